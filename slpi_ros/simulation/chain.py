"""A stage of which everything that may go wrong can be chosen: amplifier, walls, creep, flexure, surroundings."""

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
    """A lightly damped mode.

    Parameters
    ----------
    frequency : float, hertz
        Undamped.
    damping : float
        Damping ratio, 0 to below 1.
    """

    frequency: float
    damping: float


@dataclass(frozen=True)
class SlowDomains:
    """Domains that follow the fast displacement each in its own time.

    Parameters
    ----------
    time_constants : tuple of float, seconds
    gains : tuple of float
        What each adds in the end, as a share of the fast displacement.
    """

    time_constants: tuple[float, ...]
    gains: tuple[float, ...]


@dataclass(frozen=True)
class Physics:
    """What an axis has beside its hysteresis; each part may be absent.

    Parameters
    ----------
    amplifier : Amplifier, optional
    viscosity : Viscosity, optional
        Its ``coercivity`` only with a stage of relays.
    creep : SlowDomains, optional
    flexure : Flexure, optional
    ageing : Ageing, optional
    coupling : mapping of axis name to float
        Share of another axis's motion from its start that shows on this one.
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
    """Drive one axis from rest at 0 V.

    Parameters
    ----------
    base : StageParameters or BoucWen
        Its hysteresis; the dynamics and the sensor of StageParameters are left out.
    physics : Physics
        Everything else, of which what comes before the coupling is used.
    t : ndarray, shape (N,), seconds
        In order.
    command : ndarray, shape (N,), volts
        What the record says.

    Returns
    -------
    ndarray, shape (N,), metres
        Displacement of the axis by itself.
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
    """Return what the sensor of one axis shows, but for its noise.

    Parameters
    ----------
    physics : Physics
        Of this axis.
    t : ndarray, shape (N,), seconds
        In order; drift and hum count from its first.
    motion : mapping of axis name to ndarray, shape (N,), metres
        From `own_motion`, of every axis.
    axis : str
        This one.

    Returns
    -------
    ndarray, shape (N,), metres
        The reading.
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
