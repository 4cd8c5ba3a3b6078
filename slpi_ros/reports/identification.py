"""The page of an identification: what was measured, what the model makes of it, and what is left."""

from pathlib import Path

import numpy as np

from slpi_ros.identification.record import Record
from slpi_ros.model import StageModel
from slpi_ros.reports import plots
from slpi_ros.reports.page import Page
from slpi_ros.reports.text import describe_axis


def write_report(folder: Path, record: Record, model: StageModel) -> Path:
    """Write ``report.html`` into `folder` and return its path.

    Raises
    ------
    SlpiError
        If it cannot be written.
    """
    page = Page(f"Model of {record.source}")
    for name, axis in model.axes.items():
        page.heading(f"Axis {name}")
        page.lines(describe_axis(axis))
        driven = np.isfinite(record.voltage[name])
        t, v, y = record.t[driven], record.voltage[name][driven], record.displacement[name][driven]
        simulated = axis.simulate(v)
        page.figure(plots.loops(v, y, simulated), "Displacement over voltage, and what the model leaves over voltage.")
        page.figure(
            plots.residual(t, simulated - y), "What the model leaves, over time, free-run from the record's start."
        )
    path = folder / "report.html"
    page.write(path)
    return path
