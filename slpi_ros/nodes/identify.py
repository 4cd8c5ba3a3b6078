"""Node ``identify``: identifies a model from bags and publishes it, latched."""

import math
import os
import tempfile
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from std_msgs.msg import String
from std_srvs.srv import Trigger

from slpi_ros.errors import RecordError, SlpiError, UsageError, shown
from slpi_ros.identification.fit import KINDS
from slpi_ros.io.bag_files import PATIENCE, BagWatch
from slpi_ros.io.input_limits import TOPIC_MODEL_CHARACTERS
from slpi_ros.io.outputs import allow_document
from slpi_ros.model.document import parse_model, save_model
from slpi_ros.model.sensor import LONGEST
from slpi_ros.model.stage_model import StageModel
from slpi_ros.nodes import parameters as declare
from slpi_ros.nodes.common import ERROR, LATCHED, WARN, DeferredService, Diagnostics, Health
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
    Declaration(
        "bags", [""],
        "Bags to identify in one fit: rosbag2 folders, or single mcap or db3 files. A later change of a parameter "
        "repeats the identification.",
    ),
    declare.text(
        "watch_directory", "",
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
    declare.text("output", "", "File for the model document; empty: none."),
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
    declare.text(
        "diagnosis_directory", "",
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
        bags = tuple(bag for bag in values["bags"] if bag)
        if not values["topic"]:
            raise UsageError("parameter topic is empty; name the topic of the bag, as in stage_state")
        checked = validated(DECLARATIONS, values)
        start, stop = (None if (time := checked[name]) is None or time < 0.0 else time for name in ("start", "stop"))
        if start is not None and stop is not None and not start < stop:
            raise UsageError(f"parameter start is {start:g} s and stop {stop:g} s; start before you stop")
        request = FitRequest(
            bags,
            values["topic"],
            values["kind"],
            start,
            stop,
            values["output"],
            unconditional=values["replace"],
            sensor_delay=checked["sensor_delay"],
            sensor_lag=checked["sensor_lag"],
            surroundings=tuple(topic for topic in values["surroundings"] if topic),
        )
        folder = values["watch_directory"]
        if folder:
            BagWatch(folder)
        diagnosis = values["diagnosis_directory"] or beside(request.output)
        return cls(request, folder, diagnosis, checked["diagnostic_period"])


def beside(output: str) -> str:
    """Return the diagnosis folder next to the model file `output`; "" without a file."""
    return f"{os.path.splitext(output)[0]}_diagnosis" if output else ""


POLL_PERIOD = 0.1
NO_MODEL = "nothing to diagnose: no bag has been identified yet"


class DiagnosisService:
    """Service ``~/diagnose``: find the causes of the model errors on the bags of the fit; respond when complete."""

    # The diagnosis only writes files, in `folder` ("": a temporary one); it does not change the published model.
    # `identified` returns the request for that model and its bags; `report` is called at start and end of a diagnosis.
    def __init__(
        self,
        node: Node,
        identified: Callable[[], DiagnosisRequest | None],
        folder: Callable[[], str],
        report: Callable[[], None],
    ) -> None:
        self._logger = node.get_logger()
        self._identified, self._folder, self._report = identified, folder, report
        self._job: WorkerProcess[DiagnosisRequest, DiagnosisOutcome] | None = None
        self._last: DiagnosisRequest | None = None
        self._outcome = DiagnosisOutcome()
        self._temporary = ""
        self._service = DeferredService(node, "~/diagnose", self._start)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._poll = node.create_timer(POLL_PERIOD, self._poll_job, clock=steady, autostart=False)

    @property
    def error(self) -> str:
        """Error message of the last diagnosis; "" if none."""
        return self._outcome.error

    @property
    def activity(self) -> str:
        """Text that describes the running diagnosis; "" if none."""
        return f"diagnosing {self._job.request.source} for {time.monotonic() - self._began:.0f} s" if self._job else ""

    @property
    def values(self) -> dict[str, object]:
        """Values for ``/diagnostics``."""
        state = "diagnosing" if self._job else "failed" if self.error else "done" if self._last else "none"
        return {
            "diagnosis.state": state,
            "diagnosis.bag": self._last.source if self._last else "",
            "diagnosis.folder": self._last.folder if self._last else "",
            **{f"{axis}.verdict": verdict for axis, verdict in self._outcome.verdicts.items()},
            **{f"{axis}.diagnosis": summary for axis, summary in self._outcome.summaries.items()},
        }

    def forget(self) -> None:
        """Discard the last result because another model has been published."""
        if not self._job:
            self._last, self._outcome = None, DiagnosisOutcome()

    def end(self) -> None:
        """Stop the running diagnosis, if any."""
        self._poll.cancel()
        if self._job:
            self._job.end()
            self._job = None

    def _start(self) -> str:
        """Start a diagnosis unless one is running; return the reason if this is not possible, else ""."""
        if self._job:
            return ""
        identified = self._identified()
        if not identified:
            return NO_MODEL
        try:
            folder = os.path.abspath(self._folder() or self._temporary_folder())
            request = replace(identified, folder=folder)
            self._job = WorkerProcess(run_diagnosis, request, DiagnosisOutcome, f"{request.source}: the diagnosis")
            self._began = time.monotonic()
        except OSError as error:
            return f"no diagnosis can be started: {error}; free memory or disk, or set diagnosis_directory"
        self._last, self._outcome = request, DiagnosisOutcome()
        self._poll.reset()
        self._report()
        return ""

    def _temporary_folder(self) -> str:
        self._temporary = self._temporary or tempfile.mkdtemp(prefix="slpi_diagnosis_")
        return self._temporary

    def _poll_job(self) -> None:
        outcome = self._job.outcome() if self._job else None
        if not self._job or not outcome:
            return
        folder, self._job, self._outcome = Path(self._job.request.folder), None, outcome
        self._poll.cancel()
        if outcome.error:
            self._logger.error(outcome.error)
            self._service.answer(False, outcome.error)
        else:
            said = "; ".join(
                f"{axis}: {verdict.replace('_', ' ')}: {outcome.summaries[axis]}"
                for axis, verdict in outcome.verdicts.items()
            )
            said += f" Page: {folder / 'report.html'}; extended model, not in use: {folder / 'extended_model.json'}"
            self._logger.info(shown(said))
            self._service.answer(True, shown(said))
        self._report()


WATCH_PERIOD = 0.5
NOTHING_TO_DO = "no bag to identify; set the parameter bags or watch_directory"

# Time from the start within which a model that somebody else has published is heard of, seconds: Fast DDS announces a
# participant again after three seconds, if the first announcements were lost.
DISCOVERY = 4.0
# The same where there is another publisher: a latched message that was lost comes again after three more seconds.
LATCHED_WITHIN = 7.0


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
        self._parameter_set = Parameters(self, DECLARATIONS, IdentifySettings.of)
        self._publisher = self.create_publisher(String, "stage_model", LATCHED)
        # The model in use, and the messages of this node that will come back.
        self._in_use, self._begun = "", time.monotonic()
        self._echoes: deque[str] = deque()
        self.create_subscription(String, "stage_model", self._on_model, LATCHED)
        self._diagnostics = Diagnostics(self, "identify")
        self._job: WorkerProcess[FitRequest, FitOutcome] | None = None
        self._asked: FitRequest | None = None
        self._waiting: deque[Path] = deque()
        self._watch: BagWatch | None = None
        self._abandoned: set[Path] = set()
        self._stage: StageIdentity | None = None
        self._failed = 0
        self._model: StageModel | None = None
        self._identified: DiagnosisRequest | None = None
        self._doubtful: tuple[FitRequest, str] | None = None
        self._error = ""
        # A simulated clock may stop.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._poll = self.create_timer(POLL_PERIOD, self._poll_job, clock=steady, autostart=False)
        self.create_timer(self._parameter_set.settings.diagnostic_period, self._report, clock=steady)
        self._watching = self.create_timer(WATCH_PERIOD, self._poll_bags, clock=steady)
        self.create_service(Trigger, "~/identify", self._on_trigger)
        self._diagnosis = DiagnosisService(
            self, lambda: self._identified, lambda: self._parameter_set.settings.diagnosis_directory, self._report
        )
        self._settings = self._parameter_set.settings
        self._parameter_set.follow(self._on_change)
        self._begin(self._settings)

    def destroy_node(self) -> None:
        """Stop running jobs, then destroy the node."""
        self._end_job()
        self._diagnosis.end()
        super().destroy_node()

    def _on_model(self, message: String) -> None:
        """Take note of a model that somebody else has published."""
        document = str(message.data)
        if document in self._echoes:
            while self._echoes.popleft() != document:
                pass
        elif len(document) <= TOPIC_MODEL_CHARACTERS:
            self._in_use = document

    def _on_change(self, settings: IdentifySettings) -> None:
        """Repeat the identification, unless only the diagnosis folder has changed."""
        before, self._settings = self._settings, settings
        if settings.watch_directory != before.watch_directory:
            # Another folder may hold bags of another stage.
            self._stage = None
        moved = settings.diagnosis_directory != before.diagnosis_directory
        if not moved or replace(settings, diagnosis_directory=before.diagnosis_directory) != before:
            self._begin(settings)

    def _begin(self, settings: IdentifySettings) -> None:
        """Stop the running identification and start the one that the settings request."""
        self._end_job()
        self._error = ""
        self._doubtful = None
        self._waiting.clear()
        self._asked = settings.request if settings.request.bags else None
        self._watch = BagWatch(settings.watch_directory) if settings.watch_directory else None
        if not self._asked and not self._watch:
            self.get_logger().info(NOTHING_TO_DO)
        self._poll_bags()
        self._start_next()
        self._report()

    def _poll_bags(self) -> None:
        """Queue newly completed bags of the watched folder; warn once about abandoned ones."""
        for bag in self._watch.poll() if self._watch else ():
            if not _is_utf8(bag):
                # Neither a parameter nor a message can name it.
                self._fail(RecordError(f"{bag}: skipped: its name is not UTF-8; rename it"))
                continue
            self.get_logger().info(shown(f"{bag} is complete"))
            self._waiting.append(bag)
        abandoned = set(self._watch.abandoned) if self._watch else set()
        for bag in sorted(abandoned - self._abandoned):
            self.get_logger().warning(shown(abandonment([bag])))
        self._abandoned = abandoned
        self._start_next()

    def _on_trigger(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Publish a withheld model, if any; else identify again from the given bags or from the newest watched bag."""
        if self._doubtful:
            (asked, document), self._doubtful = self._doubtful, None
            self._take(asked, FitOutcome(document))
            response.success = not self._error
            response.message = self._error or shown(f"published the model of {asked.source}")
            return response
        try:
            self._begin(self._parameter_set.settings)
        except SlpiError as error:
            response.success, response.message = False, str(error)
            return response
        response.success = self._job is not None
        response.message = shown(f"identifying {self._job.request.source}") if self._job else NOTHING_TO_DO
        return response

    def _start_next(self) -> None:
        """Start the next queued identification, unless one is running."""
        request = None if self._job else self._next_request()
        if request:
            self._job = WorkerProcess(fit, request, FitOutcome, f"{request.source}: the identification")
            self._job_start = time.monotonic()
            self._poll.reset()

    def _next_request(self) -> FitRequest | None:
        """Return the request of the settings first, then one for each queued bag of the watched folder, then None."""
        request, self._asked = self._asked, None
        if not request and self._waiting:
            bag = str(self._waiting.popleft())
            request = replace(self._parameter_set.settings.request, bags=(bag,), stage=self._stage)
        return replace(request, in_use=self._in_use) if request else None

    def _end_job(self) -> None:
        self._poll.cancel()
        if self._job:
            self._job.end()
            self._job = None

    def _poll_job(self) -> None:
        waited = time.monotonic() - self._begun
        others = not self._in_use and self.count_publishers("stage_model") > 1
        if waited < (LATCHED_WITHIN if others else DISCOVERY):
            return
        outcome = self._job.outcome() if self._job else None
        if self._job and outcome:
            request, self._job = self._job.request, None
            self._poll.cancel()
            if request.in_use == self._in_use or request.unconditional or outcome.error:
                self._take(request, outcome)
            else:
                # Another model has come into use meanwhile: compare with that one.
                self._asked = request
            self._start_next()

    def _write(self, model: StageModel, output: str) -> None:
        try:
            if output:
                allow_document(output, "model")
                save_model(model, output)
        except SlpiError as error:
            self._fail(error)

    def _take(self, request: FitRequest, outcome: FitOutcome) -> None:
        if outcome.doubt:
            self._doubtful = request, outcome.document
            self._error = shown(
                f"{outcome.doubt}; the model in use stays: call ~/identify to publish the new one nevertheless, or "
                "record more"
            )
            self.get_logger().warning(self._error)
            self._report()
            return
        self._doubtful, self._error = None, ""
        if outcome.document:
            self._model = parse_model(outcome.document, "identify")
            self._stage = StageIdentity.of(self._model, request.stage)
            self._identified = DiagnosisRequest(
                request.bags, request.topic, outcome.document, surroundings=request.surroundings
            )
            self._diagnosis.forget()
            self._write(self._model, request.output)
            self._in_use = outcome.document
            self._echoes.append(outcome.document)
            self._publisher.publish(String(data=outcome.document))
            self.get_logger().info(shown(described(self._model)))
        if outcome.error:
            self._fail(outcome.error)
        self._report()

    def _fail(self, error: SlpiError | str) -> None:
        """Count and log the reason why a bag gave no model, or why the model was not written."""
        self._error = shown(error)
        self._failed += 1
        self.get_logger().error(self._error)

    def _report(self) -> None:
        model = self._model
        values: dict[str, object] = {
            "state": "identifying" if self._job else "waiting",
            "model.created": model.created if model else "",
            "model.hardware_id": model.hardware_id if model else "",
            "waiting_bags": len(self._waiting),
            "abandoned_bags": len(self._abandoned),
            "failed": self._failed,
            "last_error": self._error,
            **self._diagnosis.values,
        }
        for name, axis in model.axes.items() if model else ():
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
        problems = ((WARN if self._doubtful else ERROR, self._error),) if self._error else ()
        if not problems and not model and not self._job and not self._watch:
            problems = ((WARN, NOTHING_TO_DO),)
        if self._abandoned:
            problems = (*problems, (WARN, abandonment(sorted(self._abandoned))))
        if self._diagnosis.error:
            problems = (*problems, (WARN, self._diagnosis.error))
        hardware_id = model.hardware_id if model else ""
        self._diagnostics.report(Health(problems, self._activity(), values, hardware_id))

    def _activity(self) -> str:
        if self._job:
            return f"identifying {self._job.request.source} for {time.monotonic() - self._job_start:.0f} s"
        return self._diagnosis.activity or (described(self._model) if self._model else "")


def _is_utf8(path: Path) -> bool:
    """Return whether the name of a path is UTF-8; other bytes reach Python as lone surrogates."""
    try:
        str(path).encode()
    except UnicodeEncodeError:
        return False
    return True


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
