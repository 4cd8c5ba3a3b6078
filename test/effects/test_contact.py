"""When a change of the slope may be a contact."""

import numpy as np
import pytest

from slpi_ros.effects.base import EffectContext, FitContext
from slpi_ros.effects.contact import Contact

T = np.arange(0.0, 10.0, 1e-2)
# On the first rise the voltage passes 10 V once; then it stays above.
V = np.where(T < 1.0, 50.0 * T, 50.0 + 30.0 * np.sin(2.0 * np.pi * (T - 1.0)))


@pytest.mark.parametrize(("volts", "plausible"), [(10.0, False), (50.0, True), (90.0, False)])
def test_it_lies_where_the_stage_passes_again_and_again(volts, plausible):
    y, used = 1e-7 * V, np.ones(T.size, dtype=bool)
    signals = T, V, V, y, y, used, 0.0 * y, EffectContext(T)
    said = (lambda u: 1e-7 * u), (lambda: 1.0), (lambda: [(1.0, 10.0)]), (lambda: np.zeros(1)), (lambda: T < 1.0)
    context = FitContext(*signals, 1e-10, (), *said, lambda name: 0.0 * y)
    assert Contact(1e-7 * volts, 0.5).plausible(context) is plausible
