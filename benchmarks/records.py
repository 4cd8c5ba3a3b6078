"""Measured records, and the error of a model on them from the best of the possible initial states."""

import os
from collections.abc import Collection, Iterator
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np

from slpi_ros.io.record import Record
from slpi_ros.model.axis_model import AxisModel, Start


def measured_folder() -> Path | None:
    """Return the folder of the measured data; None, with a sentence on standard output, where there is none."""
    folder = Path(os.environ.get("SLPI_MEASURED_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
    if folder.is_dir():
        return folder
    print("no measured data: set SLPI_MEASURED_DATA to its folder")
    return None


def free_run(model: AxisModel, record: Record, axis: str, others: Collection[tuple[float, ...]] = frozenset()) -> float:
    """Return the error, % of the stroke, for the best of the possible initial states (such as never moved).

    Parameters
    ----------
    model : AxisModel
    record : Record
    axis : str
    others : collection of tuple of float, volts
        Further initial states, such as those of the models that this one is compared with. Default: none.
    """
    v, y = record.voltage[axis], record.displacement[axis]
    known = np.isfinite(y)
    # A record need not begin as those of the model did.
    calm = replace(model, effects=tuple(one.rested for one in model.effects))
    errors = [
        replace(each, start=Start(float(v[0]), 0.0, history)).simulate(record.t, v)[known] - y[known]
        for history in {(), (float(v[0]),), model.start.history, *others}
        for each in (model, calm)
    ]
    return 100.0 * min(float(np.std(error)) for error in errors) / float(np.ptp(y[known]))


def splits(names: tuple[str, ...]) -> Iterator[tuple[str, ...]]:
    """Yield every selection of records that leaves at least one out."""
    for count in range(1, len(names)):
        yield from combinations(names, count)
