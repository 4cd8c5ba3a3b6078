"""Gain and repeating error of each harmonic of a path that repeats, estimated from its passes by a Kalman filter."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from slpi_ros.arrays import FloatArray, Mask

ComplexArray = NDArray[np.complex128]

# A phase counts as known where two standard deviations of the gain are within 45 degrees: sqrt(2 P) <= sin(45) |G|.
PHASE_KNOWN = 0.5
# Largest response to a test step of a harmonic whose phase is not known, as a share of its error, and the number of
# standard deviations that its error must have. With a phase of its own each, they add 2 % to the rms error.
TEST_SHARE, TEST_ABOVE = 0.2, 3.0
# Least gain by which an error is divided: a mode that the inverse takes out may leave next to nothing.
LEAST_GAIN = 0.2
# Standard deviation of what is left of the hysteresis, as a share of the path's harmonics nearby.
REST_SHARE, TURN_SHARE = 0.1, 0.02
# Least variance of a gain; random walk of a gain from pass to pass (variance), and of the repeating error (share of its
# noise).
LEAST_VARIANCE, GAIN_WALK, ERROR_WALK = 1e-8, 1e-4, 0.02
# Share of an unexpected change, as in the neighbouring harmonics, that is taken for a change of the repeating error.
CHANGED_SHARE, NEIGHBOURS = 0.2, 3
# Share of the new estimate of what comes with a change of the path.
SCATTER_SHARE = 0.3
# A share of the noise's new estimate in each pass, of one harmonic and (by this number of harmonics) of the floor.
NOISE_SHARE, FLOOR_COUNT = 0.1, 200.0


@dataclass(frozen=True)
class Harmonics:
    """What is known of the harmonics of a pass of N samples; arrays of shape (K,), K = N // 2 + 1, as `numpy.fft.rfft`.

    The reading of harmonic k for a correction ``C`` of the desired path is ``Y = d + G C + n``. The gain ``G`` is
    constant but for a small random walk, ``d`` (what is read without a correction) walks by what the passes themselves
    show, and ``n`` is noise. Both are estimated together from all passes: a scalar reading and a state of two for each
    harmonic.

    Parameters
    ----------
    gain : ndarray of complex, metres per metre
        Estimate of ``G``.
    without : ndarray of complex, metres
        Estimate of ``d``, sum over the samples as in `numpy.fft.rfft`.
    gain_variance, without_variance, covariance : ndarray, and ndarray of complex
        Their covariance matrix: that of ``G`` and ``conj(d)`` is `covariance`.
    noise : ndarray, metres squared
        Variance of ``n``.
    answered : ndarray of complex, metres
        Correction in the pass that was learned from last.
    scatter : ndarray
        Variance that comes with a change of the path and goes by no gain, as the hysteresis is that of another path: a
        multiple of the mean square of the change's harmonics.
    passes : int
        Number of passes that the estimates come from.

    References
    ----------
    D. A. Bristow, M. Tharayil, A. G. Alleyne, A survey of iterative learning control, IEEE Control Syst. Mag. 26
    (2006).
    N. Amann, D. H. Owens, E. Rogers, Iterative learning control using optimal feedback and feedforward actions, Int. J.
    Control 65 (1996).
    """

    gain: ComplexArray
    without: ComplexArray
    gain_variance: FloatArray
    without_variance: FloatArray
    covariance: ComplexArray
    noise: FloatArray
    answered: ComplexArray
    scatter: FloatArray
    passes: int = 0

    @classmethod
    def first(cls, gain: ComplexArray, variance: FloatArray, noise: FloatArray) -> "Harmonics":
        """Return what is known before the first pass: the first guess of the gains, and the sensor's noise."""
        none = np.zeros_like(gain)
        return cls(gain, none, variance, np.full(variance.size, np.inf), none, noise, none, np.zeros_like(noise))

    def expected(self, correction: ComplexArray) -> ComplexArray:
        """Return the expected reading, (K,), metres, of a pass with a correction (m)."""
        return np.asarray(self.without + self.gain * correction)

    def variance(self, correction: ComplexArray) -> FloatArray:
        """Return the variance of `expected`, (K,), metres squared."""
        size: FloatArray = np.abs(correction) ** 2
        cross = 2.0 * (self.covariance * correction).real
        return np.asarray(np.maximum(self.gain_variance * size + cross + self.without_variance, 0.0))

    @property
    def phase_known(self) -> Mask:
        """Whether the phase of a gain is known to 45 degrees, with two standard deviations."""
        return np.asarray(np.sqrt(self.gain_variance) <= PHASE_KNOWN * np.abs(self.gain))

    def begun(self, desired: ComplexArray, reading: ComplexArray, before: ComplexArray) -> "Harmonics":
        """Return what is known after the first two passes, with no correction: desired, and measured last and before.

        All are of shape (K,), metres. Where the path has more power than what is left of its hysteresis, and than what
        differs between the passes, the gain is known already.
        """
        rest = self._of_hysteresis(desired) + _around(np.abs(reading - before) ** 2)
        total = self.gain_variance * np.abs(desired) ** 2 + rest + self.noise
        k_gain = self.gain_variance * desired.conj() / np.maximum(total, 1e-300)
        gain = self.gain + k_gain * (reading - self.gain * desired)
        left = self.gain_variance - np.abs(k_gain) ** 2 * total
        return replace(
            self, gain=gain, gain_variance=np.maximum(left, LEAST_VARIANCE), without=reading.copy(),
            without_variance=self.noise.copy(), passes=1,
        )  # fmt: skip

    def _of_hysteresis(self, path: ComplexArray) -> FloatArray:
        """Return the variance (m^2, (K,)) of what is left of the hysteresis of a path, (K,), metres, in the reading.

        It is a share of the path's own harmonics nearby, and of lower ones where it falls with the square of the
        frequency, as turns make it. It passes through the mechanics, as the path itself does.
        """
        squared = np.arange(1.0, path.size) ** 2
        turning = np.append(0.0, np.maximum.accumulate(np.abs(path[1:]) * squared) / squared)
        share = REST_SHARE**2 * _around(np.abs(path) ** 2) + TURN_SHARE**2 * turning**2
        return np.asarray(share * (np.abs(self.gain) ** 2 + self.gain_variance))

    def doubted(self, first: "Harmonics") -> "Harmonics":
        """Return the same with gains that may be wrong by as much as those of the first guess."""
        variance = np.maximum(self.gain_variance, first.gain_variance)
        # The correlation with the repeating error is lost with what it came from.
        return replace(self, gain_variance=variance, covariance=np.zeros_like(self.covariance))

    def after(self, correction: ComplexArray, reading: ComplexArray, due: Mask) -> "Harmonics":
        """Return what is known after another pass.

        Parameters
        ----------
        correction, reading : ndarray of complex, (K,), metres
            Correction of the desired path in this pass, and what was measured.
        due : ndarray of bool, (K,)
            Harmonics to learn of; the others stay.
        """
        unexpected = reading - self.expected(correction)
        # The hysteresis of the corrected path is another one.
        moved = self._of_hysteresis(correction - self.answered)
        before = self.variance(correction) + moved + self.noise
        beyond = np.maximum(_around(np.abs(unexpected) ** 2) - before, 0.0)
        scattered, size = self.scatter, float(np.mean(np.abs(correction - self.answered)[1:] ** 2))
        scatter = scattered * size
        if size > 0.0:
            new = beyond / (size + float(np.mean(self.noise[1:])))
            scattered = np.where(due, scattered + SCATTER_SHARE * (new - scattered), scattered)
        moved, before = moved + scatter, before + scatter
        changed = CHANGED_SHARE * np.maximum(beyond - scatter, 0.0) + ERROR_WALK * self.noise
        a, b = self.gain_variance + GAIN_WALK, self.without_variance + changed + moved
        with_gain = a * correction.conj() + self.covariance
        with_rest = self.covariance.conj() * correction.conj() + b
        total = np.maximum((correction * with_gain + with_rest).real, 0.0) + self.noise
        k_gain, k_rest = with_gain / total, with_rest / total
        return replace(
            self,
            gain=np.where(due, self.gain + k_gain * unexpected, self.gain),
            without=np.where(due, self.without + k_rest * unexpected, self.without),
            gain_variance=np.where(
                due, np.maximum(a - np.abs(k_gain) ** 2 * total, LEAST_VARIANCE), self.gain_variance
            ),
            without_variance=np.where(due, np.maximum(b - np.abs(k_rest) ** 2 * total, 0.0), self.without_variance),
            covariance=np.where(due, self.covariance - k_gain * k_rest.conj() * total, self.covariance),
            noise=np.where(due, self._noise_after(np.abs(unexpected) ** 2, before), self.noise),
            answered=np.where(due, correction, self.answered),
            scatter=scattered,
            passes=self.passes + 1,
        )

    def _noise_after(self, unexpected: FloatArray, before: FloatArray) -> FloatArray:
        """Return the noise after a pass: a floor that all harmonics share, and more where one scatters more."""
        ratio = unexpected / before
        upper = ratio[ratio.size // 2 :]
        # Of an exponential distribution, the median is log 2.
        level = float(np.median(upper)) / np.log(2.0)
        share = min(upper.size / FLOOR_COUNT, 1.0) * max(NOISE_SHARE, 0.5 / self.passes)
        floor = float(self.noise.min()) * float(np.clip(level, 0.25, 4.0)) ** share
        own = self.noise * (1.0 + NOISE_SHARE * (np.clip(ratio, 0.0, 4.0) - 1.0))
        return np.asarray(np.maximum(own, floor))

    def step(self, correction: ComplexArray, desired: ComplexArray, gain: float) -> ComplexArray:
        """Return the change of the correction, (K,), metres, towards the desired path; the mean is left alone.

        The estimated error is divided by the gain where the phase is known to 45 degrees, less where the gain is
        uncertain (``conj(G) / (|G|^2 + P)``), and not by what may be noise. Elsewhere a test step is made whose answer
        is at most a fifth of the error, or of the size of the noise: from it the gain is learned.
        """
        error = desired - self.expected(correction)
        size, variance = np.abs(error), self.variance(correction)
        sure = np.clip(1.0 - variance / np.maximum(size**2, 1e-300), 0.0, 1.0)
        power = np.abs(self.gain) ** 2 + self.gain_variance
        full = self.gain.conj() / np.maximum(power, LEAST_GAIN**2) * error
        step = gain * sure * full
        answer = np.maximum(TEST_SHARE * size, np.minimum(0.5 * size, np.sqrt(self.noise)))
        largest = answer / (np.abs(self.gain) + 2.0 * np.sqrt(self.gain_variance))
        test = full * (largest / np.maximum(np.abs(full), 1e-300))
        worth = size > TEST_ABOVE * np.sqrt(variance)
        step = np.where(self.phase_known, step, np.where(worth, test, 0.0))
        step[0] = 0.0
        return step


def _around(power: FloatArray) -> FloatArray:
    """Return the mean over neighbouring harmonics, the mean value of the path (harmonic 0) left out."""
    inner = power[1:]
    if inner.size < NEIGHBOURS:
        return power.copy()
    window = np.ones(NEIGHBOURS)
    smooth = np.convolve(inner, window, "same") / np.convolve(np.ones(inner.size), window, "same")
    return np.concatenate([power[:1], smooth])
