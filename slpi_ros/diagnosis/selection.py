"""Forward selection of effects: the one that best explains the residual is added if its gain is significant."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from slpi_ros.diagnosis.candidates import (
    ALTERNATIVE,
    STEPS,
    Contender,
    alike,
    best_forms,
    contenders,
    is_own,
    least_gain,
    plausible_ones,
    refined_ones,
    with_companion,
)
from slpi_ros.diagnosis.joint_fit import FINEST, Explanation, Score
from slpi_ros.diagnosis.prepare import one_speed
from slpi_ros.diagnosis.significance import (
    ALIKE,
    LEAST_GAIN,
    chance_of_gain,
    clearly_better,
    counts,
    gain,
    worse_left_out,
)
from slpi_ros.diagnosis.structures import BIAS, STRUCTURES
from slpi_ros.effects.base import Effect, usual_step
from slpi_ros.effects.registry import EFFECTS
from slpi_ros.identification.progress import report_progress
from slpi_ros.model.axis_model import ABOVE_NOISE

# A fit from other initial parameters, or with another effect, is preferred if it lowers the error by this share.
LEAST_FALL = 0.01
# Largest number of effects that are selected; records cannot determine more.
MOST_EFFECTS = 4
# Largest number of other effects with which the selection begins anew if more than the noise, and more than this share
# of the error, is left.
FRESH_STARTS, LEFT = 1, 0.4
# Largest number of rounds in which an effect is added, or a line or mode to one.
MOST_ROUNDS = 12
# An effect differs from none by at least this number of its standard deviations.
CERTAIN = 3.0
# Gauss-Newton steps of the selected effects in the end.
CONVERGED = 15
# Largest residual that counts as rounding, as a multiple of the rms rounding error.
ROUNDING_LEFT = 1.3


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
        """Return the selection without some of its effects, and those needed beside them only; all count as dropped."""
        now = self.now.only([effect.name for effect in self.now.effects if effect.name not in names])
        left = {name: rivals for name, rivals in self.rivals.items() if name not in names}
        if left:
            now = _without_needless(now.refined(CONVERGED), set(left), restart=False)
        present = {effect.name for effect in now.effects}
        left = {name: rivals for name, rivals in left.items() if name in present}
        named = _named(now.only([effect.name for effect in now.effects if effect.name not in left]), now, left)
        dropped = {*self.dropped, *(one.name for one in self.named)} - left.keys()
        return replace(self, now=now, named=named, dropped=tuple(sorted(dropped)), rivals=left)


def select(
    base: Explanation, family: Explanation | None, not_first: Collection[str] = (), *, unsure: bool = False
) -> Selection:
    """Select effects, beginning with the best one, and with the next if that leaves much and more than the noise.

    Not with an effect in `not_first`, which may be added later. With `unsure` the first one need not be significant:
    another one that is not there yet may hide it.
    """
    # `family` is used instead of `base`: the same with the loop family as hysteresis, where that is better. Of two
    # effects a third one may imitate both, and better than either alone. At a single drive frequency nothing tells them
    # apart.
    best = _grown(base, family, not_first=not_first, unsure=unsure)
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


def settled(selection: Selection, start: Explanation, now: Explanation) -> Selection:
    """Return a selection with another joint fit `now` of the same effects, and `start` without them.

    Which of them are needed, and in which form, is decided anew.
    """
    rivals = {name: list(others) for name, others in selection.rivals.items()}
    step = usual_step(now.t)
    for name in selection.rivals:
        for rival in selection.rivals[name]:
            simple = rival.simpler(step)
            if simple is not None and simple.name == name and rival.name not in rivals:
                now = now.replacing(name, rival).refined(CONVERGED)
                rivals[rival.name] = [one for one in rivals.pop(name) if one.name != rival.name]
                break
    now, named = _ended(start, now, rivals)
    kept = {one.name: rivals[one.name] for one in named}
    return replace(selection, now=now, named=named, rivals=kept)


def _beginning(now: Explanation, effect: Effect) -> Explanation:
    """Return the fit with an effect that is known from an earlier selection."""
    return with_companion(now, effect).adding(effect).refined(STEPS)


def _grown(
    base: Explanation,
    family: Explanation | None,
    beginnings: tuple[Effect, ...] = (),
    not_first: Collection[str] = (),
    onward: Selection | None = None,
    unsure: bool = False,
) -> Selection:
    """Add effects as long as one has a significant gain, at first that of `beginnings`; remove needless ones.

    With `onward`, to those of that selection; with `unsure`, begin with the best one, significant or not.
    """
    structures: tuple[str, ...]
    now, structures = (family, (BIAS,)) if family else (base, ())
    start = now
    # Only effects are stored, because a joint fit takes much memory.
    rivals: dict[str, list[Effect]] = {}
    dropped: set[str] = set()
    exchanged, rounds, trials = False, 0, 1.0
    if onward:
        now, structures, trials, dropped = onward.now, onward.structures, onward.trials, set(onward.dropped)
        rivals, beginnings = {name: list(others) for name, others in onward.rivals.items()}, onward.beginnings
    finest = max(FINEST * float(np.ptp(now.y[now.used])), ROUNDING_LEFT * now.evidence.rounding)
    while len(rivals) < MOST_EFFECTS and rounds < MOST_ROUNDS and now.held_out.rms > finest:
        rounds += 1
        report_progress(f"{len(now.effects)} effects found, {now.held_out.rms * 1e9:.3g} nm left, trying others")
        begun = rivals or not beginnings
        allowed = [name for name in EFFECTS if rivals or name not in not_first]
        found = contenders(now, allowed) if begun else [Contender(beginnings[0].name, _beginning(now, beginnings[0]))]
        structure, with_structure = _best_structure(now, structures)
        if structure and (not found or _beats(with_structure.held_out, found[0].score)):
            now, structures = with_structure, (*structures, structure)
            continue
        dropped |= {one.name for one in found if counts(now.held_out, one.score) and not one.counts_beside(now)}
        if not found or not (found[0].counts_beside(now) or (unsure and rounds == 1)):
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
    before = now.held_out.rms
    now, named = _ended(start, now, rivals)
    dropped -= {one.name for one in named}
    kept = {one.name: rivals[one.name] for one in named}
    selection = Selection(base, now, named, structures, tuple(sorted(dropped)), trials, beginnings, kept)
    # Beside what has replaced another effect, more may be seen.
    replaced = named and now.held_out.rms < (1.0 - LEAST_GAIN) * before
    return _grown(base, family, onward=selection) if replaced and not onward else selection


def _ended(
    start: Explanation, now: Explanation, rivals: dict[str, list[Effect]]
) -> tuple[Explanation, tuple[Named, ...]]:
    """Return the fit with the effects at their best parameters together, and what it names."""
    # There, some may no longer be necessary.
    now = now.refined(CONVERGED)
    now = _simplified(now, rivals)
    now = _without_needless(_plainer(now, rivals), set(rivals), restart=False)
    return now, _named(start, now, rivals)


def _simplified(now: Explanation, rivals: dict[str, list[Effect]]) -> Explanation:
    """Return the fit with simpler effects in place of those that are not clearly better, which become their rivals."""
    step = usual_step(now.t)
    for effect in now.effects:
        simple = effect.simpler(step)
        if simple is None or simple.name in {other.name for other in now.effects}:
            continue
        other = now.replacing(effect.name, simple).refined(CONVERGED)
        # A lag also rounds off turns that the hysteresis model makes too sharp.
        better = clearly_better(now.held_out, other.held_out, now.noise) or worse_left_out(now.held_out, other.held_out)
        if not better:
            rest = [rival for rival in rivals.pop(effect.name, []) if rival.name != simple.name]
            rivals[simple.name] = [effect, *rest]
            now = other
    return now


def _plainer(now: Explanation, rivals: dict[str, list[Effect]]) -> Explanation:
    """Return the fit without effects at bounds, implausible or uncertain ones, or with their rivals."""
    several, refused = len(now.evidence.parts) > 1, set[str]()
    for effect in now.effects:
        name = effect.name
        if several and effect.at_bound:
            without = now.without(name)
            anew = [
                one for one in contenders(without, [name]) if one.counts_beside(without) and not one.effect.at_bound
            ]
            now = anew[0].explanation if anew else without
        elif found := plausible_ones([Contender(name, now)] if not effect.at_bound else []):
            now = found[0].explanation
        else:
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
    refined = refined_ones(tried, rest, rest.held_out.rms**2 - now.held_out.rms**2)
    return sorted(plausible_ones(refined), key=lambda one: one.rms)


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
        for _, effect in best_forms(name, rest, []):
            if keys_of_new := [other for other in effect.keys if other not in keys]:
                other = Contender(name, rest.adding(effect)).refined()
                if alike(best, other, rest.held_out, one_speed=one_speed):
                    found += [f"{name} {new}" for new in keys_of_new]
    return list(dict.fromkeys(found))
