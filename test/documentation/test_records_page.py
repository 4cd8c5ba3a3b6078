"""How-to *Records and tables*: each line of *Your data*, on a small file of its kind."""

import re
import shlex
import subprocess
import sys

import numpy as np
import pytest
from documentation.pages import DOCS
from io_layouts import DSPACE, LABVIEW, RIGOL, ROWS, STRUCTURE, lines, settings_beside
from scipy.io import savemat

from slpi_ros.io.bag_reader import read_bag

PAGE = (DOCS / "how-to" / "records.md").read_text(encoding="utf-8")
COMMANDS = re.findall(r"^slpi import .*$", PAGE, re.MULTILINE)
T, V, Y = (np.array(column) for column in zip(*ROWS, strict=True))
SCOPE = [(t, v / 10.0, y / 6.0) for t, v, y in ROWS]
EXACT = "{!r}"


def workbook(path):
    openpyxl = pytest.importorskip("openpyxl")
    book = openpyxl.Workbook()
    book.active.title = "run"
    for row in (["Time (s)", "Voltage (V)", "Position (um)"], *ROWS):
        book.active.append(row)
    book.create_sheet("notes").append(["made by hand"])
    book.save(path)


def tdms(path):
    nptdms = pytest.importorskip("nptdms")
    wave = {"wf_increment": 0.005, "wf_start_offset": 0.0}
    with nptdms.TdmsWriter(path) as writer:
        writer.write_segment(
            [
                nptdms.ChannelObject("run", "voltage", V, {"unit_string": "V", **wave}),
                nptdms.ChannelObject("run", "position", Y, {"unit_string": "um", **wave}),
                nptdms.ChannelObject("before", "voltage", V),
            ]
        )


def text(content):
    return lambda path: path.write_text(content, encoding="utf-8")


def matlab(**variables):
    return lambda path: savemat(path, variables, oned_as="column")


MERGED = sorted([(t, repr(v), "") for t, v, _ in ROWS] + [(t, "", repr(y)) for t, _, y in ROWS])
FILES = {
    "data.csv": text("time_s,voltage (V),position [um]\n" + lines(",")),
    "recorder.txt": text("# made by the data recorder\n" + lines(" ", rows=[row[1:] for row in ROWS])),
    "keysight.csv": text("x-axis,1,2\nsecond,Volt,Volt\n" + lines(",", rows=SCOPE, form=EXACT)),
    "tektronix.csv": text(settings_beside(SCOPE)),
    "rigol.csv": text(RIGOL + lines(",", end=",", rows=[(k, *row[1:]) for k, row in enumerate(SCOPE)], form=EXACT)),
    "run.lvm": text(LABVIEW.format(mark=".", columns="One") + lines()),
    "run.tdms": tdms,
    "capture.mat": matlab(exp=DSPACE),
    "scope.mat": matlab(ScopeData=STRUCTURE),
    "period.mat": matlab(Ts=0.005, voltage=V, position=Y),
    "data.xlsx": workbook,
    "loggers.csv": text("time_s,voltage_V,position_um\n" + "".join(f"{t},{v},{y}\n" for t, v, y in MERGED)),
}


def test_every_kind_of_file_has_its_line():
    assert sorted({shlex.split(command)[2] for command in COMMANDS}) == sorted(FILES)


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: shlex.split(command)[2])
def test_a_line_of_the_page(tmp_path, command):
    words = shlex.split(command)
    FILES[words[2]](tmp_path / words[2])
    run = [sys.executable, "-m", "slpi_ros.cli", *words[1:]]
    done = subprocess.run(run, cwd=tmp_path, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, ""), done.stderr
    record = read_bag(tmp_path / words[words.index("-o") + 1])
    (axis,) = record.axes
    known = np.isfinite(record.displacement[axis])
    np.testing.assert_allclose(record.voltage[axis][known], V, atol=2e-3)
    np.testing.assert_allclose(record.displacement[axis][known], 1e-6 * Y, atol=1e-9)
