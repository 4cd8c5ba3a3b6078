"""Creep: slow relaxation of the displacement after a move."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from math import gamma, inf, isinf, log
from typing import Any

import numpy as np

from slpi_ros.arrays import FloatArray, Mask
from slpi_ros.effects.base import (
    Candidate,
    Effect,
    EffectContext,
    FitContext,
    StreamingEffect,
    Unsure,
    by_record,
    longest,
    usual_step,
)
from slpi_ros.effects.excitation import DriveLimits, DrivePath, Excitation, remaining, safe_duration
from slpi_ros.effects.filters import Hold, hold
from slpi_ros.effects.parameters import Fit, Leaf, parameter, require
from slpi_ros.io.record import Course

# Shortest time constant (s) of creep; shorter ones are modelled as lag.
FASTEST = 0.1
# Upper bounds on the gains: of each relaxation, and of the sum of those with time constants within a second.
LARGEST, SOON, LARGEST_SOON, LARGEST_POWER = 0.15, 1.0, 0.12, 0.5
# A gain is at its bound within this share of it.
NEAR = 1e-3
# Candidates: number of single relaxations; sets of several (number, longest time constant as share of the record).
# Gains below this share of the largest gain are dropped.
SINGLE, SEVERAL, LEAST_SHARE = 7, ((2, 0.1), (2, 0.5), (3, 0.3), (4, 0.7)), 0.02
# Logarithmic law, equal gains: relaxations per decade, from the longer of `FASTEST` and a number of samples, to a share
# of the longest record, and the smallest number of relaxations.
LAW_PER_DECADE, LAW_SAMPLES, LAW_TO, LAW_FEWEST = 2, 3.0, (0.3, 3.0), 4
# Power of time: time constants (s) of its chain, and the ratio of the edges between them to them; exponents of the
# candidates; bounds of the exponent, which near 1 is a drift with the displacement; time (s) from which on it is
# unsure, as few records are longer.
CHAIN, EDGE, POWERS = 10.0 ** np.arange(-3.0, 5.1, 0.5), 10.0**0.25, (0.1, 0.3, 0.6)
LEAST_POWER, MOST_POWER, UNSURE_FROM = 0.02, 0.9, 100.0
# Iterations by which creep is taken out of displacements: each leaves a tenth of it at most.
PICARD = 3
# Relaxations with a time constant below this share of the record may have an identifiable state at its start.
SOON_SETTLED = 0.025
# Creep from a move before the records is known if all records agree on the move within this share.
BEGAN_ALIKE = 0.3


def _draw(path: DrivePath, limits: DriveLimits) -> None:
    levels, shares = (0.8, 0.2, 0.6, 0.9, 0.4), (1, 2, 4, 8, 8)
    for level, share in zip(levels, shares, strict=True):
        path.to(level, safe_duration(level - path.at))
        path.hold(remaining(limits) * share / sum(shares))


@dataclass(frozen=True)
class Creep(Effect):
    """Parallel relaxations, ``y = h + sum_k g_k z_k``, ``tau_k dz_k/dt = (h - h_0) - z_k``, at first in equilibrium.

    They are given each by itself, or by a power of time: a step creeps on by the share ``gain (t / 1 s)^exponent``.
    """

    # ``h_0``, the `origin`, is where creep adds nothing; in a fit, where there is none, the first one of each record.
    side = "stage"
    is_filter = True
    what = "slow relaxation after each movement, from 0.1 s on"
    compensated = "yes"
    dynamic = True
    excitation = Excitation(
        "Quick moves up and down, each followed by a hold, the later ones longer: at constant voltage hysteresis, "
        "lag and delay are still, and only creep goes on, in proportion to the move and in its direction.",
        _draw,
        separates=("lag", "delay", "rate_dependence"),
        order=2,
        lacking=(0.2, "no record holds the voltage for long after a quick move, where creep would show"),
    )

    time_constants: tuple[float, ...] = parameter(
        "s", "time constants tau_k", 0, 1e7, above=True, default=(), count=(0, 100),
        fit=Fit("relative", least=FASTEST, within_record=True, ends=True),
    )  # fmt: skip
    gains: tuple[float, ...] = parameter(
        "", "shares g_k of the motion that follow with each", -0.9, 11, default=(), count=(0, 100),
        fit=Fit("linear", 1e-5, 0.0),
    )  # fmt: skip
    origin: float = parameter(
        "m",
        "displacement h_0 to which creep adds nothing; null, and always for a power of time: that at the start",
        -1e3,
        1e3,
        default=inf,
        none=True,
    )
    # Only `apply` includes the creep after it; streaming starts at equilibrium.
    initial: float = parameter("m", "step of the displacement just before the record", -1e3, 1e3, default=0.0)
    exponent: float = parameter(
        "", "exponent of a power of time, instead of time constants; null: none", 0, 1, above=True, below=True,
        default=inf, none=True, instead="time_constants", fit=Fit("relative", least=LEAST_POWER, most=MOST_POWER),
    )  # fmt: skip
    gain: float = parameter(
        "", "share of a step that has followed after 1 s by the power of time", 0, 1, default=0.0, instead="gains",
        fit=Fit("linear", 1e-5, 0.0, LARGEST_POWER, stays=0.0),
    )  # fmt: skip

    def __post_init__(self) -> None:
        super().__post_init__()
        given = bool(self.time_constants) == isinf(self.exponent)
        require(
            self,
            ("exponent", given, "given if there are no time constants, and else left out"),
            ("gains", len(self.gains) == len(self.time_constants), "one for each time constant"),
            ("gains", sum(min(g, 0.0) for g in self.gains) > -0.9, "more than -0.9 in sum where they are negative"),
            ("gains", sum(self.gains) <= 10, "at most 10 in sum"),
        )

    @cached_property
    def chain(self) -> FloatArray:
        """Time constants (s) and gains of its relaxations, shape (2, K)."""
        if isinf(self.exponent):
            return np.array([self.time_constants, self.gains])
        return np.array([_power_times(self.exponent), self.gain * _power(self.exponent)])

    @property
    def unsure(self) -> Unsure:
        """What relaxes at the start, and creep that is slower than the records."""
        if not isinf(self.exponent):
            soon = ((tau, gain) for tau, gain in self.chain.T.tolist() if tau < UNSURE_FROM)
            return Unsure(tuple(soon), self.exponent * self.gain * UNSURE_FROM**self.exponent)
        count, times = len(self.gains), [log(each) for each in self.time_constants]
        spacing = (max(times) - min(times)) / max(count - 1, 1)
        # A single relaxation stands for a decade. What is slower is in no record, so that all of it is unsure.
        slow = abs(sum(self.gains)) / (count * (spacing or log(10.0)))
        sizes = (abs(gain) for gain in self.gains)
        return Unsure(relaxations=tuple(zip(self.time_constants, sizes, strict=True)), slow_share=slow)

    @by_record
    def apply(self, signal: FloatArray, around: EffectContext) -> FloatArray:
        """Return the displacement with creep, shape (N,), metres."""
        grid = around.uniform
        moved = grid.on(signal)
        moved = moved - moved[:1]
        from slpi_ros.effects.paths import relaxed

        gains = self.chain[1]
        crept = relaxed(moved, gains, np.array(self._holds(grid.dt)))
        crept, step = grid.off(crept), around.step(signal)
        if self.origin < inf and signal.size:
            crept += sum(gains) * (float(signal[0]) - step - self.origin)
        if step or self.initial:
            # What a power of time had to go before the record has no bound, and counts from its start.
            known = step if isinf(self.exponent) else step + self.initial
            for tau, gain in self.chain.T.tolist():
                crept += gain * (known - (step + self.initial) * np.exp(-around.since / tau))
        if around.before:
            crept += self.remembered(around.before, around.t)
        return signal + crept

    def hysteresis_before(self, before: Course) -> Course:
        """Return displacements of a session (m) without the creep since its begin."""
        at, y = before
        h, around = y, EffectContext.since_start(at)
        around = replace(around, grid=around.uniform)
        for _ in range(PICARD):
            h = y - (replace(self, origin=inf, initial=0.0).apply(h, around) - h)
        return at, h

    def remembered(self, before: Course, t: FloatArray) -> FloatArray:
        """Return the creep that what the hysteresis did before a record leaves, shape (N,), m, at times `t` (s)."""
        at, h = before
        left, moves, steps = np.zeros_like(t), np.diff(h), np.diff(at)
        for tau, gain in self.chain.T.tolist():
            # Of each move, at a constant speed, this share has not followed at the first stamp.
            ends = np.exp(at / tau)
            left -= gain * float(moves @ (np.diff(ends) * tau / steps)) * np.exp(-t / tau)
        return left

    @classmethod
    def fit(cls, context: FitContext) -> Iterator[Candidate]:
        """Yield single relaxations from fast to slow, and combinations of several."""
        step, most, at = usual_step(context.t), longest(context.around), (context.around, context.used)
        shortest = max(10 * step, FASTEST)
        if shortest < 0.5 * most:
            single = [np.array([tau]) for tau in np.geomspace(shortest, 0.5 * most, SINGLE)]
            several = [np.geomspace(shortest, share * most, count) for count, share in SEVERAL]
            for taus in (*single, *several):
                columns = np.column_stack([_settling(taus.tolist(), *at), *cls._creeping(taus, context)])
                yield Candidate(columns, partial(cls._each, taus), taus.size)
            for exponent in POWERS:
                unit = cls(exponent=exponent, gain=1.0)
                columns = np.column_stack([unit.starting(*at), unit.column(context)])
                yield Candidate(columns, partial(cls._of_power, exponent), 1, group=1)
        for slow in LAW_TO:
            first, last = max(FASTEST, LAW_SAMPLES * step), slow * most
            if last > 10 * first:
                taus = np.geomspace(first, last, max(LAW_FEWEST, 1 + round(LAW_PER_DECADE * np.log10(last / first))))
                together = np.sum(cls._creeping(taus, context), axis=0)
                columns = np.column_stack([_settling(taus.tolist(), *at), together])
                yield Candidate(columns, partial(cls._law, taus), 1)

    @classmethod
    def _creeping(cls, taus: FloatArray, context: FitContext) -> list[FloatArray]:
        return [cls((tau,), (1.0,)).column(context) for tau in taus.tolist()]

    @classmethod
    def _of_power(cls, exponent: float, gains: FloatArray) -> "Creep | None":
        return cls(exponent=exponent, gain=float(gains[0])) if 0.0 < gains[0] < LARGEST_POWER else None

    @classmethod
    def _law(cls, taus: FloatArray, gains: FloatArray) -> "Creep | None":
        each = (float(gains[0]),) * taus.size
        return cls(tuple(taus.tolist()), each) if gains[0] > 0.0 and _reduced(taus.tolist(), each) == each else None

    @classmethod
    def _each(cls, taus: FloatArray, gains: FloatArray) -> "Creep | None":
        seen = gains > LEAST_SHARE * gains.max()
        if not gains.max() > 0.0:
            return None
        return cls(tuple(taus[seen].tolist()), _reduced(taus[seen].tolist(), gains[seen].tolist()))

    @property
    def _is_law(self) -> bool:
        """Whether it is the logarithmic law: several relaxations with equal gains."""
        return len(self.gains) >= LAW_FEWEST and len(set(self.gains)) == 1

    def free_leaves(self) -> list[Leaf]:
        """Return the fitted numbers: of the logarithmic law only its gain."""
        every = super().free_leaves()
        return [every[len(self.time_constants)]._replace(place="gains")] if self._is_law else every

    def with_free(self, numbers: Iterable[float]) -> "Creep":
        """Return the creep with other fitted numbers; the gains of the logarithmic law stay equal."""
        if not self._is_law:
            return super().with_free(numbers)
        (gain,) = numbers
        gains = (gain,) * len(self.gains)
        return replace(self, gains=(min(_reduced(self.time_constants, gains)),) * len(gains))

    @classmethod
    def limited(cls, changed: dict[str, Any]) -> dict[str, Any]:
        """Return new parameters with the gains within their upper bounds."""
        return changed | {"gains": _reduced(changed["time_constants"], changed["gains"])}

    def plausible(self, context: FitContext) -> bool:
        """Return whether some of it is slow, and no gain, nor the sum of those within a second, is at its bound."""
        if self.time_constants and max(self.time_constants) <= FASTEST:
            return False
        soon = sum(gain for tau, gain in zip(self.time_constants, self.gains, strict=True) if tau < SOON)
        bounds = (max(self.gains, default=0.0), LARGEST), (soon, LARGEST_SOON), (self.gain, LARGEST_POWER)
        return all(gain < (1.0 - NEAR) * most for gain, most in bounds)

    def starting(self, around: EffectContext, used: Mask) -> FloatArray:
        """Return the decay of creep from a move before each record, shape (N, k), one column per unknown move."""
        if isinf(self.exponent):
            return _settling(self.time_constants, around, used)
        return _settling(_power_times(self.exponent), around, used, _power(self.exponent))

    def started(self, amplitudes: FloatArray, records: int) -> "Creep":
        """Return the creep with the move before the records (`initial`) if several records agree on it."""
        gain = self.gains[0] if self.gains else self.gain
        if records == 1 or amplitudes.size != records or not gain:
            return self
        moves = -amplitudes / gain
        initial = float(np.mean(moves))
        alike = bool(np.all(np.abs(moves - initial) <= BEGAN_ALIKE * abs(initial)))
        return replace(self, initial=initial) if alike else self

    @property
    def rested(self) -> "Creep":
        """The creep without the move before the records."""
        return replace(self, initial=0.0)

    def describe(self) -> str:
        """Describe the magnitude, and the time constants or the power of time."""
        if not isinf(self.exponent):
            return (
                f"after a move the stage creeps on with the power {self.exponent:.3g} of time, by "
                f"{self.gain * 100:.3g} % of it in 1 s and {self.gain * 100**self.exponent * 100:.3g} % in 100 s"
            )
        slow, fast = max(self.time_constants), min(self.time_constants)
        span = f"{fast:.3g} s" if slow == fast else f"{fast:.3g} to {slow:.3g} s"
        return f"after a move the stage creeps on by {sum(self.gains) * 100:.3g} % of it, with time constants of {span}"

    def laws(self) -> Mapping[str, Any]:
        """Return time constants (s), gains and origin (m) for the compiled inverse."""
        return {"relaxations": self.chain, "rest_of_creep": self.origin}

    def anchored(self, rest: float) -> "Creep":
        """Return the creep with the origin `rest` (m) unless it has one; a power of time counts from each start."""
        # After a rest without end it would have gone without bound, so that no displacement is its equilibrium.
        if not isinf(self.exponent):
            return replace(self, origin=inf)
        return self if self.origin < inf else replace(self, origin=rest)

    def streaming(self) -> "StreamingCreep":
        """Return the streaming creep."""
        return StreamingCreep(self)

    def _holds(self, dt: float) -> list[Hold]:
        return [hold(dt, tau) for tau in self.chain[0].tolist()]


class StreamingCreep(StreamingEffect):
    """Streaming (sample by sample) creep."""

    def __init__(self, creep: Creep) -> None:
        self._creep, self._gains = creep, creep.chain[1].tolist()
        self.start(0.0)
        self._over(0.0)

    def start(self, x: float) -> None:
        """Initialise to equilibrium at `x` (m)."""
        self._origin = x if self._from_start else self._creep.origin
        self._input = x - self._origin
        self._states = [self._input] * len(self._gains)

    @property
    def _from_start(self) -> bool:
        """Whether the motion counts from where it has started."""
        return isinf(self._creep.origin) or not isinf(self._creep.exponent)

    def forward(self, dt: float, x: float) -> float:
        """Advance by `dt` (s) to the displacement `x` (m) and return the displacement with creep (m)."""
        if dt != self._dt:
            self._over(dt)
        moved, last = x - self._origin, self._input
        crept = self._crept() + self._now * moved
        self._states = [
            now * moved + before * last + kept * z
            for (now, before, kept), z in zip(self._holds, self._states, strict=True)
        ]
        self._input = moved
        return x + crept

    def inverse(self, dt: float, wanted: float) -> float:
        """Return the displacement before creep (m) for a displacement with creep `wanted` (m)."""
        if dt != self._dt:
            self._over(dt)
        return self._origin + (wanted - self._origin - self._crept()) / (1.0 + self._now)

    def resume(self, other: "StreamingCreep", x: float) -> None:
        """Take over the state of another model's creep at the input `x` (m)."""
        # Relaxations with a time constant that `other` has, too, continue; all others start in equilibrium. What counts
        # from its start goes on counting from there.
        self.start(x)
        if self._from_start:
            self._origin, self._input = x - other._input, other._input
        known = dict(zip(other._creep.chain[0].tolist(), other._states, strict=True))
        taus = self._creep.chain[0].tolist()
        self._states = [self._input + known.get(tau, other._input) - other._input for tau in taus]

    def snapshot(self) -> tuple[float, ...]:
        """Return origin, last motion from the origin, and states of the relaxations (m)."""
        return self._origin, self._input, *self._states

    def restore(self, state: tuple[float, ...]) -> None:
        """Replace the state by one returned by `snapshot`."""
        self._origin, self._input, *self._states = state

    @property
    def relaxing(self) -> tuple[float, ...]:
        """Distances (m) of the relaxations from equilibrium; of motion that counts from its start, that motion too."""
        moved = (self._input,) if self._from_start else ()
        return (*(state - self._input for state in self._states), *moved)

    def relax_from(self, distances: Sequence[float]) -> None:
        """Continue from what `relaxing` has returned, or from the distances alone; others are ignored."""
        count = len(self._states)
        if self._from_start and len(distances) == count + 1:
            self._origin += self._input - distances[count]
            self._input = distances[count]
            distances = distances[:count]
        if len(distances) == count:
            self._states = [self._input + distance for distance in distances]

    def _crept(self) -> float:
        """Return the part of the creep (m) that is independent of the motion in the present step."""
        crept = self._before * self._input
        for share, z in zip(self._kept, self._states, strict=True):
            crept += share * z
        return crept

    def _over(self, dt: float) -> None:
        gains, self._dt, self._holds = self._gains, dt, self._creep._holds(dt)
        self._kept = [gain * one.kept for gain, one in zip(gains, self._holds, strict=True)]
        self._now = self._before = 0.0
        # Not `sum`, which rounds otherwise than the compiled inverse.
        for gain, one in zip(gains, self._holds, strict=True):
            self._now += gain * one.now
            self._before += gain * one.before


def _reduced(time_constants: Sequence[float], gains: Sequence[float]) -> tuple[float, ...]:
    """Return the gains, reduced to the upper bounds for creep."""
    gains = [min(gain, LARGEST) for gain in gains]
    soon = sum(gain for tau, gain in zip(time_constants, gains, strict=True) if tau < SOON)
    share = min(1.0, LARGEST_SOON / soon) if soon > 0.0 else 1.0
    return tuple(gain * share if tau < SOON else gain for tau, gain in zip(time_constants, gains, strict=True))


def _power_times(exponent: float) -> FloatArray:
    """Return the time constants (s, (K,)) of the chain for a power of time."""
    # What is faster, and what is slower, than all others is one relaxation each, with the same two moments.
    ends = (CHAIN[0] / EDGE * exponent / (exponent + 1), CHAIN[-1] * EDGE * (2 - exponent) / (1 - exponent))
    return np.concatenate([ends[:1], CHAIN, ends[1:]])


def _power(exponent: float) -> FloatArray:
    """Return the gains, shape (K,), of the chain for ``(t / 1 s)^exponent``."""
    # ``t^n = n / Gamma(1 - n)`` times the integral of ``(1 - exp(-t / tau)) tau^(n - 1)`` over tau.
    faster = (CHAIN[0] / EDGE) ** exponent / exponent
    first, last = CHAIN[-1] * EDGE, _power_times(exponent)[-1]
    slower = first ** (exponent - 1) / (1 - exponent) * last
    every = np.concatenate([[faster], CHAIN**exponent * 2 * log(EDGE), [slower]])
    return np.asarray(exponent / gamma(1 - exponent) * every)


def _settling(
    time_constants: Sequence[float] | FloatArray, around: EffectContext, used: Mask, gains: FloatArray | None = None
) -> FloatArray:
    """Return the decay of creep that began before each record, shape (N, k), one column per identifiable relaxation.

    Of a record whose session is known there is none.
    """
    # A law, logarithmic or with the `gains` of a power of time, has a single column, for a move just before the record.
    from scipy.linalg import block_diag

    parts = zip(around.records or (around,), around.split(used), strict=True)
    each = (
        np.empty((own.size, 0)) if record.before else _settling_of(time_constants, record.t, own, gains)
        for record, own in parts
    )
    return np.asarray(block_diag(*each))


def _settling_of(
    time_constants: Sequence[float] | FloatArray, t: FloatArray, used: Mask, gains: FloatArray | None
) -> FloatArray:
    times = t[used]
    since = np.maximum(t - times[0], 0.0)
    if len(time_constants) >= LAW_FEWEST:
        shares, rest = (np.ones(len(time_constants)), 0.0) if gains is None else (gains, float(np.sum(gains)))
        each = zip(time_constants, shares, strict=True)
        return np.asarray(np.sum([share * np.exp(-since / tau) for tau, share in each], axis=0) - rest)[:, None]
    soon = [tau for tau in time_constants if tau < SOON_SETTLED * (times[-1] - times[0])]
    return np.asarray(np.exp(-since[:, None] / np.array(soon)))
