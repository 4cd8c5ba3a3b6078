"""Whatever is read can be used; mutated documents are refused or valid, and nothing else."""

import copy
import json
import random
import warnings

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import assert_same_model, fractions, prandtl_ishlinskii, two_axes

from slpi_ros.errors import ModelError, SlpiError
from slpi_ros.model.document import format_model, parse_model
from slpi_ros.model.stage_model import HeldAtLimitWarning

TEXT = format_model(two_axes())
DOCUMENT = json.loads(TEXT)
ODD_NUMBERS = (10**30, -(2**63), 1e308, 5e-324, -0.0)

JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=4) | st.sampled_from(ODD_NUMBERS),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=2), inner, max_size=2),
    max_leaves=4,
)


def used(text: str) -> None:
    """Whatever is read can be used: with finite answers within limits, and errors of our own only."""
    try:
        model = parse_model(text, "here.json")
    except ModelError as error:
        assert str(error).startswith("here.json: ")
        assert "\n" not in str(error)
        return
    assert_same_model(parse_model(format_model(model), "again"), model)
    for name, axis in model.axes.items():
        low, high = axis.voltage_range
        v = np.array([low, high, 0.5 * low + 0.5 * high, *np.linspace(low, high, 50)])
        try:
            y = model.simulate(np.arange(v.size), {name: v})[name]
            assert np.isfinite(y).all()
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", HeldAtLimitWarning)
                back = model.compensate(np.arange(v.size), {name: np.clip(y, *axis.displacement_range)})[name]
            assert ((low <= back) & (back <= high)).all()
        except SlpiError as error:
            assert "\n" not in str(error)


@given(st.randoms(use_true_random=False), st.integers(1, 3), JSON, st.sampled_from([None, 0.1, 10.0, -1.0, 1e9, 1e-9]))
def test_mutated_documents_are_refused_or_valid(choose: random.Random, mutations, value, factor):
    document = copy.deepcopy(DOCUMENT)
    for _ in range(mutations):
        node, key = document, "axes"
        while isinstance(node[key], dict | list) and node[key] and choose.random() < 0.85:
            node = node[key]
            key = choose.choice(list(node)) if isinstance(node, dict) else choose.randrange(len(node))
        if factor and isinstance(node[key], float):
            node[key] *= factor
        elif choose.random() < 0.2:
            del node[key]
            break
        elif isinstance(node, list) and choose.random() < 0.3:
            node.insert(key, copy.deepcopy(value))
        else:
            node[key] = copy.deepcopy(value)
    used(json.dumps(document))


INSERTIONS = st.text('0123456789.eE+-,:[]{}" \n\\ux\0nN', max_size=4)


@given(st.lists(st.tuples(fractions(0, 1), st.integers(0, 4), INSERTIONS), min_size=1, max_size=3))
def test_mutated_texts_are_refused_or_valid(edits):
    text = TEXT
    for share, cut, insertion in edits:
        at = int(share * len(text))
        text = text[:at] + insertion + text[at + cut :]
    used(text)


@pytest.mark.parametrize("number", [1e6, -1e6, 1e300, 10**30])
@pytest.mark.parametrize(
    "place",
    [("start", "voltage_V"), ("start", "history_V", 1), ("hysteresis", "grid_V", 2), ("voltage_range_V", 1)],
    ids=str,
)
def test_absurd_voltages_are_refused_here_or_in_use(place, number):
    document = copy.deepcopy(DOCUMENT)
    node = document["axes"]["x"]
    for key in place[:-1]:
        node = node[key]
    node[place[-1]] = number
    used(json.dumps(document))


@given(prandtl_ishlinskii())
def test_a_model_without_an_inverse_is_still_a_model(shape):
    document = copy.deepcopy(DOCUMENT)
    document["axes"]["y"]["hysteresis"] = {
        "thresholds_V": [r + 1.0 for r in shape.thresholds.tolist()],
        "weights_m_per_V": shape.weights.tolist(),
    }
    used(json.dumps(document))
