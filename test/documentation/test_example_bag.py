"""The example bag and its model: small, readable by programs that know MCAP, and made of each other."""

import numpy as np
import pytest
from documentation.pages import DOCS
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

import slpi_ros

BAG, MODEL = DOCS / "examples" / "xy_stage", DOCS / "examples" / "xy_stage.json"
AXES = ["x", "y"]


def test_both_together_are_small():
    assert sum(path.stat().st_size for path in [MODEL, *BAG.iterdir()]) < 2_000_000


def test_the_bag_explains_itself_and_shows_a_compensated_path():
    found = {}
    with (BAG / "xy_stage.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for schema, channel, message, decoded in reader.iter_decoded_messages():
            assert schema.encoding == "ros2msg" and schema.data
            found.setdefault(channel.topic, []).append((message.log_time, decoded))
    desired, state = (dict(found[topic]) for topic in ("/desired_displacement", "/stage_state"))
    assert desired.keys() < state.keys() and len(found["/voltage_command"]) == len(state)
    error = [np.subtract(state[stamp].position, wanted.position) for stamp, wanted in desired.items()]
    # 8 nm of noise; the stage comes from where the calibration left it.
    assert np.sqrt(np.mean(np.square(error[200:]), axis=0)).max() < 20e-9
    assert np.ptp([list(wanted.position) for wanted in desired.values()], axis=0).min() > 5e-6
    assert all(list(one.name) == AXES for one in (*state.values(), *desired.values()))


@pytest.mark.slow
def test_the_model_is_what_identify_makes_of_the_bag():
    record, kept = slpi_ros.read_bag(BAG), slpi_ros.load_model(MODEL)
    made = slpi_ros.identify(record)
    assert made.hardware_id == kept.hardware_id == record.hardware_id == "xy-stage"
    assert list(kept.axes) == AXES
    simulated = [model.simulate(record.t, record.voltage) for model in (made, kept)]
    for name in AXES:
        assert np.abs(simulated[0][name] - simulated[1][name]).max() < 1e-10
        one, other = made.axes[name], kept.axes[name]
        assert (one.kind, one.voltage_range) == (other.kind, other.voltage_range)
        assert np.allclose(one.displacement_range, other.displacement_range, atol=1e-10)
        assert one.quality.samples == other.quality.samples
        assert np.isclose(one.quality.held_out_rms, other.quality.held_out_rms, rtol=0.02)
