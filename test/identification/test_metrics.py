"""The papers' error figures, computed by hand."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slpi_ros.errors import UsageError
from slpi_ros.identification.signal_statistics import error_metrics


def test_figures_by_hand():
    """Errors 0, 1, -1, 3; squares 0, 1, 1, 9; measured 0, 2, 4, 6 about 3: 9 + 1 + 1 + 9."""
    found = error_metrics([0.0, 2.0, 4.0, 6.0], [0.0, 1.0, 5.0, 3.0])
    assert found.maximum == 3.0
    assert found.mean == 1.25
    assert found.mean_square == 2.75
    assert found.root_mean_square == pytest.approx(np.sqrt(2.75))
    assert found.r_squared == pytest.approx(1 - 11 / 20)


def test_a_perfect_model_and_the_mean():
    y = np.array([1e-6, 3e-6, 2e-6])
    perfect = error_metrics(y, y)
    assert (perfect.maximum, perfect.mean, perfect.root_mean_square, perfect.mean_square) == (0, 0, 0, 0)
    assert perfect.r_squared == 1.0
    assert error_metrics(y, np.full(3, 2e-6)).r_squared == pytest.approx(0.0)


@given(st.lists(st.tuples(st.integers(-9, 9), st.integers(-9, 9)), max_size=20))
def test_the_root_lies_between_mean_and_maximum(pairs):
    """By this the paper's "mean square errors" are told to be roots."""
    y, model = np.array([[0.0, 0.0], [1.0, 1.0], *pairs]).T
    found = error_metrics(y, model)
    assert found.mean <= found.root_mean_square * (1 + 1e-12) <= found.maximum * (1 + 1e-11)
    assert found.mean_square <= found.maximum * found.mean * (1 + 1e-12)


@pytest.mark.parametrize(
    ("measured", "model", "message"),
    [
        ([], [], "as many of each"),
        ([1.0, 2.0], [1.0], "as many of each"),
        ([[1.0, 2.0]], [[1.0, 2.0]], "as many of each"),
        ([1.0, np.nan], [1.0, 2.0], "not finite"),
        ([1.0, 2.0], [1.0, np.inf], "not finite"),
        ([2e-6, 2e-6], [1e-6, 2e-6], "all measured values are 2e-06 m"),
    ],
)
def test_what_cannot_be_compared(measured, model, message):
    with pytest.raises(UsageError, match=message):
        error_metrics(measured, model)
