"""Uncertainty of a model's curves by a wild block bootstrap of the held-out errors; those of a fit are too small."""
# Each resample changes the sign of whole blocks of errors at random, since neighbouring errors are correlated, and
# keeps all samples, as some parts occur only once in a record.

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from threadpoolctl import threadpool_limits

from slpi_ros.arrays import FloatArray
from slpi_ros.errors import UsageError
from slpi_ros.identification.least_squares import Problem
from slpi_ros.identification.linear_kinds import SMOOTHNESS, choose, plays, surfaces
from slpi_ros.identification.progress import report_progress
from slpi_ros.identification.samples import Samples, select_thinned
from slpi_ros.io.record import Record

RESAMPLES = 50
BLOCKS = 80
# Number of samples to which a record is thinned; more samples cost time and give a smaller uncertainty.
SAMPLES = 20_000
_KINDS = {"slpi": (surfaces, SMOOTHNESS), "pi": (plays, SMOOTHNESS[:1])}
# Number of voltages of the outermost loop at which the uncertainty is given.
_CURVE_POINTS = 101


@dataclass(frozen=True)
class CurveUncertainty:
    """Uncertainty of a model's curves due to the errors of the record; standard deviations in metres."""

    # Computed from a thinned record, and therefore an upper bound for long records. The uncertainty of regions that no
    # sample visits is not included: there the roughness penalty determines the curves.
    axis: str
    kind: str
    resamples: int  # bootstrap fits
    v: FloatArray  # V, (n,)
    rising: FloatArray  # m, (n,), branch of the outermost loop from its low end
    falling: FloatArray  # m, (n,), from the low end, too
    rising_std: FloatArray
    falling_std: FloatArray
    rms: float  # of the displacement predicted for the record's samples
    maximum: float

    def line(self) -> str:
        """Return the uncertainty as one line of text, in nanometres."""
        loop = np.concatenate([self.rising_std, self.falling_std])
        return (
            f"curves known to {self.rms * 1e9:.2g} nm rms on the record's path, {self.maximum * 1e9:.2g} nm at worst; "
            f"outermost loop to {np.sqrt(np.mean(loop**2)) * 1e9:.2g} nm rms (1 sigma, {self.resamples} resamples)"
        )


def curve_uncertainty(
    record: Record | Sequence[Record],
    axis: str,
    kind: str = "slpi",
    *,
    start: float | None = None,
    stop: float | None = None,
    resamples: int = RESAMPLES,
) -> CurveUncertainty:
    """Estimate the uncertainty of the curves of a model (slpi or pi) by bootstrap fits to thinned records."""
    require_known_uncertainty(kind)
    records = [record] if isinstance(record, Record) else list(record)
    samples = [select_thinned(part, axis, start, stop, SAMPLES // len(records))[0] for part in records]
    bases, smoothness = _KINDS[kind]
    with threadpool_limits(1):
        chosen = choose(samples, bases(samples), smoothness)
        problem = chosen.problem
        low, high = (float(extreme([extreme(part.v) for part in samples])) for extreme in (np.min, np.max))
        v = np.linspace(low, high, _CURVE_POINTS)
        loop = _outermost(problem, v)
        solutions = _solutions(problem, chosen.smoothness, resamples)
        paths = np.array([problem.design.predict(x) for x in solutions])[:, problem.weights > 0] * problem.scale
        curves = np.array([_branches(loop, x, problem) for x in solutions])
        rising, falling = _branches(loop, problem.solve(chosen.smoothness).x, problem)
    spread = paths.std(axis=0, ddof=1)
    rising_std, falling_std = curves.std(axis=0, ddof=1)
    return CurveUncertainty(
        axis=axis,
        kind=kind,
        resamples=resamples,
        v=v,
        rising=rising,
        falling=falling,
        rising_std=rising_std,
        falling_std=falling_std,
        rms=float(np.sqrt(np.mean(spread**2))),
        maximum=float(spread.max()),
    )


def require_known_uncertainty(kind: str) -> None:
    """Raise UsageError if the uncertainty of this kind of model is not available."""
    if kind not in _KINDS:
        raise UsageError(f"the uncertainty of kind '{kind}' is not known; choose one of {', '.join(_KINDS)}")


def _solutions(problem: Problem, smoothness: float, resamples: int) -> list[FloatArray]:
    """Return the parameters of fits to the model's prediction plus held-out errors with random signs per block."""
    rng = np.random.default_rng(0)
    design, weights = problem.design, problem.weights
    program = problem.program(problem.equations[0] + problem.penalty(smoothness, problem.count))
    whole = program.solve(problem.equations[1])
    predicted = design.predict(whole.x)
    rows = design.rows(np.arange(problem.y.size))
    left_out = problem.held_out_errors(smoothness, whole) / problem.scale
    errors = np.where(np.isfinite(left_out), left_out, predicted - problem.y)
    blocks = np.array_split(np.arange(problem.y.size), BLOCKS)
    solutions = []
    for number in range(resamples):
        report_progress(f"fits to other errors, {number + 1} of {resamples}")
        sign = np.repeat(rng.choice((-1.0, 1.0), BLOCKS), [block.size for block in blocks])
        drawn = weights * (predicted + sign * errors)
        solutions.append(program.solve(rows.project(drawn), whole.multipliers).x)
    return solutions


def _outermost(problem: Problem, v: FloatArray) -> Problem:
    """Pose the problem of the outermost loop: a rise and a fall, after a long fall to the low end."""
    path = np.concatenate([v[:1], v, v[-2::-1]])
    return Problem.pose([Samples(path, path, np.ones(path.size, dtype=bool), history=1)], problem.basis)


def _branches(loop: Problem, x: FloatArray, problem: Problem) -> FloatArray:
    """Return the rising and the falling branch, shape (2, n), metres, relative to the low end."""
    y = loop.design.predict(x[: problem.basis.size + 1])[1:] * problem.scale
    n = (y.size + 1) // 2
    return np.asarray([y[:n], y[n - 1 :][::-1]] - y[0])
