"""The error figures of the papers."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from slpi_ros.errors import UsageError


@dataclass(frozen=True)
class ErrorMetrics:
    """How far a model, or a stage, is from what it should be.

    The MPI paper's "mean square error" is `root_mean_square` in all places: Tables 2 and 4, 0.1201 µm (feedforward) and
    0.2949 µm (feedforward and PID). Its unit is µm, and it exceeds the mean absolute error as a root must. A mean
    square cannot exceed the product of maximum and mean absolute error; Table 2 from 20 to 100 V, Table 4 at 20 and
    40 V and the 0.1201 do. Of the others, R² of 0.9996 at 120 V (Table 3) goes with the root only.

    Parameters
    ----------
    maximum : float, metres
        Maximum absolute error.
    mean : float, metres
        Mean absolute error.
    root_mean_square : float, metres
        What the paper calls mean square error.
    mean_square : float, square metres
        Mean square error proper.
    r_squared : float
        ``R² = 1 - SSE / SST``, MPI paper, Eq. 3.
    """

    maximum: float
    mean: float
    root_mean_square: float
    mean_square: float
    r_squared: float


def error_metrics(measured: ArrayLike, model: ArrayLike) -> ErrorMetrics:
    """Compare a model with what was measured, or what was measured with what was desired.

    Parameters
    ----------
    measured : array_like, shape (N,), metres
        The reference; R² is relative to its variation.
    model : array_like, shape (N,), metres

    Raises
    ------
    UsageError
        If the two are not equally long, not finite, or `measured` does not vary.
    """
    y, y_model = np.asarray(measured, dtype=np.float64), np.asarray(model, dtype=np.float64)
    if y.ndim != 1 or y.shape != y_model.shape or y.size == 0:
        raise UsageError(f"error metrics: {y.shape} measured and {y_model.shape} modelled values; give as many of each")
    if not (np.isfinite(y).all() and np.isfinite(y_model).all()):
        raise UsageError("error metrics: values that are not finite; leave such samples out")
    total = np.sum((y - y.mean()) ** 2)
    if not total > 0.0:
        raise UsageError(f"error metrics: all measured values are {y[0]:g} m; R² needs some variation")
    error = np.abs(y - y_model)
    mean_square = float(np.mean(error**2))
    return ErrorMetrics(
        maximum=float(error.max()),
        mean=float(error.mean()),
        root_mean_square=float(np.sqrt(mean_square)),
        mean_square=mean_square,
        r_squared=float(1.0 - np.sum(error**2) / total),
    )
