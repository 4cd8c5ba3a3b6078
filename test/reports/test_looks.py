"""Pages as they look: on dark paper, in a narrow window, and printed."""

import pytest
from reports.browser import Browser
from reports.test_diagnosis import found, write

from slpi_ros.reports import chart

FREE = """[...document.querySelectorAll('figure.chart')].every(figure =>
  figure.querySelector('.legend .bg').getBoundingClientRect().bottom
    <= figure.querySelector('.nsewdrag').getBoundingClientRect().top
  && figure.querySelector('.main-svg').getBoundingClientRect().bottom
    <= figure.querySelector('figcaption').getBoundingClientRect().top + 1)"""
PAPER = "document.querySelector('#x-time .main-svg').style.background"
NOISE_FLOOR = "[...document.querySelectorAll('#x-frequency .js-line')].at(-1).style.stroke"
BESIDE = """(([a, b]) => a.getBoundingClientRect().top === b.getBoundingClientRect().top)(
  [...document.querySelectorAll('#x-loops .nsewdrag')])"""


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    folder = tmp_path_factory.mktemp("looks")
    browser = Browser(folder / "profile")
    browser.page = write(folder / "page", {"x": found()})
    yield browser
    browser.close()


def look(browser, width, scheme):
    browser.call("Emulation.setDeviceMetricsOverride", width=width, height=900, deviceScaleFactor=1, mobile=False)
    browser.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": scheme}])
    browser.open(browser.page)


def rgb(colour):
    return f"rgb({', '.join(str(int(colour[k : k + 2], 16)) for k in (1, 3, 5))})"


@pytest.mark.parametrize("width", [320, 400, 700, 1200])
def test_no_legend_covers_a_chart_and_nothing_is_wider_than_the_window(browser, width):
    look(browser, width, "light")
    browser.until(FREE)
    assert browser.run("document.documentElement.scrollWidth") <= width
    assert browser.run(BESIDE) == (width > 640)
    assert not browser.complaints()


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
