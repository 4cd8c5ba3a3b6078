"""The page of all experiments: complete, self-contained, and shown by a real browser."""

import html
import re
import shutil
import subprocess

import numpy as np
import pytest

from slpi_ros.papers import compound, measured, page, slpi_exhibits
from slpi_ros.papers import mpi_exhibits as mpi_paper
from slpi_ros.papers.exhibit import Exhibit


@pytest.fixture(scope="module")
def written(tmp_path_factory, random, slpi_shown):
    """Write the page with the SLPI paper's part as it is, and short stand-ins for what takes long."""
    short = [Exhibit("Fig. 2 of the other paper", "what it says", "what we found <1 µm", "a remark")]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(page, "study", lambda turns: random)
        patch.setattr(slpi_exhibits, "exhibits", lambda study: slpi_shown)
        patch.setattr(mpi_paper, "exhibits", lambda: short)
        patch.setattr(compound, "exhibits", lambda: [])
        return page.write_experiments(tmp_path_factory.mktemp("page") / "new" / "folder", None)


@pytest.mark.long
def test_page_holds_every_exhibit(written):
    text = html.unescape(written.read_text(encoding="utf-8"))
    for words in ("Fig. 9", "Fig. 15", "Table 5", "what we found <1 µm", "No measured records", "Difference"):
        assert words in text
    assert "://" not in re.sub(r"data:image/png;base64,[^\"]*", "", text)
    assert len(re.findall("<img ", text)) >= 8


@pytest.mark.long
def test_separation_table_beside_it(written):
    table = np.genfromtxt(written.parent / "separation.csv", delimiter=",", names=True)
    assert table.dtype.names == ("k", "voltage_V", "displacement_m", "tr", "lv", "sp")
    assert set(table["sp"]) == {0, 1, 2} and table["lv"].max() >= 2
    assert np.ptp(table["voltage_V"]) == 100.0 and 20e-6 < np.ptp(table["displacement_m"]) < 30e-6


@pytest.mark.long
def test_a_browser_shows_it(written, tmp_path):
    browser = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if not browser:
        pytest.skip("no Chromium on this machine")
    options = ["--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path / 'profile'}"]
    command = [browser, *options, "--dump-dom", written.as_uri()]
    shown = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False).stdout
    assert "Separated Level-loop" in shown and shown.count("<figure>") >= 8


@pytest.mark.long
def test_measured_records_are_compared_where_they_are(measured_data):
    shown = measured.exhibits(measured_data)
    assert [exhibit.title for exhibit in shown] == [f"Measured: {case.name}" for case in measured.CASES]
    rows = {row[0].split(":")[0]: row for row in shown[0].tables[0].rows}
    assert set(rows) == {"slpi", "slpi-published", "pi", "mpi", "smpi"}
    assert float(rows["slpi"][1]) < 0.065 < float(rows["pi"][1])


def test_a_refused_fit_is_told(tmp_path):
    case = measured.Case("flat", (0.0, 0.5), {"second half": (0.5, 1.0)})
    rows = "\n".join(f"{k / 100},{5.0},{1.0}" for k in range(200))
    (tmp_path / "flat.csv").write_text(f"time_s,voltage_V,displacement_um\n{rows}\n")
    exhibit = measured._exhibit(tmp_path, case)
    assert "slpi refused" in exhibit.remark and "No kind" in exhibit.ours
    assert all(row[1] == "-" for row in exhibit.tables[0].rows)
