"""The command line as a user meets it: real processes, real files."""

import json
import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from forked import completed
from identification.records import calibration, stage
from refusals import holds

import slpi_ros
from slpi_ros.cli import MOST_LINES
from slpi_ros.effects.surroundings import Quantity, Surroundings
from slpi_ros.excitation.drives import calibration_drive
from slpi_ros.io.bag_writer import write_bag
from slpi_ros.io.tables import read_table, write_table

pytestmark = pytest.mark.slow


def slpi(*arguments):
    return completed("slpi_ros.cli:main", [*map(str, arguments)])


def assert_in_form(text):
    """Check that a verdict comes first, few lines follow, and a command comes last."""
    first, *lines, last = text.splitlines()
    assert (
        first.startswith(("GOOD: ", "ERROR SOURCES: ")) and len(lines) <= MOST_LINES and last.startswith("next: slpi ")
    )


def one_line(result, code):
    """Check that a command failed properly, and return what it said."""
    lines = result.stderr.splitlines()
    assert result.returncode == code and len(lines) == 1 and lines[0].startswith("slpi"), result
    assert "Traceback" not in result.stderr
    return lines[0]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A bag, a model of it, and tables to convert."""
    folder = tmp_path_factory.mktemp("cli")
    record, _ = calibration(seed=1)
    write_bag(folder / "bag", record)
    slpi_ros.save_model(slpi_ros.identify(record, "pi"), folder / "pi.json")
    t = np.arange(200) / 100
    write_table(folder / "voltage.csv", t, {"x": 50 - 40 * np.cos(3 * t)}, "V")
    write_table(folder / "desired.csv", t, {"x": 1e-6 * (12 - 5 * np.cos(3 * t))}, "m")
    return folder


def test_from_table_to_bag_to_model_to_voltages(folder, tmp_path):
    record = slpi_ros.read_bag(folder / "bag")
    rows = np.column_stack([record.t, record.voltage["x"], record.displacement["x"] * 1e6])
    header = "time_s,voltage_V,displacement_um"
    np.savetxt(tmp_path / "data.csv", rows, delimiter=",", header=header, comments="", fmt="%.12g")
    for storage in ("mcap", "sqlite3"):
        options = ("--storage", storage, "--hardware-id", "s1")
        done = slpi("import", tmp_path / "data.csv", "-o", tmp_path / storage, *options)
        assert done.returncode == 0 and holds(done.stdout, 4001, "x")
    found = slpi("identify", tmp_path / "mcap", "-o", tmp_path / "model.json", "--report", tmp_path / "report")
    assert found.returncode == 0 and "slpi" in found.stdout
    assert (tmp_path / "report" / "report.html").read_text().startswith("<!doctype html>")
    shown = slpi("show", tmp_path / "model.json")
    assert_in_form(found.stdout)
    lines = shown.stdout.splitlines()
    # The verdict on the model and its lines are the same, but for its uncertainty.
    (own,) = [line for line in lines if "expanded uncertainty" in line]
    assert found.stdout.splitlines()[0] == lines[0] and set(lines[1:-2]) - {own} <= set(found.stdout.splitlines())
    assert "'s1'" in shown.stdout and "µm" in shown.stdout
    everything = slpi("show", tmp_path / "model.json", "-v").stdout.splitlines()
    assert len(everything) > len(lines) and set(lines[1:-2]) <= set(everything)
    assert json.loads(slpi("show", tmp_path / "model.json", "--json").stdout) == json.loads(
        (tmp_path / "model.json").read_text()
    )
    # `simulate` starts where the record did.
    asked = slpi("compensate", tmp_path / "model.json", folder / "desired.csv", "-o", tmp_path / "v.csv",
                 "--start-memory", "start")  # fmt: skip
    assert (
        asked.returncode == 0 and not asked.stderr and asked.stdout.splitlines()[-1].startswith("next: slpi simulate ")
    )
    assert slpi("simulate", tmp_path / "model.json", tmp_path / "v.csv", "-o", tmp_path / "y.csv").returncode == 0
    t, reached = read_table(tmp_path / "y.csv", "m")
    t_wished, wished = read_table(folder / "desired.csv", "m")
    np.testing.assert_array_equal(t, t_wished)
    np.testing.assert_allclose(reached["x"], wished["x"], rtol=0, atol=1e-9 * np.ptp(wished["x"]))


SETUP = Path(__file__).resolve().parents[1] / "setup.py"
COMMANDS = ("import", "excite", "identify", "refit", "diagnose", "simulate", "compensate", "show", "experiments")


def test_excite_identify_refit(tmp_path):
    done = slpi("excite", "-o", tmp_path / "drive.csv", "--voltage-min", 0, "--voltage-max", 100, "--rate", 100)
    assert done.returncode == 0 and holds(done.stdout, 3001, "30 s")
    t, v = read_table(tmp_path / "drive.csv", "V")
    for name, offset in (("first", 0.0), ("second", 1e-9)):
        y = stage(1).run(t, v["x"])[1] + offset
        stamps = np.round(t * 1e9).astype(np.int64)
        write_bag(tmp_path / name, slpi_ros.Record(stamps, v, {"x": y}))
    assert slpi("identify", tmp_path / "first", "-o", tmp_path / "m.json", "--kind", "pi").returncode == 0
    done = slpi("refit", tmp_path / "m.json", tmp_path / "second", "-o", tmp_path / "m.json")
    assert done.returncode == 0
    assert_in_form(done.stdout)
    assert [line.split()[:2] for line in done.stdout.splitlines()[1:-1]] == [["axis", "x:"]] * 2
    found = slpi(
        "refit", tmp_path / "m.json", tmp_path / "second", "-o", tmp_path / "n.json", "--axis", "x", "--start", 2,
        "--stop", 28, "--report", tmp_path / "page", "--json",
    )  # fmt: skip
    (record,) = json.loads(found.stdout)["records"]
    assert found.returncode == 0 and record["axes"].keys() == {"x"} and record["axes"]["x"]["error_after_rms_m"] < 1e-6
    samples = [slpi_ros.load_model(tmp_path / name).axes["x"].quality.samples for name in ("m.json", "n.json")]
    assert 0 < samples[1] - samples[0] < 26.1 * 100
    assert (tmp_path / "page" / "report.html").exists()
    assert one_line(
        slpi("refit", tmp_path / "m.json", tmp_path / "second", "-o", tmp_path / "n.json", "--axis", "q"), 2
    )


def test_a_drive_for_a_path_goes_along_its_voltages(folder, tmp_path):
    options = ("excite", "--voltage-min", 0, "--voltage-max", 100, "--for-path", folder / "desired.csv")
    done = slpi(*options, "-o", tmp_path / "own.csv", "--model", folder / "pi.json")
    assert (done.returncode, done.stderr) == (0, "")
    t, desired = read_table(folder / "desired.csv", "m")
    v = slpi_ros.load_model(folder / "pi.json").compensate(t, desired["x"])
    t_drive, drive = read_table(tmp_path / "own.csv", "V")
    along = np.interp(np.arange(0.0, t[-1], t_drive[1]), t, v)
    windows = np.lib.stride_tricks.sliding_window_view(drive["x"], along.size)
    assert np.abs(windows - along).max(axis=1).min() < 1e-6
    # Without a model it goes over the whole range; what the slew limit does not allow is told.
    whole = slpi(*options, "-o", tmp_path / "whole.csv", "--slew-limit", 80)
    assert whole.returncode == 0 and "V/s" in whole.stderr and "--model" in whole.stderr
    assert one_line(slpi("excite", *options[1:5], "-o", tmp_path / "no.csv", "--model", folder / "pi.json"), 2)


def test_a_refit_takes_several_bags_in_the_order_of_their_records(tmp_path):
    t, v = calibration_drive(0.0, 100.0, duration=30.0, rate=100.0, seed=2)
    for number, gain in enumerate((1.0, 1.01, 1.03)):
        y = gain * stage(2).run(t, v)[1]
        stamps = np.round(t * 1e9).astype(np.int64) + number * 10**12
        write_bag(tmp_path / f"bag{number}", slpi_ros.Record(stamps, {"x": v}, {"x": y}))
    model, bags = tmp_path / "m.json", [tmp_path / "bag1", tmp_path / "bag2"]
    assert slpi("identify", tmp_path / "bag0", "-o", model, "--kind", "pi").returncode == 0
    step, both = tmp_path / "step.json", tmp_path / "both.json"
    assert slpi("refit", model, bags[0], "-o", step).returncode == 0
    assert slpi("refit", step, bags[1], "-o", step).returncode == 0
    done = slpi("refit", model, *reversed(bags), "-o", both)
    assert done.returncode == 0
    assert [line.split(": ")[:2] for line in done.stdout.splitlines()[1:-1]] == [
        [str(bag), "axis x"] for bag in bags for _ in range(2)
    ]
    at_once, in_steps = (json.loads(path.read_text())["axes"] for path in (both, step))
    assert at_once == in_steps
    assert one_line(slpi("refit", model, bags[0], bags[0], "-o", both), 2)


def test_help_tells_every_command():
    text = slpi("--help").stdout
    assert all(command in text for command in COMMANDS)
    bare = slpi()
    assert one_line(bare, 2) and bare.stdout == text


def test_the_version_is_that_of_the_package():
    command = [sys.executable, "-m", "slpi_ros.cli", "--version"]
    told = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert (told.returncode, told.stderr) == (0, "")
    assert told.stdout == f"slpi {re.search(r'version=.([0-9.]+)', SETUP.read_text())[1]}\n"


def test_a_first_sample_that_jumps_is_told_and_a_slew_limit_kept(folder, tmp_path):
    start = slpi_ros.load_model(folder / "pi.json").axes["x"].initial("end")
    command = ("compensate", folder / "pi.json", folder / "desired.csv", "-o", tmp_path / "v.csv")
    jump = json.loads(slpi(*command, "--json").stdout)["axes"]["x"]["first_jump_V"]
    t, free = read_table(tmp_path / "v.csv", "V")
    assert jump == pytest.approx(free["x"][0] - start.voltage) and abs(jump) > 1.0
    assert holds(slpi(*command).stdout, f"{jump:+.4g} V", "--slew-limit")
    fastest = float(np.max(np.abs(np.diff(free["x"]) / np.diff(t))))
    for slew in (0.5 * fastest, 1e6):
        found = json.loads(slpi(*command, "--slew-limit", slew, "--json").stdout)["axes"]["x"]
        _, limited = read_table(tmp_path / "v.csv", "V")
        assert found["first_jump_V"] == 0.0 and limited["x"][0] == pytest.approx(start.voltage)
        assert np.max(np.abs(np.diff(limited["x"]) / np.diff(t))) <= slew * (1 + 1e-6)
        assert (found["slew_limited"] > 0) == (slew < fastest)
    # Where the limit does not hold it back, the voltage is that of the whole path.
    np.testing.assert_allclose(limited["x"][1:], free["x"][1:], atol=1e-6)
    assert one_line(slpi(*command, "--slew-limit", -1), 2)


def test_an_imported_path_is_judged(folder, tmp_path):
    record = slpi_ros.read_bag(folder / "bag")
    desired = slpi_ros.load_model(folder / "pi.json").simulate(record.t, record.voltage["x"]) - 3e-6
    rows = np.column_stack([record.t, record.voltage["x"], 1e6 * record.displacement["x"], 1e6 * desired])
    header = "time_s,voltage_V,displacement_um,desired_um"
    np.savetxt(tmp_path / "data.csv", rows, delimiter=",", header=header, comments="", fmt="%.12g")
    done = slpi("import", tmp_path / "data.csv", "-o", tmp_path / "b", "--json")
    assert json.loads(done.stdout)["desired"] == ["x"]
    found = slpi("verify", tmp_path / "b", "--model", folder / "pi.json", "--json")
    tracking = json.loads(found.stdout)["axes"]["x"]["records"][0]["tracking"]
    assert tracking["samples"] > 0.9 * len(record) and tracking["rms_m"] == pytest.approx(3e-6, rel=0.2)
    assert "path: measured - desired" in slpi("verify", tmp_path / "b", "--model", folder / "pi.json").stdout


def test_a_bag_of_the_identification_proves_nothing(folder, tmp_path):
    record = slpi_ros.read_bag(folder / "bag")
    write_bag(tmp_path / "02", record)
    # The calibrator names its bags by their place beside the model.
    model = slpi_ros.identify(replace(record, source="02"), "pi")
    slpi_ros.save_model(model, tmp_path / "model.json")
    for bag, own in ((tmp_path / "02", True), (folder / "bag", False)):
        done = slpi("verify", bag, "--model", tmp_path / "model.json")
        assert ("was identified from this bag" in done.stdout) == own


def test_an_import_tells_what_it_took_for_what(tmp_path):
    lines = ["Stage 7", "Zeit;Spannung;Weg [nm]", "0,0;0;-500", "0,5;100,5;19800"]
    (tmp_path / "d.csv").write_text("\n".join(lines), encoding="latin-1")
    columns = ("--time", "zeit", "--voltage", "spannung", "--displacement", "weg [nm]")
    done = slpi("import", tmp_path / "d.csv", "-o", tmp_path / "b", *columns)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.splitlines()[1:-1] == [
        "time: column 'Zeit' taken as s",
        "axis Weg: Spannung 0 to 100.5 V (unit assumed), Weg [nm] -0.5 to 19.8 µm",
    ]


def test_a_thousandth_of_the_unit_is_told_before_anything_else(folder, tmp_path):
    record = slpi_ros.read_bag(folder / "bag")
    rows = np.column_stack([record.t, record.voltage["x"], 1e6 * record.displacement["x"]])
    for unit, told in (("um", ""), ("nm", "check the columns and their units")):
        np.savetxt(tmp_path / "d.csv", rows, delimiter=",", header=f"time_s,x_V,x_{unit}", comments="", fmt="%.12g")
        done = slpi("import", tmp_path / "d.csv", "-o", tmp_path / unit)
        assert done.returncode == 0 and told in done.stderr and bool(told) == bool(done.stderr)
    model = ("--model", folder / "pi.json")
    last = slpi("verify", tmp_path / "nm", *model).stdout.splitlines()[-1]
    assert last == f"next: slpi doctor {tmp_path / 'nm'} --model {folder / 'pi.json'}"
    assert "check the unit" in slpi("doctor", tmp_path / "nm", *model, "--no-ros").stdout.splitlines()[-1]


@pytest.mark.parametrize("column", [1, 2])
def test_an_import_tells_of_a_column_that_stays_constant(tmp_path, column):
    rows = np.column_stack([np.arange(50) / 50, np.linspace(0, 100, 50), np.linspace(0, 10, 50)])
    rows[:, column] = 5.0
    np.savetxt(tmp_path / "d.csv", rows, delimiter=",", header="time_s,x_V,x_um", comments="")
    done = slpi("import", tmp_path / "d.csv", "-o", tmp_path / "b")
    assert done.returncode == 0 and ("voltage", "displacement")[column - 1] in done.stderr and "5" in done.stderr


def test_a_table_is_named_once_in_a_message(folder, tmp_path):
    path = another_axis(folder, tmp_path)[0][2]
    for command, suffix in (("compensate", "m"), ("simulate", "V")):
        write_table(path, np.arange(3.0), {"z": np.zeros(3)}, suffix)
        line = one_line(slpi(command, folder / "pi.json", path, "-o", tmp_path / "v.csv"), 1)
        assert line.startswith(f"slpi {command}: {path}: ") and "'z'" in line and line.count(str(path)) == 1


def test_unreachable_displacements_are_held_and_told(folder, tmp_path):
    t = np.arange(300) / 100
    top = slpi_ros.load_model(folder / "pi.json").axes["x"].displacement_range[1]
    desired = top * (0.6 - 0.5 * np.cos(2 * np.pi * t))
    write_table(tmp_path / "desired.csv", t, {"x": desired}, "m")
    done = slpi("compensate", folder / "pi.json", tmp_path / "desired.csv", "-o", tmp_path / "v.csv")
    assert done.returncode == 0 and "axis 'x'" in done.stderr and len(done.stderr.splitlines()) == 1
    assert f"to {1.1 * top * 1e6:.4g} µm" in done.stderr and "µm/s" not in done.stderr
    # A hundred times as fast.
    write_table(tmp_path / "desired.csv", t / 100, {"x": 0.8 * desired}, "m")
    done = slpi("compensate", folder / "pi.json", tmp_path / "desired.csv", "-o", tmp_path / "v.csv")
    assert done.returncode == 0 and "µm/s, the record" in done.stderr
    _, v = read_table(tmp_path / "v.csv", "V")
    assert v["x"].max() <= 100.0


def test_a_temperature_beyond_the_record_is_told(folder, tmp_path):
    model = slpi_ros.load_model(folder / "pi.json")
    warm = Quantity("/room/temperature", "", 21.0, 4e-7, 0.0, 0.0, lowest=20.0, highest=23.0)
    axis = replace(model.axes["x"], effects=(Surroundings((warm,)),))
    slpi_ros.save_model(replace(model, axes={"x": axis}), tmp_path / "warm.json")
    t, (low, high) = np.arange(200) / 100, axis.displacement_range
    beyond = "goes from 21 to 23.7, in the record of the model"
    for name, end, told in (("inside", 22.5, ""), ("beyond", 23.7, beyond), ("kelvin", 294.0, "unit")):
        rows = np.column_stack([t, low + (high - low) * np.linspace(0.4, 0.5, t.size), np.linspace(21.0, end, t.size)])
        lines = ["time_s,x_m,/room/temperature", *(",".join(map(repr, row)) for row in rows.tolist())]
        (tmp_path / f"{name}.csv").write_text("\n".join(lines))
        done = slpi("compensate", tmp_path / "warm.json", tmp_path / f"{name}.csv", "-o", tmp_path / f"{name}_v.csv")
        # What the compensator would not use is refused.
        assert done.returncode == (2 if name == "kelvin" else 0), done.stderr
        assert told in done.stderr and bool(done.stderr) == bool(told)
        assert (tmp_path / f"{name}_v.csv").exists() == (name != "kelvin")
    done = slpi("compensate", tmp_path / "warm.json", folder / "desired.csv", "-o", tmp_path / "v.csv")
    assert "/room/temperature is not known and taken as 21" in done.stderr


def test_voltage_limits_of_a_command(folder, tmp_path):
    limits = ("--voltage-min", "20", "--voltage-max", "60")
    done = slpi("compensate", folder / "pi.json", folder / "desired.csv", "-o", tmp_path / "v.csv", *limits)
    _, v = read_table(tmp_path / "v.csv", "V")
    assert done.returncode == 0 and v["x"].min() >= 20.0 and v["x"].max() <= 60.0


def truncated(folder, tmp_path):
    (tmp_path / "half.json").write_text((folder / "pi.json").read_text()[:300])
    return ("show", tmp_path / "half.json"), 1, "half.json"


def wrong_version(folder, tmp_path):
    document = json.loads((folder / "pi.json").read_text()) | {"schema": "slpi_ros/model/999"}
    (tmp_path / "new.json").write_text(json.dumps(document))
    return ("show", tmp_path / "new.json"), 1, "slpi_ros/model/999"


def retired_version(folder, tmp_path):
    document = json.loads((folder / "pi.json").read_text()) | {"schema": "slpi_ros/model/1"}
    (tmp_path / "old.json").write_text(json.dumps(document))
    return ("show", tmp_path / "old.json"), 1, "identify the stage again from its bags"


def binary_model(folder, tmp_path):
    (tmp_path / "binary.json").write_bytes(bytes(range(256)))
    return ("show", tmp_path / "binary.json"), 1, "binary.json"


def no_model(folder, tmp_path):
    return ("show", tmp_path / "absent.json"), 1, "absent.json"


def another_axis(folder, tmp_path):
    write_table(tmp_path / "y.csv", np.arange(3.0), {"z": np.zeros(3)}, "m")
    return ("compensate", folder / "pi.json", tmp_path / "y.csv", "-o", tmp_path / "v.csv"), 1, "'z'"


def far_command(folder, tmp_path):
    write_table(tmp_path / "y.csv", np.arange(3.0), {"x": np.array([0.0, 12.0, 0.0])}, "m")
    return ("compensate", folder / "pi.json", tmp_path / "y.csv", "-o", tmp_path / "v.csv"), 1, "sample 1"


def nan_command(folder, tmp_path):
    (tmp_path / "y.csv").write_text("time_s,x_m\n0,1e-6\n1,nan\n")
    return ("compensate", folder / "pi.json", tmp_path / "y.csv", "-o", tmp_path / "v.csv"), 1, "nan"


def backwards_command(folder, tmp_path):
    (tmp_path / "v.csv").write_text("time_s,x_V\n0,1\n2,3\n1,2\n")
    return ("simulate", folder / "pi.json", tmp_path / "v.csv", "-o", tmp_path / "y.csv"), 1, "time_s"


def no_bag(folder, tmp_path):
    return ("identify", tmp_path / "absent", "-o", tmp_path / "m.json"), 1, "absent"


def truncated_bag(folder, tmp_path):
    (tmp_path / "cut.mcap").write_bytes(next((folder / "bag").glob("*.mcap")).read_bytes()[:5000])
    return ("identify", tmp_path / "cut.mcap", "-o", tmp_path / "m.json"), 1, "cut.mcap"


def wrong_topic(folder, tmp_path):
    return ("identify", folder / "bag", "-o", tmp_path / "m.json", "--topic", "other"), 1, "stage_state"


def wrong_axis(folder, tmp_path):
    return ("identify", folder / "bag", "-o", tmp_path / "m.json", "--axis", "q"), 1, "q"


def empty_window(folder, tmp_path):
    return ("identify", folder / "bag", "-o", tmp_path / "m.json", "--start", "900"), 1, "bag"


def constant_voltage(folder, tmp_path):
    (tmp_path / "d.csv").write_text("time_s,voltage_V,displacement_um\n" + "".join(f"{k},5,{k}\n" for k in range(99)))
    assert slpi("import", tmp_path / "d.csv", "-o", tmp_path / "flat").returncode == 0
    return ("identify", tmp_path / "flat", "-o", tmp_path / "m.json"), 1, "5 V"


def no_such_column(folder, tmp_path):
    (tmp_path / "d.csv").write_text("time_s,voltage_V,displacement_um\n0,1,2\n1,2,3\n")
    return ("import", tmp_path / "d.csv", "-o", tmp_path / "b", "--voltage", "u"), 1, "u"


def unknown_unit(folder, tmp_path):
    (tmp_path / "d.csv").write_text("time_s,voltage_V,displacement_inch\n0,1,2\n1,2,3\n")
    return ("import", tmp_path / "d.csv", "-o", tmp_path / "b"), 1, "'inch'"


def contradicted_unit(folder, tmp_path):
    (tmp_path / "d.csv").write_text("time_s,voltage_V,displacement_um\n0,1,2\n1,2,3\n")
    return ("import", tmp_path / "d.csv", "-o", tmp_path / "b", "--displacement-unit", "nm"), 2, "um"


def column_in_two_roles(folder, tmp_path):
    (tmp_path / "d.csv").write_text("time_s,drive,displacement_um\n0,1,2\n1,2,3\n")
    columns = ("--voltage", "drive", "--displacement", "drive")
    return ("import", tmp_path / "d.csv", "-o", tmp_path / "b", *columns), 2, "'drive'"


def compensate_over_its_table(folder, tmp_path):
    (tmp_path / "y.csv").write_text("time_s,x_m\n0,1e-6\n1,2e-6\n")
    return ("compensate", folder / "pi.json", tmp_path / "y.csv", "-o", tmp_path / "y.csv"), 2, "y.csv"


def compensate_over_its_model(folder, tmp_path):
    (tmp_path / "link.json").symlink_to(folder / "pi.json")
    return ("compensate", folder / "pi.json", folder / "desired.csv", "-o", tmp_path / "link.json"), 2, "link.json"


def simulate_over_its_table(folder, tmp_path):
    return ("simulate", folder / "pi.json", folder / "voltage.csv", "-o", folder / "voltage.csv"), 2, "voltage.csv"


def existing_bag(folder, tmp_path):
    (tmp_path / "d.csv").write_text("time_s,voltage_V,displacement_um\n0,1,2\n1,2,3\n")
    return ("import", tmp_path / "d.csv", "-o", folder / "bag"), 2, "bag"


def unwritable_model(folder, tmp_path):
    return ("identify", folder / "bag", "-o", tmp_path / "no" / "m.json", "--kind", "pi"), 1, "m.json"


def two_bags(folder, tmp_path):
    arguments = ("identify", folder / "bag", folder / "bag", "-o", tmp_path / "m.json", "--kind", "smpi")
    return arguments, 2, "bag"


def unknown_kind(folder, tmp_path):
    return ("identify", folder / "bag", "-o", tmp_path / "m.json", "--kind", "magic"), 2, "magic"


def unknown_command(folder, tmp_path):
    return ("frobnicate",), 2, "frobnicate"


def nothing(folder, tmp_path):
    return (), 2, "COMMAND"


CASES = (
    truncated, wrong_version, retired_version, binary_model, no_model, another_axis, far_command, nan_command,
    backwards_command, no_bag,
    truncated_bag, wrong_topic, wrong_axis, empty_window, constant_voltage, no_such_column, existing_bag,
    unknown_unit, contradicted_unit, column_in_two_roles, compensate_over_its_table, compensate_over_its_model,
    simulate_over_its_table,
    unwritable_model, two_bags, unknown_kind, unknown_command, nothing,
)  # fmt: skip


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.__name__)
def test_bad_input_is_told_in_one_line(folder, tmp_path, case):
    arguments, code, words = case(folder, tmp_path)
    assert holds(one_line(slpi(*arguments), code), words)


def test_the_doctor_checks_files_without_ros(folder, tmp_path):
    slpi_ros.save_model(slpi_ros.identify(slpi_ros.read_bag(folder / "bag")), tmp_path / "m.json")
    command = ("doctor", folder / "bag", "--model", tmp_path / "m.json", "--no-ros")
    well = slpi(*command, "--json")
    assert well.returncode == 0 and json.loads(well.stdout)["well"] and not well.stderr
    (tmp_path / "half.json").write_text((folder / "pi.json").read_text()[:300])
    for wrong in (("--voltage-min", 0, "--voltage-max", 40), ("--model", tmp_path / "half.json"), ("--topic", "other")):
        done = slpi(*command, *wrong)
        assert done.returncode == 1 and done.stdout.startswith("FAILED: ") and "\nfailed " in done.stdout
        *lines, last = done.stdout.splitlines()
        # What to do about the first fault, and no further look.
        assert last.removeprefix("next: ") in map(str.strip, lines) and "slpi doctor" not in last
        assert "\\n" not in done.stdout and not done.stderr
    for wrong in (("--voltage-min", 0), ("--voltage-min", 5, "--voltage-max", 5), ("--seconds", 0)):
        assert one_line(slpi(*command, *wrong), 2)


@pytest.mark.parametrize(("line", "wanted"), [("slpi ver", "verify"), ("slpi show --ver", "--verbose")])
def test_the_shell_is_told_completions(line, wanted, tmp_path):
    pytest.importorskip("argcomplete")
    asked = {"_ARGCOMPLETE": "1", "COMP_LINE": line, "COMP_POINT": str(len(line)), "_ARGCOMPLETE_IFS": "\n",
             "_ARGCOMPLETE_STDOUT_FILENAME": str(tmp_path / "told")}  # fmt: skip
    command = [sys.executable, "-m", "slpi_ros.cli"]
    subprocess.run(command, env=os.environ | asked, capture_output=True, check=True, timeout=120)
    assert wanted in (tmp_path / "told").read_text()


@pytest.mark.long
def test_what_is_known_of_the_sensor_is_kept_used_and_said(folder, tmp_path):
    record = slpi_ros.read_bag(folder / "bag")
    # Four samples late.
    late = {"x": np.append(np.repeat(record.displacement["x"][0], 4), record.displacement["x"][:-4])}
    write_bag(tmp_path / "late", replace(record, displacement=late))
    done = slpi("identify", tmp_path / "late", "-o", tmp_path / "model.json", "--sensor-delay", "0.02")
    assert done.returncode == 0 and not done.stderr and "warn" not in done.stdout
    shown = slpi("show", tmp_path / "model.json").stdout
    assert any(holds(line, "sensor", 20, 0) for line in shown.splitlines() if "axis x: sensor:" in line)
    model = slpi_ros.load_model(tmp_path / "model.json")
    assert (model.axes["x"].sensor.delay, model.axes["x"].sensor.lag) == (0.02, 0.0)
    verify = ("verify", tmp_path / "late", "--model", tmp_path / "model.json")
    silent, same = slpi(*verify), slpi(*verify, "--sensor-delay", "0.02")
    # The model was identified from it: a small error proves nothing, but it is small.
    assert silent.returncode == same.returncode == 1 and not silent.stderr and not same.stderr
    assert silent.stdout == same.stdout and "unproved" in silent.stdout.splitlines()[0]
    refit = ("refit", tmp_path / "model.json", tmp_path / "late", "-o", tmp_path / "new.json")
    diagnose = ("diagnose", tmp_path / "late", "--model", tmp_path / "model.json", "-o", tmp_path / "diagnosis")
    for command, code in ((verify, 1), (refit, 0), (diagnose, 0)):
        other = slpi(*command, "--sensor-lag=0.001", "--sensor-delay=0")
        assert holds(one_line(other, code), "'x'", 20, 0, 1)
    assert slpi_ros.load_model(tmp_path / "new.json").axes["x"].sensor.lag == 0.001
    assert "--sensor-lag=0.001" in slpi(*verify, "--sensor-lag=0.001", "--sensor-delay=0").stdout.splitlines()[-1]
