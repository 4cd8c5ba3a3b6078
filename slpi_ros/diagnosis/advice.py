"""What to record next, where a record does not tell."""

from collections.abc import Sequence

from slpi_ros.diagnosis.evidence import Evidence
from slpi_ros.diagnosis.gather import one_speed
from slpi_ros.diagnosis.structure import BIAS, LEVEL, NOT_CLOSING
from slpi_ros.excitation.effects import for_effect

# Which drive separates effects that a record leaves open: the first pair that is among them decides.
SEPARATES = (
    ({"lag", "delay"}, "lag"),
    ({"lag", "rate_dependence"}, "rate_dependence"),
    ({"delay", "rate_dependence"}, "rate_dependence"),
    ({"gain_drift", "thermal_drift"}, "gain_drift"),
    ({"creep", "thermal_drift"}, "thermal_drift"),
    ({"creep", "lag"}, "creep"),
    ({"creep", "delay"}, "creep"),
    ({"creep", "rate_dependence"}, "creep"),
    ({"resonance", "lag"}, "resonance"),
    ({"resonance", "delay"}, "resonance"),
)
OTHER_FREQUENCIES = "This record has one drive frequency; other frequencies tell these apart. "
UP_TO_DATE = "`slpi refit` with this record brings the model up to date; no other one is needed for that."
ANOTHER_HYSTERESIS = {
    NOT_CLOSING: "No model with return-point memory can follow loops that do not close: compensate with "
    "feedback, and record the drive of `slpi excite --for creep` to see whether they close where time is left.",
    LEVEL: "Loops between the same two voltages differ with the level they hang on, which no "
    "model here can follow: identify on drives like those to be compensated, or compensate with feedback.",
    BIAS: "The shape of the loops depends on the bias voltage, which the kind of the given "
    "model cannot follow: identify this record with kind 'slpi'; no new one is needed.",
}


def more_loops(evidence: Evidence) -> str:
    """Return the record that shows most, in a sentence."""
    return f"Record `{_command(evidence)}`, which visits loops of every size at several speeds, and diagnose that."


def separating(names: Sequence[str], evidence: Evidence) -> str:
    """Return the experiment that separates effects, the likeliest first, in sentences."""
    chosen = next((drive for pair, drive in SEPARATES if pair <= set(names)), names[0])
    axes = " --axis OTHER THIS" if chosen == "cross_coupling" else ""
    other = OTHER_FREQUENCIES if one_speed(evidence) else ""
    return f"{other}Record `{_command(evidence)} --for {chosen}{axes}`. {for_effect(chosen).why}"


def _command(evidence: Evidence) -> str:
    low, high = float(evidence.v.min()), float(evidence.v.max())
    return f"slpi excite -o drive.csv --voltage-min {low:.4g} --voltage-max {high:.4g}"


def of_structure(structure: str) -> str:
    """Return what to do where the hysteresis itself is wrong, in a sentence."""
    return ANOTHER_HYSTERESIS[structure]
