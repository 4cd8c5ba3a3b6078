"""What a record says about one axis."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from slpi_ros.identification.bases import Basis, SurfaceBasis
from slpi_ros.identification.least_squares import Problem
from slpi_ros.identification.samples import Samples

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Evidence:
    """What a record says about one axis.

    Parameters
    ----------
    t : ndarray, shape (N,), seconds
        From the first stamp.
    v : ndarray, shape (N,), volts
        As commanded or read.
    y : ndarray, shape (N,), metres
    used : ndarray of bool, shape (N,)
        Samples that are explained; the others (outliers, drop-outs, what came before the memory was known) only move
        the memory.
    history : tuple of float, volts
        As in `slpi_ros.model.stage_model.Start`.
    basis : Basis
        Of the hysteresis.
    smoothness : float
    others : mapping of axis name to ndarray, shape (N,), metres
        How far the other axes of the record have moved since its start.
    beside : ndarray, shape (N, k), metres
        Columns that stand beside the hysteresis, whatever their gains.
    seen : ndarray of bool, shape (N,), optional
        Samples whose displacement is known and asked for: those used by default.
    """

    t: FloatArray
    v: FloatArray
    y: FloatArray
    used: NDArray[np.bool_]
    history: tuple[float, ...]
    basis: Basis
    smoothness: float
    others: Mapping[str, FloatArray] = field(default_factory=dict)
    beside: FloatArray = field(default_factory=lambda: np.empty((0, 0)))
    seen: NDArray[np.bool_] = field(default_factory=lambda: np.empty(0, dtype=bool))

    def __post_init__(self) -> None:
        """Give `beside` its rows, and `seen` what is used."""
        if not self.seen.size:
            object.__setattr__(self, "seen", self.used)
        if not self.beside.size:
            object.__setattr__(self, "beside", np.empty((self.t.size, 0)))

    @property
    def lead(self) -> int:
        """Number of voltages before the record's first."""
        return len(self.history)

    def problem(self, u: FloatArray) -> Problem:
        """Pose the problem of the hysteresis driven by `u`, shape (N,), volts."""
        low, high = self.basis.grid[[0, -1]] if isinstance(self.basis, SurfaceBasis) else (-np.inf, np.inf)
        return Problem.pose([Samples(np.clip(u, low, high), self.y, self.used).after(self.history)], self.basis)
