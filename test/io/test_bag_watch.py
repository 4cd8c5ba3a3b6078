"""Which bags of a folder are complete."""

import os
import time

import numpy as np
import pytest
from refusals import holds, refusal

from slpi_ros.errors import UsageError
from slpi_ros.io.bag_files import BagWatch
from slpi_ros.io.bag_writer import BagWriter, write_bag
from slpi_ros.io.record import Record


def write(path, finished):
    stamps = np.arange(60, dtype=np.int64) * 5_000_000 + 1
    write_bag(path, Record(stamps, {"x": np.linspace(0, 1, 60)}, {"x": np.linspace(0, 1, 60)}))
    os.utime(path / "metadata.yaml", ns=(finished, finished))


def test_only_the_newest_one_that_is_there_counts_as_new(tmp_path):
    for k, name in enumerate(("b", "a", "c")):
        write(tmp_path / name, 10**18 + k * 10**9)
    watch = BagWatch(tmp_path)
    assert watch.poll() == [tmp_path / "c"]
    assert watch.poll() == []
    write(tmp_path / "d", 2 * 10**18)
    write(tmp_path / "e", 10**18)
    assert watch.poll() == [tmp_path / "e", tmp_path / "d"]


def test_what_is_being_written_is_no_bag_yet(tmp_path):
    watch = BagWatch(tmp_path)
    write(tmp_path / "whole", 10**18)
    (lone,) = (tmp_path / "whole").glob("*.mcap")
    data = lone.read_bytes()
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "folder_0.mcap").write_bytes(data)
    (tmp_path / "lone.mcap").write_bytes(data[:-5])
    (tmp_path / ".hidden.partial").mkdir()
    (tmp_path / ".hidden.partial" / "metadata.yaml").write_text("x")
    (tmp_path / "notes.txt").write_text("x")
    (tmp_path / "empty.mcap").touch()
    assert watch.poll() == [tmp_path / "whole"]
    (tmp_path / "lone.mcap").write_bytes(data)
    (tmp_path / "folder" / "metadata.yaml").touch()
    assert watch.poll() == [tmp_path / "lone.mcap"]
    (tmp_path / "folder" / "metadata.yaml").write_text("x")
    assert watch.poll() == [tmp_path / "folder"]


def test_a_folder_that_goes_holds_none(tmp_path):
    folder = tmp_path / "bags"
    folder.mkdir()
    watch = BagWatch(folder)
    folder.rmdir()
    assert watch.poll() == []
    assert holds(refusal(UsageError, BagWatch, folder), folder)


def rest(path, seconds):
    """Let a bag look as if nothing had been written to it for so long."""
    last = time.time_ns() - int(seconds * 1e9)
    for part in (*path.rglob("*"), path):
        os.utime(part, ns=(last, last))


@pytest.fixture
def unfinished(tmp_path):
    """Return a folder with one bag of every kind that is never finished, and with what is no bag."""
    write(tmp_path / "elsewhere" / "whole", 10**18)
    (lone,) = (tmp_path / "elsewhere" / "whole").glob("*.mcap")
    watched = tmp_path / "watched"
    for name, part in (("killed", "killed_0.mcap"), ("other", "other_0.db3.zstd"), ("notes", "notes.txt")):
        (watched / name).mkdir(parents=True)
        (watched / name / part).write_bytes(lone.read_bytes()[:-5])
    (watched / "junk.mcap").write_bytes(b"junk")
    (watched / "junk.txt").write_bytes(b"junk")
    (watched / ".hidden.mcap").touch()
    BagWriter(watched / "ours")
    return watched


def test_what_has_not_grown_for_long_is_abandoned(unfinished):
    watch = BagWatch(unfinished, patience=30.0)
    names = [".ours.partial", "junk.mcap", "killed", "other"]
    assert watch.poll() == [] and watch.abandoned == ()
    for path in unfinished.iterdir():
        rest(path, 29.0)
    assert watch.poll() == [] and watch.abandoned == ()
    for path in unfinished.iterdir():
        rest(path, 31.0)
    assert watch.poll() == [] and watch.abandoned == tuple(unfinished / name for name in names)


def test_what_was_abandoned_stays_watched(unfinished):
    watch = BagWatch(unfinished, patience=30.0)
    for path in unfinished.iterdir():
        rest(path, 31.0)
    watch.poll()
    # One grows, one goes, one is mended.
    with (unfinished / "junk.mcap").open("ab") as file:
        file.write(b"more")
    for path in ("other_0.db3.zstd", ""):
        (unfinished / "other" / path).unlink() if path else (unfinished / "other").rmdir()
    (unfinished / "killed" / "metadata.yaml").write_text("x")
    assert watch.poll() == [unfinished / "killed"]
    assert watch.abandoned == (unfinished / ".ours.partial",)


def test_a_part_that_grows_keeps_its_bag(unfinished):
    watch = BagWatch(unfinished, patience=30.0)
    rest(unfinished / "killed", 31.0)
    watch.poll()
    assert unfinished / "killed" in watch.abandoned
    (unfinished / "killed" / "killed_0.mcap").touch()
    watch.poll()
    assert unfinished / "killed" not in watch.abandoned
