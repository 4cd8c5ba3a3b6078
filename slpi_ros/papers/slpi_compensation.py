"""The SLPI paper's compensation: the four percentages, the straight line, other loops, paths never identified."""

from collections.abc import Mapping

import numpy as np

from slpi_ros.papers import slpi_pictures as pictures
from slpi_ros.papers.exhibit import Exhibit, Picture, Table
from slpi_ros.papers.published import HIGHEST_MEAN, OUTER_MAXIMUM, OVERALL_MEAN, SPREAD
from slpi_ros.papers.slpi_study import (
    AT_REST,
    CLASSICAL,
    CLOSING,
    DRAWN,
    FAMILY,
    MODELS,
    LoopErrors,
    Study,
    UnseenPaths,
    gain,
)
from slpi_ros.papers.slpi_tables import errors_table, turns_of, um

FIGURES = ("outer loop's maximum", "highest loop's mean", "spread between loops", "overall mean")
PAPER = (OUTER_MAXIMUM, HIGHEST_MEAN, SPREAD, OVERALL_MEAN)


def _percentages(errors: Mapping[str, LoopErrors]) -> Table:
    rows = [("paper, SLPI", *(f"{value:.1f}" for value in PAPER))]
    rows += [(f"ours, {name}", *(f"{fall:.1f}" for fall in _falls(errors, name))) for name in MODELS[1:]]
    return Table(("less than classical PI by (%)", *FIGURES), tuple(rows))


def _falls(errors: Mapping[str, LoopErrors], name: str) -> tuple[float, float, float, float]:
    """Return by how much a model beats classical PI, in per cent, in the order of the paper's four figures."""
    classical, other = errors[CLASSICAL], errors[name]
    return (
        gain(classical.maxima[0], other.maxima[0]),
        gain(classical.means[-1], other.means[-1]),
        gain(classical.spread, other.spread),
        gain(classical.overall, other.overall),
    )


def _verdict(errors: Mapping[str, LoopErrors], name: str) -> str:
    """Say how a model stands in each of the paper's four figures."""
    parts = []
    for what, paper, ours in zip(FIGURES, PAPER, _falls(errors, name), strict=True):
        parts.append(f"{what} {-ours:+.1f} % ({'met' if ours >= paper else 'not met'})")
    return ", ".join(parts)


def compensation(study: Study) -> Exhibit:
    """Show what each model makes of the path that turns where the record did."""
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
        pictures=(
            Picture(pictures.compensation(study, errors, study.desired, DRAWN), "Achieved over desired; errors."),
        ),
    )


def straight_line(study: Study) -> Exhibit:
    """Show what each model makes of the paper's straight line."""
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
    """Show the models of another path."""
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
            Picture(pictures.separated(study.separation), "The loops."),
            Picture(pictures.over_data(study.separation, errors, DRAWN), "Models over data."),
        ),
    )


def unseen(unseen: UnseenPaths) -> Exhibit:
    """Show what the models make of paths that were not identified."""
    rows = [
        (name, *(um(mean) for mean in means), um(float(np.mean(means)))) for name, means in unseen.mean_errors.items()
    ]
    header = ("mean error (µm)", *(f"path {k + 1}" for k in range(len(unseen.turns))), "all")
    paths = "; ".join(" → ".join(f"{turn:.0f}" for turn in turns) for turns in unseen.turns)
    return Exhibit(
        title="Paths whose loops were never identified",
        paper="Not tried.",
        ours=f"Models of the random path on {len(unseen.turns)} other paths (V): {paths}. "
        f"{unseen.replaced} of their {unseen.loops} inner loops were never identified; the nearest stand in.",
        remark="Published SLPI has nothing to say about loops it has not seen, and is no better than classical PI with "
        "more operators there; the loop family interpolates.",
        tables=(Table(header, tuple(rows), best=int(np.argmin([np.mean(e) for e in unseen.mean_errors.values()]))),),
    )
