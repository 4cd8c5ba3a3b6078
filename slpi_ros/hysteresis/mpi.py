"""The multi-slope Prandtl-Ishlinskii (MPI) model: generalized play operators that fall less steeply from high up.

MPI paper, Eq. 2 with the signs that the text lost, ``u`` being the voltage above the lowest one of the range::

    f_k(t) = max{ u - r_k, min{ min[1.2 u, 0.8 u + 0.2 V_p + 0.6 r_k], f_k(t - T) } }

Such an operator follows one envelope upwards, another one downwards, and waits in between. It obeys Madelung's laws:
from the turning point ``beta`` up to ``alpha`` it moves by ``E_k(alpha, beta) = max(0, rising_k(alpha) -
falling_k(beta))``, and by as much on the way from ``alpha`` down to ``beta``.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slpi_ros.errors import ModelError
from slpi_ros.hysteresis.shape import END, Curve

FloatArray = NDArray[np.float64]

# Slopes and constants of the falling envelope, Eq. 2.
STEEP, GENTLE, AMPLITUDE_SHARE, THRESHOLD_SHARE = 1.2, 0.8, 0.2, 0.6
# The amplitude that the paper gives more operators, volts; a measured one is never exact.
FULL_AMPLITUDE, NEAR_FULL = 120.0, 0.5


def thresholds_for(amplitude: float) -> FloatArray:
    """Return the paper's thresholds for the amplitude `amplitude` (V): 13 at 120 V, else 11, from 0 to it, volts."""
    full = abs(amplitude - FULL_AMPLITUDE) < NEAR_FULL
    return np.linspace(0.0, amplitude, 13 if full else 11)


def rising_envelope(u: ArrayLike, thresholds: ArrayLike) -> FloatArray:
    """Return ``u - r``, what an operator follows upwards, volts; arguments in volts, broadcast."""
    return np.subtract(u, thresholds, dtype=np.float64)


def falling_envelope(u: ArrayLike, thresholds: ArrayLike, amplitude: float) -> FloatArray:
    """Return what an operator follows downwards, volts: the inner minimum of Eq. 2, nowhere below the rising envelope.

    Its slope is 1 below ``u = -5 r``, 1.2 up to ``0.5 V_p + 1.5 r``, 0.8 up to ``V_p + 8 r``, and 1 beyond.

    Parameters
    ----------
    u, thresholds : array_like, volts
        Broadcast.
    amplitude : float, volts
    """
    u, r = np.asarray(u, dtype=np.float64), np.asarray(thresholds, dtype=np.float64)
    gentle = GENTLE * u + AMPLITUDE_SHARE * amplitude + THRESHOLD_SHARE * r
    return np.maximum(rising_envelope(u, r), np.minimum(STEEP * u, gentle))


@dataclass(frozen=True)
class MultiSlope:
    """A weighted sum of the operators of Eq. 2, ``y = sum_k w_k f_k``.

    The operators start at the low end, as after a fall from far above: a memory that was never moved describes
    voltages at or above its rest; a primed one describes all voltages.

    There is no linear term: the branch from a turning point begins level until the first operator moves, except at the
    range's two ends. There the inverse jumps: every displacement is some voltage's, but no small step from there is.

    Parameters
    ----------
    origin : float, volts
        Lowest voltage of the range, where ``u = 0``.
    amplitude : float, volts
        ``V_p``, highest voltage of the range above `origin`.
    thresholds : ndarray, shape (n,), volts
        ``0 <= r_1 < r_2 < ...``
    weights : ndarray, shape (n,), metres per volt
        Not negative, not all zero.

    Raises
    ------
    ModelError
        If the parameters contradict each other.
    """

    origin: float
    amplitude: float
    thresholds: FloatArray
    weights: FloatArray
    symmetric_rest: bool = field(default=False, init=False)
    _r: FloatArray = field(init=False, repr=False)
    _w: FloatArray = field(init=False, repr=False)
    _bends: FloatArray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Check the operators, and keep those that have a weight and where they bend."""
        for name in ("thresholds", "weights"):
            object.__setattr__(self, name, np.asarray(getattr(self, name), dtype=np.float64))
        r, w = self.thresholds, self.weights
        if r.ndim != 1 or r.shape != w.shape or r.size == 0:
            raise ModelError(f"MPI: {r.shape} thresholds and {w.shape} weights; give as many of each, at least one")
        if not (np.isfinite(r).all() and r[0] >= 0 and (np.diff(r) > 0).all()):
            raise ModelError("MPI: thresholds must be finite, not negative and rise strictly")
        if not (np.isfinite(w).all() and (w >= 0).all() and w.any()):
            raise ModelError("MPI: weights must be finite and not negative, one at least positive, else branches fall")
        if not (np.isfinite(self.origin) and np.isfinite(self.amplitude) and self.amplitude > 0):
            raise ModelError(
                f"MPI: origin {self.origin} V, amplitude {self.amplitude} V; give finite ones, the amplitude positive"
            )
        moving = w > 0
        r, w, half = r[moving], w[moving], 0.5 * self.amplitude
        object.__setattr__(self, "_r", r)
        object.__setattr__(self, "_w", w)
        object.__setattr__(self, "_bends", np.concatenate([-5.0 * r, half + 1.5 * r, self.amplitude + 8.0 * r]))

    def stroke(self, upper: float, lower: float) -> float:
        """Return ``E(alpha, beta)``, the displacement (m) between two turning points (V)."""
        rising = rising_envelope(upper - self.origin, self._r)
        falling = falling_envelope(lower - self.origin, self._r, self.amplitude)
        return float(self._w @ np.maximum(0.0, rising - falling))

    def branch(self, direction: int, v_turn: float) -> Curve:
        """Return the branch that starts in `direction` at the turning point `v_turn` (V)."""
        u_turn = v_turn - self.origin
        return self._rise_from(u_turn) if direction > 0 else self._fall_from(u_turn)

    def first_rise(self, v_rest: float) -> Curve:
        """Return the first rise from rest at `v_rest` (V): the operators lie on their falling envelopes."""
        return self._rise_from(v_rest - self.origin)

    def _rise_from(self, turn: float) -> Curve:
        """Each operator waits until its rising envelope reaches it."""
        starts = np.maximum(turn, falling_envelope(turn, self._r, self.amplitude) + self._r)
        u = np.unique(np.append(starts, turn))
        return self._curve(u - turn, self._w @ np.maximum(0.0, u - starts[:, None]))

    def _fall_from(self, turn: float) -> Curve:
        """Each operator waits until its falling envelope reaches it, and bends with the envelope."""
        r, top = self._r, rising_envelope(turn, self._r)
        gentle = (top - AMPLITUDE_SHARE * self.amplitude - THRESHOLD_SHARE * r) / GENTLE
        starts = np.minimum(turn, np.maximum(top / STEEP, gentle))
        u = np.unique(np.concatenate([[turn], starts, self._bends[self._bends < turn]]))[::-1]
        left = falling_envelope(starts, r, self.amplitude)[:, None]
        fallen = np.maximum(0.0, left - falling_envelope(u, r[:, None], self.amplitude))
        return self._curve(turn - u, self._w @ fallen)

    def _curve(self, u: FloatArray, f: FloatArray) -> Curve:
        """Return the curve through the knots; beyond them every operator moves with slope 1."""
        # Rounding must not make a branch fall.
        f = np.maximum.accumulate(f)
        return Curve.of(np.array([np.append(u, u[-1] + END), np.append(f, f[-1] + END * self._w.sum())]))
