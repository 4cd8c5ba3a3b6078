"""The room of a simulated stage: temperature, load and what drifts beside them, and sensors of these."""

import math
from dataclasses import dataclass

import numpy as np

from slpi_ros.arrays import FloatArray
from slpi_ros.errors import UsageError

# Periods (s) of the temperature: of the weather and the day, and of the air conditioning; numbers of waves.
SLOW, COOLING, WAVES, HARMONICS = (600.0, 14_400.0), (240.0, 720.0), 10, 3
# A load stays for so long (s), is put on or taken off within `RAMP` (s), and repeats after this number.
LOADED, RAMP, LOADS = (8.0, 90.0), 0.4, 4000


@dataclass(frozen=True)
class _Waves:
    """Sum of sinusoids with amplitudes, angular frequencies (rad/s) and phases (rad), shape (k,) each."""

    amplitude: FloatArray
    omega: FloatArray
    phase: FloatArray

    def at(self, t: FloatArray, lag: float = 0.0) -> FloatArray:
        """Return it after a first-order lag (s), in steady state, shape (N,)."""
        late = self.omega * lag
        waves = np.sin(np.multiply.outer(t, self.omega) + (self.phase - np.arctan(late)))
        return np.asarray(waves @ (self.amplitude / np.hypot(1.0, late)))


class Room:
    """Temperature (°C), load (N), humidity and pressure at any time; the same for the same `seed`.

    `swing` (K) is the rms of the temperature about `mean` (°C), and `load` (N) the largest load.
    """

    def __init__(self, seed: int, swing: float = 0.5, load: float = 2.0, mean: float = 21.0) -> None:
        if not (swing >= 0.0 and load >= 0.0 and math.isfinite(swing + load + mean)):
            raise UsageError(f"room: swing {swing} K and load {load} N; give 0 or more")
        rng = np.random.default_rng([seed, 46])
        self.mean, self._swing = mean, swing
        self._temperature = _waves(rng, cooling=True)
        # They drift as the temperature does, and have nothing to do with it.
        self._humidity, self._pressure = _waves(rng, cooling=False), _waves(rng, cooling=False)
        stays = np.exp(rng.uniform(math.log(LOADED[0]), math.log(LOADED[1]), LOADS))
        self._changes = np.cumsum(stays)
        self._loads = load * rng.choice([0.0, 0.25, 0.5, 0.75, 1.0], LOADS + 1)
        self._loads[-1] = self._loads[0]

    def temperature(self, t: FloatArray, lag: float = 0.0) -> FloatArray:
        """Return the temperature (°C), shape (N,), at times `t` (s), of something that follows it with a lag (s)."""
        return self.mean + self._swing * self._temperature.at(t, lag)

    def humidity(self, t: FloatArray) -> FloatArray:
        """Return the relative humidity (0..1), shape (N,)."""
        return 0.45 + 0.03 * self._humidity.at(t)

    def pressure(self, t: FloatArray) -> FloatArray:
        """Return the air pressure (Pa), shape (N,)."""
        return 98_000.0 + 150.0 * self._pressure.at(t)

    def load(self, t: FloatArray) -> FloatArray:
        """Return the load (N), shape (N,), at times `t` (s)."""
        since = np.mod(t, self._changes[-1])
        place = np.searchsorted(self._changes, since, side="right")
        begun = np.concatenate([[0.0], self._changes])[place]
        before = self._loads[np.maximum(place - 1, 0)]
        share = np.clip((since - begun) / RAMP, 0.0, 1.0)
        return np.asarray(before + share * (self._loads[place] - before))


def _waves(rng: np.random.Generator, *, cooling: bool) -> _Waves:
    """Return waves with a total rms of 1: slow ones, larger the slower they are, and those of an air conditioning."""
    periods = np.exp(rng.uniform(math.log(SLOW[0]), math.log(SLOW[1]), WAVES))
    sizes = (periods / SLOW[1]) ** 0.5
    if cooling:
        first = math.exp(rng.uniform(math.log(COOLING[0]), math.log(COOLING[1])))
        periods = np.concatenate([periods, first / np.arange(1, HARMONICS + 1)])
        sizes = np.concatenate([sizes, rng.uniform(0.5, 1.5) / np.arange(1, HARMONICS + 1) ** 2])
    sizes *= math.sqrt(2.0) / np.linalg.norm(sizes)
    phases = rng.uniform(0.0, 2 * math.pi, periods.size)
    return _Waves(sizes, 2 * math.pi / periods, phases)


class Still(Room):
    """A room in which nothing changes: `temperature` (°C) and `load` (N) are constant."""

    def __init__(self, temperature: float, load: float, mean: float = 21.0) -> None:
        super().__init__(0, 0.0, 0.0, mean)
        self._constant = temperature, load

    def temperature(self, t: FloatArray, lag: float = 0.0) -> FloatArray:
        """Return the temperature (°C), shape (N,)."""
        return np.full(t.shape, self._constant[0])

    def load(self, t: FloatArray) -> FloatArray:
        """Return the load (N), shape (N,)."""
        return np.full(t.shape, self._constant[1])


@dataclass(frozen=True)
class RoomSensor:
    """A slow sensor: readings every `interval` (s), irregular by a tenth of that, late by `lag` (s), and noisy."""

    interval: float = 2.0
    lag: float = 0.0
    noise: float = 0.0
    seed: int = 0

    def times(self, start: float, end: float) -> FloatArray:
        """Return the times (s) of the readings from `start` to `end`, shape (n,)."""
        rng = np.random.default_rng([self.seed, 1])
        even = np.arange(start, end, self.interval)
        return np.asarray(even + self.interval * rng.uniform(-0.05, 0.05, even.size))

    def read(self, t: FloatArray, value: FloatArray) -> FloatArray:
        """Return the readings, shape (n,), at times `t` (s), which increase, for the true values there."""
        rng, seen = np.random.default_rng([self.seed, 2]), np.array(value, dtype=np.float64)
        if self.lag:
            kept = np.exp(-np.diff(t) / self.lag)
            for k in range(1, seen.size):
                seen[k] = value[k] + kept[k - 1] * (seen[k - 1] - value[k])
        return np.asarray(seen + self.noise * rng.standard_normal(seen.size))
