"""The journal and the table: nothing finished is lost."""

import re
import subprocess
import sys
import textwrap
from pathlib import Path

import pandas as pd
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slpi_ros.errors import SlpiError, UsageError
from slpi_ros.fleet.bags import PASSED, Examined, Judged, Row, plain_name
from slpi_ros.fleet.pages import stage_page
from slpi_ros.fleet.results import JOURNAL, SCHEMA, TABLE, Results
from slpi_ros.fleet.sources import Bag

OPTIONS = {"topic": "stage_state"}
CAUSE = {"name": "creep", "parameters": "{}", "gain_percent": 1.0, "share_of_residual": 0.5, "p_value": 0.001}


def row(number):
    return Row(f"/bag{number}", "a", "x", PASSED, date_ns=number, gain_change=0.1 / 3, causes=(CAUSE,), findings=("f",))


def fill(results, count):
    for number in range(count):
        results.add_examined(Examined(Bag(f"/bag{number}"), "a", date_ns=number, axes=("x",), findings={"x": ("f",)}))
        results.add_judged(f"/bag{number}", Judged((row(number),), model=f"m{number}"), "a" if number == 0 else None)


def test_a_run_continues(tmp_path):
    with Results(tmp_path, OPTIONS) as results:
        fill(results, 3)
        before = results.state
    with Results(tmp_path, OPTIONS) as again:
        assert again.state == before and again.state.references == {"a": "m0"}


@pytest.mark.parametrize("cut", [1, 20, 300])
def test_an_incomplete_line_is_dropped(tmp_path, cut):
    with Results(tmp_path, OPTIONS) as results:
        fill(results, 3)
    journal = tmp_path / JOURNAL
    journal.write_bytes(journal.read_bytes()[:-cut])
    with Results(tmp_path, OPTIONS) as results:
        assert len(results.state.judged) == 2 and len(results.state.examined) == 3
        results.add_judged("/bag2", Judged((row(2),)))
    with Results(tmp_path, OPTIONS) as results:
        assert results.state.rows() == [row(0), row(1), row(2)]


def test_another_run_is_refused(tmp_path):
    with Results(tmp_path, OPTIONS), pytest.raises(SlpiError):
        Results(tmp_path, OPTIONS)
    Results(tmp_path, OPTIONS).close()


def test_other_options_and_other_files_are_refused(tmp_path):
    Results(tmp_path, OPTIONS).close()
    with pytest.raises(UsageError, match="topic"):
        Results(tmp_path, {"topic": "other"})
    (tmp_path / JOURNAL).write_text("no journal\n")
    with pytest.raises(SlpiError):
        Results(tmp_path, OPTIONS)
    assert (tmp_path / JOURNAL).read_text() == "no journal\n"


def test_the_table(tmp_path):
    with Results(tmp_path, OPTIONS) as results:
        fill(results, 2)
        results.add_judged("/bag9", Judged((Row("/bag9", error="cannot be read"),)))
        results.write_table()
    assert pq.read_schema(tmp_path / TABLE).metadata[b"schema"].decode() == SCHEMA
    table = pd.read_parquet(tmp_path / TABLE)
    assert list(table.bag) == ["/bag9", "/bag0", "/bag1"] and str(table.date.dtype) == "datetime64[ns, UTC]"
    assert table.gain_change[1] == 0.1 / 3 and table.causes[1][0] == CAUSE and pd.isna(table.gain_change[0])


def test_a_full_disk_keeps_what_is_there(tmp_path):
    """A limit of the file size fails as a full disk does, in the middle of a line."""
    code = """
        import resource, signal, sys
        sys.path.insert(0, sys.argv[2])
        from test_results import OPTIONS, fill
        from slpi_ros.fleet.results import Results
        from slpi_ros.errors import SlpiError
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (5000, resource.RLIM_INFINITY))
        try:
            with Results(sys.argv[1], OPTIONS) as results:
                fill(results, 100)
        except SlpiError as error:
            print(len(results.state.judged), error)
    """
    here = str(__import__("pathlib").Path(__file__).parent)
    command = [sys.executable, "-c", textwrap.dedent(code), str(tmp_path), here]
    said = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    kept = int(said.split()[0])
    assert 0 < kept < 100 and JOURNAL in said
    with Results(tmp_path, OPTIONS) as results:
        assert len(results.state.judged) == kept
        fill(results, 100)
        assert len(results.state.judged) == 100


TEXT = st.text(st.characters(codec="utf-8"), min_size=1, max_size=320)


@given(st.lists(TEXT, min_size=2, max_size=2, unique=True), st.sampled_from(["", "a" * 300]))
def test_every_stage_has_a_page_of_its_own(names, before):
    """A file system takes names of 255 characters."""
    stages = [before + name for name in names]
    pages = {stage_page(stage) for stage in stages}
    assert len(pages) == 2 and all(len(Path(page).name) <= 255 and page.count("/") == 1 for page in pages)
    plain = (stage for stage in stages if len(stage) <= 200 and re.fullmatch(r"[\w-]+", stage, re.ASCII))
    assert all(plain_name(stage) == stage for stage in plain)
