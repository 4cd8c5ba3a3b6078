"""The simplified multi-slope (SMPI) model: the MPI model of one amplitude, scaled to that of each cycle.

MPI paper, 3: ``y = (X_p / X_p120) sum_k w_k f_k``, ``X_p`` being the peak displacement of a cycle. For the peak to come
out as ``X_p``, the base model must be driven to its own amplitude::

    y(u) = X_p(V_p) / X_p(V_base) * Y_base(u V_base / V_p)

Eq. 2 is homogeneous of degree one in ``u``, ``r_k`` and ``V_p`` together: that is ``X_p(V_p) / X_p(V_base) * V_base /
V_p`` times the MPI model of amplitude ``V_p`` with the thresholds ``r_k V_p / V_base``, the paper's threshold rule.
"""

from dataclasses import dataclass
from itertools import pairwise
from math import inf
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from slpi_ros.errors import ModelError, UsageError
from slpi_ros.hysteresis.memory import Memory
from slpi_ros.hysteresis.mpi import MultiSlope
from slpi_ros.hysteresis.runs import require_finite
from slpi_ros.hysteresis.shape import FAR

FloatArray = NDArray[np.float64]
Volts = TypeVar("Volts", float, FloatArray)

# Below this share of the base amplitude (in displacement: of the peak line there) a path is back at the low end.
BACK = 0.01


def cycles(x: FloatArray, back: float) -> list[tuple[int, int]]:
    """Cut a path, shape (N,), N >= 1, into cycles: the first lowest sample of each stretch up to `back` ends one.

    Each is given by its first and its last sample, which is the first of the next one. What comes before the first
    return and after the last one counts as a cycle.
    """
    low = np.concatenate([[False], x <= back, [False]])
    stretches = np.flatnonzero(low[1:] != low[:-1]).reshape(-1, 2)
    lowest = [start + int(np.argmin(x[start:stop])) for start, stop in stretches.tolist()]
    return list(pairwise(sorted({0, *lowest, x.size - 1})))


@dataclass(frozen=True)
class AmplitudeScaled:
    """An MPI model and the line of peak displacements ``X_p`` over amplitude.

    Parameters
    ----------
    base : MultiSlope
        The model of one amplitude, which is ``base.amplitude``.
    peak_voltages : ndarray, shape (m,), volts
        Amplitudes above ``base.origin``, positive, strictly increasing, m >= 1.
    peak_displacements : ndarray, shape (m,), metres
        ``X_p`` at them, positive, strictly increasing.

    Raises
    ------
    ModelError
        If the knots of ``X_p`` do not fit each other or do not rise.
    """

    base: MultiSlope
    peak_voltages: FloatArray
    peak_displacements: FloatArray

    def __post_init__(self) -> None:
        """Check the line of peaks."""
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
        """Return ``X_p`` (m) at an amplitude (V): linear from (0, 0) through the knots, and on beyond the last one."""
        v, x = np.append(0.0, self.peak_voltages), np.append(0.0, self.peak_displacements)
        beyond = max(0.0, amplitude - float(v[-1]))
        return float(np.interp(amplitude, v, x) + beyond * (x[-1] - x[-2]) / (v[-1] - v[-2]))

    def along(self, start_voltage: float, start_displacement: float) -> "KnownPath":
        """Return the model on a known path that starts from rest at a voltage (V) and displacement (m)."""
        return KnownPath(self, start_voltage, start_displacement)


@dataclass(frozen=True)
class KnownPath:
    """The SMPI model on paths known as a whole: a cycle's amplitude shows at its peak, but scales it from its start.

    A cycle starts at the low end, at the point where the one before it ended. Every call begins at the start.
    A path by displacement is cut where it comes back to the displacement of the origin, as near as a path by voltage
    must come back to the origin: both are cut alike if they do come back, or stay clearly away.

    Parameters
    ----------
    model : AmplitudeScaled
    start_voltage : float, volts
    start_displacement : float, metres
    """

    model: AmplitudeScaled
    start_voltage: float
    start_displacement: float

    def forward_array(self, v: FloatArray) -> FloatArray:
        """Return the displacements, shape (N,), metres, for the voltages `v`, shape (N,), volts.

        Raises
        ------
        UsageError
            If a voltage is not finite, or none of a stage.
        """
        v = np.asarray(v, dtype=np.float64)
        require_finite(v)
        if v.size and np.max(np.abs(v)) > FAR:
            raise UsageError(f"voltage {v[np.argmax(np.abs(v))]} V is none that a stage can be given")
        origin, y = self.model.base.origin, np.empty_like(v)
        present = (self.start_voltage, self.start_displacement)
        for start, stop in cycles(np.append(self.start_voltage, v), origin + self._least_amplitude):
            amplitude = max(present[0], float(v[start:stop].max())) - origin
            cycle = _Cycle(self.model, max(amplitude, self._least_amplitude), *present)
            y[start:stop] = cycle.forward(v[start:stop])
            present = float(v[stop - 1]), float(y[stop - 1])
        return y

    def inverse_array(self, y: FloatArray, lower: float = -inf, upper: float = inf) -> FloatArray:
        """Return the voltages, shape (N,), volts, within `lower` and `upper` (V), for the displacements `y`, metres.

        Raises
        ------
        UsageError
            If a displacement is not finite, or none that the model can take.
        """
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
        """What stays below it is no cycle of its own (V)."""
        return BACK * self.model.base.amplitude

    def _displacement_of_origin(self, y: FloatArray) -> float:
        """Return where `y` comes back to the origin from its peak (m): the start, unless that is not the low end."""
        present = (self.start_voltage, self.start_displacement)
        cycle = _Cycle(self.model, self._amplitude_for(float(y.max(initial=present[1])), *present), *present)
        return present[1] + cycle.stroke(present[0]) - cycle.stroke(self.model.base.origin)

    def _amplitude_for(self, peak: float, v_start: float, y_start: float) -> float:
        """Return the amplitude (V) of the cycle from a start (V, m) whose largest displacement is `peak` (m)."""

        def missing(amplitude: float) -> float:
            return peak - y_start - _Cycle(self.model, amplitude, v_start, y_start).stroke(v_start)

        least = max(v_start - self.model.base.origin, self._least_amplitude)
        if missing(least) <= 0.0:
            return least
        most = 2.0 * least
        while missing(most) > 0.0:
            most *= 2.0
            if most > FAR:
                raise UsageError(f"displacement {peak} m is none that this model can take; leave such samples out")
        return float(brentq(missing, least, most, xtol=1e-14 * self.model.base.amplitude, rtol=1e-15))


class _Cycle:
    """One cycle of known amplitude: the base model, its two coordinates scaled, at rest where the cycle starts."""

    def __init__(self, model: AmplitudeScaled, amplitude: float, v_start: float, y_start: float) -> None:
        self._base = model.base
        self._stretch = model.base.amplitude / amplitude
        self._scale = model.peak(amplitude) / model.peak(model.base.amplitude)
        # The memory counts displacement from the start: while no operator moves, it stays there to the last bit.
        self._v_rest, self._y_start = self._of_base(v_start), y_start

    def stroke(self, v: float) -> float:
        """Displacement (m) between the voltage `v` and the peak."""
        return self._scale * self._base.stroke(self._base.origin + self._base.amplitude, self._of_base(v))

    def forward(self, v: FloatArray) -> FloatArray:
        """Return the displacements of the voltages `v` of the cycle."""
        return self._y_start + self._scale * Memory(self._base, self._v_rest).forward_array(self._of_base(v))

    def inverse(self, y: FloatArray, lower: float, upper: float) -> tuple[FloatArray, float]:
        """Return the voltages for the displacements `y` of the cycle, and the displacement reached at its end."""
        memory = Memory(self._base, self._v_rest)
        limits = self._of_base(lower), self._of_base(upper)
        of_base = memory.inverse_array((y - self._y_start) / self._scale, *limits)
        v = self._base.origin + (of_base - self._base.origin) / self._stretch
        return np.clip(v, lower, upper), self._y_start + self._scale * memory.displacement

    def _of_base(self, v: Volts) -> Volts:
        """Return voltages of the cycle as those of the base model."""
        return self._base.origin + (v - self._base.origin) * self._stretch
