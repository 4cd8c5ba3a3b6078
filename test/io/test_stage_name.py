"""Whose stage a name is: what tells devices apart, what older drivers published, and what names no stage."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slpi_ros.errors import UsageError
from slpi_ros.io.record import Record, common_stage
from slpi_ros.io.stage_name import FRAMES, device_name, same_stage, stage_name

PI = "(c)2020 Physik Instrumente (PI) GmbH & Co. KG, E-727.3CDA, {}, {}"
LABJACK = "LabJack T7, serial number {}, firmware {}"

texts = st.text(max_size=60) | st.sampled_from(
    [*FRAMES, PI.format("0117", "13.2"), LABJACK.format(47, "1.03"), "P-611 #3", "USB-6259, serial number 27283745"]
)


@pytest.mark.parametrize(
    ("identity", "name"),
    [
        (PI.format("0123456789", "13.21.00.09"), "E-727.3CDA, serial number 0123456789"),
        ("(c)2013 Physik Instrumente(PI) Karlsruhe,E-709.CRG,112004513,02.003 ", "E-709.CRG, serial number 112004513"),
        ("Physik Instrumente, E-517, 108012345, V01.243", "E-517, serial number 108012345"),
        (PI.format("0", "13.21"), ""),
        (LABJACK.format(470012345, "1.0308"), "LabJack T7, serial number 470012345"),
        ("USB-6259, serial number 27283745", "USB-6259, serial number 27283745"),
        ("PCI-6221, serial number 0", ""),
        ("NV200/D_NET", ""),
        ("Model MDT693B Piezo Control Module Firmware Version: 1.09", ""),
        ("a serial device that does not name itself", ""),
        ("my own amplifier 3", ""),
    ],
)
def test_a_device_is_told_from_others_by_its_number_alone(identity, name):
    assert device_name(identity) == name
    # What was published of the same device by older drivers, the whole identity.
    assert same_stage(identity, name)


@pytest.mark.parametrize("form", [PI, LABJACK])
def test_another_firmware_is_the_same_device_and_another_number_is_not(form):
    one, updated, other = form.format("0117", "1.0"), form.format("0117", "2.5"), form.format("0118", "1.0")
    assert same_stage(one, updated)
    assert same_stage(device_name(one), updated)
    assert not same_stage(one, other)
    assert not same_stage(device_name(one), other)
    assert not same_stage(device_name(one), device_name(other))


@pytest.mark.parametrize("frame", ["", " ", "base_link", "world", "map", "odom", "/map"])
def test_frames_of_other_things_name_no_stage(frame):
    assert stage_name(frame) == ""
    assert same_stage(frame, "P-611 #3")


def test_own_names_are_compared_as_they_are():
    assert same_stage("P-611 #3", "P-611 #3")
    assert not same_stage("P-611 #3", "P-611 #30")
    assert not same_stage("stage", "Stage")
    assert stage_name("world 2") == "world 2"


@given(texts, texts)
def test_a_name_of_a_name_is_itself_and_order_does_not_count(one, other):
    assert stage_name(stage_name(one)) == stage_name(one)
    assert same_stage(one, other) == same_stage(other, one)
    assert same_stage(one, one)
    assert stage_name(device_name(one)) == device_name(one)


def test_records_of_one_device_before_and_after_an_update_are_of_one_stage():
    t = np.arange(3) * 10**6
    record = Record(t, {"x": np.zeros(3)}, {"x": np.zeros(3)}, "one", PI.format("0117", "1.0"))
    later = replace(record, source="later", hardware_id="E-727.3CDA, serial number 0117")
    unnamed = replace(record, source="unnamed", hardware_id="base_link")
    assert common_stage([unnamed, record, later]) == record.hardware_id
    assert common_stage([unnamed]) == ""
    with pytest.raises(UsageError, match=r"'E-727.3CDA, serial number 0117' \(later\)"):
        common_stage([later], "P-611 #3")
