"""Convex fit of one basis to one or several records, its solution and its held-out error."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg
import scipy.sparse as sp
import scipy.sparse.linalg

from slpi_ros.arrays import FloatArray, IntArray, Mask
from slpi_ros.hysteresis.kinds import Hysteresis
from slpi_ros.identification.bases import Basis
from slpi_ros.identification.design_matrix import Design, Walk
from slpi_ros.identification.progress import report_progress
from slpi_ros.identification.quadratic_program import QuadraticProgram, Solution, cholesky
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
    covered: float  # share of the parameters or loops that the samples determine
    validate: Callable[[], FloatArray]  # computes the held-out errors
    again: Callable[[Sequence[Samples]], "Fitted"]  # the same fit to fewer of the samples, sought near this one

    @cached_property
    def held_out(self) -> FloatArray:
        """Held-out error of every sample, shape (N,), metres; NaN for those in every fit."""
        return self.validate()

    @property
    def held_out_rms(self) -> float:
        """Rms held-out error, metres, with equal weights of all samples."""
        return float(np.sqrt(np.nanmean(self.held_out**2)))


def solve_free(matrix: FloatArray, vector: FloatArray, *, overwrite: bool = False) -> FloatArray:
    """Minimise ``x' M x / 2 - b' x`` without constraints; parameters and errors as in `QuadraticProgram`."""
    root = cholesky(matrix, overwrite=overwrite)
    solution: FloatArray = scipy.linalg.cho_solve((root, True), vector, check_finite=False)
    return solution


# Parameters, and share of entries of their matrix, from and up to which a sparse factorisation takes its place: those
# of a loop family of many vertices are coupled to their neighbours, and to those at which the path turned.
SPARSE_FROM, SPARSE_SHARE = 1000, 0.1
SYMMETRIC: dict[str, Any] = {
    "permc_spec": "MMD_AT_PLUS_A",
    "diag_pivot_thresh": 0.0,
    "options": {"SymmetricMode": True},
}
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
    rough: sp.csr_array  # roughness matrix, (p, p)
    scale: float  # m
    gain: float  # m/V, mean

    @classmethod
    def pose(cls, samples: Sequence[Samples], basis: Basis) -> "Problem":
        """Pose the problem of fitting `basis` to the samples of one record or several."""
        walk = walk_of(samples, basis)
        design = Design.of(walk, basis.branch_part(walk))
        volts, metres = np.max([part.spread for part in samples], axis=0).tolist()
        own = sp.csr_array(basis.roughness.T @ basis.roughness)
        rows, size = own.shape[0], design.local.shape[1]
        pointers = np.append(own.indptr, np.full(size - rows, own.indptr[-1], own.indptr.dtype))
        return cls(
            basis=basis,
            design=design,
            y=np.concatenate([part.y for part in samples]) / metres,
            weights=np.concatenate([part.fitted for part in samples]).astype(np.float64),
            judged=np.concatenate([part.judged for part in samples]),
            rough=sp.csr_array((own.data, own.indices, pointers), shape=(size, size)),
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
        matrix: FloatArray = (self.rough * (smoothness * count / 1000)).toarray()
        matrix[np.diag_indices_from(matrix)] += self._ridge * count
        return matrix

    @cached_property
    def _ridge(self) -> float:
        """Regularisation in the units of the design: play operators move by volts, up to thousands of them."""
        local = self.design.local
        square: float = float(scipy.sparse.linalg.norm(local)) ** 2 / max(local.shape[0], 1)
        return RIDGE * max(1.0, square)

    @cached_property
    def equations(self) -> tuple[FloatArray, FloatArray]:
        """Normal equations of the fitted samples: ``A' W A``, shape (p, p), and ``A' W y``, shape (p,)."""
        return self.design.normal_equations(self.y, self.weights)

    @cached_property
    def _sparse(self) -> sp.csc_array | None:
        """The matrix of `equations`, if it is large and has few entries."""
        matrix = self.equations[0]
        few = len(matrix) >= SPARSE_FROM and np.count_nonzero(matrix) <= SPARSE_SHARE * matrix.size
        return sp.csc_array(matrix) if few else None

    def solve(self, smoothness: float) -> Solution:
        """Return the fit to all samples in which every branch is monotone."""
        matrix, vector = self.equations
        return self.program(matrix + self.penalty(smoothness, self.count)).solve(vector)

    def program(self, matrix: FloatArray) -> QuadraticProgram:
        """Return the program ``x' M x / 2 - b' x`` subject to monotone branches, for the matrix M, shape (p, p)."""
        return QuadraticProgram(matrix, *self._monotone)

    @cached_property
    def _monotone(self) -> tuple[sp.csr_array, FloatArray]:
        constraints, bound = self.basis.monotone(self.gain / self.scale)
        # The displacement at rest of each record is unconstrained.
        shape = (bound.size, self.rough.shape[0])
        return sp.csr_array((constraints.data, constraints.indices, constraints.indptr), shape), bound

    def residual(self) -> FloatArray:
        """Return the errors, shape (N,), in units of `scale`, of a quick fit without monotonicity constraints."""
        return self.design.predict(self._free(FIRST_SMOOTHNESS, self.count)) - self.y

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

    @cached_property
    def folds(self) -> list["Fold"]:
        """Parts of the fitted samples, each of which is left out of one fit of a cross-validation."""
        # The first rise is part of every fit: it occurs only once in a record, so no other part can predict it.
        folds = []
        for chosen in blocked_folds((self.weights > 0) & self.judged & ~self.design.walk.first_rise):
            weights = np.zeros_like(self.weights)
            weights[chosen] = self.weights[chosen]
            square = float(weights[chosen] @ self.y[chosen] ** 2)
            matrix, vector = self.design.normal_equations(self.y, weights)
            folds.append(Fold(chosen, square, matrix if self._sparse is None else sp.csc_array(matrix), vector))
        return folds

    def held_out_errors(self, smoothness: float, whole: Solution) -> FloatArray:
        """Return the held-out error (m) of each sample, shape (N,); NaN for samples that are in every fit.

        `whole` is the fit to all samples, near which those to parts of them are sought.
        """
        errors = np.full(self.y.size, np.nan)
        (matrix, vector), near = self.equations, whole.multipliers
        for number, fold in enumerate(self.folds, 1):
            report_progress(f"cross-validation, fold {number} of {FOLDS}")
            rest = matrix - fold.matrix + self.penalty(smoothness, self.count - fold.chosen.size)
            x, near = self.program(rest).solve(vector - fold.vector, near)
            errors[fold.chosen] = (self.design.predict(x) - self.y)[fold.chosen] * self.scale
        return errors

    def smoothness_near(self, present: float, among: Sequence[float]) -> float:
        """Return a local minimum of the held-out error over ascending roughness weights, searched from `present`."""
        score = cache(lambda k: self.score(among[k]))
        best, k = among.index(present), -1
        while best != k:
            k = best
            best = min(range(max(k - 1, 0), min(k + 2, len(among))), key=score)
        return among[best]

    def best_smoothness(self, among: Sequence[float], near: float, below: float = np.inf) -> tuple[float, float]:
        """Return the roughness weight with the lowest `score` and that score (m); (`near`, `below`) if none is lower.

        Those next to the weight `near` are tried first: their scores tell that others need not be computed.
        """
        best, start, end = near, among.index(near), len(among)
        for k in sorted(range(len(among)), key=lambda k: abs(k - start)):
            if k < end:
                score, beyond = self._scored(among[k], below)
                # The error of a fit to all samples grows with the weight.
                end = k if beyond else end
                if score < below:
                    best, below = among[k], score
        return best, below

    def score(self, smoothness: float, below: float = np.inf) -> float:
        """Return the robust rms held-out error (m) of fits without monotonicity constraints.

        It may be infinite where it is not less than `below` (m), which is known early: a fit to all samples with the
        same penalty has a smaller squared error on each fold than the fit to the others.
        """
        return self._scored(smoothness, below)[0]

    def _scored(self, smoothness: float, below: float) -> tuple[float, bool]:
        """Return the score, and whether even the fit to all samples has an error of `below` (m) or more."""
        counts = np.array([self.count - fold.chosen.size for fold in self.folds])
        total = float(self.weights[np.concatenate([fold.chosen for fold in self.folds])].sum())
        lowest, squares = total * (below / self.scale) ** 2, np.zeros(len(self.folds))
        if np.isfinite(lowest):
            least, (matrix, vector) = int(counts.min()), self.equations
            x = self._free(smoothness, least)
            # The folds differ by a few samples, and so do their penalties.
            penalty = (x @ vector - x @ matrix @ x) * (counts / least - 1.0)
            squares = np.array([fold.error(x) for fold in self.folds]) - penalty
        beyond = bool(squares.sum() >= lowest)
        for k in np.argsort(-squares).tolist():
            if squares.sum() >= lowest:
                return np.inf, beyond
            squares[k] = self.folds[k].error(self._free(smoothness, int(counts[k]), self.folds[k]))
        return float(np.sqrt(max(squares.sum(), 0.0) / total)) * self.scale, False

    def _free(self, smoothness: float, count: int, without: "Fold | None" = None) -> FloatArray:
        """Return the fit without constraints, and `without` a fold, with the penalty for `count` samples."""
        matrix, vector = self.equations
        if without:
            vector = vector - without.vector
        if self._sparse is not None:
            few = self._sparse + self.rough * (smoothness * count / 1000)
            few = sp.csc_array(few - without.matrix if without else few)
            few.setdiag(few.diagonal() + self._ridge * count)
            return np.asarray(scipy.sparse.linalg.splu(few, **SYMMETRIC).solve(vector))
        whole = self.penalty(smoothness, count)
        whole += matrix
        if without:
            whole -= without.matrix
        return solve_free(whole, vector, overwrite=True)


class Fold(NamedTuple):
    """Samples that are left out of a fit, and what they contribute to the normal equations."""

    chosen: IntArray  # indices
    square: float  # weighted sum of squared displacements, in units of the problem
    matrix: FloatArray | sp.csc_array  # (p, p)
    vector: FloatArray  # (p,)

    def error(self, x: FloatArray) -> float:
        """Return the weighted squared error of parameters x, shape (p,), on these samples."""
        return float(self.square + x @ (self.matrix @ x - 2.0 * self.vector))


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
