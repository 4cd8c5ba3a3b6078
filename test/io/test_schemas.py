"""The quick validation accepts every usual document, and nothing that jsonschema refuses."""

import copy
import json

import pytest
from hypothesis import given
from hypothesis import strategies as st
from jsonschema import Draft202012Validator
from strategies import two_axes

from slpi_ros.errors import ModelError
from slpi_ros.io.schemas import _conforms, load_schema, validate
from slpi_ros.model.document import format_model

SCHEMA = load_schema("model")
DOCUMENT = json.loads(format_model(two_axes()))
MODES = [{"frequency": 100.0, "damping": 0.1, "gain": 0.4}, {"frequency": 200.0, "damping": 0.1, "gain": 0.4}]
DOCUMENT["axes"]["x"]["effects"] = [
    {"name": "resonance", "parameters": {"modes": MODES}, "uncertainty": {"modes.0.gain": 0.1}},
    {"name": "hum", "parameters": {"lines": [{"frequency": 50.0, "amplitude": 1e-9, "phase": 0.0}]}},
]
AXIS = {"verdict": "named", "floor_rms_m": 1e-9, "before_rms_m": 2e-9, "after_rms_m": 1e-9, "effects": []}
AXIS |= {"next_experiment": None, "records": [{"source": "bag", "offset_m": 0.0, "left_out_rms_m": None}]}
AXIS["records"][0] |= {"before_rms_m": 2e-9, "after_rms_m": 1e-9}
LEFT = {"variable": "rate", "share": 0.6, "evidence": "The rate predicts 60 % of the rest."}
ODD = (None, True, False, 0, -1, 1.0, 2.5, 1e300, 10**30, float("nan"), float("inf"), "", "slpi", "lag", [], {})
ODD += ([0.0, 1.0, 2.0], [float("nan"), 1.0, -5.0], [1.0, float("nan"), -5.0, 3.0], ["a"], {"name": "lag"}, {"kind": 1})


def places(value, path=()):
    """Yield the path to every part of a document."""
    yield path
    for key in value if isinstance(value, dict) else range(min(len(value), 3)) if isinstance(value, list) else ():
        yield from places(value[key], (*path, key))


PLACES = [path for path in places(DOCUMENT) if path]


@pytest.mark.parametrize("verdict", ["named", "partly_named", "ambiguous", "unexplained", "nothing_found"])
@pytest.mark.parametrize("left", [{}, {"left": []}, {"left": [LEFT]}], ids=str)
def test_diagnoses(verdict, left):
    validate({"schema": "slpi_ros/diagnosis/2", "axes": {"x": AXIS | left | {"verdict": verdict}}}, "diagnosis", "here")


@pytest.mark.parametrize(
    "change",
    [
        {"verdict": "mostly_named"},
        {"left": LEFT},
        {"left": [LEFT | {"share": 1.5}]},
        {"left": [LEFT | {"more": 1}]},
        {"left": [{"variable": "rate", "share": 0.6}]},
    ],
    ids=str,
)
def test_what_is_no_diagnosis(change):
    with pytest.raises(ModelError, match="^here: [^\n]+$"):
        validate({"schema": "slpi_ros/diagnosis/2", "axes": {"x": AXIS | change}}, "diagnosis", "here")


def test_usual_documents_need_no_other_validation():
    assert _conforms(DOCUMENT, SCHEMA, SCHEMA)


@given(st.lists(st.tuples(st.sampled_from(PLACES), st.sampled_from(ODD), st.booleans()), min_size=1, max_size=3))
def test_nothing_invalid_is_accepted(changes):
    changed = copy.deepcopy(DOCUMENT)
    for path, odd, removed in changes:
        at = changed
        try:
            for key in path[:-1]:
                at = at[key]
            at[path[-1]] = copy.deepcopy(odd)
            if removed:
                del at[path[-1]]
        except (KeyError, IndexError, TypeError):
            continue
    if _conforms(changed, SCHEMA, SCHEMA):
        assert Draft202012Validator(SCHEMA).is_valid(changed)
