"""A raster at rising rates on one stage that is not of the model's class: the true error cycle by cycle.

The stage has thermally activated relays over 37 um, a flexure mode of 350 Hz with a damping of 0.02 and a lag of 1 ms;
its sensor has 8 nm of noise, and everything is sampled at 2 kHz. The path is a triangle with rounded turns over 60 % of
the stroke, without a pause. Two models, both identified from records of the stage: hysteresis alone, so that the
mechanics are learned from the passes, and with the causes that ``slpi diagnose`` finds.

Printed are the true error, rms in nm without the mean, of some cycles, and what limits it after the last. For the
harmonics of the fastest raster: their part of the path, what the stage without a correction makes of them, and what is
left.
"""

import argparse
import sys
import warnings
from collections.abc import Iterator

import learning
import numpy as np
from hidden import foreign
from learning import FloatArray, Run, Specimen, rms

import slpi_ros

learning.RATE_HZ = 2000.0
learning.KINDS["prototype"] = foreign.ThermalRelays(stroke=37e-6, relays=1200)
RATES_HZ = (5.0, 20.0, 40.0, 100.0)
CYCLES = (1, 2, 5, 10, 20, 40)


def specimen(seed: int) -> Specimen:
    """Return the stage of a seed."""
    return Specimen("prototype", seed, 350.0, 0.02, 1e-3, 0.0, 0.0, 8e-9)


def models(stage: Specimen) -> Iterator[tuple[str, slpi_ros.AxisModel]]:
    """Yield what is known, and the model of it."""
    records = learning.records_of(stage)
    plain = slpi_ros.identify(records)
    yield "hysteresis alone", plain.axes["x"]
    yield "with causes", slpi_ros.diagnose(records, plain).extended.axes["x"]


def amplitudes(x: FloatArray) -> FloatArray:
    """Return the amplitude (nm) of each harmonic of a pass (m, (N,)), (N // 2 + 1,)."""
    return np.asarray(2e9 / x.size * np.abs(np.fft.rfft(x)))


def main() -> int:
    """Print the errors of all rates with both models."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--rates", type=float, nargs="+", default=RATES_HZ, help="Hz")
    parser.add_argument("--cycles", type=int, default=CYCLES[-1])
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    stage, shown = specimen(options.seed), sorted({*(k for k in CYCLES if k < options.cycles), options.cycles})
    print(f"true error, rms nm, in cycle {', '.join(map(str, shown))}")
    for known, axis in models(stage):
        for hertz in options.rates:
            desired = learning.path_of(f"raster {hertz:g}", stage, axis)
            run = Run(stage, axis, desired)
            learner = slpi_ros.Learner(slpi_ros.StageModel({"x": axis}), np.arange(desired.size) / 2000.0, desired)
            errors, every = [], np.ones(desired.size)
            for _ in range(options.cycles):
                voltage, true, read = run.follow(learner.path())
                errors.append((rms(true, desired, every), amplitudes(true - desired)))
                report = learner.update(read, voltage)
            told = "".join(f"{errors[k - 1][0]:>9.1f}" for k in shown)
            print(f"{known:<18}{hertz:>5.0f} Hz{told}   {report.limited_by}", flush=True)
        rows = zip(amplitudes(desired), errors[1][1], errors[-1][1], strict=True)
        for k, (path, before, left) in enumerate(rows):
            if k % 2:
                print(
                    f"{'':<18}{k * hertz:>5.0f} Hz: amplitude {path:.0f} nm, error {before:.0f} nm, left {left:.1f} nm"
                )
    return 0


if __name__ == "__main__":
    sys.exit(main())
