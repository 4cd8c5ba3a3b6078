"""Diagnosis from two simulated records of a stage, tested on a third record.

advised: the diagnosis of a record with one drive frequency is `ambiguous`; the excitation that it recommends is
recorded on the same stage, and both records are diagnosed together. pairs: two effects, two records with one drive
frequency each; the gain that the diagnosis states for effects common to all records is compared with the reduction of
the free-run error on a third record at another frequency.
Every record has its own initial state, zero offset, hum phase and drift.
"""

import os

# To be set before NumPy is imported: the processes share the cores.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import contextlib
import io
import re
import shlex
import tempfile
import time
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from hidden import CONFUSABLE, NAMES, OWN, SIZES, Hidden, again, hide
from hidden.drives import log_uniform, one_frequency
from hidden.size import beyond_hysteresis
from numpy.typing import NDArray
from records import free_run

import slpi_ros
from slpi_ros.cli import main as slpi
from slpi_ros.diagnosis.result import Diagnosis
from slpi_ros.excitation.legs import DriveSpec
from slpi_ros.io.record import Record
from slpi_ros.io.tables import read_table

FloatArray = NDArray[np.float64]

# Effects that a record with one frequency cannot distinguish.
DYNAMIC = ("lag", "creep", "delay", "rate_dependence")
# One low frequency does not excite the resonance, and effects specific to one record have no gain on another record.
PAIRS = [
    pair
    for pair in combinations([name for name in NAMES if name != "resonance"], 2)
    if set(pair) not in CONFUSABLE and not set(pair) <= set(OWN)
]
FREQUENCIES, FASTER = (0.5, 3.0), (2.5, 6.0)
# Maximum number of draws per seed to find a first record that is ambiguous, or two records that show both effects.
TRIES = 8
# Tolerance between stated and measured gain, percentage points.
CLOSE = 10.0


@dataclass(frozen=True)
class Case:
    """Settings of a case: `kind` is `advised` or `pair`; duration `seconds` and sample `rate` (Hz) of every record."""

    kind: str
    seed: int
    seconds: float
    rate: float


@dataclass(frozen=True)
class Outcome:
    """Result of a case; `failure` is an error message, or the reason why the case cannot be evaluated.

    `first` contains the effects diagnosed from the first record alone, `told` and `measured` are the stated and the
    measured gain in %, `kept` are the effects in the extended model. `changed` is True if the diagnosis reports that
    the stage has changed, which is always wrong.
    """

    case: Case
    truth: tuple[str, ...] = ()
    verdict: str = ""
    named: tuple[str, ...] = ()
    alternatives: tuple[str, ...] = ()
    first: str = ""
    advice: str = ""
    told: float = np.nan
    measured: float = np.nan
    kept: tuple[str, ...] = ()
    dropped: tuple[str, ...] = ()
    changed: bool = False
    samples: int = 0
    seconds: float = 0.0
    failure: str = ""

    @property
    def drawn(self) -> bool:
        return not self.failure.startswith("not drawn")

    @property
    def right(self) -> bool:
        """Whether all hidden effects are named."""
        return bool(self.named) and set(self.truth) <= set(self.named)

    @property
    def invented(self) -> tuple[str, ...]:
        return tuple(name for name in self.named if name not in self.truth)

    @property
    def close(self) -> bool:
        return abs(self.told - self.measured) <= CLOSE

    def line(self) -> str:
        """Return the result as one line of text."""
        start = f"{self.case.kind:<8}{self.case.seed:4d}  {'+'.join(self.truth):<32}"
        if self.failure:
            return f"{start} {self.failure}"
        told = f"{self.verdict}: {', '.join(self.named) or 'none'}"
        told += f" (or {', '.join(self.alternatives)})" if self.alternatives else ""
        told += f", dropped {', '.join(self.dropped)}" if self.dropped else ""
        if self.case.kind == "advised":
            told = f"first {self.first}; advised {self.advice}; together {told}"
        else:
            told += f"; in the model: {', '.join(self.kept) or 'none'}"
            if np.isfinite(self.told):
                told += f"; gain told {self.told:.0f} %, on a third record {self.measured:.0f} %"
                told += "" if self.close else "  FAR"
        wrong = "" if self.right else "  MISSED"
        wrong += f"  INVENTED {', '.join(self.invented)}" if self.invented else ""
        wrong += "  CHANGED" if self.changed else ""
        return f"{start} {self.samples:6d} {self.seconds:5.0f} s  {told}{wrong}"


def run(case: Case) -> Outcome:
    """Run one case; errors become part of the result."""
    warnings.simplefilter("ignore")
    try:
        return advised(case) if case.kind == "advised" else pair(case)
    except slpi_ros.SlpiError as error:
        return Outcome(case, failure=f"refused: {error}")
    # One failing case must not end a run of several hours; it is printed and counts as not found.
    except Exception as error:
        return Outcome(case, failure=f"{type(error).__name__}: {error}")


def advised(case: Case) -> Outcome:
    """Diagnose an ambiguous record, simulate the record that the diagnosis recommends, and diagnose both."""
    name = DYNAMIC[case.seed % len(DYNAMIC)]
    for attempt in range(TRIES):
        hidden = hide(1000 * case.seed + attempt, [name], axes=1, samples=round(case.seconds * case.rate) + 1)
        rng = np.random.default_rng([case.seed, attempt])
        draw = again(hidden, 1, _voltages(hidden, case, log_uniform(rng, *FREQUENCIES), rng), case.rate)
        if not visible([draw]):
            continue
        first = draw.record
        model = slpi_ros.identify(first)
        alone = slpi_ros.diagnose(first, model).axes["x"]
        if alone.verdict == "ambiguous":
            break
    else:
        return Outcome(case, (name,), failure=f"not drawn: none of {TRIES} first records is ambiguous")
    told = ", ".join("/".join((each.name, *each.alternatives)) for each in alone.effects)
    options = ("--rate", f"{case.rate:g}", "--duration", f"{case.seconds:g}", "--seed", str(case.seed))
    advice, _, voltage = advised_drive(alone.next_experiment or "", *options)
    if not voltage:
        return Outcome(case, (name,), first=told, failure=f"no drive is advised, first {told}: {alone.next_experiment}")
    records = [first, again(hidden, 2, {"x": voltage["x"]}, case.rate).record]
    return _diagnosed(Outcome(case, (name,), first=told, advice=advice), records, model)[0]


def advised_drive(next_experiment: str, *options: str) -> tuple[str, FloatArray, dict[str, FloatArray]]:
    """Run the recommended command, with further options; return the effect that it is intended for, and its drive.

    The drive is its times (s) and voltages (V) by axis, shape (N,) each; there are none where nothing is recommended.
    """
    command = re.search(r"`slpi (excite -o .*?)`", next_experiment)
    if not command:
        return "", np.empty(0), {}
    words = shlex.split(command[1])
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
        table = Path(folder) / "drive.csv"
        if slpi([*words, "-o", str(table), *options]):
            return "", np.empty(0), {}
        t, voltage = read_table(table, "V")
    return words[words.index("--for") + 1] if "--for" in words else "calibration", t, voltage


def pair(case: Case) -> Outcome:
    """Diagnose two records with one frequency each, and test the stated gain on a third record."""
    for attempt in range(TRIES):
        rng = np.random.default_rng([case.seed, attempt, 2])
        names = PAIRS[int(rng.integers(len(PAIRS)))]
        try:
            hidden = hide(1000 * case.seed + attempt, names, samples=round(case.seconds * case.rate) + 1)
        except RuntimeError:
            continue
        slow = log_uniform(rng, *FREQUENCIES)
        fast = slow * log_uniform(rng, *FASTER)
        # The third frequency may be somewhat above the fast one.
        third = log_uniform(rng, slow, 1.5 * fast)
        draws = [
            again(hidden, number, _voltages(hidden, case, frequency, rng), case.rate, from_rest=number == 3)
            for number, frequency in enumerate((slow, fast, third), 1)
        ]
        if visible(draws[:2]):
            break
    else:
        return Outcome(case, failure=f"not drawn: {TRIES} pairs of records, none shows both effects")
    records = [draw.record for draw in draws[:2]]
    plain = slpi_ros.identify(records)
    axis = hidden.truth[0].axis
    outcome, diagnosis = _diagnosed(Outcome(case, names), records, plain, axis)
    effects = diagnosis.axes[axis].effects
    shared = [each for each in effects if each.name in outcome.kept]
    # With a gain drift, a hysteresis without effects has the mean gain of its records, not that of a third record. The
    # simulation of a single axis does not contain cross-coupling.
    if not shared or {"gain_drift", "cross_coupling"} & set(names):
        return outcome
    told = 100.0 * (1.0 - np.prod([1.0 - each.gain_percent / 100.0 for each in shared]))
    # The gain refers to an error without the record-specific effects that were named before.
    earlier = {each.name for each in effects[: effects.index(shared[0])]}
    judge = third_record(draws[2], axis, earlier)
    before, after = (free_run(model.axes[axis], judge, axis) for model in (plain, diagnosis.extended))
    return replace(outcome, told=told, measured=100.0 * (1.0 - after / before))


def visible(draws: Sequence[Hidden]) -> bool:
    """Return whether the records show each effect, which means that a common hysteresis cannot explain it."""
    axis = draws[0].truth[0].axis
    v = np.concatenate([draw.record.voltage[axis] for draw in draws])
    for effects in zip(*(draw.truth for draw in draws), strict=True):
        signal = np.concatenate([each.contribution - each.contribution.mean() for each in effects])
        # A clipped voltage is visible by its kink, which the relays of this test can explain.
        if effects[0].name != "saturation" and beyond_hysteresis(v, signal) < SIZES[0] * draws[0].floor[axis]:
            return False
    return True


def third_record(draw: Hidden, axis: str, without: set[str]) -> Record:
    """Return a record without the given effects on one axis, with NaN until the axis has traversed its whole range."""
    v = draw.record.voltage[axis]
    gone = np.sum([each.contribution for each in draw.truth if each.name in without] or np.zeros((1, v.size)), axis=0)
    y = draw.record.displacement[axis] - gone
    top = int(np.argmax(v))
    y[: top + int(np.argmin(v[top:]))] = np.nan
    return replace(draw.record, voltage={**draw.record.voltage}, displacement={**draw.record.displacement, axis: y})


def _voltages(hidden: Hidden, case: Case, frequency: float, rng: np.random.Generator) -> dict[str, FloatArray]:
    return {
        axis: one_frequency(DriveSpec(0.0, float(v.max()), case.seconds, case.rate), frequency, rng)
        for axis, v in hidden.record.voltage.items()
    }


def _diagnosed(
    outcome: Outcome, records: list[Record], model: slpi_ros.StageModel, axis: str = "x"
) -> tuple[Outcome, Diagnosis]:
    began = time.perf_counter()
    diagnosis = slpi_ros.diagnose(records, model, axes=[axis])
    found = diagnosis.axes[axis]
    outcome = replace(
        outcome,
        verdict=found.verdict,
        named=tuple(each.name for each in found.effects),
        alternatives=tuple(sorted({other for each in found.effects for other in each.alternatives})),
        kept=tuple(effect.name for effect in diagnosis.extended.axes[axis].effects),
        dropped=found.dropped,
        changed=bool(found.given and found.given.changed),
        samples=sum(len(record) for record in records),
        seconds=time.perf_counter() - began,
    )
    return outcome, diagnosis


def cases(options: argparse.Namespace) -> Iterator[Case]:
    """Yield the cases that the options select."""
    for kind in [options.only] if options.only else ("advised", "pair"):
        for seed in range(options.seed, options.seed + options.draws):
            yield Case(kind, seed, options.seconds, options.rate)


def table(outcomes: Sequence[Outcome]) -> None:
    """Print how often each effect is named, and the total counts."""
    for kind, wanted in (("advised", "28 of 30"), ("pair", "27 of 30")):
        drawn = [each for each in outcomes if each.case.kind == kind and each.drawn]
        if not drawn:
            continue
        print(f"\n{kind:<24}{'drawn':>6}{'named':>7}{'all right':>11}")
        for name in NAMES:
            rows = [each for each in drawn if name in each.truth]
            if rows:
                named, right = sum(name in each.named for each in rows), sum(each.right for each in rows)
                print(f"  {name:<22}{len(rows):6d}{named:7d}{right:11d}")
        right = [each for each in drawn if each.right]
        exact = [each for each in right if not each.invented and each.verdict == "named"]
        print(f"all that is hidden is named: {len(right)} of {len(drawn)} (wanted: {wanted})")
        print(f"verdict `named`, and nothing beside: {len(exact)} of {len(drawn)}")
        print(f"something is named that is not there: {sum(bool(each.invented) for each in drawn)} of {len(drawn)}")
        print(f"said to have changed since: {sum(each.changed for each in drawn)} of {len(drawn)}")
        print(f"failed: {sum(bool(each.failure) for each in drawn)} of {len(drawn)}")
        judged = [each for each in drawn if np.isfinite(each.told)]
        if judged:
            close = sum(each.close for each in judged)
            print(f"gain told within {CLOSE:g} points of that on a third record: {close} of {len(judged)} (90 %)")


def main() -> None:
    """Run the cases and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--draws", type=int, default=30, help="of each kind")
    parser.add_argument("--seed", type=int, default=0, help="the first one")
    parser.add_argument("--only", choices=("advised", "pair"))
    parser.add_argument("--seconds", type=float, default=20.0, help="of each record")
    parser.add_argument("--rate", type=float, default=1000.0, help="samples per second")
    parser.add_argument("--processes", type=int, default=2)
    options = parser.parse_args()
    outcomes = []
    with get_context("spawn").Pool(options.processes) as pool:
        for outcome in pool.imap(run, cases(options)):
            print(outcome.line(), flush=True)
            outcomes.append(outcome)
    table(outcomes)


if __name__ == "__main__":
    main()
