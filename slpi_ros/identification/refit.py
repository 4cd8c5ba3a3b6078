"""Update of a model with a new record: correct the visited region of the model and keep the rest.

The old parameters ``x_old`` are the prior of a convex fit. A stage changes with time mostly in gain, so that
``x = (1 + s) x_old + e``, where ``s`` is a few per cent and ``e`` is small and smooth. The gain ``s`` is fitted only
if the record deviates significantly from the old model, so that a record of small loops that agrees with the old model
does not change the large loops.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime

import numpy as np
from threadpoolctl import threadpool_limits

from slpi_ros.arrays import FloatArray
from slpi_ros.arrays.rates import fastest
from slpi_ros.effects.base import EffectContext
from slpi_ros.effects.chain import forward, lasting
from slpi_ros.errors import IdentificationError, SlpiError, UsageError
from slpi_ros.hysteresis.loop_family import LoopFamily
from slpi_ros.hysteresis.prandtl_ishlinskii import PrandtlIshlinskii
from slpi_ros.identification.bases import Basis, PlayBasis, SurfaceBasis
from slpi_ros.identification.free_run import Match, match
from slpi_ros.identification.held_readings import from_fresh
from slpi_ros.identification.least_squares import FIRST_SMOOTHNESS, Problem, solve_free
from slpi_ros.identification.linear_kinds import FIT_SAMPLES
from slpi_ros.identification.samples import FEWEST, Samples, select_samples
from slpi_ros.identification.signal_statistics import white_noise
from slpi_ros.io.record import Record, common_stage
from slpi_ros.model.axis_model import AxisModel, Start
from slpi_ros.model.stage_model import StageModel

# Standard deviations of the prior, for the gain (relative) and for the smooth deviation of each parameter (share of the
# displacement range): if the stage has changed, and if the old model still agrees with the record.
CHANGED = (0.1, 1e-3)
UNCHANGED = (0.0, 1e-4)
# Weight of the roughness of the deviation from the old shape, relative to the weight of its size.
SMOOTH = 30.0
# The stage has changed if the error of the old model on the new record exceeds this multiple of its held-out error.
BEYOND_REPEATABILITY = 2.0
# A model belongs to another stage if its error exceeds this share of the displacement range, and this multiple of the
# error of a model fitted to the record.
FOREIGN_SHARE, FOREIGN_TIMES = 0.02, 4.0
# A voltage may exceed the range of the model by this share of it: a measured voltage has an error, and an effect may
# overshoot.
EXCESS_SHARE = 0.01


@dataclass(frozen=True)
class AxisChange:
    """Changes of one axis by an update; errors (m, rms) on the new record, free-run, without the constant offset."""

    error_before: float  # of the old model
    error_after: float  # of the new model
    repeatability: float  # held-out error of the old model, or the noise of the sensor if larger
    drifted: bool  # gain, width or shape of the loops has changed: nothing else explains the old model's error
    gain: float  # relative change of the height of the outermost loop
    largest: float  # m, change of a branch
    match: Match  # of the old model with the new record


def refit(
    model: StageModel,
    record: Record,
    *,
    axes: Sequence[str] | None = None,
    start: float | None = None,
    stop: float | None = None,
) -> tuple[StageModel, dict[str, AxisChange]]:
    """Update a model with a new record, keeping the regions that the record does not visit.

    Parameters
    ----------
    model : StageModel
        Model with axes of kind ``slpi`` or ``pi``. Its effects are kept, and removed from the record before the fit;
        those that belong to its own record are neither. What it knows of the sensor is taken out of the readings first.
    record : Record
        Record within the voltage range of the model. Axes that are not in the record are kept unchanged.
    axes : sequence of str, optional
        Axes to be updated; default: all that the model and the record share.
    start, stop : float, seconds, optional
        Part of the record to be used, from its first stamp; default: all of it.

    Returns
    -------
    StageModel
        Updated model, with the initial and final hysteresis state of the record.
    dict of axis name to AxisChange
        Changes of each updated axis.

    Raises
    ------
    UsageError
        If the record is of another stage, or the model's kind cannot be updated.
    RecordError, IdentificationError
        If the record does not allow an update.
    """
    common_stage([record], model.hardware_id)
    for axis in axes or ():
        model.axis(axis)
        record.require_axis(axis)
    shared = [axis for axis in model.axes if axis in (axes or record.axes)]
    if not shared:
        raise UsageError(f"{record.source} holds none of the model's axes {', '.join(model.axes)}")
    surrounded = model.stage_only.surrounded(record)
    applied, record = record, _bare(record, model, surrounded, shared)
    updated, changes = dict(model.axes), {}
    for name in shared:
        where = f"{record.source}: axis '{name}': "
        try:
            samples = select_samples(record, name, start, stop)
            with threadpool_limits(1):
                old = model.axes[name]
                new, changes[name] = _refit_axis(old.hysteresis_only, samples, record.source)
            t = record.t[np.isfinite(record.voltage[name])][: samples.v.size]
            rate = max(old.quality.fastest or 0.0, fastest(t[samples.fitted], samples.v[samples.fitted]))
            quality = replace(new.quality, fastest=rate)
            new = replace(new, effects=lasting(old.effects), sensor=old.sensor, quality=quality)
            if new.end:
                v = applied.voltage[name]
                last = float(v[np.isfinite(v)][samples.v.size - 1])
                new = replace(new, end=new.at_rest(np.empty(0), last, "end"))
            updated[name] = new
        except SlpiError as error:
            raise type(error)(where + str(error).removeprefix(where)) from None
    return replace(model, axes=updated, created=datetime.now(UTC).isoformat(timespec="seconds")), changes


def _bare(record: Record, model: StageModel, surrounded: StageModel, shared: Sequence[str]) -> Record:
    """Return the record without what the model knows of its sensors, and of effects in its surroundings."""
    changed = [axis for axis in shared if model.axes[axis].effects or model.axes[axis].corrects]
    return from_fresh(record, changed, lambda read: _without_effects(surrounded, model.correct(read), shared))


def _without_effects(model: StageModel, record: Record, shared: Sequence[str]) -> Record:
    """Return the record with the contribution of the model's effects of the stage removed."""
    if not any(model.axes[axis].effects for axis in shared):
        return record
    t, voltage, displacement = record.t, dict(record.voltage), dict(record.displacement)
    # Axes that are not updated couple into those that are.
    moving = [axis for axis in model.axes if axis in record.axes and np.isfinite(record.voltage[axis]).any()]
    known = {axis: _held(record.voltage[axis]) for axis in dict.fromkeys((*shared, *moving))}
    simulated = model.simulate(t, known)
    for axis in shared:
        own = model.axes[axis]
        u = forward(own.chain.before, known[axis], EffectContext(t))
        displacement[axis] = record.displacement[axis] - (simulated[axis] - own.hysteresis_only.simulate(t, u))
        voltage[axis] = np.where(np.isfinite(record.voltage[axis]), u, np.nan)
    return replace(record, voltage=voltage, displacement=displacement)


def _held(v: FloatArray) -> FloatArray:
    """Return a voltage, shape (N,), volts, with NaN replaced by the last finite value."""
    known = np.flatnonzero(np.isfinite(v))
    if not known.size:
        raise IdentificationError("the voltage is never known; record it")
    last = np.searchsorted(known, np.arange(v.size), side="right") - 1
    return v[known[np.maximum(last, 0)]]


def _refit_axis(old: AxisModel, samples: Samples, source: str) -> tuple[AxisModel, AxisChange]:
    basis, x_old = basis_of(old)
    if isinstance(basis, SurfaceBasis):
        samples = _within(samples, float(basis.grid[0]), float(basis.grid[-1]))
    recorded, samples = samples.v, samples.thinned(FIT_SAMPLES)
    found = match(old, samples)
    # Fit only samples independent of the initial state, unless these are too few.
    settled = samples.only(found.known & (np.arange(samples.v.size) >= found.known_from))
    samples = settled if np.count_nonzero(settled.fitted) >= FEWEST else samples.only(found.known)
    history = found.start.history
    samples = samples.after(history)
    problem = Problem.pose([samples], basis).reweighted()
    repeatability = max(old.quality.held_out_rms, white_noise(found.residual[np.isfinite(found.residual)]))
    own = problem.residual()[problem.weights > 0] * problem.scale
    require_own(found.rms, _rms(own), max(samples.spread[1], float(np.ptp(old.displacement_range))))
    otherwise = found.rms_explained > BEYOND_REPEATABILITY * repeatability
    drifted = found.gain_changed or found.width_changed or otherwise
    x = _solved(problem, x_old / problem.scale, *(CHANGED if drifted else UNCHANGED))
    errors = problem.errors(x)
    x_new = x[: basis.size + 1] * problem.scale
    largest = int(np.argmax(np.abs(x_old)))
    change = AxisChange(
        error_before=found.rms,
        error_after=_rms(errors),
        repeatability=repeatability,
        drifted=drifted,
        gain=float(x_new[largest] / x_old[largest] - 1.0),
        largest=float(np.max(np.abs(x_new[:-1] - x_old))),
        match=found,
    )
    at_start = float(problem.design.predict(x)[len(history)] * problem.scale)
    start = Start(float(samples.v[len(history)]), at_start, history)
    hysteresis = basis.shape(x_new, problem.gain)
    end = replace(old, hysteresis=hysteresis, start=start).after(recorded)
    if _same_start(start, old.start, repeatability):
        # A change of zero within the repeatability is not significant.
        start = old.start
    y = samples.y[samples.fitted]
    new = replace(
        old,
        hysteresis=hysteresis,
        start=start,
        end=end,
        displacement_range=(
            min(old.displacement_range[0], float(y.min())),
            max(old.displacement_range[1], float(y.max())),
        ),
        quality=replace(
            old.quality,
            rms=_rms(errors),
            maximum=float(np.max(np.abs(errors))),
            floor_rms=white_noise(errors),
            samples=old.quality.samples + y.size,
            source=f"{old.quality.source}, {source}",
        ),
    )
    return new, change


def _within(samples: Samples, low: float, high: float) -> Samples:
    """Return the samples with a voltage held within the range of the model; IdentificationError if far beyond it."""
    excess = max(low - samples.v.min(), samples.v.max() - high)
    if excess > EXCESS_SHARE * (high - low):
        raise IdentificationError(
            f"the record goes from {samples.v.min():g} to {samples.v.max():g} V, the model from {low:g} to {high:g} V; "
            "identify the stage anew"
        )
    return replace(samples, v=np.clip(samples.v, low, high)) if excess > 0.0 else samples


def require_own(error: float, fitted_anew: float, span: float) -> None:
    """Raise IdentificationError if the rms errors (m) of a model and of a refit show that it is of another stage."""
    if error > FOREIGN_SHARE * span and error > FOREIGN_TIMES * fitted_anew:
        raise IdentificationError(
            f"this model does not belong to this bag: its error is {error * 1e6:.4g} µm rms of {span * 1e6:.4g} µm, "
            f"that of one fitted to it {fitted_anew * 1e6:.4g} µm; give this stage's model, or identify anew"
        )


def _same_start(new: Start, old: Start, repeatability: float) -> bool:
    close = abs(new.displacement - old.displacement) <= repeatability
    return close and (new.voltage, new.history) == (old.voltage, old.history)


def basis_of(axis: AxisModel) -> tuple[Basis, FloatArray]:
    """Return the basis of a model, and its parameters without the displacement at rest, metres."""
    shape = axis.hysteresis
    if isinstance(shape, PrandtlIshlinskii):
        return PlayBasis(shape.thresholds), shape.weights
    if isinstance(shape, LoopFamily):
        if not np.allclose(np.diff(shape.grid), np.diff(shape.grid).mean(), rtol=1e-6):
            raise UsageError("the model's vertices are not evenly spaced; identify the stage anew")
        return SurfaceBasis(shape.grid), np.concatenate(
            [shape.everett[np.tril_indices(shape.grid.size, -1)], shape.rise]
        )
    raise UsageError(f"kind '{axis.kind}' cannot be updated; identify the stage anew")


def _solved(problem: Problem, x_old: FloatArray, gain_spread: float = 0.0, shape_spread: float = 0.0) -> FloatArray:
    """Return parameters and displacement at rest of a fit with prior `x_old`, in units of the problem's scale."""
    # If `shape_spread` is zero, `x_old` is kept and only the displacement at rest is fitted.
    matrix, vector = problem.equations
    size = x_old.size
    if not shape_spread:
        at_rest = (vector[size:] - matrix[size:, :size] @ x_old) / np.diag(matrix)[size:]
        return np.concatenate([x_old, at_rest])
    free = solve_free(matrix + problem.penalty(FIRST_SMOOTHNESS, problem.count), vector)
    noise = white_noise(problem.design.predict(free)[problem.weights > 0] - problem.y[problem.weights > 0])
    prior = np.zeros_like(matrix)
    prior[:size, :size] = _precision(problem.rough[:size, :size].toarray(), x_old, gain_spread, shape_spread)
    old = np.append(x_old, np.zeros(matrix.shape[0] - size))
    return problem.program(matrix + noise**2 * prior).solve(vector + noise**2 * (prior @ old)).x


def _precision(rough: FloatArray, x_old: FloatArray, gain_spread: float, shape_spread: float) -> FloatArray:
    """Return the inverse covariance of the prior: smooth deviations plus a common gain factor (Woodbury identity)."""
    shape = (np.eye(x_old.size) + SMOOTH * rough) / shape_spread**2
    if not gain_spread:
        return shape
    along = shape @ x_old
    return shape - np.outer(along, along) / (1.0 / gain_spread**2 + x_old @ along)


def _rms(errors: FloatArray) -> float:
    return float(np.sqrt(np.mean(errors**2)))
