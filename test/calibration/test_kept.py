"""A calibration that goes on with records of an earlier run: which one is no use, why, and what to do."""

from dataclasses import replace

import numpy as np
import pytest
from calibration.stages import SimulatedRecorder, settings, stage_of
from refusals import holds, refusal

from slpi_ros.calibration.kept import REMEDY
from slpi_ros.calibration.run import Recording, calibrate
from slpi_ros.errors import RecordError, SlpiError
from slpi_ros.model.limits import Limits
from slpi_ros.simulation.character import Character

CHECK, CALIBRATION = "01_check", "02_calibration"


class Ended(SlpiError):
    """Raised by a recorder that has nothing more."""


@pytest.fixture(scope="module")
def kept():
    """Return the first two recordings of a calibration by name."""
    recorder = SimulatedRecorder(stage_of(Character()))

    def two(request):
        if len(recorder.requests) == 2:
            raise Ended
        return recorder(request)

    with pytest.raises(Ended):
        calibrate(settings(), two)
    return {recording.record.source: replace(recording, kept=True) for recording in recorder.recordings}


def resumed(kept, **changes):
    """Go on with kept recordings; end where one is missing."""

    def again(request):
        if request.name not in kept:
            raise Ended(request.name)
        return kept[request.name]

    return calibrate(settings(**changes), again)


def spoiled(kept, name, **changes):
    """Return the kept recordings, with functions of stamps, voltage or displacement applied to one of them."""
    record = kept[name].record
    found = {
        "time_ns": changes.get("stamps", np.array)(record.time_ns),
        "voltage": {"x": changes.get("voltage", np.array)(record.voltage["x"])},
        "displacement": {"x": changes.get("displacement", np.array)(record.displacement["x"])},
    }
    return kept | {name: Recording(replace(record, **found), {}, kept=True)}


def first(share):
    """Return a function that keeps this share of the samples."""
    return lambda x: x[: int(share * x.size)]


def test_what_is_kept_is_taken(kept):
    with pytest.raises(Ended, match="04_verification"):
        resumed(kept)


SPOILT = {
    "no reading": {"displacement": lambda y: np.full_like(y, np.nan)},
    "no voltage": {"voltage": lambda v: np.full_like(v, np.nan)},
    "frozen sensor": {"displacement": lambda y: np.full_like(y, 1e-6)},
    "still voltage": {"voltage": lambda v: np.full_like(v, 5.0)},
    "wrong sense": {"displacement": lambda y: -y},
    "noise": {"displacement": lambda y: np.random.default_rng(0).normal(0.0, 1e-6, y.size)},
    "incomplete": {"stamps": first(0.5), "voltage": first(0.5), "displacement": first(0.5)},
}


@pytest.mark.parametrize("name", [CHECK, CALIBRATION])
@pytest.mark.parametrize("spoil", SPOILT)
def test_a_record_that_is_no_use_is_named_with_what_to_do(kept, spoil, name):
    said = refusal(RecordError, resumed, spoiled(kept, name, **SPOILT[spoil]))
    assert said.startswith(f"{name}: ") and said.endswith(REMEDY)


@pytest.mark.parametrize(
    "spoil",
    [
        {"displacement": lambda y: 1e6 * y},
        {"displacement": lambda y: np.round(y / (0.12 * np.ptp(y))) * 0.12 * np.ptp(y)},
    ],
    ids=["micrometres", "coarse sensor"],
)
def test_a_record_of_another_scale_or_too_coarse(kept, spoil):
    said = refusal(RecordError, resumed, spoiled(kept, CALIBRATION, **spoil))
    assert said.startswith(f"{CALIBRATION}: ") and said.endswith(REMEDY)


def test_a_record_of_another_stage(kept):
    other = replace(kept[CALIBRATION].record, hardware_id="stage 8")
    said = refusal(RecordError, resumed, kept | {CALIBRATION: Recording(other, {}, kept=True)})
    assert holds(said, CALIBRATION, "'stage 8'", "'simulated'", CHECK)


@pytest.mark.parametrize("upper", [50.0, 90.0, 96.0, 130.0])
def test_records_of_other_limits_are_told_as_that(kept, upper):
    """And not as a fault of the amplifier."""
    said = refusal(RecordError, resumed, kept, limits=(Limits(0.0, upper, 1000.0, 1e5),))
    assert holds(said, "voltage_max", f"{upper:g} V", "limits") and "amplifier" not in said
    assert said.startswith((f"{CHECK}: ", f"{CALIBRATION}: "))


def test_the_slew_limit_and_the_budget_may_change(kept):
    with pytest.raises(Ended, match="04_verification"):
        resumed(kept, limits=(Limits(0.0, 100.0, 900.0, 1e5),), budget=300.0, seed=5)
