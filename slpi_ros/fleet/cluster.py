"""Processing of the bags of a fleet as tasks of a Dask cluster."""

import os
import socket
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field, replace
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np

from slpi_ros.errors import SlpiError, UsageError, dependencies_needed
from slpi_ros.fleet import bags
from slpi_ros.fleet.bags import Examined, Judged
from slpi_ros.fleet.results import Results, State, as_table
from slpi_ros.fleet.sources import Bag, find_bags, is_complete, load_models
from slpi_ros.identification.progress import report_progress
from slpi_ros.io.bag_files import PATIENCE
from slpi_ros.model.document import format_model, save_model
from slpi_ros.model.stage_model import StageModel
from slpi_ros.workflows.records import Source

if TYPE_CHECKING:
    import pandas as pd
    from distributed import Client

_Path = str | os.PathLike[str]

# Groups of tasks at the scheduler for each thread of the cluster: enough to keep every thread busy, and bounded memory.
GROUPS_PER_THREAD = 4
# Most seconds of work, bytes of bags and tasks in one group, unless it is a single task: client and scheduler need
# milliseconds for each group, whatever is in it.
GROUP_SECONDS, GROUP_BYTES, MOST_TASKS = 5.0, 64_000_000, 64
# A bag is given up after this many times that Dask has given it up, each after several workers have ended.
ATTEMPTS = 3
# Seconds: until a lost scheduler is back, until the first worker is there, between two looks at the sources, and
# between two tables.
RECONNECT, FIRST_WORKER, WATCH, WRITE = 60.0, 120.0, 2.0, 30.0
# Shortest pause between two tables, as a multiple of the time that one takes.
WRITE_PAUSE = 20.0


@dataclass(frozen=True)
class Task:
    """A function with its arguments, and what is done with its result."""

    bag: Examined  # that it processes
    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    finish: Callable[[Any], Iterable["Task"]]
    attempts: int = 0
    alone: bool = False  # shares a group with no other


def run(
    sources: Sequence[_Path],  # bags, folders of bags and CSV lists, see `slpi_ros.fleet.sources.find_bags`
    output: _Path | None = None,  # folder of the results, at the same path on all machines; default: a temporary one
    *,
    client: "Client | None" = None,  # cluster, which stays open; default: that at `scheduler`, else a local one
    scheduler: str | None = None,  # address of a running scheduler, such as ``tcp://host:8786``
    workers: int | None = None,  # processes of the local cluster; default: one per core
    models: _Path | None = None,  # folder of model documents that are the references of their stages
    since: str | None = None,  # only bags that begin at or after this date, ISO 8601, UTC
    diagnose: bool = True,  # the causes of errors that no change of gain, width or zero explains
    watch: bool = False,  # continue with bags that are completed later, until interrupted
    topic: str = "stage_state",
    surroundings: Sequence[str] | None = None,  # recorded quantities, TOPIC[:FIELD]; default: for a diagnosis all
    told: Callable[[str], None] | None = None,  # receives sentences about the cluster
    finished: Callable[[Results], None] | None = None,  # called whenever the table has been written
) -> "pd.DataFrame":
    """Process the bags of many stages; return a row for each axis of each bag, see ``msg_schemas/README.md``."""
    # The first usable bag of a stage gives its reference model, unless `models` holds one; every other bag of the stage
    # is compared with it. The rows do not depend on the number of workers. A run that was interrupted is continued with
    # the same `output`, and bags that are new or changed are added.
    with dependencies_needed():
        for name in ("distributed", "pyarrow", "pandas"):
            import_module(name)
    if sum(given is not None for given in (client, scheduler, workers)) > 1:
        raise UsageError("client, scheduler and workers exclude each other; give at most one")
    if workers is not None and workers < 1:
        raise UsageError(f"workers is {workers}; give at least 1")
    if scheduler is not None:
        _require_address(scheduler)
    options = {"topic": topic, "diagnose": diagnose} | ({"with": list(surroundings)} if surroundings else {})
    earliest = _nanoseconds(since)
    given = load_models(models)
    found = find_bags(sources)
    if not found and not watch:
        raise SlpiError(f"{', '.join(map(str, sources))}: no bag there; name folders that hold bags")
    with ExitStack() as stack:
        if output is None:
            output = stack.enter_context(TemporaryDirectory(prefix="slpi_fleet_"))
        results = stack.enter_context(Results(output, options))
        for stage, model in sorted(given.items()):
            _keep_given(results, stage, model)
        cluster = stack.enter_context(_connected(client, scheduler, workers, told or (lambda _: None)))
        cluster.require_shared(results.folder, found[:1])
        work = _Fleet(results, cluster, Source((), topic, surroundings=surroundings), earliest, diagnose, finished)
        try:
            while True:
                now = time.time()
                news = work.process([bag for bag in found if not watch or is_complete(bag, now, PATIENCE)])
                if not watch:
                    break
                if news:
                    work.write()
                report_progress(f"{len(results.state.judged)} bags, waiting for new ones")
                time.sleep(WATCH)
                found = find_bags(sources)
        finally:
            # After an interruption as well: what is finished is in the table.
            work.write()
        return as_table(results.state.rows()).to_pandas()


@dataclass
class _Fleet:
    """The steps of a run: examine all bags, choose references, compare the other bags, explain what is left."""

    results: Results
    cluster: "_Cluster"
    reading: Source
    earliest: int | None
    diagnosed: bool
    finished: Callable[[Results], None] | None
    _next_table: float = field(default_factory=lambda: time.monotonic() + WRITE)
    _total: int = 0

    @property
    def _state(self) -> State:
        return self.results.state

    def process(self, found: Sequence[Bag]) -> bool:
        """Process the bags that are new or changed, and what an earlier run left; return whether there were any."""
        known = self._state.examined
        new = [bag for bag in found if bag.path not in known or known[bag.path].bag != bag]
        left = [one for one in known.values() if one.bag.path not in self._state.judged and self._wanted(one)]
        open_ones = [path for path, judged in self._state.judged.items() if judged.unexplained]
        if not (new or left or open_ones):
            return False
        self._total = len(set(self._state.judged) | {bag.path for bag in new} | {one.bag.path for one in left})
        self._do(self._examination(bag) for bag in new)
        waiting = [one for one in known.values() if one.bag.path not in self._state.judged and self._wanted(one)]
        for one in waiting:
            if not one.axes:
                self.results.add_judged(one.bag.path, Judged(tuple(one.rows())))
        self._do(self._stage_tasks([one for one in waiting if one.axes]))
        self._do(self._explanation(path) for path, one in sorted(self._state.judged.items()) if one.unexplained)
        return True

    def write(self) -> None:
        """Write the table, and call `finished`."""
        self._write_table()
        if self.finished:
            self.finished(self.results)

    def _write_table(self) -> None:
        began = time.monotonic()
        self.results.write_table()
        now = time.monotonic()
        self._next_table = now + max(WRITE, WRITE_PAUSE * (now - began))

    def _wanted(self, one: Examined) -> bool:
        return self.earliest is None or one.date_ns is None or one.date_ns >= self.earliest

    def _do(self, tasks: Iterable[Task]) -> None:
        for task, result in self.cluster.work(tasks):
            self.cluster.extend(task.finish(result))
            report_progress(f"{len(self._state.judged)} of {self._total} bags")
            if time.monotonic() > self._next_table:
                self._write_table()

    def _examination(self, bag: Bag) -> Task:
        def finish(one: Examined) -> Iterable[Task]:
            self.results.add_examined(one)
            return ()

        return Task(Examined(bag, bag.stage), bags.examine, (bag, self.reading), finish)

    def _stage_tasks(self, waiting: Sequence[Examined]) -> Iterator[Task]:
        """Yield the first tasks of every stage: comparisons with its reference, or the identification of one."""
        stages: dict[str, list[Examined]] = {}
        for one in waiting:
            # A bag of an unknown stage is not comparable with any other.
            stages.setdefault(one.stage and f"stage {one.stage}" or f"bag {one.bag.path}", []).append(one)
        for _, queue in sorted(stages.items()):
            queue.sort(key=lambda one: (one.date_ns or 0, one.bag.path))
            yield from self._next_of_stage(queue)

    def _next_of_stage(self, queue: Sequence[Examined]) -> Iterator[Task]:
        if not queue:
            return
        first = queue[0]
        if first.stage in self._state.references and first.stage:
            for one in queue:
                yield self._comparison(one)
            return

        def finish(judged: Judged) -> Iterable[Task]:
            self.results.add_judged(first.bag.path, judged, first.stage or None)
            return self._next_of_stage(queue[1:])

        name = bags.model_name(first)
        arguments = (first, self.reading, str(self.results.folder), name)
        yield Task(first, bags.identify_bag, arguments, finish)

    def _comparison(self, one: Examined) -> Task:
        reference = self._state.references[one.stage]
        arguments = (one, self.reading, str(self.results.folder), reference, bags.model_name(one))
        return Task(one, bags.compare, arguments, lambda judged: self._keep(one, judged))

    def _explanation(self, path: str) -> Task:
        one, rows = self._state.examined[path], self._state.judged[path].rows
        others = {stage: model for stage, model in sorted(self._state.references.items()) if stage != one.stage}
        reference = self._state.references.get(one.stage) if one.stage else None
        reference = reference or self._state.judged[path].model
        known = (one, rows, self.reading, str(self.results.folder), reference, bags.model_name(one), others)
        # It may take minutes.
        arguments = (*known, self.diagnosed)
        return Task(one, bags.explain, arguments, lambda judged: self._keep(one, judged), alone=True)

    def _keep(self, one: Examined, judged: Judged) -> Iterable[Task]:
        self.results.add_judged(one.bag.path, judged)
        return ()


class _Cluster:
    """A Dask cluster that completes every task, whatever happens to its workers and, by address, to its scheduler."""

    def __init__(self, client: "Client", reconnect: Callable[[], "Client"] | None) -> None:
        self.client, self._reconnect = client, reconnect
        self._waiting: deque[Task] = deque()
        self._count, self._asked = 1, -np.inf
        # Seconds that a task of each function takes.
        self._pace: dict[Callable[..., Any], float] = {}

    def require_shared(self, folder: Path, found: Sequence[Bag]) -> None:
        """Raise SlpiError unless every worker has this package and sees the folder and the first bag."""
        places = [str(folder), *(bag.path for bag in found if bag.modified)]
        for attempt in range(ATTEMPTS):
            try:
                self.client.wait_for_workers(1, timeout=FIRST_WORKER)
                seen = self.client.run(_sees, places)
                break
            except TimeoutError:
                raise SlpiError("the cluster has no worker; start some with `dask worker ADDRESS`") from None
            except ImportError as error:
                raise SlpiError(f"the workers cannot run slpi_ros: {error}; install it on every machine") from None
            except Exception as error:
                # A worker or the scheduler has ended meanwhile.
                if attempt + 1 == ATTEMPTS:
                    raise SlpiError(f"the cluster failed: {error}; finished rows are kept: run again") from None
                self._connect_again()
        for worker, missing in seen.items():
            if missing:
                raise SlpiError(f"worker {worker} does not see {missing[0]}; mount it there at the same path")

    def extend(self, tasks: Iterable[Task]) -> None:
        """Add tasks while `work` runs; they precede those that wait."""
        self._waiting.extendleft(reversed(list(tasks)))

    def work(self, tasks: Iterable[Task]) -> Iterator[tuple[Task, Any]]:
        """Yield every task with its result, as they are finished; further ones may be added by `extend`."""
        from distributed import as_completed

        source = iter(tasks)
        running: dict[Any, list[Task]] = {}
        completed = as_completed(loop=self.client.loop)
        try:
            while True:
                lost = False
                while len(running) < GROUPS_PER_THREAD * self._threads() and (group := self._next(source)):
                    try:
                        arguments = [task.arguments for task in group]
                        future = self.client.submit(_together, group[0].function, arguments, pure=False)
                    except Exception:
                        self._waiting.extendleft(reversed(group))
                        lost = True
                        break
                    running[future] = group
                    completed.add(future)
                if not running and not lost:
                    return
                done: Any = None if lost else next(completed, None)
                if done in running and done.status in ("finished", "error"):
                    yield from self._settle(running.pop(done), done)
                    continue
                # The scheduler is lost, and with it every future.
                self._waiting.extendleft(task for group in running.values() for task in group)
                running = {}
                self._connect_again()
                completed = as_completed(loop=self.client.loop)
        finally:
            with suppress(Exception):
                self.client.cancel(list(running))
            self._waiting.clear()

    def _next(self, source: Iterator[Task]) -> list[Task]:
        """Return the next tasks, of one function, that are sent together."""
        group: list[Task] = []
        size, room = 1, GROUP_BYTES
        while len(group) < size and (task := self._waiting.popleft() if self._waiting else next(source, None)):
            room -= task.bag.bag.size
            if group and (task.alone or task.function is not group[0].function or room < 0):
                self._waiting.appendleft(task)
                break
            group.append(task)
            if not task.alone and task.function in self._pace:
                size = min(MOST_TASKS, int(GROUP_SECONDS / max(self._pace[task.function], 1e-6)))
        return group

    def _settle(self, group: Sequence[Task], future: Any) -> Iterator[tuple[Task, Any]]:
        from distributed import KilledWorker

        if future.status == "finished":
            try:
                results, seconds = future.result()
            except Exception:
                # The worker that held the results has ended.
                self._waiting.extendleft(reversed(group))
                return
            function, pace = group[0].function, seconds / len(group)
            self._pace[function] = 0.5 * (self._pace.get(function, pace) + pace)
            yield from zip(group, results, strict=True)
            return
        if len(group) > 1:
            # Each by itself shows which one it was.
            self._waiting.extendleft(replace(task, alone=True) for task in reversed(group))
            return
        (task,), error = group, future.exception()
        if not isinstance(error, KilledWorker):
            what = f"{task.bag.bag.path}: the cluster failed: {type(error).__name__}: {error}"
            raise SlpiError(f"{what}; finished rows are kept: run again")
        if task.attempts + 1 < ATTEMPTS:
            self._waiting.append(replace(task, attempts=task.attempts + 1, alone=True))
            return
        reason = f"{task.bag.bag.path}: every worker that processed it has ended; give workers more memory"
        if task.function is bags.examine:
            yield task, replace(task.bag, refused={"": reason})
        else:
            yield task, bags.given_up(task.bag, reason)

    def _threads(self) -> int:
        """Return the number of threads of the cluster, asked for once a second."""
        if time.monotonic() - self._asked > 1.0:
            with suppress(Exception):
                self._count = max(1, int(sum(self.client.nthreads().values())))
            self._asked = time.monotonic()
        return self._count

    def _connect_again(self) -> None:
        if self._reconnect is None:
            raise SlpiError("the scheduler is lost; finished rows are kept: run again to continue")
        report_progress("the scheduler is lost; waiting for it")
        with suppress(Exception):
            self.client.close(timeout=1)
        self.client = self._reconnect()


@contextmanager
def _connected(
    client: "Client | None", scheduler: str | None, workers: int | None, told: Callable[[str], None]
) -> Iterator[_Cluster]:
    """Provide the cluster of a run; one that is started here ends with the ``with`` block."""
    from distributed import Client, LocalCluster

    if client is not None:
        yield _Cluster(client, None)
        return
    if scheduler is not None:

        def connect() -> Client:
            end = time.monotonic() + RECONNECT
            while True:
                try:
                    return Client(scheduler, timeout=5, set_as_default=False)
                except OSError as error:
                    if time.monotonic() > end:
                        raise SlpiError(
                            f"no scheduler at {scheduler}: {error}; start one with `dask scheduler`; finished rows "
                            "are kept"
                        ) from None
                    time.sleep(0.5)

        cluster = _Cluster(connect(), connect)
        try:
            told(f"cluster at {scheduler}; dashboard: {cluster.client.dashboard_link}")
            yield cluster
        finally:
            with suppress(Exception):
                cluster.client.close(timeout=5)
        return
    count = workers or os.cpu_count() or 1
    with (
        LocalCluster(n_workers=count, threads_per_worker=1, dashboard_address="127.0.0.1:0", silence_logs=50) as local,
        Client(local, set_as_default=False) as own,
    ):
        held = [worker["memory_limit"] for worker in own.scheduler_info()["workers"].values()]
        told(
            f"local cluster of {count} workers with {min(held, default=0) / 2**30:.3g} GiB of memory each; "
            f"dashboard: {own.dashboard_link}"
        )
        yield _Cluster(own, None)


def _require_address(scheduler: str) -> None:
    """Raise an error unless this is an address whose host is known: a client would try it for a minute."""
    from distributed.comm import resolve_address

    example = "give one such as tcp://host:8786"
    try:
        with warnings.catch_warnings(action="error"):
            resolve_address(scheduler)
    except socket.gaierror as error:
        # A server of names that does not answer now may do so in a moment.
        if error.errno != socket.EAI_AGAIN:
            raise SlpiError(f"no scheduler at {scheduler}: {error.strerror}; {example}") from None
    except (ValueError, ImportError, Warning) as error:
        raise UsageError(f"{scheduler} is no address of a scheduler: {error}; {example}") from None


def _keep_given(results: Results, stage: str, model: StageModel) -> None:
    """Make a given model the reference of a stage; UsageError if the stage has another one."""
    name = f"models/{bags.plain_name(stage)}/given.json"
    path, known = results.folder / name, results.state.references.get(stage)
    if known is None:
        path.parent.mkdir(parents=True, exist_ok=True)
        save_model(model, path)
        results.add_reference(stage, name)
    elif known != name or path.read_text(encoding="utf-8") != format_model(model):
        raise UsageError(f"{results.folder}: stage '{stage}' has another reference there, {known}; name another folder")


def _together(function: Callable[..., Any], arguments: Sequence[tuple[Any, ...]]) -> tuple[list[Any], float]:
    """Return what a function gives for each of some arguments, and how long (s) all of them took."""
    began = time.perf_counter()
    results = [function(*each) for each in arguments]
    return results, time.perf_counter() - began


def _sees(places: Sequence[str]) -> list[str]:
    """Return the places that this machine does not see."""
    return [place for place in places if not os.path.exists(place)]


def _nanoseconds(since: str | None) -> int | None:
    """Return a date as Unix time, nanoseconds; UsageError if it is none."""
    if since is None:
        return None
    try:
        return int(np.datetime64(since, "ns").astype(np.int64))
    except ValueError:
        raise UsageError(f"'{since}' is no date; give one such as 2026-01-31 or 2026-01-31T12:00") from None
