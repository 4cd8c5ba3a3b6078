"""Text summaries of models and of changes between models, and verdicts on their accuracy."""

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

import numpy as np

from slpi_ros.compensator.plausible import LONGEST, implausible_stroke
from slpi_ros.errors import length
from slpi_ros.hysteresis.kinds import DESCRIPTIONS, Hysteresis
from slpi_ros.hysteresis.loop_family import LoopFamily
from slpi_ros.hysteresis.multi_slope import AmplitudeScaled
from slpi_ros.hysteresis.slpi_published import SeparatedLoops
from slpi_ros.identification.free_run import largest_loop
from slpi_ros.model.axis_model import ABOVE_NOISE, RESOLUTION, AxisModel, StartMemory
from slpi_ros.model.coverage import fastest_displacement
from slpi_ros.model.stage_model import StageModel

if TYPE_CHECKING:
    from slpi_ros.identification.refit import AxisChange

# Noise of a sensor, rms, as a share of the displacement range, beyond which it limits what a model can promise.
NOISY = 0.005
# What is said of a voltage that the displacement follows on one curve.
NO_DRIVE = (
    "the voltage: the displacement follows it without hysteresis, as a monitor of the sensor or the reference of a "
    "servo does; the voltage must be that of the drive"
)
AT_NOISE = "at the sensor noise"
UNKNOWN = "of unknown cause"


def verdict(limits: Mapping[str, str], good: str = AT_NOISE) -> str:
    """Return the verdict on all axes in one line: what limits the accuracy of each axis of `limits`, else `good`."""
    if limits:
        return f"ERROR SOURCES: {'; '.join(f'axis {axis}: {limit}' for axis, limit in limits.items())}"
    return f"GOOD: {good}"


def above_noise(rms: float, noise: float, stroke: float) -> str:
    """Return by how much an error (m rms) exceeds the noise (m rms) as text; "" if it does not."""
    # An error below `RESOLUTION` of the `stroke` (m) counts as noise, as no model of hysteresis does better.
    if rms <= max(ABOVE_NOISE * noise, RESOLUTION * stroke):
        return ""
    times = f"{rms / noise:.1f} times the sensor noise" if noise > 0.0 else "without any noise"
    return f"an error of {length(rms)} rms, {times}"


def how_good(errors: Iterable[tuple[float, float, float]]) -> str:
    """Return how small errors (m rms), each with the noise (m rms) and the stroke (m), are that nothing limits."""
    above = max((rms / stroke for rms, noise, stroke in errors if rms > ABOVE_NOISE * noise), default=0.0)
    return f"an error of {above:.3%} of the range, below what a model of hysteresis resolves" if above else AT_NOISE


def error_of(axis: AxisModel) -> tuple[float, float, float]:
    """Return the error (m rms) of a model where it was not fitted, if known, the noise (m rms), and the stroke (m)."""
    quality, (low, high) = axis.quality, axis.displacement_range
    error = quality.held_out_rms if np.isfinite(quality.held_out_rms) else quality.rms
    return error, quality.floor_rms, high - low


def model_good(model: StageModel) -> str:
    """Return how good a model is that nothing limits."""
    return how_good(map(error_of, model.axes.values()))


def model_limits(model: StageModel) -> dict[str, str]:
    """Return what limits the accuracy of each axis of a model; axes at the sensor noise are left out."""
    limits = {}
    for name, axis in model.axes.items():
        quality, (low, high) = axis.quality, axis.displacement_range
        if high - low > LONGEST:
            limits[name] = f"the unit: {implausible_stroke(high - low)}, which no piezo stage has"
        elif limit := above_noise(*error_of(axis)):
            limits[name] = f"{limit}, {UNKNOWN}"
        elif is_without_hysteresis(axis):
            limits[name] = NO_DRIVE
        elif (share := quality.floor_rms / (high - low)) > NOISY:
            limits[name] = f"the sensor, whose noise of {length(quality.floor_rms)} rms is {share:.1%} of the range"
    return limits


def unexplained(limit: str) -> bool:
    """Return whether a diagnosis may explain what limits an axis; else its record is to be mended."""
    return limit.endswith(UNKNOWN)


def is_without_hysteresis(axis: AxisModel) -> bool:
    """Return whether the largest loop of a model is one curve but for noise, or for what no model resolves."""
    if not axis.causal:
        return False
    _, rising, falling = largest_loop(axis, *axis.hysteresis_range)
    low, high = axis.displacement_range
    half = float(np.sqrt(np.mean((rising - falling) ** 2))) / 2.0
    return half <= max(ABOVE_NOISE * axis.quality.floor_rms, RESOLUTION * (high - low))


def change_limits(changes: Mapping[str, "AxisChange"], model: StageModel) -> dict[str, str]:
    """Return what limits the accuracy of each axis after a refit to a record; axes at their repeatability left out."""
    limits = {}
    for name, change in changes.items():
        low, high = model.axes[name].displacement_range
        if limit := above_noise(change.error_after, change.repeatability, high - low):
            limits[name] = limit.replace("the sensor noise", "the repeatability") + ", that the refit leaves"
    return limits


def describe_model(model: StageModel, *, details: bool = True) -> list[str]:
    """Return a text summary of a model, in µm and nm; without `details` the most important lines only."""
    head = f"stage '{model.hardware_id}'" if model.hardware_id else "stage of unknown hardware id"
    lines = [f"{head}, identified {model.created or 'at an unknown time'}"]
    for name, axis in model.axes.items():
        lines += [f"axis {name}: {line}" for line in describe_axis(axis, details=details)]
    return lines


def describe_axis(axis: AxisModel, *, details: bool = True) -> list[str]:
    """Return a text summary of one axis; without `details` the most important lines only."""
    quality, start, end = axis.quality, axis.start, axis.end
    (v_low, v_high), (y_low, y_high) = axis.voltage_range, axis.displacement_range
    began = "a memory assumed as after a reset" if start.history else "rest"
    stroke = y_high - y_low
    more = [
        f"memory at the start of the record: {began}, at {start.voltage:.4g} V, {start.displacement * 1e6:.4g} µm",
        f"memory at the end of the record: at {end.voltage:.4g} V, {end.displacement * 1e6:.4g} µm, "
        f"with {len(end.history)} reversals"
        if end
        else "memory at the end of the record: unknown",
        f"error on the record: {length(quality.rms)} rms ({quality.rms / stroke:.3%} of the displacement range), "
        f"{length(quality.maximum)} at most",
        f"from {quality.samples} samples of {quality.source}",
    ]
    return [
        f"{axis.kind} ({DESCRIPTIONS[axis.kind]}), {_parts(axis.hysteresis)}",
        f"identified from {v_low:.4g} to {v_high:.4g} V, {y_low * 1e6:.4g} to {y_high * 1e6:.4g} µm{_rate(axis)} "
        f"({quality.covered:.0%} model covered)",
        f"held-out error: {length(quality.held_out_rms)} rms; sensor noise {length(quality.floor_rms)} rms",
        *(more if details else ()),
        *(f"{effect.name}: {effect.describe()}" for effect in axis.effects),
        *(() if axis.effects else ("effects: none",)),
        *((f"sensor: {axis.sensor.describe()}, known and taken out of its readings",) if axis.sensor else ()),
    ]


def _rate(axis: AxisModel) -> str:
    rate = fastest_displacement(axis)
    return "" if rate is None else f", at up to {axis.quality.fastest:.3g} V/s or {rate * 1e6:.3g} µm/s"


def describe_start(model: StageModel, axes: Iterable[str], start_memory: StartMemory) -> str:
    """Return one line with the assumed initial memory, voltage and displacement of some axes."""
    told = []
    for name in axes:
        axis = model.axes[name]
        start = axis.initial(start_memory)
        known = {"end": "end of the record", "start": "start of the record", "wiped": "after a reset"}[start_memory]
        if start_memory == "end" and axis.end is None:
            known = "start of the record, as the model does not contain the end"
        told.append(f"axis {name} at {start.voltage:.4g} V, {start.displacement * 1e6:.4g} µm ({known})")
    return f"assumed before the first sample: {'; '.join(told)}"


def describe_change(axis: str, change: "AxisChange") -> list[str]:
    """Return a text summary, in nm, of the change of one axis found by a refit."""
    found = change.match
    same = max(abs(found.gain_change), found.gain_uncertainty)
    zero = (
        f"the zero has moved by {found.offset * 1e6:+.3g} (+- {found.offset_uncertainty * 1e6:.2g}) µm since"
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
        verdict += "; the initial state of the new record is unknown and was not evaluated"
    return [
        f"axis {axis}: {verdict}: the old model's error on the new record is {length(change.error_before)} rms, "
        f"repeatability {length(change.repeatability)}",
        f"axis {axis}: gain {change.gain:+.2%}, branches moved by up to {length(change.largest)}; "
        f"error on the new record now {length(change.error_after)} rms",
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
