"""Names from files reach no terminal, log or page with their control characters, nor as lines of a megabyte."""

import os
import subprocess
import sys

import numpy as np
import pytest
from strategies import two_axes

from slpi_ros.cli import main
from slpi_ros.errors import LONGEST_SHOWN, RecordError, SlpiError, shown
from slpi_ros.io.bag_writer import write_bag
from slpi_ros.io.record import Record
from slpi_ros.model.document import save_model
from slpi_ros.model.stage_model import StageModel
from slpi_ros.reports.page import Page

# Clears the screen, sets the title, writes from right to left; then bytes that are no UTF-8, and a megabyte.
ESCAPES = "\x1b[2J\x1b]0;title\x07 \u202e \x9b31m \r\n\0"
HOSTILE = (ESCAPES, "caf\udce9", "x" * 10**6, f"{ESCAPES}{'y' * 10**6}")


@pytest.mark.parametrize("text", HOSTILE, ids=["escapes", "bytes", "long", "both"])
def test_text_is_one_printable_line(text):
    for line in (shown(text), str(SlpiError(text)), str(RecordError(f"{text}: do this"))):
        assert line.isprintable() and len(line.encode()) < 10 * LONGEST_SHOWN
        assert shown(line) == line
    assert str(RecordError(f"{text}: do this")).endswith(": do this")


def test_plain_text_stays():
    for text in ("", "öffnung µm", "a b", "日本 ✓"):
        assert shown(text) == text


def printed(capsys, *arguments) -> tuple[int, list[str]]:
    try:
        code = main([str(each) for each in arguments])
    except SystemExit as end:
        code = end.code
    said = capsys.readouterr()
    lines = (said.out + said.err).split("\n")
    assert all(line.isprintable() and len(line) < 2 * LONGEST_SHOWN for line in lines)
    return code, lines


@pytest.mark.parametrize("text", HOSTILE[::2] + HOSTILE[3:], ids=["escapes", "long", "both"])
def test_models(text, tmp_path, capsys):
    axes = two_axes().axes
    named = {"x\x1b[2J": axes["x"], "y": axes["y"]}
    save_model(StageModel(named, text, text), tmp_path / "m.json")
    code, lines = printed(capsys, "show", tmp_path / "m.json")
    assert code == 0 and any("\\x1b[2J" in line for line in lines)
    (tmp_path / "t.csv").write_text("time_s,z_V\n0,1\n1,2\n")
    assert printed(capsys, "simulate", tmp_path / "m.json", tmp_path / "t.csv", "-o", tmp_path / "o.csv")[0] == 1


def test_paths_and_options(tmp_path, capsys):
    name = tmp_path / "a\x1b[2J\r\nb.csv"
    assert printed(capsys, "show", name)[0] == 1
    assert printed(capsys, "import", name, "-o", tmp_path / "bag")[0] == 1
    assert printed(capsys, "show", name, f"--{ESCAPES[:5]}")[0] == 2
    name.write_text("time_s,voltage_V,\x1b[2J\n0,1,2\n1,2,3\n")
    assert printed(capsys, "import", name, "-o", tmp_path / "bag")[0] == 1


def test_stages_of_bags(tmp_path, capsys):
    ramp = np.linspace(0.0, 1.0, 50)
    for name, stage in (("one", ESCAPES), ("other", "z" * 10**5)):
        record = Record((ramp * 1e9).astype(np.int64), {"x": ramp}, {"x": 1e-6 * ramp}, hardware_id=stage)
        write_bag(tmp_path / name, record)
    assert printed(capsys, "identify", tmp_path / "one", tmp_path / "other", "-o", tmp_path / "m.json")[0] == 1


def test_pages(tmp_path):
    page = Page(ESCAPES)
    page.text(ESCAPES)
    page.heading(ESCAPES, ESCAPES)
    page.table([ESCAPES], [[ESCAPES]])
    page.write(tmp_path / "p.html")
    text = (tmp_path / "p.html").read_text()
    assert all(c.isprintable() or c == "\n" for c in text[text.index("<h1>") :])


def test_a_reader_that_has_left(tmp_path):
    """The command has done its work; `head` has seen enough."""
    save_model(two_axes(), tmp_path / "m.json")
    read, write = os.pipe()
    os.close(read)
    command = [sys.executable, "-m", "slpi_ros.cli", "show", str(tmp_path / "m.json")]
    done = subprocess.run(command, stdout=write, stderr=subprocess.PIPE, text=True, timeout=120)
    os.close(write)
    assert (done.returncode, done.stderr) == (0, "")
