"""Identification of a stage model from records: each axis separately, by the fit of the requested kind."""

import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
from threadpoolctl import threadpool_limits

from slpi_ros.arrays import FloatArray
from slpi_ros.arrays.rates import fastest
from slpi_ros.errors import IdentificationError, SlpiError, UsageError, length
from slpi_ros.identification.error_statistics import with_statistics
from slpi_ros.identification.held_readings import corrected_fresh
from slpi_ros.identification.least_squares import Fitted
from slpi_ros.identification.linear_kinds import FIT_SAMPLES, fit_family, fit_multi_slope, fit_plays
from slpi_ros.identification.progress import report_progress
from slpi_ros.identification.published_kinds import fit_amplitude_scaled, fit_at_rest, fit_primed
from slpi_ros.identification.samples import NEVER_TURNS, Samples, select_thinned
from slpi_ros.identification.signal_statistics import white_noise
from slpi_ros.io.record import Record, common_stage, release
from slpi_ros.model.axis_model import AxisModel, FitQuality, Start
from slpi_ros.model.sensor import Sensor
from slpi_ros.model.stage_model import StageModel

FITS: dict[str, Callable[[Sequence[Samples]], Fitted]] = {
    "slpi": fit_family,
    "slpi-published": fit_primed,
    "pi": fit_plays,
    "mpi": fit_multi_slope,
    "smpi": fit_amplitude_scaled,
}
KINDS = tuple(FITS)
# Largest held-out rms error of an acceptable model, as a share of the standard deviation of the displacement.
SENSELESS = 0.5


def identify(
    record: Record | Sequence[Record],
    kind: str = "slpi",
    *,
    start: float | None = None,
    stop: float | None = None,
    axes: Sequence[str] | None = None,
    loops_at_rest: bool = False,
    sensor_delay: float = 0.0,
    sensor_lag: float = 0.0,
) -> StageModel:
    """Identify the model of a stage from one record, or from several in one fit.

    Parameters
    ----------
    record : Record or sequence of Record
        Voltage before `start` updates the hysteresis state, but displacement before `start` is not fitted. Several
        records share the hysteresis; each has its own initial state and displacement at rest. The model stores the
        initial state of the first record given and the final state of the latest record. Kinds ``slpi``, ``pi`` and
        ``mpi`` accept several records.
    kind : str
        ``slpi`` (the loop family), ``slpi-published`` (a classical PI model for each separated loop), ``pi`` (classical
        Prandtl-Ishlinskii), ``mpi`` (multi-slope PI) or ``smpi`` (multi-slope PI scaled with the amplitude).
    loops_at_rest : bool
        For ``slpi-published`` only: the play operators of every loop start at rest, as in the paper, instead of in
        their state after a reversal. Default False.
    start, stop : float, seconds, optional
        Fit only samples with ``start <= t < stop``, where t counts from the first stamp; by default all samples.
    axes : sequence of str, optional
        Axes to identify; by default all axes of the first record.
    sensor_delay, sensor_lag : float, seconds
        Known delay and time constant of the sensors, taken out of the readings; the model keeps them. Default 0.

    Returns
    -------
    StageModel
        Identified model of every axis.

    Raises
    ------
    UsageError
        If the kind or an axis is unknown, or the timing of the sensors is not possible.
    RecordError, IdentificationError
        If the record does not allow a fit; the message names the cause.
    """
    fit, sensor = fit_of(kind, loops_at_rest=loops_at_rest), Sensor(sensor_delay, sensor_lag)
    records = [record] if isinstance(record, Record) else list(record)
    if sensor:
        records = [corrected_fresh(part, dict.fromkeys(axes or part.axes, sensor.undo)) for part in records]
    hardware_id = common_stage(records)
    source = ", ".join(part.source for part in records)
    last = max(range(len(records)), key=lambda number: int(records[number].time_ns.max(initial=0)))
    models = {}
    for axis in axes or records[0].axes:
        report_progress(f"axis {axis}: identification")
        selected = [select_thinned(part, axis, start, stop, FIT_SAMPLES) for part in records]
        samples = [part for part, _ in selected]
        rates, times = [], []
        for part, (one, at) in zip(records, selected, strict=True):
            stamps = part.time_ns[at]
            times.append((stamps - stamps[0]) * 1e-9)
            if np.median(np.diff(stamps)) > 0.0:
                # Else nothing can be said of time.
                rates.append(fastest(times[-1][one.fitted], one.v[one.fitted]))
            release(part.time_ns)
        try:
            # The matrices are small: one thread is fastest.
            with threadpool_limits(1):
                with warnings.catch_warnings(record=True) as raised:
                    warnings.simplefilter("always")
                    fitted = fit(samples)
                model = _axis_model(kind, fitted, source)
                # Whether the fit predicts what was left out is asked of the last one only.
                good = _without_bad_readings(samples, model, fitted.starts) if model.causal else samples
                if all(after is before for after, before in zip(good, samples, strict=True)):
                    for warning in raised:
                        warnings.warn_explicit(warning.message, warning.category, warning.filename, warning.lineno)
                else:
                    # What the first fit warned of may be due to the outliers; the second one warns for itself.
                    samples, again = good, fitted.again
                    # The first one holds the memory of its problem.
                    del fitted
                    fitted = again(samples)
                    model = _axis_model(kind, fitted, source)
                _require_sense(fitted)
                model = replace(model, quality=replace(model.quality, held_out_rms=fitted.held_out_rms))
                if model.causal:
                    # The final state includes the voltage after `stop`.
                    whole = samples[last]
                    if stop is not None:
                        whole, _ = select_thinned(records[last], axis, None, None, FIT_SAMPLES)
                    model = replace(model, end=replace(model, start=fitted.starts[last]).after(whole.v))
                quality = _with_statistics(model, fitted.starts, times, samples)
                models[axis] = replace(model, sensor=sensor, quality=replace(quality, fastest=max(rates, default=None)))
        except SlpiError as error:
            raise type(error)(f"{source}: axis '{axis}': {error}") from None
    return StageModel(models, hardware_id, datetime.now(UTC).isoformat(timespec="seconds"))


def _without_bad_readings(samples: Sequence[Samples], model: AxisModel, starts: Sequence[Start]) -> list[Samples]:
    """Return the samples of each record without the mixed readings and outliers found with a first model."""
    good = []
    for part, start in zip(samples, starts, strict=True):
        path = replace(model, start=start).memory("start").forward_array(part.v)
        good.append(part.without_mixed(path).without_outliers(path))
    return good


def _with_statistics(
    model: AxisModel, starts: Sequence[Start], times: Sequence[FloatArray], samples: Sequence[Samples]
) -> FitQuality:
    """Return the quality with what the uncertainty needs, from the free run on each record at its `times` (s)."""
    parts = []
    for part, t, start in zip(samples, times, starts, strict=True):
        error = part.y - replace(model, start=start).hysteresis_only.simulate(t, part.v)
        parts.append((t[part.fitted], part.y[part.fitted], error[part.fitted]))
    return with_statistics(model.quality, parts, model.displacement_range)


def fit_of(kind: str, *, loops_at_rest: bool) -> Callable[[Sequence[Samples]], Fitted]:
    """Return the fit function of a kind; UsageError if the kind is unknown."""
    if kind not in KINDS:
        raise UsageError(f"unknown kind '{kind}'; this version identifies {', '.join(KINDS)}")
    if loops_at_rest and kind != "slpi-published":
        raise UsageError(f"loops at rest are an option of kind 'slpi-published', not of '{kind}'; omit the option")
    return fit_at_rest if loops_at_rest else FITS[kind]


def _axis_model(kind: str, fitted: Fitted, source: str) -> AxisModel:
    """Return the model of a fit, without its held-out error; IdentificationError if the record determines none."""
    if fitted.covered == 0.0:
        raise IdentificationError(NEVER_TURNS)
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
            held_out_rms=np.nan,
            floor_rms=white_noise(fitted.errors),
            samples=y.size,
            covered=fitted.covered,
            source=source,
        ),
    )


def _require_sense(fitted: Fitted) -> None:
    """Raise IdentificationError if voltage does not explain displacement."""
    spread = float(np.std(fitted.y))
    if not fitted.held_out_rms <= SENSELESS * spread:
        low, high = fitted.voltage_range
        switched = (
            ", or drive within one sign of the voltage, where it switches a ferroelectric" if low < 0.0 < high else ""
        )
        raise IdentificationError(
            f"the voltage does not explain the displacement: held-out error {length(fitted.held_out_rms)} rms, "
            f"displacement {length(spread)} rms; check that both signals belong to this axis and have one clock"
            f"{switched}"
        )
