"""The displacement sensor of a simulated stage."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


class Sensor:
    """A sensor with Gaussian noise and quantisation.

    Parameters
    ----------
    noise_rms : float, metres
        Standard deviation of the noise.
    quantisation : float, metres
        Resolution of the readings; 0 for none.
    seed : int
        The same seed gives the same noise.
    """

    def __init__(self, noise_rms: float, quantisation: float, seed: int) -> None:
        self._noise_rms = noise_rms
        self._quantisation = quantisation
        self._rng = np.random.default_rng(seed)

    def read(self, displacement: FloatArray) -> FloatArray:
        """Return the readings for displacements, in order.

        Parameters
        ----------
        displacement : ndarray, any shape, metres
            True displacement.

        Returns
        -------
        ndarray, same shape, metres
            Sensor reading.
        """
        reading = displacement + self._noise_rms * self._rng.standard_normal(displacement.shape)
        if self._quantisation:
            reading = self._quantisation * np.round(reading / self._quantisation)
        return np.asarray(reading, dtype=np.float64)


# Smoothing time of random temperature, due to the heat capacity of the stage.
_INERTIA_S = 6.0


@dataclass(frozen=True)
class Temperature:
    """Slow displacement of the stage that is independent of the voltage.

    Parameters
    ----------
    amplitude : float, metres
        Largest displacement from the start within the record, signed.
    form : {"ramp", "settling", "sine", "wandering"}
        Linear; exponential warm-up; a slow sine, as of an air conditioner; a random walk, smoothed over some seconds.
    time : float, seconds
        Time constant of ``settling``, period of ``sine``.
    phase : float, radians
        Phase of ``sine``.
    seed : int
        Seed of ``wandering``.
    """

    amplitude: float
    form: Literal["ramp", "settling", "sine", "wandering"] = "ramp"
    time: float = 60.0
    phase: float = 0.0
    seed: int = 0

    def path(self, t: FloatArray) -> FloatArray:
        """Return the drift, shape (N,), metres, at times `t` from 0 on, shape (N,), seconds; 0 at the start."""
        x = self._form(t - t[0])
        x = x - x[0]
        return np.asarray(self.amplitude * x / np.max(np.abs(x)), dtype=np.float64)

    def _form(self, t: FloatArray) -> FloatArray:
        match self.form:
            case "ramp":
                return t
            case "settling":
                return np.asarray(-np.expm1(-t / self.time))
            case "sine":
                return np.asarray(np.sin(2 * np.pi * t / self.time + self.phase))
            case "wandering":
                return self._wandering(t)

    def _wandering(self, t: FloatArray) -> FloatArray:
        spacing = _INERTIA_S / 20
        count = int(np.ceil(t[-1] / spacing)) + 2
        steps = np.random.default_rng(self.seed).standard_normal(count + 200)
        kernel = np.hanning(43)[1:-1]
        walk = np.cumsum(np.convolve(steps, kernel, mode="valid"))[:count]
        return np.interp(t, spacing * np.arange(count), walk)


@dataclass(frozen=True)
class Hum:
    """A sinusoidal disturbance.

    Parameters
    ----------
    frequency : float, hertz
    amplitude : float, metres
    phase : float, radians
        Phase of the sine at time 0.
    """

    frequency: float
    amplitude: float
    phase: float = 0.0

    def path(self, t: FloatArray) -> FloatArray:
        """Return the disturbance, shape (N,), metres, at times `t`, shape (N,), seconds."""
        return np.asarray(self.amplitude * np.imag(np.exp(1j * (2 * np.pi * self.frequency * t + self.phase))))


@dataclass(frozen=True)
class Interferometer:
    """An interferometer with imperfect quadrature signals.

    Parameters
    ----------
    period : float, metres
        Displacement per fringe: half or a quarter of the wavelength.
    amplitude : float, metres
        Amplitude of the error's first harmonic, less than ``period / 2 pi``.
    phase : float, radians
        Phase of the error at displacement 0, in ``amplitude sin(2 pi y / period + phase)``.
    form : {"offsets", "sine"}
        ``offsets``: both signals have an uncorrected offset, which gives an error with harmonics; ``sine``: an error
        without harmonics.
    """

    period: float
    amplitude: float
    phase: float = 0.0
    form: Literal["offsets", "sine"] = "sine"

    def read(self, y: FloatArray) -> FloatArray:
        """Return the readings, shape (N,), metres, for displacements `y`, shape (N,), metres."""
        wave = 2 * np.pi / self.period
        angle = wave * y + self.phase
        if self.form == "sine":
            return np.asarray(y + self.amplitude * np.sin(angle))
        # Angle of the pointer e^(i fringe) relative to a centre with an offset of this share of its length.
        return np.asarray(y + np.angle(1.0 - wave * self.amplitude * np.exp(-1j * angle)) / wave)
