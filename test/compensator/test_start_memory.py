"""The memory at the start: the one that was asked for, unless a first measurement shows another."""

from dataclasses import replace

import numpy as np
import pytest
from strategies import FAMILY_CASE, axis_model

from slpi_ros.compensator.controller import Controller
from slpi_ros.compensator.model_swap import take_over
from slpi_ros.compensator.persistence import ASSUMED, RESTORED, SavedAxis
from slpi_ros.effects.creep import Creep
from slpi_ros.effects.filters import Mode
from slpi_ros.effects.lag import Lag
from slpi_ros.effects.resonance import Resonance
from slpi_ros.model.axis_model import START_MEMORIES
from slpi_ros.model.limits import Limits
from slpi_ros.model.stage_model import StageModel

MS, START_NS, LIMITS = 1_000_000, 10**12, Limits(0.0, 100.0)
PLAIN = axis_model(FAMILY_CASE)
MODEL = replace(
    PLAIN,
    end=PLAIN.after(np.array([100.0, 0.0, 80.0, 20.0, 60.0])),
    displacement_range=(0.0, 14e-6),
    quality=replace(PLAIN.quality, held_out_rms=8e-9, floor_rms=8e-9),
)
MEMORIES = {name: MODEL.memory(name) for name in START_MEMORIES}


def controller(start_memory="end", model=MODEL, saved=None, **settings) -> Controller:
    made = Controller(["x"], [LIMITS], **settings)
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
    assert made.axes[0].initial.assumed == name and made.axes[0].confidence.state == ASSUMED


def test_the_memories_of_this_model_are_told_apart_by_their_displacement():
    places = sorted(memory.displacement for memory in MEMORIES.values())
    assert np.diff(places).min() > 0.1e-6


def told(made: Controller, displacement: float, count: int = 5, since_ns: int = 0, fresh: bool = True) -> None:
    """Tell a displacement (m) some times, a millisecond apart, and let the start be found."""
    for k in range(count):
        made.measure(["x"], [displacement], since_ns + k * MS, fresh)
    made.locate(since_ns + count * MS)


@pytest.mark.parametrize("assumed", START_MEMORIES)
@pytest.mark.parametrize("true", START_MEMORIES)
def test_first_measurements_choose_among_histories_and_never_the_voltage(assumed, true):
    """Where the stage is at the present voltage is told by the history: the one that says so is taken."""
    made = controller(assumed)
    present = made.voltages[0]
    there = {name: take_over(MODEL, LIMITS, (), name).drive(present) for name in START_MEMORIES}
    told(made, there[true] + 10e-9)
    best = min(START_MEMORIES, key=lambda name: abs(there[name] - there[true]))
    assert memory_of(made).displacement == pytest.approx(there[best], abs=1e-12)
    assert made.voltages[0] == made.axes[0].voltage == present
    assert not made.axes[0].confidence.contradicted and made.axes[0].initial.assumed is None
    # Later ones do not: the stage moves.
    before = memory_of(made).snapshot()
    told(made, there[assumed], since_ns=100 * MS)
    assert memory_of(made).snapshot() == before and made.voltages[0] == present
    made.update(1, ["x"], [6e-6], 200 * MS)
    expected = take_over(MODEL, LIMITS, (), best)
    expected.drive(present)
    assert made.voltages[0] == expected.memory.inverse(6e-6)


def spoiled():
    """Return what must choose nothing: few, old, scattered, zero once, or of another time by its stamp."""
    true = MEMORIES["wiped"].displacement
    yield "four", [(true, k * MS, True) for k in range(4)]
    yield "old", [(true, -300 * MS, True)] * 5
    yield "scattered", [(true + (k % 2) * 1e-6, k * MS, True) for k in range(5)]
    yield "one zero", [(0.0, 0, True)]
    yield "stale or future stamps", [(true, k * MS, False) for k in range(9)]


@pytest.mark.parametrize(("what", "readings"), list(spoiled()), ids=[what for what, _ in spoiled()])
def test_measurements_that_do_not_agree_or_are_not_fresh_choose_nothing(what, readings):
    """One sample of 0.0 before the first command moved the assumed start by 92 V."""
    made = controller("end")
    for y, at_ns, fresh in readings:
        made.measure(["x"], [y], START_NS + at_ns, fresh)
    made.locate(START_NS + 10 * MS)
    assert memory_of(made).snapshot() == MEMORIES["end"].snapshot()
    assert made.voltages[0] == MEMORIES["end"].voltage
    assert made.axes[0].initial.assumed == "end" and not made.axes[0].confidence.contradicted


def test_measurements_that_fit_none_are_told_and_change_nothing():
    made = controller()
    told(made, MEMORIES["end"].displacement + 1e-6)
    confidence = made.axes[0].confidence
    assert confidence.contradicted and confidence.state == ASSUMED and "reset_memory" in confidence.doubt
    assert memory_of(made).snapshot() == MEMORIES["end"].snapshot()


def test_noise_does_not_choose_between_memories_at_the_same_place():
    """Within the noise of each other, the assumed one stays."""
    near = replace(MODEL, start=replace(MODEL.end, displacement=MODEL.end.displacement + 20e-9))
    for name in ("end", "start"):
        made = controller(name, near)
        before = memory_of(made).snapshot()
        told(made, near.end.displacement + 10e-9)
        assert memory_of(made).snapshot() == before


def test_after_a_command_measurements_choose_no_memory():
    made = controller()
    made.update(1, ["x"], [6e-6], 1)
    before = memory_of(made).snapshot()
    told(made, MEMORIES["wiped"].displacement, since_ns=2)
    assert memory_of(made).snapshot() == before and not made.axes[0].confidence.contradicted


def test_a_saved_memory_has_precedence():
    saved = {"x": SavedAxis((100.0, 0.0, 50.0), True)}
    made = controller("wiped", saved=saved)
    assert made.voltages[0] == 50.0 and made.axes[0].confidence.state == RESTORED
    told(made, MEMORIES["wiped"].displacement)
    assert made.voltages[0] == 50.0 and made.axes[0].confidence.state == RESTORED


def test_a_model_that_does_not_tell_its_end_starts_at_its_start():
    made = controller("end", PLAIN)
    assert memory_of(made).snapshot() == PLAIN.memory("start").snapshot()


@pytest.mark.parametrize(
    "effect", [Lag(0.05), Resonance((Mode(9.0, 0.04),)), Creep((5.0,), (0.05,))], ids=lambda e: e.name
)
@pytest.mark.parametrize("read", [0, 9], ids=["no reading", "readings"])
def test_a_stage_that_is_found_elsewhere_rests_there(effect, read):
    """A mode that rang from 0 V to where the amplifier was put the zero of the first reset off by 1.5 % of stroke."""
    model = replace(MODEL, effects=(effect,))
    made = controller("wiped", model)
    axis = made.axes[0]
    for k in range(read):
        made.measure(["x"], [MEMORIES["wiped"].displacement], k * MS)
        made.locate(k * MS)
    axis.locate(80.0, 10 * MS)
    there = take_over(model, LIMITS, (), "wiped")
    there.drive(80.0)
    there.wait(1e5)
    assert axis.voltage == 80.0 and axis.expected == pytest.approx(there.drive(80.0), abs=1e-12)
    for k in range(20, 60):
        axis.drive(80.0, k * MS)
        assert axis.expected == pytest.approx(there.drive(80.0), abs=1e-12)


def test_the_memory_is_chosen_where_the_amplifier_is_found_behind_a_mode():
    model = replace(MODEL, effects=(Resonance((Mode(9.0, 0.04),)),))
    made = controller("end", model)
    axis, memory = made.axes[0], MODEL.memory("wiped")
    memory.forward(80.0)
    for k in range(5):
        made.measure(["x"], [memory.displacement + 5e-9], k * MS)
    axis.locate(80.0, 5 * MS)
    assert not axis.confidence.contradicted
    assert axis.expected == pytest.approx(memory.displacement, abs=20e-9)
