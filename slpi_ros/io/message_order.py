"""Order of recorded messages: doubled ones, wrong stamps, messages that came late, a clock that was set back."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from slpi_ros.arrays import IntArray, Mask
from slpi_ros.io.record import first_step_back, order_note

# Times that messages before and after a step back take turns, and steps that are looked at.
_SET_BACK, _MOST_STEPS = 3, 100
# Messages with which a stamp is compared, and share of those that are wrong at most, else nothing is left out.
_BESIDE, _MOST_WRONG = 11, 0.05


def in_order(
    logged: IntArray, stamp: IntArray, columns: Mapping[Any, NDArray[Any]]
) -> tuple[NDArray[np.intp] | None, bool, list[str]]:
    """Return which messages are used, in order (None: all, as they are), whether by their stamps, and what was wrong.

    The times of recording and the stamps (ns) and the values are those of the file's order, of shape (N,). Messages
    that were recorded twice (equal stamp and values), without a stamp beside others that have one, or with a stamp that
    does not go with those around it are left out. What was written late is sorted; where a clock was set back, the
    order of the file is that of time, and is kept.
    """
    stamped = stamp != 0
    first = int(np.argmax(stamped))
    if stamped[first:].all() and 0 < stamp[first] <= _BESIDE * _usual_step(stamp[first:]):
        # A clock that begins at 0.
        stamped[:first] = True
    by_stamp = 2 * int(np.count_nonzero(stamped)) > stamp.size
    time = stamp if by_stamp else logged
    told: list[str] = []
    if (not by_stamp or stamped.all()) and not (np.diff(time) <= 0).any() and not (np.diff(logged) < 0).any():
        return None, by_stamp, told
    rows = np.arange(time.size)
    if by_stamp and not stamped.all():
        rows = rows[stamped]
        told.append(f"{time.size - rows.size} of {time.size} messages have no stamp, others do: they are left out")
    if doubled := int(np.count_nonzero(again := _doubled(time[rows], [column[rows] for column in columns.values()]))):
        rows = rows[~again]
        told.append(f"{doubled} of {time.size} messages were recorded twice: one of each is used")
    if note := order_note(logged[rows]):
        step = _set_back(logged[rows])
        if step is None:
            rows = rows[np.argsort(logged[rows], kind="stable")]
            told.append(note)
    if by_stamp and (np.diff(time[rows]) < 0).any():
        wrong = _wrong(time[rows])
        if 0 < np.count_nonzero(wrong) <= _MOST_WRONG * rows.size:
            told.append(f"{np.count_nonzero(wrong)} of {time.size} messages with a stamp out of order are left out")
            rows = rows[~wrong]
    if (at := first_step_back(time[rows])) is not None:
        by = (int(time[rows[at - 1]]) - int(time[rows[at]]) + _usual_step(time[rows])) * 1e-9
        told.append(
            f"a clock was set back by {by:.4g} s at message {rows[at] + 1} of {time.size}; use the part before it "
            "(--stop), or record again"
        )
    return rows, by_stamp, told


def _usual_step(time: IntArray) -> float:
    """Return the median of the steps between times that differ, in their unit; the first time if there are none."""
    steps = np.abs(np.diff(time))
    return float(np.median(steps[steps > 0])) if steps.any() else float(time[0])


def _doubled(time: IntArray, columns: list[NDArray[Any]]) -> Mask:
    """Return which messages have the time and all values of an earlier one, (N,)."""
    order = np.argsort(time, kind="stable")
    same = np.diff(time[order]) == 0
    for column in columns:
        if not same.any():
            break
        value = column[order]
        same &= (value[1:] == value[:-1]) | (np.isnan(value[1:]) & np.isnan(value[:-1]))
    doubled = np.zeros(time.size, dtype=bool)
    doubled[order[1:]] = same
    return doubled


def _set_back(time: IntArray) -> int | None:
    """Return the message at which time goes back into what was recorded already; None if messages only came late."""
    for at in (np.flatnonzero(np.diff(time) < 0) + 1).tolist()[:_MOST_STEPS]:
        before, after = time[:at], time[at:]
        # What came late leaves no pause that is longer than its own ones; a clock that was set far back does.
        if before.min() - after.max() > max(np.abs(np.diff(part)).max(initial=0) for part in (before, after)):
            return int(at) if min(before.size, after.size) > _SET_BACK else None
        low, high = max(before.min(), after.min()), min(before.max(), after.max())
        within = np.flatnonzero((time >= low) & (time <= high))
        # What came late, in one piece or singly, goes into a gap; after a step of the clock both take turns.
        later = within[np.argsort(time[within], kind="stable")] >= at
        in_turn = np.count_nonzero(np.diff(time[within]) < 0) <= _MOST_WRONG * within.size + 1
        if in_turn and np.count_nonzero(np.diff(later)) >= 2 * _SET_BACK:
            return int(at)
    return None


def _wrong(time: IntArray) -> Mask:
    """Return which stamps do not go with those around them, (N,): single, late, and both of two swapped ones."""
    off = time - median_filter(time, _BESIDE, mode="nearest")
    wrong = np.asarray(np.abs(off) > _BESIDE * max(_usual_step(time), 1.0), dtype=bool)
    good = np.flatnonzero(~wrong)
    rest = time[good]
    if _set_back(rest) is not None:
        return wrong
    late, early = rest < np.maximum.accumulate(rest), rest > np.minimum.accumulate(rest[::-1])[::-1]
    # Of stamps that contradict each other the fewer ones are wrong; of two that are swapped both.
    group = np.cumsum(np.diff(late | early, prepend=False))
    fewer = np.bincount(group, late) - np.bincount(group, early)
    wrong[good[(late & (fewer[group] <= 0.0)) | (early & (fewer[group] >= 0.0))]] = True
    return wrong
