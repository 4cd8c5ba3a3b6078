"""Axes whose models know effects, at run time: messages, trajectories, swaps, pauses, feedback, reset."""

from dataclasses import replace

import numpy as np
import pytest
from strategies import FAMILY_CASE, PI_CASE, axis_model

from slpi_ros.compensator.axis import Axis
from slpi_ros.compensator.controller import Controller, OperatingMode
from slpi_ros.compensator.feedback import LoopSettings, PidGains
from slpi_ros.compensator.model_swap import take_over
from slpi_ros.effects.creep import Creep
from slpi_ros.effects.cross_coupling import CrossCoupling
from slpi_ros.effects.delay import Delay
from slpi_ros.effects.filters import Mode as FlexureMode
from slpi_ros.effects.lag import Lag
from slpi_ros.effects.resonance import Resonance
from slpi_ros.effects.saturation import Saturation
from slpi_ros.model.limits import Limits
from slpi_ros.model.stage_model import StageModel

MS, START = 1_000_000, 10**18
DT = 1e-3
LAG, CREEP, MODE = Lag(0.01), Creep((0.03, 0.3), (0.03, 0.04)), Resonance((FlexureMode(150.0, 0.05),))
X = replace(axis_model(FAMILY_CASE), displacement_range=(2e-6, 14e-6), voltage_range=(-10.0, 110.0))
Y = replace(axis_model(PI_CASE), voltage_range=(-10.0, 90.0))
COUPLED = StageModel({
    "x": replace(X, effects=(LAG, CREEP, CrossCoupling({"y": 0.05}))),
    "y": replace(Y, effects=(CREEP, MODE, CrossCoupling({"x": -0.1}))),
})  # fmt: skip
LIMITS = Limits(-10.0, 90.0)
OFF = LoopSettings(False, PidGains(0.0), 0.1)
T = DT * np.arange(600)
RISE = 0.5 - 0.5 * np.cos(np.pi * np.clip(T / 0.1 - 0.5, 0, 1))
PATHS = {"x": 2e-6 + 4e-6 * RISE * (1 + 0.3 * np.sin(15 * T)), "y": 3e-6 * RISE * (1 + 0.3 * np.sin(19 * T))}


def compensation(model=COUPLED, limits=LIMITS):
    made = Controller(list(model.axes), [limits] * len(model.axes))
    made.activate(START)
    made.use_model(model)
    return made


def move(made, k, *names):
    names = list(names or PATHS)
    made.update(START + k * MS, names, [float(PATHS[name][k]) for name in names], START + k * MS)
    return list(made.voltages)


def with_effects(*effects, limits=LIMITS, settings=OFF):
    model = replace(X, effects=effects)
    axis = Axis("x", limits, settings)
    axis.use(model, axis.prepare(model))
    return axis


def test_messages_are_answered_as_the_library_does():
    made, stream = compensation(), COUPLED.streams()
    for k in range(T.size):
        expected = stream.step(k * DT, {name: float(path[k]) for name, path in PATHS.items()})
        np.testing.assert_allclose(move(made, k), list(expected.values()), rtol=0, atol=1e-6)


def test_an_axis_that_is_not_named_keeps_its_voltage_and_is_reckoned_with():
    made = compensation()
    for k in range(300):
        move(made, k)
    before = made.voltages[1]
    for k in range(300, 400):
        move(made, k, "x")
    x, y = (axis.stream for axis in made.axes)
    assert made.voltages[1] == before
    assert x.uncoupled_displacement + 0.05 * y.uncoupled_displacement == pytest.approx(PATHS["x"][399], abs=2e-9)


def follow(made, paths=PATHS, first=0, start_ns=0):
    """Let a trajectory of one point every millisecond take over, its time counted from `first`."""
    rows = np.column_stack(list(paths.values()))
    made.follow(list(paths), np.arange(len(rows)) * MS, rows, start_ns, START + first * MS, START + first * MS)


def displacements(model, voltages):
    """Return the displacement (m) of each axis for voltages (V), shape (N, axes), one each millisecond."""
    return model.simulate(DT * np.arange(len(voltages)), {"x": voltages[:, 0], "y": voltages[:, 1]})


def give(made, count=T.size, start=0):
    """Return the voltages after each millisecond, shape (count, axes)."""
    given = []
    for k in range(start, start + count):
        while made.advance(START + k * MS, START + k * MS):
            pass
        given.append(list(made.voltages))
    return np.array(given)


def test_trajectories_are_followed_as_messages_are():
    made, twin = compensation(), compensation()
    follow(made)
    expected = np.array([move(twin, k) for k in range(T.size)])
    np.testing.assert_allclose(give(made), expected, rtol=0, atol=1e-9)
    assert (
        made.counts["points_held_at_limit"] == made.counts["points_slew_limited"] == 0
        and made.mode is OperatingMode.STREAMING
    )


def test_a_path_reckons_with_axes_that_another_path_brings_elsewhere():
    """Until it takes over, x moves on; what y is then asked for is compensated for where x is."""
    made, twin = compensation(), compensation()
    follow(made, {"x": PATHS["x"][:300]})
    follow(made, {"y": PATHS["y"][300:]}, start_ns=START + 300 * MS)
    given = give(made)
    # A pause of y before its path; a jump of x in both.
    twin.axes[1].samples.accept(START)
    expected = np.array([move(twin, k, "x" if k < 300 else "y") for k in range(600)])
    np.testing.assert_allclose(given[:300], expected[:300], rtol=0, atol=1e-9)
    # The end of the path of x is followed by a hold, from three intervals on, at least 20 ms.
    np.testing.assert_allclose(given[300:318], expected[300:318], rtol=0, atol=1e-9)
    assert (given[318:, 0] != expected[318:, 0]).mean() > 0.9
    np.testing.assert_allclose(displacements(COUPLED, given)["x"][400:], PATHS["x"][299], rtol=0, atol=5e-8)
    np.testing.assert_allclose(displacements(COUPLED, given)["y"][400:], PATHS["y"][400:], rtol=0, atol=5e-8)


DELAYED = StageModel({name: replace(axis, effects=(Delay(0.02), *axis.effects)) for name, axis in COUPLED.axes.items()})


@pytest.mark.parametrize("start", [0, 50])
def test_points_are_given_earlier_by_the_delay_where_possible(start):
    """At once: those that would have had to be given before are left out. Stamped for later: none is."""
    made = compensation(DELAYED)
    follow(made, start_ns=START + start * MS if start else 0)
    assert made.trajectory.remaining == T.size - (0 if start else 20)
    given = give(made, T.size + start)
    seen = DELAYED.simulate(DT * np.arange(len(given)), {"x": given[:, 0], "y": given[:, 1]})
    for name, path in PATHS.items():
        np.testing.assert_allclose(seen[name][start:][25:], path[25:], rtol=0, atol=2e-8)
    assert made.trajectory.skipped == 0


def test_axes_with_delays_of_their_own_arrive_together():
    model = StageModel({
        "x": replace(X, effects=(Delay(0.02),)), "y": replace(Y, effects=(Delay(-0.005),)),
    })  # fmt: skip
    made = compensation(model)
    follow(made, start_ns=START + 50 * MS)
    assert made.trajectory.remaining == T.size
    given = give(made, T.size + 60)
    assert made.trajectory.skipped == 0 and made.mode is OperatingMode.STREAMING
    seen = model.simulate(DT * np.arange(len(given)), {"x": given[:, 0], "y": given[:, 1]})
    for name, path in PATHS.items():
        np.testing.assert_allclose(seen[name][50 : 50 + T.size], path, rtol=0, atol=1e-9)


def test_a_late_single_point_is_given_at_once():
    made, undelayed = compensation(DELAYED), compensation()
    for each in (made, undelayed):
        follow(each, {"x": PATHS["x"][300:301]})
        each.advance(START, START)
    assert list(made.voltages) == list(undelayed.voltages) != [0.0, 0.0]


@pytest.mark.parametrize("effects", [(LAG,), (CREEP,), (LAG, CREEP)])
def test_the_same_model_again_changes_nothing(effects):
    one, other = with_effects(*effects), with_effects(*effects)
    for k, y in enumerate(PATHS["x"].tolist()):
        if k in (150, 300):
            other.use(one.model, other.prepare(one.model))
        assert other.update(DT if k else 0.0, y, 0) == pytest.approx(one.update(DT if k else 0.0, y, 0), abs=1e-6)


@pytest.mark.parametrize("before", [(), (LAG,), (CREEP,), (LAG, CREEP, MODE)])
@pytest.mark.parametrize("after", [(), (LAG,), (CREEP,), (LAG, CREEP, MODE)])
def test_the_voltage_does_not_jump_when_another_model_takes_over(before, after):
    axis = with_effects(*before)
    for k, y in enumerate(PATHS["x"][:110].tolist()):
        axis.update(DT if k else 0.0, y, 0)
    voltage, model = axis.voltage, replace(X, effects=after)
    axis.use(model, axis.prepare(model))
    assert axis.voltage == voltage
    for y in PATHS["x"][110:].tolist():
        axis.update(DT, y, 0)
    assert not axis.held


def test_the_way_that_is_kept_over_a_restart_ends_with_the_command():
    axis = with_effects(LAG)
    for k, y in enumerate(PATHS["x"][:110].tolist()):
        axis.update(DT if k else 0.0, y, 0)
    assert axis.reversal_voltages[-1] == axis.voltage != axis.stream.memory.voltage
    assert take_over(axis.model, LIMITS, axis.reversal_voltages).voltage == axis.voltage


def test_creep_goes_on_in_a_pause():
    """After it, the wish being the same, the voltage has to go back by what the stage has crept on."""
    axis, patient = with_effects(CREEP), with_effects(CREEP)
    for k, y in enumerate(PATHS["x"][:180].tolist()):
        for each in (axis, patient):
            each.update(DT if k else 0.0, y, 0)
    wish = float(PATHS["x"][179])
    for _ in range(2000):
        patient.update(DT, wish, 0)
    before = axis.voltage
    assert axis.update(2.0, wish, 0) == pytest.approx(patient.voltage, abs=0.2 * (before - patient.voltage))


def test_health_knows_the_effects():
    """A stage that does what the model says has no residual, though it lags and creeps."""
    axis = with_effects(LAG, CREEP)
    stage = axis.model.stream()
    for k, y in enumerate(PATHS["x"].tolist()):
        v = axis.update(DT if k else 0.0, y, 0)
        axis.measure(stage.drive(v, DT if k else 0.0), 0)
    assert axis.loop.drift.samples == 500
    assert axis.loop.drift.rms < 1e-12


def test_feedback_with_effects():
    """A stage that is 2 V off is brought to its path."""
    settings = LoopSettings(True, PidGains(1e6, 3e7, 0.0), 0.1)
    errors = {}
    for each in (OFF, settings):
        axis = with_effects(LAG, CREEP, settings=each)
        stage = axis.model.stream()
        for k, y in enumerate(np.append(PATHS["x"], np.full(1500, PATHS["x"][-1])).tolist()):
            now_ns = round(k * DT * 1e9)
            v = axis.update(DT if k else 0.0, y, now_ns)
            measured = stage.drive(v + 2.0, DT if k else 0.0)
            axis.measure(measured, now_ns)
            errors[each.enabled] = abs(measured - y)
    assert errors[True] < 0.05 * errors[False]


@pytest.mark.parametrize("effects", [(LAG,), (CREEP,), (LAG, CREEP, MODE), (Saturation(0.0, 90.0),)])
def test_reset_and_ramps_move_the_effects_too(effects):
    made = Controller(["x"], [Limits(*X.voltage_range)])
    made.activate(0)
    made.use_model(StageModel({"x": replace(X, effects=effects)}))
    (axis,) = made.axes
    stage, now_ns = axis.model.stream(), 0
    made.reset_memory(3, 2000.0, [0.0], now_ns)
    while made.mode is OperatingMode.RESETTING:
        now_ns += 4 * MS
        made.advance(now_ns, 0)
        stage.drive(axis.voltage, 4 * DT)
    assert axis.voltage == pytest.approx(0.0, abs=1e-6)
    assert axis.stream.uncoupled_displacement == pytest.approx(stage.uncoupled_displacement, abs=1e-15)
    assert axis.confidence.state == "known"
    # And wishes are met from there.
    errors = []
    for y in np.linspace(stage.uncoupled_displacement, 5e-6, 400).tolist():
        errors.append(stage.drive(axis.update(DT, y, 0), DT) - y)
    assert np.abs(errors[-50:]).max() < 2e-8


@pytest.mark.parametrize(
    "limits", [Limits(-10.0, 90.0, 300.0), Limits(-10.0, 90.0, 300.0, 2e4), Limits(-10.0, 35.0, 300.0)]
)
def test_limits_are_kept_and_told(limits):
    axis, voltages, flags = with_effects(LAG, CREEP, limits=limits), [], set()
    for k in range(1500):
        voltages.append(axis.update(DT if k else 0.0, 4e-6 if k % 500 < 250 else 9e-6, k * MS))
        flags |= {"held"} if axis.held else set()
        flags |= {"slewing"} if axis.slewing else set()
    assert min(voltages) >= limits.lower
    assert max(voltages) <= limits.upper
    steps = np.abs(np.diff([voltages[0], *voltages]))
    # After a rest, two output periods count; within an acceleration limit, one.
    rested = np.append([True], steps[:-1] == 0.0) & (limits.acceleration == np.inf)
    assert (steps <= limits.slew * DT * np.where(rested, 2.0, 1.0) * (1 + 1e-9)).all()
    assert "slewing" in flags
    assert ("held" in flags) == (limits.upper < 50)
