"""The closed loop of one axis as it is built: transfer function, stability and margins, and which gain would do."""

from dataclasses import dataclass, replace
from functools import cached_property
from math import ceil, floor, log2, log10, pi

import numpy as np
from numpy.typing import NDArray

from slpi_ros.arrays import FloatArray
from slpi_ros.compensator.feedback import PidGains
from slpi_ros.compensator.loop_filter import Section, response, sections
from slpi_ros.effects.filters import AT_ONCE, Dynamics, first_order
from slpi_ros.model.axis_model import AxisModel

ComplexArray = NDArray[np.complex128]

# Smallest modulus margin, min |1 + L|, of a loop that is used.
LEAST_MARGIN = 0.3
# Intervals in which the slope of the hysteresis is looked at, in each direction.
CHORDS = 32
# Begin of the frequencies over the slowest rate of the loop, and their number; distances from a pole, in its rate.
LOWEST, FREQUENCIES = 1e-3, 256
BESIDE = np.array([-30.0, -10.0, -3.0, -1.0, -0.3, 0.0, 0.3, 1.0, 3.0, 10.0, 30.0])
# Between two frequencies 1 + L turns by at most this (rad), where 1 / 10 or more of the signal comes back; rounds of
# refinement, and most points that one interval is cut into.
TURN, HEARD, ROUNDS, PARTS = 0.3, 0.1, 12, 2000
# Gains that would do are looked for from the given ones on down to this share, and to this accuracy.
LEAST_SHARE, SHARE_ACCURACY = 1e-9, 0.01


@dataclass(frozen=True)
class Plant:
    """What a small change of the voltage does to the reading: slope, delay, and linear dynamics of static gain 1."""

    slope: float  # m/V
    delay: float = 0.0  # s
    dynamics: Dynamics = AT_ONCE

    @classmethod
    def of(cls, model: AxisModel) -> "Plant":
        """Return the plant of a causal model: its steepest slope, and the dynamics of its stage and of its sensor."""
        chain, sensor = model.chain, model.sensor
        dynamics = AT_ONCE
        for effect in (*chain.before, *chain.own, *chain.shared):
            dynamics = dynamics.then(effect.dynamics)
        if sensor.lag:
            dynamics = dynamics.then(first_order(sensor.lag))
        slope = _steepest(model) * float(np.prod([effect.steepest for effect in chain.own]))
        return cls(slope, max(chain.delay, 0.0) + sensor.delay, dynamics)

    def response(self, omega: FloatArray) -> ComplexArray:
        """Return the frequency response, m/V, shape (N,), at `omega` (rad/s) of the plant itself, without a hold."""
        a, b, c, d = self.dynamics
        states = 1j * omega[:, None, None] * np.eye(len(b)) - a
        driven = np.linalg.solve(states, np.broadcast_to(b[:, None], (omega.size, len(b), 1)))[..., 0]
        return np.asarray(self.slope * (driven @ c + d) * np.exp(-1j * omega * self.delay))


@dataclass(frozen=True)
class Margins:
    """Whether a loop is stable, and how far it is from the limit."""

    stable: bool
    modulus: float  # min |1 + L|
    frequency: float  # Hz, where that is

    @property
    def enough(self) -> bool:
        """Whether the loop may be used."""
        return self.stable and self.modulus >= LEAST_MARGIN


@dataclass(frozen=True)
class DiscreteLoop:
    """PID feedback of a plant once in each `period` (s), as `Feedback` computes it, without the feedforward.

    UsageError for a notch that is not below half the rate.

    The correction from a reading is output one period after it, and held over the next one. With the sampled signals
    and ``z = exp(i w period)``, ``L(z) = C(z) P(z) / z``::

        C = F (kp + ki T z / (z - 1) + kd / T (1 - a) (z - 1) / (z - a)),   a = exp(-T / derivative_filter)

    F the notches and the low pass of the readings, and P the plant with a zero-order hold, exact for any delay (Åström
    and Wittenmark, Computer-Controlled Systems, 3rd ed., 2.3).
    """

    plant: Plant
    gains: PidGains
    period: float

    def controller(self, omega: FloatArray) -> ComplexArray:
        """Return the transfer function, V/m, shape (N,), from the error to the correction at `omega` (rad/s)."""
        gains, z = self.gains, np.exp(1j * omega * self.period)
        kept = np.exp(-self.period / gains.derivative_filter) if gains.derivative_filter else 0.0
        slope = gains.derivative / self.period * (1.0 - kept) * (z - 1.0) / (z - kept)
        pid = np.asarray(gains.proportional + gains.integral * self.period * z / (z - 1.0) + slope)
        return pid * response(self._filter, z) if self._filter else pid

    @cached_property
    def _filter(self) -> tuple[Section, ...]:
        return sections(self.gains.notches, self.gains.measurement_filter, self.period)

    @np.errstate(over="ignore", invalid="ignore")
    def response(self, omega: FloatArray) -> ComplexArray:
        """Return the return ratio L, shape (N,), at `omega` (rad/s, 0 to pi / period)."""
        kept, early, late = self.held
        z, whole = np.exp(1j * omega * self.period), ceil(self.plant.delay / self.period)
        direct = self.plant.dynamics.d
        reading = np.full(omega.shape, direct, dtype=complex)
        if kept.size:
            states = z[:, None, None] * np.eye(len(kept)) - kept
            driven = early * z[:, None] + late
            reading += np.linalg.solve(states, driven[..., None])[..., 0] @ self.plant.dynamics.c
        return np.asarray(self.controller(omega) * self.plant.slope * reading * z ** -(whole + 1.0))

    @cached_property
    def held(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """States after a period, and what comes in of the newer and of the older voltage, as the delay is."""
        (a, b, _, _), period = self.plant.dynamics, self.period
        older = self.plant.delay - (ceil(self.plant.delay / period) - 1) * period
        first, second = _transition(a, b, older), _transition(a, b, period - older)
        return second[0] @ first[0], second[1], second[0] @ first[1]

    @cached_property
    def margins(self) -> Margins:
        """Stability by Nyquist's criterion, and the modulus margin."""
        omega = self._frequencies()
        returned = 1.0 + self.response(omega)
        if not (np.all(np.isfinite(returned)) and np.all(returned)):
            return Margins(False, 0.0, 0.0)
        turned = float(np.sum(np.angle(returned[1:] / returned[:-1])))
        # Zeros of 1 + L outside of the unit circle; half a turn belongs to the integrator, passed on the outside.
        outside = ((pi if self.gains.integral else 0.0) - 2.0 * turned) / (2.0 * pi)
        nearest = int(np.argmin(np.abs(returned)))
        modulus, at = float(np.abs(returned[nearest])), float(omega[nearest]) / (2.0 * pi)
        return Margins(abs(outside) < 0.5, modulus, at)

    def _frequencies(self) -> FloatArray:
        """Return frequencies (rad/s, (N,)), such that 1 + L turns little between two where that matters."""
        highest, poles = pi / self.period, np.linalg.eigvals(self.plant.dynamics.a)
        crossing = self.gains.integral * self.plant.slope
        slowest = min([highest, *([crossing] if crossing else []), *np.abs(poles)])
        # A mode above the highest frequency is seen below it.
        folded = np.abs((poles.imag + highest) % (2.0 * highest) - highest)
        near = (folded[:, None] - poles.real[:, None] * BESIDE).ravel()
        # Beside the zeros of each notch, too, where 1 + L may turn.
        for notch in self.gains.notches:
            w = 2.0 * pi * notch.frequency
            near = np.append(near, w + BESIDE * max(notch.damping, 1e-3) * w)
        lowest = LOWEST * slowest
        omega = np.concatenate([np.geomspace(lowest, highest, FREQUENCIES), near, [highest]])
        omega = np.unique(omega[(omega >= lowest) & (omega <= highest)])
        for _ in range(ROUNDS):
            back = self.response(omega)
            if not np.all(np.isfinite(back)):
                break
            loud = np.maximum(np.abs(back[1:]), np.abs(back[:-1])) >= HEARD
            turns = np.abs(np.angle((1.0 + back[1:]) / (1.0 + back[:-1])))
            # What the delay alone turns between two frequencies may be more than one round.
            turns = np.maximum(turns, np.diff(omega) * (self.plant.delay + self.period)) * loud
            parts = np.minimum(np.ceil(turns / TURN), PARTS).astype(int)
            if parts.max(initial=1) <= 1:
                break
            more = [np.linspace(omega[k], omega[k + 1], parts[k] + 1)[1:-1] for k in np.flatnonzero(parts > 1)]
            omega = np.unique(np.concatenate([omega, *more]))
        return omega

    def scaled(self, share: float) -> "DiscreteLoop":
        """Return the loop with all gains multiplied by a share."""
        g = self.gains
        gains = replace(
            g, proportional=g.proportional * share, integral=g.integral * share, derivative=g.derivative * share
        )
        return replace(self, gains=gains)

    def share_that_does(self) -> float:
        """Return the largest share, up to 1, of all gains with enough margin, to two digits; 0 if there is none."""
        low, high = 1.0, 1.0
        while not self.scaled(low).margins.enough:
            low, high = low / 10.0, low
            if low < LEAST_SHARE:
                return 0.0
        while high - low > SHARE_ACCURACY * low:
            middle = (low * high) ** 0.5
            low, high = (middle, high) if self.scaled(middle).margins.enough else (low, middle)
        return _rounded_down(low)


def refusal(model: AxisModel, gains: PidGains, period: float) -> str:
    """Return why a loop is not used, and which gain would do; "" if it may be used."""
    if not (gains.proportional or gains.integral or gains.derivative):
        return ""
    loop = DiscreteLoop(Plant.of(model), gains, period)
    found = loop.margins
    if found.enough:
        return ""
    share = loop.share_that_does()
    do = loop.scaled(share).gains
    each = {"kp": do.proportional, "ki": do.integral, "kd": do.derivative}
    would = ", ".join(f"{name} {_rounded_down(value):g}" for name, value in each.items() if value) or "no gain"
    state = f"barely stable (modulus margin {found.modulus:.2g}, wanted {LEAST_MARGIN:g})"
    return (
        f"with these gains the loop of the model is {state if found.stable else 'unstable'} near "
        f"{found.frequency:.3g} Hz; {would} would do; force_gains accepts them nevertheless"
    )


def _rounded_down(value: float) -> float:
    """Return a number rounded down to two digits."""
    if value <= 0.0:
        return 0.0
    unit = 10.0 ** (floor(log10(value)) - 1)
    return floor(value / unit * (1.0 + 1e-12)) * unit


def _steepest(model: AxisModel) -> float:
    """Return the steepest slope (m/V) of the loop of the hysteresis over its whole range."""
    low, high = model.hysteresis_range
    up = np.linspace(low, high, CHORDS + 1)
    path = np.concatenate([up, up[-2::-1], up[1:]])
    y = model.memory("end").forward_array(path)
    return float(np.max(np.abs(np.diff(y[CHORDS:]) / np.diff(path[CHORDS:]))))


def _transition(a: FloatArray, b: FloatArray, dt: float) -> tuple[FloatArray, FloatArray]:
    """Return ``exp(a dt)`` and the integral of ``exp(a s) b`` up to `dt` (s)."""
    n = len(b)
    whole = np.zeros((n + 1, n + 1))
    whole[:n, :n], whole[:n, n] = a * dt, b * dt
    # Scaling and squaring of the series: scipy's takes longer to import than a compensator may stand still.
    halvings = max(0, ceil(log2(max(float(np.abs(whole).sum(axis=1).max()), 1e-9))) + 2)
    part = whole / 2.0**halvings
    term = result = np.eye(n + 1)
    for k in range(1, 15):
        term = term @ part / k
        result = result + term
    for _ in range(halvings):
        result = result @ result
    return result[:n, :n], result[:n, n]
