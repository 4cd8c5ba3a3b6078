"""When the cycles of a driver begin, by the clock of the test."""

from bisect import bisect

import numpy as np
import pytest

from slpi_ros.devices.pace import CATCH_UP, SLACK, Pace

PERIOD = 1_000_000
END = 1000 * PERIOD


def cycles(commands, end=END, took=300_000):
    """Return when cycles begin with commands at these times; each takes so long (all ns)."""
    pace, now, begun, coming = Pace(PERIOD, 0), 0, [], [*map(int, commands), end]
    place = 0  # of the first command that no cycle has taken
    while now < end:
        if coming[place] <= now:
            # What came during a cycle is noticed after it.
            pace.note_command(now)
        if now < pace.due_ns:
            place = bisect(coming, now)
            now = min(pace.due_ns, coming[place])
            continue
        begun.append(now)
        place = bisect(coming, now)
        pace.begin(now)
        now += took
        pace.leave_out(now)
    return np.array(begun)


def delays(commands, begun):
    """Return how long each command waits for a cycle (ns)."""
    return begun[np.searchsorted(begun, commands).clip(max=begun.size - 1)] - commands


def test_without_commands_they_are_a_period_apart():
    assert set(np.diff(cycles([]))) == {PERIOD}


@pytest.mark.parametrize("every", [1.0, 1.0 + 0.9 * SLACK, 2.0, 5.0, 10.0])
def test_commands_that_come_steadily_are_taken_at_once(every):
    commands = np.round(0.63 * PERIOD + np.arange(10, 900 / every) * every * PERIOD).astype(int)
    begun = cycles(commands)
    # The first ones find the cycles out of step.
    assert delays(commands[20:], begun).max() == 0
    assert np.diff(begun).max() <= (1.0 + SLACK) * PERIOD
    assert begun.size <= END / PERIOD / (1.0 - CATCH_UP)


@pytest.mark.parametrize("every", [1.0, 2.0, 10.0])
def test_commands_that_vary_a_little_are_taken_soon(every):
    rng = np.random.default_rng(1)
    times = np.arange(10, 900 / every) * every + 0.63 + rng.uniform(0.0, 0.5 * SLACK, round(900 / every) - 10)
    commands = np.round(times * PERIOD).astype(int)
    waits = delays(commands[20:], cycles(commands))
    # Else half a period on average, and up to a whole one.
    assert waits.mean() < 0.1 * PERIOD and waits.max() <= 0.5 * SLACK * PERIOD + 1


@pytest.mark.parametrize("every", [0.01, 0.3, 0.7, 0.95])
def test_commands_that_come_more_often_make_hardly_more_cycles(every):
    begun = cycles(np.round(np.arange(0, 1000 / every) * every * PERIOD).astype(int))
    assert begun.size <= END / PERIOD / (1.0 - CATCH_UP) + 2
    assert np.diff(begun).min() >= (1.0 - SLACK) * PERIOD - 1


def test_cycles_that_take_too_long_are_left_out():
    pace = Pace(PERIOD, 0)
    pace.begin(0)
    assert pace.leave_out(5 * PERIOD + 1) == 4
    assert pace.due_ns == 5 * PERIOD
