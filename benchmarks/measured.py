"""Held-out, free-run errors on measured records, every kind of model.

The folder of measured data is that of SLPI_MEASURED_DATA.
"""

import os
import sys
import time
from pathlib import Path

from slpi_ros.experiments.measured import CASES, score
from slpi_ros.identification.fit import KINDS


def main() -> int:
    """Print the table."""
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
    return 0


if __name__ == "__main__":
    sys.exit(main())
