"""What ``-o`` may replace: outputs of slpi of the same kind, and nothing else unless asked to; told in one line."""

import json
import os
import shutil

import numpy as np
import pytest
from identification.records import calibration

import slpi_ros
from slpi_ros.cli import main
from slpi_ros.io.bag_reader import read_bag
from slpi_ros.io.bag_writer import write_bag
from slpi_ros.io.tables import write_table

pytestmark = pytest.mark.slow

FOREIGN = "the only copy of my thesis\n"


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    """Return a folder with a bag, a model of it, tables to convert, and a table to import."""
    folder = tmp_path_factory.mktemp("inputs")
    record, _ = calibration(seed=1)
    write_bag(folder / "bag", record)
    slpi_ros.save_model(slpi_ros.identify(record, "pi"), folder / "pi.json")
    t = np.arange(200) / 100
    write_table(folder / "voltage.csv", t, {"x": 50 - 40 * np.cos(3 * t)}, "V")
    write_table(folder / "desired.csv", t, {"x": 1e-6 * (12 - 5 * np.cos(3 * t))}, "m")
    (folder / "data.csv").write_text("time_s,voltage_V,displacement_um\n0,1,2\n1,2,3\n")
    return folder


@pytest.fixture
def slpi(capsys, inputs, tmp_path, monkeypatch):
    """Return a function that runs a command in an empty folder: exit code, and the lines on standard error."""
    monkeypatch.chdir(tmp_path)

    def run(*arguments):
        try:
            code = main([str(argument) for argument in arguments])
        except SystemExit as end:
            code = end.code
        lines = capsys.readouterr().err.splitlines()
        assert all(line.startswith(f"slpi {arguments[0]}: ") for line in lines), lines
        return code, lines

    return run


EXCITE = ("excite", "--voltage-min", "0", "--voltage-max", "100", "--duration", "10")


def commands(inputs):
    """Return each command that writes one file, and how its output is named."""
    bag, model = inputs / "bag", inputs / "pi.json"
    return {
        "identify": (("identify", bag, "--kind", "pi"), "m.json"),
        "refit": (("refit", model, bag), "m.json"),
        "excite": (EXCITE, "t.csv"),
        "simulate": (("simulate", model, inputs / "voltage.csv"), "t.csv"),
        "compensate": (("compensate", model, inputs / "desired.csv"), "t.csv"),
        "tune": (("tune", model), "m.yaml"),
    }


def refused(slpi, path, *arguments, code=2):
    """Check that a command is refused in one line that names the path, and return that line."""
    found, lines = slpi(*arguments)
    assert found == code and len(lines) == 1 and str(path) in lines[0], lines
    return lines[0]


@pytest.mark.parametrize("command", ["identify", "refit", "excite", "simulate", "compensate", "tune"])
def test_a_file_that_slpi_did_not_write_stays(slpi, inputs, tmp_path, command):
    arguments, name = commands(inputs)[command]
    for text in (FOREIGN, '{"schema": "slpi_ros/diagnosis/1"}', "time_s,x_V,y_V\n0,1,2\n", '{"mine": 1}'):
        (tmp_path / name).write_text(text)
        assert "--overwrite" in refused(slpi, name, *arguments, "-o", name)
        assert (tmp_path / name).read_text() == text
    code, lines = slpi(*arguments, "-o", name, "--overwrite")
    assert code == 0 and any(name in line and "replaced" in line for line in lines)
    # Its own output is replaced without a word, of an earlier version or through a link as well.
    own = (tmp_path / name).read_text()
    (tmp_path / name).write_text(own.replace("slpi_ros/model/3", "slpi_ros/model/2"))
    (tmp_path / "link").symlink_to(name)
    for place in (name, "link"):
        assert own != text and slpi(*arguments, "-o", place) == (0, [])
    assert (tmp_path / "link").is_symlink() and sorted(os.listdir()) == ["link", name]


@pytest.mark.parametrize("command", ["identify", "refit", "excite", "simulate", "compensate", "tune"])
def test_places_where_no_file_can_be(slpi, inputs, tmp_path, command):
    arguments, _ = commands(inputs)[command]
    (tmp_path / "folder").mkdir()
    (tmp_path / "loop").symlink_to("loop")
    os.mkfifo(tmp_path / "pipe")
    for place in ("folder", "loop", "pipe", "/dev/null", "nowhere/file", "", "a" * 300):
        refused(slpi, place, *arguments, "-o", place, code=1)
        refused(slpi, place, *arguments, "-o", place, "--overwrite", code=1)
    # An empty file, as a shell makes it, holds nothing to be lost.
    (tmp_path / "empty").touch()
    assert slpi(*arguments, "-o", "empty") == (0, [])


def test_a_folder_without_permission_is_told_before_the_computation(slpi, inputs, tmp_path, monkeypatch):
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    for arguments, _ in commands(inputs).values():
        assert "write-protected" in refused(slpi, "new.file", *arguments, "-o", "new.file", code=1)


def test_no_output_goes_into_a_recording(slpi, inputs, tmp_path):
    shutil.copytree(inputs / "bag", tmp_path / "cal")
    held = sorted(os.listdir("cal"))
    for arguments, name in commands(inputs).values():
        refused(slpi, f"cal/{name}", *arguments, "-o", f"cal/{name}", "--overwrite")
    bag, model = inputs / "bag", inputs / "pi.json"
    for place in ("cal", "cal/below"):
        refused(slpi, place, "identify", bag, "-o", "m.json", "--report", place, "--overwrite")
        refused(slpi, place, "diagnose", bag, "--model", model, "-o", place, "--overwrite")
        refused(slpi, place, "verify", bag, "--model", model, "-o", place, "--overwrite")
        refused(slpi, place, "experiments", "-o", place, "--overwrite")
        refused(slpi, place, "fleet", "cal", "-o", place, "--overwrite")
        refused(slpi, place, "fleet", bag, "-o", place, "--overwrite")
    assert sorted(os.listdir("cal")) == held and os.listdir() == ["cal"]


def test_a_folder_that_slpi_did_not_make_stays(slpi, inputs, tmp_path):
    bag, model = inputs / "bag", inputs / "pi.json"
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text(FOREIGN)
    calls = (
        ("identify", bag, "--kind", "pi", "-o", "m.json", "--report", "mine"),
        ("refit", model, bag, "-o", "m.json", "--report", "mine"),
        ("diagnose", bag, "--model", model, "-o", "mine"),
        ("verify", bag, "--model", model, "-o", "mine"),
        ("fleet", bag, "-o", "mine"),
        ("experiments", "-o", "mine"),
    )
    for call in calls:
        assert "--overwrite" in refused(slpi, "mine", *call)
    assert os.listdir("mine") == ["thesis.txt"] and os.listdir() == ["mine"]
    assert slpi(*calls[0], "--overwrite")[0] == 0
    assert sorted(os.listdir("mine")) == ["report.html", "thesis.txt"]
    # From now on it is known, and a file of the same name by somebody else is not.
    assert slpi(*calls[0]) == (0, [])
    (tmp_path / "mine" / "report.html").write_text("<html>mine</html>")
    (tmp_path / "mine" / "model.json").write_bytes(model.read_bytes())
    refused(slpi, "mine/report.html", *calls[0])
    code, lines = slpi(*calls[0], "--overwrite")
    assert code == 0 and len(lines) == 1 and "mine/report.html" in lines[0]
    assert (tmp_path / "mine" / "thesis.txt").read_text() == FOREIGN


def test_places_where_no_folder_can_be(slpi, inputs, tmp_path):
    bag, model = inputs / "bag", inputs / "pi.json"
    (tmp_path / "file").write_text(FOREIGN)
    (tmp_path / "loop").symlink_to("loop")
    for place in ("file", "file/below", "loop", "a" * 300, "/proc/none"):
        for call in (("verify", bag, "--model", model), ("diagnose", bag, "--model", model), ("fleet", bag)):
            assert str(place) in refused(slpi, place, *call, "-o", place, "--overwrite", code=1)
    assert (tmp_path / "file").read_text() == FOREIGN


def test_folders_are_written_again_by_the_command_that_made_them(slpi, inputs, tmp_path):
    verify = ("verify", inputs / "bag", "--model", inputs / "pi.json", "-o", "verification", "--tolerance", "50")
    for _ in range(2):
        assert slpi(*verify) == (0, [])
    (tmp_path / "verification" / "verification.json").write_text('{"mine": 1}')
    refused(slpi, "verification.json", *verify)


def test_a_bag_is_replaced_only_on_request(slpi, inputs, tmp_path):
    call = ("import", inputs / "data.csv", "-o", "new")
    shutil.copytree(inputs / "bag", tmp_path / "new")
    assert "--overwrite" in refused(slpi, "new", *call)
    assert len(read_bag("new")) > 2
    # Whatever else is in the folder is not deleted with it.
    (tmp_path / "new" / "notes.txt").write_text(FOREIGN)
    assert "notes.txt" in refused(slpi, "new", *call, "--overwrite")
    (tmp_path / "new" / "notes.txt").unlink()
    (tmp_path / "latest").symlink_to("new")
    code, lines = slpi("import", inputs / "data.csv", "-o", "latest", "--overwrite")
    assert code == 0 and len(lines) == 1 and "latest" in lines[0]
    assert (
        len(read_bag("new")) == 2 and sorted(os.listdir()) == ["latest", "new"] and (tmp_path / "latest").is_symlink()
    )
    (tmp_path / "file").write_text(FOREIGN)
    (tmp_path / "folder").mkdir()
    for place in ("file", "folder", inputs / "data.csv"):
        for more in ((), ("--overwrite",)):
            refused(slpi, place, "import", inputs / "data.csv", "-o", place, *more)
    assert (tmp_path / "file").read_text() == FOREIGN and (tmp_path / "folder").is_dir()


def test_a_model_is_refitted_in_place(slpi, inputs, tmp_path):
    shutil.copy(inputs / "pi.json", "m.json")
    before = json.loads((tmp_path / "m.json").read_text())
    assert slpi("refit", "m.json", inputs / "bag", "-o", "m.json") == (0, [])
    assert json.loads((tmp_path / "m.json").read_text()) != before


def test_a_table_is_no_output_of_its_own_conversion(slpi, inputs, tmp_path):
    for command, name in (("compensate", "desired.csv"), ("simulate", "voltage.csv")):
        shutil.copy(inputs / name, name)
        refused(slpi, name, command, inputs / "pi.json", name, "-o", name, "--overwrite")
        assert (tmp_path / name).read_bytes() == (inputs / name).read_bytes()
