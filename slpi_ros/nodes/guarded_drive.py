"""How exciter and calibrator drive a stage: limits, sole publisher, read-back, watch, return to rest."""

import math
import time
from array import array
from collections.abc import Callable, Sequence
from typing import Any

from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from slpi_ros.calibration.drive_monitor import DriveMonitor
from slpi_ros.compensator.amplifier import TOLERATED_SHARE
from slpi_ros.compensator.listening import all_found, graph_known
from slpi_ros.compensator.monitor import Monitor
from slpi_ros.compensator.reporters import SoleReporter
from slpi_ros.errors import RecordError
from slpi_ros.model.limits import StageLimiter
from slpi_ros.nodes.common import COMMANDS, nanoseconds, publishers_beside, read_state, reliability_of
from slpi_ros.nodes.company import COMMAND, LEFT_NS, STATE, StateProbe
from slpi_ros.nodes.parameters import Values, limits_of

# A voltage is at its goal within this share of the range. Time for the delivery of the last voltage.
ARRIVED, DELIVERY = 1e-6, Duration(seconds=1.0)

OnState = Callable[[bytes, int, Sequence[float]], None]


class GuardedDrive:
    """Drive a stage within its limits, alone, from where it is, and only while it does what it is commanded.

    Every voltage passes `move`, the last place before it is published, which keeps the limits by the steady clock (a
    trajectory for a driver is checked whole); it is called at the rate of the validated parameters `values`, which hold
    axes and limits as well; `state_timeout` is the longest time without a valid state during a drive. `on_state` is
    called with each serialized state, its time on the clock of the node, and its displacements (m), none if it is not
    valid. The name of the node begins messages of errors.
    """

    def __init__(self, node: Node, values: Values, on_state: OnState | None = None, publisher: Any = None) -> None:
        self._node, self._axes, self._on_valid = node, tuple(values["axes"]), on_state
        self.publisher: Any = publisher or node.create_publisher(Float64MultiArray, COMMAND, COMMANDS)
        self.heard = False  # whether anybody publishes, or has published, states
        self.reported: list[float] | None = None  # V, last valid
        self.hardware_id = ""
        state = node.resolve_topic_name(STATE)
        self._reporters = {axis: SoleReporter(axis, lambda: publishers_beside(node, state)) for axis in self._axes}
        self._identity = Monitor(*self._reporters.values())
        self._probe = StateProbe(node)
        self._begun_ns, self._state_ns = time.monotonic_ns(), 0  # of the node; when the first state was heard
        self.prepare(values)

    def prepare(self, values: Values) -> None:
        """Begin a run within the limits and at the rate of the given parameters: nothing is known of the stage."""
        self._limits, self._period = limits_of(values), 1.0 / values["rate"]
        self._limiter = StageLimiter(self._limits, self._period)
        self._goals: Sequence[float] | None = None  # V, None: voltages may not be published yet
        self._since_ns = time.monotonic_ns()
        self._published = self._away = time.monotonic()  # s, of the last voltages; of the last report of others
        simulated = bool(self._node.get_parameter("use_sim_time").value)
        self.monitor = DriveMonitor(self._axes, self._limits, values["state_timeout"], simulated=simulated)

    @property
    def voltages(self) -> tuple[float, ...]:
        """Voltages that were published last, volts; those found at the amplifier before."""
        return self._limiter.voltages

    @property
    def started(self) -> bool:
        """Whether voltages may be published."""
        return self._goals is not None

    def listen(self) -> None:
        """Subscribe to the states with the reliability that their publishers offer; again and again until there are."""
        topic = self._node.resolve_topic_name(STATE)
        if not self.heard and (publishers := self._node.get_publishers_info_by_topic(topic)):
            qos = QoSProfile(depth=1000, reliability=reliability_of(publishers))
            self._node.create_subscription(JointState, STATE, self._on_state, qos, raw=True)
            self.heard = True
        self._probe.poll(self._reporters, time.monotonic_ns())

    # Before a drive

    def company(self) -> str:
        """Return the number and the names of the other publishers of the topic of the voltages, "" if alone."""
        topic = self.publisher.topic_name
        others = self._node.count_publishers(topic) - 1
        if others <= 0:
            return ""
        return f"{others} other publisher of {topic}, {', '.join(publishers_beside(self._node, topic))}"

    def not_alone(self) -> RecordError | None:
        """Return the error if another node publishes the topic of the voltages."""
        if not (company := self.company()):
            return None
        return RecordError(
            f"{self._node.get_name()}: {company}; stop it, as the voltage would jump between the commands of both"
        )

    def overdue(self) -> RecordError | None:
        """Return the error if somebody else still commands or reports the stage when a killed one would have left."""
        if time.monotonic_ns() - self._since_ns <= LEFT_NS:
            return None
        stranger = self.stranger()
        return self.not_alone() or (RecordError(f"{self._node.get_name()}: {stranger}") if stranger else None)

    @property
    def looks(self) -> bool:
        """Whether the middleware has had the time to find everybody."""
        now_ns = time.monotonic_ns()
        # A drive goes over the whole range: it waits for that on a busy machine too.
        return all_found(now_ns, self._begun_ns) and graph_known(now_ns, self._begun_ns, self._state_ns)

    def stranger(self) -> str:
        """Return who else commands or reports the stage, "" if nobody does as far as is known."""
        if company := self.company():
            return f"{company}; stop it"
        if self.looks and self.monitor.moves():
            # The middleware may not have found it yet.
            return "the voltage of the stage moves: another node commands it; stop it"
        return self._second_reporter()

    def _second_reporter(self) -> str:
        """Return which publishers report the same axis, "" if each is reported by one."""
        self._identity.check(time.monotonic_ns())
        return str(next(iter(self._identity.standing), ""))

    def lacking(self) -> str:
        """Return what is missing before a drive may start, with what to do; "" if nothing is."""
        if stranger := self.stranger():
            return stranger
        topic = self._node.resolve_topic_name(STATE)
        if not self.heard:
            return f"no publisher of {topic}; start the driver of the stage, or remap its topic"
        if not self.publisher.get_subscription_count():
            return f"no subscriber of {self.publisher.topic_name}; start the driver of the stage, or remap its topic"
        if self.monitor.refused:
            return f"no valid {topic}: {self.monitor.refused}"
        if self.found() is None:
            return f"no report of the voltage of the axes {', '.join(self._axes)} on {topic}; check the driver"
        return "" if self.looks else "looking who else is there"

    def found(self) -> list[float] | None:
        """Return the voltages (V) at which the amplifier is, as reported; None if they are not known yet."""
        return self.monitor.started_from(time.monotonic_ns(), self._since_ns)

    def start(self, voltages: Sequence[float]) -> None:
        """Start from voltages (V) at which the amplifier is; RecordError beside others, or if one is far outside."""
        if error := self.not_alone():
            raise error
        for axis, limits, v in zip(self._axes, self._limits, voltages, strict=True):
            slack = TOLERATED_SHARE * limits.span
            if not limits.lower - slack <= v <= limits.upper + slack:
                raise RecordError(
                    f"{self._node.get_name()}: axis '{axis}' is at {v:g} V, outside {limits.lower:g} to "
                    f"{limits.upper:g} V; move it inside first"
                )
        self._goals = [limits.clip(v) for limits, v in zip(self._limits, voltages, strict=True)]
        self._limiter.start(self._goals)

    # A drive

    def begin(self) -> None:
        """Begin to hold the states against the voltages."""
        self.monitor.begin(self.voltages, time.monotonic_ns())

    def end(self) -> None:
        """End a drive: the stage is no longer watched."""
        self.monitor.end()

    def move(self, goals: Sequence[float], *, gently: bool = False) -> None:
        """Move all axes towards their goals (V), on demand at a gentle rate, and publish the voltages."""
        now_ns = time.monotonic_ns()
        self._goals, self._published = goals, now_ns * 1e-9
        voltages = self._limiter.step(goals, now_ns, gently=gently)
        self.monitor.command(voltages, now_ns)
        self.publisher.publish(Float64MultiArray(data=array("d", voltages)))

    def hold(self, period: float) -> None:
        """Publish the voltages again if that was `period` (s) ago: a stage that answers commands goes on reporting."""
        if self._goals is not None and time.monotonic() - self._published > period:
            self.move(self._goals)

    def fault(self) -> RecordError | None:
        """Return what speaks against going on with a drive, None if nothing does; call it again and again."""
        fault = self.monitor.check(time.monotonic_ns()) or self._second_reporter()
        return RecordError(f"{self._node.get_name()}: {fault}") if fault else self.not_alone()

    # Return

    def return_step(self, rest: Sequence[float]) -> bool:
        """Move towards rest (V) at the slew limit, gently if there is none; return whether all axes are there."""
        self.move(rest, gently=True)
        return self.at(rest)

    def return_to(self, rest: Sequence[float]) -> None:
        """Return to rest (V), blocking; for the end of the node."""
        while self.started and not self.at(rest):
            self.return_step(rest)
            time.sleep(self._period)
        self.deliver()

    def deliver(self) -> None:
        """Wait for the delivery of the last voltages, which are lost when the process ends."""
        self.publisher.wait_for_all_acked(DELIVERY)

    def return_seconds(self, rest: Sequence[float]) -> float:
        """Return how long the way to rest (V) takes from here, seconds."""
        ways = zip(self.voltages, rest, self._limits, strict=True)
        return max(abs(v - to) / limits.gentle for v, to, limits in ways)

    def at(self, voltages: Sequence[float], share: float = ARRIVED) -> bool:
        """Return whether the voltages published last are the given ones (V), within a share of the range."""
        return self._limiter.within(self.voltages, voltages, share)

    def reports(self, voltages: Sequence[float]) -> bool:
        """Return whether the last valid state reports the given voltages (V), within `TOLERATED_SHARE` of the range."""
        return self.reported is not None and self._limiter.within(self.reported, voltages, TOLERATED_SHARE)

    def settled(self, rest: Sequence[float], since: float, lasts: float, patience: float) -> bool:
        """Return whether states have reported rest (V) for `lasts` (s) `since` (monotonic, s); or for `patience`."""
        now = time.monotonic()
        return (self.reports(rest) and now - max(since, self._away) >= lasts) or now - since >= patience

    def _on_state(self, data: bytes) -> None:
        if (state := read_state(data)) is None:
            return
        volts, metres = (dict(zip(state.name, values, strict=False)) for values in (state.effort, state.position))
        v, y = ([float(values.get(axis, math.nan)) for axis in self._axes] for values in (volts, metres))
        clock_ns = self._node.get_clock().now().nanoseconds
        self._state_ns = self._state_ns or time.monotonic_ns()
        valid = self.monitor.state(nanoseconds(state.header.stamp), clock_ns, v, y, time.monotonic_ns())
        if valid:
            self.reported, self.hardware_id = v, state.header.frame_id
            if not self.reports(self.voltages):
                self._away = time.monotonic()
        if self._on_valid is not None:
            self._on_valid(data, clock_ns, y if valid else ())
