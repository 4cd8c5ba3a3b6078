"""Linear filters: first-order hold of a lag, second-order mode, and resampling to a uniform grid."""

from dataclasses import dataclass
from functools import cached_property
from math import cos, exp, expm1, pi, sin, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slpi_ros.arrays import FloatArray
from slpi_ros.effects.parameters import Fit, parameter

# Below this ratio of step to time constant a series is used, because differences lose precision.
_SMALL = 1e-3
# Stamps are uniform if their intervals deviate by less than this share of the median interval.
EVEN = 0.01
# Largest number of grid points per sample.
FINEST = 4
# Smallest share of the motion of a fitted mode: smaller ones, near the drive, imitate errors of the hysteresis.
LEAST_GAIN = 0.01
# The exact inverse of the first-order hold oscillates from sample to sample after every reversal. Moving this share
# of the previous input's weight to the present input damps the oscillation to a third per sample; ramps stay exact.
DAMPING = 1 / 8
# Below this step times the frequency (rad/s) a mode's response to a step is computed as a series of so many terms.
SERIES, TERMS = 0.1, 16
# Up to this difference of the squared damping from 1 both poles count as one.
EQUAL = 1e-12
# From this step times the frequency (rad/s) on a mode is not resolved, and only its lag is compensated.
WIDEST = 3.0
# Smallest spacing of the taps of the inverse of a mode, in units of 1 / w: smaller ones only make larger taps.
SPACING = 0.5


class Hold(NamedTuple):
    """Coefficients of one step of a first-order lag, ``z1 = now u1 + before u0 + kept z0``, with sum 1."""

    now: float
    before: float
    kept: float


class Dynamics(NamedTuple):
    """Linear dynamics of n states with static gain 1: ``dx/dt = a x + b u``, ``y = c x + d u``."""

    a: FloatArray  # (n, n), 1/s
    b: FloatArray  # (n,), 1/s
    c: FloatArray  # (n,)
    d: float

    def then(self, other: "Dynamics") -> "Dynamics":
        """Return these dynamics followed by others."""
        across = np.outer(other.b, self.c)
        a = np.block([[self.a, np.zeros_like(across.T)], [across, other.a]])
        b, c = np.concatenate([self.b, other.b * self.d]), np.concatenate([other.d * self.c, other.c])
        return Dynamics(a, b, c, self.d * other.d)


# What follows at once.
AT_ONCE = Dynamics(np.empty((0, 0)), np.empty(0), np.empty(0), 1.0)


def first_order(time_constant: float) -> Dynamics:
    """Return the dynamics of a first-order lag (s)."""
    rate = 1.0 / time_constant
    return Dynamics(np.array([[-rate]]), np.array([rate]), np.ones(1), 0.0)


def hold(dt: float, time_constant: float) -> Hold:
    """Return the coefficients of a first-order lag over `dt` (s); for ``dt = 0`` the output is unchanged."""
    x = dt / time_constant
    moved = -expm1(-x)
    now = x * (1 / 2 - x * (1 / 6 - x * (1 / 24 - x / 120))) if x < _SMALL else 1 - moved / x
    return Hold(now, moved - now, exp(-x))


def mode_transition(omega: float, damping: float, dt: float) -> tuple[float, float, float, float]:
    """Return the state transition matrix of position and velocity of a mode over `dt` (s), row by row."""
    decay_rate, square = damping * omega, 1 - damping * damping
    if square > 0.0:
        rate, decay = omega * sqrt(square), exp(-decay_rate * dt)
        cosine, sine = decay * cos(rate * dt), decay * sin(rate * dt) / rate
    elif square < 0.0:
        # Two lags; `slow` is the smaller pole without a difference of two that are nearly equal.
        rate = omega * sqrt(-square)
        slow, apart = exp(-(omega * omega) / (decay_rate + rate) * dt), -expm1(-2 * rate * dt)
        cosine, sine = slow * (1 - apart / 2), slow * apart / (2 * rate)
    else:
        cosine = exp(-decay_rate * dt)
        sine = dt * cosine
    return cosine + decay_rate * sine, sine, -(omega * omega) * sine, cosine - decay_rate * sine


def mode_poles(omega: float, damping: float, dt: float) -> tuple[float, float]:
    """Return sum and product of the two discrete poles ``exp(s dt)`` of a mode."""
    square = 1 - damping * damping
    if square >= 0.0:
        decay = exp(-damping * omega * dt)
        return 2 * decay * cos(omega * sqrt(square) * dt), decay * decay
    fast = damping * omega + omega * sqrt(-square)
    return exp(-omega * omega / fast * dt) + exp(-fast * dt), exp(-2 * damping * omega * dt)


def filtered(numerator: ArrayLike, denominator: ArrayLike, signal: FloatArray) -> FloatArray:
    """Filter a signal, shape (N,), with a discrete transfer function, from a zero state."""
    # Imported here because it takes a second and nodes, which filter sample by sample, do not need it.
    from scipy.signal import lfilter

    return np.asarray(lfilter(numerator, denominator, signal), dtype=np.float64)


@dataclass(frozen=True)
class Mode:
    """Second-order mode ``y'' + 2 z w y' + w^2 y = w^2 h``, ``w = 2 pi frequency``."""

    frequency: float = parameter("Hz", "frequency", 1e-3, 1e7, fit=Fit("relative", least=1e-3))
    # Above 1 it is two lags, at 2 nearly one, behind the hysteresis, which has no number of its own.
    damping: float = parameter("", "damping ratio", 1e-6, 2, fit=Fit("relative", least=1e-3, most=2.0, stays=2.0))
    gain: float = parameter(
        "", "share of the static displacement; at most 1 in sum", 0, 1, default=1.0, required=True,
        fit=Fit("linear", 1e-5, LEAST_GAIN, 1.0, stays=1.0),
    )  # fmt: skip

    @cached_property
    def omega(self) -> float:
        """Undamped angular frequency ``w``, rad/s."""
        return 2 * pi * self.frequency

    @cached_property
    def lag(self) -> float:
        """Steady-state delay of the response to a ramp, seconds."""
        return 2 * self.damping / self.omega

    @cached_property
    def decay(self) -> float:
        """Rate (1/s) at which a motion dies out, the slower one of two lags."""
        return self.omega * (self.damping if self.damping <= 1 else 1 / (self.damping + sqrt(self.damping**2 - 1)))

    def response(self, frequency: FloatArray) -> NDArray[np.complex128]:
        """Return the frequency response, shape (K,), at frequencies (Hz, (K,))."""
        ratio = frequency / self.frequency
        return np.asarray(1.0 / (1.0 - ratio**2 + 2j * self.damping * ratio))

    @property
    def dynamics(self) -> Dynamics:
        """The mode with all of the motion; states: position, and velocity over ``w``."""
        w = self.omega
        return Dynamics(w * np.array([[0, 1], [-1, -2 * self.damping]]), np.array([0, w]), np.array([1.0, 0]), 0.0)

    def release(self, t: FloatArray) -> FloatArray:
        """Return the position, shape (N,), at times `t` (s) after a release from 1 at rest, with input 0."""
        # By its poles, which may be complex, real, or (nearly) equal.
        decay_rate, square = self.damping * self.omega, self.damping**2 - 1
        if abs(square) < EQUAL:
            return np.asarray((1 + decay_rate * t) * np.exp(-decay_rate * t))
        apart = self.omega * np.sqrt(complex(square))
        slow, fast = apart - decay_rate, -apart - decay_rate
        return np.asarray(((slow * np.exp(fast * t) - fast * np.exp(slow * t)) / (slow - fast)).real)

    def transfer(self, dt: float) -> tuple[FloatArray, FloatArray]:
        """Return the discrete transfer function with step `dt` (s) for an input linear between samples, (3,) each."""
        m11, m12, m21, m22 = mode_transition(self.omega, self.damping, dt)
        # Response of position and velocity to the input at the start and at the end of a step.
        if self.omega * dt < SERIES:
            # From the step response as a power series, as differences would lose precision.
            power, square = np.zeros(TERMS), (self.omega * dt) ** 2
            for k in range(2, TERMS):
                own = (k == 2) - power[k - 2]
                power[k] = (square * own - 2 * self.damping * self.omega * dt * (k - 1) * power[k - 1]) / (k * (k - 1))
            order = np.arange(TERMS)
            p1, v1 = float((power / (order + 1)).sum()), float(power.sum()) / dt
            p0, v0 = float(power.sum()) - p1, float((order * power).sum()) / dt - v1
        else:
            late = self.lag / dt
            p0, p1 = late - m11 * (1 + late) + m12 / dt, 1 - late + m11 * late - m12 / dt
            v1 = 1 / dt + m21 * late - m22 / dt
            v0 = -1 / dt - m21 * (1 + late) + m22 / dt
        total, product = mode_poles(self.omega, self.damping, dt)
        denominator = np.array([1.0, -total, product])
        moved = np.array([p1, p0 - m22 * p1 + m12 * v1, m12 * v0 - m22 * p0])
        # Remove rounding errors from the static gain.
        return moved * (denominator.sum() / moved.sum()), denominator


class StreamingMode:
    """A mode sample by sample, for an input linear between samples; `state`: input (m), position (m), velocity."""

    def __init__(self, mode: Mode) -> None:
        self._lag, self._mode = mode.lag, mode
        self._dt, self._free = 0.0, mode_transition(mode.omega, mode.damping, 0.0)
        self.start(0.0)

    def start(self, x: float) -> None:
        """Initialise to equilibrium at `x` (m)."""
        self.state = x, x, 0.0

    def after(self, dt: float, x: float) -> tuple[float, float, float]:
        """Return the state after `dt` (s) with the input `x` (m) at the end."""
        before, position, velocity = self.state
        if dt <= 0.0:
            return x, position, velocity
        if dt != self._dt:
            self._dt, self._free = dt, mode_transition(self._mode.omega, self._mode.damping, dt)
        m11, m12, m21, m22 = self._free
        slope = (x - before) / dt
        behind = self._lag * slope
        position, velocity = position - before + behind, velocity - slope
        return x, x - behind + m11 * position + m12 * velocity, slope + m21 * position + m22 * velocity

    def move(self, dt: float, x: float) -> None:
        """Advance by `dt` (s) to the input `x` (m)."""
        self.state = self.after(dt, x)


class Between:
    """Linear interpolation between points `known`, shape (N,), ascending, at `wanted`, shape (M,), of many signals.

    The same to the last bit as `numpy.interp`, which looks for the points anew for each signal.
    """

    def __init__(self, known: FloatArray, wanted: FloatArray) -> None:
        self._before = np.maximum(np.searchsorted(known, wanted, side="right") - 1, 0)
        self._after = np.minimum(self._before + 1, known.size - 1)
        self._since = wanted - known[self._before]
        self._apart = known[self._after] - known[self._before]
        outside = (self._apart == 0.0) | (self._since < 0.0)
        self._since[outside], self._apart[outside] = 0.0, 1.0

    def of(self, signal: FloatArray) -> FloatArray:
        """Return the interpolated signal, shape (M,), of a finite one, shape (N,)."""
        signal = np.asarray(signal, dtype=np.float64)
        first = signal.take(self._before)
        found: FloatArray = signal.take(self._after)
        found -= first
        found /= self._apart
        found *= self._since
        found += first
        return found


@dataclass(frozen=True)
class Uniform:
    """A uniform grid that covers non-decreasing stamps; its points are the stamps if these are uniform."""

    t: FloatArray  # s, (N,)
    grid: FloatArray  # s, (M,)
    dt: float  # s; 0 if all stamps are equal

    @classmethod
    def over(cls, t: FloatArray) -> "Uniform":
        """Return the grid for stamps `t`, shape (N,), s: their median interval, at most `FINEST` points per sample."""
        span = float(t[-1] - t[0]) if t.size else 0.0
        if span <= 0.0:
            return cls(t, t, 0.0)
        dt = span / (t.size - 1)
        late = np.arange(t.size, dtype=np.float64)
        late *= -dt
        late += t
        late -= t[0]
        if max(late.max(), -late.min()) <= EVEN * dt:
            return cls(t, t, dt)
        step = max(float(np.median(np.diff(t))), span / (FINEST * t.size))
        points = int(np.ceil(span / step)) + 1
        return cls(t, np.linspace(t[0], t[-1], points), span / (points - 1))

    def on(self, signal: FloatArray) -> FloatArray:
        """Resample a signal from the stamps, shape (N,), to the grid, shape (M,)."""
        return signal if self.grid is self.t else self._on.of(signal)

    def off(self, signal: FloatArray) -> FloatArray:
        """Resample a signal from the grid, shape (M,), to the stamps, shape (N,)."""
        return signal if self.grid is self.t else self._off.of(signal)

    @cached_property
    def _on(self) -> Between:
        return Between(self.t, self.grid)

    @cached_property
    def _off(self) -> Between:
        return Between(self.grid, self.t)
