"""What the demo shows of its runs: an interactive chart for the page, and the picture of README."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from slpi_ros.papers.exhibit import label_axes, panels
from slpi_ros.reports import views
from slpi_ros.reports.chart import COLOURS, DESIRED, DISPLACEMENT, TIME, Chart, Panel, Quantity, thin_line

FloatArray = NDArray[np.float64]

WANTED = Quantity("desired displacement", "µm", 1e6, ".4f")
ERROR = Quantity("measured - desired", "µm", 1e6, ".4f")


@dataclass(frozen=True)
class Run:
    """Desired and measured displacement along a path.

    Parameters
    ----------
    name : str
        Name of the model or control scheme.
    t : ndarray, shape (N,), seconds
    desired, displacement : ndarray, shape (N,), metres
        Desired and measured displacement.
    held : float
        Share of the samples that were out of reach and held at a voltage limit; default 0.
    late : tuple of float, seconds
        Times of the samples that were sent later than at the next one's time; default none.
    """

    name: str
    t: FloatArray
    desired: FloatArray
    displacement: FloatArray
    held: float = 0.0
    late: tuple[float, ...] = ()

    @property
    def error(self) -> FloatArray:
        """Measured - desired displacement, shape (N,), metres."""
        return self.displacement - self.desired


def over_time(runs: Sequence[Run]) -> tuple[Chart, str]:
    """Return the chart of displacements and errors over time, and a note on what lies outside the initial view."""
    chart = Chart([Panel(TIME, DISPLACEMENT, 1.5), Panel(TIME, ERROR)], "column", 620)
    kept = thin_line(runs[0].desired)
    chart.line(0, "desired", runs[0].t[kept], runs[0].desired[kept], DESIRED, width=2.6)
    for colour, run in zip(COLOURS, runs, strict=False):
        kept = thin_line(run.displacement, run.error)
        chart.line(0, run.name, run.t[kept], run.displacement[kept], colour, width=1.2)
        chart.line(1, run.name, run.t[kept], run.error[kept], colour, width=1.0)
    return chart, views.focus(chart, (1,), [run.error for run in runs])


def over_desired(runs: Sequence[Run]) -> Chart:
    """Return the chart of measured over desired displacement, one panel for each run."""
    chart = Chart([Panel(WANTED, DISPLACEMENT) for _ in runs], height=380)
    for panel, (colour, run) in enumerate(zip(COLOURS, runs, strict=False)):
        kept = thin_line(run.desired, run.displacement)
        chart.line(panel, run.name, run.desired[kept], run.displacement[kept], colour, width=1.0)
    return chart


def picture(runs: Sequence[Run]) -> Figure:
    """Draw what `over_time` shows as a picture."""
    figure, (upper, lower) = panels(2, 1, (11, 6.4), height_ratios=(3, 2), sharex=True)
    for colour, run in zip(COLOURS, runs, strict=False):
        upper.plot(run.t, run.displacement * 1e6, color=colour, linewidth=1.1, label=run.name)
        lower.plot(run.t, run.error * 1e6, color=colour, linewidth=0.9, label=run.name)
    upper.plot(runs[0].t, runs[0].desired * 1e6, color=DESIRED, linewidth=0.9, linestyle=(0, (4, 3)), label="desired")
    label_axes(upper, "", "displacement (µm)")
    upper.legend(frameon=False, ncols=5, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    label_axes(lower, "time (s)", "measured - desired (µm)")
    return figure
