"""Weighted least squares by harmonic: real parameters from the spectra of several passes."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from slpi_ros.arrays import FloatArray
from slpi_ros.learning.harmonics import ComplexArray

# Iterations of the weights, and harmonics on either side that tell how much an estimate leaves unexplained.
REWEIGHTED, NEARBY = 2, 4


@dataclass(frozen=True)
class Row:
    """What the parameters explain of a pass: ``explained = columns @ parameters``, by harmonic."""

    columns: ComplexArray  # (K, P)
    explained: ComplexArray  # m, (K,)
    variance: FloatArray  # m^2, (K,), of the rest
    now: int | None  # number of the pass
    before: int | None  # and of that whose reading is subtracted; None: the desired path itself


def solved(rows: Sequence[Row], prior: tuple[FloatArray, FloatArray]) -> tuple[list[Row], FloatArray, FloatArray]:
    """Return the rows, the least-squares parameters, (P,), and their covariance, (P, P).

    The variance of a row is taken to be larger where more is left nearby.
    """
    found = list(rows)
    for turn in range(REWEIGHTED + 1):
        information, vector = prior
        for row in found:
            more, moved = normal(row.columns[1:], row.explained[1:], 1.0 / np.maximum(row.variance[1:], 1e-300))
            information, vector = information + more, vector + moved
        scale = 1.0 / np.sqrt(np.diag(information))
        scales = np.outer(scale, scale)
        covariance = np.linalg.inv(information * scales) * scales
        parameters = covariance @ vector
        if turn < REWEIGHTED:
            left = [_nearby(np.abs(row.explained - row.columns @ parameters) ** 2) for row in rows]
            found = [replace(row, variance=np.maximum(row.variance, x)) for row, x in zip(rows, left, strict=True)]
    return found, parameters, covariance


def normal(a: ComplexArray, y: ComplexArray, weight: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return matrix and vector of the normal equations of real parameters: ``y = a p``, weighted by row."""
    weighted = (a.conj() * weight[:, None]).T
    return (weighted @ a).real, (weighted @ y).real


def variance_of(a: ComplexArray, covariance: FloatArray) -> FloatArray:
    """Return the variance, (K,), of ``a p``, (K, P) and (P,), with the covariance of p."""
    return np.asarray(np.maximum(np.sum((a.conj() @ covariance) * a, axis=1).real, 0.0))


def _nearby(power: FloatArray) -> FloatArray:
    window = np.ones(min(2 * NEARBY + 1, power.size))
    near: FloatArray = np.convolve(power, window, "same") / np.convolve(np.ones(power.size), window, "same")
    return near
