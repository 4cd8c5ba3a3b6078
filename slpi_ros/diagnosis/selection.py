"""The competition: every effect tries to explain what is left, and the best one stays, if its gain is beyond chance."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from slpi_ros.diagnosis.explanation import Explanation
from slpi_ros.diagnosis.gather import one_speed
from slpi_ros.diagnosis.joint import Score
from slpi_ros.diagnosis.parameters import free
from slpi_ros.diagnosis.structure import BIAS, STRUCTURES
from slpi_ros.effects.base import Candidate, Effect, usual_step
from slpi_ros.effects.delay import Delay
from slpi_ros.effects.lag import Lag
from slpi_ros.effects.registry import EFFECTS
from slpi_ros.errors import ModelError
from slpi_ros.identification.progress import report_progress

FloatArray = NDArray[np.float64]

# An effect must lower the held-out error by this share of it.
LEAST_GAIN = 0.05
# No more effects than this: a record does not carry more.
MOST_EFFECTS = 4
# A gain counts when chance gives as much less often than this; two effects differ when chance does so less often.
CHANCE, ALIKE = 0.01, 0.05
SURROGATES = 1999
# Keeps losses of no noise positive (m^2).
TINY = 1e-30
# What screening finds less for than this share of the best gain, and of the error, is not tried in full.
WORTH_TRYING, LEAST_SCREENED = 0.3, 0.01
# Another effect that explains less than this share of what the best one does is no alternative to it.
ALTERNATIVE = 0.7
# The same at one drive frequency, where a better fit says little.
ALTERNATIVE_AT_ONE_SPEED = 0.4
# What one drive frequency cannot tell apart.
DYNAMIC = {"delay", "lag", "rate_dependence", "creep"}
# What shifts the displacement against the voltage.
SHIFTING = {"delay", "lag", "rate_dependence", "resonance"}
STEPS = 5
# An error below this share of the displacement range is rounding: no sensor shows more.
FINEST = 1e-6


@dataclass(frozen=True)
class Contender:
    """One more effect, fitted together with all others.

    Parameters
    ----------
    name : str
    explanation : Explanation
        With it.
    """

    name: str
    explanation: Explanation

    @property
    def score(self) -> Score:
        """Held-out score with it."""
        return self.explanation.held_out

    @property
    def parameters(self) -> int:
        """Number of its parameters that were fitted."""
        return next(free(effect).size for effect in self.explanation.effects if effect.name == self.name)


def contenders(now: Explanation, names: Iterable[str] = tuple(EFFECTS)) -> list[Contender]:
    """Return the effects, of those with the given names, that explain something of what is left; the best one first."""
    taken = {effect.name for effect in now.effects}
    screened = {name: best for name in names if name not in taken and (best := _screened(name, now))}
    error = now.held_out.rms
    most = max((error - rms for rms, _ in screened.values()), default=0.0)
    least = max(WORTH_TRYING * most, LEAST_SCREENED * error)
    found = [
        Contender(name, now.adding(effect).refined(STEPS))
        for name, (rms, effect) in screened.items()
        if error - rms > least
    ]
    return sorted((one for one in found if not _within_a_sample(one)), key=lambda contender: contender.score.rms)


def _within_a_sample(contender: Contender) -> bool:
    """Return whether a shift beside another effect of the same kind is shorter than a sample.

    How a command is held between samples does as much.
    """
    effects = {effect.name: effect for effect in contender.explanation.effects}
    shift = effects[contender.name]
    if not isinstance(shift, Delay | Lag) or not effects.keys() & SHIFTING - {contender.name}:
        return False
    seconds = shift.seconds if isinstance(shift, Delay) else shift.time_constant
    return abs(seconds) < usual_step(contender.explanation.t)


def _screened(name: str, now: Explanation) -> tuple[float, Effect] | None:
    """Return the linear form of an effect that does best, and the held-out error (m) with it.

    A simpler form that does as well, as far as the record can tell, stands for it: what is more than that goes astray
    where the record ends.
    """
    tried = [scored for form in EFFECTS[name].fit(now) if (scored := _scored(form, now))]
    if not tried:
        return None
    best = min(tried, key=lambda one: one[0].rms)
    equal = [one for one in tried if one is best or chance_of_gain(one[0], best[0]) > ALIKE]
    score, effect = min(equal, key=lambda one: (free(one[1]).size, one[0].rms))
    return score.rms, effect


def _scored(form: Candidate | Effect, now: Explanation) -> tuple[Score, Effect] | None:
    if not isinstance(form, Candidate):
        return now.adding(form).held_out, form
    score = now.score(form.columns, positive=form.positive)
    try:
        effect = form.effect(score.gains[-(form.positive or form.columns.shape[1]) :])
    except ModelError:
        # No effect has such parameters.
        return None
    return (score, effect) if effect is not None else None


def chance_of_gain(before: Score, after: Score) -> float:
    """Return how often chance lowers the losses of the blocks by as much: the sign of each gain is drawn anew.

    Gains are taken as they are, and in proportion to the losses, so that a single block of large errors does not hide
    what all others show; the clearer answer counts.
    """
    signs = _signs(before.losses.size)
    gains = (before.losses - after.losses, np.log(np.maximum(before.losses, TINY) / np.maximum(after.losses, TINY)))
    return min(float((1 + np.count_nonzero(signs @ gain >= gain.sum())) / (1 + SURROGATES)) for gain in gains)


@cache
def _signs(blocks: int) -> FloatArray:
    """Return the signs of each surrogate, shape (surrogates, blocks): always the same ones."""
    return np.random.default_rng(0).choice([-1.0, 1.0], (SURROGATES, blocks))


def gain(before: Score, after: Score) -> float:
    """Return the share of the held-out error that is gone."""
    return 1.0 - after.rms / before.rms


def counts(before: Score, after: Score) -> bool:
    """Return whether a gain is large enough, and beyond chance."""
    return gain(before, after) >= LEAST_GAIN and chance_of_gain(before, after) <= CHANCE


def alike(best: Contender, other: Contender, before: Score, *, one_speed: bool) -> bool:
    """Return whether another effect explains as much as the best one, as far as the record can tell.

    At one drive frequency what depends on time and what depends on rate cannot be told apart: a better fit says only
    which of them bends the loops in a more suitable way.
    """
    explained, by_other = before.rms**2 - best.score.rms**2, before.rms**2 - other.score.rms**2
    inseparable = one_speed and {best.name, other.name} <= DYNAMIC
    if inseparable:
        return by_other >= ALTERNATIVE_AT_ONE_SPEED * explained
    return by_other >= ALTERNATIVE * explained and chance_of_gain(other.score, best.score) > ALIKE


@dataclass(frozen=True)
class Named:
    """An effect that won.

    Parameters
    ----------
    name : str
    before, after : Score
        Without it and with it.
    alternatives : tuple of str
        Effects that explain as much, as far as the record can tell.
    runner_up : (str, float) or None
        The next best effect, and the held-out error (m) with it instead.
    """

    name: str
    before: Score
    after: Score
    alternatives: tuple[str, ...]
    runner_up: tuple[str, float] | None


@dataclass(frozen=True)
class Selection:
    """How the competition ended.

    Parameters
    ----------
    base, now : Explanation
        Before and after.
    named : tuple of Named
        Effects in the order of their gain, each added to those before it.
    structures : tuple of str
        What is wrong with the hysteresis itself, of `STRUCTURES`.
    """

    base: Explanation
    now: Explanation
    named: tuple[Named, ...]
    structures: tuple[str, ...]


def select(base: Explanation, family: Explanation | None) -> Selection:
    """Add effects as long as one of them counts; drop those that later ones make needless.

    Parameters
    ----------
    base : Explanation
        Without any.
    family : Explanation, optional
        The same by the loop family, where that does better than the kind of `base`: then effects stand beside it.
    """
    structures: tuple[str, ...]
    now, structures = (family, (BIAS,)) if family else (base, ())
    start = now
    rivals: dict[str, list[Contender]] = {}
    finest = FINEST * float(np.ptp(now.evidence.y[now.evidence.used]))
    while len(rivals) < MOST_EFFECTS and now.held_out.rms > finest:
        report_progress(f"{len(now.effects)} effects found, {now.held_out.rms * 1e9:.3g} nm left, trying others")
        found = contenders(now)
        structure, with_structure = _best_structure(now, structures)
        if structure and (not found or _beats(with_structure.held_out, found[0].score)):
            now, structures = with_structure, (*structures, structure)
            continue
        if not found or not counts(now.held_out, found[0].score):
            break
        best = _simplest(found, now)
        rivals[best.name] = [other for other in found if other is not best]
        now = _without_needless(best.explanation.smoothed(), set(rivals) - {best.name})
    now = _without_needless(now.bare(), set(rivals))
    return Selection(base, now, _named(start, now, rivals), structures)


def _simplest(found: Sequence[Contender], now: Explanation) -> Contender:
    """Return the effect with the fewest parameters of those that explain as much as the best one."""
    alone = one_speed(now.evidence)
    equal = [other for other in found if other is found[0] or alike(found[0], other, now.held_out, one_speed=alone)]
    return min(equal, key=lambda contender: (contender.parameters, contender.score.rms))


def _without_needless(now: Explanation, names: Collection[str]) -> Explanation:
    """Return it without those of the named effects that the others make needless."""
    for name in [effect.name for effect in now.effects if effect.name in names]:
        without = now.without(name)
        if not counts(without.held_out, now.held_out):
            now = without
    return now


def _best_structure(now: Explanation, taken: tuple[str, ...]) -> tuple[str | None, Explanation]:
    """Return what is wrong with the hysteresis itself, if that counts, and the explanation that allows for it."""
    best: tuple[str | None, Explanation] = (None, now)
    for name, columns in STRUCTURES.items():
        if name not in taken:
            allowing = now.beside(columns(now))
            if counts(now.held_out, allowing.held_out) and allowing.held_out.rms < best[1].held_out.rms:
                best = name, allowing
    return best


def _beats(one: Score, other: Score) -> bool:
    return one.rms < other.rms and chance_of_gain(other, one) <= ALIKE


def _named(start: Explanation, now: Explanation, rivals: Mapping[str, Sequence[Contender]]) -> tuple[Named, ...]:
    """Return the effects, each added to those before it, the one that gains most first."""
    left = [effect.name for effect in now.effects if effect.name in rivals]
    taken, before, ordered = [effect.name for effect in start.effects], start.held_out, []
    while left:
        scores = {name: now.only([*taken, name]).held_out if len(left) > 1 else now.held_out for name in left}
        best = min(left, key=lambda name: scores[name].rms)
        ordered.append(Named(best, before, scores[best], *_in_its_place(best, now, rivals[best])))
        left.remove(best)
        taken.append(best)
        before = scores[best]
    return tuple(ordered)


def _in_its_place(
    name: str, now: Explanation, rivals: Sequence[Contender]
) -> tuple[tuple[str, ...], tuple[str, float] | None]:
    """Return which rivals would do as well in the place of an effect, and the best of them."""
    present = {effect.name for effect in now.effects}
    rest = now.without(name)
    tried = []
    for rival in rivals:
        if rival.name not in present:
            effect = next(effect for effect in rival.explanation.effects if effect.name == rival.name)
            tried.append(Contender(rival.name, rest.adding(effect).refined(STEPS)))
    tried.sort(key=lambda contender: contender.score.rms)
    alone = one_speed(now.evidence)
    best = Contender(name, now)
    alternatives = tuple(other.name for other in tried if alike(best, other, rest.held_out, one_speed=alone))
    return alternatives, (tried[0].name, tried[0].score.rms) if tried else None
