"""Random episodes of a compensator without ROS: whatever happens, what leaves it keeps its limits.

A `Wire` stands where the amplifier is and knows the definitions of the limits only: it uses nothing of the rate limiter
that it checks. An `Episode` draws everything else from a seed: pauses, bursts, clocks, publishers, trajectories,
resets, models, parameters, restarts, saved memories, sensors and reports that lie, and others that move the stage.
"""

import random
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from math import inf, nan, sin

import numpy as np

from slpi_ros.compensator.controller import Controller, OperatingMode, StopReason
from slpi_ros.compensator.feedback import LoopSettings, PidGains
from slpi_ros.compensator.motion import Safety
from slpi_ros.compensator.persistence import SavedAxis
from slpi_ros.compensator.validation import RejectedError
from slpi_ros.effects.base import Effect
from slpi_ros.effects.creep import Creep
from slpi_ros.effects.lag import Lag
from slpi_ros.errors import SlpiError
from slpi_ros.hysteresis.prandtl_ishlinskii import PrandtlIshlinskii
from slpi_ros.hysteresis.turning_points import Memory
from slpi_ros.model.axis_model import AxisModel, FitQuality, Start
from slpi_ros.model.limits import Limits
from slpi_ros.model.stage_model import StageModel

SECOND_NS, MS = 1_000_000_000, 1_000_000
AXES = ("x", "y")
# Rounding of a sum of voltages, volts.
ROUNDING = 1e-9


@dataclass
class Ratios:
    """Largest ratios to the limits in a run.

    Parameters
    ----------
    step, slew, acceleration : float
        Step to the largest allowed one, mean rate over any three steps to what the slew limit allows in that time, and
        change of the rate to what the acceleration limit allows.
    start : float
        First step from the voltage of the amplifier to the largest allowed one, where the reports told it.
    outside : float, volts
        Farthest voltage outside of the limits, beyond where the amplifier was found.
    outputs : int
    what : dict of str to str
        What happened at the largest ratios.
    """

    step: float = 0.0
    slew: float = 0.0
    acceleration: float = 0.0
    start: float = 0.0
    outside: float = 0.0
    outputs: int = 0
    what: dict[str, str] = field(default_factory=dict)

    def note(self, name: str, value: float, what: str) -> None:
        """Keep the largest value of a ratio, and what happened."""
        if value > getattr(self, name):
            setattr(self, name, value)
            self.what[name] = what

    def add(self, other: "Ratios") -> None:
        """Take over what is larger in another run."""
        for name in ("step", "slew", "acceleration", "start", "outside"):
            self.note(name, getattr(other, name), other.what.get(name, ""))
        self.outputs += other.outputs


class Wire:
    """The wire to the amplifier of one axis: what comes is compared with the limits in force.

    Parameters
    ----------
    voltage : float, volts
        Where the amplifier is.
    limits : Limits
    period : float, seconds
        Output period.
    """

    def __init__(self, voltage: float, limits: Limits, period: float) -> None:
        self.voltage, self.limits, self.period = voltage, limits, period
        # While an axis that moves within an acceleration limit stops, the old limits are still in force.
        self._old: list[tuple[Limits, float]] = []
        self._changes: list[tuple[int, float]] = []
        self._rate, self._before_ns = 0.0, -SECOND_NS
        self._may_stop = self.known = False

    def change(self, limits: Limits, period: float) -> None:
        """Set new limits."""
        if self._rate and self.limits.acceleration < inf:
            self._old.append((self.limits, self.period))
        elif self._old:
            # Without acceleration limit for a while, the axis has stopped at once, or goes on to brake.
            self._may_stop = True
        else:
            # Without acceleration limit so far, the axis stops at once.
            self._rate = 0.0
        self.limits, self.period, self._changes = limits, period, []

    def moved(self, voltage: float) -> None:
        """Somebody else moves the amplifier; what comes next is not compared with what came before."""
        self.voltage, self._rate, self._old, self._changes = voltage, 0.0, [], []
        self._before_ns, self._may_stop = -SECOND_NS, False

    def begin(self, voltage: float, rate: float, now_ns: int) -> None:
        """Take a first voltage (V), and its rate (V/s), as they are."""
        self.moved(voltage)
        self._rate, self._before_ns = rate, now_ns

    def output(self, voltage: float, now_ns: int, ratios: Ratios, what: str, meant: bool = True) -> None:
        """Take a voltage (V) at `now_ns`; `meant`: whether the message was made to move this axis."""
        ratios.outputs += 1
        if now_ns - self._before_ns > 2e9 * max(self.period, *(period for _, period in self._old), 0.0):
            self._old, self._rate = [], 0.0
        if voltage == self.voltage and (not meant or not self._rate):
            return
        step, gap = voltage - self.voltage, (now_ns - self._before_ns) * 1e-9
        force = [*self._old, (self.limits, self.period)]
        accelerated = any(limits.acceleration < inf for limits, _ in force)
        if accelerated:
            self._accelerate(step, gap, force, ratios, what)
        allowed = max(limits.slew * min(gap, 2.0 * period) for limits, period in force)
        if step and allowed < inf and not accelerated:
            ratios.note("step", (abs(step) - ROUNDING) / allowed if allowed else inf, what)
            self._changes = [*self._changes[-3:], (now_ns, abs(step))]
            first_ns = self._changes[0][0]
            way = sum(size for _, size in self._changes[1:])
            most = max(limits.slew * ((now_ns - first_ns) * 1e-9 + 2.0 * period) for limits, period in force)
            ratios.note("slew", (way - ROUNDING) / most, what)
        lower, upper = min(limits.lower for limits, _ in force), max(limits.upper for limits, _ in force)
        beyond = max(voltage - max(upper, self.voltage), min(lower, self.voltage) - voltage)
        ratios.note("outside", beyond - ROUNDING, what)
        if step or accelerated:
            self._before_ns = now_ns
        self.voltage = voltage
        if not accelerated:
            self._rate = step / gap if gap > 0.0 else 0.0
        if not self._rate:
            self._old = []

    def _accelerate(
        self, step: float, gap: float, force: list[tuple[Limits, float]], ratios: Ratios, what: str
    ) -> None:
        """Compare the change of the rate with the acceleration limit; a pause of two periods is a rest."""
        period = max(each for _, each in force)
        rate, dt = (self._rate, gap) if gap <= 2.0 * period else (0.0, period)
        if dt <= 0.0:
            ratios.note("acceleration", inf if step else 0.0, what)
            return
        acceleration = max(limits.acceleration for limits, _ in force)
        self._rate = step / dt
        # A rounding error of the voltage is one of the rate.
        change = max(abs(self._rate - rate) - 2.0 * ROUNDING / dt, 0.0)
        if self._may_stop:
            change, self._may_stop = min(change, abs(self._rate)), False
        ratios.note("acceleration", change / (acceleration * dt), what)
        most = max(limits.slew * min(gap, 2.0 * each) for limits, each in force)
        if most < inf and abs(self._rate) > abs(rate):
            ratios.note("slew", (abs(step) - ROUNDING) / most, what)


def stage(rng: random.Random, top: float) -> StageModel:
    """Draw a model of two axes, identified from 0 V to `top` (V)."""

    def axis() -> AxisModel:
        scale = rng.uniform(0.8, 1.2)
        loops = PrandtlIshlinskii(np.array([0.0, 5.0, 15.0, 30.0]), scale * np.array([6e-8, 2e-8, 1e-8, 1e-8]))
        effects: tuple[Effect, ...] = ()
        if rng.random() < 0.3:
            effects += (Lag(rng.uniform(1e-3, 2e-2)),)
        if rng.random() < 0.3:
            effects += (Creep((0.1, 1.0), (0.02, 0.02)),)
        memory = Memory(loops)
        reach = memory.forward(top)
        end = rng.choice([None, Start(0.6 * top, 0.6 * reach, (top, 0.0), False)])
        quality = FitQuality(8e-9, 3e-8, 8e-9, 8e-9, 1000, 0.9, "drawn")
        return AxisModel("pi", loops, Start(0.0, 0.0), (0.0, top), (0.0, reach), quality, effects, end)

    return StageModel({name: axis() for name in AXES}, "stage", "2026-01-02T03:04:05+00:00")


class Episode:
    """One random episode.

    Parameters
    ----------
    seed : int
    length : int
        Number of events; default 40.
    """

    def __init__(self, seed: int, length: int = 40) -> None:
        self.rng = rng = random.Random(seed)
        self.seed, self.length, self.ratios = seed, length, Ratios()
        self.now_ns = rng.randrange(1, 10**6) * SECOND_NS
        # Clocks of two publishers of desired displacements, apart from each other and from that of the node.
        self.clocks = [rng.choice([0, 3, -3, 10**9]) * SECOND_NS for _ in range(2)]
        self.period = 10.0 ** rng.uniform(-3.3, -2.0)
        self.limits = self._limits()
        self.voltages = {name: rng.uniform(0.0, 100.0) for name in AXES}
        self.reports = rng.choice(["none", "good", "noisy", "slow"])
        self.what = "start"
        self.reported_ns = 0
        self.done, self.fighting = "", False
        self._new_life()

    def _limits(self) -> Limits:
        rng = self.rng
        low = rng.choice([0.0, 0.0, 20.0])
        acceleration = rng.choice([inf, inf, 10.0 ** rng.uniform(3, 6)])
        return Limits(low, low + rng.uniform(30.0, 80.0), 10.0 ** rng.uniform(1.5, 4.0), acceleration)

    def _new_life(self) -> None:
        """Start a node, with the memory of the last one, or without it."""
        rng = self.rng
        loop = LoopSettings(
            rng.random() < 0.3, PidGains(10.0 ** rng.uniform(5, 7), 10.0 ** rng.uniform(6, 9)), 0.1, 20.0
        )
        self.made = Controller(
            AXES,
            [self.limits] * 2,
            loops=[loop] * 2,
            period=self.period,
            starts=[rng.choice(["auto", "auto", "measured"])] * 2,
        )
        self.wires = [Wire(self.voltages[name], self.limits, self.period) for name in AXES]
        if self.reports == "none":
            # Nobody tells where the amplifier is: the node has to assume, and says so.
            self.made.ownership._starts = ["auto"] * 2
        saved, last = None, None
        kept = rng.choice(["none", "same", "other"]) if self.done else "none"
        model = stage(rng, 100.0)
        if kept == "same":
            model = self.model
            saved = {axis.name: SavedAxis(axis.reversal_voltages, True) for axis in self.done_axes}
        elif kept == "other":
            last = {axis.name: axis.voltage for axis in self.done_axes}
        self.model = model
        with_model_first = rng.random() < 0.5
        if with_model_first:
            self.made.use_model(model, saved, rng.choice(["end", "start", "wiped"]), last)
        self.made.activate(self.now_ns)
        if not with_model_first:
            self.made.use_model(model, saved, rng.choice(["end", "start", "wiped"]), last)
        self.made.ownership.reporting = self.reports != "none"

    # The world

    def run(self) -> Ratios:
        """Run the episode; return the largest ratios."""
        events: list[Callable[[], None]] = [
            self.stream, self.stream, self.stream, self.burst, self.single, self.follow, self.follow, self.cancel,
            self.pause, self.pause, self.reset, self.ramp, self.parameters, self.parameters, self.swap, self.restart,
            self.reactivate, self.lie, self.intruder, self.safety,
        ]  # fmt: skip
        for _ in range(self.length):
            event = self.rng.choice(events)
            self.what = f"seed {self.seed}: {event.__name__}"
            event()
        self.wait(0.2)
        return self.ratios

    def wait(self, seconds: float) -> None:
        """Let time pass; the node is called when it wants to be, or late."""
        end_ns = self.now_ns + int(seconds * SECOND_NS)
        while self.now_ns < end_ns:
            clock_ns = self.now_ns
            due_ns = self.made.next_due_ns(self.now_ns, clock_ns)
            nap_ns = 5 * MS if due_ns is None else max(due_ns - self.now_ns, 0)
            late = self.rng.random()
            jitter = 0.1 if late < 0.9 else 1.5 if late < 0.98 else 20.0
            nap_ns = min(nap_ns, 5 * MS) + int(self.rng.uniform(0.0, jitter) * self.period * SECOND_NS)
            self.now_ns = min(self.now_ns + max(nap_ns, 1000), end_ns)
            self.report()
            if self.made.advance(self.now_ns, self.now_ns):
                self.publish()

    def report(self) -> None:
        """Let the amplifier report its voltages."""
        every = {"none": inf, "slow": 0.4}.get(self.reports, 0.005)
        if (self.now_ns - self.reported_ns) * 1e-9 < every:
            return
        self.reported_ns = self.now_ns
        noise = 0.3 if self.reports == "noisy" else 0.0
        told = [wire.voltage + self.rng.gauss(0.0, noise) for wire in self.wires]
        if self.rng.random() < 0.002:
            told[0] = self.rng.choice([nan, inf, -1e300])
        self.made.report(AXES, told, self.now_ns)
        self.made.locate(self.now_ns)

    def publish(self) -> None:
        """Take what the node outputs."""
        known = self.reports in ("good", "noisy", "slow")
        if self.fighting:
            return
        for wire, voltage, axis in zip(self.wires, self.made.voltages, self.made.axes, strict=True):
            if not wire.known:
                wire.known = True
                allowed = 2.0 * wire.period * wire.limits.slew + (1.3 if self.reports == "noisy" else ROUNDING)
                if known:
                    self.ratios.note("start", abs(voltage - wire.voltage) / allowed, self.what)
                if self.reports not in ("good", "slow"):
                    # Known within noise only, or not at all: compared from here on.
                    moves = axis.output._changed_ns == self.now_ns
                    wire.begin(voltage, axis.output.rate if moves else 0.0, self.now_ns if moves else -SECOND_NS)
                    continue
            wire.output(
                voltage,
                self.now_ns,
                self.ratios,
                self.what,
                self.now_ns in (axis.samples.given_ns, axis.loop.driven_ns),
            )
        self.voltages = {name: wire.voltage for name, wire in zip(AXES, self.wires, strict=True)}

    def send(self, names: tuple[str, ...], shares: list[float], clock: int = 0) -> None:
        """Send a desired message: shares of the stroke."""
        tops = [self.model.axes[name].displacement_range[1] for name in names]
        stamp_ns = self.now_ns + self.clocks[clock] + self.rng.choice([0, 0, 0, -MS, 5 * MS])
        try:
            y = [share * top for share, top in zip(shares, tops, strict=True)]
            self.made.update(stamp_ns, names, y, self.now_ns, self.now_ns)
        except RejectedError:
            return
        self.publish()

    # Events

    def stream(self) -> None:
        rate = 10.0 ** self.rng.uniform(1.0, 3.3)
        omega, names = self.rng.uniform(1.0, 60.0), self.rng.choice([("x",), ("y",), AXES])
        for k in range(self.rng.randrange(5, 60)):
            share = 0.5 + 0.45 * sin(omega * k / rate)
            self.send(names, [share] * len(names))
            self.wait(1.0 / rate)

    def burst(self) -> None:
        for k in range(self.rng.randrange(2, 30)):
            self.send(AXES, [self.rng.uniform(0.0, 1.0)] * 2, k % 2)
            self.now_ns += self.rng.randrange(1000, 300_000)

    def single(self) -> None:
        self.send(self.rng.choice([("x",), AXES])[:1], [self.rng.uniform(-0.1, 1.1)], self.rng.randrange(2))
        self.wait(self.rng.uniform(0.0, 0.3))

    def follow(self) -> None:
        count, step = self.rng.randrange(1, 60), int(10.0 ** self.rng.uniform(5.5, 7.7))
        names = self.rng.choice([("x",), AXES])
        start = self.rng.choice([0, 0, 50 * MS, -20 * MS])
        path = [[self.rng.uniform(0.0, 1.0) * 8e-6 for _ in names] for _ in range(count)]
        times = [self.rng.choice([0, step]) + k * step for k in range(count)]
        try:
            self.made.follow(
                names, np.array(times), np.array(path), self.now_ns + start if start else 0, self.now_ns, self.now_ns
            )
        except RejectedError:
            return
        self.wait(min(self.rng.uniform(0.0, 1.2) * count * step * 1e-9, 0.5))

    def cancel(self) -> None:
        try:
            self.made.follow((), [], [], 0, self.now_ns, self.now_ns)
        except RejectedError:
            return

    def pause(self) -> None:
        self.wait(self.rng.choice([0.01, 0.1, 1.0, 1.0]))

    def reset(self) -> None:
        if not self.made.active or self.made.mode is OperatingMode.TRAJECTORY:
            return
        span = self.rng.choice([[], [(30.0, 40.0)] * 2])
        try:
            self.made.reset_memory(2, 10.0 ** self.rng.uniform(2, 4), list(self.made.voltages), self.now_ns, span)
        except RejectedError:
            return
        self.wait(self.rng.uniform(0.0, 0.4))

    def ramp(self) -> None:
        try:
            self.made.ramp([self.rng.uniform(0.0, 100.0)] * 2, 10.0 ** self.rng.uniform(1, 4), self.now_ns)
        except RejectedError:
            return
        self.wait(self.rng.uniform(0.0, 0.2))

    def safety(self) -> None:
        self.made.watch(Safety(0.05, True, True, (10.0, 60.0), 300.0), 0.0, self.now_ns)
        self.wait(0.05)

    def parameters(self) -> None:
        new = self._limits()
        if self.rng.random() < 0.5:
            new = replace(self.limits, slew=10.0 ** self.rng.uniform(1.5, 4.0))
        if self.rng.random() < 0.2:
            self.period = 10.0 ** self.rng.uniform(-3.3, -2.0)
        try:
            self.made.use_limits([new] * 2, self.now_ns, self.period)
        except SlpiError:
            return
        self.limits = new
        for wire in self.wires:
            wire.change(new, self.period)
        self.wait(self.rng.uniform(0.0, 0.05))

    def swap(self) -> None:
        model = stage(self.rng, self.rng.choice([100.0, 90.0]))
        try:
            self.made.use_model(model)
        except SlpiError:
            return
        self.model = model

    def restart(self) -> None:
        """End the node, with or without something else that moves the stage meanwhile, and start another."""
        self.done, self.done_axes = "ended", self.made.axes
        if self.rng.random() < 0.4:
            self.voltages = {name: self.rng.uniform(0.0, 100.0) for name in AXES}
        self.now_ns += int(self.rng.uniform(0.0, 2.0) * SECOND_NS)
        self._new_life()
        self.wait(self.rng.uniform(0.0, 0.1))

    def reactivate(self) -> None:
        self.made.stop(StopReason.DEACTIVATED, self.now_ns)
        while self.made.ramping and self.made.ownership.owned:
            self.wait(self.period)
        self.made.deactivate(self.now_ns)
        self.now_ns += int(self.rng.uniform(0.0, 0.5) * SECOND_NS)
        known = self.reports in ("good", "noisy")
        if self.rng.random() < 0.3 and known:
            for wire in self.wires:
                wire.moved(self.rng.uniform(0.0, 100.0))
                wire.known = False
        self.made.activate(self.now_ns)
        self.made.ownership.reporting = self.reports != "none"
        if self.reports == "noisy":
            for wire in self.wires:
                wire.known = False
        if known:
            # What the reports still tell of before is no knowledge.
            self.wait(0.1)

    def lie(self) -> None:
        """A sensor that tells anything: zero, far away, what it said before, the wrong sign."""
        kind = self.rng.randrange(4)
        for _ in range(self.rng.randrange(1, 40)):
            true = self.made.axes[0].stream.uncoupled_displacement if self.made.axes[0].model else 0.0
            told = [0.0, 1.0, 5e-6, -true][kind]
            with suppress(RejectedError):
                self.made.measure(["x"], [told], self.now_ns, self.rng.random() < 0.8)
            self.send(AXES, [self.rng.uniform(0.3, 0.6)] * 2)
            self.wait(0.004)
            self.made.watch(Safety(0.0, False, False, (0.0, 0.0), 50.0), 0.05, self.now_ns)

    def intruder(self) -> None:
        """Somebody else moves the amplifier, and reports tell; then `arm`."""
        if self.reports not in ("good", "noisy") or not self.made.ownership.owned:
            return
        goal = self.rng.uniform(0.0, 100.0)
        if abs(goal - self.wires[0].voltage) < 20.0:
            return
        self.wires[0].moved(goal)
        end_ns = self.now_ns + 2 * SECOND_NS
        # The intruder goes on: what this node says is overwritten at once, until it gives up.
        self.fighting = True
        while self.made.ownership.armed and self.now_ns < end_ns:
            self.wait(0.02)
        self.fighting = False
        self.wires[1].moved(self.made.voltages[1])
        self.voltages["x"] = goal
        if self.rng.random() < 0.8:
            self.wait(0.4)
            if not self.made.arm(self.now_ns):
                for wire in self.wires:
                    wire.known = False


def run(seeds: range, length: int = 40) -> Ratios:
    """Run an episode for each seed; return the largest ratios."""
    every = Ratios()
    for seed in seeds:
        every.add(Episode(seed, length).run())
    return every
