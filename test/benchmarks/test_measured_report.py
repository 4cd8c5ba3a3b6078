"""README's table of measured records is the one of the kept figures."""

import pytest

from benchmarks import kept
from benchmarks.measured import report
from benchmarks.measured.bench import SECTION
from benchmarks.measured.manifest import read_manifest
from benchmarks.measured.methods import METHODS


def section():
    return kept.read(SECTION)


def test_readme_holds_the_kept_figures():
    found = section()
    table = report.readme_table(found["figures"], read_manifest(), found["date"], found["command"])
    text = report.README.read_text(encoding="utf-8")
    assert report.with_table(text, table) == text, "python -m benchmarks.measured.report"


def test_every_row_and_method_is_kept():
    rows = section()["figures"]
    tasks = read_manifest().tasks
    assert set(rows) == {f"{task.name}: {part}" for task in tasks for part in task.judged}
    for label, row in rows.items():
        assert set(row) == {method.name for method in METHODS}, label


def test_a_changed_figure_is_seen():
    found = section()
    label, name = next(iter(found["figures"])), "PI"
    found["figures"][label][name]["rms"] += 0.01
    table = report.readme_table(found["figures"], read_manifest(), found["date"], found["command"])
    text = report.README.read_text(encoding="utf-8")
    assert report.with_table(text, table) != text


def test_a_page_without_marks():
    with pytest.raises(ValueError, match="marks"):
        report.with_table("no marks", "table")


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
