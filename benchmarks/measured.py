"""Held-out, free-run errors on measured records, classical PI beside the loop family.

The folder of measured data is that of SLPI_MEASURED_DATA.
"""

import os
import sys
import time
from pathlib import Path

import numpy as np

import slpi_ros
from slpi_ros.tables import import_csv

CASES = (
    # record, fit from, to, then score (name, from, to); None: the middle of the record, or its end
    ("afm_double_sine_x", None, 0.5, (("second half", 0.5, 1.0),)),
    ("picma_1hz_decay_grow", 2.0, 25.0, (("25-37 s", 25.0, 37.0), ("38-71 s, other regime", 38.0, 71.0))),
)


def seconds(bound: float | None, end: float) -> float | None:
    """Return a bound in seconds; up to 1 it is a share of the record."""
    return bound if bound is None or bound > 1 else bound * end


def main() -> int:
    """Print the table."""
    default = Path(__file__).resolve().parents[2] / "shared" / "data"
    folder = Path(os.environ.get("SLPI_MEASURED_DATA", default))
    if not folder.is_dir():
        print("no measured data: set SLPI_MEASURED_DATA to its folder")
        return 0
    print("rms error in um, held-out, free-run from the record's start")
    for name, start, stop, scores in CASES:
        record = import_csv(folder / f"{name}.csv")
        end = float(record.t[-1]) + 1e-9
        for kind in ("slpi", "pi"):
            began = time.perf_counter()
            model = slpi_ros.identify(record, kind, start=start, stop=seconds(stop, end))
            took = time.perf_counter() - began
            error = model.simulate(record.t, record.voltage["x"]) - record.displacement["x"]
            parts = []
            for what, a, b in scores:
                inside = (record.t >= seconds(a, end)) & (record.t < seconds(b, end)) & np.isfinite(error)
                parts.append(f"{what} {1e6 * np.sqrt(np.mean(error[inside] ** 2)):.4f}")
            print(f"{name:<22} {kind:<5} {'  '.join(parts)}   ({took:.1f} s)")
    return 0


if __name__ == "__main__":
    sys.exit(main())
