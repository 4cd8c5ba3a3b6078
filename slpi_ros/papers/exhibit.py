"""Exhibits: a table or figure of a paper in comparison with the reproduced one, and functions to draw them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure


@dataclass(frozen=True)
class Table:
    """A table of text cells; row `best` is highlighted."""

    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    best: int | None = None


@dataclass(frozen=True)
class Picture:
    """A picture with its caption."""

    figure: Figure
    caption: str


@dataclass(frozen=True)
class Exhibit:
    """Comparison of a result of a paper with the reproduced one; a section of the page."""

    title: str  # figure or table of the paper
    paper: str  # its result in words or numbers
    ours: str  # the reproduced result
    remark: str  # explains the differences
    tables: tuple[Table, ...] = ()
    pictures: tuple[Picture, ...] = ()


def um(metres: float, digits: int = 3) -> str:
    """Return a length as text, in micrometres."""
    return f"{metres * 1e6:.{digits}f}"


def panels(rows: int, columns: int, size: tuple[float, float], **options: Any) -> tuple[Figure, Any]:
    """Return a figure of a size (inches) and its panels, row by row; `options` are those of ``Figure.subplots``."""
    figure = Figure(figsize=size, layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False, **options).ravel()


def label_axes(panel: Axes, x: str, y: str) -> None:
    """Label the axes of a panel and add a grid."""
    panel.set_xlabel(x)
    panel.set_ylabel(y)
    panel.grid(color="#e4e9ee", linewidth=0.7)
    panel.spines[["top", "right"]].set_visible(False)


def outer_legend(
    figure: Figure, handles: Sequence[Artist], names: Sequence[str], *, inches: float, below: bool = False, **more: Any
) -> None:
    """Add a legend of a height (inches) above or below all panels; `more` are options of ``Figure.legend``."""
    share = inches / float(figure.get_figheight())
    # The place "outside ..." would keep this room itself, but Matplotlib 3.6 does not know it.
    engine: Any = figure.get_layout_engine()
    engine.set(rect=(0.0, share if below else 0.0, 1.0, 1.0 - share))
    figure.legend(list(handles), list(names), loc="lower center" if below else "upper center", frameon=False, **more)
