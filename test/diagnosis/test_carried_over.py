"""What a diagnosis finds on some measured records of a stage, judged on one that it has not seen."""

from dataclasses import replace

import numpy as np
import pytest

import slpi_ros
from slpi_ros.effects.delay import Delay
from slpi_ros.effects.lag import Lag
from slpi_ros.io.tables import import_table
from slpi_ros.model.axis_model import Start

pytestmark = [pytest.mark.slow, pytest.mark.long]


@pytest.fixture(scope="module")
def records(measured_data):
    return {name: import_table(measured_data / f"ntnu_{name}.csv") for name in ("20hz", "40hz", "100hz")}


def error(model, record):
    """Return the free-run error, % of the stroke, without its constant, from the initial state that suits."""
    (axis,) = record.axes
    v, y = record.voltage[axis], record.displacement[axis]
    own = model.axes[axis]
    histories = {(), (float(v[0]),), own.start.history}
    paths = [replace(own, start=Start(float(v[0]), 0.0, history)).simulate(record.t, v) for history in histories]
    return 100.0 * min(float(np.std(y - path)) for path in paths) / float(np.ptp(y))


def shift(effect):
    """Return by how much (s) an effect shifts a ramp, and its standard uncertainty (s)."""
    match effect:
        case Delay():
            return effect.seconds, effect.uncertainty["seconds"]
        case Lag():
            return effect.time_constant, effect.uncertainty["time_constant"]


def test_two_records_predict_a_third(records):
    two = [records["20hz"], records["40hz"]]
    plain = slpi_ros.identify(two)
    diagnosis = slpi_ros.diagnose(two, plain)
    (found,) = diagnosis.axes.values()
    (extended,) = diagnosis.extended.axes.values()
    named = {effect.name for effect in found.effects}
    assert "creep" in named and named & {"delay", "lag"}
    assert not named & {"thermal_drift", "saturation", "hum", "gain_drift", "resonance"}
    # The law without a creep beside it, fitted to another day of this stage, finds 0.109 ms.
    ((seconds, uncertainty),) = [shift(effect) for effect in extended.effects if effect.name in ("delay", "lag")]
    assert seconds == pytest.approx(0.109e-3, abs=0.025e-3) and uncertainty <= 0.025e-3
    of_plain, of_extended = (error(model, records["100hz"]) for model in (plain, diagnosis.extended))
    assert of_extended <= 0.26 and of_extended < 0.5 * of_plain
    assert all(0.0 < outcome.left_out_rms < outcome.before_rms for outcome in found.records)
