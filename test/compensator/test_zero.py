"""The zero of an axis: set to that of its sensor, kept in the memory file, and told by where it comes from."""

from dataclasses import replace

import numpy as np
import pytest
from strategies import two_axes

from slpi_ros.compensator.controller import Controller, OperatingMode
from slpi_ros.compensator.feedback import LoopSettings, PidGains
from slpi_ros.compensator.persistence import CALIBRATION, RESET, SENSOR, MemoryFile, load_memory
from slpi_ros.compensator.validation import RejectedError
from slpi_ros.effects.creep import Creep
from slpi_ros.effects.cross_coupling import CrossCoupling
from slpi_ros.model.limits import Limits

DT, MS, NAMES = 1e-3, 1_000_000, ["x", "y"]
LIMITS = [Limits(0.0, 100.0, 2000.0)] * 2
PLAIN = two_axes()
EFFECTS = {"x": (Creep((0.1, 1.0), (0.02, 0.02)), CrossCoupling({"y": 0.02})), "y": (CrossCoupling({"x": -0.03}),)}
RICH = replace(PLAIN, axes={name: replace(axis, effects=EFFECTS[name]) for name, axis in PLAIN.axes.items()})
# It counts from where it has started.
POWER = replace(
    PLAIN, axes={name: replace(axis, effects=(Creep(exponent=0.1, gain=0.05),)) for name, axis in PLAIN.axes.items()}
)
RANGES = [(2e-6, 12e-6), (0.0, 15e-6)]
MOVED = {"x": 0.4e-6, "y": -0.7e-6}


class Bench:
    """A compensator, and a stage that is its model, but for moved zeros."""

    def __init__(self, model, saved=None, feedback=False, moved=MOVED):
        loops = [LoopSettings(feedback, PidGains(2e6, 1e8), 0.1)] * 2
        self.controller, self.now_ns, self.moved = Controller(NAMES, LIMITS, period=DT, loops=loops), MS, moved
        self.controller.use_model(model, saved)
        self.controller.configure()
        self.controller.activate(self.now_ns)
        self.stage = model.streams("start" if saved is None else "end")

    def sample(self, place, measuring=True):
        """Send a desired displacement, a share of `RANGES`; return the errors, shape (2,), m."""
        self.now_ns += MS
        desired = [low + place * (high - low) for low, high in RANGES]
        self.controller.update(self.now_ns, NAMES, desired, self.now_ns)
        return self.read(measuring) - desired

    def read(self, measuring=True):
        own = {
            n: s.drive(v, DT) for (n, s), v in zip(self.stage.streams.items(), self.controller.voltages, strict=True)
        }
        motions = {name: y - self.stage._origins[name] for name, y in own.items()}
        seen = np.array([own[n] + self.stage._coupling.part(n, motions) + self.moved[n] for n in NAMES])
        if measuring:
            self.controller.measure(NAMES, seen.tolist(), self.now_ns)
        return seen

    def run(self, begin, end, count=800):
        return np.array([self.sample(place) for place in np.linspace(begin, end, count)])


@pytest.mark.parametrize("model", [PLAIN, RICH, POWER], ids=["hysteresis", "creep and coupling", "a power of time"])
@pytest.mark.parametrize("feedback", [False, True], ids=["alone", "feedback"])
def test_the_zero_of_the_sensor_becomes_that_of_the_model_and_nothing_moves(model, feedback):
    bench = Bench(model, feedback=feedback)
    bench.run(0.1, 0.5)
    controller = bench.controller
    before = list(controller.voltages)
    moved = controller.set_zero(bench.now_ns)
    expected = {name: pytest.approx(offset, abs=20e-9) for name, offset in MOVED.items()}
    assert moved == expected
    assert {axis.name: axis.zero.offset for axis in controller.axes} == expected
    assert {axis.zero.source for axis in controller.axes} == {SENSOR} and all(axis.zero.at for axis in controller.axes)
    for _ in range(100):
        bench.now_ns += MS
        controller.advance(bench.now_ns, bench.now_ns)
        bench.read()
    assert list(controller.voltages) == before
    errors = bench.run(0.5, 0.3)
    assert np.abs(errors[100:]).max() < 25e-9
    # Again: nothing is left to move.
    assert max(map(abs, controller.set_zero(bench.now_ns).values())) < 20e-9


def test_it_is_refused_without_a_measurement_of_the_present_and_tells_of_each_axis():
    bench = Bench(PLAIN)
    bench.run(0.1, 0.2, 50)
    late_ns = bench.now_ns + 300 * MS
    assert bench.controller.set_zero(late_ns) == {"x": None, "y": None}
    bench.controller.measure(["y"], [5e-6], late_ns)
    assert bench.controller.set_zero(late_ns)["x"] is None
    assert [axis.zero.source for axis in bench.controller.axes] == [CALIBRATION, SENSOR]
    bench.controller.reset_memory(2, 500.0, [0.0, 0.0], late_ns)
    with pytest.raises(RejectedError):
        bench.controller.set_zero(late_ns)


def test_a_sensor_whose_zero_is_anywhere_can_be_used():
    """An interferometer counts from where it was switched on: its readings are refused until the zero is set."""
    bench = Bench(PLAIN, moved={"x": 300e-6, "y": 0.0})
    bench.sample(0.2, measuring=False)
    for _ in range(5):
        with pytest.raises(RejectedError):
            bench.read()
    assert bench.controller.set_zero(bench.now_ns)["x"] == pytest.approx(300e-6, rel=1e-3)
    y = bench.read()[0]
    assert abs(y - bench.controller.axes[0].stream.uncoupled_displacement) < 1e-9
    bench.controller.update(bench.now_ns + MS, ["x"], [y + 1e-6], bench.now_ns + MS)


@pytest.mark.parametrize("model", [PLAIN, POWER], ids=["hysteresis", "a power of time"])
def test_it_outlives_a_restart_but_not_another_model(tmp_path, model):
    bench = Bench(model)
    bench.run(0.1, 0.5)
    bench.controller.set_zero(bench.now_ns)
    bench.run(0.5, 0.2)
    axes = bench.controller.axes
    file = MemoryFile(str(tmp_path / "memory.json"))
    saved = {axis.name: axis.saved(bench.now_ns) for axis in axes}
    file.save(bench.controller.identified, saved, complete=False)
    found = load_memory(tmp_path / "memory.json")
    found.require_fit(model, NAMES)
    again = found.axes
    assert {name: axis.zero for name, axis in again.items()} == {axis.name: axis.zero for axis in axes}
    other = Controller(NAMES, LIMITS)
    other.use_model(model, again)
    for one, before in zip(other.axes, axes, strict=True):
        assert one.zero == before.zero
        told = one.stream.uncoupled_displacement
        # Saved distances are rounded to 0.1 nm; meanwhile it has crept on.
        assert told == pytest.approx(before.stream.uncoupled_displacement, abs=1e-12 if model is PLAIN else 2e-9)
    other.use_model(RICH)
    assert {axis.zero.source for axis in other.axes} == {CALIBRATION}


def reset(bench, cycles, read=False):
    """Reset the memory to the end; with `read` the displacement is read all the while."""
    bench.controller.reset_memory(cycles, 1000.0, [0.0, 0.0], bench.now_ns)
    while bench.controller.mode is OperatingMode.RESETTING:
        bench.now_ns += MS
        bench.controller.advance(bench.now_ns, bench.now_ns)
        if read:
            bench.read()


def test_after_a_reset_the_zero_is_said_to_come_from_there():
    bench = Bench(PLAIN)
    bench.sample(0.2)
    reset(bench, 2)
    assert {(axis.zero.source, axis.zero.offset) for axis in bench.controller.axes} == {(RESET, 0.0)}


@pytest.mark.parametrize("late", [0, 5, 20])
def test_readings_that_come_late_do_not_move_the_zero_of_a_reset(late):
    """As from a slow network, or of a stage with a delay: rising and falling displacements differ.

    Now and then a hundred come at once, later than that.
    """
    bench = Bench(PLAIN)
    bench.sample(0.2)
    controller, coming = bench.controller, []
    controller.reset_memory(4, 400.0, [0.0, 0.0], bench.now_ns)
    while controller.mode is OperatingMode.RESETTING:
        bench.now_ns += MS
        controller.advance(bench.now_ns, bench.now_ns)
        coming.append(bench.read(measuring=False).tolist())
        while len(coming) > late and bench.now_ns // MS % 500 > 100:
            controller.measure(NAMES, coming.pop(0), bench.now_ns)
    moved = {axis.name: axis.loop.offsets.present(bench.now_ns) for axis in controller.axes}
    assert moved == {name: pytest.approx(moved, abs=20e-9) for name, moved in MOVED.items()}


def test_readings_that_are_late_in_one_direction_alone_do_not_move_the_zero_of_a_reset():
    """A busy computer delays some readings; their stamps tell when they were read, by a clock that may be ahead."""
    bench, ahead = Bench(PLAIN), 3
    bench.sample(0.2)
    controller, seen = bench.controller, []
    controller.reset_memory(4, 400.0, [0.0, 0.0], bench.now_ns)
    while controller.mode is OperatingMode.RESETTING:
        bench.now_ns += MS
        before = list(controller.voltages)
        controller.advance(bench.now_ns, bench.now_ns)
        seen.append(bench.read(measuring=False).tolist())
        late = 12 if controller.voltages[0] > before[0] else 0
        controller.measure(NAMES, seen[-1 - min(late, len(seen) - 1)], bench.now_ns, age=(late - ahead) * DT)
    moved = {axis.name: axis.loop.offsets.present(bench.now_ns) for axis in controller.axes}
    assert moved == {name: pytest.approx(moved, abs=20e-9) for name, moved in MOVED.items()}


def test_right_after_a_reset_the_zero_is_that_of_its_swings():
    bench = Bench(PLAIN)
    bench.sample(0.2)
    controller = bench.controller
    reset(bench, 4, read=True)
    # What the stage does after the reset is not its zero; so it is once the axis has moved, or has long rested.
    bench.moved = {name: moved + 100e-9 for name, moved in MOVED.items()}
    for _ in range(100):
        bench.now_ns += MS
        bench.read()
    of_reset = {name: pytest.approx(moved, abs=20e-9) for name, moved in MOVED.items()}
    assert {axis.name: axis.loop.offsets.present(bench.now_ns) for axis in controller.axes} == of_reset
    bench.now_ns += 61_000 * MS
    bench.read()
    present = {name: pytest.approx(moved + 100e-9, abs=20e-9) for name, moved in MOVED.items()}
    assert {axis.name: axis.loop.offsets.present(bench.now_ns) for axis in controller.axes} == present
    assert controller.set_zero(bench.now_ns) == present


def test_a_setpoint_ends_the_zero_of_a_reset():
    bench = Bench(PLAIN)
    bench.sample(0.2)
    reset(bench, 4, read=True)
    bench.moved = {name: moved + 100e-9 for name, moved in MOVED.items()}
    bench.run(0.2, 0.3, 100)
    moved = bench.controller.set_zero(bench.now_ns)
    assert moved == {name: pytest.approx(moved + 100e-9, abs=20e-9) for name, moved in MOVED.items()}


def test_creep_goes_on_over_a_restart(tmp_path):
    """The stage rests for some seconds while nobody compensates; a model that was at rest then was off by 23 nm."""
    bench = Bench(RICH, moved=dict.fromkeys(NAMES, 0.0))
    bench.run(0.1, 0.9)
    bench.run(0.9, 0.2, 200)
    axis = bench.controller.axes[0]
    bench.now_ns += 500 * MS
    file = MemoryFile(str(tmp_path / "memory.json"))
    file.save(RICH, {each.name: each.saved(bench.now_ns) for each in bench.controller.axes}, complete=True)
    found = load_memory(tmp_path / "memory.json")
    found.require_fit(RICH, NAMES)
    again = found.axes
    assert again["x"].relaxing.keys() == {"creep"} and 0.0 <= again["x"].age < 60.0
    other = Controller(NAMES, LIMITS)
    other.use_model(RICH, {name: replace(each, age=1.5) for name, each in again.items()})
    axis.stream.wait(2.0)
    told = [each.stream.uncoupled_displacement for each in (other.axes[0], axis)]
    assert told[0] == pytest.approx(told[1], abs=0.1e-9)
    # What does not fit the model is ignored.
    wrong = {name: replace(each, relaxing={"creep": (1e-6,), "none": (1.0,)}) for name, each in again.items()}
    Controller(NAMES, LIMITS).use_model(RICH, wrong)


@pytest.mark.parametrize("feedback", [False, True], ids=["alone", "feedback"])
def test_it_outlives_a_cleanup(feedback):
    bench = Bench(PLAIN, feedback=feedback)
    bench.run(0.1, 0.5)
    controller = bench.controller
    controller.set_zero(bench.now_ns)
    bench.run(0.5, 0.3)
    zeros, voltages = [axis.zero for axis in controller.axes], list(controller.voltages)
    told = [axis.stream.uncoupled_displacement for axis in controller.axes]
    controller.deactivate(bench.now_ns)
    for _ in range(2):
        controller.cleanup()
        controller.configure()
    controller.use_model(PLAIN)
    controller.activate(bench.now_ns)
    assert [axis.zero for axis in controller.axes] == zeros and zeros[0].source == SENSOR
    assert [axis.stream.uncoupled_displacement for axis in controller.axes] == pytest.approx(told, abs=1e-12)
    assert list(controller.voltages) == voltages
    controller.deactivate(bench.now_ns)
    controller.cleanup()
    # Another model begins with the zero of its calibration, and so does the first one after it.
    for model in (RICH, PLAIN):
        controller.use_model(model)
        assert {(axis.zero.source, axis.zero.offset) for axis in controller.axes} == {(CALIBRATION, 0.0)}
