"""From a record to a model: every axis by itself, by the fit that its kind of model needs."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from slpi_ros.errors import IdentificationError, SlpiError, UsageError
from slpi_ros.identification.least_squares import Fitted, noise_rms
from slpi_ros.identification.linear_kinds import fit_family, fit_multi_slope, fit_plays
from slpi_ros.identification.progress import report_progress
from slpi_ros.identification.published_kinds import fit_amplitude_scaled, fit_at_rest, fit_primed
from slpi_ros.identification.samples import NEVER_TURNS, Samples, select_samples
from slpi_ros.io.record import Record
from slpi_ros.model.axis_model import AxisModel, FitQuality
from slpi_ros.model.stage_model import StageModel

FloatArray = NDArray[np.float64]

FITS: dict[str, Callable[[Sequence[Samples]], Fitted]] = {
    "slpi": fit_family,
    "slpi-published": fit_primed,
    "pi": fit_plays,
    "mpi": fit_multi_slope,
    "smpi": fit_amplitude_scaled,
}
KINDS = tuple(FITS)
# A model that leaves more than this share of the displacement's rms unexplained is none.
SENSELESS = 0.5


def identify(
    record: Record | Sequence[Record],
    kind: str = "slpi",
    *,
    start: float | None = None,
    stop: float | None = None,
    axes: Sequence[str] | None = None,
    loops_at_rest: bool = False,
) -> StageModel:
    """Identify the model of a stage from a record, or from several in one fit.

    Parameters
    ----------
    record : Record or sequence of Record
        Voltage before `start` still moves the memory; only the displacement there is not fitted. Several records share
        the hysteresis, but each has its own memory at the start and its own displacement at rest; the model starts as
        the first one given does, and ends as the last one by its stamps. Kinds ``slpi``, ``pi`` and ``mpi``
        can be fitted to several.
    kind : str
        ``slpi`` (the loop family), ``slpi-published`` (a classical PI model for each separated loop), ``pi`` (classical
        Prandtl-Ishlinskii), ``mpi`` (multi-slope PI) or ``smpi`` (the same, scaled with the amplitude).
    loops_at_rest : bool
        Only for ``slpi-published``: the play operators of every loop start at rest, as in the paper, instead of primed.
    start, stop : float, seconds, optional
        Fit only samples with ``start <= t < stop``, t from the record's first stamp.
    axes : sequence of str, optional
        All axes of the first record by default.

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
    fit = fit_of(kind, loops_at_rest=loops_at_rest)
    records = [record] if isinstance(record, Record) else list(record)
    hardware_id = _one_stage(records)
    source = ", ".join(part.source for part in records)
    last = max(range(len(records)), key=lambda number: int(records[number].time_ns.max(initial=0)))
    models = {}
    for axis in axes or records[0].axes:
        report_progress(f"axis {axis}: identification")
        samples = [select_samples(part, axis, start, stop) for part in records]
        try:
            # The matrices are small: more threads than one only stand in each other's way.
            with threadpool_limits(1):
                fitted = fit(samples)
                model = _axis_model(kind, fitted, source)
                if model.causal:
                    # The stage went on after `stop`.
                    whole = samples[last] if stop is None else select_samples(records[last], axis, None, None)
                    model = replace(model, end=replace(model, start=fitted.starts[last]).after(whole.v))
                models[axis] = model
        except SlpiError as error:
            raise type(error)(f"{source}: axis '{axis}': {error}") from None
    return StageModel(models, hardware_id, datetime.now(UTC).isoformat(timespec="seconds"))


def fit_of(kind: str, *, loops_at_rest: bool) -> Callable[[Sequence[Samples]], Fitted]:
    """Return the fit of a kind; UsageError if there is none."""
    if kind not in KINDS:
        raise UsageError(f"unknown kind '{kind}'; this version identifies {', '.join(KINDS)}")
    if loops_at_rest and kind != "slpi-published":
        raise UsageError(f"loops at rest are a matter of kind 'slpi-published', not of '{kind}'; leave that out")
    return fit_at_rest if loops_at_rest else FITS[kind]


def _one_stage(records: Sequence[Record]) -> str:
    """Return the hardware id of records; UsageError where there are none, or of several stages."""
    if not records:
        raise UsageError("no record given; give at least one")
    named = {record.hardware_id: record.source for record in records if record.hardware_id}
    if len(named) > 1:
        stages = ", ".join(f"'{stage}' ({source})" for stage, source in named.items())
        raise UsageError(f"records of several stages: {stages}; identify each stage by itself")
    return next(iter(named), "")


def _axis_model(kind: str, fitted: Fitted, source: str) -> AxisModel:
    _require_sense(fitted)
    y = fitted.y
    return AxisModel(
        kind=kind,
        hysteresis=fitted.hysteresis,
        start=fitted.starts[0],
        voltage_range=fitted.voltage_range,
        displacement_range=(float(y.min()), float(y.max())),
        quality=FitQuality(
            rms=float(np.sqrt(np.mean(fitted.errors**2))),
            maximum=float(np.max(np.abs(fitted.errors))),
            held_out_rms=fitted.held_out_rms,
            floor_rms=noise_rms(fitted.errors),
            samples=y.size,
            covered=fitted.covered,
            source=source,
        ),
    )


def _require_sense(fitted: Fitted) -> None:
    """Refuse a model that says nothing."""
    if fitted.covered == 0.0:
        raise IdentificationError(NEVER_TURNS)
    spread = float(np.std(fitted.y))
    if not fitted.held_out_rms <= SENSELESS * spread:
        raise IdentificationError(
            f"the voltage does not explain the displacement: error {fitted.held_out_rms * 1e9:.4g} nm rms on blocks "
            f"left out, of {spread * 1e9:.4g} nm rms in all; check that both signals belong to this axis, and their "
            "clocks"
        )
