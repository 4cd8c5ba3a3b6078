"""From one measured record to the next: what a diagnosis finds on some records, judged on others of the same stage.

Errors are free-run, without the constant of each record, in % of its stroke: of a classical Prandtl-Ishlinskii model,
of a loop family, and of that extended by what the diagnosis found; all are fitted to the same records. Drift and hum
belong to the record they were found on and are left out. The folder of measured data is that of SLPI_MEASURED_DATA.
"""

import argparse
import os
import time
import warnings
from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np

import slpi_ros
from slpi_ros.effects.creep import Creep
from slpi_ros.io.record import Record
from slpi_ros.io.tables import import_table
from slpi_ros.model.axis_model import AxisModel, Start

STAGES = {
    "ntnu": ("ntnu_20hz", "ntnu_40hz", "ntnu_100hz"),
    "picma": ("picma_1hz_decay_grow", "picma_1hz_major"),
}


def free_run(model: AxisModel, record: Record, axis: str) -> float:
    """Return the error, % of the stroke, from the initial history (never moved, or after a long fall) that suits."""
    v, y = record.voltage[axis], record.displacement[axis]
    known = np.isfinite(y)
    shared = replace(model, effects=tuple(effect for effect in model.effects if effect.removable != "record"))
    # What creeps on from before a record is the record's own, as its initial history.
    settled = replace(
        shared,
        effects=tuple(replace(one, initial=0.0) if isinstance(one, Creep) else one for one in shared.effects),
    )
    errors = [
        replace(each, start=Start(float(v[0]), 0.0, history)).simulate(record.t, v)[known] - y[known]
        for history in {(), (float(v[0]),), model.start.history}
        for each in (shared, settled)
    ]
    return 100.0 * min(float(np.std(error)) for error in errors) / float(np.ptp(y[known]))


def splits(names: tuple[str, ...]) -> Iterator[tuple[str, ...]]:
    """Yield every choice of records that leaves one out."""
    for count in range(1, len(names)):
        yield from combinations(names, count)


def judge(records: dict[str, Record], fitted: tuple[str, ...]) -> None:
    """Print what is found on some records, and the errors on all."""
    began, chosen = time.perf_counter(), [records[name] for name in fitted]
    axis = chosen[0].axes[0]
    plain, classical = (slpi_ros.identify(chosen, kind) for kind in ("slpi", "pi"))
    diagnosis = slpi_ros.diagnose(chosen, plain)
    found = diagnosis.axes[axis]
    took = time.perf_counter() - began
    print(f"\nfitted to {', '.join(fitted)}: {found.verdict}, {took:.0f} s")
    for named in found.effects:
        print(
            f"  {named.name} ({named.gain_percent:.0f} %; or {', '.join(named.alternatives) or 'none'}): {named.effect}"
        )
    kept = [effect.name for effect in diagnosis.extended.axes[axis].effects]
    print(f"  in the extended model: {', '.join(kept) or 'none'}; dropped: {', '.join(found.dropped) or 'none'}")
    print(f"  {'record':24}{'':12}{'classical':>10}{'plain':>8}{'extended':>10}")
    for name, record in records.items():
        errors = [free_run(model.axes[axis], record, axis) for model in (classical, plain, diagnosis.extended)]
        where = "fitted" if name in fitted else "not fitted"
        worse = "  WORSE" if name not in fitted and errors[2] > 1.001 * errors[1] else ""
        print(f"  {name:24}{where:12}{errors[0]:10.3f}{errors[1]:8.3f}{errors[2]:10.3f}{worse}", flush=True)


def main() -> None:
    """Judge every choice of records of every stage."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", choices=STAGES, help="this stage alone")
    options = parser.parse_args()
    folder = Path(os.environ.get("SLPI_MEASURED_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
    if not folder.is_dir():
        print("no measured data: set SLPI_MEASURED_DATA to its folder")
        return
    warnings.simplefilter("ignore")
    for stage in [options.only] if options.only else STAGES:
        records = {name: import_table(folder / f"{name}.csv") for name in STAGES[stage]}
        for fitted in splits(STAGES[stage]):
            judge(records, fitted)


if __name__ == "__main__":
    main()
