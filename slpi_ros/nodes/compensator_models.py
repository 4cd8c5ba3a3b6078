"""The models of a compensator: from a file and from ``stage_model``, validated, and put into use."""

import time
from concurrent.futures import Future, ThreadPoolExecutor

from rclpy.lifecycle import LifecycleNode
from std_msgs.msg import String

from slpi_ros.compensator.controller import Controller, OperatingMode
from slpi_ros.compensator.persistence import model_id
from slpi_ros.errors import ModelError, SlpiError, shown
from slpi_ros.model.document import load_model
from slpi_ros.model.stage_model import StageModel
from slpi_ros.nodes.compensator_diagnostics import Reporter
from slpi_ros.nodes.compensator_memory import Memory
from slpi_ros.nodes.jobs import Read, Reading
from slpi_ros.nodes.path_learning import PathLearning


class Models:
    """Put models into use. The documents of the topic are validated in the background, the newest one counts."""

    # Validating a document takes as long as processing many commands, so it runs in another thread.
    def __init__(
        self, node: LifecycleNode, controller: Controller, memory: Memory, learning: PathLearning, reporter: Reporter
    ) -> None:
        self._node, self._controller, self._memory = node, controller, memory
        self._learning, self._reporter = learning, reporter
        self._topic = node.resolve_topic_name("stage_model")
        self._reader = ThreadPoolExecutor(1, "stage_model")
        self._reading: Reading | None = None

    def load(self, path: str) -> None:
        """Use the model of a file, if there is a path; ModelError if it is refused."""
        if path:
            model = load_model(path)
            self._use(model, model_id(model), path)

    def on_message(self, message: String) -> None:
        """Load the model of a message in the background; the previous model is used until then."""
        self.stop_reading()
        try:
            self._reading = Reading(message.data, self._topic)
        except SlpiError as error:
            self.refuse(error)
            return
        self._reader.submit(self._reading.read).add_done_callback(self._on_read)

    def stop_reading(self) -> None:
        """Cancel the validation of a document that is under way."""
        if self._reading:
            self._reading.cancel()
            self._reading = None

    def refuse(self, error: SlpiError) -> None:
        """Tell that a model is refused."""
        self._controller.counts["models_refused"] += 1
        self._reporter.model_error = str(error)
        self._reporter.report()

    def _on_read(self, coming: Future[Read | None]) -> None:
        """Schedule `_take` in the thread of the executor."""
        if self._node.executor:
            self._node.executor.create_task(self._take, coming)

    def _take(self, coming: Future[Read | None]) -> None:
        if self._controller.mode is OperatingMode.UNCONFIGURED:
            return
        try:
            read = coming.result()
            if read:
                self._use(*read, self._topic)
        except SlpiError as error:
            self.refuse(error)

    def _use(self, model: StageModel, fingerprint: str, source: str) -> None:
        """Replace the model unless it is already in use: a latched document may arrive repeatedly."""
        controller, reporter, values = self._controller, self._reporter, self._reporter.settings.values
        wanted = values["model_sha256"]
        if wanted and fingerprint != wanted:
            raise ModelError(f"{source}: SHA-256 {fingerprint}, not {wanted} of model_sha256; give that model")
        if controller.model is None or fingerprint != reporter.model_id:
            saved, last = self._memory.find(model)
            try:
                controller.use_model(model, saved, values["start_memory"], last, time.monotonic_ns())
            except SlpiError as error:
                raise ModelError(f"{source}: {error}") from None
            self._node.get_logger().info(
                shown(f"using the model of {source}, identified {model.created or 'at an unknown time'}")
            )
            reporter.model_id = fingerprint
            self._learning.use_model(controller.identified)
            if controller.active:
                self._memory.save(complete=False)
                self._memory.begin()
        reporter.model_error = ""
        reporter.report()
