"""Speed of the hysteresis engine: per sample in streaming, relative to ``numpy.interp`` in batch, and its scaling.

Except for the percentiles of single samples, times are processor times, as other programs may run on the machine.
"""

import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import slpi_ros
from slpi_ros.effects.base import Effect
from slpi_ros.effects.creep import Creep
from slpi_ros.effects.delay import Delay
from slpi_ros.effects.filters import Mode
from slpi_ros.effects.lag import Lag
from slpi_ros.effects.rate_dependence import RateDependence
from slpi_ros.effects.resonance import Resonance
from slpi_ros.hysteresis.branches import trace
from slpi_ros.hysteresis.loop_family import LoopFamily
from slpi_ros.hysteresis.multi_slope import MultiSlope, thresholds_for
from slpi_ros.hysteresis.prandtl_ishlinskii import PrandtlIshlinskii
from slpi_ros.hysteresis.shapes import Shape
from slpi_ros.hysteresis.turning_points import Memory
from slpi_ros.model.axis_model import AxisModel, FitQuality, Start

FloatArray = NDArray[np.float64]
SPAN = 100.0
# Samples per second of the paths with effects.
RATE = 1e4
EFFECTS: Mapping[str, tuple[Effect, ...]] = {
    "none": (),
    "delay": (Delay(1e-3),),
    "lag": (Lag(5e-3),),
    "creep": (Creep((0.1, 1.0, 10.0), (0.01, 0.01, 0.01)),),
    "resonance": (Resonance((Mode(100.0, 0.02),)),),
    "rate law": (RateDependence(0.01 * SPAN, 0.1 * SPAN, 5e-8),),
}


def loop_family(vertices: int = 41) -> LoopFamily:
    """Return a loop family with bias-dependent loops."""
    grid = np.linspace(0.0, SPAN, vertices)
    alpha, beta = np.meshgrid(grid, grid, indexing="ij")
    u = np.maximum(alpha - beta, 0.0)
    surface = 1e-6 * (0.15 * u + 5e-4 * u**2 * (1 + 0.002 * (alpha + beta)))
    return LoopFamily(grid, surface, 1e-6 * (0.2 * grid + 5e-4 * grid**2), 2e-7)


def zigzag(samples: int, every: int, seed: int = 0) -> FloatArray:
    """Return voltages, shape (samples,), that reverse every `every` samples at random levels."""
    corners = np.random.default_rng(seed).uniform(0.02 * SPAN, 0.98 * SPAN, samples // every + 2)
    corners[1::2], corners[::2] = np.maximum(corners[1::2], SPAN / 2), np.minimum(corners[::2], SPAN / 2)
    return np.interp(np.arange(samples) / every, np.arange(corners.size), corners)


def decaying(samples: int, turns: int) -> FloatArray:
    """Return a decaying oscillation, shape (samples,), which fills the memory with turning points."""
    phase = np.linspace(0.0, np.pi * turns, samples)
    return SPAN / 2 * (1 - np.cos(phase) * (1 - phase / phase[-1]))


def per_sample(step: Callable[[float], float], values: list[float]) -> tuple[float, float, float]:
    """Return median, 99.9th percentile and maximum time of one step, microseconds, without reading the clock."""
    clock = time.perf_counter_ns
    empty, times = [], []
    for value in values:
        before = clock()
        after = clock()
        empty.append(after - before)
        before = clock()
        step(value)
        times.append(clock() - before)
    base = statistics.median(empty)
    spent = (np.array(times) - base) / 1e3
    return float(np.median(spent)), float(np.percentile(spent, 99.9)), float(spent.max())


def median_time(work: Callable[[], object], repeats: int = 9) -> float:
    """Return the median processor time of a call, seconds."""
    times = []
    for _ in range(repeats):
        before = time.process_time()
        work()
        times.append(time.process_time() - before)
    return statistics.median(times)


def wishes(shape: Shape, v: FloatArray) -> FloatArray:
    """Return the displacements (m) for voltages (V), both of shape (N,), used as desired displacements."""
    return Memory(shape).forward_array(v)


def axis_model(y: FloatArray, effects: tuple[Effect, ...] = ()) -> AxisModel:
    """Return a model of one axis whose displacement range is that of `y`, shape (N,), metres."""
    quality = FitQuality(0.0, 0.0, 0.0, 0.0, y.size, 1.0, "")
    ranges = (0.0, SPAN), (float(y.min()), float(y.max()))
    return AxisModel("slpi", loop_family(), Start(0.0, 0.0), *ranges, quality, effects)


def streaming() -> dict[str, float]:
    """Print the times of the streaming inverse; return that of the public interface, relative to the bare engine."""
    print("streaming inverse, microseconds per sample      median   p99.9     max")
    for every in (10, 100):
        for name, shape in (("slpi, 41 vertices", loop_family()), ("slpi, 161 vertices", loop_family(161))):
            path = wishes(shape, zigzag(200_000, every)).tolist()
            numbers = per_sample(Memory(shape).inverse, path)
            print(f"  {name:<20} a turn every {every:>3} samples {numbers[0]:8.2f} {numbers[1]:7.1f} {numbers[2]:7.0f}")
    path = wishes(loop_family(), zigzag(200_000, 2000))
    model, y = axis_model(path), path.tolist()
    stamps = [1e-3 * sample for sample in range(len(y))]
    # Alternately, so that both meet the same load of the machine.
    pairs = []
    for _ in range(9):
        memory, stream = Memory(model.hysteresis).inverse, model.stream().step
        bare = median_time(lambda memory=memory: [memory(value) for value in y], 1)
        public = median_time(lambda stream=stream: [stream(t, value) for t, value in zip(stamps, y, strict=True)], 1)
        pairs.append((bare, public))
    bare, public = (statistics.median(times) for times in zip(*pairs, strict=True))
    print(f"  mean, few turns: Memory.inverse {1e6 * bare / len(y):.2f}, model.stream {1e6 * public / len(y):.2f}")
    return {"model.stream / Memory.inverse": public / bare}


def oscillation(turns: int, low: float = 0.0, high: float = SPAN) -> FloatArray:
    """Return 1,000,000 voltages (V) that oscillate between `low` and `high` with slowly decreasing amplitude."""
    share = np.cos(np.linspace(0.0, np.pi * turns, 1_000_000)) * np.linspace(0.98, 0.88, 1_000_000)
    return low + (high - low) / 2 * (1 - share)


def batch() -> dict[str, float]:
    """Print the speed of batch calculations relative to numpy.interp; return the times of the inverse over its time."""
    ratios = {}
    print("batch, 1,000,000 samples: numpy.interp, ms, and share of its speed")
    print("                                interp  forward  inverse  partly out of reach   branches of the samples")
    multi_slope = MultiSlope(0.0, SPAN, thresholds_for(SPAN), np.linspace(0.1, 1.0, 11) * 1e-8)
    plays = PrandtlIshlinskii(np.linspace(0.0, SPAN / 2, 30), np.full(30, 1e-8))
    for name, shape in (("slpi", loop_family()), ("mpi", multi_slope), ("pi", plays)):
        u, f = shape.branch(1, 0.0).knots
        for turns in (20, 200, 2000, 20000):
            v = oscillation(turns)
            y = wishes(shape, v)
            works = (
                lambda v=v, u=u, f=f: np.interp(v, u, f),
                lambda v=v, shape=shape: Memory(shape).forward_array(v),
                lambda y=y, shape=shape: Memory(shape).inverse_array(y),
                lambda y=y, shape=shape: Memory(shape).inverse_array(y, 0.2 * SPAN, 0.8 * SPAN),
                lambda v=v: trace(v, symmetric_rest=False),
            )
            bare, *spent = (median_time(work) for work in works)
            shares = "".join(f"{bare / each:11.0%}" for each in spent)
            print(f"  {name:<5} {turns:>6} turns {1e3 * bare:15.1f} {shares}")
            ratios[f"inverse / interp, {name}, {turns} turns"] = spent[1] / bare
            ratios[f"inverse partly out of reach / interp, {name}, {turns} turns"] = spent[2] / bare
    return ratios


def effects() -> dict[str, float]:
    """Print the times of `AxisModel.compensate` with each effect; return them relative to the bare inverse."""
    y = wishes(loop_family(), oscillation(200, 0.02 * SPAN, 0.98 * SPAN))
    base, t = axis_model(y), np.arange(y.size) / RATE
    y = 0.9 * y + 0.05 * y.max()
    bare = median_time(lambda: Memory(base.hysteresis).inverse_array(y))
    print(f"AxisModel.compensate, 1,000,000 samples, relative to the bare inverse ({1e3 * bare:.1f} ms)")
    ratios = {}
    for name, given in EFFECTS.items():
        model = replace(base, effects=given)
        model.compensate(t[:1000], y[:1000])
        ratio = median_time(lambda model=model: model.compensate(t, y), 3) / bare
        ratios[f"compensate / inverse, {name}"] = ratio
        print(f"  {name:<12} {ratio:6.1f}")
    return ratios


def commands() -> dict[str, float]:
    """Print the processor times of short commands; return them relative to the import of NumPy."""
    y = wishes(loop_family(), np.linspace(0.0, SPAN, 1000))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.json"
        slpi_ros.save_model(slpi_ros.StageModel({"x": axis_model(y)}), path)
        slpi = ("-m", "slpi_ros.cli")
        works = {
            "import numpy": ("-c", "import numpy"),
            "--help": (*slpi, "--help"),
            "show": (*slpi, "show", str(path)),
        }
        times = {name: processor_time(arguments) for name, arguments in works.items()}
    print("processor time of a command, s: " + ", ".join(f"{name} {spent:.2f}" for name, spent in times.items()))
    return {f"slpi {name} / import numpy": times[name] / times["import numpy"] for name in ("--help", "show")}


def processor_time(arguments: tuple[str, ...], repeats: int = 5) -> float:
    """Return the shortest processor time of a Python process, seconds, whose compiled sources are kept by Python."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    times = []
    for _ in range(repeats):
        process = subprocess.Popen([sys.executable, *arguments], stdout=subprocess.DEVNULL, env=environment)
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            sys.exit(f"{arguments} failed with exit code {process.returncode}")
        times.append(usage.ru_utime + usage.ru_stime)
    return min(times)


def cold_start() -> dict[str, float]:
    """Print the processor time that compilation adds to a first run; return it in units of the import of NumPy."""
    code = (
        f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r}); "
        "import engine, numpy as np; y = engine.wishes(engine.loop_family(), np.linspace(0.0, 100.0, 100_000)); "
        "t = np.arange(y.size) * 1e-3; m = engine.axis_model(y); "
        "[engine.replace(m, effects=e).compensate(t, y) for e in engine.EFFECTS.values()]"
    )
    with tempfile.TemporaryDirectory() as folder:
        os.environ["NUMBA_CACHE_DIR"] = folder
        cold, warm = processor_time(("-c", code), 1), processor_time(("-c", code), 1)
        del os.environ["NUMBA_CACHE_DIR"]
    print(f"compilation at the first run on a machine, all effects: {cold - warm:.1f} s")
    return {"compilation / import numpy": (cold - warm) / processor_time(("-c", "import numpy"))}


def growth() -> None:
    """Print how the time of the inverse grows with the number of samples, operators and turning points."""
    print("growth of the inverse, batch, ms")
    family = loop_family()
    for samples in (300, 1000, 10_000, 100_000, 1_000_000, 10_000_000):
        y = wishes(family, decaying(samples, max(samples // 5000, 2)))
        print(f"  {samples:>10,} samples {1e3 * median_time(lambda y=y: Memory(family).inverse_array(y), 3):10.2f}")
    for operators in (10, 100, 1000):
        thresholds = np.linspace(0.0, SPAN / 2, operators)
        model = PrandtlIshlinskii(thresholds, np.full(operators, 2e-7 / operators))
        y = wishes(model, decaying(100_000, 100))
        spent = median_time(lambda y=y, m=model: Memory(m).inverse_array(y))
        print(f"  {operators:>10,} play operators {1e3 * spent:10.2f}")
    for turns in (10, 100, 1000, 10_000):
        y = wishes(family, decaying(100_000, turns)).tolist()
        memory = Memory(family)
        spent = median_time(lambda y=y, m=memory: [m.inverse(value) for value in y], 1)
        print(f"  {memory.depth:>10,} turning points held, streaming: {1e6 * spent / len(y):8.2f} us per sample")


def main() -> dict[str, float]:
    """Print all results; return the times relative to those of a reference in the same run."""
    before = time.process_time()
    wishes(loop_family(), np.linspace(0.0, SPAN, 1_000_000))
    print(f"first long path of this process, s (more if it had to be compiled): {time.process_time() - before:.2f}")
    ratios = {**streaming(), **batch(), **effects(), **commands(), **cold_start()}
    growth()
    return ratios


if __name__ == "__main__":
    main()
