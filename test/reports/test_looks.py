"""Pages as they look: on dark paper, on a telephone, and printed."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from calibration.stages import settings
from reports.browser import Browser
from reports.test_diagnosis import found, write
from strategies import PI_CASE, axis_model

from slpi_ros.calibration.run import Outcome, Step, TrackingError
from slpi_ros.cli import main
from slpi_ros.diagnosis.result import Diagnosis, RecordOutcome
from slpi_ros.model.stage_model import StageModel
from slpi_ros.reports import calibration, chart

EXAMPLES = Path(__file__).resolve().parents[2] / "docs" / "examples"

FREE = """[...document.querySelectorAll('figure.chart')].every(figure =>
  (figure.querySelector('.legend .bg')?.getBoundingClientRect().bottom ?? -1e9)
    <= figure.querySelector('.nsewdrag').getBoundingClientRect().top
  && figure.querySelector('.main-svg').getBoundingClientRect().bottom
    <= figure.querySelector('figcaption').getBoundingClientRect().top + 1)"""
# Charts of which the legend lies under the buttons.
UNDER = """[...document.querySelectorAll('figure.chart')].filter(figure => {
  const [a, b] = ['.legend .bg', '.modebar'].map(part => figure.querySelector(part)?.getBoundingClientRect());
  return a && b && a.right > b.left && a.bottom > b.top && a.top < b.bottom; }).length"""
PAPER = "document.querySelector('#x-time .main-svg').style.background"
NOISE_FLOOR = "[...document.querySelectorAll('#x-frequency .js-line')].at(-1).style.stroke"
BESIDE = """(([a, b]) => a.getBoundingClientRect().top === b.getBoundingClientRect().top)(
  [...document.querySelectorAll('#x-loops .nsewdrag')])"""
# What is beyond the window, what is read by scrolling within the page, and the smallest letters, pixels.
BEYOND = """[...document.querySelectorAll('body *:not(svg *)')].filter(
  e => e.getBoundingClientRect().right > innerWidth + 1).length"""
SCROLLED = "[...document.querySelectorAll('.scroll')].filter(e => e.scrollWidth > e.clientWidth).length"
LETTERS = """Math.min(...[...document.querySelectorAll('body *:not(script)')].filter(
  e => e.checkVisibility() && [...e.childNodes].some(part => part.nodeType === 3 && part.data.trim())).map(
  e => parseFloat(getComputedStyle(e).fontSize)))"""
# Within A4 with the margins of the style sheet, pixels.
PAPER_WIDTH, PAPER_HEIGHT = 688, 1017
LONG_NAME = "2026-11-29_of_a_stage_with_a_very_long_name/03_calibration"


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    folder = tmp_path_factory.mktemp("looks")
    browser = Browser(folder / "profile")
    browser.page = write(folder / "page", {"x": found()})
    yield browser
    browser.close()


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    """Return the pages of ``verify``, ``tune`` and ``identify`` on the example, a diagnosis, and a calibration."""
    made = tmp_path_factory.mktemp("pages")
    bag, model = made / LONG_NAME / "xy_stage", EXAMPLES / "xy_stage.json"
    shutil.copytree(EXAMPLES / "xy_stage", bag)
    main(["verify", str(bag), "--model", str(model), "-o", str(made / "verify")])
    main(["tune", str(model), "-o", str(made / "gains.yaml"), "--report", str(made / "tune")])
    main(["identify", str(bag), "-o", str(made / "model.json"), "--report", str(made / "identify")])
    records = tuple(RecordOutcome(LONG_NAME, 1e-7, 2e-8, 1e-8, 9e-9) for _ in range(2))
    axis = found(records=records, summary="creep and hum make the error. " * 5)
    write(made / "diagnose", {"x": axis}, LONG_NAME)
    t = np.arange(2000) / 200.0
    error = 1e-8 * np.random.default_rng(1).standard_normal(t.size)
    tracked = {"x": TrackingError(1e-8, 1e-8, 4e-8, 0.0, 1e-8, 2e-5, 2e-8, t, 1e-6 * t, error)}
    steps = [Step(f"{k:02d}_verification", 20.0, "a path " * 12, "mean error " * 12, tracked) for k in (5, 9)]
    stage = StageModel({"x": axis_model(PI_CASE)})
    outcome = Outcome(settings(), stage, tracked, Diagnosis({"x": axis}, stage, LONG_NAME), tuple(steps), "target met")
    calibration.page_of(outcome).write(made / "calibrate" / "report.html")
    return {path.parent.name: path for path in made.glob("*/report.html")}


def look(browser, width, scheme, page=None, **more):
    metrics = {"width": width, "height": 844, "deviceScaleFactor": 1, "mobile": False}
    browser.call("Emulation.setDeviceMetricsOverride", **metrics | more)
    browser.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": scheme}])
    browser.open(page or browser.page)


NAMES = ("calibrate", "diagnose", "identify", "tune", "verify")


@pytest.mark.parametrize("name", NAMES)
def test_a_telephone_shows_all_without_scrolling_sideways(browser, pages, name):
    look(browser, 390, "light", pages[name], mobile=True)
    browser.until(FREE)
    assert browser.run("document.documentElement.scrollWidth") == 390
    assert browser.run(BEYOND) == 0 and browser.run(SCROLLED) == 0
    assert browser.run(LETTERS) >= 11.0
    # A finger that moves up on a chart scrolls the page.
    assert browser.run("[...document.querySelectorAll('figure.chart > div')].every(e => !e._fullLayout.dragmode)")


@pytest.mark.parametrize("name", NAMES)
def test_paper_holds_all(browser, pages, name):
    look(browser, PAPER_WIDTH, "light", pages[name])
    browser.call("Emulation.setEmulatedMedia", media="print")
    browser.run("window.dispatchEvent(new Event('beforeprint'))")
    fits = f"[...document.querySelectorAll('figure.chart')].every(e => e.clientHeight <= {PAPER_HEIGHT})"
    browser.until(f"{fits} && {BEYOND} === 0")
    assert browser.run(SCROLLED) == 0
    whole = "[...document.querySelectorAll('figure.chart')].every(e => getComputedStyle(e).breakInside === 'avoid')"
    # Else each chart would have to be on the page of the next one, and would be split.
    free = "[...document.querySelectorAll('figcaption')].every(e => getComputedStyle(e).breakAfter === 'auto')"
    assert browser.run(whole) and browser.run(free)
    useless = "[...document.querySelectorAll('nav, .hint, .modebar')].some(e => e.checkVisibility())"
    assert not browser.run(useless)
    browser.run("window.dispatchEvent(new Event('afterprint'))")
    browser.call("Emulation.setEmulatedMedia", media="")


def test_colours_of_a_chart_differ_in_grey():
    def grey(colour):
        share = np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)]) / 255.0
        linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
        return 116.0 * np.cbrt(linear @ (0.2126, 0.7152, 0.0722)) - 16.0

    for together in (
        (chart.DESIRED, chart.AFTER, chart.BEFORE, chart.MEASURED, chart.NOISE),
        (chart.AFTER, chart.CAUSES[0], chart.BEFORE, chart.CAUSES[1]),
        chart.CAUSES[:2],
        chart.CAUSES[1:3],
        chart.CAUSES[2:4],
    ):
        assert np.diff(sorted(map(grey, together))).min() > 9.0


def rgb(colour):
    return f"rgb({', '.join(str(int(colour[k : k + 2], 16)) for k in (1, 3, 5))})"


@pytest.mark.parametrize("width", [320, 400, 700, 1200])
def test_no_legend_covers_a_chart_and_nothing_is_wider_than_the_window(browser, width):
    look(browser, width, "light")
    browser.until(FREE)
    assert browser.run("document.documentElement.scrollWidth") <= width
    assert browser.run(BESIDE) == (width > 640)
    assert not browser.complaints()


@pytest.mark.parametrize("width", [700, 900, 1280])
def test_no_button_covers_a_legend(browser, pages, width):
    look(browser, width, "light", pages["verify"])
    assert browser.run("document.querySelectorAll('.modebar').length") > 0
    browser.until(FREE)
    assert browser.run(UNDER) == 0


def test_dark_paper_has_light_ink_and_is_printed_light(browser):
    look(browser, 1200, "light")
    assert browser.run(PAPER) == "rgb(255, 255, 255)"
    assert browser.run(NOISE_FLOOR) == rgb(chart.DESIRED)
    # The colours change while the page is open, and its charts stay as they are.
    browser.click_legend("x-time", "creep")
    lines = "document.querySelectorAll('#x-time .scatterlayer .trace .js-line').length"
    browser.until(f"{lines} === 6")
    dark = [{"name": "prefers-color-scheme", "value": "dark"}]
    browser.call("Emulation.setEmulatedMedia", features=dark)
    browser.until(f"{PAPER} !== 'rgb(255, 255, 255)' && {NOISE_FLOOR} !== '{rgb(chart.DESIRED)}'")
    paper, ink = (f"getComputedStyle(document.body).{what}" for what in ("backgroundColor", "color"))
    assert browser.run(PAPER) == browser.run(paper)
    assert browser.run(f"Math.min(...{ink}.match(/\\d+/g)) - Math.max(...{paper}.match(/\\d+/g))") > 150
    assert browser.run(lines) == 6
    browser.run("window.dispatchEvent(new Event('beforeprint'))")
    browser.until(f"{PAPER} === 'rgb(255, 255, 255)'")
    assert browser.run("document.querySelector('#x-time .main-svg').clientWidth") < 720
    browser.run("window.dispatchEvent(new Event('afterprint'))")
    browser.until(f"{PAPER} !== 'rgb(255, 255, 255)'")
    assert not browser.complaints()
