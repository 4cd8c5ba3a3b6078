"""What ``slpi doctor --device`` says of a device that was opened and read: what is there, and what will bite."""

import math
from collections.abc import Sequence

from slpi_ros.arrays import FloatArray
from slpi_ros.compensator.plausible import implausible_noise, implausible_stroke
from slpi_ros.drivers.base import USUAL_SCALE, Found
from slpi_ros.errors import shown
from slpi_ros.reports.doctor import FAILED, NOTE, OK, Check

# The limits to start with: so far on each side of the present voltage, V, but no more than this share of the device's
# own range, as an amplifier behind it makes more of it.
NARROW, NARROW_SHARE = 5.0, 0.05
# Cycles per second to choose from: a reading shall take at most half a period, as writing may take as long again.
RATES = (1000, 500, 200, 100, 50, 20)
# Metres to start with for one unit of a position that is the voltage of a sensor: 100 um for 10 V.
SENSOR_SCALES = {"labjack": 1e-5, "nidaqmx": 1e-5}


def check_device(name: str, found: Found, channels: Sequence[str], positions: FloatArray) -> list[Check]:
    """Return the checks of an open device, its channels one by one; `positions` (m, (N, channels)) were read of it."""
    checks = [Check(OK, f"{name}: {found.identity}; nothing was written")]
    for place, channel in enumerate(channels):
        v, x = found.reading.voltages[place], found.reading.positions[place]
        low, high, setpoint = found.lowest[place], found.highest[place], found.setpoints[place]
        told = f"{name}, channel {channel}"
        if found.servo[place]:
            checks.append(
                Check(FAILED, f"{told}: the servo is on: the device moves the voltage itself; switch it off, or set "
                              "take_over_servo")
            )  # fmt: skip
        if not low <= v <= high:
            checks.append(Check(FAILED, f"{told}: it is at {v:.4g} V, outside its own range; look at its display"))
        if not math.isfinite(low) or not math.isfinite(high):
            checks.append(
                Check(NOTE, f"{told}: it does not report its own range: voltage_min and voltage_max are the only guard")
            )
        if not math.isfinite(x):
            checks.append(Check(NOTE, f"{told}: no position: no calibration is possible with this device alone"))
        travel = implausible_stroke(found.travel[place]) if found.travel else ""
        if unit := travel or implausible_noise(positions[:, place]):
            checks.append(
                Check(FAILED, f"{told}: {unit}: no piezo stage has that; check the unit of its position, and set "
                              "sensor_scale")
            )  # fmt: skip
        if abs(setpoint - v) > 1e-3 * max(abs(v), 1.0):
            text = f"its setpoint is {setpoint:.6g} V, it reports {v:.6g} V: the first step may be as large"
            checks.append(Check(NOTE, f"{told}: {text}"))
    return checks + [Check(NOTE, f"{name}: {note}") for note in found.notes]


def device_table(found: Found, channels: Sequence[str], scales: Sequence[float]) -> list[str]:
    """Return a table of the channels of a device, in volts and units of the device, of which one is `scales` (m)."""
    rows = [("channel", "voltage", "position, its unit", "own range", "servo")]
    for place, channel in enumerate(channels):
        x = found.reading.positions[place] / scales[place]
        unit = found.units[place] if found.units else ""
        rows.append(
            (
                channel,
                f"{found.reading.voltages[place]:.4f} V",
                f"{x:.6g} {shown(unit)}".strip() if math.isfinite(x) else "none",
                f"{found.lowest[place]:g} to {found.highest[place]:g} V",
                "ON" if found.servo[place] else "off",
            )
        )
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    return ["  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)).rstrip() for row in rows]


def device_parameters(kind: str, address: str, found: Found, channels: Sequence[str], cycle: float) -> list[str]:
    """Return the YAML of the node ``driver`` to start with: narrow limits around the present voltages.

    `cycle` is the time of one reading, s.
    """
    ranges = list(zip(found.setpoints, found.lowest, found.highest, strict=True))
    narrow = min([NARROW, *(NARROW_SHARE * (high - low) for _, low, high in ranges)])
    lower = [max(low, v - narrow) for v, low, _ in ranges]
    upper = [min(high, v + narrow) for v, _, high in ranges]
    axes = ["x", "y", "z"] if len(channels) <= 3 else [f"axis{number}" for number in range(1, len(channels) + 1)]
    # With quotation marks: YAML takes a bare y for a boolean.
    names, texts = (", ".join(f"'{each}'" for each in some) for some in (axes[: len(channels)], channels))
    rate = next((each for each in RATES if cycle <= 0.5 / each), RATES[-1])
    scale = SENSOR_SCALES.get(kind, USUAL_SCALE)
    unit = "V; here 10 V for 100 um" if kind in SENSOR_SCALES else "here 1 um"
    scaled = [f"    # Metres for one unit of the position in the table ({unit}).", f"    sensor_scale: {scale:.1e}"]
    if any(found.units):
        told = ", ".join(map(shown, found.units))
        scaled = ["    # Metres for one unit of the position; .nan: " + f"as the device reports ({told}).",
                  "    sensor_scale: .nan"]  # fmt: skip
    return [
        "driver:",
        "  ros__parameters:",
        f"    device: {kind}",
        f"    address: '{address}'",
        f"    axes: [{names}]",
        f"    channels: [{texts}]",
        "    # Around the present voltage; the limits of the stage, once the first hour is over.",
        f"    voltage_min: [{', '.join(f'{v:.3f}' for v in lower)}]",
        f"    voltage_max: [{', '.join(f'{v:.3f}' for v in upper)}]",
        f"    slew_limit: {2.0 * narrow:.4g}",
        f"    # One reading takes {1e3 * cycle:.2g} ms.",
        f"    rate: {rate:.1f}",
        "    # V at the stage for one volt of the device: of an amplifier behind it. Set it before anything moves, and",
        "    # multiply the limits above by it.",
        "    amplifier_gain: 1.0",
        *scaled,
    ]
