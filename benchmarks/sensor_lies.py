"""Sensors that lie during a drive: how long exciter and calibrator go on driving after the first sample that shows it.

Runs the watch and the rate limiter of the nodes on simulated stages in simulated time; prints all random seeds.
"""

import argparse
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from math import inf, nan

import numpy as np
from numpy.typing import NDArray

from slpi_ros.calibration.drive_monitor import LATE, DriveMonitor
from slpi_ros.calibration.drive_rules import LASTS_NS
from slpi_ros.calibration.drives import checking, exciting
from slpi_ros.calibration.settings import CalibrationSettings
from slpi_ros.excitation.drives import DRIVES, SLEW_USED, Drive, excite
from slpi_ros.io.messages import SECOND_NS
from slpi_ros.model.limits import Limits, RateLimiter
from slpi_ros.simulation.stage import Stage

LIES = ("replayed", "frozen", "stale stamps", "sign flipped", "moved by 1 mm", "effort 0", "effort stays", "silent")
DRIVERS = ("exciter", "calibrator")
LOW, HIGH = 0.0, 100.0
TIMEOUT, PERIOD = 0.5, 1.0 / 200.0
# A lie shows in the first sample that is off by this share of stroke or voltage range, or by this time (s). A voltage
# is off that has not been output within the time that reports may be late, for as long as a fault has to last.
SHOWS, SHOWS_SECONDS = 0.05, 0.3
# Longest time driven after that, seconds: the mark.
MARK = 1.0
# Slowest motion of a voltage, ranges/s: slower is a hold.
MOVES = 1e-3
CLOCK_NS = 1_800_000_000 * SECOND_NS


@dataclass(frozen=True)
class Sensor:
    """What lies between a stage and its states.

    Parameters
    ----------
    period : float, seconds
        Of the states.
    late : float, seconds
        From measurement to arrival.
    noise : float
        As a share of the stroke, rms.
    quantum : float
        Resolution, as a share of the stroke.
    gain : float
        Displacement reported per displacement; negative: sign changed by construction.
    full_scale : float
        Largest reading, as a share of the stroke.
    """

    period: float = PERIOD
    late: float = 0.005
    noise: float = 0.001
    quantum: float = 0.0
    gain: float = 1.0
    full_scale: float = inf


@dataclass(frozen=True)
class Life:
    """What happened: the fault that was found (""), when it was found and when the lie first showed, seconds.

    `driven` is the time in between in which the voltage moved, seconds, and `moved` the way, in voltage ranges.
    """

    fault: str
    found: float = nan
    shown: float = nan
    driven: float = inf
    moved: float = 0.0


@dataclass(frozen=True)
class _Truth:
    """Samples of a drive on a stage: s, V (N, axes), m (N, axes)."""

    t: NDArray[np.float64]
    v: NDArray[np.float64]
    y: NDArray[np.float64]


def drives_of(driver: str, axes: Sequence[str], seed: int, slew: float, drive: str, seconds: float) -> list[Drive]:
    """Return the drives of a run of the exciter or of the calibrator."""
    if driver == "exciter":
        return [
            excite(
                axes, voltage_min=LOW, voltage_max=HIGH, slew_limit=SLEW_USED * slew, start=LOW, duration=seconds,
                seed=seed, drive=drive,
            )
        ]  # fmt: skip
    limits = (Limits(LOW, HIGH, slew),) * len(axes)
    settings = CalibrationSettings(tuple(axes), limits, (LOW,) * len(axes), 1.0 / PERIOD, 400.0 * len(axes))
    return [checking(settings), exciting(settings, drive, seconds, axes, seed)]


def driven(stage: Stage, drive: Drive, limits: Limits, begun: float) -> _Truth:
    """Return what the stage does during a drive through the rate limiter; it rests two seconds afterwards."""
    goals = np.column_stack(list(drive.voltage.values()))
    goals = np.vstack([goals, np.repeat(goals[-1:], round(0.3 / PERIOD), axis=0)])
    limiters = [RateLimiter(limits, PERIOD, v) for v in goals[0].tolist()]
    t = begun + PERIOD * np.arange(len(goals))
    v, y = np.empty_like(goals), np.empty_like(goals)
    for index, row in enumerate(goals.tolist()):
        now_ns = round(t[index] * SECOND_NS)
        v[index] = [limiter.step(goal, now_ns) for limiter, goal in zip(limiters, row, strict=True)]
        y[index] = stage.step(float(t[index]), v[index].tolist())
    return _Truth(t, v, y)


def live(
    driver: str, lie: str, stage: Stage, sensor: Sensor, seed: int,
    *, slew: float = 1000.0, drive: str = "calibration", seconds: float = 30.0, at: float = 0.5,
) -> Life:  # fmt: skip
    """Return what the watch finds in a run in which a sensor begins to lie at a share of the last drive; "" : none."""
    rng = np.random.default_rng([seed, 40])
    axes, limits = list(stage.axes), Limits(LOW, HIGH, slew)
    watch = DriveMonitor(axes, [limits] * len(axes), TIMEOUT)
    now, start = 10.0, [LOW] * len(axes)
    runs = []
    for each in drives_of(driver, axes, seed, slew, drive, seconds):
        runs.append(driven(stage, each, limits, now))
        now = float(runs[-1].t[-1]) + 2.0
    y_all = np.vstack([run.y for run in runs])
    stroke = float(np.ptp(y_all[:, 0])) or 1e-9
    rest = runs[0].y[0]
    spacing = max(round(sensor.period / PERIOD), 1)
    for index in range(-max(5 * spacing, 100), 0):
        before = 10.0 + PERIOD * index
        watch.check(round(before * SECOND_NS))
        if index % spacing == 0:
            _tell(watch, before, before, start, sensor.gain * rest)
    for number, run in enumerate(runs):
        life = _watched(watch, run, lie if number == len(runs) - 1 else "", sensor, stroke, rng, at)
        if life.fault:
            return life
    return life


def _tell(watch: DriveMonitor, now: float, stamp: float, v: Sequence[float], y: Sequence[float]) -> None:
    watch.state(
        CLOCK_NS + round(stamp * SECOND_NS), CLOCK_NS + round(now * SECOND_NS), list(v), list(y), round(now * SECOND_NS)
    )


def _watched(
    watch: DriveMonitor, run: _Truth, lie: str, sensor: Sensor, stroke: float, rng: np.random.Generator, at: float
) -> Life:
    begun, count = run.t[0], run.t.size
    lies_from = begun + at * (run.t[-1] - begun) if lie else inf
    y = sensor.gain * run.y + abs(sensor.gain) * stroke * rng.normal(0.0, sensor.noise, run.y.shape)
    if sensor.quantum:
        step = abs(sensor.gain) * stroke * sensor.quantum
        y = np.round(y / step) * step
    y = np.minimum(y, abs(sensor.gain) * stroke * sensor.full_scale)
    watch.begin(run.v[0].tolist(), round(begun * SECOND_NS))
    first = min(int(np.searchsorted(run.t, lies_from)), count - 1)
    spacing = max(round(sensor.period / PERIOD), 1)
    shown, contradicted, next_state = nan, nan, 0
    size = abs(sensor.gain) * stroke
    recent = round(LATE * TIMEOUT / PERIOD)
    for index in range(count):
        now = float(run.t[index])
        watch.command(run.v[index].tolist(), round(now * SECOND_NS))
        while next_state < count and run.t[next_state] + sensor.late <= now:
            stamp, true_y = float(run.t[next_state]), y[next_state]
            true_v = run.v[max(next_state - recent, 0) : next_state + 1]
            told = _told(lie if next_state >= first else "", next_state, first, run, y, stamp)
            if told is None:
                shown = now if shown != shown else shown
            else:
                said_stamp, said_v, said_y = told
                off = float(np.max(np.abs(said_y - true_y))) / size
                late = np.clip(said_v, true_v.min(axis=0), true_v.max(axis=0))
                if float(np.max(np.abs(said_v - late))) / (HIGH - LOW) <= SHOWS:
                    contradicted = nan
                elif contradicted != contradicted:
                    contradicted = now
                if shown != shown and (off > SHOWS or abs(said_stamp - stamp) > SHOWS_SECONDS):
                    shown = now
                if shown != shown and now - contradicted >= LASTS_NS / SECOND_NS:
                    shown = contradicted
                _tell(watch, now, said_stamp, said_v.tolist(), said_y.tolist())
            next_state += spacing
        fault = watch.check(round(now * SECOND_NS))
        if fault:
            shown = contradicted if shown != shown else shown
            since = int(np.searchsorted(run.t, shown)) if shown == shown else index
            way = np.abs(np.diff(run.v[since : index + 1], axis=0)).sum(axis=1) / (HIGH - LOW)
            return Life(fault, now, shown, PERIOD * np.count_nonzero(way > MOVES * PERIOD), float(way.sum()))
    watch.end()
    return Life("", inf, shown)


def _told(
    lie: str, index: int, first: int, run: _Truth, y: NDArray[np.float64], stamp: float
) -> tuple[float, NDArray[np.float64], NDArray[np.float64]] | None:
    """Return stamp, voltage and displacement of a state; None: no state."""
    v, reading = run.v[index], y[index]
    match lie:
        case "silent":
            return None
        case "replayed":
            # An earlier part of the same drive, with new stamps.
            old = max(index - first, 0) + first // 3
            return stamp, run.v[old], y[old]
        case "frozen":
            return stamp, v, y[first]
        case "stale stamps":
            return float(run.t[first]), v, reading
        case "sign flipped":
            return stamp, v, -reading
        case "moved by 1 mm":
            return stamp, v, reading + 1e-3
        case "effort 0":
            return stamp, np.zeros_like(v), reading
        case "effort stays":
            return stamp, run.v[first], reading
    return stamp, v, reading


def stage_of(seed: int) -> Stage:
    """Return a stage with one or two hidden effects."""
    return Stage.hidden(["x"], seed, 8e-9, rate=1.0 / PERIOD, voltage_max=HIGH)


def lies(count: int) -> None:
    """Print time driven after the first sample that shows each lie, over `count` stages and moments each."""
    print(f"{'driver':11}{'lie':16}{'runs':>5}{'found':>7}{'driven s':>10}{'largest':>9}{'with holds':>12}{'way':>8}")
    worst = 0.0
    for driver in DRIVERS:
        for lie in LIES:
            found = []
            runs = 0
            for seed in range(count):
                at = float(np.random.default_rng([seed, 41]).uniform(0.05, 0.9))
                life = live(driver, lie, stage_of(seed), Sensor(), seed, at=at)
                if life.shown == life.shown:
                    runs += 1
                    found.append((life.driven, life.found - life.shown, life.moved))
            seconds, passed, ways = np.array(found).T
            worst = max(worst, float(seconds.max()))
            print(
                f"{driver:11}{lie:16}{runs:5}{np.isfinite(seconds).sum():7}{np.median(seconds):10.3f}"
                f"{seconds.max():9.3f}{passed.max():12.3f}{ways.max():8.0%}",
                flush=True,
            )
    print(f"\nseeds 0 to {count - 1}; longest time driven {worst:.3f} s, mark {MARK:g} s\n")


SENSORS = {
    "usual": Sensor(),
    "1 Hz": Sensor(period=1.0),
    "10 Hz": Sensor(period=0.1),
    "40 ms late": Sensor(late=0.04),
    "noise 3 % of the stroke": Sensor(noise=0.03),
    "quantum 3 % of the stroke": Sensor(quantum=0.03, noise=0.0),
    "negative gain": Sensor(gain=-1.0),
    "gain 1e-3": Sensor(gain=1e-3),
    "full scale at 92 %": Sensor(full_scale=0.92),
}


def alarms(count: int) -> None:
    """Print false alarms on honest sensors, over all drives and `count` stages each."""
    table: dict[str, list[str]] = defaultdict(list)
    total = 0
    for seed in range(count):
        for name, sensor in SENSORS.items():
            for driver in DRIVERS:
                drive = DRIVES[(seed + len(name)) % len(DRIVES)]
                drive = "calibration" if drive == "cross_coupling" else drive
                life = live(driver, "", stage_of(seed), sensor, seed, drive=drive, seconds=40.0)
                total += 1
                if life.fault:
                    table[name].append(f"{driver}, {drive}, seed {seed}: {life.fault}")
    for name, found in table.items():
        for each in found:
            print(f"{name}: {each}")
    print(f"false alarms: {sum(map(len, table.values()))} of {total} honest runs, seeds 0 to {count - 1}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=20, help="stages for each lie; default: 20")
    parser.add_argument("--honest", type=int, default=20, help="stages with honest sensors; default: 20")
    options = parser.parse_args()
    if options.count:
        lies(options.count)
    if options.honest:
        alarms(options.honest)
