"""Faults around a compensator, as real processes over DDS.

After each one the node answers what a compensator without ROS answers that has seen the valid samples only.
"""

import math
import signal
import subprocess
import sys
import time
from itertools import groupby
from pathlib import Path

import numpy as np
import pytest

rclpy = pytest.importorskip("rclpy")

from builtin_interfaces.msg import Time  # noqa: E402
from nodes.compensator_client import SECOND_NS, START_NS, Client, compensator  # noqa: E402
from nodes.ros_helpers import LATCHED, RELIABLE, stage_model, voltage_path  # noqa: E402
from rosgraph_msgs.msg import Clock  # noqa: E402
from std_msgs.msg import Float64, String  # noqa: E402

from slpi_ros.compensator.controller import Controller  # noqa: E402
from slpi_ros.model.document import format_model, save_model  # noqa: E402
from slpi_ros.model.limits import Limits  # noqa: E402
from slpi_ros.model.stage_model import StageModel  # noqa: E402

AXES = ["x", "y"]
MODEL = stage_model(AXES)
LOW, HIGH = 2.0, 98.0
# Without a slew limit the answers do not depend on when they are given.
LIMITS = {"voltage_min": LOW, "voltage_max": HIGH, "slew_limit": 0.0}
MS = 1_000_000
NAN, INF = math.nan, math.inf


@pytest.fixture
def model_file(tmp_path: Path) -> str:
    path = tmp_path / "xy.json"
    save_model(MODEL, path)
    return str(path)


def desired(samples: int, seed: int = 0) -> list[list[float]]:
    paths = [
        0.95 * MODEL.axis(axis).simulate(np.arange(samples), voltage_path(samples, seed + i))
        for i, axis in enumerate(AXES)
    ]
    return np.column_stack(paths).tolist()


class Twin:
    """What the node must be like: a compensator without ROS, and the promises that every answer has to keep."""

    def __init__(self, model: StageModel = MODEL) -> None:
        self.controller = Controller(AXES, [Limits(LOW, HIGH)] * 2)
        self.controller.activate(0)
        self.controller.use_model(model)
        self.answers: list[list[float]] = []

    def wish(self, row: list[float], stamp_ns: int) -> None:
        """Take a valid sample."""
        self.controller.update(stamp_ns, AXES, row, 0)
        answer = list(self.controller.voltages)
        assert all(LOW <= v <= HIGH for v in answer)
        self.answers.append(answer)


def settle(client: Client, twin: Twin) -> None:
    """Wait for all answers, and compare: a compensator that has nothing new to say repeats its voltages."""
    wanted = distinct(twin.answers)
    client.graph.spin_until(lambda: len(distinct(client.answers)) >= len(wanted), f"{len(wanted)} answers")
    assert distinct(client.answers) == wanted


def distinct(answers: list[list[float]]) -> list[list[float]]:
    """Return answers without those that repeat the one before."""
    return [answer for answer, _ in groupby(answers)]


BAD = [
    (AXES, [1e-6, NAN]), (AXES, [INF, 1e-6]), (AXES, [-INF, 1e-6]), (["x", "z"], [1e-6, 1e-6]), ([], [1e-6, 1e-6]),
    ([], []), (["x", "x"], [1e-6, 1e-6]), (AXES, [1e-6]), (["x"], [1e-6, 1e-6]), (["X", "Y"], [1e-6, 1e-6]),
    (AXES, [1e-6, 1.0]), (AXES, [1e300, 1e-6]), ([""], [1e-6]), (["x"] * 1000, [1e-6] * 1000),
]  # fmt: skip


def test_a_sender_that_does_everything_wrong(model_file):
    """One node suffers it all, one fault after the other, and always while it moves."""
    rows = iter(desired(800))
    twin, now = Twin(), START_NS
    rejected = dict.fromkeys(("duplicate", "time_backwards"), 0)
    with compensator(axes=AXES, model_file=model_file, **LIMITS) as client:
        client.connect()

        def valid(step_ns: int = 5 * MS, count: int = 10, waiting: bool = True) -> None:
            nonlocal now
            for row in (next(rows) for _ in range(count)):
                now += step_ns
                client.wish(AXES, row, now)
                twin.wish(row, now)
            if waiting:
                settle(client, twin)

        valid()
        for names, row in BAD:
            client.wish(names, row, now + 1)
            valid(count=1)
        # Duplicated, and reordered by a second at most.
        for back_ns in (0, 0, 1, 5 * MS, 300 * MS, SECOND_NS):
            client.wish(AXES, [1e-6, 1e-6], now - back_ns)
            rejected["time_backwards" if back_ns else "duplicate"] += 1
            valid(count=2)
        # The clock is set forward, and back again, by a lot; single stamps are from nowhere.
        for jump_ns in (100 * SECOND_NS, -100 * SECOND_NS, 10**6 * SECOND_NS, -(10**6) * SECOND_NS, -3 * SECOND_NS):
            now += jump_ns
            valid()
        for far_ns in (10**6 * SECOND_NS, -(10**6) * SECOND_NS):
            lonely = next(rows)
            client.wish(AXES, lonely, now + far_ns)
            twin.wish(lonely, now + far_ns)
            valid()
        # Bursts: ten times as fast, and all at once.
        for _ in range(3):
            valid(step_ns=MS // 2, count=90)
        valid()
        # Silence, by the clock and by the stamps.
        time.sleep(5.0)
        valid(step_ns=5 * SECOND_NS, count=1)
        valid()
        status, values = client.report(accepted=len(twin.answers), rejected=len(BAD) + sum(rejected.values()))
        assert {cause: int(values[f"rejected.{cause}"]) for cause in rejected} == rejected
        assert (values["time_jumps"], values["gaps"]) == ("5", "5")
        assert client.node.process.poll() is None and "Traceback" not in client.node.stderr


PUBLISHER = """
import sys, time, json, rclpy
from rclpy.qos import QoSProfile
from sensor_msgs.msg import JointState
rows, start, period = json.loads(sys.stdin.readline())
rclpy.init()
node = rclpy.create_node("planner")
publisher = node.create_publisher(JointState, "desired_displacement", QoSProfile(depth=5000))
while not publisher.get_subscription_count():
    time.sleep(0.01)
message = JointState(name=["x", "y"])
allowed = 0
for i, row in enumerate(rows):
    while i >= allowed:
        allowed = int(sys.stdin.readline())
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(start + i * period, 1_000_000_000)
    message.position = row
    publisher.publish(message)
    time.sleep(period * 1e-9)
"""


def test_a_publisher_killed_in_the_middle_of_a_move(model_file):
    rows = desired(4000)
    with compensator(axes=AXES, model_file=model_file, **LIMITS) as client:
        client.connect()
        planner = subprocess.Popen([sys.executable, "-c", PUBLISHER], stdin=subprocess.PIPE, text=True)
        try:
            assert planner.stdin
            planner.stdin.write(f"[{rows}, {START_NS}, {2 * MS}]\n")
            # Never more on their way than the queue of a busy compensator holds.
            for allowed in range(40, 400, 20):
                planner.stdin.write(f"{allowed}\n")
                planner.stdin.flush()
                client.graph.spin_until(lambda: client.answered > allowed - 40, "answers to the planner")  # noqa: B023
        finally:
            planner.send_signal(signal.SIGKILL)
            planner.wait()

        # What it had sent is answered, nothing else comes: the voltage is held.
        def at_rest() -> bool:
            last = client.reports[-1]
            return last["rate_hz"] == "0.0" and int(last["accepted"]) == client.answered

        client.graph.spin_until(at_rest, "the last answer")
        sent = client.answered
        assert sent < len(rows)
        twin = Twin()
        for i, row in enumerate(rows[:sent]):
            twin.wish(row, START_NS + 2 * MS * i)
        settle(client, twin)
        # Another one goes on.
        for i, row in enumerate(rows[sent : sent + 50]):
            client.wish(AXES, row, START_NS + 2 * MS * (sent + i))
            twin.wish(row, START_NS + 2 * MS * (sent + i))
        settle(client, twin)


def test_a_node_killed_and_started_again(model_file):
    rows = desired(300)
    for life in range(2):
        with compensator(axes=AXES, model_file=model_file, **LIMITS) as client:
            client.connect()
            twin = Twin()
            for i, row in enumerate(rows[100 * life : 100 * life + 90]):
                stamp = START_NS + (100 * life + i) * 5 * MS
                client.wish(AXES, row, stamp)
                twin.wish(row, stamp)
            settle(client, twin)
            client.wish(AXES, rows[100 * life + 90], stamp + 5 * MS)
            client.node.stop(signal.SIGKILL)
            client.graph.tested = None


def test_two_hundred_models_during_motion(model_file):
    """Each takes over at a known sample, so that every answer is known."""
    rows, twin = desired(800), Twin()
    rng = np.random.default_rng(11)
    with compensator(axes=AXES, model_file=model_file, **LIMITS) as client:
        client.connect()
        models = client.graph.publisher(String, "/stage_model", LATCHED)
        for i in range(200):
            for k, row in enumerate(rows[4 * i : 4 * i + 4]):
                client.wish(AXES, row, START_NS + (4 * i + k) * 2 * MS)
                twin.wish(row, START_NS + (4 * i + k) * 2 * MS)
            settle(client, twin)
            model = stage_model(AXES, stroke=10e-6 * rng.uniform(0.95, 1.2))
            model = StageModel(model.axes, model.hardware_id, f"model {i}")
            models.publish(String(data=format_model(model)))
            client.report("the new model", **{"model.created": f"model {i}"})
            before = list(twin.controller.voltages)
            twin.controller.use_model(model)
            assert list(twin.controller.voltages) == before
        _, values = client.report(models_refused=0)
        assert "Traceback" not in client.node.stderr


def test_hostile_models_during_motion(model_file):
    rows, twin = desired(400), Twin()
    good = format_model(stage_model(AXES, stroke=9e-6))
    cut = [good[: int(len(good) * share)] for share in (0.0, 0.1, 0.5, 0.99)]
    with compensator(axes=AXES, model_file=model_file, hardware_id="stage under test", **LIMITS) as client:
        client.connect()
        models = client.graph.publisher(String, "/stage_model", LATCHED)
        hostile = [
            *cut, good.replace("stage under test", "another stage"), good.replace('"y"', '"z"'),
            good.replace("0.0", "1e999", 1), good + good, "\0" * 1000, good.replace("[0.0, 100.0]", "[300.0, 400.0]"),
            " " * 4_000_001, "{" * 100_000, good.replace('"slpi"', '"smpi"'),
        ]  # fmt: skip
        for i, text in enumerate(hostile):
            for k, row in enumerate(rows[4 * i : 4 * i + 4]):
                client.wish(AXES, row, START_NS + (4 * i + k) * 2 * MS)
                twin.wish(row, START_NS + (4 * i + k) * 2 * MS)
            settle(client, twin)
            models.publish(String(data=text))
            client.report(models_refused=i + 1)
        for k, row in enumerate(rows[-20:]):
            client.wish(AXES, row, START_NS + SECOND_NS + k * 2 * MS)
            twin.wish(row, START_NS + SECOND_NS + k * 2 * MS)
        settle(client, twin)
        assert "Traceback" not in client.node.stderr


def test_a_simulated_clock_that_stands_still_and_jumps(tmp_path):
    """Wishes without a stamp count from their arrival: on a simulated clock no time may pass, or it may be set back."""
    path = tmp_path / "x.json"
    save_model(stage_model(), path)
    told = {"desired_type": "Float64", "desired": Float64, "use_sim_time": True}
    with compensator(model_file=str(path), **LIMITS, **told) as client:
        client.connect()
        clock = client.graph.publisher(Clock, "/clock", RELIABLE)
        v = LOW
        for now_ms in (100_000, 100_004, 100_004, 105_000, 50_000, 50_001):
            # A node takes the clock as best it can, and in no order with its wishes.
            for _ in range(4):
                clock.publish(Clock(clock=Time(sec=now_ms // 1000, nanosec=now_ms % 1000 * MS)))
                time.sleep(0.1)
            client.publish(Float64(data=9e-6 if v < 50 else 1e-6))
            before, answered = v, client.answered
            client.graph.spin_until(lambda known=answered: client.answered > known, "an answer")
            v = client.answers[-1][0]
            assert LOW <= v <= HIGH and v != before
        _, values = client.report(accepted=6)
        assert values["rejected"] == "0"


def test_stale_samples_are_rejected_where_age_counts(model_file):
    with compensator(axes=AXES, model_file=model_file, max_age=2.0, **LIMITS) as client:
        client.connect()
        now = time.time_ns()
        client.wish(AXES, [1e-6, 1e-6], now - 60 * SECOND_NS)
        client.report("the rejection", **{"rejected.stale": 1})
        assert len(client.ask(AXES, [1e-6, 1e-6], time.time_ns())) == 2
