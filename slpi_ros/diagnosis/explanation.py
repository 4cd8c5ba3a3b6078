"""The hysteresis of one axis with effects around it, fitted to a record together."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from slpi_ros.diagnosis.evidence import Evidence
from slpi_ros.diagnosis.joint import Joint, Score
from slpi_ros.diagnosis.parameters import bounded, free, moved, names, steps
from slpi_ros.effects.base import Effect, EffectContext
from slpi_ros.effects.chain import reaching
from slpi_ros.effects.creep import Creep, settling
from slpi_ros.effects.registry import in_order
from slpi_ros.errors import ModelError
from slpi_ros.hysteresis.kinds import Hysteresis
from slpi_ros.identification.convex_fit import SMOOTHNESS
from slpi_ros.identification.least_squares import Problem
from slpi_ros.identification.samples import Samples

FloatArray = NDArray[np.float64]

# What effects add is found in turns with the hysteresis, until a turn changes it by less than this share of the error.
MOST_TURNS, SETTLED = 15, 0.02
# Voltages at which the middle of the largest loop is found.
LEVELS = 60
# Steps towards the best parameters end when they gain less than this share of the error.
ENOUGH = 1e-3
# Of a step, where all of it is too much.
SHARES = (1.0, 0.4, 0.1)


class Explanation:
    """Effects in the order of the signal chain, and the hysteresis that goes with them.

    Parameters
    ----------
    evidence : Evidence
    effects : sequence of Effect
    like : Explanation, optional
        Of the same evidence; its equations serve again where the same voltage drives the hysteresis.

    Attributes
    ----------
    u : ndarray, shape (N,), volts
        What drives the hysteresis.
    added : ndarray, shape (N,), metres
        What the effects add behind the hysteresis, or lead round it.
    settling : ndarray, shape (N,), metres
        What still goes on at the start of the record from moves before it.
    """

    def __init__(self, evidence: Evidence, effects: Sequence[Effect] = (), like: "Explanation | None" = None) -> None:
        self.evidence, self.effects = evidence, in_order(effects)
        self.u, self._aside = reaching(self.effects, evidence.v, EffectContext(evidence.t))
        same = like is not None and np.array_equal(like.u, self.u)
        self.joint: Joint = (
            like.joint if like and same else Joint(evidence.problem(self.u), evidence.smoothness, evidence.lead)
        )
        self.added = self._aside
        self._before = np.column_stack([evidence.beside, settling(self._relaxations, evidence.t, evidence.used)])
        self._fit()
        if any(effect.side == "displacement" for effect in self.effects):
            for _ in range(MOST_TURNS):
                h, before = self.joint.predict(self._x), self.added
                self.added = self._behind(self.effects, h + self._aside, self.u) - h
                self._fit()
                if np.ptp(self.added - before) < SETTLED * np.std(self.target - h):
                    break

    def _fit(self) -> None:
        fit = self.joint.fit(self.target, self._before)
        self._x, self.settling = fit.x, self._before @ fit.gains

    @property
    def _relaxations(self) -> list[float]:
        return [tau for effect in self.effects if isinstance(effect, Creep) for tau in effect.time_constants]

    @property
    def t(self) -> FloatArray:
        """Time, shape (N,), seconds."""
        return self.evidence.t

    @property
    def y(self) -> FloatArray:
        """Measured displacement, shape (N,), metres."""
        return self.evidence.y

    @property
    def used(self) -> NDArray[np.bool_]:
        """Samples that count, shape (N,)."""
        return self.evidence.used

    @property
    def others(self) -> Mapping[str, FloatArray]:
        """Motion of the other axes from their start, shape (N,), metres."""
        return self.evidence.others

    @property
    def target(self) -> FloatArray:
        """What the hysteresis is to explain, shape (N,), metres."""
        return self.evidence.y - self.added

    @cached_property
    def h(self) -> FloatArray:
        """What the hysteresis gives, shape (N,), metres."""
        return self.joint.predict(self._x)

    @property
    def predicted(self) -> FloatArray:
        """What hysteresis and effects give, shape (N,), metres."""
        return self.h + self.added + self.settling

    @property
    def residual(self) -> FloatArray:
        """What they leave of the measured displacement, shape (N,), metres."""
        return self.evidence.y - self.predicted

    @property
    def around(self) -> EffectContext:
        """What effects may look at."""
        return EffectContext(self.evidence.t, self.u, self._middle, self.evidence.others)

    def _behind(self, effects: Sequence[Effect], h: FloatArray, u: FloatArray) -> FloatArray:
        """Return the displacement, shape (N,), metres, that effects make of what the hysteresis gives, `h`."""
        around = replace(self.around, u=u)
        for effect in effects:
            if effect.side == "displacement":
                h = effect.apply(h, around)
        return h

    def _middle(self, u: FloatArray) -> FloatArray:
        """Return the displacement (m) half-way between the two branches of the largest loop, at voltages `u` (V)."""
        levels = np.linspace(float(self.u.min()), float(self.u.max()), LEVELS)
        around_twice = np.concatenate([levels, levels[::-1], levels])
        loop = Samples(around_twice, around_twice, np.ones(3 * LEVELS, dtype=bool))
        y = Problem.pose([loop], self.evidence.basis).design.predict(self._x) * self.joint.problem.scale
        falling, rising = y[LEVELS : 2 * LEVELS][::-1], y[2 * LEVELS :]
        middle = 0.5 * (falling + rising) + self.h[0] - y[0]
        return np.asarray(np.interp(u, levels, middle), dtype=np.float64)

    def respond(self, u: FloatArray) -> FloatArray:
        """Return what the hysteresis gives (m) for another voltage `u`, shape (N,), volts."""
        evidence = self.evidence
        response: FloatArray = evidence.problem(u).design.predict(self._x)[evidence.lead :]
        return response * self.joint.problem.scale

    @cached_property
    def tangents(self) -> FloatArray:
        """How the prediction changes with each free parameter of the effects, shape (N, k), metres."""
        columns = []
        for place, effect in enumerate(self.effects):
            values = free(effect)
            for k, step in enumerate(steps(effect, self.evidence.t, self.evidence.v)):
                changed = values.copy()
                changed[k] += step
                effects = [*self.effects[:place], moved(effect, changed), *self.effects[place + 1 :]]
                columns.append((self._whole(effects) - self.predicted) / step)
        return np.column_stack([np.empty((self.evidence.t.size, 0)), *columns])

    def _whole(self, effects: Sequence[Effect]) -> FloatArray:
        """Return the prediction, shape (N,), metres, of the same hysteresis with other effects."""
        u, reversible_bypass = reaching(effects, self.evidence.v, EffectContext(self.evidence.t))
        h = self.h if np.array_equal(u, self.u) else self.respond(u)
        return self.settling + self._behind(effects, h + reversible_bypass, u)

    def prediction_without(self, name: str) -> FloatArray:
        """Return what it would give, shape (N,), metres, if one of its effects were not there and all else as it is."""
        return self._whole([effect for effect in self.effects if effect.name != name])

    def score(self, columns: FloatArray, *, positive: int = 0) -> Score:
        """Score it with `columns`, shape (N, k), metres, beside it: on blocks left out, all effects refitted."""
        beside = np.column_stack([self._before, self.tangents, columns])
        return self.joint.score(self.target, beside, positive=positive)

    @cached_property
    def held_out(self) -> Score:
        """Its own score."""
        return self.joint.score(self.target, np.column_stack([self._before, self.tangents]))

    def refined(self, times: int) -> "Explanation":
        """Return it with the parameters of all effects fitted together with the hysteresis (Gauss-Newton)."""
        best = self
        for _ in range(times if self.effects else 0):
            better = best._step()
            gain = 1.0 - better.held_out.rms / best.held_out.rms
            best = better
            if gain < ENOUGH:
                break
        return best

    def _step(self) -> "Explanation":
        """Return it after one step, shortened until it gains; itself where none does."""
        columns = np.column_stack([self._before, self.tangents])
        change = self.joint.fit(self.target, columns).gains[self._before.shape[1] :]
        for share in SHARES:
            try:
                effects = self._stepped(share * change)
            except ModelError:
                # Too far: no effect has such parameters.
                continue
            stepped = Explanation(self.evidence, effects, self)
            if stepped.held_out.rms < self.held_out.rms:
                return stepped
        return self

    def _stepped(self, change: FloatArray) -> list[Effect]:
        effects, first = [], 0
        longest = float(self.evidence.t[-1] - self.evidence.t[0])
        for effect in self.effects:
            values = free(effect)
            step = change[first : first + values.size]
            first += values.size
            effects.append(moved(effect, values + bounded(effect, step), longest))
        return effects

    def hysteresis(self) -> tuple[Hysteresis, float]:
        """Return the model with every branch rising, and the displacement at the start of the record, metres."""
        problem, lead = self.joint.problem, self.evidence.lead
        wanted = np.concatenate([np.zeros(lead), self.target - self.settling]) / problem.scale
        problem = replace(problem, y=wanted)
        x = problem.solve(self.evidence.smoothness)
        at_start = float(problem.design.predict(x)[lead]) * problem.scale
        return problem.basis.shape(x[: problem.basis.size + 1] * problem.scale, problem.gain), at_start

    def with_uncertainty(self) -> list[Effect]:
        """Return the effects with the standard deviations of their free parameters.

        Errors of neighbouring samples are alike, so that there are fewer independent ones than samples.
        """
        if not self.effects:
            return []
        columns = np.column_stack([self.tangents, self._before])
        precision = self.joint.fit(self.target, columns).precision
        errors = self.residual[self.evidence.used]
        size = np.sqrt(np.maximum(np.diag(precision), 1e-300))
        inverse = np.linalg.pinv(precision / np.outer(size, size), rcond=1e-12) / np.outer(size, size)
        spread = np.sqrt(np.maximum(np.diag(inverse), 0.0) * np.mean(errors**2) * alike_in_a_row(errors)).tolist()
        effects = []
        for effect in self.effects:
            own = {name: spread.pop(0) for name in names(effect)}
            effects.append(replace(effect, uncertainty=own))  # type: ignore[type-var]
        return effects

    def smoothed(self) -> "Explanation":
        """Return it with the hysteresis as smooth as blocks left out say, now that effects no longer disturb it."""
        problem = self.joint.problem
        padded = np.concatenate([np.zeros(self.evidence.lead), self.target]) / problem.scale
        scores = replace(problem, y=padded).scores(SMOOTHNESS)
        best = SMOOTHNESS[int(np.argmin(scores))]
        if best == self.evidence.smoothness:
            return self
        return Explanation(replace(self.evidence, smoothness=best), self.effects).refined(2)

    def adding(self, effect: Effect) -> "Explanation":
        """Return it with one more effect."""
        return Explanation(self.evidence, [*self.effects, effect], self)

    def only(self, names: Collection[str]) -> "Explanation":
        """Return it with those of its effects that are named, fitted anew."""
        return Explanation(self.evidence, [effect for effect in self.effects if effect.name in names], self).refined(2)

    def without(self, name: str) -> "Explanation":
        """Return it without an effect, the others fitted anew."""
        return self.only([effect.name for effect in self.effects if effect.name != name])

    def beside(self, columns: FloatArray) -> "Explanation":
        """Return it with `columns`, shape (N, k), beside the hysteresis, whatever their gains."""
        evidence = replace(self.evidence, beside=np.column_stack([self.evidence.beside, columns]))
        return Explanation(evidence, self.effects, self)

    def bare(self) -> "Explanation":
        """Return it without anything beside the hysteresis but effects, those fitted anew."""
        if not self.evidence.beside.shape[1]:
            return self
        evidence = replace(self.evidence, beside=self.evidence.beside[:, :0])
        return Explanation(evidence, self.effects, self).smoothed().refined(2)


def alike_in_a_row(errors: FloatArray) -> float:
    """Return how many errors in a row tell no more than one, from their correlation up to where it first vanishes."""
    errors = errors - errors.mean()
    power = np.abs(np.fft.rfft(errors, 2 * errors.size)) ** 2
    correlation = np.fft.irfft(power)[: errors.size]
    if not correlation[0] > 0.0:
        return 1.0
    correlation = correlation / correlation[0]
    positive = int(np.argmax(correlation <= 0.0)) or correlation.size
    return float(max(1.0, 2.0 * correlation[:positive].sum() - 1.0))
