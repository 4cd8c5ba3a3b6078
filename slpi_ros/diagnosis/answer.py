"""The answer of a diagnosis: the set with the fewest numbers of those that the best one does not beat."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import inf

from slpi_ros.diagnosis.effect_parameters import free
from slpi_ros.diagnosis.held_out import Loss
from slpi_ros.diagnosis.joint_fit import JointFit
from slpi_ros.diagnosis.prepare import one_speed
from slpi_ros.diagnosis.ruler import EXPLAINED, beats, chance, share
from slpi_ros.diagnosis.search import CONVERGED, MOST_EFFECTS, PLACES, EffectSet, Form, Library, Search, is_plausible
from slpi_ros.diagnosis.structures import STRUCTURES
from slpi_ros.model.axis_model import ABOVE_NOISE

# Other effects that are fitted in the place of one: as many as single ones in a round of the search.
RIVALS = PLACES[0][1]


@dataclass(frozen=True)
class Rival:
    """Another effect in the place of one: what that set leaves, and whether the answer is no better."""

    name: str
    loss: Loss
    as_good: bool


@dataclass(frozen=True)
class Named:
    """An effect of the answer, with what the effects before it leave, without it and with it."""

    name: str
    before: Loss
    after: Loss
    # What all others leave, and the probability that chance makes the set with it so much better.
    without: Loss
    p_value: float
    # Other effects in its place, in sets of no more numbers, the best one first.
    rivals: tuple[Rival, ...]

    @property
    def alternatives(self) -> tuple[str, ...]:
        """Names of the effects that may stand in its place."""
        return tuple(dict.fromkeys(one.name for one in self.rivals if one.as_good))


@dataclass(frozen=True)
class Answer:
    """The set of effects that a diagnosis gives: joint fit without and with it."""

    base: JointFit
    now: JointFit
    # The largest gain first; each gain is relative to the preceding effects.
    named: tuple[Named, ...] = ()
    # Defects of the hysteresis model: `BIAS`, or keys of `STRUCTURES`.
    structures: tuple[str, ...] = ()
    # Effects that were found, and make a record worse, or are not needed beside another hysteresis.
    dropped: tuple[str, ...] = ()

    def without(self, name: str) -> "Answer":
        """Return the answer without one of its effects."""
        left = [one for one in self.named if one.name != name]
        now, before, kept = self.now.without(name).refined(CONVERGED) if left else self.base, self.base.held_out, []
        for place, one in enumerate(left):
            taken = {effect.name for effect in self.base.effects} | {other.name for other in left[: place + 1]}
            after = now.only(taken).held_out
            kept.append(replace(one, before=before, after=after, without=now.without(one.name).held_out))
            before = after
        return replace(self, now=now, named=tuple(kept), dropped=tuple(sorted({*self.dropped, name})))


class Judge:
    """Choice of the answer among the sets of a search."""

    def __init__(self, search: Search) -> None:
        self._search, self._base = search, search.base
        self._evidence, self._noise = search.base.evidence, search.base.noise
        # The last fit of which effects were left out, and the fits without each.
        self._whole, self._rest = search.base, dict[str, JointFit]()

    def answer(self) -> Answer:
        """Return the answer."""
        now = self._search.run()
        self._evidence, self._noise = now.evidence, now.noise
        best = now = self._meaningful(now)
        for fitted in sorted(self._search.pool.values(), key=lambda one: (one.numbers, one.loss.square)):
            if fitted.numbers >= EffectSet.of(now).numbers:
                break
            if not self._beats(best, fitted):
                fewer = self._rebuilt(fitted)
                if self._beats(best, fewer) or self._senseless(fewer):
                    continue
                if all(self._beats(fewer, self._without(fewer, name)) for name in self._free(fewer)):
                    now = fewer
                    break
        now, rivals = self._exchanged(self._needed(now, best))
        now = self._needed(now, min(now, best, key=lambda one: one.held_out.square))
        named = self._named(now, rivals)
        return self._beside_structures(Answer(self._base, now, named))

    def _beats(self, one: JointFit | EffectSet, other: JointFit | EffectSet) -> bool:
        own, its = (EffectSet.of(each) if isinstance(each, JointFit) else each for each in (one, other))
        contained = {*its.names} <= {*own.names}
        return beats(own.loss, its.loss, self._noise, self._search.trials, contained=contained)

    def _rebuilt(self, fitted: EffectSet) -> JointFit:
        return JointFit(self._evidence, fitted.effects, self._base).refined(CONVERGED)

    def _free(self, now: JointFit) -> list[str]:
        """Return the names of the effects that were found."""
        return [effect.name for effect in now.effects if effect.name not in self._search.fixed]

    def _without(self, now: JointFit, name: str) -> JointFit:
        """Return the best joint fit of the other effects."""
        if now is not self._whole:
            self._whole, self._rest = now, {}
        if name not in self._rest:
            self._rest[name] = self._best_without(now, name)
        return self._rest[name]

    def _best_without(self, now: JointFit, name: str) -> JointFit:
        fit = now.without(name).refined(CONVERGED)
        known = self._tried(EffectSet.of(fit).names)
        return fit if known is None or known.loss.square >= fit.held_out.square else self._rebuilt(known)

    def _tried(self, names: tuple[str, ...]) -> EffectSet | None:
        """Return the best one of the sets with these names, sorted, that were tried."""
        same = [one for one in self._search.pool.values() if one.names == names]
        return min(same, key=lambda one: one.loss.square, default=None)

    def _senseless(self, now: JointFit) -> list[str]:
        """Return the effects that explain too little of what is there where they act."""
        rest = {name: self._without(now, name).held_out for name in self._free(now)}
        single, little = len(now.evidence.parts) == 1, ABOVE_NOISE * now.noise

        def explains(name: str) -> bool:
            if not is_plausible(now.effect(name), now):
                return False
            # A free course, such as drift, fits what is slow. In a single record it has to leave no more than noise;
            # beside other records there has to be more than noise without it.
            if now.effect(name).courses and (now.held_out.rms > little if single else rest[name].rms <= little):
                return False
            # What goes on from before the records is a course of theirs, which needs no effect.
            begun = now.effect(name).starting(now.evidence.around, now.evidence.used)
            others = [rest[name], *([self._without(now, name).beside(begun).held_out] if begun.size else [])]
            return all(share(now.held_out, other, self._noise) >= EXPLAINED for other in others)

        return [name for name in rest if not explains(name)]

    def _meaningful(self, now: JointFit) -> JointFit:
        """Return a joint fit without what is senseless, first that without which the rest predicts best.

        Or the best of the sets that were tried, if all of it makes sense and it predicts better than what is left.
        """
        while found := self._senseless(now):
            now = min((self._without(now, name) for name in found), key=lambda fit: fit.held_out.square)
        for fitted in sorted(self._search.pool.values(), key=lambda one: one.loss.square):
            if not self._beats(fitted, now):
                break
            if self._may_make_sense(fitted):
                other = self._rebuilt(fitted)
                if self._beats(other, now) and not self._senseless(other):
                    return other
        return now

    def _may_make_sense(self, fitted: EffectSet) -> bool:
        """Return whether each effect of a set explains enough, as far as the sets without it were tried."""
        for name in {*fitted.names} - {*self._search.fixed}:
            names = list(fitted.names)
            names.remove(name)
            rest = self._tried(tuple(names))
            if rest is None or share(fitted.loss, rest.loss, self._noise) < EXPLAINED:
                return False
        return True

    def _needed(self, now: JointFit, best: JointFit) -> JointFit:
        """Return a joint fit without the effects that it, or the best one, does not need."""
        while True:
            rest = [self._without(now, name) for name in self._free(now)]
            spare = [one for one in rest if not all(self._beats(each, one) for each in (now, best))]
            if not spare:
                return now
            now = min(spare, key=lambda one: (EffectSet.of(one).numbers, one.held_out.square))

    def _exchanged(self, now: JointFit) -> tuple[JointFit, dict[str, tuple[Rival, ...]]]:
        """Return the fit with the better ones of the rivals of its effects, and for each effect the others."""
        rivals: dict[str, tuple[Rival, ...]] = {}
        for _ in range(MOST_EFFECTS):
            better = None
            for name in self._free(now):
                found, rivals[name] = self._in_its_place(now, name)
                if found:
                    better = found
                    break
            if better is None:
                break
            now = better
        return now, rivals

    def _in_its_place(self, now: JointFit, name: str) -> tuple[JointFit | None, tuple[Rival, ...]]:
        """Return the joint fit with another effect, better or as good with fewer numbers, if any; all rivals."""
        rest, effect = self._without(now, name), now.effect(name)
        # One drive frequency does not tell effects apart that depend on time, and one record not a quantity from a
        # drift, however many numbers they have.
        alone, single = one_speed(now.evidence), len(now.evidence.parts) == 1
        unproved = single and bool(effect.keys)
        # With the parameters beside the effect, which are not those without it.
        library = Library(now.only({other.name for other in now.effects} - {name}, refine=False), self._search.names)
        present = {other.name for other in rest.effects} | (set() if effect.keys else {name})
        singles, most = library.screened(frozenset(), (), present), inf if alone or unproved else free(effect).size
        choices = sorted((library.choice(frozenset(), (form,)) for form in singles), key=lambda one: one.square)
        found, tried = list[tuple[str, JointFit]](), dict[str, int]()
        for choice in [one for one in choices if one.square < rest.held_out.square]:
            (form,) = choice.forms
            first = library.fit(choice)
            if isinstance(first, Form) or free(first.effect(form.name)).size > most:
                continue
            tried[form.name] = tried.get(form.name, 0) + 1
            if len(tried) > RIVALS or tried[form.name] > 1 + len(effect.keys):
                continue
            fit, senseless = self._search.sensible(first.refined(CONVERGED))
            if senseless or fit.effect(form.name).keys == effect.keys != ():
                continue
            found.append((" ".join([form.name, *fit.effect(form.name).keys]), fit))
        found.sort(key=lambda pair: pair[1].held_out.square)
        rivals, better, own = list[Rival](), list[JointFit](), EffectSet.of(now).numbers
        for label, fit in found:
            as_good, numbers = not self._beats(now, fit), EffectSet.of(fit).numbers
            other = fit.effect(label.partition(" ")[0])
            fewer = numbers < own or (numbers == own and fit.held_out.square < now.held_out.square)
            if as_good and (unproved and other.courses or fewer and not (single and other.keys and effect.courses)):
                better.append(fit)
            if numbers <= own or alone:
                # What both leave where they differ says nothing of which one is the cause.
                refuted = not as_good and share(now.held_out, fit.held_out, self._noise) >= EXPLAINED
                as_good = not refuted or (alone and self._beats(fit, rest))
                rivals.append(Rival(label, fit.held_out, as_good))
        better.sort(key=lambda fit: (EffectSet.of(fit).numbers, fit.held_out.square))
        return next((fit for fit in better if not self._senseless(fit)), None), tuple(rivals)

    def _named(self, now: JointFit, rivals: dict[str, tuple[Rival, ...]]) -> tuple[Named, ...]:
        """Return the effects, each with its gain when added to the preceding ones, the largest gain first."""
        left, taken, before, ordered = self._free(now), list(self._search.fixed), self._base.held_out, []
        while left:
            losses = {name: now.only([*taken, name]).held_out if len(left) > 1 else now.held_out for name in left}
            best = min(left, key=lambda name: losses[name].square)
            without = self._without(now, best).held_out
            p_value = chance(now.held_out, without, self._search.trials)
            ordered.append(Named(best, before, losses[best], without, p_value, rivals.get(best, ())))
            left.remove(best)
            taken.append(best)
            before = losses[best]
        return tuple(ordered)

    def _beside_structures(self, answer: Answer) -> Answer:
        """Return the answer with the defect of the hysteresis that is seen beside it, or instead of it."""
        if self._search.names is not None:
            return answer
        now, found = answer.now, list[tuple[float, str]]()
        for name, columns in STRUCTURES.items():
            if answer.named and self._base.beside(columns(self._base)).held_out.square <= now.held_out.square:
                dropped = tuple(sorted(one.name for one in answer.named))
                return Answer(self._base, self._base, structures=(name,), dropped=dropped)
            with_it = now.beside(columns(now)).held_out
            explains = share(with_it, now.held_out, self._noise) >= EXPLAINED
            if explains and beats(with_it, now.held_out, self._noise, self._search.trials):
                found.append((with_it.square, name))
        return replace(answer, structures=(min(found)[1],)) if found else answer


def answer_of(base: JointFit, names: Sequence[str] | None = None) -> Answer:
    """Return the answer for a joint fit without effects, of all effects or of those with these `names`."""
    return Judge(Search(base, names)).answer()
