"""The drives of a calibration: within all limits, from rest to rest; the verification goes through the compensator."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from slpi_ros.arrays import FloatArray
from slpi_ros.calibration.settings import CHECK, VERIFICATION, CalibrationSettings
from slpi_ros.compensator.controller import Controller
from slpi_ros.errors import UnreachableError, UsageError
from slpi_ros.excitation.drives import SLEW_USED, SWEEP, Drive, excite
from slpi_ros.excitation.legs import DriveSpec, Path
from slpi_ros.io.messages import SECOND_NS
from slpi_ros.io.record import Record
from slpi_ros.model.limits import Limits, RateLimiter
from slpi_ros.model.stage_model import StageModel

# Share of the voltage range that the check moves.
CHECK_MOVE = 0.1
# The verification stays within these shares of the displacement range, at mean speeds between these, ranges/s.
INNER, SPEEDS = (0.04, 0.94), (0.15, 0.8)
# Steepest slope of the inverse relative to its mean slope, for the speed of a path under a slew limit.
STEEPEST_INVERSE = 2.5
# Durations of the sweep before a verification, of the way to a given path and of the return, if the slew limit allows
# them, and of the rest at the end of a given path, seconds.
SWEEP_SECONDS, RETURN_SECONDS, REST_SECONDS = 4.0, 1.0, 0.2
# Time to wait for a goal that the limiter has not reached at the end of a drive, as a share of the drive; share of the
# voltage range within which it is reached.
PATIENCE, CLOSE = 1.0, 1e-6
# A drive that is too short for its slew limit is made longer by this factor, at most this many times.
LONGER, LENGTHENINGS = 1.4, 8
# Longest pause between two records that is simulated, seconds.
LONGEST_PAUSE = 300.0
# Start of the stamps for the compensator: not 0, which means none, nanoseconds.
FIRST_STAMP = SECOND_NS


def exciting(settings: CalibrationSettings, drive: str, duration: float, axes: Sequence[str], seed: int) -> Drive:
    """Return a `drive` of `DRIVES`, of at least `duration` (s), in which some axes move and the others rest."""
    places = [settings.axes.index(axis) for axis in axes]
    limits = [settings.limits[place] for place in places]

    def moving(seconds: float) -> Drive:
        return excite(
            axes,
            voltage_min=[each.lower for each in limits],
            voltage_max=[each.upper for each in limits],
            slew_limit=[_slew(each) for each in limits],
            start=[settings.rest[place] for place in places],
            duration=seconds,
            rate=settings.rate,
            seed=seed,
            drive=drive,
        )

    for _ in range(LENGTHENINGS):
        try:
            return _with_resting(settings, moving(duration))
        except UsageError:
            # A low slew limit needs more time.
            duration *= LONGER
    return _with_resting(settings, moving(duration))


def checking(settings: CalibrationSettings) -> Drive:
    """Return a drive that moves each axis a little in turn, to see whether the stage follows and in which sense."""
    moves = []
    for limits, rest in zip(settings.limits, settings.rest, strict=True):
        spec = _spec(limits, CHECK, settings.rate)
        start = (rest - limits.lower) / spec.span
        path = Path(start)
        for to in (start + CHECK_MOVE if start < 0.5 else start - CHECK_MOVE, start):
            path.to(to, 0.3 * CHECK)
            path.hold(0.2 * CHECK)
        shortest = float(path.fewest_steps(spec).sum()) / spec.rate
        moves.append(path.voltages(replace(spec, duration=max(CHECK, shortest)))[1:])
    ends = np.cumsum([0, *(move.size for move in moves)])
    voltage = {}
    for number, (axis, rest) in enumerate(zip(settings.axes, settings.rest, strict=True)):
        voltage[axis] = np.full(ends[-1] + 1, rest)
        voltage[axis][ends[number] + 1 : ends[number + 1] + 1] = moves[number]
    return _drive(settings, voltage, "Does the voltage follow the command, and the displacement the voltage?")


def compensated(
    settings: CalibrationSettings,
    model: StageModel,
    seed: int,
    before: Sequence[Record] = (),
    pause: float = 0.0,
    *,
    in_advance: bool = True,
) -> tuple[Drive, dict[str, FloatArray]]:
    """Return a drive along a random path through the compensator, after a sweep that makes the memory known.

    It begins `pause` (s) after the records `before`. With `in_advance` a delay is undone, as on a trajectory.
    """
    # Also the desired displacement (m) of each axis, shape (N,): NaN in the sweep before and the return after the path.
    sweep = exciting(settings, SWEEP, _sweep_seconds(settings), settings.axes, seed)
    swept = np.column_stack(list(sweep.voltage.values()))
    controller = Controller(settings.axes, settings.limits, period=1.0 / settings.rate)
    # The records begin at the start of the model; memory and creep go on from them.
    controller.use_model(model, start_memory="start" if before else "wiped")
    dt = 1.0 / settings.rate
    if before:
        t, voltage = driven_so_far(before)
        for axis in controller.axes:
            for v, passed in zip(voltage[axis.name].tolist(), np.diff(t, prepend=t[0]).tolist(), strict=True):
                axis.stream.drive(v, passed)
            axis.stream.wait(pause)
    for row in swept.tolist():
        for axis, v in zip(controller.axes, row, strict=True):
            axis.stream.drive(v, dt)
    controller.configure()
    controller.activate(FIRST_STAMP)
    rng = np.random.default_rng([settings.seed, seed, 99])
    begins = [axis.stream.uncoupled_displacement for axis in controller.axes]
    if settings.path:
        paths = [_given_path(settings, model, place, begin) for place, begin in enumerate(begins)]
    else:
        paths = [_path(settings, model, place, begin, rng) for place, begin in enumerate(begins)]
    longest = max(path.size for path in paths)
    paths = [np.pad(path, (0, longest - path.size), mode="edge") for path in paths]
    rows = np.empty((longest, len(paths)))
    asked = paths
    if in_advance:
        times = np.arange(longest, dtype=np.float64) * dt
        asked = [model.axis(name).in_advance(times, path) for name, path in zip(settings.axes, paths, strict=True)]
    for index, desired in enumerate(np.column_stack(asked).tolist()):
        stamp = FIRST_STAMP + round((index + 1) * dt * SECOND_NS)
        controller.update(stamp, settings.axes, desired, stamp)
        rows[index] = controller.voltages
    back = _returns(settings, rows[-1])
    voltage = dict(zip(settings.axes, np.concatenate([swept, rows, back]).T, strict=True))
    gap = np.full(len(swept), np.nan), np.full(len(back), np.nan)
    wanted = {axis: np.concatenate([gap[0], y, gap[1]]) for axis, y in zip(settings.axes, paths, strict=True)}
    path = "The desired path" if settings.path else "A path that no record holds"
    why = f"{path}, through the compensator: the error of the model."
    drive = _drive(settings, voltage, why, limited=False)
    return drive, {axis: np.pad(y, (0, drive.t.size - y.size), constant_values=np.nan) for axis, y in wanted.items()}


def driven_so_far(records: Sequence[Record]) -> tuple[FloatArray, dict[str, FloatArray]]:
    """Return times (s) and voltages (V) of successive records; a long pause between them is shortened."""
    known = [np.all([np.isfinite(v) for v in record.voltage.values()], axis=0) for record in records]
    time_ns = np.concatenate([record.time_ns[own] for record, own in zip(records, known, strict=True)])
    t = np.cumsum(np.minimum(np.diff(time_ns, prepend=time_ns[0]) * 1e-9, LONGEST_PAUSE))
    return t, {
        axis: np.concatenate([record.voltage[axis][own] for record, own in zip(records, known, strict=True)])
        for axis in records[0].voltage
    }


def _given_path(settings: CalibrationSettings, model: StageModel, place: int, begin: float) -> FloatArray:
    """Return the desired displacements, (N,), metres, of the path that is to be covered, and the way to it."""
    name, limits = settings.axes[place], settings.limits[place]
    if name not in settings.path:
        return np.array([begin])
    wanted, axis = settings.path[name], model.axis(name)
    try:
        axis.require_reachable(wanted)
    except UnreachableError as error:
        raise UnreachableError(f"desired_path: axis '{name}', {error}") from None
    span = abs(float(wanted[0]) - begin) / float(np.ptp(axis.displacement_range))
    steps = round(max(RETURN_SECONDS, _quickest(limits, STEEPEST_INVERSE * span)) * settings.rate)
    way = (1.0 - np.cos(np.pi * np.arange(1, steps) / steps)) / 2.0
    # At rest at the end, as the return begins there.
    end = np.full(round(REST_SECONDS * settings.rate), wanted[-1])
    return np.concatenate([begin + (wanted[0] - begin) * way, wanted, end])


def _path(
    settings: CalibrationSettings, model: StageModel, place: int, begin: float, rng: np.random.Generator
) -> FloatArray:
    """Return desired displacements, shape (N,), metres, from `begin` (m) through random levels at random speeds."""
    axis, limits = model.axis(settings.axes[place]), settings.limits[place]
    low, high = axis.displacement_range
    bottom, top = (low + share * (high - low) for share in INNER)
    spec = DriveSpec(0.0, 1.0, VERIFICATION, settings.rate)
    path, spent = Path(float(np.clip((begin - bottom) / (top - bottom), -0.2, 1.2))), 0.0
    while True:
        to = float(rng.uniform(0.0, 1.0))
        span = abs(to - path.at)
        seconds = max(span, 0.05) / float(np.exp(rng.uniform(*np.log(SPEEDS))))
        seconds = max(seconds, _quickest(limits, STEEPEST_INVERSE * span))
        if spent + seconds > VERIFICATION and path.legs:
            break
        path.to(to, seconds)
        spent += seconds
    # At rest at the end, so that the return to the rest voltage begins without a jump of the rate.
    if spent < VERIFICATION:
        path.hold(VERIFICATION - spent)
    return bottom + (top - bottom) * _shares(path, spec)


def _shares(path: Path, spec: DriveSpec) -> FloatArray:
    """Return the path, shape (N,), without its first sample; unlike that of voltages it may start outside 0..1."""
    ends = np.cumsum([leg.seconds for leg in path.legs])
    t = np.arange(1, round(max(float(ends[-1]), spec.duration) * spec.rate) + 1) / spec.rate
    levels = np.array([path.start, *(leg.to for leg in path.legs)])
    leg = np.minimum(np.searchsorted(ends, t), ends.size - 1)
    phase = np.clip(1.0 - (ends[leg] - t) / np.diff(ends, prepend=0.0)[leg], 0.0, 1.0)
    return np.asarray(levels[leg] + (levels[leg + 1] - levels[leg]) * (1.0 - np.cos(np.pi * phase)) / 2.0)


def _returns(settings: CalibrationSettings, present: FloatArray) -> FloatArray:
    """Return the voltages (V) from the last ones to rest, shape (n, axes)."""
    moves = list(zip(settings.limits, present.tolist(), settings.rest, strict=True))
    seconds = max(
        RETURN_SECONDS, *(_quickest(limits, abs(rest - v) / (limits.upper - limits.lower)) for limits, v, rest in moves)
    )
    phase = np.arange(1, round(seconds * settings.rate) + 1) / round(seconds * settings.rate)
    way = (1.0 - np.cos(np.pi * phase)) / 2.0
    return np.column_stack([v + (rest - v) * way for _, v, rest in moves])


def _sweep_seconds(settings: CalibrationSettings) -> float:
    """Return the duration (s) of the sweep of all axes."""
    slowest = max(_quickest(limits, 1.0) for limits in settings.limits)
    return len(settings.axes) * max(SWEEP_SECONDS, 5.0 * slowest)


def _quickest(limits: Limits, span: float) -> float:
    """Return the shortest duration (s) of a raised cosine over a `span` of the voltage range (share)."""
    way = span * (limits.upper - limits.lower)
    by_slew = math.pi / 2 * way / min(SLEW_USED * limits.slew, limits.mean_rate)
    return max(by_slew, math.pi * math.sqrt(way / (2 * SLEW_USED * limits.acceleration)))


def _slew(limits: Limits) -> float:
    """Return the slew rate (V/s) for a drive, which is not faster than its mean may be; 0: no limit."""
    slew = min(SLEW_USED * limits.slew, limits.mean_rate)
    return slew if np.isfinite(slew) else 0.0


def _spec(limits: Limits, duration: float, rate: float) -> DriveSpec:
    return DriveSpec(limits.lower, limits.upper, duration, rate, _slew(limits))


def _with_resting(settings: CalibrationSettings, moving: Drive) -> Drive:
    voltage = {
        axis: moving.voltage.get(axis, np.full(moving.t.size, rest))
        for axis, rest in zip(settings.axes, settings.rest, strict=True)
    }
    return _drive(settings, voltage, moving.why)


def _drive(settings: CalibrationSettings, voltage: dict[str, FloatArray], why: str, *, limited: bool = True) -> Drive:
    """Return a drive, rate-limited unless it already is."""
    if limited:
        columns = [
            _limited(v, limits, settings.rate) for v, limits in zip(voltage.values(), settings.limits, strict=True)
        ]
        longest = max(column.size for column in columns)
        voltage = {
            axis: np.pad(column, (0, longest - column.size), mode="edge")
            for axis, column in zip(settings.axes, columns, strict=True)
        }
    size = voltage[settings.axes[0]].size
    specs = {
        axis: _spec(limits, (size - 1) / settings.rate, settings.rate)
        for axis, limits in zip(settings.axes, settings.limits, strict=True)
    }
    return Drive(np.arange(size) / settings.rate, voltage, specs, why)


def _limited(v: FloatArray, limits: Limits, rate: float) -> FloatArray:
    """Return the voltages (V) within slew and acceleration limits; longer if the end is reached late."""
    if not np.isfinite(limits.acceleration):
        return np.clip(v, limits.lower, limits.upper)
    goals = [*v.tolist(), *[float(v[-1])] * int(PATIENCE * v.size)]
    limiter, out = RateLimiter(limits, 1.0 / rate, goals[0]), [goals[0]]
    for index, goal in enumerate(goals[1:], 1):
        if index >= v.size and abs(goal - out[-1]) <= CLOSE * (limits.upper - limits.lower):
            break
        out.append(limiter.step(goal, round(index * SECOND_NS / rate)))
    return np.array(out)
