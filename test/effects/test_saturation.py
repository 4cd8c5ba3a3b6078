"""Limits of the voltage beyond which the stage stands still, found from the readings."""

from dataclasses import dataclass

import numpy as np
import pytest
from effects.residuals import Residual

from slpi_ros.effects.saturation import Saturation


@dataclass(frozen=True)
class Every(Residual):
    """Of so many readings one is used, as of a sensor that is slower than the record."""

    rows: int = 1

    @property
    def used(self):
        return np.arange(self.t.size) % self.rows == 0


@pytest.mark.parametrize("rows", [1, 2, 7])
def test_a_limit_is_found_from_the_readings_that_are_used(rows):
    t = np.arange(20_000) * 1e-3
    v = 50.0 + 50.0 * np.sin(2.0 * np.pi * 0.37 * t) * np.linspace(0.2, 1.0, t.size)
    y = 1e-7 * np.minimum(v, 90.0) + 1e-9 * np.random.default_rng(rows).standard_normal(t.size)
    found = list(Saturation.fit(Every(t, v, 1e-7 * v, y, rows=rows)))
    assert found and all(one.lower == -np.inf for one in found)
    assert min(abs(one.upper - 90.0) for one in found) < 0.5
