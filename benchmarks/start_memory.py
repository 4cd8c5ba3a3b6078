"""Records of one stage with different initial states: a change must be reported if, and only if, there is one.

A stage is identified, then recorded again for a few seconds, each time after other voltages: unchanged, with another
gain, and with another zero offset.
"""

import argparse
import warnings
from collections import Counter
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

import slpi_ros
from slpi_ros.excitation.drives import calibration_drive
from slpi_ros.identification.free_run import match
from slpi_ros.identification.samples import select_samples
from slpi_ros.simulation.axis import SimulatedAxis
from slpi_ros.simulation.parameters import AxisParameters

FloatArray = NDArray[np.float64]
RATE, NOISE, GAIN, ZERO = 200.0, 8e-9, 0.01, 0.3e-6
# Relative gain and zero offset (m) of the stage when it is recorded again.
CASES = {"unchanged": (1.0, 0.0), "gain": (1.0 + GAIN, 0.0), "zero": (1.0, ZERO)}
# Relative tolerance of a reported change.
WITHIN = 0.2


def record(seed: int, t: FloatArray, v: FloatArray, before: FloatArray, gain: float, zero: float) -> slpi_ros.Record:
    """Return a record of a stage with a relative gain and a zero offset (m), after the voltages `before` (V) only."""
    own = AxisParameters.random(seed)
    stage = SimulatedAxis(replace(own, noise_rms=NOISE, stroke=gain * own.stroke), seed)
    stage.run(np.arange(before.size) / RATE - 1e4, before)
    measured = stage.run(t, v)[1]
    return slpi_ros.Record(np.round(t * 1e9).astype(np.int64), {"x": v}, {"x": measured + zero}, "again")


def drives(number: int, seconds: float, random: np.random.Generator) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return times (s) and voltages (V) of a record, and the voltages (V) applied before it."""
    turns = random.uniform(0.0, 100.0, 12)
    before = np.interp(np.arange(2400), np.linspace(0, 2399, turns.size), turns)
    t, v = calibration_drive(0.0, 100.0, duration=seconds, rate=RATE, seed=100 + number)
    if number % 2:
        # A sine of growing amplitude about the middle of the range, up to a random fraction of the range.
        reach = random.uniform(0.2, 0.5)
        v = 50.0 + 100.0 * reach * np.minimum(1.0, t / t[-1]) * np.sin(2.0 * np.pi * 0.5 * t)
    return t, v, np.append(before, v[0])


def judged(case: str, model: slpi_ros.StageModel, again: slpi_ros.Record, whole: bool) -> dict[str, str]:
    """Return the wrong result of each function for a record of the `whole` range or of a part of it; "" if correct."""
    found = match(model.axes["x"], select_samples(again, "x", None, None))
    matched = (
        f"gain {found.gain_change:+.3%} +- {found.gain_uncertainty:.3%}, width {found.width_change:+.2%} +- "
        f"{found.width_uncertainty:.2%}, zero {found.offset * 1e9:+.0f} +- {found.offset_uncertainty * 1e9:.0f} nm, "
        f"error {found.rms * 1e9:.1f} nm"
    )
    if case == "zero":
        # A record of a part of the range cannot distinguish a shifted zero from another history.
        off = abs(found.offset - ZERO)
        right = found.zero_moved and off <= WITHIN * ZERO if whole else off <= found.offset_uncertainty
        return {"match": "" if right else matched}
    drifted = slpi_ros.refit(model, again)[1]["x"].drifted
    if case == "gain":
        right = found.gain_changed and abs(found.gain_change / GAIN - 1.0) <= WITHIN
        return {"match": "" if right else matched, "refit": "" if drifted else "no change"}
    verified = slpi_ros.verify(again, model).axes["x"].records[0]
    diagnosed = slpi_ros.diagnose(again, model).axes["x"]
    accused = diagnosed.given.changed or diagnosed.given.zero_moved or diagnosed.effects
    return {
        "match": matched if found.gain_changed or found.width_changed or found.zero_moved else "",
        "refit": "changed" if drifted else "",
        "verify": "" if verified.passed and not verified.zero_moved else f"{verified.to_document()}",
        "diagnose": diagnosed.summary if accused else "",
    }


def main() -> None:
    """Print how often each function gives the correct result."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=10, help="stages")
    parser.add_argument("--seed", type=int, default=0, help="of the first stage")
    parser.add_argument("--memories", type=int, default=10, help="of each stage")
    parser.add_argument("--seconds", type=float, default=12.0)
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    counts: Counter[tuple[str, str]] = Counter()
    for seed in range(options.seed, options.seed + options.seeds):
        random = np.random.default_rng(seed)
        t, v = calibration_drive(0.0, 100.0, duration=30.0, rate=RATE, seed=seed)
        model = slpi_ros.identify(record(seed, t, v, np.zeros(0), 1.0, 0.0))
        for number in range(options.memories):
            t, v, before = drives(number, options.seconds, random)
            for case, (gain, zero) in CASES.items():
                again = record(seed, t, v, before, gain, zero)
                for who, wrong in judged(case, model, again, whole=not number % 2).items():
                    counts[case, who] += not wrong
                    if wrong:
                        print(f"seed {seed}, memory {number}, {case}, {who}: {wrong}", flush=True)
        print(f"seed {seed} done", flush=True)
    print(f"\nright of {options.seeds * options.memories}")
    for (case, who), count in sorted(counts.items()):
        print(f"  {case:<12}{who:<10}{count:4d}")


if __name__ == "__main__":
    main()
