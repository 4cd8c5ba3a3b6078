"""Held-out error of a model and of the classical PI model by cross-validation, overall and by class of samples."""

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from threadpoolctl import threadpool_limits

from slpi_ros.arrays import FloatArray, IntArray, Mask
from slpi_ros.arrays.rates import rates
from slpi_ros.errors import SlpiError
from slpi_ros.hysteresis.slpi_published import separate
from slpi_ros.identification.drive import smallest_turn
from slpi_ros.identification.fit import FITS, fit_of
from slpi_ros.identification.free_run import InitialStateWarning
from slpi_ros.identification.repeatability import Repeatability, repeatability_of
from slpi_ros.identification.samples import Samples, select_thinned
from slpi_ros.identification.signal_statistics import noise
from slpi_ros.io.record import Record

CLASSICAL = "pi"
# Number of samples to which a record is thinned; more samples cost time and give the same errors.
SAMPLES = 40_000
# Loops of this level and above form one class; number of voltage regions.
DEEPEST, REGIONS = 3, 5
# Below this share of the 95th percentile of the speed the stage counts as at rest; below this ratio speeds are equal.
_REST, _ONE_SPEED = 0.02, 1.5
_SPEED_CLASSES = 3


@dataclass(frozen=True)
class Slice:
    """Held-out errors (m) of one class of samples."""

    name: str
    samples: int
    rms: float
    maximum: float  # absolute
    classical_rms: float  # of the classical PI model, NaN where it could not be fitted

    def line(self) -> str:
        """Return the errors as a line of the table, in nanometres."""
        classical = f"{self.classical_rms * 1e9:.1f}" if np.isfinite(self.classical_rms) else "-"
        return f"{self.name:<24}{self.samples:9}{self.rms * 1e9:9.1f}{self.maximum * 1e9:10.1f}{classical:>14}"


@dataclass(frozen=True)
class CrossValidationReport:
    """Held-out errors of a model, free-run, in total and by class; the arrays hold the held-out samples, (M,)."""

    axis: str
    kind: str
    repeatability: Repeatability  # of the record, or the median of several
    overall: Slice
    by_level: tuple[Slice, ...]  # by nesting of the loop, 0 is the outer one
    by_region: tuple[Slice, ...]  # by voltage, ascending
    by_speed: tuple[Slice, ...]  # by the magnitude of dv/dt, ascending from rest
    t: FloatArray  # s, from the first stamp of each record
    v: FloatArray  # V
    error: FloatArray  # m, model minus measured
    classical: FloatArray  # m, of the classical PI model

    def lines(self) -> list[str]:
        """Return the held-out errors as a text table, in nanometres."""
        head = f"{'held-out error, nm':<24}{'samples':>9}{'rms':>9}{'max':>10}{'classical PI':>14}"
        parts = (self.overall, *self.by_level, *self.by_region, *self.by_speed)
        last = f"{'repeatability':<33}{self.repeatability.rms * 1e9:9.1f}   from {self.repeatability.source}"
        return [head, *(part.line() for part in parts), last]


@dataclass(frozen=True)
class _Part:
    """Samples of one thinned record and their times (s)."""

    samples: Samples
    t: FloatArray

    @classmethod
    def of(cls, record: Record, axis: str, start: float | None, stop: float | None, most: int) -> "_Part":
        samples, at = select_thinned(record, axis, start, stop, most)
        return cls(samples, (record.time_ns[at] - record.time_ns[0]) * 1e-9)


def cross_validate(
    record: Record | Sequence[Record],
    axis: str,
    kind: str = "slpi",
    *,
    start: float | None = None,
    stop: float | None = None,
    loops_at_rest: bool = False,
) -> CrossValidationReport:
    """Cross-validate a kind of model on thinned records: fit all folds but one, evaluate the error on that fold."""
    records = [record] if isinstance(record, Record) else list(record)
    fit = fit_of(kind, loops_at_rest=loops_at_rest)
    parts = [_Part.of(one, axis, start, stop, SAMPLES // len(records)) for one in records]
    samples = [part.samples for part in parts]
    with threadpool_limits(1), warnings.catch_warnings():
        # The fit of the whole record has already issued this warning.
        warnings.simplefilter("ignore", InitialStateWarning)
        error = fit(samples).held_out
        classical = error if kind == CLASSICAL else _classical(samples)
    left_out = np.isfinite(error)
    error, classical = error[left_out], classical[left_out]
    level = np.concatenate([loop_levels(part.t, part.samples.v) for part in parts])[left_out]
    speed = np.concatenate([rates(part.t, part.samples.v) for part in parts])[left_out]
    t = np.concatenate([part.t for part in parts])[left_out]
    v = np.concatenate([part.samples.v for part in parts])[left_out]

    ends = np.cumsum([part.t.size for part in parts])[:-1]
    repeats = sorted(map(_repeatability, parts, np.split(left_out, ends)), key=lambda one: one.rms)

    def cut(classes: Iterator[tuple[str, Mask]]) -> tuple[Slice, ...]:
        return tuple(_slice(name, error[chosen], classical[chosen]) for name, chosen in classes if chosen.any())

    return CrossValidationReport(
        axis=axis,
        kind=kind,
        repeatability=repeats[len(repeats) // 2],
        overall=_slice("all", error, classical),
        by_level=cut(level_classes(level)),
        by_region=cut(region_classes(v)),
        by_speed=cut(speed_classes(speed)),
        t=t,
        v=v,
        error=error,
        classical=classical,
    )


def _classical(samples: Sequence[Samples]) -> FloatArray:
    try:
        return FITS[CLASSICAL](samples).held_out
    except SlpiError:
        # The record may determine the given kind, but not the classical PI model.
        return np.full(sum(part.v.size for part in samples), np.nan)


def _repeatability(part: _Part, judged: Mask) -> Repeatability:
    return repeatability_of(part.t, part.samples.v, np.where(judged, part.samples.y, np.nan))


def _slice(name: str, error: FloatArray, classical: FloatArray) -> Slice:
    known = np.isfinite(classical)
    classical_rms = float(np.sqrt(np.mean(classical[known] ** 2))) if known.any() else np.nan
    return Slice(name, error.size, float(np.sqrt(np.mean(error**2))), float(np.max(np.abs(error))), classical_rms)


def loop_levels(t: FloatArray, v: FloatArray) -> IntArray:
    """Return the nesting level of the loop of each sample, shape (N,), for times (s) and voltages (V)."""
    level = np.zeros(v.size, np.int64)
    for loop in separate(v, dead_band=smallest_turn(v, noise(v, t))).loops:
        level[loop.samples] = loop.level
    return level


def level_classes(level: IntArray) -> Iterator[tuple[str, Mask]]:
    """Yield the name and mask, shape (N,), of each class of loop levels, for levels of shape (N,)."""
    yield "outer loop", level == 0
    for depth in range(1, DEEPEST):
        yield f"loops of level {depth}", level == depth
    yield f"level {DEEPEST} and deeper", level >= DEEPEST


def region_classes(v: FloatArray) -> Iterator[tuple[str, Mask]]:
    """Yield the name and mask, shape (N,), of each voltage region, for voltages (V) of shape (N,)."""
    edges = np.linspace(v.min(), v.max(), REGIONS + 1)
    region = np.clip(np.searchsorted(edges, v, side="right") - 1, 0, REGIONS - 1)
    for number, (low, high) in enumerate(pairwise(edges.tolist())):
        yield f"{low:.4g} to {high:.4g} V", region == number


def speed_classes(speed: FloatArray) -> Iterator[tuple[str, Mask]]:
    """Yield the name and mask, shape (N,), of each class of speeds, for speeds (V/s) of shape (N,)."""
    rest = speed <= _REST * float(np.quantile(speed, 0.95))
    yield "at rest", rest
    moving = speed[~rest]
    if not moving.size:
        return
    slow, fast = np.quantile(moving, (0.1, 0.9)).tolist()
    classes = _SPEED_CLASSES if fast > _ONE_SPEED * slow else 1
    edges = np.quantile(moving, np.linspace(0.0, 1.0, classes + 1))
    number = np.clip(np.searchsorted(edges, speed, side="right") - 1, 0, classes - 1)
    for k, (low, high) in enumerate(pairwise(edges.tolist())):
        yield f"{low:.3g} to {high:.3g} V/s", ~rest & (number == k)
