"""One axis of a simulated stage with a character: hysteresis, and any of the effects that real stages have."""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from slpi_ros.errors import UsageError
from slpi_ros.simulation.dynamics import Creep, FlexureMode, Relaxation
from slpi_ros.simulation.parameters import StageParameters
from slpi_ros.simulation.preisach import PreisachStage
from slpi_ros.simulation.surroundings import Hum, Interferometer

# Voltage rate (V/s) at which the coercivity has grown by `rate_dependence`; rate below which the growth is linear
# (V/s); time constant of the rate (s).
REFERENCE_RATE, ONSET, SETTLING = 100.0, 5.0, 2e-3
# Creep continues from the shortest to the longest of these times, seconds.
CREEP_TIMES = (0.1, 100.0)


@dataclass(frozen=True)
class Character:
    """Effects of one axis besides its hysteresis; 0 means none. UsageError if a value is out of range.

    `delay` (s): from the command to the amplifier. `lag` (s): time constant of the amplifier. `saturation` (V): upper
    limit of its output. `rate_dependence` (V): growth of the coercivity at 100 V/s, logarithmic in the rate. `creep`:
    per decade of time from 0.1 s to 100 s, as a share of the displacement. `resonance` (Hz), `damping`: undamped
    frequency and damping ratio of the flexure mode. `coupling`: share of the motion of every other axis.
    `thermal_drift` (m), `gain_drift`: final displacement, and final relative change of the sensitivity, of exponential
    drifts that begin with the first sample; `drift_time` (s): their time constant. `sensor_period`, `sensor_amplitude`
    (m): of the sensor's periodic error. `hum_frequency` (Hz), `hum_amplitude` (m).
    """

    delay: float = 0.0
    lag: float = 0.0
    saturation: float = 0.0
    rate_dependence: float = 0.0
    creep: float = 0.0
    resonance: float = 0.0
    damping: float = 0.03
    coupling: float = 0.0
    thermal_drift: float = 0.0
    gain_drift: float = 0.0
    drift_time: float = 120.0
    sensor_period: float = 316e-9
    sensor_amplitude: float = 0.0
    hum_frequency: float = 50.0
    hum_amplitude: float = 0.0

    def __post_init__(self) -> None:
        """Validate the parameters."""
        signed = ("coupling", "thermal_drift", "gain_drift")
        for item in fields(self):
            value = getattr(self, item.name)
            if not math.isfinite(value) or (value < 0.0 and item.name not in signed):
                raise UsageError(f"stage: {item.name} is {value}; give 0 or more")
        for name, holds, need in (
            ("damping", 0.0 < self.damping < 1.0, "between 0 and 1"),
            ("coupling", abs(self.coupling) < 0.5, "between -0.5 and 0.5"),
            ("gain_drift", abs(self.gain_drift) < 0.5, "between -0.5 and 0.5"),
            ("drift_time", self.drift_time > 0.0, "more than 0 s"),
            ("sensor_amplitude", 2 * math.pi * self.sensor_amplitude < self.sensor_period, "below period / 2 pi"),
        ):
            if not holds:
                raise UsageError(f"stage: {name} is {getattr(self, name)}; it must be {need}")

    @property
    def effects(self) -> tuple[str, ...]:
        """Names of the effects that are present, as in the package."""
        return tuple(name for name, parameter in STRENGTHS.items() if getattr(self, parameter))


# The parameter that sets the strength of each effect.
STRENGTHS = {
    "delay": "delay",
    "lag": "lag",
    "saturation": "saturation",
    "rate_dependence": "rate_dependence",
    "creep": "creep",
    "resonance": "resonance",
    "cross_coupling": "coupling",
    "thermal_drift": "thermal_drift",
    "gain_drift": "gain_drift",
    "sensor_periodic": "sensor_amplitude",
    "hum": "hum_amplitude",
}
SENSOR_PERIODS = (158e-9, 266e-9, 316e-9, 388e-9, 633e-9)


def draw(rng: np.random.Generator, effects: Sequence[str], *, rate: float, voltage_max: float = 100.0) -> Character:
    """Return a character with the given effects, keys of `STRENGTHS` (else UsageError), each of a random strength.

    A resonance lies below a sixth of the sampling `rate` (Hz), a saturation below `voltage_max` (V), the upper end of
    the voltage range.
    """

    def strength(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    sign = float(rng.choice([-1.0, 1.0]))
    period = float(rng.choice(SENSOR_PERIODS))
    values = {
        "delay": strength(2e-3, 15e-3),
        "lag": strength(2e-3, 15e-3),
        "saturation": voltage_max * (1.0 - strength(0.04, 0.15)),
        "rate_dependence": strength(0.5, 3.0),
        "creep": strength(5e-3, 30e-3),
        "resonance": rate * strength(1 / 12, 1 / 6.5),
        "coupling": sign * strength(4e-3, 30e-3),
        "thermal_drift": sign * strength(0.2e-6, 1.5e-6),
        "gain_drift": sign * strength(5e-3, 30e-3),
        "sensor_amplitude": period / (2 * math.pi) * strength(0.25, 0.6),
        "hum_amplitude": strength(15e-9, 80e-9),
    }
    unknown = [effect for effect in effects if effect not in STRENGTHS]
    if unknown:
        raise UsageError(f"stage: no effect '{unknown[0]}'; choose from {', '.join(STRENGTHS)}")
    return Character(
        damping=strength(0.015, 0.06),
        drift_time=strength(60.0, 300.0),
        sensor_period=period,
        hum_frequency=float(rng.choice([50.0, 60.0])),
        **{STRENGTHS[effect]: values[STRENGTHS[effect]] for effect in effects},
    )


class CharacterAxis:
    """One axis of a stage: amplifier, hysteresis, creep, flexure and ageing, in the order of the signal.

    Voltage and displacement are linear between samples. `parameters` are hysteresis and sensor noise, with their own
    dynamics off; `seed` is that of the sensor noise.
    """

    def __init__(self, parameters: StageParameters, character: Character, seed: int) -> None:
        self.parameters, self.character = parameters, character
        self._hysteresis = PreisachStage(parameters, seed)
        self._lag = Relaxation(np.array([character.lag])) if character.lag else None
        self._creep = Creep(character.creep, *CREEP_TIMES) if character.creep else None
        self._mode = FlexureMode(character.resonance, character.damping) if character.resonance else None
        self._sensor = Interferometer(character.sensor_period, character.sensor_amplitude)
        self._hum = Hum(character.hum_frequency, character.hum_amplitude, float(seed % 7))
        self._start = self._last = -math.inf
        self._commands: deque[tuple[float, float]] = deque()
        self._piezo = self._played = self._rate = 0.0

    def step(self, t: float, v: float) -> float:
        """Apply a command (V) at time `t` (s), which does not decrease; return the motion of this axis (m)."""
        if self._last == -math.inf:
            self._start = self._last = t
        if not self._last <= t < math.inf:
            raise UsageError(f"stage: time {t} s after {self._last} s; times must be finite and non-decreasing")
        dt, self._last = t - self._last, t
        piezo = self._amplified(t, dt, v)
        y = self._hysteresis.switch(piezo, self._seen_by_relays(dt, piezo)) - self.parameters.offset
        if self._creep:
            y = self._creep.step(dt, y)
        if self._mode:
            y = self._mode.step(dt, y)
        return y * (1.0 + self.character.gain_drift * self._drifted(t))

    @property
    def coupling(self) -> float:
        """Share of the motion of every other axis."""
        return self.character.coupling

    def begin_drift(self, t: float) -> None:
        """Begin the drifts at time `t` (s); they begin with the first sample otherwise."""
        self._start = t

    def read(self, t: float, motion: float) -> float:
        """Return the reading (m), without noise, at time `t` (s) for the motion (m) of this axis with coupling."""
        y = self.parameters.offset + motion + self.character.thermal_drift * self._drifted(t)
        if self.character.sensor_amplitude:
            y = float(self._sensor.read(np.asarray(y)))
        if self.character.hum_amplitude:
            y += float(self._hum.path(np.asarray(t - self._start)))
        return y

    def measure(self, reading: float) -> float:
        """Return a reading (m) with the noise and the resolution of the sensor."""
        return self._hysteresis.measure(reading)

    def _drifted(self, t: float) -> float:
        return -math.expm1(-(t - self._start) / self.character.drift_time)

    def _amplified(self, t: float, dt: float, v: float) -> float:
        """Return the voltage (V) at the piezo."""
        if self.character.delay:
            v = self._delayed(t, v)
        if self._lag:
            v = float(self._lag.step(dt, v)[0])
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
        return min(max(self._played, self.parameters.threshold_min), self.parameters.threshold_max)
