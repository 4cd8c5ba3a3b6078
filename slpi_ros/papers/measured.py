"""Held-out, free-run errors of the models of the papers and of the loop family on measured records."""

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slpi_ros.errors import SlpiError
from slpi_ros.hysteresis.kinds import DESCRIPTIONS
from slpi_ros.hysteresis.slpi_published import UnidentifiedLoopWarning
from slpi_ros.identification.fit import KINDS, identify
from slpi_ros.io.record import Record
from slpi_ros.io.tables import import_table
from slpi_ros.model.axis_model import AxisModel
from slpi_ros.papers.exhibit import Exhibit, Table


@dataclass(frozen=True)
class Case:
    """The parts of the record ``<name>.csv`` that are fitted and predicted."""

    # Each part is its start and its end (s); values up to 1 are shares of the record.
    name: str
    fitted: tuple[float, float]
    predicted: Mapping[str, tuple[float, float]]


CASES = (
    Case("afm_double_sine_x", (0.0, 0.5), {"second half": (0.5, 1.0)}),
    Case("picma_1hz_decay_grow", (2.0, 25.0), {"25-37 s": (25.0, 37.0), "38-71 s, driven otherwise": (38.0, 71.0)}),
)


REMARK = (
    "rms errors, held out, free-run from the record's first sample. Published SLPI suffers from loops that the fitted "
    "part did not hold, and from counting levels anew where a record is cut."
)


@dataclass(frozen=True)
class Scores:
    """Held-out rms errors (m) of a kind of model on parts of a record; `refusal` is the reason if there are none."""

    kind: str
    errors: tuple[float, ...]
    refusal: str = ""


def score(folder: Path, case: Case, kind: str) -> Scores:
    """Fit a model to one part of a record; predict the others, free-run from its start. SlpiError if unreadable."""
    record = import_table(folder / f"{case.name}.csv")
    end = float(record.t[-1]) + 1e-9

    def seconds(bound: float) -> float:
        return bound if bound > 1.0 else bound * end

    start, stop = (seconds(bound) for bound in case.fitted)
    try:
        model = identify(record, kind, start=start, stop=stop).axes["x"]
    except SlpiError as error:
        return Scores(kind, (), str(error))
    return Scores(kind, tuple(_rms(model, record, seconds(a), seconds(b)) for a, b in case.predicted.values()))


def _rms(model: AxisModel, record: Record, start: float, stop: float) -> float:
    driven = np.isfinite(record.voltage["x"])
    with warnings.catch_warnings(action="ignore", category=UnidentifiedLoopWarning):
        y = model.simulate(record.t[driven], record.voltage["x"][driven])
    error = y - record.displacement["x"][driven]
    t = record.t[driven]
    return float(np.sqrt(np.nanmean(error[(t >= start) & (t < stop)] ** 2)))


def exhibits(folder: Path | None) -> list[Exhibit]:
    """Return one exhibit for each measured record in `folder`; if there are none, an exhibit that states this."""

    def none(ours: str, remark: str) -> list[Exhibit]:
        return [Exhibit("Measured records", "The papers' own data are not public.", ours, remark)]

    if folder is None or not folder.is_dir():
        return none(
            f"No measured records: {folder or 'no folder given'}.", "Give the folder of the records with --data."
        )
    found = [_exhibit(folder, case) for case in CASES if (folder / f"{case.name}.csv").is_file()]
    return found or none(f"{folder} holds none of {', '.join(f'{case.name}.csv' for case in CASES)}.", "-")


def _exhibit(folder: Path, case: Case) -> Exhibit:
    scores = [score(folder, case, kind) for kind in KINDS]
    rows, refusals = [], []
    for found in scores:
        cells = [f"{error * 1e6:.4f}" for error in found.errors] or ["-"] * len(case.predicted)
        rows.append((f"{found.kind}: {DESCRIPTIONS[found.kind]}", *cells))
        if found.refusal:
            refusals.append(f"{found.kind} refused: {found.refusal}.")
    usable = [(found.errors[0], k) for k, found in enumerate(scores) if found.errors]
    ours, best = "No kind of model could be fitted.", None
    if usable:
        (least, best), (most, worst) = min(usable), max(usable)
        ours = (
            f"Best on {next(iter(case.predicted))}: {KINDS[best]}, {least * 1e6:.4f} µm rms; worst: {KINDS[worst]}, "
            f"{most * 1e6:.4f} µm."
        )
    return Exhibit(
        title=f"Measured: {case.name}",
        paper="Not one of the papers' records.",
        ours=ours,
        remark=" ".join([REMARK, *refusals]),
        tables=(Table(("error (µm)", *case.predicted), tuple(rows), best),),
    )
