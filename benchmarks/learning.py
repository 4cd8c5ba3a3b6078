"""Paths that repeat on stages whose physics is not the model's: learning, beside feedforward, feedback, and others.

Each stage has hysteresis of ``hidden/foreign.py`` (thermally activated relays, Maxwell slip, moving Preisach), creep, a
lag, a flexure mode of 150 to 900 Hz with damping 0.005 to 0.05, and drift; its sensor has 2 to 20 nm of noise. The
model is identified from records of its own (two calibrations, and the drive that shows a resonance, as the how-to of
paths that repeat asks for), with what ``slpi diagnose`` finds; nothing of the stage is given. Then it follows one path
again and again:

- ``feedforward``: the inverse alone;
- ``PI``: the inverse and feedback with the best of several gains;
- ``line``: a straight line in place of the inverse; the error of each pass is added to the path of the next one,
  low-passed without a phase, with the best of several gains and bandwidths (as digital linearization does);
- ``inverse``: the same through the inverse;
- ``learner``: `slpi_ros.Learner`.

Printed is the **true** error, rms in nm, without the mean of the pass and (but for feedback, which sees it) the drift
of the stage: of the first pass, and after 5 and `--passes` passes; the best gains are those with the least error after
the last pass. Marks: ``NOISE`` where the last pass is above the sensor's noise, ``TENTH`` where it is above a tenth of
the first although there was room, ``LINE`` where after 5 passes it is above a third of ``line``, and ``HARM`` where a
pass is more than a tenth worse than the first one and than the sensor's noise; ``(alone too)`` where the inverse alone
is as bad in one of the same passes (the first one comes from rest: a mode that rings, and creep, come later).
"""

import argparse
import math
import sys
import time
import warnings
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import kept
import numpy as np
from hidden import foreign
from numpy.typing import NDArray
from scipy.signal import cont2discrete, lfilter

import slpi_ros
from slpi_ros.excitation.drives import CALIBRATION, excite
from slpi_ros.io.record import Record

FloatArray = NDArray[np.float64]

RATE_HZ, HIGHEST_V = 4000.0, 100.0
KINDS = {
    "relays": foreign.ThermalRelays(relays=900),
    "Maxwell": foreign.MaxwellSlip(),
    # Those that switch at the turns of a path are not the same in every pass, and make a light mode ring: of a few
    # thousand, by more than the noise of a good sensor.
    "Preisach": foreign.MovingPreisach(relays=120_000),
}
# Drives of the records that a stage is identified from, and their durations (s).
RECORDS = ((CALIBRATION, 4.0), (CALIBRATION, 0.6), ("resonance", 2.0))
# Gains and bandwidths (Hz) of learning without a model of the dynamics; gains of the feedback, proportional and
# integral (1/s).
FIXED = [(gain, band) for gain in (0.3, 0.6, 1.0) for band in (40.0, 100.0, 250.0)]
PI = [(p, i) for p in (0.0, 0.2) for i in (20.0, 80.0, 250.0)]
METHODS = ("PI", "line", "inverse")
# Passes with feedback, and the most samples of them.
FEEDBACK_PASSES, MOST_SAMPLES = 5, 30_000
PATHS = ("raster 1", "raster 5", "raster 20", "raster 40", "raster f/10", "sine", "steps", "free")
# The path of the row that `--keep` writes.
KEPT_PATH = "raster 20"
# Of steps: levels, as shares of half the path; rise (s), time constants of the mode until they count, and how long they
# count then (s).
LEVELS, RISE_S, SETTLING, COUNTED_S = (0.6, -0.4, 0.9, -0.8, 0.0), 0.02, 5.0, 0.04
# Share of the stroke that a path covers, and by what it is made smaller where the voltages would not leave room.
SHARE, SMALLER, ROOM = 0.6, 0.8, 0.05


@dataclass(frozen=True)
class Specimen:
    """One stage: its class, its seed, and what is around the hysteresis."""

    kind: str
    seed: int
    frequency: float  # Hz, of the flexure mode
    damping: float
    lag: float  # s
    creep: float  # share of the displacement per decade
    drift: float  # m/s
    noise: float  # m

    @classmethod
    def draw(cls, seed: int) -> "Specimen":
        """Draw the stage of a seed."""
        rng = np.random.default_rng([48, seed])

        def between(low: float, high: float) -> float:
            return float(np.exp(rng.uniform(np.log(low), np.log(high))))

        kind = list(KINDS)[seed % len(KINDS)]
        drift = float(rng.choice([0.0, 1.0])) * between(1e-9, 2e-8)
        return cls(kind, seed, between(150, 900), between(0.005, 0.05), between(1e-4, 1.5e-3), between(2e-3, 1.5e-2),
                   drift, between(2e-9, 20e-9))  # fmt: skip

    @property
    def settling(self) -> int:
        """Samples in which the mode settles."""
        return round(SETTLING / (self.damping * 2.0 * np.pi * self.frequency) * RATE_HZ)


class Stage:
    """A running stage: voltages in, displacement out, piece by piece."""

    def __init__(self, specimen: Specimen, v0: float = 0.0) -> None:
        self.specimen, dt = specimen, 1.0 / RATE_HZ
        self._hysteresis = KINDS[specimen.kind].begin(v0, np.random.default_rng(specimen.seed))
        w = 2.0 * np.pi * specimen.frequency
        lag = cont2discrete(([1.0], [specimen.lag, 1.0]), dt, method="foh")
        mode = cont2discrete(([w * w], [1.0, 2.0 * specimen.damping * w, w * w]), dt, method="foh")
        # Creep: a relaxation in each half decade from 10 ms to 10 s.
        times = 10.0 ** np.arange(-2.0, 1.01, 0.5)
        creeps = [cont2discrete(([0.5 * specimen.creep], [tau, 1.0]), dt, method="foh") for tau in times]
        self._lag, self._mode, self._creep = [lag[:2]], [mode[:2]], [each[:2] for each in creeps]
        settled = self._hysteresis(np.array([1.0]), np.array([v0]))[0]
        gains = 1.0 + 0.5 * specimen.creep * len(times)
        self._states = {
            "lag": [_settled(self._lag[0], v0)],
            "creep": [_settled(each, settled) for each in self._creep],
            "mode": [_settled(self._mode[0], settled * gains)],
        }
        self.t = 0.0

    def run(self, v: FloatArray) -> FloatArray:
        """Return the displacement (m, (N,)) for voltages (V, (N,))."""
        v = self._through("lag", self._lag, v)
        x = self._hysteresis(np.full(v.size, 1.0 / RATE_HZ), v)
        x = x + self._through("creep", self._creep, x)
        x = self._through("mode", self._mode, x)
        t = self.t + (1.0 + np.arange(v.size)) / RATE_HZ
        self.t = float(t[-1])
        return x + self.specimen.drift * t

    def _through(self, name: str, filters: list[tuple[FloatArray, FloatArray]], x: FloatArray) -> FloatArray:
        out = np.zeros(x.size)
        for k, (numerator, denominator) in enumerate(filters):
            y, self._states[name][k] = lfilter(np.ravel(numerator), denominator, x, zi=self._states[name][k])
            out += y
        return out


def _settled(system: tuple[FloatArray, FloatArray], value: float) -> FloatArray:
    """Return the state of a filter at rest at an input."""
    from scipy.signal import lfilter_zi

    return np.asarray(lfilter_zi(np.ravel(system[0]), system[1]) * value)


def identified(specimen: Specimen, kept: Path | None) -> slpi_ros.StageModel:
    """Return the model with causes of a stage, identified from its own records; `kept`: folder of earlier models."""
    file = kept / f"{specimen.seed}.json" if kept else None
    if file and file.exists():
        return slpi_ros.load_model(file)
    records = records_of(specimen)
    model = slpi_ros.diagnose(records, slpi_ros.identify(records)).extended
    if file:
        slpi_ros.save_model(model, file)
    return model


def records_of(specimen: Specimen) -> list[Record]:
    """Return the records from which a stage is identified."""
    noise, records = np.random.default_rng([7, specimen.seed]), []
    for number, (drive, duration) in enumerate(RECORDS):
        driven = excite(
            voltage_min=0.0, voltage_max=HIGHEST_V, duration=duration, rate=RATE_HZ, seed=10 * specimen.seed + number,
            drive=drive,
        )  # fmt: skip
        v = driven.voltage["x"]
        x = Stage(specimen).run(v)
        time_ns = np.round((3600.0 * number + np.arange(v.size) / RATE_HZ) * 1e9).astype(np.int64)
        y = x + specimen.noise * noise.standard_normal(x.size)
        records.append(Record(time_ns, {"x": v}, {"x": y}, source=f"record {number + 1}"))
    return records


def path_of(name: str, specimen: Specimen, axis: slpi_ros.AxisModel) -> FloatArray:
    """Return one pass (m, (N,)) of a path, within the range of the stage and of its voltages."""
    share = SHARE
    while not _within(path := _path_of(name, specimen, axis, share), axis):
        share *= SMALLER
    return path


def _within(path: FloatArray, axis: slpi_ros.AxisModel) -> bool:
    """Return whether the voltages of the inverse leave a share of their range for a correction."""
    lead = np.linspace(axis.start.displacement, path[0], round(0.5 * RATE_HZ))
    asked = np.concatenate([lead, path, path])
    v = axis.stream(start_memory="start").run(np.arange(asked.size) / RATE_HZ, asked)[0][lead.size :]
    low, high = axis.voltage_range
    return bool(v.min() > low + ROOM * (high - low) and v.max() < high - ROOM * (high - low))


def _path_of(name: str, specimen: Specimen, axis: slpi_ros.AxisModel, share: float) -> FloatArray:
    low, high = axis.displacement_range
    middle, half = 0.5 * (low + high), 0.5 * share * (high - low)
    if name == "steps":
        rise, counted = round(RISE_S * RATE_HZ), round(COUNTED_S * RATE_HZ)
        edges = np.repeat(LEVELS, rise + specimen.settling + counted)
        window = np.hanning(rise + 1)
        return middle + half * np.convolve(np.pad(edges, (rise, 0), "wrap"), window / window.sum(), "valid")
    if name == "free":
        rng, n = np.random.default_rng([5, specimen.seed]), round(0.8 * RATE_HZ)
        x = np.fft.irfft(np.fft.rfft(rng.standard_normal(n)) * (np.fft.rfftfreq(n, 1 / RATE_HZ) < 12.0), n)
        x = x / np.abs(x).max() * np.sin(np.pi * np.arange(n) / n)
        return middle + half * x + 0.4 * half * (np.arange(n) / n - 0.5)
    hertz = {"sine": 15.0, "raster f/10": 0.1 * specimen.frequency}.get(name) or float(name.split()[1])
    n = round(RATE_HZ / hertz)
    if name == "sine":
        return middle - half * np.cos(2.0 * np.pi * np.arange(n) / n)
    # Turns that are rounded over a few per cent of the period, as every scanner's are.
    spectrum = np.fft.rfft(2.0 * np.abs(2.0 * np.arange(n) / n - 1.0) - 1.0)
    return middle - half * np.fft.irfft(spectrum * np.exp(-((0.08 * np.arange(spectrum.size)) ** 2)), n)


class Run:
    """Passes of one path on one stage, through the inverse of the model, or through a straight line."""

    def __init__(
        self, specimen: Specimen, axis: slpi_ros.AxisModel, desired: FloatArray, *, straight: bool = False
    ) -> None:
        self.specimen, self.desired, self.stage = specimen, desired, Stage(specimen)
        self.range = axis.displacement_range
        self._line = (self.range, axis.voltage_range) if straight else None
        self.stream = axis.stream(start_memory="start")
        self._noise = np.random.default_rng([3, specimen.seed])
        self._at = 0.0
        rest = self.stream.uncoupled_displacement
        lead = 0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, round(0.5 * RATE_HZ)))
        self.closed = abs(desired[0] - desired[-1]) < 1e-7
        self.follow(rest + (desired[0] - rest) * lead)

    def follow(self, path: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return voltage (V), true displacement without drift, and measured one (m), (N,), for a path (m, (N,))."""
        v = np.empty(path.size)
        if self._line:
            v = np.interp(path, *self._line)
        else:
            for k, y in enumerate(path.tolist()):
                self._at += 1.0 / RATE_HZ
                v[k] = self.stream.step(self._at, y)
        x = self.stage.run(v)
        y = x + self.specimen.noise * self._noise.standard_normal(x.size)
        t = self.stage.t + (1.0 + np.arange(-x.size, 0)) / RATE_HZ
        return v, x - self.specimen.drift * t, y

    def back(self) -> None:
        """Lead a path that does not close back to its beginning."""
        if not self.closed:
            share = 0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, round(0.3 * RATE_HZ)))
            self.follow(self.desired[-1] + (self.desired[0] - self.desired[-1]) * share)

    def feedback(self, proportional: float, integral: float) -> FloatArray:
        """Return the true displacement (m, (N,)) of a pass with feedback on the path."""
        true, correction, total, read = np.empty(self.desired.size), 0.0, getattr(self, "_total", 0.0), None
        for k, y in enumerate(self.desired.tolist()):
            if read is not None:
                error = self.desired[k - 1] - read
                total += integral / RATE_HZ * error
                correction = float(np.clip(proportional * error + total, -5e-6, 5e-6))
            self._at += 1.0 / RATE_HZ
            true[k] = self.stage.run(np.array([self.stream.step(self._at, y + correction)]))[0]
            read = true[k] + self.specimen.noise * float(self._noise.standard_normal())
        self._total = total
        return true


def rms(x: FloatArray, desired: FloatArray, judged: FloatArray) -> float:
    """Return the rms error (nm) without its mean over the judged samples."""
    error = (x - desired)[judged > 0.5]
    return float(1e9 * np.std(error))


def judged_of(name: str, specimen: Specimen, desired: FloatArray) -> FloatArray:
    """Return which samples count, (N,), 1 or 0: of steps, those five time constants of the mode after each."""
    judged = np.ones(desired.size)
    if name == "steps":
        since_step = np.arange(desired.size) % (desired.size // len(LEVELS))
        judged = (since_step >= round(RISE_S * RATE_HZ) + specimen.settling).astype(float)
    return judged


def without_dynamics(run: Run, judged: FloatArray, gain: float, band: float, passes: int) -> list[float]:
    """Return the true error (nm) of every pass, if the error of each is added to the path of the next one."""
    size, correction, found = run.desired.size, np.zeros(run.desired.size), []
    low_pass = np.exp(-0.5 * (np.fft.rfftfreq(size, 1.0 / RATE_HZ) / band) ** 2)
    low_pass[0] = 0.0
    for _ in range(passes):
        _, x, y = run.follow(np.clip(run.desired + correction, *run.range))
        run.back()
        found.append(rms(x, run.desired, judged))
        correction = correction + gain * np.fft.irfft(np.fft.rfft(run.desired - y) * low_pass, size)
    return found


def compare(
    specimen: Specimen, axis: slpi_ros.AxisModel, name: str, passes: int, beside: Collection[str]
) -> dict[str, list[float]]:
    """Return the true error (nm) of every pass with the learner, with the inverse alone, and with others `beside`."""
    desired = path_of(name, specimen, axis)
    judged, t = judged_of(name, specimen, desired), np.arange(desired.size) / RATE_HZ
    run, learner = Run(specimen, axis, desired), slpi_ros.Learner(slpi_ros.StageModel({"x": axis}), t, desired)
    errors: dict[str, list[float]] = {"learner": []}
    for _ in range(passes):
        v, x, y = run.follow(learner.path())
        errors["learner"].append(rms(x, desired, judged))
        report = learner.update(y, v)
        run.back()
        if "-v" in sys.argv and report.reason:
            print(f"      pass {report.number}: {report.reason}")
    errors["limited"] = [report.limited_by]  # type: ignore[list-item]
    errors["bandwidth"] = [report.bandwidth]
    run, errors["alone"] = Run(specimen, axis, desired), []
    for _ in range(passes):
        errors["alone"].append(rms(run.follow(desired)[1], desired, judged))
        run.back()
    for method in {"line", "inverse"}.intersection(beside):
        tried = [
            without_dynamics(Run(specimen, axis, desired, straight=method == "line"), judged, gain, band, passes)
            for gain, band in FIXED
        ]
        errors[method] = min(tried, key=lambda found: found[-1])
    # Sample by sample, which takes too long for longer paths.
    if "PI" in beside and desired.size * FEEDBACK_PASSES <= MOST_SAMPLES:
        tried = []
        for gains in PI:
            run = Run(specimen, axis, desired)
            tried.append([rms(run.feedback(*gains), desired, judged) for _ in range(FEEDBACK_PASSES)])
        errors["PI"] = min(tried, key=lambda found: found[-1])
    return errors


def keep(stages: Mapping[int, tuple[Specimen, Mapping[str, Any]]], passes: int) -> None:
    """Keep the row of a raster that repeats: median and range over stages, by seed, and their errors (nm)."""
    specimens, errors = zip(*stages.values(), strict=True)
    modes = [one.frequency for one in specimens]
    noise = [1e9 * one.noise for one in specimens]
    what = (
        f"a raster of 20 Hz that repeats, {len(stages)} stages with modes of {min(modes):.0f} to {max(modes):.0f} Hz "
        f"and {min(noise):.0f} to {max(noise):.0f} nm of noise, rms error, median (least to largest): inverse alone, "
        "first pass; with a proportional-integral loop, the best of six gains, drift included (not `slpi tune`); "
        f"`learn`, {passes} passes; learning from the inverse without a model of the dynamics, the best of several "
        "gains"
    )
    columns = [[one["learner"][0] for one in errors]]
    columns += [[one[method][-1] for one in errors] for method in ("PI", "learner", "inverse")]
    said = "; ".join(f"{np.median(each):.3g} ({min(each):.3g} to {max(each):.3g}) nm" for each in columns)
    chosen = f"--seed {min(stages)} --count {len(stages)} --paths '{KEPT_PATH}'"
    kept.write_row("learning", what, said, f'make bench-learning LEARNING="{chosen}"')


def main() -> int:
    """Print a row for each stage and path, and what share keeps the marks; return 1 if one is missed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=3, help="stages")
    parser.add_argument("--seed", type=int, default=0, help="of the first stage")
    parser.add_argument("--passes", type=int, default=20)
    parser.add_argument("--paths", nargs="+", choices=PATHS, default=["raster 5", "raster 20", "raster f/10", "free"])
    parser.add_argument("--all-paths", action="store_true", help="every path")
    parser.add_argument("--beside", nargs="*", choices=METHODS, default=METHODS, help="what else to run; default: all")
    parser.add_argument("--models", type=Path, help="folder in which identified models are kept")
    parser.add_argument("-v", action="store_true", help="tell what happened in which pass")
    parser.add_argument("--keep", action="store_true", help=f"write the row of {KEPT_PATH} to {kept.KEPT.name}")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    print(f"true error, rms nm, without mean; after 5 and {options.passes} passes")
    print(f"{'stage':<34}{'path':<12}{'noise':>6}{'first':>8}{'PI':>8}"
          f"{'line 5':>8}{'last':>8}{'inv. 5':>8}{'last':>8}{'own 5':>10}{'last':>8}")  # fmt: skip
    counts = {"NOISE": 0, "TENTH": 0, "LINE": 0, "HARM": 0, "HARM (alone too)": 0}
    rows = 0
    stages: dict[int, tuple[Specimen, Mapping[str, Any]]] = {}
    for seed in range(options.seed, options.seed + options.count):
        specimen = Specimen.draw(seed)
        began = time.perf_counter()
        axis = identified(specimen, options.models).axes["x"]
        causes = ", ".join(effect.name for effect in axis.effects) or "no effect"
        print(f"{seed}: {specimen.kind}, mode {specimen.frequency:.0f} Hz damping {specimen.damping:.3f}, "
              f"lag {1e3 * specimen.lag:.2f} ms; found: {causes}"
              f"  ({time.perf_counter() - began:.0f} s)", flush=True)  # fmt: skip
        for name in PATHS if options.all_paths else options.paths:
            errors = compare(specimen, axis, name, options.passes, options.beside)
            own, noise, fifth = errors["learner"], 1e9 * specimen.noise, min(5, options.passes - 1)
            marks = []
            if own[-1] > noise:
                marks.append("NOISE")
            if own[-1] > max(0.1 * own[0], noise):
                marks.append("TENTH")
            if "line" in errors and own[fifth] > max(errors["line"][fifth] / 3.0, noise):
                marks.append("LINE")
            if max(own) > 1.1 * max(own[0], noise):
                marks.append("HARM")
            for mark in marks:
                counts[mark] += 1
            if "HARM" in marks and max(own) <= 1.1 * max(errors["alone"]):
                counts["HARM (alone too)"] += 1
                marks.append("(alone too)")
            rows += 1
            if name == KEPT_PATH:
                stages[seed] = specimen, errors
            others = [errors.get(method, [math.nan] * options.passes) for method in ("line", "inverse")]
            beside = "".join(f"{each[fifth]:>8.1f}{each[-1]:>8.1f}" for each in others)
            print(f"{'':<34}{name:<12}{noise:>6.1f}{own[0]:>8.1f}{errors.get('PI', [math.nan])[-1]:>8.1f}{beside}"
                  f"{own[fifth]:>10.1f}{own[-1]:>8.1f}  {errors['limited'][0]}"
                  f" {errors['bandwidth'][0]:.0f} Hz"
                  f"  {' '.join(marks)}", flush=True)  # fmt: skip
    if options.keep and stages:
        keep(stages, options.passes)
    print("; ".join(f"{mark} {count} of {rows}" for mark, count in counts.items()))
    return 1 if counts["NOISE"] > 0.1 * rows or counts["TENTH"] or counts["LINE"] or counts["HARM"] else 0


if __name__ == "__main__":
    sys.exit(main())
