"""Measured displacements over DDS: they correct the voltage when told to, and tell when the model no longer holds."""

import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

rclpy = pytest.importorskip("rclpy")

from nodes.compensator_client import PERIOD_NS, START_NS, Client, compensator  # noqa: E402
from nodes.ros_helpers import stage_model  # noqa: E402
from rcl_interfaces.srv import GetParameters  # noqa: E402
from rclpy.qos import qos_profile_sensor_data  # noqa: E402
from sensor_msgs.msg import JointState  # noqa: E402

from slpi_ros.compensator.feedback import Drift, PidGains  # noqa: E402
from slpi_ros.compensator.gains_file import TunedGains  # noqa: E402
from slpi_ros.compensator.loop_filter import Notch  # noqa: E402
from slpi_ros.model.document import save_model  # noqa: E402
from slpi_ros.nodes.compensator_diagnostics import remedy  # noqa: E402

GAINS = {"kp": 5e5, "ki": 3e8}


@pytest.fixture
def x_file(tmp_path: Path) -> str:
    path = tmp_path / "x.json"
    save_model(stage_model(), path)
    return str(path)


class DriftedStage:
    """A stage that is the model, but for an offset of its voltage."""

    def __init__(self, client: Client, offset: float) -> None:
        self._client, self._offset = client, offset
        self._memory = stage_model().axis("x").memory()
        self._followed = 0
        self.publisher = client.graph.publisher(JointState, "/measured_displacement", qos_profile_sensor_data)
        self._sent = 0

    def follow(self, wishes: list[float]) -> np.ndarray:
        """Return the errors (m) of a path in real time, each sample measured before the next is sent."""
        errors = []
        for y in wishes:
            self._client.ask(["x"], [y], START_NS + self._sent * PERIOD_NS)
            self._sent += 1
            # The loop goes by the clock of the node, between the samples as well.
            end = time.monotonic() + PERIOD_NS * 1e-9
            self._client.graph.spin_until(lambda end=end: time.monotonic() >= end, "the next sample")
            voltages = self._client.answers
            for (voltage,) in voltages[self._followed :]:
                place = self._memory.forward(voltage + self._offset)
            self._followed = len(voltages)
            self.publisher.publish(JointState(name=["other", "x"], position=[1.0, place]))
            errors.append(place - y)
        return np.array(errors)


PATH = (5e-6 + 2e-6 * np.sin(np.linspace(0.0, 6.0, 400))).tolist()


@pytest.mark.slow
def test_feedback_corrects_what_the_model_does_not_know_and_the_drift_is_told(x_file):
    with compensator(model_file=x_file, measurement_timeout=10, feedback_fault_time=0, **GAINS) as client:
        client.connect()
        stage = DriftedStage(client, 4.0)
        without = stage.follow(PATH)
        status = client.graph.wait_for_status(
            f"{client.name}: compensator", lambda status: "is off its model" in status.message, "the drift"
        )
        assert status.level == b"\1" and "nm rms" in status.message
        assert client.graph.set_parameters(client.name, feedback=True) == ""
        stage.follow(PATH[-1:] * 100)
        with_feedback = stage.follow(PATH[::-1])
        # On the way a measurement may come one wish late; at rest all have come.
        stage.follow(PATH[:1] * 200)
        told = len(client.reports)
        client.graph.spin_until(lambda: len(client.reports) > told + 1, "a report that was made at rest")
        values = client.reports[-1]
        assert values["x.feedback"] == "on"
        assert np.abs(without).mean() > 3e-7
        assert np.abs(with_feedback).mean() < 0.1 * np.abs(without).mean()
        assert float(values["x.correction_V"]) == pytest.approx(-4.0, abs=1.0)
        assert float(values["x.residual_rms_nm"]) > 100.0
        # Gains and switch change while it runs, together or not at all.
        assert "kp" in client.graph.set_parameters(client.name, kp=-1.0, feedback=False)
        assert client.graph.set_parameters(client.name, feedback=False, drift_alarm=0.0) == ""
        client.report(**{"x.feedback": "off"})


@pytest.mark.slow
def test_the_tracking_error_is_published_for_each_axis(x_file):
    with compensator(model_file=x_file) as client:
        client.connect()
        stage = DriftedStage(client, 4.0)
        found = client.graph.record(JointState, "/tracking_error")
        assert np.abs(stage.follow(PATH)).mean() > 3e-7

        def at_rest():
            # Until the window holds measurements at rest only, whose errors are equal.
            (error,) = stage.follow(PATH[-1:])
            expected = [error, error, abs(error), abs(error)]
            return found and found[-1].position.tolist() == pytest.approx(expected, rel=1e-9)

        client.graph.spin_until(at_rest, "the statistics at rest")
        assert found[-1].name == ["x", "x.mean", "x.rms", "x.maximum"]
        assert found[-1].header.stamp.sec > 0


def test_without_measurements_the_feedback_holds_and_says_so(x_file):
    # The watch of the sensor would end the feedback before it is told that it holds, on a busy machine.
    with compensator(model_file=x_file, feedback=True, feedback_fault_time=0, **GAINS) as client:
        client.connect()
        expected = stage_model().compensate(np.arange(50), np.array(PATH[:50]))
        assert client.follow(["x"], np.array(PATH[:50])[:, None])[:, 0] == pytest.approx(expected, abs=1e-9)
        client.graph.wait_for_status(
            f"{client.name}: compensator", lambda status: "feedback holds" in status.message, "the lack"
        )


def test_gains_with_which_the_loop_of_the_model_is_unstable_never_come_on_unless_forced(x_file):
    wild = 1e4 * GAINS["ki"]
    with compensator(model_file=x_file, feedback=True, feedback_fault_time=0, ki=wild) as client:
        client.connect()
        stage = DriftedStage(client, 2.0)
        stage.follow([5e-6] * 50)
        values = client.report(**{"x.feedback": "fault", "x.feedback_fault": "unstable"})[1]
        assert float(values["x.correction_V"]) == 0.0
        refused = client.graph.set_parameters(client.name, ki=2.0 * wild)
        assert "unstable" in refused and "\n" not in refused
        would = float(refused.split("ki ")[1].split()[0])
        assert client.graph.set_parameters(client.name, ki=would) == ""
        client.report(**{"x.feedback_fault": ""})
        assert "would do" in client.graph.set_parameters(client.name, feedback=False, ki=wild)
        assert client.graph.set_parameters(client.name, feedback=False, ki=wild, force_gains=True) == ""
        assert "would do" in client.graph.set_parameters(client.name, force_gains=False)


def test_a_measurement_that_cannot_be_is_told_and_moves_nothing(x_file):
    """A wrong unit, and a sensor that fails: whatever comes between the good ones."""
    with compensator(model_file=x_file, feedback=True, feedback_fault_time=0, **GAINS) as client:
        client.connect()
        stage = DriftedStage(client, 2.0)
        stage.follow([5e-6] * 200)
        measured, rested = stage.publisher, client.answers[-1]
        for i, absurd in enumerate((5.0, -1e300, float("nan"), float("-inf"), 1e-3)):
            measured.publish(JointState(name=["other", "x"], position=[1.0, absurd]))
            client.report(measurements_rejected=i + 1)
            stage.follow([5e-6])
        assert np.abs(np.array(client.answers[-5:]) - rested).max() < 0.1
        status, values = client.report(**{
            "measurements_rejected.not_finite": 2, "measurements_rejected.out_of_range": 3, "rejected": 0,
        })  # fmt: skip
        assert "axis 'x': measured displacement 1000 µm is far outside" in values["last_rejection"]
        statuses = client.graph.statuses(f"{client.name}: compensator")
        warned = [status for status in statuses if "measurements rejected, the last: axis 'x'" in status.message]
        assert warned and warned[0].level == b"\1"


@pytest.mark.parametrize(
    ("state", "mean", "advised"), [("assumed", 5e-8, False), ("assumed", 1e-9, True), ("known", 5e-8, False)]
)
def test_what_oscillates_is_not_only_blamed_on_the_memory(state, mean, advised):
    axis = SimpleNamespace(confidence=SimpleNamespace(state=state), zero=SimpleNamespace(source="calibration"))
    said = remedy(axis, Drift(mean=mean, rms=5.1e-8, samples=500))
    # What a busy computer adds says nothing of the stage, as long as it is among the residuals.
    told = [remedy(axis, Drift(mean=mean, rms=5.1e-8, samples=500), since) for since in (499, 500)]
    assert "busy" in told[0] and "changed" not in told[0] and told[1] == said
    assert ("interference" in said) == advised and ("~/reset_memory" in said) == (state == "assumed")


def test_gains_and_notches_of_a_file_are_taken_and_a_notch_above_half_the_rate_is_refused(tmp_path, x_file):
    """The file of ``slpi tune``, on a running node: one call, and one line where the rate does not suffice."""
    path = tmp_path / "gains.yaml"
    TunedGains(1000.0, {"x": PidGains(1e5, 1e8, measurement_filter=1e-3, notches=(Notch(120.0, 0.05),))}).write(
        str(path)
    )
    with compensator("--ros-args", "--params-file", str(path), model_file=x_file, feedback=True) as client:
        client.connect()
        asked = GetParameters.Request(names=["notch_frequency.x", "ki"])
        first, second = client.graph.call(GetParameters, f"{client.name}/get_parameters", asked).values
        assert list(first.double_array_value) == [120.0] and second.double_value == 1e8
        assert client.graph.set_parameters(client.name, **{"notch_frequency.x": [90.0, 210.0], "ki": 5e7}) == ""
        for wrong in ({"output_rate": 300.0}, {"notch_frequency.x": [600.0]}, {"notch_damping.x": [0.1] * 3}):
            said = client.graph.set_parameters(client.name, **wrong)
            assert "notch_" in said and "\n" not in said
        assert client.graph.set_parameters(client.name, output_rate=500.0) == ""
