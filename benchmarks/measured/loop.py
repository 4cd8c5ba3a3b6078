"""The picture of README: a measured loop beside models that were fitted to another record.

    python -m benchmarks.measured.loop

Writes ``docs/images/loop.svg``. The records are found as in ``benchmarks.measured.bench``.
"""

import sys
from pathlib import Path

import numpy as np

from benchmarks.measured.bench import data_folder
from benchmarks.measured.manifest import read_manifest
from benchmarks.measured.methods import METHODS
from benchmarks.measured.report import ROOT
from benchmarks.measured.scores import Tables, fitted_series, free_run

PICTURE = ROOT / "docs" / "images" / "loop.svg"
# README's row of the nanopositioner: fitted to 20 Hz, judged at 40 Hz; the models, with their colours. The second is
# the best other method of that row, as a test sees.
TASK, CYCLE_S = "ntnu2 20 Hz", 0.025
MODELS = {"PI": "tab:orange", "PI, creep": "tab:green", "SLPI, causes": "black"}


def draw(folder: Path, path: Path) -> None:
    """Draw the last cycle over the voltage, and the errors of the models in it without their mean, % of the range."""
    import matplotlib

    matplotlib.use("svg")
    # The same figures shall give the same file.
    matplotlib.rcParams["svg.hashsalt"] = "loop"
    from matplotlib import pyplot

    tables = Tables(folder)
    task = next(task for task in read_manifest().tasks if task.name == TASK)
    records = fitted_series(tables, task)
    one = tables.series(task.judged[0].record, task.axis, task.judged)
    shown = one.t >= one.t[-1] - CYCLE_S
    share = 100.0 / float(np.ptp(one.y))
    t, zero = 1e3 * (one.t[shown] - one.t[shown][0]), float(np.min(one.y[shown]))
    figure, (loop, errors) = pyplot.subplots(1, 2, figsize=(9.0, 3.4), constrained_layout=True)
    loop.plot(one.v[shown], share * (one.y[shown] - zero), color="tab:blue", linewidth=3.0, label="measured")
    for method in METHODS:
        if method.name in MODELS:
            run, _, _ = free_run(method.fit(records), one, records)
            run = run - np.mean((run - one.y)[shown])
            name = method.name
            colour = MODELS[method.name]
            loop.plot(one.v[shown], share * (run[shown] - zero), color=colour, linewidth=1.0, label=name)
            errors.plot(t, share * (run - one.y)[shown], color=colour, label=name)
    loop.set(xlabel="voltage / V", ylabel="displacement / % of range")
    errors.set(xlabel="time / ms", ylabel="model - measured / % of range")
    for axes in (loop, errors):
        axes.grid(linewidth=0.3)
        axes.legend(fontsize="small")
    figure.savefig(path, metadata={"Date": None})
    pyplot.close(figure)


def main() -> int:
    """Draw the picture where there are measured records."""
    folder = data_folder()
    if folder is None:
        return 1
    draw(folder, PICTURE)
    return 0


if __name__ == "__main__":
    sys.exit(main())
