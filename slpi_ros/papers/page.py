"""The page with all experiments of the two papers."""

from collections.abc import Sequence
from pathlib import Path

from slpi_ros.hysteresis.slpi_published import Separation
from slpi_ros.io.atomic_file import all_or_nothing, make_folder
from slpi_ros.papers import compound, measured, slpi_exhibits
from slpi_ros.papers import mpi_exhibits as mpi_paper
from slpi_ros.papers.exhibit import Exhibit
from slpi_ros.papers.slpi_study import RANDOM_PATH, study
from slpi_ros.reports.page import Page

FIRST = "Paper 1: Separated Level-loop Prandtl-Ishlinskii (SLPI) model"
SECOND = "Paper 2: multi-slope Prandtl-Ishlinskii (MPI) model"
PAGE, TABLE = "index.html", "separation.csv"
COLUMNS = "k,voltage_V,displacement_m,tr,lv,sp"


def write_experiments(folder: Path, data: Path | None) -> Path:
    """Run all experiments (records in `data`), write ``index.html`` and ``separation.csv``, return the page's path."""
    make_folder(folder)
    random = study(RANDOM_PATH)
    parts = {
        FIRST: slpi_exhibits.exhibits(random),
        SECOND: [*mpi_paper.exhibits(), *compound.exhibits()],
        "Measured records": measured.exhibits(data),
    }
    page = Page("The two papers, computed anew")
    page.text(
        "Every number and picture beside 'ours' was computed in the run that wrote this page, on simulated stages "
        "that resemble the papers' and are none of the models, and on measured records where they are at hand. "
        "The loop family, the default model, stands beside the papers' models."
    )
    page.definitions({exhibit.title: exhibit.ours for part in parts.values() for exhibit in part})
    for title, part in parts.items():
        page.heading(title)
        _show(page, part)
    path = folder / PAGE
    page.write(path)
    _write_separation(folder / TABLE, random.separation)
    return path


def _show(page: Page, exhibits: Sequence[Exhibit]) -> None:
    for exhibit in exhibits:
        page.section(exhibit.title)
        page.definitions({"Paper": exhibit.paper, "Ours": exhibit.ours, "Difference": exhibit.remark})
        for table in exhibit.tables:
            page.table(table.header, table.rows, table.best)
        for picture in exhibit.pictures:
            page.figure(picture.figure, picture.caption)


def _write_separation(path: Path, separation: Separation) -> None:
    """Write the table of separated loops, ``NewData`` in the SLPI paper (Eq. 4), as CSV."""
    with all_or_nothing(path) as file:
        file.write(f"{COLUMNS}\n")
        for k, voltage, displacement, tr, lv, sp in separation.table().tolist():
            file.write(f"{k:.0f},{voltage!r},{displacement!r},{tr:.0f},{lv:.0f},{sp:.0f}\n")
