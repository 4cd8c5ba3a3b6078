import json

import numpy as np
import pytest
from hypothesis import given
from strategies import loop_families, prandtl_ishlinskii

from slpi_ros.errors import ModelError
from slpi_ros.hysteresis.kinds import DESCRIPTIONS, from_document, to_document
from slpi_ros.hysteresis.prandtl_ishlinskii import PrandtlIshlinskii

FAMILY = {
    "grid_V": [0.0, 10.0, 30.0],
    "surface_m": [[0.0], [1.0, 0.0], [4.0, 2.5, 0.0]],
    "first_rise_m": [5.0, 6.5, 9.0],
    "edge_gain_m_per_V": 0.1,
}


@given(prandtl_ishlinskii() | loop_families())
def test_documents_keep_every_bit(shape):
    kind = "pi" if isinstance(shape, PrandtlIshlinskii) else "slpi"
    document = to_document(shape)
    again = from_document(kind, json.loads(json.dumps(document, allow_nan=False)))
    assert type(again) is type(shape)
    for name in ("thresholds", "weights") if kind == "pi" else ("grid", "everett", "rise", "edge_gain"):
        assert np.array_equal(getattr(again, name), getattr(shape, name))
    assert to_document(again) == document


PLAYS = {"thresholds_V": [0.0, 5.0, 20.0], "weights_m_per_V": [1e-7, 2e-8, 0.0]}
LOOP = {
    "level": 0, "direction": 1, "vertex_V": 0.0, "vertex_m": 1e-7, "span_V": 100.0, "span_m": 2e-5,
    "offset_V": 0.5, "offset_m": 1e-7, "run_in_V": None, **PLAYS,
}  # fmt: skip
SLOPES = {"origin_V": -5.0, "amplitude_V": 120.0, **PLAYS}
DOCUMENTS = {
    "slpi": FAMILY,
    "slpi-published": {"dead_band_V": 0.1, "loops": [LOOP, {**LOOP, "level": 1, "direction": -1, "run_in_V": 0.0}]},
    "pi": PLAYS,
    "mpi": SLOPES,
    "smpi": {**SLOPES, "peak_voltages_V": [20.0, 120.0], "peak_displacements_m": [1e-6, 8e-6]},
}


@pytest.mark.parametrize("kind", DESCRIPTIONS)
def test_document_of_every_kind_comes_back(kind):
    assert to_document(from_document(kind, DOCUMENTS[kind])) == DOCUMENTS[kind]


def test_published_loops_that_contradict_themselves():
    for change in ({"direction": 0}, {"span_V": 0.0}, {"run_in_V": -1.0}, {"weights_m_per_V": [0.0, 1e-7, 0.0]}):
        with pytest.raises(ModelError, match=r"\b1\b"):
            from_document("slpi-published", {"dead_band_V": 0.0, "loops": [LOOP, {**LOOP, **change}]})


def test_whole_numbers_are_numbers():
    family = from_document("slpi", {**FAMILY, "grid_V": [0, 10, 30], "first_rise_m": [5, 6, 9]})
    assert family.grid.dtype == family.rise.dtype == np.float64
    assert from_document("pi", {"thresholds_V": [0, 1], "weights_m_per_V": [1, 0]}).thresholds.dtype == np.float64


@pytest.mark.parametrize(
    "change",
    [
        {"surface_m": [[0.0], [1.0, 0.0]]},
        {"surface_m": [[0.0], [1.0, 0.0], [4.0, 2.5]]},
        {"surface_m": [[0.0], [1.0, 0.0], [4.0, 2.5, 0.0, 0.0]]},
        {"surface_m": [[0.0, 0.0, 0.0]] * 3},
        {"surface_m": [[0.0], [1.0, 0.0], [1.0, 2.5, 0.0]]},
        {"surface_m": [[0.0], [-1.0, 0.0], [4.0, 2.5, 0.0]]},
        {"first_rise_m": [5.0, 6.5]},
        {"first_rise_m": [5.0, 6.5, 6.5]},
        {"grid_V": [0.0], "surface_m": [[0.0]], "first_rise_m": [1.0]},
    ],
)
def test_families_that_contradict_themselves(change):
    with pytest.raises(ModelError):
        from_document("slpi", {**FAMILY, **change})


# JSON has whole numbers of any length; numpy makes objects of them, or wraps around.
HUGE = pytest.mark.parametrize("huge", [10**30, 10**400, 2**63], ids=["1e30", "1e400", "2^63"])


@HUGE
@pytest.mark.parametrize("key", FAMILY)
def test_huge_whole_numbers_in_a_family(key, huge):
    values = {
        "grid_V": [huge, 10, 30],
        "surface_m": [[0], [1, 0], [4, huge, 0]],
        "first_rise_m": [huge, 6, 9],
        "edge_gain_m_per_V": -huge,
    }
    with pytest.raises((ModelError, OverflowError)):
        from_document("slpi", {**FAMILY, key: values[key]})


@HUGE
def test_huge_whole_numbers_in_a_pi_model(huge):
    for thresholds, weights in ([0, -huge], [1.0, 1.0]), ([huge, 5], [1, 1]), ([0, 5], [1, -huge]):
        with pytest.raises((ModelError, OverflowError)):
            from_document("pi", {"thresholds_V": thresholds, "weights_m_per_V": weights})


def test_unknown_kind():
    with pytest.raises(ModelError, match="bouc-wen") as refusal:
        from_document("bouc-wen", {})
    assert all(kind in str(refusal.value) for kind in DESCRIPTIONS)
