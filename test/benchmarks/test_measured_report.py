"""README and the pages of figures hold the kept figures."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks import kept
from benchmarks.measured import loop, report, scores
from benchmarks.measured.bench import SECTION
from benchmarks.measured.manifest import Manifest, MeasuredRecord, Source, Span, Task, read_manifest
from benchmarks.measured.methods import METHODS


def section():
    return kept.read(SECTION)


@pytest.mark.parametrize("path", [report.README, report.PAGE, report.FIGURES])
def test_a_page_holds_the_kept_figures(path):
    assert report.pages()[path] == path.read_text(encoding="utf-8"), "python -m benchmarks.measured.report"


KEPT = (SECTION, report.LATENCY, kept.ROWS)


def test_every_row_and_method_is_kept():
    rows = section()["figures"]
    tasks = read_manifest().tasks
    assert set(rows) == {f"{task.name}: {part}" for task in tasks for part in task.judged}
    assert all(part.name for task in tasks for part in task.judged)
    for label, row in rows.items():
        assert set(row) == {method.name for method in METHODS}, label


def changed(monkeypatch, found):
    """Return the pages that differ if these are the kept figures."""
    monkeypatch.setattr(kept, "read", found.__getitem__)
    return {path for path, text in report.pages().items() if text != path.read_text(encoding="utf-8")}


@pytest.mark.parametrize(("figure", "pages"), [("rms", {report.README, report.PAGE}), ("absolute", {report.PAGE})])
def test_a_changed_figure_is_seen(monkeypatch, figure, pages):
    found = {name: kept.read(name) for name in KEPT}
    label = next(iter(report.by_device(found[SECTION]["figures"], read_manifest())))
    found[SECTION]["figures"][label]["PI"][figure] += 0.01
    assert changed(monkeypatch, found) == pages


def test_the_latency_is_in_the_page(monkeypatch):
    found = {name: kept.read(name) for name in KEPT}
    found[report.LATENCY]["figures"]["events"]["compensator"]["p99"] += 100.0
    assert changed(monkeypatch, found) == {report.FIGURES}


@pytest.mark.parametrize(("name", "page"), [("accuracy", report.README), ("faults", report.FIGURES)])
def test_the_rows_are_in_the_pages(monkeypatch, name, page):
    found = {name: kept.read(name) for name in KEPT}
    found[kept.ROWS][name]["measured"] = "1 m"
    assert changed(monkeypatch, found) == {page}


def test_each_device_that_moves_has_its_median_row():
    ratio = {"a: one": 2.0, "a: two": 0.5, "a: three": 1.0, "b: one": 0.5, "b: two": 3.0, "c: one": 1.0}
    rows = {label: {"SLPI, causes": {"rms": value}, "PI": {"rms": 1.0}, "GRU": {}} for label, value in ratio.items()}
    source = Source("o/a", "0" * 40, "MIT", "device")
    sources = {"a": source, "b": source, "c": replace(source, moves=False)}
    columns = {"time_s": "s", "voltage_V": "V", "displacement_um": "um"}
    records = {label: MeasuredRecord(label[0], ("f",), "e", columns, 1.0, "0" * 64, "") for label in ratio}
    records["fitted"] = records["c: one"]
    tasks = tuple(Task(label, "x", (Span("fitted"),), (Span(label, name=label),)) for label in ratio)
    chosen = report.by_device(
        {f"{label}: {label}": row for label, row in rows.items()}, Manifest(sources, records, tasks)
    )
    assert list(chosen.values()) == ["a: three", "b: two"]


def test_a_row_is_kept(tmp_path):
    path = tmp_path / "kept.json"
    kept.write("speed", "make bench", {"a": 1.0}, path)
    kept.write_row("b", "what", "1 nm", "make b", path)
    kept.write_row("b", "what", "2 nm", "make b", path)
    assert kept.read("speed", path)["figures"] == {"a": 1.0}
    (row,) = kept.read(kept.ROWS, path).values()
    assert (row["what"], row["measured"], row["command"]) == ("what", "2 nm", "make b")


def test_a_page_without_marks():
    with pytest.raises(ValueError, match="marks"):
        report.with_part("no marks", "measured", "table")


def test_picture(tmp_path):
    rows = {
        "a: b": {
            "PI": {"rms": 2.0, "low": 1.5, "high": 2.5},
            "SLPI": {"rms": 1.0, "low": 0.8, "high": 1.2},
            "GRU": {"refused": "too short"},
        }
    }
    for name in ("one.svg", "two.svg"):
        report.draw(rows, tmp_path / name)
    assert (tmp_path / "one.svg").read_bytes() == (tmp_path / "two.svg").read_bytes()


def test_ratios_to_the_best_other_method():
    def row(ours, pi, other):
        cells = {"SLPI, causes": ours, "SLPI": 0.1, "PI": pi, "GRU": other}
        # Blocks that are alike for all methods: each difference is certain.
        return {name: {"rms": x, "blocks": x**2 * squares, "absolute": 2.0 * x} for name, x in cells.items()}

    squares = np.random.default_rng(0).uniform(0.5, 1.5, scores.BLOCKS)

    rows = {"a": row(1.0, 4.0, 2.0), "b": row(1.0, 3.0, 0.95), "c": row(3.0, 1.0, 6.0)}
    best, pi = report.compared(rows), report.compared(rows, ["PI"])
    assert best.ratios == pytest.approx((0.5, 1.0 / 0.95, 3.0))
    assert best.absolute == pytest.approx(best.ratios)
    assert (best.wins, best.losses) == (1, 2)
    assert pi.ratios == pytest.approx((0.25, 1.0 / 3.0, 3.0))
    assert (pi.wins, pi.losses) == (2, 1)
    # A block that decides alone is no certainty.
    rows["b"]["GRU"]["blocks"] = np.append(1.2 * squares[:-1], 1.0)
    assert report.compared(rows).losses == 1


def test_the_picture_of_readme_shows_the_best_other_method():
    rows = section()["figures"]
    (row,) = (row for label, row in rows.items() if label.startswith(f"{loop.TASK}:"))
    others = {name: cell["rms"] for name, cell in row.items() if not name.startswith("SLPI") and "rms" in cell}
    assert min(others, key=others.get) in loop.MODELS


def test_what_is_worse_than_a_line_is_explained():
    rows = section()["figures"]
    for task in read_manifest().tasks:
        for part in task.judged:
            row = rows[f"{task.name}: {part}"]
            if any(cell["rms"] > row["line"]["rms"] for cell in row.values() if "rms" in cell):
                assert part.why, part


def losing(names):
    """Return the rows and methods whose kept error on their own fitted data is above that of the line."""
    return [
        (label, name)
        for label, row in section()["figures"].items()
        for name, cell in row.items()
        if name in names and "fitted" in cell and cell["fitted"] > 1.001 * row["line"]["fitted"]
    ]


def test_no_kept_method_loses_to_a_line_on_its_own_data():
    assert losing({method.name for method in METHODS} - {"SLPI, causes"}) == []


def test_no_causes_lose_to_a_line_on_their_own_data():
    assert losing({"SLPI, causes"}) == []
