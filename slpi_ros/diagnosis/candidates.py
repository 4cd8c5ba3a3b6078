"""Candidates for the next effect: those that explain part of the residual, and how well the records tell them apart."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from slpi_ros.arrays import FloatArray
from slpi_ros.diagnosis.effect_parameters import EachRecord, free
from slpi_ros.diagnosis.joint_fit import Explanation, Score
from slpi_ros.diagnosis.prepare import drive_frequency, excited_frequency
from slpi_ros.diagnosis.significance import (
    ALIKE,
    LEAST_GAIN,
    chance_of_gain,
    clearly_better,
    counts,
    independent_trials,
    worse_left_out,
)
from slpi_ros.effects.base import Candidate, Effect, FitContext, is_course
from slpi_ros.effects.registry import EFFECTS
from slpi_ros.errors import ModelError
from slpi_ros.model.axis_model import ABOVE_NOISE

# Screening: effects are fitted if their gain exceeds these shares of the best gain and of the error.
WORTH_TRYING, LEAST_SCREENED = 0.3, 0.01
# After one Gauss-Newton step, effects are refined further if they explain at least this share of what the best one
# explains.
WORTH_REFINING = 0.3
# An alternative to the best effect explains at least this share of what the best one explains.
ALTERNATIVE = 0.7
# The same for a single drive frequency, where a better fit proves little.
ALTERNATIVE_AT_ONE_SPEED = 0.4
# Smallest relative reduction of the held-out error by an effect with a companion, as two at once find more by chance,
# or beside others that leave little; and by one that another effect resembles: what is left of creep from before a
# record looks like a drift.
LEAST_GAIN_IN_COMPANY, LEAST_GAIN_BESIDE_ALIKE = 0.1, 0.2
# Gauss-Newton steps of a candidate. Steps that lower the objective below this share of it began far from the best
# parameters.
STEPS, FAR_OFF = 5, 0.9


@dataclass(frozen=True)
class Contender:
    """Candidate effect, and the joint fit of it and the effects selected so far."""

    name: str
    explanation: Explanation
    # Number of independent candidates that were tried together with it.
    trials: float = 1.0

    @property
    def effect(self) -> Effect:
        """Candidate effect with its parameters."""
        return self.explanation.effect(self.name)

    @property
    def score(self) -> Score:
        """Held-out errors of the joint fit."""
        return self.explanation.held_out

    @property
    def rms(self) -> float:
        """Held-out rms error by which candidates are compared, metres."""
        return held_out_error(self.score, own=is_own(self.effect))

    @property
    def parameters(self) -> int:
        """Number of fitted parameters of all effects of the joint fit."""
        return sum(free(effect).size for effect in self.explanation.effects)

    def refined(self, steps: int = STEPS) -> "Contender":
        """Return the candidate after up to `steps` Gauss-Newton steps, unless these increase the held-out error."""
        # Far from the best parameters the held-out error, of a fit that is linear in them, says nothing.
        better = replace(self, explanation=self.explanation.refined(steps))
        if EFFECTS[self.name].companion() and better.explanation.objective < FAR_OFF * self.explanation.objective:
            return better
        return min(self, better, key=lambda one: one.rms)

    def counts_beside(self, now: Explanation) -> bool:
        """Return whether the candidate significantly improves the joint fit `now`, which does not include it."""
        least = LEAST_GAIN_IN_COMPANY if EFFECTS[self.name].companion() else least_gain(self.name, now)
        helps = partial(counts, own=is_own(self.effect), least=least, trials=self.trials)
        if not helps(now.held_out, self.score):
            return False
        beside = self.effect.confounders(self.explanation)
        if not beside.shape[1]:
            return True
        return helps(now.beside(beside).held_out, self.explanation.beside(beside).held_out)


def seen(now: Explanation) -> FitContext:
    """Return a joint fit as the plausibility of an effect may see it."""
    evidence = now.evidence

    def drives() -> list[tuple[float, float]]:
        return [(drive_frequency(evidence.of_record(k)), float(part.t[-1])) for k, part in enumerate(evidence.parts)]

    return FitContext(
        *(now.t, evidence.v, now.u, now.h, now.y, now.used, evidence.rounding, now.effects),
        excited_frequency=lambda: excited_frequency(evidence),
        drives=drives,
        zeros=lambda: now.zeros,
        left_without=lambda name: now.y - now.prediction_without(name),
        records=now.around.records,
    )


def is_plausible(effect: Effect, now: Explanation) -> bool:
    """Return whether an effect of a joint fit, or one to be added, may be what it is called."""
    return is_course(*effect.courses) and effect.plausible(seen(now))


def plausible_ones(found: Iterable[Contender]) -> list[Contender]:
    """Return the plausible candidates, and others without those of their parts for which they are not."""
    plausible = []
    for one in found:
        if not is_plausible(one.effect, one.explanation):
            part = one.effect.only_plausible(seen(one.explanation))
            if part is None or not free(part).size:
                continue
            one = replace(one, explanation=one.explanation.replacing(one.name, part).refined(1))
        if is_plausible(one.effect, one.explanation):
            plausible.append(one)
    return plausible


def least_gain(name: str, beside: Explanation) -> float:
    """Return the smallest relative reduction of the held-out error by an effect beside those of a joint fit."""
    if any(other.resembles_when_old == name for other in beside.effects):
        return LEAST_GAIN_BESIDE_ALIKE
    # So near the noise, what is left is a defect of the model.
    near = beside.effects and beside.held_out.rms <= ABOVE_NOISE * beside.noise
    return LEAST_GAIN_IN_COMPANY if near else LEAST_GAIN


def is_own(effect: Effect | type[Any]) -> bool:
    """Return whether an effect, or each of its kind, has separate parameters in each record, such as drift or lines."""
    return effect.side == "record" or effect.sharing == "separate"


def held_out_error(score: Score, *, own: bool) -> float:
    """Return the held-out rms error (m) for an effect: on blocks if it is separate in each record, else on records."""
    return score.rms if own else score.rms_of_records


def contenders(now: Explanation, names: Iterable[str] | None = None) -> list[Contender]:
    """Return candidates for the named effects (default: all) that explain part of the residual, the best one first."""
    # Of several records, significant effects precede all others, and among them those that are common to all records.
    scores: list[Score] = []
    once = {effect.name for effect in now.effects if effect.joined(effect) is None}
    screened = [best for name in names or EFFECTS if name not in once for best in best_forms(name, now, scores)]
    trials = independent_trials(now.held_out, scores)
    error = now.held_out.rms
    # Implausible effects do not determine the threshold.
    most = max((error - score.rms for score, effect in screened if is_plausible(effect, now)), default=0.0)
    least = max(WORTH_TRYING * most, LEAST_SCREENED * error)
    tried = [
        Contender(effect.name, with_companion(now, effect).adding(effect), trials).refined(1)
        for score, effect in screened
        if error - score.rms > least
    ]
    sound = [one for one in tried if is_plausible(one.effect, one.explanation)]
    most = max((error**2 - one.score.rms**2 for one in sound), default=0.0)
    sound = plausible_ones(refined_ones(tried, now, most))
    # Of an effect that was refined from several forms, the best.
    sound = [
        min((one for one in sound if one.name == name), key=lambda one: one.rms)
        for name in {one.name: None for one in sound}
    ]
    # What has to prove itself beside other signals, and does not, stands for these, and is no rival of anything.
    sound = [one for one in sound if not one.effect.proved_beside or one.counts_beside(now)]
    several = len(now.evidence.parts) > 1

    def rank(one: Contender) -> tuple[bool, bool, float]:
        return several and not one.counts_beside(now), several and is_own(one.effect), one.rms

    return sorted(sound, key=rank)


def with_companion(now: Explanation, effect: Effect) -> Explanation:
    """Return the fit with the companion of an effect, if it has one, unless an effect like that is there already."""
    companion = EFFECTS[effect.name].companion()
    if companion is None or any(other.time_shift == companion.time_shift for other in now.effects):
        return now
    return now.adding(companion)


def refined_ones(tried: Sequence[Contender], before: Explanation, most: float) -> list[Contender]:
    """Refine the candidates that explain enough of `most`, what the best one explains (m^2), and return all."""
    square, least = before.held_out.rms**2, WORTH_REFINING * most
    return [one.refined() if square - one.score.rms**2 >= least else one for one in tried]


def best_forms(name: str, now: Explanation, scores: list[Score]) -> list[tuple[Score, Effect]]:
    """Return the held-out errors and the effect for the best form of each group of forms of the effect `name`.

    The held-out errors of all forms that are tried are appended to `scores`.
    """
    # Surplus parameters extrapolate poorly.
    tried: dict[int, list[tuple[Score, Effect]]] = {}
    for form in _forms(name, now):
        if (scored := _scored(form, now)) is None:
            continue
        scores.append(scored[0])
        if scored[1].in_phase(seen(now)):
            tried.setdefault(getattr(form, "group", 0), []).append(scored)
    return [_simplest_of_best(group) for group in tried.values()]


def _simplest_of_best(tried: Sequence[tuple[Score, Effect]]) -> tuple[Score, Effect]:
    """Return the form with the fewest parameters among those that do not differ significantly from the best."""

    def error(one: tuple[Score, Effect]) -> float:
        return held_out_error(one[0], own=is_own(one[1]))

    best = min(tried, key=error)
    equal = [one for one in tried if one is best or chance_of_gain(one[0], best[0]) > ALIKE]
    return min(equal, key=lambda one: (free(one[1]).size, error(one)))


def _forms(name: str, now: Explanation) -> Iterator[Candidate | Effect]:
    """Yield the forms of an effect: with common parameters, with separate ones in each record, or both."""
    records, own = len(now.evidence.parts), is_own(EFFECTS[name])
    if not own or records == 1:
        yield from EFFECTS[name].fit(now)
    if records == 1 or not (own or EFFECTS[name].sharing == "either"):
        return
    for forms in zip(*(EFFECTS[name].fit(now.of_record(k)) for k in range(records)), strict=False):
        yield Candidate(now.evidence.each([form.columns for form in forms]), partial(_each, forms))  # type: ignore[arg-type]


def _each(forms: Sequence[Candidate], gains: FloatArray) -> EachRecord | None:
    own = np.split(gains, np.cumsum([form.columns.shape[1] for form in forms[:-1]]))
    parts = [form.effect(part) for form, part in zip(forms, own, strict=True)]
    found = tuple(part for part in parts if part is not None)
    return EachRecord(found) if len(found) == len(parts) else None


def _scored(form: Candidate | Effect, now: Explanation) -> tuple[Score, Effect] | None:
    if not isinstance(form, Candidate):
        return now.adding(form).held_out, form
    score = now.score(form)
    try:
        effect = form.effect(score.gains[-(form.positive or form.columns.shape[1]) :])
    except ModelError:
        # The effect parameters are invalid.
        return None
    return (score, effect) if effect is not None else None


def alike(best: Contender, other: Contender, before: Score, *, one_speed: bool) -> bool:
    """Return whether the records do not distinguish another effect from the best one."""
    # A single drive frequency cannot distinguish effects that depend on time from those that depend on rate; a better
    # fit then only means a more suitable loop shape. If there are several records, the errors on held-out records also
    # decide.
    explained, by_other = before.rms**2 - best.score.rms**2, before.rms**2 - other.score.rms**2
    one, two = EFFECTS[best.name], EFFECTS[other.name]
    if one.time_shift == "only" and two.contains_shift:
        return False
    if worse_left_out(best.score, other.score):
        return False
    if one_speed and one.dynamic and two.dynamic:
        return by_other >= ALTERNATIVE_AT_ONE_SPEED * explained
    if by_other < ALTERNATIVE * explained:
        return False
    clearly = clearly_better(best.score, other.score, best.explanation.noise)
    return not clearly or chance_of_gain(other.score, best.score) > ALIKE
