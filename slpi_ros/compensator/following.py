"""All axes along trajectories: which voltages are due, and what becomes of a plan when things change."""

from collections.abc import Callable, Collection, Mapping
from math import inf

from slpi_ros.compensator.axis import Axis
from slpi_ros.compensator.deadlines import Due, Streamer
from slpi_ros.compensator.plan import Plan, Standing, prepare
from slpi_ros.compensator.trajectory import Trajectory
from slpi_ros.model.stream import ROUNDING


class Following:
    """Moves axes along trajectories. All times are nanoseconds on one clock.

    While nothing comes in between, the voltages are those that were planned. Once something has - another model, new
    limits, points that were too late, a path before it that became another - the rest of the path is compensated sample
    by sample, from where the axes really are.

    Parameters
    ----------
    axes : mapping of name to Axis
    decouple : callable, optional
        Told the desired displacements (m) by axis name before the axes move there.

    Attributes
    ----------
    points_held, points_slewing : int
        Of the last plan: at a voltage limit, or still on their way.
    """

    def __init__(self, axes: Mapping[str, Axis], decouple: Callable[[Mapping[str, float]], None] | None = None) -> None:
        self._axes, self._decouple = axes, decouple
        self._streamer: Streamer[Plan] = Streamer()
        self._plan: Plan | None = None
        self._as_planned = False
        self._now: Callable[[], int] = int
        self._last_ns = dict.fromkeys(axes, 0)
        self.points_held = self.points_slewing = 0

    @property
    def on(self) -> bool:
        """Whether points are still to come."""
        return self._streamer.next_deadline_ns is not None

    @property
    def remaining(self) -> int:
        """Points still to come."""
        return self._streamer.remaining

    @property
    def skipped(self) -> int:
        """Points that came too late so far."""
        return self._streamer.skipped

    @property
    def next_deadline_ns(self) -> int | None:
        """When the next point is due, nanoseconds; None: there is none."""
        return self._streamer.next_deadline_ns

    @property
    def names(self) -> set[str]:
        """Axes that have points to come."""
        return {name for plan in self._streamer.coming for name in plan.trajectory.names}

    @property
    def under_way(self) -> bool:
        """Whether the next point is not the first of its trajectory."""
        return self.on and self._streamer.coming[0] is self._plan

    @property
    def doing(self) -> str:
        """What is being done with a trajectory; "" without one."""
        if not self.on:
            return ""
        wait = ((self.next_deadline_ns or 0) - self._now()) * 1e-9
        if wait < 1.0:
            return "following a trajectory"
        return f"waiting for a trajectory that {'goes on' if self._plan else 'begins'} in {wait:.0f} s"

    @property
    def busy(self) -> str:
        """Why desired displacements have to wait, and what to do."""
        return f"{self.doing}; wait, or cancel it with an empty one"

    def start(
        self, trajectory: Trajectory, now: Callable[[], int], given_ns: int, driven: Collection[str] = ()
    ) -> None:
        """Let a trajectory take over from what is being followed: at once, or when its first point is due.

        Parameters
        ----------
        trajectory : Trajectory
        now : callable
            Returns the time, nanoseconds. A long trajectory takes a while to compensate; one that starts at once starts
            after that.
        given_ns : int, nanoseconds
            When axes that no trajectory moves were given their voltage.
        driven : collection of str
            Axes that something else moves meanwhile.

        Raises
        ------
        SlpiError
            If it cannot be followed; what was being followed goes on.
        """
        self._last_ns.update(dict.fromkeys(driven if self.on else self._axes, given_ns))
        standing = {
            name: Standing(axis.model, axis.stream, self._last_ns[name])
            for name, axis in self._axes.items()
            if axis.model
        }
        plan = prepare(trajectory, standing, now(), self._streamer)
        self._now = now
        self.points_held, self.points_slewing = (int(mask.any(axis=1).sum()) for mask in (plan.held, plan.slewed))
        self._streamer.start(plan, now())

    def stop(self) -> None:
        """Leave the axes where they are, and take up desired displacements from there."""
        if not self.on and self._plan is None:
            return
        self._streamer.cancel()
        self._plan = None
        for axis in self._axes.values():
            axis.stamps.restart()

    def step(self, now_ns: int) -> int | None:
        """Move on to the latest point that is due; return its deadline (ns), None when none is due."""
        due = self._streamer.due(now_ns)
        if due is None:
            return None
        self._enter(due)
        plan, point = due.points, due.point
        if self._decouple:
            self._decouple(dict(zip(plan.trajectory.names, plan.trajectory.positions[point].tolist(), strict=True)))
        for column, name in enumerate(plan.trajectory.names):
            ahead = (due.deadline_ns - self._last_ns[name]) * 1e-9
            self._last_ns[name] = due.deadline_ns
            self._move(self._axes[name], plan, point, column, ahead)
        if not self.on:
            self.stop()
        return due.deadline_ns

    def _enter(self, due: Due[Plan]) -> None:
        """Notice what makes the plan no longer hold."""
        here = [(origin, self._axes[name].stream) for name, origin in due.points.origins.items()]
        if due.points is not self._plan:
            self._plan = due.points
            self._as_planned = all(origin.is_here(stream) for origin, stream in here)
        if due.skipped or not all(origin.is_of(stream) for origin, stream in here):
            self._as_planned = False

    def _move(self, axis: Axis, plan: Plan, point: int, column: int, ahead: float) -> None:
        wish = float(plan.trajectory.positions[point, column])
        if not self._as_planned:
            axis.move(ahead, wish)
            return
        planned = float(plan.voltages[point, column])
        before = float(plan.voltages[point - 1, column]) if point else axis.stream.voltage
        axis.follow(ahead, wish, planned, before)
        limits = axis.stream.limits
        width = limits.upper - limits.lower if limits.upper - limits.lower < inf else 1.0
        if abs(axis.stream.voltage - planned) > ROUNDING * width:
            self._as_planned = False
