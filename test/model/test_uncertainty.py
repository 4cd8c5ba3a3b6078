"""The uncertainty of a model: its components, in batch and sample by sample."""

from dataclasses import fields, replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from model.test_surroundings import LOAD, WARM
from strategies import FAMILY_CASE, axis_model, two_axes

import slpi_ros
from slpi_ros.effects.base import EffectContext
from slpi_ros.effects.creep import Creep
from slpi_ros.effects.gain_drift import GainDrift
from slpi_ros.effects.rate_dependence import RateDependence
from slpi_ros.effects.surroundings import Surroundings
from slpi_ros.errors import ModelError, UsageError
from slpi_ros.model.axis_model import RESOLUTION, AxisModel, FitQuality, Start
from slpi_ros.model.document import format_model, parse_model
from slpi_ros.model.stage_model import StageModel
from slpi_ros.model.uncertainty import COMPONENTS, POINTS, REGIONS, AxisUncertainty, Budget

QUALITY = FitQuality(
    10e-9, 40e-9, 12e-9, 8e-9, 1000, 1.0, "bag", fastest=200.0,
    regions=(10e-9,) * REGIONS, drift=3e-9, duration=30.0, verdict="nothing_found",
)  # fmt: skip
BARE = replace(axis_model(FAMILY_CASE), displacement_range=(0.0, 10e-6), quality=QUALITY)
CREEP = Creep((0.1, 1.0, 10.0), (0.01, 0.01, 0.01))
DRIFT = GainDrift((10.0, 20.0), (0.01, 0.015), 1e-6)
SURROUNDINGS = Surroundings((WARM, LOAD), uncertainty={"quantities.0.offset_gain": 1e-9})
AXES = {
    "bare": BARE,
    "memory": replace(BARE, end=Start(40.0, 5e-6, (0.0, 100.0, 20.0))),
    "creep": replace(BARE, effects=(CREEP,)),
    "law": replace(BARE, effects=(RateDependence(0.5, 1.0),)),
    "drift": replace(BARE, effects=(DRIFT,)),
    "surroundings": replace(BARE, effects=(SURROUNDINGS,)),
}
CONSTANT = np.full(3, 5e-6)


@cache
def uncertainty(name: str, known: bool) -> AxisUncertainty:
    return AxisUncertainty(AXES[name], known_memory=known)


def path(axis: AxisModel, seed: int, count: int = 100) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return times (s), displacements (m) and voltages (V) of a path that is slow, fast, and at rest."""
    rng = np.random.default_rng(seed)
    t = np.cumsum(rng.choice([0.0, 1e-3, 1e-2, 1.0], count))
    low, high = axis.displacement_range
    y = low + (high - low) * np.clip(0.5 + np.cumsum(rng.normal(0.0, 0.05, count)), -0.05, 1.05)
    y[count // 2 : count // 2 + 20] = y[count // 2]
    return t, y, rng.uniform(*axis.voltage_range) + np.cumsum(rng.normal(0.0, 3.0, count))


def budget(axis: AxisModel, t: list[float], y: list[float], v: list[float], **options: float) -> Budget:
    return AxisUncertainty(axis).budget(*map(np.array, (t, y, v)), **options)


@pytest.mark.parametrize("name", AXES)
@given(seed=st.integers(0, 1000), age=st.sampled_from([0.0, 3600.0]), known=st.booleans())
def test_sample_by_sample_is_the_same_as_the_whole_path(name, seed, age, known):
    axis = AXES[name]
    t, y, v = path(axis, seed)
    own = uncertainty(name, known)
    temperature = np.linspace(20.0, 23.0, t.size)
    whole = own.budget(t, y, v, age, {WARM.key: temperature})
    stream, told = own.stream(age), []
    for k, sample in enumerate(zip(t.tolist(), y.tolist(), v.tolist(), strict=True)):
        stream.surround({WARM.key: temperature[k]})
        told.append(stream.step(*sample))
    np.testing.assert_allclose(told, whole.combined, rtol=1e-9)
    squares = sum(getattr(whole, each) ** 2 for each in COMPONENTS)
    np.testing.assert_allclose(whole.combined, np.sqrt(squares))
    np.testing.assert_allclose(whole.expanded, 2.0 * whole.combined)
    assert [each.name for each in fields(whole)] == list(COMPONENTS)


def test_fit_and_what_is_left_are_those_of_the_held_out_error():
    one = budget(BARE, [0.0], [5e-6], [40.0])
    # Held-out error and error of the fit differ by twice the variance of the fit; the noise is no error of the stage.
    assert one.fit[0] == pytest.approx(np.sqrt((144 - 100) / 2) * 1e-9)
    assert one.left[0] == pytest.approx(np.sqrt((144 - 22 - 64) * 1e-18 + (RESOLUTION * 10e-6) ** 2))
    # With a cause that is not in the model it may stay at its bound.
    systematic = replace(BARE, quality=replace(QUALITY, verdict="unexplained"))
    square = 3.0 * (144 - 22 - 64) * 1e-18 + (RESOLUTION * 10e-6) ** 2
    assert budget(systematic, [0.0], [5e-6], [40.0]).left[0] == pytest.approx(np.sqrt(square))
    # Records that were not fitted say more than blocks that were left out.
    other = replace(BARE, quality=replace(QUALITY, left_out_rms=50e-9))
    assert budget(other, [0.0], [5e-6], [40.0]).combined[0] > 40e-9


def test_regions_and_rates_without_samples_are_uncovered():
    gone = replace(QUALITY, regions=(10e-9,) * 5 + (None,) * 5)
    axis = replace(BARE, quality=gone)
    near, far = (budget(axis, [0.0], [y], [40.0]).uncovered[0] for y in (3e-6, 9.9e-6))
    assert near == 0.0
    assert far > 4.0 * np.hypot(*(getattr(budget(axis, [0.0], [3e-6], [40.0]), each)[0] for each in ("fit", "left")))
    slow, fast = (budget(BARE, [0.0, 1.0], [5e-6] * 2, [10.0, 10.0 + dv]) for dv in (200.0, 600.0))
    within = np.hypot(fast.fit, fast.left)[1]
    assert slow.uncovered[1] == 0.0 and fast.uncovered[1] == pytest.approx(2.0 * within)
    # A stage is somewhere in its range.
    jump = budget(BARE, [0.0, 1e-9], [5e-6] * 2, [0.0, 100.0]).uncovered[1]
    assert jump == pytest.approx(10e-6 / np.sqrt(12.0))
    half = replace(BARE, quality=replace(QUALITY, covered=0.5))
    assert budget(half, [0.0], [5e-6], [0.0]).uncovered[0] == pytest.approx(within)


@given(turns=st.lists(st.floats(0.0, 100.0), min_size=1, max_size=6), share=st.floats(0.0, 1.0))
def test_every_memory_is_within_two_uncertainties(turns, share):
    """Whatever went before: along any path the true stage is as far from the assumed one as is told."""
    v0 = 40.0
    axis = AXES["memory"]
    v = np.concatenate([[v0], np.linspace(v0, share * 100.0, 30), np.linspace(share * 100.0, 60.0, 30)])
    whole = np.concatenate([v, np.linspace(60.0, 0.0, 5), np.linspace(0.0, 100.0, 5)])
    other = replace(axis, end=axis.after(np.array([0.0, 100.0, *turns, v0]))).memory().forward_array(whole)
    assumed = axis.memory().forward_array(whole)
    error = (other - assumed) - (other[-1] - assumed[-1])
    u = uncertainty("memory", False).budget(np.arange(v.size) * 1.0, np.full(v.size, 5e-6), v).memory
    assert (np.abs(error[: v.size]) <= 2.0 * u + 1e-12).all()


def test_the_memory_is_known_after_a_reset_and_after_the_whole_range():
    axis = AXES["memory"]
    v = np.array([40.0, 100.0, 0.0])
    unknown = AxisUncertainty(axis).budget(np.arange(3.0), CONSTANT, v).memory
    assert unknown[0] > 0.1e-6 and unknown[-1] == pytest.approx(0.0, abs=1e-12)
    assert not AxisUncertainty(axis, "wiped").budget(np.arange(3.0), CONSTANT, v).memory.any()
    stream = AxisUncertainty(axis).stream(age=100.0)
    before = stream.step(0.0, 5e-6, 40.0)
    stream.reset(1.0)
    assert before > unknown[0]
    assert stream.step(1.0, 5e-6, 40.0) == pytest.approx(
        AxisUncertainty(axis, "wiped").budget(np.zeros(1), CONSTANT[:1], v[:1]).combined[0]
    )


@pytest.mark.parametrize("name", ["memory", "law", "creep"])
def test_what_the_path_has_not_passed_alone_is_remembered(name):
    axis = replace(AXES[name], end=AXES["memory"].end)
    v = np.concatenate([np.linspace(a, b, 500) for a, b in [(40.0, 99.9), (99.9, 0.1), (0.1, 60.0)]])
    t = np.arange(v.size) * 0.1
    memory = AxisUncertainty(axis).budget(t, np.full(v.size, 5e-6), v).memory
    relaxed = AxisUncertainty(axis, known_memory=True).budget(t, np.full(v.size, 5e-6), v).memory
    assert memory[0] > 0.1e-6 and (memory >= relaxed).all()
    assert memory[600] < 0.03 * memory[0] + relaxed[600] and memory[-1] < 1e-9 + relaxed[-1] < 3e-9


def test_a_voltage_that_the_hysteresis_does_not_feel_has_passed_nothing():
    axis = replace(AXES["law"], effects=(RateDependence(4.0, 0.1),), end=AXES["memory"].end)
    v = np.array([40.0, 100.0, 0.0, 50.0])
    quick, slow = (AxisUncertainty(axis).budget(np.arange(4) * dt, np.full(4, 5e-6), v).memory for dt in (1e-2, 1e5))
    assert slow[-1] < 1e-12 and quick[-1] > 20e-9


def test_after_the_range_that_the_records_have_felt_nothing_is_unknown():
    """A rate law keeps the hysteresis from the limits, in the record and in use."""
    law = replace(AXES["law"], effects=(RateDependence(4.0, 0.1),))
    loops = 50.0 - 50.0 * np.cos(np.arange(400) * 0.05 * np.pi)
    u = law.effects[0].apply(loops, EffectContext.since_start(np.arange(400) * 1e-2))
    axis = replace(law, end=law.after(np.append(u, 40.0)))
    v = np.concatenate([[40.0], loops[10:]])
    memory = AxisUncertainty(axis).budget(np.arange(v.size) * 1e-2, np.full(v.size, 5e-6), v).memory
    assert memory[0] > 0.1e-6 and memory[-1] < 0.01 * memory[0]


def test_the_age_grows_as_a_random_walk_and_creep_as_its_logarithm():
    t = [0.0, 30.0, 90.0]
    one = budget(BARE, t, [5e-6] * 3, [40.0] * 3)
    assert one.age == pytest.approx(3e-9 * np.sqrt([30.0, 60.0, 120.0]))
    assert budget(BARE, t, [5e-6] * 3, [40.0] * 3, age=60.0).age[0] == pytest.approx(3e-9 * np.sqrt(90.0))
    creeping = AxisUncertainty(AXES["creep"], known_memory=True).budget(np.array(t), CONSTANT, np.full(3, 40.0))
    # Three relaxations, one for each decade.
    slow = 0.03 / (3.0 * np.log(10.0)) * 10e-6 / np.sqrt(12.0) * np.log1p(np.array(t) / 30.0)
    assert creeping.age == pytest.approx(np.hypot(one.age, slow))
    # What relaxes at the start is no longer there after a while.
    assert creeping.memory[0] == pytest.approx(0.03 * 10e-6 / np.sqrt(12.0))
    assert creeping.memory[2] < 1e-3 * creeping.memory[0]
    drifting = budget(AXES["drift"], t, [5e-6] * 3, [40.0] * 3).age
    gain = (0.01**2 + 0.005**2) / 20.0 * (4e-6) ** 2
    assert drifting == pytest.approx(np.sqrt(one.age**2 + gain * (np.array(t) + 30.0)))


def test_a_quantity_counts_by_its_gain_as_far_as_it_is_known():
    axis = replace(
        BARE, effects=(Surroundings((replace(WARM, sensitivity_gain=0.0),), uncertainty=SURROUNDINGS.uncertainty),)
    )
    spread = (WARM.highest - WARM.lowest) / np.sqrt(12.0)
    own, here = AxisUncertainty(axis), (np.zeros(1), CONSTANT[:1], np.full(1, 40.0))
    assert own.budget(*here).surroundings[0] == pytest.approx(abs(WARM.offset_gain) * spread)
    at = WARM.reference + 2.0
    assert own.budget(*here, 0.0, {WARM.key: np.array([at])}).surroundings[0] == pytest.approx(2e-9)


def test_compensate_returns_it_in_the_form_of_the_path():
    model = StageModel({"x": BARE})
    t, y = np.linspace(0.0, 2.0, 50), np.linspace(3e-6, 8e-6, 50)
    plain = model.compensate(t, y)
    v, u = model.compensate(t, y, uncertainty=True, age=60.0)
    assert (v == plain).all() and u.shape == y.shape
    assert (u == model.uncertainty("x").budget(t, y, v, 60.0).combined).all()
    named = model.compensate(t, {"x": y}, uncertainty=True, age=60.0)
    assert (named[0]["x"] == v).all() and (named[1]["x"] == u).all()
    # After a reset the memory is known, and the drift begins anew.
    y = np.linspace(7e-6, 8e-6, 50)
    assert model.compensate(t, y, "wiped", uncertainty=True)[1][0] < model.compensate(t, y, uncertainty=True)[1][0]


@pytest.mark.parametrize("age", [-1.0, np.nan, np.inf, "a", None])
def test_an_age_is_a_time_since_something(age):
    with pytest.raises(UsageError, match="age is"):
        StageModel({"x": BARE}).compensate(np.arange(3.0), CONSTANT, uncertainty=True, age=age)


@pytest.mark.parametrize("missing", ["regions", "drift", "duration", "fastest"])
def test_a_model_of_an_earlier_version_says_what_to_do(missing):
    old = replace(BARE, quality=replace(QUALITY, **{missing: None}))
    with pytest.raises(ModelError, match="axis 'x', uncertainty: .*diagnose again from its bags"):
        StageModel({"x": old}).compensate([0.0], [5e-6], uncertainty=True)
    assert StageModel({"x": old}).compensate([0.0], [5e-6]).size == 1
    again = parse_model(format_model(StageModel({"x": old})), "here").axes["x"]
    assert again.quality == old.quality


def test_documents_keep_what_it_needs():
    quality = replace(QUALITY, regions=(1e-9, None) * 5, left_out_rms=2e-9)
    model = replace(two_axes(), axes={"x": replace(BARE, quality=quality)})
    assert parse_model(format_model(model), "here").axes["x"].quality == quality
    assert AxisUncertainty(model.axes["x"]).within.shape == (POINTS,)


@pytest.mark.long
def test_an_identified_model_knows_its_uncertainty():
    t = np.arange(3000) / 200.0
    v = 50.0 - 50.0 * np.cos(2.0 * np.pi * t / 3.0) * np.exp(-t / 20.0)
    y = replace(BARE, start=Start(0.0, 0.0)).simulate(t, v) + 8e-9 * np.random.default_rng(1).standard_normal(t.size)
    record = slpi_ros.Record(np.round(t * 1e9).astype(np.int64), {"x": v}, {"x": y})
    quality = slpi_ros.identify(record).axes["x"].quality
    assert quality.duration == pytest.approx(t[-1])
    assert len(quality.regions) == REGIONS and quality.regions[5] == pytest.approx(8e-9, rel=0.5)
    assert 0.0 < quality.drift < 2e-9 and quality.verdict is None
