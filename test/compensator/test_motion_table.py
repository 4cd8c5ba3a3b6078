"""What may replace what an axis is doing: the one table, as the controller keeps it."""

from dataclasses import replace

import numpy as np
import pytest
from strategies import FAMILY_CASE, axis_model

from slpi_ros.compensator.controller import Controller, StopReason
from slpi_ros.compensator.motion import MEANING, REFUSALS, REPLACED_BY, Kind
from slpi_ros.compensator.validation import RejectedError
from slpi_ros.effects.creep import Creep
from slpi_ros.model.limits import Limits
from slpi_ros.model.stage_model import StageModel

MS, START = 1_000_000, 10**12
MODEL = replace(axis_model(FAMILY_CASE), displacement_range=(2e-6, 14e-6), effects=(Creep((0.1,), (0.05,)),))
PATH = np.linspace(4e-6, 8e-6, 50)


class Stage:
    """A compensator of one axis that is brought into each of its motions."""

    def __init__(self) -> None:
        self.now_ns = START
        self.made = Controller(["x"], [Limits(0.0, 100.0, 500.0)])
        self.made.use_model(StageModel({"x": MODEL}))
        self.made.activate(self.now_ns)
        self.stamp_ns = START
        self.made.update(self.stamp_ns, ["x"], [3e-6], self.now_ns)
        self.run(0.5)

    def run(self, seconds: float) -> None:
        end_ns = self.now_ns + round(seconds * 1e9)
        while (due := self.made.next_due_ns(self.now_ns, self.now_ns)) is not None and due <= end_ns:
            self.now_ns = max(due, self.now_ns)
            self.made.advance(self.now_ns, self.now_ns)
        self.now_ns = end_ns

    def begin(self, kind: Kind) -> None:
        """Ask for a motion; RejectedError if it may not begin."""
        self.now_ns += MS
        made, now = self.made, self.now_ns
        if kind is Kind.IDLE:
            made.stop(StopReason.DEACTIVATED, now)
        elif kind in (Kind.STREAM, Kind.APPROACH, Kind.HOLD):
            # Where it is, or as far away as the slew limit makes it go there.
            y = 13e-6 if kind is Kind.APPROACH else made.axes[0].setpoint
            self.stamp_ns += MS
            made.update(self.stamp_ns, ["x"], [y], now)
            if kind is Kind.HOLD:
                self.run(4.0)
        elif kind is Kind.TRAJECTORY:
            made.follow(["x"], np.arange(1, 51) * 20 * MS, PATH[:, None], 0, now, now)
        elif kind is Kind.RAMP:
            made.ramp([50.0], 10.0, now)
        elif kind is Kind.RESET:
            made.reset_memory(3, 100.0, [30.0], now)
        elif kind is Kind.BLOCK:
            made.follow_block(["x"], np.arange(1, 51) * 20 * MS, PATH[:, None], now, 1)
        else:
            for _ in range(60):
                made.axes[0].amplifier.report(90.0, self.now_ns)
                self.now_ns += 5 * MS
            made.report(["x"], [90.0], self.now_ns)

    @property
    def kind(self) -> Kind:
        return Kind.TRAJECTORY if self.made.trajectory.on else self.made.axes[0].motion.kind


def test_every_kind_has_a_meaning_and_a_row():
    assert list(MEANING) == list(REPLACED_BY) == list(Kind)
    assert all(kind in REFUSALS or kind is Kind.FAULT for kind, row in REPLACED_BY.items() if row != set(Kind))


@pytest.mark.parametrize("kind", Kind)
def test_every_motion_begins_from_rest(kind):
    stage = Stage()
    stage.begin(kind)
    assert stage.kind is kind


@pytest.mark.parametrize("present", Kind)
@pytest.mark.parametrize("wanted", Kind)
def test_what_the_table_forbids_is_rejected_and_changes_nothing(present, wanted):
    stage = Stage()
    stage.begin(present)
    before, voltage = stage.made.axes[0].motion, stage.made.voltages[0]
    asked = Kind.STREAM if wanted in (Kind.APPROACH, Kind.HOLD) else wanted
    if wanted in REPLACED_BY[present] and not (present is Kind.FAULT and wanted is Kind.IDLE):
        stage.begin(wanted)
        assert stage.kind is wanted
    elif present is Kind.FAULT:
        if wanted not in (Kind.IDLE, Kind.FAULT):
            with pytest.raises(RejectedError) as caught:
                stage.begin(asked)
            assert caught.value.cause == "not_armed"
        assert stage.made.axes[0].motion is before and stage.made.voltages[0] == voltage
    else:
        with pytest.raises(RejectedError) as caught:
            stage.begin(asked)
        assert caught.value.cause == REFUSALS[present][0]
        assert stage.made.axes[0].motion is before and stage.made.voltages[0] == voltage


def test_a_fault_ends_with_arm_only():
    stage = Stage()
    stage.begin(Kind.FAULT)
    stage.begin(Kind.IDLE)
    assert stage.kind is Kind.FAULT
    for _ in range(100):
        stage.now_ns += 5 * MS
        stage.made.report(["x"], [90.0], stage.now_ns)
    assert stage.made.arm(stage.now_ns) == "" and stage.kind is Kind.IDLE
    assert stage.made.voltages[0] == 90.0


@pytest.mark.parametrize("reason", [each for each in StopReason if each is not StopReason.LOST])
@pytest.mark.parametrize("kind", [each for each in Kind if each is not Kind.FAULT])
def test_there_is_one_way_to_stop_and_it_says_why(kind, reason):
    stage = Stage()
    stage.begin(kind)
    stage.made.stop(reason, stage.now_ns)
    assert stage.kind is Kind.IDLE and stage.made.stopped is reason
    voltage = stage.made.voltages[0]
    stage.run(1.0)
    assert stage.made.voltages[0] == voltage
