"""Linear coupling of the axes of a stage."""

from collections.abc import Mapping
from typing import Any, TypeVar

import numpy as np

from slpi_ros.arrays import FloatArray

Motion = TypeVar("Motion", float, FloatArray)


class Coupling:
    """Linear coupling of all axes: the observed motions are ``(I + G) m``, with ``m`` the motions without coupling."""

    # ``gains[x][y]`` is the displacement of x per metre of y; axes that are not in the mapping have no coupling.
    def __init__(self, gains: Mapping[str, Mapping[str, float]]) -> None:
        self._gains = {
            name: {other: gain for other, gain in row.items() if other in gains and other != name and gain}
            for name, row in gains.items()
        }
        self.on = any(self._gains.values())
        self._solutions: dict[tuple[str, ...], list[list[float]]] = {}

    def part(self, name: str, motions: Mapping[str, Motion]) -> Motion | float:
        """Return the displacement (m) of axis `name` caused by the own motions of the others, 0 for missing axes."""
        part: Motion | float = 0.0
        for other, gain in self._gains[name].items():
            if other in motions:
                part = part + gain * motions[other]
        return part

    def parts(self, seen: Mapping[str, Motion], resting: Mapping[str, Any]) -> dict[str, Motion | float]:
        """Return the displacement (m) of each axis that the others cause; arguments as in `decouple`."""
        motions: dict[str, Any] = {**(self.decouple(seen, resting) if seen else {}), **resting}
        return {name: self.part(name, motions) for name in self._gains}

    def decouple(self, seen: Mapping[str, Motion], resting: Mapping[str, Any]) -> dict[str, Motion]:
        """Return the own motions (m) that produce the observed ones, with `resting` those of held axes."""
        left = {name: motion - self.part(name, resting) for name, motion in seen.items()}
        rows = self._solution(tuple(seen))
        own = {}
        for name, row in zip(seen, rows, strict=True):
            # Not `sum`, which rounds numbers otherwise than arrays.
            motion: Any = 0.0
            for share, each in zip(row, left.values(), strict=True):
                motion = motion + share * each
            own[name] = motion
        return own

    def _solution(self, names: tuple[str, ...]) -> list[list[float]]:
        if names not in self._solutions:
            matrix = [[float(one == other) + self._gains[one].get(other, 0.0) for other in names] for one in names]
            self._solutions[names] = np.linalg.inv(np.array(matrix)).tolist()
        return self._solutions[names]
