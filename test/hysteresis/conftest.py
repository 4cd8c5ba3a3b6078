"""Paths of these tests are short; the compiled engine evaluates them all the same."""

from collections.abc import Generator

import pytest

from slpi_ros.hysteresis import turning_points


@pytest.fixture(scope="package", autouse=True)
def compiled_engine() -> Generator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(turning_points, "LOADED_FROM", 1)
        patch.setattr(turning_points, "COMPILED_FROM", 1)
        yield
