"""The rate law of the hysteresis: its equation, both directions, sample by sample and for whole paths."""

import json
from dataclasses import dataclass, replace
from math import asinh, inf, sinh

import numpy as np
import pytest
from effects.cases import numbers, powers, rate_laws
from hypothesis import given
from hypothesis import strategies as st
from hysteresis import test_multi_slope as multi_slope
from numpy.typing import NDArray
from scipy.optimize import bisect, brentq
from strategies import PI_CASE, axis_model, cases_and_paths

from slpi_ros.effects.base import EffectContext
from slpi_ros.effects.rate_dependence import RateDependence
from slpi_ros.hysteresis import compiled, rate_law
from slpi_ros.model.axis_model import AxisModel
from slpi_ros.model.limits import Limits

FloatArray = NDArray[np.float64]
EVERYWHERE = (-1e4, 1e4)
KINDS = pytest.mark.parametrize("kind", ["pi", "slpi", "mpi"])


@st.composite
def stamps(draw: st.DrawFn, size: int, equal: float = 0.1) -> FloatArray:
    """Draw steps of time from 0.1 ms to 1 s, evenly over the orders of magnitude; a share of them, `equal`, is 0."""
    rng = np.random.default_rng(draw(st.integers(0, 10**6)))
    steps = 10.0 ** rng.uniform(-4.0, 0.0, size) * (rng.random(size) >= equal)
    return np.cumsum(steps)


@st.composite
def voltages(draw: st.DrawFn) -> tuple[FloatArray, FloatArray]:
    """Draw a path of voltages, V, with jumps and rests, and its stamps, s."""
    stretches = draw(st.lists(st.tuples(numbers(-100, 100), st.integers(1, 20)), min_size=1, max_size=8))
    parts = [np.linspace(0.0, goal, count) if count % 2 else np.full(count, goal) for goal, count in stretches]
    v = np.concatenate(parts)
    return draw(stamps(v.size)), v


@dataclass(frozen=True)
class Wish:
    """A path of displacements, m, for an axis with a law and without; the largest slope, m/V, of its hysteresis."""

    axis: AxisModel
    t: FloatArray
    y: FloatArray
    slope: float
    law: RateDependence
    bare: AxisModel


@st.composite
def wishes(draw: st.DrawFn, kind: str, equal: float = 0.1) -> Wish:
    """Draw a hysteresis of a kind, a law with or without reversible gain, a path and its stamps."""
    case, v = draw(multi_slope.cases_and_paths() if kind == "mpi" else cases_and_paths((kind,)))
    y = case.displacements(v)
    slope = 1.2 * float(case.shape.weights.sum()) if kind == "mpi" else case.slopes[1]
    gain = slope * draw(st.just(0.0) | numbers(0.01, 3.0))
    law = RateDependence(draw(powers(1e-2, 5)), draw(powers(1e-3, 1e2)), gain)
    axis = axis_model(case, (case.rest[0],) if case.primed else ())
    reach = y.min() - 10.0 * slope, y.max() + 10.0 * slope
    bare = replace(axis, kind=kind, voltage_range=EVERYWHERE, displacement_range=reach)
    return Wish(replace(bare, effects=(law,)), draw(stamps(v.size, equal)), y, slope, law, bare)


def rms(error: FloatArray) -> float:
    return float(np.sqrt(np.mean(error**2)))


@given(
    st.just(0.0) | powers(1e-15, 1e6),
    st.just(0.0) | powers(1e-6, 1e4),
    st.just(0.0) | powers(1e-12, 1e4),
    st.floats(-50, 50) | st.sampled_from((inf, -inf, 1e300)),
)
def test_its_equation_against_brent(a, b, goal, guess):
    a = a or float(b == 0.0)
    bound = min(goal / b if b else inf, asinh(goal / a) if a else inf)
    expected = brentq(lambda w: (a and a * sinh(w)) + b * w - goal, 0.0, bound * (1 + 1e-9) + 1e-300, xtol=1e-15)
    for solved in (rate_law.solved, compiled.solved):
        assert solved(a, b, goal, guess) == pytest.approx(expected, rel=1e-12, abs=1e-11)


def by_bisection(law: RateDependence, t: FloatArray, v: FloatArray) -> FloatArray:
    """Backward differences of the law, each sample by bisection."""
    u = v - sum(law.initial)
    for k, scale in enumerate(law.onset_rate * np.diff(t), 1):

        def excess(x, k=k, scale=scale):
            return x + law.threshold * np.arcsinh((x - u[k - 1]) / scale) - v[k]

        u[k] = bisect(excess, *sorted((u[k - 1], v[k])), xtol=1e-13) if scale else u[k - 1] + v[k] - v[k - 1]
    return u


@given(rate_laws(leads=1), voltages())
def test_what_the_hysteresis_feels_against_bisection(law, path):
    felt = law.apply(path[1], EffectContext(path[0]))
    np.testing.assert_allclose(felt, by_bisection(law, *path), rtol=0, atol=1e-9)


@given(rate_laws(), voltages())
def test_forward_streams_as_it_batches(law, path):
    streaming, (t, v) = law.streaming(), path
    streaming.start(float(v[0]))
    u = np.array([streaming.forward(*sample) for sample in zip(np.diff(t, prepend=t[0]).tolist(), v, strict=True)])
    np.testing.assert_allclose(u, law.apply(v, EffectContext(t)), rtol=0, atol=1e-12)
    assert streaming.beside == pytest.approx(float(law.beside(v[-1:], u[-1:])[0]), abs=1e-18)


@KINDS
@given(st.data())
def test_it_goes_where_it_shall(kind, data):
    wish = data.draw(wishes(kind))
    v, held = wish.axis.compensate(wish.t, wish.y)
    error, slack = wish.axis.simulate(wish.t, v) - wish.y, 1e-9 * (wish.slope + wish.law.reversible_gain)
    assert not held.any()
    assert np.abs(error).max() <= slack
    assert rms(error) <= rms(wish.axis.simulate(wish.t, wish.bare.compensate(wish.t, wish.y)[0]) - wish.y) + slack


@KINDS
@given(st.data(), st.none() | st.tuples(numbers(-20, 40), numbers(0, 60)))
def test_inverse_streams_as_it_batches(kind, data, tight):
    wish = data.draw(wishes(kind, equal=0.0))
    limits = Limits(tight[0], tight[0] + tight[1]) if tight else Limits(*EVERYWHERE)
    batch, held = wish.axis.compensate(wish.t, wish.y, limits)
    stream = wish.axis.stream(limits)
    streamed = [stream.step(*sample) for sample in zip(wish.t.tolist(), wish.y.tolist(), strict=True)]
    np.testing.assert_allclose(streamed, batch, rtol=0, atol=1e-12)
    assert stream.held == held[-1]
    assert batch.min() >= limits.lower and batch.max() <= limits.upper


@KINDS
@given(st.data())
def test_the_same_again_at_the_same_time_changes_nothing(kind, data):
    wish = data.draw(wishes(kind, equal=0.0))
    v = wish.axis.compensate(np.repeat(wish.t, 2), np.repeat(wish.y, 2))[0]
    np.testing.assert_allclose(v[1::2], v[::2], rtol=0, atol=1e-9)


@KINDS
@given(st.data(), st.tuples(numbers(0, 40), numbers(1, 60)))
def test_limits_hold_it_back_only_where_the_wish_lies_beyond(kind, data, tight):
    """Away from its limits the axis is where it shall be, whatever they have held back before."""
    wish, limits = data.draw(wishes(kind, equal=0.0)), Limits(tight[0], tight[0] + tight[1])
    # The memory starts within the limits.
    wish = replace(wish, axis=replace(wish.axis, start=replace(wish.axis.start, voltage=limits.lower)))
    v, held = wish.axis.compensate(wish.t, wish.y, limits)
    missed, slack = wish.axis.simulate(wish.t, v) - wish.y, 1e-9 * (wish.slope + wish.law.reversible_gain)
    assert (missed[v < limits.upper - 1e-9] >= -slack).all()
    assert (missed[v > limits.lower + 1e-9] <= slack).all()
    assert not held[np.abs(missed) <= slack].any()


@KINDS
@given(st.data())
def test_without_threshold_there_is_no_rate_dependence(kind, data):
    wish = data.draw(wishes(kind))
    axis = replace(wish.axis, effects=(replace(wish.law, threshold=0.0),))
    v = wish.bare.compensate(wish.t, wish.y)[0]
    np.testing.assert_allclose(axis.compensate(wish.t, wish.y)[0], v, rtol=0, atol=1e-9)
    there = wish.bare.simulate(wish.t, v)
    np.testing.assert_allclose(axis.simulate(wish.t, v), there, rtol=0, atol=1e-9 * wish.slope)


@given(powers(0.05, 5.0), powers(1e-2, 10.0), numbers(0.5, 8.0), st.sampled_from((1.0, -1.0)))
def test_at_rest_the_hysteresis_follows_with_the_logarithm_of_time(c, s0, ratio, way):
    """For small steps of time tanh(|v - u| / 2c) falls as exp(-s0 t / c): first c less for each factor of e in time."""
    law = RateDependence(c, s0, initial=(way * ratio * c,))
    soonest = 2e-3 * np.exp(-ratio) * c / s0
    t = np.append(0.0, np.geomspace(soonest, 8.0 * c / s0, 20_000))
    left = -law.apply(np.zeros_like(t), EffectContext(t)) * way
    expected = np.tanh(0.5 * ratio) * np.exp(-s0 * t / c)
    np.testing.assert_allclose(np.tanh(0.5 * left / c), expected, rtol=0.02, atol=1e-3)
    t = np.append(0.0, np.geomspace(1e-8, 0.02, 20_000) * c / s0)
    left = -replace(law, initial=(way * 30.0 * c,)).apply(np.zeros_like(t), EffectContext(t)) * way
    early = t > 1e-6 * c / s0
    np.testing.assert_allclose(np.diff(left[early]) / np.diff(np.log(t[early])), -c, rtol=0.02)
    # What is left of a large step, by its age.
    np.testing.assert_allclose(left[early], [law.after(age) for age in t[early].tolist()], rtol=0, atol=0.02 * c)
    assert law.after(0.0) == law.after(20.0 * c / s0) == RateDependence(0.0, s0).after(1.0) == 0.0


@pytest.mark.parametrize("gain", [0.0, 5e-8])
def test_loops_widen_by_the_threshold_for_each_factor_of_e_in_the_rate(gain):
    """Half-widths of triangles from 0 to 80 V at half the height; a part that does not wait takes its share of it."""
    c, s0 = 0.5, 0.1
    axis = replace(axis_model(PI_CASE), effects=(RateDependence(c, s0, gain),))
    v = np.interp(np.arange(8001) % 4000, (0, 2000, 4000), (0.0, 80.0, 0.0))
    rise, fall = slice(4000, 6001), slice(8000, 5999, -1)
    widths = []
    for rate in (s0 * np.exp([3.0, 5.0, 7.0, 9.0])).tolist():
        y = axis.simulate(0.04 * np.arange(v.size) / rate, v)
        middle = 0.5 * (y[rise].min() + y[rise].max())
        widths.append(0.5 * (np.interp(middle, y[rise], v[rise]) - np.interp(middle, y[fall], v[fall])))
    slope = PI_CASE.shape.weights.sum()
    np.testing.assert_allclose(np.diff(widths), 2.0 * c * (1.0 - gain / slope), rtol=2e-3)


@given(rate_laws(leads=4), st.lists(voltages(), min_size=1, max_size=3))
def test_each_record_starts_off_equilibrium_by_its_own_lead(law, paths):
    records = tuple(EffectContext(t) for t, _ in paths)
    t, v = (np.concatenate(each) for each in zip(*paths, strict=True))
    parts = EffectContext(t, records=records).split(law.apply(v, EffectContext(t, records=records)))
    leads = (*law.initial, 0.0, 0.0, 0.0)
    for (stamps, own), u, lead in zip(paths, parts, leads, strict=False):
        alone = replace(law, initial=(lead,)).apply(own, EffectContext(stamps))
        np.testing.assert_array_equal(u, alone)
        assert u[0] == own[0] - lead


@given(wishes("slpi"), st.integers(0, 10))
def test_a_snapshot_is_the_whole_state(wish, at):
    """Also through JSON, as a file keeps it; a stream of another model takes over what the hysteresis feels."""
    samples = [(dt, y, 0) for dt, y in zip(np.diff(wish.t, prepend=wish.t[0]).tolist(), wish.y.tolist(), strict=True)]
    stream, other, third = (wish.axis.stream() for _ in range(3))
    for sample in samples[:at]:
        stream.move(*sample)
    twin, state = stream.copy(), stream.snapshot()
    kept = json.loads(json.dumps(state.effects))
    other.restore(replace(state, effects={name: tuple(voltages) for name, voltages in kept.items()}))
    third.resume(stream)
    assert (third.voltage, third.snapshot().effects) == (stream.voltage, state.effects)
    ahead = [twin.move(*sample) for sample in samples[at:]]
    assert stream.snapshot() == state
    assert [stream.move(*sample) for sample in samples[at:]] == ahead
    np.testing.assert_allclose([other.move(*sample) for sample in samples[at:]], ahead, rtol=0, atol=1e-9)


def test_a_step_within_the_last_digit_of_the_voltage_has_the_direction_of_the_wish():
    """With a slow onset nearly all of a small step is reversible: the hysteresis moves by less than rounding."""
    law = RateDependence(1.0, 1e-11, 1.2e-7)
    axis = replace(axis_model(PI_CASE), voltage_range=EVERYWHERE, effects=(law,))
    t, y = np.array([0.0, 1e-4]), np.array([5e-6, 5.05e-6])
    stream = axis.stream()
    for v in (axis.compensate(t, y)[0], np.array([stream.step(*sample) for sample in zip(t, y, strict=True)])):
        np.testing.assert_allclose(axis.simulate(t, v), y, rtol=0, atol=1e-15)


def test_the_sentence_holds_the_figures():
    sentence = RateDependence(1.0, 0.25, 7e-9).describe()
    assert "0.25 V/s" in sentence and "2.3 V" in sentence and "7 nm per volt" in sentence
    assert "at once" not in RateDependence(1.0, 0.25, 0.0).describe()


@given(rate_laws(leads=1), numbers(-100, 100), numbers(-100, 100), st.integers(1, 4000))
def test_during_a_hold_the_hysteresis_never_turns(law, first, goal, samples):
    v = np.concatenate([[first], np.full(samples, goal)])
    u = law.apply(v, EffectContext(1e-3 * np.arange(v.size)))
    assert not (np.diff(np.sign(np.diff(u[1:]))[np.diff(u[1:]) != 0.0]) != 0.0).any()


def test_the_start_of_a_record_belongs_to_that_record():
    law = RateDependence(0.5, 1.0, 1e-9, (-2.0, 3.0))
    assert law.lasting == replace(law, initial=()) and law.of_record(1) == replace(law, initial=(3.0,))
    axis = replace(axis_model(PI_CASE), effects=(law,))
    t, v = 1e-3 * np.arange(200), np.linspace(0.0, 100.0, 200)
    plain = replace(axis, effects=(law.lasting,))
    assert np.array_equal(axis.simulate(t, v), plain.simulate(t, v))
    assert not np.array_equal(axis.simulate(t, v, of_record=True), axis.simulate(t, v))


def test_a_record_ends_at_the_applied_voltage():
    axis = replace(axis_model(PI_CASE), effects=(RateDependence(2.0, 1e-3),))
    t, v = 1e-3 * np.arange(200), np.linspace(0.0, 80.0, 200)
    u = axis.effects[0].apply(v, EffectContext(t))
    assert axis.after(u).voltage < 70.0 and axis.at_rest(u, 80.0).voltage == 80.0
