"""Loops tuned without a hand on simulated stages of other physics: bandwidth, margin, detuned modes, a raster.

Each stage (Preisach hysteresis, a mode of 60 to 600 Hz with a damping of 0.005 to 0.5, 0.2 to 5 ms of delay, sensor and
loop at six times the mode to 5 kHz) is identified and diagnosed from two records, its frequency response measured in a
third, `slpi_ros.compensator.loop_design` makes the gains, and the compensator's controller closes the loop on the
stage, whose voltage is held between its outputs. Sensitivity is measured with one sine on the reading after the other:
of a multisine the hysteresis makes distortion at all frequencies, and the mode magnifies it. Today's rule is
``ki g = min(2 d w / 5, 0.2 / delay)`` with the true numbers; its bandwidth is that of the linear loop with the slope
that the tuned loop has shown.
"""

import argparse
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from math import log, pi

import numpy as np

from slpi_ros.compensator.controller import Controller
from slpi_ros.compensator.feedback import LoopSettings, PidGains
from slpi_ros.compensator.loop_design import HALF, Design, Loop, Shape, design
from slpi_ros.compensator.loop_margin import DiscreteLoop, Plant
from slpi_ros.compensator.validation import RejectedError
from slpi_ros.diagnosis.diagnose import diagnose
from slpi_ros.effects.delay import Delay
from slpi_ros.effects.filters import Mode
from slpi_ros.effects.resonance import Resonance
from slpi_ros.excitation.drives import excite
from slpi_ros.excitation.response import response_drive
from slpi_ros.identification.fit import identify
from slpi_ros.identification.frequency_response import FrequencyResponse, frequency_response
from slpi_ros.io.record import Record
from slpi_ros.model.axis_model import AxisModel
from slpi_ros.model.limits import Limits
from slpi_ros.model.stage_model import StageModel
from slpi_ros.simulation.axis import SimulatedAxis
from slpi_ros.simulation.character import Character
from slpi_ros.simulation.dynamics import Creep
from slpi_ros.simulation.parameters import AxisParameters
from slpi_ros.workflows.tune import beside_model

BEGIN_NS, SECOND_NS = 10**12, 10**9
LIMITS = Limits(0.0, 100.0)
# Samples of the records, and least time (s); rms of added signals, and size of the raster (shares of the stroke), with
# its frequency (Hz), and seconds. Time of the record of the response (s).
RESPONSE = 12.0
SAMPLES, SHORTEST, ADDED, RASTER = 14_000, 3.0, 0.01, (0.3, 5.0, 2.0)
# Sines: number from end to end, beside the mode and beside the largest; decays of the mode before each is measured,
# then seconds, and least periods.
SINES, SETTLED, LASTING, PERIODS = (25, 21, 9), 6.0, 0.3, 4
Signal = Callable[[float], float]


@dataclass(frozen=True)
class Stage:
    """One simulated stage with its loop."""

    parameters: AxisParameters
    character: Character
    rate: float  # Hz
    seed: int

    @classmethod
    def drawn(cls, seed: int) -> "Stage":
        """Return the stage of a seed."""
        rng = np.random.default_rng([69, seed])

        def between(low: float, high: float) -> float:
            return float(np.exp(rng.uniform(log(low), log(high))))

        mode, damping, delay = between(60.0, 600.0), between(0.005, 0.5), between(2e-4, 5e-3)
        character = Character(
            delay=delay, resonance=mode, damping=min(damping, 0.499), creep=float(rng.uniform(0.005, 0.02)),
            thermal_drift=float(rng.uniform(-0.3e-6, 0.3e-6)), drift_time=float(rng.uniform(3.0, 30.0)),
        )  # fmt: skip
        rate = between(6.0 * mode, 5000.0)
        return cls(AxisParameters.random(int(rng.integers(2**31))), character, rate, seed)

    def driven(self, seed: int, t: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return readings (m) at times (s) of voltages (V) that are linear between them, (N,) each."""
        # Also where a delayed voltage has its corners: between two steps the stage takes its input as linear.
        every = np.union1d(t, t + self.character.delay)
        _, y = SimulatedAxis(self.parameters, seed, self.character).run(every, np.interp(every, t, v))
        return np.asarray(y[np.searchsorted(every, t)])

    def measured(self) -> FrequencyResponse:
        """Return the frequency response, of the drive for it."""
        drive = response_drive(("x",), 0.0, 100.0, 800.0, RESPONSE, self.rate, self.seed)
        y = self.driven(2, drive.t, drive.voltage["x"])
        return frequency_response(drive.t, drive.voltage["x"], y)

    def identified(self) -> AxisModel:
        """Return the model of a calibration and of a drive for the mode, as diagnosed."""
        records = []
        for number, (drive, share) in enumerate((("calibration", 0.65), ("resonance", 0.35))):
            slew = 0.0 if drive == "resonance" else 1000.0
            voltages = excite(
                voltage_min=0.0, voltage_max=100.0, slew_limit=slew, rate=self.rate,
                duration=max(share * SAMPLES / self.rate, SHORTEST), seed=self.seed, drive=drive,
            )  # fmt: skip
            v = voltages.voltage["x"]
            y = self.driven(number, voltages.t, v)
            stamps = (voltages.t * SECOND_NS).astype(np.int64) + number * 10**12
            records.append(Record(stamps, {"x": v}, {"x": y}, f"record {number}"))
        return diagnose(records, identify(records[0])).extended.axis("x")

    def closed(
        self,
        model: AxisModel,
        gains: PidGains,
        seconds: float,
        path: Signal,
        added: np.ndarray,
        noise: bool,
        scale: float,
        known: bool = False,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return true displacement and reading (m), (N,) each, at the readings; `added` (m, (M,)) repeats on these.

        The path is sent as single set points, or, if it is `known`, as a trajectory.
        """
        quiet = self.parameters if noise else replace(self.parameters, noise_rms=0.0, quantisation=0.0)
        axis = SimulatedAxis(quiet, self.seed, replace(self.character, resonance=self.character.resonance * scale))
        period_ns = round(SECOND_NS / self.rate)
        feedback = gains.integral > 0.0
        loop = LoopSettings(feedback, gains, 0.3, 50.0, True)
        made = Controller(["x"], [LIMITS], loops=[loop], period=period_ns * 1e-9)
        made.use_model(StageModel({"x": model}))
        made.activate(BEGIN_NS)
        v = made.axes[0].output.voltage
        begin_ns = BEGIN_NS // period_ns * period_ns + 10 * period_ns
        true, readings, delay_ns = [], [], round(self.character.delay * SECOND_NS)
        arriving: deque[int] = deque()

        def moved(at_ns: int) -> float:
            # The stage takes its input as linear between two steps: it steps before and after what arrives late.
            while arriving and arriving[0] <= at_ns:
                arrives_ns = arriving.popleft()
                for before in (1, 0):
                    axis.step((arrives_ns - before - begin_ns) * 1e-9 + 1.0, v)
            return axis.step((at_ns - begin_ns) * 1e-9 + 1.0, v)

        def output(now_ns: int) -> None:
            nonlocal v
            if made.axes[0].output.voltage != v:
                moved(now_ns)
                v = made.axes[0].output.voltage
                moved(now_ns)
                arriving.append(now_ns + delay_ns)

        steps = np.arange(round(seconds * self.rate))
        if known:
            places = [[path(t)] for t in (steps * period_ns * 1e-9).tolist()]
            made.follow(["x"], steps * period_ns, places, begin_ns, begin_ns - period_ns, begin_ns - period_ns)
        for k in steps.tolist():
            now_ns = begin_ns + k * period_ns
            # The correction from the last reading, with the next setpoint; then a reading of the stage.
            while known and (due_ns := made.next_due_ns(now_ns, now_ns)) is not None and due_ns <= now_ns:
                due_ns = max(due_ns, now_ns - period_ns + period_ns // 50)
                made.advance(due_ns, due_ns)
                output(due_ns)
            if not known:
                made.update(now_ns, ["x"], [path(k * period_ns * 1e-9)], now_ns)
                output(now_ns)
            at_ns = now_ns + period_ns // 50
            x = moved(at_ns)
            y = (axis.measure(x) if noise else x) + (float(added[k % added.size]) if added.size else 0.0)
            with suppress(RejectedError):
                made.measure(["x"], [y], at_ns)
            true.append(x)
            readings.append(y)
        return np.array(true), np.array(readings)


def multisine(size: int, rms: float, rng: np.random.Generator) -> np.ndarray:
    """Return a period of a signal (m, (size,)) of an rms (m), of all frequencies; octaves below a tenth are alike."""
    k = np.arange(size // 2 + 1)
    spectrum = np.exp(2j * pi * rng.random(k.size)) / np.sqrt(np.minimum(np.maximum(k, 1), size // 20))
    spectrum[0] = 0.0
    signal = np.fft.irfft(spectrum, size)
    return np.asarray(signal * rms / signal.std())


def sines(
    stage: Stage, model: AxisModel, gains: PidGains, frequencies: np.ndarray, middle: float, peak: float
) -> np.ndarray:
    """Return the sensitivity, complex, (K,), at frequencies (Hz), (K,), measured with one sine (m) after the other."""
    ring = 1.0 / (2.0 * pi * stage.character.damping * stage.character.resonance)
    added, windows, count = [], [], 0
    for f in frequencies:
        settling = round(max(SETTLED * ring, 3.0 / f, 0.05) * stage.rate)
        size = settling + round(max(round(LASTING * f), PERIODS) / f * stage.rate)
        added.append(peak * np.sin(2.0 * pi * f / stage.rate * np.arange(size)))
        windows.append(slice(count + settling, count + size))
        count += size
    given = np.concatenate(added)
    _, y = stage.closed(model, gains, count / stage.rate, lambda t: middle, given, False, 1.0)
    found = []
    for f, window in zip(frequencies, windows, strict=True):
        k = np.arange(window.stop - window.start)
        phase = 2.0 * pi * f / stage.rate * k
        basis = np.stack([np.sin(phase), np.cos(phase), np.ones(k.size), k / k.size], axis=1)
        of = [np.linalg.lstsq(basis, signal[window], rcond=None)[0] for signal in (y, given)]
        found.append(complex(*of[0][:2]) / complex(*of[1][:2]))
    return np.array(found)


def sensitivity(stage: Stage, model: AxisModel, tuned: Design, middle: float) -> tuple[np.ndarray, np.ndarray]:
    """Return frequencies (Hz) and sensitivity, complex, (K,) each, of the loop on the stage at rest."""
    mode, highest = stage.character.resonance, 0.45 * stage.rate
    peak = ADDED * 2.0**0.5 * float(np.ptp(model.displacement_range))
    whole, beside, refined = SINES
    around = mode * np.linspace(0.85, 1.15, beside)
    f = np.geomspace(min(0.25 * tuned.bandwidth, 0.8 * mode), min(5.0 * mode, highest), whole)
    f = np.union1d(f, around[around <= highest])
    s = sines(stage, model, tuned.gains, f, middle, peak)
    most = int(np.argmax(np.abs(s)))
    more = np.linspace(f[max(most - 1, 0)], f[min(most + 1, f.size - 1)], refined + 2)[1:-1]
    more = np.setdiff1d(more, f)
    order = np.argsort(np.concatenate([f, more]))
    s = np.concatenate([s, sines(stage, model, tuned.gains, more, middle, peak)])[order]
    return np.concatenate([f, more])[order], s


def first_reached(f: np.ndarray, size: np.ndarray, level: float) -> float:
    """Return the lowest frequency (Hz) at which a size, (K,), at frequencies, (K,), reaches a level."""
    k = int(np.argmax(size >= level))
    if not k:
        return float(f[0])
    return float(np.exp(np.interp(log(level), np.log(size[k - 1 : k + 1]), np.log(f[k - 1 : k + 1]))))


def judged(seed: int) -> dict[str, float]:
    """Return the figures of one stage."""
    stage, begun = Stage.drawn(seed), time.process_time()
    model = stage.identified()
    response, known = stage.measured(), time.process_time()
    tuned = design(model, stage.rate, measured=beside_model(model, response))
    made = time.process_time()
    low, high = model.displacement_range
    middle, stroke = 0.5 * (low + high), high - low
    f, s = sensitivity(stage, model, tuned, middle)
    size = np.abs(s)
    bandwidth = first_reached(f, size, HALF)
    # The slope that the stage has shown: of the return ratio where it is large.
    linear = DiscreteLoop(tuned.plant, tuned.gains, 1.0 / stage.rate)
    slow = f <= bandwidth
    back = 1.0 / s[slow] - 1.0
    slope = tuned.plant.slope * float(np.median(np.abs(back) / np.abs(linear.response(2.0 * pi * f[slow]))))
    character = stage.character
    w = 2.0 * pi * character.resonance
    rule = min(2.0 * character.damping * w / 5.0, 0.2 / character.delay)
    effects = (Delay(character.delay), Resonance((Mode(character.resonance, character.damping, 1.0),)))
    loop = Loop.of(replace(model, effects=effects), 1.0 / stage.rate)
    loop = replace(loop, nominal=replace(loop.nominal, slope=slope), corners=())
    g = stroke / (model.voltage_range[1] - model.voltage_range[0])
    # Far below mode and delay that of an integrator.
    today = loop.bandwidth(Shape(0.0, 0.0, ()), rule / g) or rule / g * slope / (2.0 * pi)
    share, raster, seconds = RASTER
    none = np.empty(0)

    def path(t: float) -> float:
        # From rest to the middle first; then a triangle.
        wave = 4.0 * abs((t * raster + 0.25) % 1.0 - 0.5) - 1.0
        return middle * min(t / 0.5, 1.0) - (0.5 * share * stroke * wave if t >= 0.5 else 0.0) * min(
            max(t - 0.5, 0.0) * 5.0, 1.0
        )

    errors = []
    three = (PidGains(0.0), PidGains(0.0, rule / g), tuned.gains)
    for gains, planned in [(each, way) for way in (False, True) for each in three]:
        x, _ = stage.closed(model, gains, 1.0 + seconds, path, none, True, 1.0, planned)
        t = np.arange(x.size) / stage.rate
        error = x - np.array([path(each) for each in t])
        errors.append(float(np.sqrt(np.mean(error[t >= 1.0] ** 2))))
    stable = 0
    added = multisine(int(0.5 * stage.rate), ADDED * stroke, np.random.default_rng(1))
    for scale in (0.9, 1.1):
        _, y = stage.closed(model, tuned.gains, 2.0, lambda t: middle, added, False, scale)
        parts = [float(np.ptp(part)) for part in np.array_split(y[y.size // 4 :], 3)]
        stable += parts[2] < 2.0 * parts[0] and parts[2] < 10.0 * np.ptp(added)
    return {
        "mode": character.resonance, "damping": character.damping, "delay": character.delay, "rate": stage.rate,
        "bandwidth": bandwidth, "predicted": tuned.bandwidth, "ratio": bandwidth / today,
        "margin": float(1.0 / size.max()), "stable": stable,
        "feedforward": errors[0], "rule": errors[1], "tuned": errors[2],
        "known_feedforward": errors[3], "known_rule": errors[4], "known_tuned": errors[5],
        "seconds": made - known, "identified": known - begun,
    }  # fmt: skip


def response_judged(stage: Stage) -> tuple[int, float, float, float]:
    """Return lines up to twice the mode, shares with an interval of 5 %, of these within 5 % and 5 degrees, in theirs.

    The truth is mode, delay and creep; the slope, which depends on the amplitude, is the measured one. The slowest
    lines, which move the stage most, have up to 5 % more of it by the hysteresis alone.
    """
    found, character = stage.measured(), stage.character
    mode = Resonance((Mode(character.resonance, character.damping, 1.0),))
    truth = Plant(1.0, character.delay, mode.dynamics).response(2.0 * pi * found.frequency)
    creep = Creep(character.creep, character.creep_shortest, character.creep_longest)
    slow = 2j * pi * found.frequency[:, None] * creep.time_constants
    off = found.response / (truth * (1.0 + np.sum(creep.gains / (1.0 + slow), axis=1)))
    off = off / np.median(np.abs(off[found.frequency < 0.5 * character.resonance]))
    band = found.frequency <= 2.0 * character.resonance
    sure = band & (found.relative <= 0.05)
    within = (np.abs(np.abs(off) - 1.0) <= 0.05) & (np.abs(np.angle(off)) <= np.radians(5.0))
    inside = np.abs(off - 1.0) <= found.relative
    return (
        int(np.sum(band)), float(np.sum(sure) / np.sum(band)),
        float(np.mean(within[sure])) if sure.any() else 1.0, float(np.mean(inside[band])),
    )  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> int:
    """Print each stage and the counts."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=30)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--response", action="store_true", help="the frequency responses only")
    options = parser.parse_args(arguments)
    if options.response:
        print(
            " seed  mode/Hz damping | lines to twice the mode, sure within 5 %, of these right, inside their interval"
        )
        shares = []
        for seed in range(options.first, options.first + options.count):
            stage = Stage.drawn(seed)
            lines, sure, right, inside = response_judged(stage)
            shares.append(right)
            c = stage.character
            print(f"{seed:5d} {c.resonance:8.0f} {c.damping:7.3f} | {lines:5d} {sure:7.1%} {right:7.1%} {inside:7.1%}")
        print(
            f"all sure lines right: {np.sum(np.array(shares) == 1.0)}, 95 % of them: {np.sum(np.array(shares) >= 0.95)}"
        )
        return 0
    print(
        " seed  mode/Hz damping delay/ms rate/Hz | bandwidth/Hz (predicted) over today's rule, margin, stable of 2 | "
        "raster, nm rms: feedforward, today's rule, tuned | the same as a trajectory", flush=True,
    )  # fmt: skip
    found = []
    for seed in range(options.first, options.first + options.count):
        one = judged(seed)
        found.append(one)
        print(
            f"{seed:5d} {one['mode']:8.0f} {one['damping']:7.3f} {one['delay'] * 1e3:8.2f} {one['rate']:7.0f} | "
            f"{one['bandwidth']:6.1f} ({one['predicted']:.1f}) {one['ratio']:6.1f} "
            f"{one['margin']:5.2f} {one['stable']} | "
            f"{one['feedforward'] * 1e9:7.1f} {one['rule'] * 1e9:7.1f} {one['tuned'] * 1e9:7.1f} | "
            f"{one['known_feedforward'] * 1e9:7.1f} {one['known_rule'] * 1e9:7.1f} {one['known_tuned'] * 1e9:7.1f} "
            f"| {one['identified']:.0f} + {one['seconds']:.1f} s", flush=True,
        )  # fmt: skip
    ratio, margin, stable = (np.array([one[name] for one in found]) for name in ("ratio", "margin", "stable"))
    n, less = len(found), np.sum(ratio >= 2.5)
    print(
        f"bandwidth over today's rule: median {np.median(ratio):.1f}, 2.5 or more {less}, below 1 {np.sum(ratio < 1)}"
    )
    print(f"modulus margin 0.45 or more: {np.sum(margin >= 0.45)} of {n}")
    print(f"stable with the mode 10 % off: {np.sum(stable == 2)} of {n}")
    for way, prefix in (("raster of single set points", ""), ("raster as a trajectory", "known_")):
        forward, rule, tuned = (
            np.array([one[prefix + name] for one in found]) for name in ("feedforward", "rule", "tuned")
        )
        print(
            f"{way}: at most half of feedforward {np.sum(tuned <= 0.5 * forward)} of {n}, above 1.2 times today's rule "
            f"{np.sum(tuned > 1.2 * rule)}"
        )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
