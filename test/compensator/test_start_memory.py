"""The memory at the start: the one that was asked for, unless a first measurement shows another."""

from dataclasses import replace

import numpy as np
import pytest
from strategies import FAMILY_CASE, axis_model

from slpi_ros.compensator.controller import Controller
from slpi_ros.compensator.persistence import ASSUMED, RESTORED, SavedAxis
from slpi_ros.model.axis_model import START_MEMORIES
from slpi_ros.model.limits import Limits
from slpi_ros.model.stage_model import StageModel

PLAIN = axis_model(FAMILY_CASE)
MODEL = replace(
    PLAIN,
    end=PLAIN.after(np.array([100.0, 0.0, 80.0, 20.0, 60.0])),
    displacement_range=(0.0, 14e-6),
    quality=replace(PLAIN.quality, held_out_rms=8e-9, floor_rms=8e-9),
)
MEMORIES = {name: MODEL.memory(name) for name in START_MEMORIES}


def controller(start_memory="end", model=MODEL, saved=None, **settings) -> Controller:
    made = Controller(["x"], [Limits(0.0, 100.0)], **settings)
    made.use_model(StageModel({"x": model}), saved, start_memory)
    made.activate(0)
    return made


def memory_of(made: Controller):
    return made.axes[0].stream.memory


@pytest.mark.parametrize("name", START_MEMORIES)
def test_the_memory_asked_for_is_where_it_starts(name):
    made = controller(name)
    assert memory_of(made).snapshot() == MEMORIES[name].snapshot()
    assert made.voltages[0] == MEMORIES[name].voltage
    assert made.axes[0].start_memory == name and made.axes[0].confidence.state == ASSUMED


def test_the_memories_of_this_model_are_told_apart_by_their_displacement():
    places = sorted(memory.displacement for memory in MEMORIES.values())
    assert np.diff(places).min() > 0.1e-6


@pytest.mark.parametrize("assumed", START_MEMORIES)
@pytest.mark.parametrize("true", START_MEMORIES)
def test_a_first_measurement_decides(assumed, true):
    made = controller(assumed)
    changed = made.measure(["x"], [MEMORIES[true].displacement + 10e-9], 0)
    assert [axis.name for axis in changed] == ([] if assumed == true else ["x"])
    assert memory_of(made).snapshot() == MEMORIES[true].snapshot()
    assert made.voltages[0] == MEMORIES[true].voltage
    assert not made.axes[0].confidence.contradicted and made.axes[0].start_memory is None
    # Later ones do not: the stage moves.
    assert made.measure(["x"], [MEMORIES[assumed].displacement], 1) == []
    made.update(1, ["x"], [6e-6], 1)
    assert made.voltages[0] == MODEL.memory(true).inverse(6e-6)


def test_a_measurement_that_fits_none_is_told_and_changes_nothing():
    made = controller()
    assert made.measure(["x"], [MEMORIES["end"].displacement + 1e-6], 0) == made.axes
    confidence = made.axes[0].confidence
    assert confidence.contradicted and confidence.state == ASSUMED and "reset_memory" in confidence.doubt
    assert memory_of(made).snapshot() == MEMORIES["end"].snapshot()


def test_noise_does_not_choose_between_memories_at_the_same_place():
    """Within the noise of each other, the assumed one stays."""
    near = replace(MODEL, start=replace(MODEL.end, displacement=MODEL.end.displacement + 20e-9))
    for name in ("end", "start"):
        made = controller(name, near)
        for noise in (-20e-9, 30e-9):
            assert made.measure(["x"], [near.end.displacement + noise], 0) == []
        assert memory_of(made).displacement == near.memory(name).displacement


def test_after_a_command_measurements_choose_no_memory():
    made = controller()
    made.update(1, ["x"], [6e-6], 1)
    before = memory_of(made).snapshot()
    assert made.measure(["x"], [MEMORIES["wiped"].displacement], 2) == []
    assert memory_of(made).snapshot() == before and not made.axes[0].confidence.contradicted


def test_a_saved_memory_has_precedence():
    saved = {"x": SavedAxis((100.0, 0.0, 50.0), True)}
    made = controller("wiped", saved=saved)
    assert made.voltages[0] == 50.0 and made.axes[0].confidence.state == RESTORED
    assert made.measure(["x"], [MEMORIES["wiped"].displacement], 0) == [] and made.voltages[0] == 50.0


def test_a_model_that_does_not_tell_its_end_starts_at_its_start():
    made = controller("end", PLAIN)
    assert memory_of(made).snapshot() == PLAIN.memory("start").snapshot()
