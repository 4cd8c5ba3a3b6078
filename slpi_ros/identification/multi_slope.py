"""What identification needs for the MPI and SMPI models: their linear basis, peaks of cycles, ``X_p = a f^b``."""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import least_squares

from slpi_ros.errors import IdentificationError
from slpi_ros.hysteresis.mpi import MultiSlope, falling_envelope, rising_envelope, thresholds_for
from slpi_ros.hysteresis.multi_slope import BACK, cycles
from slpi_ros.identification.bases import OperatorWeights
from slpi_ros.identification.design_matrix import Walk

FloatArray = NDArray[np.float64]

# Cycles count as of one amplitude when theirs differ by less than this share of the largest.
SAME_AMPLITUDE = 0.02


@dataclass(frozen=True)
class MultiSlopeBasis(OperatorWeights):
    """The MPI model: one weight for each operator; parameters as those of `slpi_ros.hysteresis.mpi.MultiSlope`."""

    origin: float
    amplitude: float
    thresholds: FloatArray
    symmetric_rest: bool = False

    @classmethod
    def over(cls, low: float, high: float) -> "MultiSlopeBasis":
        """Return the basis with the paper's thresholds for the voltages from `low` to `high` (V)."""
        return cls(low, high - low, thresholds_for(high - low))

    def branch_part(self, walk: Walk) -> sp.csr_array:
        """Return how far each operator has moved along the branch."""
        upper, lower = np.maximum(walk.v, walk.v_origin), np.minimum(walk.v, walk.v_origin)
        waits = rising_envelope(upper[:, None] - self.origin, self.thresholds) - self._falling(lower)
        moved = np.maximum(0.0, waits) * walk.direction[:, None]
        if walk.long_fall.any():
            fallen, rest = walk.v[walk.long_fall], walk.v_rest[walk.long_fall]
            moved[walk.long_fall] = self._falling(fallen) - self._falling(rest)
        return sp.csr_array(moved)

    def _falling(self, v: FloatArray) -> FloatArray:
        """Return the falling envelopes, shape (N, size)."""
        return falling_envelope(v[:, None] - self.origin, self.thresholds, self.amplitude)

    def shape(self, x: FloatArray, gain: float) -> MultiSlope:
        """Return the MPI model."""
        return MultiSlope(self.origin, self.amplitude, self.thresholds, np.maximum(x[:-1], 0.0))


def cycle_peaks(v: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the amplitude and the peak displacement of each cycle of a record, in its order.

    A cycle starts within 1 % of the voltage range of the lowest voltage, and goes beyond that. It is left out if its
    displacement is not known there, or within 1 % of its highest voltage.

    Parameters
    ----------
    v : ndarray, shape (N,), volts
    y : ndarray, shape (N,), metres
        Not finite where it is not known.

    Returns
    -------
    amplitudes : ndarray, shape (c,), volts
        Largest voltage of each cycle, above the lowest one of the record.
    peaks : ndarray, shape (c,), metres
        Largest displacement of each cycle, above that at its start.
    """
    if not v.size:
        return np.empty(0), np.empty(0)
    origin, near = v.min(), BACK * np.ptp(v)
    found = []
    for first, last in cycles(v, origin + near):
        top, known = v[first : last + 1].max(), first + np.flatnonzero(np.isfinite(y[first : last + 1]))
        v_known, y_known = v[known], y[known]
        if known.size and v_known[0] <= origin + near < top and v_known.max() >= top - near:
            found.append((v_known.max() - origin, y_known.max() - y_known[0]))
    amplitudes, peaks = np.array(found, dtype=np.float64).reshape(-1, 2).T
    return amplitudes, peaks


def peak_line(v: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the knots of ``X_p`` over amplitude for the SMPI model: cycles of nearly equal amplitude are averaged.

    Parameters
    ----------
    v : ndarray, shape (N,), volts
    y : ndarray, shape (N,), metres

    Returns
    -------
    voltages : ndarray, shape (m,), volts
    displacements : ndarray, shape (m,), metres

    Raises
    ------
    IdentificationError
        If the record holds no cycle, or the peaks do not rise with the amplitude.
    """
    amplitudes, peaks = cycle_peaks(v, y)
    if not amplitudes.size:
        raise IdentificationError("no cycle starts at the lowest voltage; drive from there up and back, per amplitude")
    order = np.argsort(amplitudes)
    amplitudes, peaks = amplitudes[order], peaks[order]
    group = np.zeros(amplitudes.size, dtype=np.int64)
    first = 0
    for i in range(1, amplitudes.size):
        apart = amplitudes[i] - amplitudes[first] > SAME_AMPLITUDE * amplitudes[-1]
        group[i] = group[i - 1] + apart
        first = i if apart else first
    count = np.bincount(group)
    voltages, displacements = (np.bincount(group, x) / count for x in (amplitudes, peaks))
    down = np.flatnonzero(np.diff(displacements, prepend=0.0) <= 0.0)
    if down.size:
        raise IdentificationError(
            f"the peak displacement {displacements[down[0]]:.4g} m at the amplitude {voltages[down[0]]:.4g} V is not "
            "above that of smaller amplitudes; check the record for drift and outliers"
        )
    return voltages, displacements


@dataclass(frozen=True)
class PeakFrequency:
    """Peak displacement over drive frequency, ``X_p = a f^b`` (MPI paper, Eq. 1).

    Parameters
    ----------
    a : float, metres
        Peak displacement at 1 Hz.
    b : float
        Negative when the peak sinks with the frequency.
    """

    a: float
    b: float

    def __call__(self, frequency: ArrayLike) -> FloatArray:
        """Return the peak displacement (m) at `frequency` (Hz), of its shape."""
        return self.a * np.asarray(frequency, dtype=np.float64) ** self.b


def fit_peak_frequency(frequency: ArrayLike, peak: ArrayLike) -> PeakFrequency:
    """Fit ``X_p = a f^b`` with the least sum of squared errors of the peaks.

    Parameters
    ----------
    frequency : array_like, shape (n,), Hz
    peak : array_like, shape (n,), metres

    Raises
    ------
    IdentificationError
        If there are not two frequencies, or a value is not positive and finite.
    """
    f, x = np.asarray(frequency, dtype=np.float64), np.asarray(peak, dtype=np.float64)
    if f.ndim != 1 or f.shape != x.shape or np.unique(f).size < 2:
        raise IdentificationError(
            f"X_p = a f^b: frequencies {f.shape}, peaks {x.shape}; give a peak of each of two frequencies or more"
        )
    for name, unit, values in (("frequency", "Hz", f), ("peak", "m", x)):
        bad = ~(np.isfinite(values) & (values > 0))
        if bad.any():
            raise IdentificationError(f"X_p = a f^b: {name} {values[bad][0]:g} {unit} is not positive; leave it out")
    # In logarithms the fit is linear, but weighs errors of small peaks more: a start only. In units of the mean peak.
    mean = x.mean()
    slope, level = np.polyfit(np.log(f), np.log(x / mean), 1)
    best = least_squares(
        lambda p: np.exp(p[0] + p[1] * np.log(f)) - x / mean, (level, slope), ftol=1e-15, xtol=1e-15, gtol=1e-15
    )
    return PeakFrequency(float(mean * np.exp(best.x[0])), float(best.x[1]))
