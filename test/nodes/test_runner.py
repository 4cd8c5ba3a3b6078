"""The shared life of a node process: how it starts, and every way in which it ends."""

import signal
import subprocess
import sys

import pytest

rclpy = pytest.importorskip("rclpy")

from nodes.ros_helpers import on_graph, started  # noqa: E402

from slpi_ros.errors import UsageError  # noqa: E402
from slpi_ros.nodes.common import make_executor  # noqa: E402
from slpi_ros.nodes.stop import PATIENT_SIGNALS  # noqa: E402

PATIENCE_S = 60.0

NODE = """
import sys
import time
from rclpy.node import Node
from std_msgs.msg import String
from slpi_ros.errors import RecordError, UsageError
from slpi_ros.nodes import common
from slpi_ros.nodes.common import request_stop, run

what, executor = sys.argv[1:3]


class Example(Node):
    def __init__(self):
        if what == "refuse":
            raise UsageError("refused: try another")
        super().__init__("example")
        self.declare_parameter("number", 1.0)
        self.said = self.create_publisher(String, "said", 1)
        if what == "build":
            print("up", flush=True)
            time.sleep(0.5)
        while what == "hang":
            print(common._stop.signals, flush=True)
            time.sleep(0.05)
        self.create_timer(0.01, self.tick)

    def tick(self):
        if what == "stop":
            request_stop()
        elif what == "fail":
            request_stop(RecordError("failed: first"))
            request_stop(RecordError("failed: second"))
        elif what == "shutdown":
            import rclpy
            rclpy.try_shutdown()
        elif what == "raise":
            raise RecordError("raised: sorry")
        elif what == "bug":
            raise ZeroDivisionError
        print("up", flush=True)

    def destroy_node(self):
        if what != "shutdown":
            self.said.publish(String(data="the context is still valid"))
        print("destroyed", flush=True)
        super().destroy_node()
        if what == "destroy":
            raise RecordError("failed: at the end")


sys.exit(run(Example, executor=executor))
"""

both_executors = pytest.mark.parametrize("executor", ["events", "default"])


def start(what: str, executor: str = "events", *arguments: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", NODE, what, executor, *arguments]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def finish(process: subprocess.Popen[str]) -> tuple[int, str, str]:
    """Return exit code, output and errors of a process that ends by itself."""
    try:
        output, errors = process.communicate(timeout=PATIENCE_S)
    finally:
        process.kill()
    return process.returncode, output, errors


@both_executors
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_signal_ends_in_order(executor, number):
    process = start("spin", executor)
    assert process.stdout.readline() == "up\n"
    process.send_signal(number)
    code, output, errors = finish(process)
    assert (code, errors) == (0, "")
    assert output.endswith("destroyed\n")


def test_hangup_that_is_ignored_at_the_start_stays_so():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        process = start("spin")
    finally:
        signal.signal(signal.SIGHUP, before)
    assert process.stdout.readline() == "up\n"
    process.send_signal(signal.SIGHUP)
    for _ in range(20):
        assert process.stdout.readline() == "up\n"
    process.send_signal(signal.SIGTERM)
    assert finish(process)[::2] == (0, "")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signal_while_the_node_is_made_ends_in_order(number):
    # it may be subscribed already, and what it holds must not be lost
    process = start("build")
    assert process.stdout.readline() == "up\n"
    process.send_signal(number)
    assert finish(process) == (0, "destroyed\n", "")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_interrupt_a_start_that_hangs(number):
    process = start("hang")
    for noted in range(PATIENT_SIGNALS + 1):
        # the system merges signals that wait, so each is sent when the one before has been seen
        assert any(line == f"{noted}\n" for line in process.stdout)
        process.send_signal(number)
    code, output, errors = finish(process)
    assert (code, errors) == (0, "")
    assert "destroyed" not in output


@both_executors
@pytest.mark.parametrize(
    ("what", "code", "says"),
    [
        ("stop", 0, ""),
        ("shutdown", 0, ""),
        ("fail", 1, "failed: first\n"),
        ("refuse", 2, "refused: try another\n"),
    ],
)
def test_end(executor, what, code, says):
    process = start(what, executor)
    exit_code, output, errors = finish(process)
    assert (exit_code, errors) == (code, says)
    assert ("destroyed" in output) == (what != "refuse")


def test_failure_while_ending():
    process = start("destroy")
    assert process.stdout.readline() == "up\n"
    process.send_signal(signal.SIGINT)
    assert finish(process)[::2] == (1, "failed: at the end\n")


@both_executors
def test_error_that_leaves_a_callback(executor):
    code, output, errors = finish(start("raise", executor))
    assert code == 1
    assert errors.splitlines()[-1] == "raised: sorry"
    assert output.endswith("destroyed\n")


@both_executors
def test_bug_is_not_hidden(executor):
    code, output, errors = finish(start("bug", executor))
    assert code == 1
    assert "ZeroDivisionError" in errors
    assert output.endswith("destroyed\n")


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["-p", "number:=3"], "'number' to '3' of type 'INTEGER', expecting type 'DOUBLE'"),
        (["-p", "number"], "Couldn't parse parameter override rule"),
        (["--no-such-thing"], "--no-such-thing"),
    ],
)
def test_command_line_that_ros_refuses(arguments, says):
    code, _, errors = finish(start("stop", "events", "--ros-args", *arguments))
    assert code == 2
    assert "Traceback" not in errors
    assert says in errors.splitlines()[-1]


def test_executor_that_does_not_exist():
    with pytest.raises(UsageError, match="events.*default"):
        make_executor("fast")


LIMITS = {"voltage_min": 0.0, "voltage_max": 100.0}
# Parameters of each program, and its exit code if it is ended before it has done anything.
PROGRAMS = {
    "calibrator": (LIMITS, 1),
    "compensator": ({}, 0),
    "device_simulator": ({"address": "127.0.0.1:0"}, 0),
    "exciter": (LIMITS | {"rest_voltage": 0.0}, 0),
    "identify": ({}, 0),
    "recorder": ({}, 1),
    "stage_simulator": ({}, 0),
}


@pytest.mark.parametrize("name", PROGRAMS)
def test_each_program_starts_as_from_a_shell(name, tmp_path):
    """Other tests start it by a fork."""
    given, code = PROGRAMS[name]
    output = {"output": str(tmp_path / "out")} if name in ("calibrator", "recorder") else {}
    with on_graph() as graph, started(name, given | output, fresh=True) as node:
        graph.tested = node
        graph.spin_until(lambda: name in graph.node.get_node_names(), "the node")
        assert node.stop() == code
        assert "Traceback" not in node.stderr
