"""The compensator without ROS: a desired message in, the voltages of all axes out, or nothing moved."""

from array import array
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from math import inf, isfinite

from slpi_ros.errors import ModelError, SlpiError, UnreachableError, UsageError
from slpi_ros.model import AxisModel, StageModel
from slpi_ros.stream import TOLERATED_SHARE, AxisStream, Limits

NO_MODEL = "no_model"
INACTIVE = "inactive"
EMPTY = "empty"
LENGTH = "length"
DUPLICATE_AXIS = "duplicate_axis"
UNKNOWN_AXIS = "unknown_axis"
NOT_FINITE = "not_finite"
TIME_BACKWARDS = "time_backwards"
OUT_OF_RANGE = "out_of_range"
CAUSES = (
    NO_MODEL, INACTIVE, EMPTY, LENGTH, DUPLICATE_AXIS, UNKNOWN_AXIS, NOT_FINITE, TIME_BACKWARDS, OUT_OF_RANGE,
)  # fmt: skip

NEVER_NS = -(2**63)


class RejectedError(SlpiError):
    """A desired message was rejected as a whole; `cause` is one of `CAUSES`."""

    def __init__(self, cause: str, message: str) -> None:
        super().__init__(message)
        self.cause = cause


@dataclass
class Counts:
    """What became of the desired messages.

    Parameters
    ----------
    received, accepted : int
    held_at_limit : int
        Accepted ones of which an axis could not reach its displacement within the voltage limits.
    by_cause : dict of str to int
        Rejected ones.
    """

    received: int = 0
    accepted: int = 0
    held_at_limit: int = 0
    by_cause: dict[str, int] = field(default_factory=lambda: dict.fromkeys(CAUSES, 0))

    @property
    def rejected(self) -> int:
        """All rejected messages."""
        return self.received - self.accepted

    def copy(self) -> "Counts":
        """Return the present counts, which do not count on."""
        return replace(self, by_cause=dict(self.by_cause))


class Compensation:
    """All axes of one compensator.

    Parameters
    ----------
    axes : sequence of str
        Names, in the order of the voltages.
    limits : sequence of Limits
        One for each axis. No model widens them.

    Attributes
    ----------
    voltages : array of float, shape (axes,), volts
        The present ones, always the same array. An axis that a message does not name keeps its voltage.
    active : bool
        Whether messages are answered.
    counts : Counts
    model : StageModel or None
    """

    def __init__(self, axes: Sequence[str], limits: Sequence[Limits]) -> None:
        self.axes = list(axes)
        self.voltages = array("d", [0.0] * len(self.axes))
        self.active = False
        self.counts = Counts()
        self.model: StageModel | None = None
        self._limits = tuple(limits)
        self._index = {axis: i for i, axis in enumerate(self.axes)}
        self._streams: tuple[AxisStream, ...] = ()
        # Before the first model nobody knows what voltages the axes have.
        self._driven = False
        self._first_ns: int | None = None
        self._last_ns = [NEVER_NS] * len(self.axes)
        self._last_names: list[str] | None = None
        self._last_indices: list[int] = []

    def use_model(self, model: StageModel) -> None:
        """Take a model over; the voltages stay as they are.

        Raises
        ------
        SlpiError
            If the model lacks an axis or cannot serve within the limits; the one before works on.
        """
        present = self.voltages if self._driven else [None] * len(self.axes)
        streams = []
        for name, limits, voltage in zip(self.axes, self._limits, present, strict=True):
            axis = model.axis(name)
            try:
                streams.append(start_stream(axis, limits, voltage))
            except SlpiError as error:
                raise type(error)(f"axis '{name}': {error}") from None
        self._streams, self.model, self._driven = tuple(streams), model, True
        for i, stream in enumerate(streams):
            self.voltages[i] = stream.voltage

    def forget_model(self) -> None:
        """Reject everything until the next model; the voltages stay."""
        self._streams, self.model = (), None

    def check_limits(self, limits: Sequence[Limits]) -> None:
        """Raise what `use_limits` would raise."""
        if not self._driven:
            return
        for name, new, present in zip(self.axes, limits, self.voltages, strict=True):
            if not new.lower <= present <= new.upper:
                raise UsageError(
                    f"axis '{name}' has {present:g} V, outside the new limits {new.lower:g}..{new.upper:g} V; "
                    "move it inside first"
                )
            if self.model:
                new.within(self.model.axis(name).voltage_range)

    def use_limits(self, limits: Sequence[Limits]) -> None:
        """Take new limits over; memory and voltages stay.

        Raises
        ------
        UsageError
            If an axis is outside of them, or the model has no voltage inside.
        """
        self.check_limits(limits)
        self._limits = tuple(limits)
        if self.model:
            for name, new, stream in zip(self.axes, limits, self._streams, strict=True):
                stream.limits = stretched(new.within(self.model.axis(name).voltage_range), stream.voltage)

    def move(self, stamp_ns: int, names: Sequence[str], displacements: Sequence[float]) -> bool:
        """Move the named axes to their desired displacements; `voltages` holds the answer.

        Parameters
        ----------
        stamp_ns : int, nanoseconds
        names : sequence of str
        displacements : sequence of float, metres
            One for each name.

        Returns
        -------
        bool
            Whether an axis could not reach its displacement and waits at a voltage limit.

        Raises
        ------
        RejectedError
            If the message cannot be answered as a whole; it is counted, and no axis has moved.
        """
        self.counts.received += 1
        try:
            indices = self._indices(names, len(displacements))
            t = (stamp_ns - self._first_ns) * 1e-9 if self._first_ns is not None else 0.0
            for i, y in zip(indices, displacements, strict=True):
                self._check(i, stamp_ns, t, y)
        except RejectedError as error:
            self.counts.by_cause[error.cause] += 1
            raise
        if self._first_ns is None:
            self._first_ns = stamp_ns
        missed = False
        for i, y in zip(indices, displacements, strict=True):
            stream = self._streams[i]
            self.voltages[i] = stream.step(t, y)
            self._last_ns[i] = stamp_ns
            missed = missed or stream.held
        self.counts.accepted += 1
        self.counts.held_at_limit += missed
        return missed

    def _indices(self, names: Sequence[str], count: int) -> list[int]:
        """Return the places of the named axes."""
        if not self.active:
            raise RejectedError(INACTIVE, "the compensator is not active; activate it")
        if not self._streams:
            raise RejectedError(NO_MODEL, "there is no model yet; give model_file, or publish stage_model")
        if count != len(names):
            raise RejectedError(LENGTH, f"{len(names)} axes but {count} displacements; send one for each axis")
        # Most senders name the same axes every time.
        if names != self._last_names:
            self._last_indices = self._match(names)
            self._last_names = list(names)
        return self._last_indices

    def _match(self, names: Sequence[str]) -> list[int]:
        if not names:
            raise RejectedError(EMPTY, "no axis is named; name the axes to move")
        if len(set(names)) != len(names):
            raise RejectedError(DUPLICATE_AXIS, f"{', '.join(names)}: an axis is named twice; name each once")
        unknown = [name for name in names if name not in self._index]
        if unknown:
            raise RejectedError(UNKNOWN_AXIS, f"no axis '{unknown[0]}'; this node moves {', '.join(self.axes)}")
        return [self._index[name] for name in names]

    def _check(self, i: int, stamp_ns: int, t: float, y: float) -> None:
        """Reject what the stream of axis `i` would refuse."""
        last = self._last_ns[i]
        # A new stream does not know the stamps before it.
        if stamp_ns < last:
            back = f"{(last - stamp_ns) * 1e-9:.9g} s"
            raise RejectedError(TIME_BACKWARDS, f"axis '{self.axes[i]}': time runs {back} backwards; send in order")
        if not isfinite(y):
            raise RejectedError(NOT_FINITE, f"axis '{self.axes[i]}': displacement is {y} m; send finite ones only")
        try:
            self._streams[i].check(t, y)
        except UnreachableError as error:
            raise RejectedError(OUT_OF_RANGE, f"axis '{self.axes[i]}': {error}") from None


def start_stream(axis: AxisModel, limits: Limits, present: float | None) -> AxisStream:
    """Return a stream of a new model that stands at the voltage `present` (V), or at the model's start if that is None.

    Only the voltage is taken over so far: the new memory reaches it in one move from its own start, and knows no other
    turning point of the old one.

    Raises
    ------
    SlpiError
        If the model has no voltage within the limits, or its displacements contradict its curves.
    """
    allowed = limits.within(axis.voltage_range)
    low, high = axis.displacement_range
    margin = TOLERATED_SHARE * (high - low) * (1.0 - 1e-9)
    try_out(
        AxisStream(axis.memory(), axis.displacement_range, replace(allowed, slew=inf)), (low - margin, high + margin)
    )
    if present is not None:
        allowed = stretched(allowed, present)
    stream = AxisStream(axis.memory(), axis.displacement_range, allowed)
    if present is not None:
        stream.memory.forward(present)
    return stream


def try_out(stream: AxisStream, ends: tuple[float, float]) -> None:
    """Ask for both ends (m) of what commands may ask for, at both voltage limits: none may find a surprise later.

    Raises
    ------
    SlpiError
        If a displacement has no voltage within the limits.
    """
    lower, upper = stream.limits.lower, stream.limits.upper
    for v in (upper, lower):
        for y in ends * 2:
            stream.memory.forward(v)
            if not lower <= stream.step(0.0, y) <= upper:
                raise ModelError(f"the model gives {stream.voltage} V for {y} m; identify the stage again")


def stretched(limits: Limits, present: float) -> Limits:
    """Return the limits, wide enough for the voltage `present` (V): taking them over must not move the axis."""
    return Limits(min(limits.lower, present), max(limits.upper, present), limits.slew)
