"""A jump of the set point within rate limits: the voltage settles, however rarely the set point is repeated."""

from dataclasses import replace

import numpy as np
import pytest
from strategies import FAMILY_CASE, axis_model

from slpi_ros.compensator.controller import Controller
from slpi_ros.effects.creep import Creep
from slpi_ros.effects.filters import Mode
from slpi_ros.effects.lag import Lag
from slpi_ros.effects.rate_dependence import RateDependence
from slpi_ros.effects.resonance import Resonance
from slpi_ros.model.limits import Limits
from slpi_ros.model.stage_model import StageModel

S = 10**9
BASE = replace(axis_model(FAMILY_CASE), displacement_range=(2e-6, 14e-6))
EFFECTS = {
    "none": (),
    "lag": (Lag(5e-3),),
    "slow lag": (Lag(20e-3),),
    "mode": (Resonance((Mode(35.0, 0.03, 1.0),)),),
    "damped mode": (Resonance((Mode(12.0, 0.6, 1.0),)),),
    "lag and mode": (Lag(5e-3), Resonance((Mode(60.0, 0.1, 1.0),))),
    "rate law": (RateDependence(0.5, 10.0, 0.0),),
    "creep": (Creep((0.5, 5.0), (0.02, 0.02)),),
}


@pytest.mark.parametrize("acceleration", [np.inf, 3e5])
@pytest.mark.parametrize("rate", [10, 50, 100, 200])
@pytest.mark.parametrize("effects", EFFECTS.values(), ids=EFFECTS)
def test_the_voltage_settles(effects, rate, acceleration):
    model = replace(BASE, effects=effects)
    made = Controller(["x"], [Limits(*model.voltage_range, 1000.0, acceleration)])
    made.configure()
    made.use_model(StageModel({"x": model}))
    now = sent = S
    made.activate(now)
    tail, errors = [], []
    while now < 4 * S:
        due = made.next_due_ns(now, now)
        now = min(sent, max(due, now + 1) if due is not None else sent)
        if now == sent:
            made.update(now, ["x"], [6e-6 if now < 2 * S else 8e-6], now)
            sent += S // rate
        else:
            made.advance(now, now)
        if now > 3.5 * S:
            tail.append(made.voltages[0])
            errors.append(made.axes[0].expected - 8e-6)
    # Creep goes on in one direction.
    assert np.abs(np.diff(tail)).sum() - abs(tail[-1] - tail[0]) < 0.05
    assert np.abs(errors).max() < 20e-9
