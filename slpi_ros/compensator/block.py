"""A path as one block of voltages for a device that plays it by its own clock, and what of it was really played."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from math import inf

import numpy as np

from slpi_ros.arrays import FloatArray, IntArray
from slpi_ros.compensator import validation as rejection
from slpi_ros.compensator.axis import Axis
from slpi_ros.compensator.monitor import Finding, Rule, Silence
from slpi_ros.compensator.trajectory import Trajectory
from slpi_ros.compensator.validation import RejectedError
from slpi_ros.io.messages import SECOND_NS
from slpi_ros.model.limits import Limits, RateLimiter
from slpi_ros.model.mean_rate import WINDOW, highest_mean_rate, later_by, slower_by
from slpi_ros.model.streaming import StageStream

# Most samples of a block: their voltages take some seconds to compute.
LONGEST = 300_000
# Relative rounding error of the steps of a block.
ROUNDING = 1e-9
# A driver answers within this time; while it plays, it tells the sample that often.
PATIENCE_NS = 2 * SECOND_NS
# What the driver may tell of a block.
ACCEPTED, REFUSED, PLAYING, ENDED, STOPPED = "accepted", "refused", "playing", "ended", "stopped"


@dataclass(frozen=True)
class Block:
    """Voltages of some axes, evenly spaced, from the present ones on."""

    stamp_ns: int  # when it was made
    names: tuple[str, ...]
    period: float  # s
    voltages: FloatArray  # V, (N, names)
    lead_in: int  # samples until the path begins
    missed: str = ""  # the first sample that the limits hold back, "" if none

    @property
    def times_ns(self) -> IntArray:
        """Times since the start, shape (N,)."""
        times: IntArray = np.round(np.arange(len(self.voltages)) * (self.period * SECOND_NS)).astype(np.int64)
        return times


def sampling_period(times_ns: IntArray, period: float) -> float:
    """Return how far apart (s) the samples of a block are: the output period (s), or the closest points (ns, (N,))."""
    return min(period, int(np.diff(times_ns).min()) * 1e-9) if times_ns.size > 1 else period


def plan(
    path: Trajectory, axes: Sequence[Axis], stage: StageStream | None, period: float, stamp_ns: int, now_ns: int
) -> Block:
    """Return the block of voltages for a path from now on; RejectedError if it is too long, or its mean rate too high.

    The axes, in a block, stay as they are.
    The samples are as far apart as the points where these are closer than `period` (s). First the limits let each axis
    go to the beginning of the path; the time of the path starts there.
    """
    times = path.time_from_start_ns
    period = sampling_period(times, period)
    moved = [axis for axis in axes if axis.name in path.names]
    grid = np.arange(int(round((times[-1] - times[0]) * 1e-9 / period)) + 1) * period * SECOND_NS + times[0]
    if grid.size > LONGEST:
        raise RejectedError(
            rejection.LENGTH, f"{grid.size} samples of {period:g} s are more than {LONGEST}; send shorter paths"
        )
    columns = [path.names.index(axis.name) for axis in moved]
    # What is late by itself begins earlier.
    delays = [axis.model.chain.delay * SECOND_NS if axis.model else 0.0 for axis in moved]
    pairs = zip(columns, delays, strict=True)
    desired = np.stack([np.interp(grid + delay, times, path.positions[:, column]) for column, delay in pairs], 1)
    listed, step_ns, missed = desired.tolist(), round(period * SECOND_NS), ""
    names = tuple(axis.name for axis in moved)
    rows: list[list[float]] = [[axis.voltage for axis in moved]]

    def step(row: list[float]) -> bool:
        """Add the voltages for displacements (m); return whether the slew limit holds them back."""
        if stage:
            stage.decouple(dict(zip(names, row, strict=True)))
        at_ns = len(rows) * step_ns
        rows.append([axis.stream.move(period, y, at_ns) for axis, y in zip(moved, row, strict=True)])
        return any(axis.stream.missed and not axis.stream.held for axis in moved)

    with _tried(moved, period):
        while step(listed[0]):
            if len(rows) > LONGEST:
                raise RejectedError(
                    rejection.OUT_OF_RANGE, "the beginning of the path is not reached; raise slew_limit"
                )
        lead_in, behind = len(rows) - 1, False
        for number, row in enumerate(listed[1:], 1):
            behind = step(row)
            late = next((axis.name for axis in moved if axis.stream.missed), None) if not missed else None
            if late:
                held = any(axis.stream.held for axis in moved)
                what = "out of reach, held at a voltage limit" if held else "too fast for slew_limit"
                missed = f"axis '{late}', {(number * period):.6g} s after the beginning of the path: {what}"
        # What the limits held back at the end.
        while behind and len(rows) <= 2 * LONGEST:
            behind = step(listed[-1])
    voltages = np.array(rows)
    for axis, v in zip(moved, voltages.T, strict=True):
        _require_mean_rate(axis, np.arange(v.size) * period, v, now_ns)
    return Block(stamp_ns, names, period, voltages, lead_in, missed)


def require_mean_rates(path: Trajectory, axes: Sequence[Axis], now_ns: int, clock_ns: int) -> None:
    """Reject a path whose voltages have too high a mean rate, as the models of its axes tell.

    `clock_ns` is now on the clock of its start.
    """
    t: FloatArray = path.time_from_start_ns.astype(np.float64) * 1e-9
    if path.start_ns:
        t += (path.start_ns - clock_ns) * 1e-9
    for axis in axes:
        if axis.name in path.names and axis.model and axis.output.limits.mean_rate < inf:
            within = Limits(axis.stream.limits.lower, axis.stream.limits.upper)
            v, _ = axis.model.compensate(t, path.positions[:, path.names.index(axis.name)], within)
            _require_mean_rate(axis, t, v, now_ns)


def _require_mean_rate(axis: Axis, t: FloatArray, v: FloatArray, now_ns: int) -> None:
    """Reject voltages (V, (N,)) at times (s, (N,), now is 0) of too high a mean rate, alone or after the last ones."""
    limit = axis.output.limits.mean_rate
    if limit == inf:
        return
    if (slower := slower_by(t, v, limit)) > 1.0:
        raise RejectedError(
            rejection.OUT_OF_RANGE,
            f"axis '{axis.name}': a mean rate of {highest_mean_rate(t, v):.4g} V/s over {WINDOW:g} s, mean_rate_limit "
            f"is {limit:g} V/s; send it {slower:.3g} times more slowly",
        )
    travelled, coming = axis.output.travelled, t >= 0.0
    if (later := later_by(travelled, now_ns, t[coming], v[coming], limit)) > 0.0:
        raise RejectedError(
            rejection.OUT_OF_RANGE,
            f"axis '{axis.name}': with the {travelled.within(now_ns):.4g} V of the last {WINDOW:g} s its mean rate "
            f"exceeds mean_rate_limit, {limit:g} V/s; send it {later:.3g} s later",
        )


@contextmanager
def _tried(axes: Sequence[Axis], period: float) -> Iterator[None]:
    """Let streams move within the limits, at a `period` (s), in the ``with`` block; after it they are as before."""
    saved = [(axis.stream, axis.stream.snapshot(), axis.stream.pace, axis.stream.coupled) for axis in axes]
    try:
        for axis in axes:
            # The mean rate is judged of the whole block.
            axis.stream.pace = RateLimiter(replace(axis.output.limits, mean_rate=inf), period, axis.voltage)
            axis.stream.pace.begin(0)
        yield
    finally:
        for stream, state, pace, coupled in saved:
            stream.restore(state)
            stream.pace, stream.coupled = pace, coupled


class BlockFollower(Rule):
    """Lets the memory of each axis follow a block up to the sample that the driver has told, which it has to go on."""

    def __init__(self, block: Block, axes: Mapping[str, Axis], now_ns: int) -> None:
        self.block = block
        self.state, self.sample, self.reason = "", 0, ""
        self._axes = [axes[name] for name in block.names]
        self._rows = block.voltages.tolist()
        self._silence = Silence(now_ns, self._unheard)

    def hear(self, state: str, sample: int, reason: str, now_ns: int) -> None:
        """Take what the driver tells of this block."""
        self.state, self.reason = state, reason
        self._silence.hear(now_ns)
        last = min(max(sample, self.sample), len(self._rows)) if state in (PLAYING, ENDED, STOPPED) else self.sample
        part = self._rows[self.sample : last]
        for column, axis in enumerate(self._axes):
            axis.play([row[column] for row in part], self.block.period, now_ns)
        self.sample = last

    @property
    def done(self) -> bool:
        """Whether the driver has told its end."""
        return self.state in (REFUSED, ENDED, STOPPED)

    @property
    def beyond_limits(self) -> bool:
        """Whether voltages that are still to be played, or their rates, are beyond the present limits of an axis."""
        rest = np.array(self._rows[max(self.sample - 1, 0) :])
        for v, axis in zip(rest.T, self._axes, strict=True):
            limits = axis.limits
            steps, most = np.abs(np.diff(v)), limits.slew * self.block.period
            if v.min() < limits.lower or v.max() > limits.upper or (steps > most * (1.0 + ROUNDING)).any():
                return True
        return False

    def check(self, now_ns: int) -> Finding | None:
        """Return why nothing more is known of the block, None while the driver tells it."""
        reason = self._silence.beyond(PATIENCE_NS / SECOND_NS, now_ns)
        return Finding("block", "silent", reason) if reason else None

    def _unheard(self, _: float) -> str:
        if not self.state:
            return (
                "no driver answers on voltage_trajectory_state; start one that plays blocks, or set trajectory_output "
                "to stream"
            )
        return f"the driver no longer tells how far the block is (last sample {self.sample} of {len(self._rows)})"

    def band(self, now_ns: int) -> None:
        """Let the reports of the amplifiers be held against the samples that may be played by now."""
        ahead = self.sample
        if self.state == PLAYING:
            ahead += int(self._silence.seconds(now_ns) / self.block.period)
        row = self._rows[min(ahead, len(self._rows) - 1)]
        for column, axis in enumerate(self._axes):
            axis.amplifier.output(row[column], now_ns)
