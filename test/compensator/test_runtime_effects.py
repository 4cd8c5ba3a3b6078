"""Axes whose models know effects, at run time: messages, trajectories, swaps, pauses, feedback, reset."""

from dataclasses import replace
from unittest import mock

import numpy as np
import pytest
from strategies import FAMILY_CASE, PI_CASE, axis_model

from slpi_ros.compensator.axis import Axis
from slpi_ros.compensator.controller import Compensation
from slpi_ros.compensator.driving import Driving
from slpi_ros.compensator.feedback import LoopSettings, PidGains
from slpi_ros.compensator.model_swap import take_over
from slpi_ros.compensator.trajectory import Trajectory
from slpi_ros.effects.creep import Creep
from slpi_ros.effects.cross_coupling import CrossCoupling
from slpi_ros.effects.delay import Delay
from slpi_ros.effects.lag import Lag
from slpi_ros.effects.resonance import Resonance
from slpi_ros.model.limits import Limits
from slpi_ros.model.stage_model import StageModel

MS, START = 1_000_000, 10**18
DT = 1e-3
LAG, CREEP, MODE = Lag(0.01), Creep((0.03, 0.3), (0.03, 0.04)), Resonance(150.0, 0.05)
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
    made = Compensation(list(model.axes), [limits] * len(model.axes))
    made.active = True
    made.use_model(model)
    return made


def move(made, k, *names):
    names = list(names or PATHS)
    made.move(START + k * MS, names, [float(PATHS[name][k]) for name in names])
    return list(made.voltages)


def with_effects(*effects, limits=LIMITS, settings=OFF):
    model = replace(X, effects=effects)
    axis = Axis("x", 0, limits, settings, lambda: 0.0)
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


def give(made, trajectory):
    """Return the voltages of every point, shape (N, axes)."""
    made.following.start(trajectory, lambda: START, START)
    given = []
    for k in range(len(trajectory)):
        made.follow(START + k * MS)
        given.append(list(made.voltages))
    return np.array(given)


def trajectory(paths=PATHS):
    return Trajectory.of(list(paths), np.arange(T.size) * MS, np.column_stack(list(paths.values())), axes=["x", "y"])


def test_trajectories_are_followed_as_messages_are():
    made, twin = compensation(), compensation()
    given = give(made, trajectory())
    expected = np.array([move(twin, k) for k in range(T.size)])
    np.testing.assert_allclose(given, expected, rtol=0, atol=1e-5)
    assert made.following.points_held == made.following.points_slewing == 0


def test_a_path_reckons_with_axes_that_another_path_brings_elsewhere():
    """Until it takes over, x moves on; what y is then asked for is planned for where x will be."""
    made, twin = compensation(), compensation()
    begin = START + 300 * MS
    first, second = (slice(0, 300), slice(300, 600))
    x = Trajectory.of(["x"], np.arange(300) * MS, PATHS["x"][first, None], axes=["x", "y"])
    y = Trajectory.of(["y"], np.arange(300) * MS, PATHS["y"][second, None], begin, axes=["x", "y"])
    made.following.start(x, lambda: START, START)
    made.following.start(y, lambda: START, START)
    with mock.patch.object(Axis, "move", None):
        given = []
        for k in range(600):
            made.follow(START + k * MS)
            given.append(list(made.voltages))
    # A pause of y before its path; a jump of x in both.
    twin.axes[1].stamps.accept(START)
    expected = np.array([move(twin, k, "x" if k < 300 else "y") for k in range(600)])
    np.testing.assert_allclose(given, expected, rtol=0, atol=1e-5)


def test_a_known_path_is_previewed_against_a_delay():
    model = StageModel(
        {name: replace(axis, effects=(Delay(0.02), *axis.effects)) for name, axis in COUPLED.axes.items()}
    )
    given = give(compensation(model), trajectory())
    seen = model.simulate(T, {"x": given[:, 0], "y": given[:, 1]})
    for name, path in PATHS.items():
        np.testing.assert_allclose(seen[name][:-25], path[:-25], rtol=0, atol=2e-8)


@pytest.mark.parametrize("effects", [(LAG,), (CREEP,), (LAG, CREEP)])
def test_the_same_model_again_changes_nothing(effects):
    one, other = with_effects(*effects), with_effects(*effects)
    for k, y in enumerate(PATHS["x"].tolist()):
        if k in (150, 300):
            other.use(one.model, other.prepare(one.model))
        assert other.move(DT if k else 0.0, y) == pytest.approx(one.move(DT if k else 0.0, y), abs=1e-6)


@pytest.mark.parametrize("before", [(), (LAG,), (CREEP,), (LAG, CREEP, MODE)])
@pytest.mark.parametrize("after", [(), (LAG,), (CREEP,), (LAG, CREEP, MODE)])
def test_the_voltage_does_not_jump_when_another_model_takes_over(before, after):
    axis = with_effects(*before)
    for k, y in enumerate(PATHS["x"][:110].tolist()):
        axis.move(DT if k else 0.0, y)
    voltage, model = axis.voltage, replace(X, effects=after)
    axis.use(model, axis.prepare(model))
    assert axis.voltage == voltage
    for y in PATHS["x"][110:].tolist():
        axis.move(DT, y)
    assert not axis.held


def test_the_way_that_is_kept_over_a_restart_ends_with_the_command():
    axis = with_effects(LAG)
    for k, y in enumerate(PATHS["x"][:110].tolist()):
        axis.move(DT if k else 0.0, y)
    assert axis.reversal_voltages[-1] == axis.voltage != axis.stream.memory.voltage
    assert take_over(axis.model, LIMITS, axis.reversal_voltages).voltage == axis.voltage


def test_creep_goes_on_in_a_pause():
    """After it, the wish being the same, the voltage has to go back by what the stage has crept on."""
    axis, patient = with_effects(CREEP), with_effects(CREEP)
    for k, y in enumerate(PATHS["x"][:180].tolist()):
        for each in (axis, patient):
            each.move(DT if k else 0.0, y)
    wish = float(PATHS["x"][179])
    for _ in range(2000):
        patient.move(DT, wish)
    before = axis.voltage
    assert axis.move(2.0, wish) == pytest.approx(patient.voltage, abs=0.2 * (before - patient.voltage))


def test_health_knows_the_effects():
    """A stage that does what the model says has no residual, though it lags and creeps."""
    axis = with_effects(LAG, CREEP)
    stage = axis.model.stream()
    for k, y in enumerate(PATHS["x"].tolist()):
        v = axis.move(DT if k else 0.0, y)
        axis.measure(stage.drive(v, DT if k else 0.0))
    assert axis.drift.samples == 500
    assert axis.drift.rms < 1e-12


def test_feedback_with_effects():
    """A stage that is 2 V off is brought to its path."""
    settings = LoopSettings(True, PidGains(1e6, 3e7, 0.0), 0.1)
    errors = {}
    for each in (OFF, settings):
        axis = with_effects(LAG, CREEP, settings=each)
        stage = axis.model.stream()
        for k, y in enumerate(np.append(PATHS["x"], np.full(1500, PATHS["x"][-1])).tolist()):
            v = axis.move(DT if k else 0.0, y)
            measured = stage.drive(v + 2.0, DT if k else 0.0)
            axis.measure(measured)
            errors[each.enabled] = abs(measured - y)
    assert errors[True] < 0.05 * errors[False]


@pytest.mark.parametrize("effects", [(LAG,), (CREEP,), (LAG, CREEP, MODE)])
def test_reset_and_ramps_move_the_effects_too(effects):
    axis = with_effects(*effects, limits=Limits(*X.voltage_range))
    stage, driving = axis.model.stream(), Driving([axis])
    driving.reset(3, 2000.0, [0.0])
    while not driving.step(DT):
        stage.drive(axis.voltage, DT)
    stage.drive(axis.voltage, DT)
    driving.stop()
    assert axis.voltage == pytest.approx(0.0, abs=1e-6)
    assert axis.stream.uncoupled_displacement == pytest.approx(stage.uncoupled_displacement, abs=1e-15)
    assert axis.memory_state == "known"
    # And wishes are met from there.
    errors = []
    for y in np.linspace(stage.uncoupled_displacement, 5e-6, 400).tolist():
        errors.append(stage.drive(axis.move(DT, y), DT) - y)
    assert np.abs(errors[-50:]).max() < 2e-8


@pytest.mark.parametrize(
    "limits", [Limits(-10.0, 90.0, 300.0), Limits(-10.0, 90.0, 300.0, 2e4), Limits(-10.0, 35.0, 300.0)]
)
def test_limits_are_kept_and_told(limits):
    axis, voltages, flags = with_effects(LAG, CREEP, limits=limits), [], set()
    for k in range(1500):
        voltages.append(axis.move(DT if k else 0.0, 4e-6 if k % 500 < 250 else 9e-6))
        flags |= {"held"} if axis.held else set()
        flags |= {"slewing"} if axis.slewing else set()
    assert min(voltages) >= limits.lower
    assert max(voltages) <= limits.upper
    assert np.abs(np.diff(voltages)).max() <= limits.slew * DT * (1 + 1e-9)
    assert "slewing" in flags
    assert ("held" in flags) == (limits.upper < 50)
