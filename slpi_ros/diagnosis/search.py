"""Search for the set of effects that predicts best what was not fitted."""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from slpi_ros.arrays import FloatArray
from slpi_ros.diagnosis.effect_parameters import EachRecord, free
from slpi_ros.diagnosis.held_out import RIDGE, HeldOut, Loss
from slpi_ros.diagnosis.joint_fit import MOST_TURNS, JointFit
from slpi_ros.diagnosis.prepare import drive_frequency, excited_frequency
from slpi_ros.diagnosis.ruler import LEAST, independent_trials
from slpi_ros.effects.base import Candidate, Effect, FitContext, is_course
from slpi_ros.effects.registry import EFFECTS
from slpi_ros.errors import ModelError
from slpi_ros.identification.progress import report_progress

# Largest number of effects of a set; sets that are continued, and sets of a round that are refined.
MOST_EFFECTS, WIDTH, MOST_TRIED = 4, 3, 20
# Places of sets of so many forms among those that are fitted in a round.
PLACES = ((1, 4), (2, 2), (3, 1))
# Gauss-Newton steps of a set; of the best one as many as it takes.
STEPS, CONVERGED = 5, MOST_TURNS
# Largest number of rounds, each with columns at new parameters.
MOST_ROUNDS = 6
# A round that lowers the mean square by less than this share is the last one.
LEAST_GAINED = 0.002


def is_own(effect: Effect | type[Any]) -> bool:
    """Return whether an effect, or each of its kind, has separate parameters in each record, such as drift or lines."""
    return effect.side == "record" or effect.sharing == "separate"


def seen(now: JointFit) -> FitContext:
    """Return a joint fit as an effect may see it."""
    evidence = now.evidence

    def drives() -> list[tuple[float, float]]:
        return [(drive_frequency(evidence.of_record(k)), float(part.t[-1])) for k, part in enumerate(evidence.parts)]

    return FitContext(
        *(now.t, evidence.v, now.u, now.h, now.y, now.used, now.residual, now.around, evidence.rounding, now.effects),
        respond=now.respond,
        excited_frequency=lambda: excited_frequency(evidence),
        drives=drives,
        zeros=lambda: now.zeros,
        first_rise=lambda: now.equations.first_rise,
        left_without=lambda name: now.y - now.prediction_without(name),
    )


def is_plausible(effect: Effect, now: JointFit) -> bool:
    """Return whether an effect of a joint fit may be what it is called."""
    if any(leaf.at_bound for leaf in effect.free_leaves()):
        return False
    return is_course(*effect.courses) and effect.plausible(seen(now)) and effect.in_phase(seen(now))


@dataclass(frozen=True)
class EffectSet:
    """A set of effects with their parameters, and what it leaves."""

    effects: tuple[Effect, ...]
    loss: Loss

    @classmethod
    def of(cls, now: JointFit) -> "EffectSet":
        """Return what is kept of a joint fit."""
        return cls(tuple(now.effects), now.held_out)

    @property
    def numbers(self) -> int:
        """Number of free parameters of the effects."""
        return sum(free(effect).size for effect in self.effects)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the effects."""
        return tuple(sorted(effect.name for effect in self.effects))


@dataclass(frozen=True, eq=False)
class Form:
    """One form of an effect, with its place among the columns."""

    name: str
    candidate: Candidate | Effect
    first: int
    end: int

    @property
    def numbers(self) -> int:
        """How many columns it has."""
        return self.end - self.first

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


@dataclass(frozen=True, eq=False)
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

    def __init__(self, now: JointFit, names: Collection[str] | None = None) -> None:
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
        sampled, forms, place = [now.equations.sampled(own)], [], own.shape[1]
        for name, candidate, columns in self._candidates(names or EFFECTS):
            forms.append(Form(name, candidate, place, place + columns.shape[1]))
            sampled.append(now.equations.sampled(columns))
            place += columns.shape[1]
        self.forms = forms
        at = np.column_stack(sampled)
        size = np.linalg.norm(at, axis=0)
        size[: own.shape[1]] = 1.0
        self._size = np.where(size > 0.0, size, 1.0)
        self.held_out: HeldOut = now.equations.held_out(at / self._size)
        self._known: dict[tuple[frozenset[str], frozenset[Form]], Choice] = {}
        self._screened: dict[tuple[frozenset[str], frozenset[Form]], dict[Form, float]] = {}

    def _candidates(self, names: Collection[str]) -> Iterator[tuple[str, Candidate | Effect, FloatArray]]:
        for name in names:
            for form in _forms(name, self.now):
                if isinstance(form, Candidate):
                    if form.columns.shape[1] and np.isfinite(form.columns).all():
                        yield name, _bare(form), form.columns
                    continue
                try:
                    yield name, form, (self.now.predicted_with(form) - self.now.predicted)[:, None]
                except ModelError:
                    continue

    def columns(self, removed: Collection[str], forms: Sequence[Form]) -> tuple[list[int], list[int], set[int]]:
        """Return the columns that add up to the target, those that are fitted, and those of gains not negative."""
        kept = [place for name, (_, places) in self._own.items() if name not in removed for place in places]
        target = [0, *(self._own[name][0] for name in removed)]
        chosen = [*self._beside, *kept, *(place for form in forms for place in form.places)]
        return target, chosen, {place for form in forms for place in form.positive}

    def choice(self, removed: frozenset[str], forms: tuple[Form, ...]) -> Choice:
        """Return a set with what is left to first order, one and the same for the same set."""
        key = removed, frozenset(forms)
        if key not in self._known:
            loss = self.held_out.loss(*self.columns(removed, forms))
            self._known[key] = Choice(removed, forms, loss.square, loss.blocks)
        return self._known[key]

    def ban(self, forms: Sequence[Form]) -> None:
        """Leave out forms that have shown to mean nothing."""
        banned = {form.kind for form in forms}
        self.forms = [form for form in self.forms if form.kind not in banned]

    def screened(self, removed: frozenset[str], taken: Sequence[Form], once: Collection[str]) -> list[Form]:
        """Return the forms that explain most of the fitted samples, the best of each group of each effect."""
        key = removed, frozenset(taken)
        if key not in self._screened:
            self._screened[key] = self._explained(removed, taken)
        gains, left_out = self._screened[key], {*once, *(form.name for form in taken)}
        best: dict[tuple[str, int, int], Form] = {}
        for form in sorted((one for one in self.forms if one.name not in left_out), key=lambda one: -gains[one]):
            best.setdefault((*form.kind, form.numbers), form)
        return [*best.values()]

    def _explained(self, removed: Collection[str], taken: Sequence[Form]) -> dict[Form, float]:
        """Return how much of the fitted samples each form explains beside those that are taken."""
        target, chosen, _ = self.columns(removed, taken)
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
        size = np.sqrt(np.maximum(np.diag(self.held_out.whole), 1e-300))
        gains: dict[Form, float] = {}
        # Many small systems, those of one size at once.
        of_size: dict[int, list[Form]] = {}
        for form in self.forms:
            of_size.setdefault(form.numbers, []).append(form)
        for numbers, forms in of_size.items():
            at = np.array([form.first for form in forms])[:, None] + np.arange(numbers)
            own = whole[at[:, :, None], at[:, None, :]] / (size[at][:, :, None] * size[at][:, None, :])
            wanted = vector[at] / size[at]
            solution = np.linalg.solve(own + 1e-6 * np.eye(numbers), wanted[:, :, None])[:, :, 0]
            gains.update(zip(forms, np.sum(wanted * solution, axis=1).tolist(), strict=True))
        return gains

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
                    names = ({*present} - removed) | {form.name for form in choice.forms}
                    full = once | (EFFECTS.keys() - names if len(names) >= MOST_EFFECTS + len(fixed) else set())
                    for form in self.screened(removed, choice.forms, full)[:screened]:
                        one = self.choice(removed, (*choice.forms, form))
                        if one.names not in grown or one.square < grown[one.names].square:
                            grown[one.names] = one
                found.update({(removed, names): one for names, one in grown.items()})
                least = min(choice.square for choice in beam)
                beam = sorted((one for one in grown.values() if one.square < least), key=lambda one: one.square)[:WIDTH]
        return sorted(found.values(), key=lambda one: one.square)

    def fit(self, choice: Choice) -> JointFit | Form:
        """Return the joint fit with a choice at first parameters, or the form of it that is not admissible."""
        target, chosen, positive = self.columns(choice.removed, choice.forms)
        gains = self.held_out.gains(target, chosen, positive)
        at = dict(zip(chosen, (gains / self._size[chosen]).tolist(), strict=True))
        fit = self.now.only(
            [effect.name for effect in self.now.effects if effect.name not in choice.removed], refine=False
        )
        for form in choice.forms:
            try:
                own = np.array([at[place] for place in (form.positive or form.places)])
                effect = form.candidate.effect(own) if isinstance(form.candidate, Candidate) else form.candidate
                if effect is None:
                    return form
                fit = fit.adding(effect)
            except ModelError:
                return form
        return fit


def _bare(candidate: Candidate) -> Candidate:
    """Return a candidate without the samples of its columns, which would fill the memory."""
    return replace(candidate, columns=np.empty((0, candidate.columns.shape[1])))


def _forms(name: str, now: JointFit) -> Iterator[Candidate | Effect]:
    """Yield the forms of an effect: with common parameters, with separate ones in each record, or both."""
    context, records, own = seen(now), len(now.evidence.parts), is_own(EFFECTS[name])
    if not own or records == 1:
        yield from EFFECTS[name].fit(context)
    if records == 1 or not (own or EFFECTS[name].sharing == "either"):
        return
    for forms in zip(*(EFFECTS[name].fit(context.of_record(k)) for k in range(records)), strict=False):
        parts = [form for form in forms if isinstance(form, Candidate)]
        yield Candidate(block_diag(*(part.columns for part in parts)), partial(_each, [*map(_bare, parts)]))


def _each(forms: Sequence[Candidate], gains: FloatArray) -> EachRecord | None:
    own = np.split(gains, np.cumsum([form.columns.shape[1] for form in forms[:-1]]))
    return EachRecord.of([form.effect(part) for form, part in zip(forms, own, strict=True)])


class Search:
    """Search for the set that predicts best, from a joint fit without new effects.

    `pool` holds the best fit of each set of names and number of parameters; `trials` is the number of independent
    comparisons among the sets that were compared. With `names` only these effects are looked for.
    """

    def __init__(self, base: JointFit, names: Sequence[str] | None = None) -> None:
        self.base, self.names = base, names
        self.fixed = tuple(effect.name for effect in base.effects)
        self.pool: dict[tuple[tuple[str, ...], int], EffectSet] = {}
        self.trials = 1.0

    def run(self) -> JointFit:
        """Return the best joint fit that was found."""
        now = self.base
        self._note(now)
        for _ in range(MOST_ROUNDS):
            report_progress(f"{len(now.effects)} effects, {now.held_out.rms * 1e9:.3g} nm left, trying others")
            best = self._round(now)
            if best is now:
                break
            gained = 1.0 - best.held_out.square / now.held_out.square
            refined = best.refined(CONVERGED)
            # The hysteresis, without what the effects took out of it, may need another smoothness.
            now = (refined if refined.held_out.square < best.held_out.square else best).smoothed()
            self._note(now)
            if gained < LEAST_GAINED:
                break
        return now

    def _round(self, now: JointFit) -> JointFit:
        """Return the best one of the sets in reach that are worth fitting, or `now`."""
        library, best = Library(now, self.names), now
        choices = library.choices(self.fixed)
        self.trials = max(self.trials, independent_trials(now.held_out.blocks, [one.blocks for one in choices]))
        tried = set[Choice]()
        for _ in range(MOST_TRIED):
            choice = next((one for one in _worth_fitting(choices, now) if one not in tried), None)
            if choice is None:
                break
            tried.add(choice)
            first = library.fit(choice)
            if isinstance(first, Form):
                library.forms.remove(first)
                choices = library.choices(self.fixed)
                continue
            fit, senseless = self.sensible(first.refined(STEPS))
            if senseless:
                library.ban([form for form in choice.forms if form.name in senseless])
                choices = library.choices(self.fixed)
                # What is left of it may mean something.
                fit, senseless = self.sensible(fit.refined(STEPS))
                if senseless:
                    continue
            self._note(fit)
            if fit.held_out.square < best.held_out.square:
                best = fit
        return best

    def _note(self, now: JointFit) -> None:
        fitted = EffectSet.of(now)
        key = fitted.names, fitted.numbers
        if key not in self.pool or fitted.loss.square < self.pool[key].loss.square:
            self.pool[key] = fitted

    def sensible(self, now: JointFit) -> tuple[JointFit, list[str]]:
        """Return a joint fit without the effects, and parts of effects, that mean nothing, and the names of effects."""
        senseless: list[str] = []
        for name in [effect.name for effect in now.effects if effect.name not in self.fixed]:
            effect = now.effect(name)
            if is_plausible(effect, now):
                continue
            part = effect.only_plausible(seen(now))
            if part is not None and free(part).size:
                fewer = now.replacing(name, part).refined(1)
                if is_plausible(fewer.effect(name), fewer):
                    now = fewer
                    continue
            senseless.append(name)
            now = now.without(name)
        return now, senseless


def _worth_fitting(choices: Sequence[Choice], now: JointFit) -> list[Choice]:
    """Return the choices with the least error of each number of forms, few forms first."""
    most = now.held_out.square - (LEAST * now.noise) ** 2
    better = [one for one in choices if one.forms and one.square < most]
    return [one for count, places in PLACES for one in [each for each in better if len(each.forms) == count][:places]]
