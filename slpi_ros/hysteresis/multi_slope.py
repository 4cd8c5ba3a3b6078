"""The multi-slope (MPI) model, and the simplified (SMPI) model, which is scaled to the amplitude of each cycle.

`MultiSlope` is a sum of the generalized play operators of the MPI paper, Eq. 2, with one set of weights for one
amplitude ``V_p``; its branches are shapes on the engine.

`AmplitudeScaled` scales it (MPI paper, section 3): ``y = (X_p / X_p120) sum_k w_k f_k``, with ``X_p`` the peak
displacement of a cycle. For the peak to equal ``X_p``, the base model must be driven to its own amplitude::

    y(u) = X_p(V_p) / X_p(V_base) * Y_base(u V_base / V_p)

Eq. 2 is homogeneous of degree one in ``u``, ``r_k`` and ``V_p`` together: that is ``X_p(V_p) / X_p(V_base) * V_base /
V_p`` times the MPI model of amplitude ``V_p`` with the thresholds ``r_k V_p / V_base``, the paper's threshold rule.
"""

from dataclasses import dataclass, field
from itertools import pairwise
from math import inf
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike

from slpi_ros.arrays import FloatArray
from slpi_ros.errors import ModelError, UsageError
from slpi_ros.hysteresis.reversals import require_finite
from slpi_ros.hysteresis.shapes import END, FAR, Branches, Curve
from slpi_ros.hysteresis.turning_points import Memory

# Slopes and constants of the falling envelope, Eq. 2.
STEEP, GENTLE, AMPLITUDE_SHARE, THRESHOLD_SHARE = 1.2, 0.8, 0.2, 0.6
# Amplitude for which the paper uses 13 operators, volts, and the tolerance for a measured amplitude.
FULL_AMPLITUDE, NEAR_FULL = 120.0, 0.5
# A path is at the low end below this share of the base amplitude (for displacement: of its peak displacement).
BACK = 0.01

Volts = TypeVar("Volts", float, FloatArray)


def thresholds_for(amplitude: float) -> FloatArray:
    """Return the thresholds (V) of the paper for an amplitude (V), from 0 to `amplitude`: 13 at 120 V, else 11."""
    full = abs(amplitude - FULL_AMPLITUDE) < NEAR_FULL
    return np.linspace(0.0, amplitude, 13 if full else 11)


def rising_envelope(u: ArrayLike, thresholds: ArrayLike) -> FloatArray:
    """Return the rising envelope ``u - r`` of an operator, volts; arguments in volts, broadcast."""
    return np.subtract(u, thresholds, dtype=np.float64)


def falling_envelope(u: ArrayLike, thresholds: ArrayLike, amplitude: float) -> FloatArray:
    """Return the falling envelope (V), the inner minimum of Eq. 2, limited from below by the rising envelope."""
    # Its slope is 1 below ``u = -5 r``, 1.2 up to ``0.5 V_p + 1.5 r``, 0.8 up to ``V_p + 8 r``, and 1 beyond. `u` (V,
    # above `MultiSlope.origin`) and `thresholds` (V) are broadcast against each other.
    u, r = np.asarray(u, dtype=np.float64), np.asarray(thresholds, dtype=np.float64)
    gentle = GENTLE * u + AMPLITUDE_SHARE * amplitude + THRESHOLD_SHARE * r
    return np.maximum(rising_envelope(u, r), np.minimum(STEEP * u, gentle))


@dataclass(frozen=True)
class MultiSlope:
    """A weighted sum of the operators of Eq. 2, ``y = sum_k w_k f_k``."""

    # The operators start at the low end, as after a fall from far above. A memory without previous motion is valid for
    # voltages at or above its rest voltage, a primed one for all voltages.
    #
    # There is no linear term: a branch is flat from its reversal until the first operator moves, except at the ends of
    # the range. The inverse exists for every displacement, but its voltage jumps across the flat part.
    origin: float  # V, lowest of the range, where ``u = 0``
    amplitude: float  # V, highest of the range, relative to the origin, ``V_p``
    thresholds: FloatArray  # V, (n,), ``0 <= r_1 < r_2 < ...``
    weights: FloatArray  # m/V, (n,), non-negative, at least one positive
    symmetric_rest: bool = field(default=False, init=False)
    branches: Branches = field(init=False, repr=False)
    _r: FloatArray = field(init=False, repr=False)
    _w: FloatArray = field(init=False, repr=False)
    _bends: FloatArray = field(init=False, repr=False)

    def __post_init__(self) -> None:
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
        object.__setattr__(self, "_bends", np.array([-5.0 * r, half + 1.5 * r, self.amplitude + 8.0 * r]))
        scale = float(self.origin), float(self.amplitude)
        object.__setattr__(self, "branches", Branches(operators=np.array([r, w]), scale=scale))

    def stroke(self, upper: float, lower: float) -> float:
        """Return the Everett function ``E(upper, lower)``, the displacement (m) between two reversals (V)."""
        rising = rising_envelope(upper - self.origin, self._r)
        falling = falling_envelope(lower - self.origin, self._r, self.amplitude)
        return float(self._w @ np.maximum(0.0, rising - falling))

    def branch(self, direction: int, v_turn: float) -> Curve:
        """Return the branch that starts in `direction` at the reversal `v_turn` (V)."""
        u_turn = v_turn - self.origin
        return self._rise_from(u_turn) if direction > 0 else self._fall_from(u_turn)

    def first_rise(self, v_rest: float) -> Curve:
        """Return the first rise from `v_rest` (V), with all operators on their falling envelopes."""
        return self._rise_from(v_rest - self.origin)

    def _rise_from(self, turn: float) -> Curve:
        """Return a rising branch: each operator is constant until its rising envelope reaches it."""
        starts = np.maximum(turn, falling_envelope(turn, self._r, self.amplitude) + self._r)
        return _curve(starts - turn, self._w)

    def _fall_from(self, turn: float) -> Curve:
        """Return a falling branch: each operator is constant until it meets its falling envelope, then follows it."""
        r, w, (low, middle, high) = self._r, self._w, self._bends
        top = rising_envelope(turn, r)
        gentle = (top - AMPLITUDE_SHARE * self.amplitude - THRESHOLD_SHARE * r) / GENTLE
        starts = np.minimum(turn, np.maximum(top / STEEP, gentle))
        slopes = np.where(starts > middle, GENTLE, STEEP)
        slopes[(starts <= low) | (starts > high)] = 1.0
        later = self._bends < starts
        changes = np.array([[1.0 - STEEP], [STEEP - GENTLE], [GENTLE - 1.0]]) * w
        return _curve(turn - np.append(starts, self._bends[later]), np.append(slopes * w, changes[later]))


def _curve(u: FloatArray, changes: FloatArray) -> Curve:
    """Return the curve whose slope changes at the distances `u`, shape (n,), volts, by `changes`, shape (n,), m/V."""
    # `slpi_ros.hysteresis.compiled.composed` computes the same, with the same rounding.
    order = np.argsort(u, kind="stable")
    u, slopes = np.append(0.0, u[order]), np.append(0.0, np.cumsum(changes[order]))
    u = np.append(u, u[-1] + END)
    return Curve.of(np.array([u, np.append(0.0, np.cumsum(slopes * np.diff(u)))]))


def cycles(x: FloatArray, back: float) -> list[tuple[int, int]]:
    """Divide a path (N,) into cycles (first and last sample), at the lowest sample of each section below `back`."""
    # The last sample of a cycle is the first of the next. The parts before the first and after the last count, too.
    low = np.concatenate([[False], x <= back, [False]])
    stretches = np.flatnonzero(low[1:] != low[:-1]).reshape(-1, 2)
    lowest = [start + int(np.argmin(x[start:stop])) for start, stop in stretches.tolist()]
    return list(pairwise(sorted({0, *lowest, x.size - 1})))


@dataclass(frozen=True)
class AmplitudeScaled:
    """An MPI model scaled by the peak displacement ``X_p`` as a piecewise linear function of the amplitude."""

    base: MultiSlope  # of the amplitude ``base.amplitude``
    peak_voltages: FloatArray  # V, (m,), relative to ``base.origin``, positive, strictly increasing
    peak_displacements: FloatArray  # m, (m,), ``X_p``, positive, strictly increasing

    def __post_init__(self) -> None:
        for name in ("peak_voltages", "peak_displacements"):
            object.__setattr__(self, name, np.asarray(getattr(self, name), dtype=np.float64))
        v, x = self.peak_voltages, self.peak_displacements
        if v.ndim != 1 or v.shape != x.shape or v.size == 0:
            raise ModelError(f"SMPI: peaks {x.shape} at voltages {v.shape}; give as many of each, at least one")
        for name, knots in (("voltages", v), ("displacements", x)):
            if not (np.isfinite(knots).all() and (np.diff(knots, prepend=0.0) > 0).all()):
                raise ModelError(f"SMPI: the peaks' {name} must be finite, positive and rise strictly")
        if not self.base.stroke(self.base.origin + self.base.amplitude, self.base.origin) > 0.0:
            raise ModelError("SMPI: no operator of the base model moves within its amplitude; lower the thresholds")

    def peak(self, amplitude: float) -> float:
        """Return ``X_p`` (m) at an amplitude (V): piecewise linear from (0, 0), extrapolated beyond the last knot."""
        v, x = np.append(0.0, self.peak_voltages), np.append(0.0, self.peak_displacements)
        beyond = max(0.0, amplitude - float(v[-1]))
        return float(np.interp(amplitude, v, x) + beyond * (x[-1] - x[-2]) / (v[-1] - v[-2]))

    def along(self, start_voltage: float, start_displacement: float) -> "KnownPath":
        """Return the model for known paths that start from rest at a voltage (V) and displacement (m)."""
        return KnownPath(self, start_voltage, start_displacement)


@dataclass(frozen=True)
class KnownPath:
    """The SMPI model for paths known in advance: the amplitude of a cycle is known only at its peak."""

    # A cycle starts at the low end, at the end point of the previous cycle. Every call starts from the initial point. A
    # voltage path is divided into cycles where it returns to the origin, a displacement path where it returns to the
    # displacement at the origin, with the same relative tolerance; both divisions agree except close to the tolerance.
    model: AmplitudeScaled
    start_voltage: float
    start_displacement: float

    def forward_array(self, v: FloatArray) -> FloatArray:
        """Return the displacements, shape (N,), metres, for the voltages `v`, shape (N,), volts."""
        v = np.asarray(v, dtype=np.float64)
        require_finite(v)
        if v.size and np.max(np.abs(v)) > FAR:
            raise UsageError(f"voltage {v[np.argmax(np.abs(v))]} V is out of range; leave such samples out")
        origin, y = self.model.base.origin, np.empty_like(v)
        present = (self.start_voltage, self.start_displacement)
        for start, stop in cycles(np.append(self.start_voltage, v), origin + self._least_amplitude):
            amplitude = max(present[0], float(v[start:stop].max())) - origin
            cycle = _Cycle(self.model, max(amplitude, self._least_amplitude), *present)
            y[start:stop] = cycle.forward(v[start:stop])
            present = float(v[stop - 1]), float(y[stop - 1])
        return y

    def inverse_array(self, y: FloatArray, lower: float = -inf, upper: float = inf) -> FloatArray:
        """Return the voltages, shape (N,), volts, within `lower` and `upper` (V), for the displacements `y`, metres."""
        y = np.asarray(y, dtype=np.float64)
        require_finite(y)
        model, v = self.model, np.empty_like(y)
        present = (self.start_voltage, self.start_displacement)
        back = self._displacement_of_origin(y) + model.peak(self._least_amplitude)
        for start, stop in cycles(np.append(self.start_displacement, y), back):
            amplitude = self._amplitude_for(float(y[start:stop].max()), *present)
            amplitude = max(min(amplitude, upper - model.base.origin), self._least_amplitude)
            cycle = _Cycle(model, amplitude, *present)
            v[start:stop], reached = cycle.inverse(y[start:stop], lower, upper)
            present = float(v[stop - 1]), reached
        return v

    @property
    def _least_amplitude(self) -> float:
        """Smallest amplitude of a cycle (V); smaller ones are merged with a neighbouring cycle."""
        return BACK * self.model.base.amplitude

    def _displacement_of_origin(self, y: FloatArray) -> float:
        """Return the displacement (m) at the origin after the peak of `y`; the start value if the path starts there."""
        present = (self.start_voltage, self.start_displacement)
        cycle = _Cycle(self.model, self._amplitude_for(float(y.max(initial=present[1])), *present), *present)
        return present[1] + cycle.stroke(present[0]) - cycle.stroke(self.model.base.origin)

    def _amplitude_for(self, peak: float, v_start: float, y_start: float) -> float:
        """Return the amplitude (V) of the cycle from a start (V, m) with the peak displacement `peak` (m)."""
        # Imported here because only this kind needs it, and the import is slow.
        from scipy.optimize import brentq

        def missing(amplitude: float) -> float:
            return peak - y_start - _Cycle(self.model, amplitude, v_start, y_start).stroke(v_start)

        least = max(v_start - self.model.base.origin, self._least_amplitude)
        if missing(least) <= 0.0:
            return least
        most = 2.0 * least
        while missing(most) > 0.0:
            most *= 2.0
            if most > FAR:
                raise UsageError(f"displacement {peak} m cannot be reached by this model; leave such samples out")
        return float(brentq(missing, least, most, xtol=1e-14 * self.model.base.amplitude, rtol=1e-15))


class _Cycle:
    """One cycle of known amplitude: the base model with both coordinates scaled, starting at rest."""

    def __init__(self, model: AmplitudeScaled, amplitude: float, v_start: float, y_start: float) -> None:
        self._base = model.base
        self._stretch = model.base.amplitude / amplitude
        self._scale = model.peak(amplitude) / model.peak(model.base.amplitude)
        # Displacement is relative to the start, so that it is exactly constant while no operator moves.
        self._v_rest, self._y_start = self._of_base(v_start), y_start

    def stroke(self, v: float) -> float:
        """Return the displacement (m) between the voltage `v` (V) and the peak."""
        return self._scale * self._base.stroke(self._base.origin + self._base.amplitude, self._of_base(v))

    def forward(self, v: FloatArray) -> FloatArray:
        """Return the displacements (m) for the voltages `v` (V) of the cycle."""
        return self._y_start + self._scale * Memory(self._base, self._v_rest).forward_array(self._of_base(v))

    def inverse(self, y: FloatArray, lower: float, upper: float) -> tuple[FloatArray, float]:
        """Return the voltages (V) for the displacements `y` (m), and the displacement (m) reached by the last one."""
        memory = Memory(self._base, self._v_rest)
        limits = self._of_base(lower), self._of_base(upper)
        of_base = memory.inverse_array((y - self._y_start) / self._scale, *limits)
        v = self._base.origin + (of_base - self._base.origin) / self._stretch
        return np.clip(v, lower, upper), self._y_start + self._scale * memory.displacement

    def _of_base(self, v: Volts) -> Volts:
        """Scale voltages of the cycle to voltages of the base model."""
        return self._base.origin + (v - self._base.origin) * self._stretch
