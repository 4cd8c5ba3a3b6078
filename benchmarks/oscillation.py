"""Loops that oscillate and loops that are well tuned, on simulated stages: which feedback is switched off, and when.

The clock is made: everything runs in one process, faster than real time. Whether feedback sustains an oscillation is
judged from outside, by the true displacement of the same loop with nothing that switches feedback off.
"""

import argparse
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from math import inf, pi, sin

import numpy as np

from slpi_ros.compensator.controller import Controller
from slpi_ros.compensator.feedback import LoopSettings, PidGains
from slpi_ros.compensator.loop_margin import DiscreteLoop, Plant
from slpi_ros.compensator.motion import Safety
from slpi_ros.compensator.validation import RejectedError
from slpi_ros.effects.base import Effect
from slpi_ros.effects.delay import Delay
from slpi_ros.effects.filters import Mode
from slpi_ros.effects.resonance import Resonance
from slpi_ros.identification.fit import identify
from slpi_ros.io.record import Record
from slpi_ros.model.axis_model import AxisModel
from slpi_ros.model.limits import Limits
from slpi_ros.model.stage_model import StageModel
from slpi_ros.simulation.axis import SimulatedAxis
from slpi_ros.simulation.character import Character
from slpi_ros.simulation.parameters import AxisParameters

BEGIN_NS, SECOND_NS, WATCH_NS = 10**12, 10**9, 50_000_000
NOISE, NOISES, SECONDS, PERIODS = 5e-9, 4.0, 2.0, 4.0
SAFETY = Safety(0.0, False, False, (0.0,), 50.0)
LIMITS = Limits(0.0, 100.0)
Path = Callable[[float], float]


def identified(parameters: AxisParameters) -> AxisModel:
    """Return the model of the stage alone, from loops of many sizes, slow enough for it to follow."""
    rng = np.random.default_rng(1)
    turns = np.concatenate([[0.0, 100.0, 0.0, 100.0, 0.0], rng.uniform(0.0, 100.0, 30), [0.0]])
    v = np.interp(np.linspace(0.0, turns.size - 1.0, 3500), np.arange(turns.size), turns)
    t = np.arange(v.size) * 0.01
    _, y = SimulatedAxis(parameters, 1).run(t, v)
    record = Record((t * SECOND_NS).astype(np.int64), {"x": v}, {"x": y}, "simulated")
    return identify(record).axis("x")


@dataclass(frozen=True)
class Case:
    """One loop: stage, what its model knows, gains, sensor and disturbance."""

    character: Character
    model: AxisModel
    gains: PidGains
    rate: float  # Hz, of the sensor
    period: float  # s, of the output
    seed: int
    vibration: tuple[tuple[float, float], ...] = ()  # (Hz, m)
    forced: bool = True
    late: float = 0.0  # s, by which a busy computer delays readings and voltages, mean of each


@dataclass
class Course:
    """What came of a loop: the true displacement 1,000 times a second, and when feedback was switched off, and why."""

    x: np.ndarray  # m
    off: float = inf  # s
    kind: str = ""
    held: float = 0.0  # s, for which the correction was held


def run(case: Case, seconds: float, path: Path, parameters: AxisParameters, watched: bool = True) -> Course:
    """Run a loop, feedback on from 0.5 s on; `path`: m over s."""
    axis = SimulatedAxis(parameters, case.seed, case.character)
    off = LoopSettings(False, case.gains, 0.3, 20.0, case.forced)
    made = Controller(["x"], [LIMITS], loops=[off], period=case.period)
    made.use_model(StageModel({"x": case.model}))
    made.activate(BEGIN_NS)
    own = made.axes[0]
    if not watched:
        own.loop.judge = lambda *_: None  # type: ignore[method-assign]
    rng = np.random.default_rng(case.seed)
    course = Course(np.empty(0))
    v, true, on = own.output.voltage, [], False
    # What is on its way: when it is there (ns), and what (m or V).
    readings, voltages = deque[tuple[int, float]](), deque[tuple[int, float]]()
    now = read_at = watch_at = sample_at = BEGIN_NS
    send_at, end = BEGIN_NS, BEGIN_NS + int(seconds * SECOND_NS)
    axis.step(0.0, v)

    def moved(at_ns: int) -> float:
        t = (at_ns - BEGIN_NS) * 1e-9
        return axis.step(t, v) + sum(size * sin(2 * pi * f * t) for f, size in case.vibration)

    def send(queue: deque[tuple[int, float]], what: float) -> None:
        at_ns = now + int(rng.exponential(case.late) * SECOND_NS) if case.late else now
        queue.append((max(at_ns, queue[-1][0] if queue else 0), what))

    while now < end:
        due = made.next_due_ns(now, now)
        there = [queue[0][0] for queue in (readings, voltages) if queue]
        now = min(read_at, watch_at, send_at, sample_at, *there, max(due, now) if due is not None else end)
        t = (now - BEGIN_NS) * 1e-9
        if not on and t >= 0.5:
            on = True
            own.retune(replace(off, enabled=True))
        x = moved(now)
        if now == sample_at:
            sample_at += 1_000_000
            true.append(x - path(t))
        if now == send_at:
            send_at += 10_000_000
            made.update(now, ["x"], [path(t)], now)
        elif now == read_at:
            read_at += round(SECOND_NS / case.rate)
            send(readings, x + rng.normal(0.0, NOISE))
        elif readings and readings[0][0] <= now:
            with suppress(RejectedError):
                made.measure(["x"], [readings.popleft()[1]], now)
        elif now == watch_at:
            watch_at += WATCH_NS
            made.watch(SAFETY, 0.5, now)
            course.held += own.loop.oscillation.held * WATCH_NS * 1e-9
            fault = own.loop.fault
            if fault and course.off == inf:
                course.off, course.kind = t, f"{fault.rule} {fault.kind}"
                if watched and fault.rule != "loop":
                    break
        elif due is not None and due <= now:
            made.advance(now, now)
        if own.output.voltage != (voltages[-1][1] if voltages else v):
            send(voltages, own.output.voltage)
        if voltages and voltages[0][0] <= now:
            v = voltages.popleft()[1]
            axis.step(t, v)
    course.x = np.array(true)
    return course


def oscillation(x: np.ndarray, begin: float = 0.5) -> tuple[float, float, float, float]:
    """Return amplitude at the end and at most (m), frequency (Hz) and begin (s); `x` 1,000 times a second."""
    tail = x[-2000:] - x[-2000:].mean()
    spectrum = np.abs(np.fft.rfft(tail * np.hanning(tail.size)))
    frequency = max(float(np.argmax(spectrum[1:]) + 1) * 1000.0 / tail.size, 0.25)
    size = min(max(round(1000.0 / frequency), 4), 2000)
    each = np.array([np.ptp(x[k : k + size]) / 2.0 for k in range(round(begin * 1000), x.size - size, size)])
    small = np.flatnonzero(each <= NOISES * NOISE)
    first = (small[-1] + 1 if small.size else 0) * size * 1e-3 + begin
    return float(np.median(each[-max(4, 2000 // size) :])), float(each.max()), frequency, float(first)


def draw(rng: np.random.Generator, seed: int, model: AxisModel, slope: float) -> tuple[Case, float]:
    """Return a case with the documented gains, and its crossover (rad/s)."""
    mode = bool(rng.integers(2))
    frequency, damping = float(np.exp(rng.uniform(np.log(30.0), np.log(300.0)))), float(rng.uniform(0.01, 0.1))
    delay = float(rng.choice([0.0, 0.002, 0.01]))
    rate, period = float(rng.choice([100.0, 500.0, 1000.0])), float(rng.choice([1e-3, 2e-3]))
    character = Character(delay=delay, **({"resonance": frequency, "damping": damping} if mode else {}))
    known: list[Effect] = [Delay(delay)] if delay else []
    if mode:
        known.append(Resonance((Mode(frequency * float(rng.uniform(0.97, 1.03)), damping, 1.0),)))
    # As docs/how-to/feedback.md says.
    total = delay + 1.0 / rate + 2.0 * period
    crossover = min(0.2 / total, 0.2 * 2.0 * damping * 2.0 * pi * frequency if mode else inf, 40.0)
    kp = 0.2 * 2.0 * damping / slope if mode and rng.integers(2) else 0.0
    gains = PidGains(kp, crossover / slope)
    # Half of the computers are busy.
    late = float(np.random.default_rng(seed).choice([0.0, 0.0, 1e-3, 3e-3]))
    return Case(character, replace(model, effects=tuple(known)), gains, rate, period, seed, late=late), crossover


def constant(t: float) -> float:
    """Return a set point (m) that is approached slowly."""
    return 5e-6 * min(t / 0.4, 1.0)


def busy(seed: int, slowest: float) -> Path:
    """Return steps and rasters (m), with rests."""
    rng = np.random.default_rng(seed)
    parts = [(rng.integers(3), float(rng.uniform(3e-6, 6e-6)), float(rng.uniform(0.2, slowest))) for _ in range(40)]

    def path(t: float) -> float:
        kind, centre, f = parts[int(t / 3.0) % len(parts)]
        if kind == 0:
            return centre
        if kind == 1:
            return centre + 0.5e-6 * (int(t * 2.0 * f) % 4)
        return centre + 1.5e-6 * (1.0 - 2.0 * abs(2.0 * (t * f % 1.0) - 1.0)) * 0.5

    return path


def main(arguments: Sequence[str] | None = None) -> int:
    """Print each loop and the counts; return 1 if one was judged wrongly."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=40, help="loops that may oscillate; half as many are well tuned")
    parser.add_argument("--seconds", type=float, default=60.0, help="of a well tuned loop")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args(arguments)
    rng = np.random.default_rng(options.seed)
    parameters = AxisParameters(stroke=10e-6, noise_rms=NOISE, quantisation=0.0)
    model = identified(parameters)
    slope = float(np.ptp(model.displacement_range) / np.ptp(model.voltage_range))
    wrong = late = oscillated = shown = on = 0
    print("  mode unknown  gains  late/ms  amplitude/nm  Hz      begin/s  off after/s", flush=True)
    for k in range(options.count):
        case, _ = draw(rng, 100 + k, model, slope)
        factor, unknown = float(10.0 ** rng.uniform(-1.0, np.log10(300.0))), bool(rng.integers(2))
        gains = replace(
            case.gains, proportional=case.gains.proportional * factor, integral=case.gains.integral * factor
        )
        case = replace(case, gains=gains, model=model if unknown else case.model)
        free = run(case, 10.0, constant, parameters, watched=False)
        size, most, frequency, first = oscillation(free.x)
        seen = run(case, 10.0 + 4.0 / frequency, constant, parameters)
        within = max(SECONDS, PERIODS / frequency)
        oscillates = size > NOISES * NOISE and first + within <= 10.0
        oscillated += oscillates
        is_late = oscillates and seen.off > first + within
        is_wrong = most <= NOISES * NOISE and seen.off < inf
        late, wrong = late + is_late, wrong + is_wrong
        loop = DiscreteLoop(Plant.of(case.model), case.gains, case.period)
        if not loop.margins.stable:
            shown += 1
            on += "unstable" not in run(replace(case, forced=False), 2.0, constant, parameters).kind
        print(
            f"  {'yes' if case.character.resonance else 'no ':4} {'yes' if unknown else 'no ':7} {factor:6.2f} "
            f"{case.late * 1e3:8.0f} {size * 1e9:13.1f} {frequency:7.2f} {first:8.2f} "
            f"{seen.off - first:8.2f} of {within:.2f} {seen.kind}"
            f"{'  LATE' if is_late else ''}{'  WRONG' if is_wrong else ''}",
            flush=True,
        )
    print(f"oscillating loops: {oscillated} of {options.count}, not off in time: {late}; others switched off: {wrong}")
    print(f"unstable by the model: {shown}, on without force_gains: {on}")
    for what in ("steps and rasters", "hum and vibration of 60 nm"):
        switched, held = 0, 0.0
        for k in range(options.count // 2):
            case, crossover = draw(rng, 500 + k, model, slope)
            case = replace(case, forced=False, late=0.0)
            if "hum" in what:
                lines = (float(rng.choice([50.0, 60.0])), float(np.exp(rng.uniform(np.log(3.0), np.log(200.0)))))
                case = replace(case, vibration=((lines[0], 60e-9), (lines[1], 60e-9)))
            course = run(case, options.seconds, busy(k, 3.0), parameters)
            switched, held = switched + (course.off < inf), held + course.held
            if course.off < inf:
                print(f"  switched off: {what}, {k}, after {course.off:.2f} s: {course.kind}", flush=True)
        count = options.count // 2
        print(f"well tuned, {what}: {switched} of {count} switched off; correction held {held / count:.2f} s in each")
        wrong += switched
    return int(bool(wrong or late or on))


if __name__ == "__main__":
    raise SystemExit(main())
