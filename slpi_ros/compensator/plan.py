"""A plan: a trajectory in volts, compensated as one block from where the axes will be when it takes over."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from slpi_ros.compensator import rejection
from slpi_ros.compensator.deadlines import Streamer, follow, seconds_between
from slpi_ros.compensator.model_swap import whole_way
from slpi_ros.compensator.rejection import RejectedError
from slpi_ros.compensator.stepping import drive_through, follow_together
from slpi_ros.compensator.trajectory import Trajectory
from slpi_ros.errors import SlpiError
from slpi_ros.model.stage_model import AxisModel
from slpi_ros.model.stream import LONGEST_STEP, ROUNDING, AxisStream, Limits, accepted_range, refusal

FloatArray = NDArray[np.float64]
TimeArray = NDArray[np.int64]
Mask = NDArray[np.bool_]
AxisPlan = tuple[FloatArray, Mask, Mask]


@dataclass(frozen=True)
class Standing:
    """Where an axis stands when a trajectory takes over.

    Parameters
    ----------
    model : AxisModel
    axis : AxisStream
        The live axis, which is only read.
    since_ns : int, nanoseconds
        When it was given its present voltage.
    """

    model: AxisModel
    axis: AxisStream
    since_ns: int

    def after(self, voltages: FloatArray, times_ns: TimeArray) -> "Standing":
        """Return where the axis stands once given voltages, shape (M,), volts, at times, shape (M,), M >= 1."""
        last, at_ns = float(voltages[-1]), int(times_ns[-1])
        before = float(voltages[-2]) if voltages.size > 1 else self.axis.voltage
        axis, elapsed = self.axis.twin(), seconds_between(times_ns, self.since_ns)
        if axis.timeless:
            axis.memory.forward_array(voltages)
            axis.drive(last)
        else:
            drive_through(axis, voltages, elapsed)
        axis.pace.moved(last - before, min(float(elapsed[-1]), LONGEST_STEP))
        return replace(self, axis=axis, since_ns=at_ns)


@dataclass(frozen=True)
class Origin:
    """Where a plan expects an axis when it takes over.

    Parameters
    ----------
    axis : AxisStream
        The live axis of the time when the plan was made.
    limits : Limits
        At that time.
    went_through : tuple of float, volts
        What its memory will know by then, and last its voltage.
    """

    axis: AxisStream
    limits: Limits
    went_through: tuple[float, ...]

    def is_of(self, axis: AxisStream) -> bool:
        """Whether neither model nor limits have changed since."""
        return axis is self.axis and axis.limits == self.limits

    def is_here(self, axis: AxisStream) -> bool:
        """Whether the axis stands as expected, but for rounding."""
        here, there = whole_way(axis), self.went_through
        scale = ROUNDING * (1.0 + max(map(abs, there)))
        return len(here) == len(there) and all(abs(a - b) <= scale for a, b in zip(here, there, strict=True))


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
    origins : mapping of axis name to Origin
        Of the axes that it reckons with.
    """

    trajectory: Trajectory
    voltages: FloatArray
    held: Mask
    slewed: Mask
    origins: Mapping[str, Origin]

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
    expected = {name: standing[name] for name in _reckoned_with(trajectory.names, standing)}
    for stretch in running.before(int(deadlines[0])) if running and trajectory.start_ns else []:
        still = slice(stretch.next, stretch.stop)
        for column, name in enumerate(stretch.points.trajectory.names):
            if name in expected:
                voltages = stretch.points.voltages[still, column]
                expected[name] = expected[name].after(voltages, stretch.deadlines_ns[still])
    origins = {
        name: Origin(standing[name].axis, standing[name].axis.limits, whole_way(there.axis))
        for name, there in expected.items()
    }
    return Plan(trajectory, *_compensate(trajectory, deadlines, {**standing, **expected}), origins)


def _compensate(trajectory: Trajectory, deadlines: TimeArray, standing: Mapping[str, Standing]) -> AxisPlan:
    shape = trajectory.positions.shape
    v, held, slewed = np.empty(shape, order="F"), np.empty(shape, np.bool_, "F"), np.empty(shape, np.bool_, "F")
    paths = {name: np.ascontiguousarray(trajectory.positions[:, i]) for i, name in enumerate(trajectory.names)}
    for name, y in paths.items():
        _check_reachable(name, standing[name].model, y, trajectory.cut)
    together = _with_effects(paths, deadlines, standing)
    for column, (name, y) in enumerate(paths.items()):
        if name in together:
            v[:, column], held[:, column], slewed[:, column] = together[name]
            continue
        here = standing[name]
        elapsed = seconds_between(deadlines, here.since_ns)
        try:
            answer = _from_memory(here.model, here.axis, y, elapsed)
        except SlpiError as error:
            raise type(error)(f"axis '{name}': {error}") from None
        v[:, column], held[:, column], slewed[:, column] = answer
    return v, held, slewed


def _move_along(names: Iterable[str], standing: Mapping[str, Standing]) -> bool:
    """Whether axes may move along with each other."""
    return any(not standing[name].axis.timeless for name in names)


def _reckoned_with(names: Sequence[str], standing: Mapping[str, Standing]) -> Iterable[str]:
    """Return the names of the axes on which a path of the named ones depends."""
    return standing if _move_along(names, standing) else names


def _with_effects(
    paths: Mapping[str, FloatArray], deadlines: TimeArray, standing: Mapping[str, Standing]
) -> dict[str, AxisPlan]:
    """Return the plans of the axes if time matters to any of them; they may move along with each other."""
    if not _move_along(paths, standing):
        return {}
    return follow_together(
        {name: here.axis.twin() for name, here in standing.items()},
        {name: here.model for name, here in standing.items()},
        paths,
        {name: seconds_between(deadlines, standing[name].since_ns) for name in paths},
    )


def _from_memory(model: AxisModel, axis: AxisStream, y: FloatArray, elapsed: FloatArray) -> AxisPlan:
    v, late, reached = follow(axis.twin(), y, elapsed)
    missing, (low, high) = y - reached, model.displacement_range
    # At a limit a wish may just be met, or lie on this side of it.
    rounding = ROUNDING * (high - low)
    held = (v <= axis.limits.lower) & (missing < -rounding) | (v >= axis.limits.upper) & (missing > rounding)
    return v, held, late & ~held


def _check_reachable(name: str, model: AxisModel, y: FloatArray, cut: int) -> None:
    accepted = accepted_range(model.displacement_range)
    if (far := (y < accepted[0]) | (y > accepted[1])).any():
        at = int(np.argmax(far))
        what = f"axis '{name}', point {cut + at}: {refusal(float(y[at]), accepted)}"
        raise RejectedError(rejection.OUT_OF_RANGE, what)
