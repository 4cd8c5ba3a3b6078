"""The uncertainty of a model as text, and as part of a document: over time and over range, and its budget."""

from collections.abc import Mapping
from dataclasses import fields
from math import sqrt
from typing import Any

from slpi_ros.errors import SlpiError, length
from slpi_ros.model.axis_model import AxisModel
from slpi_ros.model.uncertainty import COMPONENTS, COVERAGE_FACTOR, AxisUncertainty, Budget
from slpi_ros.model.unknown_memory import UnknownMemory

# Times since the reset or calibration, seconds, and places in the displacement range, shares.
TIMES = {"1 s": 1.0, "1 min": 60.0, "1 h": 3600.0}
PLACES = (0.0, 0.25, 0.5, 0.75, 1.0)
MIDDLE = 0.5
RESET = f"expanded uncertainty (k = {COVERAGE_FACTOR:g}) after a reset"


def describe_uncertainty(axis: AxisModel, *, details: bool = True) -> list[str]:
    """Return the uncertainty of an axis as lines of text, in `details` with tables in nm; or why it is not known."""
    try:
        own = AxisUncertainty(axis, known_memory=True)
    except SlpiError as error:
        return [f"uncertainty: not known: {error}"]
    known = {one.key: one.reference for one in axis.followed}
    told = [
        f"{length(float(_at(own, MIDDLE, seconds, known).expanded[0]))} after {name}" for name, seconds in TIMES.items()
    ]
    lines = [f"{RESET}, at the middle of the range: {', '.join(told)}"]
    if unknown := unknown_memory(axis):
        lines.append(
            f"without a reset: besides, standard uncertainty {length(unknown)} at first, until the voltage has gone "
            "over its range"
        )
    if known:
        (without,) = _at(own, MIDDLE, TIMES["1 s"]).surroundings
        lines.append(
            f"while {' and '.join(known)} {'is' if len(known) == 1 else 'are'} not known: besides, standard "
            f"uncertainty {length(float(without))}"
        )
    if not details:
        return lines
    lines.append(f"{RESET}, nm:")
    lines.append(f"{'displacement, µm':<28}" + "".join(f"{name:>10}" for name in TIMES))
    for share in PLACES:
        y = own.low + share * own.stroke
        figures = [float(own.at(y, seconds, known).expanded[0]) for seconds in TIMES.values()]
        lines.append(f"{y * 1e6:<28.4g}" + "".join(f"{1e9 * each:10.1f}" for each in figures))
    lines.append("budget at the middle of the range, standard uncertainty, nm:")
    budgets = [_at(own, MIDDLE, seconds, known) for seconds in TIMES.values()]
    for name, what in (*COMPONENTS.items(), ("combined", "root of the sum of squares"), ("expanded", "coverage 2")):
        row = "".join(f"{1e9 * float(getattr(each, name)[0]):10.1f}" for each in budgets)
        lines.append(f"{name:<28}{row}  {what}")
    return lines


def unknown_memory(axis: AxisModel) -> float:
    """Return the standard uncertainty (m) from a memory that is not known, before anything moves."""
    unknown = UnknownMemory(axis, "end", axis.felt_range)
    return sqrt(unknown.step(0.0, unknown.start))


def uncertainty_document(axis: AxisModel, known: Mapping[str, float]) -> dict[str, Any]:
    """Return the uncertainty of an axis as part of a certificate; ModelError if it is not known.

    `known` are values of quantities that the stage follows, by name, in their units.
    """
    own = AxisUncertainty(axis, known_memory=True)
    (unknown,) = _at(own, MIDDLE, TIMES["1 s"]).surroundings
    return {
        "coverage_factor": COVERAGE_FACTOR,
        "unknown_memory_m": unknown_memory(axis),
        "quantities": [{"name": one.key, "value": known.get(one.key)} for one in axis.followed],
        "unknown_quantities_m": float(unknown),
        "budget": [
            {
                "time_s": seconds,
                "displacement_m": own.low + share * own.stroke,
                **_figures(_at(own, share, seconds, known)),
            }
            for seconds in TIMES.values()
            for share in PLACES
        ],
    }


def _at(own: AxisUncertainty, share: float, seconds: float, known: Mapping[str, float] | None = None) -> Budget:
    return own.at(own.low + share * own.stroke, seconds, known)


def _figures(budget: Budget) -> dict[str, float]:
    """Return all figures (m) of a budget at one place."""
    names = [*(part.name for part in fields(budget)), "combined", "expanded"]
    return {f"{name}_m": float(getattr(budget, name)[0]) for name in names}
