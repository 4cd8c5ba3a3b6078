"""The file of kept figures: a section for each command, with its date, the versions it ran with, and its figures.

The section `ROWS` holds the rows of README's table, each with the command that printed its figures, and the date.
"""

import json
import platform
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

KEPT = Path(__file__).with_name("kept_figures.json")
ROWS = "rows"
PACKAGES = ("numba", "numpy", "osqp", "scipy")


def read(section: str, path: Path = KEPT) -> dict[str, Any]:
    """Return a section: ``date``, ``command``, ``versions`` and ``figures``; empty if there is none."""
    if not path.exists():
        return {}
    found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8")).get(section, {})
    return found


def write(section: str, command: str, figures: Any, path: Path = KEPT) -> None:
    """Replace the figures of a section; the others stay as they are."""
    _replace(section, {**_when(command), "figures": figures}, path)


def write_row(key: str, what: str, measured: str, command: str, path: Path = KEPT) -> None:
    """Replace a row of README's table: what was measured, the figures as text, and the command that prints them."""
    _replace(ROWS, {**read(ROWS, path), key: {"what": what, "measured": measured, **_when(command)}}, path)


def _replace(section: str, content: dict[str, Any], path: Path) -> None:
    document = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    document[section] = content
    path.write_text(json.dumps(document, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def _when(command: str) -> dict[str, Any]:
    versions = {"python": platform.python_version(), **{name: version(name) for name in PACKAGES}}
    return {"date": datetime.now(UTC).date().isoformat(), "command": command, "versions": versions}
