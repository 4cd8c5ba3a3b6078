"""Pictures of the SLPI paper's experiments."""

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from slpi_ros.hysteresis.loops import Loop, Separation
from slpi_ros.hysteresis.slpi_published import SeparatedLoops, SingleLoop
from slpi_ros.papers.slpi_study import AT_REST, CLASSICAL, CLOSING, FAMILY, STEP_S, LoopErrors, Study
from slpi_ros.reports.plots import COLOURS, DESIRED, MEASURED, label, panels

FloatArray = NDArray[np.float64]

COLOUR = dict(zip((CLASSICAL, AT_REST, CLOSING, FAMILY), COLOURS, strict=True))
ROMAN = ("0", "I", "II", "III", "IV", "V")
V, UM = "voltage (V)", "displacement (µm)"


def path_and_curve(v: FloatArray, y: FloatArray) -> Figure:
    """Draw a path over time, and displacement over voltage."""
    figure, (left, right) = panels(1, 2, (11, 4.2))
    left.plot(STEP_S * np.arange(v.size), v, ".-", color=DESIRED, markersize=3, linewidth=0.8)
    label(left, "time (s)", V)
    right.plot(v, y * 1e6, ".-", color=MEASURED, markersize=3, linewidth=0.8)
    label(right, V, UM)
    return figure


def separated(separation: Separation) -> Figure:
    """Draw every single loop: a triangle at its vertex, circles where inner loops were taken out."""
    loops = separation.loops
    figure, drawn = panels(1, len(loops), (11, 4.0), sharex=True, sharey=True)
    v, y = separation.voltage, separation.displacement * 1e6
    for panel, loop in zip(drawn, reversed(loops), strict=True):
        panel.plot(v, y, color="#dfe5ea", linewidth=2.5)
        panel.plot(v[loop.path], y[loop.path], ".-", color=DESIRED, markersize=3, linewidth=0.8)
        panel.plot(v[loop.vertex], y[loop.vertex], "^", color=COLOURS[0], markersize=9, label="vertex")
        if loop.sewn.size:
            panel.plot(
                v[loop.sewn], y[loop.sewn], "o", color=COLOURS[2], markersize=9, fillstyle="none", label="sewn here"
            )
        panel.set_title(f"level {ROMAN[loop.level]}", fontsize=11)
        panel.legend(frameon=False, loc="upper left")
        label(panel, V, UM if panel is drawn[0] else "")
    return figure


def inclinations(separation: Separation) -> Figure:
    """Draw all single loops from their vertices, one over the other."""
    figure, (panel,) = panels(1, 1, (7, 4.2))
    for colour, loop in zip(COLOURS, separation.loops, strict=False):
        drive, y = _own(separation, loop)
        panel.plot(drive, y * 1e6, ".-", color=colour, markersize=4, linewidth=0.9, label=f"level {ROMAN[loop.level]}")
    label(panel, "from the vertex (V)", "from the vertex (µm)")
    panel.legend(frameon=False)
    return figure


def single_inverses(study: Study) -> Figure:
    """Draw the inverse of each single loop: voltage over displacement, from the vertex."""
    loops = study.separation.loops
    figure, drawn = panels(1, len(loops), (11, 4.0))
    for number, (panel, loop) in enumerate(zip(drawn, reversed(loops), strict=True)):
        drive, y = _own(study.separation, loop)
        panel.plot(y * 1e6, drive, ".", color=MEASURED, markersize=5, label="measured")
        for name, model in ((AT_REST, study.at_rest), (CLOSING, study.closing)):
            single = model.loops[len(loops) - 1 - number]
            panel.plot(y * 1e6, single.memory().inverse_array(y), color=COLOUR[name], linewidth=1.1, label=name)
        panel.set_title(f"level {ROMAN[loop.level]}", fontsize=11)
        label(panel, "from the vertex (µm)", "from the vertex (V)" if panel is drawn[0] else "")
    drawn[0].legend(frameon=False)
    return figure


def single_models(separation: Separation, models: Mapping[str, SeparatedLoops]) -> Figure:
    """Draw each single loop in its own coordinates, with the PI models of it."""
    loops = separation.loops
    figure, drawn = panels(1, len(loops), (11, 4.0))
    for number, (panel, loop) in enumerate(zip(drawn, reversed(loops), strict=True)):
        drive, y = _own(separation, loop)
        panel.plot(drive, y * 1e6, ".", color=MEASURED, markersize=5, label="measured")
        for name, model in models.items():
            single = model.loops[len(loops) - 1 - number]
            panel.plot(drive, _moved(single, drive) * 1e6, color=COLOUR[name], linewidth=1.1, label=name)
        panel.set_title(f"level {ROMAN[loop.level]}", fontsize=11)
        label(panel, "from the vertex (V)", "from the vertex (µm)" if panel is drawn[0] else "")
    drawn[0].legend(frameon=False)
    return figure


def _own(separation: Separation, loop: Loop) -> tuple[FloatArray, FloatArray]:
    path = loop.path
    drive = loop.direction * (separation.voltage[path] - separation.voltage[loop.vertex])
    return drive, loop.direction * (separation.displacement[path] - separation.displacement[loop.vertex])


def _moved(single: SingleLoop, drive: FloatArray) -> FloatArray:
    return single.memory().forward_array(drive)


def over_data(separation: Separation, errors: Mapping[str, LoopErrors], names: tuple[str, ...]) -> Figure:
    """Draw models over the measured curve, and their errors below."""
    figure, drawn = panels(2, len(names), (11, 6.4), height_ratios=(3, 2), sharex=True, sharey="row")
    v, y = separation.voltage, separation.displacement
    for column, name in enumerate(names):
        upper, lower = drawn[column], drawn[len(names) + column]
        upper.plot(v, y * 1e6, ".", color=MEASURED, markersize=4, label="measured")
        upper.plot(v, (y + errors[name].error) * 1e6, color=COLOUR[name], linewidth=1.0, label="model")
        upper.set_title(name, fontsize=11)
        label(upper, "", UM if not column else "")
        lower.plot(v, errors[name].error * 1e6, ".-", color=COLOUR[name], markersize=3, linewidth=0.7)
        label(lower, V, "error (µm)" if not column else "")
    drawn[0].legend(frameon=False)
    return figure


def inverses(study: Study, names: tuple[str, ...]) -> Figure:
    """Draw the rebuilt inverse: voltage over desired displacement; stars where loops are linked."""
    figure, drawn = panels(1, len(names), (11, 4.0), sharex=True, sharey=True)
    for panel, name in zip(drawn, names, strict=True):
        desired, voltage = study.desired * 1e6, study.voltages[name]
        panel.plot(desired, voltage, color=COLOUR[name], linewidth=1.0)
        links = [loop.vertex for loop in study.separation.loops[1:]]
        panel.plot(desired[links], voltage[links], "*", color=DESIRED, markersize=10)
        panel.set_title(name, fontsize=11)
        label(panel, "desired displacement (µm)", V if panel is drawn[0] else "")
    return figure


def compensation(study: Study, errors: Mapping[str, LoopErrors], desired: FloatArray, names: tuple[str, ...]) -> Figure:
    """Draw achieved over desired displacement, and errors over the samples."""
    figure, drawn = panels(2, len(names), (11, 6.4), height_ratios=(3, 2), sharey="row")
    for column, name in enumerate(names):
        upper, lower = drawn[column], drawn[len(names) + column]
        upper.plot(desired * 1e6, (desired + errors[name].error) * 1e6, color=COLOUR[name], linewidth=1.0)
        upper.set_title(name, fontsize=11)
        label(upper, "desired (µm)", "achieved (µm)" if not column else "")
        for loop in study.separation.loops:
            lower.plot(loop.samples, errors[name].error[loop.samples] * 1e6, ".", markersize=4, label=ROMAN[loop.level])
        label(lower, "sample", "error (µm)" if not column else "")
    handles, levels = drawn[-1].get_legend_handles_labels()
    figure.legend(
        handles, levels, loc="outside lower center", title="level", ncols=len(handles), markerscale=3, frameon=False
    )
    return figure
