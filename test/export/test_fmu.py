"""The exported units pass the validation of FMPy and answer what the stream of Python answers."""

import ctypes
import math
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


LIMITED = Limits(-inf, inf, slew=20.0)  # V/s, of 100 V
REFUSED = 3  # fmi2Error, fmi3Error


@pytest.fixture(scope="module")
def slow_stage():
    return ExportedStage.of(two_axes((Lag(1e-3), Creep((0.3, 5.0), (0.02, 0.01)))), LIMITED)


@pytest.fixture(scope="module")
def slow_units(slow_stage, tmp_path_factory):
    folder = tmp_path_factory.mktemp("slow")
    return {name: folder / name for name in TARGETS["fmu"].write(str(folder), slow_stage)}


class Raw:
    """A unit as an importer calls it that is no FMPy: the functions of FMI by ctypes."""

    def __init__(self, file: Path, folder: Path) -> None:
        description = fmpy.read_model_description(str(file))
        fmpy.extract(str(file), str(folder))
        self.new, self.said = description.fmiVersion == "3.0", list[str]()
        name, token = b"one", description.guid.encode()
        places = [ctypes.c_void_p, ctypes.c_int, ctypes.c_char_p, ctypes.c_char_p]
        if self.new:
            library = folder / "binaries" / "x86_64-linux" / "slpi_inverse.so"
            self._log = ctypes.CFUNCTYPE(None, *places)(lambda *given: self.said.append(given[3].decode()))
        else:
            library = folder / "binaries" / "linux64" / "slpi_inverse.so"
            # The reason comes as what "%s" stands for.
            places = [*places[:1], ctypes.c_char_p, *places[1:], ctypes.c_char_p]
            self._log = ctypes.CFUNCTYPE(None, *places)(lambda *given: self.said.append(given[5].decode()))
        self._call = ctypes.CDLL(str(library))
        make = self._call.fmi3InstantiateCoSimulation if self.new else self._call.fmi2Instantiate
        make.restype = ctypes.c_void_p
        if self.new:
            none = [None, False, False, False, False, None, ctypes.c_size_t(0), None]
            self._unit = ctypes.c_void_p(make(name, token, *none, self._log, None))
            begin = (self._unit, False, ctypes.c_double(0.0), ctypes.c_double(0.0), False, ctypes.c_double(0.0))
        else:
            self._callbacks = (ctypes.c_void_p * 5)(ctypes.cast(self._log, ctypes.c_void_p))
            self._unit = ctypes.c_void_p(make(name, 1, token, None, self._callbacks, 0, 0))
            begin = (self._unit,)
        assert self._function("EnterInitializationMode")(*begin) == 0
        assert self._function("ExitInitializationMode")(self._unit) == 0

    def _function(self, name):
        return getattr(self._call, f"fmi{3 if self.new else 2}{name}")

    def _numbers(self, verb, first, values):
        count, kind = len(values), "Float64" if self.new else "Real"
        at, places = (ctypes.c_uint * count)(*range(first, first + count)), (ctypes.c_double * count)(*values)
        given = (self._unit, at, ctypes.c_size_t(count), places, *[ctypes.c_size_t(count)] * self.new)
        assert self._function(f"{verb}{kind}")(*given) == 0
        return np.array(places)

    def step(self, now, dt, desired):
        self._numbers("Set", 1, desired)
        ends = [ctypes.byref(ctypes.c_bool()) for _ in range(3)] + [ctypes.byref(ctypes.c_double())]
        given = (ctypes.c_double(now), ctypes.c_double(dt), True, *ends[: 4 * self.new])
        return self._function("DoStep")(self._unit, *given), self._numbers("Get", 3, [0.0, 0.0])

    def end(self):
        self._function("FreeInstance")(self._unit)


def held(stage, dt, desired):
    """Return the voltages (V) of the stream of Python that is given each row of (N, 2) for `dt` s, every 0.1 s."""
    stream, now = stage.stream(), 0.0
    stream.step(0.0, dict(zip("xy", desired[0], strict=True)))
    for k, y in enumerate(desired):
        parts = [*np.arange(1, math.ceil(dt / 0.1 - 1e-9)) * 0.1, dt]
        for part in parts:
            volts = stream.step(k * dt + part, dict(zip("xy", y, strict=True)))
        yield now, list(volts.values())
        now += dt


@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize("dt", [1e-4, 0.05, 0.1, 0.4096, 1.0, 10.0])
def test_the_slew_limit_counts_a_long_step_whole(slow_stage, slow_units, tmp_path, version, dt):
    low, high = np.array([axis.model.displacement_range for axis in slow_stage.axes]).T
    desired = (low + np.outer([0.5, 0.2, 0.9, 0.9, 0.1, 0.35, 0.3, 0.8], high - low)).tolist()
    file = slow_units[f"slpi_inverse_fmi{version}.fmu"]
    unit, other = Running(file, tmp_path / "fmpy"), Raw(file, tmp_path / "raw")
    unit.set(desired[0])
    unit.unit.exitInitializationMode()
    other._numbers("Set", 1, desired[0])
    begun, before = other.step(0.0, 0.0, desired[0])
    assert begun == 0
    for y, (now, volts) in zip(desired, held(slow_stage, dt, desired), strict=True):
        unit.set(y)
        unit.step(now, dt)
        code, found = other.step(now, dt, y)
        assert code == 0 and np.array_equal(found, unit.get())
        assert np.abs(found - volts).max() <= 1e-9 * 100.0
        assert np.abs(found - before).max() <= 20.0 * dt * (1.0 + 1e-12)
        before = found
    unit.end()
    other.end()


@pytest.mark.parametrize("version", [2, 3])
def test_a_step_that_is_too_long_is_refused_with_its_reason(slow_stage, slow_units, tmp_path, version):
    unit = Raw(slow_units[f"slpi_inverse_fmi{version}.fmu"], tmp_path)
    low, high = np.array([axis.model.displacement_range for axis in slow_stage.axes]).T
    code, before = unit.step(0.0, 0.01, (0.5 * (low + high)).tolist())
    assert code == 0 and unit.said == []
    for dt in (fmu.LONGEST_STEP * 1.001, inf):
        code, found = unit.step(0.01, dt, high.tolist())
        assert code == REFUSED and np.array_equal(found, before)
    assert len(unit.said) == 2 and "1000" in unit.said[0]
    code, found = unit.step(0.01, 0.1, high.tolist())
    assert code == 0 and np.all(np.abs(found - before) > 1.0)
    unit.end()


def test_two_exports_of_one_model_are_equal(monkeypatch):
    stage = ExportedStage.of(one_axis("pi", EVERY), FREE)
    monkeypatch.setattr(fmu, "compiled", lambda sources: b"")
    assert fmu.fmu_files(stage) == fmu.fmu_files(stage)


def test_without_a_compiler_it_says_so(monkeypatch):
    monkeypatch.setenv("PATH", "")
    with pytest.raises(SlpiError, match="--target c"):
        fmu.fmu_files(ExportedStage.of(one_axis("pi"), FREE))
