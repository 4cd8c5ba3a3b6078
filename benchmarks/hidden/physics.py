"""Physics of the records with hidden effects: Bouc-Wen stage, amplifier, rate dependence, ageing, disturbances."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from slpi_ros.errors import UsageError
from slpi_ros.simulation.dynamics import FlexureMode, Relaxation
from slpi_ros.simulation.parameters import AxisParameters
from slpi_ros.simulation.preisach import PreisachHysteresis
from slpi_ros.simulation.surroundings import Hum, Interferometer

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class BoucWen:
    """Displacement ``y = d v - h`` with ``dh = a d dv - b h |dv| - c |h| dv``: exponent 1, rate-independent.

    Between two reversals the equation is linear where the sign of ``h`` is constant, and is solved in closed form. It
    has no return-point memory: a minor loop does not return to its start.

    Parameters
    ----------
    gain : float, m/V
        Slope of the linear part, ``d``.
    share : float
        Initial slope of the hysteretic variable after a reversal, ``a``, as a share of `gain`, between 0 and 1.
    softening, asymmetry : float, 1/V
        Constants ``b`` and ``c``; ``b`` exceeds the magnitude of ``c``.
    offset : float, metres
        Displacement at rest at 0 V.

    References
    ----------
    T. S. Low, W. Guo, Modeling of a three-layer piezoelectric bimorph beam with hysteresis, J. MEMS 4 (1995).

    Raises
    ------
    UsageError
        If the parameters are invalid.
    """

    gain: float = 0.25e-6
    share: float = 0.35
    softening: float = 0.025
    asymmetry: float = 0.01
    offset: float = 0.0

    def __post_init__(self) -> None:
        """Validate the parameters."""
        if not (self.gain > 0 and 0 < self.share < 1 and self.softening > abs(self.asymmetry)):
            raise UsageError(f"stage: {self} is none; give more softening than asymmetry, and a share between 0 and 1")

    def run(self, v: FloatArray) -> FloatArray:
        """Return the displacement for a voltage signal, starting from rest at 0 V.

        Parameters
        ----------
        v : ndarray, shape (N,), volts
            Voltage, linear between samples.

        Returns
        -------
        ndarray, shape (N,), metres
            The displacement.
        """
        h, last, hysteretic = 0.0, 0.0, np.empty(v.size)
        for index, voltage in enumerate(v.tolist()):
            h = self._move(h, voltage - last)
            hysteretic[index], last = h, voltage
        return self.offset + self.gain * v - hysteretic

    def _move(self, h: float, dv: float) -> float:
        """Return the hysteretic variable (m) after a linear voltage change `dv` (V)."""
        # A fall is the mirror image of a rise.
        way, left = (1.0, dv) if dv >= 0 else (-1.0, -dv)
        h *= way
        slope = self.share * self.gain
        if h < 0.0:
            rate = self.softening - self.asymmetry
            to_zero = math.log1p(-h * rate / slope) / rate
            if to_zero >= left:
                return way * _relaxed(h, slope / rate, rate * left)
            h, left = 0.0, left - to_zero
        rate = self.softening + self.asymmetry
        return way * _relaxed(h, slope / rate, rate * left)


def _relaxed(start: float, end: float, constants: float) -> float:
    return end + (start - end) * math.exp(-constants)


@dataclass(frozen=True)
class Amplifier:
    """An amplifier between the recorded command and the piezo.

    Parameters
    ----------
    delay : float, seconds
        Delay of the command; a negative value means that the displacement is stamped late. Before the first sample the
        command is constant.
    lag : float, seconds
        Time constant; 0 for none.
    lower, upper : float, volts
        Limits of the output.
    softness : float, volts
        Distance from a limit at which the output starts to saturate; 0 for a sharp limit.
    slew : float, V/s
        Charge that its current brings into the piezo in a second, as a voltage.

    Raises
    ------
    UsageError
        If the parameters are invalid.
    """

    delay: float = 0.0
    lag: float = 0.0
    lower: float = -math.inf
    upper: float = math.inf
    softness: float = 0.0
    slew: float = math.inf

    def __post_init__(self) -> None:
        """Validate the parameters."""
        if not self.lower < self.upper or self.lag < 0 or self.softness < 0 or not math.isfinite(self.delay):
            raise UsageError(f"stage: {self} gives nothing; limits must be in order, lag and softness 0 or more")

    @property
    def clips(self) -> bool:
        """Whether any limit is finite."""
        return math.isfinite(self.lower) or math.isfinite(self.upper)

    def run(self, t: FloatArray, command: FloatArray) -> FloatArray:
        """Return the voltage at the piezo.

        Parameters
        ----------
        t : ndarray, shape (N,), seconds
            Non-decreasing times.
        command : ndarray, shape (N,), volts
            Command, linear between samples.

        Returns
        -------
        ndarray, shape (N,), volts
            Voltage at the piezo, at the same times.
        """
        late = np.interp(t - self.delay, t, command) if self.delay else command
        return self._clip(self._charged(t, self._lag(t, late)))

    def _charged(self, t: FloatArray, command: FloatArray) -> FloatArray:
        """Return the voltage of a piezo that is charged with a limited current, in ten steps a sample."""
        if math.isinf(self.slew) or t.size < 2:
            return command
        fine = np.interp(np.arange(10 * t.size - 9) / 10, np.arange(t.size), t)
        now, charged = float(command[0]), []
        for duration, wanted in zip(
            np.diff(fine, prepend=fine[0]).tolist(), np.interp(fine, t, command).tolist(), strict=True
        ):
            now += max(-self.slew * duration, min(self.slew * duration, wanted - now))
            charged.append(now)
        return np.array(charged[::10])

    def _lag(self, t: FloatArray, command: FloatArray) -> FloatArray:
        if not self.lag or not t.size:
            return command
        element, rest = Relaxation(np.array([self.lag])), float(command[0])
        steps = zip(np.diff(t, prepend=t[0]).tolist(), (command - rest).tolist(), strict=True)
        return np.array([rest + element.step(duration, value)[0] for duration, value in steps])

    def _clip(self, voltage: FloatArray) -> FloatArray:
        below = voltage - self._bent(voltage - self.upper)
        return below + self._bent(self.lower - below)

    def _bent(self, beyond: FloatArray) -> FloatArray:
        """Return the voltage (V) lost to saturation, for a voltage that exceeds a limit by `beyond` (V)."""
        if not self.softness:
            return np.maximum(beyond, 0.0)
        return self.softness * np.logaddexp(0.0, beyond / self.softness)


@dataclass(frozen=True)
class RateLaw:
    """Rate dependence of a coercivity: a power law, or a logarithmic law as for thermally activated domain walls.

    Parameters
    ----------
    strength : float
        Growth at the reference rate, in the unit of the growing quantity.
    reference_rate : float, V/s
        Rate at which the growth is `strength`.
    exponent : float
        Exponent of the power law; 0 selects the logarithmic law.
    onset : float, V/s
        Rate below which the logarithmic law is linear.
    settling : float, seconds
        Time constant of the rate filter.
    """

    strength: float
    reference_rate: float = 100.0
    exponent: float = 0.0
    onset: float = 5.0
    settling: float = 0.005

    def growth(self, t: FloatArray, v: FloatArray) -> FloatArray:
        """Return the growth, shape (N,), along voltages `v` (V) at times `t` (s), shape (N,) each."""
        # Between samples the voltage is linear: no stage knows the next sample.
        rate = _settled(t, np.abs(np.diff(v, prepend=v[:1]) / np.diff(t, prepend=-np.inf)), self.settling)
        if self.exponent:
            return np.asarray(self.strength * (rate / self.reference_rate) ** self.exponent, dtype=np.float64)
        return np.asarray(
            self.strength * np.log1p(rate / self.onset) / np.log1p(self.reference_rate / self.onset), dtype=np.float64
        )


@dataclass(frozen=True)
class Viscosity:
    """Rate-dependent switching of domain walls.

    Parameters
    ----------
    law : RateLaw
        Rate law, in volts for ``coercivity``, in metres for ``friction``.
    form : {"coercivity", "friction"}
        ``coercivity``: the thresholds of every relay move apart by the growth, so that the relays receive the voltage
        through a play operator of that half-width. ``friction``: a drag whose magnitude is the growth and whose
        direction follows that of the voltage over `transition`.
    transition : float, volts
        Decay constant of the friction direction after a reversal.
    """

    law: RateLaw
    form: Literal["coercivity", "friction"] = "coercivity"
    transition: float = 6.0

    def relay_voltage(self, t: FloatArray, v: FloatArray) -> FloatArray:
        """Return the voltage at the relays, shape (N,), volts."""
        if self.form != "coercivity":
            return v
        half_width = self.law.growth(t, v)
        lowest, highest = (v - half_width).tolist(), (v + half_width).tolist()
        seen, played = np.empty_like(v), float(v[0]) if v.size else 0.0
        for index, (low, high) in enumerate(zip(lowest, highest, strict=True)):
            played = min(max(played, low), high)
            seen[index] = played
        return seen

    def drag(self, t: FloatArray, v: FloatArray) -> FloatArray:
        """Return the displacement lost to friction, shape (N,), metres."""
        if self.form != "friction":
            return np.zeros_like(v)
        direction, now = np.empty_like(v), 0.0
        for index, move in enumerate(np.diff(v, prepend=v[:1]).tolist()):
            way = 1.0 if move > 0 else -1.0
            now = way + (now - way) * float(np.exp(-abs(move) / self.transition))
            direction[index] = now
        return self.law.growth(t, v) * direction


def _settled(t: FloatArray, x: FloatArray, time_constant: float) -> FloatArray:
    """Return `x` after a first-order low-pass filter, with each sample held over the preceding interval."""
    settled, now = np.empty_like(x), float(x[0]) if x.size else 0.0
    left = np.exp(-np.diff(t, prepend=t[:1]) / time_constant).tolist()
    for index, (share, value) in enumerate(zip(left, x.tolist(), strict=True)):
        now = value + (now - value) * share
        settled[index] = now
    return settled


@dataclass(frozen=True)
class Ageing:
    """Time-dependent sensitivity: depolarisation, run-in, or warm-up of the piezo.

    Parameters
    ----------
    change : float
        Largest relative change of the sensitivity within the record, signed.
    form : {"ramp", "settling", "cycles", "sine"}
        Linear in time; exponential in time; exponential in the accumulated voltage change; sinusoidal.
    constant : float
        Time constant of ``settling`` (s), travel constant of ``cycles`` (V), period of ``sine`` (s).
    pivot : float, metres
        Displacement, relative to rest, that is independent of the sensitivity.
    """

    change: float
    form: Literal["ramp", "settling", "cycles", "sine"] = "ramp"
    constant: float = 60.0
    pivot: float = 0.0

    def path(self, t: FloatArray, v: FloatArray) -> FloatArray:
        """Return the relative change from the start, shape (N,), for times `t` (s) and voltages `v` (V)."""
        match self.form:
            case "ramp":
                course = t - t[0]
            case "settling":
                course = -np.expm1(-(t - t[0]) / self.constant)
            case "cycles":
                course = -np.expm1(-np.cumsum(np.abs(np.diff(v, prepend=v[:1]))) / self.constant)
            case "sine":
                course = np.sin(2 * np.pi * (t - t[0]) / self.constant)
        return np.asarray(self.change * course / max(float(np.max(np.abs(course))), 1e-300), dtype=np.float64)

    def scaled(self, t: FloatArray, v: FloatArray, y: FloatArray) -> FloatArray:
        """Return the displacement with the changed sensitivity, shape (N,), metres."""
        return self.pivot + (1.0 + self.path(t, v)) * (y - self.pivot)


# Steps a sample in which the temperature of a stage that warms itself is integrated.
_FINE = 4


@dataclass(frozen=True)
class Warmth:
    """A piezo that warms itself: the loss of each moment goes into its heat capacity, and out to its mount.

    Parameters
    ----------
    change : float
        Relative change of the sensitivity in the end, signed, while the voltage changes at `rate`.
    rate : float, V/s
    time_constant : float, seconds
        Heat capacity over the conductance to the mount, which stays as warm as it is.
    pivot : float, metres
        Displacement, relative to rest, that is independent of the sensitivity.
    """

    change: float
    rate: float
    time_constant: float
    pivot: float = 0.0

    def path(self, t: FloatArray, v: FloatArray) -> FloatArray:
        """Return the relative change of the sensitivity, shape (N,), for voltages `v` (V) at times `t` (s)."""
        # The current, and with it the loss, is that of the mean rate about each moment; the midpoint rule.
        fine = np.interp(np.arange(_FINE * (t.size - 1) + 1) / _FINE, np.arange(t.size), t)
        rate = np.gradient(v, t) / self.rate
        power = np.interp(0.5 * (fine[1:] + fine[:-1]), t, rate**2)
        warmth, now = [0.0], 0.0
        for duration, loss in zip(np.diff(fine).tolist(), power.tolist(), strict=True):
            half = now + 0.5 * duration * (loss - now) / self.time_constant
            now += duration * (loss - half) / self.time_constant
            warmth.append(now)
        return self.change * np.array(warmth[::_FINE])

    def scaled(self, t: FloatArray, v: FloatArray, y: FloatArray) -> FloatArray:
        """Return the displacement with the changed sensitivity, shape (N,), metres."""
        return self.pivot + (1.0 + self.path(t, v)) * (y - self.pivot)


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
class Slips:
    """A mount, or a counter of fringes, that gives way at some moments.

    Parameters
    ----------
    moments : tuple of float, seconds
        From the start of the record.
    distances : tuple of float, metres
    """

    moments: tuple[float, ...]
    distances: tuple[float, ...]

    def path(self, t: FloatArray) -> FloatArray:
        """Return how far it has slipped, shape (N,), metres, at times `t` from 0 on, shape (N,), seconds."""
        gone = np.zeros_like(t)
        for moment, distance in zip(self.moments, self.distances, strict=True):
            gone[t > moment] += distance
        return gone


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
class Stop:
    """A spring that the stage meets, such as a sample or a stop.

    Parameters
    ----------
    at : float, metres
        Displacement, relative to rest, at which the stage meets it.
    stiffness : float
        Its stiffness over that of the stage.
    """

    at: float
    stiffness: float

    def pushed(self, y: FloatArray) -> FloatArray:
        """Return where the stage comes to, shape (N,), metres, that would come to `y` (m) by itself."""
        return y - self.stiffness / (1.0 + self.stiffness) * np.maximum(y - self.at, 0.0)


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
    stop : Stop, optional
    flexure : Flexure, optional
    warmth : Warmth, optional
    ageing : Ageing, optional
    coupling : mapping of axis name to float
        Share of the motion of another axis, relative to its start, that is added to this axis.
    temperature : Temperature, optional
    slips : Slips, optional
    interferometer : Interferometer, optional
    hum : Hum, optional
    """

    amplifier: Amplifier | None = None
    viscosity: Viscosity | None = None
    creep: SlowDomains | None = None
    stop: Stop | None = None
    flexure: Flexure | None = None
    warmth: Warmth | None = None
    ageing: Ageing | None = None
    coupling: Mapping[str, float] = field(default_factory=dict)
    temperature: Temperature | None = None
    slips: Slips | None = None
    interferometer: Interferometer | None = None
    hum: Hum | None = None


def own_motion(base: AxisParameters | BoucWen, physics: Physics, t: FloatArray, command: FloatArray) -> FloatArray:
    """Return the displacement of one axis for a voltage command, starting from rest at 0 V.

    Parameters
    ----------
    base : AxisParameters or BoucWen
        Hysteresis of the axis; the sensor of AxisParameters is not used.
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
    if physics.stop:
        y = physics.stop.pushed(y)
    if physics.flexure:
        y = ringing(physics.flexure, t, y)
    if physics.warmth:
        y = physics.warmth.scaled(t, v, y)
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
    if physics.slips:
        y = y + physics.slips.path(t - t[0])
    if physics.interferometer:
        y = physics.interferometer.read(y)
    if physics.hum:
        y = y + physics.hum.path(t - t[0])
    return y


def _hysteresis(
    base: AxisParameters | BoucWen, viscosity: Viscosity | None, t: FloatArray, v: FloatArray
) -> FloatArray:
    seen = viscosity.relay_voltage(t, v) if viscosity else v
    if isinstance(base, BoucWen):
        return base.run(seen)
    hysteresis, relays = PreisachHysteresis(base), np.clip(seen, base.threshold_min, base.threshold_max)
    return base.offset + np.array([hysteresis.step(*both) for both in zip(v.tolist(), relays.tolist(), strict=True)])


def _creeping(domains: SlowDomains, t: FloatArray, y: FloatArray) -> FloatArray:
    gains, elements = np.array(domains.gains), Relaxation(np.array(domains.time_constants))
    steps = zip(np.diff(t, prepend=t[:1]).tolist(), y.tolist(), strict=True)
    return np.array([value + float(gains @ elements.step(duration, value)) for duration, value in steps])


def ringing(flexure: Flexure, t: FloatArray, y: FloatArray) -> FloatArray:
    mode = FlexureMode(flexure.frequency, flexure.damping)
    steps = zip(np.diff(t, prepend=t[:1]).tolist(), y.tolist(), strict=True)
    return np.array([mode.step(duration, value) for duration, value in steps])
