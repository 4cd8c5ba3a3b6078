"""Progress: heard by who listens, on a terminal only, and only of long work."""

import io
import time

import pytest
from identification.records import calibration

import slpi_ros
from slpi_ros.identification import progress
from slpi_ros.identification.progress import listening, report_progress, shown_on


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_only_who_listens_hears():
    heard = []
    report_progress("before")
    with listening(heard.append):
        report_progress("within")
        with listening(lambda _: None):
            report_progress("to another")
    report_progress("after")
    assert heard == ["within"]


def test_a_terminal_shows_the_latest_of_long_work_and_is_left_clean():
    terminal, seconds = Terminal(), iter([0.0, 1.0, 3.0, 4.0])
    with pytest.raises(RuntimeError), shown_on(terminal, lambda: next(seconds)):
        for what in ("early", "later", "latest"):
            report_progress(what)
        raise RuntimeError
    shown = terminal.getvalue()
    assert "early" not in shown and "3 s: later" in shown and "4 s: latest" in shown
    assert shown.endswith("\r\x1b[K")
    report_progress("nobody listens any more")
    assert terminal.getvalue() == shown


def test_short_work_and_other_streams_show_nothing():
    for stream in (io.StringIO(), Terminal()):
        with shown_on(stream, lambda: 0.0):
            report_progress("something")
        assert stream.getvalue() == ""


@pytest.mark.parametrize("kind", ["slpi", "slpi-published"])
def test_an_identification_tells_what_it_does(kind):
    heard = []
    with listening(heard.append):
        slpi_ros.identify(calibration(seed=1, duration=8.0)[0], kind)
    assert heard[0].startswith("axis x") and sum("fold" in what for what in heard) >= 5


def test_a_compilation_is_told():
    compiled = pytest.importorskip("slpi_ros.hysteresis.compiled")
    from numba import njit

    heard = []
    with listening(heard.append):
        assert njit(lambda x: x + 1)(1) == 2
    assert len(heard) >= 1 and compiled
    heard.clear()
    with listening(heard.append):
        report_progress("own")
    assert heard == ["own"]


def test_a_long_step_shows_the_message_before_it(monkeypatch):
    monkeypatch.setattr(progress, "PATIENCE", 0.01)
    terminal = Terminal()
    with shown_on(terminal, lambda: 0.0):
        report_progress("step")
    assert terminal.getvalue() == ""
    times = iter([0.0, 0.0, 5.0])
    with shown_on(terminal, lambda: next(times)):
        report_progress("step")
        for _ in range(1000):
            if "5 s: step" in terminal.getvalue():
                break
            time.sleep(0.01)
    assert "5 s: step" in terminal.getvalue()
