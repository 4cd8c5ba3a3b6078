"""Blocks of voltages, judged by the log of the simulated device: played by its clock, or streamed."""

import re
import threading
import time
from collections import deque

import numpy as np
import pytest
from drivers.kinds import KINDS
from hypothesis import given
from hypothesis import strategies as st

from slpi_ros.devices.block import BlockPhase, BlockState, block_state, refusal
from slpi_ros.devices.link import State
from slpi_ros.devices.loop import DeviceLoop
from slpi_ros.devices.writer import LoopSettings
from slpi_ros.drivers import gcs_waves, labjack, nidaqmx, stream
from slpi_ros.io.messages import TrajectoryArrays
from slpi_ros.model.limits import Limits
from slpi_ros.simulation.devices.base import LOST, SILENT, Fault

RATE, SLEW = 500.0, 2000.0
# Largest step (V) of a cycle that may be late by one, and what a difference of two voltages is rounded by.
MOST_STEP = SLEW * 2.0 / RATE * (1.0 + 1e-12)


class Bench:
    """A loop with a simulated device, on the clock of the device or on one of the test."""

    def __init__(self, kind, simulator, real=True, **settings):
        self.kind, self.simulator, self.readings, self.states = kind, simulator, [], deque()
        self._now_ns = None if real else 10**12
        self.begin = {axis: simulator.voltage(axis) for axis in simulator.axes}
        axes = tuple(f"a{number}" for number in range(len(simulator.axes)))
        given = LoopSettings(axes, (Limits(0.0, 100.0, SLEW),) * len(axes), RATE, **settings)
        self.axes = axes
        self.loop = DeviceLoop(kind.make(simulator), given, self.readings.append, self.now_ns)
        self.loop.blocks.states = self.states

    def now_ns(self):
        return time.monotonic_ns() if self._now_ns is None else self._now_ns

    def turn(self, times=1):
        for _ in range(times):
            if self._now_ns is not None:
                self._now_ns += int(1e9 / RATE)
            else:
                # The simulated device is in this process.
                time.sleep(1e-3)
            self.loop.turn()

    def until(self, done, most=20_000, lost=False):
        for _ in range(most):
            if done():
                return
            self.turn()
            assert lost or self.loop.status.state is not State.LOST, self.loop.status.reason
        raise AssertionError(f"in vain; {self.loop.status}, {self.told}")

    @property
    def told(self):
        """What was told, one after the other; how far a block is is told again and again."""
        phases = [state.phase for state in self.states]
        return [phase for phase, before in zip(phases, [None, *phases], strict=False) if phase is not before]

    def submit(self, voltages, period, names=None, stamp=7, first=0.0):
        voltages = np.asarray(voltages, float)
        times = np.round((first + np.arange(len(voltages)) * period) * 1e9).astype(np.int64)
        self.loop.blocks.submit(TrajectoryArrays(stamp, names or self.axes[: voltages.shape[1]], times, voltages))

    def path(self, place=0):
        axis = self.simulator.axes[place]
        own = [each.voltage for each in self.simulator.log if each.axis == axis]
        return self.kind.gain * np.array([self.begin[axis], *own])

    @property
    def largest_step(self):
        return max(float(np.abs(np.diff(self.path(place))).max(initial=0.0)) for place in range(len(self.axes)))


@pytest.fixture
def bench(request, monkeypatch):
    # The simulated device is in this process, and on a busy machine it may be late.
    for module in (stream, labjack, nidaqmx):
        monkeypatch.setattr(module, "TIMEOUT", 2.0)
    name, axes, voltages, real, *rest = request.param
    kind = KINDS[name]
    with kind.simulate(axes, voltages, **(rest[0] if rest else {})) as simulator:
        made = Bench(kind, simulator, real)
        made.turn()
        yield made
        made.loop._device.close()


def wave(count, period, *begin, frequency=5.0, size=10.0):
    t = np.arange(count) * period
    return np.stack([v + size * (1.0 - np.cos(2 * np.pi * frequency * t)) for v in begin], 1)


@pytest.mark.parametrize("bench", [("gcs", 2, [20.0, 30.0], True), ("nidaqmx", 2, [20.0, 30.0], True)], indirect=True)
@pytest.mark.parametrize("count", [4000, pytest.param(20_000, marks=pytest.mark.long)])
def test_a_device_plays_a_block_by_its_clock_bit_for_bit(bench, count):
    period = 5e-5
    v = wave(count, period, 20.0, 30.0)
    bench.submit(v, period)
    bench.until(lambda: bench.loop.blocks.recorded)
    assert bench.told[:2] == [BlockPhase.ACCEPTED, BlockPhase.PLAYING] and bench.told[-1] is BlockPhase.ENDED
    assert bench.states[-1].sample == count and {state.stamp_ns for state in bench.states} == {7}
    for place, axis in enumerate(bench.simulator.axes):
        played = [each for each in bench.simulator.log if each.axis == axis]
        changed = np.flatnonzero(np.diff(v[:, place])) + 1
        np.testing.assert_array_equal([each.voltage for each in played], v[changed, place] * (1.0 / bench.kind.gain))
        times = np.array([each.time_ns for each in played])
        np.testing.assert_array_equal(times - times[0], (changed - changed[0]) * 50_000)
    recording = bench.loop.blocks.recorded[0].recording
    np.testing.assert_allclose(recording.times, np.arange(count) * period, atol=1e-12)
    np.testing.assert_allclose(recording.voltages, v, atol=1e-8)
    # The positions are those of the simulated stage, and the states went on meanwhile.
    assert np.ptp(recording.positions[:, 0]) > 1e-7 and np.corrcoef(recording.positions[:, 0], v[:, 0])[0, 1] > 0.9
    assert len(bench.readings) > 2
    # Afterwards single voltages go on from its end.
    assert bench.loop.command(v[-1].tolist()) == ""
    bench.turn(5)
    assert bench.loop.status.state is State.ARMED
    assert bench.largest_step <= MOST_STEP + 2.0 * bench.kind.rounding


@pytest.mark.parametrize(
    "bench",
    [("labjack", 2, [20.0, 30.0], False), ("gcs", 2, [20.0, 30.0], False, {"without": ("WAV",)})],
    indirect=True,
)
def test_where_a_device_cannot_it_is_streamed(bench):
    v = wave(200, 2e-3, 20.0, 30.0)
    bench.submit(v, 2e-3)
    bench.until(lambda: bench.loop.blocks.recorded)
    assert bench.told[-1] is BlockPhase.ENDED and "streamed" in bench.states[0].reason
    assert bench.largest_step <= MOST_STEP + 2.0 * bench.kind.rounding
    np.testing.assert_allclose(bench.path()[-1], v[-1, 0], atol=1e-4)
    recording = bench.loop.blocks.recorded[0].recording
    assert np.ptp(recording.positions[:, 1]) > 1e-7


@pytest.mark.parametrize("bench", [("gcs", 2, [20.0, 30.0], False)], indirect=True)
@pytest.mark.parametrize(
    ("voltages", "names", "named"),
    [
        ([[20.0], [101.0]], None, "sample 1.*101 V"),
        ([[20.0], [-1.0]], None, "-1 V"),
        ([[20.0], [90.0]], None, "slew_limit"),
        ([[40.0], [40.0]], None, "begins at 40 V, but the device is at 20 V"),
        ([[20.0], [np.nan]], None, "finite"),
        ([[20.0]], ("z",), "'z'"),
        ([[20.0, 30.0]], ("a0", "a0"), "once"),
        ([[20.0]], ("a0", "a1"), "shape"),
    ],
)
def test_what_is_refused_moves_nothing(bench, voltages, names, named):
    bench.submit(voltages, 2e-3, names)
    bench.turn(3)
    (state,) = bench.states
    assert state.phase is BlockPhase.REFUSED and re.search(named, state.reason)
    assert bench.simulator.log == [] and not [each for each in bench.simulator.received if each.startswith("W")][1:]


ONE = LoopSettings(("x",), (Limits(0.0, 100.0, 1000.0),), RATE)


@given(
    st.lists(st.floats(0.0, 100.0), min_size=1, max_size=5), st.sampled_from([50_000, 2_000_000, 33_333_333]),
    st.integers(0, 10**12),
)  # fmt: skip
def test_the_time_of_the_first_sample_lets_it_go_no_further(voltages, period_ns, first_ns):
    """A device that plays a block by its clock begins with it at once."""
    times, v = np.arange(len(voltages)) * period_ns, np.array(voltages)[:, None]
    refused = {refusal(TrajectoryArrays(7, ("x",), first + times, v), ONE, [50.0]) for first in (0, first_ns)}
    assert len(refused) == 1
    assert ("begins at" in refused.pop()) == (abs(voltages[0] - 50.0) > 1000.0 * 2.0 / RATE * (1.0 + 1e-3) + 1e-6)


# Played by the device's clock, streamed as the samples are not even, and by a device that plays none.
@pytest.mark.parametrize(
    ("bench", "uneven"),
    [
        (("gcs", 1, [20.0], True), False),
        (("gcs", 1, [20.0], False), True),
        (("nidaqmx", 1, [20.0], True), False),
        (("labjack", 1, [20.0], False), False),
    ],
    indirect=["bench"],
)
def test_a_block_with_a_later_first_sample_keeps_the_limits_at_the_wire(bench, uneven):
    far, near = np.full((200, 1), 90.0), np.full((200, 1), 20.0 + 0.9 * SLEW * 2.0 / RATE)
    for v, first in ((far, 0.1), (near, 0.1)):
        v[-1] += 1e-3 * uneven
        times = np.round((first + np.arange(200) * 2e-3) * 1e9).astype(np.int64)
        times[-1] += 10**6 * uneven
        bench.loop.blocks.submit(TrajectoryArrays(7, ("a0",), times, v))
        bench.turn(3)
        if v is far:
            assert bench.told == [BlockPhase.REFUSED] and "begins at 90 V" in bench.states[0].reason
            assert bench.simulator.log == []
    bench.until(lambda: bench.told[-1] is BlockPhase.ENDED)
    assert ("streamed" in bench.states[1].reason) == (uneven or bench.kind.device == "labjack")
    np.testing.assert_allclose(bench.path()[-1], near[-1], atol=1e-4)
    assert bench.largest_step <= MOST_STEP + 2.0 * bench.kind.rounding


@pytest.mark.parametrize("bench", [("gcs", 2, [20.0, 30.0], False)], indirect=True)
def test_times_that_do_not_increase(bench):
    bench.loop.blocks.submit(TrajectoryArrays(7, ("a0",), np.array([0, 0]), np.array([[20.0], [20.0]])))
    bench.turn(2)
    assert bench.told == [BlockPhase.REFUSED]


@pytest.mark.parametrize(
    "bench", [(name, 2, [20.0, 30.0], True) for name in ("gcs", "labjack", "nidaqmx")], indirect=True
)
@pytest.mark.parametrize("how", ["stop", "empty"])
def test_stopped_it_holds_where_it_is(bench, how):
    # Long enough that it does not end by itself meanwhile.
    count, period = 40_000, 5e-4
    v = wave(count, period, 20.0, 30.0)
    bench.submit(v, period)
    bench.until(lambda: bench.simulator.log)
    assert "block" in bench.loop.command([20.0, 30.0])
    bench.submit(v, period, stamp=8)
    bench.until(lambda: [state for state in bench.states if state.stamp_ns == 8])
    assert [state.phase for state in bench.states if state.stamp_ns == 8] == [BlockPhase.REFUSED]
    if how == "stop":
        bench.loop.request("stop")
    else:
        bench.submit(np.zeros((0, 2)), period)
    bench.until(lambda: bench.told[-1] is BlockPhase.STOPPED)
    sample, there = bench.states[-1].sample, bench.kind.volts(bench.simulator)
    assert 0 < sample < count
    # Streamed, it lags behind by a cycle.
    np.testing.assert_allclose(there, v[sample - 1], atol=1e-5 if bench.loop._device.block_period else 2.0)
    bench.turn(20)
    assert bench.kind.volts(bench.simulator) == there
    if how == "stop":
        what, success, text = bench.loop.answers.popleft()
        assert success and f"sample {sample} of {count}" in text and bench.loop.status.state is State.HELD
    else:
        assert bench.loop.status.state is State.ARMED
        bench.loop.command([20.0, 30.0])
        bench.until(lambda: bench.kind.volts(bench.simulator) == pytest.approx([20.0, 30.0], abs=1e-4))
    assert bench.largest_step <= MOST_STEP + 2.0 * bench.kind.rounding


@pytest.mark.parametrize("bench", [("gcs", 1, [20.0], True), ("nidaqmx", 1, [20.0], True)], indirect=True)
def test_the_next_block_may_follow_as_soon_as_the_last_one_is_stopped(bench):
    """It waits until what was recorded has been read, says so, and can be stopped meanwhile."""
    bench.submit(wave(40_000, 5e-4, 20.0), 5e-4)
    # So long that its recording is read in several pieces.
    bench.until(lambda: bench.states and bench.states[-1].sample > 1500)
    bench.submit(np.zeros((0, 1)), 5e-4)
    bench.turn()
    assert bench.told[-1] is BlockPhase.STOPPED
    there = bench.kind.volts(bench.simulator)[0]
    assert there == pytest.approx(bench.loop.written[0], abs=2e-6)
    for stamp in (8, 9):
        bench.submit(np.linspace(there, there + 1.0, 100)[:, None], 5e-4, stamp=stamp)
        if stamp == 8:
            bench.submit(np.zeros((0, 1)), 5e-4)
    assert "block" in bench.loop.command([20.0])
    bench.until(lambda: bench.told[-1] is BlockPhase.ENDED)
    assert [state.phase for state in bench.states if state.stamp_ns == 8] == [BlockPhase.ACCEPTED, BlockPhase.STOPPED]
    later = [state.phase for state in bench.states if state.stamp_ns == 9]
    assert later[0] is BlockPhase.ACCEPTED and later[-1] is BlockPhase.ENDED
    assert len(bench.loop.blocks.recorded) >= 1
    assert bench.kind.volts(bench.simulator)[0] == pytest.approx(there + 1.0, abs=1e-9)
    assert bench.largest_step <= MOST_STEP + 2.0 * bench.kind.rounding


@pytest.mark.parametrize("bench", [("gcs", 1, [20.0], True), ("nidaqmx", 1, [20.0], True)], indirect=True)
def test_one_that_is_stopped_before_it_begins_leaves_the_device_at_work(bench):
    bench.submit(wave(2000, 5e-4, 20.0), 5e-4)
    bench.turn()
    bench.submit(np.zeros((0, 1)), 5e-4)
    bench.turn(2)
    assert bench.told == [BlockPhase.ACCEPTED, BlockPhase.STOPPED] and bench.simulator.log == []
    assert bench.loop.command([25.0]) == ""
    bench.until(lambda: bench.kind.volts(bench.simulator) == pytest.approx([25.0], abs=1e-4))
    bench.submit(wave(200, 5e-4, 25.0), 5e-4)
    bench.until(lambda: bench.told[-1] is BlockPhase.ENDED)
    assert bench.largest_step <= MOST_STEP + 2.0 * bench.kind.rounding


@pytest.mark.parametrize(
    "bench", [("gcs", 1, [20.0], False), ("gcs", 1, [20.0], False, {"without": ("WAV",)})], indirect=True
)
def test_a_device_that_somebody_else_moves_plays_no_block(bench):
    """Neither one that is being loaded, nor one that is streamed; after ~/arm nothing of it is left."""
    # Loaded for longer than the time after which the device is held; streamed, it writes nothing while it rests.
    bench.submit(np.full((40_000, 1), 20.0), 2e-3)
    bench.turn()
    bench.simulator.set_by_hand("1", 40.0)
    bench.until(lambda: bench.loop.status.state is State.HELD)
    assert bench.told[-1] is BlockPhase.STOPPED and bench.states[-1].reason == bench.loop.status.reason
    assert not bench.loop.blocks.moving
    bench.loop.request("arm")
    bench.turn(50)
    assert bench.loop.status.state is State.ARMED and bench.kind.volts(bench.simulator) == [40.0]


def test_a_long_load_is_told_again_and_again():
    with KINDS["gcs"].simulate(voltages=[20.0]) as simulator:
        bench = Bench(KINDS["gcs"], simulator, real=False)
        bench.turn()
        bench.submit(wave(40_000, 5e-4, 20.0), 5e-4)
        bench.turn(round(0.3 * RATE))
        assert bench.told == [BlockPhase.ACCEPTED] and 5 <= len(bench.states) <= 8
        bench.loop._device.close()


@pytest.mark.parametrize(
    ("message", "values", "told"),
    [
        ("playing", {"stamp": "7.000000012", "sample": "3", "reason": ""},
         BlockState(BlockPhase.PLAYING, 7_000_000_012, 3)),
        ("refused", {"stamp": "0.5", "sample": "0", "reason": "why"}, BlockState(BlockPhase.REFUSED, 5, 0, "why")),
        ("resting", {"stamp": "7.0", "sample": "3"}, None),
        ("playing", {"stamp": "now", "sample": "3"}, None),
        ("playing", {"stamp": "7.0", "sample": "-3"}, None),
        ("playing", {}, None),
    ],
)  # fmt: skip
def test_what_a_driver_tells_is_read(message, values, told):
    assert block_state(message, values) == told


@pytest.mark.long
@pytest.mark.parametrize("bench", [(name, 1, [20.0], True) for name in ("gcs", "labjack", "nidaqmx")], indirect=True)
@pytest.mark.parametrize("kind", [SILENT, LOST])
def test_a_link_that_is_lost_ends_the_block_here(bench, kind):
    v = wave(10_000, 5e-5, 20.0)
    bench.submit(v, 5e-5)
    bench.until(lambda: bench.simulator.log)
    bench.simulator.fault = Fault(kind, seconds=0.0)
    bench.until(lambda: bench.loop.status.state is State.LOST, lost=True)
    assert bench.told[-1] is BlockPhase.STOPPED and bench.states[-1].reason == bench.loop.status.reason
    # A device that plays on by itself is not taken over before its end.
    bench.until(lambda: bench.loop.status.state is State.HELD, most=10**7, lost=True)
    there = bench.kind.volts(bench.simulator)
    bench.turn(5)
    assert bench.kind.volts(bench.simulator) == there
    if bench.kind.device == "gcs":
        assert there == v[-1].tolist()
    assert bench.largest_step <= MOST_STEP + 2.0 * bench.kind.rounding


@pytest.mark.parametrize("bench", [("gcs", 1, [20.0], True), ("nidaqmx", 1, [20.0], True)], indirect=True)
def test_the_end_of_the_driver_stops_a_block_where_it_is(bench):
    v = wave(40_000, 5e-4, 20.0)
    bench.submit(v, 5e-4)
    thread = threading.Thread(target=bench.loop.run)
    thread.start()
    while not bench.simulator.log:
        time.sleep(1e-3)
    bench.loop.end()
    thread.join()
    assert bench.told[-1] is BlockPhase.STOPPED and 0 < bench.states[-1].sample < len(v)
    there = bench.kind.volts(bench.simulator)
    assert there == pytest.approx(v[bench.states[-1].sample - 1].tolist(), abs=1e-9)
    bench.simulator.move()
    assert bench.kind.volts(bench.simulator) == there


def test_a_controller_without_these_parameters_is_used_without_blocks(monkeypatch):
    monkeypatch.setattr(gcs_waves, "WAVE_POINTS", "0x13000099")
    with KINDS["gcs"].simulate(voltages=[20.0]) as simulator:
        device = KINDS["gcs"].make(simulator)
        simulator.fail(10)
        assert any("10" in note for note in device.open().notes) and device.block_period == 0.0
        device.write([21.0])
        device.close()


@pytest.mark.parametrize("bench", [("gcs", 1, [20.0], False)], indirect=True)
def test_while_it_is_held_nothing_is_played(bench):
    bench.loop.request("stop")
    bench.turn()
    bench.submit([[20.0], [20.0]], 2e-3)
    bench.turn()
    assert bench.told == [BlockPhase.REFUSED] and "~/arm" in bench.states[-1].reason
