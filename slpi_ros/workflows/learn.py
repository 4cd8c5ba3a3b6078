"""The next pass of a path that repeats, from the bags of its passes: read, cut into passes, learn."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import numpy as np

from slpi_ros.arrays import FloatArray, IntArray
from slpi_ros.errors import RecordError, UsageError
from slpi_ros.identification.held_readings import without_held
from slpi_ros.io.desired import DesiredPath, at_times, read_desired
from slpi_ros.io.record import Record, common_stage
from slpi_ros.learning.axis_learner import MOST_REFUSED, PassReport
from slpi_ros.learning.learner import FEWEST, Learner
from slpi_ros.model.stage_model import StageModel
from slpi_ros.workflows.records import Source, mismatch_in_data, shared_axes

# Readings further apart than this many sampling intervals are a gap.
GAP = 3.0


@dataclass(frozen=True)
class LearnRequest:
    """Request of the next pass.

    `desired`: times (s) and displacements (m) of one pass by axis; default: that of `learned`, else what the first pass
    was asked for. `period` (s): the passes follow each other without a pause; default: each trajectory is a pass.
    `learned`: document of what was learned before, from the file `learned_file`.
    """

    source: Source
    model: StageModel
    desired: tuple[FloatArray, Mapping[str, FloatArray]] | None = None
    period: float | None = None
    learned: Mapping[str, Any] | None = None
    learn_limit: float | None = None
    learned_file: str = "what was learned"


@dataclass(frozen=True)
class LearnedPass:
    """One pass of all axes: where it was recorded, its error (measured - desired, m, (N,)) and what was made of it."""

    source: str
    start: float  # s, from the first stamp of its record
    errors: Mapping[str, FloatArray]
    reports: Mapping[str, PassReport]


@dataclass(frozen=True)
class LearnOutcome:
    """What was learned, from which passes, and remarks."""

    learner: Learner
    passes: Sequence[LearnedPass]
    remarks: Sequence[str]


@dataclass(frozen=True)
class _Begun:
    """A pass in a record: its start (ns), and what was asked for, by axis; None: not recorded."""

    start_ns: int
    asked: Sequence[DesiredPath] | None


def learn(request: LearnRequest) -> LearnOutcome:
    """Learn from the passes of all bags, in order of time; RecordError if there is no complete pass, or none of use."""
    source, model = request.source, request.model
    if request.period is not None and not 0.0 < request.period < math.inf:
        raise UsageError(f"period is {request.period} s; give a positive number of seconds")
    records = source.read(coupled=True, stage=request.model.hardware_id)
    bags = source.bags if not source.records else [""] * len(records)
    read = sorted(zip(bags, records, strict=True), key=lambda one: int(one[1].time_ns[0]))
    with mismatch_in_data():
        common_stage(records, model.hardware_id)
        axes = _axes(request, records)
        for axis in axes:
            model.axis(axis)
            for record in records:
                record.require_axis(axis)
    learner: Learner | None = None
    found: list[LearnedPass] = []
    remarks: list[str] = []
    for bag, record in read:
        others = 0
        read_paths = read_desired(bag, record.axes) if bag else []
        asked = [one.followed for one in read_paths if one.axis in axes]
        broken = {one.since_ns for one in asked if one.linear and not one.complete}
        if broken and request.period is None:
            remarks.append(f"{record.source}: {len(broken)} passes were cancelled or replaced, and are left out")
        for begun in _passes(request, record, asked, axes):
            if learner is None:
                learner, told = _learner(request, record, begun, axes)
                remarks += told
            taken = _taken(learner, record, begun)
            found += taken or []
            others += taken is None
        if others:
            remarks.append(f"{record.source}: {others} passes were asked for another path, and are left out")
    if learner is None or not found:
        what = "--period, and --desired" if request.period is None else "a shorter --period, or another bag"
        known = f"; {remarks[-1]}" if remarks else ""
        raise RecordError(f"{read[0][1].source}: holds no complete pass of the path; give {what}{known}")
    if len(found) >= MOST_REFUSED and not any(report.learned for one in found for report in one.reports.values()):
        reason = next(iter(found[-1].reports.values())).reason
        raise RecordError(
            f"{read[0][1].source}: none of {len(found)} passes is of use, the last as {reason}; give bags of this "
            "path, by --desired and --period if no desired displacements were recorded"
        )
    return LearnOutcome(learner, found, remarks)


def _axes(request: LearnRequest, records: Sequence[Record]) -> tuple[str, ...]:
    """Return the axes to learn; by default those of what was learned, else those that the model and all records hold.

    RecordError if what was learned is of others than these.
    """
    axes = tuple(shared_axes(records, request.model, request.source))
    if request.learned is None or request.desired is not None:
        # A path that is given anew is compared with the learned one when that is gone on with.
        return axes
    learned = tuple(request.learned["axes"])
    if missing := set(learned).difference(axes):
        where = "chosen" if request.source.axes else "in all of the bags and the model"
        raise RecordError(
            f"{request.learned_file}: learned of axes {', '.join(learned)}, but '{min(missing)}' is not {where}; "
            "choose these axes and give bags of them, or another file for what is learned"
        )
    if more := set(axes).difference(learned) if request.source.axes else ():
        raise RecordError(
            f"{request.learned_file}: learned of axes {', '.join(learned)}, not of '{min(more)}', which is chosen; "
            "choose these axes, or another file for what is learned"
        )
    return learned


def _passes(
    request: LearnRequest, record: Record, asked: Sequence[DesiredPath], axes: Sequence[str]
) -> Sequence[_Begun]:
    """Return the passes that begin in a record, in order."""
    source, first_ns, last_ns = request.source, int(record.time_ns[0]), int(record.time_ns[-1])
    trajectories = [one for one in asked if one.linear]
    if request.period is None and trajectories:
        ordered = sorted(trajectories, key=lambda one: int(one.time_ns[0]))
        groups = groupby(ordered, key=lambda one: int(one.time_ns[0]))
        each = [(ns, [one.whole for one in paths if one.complete]) for ns, paths in groups]
        return [_Begun(ns, paths) for ns, paths in each if {one.axis for one in paths} >= set(axes)]
    period = request.period or _duration(request)
    if period is None:
        raise UsageError(
            f"{record.source}: holds no trajectory, so that nothing tells where a pass begins; give --period, and "
            "--desired if no desired displacements were recorded"
        )
    # Its last reading stands for a whole interval, too: a bag of exactly one pass holds one.
    interval_ns = float(np.median(np.diff(record.time_ns))) if len(record) > 1 else 0.0
    if period < FEWEST * interval_ns * 1e-9:
        raise UsageError(
            f"{record.source}: a pass of {period:g} s has less than {FEWEST} readings, {interval_ns * 1e-9:g} s apart; "
            "give the --period of a whole pass"
        )
    begin_ns = max([first_ns, *(int(one.time_ns[0]) for one in asked)])
    if source.start is not None:
        begin_ns = first_ns + round(1e9 * max(source.start, 0.0))
    end_ns = last_ns if source.stop is None else first_ns + round(1e9 * source.stop)
    count = max(0, int((end_ns - begin_ns + interval_ns) * 1e-9 / period + 1e-6))
    return [_Begun(begin_ns + round(1e9 * k * period), asked or None) for k in range(count)]


def _duration(request: LearnRequest) -> float | None:
    """Return the duration (s) of the desired pass, if it is known."""
    if request.learned is not None:
        learned = next(iter(request.learned["axes"].values()))
        return float(request.learned["interval_s"] * len(learned["desired_m"]))
    if request.desired is None:
        return None
    t = request.desired[0]
    return float((t[-1] - t[0]) * t.size / (t.size - 1))


def _learner(request: LearnRequest, record: Record, begun: _Begun, axes: Sequence[str]) -> tuple[Learner, list[str]]:
    """Return the learner of the path, with what was learned before, and remarks."""
    desired: Mapping[str, FloatArray]
    if request.desired is not None:
        t, columns = request.desired
        desired = {axis: columns[axis] for axis in axes if axis in columns}
    elif request.learned is not None:
        learned = request.learned["axes"]
        desired = {axis: np.array(one["desired_m"]) for axis, one in learned.items()}
        t = np.arange(next(iter(desired.values())).size, dtype=np.float64) * float(request.learned["interval_s"])
    elif begun.asked is not None:
        interval = float(np.median(np.diff(record.time_ns))) * 1e-9
        duration = request.period or min(float(one.time_ns[-1] - one.time_ns[0]) for one in begun.asked) * 1e-9
        size = max(2, round(duration / interval))
        t = np.arange(size, dtype=np.float64) * (duration / size)
        desired = _asked_at(begun, t, axes)
    else:
        raise UsageError(f"{record.source}: holds no desired displacements; give the path by --desired")
    learner = Learner(request.model, t, desired, learn_limit=request.learn_limit)
    # A path may end with its first sample once more.
    lasts = float(learner.t[-1] - learner.t[0])
    if request.period is not None and request.period < (1.0 - 1e-6) * lasts:
        raise UsageError(f"--period {request.period:g} s is shorter than the path, which lasts {lasts:g} s")
    remarks = learner.resume(request.learned, request.learned_file) if request.learned is not None else []
    return learner, remarks


def _asked_at(begun: _Begun, t: FloatArray, axes: Sequence[str]) -> dict[str, FloatArray]:
    times = begun.start_ns + np.round(1e9 * (t - t[0])).astype(np.int64)
    sampled = at_times(begun.asked or (), times)
    return {axis: sampled[axis] for axis in axes if axis in sampled}


def _taken(learner: Learner, record: Record, begun: _Begun) -> list[LearnedPass] | None:
    """Let the learner have one pass, if the record holds it whole; return it, and None if it is of another path."""
    t = learner.t - learner.t[0]
    duration = float(t[-1] * t.size / (t.size - 1))
    begin = (begun.start_ns - int(record.time_ns[0])) * 1e-9
    if begin < -1e-6 or begin + float(t[-1]) > (int(record.time_ns[-1]) - int(record.time_ns[0])) * 1e-9 + 1e-6:
        return []
    fresh = {axis: without_held(record, axis)[0].displacement[axis] for axis in learner.axes}
    measured = {axis: _at(record, fresh[axis], begin + t, duration / t.size) for axis in learner.axes}
    voltage = {axis: _at(record, record.voltage[axis], begin + t, math.inf) for axis in learner.axes}
    followed = None
    if begun.asked is not None:
        followed = _asked_at(begun, t, tuple(learner.axes))
        if followed.keys() != learner.axes.keys() or not all(np.isfinite(y).all() for y in followed.values()):
            return []
        if not all(one.is_followed_by(followed[axis]) for axis, one in learner.axes.items()):
            return None
    reports = learner.update(measured, voltage, followed=followed)
    errors = {axis: measured[axis] - one.desired for axis, one in learner.axes.items()}
    return [LearnedPass(record.source, begin, errors, reports)]


def _at(record: Record, signal: FloatArray, at: FloatArray, interval: float) -> FloatArray:
    """Return a signal, (N,), at times from the first stamp (s, (M,)); NaN in gaps."""
    known = np.isfinite(signal)
    order: IntArray = np.argsort(record.time_ns[known], kind="stable").astype(np.int64)
    t = (record.time_ns[known][order] - int(record.time_ns[0])) * 1e-9
    if not t.size:
        return np.full(at.size, np.nan)
    after = np.clip(np.searchsorted(t, at), 1, max(1, t.size - 1))
    usual = max(interval, float(np.median(np.diff(t)))) if t.size > 1 else interval
    gap = (t[np.minimum(after, t.size - 1)] - t[after - 1]) > GAP * usual
    return np.where(gap, np.nan, np.interp(at, t, signal[known][order]))
