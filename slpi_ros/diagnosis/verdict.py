"""The verdict of a diagnosis of one axis: from the answer to the result."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from slpi_ros.diagnosis.answer import Answer, Named
from slpi_ros.diagnosis.effect_parameters import EachRecord
from slpi_ros.diagnosis.fingerprint import Signals, fingerprint
from slpi_ros.diagnosis.joint_fit import JointFit
from slpi_ros.diagnosis.result import (
    AMBIGUOUS,
    NAMED,
    NOTHING_FOUND,
    PARTLY_NAMED,
    UNEXPLAINED,
    AxisDiagnosis,
    Given,
    NamedEffect,
    RecordOutcome,
    Traces,
)
from slpi_ros.diagnosis.sentences import comparison_of, next_experiment, summary_of
from slpi_ros.diagnosis.structures import BIAS
from slpi_ros.effects.base import Effect
from slpi_ros.identification.repeatability import Repeatability
from slpi_ros.model.axis_model import ABOVE_NOISE


def judged(
    answer: Answer,
    signals: Sequence[Signals],
    noise_rms: float,
    repeatability: Repeatability,
    before_rms: float,
    given: Given,
    records: tuple[RecordOutcome, ...],
    driven_alike: Sequence[str],
) -> AxisDiagnosis:
    """Return the diagnosis of one axis; `noise_rms` is that of the sensor, `before_rms` the held-out error (m).

    `signals` hold what is left, of which the fingerprint is taken.
    """
    # `driven_alike` are other axes with the same drive as this one.
    base, now = answer.base, answer.now
    effects = _named_effects(answer)
    verdict = _verdict(answer, effects, noise_rms)
    found = AxisDiagnosis(
        verdict=verdict,
        summary="",
        noise_rms=noise_rms,
        repeatability_rms=repeatability.rms,
        repeatability_source=repeatability.source,
        given_rms=given.rms,
        before_rms=before_rms,
        after_rms=now.held_out.rms,
        effects=effects,
        next_experiment=None,
        traces=_traces(base, now),
        left=fingerprint(signals),
        records=records,
        surroundings=tuple(now.evidence.surroundings),
        dropped=answer.dropped,
        given=given,
    )
    return replace(
        found,
        summary=summary_of(found, given, answer, signals, driven_alike),
        next_experiment=next_experiment(found, given, answer),
    )


def _named_effects(answer: Answer) -> tuple[NamedEffect, ...]:
    courses = answer.now.evidence.courses
    fitted = {effect.name: effect.with_filters(courses) for effect in answer.now.with_uncertainty()}
    return tuple(_named_effect(fitted[named.name], named, answer) for named in answer.named)


def _named_effect(effect: Effect, named: Named, answer: Answer) -> NamedEffect:
    before, after = named.before.square, named.after.square
    return NamedEffect(
        effect=effect.parts[0] if isinstance(effect, EachRecord) else effect,
        gain_percent=100.0 * (1.0 - (after / before) ** 0.5),
        share_of_residual=float(np.clip((before - after) / answer.base.held_out.square, 0.0, 1.0)),
        p_value=named.p_value,
        alternatives=named.alternatives,
        description=effect.describe(),
        comparison=comparison_of(named, answer),
    )


def _verdict(answer: Answer, effects: tuple[NamedEffect, ...], noise_rms: float) -> str:
    more_than_noise = answer.now.held_out.rms > ABOVE_NOISE * noise_rms
    if not effects:
        return UNEXPLAINED if more_than_noise or BIAS in answer.structures else NOTHING_FOUND
    if any(named.alternatives for named in effects):
        return AMBIGUOUS
    return PARTLY_NAMED if more_than_noise else NAMED


def signals_of(now: JointFit) -> list[Signals]:
    """Return the used samples of each record with what a joint fit leaves."""
    evidence = now.evidence
    records = []
    for part, rows in zip(evidence.parts, evidence.slices, strict=True):
        used = part.used
        beside = {key: value[used] for key, value in part.surroundings.items()}
        records.append(Signals(part.t[used], part.v[used], part.y[used], now.residual[rows][used], beside))
    return [record for record in records if record.t.size]


def _traces(base: JointFit, now: JointFit) -> Traces:
    evidence, seen = now.evidence, np.flatnonzero(now.evidence.parts[0].seen)
    parts = {effect.name: now.predicted - now.prediction_without(effect.name) for effect in now.effects}
    t, v, y, before, after = (x[seen] for x in (evidence.t, evidence.v, evidence.y, base.predicted, now.predicted))
    return Traces(t, v, y, before, after, {name: part[seen] for name, part in parts.items()})
