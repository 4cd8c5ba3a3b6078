"""A path that comes again over DDS: its error falls from pass to pass, is kept over a kill, and can be forgotten."""

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

rclpy = pytest.importorskip("rclpy")

from nodes.compensator_client import Client, compensator  # noqa: E402
from nodes.ros_helpers import RELIABLE, started  # noqa: E402
from nodes.test_compensator_trajectory import trajectory  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402
from trajectory_msgs.msg import JointTrajectory  # noqa: E402

import slpi_ros  # noqa: E402
from slpi_ros.excitation.drives import calibration_drive  # noqa: E402
from slpi_ros.io.record import Record  # noqa: E402
from slpi_ros.simulation.stage import Stage  # noqa: E402

pytestmark = pytest.mark.long
MS = 1_000_000
NOISE = 4e-9
# One pass: a triangle with rounded turns; a rate that a busy machine keeps up with.
SAMPLES, RATE = 81, 50.0
MOST_PASSES = 30
# The path has at least this error, rms, and at most the other one when it has been learned on a busy machine.
UNCORRECTED_NM, LEARNED_NM = 220.0, 140.0


@pytest.fixture(scope="module")
def model_file(tmp_path_factory) -> str:
    """A model of the simulated stage that is simple, and wrong by a quarter: more than a busy machine makes it."""
    t, v = calibration_drive(0.0, 100.0, duration=4.0, rate=500.0, seed=1)[:2]
    stage = Stage.random(["x"], 3, NOISE)
    y = [stage.measure(stage.step(at, [volt]))[0] for at, volt in zip(t, v, strict=True)]
    record = Record(np.round(1e9 * np.asarray(t)).astype(np.int64), {"x": v}, {"x": 0.75 * np.array(y)})
    path = tmp_path_factory.mktemp("model") / "x.json"
    slpi_ros.save_model(slpi_ros.identify(record, "pi"), path)
    return str(path)


def raster(model_file: str) -> np.ndarray:
    low, high = slpi_ros.load_model(model_file).axes["x"].displacement_range
    spectrum = np.fft.rfft(1 - 2 * np.abs(2 * np.arange(SAMPLES - 1) / (SAMPLES - 1) - 1))
    turned = np.fft.irfft(spectrum * np.exp(-((0.08 * np.arange(spectrum.size)) ** 2)), SAMPLES - 1)
    return 0.5 * (low + high) + 0.12 * (high - low) * np.append(turned, turned[0])


@contextmanager
def learning(model_file: str, memory: Path | str = "") -> Iterator[Client]:
    """Start the compensator of a simulated stage, which learns."""
    given = {"model_file": model_file, "memory_file": str(memory), "start_voltage": "auto", "start_memory": "start"}
    measured = ("-r", "measured_displacement:=stage_state")
    with compensator(*measured, **given, learn="on", slew_limit=1e4, output_rate=RATE) as client:
        client.connect()
        yield client


class Passes:
    """Send one path again and again, and read what is told of its passes."""

    def __init__(self, client: Client, path: np.ndarray) -> None:
        self._client, self._path = client, path
        self._publisher = client.graph.publisher(JointTrajectory, "/desired_trajectory", RELIABLE)

    def until(self, done: Callable[[dict[str, str]], bool]) -> dict[str, str]:
        """Send the path, with a pause after each pass, until what is told of it is as wished; return that.

        A busy machine drops passes that it has output late.
        """
        for _ in range(MOST_PASSES):
            before = len(self._client.reports)
            times = np.arange(SAMPLES) * round(1000 / RATE) * MS
            self._publisher.publish(trajectory(["x"], times, self._path[:, None]))
            self._client.graph.spin_for(SAMPLES / RATE + 0.35)
            told = next((one for one in reversed(self._client.reports[before:]) if "x.learn_pass" in one), None)
            if told and done(told):
                return told
        raise AssertionError(f"{MOST_PASSES} passes, the last: {told}; the node said: {self._client.node.stderr}")


def figure(told: dict[str, str], name: str) -> float:
    return float(told[f"x.learn_{name}"])


def test_the_error_falls_over_the_passes_is_kept_over_a_kill_and_forgotten(model_file, tmp_path):
    memory = tmp_path / "memory.json"
    with started("stage_simulator", {"seed": 3, "noise_rms": NOISE}):
        with learning(model_file, memory) as client:
            passes = Passes(client, raster(model_file))
            last = passes.until(lambda told: figure(told, "error_nm") < LEARNED_NM)
            assert figure(last, "first_nm") > UNCORRECTED_NM
            assert figure(last, "best_nm") <= figure(last, "error_nm")
            client.node.stop(signal.SIGKILL)
            client.graph.tested = None
        assert len(list(tmp_path.glob("memory.json.learned.*.json"))) == 1
        with learning(model_file, memory) as client:
            client.report("what was kept", **{"x.learn_first_nm": last["x.learn_first_nm"]})
            passes = Passes(client, raster(model_file))
            after = passes.until(lambda told: figure(told, "pass") > figure(last, "pass"))
            assert figure(after, "error_nm") < UNCORRECTED_NM
            answer = client.graph.call(Trigger, f"{client.name}/forget", Trigger.Request())
            assert answer.success and answer.message == "forgotten: 1 path"
            assert not list(tmp_path.glob("memory.json.learned.*.json"))
            again = passes.until(lambda told: True)
            assert figure(again, "pass") <= 3
            assert figure(again, "first_nm") > UNCORRECTED_NM
