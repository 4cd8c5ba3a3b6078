"""A trajectory: a path known in advance.

Every point is one command sample, given at its own time. There is no interpolation, neither between points nor from
the present displacement to the first one (in joint_trajectory_controller: interpolation method ``none``): where the
path is farther away than the slew limit allows, the voltage goes there at the slew limit.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slpi_ros.compensator import rejection
from slpi_ros.compensator.deadlines import check_times
from slpi_ros.compensator.rejection import RejectedError, require_names
from slpi_ros.io.joint_state import SECOND_NS

FloatArray = NDArray[np.float64]
TimeArray = NDArray[np.int64]


@dataclass(frozen=True)
class Trajectory:
    """Desired displacements of some axes at given times, as `Trajectory.of` checked them.

    Parameters
    ----------
    names : tuple of str, length K
    time_from_start_ns : ndarray of int64, shape (N,), nanoseconds
        Strictly increasing, N >= 1.
    positions : ndarray, shape (N, K), metres
    start_ns : int, nanoseconds
        0: at once. A clock that counts from the machine's start may have been negative then.
    cut : int
        Number of earlier points left out: their time had passed.
    """

    names: tuple[str, ...]
    time_from_start_ns: TimeArray
    positions: FloatArray
    start_ns: int
    cut: int = 0

    @classmethod
    def of(
        cls,
        names: Sequence[str],
        time_from_start_ns: ArrayLike,
        positions: ArrayLike,
        start_ns: int = 0,
        *,
        axes: Sequence[str],
    ) -> "Trajectory":
        """Return a checked trajectory; arrays are not copied.

        Parameters
        ----------
        names : sequence of str, length K
            Some of `axes`, in any order.
        time_from_start_ns : array_like of int, shape (N,), nanoseconds
        positions : array_like, shape (N, K), metres
        start_ns : int, nanoseconds
        axes : sequence of str
            All there are.

        Raises
        ------
        RejectedError
            If names, shapes, times or positions make no sense; the first bad point is named.
        """
        require_names(names, axes)
        times, places = _as_array(time_from_start_ns), _as_array(positions, np.float64)
        if not times.size:
            raise RejectedError(rejection.EMPTY, "the trajectory has no points; give at least one")
        if times.ndim != 1 or places.shape != (times.size, len(names)):
            what = f"{len(names)} axes, times of shape {times.shape}, positions of shape {places.shape}"
            raise RejectedError(rejection.LENGTH, f"{what}; give each point a time and a number for each axis")
        check_times(times, start_ns)
        finite = np.isfinite(places)
        if not finite.all():
            point, column = (int(i) for i in np.unravel_index(np.argmin(finite), finite.shape))
            what = f"axis '{names[column]}', point {point}: displacement is {places[point, column]} m"
            raise RejectedError(rejection.NOT_FINITE, f"{what}; send finite ones only")
        return cls(tuple(names), times.astype(np.int64, copy=False), places, start_ns)

    def __len__(self) -> int:
        """Return the number of points."""
        return self.time_from_start_ns.size

    def useful_at(self, now_ns: int) -> "Trajectory":
        """Return the part whose time has not passed; all of it if it starts at once.

        Raises
        ------
        RejectedError
            If nothing is left.
        """
        first = int(np.searchsorted(self.time_from_start_ns, now_ns - self.start_ns)) if self.start_ns else 0
        if first == len(self):
            ago = (now_ns - self.start_ns - int(self.time_from_start_ns[-1])) / SECOND_NS
            raise RejectedError(
                rejection.STALE, f"the trajectory ended {ago:.9g} s ago; send it earlier, or stamp it 0"
            )
        times, places = self.time_from_start_ns[first:], self.positions[first:]
        return replace(self, time_from_start_ns=times, positions=places, cut=self.cut + first)

    def deadlines_ns(self, now_ns: int) -> TimeArray:
        """Return when its points are due, shape (N,), nanoseconds, if it is accepted now."""
        return self.time_from_start_ns + (self.start_ns or now_ns)


def _as_array(values: ArrayLike, dtype: type | None = None) -> NDArray[Any]:
    try:
        return np.asarray(values, dtype)
    except (TypeError, ValueError, OverflowError) as error:
        raise RejectedError(rejection.LENGTH, f"the points are no array of numbers: {error}") from None
