"""Charts: the numbers in their units, and nothing that a page or plotly.js would misread."""

import json

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from reports.pages import unpacked

from slpi_ros.reports.chart import DISPLACEMENT, ERROR, TIME, VOLTAGE, Chart, Panel, Quantity


def test_values_arrive_in_their_units_to_what_a_picture_shows():
    x, y = np.linspace(0.0, 3600.0, 5000), np.random.default_rng(0).uniform(-30e-6, 30e-6, 5000)
    y[7] = np.nan
    chart = Chart([Panel(TIME, DISPLACEMENT)])
    chart.line(0, "measured", x, y, "#000")
    drawn = json.loads(chart.to_json())
    (line,) = drawn["data"]
    assert np.allclose(unpacked(line["x"]), x, atol=3e-4)
    assert np.allclose(unpacked(line["y"]), y * 1e6, atol=2e-6, equal_nan=True)
    assert drawn["layout"]["yaxis"]["title"]["text"] == "displacement (µm)"
    assert "µm" in line["hovertemplate"]


@given(st.text(max_size=40))
def test_no_name_leaves_its_script_element(name):
    chart = Chart([Panel(VOLTAGE, ERROR)])
    chart.line(0, name, np.zeros(2), np.zeros(2), "#000")
    text = chart.to_json()
    assert not set("<>&") & set(text)
    assert "<" not in json.loads(text)["data"][0]["name"]


def test_one_name_in_the_legend_for_all_panels():
    chart = Chart([Panel(VOLTAGE, ERROR), Panel(TIME, ERROR)])
    for panel in (0, 1):
        chart.dots(panel, "before", np.zeros(2), np.zeros(2), "#000", faint=True)
        chart.line(panel, "before", np.zeros(2), np.zeros(2), "#000")
    data = json.loads(chart.to_json())["data"]
    assert [one["showlegend"] for one in data] == [False, True, False, False]
    assert {one["legendgroup"] for one in data} == {"before"}


def test_panels_share_the_axis_that_shows_the_same():
    row = json.loads(Chart([Panel(VOLTAGE, ERROR), Panel(TIME, ERROR), Panel(TIME, DISPLACEMENT)]).to_json())["layout"]
    assert row["yaxis2"]["matches"] == "y" and "matches" not in row["yaxis3"]
    domains = [row[f"xaxis{k}"]["domain"] for k in ("", 2, 3)]
    assert domains[0][0] == 0.0 and np.isclose(domains[2][1], 1.0)
    assert all(a[1] < b[0] for a, b in zip(domains, domains[1:], strict=False))
    column = json.loads(Chart([Panel(TIME, DISPLACEMENT), Panel(TIME, ERROR)], "column").to_json())["layout"]
    assert column["xaxis2"]["matches"] == "x" and column["yaxis"]["domain"][0] > column["yaxis2"]["domain"][1]


def test_a_view_of_a_logarithmic_axis_is_in_decades():
    density = Quantity("density", "nm", 1e9, logarithmic=True)
    chart = Chart([Panel(TIME, density)])
    chart.show(0, 1e-9, 1e-7)
    assert np.allclose(json.loads(chart.to_json())["layout"]["yaxis"]["range"], [0.0, 2.0])
