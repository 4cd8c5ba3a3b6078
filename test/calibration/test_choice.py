"""The choice of the next drive: by what is open, by its price, and by what is left of the budget."""

from dataclasses import replace

import numpy as np
import pytest
from calibration.stages import settings

from slpi_ros.calibration.choice import next_drive
from slpi_ros.calibration.settings import CALIBRATION, EFFECT
from slpi_ros.diagnosis.result import AMBIGUOUS, NAMED, NOTHING_FOUND, UNEXPLAINED, AxisDiagnosis, NamedEffect, Traces
from slpi_ros.effects.lag import Lag
from slpi_ros.effects.registry import EFFECTS

NOTHING = np.empty(0)
# Effects whose conditions the calibration drive lacks.
UNCOVERED = [name for name, effect in EFFECTS.items() if effect.excitation.lacking]
SURVEY = [(drive, ("x",)) for drive in UNCOVERED]


def diagnosis(verdict, *effects, after=8e-9, floor=8e-9):
    return AxisDiagnosis(
        verdict,
        "",
        floor,
        floor,
        "",
        1e-7,
        1e-7,
        after,
        effects,
        None,
        Traces(NOTHING, NOTHING, NOTHING, NOTHING, NOTHING),
    )


def named(share, *alternatives):
    return NamedEffect(Lag(0.005), 50.0, share, 0.001, alternatives, "", "")


def test_before_a_diagnosis_conditions_without_a_record_are_recorded_once_for_each_axis():
    chosen, done = settings("xy"), []
    while choice := next_drive(chosen, None, done, 1000.0):
        done.append((choice.drive, choice.axes))
    assert sorted(done) == sorted((drive, (axis,)) for drive in UNCOVERED for axis in "xy")


@pytest.mark.parametrize(
    ("alternative", "drive"), [("delay", "lag"), ("rate_dependence", "rate_dependence"), ("creep", "creep")]
)
def test_an_ambiguous_cause_is_separated_from_its_alternative(alternative, drive):
    found = {"x": diagnosis(AMBIGUOUS, named(0.6, alternative))}
    assert next_drive(settings(), found, SURVEY, 100.0).drive == drive


def test_what_is_larger_comes_first_and_only_the_axis_concerned_moves():
    found = {"x": diagnosis(AMBIGUOUS, named(0.1, "delay")), "y": diagnosis(AMBIGUOUS, named(0.7, "rate_dependence"))}
    choice = next_drive(settings("xy"), found, SURVEY, 100.0)
    assert (choice.drive, choice.axes, choice.seconds) == ("rate_dependence", ("y",), EFFECT)


def test_an_error_without_a_cause_asks_for_more_loops():
    found = {"x": diagnosis(UNEXPLAINED, after=40e-9)}
    choice = next_drive(settings(), found, SURVEY, 100.0)
    assert (choice.drive, choice.seconds) == ("calibration", CALIBRATION)


def test_coupling_takes_all_axes():
    found = {axis: diagnosis(NAMED, replace(named(0.9)), after=40e-9) for axis in "xy"}
    coupled = {axis: replace(one, effects=(Coupled(one.effects[0]),)) for axis, one in found.items()}
    assert next_drive(settings("xy"), coupled, SURVEY, 100.0).axes == ("x", "y")


class Coupled:
    """A named effect that says it is cross coupling."""

    name, alternatives = "cross_coupling", ()

    def __init__(self, other):
        self.share_of_residual = other.share_of_residual


@pytest.mark.parametrize(
    ("found", "left"),
    [
        (diagnosis(NOTHING_FOUND), 100.0),
        (diagnosis(NAMED, named(0.9)), 100.0),
        (diagnosis(UNEXPLAINED, after=9e-9), 100.0),
        (diagnosis(AMBIGUOUS, named(0.9, "delay")), EFFECT - 1.0),
        (diagnosis(AMBIGUOUS, named(0.01, "delay")), 100.0),
    ],
)
def test_nothing_is_recorded_that_is_not_worth_it(found, left):
    assert next_drive(settings(), {"x": found}, SURVEY, left) is None
