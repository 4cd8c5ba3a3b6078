"""Building blocks of excitation drives: moves and holds in sequence, within the limits of an axis."""

import math
from dataclasses import dataclass

import numpy as np

from slpi_ros.arrays import FloatArray, IntArray
from slpi_ros.effects.excitation import FEWEST_STEPS, STEEPEST
from slpi_ros.errors import UsageError

# Largest number of samples of a drive.
MOST_STEPS = 10_000_000
# Largest magnitude of a voltage limit, volts.
MOST_VOLTAGE = 10_000.0


@dataclass(frozen=True)
class Leg:
    """One move, or a hold if the target, a share of the voltage range, is the current position."""

    to: float
    # Desired duration, which the slew limit may extend.
    seconds: float
    # Constant speed with sharp corners; else a raised cosine, with zero speed at both ends.
    straight: bool = False


@dataclass(frozen=True)
class DriveSpec:
    """Voltage limits (V), time of the last sample (s), sampling rate (Hz) and slew limit (V/s; 0: none) of one axis."""

    low: float
    high: float
    duration: float
    rate: float
    slew_limit: float = 0.0

    def __post_init__(self) -> None:
        if not -math.inf < self.low < self.high < math.inf:
            raise UsageError(f"drive: limits {self.low} V and {self.high} V; the first must be the lower one")
        if max(-self.low, self.high) > MOST_VOLTAGE:
            raise UsageError(
                f"drive: limits {self.low:g} V and {self.high:g} V; give at most {MOST_VOLTAGE:g} V either way"
            )
        if not (0 < self.duration < math.inf and 0 < self.rate < math.inf):
            raise UsageError(f"drive: {self.duration} s at {self.rate} Hz; both must be more than 0")
        if self.duration * self.rate > MOST_STEPS:
            raise UsageError(f"drive: {self.duration:g} s at {self.rate:g} Hz are more than {MOST_STEPS} samples")
        if not 0 <= self.slew_limit < math.inf:
            raise UsageError(f"drive: slew limit {self.slew_limit} V/s; give more than 0, or 0 for none")

    @property
    def span(self) -> float:
        """Size of the range, volts."""
        return self.high - self.low

    @property
    def steps(self) -> int:
        """Number of steps from the first sample to the last."""
        return round(self.duration * self.rate)

    def quickest(self, span: float, straight: bool = False) -> float:
        """Return the shortest time (s) for a move over a `span` of the range (share)."""
        if not self.slew_limit:
            return 0.0
        return abs(span) * self.span * (1.0 if straight else STEEPEST) / self.slew_limit

    def fewest_steps(self, span: float, straight: bool) -> int:
        """Return the smallest number of steps for a move over a `span` of the range (share)."""
        return max(1 if straight else FEWEST_STEPS, math.ceil(self.quickest(span, straight) * self.rate))


class Path:
    """A sequence of legs; `start` and `at`: position (share of the range) before the first and after the last one."""

    def __init__(self, start: float = 0.0) -> None:
        self.start = self.at = start
        self.legs: list[Leg] = []

    def to(self, share: float, seconds: float, *, straight: bool = False) -> None:
        """Append a move to a share of the range in `seconds`, or longer if the slew limit requires it."""
        self.legs.append(Leg(share, seconds, straight))
        self.at = share

    def hold(self, seconds: float) -> None:
        """Append a hold of `seconds` at the current position."""
        self.to(self.at, seconds)

    def wanted_steps(self, spec: DriveSpec) -> FloatArray:
        """Return the number of steps for the desired duration of each leg, shape (n,)."""
        wanted = np.array([leg.seconds * spec.rate for leg in self.legs])
        return np.asarray(np.maximum(wanted, self.fewest_steps(spec)), dtype=np.float64)

    def fewest_steps(self, spec: DriveSpec) -> IntArray:
        """Return the smallest number of steps of each leg, shape (n,)."""
        spans = np.diff(self._turns).tolist()
        # A slew limit near zero would ask for more steps than an integer holds.
        fewest = [
            min(spec.fewest_steps(span, leg.straight), MOST_STEPS) for span, leg in zip(spans, self.legs, strict=True)
        ]
        return np.array(fewest, dtype=np.int64)

    def voltages(self, spec: DriveSpec) -> FloatArray:
        """Return the voltages (V) along all legs, shape (spec.steps + 1,); every reversal coincides with a sample."""
        # The time beyond the shortest durations is distributed in proportion to desired minus shortest duration.
        fewest = self.fewest_steps(spec)
        spare = spec.steps - int(fewest.sum())
        if spare < 0:
            raise UsageError(
                f"drive: {len(fewest)} moves and holds within {spec.low:g} to {spec.high:g} V take at least "
                f"{fewest.sum() / spec.rate:.4g} s at {_limits_of(spec)}, not {spec.duration:g} s; give more time"
            )
        knots = np.concatenate([[0], np.cumsum(fewest) + _shared_out(spare, self.wanted_steps(spec) - fewest)])
        x = np.arange(spec.steps + 1)
        leg = np.clip(np.searchsorted(knots, x, side="right") - 1, 0, fewest.size - 1)
        phase = (x - knots[leg]) / np.diff(knots)[leg]
        straight = np.array([each.straight for each in self.legs])[leg]
        way = np.where(straight, phase, (1.0 - np.cos(np.pi * phase)) / 2.0)
        share = self._turns[leg] + np.diff(self._turns)[leg] * way
        return np.asarray(np.clip(spec.low + spec.span * share, spec.low, spec.high), dtype=np.float64)

    @property
    def _turns(self) -> FloatArray:
        return np.array([self.start, *(leg.to for leg in self.legs)])


def _shared_out(steps: int, weights: FloatArray) -> IntArray:
    """Distribute whole steps in proportion to weights; return the cumulative sums, shape (len(weights),)."""
    # Equal shares if all weights are zero.
    total = np.cumsum(weights + 1e-9)
    return np.asarray(np.rint(steps * total / total[-1]), dtype=np.int64)


def _limits_of(spec: DriveSpec) -> str:
    return f"{spec.rate:g} Hz and {spec.slew_limit:g} V/s" if spec.slew_limit else f"{spec.rate:g} Hz"
