"""Who owns the voltage: what the amplifier reports, held against what was output."""

import random
from contextlib import suppress
from math import inf, nan

import numpy as np
import pytest
from strategies import FAMILY_CASE, axis_model

from slpi_ros.compensator.amplifier import REARM_NS, Amplifier
from slpi_ros.compensator.controller import Controller
from slpi_ros.compensator.listening import Listening
from slpi_ros.compensator.ownership import MEASURED, SAVED
from slpi_ros.compensator.persistence import SavedAxis
from slpi_ros.compensator.validation import NOT_ARMED, STARTING, RejectedError
from slpi_ros.model.limits import Limits
from slpi_ros.model.stage_model import StageModel

MS, SECOND, START = 1_000_000, 10**9, 10**12
SPAN = 100.0
RNG = np.random.default_rng(4)


class Wired:
    """An amplifier that is given voltages and reports them every 5 ms, as they are or changed."""

    def __init__(self, voltage=50.0):
        self.amplifier, self.now_ns, self.late_ns = Amplifier(SPAN), START, 20 * MS
        self.given = [(START - 10**9, voltage)]
        self.amplifier.begin(voltage, START)

    def run(self, path, change=lambda v: v, every=5):
        """Output a path, one voltage each millisecond; return when it became foreign (s), or None."""
        begin = self.now_ns
        for k, v in enumerate(path):
            self.now_ns += MS
            self.amplifier.output(float(v), self.now_ns)
            self.given.append((self.now_ns, float(v)))
            if k % every == 0:
                there = next(x for t, x in reversed(self.given) if t <= self.now_ns - self.late_ns)
                self.amplifier.report(change(there), self.now_ns)
            if self.amplifier.foreign:
                return (self.now_ns - begin) * 1e-9
        return None


WAVE = 50.0 + 40.0 * np.sin(np.linspace(0.0, 40.0, 4000))
REST = np.full(1000, 50.0)


@pytest.mark.parametrize("path", [REST, WAVE, 50.0 + 49.0 * np.sign(WAVE - 50.0)], ids=["rest", "wave", "jumps"])
@pytest.mark.parametrize("noise", [0.0, 0.1, 2.0])
@pytest.mark.parametrize("late_ms", [0, 60, 190])
def test_reports_within_the_band_of_the_last_voltages_are_its_own(path, noise, late_ms):
    wired = Wired(float(path[0]))
    wired.late_ns = late_ms * MS
    assert wired.run(np.full(400, path[0]), lambda v: v + RNG.normal(0.0, noise)) is None
    assert wired.run(path, lambda v: v + RNG.normal(0.0, noise)) is None


def test_a_lag_or_delay_of_the_model_widens_the_band():
    for window_ns, foreign in ((200 * MS, True), (700 * MS, False)):
        wired = Wired(10.0)
        wired.amplifier.window_ns, wired.late_ns = window_ns, 600 * MS
        found = wired.run(np.concatenate([np.full(700, 10.0), np.full(900, 60.0)]))
        assert (found is not None) == foreign


def test_three_reports_and_a_tenth_of_a_second_outside_are_somebody_else():
    wired = Wired()
    wired.run(REST)
    seconds = wired.run(REST, lambda v: v + 10.0)
    assert 0.1 <= seconds <= 0.12
    assert (
        "50 V" in wired.amplifier.foreign and "60 V" in wired.amplifier.foreign and "\n" not in wired.amplifier.foreign
    )
    # Slow reports: three of them. Too far for a constant difference that motion might yet explain.
    wired = Wired()
    wired.run(REST)
    assert 0.59 <= wired.run(np.full(3000, 50.0), lambda v: v + 30.0, every=300) <= 0.61


@pytest.mark.parametrize("rate", [2, 100, 1000, 5000])
def test_steady_is_told_at_every_rate_of_reports(rate):
    amplifier, now_ns = Amplifier(SPAN), START
    for _ in range(max(3, rate)):
        now_ns += 10**9 // rate
        assert amplifier.steady(now_ns - 1) is None or now_ns > START + 150 * MS
        amplifier.report(60.0 + RNG.normal(0.0, 0.1), now_ns)
    assert amplifier.steady(now_ns) == pytest.approx(60.0, abs=0.4)
    assert amplifier.steady(now_ns, 500 * MS) == pytest.approx(60.0, abs=0.4)
    amplifier.report(80.0, now_ns + MS)
    assert amplifier.steady(now_ns + MS) is None


def test_two_reports_outside_are_none():
    wired = Wired()
    wired.run(REST)
    bad = iter([90.0, 90.0, *[50.0] * 10] * 30)
    assert wired.run(np.full(2000, 50.0), lambda v: next(bad), every=60) is None


@pytest.mark.parametrize("off", [1.9, 4.5])
def test_two_percent_of_the_range_mean_nothing(off):
    wired = Wired()
    wired.run(REST)
    assert (wired.run(REST, lambda v: v + off) is not None) == (off > 2.0)


@pytest.mark.parametrize("noise", [1.0, 3.0])
def test_the_noise_of_the_reports_widens_what_is_tolerated(noise):
    wired = Wired()
    assert wired.run(np.full(8000, 50.0), lambda v: v + RNG.normal(0.0, noise)) is None
    assert wired.amplifier.tolerance() == pytest.approx(max(2.0, 4.0 * noise), rel=0.5)
    assert wired.run(np.full(3000, 50.0), lambda v: v + 12.0 * noise + RNG.normal(0.0, noise)) is not None


@pytest.mark.parametrize(("gain", "offset"), [(1.0, 7.0), (1.2, 0.0), (1.0, -15.0)])
def test_a_constant_gain_or_offset_is_calibration_and_not_followed(gain, offset):
    wired = Wired()
    assert wired.run(WAVE, lambda v: gain * v + offset) is None
    found = wired.amplifier.calibration
    assert (found.gain, found.offset) == (pytest.approx(gain, rel=0.03), pytest.approx(offset, abs=1.0))
    assert found.voltage(gain * 30.0 + offset) == pytest.approx(30.0, abs=1.5)
    # Somebody else is told all the same.
    assert wired.run(WAVE, lambda v: gain * (v + 25.0) + offset) is not None


def test_a_driver_that_clips_or_stays_is_somebody_else():
    for change in (lambda v: min(v, 40.0), lambda v: 50.0, lambda v: 100.0 - v):
        wired = Wired()
        assert wired.run(WAVE, change) is not None


@pytest.mark.parametrize("spoil", [nan, inf, -inf])
def test_a_report_that_is_no_number_is_none(spoil):
    wired = Wired()
    assert wired.run(WAVE, lambda v: spoil) is None and wired.amplifier.latest is None


def test_a_number_beyond_reason_is_no_report_and_breaks_nothing():
    wired = Wired()
    assert wired.run(REST, lambda v: -1e300) is None and wired.amplifier.latest is None
    assert wired.amplifier.steady(wired.now_ns) is None


# Starts

MODEL = StageModel({"x": axis_model(FAMILY_CASE)})
LIMITS = Limits(0.0, 100.0, 100.0)
SAVED_AT = {"x": SavedAxis((100.0, 0.0, 32.0), True)}


def controller(start="auto", reporting=True, saved=None, limits=LIMITS):
    made = Controller(["x"], [limits], starts=[start])
    made.use_model(MODEL, saved)
    made.activate(START)
    made.ownership.reporting = reporting
    return made


def send(made, now_ns, y=5e-6):
    made.update(now_ns, ["x"], [y], now_ns)
    return made.voltages[0]


def refused(made, now_ns):
    with pytest.raises(RejectedError) as caught:
        send(made, now_ns)
    assert "\n" not in str(caught.value)
    return caught.value.cause


@pytest.mark.parametrize("saved", [None, SAVED_AT])
def test_the_first_voltage_starts_from_the_median_of_three_reports(saved):
    """The amplifier at 80 V: the first command made a step of 80 V."""
    made = controller(saved=saved)
    for k, told in enumerate((80.0, 80.3, 79.9)):
        assert refused(made, START + k * MS) == STARTING
        made.report(["x"], [told], START + k * MS)
    assert abs(send(made, START + 5 * MS) - 80.0) <= 0.2 + 1e-9
    assert made.axes[0].reversal_voltages[-2] == 80.0


def test_old_reports_do_not_start_it():
    made = controller()
    for k in range(3):
        made.report(["x"], [80.0], START + k * MS)
    assert refused(made, START + 300 * MS) == STARTING


def test_a_slow_driver_counts_after_a_second():
    made = controller()
    for k in range(4):
        made.report(["x"], [60.0 + k], START + k * 500 * MS)
        if k * 500 < 1000:
            assert refused(made, START + k * 500 * MS + 1) == STARTING
    assert abs(send(made, START + 1600 * MS) - 63.0) <= 0.2 + 1e-9


@pytest.mark.parametrize("told", [nan, inf])
def test_a_publisher_that_tells_no_number_counts_as_none_after_three_seconds(told):
    made = controller(saved=SAVED_AT)
    now = START
    while now < START + 2900 * MS:
        made.report(["x"], [told], now)
        assert refused(made, now) == STARTING
        now += 50 * MS
    assert abs(send(made, START + 3100 * MS) - 32.0) <= 0.2 + 1e-9
    assert "stage_state" in made.ownership.notes["x"]


def test_without_a_publisher_the_saved_voltage_or_that_of_the_record_which_is_said():
    saved, unknown = controller(reporting=False, saved=SAVED_AT), controller(reporting=False)
    assert abs(send(saved, START + MS) - 32.0) <= 0.2 + 1e-9
    before = unknown.voltages[0]
    assert abs(send(unknown, START + MS) - before) <= 0.2 + 1e-9
    assert "nobody reports" in unknown.ownership.notes["x"]


def test_measured_waits_for_ever_and_a_number_or_saved_do_not_wait():
    made = controller(MEASURED, reporting=False, saved=SAVED_AT)
    assert [refused(made, START + k * 10**9) for k in range(20)] == [STARTING] * 20
    assert not made.advance(START + 30 * 10**9, START) and made.voltages[0] == 32.0
    assert abs(send(controller(70.0, saved=SAVED_AT), START) - 70.0) <= 0.2 + 1e-9
    assert abs(send(controller(SAVED, saved=SAVED_AT), START) - 32.0) <= 0.2 + 1e-9


# Somebody else, and `arm`


class Owned:
    """A controller whose amplifier reports every 5 ms."""

    def __init__(self):
        self.made, self.now_ns, self.there = controller(saved=SAVED_AT), START, 32.0
        self.foreign = False
        self.run(0.05)
        self.send()
        self.run(1.0)

    def send(self, y=8e-6):
        try:
            send(self.made, self.now_ns, y)
        except RejectedError as error:
            return error.cause
        return ""

    def run(self, seconds, noise=0.0):
        """Let time pass; True if the voltage was lost meanwhile."""
        lost = False
        for k in range(round(seconds * 1000)):
            self.now_ns += MS
            self.made.advance(self.now_ns, self.now_ns)
            if not self.foreign and self.made.ownership.owned:
                self.there = self.made.voltages[0]
            if k % 5 == 0:
                lost = self.made.report(["x"], [self.there + RNG.normal(0.0, noise)], self.now_ns) or lost
        return lost


def test_somebody_else_is_noticed_nothing_is_output_and_arm_enters_one_move():
    owned = Owned()
    made, axis = owned.made, owned.made.axes[0]
    turns = axis.reversal_voltages
    owned.foreign, owned.there = True, 75.0
    assert owned.run(0.2) and not made.ownership.armed
    before = made.voltages[0]
    assert owned.send() == NOT_ARMED and not owned.run(0.5)
    assert made.voltages[0] == before and axis.reversal_voltages == turns
    # Restless: no.
    for k in range(100):
        owned.there = 75.0 + (k % 2) * 10.0
        owned.run(0.005)
    assert "steady" in made.arm(owned.now_ns) and owned.send() == NOT_ARMED
    owned.there = 75.0
    owned.run(0.4)
    assert made.arm(owned.now_ns) == ""
    assert made.voltages[0] == axis.voltage == 75.0 and axis.reversal_voltages[-1] == 75.0
    assert len(axis.reversal_voltages) <= len(turns) + 1, "one move"
    # Old goals are gone.
    owned.foreign = False
    owned.run(1.0)
    assert made.voltages[0] == 75.0
    assert owned.send(2e-6) == "" and abs(made.voltages[0] - 75.0) <= 0.2 + 1e-9


def test_rearm_takes_half_a_second_of_steady_reports():
    owned = Owned()
    owned.foreign, owned.there = True, 75.0
    owned.run(0.2)
    begin = owned.now_ns
    while owned.made.arm(owned.now_ns, REARM_NS):
        owned.run(0.005)
        assert owned.now_ns - begin < 10**9
    assert owned.made.voltages[0] == 75.0
    assert owned.now_ns - begin >= 250 * MS


def test_trajectories_resets_and_ramps_end_when_the_voltage_is_lost():
    for begin in (
        lambda made, now: made.follow(["x"], [10**10], [[9e-6]], 0, now, now),
        lambda made, now: made.reset_memory(3, 20.0, [50.0], now),
        lambda made, now: made.ramp([5.0], 5.0, now),
    ):
        owned = Owned()
        begin(owned.made, owned.now_ns)
        owned.run(0.1)
        owned.foreign, owned.there = True, 90.0 if owned.there < 50.0 else 5.0
        assert owned.run(0.4)
        before = owned.made.voltages[0]
        owned.run(0.3)
        owned.made.arm(owned.now_ns)
        assert owned.made.voltages[0] == owned.there != before
        owned.foreign = False
        owned.run(1.0)
        assert owned.made.voltages[0] == owned.there and not owned.made.ramping and not owned.made.trajectory.on


def test_noise_of_reports_never_reaches_the_memory():
    owned = Owned()
    turns = owned.made.axes[0].reversal_voltages
    owned.run(2.0, noise=0.5)
    assert owned.made.axes[0].reversal_voltages == turns and owned.made.ownership.armed


@pytest.mark.parametrize("noise", [0.0, 0.5])
def test_a_stage_that_moves_before_the_first_voltage_is_commanded_by_somebody(noise):
    made = controller()
    made.ownership.listening = Listening(tuple)
    made.ownership.listening.begin(START)
    made.ownership.listening.state(START)
    for k in range(60):
        made.report(["x"], [30.0 + 0.2 * k + noise * RNG.normal()], START + 10 * k * MS)
    assert refused(made, START + 600 * MS) == STARTING
    # It stays: whoever moved it may begin again for a while.
    for k in range(60, 360):
        made.report(["x"], [42.0 + noise * RNG.normal()], START + 10 * k * MS)
        if k < 200:
            assert refused(made, START + 10 * k * MS) == STARTING
    assert abs(send(made, START + 3_600 * MS) - 42.0) <= 3.0 * noise + 0.2 + 1e-9


@pytest.mark.parametrize("noise", [0.1, 0.5, 2.0])
def test_noise_of_the_reports_before_the_first_voltage_is_no_motion(noise):
    made = controller()
    for k in range(100):
        made.report(["x"], [30.0 + noise * RNG.normal()], START + 10 * k * MS)
        assert not made.axes[0].amplifier.moves(START + 10 * k * MS)


@pytest.mark.parametrize("told", [1e3, 1e4, 5e4, 1e5, 9.9e5, -1e3])
def test_a_report_in_another_unit_starts_nothing_and_arms_nothing(told):
    made = controller()
    for k in range(5):
        made.report(["x"], [told], START + k * 5 * MS)
    assert refused(made, START + 25 * MS) == STARTING
    assert "correct its unit" in made.ownership.obstacle[1]
    owned = Owned()
    owned.run(0.3)
    owned.foreign, owned.there = True, told
    owned.run(0.5)
    assert not owned.made.ownership.armed and "correct its unit" in owned.made.arm(owned.now_ns)


def test_reports_that_ended_before_do_not_arm():
    owned = Owned()
    owned.run(0.3)
    owned.foreign, owned.there = True, 20.0
    owned.run(0.5)
    assert not owned.made.ownership.armed
    assert "no steady voltage" in owned.made.arm(owned.now_ns + 500 * MS)


def test_reports_that_end_while_voltages_go_on_are_missed():
    amplifier = Amplifier(SPAN)
    amplifier.begin(0.0, START)
    amplifier.report(0.0, START)
    for k in range(2000):
        amplifier.output(0.01 * k, START + k * MS)
        assert amplifier.silent == (k > 1000)


def test_uneven_motion_is_no_noise_of_the_reports():
    amplifier = Amplifier(SPAN)
    for k in range(20):
        amplifier.report(50.0 + 20.0 * (-1) ** k, START + 5 * k * MS)
    assert amplifier.scatter <= 0.02 * SPAN


# Others who are found late


class Heard:
    """A compensator that listens, its stage, and others that the middleware may not have found yet."""

    def __init__(self, left=None, at=30.0):
        self.made, self.now_ns, self.at, self.others = controller(), START, at, []
        self.listening = self.made.ownership.listening = Listening(lambda: self.others)
        self.listening.begin(START)
        self.made.ownership.left = left
        self.listening.state(START)

    def moves(self, seconds):
        """Report and send for some time; return whether a voltage was output."""
        moved = False
        for _ in range(round(seconds * 100)):
            self.now_ns += 10 * MS
            self.made.report(["x"], [self.at], self.now_ns)
            self.made.locate(self.now_ns)
            with suppress(RejectedError):
                self.at = send(self.made, self.now_ns)
                moved = True
        return moved


@pytest.mark.parametrize(
    ("left", "seconds"), [({"x": 30.5}, 0.5), ({"x": 33.0}, 3.5), ({"y": 30.0}, 3.5), ({}, 3.5), (None, 3.5)]
)
def test_where_this_node_left_the_stage_it_looks_earlier(left, seconds):
    heard = Heard(left)
    assert not heard.moves(seconds - 0.02) and heard.moves(0.2)


def test_somebody_who_was_there_before_is_found_late():
    heard = Heard({"x": 30.0})
    assert heard.moves(1.0)
    heard.listening.hear(heard.now_ns)
    assert not heard.moves(0.5) and heard.made.ownership.armed
    assert heard.made.ownership.obstacle[0] == STARTING
    # It never was the only one: without ~/arm it begins when the other one is silent.
    assert heard.moves(2.0) and heard.made.ownership.owned
    # Later, somebody has begun beside it: the reports tell whether the stage goes elsewhere.
    heard.moves(2.0)
    assert heard.listening.may_end(heard.now_ns, heard.made.ownership.begun_ns)
    heard.listening.end()
    heard.listening.hear(heard.now_ns)
    assert heard.moves(1.0) and heard.made.ownership.owned


def test_two_that_begin_at_once_give_way_and_one_of_them_begins():
    random.seed(3)
    one, other = Heard(), Heard()
    at, said = 30.0, []
    for k in range(1000):
        spoken = []
        for each in (one, other):
            each.at = at
            if each.moves(0.01):
                spoken.append(each)
        for each in spoken:
            # What is said is heard 50 ms later.
            said.append((k + 5, other if each is one else one))
            at = each.at
        for due, listener in said:
            if due == k:
                listener.listening.hear(listener.now_ns)
    assert one.made.ownership.owned != other.made.ownership.owned


def test_a_publisher_that_has_said_nothing_yet_is_waited_for():
    made = controller(saved=SAVED_AT)
    for k in range(1, 10):
        assert refused(made, START + k * SECOND) == STARTING
    made.report([], [], START + 10 * SECOND)
    assert refused(made, START + 12 * SECOND) == STARTING
    # It has no voltage of this axis.
    assert abs(send(made, START + 13 * SECOND) - 32.0) <= 0.2 + 1e-9
