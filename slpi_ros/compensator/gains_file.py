"""Gains of the feedback as a parameter file of the compensator, of ``slpi tune`` and of the calibrator."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from sys import float_info
from typing import Any

from slpi_ros.compensator.feedback import PidGains
from slpi_ros.compensator.loop_filter import notches_of
from slpi_ros.errors import UsageError, dependencies_needed
from slpi_ros.io.atomic_file import all_or_nothing
from slpi_ros.io.input_limits import METADATA_BYTES, open_input
from slpi_ros.io.outputs import GAINS_MARK

NUMBERS = {
    "kp": "proportional", "ki": "integral", "kd": "derivative", "derivative_filter": "derivative_filter",
    "measurement_filter": "measurement_filter",
}  # fmt: skip
LARGEST = float_info.max
# Parameters of the notches, and what they are where there is none.
NOTCH = {"frequency": 0.0, "damping": 0.0, "width": 1.0}


@dataclass(frozen=True)
class TunedGains:
    """Gains by axis, in the order of the axes, and the rate (Hz) of the loop that they are for."""

    rate: float
    axes: Mapping[str, PidGains]

    def write(self, path: str, by: str = "slpi tune") -> None:
        """Write a parameter file, of which the first line says `by` what; SlpiError if it cannot be written."""
        names, gains = list(self.axes), list(self.axes.values())
        lines = [f"{GAINS_MARK}{by}"]
        if len(names) > 1:
            lines.append(f"# Several values are in the order of the axes {', '.join(names)}.")
        lines += ["/**:", "  ros__parameters:", f"    output_rate: {_number(self.rate)}"]
        # Notches first: set one after the other on a running node, no gain is without them.
        for part, none in NOTCH.items():
            for name, own in self.axes.items():
                values = [getattr(notch, part) for notch in own.notches] or [none]
                lines.append(f"    notch_{part}.{name}: [{', '.join(map(_number, values))}]")
        for parameter in ("measurement_filter", "kp", "ki", "kd", "derivative_filter"):
            values = [_number(getattr(own, NUMBERS[parameter])) for own in gains]
            several = values[0] if len(values) == 1 else f"[{', '.join(values)}]"
            lines.append(f"    {parameter}: {several}")
        with all_or_nothing(path) as file:
            file.write("\n".join(lines) + "\n")

    @classmethod
    def read(cls, path: str) -> "TunedGains":
        """Return the gains of a parameter file; UsageError if it holds none, or none that make sense."""
        found = _parameters(path)
        names = [name.removeprefix("notch_frequency.") for name in found if name.startswith("notch_frequency.")]
        names = names or ["x"]
        try:
            rate = _numbers(found, "output_rate", 1)[0]
            if not (isfinite(rate) and rate > 0.0):
                raise UsageError(f"output_rate is {rate}; give the rate of the loop, hertz")
            each = {parameter: _numbers(found, parameter, len(names), 0.0) for parameter in NUMBERS}
            axes = {}
            for k, name in enumerate(names):
                frequencies, dampings, widths = (
                    _numbers(found, f"notch_{part}.{name}", 0, none) for part, none in NOTCH.items()
                )
                own = {NUMBERS[parameter]: values[k] for parameter, values in each.items()}
                axes[name] = PidGains(**own, notches=notches_of(name, frequencies, dampings, widths, rate))
        except UsageError as error:
            raise UsageError(f"{path}: {error}") from None
        return cls(rate, axes)


def _number(value: float) -> str:
    """Return a number that YAML takes for one with a decimal point."""
    text = f"{value:.9g}"
    if "." in text:
        return text
    return text.replace("e", ".0e") if "e" in text else f"{text}.0"


def _parameters(path: str) -> dict[str, Any]:
    """Return the parameters of a file, by their whole names."""
    with dependencies_needed():
        import yaml
    try:
        with open_input(Path(path), METADATA_BYTES) as file:
            content = yaml.safe_load(file.read().decode())
        nodes = [{name.strip(): v for name, v in each["ros__parameters"].items()} for each in content.values()]
        found: dict[str, Any] = {}
        for each in nodes:
            for name, value in each.items():
                found |= {f"{name}.{key}": v for key, v in value.items()} if isinstance(value, dict) else {name: value}
    except (OSError, ValueError, yaml.YAMLError, AttributeError, KeyError, TypeError, RecursionError) as error:
        why = getattr(error, "strerror", None) or "no parameter file of a compensator"
        raise UsageError(f"{path}: {why}; give a file that slpi tune has written") from None
    if "output_rate" not in found:
        raise UsageError(f"{path}: holds no output_rate; give a file that slpi tune has written")
    return found


def _numbers(found: Mapping[str, Any], name: str, count: int, default: float | None = None) -> list[float]:
    given = found.get(name, default)
    several = given if isinstance(given, list) else [given] * (count or 1)
    for v in several:
        if not isinstance(v, int | float) or isinstance(v, bool) or abs(v) > LARGEST:
            # Lists in lists, of few characters, may be of any length.
            what = f"a {type(v).__name__} in a list" if isinstance(v, list | dict | set) else f"{v!r}"
            raise UsageError(f"{name} is {what}; give finite numbers")
    if count and len(several) != count:
        raise UsageError(f"{name} has {len(several)} values for {count} axes; give one for each")
    return [float(v) for v in several]
