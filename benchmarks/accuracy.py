"""Errors on a path that was not recorded, on simulated stages (Preisach) of another type than the identified models.

Mean and maximum error against the true displacement, in % of the stroke, compared with a classical PI model of the same
record. The mean errors are compared with and without the constant offset of each model, and the smaller ratio counts,
because an offset of the classical PI model says nothing about its loops.
"""

import argparse
from dataclasses import replace

import kept
import numpy as np
from numpy.typing import NDArray
from paths import scan_path

import slpi_ros
from slpi_ros.excitation.drives import calibration_drive
from slpi_ros.simulation.axis import SimulatedAxis
from slpi_ros.simulation.parameters import AxisParameters

FloatArray = NDArray[np.float64]
V_MAX = 100.0
NOISE = 8e-9


def fresh(seed: int) -> SimulatedAxis:
    """Return the stage for a seed, never moved before."""
    return SimulatedAxis(replace(AxisParameters.random(seed), noise_rms=NOISE), seed)


def record_of(t: FloatArray, v: FloatArray, y: FloatArray) -> slpi_ros.Record:
    """Return a record of one axis."""
    return slpi_ros.Record(np.round(t * 1e9).astype(np.int64), {"x": v}, {"x": y}, "calibration")


def calibrated(seed: int, duration: float, rate: float) -> tuple[slpi_ros.Record, float, float]:
    """Return the calibration record for a seed, displacement (m) at 0 V after it, and maximum displacement (m)."""
    stage = fresh(seed)
    t, v = calibration_drive(0.0, V_MAX, duration=duration, rate=rate, seed=seed)
    true, measured = stage.run(t, v)
    low = stage.run(np.array([t[-1] + 1.0]), np.array([0.0]))[0][0]
    return record_of(t, v, measured), float(low), float(true.max())


def errors(model: slpi_ros.StageModel, seed: int, low: float, high: float, duration: float, rate: float) -> FloatArray:
    """Follow a path that was not recorded, with voltages of the model; return the errors as fractions of the stroke."""
    t, desired = scan_path(low, high, duration=duration, rate=rate, seed=1000 + seed)
    achieved, _ = fresh(seed).run(t, model.compensate(t, desired, "start"))
    share: FloatArray = (achieved - desired) / (high - low)
    return share


def smaller_ratio(errors: FloatArray, of_baseline: FloatArray) -> float:
    """Return the ratio of the mean errors, with or without the constant offsets of both, whichever is smaller."""
    sizes = [[float(np.mean(np.abs(e - offset))) for offset in (0.0, np.median(e))] for e in (errors, of_baseline)]
    return min(theirs / ours for ours, theirs in zip(*sizes, strict=True))


def below_remanence(model: slpi_ros.StageModel, seed: int, low: float, high: float, rate: float) -> tuple[float, float]:
    """Return the mean errors in the second half of a path, with and without an excursion below the reachable range."""
    t, desired = scan_path(low, high, duration=20.0, rate=rate, seed=2000 + seed)
    excursion = desired.copy()
    middle = slice(desired.size // 4, desired.size // 2)
    excursion[middle] = low - 0.1 * (high - low) * np.sin(np.linspace(0.0, np.pi, excursion[middle].size))
    means = []
    for path in (excursion, desired):
        v, _ = model.axes["x"].compensate(t, path, start_memory="start")
        achieved, _ = fresh(seed).run(t, v)
        half = desired.size // 2 + int(rate)
        means.append(float(np.mean(np.abs(achieved - path)[half:]) / (high - low)))
    return means[0], means[1]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--duration", type=float, default=60.0, help="seconds of calibration drive")
    parser.add_argument("--rate", type=float, default=200.0)
    parser.add_argument("--keep", action="store_true", help=f"write the figures to {kept.KEPT.name}")
    options, _ = parser.parse_known_args()
    print(f"{options.duration:g} s of calibration, {NOISE * 1e9:g} nm noise, errors in % of stroke")
    print("seed   slpi mean    max     pi mean    max   ratio   after an excursion below reach (without it)")
    columns = []
    for seed in range(options.seeds):
        record, low, high = calibrated(seed, options.duration, options.rate)
        margin = 0.02 * (high - low)
        low, high = low + margin, high - margin
        models = {kind: slpi_ros.identify(record, kind) for kind in ("slpi", "pi")}
        found = {kind: errors(model, seed, low, high, 40.0, options.rate) for kind, model in models.items()}
        (a, b), (c, d) = ((100 * np.abs(e).mean(), 100 * np.abs(e).max()) for e in (found["slpi"], found["pi"]))
        columns.append((a, b, c, d))
        ratio = smaller_ratio(found["slpi"], found["pi"])
        after, without = below_remanence(models["slpi"], seed, low - margin, high, options.rate)
        print(f"{seed:4d} {a:11.4f} {b:6.3f} {c:11.3f} {d:6.2f} {ratio:7.0f} {100 * after:14.4f} ({100 * without:.4f})")
    if options.keep:
        least, most = np.min(columns, axis=0), np.max(columns, axis=0)
        what = (
            f"{options.seeds} simulated stages, mean and maximum absolute error on a new path, % of stroke; the same "
            "with PI"
        )
        spans = [
            f"{low:.{digits}f}-{high:.{digits}f} %" for low, high, digits in zip(least, most, (3, 2, 2, 1), strict=True)
        ]
        said = [f"{spans[0]} / {spans[1]}", f"{spans[2]} / {spans[3]}"]
        kept.write_row("accuracy", what, "; ".join(said), "make bench")


if __name__ == "__main__":
    main()
