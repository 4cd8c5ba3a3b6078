"""A trajectory: a path known in advance, compensated as one block.

Every point is one command sample, given at its own time. There is no interpolation, neither between points nor from
the present displacement to the first one (in joint_trajectory_controller: interpolation method ``none``): where the
path is farther away than the slew limit allows, the voltage goes there at the slew limit.
"""

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slpi_ros.errors import SlpiError, UsageError
from slpi_ros.hysteresis.memory import Memory
from slpi_ros.model import AxisModel
from slpi_ros.runtime import rejection
from slpi_ros.runtime.clock import SECOND_NS
from slpi_ros.runtime.deadlines import Streamer, check_times, follow, keep_pace, seconds_between
from slpi_ros.runtime.rejection import RejectedError
from slpi_ros.stream import LONGEST_STEP, ROUNDING, AxisStream, Limits, accepted_range, refusal

FloatArray = NDArray[np.float64]
TimeArray = NDArray[np.int64]
Mask = NDArray[np.bool_]
AxisPlan = tuple[FloatArray, Mask, Mask]


@dataclass(frozen=True)
class Trajectory:
    """Desired displacements of some axes at given times, as `Trajectory.of` checked them.

    Parameters
    ----------
    names : tuple of str, length K
    time_from_start_ns : ndarray of int64, shape (N,), nanoseconds
        Strictly increasing, N >= 1.
    positions : ndarray, shape (N, K), metres
    start_ns : int, nanoseconds
        0: at once. A clock that counts from the machine's start may have been negative then.
    cut : int
        Number of earlier points left out: their time had passed.
    """

    names: tuple[str, ...]
    time_from_start_ns: TimeArray
    positions: FloatArray
    start_ns: int
    cut: int = 0

    @classmethod
    def of(
        cls,
        names: Sequence[str],
        time_from_start_ns: ArrayLike,
        positions: ArrayLike,
        start_ns: int = 0,
        *,
        axes: Sequence[str],
    ) -> "Trajectory":
        """Return a checked trajectory; arrays are not copied.

        Parameters
        ----------
        names : sequence of str, length K
            Some of `axes`, in any order.
        time_from_start_ns : array_like of int, shape (N,), nanoseconds
        positions : array_like, shape (N, K), metres
        start_ns : int, nanoseconds
        axes : sequence of str
            All there are.

        Raises
        ------
        RejectedError
            If names, shapes, times or positions make no sense; the first bad point is named.
        """
        _check_names(names, axes)
        times, places = _as_array(time_from_start_ns), _as_array(positions, np.float64)
        if not times.size:
            raise RejectedError(rejection.EMPTY, "the trajectory has no points; give at least one")
        if times.ndim != 1 or places.shape != (times.size, len(names)):
            what = f"{len(names)} axes, times of shape {times.shape}, positions of shape {places.shape}"
            raise RejectedError(rejection.LENGTH, f"{what}; give each point a time and a number for each axis")
        check_times(times, start_ns)
        finite = np.isfinite(places)
        if not finite.all():
            point, column = (int(i) for i in np.unravel_index(np.argmin(finite), finite.shape))
            what = f"axis '{names[column]}', point {point}: displacement is {places[point, column]} m"
            raise RejectedError(rejection.NOT_FINITE, f"{what}; send finite ones only")
        return cls(tuple(names), times.astype(np.int64, copy=False), places, start_ns)

    def __len__(self) -> int:
        """Return the number of points."""
        return self.time_from_start_ns.size

    def useful_at(self, now_ns: int) -> "Trajectory":
        """Return the part whose time has not passed; all of it if it starts at once.

        Raises
        ------
        RejectedError
            If nothing is left.
        """
        first = int(np.searchsorted(self.time_from_start_ns, now_ns - self.start_ns)) if self.start_ns else 0
        if first == len(self):
            ago = (now_ns - self.start_ns - int(self.time_from_start_ns[-1])) / SECOND_NS
            raise RejectedError(
                rejection.STALE, f"the trajectory ended {ago:.9g} s ago; send it earlier, or stamp it 0"
            )
        times, places = self.time_from_start_ns[first:], self.positions[first:]
        return replace(self, time_from_start_ns=times, positions=places, cut=self.cut + first)

    def deadlines_ns(self, now_ns: int) -> TimeArray:
        """Return when its points are due, shape (N,), nanoseconds, if it is accepted now."""
        return self.time_from_start_ns + (self.start_ns or now_ns)


@dataclass(frozen=True)
class Resting:
    """An axis that follows known paths only: it has `limits`, and a `voltage` (V), but no memory."""

    limits: Limits
    voltage: float


@dataclass(frozen=True)
class Standing:
    """Where an axis stands when a trajectory takes over.

    Parameters
    ----------
    model : AxisModel
    axis : AxisStream or Resting
        The live axis, which is only read; `Resting` where the model is not causal.
    since_ns : int, nanoseconds
        When it was given its present voltage.
    """

    model: AxisModel
    axis: AxisStream | Resting
    since_ns: int

    def after(self, voltages: FloatArray, times_ns: TimeArray) -> "Standing":
        """Return where the axis stands once given voltages, shape (M,), volts, at times, shape (M,), M >= 1."""
        last, at_ns = float(voltages[-1]), int(times_ns[-1])
        if isinstance(self.axis, Resting):
            return replace(self, axis=replace(self.axis, voltage=last), since_ns=at_ns)
        before = float(voltages[-2]) if voltages.size > 1 else self.axis.voltage
        axis = stream_twin_of(self.axis)
        axis.memory.forward_array(voltages)
        axis.drive(last)
        axis.pace.moved(last - before, min(float(seconds_between(times_ns, self.since_ns)[-1]), LONGEST_STEP))
        return replace(self, axis=axis, since_ns=at_ns)


@dataclass(frozen=True)
class Plan:
    """A trajectory in volts.

    Parameters
    ----------
    trajectory : Trajectory
    voltages : ndarray, shape (N, K), volts
    held : ndarray of bool, shape (N, K)
        Where a displacement is out of reach: the axis waits at a voltage limit.
    slewed : ndarray of bool, shape (N, K)
        Where the axis is still on its way, at the slew limit.
    """

    trajectory: Trajectory
    voltages: FloatArray
    held: Mask
    slewed: Mask

    @property
    def at_once(self) -> bool:
        """Whether it takes over when it is accepted, not at the time of its first point."""
        return not self.trajectory.start_ns

    def deadlines_ns(self, now_ns: int) -> TimeArray:
        """Return when its points are due, shape (N,), nanoseconds, if it is accepted now."""
        return self.trajectory.deadlines_ns(now_ns)


def prepare(
    trajectory: Trajectory, standing: Mapping[str, Standing], now_ns: int, running: Streamer[Plan] | None = None
) -> Plan:
    """Return the plan of a trajectory that arrives now; nothing moves, whatever becomes of it.

    Parameters
    ----------
    trajectory : Trajectory
        Points whose time has passed are left out.
    standing : mapping of axis name to Standing
        The axes as they are now.
    now_ns : int, nanoseconds
        A trajectory without start may be started later; that does no harm.
    running : Streamer of Plan
        Its points go on until the first one of the new trajectory is due, unless that starts at once.

    Raises
    ------
    SlpiError
        If all of it is in the past, a displacement is far out of reach, or a model cannot follow from where it stands.
    """
    trajectory = trajectory.useful_at(now_ns)
    deadlines = trajectory.deadlines_ns(now_ns)
    expected = {name: standing[name] for name in trajectory.names}
    for stretch in running.before(int(deadlines[0])) if running and trajectory.start_ns else []:
        still = slice(stretch.next, stretch.stop)
        for column, name in enumerate(stretch.points.trajectory.names):
            if name in expected:
                voltages = stretch.points.voltages[still, column]
                expected[name] = expected[name].after(voltages, stretch.deadlines_ns[still])
    return _compensate(trajectory, deadlines, expected)


def twin_of(memory: Memory) -> Memory:
    """Return a memory in the same state, which moves on its own."""
    twin = copy(memory)
    twin.restore(memory.snapshot())
    return twin


def stream_twin_of(stream: AxisStream) -> AxisStream:
    """Return a stream in the same state, which moves on its own."""
    twin = copy(stream)
    twin.memory, twin.pace = twin_of(stream.memory), copy(stream.pace)
    return twin


def _compensate(trajectory: Trajectory, deadlines: TimeArray, standing: Mapping[str, Standing]) -> Plan:
    shape = trajectory.positions.shape
    v, held, slewed = np.empty(shape, order="F"), np.empty(shape, np.bool_, "F"), np.empty(shape, np.bool_, "F")
    for column, name in enumerate(trajectory.names):
        here, y = standing[name], np.ascontiguousarray(trajectory.positions[:, column])
        _check_reachable(name, here.model, y, trajectory.cut)
        elapsed = seconds_between(deadlines, here.since_ns)
        try:
            if isinstance(here.axis, Resting):
                answer = _along_known_path(here.model, here.axis, y, elapsed)
            else:
                answer = _from_memory(here.model, here.axis, y, elapsed)
        except SlpiError as error:
            raise type(error)(f"axis '{name}': {error}") from None
        v[:, column], held[:, column], slewed[:, column] = answer
    return Plan(trajectory, v, held, slewed)


def _from_memory(model: AxisModel, axis: AxisStream, y: FloatArray, elapsed: FloatArray) -> AxisPlan:
    v, late = follow(stream_twin_of(axis), y, elapsed)
    lowest, highest = v <= axis.limits.lower, v >= axis.limits.upper
    if not (lowest.any() or highest.any() or late.any()):
        return v, lowest, late
    missing, (low, high) = y - twin_of(axis.memory).forward_array(v), model.displacement_range
    rounding = ROUNDING * (high - low)
    # At a limit a wish may just be met, or lie on this side of it.
    held = (lowest & (missing < -rounding)) | (highest & (missing > rounding))
    return v, held, late & ~held


def _along_known_path(model: AxisModel, axis: Resting, y: FloatArray, elapsed: FloatArray) -> AxisPlan:
    start, (low, high) = model.start.voltage, model.voltage_range
    if abs(axis.voltage - start) > ROUNDING * (high - low):
        raise UsageError(
            f"a path of kind '{model.kind}' begins at {start:g} V, where its model does, but the axis has "
            f"{axis.voltage:g} V; bring it there first"
        )
    wanted, held = model.compensate(y, axis.limits)
    v = keep_pace(axis.limits, axis.voltage, wanted, elapsed)
    late = np.abs(v - wanted) > ROUNDING * (high - low)
    return v, held & ~late, late


def _check_names(names: Sequence[str], axes: Sequence[str]) -> None:
    if not names:
        raise RejectedError(rejection.EMPTY, "no axis is named; name the axes to move")
    if len(set(names)) != len(names):
        raise RejectedError(rejection.DUPLICATE_AXIS, f"{', '.join(names)}: an axis is named twice; name each once")
    unknown = [name for name in names if name not in axes]
    if unknown:
        raise RejectedError(rejection.UNKNOWN_AXIS, f"no axis '{unknown[0]}'; there are {', '.join(axes)}")


def _as_array(values: ArrayLike, dtype: type | None = None) -> NDArray[Any]:
    try:
        return np.asarray(values, dtype)
    except (TypeError, ValueError, OverflowError) as error:
        raise RejectedError(rejection.LENGTH, f"the points are no array of numbers: {error}") from None


def _check_reachable(name: str, model: AxisModel, y: FloatArray, cut: int) -> None:
    accepted = accepted_range(model.displacement_range)
    if (far := (y < accepted[0]) | (y > accepted[1])).any():
        at = int(np.argmax(far))
        what = f"axis '{name}', point {cut + at}: {refusal(float(y[at]), accepted)}"
        raise RejectedError(rejection.OUT_OF_RANGE, what)
