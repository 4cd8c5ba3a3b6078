"""Stages of foreign physics: is a loop family better than the classical model, and do causes help, or harm.

Every specimen of every stage of ``hidden/foreign.py`` is recorded from rest with three calibration drives, one after
the other at about 1, 5 and 20 Hz, with 8 nm of white noise. Together they give a classical Prandtl-Ishlinskii model, a
loop family, and the loop family extended by what the diagnosis finds. These are judged without noise on new paths of
other amplitudes and nested loops at about 2, 10 and 25 Hz, from rest:

- forward: free run against the displacement, without the constant offset of the path;
- compensated: displacement for the voltages from the model against the desired displacement, with its offset.

Figures are in % of the stroke, median over the specimens and in brackets the worst one. A row is marked ``WORSE`` where
for any specimen an rms error with causes is more than 1.05 times that of the loop family, or one of the loop family
more than 1.05 times that of the classical model. The exit code is 1 if any row is marked.
"""

import argparse
import sys
import time
import warnings
from dataclasses import dataclass, field

import numpy as np
from hidden import foreign
from hidden.drives import log_uniform
from numpy.typing import NDArray

import slpi_ros
from slpi_ros.errors import SlpiError
from slpi_ros.excitation.drives import calibration_drive
from slpi_ros.excitation.legs import DriveSpec, Path
from slpi_ros.io.record import Record

FloatArray = NDArray[np.float64]

STAGES: dict[str, foreign.Stage] = {
    "thermal relays": foreign.ThermalRelays(),
    "Maxwell slip": foreign.MaxwellSlip(),
    "Duhem": foreign.DuhemStage(),
    "Bouc-Wen": foreign.LaggingBoucWen(),
    "moving Preisach": foreign.MovingPreisach(),
}
KINDS = ("pi", "slpi", "causes")
NOISE_M, RATE_HZ, HIGHEST_V = 8e-9, 2500.0, 100.0
# Duration (s) of a calibration drive, and number of drives in the record: about 1, 5 and 20 Hz.
RECORDS = ((12.0, 1), (2.4, 2), (0.6, 4))
# Mean speed of a path, loops of the whole range per second, and number of nests at this speed.
SPEEDS = ((2.0, 1), (10.0, 4), (25.0, 8))
# Lowest and highest turning points of a path, shares of the range.
LOWEST, HIGHEST = 0.08, 0.97
# Ratio of two errors above which a row is marked.
WORSE = 1.05


@dataclass(frozen=True)
class Outcome:
    """Result for one specimen: verdict and effects, and errors (% of stroke) of each kind of model."""

    verdict: str
    forward: dict[str, float]
    largest: dict[str, float]
    compensated: dict[str, float]
    compensated_largest: dict[str, float]
    marks: list[str] = field(default_factory=list)


def calibrations(stage: foreign.Stage, specimen: int, noise: np.random.Generator) -> tuple[list[Record], FloatArray]:
    """Return the calibration records of a specimen, and its displacement (m) in them without noise."""
    records, paths = [], []
    for number, (duration, repeated) in enumerate(RECORDS):
        seeds = range(100 * specimen + 10 * number, 100 * specimen + 10 * number + repeated)
        drives = [calibration_drive(0.0, HIGHEST_V, duration=duration, rate=RATE_HZ, seed=seed)[1] for seed in seeds]
        v = np.concatenate([drives[0], *(drive[1:] for drive in drives[1:])])
        t = np.arange(v.size) / RATE_HZ
        x = stage.run(t, v, np.random.default_rng(specimen))
        y = x + NOISE_M * noise.standard_normal(x.size)
        # An hour between the records.
        time_ns = np.round((3600.0 * number + t) * 1e9).astype(np.int64)
        records.append(Record(time_ns, {"x": v}, {"x": y}, source=f"record {number + 1}"))
        paths.append(x)
    return records, np.concatenate(paths)


def new_path(rng: np.random.Generator) -> FloatArray:
    """Draw a path from the low end, shape (N,), shares of the range: nests and single moves at each of `SPEEDS`."""
    path = Path()
    path.hold(0.1)
    for speed, nests in SPEEDS:
        for _ in range(nests):
            centre, left = float(rng.uniform(0.3, 0.7)), 1.0
            while left > 0.05:
                for end in (HIGHEST, LOWEST):
                    _move(path, centre + (end - centre) * left, speed)
                    left *= float(rng.uniform(0.6, 0.95))
            for share in rng.uniform(LOWEST, HIGHEST, 4).tolist():
                _move(path, share, speed * log_uniform(rng, 0.8, 1.25))
    return path.voltages(DriveSpec(0.0, 1.0, sum(leg.seconds for leg in path.legs), RATE_HZ))


def _move(path: Path, share: float, speed: float) -> None:
    path.to(share, max(abs(share - path.at), 0.05) / (2.0 * speed))


def judge(stage: foreign.Stage, specimen: int) -> Outcome:
    """Calibrate the models of a specimen and return their errors."""
    rng = np.random.default_rng([1, specimen])
    records, known = calibrations(stage, specimen, rng)
    models = {kind: slpi_ros.identify(records, kind).axes["x"] for kind in ("pi", "slpi")}
    diagnosis = slpi_ros.diagnose(records, slpi_ros.StageModel({"x": models["slpi"]}))
    models["causes"], found = diagnosis.extended.axes["x"], diagnosis.axes["x"]
    stroke, low = float(np.ptp(known)), float(known[0])
    v = HIGHEST_V * new_path(rng)
    t = np.arange(v.size) / RATE_HZ
    x = stage.run(t, v, np.random.default_rng(specimen))
    runs = {kind: model.simulate(t, v) - x for kind, model in models.items()}
    errors = {kind: 100.0 / stroke * (error - error.mean()) for kind, error in runs.items()}
    desired = low + stroke * new_path(rng)
    reached = {kind: _compensated(stage, specimen, model, desired) for kind, model in models.items()}
    missed = {kind: 100.0 / stroke * (each - desired) for kind, each in reached.items()}
    effects = ", ".join(
        one.name + (f" (or {'/'.join(one.alternatives)})" if one.alternatives else "") for one in found.effects
    )
    kept = ", ".join(effect.name for effect in models["causes"].effects)
    forward, compensated = _rms(errors), _rms(missed)
    return Outcome(
        verdict=f"{found.verdict}: {effects or 'no effect'}; in the model: {kept or 'none'}"
        + (f"; dropped: {', '.join(found.dropped)}" if found.dropped else ""),
        forward=forward,
        largest=_largest(errors),
        compensated=compensated,
        compensated_largest=_largest(missed),
        marks=[
            f"{what} {one} > {other}"
            for what, figures in (("forward", forward), ("compensated", compensated))
            for one, other in (("causes", "slpi"), ("slpi", "pi"))
            if not figures[one] <= WORSE * figures[other]
        ],
    )


def _compensated(stage: foreign.Stage, specimen: int, model: slpi_ros.AxisModel, desired: FloatArray) -> FloatArray:
    """Return the displacement (m) for the voltages of a model for the `desired` one; NaN where it refuses."""
    t = np.arange(desired.size) / RATE_HZ
    try:
        v, _ = model.compensate(t, desired, start_memory="start")
    except SlpiError:
        return np.full(desired.size, np.nan)
    return stage.run(t, v, np.random.default_rng(specimen))


def _rms(errors: dict[str, FloatArray]) -> dict[str, float]:
    return {kind: float(np.sqrt(np.mean(error**2))) for kind, error in errors.items()}


def _largest(errors: dict[str, FloatArray]) -> dict[str, float]:
    return {kind: float(np.abs(error).max()) for kind, error in errors.items()}


def row(name: str, outcomes: list[Outcome]) -> str:
    """Return the row of a stage: median and worst error of each kind, and the mark."""
    cells = []
    for figure in ("forward", "largest", "compensated", "compensated_largest"):
        for kind in KINDS:
            values = [getattr(outcome, figure)[kind] for outcome in outcomes]
            cells.append(f"{f'{np.median(values):.2f} ({max(values):.2f})':>13}")
    return f"{name:<16}{''.join(cells)}{'  WORSE' if any(outcome.marks for outcome in outcomes) else ''}"


def main() -> int:
    """Print a row for each stage; return 1 if one is marked."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=3, help="specimens of each stage")
    parser.add_argument("--seed", type=int, default=0, help="of the first specimen")
    parser.add_argument("--only", choices=STAGES, metavar="STAGE", help=f"this one alone: {', '.join(STAGES)}")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    print(f"{options.count} specimens, {1e9 * NOISE_M:.0f} nm of noise; % of stroke, median (worst)")
    heads = ("forward rms", "forward largest", "compensated rms", "compensated largest")
    print(f"{'':<16}{''.join(f'{head:>39}' for head in heads)}")
    print(f"{'':<16}{''.join(f'{kind:>13}' for kind in KINDS) * len(heads)}")
    marked = False
    for name in [options.only] if options.only else STAGES:
        outcomes, times = [], []
        for specimen in range(options.seed, options.seed + options.count):
            began = time.perf_counter()
            outcomes.append(judge(STAGES[name], specimen))
            times.append(time.perf_counter() - began)
        print(row(name, outcomes))
        for specimen, (outcome, took) in enumerate(zip(outcomes, times, strict=True), options.seed):
            marks = f"  WORSE: {', '.join(outcome.marks)}" if outcome.marks else ""
            print(f"  {specimen}: {outcome.verdict}  ({took:.0f} s){marks}", flush=True)
            marked |= bool(outcome.marks)
    return 1 if marked else 0


if __name__ == "__main__":
    sys.exit(main())
