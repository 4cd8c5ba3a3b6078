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


def fit_family(samples: Samples) -> Fitted:
    """Fit the loop family."""
    low, high = float(samples.v.min()), float(samples.v.max())
    return fit_linear(samples, [SurfaceBasis(np.linspace(low, high, n)) for n in VERTICES], SMOOTHNESS)


def fit_plays(samples: Samples) -> Fitted:
    """Fit the classical PI model."""
    half_range = float(np.ptp(samples.v)) / 2
    return fit_linear(samples, [PlayBasis(np.linspace(0.0, half_range, PLAY_OPERATORS, endpoint=False))])


def fit_linear(samples: Samples, bases: Sequence[Basis], smoothness: Sequence[float] = SMOOTHNESS[:1]) -> Fitted:
    """Fit the basis, with the roughness weight, that predicts blocks left out best.

    Parameters
    ----------
    samples : Samples
    bases : sequence of Basis
        Those that compete, the simplest one first.
    smoothness : sequence of float
        Roughness weights that compete.

    Raises
    ------
    IdentificationError
        If the samples do not determine the model.
    """
    thin = samples.thinned(SELECTION_SAMPLES)
    beginning = choose_start(thin, lambda candidate: Problem.pose(candidate, bases[0]))
    thin = beginning.of(thin)
    candidates = []
    for basis in bases:
        problem = Problem.pose(thin, basis).reweighted()
        scores = problem.scores(smoothness)
        k = int(np.argmin(scores))
        candidates.append((float(scores[k]), smoothness[k], problem))
    _, chosen, problem = min(candidates, key=lambda candidate: candidate[0])
    if samples.v.size > thin.v.size:
        samples = beginning.of(samples.thinned(FIT_SAMPLES))
        problem = Problem.pose(samples, problem.basis).reweighted()
    else:
        samples = thin
    return _solved(samples, problem, chosen, beginning.history)


def fit_multi_slope(samples: Samples) -> Fitted:
    """Fit the MPI model of the amplitude that the record covers, from rest, by plain least squares as published."""
    problem = Problem.pose(samples, MultiSlopeBasis.over(float(samples.v.min()), float(samples.v.max())))
    return _solved(samples, problem, FIRST_SMOOTHNESS, ())


def _solved(samples: Samples, problem: Problem, smoothness: float, history: tuple[float, ...]) -> Fitted:
    x = problem.solve(smoothness)
    at_start = problem.design.predict(x)[len(history)] * problem.scale
    return Fitted(
        hysteresis=problem.basis.shape(x * problem.scale, problem.gain),
        start=Start(float(samples.v[len(history)]), float(at_start), history),
        samples=samples,
        errors=problem.errors(x),
        held_out_rms=problem.held_out(smoothness),
        covered=problem.basis.covered(problem.design.local[samples.fitted]),
    )
