"""The SLPI paper's figures and tables, from the studies."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from slpi_ros.hysteresis.slpi_published import SeparatedLoops
from slpi_ros.identification.linear import PLAY_OPERATORS
from slpi_ros.identification.published_kinds import least_iterations
from slpi_ros.papers import slpi_pictures as pictures
from slpi_ros.papers.exhibit import Exhibit, Picture, Table
from slpi_ros.papers.published import TABLE_2, TABLE_3, TABLE_4, TABLE_5, THRESHOLDS
from slpi_ros.papers.slpi_compensation import compensation, other, straight_line, unseen
from slpi_ros.papers.slpi_study import (
    AT_REST,
    CLASSICAL,
    CLOSING,
    DOUBLE_INNER_LOOP,
    DRAWN,
    FAMILY,
    OVERLAPPED,
    Study,
    gain,
    study,
    unseen_paths,
)
from slpi_ros.papers.slpi_tables import errors_table, turns_of, um

FloatArray = NDArray[np.float64]

ROMAN = pictures.ROMAN
PRINTED = {2: TABLE_2, 1: TABLE_3, 0: TABLE_4}


def exhibits(random: Study) -> list[Exhibit]:
    """Run the experiments of the SLPI paper, beyond the study of its random path, and return what they show."""
    return [
        _nonlinear_curve(random),
        _inclinations(random),
        _separation(random),
        _single_models(random),
        _closure(random),
        _classical(random),
        _inverse(random),
        compensation(random),
        straight_line(random),
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
        pictures=(Picture(pictures.path_and_curve(study.separation.voltage, y), "Voltage over time; the curve."),),
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
        pictures=(Picture(pictures.inclinations(separation), "The loops, each from its vertex."),),
        remark="A translation-invariant model such as classical PI gives loops of one span one inclination.",
        tables=(Table(("level", "from … to (V)", "slope (µm/V)"), tuple(rows)),),
    )


def _separation(study: Study) -> Exhibit:
    separation = study.separation
    rows = []
    for loop in separation.loops:
        v = separation.voltage
        far = v[loop.samples][int(np.argmax(np.abs(v[loop.samples] - v[loop.vertex])))]
        sewn = ", ".join(f"{vertex:.0f}" for vertex in v[loop.sewn]) or "-"
        rows.append((ROMAN[loop.level], f"{v[loop.vertex]:.0f}", f"{far:.0f}", sewn, str(loop.samples.size)))
    return Exhibit(
        title="Fig. 9: loops separated",
        paper="Single loops of levels II, I and 0; a triangle at each vertex, a circle where a loop was taken out.",
        ours=f"{len(separation.loops)} single loops; the table of all samples is in separation.csv.",
        remark="None: level and vertex are as the paper's rules give them.",
        tables=(Table(("level", "vertex (V)", "turns at (V)", "sewn at (V)", "samples"), tuple(rows)),),
        pictures=(Picture(pictures.separated(separation), "Single loops, the highest level first."),),
    )


def _weights(models: Mapping[str, SeparatedLoops], level: int, printed: tuple[float, ...]) -> Table:
    found = [next(loop.model for loop in model.loops if loop.level == level).weights * 1e6 for model in models.values()]
    rows = [
        (f"{r:.0f}", f"{w:.5f}", *(f"{weights[i]:.5f}" for weights in found))
        for i, (r, w) in enumerate(zip(THRESHOLDS, printed, strict=True))
    ]
    return Table((f"level {ROMAN[level]}: r (V)", "ω, paper", *(f"ω, {name} (µm/V)" for name in models)), tuple(rows))


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
        ours=f"{len(THRESHOLDS)} operators each, by quadratic programming with at least as many iterations as Eq. 9 "
        f"asks: {bounds}.",
        remark="The weights are those of another stage. The inner loops are fitted closely; the outer one, which is "
        "not symmetric, is not.",
        tables=tuple(_weights(models, level, printed) for level, printed in PRINTED.items()),
        pictures=(Picture(pictures.single_models(study.separation, models), "Single loops in their own coordinates."),),
    )


def _gaps(loops: SeparatedLoops) -> dict[int, float]:
    """Return by how much each inner loop misses its vertex, metres, by level."""
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
        for r, w, ours in zip(THRESHOLDS, TABLE_5, study.classical.weights, strict=True)
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
        pictures=(Picture(pictures.over_data(study.separation, study.modelled, DRAWN), "Models over the data."),),
    )


def _inverse(study: Study) -> Exhibit:
    low, high = (float(edge(study.voltages[CLOSING])) for edge in (np.min, np.max))
    return Exhibit(
        title="Fig. 11 to 13: feedforward with the inverse, rebuilt from the loops",
        paper="Inverse models of the single loops, linked at the break points (stars) from level 0 inwards.",
        ours=f"Voltage from {low:.2f} to {high:.2f} V for the desired path of {study.desired.size} samples.",
        remark="Where loops are linked the voltage may jump: each loop keeps the place where it was measured.",
        pictures=(
            Picture(pictures.single_inverses(study), "Fig. 12: inverses of the single loops."),
            Picture(pictures.inverses(study, DRAWN), "Fig. 13: the rebuilt inverse, voltage over displacement."),
        ),
    )
