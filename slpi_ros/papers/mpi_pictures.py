"""Pictures of the MPI paper's experiments."""

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch
from numpy.typing import NDArray

from slpi_ros.papers.mpi_study import (
    FAMILY,
    MPI,
    ONE_MPI,
    OWN_MPI,
    PI,
    SCALED_MPI,
    SMPI,
    VARIABLE,
    Drive,
    Study,
    VariablePath,
)
from slpi_ros.reports.plots import COLOURS, DESIRED, MEASURED, Run, label, panels

FloatArray = NDArray[np.float64]

COLOUR = {
    **dict(zip((MPI, PI, FAMILY, SMPI), COLOURS, strict=True)),
    **dict(zip((OWN_MPI, ONE_MPI, FAMILY, SCALED_MPI), COLOURS, strict=True)),
}
V, UM, ERROR = "voltage (V)", "displacement (µm)", "error (µm)"


def loops(groups: Mapping[str, Mapping[str, Drive]], columns: int) -> Figure:
    """Draw the settled loops of drives: a panel for each group, a shade for each drive, one legend for all."""
    rows = -(-len(groups) // columns)
    figure, drawn = panels(rows, columns, (11 if columns > 1 else 8, 4.6 if rows == 1 else 3.0 * rows))
    for panel, (title, drives) in zip(drawn, groups.items(), strict=False):
        for shade, (name, drive) in zip(_shades(len(drives)), drives.items(), strict=True):
            v, y = drive.settled
            panel.plot(np.append(v, v[0]), np.append(y, y[0]) * 1e6, color=shade, linewidth=0.9, label=name)
        panel.set_title(title, fontsize=11)
        _outer_labels(panel, V, UM)
    _legend(figure, drawn, len(groups))
    return figure


def peaks(study: Study) -> Figure:
    """Draw the peaks over amplitude and frequency, and over frequency with the lines of Eq. 1."""
    figure = Figure(figsize=(11, 4.8), layout="constrained")
    left: Any = figure.add_subplot(1, 2, 1, projection="3d")
    right = figure.add_subplot(1, 2, 2)
    for shade, (amplitude, line) in zip(_shades(len(study.peaks)), study.peaks.items(), strict=True):
        f = np.array([frequency for a, frequency in study.drives if a == amplitude])
        x = 1e6 * np.array([study.drives[amplitude, frequency].first_peak for frequency in f])
        left.plot(np.full(f.size, amplitude), np.log10(f), x, "o-", color=shade, markersize=3.5, linewidth=0.8)
        fine = np.geomspace(f[0], f[-1], 200)
        right.semilogx(f, x, "o", color=shade, markersize=4)
        right.semilogx(fine, line(fine) * 1e6, color=shade, linewidth=1.0, label=f"{amplitude:g} V")
    left.set_xlabel("amplitude (V)")
    left.set_ylabel("log₁₀ of frequency in Hz")
    left.set_zlabel("peak (µm)")
    left.view_init(elev=22, azim=-125)
    left.set_box_aspect(None, zoom=0.86)
    label(right, "frequency (Hz)", "peak displacement (µm)")
    right.legend(frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def fits(drives: Mapping[float, Drive], simulated: Mapping[float, FloatArray], name: str) -> Figure:
    """Draw settled loops and one model of each."""
    figure, drawn = panels(2, 3, (11, 6.4))
    for panel, (amplitude, y_model) in zip(drawn, simulated.items(), strict=False):
        v, y = drives[amplitude].settled
        panel.plot(v, y * 1e6, ".", color=MEASURED, markersize=3, label="measured")
        panel.plot(v, y_model * 1e6, color=COLOUR[name], linewidth=1.0, label=name)
        panel.set_title(f"{amplitude:g} V", fontsize=11)
        _outer_labels(panel, V, UM)
    _legend(figure, drawn, len(simulated))
    return figure


def fit_errors(drives: Mapping[float, Drive], simulated: Mapping[str, Mapping[float, FloatArray]]) -> Figure:
    """Draw the errors of models over a settled cycle, a panel for each amplitude."""
    amplitudes = list(next(iter(simulated.values())))
    figure, drawn = panels(2, 3, (11, 5.6), sharex=True)
    for panel, amplitude in zip(drawn, amplitudes, strict=False):
        y = drives[amplitude].settled[1]
        for name, models in simulated.items():
            panel.plot(np.arange(y.size) / y.size, (models[amplitude] - y) * 1e6, color=COLOUR[name], linewidth=0.9)
            panel.plot([], [], color=COLOUR[name], label=name)
        panel.set_title(f"{amplitude:g} V", fontsize=11)
        _outer_labels(panel, "part of the cycle", ERROR)
    _legend(figure, drawn, len(amplitudes))
    return figure


def variable(path: VariablePath) -> Figure:
    """Draw what was measured and what models say over the cycles, and the errors below."""
    figure, (upper, lower) = panels(2, 1, (11, 7.0), height_ratios=(1, 1), sharex=True)
    cycle = np.arange(path.y.size) * sum(cycles for _, _, cycles in VARIABLE) / path.y.size
    upper.plot(cycle, path.y * 1e6, color=MEASURED, linewidth=3.0, label="measured")
    for name, y in path.models.items():
        upper.plot(cycle, y * 1e6, color=COLOUR[name], linewidth=0.8, label=name)
        lower.plot(cycle, (y - path.y) * 1e6, color=COLOUR[name], linewidth=0.8)
    for part, (amplitude, frequency, _) in zip(path.parts, VARIABLE, strict=True):
        upper.text(cycle[part.start], upper.get_ylim()[1], f" {amplitude} V, {frequency} Hz", va="top", color=DESIRED)
        for panel in (upper, lower):
            panel.axvline(cycle[part.start], color=MEASURED, linewidth=0.8, linestyle=":")
    label(upper, "", UM)
    lower.axhspan(-1.0, 1.0, color="#eef2f6", zorder=0)
    label(lower, "cycle", ERROR)
    _legend(figure, [upper], 1)
    return figure


def followed(runs: Mapping[str, Run], band: float | None) -> Figure:
    """Draw what was desired and what ways of driving, by model, made of it, and errors below; shade a band (µm)."""
    figure, (upper, lower) = panels(2, 1, (11, 6.4), height_ratios=(1, 1), sharex=True)
    for name, run in runs.items():
        upper.plot(run.t, run.displacement * 1e6, color=COLOUR[name], linewidth=1.0, label=run.name)
        lower.plot(run.t, run.error * 1e6, color=COLOUR[name], linewidth=0.8)
    upper.plot(run.t, run.desired * 1e6, color=DESIRED, linewidth=0.9, linestyle=(0, (4, 3)), label="desired")
    if band is not None:
        lower.axhspan(-band, band, color="#eef2f6", zorder=0)
    label(upper, "", UM)
    label(lower, "time (s)", ERROR)
    _legend(figure, [upper], 1)
    return figure


def scheme() -> Figure:
    """Draw the block diagram of feedforward and feedback together."""
    figure, (panel,) = panels(1, 1, (9, 3.0))
    panel.set(xlim=(0, 12.6), ylim=(0, 4.2))
    panel.set_axis_off()
    for x, y, width, text in (
        (3.6, 2.8, 2.4, "inverse model\n(feedforward)"),
        (3.6, 0.9, 2.4, "PID\n(feedback)"),
        (8.7, 2.8, 1.9, "stage"),
    ):
        box = FancyBboxPatch(
            (x, y - 0.1), width, 1.0, boxstyle="round,pad=0.08", edgecolor=COLOURS[3], facecolor="#f2f5f8"
        )
        panel.add_patch(box)
        panel.text(x + width / 2, y + 0.4, text, ha="center", va="center", color=DESIRED)
    arrow = {"arrowstyle": "-|>", "color": DESIRED, "linewidth": 1.0, "shrinkA": 0, "shrinkB": 0}
    for x, y in ((2.2, 1.3), (7.3, 3.2)):
        panel.plot(x, y, "o", markersize=15, markerfacecolor="white", markeredgecolor=DESIRED)
        panel.text(x, y, "+", ha="center", va="center", color=DESIRED)
    for route in (
        ((0.2, 3.2), (3.5, 3.2)),
        ((2.2, 3.2), (2.2, 1.6)),
        ((2.45, 1.3), (3.5, 1.3)),
        ((6.1, 3.2), (7.05, 3.2)),
        ((6.1, 1.3), (7.3, 1.3), (7.3, 2.9)),
        ((7.55, 3.2), (8.6, 3.2)),
        ((10.7, 3.2), (12.4, 3.2)),
        ((11.4, 3.2), (11.4, 0.3), (2.2, 0.3), (2.2, 1.0)),
    ):
        x, y = np.array(route).T
        panel.plot(x, y, color=DESIRED, linewidth=1.0)
        panel.annotate("", route[-1], route[-2], arrowprops=arrow)
    for x, y, text in ((0.2, 3.35, "desired"), (7.65, 3.35, "voltage"), (10.8, 3.35, "measured"), (1.85, 0.75, "−")):
        panel.text(x, y, text, color=DESIRED)
    return figure


def _shades(count: int) -> Sequence[tuple[float, float, float, float]]:
    return [tuple(shade) for shade in matplotlib.colormaps["viridis"](np.linspace(0.0, 0.88, count))]


def _outer_labels(panel: Axes, x: str, y: str) -> None:
    """Name only the axes at the figure's left and lower edge."""
    place = panel.get_subplotspec()
    assert place is not None
    label(panel, x if place.is_last_row() else "", y if place.is_first_col() else "")


def _legend(figure: Figure, drawn: Sequence[Axes], used: int) -> None:
    """Put one legend above all panels, and hide those that are not used."""
    handles, names = drawn[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside upper center", ncols=7, frameon=False)
    for panel in drawn[used:]:
        panel.set_axis_off()
