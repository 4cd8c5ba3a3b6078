"""The SLPI paper's experiment: its targets, and paths."""

import re
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slpi_ros.hysteresis.slpi_published import separate
from slpi_ros.papers import slpi_exhibits
from slpi_ros.papers.mpi_study import triangles
from slpi_ros.papers.slpi_study import (
    AT_REST,
    CLASSICAL,
    CLOSING,
    FAMILY,
    MODELS,
    OVERALL_MEAN,
    LoopErrors,
    gain,
    ramps,
    straight_between_reversals,
    unseen_paths,
)


def test_published_slpi_beats_classical_pi_as_the_paper_says(random):
    errors = random.compensated
    assert gain(errors[CLASSICAL].overall, errors[CLOSING].overall) >= OVERALL_MEAN
    assert gain(errors[CLASSICAL].means[-1], errors[CLOSING].means[-1]) >= 90.0
    assert errors[CLOSING].maxima[0] < errors[CLASSICAL].maxima[0]


def test_loop_family_is_better_than_both(random):
    for errors in (random.modelled, random.compensated, random.straight):
        others = [errors[name].overall for name in MODELS if name != FAMILY]
        assert errors[FAMILY].overall < 0.2 * min(others)
    unseen = unseen_paths(random)
    assert unseen.replaced > 0
    for name in MODELS[:-1]:
        assert np.mean(unseen.mean_errors[FAMILY]) < 0.2 * np.mean(unseen.mean_errors[name])


def test_closing_form_closes_every_loop(random):
    stroke = np.ptp(random.separation.displacement)
    inner = [loop for loop in random.closing.loops if loop.level]
    assert len(inner) == 2
    # In the path as a whole too: just after the vertex it is where it is just before it comes back.
    v = random.separation.voltage
    for loop in random.separation.loops[1:]:
        closing = int(loop.samples[-1]) + 1
        beside = v[loop.vertex] + loop.direction * 1e-9
        fine = np.insert(v, [loop.vertex + 1, closing], beside)
        y = random.closing.along(0.0, 0.0).forward_array(fine)
        assert abs(y[loop.vertex + 1] - y[closing + 1]) <= 1e-9 * stroke
    for loop in inner:
        path = np.concatenate([np.linspace(0, loop.span[0], 50), np.linspace(loop.span[0], 0, 50)])
        assert abs(loop.memory().forward_array(path)[-1]) <= 1e-9 * stroke
    assert max(slpi_exhibits._gaps(random.at_rest).values()) > 0.01 * stroke


def test_errors_are_those_of_each_loop():
    v = ramps((0.0, 80.0, 40.0, 100.0), 10.0)
    loops = separate(v).loops
    error = np.zeros(v.size)
    error[loops[1].samples] = -2.0
    error[loops[0].samples] = 1.0
    errors = LoopErrors.of(error, loops)
    assert errors.means == (1.0, 2.0) and errors.maxima == (1.0, 2.0) and errors.spread == 1.0
    assert errors.overall == pytest.approx((loops[0].samples.size + 2 * loops[1].samples.size) / v.size)


def test_every_exhibit_is_complete(slpi_shown):
    titles = " ".join(exhibit.title for exhibit in slpi_shown)
    captions = " ".join(picture.caption for exhibit in slpi_shown for picture in exhibit.pictures)
    for number in (5, 7, 9, 10, 12, 13, 14, 15, 16, 17, 18, 19):
        assert re.search(rf"\b{number}\b", titles + captions), number
    assert "Tables 2 to 4" in titles and "Table 5" in titles
    for exhibit in slpi_shown:
        assert exhibit.paper and exhibit.ours and exhibit.remark
        for table in exhibit.tables:
            assert all(len(row) == len(table.header) for row in table.rows)


def test_known_models_are_named():
    assert len(set(MODELS)) == 5 and {CLASSICAL, AT_REST, CLOSING, FAMILY} < set(MODELS)


@given(st.lists(st.integers(-50, 50), min_size=2, max_size=8).filter(lambda x: all(a != b for a, b in pairwise(x))))
def test_ramps_go_through_every_turn(turns):
    v = ramps([float(turn) for turn in turns], 3.0)
    assert np.max(np.abs(np.diff(v))) <= 3.0 and np.all(np.diff(v) != 0)
    k = 0
    for value in v:
        k += k < len(turns) and value == turns[k]
    assert k == len(turns)


def test_straight_lines_between_turns():
    v = ramps((0.0, 30.0, 10.0), 5.0)
    y = v**2
    straight = straight_between_reversals(y, v)
    np.testing.assert_allclose(straight[:7], 30.0 * v[:7])
    np.testing.assert_allclose(straight[6:], 900.0 + (v[6:] - 30.0) * 40.0)


def test_triangles():
    t, x = triangles(80.0, 2.0, 3, samples=100)
    assert t.size == 300 and t[100] == 0.5 and x[0] == x[100] == 0.0 and x[50] == 80.0
    assert np.ptp(np.abs(np.diff(x))) < 1e-12
