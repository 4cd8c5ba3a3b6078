"""Held-out free-run errors of every kind of model on measured records.

The environment variable SLPI_MEASURED_DATA gives the folder of the measured data.
"""

import os
import sys
import time
from pathlib import Path

import numpy as np

import slpi_ros
from slpi_ros.identification.fit import KINDS
from slpi_ros.identification.repeatability import repeatability_of
from slpi_ros.io.record import Record
from slpi_ros.io.tables import import_table
from slpi_ros.papers.measured import CASES, score

# End of the triangles and start of the sines in the record afm_triangle_sine, seconds.
TRIANGLES_END = 2893.0
# End of the fitted part of piezo_150v_1hz, seconds: rest at a remanent offset until 3.26 s, then sines.
PIEZO_FITTED = 7.2
# Largest errors allowed by issue D, um.
AFM_MARK, PIEZO_MARK = 0.060, 0.066


def main() -> int:
    """Print the tables."""
    default = Path(__file__).resolve().parents[2] / "shared" / "data"
    folder = Path(os.environ.get("SLPI_MEASURED_DATA", default))
    if not folder.is_dir():
        print("no measured data: set SLPI_MEASURED_DATA to its folder")
        return 0
    print("rms error in um, held-out, free-run from the record's start")
    for case in CASES:
        for kind in KINDS:
            began = time.perf_counter()
            scores = score(folder, case, kind)
            took = time.perf_counter() - began
            # A refused fit has no errors.
            parts = [f"{what} {1e6 * e:.4f}" for what, e in zip(case.predicted, scores.errors, strict=False)]
            print(f"{case.name:<22} {kind:<15} {'  '.join(parts) or scores.refusal}   ({took:.1f} s)")
    print(f"mark for slpi on afm_double_sine_x: {AFM_MARK:.3f}")
    print("\nfrom the record's first sample on, no start given; predicted; blocks left out; repeatability; um")
    print(f"{'':<30}{'slpi':>8}{'pi':>8}   left out: {'slpi':>8}{'pi':>8}   floor")
    for name, until, mark in (("piezo_150v_1hz", PIEZO_FITTED, PIEZO_MARK), ("afm_triangle_sine", TRIANGLES_END, 0.0)):
        record = import_table(folder / f"{name}.csv")
        for axis in record.axes:
            _row(name, record, axis, until, mark)
    return 0


def _row(name: str, record: Record, axis: str, until: float, mark: float) -> None:
    """Print the errors of models identified before the time `until` (s) of a record on the part after it."""
    v, y = record.voltage[axis], record.displacement[axis]
    predicted, left_out = [], []
    for kind in ("slpi", "pi"):
        model = slpi_ros.identify(record, kind, stop=until, axes=[axis])
        driven = np.isfinite(v)
        error = model.simulate(record.t[driven], {axis: v[driven]})[axis] - y[driven]
        predicted.append(1e6 * float(np.sqrt(np.nanmean(error[record.t[driven] >= until] ** 2))))
        left_out.append(1e6 * model.axes[axis].quality.held_out_rms)
    floor = repeatability_of(record.t, v, y)
    asked = f"   mark {mark:.3f}" if mark else ""
    print(
        f"{name + ' ' + axis + f', {until:g} s on':<30}{predicted[0]:8.4f}{predicted[1]:8.4f}"
        f"{left_out[0]:20.4f}{left_out[1]:8.4f}   {1e6 * floor.rms:.4f} ({floor.source.split(':')[0]}){asked}"
    )


if __name__ == "__main__":
    sys.exit(main())
