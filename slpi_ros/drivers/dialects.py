"""How serial devices are spoken to: one `Dialect` each, from the table here or from a user's YAML file."""

import math
import re
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import Any

from slpi_ros.errors import UsageError, dependencies_needed

NUMBER = r"\s*(-?\d+\.?\d*(?:[eE][-+]?\d+)?)\s*"


@dataclass(frozen=True)
class Dialect:
    """Commands of a device as text: ``{channel}`` is the device's name of an axis, ``{voltage}`` a number.

    An answer is compared as a whole with the regular expression `answer`, in which ``{query}`` is what was asked,
    ``{number}`` the number. UsageError if a text is none of these.
    """

    write: str  # sets the voltage of an axis
    voltage: str  # asks for it
    position: str = ""  # asks for the position; "": there is no sensor
    identity: str = ""  # asks what the device is; "": nothing does
    lowest: str = ""  # asks for the lowest voltage of an axis, and for the highest
    highest: str = ""
    servo: str = ""  # asks whether the device's own position control is on: a number other than 0
    servo_off: str = ""  # switches it off
    source: str = ""  # asks what sets the voltage: 0 if the commands do
    answer: str = "{number}"
    error: str = "(?i)error.*"  # an answer that tells an error
    terminator: str = "\r\n"  # of a command
    end: str = "\n"  # of an answer
    ignored: str = ""  # characters that are taken out of answers, such as those of flow control
    written: bool = False  # whether a command is answered, too
    decimals: int = 3  # of a voltage
    volts_per_unit: float = 1.0  # V for one unit of the device's voltages
    baud: int = 115_200

    def __post_init__(self) -> None:
        for name in ("answer", "error"):
            try:
                re.compile(getattr(self, name).replace("{query}", "").replace("{number}", NUMBER))
            except re.error as error:
                raise UsageError(f"{name} '{getattr(self, name)}' is no regular expression: {error}") from error
        if "{voltage}" not in self.write:
            raise UsageError(f"write '{self.write}' has no {{voltage}}")
        if "{number}" not in self.answer:
            raise UsageError(f"answer '{self.answer}' has no {{number}}")
        if not (self.voltage and self.end and self.terminator):
            raise UsageError("voltage, end and terminator may not be empty: without the present voltage the first one "
                             "would be a jump")  # fmt: skip
        if not (math.isfinite(self.volts_per_unit) and self.volts_per_unit != 0.0):
            raise UsageError(f"volts_per_unit is {self.volts_per_unit}; give a number other than 0")
        if not (0 <= self.decimals <= 9 and self.baud > 0):
            raise UsageError(f"decimals {self.decimals} or baud {self.baud}; give 0 to 9, and a rate")

    def number(self, query: str, text: str) -> float | None:
        """Return the number (in units of the device) that an answer holds; None if it is no answer to this query."""
        pattern = self.answer.replace("{query}", re.escape(query)).replace("{number}", NUMBER)
        found = re.fullmatch(pattern, text, re.DOTALL)
        value = float(found.group(1)) if found else math.nan
        return value if math.isfinite(value) else None


DIALECTS = {
    # piezosystem jena NV200/D, as public client code speaks it, not held against the manual; `set` is the voltage in
    # the open loop.
    "nv200": Dialect(
        write="set,{voltage}",
        voltage="set",
        position="meas",
        identity="desc",
        lowest="avmin",
        highest="avmax",
        servo="cl",
        servo_off="cl,0",
        source="modsrc",
        answer=r"{query},{number}",
        error=r"error,(\d+)",
        ignored="\x00\x01\x11\x13",
    ),
    # Thorlabs MDT693B and MDT694B, likewise from public client code; an echo may be on or off.
    "mdt69xb": Dialect(
        write="{channel}voltage={voltage}",
        voltage="{channel}voltage?",
        identity="id?",
        lowest="{channel}min?",
        highest="{channel}max?",
        answer=r"(?:{query}\s+)?\[?{number}\]?",
        error=r".*(CMD_[A-Z_]+|ERR\w*).*",
        terminator="\r",
        end=">",
        written=True,
    ),
}


def dialect_of(name: str) -> Dialect:
    """Return the dialect of the table by its name, or that in a YAML file by its path; UsageError if there is none."""
    if name in DIALECTS:
        return DIALECTS[name]
    if not name.endswith((".yaml", ".yml")):
        raise UsageError(f"no dialect '{name}'; give one of {', '.join(DIALECTS)}, or the path of a .yaml file")
    with dependencies_needed():
        import yaml
    try:
        content = yaml.safe_load(Path(name).expanduser().read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise UsageError(f"dialect {name}: it cannot be read: {' '.join(str(error).split())}") from error
    try:
        return _dialect(content)
    except UsageError as error:
        raise UsageError(f"dialect {name}: {error}") from error


def _dialect(content: Any) -> Dialect:
    known = {field.name: field for field in fields(Dialect)}
    if not isinstance(content, Mapping):
        raise UsageError(f"it holds no mapping; give write, voltage and others of {', '.join(known)}")
    if strangers := [str(name) for name in content if name not in known]:
        raise UsageError(f"it has no '{strangers[0]}'; give some of {', '.join(known)}")
    for name, field in known.items():
        if name not in content:
            if field.default is MISSING:
                raise UsageError(f"{name} is missing")
        elif not isinstance(content[name], (int, float) if field.type is float else field.type):  # type: ignore[arg-type]
            raise UsageError(f"{name} is {content[name]!r}; give a {getattr(field.type, '__name__', field.type)}")
    return Dialect(**content)
