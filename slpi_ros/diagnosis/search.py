"""Search for the set of effects that predicts best what was not fitted."""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import pairwise
from typing import Any

import numpy as np

from slpi_ros.arrays import FloatArray
from slpi_ros.diagnosis.effect_parameters import EachRecord, free
from slpi_ros.diagnosis.held_out import RIDGE, HeldOut, Loss
from slpi_ros.diagnosis.joint_fit import Explanation
from slpi_ros.diagnosis.prepare import drive_frequency, excited_frequency
from slpi_ros.diagnosis.ruler import EXPLAINED, LEAST, beats, chance, independent_trials, share
from slpi_ros.diagnosis.structures import STRUCTURES
from slpi_ros.effects.base import Candidate, Effect, FitContext, is_course
from slpi_ros.effects.registry import EFFECTS
from slpi_ros.errors import ModelError
from slpi_ros.identification.progress import report_progress

# Largest number of effects of a set; sets that are continued, and sets of a round that are refined.
MOST_EFFECTS, WIDTH, MOST_TRIED = 4, 3, 20
# Places of sets of so many forms among those that are fitted in a round.
PLACES = ((1, 4), (2, 2), (3, 1))
# Gauss-Newton steps of a set, and of the best one.
STEPS, CONVERGED = 5, 15
# Largest number of rounds, each with columns at new parameters.
MOST_ROUNDS = 6


def is_own(effect: Effect | type[Any]) -> bool:
    """Return whether an effect, or each of its kind, has separate parameters in each record, such as drift or lines."""
    return effect.side == "record" or effect.sharing == "separate"


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
    """Return whether an effect of a joint fit may be what it is called."""
    if any(leaf.at_bound for leaf in effect.free_leaves()):
        return False
    return is_course(*effect.courses) and effect.plausible(seen(now)) and effect.in_phase(seen(now))


@dataclass(frozen=True)
class Fitted:
    """A set of effects with their parameters, the defects of the hysteresis fitted beside it, and what it leaves."""

    effects: tuple[Effect, ...]
    structures: tuple[str, ...]
    loss: Loss
    numbers: int

    @classmethod
    def of(cls, now: Explanation, structures: tuple[str, ...]) -> "Fitted":
        """Return what is kept of a joint fit."""
        numbers = sum(free(effect).size for effect in now.effects) + now.evidence.beside.shape[1]
        return cls(tuple(now.effects), structures, now.held_out, numbers)

    @property
    def key(self) -> tuple[tuple[str, ...], int]:
        """Names of the effects and structures, and how many numbers they have."""
        return (*sorted(effect.name for effect in self.effects), *self.structures), self.numbers


@dataclass(frozen=True, eq=False)
class Form:
    """One form of an effect, or of a defect of the hysteresis, with its place among the columns."""

    name: str
    candidate: Candidate | Effect | None  # None: of the hysteresis
    first: int
    end: int
    numbers: int

    @property
    def places(self) -> range:
        """Its columns."""
        return range(self.first, self.end)

    @property
    def kind(self) -> tuple[str, int]:
        """Name, and group of forms that lead to other parameters."""
        return self.name, getattr(self.candidate, "group", 0)

    @property
    def positive(self) -> range:
        """Columns with gains that are not negative."""
        count = self.candidate.positive if isinstance(self.candidate, Candidate) else 0
        return range(self.end - count, self.end)


@dataclass(frozen=True)
class Choice:
    """Forms added to a joint fit, effects taken from it, and what would be left to first order."""

    removed: frozenset[str]
    forms: tuple[Form, ...]
    square: float  # m^2, mean
    blocks: FloatArray  # m^2, sums over blocks

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the forms, with the groups that lead to other parameters."""
        return tuple(sorted(f"{name} {group}" for name, group in (form.kind for form in self.forms)))


class Library:
    """Columns of all candidates for a joint fit, with which sets are compared to first order."""

    def __init__(self, now: Explanation, structures: Collection[str], names: Collection[str] | None = None) -> None:
        self.now = now
        effects = now.effects
        contributions = [now.predicted - now.prediction_without(effect.name) for effect in effects]
        own = np.column_stack([now.target, *contributions, now.before, now.tangents])
        first = 1 + len(effects)
        starts = [range(first + a, first + b) for a, b in pairwise(now.starts)]
        self._beside = range(first + now.starts[-1], first + now.before.shape[1])
        ends = first + now.before.shape[1] + np.cumsum([0, *(free(effect).size for effect in effects)])
        self._own = {
            effect.name: (1 + k, [*starts[k], *range(*ends[k : k + 2].tolist())]) for k, effect in enumerate(effects)
        }
        sampled, forms, place = [now.joint.sampled(own)], [], own.shape[1]
        for name, candidate, columns in self._candidates(structures, names):
            numbers = columns.shape[1]
            forms.append(Form(name, candidate, place, place + numbers, numbers))
            sampled.append(now.joint.sampled(columns))
            place += numbers
        self.forms = forms
        at = np.column_stack(sampled)
        size = np.linalg.norm(at, axis=0)
        size[: own.shape[1]] = 1.0
        self._size = np.where(size > 0.0, size, 1.0)
        self.held_out: HeldOut = now.joint.held_out(at / self._size)
        self._known: dict[tuple[frozenset[str], frozenset[Form]], Choice] = {}

    def _candidates(
        self, structures: Collection[str], names: Collection[str] | None
    ) -> Iterator[tuple[str, Candidate | Effect | None, FloatArray]]:
        for name in EFFECTS if names is None else names:
            for form in _forms(name, self.now):
                if isinstance(form, Candidate):
                    if form.columns.shape[1] and np.isfinite(form.columns).all():
                        yield name, form, form.columns
                else:
                    try:
                        yield name, form, (self.now.predicted_with(form) - self.now.predicted)[:, None]
                    except ModelError:
                        continue
        if names is None:
            for name, columns in STRUCTURES.items():
                if name not in structures:
                    yield name, None, columns(self.now)

    def base(self, removed: Collection[str]) -> tuple[list[int], list[int]]:
        """Return the columns that add up to the target, and those of the effects that stay."""
        kept = [self._own[name] for name in self._own if name not in removed]
        target = [0, *(self._own[name][0] for name in removed)]
        return target, [*self._beside, *(place for _, places in kept for place in places)]

    def choice(self, removed: frozenset[str], forms: tuple[Form, ...]) -> Choice:
        """Return a set with what is left to first order."""
        key = removed, frozenset(forms)
        if key not in self._known:
            target, kept = self.base(removed)
            chosen = [*kept, *(place for form in forms for place in form.places)]
            loss = self.held_out.loss(target, chosen, {place for form in forms for place in form.positive})
            self._known[key] = Choice(removed, forms, loss.square, loss.blocks)
        return self._known[key]

    def ban(self, forms: Sequence[Form]) -> None:
        """Leave out forms that have shown to mean nothing."""
        banned = {form.kind for form in forms}
        self.forms = [form for form in self.forms if form.kind not in banned]

    def screened(self, removed: Collection[str], taken: Sequence[Form], once: Collection[str]) -> list[Form]:
        """Return the forms that explain most of the fitted samples, the best of each group of each effect."""
        target, kept = self.base(removed)
        chosen = [*kept, *(place for form in taken for place in form.places)]
        whole = self.held_out.whole
        vector = whole[:, target].sum(axis=1)
        if chosen:
            inner = whole[np.ix_(chosen, chosen)]
            size = np.sqrt(np.maximum(np.diag(inner), 1e-300))
            scaled = inner / np.outer(size, size) + RIDGE * np.eye(size.size)
            beside = whole[chosen] / size[:, None]
            solution = np.linalg.lstsq(scaled, np.column_stack([beside, vector[chosen] / size]), rcond=RIDGE)[0]
            vector = vector - beside.T @ solution[:, -1]
            whole = whole - beside.T @ solution[:, :-1]
        best: dict[tuple[str, int, int], tuple[float, Form]] = {}
        names = {form.name for form in taken}
        for form in self.forms:
            if form.name in once or form.name in names:
                continue
            places = list(form.places)
            own, wanted = whole[np.ix_(places, places)], vector[places]
            size = np.sqrt(np.maximum(np.diag(self.held_out.whole)[places], 1e-300))
            gain = float(
                wanted / size @ np.linalg.solve(own / np.outer(size, size) + 1e-6 * np.eye(len(places)), wanted / size)
            )
            key = form.name, getattr(form.candidate, "group", 0), form.numbers
            if key not in best or gain > best[key][0]:
                best[key] = gain, form
        return [form for _, form in sorted(best.values(), key=lambda pair: -pair[0])]

    def choices(self, fixed: Collection[str], screened: int = 12) -> list[Choice]:
        """Return sets in reach: forms added, to all effects and to all but one, the least error first."""
        present = {effect.name: effect for effect in self.now.effects}
        found: dict[tuple[Any, ...], Choice] = {}
        for removed in (frozenset[str](), *(frozenset({name}) for name in present if name not in fixed)):
            once = {name for name, effect in present.items() if name not in removed and effect.joined(effect) is None}
            begun = self.choice(removed, ())
            if removed:
                found[removed, ()] = begun
            beam = [begun]
            while beam:
                grown: dict[tuple[str, ...], Choice] = {}
                for choice in beam:
                    if len(present) - len(removed) + len(choice.forms) >= MOST_EFFECTS + len(fixed):
                        continue
                    for form in self.screened(removed, choice.forms, once)[:screened]:
                        one = self.choice(removed, (*choice.forms, form))
                        if one.names not in grown or one.square < grown[one.names].square:
                            grown[one.names] = one
                found.update({(removed, names): one for names, one in grown.items()})
                least = min(choice.square for choice in beam)
                beam = sorted((one for one in grown.values() if one.square < least), key=lambda one: one.square)[:WIDTH]
        return sorted(found.values(), key=lambda one: one.square)

    def fit(self, choice: Choice) -> Explanation | Form:
        """Return the joint fit with a choice at first parameters, or the form of it that is not admissible."""
        target, kept = self.base(choice.removed)
        chosen = [*kept, *(place for form in choice.forms for place in form.places)]
        positive = {place for form in choice.forms for place in form.positive}
        gains = self.held_out.gains(target, chosen, positive)
        at = dict(zip(chosen, (gains / self._size[chosen]).tolist(), strict=True))
        fit = self.now.only(
            [effect.name for effect in self.now.effects if effect.name not in choice.removed], refine=False
        )
        for form in choice.forms:
            if form.candidate is None:
                fit = fit.beside(STRUCTURES[form.name](self.now))
                continue
            try:
                own = np.array([at[place] for place in (form.positive or form.places)])
                effect = form.candidate.effect(own) if isinstance(form.candidate, Candidate) else form.candidate
                if effect is None:
                    return form
                fit = fit.adding(effect)
            except ModelError:
                return form
        return fit


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


@dataclass
class Search:
    """Search from a joint fit without new effects; `fixed` are the effects that it has."""

    base: Explanation
    names: Sequence[str] | None = None
    pool: dict[Any, Fitted] = field(default_factory=dict)
    trials: float = 1.0
    structures: tuple[str, ...] = ()

    @cached_property
    def fixed(self) -> tuple[str, ...]:
        """Names of the effects of the given model."""
        return tuple(effect.name for effect in self.base.effects)

    def note(self, now: Explanation, structures: tuple[str, ...]) -> Fitted:
        """Keep a joint fit, if it is the best one of its set."""
        fitted = Fitted.of(now, structures)
        if fitted.key not in self.pool or fitted.loss.square < self.pool[fitted.key].loss.square:
            self.pool[fitted.key] = fitted
        return fitted

    def plausible(self, now: Explanation) -> tuple[Explanation, list[str]]:
        """Return a joint fit without the effects, and parts of effects, that mean nothing, and the names of effects."""
        nonsense: list[str] = []
        for effect in now.effects:
            if effect.name in self.fixed or is_plausible(now.effect(effect.name), now):
                continue
            part = now.effect(effect.name).only_plausible(seen(now))
            if part is not None and free(part).size:
                fewer = now.replacing(effect.name, part).refined(1)
                if is_plausible(fewer.effect(effect.name), fewer):
                    now = fewer
                    continue
            nonsense.append(effect.name)
            now = now.without(effect.name)
        return now, nonsense

    def run(self) -> tuple[Explanation, tuple[str, ...]]:
        """Return the best joint fit that was found, and the structures beside it."""
        now, structures = self.base, self.structures
        self.note(now, structures)
        for _ in range(MOST_ROUNDS):
            report_progress(f"{len(now.effects)} effects, {now.held_out.rms * 1e9:.3g} nm left, trying others")
            library = Library(now, structures, self.names)
            best, best_structures = now, structures
            choices = library.choices(self.fixed)
            self.trials = max(self.trials, independent_trials(now.held_out.blocks, [one.blocks for one in choices]))
            tried: set[tuple[Any, ...]] = set()
            for _ in range(MOST_TRIED):
                choice = next(
                    (one for one in self.worth_fitting(choices, now) if (one.removed, one.forms) not in tried), None
                )
                if choice is None:
                    break
                tried.add((choice.removed, choice.forms))
                found = library.fit(choice)
                if isinstance(found, Form):
                    library.forms.remove(found)
                    choices = library.choices(self.fixed)
                    continue
                ref = found.refined(STEPS)
                fit, nonsense = self.plausible(ref)
                if nonsense:
                    # What is left of it may mean something.
                    fit, worse = self.plausible(fit.refined(STEPS))
                    library.ban([form for form in choice.forms if form.name in nonsense])
                    choices = library.choices(self.fixed)
                    if worse:
                        continue
                taken = (*structures, *(form.name for form in choice.forms if form.candidate is None))
                self.note(fit, taken)
                if fit.held_out.square < best.held_out.square:
                    best, best_structures = fit, taken
            if best is now:
                break
            gained = 1.0 - best.held_out.square / now.held_out.square
            now, structures = best.refined(CONVERGED), best_structures
            if now.held_out.square > best.held_out.square:
                now = best
            self.note(now, structures)
            if gained < 0.002:
                break
        return now, structures

    def worth_fitting(self, choices: Sequence[Choice], now: Explanation) -> list[Choice]:
        """Return the choices with the least error of each number of forms, few forms first."""
        most = now.held_out.square - (LEAST * now.noise) ** 2
        better = [one for one in choices if one.forms and one.square < most]
        return [one for count, most in PLACES for one in [each for each in better if len(each.forms) == count][:most]]


@dataclass(frozen=True)
class Named:
    """An effect of the answer, with what the effects before it leave, without it and with it."""

    name: str
    before: Loss
    after: Loss
    # What all others leave, and the probability that chance makes the set with it so much better.
    without: Loss
    p_value: float
    # Effects with which a set of no more numbers is not worse; the best one in its place, with its rms error (m).
    alternatives: tuple[str, ...]
    runner_up: tuple[str, float] | None


@dataclass(frozen=True)
class Answer:
    """The set of effects that a diagnosis gives: joint fit without and with it."""

    base: Explanation
    now: Explanation
    # The largest gain first; each gain is relative to the preceding effects.
    named: tuple[Named, ...]
    # Defects of the hysteresis model: `BIAS`, or keys of `STRUCTURES`.
    structures: tuple[str, ...] = ()
    # Effects that sets which predict better have, but do not mean what they are called, or are worse on a record.
    dropped: tuple[str, ...] = ()
    trials: float = 1.0

    def without_all(self) -> "Answer":
        """Return the answer that names nothing."""
        names = {*self.dropped, *(one.name for one in self.named)}
        return replace(self, now=self.base, named=(), dropped=tuple(sorted(names)))


class Judge:
    """Choice of the answer among the sets of a search, and its alternatives."""

    def __init__(self, search: Search) -> None:
        self.search, self.base = search, search.base
        self._noise = 0.0

    def rebuilt(self, fitted: Fitted) -> Explanation:
        """Return the joint fit of a set again."""
        base = self.base
        for name in fitted.structures:
            base = base.beside(STRUCTURES[name](self.base))
        return Explanation(base.evidence, fitted.effects, base)

    def numbers(self, now: Explanation) -> int:
        """Return how many numbers a joint fit has."""
        return Fitted.of(now, ()).numbers

    def beats(self, one: Explanation | Fitted, other: Explanation | Fitted) -> bool:
        """Return whether one set is better than another one."""
        a, b = (each.loss if isinstance(each, Fitted) else each.held_out for each in (one, other))
        return beats(a, b, self._noise, self.search.trials)

    def answer(self) -> Answer:
        """Return the set with the fewest numbers of those that the best one does not beat."""
        now, structures = self.search.run()
        self._noise = now.noise
        best = now = self.meaningful(now)
        for fitted in sorted(self.search.pool.values(), key=lambda one: (one.numbers, one.loss.square)):
            if fitted.numbers >= self.numbers(now):
                break
            if not self.beats(best, fitted):
                fewer = self.rebuilt(fitted).refined(CONVERGED)
                if not self.beats(best, fewer) and not self.senseless(fewer):
                    now, structures = fewer, fitted.structures
                    break
        now, structures = self.needed(now, best, structures)
        now, rivals = self.exchanged(now)
        now, structures = self.needed(now, max(now, best, key=lambda one: -one.held_out.square), structures)
        return Answer(self.base, now, self.named(now, rivals), structures, (), self.search.trials)

    def free(self, now: Explanation) -> list[str]:
        """Return the names of the effects that were found."""
        return [effect.name for effect in now.effects if effect.name not in self.search.fixed]

    def without(self, now: Explanation, name: str) -> Explanation:
        """Return the best joint fit of the other effects."""
        fit = now.without(name).refined(CONVERGED)
        names = sorted(effect.name for effect in fit.effects)
        same = [one for one in self.search.pool.values() if sorted(effect.name for effect in one.effects) == names]
        known = min(same, key=lambda one: one.loss.square, default=None)
        if known is None or known.loss.square >= fit.held_out.square:
            return fit
        return self.rebuilt(known).refined(CONVERGED)

    def senseless(self, now: Explanation) -> dict[str, float]:
        """Return the effects that explain too little of what is there where they act, with that share."""
        shares = {name: share(now.held_out, self.without(now, name).held_out, now.noise) for name in self.free(now)}
        return {name: found for name, found in shares.items() if found < EXPLAINED}

    def meaningful(self, now: Explanation) -> Explanation:
        """Return a joint fit without the effects that explain too little of what is there where they act."""
        while found := self.senseless(now):
            now = self.without(now, min(found, key=lambda name: found[name]))
        return now

    def needed(
        self, now: Explanation, best: Explanation, structures: tuple[str, ...]
    ) -> tuple[Explanation, tuple[str, ...]]:
        """Return a joint fit, and its structures, without what the best one does not need."""
        while True:
            rest = [(self.without(now, name), structures) for name in self.free(now)]
            for name in structures:
                kept = tuple(other for other in structures if other != name)
                rest.append((self.rebuilt(Fitted(tuple(now.effects), kept, now.held_out, 0)).refined(STEPS), kept))
            spare = [one for one in rest if not self.beats(best, one[0])]
            if not spare:
                return now, structures
            now, structures = min(spare, key=lambda one: (self.numbers(one[0]), one[0].held_out.square))

    def exchanged(self, now: Explanation) -> tuple[Explanation, dict[str, list[tuple[str, float, bool]]]]:
        """Return the fit with the better ones of its rivals, and for each effect the rivals, best first."""
        rivals: dict[str, list[tuple[str, float, bool]]] = {}
        for _ in range(MOST_EFFECTS):
            rivals, swapped = {}, None
            for name in self.free(now):
                rest = self.without(now, name)
                library = Library(rest, tuple(STRUCTURES), self.search.names)
                size = free(now.effect(name)).size
                present = {effect.name for effect in rest.effects}
                singles = [form for form in library.screened((), (), present | {name}) if form.numbers <= size]
                tried = sorted((library.choice(frozenset(), (form,)) for form in singles), key=lambda one: one.square)
                found: list[tuple[Explanation, str]] = []
                for choice in tried[:4]:
                    if choice.square >= rest.held_out.square:
                        continue
                    first = library.fit(choice)
                    if isinstance(first, Form):
                        continue
                    fit, nonsense = self.search.plausible(first.refined(CONVERGED))
                    if not nonsense and self.numbers(fit) <= self.numbers(now):
                        found.append((fit, choice.forms[0].name))
                found.sort(key=lambda pair: pair[0].held_out.square)
                rivals[name] = [(other, fit.held_out.rms, not self.beats(now, fit)) for fit, other in found]
                if found and found[0][0].held_out.square < 0.999 * now.held_out.square:
                    swapped = found[0][0]
                    break
            if swapped is None:
                break
            now = swapped
        return now, rivals

    def named(self, now: Explanation, rivals: dict[str, list[tuple[str, float, bool]]]) -> tuple[Named, ...]:
        """Return the effects, each with its gain when added to the preceding ones, the largest gain first."""
        left, taken, before, ordered = self.free(now), list(self.search.fixed), self.base.held_out, []
        while left:
            losses = {name: now.only([*taken, name]).held_out if len(left) > 1 else now.held_out for name in left}
            best = min(left, key=lambda name: losses[name].square)
            without, others = self.without(now, best).held_out, rivals.get(best, [])
            ordered.append(
                Named(
                    best,
                    before,
                    losses[best],
                    without,
                    chance(now.held_out, without, self.search.trials),
                    tuple(dict.fromkeys(name for name, _, equal in others if equal)),
                    others[0][:2] if others else None,
                )
            )
            left.remove(best)
            taken.append(best)
            before = losses[best]
        return tuple(ordered)
