"""A self-contained HTML page of text, tables, pictures and interactive charts, without external resources."""

import base64
import html
import io
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Literal
from urllib.parse import quote

from slpi_ros.errors import shown
from slpi_ros.identification.record_quality import Finding
from slpi_ros.io.atomic_file import all_or_nothing, make_folder
from slpi_ros.io.outputs import PAGE_MARK
from slpi_ros.reports.chart import Chart

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Characters of one text on a page: a paragraph, not a file.
_LONGEST_TEXT = 20_000
# Length (characters) above which the column of a table holds text and not numbers.
_SENTENCE = 36
# A table with more columns, or with a longer word, is too wide for a telephone: its rows become lists there.
_MOST_COLUMNS, _LONGEST_WORD = 5, 20

Severity = Literal["good", "warn", "bad"]

# Content policy that prevents the browser from loading external resources, whatever the page contains.
_CONTENT_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data: blob:; "
    "base-uri 'none'; form-action 'none'"
)
_HINT = (
    "Drag over a chart to zoom, double-click to reset the view; click a name in a legend to hide or show it, "
    "double-click to show only that curve; hover over a curve for its values."
)


@dataclass(frozen=True)
class Share:
    """A part of a whole, 0..1, with name and colour."""

    name: str
    share: float
    colour: str


@dataclass
class Page:
    """A page to which elements are appended from top to bottom."""

    title: str
    _parts: list[str] = field(default_factory=list, init=False)
    _has_charts: bool = field(default=False, init=False)

    def contents(self, axes: Sequence[str]) -> None:
        """Add links to the headings of several axes."""
        if len(axes) > 1:
            links = (f'<a href="#{html.escape(quote(shown(f"axis-{axis}")))}">Axis {_text(axis)}</a>' for axis in axes)
            self._parts.append(f"<nav>{''.join(links)}</nav>")

    def heading(self, text: str, axis: str | None = None) -> None:
        """Add a heading; with `axis`, it is the target of a link in `contents`."""
        target = "" if axis is None else f' id="{_text(f"axis-{axis}")}"'
        self._parts.append(f"<h2{target}>{_text(text)}</h2>")

    def verdict(self, axis: str, text: str, severity: Severity, word: str = "") -> None:
        """Add the summary sentence of an axis, after an optional word; its element has the id ``verdict-<axis>``."""
        name, before = _text(f"verdict-{axis}"), f"<b>{_text(word.replace('_', ' '))}</b> " if word else ""
        said = f' data-verdict="{_text(word)}"' if word else ""
        self._parts.append(f'<p class="verdict {severity}" id="{name}"{said}>{before}{_prose(text)}</p>')

    def tiles(self, figures: Mapping[str, str]) -> None:
        """Add key figures by name."""
        tiles = (f"<div><b>{_text(text)}</b><span>{_text(name)}</span></div>" for name, text in figures.items())
        self._parts.append(f'<div class="tiles">{"".join(tiles)}</div>')

    def findings(self, found: Iterable[Finding]) -> None:
        """Add the findings on a record."""
        items = (f'<li><b class="{one.level}">{one.level}</b>{_prose(one.text)}</li>' for one in found)
        self._parts.append(f'<ul class="findings">{"".join(items)}</ul>')

    def shares(self, parts: Sequence[Share]) -> None:
        """Add a bar of the parts of a whole, with names and shares."""
        bar = (f'<div style="flex:{part.share:.4f} 0 0;background:{part.colour}"></div>' for part in parts)
        keys = (
            f'<li><i style="background:{part.colour}"></i>{_text(part.name)} <b>{part.share:.0%}</b></li>'
            for part in parts
        )
        self._parts.append(f'<div class="shares">{"".join(bar)}</div><ul class="keys">{"".join(keys)}</ul>')

    def chart(self, name: str, chart: Chart, caption: str) -> None:
        """Add an interactive chart with its caption; the id of its element is `name`."""
        if not self._has_charts:
            self._parts.append(f'<p class="hint">{_HINT}</p><noscript><p>The charts need JavaScript.</p></noscript>')
        self._has_charts = True
        self._parts.append(
            f'<figure class="chart"><div id="{_text(name)}" style="min-height:{chart.height}px"></div>'
            f'<script type="application/json">{chart.to_json()}</script>'
            f"<figcaption>{_prose(caption)}</figcaption></figure>"
        )

    def section(self, text: str) -> None:
        """Add a second-level heading."""
        self._parts.append(f"<h3>{_text(text)}</h3>")

    def subsection(self, text: str) -> None:
        """Add a third-level heading."""
        self._parts.append(f"<h4>{_text(text)}</h4>")

    def text(self, text: str) -> None:
        """Add a paragraph."""
        self._parts.append(f"<p>{_prose(text)}</p>")

    def definitions(self, texts: Mapping[str, str]) -> None:
        """Add a list of terms and their definitions."""
        items = (f"<dt>{_text(term)}</dt><dd>{_prose(text)}</dd>" for term, text in texts.items())
        self._parts.append(f"<dl>{''.join(items)}</dl>")

    def lines(self, lines: Sequence[str]) -> None:
        """Add a list of short lines."""
        self._parts.append(f"<ul>{''.join(f'<li>{_prose(line)}</li>' for line in lines)}</ul>")

    def table(
        self,
        header: Sequence[str],
        rows: Sequence[Sequence[str] | str],
        best: int | None = None,
        caption: str = "",
        links: Mapping[str, str] | None = None,
    ) -> None:
        """Add a table; row `best` is highlighted, a row of text is a group heading, first cells may be `links`."""
        below = f"<figcaption>{_prose(caption)}</figcaption>" if caption else ""
        cells_of = [row for row in rows if not isinstance(row, str)]
        # Sentences and paths are aligned like text and broken into lines; numbers are neither.
        worded = {k for row in cells_of for k, cell in enumerate(row) if k and len(cell) > _SENTENCE}

        longest = max((len(word) for row in cells_of for cell in row for word in cell.split()), default=0)
        wide = worded or len(header) > _MOST_COLUMNS or longest > _LONGEST_WORD
        names = [_text(cell) for cell in header]

        def line(tag: str, texts: Sequence[str]) -> str:
            marks = [' class="words"' if k in worded else "" for k in range(len(texts))]
            if tag == "td" and wide:
                marks = [f'{mark} data-name="{name}"' for mark, name in zip(marks, names, strict=True)]
            return "".join(f"<{tag}{mark}>{text}</{tag}>" for mark, text in zip(marks, texts, strict=True))

        head = line("th", names)
        body = []
        for k, row in enumerate(rows):
            if isinstance(row, str):
                body.append(f'<tr class="group"><td colspan="{len(header)}">{_text(row)}</td></tr>')
                continue
            texts = [_prose(cell) for cell in row]
            if links and row[0] in links:
                texts[0] = f'<a href="{html.escape(quote(links[row[0]]))}">{texts[0]}</a>'
            cells = line("td", texts)
            body.append(f'<tr class="best">{cells}</tr>' if k == best else f"<tr>{cells}</tr>")
        rows_below = f"<thead><tr>{head}</tr></thead><tbody>{''.join(body)}</tbody>"
        kind = ' class="wide"' if wide else ""
        self._parts.append(f'<figure><div class="scroll"><table{kind}>{rows_below}</table></div>{below}</figure>')

    def figure(self, figure: "Figure", caption: str) -> None:
        """Add a picture with its caption."""
        picture = base64.b64encode(png(figure)).decode()
        self._parts.append(
            f'<figure><img alt="{_text(caption)}" src="data:image/png;base64,{picture}">'
            f"<figcaption>{_prose(caption)}</figcaption></figure>"
        )

    def write(self, path: Path) -> None:
        """Write the page atomically; SlpiError if the file cannot be written."""
        title = _text(self.title)
        scripts = ("plotly-cartesian.min.js", "page.js") if self._has_charts else ()
        document = (
            f'<!doctype html><html lang="en"><head><meta charset="utf-8">{PAGE_MARK}<title>{title}</title>'
            f'<meta http-equiv="Content-Security-Policy" content="{_CONTENT_POLICY}">'
            f'<meta name="viewport" content="width=device-width"><style>{_asset("page.css")}</style></head>'
            f"<body><h1>{title}</h1>{''.join(self._parts)}"
            f"{''.join(f'<script>{_asset(name)}</script>' for name in scripts)}</body></html>"
        )
        make_folder(path.parent)
        with all_or_nothing(path) as file:
            file.write(document)


def _text(text: str) -> str:
    return html.escape(shown(text, _LONGEST_TEXT))


def _prose(text: str) -> str:
    """Return a text with what stands between backticks, such as a command, as code."""
    return re.sub("`([^`]+)`", r"<code>\1</code>", _text(text))


def _asset(name: str) -> str:
    return (files("slpi_ros.reports") / "assets" / name).read_text(encoding="utf-8")


def png(figure: "Figure") -> bytes:
    """Return a figure as the content of a PNG file."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    return buffer.getvalue()
