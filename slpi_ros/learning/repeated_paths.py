"""Paths that come again and again: what is learned of each of them, kept in files; for a worker process."""

import glob
import os
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from slpi_ros.arrays import FloatArray, IntArray
from slpi_ros.errors import SlpiError
from slpi_ros.io.messages import SECOND_NS
from slpi_ros.learning.axis_learner import HELD, AxisLearner
from slpi_ros.learning.learner import FEWEST, Learner, path_identity, read_learned
from slpi_ros.model.stage_model import StageModel

# Most samples of a pass that are learned; a longer one is learned at longer intervals.
MOST_SAMPLES = 10_000
# Paths that are learned at the same time, and files that are kept; those that came last.
MOST_PATHS = 16
# A path that repeats has at least so many periods, which differ by at most this share of what they cover.
LEAST_PERIODS, SAME_SHARE = 2, 0.01
# Digits of the identity of a path in the name of its file.
DIGITS = 12


@dataclass(frozen=True)
class SampledPath:
    """A desired path at even times, and what of it is learned: the whole of it, or a period that comes again in it.

    `identity` is the same whenever the same path, or the same period, is sent.
    """

    identity: str
    start: float  # s, of the first sample from the begin of the trajectory
    interval: float  # s
    whole: Mapping[str, FloatArray]  # m, (M,), by axis
    desired: Mapping[str, FloatArray]  # m, (N,), by axis that is learned: of one pass
    t_given: FloatArray  # s, (P,), of the points that were given, from the first one on
    given: Mapping[str, FloatArray]  # m, (P,), by axis: these points, which may be closer than the samples
    count: int = 1  # passes, one after the other

    @classmethod
    def of(
        cls,
        names: Sequence[str],
        time_from_start_ns: ArrayLike,
        positions: ArrayLike,
        output_period: float,
        learn_period: float = 0.0,
    ) -> "SampledPath | None":
        """Return the path of a valid trajectory, sampled at the output period (s); None if it is too short.

        Axes that repeat with `learn_period` (s) are learned period by period, if any do; otherwise, and with 0, all of
        them as a whole.
        """
        times, places = np.asarray(time_from_start_ns), np.asarray(positions, dtype=np.float64)
        start, own = float(times[0]) / SECOND_NS, (times - times[0]) / SECOND_NS
        duration = float(own[-1])
        given = {name: places[:, column] for column, name in enumerate(names)}
        samples = min(round(learn_period / output_period), MOST_SAMPLES)
        if samples >= FEWEST:
            interval = round(learn_period / samples, 12)
            count = int((duration + interval) / learn_period + 1e-6)
            whole = _sampled(given, own, interval, round(duration / interval))
            desired = {name: y[:samples] for name, y in whole.items() if _repeats(y, samples, count)}
            if desired:
                identity = path_identity(_times(samples, interval), desired)
                return cls(identity, start, interval, whole, desired, own, given, count)
        steps = min(round(duration / output_period), MOST_SAMPLES - 1)
        if steps < FEWEST - 1:
            return None
        interval = round(duration / steps, 12)
        whole = _sampled(given, own, interval, steps)
        return cls(path_identity(_times(steps + 1, interval), whole), start, interval, whole, whole, own, given)

    @property
    def t(self) -> FloatArray:
        """Times of the samples of one pass, (N,), seconds."""
        return _times(next(iter(self.desired.values())).size, self.interval)

    @property
    def t_whole(self) -> FloatArray:
        """Times of all samples, (M,), seconds."""
        return _times(next(iter(self.whole.values())).size, self.interval)

    def over_whole(self, correction: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
        """Return the correction of a pass (m, (N,), by axis) for all samples, (M,), and all axes."""
        return {
            name: np.resize(correction[name], y.size) if name in correction else np.zeros(y.size)
            for name, y in self.whole.items()
        }

    def corrected(
        self, correction: Mapping[str, FloatArray], output_period: float
    ) -> tuple[Sequence[str], IntArray, FloatArray]:
        """Return names, times (ns, (M,)) and positions (m, (M, K)) of the path with a correction (m, (N,), by axis)."""
        t, added = self.t_whole, self.over_whole(correction)
        count = max(t.size - 1, round(float(t[-1]) / output_period))
        at = np.linspace(0.0, float(t[-1]), count + 1)
        # Only the correction is at the samples: they may be further apart than the points of the path.
        columns = [np.interp(at, self.t_given, y) + np.interp(at, t, added[name]) for name, y in self.given.items()]
        times = np.round((self.start + at) * SECOND_NS).astype(np.int64)
        return list(self.given), times, np.column_stack(columns)


def _times(size: int, interval: float) -> FloatArray:
    return np.asarray(np.arange(size, dtype=np.float64) * interval)


def _sampled(given: Mapping[str, FloatArray], own: FloatArray, interval: float, steps: int) -> dict[str, FloatArray]:
    t = _times(steps + 1, interval)
    return {name: np.interp(t, own, y) for name, y in given.items()}


def _repeats(y: FloatArray, samples: int, count: int) -> bool:
    """Return whether a path (m, (M,)) moves, and repeats after so many samples, at least twice."""
    if count < LEAST_PERIODS or y.size < samples * count:
        return False
    periods = y[: samples * count].reshape(count, samples)
    span = float(np.ptp(periods[0]))
    return span > 0.0 and float(np.abs(periods - periods[0]).max()) <= SAME_SHARE * span


@dataclass(frozen=True)
class FinishedPass:
    """A pass that was followed to its end: what was desired, asked for and measured, m, (N,), by axis."""

    path: SampledPath
    followed: Mapping[str, FloatArray]
    measured: Mapping[str, FloatArray]  # NaN: no reading
    voltage: Mapping[str, FloatArray]  # V
    unusable: Mapping[str, str] = field(default_factory=dict)  # why it is not learned from, by axis
    dropped: str = ""  # why it tells nothing


@dataclass(frozen=True)
class AxisProgress:
    """What has become of one axis: passes, the error (m, rms without mean and drift) of the last, first and best one.

    `reason`: what was made of the last pass, "" if it was learned from; `limited_by`: what keeps the error where it is.
    """

    passes: int
    error: float
    first: float
    best: float
    limited_by: str
    reason: str

    @property
    def held(self) -> bool:
        """Whether nothing more is learned until what was learned is forgotten."""
        return self.limited_by.startswith(HELD)


@dataclass(frozen=True)
class Learned:
    """What is known of a path: the correction (m, (N,), by axis) of its next pass, and how it has come to it."""

    identity: str
    correction: Mapping[str, FloatArray]
    axes: Mapping[str, AxisProgress]
    remarks: tuple[str, ...] = ()


class RepeatedPaths:
    """Learns every path that it is given passes of; what was learned is kept in files that begin with `prefix`.

    Parameters
    ----------
    model : StageModel
        The model with which the paths are compensated.
    prefix : str
        Begin of the files' names, with their folder; "": nothing is kept.
    limit : mapping of axis name to float, or None, metres
        Most that learning may add to a desired path; None: a quarter of each axis's stroke.
    """

    def __init__(self, model: StageModel, prefix: str = "", limit: Mapping[str, float] | None = None) -> None:
        self.model, self.prefix, self.limit = model, prefix, limit
        self._learners: dict[str, Learner] = {}

    @property
    def known(self) -> Collection[str]:
        """Identities of the paths that are learned."""
        return self._learners.keys()

    def load(self) -> list[Learned]:
        """Go on from the kept files of this stage; those of others are left alone, which is said in a remark."""
        found: list[Learned] = []
        for file in reversed(kept_files(self.prefix)[:MOST_PATHS]):
            try:
                document = read_learned(file)
            except SlpiError as error:
                found.append(_afresh(error))
                continue
            if document["path"] not in self._learners:
                found.append(self._resume(document, str(file)))
        return found

    def take_over(self, before: "RepeatedPaths") -> list[Learned]:
        """Go on with what was learned with another model or limit."""
        return [self._resume(one.to_document(), "what was learned") for one in before._learners.values()]

    def _resume(self, document: Mapping[str, Any], source: str) -> Learned:
        desired = {name: np.array(one["desired_m"]) for name, one in document["axes"].items()}
        t = np.arange(next(iter(desired.values())).size, dtype=np.float64) * float(document["interval_s"])
        try:
            learner = Learner(self.model, t, desired, learn_limit=self.limit)
            remarks = learner.resume(document, source)
        except SlpiError as error:
            return _afresh(error)
        self._learners[document["path"]] = learner
        return _learned(document["path"], learner, tuple(remarks))

    def learn(self, *passes: FinishedPass) -> list[Learned]:
        """Learn from passes, and keep what was learned; return what is known of each of their paths."""
        remarks: dict[str, list[str]] = {}
        periodic = {done.path.identity: done.path.count > 1 for done in passes}
        for done in passes:
            path = done.path
            told = remarks.setdefault(path.identity, [])
            learner = self._learners.pop(path.identity, None)
            voltage = {name: v for name, v in done.voltage.items() if np.isfinite(v).all()}
            try:
                if learner is None:
                    learner = Learner(self.model, path.t, path.desired, learn_limit=self.limit)
                learner.update(done.measured, voltage, followed=done.followed, unusable=done.unusable)
            except SlpiError as error:
                told.append(f"not learned: {error}")
            except (ArithmeticError, LookupError, TypeError, ValueError) as error:
                # Of a file whose numbers do not belong together; the other paths are to be learned on.
                told.append(f"learned afresh: what was learned cannot be gone on with: {error!r}")
                continue
            if learner is not None:
                self._learners[path.identity] = learner
        for old in [*self._learners][:-MOST_PATHS]:
            del self._learners[old]
        return [
            _learned(identity, self._learners[identity], (*told, *self._keep(identity)), periodic[identity])
            if identity in self._learners
            else Learned("", {}, {}, tuple(told))
            for identity, told in remarks.items()
        ]

    def _keep(self, identity: str) -> list[str]:
        """Write the file of a path; return why that is not possible."""
        if self.prefix:
            try:
                self._learners[identity].save(f"{self.prefix}.{identity[:DIGITS]}.json")
                for file in kept_files(self.prefix)[MOST_PATHS:]:
                    file.unlink(missing_ok=True)
            except (SlpiError, OSError) as error:
                return [f"what was learned cannot be kept: {error}"]
        return []

    def forget(self) -> tuple[int, str]:
        """Begin anew from the desired paths, and remove the files.

        Return how many paths were learned, and which file cannot be removed and why, "" if all are.
        """
        count, left = len(self._learners), ""
        self._learners.clear()
        try:
            files = kept_files(self.prefix)
        except OSError as error:
            return count, f"{self.prefix}: what was learned cannot be looked for: {error.strerror or error}"
        for file in files:
            try:
                file.unlink(missing_ok=True)
            except OSError as error:
                left = left or f"{file}: cannot be removed: {error.strerror or error}; remove it, or it comes back"
        return max(count, len(files)), left


def kept_files(prefix: str) -> list[Path]:
    """Return the files of what was learned whose names begin with `prefix`, the newest first."""
    if not prefix:
        return []
    folder, name = os.path.split(prefix)
    found = Path(folder or ".").glob(f"{glob.escape(name)}.{'?' * DIGITS}.json")
    return sorted(found, key=lambda each: each.stat().st_mtime, reverse=True)


def _afresh(error: SlpiError) -> Learned:
    return Learned("", {}, {}, (f"learned afresh: {error}",))


def _learned(identity: str, learner: Learner, remarks: tuple[str, ...], periodic: bool = False) -> Learned:
    # A change comes in over one pass; in a path of many periods it would in each of them.
    paths = {name: axis.aim if periodic else axis.path for name, axis in learner.axes.items()}
    correction = {name: paths[name] - axis.desired for name, axis in learner.axes.items()}
    progress = {name: _progress(axis) for name, axis in learner.axes.items() if axis.passes}
    return Learned(identity, correction, progress, remarks)


def _progress(axis: AxisLearner) -> AxisProgress:
    last, errors = axis.passes[-1], [one.error for one in axis.passes if one.learned]
    first, best = (errors[0], min(errors)) if errors else (last.error, last.error)
    return AxisProgress(last.number, last.error, first, best, last.limited_by, last.reason)
