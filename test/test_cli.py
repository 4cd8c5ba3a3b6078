"""The command line as a user meets it: real processes, real files."""

import json
import subprocess
import sys

import numpy as np
import pytest
from identification.records import calibration, stage
from refusals import holds

import slpi_ros
from slpi_ros.io.bag_writer import write_bag
from slpi_ros.io.tables import read_table, write_table

pytestmark = pytest.mark.slow


def slpi(*arguments):
    command = [sys.executable, "-m", "slpi_ros.cli", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120)


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
    # What the record is good for comes first.
    assert found.stdout.startswith("axis x: ") and found.stdout.endswith(shown.stdout)
    assert "'s1'" in shown.stdout
    # `simulate` starts where the record did.
    asked = slpi("compensate", tmp_path / "model.json", folder / "desired.csv", "-o", tmp_path / "v.csv",
                 "--start-memory", "start")  # fmt: skip
    assert asked.returncode == 0 and len(asked.stdout.splitlines()) == 1
    assert slpi("simulate", tmp_path / "model.json", tmp_path / "v.csv", "-o", tmp_path / "y.csv").returncode == 0
    t, reached = read_table(tmp_path / "y.csv", "m")
    t_wished, wished = read_table(folder / "desired.csv", "m")
    np.testing.assert_array_equal(t, t_wished)
    np.testing.assert_allclose(reached["x"], wished["x"], rtol=0, atol=1e-9 * np.ptp(wished["x"]))


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
    assert done.returncode == 0 and [line.split()[:2] for line in done.stdout.splitlines()] == [["axis", "x:"]] * 2


def test_help_tells_every_command():
    text = slpi("--help").stdout
    assert all(command in text for command in COMMANDS)


def test_an_import_tells_what_it_took_for_what(tmp_path):
    lines = ["Stage 7", "Zeit;Spannung;Weg [nm]", "0,0;0;-500", "0,5;100,5;19800"]
    (tmp_path / "d.csv").write_text("\n".join(lines), encoding="latin-1")
    columns = ("--time", "zeit", "--voltage", "spannung", "--displacement", "weg [nm]")
    done = slpi("import", tmp_path / "d.csv", "-o", tmp_path / "b", *columns)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.splitlines()[1:] == [
        "time: column 'Zeit' taken as s",
        "axis Weg: Spannung 0 to 100.5 V (unit assumed), Weg [nm] -0.5 to 19.8 um",
    ]


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
    _, v = read_table(tmp_path / "v.csv", "V")
    assert v["x"].max() <= 100.0


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
    return ("import", tmp_path / "d.csv", "-o", folder / "bag"), 1, "bag"


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
    truncated, wrong_version, binary_model, no_model, another_axis, far_command, nan_command, backwards_command, no_bag,
    truncated_bag, wrong_topic, wrong_axis, empty_window, constant_voltage, no_such_column, existing_bag,
    unknown_unit, contradicted_unit, column_in_two_roles, compensate_over_its_table, compensate_over_its_model,
    simulate_over_its_table,
    unwritable_model, two_bags, unknown_kind, unknown_command, nothing,
)  # fmt: skip


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.__name__)
def test_bad_input_is_told_in_one_line(folder, tmp_path, case):
    arguments, code, words = case(folder, tmp_path)
    assert holds(one_line(slpi(*arguments), code), words)
