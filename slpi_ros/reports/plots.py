"""Pictures for pages without interactive charts: loops, tracking and errors; axes in µm and nm."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from slpi_ros.reports.chart import COLOURS, DESIRED, MEASURED

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Run:
    """Desired and achieved displacement along a path.

    Parameters
    ----------
    name : str
        Name of the model or control scheme.
    t : ndarray, shape (N,), seconds
    desired : ndarray, shape (N,), metres
    displacement : ndarray, shape (N,), metres
        Measured or true displacement.
    """

    name: str
    t: FloatArray
    desired: FloatArray
    displacement: FloatArray

    @property
    def error(self) -> FloatArray:
        """Achieved - desired displacement, shape (N,), metres."""
        return self.displacement - self.desired


def loops(v: FloatArray, y: FloatArray, simulated: FloatArray) -> Figure:
    """Draw measured and simulated displacement over voltage, and measured - model in a second panel.

    Parameters
    ----------
    v : ndarray, shape (N,), volts
    y, simulated : ndarray, shape (N,), metres
    """
    figure, (left, right) = panels(1, 2, (11, 4.6))
    left.plot(v, y * 1e6, ".", color=MEASURED, markersize=2.5, label="measured")
    left.plot(v, simulated * 1e6, color=COLOURS[2], linewidth=0.8, label="model")
    label(left, "voltage (V)", "displacement (µm)")
    left.legend(frameon=False)
    right.plot(v, (y - simulated) * 1e9, ".", color=COLOURS[2], markersize=2)
    label(right, "voltage (V)", "measured - model (nm)")
    return figure


def tracking(runs: Mapping[str, Run]) -> Figure:
    """Draw desired and achieved displacement of each run, and the errors below."""
    figure, (upper, lower) = panels(2, 1, (11, 6.4), height_ratios=(3, 2), sharex=True)
    for colour, run in zip(COLOURS, runs.values(), strict=False):
        upper.plot(run.t, run.displacement * 1e6, color=colour, linewidth=1.1, label=run.name)
        lower.plot(run.t, run.error * 1e6, color=colour, linewidth=0.9, label=run.name)
    first = next(iter(runs.values()))
    upper.plot(first.t, first.desired * 1e6, color=DESIRED, linewidth=0.9, linestyle=(0, (4, 3)), label="desired")
    label(upper, "", "displacement (µm)")
    upper.legend(frameon=False, ncols=4, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    label(lower, "time (s)", "error (µm)")
    return figure


def linearity(runs: Mapping[str, Run]) -> Figure:
    """Draw achieved over desired displacement, one panel per run."""
    figure, drawn = panels(1, len(runs), (11, 3.9), sharex=True, sharey=True)
    for panel, colour, run in zip(drawn, COLOURS, runs.values(), strict=False):
        panel.plot(run.desired * 1e6, run.displacement * 1e6, color=colour, linewidth=0.9)
        panel.set_title(run.name, fontsize=11)
        label(panel, "desired (µm)", "achieved (µm)" if panel is drawn[0] else "")
    return figure


def panels(rows: int, columns: int, size: tuple[float, float], **options: Any) -> tuple[Figure, Any]:
    """Return a figure of a size (inches) and its panels, row by row; `options` are those of ``Figure.subplots``."""
    figure = Figure(figsize=size, layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False, **options).ravel()


def label(panel: Axes, x: str, y: str) -> None:
    """Label the axes of a panel and add a grid."""
    panel.set_xlabel(x)
    panel.set_ylabel(y)
    panel.grid(color="#e4e9ee", linewidth=0.7)
    panel.spines[["top", "right"]].set_visible(False)
