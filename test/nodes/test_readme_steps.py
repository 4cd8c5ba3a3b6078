"""README's way from a stage to its compensation, with the commands copied from the page."""

import numpy as np
import pytest

rclpy = pytest.importorskip("rclpy")

from benchmarks.readme_steps import Readme, as_written, next_day, readme_commands  # noqa: E402

# % of stroke.
ALLOWED = 0.1
# The only warning: of the reset that was asked for.
RESET = "reset_memory moves the stage"


@pytest.fixture
def user(tmp_path, installed):
    """Return somebody who has nothing but README and an installed package."""
    installed("compensator")
    rclpy.init()
    user = Readme(tmp_path)
    try:
        yield user
    finally:
        user.close()
        rclpy.shutdown()


def test_the_page_has_each_step_once():
    programs = ["stage_simulator", "recorder", "exciter", "compensator"]
    for words in [*(f"ros2 run slpi_ros {name}" for name in programs), "slpi identify", "ros2 topic pub"]:
        assert sum(command.startswith(words) for command in readme_commands()) == 1


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.parametrize("days", [1, 2])
def test_readme_leads_to_the_set_points_and_so_does_a_restart_on_the_next_day(user, days):
    model, errors, warnings = as_written(user, seed=2)
    assert model.hardware_id == "simulated-2"
    assert np.abs(errors).max() <= ALLOWED
    assert all(RESET in line for line in warnings)
    if days == 1:
        return
    errors, warnings = next_day(user, 2, model)
    assert np.abs(errors).max() <= ALLOWED
    assert all(RESET in line for line in warnings)
