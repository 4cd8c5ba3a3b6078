"""The ten commands of the command line on one measured record in several environments: are the figures the same?

Each command runs with ``--json`` in each environment. Every number of its document is compared with the same number of
the first environment: a list of numbers by its largest difference over its largest value, a number of its own by the
difference over the larger of the two. What is a difference between two nearly equal figures (a change of gain, an
offset) is compared with the figure that it is a part of.
"""

import argparse
import json
import os
import re
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
# Name, arguments, and the figures to be printed.
COMMANDS = (
    ("import", "import {record} -o bag", ("samples", "seconds")),
    ("identify, slpi", "identify bag -o slpi.json --report report", ("axes/x/quality/held_out_rms_m",)),
    ("identify, pi", "identify bag -o pi.json --kind pi", ("axes/x/quality/held_out_rms_m",)),
    ("diagnose", "diagnose bag --model slpi.json -o diagnosis", ()),
    ("verify", "verify bag --model slpi.json -o verification", ("axes/x/rms_m", "axes/x/maximum_m")),
    ("refit", "refit slpi.json bag -o refit.json", ("records/0/axes/x/error_after_rms_m",)),
    ("show", "show slpi.json", ()),
    ("excite", "excite -o drive.csv --voltage-min 0 --voltage-max 150", ()),
    ("simulate", "simulate slpi.json voltage.csv -o displacement.csv", ()),
    ("experiments", "experiments -o experiments", ()),
)
TABLES = {"excite": "drive.csv", "simulate": "displacement.csv", "experiments": "experiments/separation.csv"}
NUMBER = r"(?<![\w.])-?\d+(?:\.\d+)?(?![\w.]*\d)"
# Differences between nearly equal figures, and what they are a part of: 1, or a displacement of the stage.
PARTS = {"gain_change": 1.0, "width_change": 1.0, "offset_m": 2e-5}


def run(python: Path, record: Path, folder: Path) -> Iterator[tuple[str, dict[str, Any], float]]:
    """Run all commands in a folder; yield name, numbers and seconds of each."""
    rows = [line.split(",")[:2] for line in record.read_text().splitlines()]
    table = "\n".join(",".join(row) for row in [["time_s", "x_V"], *rows[1:]])
    (folder / "voltage.csv").write_text(table + "\n")
    for name, arguments, _ in COMMANDS:
        began = time.perf_counter()
        words = [word.format(record=record) for word in arguments.split()]
        done = subprocess.run(
            [python, "-m", "slpi_ros.cli", *words, "--json"], cwd=folder, capture_output=True, text=True
        )
        took = time.perf_counter() - began
        if done.returncode not in (0, 1) or "Traceback" in done.stderr or not done.stdout:
            sys.exit(f"{python}: slpi {name} ended with {done.returncode}: {done.stderr}")
        found = dict(numbers(json.loads(done.stdout)))
        if name in TABLES:
            cells = [line.split(",") for line in (folder / TABLES[name]).read_text().splitlines()[1:]]
            found |= {f"column {k}": [float(row[k]) for row in cells] for k in range(len(cells[0]))}
        if name == "experiments":
            page = (folder / "experiments" / "index.html").read_text()
            text = re.sub(r"<(script|style|svg)\b.*?</\1>|<[^>]*>", " ", page, flags=re.DOTALL)
            found |= {f"number {k} of the page": float(each) for k, each in enumerate(re.findall(NUMBER, text))}
        yield name, found, took


def numbers(value: Any, place: str = "") -> Iterator[tuple[str, Any]]:
    """Yield every number and list of numbers of a document, and the names of what was found, with their places."""
    if isinstance(value, dict):
        for key, part in value.items():
            yield from numbers(part, f"{place}/{key}" if place else key)
    elif isinstance(value, list) and value and all(type(each) in (int, float) for each in value):
        yield place, value
    elif isinstance(value, list):
        yield f"{place}/length", float(len(value))
        for k, part in enumerate(value):
            yield from numbers(part, f"{place}/{k}")
    elif type(value) in (int, float):
        yield place, value


def difference(place: str, one: Any, other: Any) -> float:
    """Return the relative difference of a number or a list of numbers of two environments."""
    a, b = (each if isinstance(each, list) else [each] for each in (one, other))
    if len(a) != len(b):
        return float("inf")
    largest = max(PARTS.get(place.rsplit("/", 1)[-1], 0.0), *map(abs, a), *map(abs, b))
    return max(abs(p - q) for p, q in zip(a, b, strict=True)) / largest if largest else 0.0


STREAM = """
import sys
sys.path.insert(0, sys.argv[1])
from engine import axis_model, loop_family, median_time, wishes, zigzag
y = wishes(loop_family(), zigzag(200_000, 2000))
step, values = axis_model(y).stream().step, y.tolist()
stamps = [1e-3 * k for k in range(len(values))]
print(1e6 * median_time(lambda: [step(t, each) for t, each in zip(stamps, values)], 1) / len(values))
"""
STREAMS = 9


def stream_costs(pythons: list[Path]) -> list[list[float]]:
    """Return the costs of one streamed voltage in each environment, microseconds; the processes run in turn."""
    return [
        [float(subprocess.check_output([python, "-c", STREAM, str(ROOT / "benchmarks")])) for python in pythons]
        for _ in range(STREAMS)
    ]


def main() -> None:
    """Print the figures of all environments and the largest differences; exit code 1 if one is above the limit."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("record", type=Path, help="table of a measured record, for example afm_double_sine_x.csv")
    parser.add_argument("first", type=Path, help="environment that the others are compared with, for example .venv")
    parser.add_argument("others", nargs="+", type=Path, help="for example .venv-jazzy .venv-newest")
    parser.add_argument("--limit", type=float, default=0.01, help="largest relative difference; default: 0.01")
    options = parser.parse_args()
    pythons = [ROOT / environment / "bin" / "python" for environment in (options.first, *options.others)]
    for python in pythons:
        print(subprocess.check_output([python, ROOT / "tools" / "list_versions.py"], text=True), end="")
    print(f"{'command':<16} {'environment':<16} {'numbers':>8} {'largest difference':>19} {'s':>6}  where, and figures")
    with tempfile.TemporaryDirectory() as name:
        runs = []
        for k, python in enumerate(pythons):
            (folder := Path(name) / f"{k}").mkdir()
            runs.append(run(python, options.record.resolve(), folder))
        worst = 0.0
        for (command, one, took), *others in zip(*runs, strict=True):
            shown = next(figures for name_, _, figures in COMMANDS if name_ == command)
            told = "; ".join(f"{figure.rsplit('/', 1)[-1]} {one[figure]:.6g}" for figure in shown)
            print(f"{command:<16} {options.first!s:<16} {len(one):8d} {'':>19} {took:6.1f}  {told}", flush=True)
            for environment, (_, other, also) in zip(options.others, others, strict=True):
                missing = sorted(one.keys() ^ other.keys())
                found = [(difference(place, one[place], other[place]), place) for place in one.keys() & other.keys()]
                most, place = (float("inf"), missing[0]) if missing else max(found)
                worst = max(worst, most)
                where = place if most else ""
                print(f"{'':<16} {environment!s:<16} {len(found):8d} {most:19.2e} {also:6.1f}  {where}", flush=True)
    print(f"largest difference: {worst:.2%}; limit {options.limit:.0%}")
    costs = [*zip(*stream_costs(pythons), strict=True)]
    for environment, each in zip((options.first, *options.others), costs, strict=True):
        ratios = sorted(b / a for a, b in zip(costs[0], each, strict=True))
        print(
            f"one streamed voltage, us of processor time: {environment!s:<16} {statistics.median(each):.2f}; ratio "
            f"{statistics.median(ratios):.2f} ({ratios[0]:.2f} to {ratios[-1]:.2f} of {STREAMS} runs in turn)"
        )
    print(f"load of the machine {os.getloadavg()[0]:.1f}")
    sys.exit(worst > options.limit)


if __name__ == "__main__":
    main()
