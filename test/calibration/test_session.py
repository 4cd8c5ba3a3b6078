"""Which records of a calibration are of one session."""

import numpy as np
import pytest

from slpi_ros.calibration.drives import LONGEST_PAUSE
from slpi_ros.calibration.session import Session
from slpi_ros.io.record import Record


def record(name, begin):
    return Record(
        np.round((begin + np.arange(3.0)) * 1e9).astype(np.int64), {"x": np.zeros(3)}, {"x": np.zeros(3)}, name
    )


@pytest.mark.parametrize(
    ("begins", "kept", "known"),
    [
        ((0.0, 10.0, 20.0), (False, False, False), ["a", "b"]),
        ((0.0, 10.0, 20.0), (True, True, True), ["a", "b"]),
        ((0.0, 10.0, 20.0), (True, True, False), []),
        ((0.0, 10.0, 20.0), (True, False, False), ["b"]),
        ((0.0, 10.0, 12.0 + 0.99 * LONGEST_PAUSE), (False, False, False), ["a", "b"]),
        ((0.0, 10.0, 12.0 + 1.01 * LONGEST_PAUSE), (False, False, False), ["a", "b"]),
        ((0.0, 10.0, 12.0 + 0.99 * LONGEST_PAUSE), (True, True, True), ["a", "b"]),
        ((0.0, 10.0, 12.0 + 1.01 * LONGEST_PAUSE), (True, True, True), []),
        # A clock that was set back.
        ((20.0, 30.0, 10.0), (False, False, False), []),
    ],
)
def test_a_record_knows_those_of_its_session(begins, kept, known):
    session, followed = Session(), None
    for name, begin, own in zip("abc", begins, kept, strict=True):
        followed = session.following(record(name, begin), kept=own)
    assert [each.source for each in followed.before] == known
    assert followed.source == "c"
