"""Stages with hidden effects that calibrate themselves, beside a fixed calibration; and faults during a calibration.

The decisions and the physics are those of the node and of the simulated stage, without ROS between them: stage time is
what a real stage would need. Run it with ``make bench-calibrator``; ``--faults`` needs the build.
"""

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import kept
import numpy as np
from numpy.typing import NDArray

sys.path.append(str(Path(__file__).resolve().parents[1]))

from slpi_ros.calibration.drives import compensated, exciting
from slpi_ros.calibration.run import Outcome, Recording, Request, TrackingError, calibrate, tracking_error
from slpi_ros.calibration.settings import CalibrationSettings
from slpi_ros.errors import SlpiError
from slpi_ros.identification.fit import identify
from slpi_ros.io.record import Record
from slpi_ros.model.limits import Limits
from slpi_ros.model.stage_model import StageModel
from slpi_ros.simulation.stage import Stage

RATE, NOISE, BUDGET, FIXED = 200.0, 8e-9, 300.0, 30.0
LIMITS = Limits(0.0, 100.0, 1000.0, 1e5)
# The stage rests this long between two drives, while the calibration computes, seconds.
PAUSE = 30.0
# Effects that no feedforward undoes, by the parameter of the character; a delay is undone on a path known in advance.
LASTING = ("thermal_drift", "gain_drift", "hum_amplitude")
# Alike from outside; largest verified error where everything can be undone, and its ratio to what remains otherwise.
ALIKE, UNDONE, RATIO = {"delay", "lag"}, 5e-4, 1.5


class Bench:
    """A simulated stage in stage time, and the voltages that it was given."""

    def __init__(self, stage: Stage) -> None:
        self.stage, self.now = stage, 1000.0
        self.requests: list[Request] = []

    def __call__(self, request: Request) -> Recording:
        """Drive the stage and return the record."""
        self.requests.append(request)
        y = np.array([self.stage.measure(row) for row in self._driven(request)])
        time_ns = np.round((self.now + request.drive.t) * 1e9).astype(np.int64)
        self.now += float(request.drive.t[-1]) + PAUSE
        displacement = dict(zip(request.drive.axes, y.T, strict=True))
        return Recording(Record(time_ns, request.drive.voltage, displacement, request.name, "hidden"), request.desired)

    def _driven(self, request: Request) -> list[list[float]]:
        rows = np.column_stack(list(request.drive.voltage.values())).tolist()
        t = (self.now + request.drive.t).tolist()
        return [self.stage.step(at, row) for at, row in zip(t, rows, strict=True)]

    def replayed(self, requests: Sequence[Request]) -> NDArray[np.float64]:
        """Return the readings without noise, shape (N, axes), metres, of the last one of several drives."""
        for request in requests:
            y = np.array(self._driven(request))
            self.now += float(request.drive.t[-1]) + PAUSE
        return y


def hidden(axes: Sequence[str], seed: int) -> Stage:
    """Return the stage of a seed, at rest."""
    return Stage.hidden(axes, seed, NOISE, rate=RATE, voltage_max=LIMITS.upper)


def settings_for(axes: Sequence[str]) -> CalibrationSettings:
    """Return the settings of all calibrations."""
    count = len(axes)
    return CalibrationSettings(tuple(axes), (LIMITS,) * count, (0.0,) * count, RATE, BUDGET * count)


def reachable(axes: Sequence[str], seed: int, requests: Sequence[Request], axis: str, model: StageModel) -> float:
    """Return the mean error (m) that the true model would leave on a path.

    It is due to lasting effects on the last path, to noise, and to what the inverse of the other effects leaves sample
    by sample, which is computed with the identified `model` as the stage.
    """
    true, without = hidden(axes, seed), hidden(axes, seed)
    for one in without.axes.values():
        one.character = replace(one.character, **dict.fromkeys(LASTING, 0.0))
    place = list(axes).index(axis)
    lasting = (Bench(true).replayed(requests) - Bench(without).replayed(requests))[:, place]
    lasting = _centred(lasting[np.isfinite(requests[-1].desired[axis])])
    inverse = _left_by_inverse(settings_for(axes), model, axis)
    noise = np.random.default_rng(0).normal(0.0, NOISE, min(lasting.size, inverse.size))
    return float(np.abs(lasting[: noise.size] + inverse[: noise.size] + noise).mean())


def _left_by_inverse(settings: CalibrationSettings, model: StageModel, axis: str) -> NDArray[np.float64]:
    """Return the errors of the compensation of a path, shape (N,), metres, if the stage were the model."""
    undone = {
        name: replace(one, effects=tuple(each for each in one.effects if each.name not in ("delay", "saturation")))
        for name, one in model.stage_only.axes.items()
    }
    stage = replace(model, axes=undone)
    drive, desired = compensated(settings, stage, 1)
    errors = stage.simulate(drive.t, drive.voltage)[axis] - desired[axis]
    return _centred(errors[np.isfinite(errors)])


def _centred(errors: NDArray[np.float64]) -> NDArray[np.float64]:
    return errors - np.median(errors)


@dataclass(frozen=True)
class Row:
    """One axis of one calibrated stage."""

    seed: int
    axis: str
    hidden: tuple[str, ...]
    found: tuple[str, ...]
    error: TrackingError
    reachable: float
    fixed: TrackingError
    seconds: float
    why: str

    @property
    def named(self) -> bool:
        """Whether exactly the hidden effects were found; delay and lag count as one."""
        return alike(self.hidden) == alike(self.found)

    @property
    def good(self) -> bool:
        """Whether the error is as small as it can be."""
        return self.error.rest <= max(UNDONE * self.error.stroke, RATIO * self.reachable)

    def line(self) -> str:
        """Return the row of the table."""
        return (
            f"{self.seed:4} {self.axis:4} {', '.join(self.hidden):36} {', '.join(self.found):36} "
            f"{'yes' if self.named else 'NO':5} {self.error.rest / self.error.stroke:8.3%} "
            f"{self.reachable / self.error.stroke:8.3%} {'yes' if self.good else 'NO':5} "
            f"{self.fixed.rest / self.fixed.stroke:8.3%} {self.seconds:6.0f}"
        )


HEADER = (
    f"{'seed':>4} {'axis':4} {'hidden':36} {'found':36} {'right':5} {'error':>8} {'possible':>8} {'good':5} "
    f"{'fixed':>8} {'s/axis':>6}"
)


def alike(names: Sequence[str]) -> set[str]:
    """Return the names of effects, those that look alike from outside as one."""
    return {"delay or lag" if name in ALIKE else name for name in names}


def fixed_calibration(axes: Sequence[str], seed: int) -> dict[str, TrackingError]:
    """Return the errors after the fixed drive of 30 s for each axis, identified and compensated, without diagnosis."""
    bench, settings = Bench(hidden(axes, seed)), settings_for(axes)
    drive = exciting(settings, "calibration", FIXED * len(axes), axes, 0)
    model = identify(bench(Request("calibration", drive, {})).record)
    drive, desired = compensated(settings, model, 1)
    recording = bench(Request("verification", drive, desired))
    return {axis: tracking_error(recording, axis, model, 1.0) for axis in axes}


def rows_of(axes: Sequence[str], seed: int) -> list[Row]:
    """Let one stage calibrate itself; return a row for each axis."""
    bench = Bench(hidden(axes, seed))
    outcome: Outcome = calibrate(settings_for(axes), bench)
    fixed, effects = fixed_calibration(axes, seed), hidden(axes, seed).effects
    return [
        Row(
            seed, axis, effects[axis], tuple(named.name for named in outcome.diagnosis.axes[axis].effects), error,
            reachable(axes, seed, bench.requests, axis, outcome.model), fixed[axis], outcome.seconds / len(axes),
            outcome.why,
        )
        for axis, error in outcome.errors.items()
    ]  # fmt: skip


def characters(count: int, first: int, keep: bool) -> None:
    """Print a table of stages, half of them with one axis, half with two."""
    print(HEADER, flush=True)
    rows: list[Row] = []
    stages = [("x",)] * ((count + 1) // 2) + [("x", "y")] * (count // 2)
    whole = 0
    for seed, axes in enumerate(stages, first):
        begun = time.monotonic()
        try:
            new = rows_of(axes, seed)
        except SlpiError as error:
            print(f"{seed:4} {' '.join(axes)}: {error}", flush=True)
            continue
        rows += new
        whole += all(row.named for row in new)
        for row in new:
            print(row.line(), flush=True)
        print(f"     {new[0].why}; computed in {time.monotonic() - begun:.0f} s", flush=True)
    if rows:
        print(
            f"\nright causes on {whole} of {len(stages)} stages, {sum(row.named for row in rows)} of {len(rows)} axes; "
            f"error as small as it can be on {sum(row.good for row in rows)} of {len(rows)} axes; "
            f"median error {np.median([row.error.rest / row.error.stroke for row in rows]):.3%}, fixed calibration "
            f"{np.median([row.fixed.rest / row.fixed.stroke for row in rows]):.3%}; "
            f"most stage time {max(row.seconds for row in rows):.0f} s an axis"
        )
    if rows and keep:
        what = (
            f"calibrator, {len(stages)} simulated stages with one or two hidden effects: stages with all causes found; "
            "median error on a new path; the same without causes, from a drive that is the same for all stages"
        )
        error = np.median([row.error.rest / row.error.stroke for row in rows])
        fixed = np.median([row.fixed.rest / row.fixed.stroke for row in rows])
        said = f"{whole} of {len(stages)}; {100.0 * error:.3f} %; {100.0 * fixed:.2f} %"
        kept.write_row("calibrator", what, said, "make bench-calibrator")


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--characters", type=int, default=20, help="stages with hidden effects")
    parser.add_argument("--first", type=int, default=100, help="seed of the first one")
    parser.add_argument("--faults", type=int, default=30, help="calibrations over DDS with a fault")
    parser.add_argument("--keep", action="store_true", help=f"write the figures to {kept.KEPT.name}")
    options = parser.parse_args()
    if options.characters:
        characters(options.characters, options.first, options.keep)
    if options.faults:
        from calibrator_faults import faults

        faults(options.faults)


if __name__ == "__main__":
    main()
