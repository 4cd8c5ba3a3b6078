"""Repeating error of each harmonic of a path that repeats, by a Kalman filter, and the step that corrects it."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from slpi_ros.arrays import FloatArray, Mask

ComplexArray = NDArray[np.complex128]

# A phase counts as known where 1.7 standard deviations of the gain are within 45 degrees:
# 1.7 sqrt(P / 2) <= sin(45) |G|.
PHASE_KNOWN = 0.6
# Largest response to a test step of a harmonic whose phase is not known, as a share of its error, and the number of
# standard deviations that its error must have. With a phase of its own each, they add 2 % to the rms error.
TEST_SHARE, TEST_ABOVE = 0.2, 3.0
# Least gain by which an error is divided: a mode that the inverse takes out may leave next to nothing.
LEAST_GAIN = 0.1
# Standard deviation of what is left of the hysteresis, as a share of the path's harmonics nearby.
REST_SHARE, TURN_SHARE = 0.1, 0.02
# Random walk of the repeating error from pass to pass, as a share of its noise (variance).
ERROR_WALK = 0.02
# The share of an innovation that is taken over grows by the correlation of successive ones beyond this, which noise may
# have, up to this share; what is left of the correlation after another pass.
CORRELATED, MOST_SHARE, REMEMBERED = 0.1, 0.8, 0.7
# Share of an unexpected change, as in the neighbouring harmonics, that is taken for a change of the repeating error.
CHANGED_SHARE, NEIGHBOURS = 0.2, 3
# Share of the new estimate of what comes with a change of the path.
SCATTER_SHARE = 0.3
# Share that is left after another pass of a gain's variance by what was not foretold, and where nothing has tested it;
# share of what the changes of one harmonic alone say of its gain.
FORGOTTEN, KEPT, OWN_KEPT = 0.4, 0.9, 0.9
# Standard deviations by which a reading of the path itself may differ from its prediction; beyond, its gain is taken
# as unknown.
UNEXPLAINED = 8.0
# Most of that variance, as a multiple of that of the first guess.
MOST_MISFIT = 4.0
# A share of the noise's new estimate in each pass, of one harmonic and (by this number of harmonics) of the floor.
NOISE_SHARE, FLOOR_COUNT = 0.1, 200.0


@dataclass(frozen=True)
class Answer:
    """Answer of the displacement to a change of the path, as estimated from passes; arrays of shape (K,).

    Parameters
    ----------
    gain : ndarray of complex, metres per metre
        Of each harmonic when it has settled.
    variance : ndarray
        Its variance.
    transient : ndarray of complex, metres
        What the last pass still had of the answers to the changes before, and of its beginning from rest.
    transient_variance : ndarray, metres squared
    """

    gain: ComplexArray
    variance: FloatArray
    transient: ComplexArray
    transient_variance: FloatArray


@dataclass(frozen=True)
class Harmonics:
    """What is known of the harmonics of a pass of N samples; arrays of shape (K,), K = N // 2 + 1, as `numpy.fft.rfft`.

    The reading of harmonic k, without its transient, for a correction ``C`` of the desired path is ``Y = d + G C + n``.
    The gain ``G`` is that of all passes together (`slpi_ros.learning.dynamics.Dynamics`), ``d`` (what is read without a
    correction) walks by what the passes themselves show, and ``n`` is noise. What is filtered is the expected reading
    at the last correction, so that an error of the gain counts for the change of the correction only.

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
    misfit : ndarray
        Variance of the gain by which the last changes were answered otherwise than expected.
    innovation : ndarray of complex
        Last unexpected part of a reading, in its expected standard deviations.
    innovation_product, innovation_square : ndarray
        Means, over the last passes, of the product of successive innovations and of their square.
    changed, answers : ndarray, and ndarray of complex
        What the changes of this harmonic alone say of its gain: information (an inverse variance), and its product with
        their estimate.
    guessed : ndarray
        Variance of the first guess of the gain.
    amplified : ndarray
        Factor by which identified modes amplify what is left of the hysteresis.
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
    misfit: FloatArray
    innovation: ComplexArray
    innovation_product: FloatArray
    innovation_square: FloatArray
    changed: FloatArray
    answers: ComplexArray
    guessed: FloatArray
    amplified: FloatArray
    passes: int = 0

    @classmethod
    def first(cls, gain: ComplexArray, variance: FloatArray, noise: FloatArray, amplified: FloatArray) -> "Harmonics":
        """Return what is known before the first pass: the first guess of the gains, the sensor's noise, and modes."""
        none = np.zeros_like(gain)
        return cls(
            gain,
            none,
            variance,
            np.full(variance.size, np.inf),
            none,
            noise,
            none,
            np.zeros_like(noise),
            np.zeros_like(noise),
            none,
            np.zeros_like(noise),
            np.ones_like(noise),
            np.zeros_like(noise),
            none,
            variance,
            amplified,
        )

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
        """Whether the phase of a gain is known to 45 degrees, with 1.7 standard deviations."""
        return np.asarray(np.sqrt(self.gain_variance) <= PHASE_KNOWN * np.abs(self.gain))

    def begun(
        self, correction: ComplexArray, reading: ComplexArray, answer: Answer, path: ComplexArray, rest: FloatArray
    ) -> "Harmonics":
        """Return what is known after the first two passes.

        Arguments as of `after`; of the path with its correction, `path` is (K,), metres, and `rest` the variance (m^2)
        that is left of its hysteresis. Where even that and the gain do not explain what was read, a mode that nobody
        knows of rings, and the gain is not known.
        """
        noise, squares = self.noise + answer.transient_variance, around(np.abs(path) ** 2)
        apart = around(np.abs(reading - answer.gain * path) ** 2)
        apart = apart - UNEXPLAINED**2 * (rest + noise + answer.variance * squares)
        power = np.abs(answer.gain) ** 2
        told = np.maximum(apart, 0.0) / np.maximum(squares + rest / np.maximum(power, LEAST_GAIN**2), 1e-300)
        misfit = np.minimum(told, MOST_MISFIT * self.guessed)
        gain, variance = self._joint(answer, misfit)
        answer = replace(answer, gain=gain, variance=variance)
        return replace(self._at(correction, reading, noise, answer), noise=self.noise, misfit=misfit, passes=1)

    def at(self, correction: ComplexArray, reading: ComplexArray) -> "Harmonics":
        """Return the same with what was read, (K,), metres, in an earlier pass with a correction (m)."""
        steady = Answer(self.gain, self.gain_variance, np.zeros_like(self.gain), np.zeros_like(self.noise))
        return self._at(correction, reading, self.noise, steady)

    def _at(
        self, correction: ComplexArray, expected: ComplexArray, variance: FloatArray, answer: Answer
    ) -> "Harmonics":
        """Return the same with an expected reading (m) at a correction (m), its variance (m^2), and new gains; (K,)."""
        return replace(
            self, gain=answer.gain, gain_variance=answer.variance,
            without=expected - answer.gain * correction,
            without_variance=variance + answer.variance * np.abs(correction) ** 2,
            covariance=-answer.variance * correction.conj(),
            answered=correction,
        )  # fmt: skip

    def of_hysteresis(self, path: ComplexArray) -> FloatArray:
        """Return the variance (m^2, (K,)) of what is left of the hysteresis of a path, (K,), metres, in the reading.

        It is a share of the path's own harmonics nearby, and of lower ones where it falls with the square of the
        frequency, as turns make it. It passes through the mechanics as the path itself does, but not through the
        inverse, which takes out of the path what would make a mode ring.
        """
        squared = np.arange(1.0, path.size) ** 2
        turning = np.append(0.0, np.maximum.accumulate(np.abs(path[1:]) * squared) / squared)
        share = REST_SHARE**2 * around(np.abs(path) ** 2) + TURN_SHARE**2 * turning**2
        squares: FloatArray = np.abs(self.gain) ** 2
        return np.asarray(share * self.amplified**2 * (squares + np.minimum(squares, self.gain_variance)))

    def after(self, correction: ComplexArray, reading: ComplexArray, answer: Answer) -> "Harmonics":
        """Return what is known after another pass.

        Parameters
        ----------
        correction, reading : ndarray of complex, (K,), metres
            Correction of the desired path in this pass, and what was measured, without the transient.
        answer : Answer
            What the passes up to this one say of the gains and of the transient.
        """
        at_last, change = self.expected(self.answered), correction - self.answered
        squares: FloatArray = np.abs(change) ** 2
        gain, gain_variance = self._joint(answer, self.misfit)
        unexpected = reading - (at_last + gain * change)
        # The hysteresis of the corrected path is another one.
        before, moved = self.variance(self.answered), self.of_hysteresis(change)
        own = before + gain_variance * squares + moved
        noise = self.noise + answer.transient_variance
        beyond = np.maximum(around(np.abs(unexpected) ** 2) - own - noise, 0.0)
        scattered, size = self.scatter, float(np.mean(squares[1:]))
        scatter = scattered * size
        if size > 0.0:
            new = beyond / (size + float(np.mean(self.noise[1:])))
            scattered = scattered + SCATTER_SHARE * (new - scattered)
        # A gain that has not foretold the answer is not known, whatever is said of it. Small changes tell nothing.
        answered = around(np.abs(gain) ** 2 * squares)
        apart = around(np.abs(reading - (at_last + answer.gain * change)) ** 2)
        apart = np.maximum(apart - before - answer.variance * squares - moved - noise, 0.0)
        # Where mechanics cannot be, it is the hysteresis that has answered otherwise.
        most = np.minimum(np.abs(gain) ** 2, MOST_MISFIT * self.guessed)
        told = np.where(answered > noise, np.minimum(apart / np.maximum(around(squares), 1e-300), most), 0.0)
        misfit = np.maximum(told, np.where(answered > noise, FORGOTTEN, KEPT) * self.misfit)
        weight = 1.0 / (noise + before + moved + scattered * size)
        found = replace(
            self,
            changed=OWN_KEPT * self.changed + weight * squares,
            answers=OWN_KEPT * self.answers + weight * change.conj() * (reading - at_last),
        )
        joint, joint_variance = found._joint(answer, misfit)
        answer = replace(answer, gain=joint, variance=joint_variance)
        own = own + scatter
        variance = own + CHANGED_SHARE * np.maximum(beyond - scatter, 0.0) + ERROR_WALK * self.noise
        innovation = unexpected / np.sqrt(np.maximum(own + noise, 1e-300))
        innovation_product = _mean_with(self.innovation_product, (innovation * self.innovation.conj()).real)
        innovation_square = _mean_with(self.innovation_square, np.abs(innovation) ** 2)
        share = _share(
            variance / (variance + noise), around(innovation_product) / np.maximum(around(innovation_square), 1e-300)
        )
        now = at_last + gain * change + share * unexpected
        return replace(
            found._at(correction, now, share * noise, answer),
            noise=self._noise_after(np.abs(unexpected) ** 2, own + noise), scatter=scattered, misfit=misfit,
            innovation=innovation, innovation_product=innovation_product, innovation_square=innovation_square,
            passes=self.passes + 1,
        )  # fmt: skip

    def _joint(self, answer: Answer, misfit: FloatArray) -> tuple[ComplexArray, FloatArray]:
        """Return the gain and its variance, (K,), from all harmonics together and from the changes of each alone."""
        weight = 1.0 / np.maximum(answer.variance + misfit, 1e-300)
        total = weight + self.changed
        return (answer.gain * weight + self.answers) / total, 1.0 / total

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


def _share(share: FloatArray, correlation: FloatArray) -> FloatArray:
    """Return the share of innovations that a filter takes over, (K,), once their correlation shows it too small.

    Innovations of an optimal filter are white. With a share K, those of a random walk in noise have the correlation
    ``K_opt - K`` from one to the next, about (R. K. Mehra, On the identification of variances and adaptive Kalman
    filtering, IEEE Trans. Autom. Control 15 (1970)).
    """
    more = share + np.maximum(correlation - CORRELATED, 0.0)
    return np.asarray(np.minimum(more, np.maximum(share, MOST_SHARE)))


def _mean_with(before: FloatArray, new: FloatArray) -> FloatArray:
    """Return a mean over the last passes after another one."""
    return np.asarray(REMEMBERED * before + (1.0 - REMEMBERED) * new)


def around(power: FloatArray) -> FloatArray:
    """Return the mean over neighbouring harmonics, the mean value of the path (harmonic 0) left out."""
    inner = power[1:]
    if inner.size < NEIGHBOURS:
        return power.copy()
    window = np.ones(NEIGHBOURS)
    smooth = np.convolve(inner, window, "same") / np.convolve(np.ones(inner.size), window, "same")
    return np.concatenate([power[:1], smooth])
