"""The compensator's models: from a file, and from the topic ``stage_model`` while it runs."""

from collections.abc import Callable

from rclpy.node import Node
from std_msgs.msg import String

from slpi_ros.errors import ModelError, SlpiError
from slpi_ros.model import StageModel
from slpi_ros.model_file import load_model, parse_model
from slpi_ros.nodes.compensation import Compensation
from slpi_ros.nodes.compensator_memory import MemoryKeeper
from slpi_ros.nodes.compensator_report import Reporter
from slpi_ros.nodes.compensator_settings import CompensatorSettings
from slpi_ros.runtime.saved_memory import model_id


class Models:
    """Takes models over, and says which one is in use and why another is not.

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
        self._log, self._topic = node.get_logger(), node.resolve_topic_name("stage_model")
        self._compensation, self._keeper, self._reporter, self._settings = compensation, keeper, reporter, settings
        self._in_use = ""

    def load(self, path: str) -> None:
        """Use the model of a file.

        Raises
        ------
        ModelError
            If there is none, or it cannot serve.
        """
        self._use(load_model(path), path)

    def on_message(self, message: String) -> None:
        """Use the model of a message, or say why not: the one before works on."""
        try:
            self._use(parse_model(message.data, self._topic), self._topic)
        except SlpiError as error:
            self._log.error(f"model refused: {error}")
            self._reporter.model_refused(str(error))

    def _use(self, model: StageModel, source: str) -> None:
        """Take a model over, unless it is the one in use: a latched document may come more than once."""
        fingerprint, compensation = model_id(model), self._compensation
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
