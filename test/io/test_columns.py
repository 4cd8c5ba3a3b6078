"""Units and roles of columns, however a program wrote their names; nothing is scaled by a guess in silence."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from refusals import holds, refusal

from slpi_ros.errors import RecordError, SlpiError, UsageError
from slpi_ros.io.columns import DISPLACEMENT, TIME, VOLTAGE, ColumnOptions, parse_column
from slpi_ros.io.tables import import_table, import_with_summary

UNITS = {
    TIME: {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0},
    VOLTAGE: {"V": 1.0, "mV": 1e-3, "kV": 1e3},
    DISPLACEMENT: {"m": 1.0, "mm": 1e-3, "um": 1e-6, "µm": 1e-6, "μm": 1e-6, "nm": 1e-9, "pm": 1e-12},
}
EVERY_UNIT = [(quantity, unit, scale) for quantity, units in UNITS.items() for unit, scale in units.items()]
NOTATIONS = ("{}_{}", "{} ({})", "{}({})", "{} [{}]", "{}[{}]", "{} in {}", "{}_in_{}", "{} / {}", "{}, {}", "{} {}")


@pytest.fixture
def table(tmp_path):
    """Return a function that writes lines to a file and returns its path."""

    def write(*lines: str):
        path = tmp_path / "table.csv"
        path.write_text("\n".join([*lines, ""]), encoding="utf-8")
        return path

    return write


@given(st.sampled_from(EVERY_UNIT), st.sampled_from(NOTATIONS), st.sampled_from(["", " X", "_tilt"]), st.booleans())
def test_a_unit_is_read_in_every_notation(known, notation, axis, capital):
    quantity, unit, scale = known
    word = quantity.name.capitalize() if capital else quantity.name
    column = parse_column(notation.format(f"{word}{axis}", unit), quantity)
    assert (column.scale, column.assumed, column.axis) == (scale, False, axis.strip(" _") or "x")


@pytest.mark.parametrize(
    ("name", "quantity", "unit", "axis"),
    [
        ("POSITION_UM", DISPLACEMENT, "um", "x"),
        ("POSITION X [NM]", DISPLACEMENT, "nm", "X"),
        ("voltage_v", VOLTAGE, "V", "x"),
        ("Voltage (kv)", VOLTAGE, "kV", "x"),
        ("TIME_MS", TIME, "ms", "x"),
        ("Time (sec)", TIME, "s", "x"),
        ("Time (Minutes)", TIME, "min", "x"),
        ("voltage in volts", VOLTAGE, "V", "x"),
        ("Position (microns)", DISPLACEMENT, "um", "x"),
        ("x (mm)", DISPLACEMENT, "mm", "x"),
        ("Position (nm) filtered", DISPLACEMENT, "nm", "filtered"),
        ("displacement_nm_x", DISPLACEMENT, "nm", "x"),
        ("displacement_nm(:,2)", DISPLACEMENT, "nm", "(:,2)"),
        ("Displacement y (X) [nm]", DISPLACEMENT, "nm", "y (X)"),
    ],
)
def test_names_as_programs_write_them(name, quantity, unit, axis):
    column = parse_column(name, quantity)
    assert (column.unit, column.axis, column.assumed) == (unit, axis, False)


@pytest.mark.parametrize(
    ("name", "quantity", "axis"),
    [
        ("displacement", DISPLACEMENT, "x"),
        ("displacement_tilt", DISPLACEMENT, "tilt"),
        ("displacement_s", DISPLACEMENT, "s"),
        ("voltage_in", VOLTAGE, "in"),
        ("voltage_m", VOLTAGE, "m"),
        ("y(:,1)", DISPLACEMENT, "y(:,1)"),
        ("Position ()", DISPLACEMENT, "x"),
        ("time", TIME, "x"),
    ],
)
def test_a_name_without_a_unit(name, quantity, axis):
    column = parse_column(name, quantity)
    assert (column.unit, column.assumed, column.axis) == (quantity.default, True, axis)


@pytest.mark.parametrize(
    ("name", "quantity", "unit"),
    [
        ("displacement_inch", DISPLACEMENT, "inch"),
        ("displacement (in)", DISPLACEMENT, "in"),
        ("displacement_in", DISPLACEMENT, "in"),
        ("displacement [Nm]", DISPLACEMENT, "Nm"),
        ("displacement_Mm", DISPLACEMENT, "Mm"),
        ("displacement_cm", DISPLACEMENT, "cm"),
        ("displacement in furlongs", DISPLACEMENT, "furlongs"),
        ("displacement / counts", DISPLACEMENT, "counts"),
        ("displacement (%)", DISPLACEMENT, "%"),
        ("voltage_V", DISPLACEMENT, "V"),
        ("voltage_MV", VOLTAGE, "MV"),
        ("voltage_uV", VOLTAGE, "uV"),
        ("voltage (nm)", VOLTAGE, "nm"),
        ("time (days)", TIME, "days"),
        ("time_m", TIME, "m"),
        ("time (mV)", TIME, "mV"),
    ],
)
def test_another_unit_is_refused(name, quantity, unit):
    message = refusal(RecordError, parse_column, name, quantity)
    assert holds(message, f"'{name}'", f"'{unit}'", quantity.name, *quantity.units)


@given(st.text(max_size=30), st.sampled_from([TIME, VOLTAGE, DISPLACEMENT]))
def test_any_name_is_read_or_refused(name, quantity):
    try:
        column = parse_column(name, quantity)
    except SlpiError:
        return
    assert column.unit in quantity.units and column.axis


HEADERS = [
    ("time (ms),voltage (mV),displacement [nm]", 1e-3, 2e-3, {"x": 3e-9}),
    ("time_s,voltage_V,displacement [nm]", 1.0, 2.0, {"x": 3e-9}),
    ("Time,Voltage (V),Position (µm)", 1.0, 2.0, {"x": 3e-6}),
    ("Time (s),Drive (V),x (mm)", 1.0, 2.0, {"x": 3e-3}),
    ("time_min,voltage_V,displacement in nm", 60.0, 2.0, {"x": 3e-9}),
    ("TIME_S,X_V,X_UM", 1.0, 2.0, {"X": 3e-6}),
    ("t (s),Voltage,Position x [mm],Position y [nm]", 1.0, 2.0, {"x": 3e-3, "y": 4e-9}),
    ("Timestamp,Time (ms),Voltage,Position", 2e-3, 3.0, {"x": 4e-6}),
]


@pytest.mark.parametrize(("header", "step", "volts", "metres"), HEADERS)
def test_headers_of_other_programs(table, header, step, volts, metres):
    rows = [[row * number for number in (1, 2, 3, 4)] for row in (1, 2)]
    lines = [",".join(map(str, row[: header.count(",") + 1])) for row in rows]
    record = import_table(table(header, *lines))
    assert (record.time_ns[1] - record.time_ns[0]) * 1e-9 == pytest.approx(step)
    assert {axis: values[0] for axis, values in record.displacement.items()} == pytest.approx(metres)
    assert {axis: values[0] for axis, values in record.voltage.items()} == pytest.approx(dict.fromkeys(metres, volts))


def test_columns_are_named_without_regard_to_case(table):
    path = table("When,DRIVE,Sensor (nm),drive2", "0,1,2,3", "1,1,2,3")
    record = import_table(path, time="when", voltage=["drive"], displacement=["sensor (NM)"])
    assert record.displacement["Sensor"].tolist() == pytest.approx([2e-9, 2e-9])
    path = table("t_s,V,v,y_um", "0,1,2,3", "1,1,2,3")
    assert import_table(path, voltage=["v"], displacement=["y_um"]).voltage["y"].tolist() == [2, 2]


def test_the_option_must_not_contradict_the_name(table):
    path = table("time_s,voltage_V,displacement_um", "0,1,2", "1,1,2")
    assert import_table(path, displacement_unit="um").displacement["x"][0] == pytest.approx(2e-6)
    message = refusal(UsageError, import_table, path, displacement_unit="nm")
    assert holds(message, path, "'displacement_um'", "um", "--displacement-unit", "nm")
    refusal(UsageError, import_table, table("time,voltage,x_mm", "0,1,2"), displacement=["x_mm"], displacement_unit="m")


def test_a_column_has_one_role(table):
    path = table("time_s,voltage_V,drive,displacement_um", "0,1,2,3", "1,1,2,3")
    for options in (
        {"voltage": ["drive"], "displacement": ["drive"]},
        {"voltage": ["drive"], "displacement": ["DRIVE"]},
        {"time": "drive", "voltage": ["drive"]},
        {"displacement": ["drive", "drive"], "axes": ["x", "y"]},
    ):
        assert holds(refusal(UsageError, import_table, path, **options), path, "'drive'")
    message = refusal(RecordError, import_table, path, displacement=["voltage_V"])
    assert holds(message, "'voltage_V'", "'V'", "displacement")
    # One amplifier may drive several axes.
    path = table("time_s,drive,displacement_x_um,displacement_y_um", "0,1,2,3", "1,1,2,3")
    assert import_table(path, voltage=["drive", "drive"]).voltage["y"].tolist() == [1, 1]


def test_an_import_tells_columns_units_and_ranges(table):
    path = table("time_ms,voltage_mV,displacement_nm", "0,0,-500", "1,100000,19800", "2,5,")
    assert import_with_summary(path, ColumnOptions()).summary == (
        "time: column 'time_ms' in ms",
        "axis x: voltage_mV 0 to 100 V, displacement_nm -0.5 to 19.8 µm",
    )
    path = table("Time,Voltage,x_V,Position,displacement_y_um", "0,1,2,3,4", "1,5,6,7,8")
    options = ColumnOptions(voltage=("Voltage", "x_V"), displacement=("position", "displacement_y_um"))
    lines = import_with_summary(path, options).summary
    assert lines == (
        "time: column 'Time' taken as s",
        "axis x: Voltage 1 to 5 V (unit assumed), Position 3 to 7 µm (unit assumed)",
        "axis y: x_V 2 to 6 V, displacement_y_um 4 to 8 µm",
    )
    path = table("time_s,voltage_V,displacement", "0,1,", "1,5,nan")
    lines = import_with_summary(path, ColumnOptions(displacement_unit="nm")).summary
    assert lines[1:] == ("axis x: voltage_V 1 to 5 V, displacement without a value",)


@pytest.mark.parametrize(
    "name",
    ["desired_um", "desired_x_um", "x_desired (um)", "Desired displacement x [um]", "displacement_desired_um",
     "Setpoint_um", "x set point / um", "DESIRED"],
)  # fmt: skip
def test_a_column_of_desired_displacements_is_recognised(table, name):
    read = import_with_summary(table(f"time_s,voltage_V,x_um,{name}", "0,1,2,3", "1,1,2,"), ColumnOptions())
    assert list(read.record.axes) == ["x"] and read.record.displacement["x"] == pytest.approx([2e-6, 2e-6])
    assert read.desired["x"] == pytest.approx([3e-6, np.nan], nan_ok=True)
    assert f"desired {name} 3 to 3 µm" in read.summary[1]


@pytest.mark.parametrize(
    "name", ["voltage_setpoint_V", "time_of_setpoint", "undesired_um", "setpoint_temperature", "desired_mrad", "note"]
)
def test_a_column_of_something_else_is_no_desired_displacement(table, name):
    columns = ColumnOptions(time="time_s", voltage=("voltage_V",))
    read = import_with_summary(table(f"time_s,voltage_V,x_um,{name}", "0,1,2,3", "1,1,2,3"), columns)
    assert not read.desired and list(read.record.axes) == ["x"]
    assert any("--desired" in line for line in read.summary) == (name in ("setpoint_temperature", "desired_mrad"))


def test_desired_displacements_of_several_axes(table):
    path = table("time_s,voltage_V,x_um,y_um,y_desired_nm,b,a", "0,1,2,3,4,5,6", "1,1,2,3,4,5,6")

    def read(**options):
        return import_with_summary(path, ColumnOptions(displacement=("x_um", "y_um"), **options)).desired

    assert read()["y"][0] == pytest.approx(4e-9) and list(read(axes=("u", "v"))) == ["v"]
    found = read(desired=("a", "b"))
    assert (found["x"][0], found["y"][0]) == (pytest.approx(6e-6), pytest.approx(5e-6))
    assert holds(refusal(RecordError, read, desired=("a",)), path, "--desired")
    assert holds(refusal(UsageError, read, desired=("x_um", "y_um")), path, "'x_um'")
    path = table("time_s,voltage_V,x_um,desired_um,setpoint_um", "0,1,2,3,4", "1,1,2,3,4")
    assert holds(refusal(RecordError, import_with_summary, path, ColumnOptions()), path, "setpoint_um", "--desired")
    assert import_with_summary(path, ColumnOptions(desired=("setpoint_um",))).desired["x"][0] == pytest.approx(4e-6)
