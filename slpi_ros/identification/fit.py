"""From a record to a model: one convex fit for each axis, as smooth and as fine as blocked cross-validation says."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from slpi_ros.errors import IdentificationError, SlpiError, UsageError
from slpi_ros.identification.bases import Basis, PlayBasis, SurfaceBasis
from slpi_ros.identification.qp import solve_free, solve_qp
from slpi_ros.identification.record import Record
from slpi_ros.identification.samples import Samples, select_samples
from slpi_ros.identification.start import choose_start
from slpi_ros.identification.walk import Design, Walk
from slpi_ros.model import AxisModel, FitQuality, StageModel, Start

FloatArray = NDArray[np.float64]

KINDS = ("slpi", "pi")
# Vertices of the loop family's grid, and weights of its roughness, that cross-validation chooses from.
VERTICES = (21, 31, 41)
SMOOTHNESS = (0.001, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0)
# The weight with which outliers are found and starts are compared.
FIRST_SMOOTHNESS = 0.1
PLAY_OPERATORS = 30
FOLDS, BLOCKS_OF_FOLD = 5, 8
# Errors beyond this many (robust) standard deviations count linearly, not squared (Huber).
HUBER = 1.5
REWEIGHTINGS = 3
# A model that leaves more than this share of the displacement's rms unexplained is none.
SENSELESS = 0.5
# Keeps the equations definite where neither record nor roughness says anything.
RIDGE = 1e-9


def identify(
    record: Record,
    kind: str = "slpi",
    *,
    start: float | None = None,
    stop: float | None = None,
    axes: Sequence[str] | None = None,
) -> StageModel:
    """Identify the model of a stage from a record.

    Parameters
    ----------
    record : Record
        Voltage before `start` still moves the memory; only the displacement there is not fitted.
    kind : str
        ``slpi`` (the loop family) or ``pi`` (classical Prandtl-Ishlinskii).
    start, stop : float, seconds, optional
        Fit only samples with ``start <= t < stop``, t from the record's first stamp.
    axes : sequence of str, optional
        All axes of the record by default.

    Returns
    -------
    StageModel

    Raises
    ------
    UsageError
        If the kind or an axis is not known.
    RecordError, IdentificationError
        If the record does not allow a fit; the message says what is missing.
    """
    if kind not in KINDS:
        raise UsageError(f"unknown kind '{kind}'; this version identifies {', '.join(KINDS)}")
    if not (-np.inf if start is None else start) < (np.inf if stop is None else stop):
        raise UsageError(f"start {start} s is not before stop {stop} s; give seconds from the first stamp, in order")
    models = {}
    for axis in axes or record.axes:
        samples = select_samples(record, axis, start, stop)
        try:
            # The matrices are small: more threads than one only stand in each other's way.
            with threadpool_limits(1):
                models[axis] = _identify_axis(samples, kind, record.source)
        except SlpiError as error:
            raise type(error)(f"{record.source}: axis '{axis}': {error}") from None
    return StageModel(models, record.hardware_id, datetime.now(UTC).isoformat(timespec="seconds"))


@dataclass(frozen=True)
class _Problem:
    """One basis on one record.

    Displacement is in units of `scale`; weights are zero where a sample is not fitted; `rough` is the matrix of the
    basis's roughness.
    """

    basis: Basis
    design: Design
    y: FloatArray
    weights: FloatArray
    rough: FloatArray
    scale: float
    gain: float

    @property
    def count(self) -> int:
        return int(np.count_nonzero(self.weights))

    def errors(self, x: FloatArray) -> FloatArray:
        """Return the errors of the fitted samples, metres."""
        fitted = self.weights > 0
        return (self.design.predict(x) - self.y)[fitted] * self.scale

    def penalty(self, smoothness: float, count: float) -> FloatArray:
        matrix = self.rough * (smoothness * count / 1000)
        matrix[np.diag_indices_from(matrix)] += RIDGE * count
        return matrix

    def solve(self, smoothness: float) -> FloatArray:
        """Fit all samples, with every branch rising."""
        matrix, vector = self.design.normal_equations(self.y, self.weights)
        constraints, bound = self.basis.monotone(self.gain / self.scale)
        return solve_qp(matrix + self.penalty(smoothness, self.count), vector, constraints, bound)

    def residual(self) -> FloatArray:
        """Return the errors, shape (N,), in units of `scale`, of a rough fit whose branches may fall."""
        matrix, vector = self.design.normal_equations(self.y, self.weights)
        x = solve_free(matrix + self.penalty(FIRST_SMOOTHNESS, self.count), vector)
        return self.design.predict(x) - self.y

    def reweighted(self) -> "_Problem":
        """Return the problem with outliers weighed down."""
        allowed = (self.weights > 0).astype(np.float64)
        problem = self
        for _ in range(REWEIGHTINGS):
            size = np.abs(problem.residual())
            spread = 1.4826 * np.median(size[allowed > 0])
            weights = allowed * np.minimum(1.0, HUBER * spread / np.maximum(size, 1e-300))
            problem = replace(self, weights=weights)
        return problem

    def folds(self) -> list[NDArray[np.int64]]:
        """Return the samples that are left out together: blocks spread over the record.

        The first rise is never left out: a record shows it once, and no other part can predict it.
        """
        candidates = np.flatnonzero((self.weights > 0) & ~self.design.walk.first_rise)
        blocks = np.array_split(candidates, FOLDS * BLOCKS_OF_FOLD)
        return [np.concatenate(blocks[fold::FOLDS]) for fold in range(FOLDS)]

    def held_out(self, smoothness: float) -> float:
        """Return the rms error (m) on blocks left out of the fit: every sample counts alike, and every branch rises."""
        errors = []
        for chosen in self.folds():
            weights = self.weights.copy()
            weights[chosen] = 0.0
            part = replace(self, weights=weights)
            errors.append((self.design.predict(part.solve(smoothness)) - self.y)[chosen])
        return float(np.sqrt(np.mean(np.concatenate(errors) ** 2))) * self.scale

    def scores(self, smoothness: Sequence[float]) -> FloatArray:
        """Return the robust rms error (m) on blocks left out, one for each smoothness; quick, so branches may fall."""
        matrix, vector = self.design.normal_equations(self.y, self.weights)
        squares, total = np.zeros(len(smoothness)), 0.0
        for chosen in self.folds():
            left_out = np.zeros_like(self.weights)
            left_out[chosen] = self.weights[chosen]
            fold_matrix, fold_vector = self.design.normal_equations(self.y, left_out)
            energy, total = float(left_out @ self.y**2), total + float(left_out.sum())
            for k, weight in enumerate(smoothness):
                rest = self.penalty(weight, self.count - chosen.size)
                x = solve_free(matrix - fold_matrix + rest, vector - fold_vector)
                squares[k] += x @ fold_matrix @ x - 2.0 * (x @ fold_vector) + energy
        rms: FloatArray = np.sqrt(np.maximum(squares, 0.0) / total) * self.scale
        return rms


def _identify_axis(samples: Samples, kind: str, source: str) -> AxisModel:
    samples, history = choose_start(samples, lambda candidate: _pose(candidate, _bases(candidate, kind)[0]))
    best: tuple[float, float, _Problem] | None = None
    for basis in _bases(samples, kind):
        problem = _pose(samples, basis).reweighted()
        smoothness = SMOOTHNESS if kind == "slpi" else SMOOTHNESS[:1]
        scores = problem.scores(smoothness)
        k = int(np.argmin(scores))
        if best is None or scores[k] < best[0]:
            best = float(scores[k]), smoothness[k], problem
    assert best is not None
    _, chosen, problem = best
    x = problem.solve(chosen)
    errors = problem.errors(x)
    held_out = problem.held_out(chosen)
    covered = problem.basis.covered(problem.design.local[samples.fitted])
    _require_sense(samples, held_out, covered)
    fitted_y = samples.y[samples.fitted]
    at_start = problem.design.predict(x)[len(history)] * problem.scale
    return AxisModel(
        kind=kind,
        hysteresis=problem.basis.shape(x * problem.scale, problem.gain),
        start=Start(float(samples.v[len(history)]), float(at_start), history),
        voltage_range=samples.voltage_range,
        displacement_range=(float(fitted_y.min()), float(fitted_y.max())),
        quality=FitQuality(
            rms=float(np.sqrt(np.mean(errors**2))),
            maximum=float(np.max(np.abs(errors))),
            held_out_rms=held_out,
            floor_rms=_noise(errors),
            samples=problem.count,
            covered=covered,
            source=source,
        ),
    )


def _require_sense(samples: Samples, held_out: float, covered: float) -> None:
    """Refuse a model that says nothing."""
    if covered == 0.0:
        raise IdentificationError("the voltage never turns back; drive it up and down over the range to be used")
    spread = float(np.std(samples.y[samples.fitted]))
    if held_out > SENSELESS * spread:
        raise IdentificationError(
            f"the voltage does not explain the displacement: error {held_out * 1e9:.4g} nm rms on blocks left out, of "
            f"{spread * 1e9:.4g} nm rms in all; check that both signals belong to this axis, and their clocks"
        )


def _noise(errors: FloatArray) -> float:
    """Return the rms of what changes from sample to sample in `errors`, outliers apart."""
    return float(1.4826 * np.median(np.abs(np.diff(errors))) / np.sqrt(2))


def _bases(samples: Samples, kind: str) -> list[Basis]:
    """Return the bases that compete, coarse ones first."""
    low, high = float(samples.v.min()), float(samples.v.max())
    if kind == "pi":
        return [PlayBasis(np.linspace(0.0, (high - low) / 2, PLAY_OPERATORS, endpoint=False))]
    return [SurfaceBasis(np.linspace(low, high, n)) for n in VERTICES]


def _pose(samples: Samples, basis: Basis) -> _Problem:
    walk = Walk.along(samples.v, symmetric_rest=basis.symmetric_rest, primed=samples.primed)
    design = Design.of(walk, basis.branch_part(walk))
    volts, metres = samples.spread
    rough = basis.roughness()
    return _Problem(
        basis=basis,
        design=design,
        y=samples.y / metres,
        weights=samples.fitted.astype(np.float64),
        rough=(rough.T @ rough).toarray(),
        scale=metres,
        gain=metres / volts,
    )
