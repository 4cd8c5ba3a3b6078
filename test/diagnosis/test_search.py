"""The search over sets of effects, and the choice of the answer, on short records of a stage."""

import numpy as np
import pytest
from scipy.signal import lfilter, lfilter_zi

from slpi_ros.diagnosis.answer import Judge, answer_of
from slpi_ros.diagnosis.joint_fit import JointFit
from slpi_ros.diagnosis.prepare import Evidence, Part
from slpi_ros.diagnosis.ruler import beats
from slpi_ros.diagnosis.search import EffectSet, Form, Library, Search
from slpi_ros.effects.base import Candidate
from slpi_ros.identification.bases import SurfaceBasis

RATE, NOISE, LAG, HUM = 200.0, 5e-9, 0.02, (13.0, 3e-8)
NAMES = ("delay", "lag", "creep", "thermal_drift", "hum")


def fit(lag=0.0, hum=0.0, drift=0.0, records=1):
    """Return the joint fit of hysteresis alone to records of plays with these effects; `drift` in m from end to end."""
    parts = []
    for seed in range(records):
        rng = np.random.default_rng(seed)
        t = np.arange(3000) / RATE
        v = 50 + 45 * np.sin(2 * np.pi * 0.5 * t + seed) * np.cos(2 * np.pi * (0.07 + 0.02 * seed) * t)
        v += 8 * np.sin(2 * np.pi * 2.3 * t)
        b, a = (1, 1), (1 + 2 * RATE * lag, 1 - 2 * RATE * lag)  # bilinear transform
        u = lfilter(b, a, v, zi=lfilter_zi(b, a) * v[0])[0] if lag else v
        y = 1e-7 * u + sum(weight * play(u, width) for width, weight in ((4, 2e-8), (12, 1e-8), (30, 1e-8)))
        y += hum * np.sin(2 * np.pi * HUM[0] * t + seed) + drift * t / t[-1] + NOISE * rng.standard_normal(t.size)
        used = np.ones(t.size, dtype=bool)
        parts.append(Part(f"record {seed}", t, v, y, used, used, used, (), {}, 0.0))
    low, high = min(part.v.min() for part in parts), max(part.v.max() for part in parts)
    return JointFit(Evidence(tuple(parts), SurfaceBasis(np.linspace(low, high, 15)), 1e-3))


def play(u, width):
    """Return a play, shape (N,), volts."""
    x, found = u[0], []
    for each in u.tolist():
        x = min(max(x, each - width), each + width)
        found.append(x)
    return np.array(found)


def names(now):
    return {effect.name for effect in now.effects}


@pytest.mark.parametrize("tiny", [0.0, 1e-22])
@pytest.mark.parametrize("records", [1, 2])
def test_what_acts_in_one_block_alone_is_not_extrapolated(records, tiny):
    now = fit(records=records)
    # Elsewhere there is no more of it than rounding errors.
    column = tiny * np.random.default_rng(0).standard_normal(now.t.size)
    column[3000:] = 0.0
    column[1500:1530] = 1e-8 * np.sin(np.arange(30.0))
    own = now.equations.sampled(np.column_stack([now.target, column]))
    assert now.equations.held_out(own).loss([0], [1]).rms == pytest.approx(now.held_out.rms, rel=0.05)


@pytest.fixture(scope="module")
def both():
    """Search a record of a stage that lags, with a hum."""
    search = Search(fit(LAG, HUM[1]), NAMES)
    return search, Judge(search).answer()


def test_a_pair_is_found_with_its_parameters(both):
    search, answer = both
    assert {one.name for one in answer.named} == names(answer.now) == {"lag", "hum"}
    lag, hum = answer.now.effect("lag"), answer.now.effect("hum")
    assert lag.time_constant == pytest.approx(LAG, rel=0.05)
    (line,) = hum.lines
    assert (line.frequency, line.amplitude) == pytest.approx(HUM, rel=0.05)
    assert answer.now.noise == pytest.approx(NOISE, rel=0.1)
    assert search.trials > 1.0 and not answer.structures


def test_each_gain_is_relative_to_the_preceding_effects(both):
    _, answer = both
    first, second = answer.named
    assert first.before.rms == pytest.approx(answer.base.held_out.rms) and second.after.rms == answer.now.held_out.rms
    assert first.after.rms == pytest.approx(second.before.rms) and all(one.p_value < 1e-3 for one in answer.named)
    # The last one is judged by what all others leave without it.
    assert second.without.rms == pytest.approx(second.before.rms, rel=0.05)


def test_the_answer_is_in_the_pool_of_the_search_and_no_smaller_set_is_as_good(both):
    search, answer = both
    smaller = [one for one in search.pool.values() if one.numbers < EffectSet.of(answer.now).numbers]
    noise = answer.now.noise
    assert smaller and all(beats(answer.now.held_out, one.loss, noise, search.trials) for one in smaller)


def test_nothing_is_found_where_nothing_is():
    answer = answer_of(fit(), NAMES)
    assert not answer.named and not answer.now.effects


def test_a_delay_is_judged_in_the_place_of_a_lag(both):
    _, answer = both
    lag = next(one for one in answer.named if one.name == "lag")
    assert "delay" in {rival.name for rival in lag.rivals}
    assert all(rival.loss.rms > answer.now.held_out.rms for rival in lag.rivals)
    assert not lag.alternatives


def test_sets_are_compared_to_first_order_as_after_a_refit():
    now = fit(drift=2e-7)
    library = Library(now, ("thermal_drift",))
    # A drift is linear in all its numbers, so that first order is exact.
    form = min(library.forms, key=lambda one: one.numbers)
    assert isinstance(form.candidate, Candidate)
    choice = library.choice(frozenset(), (form,))
    refitted = library.fit(choice)
    assert not isinstance(refitted, Form) and names(refitted) == {"thermal_drift"}
    assert choice.square == pytest.approx(refitted.held_out.square, rel=1e-3)
    assert choice.square < 0.1 * now.held_out.square
    assert library.choice(frozenset(), ()).square == pytest.approx(now.held_out.square, rel=1e-6)


@pytest.mark.parametrize("records", [1, 2])
def test_a_small_lag_is_compared_nearly_as_after_a_refit(records):
    now = fit(0.003, records=records)
    library = Library(now, ("lag",))
    best = min((library.choice(frozenset(), (form,)) for form in library.forms), key=lambda one: one.square)
    refitted = library.fit(best)
    assert not isinstance(refitted, Form)
    refitted = refitted.refined(5)
    assert refitted.effect("lag").time_constant == pytest.approx(0.003, rel=0.05)
    assert best.square == pytest.approx(refitted.held_out.square, rel=0.1)
    assert best.square < 0.5 * now.held_out.square


def test_a_set_without_one_of_its_effects_is_compared_as_after_a_refit(both):
    _, answer = both
    library = Library(answer.now, ())
    for name in ("lag", "hum"):
        left = library.choice(frozenset({name}), ()).square
        assert left == pytest.approx(answer.now.without(name).held_out.square, rel=0.1)


def test_the_forms_that_explain_most_are_screened_first(both):
    _, answer = both
    library = Library(answer.now.without("lag"), NAMES)
    found = [form.name for form in library.screened(frozenset(), (), {"hum"})]
    assert "lag" in found[:2] and "hum" not in found
    library.ban([form for form in library.forms if form.name == "lag"])
    assert "lag" not in {form.name for form in library.screened(frozenset(), (), ())}
