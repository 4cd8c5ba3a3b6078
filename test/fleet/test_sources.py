"""Which bags are found, and when a bag is complete."""

import os

import pytest

from slpi_ros.errors import RecordError, UsageError
from slpi_ros.fleet.sources import find_bags, is_complete, load_models


def touch(path, content=b"x"):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)
    return path


def names(found, folder):
    return [os.path.relpath(bag.path, folder) for bag in found]


def test_folders_are_searched(tmp_path):
    touch(tmp_path / "day" / "one" / "metadata.yaml")
    touch(tmp_path / "day" / "one" / "one_0.mcap")
    touch(tmp_path / "day" / "lone.mcap")
    touch(tmp_path / "day" / "other.db3")
    touch(tmp_path / "day" / "split" / "split_0.mcap")
    touch(tmp_path / "day" / "split" / "split_1.mcap")
    touch(tmp_path / ".two.partial" / "two" / "metadata.yaml")
    touch(tmp_path / "day" / "notes.txt")
    assert names(find_bags([tmp_path]), tmp_path) == ["day/lone.mcap", "day/one", "day/other.db3", "day/split"]
    assert find_bags([tmp_path, tmp_path / "day", tmp_path / "day" / "one"]) == find_bags([tmp_path])


def test_a_list_names_the_stages(tmp_path):
    touch(tmp_path / "x.mcap")
    listed = touch(tmp_path / "list.csv", b"bag,stage,note\nx.mcap, a ,1\nmissing,b,2\n")
    assert [(bag.stage, bag.size) for bag in find_bags([listed])] == [("b", 0), ("a", 1)]
    assert find_bags([tmp_path, listed]) == find_bags([listed, tmp_path])
    again = touch(tmp_path / "again.csv", b"bag,stage\nx.mcap,b\n")
    with pytest.raises(UsageError, match="'b'"):
        find_bags([listed, again])
    with pytest.raises(UsageError):
        find_bags([touch(tmp_path / "other.csv", b"path,name\nx,a\n")])


def test_what_is_not_there(tmp_path):
    with pytest.raises(RecordError):
        find_bags([tmp_path / "nothing"])
    with pytest.raises(UsageError):
        find_bags([])
    with pytest.raises(UsageError):
        load_models(tmp_path / "nothing")


def test_a_changed_bag_is_another(tmp_path):
    path = touch(tmp_path / "x.mcap")
    before = find_bags([path])
    assert find_bags([path]) == before
    os.utime(path, ns=(1, before[0].modified + 1))
    assert find_bags([path]) != before


def test_complete_bags(tmp_path):
    touch(tmp_path / "done" / "metadata.yaml")
    touch(tmp_path / "growing" / "growing_0.mcap")
    touch(tmp_path / "end.mcap", b"anything else\x89MCAP0\r\n")
    touch(tmp_path / "cut.mcap", b"anything")
    found = find_bags([tmp_path])
    now = max(bag.modified for bag in found) * 1e-9
    complete = {os.path.basename(bag.path) for bag in found if is_complete(bag, now, 60.0)}
    assert complete == {"done", "end.mcap"}
    assert all(is_complete(bag, now + 61.0, 60.0) for bag in found)
