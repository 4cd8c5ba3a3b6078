"""Coverage: how often the true error lies within two standard uncertainties of the model.

Simulated stages, every other one of them of the foreign physics of ``hidden/foreign.py``, the others Preisach stages
with random effects: 30 s of calibration with 8 nm of noise give a model, identified and diagnosed. Then the stage is
driven by the model along random paths, without feedback, at the horizons 1 s, 1 min and 1 h, in two ways: after a reset
at the end of the record, and after moves that the model does not know of. The error is where the stage is minus the
desired displacement, its offset included, without noise.

Measured records: a loop family is identified from all records of an actuator but one, or from the first half of a
single one, and simulated along the other. The error is that without the constant offset of the record, whose zero is
arbitrary, and the noise of the sensor counts to its uncertainty. SLPI_MEASURED_DATA gives the folder.

A row passes from 90 to 99 %. The exit code is 1 if the simulated stages together are outside.
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
LOWEST, HIGHEST = 0.90, 0.99


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


def judge(number: int) -> tuple[str, dict[str, FloatArray]]:
    """Identify and diagnose a stage, drive it; return a line of text, and ratios of error to uncertainty by horizon."""
    found: dict[str, FloatArray] = {}
    name, physics = plant(number)
    began, rng = time.perf_counter(), np.random.default_rng([7, number])
    t, v = calibration_drive(0.0, HIGHEST_V, duration=RECORDED, rate=RATE, seed=number)
    y = physics(t, v) + NOISE_M * rng.standard_normal(t.size)
    record = Record(np.round(t * 1e9).astype(np.int64), {"x": v}, {"x": y}, source="record")
    diagnosis = slpi_ros.diagnose(record, slpi_ros.identify(record))
    model = diagnosis.extended
    axis = model.axes["x"]
    (low, high), limits = axis.displacement_range, Limits(*axis.voltage_range)
    said = []
    for memory in STARTS:
        if memory == "wiped":
            before = moves([float(v[-1]), *decaying_turns(limits, 0.0, CYCLES)], [TURN] * (2 * CYCLES + 2))
        else:
            before = moves([float(v[-1]), *rng.uniform(0.1, 0.9, 6) * HIGHEST_V, float(v[-1])], [TURN] * 7)
        begin = axis.initial(memory).displacement
        since, desired, at = path(min(max(begin, low), high), low, high, rng)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            volts, u = model.compensate(since, desired, start_memory=memory, uncertainty=True)
        t_before = t[-1] + np.arange(1, before.size + 1) / RATE
        whole_t = np.concatenate([t, t_before, t_before[-1] + 1 / RATE + since])
        reached = physics(whole_t, np.concatenate([v, before, volts]))[-since.size :]
        ratio = np.abs(reached - desired) / u
        for place, horizon in enumerate(HORIZONS, 1):
            own = ratio[at == place]
            found[f"{STARTS[memory]} {horizon}"] = own
            error, spread = (reached - desired)[at == place], u[at == place]
            said.append(
                f"{np.mean(own <= COVERAGE_FACTOR):5.0%} ({1e9 * np.sqrt(np.mean(error**2)):.0f}/"
                f"{1e9 * np.sqrt(np.mean(spread**2)):.0f})"
            )
    causes = ", ".join(effect.name for effect in axis.effects) or "none"
    line = f"{number:3} {name:34} {diagnosis.axes['x'].verdict:14} {causes:28} " + " ".join(
        f"{one:>18}" for one in said
    )
    return f"{line} {time.perf_counter() - began:5.0f} s", found


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
                    ratio, error, u = against(axis, records[left])
            except SlpiError as refusal:
                print(f"  {left:24} {refusal}")
                continue
            found["measured"].append(ratio)
            print(
                f"  {left:24} {np.mean(ratio <= COVERAGE_FACTOR):5.0%}  error {100 * error:.2f} % of the range rms, "
                f"uncertainty {100 * u:.2f} %",
                flush=True,
            )


def against(axis: slpi_ros.AxisModel, record: Record) -> tuple[FloatArray, float, float]:
    """Return the ratios of error to uncertainty on a record, and the rms of both as shares of the range."""
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
    return np.abs(error) / u, float(np.sqrt(np.mean(error**2))) / stroke, float(np.sqrt(np.mean(u**2))) / stroke


def main() -> int:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--stages", type=int, default=10, help="simulated stages")
    parser.add_argument("--first", type=int, default=0, help="number of the first one")
    parser.add_argument("--without-measured", action="store_true", help="simulated stages only")
    parser.add_argument("--processes", type=int, default=2)
    options = parser.parse_args()
    found: dict[str, list[FloatArray]] = defaultdict(list)
    columns = [f"{start} {horizon}" for start in STARTS.values() for horizon in HORIZONS]
    print(f"share within 2 u (rms error / rms u, nm)\n{'':82}" + " ".join(f"{one:>18}" for one in columns))
    with get_context("spawn").Pool(options.processes) as pool:
        numbers = range(options.first, options.first + options.stages)
        for line, ratios in pool.imap(judge, numbers, chunksize=1):
            print(line, flush=True)
            for column, own in ratios.items():
                found[column].append(own)
    if not options.without_measured:
        print("measured records, not fitted")
        measured(found)
    print(f"\n{'':16}{'all samples':>12}{'stages within':>15}")
    simulated = [each for name, those in found.items() if name != "measured" for each in those]
    rows = dict(found)
    for horizon in HORIZONS if simulated else ():
        rows[f"all {horizon}"] = [each for start in STARTS.values() for each in found[f"{start} {horizon}"]]
    rows |= {"simulated": simulated} if simulated else {}
    for name, those in rows.items():
        share = float(np.mean(np.concatenate(those) <= COVERAGE_FACTOR))
        within = sum(np.mean(one <= COVERAGE_FACTOR) >= LOWEST for one in those)
        print(f"{name:16}{share:12.1%}{within:8} of {len(those)}{'' if LOWEST <= share <= HIGHEST else '  OUTSIDE'}")
    share = float(np.mean(np.concatenate(simulated) <= COVERAGE_FACTOR)) if simulated else LOWEST
    return 0 if LOWEST <= share <= HIGHEST else 1


if __name__ == "__main__":
    sys.exit(main())
