"""The voltages of a device: limits at the wire, and the rule that the device has what was written."""

import pytest

from slpi_ros.devices.writer import ROUNDING, LoopSettings, Writer
from slpi_ros.drivers.base import Reading
from slpi_ros.model.limits import Limits

MS = 1_000_000


def writer_at(*voltages, offsets=(), slew=500.0):
    axes = ("x", "y")[: len(voltages)]
    made = Writer(LoopSettings(axes, (Limits(0.0, 100.0, slew),) * len(voltages)))
    made.start(voltages, offsets)
    return made


def followed(made, goal, says, cycles=800):
    """Return after how many cycles (1 ms) what is found; `says` makes a report (V) of what was written."""
    for cycle in range(cycles):
        now = 10**12 + cycle * MS
        made.step(goal, now)
        if found := made.compare(Reading(now, says(made.written), made.written), now):
            return cycle, found
    return None, ""


def test_what_follows_is_let_alone_late_or_not():
    made, past = writer_at(20.0, 30.0), []

    def late(written):
        past.append(written)
        return past[max(len(past) - 250, 0)]

    assert followed(made, (90.0, 0.0), late) == (None, "")
    assert made.at((90.0, 0.0)) and not made.at((90.0 + 2 * ROUNDING, 0.0))


def test_a_voltage_that_was_not_written_is_found_after_three_reports_and_a_tenth_of_a_second():
    made = writer_at(20.0, 30.0)
    cycle, found = followed(made, (20.0, 30.0), lambda v: (v[0], 35.0))
    assert cycle == 100 and "axis 'y' is at 35 V, but 30 V was written" in found and "~/arm" in found
    made.start((20.0, 35.0))
    assert followed(made, (20.0, 35.0), lambda v: v) == (None, "")


def test_a_voltage_in_whatever_unit_counts():
    cycle, found = followed(writer_at(20.0), (20.0,), lambda v: (1e9,))
    assert cycle == 100 and "1e+09 V" in found


def test_a_constant_gain_is_no_calibration_here():
    assert "volts" in followed(writer_at(0.0), (60.0,), lambda v: (0.25 * v[0],))[1]


@pytest.mark.parametrize(("offset", "found"), [(5.0, False), (8.0, True)])
def test_an_offset_of_the_opening_is_tolerated_with_two_percent_of_the_range(offset, found):
    made = writer_at(20.0, offsets=(-4.0,))
    assert bool(followed(made, (60.0,), lambda v: (v[0] + offset,))[1]) == found
    made.start((60.0,))
    assert bool(followed(made, (20.0,), lambda v: (v[0] + offset,))[1]) == found


def test_limits_hold_and_are_told_for_a_second():
    made = writer_at(99.9)
    assert made.step((500.0,), 10**12)[0] == 100.0 and made.step((500.0,), 10**12 + MS) is None
    assert made.limited(10**12 + MS) == ("x",) and made.limited(10**12 + 1002 * MS) == ()
    assert writer_at(50.0).step((60.0,), 10**12)[0] <= 50.0 + 500.0 * 2e-3
    free = writer_at(50.0, slew=float("inf"))
    assert free.step((0.0,), 10**12, gently=True)[0] > 49.0
