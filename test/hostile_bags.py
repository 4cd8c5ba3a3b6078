"""Small bags with something wrong, and what each way of identifying a model decides about them."""

import contextlib
import io
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from slpi_ros.cli import main
from slpi_ros.fleet.bags import examine, identify_bag
from slpi_ros.fleet.sources import Bag
from slpi_ros.identification import fit as fits
from slpi_ros.io.bag_writer import write_bag
from slpi_ros.io.record import Record
from slpi_ros.nodes.jobs import FitRequest, fit
from slpi_ros.workflows.records import Source

TOPIC, START_NS = "stage_state", 1_700_000_000_000_000_000
FloatArray = np.ndarray


def plain(rng: np.random.Generator) -> Record:
    """Return a record of an easy stage: two play operators under a triangle of falling height, with 5 nm of noise."""
    turns = np.array([0.0, 100.0, 2.0, 95.0, 10.0, 85.0, 20.0, 75.0, 30.0, 65.0, 40.0])
    v = np.interp(np.arange(501), np.linspace(0, 500, turns.size), turns)
    y = 8e-8 * v
    for radius, weight in ((4.0, 2e-8), (12.0, 3e-8)):
        state, play = 0.0, np.empty_like(v)
        for number, value in enumerate(v):
            state = play[number] = min(max(state, value - radius), value + radius)
        y = y + weight * play
    return record_of(v, y + rng.normal(0.0, 5e-9, v.size))


def record_of(v: FloatArray, y: FloatArray, **changes: object) -> Record:
    time_ns = START_NS + np.arange(v.size, dtype=np.int64) * 10_000_000
    return replace(Record(time_ns, {"x": v}, {"x": y}, hardware_id="stage"), **changes)


Spoil = Callable[[Record, np.random.Generator], Record]


def with_signals(record: Record, v: FloatArray | None = None, y: FloatArray | None = None) -> Record:
    return replace(
        record,
        voltage={"x": record.voltage["x"] if v is None else v},
        displacement={"x": record.displacement["x"] if y is None else y},
    )


def steps(x: FloatArray, share: float) -> FloatArray:
    digit = share * np.ptp(x)
    return np.round(x / digit) * digit


def coarse(record, rng):
    return with_signals(record, y=steps(record.displacement["x"], rng.uniform(0.005, 0.2)))


def coarse_voltage(record, rng):
    return with_signals(record, v=steps(record.voltage["x"], rng.uniform(0.005, 0.3)))


def noisy(record, rng):
    y = record.displacement["x"]
    return with_signals(record, y=y + rng.normal(0.0, rng.uniform(0.01, 2.0) * np.ptp(y), y.size))


def noisy_voltage(record, rng):
    v = record.voltage["x"]
    return with_signals(record, v=v + rng.normal(0.0, rng.uniform(0.001, 0.5) * np.ptp(v), v.size))


def missing(record, rng):
    y = record.displacement["x"].copy()
    y[rng.random(y.size) < rng.uniform(0.1, 1.0)] = np.nan
    return with_signals(record, y=y)


def stuck(record, rng):
    y = record.displacement["x"].copy()
    first = rng.integers(0, y.size)
    y[first : first + rng.integers(10, 500)] = y[first]
    return with_signals(record, y=y)


def held(record, rng):
    """A sensor slower than the record: each reading stands several times."""
    every = int(rng.integers(2, 60))
    return with_signals(record, y=np.repeat(record.displacement["x"][::every], every)[: len(record)])


def clipped(record, rng):
    y = record.displacement["x"]
    return with_signals(record, y=np.minimum(y, np.quantile(y, rng.uniform(0.05, 0.95))))


def spikes(record, rng):
    y = record.displacement["x"].copy()
    y[rng.random(y.size) < rng.uniform(0.005, 0.3)] = 10.0 ** rng.uniform(-6, 30)
    return with_signals(record, y=y)


def infinite(record, rng):
    v, y = record.voltage["x"].copy(), record.displacement["x"].copy()
    (v if rng.random() < 0.5 else y)[rng.integers(0, v.size, 5)] = np.inf
    return with_signals(record, v=v, y=y)


def short(record, rng):
    return record.part(slice(0, int(rng.integers(1, 120))))


def sparse(record, rng):
    return record.part(slice(None, None, int(rng.integers(5, 60))))


def one_way(record, rng):
    return record.part(slice(0, int(rng.integers(20, 49))))


def unmoved(record, rng):
    constant = np.full(len(record), rng.uniform(0.0, 50.0))
    return with_signals(record, v=constant) if rng.random() < 0.5 else with_signals(record, y=1e-7 * constant)


def unrelated(record, rng):
    return with_signals(record, y=np.cumsum(rng.normal(0.0, 1e-7, len(record))))


def inverted(record, rng):
    return with_signals(record, y=-record.displacement["x"])


def other_units(record, rng):
    scale = 10.0 ** rng.integers(-6, 10)
    signals = record.voltage["x"] * scale, record.displacement["x"] * scale
    return with_signals(record, v=signals[0]) if rng.random() < 0.5 else with_signals(record, y=signals[1])


def exchanged(record, rng):
    return with_signals(record, v=record.displacement["x"], y=record.voltage["x"])


def same_stamps(record, rng):
    time_ns = record.time_ns.copy()
    chosen = np.flatnonzero(rng.random(time_ns.size) < rng.uniform(0.1, 1.0))
    time_ns[chosen] = time_ns[np.maximum(chosen - 1, 0)]
    return replace(record, time_ns=np.maximum.accumulate(time_ns))


def stamps_back(record, rng):
    time_ns = record.time_ns.copy()
    first = int(rng.integers(1, time_ns.size))
    time_ns[first:] -= int(rng.integers(1, 10**10))
    return replace(record, time_ns=time_ns)


def gaps(record, rng):
    left = np.flatnonzero(rng.random(len(record)) < rng.uniform(0.05, 0.5))
    v, y = record.voltage["x"][left], record.displacement["x"][left]
    return replace(record, time_ns=record.time_ns[left], voltage={"x": v}, displacement={"x": y})


def late(record, rng):
    return with_signals(record, y=np.roll(record.displacement["x"], int(rng.integers(1, 250))))


def second_axis(record, rng):
    """A second axis that is fine, coarse or at rest, before or after the first one."""
    y = record.displacement["x"]
    other = (y, steps(y, 0.12), np.full(y.size, 1e-6))[rng.integers(0, 3)]
    names = ("x", "y") if rng.random() < 0.5 else ("y", "x")
    signals = {"x": y, "y": other}
    v = dict.fromkeys(names, record.voltage["x"])
    return replace(record, voltage=v, displacement={name: signals[name] for name in names})


def _rows(record, rows, time_ns=None):
    return record_of(
        record.voltage["x"][rows], record.displacement["x"][rows],
        time_ns=(record.time_ns if time_ns is None else time_ns)[rows],
    )  # fmt: skip


def doubled(record, rng):
    """Messages that were recorded twice."""
    return _rows(
        record, np.sort(np.concatenate([np.arange(len(record)), rng.integers(0, len(record), len(record) // 2)]))
    )


def zero_stamps(record, rng):
    time_ns = record.time_ns.copy()
    time_ns[rng.integers(1, len(record), max(1, len(record) // 100))] = 0
    return _rows(record, slice(None), time_ns)


def clock_back(record, rng):
    """A clock that was set back while it was recorded."""
    time_ns = record.time_ns.copy()
    step = int(np.median(np.diff(time_ns))) * int(rng.integers(8, 200))
    time_ns[int(rng.uniform(0.3, 0.9) * len(record)) :] -= step
    return _rows(record, slice(None), time_ns)


def slow_sensor(record, rng):
    """Readings that last for a changing number of rows."""
    starts = np.concatenate([[0], np.cumsum(rng.integers(1, 8, len(record)))])
    last = np.searchsorted(starts, np.arange(len(record)), side="right") - 1
    return with_signals(record, y=record.displacement["x"][starts[last]])


def unchanged(record, rng):
    return record


SPOILS: Mapping[str, Spoil] = {
    spoil.__name__: spoil
    for spoil in (
        unchanged, coarse, coarse_voltage, noisy, noisy_voltage, missing, stuck, held, clipped, spikes, infinite, short,
        sparse, one_way, unmoved, unrelated, inverted, other_units, exchanged, same_stamps, stamps_back, gaps, late,
        second_axis, doubled, zero_stamps, clock_back, slow_sensor,
    )
}  # fmt: skip


def write_hostile(folder: Path, name: str, seed: int) -> str:
    """Write a bag with the fault `name`, every eighth of them also cut off; return its path."""
    rng = np.random.default_rng([seed, *name.encode()])
    path = folder / f"{name}{seed}"
    write_bag(path, SPOILS[name](plain(rng), rng))
    if rng.random() < 0.125:
        (file,) = path.glob("*.mcap")
        file.write_bytes(file.read_bytes()[: int(rng.integers(0, file.stat().st_size))])
    return str(path)


@contextlib.contextmanager
def quick_fits():
    """Identify models of kind ``pi`` whatever the kind that is asked for: the fleet knows only the slow ``slpi``."""
    identify = fits.identify
    fits.identify = lambda records, kind, **options: identify(records, "pi", **options)
    try:
        yield
    finally:
        fits.identify = identify


@dataclass(frozen=True)
class Decision:
    """Why a bag is refused, "" if it is not; and the rms errors (m) of the model by axis."""

    refused: str
    rms: tuple[float, ...] = ()


def _accepted(document: str) -> Decision:
    axes = json.loads(document)["axes"]
    return Decision("", tuple(axes[name]["quality"]["rms_m"] for name in sorted(axes)))


def by_command_line(bag: str, folder: Path, delay: float) -> Decision:
    output, told = folder / "cli.json", io.StringIO()
    with contextlib.redirect_stderr(told), contextlib.redirect_stdout(io.StringIO()):
        code = main(["identify", bag, "-o", str(output), "--sensor-delay", str(delay)])
    if code == 0:
        return _accepted(output.read_text())
    return Decision(told.getvalue().strip().removeprefix("slpi identify: "))


def by_node(bag: str, folder: Path, delay: float) -> Decision:
    outcome = fit(FitRequest((bag,), TOPIC, "slpi", None, None, "", sensor_delay=delay))
    return Decision(outcome.error) if outcome.error else _accepted(outcome.document)


def by_fleet(bag: str, folder: Path) -> Decision:
    """The fleet decides on each axis by itself: a bag with an axis that is refused counts as refused."""
    reading = Source(topic=TOPIC)
    examined = examine(Bag(bag), reading)
    judged = identify_bag(examined, reading, str(folder), "fleet.json")
    errors = {row.axis: row.error for row in judged.rows if row.error}
    if not errors:
        return _accepted((folder / "fleet.json").read_text())
    # The others stop at the first axis whose record allows no fit, and only then at the first that allows no model.
    return Decision(next(iter(examined.refused.values()), errors[min(errors)]))


def disagreement(bag: str, folder: Path, delay: float = 0.0) -> str:
    """Return how the ways to identify a model disagree on a bag, "" if they do not; delay (s) of its sensor.

    The fleet knows no sensors: it is asked only where there is no delay.
    """
    decisions = {"command line": by_command_line(bag, folder, delay), "node": by_node(bag, folder, delay)}
    if not delay:
        decisions["fleet"] = by_fleet(bag, folder)
    return "" if len(set(decisions.values())) == 1 else f"{bag}: {decisions}"
