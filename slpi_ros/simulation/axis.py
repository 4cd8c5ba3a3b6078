"""One axis of a simulated stage: amplifier, hysteresis, creep, flexure, ageing and sensor, in this order."""

import math
from collections import deque

import numpy as np

from slpi_ros.arrays import FloatArray
from slpi_ros.errors import UsageError
from slpi_ros.simulation.character import PLAIN, Character
from slpi_ros.simulation.dynamics import Creep, FlexureMode, Relaxation
from slpi_ros.simulation.parameters import AxisParameters
from slpi_ros.simulation.preisach import PreisachHysteresis
from slpi_ros.simulation.room import Room
from slpi_ros.simulation.surroundings import Hum, Interferometer, Sensor

# Voltage rate (V/s) at which the coercivity has grown by `rate_dependence`; rate below which the growth is linear
# (V/s); time constant of the rate (s).
REFERENCE_RATE, ONSET, SETTLING = 100.0, 5.0, 2e-3


class SimulatedAxis:
    """One axis: hysteresis and noise of its parameters, all else of its character; `seed` is that of the noise."""

    # Voltage and displacement are linear between samples; the first sample after `rest` has no duration.
    # It follows `room`, whose clock is that of the samples; the temperature of the axis counts from the room's mean.
    def __init__(
        self,
        parameters: AxisParameters | None = None,
        seed: int = 0,
        character: Character = PLAIN,
        room: Room | None = None,
    ) -> None:
        self.parameters, self.character = parameters or AxisParameters(), character
        self._hysteresis = PreisachHysteresis(self.parameters)
        self._lag = Relaxation(np.array([character.lag])) if character.lag else None
        creep_times = character.creep_shortest, character.creep_longest
        self._creep = Creep(character.creep, *creep_times) if character.creep else None
        self._mode = FlexureMode(character.resonance, character.damping) if character.resonance else None
        self._interferometer = Interferometer(character.sensor_period, character.sensor_amplitude)
        self._hum = Hum(character.hum_frequency, character.hum_amplitude, float(seed % 7))
        self._noise = Sensor(self.parameters.noise_rms, self.parameters.quantisation, seed)
        self._room = room if character.has_surroundings else None
        self._commands: deque[tuple[float, float]] = deque()
        self.rest()

    def rest(self) -> None:
        """Reset to rest at 0 V, and the clock."""
        self._hysteresis.rest()
        for part in (self._lag, self._creep, self._mode):
            if part:
                part.rest()
        self._commands.clear()
        self._last: float | None = None
        self._start = self._piezo = self._played = self._rate = 0.0

    def begin_drift(self, t: float) -> None:
        """Begin the drifts at time `t` (s); they begin with the first sample otherwise."""
        self._start = t

    def step(self, t: float, v: float) -> float:
        """Apply a voltage (V) at time `t` (s); return the reading (m) without noise, other axes being at rest."""
        return self.read(t, self.move(t, v))

    def run(self, t: FloatArray, v: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Apply voltages (V) at times (s); return the readings (m) without and with noise, (N,) each."""
        if t.shape != v.shape:
            raise UsageError(f"stage: {t.shape} times for {v.shape} voltages; give one time for each voltage")
        y = np.array([self.step(*sample) for sample in zip(t.tolist(), v.tolist(), strict=True)], dtype=np.float64)
        return y, self._noise.read(y)

    def move(self, t: float, v: float) -> float:
        """Apply a voltage (V) at time `t` (s), which does not decrease, or raise unchanged; return the motion (m)."""
        self._hysteresis.check(v)
        # Where nothing depends on the time, any is good.
        dt = self._advance(t) if self.character.depends_on_time else 0.0
        piezo = self._amplified(t, dt, v)
        y = self._hysteresis.step(piezo, self._seen_by_relays(dt, piezo))
        if self._creep:
            y = self._creep.step(dt, y)
        if self._mode:
            y = self._mode.step(dt, y)
        if self.character.gain_drift:
            y *= 1.0 + self.character.gain_drift * self._drifted(t)
        if self._room:
            warmer, loaded = self._surrounded(self._room, t)
            y *= 1.0 + self.character.temperature_gain * warmer + self.character.load_gain * loaded
        return y

    def read(self, t: float, motion: float) -> float:
        """Return the reading (m), without noise, at time `t` (s) for the motion (m) of this axis with coupling."""
        y = self.parameters.offset + motion
        if self.character.thermal_drift:
            y += self.character.thermal_drift * self._drifted(t)
        if self._room:
            warmer, loaded = self._surrounded(self._room, t)
            y += self.character.temperature_offset * warmer + self.character.load_offset * loaded
        if self.character.sensor_amplitude:
            y = float(self._interferometer.read(np.asarray(y)))
        if self.character.hum_amplitude:
            y += float(self._hum.path(np.asarray(t - self._start)))
        return y

    def measure(self, reading: float) -> float:
        """Return a reading (m) with the noise and the resolution of the sensor."""
        return float(self._noise.read(np.asarray(reading)))

    def _advance(self, t: float) -> float:
        """Set the clock to `t` (s) and return the time (s) since the last sample."""
        if self._last is None:
            self._start = last = t
        else:
            last = self._last
        if not last <= t < math.inf:
            raise UsageError(f"stage: time {t} s after {last} s; times must be finite and non-decreasing")
        self._last = t
        return t - last

    def _surrounded(self, room: Room, t: float) -> tuple[float, float]:
        """Return by how much (K) the axis is warmer than usual at time `t` (s), and its load (N)."""
        at = np.array([t])
        return float(room.temperature(at, self.character.temperature_time)[0]) - room.mean, float(room.load(at)[0])

    def _drifted(self, t: float) -> float:
        return -math.expm1(-(t - self._start) / self.character.drift_time)

    def _amplified(self, t: float, dt: float, v: float) -> float:
        if self.character.delay:
            v = self._delayed(t, v)
        if self._lag:
            v = self._within_thresholds(float(self._lag.step(dt, v)[0]))
        return min(v, self.character.saturation) if self.character.saturation else v

    def _delayed(self, t: float, v: float) -> float:
        commands, wanted = self._commands, t - self.character.delay
        commands.append((t, v))
        while len(commands) > 1 and commands[1][0] <= wanted:
            commands.popleft()
        before, after = commands[0], commands[min(1, len(commands) - 1)]
        if wanted <= before[0] or after[0] <= before[0]:
            return before[1]
        return before[1] + (after[1] - before[1]) * (wanted - before[0]) / (after[0] - before[0])

    def _seen_by_relays(self, dt: float, v: float) -> float:
        """Return the voltage (V) at the relays, which follows with a play that widens with the rate."""
        if not self.character.rate_dependence:
            return v
        if dt > 0.0:
            rate = abs(v - self._piezo) / dt
            self._rate = rate + (self._rate - rate) * math.exp(-dt / SETTLING)
        self._piezo = v
        width = self.character.rate_dependence * math.log1p(self._rate / ONSET) / math.log1p(REFERENCE_RATE / ONSET)
        self._played = min(max(self._played, v - width), v + width)
        return self._within_thresholds(self._played)

    def _within_thresholds(self, v: float) -> float:
        """Return a voltage (V) that rounding or a play has not moved beyond the thresholds of the relays."""
        return min(max(v, self.parameters.threshold_min), self.parameters.threshold_max)
