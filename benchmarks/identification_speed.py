"""Cost of an identification: beside another commit, of its quadratic programs beside OSQP, and against size.

``--beside CLONE``, a built clone of another commit: time and peak memory of ``slpi identify`` as a whole process, time
in quadratic programs, and how far the free runs of both models are apart on the voltages of the record. The two take
turns, and the least of several runs counts. ``--measured``: every quadratic program of every measured record beside
OSQP with a tolerance of 1e-9; SLPI_MEASURED_DATA is the folder of the records. ``--plot FILE``: processor time over
samples and vertices.
"""

import argparse
import json
import multiprocessing
import os
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import osqp
import scipy.sparse as sp
from accuracy import FloatArray, calibrated, record_of
from hidden.physics import Amplifier, Physics, RateLaw, SlowDomains, Viscosity, own_motion
from records import measured_folder

import slpi_ros
from slpi_ros.errors import SlpiError
from slpi_ros.identification import least_squares, linear_kinds
from slpi_ros.io.bag_writer import write_bag
from slpi_ros.io.record import Record
from slpi_ros.io.tables import import_table
from slpi_ros.simulation.dynamics import Creep
from slpi_ros.simulation.parameters import AxisParameters

RUNS = 3
LAG, CREEP, NOISE, BAD, BAD_SHARE = 20e-3, 0.02, 8e-9, 0.5e-6, 0.03
# Tolerances of OSQP in the other commit: its answers come nearer the closer they are.
TOLERANCES = (1e-9, 1e-11)
# Samples and vertices of the plot.
SIZES, GRIDS = (10_000, 100_000, 1_000_000, 3_000_000), (10, 21, 41, 81)


def active(samples: int = 80_000, rate: float = 1000.0, seed: int = 7) -> Record:
    """Return a decaying oscillation on a stage with lag, creep and a rate law, 3 % of whose readings are bad."""
    rng, t = np.random.default_rng(seed), np.arange(samples) / rate
    v = 50.0 + 50.0 * np.linspace(1.0, 0.02, samples) * np.sin(4.0 * np.pi * t - np.pi / 2)
    chain = Creep(CREEP, 0.1, 100.0)
    physics = Physics(
        amplifier=Amplifier(lag=LAG),
        viscosity=Viscosity(RateLaw(3.0), "coercivity", 5.0),
        creep=SlowDomains(tuple(chain.time_constants.tolist()), tuple(chain.gains.tolist())),
    )
    y = own_motion(AxisParameters.random(seed), physics, t, v) + rng.normal(0.0, NOISE, samples)
    bad = rng.random(samples) < BAD_SHARE
    y[bad] += rng.normal(0.0, BAD, np.count_nonzero(bad))
    return record_of(t, v, y)


def clean(samples: int, rate: float) -> Record:
    """Return a calibration record of a stage without any other effect."""
    return calibrated(0, samples / rate, rate)[0]


# A million samples as they are recorded, and so few that the start of the process counts.
RECORDS = {
    "constraints active, 80,000": active,
    "clean, 952,000": partial(clean, 952_000, 10_000.0),
    "clean, 4,000": partial(clean, 4_000, 200.0),
}


def _write(bag: Path, title: str) -> None:
    write_bag(bag, RECORDS[title]())


# Runs in either clone: time in quadratic programs, and the displacement along the voltages of the bag.
INSIDE = """
import json, sys, time, numpy, slpi_ros
from slpi_ros.identification import least_squares
bag, tolerance, out = sys.argv[1], float(sys.argv[2]), sys.argv[3]
spent = [0.0, 0]
def timed(owner, name, count):
    whole = getattr(owner, name)
    def call(*arguments, **options):
        began = time.process_time()
        try:
            return whole(*arguments, **options)
        finally:
            spent[0] += time.process_time() - began
            spent[1] += count
    setattr(owner, name, call)
if hasattr(least_squares, "solve_qp"):
    timed(least_squares, "solve_qp", 1)
    if tolerance:
        least_squares.TOLERANCE = tolerance
else:
    timed(least_squares.QuadraticProgram, "__init__", 0)
    timed(least_squares.QuadraticProgram, "solve", 1)
record = slpi_ros.read_bag(bag)
model = slpi_ros.identify(record).axes["x"]
numpy.save(out, model.memory("start").forward_array(record.voltage["x"]))
print(json.dumps(spent))
"""


class Cost(NamedTuple):
    """Processor time (s) and peak memory (MB) of a process."""

    seconds: float
    memory: float


def run(clone: Path, *arguments: str) -> tuple[Cost, str]:
    """Run the Python of a clone, in its folder and on one thread; return the cost and what was printed."""
    python = clone / ".venv" / "bin" / "python"
    environment = {**os.environ, "PYTHONPATH": str(clone), "OPENBLAS_NUM_THREADS": "1"}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    with tempfile.TemporaryFile("w+") as printed:
        with subprocess.Popen([str(python), *arguments], stdout=printed, env=environment, cwd=clone) as process:
            _, status, usage = os.wait4(process.pid, 0)
            process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            sys.exit(f"{python} {arguments[:4]} failed with exit code {process.returncode}")
        printed.seek(0)
        return Cost(usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1e3), printed.read()


def beside(here: Path, other: Path, runs: int) -> None:
    """Print cost and results of both clones on each record."""
    print(f"{'':28}{'other':>18}{'this':>18}{'ratio':>14}   (s, MB)")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for title in RECORDS:
            bag = folder / f"bag_{len(list(folder.iterdir()))}"
            # Written in another process: the peak memory of a child includes that of its parent at the start.
            maker = multiprocessing.get_context("spawn").Process(target=_write, args=(bag, title))
            maker.start()
            maker.join()
            costs: dict[Path, list[Cost]] = {other: [], here: []}
            # The first run of each compiles what is not compiled yet.
            for count in range(runs + 1):
                for clone in costs:
                    command = ("-m", "slpi_ros.cli", "identify", str(bag), "-o", str(folder / f"{count}.json"))
                    costs[clone].append(run(clone, *command)[0])
            least = [Cost(*np.min(costs[clone][1:], axis=0).tolist()) for clone in (other, here)]
            show(title, *(f"{cost.seconds:.2f} {cost.memory:4.0f}" for cost in least), *ratios(*least))
            first, second = (json.loads((folder / f"{k}.json").read_text()) for k in (0, 1))
            del first["created"], second["created"]
            assert first == second, "two runs of this commit give different documents"
            programs(here, other, bag)


def show(title: str, other: str, this: str, *ratio: str) -> None:
    """Print a line of the table."""
    print(f"{title:28}{other:>18}{this:>18}{' '.join(ratio):>14}", flush=True)


def ratios(other: Cost, this: Cost) -> tuple[str, str]:
    """Return how many times faster this is, and its share of the memory."""
    return f"{other.seconds / this.seconds:.2f}", f"{this.memory / other.memory:.2f}"


def programs(here: Path, other: Path, bag: Path) -> None:
    """Print the time in quadratic programs, and the largest distance of free runs, also of closer tolerances there."""
    paths: list[FloatArray] = []
    spent = []
    for clone, tolerance in ((here, 0.0), (other, 0.0), *((other, tolerance) for tolerance in TOLERANCES)):
        out = bag.parent / f"path{len(paths)}.npy"
        spent.append(json.loads(run(clone, "-c", INSIDE, str(bag), str(tolerance), str(out))[1]))
        paths.append(np.load(out))
    (own, count), (before, _), *_ = spent
    show(f"  {count} quadratic programs", f"{before:.3f}", f"{own:.3f}", f"{before / own:.1f}")
    apart = [float(np.max(np.abs(paths[0] - path)) / np.ptp(paths[0])) for path in paths[1:]]
    closer = ", ".join(f"{far:.1e} at {tolerance:g}" for far, tolerance in zip(apart[1:], TOLERANCES, strict=True))
    print(f"  free runs apart, of stroke{apart[0]:18.1e}  ({closer})", flush=True)


def measured(folder: Path) -> None:
    """Print, for every measured record, the worst of its quadratic programs beside OSQP with a tolerance of 1e-9."""
    whole, found = least_squares.QuadraticProgram.solve, list[tuple[float, float, float, bool]]()

    def both(self: Any, vector: FloatArray, near: FloatArray | None = None) -> least_squares.Solution:
        solution: least_squares.Solution = whole(self, vector, near)
        matrix, constraints, bound = self._matrix, self._constraints, self._bound
        solver = osqp.OSQP()
        solver.setup(
            sp.csc_matrix(np.triu(matrix)), -vector, sp.csc_matrix(constraints), bound, np.full(bound.size, np.inf),
            verbose=False, eps_abs=1e-9, eps_rel=1e-9, max_iter=10_000, adaptive_rho_interval=100,
        )  # fmt: skip
        solver.warm_start(x=solution.x)
        x = solver.solve(raise_error=False).x
        value, theirs = (0.5 * z @ matrix @ z - vector @ z for z in (solution.x, x))
        # What OSQP gains by violations counts for nothing.
        lowered = solution.multipliers @ np.maximum(bound - constraints @ x, 0.0)
        violated = [max(0.0, float(np.max(bound - constraints @ z))) for z in (solution.x, x)]
        scale = max(float(np.max(np.abs(solution.x))), 1e-300)
        active = bool(np.any(solution.multipliers > 0.0))
        found.append(((value - theirs - lowered) / abs(value), violated[0] / scale, violated[1] / scale, active))
        return solution

    least_squares.QuadraticProgram.solve = both
    print("\nmeasured record                 programs  active  objective above OSQP's  violated (of largest x), OSQP's")
    for path in sorted(folder.glob("*.csv")):
        found.clear()
        note = ""
        try:
            slpi_ros.identify(replace(import_table(path), source=path.stem))
        except SlpiError as error:
            note = f"  refused: {str(error)[:60]}"
        if not found:
            print(f"{path.stem:34}{note}")
            continue
        above, own, theirs = np.max([one[:3] for one in found], axis=0).tolist()
        count = sum(one[3] for one in found)
        print(f"{path.stem:34}{len(found):6}{count:8}{above:24.1e}{own:26.1e}{theirs:10.1e}{note}", flush=True)
    least_squares.QuadraticProgram.solve = whole


def sizes(path: Path) -> None:
    """Measure and draw the processor time (s) of identifications over samples, a line for each number of vertices."""
    import matplotlib
    from matplotlib.figure import Figure

    matplotlib.rcParams["svg.hashsalt"] = "cost"
    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.add_subplot()
    slpi_ros.identify(calibrated(0, 25.0, 1000.0)[0])
    records = {size: calibrated(0, 100.0, size / 100.0)[0] for size in SIZES}
    for vertices in GRIDS:
        linear_kinds.VERTICES = (vertices,)
        spent = []
        for size, record in records.items():
            began = time.process_time()
            slpi_ros.identify(replace(record, source="record"))
            spent.append(time.process_time() - began)
            print(f"{vertices:3} vertices, {size:9,} samples: {spent[-1]:.2f} s", flush=True)
        axes.loglog(SIZES, spent, "o-", label=f"{vertices} vertices")
    axes.loglog(SIZES, 1e-5 * np.array(SIZES), ":", color="grey", label="10 s for a million")
    axes.set(xlabel="samples", ylabel="processor time (s)")
    axes.legend()
    axes.grid(alpha=0.3)
    figure.savefig(path, metadata={"Date": None})


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the tables that were asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--beside", type=Path, metavar="CLONE", help="built clone of another commit")
    parser.add_argument("--runs", type=int, default=RUNS, help=f"of each process; default {RUNS}")
    parser.add_argument("--measured", action="store_true", help="the programs of measured records beside OSQP")
    parser.add_argument("--plot", type=Path, metavar="FILE", help="draw processor time over size")
    options = parser.parse_args(arguments)
    warnings.simplefilter("ignore")
    if options.beside:
        beside(Path(__file__).resolve().parent.parent, options.beside, options.runs)
    if options.measured and (folder := measured_folder()):
        measured(folder)
    if options.plot:
        sizes(options.plot)


if __name__ == "__main__":
    main()
