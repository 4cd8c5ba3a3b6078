"""Results of a diagnosis: its figures, and the JSON document."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from slpi_ros.arrays import FloatArray
from slpi_ros.diagnosis.fingerprint import Left
from slpi_ros.effects.base import Effect
from slpi_ros.effects.registry import to_document as effect_document
from slpi_ros.model.stage_model import StageModel

# The given model is out of date if its error exceeds that of a refitted one by this factor.
STALE = 1.5
# It is not out of date if its error equals that at its identification, within this factor.
AS_BEFORE = 1.1
# Thresholds for a changed stage: excess rms error as a share of the motion; relative change of gain; change of gain in
# standard deviations.
CHANGED, LEAST_CHANGE, CERTAIN = 1e-3, 3e-3, 5.0

SCHEMA = "slpi_ros/diagnosis/2"
NAMED, PARTLY_NAMED, AMBIGUOUS = "named", "partly_named", "ambiguous"
UNEXPLAINED, NOTHING_FOUND = "unexplained", "nothing_found"


@dataclass(frozen=True)
class NamedEffect:
    """Effect that explains part of the error, with its parameters and their standard deviations."""

    effect: Effect
    # Reduction of the held-out rms error when the effect is added to the preceding ones.
    gain_percent: float
    # Share of the mean square held-out error without effects that the effect explains, 0..1.
    share_of_residual: float
    # Probability that chance reduces the error as much, with the best of all effects that were tried.
    p_value: float
    # Effects that explain the error equally well, so that the records do not distinguish them.
    alternatives: tuple[str, ...]
    # What the effect does, in each record where it differs from record to record.
    description: str
    # What it does to the held-out error, beside other effects in its place.
    comparison: str

    @property
    def name(self) -> str:
        """The effect's name."""
        return self.effect.name

    @property
    def evidence(self) -> str:
        """One sentence with numbers: what the effect does, and what speaks for it."""
        return f"{self.description}; {self.comparison}"


@dataclass(frozen=True)
class Traces:
    """Signals of one axis for charts, (N,)."""

    t: FloatArray  # s, from the first stamp
    voltage: FloatArray  # V
    measured: FloatArray  # m
    before: FloatArray  # m, hysteresis without effects
    after: FloatArray  # m, with effects
    contributions: Mapping[str, FloatArray] = field(default_factory=dict)  # m, by effect


@dataclass(frozen=True)
class RecordOutcome:
    """Errors (m) of one record before and after the diagnosis."""

    source: str
    # Shift of the zero relative to the given model.
    offset: float
    # Free-run rms error of the given model and of the extended one, each without its mean.
    before_rms: float
    after_rms: float
    # With the hysteresis fitted to the other records; None if there are no others, or if these cover too little of it.
    left_out_rms: float | None

    def to_document(self) -> dict[str, Any]:
        """Return the record's part of the diagnosis document."""
        return {
            "source": self.source,
            "offset_m": self.offset,
            "before_rms_m": self.before_rms,
            "after_rms_m": self.after_rms,
            "left_out_rms_m": self.left_out_rms,
        }


@dataclass(frozen=True)
class AxisDiagnosis:
    """Diagnosis of the model of one axis."""

    # `before_rms` and `after_rms` are of the refitted hysteresis without and with effects, on held-out blocks or, if
    # there are several records, on held-out records.
    verdict: str  # `NAMED`, `PARTLY_NAMED`, `AMBIGUOUS`, `UNEXPLAINED` or `NOTHING_FOUND`
    summary: str  # a few sentences
    noise_rms: float  # m, sensor noise: the white part of the residual
    repeatability_rms: float  # m, how much repetitions of a motion differ, vibration and drift included
    repeatability_source: str  # what it was estimated from
    given_rms: float  # m, free-run, of the given model as it is, without the offset of each record
    before_rms: float  # m, held-out, free-run
    after_rms: float  # m, held-out, free-run
    effects: tuple[NamedEffect, ...]  # the largest gain first
    next_experiment: str | None  # recommended next recording or other action
    traces: Traces  # of the first record
    left: tuple[Left, ...] = ()  # variables that go with what is left, the largest share first
    records: tuple[RecordOutcome, ...] = ()
    surroundings: tuple[str, ...] = ()  # recorded quantities that were looked at
    dropped: tuple[str, ...] = ()  # found on some records, but do not carry over to others
    given: "Given | None" = None

    def to_document(self) -> dict[str, Any]:
        """Return the axis's part of the diagnosis document."""
        return {
            "verdict": self.verdict,
            "summary": self.summary,
            "floor_rms_m": self.noise_rms,
            "repeatability_rms_m": self.repeatability_rms,
            "repeatability_source": self.repeatability_source,
            "given_rms_m": self.given_rms,
            "before_rms_m": self.before_rms,
            "after_rms_m": self.after_rms,
            "left": [one.to_document() for one in self.left],
            "effects": [
                {
                    **effect_document(named.effect),
                    "gain_percent": named.gain_percent,
                    "share_of_residual": named.share_of_residual,
                    "p_value": named.p_value,
                    "alternatives": list(named.alternatives),
                    "evidence": named.evidence,
                }
                for named in self.effects
            ],
            "next_experiment": self.next_experiment,
            "records": [record.to_document() for record in self.records],
            "dropped": list(self.dropped),
            "looked_at": list(self.surroundings),
        }


@dataclass(frozen=True)
class Diagnosis:
    """Diagnosis of the model of a stage, by axis, with the names of the records."""

    axes: Mapping[str, AxisDiagnosis]
    # Model with the identified effects; hysteresis and effects are fitted jointly.
    extended: StageModel
    source: str = ""

    def to_document(self) -> dict[str, Any]:
        """Return the diagnosis document, ``msg_schemas/diagnosis.schema.json``."""
        return {
            "schema": SCHEMA,
            "source": self.source,
            "axes": {axis: found.to_document() for axis, found in self.axes.items()},
        }


@dataclass(frozen=True)
class Given:
    """Comparison of the given model with the records; errors in metres (rms), free-run."""

    # `hysteresis_rms` and `refitted_rms` are on samples to which the initial state only adds a constant; with the
    # identified effects if the error is then lower.
    hysteresis_rms: float  # of its hysteresis
    refitted_rms: float  # of a refitted one
    gain: float  # relative change of the gain of the stage
    gain_deviation: float  # standard deviation
    rms: float = 0.0  # of the model as it is, without the offset of each record
    zero_moved: float | None = None  # m, largest among the records; None: small, or due to the initial state
    motion: float = 0.0  # m, range of the measured displacement
    own_rms: float = 0.0  # at the identification of the model, if these are its records, else 0
    explained: bool = True  # whether a new fit leaves little, where the stage seems to have changed

    @property
    def changed(self) -> bool:
        """Whether the stage has changed since the model was identified: its loops or its gain no longer fit."""
        if not self.explained or (self.own_rms <= AS_BEFORE * self.rms and self.rms <= AS_BEFORE * self.own_rms):
            return False
        excess = np.sqrt(max(self.hysteresis_rms**2 - self.refitted_rms**2, 0.0))
        clear = self.hysteresis_rms > STALE * self.refitted_rms and excess > CHANGED * self.motion
        return bool(clear or (abs(self.gain) > LEAST_CHANGE and abs(self.gain) > CERTAIN * self.gain_deviation))
