"""Cost of a diagnosis beside another commit: processor time and peak memory of ``slpi diagnose`` as a whole process.

Two records of 80,000 samples each, of a stage with creep and a lag and of one with a lag and a periodic error of the
sensor; and the four records of the measured mirror, where SLPI_MEASURED_DATA has them. Each commit identifies its own
model of the first record.
"""

import argparse
import multiprocessing
import tempfile
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from accuracy import FloatArray, record_of
from hidden.physics import Amplifier, Physics, SlowDomains, own_motion
from identification_speed import Cost, ratios, run, show
from records import measured_folder

from slpi_ros.excitation.drives import calibration_drive
from slpi_ros.io.bag_writer import write_bag
from slpi_ros.io.record import Record
from slpi_ros.io.tables import import_table
from slpi_ros.simulation.dynamics import Creep
from slpi_ros.simulation.parameters import AxisParameters

SAMPLES, RATE, SEED = 80_000, 1000.0, 11
# Seconds; share per decade; metres.
LAG, CREEP, NOISE, PERIODIC, PERIOD = 8e-3, 0.015, 8e-9, 30e-9, 0.8e-6
MIRROR = ("sine_1p02hz", "sine_0p49hz", "square_250mv", "sawtooth_0p5hz")


def simulated(physics: Physics, amplitude: float, number: int) -> Record:
    """Return a calibration record of a stage whose sensor has a periodic error of this `amplitude` (m)."""
    rng = np.random.default_rng(SEED + number)
    t, v = calibration_drive(0.0, 100.0, duration=SAMPLES / RATE, rate=RATE, seed=SEED + number)
    y: FloatArray = own_motion(AxisParameters.random(SEED), physics, t, v)
    y = y + amplitude * np.sin(2.0 * np.pi * y / PERIOD) + rng.normal(0.0, NOISE, y.size)
    return record_of(t + 3600.0 * number, v, y)


def creeping() -> list[Record]:
    """Return two records of a stage with creep and a lag."""
    chain = Creep(CREEP, 0.1, 100.0)
    slow = SlowDomains(tuple(chain.time_constants.tolist()), tuple(chain.gains.tolist()))
    return [simulated(Physics(amplifier=Amplifier(lag=LAG), creep=slow), 0.0, number) for number in (0, 1)]


def periodic() -> list[Record]:
    """Return two records of a stage with a lag and a periodic error of its sensor."""
    return [simulated(Physics(amplifier=Amplifier(lag=LAG)), PERIODIC, number) for number in (0, 1)]


def mirror(folder: Path) -> list[Record]:
    """Return the four records of the measured mirror."""
    return [import_table(folder / f"mirror_{name}.csv") for name in MIRROR]


def _write(records: Callable[[], list[Record]], folder: Path) -> None:
    for number, record in enumerate(records()):
        write_bag(folder / str(number), record)


def costs(clone: Path, bags: list[Path]) -> tuple[Cost, str]:
    """Return the cost of a diagnosis by a clone, and what it says."""
    model, out = bags[0].parent / f"{clone.name}.json", bags[0].parent / f"{clone.name}_diagnosis"
    run(clone, "-m", "slpi_ros.cli", "identify", str(bags[0]), "-o", str(model))
    said = [str(bag) for bag in bags]
    cost, printed = run(clone, "-m", "slpi_ros.cli", "diagnose", *said, "--model", str(model), "-o", str(out))
    return cost, printed


def main() -> None:
    """Print cost and answers of both commits."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--beside", type=Path, metavar="CLONE", required=True, help="built clone of another commit")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    here, measured = Path(__file__).resolve().parent.parent, measured_folder()
    kinds: dict[str, Callable[[], list[Record]]] = {"creep and lag": creeping, "lag and sensor period": periodic}
    if measured:
        kinds["mirror, four records"] = partial(mirror, measured)
    print(f"{'':28}{'other':>18}{'this':>18}{'ratio':>14}   (s, MB)")
    for title, records in kinds.items():
        with tempfile.TemporaryDirectory() as name:
            # Written in another process: the peak memory of a child includes that of its parent at the start.
            maker = multiprocessing.get_context("spawn").Process(target=_write, args=(records, Path(name)))
            maker.start()
            maker.join()
            bags = sorted(Path(name).iterdir())
            (theirs, before), (own, now) = costs(options.beside.resolve(), bags), costs(here, bags)
        show(title, *(f"{cost.seconds:.1f} {cost.memory:4.0f}" for cost in (theirs, own)), *ratios(theirs, own))
        for who, text in (("other", before), ("this", now)):
            print(f"  {who}: " + " ".join(text.split())[:300], flush=True)


if __name__ == "__main__":
    main()
