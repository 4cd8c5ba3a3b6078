"""A simulated stage of one or more axes."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import count

import numpy as np

from slpi_ros.errors import UsageError
from slpi_ros.simulation.axis import SimulatedAxis
from slpi_ros.simulation.character import PLAIN, STRENGTHS, Character, draw
from slpi_ros.simulation.dynamics import Creep
from slpi_ros.simulation.parameters import AxisParameters
from slpi_ros.simulation.room import Room

# Seeds of the axes of one stage differ by this number.
NEXT_AXIS = 1000


class Stage:
    """Axes, each with hysteresis, other effects and a sensor, which may move each other; UsageError without axes."""

    def __init__(self, axes: Mapping[str, SimulatedAxis]) -> None:
        if not axes:
            raise UsageError("stage: it has no axis; name at least one")
        self.axes = dict(axes)

    @classmethod
    def random(cls, names: Sequence[str], seed: int, noise_rms: float | None = None) -> "Stage":
        """Return a random plausible stage at rest, without effects but hysteresis; the first axis is of that seed."""
        return cls.of(names, [PLAIN] * len(names), seed, noise_rms)

    @classmethod
    def of(
        cls,
        names: Sequence[str],
        characters: Sequence[Character],
        seed: int,
        noise_rms: float | None,
        room: Room | None = None,
    ) -> "Stage":
        """Return a stage at rest with the hysteresis of `random`, and one character for each axis, in a room."""
        if len(set(names)) != len(names):
            raise UsageError(f"stage: axes {', '.join(names)} are not unique; give each axis its own name")
        axes = {}
        for own, (name, character) in zip(count(seed, NEXT_AXIS), zip(names, characters, strict=True), strict=False):
            parameters = AxisParameters.random(own)
            if noise_rms is not None:
                parameters = replace(parameters, noise_rms=noise_rms)
            axes[name] = SimulatedAxis(parameters, own, character, room)
        return cls(axes)

    @classmethod
    def hidden(cls, names: Sequence[str], seed: int, noise_rms: float, *, rate: float, voltage_max: float) -> "Stage":
        """Return a random stage whose axes have one or two effects each, as from `draw`; several axes are coupled."""
        rng = np.random.default_rng([seed, 15])
        others = [name for name in STRENGTHS if name != "cross_coupling"]
        characters = []
        for _ in names:
            number = int(rng.integers(1, 3))
            if len(names) > 1:
                effects = ["cross_coupling", *rng.choice(others, number - 1, replace=False).tolist()]
            else:
                effects = rng.choice(others, number, replace=False).tolist()
            characters.append(draw(rng, effects, rate=rate, voltage_max=voltage_max))
        return cls.of(names, characters, seed, noise_rms)

    @property
    def effects(self) -> dict[str, tuple[str, ...]]:
        """Names of the effects of each axis."""
        return {name: axis.character.effects for name, axis in self.axes.items()}

    @property
    def voltage_range(self) -> tuple[float, float]:
        """Voltage range accepted by all axes, lowest and highest, volts."""
        parameters = [axis.parameters for axis in self.axes.values()]
        return max(p.threshold_min for p in parameters), min(p.threshold_max for p in parameters)

    def begin_drift(self, t: float) -> None:
        """Begin the drifts of all axes at time `t` (s)."""
        for axis in self.axes.values():
            axis.begin_drift(t)

    def step(self, t: float, voltages: Sequence[float]) -> list[float]:
        """Apply one voltage (V) to each axis at time `t` (s), not decreasing; return readings (m) without noise."""
        axes = list(self.axes.values())
        motion = [axis.move(t, v) for axis, v in zip(axes, voltages, strict=True)]
        whole = sum(motion)
        coupled = [own + axis.character.coupling * (whole - own) for axis, own in zip(axes, motion, strict=True)]
        return [axis.read(t, own) for axis, own in zip(axes, coupled, strict=True)]

    def measure(self, readings: Sequence[float]) -> list[float]:
        """Return the readings (m) with noise and resolution of the sensors, in the order of `axes`."""
        return [axis.measure(y) for axis, y in zip(self.axes.values(), readings, strict=True)]


_P11_PEAK = 89.189e-6
_P11_HALF_PERIOD = 0.5


def flexure_axis(seed: int = 0) -> SimulatedAxis:
    """Return an axis similar to that of the SLPI paper: 0 to 100 V, quasi-static, loops that vary with bias.

    - 0 to 100 V: the range of the paper's voltage controller (section 2.2).
    - Stroke 24 µm: chosen. The paper states none; its Table 4 gives 6.5 at 100 V, in an unstated unit.
    - Hysteresis 14 % of the stroke: chosen, usual for soft piezo ceramics at full range. Table 4 gives 18 %.
    - Thresholds from -30 V: chosen for a remanence near 8 % of the stroke; Table 4 leaves 0.545 of 6.52, 8.4 %.
    - Density growing with bias (slope 0.8), wider relays at higher bias, flexure stiffening by 1 %: chosen, so that the
      slope of inner loops of equal width depends on bias and history (Fig. 7).
    - No dynamics: a sample every 0.8 s, creep and temperature "can be ignored" (2.2).
    - Noise 5 nm rms, resolution 1 nm: chosen; the resolution of a laser interferometer such as the paper's is 1 nm,
      and the mean of two passes (2.2) leaves little noise.

    It is at rest at 0 V. `seed` is that of the sensor noise; nothing else depends on it.
    """
    parameters = AxisParameters(
        stroke=24e-6,
        hysteresis=0.14,
        nominal_voltage=100.0,
        threshold_min=-30.0,
        threshold_max=120.0,
        levels=300,
        bias_slope=0.8,
        stiffening=0.01,
        noise_rms=5e-9,
        quantisation=1e-9,
    )
    return SimulatedAxis(parameters, seed)


def p11_stage(seed: int = 0) -> Stage:
    """Return a stage similar to the P11.XY100 of the MPI paper: 0 to 120 V nominal, with creep and resonance.

    - -20 to 150 V: stated (section 2.1).
    - Peak of 89.189 µm for a triangle of 120 V at 1 Hz: Table 1, where ``a`` is the peak at 1 Hz. The stroke of the
      relays is this peak divided by the growth due to creep during a ramp of half a second.
    - Exponent 1.15 and stiffening 0.03: the other five ``a`` of Table 1, reproduced within 2 %. A larger exponent would
      reproduce them better, but make the rise, "highly linear" (2.3), less linear.
    - Relays of the power-law material: "the change in voltage amplitude basically does not affect the shape of the
      hysteresis curve" (5); a nearly straight rise and a bulging fall (2.3, Fig. 2 and 3).
    - Hysteresis of the relays 11 %, a loop of 13 % with creep at 0.1 Hz: chosen, usual for piezo stacks.
    - Creep of 4.2 % in a decade between 1 ms and 100 s: makes the peaks fall as ``f^b`` with ``b = -0.015``, the mean
      of Table 1, from 0.1 to 20 Hz; the time constants exceed this range on both sides.
    - Flexure mode at 350 Hz, damping 0.05: chosen; triangles oscillate visibly at 10 and 20 Hz only (2.4, Fig. 4f and
      g). At 20 Hz and 120 V the oscillation is 2.2 µm; the maximum error of the model in Table 2 is 1.4 µm.
    - Amplifier lag 0.2 ms: chosen; "the greater the frequency, the more obvious the hysteresis" (2.3), but the
      influence of frequency "is not visible" (2.4): from 0.1 to 10 Hz the loop widens by 1 % of the stroke.
    - Noise 10 nm rms: chosen, usual for strain gauges. Resolution 3 nm: 16 bits over -10 to 10 V (2.1), where 10 V
      correspond to 100 µm (chosen).
    - The y axis differs by a few per cent: chosen; the paper says only that the axes are independent (2.2).

    The axes ``x`` and ``y`` are at rest at 0 V. `seed` is that of the sensor noise, which differs between them; nothing
    else depends on it.
    """
    moving = Character(lag=0.2e-3, creep=0.042, creep_shortest=1e-3, creep_longest=100.0, resonance=350.0, damping=0.05)
    creep = Creep(moving.creep, moving.creep_shortest, moving.creep_longest)
    x = AxisParameters(
        stroke=_P11_PEAK / creep.after_ramp(_P11_HALF_PERIOD),
        hysteresis=0.11,
        nominal_voltage=120.0,
        threshold_min=-20.0,
        threshold_max=150.0,
        levels=340,
        exponent=1.15,
        stiffening=0.03,
        noise_rms=10e-9,
        quantisation=3e-9,
    )
    y = replace(x, stroke=0.97 * x.stroke, hysteresis=0.115, exponent=1.14)
    y_moving = replace(moving, creep=0.040, resonance=330.0)
    return Stage({"x": SimulatedAxis(x, seed, moving), "y": SimulatedAxis(y, seed + NEXT_AXIS, y_moving)})
