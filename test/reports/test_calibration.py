"""The page of a calibration."""

import numpy as np
from calibration.stages import settings
from reports.test_diagnosis import found
from strategies import PI_CASE, axis_model

from slpi_ros.calibration.run import Outcome, Step, TrackingError
from slpi_ros.diagnosis.result import Diagnosis
from slpi_ros.model.stage_model import StageModel
from slpi_ros.reports.calibration import page_of


def test_each_verification_is_of_the_model_that_it_followed(tmp_path):
    """Also where the first model, of hysteresis alone, was the best one and is verified again at the end."""
    t = np.arange(100) / 200.0
    tracked = {"x": TrackingError.of(t, 1e-6 * t, np.full(t.size, 1e-8), 2e-5, 2e-8)}
    steps = [
        Step(f"{number:02d}_verification", 20.0, "a path", "", tracked, extended=frozenset(extended))
        for number, extended in enumerate(["", "x", ""])
    ]
    stage = StageModel({"x": axis_model(PI_CASE)})
    outcome = Outcome(settings(), stage, tracked, Diagnosis({"x": found()}, stage, ""), tuple(steps), "target met")
    page_of(outcome).write(tmp_path / "report.html")
    rows = [row.split("</tr>")[0] for row in (tmp_path / "report.html").read_text().split("_verification")[1:4]]
    assert ["with the causes found" in row for row in rows] == [False, True, False]
    assert ["hysteresis alone" in row for row in rows] == [True, False, True]
