"""What the compensator learns of paths that come again: in a process of its own, so that no command waits for it."""

import os
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from slpi_ros.arrays import FloatArray
from slpi_ros.compensator.block import Block, sampling_period
from slpi_ros.compensator.controller import Controller, OperatingMode
from slpi_ros.compensator.path_passes import ComingAgain, PassRecorder, PathPasses
from slpi_ros.compensator.trajectory import Trajectory
from slpi_ros.compensator.validation import RejectedError
from slpi_ros.io.stage_name import same_stage
from slpi_ros.learning.axis_learner import usual_limit
from slpi_ros.learning.repeated_paths import AxisProgress, Learned, RepeatedPaths, SampledPath
from slpi_ros.model.document import format_model, parse_model
from slpi_ros.model.stage_model import StageModel
from slpi_ros.nodes.jobs import Worker

OFF, ON = "off", "on"
# How much less urgent the process is than the node.
NICENESS = 10
# Requests that wait for the process; passes that come with more are not learned from.
MOST_WAITING = 4


@dataclass(frozen=True)
class Answer:
    """What is known of paths; why the last pass that tells nothing does not; how many paths were forgotten, if so.

    `not_forgotten`: why what was forgotten will come back, with the file; "" if it will not.
    """

    learned: Sequence[Learned] = ()
    dropped: str = ""
    forgotten: int | None = None
    not_forgotten: str = ""


class Paths:
    """What the process knows; each method answers a request."""

    def __init__(self) -> None:
        self._paths, self._again = RepeatedPaths(StageModel({})), ComingAgain()

    def open(self, document: str, prefix: str, limit: Mapping[str, float] | None) -> Answer:
        """Go on from the files that begin with `prefix`, with a model document and limits (m; None: usual)."""
        before, self._paths = self._paths, RepeatedPaths(parse_model(document, "the model"), prefix, limit)
        return Answer([*self._paths.take_over(before), *self._paths.load()])

    def learn(self, passes: Sequence[PassRecorder]) -> Answer:
        """Learn from passes."""
        learned = self._paths.learn(*self._again.of(passes, self._paths.known))
        return Answer(learned, self._again.dropped)

    def forget(self, prefix: str) -> Answer:
        """Forget everything, and remove the files that begin with `prefix`."""
        self._paths.prefix, self._again = prefix, ComingAgain()
        forgotten, left = self._paths.forget()
        return Answer(forgotten=forgotten, not_forgotten=left)


def serve(connection: Connection) -> None:
    """Answer requests, each a method of `Paths` and what it is given, until the other end is closed."""
    os.nice(NICENESS)
    paths = Paths()
    with suppress(EOFError, OSError):
        while True:
            method, *given = connection.recv()
            connection.send(method(paths, *given))


class PathLearning:
    """Correct the trajectories of the controller by what was learned of them, and learn from their passes.

    `prefix` begins the names of the files that are kept; "": none. `on_forgotten` is called in the thread of `poll`
    with the number of paths, also where a file could not be removed; `not_forgotten` then tells which one and why.
    """

    def __init__(self, controller: Controller, prefix: str, on_forgotten: Callable[[int], None]) -> None:
        self.passes = PathPasses()
        self.mode, self.period = OFF, 0.0
        self.limit: Mapping[str, float] | None = None
        self.progress: dict[str, AxisProgress] = {}  # of the path that came last, by axis
        self.dropped = ""  # why the last pass that tells nothing does not
        self.remarks: deque[str] = deque()  # to be logged
        self.not_forgotten = ""  # why what was forgotten last will come back, with the file
        self._controller, self._prefix, self._on_forgotten = controller, prefix, on_forgotten
        self._model: StageModel | None = None
        self._opened = False
        self._thread = ThreadPoolExecutor(1, "learning")
        self._worker: Worker | None = None
        self._asked: deque[tuple[int, Future[Answer]]] = deque()  # in an era
        self._era = 0  # answers to requests of an earlier one are void

    @property
    def waiting(self) -> int:
        """Number of requests whose answer has not been taken yet."""
        return len(self._asked)

    def use(self, mode: str, limit: Mapping[str, float] | None, period: float) -> None:
        """Learn (`on`), follow what was learned (`hold`) or neither (`off`).

        At most `limit` (m, by axis) is added; `period` (s): of paths that repeat within a trajectory, 0: none.
        """
        changed = limit != self.limit
        self.mode, self.limit, self.period = mode, limit, period
        if mode == OFF:
            self.passes.forget()
            self.progress = {}
            self._opened, self._era = False, self._era + 1
            if self._worker:
                self._thread.submit(self._stop)
        elif changed or not self._opened:
            self._open()

    def use_model(self, model: StageModel | None) -> None:
        """Take another model: what was learned with the last one is learned afresh."""
        if self._model is not None and model is not None and not same_stage(model.hardware_id, self._model.hardware_id):
            # Those of another stage.
            self.passes.corrections.clear()
        self._model = model
        if self.mode != OFF:
            self._open()

    def _open(self) -> None:
        """Let the process go on from the kept files, with the present model."""
        if self._model is None:
            return
        self._era, self._opened = self._era + 1, True
        model, prefix, limit = self._model, self._prefix, self.limit
        self._ask(lambda: (Paths.open, format_model(model), prefix, limit))

    def corrected(
        self, names: Sequence[str], times: ArrayLike, positions: ArrayLike, *, as_block: bool = False
    ) -> tuple[SampledPath | None, tuple[Sequence[str], ArrayLike, ArrayLike]]:
        """Return the path of a trajectory, None if none is learned, and the trajectory with what was learned of it.

        `as_block`: its samples are as far apart as those of a block.
        """
        plain = names, times, positions
        if self.mode == OFF or not len(times):  # type: ignore[arg-type]
            return None, plain
        self.poll(0)
        period = self._controller.trajectory.period
        try:
            valid = Trajectory.of(names, times, positions, axes=self._controller.names)
        except RejectedError:
            return None, plain
        if as_block:
            period = sampling_period(valid.time_from_start_ns, period)
        path = SampledPath.of(valid.names, valid.time_from_start_ns, valid.positions, period, self.period)
        correction = self._within_limit(path.identity) if path else None
        return path, (path.corrected(correction, period) if path and correction else plain)

    def _within_limit(self, identity: str) -> Mapping[str, FloatArray] | None:
        """Return what was learned of a path, at most the present limit; its next pass follows the same."""
        # The process may be busy for seconds with a request that came before a lower limit, or another model.
        known = self.passes.corrections.get(identity)
        if known is None:
            return None
        within = {name: np.clip(y, -self._most(name), self._most(name)) for name, y in known.items()}
        self.passes.corrections[identity] = within
        return within

    def _most(self, name: str) -> float:
        """Return the most (m) that may be added to the desired displacement of an axis now."""
        most = self.limit.get(name) if self.limit else None
        if most is None:
            axis = self._model.axes.get(name) if self._model else None
            most = usual_limit(axis) if axis else 0.0
        return most

    def begin(self, path: SampledPath | None, start_ns: int, clock_ns: int) -> None:
        """Take notice of a trajectory that was accepted; None: it is not learned."""
        self.passes.begin(path, start_ns, clock_ns, self._controller.trajectory.period, self.mode == ON)

    def begin_block(self, path: SampledPath | None, block: Block) -> None:
        """Take notice of a block that a device will play and record; no path: it is not learned."""
        if path is not None:
            self.passes.begin_block(path, block, self.mode == ON)

    def poll(self, clock_ns: int) -> None:
        """Take what has been learned, and have passes learned that have ended."""
        while self._asked and self._asked[0][1].done():
            era, coming = self._asked.popleft()
            answer = coming.result()
            self.dropped = answer.dropped or self.dropped
            if answer.forgotten is not None:
                self.dropped, self.not_forgotten = "", answer.not_forgotten
                if answer.not_forgotten:
                    self.remarks.append(answer.not_forgotten)
                self._on_forgotten(answer.forgotten)
                if self.mode == OFF:
                    self._thread.submit(self._stop)
                continue
            for one in answer.learned:
                self.remarks.extend(one.remarks)
                if era == self._era and one.identity:
                    self.passes.corrections[one.identity] = one.correction
                    self.progress = dict(one.axes)
        if self.mode != OFF and not self._opened:
            self._open()
        if clock_ns:
            if self.passes.on and self._controller.mode is not OperatingMode.TRAJECTORY:
                self.passes.end(clock_ns)
            done = self.passes.take(clock_ns)
            if done and self.waiting < MOST_WAITING:
                self._ask(lambda: (Paths.learn, done))

    def forget(self) -> None:
        """Begin anew from the desired paths; `on_forgotten` is called when the files are removed, or cannot be."""
        self.passes.forget()
        self.progress = {}
        self._era += 1
        self._ask(lambda: (Paths.forget, self._prefix))

    def close(self) -> None:
        """End the process."""
        self._thread.shutdown(wait=False, cancel_futures=True)
        self._stop()

    def _stop(self) -> None:
        # None: a request that follows at once must not be sent to a process that has not ended yet.
        worker, self._worker = self._worker, None
        if worker:
            worker.process.kill()

    def _ask(self, request: Callable[[], tuple[Any, ...]]) -> None:
        self._asked.append((self._era, self._thread.submit(self._answer, request)))

    def _answer(self, request: Callable[[], tuple[Any, ...]]) -> Answer:
        """Send a request to the process, which is started if there is none; wait for its answer."""
        wanted = request()
        try:
            if self._worker is None or not self._worker.process.is_alive():
                if wanted[0] is Paths.learn:
                    # A new process has to be given the model first.
                    raise EOFError
                self._worker = Worker(serve)
            self._worker.connection.send(wanted)
            answer: Answer = self._worker.connection.recv()
        except (EOFError, OSError):
            self._worker, self._opened = None, False
            ended = "the process that learns has ended: learning goes on from the files"
            if wanted[0] is Paths.forget:
                return Answer(forgotten=0, not_forgotten=f"{ended}; call ~/forget again")
            return Answer([Learned("", {}, {}, (ended,))])
        return answer
