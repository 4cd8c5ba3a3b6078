"""A model takes over from another: bumpless, and with the memory of what the axis went through."""

from dataclasses import replace

import numpy as np
import pytest
from effects.cases import BY_NAME
from hypothesis import example, given
from hypothesis import strategies as st
from strategies import FAMILY_CASE, axis_model, axis_models, cases_and_paths, stream_forward

from slpi_ros.compensator.axis import Axis
from slpi_ros.compensator.controller import OPEN_LOOP, Controller, StopReason
from slpi_ros.compensator.feedback import LoopSettings, PidGains
from slpi_ros.compensator.model_swap import take_over, turning_voltages
from slpi_ros.compensator.validation import RejectedError
from slpi_ros.effects.creep import Creep
from slpi_ros.effects.lag import Lag
from slpi_ros.errors import SlpiError, UsageError
from slpi_ros.hysteresis.shapes import FAR
from slpi_ros.model.limits import Limits
from slpi_ros.model.stage_model import StageModel

OPEN, MS = Limits(-1e4, 1e4), 1_000_000


@given(cases_and_paths(), st.lists(st.floats(0.0, 1.0), min_size=1, max_size=20))
def test_a_replayed_memory_goes_on_as_the_one_that_was_there(drawn, shares):
    """The new model being the old one, nothing must be lost: neither where it is nor where it will go."""
    case, path = drawn
    axis = replace(axis_model(case), voltage_range=(-1e4, 1e4))
    memory = axis.memory()
    stream_forward(memory, path)
    turns = turning_voltages(memory)
    assert max(map(abs, turns)) < FAR / 2
    stream = take_over(axis, OPEN, turns)
    assert stream.voltage == memory.voltage
    further = np.array([case.span[0] + share * case.width for share in shares])
    scale = 1e-9 * case.width * case.slopes[1]
    assert stream.memory.displacement == pytest.approx(memory.displacement, abs=scale)
    np.testing.assert_allclose(stream_forward(stream.memory, further), stream_forward(memory, further), atol=scale)


# What settles soon is at rest: nothing moves while a zero is set.
SLOW = st.sampled_from(sorted(set(BY_NAME) - {"lag", "resonance", "slew"})).flatmap(BY_NAME.__getitem__)


@given(SLOW, st.lists(st.tuples(st.floats(0.0, 1.0), st.floats(1e-3, 5.0)), min_size=2, max_size=20))
@example(Creep(exponent=0.1, gain=0.05), [(1.0, 1.0), (0.0, 1.0)])
@example(Creep((2.0,), (0.05,)), [(1.0, 1.0), (0.0, 1.0)])
def test_with_another_zero_each_effect_goes_on_where_it_was(effect, moves):
    """A zero that moves (m) moves the displacement, now and later, and nothing else: in no effect anything is lost."""
    by, axis = 0.3e-6, replace(axis_model(FAMILY_CASE), voltage_range=(-1e4, 1e4), effects=(effect,))
    low, high = FAMILY_CASE.span[0], FAMILY_CASE.span[0] + FAMILY_CASE.width
    stream = take_over(axis, OPEN, ())
    half = len(moves) // 2
    for share, dt in moves[:half]:
        stream.drive(low + share * (high - low), dt)
    after = take_over(axis.shifted(by), OPEN, turning_voltages(stream.memory))
    after.resume(stream)
    for share, dt in [(None, 0.0), *moves[half:]]:
        v = stream.voltage if share is None else low + share * (high - low)
        assert after.drive(v, dt) - by == pytest.approx(stream.drive(v, dt), abs=1e-12)


@given(axis_models(), axis_models(), st.lists(st.floats(0.0, 1.0), min_size=1, max_size=12))
def test_another_model_stands_where_it_would_had_it_always_been_there(old, new, shares):
    """Within the range both know; what the old one was assumed to have gone through before counts too."""
    low, high = max(old.voltage_range[0], new.voltage_range[0]), min(old.voltage_range[1], new.voltage_range[1])
    if low >= high:
        return
    old, new = (replace(each, voltage_range=(-1e4, 1e4)) for each in (old, new))
    memory, twin = old.memory(), new.memory()
    for v in turning_voltages(memory):
        twin.forward(v)
    for share in shares:
        for each in (memory, twin):
            each.forward(low + share * (high - low))
    stream = take_over(new, OPEN, turning_voltages(memory))
    assert stream.voltage == memory.voltage == twin.voltage
    # Turning points that the old memory has wiped are gone from the new one's, too, wherever loops close alike.
    beyond = (min(low, *turning_voltages(memory)) - 200.0, max(high, *turning_voltages(memory)) + 200.0)
    for v in (*beyond, 0.5 * (low + high)):
        for each in (stream.memory, twin):
            each.forward(v)
    scale = 1e-6 * max(abs(twin.displacement), 1e-6)
    assert stream.memory.displacement == pytest.approx(twin.displacement, abs=scale)


AXIS = axis_model(FAMILY_CASE)


@pytest.mark.parametrize("present", [119.0, 121.0, -19.0, -210.0])
def test_a_voltage_outside_goes_inside_at_the_slew_limit(present):
    """However far: where the amplifier is, is no reason not to start."""
    stream = take_over(AXIS, Limits(-500.0, 500.0, 100.0), (0.0, present))
    assert stream.voltage == present
    assert stream.limits == Limits(0.0, 100.0, 100.0)
    wish = 20e-6 if present > 0 else -15e-6
    way = [stream.step(i * 0.05, wish) for i in range(60)]
    assert way[0] == present
    assert np.abs(np.diff([present, *way])).max() <= 5.0 + 1e-9
    assert way[-1] == (100.0 if present > 0 else 0.0)


@pytest.mark.parametrize(("present", "taken"), [(119.0, True), (121.0, False), (-19.0, True), (-21.0, False)])
def test_a_running_axis_takes_no_model_that_would_extrapolate_far(present, taken):
    wide = replace(AXIS, voltage_range=(-500.0, 500.0))
    axis = Axis("x", Limits(-500.0, 500.0, 100.0), OPEN_LOOP)
    axis.use(wide, axis.prepare(wide, (0.0, present)))
    if taken:
        axis.use(AXIS, axis.prepare(AXIS))
        assert axis.voltage == present
        return
    with pytest.raises(UsageError, match=rf"{present:g} V.*\b0\.\.100 V"):
        axis.prepare(AXIS)


@pytest.mark.parametrize("effects", [(), (Lag(2e-3),)])
def test_a_sample_that_the_slew_limit_holds_back_is_reached_with_a_new_model(effects):
    limits = Limits(0.0, 100.0, 100.0)
    stiff = replace(AXIS, effects=effects)
    own = AXIS.hysteresis
    soft = replace(stiff, hysteresis=replace(own, everett=0.8 * own.everett, rise=0.8 * own.rise))
    axis = Axis("x", limits, OPEN_LOOP)
    axis.use(stiff, axis.prepare(stiff))
    now = 1_000_000_000
    desired = AXIS.displacement_range[0] + 0.7 * float(np.ptp(AXIS.displacement_range))
    axis.update(None, desired, now)
    assert axis.slewing
    way = [axis.voltage]
    for step in range(2000):
        now += 1_000_000
        if step == 100:
            axis.use(soft, axis.prepare(soft))
        axis.tick(now)
        way.append(axis.voltage)
    assert np.abs(np.diff(way)).max() <= 0.1 + 1e-9
    assert axis.stream.uncoupled_displacement == pytest.approx(desired, abs=1e-3 * np.ptp(AXIS.displacement_range))


def test_without_a_past_the_model_starts_where_it_says():
    stream = take_over(AXIS, Limits(5.0, 100.0))
    assert stream.voltage == 5.0 and stream.limits == Limits(5.0, 100.0)


@pytest.mark.parametrize(("change", "limits"), [
    ({"voltage_range": (600.0, 700.0)}, Limits(0.0, 100.0)),
    ({"displacement_range": (0.0, 1e6)}, Limits(0.0, 100.0)),
    ({}, Limits(-9.0, -1.0)),
])  # fmt: skip
def test_models_that_cannot_serve(change, limits):
    with pytest.raises(SlpiError, match="^[^\n]+$"):
        take_over(replace(AXIS, **change), limits)


def held(effects=(), feedback=False, **limits):
    """Return a controller that holds 10 um, and the time (ns)."""
    loops = [LoopSettings(feedback, PidGains(1e5, 1e6), 1.0)]
    made, now = Controller(["x"], [Limits(0.0, 100.0, 1000.0, **limits)], loops=loops), 10**9
    made.configure()
    made.use_model(StageModel({"x": replace(AXIS, effects=effects)}))
    made.activate(now)
    for _ in range(500):
        now += MS
        made.update(now, ["x"], [10e-6], now)
        if feedback:
            made.measure(["x"], [10e-6], now)
    return made, now


def advanced(made, now, seconds):
    """Return the voltages of the next `seconds`."""
    given = []
    for at in range(now, now + int(seconds * 1e9), MS):
        made.advance(at, at)
        given.append(made.voltages[0])
    return np.array(given)


@pytest.mark.parametrize("feedback", [False, True], ids=["alone", "feedback"])
@pytest.mark.parametrize("effects", [(), (Lag(0.01),), (Creep((0.5,), (0.03,)),)], ids=["none", "lag", "creep"])
def test_a_setpoint_that_another_model_does_not_accept_moves_nothing(effects, feedback):
    """Its displacements are elsewhere by 100 um, and so the voltage for the setpoint would be that of a limit."""
    made, now = held(effects, feedback)
    before = made.voltages[0]
    assert 20.0 < before < 80.0
    other = StageModel({"x": replace(AXIS, effects=effects).shifted(100e-6)})
    made.use_model(other)
    assert not made.axes[0].stream.accepted[0] <= 10e-6
    # What has not settled goes on to be compensated, as it would be with the old model.
    given, (same, _) = advanced(made, now, 3.0), held(effects, feedback)
    np.testing.assert_allclose(given, advanced(same, now, 3.0), atol=1e-6)
    assert np.abs(given - before).max() < 1.0
    with pytest.raises(RejectedError, match="far outside"):
        made.update(now + 4 * 10**9, ["x"], [10e-6], now + 4 * 10**9)


@pytest.mark.parametrize("begin_s", [0.0, 1.0])
def test_a_trajectory_that_another_model_does_not_accept_is_canceled(begin_s):
    made, now = held()
    times, path = np.arange(1, 500) * 4 * MS, (10e-6 + np.linspace(0.0, 2e-6, 499))[:, None]
    made.follow(["x"], times, path, now + int(begin_s * 1e9), now, now)
    advanced(made, now, 0.1)
    now += 10**8
    # One that accepts it leaves it as it is.
    made.use_model(StageModel({"x": AXIS.shifted(0.1e-6)}))
    assert made.trajectory.on and not made.trajectory.refused
    before = made.voltages[0]
    made.use_model(StageModel({"x": AXIS.shifted(100e-6)}))
    assert not made.trajectory.on and made.stopped is StopReason.CANCELED
    assert "axis 'x'" in made.trajectory.refused and "accepted" in made.trajectory.refused
    assert np.abs(advanced(made, now, 3.0) - before).max() < 1e-9
    made.follow(["x"], times, path + 100e-6, 0, now + 4 * 10**9, now + 4 * 10**9)
    assert made.trajectory.on and not made.trajectory.refused


def test_what_a_model_cancels_counts_as_a_command():
    """The axis brakes by itself, and the time without a command counts from there."""
    made, now = held()
    times = np.arange(1, 500) * 4 * MS
    made.follow(["x"], times, (10e-6 + np.linspace(0.0, 2e-6, 499))[:, None], now, now, now)
    advanced(made, now, 0.1)
    now += 10**8
    made.axes[0].motion.due_ns = None  # as between two samples
    made.use_model(StageModel({"x": AXIS.shifted(100e-6)}), now_ns=now)
    assert made.axes[0].motion.due_ns == now
    assert made.watchdog.silence(now) == 0.0
