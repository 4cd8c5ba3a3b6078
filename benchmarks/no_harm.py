"""Other actuators, measured: are the causes that a diagnosis finds a help, and do they never harm.

Some records of an actuator are fitted: a classical Prandtl-Ishlinskii model, a loop family, and the loop family
extended by the diagnosed effects. All three are judged on its other records: free-run error without the constant offset
of the record, rms in % of its range, from the best of the same initial states for all three. A row is marked

- ``HARM``: with causes the error is more than 1.05 times that of the loop family without;
- ``PI``: the error of the loop family is more than 1.05 times that of the classical model.

Most of these actuators are no piezos, see the README of the measured data. The environment variable SLPI_MEASURED_DATA
gives its folder. The exit code is 1 if any row is marked.
"""

import argparse
import sys
import time
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from records import free_run, measured_folder, splits

import slpi_ros
from slpi_ros.diagnosis.result import NamedEffect
from slpi_ros.errors import SlpiError
from slpi_ros.identification.free_run import histories
from slpi_ros.identification.samples import Samples, select_samples
from slpi_ros.io.record import Record
from slpi_ros.io.tables import import_table

# Records of each actuator. One with a single record is halved in time.
SETS = {
    "hasel": ("hasel_1hz", "hasel_5hz", "hasel_step"),
    "pzt19": ("pzt19_500ms", "pzt19_2s"),
    "ferro": ("ferro_forc",),
    "tendon": ("tendon_0p1hz", "tendon_0p3hz"),
    "ntnu": ("ntnu_20hz", "ntnu_40hz", "ntnu_100hz"),
    "ntnu2": ("ntnu2_20hz", "ntnu2_40hz"),
    "picma": ("picma_1hz_decay_grow", "picma_1hz_major"),
}
# Ratio of two errors above which a row is marked.
WORSE = 1.05


def records_of(folder: Path, names: Sequence[str]) -> dict[str, Record]:
    """Return the records of an actuator by name; the halves of a single one."""
    records = {name: replace(import_table(folder / f"{name}.csv"), source=name) for name in names}
    if len(records) > 1:
        return records
    ((name, whole),) = records.items()
    half = len(whole) // 2
    parts = {f"{name} 1st half": whole.part(slice(half)), f"{name} 2nd half": whole.part(slice(half, None))}
    return {part: replace(record, source=part) for part, record in parts.items()}


def judge(records: dict[str, Record], fitted: tuple[str, ...]) -> list[str]:
    """Fit the records named in `fitted`; print a line for each other record, and return the marks."""
    began, chosen = time.perf_counter(), [records[name] for name in fitted]
    axis = chosen[0].axes[0]
    print(f"\nfitted to {', '.join(fitted)}")
    models: dict[str, slpi_ros.StageModel] = {}
    for kind in ("pi", "slpi"):
        try:
            models[kind] = slpi_ros.identify(chosen, kind)
        except SlpiError as error:
            print(f"  {kind} refused: {error}")
    if "slpi" in models:
        try:
            diagnosis = slpi_ros.diagnose(chosen, models["slpi"])
        except SlpiError as error:
            print(f"  diagnosis refused: {error}")
        else:
            models["causes"], found = diagnosis.extended, diagnosis.axes[axis]
            print(f"  {found.verdict}: {_named(found.effects)}; dropped: {', '.join(found.dropped) or 'none'}")
            for effect in diagnosis.extended.axes[axis].effects:
                print(f"    in the model: {effect.describe()}")
    marks = []
    for name, record in records.items():
        errors = _errors(models, record, axis)
        where = "fitted" if name in fitted else "left out"
        mark = [] if name in fitted else _marks(errors)
        marks += mark
        figures = "".join(f"{errors.get(kind, np.nan):9.3f}" for kind in ("pi", "slpi", "causes"))
        print(f"  {name:24}{where:10}{figures}  {' '.join(mark)}".rstrip())
    print(f"  {time.perf_counter() - began:.0f} s", flush=True)
    return marks


def _named(effects: Sequence[NamedEffect]) -> str:
    said = [f"{one.name} (or {', '.join(one.alternatives)})" if one.alternatives else one.name for one in effects]
    return ", ".join(said) or "no effect"


def _errors(models: dict[str, slpi_ros.StageModel], record: Record, axis: str) -> dict[str, float]:
    """Return the free-run error (% of range) of each model, from the best of the same initial states."""
    own = {kind: model.axes[axis] for kind, model in models.items()}
    samples = select_samples(record, axis, None, None)
    # Before the record the actuator may also have moved over the whole range of the fitted ones.
    v = np.concatenate([samples.v, *(model.voltage_range for model in own.values())])
    whole = Samples(v, np.zeros(v.size), np.zeros(v.size, dtype=bool))
    starts = {*histories(samples), *histories(whole), *(model.start.history for model in own.values())}
    return {kind: free_run(model, record, axis, starts) for kind, model in own.items()}


def _marks(errors: dict[str, float]) -> list[str]:
    compared = (("HARM", "causes", "slpi"), ("PI", "slpi", "pi"))
    return [mark for mark, one, other in compared if errors.get(one, 0.0) > WORSE * errors.get(other, np.inf)]


def main() -> int:
    """Fit every selection of records of every actuator that leaves one out; return 1 if a row is marked."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", choices=SETS, metavar="SET", help=f"this actuator alone: {', '.join(SETS)}")
    options = parser.parse_args()
    folder = measured_folder()
    if not folder:
        return 0
    warnings.simplefilter("ignore")
    print(f"{'rms error, % of range':36}{'pi':>9}{'slpi':>9}{'causes':>9}")
    marks = []
    for name in [options.only] if options.only else SETS:
        records = records_of(folder, SETS[name])
        print(f"\n== {name}")
        for fitted in splits(tuple(records)):
            marks += judge(records, fitted)
    print(f"\n{marks.count('HARM')} rows marked HARM, {marks.count('PI')} marked PI")
    return 1 if marks else 0


if __name__ == "__main__":
    sys.exit(main())
