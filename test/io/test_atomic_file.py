"""Folders are made before long work, and refused in one line."""

from refusals import refusal

from slpi_ros.errors import SlpiError
from slpi_ros.io.atomic_file import make_folder


def test_makes_a_folder_and_those_above(tmp_path):
    make_folder(tmp_path / "a" / "b")
    make_folder(tmp_path / "a" / "b")
    assert (tmp_path / "a" / "b").is_dir()


def test_says_why_not(tmp_path):
    (tmp_path / "file").touch()
    for path in (tmp_path / "file", tmp_path / "file" / "below", "/proc/none", "nul\0"):
        assert str(path).strip("\0") in refusal(SlpiError, make_folder, path)
