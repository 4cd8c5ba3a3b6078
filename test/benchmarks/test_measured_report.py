"""README and the page on measured records hold the kept figures."""

import pytest

from benchmarks import kept
from benchmarks.measured import report
from benchmarks.measured.bench import SECTION
from benchmarks.measured.manifest import read_manifest
from benchmarks.measured.methods import METHODS


def section():
    return kept.read(SECTION)


@pytest.mark.parametrize("path", [report.README, report.PAGE])
def test_a_page_holds_the_kept_figures(path):
    assert report.pages()[path] == path.read_text(encoding="utf-8"), "python -m benchmarks.measured.report"


KEPT = (SECTION, report.LATENCY, kept.ROWS)


def test_every_row_and_method_is_kept():
    rows = section()["figures"]
    tasks = read_manifest().tasks
    assert set(rows) == {f"{task.name}: {part}" for task in tasks for part in task.judged}
    for label, row in rows.items():
        assert set(row) == {method.name for method in METHODS}, label


@pytest.mark.parametrize("figure", ["rms", "absolute"])
def test_a_changed_figure_is_seen(monkeypatch, figure):
    found = {name: kept.read(name) for name in KEPT}
    next(iter(found[SECTION]["figures"].values()))["PI"][figure] += 0.01
    monkeypatch.setattr(kept, "read", found.__getitem__)
    changed = {path for path, text in report.pages().items() if text != path.read_text(encoding="utf-8")}
    assert changed == ({report.README, report.PAGE} if figure == "rms" else {report.PAGE})


def test_the_latency_is_in_the_page(monkeypatch):
    found = {name: kept.read(name) for name in KEPT}
    found[report.LATENCY]["figures"]["events"]["compensator"]["p99"] += 100.0
    monkeypatch.setattr(kept, "read", found.__getitem__)
    assert report.pages()[report.README] != report.README.read_text(encoding="utf-8")


def test_the_rows_are_in_the_page(monkeypatch):
    found = {name: kept.read(name) for name in KEPT}
    next(iter(found[kept.ROWS].values()))["measured"] = "1 m"
    monkeypatch.setattr(kept, "read", found.__getitem__)
    assert report.pages()[report.README] != report.README.read_text(encoding="utf-8")


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
