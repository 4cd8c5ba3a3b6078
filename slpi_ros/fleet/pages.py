"""The pages of a fleet: ``index.html`` with all stages, one page for each stage, and sentences for the terminal."""

from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from slpi_ros.errors import length
from slpi_ros.fleet.bags import REFUSED, Row, plain_name
from slpi_ros.fleet.cluster import run
from slpi_ros.fleet.results import TABLE, Results
from slpi_ros.fleet.stages import (
    CALIBRATE,
    EXCHANGED,
    GOOD,
    QUANTITIES,
    REFITTED,
    StageSummary,
    fleet_document,
    series,
    summarise,
)
from slpi_ros.io.atomic_file import all_or_nothing
from slpi_ros.io.schemas import format_document
from slpi_ros.reports.chart import CAUSES, COLOURS, MEASURED, NOISE, Chart, Panel, Quantity
from slpi_ros.reports.page import Page, Severity

PAGE, DOCUMENT = "index.html", "fleet.json"
# Order of the stages on the page, colour of their health, and what is to be done.
_HEALTH: dict[str, tuple[Severity, str]] = {
    CALIBRATE: ("bad", "no model describes the latest bag: record and identify anew"),
    EXCHANGED: ("bad", "the latest bag is of another stage: check cables and names"),
    REFITTED: ("warn", "the reference no longer holds: use the refitted model"),
    GOOD: ("good", "the reference holds"),
}
# Stages whose trends are on the first page: those with the largest changes.
_MOST_TRENDS = 10
_PANELS = {
    "gain": Quantity("change of gain", "%", 100.0, ".3f"),
    "width": Quantity("change of loop width", "%", 100.0, ".3f"),
    "offset": Quantity("offset", "nm", 1e9, ".1f"),
}
_COLUMNS = "date", "verdict", "gain", "loop width", "offset (nm)", "error (nm)", "limit (nm)", "causes", "bag", "notes"
_DAYS = Quantity("time since the first bag", "d", 1.0 / 86400.0, ".2f")


class Pages:
    """Writer of the pages; a stage whose rows are the same as before keeps its page."""

    def __init__(self) -> None:
        self._written: dict[str, int] = {}

    def write(self, results: Results) -> None:
        """Write ``fleet.json``, ``index.html`` and the pages of the stages with new rows."""
        rows, folder = results.state.rows(), results.folder
        stages = summarise(rows)
        with all_or_nothing(folder / DOCUMENT) as file:
            file.write(format_document(fleet_document(rows, stages), "fleet"))
        for name in dict.fromkeys(one.stage for one in stages):
            own = [one for one in stages if one.stage == name]
            content = hash(tuple((row.bag, row.axis, row.verdict, row.seconds) for one in own for row in one.rows))
            if self._written.get(name) != content:
                _stage_page(name, own).write(folder / stage_page(name))
                self._written[name] = content
        _index(rows, stages).write(folder / PAGE)


def report_fleet(
    sources: Sequence[str], output: str, *, as_document: bool = False, **options: Any
) -> tuple[list[str], bool]:
    """Run `slpi_ros.fleet.run`, write pages; return sentences or ``fleet.json``, and whether any bag was usable."""
    pages = Pages()
    rows: list[Row] = []

    def finished(results: Results) -> None:
        rows[:] = results.state.rows()
        pages.write(results)

    run(sources, output, finished=finished, **options)
    if as_document:
        lines = [(Path(output) / DOCUMENT).read_text(encoding="utf-8")]
    else:
        lines = [*describe_fleet(rows), f"{Path(output) / PAGE}: open it in a browser"]
    return lines, any(row.verdict != REFUSED for row in rows)


def stage_page(stage: str) -> str:
    """Return the path of a stage's page within the folder of the results."""
    return f"stages/{plain_name(stage)}.html"


def describe_fleet(rows: Sequence[Row]) -> list[str]:
    """Return lines of text: the counts, and each stage that is not good or has changed."""
    stages = summarise(rows)
    refused = [row for row in rows if row.verdict == REFUSED]
    count = {health: sum(one.health == health for one in stages) for health in _HEALTH}
    lines = [
        f"bags: {len({row.bag for row in rows})}, stages: {len({one.stage for one in stages})}; axes "
        + ", ".join(f"{health}: {number}" for health, number in count.items())
    ]
    for one in sorted(stages, key=_order):
        told = list(_told(one))
        if told or one.health != GOOD:
            lines.append(f"{_name(one)}: {one.health}" + "".join(f"; {text}" for text in told))
    return lines + [f"refused: {row.error or row.bag}" for row in refused]


def _order(one: StageSummary) -> tuple[int, float, str, str]:
    return list(_HEALTH).index(one.health), -one.largest, one.stage, one.axis


def _name(one: StageSummary) -> str:
    return f"{one.stage} {one.axis}".strip()


def _told(one: StageSummary) -> Iterator[str]:
    """Yield the exchanges and the changes of gain and width of a stage, and of its zero, with date and chance."""
    for exchange in one.exchanges:
        word = "exchanged with" if exchange.mutual else "bags of"
        yield f"{word} {exchange.like_stage} since {_date(exchange.date_ns)}"
    for quantity, found in one.changes.items():
        for change in found:
            size = (
                f"{change.size * 1e9:+.3g} ± {change.uncertainty * 1e9:.1g} nm"
                if quantity == "offset"
                else f"{change.size:+.2%} ± {change.uncertainty:.2%}"
            )
            when = (
                f"between {_date(change.before_ns)} and {_date(change.date_ns)}"
                if change.kind == "step"
                else f"in all, visible from {_date(change.date_ns)}"
            )
            yield f"{quantity} {change.kind} {size} {when} (by chance: {max(change.chance, 1e-99):.0e})"


def _index(rows: Sequence[Row], stages: Sequence[StageSummary]) -> Page:
    page = Page("Fleet of stages")
    refused = [row for row in rows if row.verdict == REFUSED]
    worst = next((health for health in _HEALTH if any(one.health == health for one in stages)), GOOD)
    page.verdict("fleet", describe_fleet(rows)[0], _HEALTH[worst][0], worst)
    page.tiles(
        {
            "bags": str(len({row.bag for row in rows})),
            "stages": str(len({one.stage for one in stages})),
            "need a calibration": str(sum(one.health == CALIBRATE for one in stages)),
            "refused bags": str(len({row.bag for row in refused})),
        }
    )
    page.definitions({health: text for health, (_, text) in _HEALTH.items()})
    page.section("Stages by health")
    table: list[Sequence[str] | str] = []
    links = {}
    for health in _HEALTH:
        own = sorted((one for one in stages if one.health == health), key=_order)
        if own:
            table.append(health)
        for one in own:
            links[_name(one)] = stage_page(one.stage)
            table.append([_name(one), str(one.bags), str(one.refused), _date(one.date_ns), "; ".join(_told(one))])
    page.table(("stage", "bags", "refused", "latest bag", "changes"), table, links=links)
    shown = sorted((one for one in stages if one.largest or one.health != GOOD), key=lambda one: -one.largest)
    if shown:
        page.section("Trends of the stages with the largest changes")
        page.chart("trends", _trends(shown[:_MOST_TRENDS]), "Changes from the reference model of each stage.")
    if refused:
        page.section("Bags that cannot be used")
        page.table(("stage", "bag", "reason"), [[row.stage, row.bag, row.error] for row in refused])
    page.text(f"All figures of all bags: {TABLE}; this summary: {DOCUMENT}.")
    return page


def _stage_page(name: str, axes: Sequence[StageSummary]) -> Page:
    page = Page(f"Stage {name}")
    page.contents([one.axis for one in axes])
    for one in axes:
        if one.axis:
            page.heading(f"Axis {one.axis}", one.axis)
        severity, text = _HEALTH[one.health]
        page.verdict(one.axis, text, severity, one.health)
        page.lines([*_told(one), *([f"model: {one.model}"] if one.model else [])])
        if any(row.gain_change is not None for row in one.rows):
            page.chart(
                f"trend-{one.axis}",
                _trends([one], uncertain=True),
                "Changes from the reference model; lines: two standard deviations.",
            )
        links = {_date(row.date_ns): f"../{row.page}" for row in one.rows if row.page}
        page.table(_COLUMNS, [_cells(row) for row in one.rows], links=links)
    return page


def _cells(row: Row) -> list[str]:
    number = [
        f"{row.gain_change:+.3%}" if row.gain_change is not None else "",
        f"{row.width_change:+.3%}" if row.width_change is not None else "",
        *(
            "" if value is None else f"{value * 1e9:.1f}"
            for value in (row.offset_m, row.held_out_rms_m, row.limit_rms_m)
        ),
    ]
    causes = ", ".join(str(cause["name"]) for cause in row.causes) or row.diagnosis.replace("_", " ")
    like = [f"of stage {row.like_stage}"] if row.like_stage else []
    refitted = [f"refitted: {length(row.refitted_rms_m)}"] if row.refitted_rms_m is not None else []
    notes = "; ".join([*like, *refitted, *([row.error] if row.error else []), *row.findings])
    return [_date(row.date_ns), row.verdict, *number, causes, row.bag, notes]


def _trends(stages: Sequence[StageSummary], *, uncertain: bool = False) -> Chart:
    """Return a chart of gain, width and offset over time, of several stages or of one with its uncertainty."""
    chart = Chart([Panel(_DAYS, _PANELS[name]) for name in QUANTITIES], "column", 620)
    points = {(one.stage, one.axis, name): series(one.rows, name) for one in stages for name in QUANTITIES}
    first = min((int(dates[0]) for dates, _, _ in points.values() if dates.size), default=0)
    colours = (*COLOURS, *CAUSES)
    for number, one in enumerate(stages):
        for panel, name in enumerate(QUANTITIES):
            dates, values, deviations = points[one.stage, one.axis, name]
            if not dates.size:
                continue
            t = (dates - first) * 1e-9
            colour = MEASURED if uncertain else colours[number % len(colours)]
            chart.line(panel, _name(one), t, values, colour)
            chart.dots(panel, f"{_name(one)}, bags", t, values, colour)
            if uncertain:
                for side in (-2.0, 2.0):
                    chart.line(panel, "two standard deviations", t, values + side * deviations, NOISE, width=1.0)
    return chart


def _date(nanoseconds: int | None) -> str:
    if nanoseconds is None:
        return ""
    return datetime.fromtimestamp(nanoseconds // 10**9, UTC).strftime("%Y-%m-%d %H:%M")
