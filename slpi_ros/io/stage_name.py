"""Names of stages, as models, records and ``stage_state.header.frame_id`` hold them: whether two are of one stage."""

import re

# Frames of other things, which drivers of others put there.
FRAMES = frozenset({"", "base_link", "map", "odom", "world"})
# What a device says of itself (`Found.identity`) with its firmware, which an update changes; older drivers published
# all of it. Of PI it is what ``*IDN?`` tells: maker, model, serial number, firmware (IEEE 488.2).
_OF_PI = re.compile(r"(?:\(c\)[^,]*|[^,]*\bPhysik Instrumente\b[^,]*|PI\s*),([^,]+),([^,]+),.+", re.IGNORECASE)
_NUMBERED = re.compile(r"(.+), serial number ([^\s,]+)(?:, firmware .*)?")
# Of devices that tell no number.
_NUMBERLESS = re.compile(
    r"Model MDT69\w+ .*Firmware Version: .*|NV200\w*/D\w*|a serial device that does not name itself"
)


def stage_name(text: str) -> str:
    """Return the name of a stage without what does not tell it from others, "" if the text names none.

    Parameters
    ----------
    text : str
        ``hardware_id`` of a model or record, ``frame_id`` of a message; of a device also all that it says of itself.
    """
    name = text.strip()
    if name.lstrip("/") in FRAMES or _NUMBERLESS.fullmatch(name):
        return ""
    return _of_device(name) or ("" if _OF_PI.fullmatch(name) or _NUMBERED.fullmatch(name) else name)


def same_stage(one: str, other: str, accepted: str = "") -> bool:
    """Return whether two names may be of one stage: they agree, or one of them names none, or is `accepted`."""
    names = {stage_name(one), stage_name(other)}
    return len(names) == 1 or bool(names & {"", stage_name(accepted)})


def acceptance(name: str, option: str) -> str:
    """Return what is said of a name that is taken for that of this stage, by a parameter or an option."""
    return f"what is named stage '{name}' is taken for this one ({option})"


def device_name(identity: str) -> str:
    """Return what tells a device from others of its kind, by all that it says of itself; "" if nothing does."""
    return _of_device(identity.strip())


def _of_device(identity: str) -> str:
    """Return model and serial number of a known form of identity, "" if it is of another form or has no number."""
    if not (found := _OF_PI.fullmatch(identity) or _NUMBERED.fullmatch(identity)):
        return ""
    model, number = found.group(1).strip(), found.group(2).strip()
    # A device that was given none tells zeros.
    return f"{model}, serial number {number}" if number.strip("0") else ""
