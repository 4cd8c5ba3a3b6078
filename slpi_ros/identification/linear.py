"""The kinds that are linear in their parameters: one convex fit, as smooth and fine as held-out blocks say."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from slpi_ros.identification.bases import Basis, PlayBasis, SurfaceBasis
from slpi_ros.identification.fitted import Fitted
from slpi_ros.identification.multi_slope import MultiSlopeBasis
from slpi_ros.identification.problem import FIRST_SMOOTHNESS, Problem
from slpi_ros.identification.samples import Samples
from slpi_ros.identification.start import choose_start
from slpi_ros.model import Start

FloatArray = NDArray[np.float64]

# Vertices of the loop family's grid, and weights of its roughness, that cross-validation chooses from.
VERTICES = (21, 31, 41)
SMOOTHNESS = (0.001, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0)
PLAY_OPERATORS = 30
# A long record is thinned to about so many samples to choose start, grid and smoothness by, and to be fitted at last:
# more of them cost time and memory, and tell nothing new.
SELECTION_SAMPLES, FIT_SAMPLES = 100_000, 1_000_000


def fit_family(samples: Sequence[Samples]) -> Fitted:
    """Fit the loop family to one record or several."""
    low, high = _voltage_range(samples)
    return fit_linear(samples, [SurfaceBasis(np.linspace(low, high, n)) for n in VERTICES], SMOOTHNESS)


def fit_plays(samples: Sequence[Samples]) -> Fitted:
    """Fit the classical PI model to one record or several."""
    low, high = _voltage_range(samples)
    return fit_linear(samples, [PlayBasis(np.linspace(0.0, (high - low) / 2, PLAY_OPERATORS, endpoint=False))])


def fit_multi_slope(samples: Sequence[Samples]) -> Fitted:
    """Fit the MPI model of the amplitude that the records cover, from rest, by plain least squares as published."""
    problem = Problem.pose(samples, MultiSlopeBasis.over(*_voltage_range(samples)))
    return _solved(samples, problem, FIRST_SMOOTHNESS, ())


def _voltage_range(samples: Sequence[Samples]) -> tuple[float, float]:
    return float(min(part.v.min() for part in samples)), float(max(part.v.max() for part in samples))


def fit_linear(
    samples: Sequence[Samples], bases: Sequence[Basis], smoothness: Sequence[float] = SMOOTHNESS[:1]
) -> Fitted:
    """Fit the basis, with the roughness weight, that predicts blocks left out best.

    Parameters
    ----------
    samples : sequence of Samples
        Of each record.
    bases : sequence of Basis
        Those that compete, the simplest one first.
    smoothness : sequence of float
        Roughness weights that compete.

    Raises
    ------
    IdentificationError
        If the samples do not determine the model.
    """
    thin = [part.thinned(SELECTION_SAMPLES // len(samples)) for part in samples]
    beginnings = [choose_start(part, lambda candidate: Problem.pose([candidate], bases[0])) for part in thin]
    thin = [beginning.of(part) for beginning, part in zip(beginnings, thin, strict=True)]
    candidates = []
    for basis in bases:
        problem = Problem.pose(thin, basis).reweighted()
        scores = problem.scores(smoothness)
        k = int(np.argmin(scores))
        candidates.append((float(scores[k]), smoothness[k], problem))
    _, chosen, problem = min(candidates, key=lambda candidate: candidate[0])
    fitted = [
        beginning.of(part.thinned(FIT_SAMPLES // len(samples)))
        for beginning, part in zip(beginnings, samples, strict=True)
    ]
    if any(part.v.size > thinned.v.size for part, thinned in zip(fitted, thin, strict=True)):
        problem = Problem.pose(fitted, problem.basis).reweighted()
    return _solved(fitted, problem, chosen, beginnings[0].history)


def _solved(samples: Sequence[Samples], problem: Problem, smoothness: float, history: tuple[float, ...]) -> Fitted:
    """Solve a problem; the model starts as the first record does, after its `history`."""
    x = problem.solve(smoothness)
    at_start = problem.design.predict(x)[len(history)] * problem.scale
    return Fitted(
        hysteresis=problem.basis.shape(x[: problem.basis.size + 1] * problem.scale, problem.gain),
        start=Start(float(samples[0].v[len(history)]), float(at_start), history),
        y=np.concatenate([part.y[part.fitted] for part in samples]),
        voltage_range=_fitted_range(samples),
        errors=problem.errors(x),
        held_out_rms=problem.held_out(smoothness),
        covered=problem.basis.covered(problem.design.local[np.concatenate([part.fitted for part in samples])]),
    )


def _fitted_range(samples: Sequence[Samples]) -> tuple[float, float]:
    low, high = zip(*(part.voltage_range for part in samples), strict=True)
    return min(low), max(high)
