import copy
import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from effects.cases import EVERY
from hypothesis import assume, given
from hypothesis import strategies as st
from strategies import assert_same_model, axis_models, two_axes

from slpi_ros.effects.creep import Creep
from slpi_ros.effects.filters import Mode
from slpi_ros.effects.resonance import Resonance
from slpi_ros.errors import ModelError
from slpi_ros.model.document import EARLIER, RETIRED, SCHEMA, format_model, load_model, parse_model, save_model
from slpi_ros.model.stage_model import StageModel

MODEL = two_axes()
Y = MODEL.axes["y"]
TEXT = format_model(MODEL)
DOCUMENT = json.loads(TEXT)


def refused(text: str, words: str = "") -> None:
    with pytest.raises(ModelError, match=f"^here.json: [^\n]*{words}[^\n]*$"):
        parse_model(text, "here.json")


def changed(*path: str | int, to: object) -> str:
    """Return the text of the document with one value replaced."""
    document = copy.deepcopy(DOCUMENT)
    node = document
    for key in path[:-1]:
        node = node[key]
    node[path[-1]] = to
    return json.dumps(document)


@given(st.dictionaries(st.text(max_size=20), axis_models(), min_size=1, max_size=3), st.text(), st.text())
def test_documents_keep_every_bit(axes, hardware_id, created):
    model = StageModel(axes, hardware_id, created)
    text = format_model(model)
    again = parse_model(text, "here")
    assert_same_model(model, again)
    assert format_model(again) == text
    assert "\n" not in text
    text.encode("utf-8")
    for name, axis in axes.items():
        v = np.linspace(*axis.voltage_range, 50)
        assert (again.axes[name].simulate(v, v) == axis.simulate(v, v)).all()


def test_files_keep_every_bit(tmp_path):
    path = tmp_path / "model.json"
    save_model(MODEL, path)
    assert_same_model(load_model(path), MODEL)
    assert_same_model(load_model(str(path)), MODEL)
    assert path.read_text(encoding="utf-8") == TEXT
    save_model(StageModel({"y": Y}), str(path))
    assert list(load_model(path).axes) == ["y"]
    assert [entry.name for entry in tmp_path.iterdir()] == ["model.json"]


def test_units_and_version_stand_in_the_document():
    assert DOCUMENT["schema"] == SCHEMA == "slpi_ros/model/3"
    assert DOCUMENT["axes"]["x"]["voltage_range_V"] == [0.0, 100.0]
    assert DOCUMENT["axes"]["x"]["start"] == {"voltage_V": 0.0, "displacement_m": 2e-6, "history_V": [0.0, 60.0, 20.0]}
    assert DOCUMENT["axes"]["y"]["hysteresis"] == {"thresholds_V": [0.0, 4.0], "weights_m_per_V": [1e-7, 2e-8]}


@pytest.mark.parametrize(
    "version", ["slpi_ros/model/4", "slpi_ros/diagnosis/2", "", None, 1, ["slpi_ros/model/1"], {"a": 1}]
)
def test_wrong_version(version):
    refused(changed("schema", to=version), "schema is ")


HUMMING = {"name": "hum", "parameters": {"frequency": 50.0, "amplitude": 1e-9, "phase": 0.5}}


def test_version_1_is_refused():
    """No release had it: its bags are there."""
    refused(changed("schema", to=RETIRED), "identify the stage again from its bags")


@given(EVERY)
def test_version_2_gives_the_same_voltages(effect):
    """Each effect with what version 2 could hold; it is written as version 3."""
    assume(effect.name != "clock" and not (effect.name == "creep" and not effect.time_constants))
    assume(all(mode.damping < 1.0 for mode in getattr(effect, "modes", ())))
    model = StageModel({"x": replace(MODEL.axes["x"], effects=(effect,))})
    text = format_model(model)
    earlier = parse_model(text.replace(SCHEMA, EARLIER, 1), "here.json")
    assert_same_model(earlier, model)
    assert format_model(earlier) == text
    t, y = np.arange(60) * 1e-2, 4e-6 + 1e-6 * np.sin(np.arange(60) * 0.1)
    for one, other in zip(earlier.axes["x"].command(t, y), model.axes["x"].command(t, y), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12, atol=0)


def test_a_document_of_version_2_as_it_was_written():
    """Every field that version 2 wrote is read, with the meaning that it had."""
    written = [
        {"name": "creep", "parameters": {"time_constants": [0.1, 1.0], "gains": [0.01, 0.02], "origin": 1e-6,
                                         "initial": 0.0}, "uncertainty": {"gains.0": 1e-3}},
        {"name": "resonance", "parameters": {"modes": [{"frequency": 100.0, "damping": 1e-6, "gain": 0.5}]},
         "uncertainty": {}},
    ]  # fmt: skip
    document = copy.deepcopy(DOCUMENT) | {"schema": EARLIER}
    document["axes"]["x"]["effects"] = written
    found = parse_model(json.dumps(document), "here.json").axes["x"].effects
    creep = Creep((0.1, 1.0), (0.01, 0.02), 1e-6, uncertainty={"gains.0": 1e-3})
    assert found == (creep, Resonance((Mode(100.0, 1e-6, 0.5),)))


@pytest.mark.parametrize(
    "parameters",
    [
        {},
        {"exponent": 0.2},
        {"gain": 0.02},
        {"exponent": 1.0, "gain": 0.02},
        {"exponent": 0.2, "gain": 0.02, "time_constants": [1.0], "gains": [0.1]},
        {"exponent": None, "gain": 0.02},
        {"time_constants": [1.0], "gains": [0.1], "gain": "a"},
        {"time_constants": [1.0], "gains": []},
    ],
    ids=str,
)
def test_creep_is_a_list_or_a_power_of_time(parameters):
    def text(given: object) -> str:
        return changed("axes", "x", "effects", to=[{"name": "creep", "parameters": given}])

    good = json.loads(format_model(parse_model(text({"exponent": 0.2, "gain": 0.02}), "here.json")))
    assert good["axes"]["x"]["effects"][0]["parameters"].keys() == {"origin", "initial", "exponent", "gain"}
    if parameters != {"exponent": 0.2}:
        refused(text(parameters))


@pytest.mark.parametrize(
    ("name", "key", "one"),
    [
        ("resonance", "modes", {"frequency": 100.0, "damping": 0.02, "gain": 0.1}),
        ("hum", "lines", HUMMING["parameters"]),
    ],
)
def test_lists_that_say_what_cannot_be(name, key, one):
    def text(parameters: object) -> str:
        return changed("axes", "x", "effects", to=[{"name": name, "parameters": parameters}])

    assert len(parse_model(text({key: [one] * 3}), "here.json").axes["x"].effects) == 1
    lists = [[], [[]], [None], [1.0], ["a"], {}, one, None, [one] * 101, [one, {}], [one | {"more": 1.0}]]
    lists += [[one | {each: value}] for each in one for value in (None, [], {}, "1", True, -1e300, 1e300)]
    lists += [[{each: one[each] for each in one if each != left}] for left in one]
    for each in lists:
        refused(text({key: each}))
    for each in ({}, one, {key: [one], "more": 1.0}, {key.upper(): [one]}):
        refused(text(each))


def test_every_truncation_is_refused():
    for end in range(len(TEXT)):
        refused(TEXT[:end])


@pytest.mark.parametrize("text", [
    "", " ", "null", "1", "true", '"slpi_ros/model/1"', "[]", "{}",
    "[" + TEXT + "]", TEXT + TEXT, TEXT + "}", "\ufeff" + TEXT,
    "x: 1\ny: 2\n", "\0", "\ud800", "NaN", "1e400", "9" * 5000,
], ids=range(18))  # fmt: skip
def test_text_that_is_no_document(text):
    refused(text)


@pytest.mark.parametrize("number", ["NaN", "Infinity", "-Infinity", "1e400", "-1e400", "1" + "0" * 400, "9" * 5000])
@pytest.mark.parametrize(
    "place",
    [
        ("start", "voltage_V"),
        ("start", "displacement_m"),
        ("start", "history_V", 0),
        ("voltage_range_V", 0),
        ("voltage_range_V", 1),
        ("displacement_range_m", 1),
        ("quality", "rms_m"),
        ("quality", "maximum_m"),
        ("quality", "held_out_rms_m"),
        ("quality", "floor_rms_m"),
        ("quality", "samples"),
        ("quality", "covered"),
        ("hysteresis", "grid_V", 0),
        ("hysteresis", "grid_V", 2),
        ("hysteresis", "surface_m", 2, 1),
        ("hysteresis", "first_rise_m", 2),
        ("hysteresis", "edge_gain_m_per_V"),
    ],
    ids=str,
)
def test_numbers_that_are_not_finite(place, number):
    refused(changed("axes", "x", *place, to="NUMBER").replace('"NUMBER"', number))


@pytest.mark.parametrize(
    ("place", "value"),
    [
        (("axes",), {}),
        (("axes",), []),
        (("axes",), None),
        (("axes", "x"), None),
        (("axes", "x", "kind"), "bouc-wen"),
        (("axes", "x", "kind"), "pi"),
        (("axes", "y", "kind"), "slpi"),
        (("axes", "x", "effects"), [{"name": "creep"}]),
        (("axes", "x", "unknown"), 1),
        (("axes", "x", "voltage_range_V"), [0.0]),
        (("axes", "x", "voltage_range_V"), [0.0, 1.0, 2.0]),
        (("axes", "x", "voltage_range_V"), [5.0, 5.0]),
        (("axes", "x", "displacement_range_m"), [2e-6, 1e-6]),
        (("axes", "x", "start", "history_V"), [0.0, "60"]),
        (("axes", "x", "start", "voltage_V"), True),
        (("axes", "x", "quality", "samples"), 0),
        (("axes", "x", "quality", "samples"), 1.5),
        (("axes", "x", "quality", "covered"), 1.1),
        (("axes", "x", "quality", "rms_m"), -1e-9),
        (("axes", "x", "hysteresis"), []),
        (("axes", "x", "hysteresis", "grid_V"), [0.0, 50.0]),
        (("axes", "x", "hysteresis", "grid_V"), [0.0, 50.0, 50.0]),
        (("axes", "x", "hysteresis", "grid_V"), []),
        (("axes", "x", "hysteresis", "grid_V"), [0.0, "50", 100.0]),
        (("axes", "x", "hysteresis", "grid_V"), [[0.0, 50.0, 100.0]]),
        (("axes", "x", "hysteresis", "surface_m"), [[0.0], [4e-6, 0.0]]),
        (("axes", "x", "hysteresis", "surface_m"), [[0.0], [4e-6, 0.0], [1e-5, 5e-6]]),
        (("axes", "x", "hysteresis", "surface_m"), [[0.0], [4e-6, 0.0], [1e-5, 5e-6, 0.0, 0.0]]),
        (("axes", "x", "hysteresis", "surface_m"), [[0.0], [4e-6, 0.0], [4e-6, 5e-6, 0.0]]),
        (("axes", "x", "hysteresis", "surface_m"), [[0.0], [4e-6, 0.0], [1e-5, -5e-6, 0.0]]),
        (("axes", "x", "hysteresis", "surface_m"), [[0.0], [4e-6, 1e-6], [1e-5, 5e-6, 0.0]]),
        (("axes", "x", "hysteresis", "surface_m"), [0.0, 4e-6, 1e-5]),
        (("axes", "x", "hysteresis", "first_rise_m"), [0.0, 5e-6, 4e-6]),
        (("axes", "x", "hysteresis", "first_rise_m"), [0.0, 5e-6]),
        (("axes", "x", "hysteresis", "edge_gain_m_per_V"), 0.0),
        (("axes", "x", "hysteresis", "edge_gain_m_per_V"), [1e-7]),
        (("axes", "y", "hysteresis", "thresholds_V"), [0.0, 4.0, 8.0]),
        (("axes", "y", "hysteresis", "thresholds_V"), [0.0, -4.0]),
        (("axes", "y", "hysteresis", "weights_m_per_V"), [1e-7, -2e-7]),
        (("axes", "y", "hysteresis", "weights_m_per_V"), []),
    ],
)
def test_documents_that_say_what_cannot_be(place, value):
    refused(changed(*place, to=value))


def test_every_key_is_needed():
    def keys(node, path=()):
        if isinstance(node, dict):
            for key, value in node.items():
                yield (*path, key)
                yield from keys(value, (*path, key))

    for path in keys(DOCUMENT):
        # Documents of before there were effects have none.
        if path[:-1] == ("axes",) or path[-1] == "effects":
            continue
        document = copy.deepcopy(DOCUMENT)
        node = document
        for key in path[:-1]:
            node = node[key]
        del node[path[-1]]
        refused(json.dumps(document))


@pytest.mark.parametrize("depth", [50, 300, 5000, 200_000])
@pytest.mark.parametrize(
    "place", [(), ("schema",), ("hardware_id",), ("axes", "x", "hysteresis"), ("axes", "x", "effects")], ids=str
)
def test_deep_nesting(place, depth):
    for left, right in ("[", "]"), ('{"a":', "}"):
        nested = left * depth + "1" + right * depth
        refused(changed(*place, to="HERE").replace('"HERE"', nested) if place else nested)


def test_nesting_at_the_edge_of_what_python_reads():
    for key in ("hardware_id", "schema"):
        for depth in range(850, 1000):
            refused(changed(key, to="HERE").replace('"HERE"', "[" * depth + "]" * depth))


@pytest.mark.parametrize("key", ["schema", "hardware_id", "axes", "a" * 100_000, "a\nb"])
def test_messages_are_one_short_line_whatever_the_document_holds(key):
    for value in (["long\n" * 100_000], {"a\nb": "long\n" * 100_000}):
        with pytest.raises(ModelError, match="^here.json: [^\n]+$") as refusal:
            parse_model(changed(key, to=value), "here.json")
        assert len(str(refusal.value)) < 1000


@pytest.mark.parametrize(
    "content", [b"\xff\xfe\x00\x01", bytes(range(256)), "\u00e4".encode("latin-1"), TEXT.encode("utf-16")]
)
def test_binary_files(tmp_path, content):
    path = tmp_path / "model.json"
    path.write_bytes(content)
    unreadable(path)


def test_files_that_are_none(tmp_path):
    unreadable(tmp_path / "missing.json")
    unreadable(tmp_path)
    unreadable(tmp_path / ("x" * 300))
    unreadable(f"{tmp_path}/nul\0byte")
    (tmp_path / "file").write_text("")
    unreadable(tmp_path / "file" / "model.json")
    unreadable("")


def unreadable(path: str | os.PathLike[str]) -> None:
    with pytest.raises(ModelError, match="^[^\n]+$"):
        load_model(path)


def test_targets_that_cannot_be_written(tmp_path):
    (tmp_path / "file").write_text("kept")
    (tmp_path / "folder").mkdir()
    for target in (
        tmp_path / "missing" / "model.json",
        tmp_path / "folder",
        tmp_path / "file" / "model.json",
        tmp_path / ("x" * 300),
        Path("/"),
        Path(""),
        f"{tmp_path}/nul\0byte",
        "/proc/version",
    ):
        with pytest.raises(ModelError, match="^[^\n]+$"):
            save_model(MODEL, target)
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["file", "folder"]
    assert (tmp_path / "file").read_text() == "kept"


def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "model.json"
    save_model(MODEL, path)

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(ModelError, match=f"model.json.*{os.strerror(28)}"):
        save_model(StageModel({"y": Y}), path)
    assert path.read_text(encoding="utf-8") == TEXT
    assert list(tmp_path.iterdir()) == [path]
