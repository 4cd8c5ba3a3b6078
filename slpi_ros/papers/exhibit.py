"""An exhibit: a table or figure of a paper, the one computed here beside it, and what differs."""

from dataclasses import dataclass

from matplotlib.figure import Figure


@dataclass(frozen=True)
class Table:
    """A table of text cells; row `best` stands out."""

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
    """One section of the page.

    Parameters
    ----------
    title : str
        The paper's figure or table.
    paper : str
        What the paper shows, in words or numbers.
    ours : str
        What was computed.
    remark : str
        One sentence on any difference.
    tables : tuple of Table
    pictures : tuple of Picture
    """

    title: str
    paper: str
    ours: str
    remark: str
    tables: tuple[Table, ...] = ()
    pictures: tuple[Picture, ...] = ()


def um(metres: float, digits: int = 3) -> str:
    """Return a length as text, in micrometres."""
    return f"{metres * 1e6:.{digits}f}"
