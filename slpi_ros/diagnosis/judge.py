"""What the outcome of the competition means, in words."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slpi_ros.diagnosis import advice
from slpi_ros.diagnosis.explanation import Explanation
from slpi_ros.diagnosis.selection import Named, Selection, chance_of_gain, gain
from slpi_ros.diagnosis.structure import BIAS
from slpi_ros.diagnosis.verdict import AMBIGUOUS, NAMED, NOTHING_FOUND, UNEXPLAINED, AxisDiagnosis, NamedEffect, Traces
from slpi_ros.effects.base import Effect
from slpi_ros.identification.signal_statistics import Floor

FloatArray = NDArray[np.float64]

# The given model is out of date when its error is so many times that of one fitted to the record.
STALE = 1.5
# What is left is more than the floor when it is this many times as much.
ABOVE_FLOOR = 1.5
# No hysteresis model resolves better than this share of the displacement range, even where there is no noise.
RESOLUTION = 2e-4


@dataclass(frozen=True)
class Given:
    """How well the given model does as it is.

    Parameters
    ----------
    rms : float, metres
        Its error, free-run from its own start, but for the displacement at rest.
    gain : float
        By which share the stage moves more than it says.
    hysteresis_rms : float, metres
        The same of its hysteresis, with effects that were found if that is less.
    """

    rms: float
    gain: float
    hysteresis_rms: float


def judged(
    selection: Selection, floor: Floor, before_rms: float, given: Given, driven_alike: Sequence[str]
) -> AxisDiagnosis:
    """Return what is to be said of one axis.

    Parameters
    ----------
    selection : Selection
    floor : Floor
        Of the record.
    before_rms : float, metres
        Error before any effect, held out.
    given : Given
        Of the given model.
    driven_alike : sequence of str
        Axes that have the drive of this one.
    """
    base, now = selection.base, selection.now
    effects = _named_effects(selection)
    verdict = _verdict(selection, effects, floor)
    return AxisDiagnosis(
        verdict=verdict,
        summary=_of_given(given, selection, before_rms)
        + _summary(verdict, selection, effects, floor, before_rms)
        + _cannot_tell(driven_alike),
        floor_rms=floor.rms,
        floor_source=floor.source,
        given_rms=given.rms,
        before_rms=before_rms,
        after_rms=now.held_out.rms,
        effects=effects,
        next_experiment=_next(verdict, selection, effects, stale=_stale(given, selection, before_rms)),
        traces=_traces(base, now),
    )


def _named_effects(selection: Selection) -> tuple[NamedEffect, ...]:
    fitted = {effect.name: effect for effect in selection.now.with_uncertainty()}
    return tuple(_named_effect(fitted[named.name], named, selection) for named in selection.named)


def _named_effect(effect: Effect, named: Named, selection: Selection) -> NamedEffect:
    whole, chance = selection.base.held_out.rms**2, chance_of_gain(named.before, named.after)
    return NamedEffect(
        effect=effect,
        gain_percent=100.0 * gain(named.before, named.after),
        share_of_residual=float(np.clip((named.before.rms**2 - named.after.rms**2) / whole, 0.0, 1.0)),
        p_value=chance,
        alternatives=named.alternatives,
        evidence=_evidence(effect, named, chance, selection.now.held_out.rms),
    )


def _evidence(effect: Effect, named: Named, chance: float, in_the_end: float) -> str:
    sentence = effect.describe()
    before, after = named.before.rms * 1e9, named.after.rms * 1e9
    gained = (
        f"with it the error on blocks left out falls from {before:.3g} to {after:.3g} nm rms "
        f"(chance gains as much in {100 * chance:.2g} % of cases)"
    )
    if not named.runner_up:
        return f"{sentence}; {gained}, and no other effect comes near"
    other, rms = named.runner_up
    instead = f"with {other} in its place {rms * 1e9:.3g} nm are left in the end, not {in_the_end * 1e9:.3g}"
    return f"{sentence}; {gained}; {instead}"


def _resolved(selection: Selection) -> float:
    """Return the error (m) below which no hysteresis model comes."""
    evidence = selection.now.evidence
    return RESOLUTION * float(np.ptp(evidence.y[evidence.used]))


def _left(selection: Selection, floor: Floor) -> bool:
    """Return whether more is left than noise and the model's resolution."""
    return selection.now.held_out.rms > max(ABOVE_FLOOR * floor.rms, _resolved(selection))


def _verdict(selection: Selection, effects: tuple[NamedEffect, ...], floor: Floor) -> str:
    if effects:
        return AMBIGUOUS if any(named.alternatives for named in effects) else NAMED
    wrong_kind = BIAS in selection.structures
    return UNEXPLAINED if wrong_kind or _left(selection, floor) else NOTHING_FOUND


def _stale(given: Given, selection: Selection, before_rms: float) -> bool:
    """Return whether the given model is wrong where one of its kind, fitted to the record, is not."""
    return BIAS not in selection.structures and given.hysteresis_rms > max(STALE * before_rms, _resolved(selection))


def _of_given(given: Given, selection: Selection, before_rms: float) -> str:
    error, anew = given.rms * 1e9, before_rms * 1e9
    if _stale(given, selection, before_rms):
        return (
            f"The given model is off by {error:.3g} nm rms on this record, one fitted to it by {anew:.3g} nm: the "
            f"stage has changed since (its gain by {100 * given.gain:+.2g} %), or it is used otherwise now. "
        )
    return f"The given model is off by {error:.3g} nm rms on this record. " if BIAS in selection.structures else ""


def _summary(
    verdict: str, selection: Selection, effects: tuple[NamedEffect, ...], floor: Floor, before_rms: float
) -> str:
    before, after = before_rms * 1e9, selection.now.held_out.rms * 1e9
    left = f"{after:.3g} nm rms are left, the floor of the record is {floor.rms * 1e9:.3g} nm"
    found = ", then ".join(
        f"{named.name}, which takes away {named.gain_percent:.0f} % of {'the rest' if place else 'the error'}"
        for place, named in enumerate(effects)
    )
    if verdict == NOTHING_FOUND:
        return f"No effect found: {left}."
    structure = f"The hysteresis itself is wrong: {', '.join(selection.structures)}. " if selection.structures else ""
    if verdict == UNEXPLAINED:
        if BIAS in selection.structures:
            return f"{structure}None of the known effects is needed: with loops that depend on bias {left}."
        return f"{structure}None of the known effects explains the error: {left}."
    others = ""
    if verdict == AMBIGUOUS:
        open_ones = (named for named in effects if named.alternatives)
        others = "".join(f" The record cannot tell {one.name} from {', '.join(one.alternatives)}." for one in open_ones)
    return f"{structure}Found: {found}.{others} The held-out error falls from {before:.3g} nm; {left}."


def _cannot_tell(driven_alike: Sequence[str]) -> str:
    if not driven_alike:
        return ""
    return f" Axis {', '.join(driven_alike)} has the same drive: whether it couples into this one cannot be told."


def _next(verdict: str, selection: Selection, effects: tuple[NamedEffect, ...], *, stale: bool) -> str | None:
    steps = [advice.UP_TO_DATE] if stale else []
    steps += [] if verdict == NOTHING_FOUND else [advice.of_structure(structure) for structure in selection.structures]
    if verdict == AMBIGUOUS:
        first = next(named for named in effects if named.alternatives)
        steps.append(advice.separating((first.name, *first.alternatives), selection.now.evidence))
    if verdict == UNEXPLAINED and not steps:
        steps.append(advice.more_loops(selection.now.evidence))
    return " ".join(steps) or None


def _traces(base: Explanation, now: Explanation) -> Traces:
    evidence, seen = now.evidence, now.evidence.seen
    parts = {effect.name: now.predicted - now.prediction_without(effect.name) for effect in now.effects}
    t, v, y, before, after = (x[seen] for x in (evidence.t, evidence.v, evidence.y, base.predicted, now.predicted))
    return Traces(t, v, y, before, after, {name: part[seen] for name, part in parts.items()})
