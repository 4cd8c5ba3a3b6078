"""The latest rows of numbers, against a queue."""

from collections import deque

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from slpi_ros.arrays.latest_rows import LatestRows

STEPS = st.lists(st.tuples(st.sampled_from(["append"] * 8 + ["drop", "clear"]), st.integers(0, 5)), max_size=80)


@given(STEPS, st.integers(1, 6), st.integers(0, 3))
def test_they_are_those_of_a_queue(steps, most, fewest):
    rows, queue, now = LatestRows(most, 2), deque(maxlen=most), 0
    for what, number in steps:
        now += number
        if what == "append":
            rows.append(now, -number)
            queue.append((now, -number))
        elif what == "drop":
            rows.drop_before(now - number, fewest)
            while len(queue) > fewest and queue[0][0] < now - number:
                queue.popleft()
        else:
            rows.clear()
            queue.clear()
        assert len(rows) == len(queue)
        np.testing.assert_array_equal(rows.columns, np.array(queue, dtype=float).reshape(-1, 2).T)
