"""A model takes over: its memory is rebuilt from what the axis went through, and the voltage stays."""

from collections.abc import Sequence
from dataclasses import replace
from math import inf

from slpi_ros.errors import ModelError, UsageError
from slpi_ros.hysteresis.turning_points import FAR, Memory
from slpi_ros.model.axis_model import AxisModel, StartMemory
from slpi_ros.model.limits import Limits
from slpi_ros.model.streaming import TOLERATED_SHARE, StreamingInverse


def take_over(
    axis: AxisModel, limits: Limits, reversal_voltages: Sequence[float] = (), start_memory: StartMemory = "end"
) -> StreamingInverse:
    """Return a stream of a new model.

    Parameters
    ----------
    axis : AxisModel
    limits : Limits
        Of the node; the stream keeps to what is within them and the identified voltages.
    reversal_voltages : sequence of float, volts
        Where the drive turned, oldest first, and last its present voltage. The new memory goes through them from the
        model's start. Empty: they are not known, and the memory is the one that `start_memory` names.
    start_memory : str
        See `AxisModel.initial`.

    Raises
    ------
    SlpiError
        If the model is none that can follow sample by sample, has no voltage within the limits, has been identified
        far from the present voltage, or its displacements contradict its curves.
    """
    if not axis.causal:
        raise UsageError(
            f"kind '{axis.kind}' needs whole paths from its start on, and the compensator follows commands and "
            "trajectories from anywhere; identify kind 'slpi', or use 'slpi compensate'"
        )
    allowed = limits.within(axis.voltage_range)
    try_out(axis, allowed)
    if not reversal_voltages:
        return axis.stream_from(axis.memory(start_memory), allowed)
    present = reversal_voltages[-1]
    require_near(present, allowed)
    memory = axis.memory("start")
    replay(memory, reversal_voltages)
    # No jump: a voltage just outside goes inside with the next samples, as fast as it may.
    stream = axis.stream_from(memory, including(allowed, present))
    stream.limits = allowed
    return stream


def go_on(axis: AxisModel, allowed: Limits, before: StreamingInverse) -> StreamingInverse:
    """Return a stream of a new model where another one has been; its limits are wide enough for its voltage."""
    memory = axis.memory("start")
    replay(memory, turning_voltages(before.memory))
    stream = axis.stream_from(memory, including(including(allowed, before.voltage), memory.voltage))
    stream.resume(before)
    return stream


def turning_voltages(memory: Memory) -> tuple[float, ...]:
    """Return the voltages (V) at which the drive turned, oldest first, and last the present one."""
    state = memory.snapshot()
    # A primed memory remembers a fall from farther than any stage has been.
    return (*(v for v in state.turn_voltages if abs(v) < FAR / 2), state.voltage)


def whole_way(stream: StreamingInverse) -> tuple[float, ...]:
    """Return the voltages (V) at which the drive turned, oldest first, and last the command that it lags behind."""
    turns = turning_voltages(stream.memory)
    return turns if turns[-1] == stream.voltage else (*turns, stream.voltage)


def replay(memory: Memory, voltages: Sequence[float]) -> None:
    """Move a memory through turning voltages (V), oldest first."""
    for v in voltages:
        memory.forward(v)


def try_out(axis: AxisModel, allowed: Limits) -> None:
    """Ask for both ends of what commands may ask for, at both voltage limits, before a command does.

    Raises
    ------
    SlpiError
        If a displacement has no voltage within the limits.
    """
    low, high = axis.displacement_range
    margin = TOLERATED_SHARE * (high - low) * (1.0 - 1e-9)
    stream = StreamingInverse(
        axis.memory("start"), axis.displacement_range, replace(allowed, slew=inf, acceleration=inf)
    )
    for v in (allowed.upper, allowed.lower):
        for y in (low - margin, high + margin) * 2:
            stream.memory.forward(v)
            if not allowed.lower <= stream.step(0.0, y) <= allowed.upper:
                raise ModelError(f"the model gives {stream.voltage} V for {y} m; identify the stage again")


def require_near(present: float, allowed: Limits) -> None:
    """Refuse a model that was identified far from the present voltage (V), where it only extrapolates.

    Raises
    ------
    UsageError
        If `present` is farther outside than commands may be.
    """
    margin = TOLERATED_SHARE * (allowed.upper - allowed.lower)
    if not allowed.lower - margin <= present <= allowed.upper + margin:
        raise UsageError(
            f"it has {present:g} V, but the model is good for {allowed.lower:g}..{allowed.upper:g} V within the "
            "limits; move it there first, or identify on a larger range"
        )


def including(limits: Limits, voltage: float) -> Limits:
    """Return the limits, wide enough for a voltage (V)."""
    return replace(limits, lower=min(limits.lower, voltage), upper=max(limits.upper, voltage))
