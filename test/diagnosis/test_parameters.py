"""The free parameters of every effect as one vector."""

from dataclasses import fields
from multiprocessing.reduction import ForkingPickler

import numpy as np
import pytest
from effects.cases import EVERY
from hypothesis import given

from slpi_ros.diagnosis.effect_parameters import LEAST_KNOWN, EachRecord, bounded, certain, free, moved, names, steps
from slpi_ros.effects.base import is_course
from slpi_ros.effects.gain_drift import GainDrift
from slpi_ros.effects.parameters import facts_of
from slpi_ros.effects.rate_dependence import RateDependence
from slpi_ros.effects.registry import EFFECTS
from slpi_ros.effects.thermal_drift import ThermalDrift

T, V = np.linspace(0, 10, 1001), np.linspace(0, 100, 1001)


@given(EVERY)
def test_each_free_parameter_has_a_name_and_a_step_that_changes_it(effect):
    effect = moved(effect, free(effect))
    values, own = free(effect), steps(effect, T, V)
    assert len(names(effect)) == values.size == own.size
    for k in range(own.size):
        assert moved(effect, values + own * (np.arange(own.size) == k)) != effect


@given(EVERY)
def test_an_effect_goes_to_another_process_with_its_parameters_alone(effect):
    assert free(effect).size == len(effect.free_leaves())
    other = ForkingPickler.loads(ForkingPickler.dumps(effect))
    assert other == effect and "leaves" not in vars(other) and other.leaves == effect.leaves


@given(EVERY)
def test_moving_by_nothing_keeps_what_makes_sense(effect):
    once = moved(effect, free(effect))
    np.testing.assert_allclose(free(moved(once, free(once))), free(once), rtol=1e-12)


@given(EVERY)
def test_a_step_is_never_lengthened(effect):
    change = free(effect) + 1.0
    assert np.all(np.abs(bounded(effect, change)) <= np.abs(change))


def test_a_start_that_is_none_stays_none():
    """The state at the start of a record is free only where the record shows one."""
    law = RateDependence(1.0, 0.1, 1e-8, (0.0, -2.0))
    assert names(law) == ["threshold", "onset_rate", "reversible_gain", "initial.1"]
    assert [leaf.facts.fit.start for leaf in law.free_leaves()] == [False, False, False, True]
    values = free(law)
    values[-1] = 1e-9
    assert moved(law, values).initial == (0.0, 0.0)


def test_the_uncertainty_of_a_logarithm_is_in_the_unit_of_the_parameter():
    law = certain(RateDependence(2.0, 0.5, 1e-8), [0.1, 0.2, 3e-9])
    assert law.uncertainty == pytest.approx({"threshold": 0.2, "onset_rate": 0.1, "reversible_gain": 3e-9})
    # What is not determined at all has a place in a document, too.
    assert certain(RateDependence(2.0, 0.5, 1e-8), [1e200, 0.2, 3e-9]).uncertainty["threshold"] == LEAST_KNOWN


@pytest.mark.parametrize("name", EFFECTS)
def test_every_field_but_the_uncertainty_is_a_parameter_with_facts(name):
    facts = facts_of(EFFECTS[name])
    assert {*facts, "uncertainty"} == {each.name for each in fields(EFFECTS[name])}
    assert all(each.meaning and each.count[0] <= each.count[1] for each in facts.values())


@pytest.mark.parametrize(("first", "expected"), [(1e-6, True), (0.0, False)])
def test_a_course_is_that_of_all_records_together(first, expected):
    # In the second one nothing is left of it but noise, which goes up and down by turns.
    noise = tuple((1e-9 * np.array([1.0, -1.0, 1.0, -1.0, 1.0])).tolist())
    slow = tuple((first * np.linspace(0.0, 1.0, 5) + 1e-9 * np.array([1.0, -1.0, 1.0, -1.0, 1.0])).tolist())
    times = (0.0, 10.0, 20.0, 30.0, 40.0)
    both = EachRecord((ThermalDrift(times, slow), ThermalDrift(times, noise)))
    assert is_course(*both.courses) is expected


def test_what_differs_between_records_is_a_course_of_the_sensitivity_and_not_of_the_zero():
    noise = np.array([1.0, -1.0, 1.0, -1.0, 1.0])
    times = (10.0, 20.0, 30.0, 40.0, 50.0)
    levels = [tuple((1e-3 * level + 1e-4 * noise).tolist()) for level in range(4)]
    assert is_course(*EachRecord(tuple(GainDrift(times, gains, 0.0) for gains in levels)).courses)
    assert not is_course(*EachRecord(tuple(ThermalDrift(times, values) for values in levels)).courses)
    # Records that are all alike.
    assert not is_course(*EachRecord(tuple(GainDrift(times, levels[0], 0.0) for _ in levels)).courses)
