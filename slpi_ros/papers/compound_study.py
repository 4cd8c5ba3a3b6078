"""Feedforward and compound control as in the MPI paper, on one axis of a simulated stage like its own."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from slpi_ros.compensator.feedback import Feedback, PidGains
from slpi_ros.hysteresis.multi_slope import AmplitudeScaled, cycles
from slpi_ros.identification.fit import identify
from slpi_ros.identification.metrics import ErrorMetrics, error_metrics
from slpi_ros.model.stage_model import AxisModel, Start
from slpi_ros.model.stream import Limits
from slpi_ros.papers.mpi_published import TABLE_6
from slpi_ros.papers.mpi_study import FAMILY, SMPI, triangle_record
from slpi_ros.papers.paths import triangles
from slpi_ros.reports.plots import Run
from slpi_ros.simulation.parameters import StageParameters
from slpi_ros.simulation.preisach import PreisachStage

FloatArray = NDArray[np.float64]

# Samples per second of the controller.
RATE = 2000.0
# Volts: what the stage takes (paper, 2.1).
LIMITS = Limits(-20.0, 150.0)
# Volts of the record that models are identified on, at 1 Hz, 500 samples per cycle: 100 µm need more than the nominal
# 120 V. The first cycle wipes the memory and is not fitted.
RECORD, RECORD_SAMPLES = (150, 150, 150, 140, 120, 100, 80, 60, 40, 20), 500
# Cycles at 1 Hz before a path; where they end is the sensor's zero. Where a rest follows, it takes this long, seconds.
WARM_UP, REST = 2, 2.0
# Fig. 11, volts; its path has the peak that the record has at this voltage.
FEEDFORWARD_VOLTAGE = 80
# Shares of the gains at which the loop gain would reach 1 at the flexure's mode.
INTEGRAL_SHARE, PROPORTIONAL_SHARE = 1 / 3, 1 / 10

KINDS = {SMPI: "smpi", FAMILY: "slpi"}


@dataclass(frozen=True)
class Outcome:
    """A path followed.

    Parameters
    ----------
    desired : ndarray, shape (N,), metres
    measured : ndarray, shape (N,), metres
        What the sensor read.
    displacement : ndarray, shape (N,), metres
        What the stage did.
    """

    desired: FloatArray
    measured: FloatArray
    displacement: FloatArray

    @property
    def read(self) -> ErrorMetrics:
        """Errors by the sensor."""
        return error_metrics(self.desired, self.measured)

    @property
    def done(self) -> ErrorMetrics:
        """Errors of the stage itself."""
        return error_metrics(self.desired, self.displacement)

    @property
    def offset(self) -> float:
        """Mean error by the sensor, signed, metres."""
        return float(np.mean(self.measured - self.desired))

    @property
    def scatter(self) -> float:
        """Standard deviation of the error by the sensor, metres."""
        return float(np.std(self.measured - self.desired))

    @property
    def peaks(self) -> FloatArray:
        """Largest reading of each cycle, shape (c,), metres."""
        return np.array([self.measured[a : b + 1].max() for a, b in cycles(self.desired, 0.0)])

    def within(self, band: float) -> float:
        """Return the share of readings that are within `band` (m) of what was desired."""
        return float(np.mean(np.abs(self.measured - self.desired) <= band))

    def run(self, name: str) -> Run:
        """Return the readings as a run to be drawn."""
        return Run(name, np.arange(self.desired.size) / RATE, self.desired, self.measured)


@dataclass(frozen=True)
class AxisStudy:
    """What one axis did.

    Parameters
    ----------
    gains : PidGains
    feedforward : mapping of model to Outcome
        Fig. 11.
    compound : mapping of (model or "", whether with PID) to Outcome
        Fig. 13.
    rested : mapping of model to Outcome
        The same with PID, after a rest at 0 V that ends with setting the zero.
    """

    gains: PidGains
    feedforward: Mapping[str, Outcome]
    compound: Mapping[tuple[str, bool], Outcome]
    rested: Mapping[str, Outcome]


def run_study(axis: PreisachStage, name: str, path_cycles: int = 3) -> AxisStudy:
    """Identify models of an axis and let it follow the paths of Fig. 11 and of Table 6, `path_cycles` of each part."""
    record = triangle_record(axis, name, RECORD, 1.0, RECORD_SAMPLES)
    models = {label: _warm(identify(record, kind, start=1.0).axis(name)) for label, kind in KINDS.items()}
    smpi = models[SMPI].hysteresis
    assert isinstance(smpi, AmplitudeScaled)
    gains = tune(axis.parameters, smpi.peak(max(RECORD)) / max(RECORD))
    single = path([(smpi.peak(FEEDFORWARD_VOLTAGE), 1.0)], path_cycles)
    segments = path([(peak * 1e-6, frequency) for peak, frequency in TABLE_6], path_cycles)
    voltages = {
        label: model.compensate(np.arange(segments.size) / RATE, segments)[0] for label, model in models.items()
    }
    voltages[""] = np.zeros(segments.size)

    def compound(label: str, fed_back: bool, rest: float = 0.0) -> Outcome:
        return follow(axis, segments, voltages[label], gains if fed_back else None, max(RECORD), rest)

    return AxisStudy(
        gains,
        feedforward={
            label: follow(
                axis, single, model.compensate(np.arange(single.size) / RATE, single)[0], None, FEEDFORWARD_VOLTAGE
            )
            for label, model in models.items()
        },
        compound={way: compound(*way) for way in (("", True), *product(models, (False, True)))},
        rested={label: compound(label, True, REST) for label in models},
    )


def path(parts: Sequence[tuple[float, float]], path_cycles: int) -> FloatArray:
    """Return triangles, shape (N,), metres, of peaks (m) and frequencies (Hz), at the controller's rate, up to 0."""
    waves = [triangles(peak, frequency, path_cycles, 2 * round(RATE / frequency / 2))[1] for peak, frequency in parts]
    return np.append(np.concatenate(waves), 0.0)


def tune(stage: StageParameters, gain: float) -> PidGains:
    """Return gains for an axis with a lightly damped mode, ``w`` and ``z``, and a static gain ``g`` (m/V).

    At the mode the stage answers with ``g / 2z``, so integral action alone would make the loop gain 1 there with ``K_i
    = 2 z w / g``, proportional action with ``K_p = 2 z / g``. With a third of one and a tenth of the other it stays
    below 0.35 whatever the phase, and so whatever lag and delay there are. Derivative action would raise it.

    Parameters
    ----------
    stage : StageParameters
        Of which the frequency and damping of the mode are used, as a ring-down shows them.
    gain : float, metres per volt
    """
    omega, double_damping = 2.0 * math.pi * stage.resonance_frequency, 2.0 * stage.resonance_damping
    return PidGains(PROPORTIONAL_SHARE * double_damping / gain, INTEGRAL_SHARE * double_damping * omega / gain)


def follow(
    axis: PreisachStage,
    desired: FloatArray,
    feedforward: FloatArray,
    gains: PidGains | None,
    warm_up: float,
    rest: float = 0.0,
) -> Outcome:
    """Warm an axis up, set the sensor's zero, and let the axis follow a path.

    A voltage is reached one sample after it is given. The path is known, so the feedforward is given one sample ahead.

    Parameters
    ----------
    axis : PreisachStage
    desired : ndarray, shape (N,), metres
        From 0.
    feedforward : ndarray, shape (N,), volts
    gains : PidGains or None
        None: no feedback.
    warm_up : float, volts
        Amplitude of the cycles before.
    rest : float, seconds
        Time at 0 V between them and the zero.
    """
    axis.rest()
    v = np.append(triangles(warm_up, 1.0, WARM_UP, round(RATE))[1], np.zeros(1 + round(rest * RATE)))
    displacement, readings = axis.run(np.arange(v.size) / RATE, v)
    zero, y = float(readings[-1]), float(displacement[-1])
    control = Feedback(gains or PidGains(0.0), LIMITS)
    if gains:
        control.enable()
    reading, done, read = 0.0, np.empty_like(desired), np.empty_like(desired)
    ahead = np.append(feedforward[1:], feedforward[-1])
    for k, (wish, v_ahead) in enumerate(zip(desired.tolist(), ahead.tolist(), strict=True)):
        done[k], read[k] = y - zero, reading
        voltage = control.correct(k / RATE, wish, reading, v_ahead)
        y = axis.step((v.size + k) / RATE, voltage)
        reading = axis.measure(y) - zero
    return Outcome(desired, read, done)


def _warm(model: AxisModel) -> AxisModel:
    """Let a model start at 0 V and at the sensor's zero, where a long fall has led."""
    return replace(model, start=Start(0.0, 0.0, (0.0,) if model.causal else ()))
