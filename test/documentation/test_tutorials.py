"""The tutorials, with their commands copied from the pages."""

import json
import subprocess
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest

rclpy = pytest.importorskip("rclpy")

from diagnostic_msgs.msg import DiagnosticArray  # noqa: E402
from documentation.pages import DOCS, steps_of  # noqa: E402
from rclpy.time import Time  # noqa: E402
from sensor_msgs.msg import JointState  # noqa: E402

# Metres: a tenth of a per cent of the strokes of the simulated stages.
ALLOWED = 2e-8
READINGS = 100


class Watcher:
    """A node that sees what the tutorials bring about."""

    def __init__(self):
        self.context = rclpy.Context()
        rclpy.init(context=self.context)
        self.node = rclpy.create_node("watcher", context=self.context)
        self.executor = rclpy.executors.SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.states, self.memory = [], ""
        self.node.create_subscription(JointState, "/stage_state", self.states.append, 1000)
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self.on_diagnostics, 10)

    def on_diagnostics(self, message):
        for pair in (pair for status in message.status for pair in status.values):
            self.memory = pair.value if pair.key == "memory" else self.memory

    def spin(self):
        self.executor.spin_once(timeout_sec=0.05)

    def there(self, name):
        """Return whether a program that has been started takes part in the graph."""
        if name in ("stage_simulator", "driver.py"):
            return self.node.count_subscribers("/voltage_command") and self.node.count_publishers("/stage_state")
        if name == "recorder":
            return self.node.count_subscribers("/stage_state") >= 2
        return name == "pub -r" or self.node.count_subscribers("/desired_displacement")

    def close(self):
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self.context)


@pytest.fixture
def watcher():
    watcher = Watcher()
    yield watcher
    watcher.close()


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize("page", ["simulator", "own_stage", "xy_feedback"])
def test_tutorial_with_a_stage(page, reader, watcher):
    for name in ("driver.py", "my_device.py"):
        (reader.folder / name).write_text((DOCS / "examples" / name).read_text())
    checks = 0
    for step in steps_of(DOCS / "tutorials" / f"{page}.md"):
        if step.what == "bash":
            name = reader.type(step.text)
            if name:
                reader.until(watcher.spin, lambda name=name: watcher.there(name), name)
        elif step.what == "interrupt":
            reader.interrupt(step.text)
        elif step.what == "wait for memory":
            watcher.memory = ""
            reader.until(watcher.spin, lambda step=step: watcher.memory == step.text, step.text)
        elif step.what == "check":
            axis, target = step.text.split()
            now = watcher.node.get_clock().now()
            there = partial(arrived, watcher, axis, float(target), now)
            reader.until(watcher.spin, there, step.text)
            checks += 1
    assert checks


def arrived(watcher, axis, target, since):
    """Return whether the newest readings of an axis, all measured since a time, lie at the target."""
    newest = [state for state in watcher.states[-READINGS:] if Time.from_msg(state.header.stamp) > since]
    measured = [state.position[list(state.name).index(axis)] for state in newest if axis in state.name]
    return len(measured) == READINGS and abs(np.mean(measured) - target) <= ALLOWED and np.ptp(measured) < 5 * ALLOWED


def test_the_notebook_is_the_page_with_what_it_prints():
    page = DOCS / "tutorials" / "csv.md"
    notebook = json.loads(page.with_suffix(".ipynb").read_text())
    sources = [cell["source"].removeprefix("%%bash\n") + "\n" for cell in notebook["cells"] if "outputs" in cell]
    assert sources == [step.text for step in steps_of(page)]
    text = "".join(cell["source"] for cell in notebook["cells"] if "outputs" not in cell)
    assert all(line in text for line in page.read_text().splitlines() if line.startswith("#"))
    outputs = [output for cell in notebook["cells"] for output in cell.get("outputs", ())]
    assert sum(output["output_type"] == "display_data" for output in outputs) == 1
    assert any("held-out error" in output.get("text", "") for output in outputs)
    assert str(Path.home()) not in json.dumps(outputs) and "/tmp" not in json.dumps(outputs)


@pytest.mark.slow
@pytest.mark.long
def test_tutorial_without_ros(reader):
    """The commands of the page run in its order, and what the page says about their figures holds."""
    said = []
    for step in steps_of(DOCS / "tutorials" / "csv.md"):
        if step.what == "bash":
            reader.type(step.text)
        elif step.what == "python":
            command = [sys.executable, "-c", step.text]
            said += subprocess.run(
                command, cwd=reader.folder, stdout=subprocess.PIPE, text=True, check=True
            ).stdout.split()
    held_out, passed = said
    assert 6e-9 < float(held_out) < 10e-9
    assert passed == "True"
    table = np.loadtxt(reader.folder / "voltage.csv", delimiter=",", skiprows=1)
    assert table.shape == (400, 2) and np.isfinite(table).all()


@pytest.mark.slow
@pytest.mark.long
def test_tutorial_with_a_temperature(reader):
    (reader.folder / "make_days.py").write_text((DOCS / "examples" / "room" / "make_days.py").read_text())
    said = ""
    for step in steps_of(DOCS / "tutorials" / "temperature.md"):
        if step.text.startswith("python "):
            subprocess.run([sys.executable, *step.text.split()[1:]], cwd=reader.folder, check=True)
        elif step.what == "bash":
            reader.type(step.text)
        elif step.what == "python":
            command = [sys.executable, "-c", step.text]
            said += subprocess.run(command, cwd=reader.folder, stdout=subprocess.PIPE, text=True, check=True).stdout
    found = json.loads((reader.folder / "diagnosis" / "diagnosis.json").read_text())["axes"]["x"]
    (effect,) = found["effects"]
    assert (found["verdict"], effect["name"]) == ("named", "surroundings")
    (quantity,) = effect["parameters"]["quantities"]
    assert quantity["topic"] == "/room/temperature"
    # Of `EXPANSION` in the script, m/K, as the page says.
    assert quantity["offset_gain"] == pytest.approx(3e-7, rel=0.03)
    assert json.loads((reader.folder / "verification" / "certificate.json").read_text())["verdict"] == "passed"
    assert [float(line.split()[-2]) for line in said.splitlines()] == pytest.approx([6.0, 6.0], abs=3.0)
