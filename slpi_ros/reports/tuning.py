"""What ``slpi tune`` says of a loop: text, document and page."""

from collections.abc import Mapping
from dataclasses import replace
from math import isfinite, pi
from pathlib import Path
from typing import Any

import numpy as np

from slpi_ros.compensator.loop_design import DETUNING, HALF, NOISES, SETTLED, STEP, Design, Loop
from slpi_ros.compensator.loop_margin import DiscreteLoop
from slpi_ros.errors import length
from slpi_ros.identification.frequency_response import FrequencyResponse
from slpi_ros.model.axis_model import AxisModel
from slpi_ros.model.stage_model import StageModel
from slpi_ros.reports.chart import AFTER, BEFORE, DESIRED, MEASURED, NOISE, TIME, Chart, Panel, Quantity
from slpi_ros.reports.page import Page

FILES = ("report.html",)
FREQUENCY = Quantity("frequency", "Hz", digits=".4~g", logarithmic=True)
RESPONSE = Quantity("reading over voltage", "nm/V", 1e9, ".4~g", logarithmic=True)
PHASE = Quantity("phase", "degrees", 180.0 / pi, ".1f")
SENSITIVITY = Quantity("sensitivity |S|", "", digits=".3~g", logarithmic=True)
REST = Quantity("error", "% of the step", 100.0, ".2f")
# Colour of the band in which model and measurement agree.
AGREE = "#eef4f1"
# Points of a curve over frequency.
POINTS = 1500
MODES = (
    "A peak is a mode: there the stage rings, and the notch takes the feedback out. Grey: that mode 10 % lower and "
    "higher, with which the loop keeps its margin, too. "
)
MEASURED_TOO = "Dots are measured; shaded: where model and measurement agree but for a constant factor. "
UNKNOWN = (
    "the model knows neither mode nor lag nor delay, and a loop of this bandwidth may be unstable on the stage; give a "
    "record of slpi excite --for-response, or a model of slpi diagnose"
)
HELP = {
    "mode": "a stiffer or better damped mount, or less load, raises it",
    "delay": "a faster sensor, driver or link raises it",
    "rate": "raise output_rate, and the rate of the readings",
}


def describe(axis: AxisModel, found: Design) -> list[str]:
    """Return what was found for an axis, as lines of text."""
    detuned = f"each mode {DETUNING:.0%} off and " if any(effect.ringing for effect in axis.effects) else ""
    return [
        f"bandwidth {found.bandwidth:.3g} Hz of small motions, modulus margin {found.margin:.2f} with {detuned}the "
        "slope of the largest loop",
        _gains(found),
        f"a step of a tenth of the stroke, by feedback alone, is within 1 % after {_time(_settling(axis, found)[0])}, "
        f"within the noise after {_time(_settling(axis, found)[1])}",
        f"the sensor's noise of {length(axis.quality.floor_rms)} moves the stage by {length(found.noise)} rms",
        *limits(axis, found),
    ]


def _gains(found: Design) -> str:
    gains = found.gains
    filters = [
        f"notch at {one.frequency:.4g} Hz (damping {one.damping:.3g}, width {one.width:.3g})" for one in gains.notches
    ]
    if gains.measurement_filter:
        filters.append(f"measurement_filter {gains.measurement_filter * 1e3:.3g} ms")
    return f"ki {gains.integral:.3g} V/(m s), kp {gains.proportional:.3g} V/m{''.join(f', {each}' for each in filters)}"


def describe_measured(found: Design, measured: FrequencyResponse | None) -> list[str]:
    """Return where a measured response and the model agree, or that nothing is known of it, as lines of text."""
    if measured is None:
        plant = found.plant
        return [] if plant.delay or len(plant.dynamics.b) else [UNKNOWN]
    model = found.plant.response(2.0 * pi * measured.frequency)
    band = measured.agreement(model)
    where = f"agree from {band[0]:.3g} to {band[1]:.4g} Hz" if band else "agree nowhere"
    return [
        f"measured and modelled response {where}, but for the slope of small motions: {measured.slope * 1e9:.3g} and "
        f"{found.plant.slope * 1e9:.3g} nm/V"
    ]


def limits(axis: AxisModel, found: Design) -> list[str]:
    """Return what limits the bandwidth, and what would help."""
    lines = []
    for name, without in found.limits.items():
        relieved = "at four times the rate" if name == "rate" else "without"
        lines.append(f"bandwidth limited by {_cause(name, found)}: {without:.3g} Hz {relieved}; {HELP[name]}")
    if found.noise > axis.quality.held_out_rms:
        lines.append(
            "limited by the noise: it moves the stage by more than the model is off "
            f"({length(axis.quality.held_out_rms)}); lower ki and kp by one factor where drift and creep are slow"
        )
    return lines


def _cause(name: str, found: Design) -> str:
    if name == "mode":
        return "the mode" if len(found.gains.notches) == 1 else "the modes"
    return (
        f"the delay of {found.plant.delay * 1e3:.3g} ms"
        if name == "delay"
        else f"the rate of {1.0 / found.period:.4g} Hz"
    )


def _settling(axis: AxisModel, found: Design) -> tuple[float, float]:
    """Return settling times (s) of a step, to 1 % and to the noise."""
    low, high = axis.displacement_range
    return found.settling(SETTLED), found.settling(NOISES * axis.quality.floor_rms / (STEP * (high - low)))


def _time(seconds: float) -> str:
    return f"{seconds * 1e3:.3g} ms" if isfinite(seconds) else "a time longer than looked at"


def tuning_document(axis: AxisModel, found: Design) -> dict[str, Any]:
    """Return what was found for an axis, for ``--json``, SI."""
    gains, (settled, to_noise) = found.gains, _settling(axis, found)
    return {
        "bandwidth_Hz": found.bandwidth,
        "modulus_margin": found.margin,
        "settling_1_percent_s": settled,
        "settling_noise_s": to_noise,
        "noise_m": found.noise,
        "limits_Hz": found.limits,
        "kp": gains.proportional,
        "ki": gains.integral,
        "measurement_filter": gains.measurement_filter,
        "notches": [{"frequency": one.frequency, "damping": one.damping, "width": one.width} for one in gains.notches],
    }


def write_files(
    folder: Path, model: StageModel, found: Mapping[str, Design], measured: Mapping[str, FrequencyResponse]
) -> None:
    """Write the page into a folder."""
    page = Page("The closed loop" + (f" of stage {model.hardware_id}" if model.hardware_id else ""))
    page.contents(tuple(found))
    for name, one in found.items():
        axis = model.axes[name]
        page.heading(f"Axis {name}", name)
        said = limits(axis, one)
        page.verdict(name, f"{one.bandwidth:.3g} Hz; {said[0] if said else 'bandwidth limited by the margin'}", "good")
        settled, to_noise = _settling(axis, one)
        page.tiles(
            {
                "bandwidth": f"{one.bandwidth:.3g} Hz",
                "modulus margin": f"{one.margin:.2f}",
                "settling to 1 %": _time(settled),
                "settling to the noise": _time(to_noise),
                "noise at the stage": length(one.noise),
            }
        )
        # What verdict and tiles say is not said again.
        page.lines([_gains(one), *said[1:], *describe_measured(one, measured.get(name))])
        _show(page, name, axis, one, measured.get(name))
    page.write(folder / FILES[0])


def _show_measured(bode: Chart, found: Design, measured: FrequencyResponse) -> None:
    """Add what was measured, with its interval of 95 %, and where the model agrees."""
    model = found.plant.response(2.0 * pi * measured.frequency)
    if band := measured.agreement(model):
        for panel in (0, 1):
            bode.span(panel, "agree", *band, AGREE)
    size, half = np.abs(measured.response), measured.interval
    sure = half < size
    for edge in (size + half, size - half):
        bode.line(0, "95 % interval", measured.frequency, np.where(sure, edge, np.nan), NOISE, width=1.0)
    bode.dots(0, "measured", measured.frequency[sure], size[sure], AFTER)
    angle = np.unwrap(np.angle(measured.response[sure]))
    bode.dots(1, "measured", measured.frequency[sure], angle, AFTER)


def _show(page: Page, name: str, axis: AxisModel, found: Design, measured: FrequencyResponse | None) -> None:
    loop = Loop.of(axis, found.period)
    frequency = np.geomspace(max(1e-2 * found.bandwidth, 1e-6), 0.5 / found.period, POINTS)
    frequency = np.unique(np.concatenate([frequency, loop.omega[loop.omega > 2.0 * pi * frequency[0]] / (2.0 * pi)]))
    omega = 2.0 * pi * frequency
    bode = Chart([Panel(FREQUENCY, RESPONSE, 1.6), Panel(FREQUENCY, PHASE)], "column", 560)
    corners = (loop.corners[0], loop.corners[-1]) if loop.modes else ()
    for each, label, colour, width in (
        *((replace(each, slope=loop.nominal.slope), f"the mode {DETUNING:.0%} off", MEASURED, 1.0) for each in corners),
        (loop.nominal, "model", DESIRED, 1.6),
    ):
        response = each.response(omega)
        bode.line(0, label, frequency, np.abs(response), colour, width=width)
        if each is loop.nominal:
            bode.line(1, label, frequency, np.unwrap(np.angle(response)), colour, width=width)
    if measured:
        _show_measured(bode, found, measured)
    page.section("What the stage does: a small sine of the voltage, seen by the sensor")
    page.chart(
        f"bode-{name}", bode,
        "How many nanometres the reading moves for each volt, and by how much it is late (360 degrees: a whole "
        f"period). {MODES if corners else ''}{MEASURED_TOO if measured else ''}"
        f"Small motions have less slope than large ones, {loop.large:.2g} times as much in the largest loop, for which "
        "the margin is kept.",
    )  # fmt: skip
    sensitivity = Chart([Panel(FREQUENCY, SENSITIVITY)], "column", 380)
    for each, label, colour, width in (
        *((corner, f"the mode {DETUNING:.0%} off, largest loop", MEASURED, 1.0) for corner in corners),
        (loop.nominal, "with these gains", AFTER, 1.8),
    ):
        back = DiscreteLoop(each, found.gains, found.period).response(omega)
        sensitivity.line(0, label, frequency, np.abs(1.0 / (1.0 + back)), colour, width=width)
    ends = frequency[[0, -1]]
    sensitivity.line(0, "-3 dB", ends, np.full(2, HALF), NOISE, width=1.2)
    sensitivity.line(0, "no feedback", ends, np.ones(2), BEFORE, width=1.2)
    sensitivity.line(0, "bandwidth", np.full(2, found.bandwidth), np.array([1e-2, 1.0]) * HALF, NOISE, width=1.2)
    page.section("What feedback does: errors by their frequency")
    page.chart(
        f"sensitivity-{name}", sensitivity,
        "Below 1, feedback makes an error of that frequency smaller; above 1, larger, by at most "
        f"{1.0 / found.margin:.2g} times. The bandwidth, {found.bandwidth:.3g} Hz, is where the curve first is at "
        "-3 dB (0.71).",
    )  # fmt: skip
    t, error = found.step()
    shown = t <= 2.0 * min(_settling(axis, found)[0], t[-1])
    t, error = t[shown], error[shown]
    step = Chart([Panel(TIME, REST)], "column", 340)
    step.line(0, "error", t, error, AFTER, width=1.8)
    step.line(0, "1 %", t[[0, -1]], np.full(2, SETTLED), NOISE, width=1.2)
    step.line(0, "1 %", t[[0, -1]], np.full(2, -SETTLED), NOISE, width=1.2)
    page.section("A step, by feedback alone")
    page.chart(f"step-{name}", step, "The model's feedforward does most of a real step; feedback removes the rest so.")
