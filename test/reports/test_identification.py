"""The page of an identification: its numbers, whatever the record, and in a real browser."""

import json
from dataclasses import replace

import numpy as np
import pytest
from identification.records import calibration, record_of
from reports.browser import Browser
from reports.pages import parsed, trace, unpacked

import slpi_ros
from slpi_ros.errors import UsageError
from slpi_ros.hysteresis.prandtl_ishlinskii import PrandtlIshlinskii
from slpi_ros.identification.cross_validation import CrossValidationReport, Slice
from slpi_ros.identification.repeatability import Repeatability
from slpi_ros.io.record import Record
from slpi_ros.model.axis_model import AxisModel, FitQuality, Start
from slpi_ros.model.stage_model import StageModel
from slpi_ros.reports.identification import write_report

HOSTILE = """<script>alert(1)</script>"' onload=x &amp; <img src=http://x/y>"""
CHARTS = ("loops", "time", "residual", "coverage")


@pytest.fixture(scope="module")
def identified():
    record, _ = calibration(3, duration=15.0)
    return record, slpi_ros.identify(record, "pi")


@pytest.fixture(scope="module")
def written(identified, tmp_path_factory):
    record, model = identified
    return write_report(tmp_path_factory.mktemp("page") / "new", record, model, held_out={"x": truth_of(record)})


def truth_of(record):
    part = Slice("all samples", 2000, 12.3e-9, 45.6e-9, 78.9e-9)
    error = 1e-9 * np.arange(record.t.size)
    return CrossValidationReport(
        axis="x",
        kind="slpi",
        repeatability=Repeatability(8.7e-9, "repeats: 5 <moves>"),
        overall=part,
        by_level=(replace(part, name="outer loop", classical_rms=np.nan),),
        by_region=(replace(part, name="0 to 20 V", rms=34.5e-9),),
        by_speed=(replace(part, name="at rest"),),
        t=record.t,
        v=record.voltage["x"],
        error=error,
        classical=-2.0 * error,
    )


def small_model(axes=("x",)):
    shape = PrandtlIshlinskii(np.array([0.0, 1.0]), np.array([1e-7, 1e-7]))
    quality = FitQuality(1e-9, 2e-9, 3e-9, 0.0, 3, 0.1, "test")
    axis = AxisModel("pi", shape, Start(0.0, 0.0), (0.0, 1.0), (0.0, 1e-6), quality)
    return StageModel(dict.fromkeys(axes, axis))


def test_numbers_are_there_without_javascript(written, identified):
    page = parsed(written)
    text = written.read_text(encoding="utf-8")
    assert "12.3 nm" in page.texts["verdict-x"] and "8.7 nm" in page.texts["verdict-x"]
    assert "78.9 nm" in page.texts["verdict-x"]
    for words in ("outer loop", "0 to 20 V", "34.5", "at rest", "repeats: 5 &lt;moves&gt;", "by speed", "memory known"):
        assert words in text
    assert [name for name in CHARTS if f"x-{name}" in page.charts] == list(CHARTS)


def test_charts_hold_record_and_model(written, identified):
    record, model = identified
    charts = parsed(written).charts
    simulated = model.simulate(record.t, record.voltage["x"])
    left = (record.displacement["x"] - simulated) * 1e9
    t, drawn = trace(charts["x-time"], "model", "y2")
    assert t[0] == 0.0 and np.isclose(t[-1], record.t[-1], rtol=1e-6)
    assert np.isclose(drawn.max(), left.max(), rtol=1e-5) and np.isclose(drawn.min(), left.min(), rtol=1e-5)
    v, y = trace(charts["x-loops"], "measured")
    assert np.isclose(np.nanmax(y), record.displacement["x"].max() * 1e6, rtol=1e-6)
    # The sign of an error is that of the record, in truths too: what is left of it.
    _, error = trace(charts["x-held-out"], "slpi")
    _, classical = trace(charts["x-held-out"], "classical PI")
    assert np.nanmin(error) < 0.0 == np.nanmax(error) and np.nanmin(classical) == 0.0 < np.nanmax(classical)
    counts, _ = trace(charts["x-residual"], "used samples", "y2")
    assert counts.sum() == len(record)
    assert "not used" not in json.dumps(charts)


def maps_of(chart):
    """Return the maps of a chart, each shape (n, n); 0 where they are empty."""
    maps = [one["z"] for one in chart["data"] if one["type"] == "heatmap"]
    return [np.nan_to_num(unpacked(z)).reshape([int(n) for n in z["shape"].split(",")]) for z in maps]


def test_what_was_not_fitted_is_marked_and_counts_nowhere(identified, written, tmp_path):
    record, model = identified
    path = write_report(tmp_path, record, model, held_out={"x": truth_of(record)}, start=3.0, stop=9.0)
    charts, whole = parsed(path).charts, parsed(written).charts
    fitted = (record.t >= 3.0) & (record.t < 9.0)
    left = (record.displacement["x"] - model.simulate(record.t, record.voltage["x"]))[fitted]
    counts, errors = maps_of(charts["x-coverage"])
    all_counts, _ = maps_of(whole["x-coverage"])
    # Each sample lies where it lies in the whole record: what was before still says where branches began.
    assert counts.sum() == fitted.sum() and np.all(counts <= all_counts)
    assert np.isclose((counts * errors**2).sum(), ((left * 1e9) ** 2).sum(), rtol=1e-5)
    assert trace(charts["x-residual"], "used samples", "y2")[0].sum() == fitted.sum()
    # Nothing is hidden: the rest is there, but apart.
    assert np.isfinite(trace(charts["x-residual"], "not used")[1]).any()
    for name in ("measured", "model"):
        lines = [trace(charts["x-loops"], part)[1] for part in (name, f"{name}, not used")]
        assert all(np.isfinite(line).any() for line in lines)
        assert np.array_equal(*map(np.isfinite, (lines[0], np.where(np.isfinite(lines[1]), np.nan, 0.0))))
    shaded = [shape for shape in charts["x-time"]["layout"]["shapes"] if shape.get("name") == "not used"]
    spans = [(shape["xref"], pytest.approx(shape["x0"]), pytest.approx(shape["x1"])) for shape in shaded]
    ends = ((0.0, 3.0), (9.0, record.t[-1]))
    assert sorted(spans, key=str) == sorted([(x, *span) for x in ("x", "x2") for span in ends], key=str)
    assert [shape["showlegend"] for shape in shaded] == [True, False, False, False]
    assert "8.995 s" in path.read_text(encoding="utf-8")


def test_the_legend_hides_what_was_not_fitted(identified, tmp_path):
    browser = Browser(tmp_path / "profile")
    try:
        browser.open(write_report(tmp_path, *identified, start=3.0, stop=9.0))
        shaded = (
            "[...document.querySelectorAll('#x-time .shapelayer path')]"
            ".filter(path => path.style.fill === 'rgb(251, 236, 203)').length"
        )
        assert browser.run(shaded) == 4
        browser.click_legend("x-time", "not used")
        browser.until(f"{shaded} === 0")
        browser.click_legend("x-time", "not used")
        browser.until(f"{shaded} === 4")
        assert not browser.complaints()
    finally:
        browser.close()


@pytest.mark.parametrize("duration", [15.0, 60.0])
def test_no_reading_is_a_gap(duration, tmp_path):
    t = np.arange(round(duration * 200)) / 200.0
    v = 0.5 + 0.4 * np.sin(2.0 * t)
    y = 1e-6 * (1.0 + v)
    missing = (t > 3.0) & (t < 4.5)
    y[missing] = np.nan
    charts = parsed(write_report(tmp_path, record_of(t, v, y), small_model())).charts
    for axis, name in (("y", "measured"), ("y2", "model")):
        when, drawn = trace(charts["x-time"], name, axis)
        inside = (when > 3.001) & (when < 4.499)
        assert np.isnan(drawn[inside]).all() and inside.any() and np.isfinite(drawn[~inside]).all()
    assert np.nanmin(trace(charts["x-loops"], "measured")[1]) > 1.09
    assert trace(charts["x-residual"], "used samples", "y2")[0].sum() == maps_of(charts["x-coverage"])[0].sum()
    assert maps_of(charts["x-coverage"])[0].sum() == np.count_nonzero(~missing)


def test_a_sensor_slower_than_the_record_is_seen(tmp_path):
    t = np.arange(1000) / 200.0
    v = 0.5 + 0.4 * np.sin(2.0 * t)
    y = np.where(np.arange(t.size) % 4, np.nan, 1e-6 * v)
    chart = parsed(write_report(tmp_path, record_of(t, v, y), small_model())).charts["x-time"]
    assert {one["name"]: one["mode"] for one in chart["data"] if one["yaxis"] == "y"} == {
        "measured": "lines+markers",
        "model": "lines",
    }


def test_nothing_is_taken_from_elsewhere(written):
    page = parsed(written)
    links = [value for _, attributes in page.elements for name, value in attributes.items() if name in ("src", "href")]
    assert not links
    (policy,) = [meta["content"] for meta in page.tags("meta") if "http-equiv" in meta]
    assert "default-src 'none'" in policy and "unsafe-eval" not in policy and "http" not in policy
    assert written.stat().st_size < 4e6


def test_hostile_names_stay_text(tmp_path):
    t = np.arange(300) * 0.01
    v = 1.0 - np.abs(1.0 - np.mod(t, 2.0))
    names = (HOSTILE, "y", "</script>")
    record = Record((t * 1e9).astype(np.int64), dict.fromkeys(names, v), dict.fromkeys(names, 1e-6 * v), HOSTILE)
    path = write_report(tmp_path, record, small_model(names))
    page = parsed(path)
    assert len(page.tags("script")) == 2 + len(CHARTS) * len(names)
    assert not page.tags("img") and not any(name.startswith("on") for _, a in page.elements for name in a)
    assert page.texts[f"axis-{HOSTILE}"] == f"Axis {HOSTILE}" and f"verdict-{HOSTILE}" in page.texts
    assert f"{HOSTILE}-loops" in page.charts
    with_browser(path, tmp_path, lambda browser: browser.run("document.querySelectorAll('.js-plotly-plot').length"), 12)


def with_browser(path, folder, look, expected):
    browser = Browser(folder / "profile")
    try:
        browser.open(path)
        assert look(browser) == expected
        assert not browser.complaints()
    finally:
        browser.close()


@pytest.mark.parametrize("size", [0, 1, 2, 5, 60])
def test_small_records(size, tmp_path):
    t = np.arange(size) * 0.01
    record = record_of(t, np.mod(t, 0.3), 1e-7 * t)
    page = parsed(write_report(tmp_path, record, small_model()))
    assert "verdict-x" in page.texts
    assert len(page.charts) == (len(CHARTS) if size else 0)


@pytest.mark.parametrize("missing", ["voltage", "displacement", "half"])
def test_records_with_nothing_in_places(missing, tmp_path):
    t = np.arange(400) * 0.01
    v, y = np.abs(1.0 - np.mod(t, 2.0)), 1e-6 * np.abs(1.0 - np.mod(t, 2.0))
    if missing == "voltage":
        v[:] = np.nan
    elif missing == "displacement":
        y[:] = np.nan
    else:
        v[100:150], y[120:300] = np.nan, np.nan
    page = parsed(write_report(tmp_path, record_of(t, v, y), small_model()))
    assert len(page.charts) == (0 if missing == "voltage" else len(CHARTS))


def test_a_constant_voltage_is_drawn(tmp_path):
    page = parsed(
        write_report(tmp_path, record_of(np.arange(100) * 0.1, np.full(100, 0.5), np.zeros(100)), small_model())
    )
    assert len(page.charts) == len(CHARTS)


def test_many_loops_are_drawn_whole_but_not_all(tmp_path):
    t = np.arange(60_000) * 1e-3
    v = 0.5 - 0.5 * np.cos(2 * np.pi * 10.0 * t)
    path = write_report(tmp_path, record_of(t, v, 1e-7 * v), small_model())
    v_drawn, _ = trace(parsed(path).charts["x-loops"], "measured")
    assert 2000 < v_drawn.size < 7000
    gaps = np.flatnonzero(np.isnan(v_drawn))
    first = v_drawn[: gaps[0]]
    assert np.all(np.diff(first) > 0.0) and np.ptp(first) > 0.99
    assert "1200 branches" in path.read_text(encoding="utf-8")


def test_an_axis_that_the_record_lacks_is_told(tmp_path):
    with pytest.raises(UsageError, match="'q'"):
        write_report(tmp_path, record_of(np.arange(9.0), np.arange(9.0), np.arange(9.0)), small_model(("q",)))


def test_a_person_looks_closer(written, tmp_path):
    """In a real browser: all is drawn, nothing is fetched, the legend hides a curve, dragging zooms, hovering tells."""
    browser = Browser(tmp_path / "profile")
    try:
        browser.open(written)
        drawn = "document.querySelectorAll('#x-loops .scatterlayer .trace .js-line').length"
        assert browser.run(drawn) == 4
        browser.click_legend("x-loops", "model")
        browser.until(f"{drawn} === 2")
        browser.click_legend("x-loops", "model")
        browser.until(f"{drawn} === 4")

        left, top, width, height = browser.place_of(
            "document.querySelector('#x-time .xy .gridlayer, #x-time .nsewdrag')"
        )
        browser.drag((left + 0.3 * width, top + 0.2 * height), (left + 0.6 * width, top + 0.8 * height))
        view = "document.getElementById('x-time')._fullLayout.xaxis2.range"
        browser.until(f"{view}[1] - {view}[0] < 8")

        left, top, width, height = browser.place_of("document.querySelector('#x-time .nsewdrag')")
        for share in (0.5, 0.52):
            place = {"x": left + share * width, "y": top + 0.5 * height}
            browser.call("Input.dispatchMouseEvent", type="mouseMoved", **place)
        browser.until("/µm/.test(document.querySelector('#x-time .hoverlayer').textContent)")

        assert [url for url in browser.fetched() if not url.startswith(("data:", "blob:"))] == [written.as_uri()]
        assert not browser.complaints()
        blocked = browser.run(
            "new Promise(done => { addEventListener('securitypolicyviolation', e => done(e.effectiveDirective));"
            " fetch('http://127.0.0.1:9/').catch(() => setTimeout(() => done('let through'), 3000)); })"
        )
        assert blocked == "connect-src"
    finally:
        browser.close()
