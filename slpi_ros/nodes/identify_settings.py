"""What the identify node is told by its parameters."""

import math
import os
from dataclasses import dataclass

from slpi_ros.errors import UsageError
from slpi_ros.identification.fit import KINDS
from slpi_ros.io.bag_watch import BagWatch
from slpi_ros.nodes.fit_process import FitRequest
from slpi_ros.nodes.parameters import Declaration, Values, choice, number

REPORT_PERIOD = (0.05, 3600.0)

DECLARATIONS = (
    Declaration(
        "bags", [""],
        "Bags to identify in one fit: rosbag2 folders, or lone mcap or db3 files. Setting a parameter later identifies "
        "anew.",
    ),
    Declaration(
        "watch_directory", "",
        "Folder: every bag completed there is identified too, the newest one there at once, unless it is of another "
        "stage than the published model; empty: none.",
    ),
    Declaration("topic", "stage_state", "Topic of the bag that holds voltage and displacement."),
    Declaration("kind", "slpi", f"Kind of hysteresis model: {', '.join(KINDS)}."),
    Declaration("output", "", "File to write the model to as well; empty: none."),
    Declaration(
        "start", math.nan, "Fit from here on, seconds from the bag's first stamp; NaN or negative: from the first.",
        number=True,
    ),
    Declaration(
        "stop", math.nan, "Fit up to here, seconds from the bag's first stamp; NaN or negative: to the last.",
        number=True,
    ),
    Declaration(
        "diagnosis_directory", "",
        "Folder that ~/diagnose writes into; empty: the folder NAME_diagnosis beside the output NAME.json, without an "
        "output a temporary one, which the answer names.",
    ),
    Declaration(
        "diagnostic_period", 1.0, "Seconds between two reports on /diagnostics.",
        read_only=True, between=REPORT_PERIOD, number=True,
    ),
)  # fmt: skip


@dataclass(frozen=True)
class IdentifySettings:
    """What the node is told by its parameters.

    Parameters
    ----------
    request : FitRequest
        What to identify; without bags, what to identify those of the watched folder like.
    watch_directory : str
        "": none.
    diagnosis_directory : str
        "": a temporary one.
    diagnostic_period : float, seconds
    """

    request: FitRequest
    watch_directory: str
    diagnosis_directory: str
    diagnostic_period: float

    @classmethod
    def of(cls, values: Values) -> "IdentifySettings":
        """Make the settings of all parameters by name.

        Raises
        ------
        UsageError
            If a value makes no sense.
        """
        bags = tuple(bag for bag in values["bags"] if bag)
        if not values["topic"]:
            raise UsageError("parameter topic is empty; name the topic of the bag, as in stage_state")
        kind = choice(values, "kind", KINDS)
        start, stop = bound(values, "start"), bound(values, "stop")
        if start is not None and stop is not None and not start < stop:
            raise UsageError(f"parameter start is {start:g} s and stop {stop:g} s; start before you stop")
        request = FitRequest(bags, values["topic"], kind, start, stop, values["output"])
        folder = values["watch_directory"]
        if folder:
            BagWatch(folder)
        diagnosis = values["diagnosis_directory"] or beside(request.output)
        return cls(request, folder, diagnosis, number(values, "diagnostic_period", *REPORT_PERIOD))


def beside(output: str) -> str:
    """Return the folder beside the file of a model that its diagnosis goes to; "" for no file."""
    return f"{os.path.splitext(output)[0]}_diagnosis" if output else ""


def bound(values: Values, name: str) -> float | None:
    """Return a time of the record, seconds; None where NaN or a negative number says that there is none."""
    given = values[name]
    if isinstance(given, float) and math.isnan(given):
        return None
    seconds = number(values, name, -math.inf, math.inf)
    return seconds if seconds >= 0 else None
