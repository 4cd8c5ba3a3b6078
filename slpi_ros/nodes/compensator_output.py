"""What a compensator publishes: voltages, blocks of voltages, tracking errors and uncertainties."""

import time
from datetime import UTC, datetime

import numpy as np
from rclpy.duration import Duration
from rclpy.lifecycle import LifecycleNode
from rclpy.qos_overriding_options import QoSOverridingOptions
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from trajectory_msgs.msg import JointTrajectory

from slpi_ros.compensator.block import Block
from slpi_ros.compensator.controller import Controller, OperatingMode, watch_uncertainty
from slpi_ros.compensator.listening import REPEAT_NS
from slpi_ros.io.cdr import multiarray_header
from slpi_ros.io.messages import encode_trajectory
from slpi_ros.nodes.common import COMMANDS, DIAGNOSTICS
from slpi_ros.nodes.company import Company
from slpi_ros.nodes.compensator_diagnostics import Reporter
from slpi_ros.nodes.compensator_memory import Memory

# History, depth and reliability, by parameters qos_overrides./TOPIC.{publisher,subscription}.POLICY.
OVERRIDABLE = QoSOverridingOptions.with_default_policies()
# Time to wait at shutdown for the delivery of the last voltages.
PATIENCE = Duration(seconds=1.0)


class Output:
    """The publishers of a configured compensator."""

    def __init__(
        self, node: LifecycleNode, controller: Controller, memory: Memory, reporter: Reporter, company: Company
    ) -> None:
        self._company = company
        self._node, self._controller, self._memory, self._reporter = node, controller, memory, reporter
        self._header = multiarray_header(len(controller.names))
        self._published, self._published_ns = False, 0  # since the last look; when that was
        self._voltages = node.create_lifecycle_publisher(
            Float64MultiArray, "voltage_command", COMMANDS, qos_overriding_options=OVERRIDABLE
        )
        self._errors = node.create_lifecycle_publisher(JointState, "tracking_error", DIAGNOSTICS)
        self._uncertainties = node.create_lifecycle_publisher(JointState, "displacement_uncertainty", DIAGNOSTICS)
        self._blocks = node.create_lifecycle_publisher(JointTrajectory, "voltage_trajectory", COMMANDS)

    def destroy(self) -> None:
        """Destroy the publishers."""
        for publisher in (self._voltages, self._errors, self._uncertainties, self._blocks):
            self._node.destroy_lifecycle_publisher(publisher)

    def publish(self) -> None:
        """Publish the present voltages."""
        # As bytes: creating a message object takes longer than compensating an axis.
        voltages = self._controller.voltages.tobytes()
        self._memory.note(voltages)
        message = self._header + voltages
        if self._company.listens:
            self._company.own.add(message)
        self._voltages.publish(message)
        self._published = True

    def wait(self) -> None:
        """Wait until the voltages have been delivered: those that have not are lost when the process ends."""
        self._voltages.wait_for_all_acked(PATIENCE)

    def repeat(self, now_ns: int) -> None:
        """Publish the voltages again if nothing else was output for some time, so that others hear who commands."""
        if self._published:
            self._published, self._published_ns = False, now_ns
        elif self._published_ns and now_ns - self._published_ns >= REPEAT_NS:
            repeats = self._controller.ownership.owned and self._controller.mode is not OperatingMode.BLOCK
            if repeats:
                self.publish()

    def publish_block(self, block: Block) -> None:
        """Publish a block of voltages."""
        none = np.zeros((len(block.voltages), 0))
        self._blocks.publish(encode_trajectory(block.stamp_ns, block.names, block.times_ns, none, block.voltages))

    def stop_block(self) -> None:
        """Ask the driver to hold where it is; it tells at which sample."""
        self._blocks.publish(JointTrajectory())

    def publish_tracking_errors(self) -> None:
        """Publish the tracking errors of all axes if any axis was measured since the last call."""
        if not any(axis.tracking.fresh for axis in self._controller.axes):
            return
        message = JointState()
        for axis in self._controller.axes:
            report = axis.tracking.report()
            message.name += [axis.name, f"{axis.name}.mean", f"{axis.name}.rms", f"{axis.name}.maximum"]
            message.position.extend([report.latest, report.mean, report.rms, report.maximum])
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._errors.publish(message)

    def publish_uncertainty(self) -> None:
        """Publish where the axes are and how uncertain that is, if anybody listens; else it is not computed."""
        wanted, axes = self._uncertainties.get_subscription_count() > 0, self._controller.axes
        why = watch_uncertainty(axes, self._controller.model, wanted, datetime.now(UTC), time.monotonic_ns())
        self._reporter.log.remark("uncertainty", f"displacement_uncertainty is not published: {why}" if why else "")
        known = [(axis, spread) for axis in axes if (spread := axis.uncertainty.present) is not None]
        if why or not known:
            return
        message = JointState(name=[axis.name for axis, _ in known])
        message.position.extend(axis.expected for axis, _ in known)
        message.effort.extend(spread for _, spread in known)
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._uncertainties.publish(message)
