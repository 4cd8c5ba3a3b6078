"""The rate law: round trips over random laws and paths, its cost, and what it predicts of the NTNU records.

The measured part fits 20 and 40 Hz and judges 100 Hz, each record also from the other one alone. Errors are those of a
free run in % of the stroke, without the constant offset of the record; "moving" begins with the first cycle, "hold" is
the standstill before it. The environment variable SLPI_MEASURED_DATA gives the folder of the measured data.
"""

import argparse
import os
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from engine import EFFECTS, RATE, SPAN, axis_model, loop_family, zigzag
from numpy.typing import NDArray
from scipy.optimize import least_squares

import slpi_ros
from slpi_ros.effects.base import EffectContext
from slpi_ros.effects.chain import Chain
from slpi_ros.effects.filters import Mode
from slpi_ros.effects.rate_dependence import RateDependence
from slpi_ros.effects.resonance import Resonance
from slpi_ros.hysteresis.prandtl_ishlinskii import PrandtlIshlinskii
from slpi_ros.io.record import Record
from slpi_ros.io.tables import import_table
from slpi_ros.model.axis_model import AxisModel, Start

FloatArray = NDArray[np.float64]
# Change of the voltage (V) that ends the hold; frequencies (Hz) of the drives; time (s) at which each starts.
MOVES, CYCLES = 0.02, {"20hz": 20.0, "40hz": 40.0, "100hz": 100.0}
START_S = 1.35


def draws(count: int, seed: int) -> None:
    """Print the largest errors over random laws, hystereses, paths and steps of time."""
    rng = np.random.default_rng(seed)
    worst = {"round trip": 0.0, "streaming - batch": 0.0, "voltage of a displacement": 0.0}
    worse = 0
    for _ in range(count):
        axis = _random_axis(rng)
        size = int(rng.integers(20, 120))
        t = np.cumsum(10.0 ** rng.uniform(-4.0, 0.0, size))
        v = np.clip(50.0 + np.cumsum(rng.normal(0.0, 10.0 ** rng.uniform(-1.0, 1.3), size)), 0.0, SPAN)
        v[0] = axis.start.voltage
        y = axis.simulate(t, v)
        back, _ = axis.command(t, y, start_memory="start")
        stream = axis.stream(start_memory="start")
        streamed = np.array([stream.step(*each) for each in zip(t.tolist(), y.tolist(), strict=True)])
        # Desired displacement to voltage and back, over the mean slope of the hysteresis. The voltage itself is less
        # certain: in a short step, digits of the displacement are the whole way of the hysteresis.
        slope = float(np.ptp(axis.hysteresis_only.simulate(t[:3], np.array([0.0, SPAN, 0.0])))) / SPAN
        for name, error in (
            ("round trip", (axis.simulate(t, back) - y) / slope),
            ("streaming - batch", streamed - back),
            ("voltage of a displacement", back - v),
        ):
            worst[name] = max(worst[name], float(np.abs(error).max()))
        # A desired path of the bare hysteresis: with the law it is met at least as well as without.
        desired = axis.hysteresis_only.simulate(t, v)
        errors = [
            float(np.std(axis.simulate(t, one.command(t, desired, start_memory="start")[0]) - desired))
            for one in (axis, axis.hysteresis_only)
        ]
        worse += errors[0] > errors[1] + 1e-15
    print(f"{count} random laws, hystereses, paths and steps of time from 0.1 ms to 1 s (seed {seed}):")
    print("  " + ", ".join(f"{name} at most {value:.1e} V" for name, value in worst.items()), end="; ")
    print(f"worse than without the law in {worse} draws", flush=True)


def _random_axis(rng: np.random.Generator) -> AxisModel:
    """Return a loop family or PI model with a random rate law; the command is bounded 2,000 V beyond the paths."""
    if rng.random() < 0.5:
        shape, kind = loop_family(int(rng.integers(5, 42))), "slpi"
    else:
        thresholds = np.append(0.0, np.sort(rng.uniform(0.1, 60.0, 12)))
        shape, kind = PrandtlIshlinskii(thresholds, 1e-7 * rng.uniform(0.02, 1.0, 13)), "pi"
    gain = 10.0 ** rng.uniform(-9.0, -7.0) if rng.random() < 0.8 else 0.0
    law = RateDependence(10.0 ** rng.uniform(-2.0, 0.7), 10.0 ** rng.uniform(-2.0, 4.0), gain)
    axis = replace(
        axis_model(np.zeros(2), (law,)), kind=kind, hysteresis=shape, start=Start(float(rng.uniform(0.0, SPAN)), 0.0)
    )
    return replace(axis, voltage_range=(-2e3, 2e3), displacement_range=(-1e-3, 1e-3))


def costs(samples: int = 200_000) -> None:
    """Print the processor time with the law, relative to the bare engine, in batch, and what it adds in streaming."""
    v = zigzag(samples, samples // 200)
    t = np.arange(samples) / RATE
    bare = replace(axis_model(np.zeros(2)), voltage_range=(-SPAN, 2 * SPAN), displacement_range=(-1e-3, 1e-3))
    law = replace(bare, effects=EFFECTS["rate law"])
    y = bare.simulate(t, v)

    def least(run: Callable[[], object]) -> float:
        times = []
        for _ in range(7):
            began = time.process_time()
            run()
            times.append(time.process_time() - began)
        return min(times)

    inverse = [least(lambda axis=axis: axis.command(t, y)) for axis in (bare, law)]
    forward = [least(lambda axis=axis: axis.simulate(t, v)) for axis in (bare, law)]
    steps = list(zip(t.tolist(), y.tolist(), strict=True))[:50_000]

    def stream(axis: AxisModel) -> None:
        step = axis.stream().step
        for sample in steps:
            step(*sample)

    streamed = [1e6 * least(lambda axis=axis: stream(axis)) / len(steps) for axis in (bare, law)]
    print(f"cost with the law over the bare engine, {samples} samples, 200 turns, least of 7:", end=" ")
    print(f"batch inverse {inverse[1] / inverse[0]:.1f}, forward {forward[1] / forward[0]:.1f}; ", end="")
    print(
        f"streaming {streamed[0]:.2f} -> {streamed[1]:.2f} us a sample ({streamed[1] - streamed[0]:+.2f})", flush=True
    )


@dataclass(frozen=True)
class Judged:
    """Free run of a model: time (s), measured - predicted (m), predicted (m), stroke (m), start of motion (s)."""

    t: FloatArray
    error: FloatArray
    predicted: FloatArray
    stroke: float
    moves: float

    @classmethod
    def of(cls, axis: AxisModel, record: Record) -> "Judged":
        """Return the run with the lowest error over the possible initial states, a lead of the law before it included.

        Both belong to the record: where the memory was, and how long ago the step before its hold.
        """
        (name,) = record.axes
        t, v, y = record.t, record.voltage[name], record.displacement[name]
        moves = float(t[np.flatnonzero(np.abs(v - v[0]) > MOVES)[0]])
        runs = [one.simulate(t, v, of_record=True) for one in _beginnings(axis, float(v[0]))]
        best = min(runs, key=lambda run: float(np.std(y - run)))
        return cls(t, y - best - np.mean(y - best), best, float(np.ptp(y)), moves)

    def percent(self, chosen: NDArray[np.bool_] | None = None) -> float:
        """Return the rms, % of the stroke, of chosen samples, about the mean of the whole record."""
        error = self.error if chosen is None else self.error[chosen]
        return 100.0 * float(np.sqrt(np.mean(error**2))) / self.stroke

    def __str__(self) -> str:
        moving = self.t >= self.moves
        hold = 100.0 * float(np.std(self.error[~moving])) / self.stroke
        return f"{self.percent():.3f} (moving {self.percent(moving):.3f}, hold {hold:.3f})"


def _beginnings(axis: AxisModel, v0: float) -> list[AxisModel]:
    laws = [effect for effect in axis.effects if isinstance(effect, RateDependence)]
    leads = {lead for law in laws for lead in law.initial} | {0.0}
    found = []
    for history in dict.fromkeys(((), (v0,), axis.start.history)):
        for lead in leads:
            effects = tuple(replace(one, initial=(lead,)) if one in laws else one for one in axis.effects)
            found.append(replace(axis, start=Start(v0, 0.0, history), effects=effects))
    return found


def measured(folder: Path) -> None:
    """Print what is found on 20 and 40 Hz of both days, and the errors of each record from the others."""
    for day in ("ntnu2", "ntnu"):
        records = {
            name: import_table(folder / f"{day}_{name}.csv")
            for name in CYCLES
            if (folder / f"{day}_{name}.csv").is_file()
        }
        print(f"\n{day}: rms in % of the stroke")
        model = _found(records, ("20hz", "40hz"))
        for name, record in records.items():
            print(f"  {name:6} {'fitted' if name != '100hz' else 'never fitted':13} {Judged.of(model, record)}")
        for fitted, judged in (("20hz", "40hz"), ("40hz", "20hz")):
            other = _refitted(model, records[fitted])
            print(f"  {judged:6} {'from ' + fitted:13} {Judged.of(other, records[judged])}")
        if "100hz" in records:
            _with_mode(model, records)
            model = _found(records, tuple(records))
            for name, record in records.items():
                print(f"  {name:6} fitted        {Judged.of(model, record)}", flush=True)


def _found(records: dict[str, Record], fitted: Sequence[str]) -> AxisModel:
    chosen = [records[name] for name in fitted]
    began = time.perf_counter()
    diagnosis = slpi_ros.diagnose(chosen, slpi_ros.identify(chosen))
    ((axis, found),) = diagnosis.axes.items()
    print(f"  fitted to {', '.join(fitted)}: {found.verdict}, {time.perf_counter() - began:.0f} s")
    for one in found.effects:
        numbers = ", ".join(f"{name} +- {spread:.2g}" for name, spread in one.effect.uncertainty.items())
        print(f"    {one.name} (or {', '.join(one.alternatives) or 'none'}): {one.effect.describe()} [{numbers}]")
    return diagnosis.extended.axes[axis]


def _refitted(model: AxisModel, record: Record) -> AxisModel:
    """Return the hysteresis fitted to one record alone, under the effects of the model."""
    (axis,) = record.axes
    t, v, y = record.t, record.voltage[axis], record.displacement[axis]
    # The leads of the law at the start, whatever the memory was: that is fitted anew.
    beginnings = [one for one in _beginnings(model, float(v[0])) if one.start.history == model.start.history]

    def fitted(one: AxisModel) -> AxisModel:
        around = EffectContext(t)
        _, u, _ = Chain.of(one.effects).reaching(v, around)
        h = y - (one.simulate(t, v, of_record=True) - one.hysteresis_only.simulate(t, u))
        felt = Record(record.time_ns, {axis: u}, {axis: h}, source=record.source)
        return replace(slpi_ros.identify(felt).axes[axis], effects=one.effects)

    return min((fitted(one) for one in beginnings), key=lambda one: Judged.of(one, record).percent())


def _with_mode(model: AxisModel, records: dict[str, Record]) -> None:
    """Fit a mode to the first half of the motion at 100 Hz, and judge the second half with it.

    All other parameters are those found at 20 and 40 Hz. The three drives are the same path. What the slower records
    leave at the same place of the path is the hysteresis' own error: it is taken out of the fit, not out of the
    judgement.
    """
    fast = Judged.of(model, records["100hz"])
    place = (fast.t - START_S) * CYCLES["100hz"]
    common = np.zeros_like(place)
    for name in ("20hz", "40hz"):
        slow = Judged.of(model, records[name])
        common += 0.5 * np.interp(place, (slow.t - START_S) * CYCLES[name], slow.error) * (place >= 0.0)
    moving, half = fast.t >= fast.moves, 0.5 * (fast.moves + float(fast.t[-1]))
    first, second = moving & (fast.t < half), fast.t >= half
    around = EffectContext(fast.t)

    def left(values: FloatArray, known: FloatArray | float) -> FloatArray:
        mode, path = Resonance((Mode(*values.tolist()),)), fast.predicted + known
        error = fast.error - known - (mode.apply(path, around) - path)
        return np.asarray(100.0 * (error - np.mean(error[first])) / fast.stroke)

    fits = [
        least_squares(
            lambda values: left(values, common)[first],
            (frequency, 0.02, 0.5),
            bounds=([300.0, 1e-3, 0.0], [1500.0, 0.4, 1.0]),
            x_scale=(50.0, 0.02, 0.2),
        )
        for frequency in (600.0, 700.0, 750.0, 850.0)
    ]
    frequency, damping, gain = (best := min(fits, key=lambda fit: fit.cost)).x
    print(
        f"  100hz  mode from the first half of its motion: {frequency:.0f} Hz, damping {damping:.3f}, gain {gain:.2f}"
    )
    for name, part in (("first half, fitted", first), ("second half, never fitted", second)):
        error = left(best.x, 0.0)[part]
        without = 100.0 * float(np.std(fast.error[part])) / fast.stroke
        print(f"         {name:26} {np.std(error):.3f} with the mode, {without:.3f} without it", flush=True)


def main() -> None:
    """Print all three parts."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--draws", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    draws(options.draws, options.seed)
    costs()
    folder = Path(os.environ.get("SLPI_MEASURED_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
    if folder.is_dir():
        measured(folder)
    else:
        print("no measured data: set SLPI_MEASURED_DATA to its folder")


if __name__ == "__main__":
    main()
