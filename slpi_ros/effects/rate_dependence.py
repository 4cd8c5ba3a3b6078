"""Rate dependence: loops that widen with the rate by more than a linear filter explains.

There are two forms: wider loops with a backlash, which act on the displacement, and a rate-dependent coercivity, which
acts on the voltage as a play operator before the hysteresis.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from math import copysign, exp
from typing import TYPE_CHECKING, ClassVar, overload

import numpy as np

from slpi_ros.effects.base import (
    Candidate,
    EffectContext,
    FloatArray,
    ResidualView,
    Side,
    Signal,
    by_record,
    require,
)
from slpi_ros.effects.filters import Uniform
from slpi_ros.errors import ModelError

if TYPE_CHECKING:
    from slpi_ros.hysteresis.compiled import Play

CoercivityState = tuple[float, float, float, float, float, float]

# Fixed-point iterations: the coercivity depends weakly on the resulting voltage.
TRIALS = 4
# Number of secant steps for inverting the reversible part, which is nearly linear within the play.
CHORDS = 8
# Rounding tolerance for a command at the end of the play.
INSIDE = 1 - 1e-9
# Shares of the half-width, and smoothing times (s) of the crossing of the play at a turn, that the inverse of a whole
# path tries; the error, as a share of that without compensation, with which the first of them is good enough.
SHARES, CROSSINGS, ENOUGH = (1.0, 0.75, 0.5, 0.25, 0.12), (0.0, 0.005, 0.02, 0.1), 0.5


def reversible(v: FloatArray, gains: Sequence[float]) -> FloatArray:
    """Return the reversible displacement, shape (N,), metres, at voltages `v`, shape (N,), volts."""
    return np.asarray(np.polynomial.polynomial.polyval(v, [0.0, *gains]), dtype=np.float64)


class StreamingCoercivity:
    """Streaming (sample by sample) play operator with rate-dependent half-width.

    The inverse takes the rate from the voltage at the hysteresis, or from the command if that voltage rests, but never
    a higher one than that of the wanted voltages: with the rate of its own commands, or of what they lead to, the
    recursion is unstable where the width grows nearly in proportion to the rate.

    Parameters
    ----------
    half_width : callable
        Half-width of the play (V) as a function of the rate (V/s).
    settling, reversible
        As in `RateDependence`.
    """

    def __init__(self, half_width: Callable[[float], float], settling: float, reversible: Sequence[float]) -> None:
        self._half_width, self._settling, self._reversible = half_width, settling, tuple(reversible)
        self.start(0.0)

    def start(self, x: float) -> None:
        """Initialise to equilibrium at `x` (V)."""
        self._v = self._u = self._aimed = x
        self._rate = self._rate_out = self._rate_aimed = 0.0
        self._aim: float | None = None

    def forward(self, dt: float, x: float) -> float:
        """Advance by `dt` (s) to the command `x` (V) and return the voltage (V) at the hysteresis."""
        way, before, aim = x - self._v, self._u, self._aim
        self._rate = self._settled(dt, self._rate, way)
        half_width = self._half_width(self._rate)
        self._v, self._u, self._aim = x, min(max(before, x - half_width), x + half_width), None
        moved = self._u - before
        if moved or abs(x - before) < INSIDE * self._half_width(self._rate_out):
            self._rate_out = self._settled(dt, self._rate_out, moved or way)
        if aim is None:
            self._aimed, self._rate_aimed = self._u, self._rate_out
        else:
            self._rate_aimed, self._aimed = self._settled(dt, self._rate_aimed, aim - self._aimed), aim
            self._rate_out = min(self._rate_out, self._rate_aimed)
        return self._u

    def inverse(self, dt: float, wanted: float) -> float:
        """Return the command (V) for the voltage `wanted` (V) at the hysteresis."""
        way = wanted - self._u
        return self.aim(wanted, copysign(1.0, way)) if way else self._v

    def aim(self, u: float, direction: float) -> float:
        """Return the command (V) that brings the hysteresis to `u` (V), or near it, in `direction`, -1 or 1."""
        self._aim = u
        return self.ahead(u, direction)

    def ahead(self, u: float, direction: float) -> float:
        """Return the command (V) beyond which the input of the hysteresis leaves `u` (V) in `direction`, -1 or 1."""
        return u + direction * self._half_width(self._rate_out)

    def within(self, reversible_bypass: float) -> tuple[float | None, float]:
        """Return the command (V) for a reversible displacement (m) with the hysteresis at rest; None beyond the play.

        The second value is the direction of the command from the middle of the play, -1 or 1.
        """
        low, high = (self.between(self.ahead(self._u, side), self._u) for side in (-1.0, 1.0))
        direction = 1.0 if reversible_bypass > 0.5 * (low + high) else -1.0
        if not low < reversible_bypass < high:
            return None, direction
        v, slope = self._u, 0.5 * (high - low) / self._half_width(self._rate_out)
        for _ in range(CHORDS):
            v += (reversible_bypass - self.between(v, self._u)) / slope
        return v, direction

    @property
    def reversible_bypass(self) -> float:
        """Reversible displacement (m) in parallel with the hysteresis."""
        return self.between(self._v, self._u)

    def between(self, v: float, u: float) -> float:
        """Return the reversible displacement (m) at a command `v` (V) and a voltage `u` (V) of the hysteresis."""
        # In the order of the compiled inverse, so that both round alike.
        total, v_power, u_power = 0.0, 1.0, 1.0
        for gain in self._reversible:
            v_power, u_power = v_power * v, u_power * u
            total += gain * (v_power - u_power)
        return total

    def snapshot(self) -> CoercivityState:
        """Return command and hysteresis voltage (V), their rates (V/s), and the last wanted voltage and its rate."""
        return self._v, self._u, self._rate, self._rate_out, self._aimed, self._rate_aimed

    def restore(self, state: CoercivityState) -> None:
        """Replace the state by one returned by `snapshot`."""
        self._v, self._u, self._rate, self._rate_out, self._aimed, self._rate_aimed = state
        self._aim = None

    def _settled(self, dt: float, before: float, way: float) -> float:
        if dt <= 0.0:
            return before
        rate = abs(way) / dt
        return rate + (before - rate) * (exp(-dt / self._settling) if self._settling else 0.0)


# Weight of the latest rate in the exponential average.
SMOOTHING = 0.5
# Averaging time for comparing the rates of voltage and displacement, seconds.
COMPARISON = 0.02

RateState = tuple[float | None, float, float, float | None, float, float, float]


class StreamingRateDependence:
    """Streaming (sample by sample) rate dependence on the displacement, which also uses the voltage.

    The inverse takes the rate from the desired displacements, with a slowly updated ratio of voltage to displacement;
    with the rate of its own voltages, the recursion would be unstable.

    Parameters
    ----------
    widening, backlash, exponent, reference_rate, transition : float
        As in `RateDependence`.
    """

    def __init__(
        self, widening: float, backlash: float, exponent: float, reference_rate: float, transition: float
    ) -> None:
        self._widening, self._backlash = widening, backlash
        self._exponent, self._reference_rate, self._transition = exponent, reference_rate, transition
        self._middle: Callable[[float], float] = float
        self.start(0.0)

    def attach(self, middle: Callable[[float], float]) -> None:
        """Set the function that maps voltage (V) to the mid-line of the largest loop (m)."""
        self._middle = middle

    def start(self, x: float) -> None:
        """Initialise to equilibrium at `x` (m); the next voltage is taken as the rest voltage."""
        self._u: float | None = None
        self._rate = self._direction = self._desired_rate = self._volts = self._metres = 0.0
        self._desired: float | None = x
        self._asked: float | None = None

    def drive(self, dt: float, u: float) -> None:
        """Record the voltage `u` (V), applied `dt` (s) after the previous one."""
        way = 0.0 if self._u is None else u - self._u
        if dt > 0.0:
            self._rate += SMOOTHING * (way / dt - self._rate)
            self._compare(dt, way)
        if self._asked is not None or dt > 0.0:
            self._desired, self._asked = self._asked, None
        self._direction = self._turned(way)
        self._u = u

    def forward(self, dt: float, x: float) -> float:
        """Return the displacement (m) of the widened loops for a displacement `x` (m) of the quasi-static loops."""
        if self._u is None or not self._rate:
            return x
        behind = self._backlash * self._direction
        return x + self._speed(self._rate) * (self._widening * (x - self._middle(self._u)) - behind)

    def inverse(self, dt: float, wanted: float) -> float:
        """Return the displacement (m) of the quasi-static loops for a displacement `wanted` (m) of the wider loops."""
        self._asked = wanted
        if self._u is None or self._desired is None or dt <= 0.0:
            return wanted
        rate = (
            self._desired_rate + SMOOTHING * ((wanted - self._desired) / dt - self._desired_rate)
        ) * self._volts_per_metre()
        speed, middle = self._speed(rate), self._middle(self._u + rate * dt)
        back = wanted + speed * (self._widening * middle + self._backlash * self._turned(rate * dt))
        return back / (1 + speed * self._widening)

    def snapshot(self) -> RateState:
        """Return voltage, rate, direction, and the history of the desired displacements."""
        return self._u, self._rate, self._direction, self._desired, self._desired_rate, self._volts, self._metres

    def restore(self, state: RateState) -> None:
        """Replace the state by one returned by `snapshot`."""
        self._u, self._rate, self._direction, self._desired, self._desired_rate, self._volts, self._metres = state
        self._asked = None

    def _turned(self, way: float) -> float:
        """Return the direction (-1 to 1) after a voltage change `way` (V)."""
        if not way:
            return self._direction
        toward = copysign(1.0, way)
        return toward + (self._direction - toward) * exp(-abs(way) / self._transition)

    def _speed(self, rate: float) -> float:
        return float((abs(rate) / self._reference_rate) ** self._exponent)

    def _compare(self, dt: float, way: float) -> None:
        """Record the last desired displacement and update the ratio of its rate to that of the voltage."""
        if self._asked is None or self._desired is None:
            self._desired_rate = 0.0
            return
        went = self._asked - self._desired
        self._desired_rate += SMOOTHING * (went / dt - self._desired_rate)
        kept = exp(-dt / COMPARISON)
        self._volts = kept * self._volts + abs(way)
        self._metres = kept * self._metres + abs(went)

    def _volts_per_metre(self) -> float:
        """Return the voltage per metre of displacement, from the slope of the mid-line and from recent samples."""
        u = self._u or 0.0
        slope = 1 / max((self._middle(u + 1.0) - self._middle(u - 1.0)) / 2, 1e-15)
        seen = self._volts / self._metres if self._metres > 0.0 else slope
        return min(max(seen, slope / 3), 3 * slope)


# Exponents, and transition lengths as shares of the voltage range, of the candidates.
EXPONENTS, TRANSITIONS = (0.1, 0.3, 0.6), (0.01, 0.04, 0.12)

# Candidates of the coercivity form: exponent, onset (share of the reference rate), settling (s), and coercivities
# (shares of the voltage range).
COERCIVE_EXPONENT, COERCIVE_ONSET, SETTLING, COERCIVITIES = 0.3, 0.1, 2e-3, (0.003, 0.02, 0.06)
# Number of gains of the reversible part.
POWERS, MOST_POWERS = 3, 6

# Fewest samples from which batch evaluation computes a rate.
WINDOW = 7


@dataclass(frozen=True)
class RateDependence:
    """Rate dependence of the loops in one of two forms: wider loops with a backlash, or a coercivity.

    First form: ``y = h + (|du/dt| / r)^e (widening (h - m(u)) - backlash z)``, where ``m`` is the mid-line of the
    largest loop, and ``z`` the direction of ``u``, from -1 to 1, with ``dz = (sign(du) - z) |du| / transition``. Second
    form: the voltage of the hysteresis is ``u = play(v)`` with half-width ``c (s / r)^e``, where ``s`` is the low-pass
    filtered ``|dv/dt|``; the reversible part ``R(v) - R(u)``, ``R(v) = g1 v + g2 v^2 + ..``, acts in parallel.

    Parameters
    ----------
    widening : float
        Relative widening of the loops at the reference rate.
    backlash : float, metres
        Displacement by which the stage lags in its direction of motion, at the reference rate.
    exponent : float
        Exponent ``e`` of the rate.
    reference_rate : float, V/s
        Reference rate ``r``.
    transition : float, volts
        Voltage change after a reversal over which the direction ``z`` changes, to 1/e; first form only.
    coercivity : float, volts
        Coercivity ``c`` at the reference rate; 0 selects the first form.
    onset : float, V/s
        If not 0, the coercivity is proportional to ``(1 + s / onset)^e - 1``, nearly logarithmic, instead of ``s^e``.
    settling : float, seconds
        Time constant of the rate filter for the coercivity.
    reversible : tuple of float, m/V, m/V^2, ..
        Gains of the reversible part, which the coercivity does not affect.
    uncertainty : mapping of parameter name to standard deviation, optional
    """

    name: ClassVar[str] = "rate_dependence"
    side: ClassVar[Side] = "stage"

    widening: float
    backlash: float
    exponent: float
    reference_rate: float
    transition: float
    coercivity: float = 0.0
    onset: float = 0.0
    settling: float = 0.0
    reversible: tuple[float, ...] = ()
    uncertainty: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Validate the parameters, including invertibility."""
        require(
            self,
            ("widening", 0 <= self.widening <= 10, "from 0 to 10"),
            ("backlash", abs(self.backlash) <= 1, "within 1 m"),
            ("exponent", 0 < self.exponent <= 4, "more than 0, at most 4"),
            ("reference_rate", 1e-9 <= self.reference_rate <= 1e12, "from 1e-9 to 1e12 V/s"),
            ("transition", 1e-9 <= self.transition <= 1e5, "from 1e-9 to 1e5 V"),
            ("coercivity", 0 <= self.coercivity <= 1e5, "from 0 to 1e5 V"),
            ("settling", 0 <= self.settling <= 100, "from 0 to 100 s"),
            ("onset", 0 <= self.onset <= 1e12, "from 0 to 1e12 V/s"),
            ("reversible", len(self.reversible) <= MOST_POWERS, f"at most {MOST_POWERS} gains"),
            ("coercivity", not (self.coercivity and (self.widening or self.backlash)), "0 beside other parts"),
        )

    @property
    def acts_on(self) -> Signal:
        """Signal on which the effect acts: the voltage in the coercivity form, else the displacement."""
        return "voltage" if self.coercivity else "displacement"

    @by_record
    def apply(self, signal: FloatArray, around: EffectContext) -> FloatArray:
        """Return the displacement of the wider loops, shape (N,), metres, or in the coercivity form the voltage (V)."""
        if self.coercivity:
            from slpi_ros.effects.paths import play, settled_rate

            return play(signal, self._growth(settled_rate(around.t, signal, self.settling)))
        middle, speed, direction = self._drive(around)
        return signal + speed * (self.widening * (signal - middle) - self.backlash * direction)

    def invert(self, signal: FloatArray, around: EffectContext) -> FloatArray:
        """Return the displacement of the quasi-static loops, shape (N,), metres, given the voltage in `around`.

        In the coercivity form return the command, shape (N,), volts, using the rate of the voltage at the hysteresis.
        """
        if self.coercivity:
            return self._command(signal, around) if signal.size > 1 else signal.copy()
        middle, speed, direction = self._drive(around)
        back = signal + speed * (self.widening * middle + self.backlash * direction)
        return np.asarray(back / (1 + speed * self.widening), dtype=np.float64)

    def _command(self, wanted: FloatArray, around: EffectContext) -> FloatArray:
        """Return the command for the voltages `wanted` at the hysteresis, shape (N,) each, volts.

        A command that jumps over the play at a turn widens it. Where that costs too much, a slower crossing or a part
        of the compensation is better; the best of them is returned, or `wanted` itself if none does better.
        """
        from slpi_ros.effects.paths import settled_rate, smoothed

        ahead = self._growth(settled_rate(around.t, wanted, self.settling)) * np.sign(np.gradient(wanted))
        period = float(around.t[-1] - around.t[0]) / (wanted.size - 1)
        best = ignored = float(np.linalg.norm(self.apply(wanted, around) - wanted))
        chosen = wanted.copy()
        for crossing in CROSSINGS:
            over = smoothed(ahead, round(crossing / period)) if period and crossing else ahead
            for share in SHARES:
                command = wanted + share * over
                missed = float(np.linalg.norm(self.apply(command, around) - wanted))
                if missed < best:
                    best, chosen = missed, command
                if best <= ENOUGH * ignored:
                    return chosen
        return chosen

    def reversible_bypass(self, v: FloatArray, u: FloatArray) -> FloatArray:
        """Return the reversible displacement, shape (N,), m, at commands `v` and hysteresis voltages `u`, volts."""
        return reversible(v, self.reversible) - reversible(u, self.reversible)

    @classmethod
    def fit(cls, left: ResidualView) -> Iterator[Candidate]:
        """Yield candidates of both forms: wider loops (several exponents and transitions) and several coercivities."""
        reference = float(np.sqrt(np.mean(np.gradient(left.u, left.t) ** 2)))
        yield from cls._losing(left, reference)
        yield from cls._coercive(left, reference)

    @classmethod
    def _losing(cls, left: ResidualView, reference: float) -> Iterator[Candidate]:
        for exponent in EXPONENTS:
            wider = cls(1.0, 0.0, exponent, reference, float(np.ptp(left.u)))
            widening = wider.apply(left.h, left.around) - left.h
            yield Candidate(widening[:, None], partial(cls._times, wider), positive=1)
            for transition in (float(share * np.ptp(left.u)) for share in TRANSITIONS):
                one = cls(0.0, 1e-6, exponent, reference, transition)
                columns = np.column_stack([widening, one.apply(left.h, left.around) - left.h])
                yield Candidate(columns, partial(cls._times, one), positive=2)

    @classmethod
    def _coercive(cls, left: ResidualView, reference: float) -> Iterator[Candidate]:
        span, onset = float(np.ptp(left.u)), COERCIVE_ONSET * reference
        for share in COERCIVITIES:
            one = cls(0.0, 0.0, COERCIVE_EXPONENT, reference, span, share * span, onset, SETTLING)
            u = one.apply(left.u, left.around)
            through = [left.u**power - u**power for power in range(1, POWERS + 1)]
            yield Candidate(np.column_stack([left.respond(u) - left.h, *through]), partial(cls._grown, one))

    @staticmethod
    def _grown(one: "RateDependence", gains: FloatArray) -> "RateDependence | None":
        times, *through = gains.tolist()
        if times <= 0:
            return None
        return replace(one, coercivity=times * one.coercivity, reversible=tuple(gain / times for gain in through))

    @staticmethod
    def _times(one: "RateDependence", gains: FloatArray) -> "RateDependence | None":
        wider, behind = float(gains[0]), float(gains[1]) if gains.size > 1 else 0.0
        return replace(one, widening=wider, backlash=behind * one.backlash) if gains.max() > 0 else None

    def describe(self) -> str:
        """Describe the magnitude at the reference rate and the dependence on the rate."""
        if self.coercivity:
            return (
                f"at {self.reference_rate:.3g} V/s the coercivity is {self.coercivity:.3g} V larger than at rest, "
                f"and at other rates {self._law()}"
            )
        parts = [f"by {self.widening * 100:.3g} %"] if self.widening else []
        parts += [f"by {self.backlash * 1e9:.3g} nm on either side"] if self.backlash else []
        return (
            f"at {self.reference_rate:.3g} V/s the loops are wider {' and '.join(parts) or 'by nothing'}, "
            f"and at other rates as their power {self.exponent:.2g}"
        )

    def _law(self) -> str:
        if not self.onset:
            return f"as their power {self.exponent:.2g}"
        return f"as the power {self.exponent:.2g} of 1 + rate / {self.onset:.3g} V/s, nearly their logarithm"

    def streaming(self) -> StreamingRateDependence | StreamingCoercivity:
        """Return the streaming rate dependence."""
        if self.coercivity:
            return StreamingCoercivity(self._growth, self.settling, self.reversible)
        return StreamingRateDependence(
            self.widening, self.backlash, self.exponent, self.reference_rate, self.transition
        )

    def compiled_play(self) -> "Play":
        """Return the coercivity form for the compiled inverse of whole paths."""
        from slpi_ros.hysteresis.compiled import Play

        return Play(
            coercivity=float(self.coercivity),
            exponent=float(self.exponent),
            reference_rate=float(self.reference_rate),
            onset=float(self.onset),
            settling=float(self.settling),
            reversible=np.array(self.reversible, dtype=np.float64),
            inside=INSIDE,
            trials=TRIALS,
            chords=CHORDS,
        )

    def _drive(self, around: EffectContext) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the mid-line (m), the rate to the power ``e``, and the direction, shape (N,) each."""
        if around.u is None or around.middle is None:
            raise ModelError("effect 'rate_dependence' needs the voltage that drives the hysteresis, and its loop")
        return around.middle(around.u), self._speed(around.uniform, around.u), self._direction(around.u)

    def _speed(self, grid: Uniform, u: FloatArray) -> FloatArray:
        if not grid.dt or u.size < WINDOW:
            return np.zeros_like(u)
        from slpi_ros.effects.paths import smoothed_slope

        rate = smoothed_slope(grid.on(u)) / grid.dt
        return grid.off((np.abs(rate) / self.reference_rate) ** self.exponent)

    def _direction(self, u: FloatArray) -> FloatArray:
        if not self.backlash:
            return np.zeros_like(u)
        from slpi_ros.effects.paths import direction

        return direction(u, self.transition)

    @overload
    def _growth(self, rate: float) -> float: ...
    @overload
    def _growth(self, rate: FloatArray) -> FloatArray: ...
    def _growth(self, rate: float | FloatArray) -> float | FloatArray:
        """Return the coercivity (V) at a rate (V/s)."""
        grown: float | FloatArray = (rate / self.reference_rate) ** self.exponent
        if self.onset:
            at_reference = (1 + self.reference_rate / self.onset) ** self.exponent - 1
            grown = ((1 + rate / self.onset) ** self.exponent - 1) / at_reference
        return self.coercivity * grown
