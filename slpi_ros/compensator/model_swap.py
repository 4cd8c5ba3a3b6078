"""A model takes over: its memory is rebuilt from what the axis went through, and the voltage stays."""

from collections.abc import Sequence
from dataclasses import replace
from math import inf

from slpi_ros.errors import ModelError, UsageError
from slpi_ros.hysteresis.turning_points import FAR, Memory
from slpi_ros.model.stage_model import AxisModel
from slpi_ros.model.streaming import TOLERATED_SHARE, Limits, StreamingInverse


def take_over(axis: AxisModel, limits: Limits, reversal_voltages: Sequence[float] = ()) -> StreamingInverse:
    """Return a stream of a new model.

    Parameters
    ----------
    axis : AxisModel
    limits : Limits
        Of the node; the stream keeps to what is within them and the identified voltages.
    went_through : sequence of float, volts
        Where the drive turned, oldest first, and last its present voltage. The new memory goes through them from its
        own start. Empty: nothing is known, and the model's start stands.

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
    memory = axis.memory()
    if not reversal_voltages:
        return axis.stream_from(memory, allowed)
    present = reversal_voltages[-1]
    require_near(present, allowed)
    replay(memory, reversal_voltages)
    # No jump: a voltage just outside goes inside with the next samples, as fast as it may.
    stream = axis.stream_from(memory, including(allowed, present))
    stream.limits = allowed
    return stream


def go_on(axis: AxisModel, allowed: Limits, before: StreamingInverse) -> tuple[Limits, StreamingInverse]:
    """Return a stream of a new model where another one has been, and `allowed`, wide enough for it."""
    memory = axis.memory()
    replay(memory, turning_voltages(before.memory))
    limits = including(allowed, before.voltage)
    stream = axis.stream_from(memory, including(limits, memory.voltage))
    stream.resume(before)
    return limits, stream


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
    """Ask for both ends of what commands may ask for, at both voltage limits: none may find a surprise later.

    Raises
    ------
    SlpiError
        If a displacement has no voltage within the limits.
    """
    low, high = axis.displacement_range
    margin = TOLERATED_SHARE * (high - low) * (1.0 - 1e-9)
    stream = StreamingInverse(axis.memory(), axis.displacement_range, replace(allowed, slew=inf, acceleration=inf))
    for v in (allowed.upper, allowed.lower):
        for y in (low - margin, high + margin) * 2:
            stream.memory.forward(v)
            if not allowed.lower <= stream.step(0.0, y) <= allowed.upper:
                raise ModelError(f"the model gives {stream.voltage} V for {y} m; identify the stage again")


def require_near(present: float, allowed: Limits) -> None:
    """Refuse a model that was identified far from the present voltage (V): what it says there is made up.

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
