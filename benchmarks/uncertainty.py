"""Coverage and sharpness: how often the true error lies within two standard uncertainties, and how large these are.

Simulated stages, every other one of them of the foreign physics of ``hidden/foreign.py``, the others Preisach stages
with random effects: 30 s of calibration with 8 nm of noise give a model, identified and diagnosed. Then the stage is
driven by the model along random paths, without feedback, at the horizons 1 s, 1 min and 1 h, in two ways: after a reset
at the end of the record, and after moves of which the model knows the last voltage alone. The error is where the stage
is minus the desired displacement, its offset included, without noise.

Measured records: a loop family is identified from all records of an actuator but one, or from the first half of a
single one, and simulated along the other. The error is that without the constant offset of the record, whose zero is
arbitrary, and the noise of the sensor counts to its uncertainty. SLPI_MEASURED_DATA gives the folder.

Any wide promise covers the errors. So the ratio of the median uncertainty to the rms of the true error is told, too:
of each path, and of all paths of a stage together. The exit code is 1 if less than 90 or more than 99.5 % of the
samples of the simulated stages are within two uncertainties, or if more than one stage in ten has a ratio above 4.
"""

# To be set before NumPy is imported: the processes share the cores.
import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import sys
import time
import warnings
from collections import defaultdict
from collections.abc import Callable
from dataclasses import replace
from multiprocessing import get_context

import numpy as np
from foreign import HIGHEST_V, NOISE_M, STAGES
from no_harm import SETS, records_of
from numpy.typing import NDArray
from records import measured_folder

import slpi_ros
from slpi_ros.errors import SlpiError
from slpi_ros.excitation.drives import calibration_drive
from slpi_ros.io.record import Record
from slpi_ros.model.axis_model import StartMemory
from slpi_ros.model.limits import Limits, decaying_turns
from slpi_ros.model.uncertainty import COVERAGE_FACTOR, AxisUncertainty
from slpi_ros.simulation import character
from slpi_ros.simulation.axis import SimulatedAxis
from slpi_ros.simulation.parameters import AxisParameters

FloatArray = NDArray[np.float64]
# Displacement (m) for voltages (V) at times (s), from the beginning of the record on.
Plant = Callable[[FloatArray, FloatArray], FloatArray]

RATE, RECORDED = 500.0, 30.0
HORIZONS = {"1 s": 1.0, "1 min": 60.0, "1 h": 3600.0}
# Initial state that the model assumes, and what was done to the stage before.
STARTS: dict[StartMemory, str] = {"wiped": "reset", "end": "moved"}
# Duration of the judged path at each horizon, and of a leg of it, s; range of its ends, shares of the range.
JUDGED, LEGS, INNER = 4.0, (0.2, 1.0), (0.05, 0.95)
# Reset, and moves that the model does not know of: duration (s) of each turn.
CYCLES, TURN = 10, 0.5
EFFECTS = ("creep", "thermal_drift", "gain_drift", "rate_dependence", "lag", "delay")
LOWEST, HIGHEST = 0.90, 0.995
# Largest ratio of the median uncertainty to the rms error, and the share of the stages that keep it.
SHARP, MOST = 4.0, 0.9


def plant(number: int) -> tuple[str, Plant]:
    """Return name and physics of a stage."""
    names = list(STAGES)
    if number % 2:
        name = names[number // 2 % len(names)]
        return name, lambda t, v: STAGES[name].run(t, v, np.random.default_rng(number))
    rng = np.random.default_rng(number)
    effects = rng.choice(EFFECTS, size=int(rng.integers(0, 4)), replace=False).tolist()
    nature = character.draw(rng, effects, rate=RATE)
    parameters = AxisParameters.random(number)
    return ", ".join(effects) or "nothing", lambda t, v: SimulatedAxis(parameters, number, nature).run(t, v)[0]


def moves(turns: list[float], seconds: list[float]) -> FloatArray:
    """Return half cosines from turn to turn, without the first sample."""
    parts = []
    for one, other, duration in zip(turns, turns[1:], seconds, strict=False):
        phase = np.arange(1, round(duration * RATE) + 1)
        parts.append(one + (other - one) * (1.0 - np.cos(np.pi * phase / phase.size)) / 2.0)
    return np.concatenate(parts)


def path(begin: float, low: float, high: float, rng: np.random.Generator) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return time since the start (s), desired displacement (m), and number of the horizon, 1.., or 0 between them."""
    t, y, at, now = [np.array([0.0])], [np.array([begin])], [np.array([0])], 0.0
    for number, after in enumerate(HORIZONS.values(), 1):
        held = np.geomspace(0.05, after - now, 60) if after - now > 0.05 else np.array([])
        t.append(now + held)
        y.append(np.full(held.size, y[-1][-1]))
        at.append(np.zeros(held.size))
        legs = rng.uniform(*LEGS, round(2 * JUDGED / sum(LEGS))).tolist()
        turns = [float(y[-1][-1]), *(low + (high - low) * rng.uniform(*INNER, len(legs))).tolist()]
        moved = moves(turns, legs)
        t.append(after + np.arange(1, moved.size + 1) / RATE)
        y.append(moved)
        at.append(np.full(moved.size, number))
        now = float(t[-1][-1])
    return np.concatenate(t), np.concatenate(y), np.concatenate(at)


def share_and_ratio(judged: FloatArray) -> tuple[float, float]:
    """Return the share within two uncertainties, and median uncertainty by rms error, of those of shape (2, N), m."""
    error, u = judged
    return float(np.mean(np.abs(error) <= COVERAGE_FACTOR * u)), float(np.median(u) / np.sqrt(np.mean(error**2)))


def judge(number: int) -> tuple[str, dict[str, FloatArray]]:
    """Identify and diagnose a stage, drive it; return a line of text, and error and uncertainty by horizon."""
    name, physics = plant(number)
    began, rng = time.perf_counter(), np.random.default_rng([7, number])
    t, v = calibration_drive(0.0, HIGHEST_V, duration=RECORDED, rate=RATE, seed=number)
    y = physics(t, v) + NOISE_M * rng.standard_normal(t.size)
    record = Record(np.round(t * 1e9).astype(np.int64), {"x": v}, {"x": y}, source="record")
    diagnosis = slpi_ros.diagnose(record, slpi_ros.identify(record))
    found = driven(diagnosis.extended.axes["x"], physics, t, v, rng)
    said = " ".join(f"{share:9.0%} {ratio:8.1f}" for share, ratio in map(share_and_ratio, found.values()))
    share, ratio = share_and_ratio(np.hstack(list(found.values())))
    causes = ", ".join(effect.name for effect in diagnosis.extended.axes["x"].effects) or "none"
    line = f"{number:3} {name:34} {diagnosis.axes['x'].verdict:14} {causes:28} {share:5.0%} {ratio:5.1f} {said}"
    return f"{line} {time.perf_counter() - began:5.0f} s", found


def driven(
    axis: slpi_ros.AxisModel, physics: Plant, t: FloatArray, v: FloatArray, rng: np.random.Generator
) -> dict[str, FloatArray]:
    """Drive a stage by its model after its record; return error and uncertainty, shape (2, N), m, by horizon."""
    found: dict[str, FloatArray] = {}
    (low, high), limits = axis.displacement_range, Limits(*axis.voltage_range)
    for memory in STARTS:
        own = axis
        if memory == "wiped":
            before = moves([float(v[-1]), *decaying_turns(limits, 0.0, CYCLES)], [TURN] * (2 * CYCLES + 2))
        else:
            before = moves([float(v[-1]), *rng.uniform(0.1, 0.9, 7) * HIGHEST_V], [TURN] * 7)
            own = replace(axis, end=axis.after(before[-1:], "end"))
        begin = own.initial(memory).displacement
        since, desired, at = path(min(max(begin, low), high), low, high, rng)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            model = slpi_ros.StageModel({"x": own})
            volts, u = model.compensate(since, desired, start_memory=memory, uncertainty=True)
        t_before = t[-1] + np.arange(1, before.size + 1) / RATE
        whole_t = np.concatenate([t, t_before, t_before[-1] + 1 / RATE + since])
        error = physics(whole_t, np.concatenate([v, before, volts]))[-since.size :] - desired
        for place, horizon in enumerate(HORIZONS, 1):
            found[f"{STARTS[memory]} {horizon}"] = np.stack([error, u])[:, at == place]
    return found


def measured(found: dict[str, list[FloatArray]]) -> None:
    """Identify from the records of each actuator but one, and judge on the other."""
    folder = measured_folder()
    if not folder:
        return
    for name in SETS:
        records = records_of(folder, SETS[name])
        for left in list(records)[1:] if len(records) == 2 and "half" in " ".join(records) else records:
            fitted = [record for one, record in records.items() if one != left]
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    axis = next(iter(slpi_ros.identify(fitted).axes.values()))
                    judged, error = against(axis, records[left])
            except SlpiError as refusal:
                print(f"  {left:24} {refusal}")
                continue
            found["measured"].append(judged)
            share, ratio = share_and_ratio(judged)
            print(f"  {left:24} {share:5.0%} {ratio:5.1f}  error {100 * error:.2f} % of the range rms", flush=True)


def against(axis: slpi_ros.AxisModel, record: Record) -> tuple[FloatArray, float]:
    """Return error and uncertainty on a record, shape (2, N), m, and the rms error as a share of the range."""
    name = record.axes[0]
    v, y = record.voltage[name], record.displacement[name]
    known = np.isfinite(v)
    t, v, y = record.t[known], v[known], y[known]
    start = axis.initial("end")
    # The last voltage of another record is not where this one begins.
    own = replace(axis, start=replace(start, voltage=float(v[0]), history=()), end=None)
    x = own.simulate(t, v)
    judged = np.isfinite(y)
    error = (y - x)[judged]
    error -= error.mean()
    budget = AxisUncertainty(own).budget(t, x, v)
    u = np.sqrt(budget.combined[judged] ** 2 + axis.quality.floor_rms**2)
    stroke = float(np.ptp(axis.displacement_range))
    return np.stack([error, u]), float(np.sqrt(np.mean(error**2))) / stroke


def summary(found: dict[str, list[FloatArray]], stages: list[FloatArray]) -> int:
    """Print a row for each of the columns `found`, and for all paths of each of the `stages`; return the exit code."""
    for horizon in HORIZONS if stages else ():
        found[f"all {horizon}"] = [each for start in STARTS.values() for each in found[f"{start} {horizon}"]]
    if stages:
        found["stages"] = stages
    print(f"\n{'':16}{'all samples':>12}{'90 to 99.5 %':>16}{'u / error':>11}{f'at most {SHARP:g}':>16}")
    for name, those in found.items():
        shares, ratios = np.array([share_and_ratio(one) for one in those]).T
        share, count = share_and_ratio(np.hstack(those))[0], len(those)
        right = f"{np.sum((shares >= LOWEST) & (shares <= HIGHEST))} of {count}"
        sharp = f"{np.sum(ratios <= SHARP)} of {count}"
        print(f"{name:16}{share:12.1%}{right:>16}{np.median(ratios):11.1f}{sharp:>16}")
    if not stages:
        return 0
    return 0 if LOWEST <= share <= HIGHEST and np.mean(ratios <= SHARP) >= MOST else 1


def main() -> int:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--stages", type=int, default=10, help="simulated stages")
    parser.add_argument("--first", type=int, default=0, help="number of the first one")
    parser.add_argument("--without-measured", action="store_true", help="simulated stages only")
    parser.add_argument("--processes", type=int, default=2)
    options = parser.parse_args()
    found: dict[str, list[FloatArray]] = defaultdict(list)
    stages: list[FloatArray] = []
    columns = [f"{start} {horizon}" for start in STARTS.values() for horizon in HORIZONS]
    print(
        f"share within 2 u, and median u / rms error\n{'':82}{'all':>11} " + " ".join(f"{one:>18}" for one in columns)
    )
    with get_context("spawn").Pool(options.processes) as pool:
        numbers = range(options.first, options.first + options.stages)
        for line, judged in pool.imap(judge, numbers, chunksize=1):
            print(line, flush=True)
            stages.append(np.hstack(list(judged.values())))
            for column, own in judged.items():
                found[column].append(own)
    if not options.without_measured:
        print("measured records, not fitted")
        measured(found)
    return summary(found, stages)


if __name__ == "__main__":
    sys.exit(main())
