"""The closed loop in C and in the FMU: what `Feedback` computes, step by step."""

import ctypes
import subprocess
from math import inf, nan

import numpy as np
import pytest
from export.built import WARNINGS, compiler, write
from export.stages import one_axis, two_axes

from slpi_ros import save_model
from slpi_ros.cli import main
from slpi_ros.compensator.feedback import PidGains
from slpi_ros.compensator.gains_file import TunedGains
from slpi_ros.compensator.loop_filter import Notch
from slpi_ros.errors import UsageError
from slpi_ros.export.stage import ExportedStage
from slpi_ros.model.limits import Limits

FREE = Limits(-inf, inf)
NOTCHES = (Notch(120.0, 0.02), Notch(310.0, 0.1, 0.5))
GAINS = {
    "integral": PidGains(0.0, 3e8),
    "notches and low pass": PidGains(2e6, 3e8, measurement_filter=4e-4, notches=NOTCHES),
    "all": PidGains(2e6, 3e8, 1e3, 2e-3, 4e-4, NOTCHES),
    "a derivative without a low pass": PidGains(2e6, 3e8, 50.0, notches=NOTCHES[:1]),
}
RATE = 2000.0
SHIM = """
#include <stddef.h>
#include "slpi_inverse.c"
void run(slpi_feedback_t *f, int n, double dt, const double *y, const double *m, double *c, int *code);
void run(slpi_feedback_t *f, int n, double dt, const double *y, const double *m, double *c, int *code)
{
    for (int k = 0; k < n; k++) {
        code[k] = slpi_feedback_step(f, dt, y + k * SLPI_AXES, m + k * SLPI_AXES, c + k * SLPI_AXES);
    }
}
size_t size(void);
size_t size(void) { return sizeof(slpi_feedback_t); }
"""


class Built:
    """The compiled feedback with its state."""

    def __init__(self, folder, stage):
        write(folder, stage)
        (folder / "shim.c").write_text(SHIM)
        command = [compiler(), *WARNINGS, "-O2", "-ffp-contract=off", "-shared", "-fPIC", "shim.c", "-o", "f.so", "-lm"]
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        self.library = ctypes.CDLL(str(folder / "f.so"))
        self.library.size.restype = ctypes.c_size_t
        self.state = ctypes.create_string_buffer(self.library.size())
        self.library.slpi_feedback_init(self.state)

    def run(self, y, measured, dt=1.0 / RATE):
        """Return corrections (V), (N, axes), and codes, (N,)."""
        given = [np.ascontiguousarray(each, dtype=float) for each in (y, measured)]
        c, code = np.empty(given[0].shape), np.empty(len(given[0]), dtype=np.int32)
        places = [each.ctypes.data_as(ctypes.c_void_p) for each in (*given, c, code)]
        self.library.run(self.state, len(c), ctypes.c_double(dt), *places)
        return c, code


def signals(count, axes, seed=3):
    """Return setpoints and readings (m), (N, axes): some errors drive the correction into its limit and back."""
    rng = np.random.default_rng(seed)
    t = np.arange(count)[:, None] / RATE
    y = 5e-6 + 2e-6 * np.sin(2.0 * np.pi * (3.0 + np.arange(axes)) * t)
    slow = 3e-6 * np.sign(np.sin(2.0 * np.pi * 1.3 * t)) * (t > 0.3)
    return y, y + slow + rng.normal(0.0, 20e-9, y.shape)


def by_python(stage, y, measured):
    period_ns = round(1e9 / RATE)
    found = np.empty(y.shape)
    for k, loop in enumerate(stage.loops):
        reference = loop.reference()
        for n in range(len(y)):
            reference.correct((n + 1) * period_ns, float(y[n, k]), float(measured[n, k]), 0.0)
            found[n, k] = reference.correction
    return found


@pytest.mark.parametrize("name", GAINS)
def test_c_is_the_reference(tmp_path, name):
    tuned = TunedGains(RATE, {"x": GAINS[name], "y": GAINS["integral"]})
    stage = ExportedStage.of(two_axes(), FREE).with_feedback(tuned)
    y, measured = signals(6000, 2)
    expected = by_python(stage, y, measured)
    found, codes = Built(tmp_path, stage).run(y, measured)
    assert not codes.any()
    most = stage.loops[0].most
    assert (np.abs(expected[:, 0]) >= most * (1.0 - 1e-12)).any() and (np.abs(expected[:, 0]) < 0.5 * most).any()
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-12 * most)


def test_what_is_refused_moves_nothing(tmp_path):
    tuned = TunedGains(RATE, {"x": GAINS["all"]})
    stage = ExportedStage.of(one_axis(), FREE).with_feedback(tuned)
    built = Built(tmp_path, stage)
    y, measured = signals(200, 1)
    before, _ = built.run(y, measured)
    for wrong in ((y, measured, 2.0 / RATE), (y, measured, nan), (y * nan, measured), (y, measured + inf)):
        held, codes = built.run(*wrong)
        assert set(codes) == {1 if len(wrong) == 3 else 2} and (held == before[-1]).all()
    after, codes = built.run(y, measured)
    assert not codes.any() and np.isfinite(after).all()


def test_gains_that_lack_an_axis_or_are_too_slow_are_refused():
    stage = ExportedStage.of(two_axes(), FREE)
    for tuned, named in ((TunedGains(RATE, {"x": GAINS["all"]}), "'y'"), (TunedGains(5.0, {}), "5 Hz")):
        with pytest.raises(UsageError) as caught:
            stage.with_feedback(tuned)
        assert named in str(caught.value)


def test_the_command_writes_it_and_its_own_test_passes(tmp_path, capsys):
    save_model(one_axis(), tmp_path / "model.json")
    TunedGains(RATE, {"x": GAINS["all"]}).write(str(tmp_path / "gains.yaml"))
    out = tmp_path / "c"
    arguments = ["export", str(tmp_path / "model.json"), "-o", str(out), "--gains"]
    assert main([*arguments, str(tmp_path / "gains.yaml")]) == 0
    assert "slpi_feedback_step" in (out / "slpi_inverse.h").read_text()
    command = [compiler(), *WARNINGS, "-DSLPI_FLOAT", "-O1", "-c", "slpi_inverse.c"]
    assert not subprocess.run(command, cwd=out).returncode
    assert main([*arguments, str(tmp_path / "none.yaml")]) == 2
    assert "none.yaml" in capsys.readouterr().err


def test_the_unit_adds_the_correction_within_the_limits(tmp_path):
    pytest.importorskip("fmpy")
    from export.test_fmu import Running

    from slpi_ros.export.fmu import UNITS, fmu

    plain = ExportedStage.of(one_axis(), FREE)
    stage = plain.with_feedback(TunedGains(RATE, {"x": GAINS["all"]}))
    low, high = plain.axes[0].allowed.lower, plain.axes[0].allowed.upper
    y, measured = signals(1200, 1)
    corrections = by_python(stage, y, measured)
    streamed = plain.stream()
    for version in ("3.0", "2.0"):
        file = tmp_path / f"unit{version[0]}.fmu"
        file.write_bytes(fmu(stage, UNITS[0], version))
        unit = Running(file, tmp_path / version)
        assert "measured_x" in unit.references
        unit.set([y[0, 0], measured[0, 0]])
        unit.unit.exitInitializationMode()
        found = []
        for k in range(len(y)):
            unit.set([y[k, 0], measured[k, 0]])
            unit.step(k / RATE, 1.0 / RATE)
            found.append(unit.get()[0])
        unit.end()
        if version == "3.0":
            feedforward = []
            streamed.step(0.0, {"x": float(y[0, 0])})
            for k in range(len(y)):
                streamed.step((k + 1) / RATE, {"x": float(y[k, 0])})
                feedforward.append(streamed.streams["x"].voltage)
            expected = np.clip(np.array(feedforward) + corrections[:, 0], low, high)
        np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-9)
    # The forward model has none.
    (tmp_path / "model.fmu").write_bytes(fmu(stage, UNITS[1], "3.0"))
    assert "measured_x" not in Running(tmp_path / "model.fmu", tmp_path / "m").references


def test_limits_of_the_correction_follow_those_of_the_voltage():
    tuned = TunedGains(RATE, {"x": GAINS["all"]})
    wide, narrow = (
        ExportedStage.of(one_axis(), limits).with_feedback(tuned).loops[0].most for limits in (FREE, Limits(10.0, 60.0))
    )
    assert narrow == pytest.approx(10.0) and wide > narrow
