"""Calibration and compensation as described in the README, on simulated stages that were never driven before.

The commands are taken from the README. Only ``ros2``, which need not be installed, is replaced: ``ros2 run`` by the
installed programs, ``ros2 topic pub`` by a publisher of the same message at the same rate.
"""

import argparse
import os
import re
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import rclpy
import yaml
from diagnostic_msgs.msg import DiagnosticArray
from numpy.typing import NDArray
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

import slpi_ros
from benchmarks import kept

FloatArray = NDArray[np.float64]
CHECKOUT = Path(__file__).resolve().parents[1]
PROGRAMS = CHECKOUT / os.environ.get("SLPI_INSTALL", "install") / "slpi_ros" / "lib" / "slpi_ros"
SECTION = re.compile(r"^## No stage yet.*^## Calibrate a real stage.*?(?=^## )", re.DOTALL | re.MULTILINE)
BLOCK = re.compile(r"^```bash\n(.*?)^```$", re.DOTALL | re.MULTILINE)
# Set points after that of the README, as fractions of the identified range.
SHARES = (0.85, 0.2, 0.65, 0.4)
# Readings averaged at each set point, after half as many are discarded: 8 nm of noise become 1.1 nm.
READINGS = 50
PATIENCE_S = 90.0
# Waiting time, seconds: a node appears in the ROS graph shortly before its topics are connected.
SETTLE_S = 1.0


def readme_commands() -> list[str]:
    """Return the commands of the sections of the README on a stage, in order, without comments."""
    section = SECTION.search((CHECKOUT / "README.md").read_text())
    assert section, "README has no section on calibration"
    lines = [line for block in BLOCK.findall(section[0]) for line in block.splitlines()]
    return [command for line in lines if (command := re.sub(r"\s+#.*", "", line).strip())]


class Readme:
    """Simulated user who executes commands of the README in a folder; every program runs until it is interrupted."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.commands = folder, readme_commands()
        self.node = rclpy.create_node("readme_user")
        self.readings: list[float] = []
        self.turns: list[float] = [0.0]
        self.memory = ""
        self.node.create_subscription(JointState, "/stage_state", self._on_state, 1000)
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)
        self._running: list[subprocess.Popen[bytes]] = []

    def _on_state(self, state: JointState) -> None:
        self.readings.append(state.position[0])
        v, turns = state.effort[0], self.turns
        if len(turns) > 1 and (v - turns[-1]) * (turns[-1] - turns[-2]) >= 0:
            turns[-1] = v
        elif v != turns[-1]:
            turns.append(v)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        found = [pair.value for status in message.status for pair in status.values if pair.key == "memory"]
        self.memory = found[-1] if found else self.memory

    def close(self) -> None:
        """Interrupt all programs, in reverse order of their start."""
        while self._running:
            self.interrupt(self._running[-1])
        self.node.destroy_node()

    def command(self, words: str) -> str:
        """Return the only command of the README that begins with these words."""
        (found,) = [command for command in self.commands if command.startswith(words)]
        return found

    def start(self, words: str, more: str = "") -> subprocess.Popen[bytes]:
        """Start the command that begins with these words, with the options `more`; its output is written to a file."""
        command = re.sub(r"^(ros2 run slpi_ros |(?=slpi ))", f"{PROGRAMS}/", self.command(words)) + " " + more
        with self.console(words).open("wb") as console:
            process = subprocess.Popen(
                ["bash", "-c", f"exec {command}"],
                cwd=self.folder, stdout=console, stderr=subprocess.STDOUT, start_new_session=True,
            )  # fmt: skip
        self._running.append(process)
        return process

    def console(self, words: str) -> Path:
        """Return the path of the file with the output of the last command that begins with these words."""
        return self.folder / (re.sub(r"\W+", "_", words) + ".log")

    def finish(self, words: str, process: subprocess.Popen[bytes]) -> str:
        """Wait until a program has ended by itself; return its output."""
        self.until(lambda: process.poll() is not None, f"the end of {words}")
        self._running.remove(process)
        said = self.console(words).read_text()
        assert process.returncode == 0, f"{words}: exit code {process.returncode}: {said}"
        return said

    def interrupt(self, process: subprocess.Popen[bytes]) -> None:
        """Interrupt a program by SIGINT, as Ctrl-C does."""
        self._running.remove(process)
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGINT)
        process.wait(PATIENCE_S)

    def until(self, done: Callable[[], object], what: str) -> None:
        """Spin the ROS node until `done` returns True; AssertionError after `PATIENCE_S` seconds."""
        deadline = time.monotonic() + PATIENCE_S
        while not done():
            assert time.monotonic() < deadline, f"waited in vain for {what}"
            rclpy.spin_once(self.node, timeout_sec=0.02)

    def spin(self, seconds: float) -> None:
        """Spin the ROS node for some seconds."""
        deadline = time.monotonic() + seconds
        self.until(lambda: time.monotonic() >= deadline, "the time")

    # The steps

    def stage(self, seed: int, more: str = "") -> subprocess.Popen[bytes]:
        """Start a simulated stage."""
        process = self.start("ros2 run slpi_ros stage_simulator", f"-p seed:={seed} {more}")
        self.until(lambda: self.node.count_publishers("/stage_state"), "the stage")
        return process

    def calibrate(self) -> slpi_ros.StageModel:
        """Record a calibration drive and identify the model, by hand."""
        recorder = self.start("ros2 run slpi_ros recorder")
        self.until(lambda: self.node.count_subscribers("/stage_state") >= 2, "the recorder")
        words = "ros2 run slpi_ros exciter"
        self.finish(words, self.start(words))
        self.interrupt(recorder)
        for words in ("slpi identify", "slpi show"):
            self.finish(words, self.start(words))
        return slpi_ros.load_model(self.folder / "my_stage" / "model.json")

    def compensator(self) -> subprocess.Popen[bytes]:
        """Start the compensator and wait until its topics are visible and its reset has ended."""
        self.memory = ""
        process = self.start("ros2 run slpi_ros compensator")
        self.until(
            lambda: (
                self.node.count_subscribers("/desired_displacement") and self.node.count_publishers("/voltage_command")
            ),
            "the compensator",
        )
        self.until(lambda: self.memory == "known", "the end of the reset")
        return process

    def errors(self, model: slpi_ros.StageModel) -> FloatArray:
        """Return the displacement errors at the set point of the README and at others, shape (5,), % of the range."""
        _, _, _, _, rate, topic, _, text = self.command("ros2 topic pub").split(maxsplit=7)
        low, high = model.axes["x"].displacement_range
        message = yaml.safe_load(text.strip('"'))
        points = [*map(float, message["position"]), *(low + share * (high - low) for share in SHARES)]
        publisher = self.node.create_publisher(JointState, topic, 100)
        self.until(publisher.get_subscription_count, topic)
        sent: list[float] = []
        answers: list[Float64MultiArray] = []

        def send() -> None:
            publisher.publish(JointState(name=message["name"], position=[point]))
            sent.append(point)

        listener = self.node.create_subscription(Float64MultiArray, "/voltage_command", answers.append, 100)
        timer, found = self.node.create_timer(1.0 / float(rate), send), []
        for point in points:
            # Answers to earlier messages may still arrive, and a stage reports its rest until it is driven.
            # What the slew limit holds back comes between the answers.
            new = len(sent) + 20
            self.until(
                lambda new=new: (
                    len(sent) >= new
                    and len({each.data[0] for each in answers[-5:]}) == 1
                    and self.turns[-1] == answers[-1].data[0]
                ),
                f"the voltage for {point} m",
            )
            self.readings.clear()
            self.until(lambda: len(self.readings) >= 3 * READINGS // 2, f"the stage at {point} m")
            found.append(float(np.mean(self.readings[READINGS // 2 :])) - point)
        self.node.destroy_timer(timer)
        self.node.destroy_subscription(listener)
        self.node.destroy_publisher(publisher)
        return 100.0 * np.array(found) / (high - low)

    def warnings(self) -> list[str]:
        """Return the warnings and errors in the output of the compensator."""
        lines = self.console("ros2 run slpi_ros compensator").read_text().splitlines()
        return [line for line in lines if "[WARN]" in line or "[ERROR]" in line]


def as_written(user: Readme, seed: int) -> tuple[slpi_ros.StageModel, FloatArray, list[str]]:
    """Execute the steps of the README; return the model, the errors (% of the range) and the compensator's warnings."""
    stage = user.stage(seed)
    model = user.calibrate()
    compensator = user.compensator()
    errors = user.errors(model)
    user.interrupt(compensator)
    user.interrupt(stage)
    return model, errors, user.warnings()


def next_day(user: Readme, seed: int, model: slpi_ros.StageModel) -> tuple[FloatArray, list[str]]:
    """Restart the stage one day later, and the compensator; return errors and warnings."""
    stage = user.stage(seed, f"-p initial_state:='{[round(v, 6) for v in user.turns]}'")
    compensator = user.compensator()
    errors = user.errors(model)
    user.interrupt(compensator)
    user.interrupt(stage)
    return errors, user.warnings()


def moved(user: Readme, seed: int, model: slpi_ros.StageModel, history: str, to: float) -> None:
    """Print the errors of a stage that was driven through `history` (V) to `to` (V) before the compensator starts."""
    stage = user.stage(seed, f"-p initial_state:='{history}'")
    voltages = user.node.create_publisher(Float64MultiArray, "/voltage_command", 100)
    user.until(voltages.get_subscription_count, "the stage")
    user.spin(SETTLE_S)
    user.readings.clear()
    while not user.readings:
        voltages.publish(Float64MultiArray(data=[to]))
        user.spin(0.1)
    compensator = user.compensator()
    errors = user.errors(model)
    user.interrupt(compensator)
    user.interrupt(stage)
    user.node.destroy_publisher(voltages)
    print(f"  driven through {history} V, at {to:g} V: {shown(errors)}")
    for line in user.warnings():
        print(f"    {line}")


def shown(errors: FloatArray) -> str:
    """Return errors (%) as text."""
    return " ".join(f"{error:+.3f}" for error in errors)


def main() -> None:
    """Print the errors of each stage."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3, 4, 5])
    parser.add_argument("--moved", action="store_true", help="also stages that were moved after the record")
    parser.add_argument("--keep", action="store_true", help=f"write the figures to {kept.KEPT.name}")
    options = parser.parse_args()
    # On this machine only, and in a separate ROS domain.
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    os.environ.setdefault("ROS_DOMAIN_ID", str(60 + os.getpid() % 40))
    rclpy.init()
    print("errors at five set points, % of stroke: as written | next day")
    found: list[FloatArray] = []
    for seed in options.seeds:
        with tempfile.TemporaryDirectory() as folder:
            user = Readme(Path(folder))
            try:
                model, errors, warnings = as_written(user, seed)
                again, more = next_day(user, seed, model)
                found += [errors, again]
                print(f"seed {seed}: {shown(errors)} | {shown(again)}; warnings {len(warnings)} | {len(more)}")
                for line in [*warnings, *more]:
                    print(f"    {line}")
                if options.moved:
                    for history, to in (("[0.0, 100.0]", 0.0), ("[0.0]", 0.0), ("[0.0, 70.0]", 40.0)):
                        moved(user, seed, model, history, to)
            finally:
                user.close()
    rclpy.shutdown()
    if options.keep:
        largest = float(np.abs(found).max())
        what = (
            f"the commands of README on {len(options.seeds)} simulated stages, on the same and on the next day: "
            "largest error"
        )
        kept.write_row("readme", what, f"{largest:.3f} % of stroke", "make bench-readme")


if __name__ == "__main__":
    main()
