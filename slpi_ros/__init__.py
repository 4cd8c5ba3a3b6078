"""Hysteresis compensation for piezo stages: identify a model from a bag, simulate it, invert it.

SLPI is the Separated Level-loop Prandtl-Ishlinskii model. Nothing here needs a running ROS graph.
"""

import os
from collections.abc import Sequence
from typing import TYPE_CHECKING

from slpi_ros.diagnosis.diagnose import diagnose
from slpi_ros.diagnosis.verify import verify
from slpi_ros.errors import SlpiError
from slpi_ros.identification.fit import identify
from slpi_ros.identification.record_quality import assess, findings
from slpi_ros.identification.refit import refit
from slpi_ros.io.record import Record
from slpi_ros.model.axis_model import AxisModel
from slpi_ros.model.document import load_model, save_model
from slpi_ros.model.stage_model import HeldAtLimitWarning, StageModel

if TYPE_CHECKING:
    from slpi_ros.io.alignment import SeparateTopics

__all__ = [
    "AxisModel",
    "HeldAtLimitWarning",
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


def read_bag(
    path: str | os.PathLike[str], topic: "str | SeparateTopics" = "stage_state", *, axes: Sequence[str] | None = None
) -> Record:
    """Read voltage and displacement of a stage from a bag.

    Parameters
    ----------
    path : path-like
        A rosbag2 folder, or a lone mcap or sqlite3 file.
    topic : str or slpi_ros.io.alignment.SeparateTopics
        A ``sensor_msgs/JointState`` topic with ``position`` in metres and ``effort`` in volts, or a pair of topics.
    axes : sequence of str, optional
        Names of the axes to read; by default every axis of the bag.

    Returns
    -------
    Record
        ``t`` in seconds, shape (N,); ``voltage`` and ``displacement`` per axis, shape (N,), in volts and metres.

    Raises
    ------
    SlpiError
        If the bag cannot be read; the message names the remedy.
    """
    # Imported here so that simulation and compensation do not require rosbags.
    from slpi_ros.io.bag_reader import read_bag as read

    return read(path, topic, axes=axes)
