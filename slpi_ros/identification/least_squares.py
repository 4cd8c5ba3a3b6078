"""Convex fit of one basis to one or several records, its solution and its held-out error."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property

import numpy as np
import osqp
import scipy.linalg
import scipy.sparse as sp
import scipy.sparse.linalg

from slpi_ros.arrays import FloatArray, IntArray, Mask
from slpi_ros.errors import IdentificationError
from slpi_ros.hysteresis.kinds import Hysteresis
from slpi_ros.identification.bases import Basis
from slpi_ros.identification.design_matrix import Design, Walk
from slpi_ros.identification.progress import report_progress
from slpi_ros.identification.samples import Samples
from slpi_ros.model.axis_model import Start


@dataclass(frozen=True)
class Fitted:
    """Fitted hysteresis model, the initial state of each record, and the errors (m, model minus measured, free-run)."""

    hysteresis: Hysteresis
    starts: tuple[Start, ...]
    y: FloatArray  # m, fitted samples
    voltage_range: tuple[float, float]  # V, of the fitted samples
    errors: FloatArray
    held_out: FloatArray  # of every sample, (N,); NaN for those in every fit
    covered: float  # share of the parameters or loops that the samples determine

    @property
    def held_out_rms(self) -> float:
        """Rms held-out error, metres, with equal weights of all samples."""
        return float(np.sqrt(np.nanmean(self.held_out**2)))


# Tolerance of the constraints, in units of the scaled problem; far below the least gain.
TOLERANCE = 1e-7
# Default number of iterations between convergence checks of OSQP.
CHECKED_EVERY = 25


def solve_qp(
    matrix: FloatArray,
    vector: FloatArray,
    constraints: sp.csr_array,
    bound: FloatArray,
    *,
    least_iterations: int = CHECKED_EVERY,
) -> FloatArray:
    """Return the x, (p,), that minimises ``x' M x / 2 - b' x`` subject to ``C x >= bound``; M positive definite."""
    # `least_iterations` is also the interval of the convergence checks; IdentificationError if it does not converge.
    free = solve_free(matrix, vector)
    if np.all(constraints @ free >= bound):
        return free
    # No polishing step: it does not improve the solution at this tolerance, and it writes to standard output.
    solver = osqp.OSQP()
    solver.setup(
        sp.csc_matrix(np.triu(matrix)), -vector, sp.csc_matrix(constraints), bound, np.full(bound.size, np.inf),
        verbose=False, eps_abs=TOLERANCE, eps_rel=TOLERANCE, max_iter=50_000, check_termination=least_iterations,
    )  # fmt: skip
    solver.warm_start(x=free)
    result = solver.solve(raise_error=False)
    if result.info.status != "solved":
        raise IdentificationError(
            f"the quadratic program did not converge (OSQP: {result.info.status}); check the record for gross errors"
        )
    solution: FloatArray = result.x
    return solution


def solve_free(matrix: FloatArray, vector: FloatArray) -> FloatArray:
    """Minimise ``x' M x / 2 - b' x`` without constraints; parameters and errors as in `solve_qp`."""
    try:
        solution: FloatArray = scipy.linalg.cho_solve(scipy.linalg.cho_factor(matrix), vector)
    except np.linalg.LinAlgError:
        raise IdentificationError("the record does not determine the model; cover more of the voltage range") from None
    return solution


# Roughness weight for the detection of outliers and the comparison of initial states.
FIRST_SMOOTHNESS = 0.1
FOLDS, BLOCKS_OF_FOLD = 5, 8
# Errors beyond this many (robust) standard deviations count linearly, not squared (Huber).
HUBER = 1.5
REWEIGHTINGS = 3
# Regularisation that keeps the equations definite where neither record nor roughness determines a parameter.
RIDGE = 1e-9


def walk_of(samples: Sequence[Samples], basis: Basis) -> Walk:
    """Return the hysteresis branches of the samples of one record or several."""
    return Walk.joined(
        [Walk.along(part.v, symmetric_rest=basis.symmetric_rest, primed=part.primed) for part in samples]
    )


@dataclass(frozen=True)
class Problem:
    """Least-squares problem of the fit of one basis to one or several records."""

    basis: Basis
    design: Design
    y: FloatArray  # in units of `scale`, (N,)
    weights: FloatArray  # 0: not fitted
    judged: Mask  # can be held out
    rough: FloatArray  # roughness matrix, (p, p)
    scale: float  # m
    gain: float  # m/V, mean

    @classmethod
    def pose(cls, samples: Sequence[Samples], basis: Basis) -> "Problem":
        """Pose the problem of fitting `basis` to the samples of one record or several."""
        walk = walk_of(samples, basis)
        design = Design.of(walk, basis.branch_part(walk))
        volts, metres = np.max([part.spread for part in samples], axis=0).tolist()
        rough = np.zeros((design.local.shape[1],) * 2)
        own = basis.roughness
        rough[: own.shape[1], : own.shape[1]] = (own.T @ own).toarray()
        return cls(
            basis=basis,
            design=design,
            y=np.concatenate([part.y for part in samples]) / metres,
            weights=np.concatenate([part.fitted for part in samples]).astype(np.float64),
            judged=np.concatenate([part.judged for part in samples]),
            rough=rough,
            scale=metres,
            gain=metres / volts,
        )

    @property
    def count(self) -> int:
        """Number of samples fitted."""
        return int(np.count_nonzero(self.weights))

    def errors(self, x: FloatArray) -> FloatArray:
        """Return the errors of the fitted samples, model minus measured, metres."""
        fitted = self.weights > 0
        return (self.design.predict(x) - self.y)[fitted] * self.scale

    def penalty(self, smoothness: float, count: float) -> FloatArray:
        """Return the matrix of the roughness penalty with weight `smoothness` for `count` samples, shape (p, p)."""
        matrix = self.rough * (smoothness * count / 1000)
        matrix[np.diag_indices_from(matrix)] += self._ridge * count
        return matrix

    @cached_property
    def _ridge(self) -> float:
        """Regularisation in the units of the design: play operators move by volts, up to thousands of them."""
        local = self.design.local
        square: float = float(scipy.sparse.linalg.norm(local)) ** 2 / max(local.shape[0], 1)
        return RIDGE * max(1.0, square)

    def solve(self, smoothness: float) -> FloatArray:
        """Return the parameters, shape (p,), of a fit to all samples in which every branch is monotone."""
        matrix, vector = self.design.normal_equations(self.y, self.weights)
        return self.constrained(matrix + self.penalty(smoothness, self.count), vector)

    def constrained(self, matrix: FloatArray, vector: FloatArray) -> FloatArray:
        """Minimise ``x' M x / 2 - b' x`` subject to monotone branches."""
        constraints, bound = self.basis.monotone(self.gain / self.scale)
        # The displacement at rest of each record is unconstrained.
        shape = (bound.size, matrix.shape[0])
        constraints = sp.csr_array((constraints.data, constraints.indices, constraints.indptr), shape)
        return solve_qp(matrix, vector, constraints, bound)

    def residual(self) -> FloatArray:
        """Return the errors, shape (N,), in units of `scale`, of a quick fit without monotonicity constraints."""
        matrix, vector = self.design.normal_equations(self.y, self.weights)
        x = solve_free(matrix + self.penalty(FIRST_SMOOTHNESS, self.count), vector)
        return self.design.predict(x) - self.y

    def reweighted(self) -> "Problem":
        """Return the problem with reduced weights of outliers (Huber)."""
        allowed = (self.weights > 0).astype(np.float64)
        problem = self
        for _ in range(REWEIGHTINGS):
            size = np.abs(problem.residual())
            spread = 1.4826 * np.median(size[allowed > 0])
            weights = allowed * np.minimum(1.0, HUBER * spread / np.maximum(size, 1e-300))
            problem = replace(self, weights=weights)
        return problem

    def folds(self) -> list[IntArray]:
        """Return the sample indices of each fold."""
        # The first rise is part of every fit: it occurs only once in a record, so no other part can predict it.
        return blocked_folds((self.weights > 0) & self.judged & ~self.design.walk.first_rise)

    def held_out_errors(self, smoothness: float) -> FloatArray:
        """Return the held-out error (m) of each sample, shape (N,); NaN for samples that are in every fit."""
        errors = np.full(self.y.size, np.nan)
        for fold, chosen in enumerate(self.folds(), 1):
            report_progress(f"cross-validation, fold {fold} of {FOLDS}")
            weights = self.weights.copy()
            weights[chosen] = 0.0
            part = replace(self, weights=weights)
            errors[chosen] = (self.design.predict(part.solve(smoothness)) - self.y)[chosen] * self.scale
        return errors

    def scores(self, smoothness: Sequence[float]) -> FloatArray:
        """Return the robust rms held-out error (m) for each smoothness, from fits without monotonicity constraints."""
        return np.array([self._score(each) for each in smoothness])

    def smoothness_near(self, present: float, among: Sequence[float]) -> float:
        """Return a local minimum of the held-out error over ascending roughness weights, searched from `present`."""
        score = cache(lambda k: self._score(among[k]))
        best, k = among.index(present), -1
        while best != k:
            k = best
            best = min(range(max(k - 1, 0), min(k + 2, len(among))), key=score)
        return among[best]

    @cached_property
    def _folds(self) -> list[tuple[int, FloatArray, FloatArray, FloatArray, FloatArray]]:
        """For each fold: number of its samples, normal equations of all other samples, normal equations of the fold."""
        matrix, vector = self.design.normal_equations(self.y, self.weights)
        equations = []
        for chosen in self.folds():
            left_out = np.zeros_like(self.weights)
            left_out[chosen] = self.weights[chosen]
            own_matrix, own_vector = self.design.normal_equations(self.y, left_out)
            equations.append((chosen.size, matrix - own_matrix, vector - own_vector, own_matrix, own_vector))
        return equations

    def _score(self, smoothness: float) -> float:
        """Return the robust rms held-out error (m) of fits without monotonicity constraints."""
        judged = np.concatenate(self.folds())
        squares, total = float(self.weights[judged] @ self.y[judged] ** 2), float(self.weights[judged].sum())
        for count, matrix, vector, own_matrix, own_vector in self._folds:
            x = solve_free(matrix + self.penalty(smoothness, self.count - count), vector)
            squares += float(x @ own_matrix @ x - 2.0 * (x @ own_vector))
        return float(np.sqrt(max(squares, 0.0) / total)) * self.scale


def blocked_folds(allowed: Mask) -> list[IntArray]:
    """Return the sample indices of each fold, from the mask `allowed`; a fold is a set of blocks across the record."""
    blocks = np.array_split(np.flatnonzero(allowed), FOLDS * BLOCKS_OF_FOLD)
    return [np.concatenate(blocks[fold::FOLDS]) for fold in range(FOLDS)]


def held_out_errors(samples: Samples, allowed: Mask, predict: Callable[[Mask], FloatArray]) -> FloatArray:
    """Return the held-out error (m) of each sample, shape (N,); NaN for samples that are in every fit."""
    # `predict` takes the mask of samples to be fitted, and returns the displacement of all (m).
    errors = np.full(samples.v.size, np.nan)
    for fold, chosen in enumerate(blocked_folds(allowed), 1):
        report_progress(f"cross-validation, fold {fold} of {FOLDS}")
        kept = samples.fitted.copy()
        kept[chosen] = False
        errors[chosen] = (predict(kept) - samples.y)[chosen]
    return errors
