"""The whole line as real processes over DDS: calibration drive, bag, models, compensation of a path not in the bag.

A simulated stage stands in for yours; it is no model of the compensator. Run it with ``make demo``.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

# Before rclpy is loaded: the demo keeps to this machine, and to a domain of its own.
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ.setdefault("ROS_DOMAIN_ID", str(60 + os.getpid() % 40))

sys.path.append(str(Path(__file__).resolve().parents[1]))

import numpy as np  # noqa: E402
import plots  # noqa: E402
from graph import EXECUTABLES, FloatArray, Operator, executable, operator  # noqa: E402

import slpi_ros  # noqa: E402
from benchmarks.paths import scan_path  # noqa: E402
from slpi_ros.excitation.drives import calibration_drive  # noqa: E402
from slpi_ros.reports.page import Page, png  # noqa: E402
from slpi_ros.reports.text import describe_model  # noqa: E402
from slpi_ros.reports.views import show_model  # noqa: E402

RATE = 250.0
V_MIN, V_MAX = 0.0, 100.0
# The graph shows a node a moment before its topics are connected, seconds.
SETTLE = 3.0
KINDS = {"pi": "classical PI", "slpi": "SLPI"}


def wipe(stage: Operator) -> float:
    """Sweep the full range, so that the memory is wiped, and return where the stage is at the low end (m)."""
    sweep = V_MIN + (V_MAX - V_MIN) * (1 - np.cos(np.linspace(0.0, 2 * np.pi, int(2 * RATE)))) / 2
    return float(np.mean(stage.drive([*sweep, *[V_MIN] * 20], RATE)[-20:, 1]))


def calibrate(stage: Operator, bag: Path, duration: float) -> None:
    """Record a calibration drive."""
    wipe(stage)
    _, v = calibration_drive(V_MIN, V_MAX, duration=duration, rate=RATE, seed=1)
    with executable("recorder", output=str(bag)):
        stage.wait_until("the recorder to listen", lambda: stage.count_subscribers("stage_state") >= 2)
        time.sleep(SETTLE)
        stage.drive(v.tolist(), RATE)


def identify(bag: Path, model: Path, kind: str) -> slpi_ros.StageModel:
    """Identify a model with the command line, as a user does."""
    subprocess.run(
        [EXECUTABLES / "slpi", "identify", bag, "-o", model, "--kind", kind], check=True, stdout=subprocess.DEVNULL
    )
    return slpi_ros.load_model(model)


def follow_uncompensated(stage: Operator, t: FloatArray, y: FloatArray, low: float, high: float) -> plots.Run:
    """Follow a path with voltages from a straight line through the ends of the stroke."""
    wipe(stage)
    v = V_MIN + (y - low) / (high - low) * (V_MAX - V_MIN)
    return plots.Run("uncompensated", t, y, stage.drive(v.tolist(), RATE)[:, 1])


def follow_compensated(stage: Operator, name: str, model: Path, t: FloatArray, y: FloatArray) -> plots.Run:
    """Follow a path with the compensator in between."""
    wipe(stage)
    with executable("compensator", model_file=str(model), voltage_min=V_MIN, voltage_max=V_MAX):
        stage.wait_until(
            "the compensator to be ready",
            lambda: (
                stage.count_publishers("voltage_command") >= 2 and stage.count_subscribers("desired_displacement") >= 1
            ),
        )
        time.sleep(SETTLE)
        return plots.Run(name, t, y, stage.follow(y.tolist(), RATE)[:, 1])


def table_of(runs: Sequence[plots.Run], stroke: float) -> list[list[str]]:
    """Return mean and maximum error of each run in µm and % of stroke, without the constant offset of each.

    A classical PI model may lie beside the stage as a whole, which says nothing of its loops.
    """
    rows = []
    for run in runs:
        size = np.abs(run.error - np.median(run.error))
        values = [
            f"{x * 1e6:.3f} µm" if unit else f"{x / stroke:.3%}" for x in (size.mean(), size.max()) for unit in (1, 0)
        ]
        rows.append([run.name, *values])
    return rows


HEADER = ["path not in the bag", "mean error", "of stroke", "maximum", "of stroke"]


def write_page(
    path: Path, rows: list[list[str]], runs: list[plots.Run], record: slpi_ros.Record, model: slpi_ros.StageModel
) -> None:
    """Write the page, and the tracking picture beside it."""
    page = Page("A piezo stage, compensated")
    page.text(
        "A simulated stage with hysteresis was driven through a calibration, recorded into a bag, identified, and "
        "then asked to follow a path that was not in the bag. Simulator, recorder and compensator ran as separate "
        "ROS 2 processes. Errors in the table are without the constant offset of each run."
    )
    page.table(HEADER, rows, best=len(rows) - 1)
    chart, said = plots.over_time(runs)
    page.chart("tracking", chart, f"Displacement, and measured - desired displacement, over time. {said}")
    page.chart("linearity", plots.over_desired(runs), "Measured over desired displacement: a straight line is the aim.")
    page.heading("The model")
    page.lines(describe_model(model))
    page.section("The calibration")
    v, y = record.voltage["x"], record.displacement["x"]
    floor, whole = model.axes["x"].quality.floor_rms, np.ones(v.size, dtype=bool)
    show_model(page, "model", record.t, v, y, model.simulate(record.t, v), floor, whole)
    page.write(path)
    path.with_name("tracking.png").write_bytes(png(plots.picture(runs)))


def main() -> int:
    """Run the demo."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, default=Path("demo_output"), help="folder for the page")
    parser.add_argument("--seed", type=int, default=1, help="which simulated stage")
    parser.add_argument("--calibration", type=float, default=30.0, help="seconds of calibration drive")
    parser.add_argument("--path", type=float, default=15.0, help="seconds of path to follow")
    options = parser.parse_args()
    work = Path(tempfile.mkdtemp(prefix="slpi_demo_"))
    try:
        with executable("stage_simulator", seed=options.seed), operator() as stage:
            stage.wait_until("the stage to be ready", lambda: stage.voltage.get_subscription_count() >= 1)
            print(f"calibrating: {options.calibration:g} s of drive, recorded into a bag")
            calibrate(stage, work / "bag", options.calibration)
            record = slpi_ros.read_bag(work / "bag")
            print(f"identifying from {len(record)} samples")
            models = {kind: identify(work / "bag", work / f"{kind}.json", kind) for kind in KINDS}
            low, high = wipe(stage), float(record.displacement["x"].max())
            stroke = high - low
            t, y = scan_path(
                low + 0.03 * stroke, high - 0.03 * stroke, duration=options.path, rate=RATE, seed=options.seed
            )
            print(f"following a new path of {options.path:g} s, three times")
            runs = [follow_uncompensated(stage, t, y, low, high)]
            runs += [follow_compensated(stage, name, work / f"{kind}.json", t, y) for kind, name in KINDS.items()]
        rows = table_of(runs, stroke)
        page = options.output / "report.html"
        write_page(page, rows, runs, record, models["slpi"])
    finally:
        shutil.rmtree(work, ignore_errors=True)
    print()
    for row in [HEADER, *rows]:
        print(f"{row[0]:<22}" + "".join(f"{cell:>13}" for cell in row[1:]))
    print(f"\nstroke {stroke * 1e6:.1f} µm, sensor noise 8 nm rms included. Page: {page.resolve()}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
