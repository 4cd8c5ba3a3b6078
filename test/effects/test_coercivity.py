"""Rate dependence whose thresholds grow with the rate."""

import json
from dataclasses import replace

import numpy as np
import pytest
from effects.cases import coercivities, records
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import lfilter
from strategies import FAMILY_CASE, axis_model

from benchmarks.hidden.physics import RateLaw, Viscosity
from slpi_ros.effects.base import EffectContext
from slpi_ros.effects.lag import Lag
from slpi_ros.effects.paths import play, settled_rate
from slpi_ros.effects.rate_dependence import RateDependence, StreamingCoercivity
from slpi_ros.effects.registry import in_order
from slpi_ros.model.document import format_model, parse_model
from slpi_ros.model.limits import Limits
from slpi_ros.model.stage_model import StageModel

BARE = replace(axis_model(FAMILY_CASE), voltage_range=(-20.0, 120.0))
SPAN, DT = 10e-6, 1e-3
T, MS = DT * np.arange(4000), 1_000_000
CORNERS = np.interp(T, 0.3 + 0.25 * np.arange(16), [2e-6, *(10e-6, 4e-6, 8e-6, 5e-6, 9e-6) * 3])
SMOOTH = 2e-6 + 4e-6 * (1 - np.cos(2 * np.pi * 0.5 * T)) * (1 - 0.4 * np.sin(2 * np.pi * 0.9 * T) ** 2)
PATHS = pytest.mark.parametrize("wish", [SMOOTH, CORNERS], ids=["smooth", "corners"])
EFFECTS = pytest.mark.parametrize(
    "effect",
    [
        RateDependence(0.0, 0.0, 0.05, 200.0, 1.0, 2.0, 10.0, 2e-3, (5e-8,)),
        RateDependence(0.0, 0.0, 0.5, 200.0, 1.0, 1.0, 0.0, 1e-3, (3e-8, 1e-10)),
        RateDependence(0.0, 0.0, 0.1, 200.0, 1.0, 4.0, 5.0, 5e-3, (8e-8, -1e-10)),
    ],
    ids=["logarithm", "power", "large"],
)


def rms(error):
    return float(np.sqrt(np.mean(error**2))) if error.size else 0.0


def widest(effect, v, t):
    rate = np.abs(np.diff(v) / np.diff(t)).max()
    law = replace(effect, reversible=(), settling=0.0)
    ramp = rate * np.array([0.0, 1.0, 2.0])
    return float(np.ptp(law.apply(ramp, EffectContext(np.arange(3.0))) - ramp))


@given(coercivities(), records("voltage"))
def test_what_is_seen_stays_within_the_coercivity(effect, record):
    seen = effect.apply(record.signal, record.around)
    assert np.abs(seen - record.signal).max() <= widest(effect, record.signal, record.around.t) * (1 + 1e-9) + 1e-9


@given(coercivities(), records("voltage"))
def test_more_coercivity_lets_less_through(effect, record):
    """And none in the limit lets everything through."""
    seen = [np.ptp(replace(effect, coercivity=c).apply(record.signal, record.around)) for c in (1e-12, 1.0, 3.0)]
    assert seen[0] == pytest.approx(record.span, abs=1e-9)
    assert seen[0] >= seen[1] - 1e-9 >= seen[2] - 2e-9


@given(coercivities(), records("voltage"))
def test_it_comes_back_from_its_inverse(effect, record):
    """Nearly, for the rate of the command is not that of what comes out; away from turns it is closer."""
    command = effect.invert(record.signal, record.around)
    assert np.abs(command - record.signal).max() <= widest(effect, record.signal, record.around.t) * (1 + 1e-9) + 1e-9
    error, ignored = (np.abs(effect.apply(v, record.around) - record.signal) for v in (command, record.signal))
    slope = np.abs(np.gradient(record.signal, record.around.t))
    fast = slope > 0.3 * slope.max(initial=0.0)
    assert rms(error) <= rms(ignored) + 1e-5
    assert rms(error[fast]) <= 0.9 * rms(ignored[fast]) + 1e-5


@given(coercivities(), records("voltage"))
def test_a_stream_of_commands_does_not_run_away(effect, record):
    """Also where the coercivity grows in proportion to the rate: it is at most that of the wanted voltages."""
    streaming, steps = effect.streaming(), np.diff(record.around.t, prepend=0.0).tolist()
    streaming.start(float(record.signal[0]))
    bound = widest(effect, record.signal, record.around.t) * (1 + 1e-9) + 1e-9
    for dt, wanted in zip(steps, record.signal.tolist(), strict=True):
        command = streaming.inverse(dt, wanted)
        assert abs(command - wanted) <= bound
        streaming.forward(dt, command)


@given(coercivities(), records("voltage"))
def test_it_is_what_follows_sample_by_sample(effect, record):
    streaming, steps = effect.streaming(), np.diff(record.around.t, prepend=0.0).tolist()
    streaming.start(float(record.signal[0]))
    followed = [streaming.forward(dt, v) for dt, v in zip(steps, record.signal.tolist(), strict=True)]
    np.testing.assert_allclose(effect.apply(record.signal, record.around), followed, rtol=0, atol=1e-9)
    assert streaming.reversible_bypass == pytest.approx(
        float(effect.reversible_bypass(record.signal[-1:], np.array(followed[-1:]))[0]), abs=1e-15
    )


@given(st.lists(st.tuples(st.floats(-100, 100), st.floats(0, 10)), max_size=50))
def test_a_play_along_a_path_is_the_follower_s(samples):
    v, widths = np.array(samples).reshape(-1, 2).T.copy()
    followed = []
    streaming = StreamingCoercivity(lambda _: float(widths[len(followed)]), 0.0, ())
    streaming.start(float(v[0]) if v.size else 0.0)
    for x in v.tolist():
        followed.append(streaming.forward(1.0, x))
    np.testing.assert_allclose(play(v, widths), followed, rtol=0, atol=1e-12)


@given(st.lists(st.floats(1e-4, 1.0), min_size=1, max_size=50), st.floats(-1e3, 1e3), st.floats(1e-4, 1.0))
def test_on_a_ramp_the_settled_rate_is_the_follower_s(steps, slope, settling):
    """A ramp has one rate, whichever samples it is taken from; the stamps are uneven."""
    t = np.cumsum([0.0, *steps])
    rates, expected = [], [0.0]
    streaming = StreamingCoercivity(lambda rate: rates.append(rate) or 0.0, settling, ())
    for dt, v in zip(np.diff(t).tolist(), (slope * t[1:]).tolist(), strict=True):
        del rates[:]
        streaming.forward(dt, v)
        expected.append(rates[0])
    np.testing.assert_allclose(settled_rate(t, slope * t, settling), expected, rtol=1e-12, atol=1e-12)


@given(records("voltage"), st.floats(1e-4, 1e-1))
def test_at_even_stamps_the_settled_rate_is_filtered(record, settling):
    dt = record.around.t[1]
    even = dt * np.arange(record.signal.size)
    rate, kept = np.abs(np.diff(record.signal, prepend=record.signal[:1])) / dt, np.exp(-dt / settling)
    expected = lfilter([1 - kept], [1.0, -kept], rate)
    np.testing.assert_allclose(settled_rate(even, record.signal, settling), expected, rtol=1e-9, atol=1e-12)


@given(coercivities(), records("voltage"), st.integers(1, 600))
def test_a_snapshot_is_the_whole_state(effect, record, at):
    one, other = effect.streaming(), effect.streaming()
    samples = list(zip(np.diff(record.around.t, prepend=0.0).tolist(), record.signal.tolist(), strict=True))
    one.start(samples[0][1])
    for dt, v in samples[:at]:
        one.forward(dt, one.inverse(dt, v))
    other.restore(tuple(json.loads(json.dumps(one.snapshot()))))
    for dt, v in samples[at : at + 50]:
        wanted = one.inverse(dt, v)
        assert other.inverse(dt, v) == wanted
        assert other.forward(dt, wanted) == one.forward(dt, wanted)


@given(coercivities(), records("voltage"), st.sampled_from(("apply", "invert")))
def test_at_rest_nothing_changes(effect, record, verb):
    rest = np.full_like(record.signal, 50.0)
    np.testing.assert_array_equal(getattr(effect, verb)(rest, record.around), rest)
    assert not effect.reversible_bypass(rest, rest).any()


@given(records("voltage"), st.floats(0.1, 4.0), st.floats(0.2, 0.9), st.floats(5e-4, 5e-3))
def test_against_the_simulated_stage(record, strength, exponent, settling):
    """Of a power law."""
    stage = Viscosity(RateLaw(strength, 100.0, exponent, settling=settling)).relay_voltage(
        record.around.t, record.signal
    )
    effect = RateDependence(0.0, 0.0, exponent, 100.0, 1.0, strength, settling=settling)
    np.testing.assert_allclose(effect.apply(record.signal, record.around), stage, rtol=0, atol=1e-3 * strength)


@given(records("voltage"), st.floats(0.1, 4.0), st.floats(3.0, 30.0))
def test_a_small_power_is_a_logarithm(record, strength, onset):
    stage = Viscosity(RateLaw(strength, 100.0, 0.0, onset)).relay_voltage(record.around.t, record.signal)
    effect = RateDependence(0.0, 0.0, 1e-3, 100.0, 1.0, strength, onset, 5e-3)
    np.testing.assert_allclose(effect.apply(record.signal, record.around), stage, rtol=0, atol=5e-3 * strength)


def test_a_ramp_back_and_forth():
    """At one rate it is a play of one width, from where the coercivity has settled."""
    t = np.arange(2000) * 1e-3
    v = 50 * (1 - np.abs(1 - t))
    u = RateDependence(0.0, 0.0, 0.5, 100.0, 1.0, 2.0, settling=1e-3).apply(v, EffectContext(t))
    half_width = 2.0 * np.sqrt(0.5)
    np.testing.assert_allclose(u[100:900], v[100:900] - half_width, rtol=1e-12)
    np.testing.assert_allclose(u[1100:1900], v[1100:1900] + half_width, rtol=1e-12)


def test_no_samples_one_sample_and_no_time():
    effect = RateDependence(0.0, 0.0, 0.5, 100.0, 1.0, 2.0)
    for verb in (effect.apply, effect.invert):
        assert verb(np.empty(0), EffectContext(np.empty(0))).shape == (0,)
        assert verb(np.array([3.0]), EffectContext(np.array([7.0]))).tolist() == [3.0]
        assert verb(np.array([3.0, 5.0, 4.0]), EffectContext(np.zeros(3))).tolist() == [3.0, 5.0, 4.0]


def test_it_is_the_last_before_the_hysteresis():
    effect = RateDependence(0.0, 0.0, 0.5, 100.0, 1.0, 2.0)
    axis = replace(BARE, effects=(effect, Lag(0.01)))
    assert [each.name for each in in_order(axis.effects)] == ["lag", "rate_dependence"]
    assert axis.chain.before == (Lag(0.01), effect) and not axis.chain.own
    assert parse_model(format_model(StageModel({"x": axis})), "here").axes["x"].effects == axis.effects


@EFFECTS
@PATHS
def test_compensation(effect, wish):
    """A whole path, and sample by sample; the command does not run away."""
    axis = replace(BARE, effects=(effect,))
    batch, held = axis.compensate(T, wish)
    stream = axis.stream()
    streamed = [stream.step(now, y) for now, y in zip(T.tolist(), wish.tolist(), strict=True)]
    np.testing.assert_allclose(batch, streamed, rtol=0, atol=1e-9)
    bare = BARE.compensate(T, wish)[0]
    error, ignored = (rms((axis.simulate(T, v) - wish)[20:]) for v in (batch, bare))
    assert error < 2e-3 * SPAN and error < 0.4 * ignored
    assert np.abs(batch - bare).max() < 2.5 * effect.coercivity
    assert not held.any()


@EFFECTS
def test_beside_a_lag_and_limits(effect):
    """What a stream says of its own displacement is what the model makes of its voltages."""
    axis = replace(BARE, effects=(Lag(0.01), effect))
    stream, twin = (axis.stream(Limits(10.0, 70.0, 400.0, 4e4)) for _ in range(2))
    v, own = [], []
    for now, y in zip(T.tolist(), (1.4 * CORNERS).tolist(), strict=True):
        v.append(stream.step(now, y))
        own.append(stream.uncoupled_displacement)
    assert (min(v), max(v)) == (10.0, 70.0)
    expected = [twin.drive(each, DT if k else 0.0) for k, each in enumerate(v)]
    # At rest a power of the rate makes much of rounding.
    np.testing.assert_allclose(own, expected, rtol=0, atol=1e-8 * SPAN)


@EFFECTS
def test_a_stream_goes_on_where_another_has_been(effect):
    axis = replace(BARE, effects=(effect,))
    one, other = axis.stream(), axis.stream()
    for now, y in zip(T[:1500].tolist(), CORNERS.tolist(), strict=False):
        one.step(now, y)
    other.resume(one)
    assert other.voltage == one.voltage
    before = one.voltage
    after = other.move(DT, float(CORNERS[1500]), 1500 * MS)
    assert abs(after - before) < 1.0 + 2 * effect.coercivity


@EFFECTS
def test_twins_go_their_own_ways(effect):
    stream = replace(BARE, effects=(effect,)).stream()
    for now, y in zip(T[:700].tolist(), CORNERS.tolist(), strict=False):
        stream.step(now, y)
    twin, state = stream.copy(), stream.snapshot()
    ahead = [twin.move(DT, float(y), k * MS) for k, y in enumerate(CORNERS[700:800], 700)]
    assert stream.snapshot() == state
    assert [stream.move(DT, float(y), k * MS) for k, y in enumerate(CORNERS[700:800], 700)] == ahead
