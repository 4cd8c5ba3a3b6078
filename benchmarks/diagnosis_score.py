"""One case of the benchmark of the diagnosis: hide effects, identify, diagnose, and compare with the truth."""

import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from hidden import Hidden, Truth, calibration_of, hide
from hidden.size import beyond_hysteresis

import slpi_ros
from slpi_ros.io.bag_writer import write_bag


@dataclass(frozen=True)
class Case:
    """Effects to hide; `group` is the table to which the case belongs."""

    group: str
    seed: int
    effects: tuple[str, ...] = ()
    base: str | None = None
    size: float | None = None
    second_record: bool = False


@dataclass(frozen=True)
class AxisOutcome:
    """Diagnosis of one axis, and the truth."""

    verdict: str
    named: tuple[str, ...]
    alternatives: tuple[tuple[str, ...], ...]
    truth: tuple[str, ...]
    sizes: tuple[float, ...]
    gain: float
    true_gain: float
    errors: Mapping[tuple[str, str], float]
    summary: str

    @property
    def first_right(self) -> bool:
        return bool(self.named) and self.named[0] in self.truth

    @property
    def first_among(self) -> bool:
        """Whether the first named effect, or one of its alternatives, is a true one."""
        return bool(self.named) and bool({self.named[0], *self.alternatives[0]} & set(self.truth))

    @property
    def all_named(self) -> bool:
        return set(self.truth) <= set(self.named)

    @property
    def alarm(self) -> bool:
        """Whether an effect was named although there is none (false alarm)."""
        return not self.truth and bool(self.named)


@dataclass(frozen=True)
class Outcome:
    """Result of a case; `failure` is an error message, or states that the case could not be drawn."""

    case: Case
    axes: Mapping[str, AxisOutcome] = field(default_factory=dict)
    samples: int = 0
    seconds: float = 0.0
    failure: str = ""

    @property
    def victim(self) -> AxisOutcome | None:
        return next((axis for axis in self.axes.values() if axis.truth), None)


def run(case: Case) -> Outcome:
    """Hide effects, write a bag, identify and diagnose from this bag, and compare with the truth."""
    try:
        hidden = hide(case.seed, case.effects, base=case.base, size=case.size)
    except RuntimeError as error:
        return Outcome(case, failure=f"not drawn: {error}")
    try:
        return _diagnosed(case, hidden)
    except slpi_ros.SlpiError as error:
        return Outcome(case, samples=len(hidden.record), failure=f"refused: {error}")
    # One failing case must not end a run of several hours; it is printed and counts as not found.
    except Exception as error:
        return Outcome(case, samples=len(hidden.record), failure=f"{type(error).__name__}: {error}")


def _diagnosed(case: Case, hidden: Hidden) -> Outcome:
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(folder) / "bag"
        write_bag(bag, hidden.record)
        model = slpi_ros.identify(calibration_of(hidden) if case.second_record else slpi_ros.read_bag(bag))
        began = time.perf_counter()
        diagnosis = slpi_ros.diagnose(slpi_ros.read_bag(bag), model)
        seconds = time.perf_counter() - began
    axes = {axis: _compared(hidden, axis, found) for axis, found in diagnosis.axes.items()}
    return Outcome(case, axes, len(hidden.record), seconds)


def _compared(hidden: Hidden, axis: str, found) -> AxisOutcome:
    truth = tuple(each for each in hidden.truth if each.axis == axis)
    named = tuple(each.effect.name for each in found.effects)
    best = _best_rms(hidden, axis, truth) if truth else found.before_rms
    errors: dict[tuple[str, str], float] = {}
    for each in truth:
        if each.name in named:
            effect = found.effects[named.index(each.name)].effect
            wrong = parameter_errors(each, effect, hidden)
            contribution = found.traces.contributions.get(each.name)
            if contribution is not None:
                seen = np.isin(hidden.record.t, found.traces.t)
                wrong["contribution"] = contribution_error(
                    hidden.record.voltage[axis][seen], contribution, each.contribution[seen]
                )
            errors |= {(each.name, parameter): error for parameter, error in wrong.items()}
    return AxisOutcome(
        verdict=found.verdict,
        named=named,
        alternatives=tuple(tuple(each.alternatives) for each in found.effects),
        truth=tuple(each.name for each in truth),
        sizes=tuple(each.size_over_floor for each in truth),
        gain=100.0 * (1.0 - found.after_rms / found.before_rms),
        true_gain=100.0 * (1.0 - best / found.before_rms),
        errors=errors,
        summary=found.summary,
    )


def _best_rms(hidden: Hidden, axis: str, truth: tuple[Truth, ...]) -> float:
    """Return the held-out rms (m) of a hysteresis fitted to the readings without the true effects."""
    reading = hidden.record.displacement[axis] - (hidden.reading[axis] - hidden.clean[axis])
    without = replace(hidden.record, voltage={axis: hidden.record.voltage[axis]}, displacement={axis: reading})
    return float(slpi_ros.identify(without).axes[axis].quality.held_out_rms)


def contribution_error(v, found, truth) -> float:
    """Return the relative rms error of a contribution, without the parts that hysteresis can explain."""
    return beyond_hysteresis(v, found - truth) / beyond_hysteresis(v, truth)


def parameter_errors(truth: Truth, effect, hidden: Hidden) -> dict[str, float]:
    """Return the relative errors by parameter name; a list of knots or relaxations has one error.

    ``saturation``: relative to the voltage that is cut off. ``creep``: step response from 0.1 s to half of the record.
    ``gain_drift``, ``thermal_drift``, ``steps``: course in time, without its mean. ``wave``: the sine, including its
    phase.
    """
    true, t = truth.parameters, hidden.record.t
    if truth.name in ("resonance", "hum"):
        # The true stage has one mode, or one line.
        found = effect.modes if truth.name == "resonance" else effect.lines
        effect = min(found, key=lambda one: abs(one.frequency - true["frequency"]))
    v = hidden.record.voltage[truth.axis]
    match truth.name:
        case "saturation":
            cut = {"upper": v.max() - true["upper"], "lower": true.get("lower", 0.0) - v.min()}
            return {end: abs(_number(getattr(effect, end)) - true[end]) / cut[end] for end in true}
        case "cross_coupling":
            return {
                "gains": max(_relative(effect.gains.get(other, 0.0), gain) for other, gain in true["gains"].items())
            }
        case "creep":
            times = np.geomspace(0.1, t[-1] / 2, 40)
            return {"response": _mismatch(*(_after_a_step(each, times) for each in (effect, true)))}
        case "gain_drift":
            return {"course": _mismatch(*(_course(each, t) for each in (effect, true)))}
        case "thermal_drift":
            return {"path": _mismatch(*(_path(each, t) for each in (effect, true)))}
        case "steps":
            return {"path": _mismatch(*(_stairs(each, t) for each in (effect, true)))}
        case "sensor_periodic" | "hum":
            scale = "period" if truth.name == "sensor_periodic" else "frequency"
            wave = _mismatch(*(_wave(each, scale, hidden.clean[truth.axis], t) for each in (effect, true)))
            return {name: _relative(getattr(effect, name), true[name]) for name in (scale, "amplitude")} | {
                "wave": wave
            }
        case _:
            return {name: _relative(getattr(effect, name), value) for name, value in true.items()}


def _relative(found: float, true: float) -> float:
    return abs(found / true - 1.0)


def _number(limit: float | None) -> float:
    return np.inf if limit is None else float(limit)


def _mismatch(found, true) -> float:
    true = true - true.mean()
    return float(np.linalg.norm(found - found.mean() - true) / np.linalg.norm(true))


def _of(source, name: str):
    return source[name] if isinstance(source, Mapping) else getattr(source, name)


def _after_a_step(source, times):
    given = isinstance(source, Mapping)
    taus, gains = (np.array(source[name]) for name in ("time_constants", "gains")) if given else source.chain
    return -np.exp(-times[:, None] / taus) @ gains


def _path(source, t):
    return np.interp(t, _of(source, "times"), _of(source, "values"))


def _stairs(source, t):
    return np.cumsum((0.0, *_of(source, "sizes")))[np.searchsorted(_of(source, "times"), t)]


def _course(source, t):
    return np.interp(t, (0.0, *_of(source, "times")), (0.0, *_of(source, "gains")))


def _wave(source, scale: str, y, t):
    turns = y / _of(source, "period") if scale == "period" else t * _of(source, "frequency")
    return _of(source, "amplitude") * np.sin(2 * np.pi * turns + _of(source, "phase"))
