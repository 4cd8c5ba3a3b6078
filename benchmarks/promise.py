"""The error that the calibrator promises, beside that of scans five minutes later: after a reset, and after a restart.

Stage time and physics are those of `calibrator.py`, without ROS between them. All errors are measured - desired, with
the constant offset, after ~/set_zero. Run it with ``make bench-promise``.
"""

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

sys.path.append(str(Path(__file__).resolve().parents[1]))
from calibrator import LIMITS, RATE, Bench, hidden, settings_for

from slpi_ros.calibration.run import Outcome, calibrate
from slpi_ros.compensator.controller import Controller, OperatingMode
from slpi_ros.compensator.persistence import SavedAxis
from slpi_ros.errors import SlpiError

# Time from the last record to the reset, and that without a compensator at a restart, seconds.
LATER, RESTART = 300.0, 20.0
# Reset as the compensator does it by default; legs of a scan and their durations (s); shares of the range.
CYCLES, RESET_RATE, LEGS, SECONDS, INNER = 10, 200.0, 12, (1.0, 2.5), (0.05, 0.93)
# The promise is kept within this factor.
FACTOR = 1.5


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


def promises(axes: Sequence[str], seed: int) -> list[str]:
    """Calibrate one stage, print what was promised and what came of it, and return whether each axis kept it."""
    bench, begun = Bench(hidden(axes, seed)), time.monotonic()
    outcome = calibrate(settings_for(axes), bench)
    computed = time.monotonic() - begun
    bench.now += LATER
    operation = Operation(bench, outcome)
    operation.reset()
    after_reset = operation.scan(seed)
    bench.now += RESTART
    restarted = Operation(bench, outcome, operation.saved())
    after_restart = restarted.scan(seed + 1)
    kept = []
    for name, error in outcome.errors.items():
        found = [each[name][np.isfinite(each[name])] for each in (after_reset, after_restart)]
        means = [float(np.abs(each).mean()) for each in found]
        ratios = [max(mean / error.mean, error.mean / mean) for mean in means]
        # The zero moves on by itself, which the outcome has told.
        told = any(each.effect.needs_feedback for each in outcome.diagnosis.axes[name].effects)
        kept.append("yes" if max(ratios) <= FACTOR else "told" if told else "NO")
        zeros = " ".join(f"{np.median(each) * 1e9:+8.1f}" for each in found)
        print(
            f"{seed:4} {name:4} {', '.join(bench.stage.effects[name]):32} "
            f"{', '.join(each.name for each in outcome.diagnosis.axes[name].effects):32} {error.mean * 1e9:8.1f} "
            f"{error.offset * 1e9:+8.1f} {means[0] * 1e9:8.1f} {means[1] * 1e9:8.1f} {zeros} "
            f"{kept[-1]:4} {computed:4.0f}",
            flush=True,
        )
    print(f"     {outcome.why}", flush=True)
    return kept


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--stages", type=int, default=20, help="stages with hidden effects")
    parser.add_argument("--first", type=int, default=100, help="seed of the first one")
    options = parser.parse_args()
    print(
        f"{'seed':>4} {'axis':4} {'hidden':32} {'found':32} {'promised':>8} {'zero':>8} {'reset':>8} {'restart':>8} "
        f"{'zero':>8} {'zero':>8} {'kept':4} {'s':>4}   (nm)"
    )
    kept = []
    for seed in range(options.first, options.first + options.stages):
        try:
            kept += promises(["x"], seed)
        except SlpiError as error:
            print(f"{seed:4} {error}")
    print(
        f"\nthe promise is kept within a factor of {FACTOR:g} by {kept.count('yes')} of {len(kept)} axes; of "
        f"{kept.count('told')} others it was told that the zero or the sensitivity goes on moving"
    )


if __name__ == "__main__":
    main()
