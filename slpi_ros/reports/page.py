"""One self-contained HTML page: text, tables and pictures, nothing to fetch."""

import base64
import html
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from matplotlib.figure import Figure

from slpi_ros.files import all_or_nothing, make_folder

_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; color: #1b2733; background: #fff; }
body { max-width: 1040px; margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.7rem; margin-bottom: .2rem; }
h2 { font-size: 1.3rem; margin-top: 2.2rem; }
h3 { font-size: 1.1rem; margin-top: 2.2rem; border-top: 1px solid #d5dde5; padding-top: .8rem; }
dl { display: grid; grid-template-columns: fit-content(17rem) 1fr; gap: .3rem 1rem; margin: .6rem 0; }
dt { color: #51606e; }
dd { margin: 0; }
table { border-collapse: collapse; margin: 1rem 0; }
th, td { padding: .35rem .9rem; text-align: right; border-bottom: 1px solid #d5dde5; }
th { background: #f2f5f8; }
th:first-child, td:first-child { text-align: left; }
tr.best td { font-weight: 600; background: #eef7f0; }
img { max-width: 100%; height: auto; }
figure { margin: 1rem 0; }
figcaption { color: #51606e; font-size: .92rem; }
"""


@dataclass
class Page:
    """A page that grows from top to bottom.

    Parameters
    ----------
    title : str
    """

    title: str
    _parts: list[str] = field(default_factory=list)

    def heading(self, text: str) -> None:
        """Add a heading."""
        self._parts.append(f"<h2>{html.escape(text)}</h2>")

    def section(self, text: str) -> None:
        """Add a heading below a heading."""
        self._parts.append(f"<h3>{html.escape(text)}</h3>")

    def text(self, text: str) -> None:
        """Add a paragraph."""
        self._parts.append(f"<p>{html.escape(text)}</p>")

    def definitions(self, texts: Mapping[str, str]) -> None:
        """Add terms, each with what it is."""
        items = (f"<dt>{html.escape(term)}</dt><dd>{html.escape(text)}</dd>" for term, text in texts.items())
        self._parts.append(f"<dl>{''.join(items)}</dl>")

    def lines(self, lines: Sequence[str]) -> None:
        """Add a list of short lines."""
        self._parts.append(f"<ul>{''.join(f'<li>{html.escape(line)}</li>' for line in lines)}</ul>")

    def table(self, header: Sequence[str], rows: Sequence[Sequence[str]], best: int | None = None) -> None:
        """Add a table; row `best` stands out."""
        head = "".join(f"<th>{html.escape(cell)}</th>" for cell in header)
        body = []
        for k, row in enumerate(rows):
            cells = "".join(f"<td>{html.escape(cell)}</td>" for cell in row)
            body.append(f'<tr class="best">{cells}</tr>' if k == best else f"<tr>{cells}</tr>")
        self._parts.append(f"<table><thead><tr>{head}</tr></thead><tbody>{''.join(body)}</tbody></table>")

    def figure(self, figure: Figure, caption: str) -> None:
        """Add a picture with its caption."""
        picture = base64.b64encode(png(figure)).decode()
        self._parts.append(
            f'<figure><img alt="{html.escape(caption)}" src="data:image/png;base64,{picture}">'
            f"<figcaption>{html.escape(caption)}</figcaption></figure>"
        )

    def write(self, path: Path) -> None:
        """Write the page, all of it or nothing.

        Raises
        ------
        SlpiError
            If it cannot be written.
        """
        title = html.escape(self.title)
        document = (
            f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{title}</title>'
            f'<meta name="viewport" content="width=device-width"><style>{_STYLE}</style></head>'
            f"<body><h1>{title}</h1>{''.join(self._parts)}</body></html>"
        )
        make_folder(path.parent)
        with all_or_nothing(path) as file:
            file.write(document)


def png(figure: Figure) -> bytes:
    """Return a figure as a PNG file's bytes."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    return buffer.getvalue()
