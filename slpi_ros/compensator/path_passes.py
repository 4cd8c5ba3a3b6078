"""Passes of paths that come again: recognised by their content, recorded while they are followed; without ROS."""

from array import array
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from slpi_ros.arrays import FloatArray, IntArray, Mask
from slpi_ros.compensator.axis import Axis
from slpi_ros.compensator.block import Block
from slpi_ros.io.messages import SECOND_NS
from slpi_ros.learning.repeated_paths import FinishedPass, SampledPath

# Paths whose identity is remembered.
KNOWN_PATHS = 64
# Time after the end of a pass until its last reading has come.
LAST_READING_NS = SECOND_NS // 10
# Readings further apart than this many of their intervals are a gap.
GAP = 3.0
# Longest time between two outputs (s), or this many output periods if that is more; what is read after a longer one
# counts from this time (s) on. A pass that has no reading at more than this share of its samples tells nothing.
LATE, LATE_PERIODS, RECOVERED, MOST_LATE = 0.01, 5.0, 0.01, 0.1
# Samples in a row that a limit held back in the midst of a pass, from which it is not learned from.
HELD_SAMPLES = 3
# Of more passes in a row than these, the first one is left out.
FIRST_LEFT_OUT = 2
# Blocks whose recordings are awaited, and by how much the stamp of a recording may be too early.
MOST_BLOCKS, EARLY_NS = 4, SECOND_NS // 20
# A device has played a block if its voltages are those of the block within this share of their range.
SAME_VOLTAGES = 0.02


class PassRecorder:
    """The readings and outputs of one pass that begins at `begin_ns`, ns on the clock of trajectories."""

    # Without `learns` only the setpoints are told; `held_back`: why it is not learned from, if that is known before.
    def __init__(
        self, path: SampledPath, begin_ns: int, correction: Mapping[str, FloatArray], period: float, learns: bool,
        held_back: str = "",
    ) -> None:  # fmt: skip
        self.path, self.begin_ns, self.period, self.learns, self.held_back = path, begin_ns, period, learns, held_back
        self._correction, self._t = path.over_whole(correction), path.t_whole
        self.end_ns = begin_ns + round(float(self._t[-1]) * SECOND_NS)
        # Time (s) and reading (m); time (s), voltage (V), 1 where a voltage limit or 2 where the slew limit holds back.
        self._kept: dict[str, list[array[Any]]] = {name: [array(kind) for kind in "ddddb"] for name in path.whole}

    def read(self, name: str, reading: float, at_ns: int) -> None:
        """Take a reading (m) at `at_ns`; those of other axes and times are left alone."""
        kept = self._kept.get(name)
        if kept is not None and self.begin_ns <= at_ns:
            kept[0].append((at_ns - self.begin_ns) * 1e-9)
            kept[1].append(reading)

    def output(self, axes: Iterable[Axis], at_ns: int) -> None:
        """Take what has been output at `at_ns`, and tell each axis how much of its setpoint was learned."""
        at = (at_ns - self.begin_ns) * 1e-9
        place = min(max(int(at / self.path.interval + 0.5), 0), self._t.size - 1)
        for axis in axes:
            kept = self._kept.get(axis.name)
            if kept is not None:
                kept[2].append(at)
                kept[3].append(axis.voltage)
                kept[4].append(1 if axis.held else 2 if axis.slewing else 0)
                axis.tracking.learned = float(self._correction[axis.name][place])

    def recorded(self, names: Sequence[str], at_ns: IntArray, readings: FloatArray, voltages: FloatArray) -> None:
        """Take what a device has recorded at `at_ns`, (N,): readings (m) and voltages (V), (N, names)."""
        at = (at_ns - self.begin_ns) * 1e-9
        begun, free = at >= 0.0, np.zeros(at.size, np.int8)
        for name, reading, voltage in zip(names, readings.T, voltages.T, strict=True):
            for kept, values in zip(self._kept.get(name, ()), (at, reading, at, voltage, free), strict=False):
                kept.extend(values[begun].tolist())

    def finished(self) -> list[FinishedPass]:
        """Return what each pass says, in order; of several, not the first one, which comes from elsewhere."""
        size, path = self.path.t.size, self.path
        first = 1 if path.count > FIRST_LEFT_OUT else 0
        return [self._finished(slice(k * size, (k + 1) * size)) for k in range(first, path.count)]

    def _finished(self, part: slice) -> FinishedPass:
        t, path = self._t[part], self.path
        measured, voltage, unusable, dropped = {}, {}, {}, ""
        for name in path.desired:
            at, readings, out_t, out_v, limited = (np.array(each) for each in self._kept[name])
            reading = _at(t, at, readings, path.interval)
            if not out_t.size:
                dropped = "it was not output"
                measured[name], voltage[name] = reading, np.full(t.size, np.nan)
                continue
            lost, latest = self._late(t, out_t)
            if float(np.mean(lost)) > MOST_LATE:
                dropped = f"the computer was busy: the path was output up to {latest * 1e3:.3g} ms late"
            # On the way to a path that begins elsewhere, the slew limit holds back; that is no part of the pass.
            begun = int(np.argmin(limited == 2)) if (limited != 2).any() else limited.size - 1
            lost |= t < out_t[begun] if begun else lost
            measured[name] = reading = np.where(lost, np.nan, reading)
            missing = float(np.mean(np.isnan(reading)))
            if missing > MOST_LATE and not dropped:
                dropped = f"axis '{name}': {100 * missing:.0f} % of its samples have no reading"
            voltage[name] = np.interp(t, out_t, out_v)
            within = (out_t >= max(t[0], out_t[begun])) & (out_t <= t[-1])
            held, slow = (int(np.count_nonzero(limited[within] == kind)) for kind in (1, 2))
            if self.held_back:
                unusable[name] = self.held_back
            elif held >= HELD_SAMPLES:
                unusable[name] = f"the voltage is held at a limit at {held} of its samples"
            elif slow >= HELD_SAMPLES:
                unusable[name] = f"slew_limit holds the voltage back at {slow} of its samples"
        followed = {name: y + self._correction[name][part] for name, y in path.desired.items()}
        return FinishedPass(path, followed, measured, voltage, unusable, dropped)

    def _late(self, t: FloatArray, output: FloatArray) -> tuple[Mask, float]:
        """Return which samples at `t` (s, (N,)) were output late or follow such ones, and by how much (s) at most."""
        lost, latest, longest = np.zeros(t.size, dtype=np.bool_), 0.0, max(LATE, LATE_PERIODS * self.period)
        edges = np.concatenate([[min(0.0, output[0])], output, [max(self._t[-1], output[-1])]])
        for k in np.flatnonzero(np.diff(edges) > longest):
            late = (t > edges[k]) & (t <= edges[k + 1] + RECOVERED)
            if late.any():
                lost, latest = lost | late, max(latest, float(edges[k + 1] - edges[k]))
        return lost, latest


class PathPasses:
    """Record the passes of paths; times in ns on the clock of trajectories."""

    def __init__(self) -> None:
        self.corrections: dict[str, Mapping[str, FloatArray]] = {}  # m, by identity of the path and axis
        self._recorders: list[PassRecorder] = []
        self._blocks: list[tuple[Block, PassRecorder]] = []  # whose recordings are awaited
        self._played: list[PassRecorder] = []

    @property
    def on(self) -> bool:
        """Whether a pass of a path is followed, or awaited."""
        return bool(self._recorders)

    def begin(self, path: SampledPath | None, start_ns: int, now_ns: int, period: float, learns: bool) -> None:
        """Begin a pass of a trajectory that was accepted at `now_ns` and starts at `start_ns`, 0: at once.

        Without `learns` it is followed with what is known, and tells nothing; without `path` it only ends others.
        """
        self.end(start_ns or now_ns)
        if path is None:
            return
        begin_ns = (start_ns or now_ns) + round(path.start * SECOND_NS)
        learns = learns and (now_ns - begin_ns) * 1e-9 <= MOST_LATE * float(path.t_whole[-1])
        correction = self.corrections.get(path.identity, {})
        self._recorders.append(PassRecorder(path, begin_ns, correction, period, learns))

    def begin_block(self, path: SampledPath, block: Block, learns: bool) -> None:
        """Begin a pass that a device plays by its own clock, and tells by what it has recorded."""
        correction = self.corrections.get(path.identity, {})
        begin_ns = int(block.times_ns[block.lead_in])
        recorder = PassRecorder(path, begin_ns, correction, block.period, learns, block.missed)
        self._blocks = [*self._blocks, (block, recorder)][-MOST_BLOCKS:]

    def recorded(
        self, stamp_ns: int, names: Sequence[str], times_ns: IntArray, readings: FloatArray, voltages: FloatArray
    ) -> None:
        """Take what a device has recorded of a block that began at `stamp_ns`: readings (m), voltages (V), (N, names).

        It is that of the last block before; those before it tell nothing any more.
        """
        begun = [number for number, (block, _) in enumerate(self._blocks) if block.stamp_ns <= stamp_ns + EARLY_NS]
        if not begun:
            return
        block, recorder = self._blocks[begun[-1]]
        del self._blocks[: begun[-1] + 1]
        if recorder.learns and _played(block, names, times_ns, voltages):
            recorder.recorded(names, times_ns, readings, voltages)
            self._played.append(recorder)

    def end(self, at_ns: int) -> None:
        """Nothing more is output from `at_ns` on: the passes that have not ended by then tell nothing."""
        self._recorders = [one for one in self._recorders if one.end_ns <= at_ns + SECOND_NS // 1000]

    def read(self, names: Sequence[str], readings: Sequence[float], at_ns: int) -> None:
        """Take readings (m) of sensors."""
        for recorder in self._recorders:
            for name, reading in zip(names, readings, strict=False):
                recorder.read(name, reading, at_ns)

    def output(self, axes: Iterable[Axis], at_ns: int) -> None:
        """Take what has been output."""
        for recorder in self._recorders:
            if recorder.begin_ns <= at_ns <= recorder.end_ns + SECOND_NS // 1000:
                recorder.output(axes, at_ns)

    def take(self, now_ns: int) -> list[PassRecorder]:
        """Return what was recorded of the passes that have ended and are to be learned, in order."""
        ended = [one for one in self._recorders if one.end_ns + LAST_READING_NS < now_ns]
        self._recorders = [one for one in self._recorders if one not in ended]
        played, self._played = self._played, []
        return [*played, *(one for one in ended if one.learns)]

    def forget(self) -> None:
        """Begin anew, from the desired paths."""
        self.corrections.clear()
        self._recorders.clear()
        self._blocks.clear()


class ComingAgain:
    """Tell the passes of paths that come again; a path that comes once is only remembered."""

    def __init__(self) -> None:
        self.dropped = ""  # why the last pass that tells nothing does not
        self._seen: dict[str, FinishedPass | None] = {}  # the first pass of a path that has come once

    def of(self, recorders: Iterable[PassRecorder], known: Collection[str]) -> list[FinishedPass]:
        """Return the passes to learn from; `known`: identities of paths that have been learned already."""
        ready: list[FinishedPass] = []
        for done in (done for recorder in recorders for done in recorder.finished()):
            identity = done.path.identity
            if done.dropped:
                self.dropped = done.dropped
            elif identity in known:
                ready.append(done)
            elif identity in self._seen:
                first, self._seen[identity] = self._seen[identity], None
                ready += [done] if first is None else [first, done]
            else:
                # Of paths that came once, the readings of the last one only are kept.
                self._seen = dict.fromkeys([*self._seen][-KNOWN_PATHS:]) | {identity: done}
        return ready


def _played(block: Block, names: Sequence[str], times_ns: IntArray, voltages: FloatArray) -> bool:
    """Return whether a device has played a block: to its end, and with its voltages (V, (N, names))."""
    if not times_ns.size or times_ns[-1] < block.times_ns[-1] - round(block.period * SECOND_NS):
        return False
    for column, name in enumerate(block.names):
        if name not in names:
            return False
        sent = block.voltages[:, column]
        played = np.interp(block.times_ns, times_ns, voltages[:, list(names).index(name)])
        if float(np.sqrt(np.mean((played - sent) ** 2))) > SAME_VOLTAGES * float(np.ptp(sent)):
            return False
    return True


def _at(t: FloatArray, at: FloatArray, readings: FloatArray, interval: float) -> FloatArray:
    """Return readings (m) at times (s, (N,)); NaN in gaps and beyond the first and the last one."""
    order = np.argsort(at, kind="stable")
    at, readings = at[order], readings[order]
    if at.size < 2:
        return np.full(t.size, np.nan)
    longest = GAP * max(interval, float(np.median(np.diff(at))))
    after = np.clip(np.searchsorted(at, t), 1, at.size - 1)
    gap = (at[after] - at[after - 1] > longest) | (t < at[0] - longest) | (t > at[-1] + longest)
    gap &= np.minimum(np.abs(t - at[after - 1]), np.abs(at[after] - t)) > 0.5 * interval
    return np.where(gap, np.nan, np.interp(t, at, readings))
