"""What a diagnosis says, for the page and for the document."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slpi_ros.effects.base import Effect
from slpi_ros.effects.registry import to_document as effect_document
from slpi_ros.model.stage_model import StageModel

FloatArray = NDArray[np.float64]

SCHEMA = "slpi_ros/diagnosis/1"
NAMED, AMBIGUOUS, UNEXPLAINED, NOTHING_FOUND = "named", "ambiguous", "unexplained", "nothing_found"


@dataclass(frozen=True)
class NamedEffect:
    """An effect that explains part of the error.

    Parameters
    ----------
    effect : Effect
        With its parameters, and their standard deviations.
    gain_percent : float
        By how much it lowers the held-out rms error, added to the effects before it.
    share_of_residual : float
        Share of the mean square error before any effect, held out, that it explains, 0..1.
    p_value : float
        How often chance would gain as much.
    alternatives : tuple of str
        Effects that would do in its place: the record does not tell them apart.
    evidence : str
        One sentence with numbers.
    """

    effect: Effect
    gain_percent: float
    share_of_residual: float
    p_value: float
    alternatives: tuple[str, ...]
    evidence: str

    @property
    def name(self) -> str:
        """The effect's name."""
        return self.effect.name


@dataclass(frozen=True)
class Traces:
    """One axis over the record, for plots.

    Parameters
    ----------
    t : ndarray, shape (N,), seconds
        From the first stamp.
    voltage : ndarray, shape (N,), volts
    measured, before, after : ndarray, shape (N,), metres
        Measured displacement; that of the hysteresis alone, and with effects.
    contributions : mapping of effect name to ndarray, shape (N,), metres
        What each effect does to the displacement.
    """

    t: FloatArray
    voltage: FloatArray
    measured: FloatArray
    before: FloatArray
    after: FloatArray
    contributions: Mapping[str, FloatArray] = field(default_factory=dict)


@dataclass(frozen=True)
class AxisDiagnosis:
    """What one axis's model gets wrong, and why.

    Parameters
    ----------
    verdict : str
        `NAMED`, `AMBIGUOUS`, `UNEXPLAINED` or `NOTHING_FOUND`.
    summary : str
        The same in a sentence or two.
    floor_rms : float, metres
        What no model can explain.
    floor_source : str
        Where that was seen.
    given_rms : float, metres
        Error of the given model as it is, free-run from its own start, but for the displacement at rest.
    before_rms, after_rms : float, metres
        Error on blocks left out, free-run: of the hysteresis fitted to this record, and of hysteresis and effects.
    effects : tuple of NamedEffect
        In the order of gain.
    next_experiment : str or None
        What to record, or to do, next.
    traces : Traces
    """

    verdict: str
    summary: str
    floor_rms: float
    floor_source: str
    given_rms: float
    before_rms: float
    after_rms: float
    effects: tuple[NamedEffect, ...]
    next_experiment: str | None
    traces: Traces

    def to_document(self) -> dict[str, Any]:
        """Return the axis's part of the diagnosis document."""
        return {
            "verdict": self.verdict,
            "summary": self.summary,
            "floor_rms_m": self.floor_rms,
            "floor_source": self.floor_source,
            "given_rms_m": self.given_rms,
            "before_rms_m": self.before_rms,
            "after_rms_m": self.after_rms,
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
        }


@dataclass(frozen=True)
class Diagnosis:
    """What a model gets wrong on a record.

    Parameters
    ----------
    axes : mapping of axis name to AxisDiagnosis
    extended : StageModel
        The model with the effects found, hysteresis and effects fitted together.
    source : str
        The record.
    """

    axes: Mapping[str, AxisDiagnosis]
    extended: StageModel
    source: str = ""

    def to_document(self) -> dict[str, Any]:
        """Return the diagnosis document, ``msg_schemas/diagnosis.schema.json``."""
        return {
            "schema": SCHEMA,
            "source": self.source,
            "axes": {axis: found.to_document() for axis, found in self.axes.items()},
        }
