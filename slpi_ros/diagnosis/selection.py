"""Forward selection of effects: the one that best explains the residual is added if its gain is significant."""

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from slpi_ros.arrays import FloatArray
from slpi_ros.diagnosis.effect_parameters import EachRecord, free
from slpi_ros.diagnosis.joint_fit import FINEST, Explanation, Score
from slpi_ros.diagnosis.prepare import drive_frequency, excited_frequency, one_speed
from slpi_ros.diagnosis.significance import (
    ALIKE,
    LEAST_GAIN,
    NO_WORSE,
    chance_of_gain,
    clearly_better,
    counts,
    gain,
    independent_trials,
)
from slpi_ros.effects.base import Candidate, Effect, FitContext, is_course, usual_step
from slpi_ros.effects.registry import EFFECTS
from slpi_ros.errors import ModelError
from slpi_ros.hysteresis.reversals import monotone_runs
from slpi_ros.identification.progress import report_progress
from slpi_ros.model.axis_model import ABOVE_NOISE

# Defect of other kinds of hysteresis model than the loop family.
BIAS = "loops that depend on bias"
# Defects of the loop family.
NOT_CLOSING, LEVEL = "loops that do not close", "loops that depend on level"
# Memory lengths (voltage travel, share of the voltage range) for hysteresis without return-point memory.
FORGETS_WITHIN = (0.02, 0.05, 0.12, 0.3, 0.7)
# A fit from other initial parameters, or with another effect, is preferred if it lowers the error by this share.
LEAST_FALL = 0.01
# Largest number of effects that are selected; records cannot determine more.
MOST_EFFECTS = 4
# Largest number of other effects with which the selection begins anew if more than the noise, and more than this share
# of the error, is left.
FRESH_STARTS, LEFT = 1, 0.4
# Largest number of rounds in which an effect is added, or a line or mode to one.
MOST_ROUNDS = 12
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
# An effect differs from none by at least this number of its standard deviations.
CERTAIN = 3.0
# Gauss-Newton steps of a candidate, and of the selected effects in the end.
STEPS, CONVERGED = 5, 15
# Steps that lower the objective below this share of it began far from the best parameters.
FAR_OFF = 0.9
# Largest residual that counts as rounding, as a multiple of the rms rounding error.
ROUNDING_LEFT = 1.3


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
    screened = [best for name in names or EFFECTS if name not in once for best in _screened(name, now, scores)]
    trials = independent_trials(now.held_out, scores)
    error = now.held_out.rms
    # Implausible effects do not determine the threshold.
    most = max((error - score.rms for score, effect in screened if is_plausible(effect, now)), default=0.0)
    least = max(WORTH_TRYING * most, LEAST_SCREENED * error)
    tried = [
        Contender(effect.name, _with_companion(now, effect).adding(effect), trials).refined(1)
        for score, effect in screened
        if error - score.rms > least
    ]
    sound = [one for one in tried if is_plausible(one.effect, one.explanation)]
    most = max((error**2 - one.score.rms**2 for one in sound), default=0.0)
    sound = [one for one in _refined(tried, now, most) if is_plausible(one.effect, one.explanation)]
    # Of an effect that was refined from several forms, the best.
    sound = [min((one for one in sound if one.name == name), key=_error) for name in {one.name: None for one in sound}]
    # What has to prove itself beside other signals, and does not, stands for these, and is no rival of anything.
    sound = [one for one in sound if not one.effect.proved_beside or one.counts_beside(now)]
    several = len(now.evidence.parts) > 1

    def rank(one: Contender) -> tuple[bool, bool, float]:
        return several and not one.counts_beside(now), several and is_own(one.effect), one.rms

    return sorted(sound, key=rank)


def _with_companion(now: Explanation, effect: Effect) -> Explanation:
    """Return the fit with the companion of an effect, if it has one, unless an effect like that is there already."""
    companion = EFFECTS[effect.name].companion()
    if companion is None or any(other.time_shift == companion.time_shift for other in now.effects):
        return now
    return now.adding(companion)


def _beginning(now: Explanation, effect: Effect) -> Explanation:
    """Return the fit with an effect that is known from an earlier selection."""
    return _with_companion(now, effect).adding(effect).refined(STEPS)


def _error(one: Contender) -> float:
    return one.rms


def _refined(tried: Sequence[Contender], before: Explanation, most: float) -> list[Contender]:
    """Refine the candidates that explain enough of `most`, what the best one explains (m^2), and return all."""
    square, least = before.held_out.rms**2, WORTH_REFINING * most
    return [one.refined() if square - one.score.rms**2 >= least else one for one in tried]


def _screened(name: str, now: Explanation, scores: list[Score]) -> list[tuple[Score, Effect]]:
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
    if best.score.records.size and other.score.rms_of_records > NO_WORSE * best.score.rms_of_records:
        return False
    if one_speed and one.dynamic and two.dynamic:
        return by_other >= ALTERNATIVE_AT_ONE_SPEED * explained
    if by_other < ALTERNATIVE * explained:
        return False
    clearly = clearly_better(best.score, other.score, best.explanation.noise)
    return not clearly or chance_of_gain(other.score, best.score) > ALIKE


@dataclass(frozen=True)
class Named:
    """Selected effect, with the held-out errors of the preceding effects without it and with it."""

    name: str
    before: Score
    after: Score
    # Held-out errors of all others, without it.
    without: Score
    # Effects that the records do not distinguish from it; next best effect, and the held-out rms error (m) with that.
    alternatives: tuple[str, ...]
    runner_up: tuple[str, float] | None
    # Whether it has separate parameters in each record.
    own: bool


@dataclass(frozen=True)
class Selection:
    """Result of the selection: joint fit before and after it, and what it found."""

    base: Explanation
    now: Explanation
    # The largest gain first; each gain is relative to the preceding effects.
    named: tuple[Named, ...]
    # Defects of the hysteresis model: `BIAS`, or keys of `STRUCTURES`.
    structures: tuple[str, ...]
    # Effects that were found on some records but do not carry over to others.
    dropped: tuple[str, ...]
    # Largest number of independent candidates among which an effect was chosen.
    trials: float = 1.0
    # The effect that was added first, and the others that had a significant gain then, the best one first.
    beginnings: tuple[Effect, ...] = ()
    # Of each named effect those that may stand in its place.
    rivals: Mapping[str, Sequence[Effect]] = field(default_factory=dict)

    def without(self, names: Collection[str]) -> "Selection":
        """Return the selection without some of its effects, which count as dropped."""
        now = self.now.only([effect.name for effect in self.now.effects if effect.name not in names])
        if left := {name: rivals for name, rivals in self.rivals.items() if name not in names}:
            now = now.refined(CONVERGED)
        named = _named(now.only([effect.name for effect in now.effects if effect.name not in left]), now, left)
        return replace(self, now=now, named=named, dropped=tuple(sorted({*self.dropped, *names})), rivals=left)


def select(base: Explanation, family: Explanation | None) -> Selection:
    """Select effects, beginning with the best one, and with the next if that leaves much and more than the noise."""
    # `family` is used instead of `base`: the same with the loop family as hysteresis, where that is better. Of two
    # effects a third one may imitate both, and better than either alone. At a single drive frequency nothing tells them
    # apart.
    best = _grown(base, family)
    beginnings = best.beginnings
    others = 0 if one_speed(base.evidence) else min(len(beginnings) - 1, FRESH_STARTS)
    for first in range(1, 1 + others):
        error = best.now.held_out.rms_of_records
        if error <= max(ABOVE_NOISE * best.now.noise, LEFT * base.held_out.rms_of_records):
            break
        order = (beginnings[first], *beginnings[:first], *beginnings[first + 1 :])
        other = _grown(base, family, order)
        if other.named and other.now.held_out.rms_of_records < (1.0 - LEAST_GAIN) * error:
            best = replace(other, trials=max(best.trials, other.trials))
    return best


def _grown(base: Explanation, family: Explanation | None, beginnings: tuple[Effect, ...] = ()) -> Selection:
    """Add effects as long as one has a significant gain, at first that of `beginnings`; remove needless ones."""
    structures: tuple[str, ...]
    now, structures = (family, (BIAS,)) if family else (base, ())
    start = now
    # Only effects are stored, because a joint fit takes much memory.
    rivals: dict[str, list[Effect]] = {}
    dropped: set[str] = set()
    exchanged, rounds, trials = False, 0, 1.0
    finest = max(FINEST * float(np.ptp(now.y[now.used])), ROUNDING_LEFT * now.evidence.rounding)
    while len(rivals) < MOST_EFFECTS and rounds < MOST_ROUNDS and now.held_out.rms > finest:
        rounds += 1
        report_progress(f"{len(now.effects)} effects found, {now.held_out.rms * 1e9:.3g} nm left, trying others")
        begun = rivals or not beginnings
        found = contenders(now) if begun else [Contender(beginnings[0].name, _beginning(now, beginnings[0]))]
        structure, with_structure = _best_structure(now, structures)
        if structure and (not found or _beats(with_structure.held_out, found[0].score)):
            now, structures = with_structure, (*structures, structure)
            continue
        dropped |= {one.name for one in found if counts(now.held_out, one.score) and not one.counts_beside(now)}
        if not found or not found[0].counts_beside(now):
            names = {effect.name for effect in now.effects}
            if not exchanged and len(now.effects) > 1:
                # The parameters of the rivals have been refined before, too.
                now, exchanged = _exchanged(now.refined(STEPS), rivals), True
            if {effect.name for effect in now.effects} == names:
                break
            continue
        best = _simplest(found, now)
        trials = max(trials, best.trials)
        if EFFECTS[best.name].companion():
            best = best.refined(CONVERGED)
        beside = [one.effect for one in found if one.name != best.name] if begun else list(beginnings[1:])
        # It has proved itself beside these.
        beside = [effect for effect in beside if effect.name not in best.effect.proved_beside]
        if not beginnings:
            significant = (one.effect for one in found if one.name != best.name and one.counts_beside(now))
            beginnings = (best.effect, *significant)
        for effect in best.explanation.effects:
            if effect.name not in {known.name for known in now.effects}:
                rivals[effect.name] = beside
        rivals.setdefault(best.name, beside)
        now = _without_needless(best.explanation.smoothed(), set(rivals) - {best.name})
        resembled = {effect.resembles_when_old for effect in now.effects} & {effect.name for effect in now.effects}
        if resembled and not now.evidence.older_moves:
            now = _without_needless(now.with_older_moves(), resembled)
    # Exchanged effects and removed structures may have made other effects unnecessary.
    with_structures, now = now, now.bare()
    now = _without_needless(now, set(rivals), restart=now is not with_structures)
    # At their best parameters together, some may no longer be necessary.
    now = _without_needless(_plainer(now.refined(CONVERGED), rivals), set(rivals), restart=False)
    named = _named(start, now, rivals)
    dropped -= {one.name for one in named}
    kept = {one.name: rivals[one.name] for one in named}
    return Selection(base, now, named, structures, tuple(sorted(dropped)), trials, beginnings, kept)


def _plainer(now: Explanation, rivals: dict[str, list[Effect]]) -> Explanation:
    """Return the fit with simpler effects, unless clearly worse, without those at bounds, implausible or uncertain."""
    several, step, refused = len(now.evidence.parts) > 1, usual_step(now.t), set[str]()
    for effect in now.effects:
        simple = effect.simpler(step)
        if simple is None or simple.name in {other.name for other in now.effects}:
            continue
        other = now.replacing(effect.name, simple).refined(CONVERGED)
        # A lag also rounds off turns that the hysteresis model makes too sharp.
        if not clearly_better(now.held_out, other.held_out, now.noise):
            rest = [rival for rival in rivals.pop(effect.name, []) if rival.name != simple.name]
            rivals[simple.name] = [effect, *rest]
            now = other
    for effect in now.effects:
        name = effect.name
        if several and effect.at_bound:
            without = now.without(name)
            anew = [
                one for one in contenders(without, [name]) if one.counts_beside(without) and not one.effect.at_bound
            ]
            now = anew[0].explanation if anew else without
        elif effect.at_bound or not is_plausible(effect, now):
            refused.add(name)
            now = _without(name, now, rivals, refused)
    # Of several records, that an effect holds on those that are left out says more than its standard deviations, which
    # are too large where the model leaves more than noise.
    while not several and (
        uncertain := {
            effect.name: certainty for effect in now.effects if (certainty := now.certainty(effect.name)) < CERTAIN
        }
    ):
        refused.add(least := min(uncertain, key=lambda name: uncertain[name]))
        now = _without(least, now, rivals, refused)
    return now


def _without(name: str, now: Explanation, rivals: dict[str, list[Effect]], refused: Collection[str]) -> Explanation:
    """Return the fit without an effect, but with one of its rivals that are not `refused` if that helps."""
    rest, own = now.without(name), rivals.pop(name, [])
    others = {rival.name for rival in own} - {*refused, *(effect.name for effect in now.effects)}
    found = [one for one in contenders(rest, others) if one.counts_beside(rest)] if others else []
    if not found:
        return rest
    best = _simplest(found, rest)
    rivals[best.name] = [rival for rival in own if rival.name != best.name]
    return best.explanation.refined(CONVERGED)


def _simplest(found: Sequence[Contender], now: Explanation) -> Contender:
    """Return the candidate with the fewest parameters among those that the records do not distinguish from the best."""
    alone = one_speed(now.evidence)
    if proved := _proved(found, now):
        return proved
    equal = [
        other
        for other in found
        if other is found[0] or (other.counts_beside(now) and alike(found[0], other, now.held_out, one_speed=alone))
    ]
    return min(equal, key=lambda one: (one.parameters, one.score.rms))


def _proved(found: Sequence[Contender], now: Explanation) -> Contender | None:
    """Return the candidate that proves itself beside what follows time alone, if that is the best and it does as well.

    As well: it explains most of what the best one explains beside the same signals.
    """
    best = found[0]
    for one in found[1:]:
        if best.name in one.effect.proved_beside and one.counts_beside(now):
            beside = one.effect.confounders(one.explanation)
            rest, by_best, by_one = (
                each.beside(beside).held_out.rms ** 2 for each in (now, best.explanation, one.explanation)
            )
            if rest - by_one >= ALTERNATIVE * (rest - by_best):
                return one
    return None


def _without_needless(now: Explanation, names: Collection[str], *, restart: bool = True) -> Explanation:
    """Return the fit without those of the named effects that the others make unnecessary."""
    # An unnecessary effect, with `restart` (default) any effect, is first refitted from new initial parameters: its
    # parameters may compensate for another effect that was missing when it was found.
    for name in [effect.name for effect in now.effects if effect.name in names]:
        without = now.without(name)
        least = least_gain(name, without)
        needed = counts(without.held_out, now.held_out, own=is_own(now.effect(name)), least=least)
        # The others may reach their best parameters only without it.
        anew = contenders(without, [name]) if without.effects and (restart or not needed) else []
        for one in anew:
            if one.counts_beside(without) and (not needed or gain(now.held_out, one.score) > LEAST_FALL):
                now, needed = one.explanation, True
        if not needed:
            now = without
    return now


def _exchanged(now: Explanation, rivals: dict[str, list[Effect]]) -> Explanation:
    """Return the fit in which rivals replace effects that are worse, or equivalent with more parameters."""
    # An effect may have been selected before its rival only because a third one was missing at that time.
    alone = one_speed(now.evidence)
    for name in [effect.name for effect in now.effects if effect.name in rivals]:
        rest, best = now.without(name), Contender(name, now)
        better = [
            one
            for one in (*_tried(name, now, rest, rivals[name]), *_other_courses(name, now, rest))
            if one.counts_beside(rest)
            and (
                one.rms < (1.0 - LEAST_FALL) * best.rms
                or (one.parameters < best.parameters and alike(best, one, rest.held_out, one_speed=alone))
            )
        ]
        if better:
            one = min(better, key=lambda other: other.rms)
            rivals[one.name] = [best.effect, *(rival for rival in rivals.pop(name) if rival.name != one.name)]
            now = one.explanation
    return now


def _other_courses(name: str, now: Explanation, rest: Explanation) -> list[Contender]:
    """Return the other effects with a free course in place of one; `rest` is the fit without it."""
    # When it was selected, others that were missing may have hidden which of them it is.
    present = {effect.name for effect in now.effects}
    free_courses = [other for other, effect in EFFECTS.items() if effect.free_course]
    return contenders(rest, [other for other in free_courses if other not in present]) if name in free_courses else []


def _tried(name: str, now: Explanation, rest: Explanation, rivals: Sequence[Effect]) -> list[Contender]:
    """Return the plausible rivals of an effect in its place, the best one first; `rest` is the fit without it."""
    present = {effect.name for effect in now.effects}
    absent = {rival.name: rival for rival in rivals if rival.name not in present}
    tried = [Contender(other, now.replacing(name, rival).refined(1)) for other, rival in absent.items()]
    refined = _refined(tried, rest, rest.held_out.rms**2 - now.held_out.rms**2)
    return sorted((one for one in refined if is_plausible(one.effect, one.explanation)), key=_error)


def _best_structure(now: Explanation, taken: tuple[str, ...]) -> tuple[str | None, Explanation]:
    """Return the main defect of the hysteresis model, None if not significant, and the fit that allows for it."""
    best: tuple[str | None, Explanation] = (None, now)
    for name, columns in STRUCTURES.items():
        if name not in taken:
            allowing = now.beside(columns(now))
            if counts(now.held_out, allowing.held_out, own=False) and allowing.held_out.rms < best[1].held_out.rms:
                best = name, allowing
    return best


def _beats(one: Score, other: Score) -> bool:
    least = (1.0 - LEAST_GAIN) * other.rms_of_records
    return one.rms_of_records < least and chance_of_gain(other, one) <= ALIKE


def _named(start: Explanation, now: Explanation, rivals: Mapping[str, Sequence[Effect]]) -> tuple[Named, ...]:
    """Return the selected effects, each with its gain when added to the preceding ones, the largest gain first."""
    left = [effect.name for effect in now.effects if effect.name in rivals]
    taken, before, ordered = [effect.name for effect in start.effects], start.held_out, []
    while left:
        scores = {name: now.only([*taken, name]).held_out if len(left) > 1 else now.held_out for name in left}
        best = min(left, key=lambda name: scores[name].rms)
        rest = now.without(best)
        beside = _in_its_place(best, now, rest, rivals[best])
        ordered.append(Named(best, before, scores[best], rest.held_out, *beside, own=is_own(now.effect(best))))
        left.remove(best)
        taken.append(best)
        before = scores[best]
    return tuple(ordered)


def _in_its_place(
    name: str, now: Explanation, rest: Explanation, rivals: Sequence[Effect]
) -> tuple[tuple[str, ...], tuple[str, float] | None]:
    """Return the alternatives to an effect, and its best rival with the held-out error; `rest` is without it."""
    best = Contender(name, now)
    tried = _tried(name, now, rest, rivals)
    alone = one_speed(now.evidence)
    alternatives = [other.name for other in tried if alike(best, other, rest.held_out, one_speed=alone)]
    alternatives += _other_quantities(best, one_speed=alone)
    if alone and EFFECTS[name].dynamic and not alternatives:
        # At a single frequency a better fit only means a more suitable loop shape.
        others = [*(other.name for other in tried), *(key for key in EFFECTS if EFFECTS[key].time_shift != "only")]
        alternatives = [other for other in others if other != name and EFFECTS[other].dynamic][:1]
    return tuple(alternatives), (tried[0].name, tried[0].score.rms) if tried else None


def _other_quantities(best: Contender, *, one_speed: bool) -> list[str]:
    """Return the recorded quantities, as labels, that do as well as one of those that an effect follows."""
    name, now, keys = best.name, best.explanation, best.effect.keys
    found = []
    for key in keys:
        kept = best.effect.only([other for other in keys if other != key])
        rest = now.replacing(name, kept).refined(2) if kept else now.without(name)
        for _, effect in _screened(name, rest, []):
            if keys_of_new := [other for other in effect.keys if other not in keys]:
                other = Contender(name, rest.adding(effect)).refined()
                if alike(best, other, rest.held_out, one_speed=one_speed):
                    found += [f"{name} {new}" for new in keys_of_new]
    return list(dict.fromkeys(found))


def _do_not_close(now: Explanation) -> FloatArray:
    """Return columns, shape (N, k), metres, for loops that do not close: Duhem operators, as in the Bouc-Wen model."""
    # Each follows ``dz = dv - z |dv| / w`` with a memory length ``w`` (V), independent of the rate.
    span = float(np.ptp(now.evidence.v))
    columns = [
        np.concatenate([_duhem(part.v, share * span) for part in now.evidence.parts]) for share in FORGETS_WITHIN
    ]
    return np.column_stack(columns) / span * float(np.ptp(now.h))


def _duhem(v: FloatArray, way: float) -> FloatArray:
    z, state = np.empty_like(v), 0.0
    for start, stop in monotone_runs(v):
        gone = np.abs(v[start:stop] - v[max(start - 1, 0)])
        limit = way * np.sign(v[stop - 1] - v[max(start - 1, 0)])
        z[start:stop] = limit + (state - limit) * np.exp(-gone / way)
        state = float(z[stop - 1])
    return z


def _bent(now: Explanation) -> FloatArray:
    """Return columns, shape (N, 2), metres, for loops that depend on level: square and cube of the displacement."""
    x = now.h - now.h.mean()
    x = x / np.abs(x).max()
    return np.column_stack([x**2, x**3]) * float(np.ptp(now.h))


STRUCTURES: Mapping[str, Callable[[Explanation], FloatArray]] = {NOT_CLOSING: _do_not_close, LEVEL: _bent}
