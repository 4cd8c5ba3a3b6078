"""Axes that move along with each other, taken apart."""

from collections.abc import Mapping
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
Motion = TypeVar("Motion", float, FloatArray)


class Coupling:
    """What each axis takes from the own motion of the others: ``(I + G) m`` are the motions to be seen.

    Parameters
    ----------
    gains : mapping of axis name to mapping of axis name to float
        ``gains[x][y]``: metres that x moves for one metre of y. Axes that are none of the mapping's rest.

    Attributes
    ----------
    on : bool
        Whether any axis takes anything.
    """

    def __init__(self, gains: Mapping[str, Mapping[str, float]]) -> None:
        self._gains = {
            name: {other: gain for other, gain in row.items() if other in gains and other != name and gain}
            for name, row in gains.items()
        }
        self.on = any(self._gains.values())
        self._solutions: dict[tuple[str, ...], list[list[float]]] = {}

    def part(self, name: str, motions: Mapping[str, Motion]) -> Motion | float:
        """Return what an axis takes from the others' own motions, metres; an axis that is not given rests."""
        return sum((gain * motions[other] for other, gain in self._gains[name].items() if other in motions), 0.0)

    def apart(self, seen: Mapping[str, Motion], resting: Mapping[str, Motion]) -> dict[str, Motion]:
        """Return the own motions that add up to the ones to be seen.

        Parameters
        ----------
        seen : mapping of axis name to float or ndarray, shape (N,), metres
            Wanted motions from the start.
        resting : mapping of axis name to float or ndarray, shape (N,), metres
            Own motions of axes that stay where they are.
        """
        left = {name: motion - self.part(name, resting) for name, motion in seen.items()}
        rows = self._solution(tuple(seen))
        return {
            name: sum(share * motion for share, motion in zip(row, left.values(), strict=True))  # type: ignore[misc]
            for name, row in zip(seen, rows, strict=True)
        }

    def _solution(self, names: tuple[str, ...]) -> list[list[float]]:
        if names not in self._solutions:
            matrix = [[float(one == other) + self._gains[one].get(other, 0.0) for other in names] for one in names]
            self._solutions[names] = np.linalg.inv(np.array(matrix)).tolist()
        return self._solutions[names]
