"""Records of one stage from different memories: a change must be told where there is one, and only there.

A stage is identified, then recorded again for a few seconds, each time after another drive: unchanged, with another
gain, and with another zero.
"""

import argparse
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

import slpi_ros
from slpi_ros.excitation.drives import calibration_drive
from slpi_ros.identification.initial_history import match
from slpi_ros.identification.samples import select_samples
from slpi_ros.simulation.parameters import StageParameters
from slpi_ros.simulation.preisach import PreisachStage

FloatArray = NDArray[np.float64]
RATE, NOISE, GAIN, ZERO = 200.0, 8e-9, 0.01, 0.3e-6
# What a figure that is told may be off by, as a share of it.
WITHIN = 0.2


def record(seed: int, t: FloatArray, v: FloatArray, before: FloatArray, gain: float, zero: float) -> slpi_ros.Record:
    """Return a record of a stage, never moved but by `before` (V), of a relative gain and with a zero (m)."""
    own = StageParameters.random(seed)
    stage = PreisachStage(replace(own, noise_rms=NOISE, stroke=gain * own.stroke), seed)
    stage.run(np.arange(before.size) / RATE - 1e4, before)
    measured = stage.run(t, v)[1]
    return slpi_ros.Record(np.round(t * 1e9).astype(np.int64), {"x": v}, {"x": measured + zero}, "again")


def main() -> None:
    """Print how often a change is told."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--memories", type=int, default=10)
    parser.add_argument("--seconds", type=float, default=12.0)
    options = parser.parse_args()
    none = np.zeros(0)
    for seed in range(options.seeds):
        random = np.random.default_rng(seed)
        t, v = calibration_drive(0.0, 100.0, duration=30.0, rate=RATE, seed=seed)
        model = slpi_ros.identify(record(seed, t, v, none, 1.0, 0.0))
        cases = {"unchanged": (1.0, 0.0), "gain": (1.0 + GAIN, 0.0), "zero": (1.0, ZERO)}
        told = dict.fromkeys(cases, 0)
        for number in range(options.memories):
            turns = random.uniform(0.0, 100.0, 12)
            before = np.interp(np.arange(2400), np.linspace(0, 2399, turns.size), turns)
            t, v = calibration_drive(0.0, 100.0, duration=options.seconds, rate=RATE, seed=100 + number)
            if number % 2:
                # A sine that grows about where the stage is, to a share of the range that differs.
                reach = random.uniform(0.2, 0.5)
                v = 50.0 + 100.0 * reach * np.minimum(1.0, t / t[-1]) * np.sin(2.0 * np.pi * 0.5 * t)
            before = np.append(before, v[0])
            for case, (gain, zero) in cases.items():
                again = record(seed, t, v, before, gain, zero)
                found = match(model.axes["x"], select_samples(again, "x", None, None))
                change = slpi_ros.refit(model, again)[1]["x"] if case != "zero" else None
                if case == "unchanged":
                    right = not (found.gain_changed or found.width_changed or found.zero_moved or change.drifted)
                elif case == "gain":
                    right = found.gain_changed and abs(found.gain_change / GAIN - 1.0) <= WITHIN and change.drifted
                else:
                    # A record of a part of the range cannot tell a moved zero from another history.
                    off = abs(found.offset - ZERO)
                    right = off <= found.offset_uncertainty if number % 2 else found.zero_moved and off <= WITHIN * ZERO
                told[case] += right
                if not right:
                    print(
                        f"  seed {seed}, memory {number}, {case}: gain {found.gain_change:+.3%} +- "
                        f"{found.gain_uncertainty:.3%}, width {found.width_change:+.2%} +- "
                        f"{found.width_uncertainty:.2%}, zero {found.offset * 1e9:+.0f} +- "
                        f"{found.offset_uncertainty * 1e9:.0f} nm, error {found.rms * 1e9:.1f} nm, explained to "
                        f"{found.rms_explained * 1e9:.1f}, known {np.mean(found.known):.0%}, from {found.known_from}, "
                        f"drifted {change and change.drifted}"
                    )
        print(f"seed {seed}: right of {options.memories}: " + ", ".join(f"{k} {n}" for k, n in told.items()))


if __name__ == "__main__":
    main()
