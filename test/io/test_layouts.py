"""Tables as instruments and programs write them: the same samples in each of them, to the last digit that it shows."""
# ruff: noqa: E501

import itertools
import warnings

import numpy as np
import pytest
from io_layouts import DSPACE, LABVIEW, RIGOL, ROWS, SIGNALS, STRUCTURE, N, T, V, Y, lines, settings_beside
from refusals import holds, refusal
from scipy.io import savemat

from slpi_ros.errors import DependencyError, RecordError, UsageError
from slpi_ros.io.columns import ColumnOptions
from slpi_ros.io.tables import import_table, import_with_summary, read_table


@pytest.fixture(autouse=True)
def no_warning():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # Under Python 3.12, of dateutil and openpyxl.
        warnings.filterwarnings("ignore", r"datetime\.datetime\.utc", DeprecationWarning)
        yield


DATES = "".join(f"2026-01-31 23:59:59.{900 + 5 * k:03d},{v},{y}\n" for k, (_, v, y) in enumerate(ROWS[:20])) + "".join(
    f"2026-02-01 00:00:00.{5 * k:03d},{v},{y}\n" for k, (_, v, y) in enumerate(ROWS[20:])
)
TIMES = DATES.replace("2026-01-31 ", "").replace("2026-02-01 ", "")
COMMA = {"voltage": ("Piezo voltage",)}
SCOPE = {"sensor_scale": 1e-6, "amplifier_gain": 1.0}
TEXTS = {
    "savetxt": ("# time_s,voltage_V,position_um\n" + lines(","), {}),
    "MATLAB comments": ("% export of a scope\n% Time (s)  Voltage (V)  Position (um)\n" + lines("  "), {}),
    "LabVIEW": (LABVIEW.format(mark=".", columns="One") + lines(end="\t"), COMMA),
    "LabVIEW, decimal commas": (LABVIEW.format(mark=",", columns="One") + lines(comma=True), COMMA),
    "LabVIEW, no X": (LABVIEW.format(mark=".", columns="No") + lines(rows=[("", *row[1:]) for row in ROWS], form="{}"), COMMA),
    "Keysight": ("x-axis,1,2\nsecond,Volt,Volt\n" + lines(",", form="{:+.12E}"),
                 {"time": "x-axis", "voltage": ("1",), "displacement": ("2",), **SCOPE}),
    "Rigol": (RIGOL + lines(",", end=",", rows=[(k, *row[1:]) for k, row in enumerate(ROWS)], form="{}"),
              {"sample_period": 0.005, "voltage": ("CH1",), "displacement": ("CH2",), **SCOPE}),
    "Tektronix": (settings_beside(ROWS), {"names": ("time_s", "voltage_V", "position_um")}),
    "spaces": ("  Time(s)   Voltage(V)   Position(um)\n" + lines("   "), {}),
    "names with spaces": ("Time (s)  Piezo voltage (V)  Position (um)\n" + lines(" "), {}),
    "names with units after spaces": ("Time (s) Voltage (V) Position (um)\n" + lines(" "), {}),
    "tabs at the ends": ("time_s\tx_V\tx_um\n" + lines(end="\t"), {}),
    "German": ("Messung 7;;\nZeit;Spannung;Weg\n[s];[V];[µm]\n" + lines(";", comma=True),
               {"time": "Zeit", "voltage": ("Spannung",), "displacement": ("Weg",)}),
    "no names": (lines("\t"), {"names": ("time_s", "x_V", "x_um")}),
    "no time": ("voltage_V,position_um\n" + lines(",", rows=[row[1:] for row in ROWS]), {"sample_period": 0.005}),
    "dates": ("Time,Voltage (V),Position (um)\n" + DATES, {}),
    "days first": ("Time;Voltage (V);Position (um)\n"
                   + DATES.replace("2026-01-31", "31/01/2026").replace("2026-02-01", "01/02/2026").replace(",", ";"), {}),
    "points in dates": ("Time;Voltage (V);Position (um)\n"
                        + DATES.replace("2026-01-31", "31.1.2026").replace("2026-02-01", "1.2.2026").replace(",", ";"), {}),
    "times of day": ("Date,Time,Voltage (V),Position (um)\n" + "".join("x," + line + "\n" for line in TIMES.split()), {}),
    "seconds since 1904": ("time_s\tx_V\tx_um\n" + lines(rows=[(t + 3.9e9, v, y) for t, v, y in ROWS], form="{:.6f}"), {}),
    "milliseconds since 1970": ("Timestamp\tx_V\tx_um\n" + lines(rows=[(1764000000000 + round(1e3 * t), v, y) for t, v, y in ROWS], form="{}"), {}),
    "a monitor": ("Time (s),Voltage (V),Sensor (V),Position (um)\n"
                  + lines(",", rows=[(t, v, y / 6.0, y) for t, v, y in ROWS], form="{:.4f}"), {}),
    "the drive's name is another one": ("Time (s),Position (V),Drive (V),Position (um)\n"
                  + lines(",", rows=[(t, y / 6.0, v, y) for t, v, y in ROWS], form="{:.4f}"), {}),
}  # fmt: skip
LINES = {"names": "Time\tVoltage\tPosition", "units": "s\tV\tµm", "comments": "Comment\tpiezo\tcap sensor"}
TEXTS |= {
    f"Origin, {', '.join(order)}": ("\n".join([*(LINES[one] for one in order), lines()]), {})
    for order in itertools.permutations(LINES)
}


def agrees(record, first=0):
    (axis,) = record.axes
    time = record.time_ns - record.time_ns[0]
    np.testing.assert_allclose(time * 1e-9, T - T[0], atol=3e-7)
    np.testing.assert_array_equal(record.voltage[axis], V)
    np.testing.assert_allclose(record.displacement[axis], Y * 1e-6, rtol=1e-15)


@pytest.mark.parametrize("layout", TEXTS)
def test_layouts_of_text(tmp_path, layout):
    text, options = TEXTS[layout]
    path = tmp_path / "table.txt"
    path.write_text(text, encoding="utf-8")
    agrees(import_with_summary(path, ColumnOptions(**options)).record)


BY_PLACE = {"voltage": ("signals.values(:,1)",), "displacement": ("signals.values(:,2)",)}
MATLAB = {
    "vectors": ({"time_s": T, "x_V": V, "x_um": Y, "note": "run 3"}, {}),
    "a matrix": ({"log": np.c_[T, V, Y]}, {"time": "log(:,1)", "voltage": ("log(:,2)",), "displacement": ("log(:,3)",)}),
    "structure with time": ({"ScopeData": STRUCTURE}, BY_PLACE),
    "structure with labels": ({"ScopeData": {"time": T[:, None], "signals": SIGNALS}}, {}),
    "capture of dSPACE": ({"exp": DSPACE}, {}),
    "a period": ({"Ts": 0.005, "voltage": V, "position": Y}, {"time": "Ts"}),
    "a period, by its name": ({"Ts": 0.005, "voltage": V, "position": Y}, {}),
    "t": ({"t": T, "u_V": V, "x_um": Y}, {}),
}  # fmt: skip


@pytest.mark.parametrize("compressed", [True, False])
@pytest.mark.parametrize("layout", MATLAB)
def test_layouts_of_matlab_files(tmp_path, layout, compressed):
    variables, options = MATLAB[layout]
    savemat(tmp_path / "data.mat", variables, do_compression=compressed, oned_as="column")
    agrees(import_with_summary(tmp_path / "data.mat", ColumnOptions(**options)).record)


def opaque(name: str) -> bytes:
    """Return the element of a string object, as MATLAB writes it: no shape, but names and a matrix of references."""

    def element(kind, content):
        return kind.to_bytes(4, "little") + len(content).to_bytes(4, "little") + content + bytes(-len(content) % 8)

    reference = element(6, (13).to_bytes(4, "little") + bytes(4)) + element(
        5, (6).to_bytes(4, "little") + (1).to_bytes(4, "little")
    )
    inner = element(14, reference + element(1, b"") + element(6, bytes(24)))
    flags = element(6, (17).to_bytes(4, "little") + bytes(4))
    return element(14, flags + element(1, name.encode()) + element(1, b"MCOS") + element(1, b"string") + inner)


def test_objects_of_matlab_are_left_out_and_told(tmp_path):
    path = tmp_path / "data.mat"
    savemat(path, {"time_s": T, "x_V": V, "x_um": Y}, oned_as="column")
    path.write_bytes(path.read_bytes() + opaque("note"))
    table = import_with_summary(path, ColumnOptions())
    agrees(table.record)
    assert any(holds(line, "note", "object") for line in table.summary)


def version_7_3(path, **variables):
    """Write variables as MATLAB 7.3 does: arrays turned round, texts as numbers, structures as groups."""
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "w", userblock_size=512) as file:

        def put(place, name, value):
            if isinstance(value, dict):
                group = place.create_group(name)
                group.attrs["MATLAB_class"] = np.bytes_("struct")
                for field, part in value.items():
                    put(group, field, part)
            elif isinstance(value, list):
                group = place.create_group(name)
                references = file.require_group("#refs#")
                for field in value[0]:
                    for number, one in enumerate(value):
                        put(references, f"{name}{field}{number}", one[field])
                    cells = [references[f"{name}{field}{number}"].ref for number in range(len(value))]
                    group.create_dataset(field, (len(value), 1), h5py.ref_dtype, cells)
            else:
                text = isinstance(value, str)
                array = np.frombuffer(value.encode("utf-16-le"), np.uint16)[:, None] if text else np.atleast_2d(value).T
                place.create_dataset(name, data=array).attrs["MATLAB_class"] = np.bytes_("char" if text else "double")

        for name, value in variables.items():
            put(file, name, value)
    with open(path, "r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM")


def test_matlab_7_3(tmp_path):
    path = tmp_path / "data.mat"
    version_7_3(path, time_s=T[:, None], x_V=V[:, None], x_um=Y[None], note="run")
    agrees(import_table(path))
    version_7_3(path, exp=DSPACE)
    agrees(import_table(path))
    version_7_3(path, ScopeData={"time": T[:, None], "signals": {"values": np.c_[V, Y], "label": ""}})
    agrees(import_with_summary(path, ColumnOptions(**BY_PLACE)).record)


def test_archives_of_numpy(tmp_path):
    path = tmp_path / "data.npz"
    np.savez(path, time_s=T, x_V=V, x_um=Y, other=np.array(["a", "b"]))
    agrees(import_table(path))
    records = np.array(ROWS, [("time_s", float), ("x_V", float), ("x_um", float)])
    np.savez_compressed(path, log=records)
    agrees(import_table(path))
    np.savez(path, time_s=T, x_V=V, x_um=Y, objects=np.array([{}], object))
    agrees(import_table(path))


def test_workbooks(tmp_path):
    openpyxl = pytest.importorskip("openpyxl")
    path = tmp_path / "data.xlsx"
    book = openpyxl.Workbook()
    for row in (["Stage 7"], [], ["Time (s)", "Voltage (V)", "Position (um)"], *ROWS):
        book.active.append(row)
    book.save(path)
    agrees(import_table(path))
    book.create_sheet("other").append(["a", 1])
    book.save(path)
    assert holds(refusal(RecordError, import_table, path), "Sheet", "other", "--sheet")
    agrees(import_with_summary(path, ColumnOptions(sheet="Sheet")).record)
    path.write_bytes(b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1" + bytes(500))
    assert holds(refusal(RecordError, import_table, path), ".xlsx")


def test_tdms(tmp_path):
    nptdms = pytest.importorskip("nptdms")
    path = tmp_path / "data.tdms"
    wave = {"wf_increment": 0.005, "wf_start_offset": 0.0}
    channels = [
        nptdms.ChannelObject("run", "voltage", V, {"unit_string": "V", **wave}),
        nptdms.ChannelObject("run", "position", Y, {"unit_string": "um", **wave}),
    ]
    with nptdms.TdmsWriter(path) as writer:
        writer.write_segment(channels)
    agrees(import_table(path))
    with nptdms.TdmsWriter(path) as writer:
        writer.write_segment([*channels, nptdms.ChannelObject("second", "voltage", V)])
    assert holds(refusal(RecordError, import_table, path), "run", "second", "--group")
    agrees(import_with_summary(path, ColumnOptions(group="run")).record)


def test_the_library_of_a_file_is_named_where_it_is_missing(tmp_path, monkeypatch):
    path = tmp_path / "data.mat"
    version_7_3(path, time_s=T[:, None])
    monkeypatch.setitem(__import__("sys").modules, "h5py", None)
    assert holds(refusal(DependencyError, import_table, path), path, "7.3", "pip install h5py")


def written(tmp_path, text):
    path = tmp_path / "table.csv"
    path.write_text(text, encoding="utf-8")
    return path


def test_of_two_columns_in_volts_the_drive_is_not_guessed(tmp_path):
    other = [(t, v, 0.8 * v + 3.0 * np.sin(9.0 * t), y) for t, v, y in ROWS]
    for names in ("Voltage (V),Control (V)", "a_V,b_V", "x_V,x2_V", "voltage_V,voltage2_V"):
        path = written(tmp_path, f"Time (s),{names},Position (um)\n" + lines(",", rows=other))
        assert holds(refusal(RecordError, import_table, path), *names.split(","), "--voltage")
    agrees(import_table(path, voltage=["voltage_V"]))
    # Two axes, whose drives do not say to which they belong.
    path = written(
        tmp_path, "Time (s),U (V),W (V),x (um),y (um)\n" + lines(",", rows=[(*row, row[3]) for row in other])
    )
    assert holds(refusal(RecordError, import_table, path), "U (V)", "W (V)", "--voltage")


def test_a_monitor_of_the_sensor_is_told(tmp_path):
    rng = np.random.default_rng(0)
    noisy = [(t, v, y / 6.0 + noise, y) for (t, v, y), noise in zip(ROWS, rng.normal(0.0, 2e-3, N), strict=True)]
    path = written(tmp_path, "Time (s),Drive (V),Monitor (V),Position (um)\n" + lines(",", rows=noisy, form="{:.3f}"))
    table = import_with_summary(path, ColumnOptions())
    assert table.record.voltage["x"].max() == pytest.approx(100.0, abs=1.0)
    assert any("'Monitor (V)'" in line and "monitor" in line for line in table.summary)


@pytest.mark.parametrize("what", ["a loop", "a loop with a spike", "noise", "one rise", "a line", "a noisy line"])
def test_only_a_line_is_taken_for_a_monitor(tmp_path, what):
    """One damaged reading of 4,000 made a loop a line; so did readings that are nothing but noise."""
    rng = np.random.default_rng(3)
    moved = np.array([y for _, _, y in ROWS])
    moved = {
        "a loop": moved,
        "a loop with a spike": np.where(np.arange(N) == N // 2, 99.0, moved),
        "noise": rng.normal(0.0, 1.0, N),
        # Which cannot show any hysteresis.
        "one rise": 0.1 * np.linspace(0.0, 7.0, N),
        "a line": 0.1 * V,
        "a noisy line": 0.1 * V + rng.normal(0.0, 8e-3, N),
    }[what]
    driven = 10.0 * moved if what == "one rise" else V
    rows = [(t, v, y) for (t, _, _), v, y in zip(ROWS, driven.tolist(), moved.tolist(), strict=True)]
    path = written(tmp_path, "Time (s),x_V,x_um\n" + lines(",", rows=rows, form="{:.6f}"))
    summary = import_with_summary(path, ColumnOptions()).summary
    assert any("monitor" in line for line in summary) == what.endswith("line")


def test_the_scales_of_a_sensor_and_of_an_amplifier(tmp_path):
    rows = [(t, v / 10.0, y / 6.0) for t, v, y in ROWS]
    path = written(tmp_path, "Time (s),Drive (V),Sensor (V)\n" + lines(",", rows=rows, form="{!r}"))
    options = ColumnOptions(
        voltage=("Drive (V)",), displacement=("Sensor (V)",), sensor_scale=6e-6, amplifier_gain=10.0
    )
    record = import_with_summary(path, options).record
    np.testing.assert_allclose(record.voltage["Sensor"], V)
    np.testing.assert_allclose(record.displacement["Sensor"], 1e-6 * Y)
    assert holds(refusal(RecordError, import_table, path), "--displacement", "--sensor-scale")
    for wrong in (
        {"sensor_scale": 0.0},
        {"amplifier_gain": np.nan},
        {"sample_period": -1.0},
        {"time": "a", "sample_period": 1.0},
    ):
        refusal(UsageError, ColumnOptions, **wrong)


def test_rows_of_two_clocks_are_aligned(tmp_path):
    rows = sorted([(t, f"{v}", "") for t, v, _ in ROWS] + [(t + 0.0021, "", f"{y}") for t, _, y in ROWS])
    path = written(tmp_path, "time_s,voltage_V,position_um\n" + "".join(f"{t:.4f},{v},{y}\n" for t, v, y in rows))
    table = import_with_summary(path, ColumnOptions())
    both = np.isfinite(table.record.displacement["x"]) & np.isfinite(table.record.voltage["x"])
    assert both.sum() == N - 1
    t = table.record.t[both]
    np.testing.assert_allclose(table.record.voltage["x"][both], np.interp(t, T, V), atol=1e-9)
    assert any("two clocks" in line for line in table.summary)


def test_two_columns_of_time_are_no_table(tmp_path):
    twice = [(t, v, 1.01 * t + 0.003 * (k % 2), y) for k, (t, v, y) in enumerate(ROWS)]
    path = written(tmp_path, "time_s,voltage_V,time2_s,position_um\n" + lines(",", rows=twice))
    assert holds(refusal(RecordError, import_table, path), "'time_s'", "'time2_s'")
    # The same clock, in another unit.
    same = [(t, v, 1e3 * t + 7.0, y) for t, v, y in ROWS]
    agrees(import_table(written(tmp_path, "time_s,voltage_V,time_ms,position_um\n" + lines(",", rows=same))))


def test_what_is_cut_off_is_not_read_as_less(tmp_path):
    whole = "time_s,x_V,x_um\n" + lines(",")
    path = written(tmp_path, whole[: whole.rindex(",")])
    assert holds(refusal(RecordError, import_table, path), f"line {N + 1}", 2, 3)
    path = written(tmp_path, whole + "0.3,1.0,2.0,4.0\n")
    assert holds(refusal(RecordError, import_table, path), f"line {N + 2}", 4, 3)
    # A bad first row is no part of the header.
    path = written(tmp_path, whole.replace("0.0000,0.0000,0.0000", "0.0,err,0.0", 1))
    assert holds(refusal(RecordError, import_table, path), "line 2", "'err'")


def test_tables_of_commands_have_any_layout(tmp_path):
    path = written(tmp_path, "# time_s x_V\n" + lines(" ", rows=[row[:2] for row in ROWS]))
    t, columns = read_table(path, "V")
    np.testing.assert_array_equal((t, columns["x"]), (T, V))
    path = written(tmp_path, "Time;Spannung\n1;2\n2;3\n")
    assert holds(refusal(RecordError, read_table, path, "V"), "slpi import", path)


def test_numbers_keep_their_last_digit(tmp_path):
    rng = np.random.default_rng(1)
    values = rng.normal(size=(2000, 2)) * 10.0 ** rng.integers(-12, 12, (2000, 2))
    rows = [(k, *pair) for k, pair in enumerate(values.tolist())]
    path = written(tmp_path, "time_s,x_V,x_m\n" + lines(",", rows=rows, form="{!r}"))
    record = import_table(path)
    assert record.voltage["x"].tobytes() == values[:, 0].copy().tobytes()
    assert record.displacement["x"].tobytes() == values[:, 1].copy().tobytes()
