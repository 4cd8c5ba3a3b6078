"""A stage with selectable physics: amplifier, rate dependence, creep, flexure mode, and environmental disturbances."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from slpi_ros.simulation.bouc_wen import BoucWen
from slpi_ros.simulation.dynamics import Ageing, Amplifier, FlexureMode, Relaxation, Viscosity
from slpi_ros.simulation.parameters import StageParameters
from slpi_ros.simulation.preisach import PreisachStage
from slpi_ros.simulation.sensor import Hum, Interferometer, Temperature

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Flexure:
    """A lightly damped second-order mode.

    Parameters
    ----------
    frequency : float, hertz
        Undamped natural frequency.
    damping : float
        Damping ratio, 0 to below 1.
    """

    frequency: float
    damping: float


@dataclass(frozen=True)
class SlowDomains:
    """Slow domains, each of which follows the fast displacement with its own time constant.

    Parameters
    ----------
    time_constants : tuple of float, seconds
    gains : tuple of float
        Final contribution of each domain, as a share of the fast displacement.
    """

    time_constants: tuple[float, ...]
    gains: tuple[float, ...]


@dataclass(frozen=True)
class Physics:
    """Physics of an axis other than its hysteresis; each part is optional.

    Parameters
    ----------
    amplifier : Amplifier, optional
    viscosity : Viscosity, optional
        Rate dependence; the form ``coercivity`` requires a Preisach stage.
    creep : SlowDomains, optional
    flexure : Flexure, optional
    ageing : Ageing, optional
    coupling : mapping of axis name to float
        Share of the motion of another axis, relative to its start, that is added to this axis.
    temperature : Temperature, optional
    interferometer : Interferometer, optional
    hum : Hum, optional
    """

    amplifier: Amplifier | None = None
    viscosity: Viscosity | None = None
    creep: SlowDomains | None = None
    flexure: Flexure | None = None
    ageing: Ageing | None = None
    coupling: Mapping[str, float] = field(default_factory=dict)
    temperature: Temperature | None = None
    interferometer: Interferometer | None = None
    hum: Hum | None = None


def own_motion(base: StageParameters | BoucWen, physics: Physics, t: FloatArray, command: FloatArray) -> FloatArray:
    """Return the displacement of one axis for a voltage command, starting from rest at 0 V.

    Parameters
    ----------
    base : StageParameters or BoucWen
        Hysteresis of the axis; dynamics and sensor of StageParameters are not used.
    physics : Physics
        Other physics; only the parts before the coupling are used.
    t : ndarray, shape (N,), seconds
        Non-decreasing times.
    command : ndarray, shape (N,), volts
        Voltage command, as recorded.

    Returns
    -------
    ndarray, shape (N,), metres
        Displacement of the axis before coupling.
    """
    v = physics.amplifier.run(t, command) if physics.amplifier else command
    y = _hysteresis(base, physics.viscosity, t, v) - base.offset
    if physics.viscosity:
        y = y - physics.viscosity.drag(t, v)
    if physics.creep:
        y = _creeping(physics.creep, t, y)
    if physics.flexure:
        y = _ringing(physics.flexure, t, y)
    if physics.ageing:
        y = physics.ageing.scaled(t, v, y)
    return base.offset + y


def sensed(physics: Physics, t: FloatArray, motion: Mapping[str, FloatArray], axis: str) -> FloatArray:
    """Return the sensor reading of one axis without noise.

    Parameters
    ----------
    physics : Physics
        Physics of this axis.
    t : ndarray, shape (N,), seconds
        Non-decreasing times; drift and hum start at the first one.
    motion : mapping of axis name to ndarray, shape (N,), metres
        Displacement of every axis from `own_motion`.
    axis : str
        Name of this axis.

    Returns
    -------
    ndarray, shape (N,), metres
        Sensor reading.
    """
    y = motion[axis]
    for other, gain in physics.coupling.items():
        y = y + gain * (motion[other] - motion[other][0])
    if physics.temperature:
        y = y + physics.temperature.path(t)
    if physics.interferometer:
        y = physics.interferometer.read(y)
    if physics.hum:
        y = y + physics.hum.path(t - t[0])
    return y


def _hysteresis(
    base: StageParameters | BoucWen, viscosity: Viscosity | None, t: FloatArray, v: FloatArray
) -> FloatArray:
    seen = viscosity.relay_voltage(t, v) if viscosity else v
    if isinstance(base, BoucWen):
        return base.run(seen)
    return PreisachStage(base).respond(v, np.clip(seen, base.threshold_min, base.threshold_max))


def _creeping(domains: SlowDomains, t: FloatArray, y: FloatArray) -> FloatArray:
    gains, elements = np.array(domains.gains), Relaxation(np.array(domains.time_constants))
    steps = zip(np.diff(t, prepend=t[:1]).tolist(), y.tolist(), strict=True)
    return np.array([value + float(gains @ elements.step(duration, value)) for duration, value in steps])


def _ringing(flexure: Flexure, t: FloatArray, y: FloatArray) -> FloatArray:
    mode = FlexureMode(flexure.frequency, flexure.damping)
    steps = zip(np.diff(t, prepend=t[:1]).tolist(), y.tolist(), strict=True)
    return np.array([mode.step(duration, value) for duration, value in steps])
