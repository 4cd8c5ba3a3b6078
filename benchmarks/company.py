"""Lives of real processes on the topics of one stage: who moves it, who must not, who is refused though he may.

Each life is a plan that is drawn before it starts: which programs start and end in which order, and for each of its
steps who must speak and who may. Everybody else of `Plan.judged` must be silent. An observer takes each voltage and
each state with the publisher that sent it (`speakers.py`), and counts

- voltages (of a driver: states) from what must not move, and
- what had to move, and did not within `PATIENCE`.

Lives have a namespace each, and workers a ROS domain each.
"""

import argparse
import json
import math
import os
import random
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import suppress
from dataclasses import dataclass, field, replace
from multiprocessing import get_context
from pathlib import Path

CHECKOUT = Path(__file__).resolve().parents[1]
sys.path += [str(CHECKOUT), str(CHECKOUT / "demo")]

from graph import EXECUTABLES  # noqa: E402

from benchmarks.ros_domain import OWN, keep_to_own_domain  # noqa: E402

# Longest wait for what must speak, s: one that was killed stays in the graph for 20 s.
PATIENCE = 60.0
SIGNALS = (signal.SIGHUP, signal.SIGTERM, signal.SIGINT, signal.SIGKILL)
MINE, THEIRS, TOP = "mine", "theirs", 100.0
COMMAND = "voltage_command"
COMPENSATOR, EXCITER, CALIBRATOR = "compensator", "exciter", "calibrator"
MOVERS = (COMPENSATOR, EXCITER, CALIBRATOR)
# Parameters that tell lives of a kind apart.
TOLD = ("hardware_id", "accept_stage", "accept_units", "unit", "sensor_scale", "reset_on_start")
# A voltage that another program repeats, V.
REPEATED = 30.0


@dataclass(frozen=True)
class Step:
    """One step of a life: what is done, who must speak then and who may, and for how long it is watched after that."""

    acts: tuple[tuple[object, ...], ...]  # each: name of a method of `Life`, and what it is given
    must: tuple[str, ...] = ()
    may: tuple[str, ...] = ()
    seconds: float = 0.0
    one_of: bool = False  # one of `must`, the others must be silent
    below: float = TOP + 1.0  # V, beyond which a voltage counts as one that must not be

    def __str__(self) -> str:
        done = ", ".join(" ".join(map(_told, act)) for act in self.acts)
        must = (" or " if self.one_of else ", ").join(self.must) or "nobody"
        return f"{done}: {must} must" + (f", {', '.join(self.may)} may" if self.may else "")


@dataclass(frozen=True)
class Plan:
    """A life before it starts: who is judged in it, and its steps."""

    kind: str
    judged: tuple[str, ...]
    steps: tuple[Step, ...]

    def __str__(self) -> str:
        return f"{self.kind}, of {', '.join(self.judged)}: {'; '.join(map(str, self.steps))}"


@dataclass
class Figures:
    """What was counted in a life."""

    kind: str
    wrong: int = 0  # voltages from what must not move
    refused: int = 0  # what had to move and did not
    moved: int = 0  # what had to move and did
    left: int = 0  # ends elsewhere than at rest
    unknown: int = 0  # messages of publishers that the graph does not name
    slowest: float = 0.0  # s, until it did
    told: list[str] = field(default_factory=list)


def _told(word: object) -> str:
    """Return a word of an act, without parameters that every life has."""
    if isinstance(word, dict):
        return " ".join(f"{key}={value}" for key, value in word.items() if key in TOLD)
    return f"{word:.2f}" if isinstance(word, float) else str(getattr(word, "name", word))


# Plans: `start` NAME PROGRAM {parameters} [nohup], `end` NAME SIGNAL, `leaves` NAME (by itself), `wait` SECONDS, ..


def _start(name: str, program: str, **given: object) -> tuple[object, ...]:
    return "start", name, program, given


def _stage(frame: str = MINE, name: str = "stage") -> tuple[object, ...]:
    return _start(name, "stage_simulator", axes=["x"], hardware_id=frame, rate=50.0)


def _device(device: str = "gcs", **given: object) -> tuple[object, ...]:
    return _start("device", "device_simulator", device=device, address="PLACE", **given)


def _driver(name: str = "driver", device: str = "gcs", **given: object) -> tuple[object, ...]:
    known = {"axes": ["x"], "voltage_min": 0.0, "voltage_max": TOP, "rate": 100.0, "hardware_id": MINE}
    return _start(name, "driver", device=device, address="PLACE", **known | given)


def _mover(name: str, program: str, **given: object) -> tuple[object, ...]:
    known: dict[str, object] = {"axes": ["x"], "voltage_min": 0.0, "voltage_max": TOP}
    match program:
        case "compensator":
            known |= {"model_file": "MODEL", "memory_file": f"FOLDER/{name}.json"}
        case "exciter":
            known |= {"slew_limit": 200.0, "duration": 60.0, "settle": 0.3, "rate": 100.0, "state_timeout": 5.0}
        case _:
            known |= {"slew_limit": 200.0, "output": f"FOLDER/{name}", "rate": 100.0, "state_timeout": 5.0}
    return _start(name, program, **known | given)


def alone(rng: random.Random) -> Plan:
    """One of each, before or after the stage, of any name that is no other one."""
    frame = rng.choice((MINE, MINE, "odom", "base_link", "/world"))
    acts = [_stage(frame), _mover("a", rng.choice(MOVERS))]
    rng.shuffle(acts)
    return Plan("alone", ("a",), (Step((acts[0], ("wait", rng.uniform(0.0, 1.5)), acts[1]), ("a",), seconds=2.0),))


def second(rng: random.Random) -> Plan:
    """A second one of the same or another node beside a running one; then the first one ends."""
    first, other, number = rng.choice(MOVERS), rng.choice(MOVERS), rng.choice(SIGNALS)
    steps = [Step((_stage(), _mover("a", first)), ("a",), seconds=rng.uniform(0.0, 2.0))]
    if first == COMPENSATOR:
        reset = {"reset_on_start": True} if other == COMPENSATOR and rng.random() < 0.5 else {}
        steps += [
            Step((_mover("b", other, **reset),), (), ("a",), rng.uniform(5.0, 7.0)),
            Step((("end", "a", number),), ("b",), seconds=1.0),
        ]
    else:
        # It returns to rest and ends where another one appears.
        steps += [Step((_mover("b", other), ("leaves", "a")), ("b",), seconds=1.0)]
    return Plan(f"{first} and {other}", ("a", "b"), tuple(steps))


def at_once(rng: random.Random) -> Plan:
    """Two compensators that start together: one of them moves, until it ends."""
    both = [_mover("a", COMPENSATOR), ("wait", rng.uniform(0.0, 0.3)), _mover("b", COMPENSATOR)]
    stage = [_stage(), ("wait", rng.uniform(0.0, 2.0))]
    acts = (*stage, *both) if rng.random() < 0.5 else (*both, *stage)
    return Plan("two at once", ("a", "b"), (Step(acts, ("a", "b"), seconds=5.0, one_of=True),))


def restart(rng: random.Random) -> Plan:
    """One that ends in any way and starts again, twice."""
    program, steps = rng.choice(MOVERS), [Step((_stage(),))]
    for life in range(3):
        own = {"output": f"FOLDER/{life}"} if program == CALIBRATOR else {}
        ended = [("end", "a", rng.choice(SIGNALS))] if life else []
        steps.append(Step((*ended, _mover("a", program, **own)), ("a",), seconds=rng.uniform(0.2, 2.0)))
    return Plan(f"{program} again", ("a",), tuple(steps))


def stage_again(rng: random.Random) -> Plan:
    """A stage, or the driver of one, that ends in any way and starts again under a running compensator."""
    if rng.random() < 0.5:
        begun, again = (_stage(),), _stage()
    else:
        begun, again = (_device(), _driver("stage")), _driver("stage")
    return Plan(
        "stage again", ("stage", "a"),
        (
            Step((*begun, _mover("a", COMPENSATOR)), ("stage", "a"), seconds=1.0),
            Step((("end", "stage", rng.choice(SIGNALS)), again), ("stage",), ("a",), 1.0),
            Step((("end", "a", rng.choice(SIGNALS)), _mover("a", COMPENSATOR)), ("a",), ("stage",), 1.0),
        ),
    )  # fmt: skip


def two_stages(rng: random.Random) -> Plan:
    """Two publishers of one axis: nothing moves until one of them ends."""
    program = rng.choice(MOVERS)
    return Plan(
        "two stages", ("a",),
        (
            Step((_stage(), _stage(rng.choice((MINE, THEIRS)), "twin"), ("heard", "stage"), ("heard", "twin"))),
            Step((_mover("a", program),), seconds=rng.uniform(5.0, 7.0)),
            Step((("end", "twin", rng.choice(SIGNALS)),), ("a",), seconds=1.0),
        ),
    )  # fmt: skip


def second_driver(rng: random.Random) -> Plan:
    """A second driver of the same stage does not begin; the compensator goes on."""
    return Plan(
        "second driver", ("driver", "twin", "a"),
        (
            Step((_device(), _driver(), _mover("a", COMPENSATOR)), ("driver", "a"), seconds=1.0),
            Step((_driver("twin"), ("leaves", "twin")), ("driver", "a"), seconds=1.0),
        ),
    )  # fmt: skip


def foreign(rng: random.Random) -> Plan:
    """The model of another stage moves nothing, unless that is accepted."""
    expected = {"hardware_id": MINE} if rng.random() < 0.3 else {}
    return Plan(
        "foreign stage", ("a",),
        (
            Step((_stage(THEIRS), _mover("a", COMPENSATOR, **expected)), seconds=rng.uniform(5.0, 7.0)),
            Step(
                (("end", "a", rng.choice(SIGNALS)), _mover("a", COMPENSATOR, accept_stage=THEIRS)), ("a",), seconds=1.0
            ),
        ),
    )  # fmt: skip


def exchanged(rng: random.Random) -> Plan:
    """A stage that becomes another one is driven no more."""
    exchange = (("end", "stage", rng.choice(SIGNALS)), _stage(THEIRS, "other"), ("heard", "other"), ("settle", 4.0))
    return Plan(
        "stage exchanged", ("a",),
        (
            Step((_stage(), _mover("a", COMPENSATOR)), ("a",), seconds=1.0),
            Step(exchange, seconds=3.0),
        ),
    )  # fmt: skip


def commander(rng: random.Random) -> Plan:
    """A program that repeats a voltage is left alone; when it has ended, the stage is taken."""
    program = rng.choice(MOVERS)
    return Plan(
        f"commander, {program}", ("a",),
        (
            Step((_stage(), ("start", "somebody", "", {}), ("heard", "somebody"))),
            Step((_mover("a", program),), seconds=rng.uniform(4.0, 6.0)),
            Step((("end", "somebody", rng.choice(SIGNALS)),), ("a",), seconds=1.0),
        ),
    )  # fmt: skip


def block(rng: random.Random) -> Plan:
    """A compensator that starts while a driver plays a block waits for its end."""
    return Plan(
        "block", ("a",),
        (
            Step((_device(), _driver(), ("heard", "driver"), ("play", 12.0))),
            Step((_mover("a", COMPENSATOR), ("played",))),
            Step((), ("a",), seconds=1.0),
        ),
    )  # fmt: skip


def hangup(rng: random.Random) -> Plan:
    """The terminal is closed: with nohup it goes on, otherwise it ends and another one may begin."""
    program, other = rng.choice(MOVERS), rng.choice(MOVERS)
    return Plan(
        "hangup", ("a", "b"),
        (
            Step((_stage(), (*_mover("a", program), True)), ("a",), seconds=1.0),
            Step((("hang_up", "a"), ("wait", 2.0)), ("a",), seconds=1.0),
            Step((("end", "a", rng.choice((signal.SIGTERM, signal.SIGINT))), _mover("b", other)), ("b",), seconds=1.0),
            Step((("end", "b", signal.SIGHUP),), seconds=1.0),
        ),
    )  # fmt: skip


def unit(rng: random.Random) -> Plan:
    """A unit that contradicts the device's is refused, and one that it tells is taken."""
    program, told = rng.choice(MOVERS), rng.choice(("MM", "NM"))
    return Plan(
        "unit told", ("driver", "a"),
        (
            Step((_device(unit=told), _driver(sensor_scale=1e-6), ("leaves", "driver")), seconds=1.0),
            Step((_driver(), _mover("a", program)), ("driver", "a"), seconds=1.0),
        ),
    )  # fmt: skip


def unit_untold(rng: random.Random) -> Plan:
    """Displacements that no stage has: the calibrator does not go over the range, unless they are accepted."""
    scale = rng.choice((1e-8, 1e-2))
    driver = _driver(
        device="labjack", channels=["DAC0:AIN0"], amplifier_gain=20.0, sensor_scale=scale, voltage_max=90.0
    )
    begun, known = (_device("labjack"), driver), {"voltage_max": 90.0}
    return Plan(
        "unit not told", ("a",),
        (
            Step((*begun, _mover("a", CALIBRATOR, **known), ("leaves", "a")), may=("a",), below=0.5 * TOP),
            Step(
                (_mover("a", CALIBRATOR, **known | {"output": "FOLDER/again", "accept_units": True}),), ("a",),
                seconds=1.0,
            ),
        ),
    )  # fmt: skip


KINDS: tuple[Callable[[random.Random], Plan], ...] = (
    alone, second, second, second, at_once, restart, stage_again, two_stages, second_driver, foreign, exchanged,
    commander, block, hangup, unit, unit_untold,
)  # fmt: skip


class Life:
    """The processes of one plan in a namespace of their own, and what they say."""

    def __init__(self, plan: Plan, folder: Path, number: int) -> None:
        from diagnostic_msgs.msg import DiagnosticStatus
        from sensor_msgs.msg import JointState
        from trajectory_msgs.msg import JointTrajectory

        from benchmarks.node_lives import stage
        from benchmarks.speakers import Speakers
        from slpi_ros.model.document import save_model

        self._plan, self._folder, self._namespace = plan, folder, f"/life{number}"
        model = stage()
        save_model(replace(model, axes={"x": model.axes["x"]}, hardware_id=MINE), folder / "model.json")
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self._place = f"127.0.0.1:{free.getsockname()[1]}"
        self._processes: dict[str, subprocess.Popen[bytes]] = {}
        self._programs: dict[str, tuple[str, int]] = {}  # by name: program, and the number of messages at its start
        self._figures = Figures(plan.kind)
        self._speakers = speakers = Speakers(self._namespace)
        self._points = speakers.node.create_publisher(JointState, "desired_displacement", 100)
        self._blocks = speakers.node.create_publisher(JointTrajectory, "voltage_trajectory", 10)
        self._phases: list[tuple[str, float]] = []  # of blocks, and when they were told
        speakers.node.create_subscription(
            DiagnosticStatus, "voltage_trajectory_state",
            lambda status: self._phases.append((status.message, time.time())), 10,
        )  # fmt: skip
        speakers.node.create_timer(0.05, self._desire)
        speakers.begin()

    def close(self) -> None:
        """End every process that is left."""
        for process in self._processes.values():
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
        self._speakers.close()

    def run(self) -> Figures:
        """Live the plan."""
        figures, allowed = self._figures, set[str]()
        for step in self._plan.steps:
            first, times = len(self._speakers.said), {}
            for act, *given in step.acts:
                times[act] = getattr(self, f"_{act}")(*given)
            self._await(step)
            time.sleep(step.seconds)
            ended = {str(act[1]) for act in step.acts if act[0] in ("end", "leaves")}
            said = self._speakers.said[first:]
            after = {*step.must, *step.may}
            before = allowed | (set(step.may) if ended else after)
            if step.one_of:
                counts = Counter(each.name for each in said if each.topic == COMMAND and each.name in step.must)
                before = after = {name for name, _ in counts.most_common(1)}
            border = self._border(times, [each.at for each in self._speakers.said if each.name in ended - after])
            for each in said:
                good = each.name in (before if each.at <= border else after) and max(each.voltages) < step.below
                if each.name in self._plan.judged and not good:
                    late = f"{border - each.at:.2f} s too early" if each.at < border else ""
                    self._wrong(f"in '{step}' {each.name} on {each.topic}", f"{each.voltages} V, {late}")
            allowed = after
        figures.unknown = sum(each.name not in self._programs for each in self._speakers.said)
        return figures

    @staticmethod
    def _border(times: Mapping[str, float | None], last: Sequence[float]) -> float:
        """Return the time until which the step before holds: that of the `last` word of what ended, if it said any."""
        told = times.get("settle") or times.get("played")
        return told or max(last, default=times.get("end") or times.get("leaves") or 0.0)

    def _wrong(self, what: str, told: str) -> None:
        """Count it; tell the first one of its kind."""
        self._figures.wrong += 1
        if not any(each.startswith(what) for each in self._figures.told):
            self._figures.told.append(f"{what}: {told}")

    def _await(self, step: Step) -> None:
        """Wait until what must speak does, each or one of them."""
        begun, first = time.time(), len(self._speakers.said)
        waiting = set(step.must)
        while waiting and time.time() < begun + PATIENCE:
            time.sleep(0.02)
            spoken = {each.name for each in self._speakers.said[first:]} & waiting
            waiting = set() if spoken and step.one_of else waiting - spoken
        self._figures.moved += len(step.must) - len(waiting) if not step.one_of else not waiting
        self._figures.slowest = max(self._figures.slowest, time.time() - begun if step.must else 0.0)
        for name in waiting:
            self._figures.refused += 1
            log = (self._folder / f"{name}.log").read_text()[-1500:]
            self._figures.told.append(f"{name} is silent in '{step}': {self._processes[name].poll()}, {log}")

    # Acts; each may return a time (s) until when the step before holds.

    def _start(self, name: str, program: str, given: dict[str, object], nohup: bool = False) -> None:
        words = [word for key, value in given.items() for word in ("-p", f"{key}:={self._text(value)}")]
        ros = ["--ros-args", "-r", f"__ns:={self._namespace}", "-r", f"__node:={name}", *words]
        ran = [str(EXECUTABLES / program)] if program else [sys.executable, __file__, "--repeat"]
        with (self._folder / f"{name}.log").open("ab") as log:
            self._processes[name] = subprocess.Popen(
                ["nohup", *ran, *ros] if nohup else [*ran, *ros], stdin=subprocess.DEVNULL, stdout=log, stderr=log,
                start_new_session=True,
            )  # fmt: skip
        self._programs[name] = program, len(self._speakers.said)

    def _text(self, value: object) -> str:
        places = {"MODEL": str(self._folder / "model.json"), "PLACE": self._place}
        if isinstance(value, str):
            return json.dumps(places.get(value, value.replace("FOLDER", str(self._folder))))
        return json.dumps(value)

    def _end(self, name: str, number: signal.Signals) -> float:
        process = self._processes[name]
        with suppress(ProcessLookupError):
            os.killpg(process.pid, number)
        self._leaves(name)
        ended = time.time()
        if number != signal.SIGKILL:
            self._require_rest(name)
        return ended

    def _leaves(self, name: str) -> float:
        try:
            self._processes[name].wait(PATIENCE)
        except subprocess.TimeoutExpired:
            self._wrong(f"{name} does not end", (self._folder / f"{name}.log").read_text()[-1500:])
            os.killpg(self._processes[name].pid, signal.SIGKILL)
            self._processes[name].wait()
        time.sleep(0.1)
        return time.time()

    def _require_rest(self, name: str) -> None:
        """Count it if exciter or calibrator leave the stage elsewhere than at rest."""
        program, first = self._programs[name]
        said = [each.voltages for each in self._speakers.said[first:] if each.name == name]
        rest = {EXCITER: said[:1], CALIBRATOR: [(0.0,)]}.get(program)
        if rest and said and abs(said[-1][0] - rest[0][0]) > 0.01:
            self._figures.left += 1
            self._figures.told.append(f"{program} {name} leaves the stage at {said[-1]} V, not at {rest[0]} V")

    def _wait(self, seconds: float) -> None:
        time.sleep(seconds)

    def _settle(self, seconds: float) -> float:
        time.sleep(seconds)
        return time.time()

    def _heard(self, name: str) -> None:
        self._await(Step((), (name,)))

    def _hang_up(self, name: str) -> None:
        os.killpg(self._processes[name].pid, signal.SIGHUP)

    def _play(self, seconds: float) -> None:
        """Let the driver play a block from 0 V up, and wait until it does."""
        from builtin_interfaces.msg import Duration
        from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

        count = round(seconds * 50)
        points = [
            JointTrajectoryPoint(
                effort=[40.0 * k / count], time_from_start=Duration(sec=k // 50, nanosec=k % 50 * 20_000_000)
            )
            for k in range(1, count + 1)
        ]
        while not self._blocks.get_subscription_count():
            time.sleep(0.05)
        time.sleep(1.0)
        self._blocks.publish(JointTrajectory(joint_names=["x"], points=points))
        self._phase("playing")

    def _played(self) -> float:
        # Others may hear of the end a little before.
        return self._phase("ended") - 0.2

    def _phase(self, wanted: str) -> float:
        begun = time.time()
        while time.time() < begun + PATIENCE:
            if at := [at for phase, at in self._phases if phase == wanted]:
                return at[0]
            time.sleep(0.02)
        self._wrong(f"no block is {wanted}", str(self._phases))
        return time.time()

    def _desire(self) -> None:
        from sensor_msgs.msg import JointState

        y = 2.5e-6 - 1.5e-6 * math.cos(time.monotonic())
        self._points.publish(JointState(name=["x"], position=[y]))


def live(number: int, seed: int, only: str = "") -> Figures:
    """Live one life."""
    rng = random.Random(f"{seed} {number}")
    kinds = [kind for kind in KINDS if not only or kind.__name__ == only]
    plan = kinds[number % len(kinds)](rng)
    print(f"life {number}: {plan}", flush=True)
    with tempfile.TemporaryDirectory() as folder:
        life = Life(plan, Path(folder), number)
        try:
            return life.run()
        finally:
            life.close()


def table(lives: Sequence[Figures]) -> int:
    """Print the counts of each kind; return how many voltages and refusals are wrong."""
    kinds: dict[str, list[Figures]] = defaultdict(list)
    for each in lives:
        kinds[each.kind].append(each)
    print(f"{'kind':<28} {'lives':>5} {'moved':>6} {'refused':>8} {'wrong V':>8} {'not at rest':>12} {'slowest s':>10}")
    rows = [*sorted(kinds.items()), ("all", list(lives))]
    for kind, own in rows:
        sums = [sum(getattr(each, name) for each in own) for name in ("moved", "refused", "wrong", "left")]
        print(
            "{:<28} {:5d} {:6d} {:8d} {:8d} {:12d} {:10.1f}".format(kind, len(own), *sums, max(x.slowest for x in own))
        )
    return sum(each.wrong + each.refused + each.left for each in lives)


def own_domain() -> None:
    """Give a worker a domain of its own."""
    os.environ.pop(OWN, None)
    keep_to_own_domain()


def main(count: int, seed: int, workers: int, only: str = "") -> int:
    """Live all lives; print what was wrong, and the table."""
    print(f"seed {seed}; load of the machine before: {os.getloadavg()[0]:.2f}")
    found: list[Figures] = []
    with ProcessPoolExecutor(workers, get_context("spawn"), own_domain) as pool:
        for done in as_completed([pool.submit(live, number, seed, only) for number in range(count)]):
            found.append(done.result())
            for told in found[-1].told:
                print(f"  {found[-1].kind}: {told}", flush=True)
    print(f"load of the machine after: {os.getloadavg()[0]:.2f}")
    return table(found)


def repeat() -> None:
    """Be a program that repeats a voltage."""
    import rclpy
    from std_msgs.msg import Float64MultiArray

    rclpy.init()
    node = rclpy.create_node("somebody")
    commands = node.create_publisher(Float64MultiArray, COMMAND, 100)
    node.create_timer(0.8, lambda: commands.publish(Float64MultiArray(data=[REPEATED])))
    with suppress(KeyboardInterrupt, rclpy.executors.ExternalShutdownException):
        rclpy.spin(node)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--repeat"]:
        repeat()
        sys.exit()
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--lives", type=int, default=200)
    parser.add_argument("--seed", type=int, default=int(time.time()))
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--only", default="", choices=[kind.__name__ for kind in KINDS], help="lives of one kind")
    options = parser.parse_args()
    sys.exit(bool(main(options.lives, options.seed, options.workers, options.only)))
