"""Thermal drift: slow change of the displacement, independent of the voltage."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from slpi_ros.arrays import FloatArray
from slpi_ros.effects.base import Additive, Candidate, EffectContext, FitContext
from slpi_ros.effects.excitation import DriveLimits, DrivePath, Excitation, remaining, safe_duration
from slpi_ros.effects.parameters import Fit, Leaf, parameter, require

# Numbers of knots of the candidates.
KNOTS = (2, 3, 5, 8, 13)
# Shortest duration (s), and highest rate (share of the motion per second).
TAKES, RATE = 10.0, 1e-2


def _draw(path: DrivePath, limits: DriveLimits) -> None:
    # Motion takes 0.6 of each cycle.
    shortest = 2 * max(limits.quickest(1.0), safe_duration(1.0)) / 0.6
    repeats = min(max(int(remaining(limits) / shortest), 3), 8)
    each = remaining(limits) / repeats
    for _ in range(repeats):
        path.to(1.0, 0.3 * each)
        path.hold(0.2 * each)
        path.to(0.0, 0.3 * each)
        path.hold(0.2 * each)


@dataclass(frozen=True)
class ThermalDrift(Additive):
    """A displacement that depends on time only, linear between knots and constant outside."""

    side = "record"
    what = "slow change that does not follow the voltage"
    compensated = "no"
    needs_feedback = True
    excitation = Excitation(
        "The same full loop over and over, with the same holds: voltage, memory and creep repeat, so what differs "
        "from one repeat to the next follows time alone.",
        _draw,
        separates=("creep",),
        order=1,
    )

    times: tuple[float, ...] = parameter("s", "times of the knots from the record's start", -1e9, 1e9)
    values: tuple[float, ...] = parameter("m", "displacements at the knots", -1e3, 1e3, fit=Fit("linear", 1e-9))

    def __post_init__(self) -> None:
        super().__post_init__()
        rising = all(a < b for a, b in zip(self.times, self.times[1:], strict=False))
        require(
            self,
            ("times", rising, "strictly increasing"),
            ("values", len(self.values) == len(self.times), "one for each time"),
        )

    @property
    def courses(self) -> tuple[tuple[float, ...], ...]:
        """Displacements at the knots, m, from their mean: a constant belongs to the zero."""
        return (tuple((np.array(self.values) - np.mean(self.values)).tolist()),)

    def free_leaves(self) -> list[Leaf]:
        """Return the displacements at the knots but the last one: a constant belongs to the zero."""
        return super().free_leaves()[:-1]

    def with_free(self, numbers: Iterable[float]) -> "ThermalDrift":
        """Return the drift with other displacements at the knots but the last one."""
        return super().with_free([*numbers, self.values[-1]])

    def plausible(self, context: FitContext) -> bool:
        """Return whether it is slow."""
        pairs = zip(np.diff(self.values).tolist(), np.diff(self.times).tolist(), strict=True)
        return self.times[-1] >= TAKES and all(abs(dy) <= RATE * context.motion * dt for dy, dt in pairs)

    def added(self, around: EffectContext) -> FloatArray:
        """Return the drift, shape (N,), metres."""
        return np.interp(around.t, self.times, self.values)

    def from_end(self) -> tuple["ThermalDrift", float]:
        """Return the drift that ends at zero, and the displacement (m) at the end."""
        end = self.values[-1]
        return replace(self, values=tuple(value - end for value in self.values)), end

    @classmethod
    def fit(cls, context: FitContext) -> Iterator[Candidate]:
        """Yield piecewise linear curves with an increasing number of knots."""
        for knots in KNOTS if float(np.ptp(context.t)) >= TAKES else ():
            times = np.linspace(context.t[0], context.t[-1], knots)
            # A constant is part of the displacement at rest.
            hats = np.column_stack([np.interp(context.t, times, row) for row in np.eye(knots)[1:]])
            yield Candidate(hats, partial(cls._through, times))

    @classmethod
    def _through(cls, times: FloatArray, gains: FloatArray) -> "ThermalDrift":
        return cls(tuple(times.tolist()), (0.0, *gains.tolist()))

    def describe(self) -> str:
        """Describe the range and the duration."""
        way, span = max(self.values) - min(self.values), self.times[-1] - self.times[0]
        return f"whatever the voltage, the stage drifts by {way * 1e6:.3g} µm within {span:.3g} s of this record"
