"""Faults: mutated files over all readers, node lives under random faults, a long run, and a day at accelerated time.

Prints a table of what was tried, refused and wrong. Wrong is a reader that raises anything but its own one-line error,
takes more than `PATIENCE` seconds or returns what cannot be used, and every broken promise of `node_lives` and
`feedback_soak`. Every case is drawn from the printed seed and its number alone.
"""

import argparse
import os
import random
import resource
import shutil
import signal
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from math import inf
from pathlib import Path
from types import FrameType

import numpy as np
from scipy.io import savemat

sys.path.append(str(Path(__file__).resolve().parents[1]))
sys.path.append(str(Path(__file__).resolve().parents[1] / "test"))

from benchmarks import kept
from benchmarks.node_lives import AXES, MS, START_NS, Twin, lives, mutated, stage
from slpi_ros.compensator.persistence import SavedAxis, SavedMemory, load_memory, model_id, save_memory
from slpi_ros.errors import SlpiError
from slpi_ros.io.bag_reader import read_bag
from slpi_ros.io.bag_writer import write_bag
from slpi_ros.io.messages import JOINT_STATE, JointStates, decode_trajectory, encode_joint_states, read_message
from slpi_ros.io.record import Record
from slpi_ros.io.tables import import_table, read_table, write_table
from slpi_ros.model.document import format_model, load_model, parse_model, save_model
from slpi_ros.model.stage_model import StageModel

# Seconds after which a reader counts as hanging.
PATIENCE = 20.0
# Bytes of a mutated file; repetitions would let it grow with every generation.
LONGEST = 200_000
# Part of a file name that tells the code of the package.
PACKAGE = f"{os.sep}slpi_ros{os.sep}"


class Overdue(BaseException):
    """A reader takes too long."""


@contextmanager
def at_most(seconds: float) -> Iterator[None]:
    """Raise Overdue in the ``with`` block after `seconds`."""

    def ring(number: int, frame: FrameType | None) -> None:
        raise Overdue

    before = signal.signal(signal.SIGALRM, ring)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def usable_record(record: Record) -> None:
    """Raise AssertionError if a record that was read is not what it promises to be."""
    assert record.axes and all(axis.isprintable() for axis in record.axes)
    assert all(record.voltage[axis].shape == record.time_ns.shape for axis in record.axes)


def usable_model(model: StageModel) -> None:
    """Raise AssertionError if a model that was read cannot be written, or commands voltages outside of its limits."""
    parse_model(format_model(model), "again")
    for name, axis in model.axes.items():
        low, high = axis.voltage_range
        y = np.linspace(*axis.displacement_range, 30)
        with warnings.catch_warnings(), suppress(SlpiError):
            warnings.simplefilter("ignore")
            v = model.compensate(np.arange(30.0), {name: y})[name]
            assert ((low <= v) & (v <= high)).all()


def from_bytes(data: bytes) -> None:
    """Decode a message as the nodes and the bag reader do."""
    JointStates().read(data)
    decode_trajectory(data)
    with suppress(Exception):
        # The bag reader translates whatever this raises.
        read_message(data, JOINT_STATE)


Reader = tuple[bytes, str, Callable[[Path], object]]


def readers(folder: Path) -> dict[str, Reader]:
    """Return, for each reader, a good file's content, its suffix, and what reads and uses it."""
    t = np.arange(300) * 0.01
    v = {axis: 50.0 - 50.0 * np.cos(3.0 * t + k) for k, axis in enumerate(AXES)}
    model = stage()
    record = Record(START_NS + (t * 1e9).astype(np.int64), v, model.simulate(t, v), hardware_id="stage")
    found: dict[str, Reader] = {}
    for storage, suffix in (("mcap", ".mcap"), ("sqlite3", ".db3")):
        write_bag(folder / storage, record, storage=storage)
        (file,) = (folder / storage).glob(f"*{suffix}")
        found[f"bag, {storage}"] = file.read_bytes(), suffix, lambda path: usable_record(read_bag(path))

    def in_folder(path: Path) -> None:
        shutil.copy(path, folder / "mcap" / "metadata.yaml")
        usable_record(read_bag(folder / "mcap"))

    found["bag, metadata"] = (folder / "mcap" / "metadata.yaml").read_bytes(), ".yaml", in_folder
    columns = {"time_s": t, "voltage_V": v["x"], "displacement_um": 1e6 * record.displacement["x"]}
    rows = np.column_stack([*columns.values()])
    np.savetxt(folder / "t.csv", rows, delimiter=",", header=",".join(columns), comments="")
    found["table, CSV"] = (folder / "t.csv").read_bytes(), ".csv", lambda path: usable_record(import_table(path))
    for packed in (False, True):
        savemat(folder / "t.mat", columns, do_compression=packed)
        name = f"table, MAT{' packed' * packed}"
        found[name] = (folder / "t.mat").read_bytes(), ".mat", lambda path: usable_record(import_table(path))
    write_table(folder / "v.csv", t, v, "V")
    found["table of a command"] = (folder / "v.csv").read_bytes(), ".csv", lambda path: read_table(path, "V")
    save_model(model, folder / "m.json")
    found["model"] = (folder / "m.json").read_bytes(), ".json", lambda path: usable_model(load_model(path))
    save_memory(SavedMemory(model_id(model), False, {"x": SavedAxis((1.0, 5.0), True)}), folder / "s.json")
    found["saved memory"] = (folder / "s.json").read_bytes(), ".json", load_memory
    message = next(encode_joint_states(record.time_ns[:1], np.zeros((1, 2)), np.zeros((1, 2)), tuple(AXES), "stage"))
    found["message"] = message, ".cdr", lambda path: from_bytes(path.read_bytes())
    return found


def fault_of(read: Callable[[Path], object], path: Path) -> tuple[bool, str]:
    """Read a file; return whether it is refused, and what is wrong; "" if nothing is."""
    try:
        with at_most(PATIENCE), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            read(path)
    except SlpiError as error:
        return True, "" if str(error).isprintable() and str(error) else f"no line to show: {str(error)!r}"
    except (Exception, Overdue) as error:
        return False, f"{type(error).__name__}: {error}"
    return False, ""


def steps_of(work: Callable[[], object]) -> tuple[object, frozenset[tuple[int, int, int]]]:
    """Return the result of `work`, and the steps from line to line of the package that it takes."""
    steps: set[tuple[int, int, int]] = set()

    def enter(frame: FrameType, event: str, _: object) -> object:
        if PACKAGE not in frame.f_code.co_filename:
            return None
        code, last = hash(frame.f_code), frame.f_lineno

        def step(frame: FrameType, event: str, _: object) -> object:
            nonlocal last
            steps.add((code, last, frame.f_lineno))
            last = frame.f_lineno
            return step

        return step

    before = sys.gettrace()
    sys.settrace(enter)
    try:
        return work(), frozenset(steps)
    finally:
        sys.settrace(before)


def files(count: int, seed: int, guided: bool = False) -> list[tuple[str, Counter[str]]]:
    """Feed mutated files to every reader; return how often each was tried, refused and wrong.

    Parameters
    ----------
    count : int
        Number of files.
    seed : int
    guided : bool
        Whether a file that takes a new step in the code of the package is mutated further (coverage-guided fuzzing);
        otherwise every file is a mutation of a good one. Default False.
    """
    rows = []
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        sources = readers(folder)
        for name, (good, suffix, read) in sources.items():
            counts: Counter[str] = Counter()
            path = folder / f"mutated{suffix}"
            path.write_bytes(good)
            read(path)
            kept = [good]
            known = set(steps_of(lambda: fault_of(read, path))[1]) if guided else set()  # noqa: B023
            for number in range(-(-count // len(sources))):
                rng = random.Random(f"{seed} {name} {number}")
                # Mutations of mutations are mostly refused at once: every other file is the good one with faults.
                data = mutated(good if rng.random() < 0.5 else rng.choice(kept), rng)[:LONGEST]
                path.write_bytes(data)
                counts["tried"] += 1
                steps: frozenset[tuple[int, int, int]] = frozenset()
                if guided:
                    (refused, fault), steps = steps_of(lambda: fault_of(read, path))  # type: ignore[misc] # noqa: B023
                else:
                    refused, fault = fault_of(read, path)
                if not steps <= known:
                    known |= steps
                    kept.append(data)
                counts["refused"] += refused
                if fault:
                    counts["wrong"] += 1
                    print(f"wrong: {name}, seed {seed}, number {number}: {fault[:200]}", flush=True)
            if guided:
                print(f"{name}: {len(known)} steps from line to line, {len(kept)} files kept", flush=True)
            rows.append((f"{name}, guided" if guided else name, counts))
    return rows


def long_life(hours: float, rate: float, seed: int) -> Counter[str]:
    """Stream `hours` of samples at `rate` (Hz) through a controller; a wrong one is a growth or a drift.

    Memory and the stack of reversals must not grow, and at the end a path is compensated as at the beginning.
    """
    twin, rng = Twin(stage()), np.random.default_rng(seed)
    top = float(stage().axes["x"].displacement_range[1])
    step_ns = int(1e9 / rate)
    now = START_NS
    # A whole sweep first and last: it wipes what was before, so that the same path must give the same voltages.
    sweep, waves = np.linspace(0.0, top, 200), 0.6 * top * np.sin(np.arange(300) / 40) ** 2
    test = [*sweep, *sweep[::-1], *waves]
    firsts: list[list[float]] = []
    samples = int(hours * 3600.0 * rate)
    sizes, counts = [], Counter({"tried": 1})
    block = max(samples // 20, 1)
    done = 0
    while done <= samples:
        answers = []
        for y in test:
            now += 100 * MS
            twin.desire(AXES, [float(y)] * 2, now)
            answers.append(twin.answers[-1])
        firsts = firsts or answers
        counts["wrong"] += bool(np.abs(np.array(answers) - firsts)[sweep.size :].max() > 1e-6)
        walk = top * (0.5 + 0.5 * np.sin(np.cumsum(rng.uniform(0.0, 0.3, block))) * rng.uniform(0.1, 1.0, block))
        for y in walk.tolist():
            now += step_ns
            twin.desire(AXES, [y, 0.5 * y], now)
        twin.answers.clear()
        done += block
        stack = max(len(axis.stream.memory.snapshot().turn_voltages) for axis in twin.controller.axes)
        sizes.append((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, stack))
    grown = sizes[-1][0] - sizes[len(sizes) // 3][0]
    counts["wrong"] += grown > 8192
    print(f"{hours:g} h at {rate:g} Hz: memory {grown:+d} KiB, at most {max(s for _, s in sizes)} reversals remembered")
    return counts


def table(rows: list[tuple[str, Counter[str]]]) -> int:
    """Print the table; return the number of wrong cases."""
    print(f"{'what':48} {'tried':>7} {'refused':>8} {'wrong':>6}")
    total: Counter[str] = Counter()
    for name, counts in rows:
        if not name.startswith(" "):
            # Indented rows are parts of the row above them.
            total += counts
        print(f"{name:48} {counts['tried']:7d} {counts['refused']:8d} {counts['wrong']:6d}")
    print(f"{'all':48} {total['tried']:7d} {total['refused']:8d} {total['wrong']:6d}")
    return total["wrong"]


def main() -> int:
    """Run the parts that were asked for; return 1 if anything was wrong."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--files", type=int, default=5000, help="mutated files; default: 5000")
    parser.add_argument("--guided", type=int, default=5000, help="the same, guided by coverage; default: 5000")
    parser.add_argument("--lives", type=int, default=500, help="lives of a compensator; default: 500")
    parser.add_argument("--workers", type=int, default=2, help="lives at the same time; default: 2")
    parser.add_argument("--lives-minutes", type=float, default=inf, help="no new life after these; default: no limit")
    parser.add_argument("--soak", type=float, default=30.0, help="minutes at 1 kHz; default: 30")
    parser.add_argument("--hours", type=float, default=24.0, help="simulated hours of one life; default: 24")
    parser.add_argument("--rate", type=float, default=50.0, help="samples a second of that life; default: 50")
    parser.add_argument("--seed", type=int, default=int(time.time()), help="default: the time")
    parser.add_argument("--keep", action="store_true", help=f"write the figures to {kept.KEPT.name}")
    options = parser.parse_args()
    # A shell starts background jobs with SIGINT ignored, and a node inherits that until its own handler is there.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    print(f"seed {options.seed}", flush=True)
    rows = files(options.files, options.seed) if options.files else []
    if options.guided:
        rows += files(options.guided, options.seed, guided=True)
    if options.hours:
        rows.append(("a long life", long_life(options.hours, options.rate, options.seed)))
    if options.lives:
        rows += lives(options.lives, options.seed, options.workers, options.lives_minutes)
    if options.soak:
        from benchmarks.feedback_soak import soak

        rows += soak(options.soak, options.seed)
    if options.keep:
        total = sum((counts for name, counts in rows if not name.startswith(" ")), Counter[str]())
        what = (
            "damaged bags, models and messages, full disks, clock jumps and `kill -9`: cases; refused; wrong, such as "
            "a traceback, a hang or a voltage outside of a limit"
        )
        said = f"{total['tried']:,}; {total['refused']:,}; {total['wrong']}"
        kept.write_row("faults", what, said, "make bench-faults")
    return 1 if table(rows) else 0


if __name__ == "__main__":
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    # Another compensator in the same domain would answer as well.
    os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
    sys.exit(main())
