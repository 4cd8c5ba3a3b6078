"""The exported C source answers what the stream of Python answers."""

import ctypes
import subprocess
import tempfile
from dataclasses import replace
from math import inf
from pathlib import Path

import numpy as np
import pytest
from export.built import WARNINGS, build, by_python, compiler, write
from export.stages import EVERY, KINDS, one_axis, stages, two_axes
from hypothesis import given, settings
from hypothesis import strategies as st

from slpi_ros.effects.creep import Creep
from slpi_ros.effects.filters import Mode
from slpi_ros.effects.hum import Hum, Line
from slpi_ros.effects.lag import Lag
from slpi_ros.effects.resonance import Resonance
from slpi_ros.effects.sensor_periodic import SensorPeriodic
from slpi_ros.effects.surroundings import Quantity, Surroundings
from slpi_ros.errors import UsageError
from slpi_ros.export.stage import ExportedStage
from slpi_ros.export.vectors import (
    UNREACHABLE,
    by_rounding,
    courses,
    float_remarks,
    path,
    program_files,
    smooth,
    vectors,
)
from slpi_ros.hysteresis.multi_slope import AmplitudeScaled, MultiSlope
from slpi_ros.hysteresis.prandtl_ishlinskii import PrandtlIshlinskii
from slpi_ros.hysteresis.slpi_published import SeparatedLoops, SingleLoop
from slpi_ros.model.limits import Limits
from slpi_ros.model.stage_model import StageModel

FREE = Limits(-inf, inf)
AGREES = 1e-12
SANITIZED = ("-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-fno-omit-frame-pointer")


def widths(stage):
    return np.array([axis.allowed.upper - axis.allowed.lower for axis in stage.axes])


def differences(stage, folder, stamps, y, *flags, name="gcc"):
    """Return the largest difference by axis, as a share of the voltage range, up to what the model cannot reach."""
    t = stamps * 1e-9
    given = courses(stage, t.size)
    v, code = by_python(stage, t, y, given)
    answers, codes = build(folder, stage, *flags, name=name).run(np.diff(t, prepend=0.0), y, given)
    end = int(np.argmax(code == UNREACHABLE)) if (code == UNREACHABLE).any() else code.size
    assert np.array_equal(code[:end], codes[:end])
    return np.abs(v - answers)[:end].max(axis=0, initial=0.0) / widths(stage)


@settings(max_examples=max(settings.default.max_examples // 4, 1), deadline=None)
@given(stages(), st.sampled_from((inf, 3000.0)), st.integers(0, 1000))
def test_it_equals_the_stream(model, slew, seed):
    stage = ExportedStage.of(model, replace(FREE, slew=slew))
    with tempfile.TemporaryDirectory() as folder:
        assert (differences(stage, Path(folder), *path(stage, 700, seed)) <= AGREES).all()


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_with_every_effect(tmp_path, kind):
    stage = ExportedStage.of(one_axis(kind, EVERY), Limits(5.0, 95.0, 2e4))
    assert (differences(stage, tmp_path, *path(stage, 800)) <= AGREES).all()


@pytest.mark.parametrize("slew", [inf, 100.0])
@pytest.mark.parametrize("frequency", [0.06, 1.0, 10.0, 300.0])
def test_pauses_with_a_slow_mode(tmp_path, frequency, slew):
    # Of a pause longer than 0.1 s a short part may come first; its displacement is kept, too.
    stage = ExportedStage.of(one_axis("pi", (Resonance((Mode(frequency, 0.3, 1.0),)),)), replace(FREE, slew=slew))
    for seed in (1, 2, 3):
        assert (differences(stage, tmp_path, *path(stage, 1500, seed)) <= AGREES).all()


@pytest.mark.parametrize(
    "effect",
    [
        Resonance((Mode(6.5, 0.45, 1.0),)),
        Resonance((Mode(60.0, 1.0, 1.0),)),
        Resonance((Mode(40.0, 2.0, 0.5), Mode(300.0, 0.02, 0.3))),
        Creep(exponent=0.25, gain=0.03),
    ],
    ids=["damped", "critical", "two lags beside a mode", "power of time"],
)
def test_any_damping_and_a_power_of_time(tmp_path, effect):
    stage = ExportedStage.of(one_axis("pi", (effect,)), FREE)
    assert (differences(stage, tmp_path, *path(stage, 800)) <= AGREES).all()


def test_a_mode_that_is_too_slow_is_refused_by_name():
    with pytest.raises(UsageError, match="0.04 Hz"):
        ExportedStage.of(one_axis("pi", (Resonance((Mode(0.04, 0.3, 1.0),)),)), FREE)


def test_coupled_axes_together(tmp_path):
    stage = ExportedStage.of(two_axes(), FREE)
    # The compiler finds more to warn of where it optimises.
    assert (differences(stage, tmp_path, *path(stage, 800), "-O2") <= AGREES).all()


def test_one_of_two_axes_is_exported_as_if_the_other_rested(tmp_path):
    stage = ExportedStage.of(two_axes(), FREE, ["y"])
    assert [axis.name for axis in stage.axes] == ["y"]
    assert (differences(stage, tmp_path, *path(stage, 300)) <= AGREES).all()
    assert "x: not in this export" in (tmp_path / "slpi_inverse.h").read_text()


@pytest.mark.parametrize("flags", [(), ("-DSLPI_FLOAT",)])
def test_the_written_program_passes(tmp_path, flags):
    stage = ExportedStage.of(two_axes(()), FREE)
    write(tmp_path, stage)
    for name, text in program_files(stage).items():
        (tmp_path / name).write_text(text)
    command = [compiler(), *WARNINGS, "-O1", *flags, "slpi_inverse.c", "slpi_test.c", "-lm", "-o", "slpi_test"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    said = subprocess.run([tmp_path / "slpi_test"], capture_output=True, text=True)
    assert said.returncode == 0, said.stdout + said.stderr
    # A program that cannot fail shows nothing.
    wrong = (tmp_path / "slpi_inverse.c").read_text().replace("b->v = v;", "b->v = v + R(1e-3);")
    (tmp_path / "slpi_inverse.c").write_text(wrong)
    assert not subprocess.run(command, cwd=tmp_path, capture_output=True).returncode
    assert subprocess.run([tmp_path / "slpi_test"], capture_output=True).returncode == 1


def test_what_rounding_of_setpoints_makes_is_measured():
    plain, late = (ExportedStage.of(one_axis("slpi", each), FREE) for each in ((), (Lag(0.02),)))
    found, more = (by_rounding(each, *smooth(each, 300), np.empty((300, 0))) for each in (plain, late))
    # A lag of 200 steps multiplies it.
    assert 0.0 < found < 1e-6 and more > 30.0 * found
    assert float_remarks(plain) == []
    (told,) = float_remarks(late)
    assert "use double" in told
    assert "mpi" in float_remarks(ExportedStage.of(one_axis("mpi"), FREE))[0]


def test_refused_steps_change_nothing_and_their_time_counts(tmp_path):
    stage = ExportedStage.of(two_axes(), FREE)
    found = vectors(stage, 400)
    assert {1, 2, 3} <= set(found.codes.tolist())
    answers, codes = build(tmp_path, stage).run(found.dt, found.desired, found.surroundings)
    assert np.array_equal(codes, found.codes)
    assert (np.abs(answers - found.volts).max(axis=0) <= AGREES * widths(stage)).all()


@settings(max_examples=max(settings.default.max_examples // 12, 1), deadline=None)
@given(stages(), st.integers(0, 1000))
def test_a_state_that_is_restored_goes_on_as_before(model, seed):
    stage = ExportedStage.of(model, FREE)
    stamps, y = path(stage, 600, seed)
    dt = np.diff(stamps * 1e-9, prepend=0.0)
    with tempfile.TemporaryDirectory() as folder:
        one = build(Path(folder), stage)
    one.run(dt[:300], y[:300])
    saved = one.state.raw
    first, _ = one.run(dt[300:], y[300:])
    one.run(dt[:100], y[200:300])
    one.state.raw = saved
    again, _ = one.run(dt[300:], y[300:])
    assert np.array_equal(first, again)


def test_it_starts_where_the_amplifier_is(tmp_path):
    model = one_axis("slpi", EVERY)
    stage = ExportedStage.of(model, FREE)
    one = build(tmp_path, stage)
    stamps, y = path(stage, 200)
    for volts in (30.0, 99.0, 0.0):
        assert one.start([volts]) == 0
        axis = model.axes["x"]
        memory = axis.memory()
        memory.forward(volts)
        stream = axis.stream_from(memory, FREE.within(axis.voltage_range))
        expected = [stream.step(t, *each) for t, each in zip((stamps * 1e-9).tolist(), y.tolist(), strict=True)]
        answers, _ = one.run(np.diff(stamps * 1e-9, prepend=0.0), y)
        assert np.abs(answers[:, 0] - expected).max() <= AGREES * 100
    assert one.start([np.nan]) == 2
    assert one.start([1e9]) == 3


def test_a_voltage_that_is_applied_moves_the_model(tmp_path):
    model = two_axes()
    stage = ExportedStage.of(model, FREE)
    one, stream = build(tmp_path, stage), stage.stream()
    rng = np.random.default_rng(3)
    origins = model.origins
    for _ in range(300):
        dt, volts = float(rng.choice([0.0, 1e-4, 3e-3, 0.2])), rng.uniform(0.0, 94.0, 2)
        own = {name: stream.streams[name].drive(v, dt) for name, v in zip("xy", volts.tolist(), strict=True)}
        moved = {name: y - origins[name] for name, y in own.items()}
        expected = [own["x"] + 0.03 * moved["y"], own["y"] - 0.02 * moved["x"]]
        assert np.abs(one.drive(dt, volts) - expected).max() < 1e-17


def test_quantities_that_do_not_come_or_make_no_sense_are_ignored(tmp_path):
    stage = ExportedStage.of(one_axis("slpi", EVERY), FREE)
    assert [one.key for one in stage.quantities] == ["/room/temperature", "/load:force.z"]
    one = build(tmp_path, stage)
    setting = one.library.slpi_inverse_set
    setting.argtypes = [ctypes.c_char_p, ctypes.c_int, ctypes.c_double]
    before = one.state.raw
    for number, value, code in ((0, np.nan, 2), (1, np.inf, 2), (-1, 1.0, 3), (2, 1.0, 3)):
        assert setting(one.state, number, value) == code
    assert one.state.raw == before
    assert setting(one.state, 1, 5.0) == 0 and one.state.raw != before


def test_an_arithmetic_that_failed_leaves_the_quantities(tmp_path):
    follows = Surroundings((Quantity("/room", offset_gain=1e6), Quantity("/load", offset_gain=-2e-8)))
    stage = ExportedStage.of(one_axis("slpi", (follows,)), FREE)
    one = build(tmp_path, stage)
    low, high = stage.axes[0].model.displacement_range
    y = np.full((3, 1), 0.5 * (low + high))
    given = np.array([[1e-12, 4.0], [1e308, np.nan], [1e-12, np.nan]])
    answers, codes = one.run(np.full(3, 1e-3), y, given)
    assert codes.tolist() == [0, 5, 0] and answers[1] == answers[0]
    # The load is known as before.
    assert answers[2] == pytest.approx(answers[0], abs=1e-9)


def nested(turns, rng):
    """Return displacements (as shares) of loops within loops, `turns` turning points deep, then a full loop."""
    levels = 0.5 + 0.49 * np.where(np.arange(turns) % 2, -1, 1) * np.linspace(1.0, 0.1, turns)
    levels *= 1.0 + 1e-3 * rng.uniform(-1, 1, turns)
    way = np.interp(np.arange(8 * turns) / 8, np.arange(turns), levels)
    return way, np.interp(np.arange(200) / 40, [0, 1, 2, 3, 5], [way[-1], 0.99, 0.01, 0.99, 0.3])


@pytest.mark.long
@pytest.mark.parametrize("kind", KINDS)
def test_what_is_forgotten_is_less_than_its_bound(tmp_path, kind):
    stage = ExportedStage.of(one_axis(kind), FREE)
    one = build(tmp_path, stage, "-DSLPI_TURNS=16")
    rng, most = np.random.default_rng(2), 0.0
    for _ in range(20):
        one.start()
        stream = stage.stream().streams["x"]
        inside, after = nested(int(rng.integers(18, 60)), rng)
        for volts in (100.0 * np.concatenate([inside, inside[::-1], after])).tolist():
            most = max(most, abs(float(one.drive(1e-3, [volts])[0]) - stream.drive(volts, 1e-3)))
    # Several loops are forgotten on the way.
    assert 0.0 < most < stage.axes[0].forgotten(16)


def test_beyond_the_stack_the_smallest_loop_is_forgotten(tmp_path):
    stage = ExportedStage.of(one_axis("slpi"), FREE)
    (axis,) = stage.axes
    one = build(tmp_path, stage, "-DSLPI_TURNS=16")
    inside, after = nested(40, np.random.default_rng(1))
    low, high = axis.model.displacement_range
    y = low + (high - low) * np.concatenate([inside, inside[::-1], after])[:, None]
    dt = np.full(len(y), 1e-4)
    answers, _ = one.run(dt, y)
    expected, _ = by_python(stage, np.cumsum(dt) - dt, y)
    error = np.abs(answers - expected)[:, 0]
    assert one.depth() <= 18
    most = axis.forgotten(16) / 5e-8
    assert 0.0 < error[: 2 * inside.size].max() < most
    # A full loop wipes the memory, and with it what was forgotten.
    assert error[-60:].max() <= AGREES * 100
    exact = build(tmp_path, stage).run(dt, y)[0]
    assert np.abs(exact - expected).max() <= AGREES * 100


def run_hostile(folder, stage, steps, *flags, name="gcc"):
    write(folder, stage)
    accepted = [axis.model.displacement_range for axis in stage.axes]
    values = {
        "LOWER": [axis.allowed.lower for axis in stage.axes], "UPPER": [axis.allowed.upper for axis in stage.axes],
        "LOW": [low for low, _ in accepted], "HIGH": [high for _, high in accepted],
    }  # fmt: skip
    given = [f"-D{key}={{{', '.join(map(repr, map(float, each)))}}}" for key, each in values.items()]
    source = Path(__file__).with_name("hostile.c")
    command = [compiler(name), *WARNINGS, *flags, f"-DSTEPS={steps}L", *given, "-I.", "slpi_inverse.c", str(source)]
    done = subprocess.run([*command, "-lm", "-o", "hostile"], cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    said = subprocess.run([folder / "hostile"], capture_output=True, text=True)
    assert said.returncode == 0, said.stdout + said.stderr
    return [int(each) for each in said.stdout.split()]


@pytest.mark.parametrize(
    "flags", [SANITIZED, pytest.param((*SANITIZED, "-DSLPI_FLOAT"), marks=pytest.mark.long)], ids=["double", "float"]
)
def test_hostile_inputs_never_leave_the_limits(tmp_path, flags):
    seen = run_hostile(tmp_path, ExportedStage.of(two_axes(), Limits(5.0, 90.0, 1e4)), 10_000, *flags)
    assert min(seen[:4]) > 0


@pytest.mark.long
@pytest.mark.parametrize("name", ["gcc", "clang"])
@pytest.mark.parametrize("number", [(), ("-DSLPI_FLOAT",)])
def test_a_million_hostile_inputs(tmp_path, name, number):
    # The run-time library of clang's sanitizers is a package of its own.
    flags = (*(SANITIZED if name == "gcc" else ("-O2",)), *number)
    for model in (two_axes(), *(one_axis(kind, EVERY) for kind in ("pi", "mpi"))):
        run_hostile(tmp_path, ExportedStage.of(model, Limits(5.0, 90.0, 1e4)), 1_000_000, *flags, name=name)


@pytest.mark.long
@settings(max_examples=max(settings.default.max_examples // 4, 1), deadline=None)
@given(stages(), st.sampled_from((inf, 3000.0)), st.integers(0, 1000))
def test_clang_has_the_same_answers(model, slew, seed):
    stage = ExportedStage.of(model, replace(FREE, slew=slew))
    with tempfile.TemporaryDirectory() as folder:
        assert (differences(stage, Path(folder), *path(stage, 1000, seed), "-O2", name="clang") <= AGREES).all()


@pytest.mark.long
def test_cppcheck_finds_nothing(tmp_path):
    for place, model in enumerate((two_axes(), one_axis("mpi"))):
        folder = tmp_path / str(place)
        folder.mkdir()
        write(folder, ExportedStage.of(model, FREE))
        command = [compiler("cppcheck"), "--std=c11", "--enable=warning,performance,portability", "--error-exitcode=1"]
        done = subprocess.run(
            [*command, "--inline-suppr", "slpi_inverse.c"], cwd=folder, capture_output=True, text=True
        )
        assert done.returncode == 0, done.stderr


def test_what_belongs_to_sensor_and_record_is_left_out_by_name(tmp_path):
    measured = (Hum((Line(50.0, 1e-8, 0.0),)), SensorPeriodic(3e-7, 1e-9, 0.0))
    stage = ExportedStage.of(one_axis("slpi", (*EVERY, *measured)), FREE)
    write(tmp_path, stage)
    header = (tmp_path / "slpi_inverse.h").read_text()
    assert all(f"left out: {effect.name}" in header for effect in measured)
    assert "#define SLPI_DELAY_0 0.001" in header


def published():
    loop = SingleLoop(
        0.0, 1, (0.0, 0.0), (100.0, 1e-5), (0.0, 0.0), PrandtlIshlinskii(np.zeros(1), np.array([1e-7])), 0.0
    )
    return SeparatedLoops((loop,), 0.1)


def scaled():
    base = MultiSlope(0.0, 100.0, np.array([0.0, 10.0]), np.array([5e-8, 5e-8]))
    return AmplitudeScaled(base, np.array([100.0]), np.array([1e-5]))


@pytest.mark.parametrize(("kind", "make"), [("slpi-published", published), ("smpi", scaled)])
def test_kinds_that_need_the_whole_path_are_refused_by_name(kind, make):
    axis = replace(one_axis().axes["x"], kind=kind, hysteresis=make())
    with pytest.raises(UsageError, match=kind):
        ExportedStage.of(StageModel({"x": axis}), FREE)


def test_an_effect_without_exported_form_is_refused_by_name(monkeypatch):
    model = one_axis("slpi", EVERY)
    effect = next(each for each in EVERY if each.name == "creep")
    for laws in (None, {"unheard_of": 1.0}):
        monkeypatch.setattr(type(effect), "laws", lambda self, laws=laws: laws)
        with pytest.raises(UsageError, match="effect 'creep' cannot be exported"):
            ExportedStage.of(model, FREE)


def test_names_of_axes_cannot_leave_their_comment(tmp_path):
    model = one_axis()
    name = 'x*/ int "a\\ ??/\n\N{MICRO SIGN}???/'
    stage = ExportedStage.of(StageModel({name: model.axes["x"]}, "*/ #error"), FREE)
    build(tmp_path, stage)
