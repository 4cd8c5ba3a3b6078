"""The process that learns: what is known comes back, also after the process has died; without ROS."""

from dataclasses import replace

import numpy as np
import pytest
from compensator.test_path_passes import MS, START, axis
from identification.records import calibration
from learning.test_learner import RATE, Stage, path
from learning.test_learning_process import Learning as ForgettingLearning

import slpi_ros

pytestmark = pytest.mark.long
PERIOD = 1.0 / RATE


class Learning(ForgettingLearning):
    """Sends the passes of one path through a simulated stage."""

    def __init__(self, model, prefix):
        super().__init__(prefix)
        self.use("on", None, 0.0)
        self.use_model(model)
        self.settle()
        t, self.desired = path()
        self._times = np.round(1e9 * t).astype(np.int64)
        self._stage, self._at = Stage(self.desired[0]), START

    def passes_of(self, count):
        """Return the true errors (m) of so many passes."""
        errors = []
        for _ in range(count):
            self._at += 1_000 * MS
            way, (_, times, positions) = self.corrected(["x"], self._times, self.desired[:, None])
            self.begin(way, self._at, self._at)
            true, read = self._stage.run(np.asarray(positions)[:, 0])
            errors.append(float(np.std(true - self.desired)))
            for at, reading in zip(np.asarray(times).tolist(), read.tolist(), strict=True):
                self.passes.output([axis()], self._at + at)
                self.passes.read(["x"], [reading], self._at + at)
            self.poll(self._at + 900 * MS)
            self.settle()
        return errors


def test_what_is_learned_comes_back_and_survives_the_death_of_the_process(tmp_path):
    model = replace(slpi_ros.identify(calibration(seed=1)[0], "pi"), hardware_id="one")
    learning = Learning(model, str(tmp_path / "learned"))
    try:
        errors = learning.passes_of(10)
        assert errors[-1] < 0.2 * errors[1]
        assert learning.progress["x"].passes == 10 and not learning.remarks
        learning._worker.process.kill()
        learning._worker.process.join()
        # It is begun again, from the file.
        assert max(learning.passes_of(3)) < 0.3 * errors[1]
        assert learning.progress["x"].passes > 10
        # Held: used, and no more is learned.
        learning.use("hold", None, 0.0)
        before = learning.progress["x"].passes
        assert max(learning.passes_of(2)) < 0.3 * errors[1]
        assert learning.progress["x"].passes == before
        learning.use("on", None, 0.0)
        learning.forget()
        learning.settle()
        assert learning.forgotten == [1] and not list(tmp_path.iterdir())
        assert learning.passes_of(1)[0] > 0.7 * errors[1]
        # A model of another stage: what was learned is not its.
        learning.passes_of(4)
        assert learning.passes.corrections
        learning.use_model(replace(model, hardware_id="two"))
        assert not learning.passes.corrections
        learning.settle()
        assert any("learned on stage 'one'" in remark for remark in learning.remarks)
        # Off: nothing is corrected or recorded.
        learning.use("off", None, 0.0)
        assert learning.corrected(["x"], [0, MS], [[0.0], [1e-6]]) == (None, (["x"], [0, MS], [[0.0], [1e-6]]))
        learning.begin(None, 0, START)
        assert not learning.passes.on
    finally:
        learning.close()
