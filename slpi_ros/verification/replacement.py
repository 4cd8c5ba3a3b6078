"""Whether a new model may take the place of the one in use without a person having looked at it."""

from collections.abc import Sequence

import numpy as np

from slpi_ros.errors import SlpiError, length
from slpi_ros.io.record import Record
from slpi_ros.model.axis_model import AxisModel
from slpi_ros.model.stage_model import StageModel
from slpi_ros.verification.verify import verify

# Least share of the voltage range of the model in use, and of its visited pairs of reversal and present voltage, that a
# new model covers.
LEAST_RANGE, LEAST_COVERED = 0.8, 0.5
# A new model rests on far fewer samples if they are fewer than this share of those of the model in use, and than this
# number: a refitted model counts the samples of all its records.
LEAST_SAMPLES, ENOUGH_SAMPLES = 0.1, 1000
# Largest held-out error of a new model, in multiples of the error of the model in use on the same record, and of the
# held-out error of that on its own record.
WORSE, MUCH_WORSE = 2.0, 3.0
# Largest difference of the largest loops, as a share of their height: beyond it the stage is another one.
FOREIGN = 0.1


def doubt_about(model: StageModel, in_use: StageModel, records: Sequence[Record] = ()) -> str:
    """Return the reason not to replace the model in use, "" if there is none: axis, what, value and limit."""
    # The new `model` has all axes of the one `in_use`, which is also judged on `records`, those of the new model.
    for name, old in in_use.axes.items():
        reason = (
            _covers_less(model.axes[name], old)
            or _is_another(model.axes[name], old)
            or _predicts_worse(model.axes[name].quality.held_out_rms, old.quality.held_out_rms, in_use, name, records)
        )
        if reason:
            return f"axis '{name}': {reason}"
    return ""


def _covers_less(new: AxisModel, old: AxisModel) -> str:
    (low, high), span = _shared(new, old), float(np.ptp(old.voltage_range))
    share = max(high - low, 0.0) / span
    if share < LEAST_RANGE:
        return (
            f"the record goes from {new.voltage_range[0]:.4g} to {new.voltage_range[1]:.4g} V, which is {share:.0%} of "
            f"the {old.voltage_range[0]:.4g} to {old.voltage_range[1]:.4g} V of the model in use, less than "
            f"{LEAST_RANGE:.0%}"
        )
    # Pairs of the smaller range, as a share of those of the range of the model in use.
    covered, before = new.quality.covered * share**2, old.quality.covered
    if covered < LEAST_COVERED * before:
        return (
            f"the record visits {covered:.0%} of all pairs of turning point and voltage, that of the model in use "
            f"{before:.0%}; at least {LEAST_COVERED * before:.0%} are needed"
        )
    least = min(LEAST_SAMPLES * old.quality.samples, ENOUGH_SAMPLES)
    if new.quality.samples < least:
        return (
            f"{new.quality.samples} samples, the model in use rests on {old.quality.samples}; at least {least:.0f} "
            "are needed"
        )
    return ""


def _is_another(new: AxisModel, old: AxisModel) -> str:
    rise = np.linspace(*_shared(new, old), 101)
    way = np.concatenate([rise[-1:], rise, rise[::-1]])
    loops = [axis.simulate(np.zeros(way.size), way)[1:] for axis in (new, old)]
    off = float(np.ptp(loops[0] - loops[1]) / np.ptp(loops[1]))
    if off > FOREIGN:
        return f"its largest loop differs by {off:.0%} from that of the model in use, more than {FOREIGN:.0%}"
    return ""


def _predicts_worse(error: float, before: float, in_use: StageModel, name: str, records: Sequence[Record]) -> str:
    """Compare the held-out error (m) of a new model with the model in use, whose own is `before` (m)."""
    said = f"held-out error {length(error)} rms"
    if error > MUCH_WORSE * before:
        limit = MUCH_WORSE * before
        return f"{said}, that of the model in use {before * 1e9:.3g} nm; at most {limit * 1e9:.3g} nm are allowed"
    try:
        found = verify(records, in_use, axes=[name]).axes[name] if records else None
    except SlpiError:
        # What the model in use cannot be compared with is no reason to keep it.
        return ""
    if found:
        of_records = float(np.sqrt(np.mean([one.rest.rms**2 for one in found.records])))
        if error > WORSE * of_records:
            return (
                f"{said}, on the same record the model in use has {of_records * 1e9:.3g} nm; at most "
                f"{WORSE * of_records * 1e9:.3g} nm are allowed"
            )
    return ""


def _shared(new: AxisModel, old: AxisModel) -> tuple[float, float]:
    """Return the voltages (V) that both ranges hold."""
    (low, high), (old_low, old_high) = new.voltage_range, old.voltage_range
    return max(low, old_low), min(high, old_high)
