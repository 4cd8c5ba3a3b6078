"""The compensator's trajectories: bytes in, voltages at their own times out."""

import time
from collections.abc import Callable

import numpy as np
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.serialization import deserialize_message
from trajectory_msgs.msg import JointTrajectory

from slpi_ros.compensator.controller import Compensation
from slpi_ros.compensator.statistics import Timing
from slpi_ros.compensator.trajectory import Trajectory
from slpi_ros.compensator.validation import EMPTY, INACTIVE, LENGTH, NO_MODEL, RESETTING, RejectedError
from slpi_ros.io.messages import SECOND_NS, TrajectoryArrays, decode_trajectory
from slpi_ros.model.limits import MAX_DT
from slpi_ros.nodes.compensator_driver import Driver

# How often a simulated clock is looked at, seconds.
SIMULATED_PERIOD = 0.001
SHORTEST_WAIT_NS = 1_000


class TrajectoryFollower:
    """Takes trajectories, and publishes the voltages of each point when it is due.

    Deadlines are absolute, on a clock that never jumps; with `use_sim_time` on the simulated one.

    Parameters
    ----------
    node : Node
    compensation : Compensation
    publish : callable
        Publishes the present voltages.
    driver : Driver
        Brings axes to rest where a trajectory leaves them in motion.

    Attributes
    ----------
    lateness : Timing
        Of the points since the last report.
    """

    def __init__(
        self,
        node: Node,
        compensation: Compensation,
        publish: Callable[[], None],
        driver: Driver,
    ) -> None:
        self._node, self._compensation = node, compensation
        self._publish, self._driver = publish, driver
        self.lateness = Timing()
        self._on_simulated = False
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._timer = node.create_timer(SIMULATED_PERIOD, self._on_timer, clock=steady)
        self._timer.cancel()

    def take(self, data: bytes) -> None:
        """Follow a serialized JointTrajectory from its time on; one without points stops what is being followed.

        Raises
        ------
        SlpiError
            If it cannot be followed; what was being followed goes on.
        """
        arrays = decode_trajectory(data) or _as_rclpy_reads(data)
        if not arrays.time_from_start_ns.size:
            self.stop()
            return
        compensation = self._compensation
        if not compensation.active:
            raise RejectedError(INACTIVE, "the compensator is not active; activate it")
        if compensation.model is None:
            raise RejectedError(NO_MODEL, "there is no model yet; give model_file, or publish stage_model")
        if compensation.driving.resetting:
            raise RejectedError(RESETTING, "the memory is being reset; wait until reset_memory answers")
        now_ns = self._now_ns()
        start_ns = arrays.start_ns + now_ns - self._node.get_clock().now().nanoseconds if arrays.start_ns else 0
        trajectory = Trajectory.of(
            arrays.names, arrays.time_from_start_ns, arrays.positions, start_ns, axes=compensation.names
        )
        given_ns = self._driver.given_ns + now_ns - time.monotonic_ns()
        driven = [axis.name for axis in compensation.axes if axis.on_ramp]
        following = compensation.following
        following.start(trajectory, self._now_ns, given_ns, driven)
        soon = (following.next_deadline_ns or 0) - self._now_ns() <= MAX_DT * SECOND_NS
        compensation.hold(but=following.names if soon or following.under_way else ())
        self._driver.go_on()
        self._on_simulated = self._simulated
        self._wait()

    def stop(self) -> None:
        """Leave the axes where they are, or come to rest."""
        self._timer.cancel()
        if self._compensation.following.on:
            self._compensation.following.stop()
            self._driver.stop()

    def _on_timer(self) -> None:
        if self._on_simulated != self._simulated:
            self.stop()
            self._node.get_logger().error("use_sim_time was changed: the trajectory's times mean nothing now, stopped")
            return
        # One point at a time: others have their turn even where points come faster than they can be given.
        deadline_ns, now_ns = self._compensation.following.next_deadline_ns, self._now_ns()
        if deadline_ns is not None and deadline_ns <= now_ns:
            self._compensation.follow(now_ns)
            self._publish()
            self.lateness.note(deadline_ns, now_ns)
            self._driver.go_on()
        self._wait()

    def _wait(self) -> None:
        """Set the timer to the next deadline."""
        deadline_ns = self._compensation.following.next_deadline_ns
        if deadline_ns is None:
            self._timer.cancel()
            return
        wait_ns = max(deadline_ns - self._now_ns(), SHORTEST_WAIT_NS)
        self._timer.timer_period_ns = int(SIMULATED_PERIOD * SECOND_NS) if self._simulated else wait_ns
        self._timer.reset()

    @property
    def _simulated(self) -> bool:
        return bool(self._node.get_clock().ros_time_is_active)

    def _now_ns(self) -> int:
        return int(self._node.get_clock().now().nanoseconds) if self._simulated else time.monotonic_ns()


def _as_rclpy_reads(data: bytes) -> TrajectoryArrays:
    """Return what a serialized JointTrajectory says whose points are not alike.

    Raises
    ------
    RejectedError
        If it cannot be read, or a point has not one position for each joint.
    """
    try:
        message = deserialize_message(data, JointTrajectory)
    except RuntimeError as error:
        raise RejectedError(EMPTY, "the message cannot be read; send a JointTrajectory") from error
    stamp, names = message.header.stamp, tuple(message.joint_names)
    for i, point in enumerate(message.points):
        if len(point.positions) != len(names):
            said = f"point {i} has {len(point.positions)} positions for {len(names)} axes"
            raise RejectedError(LENGTH, f"{said}; send one for each")
    times = [point.time_from_start.sec * SECOND_NS + point.time_from_start.nanosec for point in message.points]
    return TrajectoryArrays(
        stamp.sec * SECOND_NS + stamp.nanosec,
        names,
        np.array(times, dtype=np.int64),
        np.array([point.positions for point in message.points], dtype=np.float64).reshape(len(times), len(names)),
    )
