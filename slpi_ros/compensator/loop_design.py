"""Design of the closed loop of one axis: gains, notches and low pass of the largest bandwidth at a modulus margin."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from math import ceil, inf, isfinite, log, pi, sqrt

import numpy as np

from slpi_ros.arrays import FloatArray
from slpi_ros.compensator.feedback import PidGains
from slpi_ros.compensator.loop_filter import LoopFilter, Notch, response, sections
from slpi_ros.compensator.loop_margin import BESIDE, LEAST_MARGIN, ComplexArray, DiscreteLoop, Plant
from slpi_ros.effects.filters import Mode
from slpi_ros.errors import ModelError, UsageError
from slpi_ros.model.axis_model import AxisModel

# Smallest modulus margin that a design keeps, and that can be asked for; share by which each mode may be off.
MARGIN, MARGINS, DETUNING = 0.5, (0.3, 0.9), 0.1
# Delay of the two messages of a correction that no record holds, s, from none to this.
MESSAGES = 3e-4
# The margin is kept where the slope is larger by this share than that of the largest loop.
STEEPER = 0.05
# Above this ratio of the highest mode no record tells modes from lags and delays: the response may be that of the
# model times the second number, with any phase.
KNOWN, UNKNOWN = 2.0, 2.0
# So many standard uncertainties less damping.
UNCERTAIN = 2.0
# Scales of the frequencies of a measured response.
MEASURED_OFF = (1.0 - DETUNING, 1.0 - DETUNING / 2.0, 1.0, 1.0 + DETUNING / 2.0, 1.0 + DETUNING)
# Detunings of all modes alike, and most modes of which all combinations are looked at.
STEPS, COMBINED = 9, 3
# The lowest frequency over the slowest rate of the loop, and the number of frequencies.
LOWEST, FREQUENCIES = 1e-3, 300
# Width of a notch that inverts its mode.
WIDE = 10.0
# A low pass may cost this share of the bandwidth for less noise.
FOR_NOISE = 0.03
# Bounds of damping and width of a notch, and of its frequency over that of the mode.
DAMPINGS, WIDTHS, BESIDE_MODE = (1e-4, 3.0), (0.03, 30.0), (0.75, 1.33)
# A time of a controller that is none, in periods; population for each number, at most, and generations of the search.
NONE, POPULATION, MOST_TRIED, GENERATIONS = 0.01, 10, 60, 60
# |S| at the bandwidth: -3 dB.
HALF = 0.5**0.5
# Sensitivities at which a loop is held against an integrator.
LEVELS = (HALF, 0.5, 0.1)
# Longest step, in periods, and in times of the bandwidth; what counts as settled; size of the step over the stroke.
LONGEST_STEP, STEP_TIMES, SETTLED, STEP = 20_000, 12.0, 0.01, 0.1
# Standard deviations of the noise within which a step has settled to the noise.
NOISES = 3.0
# What limits a bandwidth raises it by at least this ratio where it is absent.
LIMITING = 1.15


@dataclass(frozen=True)
class Loop:
    """A plant that is sampled once in each `period` (s), and those that it may be as well: the corners.

    The nominal plant has the slope of small motions, the corners that of the largest loop from end to end.
    """

    nominal: Plant
    corners: tuple[Plant, ...]
    modes: tuple[Mode, ...]
    period: float
    large: float = 1.0  # slope of the largest loop over that of the nominal plant
    steep: float = 1.0  # steepest slope over that of the largest loop
    # What was measured over what the model says where it is steepest, at rising frequencies (rad/s), (M,) each: one
    # more corner.
    measured: tuple[FloatArray, ComplexArray] | None = None

    @classmethod
    def of(cls, model: AxisModel, period: float, measured: tuple[FloatArray, ComplexArray] | None = None) -> "Loop":
        """Return the loop of a model; ModelError if it has no slope, UsageError for a mode above half the rate."""
        if not model.causal:
            raise ModelError(f"kind {model.kind} needs the path in advance, feedback does not; identify another kind")
        steepest = Plant.of(model)
        largest = replace(steepest, slope=min(model.mean_slope, steepest.slope))
        nominal = replace(steepest, slope=min(_small_slope(model), largest.slope))
        if not (isfinite(nominal.slope) and nominal.slope > 0.0):
            raise ModelError(f"the model has a slope of {nominal.slope:g} m/V; identify it from a record that moves")
        modes = tuple(mode for effect in model.effects for mode in effect.ringing)
        for mode in modes:
            if not mode.frequency * period < 0.5:
                raise UsageError(
                    f"the mode at {mode.frequency:.4g} Hz is above half the loop's rate of {1.0 / period:.4g} Hz; give "
                    "a higher --rate, of sensor and output"
                )
        large, steep = largest.slope / nominal.slope, steepest.slope / largest.slope
        return cls(nominal, tuple(_corners(model, largest)), modes, period, large, steep, measured)

    @cached_property
    def hardest(self) -> "Loop":
        """The loop with the corners that decide nearly always: late messages and, with modes, little damping."""
        each = 4 if self.modes else 2
        return replace(self, corners=self.corners[each - 1 :: each])

    @cached_property
    def omega(self) -> FloatArray:
        """Frequencies, rad/s, shape (N,): dense around the modes of all corners."""
        highest = pi / self.period
        poles = np.concatenate([np.linalg.eigvals(each.dynamics.a) for each in (self.nominal, *self.corners)])
        first = [float(self.measured[0][0])] if self.measured else []
        slowest = min([highest, *np.abs(poles), 1.0 / max(self.nominal.delay, 1e-9), *first])
        near = (np.abs(poles.imag)[:, None] - poles.real[:, None] * BESIDE).ravel()
        spread = [2.0 * pi * mode.frequency * np.linspace(0.7, 1.4, 60) for mode in self.modes]
        seen = [scale * self.measured[0] for scale in MEASURED_OFF] if self.measured else []
        omega = np.concatenate([np.geomspace(LOWEST * slowest, highest, FREQUENCIES), near, *spread, *seen])
        return np.unique(omega[(omega >= LOWEST * slowest) & (omega <= highest)])

    @cached_property
    def delayed(self) -> ComplexArray:
        """Return ratios of nominal plant and corners for a controller of 1 V/m, shape (1 + K, N)."""
        plants = (self.nominal, *self.corners)
        rows = [DiscreteLoop(each, PidGains(1.0), self.period).response(self.omega) for each in plants]
        if self.measured:
            omega, ratio = self.measured
            sizes, angles = np.log(np.abs(ratio)), np.unwrap(np.angle(ratio))
            # Small motions have less slope than larger ones, but not more than the model has for them.
            slope = float(np.median(sizes[: max(3, sizes.size // 20)]))
            sizes -= min(slope, -log(self.large * self.steep))
            # Modes that the model does not know are detuned, too.
            for scale in MEASURED_OFF:
                size, angle = (np.interp(self.omega, scale * omega, of, left=0.0, right=0.0) for of in (sizes, angles))
                rows.append(rows[0] * self.large * (1.0 + STEEPER) * np.exp(size + 1j * angle))
        return np.array(rows)

    @cached_property
    def unknown(self) -> FloatArray:
        """How large the response (m/V) may be above `KNOWN` times all modes and what was measured, else 0, (N,)."""
        several = [KNOWN * mode.omega for mode in self.modes] + ([float(self.measured[0][-1])] if self.measured else [])
        known = max(several, default=inf)
        # A lag that is as short may be a delay, which leaves large what is fast.
        poles = np.linalg.eigvals(self.nominal.dynamics.a)
        short = -poles.real[(np.abs(poles.imag) < 1e-9 * np.abs(poles)) & (-poles.real > known)]
        less = np.prod(np.hypot(1.0, self.omega[:, None] / short), axis=1)
        return np.asarray((self.omega > known) * UNKNOWN * less * np.max(np.abs(self.delayed), axis=0))

    @cached_property
    def z(self) -> ComplexArray:
        """``exp(i w period)``, shape (N,)."""
        return np.asarray(np.exp(1j * self.omega * self.period))

    def controller(self, shape: "Shape") -> ComplexArray:
        """Return the transfer function of a controller with an integral gain of 1 V/(m s), shape (N,)."""
        z = self.z
        pi_part = shape.lead + self.period * z / (z - 1.0)
        return pi_part * response(sections(shape.notches, shape.low_pass, self.period), z)

    def largest(self, shape: "Shape", margin: float) -> float:
        """Return the largest integral gain up to which every smaller one keeps the margins at all corners, V/(m s).

        `margin` is kept at the slope of the largest loop, `LEAST_MARGIN` at the steepest slope, and where nothing is
        known of the stage whatever its phase.
        """
        controller = self.controller(shape)
        back = self.delayed * controller
        size = back.real**2 + back.imag**2
        allowed = [_smallest(back, size, margin), _smallest(back, size, LEAST_MARGIN) / self.steep]
        if loudest := float(np.max(self.unknown * np.abs(controller))):
            allowed.append((1.0 - LEAST_MARGIN) / loudest)
        return min(allowed) if min(allowed) < inf else 0.0

    def bandwidth(self, shape: "Shape", integral: float) -> float:
        """Return the lowest frequency (Hz) at which the sensitivity of the nominal loop reaches -3 dB."""
        return self._reached(self._returned(shape, integral), HALF)

    def speed(self, shape: "Shape", integral: float) -> float:
        """Return the bandwidth (Hz), or that of the integrator whose sensitivity is as large further below."""
        # Else a proportional gain alone had the largest bandwidth, and an error that stays; or a sensitivity hardly
        # below -3 dB over a wide band, which is above it where the stage is a little different.
        returned = self._returned(shape, integral)
        slow = integral * self.nominal.slope / (2.0 * pi)
        return min(slow, *(self._reached(returned, level) * sqrt(level**-2 - 1.0) for level in LEVELS))

    def _returned(self, shape: "Shape", integral: float) -> FloatArray:
        return np.asarray(np.abs(1.0 + integral * self.delayed[0] * self.controller(shape)))

    def _reached(self, returned: FloatArray, sensitivity: float) -> float:
        """Return the lowest frequency (Hz) at which 1 / ``returned``, shape (N,), reaches a sensitivity."""
        below = np.flatnonzero(returned < 1.0 / sensitivity)
        if not below.size or below[0] == 0:
            return 0.0 if below.size else float(self.omega[-1]) / (2.0 * pi)
        k = int(below[0])
        a, b = (log(each * sensitivity) for each in returned[k - 1 : k + 1])
        share = a / (a - b)
        return float(self.omega[k - 1] ** (1.0 - share) * self.omega[k] ** share) / (2.0 * pi)


@dataclass(frozen=True)
class Shape:
    """What a controller is beside its gain: proportional over integral gain (s), low pass (s), and notches."""

    lead: float
    low_pass: float
    notches: tuple[Notch, ...]

    def gains(self, integral: float) -> PidGains:
        """Return the gains with an integral gain (V/(m s)), rounded down to six digits."""
        integral = float(f"{integral * (1.0 - 5e-6):.6g}")
        notches = tuple(Notch(*(float(f"{v:.6g}") for v in (n.frequency, n.damping, n.width))) for n in self.notches)
        return PidGains(
            float(f"{integral * self.lead:.6g}"),
            integral,
            measurement_filter=float(f"{self.low_pass:.6g}"),
            notches=notches,
        )


@dataclass(frozen=True)
class Design:
    """Gains of one axis, and what is expected of them."""

    gains: PidGains
    period: float  # s
    plant: Plant  # with the slope of small motions
    margin: float  # least modulus margin of all corners
    bandwidth: float  # Hz, of small motions
    noise: float  # m, what the noise of the sensor moves the stage by
    limits: dict[str, float]  # bandwidth (Hz) without what limits it: "mode", "delay", "rate"; the largest first

    @property
    def limit(self) -> str:
        """What limits the bandwidth most."""
        return next(iter(self.limits), "")

    def step(self) -> tuple[FloatArray, FloatArray]:
        """Return times (s) and error, shape (N,) each, after a step of 1 without feedforward."""
        return _step(DiscreteLoop(self.plant, self.gains, self.period), self.bandwidth)

    def settling(self, within: float) -> float:
        """Return the time (s) after which the error of a step of 1 stays `within`; infinite if it does not."""
        if not within > 0.0:
            return inf
        t, error = self.step()
        outside = np.flatnonzero(np.abs(error) > within)
        if not outside.size:
            return 0.0
        return float(t[outside[-1] + 1]) if outside[-1] + 1 < t.size else inf


def design(
    model: AxisModel,
    rate: float,
    margin: float = MARGIN,
    measured: tuple[FloatArray, ComplexArray] | None = None,
) -> Design:
    """Return the loop of the largest bandwidth for a model of an axis.

    Parameters
    ----------
    model : AxisModel
    rate : float, hertz
        Corrections per second, and readings.
    margin : float
        Modulus margin, ``min |1 + L|``, that is kept at the slope of the largest loop from end to end with each mode
        off by `DETUNING`, later messages and less damping, as far as the model is uncertain of it; where the loop is
        steepest `LEAST_MARGIN` is.
    measured : (ndarray, ndarray), shape (M,) each, optional
        Frequencies, rad/s, and the measured response there over that of the model where it is steepest: with it the
        margin is kept, too, and with its slope if that is more than the model's for small motions.

    Returns
    -------
    Design

    Raises
    ------
    ModelError
        The model has no slope, or is not causal.
    UsageError
        A margin that cannot be kept, or a mode above half the rate.
    """
    if not MARGINS[0] <= margin <= MARGINS[1]:
        raise UsageError(f"a margin of {margin:g}; give a number from {MARGINS[0]:g} to {MARGINS[1]:g}, as {MARGIN:g}")
    if not (isfinite(rate) and 1.0 <= rate <= 20_000.0):
        raise UsageError(f"a rate of {rate:g} Hz; give what output_rate takes, 1 to 20000 Hz")
    loop = Loop.of(model, 1.0 / rate, measured)
    shape = _quieter(loop, _best(loop, margin), margin)
    gains = shape.gains(loop.largest(shape, margin))
    if not gains.integral > 0.0:
        raise ModelError(f"no gain keeps a margin of {margin:g} at {rate:g} Hz; give a higher --rate")
    found = Shape(gains.proportional / gains.integral, gains.measurement_filter, gains.notches)
    bandwidth = loop.bandwidth(found, gains.integral)
    back = gains.integral * loop.delayed * loop.controller(found)
    others = {name: _bandwidth(other, margin) for name, other in _relieved(model, loop)}
    kept = {name: each for name, each in others.items() if each > LIMITING * bandwidth}
    return Design(
        gains,
        loop.period,
        loop.nominal,
        float(np.min(np.abs(1.0 + back))),
        bandwidth,
        model.quality.floor_rms * _noise_gain(loop, back[0]),
        dict(sorted(kept.items(), key=lambda item: -item[1])),
    )


def _smallest(back: ComplexArray, size: FloatArray, margin: float) -> float:
    """Return the smallest gain at which a return ratio, with the square of its size, is as near to -1 as the margin."""
    inside = back.real**2 - size * (1.0 - margin**2)
    meets = (back.real < 0.0) & (inside > 0.0)
    if not meets.any():
        return inf
    return float(np.min((-back.real[meets] - np.sqrt(inside[meets])) / size[meets]))


def _small_slope(model: AxisModel) -> float:
    """Return the slope (m/V) of a loop of `STEP` of the voltage range about its middle, after the largest one."""
    low, high = model.hysteresis_range
    middle, half = 0.5 * (low + high), 0.5 * STEP * (high - low)
    y = model.memory("end").forward_array(np.array([low, high, low, middle + half, middle - half]))
    return float(y[-2] - y[-1]) / (2.0 * half) if half > 0.0 else 0.0


def _corners(model: AxisModel, largest: Plant) -> Iterator[Plant]:
    """Yield the plants that a model may mean as well."""
    steep = largest.slope * (1.0 + STEEPER)
    for scales in _detunings(sum(len(each.ringing) for each in model.effects)):
        for uncertain in (0.0, UNCERTAIN) if scales else (0.0,):
            changed, left = [], scales
            for effect in model.effects:
                count = len(effect.ringing)
                changed.append(effect.detuned(left[:count], uncertain))
                left = left[count:]
            dynamics = largest.dynamics if not scales else Plant.of(replace(model, effects=tuple(changed))).dynamics
            for later in (0.0, MESSAGES):
                yield Plant(steep, largest.delay + later, dynamics)


def _detunings(count: int) -> list[tuple[float, ...]]:
    """Return the scales of the frequencies of `count` modes."""
    if not count:
        return [()]
    found = {(float(scale),) * count for scale in np.linspace(1.0 - DETUNING, 1.0 + DETUNING, STEPS)}
    ends = (1.0 - DETUNING, 1.0, 1.0 + DETUNING)
    if count <= COMBINED:
        found |= set(product(ends, repeat=count))
    else:
        found |= {tuple(end if j == k else 1.0 for j in range(count)) for k in range(count) for end in ends}
    return sorted(found)


def _relieved(model: AxisModel, loop: Loop) -> Iterator[tuple[str, Loop]]:
    """Yield loops without one of the things that may limit the bandwidth."""
    if loop.modes:
        rigid = replace(model, effects=tuple(each for each in model.effects if not each.ringing))
        yield "mode", Loop.of(rigid, loop.period)
    if loop.nominal.delay > 0.0:
        yield (
            "delay",
            replace(
                loop,
                nominal=replace(loop.nominal, delay=0.0),
                corners=tuple(replace(each, delay=each.delay - loop.nominal.delay) for each in loop.corners),
            ),
        )
    yield "rate", replace(loop, period=loop.period / 4.0)


def _bandwidth(loop: Loop, margin: float) -> float:
    shape = _best(loop, margin, quick=True)
    return loop.speed(shape, loop.largest(shape, margin))


def _best(loop: Loop, margin: float, quick: bool = False) -> Shape:
    """Return the shape of the largest bandwidth."""
    # Imported here because it takes a second.
    from scipy.optimize import differential_evolution, minimize

    highest, count = 0.5 / loop.period, len(loop.modes)
    slowest = 1.0 / min([highest, 1.0 / max(loop.nominal.delay, loop.period), *(mode.omega for mode in loop.modes)])
    times = log(NONE * loop.period), log(30.0 * slowest)
    bounds = [times, times]
    for mode in loop.modes:
        low, high = (min(each, 0.99 * highest / mode.frequency) for each in BESIDE_MODE)
        bounds += [(log(each[0]), log(each[1])) for each in ((low, high), DAMPINGS, WIDTHS)]
    lowest, largest = np.array(bounds).T

    def shape(x: FloatArray) -> Shape:
        values = np.exp(np.clip(x, lowest, largest))
        notches = tuple(
            Notch(mode.frequency * ratio, damping, width)
            for mode, (ratio, damping, width) in zip(loop.modes, values[2:].reshape(count, 3).tolist(), strict=True)
        )
        # A time far below a period is none.
        lead, low_pass = (0.0 if v <= 2.0 * NONE * loop.period else float(v) for v in values[:2])
        return Shape(lead, low_pass, notches)

    def loss(x: FloatArray, of: Loop) -> float:
        tried = shape(x)
        found = of.speed(tried, of.largest(tried, margin))
        return -log(found) if found > 0.0 else 1e3

    size = len(bounds)
    last = {"maxfev": (30 if quick else 60) * size, "xatol": 1e-3, "fatol": 1e-4}

    def searched(seed: int, starts: list[list[float]]) -> tuple[float, FloatArray]:
        others = np.random.default_rng(seed).uniform(lowest, largest, (min(POPULATION * size, MOST_TRIED), size))
        found = differential_evolution(
            loss, bounds, (loop.hardest,), init=np.vstack([np.array(starts).clip(lowest, largest), others]),
            maxiter=GENERATIONS // (2 if quick else 1), tol=1e-4, seed=seed, polish=False,
        )  # fmt: skip
        done = minimize(loss, found.x, (loop,), method="Nelder-Mead", options=last)
        return float(done.fun), done.x

    # The best of both, as a search that follows one kind of start may not find what is better in the other.
    narrow, inverting = _starts(loop)
    every = [searched(0, narrow + inverting), *([] if quick else [searched(1, narrow)])]
    return shape(min(every, key=lambda each: each[0])[1])


def _starts(loop: Loop) -> tuple[list[list[float]], list[list[float]]]:
    """Return logarithms of lead and low pass (s), and of frequency ratio, damping and width of each notch, two kinds.

    Of the second kind one notch is so wide that a proportional part cancels its slow pole: what is left inverts the
    mode.
    """
    none = log(NONE * loop.period)
    lags = [-1.0 / pole.real for pole in np.linalg.eigvals(loop.nominal.dynamics.a) if abs(pole.imag) < -pole.real]
    lag = log(max([loop.period, *(2.0 * mode.damping / mode.omega for mode in loop.modes), *lags]))
    narrow, inverting = [], []
    for lead, low_pass in ((none, none), (lag, none), (lag, lag)):
        for least, width in ((0.0, 1.0), (DETUNING, 1.0), (2.0 * DETUNING, 5.0)):
            notches = [(0.0, log(max(mode.damping, least)), log(width)) for mode in loop.modes]
            narrow.append([lead, low_pass, *(v for each in notches for v in each)])
    for (k, wide), least in product(enumerate(loop.modes), (DETUNING, 2.0 * DETUNING, 4.0 * DETUNING)):
        notches = [
            (0.0, log(max(mode.damping, least)), log(WIDE if j == k else 1.0)) for j, mode in enumerate(loop.modes)
        ]
        inverting.append([log(2.0 * WIDE / wide.omega), none, *(v for each in notches for v in each)])
    return narrow, inverting


def _quieter(loop: Loop, best: Shape, margin: float) -> Shape:
    """Return the shape with the least noise of those with a longer low pass that keep nearly all of the bandwidth."""
    largest = loop.speed(best, loop.largest(best, margin))
    found, least = best, inf
    for low_pass in (best.low_pass, *(best.low_pass + np.geomspace(0.1, 100.0, 31) * loop.period)):
        tried = replace(best, low_pass=float(low_pass))
        integral = loop.largest(tried, margin)
        if loop.speed(tried, integral) < (1.0 - FOR_NOISE) * largest:
            continue
        noise = _noise_gain(loop, integral * loop.delayed[0] * loop.controller(tried))
        if noise < least:
            found, least = tried, noise
    return found


def _noise_gain(loop: Loop, back: ComplexArray) -> float:
    """Return what white noise of the readings moves the stage by, rms over rms, for a return ratio, shape (N,)."""
    moved = np.abs(back / (1.0 + back)) ** 2
    omega = loop.omega
    area = float(np.sum(0.5 * (moved[1:] + moved[:-1]) * np.diff(omega))) + float(moved[0] * omega[0])
    return float((area * loop.period / pi) ** 0.5)


def _step(loop: DiscreteLoop, bandwidth: float) -> tuple[FloatArray, FloatArray]:
    """Return times (s) and error, shape (N,) each, of the loop after a step by 1 without feedforward."""
    gains, period, plant = loop.gains, loop.period, loop.plant
    count = min(ceil(STEP_TIMES / max(bandwidth, 1e-9) / period) + 10, LONGEST_STEP)
    kept, early, late = loop.held
    filters = LoopFilter(gains.notches, gains.measurement_filter, period)
    states, x, integral = filters.at_rest(0.0), np.zeros(len(early)), 0.0
    waiting = [0.0] * (ceil(plant.delay / period) + 1)
    before, errors = 0.0, np.empty(count)
    for k in range(count):
        # What is output a period after the reading, and later by the delay.
        given = waiting.pop(0)
        x = kept @ x + early * given + late * before
        before = given
        errors[k] = 1.0 - plant.slope * float(plant.dynamics.c @ x + plant.dynamics.d * given)
        error, states = filters.after(states, float(errors[k]), 1)
        integral += gains.integral * period * error
        waiting.append(gains.proportional * error + integral)
    return np.asarray(np.arange(count) * period), errors
