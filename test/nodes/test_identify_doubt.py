"""A model that is much worse than the published one, or foreign, needs a word before it takes its place."""

from dataclasses import replace

import pytest
from strategies import FAMILY_CASE, axis_model

from slpi_ros.model.stage_model import StageModel
from slpi_ros.nodes.jobs import doubt_about

pytestmark = pytest.mark.ros
X = axis_model(FAMILY_CASE)


def of_error(axis, rms):
    return StageModel({"x": replace(axis, quality=replace(axis.quality, held_out_rms=rms))})


def test_a_model_as_good_as_the_published_one_is_taken():
    assert doubt_about(of_error(X, 9e-9), of_error(X, 8e-9)) == ""


def test_a_much_worse_model_is_not():
    assert "'x'" in doubt_about(of_error(X, 485e-9), of_error(X, 8e-9))


def test_a_foreign_model_is_not():
    shape = X.hysteresis
    foreign = replace(X, hysteresis=replace(shape, everett=1.3 * shape.everett, rise=1.3 * shape.rise))
    assert "'x'" in doubt_about(of_error(foreign, 8e-9), of_error(X, 8e-9))
