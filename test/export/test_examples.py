"""The examples of a controller build without warnings, and answer what the stream of Python answers."""

import subprocess
import time
from math import inf
from pathlib import Path

import numpy as np
import pytest
from export.built import WARNINGS, compiler, write
from export.stages import one_axis

from slpi_ros.export.stage import ExportedStage
from slpi_ros.model.limits import Limits

EXAMPLES = Path(__file__).resolve().parents[2] / "docs" / "examples" / "controller"
FREE = Limits(-inf, inf)


@pytest.fixture
def stage(tmp_path):
    made = ExportedStage.of(one_axis("slpi"), FREE)
    write(tmp_path, made)
    return made


def built(folder, name, *files, program="gcc", flags=WARNINGS):
    command = [compiler(program), *flags, f"-I{folder}", f"-I{EXAMPLES}", *map(str, files), "-lm", "-lrt", "-o", name]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return folder / name


def test_the_wrapper_of_a_controller(stage, tmp_path):
    low, high = stage.axes[0].model.displacement_range
    subprocess.run([compiler(), "-std=c11", "-c", "slpi_inverse.c"], cwd=tmp_path, check=True)
    middle, span = 0.5 * (low + high), high - low
    flags = ["-std=c++17", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-DSTART_VOLTS=60.0"]
    flags += [f"-DMIDDLE={middle!r}", f"-DSPAN={span!r}"]
    files = (EXAMPLES / "controller.cpp", "slpi_inverse.o")
    program = built(tmp_path, "controller", *files, program="g++", flags=flags)
    said = subprocess.run([program], capture_output=True, text=True)
    assert said.returncode == 0
    axis = stage.axes[0].model
    memory = axis.memory()
    memory.forward(60.0)
    stream = axis.stream_from(memory, FREE.within(axis.voltage_range))
    for k in range(10000):
        v = stream.step(k * 1e-4, middle + 0.3 * span * np.sin(6.283185307179586 * 5.0 * k * 1e-4))
    assert float(said.stdout.split()[0]) == pytest.approx(v, abs=1e-6)


BOARD = """
#include <stdio.h>
#include "slpi_inverse.h"
static int k, worst;
int board_period_passed(void);
int board_period_passed(void) { k++; return k % 3 != 0; }
void board_read_setpoint(slpi_real *desired);
void board_read_setpoint(slpi_real *desired) { desired[0] = (slpi_real)(k % 1000 * 8e-9 + 1e-6); }
void board_read_amplifier(slpi_real *volts);
void board_read_amplifier(slpi_real *volts) { volts[0] = (slpi_real)20; }
void board_write_dac(const slpi_real *volts);
void board_write_dac(const slpi_real *volts) { worst |= !(volts[0] >= 0 && volts[0] <= 100); }
void board_report(int reason);
void board_report(int reason) { worst |= reason; }
int board_runs(void);
int board_runs(void) { return k < 5000; }
void control(void);
int main(void) { control(); printf("%d\\n", worst); return worst; }
"""


@pytest.mark.parametrize("number", ["double", "float"])
def test_the_loop_of_a_microcontroller(stage, tmp_path, number):
    (tmp_path / "board.c").write_text(BOARD)
    flags = [one for one in WARNINGS if one != "-Wpedantic"] + ["-DSLPI_FLOAT"] * (number == "float")
    flags += ["-Wno-missing-prototypes"]
    files = (EXAMPLES / "microcontroller.c", "slpi_inverse.c", "board.c")
    program = built(tmp_path, "board", *files, flags=flags)
    assert subprocess.run([program], capture_output=True).returncode == 0


def test_the_real_time_loop_reads_setpoints_from_shared_memory(stage, tmp_path):
    program = built(tmp_path, "realtime", EXAMPLES / "realtime.c", "slpi_inverse.c")
    name = f"/slpi_test_{tmp_path.name}_{time.time_ns()}"
    place = Path("/dev/shm") / name[1:]
    low, high = stage.axes[0].model.displacement_range
    # written, desired, answered, volts: 4 and 8 bytes with their alignment.
    fields = [("written", "u4"), ("_", "u4"), ("desired", "f8"), ("answered", "u4"), ("__", "u4"), ("volts", "f8")]
    layout = np.dtype(fields)
    try:
        process = subprocess.Popen([program, name, "1", "0"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        end = time.monotonic() + 20
        while not (place.exists() and place.stat().st_size >= layout.itemsize):
            assert time.monotonic() < end and process.poll() is None
            time.sleep(0.01)
        shared = np.memmap(place, dtype=layout, mode="r+", shape=(1,))
        desired = 0.3 * low + 0.7 * high
        shared["desired"], shared["written"] = desired, 2
        while not shared["answered"][0]:
            assert time.monotonic() < end and process.poll() is None
            time.sleep(0.01)
        time.sleep(0.05)
        expected = stage.stream().step(0.0, {"x": desired})["x"]
        assert float(shared["volts"][0]) == pytest.approx(expected, abs=1e-9)
        process.terminate()
        said, _ = process.communicate(timeout=20)
        assert process.returncode == 0 and "0 refused" in said
    finally:
        process.kill()
        process.wait()
        place.unlink(missing_ok=True)
