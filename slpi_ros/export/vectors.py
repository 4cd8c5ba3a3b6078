"""Test vectors of an export: steps with what the stream of Python answers, and a program that runs them."""

from dataclasses import dataclass
from math import inf, nan, pi
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slpi_ros.arrays import FloatArray
from slpi_ros.errors import SlpiError, UnreachableError, UsageError
from slpi_ros.export.c_source import context_of, templates
from slpi_ros.export.stage import ExportedStage, resolved
from slpi_ros.model.streaming import StageStream

# Codes of slpi_inverse.h.
OK, BAD_TIME, NOT_FINITE, OUT_OF_RANGE, UNREACHABLE = range(5)
# Number of steps, and the usual one (s).
STEPS, USUAL = 1200, 1e-4
# Largest difference to the stream of Python, as a share of the voltage range: double; float; float with creep, whose
# states hardly change in a step. The inverses of lag, rate law and modes multiply rounding errors, and a model without
# slope jumps: allowed is what setpoints make that are rounded so many times as coarsely as float does.
DOUBLE, FLOAT, FLOAT_SLOW, COARSER = 1e-12, 1e-5, 1e-4, 256.0
# Share of the steps in which a model that jumps at turns may differ by more: with float, a jump comes a step earlier or
# later.
STRAY = 0.02
# Rounding of a float, as a share of the number.
EPSILON = 2.0**-24


@dataclass(frozen=True)
class Vectors:
    """Steps: times (s, (N,)), displacements (m, (N, axes)), expected voltages (V, (N, axes)), and codes (N,).

    `surroundings` are values of the quantities that the stage follows, (N, quantities), NaN where none comes.
    """

    dt: FloatArray
    desired: FloatArray
    volts: FloatArray
    codes: NDArray[np.int64]
    surroundings: FloatArray


def code_of(error: SlpiError) -> int:
    """Return the code of slpi_inverse.h for an error of the stream."""
    text = str(error)
    if isinstance(error, UnreachableError):
        return OUT_OF_RANGE
    if "not finite" in text:
        return NOT_FINITE
    return BAD_TIME if "backwards" in text else UNREACHABLE


def usual_step(stage: ExportedStage) -> float:
    """Return a step (s), in whole nanoseconds, which resolves all modes."""
    lowest = min((float(row[1]) for axis in stage.axes for row in axis.laws.factors if row[0] > 0.0), default=inf)
    return max(USUAL, round(1e9 * 2.0 * resolved(lowest)) * 1e-9)


def float_goal(stage: ExportedStage) -> float:
    """Return the largest difference that `float` should make, as a share of the voltage range."""
    return FLOAT_SLOW if any(axis.laws.relaxations.size for axis in stage.axes) else FLOAT


def smooth(stage: ExportedStage, steps: int) -> tuple[NDArray[np.int64], FloatArray]:
    """Return stamps (ns, (N,)) and displacements (m, (N, axes)) of a smooth path within the limits."""
    place = np.arange(steps)
    shares = 0.5 + 0.3 * np.sin(2.0 * pi * place / 600.0) + 0.1 * np.sin(2.0 * pi * place / 130.0)
    low, high = np.array([axis.model.displacement_range for axis in stage.axes]).T
    return round(usual_step(stage) * 1e9) * place, low + np.outer(shares, high - low)


def by_rounding(
    stage: ExportedStage, stamps: NDArray[np.int64], desired: FloatArray, given: FloatArray, coarser: float = 1.0
) -> float:
    """Return the largest change of the voltages, as a share of their range, by setpoints rounded to `float`.

    Stamps (ns, (N,)) and displacements (m, (N, axes)) are those of `path` or `smooth`, quantities (N, K) those of
    `courses`. Everything is computed with `double`: a build with `float` can do no better. `coarser`: by what factor
    the rounding is coarser than that of `float`.
    """
    names = [axis.name for axis in stage.axes]
    ranges = [axis.allowed.upper - axis.allowed.lower for axis in stage.axes]
    exact, rounded, most = stage.stream(), stage.stream(), 0.0
    signals = (desired, _rounded(desired, coarser), given, _rounded(given, coarser))
    for stamp, *values in zip((stamps * 1e-9).tolist(), *signals, strict=True):
        voltages = []
        for stream, y, known in ((exact, *values[::2]), (rounded, *values[1::2])):
            surround(stream, stage, known)
            try:
                voltages.append(stream.step(stamp, dict(zip(names, y.tolist(), strict=True))))
            except SlpiError:
                # Beyond the model.
                return most
        changes = zip(*(one.values() for one in voltages), ranges, strict=True)
        most = max(most, *(abs(one - other) / span for one, other, span in changes))
    return most


def _rounded(values: FloatArray, coarser: float) -> FloatArray:
    """Return values on a grid, as `float` has it for the largest ones of a column, times `coarser`."""
    largest = np.nanmax(np.abs(values), axis=0, initial=0.0)
    grid = 2.0 * EPSILON * coarser * np.where(largest > 0.0, largest, 1.0)
    return np.round(values / grid) * grid


def _jumps(stage: ExportedStage) -> bool:
    """Return whether a branch of an axis has pieces without slope, over which the voltage jumps."""
    return any(axis.branches.operators.size for axis in stage.axes)


def float_remarks(stage: ExportedStage) -> list[str]:
    """Return a remark where `float` is not enough for the model, else nothing."""
    if _jumps(stage):
        return ["with float, jumps of a model of kind 'mpi' at turns may come a step earlier or later; use double"]
    rounding = by_rounding(stage, *smooth(stage, STEPS // 2), courses(stage, STEPS // 2))
    if rounding <= float_goal(stage):
        return []
    return [
        f"with float, rounding of the setpoints alone moves the voltages by up to {rounding:.1g} of their range on a "
        f"smooth path with steps of {usual_step(stage):g} s; use double"
    ]


def path(stage: ExportedStage, steps: int, seed: int = 1) -> tuple[NDArray[np.int64], FloatArray]:
    """Return stamps (ns, (N,)) and displacements (m, (N, axes)) of a path with turns, holds, jumps and pauses."""
    rng = np.random.default_rng(seed)
    dt = np.full(steps, round(usual_step(stage) * 1e9), dtype=np.int64)
    dt[0] = 0
    dt[rng.integers(1, steps, steps // 40)] = 0
    longer = rng.integers(1, steps, steps // 30)
    dt[longer] = (dt[longer] * rng.uniform(1.0, 40.0, longer.size)).astype(np.int64)
    dt[rng.integers(1, steps, 3)] = rng.integers(50_000_000, 3_000_000_000, 3)
    y = np.column_stack([_displacements(axis.model.displacement_range, steps, rng) for axis in stage.axes])
    return np.cumsum(dt), y


def _displacements(span: tuple[float, float], steps: int, rng: np.random.Generator) -> FloatArray:
    """Return a path within a range (m), and a little beyond it at times, shape (N,)."""
    low, high = span
    parts, last, count = list[FloatArray](), 0.5, 0
    while count < steps:
        kind, length = rng.integers(6), int(rng.integers(5, 60))
        goal = float(rng.uniform(0.02, 0.98))
        if kind == 0:
            part = np.full(length, last)
        elif kind == 1:
            part = goal + (last - goal) * np.cos(np.linspace(0.0, 7.0 * pi, 3 * length))
        elif kind == 2:
            # Loops within loops.
            turns = goal + (last - goal) * (-0.85) ** np.arange(1, 12)
            part = np.interp(np.arange(6 * turns.size) / 6.0, np.arange(turns.size + 1), np.append(last, turns))
        elif kind == 3:
            part = np.full(length, goal)
        elif kind == 4 and rng.uniform() < 0.3:
            part = np.linspace(last, rng.choice([-0.1, 1.1]), length)
        else:
            part = np.linspace(last, goal, length)
        parts.append(part)
        last, count = float(part[-1]), count + part.size
    return low + (high - low) * np.concatenate(parts)[:steps]


def courses(stage: ExportedStage, steps: int, seed: int = 1) -> FloatArray:
    """Return values of the quantities that a stage follows, shape (N, quantities); NaN in steps where none comes."""
    rng = np.random.default_rng(seed)
    values = np.full((steps, len(stage.quantities)), nan)
    for column, one in zip(values.T, stage.quantities, strict=True):
        # The first steps are at the reference.
        comes = rng.integers(steps // 8, steps, max(steps // 40, 1))
        column[comes] = rng.uniform(one.lowest, one.highest, comes.size)
    return values


def surround(stream: StageStream, stage: ExportedStage, values: FloatArray) -> None:
    """Give the stream values of quantities, shape (quantities,); NaN: none comes."""
    known = {one.key: value for one, value in zip(stage.quantities, values.tolist(), strict=True) if value == value}
    for each in stream.streams.values():
        each.surround(known)


def vectors(stage: ExportedStage, steps: int = STEPS, seed: int = 1) -> Vectors:
    """Return steps with the answers of the stream, and among them some that it refuses."""
    stamps, desired = path(stage, steps, seed)
    rng = np.random.default_rng(seed)
    stream, names = stage.stream(), [axis.name for axis in stage.axes]
    before, rows = 0.0, list[tuple[float, list[float], list[float], int]]()
    given, coming = list[FloatArray](), courses(stage, steps, seed)
    refused = set(rng.integers(2, steps, 12).tolist())
    for k, (stamp, y) in enumerate(zip((stamps * 1e-9).tolist(), desired.tolist(), strict=True)):
        surround(stream, stage, coming[k])
        given.append(coming[k])
        if k in refused:
            low, high = stage.axes[-1].accepted
            for dt, wrong in ((0.0, nan), (0.0, high + (high - low)), (-1e-3, y[-1]), (nan, y[-1])):
                rows.append(_answered(stream, names, before, dt, [*y[:-1], wrong]))
                given.append(coming[k])
        try:
            rows.append(_answered(stream, names, before, stamp - before, y, stamp))
        except SlpiError:
            # Beyond the model: the axes before it have moved.
            break
        before = stamp
    if not rows:
        raise UsageError("the model reaches no displacement of its range, and cannot be exported; identify it again")
    times, wanted, volts, codes = zip(*rows, strict=True)
    kinds = np.array(codes, dtype=np.int64)
    return Vectors(np.array(times), np.array(wanted), np.array(volts), kinds, np.array(given[: len(rows)]))


def _answered(
    stream: StageStream, names: list[str], before: float, dt: float, y: list[float], stamp: float | None = None
) -> tuple[float, list[float], list[float], int]:
    """Return one step with its answer; SlpiError if the model does not reach it."""
    code = OK
    try:
        stream.step(before + dt if stamp is None else stamp, dict(zip(names, y, strict=True)))
    except SlpiError as error:
        code = BAD_TIME if dt != dt else code_of(error)
        if code == UNREACHABLE:
            raise
    return dt, y, [stream.streams[name].voltage for name in names], code


def program_files(stage: ExportedStage, steps: int = STEPS) -> dict[str, str]:
    """Return the program that runs the vectors, by file name."""
    found = vectors(stage, steps)

    def constant(value: float) -> str:
        return "SLPI_NAN" if value != value else repr(value)

    rows = [
        {
            "dt": constant(dt),
            "desired": [constant(one) for one in y],
            "volts": [constant(v) for v in volts],
            "code": code,
            "given": [constant(one) for one in values],
        }
        for dt, y, volts, code, values in zip(
            *(found.dt.tolist(), found.desired.tolist(), found.volts.tolist(), found.codes.tolist()),
            *(found.surroundings.tolist(),),
            strict=True,
        )
    ]
    ranges = [repr(axis.allowed.upper - axis.allowed.lower) for axis in stage.axes]
    allowed = max(float_goal(stage), by_rounding(stage, *path(stage, steps), courses(stage, steps), COARSER))
    limits = {"double_limit": repr(DOUBLE), "float_limit": f"{allowed:.3g}", "coarser": f"{COARSER:g}"}
    limits["strays"] = str(round(STRAY * len(rows)) if _jumps(stage) else 0)
    more: dict[str, Any] = {"rows": rows, "ranges": ranges, **limits}
    context = {**context_of(stage), **more}
    return {"slpi_test.c": templates().get_template("slpi_test.c.j2").render(context)}
