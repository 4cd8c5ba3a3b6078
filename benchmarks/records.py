"""Transfer between measured records: diagnose some records of a stage, test the extended model on its other records.

Errors are those of a free-run simulation, without the constant offset of each record, in % of its stroke. The models
are a classical Prandtl-Ishlinskii model, a loop family, and the loop family extended by the diagnosed effects, all
fitted to the same records. Drift and hum are specific to a record and are left out. The environment variable
SLPI_MEASURED_DATA gives the folder of the measured data.
"""

import argparse
import os
import time
import warnings
from collections.abc import Collection, Iterator
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np

import slpi_ros
from slpi_ros.io.record import Record
from slpi_ros.io.tables import import_table
from slpi_ros.model.axis_model import AxisModel, Start

STAGES = {
    "ntnu": ("ntnu_20hz", "ntnu_40hz", "ntnu_100hz"),
    "picma": ("picma_1hz_decay_grow", "picma_1hz_major"),
}


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


def judge(records: dict[str, Record], fitted: tuple[str, ...]) -> None:
    """Diagnose the records named in `fitted`; print the effects found, and the errors of the models on all records."""
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
    """Test every selection of records of every stage."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", choices=STAGES, help="this stage alone")
    options = parser.parse_args()
    folder = measured_folder()
    if not folder:
        return
    warnings.simplefilter("ignore")
    for stage in [options.only] if options.only else STAGES:
        records = {name: import_table(folder / f"{name}.csv") for name in STAGES[stage]}
        for fitted in splits(STAGES[stage]):
            judge(records, fitted)


if __name__ == "__main__":
    main()
