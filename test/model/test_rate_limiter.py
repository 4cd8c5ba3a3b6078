"""The rate limiter by itself: how much time counts, and where a voltage may go from outside its limits."""

import pytest

from slpi_ros.model.limits import MAX_DT, Limits, RateLimiter


@pytest.mark.parametrize(("elapsed", "counted"), [(-1.0, 0.0), (-1e-9, 0.0), (0.0, 0.0), (0.03, 0.03), (9.0, MAX_DT)])
def test_time_counts_from_zero_to_the_longest_step(elapsed, counted):
    assert RateLimiter(Limits(0.0, 100.0, 20.0)).clamp_dt(elapsed) == counted


@pytest.mark.parametrize(("present", "expected"), [
    # Within: down and up by the slew, clamped at the limits.
    (50.0, (48.0, 52.0)), (1.0, (0.0, 3.0)), (99.0, (97.0, 100.0)),
    # Outside: inside at the full rate, and not beyond the limit on the other side.
    (-5.0, (-3.0, -3.0)), (105.0, (103.0, 103.0)), (-1.0, (0.0, 1.0)), (101.0, (99.0, 100.0)),
])  # fmt: skip
def test_the_reach_is_clamped_to_the_limits(present, expected):
    limiter = RateLimiter(Limits(0.0, 100.0, 20.0))
    assert limiter.reach(present, 0.1) == pytest.approx(expected)
    assert limiter.step(present, -1e3, 0.1) == pytest.approx(expected[0])
    assert limiter.step(present, 1e3, 0.1) == pytest.approx(expected[1])


def test_without_a_rate_limit_the_limits_alone_count():
    assert RateLimiter(Limits(-3.0, 7.0)).reach(50.0, 0.1) == (-3.0, 7.0)
