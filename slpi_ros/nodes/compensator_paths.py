"""Paths that a compensator knows in advance: trajectories, blocks for a device, and what is learned of both."""

import time

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.node import Node

from slpi_ros.compensator.block import ACCEPTED, PLAYING
from slpi_ros.compensator.controller import Controller, OperatingMode, StopReason
from slpi_ros.compensator.validation import STALE, RejectedError
from slpi_ros.devices.block import block_values
from slpi_ros.errors import shown
from slpi_ros.io.messages import TrajectoryArrays, decode_trajectory
from slpi_ros.nodes.common import DeferredService, read_trajectory
from slpi_ros.nodes.compensator_diagnostics import Reporter
from slpi_ros.nodes.compensator_memory import Memory
from slpi_ros.nodes.compensator_output import Output
from slpi_ros.nodes.path_learning import OFF, PathLearning


class Paths:
    """Begin and end the paths that come as trajectories; they are learned from where that is switched on."""

    output: Output  # of the configured node

    def __init__(
        self, node: Node, controller: Controller, learning: PathLearning, memory: Memory, reporter: Reporter
    ) -> None:
        self._node, self._controller, self._learning = node, controller, learning
        self._memory, self._reporter = memory, reporter
        self._on_simulated = False  # whether the times of the trajectory are those of a simulated clock
        self._forget_service = DeferredService(node, "~/forget", self._on_forget)

    # Clocks

    def clocks(self) -> tuple[int, int]:
        """Return the times on the monotonic clock and on the trajectory clock, nanoseconds."""
        now_ns = time.monotonic_ns()
        return now_ns, self._node.get_clock().now().nanoseconds if self.simulated else now_ns

    @property
    def simulated(self) -> bool:
        """Whether the clock of the node is a simulated one."""
        return bool(self._node.get_clock().ros_time_is_active)

    def check_clock(self, now_ns: int) -> None:
        """Cancel a trajectory whose times are of another clock than that of the node now."""
        if self._controller.trajectory.on and self._on_simulated != self.simulated:
            self._controller.stop(StopReason.CANCELED, now_ns)
            self._node.get_logger().error(
                "use_sim_time was changed: trajectory canceled, as its times are no longer valid"
            )

    # Trajectories and blocks

    def on_trajectory(self, data: bytes) -> None:
        """Begin a trajectory, as samples or as a block; an empty one cancels."""
        controller, path = self._controller, read_trajectory(data)
        now_ns, clock_ns = self.clocks()
        points = path.time_from_start_ns.size
        start_ns = path.start_ns + clock_ns - self._node.get_clock().now().nanoseconds if path.start_ns else 0
        try:
            if controller.mode is OperatingMode.BLOCK and not points:
                self.output.stop_block()
                return
            if self._reporter.settings.values["trajectory_output"] == "block" and points:
                said = self._send_block(path, start_ns > clock_ns)
            else:
                said = self._follow(path, start_ns, now_ns, clock_ns)
        except RejectedError as error:
            self._reporter.reject(error)
            return
        self._node.get_logger().info(said)
        self._reporter.report()

    def _follow(self, given: TrajectoryArrays, start_ns: int, now_ns: int, clock_ns: int) -> str:
        """Begin a trajectory that is output sample by sample; return what is logged of it."""
        path, samples = self._learning.corrected(given.names, given.time_from_start_ns, given.values)
        self._controller.follow(*samples, start_ns, now_ns, clock_ns)
        self._learning.begin(path, start_ns, clock_ns)
        self._on_simulated = self.simulated
        return f"trajectory: {self._controller.trajectory.remaining} points to come"

    def _send_block(self, given: TrajectoryArrays, later: bool) -> str:
        """Publish a trajectory as one block of voltages; return what is logged of it."""
        if later:
            raise RejectedError(STALE, "a block begins as soon as the device has it; stamp the trajectory 0")
        path, samples = self._learning.corrected(given.names, given.time_from_start_ns, given.values, as_block=True)
        stamp_ns = self._node.get_clock().now().nanoseconds
        block = self._controller.follow_block(*samples, time.monotonic_ns(), stamp_ns)
        self._learning.begin_block(path, block)
        self.output.publish_block(block)
        return f"block: {len(block.voltages)} samples of {block.period:g} s, the path begins after {block.lead_in}"

    def on_block_state(self, status: DiagnosticStatus) -> None:
        """Take what a driver tells of a block."""
        listening = self._controller.ownership.listening
        if listening:
            listening.play(status.message in (ACCEPTED, PLAYING), time.monotonic_ns())
        found = block_values({each.key: each.value for each in status.values})
        if found is None:
            return
        stamp_ns, sample, reason = found
        if self._controller.hear_block(stamp_ns, status.message, sample, reason, time.monotonic_ns()):
            block = self._controller.block
            assert block
            said = f"block {shown(block.state)} at sample {block.sample}{': ' if reason else ''}{shown(reason)}"
            if block.state == "ended":
                self._node.get_logger().info(said)
            else:
                self._node.get_logger().warning(said)
            self._memory.save(complete=False)
            self._reporter.report()

    def on_recorded(self, data: bytes) -> None:
        """Take what a device has recorded of a block."""
        if self._learning.mode == OFF:
            return
        read, applied = decode_trajectory(data), decode_trajectory(data, "effort")
        if read and applied:
            self._learning.passes.recorded(
                read.start_ns, read.names, read.time_from_start_ns, read.values, applied.values
            )

    def _on_forget(self) -> str:
        """Forget what was learned; answered when the files are removed."""
        self._learning.forget()
        return ""

    def on_forgotten(self, count: int) -> None:
        """Answer whether what was learned of so many paths is forgotten."""
        left = self._learning.not_forgotten
        self._forget_service.answer(not left, left or f"forgotten: {count} {'path' if count == 1 else 'paths'}")
        self._reporter.report()
