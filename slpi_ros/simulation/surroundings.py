"""What acts on the reading of a stage besides its motion: a line, the error of an interferometer, and noise."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from slpi_ros.arrays import FloatArray


@dataclass(frozen=True)
class Hum:
    """A sinusoidal disturbance: `frequency` (Hz), `amplitude` (m), and `phase` (rad) of the sine at time 0."""

    frequency: float
    amplitude: float
    phase: float = 0.0

    def path(self, t: FloatArray) -> FloatArray:
        """Return the disturbance, shape (N,), metres, at times `t`, shape (N,), seconds."""
        return np.asarray(self.amplitude * np.imag(np.exp(1j * (2 * np.pi * self.frequency * t + self.phase))))


@dataclass(frozen=True)
class Interferometer:
    """An interferometer with imperfect quadrature signals."""

    # The first harmonic of the error is ``amplitude sin(2 pi y / period + phase)``. With the form ``offsets``, an
    # uncorrected offset of both signals, it has further harmonics.

    period: float  # m, half or a quarter of the wavelength
    amplitude: float  # m, less than ``period / 2 pi``
    phase: float = 0.0  # rad
    form: Literal["offsets", "sine"] = "sine"

    def read(self, y: FloatArray) -> FloatArray:
        """Return the readings, shape (N,), metres, for displacements `y`, shape (N,), metres."""
        wave = 2 * np.pi / self.period
        angle = wave * y + self.phase
        if self.form == "sine":
            return np.asarray(y + self.amplitude * np.sin(angle))
        # Angle of the phasor e^(i fringe) relative to a centre with an offset of this fraction of its length.
        return np.asarray(y + np.angle(1.0 - wave * self.amplitude * np.exp(-1j * angle)) / wave)


class Sensor:
    """A sensor with Gaussian noise of `noise_rms` (m), the same for the same `seed`, and quantisation (m; 0: none)."""

    def __init__(self, noise_rms: float, quantisation: float, seed: int) -> None:
        self._noise_rms = noise_rms
        self._quantisation = quantisation
        self._rng = np.random.default_rng(seed)

    def read(self, displacement: FloatArray) -> FloatArray:
        """Return the readings (m) for true displacements (m), in order, arrays of one shape."""
        reading = displacement + self._noise_rms * self._rng.standard_normal(displacement.shape)
        if self._quantisation:
            reading = self._quantisation * np.round(reading / self._quantisation)
        return np.asarray(reading, dtype=np.float64)
