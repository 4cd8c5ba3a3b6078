"""The page *Close the loop*, with its commands copied from it, on a simulated stage."""

import time
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("rclpy")

from documentation.pages import DOCS, steps_of  # noqa: E402
from nodes.ros_helpers import RELIABLE, on_graph, stage_model, started  # noqa: E402
from sensor_msgs.msg import JointState  # noqa: E402

from slpi_ros import save_model  # noqa: E402
from slpi_ros.compensator.gains_file import TunedGains  # noqa: E402
from slpi_ros.effects.delay import Delay  # noqa: E402
from slpi_ros.effects.filters import Mode  # noqa: E402
from slpi_ros.effects.resonance import Resonance  # noqa: E402
from slpi_ros.io.tables import read_table  # noqa: E402
from slpi_ros.model.stage_model import StageModel  # noqa: E402
from slpi_ros.simulation.axis import SimulatedAxis  # noqa: E402
from slpi_ros.simulation.character import Character  # noqa: E402
from slpi_ros.simulation.parameters import AxisParameters  # noqa: E402

MODE, DAMPING, DELAY = 110.0, 0.04, 5e-3
STAGE = {"rate": 1000.0, "answer_commands": False, "resonance": MODE, "damping": DAMPING, "delay": DELAY, "seed": 3}
DESIRED = 5e-6


@pytest.mark.ros
@pytest.mark.slow
@pytest.mark.long
def test_the_loop_of_the_page_takes_the_error_away(reader):
    folder = reader.folder
    axis = replace(stage_model().axis("x"), effects=(Delay(DELAY), Resonance((Mode(MODE, DAMPING, 1.0),))))
    save_model(StageModel({"x": axis}), folder / "model.json")
    (folder / "stage.yaml").write_text(
        "/**:\n  ros__parameters:\n    axes: ['x']\n    model_file: model.json\n    start_voltage: auto\n"
        # That model is up to 25 V off, more than a correction may be by default.
        "    correction_limit: 40.0\n"
    )
    blocks = [step.text for step in steps_of(DOCS / "how-to" / "close_the_loop.md") if step.what == "bash"]
    assert len(blocks) == 4
    reader.type(blocks[0])
    t, voltage = read_table(folder / "response.csv", "V")
    _, y = SimulatedAxis(AxisParameters.random(3), 1, Character(delay=DELAY, resonance=MODE, damping=DAMPING)).run(
        t, voltage["x"]
    )
    table = np.column_stack([t, voltage["x"], y])
    np.savetxt(folder / "measured.csv", table, delimiter=",", header="time_s,x_V,x_m", comments="")
    reader.type(blocks[1])
    reader.type(blocks[2])
    assert (folder / "tuning" / "report.html").exists()
    gains = TunedGains.read(str(folder / "gains.yaml")).axes["x"]
    assert gains.integral > 0.0 and len(gains.notches) == 1
    with on_graph() as graph, started("stage_simulator", STAGE) as simulator:
        graph.tested = simulator
        states = graph.record(JointState, "/stage_state")
        graph.spin_until(lambda: states, "the stage")
        reader.type(blocks[3])
        desired = graph.publisher(JointState, "/desired_displacement", RELIABLE)
        graph.spin_until(lambda: graph.node.count_subscribers("/desired_displacement"), "the compensator")

        def there() -> bool:
            message = JointState(name=["x"], position=[DESIRED])
            message.header.stamp = graph.node.get_clock().now().to_msg()
            desired.publish(message)
            time.sleep(0.02)
            errors = [state.position[0] - DESIRED for state in states[-200:]]
            return len(errors) == 200 and abs(float(np.mean(errors))) < 10e-9

        # The model is of another stage: by feedforward alone the error would be far more than the noise.
        graph.spin_until(there, "the set point")
        reader.check_alive()
