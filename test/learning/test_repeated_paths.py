"""Paths that come again: learned side by side, kept in files, and gone on with for the same stage and model only."""

from dataclasses import replace

import numpy as np
import pytest
from identification.records import calibration
from learning.test_learner import NOISE, RATE, Stage, path

import slpi_ros
from slpi_ros.learning.repeated_paths import MOST_PATHS, FinishedPass, RepeatedPaths, SampledPath, kept_files


@pytest.fixture(scope="module")
def model():
    return replace(slpi_ros.identify(calibration(seed=1)[0], "pi"), hardware_id="one")


def sampled(hertz=20.0, amplitude=4e-6):
    t, desired = path(hertz, amplitude)
    return SampledPath.of(["x"], np.round(1e9 * t).astype(np.int64), desired[:, None], 1.0 / RATE)


def passed(way, correction, stage, unusable=None):
    followed = way.desired["x"] + correction
    true, read = stage.run(followed)
    error = float(np.std(true - way.desired["x"]))
    return FinishedPass(way, {"x": followed}, {"x": read}, {"x": np.full(read.size, 50.0)}, unusable or {}), error


def run(paths, way, stage, count, correction=0.0):
    """Return what was learned last, and the true errors (m) of the passes."""
    errors, learned = [], None
    for _ in range(count):
        done, error = passed(way, correction, stage)
        (learned,) = paths.learn(done)
        correction = learned.correction["x"]
        errors.append(error)
    return learned, errors


def test_each_path_gets_better_and_goes_on_after_a_restart(model, tmp_path):
    prefix = str(tmp_path / "memory.json.learned")
    ways = sampled(), sampled(amplitude=2e-6)
    stages = [Stage(way.desired["x"][0]) for way in ways]
    paths = RepeatedPaths(model, prefix)
    for way, stage in zip(ways, stages, strict=True):
        learned, errors = run(paths, way, stage, 10)
        assert errors[-1] < 0.2 * errors[1]
        assert learned.axes["x"].passes == 10 and learned.axes["x"].first > 3 * learned.axes["x"].best
    assert {file.name.split(".")[-2] for file in kept_files(prefix)} == {way.identity[:12] for way in ways}
    again = RepeatedPaths(model, prefix)
    found = {one.identity: one for one in again.load()}
    assert found.keys() == {way.identity for way in ways}
    assert all(one.remarks == () for one in found.values())
    kept = found[ways[1].identity]
    assert kept.correction["x"] == pytest.approx(learned.correction["x"], abs=1e-15)
    after, errors = run(again, ways[1], stages[1], 2, kept.correction["x"])
    assert after.axes["x"].passes == 12
    assert max(errors) < 2 * NOISE


def test_another_model_and_another_stage(model, tmp_path):
    prefix, way = str(tmp_path / "learned"), sampled()
    run(RepeatedPaths(model, prefix), way, Stage(way.desired["x"][0]), 6)
    axis = model.axes["x"]
    other = replace(model, axes={"x": replace(axis, quality=replace(axis.quality, held_out_rms=9e-9))})
    before = RepeatedPaths(model, prefix)
    before.load()
    # From the file, and from what another model has learned in this process.
    (found,), (same,) = RepeatedPaths(other, prefix).load(), RepeatedPaths(other).take_over(before)
    assert same.remarks == found.remarks and same.correction["x"] == pytest.approx(found.correction["x"], abs=1e-15)
    assert found.remarks == ("axis 'x': another model; learned again, from the correction of the path so far",)
    assert np.ptp(found.correction["x"]) > 50e-9 and not found.axes
    (found,) = RepeatedPaths(replace(model, hardware_id="two"), prefix).load()
    assert not found.identity and not found.correction
    assert "learned on stage 'one', the model is of 'two'" in found.remarks[0]
    file = kept_files(prefix)[0]
    file.write_text("{")
    (found,) = RepeatedPaths(model, prefix).load()
    assert found.remarks == (
        f"learned afresh: {file}: cannot read what was learned: it is no JSON document; leave it out to learn again",
    )


def test_a_pass_that_a_limit_held_back_leads_back_to_the_best_path(model):
    way = sampled()
    stage, paths = Stage(way.desired["x"][0]), RepeatedPaths(model)
    before, _ = run(paths, way, stage, 6)
    done, _ = passed(way, before.correction["x"], stage, {"x": "the voltage is held at a limit at 9 of its samples"})
    (after,) = paths.learn(done)
    assert after.axes["x"].reason == "the voltage is held at a limit at 9 of its samples"
    assert after.axes["x"].best == before.axes["x"].best


def test_several_passes_of_one_correction_make_one_step(model):
    way = replace(sampled(), count=4)
    stage, paths, correction, errors = Stage(way.desired["x"][0]), RepeatedPaths(model), 0.0, []
    for _ in range(6):
        passes = [passed(way, correction, stage) for _ in range(4)]
        errors += [error for _, error in passes]
        (learned,) = paths.learn(*(done for done, _ in passes))
        correction = learned.correction["x"]
    assert learned.axes["x"].passes == 24
    assert errors[-1] < NOISE < 0.1 * errors[1]


def test_a_pass_that_cannot_be_learned_loses_nothing_that_was_learned(model):
    way = sampled()
    stage, paths = Stage(way.desired["x"][0]), RepeatedPaths(model)
    learned, _ = run(paths, way, stage, 6)
    done, _ = passed(way, learned.correction["x"], stage)
    (after,) = paths.learn(replace(done, followed={"x": np.full(way.desired["x"].size, np.nan)}))
    assert after.remarks and after.axes["x"].passes == 6
    assert np.array_equal(after.correction["x"], learned.correction["x"])


def test_limits_are_kept_and_forgetting_removes_the_files(model, tmp_path):
    prefix, way = str(tmp_path / "learned"), sampled()
    paths = RepeatedPaths(model, prefix, {"x": 20e-9})
    learned, _ = run(paths, way, Stage(way.desired["x"][0]), 6)
    assert np.abs(learned.correction["x"]).max() <= 20e-9 * (1 + 1e-9)
    assert learned.axes["x"].limited_by == "learn_limit"
    beside = tmp_path / "learned.other.json"
    beside.write_text("{}")
    assert paths.forget() == (1, "")
    assert [file.name for file in tmp_path.iterdir()] == ["learned.other.json"]
    assert paths.load() == []


def test_a_path_that_the_model_has_no_axis_of_is_not_learned(model):
    way = SampledPath.of(["z"], np.arange(50) * 1_000_000, np.ones((50, 1)) * 1e-6, 1e-3)
    done = FinishedPass(way, way.desired, way.desired, {})
    (learned,) = RepeatedPaths(model).learn(done)
    assert not learned.correction and learned.remarks[0].startswith("not learned: ")


def test_the_paths_that_came_last_are_kept(model, tmp_path):
    prefix = str(tmp_path / "learned")
    paths = RepeatedPaths(model, prefix)
    for k in range(MOST_PATHS + 2):
        way = sampled(100.0, 1e-6 + 1e-8 * k)
        paths.learn(passed(way, 0.0, Stage(way.desired["x"][0]))[0])
    assert len(kept_files(prefix)) == MOST_PATHS


@pytest.mark.parametrize("learn_period", [0.0, 0.1])
def test_a_long_path_keeps_the_points_that_were_given(learn_period):
    # 60 s at 1 kHz, a triangle of 10 Hz and 10 um: between samples 6 ms apart its turns would lose 0.6 um.
    times = np.arange(60_001) * 1_000_000
    triangle = 10e-6 * np.abs((times / 1e8) % 1.0 * 2.0 - 1.0)
    way = SampledPath.of(["x"], times, triangle[:, None], 1e-3, learn_period)
    correction = np.full(way.t.size, 5e-9)
    names, out_ns, positions = way.corrected({"x": correction}, 1e-3)
    assert list(names) == ["x"] and np.abs(out_ns - times).max() <= 1
    assert np.abs(positions[:, 0] - triangle - 5e-9).max() < 1e-12


def test_a_file_that_cannot_be_removed_is_told_and_all_others_are(model, tmp_path):
    prefix = str(tmp_path / "learned")
    paths, ways = RepeatedPaths(model, prefix), [sampled(100.0, 1e-6 + 1e-8 * k) for k in range(3)]
    for way in ways:
        paths.learn(passed(way, 0.0, Stage(way.desired["x"][0]))[0])
    stays = tmp_path / f"learned.{ways[1].identity[:12]}.json"
    stays.unlink()
    stays.mkdir()
    count, left = paths.forget()
    assert count == 3 and left.startswith(f"{stays}: cannot be removed: ")
    assert list(tmp_path.iterdir()) == [stays] and not paths.known
