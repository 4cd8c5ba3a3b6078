"""Confusion of effects, pairs, clean stages and causes that no effect describes: what is named wrongly, or silently.

Every record is drawn from a seed, identified and diagnosed, and only then compared with the truth. A name is wrong if
the cause is not there and no alternative is it; a diagnosis is silent if it claims to be complete although more than
1.5 times the sensor noise is left, or says nothing of a cause of at least three times the noise. An ambiguous
diagnosis with the truth among its alternatives is right where the record that it asks for decides: that is simulated on
the same stage, and both are diagnosed together. Models are judged on one more record, without its constant.
``--beside CLONE``, a built clone of another commit: the same records are diagnosed by it, too.
"""

# To be set before NumPy is imported: the processes share the cores.
import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import contextlib
import io
import json
import re
import shlex
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import combinations, count
from multiprocessing import get_context
from pathlib import Path

import kept
import numpy as np
from hidden import CONFUSABLE, NAMES, again, hide
from hidden.unknown import KINDS, NEAR, hide_unknown
from identification_speed import run as run_clone
from numpy.typing import NDArray
from scipy.stats import beta

import slpi_ros
from slpi_ros.cli import main as slpi
from slpi_ros.excitation.drives import calibration_drive
from slpi_ros.io.bag_writer import write_bag
from slpi_ros.io.record import Record
from slpi_ros.io.tables import read_table
from slpi_ros.simulation.axis import SimulatedAxis
from slpi_ros.simulation.character import Character
from slpi_ros.simulation.parameters import AxisParameters

FloatArray = NDArray[np.float64]
GROUPS = ("single", "pair", "simulator", "clean", "unknown")
SAMPLES = 40_000
# What the groups are, in the tables of figures.
MEANT = {
    "single": "simulated stages with one hidden effect: that one named or among the alternatives, and no other",
    "pair": "simulated stages with two hidden effects: both named or among the alternatives, and no other",
    "simulator": "stages of the package's own simulator with creep and a lag: both named or among the alternatives, "
    "and no other",
    "clean": "simulated stages without a hidden effect: an effect named",
    "unknown": f"simulated stages with one of {len(KINDS)} causes that no effect describes: a wrong name, or no "
    "report of the remaining error",
}
# Group "simulator": the simulated stage of the package and its default calibration drive (s, Hz), sensor noise (m), lag
# (s), and smallest and largest creep per decade of time (share of the displacement).
DURATION, RATE, NOISE, LAG, CREEP = 60.0, 500.0, 8e-9, 3e-3, (0.005, 0.03)
# Runs in another clone: the diagnosis of one axis of a bag, and the errors (m, rms) of both models on another one.
INSIDE = """
import json, sys, time, slpi_ros
axis, record, third = sys.argv[1], *(slpi_ros.read_bag(bag) for bag in sys.argv[2:])
model = slpi_ros.identify(record)
began = time.process_time()
diagnosis = slpi_ros.diagnose(record, model, axes=[axis])
seconds, found = time.process_time() - began, diagnosis.axes[axis]
print(json.dumps({
    "verdict": found.verdict, "named": [[one.name, *one.alternatives] for one in found.effects],
    "left": found.after_rms, "noise": found.noise_rms, "seconds": seconds,
    "third": [slpi_ros.verify(third, each).axes[axis].rest.rms for each in (model, diagnosis.extended)],
}))
"""
# Seconds of the record on which models are judged.
THIRD = 30.0


@dataclass(frozen=True)
class Case:
    """What to hide, names of effects or a kind of `KINDS`; `group` is one of `GROUPS`."""

    group: str
    seed: int
    hidden: tuple[str, ...]


@dataclass(frozen=True)
class Outcome:
    """Diagnosis of the axis of a case."""

    case: Case
    verdict: str
    named: tuple[tuple[str, ...], ...]  # each with its alternatives
    left: float  # what is left, in times of the true sensor noise
    noise: float  # the sensor noise that was found, likewise
    goes_with: str
    seconds: float
    failure: str = ""
    # What both records together say, if the first one is ambiguous: the same as `verdict` and `named`.
    then: str = ""
    then_named: tuple[tuple[str, ...], ...] = ()
    # Errors on another record of the model without causes and of the extended one, in times of the noise.
    third: tuple[float, float] | None = None

    @property
    def decided(self) -> bool:
        """Whether the record that an ambiguous diagnosis asks for decides for what is hidden."""
        return bool(self.then) and self.then != "ambiguous" and {one[0] for one in self.then_named} == self.allowed

    @property
    def allowed(self) -> frozenset[str]:
        """Names that are no mistake."""
        hidden = self.case.hidden
        return NEAR.get(hidden[0], frozenset()) if self.case.group == "unknown" else frozenset(hidden)

    @property
    def wrong(self) -> bool:
        """Whether an effect is named that is not there, nor one of its alternatives."""
        return any(not self.allowed & set(names) for names in self.named)

    @property
    def silent(self) -> bool:
        """Whether it claims that nothing is left although there is something."""
        missed = self.case.group in ("single", "pair", "simulator") and self.verdict == "nothing_found"
        # The white part of what is left is the noise that the sensor has, whatever its cause.
        return missed or (self.verdict in ("named", "nothing_found") and self.left > 1.6 * max(self.noise, 1.0))

    @property
    def right(self) -> bool:
        """Whether all hidden effects are named, or alternatives of what is named, and nothing else."""
        told = set().union(*self.named)
        return not self.wrong and set(self.case.hidden) <= told

    def line(self) -> str:
        """Return one line of text."""
        named = ", ".join(one[0] + (f" (or {'/'.join(one[1:])})" if one[1:] else "") for one in self.named) or "-"
        mark = "".join(text for text, is_so in ((" WRONG", self.wrong), (" SILENT", self.silent)) if is_so)
        told = f"{self.verdict} {named}; left {self.left:.2f} (noise {self.noise:.2f}) {self.goes_with}"
        if self.third:
            told += "; next {:.2f} -> {:.2f}".format(*self.third)
        if self.then:
            told += f"; with the next record {self.then} {', '.join('/'.join(one) for one in self.then_named) or '-'}"
        return (
            f"{self.case.group:<8}{self.case.seed:4d} {'+'.join(self.case.hidden) or 'clean':<32}{self.seconds:5.1f} s "
            f"{self.failure or told}{mark}"
        )


def run(case: Case, beside: Path | None = None) -> list[Outcome]:
    """Hide, identify, diagnose, and compare; the outcome of this commit, and that of the clone `beside`."""
    try:
        stage = _drawn(case)
        return [_outcome(case, stage), *([_outcome_beside(case, stage, beside)] if beside else [])]
    # One failing case must not end a long run; it is printed and counts as wrong.
    except Exception as error:
        failed = Outcome(case, "failed", (), 0.0, 0.0, "", 0.0, f"{type(error).__name__}: {error}"[:150])
        return [failed] * (2 if beside else 1)


def _outcome(case: Case, stage: "Drawn") -> Outcome:
    model = slpi_ros.identify(stage.record)
    began = time.process_time()
    diagnosis = slpi_ros.diagnose(stage.record, model, axes=[stage.axis])
    seconds, found, third = time.process_time() - began, diagnosis.axes[stage.axis], stage.third
    errors = [slpi_ros.verify(third, each).axes[stage.axis].rest.rms for each in (model, diagnosis.extended) if third]
    outcome = Outcome(
        case,
        found.verdict,
        tuple((one.name, *one.alternatives) for one in found.effects),
        found.after_rms / stage.floor,
        found.noise_rms / stage.floor,
        f"{found.left[0].variable} {found.left[0].share:.0%}" if found.left else "",
        seconds,
        third=(errors[0] / stage.floor, errors[1] / stage.floor) if errors else None,
    )
    if found.verdict != "ambiguous" or not outcome.right or case.group == "unknown":
        return outcome
    second = stage.next(found.next_experiment or "")
    if second is None:
        return replace(outcome, then="no record advised")
    both = slpi_ros.diagnose([stage.record, second], model, axes=[stage.axis]).axes[stage.axis]
    return replace(outcome, then=both.verdict, then_named=tuple((one.name, *one.alternatives) for one in both.effects))


def _outcome_beside(case: Case, stage: "Drawn", clone: Path) -> Outcome:
    third = stage.third
    with tempfile.TemporaryDirectory() as folder:
        bags = [Path(folder) / "record", Path(folder) / "third"]
        for bag, record in zip(bags, (stage.record, third or stage.record), strict=True):
            write_bag(bag, record)
        try:
            said = json.loads(run_clone(clone, "-W", "ignore", "-c", INSIDE, stage.axis, *map(str, bags))[1])
        # It has printed why.
        except SystemExit:
            return Outcome(case, "failed", (), 0.0, 0.0, "", 0.0, "failed")
    plain, extended = (error / stage.floor for error in said["third"])
    named = tuple(tuple(names) for names in said["named"])
    left, noise = said["left"] / stage.floor, said["noise"] / stage.floor
    at_third = (plain, extended) if third else None
    return Outcome(case, said["verdict"], named, left, noise, "", said["seconds"], third=at_third)


@dataclass(frozen=True)
class Drawn:
    """Record of a stage, the axis that counts, its sensor noise (m rms), and what makes another record of the stage.

    `another` takes times (s) and voltages (V) by axis, shape (N,) each.
    """

    record: Record
    axis: str
    floor: float
    another: Callable[[FloatArray, Mapping[str, FloatArray]], Record] | None = None

    @cached_property
    def third(self) -> Record | None:
        """A record of the stage on which models are judged, of a drive over the same range."""
        if self.another is None:
            return None
        rate, drives = 1.0 / float(np.median(np.diff(self.record.t))), dict[str, FloatArray]()
        for number, (axis, v) in enumerate(self.record.voltage.items()):
            ends = float(v.min()), float(v.max())
            t, drives[axis] = calibration_drive(*ends, duration=THIRD, rate=rate, seed=number + 3)
        return self.another(t, drives)

    def next(self, next_experiment: str) -> Record | None:
        """Return the record that a diagnosis recommends; None if it recommends none."""
        others = [axis for axis in self.record.axes if axis != self.axis]
        advice = next_experiment.replace("OTHER THIS", " ".join([*others, self.axis]))
        _, t, voltage = advised_drive(advice, "--seed", "1")
        if not voltage or self.another is None:
            return None
        own = voltage.get(self.axis, next(iter(voltage.values())))
        rest = {axis: np.full(t.size, self.record.voltage[axis].min()) for axis in others}
        return self.another(t, {**rest, **{axis: v for axis, v in voltage.items() if axis in others}, self.axis: own})


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


def _drawn(case: Case) -> Drawn:
    if case.group == "unknown":
        one = hide_unknown(case.hidden[0], case.seed, SAMPLES)
        return Drawn(one.record, "x", one.floor)
    if case.group == "simulator":
        stage = _simulated(case.seed)
        t, v = calibration_drive(0.0, 100.0, duration=DURATION, rate=RATE, seed=case.seed)
        numbers = count(1)
        return Drawn(_run(stage, t, v, next(numbers)), "x", NOISE, lambda t, v: _run(stage, t, v["x"], next(numbers)))
    hidden = hide(case.seed, case.hidden, samples=SAMPLES, base="preisach" if case.group == "clean" else None)
    axis = next((truth.axis for truth in hidden.truth), "x")

    def another(t: FloatArray, v: Mapping[str, FloatArray]) -> Record:
        return again(hidden, 2, {name: v[name] for name in hidden.record.axes}, 1.0 / float(t[1] - t[0])).record

    return Drawn(hidden.record, axis, hidden.floor[axis], another)


def _simulated(seed: int) -> SimulatedAxis:
    """Return a simulated stage with creep and lag."""
    character = Character(lag=LAG, creep=float(np.random.default_rng(seed).uniform(*CREEP)))
    return SimulatedAxis(replace(AxisParameters.random(seed), noise_rms=NOISE), seed, character)


def _run(axis: SimulatedAxis, t: FloatArray, v: FloatArray, number: int) -> Record:
    """Return the record of a drive; the stage goes on from where the one before ended."""
    # An hour apart.
    _, measured = axis.run(3600.0 * number + t, v)
    stamps = np.round((3600.0 * number + t) * 1e9).astype(np.int64)
    return slpi_ros.Record(stamps, {"x": v}, {"x": measured}, f"record {number}")


def cases(groups: list[str], draws: int, seed: int, only: str | None) -> list[Case]:
    """Return the cases: each effect and each kind `draws` times, pairs and clean stages several times as often."""
    found = []
    pairs = [pair for pair in combinations(NAMES, 2) if set(pair) not in CONFUSABLE]
    rng = np.random.default_rng(seed)
    for index in range(draws):
        if "single" in groups:
            found += [Case("single", seed + index, (name,)) for name in NAMES]
        if "unknown" in groups:
            found += [Case("unknown", seed + index, (kind,)) for kind in KINDS]
        if "pair" in groups:
            found += [
                Case("pair", seed + index, pairs[k]) for k in rng.choice(len(pairs), len(NAMES), replace=False).tolist()
            ]
        if "simulator" in groups:
            found += [Case("simulator", seed + 4 * index + k, ("creep", "lag")) for k in range(4)]
        if "clean" in groups:
            found += [Case("clean", seed + 10 * index + k, ()) for k in range(10)]
    return [case for case in found if not only or only in case.hidden]


def table(outcomes: list[Outcome]) -> None:
    """Print what was named for each hidden cause, the rates, and what models gain on another record."""
    rows: dict[tuple[str, str], list[Outcome]] = defaultdict(list)
    for one in outcomes:
        rows[one.case.group, "pairs" if one.case.group == "pair" else "+".join(one.case.hidden)].append(one)
    print(f"\n{'hidden':<26}{'n':>4}{'right':>7}{'wrong':>7}{'silent':>7}  verdicts; names; left in times of the noise")
    for (_, name), own in rows.items():
        verdicts = ", ".join(f"{count} {what}" for what, count in Counter(one.verdict for one in own).most_common())
        names = Counter(names[0] for one in own for names in one.named)
        said = ", ".join(f"{what} {count}" for what, count in names.most_common()) or "-"
        print(
            f"{name or 'clean':<26}{len(own):>4}{sum(one.right for one in own):>7}{sum(one.wrong for one in own):>7}"
            f"{sum(one.silent for one in own):>7}  {verdicts}; {said}; {np.median([one.left for one in own]):.2f}"
        )
    for group in GROUPS:
        own = [one for one in outcomes if one.case.group == group]
        if own:
            bad = sum(one.wrong or one.silent or bool(one.failure) for one in own)
            bound = float(beta.ppf(0.95, bad + 1, len(own) - bad)) if bad < len(own) else 1.0
            open_ones = [one for one in own if one.verdict == "ambiguous"]
            decided = sum(one.decided for one in open_ones)
            print(
                f"{group}: {sum(one.right for one in own)} of {len(own)} right, {bad} wrong or silent "
                f"({bad / len(own):.1%}; one-sided 95 % bound {bound:.1%}), {len(open_ones)} ambiguous"
                f"{f', {decided} decided by the record asked for' if group != 'unknown' else ''}"
            )
        judged = [one.third for one in own if one.third and one.named]
        if judged:
            ratios = [extended / plain for plain, extended in judged]
            worse = sum(ratio > 1.05 for ratio in ratios)
            print(
                f"  on another record: {np.median([extended for _, extended in judged]):.2f} times the noise in the "
                f"median, {np.median(ratios):.2f} of the error without causes, most {max(ratios):.2f}; more than 1.05 "
                f"in {worse} of {len(ratios)}"
            )
    times = [one.seconds for one in outcomes]
    print(f"CPU time of a diagnosis: median {np.median(times):.1f} s, longest {max(times):.1f} s")


def main() -> None:
    """Run the cases and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--draws", type=int, default=5, help="records of each effect and kind")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--groups", nargs="+", choices=GROUPS, default=list(GROUPS))
    parser.add_argument("--only", help="cases with this effect or kind")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--beside", type=Path, metavar="CLONE", help="built clone of another commit")
    parser.add_argument("--keep", action="store_true", help=f"write the figures to {kept.KEPT.name}")
    options = parser.parse_args()
    outcomes, others = list[Outcome](), list[Outcome]()
    chosen = cases(options.groups, options.draws, options.seed, options.only)
    with get_context("spawn").Pool(options.processes, maxtasksperchild=20) as pool:
        for outcome, *other in pool.imap_unordered(partial(run, beside=options.beside), chosen):
            print(outcome.line(), *(f"    beside: {one.line()}" for one in other), sep="\n", flush=True)
            outcomes.append(outcome)
            others += other
    if options.keep:
        for group in options.groups:
            own = [one for one in outcomes if one.case.group == group]
            bad = sum(one.wrong or one.silent or bool(one.failure) for one in own)
            said = f"{sum(one.right for one in own)} of {len(own)}; {bad} wrong or nothing reported"
            said = f"{bad} of {len(own)}" if group in ("clean", "unknown") else said
            kept.write_row(f"confusion {group}", f"diagnosis, {MEANT[group]}", said, "make bench-confusion")
    for found, whose in ((outcomes, "this commit"), (others, "the other one")):
        if found:
            print(f"\n{whose}")
            table(sorted(found, key=lambda one: (GROUPS.index(one.case.group), one.case.hidden, one.case.seed)))


if __name__ == "__main__":
    main()
