"""The SLPI paper's Tables 2 to 5 as models, its headline percentages, and the drives of both papers.

The tables give no unit for the weights; they are taken for micrometres per volt.
"""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from slpi_ros.hysteresis.prandtl_ishlinskii import PrandtlIshlinskii
from slpi_ros.hysteresis.reversals import monotone_runs
from slpi_ros.hysteresis.slpi_published import SeparatedLoops, SingleLoop

FloatArray = NDArray[np.float64]

THRESHOLDS = (0.0, 5.0, 10.0, 15.0, 20.0, 25.0, 30.0, 35.0, 40.0, 45.0)
# Micrometres per volt, one for each threshold.
TABLE_2 = (0.02943, 0.01351, 0.00040, 0.00206, 0.00230, 0.00265, 0.00249, 0.00550, 0.02802, 0.09411)
TABLE_3 = (0.03151, 0.01298, 0.01092, 0.00445, 0.00648, 0.00000, 0.00148, 0.00016, 0.00051, 0.00100)
TABLE_4 = (0.04045, 0.00000, 0.00893, 0.00537, 0.00456, 0.01136, 0.00000, 0.00000, 0.00000, 0.00000)
TABLE_5 = (0.03040, 0.01116, 0.01516, 0.00478, 0.00000, 0.00000, 0.00823, 0.00057, 0.00000, 0.00000)
TABLES = {2: TABLE_2, 3: TABLE_3, 4: TABLE_4, 5: TABLE_5}

# By how much SLPI is better than classical PI, in per cent (section 4.1).
OUTER_MAXIMUM, HIGHEST_MEAN, SPREAD, OVERALL_MEAN = 10.0, 97.5, 53.7, 50.3


def table_model(number: int) -> PrandtlIshlinskii:
    """Return the PI model of Table 2 (level II), 3 (level I), 4 (level 0) or 5 (classical PI), volts to metres."""
    return PrandtlIshlinskii(np.array(THRESHOLDS), 1e-6 * np.array(TABLES[number]))


def table_loops(vertices: tuple[float, float], spans: tuple[float, float, float], *, at_rest: bool) -> SeparatedLoops:
    """Return the three loops of Tables 4, 3 and 2, each on the loop before it.

    Parameters
    ----------
    vertices : (float, float), volts
        Of the loops of level I and II; the paper does not print them.
    spans : (float, float, float), volts
        Of the loops of level 0, I and II.
    at_rest : bool
        As published; else the inner loops close.
    """
    outer = _loop(4, 0, 1, (0.0, 0.0), spans[0], None)
    run_in = None if at_rest else 0.0
    first_vertex = vertices[0], outer.memory().forward(vertices[0])
    first = _loop(3, 1, -1, first_vertex, spans[1], run_in)
    way_back = first.memory()
    # Down to the turn, and up again to the next vertex.
    way_back.forward(spans[1])
    second_vertex = vertices[1], first_vertex[1] - way_back.forward(vertices[0] - vertices[1])
    return SeparatedLoops((outer, first, _loop(2, 2, -1, second_vertex, spans[2], run_in)))


def _loop(
    table: int, level: int, direction: int, vertex: tuple[float, float], span: float, run_in: float | None
) -> SingleLoop:
    model = table_model(table)
    height = SingleLoop(level, direction, vertex, (span, 1.0), (0.0, 0.0), model, run_in).memory().forward(span)
    return SingleLoop(level, direction, vertex, (span, height), (0.0, 0.0), model, run_in)


def ramps(turns: Sequence[float], step: float) -> FloatArray:
    """Return straight ramps through turning points, a sample every `step`; every turn is a sample too.

    Parameters
    ----------
    turns : sequence of float
        Neighbours differ.
    step : float
        In the unit of `turns`.

    Returns
    -------
    ndarray, shape (N,)
    """
    parts = [np.append(np.arange(a, b, step if b > a else -step)[1:], b) for a, b in pairwise(turns)]
    return np.concatenate([np.array([turns[0]], dtype=np.float64), *parts])


def triangles(amplitude: float, frequency: float, cycles: int, samples: int = 2000) -> tuple[FloatArray, FloatArray]:
    """Return a triangle wave from 0 to `amplitude` and back.

    Parameters
    ----------
    amplitude : float, volts or metres
    frequency : float, hertz
    cycles : int
    samples : int
        In one cycle; even.

    Returns
    -------
    t : ndarray, shape (cycles * samples,), seconds
    x : ndarray, shape (cycles * samples,), in the unit of `amplitude`
    """
    k = np.arange(cycles * samples)
    phase = (k % samples) / samples
    return k / (samples * frequency), amplitude * (1.0 - np.abs(2.0 * phase - 1.0))


def straight_between_reversals(x: FloatArray, at: FloatArray) -> FloatArray:
    """Return `x`, shape (N,), made a straight line over `at`, shape (N,), between neighbouring reversals of `at`."""
    path = x.copy()
    for a, b in pairwise(stop - 1 for _, stop in monotone_runs(at)):
        path[a : b + 1] = x[a] + (x[b] - x[a]) * (at[a : b + 1] - at[a]) / (at[b] - at[a])
    return path
