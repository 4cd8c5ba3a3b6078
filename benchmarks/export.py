"""The exported C inverse beside the stream of Python: agreement, time and memory of a step, float, a full stack.

Of the exported feedback what a step takes with each notch more.

    make bench-export                                            # 1e6 steps of 200 models, a few minutes
    .venv/bin/python benchmarks/export.py --steps 10000000       # 1e7 steps

Times are those of the processor, as ratios of one run. The worst case is a number of instructions, counted by
callgrind (valgrind).
"""

import argparse
import ctypes
import re
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from functools import partial
from math import inf
from pathlib import Path

import numpy as np

from slpi_ros.compensator.feedback import PidGains
from slpi_ros.compensator.gains_file import TunedGains
from slpi_ros.compensator.loop_filter import Notch
from slpi_ros.effects.contact import Contact
from slpi_ros.effects.creep import Creep
from slpi_ros.effects.cross_coupling import CrossCoupling
from slpi_ros.effects.filters import Mode
from slpi_ros.effects.gain_drift import GainDrift
from slpi_ros.effects.lag import Lag
from slpi_ros.effects.rate_dependence import RateDependence
from slpi_ros.effects.resonance import Resonance
from slpi_ros.effects.saturation import Saturation
from slpi_ros.effects.self_heating import SelfHeating
from slpi_ros.effects.slew import Slew
from slpi_ros.effects.surroundings import Quantity, Surroundings
from slpi_ros.errors import SlpiError
from slpi_ros.export.c_source import c_files
from slpi_ros.export.stage import ExportedStage
from slpi_ros.export.vectors import UNREACHABLE, code_of, courses, path, surround
from slpi_ros.hysteresis.loop_family import LoopFamily
from slpi_ros.hysteresis.multi_slope import MultiSlope
from slpi_ros.hysteresis.prandtl_ishlinskii import PrandtlIshlinskii
from slpi_ros.model.axis_model import AxisModel, FitQuality, Start
from slpi_ros.model.limits import Limits
from slpi_ros.model.stage_model import StageModel

SHIM = """
#include <stddef.h>
#include "slpi_inverse.c"
size_t slpi_size(void) { return sizeof(slpi_inverse_t); }
void slpi_run(slpi_inverse_t *inverse, int n, const slpi_real *dt, const slpi_real *y, const slpi_real *given,
    slpi_real *v, int *code)
{
    for (int k = 0; k < n; k++) {
#ifdef SLPI_SURROUNDINGS
        for (int i = 0; given != NULL && i < SLPI_SURROUNDINGS; i++) {
            slpi_inverse_set(inverse, i, given[k * SLPI_SURROUNDINGS + i]);
        }
#endif
        code[k] = slpi_inverse_step(inverse, dt[k], y + k * SLPI_AXES, v + k * SLPI_AXES);
    }
}
#ifdef SLPI_FEEDBACK_DT
void slpi_feed(int n, const slpi_real *y, slpi_real *v)
{
    slpi_feedback_t feedback;
    slpi_feedback_init(&feedback);
    for (int k = 0; k < n; k++) {
        slpi_feedback_step(&feedback, SLPI_FEEDBACK_DT, y + k, y + n + k, v + k);
    }
}
#endif
"""
# The last step closes every loop of a full stack, after a pause, with a new step.
WORST = """
#include <stdio.h>
#include "slpi_inverse.c"
static const double low = LOW, high = HIGH;
__attribute__((noinline)) int slpi_worst(slpi_inverse_t *inverse, slpi_real dt, const slpi_real *y, slpi_real *v)
{
    return slpi_inverse_step(inverse, dt, y, v);
}
int main(void)
{
    static slpi_inverse_t inverse;
    slpi_real y[1], v[1];
    int code = slpi_inverse_init(&inverse, NULL);
    for (int k = 0; k < 63; k++) {
        for (int j = 1; j <= 200; j++) {
            const double size = 0.96 - 0.0145 * k, from = 0.5 + 0.5 * (k % 2 ? 1 : -1) * size;
            const double to = 0.5 - 0.5 * (k % 2 ? 1 : -1) * (size - 0.0145);
            y[0] = (slpi_real)(low + (high - low) * (from + (to - from) * j / 200.0));
            code |= slpi_inverse_step(&inverse, (slpi_real)1e-3, y, v);
        }
    }
    int depth = inverse.axis[0].memory.now.depth;
    y[0] = (slpi_real)(low + 0.999 * (high - low));
    code |= slpi_worst(&inverse, (slpi_real)0.7, y, v);
    printf("%d %d %d\\n", code, depth, inverse.axis[0].memory.now.depth);
    return 0;
}
"""
QUALITY = FitQuality(8e-9, 3e-8, 8e-9, 8e-9, 1234, 0.75, "bench")
DRAWS = {
    "lag": lambda rng: Lag(10 ** rng.uniform(-4, -2)),
    "slew": lambda rng: Slew(10 ** rng.uniform(3, 5)),
    "saturation": lambda rng: Saturation(-inf, rng.uniform(70, 110)),
    "rate_dependence": lambda rng: RateDependence(rng.uniform(0.05, 1), 10 ** rng.uniform(-1, 2), rng.uniform(0, 5e-9)),
    "creep": lambda rng: Creep(
        (rng.uniform(0.1, 1), rng.uniform(1, 100)), (rng.uniform(0, 0.03), rng.uniform(0, 0.03))
    ),
    "contact": lambda rng: Contact(rng.uniform(2e-6, 9e-6), rng.uniform(0.3, 1.5)),
    "resonance": lambda rng: Resonance(
        (Mode(rng.uniform(80, 600), 10 ** rng.uniform(-2, 0.3), rng.uniform(0.2, 1.0)),)
    ),
    "self_heating": lambda rng: SelfHeating(10 ** rng.uniform(-10, -8), rng.uniform(1, 100), 1e-6),
    "surroundings": lambda rng: Surroundings(
        (
            Quantity(
                "/temperature",
                "",
                20.0,
                rng.uniform(-1e-7, 1e-7),
                rng.uniform(-1e-3, 1e-3),
                10 ** rng.uniform(-1, 3),
                rng.choice([0.0, 1.0]),
                15.0,
                25.0,
            ),
            Quantity("/load", "", 0.0, rng.uniform(-1e-8, 1e-8), lowest=0.0, highest=10.0),
        ),
        1e-6,
    ),  # fmt: skip
    "gain_drift": lambda rng: GainDrift((1.0,), (rng.uniform(-0.1, 0.1),), 1e-6),
}
# Effects whose inverse multiplies no rounding error, and groups by the number of others.
SMOOTH = ("saturation", "contact", "gain_drift", "self_heating", "creep", "surroundings")
GROUPS = ("without the following", "one of lag, slew, rate law, modes", "several of them")


def family(rng, n=41):
    """Return a random loop family over 0 to 100 V and about 10 um."""
    grid = np.linspace(0.0, 100.0, n)
    mass = rng.uniform(0.2, 1.0, (n, n)) * np.tri(n) * (1.0 + rng.uniform(0, 2) * np.tri(n, k=-3))
    mass /= mass.sum()
    reversible = rng.uniform(5e-8, 9e-8)
    everett = np.zeros((n, n))
    for i in range(n):
        for j in range(i):
            everett[i, j] = reversible * (grid[i] - grid[j]) + 3e-6 * mass[j + 1 : i + 1, j + 1 : i + 1].sum()
    return LoopFamily(grid, everett, everett[:, 0] + 1e-9 * grid, reversible)


def plays(rng):
    weights = np.append(rng.uniform(4e-8, 8e-8), rng.uniform(1e-10, 5e-9, 12))
    return PrandtlIshlinskii(np.linspace(0.0, 45.0, 13), weights)


def slopes(rng):
    return MultiSlope(0.0, 100.0, np.linspace(0.0, 40.0, 11), rng.uniform(2e-9, 2e-8, 11))


def axis(rng, kind, effects):
    shape = {"slpi": family, "pi": plays, "mpi": slopes}[kind](rng)
    history = (0.0, 100.0, 0.0, *rng.uniform(5, 95, rng.integers(0, 5)).tolist())
    one = AxisModel(kind, shape, Start(rng.uniform(0, 100), 0.0, history), (0.0, 100.0), (-1.0, 1.0), QUALITY)
    memory = one.memory()
    high, low = memory.forward(100.0), memory.forward(0.0)
    return replace(one, displacement_range=(low, high), effects=tuple(effects))


def stage(rng, kind, names, axes=1, slew=inf):
    """Return the export of a random stage with the named effects."""
    made = {}
    for name in "xy"[:axes]:
        effects = [DRAWS[each](rng) for each in names]
        effects += [CrossCoupling({"y" if name == "x" else "x": rng.uniform(-0.1, 0.1)})] if axes > 1 else []
        made[name] = axis(rng, kind, effects)
    return ExportedStage.of(StageModel(made), Limits(-inf, inf, slew))


class Compiled:
    """A compiled inverse."""

    def __init__(self, folder, stage, *flags):
        for name, text in c_files(stage).items():
            (folder / name).write_text(text)
        (folder / "shim.c").write_text(SHIM)
        library = folder / f"{len(list(folder.glob('*.so')))}.so"
        subprocess.run(
            ["gcc", "-std=c11", "-O2", "-shared", "-fPIC", *flags, "shim.c", "-o", library, "-lm"],
            cwd=folder,
            check=True,
        )
        self.library = ctypes.CDLL(str(library))
        self.library.slpi_size.restype = ctypes.c_size_t
        self.size = self.library.slpi_size()
        self.dtype = np.float32 if "-DSLPI_FLOAT" in flags else np.float64
        self.state = ctypes.create_string_buffer(self.size)

    def run(self, dt, y, given=None, times=1):
        """Return voltages, codes, and the time (s) of a step, the best of some runs."""
        dt, y = np.ascontiguousarray(dt, self.dtype), np.ascontiguousarray(y, self.dtype)
        v, code, took = np.empty_like(y), np.empty(dt.size, np.int32), []
        values = None if given is None else np.ascontiguousarray(given, self.dtype)
        at = [None if each is None else each.ctypes.data_as(ctypes.c_void_p) for each in (dt, y, values, v, code)]
        for _ in range(times):
            self.library.slpi_inverse_init(self.state, None)
            started = time.process_time()
            self.library.slpi_run(self.state, dt.size, *at)
            took.append((time.process_time() - started) / dt.size)
        return v.astype(np.float64), code, min(took)


def streamed(stage, t, y, given=None):
    """Return what the stream of Python answers, and its time (s) of a step."""
    stream, names = stage.stream(), [axis.name for axis in stage.axes]
    v, codes = np.empty(y.shape), np.zeros(t.size, np.int32)
    started = time.process_time()
    for k, (now, desired) in enumerate(zip(t.tolist(), y.tolist(), strict=True)):
        if given is not None:
            surround(stream, stage, given[k])
        try:
            stream.step(now, dict(zip(names, desired, strict=True)))
        except SlpiError as error:
            codes[k] = code_of(error)
        v[k] = [stream.streams[name].voltage for name in names]
    return v, codes, (time.process_time() - started) / t.size


def smooth(stage, steps):
    """Return times and displacements of a smooth path at 10 kHz, slowly changing sines."""
    t = 1e-4 * np.arange(steps)
    shares = (
        0.5 + 0.2 * np.sin(2 * np.pi * 5 * t) + 0.2 * np.sin(2 * np.pi * 1.3 * t) + 0.05 * np.sin(2 * np.pi * 17 * t)
    )
    ranges = np.array([axis.model.displacement_range for axis in stage.axes])
    return t, ranges[:, 0] + np.outer(shares, np.diff(ranges, axis=1)[:, 0])


def reached(codes):
    """Return the number of steps before the first one that a model cannot reach."""
    return int(np.argmax(codes == UNREACHABLE)) if (codes == UNREACHABLE).any() else codes.size


def largest(stage, one, other, codes):
    """Return the largest difference as a share of the voltage range, up to what a model cannot reach."""
    end = reached(codes)
    widths = [axis.allowed.upper - axis.allowed.lower for axis in stage.axes]
    return float((np.abs(one - other)[:end] / widths).max(initial=0.0))


def agreement(models, steps, folder, rng):
    """Compare random models on hostile paths, and the float build on smooth ones."""
    errors, floats, sizes, each = [], {group: [] for group in GROUPS}, [], max(steps // models, 200)
    compared = 0
    for k in range(models):
        kind = ("slpi", "pi", "mpi")[k % 3]
        names = [name for name in DRAWS if rng.uniform() < (0.0, 0.3, 0.6)[k % 4 % 3]]
        one = stage(rng, kind, names, axes=1 + int(rng.uniform() < 0.25), slew=inf if rng.uniform() < 0.7 else 3000.0)
        own = folder / str(k)
        own.mkdir()
        stamps, y = path(one, each, seed=k)
        # The compiler takes longer than the steps.
        compiled = Compiled(own, one, "-O0")
        given = courses(one, each, seed=k)
        expected, codes, _ = streamed(one, stamps * 1e-9, y, given)
        answers, _, _ = compiled.run(np.diff(stamps * 1e-9, prepend=0.0), y, given)
        errors.append(largest(one, answers, expected, codes))
        compared += reached(codes)
        sizes.append(compiled.size / len(one.axes))
        t, y = smooth(one, 20_000)
        double, codes, _ = compiled.run(np.diff(t, prepend=0.0), y)
        single, _, _ = Compiled(own, one, "-O0", "-DSLPI_FLOAT").run(np.diff(t, prepend=0.0), y)
        rounded, _, _ = compiled.run(np.diff(t, prepend=0.0), y.astype(np.float32))
        group = GROUPS[min(len(set(names) - set(SMOOTH)), 2)]
        floats[group].append([largest(one, each, double, codes) for each in (single, rounded)])
        if (k + 1) % 10 == 0:
            print(f"{k + 1} of {models} models, {compared} steps: {max(errors):.3g}", file=sys.stderr, flush=True)
    print(
        f"agreement, double: {compared} of {models} x {each} steps (the others come after one that a model does not "
        f"reach), largest difference {max(errors):.3g} of the voltage range"
    )
    print(f"  {sum(error == 0.0 for error in errors)} of {models} models to the last bit; allowed 1e-12")
    for group, found in floats.items():
        if found:
            (all_, least), (most, least_most) = np.median(found, axis=0), np.max(found, axis=0)
            print(
                f"float on smooth paths, {group}: median {all_:.2g}, largest {most:.2g}; of it double with setpoints "
                f"rounded to float {least:.2g}, {least_most:.2g} ({len(found)} models)"
            )
    print(f"state of an axis, 64 turning points: median {np.median(sizes):.0f}, largest {max(sizes):.0f} bytes")


def durations(folder, rng, steps=200_000, models=9):
    """Print the time of a step without effects and with all, beside the stream of Python in the same run."""
    for label, names in (("no effects", []), ("all effects", list(DRAWS))):
        found = []
        for k in range(models):
            own = folder / f"{label}{k}"
            own.mkdir()
            one = stage(rng, ("slpi", "pi", "mpi")[k % 3], names)
            t, y = smooth(one, steps)
            _, _, mine = Compiled(own, one).run(np.diff(t, prepend=0.0), y, times=3)
            _, _, its = streamed(one, t[:4000], y[:4000])
            found.append((mine, its))
        mine, its = np.median(found, axis=0)
        ratio = np.median([slow / fast for fast, slow in found])
        print(f"{label}: {mine * 1e9:.0f} ns a step (median), Python {its * 1e6:.1f} us: {ratio:.0f} times as fast")


def notches(folder, rng, steps=1_000_000, most=4):
    """Print the time of a step of the feedback of one axis without notches, and what each one more takes."""
    y, times = 1e-6 * rng.standard_normal((2, steps)), []
    v, plain = np.empty(steps), stage(rng, "pi", [])
    compiled = []
    for count in range(most + 1):
        each = tuple(Notch(100.0 * (k + 1), 0.05, 1.0) for k in range(count))
        gains = PidGains(1e5, 1e7, measurement_filter=1e-4, notches=each)
        own = folder / f"notches{count}"
        own.mkdir()
        compiled.append(Compiled(own, plain.with_feedback(TunedGains(10_000.0, {"x": gains}))).library)
    # In turn, so that all see the same moments of the computer.
    for _ in range(15):
        times.append([])
        for library in compiled:
            started = time.process_time()
            library.slpi_feed(steps, *(each.ctypes.data_as(ctypes.c_void_p) for each in (y, v)))
            times[-1].append((time.process_time() - started) / steps * 1e9)
    least = np.min(times, axis=0)
    more = float(np.polyfit(np.arange(most + 1), least, 1)[0])
    print(f"feedback, low pass and 0 to {most} notches: {', '.join(f'{ns:.1f}' for ns in least)} ns a step; "
          f"a notch {more:.1f} ns")  # fmt: skip


def beyond(folder, rng):
    """Print the error by loops that were forgotten: nested loops, more than the stack holds."""
    one = stage(rng, "slpi", [])
    low, high = one.axes[0].model.displacement_range
    turns = 120
    levels = 0.5 + 0.49 * np.where(np.arange(turns) % 2, -1, 1) * np.linspace(1.0, 0.05, turns)
    inside = np.interp(np.arange(8 * turns) / 8, np.arange(turns), levels)
    y = (low + (high - low) * np.concatenate([inside, inside[::-1]]))[:, None]
    dt = np.full(len(y), 1e-4)
    expected, codes, _ = streamed(one, np.cumsum(dt) - dt, y)
    for held in (16, 32, 64, 128):
        own = folder / f"turns{held}"
        own.mkdir()
        answers, _, _ = Compiled(own, one, f"-DSLPI_TURNS={held}").run(dt, y)
        error = largest(one, answers, expected, codes)
        print(f"{turns} nested turns, {held} kept: largest error {error:.2g} of the range")


def worst(folder, rng):
    """Print the instructions of the worst step: all loops of a full stack close, after a pause, with a new step."""
    if not shutil.which("valgrind"):
        print("worst case: not counted, valgrind is not installed")
        return
    for label, names in (("no effects", []), ("all effects", list(DRAWS))):
        own = folder / f"worst {label}"
        own.mkdir()
        one = stage(rng, "slpi", names)
        for name, text in c_files(one).items():
            (own / name).write_text(text)
        (own / "worst.c").write_text(WORST)
        low, high = one.axes[0].model.displacement_range
        subprocess.run(
            ["gcc", "-O2", f"-DLOW={low!r}", f"-DHIGH={high!r}", "worst.c", "-o", "worst", "-lm"], cwd=own, check=True
        )
        command = [
            "valgrind",
            "--tool=callgrind",
            "--toggle-collect=slpi_worst",
            "--callgrind-out-file=/dev/null",
            "./worst",
        ]
        done = subprocess.run(command, cwd=own, capture_output=True, text=True, check=True)
        counted = re.findall(r"Collected : (\d+)", done.stderr)[-1]
        code, before, after = done.stdout.split()
        print(f"worst step, {label}: {counted} instructions; turning points {before} to {after}, code {code}")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=1_000_000, help="steps of all models; default: 1e6")
    parser.add_argument("--models", type=int, default=200)
    names = ("times", "notches", "worst", "stack", "agreement")
    parser.add_argument("--only", choices=names, help="one part; default: all")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    rng = np.random.default_rng(options.seed)
    with tempfile.TemporaryDirectory() as folder:
        parts = {
            "times": durations, "notches": notches, "worst": worst, "stack": beyond,
            "agreement": partial(agreement, options.models, options.steps),
        }  # fmt: skip
        for name, part in parts.items():
            if options.only in (None, name):
                part(Path(folder), rng)


if __name__ == "__main__":
    main()
