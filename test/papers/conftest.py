"""The SLPI paper's studies, which take seconds, computed once for all tests."""

import pytest

from slpi_ros.papers import slpi_exhibits
from slpi_ros.papers.slpi_study import RANDOM_PATH, study


@pytest.fixture(scope="session")
def random():
    """Return the study of the paper's random path."""
    return study(RANDOM_PATH)


@pytest.fixture(scope="session")
def slpi_shown(random):
    """Return all exhibits of the SLPI paper."""
    return slpi_exhibits.exhibits(random)
