"""Summary of each stage of a fleet: health, changes over time, exchange with another stage."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import groupby
from typing import Any

import numpy as np

from slpi_ros.fleet.bags import CHANGED, FAILED, FOREIGN, IDENTIFIED, PASSED, REFUSED, Row
from slpi_ros.fleet.changes import Change, find_changes
from slpi_ros.fleet.results import SCHEMA
from slpi_ros.identification.free_run import BEYOND_CHANCE

# Health by the latest usable bag. GOOD: the reference model holds; REFITTED: a model refitted to this bag does;
# EXCHANGED: the bag is of another stage; CALIBRATE: neither model holds, or no bag is usable.
GOOD, REFITTED, EXCHANGED, CALIBRATE = "good", "refitted", "exchanged", "calibrate"
_HEALTH = {IDENTIFIED: GOOD, PASSED: GOOD, CHANGED: REFITTED, FOREIGN: EXCHANGED, FAILED: CALIBRATE}
# Columns with value and uncertainty of each quantity, and the number of standard deviations of that uncertainty.
QUANTITIES = {
    "gain": ("gain_change", "gain_uncertainty", 1.0),
    "width": ("width_change", "width_uncertainty", 1.0),
    "offset": ("offset_m", "offset_uncertainty_m", BEYOND_CHANCE),
}


@dataclass(frozen=True)
class Exchange:
    """Bags that belong to another stage than named."""

    like_stage: str  # whose model describes them
    date_ns: int  # of the first of them
    before_ns: int | None  # of the last bag before, if any
    mutual: bool  # that stage has bags that belong to this one


@dataclass(frozen=True)
class StageSummary:
    """Summary of one axis of a stage."""

    stage: str
    axis: str
    health: str  # `GOOD`, `REFITTED`, `EXCHANGED` or `CALIBRATE`
    bags: int
    refused: int  # of the bags
    date_ns: int | None  # of the latest usable bag
    model: str  # path of the model that describes it; "": none
    changes: Mapping[str, tuple[Change, ...]]  # of ``gain``, ``width`` (relative to the model) and ``offset`` (m)
    exchanges: tuple[Exchange, ...]
    rows: tuple[Row, ...]  # by date

    @property
    def largest(self) -> float:
        """Largest total change of gain or width, relative."""
        return max((abs(one.size) for name in ("gain", "width") for one in self.changes[name]), default=0.0)

    def to_document(self) -> dict[str, Any]:
        """Return the summary as in ``msg_schemas/fleet.schema.json``."""
        changes = [{"quantity": name, **asdict(change)} for name, found in self.changes.items() for change in found]
        names = "stage", "axis", "health", "bags", "refused", "date_ns", "model"
        own = {name: getattr(self, name) for name in names}
        return {**own, "changes": changes, "exchanges": [asdict(one) for one in self.exchanges]}


def summarise(rows: Sequence[Row]) -> list[StageSummary]:
    """Return the summary of each axis of each stage, by name, of rows in any order; bags without a stage have none."""
    named = sorted((row for row in rows if row.stage), key=lambda row: (row.stage, row.date_ns or 0, row.bag))
    pairs = {(row.stage, row.like_stage) for row in named if row.verdict == FOREIGN}
    found = []
    for stage, each in groupby(named, key=lambda row: row.stage):
        own = list(each)
        for axis in sorted({row.axis for row in own if row.axis} or {""}):
            # A bag that cannot be read is one of every axis.
            found.append(_summary(stage, axis, [row for row in own if row.axis in (axis, "")], pairs))
    return found


def fleet_document(rows: Sequence[Row], stages: Sequence[StageSummary]) -> dict[str, Any]:
    """Return the summary of a fleet, ``msg_schemas/fleet.schema.json``."""
    return {
        "schema": SCHEMA,
        "bags": len({row.bag for row in rows}),
        "refused": [
            {"bag": row.bag, "axis": row.axis, "stage": row.stage, "error": row.error}
            for row in rows
            if row.verdict == REFUSED
        ],
        "stages": [stage.to_document() for stage in stages],
    }


def series(rows: Sequence[Row], quantity: str) -> tuple[Any, Any, Any]:
    """Return times (int64, ns), values and standard deviations, (N,) each, of a quantity of one stage and axis."""
    # Bags of other stages, and those that no model describes, are left out.
    value, uncertainty, times = QUANTITIES[quantity]
    points = [
        (row.date_ns, getattr(row, value), getattr(row, uncertainty) / times)
        for row in rows
        if row.verdict in (IDENTIFIED, PASSED, CHANGED) and getattr(row, uncertainty)
    ]
    dates, values, deviations = zip(*points, strict=True) if points else ((), (), ())
    return np.array(dates, np.int64), np.array(values, float), np.array(deviations, float)


def _summary(stage: str, axis: str, rows: Sequence[Row], pairs: set[tuple[str, str]]) -> StageSummary:
    usable = [row for row in rows if row.verdict != REFUSED]
    last = usable[-1] if usable else None
    return StageSummary(
        stage=stage,
        axis=axis,
        health=_HEALTH[last.verdict] if last else CALIBRATE,
        bags=len({row.bag for row in rows}),
        refused=len(rows) - len(usable),
        date_ns=last.date_ns if last else None,
        model=last.model if last and last.verdict in (IDENTIFIED, PASSED, CHANGED) else "",
        changes={name: tuple(find_changes(*series(rows, name))) for name in QUANTITIES},
        exchanges=tuple(_exchanges(usable, pairs)),
        rows=tuple(rows),
    )


def _exchanges(rows: Sequence[Row], pairs: set[tuple[str, str]]) -> Iterator[Exchange]:
    before: Row | None = None
    for row in rows:
        known = before.like_stage if before else ""
        if row.verdict == FOREIGN and row.like_stage != known:
            assert row.date_ns is not None
            mutual = (row.like_stage, row.stage) in pairs
            yield Exchange(row.like_stage, row.date_ns, before.date_ns if before else None, mutual)
        before = row
