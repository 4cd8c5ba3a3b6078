"""Harmonics of the passes of one path: closed, or led back to its beginning."""

import numpy as np

from slpi_ros.arrays import FloatArray
from slpi_ros.learning.harmonics import ComplexArray

# A path closes if its ends differ by less than this many of its largest steps; otherwise it is led back to its
# beginning over this share of it, and the correction begins and ends at 0, over this share.
CLOSING_STEPS, LED_BACK, LEAST_LED_BACK, TAPER = 1.5, 0.25, 16, 0.005


class PathSpectrum:
    """Spectra of signals along one desired path (m, (N,)), sampled at `dt` (s).

    Attributes
    ----------
    closed : bool
        Whether the path ends where it begins, so that its passes may follow one another.
    size : int
        Samples of a period: N, and more if the path is led back to its beginning.
    frequency : ndarray, shape (K,), hertz
        Of the K = size // 2 + 1 harmonics.
    taper : ndarray, shape (N,)
        Factor of corrections: 1, and down to 0 at the ends of a path that does not close.
    """

    def __init__(self, desired: FloatArray, dt: float) -> None:
        steps = np.abs(np.diff(desired))
        self.count = desired.size
        self.closed = bool(abs(desired[0] - desired[-1]) <= CLOSING_STEPS * float(steps.max(initial=0.0)))
        self.size = self.count + (0 if self.closed else max(LEAST_LED_BACK, int(LED_BACK * self.count)))
        self.frequency: FloatArray = np.asarray(np.fft.rfftfreq(self.size, dt), dtype=np.float64)
        self.taper = np.ones(self.count)
        if not self.closed:
            edge = max(2, int(TAPER * self.count))
            rise = 0.5 - 0.5 * np.cos(np.pi * np.arange(edge) / edge)
            self.taper[:edge], self.taper[-edge:] = rise, rise[::-1]

    def whole(self, x: FloatArray) -> FloatArray:
        """Return a period, (size,), of a signal, (N,)."""
        count = self.size - x.size
        if not count:
            return x
        share = 0.5 - 0.5 * np.cos(np.pi * (np.arange(count) + 1.0) / (count + 1.0))
        return np.concatenate([x, x[-1] + (x[0] - x[-1]) * share])

    def of(self, x: FloatArray) -> ComplexArray:
        """Return the harmonics, (K,), of a signal, (N,), in its unit."""
        return np.asarray(np.fft.rfft(self.whole(x)))

    def signal(self, spectrum: ComplexArray) -> FloatArray:
        """Return the signal, (N,), of harmonics, (K,)."""
        return np.asarray(np.fft.irfft(spectrum, self.size)[: self.count])

    def power(self, squares: FloatArray) -> float:
        """Return the mean square (m^2) of a signal with these squares of harmonics (m^2, (K,)), without the mean."""
        twice = np.full(squares.size, 2.0)
        if self.size % 2 == 0:
            twice[-1] = 1.0
        return float((twice * squares)[1:].sum()) / self.size**2
