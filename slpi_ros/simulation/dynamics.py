"""What makes a stage depend on time: the amplifier before the hysteresis, creep and a flexure mode behind it."""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from slpi_ros.errors import UsageError
from slpi_ros.simulation.parameters import StageParameters

FloatArray = NDArray[np.float64]

# Seconds. In less time an input jumps: its slope would cost the state its last digits.
SHORTEST_STEP = 1e-12


class Relaxation:
    """Elements that each follow one common input with a time constant of their own, ``tau_j dz_j/dt = u - z_j``.

    The update is exact, for steps of any length, where the input is linear between two samples (first-order hold).

    Parameters
    ----------
    time_constants : ndarray, shape (n,), seconds
        More than 0.
    """

    def __init__(self, time_constants: FloatArray) -> None:
        self._rate = 1.0 / time_constants
        self.rest()

    def rest(self) -> None:
        """Return to rest: input and elements at 0."""
        self._input = 0.0
        self._state: FloatArray = np.zeros_like(self._rate)

    def step(self, duration: float, value: float) -> FloatArray:
        """Let time pass while the input goes to a value.

        Parameters
        ----------
        duration : float, seconds
            0 or more; in less than `SHORTEST_STEP` the input jumps and the elements stay.
        value : float
            The input at the end of the step.

        Returns
        -------
        ndarray, shape (n,), in the unit of the input
            The elements at the end of the step.
        """
        if duration >= SHORTEST_STEP:
            x = duration * self._rate
            left = self._state - self._input
            self._state = value + np.exp(-x) * left + np.expm1(-x) / x * (value - self._input)
        self._input = value
        return self._state


@dataclass(frozen=True)
class Amplifier:
    """An amplifier between the recorded command and the piezo.

    Parameters
    ----------
    delay : float, seconds
        By which the command comes late; less than 0: the displacement is stamped late. Before the first sample the
        command was what it is there.
    lag : float, seconds
        Time constant; 0 for none.
    lower, upper : float, volts
        What it can give at least and at most.
    softness : float, volts
        Width of the bend before either limit: within about this distance of it, the output falls behind already; 0 for
        a sharp one.

    Raises
    ------
    UsageError
        If no command gets through.
    """

    delay: float = 0.0
    lag: float = 0.0
    lower: float = -math.inf
    upper: float = math.inf
    softness: float = 0.0

    def __post_init__(self) -> None:
        """Refuse what is no amplifier."""
        if not self.lower < self.upper or self.lag < 0 or self.softness < 0 or not math.isfinite(self.delay):
            raise UsageError(f"stage: {self} gives nothing; limits must be in order, lag and softness 0 or more")

    @property
    def clips(self) -> bool:
        """Whether there is a limit."""
        return math.isfinite(self.lower) or math.isfinite(self.upper)

    def run(self, t: FloatArray, command: FloatArray) -> FloatArray:
        """Return the voltage at the piezo.

        Parameters
        ----------
        t : ndarray, shape (N,), seconds
            In order.
        command : ndarray, shape (N,), volts
            Linear between samples.

        Returns
        -------
        ndarray, shape (N,), volts
            At the same times.
        """
        return self._clip(self._lag(t, np.interp(t - self.delay, t, command) if self.delay else command))

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
        """Return how much of a voltage is lost that goes so far beyond a limit, volts."""
        if not self.softness:
            return np.maximum(beyond, 0.0)
        return self.softness * np.logaddexp(0.0, beyond / self.softness)


class FlexureMode:
    """A second-order mode, ``d2x/dt2 + 2 z w dx/dt + w^2 x = w^2 u``, with a static gain of 1.

    The update is exact, for steps of any length, where the input is linear between two samples (first-order hold): the
    steady answer to the ramp is known, and what differs from it decays by the closed form of the matrix exponential.

    Parameters
    ----------
    frequency : float, hertz
        Undamped, ``w / 2 pi``.
    damping : float
        Damping ratio ``z``, from 0 to below 1.
    """

    def __init__(self, frequency: float, damping: float) -> None:
        self._omega = 2 * math.pi * frequency
        self._damping = damping
        self.rest()

    def rest(self) -> None:
        """Return to rest at 0."""
        self._input = self._position = self._velocity = 0.0

    def step(self, duration: float, value: float) -> float:
        """Let time pass while the input goes to a value.

        Parameters
        ----------
        duration : float, seconds
            0 or more; in less than `SHORTEST_STEP` the input jumps and the mass stays.
        value : float, metres
            The input at the end of the step.

        Returns
        -------
        float, metres
            Position of the mass at the end of the step.
        """
        if duration >= SHORTEST_STEP:
            slope = (value - self._input) / duration
            lag = 2 * self._damping * slope / self._omega
            position, velocity = self._ringing(duration, self._position - self._input + lag, self._velocity - slope)
            self._position, self._velocity = value - lag + position, slope + velocity
        self._input = value
        return self._position

    def _ringing(self, duration: float, position: float, velocity: float) -> tuple[float, float]:
        """Return position and velocity of the free motion from the given ones."""
        decay_rate = self._damping * self._omega
        ringing_rate = self._omega * math.sqrt(1 - self._damping**2)
        decay = math.exp(-decay_rate * duration)
        cosine, sine = math.cos(ringing_rate * duration), math.sin(ringing_rate * duration) / ringing_rate
        return (
            decay * (position * cosine + (velocity + decay_rate * position) * sine),
            decay * (velocity * cosine - (self._omega**2 * position + decay_rate * velocity) * sine),
        )


_ELEMENTS_PER_DECADE = 2


class Creep:
    """Log-time creep: a chain of relaxations whose time constants are evenly spaced in log time.

    The displacement is ``y = h + sum_j g_j z_j`` with ``tau_j dz_j/dt = h - z_j``, exact where ``h`` is linear between
    samples. All ``g_j`` are alike, so that after a step of ``h`` the displacement grows by `gain` of it in each decade
    between `shortest` and `longest`. Under periodic drive the peaks fall as ``f^b``, with ``b`` near ``-gain / ln 10``.

    Parameters
    ----------
    gain : float
        Creep in one decade of time, as a share of ``h``.
    shortest, longest : float, seconds
        Between these the time constants lie; longer than the first, the creep is over.

    Attributes
    ----------
    time_constants : ndarray, shape (n,), seconds
        Two or more for each decade.
    gains : ndarray, shape (n,)
        Shares of ``h``; their sum is `gain` times the number of decades.
    """

    def __init__(self, gain: float, shortest: float, longest: float) -> None:
        decades = math.log10(longest / shortest)
        count = math.ceil(_ELEMENTS_PER_DECADE * decades)
        self.time_constants = shortest * 10 ** (decades * (np.arange(count) + 0.5) / count)
        self.gains = np.full(count, gain * decades / count)
        self._chain = Relaxation(self.time_constants)

    def rest(self) -> None:
        """Forget the past, as after a long time at 0."""
        self._chain.rest()

    def step(self, duration: float, value: float) -> float:
        """Let time pass while the hysteresis goes to a value.

        Parameters
        ----------
        duration : float, seconds
            0 or more.
        value : float, metres
            Displacement without creep at the end of the step.

        Returns
        -------
        float, metres
            Displacement with creep.
        """
        return value + float(self.gains @ self._chain.step(duration, value))

    def after_ramp(self, duration: float) -> float:
        """Return what a ramp from rest has become at its end, as a multiple of its end without creep.

        Parameters
        ----------
        duration : float, seconds
            Of the ramp, more than 0.

        Returns
        -------
        float
            1 plus the creep.
        """
        chain = Relaxation(self.time_constants)
        return 1.0 + float(self.gains @ chain.step(duration, 1.0))


class Dynamics:
    """Amplifier lag, creep and flexure mode of one axis; each may be absent.

    Parameters
    ----------
    parameters : StageParameters
        Of which `amplifier_lag`, the ones of creep and those of the resonance are used.
    """

    def __init__(self, parameters: StageParameters) -> None:
        p = parameters
        self._amplifier = Relaxation(np.array([p.amplifier_lag])) if p.amplifier_lag else None
        self._creep = Creep(p.creep_gain, p.creep_shortest, p.creep_longest) if p.creep_gain else None
        self._mode = FlexureMode(p.resonance_frequency, p.resonance_damping) if p.resonance_frequency else None
        self.rest()

    def rest(self) -> None:
        """Forget the past and the time."""
        self._time: float | None = None
        for part in (self._amplifier, self._creep, self._mode):
            if part:
                part.rest()

    def advance(self, t: float) -> float:
        """Set the clock.

        Parameters
        ----------
        t : float, seconds
            Not before the last one.

        Returns
        -------
        float, seconds
            Time passed since the last call; 0 for the first one after rest.

        Raises
        ------
        UsageError
            If the time is not finite or before the last one.
        """
        last = t if self._time is None else self._time
        if not last <= t < math.inf:
            raise UsageError(f"stage: time {t} s after {last} s; times must be finite and never go back")
        self._time = t
        return t - last

    def amplify(self, duration: float, command: float) -> float:
        """Return the voltage at the piezo (V) once the command (V) has been reached in `duration` (s)."""
        return float(self._amplifier.step(duration, command)[0]) if self._amplifier else command

    def follow(self, duration: float, displacement: float) -> float:
        """Return where the stage is (m) once the hysteresis has gone to `displacement` (m) in `duration` (s)."""
        crept = self._creep.step(duration, displacement) if self._creep else displacement
        return self._mode.step(duration, crept) if self._mode else crept


@dataclass(frozen=True)
class Ageing:
    """A sensitivity that is not the same all along: the piezo depolarises, runs itself in, or warms up and cools down.

    Parameters
    ----------
    change : float
        Largest relative change of the sensitivity within the record, with its sign.
    form : {"ramp", "settling", "cycles", "sine"}
        A straight line in time; an exponential approach in time; one in the voltage travelled; a slow sine.
    constant : float
        Time constant of ``settling`` (s), travel constant of ``cycles`` (V), period of ``sine`` (s).
    pivot : float, metres
        Displacement from rest that keeps its place.
    """

    change: float
    form: Literal["ramp", "settling", "cycles", "sine"] = "ramp"
    constant: float = 60.0
    pivot: float = 0.0

    def path(self, t: FloatArray, v: FloatArray) -> FloatArray:
        """Return the relative change, shape (N,), at times (s) with voltages (V), shape (N,) each; 0 at the start."""
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
        """Return what becomes of a displacement from rest, shape (N,), metres."""
        return self.pivot + (1.0 + self.path(t, v)) * (y - self.pivot)


@dataclass(frozen=True)
class RateLaw:
    """How a coercivity grows with the rate: by a power, or logarithmically as thermally activated domain walls do.

    Parameters
    ----------
    strength : float
        Growth at the reference rate, in the unit of what grows.
    reference_rate : float, V/s
        At this rate the growth is `strength`.
    exponent : float
        Of the power law; 0 for the logarithmic one.
    onset : float, V/s
        Below this rate the logarithmic law is linear.
    settling : float, seconds
        Time constant with which walls get used to another rate.
    """

    strength: float
    reference_rate: float = 100.0
    exponent: float = 0.0
    onset: float = 5.0
    settling: float = 0.005

    def growth(self, t: FloatArray, v: FloatArray) -> FloatArray:
        """Return the growth along a path, shape (N,), of voltages (V) at times (s)."""
        rate = _settled(t, np.abs(np.gradient(v, t)), self.settling)
        if self.exponent:
            return np.asarray(self.strength * (rate / self.reference_rate) ** self.exponent, dtype=np.float64)
        return np.asarray(
            self.strength * np.log1p(rate / self.onset) / np.log1p(self.reference_rate / self.onset), dtype=np.float64
        )


@dataclass(frozen=True)
class Viscosity:
    """Domain walls that switch later the faster the voltage moves.

    Parameters
    ----------
    law : RateLaw
        In volts for ``coercivity``, in metres for ``friction``.
    form : {"coercivity", "friction"}
        ``coercivity``: every relay's thresholds move apart, each by the growth, so that relays see the voltage through
        a play of that half-width. ``friction``: walls drag the stage behind by a force whose direction follows the
        voltage over `transition`, and whose size is the growth.
    transition : float, volts
        Constant of the exponential with which the friction turns round.
    """

    law: RateLaw
    form: Literal["coercivity", "friction"] = "coercivity"
    transition: float = 6.0

    def relay_voltage(self, t: FloatArray, v: FloatArray) -> FloatArray:
        """Return the voltage that the relays see, shape (N,), V."""
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
        """Return by how much the stage is pulled back, shape (N,), metres."""
        if self.form != "friction":
            return np.zeros_like(v)
        direction, now = np.empty_like(v), 0.0
        for index, move in enumerate(np.diff(v, prepend=v[:1]).tolist()):
            way = 1.0 if move > 0 else -1.0
            now = way + (now - way) * float(np.exp(-abs(move) / self.transition))
            direction[index] = now
        return self.law.growth(t, v) * direction


def _settled(t: FloatArray, x: FloatArray, time_constant: float) -> FloatArray:
    """Return `x` as an element follows it that takes each sample as held since the last."""
    settled, now = np.empty_like(x), float(x[0]) if x.size else 0.0
    left = np.exp(-np.diff(t, prepend=t[:1]) / time_constant).tolist()
    for index, (share, value) in enumerate(zip(left, x.tolist(), strict=True)):
        now = value + (now - value) * share
        settled[index] = now
    return settled
