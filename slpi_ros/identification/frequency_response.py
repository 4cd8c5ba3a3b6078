"""Frequency response of a stage from a record of periodic multisines: best linear approximation, noise, distortion.

The method is that of Pintelon and Schoukens, System Identification, 2nd ed., chapter 4: periods tell the noise, lines
that are not excited the distortion, and biases what depends on them. Voltages are linear between samples.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slpi_ros.arrays import FloatArray, Mask
from slpi_ros.effects.filters import Uniform
from slpi_ros.errors import RecordError

ComplexArray = NDArray[np.complex128]
# Voltage steps count as repeated where they differ by at most this share of their rms; share that repeats at a period.
REPEATED, MOSTLY = 0.05, 0.3
# Periods of the transient, fewest that are used after it, and fewest samples of a period.
TRANSIENT, FEWEST, SHORTEST = 2, 2, 32
# Fewest frequencies.
LINES = 10
# A line is excited if its voltage is at least this share of the median of the strongest tenth.
EXCITED = 0.1
# Expanded by this factor, the uncertainty is an interval of 95 %.
COVERAGE = 2.0
NO_DRIVE = "give a record of a drive by slpi excite --for-response"


@dataclass(frozen=True)
class FrequencyResponse:
    """Response (reading over voltage, m/V) of one axis at frequencies; standard uncertainties are of its magnitude."""

    frequency: FloatArray  # Hz, (K,)
    response: ComplexArray  # m/V, (K,), mean of the biases
    noise: FloatArray  # m/V, (K,), from what does not repeat
    distortion: FloatArray  # m/V, (K,), from what appears where nothing was excited, and differs between biases
    biases: tuple[float, ...]  # V
    each: ComplexArray  # m/V, (B, K), at each bias

    @property
    def interval(self) -> FloatArray:
        """Half width of the interval of 95 %, m/V, (K,)."""
        return np.asarray(COVERAGE * np.hypot(self.noise, self.distortion))

    @property
    def relative(self) -> FloatArray:
        """`interval` over the magnitude, (K,)."""
        return np.asarray(self.interval / np.maximum(np.abs(self.response), 1e-300))

    @property
    def slope(self) -> float:
        """Magnitude at the lowest frequencies, m/V."""
        return float(np.median(np.abs(self.response[: max(3, self.frequency.size // 20)])))

    def agreement(self, model: ComplexArray, within: float = 0.1) -> tuple[float, float] | None:
        """Return the band (Hz) from the lowest frequency on in which a model (m/V, (K,)) has this shape; None: none.

        Slopes may differ by a constant factor, as that of a small motion is less than that of a large one.
        """
        low = slice(0, max(3, self.frequency.size // 20))
        scale = np.median(np.abs(self.response[low]) / np.abs(model[low]))
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio, allowed = self.response / (scale * model), within + self.relative
        # What is not known does not agree.
        off = ~(np.isfinite(ratio) & np.isfinite(allowed) & (np.abs(ratio - 1.0) <= allowed))
        # Single lines are off by chance.
        off = np.convolve(off, np.ones(5), "same") > 2.5
        last = int(np.argmax(off)) - 1 if off.any() else off.size - 1
        return (float(self.frequency[0]), float(self.frequency[last])) if last > 0 else None


def frequency_response(t: FloatArray, v: FloatArray, y: FloatArray) -> FrequencyResponse:
    """Return the frequency response of an axis.

    Parameters
    ----------
    t, v, y : ndarray, shape (N,)
        Stamps (s), voltages (V) and readings (m), with periodic voltages of the same period at one or more biases.
        Periods in which a reading is missing (NaN) are left out.

    Returns
    -------
    FrequencyResponse

    Raises
    ------
    RecordError
        If no voltages repeat, or readings are missing in nearly all periods.
    """
    grid = Uniform.over(t)
    v, y = grid.on(v), grid.on(y)
    size = _period(v)
    stretches = list(_stretches(v, size))
    if not stretches:
        raise RecordError(f"no voltages repeat for {TRANSIENT + FEWEST} periods; {NO_DRIVE}")
    stretches = [each for each in stretches if np.count_nonzero(_whole(y, *each, size)) >= FEWEST]
    if not stretches:
        raise RecordError("readings are missing in nearly all periods; check the sensor and its link, and record again")
    spectra = [_spectra(v, y, begin, end, size) for begin, end in stretches]
    strength = np.abs(np.mean([volts[0] for volts, _, _ in spectra], axis=0))
    strong = np.sort(strength[1:])[-max(3, size // 20) :]
    excited = np.flatnonzero(strength >= EXCITED * np.median(strong))
    excited = excited[excited > 0]
    if excited.size < LINES:
        raise RecordError(f"the voltages that repeat have {excited.size} frequencies; {NO_DRIVE}")
    # Between samples the voltage is linear: so much of a line of the samples is in the continuous signal.
    frequency = excited / (size * grid.dt)
    continuous = np.sinc(excited / size) ** 2
    each, noise, distortion = [], [], []
    for volts, readings, count in spectra:
        given = volts.mean(axis=0)[excited] * continuous
        answer = readings.mean(axis=0)
        spread = np.sqrt(readings.var(axis=0, ddof=1) / count) if count > 1 else np.zeros(answer.size)
        each.append(answer[excited] / given)
        noise.append(spread[excited] / np.abs(given))
        distortion.append(_beside(np.abs(answer), spread, excited) / np.abs(given))
    count, mean = len(spectra), np.mean(each, axis=0)
    unlike = np.sum(np.abs(each - mean) ** 2, axis=0) / max(count - 1, 1) / count
    return FrequencyResponse(
        frequency,
        mean,
        np.sqrt(np.sum(np.square(noise), axis=0)) / count,
        np.sqrt(np.sum(np.square(distortion), axis=0) / count**2 + unlike),
        tuple(float(v[begin:end].mean()) for begin, end in stretches),
        np.array(each),
    )


def _period(v: FloatArray) -> int:
    """Return the number of samples after which most steps of the voltage repeat; 0: none."""
    if v.size <= 2 * SHORTEST:
        return 0
    steps = np.diff(v)
    steps = steps - steps.mean()
    spectrum = np.fft.rfft(steps, 2 * steps.size)
    alike = np.fft.irfft(np.abs(spectrum) ** 2)[: steps.size // 2]
    if alike.size <= SHORTEST or not alike[0] > 0.0:
        return 0
    share = alike / alike[0]
    # Beyond what is alike because it moves slowly.
    near = int(np.argmax(share < 0.5 * MOSTLY)) if (share < 0.5 * MOSTLY).any() else share.size
    if max(near, SHORTEST) >= share.size:
        return 0
    near = max(near, SHORTEST)
    most = int(np.argmax(share[near:])) + near
    if share[most] < MOSTLY:
        return 0
    # The shortest of the lags that are nearly as much alike: a multiple of the period is, too.
    good = np.flatnonzero(share[near:] >= 0.8 * share[most]) + near
    return int(good[0]) if share[good[0]] >= share[min(good[0] + 1, share.size - 1)] else most


def _stretches(v: FloatArray, size: int) -> Iterator[tuple[int, int]]:
    """Yield begin and end of whole periods, after the transient, in which the voltage repeats."""
    if not size:
        return
    steps = np.diff(v)
    scale = float(np.sqrt(np.mean(steps**2)))
    repeated = np.abs(steps[size:] - steps[:-size]) <= REPEATED * scale
    # Stretches at rest repeat, too.
    moves = np.convolve(steps**2, np.ones(size), "valid")[: repeated.size] > 0.1 * size * scale**2
    edges = np.flatnonzero(np.diff(np.pad(repeated & moves, 1).astype(np.int8)))
    for first, after in edges.reshape(-1, 2).tolist():
        end = after + size
        count = (end - first) // size - TRANSIENT
        if count >= FEWEST:
            yield end - count * size + 1, end + 1


def _spectra(v: FloatArray, y: FloatArray, begin: int, end: int, size: int) -> tuple[ComplexArray, ComplexArray, int]:
    """Return spectra of voltages and readings, (P, size // 2 + 1) each, of P whole periods, without their trend."""
    count, whole = (end - begin) // size, _whole(y, begin, end, size)
    place = (np.arange(count * size) - 0.5 * count * size).reshape(count, size)[whole]
    volts, readings = (each[begin:end].reshape(count, size)[whole] for each in (v, y))
    # Creep and drift go on: a parabola through the means of the periods.
    trend = np.polynomial.Polynomial.fit(place.mean(axis=1) + 0.5, readings.mean(axis=1), min(2, len(place) - 1))
    return np.fft.rfft(volts, axis=1), np.fft.rfft(readings - trend(place), axis=1), len(place)


def _whole(y: FloatArray, begin: int, end: int, size: int) -> Mask:
    """Return the mask, (P,), of the periods from `begin` to `end` in which no reading is missing."""
    return np.asarray(np.isfinite(y[begin:end]).reshape(-1, size).all(axis=1))


def _beside(answer: FloatArray, spread: FloatArray, excited: NDArray[np.int64]) -> FloatArray:
    """Return what odd lines that are not excited hold beyond the noise, around each excited line, (K,)."""
    odd = np.arange(1, int(excited[-1]) + 1, 2)
    silent = np.setdiff1d(odd, excited)
    if silent.size < FEWEST:
        return np.zeros(excited.size)
    power = np.maximum(answer[silent] ** 2 - spread[silent] ** 2, 0.0)
    # Means of a few lines: a single one is that of a chi-squared variable with two degrees of freedom.
    few = min(5, silent.size)
    smooth = np.convolve(np.pad(power, few // 2, mode="edge"), np.ones(few) / few, "valid")[: silent.size]
    return np.sqrt(np.interp(excited, silent, smooth))
