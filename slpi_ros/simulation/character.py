"""The character of one axis of a simulated stage: any of the effects that real stages have besides hysteresis."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from slpi_ros.errors import UsageError


def _figure(default: float, meaning: str, low: float, high: float) -> Any:
    """Return a field with its meaning and unit, and its smallest and largest value."""
    return field(default=default, metadata={"meaning": meaning, "between": (low, high)})


@dataclass(frozen=True)
class Character:
    """Effects of one axis besides its hysteresis; 0 means none. UsageError if a value is out of range."""

    delay: float = _figure(0.0, "Delay of the amplifier, seconds.", 0.0, 10.0)
    lag: float = _figure(0.0, "Time constant of the amplifier, seconds.", 0.0, 10.0)
    saturation: float = _figure(
        0.0, "Upper limit of the amplifier's output, below the commands, volts; 0: none.", 0.0, 1e4
    )
    rate_dependence: float = _figure(
        0.0, "Growth of the coercivity at 100 V/s, logarithmic in the rate, volts.", 0.0, 100.0
    )
    creep: float = _figure(0.0, "Creep per decade of time, share of the displacement.", 0.0, 0.2)
    creep_shortest: float = _figure(0.1, "Shortest time constant of the creep, seconds.", 1e-6, 1e3)
    creep_longest: float = _figure(100.0, "Longest time constant of the creep, seconds.", 1e-6, 1e6)
    resonance: float = _figure(0.0, "Undamped frequency of the flexure mode, hertz; 0: none.", 0.0, 1e4)
    damping: float = _figure(0.03, "Damping ratio of the flexure mode.", 1e-4, 0.999)
    coupling: float = _figure(0.0, "Share of the motion of every other axis.", -0.499, 0.499)
    thermal_drift: float = _figure(0.0, "Final value of the drift, metres.", -1e-3, 1e-3)
    gain_drift: float = _figure(0.0, "Final relative change of the sensitivity.", -0.499, 0.499)
    temperature_offset: float = _figure(0.0, "Displacement for each kelvin of the room, metres.", -1e-3, 1e-3)
    temperature_gain: float = _figure(0.0, "Relative change of the sensitivity for each kelvin.", -0.1, 0.1)
    temperature_time: float = _figure(0.0, "Time constant of the stage's own temperature, seconds.", 0.0, 1e6)
    load_offset: float = _figure(0.0, "Displacement for each newton of the load, metres.", -1e-3, 1e-3)
    load_gain: float = _figure(0.0, "Relative change of the sensitivity for each newton.", -0.1, 0.1)
    drift_time: float = _figure(120.0, "Time constant of both drifts, seconds.", 1e-3, 1e6)
    sensor_period: float = _figure(316e-9, "Period of the sensor's periodic error, metres.", 1e-9, 1e-3)
    sensor_amplitude: float = _figure(0.0, "Amplitude of the sensor's periodic error, metres.", 0.0, 1e-4)
    hum_frequency: float = _figure(50.0, "Frequency of the line interference, hertz.", 1e-3, 1e4)
    hum_amplitude: float = _figure(0.0, "Amplitude of the line interference, metres.", 0.0, 1e-4)

    def __post_init__(self) -> None:
        for item in fields(self):
            value, (low, high) = getattr(self, item.name), item.metadata["between"]
            if not low <= value <= high:
                raise UsageError(f"stage: {item.name} is {value}; give {low:g} to {high:g}")
        if self.creep_longest <= self.creep_shortest:
            raise UsageError(f"stage: creep_longest is {self.creep_longest} s; give more than creep_shortest")
        if 2 * math.pi * self.sensor_amplitude >= self.sensor_period:
            raise UsageError(f"stage: sensor_amplitude is {self.sensor_amplitude} m; give less than period / 2 pi")

    @property
    def effects(self) -> tuple[str, ...]:
        """Names of the effects that are present, as in the package."""
        return tuple(name for name, parameter in STRENGTHS.items() if getattr(self, parameter))

    @property
    def depends_on_time(self) -> bool:
        """Whether the displacement depends on time in addition to the sequence of voltages."""
        return not {"saturation", "cross_coupling", "sensor_periodic"}.issuperset(self.effects) or self.has_surroundings

    @property
    def has_surroundings(self) -> bool:
        """Whether the axis follows its room."""
        return any((self.temperature_offset, self.temperature_gain, self.load_offset, self.load_gain))


# The parameter that sets the strength of each effect: mostly that of its name.
_OTHERWISE = {"cross_coupling": "coupling", "sensor_periodic": "sensor_amplitude", "hum": "hum_amplitude"}
STRENGTHS = {
    name: _OTHERWISE.get(name, name)
    for name in (
        "delay", "lag", "saturation", "rate_dependence", "creep", "resonance", "cross_coupling", "thermal_drift",
        "gain_drift", "sensor_periodic", "hum",
    )
}  # fmt: skip
PLAIN = Character()
SENSOR_PERIODS = (158e-9, 266e-9, 316e-9, 388e-9, 633e-9)


def draw(rng: np.random.Generator, effects: Sequence[str], *, rate: float, voltage_max: float = 100.0) -> Character:
    """Return a character with the given effects, keys of `STRENGTHS`, each of a random strength."""
    # A resonance lies below a sixth of the sampling `rate` (Hz), a saturation below `voltage_max` (V).

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
