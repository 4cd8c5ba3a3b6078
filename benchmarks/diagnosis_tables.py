"""Tables of the benchmark of the diagnosis."""

from collections import Counter, defaultdict
from collections.abc import Sequence

import numpy as np
from diagnosis_score import Outcome
from hidden import NAMES

OTHER = ("nothing_found", "unexplained", "failed")
CLOSE_POINTS = 10.0


def line(outcome: Outcome) -> str:
    """Return the result of a case as one line of text."""
    case = outcome.case
    hidden = "+".join(case.effects) or case.base or "clean"
    says = [
        f"{axis}: {found.verdict} {', '.join(_with_alternatives(found))} ({found.gain:.0f} % of {found.true_gain:.0f} %"
        f"{''.join(f', {size:.1f} floors' for size in found.sizes)})"
        for axis, found in outcome.axes.items()
    ]
    told = outcome.failure or "; ".join(says)
    return f"{case.group:<8} {case.seed:4d} {hidden:<32} {outcome.samples:6d} {outcome.seconds:5.1f} s  {told}"


def everything(outcomes: Sequence[Outcome]) -> None:
    """Print all tables of a run."""
    groups: dict[str, list[Outcome]] = defaultdict(list)
    for outcome in outcomes:
        groups[outcome.case.group].append(outcome)
    failures = [outcome for outcome in outcomes if outcome.failure]
    print(f"\n{len(outcomes)} records, {len(failures)} failed")
    confusion(groups["single"])
    clean(groups["clean"], outcomes)
    pairs(groups["pair"])
    gains(groups["single"] + groups["pair"])
    parameters(groups["single"])
    times(outcomes)
    bouc_wen(groups["bouc_wen"])


def confusion(outcomes: Sequence[Outcome]) -> None:
    """Print the confusion matrix: for each hidden effect, how often each effect was named first."""
    drawn = [outcome for outcome in outcomes if not outcome.failure.startswith("not drawn")]
    if not drawn:
        return
    print("\nname that came first, one row for each hidden effect")
    print(" " * 17 + " ".join(f"{_short(name):>7}" for name in (*NAMES, *OTHER)) + "   right   right or an alternative")
    for name in NAMES:
        rows = [outcome for outcome in drawn if outcome.case.effects == (name,)]
        if rows:
            counts = Counter(_first(outcome) for outcome in rows)
            cells = " ".join(f"{counts[column] or '.':>7}" for column in (*NAMES, *OTHER))
            print(f"{name:<17}{cells}   {_share(rows, 'first_right')}   {_share(rows, 'first_among')}")
    print(
        f"right name first: {_share(drawn, 'first_right')}; or as an alternative of it: {_share(drawn, 'first_among')}"
    )
    extra = sum(len(set(o.victim.named) - set(o.victim.truth)) > 0 for o in drawn if o.victim and o.victim.first_right)
    print(f"right name first, but something named beside it that is not there: {extra} of {len(drawn)}")


def clean(outcomes: Sequence[Outcome], everyone: Sequence[Outcome]) -> None:
    """Print the false alarms on clean records, and on axes without effects of stages with an effect on another axis."""
    for what, rows in (
        ("clean records", outcomes),
        ("axes without effect beside one that has one", [o for o in everyone if o.case.effects]),
    ):
        axes = [axis for outcome in rows for axis in outcome.axes.values() if not axis.truth]
        if axes:
            verdicts = Counter(axis.verdict for axis in axes)
            alarms = sum(axis.alarm for axis in axes)
            print(
                f"\n{what}: {alarms} false alarms on {len(axes)} axes ({alarms / len(axes):.1%}); {_counted(verdicts)}"
            )


def pairs(outcomes: Sequence[Outcome]) -> None:
    """Print how often both of two hidden effects were named."""
    drawn = [outcome for outcome in outcomes if not outcome.failure.startswith("not drawn")]
    if drawn:
        both = [outcome for outcome in drawn if outcome.victim and outcome.victim.all_named]
        print(f"\nof two hidden effects both named: {len(both)} of {len(drawn)} ({len(both) / len(drawn):.0%})")
        for outcome in drawn:
            if outcome not in both:
                print("  not: " + line(outcome))


def gains(outcomes: Sequence[Outcome]) -> None:
    """Print by how much the held-out gains are below those of the true effects."""
    short = [axis.true_gain - axis.gain for outcome in outcomes if (axis := outcome.victim)]
    if short:
        close = np.mean(np.array(short) <= CLOSE_POINTS)
        print(f"\nheld-out gain below that of the true effects, points: {_spread(short, 1.0)}; within 10: {close:.0%}")


def parameters(outcomes: Sequence[Outcome]) -> None:
    """Print the error statistics of every parameter of the correctly named effects."""
    errors: dict[tuple[str, str], list[float]] = defaultdict(list)
    for outcome in outcomes:
        for key, error in (outcome.victim.errors if outcome.victim else {}).items():
            errors[key].append(error)
    if not errors:
        return
    print("\nparameter errors, %                median      90 %   largest   n")
    for (name, parameter), found in sorted(errors.items(), key=lambda item: (NAMES.index(item[0][0]), item[0][1])):
        median, most, largest = 100 * np.percentile(found, [50, 90, 100])
        print(f"  {name:<17} {parameter:<14} {median:9.1f} {most:9.1f} {largest:9.1f} {len(found):3d}")
    own = [error for (_, parameter), found in errors.items() if parameter != "contribution" for error in found]
    print(f"  all parameters: median {100 * np.median(own):.1f} %")


def times(outcomes: Sequence[Outcome]) -> None:
    """Print median and maximum time of a diagnosis."""
    done = [outcome for outcome in outcomes if not outcome.failure]
    if done:
        longest = max(done, key=lambda outcome: outcome.seconds)
        median = np.median([outcome.seconds for outcome in done])
        print(f"\ndiagnosis: median {median:.1f} s, longest {longest.seconds:.1f} s of {longest.samples:,} samples")


def bouc_wen(outcomes: Sequence[Outcome]) -> None:
    """Print the verdicts on Bouc-Wen stages, whose loops do not close."""
    axes = [axis for outcome in outcomes for axis in outcome.axes.values()]
    if axes:
        named = sum(axis.alarm for axis in axes)
        said = sum("clos" in axis.summary for axis in axes)
        print(f"\nBouc-Wen: {_counted(Counter(axis.verdict for axis in axes))}")
        print(f"  a cause invented on {named} of {len(axes)} axes; the summary speaks of closing on {said}")


def sizes(outcomes: Sequence[Outcome]) -> None:
    """Print how often each effect is found, as a function of its size."""
    steps = sorted({outcome.case.size for outcome in outcomes})
    print("\nright name first, of those drawn, over the size in noise floors")
    print(" " * 17 + " ".join(f"{step:>7g}" for step in steps))
    for name in (*NAMES, ""):
        cells = []
        for step in steps:
            rows = [o for o in outcomes if o.case.size == step and name in (*o.case.effects, "")]
            rows = [outcome for outcome in rows if not outcome.failure.startswith("not drawn")]
            right = sum(bool(o.victim and o.victim.first_right) for o in rows)
            cells.append(f"{right:>3}/{len(rows):<3}" if rows else "      -")
        if any("/" in cell for cell in cells):
            print(f"{name or 'all':<17}" + " ".join(cells))


def _first(outcome: Outcome) -> str:
    if outcome.failure or not outcome.victim:
        return "failed"
    if outcome.victim.named:
        return outcome.victim.named[0]
    return outcome.victim.verdict if outcome.victim.verdict in OTHER else "failed"


def _share(outcomes: Sequence[Outcome], what: str) -> str:
    return f"{sum(bool(o.victim and getattr(o.victim, what)) for o in outcomes) / len(outcomes):5.0%}"


def _spread(values: Sequence[float], scale: float) -> str:
    low, median, high = scale * np.percentile(values, [0, 50, 100])
    return f"median {median:.1f}, least {low:.1f}, most {high:.1f}"


def _counted(counts: Counter[str]) -> str:
    return ", ".join(f"{count} {what}" for what, count in counts.most_common())


def _short(name: str) -> str:
    return {
        "rate_dependence": "rate",
        "saturation": "satur",
        "resonance": "reson",
        "gain_drift": "gain",
        "cross_coupling": "coupl",
        "thermal_drift": "drift",
        "sensor_periodic": "period",
        "nothing_found": "nothing",
        "unexplained": "unexpl",
    }.get(name, name)


def _with_alternatives(found) -> list[str]:
    return [
        name + (f" (or {'/'.join(others)})" if others else "")
        for name, others in zip(found.named, found.alternatives, strict=True)
    ]
