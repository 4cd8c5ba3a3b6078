"""Options that make no sense: refused in one line, before anything is read."""

import argparse
import shlex

import numpy as np
import pytest
from strategies import two_axes

from slpi_ros.cli import COMMANDS, main, parser
from slpi_ros.io.tables import write_table
from slpi_ros.model.document import save_model
from slpi_ros.model.stage_model import StageModel

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


@pytest.mark.parametrize("option", ["--sensor-delay", "--sensor-lag"])
@pytest.mark.parametrize("value", ["nan", "inf", "-0.001", "1.5", "2ms", ""])
@pytest.mark.parametrize(
    "command", [IDENTIFY, DIAGNOSE, ("verify", BAG, "--model", "m.json"), ("refit", "m.json", BAG, "-o", "n.json")]
)
def test_a_sensor_that_no_stage_has(command, value, option, capsys, folder):
    said = refused(capsys, folder, *command, f"{option}={value}")
    assert option in said and "_s" not in said.replace("--sensor", "")


@pytest.mark.parametrize("argument", ["--axis=--", "--voltage-max=--", "--seed=--", "drive\0.csv"])
def test_arguments_that_are_no_value(argument, capsys, folder):
    with pytest.raises(SystemExit) as end:
        main([*EXCITE, "--voltage-max", "100", argument])
    assert end.value.code == 2 and capsys.readouterr().err.count("\n") == 1 and not list(folder.iterdir())


@pytest.mark.parametrize(
    "option", [("--voltage-min", "nan"), ("--voltage-max", "0"), ("--slew-limit", "-1"), ("--axis", "a\x1b[2J")]
)
def test_a_calibration_that_the_node_would_refuse(option, capsys, folder):
    refused(capsys, folder, "calibrate", "-o", "d", "--voltage-min", "0", "--voltage-max", "100", *option)


@pytest.mark.parametrize("kind", ["slpi", "pi", "mpi", "smpi"])
def test_loops_at_rest_are_of_one_kind(kind, capsys, folder):
    said = refused(capsys, folder, *IDENTIFY, "--kind", kind, "--loops-at-rest", "--report", "page")
    assert "slpi-published" in said and kind in said


@pytest.mark.parametrize("limits", [("0", "1e9"), ("-1e9", "0"), ("0", "10000.1")])
def test_voltages_that_no_stage_has(limits, capsys, folder):
    low, high = limits
    options = ("excite", "-o", "drive.csv", f"--voltage-min={low}", "--voltage-max", high)
    assert "10000 V" in refused(capsys, folder, *options)


@pytest.mark.parametrize("command", [IDENTIFY, DIAGNOSE])
def test_a_bag_is_given_once(command, capsys, folder):
    assert BAG in refused(capsys, folder, *command[:2], *command[1:])


def test_a_link_that_leads_to_itself_is_no_bag(capsys, folder):
    link = folder / "elsewhere" / "loop"
    link.parent.mkdir()
    link.symlink_to(link)
    assert main(("identify", str(link), "-o", "m.json")) == 1
    said = capsys.readouterr()
    assert not said.out and said.err.count("\n") == 1


@pytest.mark.parametrize("option", ["--start", "--stop"])
@pytest.mark.parametrize("text", ["nan", "inf", "-inf"])
def test_times_are_finite(option, text, capsys, folder):
    assert option in refused(capsys, folder, *IDENTIFY, f"{option}={text}")


@pytest.mark.parametrize("name", ["a,b", "", " ", "\x1b[2J", "a" * 101])
def test_names_of_axes_to_excite(name, capsys, folder):
    assert "--axis" in refused(capsys, folder, *EXCITE, "--voltage-max", "9", "--axis", name)


def test_a_slew_limit_near_zero(capsys, folder):
    refused(capsys, folder, *EXCITE, "--voltage-max", "9", "--slew-limit", "1e-30")


@pytest.mark.parametrize("more", [(), ("--for-response",), ("--for-path", "no such path")])
@pytest.mark.parametrize("rate", ["0", "-0.0", "-5", "nan", "inf"])
def test_a_drive_at_no_rate(rate, more, capsys, folder):
    assert "--rate" in refused(capsys, folder, *EXCITE, "--voltage-max", "9", f"--rate={rate}", *more)


def test_a_seed_that_is_none(capsys, folder):
    for more in ((), ("--for-response",)):
        assert "seed -1" in refused(capsys, folder, *EXCITE, "--voltage-max", "100", "--seed", "-1", *more)


@pytest.mark.parametrize("rate", ["1e19", "1e308"])
def test_more_samples_of_a_path_than_a_drive_has(rate, capsys, folder):
    path = folder.parent / "path.csv"
    write_table(path, np.arange(3.0), {"x": np.array([0.0, 1e-6, 0.0])}, "m")
    command = (*EXCITE, "--voltage-max", "100", "--rate", rate, "--for-path", str(path))
    assert "10000000 samples" in refused(capsys, folder, *command)


@pytest.mark.parametrize(
    "command",
    [IDENTIFY, DIAGNOSE, ("verify", BAG, "--model", "m.json"), ("refit", "m.json", BAG, "-o", "n.json")],
)
def test_a_part_that_ends_before_it_begins(command, capsys, folder, tmp_path_factory):
    model = tmp_path_factory.mktemp("model") / "m.json"
    save_model(two_axes(), model)
    words = [
        str(model) if word in ("m.json", "no such model") and command is not IDENTIFY else word for word in command
    ]
    assert "start 5.0 s is not before stop 1.0 s" in refused(capsys, folder, *words, "--start", "5", "--stop", "1")


def subparsers():
    whole = parser()
    (found,) = (action for action in whole._actions if isinstance(action, argparse._SubParsersAction))
    return found.choices


@pytest.mark.parametrize("command", COMMANDS)
def test_help_has_defaults_and_an_example_that_is_taken(command, capsys):
    own = subparsers()[command]
    for action in own._actions:
        if not isinstance(action, argparse._HelpAction) and action.option_strings and not action.required:
            assert "default" in action.help, action.option_strings
        assert action.help
    words = shlex.split(own.format_help().split("example:\n")[1])
    assert words[:2] == ["slpi", command] and parser().parse_args(words[1:]).command == command


def test_a_run_that_fails_leaves_no_folder(capsys, folder):
    assert main((*IDENTIFY, "--report", "a/b")) == 1
    assert capsys.readouterr().err.count("\n") == 1 and not list(folder.iterdir())


def test_one_line_where_remarks_and_an_error_meet(capsys, folder):
    """Commands out of reach, and a place that cannot be written."""
    inputs = folder / "in"
    inputs.mkdir()
    axis = two_axes().axes["x"]
    save_model(StageModel({"x": axis}), inputs / "m.json")
    low, high = axis.displacement_range
    t = np.arange(3.0)
    write_table(inputs / "d.csv", t, {"x": np.array([low, high, high + 0.1 * (high - low)])}, "m")
    command = ("compensate", str(inputs / "m.json"), str(inputs / "d.csv"), "--voltage-max", "20", "-o")
    assert main((*command, str(folder / "nowhere" / "v.csv"))) == 1
    assert capsys.readouterr().err.count("\n") == 1
    assert main((*command, str(folder / "v.csv"))) == 0
    assert "axis 'x'" in capsys.readouterr().err
