"""Saturation: the amplifier output is limited to a voltage range."""

from collections.abc import Iterator
from dataclasses import dataclass
from math import inf, isinf
from typing import Any

import numpy as np

from slpi_ros.arrays import FloatArray, IntArray, Mask
from slpi_ros.effects.base import Effect, EffectContext, FitContext
from slpi_ros.effects.excitation import DriveLimits, DrivePath, Excitation, remaining, safe_duration
from slpi_ros.effects.parameters import Fit, parameter, require

# Number of voltage bins; a bin is clipped if its gain is below this share of the median gain.
BINS, STILL = 200, 0.35
# Distance from a limit, as a share of the range, within which a voltage is at it.
WITHIN = 1e-6


def _limit(default: float) -> Any:
    fit = Fit("relative", lambda _, of: 1e-3 * of.voltage)
    return parameter("V", "limit", -1e4, 1e4, default=default, required=True, none=True, fit=fit)


def _draw(path: DrivePath, limits: DriveLimits) -> None:
    for near in (0.2, 0.1, 0.05, 0.0):
        for seconds in (remaining(limits) / 12, remaining(limits) / 48):
            for end in (1.0 - near, near):
                path.to(end, max(seconds, safe_duration(1.0)))
                path.hold(0.01 * limits.duration)


@dataclass(frozen=True)
class Saturation(Effect):
    """Limits of the voltage at the piezo, which the limits of the command keep, see `passes`."""

    acts_on = "voltage"
    side = "stage"
    what = "the amplifier clips"
    compensated = "no voltage undoes it: displacements beyond it are out of reach"
    excitation = Excitation(
        "Peaks that come up to both limits in steps, slow and fast, with a hold at each: a clipped amplifier stops "
        "at one voltage at any speed, where hysteresis and lag go on to the peak.",
        _draw,
    )

    lower: float = _limit(-inf)
    upper: float = _limit(inf)

    def __post_init__(self) -> None:
        super().__post_init__()
        require(
            self,
            ("lower", self.lower < inf, "a voltage, or -inf for none"),
            ("upper", self.upper > self.lower, f"more than lower, {self.lower} V"),
        )

    def apply(self, signal: FloatArray, around: EffectContext) -> FloatArray:
        """Return the voltage, shape (N,), volts, clipped to the limits."""
        return np.clip(signal, self.lower, self.upper)

    def invert(self, signal: FloatArray, around: EffectContext) -> FloatArray:
        """Return the voltage, shape (N,), volts, clipped to the limits; a clipped voltage cannot be recovered."""
        return np.clip(signal, self.lower, self.upper)

    @classmethod
    def fit(cls, context: FitContext) -> Iterator["Saturation"]:
        """Yield limits beyond which the displacement remains constant while the voltage changes."""
        # At the piezo: what the hysteresis feels moves on while the voltage rests.
        v = context.u if context.around.voltage is None else context.around.voltage
        low, width = float(v.min()), float(np.ptp(v)) / BINS
        first, last = outward_steps(v, context.used)
        dv, dy, middle = v[last] - v[first], context.y[last] - context.y[first], 0.5 * (v[last] + v[first])
        place = np.clip(((middle - low) / width).astype(np.int64), 0, BINS - 1)
        # A few steps in a bin are noisy: each with its neighbours.
        moved, way = (np.convolve(np.bincount(place, x, BINS), np.ones(3), "same") for x in (dv**2, dv * dy))
        gain = way / np.maximum(moved, 1e-300)
        still = (gain < STILL * np.median(gain[moved > 0])) | (moved == 0)
        at_top, at_bottom = int(np.argmin(still[::-1])), int(np.argmin(still))
        upper = low + (BINS - at_top) * width if at_top else np.inf
        lower = low + at_bottom * width if at_bottom else -np.inf
        if upper > lower and (at_top or at_bottom):
            for shift in np.linspace(-1.0, 1.0, 9).tolist():
                yield cls(lower + shift * width, upper - shift * width)

    def plausible(self, context: FitContext) -> bool:
        """Return whether the stage stands still while the voltage changes beyond the limits."""
        first, last = outward_steps(context.v, context.used)
        dv, dy = context.v[last] - context.v[first], context.y[last] - context.y[first]
        # By what reaches the piezo, which may follow the voltage late.
        middle, within = 0.5 * (context.u[last] + context.u[first]), WITHIN * float(np.ptp(context.v))
        inside = (middle > self.lower + within) & (middle < self.upper - within)
        usual = float(dv[inside] @ dy[inside] / max(float(dv[inside] @ dv[inside]), 1e-300))
        for beyond in (middle >= self.upper - within, middle <= self.lower + within):
            if beyond.any() and float(dv[beyond] @ dy[beyond]) > STILL * usual * float(dv[beyond] @ dv[beyond]):
                return False
        return True

    @property
    def passes(self) -> tuple[float, float]:
        """The limits, volts."""
        return self.lower, self.upper

    def describe(self) -> str:
        """Describe the limits."""
        below, above = f"below {self.lower:.4g} V", f"above {self.upper:.4g} V"
        where = [text for text, limit in ((below, self.lower), (above, self.upper)) if not isinf(limit)]
        return f"the amplifier clips {' and '.join(where) or 'nowhere'}"


def outward_steps(v: FloatArray, used: Mask) -> tuple[IntArray, IntArray]:
    """Return the first and last samples, (M,), of steps of a voltage (V, (N,)) away from the middle of its range."""
    # Beyond a clipping limit they give no displacement.
    low, high = float(v.min()), float(v.max())
    at = np.flatnonzero(used)
    v = v[at]
    # Steps over several samples improve the signal-to-noise ratio.
    every = max(1, round((high - low) / BINS / 4 / max(float(np.mean(np.abs(np.diff(v)))), 1e-12)))
    middle, dv = 0.5 * (v[every:] + v[:-every]), v[every:] - v[:-every]
    outward = (dv > 0) == (middle > 0.5 * (low + high))
    first = np.flatnonzero(outward & (dv != 0.0))
    return at[first], at[first + every]
