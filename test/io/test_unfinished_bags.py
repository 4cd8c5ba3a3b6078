"""What a killed writer of a bag leaves: read as it lies, up to what was on the disk."""

import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from forked import completed
from refusals import holds, refusal

from slpi_ros.errors import RecordError
from slpi_ros.fleet.sources import find_bags
from slpi_ros.io.bag_files import BagWatch
from slpi_ros.io.bag_reader import read_bag
from slpi_ros.io.bag_writer import BagWriter
from slpi_ros.io.digests import digests
from slpi_ros.io.unfinished_bags import NOTE, is_being_written, partial_path, place_of, set_aside

# Messages on the disk, and further ones that the process takes with it; the second time SQLite has written some of
# these to its file, and needs its journal to undo them.
SYNCED, LOST = 700, 9000
WRITER = """
import os, signal, sys
from slpi_ros.io.bag_writer import BagWriter
from slpi_ros.io.messages import encode_joint_states
import numpy as np

path, storage, synced, lost, spilled = sys.argv[1], sys.argv[2], *map(int, sys.argv[3:6])
bag = BagWriter(path, storage=storage)
count = synced + lost
t = np.arange(1, count + 1, dtype=np.int64) * 1_000_000
rows = np.arange(count)[:, None]
messages = list(encode_joint_states(t, rows * 1e-9, rows * 0.01, ("x",), "stage-7"))
if spilled:
    bag._writer.storage.conn.execute("PRAGMA cache_size = 1")
for row, message in enumerate(messages):
    if row == synced:
        bag.sync()
    bag.write(int(t[row]), message)
print("written", flush=True)
if sys.stdin.readline():
    os.kill(os.getpid(), signal.SIGKILL)
"""


def writing(path, storage, synced=SYNCED, lost=LOST, spilled=False) -> subprocess.Popen[str]:
    """Return a process that has written to a bag, and kills itself when it is told to."""
    given = [str(path), storage, *map(str, (synced, lost, int(spilled)))]
    command = [sys.executable, "-c", WRITER, *given]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "written\n"
    return process


def killed(process: subprocess.Popen[str]) -> None:
    process.communicate("die\n")
    assert process.returncode == -signal.SIGKILL


@pytest.mark.parametrize(("storage", "spilled"), [("mcap", False), ("sqlite3", False), ("sqlite3", True)])
def test_what_was_on_the_disk_is_read_as_it_lies(tmp_path, storage, spilled):
    path = tmp_path / "bag"
    process = writing(path, storage, spilled=spilled)
    assert is_being_written(partial_path(path))
    assert holds(refusal(RecordError, read_bag, path), partial_path(path), "wait")
    killed(process)
    assert not is_being_written(partial_path(path))
    left = partial_path(path) / "bag"
    (file,) = (each for each in left.iterdir() if each.suffix in (".mcap", ".db3"))
    before = {each.name: each.read_bytes() for each in left.iterdir()}
    for place in (path, partial_path(path), left, file):
        record = read_bag(place)
        assert SYNCED <= len(record) < SYNCED + LOST + (storage == "mcap")
        np.testing.assert_array_equal(record.displacement["x"], np.arange(len(record)) * 1e-9)
        assert record.hardware_id == "stage-7" and NOTE in record.notes
    if storage == "sqlite3":
        assert len(record) == SYNCED
        assert (left / "bag.db3-journal").exists() == spilled or not spilled
    assert before == {each.name: each.read_bytes() for each in left.iterdir()}
    assert holds(refusal(RecordError, BagWriter, path), partial_path(path), "slpi")


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_nothing_was_on_the_disk(tmp_path, storage):
    killed(writing(tmp_path / "bag", storage, synced=10, lost=-5))
    assert holds(refusal(RecordError, read_bag, tmp_path / "bag"), "bag")


def test_mcap_that_ends_anywhere_in_a_record(tmp_path):
    killed(writing(tmp_path / "bag", "mcap", lost=1))
    file = partial_path(tmp_path / "bag") / "bag" / "bag.mcap"
    whole = file.read_bytes()
    sizes = set()
    for kept in (*np.random.default_rng(1).integers(0, len(whole), 30), len(whole)):
        file.write_bytes(whole[:kept] + bytes(kept % 3))
        try:
            sizes.add(len(read_bag(tmp_path / "bag")))
        except RecordError as error:
            assert "\n" not in str(error)
            sizes.add(0)
    assert sizes == {0, SYNCED}


def test_a_journal_that_names_another_is_refused(tmp_path):
    killed(writing(tmp_path / "bag", "sqlite3", spilled=True))
    journal = partial_path(tmp_path / "bag") / "bag" / "bag.db3-journal"
    journal.write_bytes(journal.read_bytes() + b"\xd9\xd5\x05\xf9\x20\xa1\x63\xd7")
    assert holds(refusal(RecordError, read_bag, tmp_path / "bag"), "journal")


def test_a_watched_folder_gives_it_once_its_writer_is_dead(tmp_path):
    watch = BagWatch(tmp_path)
    process = writing(tmp_path / "bag", "mcap")
    assert watch.poll() == []
    killed(process)
    (found,) = watch.poll()
    assert len(read_bag(found)) >= SYNCED
    assert watch.poll() == []


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_it_is_set_aside_and_read_by_its_new_name(tmp_path, storage):
    names = ["killed_bag", "killed_bag_1"]
    for _ in names:
        killed(writing(tmp_path / "bag", storage))
        set_aside(tmp_path, "killed_")
        assert not partial_path(tmp_path / "bag").exists()
    for name in names:
        assert len(read_bag(tmp_path / name)) >= SYNCED and NOTE in read_bag(tmp_path / name).notes
    (tmp_path / ".empty.partial").mkdir()
    writer = writing(tmp_path / "bag", storage)
    set_aside(tmp_path, "killed_")
    assert not partial_path(tmp_path / "empty").exists() and partial_path(tmp_path / "bag").exists()
    killed(writer)


def test_a_complete_bag_of_the_name_comes_first(tmp_path):
    killed(writing(tmp_path / "bag", "mcap"))
    shutil.move(partial_path(tmp_path / "bag"), tmp_path / "aside")
    with BagWriter(tmp_path / "bag") as bag:
        bag.write(1, bytes(100))
    shutil.move(tmp_path / "aside", partial_path(tmp_path / "bag"))
    assert os.listdir(tmp_path / "bag")
    assert holds(refusal(RecordError, read_bag, tmp_path / "bag"), tmp_path / "bag")


def test_places_that_are_no_recording(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / ".bag.partial").mkdir()
    (tmp_path / ".other.partial" / "bag").mkdir(parents=True)
    for path in (Path("/"), Path(), Path(".."), Path("bag"), Path("other"), Path(".other.partial")):
        assert place_of(path) == path


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_commands_take_it_by_its_name(tmp_path, storage):
    killed(writing(tmp_path / "bag", storage))
    assert len(digests(tmp_path / "bag")) >= 1
    (bag,) = find_bags([tmp_path / "bag"])
    assert bag.size > 0
    done = completed("slpi_ros.cli:main", ["doctor", str(tmp_path / "bag"), "--no-ros", "-v"])
    assert holds(done.stdout, tmp_path / "bag", "axis")
