"""Stages whose rate physics is not that of the package: thermal relays, Maxwell slip, Duhem, Bouc-Wen, moving Preisach.

Every stage has one method, ``run(t, v, rng)``. The generator draws the specimen: the parameters of a class scatter from
one specimen to the next. Every record of one specimen needs a generator of the same seed.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from slpi_ros.hysteresis.compilation import compiler

from .physics import BoucWen

FloatArray = NDArray[np.float64]

# Standard deviation of the logarithm of a parameter among specimens.
SCATTER = 0.15
# Largest exponent of an Arrhenius rate: such a relay flips within any sample.
_MOST = 60.0
# Seconds at the first voltage before the first sample.
_REST_S = 10.0
# Golden ratio minus 1: the biases of successive relays fill their range evenly.
_GOLDEN = (math.sqrt(5.0) - 1.0) / 2.0


def compiled(function: Callable[..., FloatArray]) -> Callable[..., FloatArray]:
    """Return a compiled function, without a cache: benches and tests import this file by different names."""
    njit = compiler()
    return njit(nogil=True)(function) if njit else function


# Continues a stage: displacement (m, (N,)) for durations since the preceding sample (s, (N,)) and voltages (V, (N,)).
Continued = Callable[[FloatArray, FloatArray], FloatArray]


class Stage(Protocol):
    """A stage at rest before the first sample, at the low end of its range."""

    def run(self, t: FloatArray, v: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Return the displacement, shape (N,), metres, for voltages `v` (V) at times `t` (s), shape (N,) each."""


@dataclass(frozen=True)
class ThermalRelays:
    """Thermally activated Preisach relays beside a linear part: rate dependence and creep have one cause.

    A relay with thresholds ``alpha > beta`` flips up with the probability ``f0 exp(-(alpha - v) / kT)`` per second, and
    down with ``f0 exp(-(v - beta) / kT)``. The displacement is the expected value: ``dp/dt = up (1 - p) - down p`` for
    the share ``p`` of relays of one class that are up, with the mean rates over each sample.

    Parameters
    ----------
    stroke : float, metres
        Displacement from 0 to 100 V, of relays and linear part, about.
    share : float
        Share of the relays in the stroke, between 0 and 1.
    attempts : float, 1/s
        Rate of flips at the threshold, ``f0``.
    thermal : float, volts
        Thermal voltage, ``kT``.
    width : float, volts
        Mean distance of the two thresholds at the centre of the range; the widths are distributed exponentially.
    width_growth, bias_slope : float
        Relative growth of the mean width, and of the density of relays, from the centre of the range to its end.
    relays : int
        Number of classes of relays.

    References
    ----------
    G. Bertotti, Hysteresis in Magnetism, Academic Press 1998, Sec. 14.1 (thermally activated Preisach relays).
    """

    stroke: float = 16e-6
    share: float = 0.45
    attempts: float = 20.0
    thermal: float = 0.55
    width: float = 22.0
    width_growth: float = 0.25
    bias_slope: float = 0.3
    relays: int = 2500

    def run(self, t: FloatArray, v: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Return the displacement, at rest at ``v[0]`` after negative saturation.

        Parameters
        ----------
        t : ndarray, shape (N,), seconds
            Increasing times.
        v : ndarray, shape (N,), volts
            Voltage, linear between samples.
        rng : Generator
            Draws the specimen: `attempts` within a factor of 10, and the shape of the density.

        Returns
        -------
        ndarray, shape (N,), metres
            The displacement.
        """
        # The first step is the rest before the record.
        return self.begin(float(v[0]), rng)(np.diff(t, prepend=t[0] - _REST_S), v)

    def begin(self, v0: float, rng: np.random.Generator) -> Continued:
        """Return the stage, at the voltage `v0` (V) after negative saturation, to be continued piece by piece."""
        attempts = self.attempts * 10.0 ** rng.uniform(-0.5, 0.5)
        share, width = _specimen(rng, self.share), _specimen(rng, self.width)
        growth, slope = _specimen(rng, self.width_growth), _specimen(rng, self.bias_slope)
        up, down, weights = _density(self.relays, width, growth, slope)
        p, last = (up < v0).astype(np.float64), np.array([v0])
        weights = weights / _within(up, down, weights)

        def continued(durations: FloatArray, v: FloatArray) -> FloatArray:
            seen = flipped(durations, v, p, up, down, weights, attempts, self.thermal, float(last[0]))
            last[0] = v[-1]
            return np.asarray(self.stroke * (share * seen + (1.0 - share) * v / 100.0))

        return continued


@dataclass(frozen=True)
class MaxwellSlip:
    """Maxwell-slip elements with Stribeck friction and a viscous element, beside a linear gain.

    The displacement is ``gain (v - sum_i s_i e_i - s e)``. An element's deflection ``e_i`` (V) follows the voltage
    while it sticks. It slips from its breakaway deflection on, which falls with the speed of the voltage:
    ``w_i (c + (1 - c) exp(-|v'| / v_s))``. A slipping element approaches its breakaway deflection by and by, with the
    constant of `attraction`, and sticks again at the next reversal. The viscous element is a spring and a dashpot in
    series: ``de/dt = v' - e / tau``.

    Parameters
    ----------
    gain : float, m/V
    shares : tuple of float
        Share ``s_i`` of each element in the gain; the sum is below 1.
    breakaways : tuple of float, volts
        Deflection ``w_i`` at which each element breaks away at low speed.
    kinetic : float
        Kinetic friction as a share of the static one, ``c``.
    stribeck : float, V/s
        Speed ``v_s`` at which the friction has fallen.
    attraction : float, 1/s
        Constant of the approach to the breakaway deflection during slip.
    viscous_share : float
        Share of the viscous element in the gain.
    viscous_time : float, seconds
        Its time constant ``tau``.

    References
    ----------
    F. Al-Bender, V. Lampaert, J. Swevers, The generalized Maxwell-slip model: a novel model for friction simulation and
    compensation, IEEE Trans. Autom. Control 50 (2005).
    M. Goldfarb, N. Celanovic, Modeling piezoelectric stack actuators for control of micromanipulation, IEEE Control
    Syst. 17 (1997).
    """

    gain: float = 0.2e-6
    shares: tuple[float, ...] = (0.03, 0.04, 0.05, 0.06, 0.07, 0.08, 0.08)
    breakaways: tuple[float, ...] = (1.0, 2.5, 6.0, 12.0, 22.0, 38.0, 60.0)
    kinetic: float = 0.75
    stribeck: float = 400.0
    attraction: float = 400.0
    viscous_share: float = 0.08
    viscous_time: float = 4e-3

    def run(self, t: FloatArray, v: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Return the displacement, with all elements relaxed at ``v[0]``.

        Parameters
        ----------
        t : ndarray, shape (N,), seconds
            Increasing times.
        v : ndarray, shape (N,), volts
            Voltage, linear between samples.
        rng : Generator
            Draws the specimen: every share and breakaway, `stribeck` and `viscous_time`.

        Returns
        -------
        ndarray, shape (N,), metres
            The displacement.
        """
        return self.begin(float(v[0]), rng)(np.diff(t, prepend=t[0]), v)

    def begin(self, v0: float, rng: np.random.Generator) -> Continued:
        """Return the stage, with all elements relaxed at the voltage `v0` (V), to be continued piece by piece."""
        shares = np.array([_specimen(rng, share) for share in self.shares])
        breakaways = np.array([_specimen(rng, breakaway) for breakaway in self.breakaways])
        stribeck, time_constant = _specimen(rng, self.stribeck), _specimen(rng, self.viscous_time)
        deflection, slipping = np.zeros(shares.size), np.zeros(shares.size)
        # Voltage of the preceding sample, and that of the dashpot.
        last = np.array([v0, v0])

        def continued(durations: FloatArray, v: FloatArray) -> FloatArray:
            lost = slipped(
                durations, v, deflection, slipping, shares, breakaways, self.kinetic, stribeck, self.attraction,
                float(last[0]),
            )  # fmt: skip
            behind = _followed(np.append(0.0, durations), np.append(last[0], v), time_constant, float(last[1]))[1:]
            last[:] = v[-1], behind[-1]
            return np.asarray(self.gain * (v - lost - self.viscous_share * (v - behind)))

        return continued


@dataclass(frozen=True)
class DuhemStage:
    """A rate-dependent Duhem model: the anhysteretic curve is approached at a rate ``|v'|^p`` instead of ``|v'|``.

    The displacement is ``gain (v + h)`` with ``dh/dt = k r (|v'| / r)^p (f(v) - h) - g v'``: for ``p = 1`` the model is
    that of Coleman and Hodgdon, and independent of the rate ``r``. For ``p < 1`` the loop widens with the speed. The
    anhysteretic curve is ``f(v) = a v + b v (v - 100) / 100``.

    Parameters
    ----------
    gain : float, m/V
    approach : float, 1/V
        Constant ``k`` of the approach.
    exponent : float
        Exponent ``p``, above 0.
    reference_rate : float, V/s
        Rate ``r`` at which the exponent does not matter.
    initial : float
        Loss of slope after a reversal, ``g``.
    slope, bow : float
        Constants ``a`` and ``b`` of the anhysteretic curve.

    References
    ----------
    J. Oh, D. S. Bernstein, Semilinear Duhem model for rate-independent and rate-dependent hysteresis, IEEE Trans.
    Autom. Control 50 (2005).
    B. D. Coleman, M. L. Hodgdon, A constitutive relation for rate-independent hysteresis in ferromagnetically soft
    materials, Int. J. Eng. Sci. 24 (1986).
    """

    gain: float = 0.15e-6
    approach: float = 0.03
    exponent: float = 0.94
    reference_rate: float = 300.0
    initial: float = 0.3
    slope: float = 0.1
    bow: float = 0.12

    def run(self, t: FloatArray, v: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Return the displacement, with ``h`` on the anhysteretic curve at ``v[0]``.

        Between samples the equation is linear where the slope of ``f`` is that at mid-sample, and is solved in closed
        form.

        Parameters
        ----------
        t : ndarray, shape (N,), seconds
            Increasing times.
        v : ndarray, shape (N,), volts
            Voltage, linear between samples.
        rng : Generator
            Draws the specimen: `approach`, `initial`, `bow`, and `exponent` by its distance from 1.

        Returns
        -------
        ndarray, shape (N,), metres
            The displacement.
        """
        approach, initial, bow = (_specimen(rng, x) for x in (self.approach, self.initial, self.bow))
        power = 1.0 - _specimen(rng, 1.0 - self.exponent)
        dt, dv = np.diff(t, prepend=t[0]), np.diff(v, prepend=v[0])
        rate = np.divide(np.abs(dv), dt, out=np.zeros_like(v), where=dt > 0.0)
        steps = approach * self.reference_rate * (rate / self.reference_rate) ** power * dt
        anhysteretic = self.slope * v + bow * v * (v - 100.0) / 100.0
        forced = -initial * dv - np.diff(anhysteretic, prepend=anhysteretic[0])
        # Distance of h from the anhysteretic curve.
        apart, now = np.empty_like(v), 0.0
        for index, (step, force) in enumerate(zip(steps.tolist(), forced.tolist(), strict=True)):
            settled = -math.expm1(-step)
            now += -now * settled + (force * settled / step if step > 0.0 else force)
            apart[index] = now
        return self.gain * (v + anhysteretic + apart)


@dataclass(frozen=True)
class LaggingBoucWen:
    """A Bouc-Wen stage whose hysteretic variable sees the voltage through a first-order element.

    The displacement is ``d v - h(u)``: the linear part follows the voltage at once, and the hysteretic variable, that
    of `BoucWen`, the voltage ``u = (1 - s) v + s w`` with ``tau dw/dt = v - w``. `BoucWen` is independent of the rate
    of its input, so that all rate dependence is in ``u``.

    Parameters
    ----------
    gain : float, m/V
        Slope of the linear part, ``d``.
    share, softening, asymmetry : float
        As in `BoucWen`.
    slow_share : float
        Share ``s`` of the voltage that arrives late.
    time_constant : float, seconds
        Its time constant ``tau``.

    References
    ----------
    W. Zhu, X.-T. Rui, Hysteresis modeling and displacement control of piezoelectric actuators with the
    frequency-dependent behavior using a generalized Bouc-Wen model, Precis. Eng. 43 (2016).
    """

    gain: float = 0.22e-6
    share: float = 0.35
    softening: float = 0.03
    asymmetry: float = 0.01
    slow_share: float = 0.3
    time_constant: float = 0.015

    def run(self, t: FloatArray, v: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Return the displacement, starting from rest at 0 V.

        Parameters
        ----------
        t : ndarray, shape (N,), seconds
            Increasing times.
        v : ndarray, shape (N,), volts
            Voltage from 0 V on, linear between samples.
        rng : Generator
            Draws the specimen: `share`, `softening`, `slow_share` and `time_constant`.

        Returns
        -------
        ndarray, shape (N,), metres
            The displacement.
        """
        share, softening = _specimen(rng, self.share), _specimen(rng, self.softening)
        slow, time_constant = _specimen(rng, self.slow_share), _specimen(rng, self.time_constant)
        followed = _followed(np.diff(t, prepend=t[0]), v, time_constant)
        seen = (1.0 - slow) * v + slow * followed
        stage = BoucWen(self.gain, min(share, 0.9), max(softening, 1.5 * self.asymmetry), self.asymmetry)
        return stage.run(seen) + self.gain * (v - seen)


@dataclass(frozen=True)
class MovingPreisach:
    """The moving Preisach model: the relays feel the voltage plus a share of the displacement.

    The effective voltage is ``v + k z``, where ``z`` is the displacement in units of 100 V per stroke. Loops between
    the same two voltages then differ with the displacement they are at: congruency is lost, but loops close. The
    displacement acts back with a time constant, which makes the model rate-dependent; slow paths are those of the
    moving model of the reference.

    Parameters
    ----------
    stroke : float, metres
        Displacement from 0 to 100 V, about.
    share : float
        Share of the relays in the stroke, between 0 and 1.
    moving : float
        Constant ``k`` of the moving model.
    settling : float, seconds
        Time constant with which the displacement acts back.
    width : float, volts
        Mean distance of the two thresholds; the widths are distributed exponentially.
    width_growth, bias_slope : float
        Relative growth of the mean width, and of the density of relays, from the centre of the range to its end.
    relays : int
        Number of relays.

    References
    ----------
    E. Della Torre, Effect of interaction on the magnetization of single-domain particles, IEEE Trans. Audio
    Electroacoust. 14 (1966); I. D. Mayergoyz, Mathematical Models of Hysteresis, Springer 1991, Sec. 2.1.
    """

    stroke: float = 20e-6
    share: float = 0.4
    moving: float = 0.12
    settling: float = 2e-3
    width: float = 20.0
    width_growth: float = 0.25
    bias_slope: float = 0.3
    relays: int = 6000

    def run(self, t: FloatArray, v: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Return the displacement, at rest at ``v[0]`` after negative saturation.

        Parameters
        ----------
        t : ndarray, shape (N,), seconds
            Increasing times.
        v : ndarray, shape (N,), volts
            Voltage.
        rng : Generator
            Draws the specimen: `share`, `moving`, `settling` and the shape of the density.

        Returns
        -------
        ndarray, shape (N,), metres
            The displacement.
        """
        return self.begin(float(v[0]), rng)(np.diff(t, prepend=t[0]), v)

    def begin(self, v0: float, rng: np.random.Generator) -> Continued:
        """Return the stage, at the voltage `v0` (V) after negative saturation, to be continued piece by piece."""
        share, moving, settling = (_specimen(rng, x) for x in (self.share, self.moving, self.settling))
        width = _specimen(rng, self.width)
        growth, slope = _specimen(rng, self.width_growth), _specimen(rng, self.bias_slope)
        up, down, weights = _density(self.relays, width, growth, slope)
        weights = share * weights / _within(up, down, weights)
        gain, state = (1.0 - share) / 100.0, np.zeros(up.size, dtype=np.bool_)
        place, felt, order = np.zeros(2, dtype=np.intp), np.zeros(2), (np.argsort(up), np.argsort(down))

        def continued(durations: FloatArray, v: FloatArray) -> FloatArray:
            z = moved(durations, v, state, place, felt, up, down, *order, weights, gain, 100.0 * moving, settling)
            return np.asarray(self.stroke * z)

        # The first sample settles at once.
        continued(np.array([np.inf]), np.array([v0]))
        return continued


def _specimen(rng: np.random.Generator, value: float) -> float:
    """Return a parameter of the specimen, of the same sign as `value`."""
    return float(value * np.exp(SCATTER * rng.standard_normal()))


def _density(count: int, width: float, growth: float, slope: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return upper and lower thresholds (V) and weights of relays, shape (count,) each.

    The thresholds exceed the range of 0 to 100 V by half of it. Widths are exponential, with a mean and a density that
    depend on the bias.
    """
    number = np.arange(count)
    b = 2.0 * ((number + 0.5) * _GOLDEN % 1.0) - 1.0
    # 1.5 half ranges on both sides of the centre.
    bias = 50.0 + 75.0 * b
    mean = width * (1.0 + growth * np.clip(1.5 * b, -1.5, 1.5))
    half = -0.5 * mean * np.log1p(-(number + 0.5) / count)
    return bias + half, bias - half, np.exp(1.5 * slope * b)


def _within(up: FloatArray, down: FloatArray, weights: FloatArray) -> float:
    """Return the weight of the relays that both a rise to 100 V and a fall to 0 V switch."""
    return float(np.sum(weights[(up < 100.0) & (down > 0.0)]))


def _followed(durations: FloatArray, v: FloatArray, time_constant: float, start: float | None = None) -> FloatArray:
    """Return `v` (V), linear between samples, after a first-order low-pass filter at `start` (V); default: at rest."""
    out, now, before = np.empty_like(v), float(v[0]) if start is None else start, float(v[0])
    for index, (duration, voltage) in enumerate(zip(durations.tolist(), v.tolist(), strict=True)):
        # The filter's distance from its input, driven by a ramp, in closed form.
        behind = now - before
        if duration > 0.0:
            lag = (voltage - before) / duration * time_constant
            behind = -lag + (behind + lag) * math.exp(-duration / time_constant)
            now = voltage + behind
        out[index], before = now, voltage
    return out


@compiled
def flipped(
    durations: FloatArray,
    v: FloatArray,
    p: FloatArray,
    up: FloatArray,
    down: FloatArray,
    weights: FloatArray,
    attempts: float,
    thermal: float,
    before: float,
) -> FloatArray:
    """Return the weighted sum of thermally activated relays, shape (N,); `p` is their state and is modified.

    Parameters
    ----------
    durations : ndarray, shape (N,), seconds
        From the preceding sample.
    v : ndarray, shape (N,), volts
        Voltage, linear between samples.
    p : ndarray, shape (M,)
        Share of each class that is up before the first sample.
    up, down : ndarray, shape (M,), volts
        Thresholds.
    weights : ndarray, shape (M,)
        Contribution of each class to the sum.
    attempts, thermal : float, 1/s and volts
        As in `ThermalRelays`.
    before : float, volts
        Voltage of the preceding sample.
    """
    out = np.empty_like(v)
    for n in range(v.size):
        last = v[n - 1] if n else before
        middle, half = 0.5 * (v[n] + last), 0.5 * (v[n] - last) / thermal
        # Mean of an exponential over a linear step, relative to its value at mid-step.
        mean = math.sinh(half) / half if abs(half) > 1e-6 else 1.0
        expected = attempts * durations[n] * mean
        total = 0.0
        for k in range(p.size):
            rise = expected * math.exp(min((middle - up[k]) / thermal, 60.0))
            fall = expected * math.exp(min((down[k] - middle) / thermal, 60.0))
            both = rise + fall
            if both > 1e-12:
                goal = rise / both
                p[k] = goal + (p[k] - goal) * math.exp(-both)
            total += weights[k] * p[k]
        out[n] = total
    return out


@compiled
def slipped(
    durations: FloatArray,
    v: FloatArray,
    deflection: FloatArray,
    slipping: FloatArray,
    shares: FloatArray,
    breakaways: FloatArray,
    kinetic: float,
    stribeck: float,
    attraction: float,
    before: float,
) -> FloatArray:
    """Return the weighted sum of the deflections of Maxwell-slip elements, shape (N,), volts.

    `deflection` (V) and `slipping` (direction, or 0), shape (M,), are their state and are modified.

    Parameters
    ----------
    durations : ndarray, shape (N,), seconds
        From the preceding sample.
    v : ndarray, shape (N,), volts
    shares, breakaways : ndarray, shape (M,), dimensionless and volts
    kinetic, stribeck, attraction : float
        As in `MaxwellSlip`.
    before : float, volts
        Voltage of the preceding sample.
    """
    out = np.empty_like(v)
    for n in range(v.size):
        dv = v[n] - (v[n - 1] if n else before)
        way = 1.0 if dv > 0.0 else -1.0
        total = 0.0
        if dv != 0.0 and durations[n] > 0.0:
            friction = kinetic + (1.0 - kinetic) * math.exp(-abs(dv) / durations[n] / stribeck)
            settled = -math.expm1(-attraction * durations[n])
        else:
            friction, settled = 1.0, 0.0
        for k in range(shares.size):
            if dv != 0.0:
                limit = way * breakaways[k] * friction
                if slipping[k] != way:
                    slipping[k] = 0.0
                    deflection[k] += dv
                    if way * (deflection[k] - limit) >= 0.0:
                        slipping[k] = way
                        # An element that breaks away within the sample stays where it breaks away, at static friction.
                        deflection[k] = way * min(way * deflection[k], breakaways[k])
                if slipping[k] != 0.0:
                    deflection[k] += (limit - deflection[k]) * settled
            total += shares[k] * deflection[k]
        out[n] = total
    return out


@compiled
def moved(
    durations: FloatArray,
    v: FloatArray,
    state: NDArray[np.bool_],
    place: NDArray[np.intp],
    felt: FloatArray,
    up: FloatArray,
    down: FloatArray,
    rising: NDArray[np.intp],
    falling: NDArray[np.intp],
    weights: FloatArray,
    gain: float,
    moving: float,
    settling: float,
) -> FloatArray:
    """Return the displacement of the moving Preisach model, shape (N,), in strokes.

    Only the relays whose thresholds the effective voltage crosses are looked at. `state`, shape (M,), whether each
    relay is up; `place`, shape (2,), the number of relays whose upper and whose lower threshold has been crossed; and
    `felt`, shape (2,), the displacement that acts back and that of the relays (strokes), are modified.

    Parameters
    ----------
    durations : ndarray, shape (N,), seconds
        From the preceding sample.
    v : ndarray, shape (N,), volts
    up, down : ndarray, shape (M,), volts
        Thresholds of the relays.
    rising, falling : ndarray of int, shape (M,)
        Relays in the order of their upper and of their lower thresholds.
    weights : ndarray, shape (M,), strokes
    gain : float, 1/V
        Linear part, strokes per volt.
    moving : float, volts
        Effective voltage per stroke.
    settling : float, seconds
        Time constant with which the displacement acts back.
    """
    out = np.empty_like(v)
    above, below = place[0], place[1]
    for n in range(v.size):
        field = v[n] + moving * felt[0]
        while above > 0 and up[rising[above - 1]] > field:
            above -= 1
        while below > 0 and down[falling[below - 1]] >= field:
            below -= 1
            k = falling[below]
            if state[k]:
                state[k] = False
                felt[1] -= weights[k]
        while above < up.size and up[rising[above]] <= field:
            k = rising[above]
            above += 1
            if not state[k]:
                state[k] = True
                felt[1] += weights[k]
        while below < down.size and down[falling[below]] < field:
            below += 1
        out[n] = gain * v[n] + felt[1]
        felt[0] = out[n] + (felt[0] - out[n]) * math.exp(-durations[n] / settling)
    place[0], place[1] = above, below
    return out
