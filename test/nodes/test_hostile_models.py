"""Model documents with wrong values in them: refused with a message, or harmless."""

import copy
import json
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

rclpy = pytest.importorskip("rclpy")

from nodes.ros_helpers import stage_model  # noqa: E402

from slpi_ros.compensator.controller import Controller  # noqa: E402
from slpi_ros.compensator.validation import RejectedError  # noqa: E402
from slpi_ros.errors import SlpiError  # noqa: E402
from slpi_ros.model.document import format_model, parse_model  # noqa: E402
from slpi_ros.model.limits import Limits  # noqa: E402

SLPI = json.loads(format_model(stage_model()))
PI = copy.deepcopy(SLPI)
PI["axes"]["x"] |= {
    "kind": "pi",
    "hysteresis": {"thresholds_V": [0, 5, 10, 20, 40], "weights_m_per_V": [5e-8, 1e-8, 1e-8, 2e-8, 1e-8]},
}


def places(document: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the way to every value."""
    inside = document.items() if isinstance(document, dict) else enumerate(document)
    for key, value in inside:
        yield (*path, key)
        if isinstance(value, dict | list):
            yield from places(value, (*path, key))


WRONG = [0, -1, 1, 0.5, -1e-9, 1e-300, 5e-324, 1e-7, 100.0, -100.0, 9999.0, 1e308, 1e-308, 10**400]
WRONG += [True, None, "x", [], {}, [[]]]
FACTORS = [-1.0, 0.0, 1e-12, 1e-3, 0.5, 1.0 + 1e-9, 2.0, 100.0]


@st.composite
def spoilt(draw: st.DrawFn) -> str:
    """Return the text of a document with up to three changes."""
    document: Any = copy.deepcopy(draw(st.sampled_from([SLPI, PI])))
    for _ in range(draw(st.integers(1, 3))):
        *way, last = draw(st.sampled_from(list(places(document))))
        inside = document
        for key in way:
            inside = inside[key]
        value = inside[last]
        if isinstance(value, int | float) and abs(value) < 1e300 and draw(st.booleans()):
            inside[last] = value * draw(st.sampled_from(FACTORS))
        else:
            inside[last] = copy.deepcopy(draw(st.sampled_from(WRONG)))
    return json.dumps(document)


@settings(max_examples=300)
@given(spoilt(), st.integers(0, 2**32 - 1))
def test_a_spoilt_document_is_refused_or_harmless(text, seed):
    made = Controller(["x"], [Limits(0.0, 100.0)])
    made.activate(0)
    made.use_model(stage_model())
    made.update(1, ["x"], [3e-6], 0)
    before = made.voltages[0]
    try:
        model = parse_model(text, "spoilt")
        made.use_model(model)
    except SlpiError as error:
        assert "\n" not in str(error)
        return
    assert made.voltages[0] == before
    low, high = model.axis("x").displacement_range
    for i, y in enumerate(np.random.default_rng(seed).uniform(low - 0.2 * (high - low), high + 0.2 * (high - low), 40)):
        try:
            made.update(2 + i, ["x"], [float(y)], 0)
        except RejectedError:
            continue
        assert 0.0 <= made.voltages[0] <= 100.0
