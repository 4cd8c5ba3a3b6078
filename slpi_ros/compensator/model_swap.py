"""Replacement of the model at run time: the memory is rebuilt from the reversals, the voltage is unchanged."""

from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from math import inf
from statistics import median

from slpi_ros.compensator.persistence import MemoryConfidence
from slpi_ros.errors import ModelError, UsageError
from slpi_ros.hysteresis.shapes import FAR
from slpi_ros.hysteresis.turning_points import Memory
from slpi_ros.io.messages import SECOND_NS
from slpi_ros.model.axis_model import START_MEMORIES, AxisModel, StartMemory
from slpi_ros.model.limits import Limits
from slpi_ros.model.streaming import TOLERATED_SHARE, StreamingInverse

# An initial state matches the first measurements if its error is at most this fraction of the identified displacement
# range, or this multiple of the held-out error: more than overnight drift, less than the error of a wrong history.
FIT_SHARE, FIT_SIGMAS = 0.005, 4.0
# The median of this many measurements of at most this age decides on the initial state.
FIRST_READINGS, FIRST_AGE_NS = 5, SECOND_NS // 5


def take_over(
    axis: AxisModel, limits: Limits, reversal_voltages: Sequence[float] = (), start_memory: StartMemory = "end"
) -> StreamingInverse:
    """Return the streaming inverse of a new model, with its memory in the present hysteresis state of the axis."""
    # The `reversal_voltages` (V), oldest first, then the present one, are replayed on the initial state "start";
    # without them the initial state is `start_memory`, see `AxisModel.initial`.
    if not axis.causal:
        raise UsageError(
            f"kind '{axis.kind}' needs the complete path in advance, but the compensator works sample by sample; "
            "identify kind 'slpi', or use 'slpi compensate'"
        )
    allowed = limits.within(axis.voltage_range)
    check_inverse(axis, allowed)
    if not reversal_voltages:
        return axis.stream_from(axis.memory(start_memory), allowed)
    present = reversal_voltages[-1]
    memory = replayed(axis, reversal_voltages)
    # No step: a voltage just outside the limits returns with the next samples, within slew and acceleration limits.
    stream = axis.stream_from(memory, extended_to(allowed, present))
    stream.limits = allowed
    return stream


def continue_from(axis: AxisModel, allowed: Limits, before: StreamingInverse) -> StreamingInverse:
    """Return a streaming inverse of a new model in the state of `before`; limits are widened to include its voltage."""
    memory = replayed(axis, turning_voltages(before.memory))
    stream = axis.stream_from(memory, extended_to(extended_to(allowed, before.voltage), memory.voltage))
    stream.resume(before)
    return stream


def turning_voltages(memory: Memory) -> tuple[float, ...]:
    """Return the voltages (V) of the remembered reversals, oldest first, followed by the present voltage."""
    state = memory.snapshot()
    # A primed memory (major loop, falling branch) contains a reversal far outside the voltage range of any stage.
    return (*(v for v in state.turn_voltages if abs(v) < FAR / 2), state.voltage)


def voltage_history(stream: StreamingInverse) -> tuple[float, ...]:
    """Return `turning_voltages` of the memory (V), followed by the command (V) if it differs, for instance by a lag."""
    turns = turning_voltages(stream.memory)
    return turns if turns[-1] == stream.voltage else (*turns, stream.voltage)


def replayed(axis: AxisModel, voltages: Sequence[float]) -> Memory:
    """Return the memory of a model after reversal voltages (V), oldest first."""
    memory = axis.memory("start")
    for v in voltages:
        memory.forward(v)
    return memory


def check_inverse(axis: AxisModel, allowed: Limits) -> None:
    """Check that both ends of the accepted displacements have voltages within the limits, from either limit."""
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
    """Refuse a model if the present voltage (V) is far outside its identified range: it would extrapolate."""
    margin = TOLERATED_SHARE * (allowed.upper - allowed.lower)
    if not allowed.lower - margin <= present <= allowed.upper + margin:
        raise UsageError(
            f"the axis has {present:g} V, but the model is valid for {allowed.lower:g}..{allowed.upper:g} V within "
            "the limits; move the axis into this range first, or identify on a larger range"
        )


def extended_to(limits: Limits, voltage: float) -> Limits:
    """Return the limits, extended to include `voltage` (V)."""
    return replace(limits, lower=min(limits.lower, voltage), upper=max(limits.upper, voltage))


class InitialState:
    """State of the memory at the start: `assumed` until a voltage is output, unless measurements show another one."""

    def __init__(self) -> None:
        self.assumed: StartMemory | None = None  # None once a voltage was output, or if it was restored
        self._readings: deque[tuple[int, float]] = deque(maxlen=FIRST_READINGS)

    def read(self, x: float, now_ns: int) -> None:
        """Take a measured displacement (m)."""
        self._readings.append((now_ns, x))

    def choose(
        self, model: AxisModel, limits: Limits, present: StreamingInverse, surroundings: dict[str, float], now_ns: int
    ) -> tuple[StreamingInverse | None, MemoryConfidence | None]:
        """Return the inverse with the initial state that matches the first measurements, and the confidence in it.

        None: as it is. The assumed one stays unless another one matches better by more than the noise, and without
        enough recent measurements that agree. The voltage is that of the `present` inverse.
        """
        recent = [x for t, x in self._readings if now_ns - t <= FIRST_AGE_NS]
        if not self.assumed or len(recent) < FIRST_READINGS:
            return None, None
        measured, (low, high) = median(recent), model.displacement_range
        noise = FIT_SIGMAS * max(model.quality.held_out_rms, model.quality.floor_rms)
        allowed = max(noise, FIT_SHARE * (high - low))
        if max(recent) - min(recent) > 2.0 * allowed:
            return None, None
        assumed, errors = self.assumed, dict[StartMemory, float]()
        streams = {name: take_over(model, limits, (), name) for name in START_MEMORIES}
        for name, stream in streams.items():
            stream.coupled = present.coupled
            stream.surround(surroundings)
            errors[name] = abs(measured - stream.rest_at(present.voltage, measured))
        best = min(START_MEMORIES, key=lambda name: errors[name])
        self.assumed = None
        self._readings.clear()
        if errors[best] > allowed:
            tried = ", ".join(f"{name} {error * 1e6:.4g} µm" for name, error in errors.items())
            doubt = f"the measurement matches no initial state of the model (errors: {tried}); call ~/reset_memory"
            return None, MemoryConfidence(doubt=doubt, contradicted=True)
        if errors[assumed] > errors[best] + noise:
            doubt = f"chosen by measurement: start_memory '{best}', not '{assumed}'"
            return streams[best], MemoryConfidence(doubt=doubt)
        return None, None
