"""The page of a diagnosis: the verdict, the shares of the causes, and what a person sees and does."""

from dataclasses import replace

import numpy as np
import pytest
from reports.browser import Browser
from reports.pages import parsed, trace

from slpi_ros.diagnosis.result import (
    AMBIGUOUS,
    NAMED,
    NOTHING_FOUND,
    UNEXPLAINED,
    AxisDiagnosis,
    Diagnosis,
    NamedEffect,
    RecordOutcome,
    Traces,
)
from slpi_ros.effects.creep import Creep
from slpi_ros.effects.hum import Hum, Line
from slpi_ros.model.stage_model import StageModel
from slpi_ros.reports import diagnosis as diagnosis_page
from slpi_ros.reports.diagnosis import PAGE, page_of
from slpi_ros.reports.page import Page

CHARTS = ("time", "motion", "frequency", "loops")
HOSTILE = "</script><img src=x onerror=alert(1)>"


def traces(size=6000):
    """Return a record of a straight stage with a slow and a fast error, of which a model had imitated half the slow."""
    t = np.arange(size) * 2e-3
    v = 50.0 - 50.0 * np.cos(2 * np.pi * 0.5 * t)
    slow, fast = 400e-9 * np.sin(2 * np.pi * 0.13 * t), 60e-9 * np.sin(2 * np.pi * 50.0 * t)
    noise = 5e-9 * np.random.default_rng(1).standard_normal(size)
    alone = 2e-7 * v
    return Traces(
        t, v, alone + slow + fast + noise, alone + 0.5 * slow, alone + slow + fast, {"creep": slow, "hum": fast}
    )


def found(**changes):
    effects = (
        NamedEffect(
            Creep((1.0,), (0.02,)), 75.0, 0.85, 0.002, ("thermal_drift",), "It creeps", "Holds go on by 31 nm."
        ),
        NamedEffect(Hum((Line(50.0, 60e-9, 0.0),)), 84.0, 0.12, 0.002, (), "It hums", "A line stands at 50 Hz."),
    )
    axis = AxisDiagnosis(
        verdict=NAMED,
        summary="creep and hum make the error.",
        noise_rms=5e-9,
        repeatability_rms=5e-9,
        repeatability_source="repeats: 9 moves",
        given_rms=170e-9,
        before_rms=150e-9,
        after_rms=6e-9,
        effects=effects,
        next_experiment="Record the drive of `slpi excite --for creep`.",
        traces=traces(),
    )
    return replace(axis, **changes)


def write(folder, axes, source="some bag"):
    page_of(Diagnosis(axes, StageModel({}), source)).write(folder / PAGE)
    return folder / PAGE


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    quiet = found(verdict=NOTHING_FOUND, summary="only noise is left.", effects=(), next_experiment=None)
    return write(tmp_path_factory.mktemp("page") / "new", {"x": found(), "y": quiet})


def test_all_is_said_without_javascript(written):
    page, text = parsed(written), written.read_text(encoding="utf-8")
    assert page.texts["verdict-x"] == "named creep and hum make the error."
    assert page.texts["verdict-y"] == "nothing found only noise is left."
    verdicts = [attributes["data-verdict"] for attributes in page.tags("p") if "data-verdict" in attributes]
    assert verdicts == [NAMED, NOTHING_FOUND]
    for words in (
        *("Holds go on by 31 nm.", "A line stands at 50 Hz.", "thermal_drift", "slpi excite --for creep"),
        *("repeats: 9 moves", "150.0", "37.5", "6.0", "75.0 %", "0.002", "85%", "12%", "unexplained"),
    ):
        assert words in text
    assert text.count("Holds go on by 31 nm.") == text.count("It creeps") == 1
    assert set(page.charts) == {f"{axis}-{chart}" for axis in "xy" for chart in CHARTS}


def test_shares_of_causes_add_up_to_what_effects_explain(written):
    """The hysteresis had imitated half of the slow effect, nothing of the fast one."""
    chart, of = parsed(written).charts["x-time"], traces()
    t, creep = trace(chart, "creep", "y2")
    slow = of.contributions["creep"]
    assert np.allclose(creep, np.interp(t, of.t, 0.5e9 * (slow - slow.mean())), atol=4.0)
    t, hum = trace(chart, "hum", "y2")
    assert np.allclose(hum, 60.0 * np.sin(2 * np.pi * 50.0 * t), atol=4.0)
    before = trace(chart, "without effects", "y2")[1]
    assert np.isclose(before.max(), (of.measured - of.before).max() * 1e9, rtol=1e-5)


def test_spectrum_shows_the_line_and_the_noise(written):
    chart = parsed(written).charts["x-frequency"]
    frequency, density = trace(chart, "without effects", "y2")
    high = frequency > 10.0
    assert np.isclose(frequency[high][np.argmax(density[high])], 50.0, rtol=0.02)
    frequency, density = trace(chart, "with effects", "y2")
    _, floor = trace(chart, "sensor noise", "y2")
    assert np.allclose(floor, 5.0 * np.sqrt(2.0 / 500.0), rtol=1e-3)
    assert np.isclose(np.sqrt(np.mean(density[frequency > 5.0] ** 2)), floor[0], rtol=0.2)


def test_a_parameter_less_certain_than_its_size_is_not_determined(tmp_path):
    effects = [
        replace(named, effect=replace(named.effect, uncertainty=uncertainty))
        for named, uncertainty in zip(
            found().effects,
            (
                {"time_constants.0": 0.1, "gains.0": 1e4},
                {"lines.0.frequency": 0.01, "lines.0.amplitude": 7e-8, "lines.0.phase": 0.3},
            ),
            strict=True,
        )
    ]
    text = write(tmp_path, {"x": found(effects=tuple(effects))}).read_text(encoding="utf-8")
    assert "time_constants [1 ± 0.1]; gains [not determined]" in text
    assert "lines frequency: 50 ± 0.01, amplitude: not determined, phase: 0 ± 0.3" in text


@pytest.mark.parametrize("verdict", [AMBIGUOUS, UNEXPLAINED])
def test_other_verdicts(verdict, tmp_path):
    axis = found(verdict=verdict, effects=found().effects[:1] if verdict == AMBIGUOUS else (), after_rms=150e-9)
    page = parsed(write(tmp_path, {"x": axis}))
    assert page.texts["verdict-x"].startswith(verdict)


@pytest.mark.parametrize("size", [0, 1, 2, 7, 40])
def test_small_records(size, tmp_path):
    full = traces()
    parts = {name: values[:size] for name, values in full.contributions.items()}
    short = Traces(*(getattr(full, name)[:size] for name in ("t", "voltage", "measured", "before", "after")), parts)
    zero = dict.fromkeys(("noise_rms", "repeatability_rms", "before_rms", "after_rms", "given_rms"), 0.0)
    page = parsed(write(tmp_path, {"x": found(traces=short, **zero)}))
    assert len(page.charts) == (len(CHARTS) if size else 0)


def test_missing_readings(tmp_path):
    gaps = traces()
    gaps.measured[100:900] = np.nan
    page = parsed(write(tmp_path, {"x": found(traces=gaps)}))
    assert len(page.charts) == len(CHARTS)
    gaps.measured[:] = np.nan
    assert len(parsed(write(tmp_path, {"x": found(traces=gaps)})).charts) == len(CHARTS)


def test_commands_are_code_and_values_are_no_python(tmp_path):
    page = Page("page")
    page.text("`slpi refit <b>` with this record")
    page.table(("what",), [("see `slpi show`",)])
    page.write(tmp_path / "page.html")
    text = (tmp_path / "page.html").read_text()
    assert "<code>slpi refit &lt;b&gt;</code> with" in text and "<code>slpi show</code>" in text
    document = {"parameters": {"a": None, "b": [], "c": [1.0, 2.0]}, "uncertainty": {}}
    assert diagnosis_page._parameters(document) == "a none; b none; c [1, 2]"


def test_hostile_texts_stay_text(tmp_path):
    named = replace(found().effects[0], description=HOSTILE, comparison=HOSTILE, alternatives=(HOSTILE,))
    loud = replace(traces(), contributions={HOSTILE: traces().contributions["creep"]})
    axis = found(summary=HOSTILE, repeatability_source=HOSTILE, next_experiment=HOSTILE, effects=(named,), traces=loud)
    page = parsed(write(tmp_path, {HOSTILE: axis}, HOSTILE))
    assert not page.tags("img") and len(page.tags("script")) == 2 + len(CHARTS)
    assert HOSTILE in page.texts[f"verdict-{HOSTILE}"]


def test_a_person_reads_the_verdict_and_toggles_a_cause(written, tmp_path):
    browser = Browser(tmp_path / "profile")
    try:
        browser.open(written)
        assert browser.run("document.getElementById('verdict-x').innerText").endswith("creep and hum make the error.")
        assert browser.run("document.getElementById('verdict-x').dataset.verdict") == NAMED
        lines = "document.querySelectorAll('#x-time .scatterlayer .trace .js-line').length"
        assert browser.run(lines) == 7
        browser.click_legend("x-time", "creep")
        browser.until(f"{lines} === 6")
        browser.click_legend("x-time", "with effects")
        browser.until(f"{lines} === 4")
        browser.click_legend("x-time", "creep")
        browser.until(f"{lines} === 5")
        assert not browser.complaints()
        assert [url for url in browser.fetched() if not url.startswith("data:")] == [written.as_uri()]
    finally:
        browser.close()


def test_each_record_has_its_row(tmp_path):
    records = (
        RecordOutcome("first bag", -930e-9, 210e-9, 12.5e-9, 17.5e-9),
        RecordOutcome("second bag", 40e-9, 180e-9, 11.5e-9, None),
    )
    text = write(tmp_path, {"x": found(records=records)}).read_text(encoding="utf-8")
    cells = ["first bag", "-930 nm", "210 nm", "12.5 nm", "17.5 nm", "second bag", "+40 nm", "180 nm", "11.5 nm", "-"]
    rows = [f"<tr>{''.join(f'<td>{cell}</td>' for cell in row)}</tr>" for row in (cells[:5], cells[5:])]
    assert "".join(rows) in text
