"""Saturation: the amplifier clips below what it is commanded."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from math import inf, isinf, isnan
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from slpi_ros.effects.base import EffectContext, FloatArray, Removable, ResidualView, Side, require_rules

# Voltages are sorted into so many bins; the stage stands still where it moves by less than this share of the usual.
BINS, STILL = 200, 0.35


@dataclass(frozen=True)
class Saturation:
    """The voltage at the piezo never leaves a range.

    Parameters
    ----------
    lower, upper : float, volts
        Infinite where there is no limit.
    uncertainty : mapping of str to float
    """

    name: ClassVar[str] = "saturation"
    side: ClassVar[Side] = "voltage"
    removable: ClassVar[Removable] = "never"

    lower: float = -inf
    upper: float = inf
    uncertainty: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Refuse a range without voltages."""
        require_rules(
            self,
            ("lower", not isnan(self.lower) and self.lower < inf, "a voltage, or -inf for none"),
            ("upper", self.upper > self.lower, f"more than lower, {self.lower} V"),
        )

    def apply(self, signal: FloatArray, around: EffectContext) -> FloatArray:
        """Return the voltage, shape (N,), volts, within the range."""
        return np.clip(signal, self.lower, self.upper)

    def invert(self, signal: FloatArray, around: EffectContext) -> FloatArray:
        """Return the voltage, shape (N,), volts, within the range: more is not to be had."""
        return np.clip(signal, self.lower, self.upper)

    @classmethod
    def fit(cls, left: ResidualView) -> Iterator["Saturation"]:
        """Yield limits where the displacement stands still although the voltage goes on."""
        low, width = float(left.u.min()), float(np.ptp(left.u)) / BINS
        middle, dv, dy = outward_steps(left.u, left.y, left.used)
        place = np.clip(((middle - low) / width).astype(np.int64), 0, BINS - 1)
        moved = np.bincount(place, dv**2, BINS)
        gain = np.bincount(place, dv * dy, BINS) / np.maximum(moved, 1e-300)
        still = (gain < STILL * np.median(gain[moved > 0])) | (moved == 0)
        at_top, at_bottom = int(np.argmin(still[::-1])), int(np.argmin(still))
        upper = low + (BINS - at_top) * width if at_top else np.inf
        lower = low + at_bottom * width if at_bottom else -np.inf
        if upper > lower and (at_top or at_bottom):
            for shift in np.linspace(-1.0, 1.0, 9).tolist():
                yield cls(lower + shift * width, upper - shift * width)

    def describe(self) -> str:
        """Say where it clips."""
        below, above = f"below {self.lower:.4g} V", f"above {self.upper:.4g} V"
        where = [text for text, limit in ((below, self.lower), (above, self.upper)) if not isinf(limit)]
        return f"the amplifier clips {' and '.join(where) or 'nowhere'}"

    def streaming(self) -> "StreamingSaturation":
        """Return the limits sample by sample."""
        return StreamingSaturation(self.lower, self.upper)


def outward_steps(v: FloatArray, y: FloatArray, used: NDArray[np.bool_]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return steps away from the middle of the voltage's range: a stage that is clipped stands still there.

    Returns
    -------
    middle, dv : ndarray, shape (M,), volts
        Where each step is, and how far it goes.
    dy : ndarray, shape (M,), metres
        How far the stage goes.
    """
    low, high = float(v.min()), float(v.max())
    # Steps over a few samples stand out of the noise.
    every = max(1, round((high - low) / BINS / 4 / max(float(np.mean(np.abs(np.diff(v)))), 1e-12)))
    middle, dv, dy = 0.5 * (v[every:] + v[:-every]), v[every:] - v[:-every], y[every:] - y[:-every]
    outward = (dv > 0) == (middle > 0.5 * (low + high))
    chosen = used[every:] & used[:-every] & outward & (dv != 0.0)
    return middle[chosen], dv[chosen], dy[chosen]


class StreamingSaturation:
    """Limits sample by sample; there is nothing to remember."""

    def __init__(self, lower: float, upper: float) -> None:
        self.lower, self.upper = lower, upper

    def start(self, x: float) -> None:
        """Be at rest at `x` (V)."""

    def forward(self, dt: float, x: float) -> float:
        """Return the voltage (V) within the range."""
        return min(max(x, self.lower), self.upper)

    def inverse(self, dt: float, wanted: float) -> float:
        """Return the voltage (V) within the range."""
        return min(max(wanted, self.lower), self.upper)

    def snapshot(self) -> tuple[()]:
        """Return nothing."""
        return ()

    def restore(self, state: tuple[()]) -> None:
        """Take over nothing."""
