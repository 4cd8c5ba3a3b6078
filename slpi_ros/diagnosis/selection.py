"""The competition: every effect tries to explain what is left, and the best one stays, if its gain is beyond chance."""

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial

import numpy as np
from numpy.typing import NDArray

from slpi_ros.diagnosis.effect_parameters import EachRecord, free
from slpi_ros.diagnosis.joint_fit import Explanation, Score
from slpi_ros.diagnosis.prepare import Evidence, drive_frequency, excited_frequency, one_speed
from slpi_ros.effects.base import Candidate, Effect, usual_step
from slpi_ros.effects.creep import Creep
from slpi_ros.effects.delay import Delay
from slpi_ros.effects.gain_drift import GainDrift
from slpi_ros.effects.hum import Hum
from slpi_ros.effects.lag import Lag
from slpi_ros.effects.registry import EFFECTS
from slpi_ros.effects.resonance import Resonance
from slpi_ros.effects.saturation import STILL, Saturation, outward_steps
from slpi_ros.effects.sensor_periodic import SensorPeriodic
from slpi_ros.effects.thermal_drift import ThermalDrift
from slpi_ros.errors import ModelError
from slpi_ros.hysteresis.reversals import monotone_runs
from slpi_ros.identification.progress import report_progress

FloatArray = NDArray[np.float64]

# What a kind of model gets wrong that the loop family gets right.
BIAS = "loops that depend on bias"
# What the loop family gets wrong.
NOT_CLOSING, LEVEL = "loops that do not close", "loops that depend on level"
# Ways (share of the voltage range) over which a material without return-point memory may forget.
FORGETS_WITHIN = (0.02, 0.05, 0.12, 0.3, 0.7)
# An effect must lower the held-out error by this share of it.
LEAST_GAIN = 0.05
# A fit from another start is taken when it lowers the error by this share of it.
BETTER = 0.01
# No more effects than this: a record does not carry more.
MOST_EFFECTS = 4
# A gain counts when chance gives as much less often than this; two effects differ when chance does so less often.
CHANCE, ALIKE = 0.01, 0.05
SURROGATES = 1999
# Keeps losses of no noise positive (m^2).
TINY = 1e-30
# What screening finds less for than this share of the best gain, and of the error, is not tried in full.
WORTH_TRYING, LEAST_SCREENED = 0.3, 0.01
# After one step towards its best parameters an effect is given up that explains less than this share of what the best
# one does.
WORTH_REFINING = 0.3
# Another effect that explains less than this share of what the best one does is no alternative to it.
ALTERNATIVE = 0.7
# The same at one drive frequency, where a better fit says little.
ALTERNATIVE_AT_ONE_SPEED = 0.4
# What one drive frequency cannot tell apart.
DYNAMIC = {"delay", "lag", "rate_dependence", "creep"}
# What is shared by all records, or each record's own: where a sensor begins to count it may begin its period.
MAY_BE_OWN = {"sensor_periodic"}
# Zeros are alike for a sensor's error when they differ by no more than this share of its period.
IN_PHASE = 0.1
# What does nothing but shift in time.
SHIFTS = {"delay", "lag"}
# What shifts the displacement against the voltage.
SHIFTING = {"delay", "lag", "rate_dependence", "resonance"}
STEPS = 5
# Of other records none may be off by more than so many times what it was without an effect.
NO_WORSE = 1.05
# A shift by less than this share of a sample is how commands are held.
HELD = 0.6
# Warmth takes time (s), and moves a stage by no more than this share of its motion in a second.
DRIFT_TAKES, DRIFT_RATE = 10.0, 1e-2
# What keeps its place while the sensitivity changes is no further outside the record than this share of its range.
ORIGIN = 0.3
# Multiples of the drive's frequency that may be what is left of hysteresis.
MOST_HARMONICS = 15
# A resonance is seen up to so many times the highest frequency that the drive excites.
RINGS = 2.0
# Rounding errors (their rms) repeat with every digit, that is sqrt(12) times as far; what is left of a record is
# rounding when it is no more than so many times that.
ROUNDING_PERIOD, ROUNDING_LEFT = 1.3 * 12**0.5, 1.3
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
    def effect(self) -> Effect:
        """The effect itself."""
        return self.explanation.effect(self.name)

    @property
    def score(self) -> Score:
        """Held-out score with it."""
        return self.explanation.held_out

    @property
    def rms(self) -> float:
        """Held-out error (m) that it competes with."""
        return held_out_error(self.score, own=is_own(self.effect))

    @property
    def parameters(self) -> int:
        """Number of its parameters that were fitted."""
        return free(self.effect).size

    def refined(self, steps: int = STEPS) -> "Contender":
        """Return it with its parameters at their best, unless that does worse on what is left out."""
        better = Contender(self.name, self.explanation.refined(steps))
        return min(self, better, key=lambda one: one.rms)

    def counts_beside(self, now: Explanation) -> bool:
        """Return whether it gains enough over what has been found so far."""
        return counts(now.held_out, self.score, own=is_own(self.effect))


def is_own(effect: Effect) -> bool:
    """Return whether an effect is each record's own."""
    return effect.removable == "record"


def held_out_error(score: Score, *, own: bool) -> float:
    """Return the held-out error (m) that counts for an effect: on other records, if it is not each record's own."""
    return score.rms if own else score.rms_of_records


def contenders(now: Explanation, names: Iterable[str] = tuple(EFFECTS)) -> list[Contender]:
    """Return the effects, of those with the given names, that explain something of what is left; the best one first.

    Effects that every record shares come before those that are each record's own, where both count.
    """
    taken = {effect.name for effect in now.effects}
    screened = {name: best for name in names if name not in taken and (best := _screened(name, now))}
    error = now.held_out.rms
    # What is not plausible does not set the mark for others.
    most = max((error - score.rms for score, effect in screened.values() if plausible(effect, now)), default=0.0)
    least = max(WORTH_TRYING * most, LEAST_SCREENED * error)
    tried = [
        Contender(name, now.adding(effect)).refined(1)
        for name, (score, effect) in screened.items()
        if error - score.rms > least
    ]
    sound = [one for one in tried if plausible(one.effect, one.explanation)]
    most = max((error**2 - one.score.rms**2 for one in sound), default=0.0)
    sound = [one for one in _refined(tried, now, most) if plausible(one.effect, one.explanation)]
    several = len(now.evidence.parts) > 1

    def rank(one: Contender) -> tuple[bool, float]:
        return several and (is_own(one.effect) or not one.counts_beside(now)), one.rms

    return sorted(sound, key=rank)


def _refined(tried: Sequence[Contender], before: Explanation, most: float) -> list[Contender]:
    """Return contenders with their parameters at their best, where the first step shows that to be worth while.

    Parameters
    ----------
    tried : sequence of Contender
        After one step.
    before : Explanation
        Without them.
    most : float, m^2
        By how much the best one lowers the mean square of the held-out error.
    """
    square, least = before.held_out.rms**2, WORTH_REFINING * most
    return [one.refined() if square - one.score.rms**2 >= least else one for one in tried]


def plausible(effect: Effect, now: Explanation) -> bool:
    """Return whether an effect is what its name says, and not something else in its shape."""
    if isinstance(effect, EachRecord):
        return all(plausible(part, now) for part in effect.parts)
    evidence, motion = now.evidence, float(np.ptp(now.y[now.used]))
    match effect:
        case Delay() | Lag():
            # How a command is held between samples does as much as a shift by less than that.
            shift = effect.seconds if isinstance(effect, Delay) else effect.time_constant
            others = {other.name for other in now.effects} & SHIFTING - {effect.name}
            return not others or abs(shift) > HELD * usual_step(evidence.t)
        case ThermalDrift():
            pairs = zip(np.diff(effect.values).tolist(), np.diff(effect.times).tolist(), strict=True)
            return effect.times[-1] >= DRIFT_TAKES and all(abs(dy) <= DRIFT_RATE * motion * dt for dy, dt in pairs)
        case GainDrift():
            # Gains round an origin far away are a thermal drift.
            y = now.y[now.used]
            near = float(y.min()) - ORIGIN * motion <= effect.origin <= float(y.max()) + ORIGIN * motion
            return near and effect.times[-1] >= DRIFT_TAKES
        case Saturation():
            return _stands_still(effect, now)
        case Hum():
            return not _is_harmonic(effect.frequency, evidence)
        case Resonance():
            # Far above all that is excited a resonance is a shift, and bends with the frequency as hysteresis does.
            return effect.frequency <= RINGS * excited_frequency(evidence)
        case SensorPeriodic():
            return bool(effect.period > ROUNDING_PERIOD * evidence.rounding)
    return True


def _stands_still(effect: Saturation, now: Explanation) -> bool:
    """Return whether the stage stands still beyond the limits, where the voltage goes on."""
    middle, dv, dy = outward_steps(now.evidence.v, now.y, now.used)
    inside = (middle > effect.lower) & (middle < effect.upper)
    usual = float(dv[inside] @ dy[inside] / max(float(dv[inside] @ dv[inside]), 1e-300))
    for beyond in (middle >= effect.upper, middle <= effect.lower):
        if beyond.any() and float(dv[beyond] @ dy[beyond]) > STILL * usual * float(dv[beyond] @ dv[beyond]):
            return False
    return True


def _is_harmonic(frequency: float, evidence: Evidence) -> bool:
    """Return whether a frequency (Hz) is a low multiple of the only one that drives a record, as far as that can tell.

    What is left of hysteresis fades with the order; of high multiples one is near to any frequency.
    """
    for k, part in enumerate(evidence.parts):
        drive = drive_frequency(evidence.of_record(k))
        if not drive:
            continue
        order = round(frequency / drive)
        if order <= MOST_HARMONICS and abs(frequency - order * drive) < 2.0 / float(part.t[-1]):
            return True
    return False


def _screened(name: str, now: Explanation) -> tuple[Score, Effect] | None:
    """Return the linear form of an effect that does best, and its score.

    A simpler form that does as well, as far as the record can tell, stands for it: what is more than that goes astray
    where the record ends.
    """
    tried = [scored for form in _forms(name, now) if (scored := _scored(form, now)) and in_phase(scored[1], now)]
    if not tried:
        return None

    def error(one: tuple[Score, Effect]) -> float:
        return held_out_error(one[0], own=is_own(one[1]))

    best = min(tried, key=error)
    equal = [one for one in tried if one is best or chance_of_gain(one[0], best[0]) > ALIKE]
    return min(equal, key=lambda one: (free(one[1]).size, error(one)))


def in_phase(effect: Effect, now: Explanation) -> bool:
    """Return whether an effect that depends on the reading is at the same displacements in all records.

    Where their zeros differ, those of other records do as well, and nothing tells what the effect is there.
    """
    if not isinstance(effect, SensorPeriodic) or len(now.evidence.parts) == 1:
        return True
    return float(np.ptp(now.zeros)) <= IN_PHASE * effect.period


def _forms(name: str, now: Explanation) -> Iterator[Candidate | Effect]:
    """Yield what an effect may be; one of every record where it is each record's own, or may be."""
    records, own = len(now.evidence.parts), EFFECTS[name].removable == "record"
    if not own or records == 1:
        yield from EFFECTS[name].fit(now)
    if records == 1 or not (own or name in MAY_BE_OWN):
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
    """Return the share of the held-out error on blocks that is gone."""
    return 1.0 - after.rms / before.rms


def carries_over(before: Score, after: Score) -> bool:
    """Return whether what was found on some records lowers the error on the others; True for one record.

    On each of them, or on all together by the share that counts.
    """
    ratio = _ratio_on_records(before, after)
    lower = ratio.size == 0 or float(ratio.max()) < 1.0
    return lower or _carries_over_clearly(before, after)


def _carries_over_clearly(before: Score, after: Score) -> bool:
    """Return whether the error on records that were left out falls by the share that counts, and grows on none."""
    ratio = _ratio_on_records(before, after)
    less = after.rms_of_records <= (1.0 - LEAST_GAIN) * before.rms_of_records
    return ratio.size > 0 and float(ratio.max()) <= NO_WORSE and less


def _ratio_on_records(before: Score, after: Score) -> FloatArray:
    """Return after / before of the errors on the records that were left out and could be judged."""
    if not before.records.size:
        return np.empty(0)
    both = np.isfinite(before.records) & np.isfinite(after.records)
    ratio: FloatArray = np.sqrt(after.records[both] / np.maximum(before.records[both], TINY))
    return ratio


def counts(before: Score, after: Score, *, own: bool = True) -> bool:
    """Return whether a gain is large enough, beyond chance, and, but for what is each record's own, carries over."""
    if not (gain(before, after) >= LEAST_GAIN and chance_of_gain(before, after) <= CHANCE):
        return False
    return own or carries_over(before, after)


def alike(best: Contender, other: Contender, before: Score, *, one_speed: bool) -> bool:
    """Return whether another effect explains as much as the best one, as far as the record can tell.

    At one drive frequency what depends on time and what depends on rate cannot be told apart: a better fit says only
    which of them bends the loops in a more suitable way. Shifts by less than a sample look the same. Of several records
    those that are left out decide as well.
    """
    explained, by_other = before.rms**2 - best.score.rms**2, before.rms**2 - other.score.rms**2
    if best.name in SHIFTS and other.name == Resonance.name:
        # It is a shift that rings as well: where it does no better nothing rings.
        return False
    if best.score.records.size and other.score.rms_of_records > NO_WORSE * best.score.rms_of_records:
        return False
    if one_speed and {best.name, other.name} <= DYNAMIC:
        return by_other >= ALTERNATIVE_AT_ONE_SPEED * explained
    if {best.name, other.name} == {"delay", "lag"} and _shift(best.effect) < usual_step(best.explanation.t):
        return by_other >= ALTERNATIVE * explained
    return by_other >= ALTERNATIVE * explained and chance_of_gain(other.score, best.score) > ALIKE


def _shift(effect: Effect) -> float:
    """Return by how much (s) a delay or lag shifts the displacement."""
    return abs(effect.seconds) if isinstance(effect, Delay) else getattr(effect, "time_constant", np.inf)


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
    own : bool
        Whether it is each record's own.
    confirmed : bool
        Whether each record, left out, says that it belongs to the others' explanation.
    """

    name: str
    before: Score
    after: Score
    alternatives: tuple[str, ...]
    runner_up: tuple[str, float] | None
    confirmed: bool
    own: bool


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
    dropped : tuple of str
        Effects that explain the records they were found on and make others worse.
    """

    base: Explanation
    now: Explanation
    named: tuple[Named, ...]
    structures: tuple[str, ...]
    dropped: tuple[str, ...]


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
    # Their effects alone: a fit takes much room.
    rivals: dict[str, list[Effect]] = {}
    dropped: set[str] = set()
    exchanged = False
    finest = max(FINEST * float(np.ptp(now.y[now.used])), ROUNDING_LEFT * now.evidence.rounding)
    while len(rivals) < MOST_EFFECTS and now.held_out.rms > finest:
        report_progress(f"{len(now.effects)} effects found, {now.held_out.rms * 1e9:.3g} nm left, trying others")
        found = contenders(now)
        structure, with_structure = _best_structure(now, structures)
        if structure and (not found or _beats(with_structure.held_out, found[0].score)):
            now, structures = with_structure, (*structures, structure)
            continue
        dropped |= {one.name for one in found if counts(now.held_out, one.score) and not one.counts_beside(now)}
        if not found or not found[0].counts_beside(now):
            names = {effect.name for effect in now.effects}
            if not exchanged and len(now.effects) > 1:
                # Rivals come with their best parameters.
                now, exchanged = _exchanged(now.refined(STEPS), rivals), True
            if {effect.name for effect in now.effects} == names:
                break
            continue
        best = _simplest(found, now)
        rivals[best.name] = [other.effect for other in found if other is not best]
        now = _without_needless(best.explanation.smoothed(), set(rivals) - {best.name})
        if {Creep.name, ThermalDrift.name} <= {effect.name for effect in now.effects} and not now.evidence.older_moves:
            # Creep from long before a record looks like a thermal drift.
            now = _without_needless(now.with_older_moves(), {ThermalDrift.name})
    # Effects that were exchanged, and structures that no longer stand beside them, may make others needless.
    with_structures, now = now, now.bare()
    now = _without_needless(now, set(rivals), restart=now is not with_structures)
    named = _named(start, now, rivals)
    return Selection(base, now, named, structures, tuple(sorted(dropped - {one.name for one in named})))


def _simplest(found: Sequence[Contender], now: Explanation) -> Contender:
    """Return the effect with the fewest parameters of those that explain as much as the best one."""
    alone = one_speed(now.evidence)
    equal = [
        other
        for other in found
        if other is found[0] or (other.counts_beside(now) and alike(found[0], other, now.held_out, one_speed=alone))
    ]
    return min(equal, key=lambda contender: (contender.parameters, contender.score.rms))


def _without_needless(now: Explanation, names: Collection[str], *, restart: bool = True) -> Explanation:
    """Return it without those of the named effects that the others make needless.

    One that is not needed as it is, with `restart` (default) each one, is tried from a new start: an effect that was
    found while another one was missing may have settled at parameters that make up for that.
    """
    for name in [effect.name for effect in now.effects if effect.name in names]:
        without = now.without(name)
        needed = counts(without.held_out, now.held_out, own=is_own(now.effect(name)))
        # The others may have come to their best only without it.
        anew = contenders(without, [name]) if without.effects and (restart or not needed) else []
        for one in anew:
            if one.counts_beside(without) and (not needed or gain(now.held_out, one.score) > BETTER):
                now, needed = one.explanation, True
        if not needed:
            now = without
    return now


def _exchanged(now: Explanation, rivals: dict[str, list[Effect]]) -> Explanation:
    """Return it with a rival in the place of an effect that it beats, or that it equals with fewer parameters.

    Which effect came first depends on what else was missing then.
    """
    alone = one_speed(now.evidence)
    for name in [effect.name for effect in now.effects if effect.name in rivals]:
        rest, best = now.without(name), Contender(name, now)
        better = [
            one
            for one in _tried(name, now, rest, rivals[name])
            if one.counts_beside(rest)
            and (
                one.rms < (1.0 - BETTER) * best.rms
                or (one.parameters < best.parameters and alike(best, one, rest.held_out, one_speed=alone))
            )
        ]
        if better:
            one = min(better, key=lambda other: other.rms)
            rivals[one.name] = [best.effect, *(rival for rival in rivals.pop(name) if rival.name != one.name)]
            now = one.explanation
    return now


def _tried(name: str, now: Explanation, rest: Explanation, rivals: Sequence[Effect]) -> list[Contender]:
    """Return rivals in the place of an effect, fitted beside the `rest`, the best one first."""
    present = {effect.name for effect in now.effects}
    tried = [Contender(rival.name, rest.adding(rival).refined(1)) for rival in rivals if rival.name not in present]
    refined = _refined(tried, rest, rest.held_out.rms**2 - now.held_out.rms**2)
    return sorted(refined, key=lambda contender: contender.rms)


def _best_structure(now: Explanation, taken: tuple[str, ...]) -> tuple[str | None, Explanation]:
    """Return what is wrong with the hysteresis itself, if that counts, and the explanation that allows for it."""
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
    """Return the effects, each added to those before it, the one that gains most first."""
    left = [effect.name for effect in now.effects if effect.name in rivals]
    taken, before, ordered = [effect.name for effect in start.effects], start.held_out, []
    while left:
        scores = {name: now.only([*taken, name]).held_out if len(left) > 1 else now.held_out for name in left}
        best = min(left, key=lambda name: scores[name].rms)
        beside = _in_its_place(best, now, rivals[best])
        ordered.append(Named(best, before, scores[best], *beside, own=is_own(now.effect(best))))
        left.remove(best)
        taken.append(best)
        before = scores[best]
    return tuple(ordered)


def _in_its_place(
    name: str, now: Explanation, rivals: Sequence[Effect]
) -> tuple[tuple[str, ...], tuple[str, float] | None, bool]:
    """Return which rivals would do as well in the place of an effect, the best of them, and whether it is confirmed."""
    rest, best = now.without(name), Contender(name, now)
    tried = _tried(name, now, rest, rivals)
    alone = one_speed(now.evidence)
    alternatives = [other.name for other in tried if alike(best, other, rest.held_out, one_speed=alone)]
    inseparable = [other.name for other in tried if {name, other.name} <= DYNAMIC]
    if alone and name in DYNAMIC and not alternatives:
        # A better fit at one frequency says only which of them bends the loops in a more suitable way.
        alternatives = inseparable[:1] or [one for one in ("rate_dependence", "creep") if one != name][:1]
    confirmed = _carries_over_clearly(rest.held_out, now.held_out)
    return tuple(alternatives), (tried[0].name, tried[0].score.rms) if tried else None, confirmed


def _do_not_close(now: Explanation) -> FloatArray:
    """Return what forgets with the way, not at turning points: Duhem operators, such as Bouc and Wen's.

    Each follows ``dz = dv - z |dv| / w`` for a way ``w``; at whatever speed.
    """
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
    """Return what bends the displacement: then loops between the same turns differ with the level they hang on."""
    x = now.h - now.h.mean()
    x = x / np.abs(x).max()
    return np.column_stack([x**2, x**3]) * float(np.ptp(now.h))


STRUCTURES: Mapping[str, Callable[[Explanation], FloatArray]] = {
    NOT_CLOSING: _do_not_close,
    LEVEL: _bent,
}
