"""Folders are made before long work, and refused in one line."""

import os

import pytest
from refusals import refusal

from slpi_ros.errors import SlpiError
from slpi_ros.io.atomic_file import all_or_nothing, make_folder, output_folder


def test_makes_a_folder_and_those_above(tmp_path):
    make_folder(tmp_path / "a" / "b")
    make_folder(tmp_path / "a" / "b")
    assert (tmp_path / "a" / "b").is_dir()


def test_says_why_not(tmp_path):
    (tmp_path / "file").touch()
    for path in (tmp_path / "file", tmp_path / "file" / "below", "/proc/none", "nul\0"):
        assert str(path).strip("\0") in refusal(SlpiError, make_folder, path)


def test_what_is_no_regular_file_stays(tmp_path):
    os.mkfifo(tmp_path / "pipe")

    def write(path):
        with all_or_nothing(path) as file:
            file.write("text")

    for path in (tmp_path / "pipe", ""):
        assert f"'{path}'" in refusal(SlpiError, write, path)
    assert str(tmp_path) in refusal(SlpiError, write, tmp_path)
    assert (tmp_path / "pipe").is_fifo() and [path.name for path in tmp_path.iterdir()] == ["pipe"]


def test_a_link_stays_a_link(tmp_path):
    (tmp_path / "dated").touch()
    (tmp_path / "latest").symlink_to("dated")
    with all_or_nothing(tmp_path / "latest") as file:
        file.write("text")
    assert (tmp_path / "latest").is_symlink() and (tmp_path / "dated").read_text() == "text"


def test_a_folder_for_files_goes_with_the_failure(tmp_path):
    (tmp_path / "there").mkdir()
    for place in ("new/below", "there"):
        with pytest.raises(KeyboardInterrupt), output_folder(tmp_path / place):
            raise KeyboardInterrupt
    assert [path.name for path in tmp_path.iterdir()] == ["there"]
    with output_folder(tmp_path / "new" / "below") as folder:
        pass
    assert folder.is_dir()
    with pytest.raises(SlpiError), output_folder(""):
        pass
