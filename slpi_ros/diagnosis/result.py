"""Results of a diagnosis: figures and sentences for the report and the JSON document."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from slpi_ros.arrays import FloatArray
from slpi_ros.diagnosis.answer import Answer, Named
from slpi_ros.diagnosis.effect_parameters import EachRecord
from slpi_ros.diagnosis.fingerprint import Left, Signals, fingerprint, half_power, hint
from slpi_ros.diagnosis.joint_fit import Explanation
from slpi_ros.diagnosis.prepare import MOST_SAMPLES, Evidence, one_speed
from slpi_ros.diagnosis.structures import BIAS, LEVEL, NOT_CLOSING
from slpi_ros.effects.base import Effect, usual_step
from slpi_ros.effects.excitation import FASTEST
from slpi_ros.effects.registry import to_document as effect_document
from slpi_ros.errors import length
from slpi_ros.excitation.effects import for_effect, separating
from slpi_ros.identification.repeatability import Repeatability
from slpi_ros.model.axis_model import ABOVE_NOISE
from slpi_ros.model.stage_model import StageModel

OTHER_FREQUENCIES = "This record has one drive frequency; other frequencies tell these apart. "
UP_TO_DATE = "`slpi refit` with this record brings the model up to date; no other one is needed for that."
ANOTHER_HYSTERESIS = {
    NOT_CLOSING: "No model with return-point memory can follow loops that do not close: compensate with "
    "feedback, and record `{command} --for creep` to see whether they close where time is left.",
    LEVEL: "Loops between the same two voltages differ with the loop that they lie in, which no "
    "model here can follow: identify on drives like those to be compensated, or compensate with feedback.",
    BIAS: "The shape of the loops depends on the bias voltage, which the kind of the given "
    "model cannot follow: identify this record with kind 'slpi'; no new one is needed.",
}
# The given model is out of date if its error exceeds that of a refitted one by this factor.
STALE = 1.5
# It is not out of date if its error equals that at its identification, within this factor.
AS_BEFORE = 1.1
# Thresholds for a changed stage: excess rms error as a share of the motion; relative change of gain; change of gain in
# standard deviations.
CHANGED, LEAST_CHANGE, CERTAIN = 1e-3, 3e-3, 5.0

# Advised drive: duration (s) at usual sampling rates, smallest number of readings, and those of a move over the range.
DRIVE_SECONDS, FEWEST_READINGS, READINGS_OF_A_MOVE = 30.0, 2000, 20

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
    # One sentence with numbers.
    evidence: str

    @property
    def name(self) -> str:
        """The effect's name."""
        return self.effect.name


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
    rms: float  # of the model as it is, without the offset of each record
    hysteresis_rms: float  # of its hysteresis
    refitted_rms: float  # of a refitted one
    gain: float  # relative change of the gain of the stage
    gain_deviation: float  # standard deviation
    zero_moved: float | None  # m, largest among the records; None: small, or due to the initial state
    motion: float  # m, range of the measured displacement
    own_rms: float  # at the identification of the model, if these are its records, else 0
    explained: bool  # whether a new fit leaves little, where the stage seems to have changed

    @property
    def changed(self) -> bool:
        """Whether the stage has changed since the model was identified: its loops or its gain no longer fit."""
        if not self.explained or (self.own_rms <= AS_BEFORE * self.rms and self.rms <= AS_BEFORE * self.own_rms):
            return False
        excess = np.sqrt(max(self.hysteresis_rms**2 - self.refitted_rms**2, 0.0))
        clear = self.hysteresis_rms > STALE * self.refitted_rms and excess > CHANGED * self.motion
        return bool(clear or (abs(self.gain) > LEAST_CHANGE and abs(self.gain) > CERTAIN * self.gain_deviation))


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
    left = fingerprint(signals)
    return AxisDiagnosis(
        verdict=verdict,
        summary=_of_given(given, answer, before_rms)
        + _summary(verdict, answer, effects, noise_rms, before_rms)
        + _goes_with(left, verdict, signals)
        + _in_model(now, effects, answer.dropped)
        + _mixed(now.evidence)
        + _cannot_tell(driven_alike)
        + _looked_at(now.evidence, effects),
        noise_rms=noise_rms,
        repeatability_rms=repeatability.rms,
        repeatability_source=repeatability.source,
        given_rms=given.rms,
        before_rms=before_rms,
        after_rms=now.held_out.rms,
        effects=effects,
        next_experiment=_next(verdict, answer, effects, left, stale=_stale(given, answer)),
        traces=_traces(base, now),
        left=left,
        records=records,
        surroundings=tuple(now.evidence.surroundings),
        dropped=answer.dropped,
        given=given,
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
        evidence=_evidence(effect, named, answer),
    )


def _evidence(effect: Effect, named: Named, answer: Answer) -> str:
    before, after, without, end = (
        length(loss.rms) for loss in (named.before, named.after, named.without, answer.now.held_out)
    )
    on = "records left out" if len(answer.now.evidence.parts) > 1 else "parts left out"
    gained = (
        f"{effect.describe()}; held-out error on the {on}: {before} rms before, {after} with it; with all effects "
        f"found {end}, with all but this one {without} (p = {named.p_value:.2g})"
    )
    if not named.rivals:
        return gained
    return f"{gained}; with {named.rivals[0].name} instead {length(named.rivals[0].loss.rms)}"


def _verdict(answer: Answer, effects: tuple[NamedEffect, ...], noise_rms: float) -> str:
    more_than_noise = answer.now.held_out.rms > ABOVE_NOISE * noise_rms
    if not effects:
        return UNEXPLAINED if more_than_noise or BIAS in answer.structures else NOTHING_FOUND
    if any(named.alternatives for named in effects):
        return AMBIGUOUS
    return PARTLY_NAMED if more_than_noise else NAMED


def signals_of(now: Explanation) -> list[Signals]:
    """Return the used samples of each record with what a joint fit leaves."""
    evidence = now.evidence
    records = []
    for part, rows in zip(evidence.parts, evidence.slices, strict=True):
        used = part.used
        beside = {key: value[used] for key, value in part.surroundings.items()}
        records.append(Signals(part.t[used], part.v[used], part.y[used], now.residual[rows][used], beside))
    return [record for record in records if record.t.size]


def _goes_with(left: Sequence[Left], verdict: str, records: Sequence[Signals]) -> str:
    if left:
        others = [f"{one.variable} ({one.share:.0%})" for one in left[1:]]
        return f" Remaining error: {left[0].evidence}." + (f" Also: {', '.join(others)}." if others else "")
    if verdict not in (UNEXPLAINED, PARTLY_NAMED):
        return ""
    return (
        f" No recorded variable predicts the remaining error; half of its power is below {half_power(records):.3g} Hz."
    )


def _stale(given: Given, answer: Answer) -> bool:
    """Return whether the given model is out of date, so that a refit of the same kind corrects it."""
    return BIAS not in answer.structures and given.changed


def _of_given(given: Given, answer: Answer, before_rms: float) -> str:
    error, anew = length(given.rms), length(before_rms)
    moved = ""
    if given.zero_moved is not None:
        moved = f"The zero has moved by {length(given.zero_moved)}. "
    if _stale(given, answer):
        return (
            f"The given model is off by {error} rms, one fitted to the record by {anew}: the stage has "
            f"changed since, its gain by {100 * given.gain:+.2g} %. {moved}"
        )
    if moved:
        same = 100.0 * max(abs(given.gain), given.hysteresis_rms / given.motion)
        return f"{moved}The loops are the same within {same:.1g} %. "
    return f"The given model is off by {error} rms on this record. " if BIAS in answer.structures else ""


def _in_model(now: Explanation, effects: Sequence[NamedEffect], dropped: Sequence[str]) -> str:
    own = [effect.name for effect in now.effects if isinstance(effect, EachRecord)]
    said = f" Not in the extended model, as it differs from record to record: {', '.join(own)}." if own else ""
    if undecided := [named.name for named in effects if named.alternatives and named.name not in own]:
        said += (
            f" In the extended model as one of several possible causes: {', '.join(undecided)}; proved at the drive "
            "rates of these records only."
        )
    if dropped:
        said += (
            f" Tried and not in the model, as the remaining error is too large or the gain does not hold on held-out "
            f"data: {', '.join(dropped)}."
        )
    return said


def _mixed(evidence: Evidence) -> str:
    share = 100.0 * max(part.mixed for part in evidence.parts)
    return f" {share:.2g} % of the readings are late or mixed with the one beside them and left out." if share else ""


def _summary(
    verdict: str, answer: Answer, effects: tuple[NamedEffect, ...], noise_rms: float, before_rms: float
) -> str:
    after = answer.now.held_out.rms
    left = f"the remaining error is {length(after)} rms, the sensor noise {length(noise_rms)}"
    found = ", then ".join(
        f"{named.name}, which reduces {'the remaining error' if place else 'the error'} by {named.gain_percent:.0f} %"
        for place, named in enumerate(effects)
    )
    if verdict == NOTHING_FOUND:
        return f"No effect found: {left}."
    structure = f"The hysteresis itself is wrong: {', '.join(answer.structures)}. " if answer.structures else ""
    if verdict == UNEXPLAINED:
        if BIAS in answer.structures:
            return f"{structure}None of the known effects is needed: with loops that depend on bias {left}."
        return f"{structure}None of the known effects explains the error: {left}."
    others = ""
    if verdict == AMBIGUOUS:
        open_ones = (named for named in effects if named.alternatives)
        others = "".join(f" The record cannot tell {one.name} from {', '.join(one.alternatives)}." for one in open_ones)
    return f"{structure}Found: {found}.{others} The held-out error was {length(before_rms)} before; {left}."


def _cannot_tell(driven_alike: Sequence[str]) -> str:
    if not driven_alike:
        return ""
    return f" Axis {', '.join(driven_alike)} has the same drive: its coupling into this one cannot be identified."


def _looked_at(evidence: Evidence, effects: Sequence[NamedEffect]) -> str:
    """Return which recorded quantities were looked at and are not among the causes."""
    followed = {key for named in effects for key in named.effect.keys}
    others = [key for key in evidence.surroundings if key not in followed]
    return (
        f" Recorded quantities that were tried and have no effect in these records: {', '.join(others)}."
        if others
        else ""
    )


def _next(
    verdict: str, answer: Answer, effects: tuple[NamedEffect, ...], left: Sequence[Left], *, stale: bool
) -> str | None:
    steps = [UP_TO_DATE] if stale else []
    steps += (
        []
        if verdict == NOTHING_FOUND
        else [
            ANOTHER_HYSTERESIS[structure].format(command=_command(answer.now.evidence))
            for structure in answer.structures
        ]
    )
    if verdict == AMBIGUOUS:
        first = next((named for named in effects if named.alternatives), effects[0])
        steps.append(_separating((first.name, *first.alternatives), answer.now.evidence))
    if verdict == PARTLY_NAMED and left:
        steps.append(f"For the remaining error, {hint(left[0].variable)}.")
    elif verdict in (UNEXPLAINED, PARTLY_NAMED) and not steps:
        steps.append(_more_loops(answer.now.evidence))
    return " ".join(steps) or None


def _traces(base: Explanation, now: Explanation) -> Traces:
    evidence, seen = now.evidence, np.flatnonzero(now.evidence.parts[0].seen)
    parts = {effect.name: now.predicted - now.prediction_without(effect.name) for effect in now.effects}
    t, v, y, before, after = (x[seen] for x in (evidence.t, evidence.v, evidence.y, base.predicted, now.predicted))
    return Traces(t, v, y, before, after, {name: part[seen] for name, part in parts.items()})


def _more_loops(evidence: Evidence) -> str:
    """Return a sentence that recommends the most informative record."""
    return f"Record `{_command(evidence)}`, which visits loops of every size at several speeds, and diagnose that."


def _separating(names: Sequence[str], evidence: Evidence) -> str:
    """Return sentences that recommend an experiment to distinguish the effects `names` (likeliest first)."""
    chosen = separating(names)
    axes = " --axis OTHER THIS" if for_effect(chosen).least_axes > 1 else ""
    other = OTHER_FREQUENCIES if one_speed(evidence) else ""
    return f"{other}Record `{_command(evidence)} --for {chosen}{axes}`. {for_effect(chosen).why}"


def _command(evidence: Evidence) -> str:
    """Return the command for a drive that suits the stage: its voltage range, sampling rate and speed."""
    low, high = float(evidence.v.min()), float(evidence.v.max())
    rate = 1.0 / usual_step(evidence.parts[0].t)
    seconds = max(min(DRIVE_SECONDS, MOST_SAMPLES / rate), FEWEST_READINGS / rate)
    slew = (high - low) * rate / READINGS_OF_A_MOVE
    slow = f" --slew-limit {slew:.3g}" if slew < FASTEST * (high - low) else ""
    return (
        f"slpi excite -o drive.csv --voltage-min {low:.4g} --voltage-max {high:.4g} --rate {rate:.4g} "
        f"--duration {seconds:.3g}{slow}"
    )
