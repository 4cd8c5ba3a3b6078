"""Hysteresis curves and models of the MPI paper (Fig. 2 to 10, Tables 1 to 5), reproduced on a simulated axis."""

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from slpi_ros.arrays import FloatArray
from slpi_ros.identification.signal_statistics import ErrorMetrics
from slpi_ros.papers.exhibit import Exhibit, Picture, Table, label_axes, outer_legend, panels, um
from slpi_ros.papers.mpi_study import (
    FAMILY,
    KINDS,
    MPI,
    ONE_MPI,
    OWN_MPI,
    PI,
    SCALED_MPI,
    SMPI,
    TABLE_1,
    TABLE_2,
    TABLE_3,
    TABLE_4,
    TABLE_5,
    VARIABLE,
    CycleFit,
    Drive,
    Study,
    VariablePath,
    run_study,
)
from slpi_ros.reports.chart import COLOURS, DESIRED, MEASURED
from slpi_ros.simulation.stage import p11_stage

COLOUR = {
    **dict(zip((MPI, PI, FAMILY, SMPI), COLOURS, strict=True)),
    **dict(zip((OWN_MPI, ONE_MPI, FAMILY, SCALED_MPI), COLOURS, strict=True)),
}
V, UM, ERROR = "voltage (V)", "displacement (µm)", "error (µm)"
ERRORS = "maximum / mean / root mean square (µm)"


def loops(groups: Mapping[str, Mapping[str, Drive]], columns: int) -> Figure:
    """Draw the settled loops of drives: a panel for each group, a colour for each drive, one common legend."""
    rows = -(-len(groups) // columns)
    figure, drawn = panels(rows, columns, (11 if columns > 1 else 8, 4.6 if rows == 1 else 3.0 * rows))
    for panel, (title, drives) in zip(drawn, groups.items(), strict=False):
        for shade, (name, drive) in zip(_shades(len(drives)), drives.items(), strict=True):
            v, y = drive.settled
            panel.plot(np.append(v, v[0]), np.append(y, y[0]) * 1e6, color=shade, linewidth=0.9, label=name)
        panel.set_title(title, fontsize=11)
        _outer_labels(panel, V, UM)
    legend(figure, drawn, len(groups))
    return figure


def peaks(study: Study) -> Figure:
    """Draw the peak displacements over amplitude and frequency, and over frequency with the fits of Eq. 1."""
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
    label_axes(right, "frequency (Hz)", "peak displacement (µm)")
    right.legend(frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def fits(drives: Mapping[float, Drive], simulated: Mapping[float, FloatArray], name: str) -> Figure:
    """Draw the settled loop of each amplitude (V), and its simulation by the model `name`."""
    figure, drawn = panels(2, 3, (11, 6.4))
    for panel, (amplitude, y_model) in zip(drawn, simulated.items(), strict=False):
        v, y = drives[amplitude].settled
        panel.plot(v, y * 1e6, ".", color=MEASURED, markersize=3, label="measured")
        panel.plot(v, y_model * 1e6, color=COLOUR[name], linewidth=1.0, label=name)
        panel.set_title(f"{amplitude:g} V", fontsize=11)
        _outer_labels(panel, V, UM)
    legend(figure, drawn, len(simulated))
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
    legend(figure, drawn, len(amplitudes))
    return figure


def variable(path: VariablePath) -> Figure:
    """Draw measured and simulated displacement of the path of Fig. 8 over the cycles, and the errors below."""
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
    label_axes(upper, "", UM)
    lower.axhspan(-1.0, 1.0, color="#eef2f6", zorder=0)
    label_axes(lower, "cycle", ERROR)
    legend(figure, [upper], 1)
    return figure


def _shades(count: int) -> Sequence[tuple[float, float, float, float]]:
    return [tuple(shade) for shade in matplotlib.colormaps["viridis"](np.linspace(0.0, 0.88, count))]


def _outer_labels(panel: Axes, x: str, y: str) -> None:
    """Label only the axes at the left and the lower edge of the figure."""
    place = panel.get_subplotspec()
    assert place is not None
    label_axes(panel, x if place.is_last_row() else "", y if place.is_first_col() else "")


def legend(figure: Figure, drawn: Sequence[Axes], used: int) -> None:
    """Add one legend above all panels, and hide the panels after the first `used` ones."""
    handles, names = drawn[0].get_legend_handles_labels()
    outer_legend(figure, handles, names, inches=0.35, ncols=7)
    for panel in drawn[used:]:
        panel.set_axis_off()


def exhibits(seed: int = 0) -> list[Exhibit]:
    """Run the experiments and return their exhibits; `seed` is the seed of the sensor noise."""
    return present(run_study(p11_stage(seed).axes["x"]))


def present(study: Study) -> list[Exhibit]:
    """Return the exhibits of a study with the paper's amplitudes and frequencies."""
    parts = _amplitudes, _frequencies, _grid, _peaks, _fits, _variable, _scaled
    return [part(study) for part in parts]


def errors(metrics: ErrorMetrics) -> str:
    """Return maximum, mean and root mean square error in micrometres, as text."""
    return " / ".join(um(value) for value in (metrics.maximum, metrics.mean, metrics.root_mean_square))


def _printed(table: Mapping[float, tuple[float, ...]]) -> dict[float, str]:
    return {amplitude: " / ".join(f"{value:.4f}" for value in row) for amplitude, row in table.items()}


def _rounded(values: Mapping[float, float]) -> dict[float, str]:
    return {amplitude: f"{value:.4f}" for amplitude, value in values.items()}


def _table(key: str, unit: str, columns: Mapping[str, Mapping[float, str]]) -> Table:
    """Return a table of named columns; the keys of the first column determine the rows."""
    rows = [(f"{k:g} {unit}", *(column[k] for column in columns.values())) for k in next(iter(columns.values()))]
    return Table((key, *columns), tuple(rows))


def _between(values: Collection[float] | FloatArray, digits: int = 1) -> str:
    return f"{min(values):.{digits}f} to {max(values):.{digits}f}"


def _target(what: str, values: Collection[float], least: float) -> str:
    verdict = "not below" if min(values) >= least else "BELOW"
    return f"{what} {_between(values, 4)}, {verdict} the paper's lowest, {least:.4f}"


def _amplitudes(study: Study) -> Exhibit:
    lowest = min(study.ringing)
    drives = {amplitude: drive for (amplitude, f), drive in study.drives.items() if f == lowest}
    width, rise, fall = ({a: 100.0 * drive.bows[k] for a, drive in drives.items()} for k in range(3))
    asymmetric = all(fall[a] > rise[a] for a in drives)
    strokes = {a: um(drive.settled_peak, 2) for a, drive in drives.items()}
    shares = {"mean width (%)": width, "rise off its chord (%)": rise, "fall off its chord (%)": fall}
    columns = {name: {a: f"{share:.1f}" for a, share in of.items()} for name, of in shares.items()}
    return Exhibit(
        title="Fig. 2: hysteresis at 0.1 Hz, 20 to 120 V",
        paper="Obvious hysteresis; at every amplitude rise and fall are not symmetric. No numbers are printed.",
        ours=f"The fall leaves its chord by {_between(fall.values())} % of the stroke, the rise by "
        f"{_between(rise.values())} %; asymmetric at {'every amplitude' if asymmetric else 'some amplitudes only'}.",
        remark="Shown is the third cycle from rest. The stage was given a nearly straight rise and a bulging fall, "
        "as the paper describes them.",
        tables=(_table("amplitude", "V", {"stroke (µm)": strokes} | columns),),
        pictures=(Picture(loops({"": {f"{a:g} V": drive for a, drive in drives.items()}}, 1), "Settled loops."),),
    )


def _frequencies(study: Study) -> Exhibit:
    ends = min(study.peaks), max(study.peaks)
    drives = {a: {f: study.drives[a, f] for f in study.ringing} for a in ends}
    width = {a: np.array([100.0 * drive.bows[0] for drive in drives[a].values()]) for a in ends}
    everywhere = all(np.all(np.diff(widths) > 0.0) for widths in width.values())
    told = {a: {f: f"{w:.2f}" for f, w in zip(drives[a], width[a], strict=True)} for a in ends}
    groups = {f"{a} V": {f"{f:g} Hz": drive for f, drive in drives[a].items()} for a in ends}
    return Exhibit(
        title="Fig. 3: hysteresis at 20 V and at 120 V, 0.1 to 20 Hz",
        paper="The rise is highly linear at every frequency; the greater the frequency, the more obvious the "
        "hysteresis. No numbers are printed.",
        ours=f"At {ends[1]} V the mean width of the loop goes from {width[ends[1]][0]:.1f} % of the stroke to "
        f"{width[ends[1]][-1]:.1f} %; it {'grows' if everywhere else 'does not always grow'} with the frequency.",
        remark="The width grows by the lag of the amplifier, which was chosen: the paper gives none.",
        tables=(_table("frequency", "Hz", {f"mean width at {a} V (%)": widths for a, widths in told.items()}),),
        pictures=(Picture(loops(groups, 2), "Settled loops."),),
    )


def _grid(study: Study) -> Exhibit:
    groups = {f"{f:g} Hz": {f"{a:g} V": study.drives[a, f] for a in study.peaks} for f in study.ringing}
    stroke = max(drive.settled_peak for drive in study.drives.values())
    fastest = list(study.ringing)[-3:]
    return Exhibit(
        title="Fig. 4: hysteresis over amplitude and frequency",
        paper="Loops grow with the amplitude; the frequency hardly shows, except that the curves oscillate obviously "
        "when it is high (f and g, 10 and 20 Hz).",
        ours="The flexure's mode moves the stage by up to "
        + ", ".join(f"{um(study.ringing[f], 2)} µm at {f:g} Hz" for f in fastest)
        + f", of {um(stroke, 1)} µm.",
        remark="The stage's mode was chosen so that triangles oscillate at these frequencies; the numbers are the "
        "largest difference to the same stage without it, at the highest amplitude.",
        tables=(_table("frequency", "Hz", {"oscillation (µm)": {f: um(x) for f, x in study.ringing.items()}}),),
        pictures=(Picture(loops(groups, 4), "Settled loops."),),
    )


def _peaks(study: Study) -> Exhibit:
    lines = study.peaks
    apart_a = max(abs(line.a * 1e6 / TABLE_1[amplitude][0] - 1.0) for amplitude, line in lines.items())
    apart_b = max(abs(line.b - TABLE_1[amplitude][1]) for amplitude, line in lines.items())
    worst = max(abs(drive.first_peak / float(lines[a](f)) - 1.0) for (a, f), drive in study.drives.items())
    steps = np.diff([line.a * 1e6 for line in lines.values()])
    columns = {
        "a, paper (µm)": {amplitude: f"{TABLE_1[amplitude][0]:.3f}" for amplitude in lines},
        "a, ours (µm)": {amplitude: um(line.a) for amplitude, line in lines.items()},
        "b, paper": {amplitude: f"{TABLE_1[amplitude][1]:.3f}" for amplitude in lines},
        "b, ours": {amplitude: f"{line.b:.4f}" for amplitude, line in lines.items()},
    }
    return Exhibit(
        title="Fig. 5 and 6, Eq. 1 and Table 1: peak displacement over amplitude and frequency",
        paper="X_p = a f^b; a grows in equal steps with the amplitude, b is basically the same.",
        ours=f"a within {100.0 * apart_a:.1f} % and b within {apart_b:.4f} of Table 1; Eq. 1 meets every peak within "
        f"{100.0 * worst:.2f} %; a grows in steps of {_between(steps)} µm.",
        remark="This shows what the stage is, not how good a model is: its stroke, the growth with the amplitude and "
        "its creep were set by Table 1. Linear creep gives one b for all amplitudes; the paper's goes from "
        f"{min(b for _, b in TABLE_1.values())} to {max(b for _, b in TABLE_1.values())}. Peaks are the largest "
        "readings of the first cycle from rest.",
        tables=(_table("amplitude", "V", columns),),
        pictures=(Picture(peaks(study), "Peaks; lines: Eq. 1."),),
    )


def _fits(study: Study) -> Exhibit:
    measured = study.fits
    mean = {name: np.array([fit.fitted.mean for fit in measured[name].values()]) for name in KINDS}
    printed = np.array([TABLE_2[amplitude][1] * 1e-6 for amplitude in measured[MPI]])
    curves = {name: {a: fit.simulated for a, fit in measured[name].items()} for name in KINDS}
    lower = [a for a, fit in measured[MPI].items() if fit.fitted.r_squared < TABLE_3[a]]
    symmetric = [a for a, x, y in zip(measured[PI], mean[PI], mean[MPI], strict=True) if x < y]
    following = [fit.following.r_squared for fit in measured[MPI].values()]

    def told(what: Callable[[CycleFit], str]) -> dict[str, dict[float, str]]:
        return {name: {a: what(fit) for a, fit in measured[name].items()} for name in KINDS}

    return Exhibit(
        title="Fig. 7, Tables 2 and 3: the MPI model at 20 Hz",
        paper="R² of 0.9960 to 0.9997, on the very curves that the weights were fitted to. The “mean square error” of "
        "the tables is its root.",
        ours=_target("MPI: R²", [fit.fitted.r_squared for fit in measured[MPI].values()], min(TABLE_3.values()))
        + f"; on the next cycle, held out, {_between(following, 4)}.",
        remark=f"R² is below the paper's of the same amplitude at {_where(lower)}: ringing alone moves the stage by up "
        f"to {um(study.ringing[max(study.ringing)], 1)} µm, which the operators of Eq. 2 cannot follow; MPI's mean "
        f"error is {_between(mean[MPI] / printed)} times the paper's. Classical PI's is smaller than MPI's at "
        f"{_where(symmetric)}; rise and fall are the more alike, the smaller the amplitude (Fig. 2). The loop family "
        f"leaves {_between(mean[FAMILY] / mean[MPI], 2)} of MPI's mean error: it has many more parameters, and takes "
        "ringing that comes again in each cycle for the shape of the loop.",
        tables=(
            _table(ERRORS, "V", {"paper, MPI": _printed(TABLE_2)} | told(lambda fit: errors(fit.fitted))),
            _table("R²", "V", {"paper, MPI": _rounded(TABLE_3)} | told(lambda fit: f"{fit.fitted.r_squared:.4f}")),
            _table(f"next cycle: {ERRORS}", "V", told(lambda fit: errors(fit.following))),
        ),
        pictures=(
            Picture(fits(study.fastest, curves[MPI], MPI), "Settled cycles and the MPI model of each."),
            Picture(fit_errors(study.fastest, curves), "Model - measured; the first half of the cycle is the rise."),
        ),
    )


def _where(amplitudes: Sequence[float]) -> str:
    return ", ".join(f"{amplitude:g} V" for amplitude in amplitudes) or "no amplitude"


def _variable(study: Study) -> Exhibit:
    path = study.variable
    apart = {name: np.abs(y - path.y) for name, y in path.models.items()}
    near = {name: f"{100.0 * np.mean(x <= 1e-6):.0f}" for name, x in apart.items()}
    rows = [
        (name, *(f"{um(x[part].max(), 2)} / {um(x[part].mean(), 2)}" for part in path.parts), near[name])
        for name, x in apart.items()
    ]
    (amplitude, fast, _), (_, slow, _) = VARIABLE[0], VARIABLE[-1]
    a, b = TABLE_1[amplitude]
    return Exhibit(
        title="Fig. 8 and 9: variable amplitude and frequency",
        paper="Triangles of 120, 80 and 40 V at 20 Hz and of 120 V at 2 Hz: the error is basically within ±1 µm, and "
        "alike at 20 and 2 Hz.",
        ours=f"Within ±1 µm: {near[OWN_MPI]} % of the samples with an MPI model of each amplitude, {near[SCALED_MPI]} "
        f"% if Eq. 1 scales it to the frequency, {near[ONE_MPI]} % with that of 120 V alone, {near[FAMILY]} % with "
        "one loop family.",
        remark="The paper does not say which V_p its model has in each part. By its own Table 1 the peak at 2 Hz is "
        f"{a * (slow**b - fast**b):.1f} µm above that at 20 Hz, which no quasi-static model identified at 20 Hz knows, "
        "the loop family neither. At 20 Hz there is ringing besides.",
        tables=(
            Table(
                ("maximum / mean error (µm)", *(f"{a} V, {f} Hz" for a, f, _ in VARIABLE), "within ±1 µm (%)"),
                tuple(rows),
            ),
        ),
        pictures=(Picture(variable(path), "Displacement, and model - measured; shaded: ±1 µm."),),
    )


def _scaled(study: Study) -> Exhibit:
    scaled = {amplitude: study.scaled[amplitude] for amplitude in TABLE_4}
    curves = {a: fit.simulated for a, fit in scaled.items()}
    ratio = [fit.errors.mean / study.fits[MPI][a].fitted.mean for a, fit in scaled.items()]
    return Exhibit(
        title="Fig. 10, Tables 4 and 5: the SMPI model, scaled from 120 V",
        paper="R² of 0.9939 to 0.9985; errors are a little larger than those of an MPI model of each amplitude.",
        ours=_target("SMPI: R²", [fit.errors.r_squared for fit in scaled.values()], min(TABLE_5.values())) + ".",
        remark=f"SMPI's mean error is {_between(ratio, 2)} times that of the MPI model of each amplitude, in the paper "
        f"{_between([TABLE_4[a][1] / TABLE_2[a][1] for a in scaled], 2)} times: the simulated stage's loops are alike "
        "at all amplitudes by design, as the paper says of its own (section 5). Peaks are measured, and the "
        "displacement at the start is fitted.",
        tables=(
            _table(
                ERRORS,
                "V",
                {
                    "paper, SMPI": _printed(TABLE_4),
                    SMPI: {a: errors(fit.errors) for a, fit in scaled.items()},
                    "R²: paper": _rounded(TABLE_5),
                    f"R²: {SMPI}": {a: f"{fit.errors.r_squared:.4f}" for a, fit in scaled.items()},
                    f"R²: {FAMILY} of each": {a: f"{study.fits[FAMILY][a].fitted.r_squared:.4f}" for a in scaled},
                },
            ),
        ),
        pictures=(Picture(fits(study.fastest, curves, SMPI), "Settled cycles and the SMPI model."),),
    )
