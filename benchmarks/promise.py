"""The error that the calibrator promises, beside that of scans five minutes later: after a reset, and after a restart.

The decisions and the physics are those of the node and of the simulated stage, in stage time, without ROS between
them. All errors are measured - desired, with the constant offset, after ~/set_zero. Run it with ``make bench-promise``.
"""

# To be set before NumPy is imported: the processes share the cores.
import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import nan
from multiprocessing import get_context
from pathlib import Path

import kept
import numpy as np
from numpy.typing import NDArray

sys.path.append(str(Path(__file__).resolve().parents[1]))

from slpi_ros.calibration.run import Outcome, Recording, Request, calibrate
from slpi_ros.calibration.settings import CalibrationSettings
from slpi_ros.compensator.controller import Controller, OperatingMode
from slpi_ros.compensator.persistence import SavedAxis
from slpi_ros.errors import SlpiError
from slpi_ros.io.record import Record
from slpi_ros.model.limits import Limits
from slpi_ros.simulation.stage import Stage

RATE, NOISE, BUDGET = 200.0, 8e-9, 300.0
LIMITS = Limits(0.0, 100.0, 1000.0, 1e5)
# The stage rests this long between two drives, while the calibration computes, seconds.
PAUSE = 30.0
# Alike from outside.
ALIKE = {"delay", "lag"}
# Time from the last record to the reset, and that without a compensator at a restart, seconds.
LATER, RESTART = 300.0, 20.0
# Reset as the compensator does it by default; legs of a scan and their durations (s); shares of the range.
CYCLES, RESET_RATE, LEGS, SECONDS, INNER = 10, 200.0, 12, (1.0, 2.5), (0.05, 0.93)
# The promise is kept within this factor.
FACTOR = 1.5


class Bench:
    """A simulated stage in stage time."""

    def __init__(self, stage: Stage) -> None:
        self.stage, self.now = stage, 1000.0

    def __call__(self, request: Request) -> Recording:
        """Drive the stage and return the record."""
        rows = np.column_stack(list(request.drive.voltage.values())).tolist()
        t = (self.now + request.drive.t).tolist()
        y = np.array([self.stage.measure(self.stage.step(at, row)) for at, row in zip(t, rows, strict=True)])
        time_ns = np.round((self.now + request.drive.t) * 1e9).astype(np.int64)
        self.now += float(request.drive.t[-1]) + PAUSE
        displacement = dict(zip(request.drive.axes, y.T, strict=True))
        return Recording(Record(time_ns, request.drive.voltage, displacement, request.name, "hidden"), request.desired)


def hidden(axes: Sequence[str], seed: int) -> Stage:
    """Return the stage of a seed, at rest."""
    return Stage.hidden(axes, seed, NOISE, rate=RATE, voltage_max=LIMITS.upper)


def settings_for(axes: Sequence[str]) -> CalibrationSettings:
    """Return the settings of all calibrations."""
    count = len(axes)
    return CalibrationSettings(tuple(axes), (LIMITS,) * count, (0.0,) * count, RATE, BUDGET * count)


def alike(names: Sequence[str]) -> set[str]:
    """Return the names of effects, those that look alike from outside as one."""
    return {"delay or lag" if name in ALIKE else name for name in names}


class Operation:
    """A compensator with the calibrated model in front of the stage, in stage time."""

    def __init__(self, bench: Bench, outcome: Outcome, saved: dict[str, SavedAxis] | None = None) -> None:
        self.bench, self.model = bench, outcome.model
        self.axes = list(outcome.errors)
        self.controller = Controller(self.axes, [LIMITS] * len(self.axes), period=1 / RATE)
        self.controller.use_model(outcome.model, saved)
        self.controller.configure()
        self.controller.activate(self._ns)

    @property
    def _ns(self) -> int:
        return round(self.bench.now * 1e9)

    def _step(self) -> list[float]:
        """Apply the present voltages, and return the readings (m)."""
        self.bench.now += 1 / RATE
        stage = self.bench.stage
        return stage.measure(stage.step(self.bench.now, self.controller.voltages.tolist()))

    def reset(self) -> None:
        """Reset the memory, and set the zero."""
        controller = self.controller
        controller.reset_memory(CYCLES, RESET_RATE, [0.0] * len(self.axes), self._ns)
        while controller.mode is OperatingMode.RESETTING:
            controller.measure(self.axes, self._step(), self._ns)
            controller.advance(self._ns, self._ns)
        controller.set_zero(self._ns)

    def scan(self, seed: int) -> dict[str, NDArray[np.float64]]:
        """Follow a random path; return the errors (m) of each axis."""
        paths = []
        for place, axis in enumerate(self.controller.axes):
            assert axis.model
            low, high = axis.model.displacement_range
            paths.append(_path(axis.stream.uncoupled_displacement, low, high, np.random.default_rng([seed, place])))
        longest = max(map(len, paths))
        desired = np.column_stack([np.pad(path, (0, longest - path.size), mode="edge") for path in paths])
        rows, t = [], []
        times = np.arange(longest) / RATE
        asked = [self.model.axis(name).in_advance(times, y) for name, y in zip(self.axes, desired.T, strict=True)]
        for row in np.column_stack(asked).tolist():
            self.controller.update(self._ns, self.axes, row, self._ns)
            rows.append(self._step())
            t.append(self.bench.now)
        read = np.array(rows)
        return {
            name: self.model.axis(name).correct(np.array(t), read[:, place]) - desired[:, place]
            for place, name in enumerate(self.axes)
        }

    def saved(self) -> dict[str, SavedAxis]:
        """Return the memory as a file keeps it over a restart."""
        return {axis.name: replace(axis.saved(self._ns), age=RESTART) for axis in self.controller.axes}


def _path(begin: float, low: float, high: float, rng: np.random.Generator) -> NDArray[np.float64]:
    levels = [begin, *(low + (high - low) * rng.uniform(*INNER, LEGS)).tolist()]
    parts = []
    for one, other in zip(levels, levels[1:], strict=False):
        phase = np.arange(1, round(rng.uniform(*SECONDS) * RATE) + 1)
        parts.append(one + (other - one) * (1.0 - np.cos(np.pi * phase / phase.size)) / 2.0)
    return np.concatenate(parts)


@dataclass(frozen=True)
class Row:
    """What came of one calibration; errors are means of the magnitude, m.

    `kept`: within `FACTOR` of what was promised after a reset and after a restart; `told`: not, but it was said that
    the zero or the sensitivity goes on moving.
    """

    seed: int
    hidden: tuple[str, ...]
    found: tuple[str, ...]
    promised: float
    stroke: float
    zero: float
    later: tuple[float, float]  # after a reset, after a restart
    zeros: tuple[float, float]
    told: bool
    why: str
    seconds: float

    @property
    def kept(self) -> bool:
        """Whether both scans are as promised."""
        return all(max(each / self.promised, self.promised / each) <= FACTOR for each in self.later)

    def line(self) -> str:
        """Return the row of the table."""
        after = "".join(f" {each * 1e9:8.1f}" for each in self.later)
        zeros = "".join(f" {each * 1e9:+8.1f}" for each in self.zeros)
        return (
            f"{self.seed:4} {', '.join(self.hidden):32} {', '.join(self.found):32} {self.promised * 1e9:8.1f} "
            f"{self.zero * 1e9:+8.1f}{after}{zeros} {'yes' if self.kept else 'told' if self.told else 'NO':4} "
            f"{self.seconds:4.0f}\n     {self.why}"
        )


def row_of(seed: int) -> Row | str:
    """Calibrate one stage, and return what was promised and what came of it; or why nothing did."""
    bench, begun = Bench(hidden(["x"], seed)), time.process_time()
    try:
        outcome = calibrate(settings_for(["x"]), bench, clock=lambda: bench.now)
        computed = time.process_time() - begun
        bench.now += LATER
        operation = Operation(bench, outcome)
        operation.reset()
        after_reset = operation.scan(seed)["x"]
        bench.now += RESTART
        after_restart = Operation(bench, outcome, operation.saved()).scan(seed + 1)["x"]
    except SlpiError as error:
        return f"{seed:4} {error}"
    scans = [each[np.isfinite(each)] for each in (after_reset, after_restart)]
    first, second = (float(np.abs(each).mean()) for each in scans)
    named, error = outcome.diagnosis.axes["x"].effects, outcome.errors["x"]
    return Row(
        seed, tuple(bench.stage.effects["x"]), tuple(each.name for each in named), error.mean, error.stroke,
        error.offset, (first, second), (float(np.median(scans[0])), float(np.median(scans[1]))),
        any(each.effect.needs_feedback for each in named), outcome.why, computed,
    )  # fmt: skip


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--stages", type=int, default=20, help="stages with hidden effects")
    parser.add_argument("--first", type=int, default=100, help="seed of the first one")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--keep", action="store_true", help=f"write the figures to {kept.KEPT.name}")
    options = parser.parse_args()
    print(
        f"{'seed':>4} {'hidden':32} {'found':32} {'promised':>8} {'zero':>8} {'reset':>8} {'restart':>8} "
        f"{'zero':>8} {'zero':>8} {'kept':4} {'s':>4}   (nm)"
    )
    rows = list[Row]()
    with get_context("spawn").Pool(options.processes) as pool:
        for row in pool.imap(row_of, range(options.first, options.first + options.stages), chunksize=1):
            print(row if isinstance(row, str) else row.line(), flush=True)
            rows += [] if isinstance(row, str) else [row]
    right, good = sum(alike(row.hidden) == alike(row.found) for row in rows), sum(row.kept for row in rows)
    told = sum(row.told and not row.kept for row in rows)
    error = float(np.median([row.promised / row.stroke for row in rows])) if rows else nan
    print(
        f"\n{options.stages} stages: all causes found on {right}; the promise, {error:.3%} of the stroke (median), is "
        f"kept within a factor of {FACTOR:g} on {good}; on {told} others it was told that the zero or the "
        "sensitivity goes on moving"
    )
    if options.keep:
        what = (
            "calibrator, stages with one or two hidden effects: all causes found; mean absolute error that it "
            f"promises, of stroke, median; found within a factor of {FACTOR:g} of it, either way, five minutes later, "
            "after a reset and after a restart; of the others, told that zero or sensitivity go on moving"
        )
        whole = options.stages
        said = f"{right} of {whole}; {100.0 * error:.3f} %; {good} of {whole}; {told} of the other {whole - good}"
        kept.write_row("promise", what, said, "make bench-promise")


if __name__ == "__main__":
    main()
