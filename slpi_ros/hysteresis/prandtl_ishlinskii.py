"""The play operator (SLPI paper, Eq. 1) and the classical Prandtl-Ishlinskii (PI) model (Eq. 8, inverse Eq. 10-12)."""

from dataclasses import dataclass, field

import numpy as np

from slpi_ros.arrays import FloatArray
from slpi_ros.errors import ModelError
from slpi_ros.hysteresis.shapes import END, Branches, Curve


@dataclass(frozen=True)
class PrandtlIshlinskii:
    """A weighted sum of play operators, ``P[v] = sum_i w_i p_i[v]``; the one with threshold 0 is the linear term."""

    # At rest every operator is in the middle of its play and moves after ``r_i``. In a primed memory it is at the end
    # of its play, as after a long fall, and moves up after ``2 r_i``.
    thresholds: FloatArray  # V, (n,), ``0 <= r_1 < r_2 < ...``
    weights: FloatArray  # m/V, (n,); no cumulative sum is negative
    symmetric_rest: bool = field(default=True, init=False)
    branches: Branches = field(init=False, repr=False)
    _branch: Curve = field(init=False, repr=False)
    _first: Curve = field(init=False, repr=False)

    def __post_init__(self) -> None:
        for name in ("thresholds", "weights"):
            object.__setattr__(self, name, np.asarray(getattr(self, name), dtype=np.float64))
        r, w = self.thresholds, self.weights
        if r.ndim != 1 or r.shape != w.shape or r.size == 0:
            raise ModelError(f"PI: {r.shape} thresholds and {w.shape} weights; give as many of each, at least one")
        if not (np.isfinite(r).all() and np.isfinite(w).all() and r[0] >= 0 and (np.diff(r) > 0).all()):
            raise ModelError("PI: thresholds must be finite, not negative and rise strictly; weights must be finite")
        if np.min(np.cumsum(w)) < 0:
            raise ModelError(
                "PI: every cumulative sum of the weights must be at least 0, else rising branches would decrease"
            )
        object.__setattr__(self, "_branch", self._curve(2.0))
        object.__setattr__(self, "_first", self._curve(1.0))
        rows = [[(self._branch.knots, 0.0 * self._branch.knots)]]
        object.__setattr__(self, "branches", Branches.interpolated(np.empty((2, 0)), 2 * rows))

    @property
    def invertible(self) -> bool:
        """Whether the output is strictly monotone: all cumulative sums of the weights are positive."""
        return bool(self.thresholds[0] == 0 and np.min(np.cumsum(self.weights)) > 0)

    def branch(self, direction: int, v_turn: float) -> Curve:
        """Return the branch ``F(u) = sum_i w_i max(u - 2 r_i, 0)``, independent of the reversal."""
        return self._branch

    def first_rise(self, v_rest: float) -> Curve:
        """Return the first rise from rest, ``F(u) = sum_i w_i max(u - r_i, 0)``."""
        return self._first

    def inverse(self) -> "PrandtlIshlinskii":
        """Return the analytic inverse, a PI model from displacement (m) to voltage (V), or raise."""
        # ``r'_i = sum_{j<=i} w_j (r_i - r_j)``, ``w'_1 = 1 / w_1`` and ``w'_i = -w_i / (W_{i-1} W_i)``, where ``W_i``
        # is the sum of the first i weights (Eq. 12, the linear weight being that of threshold 0). It is valid for a
        # memory without previous motion; for a primed one use `Memory.inverse`.
        if not self.invertible:
            raise ModelError("PI: no inverse without a threshold 0 of positive weight; add a linear term")
        r, w = self.thresholds, self.weights
        total = np.cumsum(w)
        thresholds = r * total - np.cumsum(w * r)
        weights = np.concatenate([[1.0 / w[0]], -w[1:] / (total[:-1] * total[1:])])
        moving = np.concatenate([[True], w[1:] != 0])
        return PrandtlIshlinskii(thresholds[moving], weights[moving])

    def _curve(self, plays: float) -> Curve:
        """Return the curve in which operator i starts to move at `plays` times its threshold."""
        knots = plays * self.thresholds
        slopes = np.cumsum(self.weights)
        if knots[0] > 0:
            knots, slopes = np.concatenate([[0.0], knots]), np.concatenate([[0.0], slopes])
        knots = np.append(knots, knots[-1] + END)
        values = np.concatenate([[0.0], np.cumsum(slopes * np.diff(knots))])
        return Curve.of(np.array([knots, values]))


def play(threshold: float) -> PrandtlIshlinskii:
    """Return the play operator of `threshold` (V): ``p = max(v - r, min(v + r, p))``, Eq. 1; it is not invertible."""
    return PrandtlIshlinskii(np.array([threshold]), np.array([1.0]))
