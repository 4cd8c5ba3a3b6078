"""Text summaries of models and of changes between models."""

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np

from slpi_ros.hysteresis.kinds import DESCRIPTIONS, Hysteresis
from slpi_ros.hysteresis.loop_family import LoopFamily
from slpi_ros.hysteresis.multi_slope import AmplitudeScaled
from slpi_ros.hysteresis.slpi_published import SeparatedLoops
from slpi_ros.model.axis_model import AxisModel, StartMemory
from slpi_ros.model.stage_model import StageModel

if TYPE_CHECKING:
    from slpi_ros.identification.refit import AxisChange


def nm(metres: float) -> str:
    """Return a length as text in nanometres; "none" if it is not finite."""
    return f"{metres * 1e9:.1f} nm" if np.isfinite(metres) else "none"


def describe_model(model: StageModel) -> list[str]:
    """Return a text summary of a model, in µm and nm."""
    head = f"stage '{model.hardware_id}'" if model.hardware_id else "stage of unknown hardware id"
    lines = [f"{head}, identified {model.created or 'at an unknown time'}"]
    for name, axis in model.axes.items():
        lines += [f"axis {name}: {line}" for line in describe_axis(axis)]
    return lines


def describe_axis(axis: AxisModel) -> list[str]:
    """Return a text summary of one axis."""
    quality, start, end = axis.quality, axis.start, axis.end
    (v_low, v_high), (y_low, y_high) = axis.voltage_range, axis.displacement_range
    began = "a memory assumed wiped" if start.history else "rest"
    stroke = y_high - y_low
    return [
        f"{axis.kind} ({DESCRIPTIONS[axis.kind]}), {_parts(axis.hysteresis)}",
        f"identified from {v_low:.4g} to {v_high:.4g} V, {y_low * 1e6:.4g} to {y_high * 1e6:.4g} um "
        f"({quality.covered:.0%} model covered)",
        f"memory at the start of the record: {began}, at {start.voltage:.4g} V, {start.displacement * 1e6:.4g} um",
        f"memory at the end of the record: at {end.voltage:.4g} V, {end.displacement * 1e6:.4g} um, "
        f"with {len(end.history)} reversals"
        if end
        else "memory at the end of the record: unknown",
        f"error on the record: {nm(quality.rms)} rms ({quality.rms / stroke:.3%} of the displacement range), "
        f"{nm(quality.maximum)} at most",
        f"held-out error: {nm(quality.held_out_rms)} rms; sensor noise {nm(quality.floor_rms)} rms",
        f"from {quality.samples} samples of {quality.source}",
        *(f"{effect.name}: {effect.describe()}" for effect in axis.effects),
        *(() if axis.effects else ("effects: none",)),
    ]


def describe_start(model: StageModel, axes: Iterable[str], start_memory: StartMemory) -> str:
    """Return one line with the assumed initial memory, voltage and displacement of some axes."""
    told = []
    for name in axes:
        axis = model.axes[name]
        start = axis.initial(start_memory)
        known = {"end": "end of the record", "start": "start of the record", "wiped": "memory wiped"}[start_memory]
        if start_memory == "end" and axis.end is None:
            known = "start of the record, as the model does not contain the end"
        told.append(f"axis {name} at {start.voltage:.4g} V, {start.displacement * 1e6:.4g} um ({known})")
    return f"assumed before the first sample: {'; '.join(told)}"


def describe_change(axis: str, change: "AxisChange") -> list[str]:
    """Return a text summary, in nm, of the change of one axis found by a refit."""
    found = change.match
    same = max(abs(found.gain_change), found.gain_uncertainty)
    zero = (
        f"the zero has moved by {found.offset * 1e6:+.3g} (+- {found.offset_uncertainty * 1e6:.2g}) um since"
        if found.zero_moved
        else ""
    )
    if change.drifted:
        verdict = f"the stage has changed{f' and {zero}' if zero else ''}"
    elif zero:
        verdict = f"{zero}; the loops are the same within {same:.2%}"
    else:
        verdict = f"no change beyond repeatability; the loops are the same within {same:.2%}"
    if change.match.known_from:
        verdict += "; the initial history of the new record is unknown and was not evaluated"
    return [
        f"axis {axis}: {verdict}: the old model's error on the new record is {nm(change.error_before)} rms, "
        f"repeatability {nm(change.repeatability)}",
        f"axis {axis}: gain {change.gain:+.2%}, branches moved by up to {nm(change.largest)}; "
        f"error on the new record now {nm(change.error_after)} rms",
    ]


def _parts(model: Hysteresis) -> str:
    """Return the number of elements of a model as text."""
    match model:
        case LoopFamily():
            return f"{model.grid.size} loop vertices"
        case SeparatedLoops():
            levels = max(loop.level for loop in model.loops)
            closing = "that close" if any(loop.run_in is not None for loop in model.loops) else "at rest"
            return f"{len(model.loops)} loops {closing}, up to level {levels}"
        case AmplitudeScaled():
            return f"{model.base.weights.size} play operators, peaks at {model.peak_voltages.size} amplitudes"
        case _:
            return f"{model.weights.size} play operators"
