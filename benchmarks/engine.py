"""Speed of the engine: per sample while streaming, and as a share of ``numpy.interp`` in batch; how it grows."""

import statistics
import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from slpi_ros.hysteresis.loop_family import LoopFamily
from slpi_ros.hysteresis.prandtl_ishlinskii import PrandtlIshlinskii
from slpi_ros.hysteresis.turning_points import Memory, Shape

FloatArray = NDArray[np.float64]
SPAN = 100.0


def loop_family(vertices: int = 41) -> LoopFamily:
    """Return a loop family with bias-dependent loops."""
    grid = np.linspace(0.0, SPAN, vertices)
    alpha, beta = np.meshgrid(grid, grid, indexing="ij")
    u = np.maximum(alpha - beta, 0.0)
    surface = 1e-6 * (0.15 * u + 5e-4 * u**2 * (1 + 0.002 * (alpha + beta)))
    return LoopFamily(grid, surface, 1e-6 * (0.2 * grid + 5e-4 * grid**2), 2e-7)


def zigzag(samples: int, every: int, seed: int = 0) -> FloatArray:
    """Return voltages that turn every `every` samples at random places, shape (samples,)."""
    corners = np.random.default_rng(seed).uniform(0.02 * SPAN, 0.98 * SPAN, samples // every + 2)
    corners[1::2], corners[::2] = np.maximum(corners[1::2], SPAN / 2), np.minimum(corners[::2], SPAN / 2)
    return np.interp(np.arange(samples) / every, np.arange(corners.size), corners)


def decaying(samples: int, turns: int) -> FloatArray:
    """Return a decaying oscillation, which fills the memory with turning points, shape (samples,)."""
    phase = np.linspace(0.0, np.pi * turns, samples)
    return SPAN / 2 * (1 - np.cos(phase) * (1 - phase / phase[-1]))


def per_sample(step: Callable[[float], float], values: list[float]) -> tuple[float, float, float]:
    """Return median, 99.9th percentile and maximum time of one step, microseconds, without that of the clock."""
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
    """Return the median time of some work, seconds."""
    times = []
    for _ in range(repeats):
        before = time.perf_counter()
        work()
        times.append(time.perf_counter() - before)
    return statistics.median(times)


def wishes(shape: Shape, v: FloatArray) -> FloatArray:
    """Return the displacements of voltages, shape (N,), metres."""
    return Memory(shape).forward_array(v)


def streaming() -> None:
    """Print times of the streaming inverse."""
    print("streaming inverse, microseconds per sample      median   p99.9     max")
    for every in (10, 100):
        for name, shape in (("slpi, 41 vertices", loop_family()), ("slpi, 161 vertices", loop_family(161))):
            path = wishes(shape, zigzag(200_000, every)).tolist()
            numbers = per_sample(Memory(shape).inverse, path)
            print(f"  {name:<20} a turn every {every:>3} samples {numbers[0]:8.2f} {numbers[1]:7.1f} {numbers[2]:7.0f}")


def batch() -> None:
    """Print times of the batch paths beside numpy.interp."""
    family = loop_family()
    print("batch, 1,000,000 samples, ms            forward  inverse  numpy.interp   share of its speed")
    knots, values = family.grid, family.everett[:, 0]
    for turns in (20, 200, 2000, 20000):
        v = (
            SPAN
            / 2
            * (1 - 0.98 * np.cos(np.linspace(0.0, np.pi * turns, 1_000_000)) * np.linspace(1.0, 0.9, 1_000_000))
        )
        y = wishes(family, v)
        forward = median_time(lambda v=v: Memory(family).forward_array(v))
        inverse = median_time(lambda y=y: Memory(family).inverse_array(y))
        bare = median_time(lambda v=v: np.interp(v, knots, values))
        print(
            f"  {turns:>6} turns {1e3 * forward:30.1f} {1e3 * inverse:8.1f} {1e3 * bare:13.1f}"
            f" {bare / forward:12.0%} {bare / inverse:6.0%}"
        )


def growth() -> None:
    """Print how the inverse's time grows."""
    print("growth of the inverse, batch, ms")
    family = loop_family()
    for samples in (10_000, 100_000, 1_000_000, 10_000_000):
        y = wishes(family, decaying(samples, samples // 5000))
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


def main() -> None:
    """Print all."""
    streaming()
    batch()
    growth()


if __name__ == "__main__":
    main()
