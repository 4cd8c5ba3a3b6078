"""What the driver does with a device, judged by the log of the (simulated) device; the clock is that of the test."""

import threading
from contextlib import contextmanager

import numpy as np
import pytest

from slpi_ros.devices.link import State
from slpi_ros.devices.loop import DeviceLoop
from slpi_ros.devices.writer import LoopSettings
from slpi_ros.drivers.base import Channel, DeviceError, LinkError, UnsuitableError
from slpi_ros.drivers.registry import make_device
from slpi_ros.model.limits import Limits
from slpi_ros.simulation.devices.base import FAULTS, LATE, SILENT, Fault
from slpi_ros.simulation.devices.gcs import GcsSimulator
from slpi_ros.simulation.stage import Stage

RATE, SLEW = 1000.0, 500.0
STEP = SLEW / RATE
# The longest way takes 200 cycles; so many are enough for anything.
MANY = 3000
ROUNDING = 2e-6


class Bench:
    """A loop whose cycles are those of the test, one period apart."""

    def __init__(self, simulator, limits=None, **settings):
        self.simulator, self.readings, self.now_ns = simulator, [], 10**12
        self.begin = {axis: simulator.voltage(axis) for axis in simulator.axes}
        limits = limits or [Limits(0.0, 100.0, SLEW)] * len(simulator.axes)
        device = make_device("gcs", simulator.address, [Channel(axis) for axis in simulator.axes])
        given = LoopSettings(tuple(simulator.axes), tuple(limits), RATE, **settings)
        self.loop = DeviceLoop(device, given, self.readings.append, lambda: self.now_ns)

    def turn(self, times=1):
        for _ in range(times):
            self.now_ns += int(1e9 / RATE)
            self.loop.turn()

    def turn_until(self, done):
        for _ in range(MANY):
            if done():
                return
            self.turn()
        raise AssertionError(f"in vain; {self.loop.status}")

    def reach(self, *voltages):
        """Command voltages and wait until the device is there."""
        assert self.loop.command(voltages) == ""
        self.turn_until(lambda: [self.simulator.voltage(axis) for axis in self.simulator.axes] == list(voltages))

    def answer(self, what):
        self.loop.request(what)
        self.turn()
        return self.loop.answers.popleft()

    @property
    def largest_step(self):
        """Largest step of an output in the log of the device, V."""
        paths = {
            axis: [v, *(each.voltage for each in self.simulator.log if each.axis == axis)]
            for axis, v in self.begin.items()
        }
        return max(float(np.max(np.abs(np.diff(path)), initial=0.0)) for path in paths.values())


@contextmanager
def bench(axes=("1",), limits=None, voltages=None, settings=None, **device):
    with GcsSimulator(axes, voltages=voltages, **device) as simulator:
        made = Bench(simulator, limits, **settings or {})
        try:
            yield made
        finally:
            made.loop._device.close()


def test_nothing_is_written_before_a_command():
    with bench(voltages=[37.5]) as at:
        at.turn(50)
        assert at.loop.status.state is State.ARMED and len(at.readings) == 49
        assert at.simulator.log == [] and not [line for line in at.simulator.received if line.startswith("SVA ")]


def test_the_first_voltage_starts_from_the_one_that_was_read():
    with bench(("1", "2"), voltages=[37.5, 60.0]) as at:
        at.turn()
        at.reach(90.0, 10.0)
        first = {each.axis: each.voltage for each in reversed(at.simulator.log)}
        assert abs(first["1"] - 37.5) <= 2 * STEP + ROUNDING and abs(first["2"] - 60.0) <= 2 * STEP + ROUNDING
        # After the first, steps are one period apart.
        assert at.largest_step <= 2 * STEP + ROUNDING
        assert at.readings[-1].voltages == (90.0, 10.0)


def test_a_pause_is_not_made_up():
    with bench() as at:
        at.turn()
        at.reach(20.0)
        at.now_ns += 10**10
        at.reach(60.0)
        assert at.largest_step <= 2 * STEP + ROUNDING


def test_a_voltage_that_is_reached_is_not_written_again():
    with bench() as at:
        at.turn()
        at.reach(20.0)
        written = len(at.simulator.received)
        at.loop.command([20.0])
        at.turn(10)
        assert not [line for line in at.simulator.received[written:] if line.startswith("SVA ")]


@pytest.mark.parametrize(("goal", "limit"), [(500.0, 80.0), (-500.0, 10.0)])
def test_limits_are_kept_and_told(goal, limit):
    with bench(limits=[Limits(10.0, 80.0, SLEW)], voltages=[40.0]) as at:
        at.turn()
        at.loop.command([goal])
        at.turn(300)
        assert at.simulator.voltage("1") == limit and at.loop.limited == ("1",)
        assert all(10.0 <= each.voltage <= 80.0 for each in at.simulator.log)
        at.loop.command([40.0])
        at.turn(1500)
        assert at.loop.limited == ()


def test_found_outside_it_returns_at_the_slew_limit():
    with bench(limits=[Limits(10.0, 80.0, SLEW)], voltages=[-5.0]) as at:
        at.turn(20)
        assert at.simulator.log == []
        at.loop.command([-30.0])
        at.turn(200)
        assert at.simulator.voltage("1") == 10.0
        assert at.largest_step <= 2 * STEP + ROUNDING
        assert min(each.voltage for each in at.simulator.log) > -5.0


@pytest.mark.parametrize("command", [[], [1.0, 2.0], [float("nan")], [float("inf")]])
def test_commands_that_are_none(command):
    with bench() as at:
        at.turn()
        assert at.loop.command(command) and at.loop.counts.rejected == 1
        at.turn(5)
        assert at.simulator.log == []


def test_limits_beyond_the_own_range_of_the_device():
    with bench(limits=[Limits(0.0, 130.0, SLEW)]) as at, pytest.raises(UnsuitableError, match="130 V.*120 V"):
        at.turn()


def test_a_servo_that_is_on_is_refused():
    with bench(servo=True) as at:
        with pytest.raises(UnsuitableError, match="take_over_servo"):
            at.turn()
        assert "SVO 1 0" not in at.simulator.received


def test_a_servo_is_taken_over_from_its_voltage():
    with bench(servo=True, voltages=[42.0], settings={"take_over_servo": True}) as at:
        at.turn(10)
        assert at.simulator.servo == {"1": False} and at.simulator.log == []
        at.reach(50.0)
        assert at.largest_step <= 2 * STEP + ROUNDING


def test_a_servo_that_was_switched_on_meanwhile_is_taken_over_only_by_arm():
    with bench(voltages=[42.0], settings={"take_over_servo": True}) as at:
        at.turn()
        at.simulator.servo["1"] = True
        at.loop.command([50.0])
        at.turn_until(lambda: at.loop.status.state is State.HELD)
        assert at.simulator.servo["1"] and "servo" in at.loop.status.reason and at.simulator.log == []
        assert at.answer("arm")[1]
        assert not at.simulator.servo["1"]
        at.reach(50.0)


@pytest.mark.parametrize("rearm", [False, True])
@pytest.mark.parametrize("kind", FAULTS)
def test_after_a_fault_nothing_moves_until_it_is_armed(kind, rearm):
    with bench(voltages=[20.0], settings={"rearm": rearm}) as at:
        at.turn()
        at.reach(30.0)
        at.loop.command([80.0])
        at.simulator.fault = Fault(kind, seconds=0.25 if kind == LATE else 0.0)
        at.turn_until(lambda: at.loop.status.state is State.LOST)
        assert at.simulator.address in at.loop.status.reason and at.loop.status.since > 0.0
        assert at.loop.command([80.0]) == at.loop.status.reason
        assert at.answer("arm")[1:] == (False, at.loop.status.reason)
        read = len(at.readings)
        at.turn(3)
        assert len(at.readings) == read
        at.turn_until(lambda: at.loop.status.state is not State.LOST)
        there = at.simulator.voltage("1")
        at.turn(20)
        assert len(at.readings) >= read + 19 and at.simulator.voltage("1") == there
        if rearm:
            assert at.loop.status.state is State.ARMED
        else:
            assert at.loop.status.state is State.HELD and "~/arm" in at.loop.status.reason
            assert at.loop.command([80.0]) == at.loop.status.reason
            assert at.answer("arm")[1]
        at.reach(80.0)
        assert at.largest_step <= 2 * STEP + ROUNDING
        assert at.loop.counts.losses == 1


def test_it_goes_on_from_where_the_device_is_after_a_lost_link():
    with bench(voltages=[20.0], settings={"rearm": True}) as at:
        at.turn()
        at.reach(30.0)
        at.simulator.fault = Fault(SILENT)
        at.turn()
        at.simulator.set_by_hand("1", 70.0)
        at.turn_until(lambda: at.loop.status.state is State.ARMED)
        moved = len(at.simulator.log)
        at.reach(60.0)
        path = [70.0, *(each.voltage for each in at.simulator.log[moved:])]
        assert np.max(np.abs(np.diff(path))) <= 2 * STEP + ROUNDING


def test_somebody_else_moves_the_device():
    with bench() as at:
        at.turn()
        at.reach(30.0)
        at.simulator.set_by_hand("1", 45.0)
        at.turn_until(lambda: at.loop.status.state is State.HELD)
        assert "45 V" in at.loop.status.reason and "30 V" in at.loop.status.reason
        assert at.simulator.log[-1].voltage == 45.0
        assert at.answer("arm")[1] and at.loop._writer.written == (45.0,)


def test_a_command_that_is_not_in_volts_is_found_by_the_first_moves():
    """At 0 V an opening cannot tell."""
    with bench(units_per_volt=0.25) as at:
        at.turn()
        at.loop.command([20.0])
        at.turn_until(lambda: at.loop.status.state is State.HELD)
        assert "volts" in at.loop.status.reason


def test_stop_holds_until_arm():
    with bench() as at:
        at.turn()
        at.loop.command([80.0])
        at.turn(20)
        what, success, text = at.answer("stop")
        there = at.simulator.voltage("1")
        assert (what, success) == ("stop", True) and f"{there:g} V" in text
        assert at.loop.command([80.0])
        at.turn(20)
        assert at.simulator.voltage("1") == there
        assert at.answer("arm")[1] and at.answer("arm")[1]
        at.turn(5)
        assert at.simulator.voltage("1") == there
        at.reach(80.0)
        assert at.largest_step <= 2 * STEP + ROUNDING


def test_killed_and_started_again():
    with bench(voltages=[20.0]) as at:
        at.turn()
        at.loop.command([80.0])
        at.turn(60)
        there = at.simulator.voltage("1")
        # The system closes the connection of a process that was killed.
        at.loop._device.close()
        again = Bench(at.simulator)
        again.begin = at.begin
        again.turn(20)
        assert at.simulator.voltage("1") == there
        again.reach(10.0)
        assert again.largest_step <= 2 * STEP + ROUNDING
        again.loop._device.close()


def test_the_first_opening_fails():
    with bench() as at:
        at.simulator.close()
        with pytest.raises(LinkError):
            at.loop.run()


@pytest.mark.parametrize(("rest", "end"), [(None, 30.0), ((5.0,), 5.0)])
def test_the_end(rest, end):
    with GcsSimulator(voltages=[30.0]) as simulator:
        device = make_device("gcs", simulator.address, [Channel("1")])
        settings = LoopSettings(("x",), (Limits(0.0, 100.0, SLEW),), RATE, rest=rest)
        loop = DeviceLoop(device, settings, lambda _: None)
        thread = threading.Thread(target=loop.run)
        thread.start()
        while loop.counts.cycles < 20:
            pass
        loop.end()
        thread.join()
        assert simulator.voltage("1") == end
        path = [30.0, *(each.voltage for each in simulator.log)]
        assert np.max(np.abs(np.diff(path)), initial=0.0) <= 2 * STEP + ROUNDING


def test_the_end_while_the_link_is_lost():
    with GcsSimulator(voltages=[30.0]) as simulator:
        device = make_device("gcs", simulator.address, [Channel("1")])
        settings = LoopSettings(("x",), (Limits(0.0, 100.0, SLEW),), RATE, rest=(5.0,))
        loop = DeviceLoop(device, settings, lambda _: None)
        thread = threading.Thread(target=loop.run)
        thread.start()
        while loop.counts.cycles < 20:
            pass
        simulator.fault = Fault(SILENT, times=1000)
        loop.end()
        thread.join()
        assert simulator.voltage("1") > 5.0 and loop.status.state is State.LOST


def test_errors_of_devices_are_shown_as_one_line():
    assert "\n" not in str(DeviceError("gcs host: it sent '\n\x1b[2J'"))


SILENCE = 0.5
QUIET = int(SILENCE * RATE)


def rules(at):
    return {found.rule for found in at.loop.monitor.standing}


@pytest.mark.parametrize("rearm", [False, True])
def test_a_silence_of_the_commands_holds_and_is_told_until_the_next_one(rearm):
    with bench(voltages=[20.0], settings={"silence": SILENCE, "rearm": rearm}) as at:
        at.turn(3 * QUIET)
        assert rules(at) == set()
        at.reach(30.0)
        at.turn(QUIET // 2)
        assert rules(at) == set()
        at.turn(QUIET)
        assert rules(at) == {"commands"} and at.loop.status.armed
        assert at.simulator.voltage("1") == 30.0
        at.reach(40.0)
        at.turn(60)
        assert rules(at) == set()


def test_a_way_that_is_not_at_its_end_is_held_where_it_is():
    with bench(limits=[Limits(0.0, 100.0, 50.0)], voltages=[20.0], settings={"silence": SILENCE}) as at:
        at.turn()
        assert at.loop.command([100.0]) == ""
        at.turn(2 * QUIET)
        reached = at.simulator.voltage("1")
        assert 20.0 + 50.0 * SILENCE <= reached <= 20.0 + 50.0 * (SILENCE + 0.1)
        at.turn(QUIET)
        assert at.simulator.voltage("1") == reached


def test_commands_that_are_rejected_do_not_break_a_silence():
    with bench(settings={"silence": SILENCE}) as at:
        at.turn()
        at.reach(10.0)
        for _ in range(2 * QUIET):
            assert at.loop.command([float("nan")])
            at.turn()
        assert rules(at) == {"commands"}


def test_without_a_timeout_silence_is_no_matter():
    with bench(settings={"silence": 0.0, "silence_rest": (0.0,)}) as at:
        at.turn()
        at.reach(10.0)
        at.turn(10 * QUIET)
        assert rules(at) == set() and at.simulator.voltage("1") == 10.0


def test_rest_after_a_silence_keeps_the_slew_limit_and_then_needs_to_be_armed(monkeypatch):
    # On a busy machine the simulated device may answer late, which is another reason to hold.
    monkeypatch.setattr("slpi_ros.drivers.stream.TIMEOUT", 5.0)
    with bench(voltages=[20.0], settings={"silence": SILENCE, "silence_rest": (5.0,)}) as at:
        at.turn()
        at.reach(80.0)
        at.turn_until(lambda: at.simulator.voltage("1") < 75.0)
        assert at.loop.status.state is State.HELD and "no voltage_command" in at.loop.status.reason
        assert "~/arm" in at.loop.command([50.0])
        assert 5.0 < at.simulator.voltage("1") < 80.0
        at.turn_until(lambda: at.simulator.voltage("1") == 5.0)
        at.turn(QUIET)
        assert at.loop.command([50.0]) and at.simulator.voltage("1") == 5.0
        assert at.answer("arm")[1]
        at.turn(3 * QUIET)
        # Armed anew, nothing is awaited before the first command.
        assert rules(at) == set() and at.loop.status.armed
        at.reach(50.0)
        assert at.largest_step <= 2.0 * STEP + ROUNDING


def test_with_rearm_the_next_command_is_taken_on_the_way_to_rest():
    with bench(voltages=[20.0], settings={"silence": SILENCE, "silence_rest": (5.0,), "rearm": True}) as at:
        at.turn()
        at.reach(80.0)
        at.turn_until(lambda: at.simulator.voltage("1") < 75.0)
        assert at.loop.status.armed and rules(at) == {"commands"}
        assert 5.0 < at.simulator.voltage("1") < 80.0
        at.reach(70.0)
        at.turn_until(lambda: at.simulator.voltage("1") == 5.0)
        assert at.largest_step <= 2.0 * STEP + ROUNDING


def test_a_stop_and_an_arming_on_the_way_to_rest_stay_there():
    for what in ("stop", "arm"):
        with bench(voltages=[20.0], settings={"silence": SILENCE, "silence_rest": (5.0,)}) as at:
            at.turn()
            at.reach(80.0)
            at.turn_until(lambda: at.simulator.voltage("1") < 75.0)
            assert at.answer(what)[1]
            there = at.simulator.voltage("1")
            at.turn(QUIET)
            assert at.simulator.voltage("1") == there > 5.0


def test_a_lost_link_ends_the_way_to_rest():
    with bench(voltages=[20.0], settings={"silence": SILENCE, "silence_rest": (5.0,)}) as at:
        at.turn()
        at.reach(80.0)
        at.turn_until(lambda: at.simulator.voltage("1") < 75.0)
        at.simulator.fault = Fault(SILENT)
        at.turn()
        assert at.loop.status.lost
        there = at.simulator.voltage("1")
        at.turn_until(lambda: at.loop.status.state is State.HELD)
        at.turn(QUIET)
        assert at.simulator.voltage("1") == there


@pytest.mark.parametrize(
    ("device", "told"), [({"unit": "MM"}, set()), ({"unit": "MM", "without": ["PUN?"]}, {"units"})]
)
def test_a_controller_that_counts_in_millimetres(device, told):
    with bench(voltages=[20.0], **device) as at:
        at.turn(60)
        assert rules(at) == told


def test_a_stroke_that_is_none_is_told_once_it_was_seen():
    without = ["PUN?", "TMN?", "TMX?"]
    with bench(voltages=[20.0], unit="MM", without=without, stage=Stage.random(["1"], 1, 8e-9)) as at:
        at.turn(500)
        assert rules(at) == set()
        for goal in (80.0, 20.0):
            at.reach(goal)
            at.turn(400)
        assert rules(at) == {"units"} and at.loop.status.armed
