"""What stamps mean: in order, late, of a clock that was set, or none."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from slpi_ros.compensator.samples import Samples
from slpi_ros.compensator.validation import DUPLICATE, TIME_BACKWARDS, RejectedError
from slpi_ros.io.messages import SECOND_NS

# Beyond what floats hold to the nanosecond.
NOW = 1_700_000_000_123_456_789
JUMP = SECOND_NS


def verdict(stamps: Samples, stamp_ns: int) -> str | float | None:
    """Return why a stamp is rejected, or the seconds since the one before."""
    try:
        stamps.check(stamp_ns)
    except RejectedError as error:
        assert "\n" not in str(error)
        return error.cause
    return stamps.accept(stamp_ns)


@pytest.mark.parametrize(("step_ns", "expected"), [
    (1, 1e-9), (1_000_000, 1e-3), (5 * SECOND_NS, 5.0), (0, DUPLICATE), (-1, TIME_BACKWARDS), (-JUMP, TIME_BACKWARDS),
    (-JUMP - 1, -1.000000001), (-NOW, -NOW * 1e-9),
])  # fmt: skip
def test_what_a_step_means(step_ns, expected):
    stamps = Samples()
    assert verdict(stamps, NOW) == 0.0
    assert verdict(stamps, NOW + step_ns) == expected
    if isinstance(expected, str):
        assert verdict(stamps, NOW + 1) == 1e-9, "what is rejected leaves no trace"


def test_one_stamp_of_the_far_future_does_not_silence_the_axis():
    stamps = Samples()
    found = [verdict(stamps, NOW + i * 1_000_000 + (10**15 if i == 2 else 0)) for i in range(6)]
    assert found[2] > 1e5 and found[3] < -1e5
    assert found[:2] + found[4:] == [0.0, 1e-3, 1e-3, 1e-3]


@given(st.lists(st.integers(-3 * JUMP, 3 * JUMP), max_size=60))
def test_whatever_comes_time_goes_on(steps):
    """After any stamps whatever, an orderly sender is heard again: at once, or after `time_jump` at the latest."""
    stamps, now = Samples(), NOW
    for step in steps:
        now += step
        verdict(stamps, now)
    heard = [verdict(stamps, now + i * SECOND_NS // 10) for i in range(1, 41)]
    assert heard[-20:] == [pytest.approx(0.1)] * 20


def test_after_a_restart_no_time_counts_by_stamps_but_old_ones_stay_late():
    """The axis has moved meanwhile: the time since its last step is that of the steady clock."""
    stamps = Samples()
    verdict(stamps, NOW)
    stamps.restart()
    assert verdict(stamps, NOW) == DUPLICATE
    assert verdict(stamps, NOW + 3 * SECOND_NS) is None
    assert verdict(stamps, NOW + 4 * SECOND_NS) == 1.0
    stamps.restart()
    assert verdict(stamps, NOW + 2 * SECOND_NS) is None, "a clock that was set back"
    assert verdict(stamps, NOW + 3 * SECOND_NS) == 1.0


def test_a_restart_before_the_first_stamp_is_none():
    stamps = Samples()
    stamps.restart()
    assert [verdict(stamps, NOW + i * SECOND_NS) for i in range(3)] == [0.0, 1.0, 1.0]


def test_what_has_no_stamp_is_never_late():
    stamps = Samples()
    arrivals = [NOW, NOW, NOW - 1, NOW - JUMP, NOW + 5, NOW - 2 * JUMP, NOW - 2 * JUMP + 7]
    assert [stamps.arrive(now) for now in arrivals] == pytest.approx([0.0, 0.0, 0.0, 0.0, 5e-9, -2.0, 7e-9])
