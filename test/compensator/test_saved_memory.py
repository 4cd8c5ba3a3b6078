"""The memory in a file: back as it was, or refused in one line."""

import errno
import hashlib
import json
import os
import struct
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from strategies import two_axes

from slpi_ros.compensator import persistence
from slpi_ros.compensator.persistence import (
    ASSUMED,
    CRASHED,
    RESTORED,
    LastVoltages,
    MemoryConfidence,
    MemoryFile,
    SavedAxis,
    SavedMemory,
    is_kept,
    load_memory,
    model_id,
    read_last_voltages,
    save_memory,
)
from slpi_ros.errors import ModelError
from slpi_ros.model.document import format_model, save_model

MODEL = two_axes()
SAVED = SavedMemory(
    model_id(MODEL), True, {"x": SavedAxis((0.0, 60.0, 20.0, 1 / 3), True), "y": SavedAxis((-0.1,), False)}
)


def test_it_comes_back_to_the_last_bit(tmp_path):
    path = tmp_path / "memory.json"
    assert load_memory(path) is None
    save_memory(SAVED, path)
    assert load_memory(path) == SAVED
    SAVED.require_fit(MODEL, ["y", "x"])
    assert load_memory(path).last_voltages == {"x": 1 / 3, "y": -0.1}


def test_a_model_is_known_by_the_sum_of_its_document():
    assert model_id(MODEL) == hashlib.sha256(format_model(MODEL).encode()).hexdigest()


def test_it_belongs_to_one_model_and_its_axes():
    """A voltage outside the limits is no reason to forget where the amplifier is."""
    other = replace(MODEL, created="2030-01-01T00:00:00Z")
    with pytest.raises(ModelError):
        SAVED.require_fit(other, ["x"])
    with pytest.raises(ModelError, match="'z'"):
        SAVED.require_fit(MODEL, ["x", "z"])


@pytest.mark.parametrize("complete", [True, False])
def test_the_last_voltages_outlive_their_model(tmp_path, complete):
    """A model that was refitted, and a restart: only the turning points are lost. It was a step of 44 V."""
    path = tmp_path / "memory.json"
    written = MemoryFile(str(path))
    written.save(MODEL, SAVED.axes, complete)
    written.note(as_given(48.0, 3.0))
    read = load_memory(path)
    with pytest.raises(ModelError, match="^[^\n]+$"):
        read.require_fit(replace(MODEL, created="2030-01-01T00:00:00Z"), ["x", "y"])
    assert read.last_voltages == ({"x": 1 / 3, "y": -0.1} if complete else {"x": 48.0, "y": 3.0})


def test_a_place_that_takes_no_file_stays_as_it_is(tmp_path):
    """A device of the machine must outlive a saved memory that was sent there."""
    place = tmp_path / "pipe"
    os.mkfifo(place)
    memory = MemoryFile(str(place))
    with pytest.raises(ModelError):
        memory.save(MODEL, SAVED.axes, complete=False)
    assert place.is_fifo()
    os.mkfifo(tmp_path / "memory.json.last")
    reader = os.open(tmp_path / "memory.json.last", os.O_RDONLY | os.O_NONBLOCK)
    with pytest.raises(ModelError):
        MemoryFile(str(tmp_path / "memory.json")).save(MODEL, SAVED.axes, complete=False)
    os.close(reader)
    assert (tmp_path / "memory.json.last").is_fifo()


@pytest.mark.parametrize("complete", [True, False])
def test_another_document_is_not_overwritten(tmp_path, complete):
    """A memory file that is by mistake the model file."""
    path = tmp_path / "model.json"
    save_model(MODEL, path)
    before = path.read_bytes()
    for _ in range(2):
        with pytest.raises(ModelError, match="slpi_ros/model/3"):
            MemoryFile(str(path)).save(MODEL, SAVED.axes, complete)
    assert path.read_bytes() == before and not (tmp_path / "model.json.last").exists()
    for damaged in ("", "{", '{"schema": "slpi_ros/saved_memory/1"}', "[]", "\0" * 400):
        path.write_text(damaged)
        MemoryFile(str(path)).save(MODEL, SAVED.axes, complete=True)
        assert load_memory(path) == SAVED


def as_given(*voltages: float) -> bytes:
    return struct.pack(f"{len(voltages)}d", *voltages)


def crashed(path: Path, *commands: tuple[float, float]) -> SavedMemory:
    """Return what is found after a life that saved its memory, gave these voltages and was killed."""
    last = LastVoltages(path, save_memory(replace(SAVED, complete=False), path))
    for voltages in commands:
        last.note(as_given(*voltages))
    found = load_memory(path)
    assert found
    return found


def test_after_a_crash_it_is_where_the_last_command_led(tmp_path):
    path = tmp_path / "memory.json"
    found = crashed(path, (1.0, 2.0), (3.0, -0.1), (0.1, 0.2))
    assert found.axes["x"].reversal_voltages == (0.0, 60.0, 20.0, 1 / 3, 0.1)
    assert found.axes["y"].reversal_voltages == (-0.1, 0.2)
    # The mark is the memory's: what was noted for another one is not believed, nor what an orderly end makes old.
    save_memory(replace(SAVED, complete=False, model="0" * 64), path)
    assert load_memory(path).axes["x"].reversal_voltages == SAVED.axes["x"].reversal_voltages
    save_memory(SAVED, path)
    assert load_memory(path) == SAVED


def test_after_a_crash_nothing_is_certain(tmp_path):
    found = crashed(tmp_path / "memory.json")
    assert found.axes["x"] == SavedAxis(SAVED.axes["x"].reversal_voltages, True, CRASHED)
    assert found.axes["x"].confidence((0.0, 50.0)) == MemoryConfidence(ASSUMED, CRASHED)
    assert SAVED.axes["x"].confidence((0.0, 50.0)) == MemoryConfidence(RESTORED, "", (0.0, 50.0))
    assert SAVED.axes["y"].confidence((0.0, 50.0)) == MemoryConfidence()


@given(st.integers(1, 5), st.integers(0, 100), st.integers(0, 300), st.binary(max_size=8))
def test_a_torn_record_is_never_believed(tmp_path_factory, commands, mark, at, noise):
    """Whatever a crash makes of the record under way, the one before it counts."""
    memory = tmp_path_factory.mktemp("torn") / "memory"
    path = memory.with_name("memory.last")
    last, contents = LastVoltages(memory, mark), [b""]
    for i in range(commands):
        last.note(as_given(i, 10 * i))
        contents.append(path.read_bytes())
    before, after = contents[-2:]
    torn = [i for i in range(len(after)) if i >= len(before) or before[i] != after[i]]
    kept = torn[: at % (len(torn) + 1)]
    mixed = bytearray(before.ljust(len(after), b"\0"))
    for i in kept:
        mixed[i] = after[i]
    path.write_bytes(bytes(mixed))
    whole = commands - 1 if bytes(mixed) == after else commands - 2
    assert read_last_voltages(memory, mark, 2) == ((whole, 10.0 * whole) if whole >= 0 else None)
    assert read_last_voltages(memory, mark + 1, 2) is None
    path.write_bytes(noise * 20)
    assert read_last_voltages(memory, mark, 2) is None


def test_last_voltages_of_other_axes_or_nowhere(tmp_path):
    path = tmp_path / "memory"
    assert read_last_voltages(path, 1, 1) is None
    last = LastVoltages(path, 1)
    last.note(as_given(5.0))
    assert read_last_voltages(path, 1, 1) == (5.0,) and read_last_voltages(path, 1, 2) is None
    with pytest.raises(ModelError, match=f"^{path}[^\n]+$"):
        LastVoltages(path, 1)
    assert is_kept(path) and read_last_voltages(path, 1, 1) == (5.0,), "one at a time keeps them"
    last.discard()
    assert not is_kept(path)
    last = LastVoltages(path, 1)
    assert read_last_voltages(path, 1, 1) is None, "a new life starts without"
    last.discard()
    assert not list(tmp_path.iterdir())
    (tmp_path / "folder.last").mkdir()
    with pytest.raises(ModelError, match=f"^{tmp_path}[^\n]+$"):
        LastVoltages(tmp_path / "folder", 1)


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
    with pytest.raises(ModelError, match=os.strerror(errno.ENOENT)):
        save_memory(SAVED, tmp_path / "no folder" / "memory.json")
    with pytest.raises(ModelError, match=f"^[^\n]*{tmp_path}[^\n]*$"):
        load_memory(tmp_path)


@pytest.mark.parametrize("before", [True, False], ids=["ended in order", "crashed"])
def test_an_old_state_does_not_outlive_a_start_that_cannot_save(tmp_path, monkeypatch, before):
    path = tmp_path / "memory.json"
    save_memory(replace(SAVED, complete=before), path)
    full = MemoryFile(str(path))

    def no_space(memory, path):
        raise ModelError(os.strerror(errno.ENOSPC))

    monkeypatch.setattr(persistence, "save_memory", no_space)
    with pytest.raises(ModelError):
        full.save(MODEL, SAVED.axes, complete=False)
    # The next life knows nothing, rather than what was true before this one.
    assert load_memory(path) is None


def test_a_full_disk_does_not_discard_what_this_life_has_saved(tmp_path, monkeypatch):
    path = tmp_path / "memory.json"
    memory = MemoryFile(str(path))
    memory.save(MODEL, SAVED.axes, complete=False)
    memory.note(as_given(3.0, 4.0))

    def no_space(memory, path):
        raise ModelError(os.strerror(errno.ENOSPC))

    monkeypatch.setattr(persistence, "save_memory", no_space)
    moved = {**SAVED.axes, "y": SavedAxis((5.0,), False)}
    with pytest.raises(ModelError):
        memory.save(MODEL, moved, complete=False)
    assert load_memory(path).axes["x"].reversal_voltages[-1] == 3.0


def test_a_second_compensator_does_not_write_the_memory_of_a_running_one(tmp_path):
    path = tmp_path / "memory.json"
    running, second = MemoryFile(str(path)), MemoryFile(str(path))
    running.save(MODEL, SAVED.axes, complete=False)
    running.note(as_given(*[axis.reversal_voltages[-1] for axis in SAVED.axes.values()]))
    before = path.read_bytes()
    assert second.used and not running.used
    for complete in (False, True):
        with pytest.raises(ModelError, match=f"^{path}[^\n]+$"):
            second.save(MODEL, {name: replace(axis, certain=False) for name, axis in SAVED.axes.items()}, complete)
    assert path.read_bytes() == before
    running.save(MODEL, SAVED.axes, complete=True)
    assert not second.used
    second.save(MODEL, SAVED.axes, complete=True)
