"""Tables of errors that several exhibits of the SLPI paper share."""

from collections.abc import Mapping

import numpy as np

from slpi_ros.hysteresis.loops import Separation
from slpi_ros.papers.exhibit import Table
from slpi_ros.papers.slpi_pictures import ROMAN
from slpi_ros.papers.slpi_study import LoopErrors, Study


def um(metres: float) -> str:
    """Return a length in micrometres, three digits behind the point."""
    return f"{metres * 1e6:.3f}"


def turns_of(study: Study) -> str:
    """Return the path in words."""
    return " → ".join(f"{turn:.0f}" for turn in study.turns) + " V"


def errors_table(errors: Mapping[str, LoopErrors], separation: Separation, what: str = "") -> Table:
    """Return the errors of all models, loop by loop; the best one stands out."""
    v = separation.voltage
    levels = [f"{ROMAN[loop.level]} from {v[loop.vertex]:.0f} V" for loop in separation.loops]
    rows = [
        (name, um(e.overall), *(um(mean) for mean in e.means), um(e.maxima[0]), um(e.spread))
        for name, e in errors.items()
    ]
    name = f"error {what} (µm)" if what else "error (µm)"
    header = (name, "mean", *(f"mean, level {level}" for level in levels), "maximum, level 0", "spread")
    return Table(header, tuple(rows), best=int(np.argmin([e.overall for e in errors.values()])))
