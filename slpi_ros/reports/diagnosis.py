"""The page and the files of a diagnosis: error of the model, its causes, and the suggested next experiment."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from slpi_ros.diagnosis import result
from slpi_ros.diagnosis.fingerprint import Left
from slpi_ros.diagnosis.result import AxisDiagnosis, Diagnosis, NamedEffect, Traces
from slpi_ros.effects.registry import to_document
from slpi_ros.errors import SlpiError, length
from slpi_ros.io.atomic_file import all_or_nothing, make_folder
from slpi_ros.io.schemas import format_document
from slpi_ros.model.document import format_model
from slpi_ros.reports import views
from slpi_ros.reports.chart import AFTER, BEFORE, CAUSES, DISPLACEMENT, ERROR, NOISE, Chart, Panel, Quantity
from slpi_ros.reports.page import Page, Severity, Share
from slpi_ros.reports.text import NO_DRIVE, above_noise, how_good, is_without_hysteresis
from slpi_ros.reports.views import Motion, Series

# Relative difference of equal errors.
_SAME = 0.01
# The variable over a logarithmic axis.
SINCE = Quantity("time since the last turn", "s", digits=".3~g", logarithmic=True)
# Largest number of variables whose part of the residual is drawn.
_MOST_DRAWN = 3

BEFORE_NAME, AFTER_NAME = "without effects", "with effects"
FILES = (_, _, PAGE) = "diagnosis.json", "extended_model.json", "report.html"


def write_files(folder: Path, diagnosis: Diagnosis) -> None:
    """Write ``diagnosis.json``, ``extended_model.json`` and ``report.html`` into `folder`, each atomically."""
    make_folder(folder, *FILES)
    try:
        texts = format_document(diagnosis.to_document(), "diagnosis"), format_model(diagnosis.extended)
    except ValueError as error:
        raise SlpiError(f"{diagnosis.source}: no valid diagnosis: {error}; record a longer drive") from None
    for name, text in zip(FILES, texts, strict=False):
        with all_or_nothing(folder / name) as file:
            file.write(text)
    page_of(diagnosis).write(folder / PAGE)


def page_of(diagnosis: Diagnosis) -> Page:
    """Return the page of a diagnosis."""
    stage = diagnosis.extended.hardware_id
    page = Page("Diagnosis" + (f" of stage {stage}" if stage else ""))
    page.contents(tuple(diagnosis.axes))
    if diagnosis.source:
        page.text(f"Records: {diagnosis.source}")
    for name, found in diagnosis.axes.items():
        page.heading(f"Axis {name}", name)
        page.verdict(name, found.summary, _severity(found), found.verdict)
        page.tiles(_figures(found))
        _show_causes(page, found)
        _show_left(page, name, found)
        _show_records(page, found)
        if found.next_experiment:
            page.section("Next step")
            page.text(found.next_experiment)
        _show_charts(page, name, found)
    return page


def _severity(found: AxisDiagnosis) -> Severity:
    if found.verdict in (result.NOTHING_FOUND, result.NAMED):
        return "good"
    return "warn" if found.verdict in (result.PARTLY_NAMED, result.AMBIGUOUS) else "bad"


def _figures(found: AxisDiagnosis) -> dict[str, str]:
    figures = {
        "error of the given model, rms": length(found.given_rms),
        "refitted hysteresis": length(found.before_rms),
    }
    if found.effects:
        figures["with the identified effects"] = length(found.after_rms)
        if found.before_rms > 0.0:
            figures["reduction by the effects"] = f"{1.0 - found.after_rms / found.before_rms:.0%}"
    return figures | {
        "sensor noise, rms": length(found.noise_rms),
        "repeatability, rms": length(found.repeatability_rms),
    }


def _show_causes(page: Page, found: AxisDiagnosis) -> None:
    """Add the share of each cause in the error, its evidence, and the table of held-out errors."""
    page.section("Causes of the error")
    page.shares(_shares(found))
    for named in found.effects:
        page.subsection(named.name)
        page.definitions(_cause(named))
    page.table(("Model", "error, rms (nm)", "times the sensor noise", "reduction"), *_steps(found))


def _show_left(page: Page, name: str, found: AxisDiagnosis) -> None:
    """Add which measured variables go with what is left, and charts of the residual over these."""
    page.section("Remaining error")
    if not found.left:
        page.text("No recorded variable predicts the remaining error on held-out data.")
        return
    rows = [[one.variable, f"{one.share:.0%}", one.evidence] for one in found.left]
    caption = (
        "Share of the mean square of the residual that each variable alone predicts on held-out data; they overlap."
    )
    page.table(("Variable", "share", "evidence"), rows, None, caption)
    drawn = [one for one in found.left if one.curve[0].size][:_MOST_DRAWN]
    if drawn:
        chart = Chart(
            [Panel(_quantity(one), ERROR) for one in drawn],
            height=330,
        )
        for panel, one in enumerate(drawn):
            positive = one.curve[0] > 0.0 if one.variable == SINCE.name else np.isfinite(one.curve[0])
            chart.dots(panel, one.variable, one.curve[0][positive], one.curve[1][positive], BEFORE)
        page.chart(f"{name}-left", chart, "Measured - model as predicted by each of these variables alone.")


def _quantity(one: Left) -> Quantity:
    if one.variable == SINCE.name:
        return SINCE
    return DISPLACEMENT if one.unit == "m" else Quantity(one.variable, one.unit)


def _show_records(page: Page, found: AxisDiagnosis) -> None:
    if len(found.records) > 1:
        page.section("Errors by record")
        rows = [
            [
                each.source,
                f"{'+' if each.offset > 0.0 else ''}{length(each.offset + 0.0)}",
                *(length(rms) for rms in (each.before_rms, each.after_rms)),
                "-" if each.left_out_rms is None else length(each.left_out_rms),
            ]
            for each in found.records
        ]
        caption = (
            "Offset: by how much the zero has moved against the given model. Errors, rms, without it; held out: by a "
            "fit to the other records."
        )
        header = ("Record", "offset", "given model", "extended model", "held out")
        page.table(header, rows, None, caption)


def _shares(found: AxisDiagnosis) -> list[Share]:
    """Return the contributions to the mean square error before any effect."""
    parts = [
        Share(named.name, max(named.share_of_residual, 0.0), colour)
        for named, colour in zip(found.effects, _colours(len(found.effects)), strict=True)
    ]
    left = max(1.0 - sum(part.share for part in parts), 0.0)
    noise = min((found.noise_rms / found.before_rms) ** 2, left) if found.before_rms > 0.0 else left
    return [*parts, Share("noise", noise, NOISE), Share("unexplained", left - noise, BEFORE)]


def _colours(count: int) -> list[str]:
    return [CAUSES[k % len(CAUSES)] for k in range(count)]


def _cause(named: NamedEffect) -> dict[str, str]:
    said = {
        "Description": named.description,
        "Evidence": named.comparison,
        "Gain": f"{named.gain_percent:.1f} % less held-out error; "
        f"{named.share_of_residual:.0%} of the mean square error without effects",
        "p-value": f"{named.p_value:.2g}",
    }
    if named.alternatives:
        said["Alternatives"] = f"{', '.join(named.alternatives)}: this record does not distinguish these effects"
    parameters = _parameters(to_document(named.effect))
    return said | ({"Parameters (SI)": parameters} if parameters else {})


def _parameters(document: Mapping[str, object]) -> str:
    """Return parameters with their standard deviations as text; "not determined" where these exceed the value."""
    parameters, uncertainty = document.get("parameters"), document.get("uncertainty")
    if not isinstance(parameters, Mapping) or not isinstance(uncertainty, Mapping):
        return ""
    return "; ".join(f"{name} {_value(name, value, uncertainty)}" for name, value in parameters.items())


def _value(name: str, value: object, uncertainty: Mapping[str, float]) -> str:
    match value:
        case float() | int():
            scale = 1.0 if name.rpartition(".")[2] == "phase" else abs(value)
            return _estimate(value, uncertainty.get(name), scale)
        case None | [] | ():
            return "none"
        case [Mapping(), *_]:
            return "; ".join(_value(f"{name}.{k}", one, uncertainty) for k, one in enumerate(value))
        case list() | tuple():
            largest = max((abs(one) for one in value), default=0.0)
            shown = (_estimate(one, uncertainty.get(f"{name}.{k}"), largest) for k, one in enumerate(value))
            return f"[{', '.join(shown)}]"
        case Mapping():
            return ", ".join(f"{key}: {_value(f'{name}.{key}', one, uncertainty)}" for key, one in value.items())
        case _:
            return str(value)


def _estimate(value: float, deviation: float | None, scale: float) -> str:
    """Return a value with its standard deviation, if this is smaller than `scale`."""
    if deviation is None:
        return f"{value:.4g}"
    return f"{value:.4g} ± {deviation:.2g}" if deviation <= scale else "not determined"


def _steps(found: AxisDiagnosis) -> tuple[list[list[str]], int, str]:
    """Return the rows of the table of held-out errors, the index of the best row, and the caption."""

    def row(name: str, error: float, gain: str = "") -> list[str]:
        times = f"{error / found.noise_rms:.2f}" if found.noise_rms > 0.0 else ""
        return [name, f"{error * 1e9:.1f}", times, gain]

    rows = [row("given model", found.given_rms), row("refitted hysteresis", found.before_rms)]
    error = found.before_rms
    for named in found.effects:
        error *= 1.0 - named.gain_percent / 100.0
        rows.append(row(f"with {named.name}", error, f"{named.gain_percent:.1f} %"))
    if abs(found.after_rms - error) > _SAME * error:
        rows.append(row("all effects, fitted jointly", found.after_rms))
    best = len(rows) - 1
    caption = (
        "Free-run errors; all but that of the given model are held out. Sensor noise: the white part of the residual. "
        f"Repeatability: {found.repeatability_source}."
    )
    rows += [row("repeatability", found.repeatability_rms), row("sensor noise", found.noise_rms)]
    return rows, best, caption


def _show_charts(page: Page, name: str, found: AxisDiagnosis) -> None:
    traces = found.traces
    t, v, y = traces.t, traces.voltage, traces.measured
    page.section("Measured - model")
    if not t.size:
        page.text("The record holds no sample: there are no charts.")
        return
    motion = Motion.of(t, v)
    models = [Series(BEFORE_NAME, traces.before, BEFORE)]
    if found.effects:
        models.append(Series(AFTER_NAME, traces.after, AFTER))
    left = [Series(model.name, y - model.values, model.colour) for model in models]
    parts = _parts(traces)
    drawings = {
        "time": views.model_over_time(t, y, models, found.noise_rms, parts),
        "motion": views.over_motion(v, left, parts, motion),
        "frequency": views.over_frequency(t, left, parts, motion, found.noise_rms),
    }
    captions = {
        "time": "Displacement and measured - model over time; the grey band is plus or minus the sensor noise.",
        "motion": "Measured - model over voltage (lines: means for rising and falling voltage) and over its speed.",
        "frequency": "Measured - model over the time since the last reversal or stop, with means, and its spectrum.",
    }
    for what, (chart, said) in drawings.items():
        page.chart(f"{name}-{what}", chart, f"{captions[what]} {said}")
    if parts:
        page.text(
            "A line with an effect's name is its part of the residual without effects: its contribution to the "
            "displacement without the part that the refitted hysteresis had absorbed."
        )
    page.section("Model and measurement")
    loops, said = views.loops(v, y, models, motion)
    page.chart(f"{name}-loops", loops, f"{views.LOOPS} {said}")


def _parts(traces: Traces) -> list[Series]:
    """Return the contribution of each effect to the residual of the model without effects."""
    # The part absorbed by the hysteresis fitted alone is subtracted from the effects with which it is correlated.
    effects = {name: values - np.mean(values) for name, values in traces.contributions.items()}
    if not effects:
        return []
    explained = traces.after - traces.before
    imitated = sum(effects.values()) - (explained - np.mean(explained))
    weights = np.array([max(float(values @ imitated), 0.0) for values in effects.values()])
    weights = weights / weights.sum() if weights.any() else np.full(len(effects), 1.0 / len(effects))
    return [
        Series(name, values - weight * imitated, colour)
        for (name, values), weight, colour in zip(
            effects.items(), weights.tolist(), _colours(len(effects)), strict=True
        )
    ]


def diagnosis_limits(diagnosis: Diagnosis) -> dict[str, str]:
    """Return what limits the accuracy of the given model on each axis; axes at the sensor noise are left out."""
    limits = {}
    for name, found in diagnosis.axes.items():
        low, high = diagnosis.extended.axes[name].displacement_range
        causes = [
            f"{' or '.join((named.name, *named.alternatives))} ({named.gain_percent:.0f} %)" for named in found.effects
        ]
        if found.verdict == result.UNEXPLAINED:
            causes.append("a cause that is none of the known effects")
        if not causes and above_noise(found.given_rms, found.noise_rms, high - low):
            causes.append("a model that does not fit the stage as it is now")
        if not causes and is_without_hysteresis(diagnosis.extended.axes[name]):
            causes.append(NO_DRIVE)
        if causes:
            limits[name] = ", ".join(causes)
    return limits


def diagnosis_good(diagnosis: Diagnosis) -> str:
    """Return how good the given model is if nothing limits it."""
    axes = ((found, diagnosis.extended.axes[name].displacement_range) for name, found in diagnosis.axes.items())
    return how_good((found.given_rms, found.noise_rms, high - low) for found, (low, high) in axes)


def describe_diagnosis(diagnosis: Diagnosis) -> list[str]:
    """Return lines of text: for each axis the verdict, the causes, and the suggested next experiment."""
    lines = []
    for name, found in diagnosis.axes.items():
        told = [f"verdict: {found.verdict.replace('_', ' ')}", found.summary]
        told += [f"{named.name}: {named.evidence}" for named in found.effects]
        told += [f"next: {found.next_experiment}"] if found.next_experiment else []
        lines += [f"axis {name}: {line}" for line in told]
    return lines
