"""Sentences of a diagnosis: what was found and what is left, what speaks for it, and what to record next."""

from collections.abc import Sequence

from slpi_ros.diagnosis.answer import Answer, Named
from slpi_ros.diagnosis.effect_parameters import EachRecord
from slpi_ros.diagnosis.fingerprint import Signals, half_power, hint
from slpi_ros.diagnosis.joint_fit import JointFit
from slpi_ros.diagnosis.prepare import MOST_SAMPLES, Evidence, one_speed
from slpi_ros.diagnosis.result import AMBIGUOUS, NOTHING_FOUND, PARTLY_NAMED, UNEXPLAINED, AxisDiagnosis, Given
from slpi_ros.diagnosis.structures import BIAS, LEVEL, NOT_CLOSING
from slpi_ros.effects.base import usual_step
from slpi_ros.effects.excitation import FASTEST
from slpi_ros.errors import length
from slpi_ros.excitation.effects import for_effect, separating

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
# Advised drive: duration (s) at usual sampling rates, smallest number of readings, and those of a move over the range.
DRIVE_SECONDS, FEWEST_READINGS, READINGS_OF_A_MOVE = 30.0, 2000, 20


def summary_of(
    found: AxisDiagnosis, given: Given, answer: Answer, signals: Sequence[Signals], driven_alike: Sequence[str]
) -> str:
    """Return a few sentences on a diagnosis; see `slpi_ros.diagnosis.verdict.judged` for the other arguments."""
    return (
        _of_given(given, answer, found.before_rms)
        + _summary(found, answer)
        + _goes_with(found, signals)
        + _in_model(found, answer.now)
        + _mixed(answer.now.evidence)
        + _cannot_tell(driven_alike)
        + _looked_at(found)
    )


def comparison_of(named: Named, answer: Answer) -> str:
    """Return what an effect does to the held-out error, beside the best of the others in its place."""
    before, after, without, end = (
        length(loss.rms) for loss in (named.before, named.after, named.without, answer.now.held_out)
    )
    on = "records left out" if len(answer.now.evidence.parts) > 1 else "parts left out"
    gained = (
        f"held-out error on the {on}: {before} rms before, {after} with it; with all effects "
        f"found {end}, with all but this one {without} (p = {named.p_value:.2g})"
    )
    if not named.rivals:
        return gained
    return f"{gained}; with {named.rivals[0].name} instead {length(named.rivals[0].loss.rms)}"


def _goes_with(found: AxisDiagnosis, records: Sequence[Signals]) -> str:
    if found.left:
        others = [f"{one.variable} ({one.share:.0%})" for one in found.left[1:]]
        return f" Remaining error: {found.left[0].evidence}." + (f" Also: {', '.join(others)}." if others else "")
    if found.verdict not in (UNEXPLAINED, PARTLY_NAMED):
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


def _in_model(found: AxisDiagnosis, now: JointFit) -> str:
    own = [effect.name for effect in now.effects if isinstance(effect, EachRecord)]
    said = f" Not in the extended model, as it differs from record to record: {', '.join(own)}." if own else ""
    if undecided := [named.name for named in found.effects if named.alternatives and named.name not in own]:
        said += (
            f" In the extended model as one of several possible causes: {', '.join(undecided)}; proved at the drive "
            "rates of these records only."
        )
    if found.dropped:
        said += (
            f" Tried and not in the model, as the remaining error is too large or the gain does not hold on held-out "
            f"data: {', '.join(found.dropped)}."
        )
    return said


def _mixed(evidence: Evidence) -> str:
    share = 100.0 * max(part.mixed for part in evidence.parts)
    return f" {share:.2g} % of the readings are late or mixed with the one beside them and left out." if share else ""


def _summary(found: AxisDiagnosis, answer: Answer) -> str:
    left = f"the remaining error is {length(found.after_rms)} rms, the sensor noise {length(found.noise_rms)}"
    if found.verdict == NOTHING_FOUND:
        return f"No effect found: {left}."
    structure = f"The hysteresis itself is wrong: {', '.join(answer.structures)}. " if answer.structures else ""
    if found.verdict == UNEXPLAINED:
        if BIAS in answer.structures:
            return f"{structure}None of the known effects is needed: with loops that depend on bias {left}."
        return f"{structure}None of the known effects explains the error: {left}."
    gains = ", then ".join(
        f"{named.name}, which reduces {'the remaining error' if place else 'the error'} by {named.gain_percent:.0f} %"
        for place, named in enumerate(found.effects)
    )
    others = "".join(
        f" The record cannot tell {one.name} from {', '.join(one.alternatives)}."
        for one in found.effects
        if one.alternatives
    )
    return f"{structure}Found: {gains}.{others} The held-out error was {length(found.before_rms)} before; {left}."


def _cannot_tell(driven_alike: Sequence[str]) -> str:
    if not driven_alike:
        return ""
    return f" Axis {', '.join(driven_alike)} has the same drive: its coupling into this one cannot be identified."


def _looked_at(found: AxisDiagnosis) -> str:
    """Return which recorded quantities were looked at and are not among the causes."""
    followed = {key for named in found.effects for key in named.effect.keys}
    others = [key for key in found.surroundings if key not in followed]
    if not others:
        return ""
    return f" Recorded quantities that were tried and have no effect in these records: {', '.join(others)}."


def next_experiment(found: AxisDiagnosis, given: Given, answer: Answer) -> str | None:
    """Return what to record or to do next, if anything."""
    evidence, steps = answer.now.evidence, [UP_TO_DATE] if _stale(given, answer) else []
    if found.verdict != NOTHING_FOUND:
        steps += [ANOTHER_HYSTERESIS[one].format(command=_command(evidence)) for one in answer.structures]
    if found.verdict == AMBIGUOUS:
        first = next(named for named in found.effects if named.alternatives)
        steps.append(_separating((first.name, *first.alternatives), evidence))
    if found.verdict == PARTLY_NAMED and found.left:
        steps.append(f"For the remaining error, {hint(found.left[0].variable)}.")
    elif found.verdict in (UNEXPLAINED, PARTLY_NAMED) and not steps:
        steps.append(
            f"Record `{_command(evidence)}`, which visits loops of every size at several speeds, and diagnose that."
        )
    return " ".join(steps) or None


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
