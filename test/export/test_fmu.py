"""The exported units pass the validation of FMPy and answer what the stream of Python answers."""

from math import inf
from pathlib import Path

import numpy as np
import pytest
from export.stages import EVERY, one_axis, two_axes

from slpi_ros.effects.creep import Creep
from slpi_ros.effects.lag import Lag
from slpi_ros.errors import SlpiError
from slpi_ros.export import fmu
from slpi_ros.export.stage import ExportedStage
from slpi_ros.export.targets import TARGETS
from slpi_ros.export.vectors import courses, path, surround
from slpi_ros.model.limits import Limits

fmpy = pytest.importorskip("fmpy")
validation = pytest.importorskip("fmpy.validation")
FREE = Limits(-inf, inf)
FOLLOWS = next(effect for effect in EVERY if effect.name == "surroundings")
TOPICS = {"surrounding_/room/temperature", "surrounding_/load:force.z"}


@pytest.fixture(scope="module")
def stage():
    # Each effect is tested in the C source; four units of all of them take long to compile.
    return ExportedStage.of(two_axes((Lag(1e-3), Creep((0.3, 5.0), (0.02, 0.01)), FOLLOWS)), FREE)


@pytest.fixture(scope="module")
def units(stage, tmp_path_factory):
    folder = tmp_path_factory.mktemp("units")
    return {name: folder / name for name in TARGETS["fmu"].write(str(folder), stage)}


class Running:
    """A unit in a simulation."""

    def __init__(self, file: Path, folder: Path) -> None:
        from fmpy.fmi2 import FMU2Slave
        from fmpy.fmi3 import FMU3Slave

        self.description = fmpy.read_model_description(str(file))
        self.new = self.description.fmiVersion == "3.0"
        fmpy.extract(str(file), str(folder))
        arguments = {
            "guid": self.description.guid, "unzipDirectory": str(folder),
            "modelIdentifier": self.description.coSimulation.modelIdentifier, "instanceName": "one",
        }  # fmt: skip
        self.unit = (FMU3Slave if self.new else FMU2Slave)(**arguments)
        self.references = {each.name: each.valueReference for each in self.description.modelVariables}
        self.unit.instantiate()
        if not self.new:
            self.unit.setupExperiment(startTime=0.0)
        self.unit.enterInitializationMode()

    def _which(self, causality):
        variables = [each for each in self.description.modelVariables if each.causality == causality]
        return [each.valueReference for each in variables if not each.name.startswith("surrounding_")]

    def set(self, values, given=()):
        setting = self.unit.setFloat64 if self.new else self.unit.setReal
        setting(self._which("input"), values)
        for name, value in zip(sorted(TOPICS, reverse=True), given, strict=False):
            # Not a number: none comes.
            if value == value:
                setting([self.references[name]], [value])

    def get(self):
        return np.array((self.unit.getFloat64 if self.new else self.unit.getReal)(self._which("output")))

    def step(self, now, dt):
        self.unit.doStep(currentCommunicationPoint=now, communicationStepSize=dt)

    def end(self):
        self.unit.terminate()
        self.unit.freeInstance()


def test_they_are_valid(units):
    assert len(units) == 4
    for file in units.values():
        assert validation.validate_fmu(str(file)) == []


@pytest.mark.parametrize("version", [2, 3])
def test_the_inverse_has_the_answers_of_the_stream(stage, units, tmp_path, version):
    stamps, y = path(stage, 500)
    # A step of no time is none of a simulation.
    stamps = np.cumsum(np.maximum(np.diff(stamps, prepend=0), 100_000)) - 100_000
    low, high = np.array([axis.model.displacement_range for axis in stage.axes]).T
    t, y, stream = stamps * 1e-9, np.clip(y, low, high), stage.stream()
    unit = Running(units[f"slpi_inverse_fmi{version}.fmu"], tmp_path)
    assert set(unit.references) - {"time"} == {"desired_x", "desired_y", "voltage_x", "voltage_y"} | TOPICS
    given = courses(stage, t.size)
    unit.set(y[0].tolist())
    unit.unit.exitInitializationMode()
    for k, now in enumerate(t.tolist()):
        if k:
            unit.set(y[k].tolist(), given[k])
            unit.step(t[k - 1], now - t[k - 1])
        surround(stream, stage, given[k])
        expected = list(stream.step(now, dict(zip("xy", y[k].tolist(), strict=True))).values())
        assert np.abs(unit.get() - expected).max() <= 1e-10
        if k == 200:
            state = unit.unit.getFMUState() if unit.new else unit.unit.getFMUstate()
            kept = unit.get()
    (unit.unit.setFMUState if unit.new else unit.unit.setFMUstate)(state)
    assert np.array_equal(unit.get(), kept)
    unit.end()


@pytest.mark.parametrize("version", [2, 3])
def test_the_model_goes_where_the_stream_says(stage, units, tmp_path, version):
    stream, rng = stage.stream(), np.random.default_rng(1)
    unit = Running(units[f"slpi_model_fmi{version}.fmu"], tmp_path)
    unit.unit.exitInitializationMode()
    now, origins = 0.0, stage.model.origins
    for each in stream.streams.values():
        each.drive(each.voltage, 0.0)
    for volts in rng.uniform(0.0, 94.0, (200, 2)):
        dt = float(rng.choice([1e-4, 2e-3]))
        unit.set(volts.tolist())
        unit.step(now, dt)
        now += dt
        own = {name: stream.streams[name].drive(v, dt) for name, v in zip("xy", volts.tolist(), strict=True)}
        moved = {name: y - origins[name] for name, y in own.items()}
        expected = [own["x"] + 0.03 * moved["y"], own["y"] - 0.02 * moved["x"]]
        assert np.abs(unit.get() - expected).max() <= 1e-16
    unit.end()


def test_two_exports_of_one_model_are_equal(monkeypatch):
    stage = ExportedStage.of(one_axis("pi", EVERY), FREE)
    monkeypatch.setattr(fmu, "compiled", lambda sources: b"")
    assert fmu.fmu_files(stage) == fmu.fmu_files(stage)


def test_without_a_compiler_it_says_so(monkeypatch):
    monkeypatch.setenv("PATH", "")
    with pytest.raises(SlpiError, match="--target c"):
        fmu.fmu_files(ExportedStage.of(one_axis("pi"), FREE))
