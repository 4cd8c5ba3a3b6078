"""What ``slpi doctor --device`` says of a device that was opened and read: what is there, and what will bite."""

import math
from collections.abc import Sequence

from slpi_ros.drivers.base import Found
from slpi_ros.reports.doctor import FAILED, NOTE, OK, Check

# The limits to start with: so far on each side of the present voltage, V.
NARROW = 5.0


def check_device(name: str, found: Found, channels: Sequence[str]) -> list[Check]:
    """Return the checks of an open device, its channels one by one."""
    checks = [Check(OK, f"{name}: {found.identity}; nothing was written")]
    rows = zip(
        channels,
        found.setpoints,
        found.reading.voltages,
        found.reading.positions,
        found.lowest,
        found.highest,
        found.servo,
        strict=True,
    )
    for channel, setpoint, v, x, low, high, servo in rows:
        told = f"{name}, channel {channel}"
        if servo:
            checks.append(
                Check(FAILED, f"{told}: the servo is on: the device moves the voltage itself; switch it off, or set "
                              "take_over_servo")
            )  # fmt: skip
        if not low <= v <= high:
            checks.append(Check(FAILED, f"{told}: it is at {v:.4g} V, outside its own range; look at its display"))
        if not math.isfinite(low) or not math.isfinite(high):
            checks.append(
                Check(NOTE, f"{told}: it does not tell its own range: voltage_min and voltage_max are the only guard")
            )
        if not math.isfinite(x):
            checks.append(Check(NOTE, f"{told}: no position: no calibration is possible with this device alone"))
        if abs(setpoint - v) > 1e-3 * max(abs(v), 1.0):
            checks.append(
                Check(NOTE, f"{told}: it was told {setpoint:.6g} V and says {v:.6g} V: the first step may be as large")
            )
    return checks + [Check(NOTE, f"{name}: {note}") for note in found.notes]


def device_table(found: Found, channels: Sequence[str]) -> list[str]:
    """Return a table of the channels of a device, in volts at the device."""
    rows = [("channel", "voltage", "position", "own range", "servo")]
    for place, channel in enumerate(channels):
        x = found.reading.positions[place]
        rows.append(
            (
                channel,
                f"{found.reading.voltages[place]:.4f} V",
                f"{x:.6g}" if math.isfinite(x) else "none",
                f"{found.lowest[place]:g} to {found.highest[place]:g} V",
                "ON" if found.servo[place] else "off",
            )
        )
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    return ["  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)).rstrip() for row in rows]


def device_parameters(kind: str, address: str, found: Found, channels: Sequence[str]) -> list[str]:
    """Return the YAML of the node ``driver`` to start with: narrow limits around the present voltages."""
    lower = [max(low, v - NARROW) for low, v in zip(found.lowest, found.setpoints, strict=True)]
    upper = [min(high, v + NARROW) for high, v in zip(found.highest, found.setpoints, strict=True)]
    axes = ["x", "y", "z"] if len(channels) <= 3 else [f"axis{number}" for number in range(1, len(channels) + 1)]
    texts = ", ".join(f"'{channel}'" for channel in channels)
    return [
        "driver:",
        "  ros__parameters:",
        f"    device: {kind}",
        f"    address: '{address}'",
        f"    axes: [{', '.join(axes[: len(channels)])}]",
        f"    channels: [{texts}]",
        "    # Around the present voltage; the limits of the stage, once the first hour is over.",
        f"    voltage_min: [{', '.join(f'{v:.3f}' for v in lower)}]",
        f"    voltage_max: [{', '.join(f'{v:.3f}' for v in upper)}]",
        f"    slew_limit: {2.0 * NARROW:.1f}",
        "    # Volts at the stage for one volt of the device, and metres for one unit of its position.",
        "    amplifier_gain: 1.0",
        "    sensor_scale: 1.0e-6",
    ]
