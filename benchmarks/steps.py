"""What the amplifier feels: largest step, slew and acceleration of everything that leaves a compensator, as ratios.

Episodes run the compensator's core without ROS against a made clock, lives are real processes over DDS with an
amplifier that reports its voltage: the node is sent set points, streams of two publishers with different clocks,
bursts, trajectories, parameters and models; it is killed, and something else moves the stage before the next start.
"""

import argparse
import os
import random
import tempfile
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager, suppress
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from benchmarks import kept
from benchmarks.episodes import Ratios, run

CHUNK = 50
# Voltages arrive late by up to this much on a busy machine, seconds; slew is judged over at least as long as that.
JITTER, WINDOW = 0.05, 0.5


def episodes(count: int, first: int) -> Ratios:
    """Run that many episodes from the first seed on, in two processes; return the largest ratios."""
    ratios = Ratios()
    chunks = [range(seed, min(seed + CHUNK, first + count)) for seed in range(first, first + count, CHUNK)]
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        for each in pool.map(run, chunks):
            ratios.add(each)
    return ratios


class Amplifier:
    """Amplifier and sensor of one axis on the graph: holds what it is told, and reports it 200 times a second."""

    def __init__(self, context: Any, domain: str) -> None:
        import rclpy
        from rclpy.executors import SingleThreadedExecutor
        from sensor_msgs.msg import JointState
        from std_msgs.msg import Float64MultiArray
        from trajectory_msgs.msg import JointTrajectory

        self.voltage, self.received = 0.0, []
        self._state = JointState
        self.node = rclpy.create_node("amplifier", context=context)
        self.node.create_subscription(Float64MultiArray, "voltage_command", self._take, 1000)
        self._reports = self.node.create_publisher(JointState, "stage_state", 10)
        self.desired = [self.node.create_publisher(JointState, "desired_displacement", 100) for _ in range(2)]
        self.path = self.node.create_publisher(JointTrajectory, "desired_trajectory", 10)
        self.node.create_timer(0.005, self._report)
        self._executor = SingleThreadedExecutor(context=context)
        self._executor.add_node(self.node)
        self._spinning = True
        self._thread = threading.Thread(target=self._spin, daemon=True)
        self._thread.start()

    def _spin(self) -> None:
        while self._spinning:
            self._executor.spin_once(timeout_sec=0.05)

    def close(self) -> None:
        """Leave the graph."""
        self._spinning = False
        self._thread.join()
        self._executor.shutdown()
        self.node.destroy_node()

    def _take(self, command: Any) -> None:
        self.voltage = command.data[0]
        self.received.append((time.monotonic(), self.voltage))

    def _report(self) -> None:
        state = self._state(name=["x"], position=[1e-7 * self.voltage], effort=[self.voltage])
        state.header.stamp = self.node.get_clock().now().to_msg()
        self._reports.publish(state)

    def send(self, y: float, publisher: int = 0, ahead: float = 0.0) -> None:
        """Send a desired displacement (m), stamped `ahead` (s) of the clock."""
        stamp_ns = self.node.get_clock().now().nanoseconds + round(ahead * 1e9)
        message = self._state(name=["x"], position=[y])
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 10**9)
        self.desired[publisher].publish(message)


class Life:
    """The lives of one compensator: started, sent things, killed, started again where something else left the stage."""

    def __init__(self, seed: int, amplifier: Amplifier, folder: Path) -> None:
        self.rng, self.seed, self.amplifier, self.folder = random.Random(seed), seed, amplifier, folder
        self.slew, self.rate = 10.0 ** self.rng.uniform(2.0, 3.3), self.rng.choice([500.0, 1000.0])
        self.ratios, self._judged = Ratios(), 0

    def run(self) -> Ratios:
        """Start the node twice; return the largest ratios."""
        from nodes.ros_helpers import stage_model, started

        from slpi_ros.model.document import save_model

        model = str(self.folder / "model.json")
        for start in range(2):
            save_model(stage_model(("x",), stroke=10e-6 * self.rng.uniform(0.9, 1.1)), model)
            self.amplifier.voltage = self.rng.uniform(0.0, 100.0)
            self._judged = len(self.amplifier.received)
            parameters = {
                "model_file": model, "slew_limit": self.slew, "output_rate": self.rate,
                "memory_file": str(self.folder / "memory.json"),
            }  # fmt: skip
            with started("compensator", parameters) as node:
                deadline = time.monotonic() + 60.0
                while not self.amplifier.desired[0].get_subscription_count() and time.monotonic() < deadline:
                    time.sleep(0.02)
                time.sleep(0.3)
                begun = self.amplifier.voltage
                # It listens first whether somebody else commands the stage.
                while len(self.amplifier.received) == self._judged and time.monotonic() < deadline:
                    self.amplifier.send(self.share())
                    time.sleep(0.05)
                for _ in range(6):
                    self.rng.choice([self.points, self.stream, self.clocks, self.burst, self.follow, self.pause])()
                time.sleep(0.2)
                if start or self.rng.random() < 0.5:
                    node.stop()
                else:
                    node.kill()
            self.judge(begun)
        return self.ratios

    def judge(self, begun: float) -> None:
        """Compare what has been received since the start with the limits."""
        received = self.amplifier.received[self._judged :]
        most, what = 2.0 * self.slew / self.rate, f"life {self.seed}"
        voltage = begun
        for number, (_, v) in enumerate(received):
            self.ratios.note("step" if number else "start", (abs(v - voltage) - 1e-9) / most, what)
            voltage = v
        way, first = 0.0, 0
        steps = [abs(b - a) for (_, a), (_, b) in zip(received, received[1:], strict=False)]
        for last, step in enumerate(steps, 1):
            way += step
            while received[last][0] - received[first][0] > WINDOW:
                way -= steps[first]
                first += 1
            passed = max(received[last][0] - received[first][0], 0.0)
            allowed = self.slew * (passed + 2.0 / self.rate + JITTER)
            self.ratios.note("slew", way / allowed, what)
        self.ratios.outputs += len(received)

    def share(self) -> float:
        return self.rng.uniform(0.5e-6, 8e-6)

    def points(self) -> None:
        """Set points at 20 Hz."""
        for _ in range(8):
            self.amplifier.send(self.share())
            time.sleep(0.05)

    def stream(self) -> None:
        y, goal = self.share(), self.share()
        for k in range(200):
            self.amplifier.send(y + (goal - y) * k / 200)
            time.sleep(0.001)

    def clocks(self) -> None:
        """Two publishers whose clocks differ by days."""
        for _ in range(15):
            self.amplifier.send(self.share(), 0)
            self.amplifier.send(self.share(), 1, 1e5)
            time.sleep(0.002)

    def burst(self) -> None:
        for k in range(40):
            self.amplifier.send(self.share(), k % 2)

    def follow(self) -> None:
        from builtin_interfaces.msg import Duration
        from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

        path = JointTrajectory(joint_names=["x"])
        for k in range(1, 30):
            ns = k * 20_000_000
            at = Duration(sec=ns // 10**9, nanosec=ns % 10**9)
            path.points.append(JointTrajectoryPoint(positions=[self.share()], time_from_start=at))
        self.amplifier.path.publish(path)
        time.sleep(self.rng.uniform(0.1, 0.8))

    def pause(self) -> None:
        """A long pause permits no large step."""
        time.sleep(1.0)
        self.amplifier.send(self.share())
        time.sleep(0.1)


@contextmanager
def graph() -> Iterator[Amplifier]:
    """Take part in a graph of this run alone."""
    import rclpy
    from rclpy.context import Context

    context = Context()
    rclpy.init(context=context)
    amplifier = Amplifier(context, os.environ["ROS_DOMAIN_ID"])
    try:
        yield amplifier
    finally:
        amplifier.close()
        rclpy.shutdown(context=context)


def lives(count: int, first: int) -> Ratios:
    """Run that many lives of real processes, two of a node each; return the largest ratios."""
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    os.environ.setdefault("ROS_DOMAIN_ID", str(random.randrange(1, 100)))
    ratios = Ratios()
    with graph() as amplifier:
        for seed in range(first, first + (count + 1) // 2):
            with tempfile.TemporaryDirectory() as folder, suppress(KeyboardInterrupt):
                ratios.add(Life(seed, amplifier, Path(folder)).run())
    return ratios


def line(name: str, count: int, first: int, ratios: Ratios) -> str:
    """Return a line of the table."""
    shown = " ".join(f"{getattr(ratios, each):12.9f}" for each in ("step", "slew", "acceleration", "start"))
    return f"{name:<10} {count:7d} from seed {first:<8d} {ratios.outputs:10d} {shown} {max(ratios.outside, 0.0):10.3g}"


def main() -> int:
    """Print the table; return 1 if a ratio is above 1."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--episodes", type=int, default=10_000)
    parser.add_argument("--lives", type=int, default=100)
    parser.add_argument("--seed", type=int, default=None, help="default: drawn from the clock")
    parser.add_argument("--keep", action="store_true", help=f"write the figures to {kept.KEPT.name}")
    options = parser.parse_args()
    first = int(time.time()) % 10**7 * 10 if options.seed is None else options.seed
    print(
        "largest ratios to the limits; start: first step from where the amplifier is; outside: volts beyond the limits"
    )
    heads = " ".join(f"{head:>12}" for head in ("step", "slew", "acceleration", "start"))
    print(f"{'':<10} {'runs':>7} {'':<18} {'voltages':>10} {heads} {'outside':>10}")
    worst = Ratios()
    for name, count, of in (("episodes", options.episodes, episodes), ("lives", options.lives, lives)):
        if count:
            ratios = of(count, first)
            print(line(name, count, first, ratios), flush=True)
            worst.add(ratios)
    if options.keep:
        ratio = max(worst.step, worst.slew, worst.acceleration, worst.start)
        what = (
            f"limits, {worst.outputs:,} voltages of {options.episodes:,} random episodes and {options.lives} runs of "
            "real processes: largest ratio to the limit of step, slew, acceleration and first step; largest voltage "
            "outside of the limits, V"
        )
        kept.write_row("steps", what, f"{ratio:.3f}; {max(worst.outside, 0.0):.3g}", "make bench-steps")
    wrong = max(worst.step, worst.slew, worst.acceleration, worst.start) > 1.0 + 1e-6 or worst.outside > 0.0
    if wrong:
        print("above 1:", {name: what for name, what in worst.what.items() if getattr(worst, name) > 1.0 + 1e-6})
    return int(wrong)


if __name__ == "__main__":
    raise SystemExit(main())
