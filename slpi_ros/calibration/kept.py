"""Whether a record that an earlier run of a calibration has kept can be used in this one."""

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from slpi_ros.calibration.settings import CalibrationSettings
from slpi_ros.compensator.amplifier import TOLERATED_SHARE
from slpi_ros.errors import RecordError, SlpiError
from slpi_ros.excitation.drives import Drive
from slpi_ros.io.record import Record
from slpi_ros.io.stage_name import same_stage
from slpi_ros.workflows.records import Source, require_records

# The range of a recorded voltage may differ from that of its drive by this share.
FOLLOWS = 0.2
# Least share of its drive that a record lasts.
LEAST_LENGTH = 0.8
# Largest ratio of the slopes of displacement over voltage of two records.
OTHER_SLOPE = 2.0
# What to do with a record that cannot be used.
REMEDY = "move its bag out of the folder, or rename it, and resume: it is then recorded again"


class OtherLimitsError(RecordError):
    """A kept record is of other voltage limits than those of this calibration."""


def require_kept(
    record: Record, drive: Drive, settings: CalibrationSettings, before: Record | None, *, fitted: bool
) -> None:
    """Check a kept record of `drive` against the first one (`before`), and its quality if a model is `fitted`."""
    with naming(record):
        lasts, whole = float(np.ptp(record.time_ns)) * 1e-9, float(drive.t[-1])
        if lasts < LEAST_LENGTH * whole:
            raise RecordError(f"it lasts {lasts:.3g} s, its drive {whole:.3g} s: incomplete, or of a higher slew_limit")
        for axis in settings.axes:
            record.require_axis(axis)
            _require_limits(record, axis, drive, settings)
        if before and not same_stage(record.hardware_id, before.hardware_id, settings.accept_stage):
            raise RecordError(f"of stage '{record.hardware_id}', {before.source} of '{before.hardware_id}'")
        moving = [axis for axis in settings.axes if np.ptp(drive.voltage[axis]) > 0.0]
        if fitted:
            require_records([record], Source(axes=moving))
        for axis in moving if before else ():
            assert before is not None
            own, other = _slope(record, axis), _slope(before, axis)
            if not other / OTHER_SLOPE < own < other * OTHER_SLOPE:
                raise RecordError(
                    f"axis '{axis}' moves by {own * 1e6:.3g} µm/V, in {before.source} by {other * 1e6:.3g} µm/V: one "
                    "of the two is wrong"
                )


@contextmanager
def naming(record: Record) -> Iterator[None]:
    """Name a kept record in the errors of a ``with`` block, and say what to do."""
    try:
        yield
    except OtherLimitsError as error:
        raise RecordError(f"{record.source}: kept from an earlier run, and {error}") from None
    except SlpiError as error:
        reason = str(error).removeprefix(f"{record.source}: ")
        raise RecordError(f"{record.source}: kept from an earlier run, and no use: {reason}; {REMEDY}") from None


def _require_limits(record: Record, axis: str, drive: Drive, settings: CalibrationSettings) -> None:
    """Raise RecordError unless the voltages of a record are those of the drive, as far as an amplifier repeats them."""
    limits = settings.limits[settings.axes.index(axis)]
    v = record.voltage[axis]
    v = v[np.isfinite(v)]
    if not v.size:
        raise RecordError(f"no voltage of axis '{axis}'")
    low, high, wanted = float(v.min()), float(v.max()), float(np.ptp(drive.voltage[axis]))
    if wanted and low == high:
        raise RecordError(f"the voltage of axis '{axis}' stays at {low:.4g} V")
    span = limits.upper - limits.lower
    slack = TOLERATED_SHARE * span
    within = limits.lower - slack <= low and high <= limits.upper + slack
    if not within or abs(high - low - wanted) > max(FOLLOWS * wanted, slack):
        raise OtherLimitsError(
            f"recorded with other limits: axis '{axis}' goes from {low:.4g} to {high:.4g} V, over {high - low:.4g} V; "
            f"with the limits {limits.lower:g} to {limits.upper:g} V it would go over {wanted:.4g} V; give the "
            "voltage_min, voltage_max and rest_voltage of the earlier run, or another output"
        )


def _slope(record: Record, axis: str) -> float:
    """Return the slope (m/V) of the displacement over the voltage; NaN if there is none."""
    v, y = record.voltage[axis], record.displacement[axis]
    known = np.isfinite(v) & np.isfinite(y)
    v, y = v[known], y[known]
    variance = float(np.var(v)) if v.size > 1 else 0.0
    return float(np.cov(v, y, bias=True)[0, 1]) / variance if variance else float("nan")
