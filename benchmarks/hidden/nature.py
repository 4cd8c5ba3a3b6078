"""Random draws of the effects: the physics of each, and its parameters by their names in the package."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from slpi_ros.simulation.dynamics import Creep
from slpi_ros.simulation.surroundings import Hum, Interferometer

from .drives import log_uniform
from .physics import (
    Ageing,
    Amplifier,
    Flexure,
    Physics,
    RateLaw,
    Slips,
    SlowDomains,
    Stop,
    Temperature,
    Viscosity,
    Warmth,
)

FloatArray = NDArray[np.float64]
Parameters = Mapping[str, float | tuple[float, ...] | Mapping[str, float]]

# Pairs of effects that cannot be distinguished from a single effect.
CONFUSABLE = ({"delay", "lag"},)
# Effects that differ between records of the same stage.
OWN = ("gain_drift", "thermal_drift", "steps", "hum")


@dataclass(frozen=True)
class Setting:
    """Properties of the record that a draw may use."""

    t: FloatArray
    v: FloatArray
    rate: float
    low: float
    high: float
    other: str

    @property
    def travel(self) -> float:
        """Accumulated voltage change of the record, volts."""
        return float(np.abs(np.diff(self.v)).sum())


@dataclass(frozen=True)
class Nature:
    """One effect whose strength is set afterwards.

    Parameters
    ----------
    weakest, strongest : float
        Bounds of the strength.
    physics : callable
        Returns, for a strength, the physics with this effect only.
    parameters : callable
        Returns, for a strength, the parameters by their names in the package.
    """

    weakest: float
    strongest: float
    physics: Callable[[float], Physics]
    parameters: Callable[[float], Parameters]


def _delay(rng: np.random.Generator, setting: Setting) -> Nature:
    return Nature(0.5e-3, 20e-3, lambda s: Physics(amplifier=Amplifier(delay=s)), lambda s: {"seconds": s})


def _lag(rng: np.random.Generator, setting: Setting) -> Nature:
    return Nature(1e-3, 20e-3, lambda s: Physics(amplifier=Amplifier(lag=s)), lambda s: {"time_constant": s})


def _slew(rng: np.random.Generator, setting: Setting) -> Nature:
    # The strength is how far the limit is below the fastest rate, as the logarithm of their ratio.
    fastest = float(np.quantile(np.abs(np.diff(setting.v) / np.diff(setting.t)), 0.999))
    return Nature(
        0.05,
        2.0,
        lambda s: Physics(amplifier=Amplifier(slew=fastest * np.exp(-s))),
        lambda s: {"rate": fastest * np.exp(-s)},
    )


def _saturation(rng: np.random.Generator, setting: Setting) -> Nature:
    # The strength is the fraction of the range that is cut off. The part that a refit cannot explain does not grow with
    # it, so it is drawn here.
    depth = log_uniform(rng, 0.03, 0.25)
    softness = float(rng.uniform(0.05, 0.4)) if rng.random() < 0.3 else 0.0
    below = float(rng.uniform(0.3, 1.0)) if rng.random() < 0.3 else 0.0

    def limits(strength: float) -> dict[str, float]:
        span = setting.high - setting.low
        upper = {"upper": setting.high - strength * span}
        return upper | ({"lower": setting.low + below * strength * span} if below else {})

    return Nature(depth, depth, lambda s: Physics(amplifier=Amplifier(softness=softness, **limits(s))), limits)


def _rate_dependence(rng: np.random.Generator, setting: Setting) -> Nature:
    exponent = float(rng.uniform(0.3, 0.8)) if rng.random() < 0.5 else 0.0
    onset, transition = log_uniform(rng, 3.0, 30.0), float(rng.uniform(3.0, 12.0))
    settling = log_uniform(rng, 0.5e-3, 5e-3)
    form = "coercivity" if rng.random() < 0.5 else "friction"
    bounds = (0.02, 6.0) if form == "coercivity" else (5e-9, 1e-6)

    def physics(strength: float) -> Physics:
        law = RateLaw(strength, exponent=exponent, onset=onset, settling=settling)
        return Physics(viscosity=Viscosity(law, form, transition))

    return Nature(*bounds, physics, lambda s: {"exponent": exponent} if exponent else {})


def _creep(rng: np.random.Generator, setting: Setting) -> Nature:
    if rng.random() < 0.5:
        chain = Creep(1.0, float(rng.uniform(0.05, 0.3)), log_uniform(rng, 10.0, 300.0))
        times, gains = chain.time_constants, chain.gains
    else:
        times = np.sort([log_uniform(rng, 0.15, 40.0) for _ in range(int(rng.integers(1, 4)))])
        gains = rng.uniform(0.5, 1.5, times.size)

    def parameters(strength: float) -> dict[str, tuple[float, ...]]:
        return {"time_constants": tuple(times.tolist()), "gains": tuple((strength * gains).tolist())}

    return Nature(
        5e-4,
        0.08,
        lambda s: Physics(creep=SlowDomains(**parameters(s))),
        parameters,
    )


def _contact(rng: np.random.Generator, setting: Setting) -> Nature:
    at = float(rng.uniform(3e-6, 12e-6))
    return Nature(1e-3, 1.0, lambda s: Physics(stop=Stop(at, s)), lambda s: {"gain": 1.0 / (1.0 + s)})


def _resonance(rng: np.random.Generator, setting: Setting) -> Nature:
    # The strength is the reciprocal of the damping; only a larger noise can make this effect weak.
    frequency, damping = log_uniform(rng, 50.0, min(400.0, setting.rate / 5)), log_uniform(rng, 0.012, 0.08)
    return Nature(
        1 / (1.2 * damping),
        1.2 / damping,
        lambda s: Physics(flexure=Flexure(frequency, 1 / s)),
        lambda s: {"frequency": frequency, "damping": 1 / s},
    )


def _gain_drift(rng: np.random.Generator, setting: Setting) -> Nature:
    duration, sign = float(setting.t[-1]), float(rng.choice([-1.0, 1.0]))
    form = str(rng.choice(["ramp", "settling", "cycles", "sine"]))
    constant = {
        "settling": float(rng.uniform(0.15, 0.7)) * duration,
        "cycles": float(rng.uniform(0.15, 0.7)) * setting.travel,
        "sine": float(rng.uniform(1.0, 3.0)) * duration,
    }.get(form, 1.0)
    # Displacement that does not change: the rest position, or another one, depending on the mounting of the sensor.
    pivot = float(rng.choice([0.0, rng.uniform(0.0, 15e-6)]))

    def ageing(strength: float) -> Ageing:
        return Ageing(sign * strength, form, constant, pivot)

    times = np.linspace(0.0, duration, 41)[1:]

    def parameters(strength: float) -> dict[str, tuple[float, ...]]:
        course = ageing(strength).path(setting.t, setting.v)
        return {"times": tuple(times), "gains": tuple(np.interp(times, setting.t, course))}

    return Nature(1e-3, 0.1, lambda s: Physics(ageing=ageing(s)), parameters)


def _cross_coupling(rng: np.random.Generator, setting: Setting) -> Nature:
    sign = float(rng.choice([-1.0, 1.0]))
    return Nature(
        1e-3,
        3e-2,
        lambda s: Physics(coupling={setting.other: sign * s}),
        lambda s: {"gains": {setting.other: sign * s}},
    )


def _thermal_drift(rng: np.random.Generator, setting: Setting) -> Nature:
    duration, sign = float(setting.t[-1]), float(rng.choice([-1.0, 1.0]))
    form = str(rng.choice(["ramp", "settling", "sine", "wandering"]))
    time = float(rng.uniform(0.25, 1.0)) * duration if form == "settling" else max(45.0, rng.uniform(0.7, 3) * duration)
    phase, seed = float(rng.uniform(0, 2 * np.pi)), int(rng.integers(2**31))
    times = np.linspace(0.0, duration, 41)

    def temperature(strength: float) -> Temperature:
        return Temperature(sign * strength, form, time, phase, seed)

    return Nature(
        1e-8,
        5e-6,
        lambda s: Physics(temperature=temperature(s)),
        lambda s: {"times": tuple(times), "values": tuple(temperature(s).path(times))},
    )


def _steps(rng: np.random.Generator, setting: Setting) -> Nature:
    duration, count = float(setting.t[-1]), int(rng.integers(1, 5))
    # At least a fortieth of the record apart, so that it shows how far each went.
    moments = np.sort(0.1 * duration + 0.02 * duration * rng.choice(np.arange(40), count, replace=False))
    moments = tuple((moments + rng.uniform(0.0, 0.005, count) * duration).tolist())
    shares = rng.choice([-1.0, 1.0], count) * np.exp(rng.uniform(-0.7, 0.7, count))

    def distances(strength: float) -> tuple[float, ...]:
        return tuple((strength * shares).tolist())

    return Nature(
        2e-9,
        1e-6,
        lambda s: Physics(slips=Slips(moments, distances(s))),
        lambda s: {"times": moments, "sizes": distances(s)},
    )


def _sensor_periodic(rng: np.random.Generator, setting: Setting) -> Nature:
    period = float(rng.choice([158e-9, 266e-9, 316e-9, 388e-9, 633e-9]))
    phase = float(rng.uniform(-np.pi, np.pi))
    radians = period / (2 * np.pi)

    def interferometer(strength: float) -> Interferometer:
        return Interferometer(period, strength, phase, "offsets" if strength < 0.15 * radians else "sine")

    return Nature(
        0.02 * radians,
        0.6 * radians,
        lambda s: Physics(interferometer=interferometer(s)),
        lambda s: {"period": period, "amplitude": s, "phase": phase},
    )


def _hum(rng: np.random.Generator, setting: Setting) -> Nature:
    frequency = float(rng.choice([50.0, 60.0, 100.0, rng.uniform(30.0, 200.0)], p=[0.35, 0.25, 0.15, 0.25]))
    phase = float(rng.uniform(-np.pi, np.pi))
    return Nature(
        2e-9,
        1e-6,
        lambda s: Physics(hum=Hum(frequency, s, phase)),
        lambda s: {"frequency": frequency, "amplitude": s, "phase": phase},
    )


def _self_heating(rng: np.random.Generator, setting: Setting) -> Nature:
    # The strength is the largest change of the sensitivity in the record; with a rate of 1 V/s, that is its gain.
    sign = float(rng.choice([-1.0, 1.0]))
    time_constant = log_uniform(rng, 1.5, 0.5 * float(setting.t[-1]))
    pivot = float(rng.choice([0.0, rng.uniform(0.0, 15e-6)]))
    gain = sign / float(np.max(Warmth(1.0, 1.0, time_constant).path(setting.t, setting.v)))
    return Nature(
        1e-3,
        0.2,
        lambda s: Physics(warmth=Warmth(s * gain, 1.0, time_constant, pivot)),
        lambda s: {"gain": s * gain, "time_constant": time_constant},
    )


# A new one comes last: the place of a name is in the seeds of its draws.
DRAWS: dict[str, Callable[[np.random.Generator, Setting], Nature]] = {
    "delay": _delay,
    "lag": _lag,
    "saturation": _saturation,
    "rate_dependence": _rate_dependence,
    "creep": _creep,
    "resonance": _resonance,
    "cross_coupling": _cross_coupling,
    "thermal_drift": _thermal_drift,
    "sensor_periodic": _sensor_periodic,
    "hum": _hum,
    "gain_drift": _gain_drift,
    "steps": _steps,
    "slew": _slew,
    "contact": _contact,
    "self_heating": _self_heating,
}
NAMES = tuple(DRAWS)


def another_time(
    name: str, physics: Physics, parameters: Parameters, strength: float, setting: Setting, rng: np.random.Generator
) -> tuple[Physics, Parameters]:
    """Return physics and parameters that an effect has in another record of the same stage."""
    if name not in OWN:
        return physics, parameters
    if physics.hum:
        # Only the phase of the mains changes.
        phase = float(rng.uniform(-np.pi, np.pi))
        return Physics(hum=replace(physics.hum, phase=phase)), {**parameters, "phase": phase}
    nature = DRAWS[name](rng, setting)
    return nature.physics(strength), nature.parameters(strength)
