"""Hysteresis compensation for piezo stages: identify a model from a bag, simulate it, invert it.

SLPI is the Separated Level-loop Prandtl-Ishlinskii model. The names exported here do not need a running ROS graph.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from slpi_ros.errors import dependencies_needed

if TYPE_CHECKING:
    from slpi_ros.diagnosis.diagnose import diagnose
    from slpi_ros.errors import SlpiError
    from slpi_ros.identification.fit import identify
    from slpi_ros.identification.record_quality import assess, findings
    from slpi_ros.identification.refit import refit
    from slpi_ros.io.bag_reader import read_bag
    from slpi_ros.io.record import Record
    from slpi_ros.learning.learner import Learner
    from slpi_ros.model.axis_model import AxisModel
    from slpi_ros.model.document import load_model, save_model
    from slpi_ros.model.stage_model import HeldAtLimitWarning, StageModel
    from slpi_ros.verification.verify import verify

# Imported at first use: the compensator needs neither the identification nor the diagnosis.
_MODULES = {
    "AxisModel": "model.axis_model",
    "HeldAtLimitWarning": "model.stage_model",
    "Learner": "learning.learner",
    "Record": "io.record",
    "SlpiError": "errors",
    "StageModel": "model.stage_model",
    "assess": "identification.record_quality",
    "diagnose": "diagnosis.diagnose",
    "findings": "identification.record_quality",
    "identify": "identification.fit",
    "load_model": "model.document",
    "read_bag": "io.bag_reader",
    "refit": "identification.refit",
    "save_model": "model.document",
    "verify": "verification.verify",
}

__all__ = [
    "AxisModel",
    "HeldAtLimitWarning",
    "Learner",
    "Record",
    "SlpiError",
    "StageModel",
    "assess",
    "diagnose",
    "findings",
    "identify",
    "load_model",
    "read_bag",
    "refit",
    "save_model",
    "verify",
]


def __getattr__(name: str) -> Any:
    if name == "fleet":
        return import_module(f"{__name__}.fleet")
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    with dependencies_needed():
        found = getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
