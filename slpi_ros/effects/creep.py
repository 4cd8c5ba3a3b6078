"""Creep: slow relaxation of the displacement after a move."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from slpi_ros.effects.base import (
    Candidate,
    EffectBase,
    EffectContext,
    FloatArray,
    ResidualView,
    Side,
    Signal,
    StreamingBase,
    by_record,
    longest,
    require,
    usual_step,
)
from slpi_ros.effects.filters import Hold, hold

# Shortest time constant (s) of creep; shorter ones are modelled as lag.
FASTEST = 0.1
# Upper bounds on the gains: of each relaxation, and of the sum of those with time constants within a second.
LARGEST, SOON, LARGEST_SOON = 0.15, 1.0, 0.12
# A gain is at its bound within this share of it.
NEAR = 1e-3
# Candidates: number of single relaxations; sets of several (number, longest time constant as share of the record).
# Gains below this share of the largest gain are dropped.
SINGLE, SEVERAL, LEAST_SHARE = 7, ((2, 0.1), (2, 0.5), (3, 0.3), (4, 0.7)), 0.02
# Logarithmic law, equal gains: relaxations per decade, from the longer of `FASTEST` and a number of samples, to a share
# of the longest record, and the smallest number of relaxations.
LAW_PER_DECADE, LAW_SAMPLES, LAW_TO, LAW_FEWEST = 2, 3.0, (0.3, 3.0), 4
# Relaxations with a time constant below this share of the record may have an identifiable state at its start.
SOON_SETTLED = 0.025


@dataclass(frozen=True)
class Creep(EffectBase):
    """Parallel first-order relaxations, ``y = h + sum_k g_k z_k`` with ``tau_k dz_k/dt = (h - h_0) - z_k``.

    ``h_0`` is the displacement at the start, where all relaxations are in equilibrium.

    Parameters
    ----------
    time_constants : tuple of float, length K >= 1, seconds, ``tau_k``
    gains : tuple of float, length K
        Share ``g_k`` of the motion ``h - h_0`` that follows with each time constant.
    initial : float, metres
        Displacement step just before the record, default 0. Only `apply` includes the creep after this step; streaming
        starts at equilibrium.
    uncertainty : mapping of parameter name to standard deviation, optional
        Standard deviations; those of single elements have keys such as ``gains.0``.
    """

    name: ClassVar[str] = "creep"
    acts_on: ClassVar[Signal] = "displacement"
    side: ClassVar[Side] = "stage"

    time_constants: tuple[float, ...]
    gains: tuple[float, ...]
    initial: float = 0.0
    uncertainty: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Validate the parameters, including invertibility."""
        require(
            self,
            ("time_constants", 1 <= len(self.time_constants) <= 100, "1 to 100 numbers"),
            ("time_constants", all(0 < tau <= 1e7 for tau in self.time_constants), "more than 0 s, at most 1e7 s"),
            ("gains", len(self.gains) == len(self.time_constants), "one for each time constant"),
            ("gains", sum(min(g, 0.0) for g in self.gains) > -0.9, "more than -0.9 in sum where they are negative"),
            ("gains", sum(self.gains) <= 10, "at most 10 in sum"),
            ("initial", abs(self.initial) <= 1e3, "within 1000 m"),
        )

    @by_record
    def apply(self, signal: FloatArray, around: EffectContext) -> FloatArray:
        """Return the displacement with creep, shape (N,), metres."""
        grid = around.uniform
        moved = grid.on(signal)
        moved = moved - moved[:1]
        from slpi_ros.effects.paths import relaxed

        crept = relaxed(moved, np.array(self.gains), np.array(self._holds(grid.dt)))
        crept, step = grid.off(crept), around.step(signal)
        if step or self.initial:
            for gain, tau in zip(self.gains, self.time_constants, strict=True):
                crept += gain * (step - (step + self.initial) * np.exp(-around.since / tau))
        return signal + crept

    @classmethod
    def fit(cls, left: ResidualView) -> Iterator[Candidate]:
        """Yield single relaxations from fast to slow, and combinations of several."""
        step, most = usual_step(left.t), longest(left.around)
        shortest = max(10 * step, FASTEST)
        if shortest < 0.5 * most:
            single = [np.array([tau]) for tau in np.geomspace(shortest, 0.5 * most, SINGLE)]
            several = [np.geomspace(shortest, share * most, count) for count, share in SEVERAL]
            for taus in (*single, *several):
                starting = settling(taus.tolist(), left.around, left.used)
                columns = np.column_stack([starting, *cls._creeping(taus, left)])
                yield Candidate(columns, partial(cls._each, taus), taus.size, starting.shape[1])
        for slow in LAW_TO:
            first, last = max(FASTEST, LAW_SAMPLES * step), slow * most
            if last > 10 * first:
                taus = np.geomspace(first, last, max(LAW_FEWEST, 1 + round(LAW_PER_DECADE * np.log10(last / first))))
                starting = settling(taus.tolist(), left.around, left.used)
                columns = np.column_stack([starting, np.sum(cls._creeping(taus, left), axis=0)])
                yield Candidate(columns, partial(cls._law, taus), 1, starting.shape[1])

    @classmethod
    def _creeping(cls, taus: FloatArray, left: ResidualView) -> list[FloatArray]:
        return [cls((tau,), (1.0,)).apply(left.h, left.around) - left.h for tau in taus.tolist()]

    @classmethod
    def _law(cls, taus: FloatArray, gains: FloatArray) -> "Creep | None":
        each = (float(gains[0]),) * taus.size
        return cls(tuple(taus.tolist()), each) if gains[0] > 0.0 and plausible(taus.tolist(), each) == each else None

    @classmethod
    def _each(cls, taus: FloatArray, gains: FloatArray) -> "Creep | None":
        seen = gains > LEAST_SHARE * gains.max()
        if not gains.max() > 0.0:
            return None
        return cls(tuple(taus[seen].tolist()), plausible(taus[seen].tolist(), gains[seen].tolist()))

    def describe(self) -> str:
        """Describe the magnitude and the time constants."""
        slow, fast = max(self.time_constants), min(self.time_constants)
        span = f"{fast:.3g} s" if slow == fast else f"{fast:.3g} to {slow:.3g} s"
        return f"after a move the stage creeps on by {sum(self.gains) * 100:.3g} % of it, with time constants of {span}"

    def laws(self) -> Mapping[str, FloatArray]:
        """Return time constants (s) and gains for the compiled inverse."""
        return {"relaxations": np.array([self.time_constants, self.gains])}

    def streaming(self) -> "StreamingCreep":
        """Return the streaming creep."""
        return StreamingCreep(self)

    def _holds(self, dt: float) -> list[Hold]:
        return [hold(dt, tau) for tau in self.time_constants]


class StreamingCreep(StreamingBase):
    """Streaming (sample by sample) creep."""

    def __init__(self, creep: Creep) -> None:
        self._creep = creep
        self.start(0.0)
        self._over(0.0)

    def start(self, x: float) -> None:
        """Initialise to equilibrium at `x` (m)."""
        self._origin, self._input, self._states = x, 0.0, [0.0] * len(self._creep.gains)

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
        """Take over the state of another model's creep at the input `x` (m).

        Relaxations with a time constant that `other` also has continue from its state; all others start in equilibrium.
        """
        moved = other._input
        known = dict(zip(other._creep.time_constants, other._states, strict=True))
        self._origin, self._input = x - moved, moved
        self._states = [known.get(tau, moved) for tau in self._creep.time_constants]

    def snapshot(self) -> tuple[float, ...]:
        """Return origin, last motion from the origin, and states of the relaxations (m)."""
        return self._origin, self._input, *self._states

    def restore(self, state: tuple[float, ...]) -> None:
        """Replace the state by one returned by `snapshot`."""
        self._origin, self._input, *self._states = state

    def _crept(self) -> float:
        """Return the part of the creep (m) that is independent of the motion in the present step."""
        crept = self._before * self._input
        for share, z in zip(self._kept, self._states, strict=True):
            crept += share * z
        return crept

    def _over(self, dt: float) -> None:
        gains, self._dt, self._holds = self._creep.gains, dt, self._creep._holds(dt)
        self._kept = [gain * one.kept for gain, one in zip(gains, self._holds, strict=True)]
        self._now = self._before = 0.0
        # Not `sum`, which rounds otherwise than the compiled inverse.
        for gain, one in zip(gains, self._holds, strict=True):
            self._now += gain * one.now
            self._before += gain * one.before


def plausible(time_constants: Sequence[float], gains: Sequence[float]) -> tuple[float, ...]:
    """Return the gains, reduced to the upper bounds for creep."""
    gains = [min(gain, LARGEST) for gain in gains]
    soon = sum(gain for tau, gain in zip(time_constants, gains, strict=True) if tau < SOON)
    share = min(1.0, LARGEST_SOON / soon) if soon > 0.0 else 1.0
    return tuple(gain * share if tau < SOON else gain for tau, gain in zip(time_constants, gains, strict=True))


def within_bounds(creep: Creep) -> bool:
    """Return whether no gain, nor the sum of those that settle within a second, is at its upper bound."""
    soon = sum(gain for tau, gain in zip(creep.time_constants, creep.gains, strict=True) if tau < SOON)
    return max(creep.gains) < (1.0 - NEAR) * LARGEST and soon < (1.0 - NEAR) * LARGEST_SOON


def settling(
    time_constants: Sequence[float], around: EffectContext, used: NDArray[np.bool_], *, older: bool = False
) -> FloatArray:
    """Return the decay of creep that began before each record, shape (N, k), one column per identifiable relaxation.

    The logarithmic law has a single column, for a move just before the record. With `older` there is a second one, for
    a move one record duration before the record, of which only the slow part remains.
    """
    whole = []
    for own in range(max(len(around.records), 1)):
        for column in _settling_of(time_constants, around.split(around.t)[own], around.split(used)[own], older):
            parts = [np.zeros_like(t) for t in around.split(around.t)]
            parts[own] = column
            whole.append(np.concatenate(parts))
    return np.column_stack([np.empty((around.t.size, 0)), *whole])


def _settling_of(
    time_constants: Sequence[float], t: FloatArray, used: NDArray[np.bool_], older: bool
) -> list[FloatArray]:
    times = t[used]
    since = np.maximum(t - times[0], 0.0)
    if len(time_constants) >= LAW_FEWEST:
        ages = (0.0, float(times[-1] - times[0])) if older else (0.0,)
        return [np.sum([np.exp(-(since + age) / tau) for tau in time_constants], axis=0) for age in ages]
    return [np.exp(-since / tau) for tau in time_constants if tau < SOON_SETTLED * (times[-1] - times[0])]
