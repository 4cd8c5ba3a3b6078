"""Node ``identify``: identifies a model from bags and publishes it, latched."""

import math
import os
import tempfile
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

from rclpy.node import Node
from std_msgs.msg import String

from slpi_ros.errors import RecordError, SlpiError, UsageError, shown
from slpi_ros.identification.fit import KINDS
from slpi_ros.io.bag_files import PATIENCE, BagWatch
from slpi_ros.io.input_limits import TOPIC_MODEL_CHARACTERS
from slpi_ros.io.outputs import allow_document
from slpi_ros.model.document import parse_model, save_model
from slpi_ros.model.sensor import LONGEST
from slpi_ros.model.stage_model import StageModel
from slpi_ros.nodes import parameters as declare
from slpi_ros.nodes.common import ERROR, LATCHED, WARN, DeferredService, Diagnostics, Health, serve, steady_timer
from slpi_ros.nodes.jobs import (
    DiagnosisOutcome,
    DiagnosisRequest,
    FitOutcome,
    FitRequest,
    StageIdentity,
    WorkerProcess,
    fit,
    run_diagnosis,
)
from slpi_ros.nodes.parameters import Declaration, Parameters, Values, validated

ANY_TIME = (-math.inf, math.inf)
DECLARATIONS = (
    declare.path(
        "bags",
        "Bags to identify in one fit: rosbag2 folders, or single mcap or db3 files. A later change of a parameter "
        "repeats the identification.",
        [""],
    ),
    declare.path(
        "watch_directory",
        "Watched folder: the newest complete bag and every bag completed later are identified, unless recorded on "
        "another stage than the published model; empty: none.",
    ),
    declare.text("topic", "stage_state", "Topic of the bag that holds voltage and displacement."),
    Declaration(
        "surroundings", [""],
        "Recorded quantities that the stage may follow, topic or topic:field: the model compensates those that it "
        "follows; empty: none, and for ~/diagnose every one that the bag holds.",
    ),
    declare.text("kind", "slpi", f"Kind of hysteresis model: {', '.join(KINDS)}.", *KINDS),
    declare.path("output", "File for the model document; empty: none."),
    Declaration(
        "replace", False,
        "Whether a new model is published whatever it lacks beside the model in use: voltage range, coverage, samples, "
        "held-out error.",
    ),
    declare.scalar(
        "sensor_delay", 0.0, "Known delay of the sensor, seconds, taken out of its readings; the model keeps it.",
        (0.0, LONGEST),
    ),
    declare.scalar(
        "sensor_lag", 0.0,
        "Known time constant of the sensor's low-pass filter, seconds, taken out of its readings; the model keeps it.",
        (0.0, LONGEST),
    ),
    declare.scalar(
        "start", math.nan, "Start of the fitted part, seconds from the first stamp; NaN or negative: first stamp.",
        ANY_TIME,
    ),
    declare.scalar(
        "stop", math.nan, "End of the fitted part, seconds from the first stamp; NaN or negative: last stamp.", ANY_TIME
    ),
    declare.path(
        "diagnosis_directory",
        "Output folder of ~/diagnose; empty: NAME_diagnosis next to the output NAME.json, or, without an output, a "
        "temporary folder named in the service response.",
    ),
    declare.DIAGNOSTIC_PERIOD,
)  # fmt: skip


@dataclass(frozen=True)
class IdentifySettings:
    """Validated settings of the node."""

    request: FitRequest  # also used for bags of the watched folder
    watch_directory: str  # "": none
    diagnosis_directory: str  # "": a temporary folder
    diagnostic_period: float  # s

    @classmethod
    def of(cls, values: Values) -> "IdentifySettings":
        """Return the settings from parameter names and values; UsageError if a value is not valid."""
        if not values["topic"]:
            raise UsageError("parameter topic is empty; name the topic of the bag, as in stage_state")
        checked = validated(DECLARATIONS, values)
        start, stop = (None if (time := checked[name]) is None or time < 0.0 else time for name in ("start", "stop"))
        if start is not None and stop is not None and not start < stop:
            raise UsageError(f"parameter start is {start:g} s and stop {stop:g} s; start before you stop")
        output, folder = values["output"], values["watch_directory"]
        bags, surroundings = (tuple(filter(None, values[name])) for name in ("bags", "surroundings"))
        same = {name: checked[name] for name in ("topic", "kind", "output", "sensor_delay", "sensor_lag")}
        request = FitRequest(
            bags=bags, start=start, stop=stop, unconditional=values["replace"], surroundings=surroundings, **same
        )
        if folder:
            BagWatch(folder)
        beside = f"{os.path.splitext(output)[0]}_diagnosis" if output else ""
        return cls(request, folder, values["diagnosis_directory"] or beside, checked["diagnostic_period"])


# Periods of looks at the processes and at the watched folder, seconds.
POLL_PERIOD, WATCH_PERIOD = 0.1, 0.5
NO_MODEL = "nothing to diagnose: no bag has been identified yet"
NOTHING_TO_DO = "no bag to identify; set the parameter bags or watch_directory"


class DiagnosisService:
    """Service ``~/diagnose``: find the causes of the model errors on the bags of the fit; respond when complete."""

    # The diagnosis only writes files, in `folder` ("": a temporary one); it does not change the published model.
    # `report` is called at start and end of a diagnosis.
    def __init__(self, node: Node, folder: Callable[[], str], report: Callable[[], None]) -> None:
        self._logger, self._folder, self._report = node.get_logger(), folder, report
        self._published: DiagnosisRequest | None = None
        self._job: WorkerProcess[DiagnosisRequest, DiagnosisOutcome] | None = None
        self._last: DiagnosisRequest | None = None
        self.outcome = DiagnosisOutcome()  # of the last diagnosis
        self._service = DeferredService(node, "~/diagnose", self._start)

    @property
    def activity(self) -> str:
        """Text that describes the running diagnosis; "" if none."""
        return f"diagnosing {self._job.request.source} for {self._job.seconds:.0f} s" if self._job else ""

    @property
    def values(self) -> dict[str, object]:
        """Values for ``/diagnostics``."""
        state = "diagnosing" if self._job else "failed" if self.outcome.error else "done" if self._last else "none"
        return {
            "diagnosis.state": state,
            "diagnosis.bag": self._last.source if self._last else "",
            "diagnosis.folder": self._last.folder if self._last else "",
            **{f"{axis}.verdict": verdict for axis, verdict in self.outcome.verdicts.items()},
            **{f"{axis}.diagnosis": summary for axis, summary in self.outcome.summaries.items()},
        }

    def use(self, published: DiagnosisRequest) -> None:
        """Diagnose another model from now on, which has been published, and discard the last result."""
        self._published = published
        if not self._job:
            self._last, self.outcome = None, DiagnosisOutcome()

    def end(self) -> None:
        """Stop the running diagnosis, if any; for the end of the node."""
        if self._job:
            self._job.end()

    def poll(self) -> None:
        """Respond if the diagnosis is complete."""
        if not self._job or not (outcome := self._job.outcome()):
            return
        folder, self._job, self.outcome = Path(self._job.request.folder), None, outcome
        said = outcome.error
        if said:
            self._logger.error(said)
        else:
            causes = "; ".join(
                f"{axis}: {verdict.replace('_', ' ')}: {outcome.summaries[axis]}"
                for axis, verdict in outcome.verdicts.items()
            )
            files = f"Page: {folder / 'report.html'}; extended model, not in use: {folder / 'extended_model.json'}"
            said = shown(f"{causes} {files}")
            self._logger.info(said)
        self._service.answer(not outcome.error, said)
        self._report()

    def _start(self) -> str:
        """Start a diagnosis unless one is running; return the reason if this is not possible, else ""."""
        if self._job:
            return ""
        if not self._published:
            return NO_MODEL
        try:
            folder = os.path.abspath(self._folder() or self._temporary)
            request = replace(self._published, folder=folder)
            self._job = WorkerProcess(run_diagnosis, request, DiagnosisOutcome, f"{request.source}: the diagnosis")
        except OSError as error:
            return f"no diagnosis can be started: {error}; free memory or disk, or set diagnosis_directory"
        self._last, self.outcome = request, DiagnosisOutcome()
        self._report()
        return ""

    @cached_property
    def _temporary(self) -> str:
        return tempfile.mkdtemp(prefix="slpi_diagnosis_")


# Time from the start within which a model that somebody else has published is heard of, seconds: Fast DDS announces a
# participant again after three seconds, if the first announcements were lost.
DISCOVERY = 4.0
# The same where there is another publisher: a latched message that was lost comes again after three more seconds.
LATCHED_WITHIN = 7.0


class ModelInUse:
    """The model in use: the last `document` on ``stage_model``, by whomever; "" if there is none."""

    def __init__(self, node: Node) -> None:
        self.document = ""
        self._node, self._begun = node, time.monotonic()
        self._echoes: deque[str] = deque()  # messages of this node that will come back
        self._publisher = node.create_publisher(String, "stage_model", LATCHED)
        node.create_subscription(String, "stage_model", self._on_model, LATCHED)

    @property
    def known(self) -> bool:
        """Whether a model that somebody else has published has been heard of, if there is one."""
        others = not self.document and self._node.count_publishers("stage_model") > 1
        return time.monotonic() - self._begun >= (LATCHED_WITHIN if others else DISCOVERY)

    def publish(self, document: str) -> None:
        """Publish a model, which is in use from now on."""
        self.document = document
        self._echoes.append(document)
        self._publisher.publish(String(data=document))

    def _on_model(self, message: String) -> None:
        """Take note of a model that somebody else has published."""
        document = str(message.data)
        if document in self._echoes:
            while self._echoes.popleft() != document:
                pass
        elif len(document) <= TOPIC_MODEL_CHARACTERS:
            self.document = document


class Identify(Node):
    """Identify the model of a stage from bags and publish it, latched, on ``stage_model``.

    Publishes ``stage_model`` and ``/diagnostics``; parameters in `DECLARATIONS`. The service ``~/identify``
    (``std_srvs/Trigger``) repeats the identification, ``~/diagnose`` finds the causes of the errors of the published
    model on its bags. A bag that cannot be identified, or a bag of the watched folder that was recorded on another
    stage, is reported and skipped; the last valid model stays published. So it does if the new model is worse than the
    model in use: the last one on ``stage_model``, by whomever, or else the one in the file ``output``.
    """

    def __init__(self) -> None:
        super().__init__("identify")
        parameters = Parameters(self, DECLARATIONS, IdentifySettings.of)
        self._settings = parameters.settings
        self._in_use = ModelInUse(self)
        self._diagnostics = Diagnostics(self, "identify")
        self._diagnosis = DiagnosisService(self, lambda: self._settings.diagnosis_directory, self._report)
        self._job: WorkerProcess[FitRequest, FitOutcome] | None = None
        self._asked: FitRequest | None = None
        self._waiting: deque[Path] = deque()
        self._watch: BagWatch | None = None
        self._abandoned: tuple[Path, ...] = ()
        self._stage: StageIdentity | None = None  # of the watched folder
        self._as_in_use = True  # as long as the stage is not known it is that of the model in use
        self._failed = 0
        self._model = StageModel({})  # the last one that was published
        self._doubtful: tuple[FitRequest, FitOutcome] | None = None
        self._error = ""
        steady_timer(self, POLL_PERIOD, self._poll_jobs)
        steady_timer(self, WATCH_PERIOD, self._poll_bags)
        steady_timer(self, self._settings.diagnostic_period, self._report)
        serve(self, "~/identify", self._on_trigger)
        parameters.follow(self._on_change)
        self._begin()

    def destroy_node(self) -> None:
        """Stop running jobs, then destroy the node."""
        self._end_job()
        self._diagnosis.end()
        super().destroy_node()

    def _on_change(self, settings: IdentifySettings) -> None:
        """Repeat the identification, unless only the diagnosis folder has changed."""
        before, self._settings = self._settings, settings
        if settings.watch_directory != before.watch_directory:
            # Another folder may hold bags of another stage.
            self._stage, self._as_in_use = None, False
        if settings == before or replace(settings, diagnosis_directory=before.diagnosis_directory) != before:
            self._begin()

    def _begin(self) -> None:
        """Stop the running identification and start the one that the settings request."""
        self._end_job()
        self._error, self._doubtful = "", None
        self._waiting.clear()
        request, folder = self._settings.request, self._settings.watch_directory
        self._asked = request if request.bags else None
        self._watch = BagWatch(folder) if folder else None
        if not self._asked and not self._watch:
            self.get_logger().info(NOTHING_TO_DO)
        self._poll_bags()
        self._report()

    def _poll_bags(self) -> None:
        """Queue newly completed bags of the watched folder; warn once about abandoned ones."""
        for bag in self._watch.poll() if self._watch else ():
            if str(bag) != str(bag).encode(errors="ignore").decode():
                # Lone surrogates stand for bytes that are not UTF-8: neither a parameter nor a message can name it.
                self._fail(RecordError(f"{bag}: skipped: its name is not UTF-8; rename it"))
                continue
            self.get_logger().info(shown(f"{bag} is complete"))
            self._waiting.append(bag)
        before, self._abandoned = self._abandoned, self._watch.abandoned if self._watch else ()
        for bag in self._abandoned:
            if bag not in before:
                self.get_logger().warning(shown(abandonment([bag])))
        self._start_next()

    def _on_trigger(self) -> tuple[bool, str]:
        """Publish a withheld model, if any; else identify again from the given bags or from the newest watched bag."""
        if self._doubtful:
            asked, outcome = self._doubtful
            self._take(asked, replace(outcome, doubt=""))
            return not self._error, self._error or shown(f"published the model of {asked.source}")
        try:
            self._begin()
        except SlpiError as error:
            return False, str(error)
        return (True, shown(f"identifying {self._job.request.source}")) if self._job else (False, NOTHING_TO_DO)

    def _start_next(self) -> None:
        """Start the next queued identification, unless one is running."""
        request = None if self._job else self._next_request()
        if request:
            self._job = WorkerProcess(fit, request, FitOutcome, f"{request.source}: the identification")

    def _next_request(self) -> FitRequest | None:
        """Return the request of the settings first, then one for each queued bag of the watched folder, then None."""
        request, self._asked = self._asked, None
        if not request and self._waiting:
            bag = str(self._waiting.popleft())
            request = replace(self._settings.request, bags=(bag,), stage=self._stage, as_in_use=self._as_in_use)
        return replace(request, in_use=self._in_use.document) if request else None

    def _end_job(self) -> None:
        if self._job:
            self._job.end()
            self._job = None

    def _poll_jobs(self) -> None:
        self._diagnosis.poll()
        job = self._job if self._in_use.known else None
        outcome = job.outcome() if job else None
        if job and outcome:
            self._job = None
            same, required = job.request.in_use == self._in_use.document, job.request.requires_stage_in_use
            if same or (not required and (job.request.unconditional or outcome.error)):
                self._take(job.request, outcome)
            else:
                # Another model has come into use meanwhile: its stage counts, and it is the one to compare with.
                self._asked = job.request
            self._start_next()

    def _take(self, request: FitRequest, outcome: FitOutcome) -> None:
        self._doubtful = (request, outcome) if outcome.doubt else None
        if outcome.doubt:
            self._error = shown(
                f"{outcome.doubt}; the model in use stays: call ~/identify to publish the new one nevertheless, or "
                "record more"
            )
            self.get_logger().warning(self._error)
        elif outcome.error:
            self._fail(outcome.error)
        else:
            self._error = ""
            self._publish(request, outcome)
        self._report()

    def _publish(self, request: FitRequest, outcome: FitOutcome) -> None:
        """Publish a model, write it to the file `output`, if any, and have it diagnosed from now on."""
        document, self._model = outcome.document, parse_model(outcome.document, "identify")
        self._stage = StageIdentity.of(self._model, outcome.stage)
        self._diagnosis.use(
            DiagnosisRequest(
                request.bags, request.topic, document,
                surroundings=request.surroundings, start=request.start, stop=request.stop,
            )
        )  # fmt: skip
        try:
            if request.output:
                allow_document(request.output, "model")
                save_model(self._model, request.output)
        except SlpiError as error:
            self._fail(error)
        self._in_use.publish(document)
        self.get_logger().info(shown(described(self._model)))

    def _fail(self, error: SlpiError | str) -> None:
        """Count and log the reason why a bag gave no model, or why the model was not written."""
        self._error = shown(error)
        self._failed += 1
        self.get_logger().error(self._error)

    def _report(self) -> None:
        model = self._model
        values: dict[str, object] = {
            "state": "identifying" if self._job else "waiting",
            "model.created": model.created,
            "model.hardware_id": model.hardware_id,
            "waiting_bags": len(self._waiting),
            "abandoned_bags": len(self._abandoned),
            "failed": self._failed,
            "last_error": self._error,
            **self._diagnosis.values,
        }
        for name, axis in model.axes.items():
            quality = axis.quality
            values |= {
                f"{name}.kind": axis.kind,
                f"{name}.rms_nm": f"{quality.rms * 1e9:.2f}",
                f"{name}.held_out_rms_nm": f"{quality.held_out_rms * 1e9:.2f}",
                f"{name}.maximum_nm": f"{quality.maximum * 1e9:.2f}",
                f"{name}.noise_rms_nm": f"{quality.floor_rms * 1e9:.2f}",
                f"{name}.samples": quality.samples,
                f"{name}.covered": f"{quality.covered:.3f}",
                f"{name}.source": quality.source,
            }
        idle = not model.axes and not self._job and not self._watch
        problems = (
            (WARN if self._doubtful else ERROR, self._error),
            (WARN, NOTHING_TO_DO if idle and not self._error else ""),
            (WARN, abandonment(self._abandoned) if self._abandoned else ""),
            (WARN, self._diagnosis.outcome.error),
        )
        found = tuple((level, text) for level, text in problems if text)
        self._diagnostics.report(Health(found, self._activity(), values, model.hardware_id))

    def _activity(self) -> str:
        if self._job:
            return f"identifying {self._job.request.source} for {self._job.seconds:.0f} s"
        return self._diagnosis.activity or (described(self._model) if self._model.axes else "")


def abandonment(bags: Sequence[Path]) -> str:
    """Return a one-line message that names the abandoned bags and the remedy."""
    return (
        f"{', '.join(map(str, bags))}: not complete, and not grown for {PATIENCE:g} s: the recording seems abandoned; "
        "if it is, repair it (`ros2 bag reindex` for a folder, `mcap recover` for a file) or delete it"
    )


def described(model: StageModel) -> str:
    """Return a one-line message with the fit quality of a model."""
    axes = []
    for name, axis in model.axes.items():
        quality, (low, high) = axis.quality, axis.displacement_range
        axes.append(
            f"{name}: {axis.kind}, rms {quality.rms * 1e9:.1f} nm (held out {quality.held_out_rms * 1e9:.1f} nm) "
            f"of {(high - low) * 1e6:.3g} µm from {quality.samples} samples"
        )
    return f"identified {'; '.join(axes)}"
