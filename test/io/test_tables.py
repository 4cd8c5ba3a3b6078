"""Tables: measured data of any source, and command tables whose round trip is exact."""

import errno
import os
from contextlib import suppress

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from refusals import holds, refusal
from scipy.io import savemat

from slpi_ros.errors import RecordError, SlpiError, UsageError
from slpi_ros.io.bag_reader import read_bag
from slpi_ros.io.bag_writer import write_bag
from slpi_ros.io.tables import import_table, read_table, write_table

MEASURED = {
    "afm_double_sine_x": (3531, ("x",), 1.2, 150.0, 20.0e-6),
    "afm_triangle_sine": (4824, ("x", "y", "z"), 1.2, 150.0, 20.0e-6),
    "picma_1hz_decay_grow": (14155, ("x",), 0.005, 3.5, 46.0e-6),
    "picma_1hz_major": (8027, ("x",), 0.005, 3.6, 49.7e-6),
    "piezo_150v_1hz": (50001, ("x",), 0.0002, 150.0, 39.5e-6),
}


@pytest.fixture
def table(tmp_path):
    """Return a function that writes lines to a file and returns its path."""

    def write(*lines: str, encoding: str = "utf-8"):
        path = tmp_path / "table.csv"
        path.write_bytes("\n".join([*lines, ""]).encode(encoding))
        return path

    return write


@pytest.mark.parametrize("name", MEASURED)
def test_measured_record(measured_data, name, tmp_path):
    samples, axes, period, top, stroke = MEASURED[name]
    record = import_table(measured_data / f"{name}.csv")
    assert (len(record), record.axes) == (samples, axes)
    assert np.median(np.diff(record.time_ns)) == pytest.approx(period * 1e9, rel=0.01)
    for axis in axes:
        assert record.voltage[axis].max() == pytest.approx(top, rel=0.01)
        assert np.nanmax(record.displacement[axis]) - np.nanmin(record.displacement[axis]) == pytest.approx(
            stroke, rel=0.2
        )
    write_bag(tmp_path / "bag", record)
    read = read_bag(tmp_path / "bag")
    np.testing.assert_array_equal(read.time_ns, record.time_ns)
    for axis in axes:
        np.testing.assert_array_equal(read.voltage[axis], record.voltage[axis])
        np.testing.assert_array_equal(read.displacement[axis], record.displacement[axis])


def test_drop_outs_of_a_measured_record(measured_data):
    record = import_table(measured_data / "afm_triangle_sine.csv")
    assert [int(np.isnan(record.displacement[axis]).sum()) for axis in "xyz"] == [0, 37, 71]
    assert all(np.isfinite(voltage).all() for voltage in record.voltage.values())


@pytest.mark.parametrize(
    ("header", "displacement"),
    [
        ("time_s,voltage_V,displacement_um", {"x": 3e-6}),
        ("time_s,voltage_V,displacement_nm", {"x": 3e-9}),
        ("time_s,voltage_V,displacement", {"x": 3e-6}),
        ("time_s,voltage_V,displacement_x_mm,displacement_tilt_m", {"x": 3e-3, "tilt": 4.0}),
        ("time_s,x_V,x_m", {"x": 3.0}),
        ("time_s,x_V,x_um,noise_um", {"x": 3e-6}),
        ("time_s,voltage,desired_um,displacement_um", {"x": 4e-6}),
    ],
)
def test_columns_speak_for_themselves(table, header, displacement):
    width = header.count(",") + 1
    record = import_table(table(header, *[f"{row}," + ",".join("234"[: width - 1]) for row in range(3)]))
    assert record.time_ns.tolist() == [0, 1_000_000_000, 2_000_000_000]
    assert {axis: values[0] for axis, values in record.displacement.items()} == pytest.approx(displacement)
    assert {axis: values[0] for axis, values in record.voltage.items()} == dict.fromkeys(displacement, 2.0)


@pytest.mark.parametrize(("column", "scale"), [("time_ms", 1e6), ("timestamp", 1e9), ("time_us", 1e3)])
def test_unit_of_time(table, column, scale):
    record = import_table(table(f"other,{column},voltage_mV,displacement_um", "0,1,2000,3", "0,2,2000,3"))
    assert record.time_ns.tolist() == [scale, 2 * scale]
    assert record.voltage["x"].tolist() == [2.0, 2.0]


def test_voltages_go_to_the_axis_they_name(table):
    path = table("time_s,y_V,x_V,displacement_x_um,displacement_y_um", "0,20,10,1,2", "1,20,10,1,2")
    record = import_table(path)
    assert (record.voltage["x"][0], record.voltage["y"][0]) == (10, 20)
    columns = ["displacement_x_um", "displacement_y_um"]
    record = import_table(path, voltage=["y_V", "x_V"], displacement=columns, axes=["a", "b"])
    assert (record.voltage["a"][0], record.voltage["b"][0]) == (20, 10)


def test_columns_and_unit_by_option(table):
    path = table("when,drive,sensor,spare", "0.5,1,7,", "0.75,2,8,text")
    record = import_table(path, time="when", voltage=["drive"], displacement=["sensor"], displacement_unit="nm")
    assert record.axes == ("sensor",)
    assert record.time_ns.tolist() == [500_000_000, 750_000_000]
    assert record.displacement["sensor"].tolist() == pytest.approx([7e-9, 8e-9])
    assert holds(refusal(UsageError, import_table, path, displacement_unit="inch"), "'inch'", "um", "nm")
    options = {"time": "when", "voltage": ["drive"], "displacement": ["sensor"], "axes": ["x", "y"]}
    assert holds(refusal(UsageError, import_table, path, **options), path, 2, "sensor")


def test_empty_cells_are_nan(table):
    record = import_table(table("time_s,voltage_V,displacement_um", "0,1,", "1,,2", "2,3,nan", "", "3,4, 5 "))
    np.testing.assert_allclose(record.displacement["x"], [np.nan, 2e-6, np.nan, 5e-6])
    np.testing.assert_array_equal(record.voltage["x"], [1, np.nan, 3, 4])


def test_time_before_zero_is_shifted(table):
    path = table("time_s,voltage_V,displacement_um", "-0.25,0,0", "0,0,0", "0.5,0,0")
    assert import_table(path).time_ns.tolist() == [0, 250_000_000, 750_000_000]


@pytest.mark.parametrize("mark", ["\ufeff", ""])
@pytest.mark.parametrize("end", ["\r\n", "\n"])
def test_as_spreadsheets_write_it(tmp_path, mark, end):
    path = tmp_path / "table.csv"
    lines = ['"time_s", voltage_V,"displacement_um"', '"0","1",2', "1,1,2", ""]
    path.write_bytes((mark + end.join(lines)).encode())
    assert import_table(path).displacement["x"].tolist() == pytest.approx([2e-6, 2e-6])


@pytest.mark.parametrize(
    ("lines", "data"),
    [
        (["time_s,voltage_V,displacement_um", "0,1,2", "1,1,2 um"], ("line 3", "'displacement_um'", "'2 um'")),
        (["time_s,voltage_V,displacement_um", "0,1,2", "", "1,x,2"], ("line 4", "'voltage_V'", "'x'")),
        (["time_s,voltage_V,displacement_um", "0,1,2", "1,1"], ("line 3", 2, 3)),
        (["time_s,voltage_V,displacement_um", "0,5,1,5,2,5", "1,5,1,5,2,5"], ("line 2", 6, 3)),
        (["time_s,voltage_V,displacement_um", "0,1,2"], ("1 rows",)),
        (["time_s,voltage_V,displacement_um"], ("0 rows",)),
        (["time_s,voltage_V,displacement_um", "0,1,2", ",1,2"], ("line 3", "'time_s'", "nan")),
        (["time_s,voltage_V,displacement_um", "0,1,2", "inf,1,2"], ("line 3", "'time_s'", "inf")),
        (["time_s,voltage_V,displacement_um", "0,1,2", "3e9,1,2"], ("line 3", 3000000000, "2^31 s")),
        (["time_s,voltage_V,displacement_um", "0,1,2", "2,1,2", "1,1,2"], ("line 4", "'time_s'", 1)),
        (["when,voltage_V,displacement_um", "0,1,2", "1,1,2"], ("--time", "when, voltage_V, displacement_um")),
        (["time_s,displacement_um", "0,1", "1,1"], ("--voltage", "time_s, displacement_um")),
        (["time_s,voltage_V,desired_um", "0,1,2", "1,1,2"], ("--displacement", "time_s, voltage_V, desired_um")),
        (["time_s!voltage_V!displacement_um", "0!1!2", "1!1!2"], ("comma", "semicolon", "tab", "--names")),
        (["time_s,voltage_V,voltage_V,displacement_um", "0,1,2,3", "1,1,2,3"], (2, "--voltage")),
        (["time_s,voltage_V,displacement_um,displacement_um", "0,1,2,3", "1,1,2,3"], ("x, x", "--displacement")),
        (["time_s,time_s,voltage_V,displacement_um", "0,1,2,3", "1,1,2,3"], ("'time_s'", "voltage_V")),
        (["time_s,a_V,b_V,displacement_x_um,displacement_y_um,displacement_z_um"], (2, "a_V, b_V", 3, "--voltage")),
        (["0,1,2", "1,1,2"], ("first line",)),
        ([""], ("first line", "time_s,x_V")),
        ([], ("first line", "time_s,x_V")),
        (["a" * 200_000], ("comma", "semicolon", "tab")),
        (["time_s,voltage_V,displacement_um", "0,1,2", f"1,1,{'9' * 200_000}x"], ("line 3",)),
    ],
)
def test_bad_table(table, lines, data):
    path = table(*lines)
    message = refusal(RecordError, import_table, path)
    assert holds(message, path, *data)
    assert len(message) < 500


def test_column_that_is_not_there(table):
    path = table("time_s,voltage_V,displacement_um", "0,1,2", "1,1,2")
    for option in ({"time": "when"}, {"voltage": ["when"]}, {"displacement": ["when"]}):
        assert holds(refusal(RecordError, import_table, path, **option), "'when'", "time_s, voltage_V, displacement_um")


def test_no_text_file(tmp_path):
    assert holds(refusal(RecordError, import_table, tmp_path / "nothing.csv"), tmp_path / "nothing.csv")
    assert holds(refusal(RecordError, import_table, tmp_path), tmp_path, os.strerror(errno.EISDIR))
    for junk in (bytes(range(256)) * 10, b"\0" * 100, b"\xff\xfea", b"GIF89a\x01,\x02\n1,2\n"):
        (tmp_path / "junk.csv").write_bytes(junk)
        assert holds(refusal(RecordError, import_table, tmp_path / "junk.csv"), tmp_path / "junk.csv", "UTF-8")


@pytest.fixture
def mat(tmp_path):
    """Return a function that writes variables to a MATLAB file and returns its path."""

    def write(version="5", **variables):
        path = tmp_path / "data.mat"
        savemat(path, variables, format=version, do_compression=version == "5", oned_as="column")
        return path

    return write


T = np.arange(60) * 0.01
MOVED = np.column_stack([T, 2 * T, 3 * T])


@pytest.mark.parametrize("version", ["4", "5"])
def test_matlab_file_as_a_table(mat, version):
    record = import_table(mat(version, time_ms=1e3 * T, voltage=100 * T[None], displacement_nm=T, other=np.eye(3)))
    np.testing.assert_array_equal(record.time_ns, 10_000_000 * np.arange(60))
    np.testing.assert_allclose(record.voltage["x"], 100 * T)
    np.testing.assert_allclose(record.displacement["x"], 1e-9 * T)


@pytest.mark.parametrize(("y", "column"), [(MOVED, "y(:,{})"), (MOVED.T, "y({},:)")])
def test_matrix_of_a_matlab_file(mat, y, column):
    path = mat(t=T.astype(np.float32), u=(100 * T).astype(np.int16), y=y)
    columns = [column.format(number) for number in (1, 3)]
    record = import_table(path, time="t", voltage=["u"], displacement=columns, axes=["a", "b"], displacement_unit="mm")
    np.testing.assert_allclose(record.displacement["a"], 1e-3 * T)
    np.testing.assert_allclose(record.displacement["b"], 3e-3 * T)
    np.testing.assert_array_equal(record.voltage["a"], np.trunc(100 * T))
    message = refusal(RecordError, import_table, path, time="t", voltage=["u"], displacement=["y"])
    assert holds(message, "'y'", f"t, u, {columns[0]}")


@pytest.mark.parametrize(
    ("variables", "data"),
    [
        ({"time": T, "voltage": T, "displacement": T[1:]}, ("'displacement'", 59, "'time'", 60)),
        ({"time": T, "voltage": T + 1j, "displacement": T}, ("'voltage'", "complex")),
        ({"time": T[::-1], "voltage": T, "displacement": T}, ("value 2", "'time'", 0.58)),
        ({"time": np.where(T > 0.3, np.nan, T), "voltage": T, "displacement": T}, ("value 32", "'time'", "nan")),
        ({"when": T, "voltage": T, "displacement": T}, ("--time", "when, voltage, displacement")),
        ({"time": [[1.0]], "voltage": [[1.0]], "displacement": [[1.0]]}, (1,)),
        ({"log": {"time": T}, "name": "stage", "parts": np.array(["a", 1], object)}, ("log.time", "--time")),
        ({"cube": np.zeros((2, 2, 2)), "none": np.zeros((0, 3))}, ("cube (double, 2x2x2)", "none (double, 0x3)")),
        ({}, ("nothing",)),
    ],
)
def test_bad_matlab_file(mat, variables, data):
    path = mat(**variables)
    assert holds(refusal(RecordError, import_table, path), path, *data)


def test_matlab_file_at_which_scipy_would_end_the_process(tmp_path):
    """A damaged type of the data, which SciPy looks up without a check; a complex matrix without an imaginary part."""
    path = tmp_path / "data.mat"
    savemat(path, {"time_s": T, "x_V": T, "x_um": T}, oned_as="column")
    whole = path.read_bytes()
    for at in range(128, 200, 4):
        for number in (0, 8, 10, 14, 15, 3849, 2**31, 0x00080006, 0x00010E0E):
            path.write_bytes(whole[:at] + number.to_bytes(4, "little") + whole[at + 4 :])
            # Some of it is no part of what is read.
            with suppress(RecordError):
                import_table(path)
    for at, number in ((145, 0x08), (184, 14), (184, 8)):
        path.write_bytes(whole[:at] + bytes([number]) + whole[at + 1 :])
        assert holds(refusal(RecordError, import_table, path), path, "variable")


@pytest.mark.parametrize("cell", ["1_0", "१२", "１２"])
def test_numbers_of_other_notations(tmp_path, cell):
    path = tmp_path / "data.csv"
    path.write_text(f"time_s,x_V,x_um\n0,0,0\n1,{cell},1\n2,1,2\n", encoding="utf-8")
    assert holds(refusal(RecordError, import_table, path), path, "line 3", repr(cell))


def test_no_matlab_file(tmp_path, mat):
    assert holds(refusal(RecordError, import_table, tmp_path / "nothing.mat"), tmp_path / "nothing.mat")
    hdf5 = tmp_path / "new.mat"
    hdf5.write_bytes(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM" + bytes(400))
    assert holds(refusal(RecordError, import_table, hdf5), hdf5, 7.3, "save(..., '-v7')")
    for junk in (b"", b"time_s,x_V\n", bytes(range(256)) * 10):
        hdf5.write_bytes(junk)
        message = refusal(RecordError, import_table, hdf5)
        assert holds(message, hdf5, "save(..., '-v7')") and not holds(message, 7.3)
    whole = mat(time=T, voltage=T, displacement=T).read_bytes()
    rng = np.random.default_rng(0)
    for _ in range(200):
        damaged = np.frombuffer(whole, np.uint8).copy()
        damaged[rng.integers(len(whole), size=4)] = rng.integers(256, size=4)
        hdf5.write_bytes(damaged.tobytes()[: rng.integers(1, len(whole) + 1)])
        with suppress(SlpiError):
            import_table(hdf5)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.lists(
        st.tuples(st.floats(allow_nan=False, allow_infinity=False), st.integers(0, 10**12)), min_size=2, max_size=20
    ),
    st.sampled_from(["V", "m"]),
)
def test_table_round_trip_is_exact(tmp_path, rows, suffix):
    t = np.cumsum([step for _, step in rows]) * 1e-9
    columns = {"x": np.array([value for value, _ in rows]), "long name": np.array([-value for value, _ in rows])}
    write_table(tmp_path / "table.csv", t, columns, suffix)
    read_t, read = read_table(tmp_path / "table.csv", suffix)
    assert list(read) == ["x", "long name"]
    np.testing.assert_allclose(read_t, t, rtol=0, atol=0.51e-9)
    for axis, values in columns.items():
        assert read[axis].tobytes() == values.tobytes()
    assert os.listdir(tmp_path) == ["table.csv"]


def test_other_units_count_where_none_is_in_si(table):
    rows = ("0,1,2", "1,3,4")
    for header, suffix, scale in (("x_um,y_um", "m", 1e-6), ("x_nm,y_nm", "m", 1e-9), ("x_mV,y_mV", "V", 1e-3)):
        _, columns = read_table(table(f"time_s,{header}", *rows), suffix)
        assert {axis: values.tolist() for axis, values in columns.items()} == {
            "x": [1 * scale, 3 * scale],
            "y": [2 * scale, 4 * scale],
        }
    _, columns = read_table(table("time_s,x_um,x_m", *rows), "m")
    assert columns["x"].tolist() == [2, 4]
    for header in ("time_s,um,x_V", "time_s,_um,x_V", "time_s,x_kg,x_V"):
        with pytest.raises(RecordError, match="_m"):
            read_table(table(header, *rows), "m")


def test_only_the_wanted_columns_count(table):
    path = table("note,x_m,time_s,y_V,x_V", "a,,0,1,2", "b,,0,3,4", "c,nan,0.5,5,6")
    t, columns = read_table(path, "V")
    assert t.tolist() == [0, 0, 0.5]
    assert {axis: values.tolist() for axis, values in columns.items()} == {"y": [1, 3, 5], "x": [2, 4, 6]}


@pytest.mark.parametrize(
    ("lines", "data"),
    [
        (["time_s,x_V", "0,1", "1,nan"], ("line 3", "'x_V'", "nan")),
        (["time_s,x_V", "0,1", "1,"], ("line 3", "'x_V'", "nan")),
        (["time_s,x_V", "0,1", "", "1,-inf"], ("line 4", "'x_V'", "-inf")),
        (["time_s,x_V", "nan,1", "1,1"], ("line 2", "'time_s'", "nan")),
        (["time_s,x_V", "1,1", "0.5,1"], ("line 3", "'time_s'", 0.5)),
        (["time_s,x_V", "0,1", "1,one"], ("line 3", "'x_V'", "'one'")),
        (["time_s,x_V", "0,1"], ("1 rows",)),
        (["time,x_V", "0,1", "1,1"], ("'time_s'", "time, x_V")),
        (["time_s,x_m", "0,1", "1,1"], ("<axis>_V", "time_s, x_m")),
    ],
)
def test_bad_command_table(table, lines, data):
    path = table(*lines)
    assert holds(refusal(RecordError, read_table, path, "V"), path, *data)


def test_table_that_cannot_be_written(tmp_path):
    t = np.arange(3.0)
    write_table(tmp_path / "table.csv", t, {"x": t}, "V")
    assert holds(refusal(RecordError, write_table, tmp_path / "table.csv", t, {"x": t[:2]}, "V"), 2, "'x'", 3)
    for place, reason in (
        (tmp_path / "no" / "table.csv", errno.ENOENT),
        (tmp_path / "table.csv" / "below", errno.ENOTDIR),
        (tmp_path, errno.EISDIR),
    ):
        assert holds(refusal(RecordError, write_table, place, t, {"x": t}, "V"), place, os.strerror(reason))
    assert os.listdir(tmp_path) == ["table.csv"]
    assert read_table(tmp_path / "table.csv", "V")[1]["x"].tolist() == [0, 1, 2]
