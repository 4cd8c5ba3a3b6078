"""From a record to a model: every axis by itself, by the fit that its kind of model needs."""

from collections.abc import Callable, Sequence
from datetime import UTC, datetime

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from slpi_ros.errors import IdentificationError, SlpiError, UsageError
from slpi_ros.identification import linear, separated
from slpi_ros.identification.amplitude_scaled import fit_amplitude_scaled
from slpi_ros.identification.fitted import Fitted
from slpi_ros.identification.record import Record
from slpi_ros.identification.samples import Samples, select_samples
from slpi_ros.model import AxisModel, FitQuality, StageModel

FloatArray = NDArray[np.float64]

FITS: dict[str, Callable[[Samples], Fitted]] = {
    "slpi": linear.fit_family,
    "slpi-published": separated.fit_primed,
    "pi": linear.fit_plays,
    "mpi": linear.fit_multi_slope,
    "smpi": fit_amplitude_scaled,
}
KINDS = tuple(FITS)
# A model that leaves more than this share of the displacement's rms unexplained is none.
SENSELESS = 0.5


def identify(
    record: Record,
    kind: str = "slpi",
    *,
    start: float | None = None,
    stop: float | None = None,
    axes: Sequence[str] | None = None,
    loops_at_rest: bool = False,
) -> StageModel:
    """Identify the model of a stage from a record.

    Parameters
    ----------
    record : Record
        Voltage before `start` still moves the memory; only the displacement there is not fitted.
    kind : str
        ``slpi`` (the loop family), ``slpi-published`` (a classical PI model for each separated loop), ``pi`` (classical
        Prandtl-Ishlinskii), ``mpi`` (multi-slope PI) or ``smpi`` (the same, scaled with the amplitude).
    loops_at_rest : bool
        Only for ``slpi-published``: the play operators of every loop start at rest, as in the paper, instead of primed.
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
    if loops_at_rest and kind != "slpi-published":
        raise UsageError(f"loops at rest are a matter of kind 'slpi-published', not of '{kind}'; leave that out")
    fit = separated.fit_at_rest if loops_at_rest else FITS[kind]
    models = {}
    for axis in axes or record.axes:
        samples = select_samples(record, axis, start, stop)
        try:
            # The matrices are small: more threads than one only stand in each other's way.
            with threadpool_limits(1):
                models[axis] = _axis_model(samples, kind, fit(samples), record.source)
        except SlpiError as error:
            raise type(error)(f"{record.source}: axis '{axis}': {error}") from None
    return StageModel(models, record.hardware_id, datetime.now(UTC).isoformat(timespec="seconds"))


def _axis_model(samples: Samples, kind: str, fitted: Fitted, source: str) -> AxisModel:
    _require_sense(samples, fitted)
    y = fitted.samples.y[fitted.samples.fitted]
    return AxisModel(
        kind=kind,
        hysteresis=fitted.hysteresis,
        start=fitted.start,
        voltage_range=fitted.samples.voltage_range,
        displacement_range=(float(y.min()), float(y.max())),
        quality=FitQuality(
            rms=float(np.sqrt(np.mean(fitted.errors**2))),
            maximum=float(np.max(np.abs(fitted.errors))),
            held_out_rms=fitted.held_out_rms,
            floor_rms=_noise(fitted.errors),
            samples=y.size,
            covered=fitted.covered,
            source=source,
        ),
    )


def _require_sense(samples: Samples, fitted: Fitted) -> None:
    """Refuse a model that says nothing."""
    if fitted.covered == 0.0:
        raise IdentificationError("the voltage never turns back; drive it up and down over the range to be used")
    spread = float(np.std(samples.y[samples.fitted]))
    if fitted.held_out_rms > SENSELESS * spread:
        raise IdentificationError(
            f"the voltage does not explain the displacement: error {fitted.held_out_rms * 1e9:.4g} nm rms on blocks "
            f"left out, of {spread * 1e9:.4g} nm rms in all; check that both signals belong to this axis, and their "
            "clocks"
        )


def _noise(errors: FloatArray) -> float:
    """Return the rms of what changes from sample to sample in `errors`, outliers apart."""
    return float(1.4826 * np.median(np.abs(np.diff(errors))) / np.sqrt(2))
