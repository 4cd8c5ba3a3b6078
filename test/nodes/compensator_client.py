"""What stands around a compensator in its tests: a sender of wishes, and ears for what it answers."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from nodes.ros_helpers import RELIABLE, Graph, NodeProcess, on_graph, started, values_of
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

SECOND_NS = 1_000_000_000
START_NS = 1_700_000_000 * SECOND_NS
PERIOD_NS = 5_000_000
# Sent but not yet answered: less than the depth of the compensator's queue.
AHEAD = 50
# Reports are what most tests wait for.
# Without a slew limit the answers are those of the library, one for each message. No amplifier reports its voltage.
QUICK = {"diagnostic_period": 0.2, "slew_limit": 0.0, "start_voltage": "saved"}


class Client:
    """The other end of one compensator."""

    def __init__(self, graph: Graph, node: NodeProcess, namespace: str, names: Mapping[str, str], desired: Any) -> None:
        self.graph, self.node = graph, node
        self._present = False
        self.name = f"{namespace}/compensator"
        self._role = f"{self.name}: compensator"
        self._answers = graph.record(
            Float64MultiArray, names.get("voltage_command", f"{namespace}/voltage_command"), RELIABLE
        )
        self._voltages: list[list[float]] = []
        self._wishes = graph.node.create_publisher(
            desired, names.get("desired_displacement", f"{namespace}/desired_displacement"), RELIABLE
        )
        graph.watch_diagnostics()

    @property
    def answers(self) -> list[list[float]]:
        """All voltages so far, volts; each is converted once, or who looks after each of many falls behind them."""
        self._voltages.extend(list(message.data) for message in self._answers[len(self._voltages) :])
        return self._voltages

    @property
    def answered(self) -> int:
        """Number of answers so far."""
        return len(self._answers)

    @property
    def reports(self) -> list[dict[str, str]]:
        """The values of all reports so far."""
        return [values_of(status) for status in self.graph.statuses(self._role)]

    def report(self, what: str = "a report", **wanted: object) -> tuple[Any, dict[str, str]]:
        """Wait for a report with these key-values; return it and all its values."""
        texts = {key: str(value) for key, value in wanted.items()}
        status = self.graph.wait_for_status(
            self._role, lambda status: texts.items() <= values_of(status).items(), f"{what} {texts}"
        )
        return status, values_of(status)

    def be_present(self, topic: str) -> None:
        """Publish states of no axis: where there is a stage, the compensator looks sooner who else commands it."""
        states = self.graph.node.create_publisher(JointState, topic, RELIABLE)
        self.graph.node.create_timer(0.02, lambda: states.publish(JointState()))
        self._present = True

    def connect(self, state: str = "active") -> "Client":
        """Wait until nothing that is sent can be lost."""
        self.report("the state", state=state)
        if state == "active":
            self.ready()
        if state != "unconfigured":
            self.graph.spin_until(self._wishes.get_subscription_count, "the compensator's ears")
        return self

    def ready(self) -> "Client":
        """Wait until the compensator has looked who else is there, if it has a model."""
        if self._present:
            self.graph.wait_for_status(self._role, _looked, "the look for others")
        return self

    def change_state(self, transition: int) -> bool:
        """Ask for a transition of the lifecycle; return whether it succeeded."""
        request = ChangeState.Request(transition=Transition(id=transition))
        return self.graph.call(ChangeState, f"{self.name}/change_state", request).success

    def publish(self, message: Any) -> None:
        self._wishes.publish(message)

    def wish(self, names: Sequence[str], displacements: Sequence[float], stamp_ns: int = 0) -> None:
        self.publish(wish(names, displacements, stamp_ns))

    def ask(self, names: Sequence[str], displacements: Sequence[float], stamp_ns: int = 0) -> list[float]:
        """Return the voltages for one message."""
        self.ready()
        before = len(self._answers)
        self.wish(names, displacements, stamp_ns)
        self.graph.spin_until(lambda: len(self._answers) > before, "an answer")
        return self.answers[before]

    def wait_for_rest(self, voltage: float) -> None:
        """Wait until the last answer of one axis is this voltage, V."""
        self.graph.spin_until(lambda: self.answers and self.answers[-1] == [voltage], f"{voltage} V")

    def follow(self, names: Sequence[str], path: np.ndarray, start_ns: int = START_NS) -> np.ndarray:
        """Return the voltages, shape (N, axes), for a path, shape (N, names), of one sample every `PERIOD_NS`."""
        self.ready()
        before = len(self._answers)
        for i, row in enumerate(path.tolist()):
            self.wish(names, row, start_ns + i * PERIOD_NS)
            self.graph.spin_until(lambda sent=i: sent - (len(self._answers) - before) < AHEAD, f"answer {i}")
        self.graph.spin_until(lambda: len(self._answers) - before >= len(path), f"{len(path)} answers")
        return np.array(self.answers[before:])


def wish(names: Sequence[str], displacements: Sequence[float], stamp_ns: int = 0) -> JointState:
    """Return a desired message, metres."""
    message = JointState(name=list(names), position=list(displacements))
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, SECOND_NS)
    return message


@contextmanager
def compensator(
    *arguments: str,
    namespace: str = "",
    names: Mapping[str, str] | None = None,
    desired: Any = JointState,
    **parameters: Any,
) -> Iterator[Client]:
    """Start a compensator and stand around it; `names` tells remapped topics."""
    with on_graph() as graph, started("compensator", {**QUICK, **parameters}, *arguments) as node:
        graph.tested = node
        client = Client(graph, node, namespace, names or {}, desired)
        if parameters.get("start_voltage", QUICK["start_voltage"]) not in ("auto", "measured"):
            client.be_present((names or {}).get("stage_state", f"{namespace}/stage_state"))
        yield client


def _looked(status: Any) -> bool:
    """Return whether voltages may be output, or there is no model."""
    values = values_of(status)
    return not values["model.id"] or values["obstacle"] != "starting"
