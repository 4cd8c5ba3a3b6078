"""A fleet of simulated stages over a simulated year: what is found, and what it costs.

30 stages with 10 bags each of 12,000 samples: gain drifts of up to 5 %, steps, two exchanged stages, and broken bags of
ten kinds. Printed: broken bags with the right reason, changes of at least 1 % found with their date within one bag,
false alarms, exchanged stages; then the time with one and with two workers, and an estimate for a million bags.
"""

import argparse
import pickle
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from slpi_ros.excitation.drives import excite
from slpi_ros.fleet import bags, run
from slpi_ros.fleet.sources import find_bags
from slpi_ros.fleet.stages import StageSummary, summarise
from slpi_ros.io.bag_writer import write_bag
from slpi_ros.io.record import Record
from slpi_ros.simulation.axis import SimulatedAxis
from slpi_ros.simulation.parameters import AxisParameters

FloatArray = NDArray[np.float64]
DAY_NS, START_NS = 86_400 * 10**9, 1_767_225_600 * 10**9
NOISE, DIGIT, ZERO = 8e-9, 1e-9, 20e-9
SAMPLES, DURATION = 12_000, 60.0
# A change of at least this size must be found.
CHANGE = 0.01
# Number of empty bags in the measurement of the scheduler, and of tasks for a usual bag.
EMPTY, TASKS = 1000, 2


@dataclass(frozen=True)
class Truth:
    """What happened to a stage: the gain at each bag, and the stage that each bag is really of."""

    gains: FloatArray
    dates: NDArray[np.int64]
    really: tuple[int, ...]
    kind: str


def histories(stages: int, count: int, rng: np.random.Generator) -> list[Truth]:
    """Return the history of each stage: a third unchanged, drifts, steps, and the last two exchanged."""
    found = []
    for stage in range(stages):
        dates = START_NS + np.sort(rng.choice(365, count, replace=False)) * DAY_NS
        share = (dates - dates[0]) / (365 * DAY_NS)
        gains, really, kind = np.ones(count), [stage] * count, "none"
        if stage >= stages - 2:
            kind, other = "exchanged", 2 * stages - 3 - stage
            really = [other if date > START_NS + 182 * DAY_NS else stage for date in dates]
        elif stage % 3 == 1:
            kind, gains = "drift", 1.0 + rng.choice([-1, 1]) * rng.uniform(0.0, 0.05) * share
        elif stage % 3 == 2:
            kind = "step"
            gains[int(rng.integers(1, count)) :] += rng.choice([-1, 1]) * rng.uniform(0.01, 0.05)
        found.append(Truth(gains, dates, tuple(really), kind))
    return found


def healthy_record(path: FloatArray, drive: tuple[FloatArray, FloatArray], rng: np.random.Generator) -> Record:
    """Return a record of a path (m): sensor noise, digits and a zero of its own."""
    t, v = drive
    y = path + rng.normal(0.0, NOISE, path.size) + rng.normal(0.0, ZERO)
    return Record(np.rint(t * 1e9).astype(np.int64), {"x": v}, {"x": np.rint(y / DIGIT) * DIGIT})


def _cut(bag: Path) -> None:
    (file,) = bag.glob("*.mcap")
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])


def _emptied(bag: Path) -> None:
    (file,) = bag.glob("*.mcap")
    shutil.rmtree(bag)
    bag.with_suffix(".mcap").write_bytes(b"")


def _without_data(bag: Path) -> None:
    (file,) = bag.glob("*.mcap")
    file.unlink()


def _text(bag: Path) -> None:
    (file,) = bag.glob("*.mcap")
    file.write_text("time_s,x_V,x_um\n" * 100)


def _signals(record: Record, v: FloatArray | None = None, y: FloatArray | None = None) -> Record:
    return replace(
        record,
        voltage=record.voltage if v is None else {"x": v},
        displacement=record.displacement if y is None else {"x": y},
    )


def _short(record: Record) -> Record:
    v, y = record.voltage["x"][:20], record.displacement["x"][:20]
    return replace(record, time_ns=record.time_ns[:20], voltage={"x": v}, displacement={"x": y})


# Ten kinds of broken bags: changes of the record before it is written or of the written bag, and a word of the reason.
BROKEN: dict[str, tuple[Callable[[Record], Record] | None, Callable[[Path], None] | None, str]] = {
    "cut": (None, _cut, "damaged"),
    "empty file": (None, _emptied, "empty"),
    "data file missing": (None, _without_data, "damaged"),
    "text": (None, _text, "damaged"),
    "other topic": (None, None, "no topic"),
    "no voltage": (lambda r: _signals(r, v=np.full(len(r), np.nan)), None, "effort[] of any"),
    "no displacement": (lambda r: _signals(r, y=np.full(len(r), np.nan)), None, "position[] of any"),
    "few samples": (_short, None, "samples"),
    "constant voltage": (lambda r: _signals(r, v=np.full(len(r), 50.0)), None, "voltage"),
    "stamps backwards": (lambda r: replace(r, time_ns=r.time_ns[::-1].copy()), None, "backwards"),
}


def write_broken(place: Path, record: Record, kind: str) -> None:
    """Write a record as a broken bag."""
    changed, spoil, _ = BROKEN[kind]
    write_bag(
        place, changed(record) if changed else record, topic="/other" if kind == "other topic" else "/stage_state"
    )
    if spoil:
        spoil(place)


def write_fleet(folder: Path, stages: int, count: int, seed: int) -> tuple[list[Truth], dict[str, str]]:
    """Write all bags; return the truth of each stage, and the kind of each broken bag by its name."""
    rng = np.random.default_rng(seed)
    drive = excite(("x",), voltage_min=0.0, voltage_max=100.0, duration=DURATION, rate=SAMPLES / DURATION)
    t, v = drive.t[:SAMPLES], drive.voltage["x"][:SAMPLES]
    paths = [
        SimulatedAxis(replace(AxisParameters.random(seed + k), noise_rms=0.0, quantisation=0.0)).run(t, v)[0]
        for k in range(stages)
    ]
    truths = histories(stages, count, rng)
    every = [(stage, number) for stage in range(stages) for number in range(count)]
    spoiled = rng.choice(len(every), max(len(BROKEN), round(0.05 * len(every))), replace=False).tolist()
    kinds = {every[place]: list(BROKEN)[k % len(BROKEN)] for k, place in enumerate(spoiled)}
    broken = {}
    for stage, number in every:
        truth = truths[stage]
        record = healthy_record(paths[truth.really[number]] * truth.gains[number], (t, v), rng)
        record = replace(record, time_ns=record.time_ns + truth.dates[number], hardware_id=f"stage-{stage:03d}")
        place = folder / f"stage-{stage:03d}" / f"bag-{number:03d}"
        place.parent.mkdir(parents=True, exist_ok=True)
        if (stage, number) in kinds:
            write_broken(place, record, kinds[stage, number])
            broken[f"{place.parent.name}/{place.name}"] = kinds[stage, number]
        else:
            write_bag(place, record)
    return truths, broken


def judge(rows: list[bags.Row], truths: list[Truth], broken: dict[str, str]) -> Iterator[str]:
    """Yield lines with what was found and what was missed."""
    by_bag = {row.bag: row for row in rows}
    named = {"/".join(Path(path).with_suffix("").parts[-2:]): row for path, row in by_bag.items()}
    right = [name for name, kind in broken.items() if BROKEN[kind][2] in named[name].error]
    wrong = {f"{name} ({broken[name]})": named[name].error for name in broken if name not in right}
    yield f"broken bags: {len(right)} of {len(broken)} refused with the right reason; wrong: {wrong}"
    extra = [row.error for name, row in named.items() if row.verdict == bags.REFUSED and name not in broken]
    yield f"other refused bags: {len(extra)} {extra}"
    found, due, false, calm, exchanged = 0, 0, 0, 0, 0
    for one in summarise(rows):
        if one.axis != "x":
            continue
        truth = truths[int(one.stage.removeprefix("stage-"))]
        changes = [(name, each) for name in ("gain", "width") for each in one.changes[name]]
        if truth.kind == "exchanged":
            exchanged += any(_near(each.date_ns, _first(truth, one, _moved(truth)), one) for each in one.exchanges)
            continue
        size = float(np.ptp(truth.gains[_kept(truth, one)]))
        if truth.kind == "none":
            calm, false = calm + 1, false + bool(changes or one.exchanges)
            if changes:
                yield f"  false alarm: {one.stage}: {changes}"
        elif size >= CHANGE:
            due += 1
            hit = [each for name, each in changes if name == "gain" and abs(abs(each.size) - size) < 0.3 * size]
            if truth.kind == "step":
                hit = [each for each in hit if _near(each.date_ns, _first(truth, one, truth.gains != 1.0), one)]
            found += bool(hit)
            if not hit:
                yield f"  missed: {one.stage}: {truth.kind} of {size:.3f}: {changes}"
    yield f"changes of at least 1 %: {found} of {due} found (steps: date within one bag)"
    yield f"false alarms: {false} of {calm} stages without a change"
    yield f"exchanged stages found with their date: {exchanged} of 2"


def _moved(truth: Truth) -> NDArray[np.bool_]:
    return np.array([each != truth.really[0] for each in truth.really])


def _kept(truth: Truth, one: StageSummary) -> NDArray[np.bool_]:
    """Return which bags could be used, shape (N,)."""
    dates = {row.date_ns for row in one.rows if row.verdict != bags.REFUSED}
    return np.array([int(date) in dates for date in truth.dates])


def _first(truth: Truth, one: StageSummary, changed: NDArray[np.bool_]) -> int:
    """Return the place of the first bag after a change among the bags that could be used."""
    return int(np.count_nonzero(~changed & _kept(truth, one)))


def _near(date_ns: int, place: int, one: StageSummary) -> bool:
    dates = [row.date_ns for row in one.rows if row.verdict != bags.REFUSED]
    return date_ns in dates and abs(dates.index(date_ns) - place) <= 1


def scheduler_load(folder: Path, workers: int) -> dict[str, float]:
    """Run a fleet on a local cluster; return wall time, computing time, scheduler time and bytes moved."""
    import psutil
    from distributed import Client, LocalCluster

    options = {"threads_per_worker": 1, "dashboard_address": ":0", "silence_logs": 50}
    with LocalCluster(n_workers=workers, **options) as cluster, Client(cluster) as client:
        # Everything is compiled and imported before the clock starts.
        one = find_bags([folder])[:1]
        client.run(bags.examine, one[0], "stage_state")
        own = psutil.Process()
        began, busy = time.perf_counter(), sum(own.cpu_times()[:2])
        table = run([folder], client=client, diagnose=False)
        wall, busy = time.perf_counter() - began, sum(own.cpu_times()[:2]) - busy
    moved = len(pickle.dumps((bags.Examined(one[0], "stage-000"), table.iloc[0].to_dict()))) * 2
    return {"wall": wall, "computed": float(table.seconds.sum()), "client": busy, "bytes": moved, "bags": len(table)}


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--stages", type=int, default=30)
    options.add_argument("--bags", type=int, default=10, help="of each stage")
    options.add_argument("--seed", type=int, default=1)
    options.add_argument("--folder", type=Path, help="keep bags and results there")
    options.add_argument("--no-scaling", action="store_true", help="do not compare one worker with two")
    given = options.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = given.folder or Path(temporary)
        shutil.rmtree(folder / "bags", ignore_errors=True)
        truths, broken = write_fleet(folder / "bags", given.stages, given.bags, given.seed)
        rows: list[bags.Row] = []
        began = time.perf_counter()
        run([folder / "bags"], folder / "out", workers=2, finished=lambda results: rows.extend(results.state.rows()))
        wall = time.perf_counter() - began
        print(f"{given.stages * given.bags} bags of {given.stages} stages in {wall:.0f} s with two workers", flush=True)
        print("\n".join(judge(rows, truths, broken)), flush=True)
        if not given.no_scaling:
            _print_scaling(folder / "bags")


def _print_scaling(folder: Path) -> None:
    small = [scheduler_load(folder / "stage-000", 1), scheduler_load(folder, 1), scheduler_load(folder, 2)]
    _, one, two = small
    print(f"one worker {one['wall']:.1f} s, two {two['wall']:.1f} s: {one['wall'] / two['wall']:.2f} times as fast")
    for count, load in (("1, tenth of the bags", small[0]), ("1", one), ("2", two)):
        each = {key: load[key] / load["bags"] for key in ("wall", "computed", "client")}
        idle = 1.0 - load["client"] / load["wall"]
        served = f"{each['client'] * 1e3:.1f} ms of client and scheduler (idle {idle:.0%})"
        times = f"per bag {each['wall']:.3f} s wall, {each['computed']:.3f} s computed"
        print(f"workers {count}: {times}, {served}, {load['bytes'] / 1e3:.1f} kB moved")
    # Bags that are refused at once show what the client and the scheduler do for each task, beside the workers.
    with tempfile.TemporaryDirectory() as empty:
        for number in range(EMPTY):
            Path(empty, f"{number}.mcap").write_bytes(b"")
        refused = scheduler_load(Path(empty), 2)
    task = refused["client"] / EMPTY
    print(
        f"{EMPTY} empty bags: {refused['wall'] / EMPTY * 1e3:.1f} ms wall, {task * 1e3:.1f} ms of client and scheduler"
    )
    bags_total, workers = 1_000_000, 1000
    computed = one["computed"] / one["bags"] * bags_total / workers
    served = TASKS * task * bags_total
    print(
        f"{bags_total:,} bags on {workers:,} workers: computing {computed / 3600:.2f} h, client and scheduler "
        f"{served / 3600:.2f} h, {one['bytes'] * bags_total / 1e9:.1f} GB moved; "
        f"{'client and scheduler' if served > computed else 'the workers'} limit the run"
    )


if __name__ == "__main__":
    sys.exit(main())
