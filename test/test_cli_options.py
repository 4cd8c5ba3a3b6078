"""Options that make no sense: refused in one line, before anything is read."""

import pytest

from slpi_ros.cli import main

BAG = "no such bag"
IDENTIFY = ("identify", BAG, "-o", "m.json")
DIAGNOSE = ("diagnose", BAG, "--model", "no such model", "-o", "out")
EXCITE = ("excite", "-o", "drive.csv", "--voltage-min", "0")
APART = ("--voltage-topic", "u", "--displacement-topic", "y")


def refused(capsys, folder, *arguments):
    """Return the one line that is said on a wrong usage."""
    try:
        code = main(arguments)
    except SystemExit as end:
        code = end.code
    said = capsys.readouterr()
    assert code == 2 and not said.out and said.err.count("\n") == 1, said
    assert said.err.startswith(f"slpi {arguments[0]}: ") and not list(folder.iterdir())
    return said.err


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("command", [IDENTIFY, DIAGNOSE])
def test_one_topic_or_two(command, capsys, folder):
    assert "--topic" in refused(capsys, folder, *command, *APART, "--topic", "stage_state")
    for option in (("--clock", "voltage"), ("--voltage-measured",)):
        assert option[0] in refused(capsys, folder, *command, *option)
        assert option[0] in refused(capsys, folder, *command, *option, "--topic", "stage_state")


@pytest.mark.parametrize("command", [IDENTIFY, DIAGNOSE, (*EXCITE, "--voltage-max", "100")])
def test_an_axis_is_named_once(command, capsys, folder):
    assert "--axis" in refused(capsys, folder, *command, "--axis", "x", "y", "x")


@pytest.mark.parametrize("kind", ["slpi", "pi", "mpi", "smpi"])
def test_loops_at_rest_are_of_one_kind(kind, capsys, folder):
    said = refused(capsys, folder, *IDENTIFY, "--kind", kind, "--loops-at-rest", "--report", "page")
    assert "slpi-published" in said and kind in said


@pytest.mark.parametrize("limits", [("0", "1e9"), ("-1e9", "0"), ("0", "10000.1")])
def test_voltages_that_no_stage_has(limits, capsys, folder):
    low, high = limits
    options = ("excite", "-o", "drive.csv", f"--voltage-min={low}", "--voltage-max", high)
    assert "10000 V" in refused(capsys, folder, *options)
