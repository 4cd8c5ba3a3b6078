"""Lightly damped modes of what answers to a path that repeats: their answers, and how they are found in ringing."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.signal import lfilter

from slpi_ros.arrays import FloatArray
from slpi_ros.learning.harmonics import ComplexArray

# Dampings that are tried for a mode; steps of its frequency as a multiple of the width of its peak; the lowest
# frequency (periods in a pass, and as a share of the sampling rate), and the highest. Modes within this share of their
# frequency are one.
DAMPINGS, PEAK_STEP, LEAST_PERIODS, LOWEST, HIGHEST, SAME = (0.008, 0.025), 1.5, 1.5, 0.01, 0.4, 0.12
# Most that an estimate moves the frequency and the decay of a mode at once, and its largest decay over a sample.
MOST_FASTER, MOST_SLOWER, MOST_RATE = 0.03, 2.0, 1.0


@dataclass(frozen=True)
class Mode:
    """A mode by its pole: from one sample to the next a free oscillation changes by ``exp(-rate + j angle)``.

    `exact`: known exactly, as it is one of the inverse itself. `unsure`: standard deviation of the angle.
    """

    rate: float  # 1/sample
    angle: float  # rad/sample
    exact: bool = False
    unsure: float = 0.0

    @classmethod
    def of(cls, frequency: float, damping: float, dt: float, *, exact: bool = False, unsure: float = 0.0) -> "Mode":
        """Return the mode of a frequency (Hz) and damping ratio, sampled at `dt` (s)."""
        w = 2.0 * math.pi * frequency * dt
        return cls(damping * w, w * math.sqrt(max(1.0 - damping**2, 0.0)), exact, unsure)

    @property
    def step(self) -> complex:
        """Factor of a free oscillation from one sample to the next."""
        return complex(np.exp(-self.rate + 1j * self.angle))

    def moved(self, slower: float, faster: float) -> "Mode":
        """Return the mode with less decay (1/sample) and a higher frequency (rad/sample), within bounds."""
        if self.exact:
            return self
        return replace(
            self,
            rate=min(max(self.rate - slower, self.rate / MOST_SLOWER), self.rate * MOST_SLOWER, MOST_RATE),
            angle=min(max(self.angle + faster, (1.0 - MOST_FASTER) * self.angle), (1.0 + MOST_FASTER) * self.angle),
        )

    def near(self, angle: float, reach: float) -> "Mode":
        """Return the mode with a frequency (rad/sample) not further than `reach` from `angle`."""
        return replace(self, angle=min(max(self.angle, angle - reach), angle + reach))


@dataclass(frozen=True)
class ModeAnswers:
    """Answers of M modes, linear in their residues, in small moves of their poles, and in what rings from before.

    Columns are real and imaginary part of each residue, then decrease of the decay and increase of the frequency of
    each pole. `residues` and `rings` (m) are the present estimates, (M,), by which moves of the poles become visible.
    """

    modes: tuple[Mode, ...]
    residues: ComplexArray
    rings: ComplexArray

    def response(self, w: FloatArray) -> ComplexArray:
        """Return the frequency response, (len(w), 4 M), at `w` (rad/sample)."""
        z, own, moves = np.exp(-1j * w), [], []
        for mode, residue in zip(self.modes, self.residues, strict=True):
            factor = complex(residue) * mode.step
            up, down = 1.0 / (1.0 - mode.step * z), 1.0 / (1.0 - mode.step.conjugate() * z)
            own += _parts(up, down)
            moves += _parts(factor * z * up**2, factor.conjugate() * z * down**2)
        return columns(own + moves, w.size)

    def answers(self, commanded: Sequence[FloatArray], begin: int) -> list[ComplexArray]:
        """Return the spectra of the answers, (K, 4 M), in passes (m, (N,)) that follow one another, from `begin` on."""
        n, own, moves = commanded[0].size, [], []
        whole = np.concatenate(commanded).astype(np.complex128)
        for mode, residue in zip(self.modes, self.residues, strict=True):
            one, factor = np.array([1.0, -mode.step]), complex(residue) * mode.step
            q = lfilter([1.0], one, whole)
            moved = factor * lfilter([0.0, 1.0], one, q)
            own += [q.real, -q.imag]
            moves += [moved.real, -moved.imag]
        return [
            columns([np.fft.rfft(x[j * n : (j + 1) * n]) for x in own + moves], n // 2 + 1)
            for j in range(begin, len(commanded))
        ]

    def ringing(self, size: int, number: int) -> ComplexArray:
        """Return the spectra, (K, 4 M), in a pass of `size` samples, of what rings from before that of number 0."""
        at, own, moves = np.arange(size) + float(number * size), [], []
        for mode, ring in zip(self.modes, self.rings, strict=True):
            q = np.exp((-mode.rate + 1j * mode.angle) * at)
            moved = ring * at * q
            own += [q.real, -q.imag]
            moves += [moved.real, -moved.imag]
        return columns([np.fft.rfft(x) for x in own + moves], size // 2 + 1)


def columns(parts: Sequence[ComplexArray], size: int) -> ComplexArray:
    """Return columns (size,) side by side, also none."""
    return np.stack(parts, axis=1) if parts else np.zeros((size, 0), dtype=np.complex128)


def _parts(one: ComplexArray, other: ComplexArray) -> list[ComplexArray]:
    """Return spectra of the real and the negative imaginary part of a signal with spectra of it and its conjugate."""
    return [0.5 * (one + other), 0.5j * (one - other)]


def candidates(size: int, known: Sequence[Mode]) -> list[Mode]:
    """Return modes that may be those of passes of `size` samples, but those that are like the known ones."""
    found: list[Mode] = []
    for damping in DAMPINGS:
        frequency = max(LEAST_PERIODS / size, LOWEST)
        while frequency < HIGHEST:
            step = PEAK_STEP * damping * frequency
            mode = Mode.of(frequency, damping, 1.0, unsure=2.0 * math.pi * step)
            if all(abs(mode.angle - one.angle) > SAME * one.angle for one in known):
                found.append(mode)
            frequency += step
    return found
