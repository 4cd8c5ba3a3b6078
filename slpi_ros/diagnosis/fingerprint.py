"""Measured variables that predict what a model leaves of the displacement, on held-out data.

The residual is fitted by a smooth function of each variable alone, on four fifths of the blocks of a record, and judged
on the others. The share of its mean square that such a function predicts tells where to look for an unknown cause.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import scipy.linalg

from slpi_ros.arrays import FloatArray, IntArray
from slpi_ros.arrays.rates import slopes
from slpi_ros.diagnosis.prepare import frequency_of_moves
from slpi_ros.effects.base import usual_step, wave
from slpi_ros.effects.jumps import jumps
from slpi_ros.errors import length
from slpi_ros.hysteresis.reversals import reversals
from slpi_ros.identification.drive import smallest_turn
from slpi_ros.identification.signal_statistics import noise

# Number of blocks of a record, of which every fifth is held out in turn.
BLOCKS, FOLDS = 40, 5
# Number of knots of the function of a variable; for time one for each two blocks, so that it spans a held-out block.
KNOTS, KNOTS_OF_TIME = 12, 20
# The same for a recorded quantity: few, as it may drift, and with many any function of time would be one of it.
KNOTS_OF_QUANTITY = 4
# Weight of the roughness of a function, relative to the largest eigenvalue of its equations.
ROUGHNESS = 1e-5
# Smallest share of the mean square that is told.
LEAST_SHARE = 0.05
# Largest number of spectral lines and of jumps; power of a line relative to the median of its surroundings.
MOST_LINES, MOST_JUMPS, LINE = 6, 8, 30.0
# Lines of this share of the largest amplitude are told; fewest periods of one in its record; frequency (Hz) below which
# lines are slow.
TALL, PERIODS, SLOW = 0.1, 10.0, 1.0
# Largest number of samples of a record, evenly thinned, for functions of a variable.
ENOUGH = 40_000

# In a record with fewer turns, a function of time stands for parts of the drive as well.
FEWEST_TURNS = KNOTS_OF_TIME

# What each variable suggests to look at.
HINTS: Mapping[str, str] = {
    "time": "look for temperature, a mount that relaxes, or a drift of the sensor",
    "voltage": "look for a nonlinearity of amplifier or sensor, or record more loops of every size",
    "displacement": "look for a nonlinearity of the sensor, or a contact of the stage",
    "rate": "look for dynamics of stage, amplifier or sensor: record several drive frequencies",
    "acceleration": "look for a flexure mode or the mass of the load: record faster turns",
    "direction": "look for friction or backlash: record the same loop at several rates",
    "time since the last turn": "look for creep or ringing after turns: record holds after steps",
    "position in the loop": "look for a hysteresis that depends on the loop: record loops of every size",
    "lines of the spectrum": "look for mains, pumps, fans and their frequencies",
    "jumps": "look for a slip of the mount, a fringe jump of the sensor, or somebody at the table",
}


def hint(variable: str) -> str:
    """Return what a variable suggests to look at; one that is not in `HINTS` is a recorded quantity."""
    return HINTS.get(variable, "change that alone, on purpose, up and down, and record it")


class Signals(NamedTuple):
    """Used samples of one record, shape (N,) each: time (s), voltage (V), displacement and residual of a model (m).

    `surroundings` are recorded quantities by name, in their units.
    """

    t: FloatArray
    v: FloatArray
    y: FloatArray
    residual: FloatArray
    surroundings: Mapping[str, FloatArray] = {}


@dataclass(frozen=True)
class Left:
    """Measured variable that predicts a share (0..1) of the mean square of a residual on held-out data.

    `curve` is the predicted residual (m) over the variable, in its `unit`, for a chart; empty for lines and jumps.
    """

    variable: str
    share: float
    evidence: str
    curve: tuple[FloatArray, FloatArray] = field(default=(np.empty(0), np.empty(0)), compare=False)
    unit: str = ""

    def to_document(self) -> dict[str, str | float]:
        """Return the part of the diagnosis document."""
        return {"variable": self.variable, "share": self.share, "evidence": self.evidence}


def fingerprint(records: Sequence[Signals]) -> tuple[Left, ...]:
    """Return the measured variables that predict the residuals of records of one axis, the largest share first."""
    centred, thin = [_centred(record) for record in records], [_centred(_thinned(record)) for record in records]
    found = [*_of_variables(thin), *_of_surroundings(thin), *_of_lines(centred), *_of_jumps(centred)]
    return tuple(sorted((one for one in found if one.share >= LEAST_SHARE), key=lambda one: -one.share))


def lines_of(record: Signals, least: float) -> Left | None:
    """Return the lines of the spectrum of a residual; None if they hold no more than the share `least` of it."""
    return next((found for found in _of_lines([_centred(record)]) if found.share > least), None)


def half_power(records: Sequence[Signals]) -> float:
    """Return the frequency (Hz) below which half of the mean square of the residuals lies; 0 without any."""
    frequencies, powers = [], []
    for record in records:
        step = usual_step(record.t) if record.t.size > 1 else 0.0
        if step > 0.0:
            grid = np.arange(record.t[0], record.t[-1], step)
            powers.append(np.abs(np.fft.rfft(np.interp(grid, record.t, _centred(record).residual))) ** 2 / grid.size)
            frequencies.append(np.fft.rfftfreq(grid.size, step))
    if not powers or not sum(power.sum() for power in powers) > 0.0:
        return 0.0
    frequency, power = np.concatenate(frequencies), np.concatenate(powers)
    order = np.argsort(frequency)
    total = np.cumsum(power[order])
    return float(frequency[order][np.searchsorted(total, 0.5 * total[-1])])


def _thinned(record: Signals) -> Signals:
    every = -(-record.t.size // ENOUGH)
    beside = {key: value[::every] for key, value in record.surroundings.items()}
    t, v, y, residual, _ = record
    return Signals(t[::every], v[::every], y[::every], residual[::every], beside)


def _centred(record: Signals) -> Signals:
    return record._replace(residual=record.residual - record.residual.mean())


def _of_variables(records: Sequence[Signals]) -> Iterator[Left]:
    values = [_variables(record) for record in records]
    up = np.concatenate([np.sign(one["rate"]) for one in values])
    for name, unit, branches in (
        ("time", "s", False), ("voltage", "V", False), ("displacement", "m", False), ("rate", "V/s", False),
        ("acceleration", "V/s²", False), ("direction", "V", True), ("time since the last turn", "s", True),
        ("position in the loop", "", True),
    ):  # fmt: skip
        own = [one["voltage" if name == "direction" else name] for one in values]
        x = np.concatenate(own)
        if name == "time":
            # Drift belongs to its record.
            columns = scipy.linalg.block_diag(*(_hats(one, KNOTS_OF_TIME, even=True) for one in own))
        else:
            columns = _hats(x, KNOTS, even=name == "voltage")
        if branches:
            columns = np.hstack([columns * (up > 0.0)[:, None], columns * (up < 0.0)[:, None]])
        if name == "direction":
            # Only what rising and falling voltage differ by: the rest goes with the voltage.
            columns = columns[:, :KNOTS] - columns[:, KNOTS:]
        advice = HINTS[name]
        if name == "time" and (turns := min(_turns(record).size for record in records)) < FEWEST_TURNS:
            advice = f"a record with {turns} turns cannot tell time from its drive: record more cycles, or {advice}"
        yield _of_variable(name, unit, x, columns, records, advice, up if branches else None)


def _of_surroundings(records: Sequence[Signals]) -> Iterator[Left]:
    for key in records[0].surroundings if records else ():
        if all(key in record.surroundings for record in records):
            x = np.concatenate([record.surroundings[key] for record in records])
            if np.ptp(x) > 0.0:
                yield _of_variable(key, "", x, _hats(x, KNOTS_OF_QUANTITY, even=False), records, hint(key))


def _variables(record: Signals) -> dict[str, FloatArray]:
    """Return the variables of a record, shape (N,) each, in SI units; the position in the loop is 0..1."""
    t, v = record.t, record.v
    ends = _turns(record)
    last = ends[np.maximum(np.searchsorted(ends, np.arange(v.size), side="right") - 1, 0)]
    way = np.abs(np.diff(v[ends], append=v[-1]))[np.searchsorted(ends, last)]
    rate = slopes(t, v)
    return {
        "time": t,
        "voltage": v,
        # That of the model: where the stage rests, the measured one is the residual itself.
        "displacement": record.y - record.residual,
        "rate": rate,
        "acceleration": slopes(t, rate),
        "time since the last turn": np.maximum(t - t[last], 0.0),
        "position in the loop": np.divide(np.abs(v - v[last]), way, out=np.zeros_like(v), where=way > 0.0).clip(
            0.0, 1.0
        ),
    }


def _turns(record: Signals) -> IntArray:
    """Return the indices of the reversals of the voltage of a record, its first sample included."""
    t, v = record.t, record.v
    return reversals(v, max(smallest_turn(v, noise(v, t)), 1e-9 * float(np.ptp(v)))) if v.size > 4 else np.array([0])


def _hats(x: FloatArray, knots: int, *, even: bool) -> FloatArray:
    """Return the piecewise linear functions of `x`, shape (N, knots), at even knots or at quantiles."""
    places = np.unique(np.linspace(x.min(), x.max(), knots) if even else np.quantile(x, np.linspace(0.0, 1.0, knots)))
    # Of equal quantiles one is a knot; the columns of the others are zero.
    return np.column_stack([np.interp(x, places, row) for row in np.eye(knots, places.size)])


def _share(matrix: FloatArray, records: Sequence[Signals]) -> tuple[float, FloatArray]:
    """Return the share of the mean square that columns predict on held-out blocks, and the fit to all samples (m)."""
    y = np.concatenate([record.residual for record in records])
    fold = np.concatenate([np.arange(one.t.size) * BLOCKS // max(one.t.size, 1) % FOLDS for one in records])
    grams = [matrix[fold == k].T @ matrix[fold == k] for k in range(FOLDS)]
    products = [matrix[fold == k].T @ y[fold == k] for k in range(FOLDS)]
    whole, right = sum(grams), sum(products)
    ridge = ROUGHNESS * max(float(np.linalg.norm(whole, 2)), 1e-300) * np.eye(matrix.shape[1])

    def fitted(gram: FloatArray, product: FloatArray) -> FloatArray:
        return np.asarray(scipy.linalg.solve(gram + ridge, product, assume_a="pos"))

    missed = np.zeros_like(y)
    for k in range(FOLDS):
        out = fold == k
        missed[out] = y[out] - matrix[out] @ fitted(whole - grams[k], right - products[k])
    total = float(np.sum(y**2))
    share = 1.0 - float(np.sum(missed**2)) / total if total > 0.0 else 0.0
    return float(np.clip(share, 0.0, 1.0)), matrix @ fitted(whole, right)


def _of_variable(
    name: str,
    unit: str,
    x: FloatArray,
    columns: FloatArray,
    records: Sequence[Signals],
    advice: str,
    rate: FloatArray | None = None,
) -> Left:
    """Return what columns predict that are functions of the variable `x`; `rate`: where rising and falling differ."""
    share, fitted = _share(columns, records)

    def at(k: int) -> str:
        branch = "" if rate is None else " while rising" if rate[k] > 0.0 else " while falling"
        where = length(x[k]) if unit == "m" else f"{x[k]:.3g} {unit}".rstrip()
        return f"{length(fitted[k])} at {where}{branch}"

    extremes = f"from {at(int(np.argmin(fitted)))} to {at(int(np.argmax(fitted)))}"
    evidence = f"{share:.0%} of the mean square depends on the {name}: {extremes}; {advice}"
    order = np.argsort(x)[:: max(1, x.size // 400)]
    return Left(name, share, evidence, (x[order], fitted[order]), unit)


def _of_lines(records: Sequence[Signals]) -> Iterator[Left]:
    found = [_lines(record) for record in records]
    if not any(found):
        return
    columns = [
        np.column_stack([np.empty((record.t.size, 0)), *(wave(2.0 * np.pi * f * record.t) for f in lines)])
        for record, lines in zip(records, found, strict=True)
    ]
    share, _ = _share(scipy.linalg.block_diag(*columns), records)
    told = dict[str, str]()
    for lines, own, record in zip(found, columns, records, strict=True):
        if not lines:
            continue
        gains = np.linalg.lstsq(own, record.residual, rcond=None)[0].reshape(-1, 2)
        heights = np.hypot(*gains.T).tolist()
        # Beside a strong line are weak ones that its amplitude, not quite constant, makes.
        tall = [each for each in zip(lines, heights, strict=True) if each[1] >= TALL * max(heights)]
        for frequency, height in tall:
            told.setdefault(f"{frequency:.3g}", f"{frequency:.4g} Hz ({length(height)})")
    name = "lines of the spectrum"
    # No mains and no pump is so slow.
    slow = max(frequency for lines in found for frequency in lines) < SLOW
    advice = (
        "look for what comes and goes so slowly, such as an air conditioning, and record it" if slow else HINTS[name]
    )
    listed = ", ".join([*told.values()][:MOST_LINES])
    yield Left(name, share, f"{share:.0%} of the mean square is in lines at {listed}; {advice}")


def _lines(record: Signals) -> list[float]:
    """Return the frequencies (Hz) of lines that stand out of the spectrum of a residual and are none of the drive."""
    t, step = record.t, float(np.median(np.diff(record.t))) if record.t.size > 1 else 0.0
    if t.size < 8 * KNOTS or not step > 0.0:
        return []
    grid = np.arange(t[0], t[-1], step)
    window = np.hanning(grid.size)
    power, drive = (
        np.abs(np.fft.rfft((np.interp(grid, t, x) - np.mean(x)) * window, 4 * grid.size)) ** 2
        for x in (record.residual, record.v)
    )
    frequency = np.fft.rfftfreq(4 * grid.size, step)
    base, period = frequency_of_moves(t, record.v), float(t[-1] - t[0])
    if base:
        base = _refined(t, record.v - np.mean(record.v), base, 1.0 / period)
    # Bins of four times the length: a line with this window is 16 bins wide.
    wide = 16
    rest = power.copy()
    found: list[float] = []
    for _ in range(4 * MOST_LINES):
        k = int(np.argmax(rest[wide:])) + wide
        around = power[max(k - 20 * wide, wide) : k + 20 * wide]
        if rest[k] < LINE * np.median(around) or len(found) == MOST_LINES:
            break
        near = slice(max(k - wide, 0), k + wide)
        # A harmonic of the drive is no line of its own: what goes with it repeats with the motion.
        driven = drive[k] > 1e-6 * drive[wide:].max() and drive[k] >= 0.5 * drive[near].max()
        # Of one frequency of the drive also those that a bent characteristic makes of it.
        off = frequency[k] - base * np.round(frequency[k] / base) if base else np.inf
        # Of a few periods nobody can say that they are one line: that is a drift.
        if not driven and abs(off) * period >= 2.0 and frequency[k] * period >= PERIODS:
            found.append(_refined(t, record.residual, float(frequency[k]), 1.0 / (4 * grid.size * step)))
        rest[near] = 0.0
    return found


def _refined(t: FloatArray, x: FloatArray, frequency: float, bin_width: float) -> float:
    """Return the frequency (Hz) near `frequency` whose wave takes most of `x`."""

    def power(f: float) -> float:
        return float(np.abs(np.exp(-2j * np.pi * f * t) @ x))

    for _ in range(3):
        tried = frequency + bin_width * np.linspace(-1.0, 1.0, 9)
        frequency = float(max(tried, key=power))
        bin_width /= 4.0
    return frequency


def _of_jumps(records: Sequence[Signals]) -> Iterator[Left]:
    found = [jumps(record.residual, MOST_JUMPS) for record in records]
    if not any(found):
        return
    columns = [
        np.column_stack([np.ones(record.t.size), *(np.arange(record.t.size) >= k for k, _ in jumps)])
        for record, jumps in zip(records, found, strict=True)
    ]
    share, _ = _share(scipy.linalg.block_diag(*columns), records)
    largest = sorted(
        ((float(record.t[k]), size) for record, jumps in zip(records, found, strict=True) for k, size in jumps),
        key=lambda jump: -abs(jump[1]),
    )
    told = ", ".join(f"{length(size)} at {at:.4g} s" for at, size in largest[:MOST_JUMPS])
    yield Left("jumps", share, f"{share:.0%} of the mean square is in jumps: {told}; {HINTS['jumps']}")
