"""Registry of the hysteresis models by kind, and conversion of their parameters to and from documents."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from slpi_ros.errors import ModelError
from slpi_ros.hysteresis.loop_family import LoopFamily
from slpi_ros.hysteresis.multi_slope import AmplitudeScaled, MultiSlope
from slpi_ros.hysteresis.prandtl_ishlinskii import PrandtlIshlinskii
from slpi_ros.hysteresis.slpi_published import SeparatedLoops, SingleLoop

# Causal models define shapes for the engine; path models require the whole path in advance.
CausalModel = LoopFamily | PrandtlIshlinskii | MultiSlope
PathModel = SeparatedLoops | AmplitudeScaled
Hysteresis = CausalModel | PathModel

DESCRIPTIONS = {
    "slpi": "Separated Level-loop Prandtl-Ishlinskii loop family",
    "slpi-published": "Separated Level-loop Prandtl-Ishlinskii model as published, one model for each loop",
    "pi": "classical Prandtl-Ishlinskii model",
    "mpi": "multi-slope Prandtl-Ishlinskii model",
    "smpi": "simplified multi-slope Prandtl-Ishlinskii model, scaled with the amplitude",
}


def to_document(model: Hysteresis) -> dict[str, Any]:
    """Return the parameters of a model in SI units for a model document."""
    match model:
        case PrandtlIshlinskii():
            return _plays_document(model)
        case LoopFamily():
            return {
                "grid_V": model.grid.tolist(),
                "surface_m": [row[: i + 1].tolist() for i, row in enumerate(model.everett)],
                "first_rise_m": model.rise.tolist(),
                "edge_gain_m_per_V": model.edge_gain,
            }
        case SeparatedLoops():
            return {"dead_band_V": model.dead_band, "loops": [_loop_document(loop) for loop in model.loops]}
        case MultiSlope():
            return {
                "origin_V": model.origin,
                "amplitude_V": model.amplitude,
                "thresholds_V": model.thresholds.tolist(),
                "weights_m_per_V": model.weights.tolist(),
            }
        case AmplitudeScaled():
            return to_document(model.base) | {
                "peak_voltages_V": model.peak_voltages.tolist(),
                "peak_displacements_m": model.peak_displacements.tolist(),
            }


def from_document(kind: str, parameters: Mapping[str, Any]) -> Hysteresis:
    """Return the model of validated `parameters`; ModelError if they are inconsistent or the kind is unknown."""
    match kind:
        case "slpi":
            return _family_from(parameters)
        case "slpi-published":
            return SeparatedLoops(tuple(_loop_from(loop) for loop in parameters["loops"]), parameters["dead_band_V"])
        case "pi":
            return _plays_from(parameters)
        case "mpi":
            return _multi_slope_from(parameters)
        case "smpi":
            peaks = (np.array(parameters[key]) for key in ("peak_voltages_V", "peak_displacements_m"))
            return AmplitudeScaled(_multi_slope_from(parameters), *peaks)
    raise ModelError(f"unknown kind '{kind}'; this version knows {', '.join(DESCRIPTIONS)}")


def _plays_document(model: PrandtlIshlinskii) -> dict[str, Any]:
    return {"thresholds_V": model.thresholds.tolist(), "weights_m_per_V": model.weights.tolist()}


def _plays_from(parameters: Mapping[str, Any]) -> PrandtlIshlinskii:
    return PrandtlIshlinskii(np.array(parameters["thresholds_V"]), np.array(parameters["weights_m_per_V"]))


def _family_from(parameters: Mapping[str, Any]) -> LoopFamily:
    grid, rows = np.array(parameters["grid_V"]), parameters["surface_m"]
    if [len(row) for row in rows] != list(range(1, grid.size + 1)):
        raise ModelError(
            f"surface_m: row i must hold i + 1 values, one row for each of the {grid.size} vertices of grid_V"
        )
    everett = np.zeros((grid.size, grid.size))
    for i, row in enumerate(rows):
        everett[i, : i + 1] = row
    return LoopFamily(grid, everett, np.array(parameters["first_rise_m"]), parameters["edge_gain_m_per_V"])


def _multi_slope_from(parameters: Mapping[str, Any]) -> MultiSlope:
    thresholds, weights = (np.array(parameters[key]) for key in ("thresholds_V", "weights_m_per_V"))
    return MultiSlope(parameters["origin_V"], parameters["amplitude_V"], thresholds, weights)


def _loop_document(loop: SingleLoop) -> dict[str, Any]:
    return {
        "level": loop.level,
        "direction": loop.direction,
        "vertex_V": loop.vertex[0],
        "vertex_m": loop.vertex[1],
        "span_V": loop.span[0],
        "span_m": loop.span[1],
        "offset_V": loop.offset[0],
        "offset_m": loop.offset[1],
        "run_in_V": loop.run_in,
        **_plays_document(loop.model),
    }


def _loop_from(loop: Mapping[str, Any]) -> SingleLoop:
    return SingleLoop(
        level=loop["level"],
        direction=loop["direction"],
        vertex=(float(loop["vertex_V"]), float(loop["vertex_m"])),
        span=(float(loop["span_V"]), float(loop["span_m"])),
        offset=(float(loop["offset_V"]), float(loop["offset_m"])),
        model=_plays_from(loop),
        run_in=loop["run_in_V"],
    )
