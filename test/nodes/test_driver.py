"""The driver as a process of its own, between DDS and a simulated controller over TCP."""

import os
import re
import signal
import socket
import subprocess
import sys
from contextlib import contextmanager

import numpy as np
import pytest

pytest.importorskip("rclpy")

from diagnostic_msgs.msg import DiagnosticStatus  # noqa: E402
from nodes.ros_helpers import RELIABLE, NodeProcess, on_graph, started, values_of  # noqa: E402
from sensor_msgs.msg import JointState  # noqa: E402
from std_msgs.msg import Float64MultiArray  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402

from slpi_ros.simulation.devices.base import FAULTS, LATE, LOST, Fault  # noqa: E402
from slpi_ros.simulation.devices.gcs import GcsSimulator  # noqa: E402

RATE, SLEW = 200.0, 500.0
LIMITS = {"voltage_min": 0.0, "voltage_max": 100.0, "slew_limit": SLEW, "rate": RATE}
# Of the limiter at most two periods count at once.
LARGEST_STEP = 2.0 * SLEW / RATE + 2e-6


# What a controller's faults are told as, in the order of `FAULTS`.
REASONS = (
    "no whole answer", "no whole answer", "answered for", "error 17", "no whole answer",
    "without having been|beyond what", "closed the connection|link was lost", "not a name and a number",
    "not a name and a number|answered for|beyond what",
)  # fmt: skip


class Bench:
    """What stands at both ends of a driver."""

    def __init__(self, graph, node):
        self.graph, self.node = graph, node
        graph.tested = node
        self.states = graph.record(JointState, "stage_state")
        self.commands = graph.node.create_publisher(Float64MultiArray, "voltage_command", RELIABLE)
        graph.watch_diagnostics()

    def connect(self):
        self.graph.spin_until(self.commands.get_subscription_count, "the ears of the driver")
        self.graph.spin_until(lambda: self.states, "a state")
        return self

    def status(self, state):
        return self.graph.wait_for_status(
            "/driver: driver", lambda status: values_of(status)["state"] == state, f"the state {state}"
        )

    def reach(self, *voltages):
        """Send voltages until the device says that it has them."""

        def there():
            self.commands.publish(Float64MultiArray(data=list(voltages)))
            return list(self.states[-1].effort) == pytest.approx(list(voltages), abs=1e-4)

        self.graph.spin_until(there, f"{voltages} V")

    def call(self, name):
        return self.graph.call(Trigger, f"/driver/{name}", Trigger.Request())


@contextmanager
def driver(address, **parameters):
    given = {"device": "gcs", "address": address, **LIMITS, **parameters}
    with on_graph() as graph, started("driver", given) as node:
        yield Bench(graph, node)


def largest_step(simulator, begin):
    path = [begin, *(each.voltage for each in simulator.log)]
    return float(np.max(np.abs(np.diff(path)), initial=0.0))


def test_voltages_go_to_the_device_and_positions_come_back():
    channels = {"axes": ["x", "y"], "channels": ["2", "1"], "sensor_offset": [1e-6, 0.0]}
    with GcsSimulator(["1", "2"], voltages=[10.0, 20.0]) as simulator, driver(simulator.address, **channels) as bench:
        bench.connect()
        assert list(bench.states[0].name) == ["x", "y"] and list(bench.states[0].effort) == [20.0, 10.0]
        assert simulator.log == []
        bench.reach(60.0, 30.0)
        assert (simulator.voltage("1"), simulator.voltage("2")) == (30.0, 60.0)
        last, told = bench.states[-1], simulator.move()
        assert list(last.position) == pytest.approx([told[1] + 1e-6, told[0]], abs=2e-9)
        assert "E-727" in last.header.frame_id
        stamps = [state.header.stamp.sec + state.header.stamp.nanosec * 1e-9 for state in bench.states]
        assert all(np.diff(stamps) > 0.0)
        status = bench.status("armed")
        assert status.level < DiagnosticStatus.ERROR and values_of(status)["device"] == f"gcs {simulator.address}"
        answer = bench.call("stop")
        assert answer.success and "60, 30 V" in answer.message
        bench.status("held")
        assert bench.call("arm").success


def test_it_asks_for_the_priority_that_is_given():
    with GcsSimulator() as simulator, driver(simulator.address, realtime_priority=1) as bench:
        bench.connect()
        in_real_time = os.sched_getscheduler(bench.node.process.pid) == os.SCHED_FIFO
        assert in_real_time != ("no realtime_priority 1" in bench.node.stderr)


def test_a_lost_link_is_told_and_nothing_moves_until_it_is_armed():
    with GcsSimulator(voltages=[20.0]) as simulator, driver(simulator.address) as bench:
        bench.connect().reach(40.0)
        simulator.fault = Fault(LOST, seconds=1.5)
        status = bench.status("lost")
        assert status.level == DiagnosticStatus.ERROR and simulator.address in status.message
        assert values_of(status)["since"]
        silent = len(bench.states)
        held = bench.status("held")
        assert "~/arm" in held.message
        bench.graph.spin_until(lambda: len(bench.states) > silent + 5, "states again")
        for _ in range(5):
            bench.commands.publish(Float64MultiArray(data=[80.0]))
        bench.graph.wait_for_status(
            "/driver: driver", lambda status: int(values_of(status)["commands_rejected"]) >= 5, "a rejection"
        )
        assert simulator.voltage("1") == 40.0
        assert bench.call("arm").success
        bench.reach(80.0)
        assert largest_step(simulator, 20.0) <= LARGEST_STEP


@pytest.mark.long
def test_every_fault_is_told_with_its_reason_by_the_next_report_but_one():
    """Reports come every half a second, so this is within a second."""
    causes = dict(zip(FAULTS, REASONS, strict=True))
    with GcsSimulator(voltages=[20.0]) as simulator, driver(simulator.address, rearm=True) as bench:
        bench.connect()
        for fault, cause in causes.items():
            bench.status("armed")
            given = Fault(fault, seconds=0.6 if fault in (LATE, LOST) else 0.0)
            simulator.fault = given
            bench.graph.spin_until(lambda: simulator.fault is not given, fault)  # noqa: B023
            before = len(bench.graph.statuses("/driver: driver"))
            told = bench.status("lost")
            assert re.search(cause, values_of(told)["reason"]), fault
            silent = bench.graph.statuses("/driver: driver")[before:]
            assert [values_of(each)["state"] for each in silent].index("lost") <= 1
        assert int(values_of(bench.status("armed"))["links_lost"]) >= len(FAULTS)
        assert simulator.log == []


@pytest.mark.parametrize(
    ("end", "parameters", "voltage"),
    [(signal.SIGTERM, {}, 60.0), (signal.SIGKILL, {}, 60.0), (signal.SIGINT, {"at_exit": "rest"}, 0.0)],
)
def test_its_end_and_the_next_start(end, parameters, voltage):
    # On a busy machine the simulated device, in this process, may answer too late.
    parameters = {"rearm": True, **parameters}
    with GcsSimulator(voltages=[20.0]) as simulator:
        with driver(simulator.address, **parameters) as bench:
            bench.connect().reach(60.0)
            code = bench.node.stop(end)
            assert code == (-end if end == signal.SIGKILL else 0) and "Traceback" not in bench.node.stderr
        assert simulator.voltage("1") == voltage
        with driver(simulator.address, rearm=True) as bench:
            bench.connect()
            assert list(bench.states[0].effort) == [voltage] and simulator.voltage("1") == voltage
            bench.reach(50.0)
        assert largest_step(simulator, 20.0) <= LARGEST_STEP


# Of each simulated device: where it is served, where the driver finds it, its first channel, V/V of the amplifier.
SIMULATED = {
    "gcs": ("127.0.0.1:{port}", "127.0.0.1:{port}", "1", 1.0),
    "labjack": ("127.0.0.1:{port}", "127.0.0.1:{port}", "DAC0:AIN0", 20.0),
    "nidaqmx": ("127.0.0.1:{port}", "Dev1@127.0.0.1:{port}", "ao0:ai0", 10.0),
    "nv200": ("{folder}/tty", "nv200:{folder}/tty", "1", 1.0),
}


@pytest.mark.parametrize("name", ["gcs", *(pytest.param(name, marks=pytest.mark.long) for name in list(SIMULATED)[1:])])
def test_a_simulated_device_as_a_node(tmp_path, name):
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    served, found, channel, gain = SIMULATED[name]
    place = served.format(port=port, folder=tmp_path)
    given = {"device": name, "address": place, "voltage": 15.0 / gain, "noise_rms": 0.0}
    with started("device_simulator", given) as device:
        # Until it listens, a driver would end.
        while "own range" not in device.stderr:
            assert device.process.poll() is None
        kind = "serial" if name == "nv200" else name
        own = {"device": kind, "channels": [channel], "amplifier_gain": gain, "voltage_max": 90.0, "rate": 100.0}
        with driver(found.format(port=port, folder=tmp_path), rearm=True, **own) as bench:
            bench.connect()
            assert list(bench.states[0].effort) == pytest.approx([15.0], abs=1e-4)
            bench.reach(25.0)
            assert bench.graph.set_parameters("/device_simulator", fault="half") == ""
            lost = bench.graph.wait_for_status(
                "/driver: driver", lambda status: values_of(status)["links_lost"] == "1", "the loss"
            )
            assert kind in values_of(lost)["device"]
            bench.reach(35.0)


@pytest.mark.parametrize(
    ("parameters", "code", "complaint"),
    [
        ({"device": "abacus"}, 2, "abacus"),
        ({"address": ""}, 2, "address"),
        ({"voltage_min": float("nan")}, 2, "voltage_min"),
        ({"voltage_min": 110.0}, 2, "voltage_min 110 and voltage_max 100 V"),
        ({"channels": ["1", "2"]}, 2, "channels"),
        ({"sensor_scale": 0.0}, 2, "sensor_scale"),
        ({"at_exit": "rest", "rest_voltage": 200.0}, 2, "rest_voltage"),
        ({"voltage_max": 130.0}, 1, "own range"),
        ({"channels": ["A"]}, 1, "'A'"),
        ({"address": "127.0.0.1:1"}, 1, "127.0.0.1:1"),
    ],
)
def test_what_cannot_work_ends_with_one_line(parameters, code, complaint):
    with GcsSimulator() as simulator:
        process = NodeProcess("driver", {"device": "gcs", "address": simulator.address, **LIMITS, **parameters}, ())
        try:
            assert process.wait() == code
            said = process.stderr
        finally:
            process.kill()
    assert complaint in said and "Traceback" not in said and len(said.splitlines()) == 1


def test_a_misspelt_parameter_is_told():
    given = {"device": "gcs", "address": "127.0.0.1:1", **LIMITS, "slew_limt": 10.0}
    process = NodeProcess("driver", given, ())
    try:
        assert process.wait() == 1
        said = process.stderr
    finally:
        process.kill()
    assert "slew_limt" in said and "slew_limit" in said


def test_when_commands_cease_it_holds_and_says_so():
    with GcsSimulator(voltages=[20.0]) as simulator, driver(simulator.address, voltage_timeout=1.0) as bench:
        bench.connect()
        quiet = bench.status("armed")
        assert "voltage_command" not in quiet.message
        bench.reach(40.0)
        told = bench.graph.wait_for_status(
            "/driver: driver", lambda status: "no voltage_command" in status.message, "the silence"
        )
        assert told.level == DiagnosticStatus.WARN and values_of(told)["state"] == "armed"
        assert simulator.voltage("1") == 40.0
        bench.reach(50.0)
        bench.graph.wait_for_status(
            "/driver: driver", lambda status: "no voltage_command" not in status.message, "commands again"
        )


COMMANDER = """
import time, rclpy
from std_msgs.msg import Float64MultiArray
rclpy.init()
node = rclpy.create_node("commander")
publisher = node.create_publisher(Float64MultiArray, "voltage_command", 10)
while True:
    publisher.publish(Float64MultiArray(data=[70.0]))
    time.sleep(0.01)
"""


def test_a_commander_that_dies_leaves_the_stage_at_rest():
    rest = {"voltage_timeout": 1.0, "at_silence": "rest", "rest_voltage": 10.0}
    with GcsSimulator(voltages=[20.0]) as simulator, driver(simulator.address, **rest) as bench:
        bench.connect()
        commander = subprocess.Popen([sys.executable, "-c", COMMANDER])
        try:
            bench.graph.spin_until(lambda: bench.states[-1].effort[0] == 70.0, "70 V")
        finally:
            commander.kill()
            commander.wait()
        held = bench.status("held")
        assert held.level == DiagnosticStatus.WARN and "~/arm" in held.message
        bench.graph.spin_until(lambda: bench.states[-1].effort[0] == 10.0, "rest")
        assert largest_step(simulator, 20.0) <= LARGEST_STEP
        # Whoever comes back does not move it.
        before = int(values_of(held)["commands_rejected"])
        for _ in range(5):
            bench.commands.publish(Float64MultiArray(data=[50.0]))
        bench.graph.wait_for_status(
            "/driver: driver", lambda status: int(values_of(status)["commands_rejected"]) >= before + 5, "a rejection"
        )
        assert simulator.voltage("1") == 10.0
        assert bench.call("arm").success
        bench.reach(50.0)


def test_a_unit_that_is_none_of_a_stage_is_told():
    with (
        GcsSimulator(unit="MM", without=["PUN?"]) as simulator,
        driver(simulator.address) as bench,
    ):
        told = bench.status("armed")
        assert told.level == DiagnosticStatus.WARN and "25 nm" in told.message and "sensor_scale" in told.message


def ends(parameters):
    """Return the exit code of a driver, and what it says."""
    process = NodeProcess("driver", {"device": "gcs", **LIMITS, **parameters}, ())
    try:
        return process.wait(), process.stderr
    finally:
        process.kill()


SERIALS = "E-727.SIMULATED, serial number {}"


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ({"hardware_id": "P-611"}, {"hardware_id": "P-611"}),
        ({}, {}),
        pytest.param({"hardware_id": SERIALS.format(7)}, {}, marks=pytest.mark.long),
        pytest.param({"hardware_id": "world"}, {}, marks=pytest.mark.long),
    ],
)
def test_a_second_driver_of_a_stage_does_not_begin(first, second):
    with (
        GcsSimulator(serial="7") as simulator,
        GcsSimulator(serial="7") as other,
        driver(simulator.address, **first) as bench,
    ):
        bench.connect()
        code, said = ends({"address": other.address, **second})
        assert code == 1 and "/driver" in said and len(said.splitlines()) == 1
        assert other.log == [] and bench.status("armed")


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ({}, {}),
        pytest.param({"hardware_id": "A"}, {"hardware_id": "B"}, marks=pytest.mark.long),
        pytest.param({}, {"axes": ["y"]}, marks=pytest.mark.long),
    ],
)
def test_another_stage_or_axis_beside_begins(first, second):
    with (
        GcsSimulator(serial="7") as simulator,
        GcsSimulator(serial="7" if "axes" in second else "8") as other,
        driver(simulator.address, **first) as bench,
    ):
        own = bench.connect().states[-1]
        given = {"device": "gcs", "address": other.address, **LIMITS, **second}

        def heard():
            return any((each.header.frame_id, each.name) != (own.header.frame_id, own.name) for each in bench.states)

        with started("driver", given):
            bench.graph.spin_until(heard, "the other stage")


def test_a_driver_whose_device_is_in_use_names_the_other():
    with GcsSimulator() as simulator, driver(simulator.address) as bench:
        bench.connect()
        code, said = ends({"address": simulator.address})
        assert code == 1 and "/driver" in said and simulator.address in said and len(said.splitlines()) == 1


def test_the_name_of_a_stage_is_the_number_of_its_device():
    with GcsSimulator(serial="0042") as simulator, driver(simulator.address) as bench:
        assert bench.connect().states[0].header.frame_id == SERIALS.format("0042")
    with GcsSimulator(serial="0") as simulator, driver(simulator.address) as bench:
        assert bench.connect().states[0].header.frame_id == ""
