"""Experiment of the SLPI paper on a simulated stage: models identified on one path, and their errors by loop."""

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from slpi_ros.arrays import FloatArray
from slpi_ros.hysteresis.prandtl_ishlinskii import PrandtlIshlinskii
from slpi_ros.hysteresis.reversals import monotone_runs
from slpi_ros.hysteresis.slpi_published import (
    KnownPath,
    Loop,
    SeparatedLoops,
    Separation,
    UnidentifiedLoopWarning,
    separate,
)
from slpi_ros.hysteresis.turning_points import Memory
from slpi_ros.identification.fit import identify
from slpi_ros.identification.linear_kinds import PLAY_OPERATORS
from slpi_ros.identification.published_kinds import default_thresholds, fit_plays
from slpi_ros.io.record import Record
from slpi_ros.simulation.stage import flexure_axis

# Tables 2 (level II), 3 (level I), 4 (level 0) and 5 (classical PI). They give no unit for the weights, which are taken
# as micrometres per volt.
THRESHOLDS = (0.0, 5.0, 10.0, 15.0, 20.0, 25.0, 30.0, 35.0, 40.0, 45.0)
TABLES = {
    2: (0.02943, 0.01351, 0.00040, 0.00206, 0.00230, 0.00265, 0.00249, 0.00550, 0.02802, 0.09411),
    3: (0.03151, 0.01298, 0.01092, 0.00445, 0.00648, 0.00000, 0.00148, 0.00016, 0.00051, 0.00100),
    4: (0.04045, 0.00000, 0.00893, 0.00537, 0.00456, 0.01136, 0.00000, 0.00000, 0.00000, 0.00000),
    5: (0.03040, 0.01116, 0.01516, 0.00478, 0.00000, 0.00000, 0.00823, 0.00057, 0.00000, 0.00000),
}

# Error reductions by SLPI relative to classical PI, per cent (section 4.1).
OUTER_MAXIMUM, HIGHEST_MEAN, SPREAD, OVERALL_MEAN = 10.0, 97.5, 53.7, 50.3

# Similar to the random path of Fig. 4: up to level II; a sample every 4 V and 0.8 s, and at every reversal (2.2).
RANDOM_PATH = (0.0, 80.0, 12.0, 68.0, 20.0, 80.0, 100.0, 0.0)
# Fig. 16: a second inner loop, whose vertex lies on the back branch. Fig. 18: inner and outer loop share their rise.
DOUBLE_INNER_LOOP = (0.0, 64.0, 24.0, 100.0, 40.0, 76.0, 0.0)
OVERLAPPED = (0.0, 60.0, 0.0, 100.0, 0.0)
STEP_V, STEP_S = 4.0, 0.8
VOLTAGE_RANGE = (0.0, 100.0)
# Number of measurements that are averaged (2.2, step 4).
PASSES = 2
UNSEEN = 6

CLASSICAL, MORE_PLAYS = "classical PI", f"classical PI, {PLAY_OPERATORS} operators"
AT_REST, CLOSING, FAMILY = "SLPI, at rest", "SLPI, closing", "loop family"
MODELS = (CLASSICAL, MORE_PLAYS, AT_REST, CLOSING, FAMILY)
DRAWN = (CLASSICAL, AT_REST, CLOSING, FAMILY)

Drive = Memory | KnownPath


@dataclass(frozen=True)
class LoopErrors:
    """Errors (m) of one model along a path."""

    error: FloatArray  # (N,)
    means: tuple[float, ...]  # absolute, of each loop, the outer one first
    maxima: tuple[float, ...]  # absolute

    @classmethod
    def of(cls, error: FloatArray, loops: tuple[Loop, ...]) -> "LoopErrors":
        """Return the errors, shape (N,), metres, loop by loop (Eq. 13 and 14)."""
        size = np.abs(error)
        return cls(
            error,
            tuple(float(size[loop.samples].mean()) for loop in loops),
            tuple(float(size[loop.samples].max()) for loop in loops),
        )

    @property
    def overall(self) -> float:
        """Mean absolute error over the whole path."""
        return float(np.mean(np.abs(self.error)))

    @property
    def spread(self) -> float:
        """Difference between the largest and the smallest mean error of the loops."""
        return max(self.means) - min(self.means)


@dataclass(frozen=True)
class Study:
    """One path on the stage with the reversals `turns` (V), and the errors (m) of the models along it, by name."""

    # `at_rest` and `closing` are the published model with play operators that start at rest in every loop, and primed,
    # so that loops close.
    turns: tuple[float, ...]
    separation: Separation  # voltage and displacement, separated into loops
    classical: PrandtlIshlinskii
    at_rest: SeparatedLoops
    closing: SeparatedLoops
    modelled: Mapping[str, LoopErrors]  # model - measured
    compensated: Mapping[str, LoopErrors]  # achieved - `desired`
    straight: Mapping[str, LoopErrors]  # for a desired displacement proportional to the voltage (SLPI paper, 4.1)
    desired: FloatArray  # m, (N,), straight lines between the measured reversals
    voltages: Mapping[str, FloatArray]  # V, (N,), of `compensated`
    drives: Mapping[str, Callable[[], Drive]]  # make the model anew in its initial state


def study(turns: tuple[float, ...]) -> Study:
    """Drive the stage through the reversals `turns` (V), identify each model on this path, and compensate with it."""
    v = ramps(turns, STEP_V)
    t = _times(v)
    y = np.mean([measure(v, seed) for seed in range(PASSES)], axis=0)
    record = Record(np.round(t * 1e9).astype(np.int64), {"x": v}, {"x": y}, "random path")
    separation = separate(v, y)
    published = {
        at_rest: identify(record, "slpi-published", loops_at_rest=at_rest).axis("x").hysteresis
        for at_rest in (True, False)
    }
    at_rest, closing = published[True], published[False]
    assert isinstance(at_rest, SeparatedLoops)
    assert isinstance(closing, SeparatedLoops)
    classical = classical_model(v, y)
    more_plays, family = (identify(record, kind).axis("x") for kind in ("pi", "slpi"))
    drives: dict[str, Callable[[], Drive]] = {
        CLASSICAL: lambda: Memory(classical, 0.0, float(y[0])),
        MORE_PLAYS: lambda: more_plays.memory("start"),
        AT_REST: lambda: at_rest.along(0.0, float(y[0])),
        CLOSING: lambda: closing.along(0.0, float(y[0])),
        FAMILY: lambda: family.memory("start"),
    }
    desired = straight_between_reversals(y, v)
    straight = y[0] + (y.max() - y[0]) * v / v.max()
    voltages = {name: voltage_for(drive(), desired) for name, drive in drives.items()}
    loops = separation.loops
    return Study(
        turns=turns,
        separation=separation,
        classical=classical,
        at_rest=at_rest,
        closing=closing,
        modelled={name: LoopErrors.of(forward(drive(), v) - y, loops) for name, drive in drives.items()},
        compensated={name: LoopErrors.of(reached(u) - desired, loops) for name, u in voltages.items()},
        straight={
            name: LoopErrors.of(reached(voltage_for(drive(), straight)) - straight, loops)
            for name, drive in drives.items()
        },
        desired=desired,
        voltages=voltages,
        drives=drives,
    )


@dataclass(frozen=True)
class UnseenPaths:
    """Errors of the models of one study along other paths with the reversals `turns` (V)."""

    turns: tuple[tuple[float, ...], ...]
    mean_errors: Mapping[str, tuple[float, ...]]  # m, absolute, free-run, of each path, by model
    loops: int  # inner loops of all paths
    replaced: int  # of them never identified


def unseen_paths(known: Study, seed: int = 1) -> UnseenPaths:
    """Generate random paths within the same range, and predict them with the models of a study."""
    rng = np.random.default_rng(seed)
    paths = tuple(_draw(rng) for _ in range(UNSEEN))
    errors: dict[str, list[float]] = {name: [] for name in MODELS}
    loops = replaced = 0
    for turns in paths:
        v = ramps(turns, STEP_V)
        true = reached(v)
        for name, drive in known.drives.items():
            errors[name].append(float(np.mean(np.abs(forward(drive(), v) - true))))
        inner = separate(v).loops[1:]
        loops += len(inner)
        for loop in inner:
            span = float(np.ptp(v[loop.path]))
            place = loop.level, loop.direction, float(v[loop.vertex]), span
            replaced += not known.closing.matches(known.closing.nearest(*place, 0), *place, 0)
    return UnseenPaths(paths, {name: tuple(e) for name, e in errors.items()}, loops, replaced)


def _draw(rng: np.random.Generator) -> tuple[float, ...]:
    """Return the reversals (V) of a random path: from 0 V through six inner reversals to 100 V, and back to 0 V."""
    levels = STEP_V * rng.choice(np.arange(2, 24), 6, replace=False)
    low, high = np.sort(levels[:3]), np.sort(levels[3:])
    inner = np.column_stack([np.maximum(low, high), np.minimum(low, high)])[rng.permutation(3)]
    turns = [0.0, *inner.ravel().tolist(), 100.0, 0.0]
    return tuple(float(turn) for turn in turns)


def classical_model(v: FloatArray, y: FloatArray) -> PrandtlIshlinskii:
    """Fit the classical PI model of Table 5: with its thresholds, and at rest and zero at the start of the record."""
    thresholds = default_thresholds(float(np.ptp(v)))
    everything = np.ones(v.size, dtype=bool)
    fit = fit_plays(v - v[0], y - y[0], everything, thresholds, None, through_zero=True)
    return PrandtlIshlinskii(thresholds, fit.weights)


def ramps(turns: Sequence[float], step: float) -> FloatArray:
    """Return straight ramps between reversals, (N,), in their unit, sampled every `step` and at every reversal."""
    parts = [np.append(np.arange(a, b, step if b > a else -step)[1:], b) for a, b in pairwise(turns)]
    return np.concatenate([np.array([turns[0]], dtype=np.float64), *parts])


def straight_between_reversals(x: FloatArray, at: FloatArray) -> FloatArray:
    """Return `x`, shape (N,), replaced by straight lines over `at`, shape (N,), between the reversals of `at`."""
    path = x.copy()
    for a, b in pairwise(stop - 1 for _, stop in monotone_runs(at)):
        path[a : b + 1] = x[a] + (x[b] - x[a]) * (at[a : b + 1] - at[a]) / (at[b] - at[a])
    return path


def _times(v: FloatArray) -> FloatArray:
    return STEP_S * np.arange(v.size, dtype=np.float64)


def measure(v: FloatArray, seed: int) -> FloatArray:
    """Drive a new stage through `v`, shape (N,), volts, and return the sensor readings, shape (N,), metres."""
    return flexure_axis(seed).run(_times(v), v)[1]


def reached(v: FloatArray) -> FloatArray:
    """Drive a new stage through `v`, shape (N,), volts, and return its true displacement, shape (N,), metres."""
    return flexure_axis().run(_times(v), v)[0]


def forward(drive: Drive, v: FloatArray) -> FloatArray:
    """Return the model's displacement, shape (N,), metres, for voltages (V), without warnings of unidentified loops."""
    with warnings.catch_warnings(action="ignore", category=UnidentifiedLoopWarning):
        return drive.forward_array(v)


def voltage_for(drive: Drive, y: FloatArray) -> FloatArray:
    """Return the model's voltage, shape (N,), volts, within the identified range, for displacements `y` (m)."""
    with warnings.catch_warnings(action="ignore", category=UnidentifiedLoopWarning):
        return drive.inverse_array(y, *VOLTAGE_RANGE)


def gain(before: float, after: float) -> float:
    """Return the reduction of an error, in per cent."""
    return 100.0 * (1.0 - after / before)
