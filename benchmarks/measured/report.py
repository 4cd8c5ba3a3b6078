"""The table of README and the picture, from the file of kept figures.

    python -m benchmarks.measured.report [--check]

Writes what stands between two marks in README.md, and ``docs/images/measured.svg``. With ``--check`` README is compared
only; the exit code is 1 if it differs.
"""

import argparse
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import kept
from benchmarks.measured.bench import SECTION, marks
from benchmarks.measured.manifest import Manifest, read_manifest

ROOT = Path(__file__).resolve().parents[2]
README, PICTURE = ROOT / "README.md", ROOT / "docs" / "images" / "measured.svg"
BEGIN, END = "<!-- measured: begin -->", "<!-- measured: end -->"
# Methods whose figures stand in README. The best of all others has a column of its own.
COLUMNS = ("PI", "PI, lag", "SLPI", "SLPI, causes")
Rows = Mapping[str, Mapping[str, Mapping[str, Any]]]


def readme_table(rows: Rows, manifest: Manifest, date: str, command: str) -> str:
    """Return the table of README: a row for each judged part."""
    judged = "judged (fitted parts: [manifest](benchmarks/measured/manifest.json))"
    lines = [
        f"| source | {judged} | {' | '.join(COLUMNS)} | best of the other methods |",
        f"|---|---|{'---|' * len(COLUMNS)}---|",
    ]
    tasks = {task.name: task for task in manifest.tasks}
    for label, row in rows.items():
        name, part = label.split(": ", 1)
        record = manifest.records[tasks[name].judged[0].record]
        source = manifest.sources[record.source]
        link = f"[{source.repository.split('/')[1]}](https://github.com/{source.repository}/tree/{source.commit})"
        marked = marks(row)
        cells = [_cell(row.get(column, {}), marked.get(column, "")) for column in COLUMNS]
        others = {other: cell for other, cell in row.items() if other not in COLUMNS and "rms" in cell}
        best = min(others, key=lambda other: float(others[other]["rms"]), default=None)
        last = f"{_cell(others[best], marked.get(best, ''))} {best}" if best else "-"
        lines.append(f"| {link} | {name}: {part} | {' | '.join(cells)} | {last} |")
    ours = [[marks(row).get(column, "") for column in ("SLPI", "SLPI, causes")] for row in rows.values()]
    wins, near = sum("*" in found for found in ours), sum(any(found) for found in ours)
    count = max(len(row) for row in rows.values())
    said = (
        f"Free-run rms error without its mean on parts that were not fitted, % of their range; {date}, `{command}`. "
        f"Bold: the best of the row, of all {count} methods; =: the best is within the 95 % interval of this one. "
        f"SLPI, with or without causes, is best in {wins} of {len(rows)} rows, and best or within its interval of the "
        f"best in {near}. [All methods, with intervals](docs/images/measured.svg)."
    )
    return "\n".join([*lines, "", said])


def _cell(cell: Mapping[str, Any], mark: str) -> str:
    if "rms" not in cell:
        return "refused"
    figure = f"{cell['rms']:.3f}"
    return f"**{figure}**" if mark == "*" else f"{figure} {mark}".strip()


def with_table(text: str, table: str) -> str:
    """Return a page with the table between its marks; ValueError if it has none."""
    if text.count(BEGIN) != 1 or text.count(END) != 1:
        raise ValueError(f"the page does not have the marks {BEGIN} and {END} once")
    before, rest = text.split(BEGIN)
    return f"{before}{BEGIN}\n{table}\n{END}{rest.split(END)[1]}"


def draw(rows: Rows, path: Path) -> None:
    """Draw the error of each method on each row, over that of the best of the row, with intervals."""
    import matplotlib

    matplotlib.use("svg")
    # The same figures shall give the same file.
    matplotlib.rcParams["svg.hashsalt"] = "measured"
    from matplotlib import pyplot

    names = list(dict.fromkeys(name for row in rows.values() for name in row))
    figure, axes = pyplot.subplots(figsize=(11.0, 0.42 * len(rows) + 1.6), constrained_layout=True)
    colours = pyplot.get_cmap("tab20")(np.linspace(0.0, 1.0, 20))
    for column, name in enumerate(names):
        ours = name.startswith("SLPI")
        at, ratio, low, high = [], [], [], []
        for line, row in enumerate(rows.values()):
            least = min((float(cell["rms"]) for cell in row.values() if "rms" in cell), default=1.0)
            if "rms" in (cell := row.get(name, {})):
                at.append(line + 0.05 * (column - len(names) / 2.0))
                ratio.append(cell["rms"] / least)
                low.append((cell["rms"] - min(cell["low"], cell["rms"])) / least)
                high.append((max(cell["high"], cell["rms"]) - cell["rms"]) / least)
        axes.errorbar(
            ratio, at, xerr=[low, high], fmt="D" if ours else "o", markersize=6 if ours else 4, linewidth=0.7,
            label=name, color="black" if name == "SLPI, causes" else "crimson" if ours else colours[column],
        )  # fmt: skip
    axes.set_xscale("log")
    axes.set_xlim(0.7, 30.0)
    axes.set_yticks(range(len(rows)), list(rows))
    axes.invert_yaxis()
    axes.grid(axis="x", linewidth=0.3)
    axes.set_xlabel("free-run rms error without its mean, held out, over that of the best method of the row")
    figure.legend(loc="outside right upper", fontsize="small")
    figure.savefig(path, metadata={"Date": None})
    pyplot.close(figure)


def main() -> int:
    """Write table and picture, or compare the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true", help="compare README with the kept figures; write nothing")
    options = parser.parse_args()
    section = kept.read(SECTION)
    text = README.read_text(encoding="utf-8")
    new = with_table(text, readme_table(section["figures"], read_manifest(), section["date"], section["command"]))
    if options.check:
        if new != text:
            print("README.md differs from the kept figures: python -m benchmarks.measured.report", file=sys.stderr)
        return int(new != text)
    README.write_text(new, encoding="utf-8")
    draw(section["figures"], PICTURE)
    return 0


if __name__ == "__main__":
    sys.exit(main())
