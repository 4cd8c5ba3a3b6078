"""The compensator's models: from a file, and from the topic ``stage_model`` while it runs."""

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor

from rclpy.node import Node
from std_msgs.msg import String

from slpi_ros.compensator.controller import Compensation
from slpi_ros.compensator.persistence import model_id
from slpi_ros.errors import ModelError, SlpiError
from slpi_ros.model.document import load_model
from slpi_ros.model.stage_model import StageModel
from slpi_ros.nodes.compensator_diagnostics import Reporter
from slpi_ros.nodes.compensator_memory import MemoryKeeper
from slpi_ros.nodes.compensator_parameters import CompensatorSettings
from slpi_ros.nodes.jobs import Read, Reading


class Models:
    """Takes models over, and says which one is in use and why another is not.

    To check a document takes as long as many commands, so this is done in the background.

    Parameters
    ----------
    node : Node
    compensation : Compensation
    keeper : MemoryKeeper
    reporter : Reporter
    settings : callable
        Returns the present ones.
    """

    def __init__(
        self,
        node: Node,
        compensation: Compensation,
        keeper: MemoryKeeper,
        reporter: Reporter,
        settings: Callable[[], CompensatorSettings],
    ) -> None:
        self._node, self._log, self._topic = node, node.get_logger(), node.resolve_topic_name("stage_model")
        self._compensation, self._keeper, self._reporter, self._settings = compensation, keeper, reporter, settings
        self._in_use = ""
        self._background = ThreadPoolExecutor(1, "stage_model")
        self._reading: Reading | None = None

    def load(self, path: str) -> None:
        """Use the model of a file.

        Raises
        ------
        ModelError
            If there is none, or it cannot serve.
        """
        model = load_model(path)
        self._use(model, model_id(model), path)

    def on_message(self, message: String) -> None:
        """Use the model of a message soon, or say why not: the one before works on.

        Of those that have not been read when a newer one comes, nothing becomes.
        """
        self.end()
        try:
            self._reading = Reading(message.data, self._topic)
        except SlpiError as error:
            self._refuse(error)
            return
        self._background.submit(self._reading.read).add_done_callback(self._on_read)

    def end(self) -> None:
        """Leave what is being read."""
        if self._reading:
            self._reading.cancel()
            self._reading = None

    def _on_read(self, coming: Future[Read | None]) -> None:
        """Go on in the thread that the node lives in."""
        if self._node.executor:
            self._node.executor.create_task(self._take, coming)

    def _take(self, coming: Future[Read | None]) -> None:
        if self._reporter.state == "unconfigured":
            return
        try:
            read = coming.result()
            if read:
                self._use(*read, self._topic)
        except SlpiError as error:
            self._refuse(error)

    def _refuse(self, error: SlpiError) -> None:
        self._log.error(f"model refused: {error}")
        self._reporter.model_refused(str(error))

    def _use(self, model: StageModel, fingerprint: str, source: str) -> None:
        """Take a model over, unless it is the one in use: a latched document may come more than once."""
        compensation = self._compensation
        if compensation.model is None or fingerprint != self._in_use:
            saved = None if compensation.driven else self._keeper.find(model, self._settings().limits)
            try:
                compensation.use_model(model, saved)
            except SlpiError as error:
                raise ModelError(f"{source}: {error}") from None
            self._in_use = fingerprint
            self._log.info(f"using the model of {source}, identified {model.created or 'at an unknown time'}")
            if compensation.active:
                self._keeper.save(complete=False)
        self._reporter.model_taken(fingerprint)
