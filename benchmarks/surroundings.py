"""Hidden temperature or load: named with the right topic, its gain, decoys that merely drift, and a later day.

Each stage is drawn from a seed: it follows the temperature or the load of its room, at once or late, in its zero or in
its sensitivity. Its record also holds what slow and noisy sensors say of temperature, load, humidity and pressure. Then
as many stages of which none follows its room: they drift by themselves, or do nothing.
"""

import os

# To be set before NumPy is imported: the processes share the cores.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import warnings
from dataclasses import dataclass, replace
from multiprocessing import get_context
from time import perf_counter

import numpy as np

import slpi_ros
from slpi_ros.io.record import Record
from slpi_ros.model.limits import Limits, decaying_turns
from slpi_ros.simulation.axis import SimulatedAxis
from slpi_ros.simulation.character import Character
from slpi_ros.simulation.parameters import AxisParameters
from slpi_ros.simulation.room import Room, RoomSensor, Still

SECONDS, RATE, LATER, RESTS = 1800.0, 20.0, 86_400.0, 900.0
KINDS = ("temperature zero", "temperature zero, late", "temperature sensitivity", "load zero", "load sensitivity")
DECOYS = ("drift", "sensitivity drifts", "random walk", "nothing")
# Least and largest effect over the record, shares of the stroke.
WEAK, STRONG = 0.004, 0.02


@dataclass(frozen=True)
class Outcome:
    """What was hidden in a stage and what was found."""

    seed: int
    hidden: str
    verdict: str
    effects: tuple[str, ...]
    topics: tuple[str, ...]
    alternatives: tuple[str, ...]
    gain_error: float  # relative; NaN: not found
    drift: float  # m rms on a later day, not compensated
    left: float  # m rms, compensated
    noise: float  # m
    seconds: float


def path(rng: np.random.Generator, t: np.ndarray) -> np.ndarray:
    """Return a voltage (V), (N,): a full loop, then moves between random turning points."""
    times, turns = [0.0, 8.0, 16.0], [0.0, 100.0, 0.0]
    while times[-1] < t[-1]:
        turns.append(rng.uniform(0.0, 100.0))
        times.append(times[-1] + max(0.5, abs(turns[-1] - turns[-2]) / rng.uniform(5.0, 60.0)) + rng.choice([0.0, 2.0]))
    return np.interp(t, times, turns)


def drawn(seed: int, hidden: str) -> tuple[AxisParameters, Character, np.random.Generator]:
    """Return a random stage that hides what the words say."""
    rng = np.random.default_rng([seed, len(hidden)])
    parameters = AxisParameters.random(seed)
    size = float(np.exp(rng.uniform(np.log(WEAK), np.log(STRONG)))) * float(rng.choice([-1.0, 1.0]))
    rms = {"temperature": 0.5, "load": 0.7}
    facts = {}
    quantity = hidden.split(" ")[0]
    if quantity in rms:
        each = size / rms[quantity]
        facts = (
            {f"{quantity}_gain": each} if "sensitivity" in hidden else {f"{quantity}_offset": each * parameters.stroke}
        )
        if "late" in hidden:
            facts["temperature_time"] = float(np.exp(rng.uniform(np.log(20.0), np.log(200.0))))
    elif hidden == "drift":
        facts = {"thermal_drift": 3 * size * parameters.stroke, "drift_time": float(rng.uniform(100.0, 900.0))}
    elif hidden == "sensitivity drifts":
        facts = {"gain_drift": 3 * size, "drift_time": float(rng.uniform(100.0, 900.0))}
    return parameters, Character(**facts), rng


def sensors(seed: int, rng: np.random.Generator) -> dict[str, RoomSensor]:
    """Return the sensors of a room by topic."""
    spans = {"/room/temperature": 0.5, "/load": 0.7, "/room/humidity": 0.03, "/room/pressure": 150.0}
    return {
        topic: RoomSensor(
            interval=float(rng.uniform(0.02, 0.1) if topic == "/load" else rng.uniform(1.0, 6.0)),
            lag=0.0 if topic == "/load" else float(rng.uniform(0.0, 6.0)),
            noise=span * float(rng.uniform(0.02, 0.08)),
            seed=seed + place,
        )
        for place, (topic, span) in enumerate(spans.items())
    }


def courses(room: Room, own: dict[str, RoomSensor], start: float, end: float) -> dict:
    """Return what the sensors say between two times (s) of the room, with a gap, by topic."""
    values = {"/room/temperature": room.temperature, "/load": room.load, "/room/humidity": room.humidity,
              "/room/pressure": room.pressure}  # fmt: skip
    found = {}
    for topic, sensor in own.items():
        t = sensor.times(start, end)
        value = sensor.read(t, values[topic](t))
        value[(t > start + 0.4 * (end - start)) & (t < start + 0.41 * (end - start))] = np.nan
        found[topic] = t - start, value
    return found


def record_of(
    axis: SimulatedAxis, t: np.ndarray, v: np.ndarray, beside: dict, walk: np.ndarray | float = 0.0
) -> Record:
    """Return the record of an axis with its surroundings."""
    _, y = axis.run(t, v)
    ns = np.round((t - t[0]) * 1e9).astype(np.int64) + 1_700_000_000 * 10**9
    return Record(ns, {"x": v}, {"x": y + walk}, "record", surroundings=beside)


def run(case: tuple[int, str, bool]) -> Outcome:
    """Draw a stage, diagnose its record, and compensate it on a later day."""
    seed, hidden, later = case
    began = perf_counter()
    parameters, character, rng = drawn(seed, hidden)
    room, t = Room(seed), np.arange(0.0, SECONDS, 1.0 / RATE)
    own, v = sensors(10 * seed, rng), path(rng, t)
    walk: np.ndarray | float = 0.0
    if hidden == "random walk":
        steps = rng.standard_normal(t.size).cumsum()
        walk = 0.02 * parameters.stroke * steps / np.ptp(steps)
    record = record_of(SimulatedAxis(parameters, seed, character, room), t, v, courses(room, own, 0.0, SECONDS), walk)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model = slpi_ros.identify(record)
        diagnosis = slpi_ros.diagnose(record, model)
    found = diagnosis.axes["x"]
    quantities = [one for named in found.effects if named.name == "surroundings" for one in named.effect.quantities]
    topics = tuple(one.topic for one in quantities)
    truth = {f"/{'room/' * (key == 'temperature')}{key}": key for key in ("temperature", "load")}
    error = drift = left = np.nan
    right = [one for one in quantities if hidden.startswith(truth.get(one.topic, "nothing "))]
    if right:
        kind = "sensitivity_gain" if "sensitivity" in hidden else "offset_gain"
        given = getattr(character, f"{truth[right[0].topic]}_{'gain' if 'sensitivity' in hidden else 'offset'}")
        error = getattr(right[0], kind) / given - 1.0
        if later:
            drift, left = later_day(parameters, character, room, own, diagnosis.extended)
    return Outcome(
        seed, hidden, found.verdict, tuple(named.name for named in found.effects), topics,
        tuple(other for named in found.effects for other in named.alternatives), error, drift, left,
        parameters.noise_rms, perf_counter() - began,
    )  # fmt: skip


def later_day(parameters, character, room, own, model) -> tuple[float, float]:
    """Return the drift (m rms) of a stage on a later day, without and with its surroundings compensated."""
    # Before, the stage rests for a while, as it does between a start in the morning and the first path.
    moves = np.arange(0.0, 900.0, 1.0 / RATE)
    t = np.concatenate([np.arange(-RESTS, 0.0, 1.0), moves])
    low, high = model.axes["x"].displacement_range
    rng = np.random.default_rng(own["/load"].seed)
    way = path(rng, moves)
    desired = low + (high - low) * (0.1 + 0.8 * np.concatenate([np.full(t.size - way.size, way[0]), way]) / 100.0)
    beside = courses(room, own, LATER - RESTS, LATER + 900.0)
    quiet = replace(parameters, noise_rms=0.0, quantisation=0.0)
    effect = next(one for one in model.axes["x"].effects if one.name == "surroundings")
    reference = {one.topic: one.reference for one in effect.quantities}
    still = Still(reference.get("/room/temperature", room.mean), reference.get("/load", 0.0))

    def stage(voltage: np.ndarray, own_room: Room) -> np.ndarray:
        axis = SimulatedAxis(quiet, 0, character, own_room)
        # To the state in which the model starts: a decaying oscillation over its range.
        turns = decaying_turns(Limits(0.0, 100.0), 0.0, 10)
        lead = np.interp(np.arange(0.0, len(turns) - 0.95, 0.05), np.arange(len(turns)), turns)
        times = LATER - RESTS + np.concatenate([np.linspace(-20.0, -1.0, lead.size), t + RESTS])
        return axis.run(times, np.concatenate([lead, voltage]))[0][-moves.size :]

    def driven(with_surroundings: bool) -> np.ndarray:
        step, out = model.stream("x", start_memory="wiped"), np.empty(t.size)
        waiting = sorted(
            (at - RESTS, key, value) for key, course in beside.items() for at, value in zip(*course, strict=True)
        ) if with_surroundings else []  # fmt: skip
        place = 0
        for k, now in enumerate(t.tolist()):
            told = {}
            while place < len(waiting) and waiting[place][0] <= now:
                told[waiting[place][1]] = waiting[place][2]
                place += 1
            out[k] = step(now, desired[k], told)
        return out

    plain = driven(False)
    # What hysteresis alone leaves, where nothing changes, is no drift.
    steady = stage(plain, still)
    return tuple(float(np.std(stage(voltage, room) - steady)) for voltage in (plain, driven(True)))


def line(one: Outcome) -> str:
    """Return the line of one stage."""
    return (
        f"{one.seed:4d} {one.hidden:24s} {one.verdict:14s} {'+'.join(one.effects) or '-':28s} "
        f"{','.join(one.topics) or '-':20s} {','.join(one.alternatives) or '-':24s} gain {one.gain_error:+.1%} "
        f"later {one.drift * 1e9:.0f} -> {one.left * 1e9:.1f} nm  {one.seconds:.0f} s"
    )


def main() -> None:
    """Run the stages and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--stages", type=int, default=20)
    parser.add_argument("--decoys", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--no-later", action="store_true", help="without the later day")
    options = parser.parse_args()
    cases = [(options.seed + k, KINDS[k % len(KINDS)], not options.no_later) for k in range(options.stages)]
    cases += [(options.seed + k, DECOYS[k % len(DECOYS)], False) for k in range(options.decoys)]
    outcomes = []
    with get_context("spawn").Pool(options.processes) as pool:
        for outcome in pool.imap(run, cases):
            print(line(outcome), flush=True)
            outcomes.append(outcome)
    stages, decoys = outcomes[: options.stages], outcomes[options.stages :]
    right = [one for one in stages if len(one.topics) == 1 and np.isfinite(one.gain_error)]
    near = [one for one in right if abs(one.gain_error) <= 0.1]
    print(f"right topic alone: {len(right)} of {len(stages)}; ambiguous {sum(bool(one.alternatives) for one in right)}")
    print(f"gain within 10 %: {len(near)} of {len(right)}")
    wrong = sum(any(topic in ("/room/humidity", "/room/pressure") for topic in one.topics) for one in stages)
    print(f"a decoy named beside the cause: {wrong}; on stages without cause: "
          f"{sum(bool(one.topics) for one in decoys)} of {len(decoys)}")  # fmt: skip
    ratios = [one.drift / one.left for one in right if one.left > 0.0]
    if ratios:
        print(f"drift on a later day: {min(ratios):.1f} (least), {np.median(ratios):.1f} (median) times smaller")


if __name__ == "__main__":
    main()
