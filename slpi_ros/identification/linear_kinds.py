"""Convex fits of the kinds that are linear in their parameters; cross-validation selects grid and smoothness."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from slpi_ros.identification.bases import Basis, PlayBasis, SurfaceBasis
from slpi_ros.identification.free_run import InitialState, choose_start, warn_of_initial_history, warn_of_rest
from slpi_ros.identification.least_squares import FIRST_SMOOTHNESS, Fitted, Problem
from slpi_ros.identification.progress import report_progress
from slpi_ros.identification.published_kinds import MultiSlopeBasis
from slpi_ros.identification.samples import Samples
from slpi_ros.model.axis_model import Start

# Candidate numbers of grid vertices and roughness weights of the loop family, for cross-validation.
VERTICES = (21, 31, 41)
SMOOTHNESS = (0.001, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0)
PLAY_OPERATORS = 30
# Numbers of samples to which a long record is thinned: for the choice of the initial state, for that of grid and
# smoothness, and for the final fit. More samples cost time and memory without changing the result.
START_SAMPLES, SELECTION_SAMPLES, FIT_SAMPLES = 20_000, 100_000, 300_000
# Factor on the last two for play operators: every sample moves every operator, and there are few parameters.
PLAYS_SHARE = 0.2


def fit_family(samples: Sequence[Samples]) -> Fitted:
    """Fit the loop family to one record or several."""
    return fit_linear(samples, surfaces(samples), SMOOTHNESS)


def fit_plays(samples: Sequence[Samples]) -> Fitted:
    """Fit the classical PI model to one record or several."""
    return fit_linear(samples, plays(samples), share=PLAYS_SHARE)


def surfaces(samples: Sequence[Samples]) -> list[Basis]:
    """Return the candidate loop families, one for each number of vertices, for the voltage range of the samples."""
    low, high = _voltage_range(samples)
    return [SurfaceBasis(np.linspace(low, high, n)) for n in VERTICES]


def plays(samples: Sequence[Samples]) -> list[Basis]:
    """Return the classical PI model, the only candidate, for the voltage range of the samples."""
    low, high = _voltage_range(samples)
    return [PlayBasis(np.linspace(0.0, (high - low) / 2, PLAY_OPERATORS, endpoint=False))]


def fit_multi_slope(samples: Sequence[Samples]) -> Fitted:
    """Fit the MPI model for the amplitude of the records, from rest, by unweighted least squares as published."""
    samples = [part.thinned(round(PLAYS_SHARE * FIT_SAMPLES / len(samples))) for part in samples]
    problem = Problem.pose(samples, MultiSlopeBasis.over(*_voltage_range(samples)))
    beginnings = [InitialState((), only_after_reset=False)] * len(samples)
    return _solved(samples, problem, FIRST_SMOOTHNESS, beginnings, fit_multi_slope)


def _voltage_range(samples: Sequence[Samples]) -> tuple[float, float]:
    return float(min(part.v.min() for part in samples)), float(max(part.v.max() for part in samples))


def fit_linear(
    samples: Sequence[Samples],
    bases: Sequence[Basis],
    smoothness: Sequence[float] = SMOOTHNESS[:1],
    *,
    share: float = 1.0,
    near: tuple[int, float] | None = None,
) -> Fitted:
    """Fit the basis, the simplest first, and the roughness weight with the lowest held-out error."""
    # `share`, 0..1, is a factor on `SELECTION_SAMPLES` and `FIT_SAMPLES`; `near`, number of a basis and a weight, is
    # tried first.
    problem, weight, beginnings = choose(samples, bases, smoothness, share=share, near=near)
    near = [basis is problem.basis for basis in bases].index(True), weight
    warn_of_rest(samples, beginnings)
    fitted = [
        beginning.of(part.thinned(round(share * FIT_SAMPLES / len(samples))))
        for beginning, part in zip(beginnings, samples, strict=True)
    ]
    if sum(part.v.size for part in fitted) > problem.y.size:
        # The problem of the choice is released before that of the fit needs its memory.
        basis = problem.basis
        del problem
        problem = Problem.pose(fitted, basis).reweighted()
    again = partial(fit_linear, bases=bases, smoothness=smoothness, share=share, near=near)
    result = _solved(fitted, problem, weight, beginnings, again)
    judged = problem.judged[problem.weights > 0]
    warn_of_initial_history(result.errors[~judged], result.errors[judged])
    return result


class Choice(NamedTuple):
    """Problem (of thinned records), roughness weight and initial states with the lowest held-out error."""

    problem: Problem
    smoothness: float
    beginnings: Sequence[InitialState]


def choose(
    samples: Sequence[Samples],
    bases: Sequence[Basis],
    smoothness: Sequence[float],
    *,
    share: float = 1.0,
    near: tuple[int, float] | None = None,
) -> Choice:
    """Choose initial state, basis and roughness weight; parameters and errors as in `fit_linear`."""
    report_progress("choosing the initial state")
    beginnings = [
        choose_start(part.thinned(START_SAMPLES // len(samples)), lambda candidate: Problem.pose([candidate], bases[0]))
        for part in samples
    ]
    thin = [
        beginning.of(part.thinned(round(share * SELECTION_SAMPLES / len(samples))))
        for beginning, part in zip(beginnings, samples, strict=True)
    ]
    first, best = near or (0, FIRST_SMOOTHNESS if FIRST_SMOOTHNESS in smoothness else smoothness[0])
    chosen, lowest = None, np.inf
    for done, number in enumerate(sorted(range(len(bases)), key=lambda number: number != first), 1):
        report_progress(f"choosing grid and smoothness, {done} of {len(bases)}")
        problem = Problem.pose(thin, bases[number]).reweighted()
        better, score = problem.best_smoothness(smoothness, best, lowest)
        if chosen is None or score < lowest:
            chosen, best, lowest = problem, better, score
    assert chosen is not None
    return Choice(chosen, best, beginnings)


def _solved(
    samples: Sequence[Samples],
    problem: Problem,
    smoothness: float,
    beginnings: Sequence[InitialState],
    again: Callable[[Sequence[Samples]], Fitted],
) -> Fitted:
    """Solve a problem whose samples begin with the initial state; return the result without that history."""
    report_progress(f"fit to {problem.count} samples")
    whole = problem.solve(smoothness)
    x = whole.x
    predicted = np.split(problem.design.predict(x) * problem.scale, np.cumsum([part.v.size for part in samples])[:-1])
    recorded, starts = [], []
    for part, beginning, y in zip(samples, beginnings, predicted, strict=True):
        first = len(beginning.history)
        recorded.append(np.arange(part.v.size) >= first)
        starts.append(Start(float(part.v[first]), float(y[first]), beginning.history))
    return Fitted(
        hysteresis=problem.basis.shape(x[: problem.basis.size + 1] * problem.scale, problem.gain),
        starts=tuple(starts),
        y=np.concatenate([part.y[part.fitted] for part in samples]),
        voltage_range=_fitted_range(samples),
        errors=problem.errors(x),
        covered=problem.basis.covered(problem.design.local[np.concatenate([part.fitted for part in samples])]),
        validate=lambda: problem.held_out_errors(smoothness, whole)[np.concatenate(recorded)],
        again=again,
    )


def _fitted_range(samples: Sequence[Samples]) -> tuple[float, float]:
    low, high = zip(*(part.voltage_range for part in samples), strict=True)
    return min(low), max(high)
