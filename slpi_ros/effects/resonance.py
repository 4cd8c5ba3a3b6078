"""Resonance: modes of the mechanics, from those that ring after every reversal to well damped ones."""

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise, zip_longest
from math import inf, pi, sqrt
from typing import Any

import numpy as np

from slpi_ros.arrays import FloatArray
from slpi_ros.effects.base import (
    Candidate,
    Effect,
    EffectContext,
    FitContext,
    StreamingEffect,
    by_record,
    rhythms,
    usual_step,
)
from slpi_ros.effects.excitation import FEWEST_STEPS, DriveLimits, DrivePath, Excitation, loops, move, remaining
from slpi_ros.effects.filters import LEAST_GAIN, SPACING, WIDEST, Dynamics, Mode, StreamingMode, filtered, mode_poles
from slpi_ros.effects.parameters import parameter, require

# A zero is near a mode up to this ratio of the squared frequencies, which is the largest gain of `Exact`.
NEAR = 10.0
# Of a damping that is uncertain at least this share is assumed.
LEAST_DAMPING = 0.5
# Largest error of the inverse on a whole path, as a share of the path: more is by rounding, or by a path not from rest.
ROUNDING = 1e-4
# Number of time constants after which nothing is left of a motion that dies out.
SETTLED = 30.0
# Largest number of modes, and the smallest share of the motion beside the modes that is none by rounding.
MOST_MODES, LEAST_REST = 10, 1e-9


class Exact(StreamingMode):
    """Inverse of a mode with a zero near it: the ratio of their polynomials, with static gain 1, as a filter."""

    # It is a weighted sum of input, position and velocity of the zero, a mode that the desired displacement drives.
    def __init__(self, mode: Mode, zero: Mode) -> None:
        super().__init__(zero)
        self.zero = zero
        high = (zero.omega / mode.omega) ** 2
        self._weights, self._late = (high, 1 - high, mode.lag - high * zero.lag), mode.lag - zero.lag
        self._longest = WIDEST / zero.omega

    @property
    def law(self) -> tuple[float, ...]:
        """Numbers for the compiled inverse: 0, the zero's frequency and damping, weights, delay and longest step."""
        return 0.0, self.zero.omega, self.zero.damping, *self._weights, self._late, self._longest

    def inverse(self, dt: float, wanted: float) -> float:
        """Return the input (m) for `wanted` (m) after `dt` (s); keep the state."""
        if dt >= self._longest:
            return wanted + (wanted - self.state[0]) * (self._late / dt)
        direct, moved, moving = self._weights
        _, position, velocity = self.after(dt, wanted)
        return direct * wanted + moved * position + moving * velocity


class Unringing:
    """Inverse of a mode as a finite impulse response, ``sum_k taps[k] y(t - k spacing)``."""

    # The sum of the taps is 1. Two zeros are at the poles of the mode, and one more compensates the remaining delay but
    # `known` (s). Each desired displacement is stored with the time since the one before it: a clock that runs for days
    # has too few digits.
    def __init__(self, mode: Mode, known: float) -> None:
        self._mode, self._late = mode, mode.lag - known
        self._spacing = self._shortest = SPACING / mode.omega
        self._taps = self._of(self._shortest)

    @property
    def law(self) -> tuple[float, ...]:
        """Numbers for the compiled inverse: 1, frequency and damping, delay and shortest spacing."""
        return 1.0, self._mode.omega, self._mode.damping, self._late, self._shortest, 0.0, 0.0, 0.0

    def _of(self, spacing: float) -> tuple[float, float, float, float]:
        """Return the taps for a spacing (s)."""
        a, b, c = 1.0, 0.0, 0.0
        if spacing * self._mode.omega < WIDEST:
            total, product = mode_poles(self._mode.omega, self._mode.damping, spacing)
            a, b, c = (part / (1 - total + product) for part in (1.0, -total, product))
        delay = self._late / spacing + b + 2 * c
        return a * (1 + delay), b * (1 + delay) - a * delay, c * (1 + delay) - b * delay, -c * delay

    def start(self, x: float) -> None:
        """Initialise to equilibrium at `x` (m)."""
        self.state = (0.0,), (x,)

    @property
    def state(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Stored desired displacements: ages (s), and values (m), constant before the oldest."""
        ages, age = [0.0], 0.0
        for gap, _ in list(self._desired)[:0:-1]:
            age += gap
            ages.append(age)
        return tuple(reversed(ages)), tuple(y for _, y in self._desired)

    @state.setter
    def state(self, state: tuple[tuple[float, ...], tuple[float, ...]]) -> None:
        ages, values = state
        gaps = [inf, *(older - age for older, age in pairwise(ages))]
        self._desired = deque(zip(gaps, values, strict=True))

    def inverse(self, dt: float, wanted: float) -> float:
        """Return the input (m) for `wanted` (m) after `dt` (s); keep the state."""
        spacing = max(dt, self._shortest)
        if spacing != self._spacing:
            self._spacing, self._taps = spacing, self._of(spacing)
        taps = self._taps
        later, earlier, at, value = 0.0, dt, spacing, wanted
        needed, k = taps[0] * wanted, 1
        # From the newest sample to the oldest, with linear interpolation; ages count from now.
        for gap, before in reversed(self._desired):
            while at <= earlier:
                share = (earlier - at) / (earlier - later) if earlier > later else 0.0
                needed += taps[k] * (before + (value - before) * share)
                k += 1
                if k == len(taps):
                    return needed
                at += spacing
            later, value = earlier, before
            earlier += gap
        # Not `sum`, which rounds otherwise than the compiled inverse.
        left = 0.0
        for tap in taps[k:]:
            left += tap
        return needed + left * value

    def move(self, dt: float, wanted: float) -> None:
        """Advance by `dt` (s) to `wanted` (m), and forget what is older than all taps."""
        desired = self._desired
        desired.append((dt, wanted) if dt > 0.0 else (desired.pop()[0], wanted))
        oldest, age, kept = 4 * max(self._shortest, dt), 0.0, 1
        for gap, _ in reversed(desired):
            age, kept = age + gap, kept + 1
            if age >= oldest:
                break
        while len(desired) > kept:
            desired.popleft()


class StreamingResonance(StreamingEffect):
    """Streaming (sample by sample) resonance."""

    def __init__(self, resonance: "Resonance") -> None:
        self._gains, self._rest = [mode.gain for mode in resonance.modes], resonance.rest
        self._modes, self._factors = [StreamingMode(mode) for mode in resonance.modes], resonance.factors()
        self.start(0.0)

    def start(self, x: float) -> None:
        """Initialise to equilibrium at `x` (m)."""
        for each in (*self._modes, *self._factors):
            each.start(x)
        # Time step (s) of the last call of `inverse`, -1 after a move; inputs (m) of the factors.
        self._asked, self._inputs = -1.0, [x] * len(self._factors)

    def forward(self, dt: float, x: float) -> float:
        """Advance by `dt` (s) to the input `x` (m) and return the position of the stage (m)."""
        y = self._rest * x
        for gain, mode in zip(self._gains, self._modes, strict=True):
            mode.state = state = mode.after(dt, x)
            y += gain * state[1]
        if dt != self._asked:
            self.inverse(dt, y if self._asked < 0.0 else self._inputs[0])
        for factor, wanted in zip(self._factors, self._inputs, strict=True):
            factor.move(dt, wanted)
        self._asked = -1.0
        return y

    def inverse(self, dt: float, wanted: float) -> float:
        """Return the input (m) for the desired position `wanted` (m)."""
        self._asked = dt
        for k, factor in enumerate(self._factors):
            self._inputs[k] = wanted
            wanted = factor.inverse(dt, wanted)
        return wanted

    def snapshot(self) -> tuple[Any, ...]:
        """Return the states of the modes, and of the factors of the inverse."""
        return tuple(each.state for each in (*self._modes, *self._factors))

    def restore(self, state: tuple[Any, ...]) -> None:
        """Replace the state by one returned by `snapshot`."""
        for each, own in zip((*self._modes, *self._factors), state, strict=True):
            each.state = own
        self._asked = -1.0


# Modes of the candidates: lowest frequency (Hz) of spectral peaks and of the others, highest as share of the sampling
# rate, number of spectral peaks and of the others; dampings of those at a peak, and of the others.
LOWEST, SLOWEST, HIGHEST, LINES, OTHERS = 10.0, 3.0, 0.45, 4, 10
DAMPINGS, WELL_DAMPED = (0.02, 0.08), (0.08, 0.5, 1.5)
# Step of the derivatives by frequency, as a share of the half bandwidth, and by damping, as a share of that.
STEP = 0.05
# Largest damping ratio of a mode from one drive frequency, up to this ratio of those of several records: a mode that
# hardly rings is a lag or a delay there.
AT_ONE_SPEED, ONE_SPEED = 0.3, 1.25
# Highest frequency of any mode, as a multiple of the highest excited frequency; above it only sharp ones can be
# identified, with at most this damping ratio: turns excite them, and others only shift in time.
RINGS, SHARP = 2.0, 0.1


def _draw(path: DrivePath, limits: DriveLimits) -> None:
    step, levels, repeats = 0.1, (0.2, 0.5, 0.8), 3
    ring = 0.5 * remaining(limits) / (len(levels) * (1 + 2 * repeats))
    for level in levels:
        move(path, level)
        path.hold(ring)
        for _ in range(repeats):
            for to in (level + step, level):
                path.to(to, 0.0, straight=True)
                path.hold(ring)
    # In the sweep each half-wave is one sample shorter than the previous one; two loops of each take 0.3 of the time.
    move(path, 0.5)
    longest = int(sqrt(0.3 * remaining(limits) * limits.rate / 2))
    for steps in range(longest, FEWEST_STEPS - 1, -1):
        loops(path, 0.5 - step / 4, 0.5 + step / 4, steps / limits.rate, 2)


@dataclass(frozen=True)
class Resonance(Effect):
    """Superposition of second-order modes, ``y = h + sum_k gain_k (M_k[h] - h)``, ``M_k`` a `Mode`.

    With ``D_k`` the polynomial of mode k, ``y = N / (D_1 D_2 ..) h``. The inverse is the product of ``D_k / N_k``, with
    the quadratic factors ``N_k`` of ``N`` in order of frequency. Where the zeros of ``N_k`` are near the mode this is
    `Exact`. Else, as ``1 / N_k`` hardly matters and the exact inverse of the sampled mode is unstable or large, the
    factor is `Unringing`: it cancels the oscillation, follows ramps without error, and is bounded. On a whole path what
    is unstable runs backward in time, see `invert`.
    """

    side = "stage"
    is_filter = True
    what = "modes of the mechanics, ringing or well damped, each with its share of the motion"
    compensated = (
        "exactly where `slpi compensate` has the whole path; sample by sample, as in the compensator, if a part of the "
        "motion follows at once, else what would ring is taken out"
    )
    time_shift = "partly"
    looks_ahead = True
    excitation = Excitation(
        "Small steps as fast as allowed with time to ring down, at three levels, then a sweep up to a sixth of the "
        "sampling rate: only a resonance rings on, at one frequency (sample at six times that or more).",
        _draw,
        separates=("lag", "delay"),
        order=2,
        lacking=(0.2, "no record holds small quick steps, where a resonance, a delay or a lag would show"),
    )

    modes: tuple[Mode, ...] = parameter("", "modes of the mechanics", count=(1, MOST_MODES))

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self, ("modes", self.rest >= 0, "of gains that are at most 1 in sum"))

    @classmethod
    def limited(cls, changed: dict[str, Any]) -> dict[str, Any]:
        """Return new parameters with gains that are at most 1 in sum."""
        return {"modes": _within(changed["modes"])}

    def joined(self, other: "Resonance") -> "Resonance | None":
        """Return the modes of both, with gains that are at most 1 in sum."""
        modes = (*self.modes, *other.modes)
        return Resonance(_within(modes)) if len(modes) <= MOST_MODES else None

    def plausible(self, context: FitContext) -> bool:
        """Return whether modes ring that are far above the excited frequencies, or from a single drive frequency.

        Others shift in time, as a lag or a delay.
        """
        highest, drives = RINGS * context.excited_frequency(), [frequency for frequency, _ in context.drives()]
        most = AT_ONE_SPEED if max(drives) < ONE_SPEED * min(drives) else inf
        return all(mode.damping <= (most if mode.frequency <= highest else SHARP) for mode in self.modes)

    @property
    def rest(self) -> float:
        """Share of the static displacement beside the modes."""
        rest = 1.0 - sum(mode.gain for mode in self.modes)
        return rest if abs(rest) > 1e-12 else 0.0

    @by_record
    def apply(self, signal: FloatArray, around: EffectContext) -> FloatArray:
        """Return the displacement with the resonance, shape (N,), metres; exact for an input linear between samples."""
        grid = around.uniform
        if not grid.dt:
            return np.full_like(signal, signal[0]) if signal.size else signal.copy()
        start, moved = signal[0], grid.on(signal) - signal[0]
        parts = (mode.gain * filtered(*mode.transfer(grid.dt), moved) for mode in self.modes)
        y = grid.off(start + sum(parts, self.rest * moved))
        if step := around.step(signal):
            for mode in self.modes:
                y -= step * mode.gain * mode.release(around.since)
        return y

    @by_record
    def invert(self, signal: FloatArray, around: EffectContext) -> FloatArray:
        """Return the displacement before the modes, shape (N,), metres, of which `apply` makes the signal.

        Exact at each sample of a path that is even, resolves all modes and begins at rest; else sample by sample.
        """
        grid = around.uniform
        if not grid.dt or grid.grid is not grid.t or any(mode.omega * grid.dt >= WIDEST for mode in self.modes):
            return super().invert(signal, around)
        found, still = self._inverted(signal, grid.dt), replace(around, start=None)
        # Once more with what rounding leaves: modes that are slow against the sampling have poles near 1.
        found += self._inverted(signal - self.apply(found, still), grid.dt)
        if not np.max(np.abs(self.apply(found, still) - signal)) <= ROUNDING * np.ptp(signal):
            return super().invert(signal, around)
        if around.step(signal):
            # The way to its beginning cannot be followed at once: as sample by sample, until that has settled.
            ends = [SETTLED / mode.decay for mode in self.inverse_modes()]
            ends += [4 * max(SPACING / mode.omega, grid.dt) for mode in self.modes]
            first = signal[: int(np.searchsorted(around.since, max(ends), "right")) + 1]
            around = replace(around, t=around.t[: first.size], grid=None)
            found[: first.size] += super().invert(np.full_like(first, signal[0]), around) - signal[0]
        return np.asarray(found)

    def _inverted(self, signal: FloatArray, dt: float) -> FloatArray:
        """Return the displacement before the modes, shape (N,), m, for a path from rest, with step `dt` (s)."""
        from scipy.signal import lfilter

        whole, shares = np.ones(1), self.rest * np.ones(1)
        for mode in self.modes:
            numerator, denominator = mode.transfer(dt)
            shares = np.convolve(shares, denominator) + mode.gain * np.convolve(whole, numerator)
            whole = np.convolve(whole, denominator)
        roots = np.roots(shares)
        outside = roots[np.abs(roots) >= 1]
        stable = np.polydiv(shares, np.real(np.poly(outside)))[0]
        moved = filtered(whole, stable, signal - signal[0]).astype(np.complex128)
        for root in outside:
            # ``x[n] = (x[n + 1] - moved[n + 1]) / root``, from the end, where the path goes on as it is.
            last = moved[-1:] / (1 - root)
            moved = np.append(lfilter([-1 / root], [1, -1 / root], moved[:0:-1], zi=last / root)[0][::-1], last)
        return np.asarray(signal[0] + np.real(moved), dtype=np.float64)

    def factors(self) -> list[Unringing | Exact]:
        """Return the factors of the inverse, one for each mode, in equilibrium at 0 m."""
        ordered = sorted(self.modes, key=lambda mode: mode.frequency)
        found: list[Unringing | Exact] = [
            Exact(mode, zero)
            if zero and zero.omega**2 <= NEAR * mode.omega**2
            else Unringing(mode, zero.lag if zero else 0.0)
            for mode, zero in zip_longest(ordered, zeros(ordered, self.rest))
        ]
        return sorted(found, key=lambda factor: isinstance(factor, Exact))

    def inverse_modes(self) -> list[Mode]:
        """Return the modes of the inverse itself: the zeros of the factors that are inverted exactly."""
        return [factor.zero for factor in self.factors() if isinstance(factor, Exact)]

    @classmethod
    def fit(cls, context: FitContext) -> Iterator[Candidate]:
        """Yield light modes at the strongest frequencies of the residual, and others on a logarithmic grid."""
        highest = HIGHEST / usual_step(context.t)
        found = [frequency for frequency in rhythms(context, LINES, LOWEST) if frequency < highest]
        others = np.geomspace(min(SLOWEST, highest), highest, OTHERS).tolist()
        for frequency in (*found, *others):
            for damping in DAMPINGS if frequency in found else WELL_DAMPED:
                mode = Mode(frequency, damping)
                columns = [cls((mode,)).column(context)]
                if frequency in found and damping == DAMPINGS[0]:
                    # A mode that rings for long explains nothing beside its frequency: both are free to first order.
                    tuned = replace(mode, frequency=frequency * (1.0 + STEP * damping))
                    damped = replace(mode, damping=damping * (1.0 + STEP))
                    columns = [*(cls((one,)).column(context) - columns[0] for one in (tuned, damped)), *columns]
                yield Candidate(np.column_stack(columns), partial(cls._if_seen, mode), positive=1)
                if frequency not in found:
                    # All of the motion, as of a mirror on its bearing.
                    yield Candidate(np.column_stack(columns), partial(cls._whole, mode), positive=1, group=1)

    @classmethod
    def _if_seen(cls, mode: Mode, gains: FloatArray) -> "Resonance | None":
        return cls((replace(mode, gain=min(float(gains[0]), 1.0)),)) if gains[0] >= LEAST_GAIN else None

    @classmethod
    def _whole(cls, mode: Mode, gains: FloatArray) -> "Resonance | None":
        return cls((replace(mode, gain=1.0),)) if gains[0] > 0.5 else None

    @property
    def dynamics(self) -> Dynamics:
        """The modes beside each other, and what follows at once."""
        each = [mode.dynamics for mode in self.modes]
        a = np.zeros((2 * len(each), 2 * len(each)))
        for k, mode in enumerate(each):
            a[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = mode.a
        gains = np.repeat([mode.gain for mode in self.modes], 2)
        return Dynamics(a, np.concatenate([m.b for m in each]), gains * np.concatenate([m.c for m in each]), self.rest)

    @property
    def ringing(self) -> tuple[Mode, ...]:
        """Its modes."""
        return self.modes

    def detuned(self, scales: Sequence[float], uncertain: float) -> "Resonance":
        """Return the modes with scaled frequencies, and dampings less by so many standard uncertainties."""
        modes = []
        for k, (mode, scale) in enumerate(zip(self.modes, scales, strict=True)):
            unsure = uncertain * self.uncertainty.get(f"modes.{k}.damping", 0.0)
            damping = max(mode.damping - unsure, LEAST_DAMPING * mode.damping)
            modes.append(replace(mode, frequency=mode.frequency * scale, damping=damping))
        return replace(self, modes=tuple(modes))

    def describe(self) -> str:
        """Describe frequency, damping and share of each mode; of an overdamped one its two time constants."""
        rings = any(mode.damping < 1 / sqrt(2) for mode in self.modes)
        does = "rings after reversals, at" if rings else "follows late, by damped modes of"
        told = f"the stage {does} {' and '.join(_described(mode) for mode in self.modes)}"
        if all(mode.damping >= 1.0 for mode in self.modes):
            told += "; so does a sensor that lags: give its time constant (`--sensor-lag`) if it is known"
        return told

    def laws(self) -> Mapping[str, Any]:
        """Return modes, share beside them and factors for the compiled inverse."""
        modes = np.array([(0.0, mode.omega, mode.damping, mode.gain) for mode in self.modes])
        return {"modes": modes, "rest": self.rest, "factors": np.array([each.law for each in self.factors()])}

    def streaming(self) -> StreamingResonance:
        """Return the streaming modes."""
        return StreamingResonance(self)


def _described(mode: Mode) -> str:
    told = f"damping {mode.damping:.3g}, share {mode.gain:.3g}"
    if mode.damping > 1.0:
        slow = 1.0 / mode.decay
        told += f", as lags of {slow * 1e3:.3g} and {1e3 / (slow * mode.omega**2):.2g} ms behind the hysteresis"
    return f"{mode.frequency:.4g} Hz ({told})"


def _within(modes: Sequence[Mode]) -> tuple[Mode, ...]:
    """Return the modes, with their gains reduced to a sum of at most 1."""
    total = max(sum(mode.gain for mode in modes), 1.0)
    return tuple(replace(mode, gain=mode.gain / total) for mode in modes)


def zeros(modes: Sequence[Mode], rest: float) -> list[Mode]:
    """Return the pairs of zeros of a superposition as modes, in order of frequency; one less if `rest` is 0."""
    # They are the modes of a stage that is held, ``y = 0``. With the forces ``sqrt(gain_k) w_k`` on the modes these are
    # the eigenvalues, but one that is 0, of a skew-symmetric matrix minus the damping: all are stable.
    w, loss = np.array([mode.omega for mode in modes]), np.diag([mode.lag * mode.omega**2 for mode in modes])
    force = np.sqrt([mode.gain for mode in modes]) * w
    if rest > LEAST_REST:
        stiff = np.vstack([np.diag(w), force / np.sqrt(rest)])
    else:
        free = np.linalg.svd(force[None])[2][1:].T
        stiff, loss = w[:, None] * free, free.T @ loss @ free
    nothing = np.zeros((stiff.shape[0],) * 2)
    roots = sorted(np.linalg.eigvals(np.block([[nothing, stiff], [-stiff.T, -loss]])), key=abs)[1:]
    # Of two that are conjugate one stands for both; those that do not oscillate are pairs in order.
    lags = [root for root in roots if not root.imag]
    pairs = [(root, root.conjugate()) for root in roots if root.imag > 0]
    pairs += zip(lags[::2], lags[1::2], strict=True)
    found = [(sqrt(abs(one * other)), -(one + other).real / 2) for one, other in pairs]
    # With rounding errors.
    return [Mode(omega / (2 * pi), max(float(rate / omega), 1e-9)) for omega, rate in sorted(found)]
