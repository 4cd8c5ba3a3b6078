"""Figures and tables of the SLPI paper, reproduced on a simulated stage."""

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

from slpi_ros.arrays import FloatArray
from slpi_ros.hysteresis.slpi_published import Loop, SeparatedLoops, Separation
from slpi_ros.identification.linear_kinds import PLAY_OPERATORS
from slpi_ros.papers.exhibit import Exhibit, Picture, Table, label_axes, outer_legend, panels, um
from slpi_ros.papers.slpi_study import (
    AT_REST,
    CLASSICAL,
    CLOSING,
    DOUBLE_INNER_LOOP,
    DRAWN,
    FAMILY,
    HIGHEST_MEAN,
    MODELS,
    OUTER_MAXIMUM,
    OVERALL_MEAN,
    OVERLAPPED,
    SPREAD,
    STEP_S,
    TABLES,
    THRESHOLDS,
    LoopErrors,
    Study,
    UnseenPaths,
    gain,
    study,
    unseen_paths,
)
from slpi_ros.reports.chart import COLOURS, DESIRED, MEASURED

COLOUR = dict(zip((CLASSICAL, AT_REST, CLOSING, FAMILY), COLOURS, strict=True))
ROMAN = ("0", "I", "II", "III", "IV", "V")
V, UM = "voltage (V)", "displacement (µm)"
# Weights in the paper, by level, and the four quantities by which it compares SLPI with classical PI.
PRINTED = {2: TABLES[2], 1: TABLES[3], 0: TABLES[4]}
FIGURES = ("outer loop's maximum", "highest loop's mean", "spread between loops", "overall mean")
PAPER = (OUTER_MAXIMUM, HIGHEST_MEAN, SPREAD, OVERALL_MEAN)


def turns_of(study: Study) -> str:
    """Return the reversals of the path as text."""
    return " → ".join(f"{turn:.0f}" for turn in study.turns) + " V"


def errors_table(errors: Mapping[str, LoopErrors], separation: Separation, what: str = "") -> Table:
    """Return a table of the errors of all models by loop; the model with the lowest mean error is highlighted."""
    v = separation.voltage
    levels = [f"{ROMAN[loop.level]} from {v[loop.vertex]:.0f} V" for loop in separation.loops]
    rows = [
        (name, um(e.overall), *(um(mean) for mean in e.means), um(e.maxima[0]), um(e.spread))
        for name, e in errors.items()
    ]
    name = f"error {what} (µm)" if what else "error (µm)"
    header = (name, "mean", *(f"mean, level {level}" for level in levels), "maximum, level 0", "spread")
    return Table(header, tuple(rows), best=int(np.argmin([e.overall for e in errors.values()])))


def path_and_curve(v: FloatArray, y: FloatArray) -> Figure:
    """Draw the voltage over time, and the displacement over voltage."""
    figure, (left, right) = panels(1, 2, (11, 4.2))
    left.plot(STEP_S * np.arange(v.size), v, ".-", color=DESIRED, markersize=3, linewidth=0.8)
    label_axes(left, "time (s)", V)
    right.plot(v, y * 1e6, ".-", color=MEASURED, markersize=3, linewidth=0.8)
    label_axes(right, V, UM)
    return figure


def separated(separation: Separation) -> Figure:
    """Draw each separated loop, with a triangle at its vertex and circles where inner loops were removed."""
    loops = separation.loops
    figure, drawn = panels(1, len(loops), (11, 4.0), sharex=True, sharey=True)
    v, y = separation.voltage, separation.displacement * 1e6
    for panel, loop in zip(drawn, reversed(loops), strict=True):
        panel.plot(v, y, color="#dfe5ea", linewidth=2.5)
        panel.plot(v[loop.path], y[loop.path], ".-", color=DESIRED, markersize=3, linewidth=0.8)
        panel.plot(v[loop.vertex], y[loop.vertex], "^", color=COLOURS[0], markersize=9, label="vertex")
        if loop.joined.size:
            ring = {"color": COLOURS[2], "markersize": 9, "fillstyle": "none"}
            panel.plot(v[loop.joined], y[loop.joined], "o", label="joined here", **ring)
        panel.set_title(f"level {ROMAN[loop.level]}", fontsize=11)
        panel.legend(frameon=False, loc="upper left")
        label_axes(panel, V, UM if panel is drawn[0] else "")
    return figure


def inclinations(separation: Separation) -> Figure:
    """Draw all separated loops in one panel, relative to their vertices."""
    figure, (panel,) = panels(1, 1, (7, 4.2))
    for colour, loop in zip(COLOURS, separation.loops, strict=False):
        drive, y = _own(separation, loop)
        panel.plot(drive, y * 1e6, ".-", color=colour, markersize=4, linewidth=0.9, label=f"level {ROMAN[loop.level]}")
    label_axes(panel, "from the vertex (V)", "from the vertex (µm)")
    panel.legend(frameon=False)
    return figure


def singles(separation: Separation, models: Mapping[str, SeparatedLoops], *, inverse: bool = False) -> Figure:
    """Draw each separated loop, relative to its vertex, and its PI models or, if `inverse`, their inverses."""
    loops = separation.loops
    figure, drawn = panels(1, len(loops), (11, 4.0))
    order = slice(None, None, -1 if inverse else 1)
    for number, (panel, loop) in enumerate(zip(drawn, reversed(loops), strict=True)):
        drive, y = _own(separation, loop)
        panel.plot(*(drive, y * 1e6)[order], ".", color=MEASURED, markersize=5, label="measured")
        for name, model in models.items():
            memory = model.loops[len(loops) - 1 - number].memory()
            curve = (memory.inverse_array(y), y * 1e6) if inverse else (drive, memory.forward_array(drive) * 1e6)
            panel.plot(*curve[order], color=COLOUR[name], linewidth=1.1, label=name)
        panel.set_title(f"level {ROMAN[loop.level]}", fontsize=11)
        x, up = ("µm", "V") if inverse else ("V", "µm")
        label_axes(panel, f"from the vertex ({x})", f"from the vertex ({up})" if panel is drawn[0] else "")
    drawn[0].legend(frameon=False)
    return figure


def _own(separation: Separation, loop: Loop) -> tuple[FloatArray, FloatArray]:
    path = loop.path
    drive = loop.direction * (separation.voltage[path] - separation.voltage[loop.vertex])
    return drive, loop.direction * (separation.displacement[path] - separation.displacement[loop.vertex])


def over_data(separation: Separation, errors: Mapping[str, LoopErrors], names: tuple[str, ...]) -> Figure:
    """Draw the models on top of the measured curve, and their errors below."""
    figure, drawn = panels(2, len(names), (11, 6.4), height_ratios=(3, 2), sharex=True, sharey="row")
    v, y = separation.voltage, separation.displacement
    for column, name in enumerate(names):
        upper, lower = drawn[column], drawn[len(names) + column]
        upper.plot(v, y * 1e6, ".", color=MEASURED, markersize=4, label="measured")
        upper.plot(v, (y + errors[name].error) * 1e6, color=COLOUR[name], linewidth=1.0, label="model")
        upper.set_title(name, fontsize=11)
        label_axes(upper, "", UM if not column else "")
        lower.plot(v, errors[name].error * 1e6, ".-", color=COLOUR[name], markersize=3, linewidth=0.7)
        label_axes(lower, V, "error (µm)" if not column else "")
    drawn[0].legend(frameon=False)
    return figure


def inverses(study: Study, names: tuple[str, ...]) -> Figure:
    """Draw the inverse models: voltage over desired displacement, with stars where loops are linked."""
    figure, drawn = panels(1, len(names), (11, 4.0), sharex=True, sharey=True)
    for panel, name in zip(drawn, names, strict=True):
        desired, voltage = study.desired * 1e6, study.voltages[name]
        panel.plot(desired, voltage, color=COLOUR[name], linewidth=1.0)
        links = [loop.vertex for loop in study.separation.loops[1:]]
        panel.plot(desired[links], voltage[links], "*", color=DESIRED, markersize=10)
        panel.set_title(name, fontsize=11)
        label_axes(panel, "desired displacement (µm)", V if panel is drawn[0] else "")
    return figure


def draw_compensation(study: Study, names: tuple[str, ...]) -> Figure:
    """Draw achieved over desired displacement, and errors over the samples."""
    errors, desired = study.compensated, study.desired
    figure, drawn = panels(2, len(names), (11, 6.4), height_ratios=(3, 2), sharey="row")
    for column, name in enumerate(names):
        upper, lower = drawn[column], drawn[len(names) + column]
        upper.plot(desired * 1e6, (desired + errors[name].error) * 1e6, color=COLOUR[name], linewidth=1.0)
        upper.set_title(name, fontsize=11)
        label_axes(upper, "desired (µm)", "achieved (µm)" if not column else "")
        for loop in study.separation.loops:
            lower.plot(loop.samples, errors[name].error[loop.samples] * 1e6, ".", markersize=4, label=ROMAN[loop.level])
        label_axes(lower, "sample", "error (µm)" if not column else "")
    handles, levels = drawn[-1].get_legend_handles_labels()
    outer_legend(figure, handles, levels, inches=0.55, below=True, title="level", ncols=len(handles), markerscale=3)
    return figure


def exhibits(random: Study) -> list[Exhibit]:
    """Return the exhibits of the SLPI paper, from the given study of its random path and from further experiments."""
    parts = _nonlinear_curve, _inclinations, _separation, _single_models, _closure, _classical, _inverse
    return [
        *(part(random) for part in (*parts, compensation, straight_line)),
        other("Fig. 16 and 17: double inner loop, one vertex on the back branch", study(DOUBLE_INNER_LOOP)),
        other("Fig. 18 and 19: overlapped inner and outer loop", study(OVERLAPPED)),
        unseen(unseen_paths(random)),
    ]


def _nonlinear_curve(study: Study) -> Exhibit:
    y = study.separation.displacement
    remanence = y[-1] - y[0]
    stroke = float(np.ptp(y))
    return Exhibit(
        title="Fig. 4 and 5: random complex voltage, and the displacement",
        paper="A random voltage between 0 and 100 V with loops up to level II, a sample every 4 V and 0.8 s; the mean "
        "of two measurements. No numbers are printed.",
        ours=f"{turns_of(study)}; stroke {um(stroke)} µm, {um(remanence)} µm left at the end.",
        remark="The path is ours: the paper's is known as a picture only.",
        pictures=(Picture(path_and_curve(study.separation.voltage, y), "Voltage over time; the curve."),),
    )


def _inclinations(study: Study) -> Exhibit:
    separation = study.separation
    rows, slopes = [], []
    for loop in separation.loops:
        v, y = separation.voltage[loop.path], separation.displacement[loop.path]
        low, high = int(np.argmin(v)), int(np.argmax(v))
        slopes.append(float((y[high] - y[low]) / (v[high] - v[low])))
        rows.append((ROMAN[loop.level], f"{v[low]:.0f} … {v[high]:.0f}", f"{slopes[-1] * 1e6:.4f}"))
    return Exhibit(
        title="Fig. 7: inclination of the loops",
        paper="Three loops of different inclination at the same voltages; drawn, not measured.",
        ours=f"Slopes between the ends of the loops differ by {gain(max(slopes), min(slopes)):.1f} %.",
        pictures=(Picture(inclinations(separation), "The loops, each from its vertex."),),
        remark="A translation-invariant model such as classical PI gives loops of one span one inclination.",
        tables=(Table(("level", "from … to (V)", "slope (µm/V)"), tuple(rows)),),
    )


def _separation(study: Study) -> Exhibit:
    separation = study.separation
    rows = []
    for loop in separation.loops:
        v = separation.voltage
        far = v[loop.samples][int(np.argmax(np.abs(v[loop.samples] - v[loop.vertex])))]
        joined = ", ".join(f"{vertex:.0f}" for vertex in v[loop.joined]) or "-"
        rows.append((ROMAN[loop.level], f"{v[loop.vertex]:.0f}", f"{far:.0f}", joined, str(loop.samples.size)))
    return Exhibit(
        title="Fig. 9: loops separated",
        paper="Single loops of levels II, I and 0; a triangle at each vertex, a circle where a loop was taken out.",
        ours=f"{len(separation.loops)} single loops; the table of all samples is in separation.csv.",
        remark="None: level and vertex are as the paper's rules give them.",
        tables=(Table(("level", "vertex (V)", "turns at (V)", "joined at (V)", "samples"), tuple(rows)),),
        pictures=(Picture(separated(separation), "Single loops, the highest level first."),),
    )


def _weights(models: Mapping[str, SeparatedLoops], level: int, printed: tuple[float, ...]) -> Table:
    found = [next(loop.model for loop in model.loops if loop.level == level).weights * 1e6 for model in models.values()]
    rows = [
        (f"{r:.0f}", f"{w:.5f}", *(f"{weights[i]:.5f}" for weights in found))
        for i, (r, w) in enumerate(zip(THRESHOLDS, printed, strict=True))
    ]
    return Table((f"level {ROMAN[level]}: r (V)", "ω, paper", *(f"ω, {name} (µm/V)" for name in models)), tuple(rows))


def least_iterations(samples: int, all_samples: int) -> int:
    """Return the least number of iterations for a loop with `samples` of `all_samples` samples, Eq. 9, rounded up."""
    return int(np.ceil(10.0 * np.sqrt(4.0 * samples / all_samples + 1.0)))


def _single_models(study: Study) -> Exhibit:
    models = {AT_REST: study.at_rest, CLOSING: study.closing}
    all_samples = study.separation.voltage.size
    bounds = ", ".join(
        f"{least_iterations(loop.path.size, all_samples)} (level {ROMAN[loop.level]})"
        for loop in study.separation.loops
    )
    return Exhibit(
        title="Fig. 10 and Tables 2 to 4: a PI model for each loop",
        paper="Every single loop is fitted closely by play operators of its own; the weights have no unit.",
        ours=f"{len(THRESHOLDS)} operators each, by quadratic programming to the minimum; Eq. 9 would ask for at "
        f"least so many iterations: {bounds}.",
        remark="The weights are those of another stage. The inner loops are fitted closely; the outer one, which is "
        "not symmetric, is not.",
        tables=tuple(_weights(models, level, printed) for level, printed in PRINTED.items()),
        pictures=(Picture(singles(study.separation, models), "Single loops in their own coordinates."),),
    )


def _gaps(loops: SeparatedLoops) -> dict[int, float]:
    """Return the gap (m) by which each inner loop fails to close at its vertex, by level."""
    there_and_back = (np.array([0.0, loop.span[0], 0.0]) for loop in loops.loops)
    return {
        loop.level: abs(float(loop.memory().forward_array(path)[-1]))
        for loop, path in zip(loops.loops, there_and_back, strict=True)
        if loop.level
    }


def _closure(study: Study) -> Exhibit:
    stroke = float(np.ptp(study.separation.displacement))
    at_rest, closing = _gaps(study.at_rest), _gaps(study.closing)
    steps = {loop.level: loop.offset[1] for loop in study.closing.loops}
    rows = [
        (ROMAN[level], um(gap), f"{closing[level] / stroke:.1e}", um(steps[level])) for level, gap in at_rest.items()
    ]
    return Exhibit(
        title="Loops that close",
        paper="Not discussed. With operators that start at rest (p = 0), a loop misses its vertex by the sum of ω r.",
        ours=f"At rest, inner loops miss their vertex by up to {um(max(at_rest.values()))} µm; primed, by "
        f"{max(closing.values()) / stroke:.1e} of the stroke.",
        remark="The closing form is the default of kind slpi-published; --loops-at-rest gives the published one. Every "
        "loop keeps the place where it was measured, so there is a step where it is linked to the loop below: that "
        "loop's error at the vertex.",
        tables=(Table(("level", "gap at rest (µm)", "gap primed (of stroke)", "step where linked (µm)"), tuple(rows)),),
    )


def _classical(study: Study) -> Exhibit:
    rows = [
        (f"{r:.0f}", f"{w:.5f}", f"{ours * 1e6:.5f}")
        for r, w, ours in zip(THRESHOLDS, TABLES[5], study.classical.weights, strict=True)
    ]
    better = gain(study.modelled[CLASSICAL].overall, study.modelled[CLOSING].overall)
    return Exhibit(
        title="Fig. 14 and Table 5: classical PI and SLPI over the data",
        paper="SLPI follows every loop; classical PI loses accuracy towards the higher levels. No numbers are printed.",
        ours=f"Free-run, on the record they were fitted to: mean {um(study.modelled[CLASSICAL].overall)} µm (classical "
        f"PI), {um(study.modelled[AT_REST].overall)} µm (SLPI at rest), {um(study.modelled[CLOSING].overall)} µm (SLPI "
        f"closing, {better:.1f} % less than classical), {um(study.modelled[FAMILY].overall)} µm (loop family).",
        remark=f"Classical PI is as in Table 5: {len(THRESHOLDS)} operators, at rest and zero at the start. With "
        f"{PLAY_OPERATORS} operators and a free start, as kind pi has them, it is better; it stands beside.",
        tables=(
            Table(("Table 5: r (V)", "ω, paper", "ω, ours (µm/V)"), tuple(rows)),
            errors_table(study.modelled, study.separation),
        ),
        pictures=(Picture(over_data(study.separation, study.modelled, DRAWN), "Models over the data."),),
    )


def _inverse(study: Study) -> Exhibit:
    low, high = (float(edge(study.voltages[CLOSING])) for edge in (np.min, np.max))
    models = {AT_REST: study.at_rest, CLOSING: study.closing}
    return Exhibit(
        title="Fig. 11 to 13: feedforward with the inverse, rebuilt from the loops",
        paper="Inverse models of the single loops, linked at the break points (stars) from level 0 inwards.",
        ours=f"Voltage from {low:.2f} to {high:.2f} V for the desired path of {study.desired.size} samples.",
        remark="Where loops are linked the voltage may jump: each loop keeps the place where it was measured.",
        pictures=(
            Picture(singles(study.separation, models, inverse=True), "Fig. 12: inverses of the single loops."),
            Picture(inverses(study, DRAWN), "Fig. 13: the rebuilt inverse, voltage over displacement."),
        ),
    )


def _percentages(errors: Mapping[str, LoopErrors]) -> Table:
    rows = [("paper, SLPI", *(f"{value:.1f}" for value in PAPER))]
    rows += [(f"ours, {name}", *(f"{fall:.1f}" for fall in _falls(errors, name))) for name in MODELS[1:]]
    return Table(("less than classical PI by (%)", *FIGURES), tuple(rows))


def _falls(errors: Mapping[str, LoopErrors], name: str) -> tuple[float, float, float, float]:
    """Return the reductions of the errors in `FIGURES` by a model, relative to classical PI, in per cent."""
    classical, other = errors[CLASSICAL], errors[name]
    return (
        gain(classical.maxima[0], other.maxima[0]),
        gain(classical.means[-1], other.means[-1]),
        gain(classical.spread, other.spread),
        gain(classical.overall, other.overall),
    )


def _verdict(errors: Mapping[str, LoopErrors], name: str) -> str:
    """Return a comparison of these reductions with those of the paper, as text."""
    parts = []
    for what, paper, ours in zip(FIGURES, PAPER, _falls(errors, name), strict=True):
        parts.append(f"{what} {-ours:+.1f} % ({'met' if ours >= paper else 'not met'})")
    return ", ".join(parts)


def compensation(study: Study) -> Exhibit:
    """Return the exhibit of compensation along a path with the reversals of the record."""
    errors = study.compensated
    return Exhibit(
        title="Fig. 15 and the four percentages: compensation",
        paper="Against classical PI: "
        + ", ".join(f"{what} -{value} %" for what, value in zip(FIGURES, PAPER, strict=True))
        + ".",
        ours=f"Closing form: {_verdict(errors, CLOSING)}. At rest, as published: {_verdict(errors, AT_REST)}.",
        remark="Desired: straight lines between the displacements measured at the turns, so that the loops are those "
        "that were identified. The stage is a fresh one, errors are true ones, voltages stay within 0 to 100 V. The "
        "spread grows where the inner loops gain more than the outer one, whose shape no PI model has.",
        tables=(_percentages(errors), errors_table(errors, study.separation)),
        pictures=(Picture(draw_compensation(study, DRAWN), "Achieved over desired; errors."),),
    )


def straight_line(study: Study) -> Exhibit:
    """Return the exhibit of compensation along the paper's straight line."""
    errors = study.straight
    return Exhibit(
        title="Fig. 15 with the paper's straight line",
        paper="Expected is the straight line through zero and the maximum (4.1).",
        ours=f"Closing form: {_verdict(errors, CLOSING)}. At rest, as published: {_verdict(errors, AT_REST)}.",
        remark="This path turns at other displacements than the record did, by up to the hysteresis itself, so that no "
        "published loop quite fits; and it ends below what the stage can reach at 0 V after the rise. The loop family "
        "interpolates between vertices and loses little.",
        tables=(_percentages(errors), errors_table(errors, study.separation)),
    )


def other(title: str, study: Study) -> Exhibit:
    """Return the exhibit of the models and the compensation on another path."""
    errors = study.modelled
    worst = {name: max(errors[name].means[1:]) for name in (CLASSICAL, CLOSING, FAMILY)}
    return Exhibit(
        title=title,
        paper="SLPI describes the inner loops much better than classical PI; there was no error calculation.",
        ours=f"{turns_of(study)}. Worst inner loop, mean error of the model: {um(worst[CLASSICAL])} µm (classical PI), "
        f"{um(worst[CLOSING])} µm (SLPI closing), {um(worst[FAMILY])} µm (loop family).",
        remark="As in the paper, and with numbers.",
        tables=(
            errors_table(errors, study.separation, "of the model"),
            errors_table(study.compensated, study.separation, "compensated"),
        ),
        pictures=(
            Picture(separated(study.separation), "The loops."),
            Picture(over_data(study.separation, errors, DRAWN), "Models over data."),
        ),
    )


def unseen(unseen: UnseenPaths) -> Exhibit:
    """Return the exhibit of paths that were not used for the identification."""
    rows = [
        (name, *(um(mean) for mean in means), um(float(np.mean(means)))) for name, means in unseen.mean_errors.items()
    ]
    header = ("mean error (µm)", *(f"path {k + 1}" for k in range(len(unseen.turns))), "all")
    paths = "; ".join(" → ".join(f"{turn:.0f}" for turn in turns) for turns in unseen.turns)
    return Exhibit(
        title="Paths whose loops were never identified",
        paper="Not tried.",
        ours=f"Models of the random path on {len(unseen.turns)} other paths (V): {paths}. "
        f"{unseen.replaced} of their {unseen.loops} inner loops were never identified; the nearest ones replace them.",
        remark="Published SLPI has nothing to say about loops it has not seen, and is no better than classical PI with "
        "more operators there; the loop family interpolates.",
        tables=(Table(header, tuple(rows), best=int(np.argmin([np.mean(e) for e in unseen.mean_errors.values()]))),),
    )
