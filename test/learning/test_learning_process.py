"""The process that learns, while it is busy, cannot remove a file, or has ended; without ROS."""

import time
from threading import Event
from types import SimpleNamespace

import numpy as np
import pytest
from compensator.test_path_passes import START, axis
from identification.records import calibration
from learning.test_learner import RATE, path

import slpi_ros
from slpi_ros.compensator.controller import Controller
from slpi_ros.learning.repeated_paths import SampledPath
from slpi_ros.model.limits import Limits
from slpi_ros.nodes.path_learning import Answer, PathLearning

PERIOD = 1.0 / RATE


@pytest.fixture(scope="module")
def model():
    return slpi_ros.identify(calibration(seed=1)[0], "pi")


class Learning(PathLearning):
    """Keeps how many paths were forgotten; `answered`: stands for the process, if given."""

    def __init__(self, prefix="", answered=None):
        self.forgotten, self._answered = [], answered
        controller = Controller(["x"], [Limits(0.0, 100.0)], period=PERIOD)
        super().__init__(controller, prefix, self.forgotten.append)

    def _answer(self, request):
        return self._answered(request) if self._answered else super()._answer(request)

    def settle(self):
        deadline = time.monotonic() + 60.0
        while self.waiting:
            assert time.monotonic() < deadline
            self.poll(0)
            time.sleep(0.01)


@pytest.mark.parametrize("share", [None, 20e-9, 1e-6])
def test_a_lower_limit_is_in_force_while_the_process_is_busy(model, share):
    goes_on = Event()

    def busy(request):
        goes_on.wait(60.0)
        return Answer()

    learning = Learning(answered=busy)
    try:
        learning.use_model(model)
        learning.use("on", {"x": 30e-6}, 0.0)
        t, desired = path()
        times = np.round(1e9 * t).astype(np.int64)
        way = SampledPath.of(["x"], times, desired[:, None], PERIOD)
        learned = 20e-6 * np.sin(2 * np.pi * np.arange(t.size) / t.size)
        learning.passes.corrections[way.identity] = {"x": learned}
        learning.use("on", share and {"x": share}, 0.0)
        low, high = model.axes["x"].displacement_range
        most = share or 0.25 * (high - low)
        assert learning.waiting and most < 10e-6
        way, (_, _, positions) = learning.corrected(["x"], times, desired[:, None])
        added = np.asarray(positions)[:, 0] - desired
        assert np.abs(added).max() == pytest.approx(most, rel=1e-6)
        # The pass knows of the same correction.
        learning.begin(way, START, START)
        one = axis()
        for k in range(t.size):
            learning.passes.output([one], START + int(times[k]))
            assert one.tracking.learned == pytest.approx(added[k], abs=1e-12)
    finally:
        goes_on.set()
        learning.close()


def test_a_file_that_cannot_be_removed_is_the_answer_and_the_process_goes_on(tmp_path):
    stays = tmp_path / "learned.0123456789ab.json"
    stays.mkdir()
    learning = Learning(str(tmp_path / "learned"))
    try:
        learning.use("on", None, 0.0)
        learning.forget()
        learning.settle()
        assert learning.forgotten == [1] and learning.not_forgotten.startswith(f"{stays}: cannot be removed: ")
        assert list(learning.remarks) == [learning.not_forgotten]
        process = learning._worker.process
        stays.rmdir()
        learning.forget()
        learning.settle()
        assert learning.forgotten == [1, 0] and learning.not_forgotten == ""
        assert learning._worker.process is process and process.is_alive()
    finally:
        learning.close()


def test_what_is_forgotten_again_at_once_is_forgotten(tmp_path):
    learning = Learning(str(tmp_path / "learned"))
    try:
        for _ in range(2):
            # Where nothing is learned the process ends after each answer.
            learning.forget()
            learning.settle()
            assert learning.not_forgotten == ""
    finally:
        learning.close()


def test_a_process_that_ends_while_it_forgets_is_an_answer(tmp_path):
    def ended(_=None):
        raise EOFError

    learning = Learning(str(tmp_path / "learned"))
    try:
        process = SimpleNamespace(is_alive=lambda: True, kill=lambda: None)
        learning._worker = SimpleNamespace(process=process, connection=SimpleNamespace(send=ended, recv=ended))
        learning.forget()
        learning.settle()
        assert learning.forgotten == [0] and "call ~/forget again" in learning.not_forgotten
    finally:
        learning.close()
