"""Errors on a path that was not recorded, for disturbed records compared with clean ones, on simulated stages.

Mean and maximum error against the true displacement, in % of the stroke; ratio to the error with the clean record, for
all seeds together and for the worst seed.
"""

import argparse
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from accuracy import NOISE, V_MAX, FloatArray, fresh, record_of
from paths import scan_path

import slpi_ros
from slpi_ros.excitation.drives import calibration_drive

PATH_SECONDS = 40.0


@dataclass(frozen=True)
class Recording:
    """Result of a calibration run.

    Parameters
    ----------
    t, v, true, measured : ndarray, shape (N,), seconds, volts and metres
        Time, voltage, true and measured displacement.
    before : ndarray, shape (M,), volts
        Voltages applied before the record began.
    """

    t: FloatArray
    v: FloatArray
    true: FloatArray
    measured: FloatArray
    before: FloatArray = field(default_factory=lambda: np.empty(0))


Spoil = Callable[[Recording, np.random.Generator, int], Recording]


def _with(recording: Recording, **changes: FloatArray) -> Recording:
    return Recording(**{**recording.__dict__, **changes})


def clean(recording: Recording, rng: np.random.Generator, seed: int) -> Recording:
    """Return the recording unchanged."""
    return recording


def outliers(recording: Recording, rng: np.random.Generator, seed: int) -> Recording:
    """Add noise to 5 % of the readings, ten times as large as the sensor noise."""
    y = recording.measured.copy()
    hit = rng.random(y.size) < 0.05
    y[hit] += rng.normal(0.0, 10 * NOISE, np.count_nonzero(hit))
    return _with(recording, measured=y)


def stale(recording: Recording, rng: np.random.Generator, seed: int) -> Recording:
    """Replace 1 % of the readings by the previous reading."""
    y = recording.measured.copy()
    hit = 1 + np.flatnonzero(rng.random(y.size - 1) < 0.01)
    y[hit] = y[hit - 1]
    return _with(recording, measured=y)


def drop_outs(recording: Recording, rng: np.random.Generator, seed: int) -> Recording:
    """Replace 2 % of the readings by NaN."""
    return _with(recording, measured=np.where(rng.random(recording.t.size) < 0.02, np.nan, recording.measured))


def coarse(recording: Recording, rng: np.random.Generator, seed: int) -> Recording:
    """Quantize displacement and voltage with 12 bits over their range."""
    y, v = (np.round(x / step) * step for x, step in ((recording.measured, 25e-6 / 4096), (recording.v, V_MAX / 4096)))
    return _with(recording, measured=y, v=v)


def jitter(recording: Recording, rng: np.random.Generator, seed: int) -> Recording:
    """Sample the displacement up to 20 % of the sampling period before or after its stamp."""
    t, period = recording.t, recording.t[1] - recording.t[0]
    true = np.interp(t + rng.uniform(-0.2, 0.2, t.size) * period, t, recording.true)
    return _with(recording, measured=true + (recording.measured - recording.true))


def unknown_memory(recording: Recording, rng: np.random.Generator, seed: int) -> Recording:
    """Move the stage to random levels before the record begins."""
    turns = np.concatenate([[0.0], rng.uniform(0.0, V_MAX, 7), [recording.v[0]]])
    before = np.interp(np.arange(0.0, 8.0, 0.02), np.arange(9), turns)
    stage = fresh(seed)
    stage.run(np.arange(before.size) * 0.02, before)
    true, measured = stage.run(before.size * 0.02 + recording.t, recording.v)
    return _with(recording, true=true, measured=measured, before=before)


def mid_loop(recording: Recording, rng: np.random.Generator, seed: int) -> Recording:
    """Begin the record in the middle of a loop of the excitation."""
    within = (recording.v > 0.2 * V_MAX) & (recording.v < 0.8 * V_MAX)
    within &= (recording.t > 0.04 * recording.t[-1]) & (recording.t < 0.15 * recording.t[-1])
    first = int(rng.choice(np.flatnonzero(within)))
    kept = slice(first, None)
    parts = {name: getattr(recording, name)[kept] for name in ("t", "v", "true", "measured")}
    return _with(recording, **parts, before=recording.v[:first])


def voltage_noise(recording: Recording, rng: np.random.Generator, seed: int) -> Recording:
    """Add noise of 0.05 % of the range to the recorded voltage."""
    return _with(recording, v=recording.v + rng.normal(0.0, 0.0005 * V_MAX, recording.v.size))


CASES: dict[str, tuple[Spoil, float]] = {
    "clean": (clean, 1.0),
    "5 % outliers, 10 x noise": (outliers, 1.5),
    "1 % stale samples": (stale, 1.5),
    "2 % drop-outs": (drop_outs, 1.5),
    "12-bit quantisation": (coarse, 2.0),
    "jitter, 20 % of period": (jitter, 1.5),
    "unknown initial memory": (unknown_memory, 1.5),
    "start in mid-loop": (mid_loop, 1.5),
    "voltage noise, 0.05 %": (voltage_noise, 1.5),
}


def recorded(seed: int, duration: float, rate: float) -> Recording:
    """Return the calibration run of the stage for a seed."""
    t, v = calibration_drive(0.0, V_MAX, duration=duration, rate=rate, seed=seed)
    return Recording(t, v, *fresh(seed).run(t, v))


def unseen_errors(recording: Recording, seed: int, rate: float, low: float, high: float) -> FloatArray:
    """Identify the stage and follow a path that was not recorded; return absolute errors as fractions of the stroke."""
    model = slpi_ros.identify(record_of(recording.t, recording.v, recording.measured))
    t, desired = scan_path(low, high, duration=PATH_SECONDS, rate=rate, seed=1000 + seed)
    stage = fresh(seed)
    before = np.append(recording.before, recording.v[0])
    stage.run(np.arange(before.size) / rate, before)
    achieved, _ = stage.run(before.size / rate + t, model.compensate(t, desired, "start"))
    share: FloatArray = np.abs(achieved - desired) / (high - low)
    return share


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=8)
    parser.add_argument("--duration", type=float, default=30.0, help="seconds of calibration drive")
    parser.add_argument("--rate", type=float, default=200.0)
    parser.add_argument("--verbose", action="store_true", help="every seed")
    options = parser.parse_args()
    print(f"{options.seeds} seeds, {options.duration:g} s of calibration, errors on unseen paths in % of stroke")
    print(f"{'':<26}  mean     max   ratio of means (worst seed)   of maxima (worst seed)  allowed")
    reference = np.empty(0)
    for name, (spoil, allowed) in CASES.items():
        found = []
        for seed in range(options.seeds):
            recording = recorded(seed, options.duration, options.rate)
            span = float(np.ptp(recording.true[recording.t > 0.2 * options.duration]))
            high = recording.true.max() - 0.02 * span
            low = recording.true.max() - 0.98 * span
            error = unseen_errors(
                spoil(recording, np.random.default_rng([seed, 7]), seed), seed, options.rate, low, high
            )
            found.append((100 * error.mean(), 100 * error.max()))
        table = np.array(found)
        reference = reference if reference.size else table
        ratio, worst = table.sum(axis=0) / reference.sum(axis=0), (table / reference).max(axis=0)
        print(
            f"{name:<26} {table[:, 0].mean():.4f}  {table[:, 1].max():.3f} {ratio[0]:16.2f} ({worst[0]:.2f})"
            f"{ratio[1]:20.2f} ({worst[1]:.2f}) {allowed:12.1f}"
        )
        if options.verbose:
            print("   " + "  ".join(f"{mean:.4f}/{most:.3f}" for mean, most in found))


if __name__ == "__main__":
    main()
