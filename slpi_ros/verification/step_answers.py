"""What a path shows of a loop: answers to steps of the desired displacement by their size, and the bandwidth."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.ndimage import median_filter
from scipy.signal import csd, welch

from slpi_ros.arrays import FloatArray
from slpi_ros.compensator.loop_design import HALF, NOISES, SETTLED
from slpi_ros.effects.filters import Uniform

# Fewest samples for which a setpoint is held before and after a step.
HELD = 20
# Steps are of one size up to this ratio.
ALIKE = 1.1
# Medians of so many samples leave few exceptions of the noise.
MEDIAN = 5
# Parts of a path of which spectra are the mean, each with half of the next one; what follows the path there is at least
# half of what is measured.
PARTS, FOLLOWS = 8, 0.5


@dataclass(frozen=True)
class StepAnswer:
    """What the steps of one size did, the worst of them."""

    size: float  # m, median magnitude
    count: int
    overshoot: float  # beyond the setpoint, over the size
    settled: float | None  # s, until the error stays within 1 % of the step; None: not before the next one
    quiet: float | None  # s, until it stays within the noise

    def to_document(self) -> dict[str, Any]:
        """Return the figures as in ``msg_schemas/verification.schema.json``."""
        return {
            "size_m": self.size,
            "count": self.count,
            "overshoot": self.overshoot,
            "settling_1_percent_s": self.settled,
            "settling_noise_s": self.quiet,
        }


def step_answers(t: FloatArray, desired: FloatArray, error: FloatArray, noise_rms: float) -> tuple[StepAnswer, ...]:
    """Return the answers to steps, by rising size, for desired displacement and error (m), at times (s), (N,) each."""
    edges = np.concatenate([[0], np.flatnonzero(np.diff(desired)) + 1, [t.size]])
    held = np.flatnonzero(np.diff(edges) >= HELD)
    begins, ends = edges[held], edges[held + 1]
    found: list[tuple[float, float, float | None, float | None]] = []
    # A setpoint that is read between two messages moves within a few samples.
    for k in np.flatnonzero(begins[1:] - ends[:-1] < HELD):
        at, to = slice(int(ends[k]), int(ends[k + 1])), float(desired[begins[k + 1]])
        step = to - float(desired[at.start - 1])
        left = median_filter(error[at] + desired[at] - to, MEDIAN, mode="nearest")
        passed = t[at] - t[at.start]
        settled, quiet = (_after(passed, left, limit) for limit in (SETTLED * abs(step), NOISES * noise_rms))
        found.append((abs(step), max(float(np.max(left * np.sign(step))), 0.0) / abs(step), settled, quiet))
    found.sort(key=lambda each: each[0])
    sizes = np.array([each[0] for each in found])
    groups = np.split(np.arange(sizes.size), np.flatnonzero(sizes[1:] > ALIKE * sizes[:-1]) + 1)
    return tuple(_worst([found[k] for k in group]) for group in groups if group.size)


def _worst(steps: list[tuple[float, float, float | None, float | None]]) -> StepAnswer:
    sizes, overshoots, settled, quiet = zip(*steps, strict=True)
    return StepAnswer(float(np.median(sizes)), len(steps), max(overshoots), _longest(settled), _longest(quiet))


def _longest(times: tuple[float | None, ...]) -> float | None:
    known = [each for each in times if each is not None]
    return max(known) if len(known) == len(times) else None


def _after(t: FloatArray, error: FloatArray, within: float) -> float | None:
    """Return the time (s) from which an error, (N,), stays within a limit; None if it does not."""
    outside = np.flatnonzero(np.abs(error) > within)
    if not outside.size:
        return 0.0
    return float(t[outside[-1] + 1]) if outside[-1] + MEDIAN < t.size else None


def followed_up_to(t: FloatArray, desired: FloatArray, error: FloatArray) -> float | None:
    """Return the lowest frequency (Hz) at which the error of a path reaches -3 dB of it; None: the path has none."""
    grid = Uniform.over(t)
    if not grid.dt > 0.0:
        return None
    d, e = grid.on(desired), grid.on(error)
    size = d.size // PARTS
    if size < HELD:
        return None
    spectra = {"fs": 1.0 / grid.dt, "nperseg": size}
    f, wanted = welch(d, **spectra)
    _, both = csd(d, d + e, **spectra)
    _, measured = welch(d + e, **spectra)
    with np.errstate(divide="ignore", invalid="ignore"):
        seen = (np.abs(both) ** 2 >= FOLLOWS * wanted * measured) & (wanted > 0.0)
        left = np.abs(both / wanted - 1.0)
    # Beside the mean, which no window takes out of the first line.
    seen[:2] = False
    f, left = f[seen], left[seen]
    k = int(np.argmax(left >= HALF)) if (left >= HALF).any() else 0
    return float(np.interp(HALF, left[k - 1 : k + 1], f[k - 1 : k + 1])) if k else None
