"""The memory in a file: back as it was, or refused in one line."""

import json
from dataclasses import replace

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from strategies import two_axes

from slpi_ros.errors import ModelError
from slpi_ros.runtime.saved_memory import SavedAxis, SavedMemory, load_memory, model_id, save_memory
from slpi_ros.stream import Limits

MODEL = two_axes()
SAVED = SavedMemory(
    model_id(MODEL), True, {"x": SavedAxis((0.0, 60.0, 20.0, 1 / 3), True), "y": SavedAxis((-0.1,), False)}
)
LIMITS = [Limits(-1.0, 100.0)] * 2


def test_it_comes_back_to_the_last_bit(tmp_path):
    path = tmp_path / "memory.json"
    assert load_memory(path) is None
    save_memory(SAVED, path)
    assert load_memory(path) == SAVED
    SAVED.require_fit(MODEL, ["y", "x"], LIMITS)


def test_it_belongs_to_one_model_its_axes_and_its_limits():
    other = replace(MODEL, created="2030-01-01T00:00:00Z")
    with pytest.raises(ModelError, match="another model"):
        SAVED.require_fit(other, ["x"], LIMITS[:1])
    with pytest.raises(ModelError, match="no axis 'z'"):
        SAVED.require_fit(MODEL, ["x", "z"], LIMITS)
    with pytest.raises(ModelError, match=r"-0\.1 V for axis 'y', outside 0\.\.1 V"):
        SAVED.require_fit(MODEL, ["x", "y"], [Limits(0.0, 1.0)] * 2)


def texts() -> list[str]:
    save = {"schema": "slpi_ros/saved_memory/1", "model": "0" * 64, "complete": True}
    good = save | {"axes": {"x": {"went_through_V": [1.0], "certain": True}}}
    wrong_axes = [
        {}, None, {"x": {}}, {"x": {"went_through_V": [], "certain": True}},
        {"x": {"went_through_V": [1e9], "certain": True}}, {"x": {"went_through_V": ["1"], "certain": True}},
        {"x": {"went_through_V": [10**400], "certain": True}}, {"x": {"went_through_V": [1.0], "certain": 1}},
    ]  # fmt: skip
    return [
        "", "garbage", "[" * 100_000, "null", json.dumps(good)[:-9], json.dumps(good).replace("1.0", "NaN"),
        json.dumps(good).replace("1.0", "1e400"), json.dumps(good | {"schema": "slpi_ros/model/1"}),
        json.dumps(good | {"model": "abc"}), json.dumps(good | {"more": 1}),
        *(json.dumps(save | {"axes": axes}) for axes in wrong_axes),
    ]  # fmt: skip


@pytest.mark.parametrize("text", texts(), ids=range(len(texts())))
def test_what_is_no_saved_memory_is_refused_in_one_line(tmp_path, text):
    path = tmp_path / "memory.json"
    path.write_text(text)
    with pytest.raises(ModelError, match="^[^\n]+$"):
        load_memory(path)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.binary(max_size=60))
def test_noise_is_refused_in_one_line(tmp_path, noise):
    path = tmp_path / "memory.json"
    path.write_bytes(noise)
    with pytest.raises(ModelError, match="^[^\n]+$"):
        load_memory(path)


def test_a_place_that_cannot_be_written_is_said(tmp_path):
    with pytest.raises(ModelError, match="cannot be written"):
        save_memory(SAVED, tmp_path / "no folder" / "memory.json")
    with pytest.raises(ModelError, match="no saved memory"):
        load_memory(tmp_path)
