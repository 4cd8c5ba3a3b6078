"""The displacement sensor of a simulated stage."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


class Sensor:
    """A sensor with Gaussian noise and a last digit.

    Parameters
    ----------
    noise_rms : float, metres
        Standard deviation of the noise.
    quantisation : float, metres
        Step of the readings; 0 for none.
    seed : int
        The same seed gives the same noise.
    """

    def __init__(self, noise_rms: float, quantisation: float, seed: int) -> None:
        self._noise_rms = noise_rms
        self._quantisation = quantisation
        self._rng = np.random.default_rng(seed)

    def read(self, displacement: FloatArray) -> FloatArray:
        """Read displacements one after the other.

        Parameters
        ----------
        displacement : ndarray, any shape, metres
            What the stage does.

        Returns
        -------
        ndarray, same shape, metres
            What the sensor says.
        """
        reading = displacement + self._noise_rms * self._rng.standard_normal(displacement.shape)
        if self._quantisation:
            reading = self._quantisation * np.round(reading / self._quantisation)
        return np.asarray(reading, dtype=np.float64)


# Random temperature is smooth over this time: the stage's body is heavy.
_INERTIA_S = 6.0


@dataclass(frozen=True)
class Temperature:
    """Slow motion of the whole stage, whatever its voltage.

    Parameters
    ----------
    amplitude : float, metres
        How far it goes from its start within the record, up to sign.
    form : {"ramp", "settling", "sine", "wandering"}
        A straight line; a body that warms up exponentially; a slow sine, as of an air conditioner; a random walk,
        smooth over some seconds.
    time : float, seconds
        Time constant of ``settling``, period of ``sine``.
    phase : float, radians
        Of ``sine``.
    seed : int
        Of ``wandering``.
    """

    amplitude: float
    form: Literal["ramp", "settling", "sine", "wandering"] = "ramp"
    time: float = 60.0
    phase: float = 0.0
    seed: int = 0

    def path(self, t: FloatArray) -> FloatArray:
        """Return the drift at times (s) from 0 on, shape (N,), metres; 0 at the start."""
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
    """A disturbance of one frequency.

    Parameters
    ----------
    frequency : float, hertz
    amplitude : float, metres
    phase : float, radians
        At time 0, of the sine.
    """

    frequency: float
    amplitude: float
    phase: float = 0.0

    def path(self, t: FloatArray) -> FloatArray:
        """Return the disturbance at times (s), shape (N,), metres."""
        return np.asarray(self.amplitude * np.imag(np.exp(1j * (2 * np.pi * self.frequency * t + self.phase))))


@dataclass(frozen=True)
class Interferometer:
    """A sensor whose two signals, a quarter of a period apart, are not what they should be.

    Parameters
    ----------
    period : float, metres
        Displacement from one fringe to the next: half or a quarter of a wavelength.
    amplitude : float, metres
        Of the error's first harmonic, less than ``period / 2 pi``.
    phase : float, radians
        Of the error where the displacement is 0: of ``amplitude sin(2 pi y / period + phase)``.
    form : {"offsets", "sine"}
        ``offsets``: both signals have an offset, and the phase is read from them as it is, which gives the error
        harmonics; ``sine``: an error without harmonics.
    """

    period: float
    amplitude: float
    phase: float = 0.0
    form: Literal["offsets", "sine"] = "sine"

    def read(self, y: FloatArray) -> FloatArray:
        """Return the readings of displacements, shape (N,), metres."""
        wave = 2 * np.pi / self.period
        angle = wave * y + self.phase
        if self.form == "sine":
            return np.asarray(y + self.amplitude * np.sin(angle))
        # Seen from a centre that is off by so much of its length, the pointer e^(i fringe) has another angle.
        return np.asarray(y + np.angle(1.0 - wave * self.amplitude * np.exp(-1j * angle)) / wave)
