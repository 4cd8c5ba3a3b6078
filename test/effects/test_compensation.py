"""A stage with an effect, compensated sample by sample by a model that knows it, against the same stage without it.

The stage's physics is none of the model's code. Its hysteresis is identified on the stage without the effect. Run with
``-s`` to see the figures.
"""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import slpi_ros
from benchmarks.paths import scan_path
from slpi_ros.effects.creep import Creep
from slpi_ros.effects.cross_coupling import CrossCoupling
from slpi_ros.effects.filters import Mode
from slpi_ros.effects.lag import Lag
from slpi_ros.effects.resonance import Resonance
from slpi_ros.excitation.drives import calibration_drive
from slpi_ros.model.stage_model import StageModel
from slpi_ros.simulation import dynamics as physics
from slpi_ros.simulation.axis import SimulatedAxis
from slpi_ros.simulation.character import Character
from slpi_ros.simulation.parameters import AxisParameters

AXES = ("x", "y")
RATE, DURATION = 500.0, 12.0
# Of the motion of the other axis; the axes do it to each other.
COUPLING = {"x": 0.03, "y": -0.02}

SLOW = physics.Creep(0.02, 1e-2, 1e3)
CREEP = Creep(tuple(SLOW.time_constants.tolist()), tuple(SLOW.gains.tolist()))
CREEPING = {"creep": 0.02, "creep_shortest": 1e-2, "creep_longest": 1e3}
LAG, LAGGING = Lag(0.015), {"lag": 0.015}
MODE, RINGING = Resonance((Mode(80.0, 0.03),)), {"resonance": 80.0, "damping": 0.03}
CASES = {
    "creep": ((CREEP,), CREEPING),
    "lag": ((LAG,), LAGGING),
    "resonance": ((MODE,), RINGING),
    "coupling": ((), {}),
    "creep, lag, resonance": ((CREEP, LAG, MODE), CREEPING | LAGGING | RINGING),
    "creep, lag, resonance, coupling": ((CREEP, LAG, MODE), CREEPING | LAGGING | RINGING),
}


def stage(place: int, **effects: float) -> SimulatedAxis:
    return SimulatedAxis(AxisParameters.random(11 + place), place, Character(**effects))


@cache
def identified() -> tuple[StageModel, dict[str, tuple[float, float]]]:
    """Return the model of the stage without effects, and where its paths may go (m)."""
    t, v = calibration_drive(0.0, 100.0, duration=30.0, rate=200.0, seed=3)
    measured, reach = {}, {}
    for place, name in enumerate(AXES):
        true, measured[name] = stage(place).run(t, v)
        reach[name] = 0.2 * true.max(), 0.9 * true.max()
    stamps = np.round(t * 1e9).astype(np.int64)
    return slpi_ros.identify(slpi_ros.Record(stamps, dict.fromkeys(AXES, v), measured, "calibration")), reach


@cache
def wishes(smooth: bool) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return paths that no calibration has seen: smooth ones, or ramps with sharp corners and rests."""
    reach, paths = identified()[1], {}
    for place, name in enumerate(AXES):
        t, path = scan_path(*reach[name], duration=DURATION, rate=RATE, seed=place)
        if not smooth:
            corners = np.arange(0.0, DURATION, 0.5)
            path = np.interp(t, corners + 0.1 * (np.arange(corners.size) % 2), np.interp(corners, t, path))
        paths[name] = path
    return t, paths


def achieved(model: StageModel, stages: dict[str, SimulatedAxis], coupled: bool, smooth: bool) -> dict[str, np.ndarray]:
    """Return the errors of the real displacement, metres, from one second on."""
    t, desired = wishes(smooth)
    stream, real = model.streams(start_memory="start"), {name: np.empty(t.size) for name in AXES}
    for k, now in enumerate(t.tolist()):
        voltage = stream.step(now, {name: float(path[k]) for name, path in desired.items()})
        for name in AXES:
            real[name][k] = stages[name].step(now, voltage[name])
    rests = {name: stages[name].parameters.offset for name in AXES}
    seen = {
        name: real[name] + coupled * COUPLING[name] * (real[other] - rests[other]) for name, other in (AXES, AXES[::-1])
    }
    return {name: (seen[name] - desired[name])[int(RATE) :] for name in AXES}


def rms(error: np.ndarray) -> float:
    return float(np.sqrt(np.mean(error**2)))


@cache
def without(smooth: bool) -> dict[str, np.ndarray]:
    return achieved(identified()[0], {name: stage(place) for place, name in enumerate(AXES)}, False, smooth)


@pytest.mark.parametrize("smooth", [pytest.param(True, marks=pytest.mark.long), False], ids=["smooth", "corners"])
@pytest.mark.parametrize("case", CASES)
def test_what_is_known_is_compensated(case, smooth):
    effects, physical = CASES[case]
    coupled = "coupling" in case
    bare, _ = identified()
    axes = {}
    for name, other in (AXES, AXES[::-1]):
        shared = (CrossCoupling({other: COUPLING[name]}),) if coupled else ()
        axes[name] = replace(bare.axes[name], effects=(*effects, *shared))

    def run(model):
        return achieved(model, {name: stage(place, **physical) for place, name in enumerate(AXES)}, coupled, smooth)

    clean, known, ignored = without(smooth), run(StageModel(axes)), run(bare)
    for name in AXES:
        figures = [rms(errors[name]) * 1e9 for errors in (clean, known, ignored)]
        print(f"{case}, {'smooth' if smooth else 'corners'}, {name}: without it, known, ignored", np.round(figures, 1))
    # Both axes together: how good an identified model is differs from place to place.
    ratio, before = (rms(both(errors)) / rms(both(clean)) for errors in (known, ignored))
    print(f"{case}, {'smooth' if smooth else 'corners'}: times {ratio:.2f}, ignored {before:.1f}")
    assert ratio <= 2.0
    # A smooth path makes nothing ring.
    assert before > 1.5 * ratio or (case == "resonance" and smooth)


def both(errors: dict[str, np.ndarray]) -> np.ndarray:
    return np.concatenate(list(errors.values()))
