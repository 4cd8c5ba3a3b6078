"""Quantities beside a stage in bags that rosbags wrote: types, stamps, clocks, gaps, and what is no quantity."""

from dataclasses import replace

import numpy as np
import pytest
from bag_makers import STORE, float64, header, joint_state, rosbags_bag
from refusals import holds, refusal

from slpi_ros.errors import RecordError, UsageError
from slpi_ros.io.bag_reader import read_bag
from slpi_ros.io.bag_writer import write_bag
from slpi_ros.io.columns import ColumnOptions
from slpi_ros.io.surroundings import clean, named_in, wild
from slpi_ros.io.tables import import_table, import_with_summary, read_table_with

SECOND = 10**9
START = 1_700_000_000 * SECOND
STATE = [
    (START + k * SECOND // 100, joint_state(START + k * SECOND // 100, ("x",), (k,), (2 * k,))) for k in range(500)
]


def measured(msgtype, field, stamp_ns, value):
    return STORE.types[f"sensor_msgs/msg/{msgtype}"](header=header(stamp_ns), variance=0.0, **{field: float(value)})


def temperature(stamp_ns, value):
    return measured("Temperature", "temperature", stamp_ns, value)


def wrench(stamp_ns, z):
    vector = STORE.types["geometry_msgs/msg/Vector3"]
    inside = STORE.types["geometry_msgs/msg/Wrench"](
        force=vector(x=0.0, y=1.0, z=float(z)), torque=vector(x=2.0, y=3.0, z=4.0)
    )
    return STORE.types["geometry_msgs/msg/WrenchStamped"](header=header(stamp_ns), wrench=inside)


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_every_type_is_read_and_aligned_by_its_stamps(tmp_path, storage):
    # Irregular, slower, late on the wire, partly without a value.
    at = np.array([0.02, 0.7, 1.9, 4.4])
    value = np.array([20.0, 20.5, np.nan, 21.0])
    stamps = (START + at * SECOND).astype(np.int64).tolist()

    def series(make, late=SECOND // 2):
        return [(stamp + late, make(stamp, one)) for stamp, one in zip(stamps, value.tolist(), strict=True)]

    beside = {
        "/room/temperature": series(temperature),
        "/room/humidity": series(lambda stamp, one: measured("RelativeHumidity", "relative_humidity", stamp, one)),
        "/room/pressure": series(lambda stamp, one: measured("FluidPressure", "fluid_pressure", stamp, one)),
        "/load": series(wrench),
        "/plain": series(lambda stamp, one: float64(one), late=0),
        "/other/stage_state": series(lambda stamp, one: joint_state(stamp, ("a", "b"), (one, 1.0), (2.0, 3.0))),
    }
    record = read_bag(rosbags_bag(tmp_path / "bag", {"/stage_state": STATE, **beside}, storage))
    several = {f"/load:{part}.{axis}" for part in ("force", "torque") for axis in "xyz"}
    several |= {f"/other/stage_state:{field}.{axis}" for field in ("position", "effort") for axis in "ab"}
    assert set(record.surroundings) == {"/room/temperature", "/room/humidity", "/room/pressure", "/plain", *several}
    for name in ("/room/temperature", "/load:force.z", "/plain", "/other/stage_state:position.a"):
        t, read = record.surroundings[name]
        np.testing.assert_allclose(t, at, atol=1e-6)
        np.testing.assert_array_equal(read, value)
    t, read = clean(record.surroundings["/plain"])
    np.testing.assert_allclose(t, at[[0, 1, 3]], atol=1e-6)
    np.testing.assert_array_equal(read, value[[0, 1, 3]])
    # A part of the record keeps its own zero of time.
    t, _ = record.part(slice(100, None)).surroundings["/plain"]
    np.testing.assert_allclose(t, at - 1.0, atol=1e-6)


def test_messages_without_stamps_are_on_the_clock_of_the_stage(tmp_path):
    """Where the stage's stamps are those of a simulation, or late on the wire, the times of recording are shifted."""
    late = 7 * SECOND
    state = [(stamp + late, message) for stamp, message in STATE]
    load = [(START + late + k * SECOND, float64(k)) for k in range(5)]
    record = read_bag(rosbags_bag(tmp_path / "bag", {"/stage_state": state, "/load": load}))
    np.testing.assert_allclose(record.surroundings["/load"][0], np.arange(5.0), atol=1e-6)


def test_topics_of_the_stage_itself_are_no_surroundings(tmp_path):
    own = {f"/{name}": STATE for name in ("measured_displacement", "tracking_error", "desired_displacement")}
    own["/voltage"] = STATE
    record = read_bag(rosbags_bag(tmp_path / "bag", {"/stage_state": STATE, **own}))
    assert record.surroundings == {}


def test_named_quantities(tmp_path):
    beside = {"/room/temperature": [(START, temperature(START, 20.0))], "/load": [(START, wrench(START, 5.0))]}
    bag = rosbags_bag(tmp_path / "bag", {"/stage_state": STATE, **beside})
    assert set(read_bag(bag, surroundings=["temperature"]).surroundings) == {"/room/temperature"}
    assert set(read_bag(bag, surroundings=["load:force.z"]).surroundings) == {"/load:force.z"}
    assert read_bag(bag, surroundings=[]).surroundings == {}
    assert holds(refusal(RecordError, read_bag, bag, surroundings=["humidity"]), "humidity", "temperature")
    assert holds(refusal(RecordError, read_bag, bag, surroundings=["load:mass"]), "mass", "force.z")
    assert holds(
        refusal(RecordError, read_bag, bag, surroundings=["stage_state:velocity.x"]), "velocity.x", "position.x"
    )
    for own in ("stage_state", "/stage_state:position.x", "stage_state:effort.x"):
        assert holds(refusal(UsageError, read_bag, bag, surroundings=[own]), "stage itself")
    record = read_bag(bag)
    assert set(named_in(record.surroundings, ["load:force.z", "/room/temperature"])) == {
        "/load:force.z",
        "/room/temperature",
    }
    assert named_in(record.surroundings, ["temperature:force"]) == {
        "/room/temperature": record.surroundings["/room/temperature"]
    }


def test_a_named_quantity_without_any_reading_is_refused(tmp_path):
    beside = {"/temperature": [(START, temperature(START, np.nan))]}
    bag = rosbags_bag(tmp_path / "bag", {"/stage_state": STATE, **beside})
    assert holds(refusal(RecordError, read_bag, bag, surroundings=["temperature"]), "temperature", "no finite reading")
    assert read_bag(bag).surroundings == {}


def test_what_cannot_be_read_is_said_unless_it_was_asked_for(tmp_path):
    from slpi_ros.io.bag_writer import BagWriter

    with BagWriter(tmp_path / "bag") as bag:
        bag.add_topic("/temperature", "sensor_msgs/msg/Temperature")
        for stamp, message in STATE:
            bag.write(stamp, bytes(STORE.serialize_cdr(message, message.__msgtype__)))
        bag.write(START, b"\0\1\0\0short", "/temperature")
    record = read_bag(tmp_path / "bag")
    assert record.surroundings == {}
    assert any("/temperature" in note for note in record.notes)
    refusal(RecordError, read_bag, tmp_path / "bag", surroundings=["temperature"])


def test_courses_have_one_value_for_each_time(tmp_path):
    record = read_bag(rosbags_bag(tmp_path / "bag", {"/stage_state": STATE}))
    with pytest.raises(RecordError):
        replace(record, surroundings={"/t": (np.zeros(2), np.zeros(3))})


def test_readings_too_large_for_arithmetic_are_missing():
    t, value = clean((np.arange(4.0), np.array([20.0, 1e308, -np.inf, 21.0])))
    assert t.tolist() == [0.0, 3.0] and value.tolist() == [20.0, 21.0]


def test_single_readings_far_from_all_others_are_left_out_and_told(tmp_path):
    rng = np.random.default_rng(2)
    value = 21.0 + np.sin(np.arange(200) / 20) + 0.02 * rng.standard_normal(200)
    value[[40, 90, 91]] = 85.0, -127.0, -127.0
    assert np.flatnonzero(wild(value)).tolist() == [40, 90, 91]
    assert clean((np.arange(200.0), value))[0].size == 197
    # A load that is put on for a while, or a value that is mostly the same, is none.
    load = np.where((np.arange(400) > 100) & (np.arange(400) < 110), 5.0, 0.01 * rng.standard_normal(400))
    assert not wild(load).any() and not wild(np.r_[np.zeros(50), 1.0, np.zeros(50)]).any()
    assert not wild(np.array([1.0, 1.1, 1.05, 90.0])).any()
    at = START + (np.arange(200) * SECOND // 45)
    beside = {"/temperature": [(int(k), temperature(int(k), x)) for k, x in zip(at, value, strict=True)]}
    record = read_bag(rosbags_bag(tmp_path / "bag", {"/stage_state": STATE, **beside}))
    assert any("/temperature" in note and "3 of 200" in note for note in record.notes)


def test_columns_named_by_a_topic_are_quantities_of_the_bag_too(tmp_path):
    lines = ["time_s,voltage_V,x_um,/room/temperature,humidity"]
    lines += [f"{k / 10},{k % 7},{k % 5},{21.5 + k / 10 if k % 3 == 0 else ''},0.4" for k in range(30)]
    (tmp_path / "data.csv").write_text("\n".join(lines))
    record = import_table(tmp_path / "data.csv")
    t, value = record.surroundings["/room/temperature"]
    assert set(record.surroundings) == {"/room/temperature"}
    np.testing.assert_allclose(t, np.arange(0, 30, 3) / 10) and np.testing.assert_allclose(value, 21.5 + t)
    told = " ".join(import_with_summary(tmp_path / "data.csv", ColumnOptions()).summary)
    assert holds(told, "/room/temperature", "10 readings", "humidity")
    write_bag(tmp_path / "bag", record)
    again = read_bag(tmp_path / "bag")
    for one, other in zip(again.surroundings["/room/temperature"], (t, value), strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-9)


def test_a_quantity_of_a_command_table_is_held_where_its_cells_are_empty(tmp_path):
    (tmp_path / "path.csv").write_text("time_s,x_m,/t\n0,1e-6,\n1,2e-6,21\n2,1e-6,\n3,1e-6,22.5\n4,1e-6,\n")
    _, _, beside = read_table_with(tmp_path / "path.csv", "m", ["/t"])
    assert beside["/t"].tolist() == [21.0, 21.0, 21.0, 22.5, 22.5]
