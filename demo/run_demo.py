"""Real processes over DDS: the calibrator calibrates a stage with hidden effects, which then follows a new path.

A simulated stage stands in for yours; it is no model of the compensator. Run it with ``make demo``; ``SEED=`` repeats
one.
"""

import argparse
import re
import secrets
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path

sys.path.append(str(Path(__file__).resolve().parents[1]))

from benchmarks.ros_domain import keep_to_own_domain, require_nobody_else  # noqa: E402

# Before rclpy is loaded.
keep_to_own_domain()

import numpy as np  # noqa: E402
import plots  # noqa: E402
from graph import EXECUTABLES, FloatArray, Operator, executable, operator  # noqa: E402
from promise import best_of, kept  # noqa: E402

import slpi_ros  # noqa: E402
from benchmarks.paths import scan_path  # noqa: E402
from slpi_ros.calibration.settings import VERIFICATION  # noqa: E402
from slpi_ros.reports.page import Page, png  # noqa: E402
from slpi_ros.reports.text import describe_model  # noqa: E402
from slpi_ros.simulation.stage import Stage  # noqa: E402

RATE = 100.0
V_MIN, V_MAX, SLEW = 0.0, 100.0, 1000.0
# The calibration runs faster than in life; the comparison is in real time, on the next day of the stage, after it has
# been switched on for about as long as at the end of the calibration: a stage that still warms up drifts faster.
SPEED = 2.0
NOISE = 8e-9
# The path stays away from the ends of what can be reached by this share: the zero may go on moving.
MARGIN = 0.05
# The sensor is connected as in README.
SENSOR = "measured_displacement:=stage_state"
KINDS = {"pi": "classical PI", "slpi": "SLPI"}


def wipe(stage: Operator) -> tuple[float, float]:
    """Sweep the full range, so that the memory is wiped; return what can be reached from then on, (m, m)."""
    if stage.state.effort:
        stage.drive(np.linspace(stage.state.effort[0], V_MIN, int(RATE)).tolist(), RATE)
    sweep = V_MIN + (V_MAX - V_MIN) * (1 - np.cos(np.linspace(0.0, 2 * np.pi, int(2 * RATE)))) / 2
    falling = stage.drive([*sweep, *[V_MIN] * 20], RATE)[sweep.size // 2 :, 1]
    return float(falling.min()), float(falling.max())


def stage_simulator(seed: int, speed: float, warm_up: float = 0.0) -> AbstractContextManager[object]:
    """Run a stage with one or two effects that it does not tell.

    With `warm_up` (s) it has been on for so long, and was moved over its whole range the day before.
    """
    given = {"rate": RATE, "noise_rms": NOISE, "speed": speed, "warm_up": warm_up}
    if warm_up:
        given["initial_state"] = f"[{V_MIN}, {V_MAX}, {V_MIN}]"
    return executable("stage_simulator", seed=seed, character="hidden", **given)


def calibrate_itself(seed: int, folder: Path) -> tuple[float, float, float]:
    """Let the calibrator calibrate the stage into a folder.

    Return the mean error (m) that it found at last, that without its offset, and how long (s) the stage was on.
    """
    given = {"voltage_min": V_MIN, "voltage_max": V_MAX, "slew_limit": SLEW, "rate": RATE, "output": str(folder)}
    said, began = None, time.monotonic()
    node = executable("calibrator", log="info", listen=True, use_sim_time=True, **given)
    with stage_simulator(seed, SPEED), node as calibrator:
        for line in calibrator.stderr or ():
            print(line.decode(), end="", file=sys.stderr, flush=True)
            # Of the last verification: with and without its offset.
            said = re.search(r"mean error (\S+) (nm|µm) .* without it (\S+) (nm|µm)", line.decode()) or said
        calibrator.wait()
        on = SPEED * (time.monotonic() - began)
    # 1 says that the target was missed, and why; there is a model nevertheless.
    if not said or not (folder / "model.json").exists():
        raise SystemExit("demo: the calibration failed; the line above says why")
    mean, rest = (float(said[k]) * {"nm": 1e-9, "µm": 1e-6}[said[k + 1]] for k in (1, 3))
    return mean, rest, on


def identify(bag: Path, model: Path, kind: str) -> None:
    """Identify a model with the command line, as a user does."""
    command = [EXECUTABLES / "slpi", "identify", bag, "-o", model, "--kind", kind]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def follow_uncompensated(stage: Operator, t: FloatArray, y: FloatArray, low: float, high: float) -> plots.Run:
    """Follow a path with voltages from a straight line through the ends of the stroke."""
    v = V_MIN + (y - low) / (high - low) * (V_MAX - V_MIN)
    return plots.Run("uncompensated", t, y, stage.drive(v.tolist(), RATE)[:, 1])


def follow_compensated(
    stage: Operator, name: str, model: Path, scan: Callable[[float, float], tuple[FloatArray, FloatArray]]
) -> plots.Run:
    """Follow a path, which `scan` returns for what can be reached (m), with the compensator in between."""
    limits = {"voltage_min": V_MIN, "voltage_max": V_MAX}
    with executable("compensator", SENSOR, log="error", model_file=str(model), **limits):
        stage.await_compensator()
        # As the calibrator does: the memory is reset, and the zero is that of the sweep.
        t, y = scan(*stage.reset())
        # To the begin of the path without a jump, from where the reset has left the stage.
        at = float(stage.state.position[0])
        approach = at + (y[0] - at) * (1 - np.cos(np.linspace(0.0, np.pi, int(RATE)))) / 2
        path = np.concatenate([approach, y])
        asked = slpi_ros.load_model(model).axes["x"].in_advance(np.arange(path.size) / RATE, path)
        measured = stage.follow(asked.tolist(), RATE)[-y.size :, 1]
        late = tuple(float(t[max(k - approach.size, 0)]) for k in stage.late)
        return plots.Run(name, t, y, measured, stage.held_at_limit() / y.size, late)


def compared(seed: int, models: Mapping[str, Path], duration: float, warm_up: float) -> list[plots.Run]:
    """Follow a path that no record holds, without and with each model, on the next day, after `warm_up` (s)."""
    with stage_simulator(seed, 1.0, warm_up), operator() as stage:
        stage.wait_until("the stage to be ready", lambda: stage.voltage.get_subscription_count() >= 1)
        paths: list[tuple[FloatArray, FloatArray]] = []

        def scan(low: float, high: float) -> tuple[FloatArray, FloatArray]:
            margin = MARGIN * (high - low)
            if not paths:
                paths.append(scan_path(low + margin, high - margin, duration=duration, rate=RATE, seed=seed))
            return paths[0]

        # First that of which the calibrator has told the error: from rest, as then. A stage that has moved creeps less.
        runs = {name: follow_compensated(stage, name, model, scan) for name, model in reversed(models.items())}
        low, high = wipe(stage)
        every = [follow_uncompensated(stage, *paths[0], low, high), *(runs[name] for name in models)]
    # The same ruler for all, that of the calibrator: known errors of the sensor are none of the stage.
    ruler = slpi_ros.load_model(models["SLPI with causes"]).axes["x"]
    return [replace(run, displacement=ruler.correct(run.t, run.displacement)) for run in every]


def table_of(runs: Sequence[plots.Run], stroke: float) -> list[list[str]]:
    """Return the mean error of each run, its offset, and mean and maximum without it."""
    rows = []
    for run in runs:
        constant = float(np.median(run.error))
        rest = np.abs(run.error - constant)
        mean = float(np.abs(run.error).mean())
        shares = (f"{x / stroke:.3%}" for x in (rest.mean(), rest.max()))
        rows.append([run.name, f"{mean * 1e6:.3f} µm", f"{mean / stroke:.3%}", f"{constant * 1e6:+.3f} µm", *shares])
    return rows


HEADER = ["path not in the records", "mean error", "of stroke", "offset", "without offset, mean", "maximum"]


def write_page(
    path: Path, seed: int, rows: list[list[str]], runs: list[plots.Run], told: str, model: slpi_ros.StageModel
) -> None:
    """Write the page, and the tracking picture beside it."""
    page = Page("A piezo stage that calibrated itself")
    page.text(
        f"A simulated stage with hysteresis and hidden effects (seed {seed}) calibrated itself: it recorded what was "
        "needed, identified a model and searched for causes of what was left. On the next day, after it had warmed up "
        "for as long as then, it followed a path that no record holds. Simulator, calibrator and compensator ran as "
        "separate ROS 2 processes. Errors in the table include the offset, after a reset and ~/set_zero; then follow "
        "the offset and the error without it. Errors of the sensor that the calibrator has found are taken out of all "
        "readings; 8 nm rms of its noise are included."
    )
    page.table(HEADER, rows, best=best_of(runs))
    page.text(told)
    chart, said = plots.over_time(runs)
    page.chart("tracking", chart, f"Displacement, and measured - desired displacement, over time. {said}")
    page.chart("linearity", plots.over_desired(runs), "Measured over desired displacement: a straight line is the aim.")
    page.heading("The model")
    page.lines(describe_model(model))
    page.text("calibration/report.html shows the calibration: what was recorded, why, and what each record showed.")
    page.write(path)
    path.with_name("tracking.png").write_bytes(png(plots.picture(runs)))


def out_of_reach(runs: Sequence[plots.Run]) -> str:
    """Return a sentence about the samples that no voltage reaches, which no model can follow; "" if none."""
    held = [f"{run.name} {run.held:.1%}" for run in runs if run.held]
    if not held:
        return ""
    return (
        f" A part of the path was out of reach on this day, held at a voltage limit: {', '.join(held)} of the samples. "
        "The errors there, and the maximum, say nothing of the model."
    )


def hidden_and_found(seed: int, model: slpi_ros.StageModel) -> str:
    """Return a sentence about the effects of the stage, and those in the model."""
    hidden = Stage.hidden(("x",), seed, NOISE, rate=RATE, voltage_max=V_MAX).effects["x"]
    found = [effect.name for effect in model.axes["x"].effects]
    return f"Hidden in the stage: {', '.join(hidden)}. In the model: {', '.join(found) or 'none'}."


def main() -> int:
    """Run the demo."""
    # Its nodes end with it.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit("demo: terminated"))
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, default=Path("demo_output"), help="folder for the pages")
    parser.add_argument("--seed", type=int, help="which stage; default: a random one")
    parser.add_argument("--path", type=float, default=VERIFICATION, help="seconds of path; default: as the calibrator")
    options = parser.parse_args()
    require_nobody_else()
    began = time.monotonic()
    seed = secrets.randbelow(10_000) if options.seed is None else options.seed
    print(f"stage {seed} (SEED={seed} repeats it) is calibrated, {SPEED:g} times as fast as in life", flush=True)
    calibration = options.output / "calibration"
    shutil.rmtree(calibration, ignore_errors=True)
    promised, without_offset, on = calibrate_itself(seed, calibration)
    # The first one: where no known cause explains the error, another one is recorded.
    bag = min(calibration.glob("*_calibration"))
    with tempfile.TemporaryDirectory(prefix="slpi_demo_") as work:
        models = {name: Path(work) / f"{kind}.json" for kind, name in KINDS.items()}
        for kind, name in KINDS.items():
            identify(bag, models[name], kind)
        models["SLPI with causes"] = calibration / "model.json"
        model = slpi_ros.load_model(calibration / "model.json")
        low, high = model.axes["x"].displacement_range
        print(f"following a new path of {options.path:g} s, {1 + len(models)} times", flush=True)
        runs = compared(seed, models, options.path, on)
    rows = table_of(runs, high - low)
    told = hidden_and_found(seed, model) + kept(promised, without_offset, runs) + out_of_reach(runs)
    page = options.output / "report.html"
    write_page(page, seed, rows, runs, told, model)
    print()
    for row in [HEADER, *rows]:
        print(f"{row[0]:<24}" + "".join(f"{cell:>15}" for cell in row[1:]))
    print(f"\n{told} Stroke {(high - low) * 1e6:.1f} µm, sensor noise {NOISE * 1e9:g} nm rms included.")
    print(f"{time.monotonic() - began:.0f} s. Page: {page.resolve()}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
