"""Measured records: every method on the parts that were not fitted, one row a part.

    python -m benchmarks.measured.bench [--only TASK ..] [--method NAME ..] [--keep]

Errors are those of a free run, rms in % of the range of the judged part. ``*`` marks the best of a row, ``=`` what
is not worse than it with 95 % certainty. The environment variable SLPI_MEASURED_DATA gives the folder of the tables, as
``python -m benchmarks.measured.fetch`` makes it. ``--keep`` writes the figures to the file of kept figures, task by
task.
"""

# To be set before NumPy is imported: the processes share the cores.
import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from benchmarks import kept
from benchmarks.measured.manifest import Manifest, Task, read_manifest
from benchmarks.measured.methods import METHODS, Method
from benchmarks.measured.scores import Score, Tables, interval, score

SECTION, COMMAND = "measured", "make bench-measured"


def data_folder() -> Path | None:
    """Return the folder of the tables; None, with a line on standard output, where there is none."""
    folder = Path(os.environ.get("SLPI_MEASURED_DATA", Path(__file__).resolve().parents[3] / "shared" / "data"))
    if folder.is_dir():
        return folder
    print("no measured data: python -m benchmarks.measured.fetch -o FOLDER, then set SLPI_MEASURED_DATA to FOLDER")
    return None


def marks(row: Mapping[str, Mapping[str, Any]]) -> dict[str, str]:
    """Return ``*`` for the method with the least error of a row, ``=`` for those that are not clearly worse (95 %)."""
    scored = {name: cell for name, cell in row.items() if "rms" in cell}
    if not scored:
        return {}
    best = min(scored, key=lambda name: float(scored[name]["rms"]))
    least = scored[best]["blocks"]
    return {
        name: "*" if name == best else "=" if interval(cell["blocks"], least)[0] <= 1.0 else ""
        for name, cell in scored.items()
    }


def table(rows: Mapping[str, Mapping[str, Mapping[str, Any]]], figure: str) -> list[str]:
    """Return the lines of the table of one figure, ``rms`` with marks or another one without."""
    names = list(dict.fromkeys(name for row in rows.values() for name in row))
    lines = [f"{'':<42}" + "".join(f"{name[:11]:>12}" for name in names)]
    for label, row in rows.items():
        marked = marks(row) if figure == "rms" else {}
        cells = []
        for name in names:
            cell = row.get(name, {})
            absent = "refused " if "rms" not in cell else "- "
            cells.append(f"{cell[figure]:.3f}{marked.get(name) or ' '}" if figure in cell else absent)
        lines.append(f"{label:<42}" + "".join(f"{cell:>12}" for cell in cells))
    return lines


def run(
    manifest: Manifest, folder: Path, tasks: Sequence[str], methods: Sequence[Method], keep: bool, processes: int = 1
) -> dict[str, dict[str, dict[str, Any]]]:
    """Score every method on every task; return the cells by row and method."""
    known: dict[str, dict[str, dict[str, Any]]] = dict(kept.read(SECTION).get("figures", {}))
    rows = known if keep else {}
    labels = {task.name: [f"{task.name}: {part}" for part in task.judged] for task in manifest.tasks}

    def took(task: Task) -> float:
        cells = known.get(labels[task.name][0], {}).values()
        return sum(float(cell.get("fit_seconds", 0.0)) for cell in cells) or float("inf")

    # The slowest tasks first, so that the processes end together.
    chosen = sorted((task for task in manifest.tasks if task.name in tasks), key=took, reverse=True)
    with get_context("spawn").Pool(processes) as pool:
        for task, (found, seconds) in zip(
            chosen, pool.imap(partial(_scored, folder, [one.name for one in methods]), chosen, chunksize=1), strict=True
        ):
            merged = {**rows, **{label: {**rows.get(label, {}), **row} for label, row in found.items()}}
            rows = {label: merged[label] for own in labels.values() for label in own if label in merged}
            print(f"\n{task.name}, fitted to {'; '.join(map(str, task.fitted))} ({seconds:.0f} s of processor time)")
            print("\n".join(table(found, "rms")), flush=True)
            for label, row in found.items():
                for name, figures in row.items():
                    if said := figures.get("said") or figures.get("refused"):
                        print(f"  {label}, {name}: {said}")
            if keep:
                kept.write(SECTION, COMMAND, rows)
    return rows


def _scored(folder: Path, names: Sequence[str], task: Task) -> tuple[dict[str, dict[str, dict[str, Any]]], float]:
    """Return the cells of a task by row and method, and the processor time that it took, s."""
    began, tables = time.process_time(), Tables(folder)
    found: dict[str, dict[str, dict[str, Any]]] = {}
    for method in METHODS:
        if method.name in names:
            for part, cell in score(tables, task, method).items():
                found.setdefault(f"{task.name}: {part}", {})[method.name] = _rounded(cell)
    return found, time.process_time() - began


def _rounded(cell: Score | str) -> dict[str, Any]:
    if isinstance(cell, str):
        return {"refused": cell}
    figures = {key: value for key, value in asdict(cell).items() if value not in ("", None)}
    figures["blocks"] = [float(f"{value:.5g}") for value in cell.blocks]
    return {key: round(value, 4) if isinstance(value, float) else value for key, value in figures.items()}


def main() -> int:
    """Print the tables."""
    manifest = read_manifest()
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", metavar="TASK", help="these tasks alone")
    parser.add_argument("--method", nargs="+", metavar="NAME", help="these methods alone")
    parser.add_argument("--keep", action="store_true", help=f"write the figures to {kept.KEPT.name}")
    parser.add_argument("--processes", type=int, default=2)
    options = parser.parse_args()
    folder = data_folder()
    if folder is None:
        return 1
    methods = [one for one in METHODS if one.name in (options.method or [one.name])]
    tasks = options.only or [task.name for task in manifest.tasks]
    began = time.perf_counter()
    rows = run(manifest, folder, tasks, methods, options.keep, options.processes)
    for title, figure in (
        ("rms error without its mean, % of range; * best, = not worse than it with 95 % certainty", "rms"),
        ("rms error with its mean, % of range", "absolute"),
        ("rms error of the fitted records without its mean, % of range", "fitted"),
        ("rms error of the voltage of the inverse, % of range", "inverse"),
        ("processor time of the fit, s", "fit_seconds"),
        ("processor time of a sample of a free run, us", "sample_microseconds"),
    ):
        print(f"\n{title}")
        print("\n".join(table(rows, figure)))
    print(f"\n{time.perf_counter() - began:.0f} s")
    return 0


if __name__ == "__main__":
    sys.exit(main())
