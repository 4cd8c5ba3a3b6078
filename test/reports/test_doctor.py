"""What the doctor says: every fault of a record, a model or a graph is to be mended, and nothing else."""

from dataclasses import replace

import numpy as np
import pytest
from identification.records import calibration

import slpi_ros
from slpi_ros.reports.doctor import FAILED, STATE_TYPE, Graph, check_graph, check_model, check_record

LIMITS = (0.0, 100.0)


@pytest.fixture(scope="module")
def record():
    return replace(calibration(seed=1)[0], hardware_id="s1")


@pytest.fixture(scope="module")
def model(record):
    return slpi_ros.identify(record)


def graph(**changes):
    """Return a graph in which all is well, but for the changes."""
    stamps = 1e9 + np.arange(600) / 200
    well = Graph(
        "/stage_state", "/voltage_command", 3.0, ["/driver", "/compensator"], {"/driver": STATE_TYPE},
        ["/compensator"], ["/driver"], stamps, stamps + 2e-3, ["x"], {"x": 5e-6}, {"x": 20.0}, "s1", {"x": LIMITS},
    )  # fmt: skip
    return replace(well, **changes)


def to_mend(checks):
    return [check.text for check in checks if check.level == FAILED]


def test_what_is_well_needs_nothing(record, model):
    for checks in (check_record(record, model, LIMITS), check_model(model, LIMITS), check_graph(graph(), model)):
        assert checks and not to_mend(checks)


STAMPS = graph().stamps
RAMP, NOISE = np.linspace(0.0, 30.0, 600), 5e-9 * np.random.default_rng(1).standard_normal(600)
FAULTS = {
    "nobody": ({"nodes": []}, "ROS_DOMAIN_ID"),
    "no driver": ({"state_publishers": {}, "stamps": STAMPS[:0], "arrivals": STAMPS[:0]}, "no publisher"),
    "wrong type": ({"state_publishers": {"/driver": "std_msgs/msg/Float64MultiArray"}}, "Float64MultiArray"),
    "two drivers": ({"state_publishers": {"/driver": STATE_TYPE, "/other": STATE_TYPE}}, "/other"),
    "silence": ({"stamps": STAMPS[:0], "arrivals": STAMPS[:0]}, "nothing for 3 s"),
    "slow": ({"stamps": STAMPS[:4], "arrivals": STAMPS[:4]}, "4 states"),
    "no stamps": ({"stamps": 0.0 * STAMPS}, "without stamps"),
    "equal stamps": ({"stamps": np.repeat(STAMPS[:1], STAMPS.size)}, "equal"),
    "clock behind": ({"arrivals": STAMPS + 3.0}, "3 s old"),
    "clock ahead": ({"arrivals": STAMPS - 0.5}, "0.5 s ahead"),
    "gap": ({"stamps": np.concatenate([STAMPS[:300], STAMPS[300:] + 0.2]), "arrivals": STAMPS + 0.1}, "gap"),
    "jitter": ({"stamps": STAMPS + 4e-3 * (np.arange(STAMPS.size) % 2)}, "jitter"),
    "micrometres": ({"displacement": {"x": 5.0}}, "metres"),
    "millimetres": ({"readings": {"x": (RAMP, 1e-3 * (0.2e-6 * RAMP + NOISE))}}, "nm"),
    "noise of no sensor": ({"readings": {"x": (0.0 * RAMP, 1e-6 * NOISE)}}, "noise"),
    "no voltage": ({"voltage": {}}, "effort"),
    "two commanders": ({"command_publishers": ["/compensator", "/exciter"]}, "/exciter"),
    "no amplifier": ({"command_subscribers": []}, "no subscriber"),
    "another stage": ({"hardware_id": "s2"}, "'s2'"),
    "another axis": ({"axes": ["z"], "displacement": {"z": 0.0}, "voltage": {"z": 0.0}, "limits": {}}, "x"),
    "out of range": ({"voltage": {"x": 130.0}}, "130 V"),
    "other limits": ({"limits": {"x": (110.0, 150.0)}}, "110 to 150 V"),
}


@pytest.mark.parametrize("name", FAULTS)
def test_every_fault_of_a_graph_is_to_be_mended(model, name):
    changes, told = FAULTS[name]
    (text,) = to_mend(check_graph(graph(**changes), model))
    assert told in text


@pytest.mark.parametrize("rows", [1, 5])
def test_a_sensor_that_is_slower_than_the_states_is_told(rows):
    v = 50.0 - 50.0 * np.cos(np.arange(600) / 60)
    y = (2e-7 * v + NOISE)[np.arange(600) // rows * rows]
    told = [check.text for check in check_graph(graph(readings={"x": (v, y)})) if "slower" in check.text]
    assert len(told) == (rows > 1) and all("40 readings" in text for text in told)


def test_a_model_on_the_graph_is_compared_unless_another_is_given(model):
    other = replace(model, hardware_id="s2")
    assert to_mend(check_graph(graph(model=other))) and not to_mend(check_graph(graph(model=other), model))


def test_faults_of_a_model(model):
    axis = model.axes["x"]
    noisy = replace(axis, quality=replace(axis.quality, held_out_rms=30 * axis.quality.floor_rms))
    assert to_mend(check_model(replace(model, axes={"x": noisy})))
    assert to_mend(check_model(replace(model, axes={"x": replace(axis, end=None)})))
    assert to_mend(check_model(model, (150.0, 200.0))) and not to_mend(check_model(model, (0.0, 50.0)))


def test_faults_of_a_record(record, model):
    assert to_mend(check_record(record, model, (0.0, 60.0)))
    assert to_mend(check_record(replace(record, hardware_id="s2"), model))
    kept = np.ones(len(record), dtype=bool)
    kept[1000:1400] = False
    cut = slpi_ros.Record(
        record.time_ns[kept], {"x": record.voltage["x"][kept]}, {"x": record.displacement["x"][kept]}, hardware_id="s1"
    )
    assert to_mend(check_record(cut, model))
    wrong = replace(record, displacement={"x": 1e-3 * record.displacement["x"]})
    (unit,) = [text for text in to_mend(check_record(wrong)) if "sensor_scale" in text]
    assert "nm" in unit
