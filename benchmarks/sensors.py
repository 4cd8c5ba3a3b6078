"""Diagnosis of records with sensor imperfections, on simulated stages without other effects.

Coarse sensors (50 to 1000 steps over the stroke), sensors that saturate, pure delays at one speed and one frequency,
and late or mixed readings with and without a gain drift. A path that was not recorded is then simulated by the plain
and by the extended model; errors are relative to the true displacement, without their constant offset.
"""

import argparse
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from accuracy import V_MAX, FloatArray, fresh, record_of
from paths import scan_path
from threadpoolctl import threadpool_limits

import slpi_ros
from slpi_ros.effects.base import EffectContext
from slpi_ros.effects.gain_drift import GainDrift
from slpi_ros.excitation.drives import calibration_drive

RATE, SECONDS, UNSEEN = 100.0, 30.0, 20.0
# Fractions of late or mixed readings, number of readings between two reversals, and gain drift.
SHARES, MOVES, DRIFT = (0.05, 0.11, 0.2), (16, 40, 100), -0.024


@dataclass(frozen=True)
class Draw:
    """A simulated record and its true properties.

    Parameters
    ----------
    t, v, y : ndarray, shape (N,), seconds, volts and metres
        Time, voltage and reading.
    allowed : set of str
        Causes that do not count as invented.
    delay : float, seconds
        Delay of the displacement.
    share : float
        Fraction of late or mixed readings.
    """

    t: FloatArray
    v: FloatArray
    y: FloatArray
    allowed: frozenset[str] = frozenset()
    delay: float = 0.0
    share: float = 0.0


def coarse(seed: int, number: int) -> Draw:
    """Return a record of a sensor with coarse resolution."""
    t, v = calibration_drive(0.0, V_MAX, duration=SECONDS, rate=RATE, seed=seed)
    _, y = fresh(seed).run(t, v)
    digit = np.ptp(y) / (50.0 * 20.0 ** np.random.default_rng(seed).random())
    return Draw(t, v, digit * np.round(y / digit))


def clipped(seed: int, number: int) -> Draw:
    """Return a record of a sensor that saturates within the stroke, at the top, at the bottom or at both."""
    t, v = calibration_drive(0.0, V_MAX, duration=SECONDS, rate=RATE, seed=seed)
    _, y = fresh(seed).run(t, v)
    margins = np.random.default_rng(seed).uniform(0.02, 0.1, 2) * [number % 3 != 0, number % 3 != 1]
    return Draw(t, v, np.clip(y, y.min() + margins[0] * np.ptp(y), y.max() - margins[1] * np.ptp(y)))


def delayed(seed: int, number: int) -> Draw:
    """Return a record of equal triangles with readings that are delayed by 20 to 200 ms."""
    t, delay = np.arange(0.0, SECONDS, 1.0 / RATE), 0.02 * 10.0 ** np.random.default_rng(seed).random()
    v = triangles(t * RATE, 150)
    _, y = fresh(seed).run(t, np.interp(t - delay, t, v))
    return Draw(t, v, y, frozenset({"delay", "lag", "rate_dependence", "creep"}), delay)


def mixed(seed: int, number: int) -> Draw:
    """Return a record in which readings are mixed with the previous or next one; every second draw has a gain drift."""
    random, share = np.random.default_rng(seed), (0.0, *SHARES)[number // 2 % 4]
    k = np.arange(SECONDS * RATE)
    v = triangles(k, MOVES[number % len(MOVES)])
    _, y = fresh(seed).run(k / RATE, v)
    drift = GainDrift((0.1 * SECONDS, 0.4 * SECONDS, SECONDS), (0.5 * DRIFT, 0.8 * DRIFT, DRIFT), float(np.median(y)))
    if number % 2:
        y = drift.apply(y, EffectContext(k / RATE))
    beside = np.roll(y, random.choice([-1, 1]))
    how_much = np.where(random.random(k.size) < share, random.random(k.size), 0.0)
    return Draw(k / RATE, v, y + how_much * (beside - y), frozenset({"gain_drift"} if number % 2 else ()), 0.0, share)


def triangles(k: FloatArray, move: int) -> FloatArray:
    """Return a triangular voltage, shape (N,), at the sample numbers `k`; each ramp takes `move` samples."""
    return V_MAX * (1.0 - np.abs((k / move) % 2.0 - 1.0))


DRAWS: dict[str, tuple[Callable[[int, int], Draw], int]] = {
    "coarse": (coarse, 8),
    "clipped": (clipped, 6),
    "delayed": (delayed, 6),
    "mixed": (mixed, 12),
}


@dataclass(frozen=True)
class Outcome:
    """Result of a diagnosis, and the errors of the plain and the extended model, in % of the stroke."""

    verdict: str
    causes: tuple[str, ...]
    invented: bool
    changed: bool
    plain: float
    extended: float
    said: str

    @property
    def worse(self) -> bool:
        """Whether the extended model is worse than the plain one."""
        return self.extended > 1.001 * self.plain


def outcome(kind: str, number: int) -> Outcome:
    """Diagnose a draw, and simulate a path that was not recorded."""
    draw = DRAWS[kind][0](number, number)
    record = record_of(draw.t, draw.v, draw.y)
    model = slpi_ros.identify(record)
    diagnosis = slpi_ros.diagnose(record, model)
    found = diagnosis.axes["x"]
    t, path = scan_path(0.05 * V_MAX, 0.95 * V_MAX, duration=UNSEEN, rate=RATE, seed=1000 + number)
    v = np.concatenate([[draw.v[0]], path])
    t = np.concatenate([[0.0], t + 1.0 / RATE])
    true, _ = fresh(number).run(t, np.interp(t - draw.delay, t, v))
    errors = []
    for one in (model.axes["x"], diagnosis.extended.axes["x"]):
        errors.append(100.0 * float(np.std((one.stage_only.simulate(t, v) - true)[1:]) / np.ptp(true)))
    causes = tuple(named.name for named in found.effects)
    end = [100.0 * named.effect.gains[-1] for named in found.effects if isinstance(named.effect, GainDrift)]
    said = found.summary.split(" % of the readings")[0].split()[-1] if " % of the readings" in found.summary else "0"
    share = (
        f"mixed {said} % (true {100 * draw.share:.0f}), gain {end[0] if end else 0.0:+.2g} %" if kind == "mixed" else ""
    )
    invented = bool(set(causes) - draw.allowed)
    return Outcome(found.verdict, causes, invented, bool(found.given and found.given.changed), *errors, share)


def main() -> None:
    """Print every draw, then the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", choices=DRAWS, help="this kind alone")
    parser.add_argument("--first", type=int, default=0, help="number of the first draw")
    parser.add_argument("--draws", type=int, help="number of draws of each kind")
    options = parser.parse_args()
    table = {}
    for kind in [options.only] if options.only else list(DRAWS):
        outcomes = []
        for number in range(options.first, options.first + (options.draws or DRAWS[kind][1])):
            with threadpool_limits(1):
                one = outcome(kind, number)
            outcomes.append(one)
            print(
                f"{kind:8} {number:2}  {one.verdict:13} {', '.join(one.causes) or '-':28} plain {one.plain:.4f} "
                f"extended {one.extended:.4f} %{'  WORSE' if one.worse else ''}{'  INVENTED' if one.invented else ''}"
                f"{'  CHANGED' if one.changed else ''}  {one.said}",
                flush=True,
            )
        table[kind] = outcomes
    print(f"\n{'':8}{'draws':>7}{'invented':>10}{'changed':>9}{'worse':>7}{'plain':>9}{'extended':>10}")
    for kind, outcomes in table.items():
        counts = [sum(getattr(one, name) for one in outcomes) for name in ("invented", "changed", "worse")]
        means = [float(np.mean([getattr(one, name) for one in outcomes])) for name in ("plain", "extended")]
        print(f"{kind:8}{len(outcomes):7}{counts[0]:10}{counts[1]:9}{counts[2]:7}{means[0]:9.4f}{means[1]:10.4f}")


if __name__ == "__main__":
    main()
