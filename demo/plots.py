"""Pictures of the demo: loops, tracking and errors; axes in µm and nm."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from slpi_ros.papers.exhibit import label_axes, panels
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
    label_axes(left, "voltage (V)", "displacement (µm)")
    left.legend(frameon=False)
    right.plot(v, (y - simulated) * 1e9, ".", color=COLOURS[2], markersize=2)
    label_axes(right, "voltage (V)", "measured - model (nm)")
    return figure


def tracking(runs: Mapping[str, Run]) -> Figure:
    """Draw desired and achieved displacement of each run, and the errors below."""
    figure, (upper, lower) = panels(2, 1, (11, 6.4), height_ratios=(3, 2), sharex=True)
    for colour, run in zip(COLOURS, runs.values(), strict=False):
        upper.plot(run.t, run.displacement * 1e6, color=colour, linewidth=1.1, label=run.name)
        lower.plot(run.t, run.error * 1e6, color=colour, linewidth=0.9, label=run.name)
    first = next(iter(runs.values()))
    upper.plot(first.t, first.desired * 1e6, color=DESIRED, linewidth=0.9, linestyle=(0, (4, 3)), label="desired")
    label_axes(upper, "", "displacement (µm)")
    upper.legend(frameon=False, ncols=4, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    label_axes(lower, "time (s)", "error (µm)")
    return figure


def linearity(runs: Mapping[str, Run]) -> Figure:
    """Draw achieved over desired displacement, one panel per run."""
    figure, drawn = panels(1, len(runs), (11, 3.9), sharex=True, sharey=True)
    for panel, colour, run in zip(drawn, COLOURS, runs.values(), strict=False):
        panel.plot(run.desired * 1e6, run.displacement * 1e6, color=colour, linewidth=0.9)
        panel.set_title(run.name, fontsize=11)
        label_axes(panel, "desired (µm)", "achieved (µm)" if panel is drawn[0] else "")
    return figure
