"""Lives of compensator processes under random faults, and a long run at 1 kHz, each judged against fixed promises.

In every life: no voltage leaves its limits, every accepted message is answered, every message that was sent is counted
as accepted or rejected, the answers are those of a twin without ROS that has seen the accepted samples only, and what
the memory file holds afterwards is the memory of that twin.
"""

import copy
import os
import random
import signal
import subprocess
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import ExitStack, suppress
from itertools import groupby
from math import inf
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from slpi_ros.compensator.controller import Controller
from slpi_ros.compensator.persistence import SavedAxis, load_memory, model_id
from slpi_ros.compensator.statistics import COUNTED
from slpi_ros.compensator.validation import RejectedError
from slpi_ros.errors import SlpiError
from slpi_ros.hysteresis.prandtl_ishlinskii import PrandtlIshlinskii
from slpi_ros.hysteresis.turning_points import Memory
from slpi_ros.model.axis_model import AxisModel, FitQuality, Start
from slpi_ros.model.document import format_model, parse_model, save_model
from slpi_ros.model.limits import Limits
from slpi_ros.model.stage_model import StageModel

AXES = ["x", "y"]
LOW, HIGH = 2.0, 98.0
START_NS, MS = 1_700_000_000_000_000_000, 1_000_000
NAN, INF = float("nan"), inf
# What a second publisher of voltage_command says: no voltage of the node, so that the two can be told apart.
# Messages sent at once and not yet answered: fewer than the node's queue holds.
BURST = 8
BAD = [
    (AXES, [1e-6, NAN]), (AXES, [INF, 1e-6]), (["x", "z"], [1e-6, 1e-6]), ([], []), (["x", "x"], [1e-6, 1e-6]),
    (AXES, [1e-6]), (AXES, [1e-6, 1.0]), (AXES, [1e300, 1e-6]), ([""], [1e-6]), (["\x1b[2J" * 1000], [1e-6]),
    ([f"a{k}" for k in range(2000)], [1e-6] * 2000),
]  # fmt: skip
ENDS = {signal.SIGKILL: "kill -9", signal.SIGINT: "SIGINT", signal.SIGTERM: "SIGTERM"}


def shape(scale: float = 1.0) -> PrandtlIshlinskii:
    """Return the hysteresis of one axis, with displacements scaled by `scale`."""
    return PrandtlIshlinskii(np.array([0.0, 5.0, 15.0, 30.0]), scale * np.array([6e-8, 2e-8, 1e-8, 1e-8]))


def stage(scale: float = 1.0, created: str = "2026-01-02T03:04:05+00:00") -> StageModel:
    """Return a small model of two axes whose displacements are scaled by `scale`."""
    loops = shape(scale)
    top = Memory(loops).forward(100.0)
    quality = FitQuality(8e-9, 3e-8, 8e-9, 8e-9, 1000, 0.9, "made by hand")
    axis = AxisModel("pi", loops, Start(0.0, 0.0), (0.0, 100.0), (0.0, top), quality)
    return StageModel(dict.fromkeys(AXES, axis), "stage", created)


def mutated(data: bytes, rng: random.Random) -> bytes:
    """Return data with one to four faults: bits, bytes, numbers, lengths, cuts, repetitions and exchanged parts."""
    found = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        at, size = rng.randrange(len(found) + 1), rng.choice((1, 1, 2, 4, 8, 64))
        match rng.randrange(8):
            case 0 if at < len(found):
                found[at] ^= 1 << rng.randrange(8)
            case 1:
                found[at : at + size] = rng.randbytes(size)
            case 2:
                found[at : at + 4] = rng.choice((0, 1, 2**31 - 1, 2**32 - 1, len(found))).to_bytes(4, "little")
            case 3:
                found[at : at + 8] = rng.choice((0, 2**62, 2**63, 2**64 - 1)).to_bytes(8, "little")
            case 4:
                del found[at:]
            case 5:
                del found[at : at + size]
            case 6:
                found[at:at] = found[at : at + size] * rng.choice((1, 2, 100))
            case _:
                words = (b"nan", b"1e400", b"-0", b'"', b"\0", b"\x1b[2J", b",,", b"[[[[", b"\xff\xfe", b"null", b"\r")
                found[at:at] = rng.choice(words)
    return bytes(found)


def require_limits(voltages: Sequence[float]) -> None:
    """Raise AssertionError if a voltage (V) is outside of the limits. Steps and rates: `benchmarks/steps.py`."""
    for v in voltages:
        assert LOW <= v <= HIGH, f"{v} V outside of the limits"


class Twin:
    """What a compensator must answer: a controller without ROS that sees what the node accepts."""

    def __init__(self, model: StageModel, saved: dict[str, SavedAxis] | None = None) -> None:
        # Without rate limits the answers do not depend on when they are given.
        self.controller = Controller(AXES, [Limits(LOW, HIGH)] * 2)
        self.controller.activate(0)
        self.controller.use_model(model, saved)
        self.answers: list[list[float]] = []  # those that differ from the one before

    def desire(self, names: Sequence[str], row: Sequence[float], stamp_ns: int) -> bool:
        """Take a message; return whether it is accepted. AssertionError if the answer breaks a promise."""
        try:
            self.controller.update(stamp_ns, names, row, 0)
        except RejectedError:
            return False
        answer = list(self.controller.voltages)
        require_limits(answer)
        if answer not in self.answers[-1:]:
            self.answers.append(answer)
        return True

    @property
    def counters(self) -> dict[str, str]:
        """Counters that the node must report."""
        counts = self.controller.counts
        causes = {name: counts[name] for name in COUNTED if name.startswith("rejected.")}
        kept = ("received", "accepted", "rejected", "held_at_limit", "slew_limited", "gaps", "time_jumps")
        return {key: str(value) for key, value in ({name: counts[name] for name in kept} | causes).items()}

    @property
    def memory(self) -> dict[str, tuple[float, ...]]:
        """Reversal voltages of each axis, followed by the last voltage."""
        return {axis.name: axis.reversal_voltages for axis in self.controller.axes}


def common(some: list[list[float]], others: list[list[float]]) -> int:
    """Return the number of voltages, from the first on, in which two lists agree."""
    pairs = zip(some, others, strict=False)
    return next((k for k, (one, other) in enumerate(pairs) if one != other), min(len(some), len(others)))


Message = tuple[Sequence[str], Sequence[float], int]


def merged(twin: Twin, first: list[Message], second: list[Message], answers: list[list[float]]) -> Twin | None:
    """Return the twin after two senders' messages, in the order that explains the answers; None if there is none."""
    if not first and not second:
        return twin if twin.answers == answers else None
    for ahead, other, turned in ((first, second, False), (second, first, True)):
        if ahead:
            tried = copy.deepcopy(twin)
            if tried.desire(*ahead[0]) and tried.answers != answers[: len(tried.answers)]:
                continue
            found = merged(tried, *((other, ahead[1:]) if turned else (ahead[1:], other)), answers)
            if found:
                return found
    return None


class Disk:
    """Where a memory file lies, and what goes wrong with it."""

    KINDS = ("none", "good", "good", "no folder", "/proc", "/dev/full", "broken file", "full", "read-only")

    def __init__(self, kind: str, folder: Path, ends: ExitStack) -> None:
        self.kind, self._folder = kind, folder / "disk"
        self._folder.mkdir()
        if kind in ("full", "read-only"):
            # Without the right to mount, a device that is always full and a folder that takes no file stand for these.
            mounted = subprocess.run(
                ["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", self._folder], stderr=subprocess.DEVNULL
            )
            if mounted.returncode:
                self.kind = {"full": "/dev/full", "read-only": "/proc"}[kind]
            else:
                ends.callback(subprocess.run, ["umount", "-l", self._folder], check=True)
        places = {"none": "", "no folder": folder / "nowhere" / "m.json", "/proc": "/proc/m.json"}
        self.path = str(places.get(self.kind, self.kind if self.kind == "/dev/full" else self._folder / "memory.json"))
        if kind == "broken file":
            Path(self.path).write_bytes(os.urandom(100))

    @property
    def writable(self) -> bool:
        """Whether the memory can be written all the time."""
        return self.kind in ("good", "broken file")

    def spoil(self) -> None:
        """Let the disk run full, or become read-only."""
        if self.kind == "full":
            with suppress(OSError), (self._folder / "junk").open("wb", buffering=0) as file:
                for _ in range(64):
                    file.write(bytes(4096))
        elif self.kind == "read-only":
            subprocess.run(["mount", "-o", "remount,ro", self._folder], check=True)

    def mend(self) -> None:
        """Undo `spoil`."""
        if self.kind == "full":
            (self._folder / "junk").unlink(missing_ok=True)
        elif self.kind == "read-only":
            subprocess.run(["mount", "-o", "remount,rw", self._folder], check=True)


class Life:
    """One or two runs of a compensator in one place: the second one begins with what the first one has left."""

    def __init__(self, rng: random.Random, folder: Path, namespace: str, ends: ExitStack) -> None:
        self.rng, self.namespace = rng, namespace
        self.counts: Counter[tuple[str, str]] = Counter()
        self.disk = Disk(rng.choice(Disk.KINDS), folder, ends)
        self.model, self.now = stage(), START_NS
        save_model(self.model, folder / "model.json")
        self.given: dict[str, object] = {
            "axes": AXES, "model_file": str(folder / "model.json"), "voltage_min": LOW, "voltage_max": HIGH,
            "slew_limit": 0.0,
        }  # fmt: skip
        if self.disk.path:
            self.given["memory_file"] = self.disk.path

    def note(self, fault: str, refused: int = 0) -> None:
        """Count a fault, and how often it was refused as it should be."""
        self.counts[fault, "tried"] += 1
        self.counts[fault, "refused"] += refused

    def run(self) -> None:
        """Live one run; AssertionError if anything is wrong."""
        from nodes.compensator_client import compensator

        rng = self.rng
        number = rng.choice(list(ENDS))
        kept = None
        with suppress(SlpiError):
            saved = load_memory(self.disk.path)
            if saved:
                saved.require_fit(self.model, AXES)
                kept = dict(saved.axes)
        self.twin = Twin(self.model, kept)
        if self.disk.kind in ("no folder", "/proc", "/dev/full", "broken file"):
            self.note(f"memory file: {self.disk.kind}")
        elif self.disk.kind in ("full", "read-only") and rng.random() < 0.6:
            self.disk.spoil()
            self.note(f"disk {self.disk.kind} from the start")
        remapping = ("-r", f"__ns:={self.namespace}")
        with compensator(*remapping, namespace=self.namespace, **self.given) as client:
            if rng.random() < 0.2:
                time.sleep(rng.uniform(0.0, 3.0))
                code = client.node.stop(number)
                self.note(f"{ENDS[number]} during the start")
                said = client.node.stderr
                # Nobody can catch a signal before the interpreter runs the first line of the package.
                assert code in (0, -number) or "import_module" not in said, f"exit code {code}: {said[-500:]}"
                assert "Traceback" not in said or "import_module" not in said, said[-500:]
                if code and number != signal.SIGKILL:
                    self.note(f"{ENDS[number]} before the interpreter was ready")
                return
            client.connect()
            self.client = client
            self._move()
            self._end(number)

    # In motion

    @property
    def answers(self) -> list[list[float]]:
        """Voltages of the node so far, volts, that differ from the one before: it repeats its last one."""
        return [answer for answer, _ in groupby(self.client.answers)]

    def _move(self) -> None:
        from nodes.ros_helpers import LATCHED, RELIABLE
        from sensor_msgs.msg import JointState
        from std_msgs.msg import String

        graph = self.client.graph
        self._models = graph.publisher(String, f"{self.namespace}/stage_model", LATCHED)
        self._second = graph.publisher(JointState, f"{self.namespace}/desired_displacement", RELIABLE)
        self._measured = graph.node.create_publisher(JointState, f"{self.namespace}/measured_displacement", RELIABLE)
        self._refused = self._swaps = 0
        faults = (
            self._bad_message, self._late_message, self._clock_jump, self._hostile_model, self._new_model,
            self._second_sender, self._pause, self._disk_fault, self._bad_measurement,
        )  # fmt: skip
        for _ in range(self.rng.randint(20, 60)):
            if self.rng.random() < 0.6:
                self.rng.choice(faults)()
            for _ in range(self.rng.randint(1, BURST)):
                self._send(*self._sample())
            self._settle()
        self.disk.mend()
        self.client.report(**self.twin.counters)

    def _sample(self) -> Message:
        """Return a valid message, later than those before."""
        self.now += self.rng.choice((1, 2, 5, 50)) * MS
        top = min(axis.model.displacement_range[1] for axis in self.twin.controller.axes if axis.model)
        return AXES, [self.rng.uniform(0.0, top) for _ in AXES], self.now

    def _send(self, names: Sequence[str], row: Sequence[float], stamp_ns: int) -> bool:
        """Send a message to the node and to its twin; return whether it must be accepted."""
        self.client.wish(names, row, stamp_ns)
        return self.twin.desire(names, row, stamp_ns)

    def _settle(self) -> None:
        expected = len(self.twin.answers)
        self.client.graph.spin_until(lambda: len(self.answers) >= expected, f"{expected} answers")
        answers, due = self.answers, self.twin.answers
        k = common(answers, due)
        assert len(answers) == len(due) == k, f"answer {k} of {expected} is {answers[k:][:2]}, not {due[k:][:2]} V"

    def _bad_message(self) -> None:
        names, row = self.rng.choice(BAD)
        self.note("NaN and other bad messages", not self._send(names, row, self.now + 1))

    def _late_message(self) -> None:
        back_ns = self.rng.choice((0, 1, 5 * MS, 900 * MS))
        self.note("late or repeated stamps", not self._send(AXES, [1e-6, 1e-6], self.now - back_ns))

    def _clock_jump(self) -> None:
        self.now += self.rng.choice((100, -100, 10**6, -(10**6), -3)) * 10**9
        self.note("clock jumps")

    def _hostile_model(self) -> None:
        from std_msgs.msg import String

        text = format_model(self.model)
        text = mutated(text.encode(), self.rng).decode(errors="ignore").replace("\0", "")
        if self._publish_model(text, String):
            self.note("hostile models")
        else:
            self.note("hostile models", refused=1)

    def _new_model(self) -> None:
        from std_msgs.msg import String

        self._swaps += 1
        self._publish_model(format_model(stage(self.rng.uniform(0.9, 1.1), f"model {self._swaps}")), String)
        self.note("new models")

    def _publish_model(self, text: str, kind: Any) -> bool:
        """Publish a model document and wait until the node has used or refused it; return whether it is in use."""
        self._models.publish(kind(data=text))
        try:
            model = parse_model(text, "here")
            # The same model again changes nothing.
            if model_id(model) != model_id(self.model):
                self.twin.controller.use_model(model)
        except SlpiError:
            self._refused += 1
            self.client.report(models_refused=self._refused)
            return False
        self.model = model
        self.client.report(
            **{"model.id": model_id(model)[:12], "models_refused": self._refused, "last_model_error": ""}
        )
        return True

    def _second_sender(self) -> None:
        """Let a second publisher of desired_displacement send at the same time; any order may come of it."""
        from nodes.compensator_client import wish

        messages = [self._sample() for _ in range(6)]
        senders = self.client.publish, self._second.publish
        # One after the other, or all of one sender first, so that some are late.
        order = self.rng.choice(((0, 1, 2, 3, 4, 5), (1, 3, 5, 0, 2, 4), (0, 2, 4, 1, 3, 5)))
        for k in order:
            senders[k % 2](wish(*messages[k]))
        received = self.twin.controller.counts["received"] + len(messages)
        _, values = self.client.report(received=received)
        accepted = int(values["accepted"])
        self.client.graph.spin_until(lambda: self.client.answered >= accepted, f"{accepted} answers")
        self.client.graph.spin_for(0.1)
        found = merged(self.twin, messages[::2], messages[1::2], self.answers)
        assert found, "no order of the two senders' messages explains the answers"
        refused = found.controller.counts["rejected"] - self.twin.controller.counts["rejected"]
        self.twin = found
        self.note("second publishers of desired_displacement", refused)

    def _pause(self) -> None:
        """Stop the process for a while, as a busy machine does."""
        pid = self.client.node.process.pid
        os.killpg(pid, signal.SIGSTOP)
        for _ in range(BURST):
            self._send(*self._sample())
        time.sleep(self.rng.uniform(0.0, 0.3))
        os.killpg(pid, signal.SIGCONT)
        self._settle()
        self.note("pauses of the process")

    def _disk_fault(self) -> None:
        # A disk with a file that is open for writing cannot become read-only.
        if self.disk.kind == "full":
            self.disk.spoil()
            self.note("disk full, later")

    def _bad_measurement(self) -> None:
        from sensor_msgs.msg import JointState

        value = self.rng.choice((NAN, INF, -1.0, 1e300))
        self._measured.publish(JointState(name=AXES, position=[value, value]))
        self.note("bad measurements")

    # The end

    def _end(self, number: int) -> None:
        """End the node in the middle of a burst; check what it said and what its memory file holds."""
        before, burst = copy.deepcopy(self.twin), [self._sample() for _ in range(BURST)]
        for message in burst:
            self._send(*message)
        if self.rng.random() < 0.5:
            self._settle()
        code = self.client.node.stop(number)
        self.client.graph.tested = None
        self.client.graph.spin_for(0.3)
        self.note(f"{ENDS[number]} in motion")
        assert code == (0 if number != signal.SIGKILL else -number), f"exit code {code} after signal {number}"
        assert "Traceback" not in self.client.node.stderr, self.client.node.stderr[-500:]
        answers = self.answers
        known = common(answers, self.twin.answers)
        assert known >= len(before.answers), "answers are lost or wrong"
        assert not answers[known:], f"unknown answers {answers[known:][:3]}"
        last = answers[known - 1]
        for message in burst:
            if len(before.answers) < known:
                assert before.desire(*message)
        if self.disk.writable:
            self._check_memory(number, before, known, last)

    def _check_memory(self, number: int, accepted: Twin, known: int, last: list[float]) -> None:
        """Compare the memory file with the memory of the twin that has seen the first `known` accepted samples."""
        memory = load_memory(self.disk.path)
        assert memory and memory.model == model_id(self.model), "the memory file belongs to another model"
        voltages = [memory.axes[axis].reversal_voltages[-1] for axis in AXES]
        if number == signal.SIGKILL:
            # The last voltage may have been published but not received, or published and not yet noted.
            assert not memory.complete
            assert voltages in self.twin.answers[max(known - 2, 0) :], "the last voltage is not in the memory file"
            return
        assert memory.complete and voltages == last, f"the memory file ends at {voltages} V, the answers at {last} V"
        found = {axis: memory.axes[axis].reversal_voltages for axis in AXES}
        assert found == accepted.memory, "the memory file is not the memory of the twin"


def live(seed: int, number: int) -> tuple[int, str, Counter[tuple[str, str]]]:
    """Live one life; return its number, what was wrong with it, and its faults."""
    rng = random.Random(f"{seed} life {number}")
    counts: Counter[tuple[str, str]] = Counter()
    wrong = ""
    with tempfile.TemporaryDirectory() as temporary, ExitStack() as ends:
        try:
            life = Life(rng, Path(temporary), f"/life_{seed}_{number}", ends)
            counts = life.counts
            for _ in range(rng.choice((1, 1, 2))):
                counts["runs of a node", "tried"] += 1
                life.run()
                save_model(life.model, Path(temporary) / "model.json")
                life.disk.mend()
        except Exception as error:
            wrong = f"{type(error).__name__}: {str(error)[-600:]}"
    return number, wrong, counts


def _begin_worker() -> None:
    os.environ["ROS_DOMAIN_ID"] = str(1 + os.getpid() % 100)
    # A shell starts background jobs with SIGINT ignored, which the nodes would inherit.
    signal.signal(signal.SIGINT, signal.default_int_handler)


def lives(count: int, seed: int, workers: int = 1, minutes: float = inf) -> list[tuple[str, Counter[str]]]:
    """Live many lives, several at once; return how often each fault was tried and refused, and what was wrong.

    After `minutes` no new life begins.
    """
    total: dict[str, Counter[str]] = {"node lives": Counter()}
    deadline = time.monotonic() + 60.0 * minutes
    with ProcessPoolExecutor(workers, get_context("spawn"), _begin_worker) as pool:
        pending = {pool.submit(live, seed, number) for number in range(min(count, 2 * workers))}
        begun = len(pending)
        while pending:
            done = next(as_completed(pending))
            pending.remove(done)
            if begun < count and time.monotonic() < deadline:
                pending.add(pool.submit(live, seed, begun))
                begun += 1
            number, wrong, counts = done.result()
            total["node lives"]["tried"] += 1
            if wrong:
                total["node lives"]["wrong"] += 1
                print(f"wrong: life {number} of seed {seed}: {wrong}", flush=True)
            for (fault, what), times in counts.items():
                total.setdefault(f"  {fault}", Counter())[what] += times
            if total["node lives"]["tried"] % 25 == 0:
                said = total["node lives"]
                print(f"{said['tried']} of {count} lives, {said['wrong']} wrong", flush=True)
    return sorted(total.items(), key=lambda item: (item[0] != "node lives", item[0]))
