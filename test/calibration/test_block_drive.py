"""A drive as one block: what a driver tells of it, and how it is stopped and brought back, judged at the amplifier."""

from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slpi_ros.calibration.block_drive import BlockDrive
from slpi_ros.devices.block import BlockPhase, BlockState
from slpi_ros.excitation.drives import Playback, excite
from slpi_ros.model.limits import Limits

RATE, SLEW, LOOK, DURATION = 100.0, 400.0, 0.02, 12.0
LIMITS = (Limits(0.0, 100.0, SLEW),)


@cache
def drive_from(rest):
    given = {"slew_limit": 0.8 * SLEW, "duration": DURATION, "rate": RATE}
    return excite(voltage_min=0.0, voltage_max=100.0, start=rest, **given)


class Amplifier:
    """A driver with an amplifier: plays blocks by its own clock, tells how far it is, and reports its voltage."""

    def __init__(self, tells=True, reports=True, heeds_stop=True, refuses=(), late=0.15, rest=0.0, noise=0.0):
        self.tells, self.reports, self.heeds_stop, self.refuses = tells, reports, heeds_stop, refuses
        self.late, self.v, self.now, self.noise = late, rest, 0.0, noise
        self.path, self.blocks, self.stops, self.silent = [rest], [], 0, False
        self._block = self._begun = None
        self._states = []
        self._rng = np.random.default_rng(1)
        self.playback = Playback(drive_from(rest))
        self.drive = BlockDrive(self.playback, LIMITS, self.send, 10**12, expected=tells)

    def send(self, voltages):
        if not len(voltages):
            self.stops += 1
            if self.heeds_stop and self._block is not None:
                self.end(BlockPhase.STOPPED, "by an empty trajectory")
            return 0
        self.blocks.append(voltages)
        if len(self.blocks) in self.refuses:
            self.tell(BlockPhase.REFUSED, 0, "it is held")
        else:
            self._block, self._begun = voltages[:, 0], self.now + self.late
            self.tell(BlockPhase.ACCEPTED, 0)
        return len(self.blocks)

    def tell(self, phase, sample, reason=""):
        if self.tells and not self.silent:
            self._states.append(BlockState(phase, len(self.blocks), sample, reason))

    def end(self, phase, reason=""):
        self.tell(phase, self.sample, reason)
        self._block = None

    @property
    def sample(self):
        return int(np.clip((self.now - self._begun) * RATE + 1e-6, 0, len(self._block)))

    def turn(self, seconds=LOOK):
        """Go on by the period of a look."""
        for _ in range(round(seconds * RATE)):
            self.now += 1.0 / RATE
            if self._block is not None and self.sample:
                self.v = self._block[self.sample - 1]
                self.path.append(self.v)
                if self.sample == len(self._block):
                    self.end(BlockPhase.ENDED)
                else:
                    self.tell(BlockPhase.PLAYING, self.sample)
        told, self._states = self._states, []
        for state in told:
            self.drive.hear(state)
        if self.reports:
            self.drive.report([self.v + self.noise * self._rng.normal()])
        self.drive.look(10**12 + round(self.now * 1e9))

    def until(self, done, most=60.0):
        while not done():
            self.turn()
            assert self.now < most, (self.drive.failure, self.v)
        return self.drive

    def until_over(self):
        return self.until(lambda: self.drive.over)

    def until_stopped_at(self, seconds):
        """Stop it then, and wait for what becomes of that."""
        self.until(lambda: self.now >= seconds)
        self.drive.stop()
        return self.until_over()

    @property
    def largest_step(self):
        return np.abs(np.diff(self.path)).max(initial=0.0)


def test_it_is_over_when_the_driver_tells_its_end():
    # By the time alone it were over earlier.
    amplifier = Amplifier(late=1.5)
    drive = amplifier.until_over()
    assert not drive.failure and not drive.stopped and drive.told
    assert amplifier.now > DURATION + 1.5 and len(amplifier.blocks) == 1 and amplifier.v == 0.0


def test_one_that_is_refused_fails_with_the_reason_of_the_driver():
    amplifier = Amplifier(refuses=(1,))
    assert "it is held" in amplifier.until_over().failure and amplifier.now < 0.1
    assert len(amplifier.blocks) == 1 and not amplifier.stops


@given(st.floats(0.1, DURATION - 0.1), st.sampled_from([0.0, 30.0, 100.0]), st.booleans(), st.booleans())
def test_stopped_it_returns_from_where_the_driver_holds(seconds, rest, tells, reports):
    amplifier = Amplifier(tells=tells, reports=reports or not tells, rest=rest, noise=0.01)
    drive = amplifier.until_stopped_at(seconds)
    assert not drive.failure and drive.stopped and amplifier.stops == 1
    assert amplifier.v == pytest.approx(rest, abs=1e-9)
    assert len(amplifier.blocks) == 2
    # The noise of the report is in the first step.
    assert amplifier.largest_step <= SLEW / RATE + 0.1
    assert amplifier.now < seconds + 4.0


def test_the_return_waits_until_a_late_report_rests():
    amplifier = Amplifier()
    amplifier.until(lambda: amplifier.now >= 2.0)
    held, amplifier.reports = amplifier.v, False
    amplifier.drive.stop()
    for late in np.linspace(held - 40.0, held, 30):
        amplifier.drive.report([late])
        amplifier.turn()
        assert len(amplifier.blocks) == 1
    amplifier.reports = True
    assert not amplifier.until_over().failure
    assert amplifier.largest_step <= SLEW / RATE


def test_one_that_the_driver_stops_stays_where_it_is():
    amplifier = Amplifier()
    amplifier.until(lambda: amplifier.now >= 2.0)
    amplifier.end(BlockPhase.STOPPED, "by ~/stop")
    drive, there = amplifier.until_over(), amplifier.v
    assert "by ~/stop" in drive.failure and not drive.stopped
    amplifier.turn(1.0)
    assert amplifier.v == there != 0.0 and len(amplifier.blocks) == 1


def test_without_a_driver_that_tells_the_time_decides():
    amplifier = Amplifier(tells=False, reports=False, late=0.0)
    drive = amplifier.until_over()
    assert not drive.failure and not drive.told and amplifier.now == pytest.approx(DURATION, abs=0.1)


def test_a_driver_that_does_not_answer_or_falls_silent_is_named():
    amplifier = Amplifier()
    amplifier.silent = True
    amplifier._states.clear()
    assert "no driver answers" in amplifier.until_over().failure
    amplifier = Amplifier(heeds_stop=False)
    amplifier.until(lambda: amplifier.now >= 2.0)
    amplifier.silent = True
    drive = amplifier.until_over()
    assert "no longer tells" in drive.failure and "stop is not confirmed" in drive.failure
    assert len(amplifier.blocks) == 1 and amplifier.stops == 1


@pytest.mark.parametrize(
    ("given", "says"),
    [
        # It plays on and says so; it plays on and says nothing; nobody says anything at all.
        ({"heeds_stop": False}, "does not tell that the drive has stopped"),
        ({"heeds_stop": False, "tells": False}, "which does not rest"),
        ({"tells": False, "reports": False}, "nobody reports the voltage"),
    ],
)
def test_a_stop_that_is_not_confirmed_is_said_and_nothing_is_sent_after_it(given, says):
    amplifier = Amplifier(**given)
    assert says in amplifier.until_stopped_at(1.0).failure
    assert len(amplifier.blocks) == 1 and amplifier.stops == 1


def test_a_way_back_that_is_refused_or_not_reached_is_said():
    amplifier = Amplifier(refuses=(2,))
    drive = amplifier.until_stopped_at(1.5)
    assert "refuses the way back" in drive.failure and "it is held" in drive.failure
    amplifier = Amplifier()
    amplifier.until(lambda: amplifier.now >= 1.5)
    amplifier.drive.stop()
    amplifier.until(lambda: len(amplifier.blocks) == 2)
    amplifier.reports = False
    amplifier.drive.report([50.0])
    assert "return is not confirmed: stage_state reports 50 V" in amplifier.until_over().failure


def test_a_stage_that_falls_silent_is_not_moved():
    amplifier = Amplifier()
    amplifier.until(lambda: amplifier.now >= 1.5)
    amplifier.reports = False
    amplifier.drive.stop()
    assert "stage_state no longer comes" in amplifier.until_over().failure
    assert len(amplifier.blocks) == 1


def test_a_stop_beside_the_end_is_no_failure():
    amplifier = Amplifier()
    amplifier.until(lambda: amplifier.now >= DURATION)
    amplifier.end(BlockPhase.ENDED)
    amplifier.drive.stop()
    assert not amplifier.until_over().failure and len(amplifier.blocks) == 1


def test_a_process_that_was_held_up_takes_nothing_for_silence():
    amplifier = Amplifier()
    amplifier.until(lambda: amplifier.now >= 2.0)
    amplifier.drive.look(10**12 + round((amplifier.now + 30.0) * 1e9))
    assert not amplifier.drive.over and not amplifier.stops
