"""The tables of README and of the pages of figures, and the picture, from the file of kept figures.

    python -m benchmarks.measured.report [--check]

Writes what stands between marks in README.md and in measured.md and figures.md of docs/explanation, and
``docs/images/measured.svg``. With ``--check`` the pages are compared only; the exit code is 1 if one differs.
"""

import argparse
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import kept
from benchmarks.measured.bench import SECTION, marks
from benchmarks.measured.manifest import Manifest, read_manifest
from benchmarks.measured.scores import interval

ROOT = Path(__file__).resolve().parents[2]
README, PICTURE = ROOT / "README.md", ROOT / "docs" / "images" / "measured.svg"
PAGE, FIGURES = (ROOT / "docs" / "explanation" / name for name in ("measured.md", "figures.md"))
# Section of the kept figures of ``make bench-latency``.
LATENCY = "latency"
# The kept rows of simulated stages in README; the others stand on the page of figures.
IN_README = ("accuracy", "promise", "confusion pair", "learning")
# Methods whose figures stand in README. The best of all others has a column of its own.
COLUMNS = ("line", "PI", "PI, lag", "SLPI", "SLPI, causes")
Rows = Mapping[str, Mapping[str, Mapping[str, Any]]]


def by_device(rows: Rows, manifest: Manifest) -> dict[str, str]:
    """Return the label of README's row for each device whose motion was measured, with its name.

    It is the row with the median ratio of the error of SLPI with causes to that of the best other method; of two
    middle rows the worse one.
    """
    ratios: dict[str, list[tuple[float, str]]] = {}
    names = {}
    for task in manifest.tasks:
        source = manifest.records[task.judged[0].record].source
        for part in task.judged:
            label = f"{task.name}: {part}"
            names[label] = part.name
            if manifest.sources[source].moves:
                least = min(float(cell["rms"]) for cell in _others(rows[label]).values())
                ratios.setdefault(source, []).append((float(rows[label]["SLPI, causes"]["rms"]) / least, label))
    chosen = [sorted(found)[len(found) // 2][1] for found in ratios.values()]
    return {label: names[label] for label in chosen}


def _others(row: Mapping[str, Mapping[str, Any]]) -> dict[str, Mapping[str, Any]]:
    return {name: cell for name, cell in row.items() if not name.startswith("SLPI") and "rms" in cell}


def readme_table(rows: Rows, manifest: Manifest, date: str, command: str) -> str:
    """Return the table of README, a row for each device, and what all rows come to."""
    lines = [
        f"| device, judged on | {' | '.join(COLUMNS)} | best of the other methods |",
        f"|---|{'---|' * len(COLUMNS)}---|",
    ]
    for label, name in by_device(rows, manifest).items():
        row, marked = rows[label], marks(rows[label])
        cells = [_cell(row.get(column, {}), marked.get(column, "")) for column in COLUMNS]
        others = {other: cell for other, cell in row.items() if other not in COLUMNS and "rms" in cell}
        best = min(others, key=lambda other: float(others[other]["rms"]))
        cells.append(f"{_cell(others[best], marked.get(best, ''))} {best}")
        lines.append(f"| {name} | {' | '.join(cells)} |")
    count = max(len(row) for row in rows.values())
    said = (
        f"Rms error without its mean, in % of the range of the data. No parameter was fitted to these data, but they "
        f"were at hand while the package was developed; {date}, `{command}` with the [fetched "
        f"records](docs/explanation/measured.md). **Bold**: the least of {count} methods; *as good*: not worse with "
        f"95 % certainty; *line*: a straight line. One row for each device whose motion was measured: the one with the "
        f"median ratio of *SLPI, causes* to the best other method; of two the worse."
        f"{lost_with_mean(rows, manifest)}\n\n"
        f"{headline(rows, of_piezos(manifest))} [All rows and methods, with intervals](docs/explanation/measured.md)."
    )
    return "\n".join([*lines, "", said])


def lost_with_mean(rows: Rows, manifest: Manifest) -> str:
    """Return a sentence with the rows of README in which only the mean error makes another method the better one."""
    lost = []
    for label, name in by_device(rows, manifest).items():
        ours, others = rows[label]["SLPI, causes"], _others(rows[label])
        best = min(others, key=lambda other: float(others[other]["absolute"]))
        wins = ours["rms"] <= min(float(cell["rms"]) for cell in others.values())
        if wins and ours["absolute"] > others[best]["absolute"]:
            lost.append(f"{name} ({ours['absolute']:.3f}; {best} {others[best]['absolute']:.3f})")
    return f" Lost with the mean error: {'; '.join(lost)}." if lost else ""


@dataclass(frozen=True)
class Comparison:
    """Errors of SLPI with causes over those of another method, row by row: without the mean error, and with it."""

    ratios: tuple[float, ...]
    absolute: tuple[float, ...]
    wins: int  # the ratio is below 1 with 95 % certainty
    losses: int  # above 1

    @property
    def median(self) -> str:
        """The median, in brackets with the mean error."""
        return f"{np.median(self.ratios):.2f} ({np.median(self.absolute):.2f})"

    @property
    def worst(self) -> str:
        """The largest ratio, in brackets with the mean error."""
        return f"{max(self.ratios):.2f} ({max(self.absolute):.2f})"


def compared(rows: Rows, others: Sequence[str] = ()) -> Comparison:
    """Compare SLPI with causes with the best of `others` in each row; by default of all methods that are not SLPI."""
    ratios, absolute, wins, losses = [], [], 0, 0
    for row in rows.values():
        ours = row["SLPI, causes"]
        rivals = [row[name] for name in others if "rms" in row[name]] if others else list(_others(row).values())
        if "rms" not in ours or not rivals:
            continue
        best = min(rivals, key=lambda cell: float(cell["rms"]))
        ratios.append(ours["rms"] / best["rms"])
        absolute.append(ours["absolute"] / min(float(cell["absolute"]) for cell in rivals))
        low, high = interval(ours["blocks"], best["blocks"])
        wins += high < 1.0
        losses += low > 1.0
    return Comparison(tuple(ratios), tuple(absolute), wins, losses)


def of_piezos(manifest: Manifest) -> dict[str, str]:
    """Return the labels of the rows of piezos whose motion was measured, with the name of the device."""
    return {
        f"{task.name}: {part}": part.name.split(",")[0]
        for task in manifest.tasks
        for part in task.judged
        if manifest.sources[manifest.records[part.record].source].piezo
    }


def headline(rows: Rows, piezos: Mapping[str, str]) -> str:
    """Return a table with the ratios to the best other method of each row, to PI and to SLPI, and what it means."""
    few = {label: rows[label] for label in piezos}
    extended = {
        label: row for label, row in rows.items() if "in the model: nothing" not in row["SLPI, causes"].get("said", "")
    }
    voltages = {name or "the best other method": ratios_of_voltages(few, name) for name in (None, "PI", "SLPI")}
    lines = [
        "| error of *SLPI, causes* over that of | median | worst | clearly better | clearly worse |",
        "|---|---|---|---|---|",
        *(
            f"| {name} | {found.median} | {found.worst} | {found.wins} rows | {found.losses} |"
            for name, found in (
                (f"the best other method, all {len(rows)} rows", compared(rows)),
                (f"the best other method, {len(few)} rows of moving piezos", compared(few)),
                ("PI, all rows", compared(rows, ["PI"])),
                ("PI with a lag, all rows", compared(rows, ["PI, lag"])),
                (f"SLPI, the {len(extended)} rows with causes", compared(extended, ["SLPI"])),
            )
        ),
        *(
            f"| {name}: voltage for a measured displacement, moving piezos | {np.median(ratios):.2f} | "
            f"{max(ratios):.2f} | | |"
            for name, ratios in voltages.items()
        ),
    ]
    devices: dict[str, dict[str, Mapping[str, Mapping[str, Any]]]] = {}
    for label, device in piezos.items():
        devices.setdefault(device, {})[label] = rows[label]
    medians = ", ".join(
        f"{device} {np.median(compared(own).ratios):.2f} (voltage {np.median(ratios_of_voltages(own)):.2f})"
        for device, own in devices.items()
    )
    return "\n".join(lines) + (
        f"\n\nBelow 1, *SLPI, causes* is better; in brackets with the mean error. *The best other method* is chosen "
        f"afterwards, for each row. Clearly: with 95 % certainty (paired block bootstrap). Medians of each piezo over "
        f"the best other method: {medians}. SLPI keeps to the fitted range of voltages, the others may "
        f"leave it by a tenth."
    )


def ratios_of_voltages(rows: Rows, over: str | None = None) -> list[float]:
    """Return the ratios of the errors of the inverse to those of a method; default: of the best that is not SLPI."""
    found = []
    for row in rows.values():
        errors = {name: float(cell["inverse"]) for name, cell in row.items() if "inverse" in cell}
        other = errors[over] if over else min(x for name, x in errors.items() if not name.startswith("SLPI"))
        found.append(errors["SLPI, causes"] / other)
    return found


def further(rows: Rows, shown: Iterable[str]) -> str:
    """Return sentences with the ratios to PI with a lag, to the best other method of README's rows, and the times."""
    cells = [row["SLPI, causes"] for row in rows.values() if "rms" in row["SLPI, causes"]]
    fit, sample = ([float(cell[key]) for cell in cells] for key in ("fit_seconds", "sample_microseconds"))
    few = np.median(compared({label: rows[label] for label in shown}).ratios)
    lagging = compared(rows, ["PI, lag"])
    return (
        f"*SLPI, causes* over PI with a lag, in all rows: median {lagging.median}, worst {lagging.worst}; clearly "
        f"better in {lagging.wins} rows, clearly worse in {lagging.losses}. In the rows of README the median over the "
        f"best other method is {few:.2f}. A fit of *SLPI, causes* takes {np.median(fit):.0f} s on one "
        f"core, the longest {max(fit):.0f} s; the prediction of a sample {np.median(sample):.2f} µs (medians)."
    )


def worse_than_line(rows: Rows, manifest: Manifest) -> list[str]:
    """Return the lines of a table: where methods are worse than a straight line, by how much, and why."""
    lines = ["| row | line | worse | why |", "|---|---|---|---|"]
    for task in manifest.tasks:
        for part in task.judged:
            row = rows[label := f"{task.name}: {part}"]
            least = float(row["line"]["rms"])
            worse = {name: cell["rms"] for name, cell in row.items() if "rms" in cell and cell["rms"] > least}
            if worse:
                found = ", ".join(f"{name} {rms:.3f}" for name, rms in worse.items())
                lines.append(f"| {label} | {least:.3f} | {found} | {part.why} |")
    return lines


def what_is_judged(rows: Rows, manifest: Manifest) -> list[str]:
    """Return the lines of a table: what each row is, what was fitted and found, and where the records are from."""
    lines = ["| row | what is judged | fitted to | diagnosis | records |", "|---|---|---|---|---|"]
    for task in manifest.tasks:
        source = manifest.sources[manifest.records[task.judged[0].record].source]
        link = f"[{source.repository.split('/')[1]}](https://github.com/{source.repository}/tree/{source.commit})"
        fitted = "; ".join(map(str, task.fitted))
        for part in task.judged:
            found = str(rows[label := f"{task.name}: {part}"]["SLPI, causes"].get("said", ""))
            lines.append(f"| {label} | {part.name} | {fitted} | {found.replace('_', ' ')} | {link} |")
    return lines


def full_tables(rows: Rows, manifest: Manifest, date: str, command: str) -> str:
    """Return the tables of the page: every method on every row."""
    names = list(dict.fromkeys(name for row in rows.values() for name in row))
    said = further(rows, by_device(rows, manifest))
    parts = [f"{date}, `{command}`. {said}", "", "### What is judged and found", "", *what_is_judged(rows, manifest)]
    for title, figure, text in (
        ("Without the mean error", "rms", "{0[rms]:.3f} ({0[low]:.3f} to {0[high]:.3f})"),
        ("With the mean error", "absolute", "{0[absolute]:.3f}"),
        ("On the fitted records, without the mean error", "fitted", "{0[fitted]:.3f}"),
        ("Inverse: error of the voltage, % of its range", "inverse", "{0[inverse]:.3f}"),
        ("Processor time of the fit, s", "fit_seconds", "{0[fit_seconds]:.1f}"),
        ("Processor time of a sample, µs", "sample_microseconds", "{0[sample_microseconds]:.2f}"),
    ):
        parts += ["", f"### {title}", "", f"| judged | {' | '.join(names)} |", f"|---|{'---|' * len(names)}"]
        for label, row in rows.items():
            known = {name: float(cell[figure]) for name, cell in row.items() if figure in cell}
            best = min(known, key=lambda name: known[name], default=None) if "seconds" not in figure else None
            absent = {name: "-" if "rms" in row.get(name, {}) else "refused" for name in names}
            cells = [text.format(row[name]) if name in known else absent[name] for name in names]
            cells = [f"**{cell}**" if name == best else cell for name, cell in zip(names, cells, strict=True)]
            parts.append(f"| {label} | {' | '.join(cells)} |")
    parts += ["", "### Worse than a straight line", "", *worse_than_line(rows, manifest)]
    return "\n".join(parts)


def latency_line(section: Mapping[str, Any]) -> str:
    """Return the sentence on the latency."""
    echo, compensator = (section["figures"]["events"][name] for name in ("echo", "compensator"))
    return (
        f"Latency of the compensator, from a desired displacement to its voltage over DDS at 1 kHz, two axes: median "
        f"{compensator['p50']:.0f} µs, 99th percentile {compensator['p99']:.0f} µs, so a jitter of "
        f"{compensator['p99'] - compensator['p50']:.0f} µs; a node that only echoes: {echo['p50']:.0f} and "
        f"{echo['p99']:.0f} µs ({section['date']}, `{section['command']}`, loopback of a shared machine)."
    )


def rows_table(rows: Mapping[str, Mapping[str, str]], names: Iterable[str]) -> str:
    """Return the table of other kept figures: a row for each of these names."""
    lines = ["| what | measured | command | date |", "|---|---|---|---|"]
    chosen = [rows[name] for name in names]
    lines += [f"| {row['what']} | {row['measured']} | `{row['command']}` | {row['date']} |" for row in chosen]
    return "\n".join(lines)


def _cell(cell: Mapping[str, Any], mark: str) -> str:
    if "rms" not in cell:
        return "refused"
    figure = f"{cell['rms']:.3f}"
    return {"*": f"**{figure}**", "=": f"{figure} *as good*"}.get(mark, figure)


def with_part(text: str, name: str, part: str) -> str:
    """Return a page with a generated part between the marks of this name; ValueError if it has none."""
    begin, end = f"<!-- {name}: begin -->", f"<!-- {name}: end -->"
    if text.count(begin) != 1 or text.count(end) != 1:
        raise ValueError(f"the page does not have the marks {begin} and {end} once")
    before, rest = text.split(begin)
    return f"{before}{begin}\n{part}\n{end}{rest.split(end)[1]}"


def pages() -> dict[Path, str]:
    """Return README and the pages of figures as the kept figures want them."""
    section, others, manifest = kept.read(SECTION), kept.read(kept.ROWS), read_manifest()
    rows, date, command = section["figures"], section["date"], section["command"]
    readme = with_part(README.read_text("utf-8"), "measured", readme_table(rows, manifest, date, command))
    readme = with_part(readme, "rows", rows_table(others, IN_README))
    rest = [name for name in others if name not in IN_README]
    figures = with_part(FIGURES.read_text("utf-8"), "rows", rows_table(others, rest))
    figures = with_part(figures, "latency", latency_line(kept.read(LATENCY)))
    measured = with_part(PAGE.read_text("utf-8"), "measured", full_tables(rows, manifest, date, command))
    return {README: readme, FIGURES: figures, PAGE: measured}


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
    """Write the pages and the picture, or compare the pages."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true", help="compare with the kept figures; write nothing")
    options = parser.parse_args()
    new = pages()
    differ = [path for path, text in new.items() if text != path.read_text(encoding="utf-8")]
    if options.check:
        for path in differ:
            print(f"{path} differs from the kept figures: python -m benchmarks.measured.report", file=sys.stderr)
        return int(bool(differ))
    for path in differ:
        path.write_text(new[path], encoding="utf-8")
    draw(kept.read(SECTION)["figures"], PICTURE)
    return 0


if __name__ == "__main__":
    sys.exit(main())
