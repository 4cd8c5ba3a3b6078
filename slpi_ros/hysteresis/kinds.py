"""The hysteresis models by name: how each is written in a model document and read back."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from slpi_ros.errors import ModelError
from slpi_ros.hysteresis.family import LoopFamily
from slpi_ros.hysteresis.pi import PrandtlIshlinskii

Hysteresis = LoopFamily | PrandtlIshlinskii

DESCRIPTIONS = {
    "slpi": "Separated Level-loop Prandtl-Ishlinskii loop family",
    "pi": "classical Prandtl-Ishlinskii model",
}


def to_document(shape: Hysteresis) -> dict[str, Any]:
    """Return the parameters of a model, SI units, as they stand in a model document."""
    if isinstance(shape, PrandtlIshlinskii):
        return {"thresholds_V": shape.thresholds.tolist(), "weights_m_per_V": shape.weights.tolist()}
    return {
        "grid_V": shape.grid.tolist(),
        "surface_m": [row[: i + 1].tolist() for i, row in enumerate(shape.surface)],
        "first_rise_m": shape.rise.tolist(),
        "edge_gain_m_per_V": shape.edge_gain,
    }


def from_document(kind: str, parameters: Mapping[str, Any]) -> Hysteresis:
    """Build the model of `kind` from the parameters of a valid model document.

    Raises
    ------
    ModelError
        If the kind is not known or the parameters contradict each other.
    """
    if kind == "pi":
        return PrandtlIshlinskii(np.array(parameters["thresholds_V"]), np.array(parameters["weights_m_per_V"]))
    if kind == "slpi":
        grid, rows = np.array(parameters["grid_V"]), parameters["surface_m"]
        if [len(row) for row in rows] != list(range(1, grid.size + 1)):
            raise ModelError(
                f"surface_m: row i must hold i + 1 values, one row for each of the {grid.size} vertices of grid_V"
            )
        surface = np.zeros((grid.size, grid.size))
        for i, row in enumerate(rows):
            surface[i, : i + 1] = row
        return LoopFamily(grid, surface, np.array(parameters["first_rise_m"]), parameters["edge_gain_m_per_V"])
    raise ModelError(f"unknown kind '{kind}'; this version knows {', '.join(DESCRIPTIONS)}")
