"""The free parameters of every effect as one vector."""

import numpy as np
import pytest
from effects.cases import EVERY, coercivities
from hypothesis import given

from slpi_ros.diagnosis.effect_parameters import FREE, bounded, free, moved, names, steps
from slpi_ros.effects.registry import EFFECTS

T, V = np.linspace(0, 10, 1001), np.linspace(0, 100, 1001)


def test_every_effect_has_free_parameters():
    assert FREE.keys() == EFFECTS.keys()


@given(EVERY)
def test_each_free_parameter_has_a_name_and_a_step(effect):
    values = free(effect)
    assert len(names(effect)) == values.size == steps(effect, T, V).size
    assert np.all(steps(effect, T, V) > 0)


@given(EVERY)
def test_moving_by_nothing_keeps_what_makes_sense(effect):
    once = moved(effect, free(effect))
    np.testing.assert_allclose(free(moved(once, free(once))), free(once), rtol=1e-12)


@given(EVERY)
def test_a_step_is_never_lengthened(effect):
    change = free(effect) + 1.0
    assert np.all(np.abs(bounded(effect, change)) <= np.abs(change))


@given(coercivities())
def test_a_coercivity_has_parameters_of_its_own(effect):
    """The others stay as they are, and gains may have either sign."""
    assert not {"widening", "backlash", "transition"} & set(names(effect))
    assert {"coercivity", "exponent", "onset", "settling"} <= set(names(effect))
    values = free(effect)
    values[-len(effect.reversible) or values.size :] = -1e-9
    assert moved(effect, values).reversible == (-1e-9,) * len(effect.reversible)


@pytest.mark.parametrize("name", EFFECTS)
def test_free_parameters_are_fields(name):
    assert set(FREE[name]) <= set(EFFECTS[name].__dataclass_fields__)
