"""What ``slpi doctor`` says of a record, a model and a running ROS graph: what is well, and what failed."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from math import nan
from typing import Any

import numpy as np

from slpi_ros.arrays import FloatArray
from slpi_ros.calibration.drive_monitor import FARTHEST
from slpi_ros.compensator.amplifier import TOLERATED_SHARE
from slpi_ros.compensator.plausible import implausible
from slpi_ros.identification.held_readings import held_readings
from slpi_ros.identification.record_quality import assess, findings
from slpi_ros.io.record import Record
from slpi_ros.io.stage_name import same_stage, stage_name
from slpi_ros.model.stage_model import StageModel
from slpi_ros.reports.text import error_of, how_good, model_limits, unexplained

Range = tuple[float, float]

OK, NOTE, FAILED = "ok", "note", "failed"
STATE_TYPE = "sensor_msgs/msg/JointState"
# Largest share of the period by which 95 % of the steps of the stamps may differ from it, and longest gap in periods.
JITTER, GAP = 0.5, 5.0
# Seconds by which a stamp may lie before and after the time of its arrival.
OLDEST, NEWEST = 0.1, 0.01
NO_STAGE = "which no piezo stage has: displacements are in metres; check the unit and sensor_scale of the driver"
# Fewest states from which a rate is told.
FEWEST = 10


@dataclass(frozen=True)
class Check:
    """One statement: `level` is "ok", "note" or "failed"; `text` is what was found, after a semicolon what to do."""

    level: str
    text: str

    @property
    def remedy(self) -> str:
        """What to do."""
        return self.text.rpartition("; ")[2]

    def lines(self) -> list[str]:
        """Return the statement as lines of text; what to do about a failed check is on the second line."""
        found, separator, remedy = self.text.rpartition("; ")
        if self.level == FAILED and separator:
            return [f"{self.level:6} {found}", f"{'':6} {remedy}"]
        return [f"{self.level:6} {self.text}"]


@dataclass(frozen=True)
class Graph:
    """What was seen of a running ROS graph."""

    state_topic: str  # full name
    command_topic: str  # full name
    seconds: float  # for which the state was received
    nodes: Sequence[str] = ()  # all others
    state_publishers: Mapping[str, str] = field(default_factory=dict)  # types of the topic, by node
    command_publishers: Sequence[str] = ()  # nodes
    command_subscribers: Sequence[str] = ()  # nodes
    stamps: FloatArray = field(default_factory=lambda: np.empty(0))  # s, (N,), of the states
    arrivals: FloatArray = field(default_factory=lambda: np.empty(0))  # s, (N,)
    axes: Sequence[str] = ()  # of the last state
    displacement: Mapping[str, float] = field(default_factory=dict)  # m, last
    voltage: Mapping[str, float] = field(default_factory=dict)  # V, last
    hardware_id: str = ""
    limits: Mapping[str, Range] = field(default_factory=dict)  # V, of the node that publishes the voltages; {}: untold
    model: StageModel | None = None  # on ``stage_model``
    readings: Mapping[str, tuple[FloatArray, FloatArray]] = field(default_factory=dict)  # V, m, (N,), of all states


def check_record(record: Record, model: StageModel | None = None, limits: Range | None = None) -> list[Check]:
    """Check a record: rate, jitter, gaps, sensor, drive and memory, whether it fits a model and limits (V)."""
    return [Check(check.level, f"{record.source}: {check.text}") for check in _of_record(record, model, limits)]


def _of_record(record: Record, model: StageModel | None, limits: Range | None) -> Iterator[Check]:
    for axis in record.axes:
        v = record.voltage[axis]
        # First, as nothing else of a record in wrong units means what it says.
        units = implausible(v, record.displacement[axis], limits[1] - limits[0] if limits else nan)
        if units:
            yield Check(FAILED, f"axis {axis}: {units}, {NO_STAGE}")
        for finding in findings(assess(record, axis)):
            yield Check(OK if finding.level == "ok" else FAILED, f"axis {axis}: {finding.text}")
        reached = float(np.nanmin(v)), float(np.nanmax(v))
        if limits is not None:
            yield _within(axis, "the voltage went", reached, limits, "the limits", "correct the limits or the driver")
        if model is not None and axis in model.axes:
            known = model.axes[axis].voltage_range
            yield _within(axis, "the voltage went", reached, known, "the model", "identify a model of the whole range")
    if model is not None:
        yield from _of_one_stage(record.hardware_id, record.axes, model)


def check_model(model: StageModel, limits: Range | None = None) -> list[Check]:
    """Check a model: its accuracy, its memory at the end of its record, and voltage limits (V)."""
    checks = [Check(OK, "model: the document is valid")]
    limited = model_limits(model)
    for name, axis in model.axes.items():
        if name in limited:
            advice = "; find it with 'slpi diagnose'" if unexplained(limited[name]) else ""
            checks.append(Check(FAILED, f"model: axis {name}: {limited[name]}{advice}"))
        else:
            checks.append(Check(OK, f"model: axis {name}: its error is {how_good([error_of(axis)])}"))
        if axis.end is None:
            checks.append(
                Check(FAILED, f"model: axis {name}: the memory at the end of its record is unknown; identify it again")
            )
        if limits is not None:
            told = "identify within the limits, or correct them"
            checks.append(_overlap(f"model: axis {name}", axis.voltage_range, limits, told))
    if not stage_name(model.hardware_id):
        checks.append(Check(NOTE, "model: without hardware id: that it is of this stage cannot be checked"))
    return checks


def check_graph(graph: Graph, model: StageModel | None = None) -> list[Check]:
    """Check a running graph: discovery, state of the stage, who commands, and whether the model fits the stage."""
    if not graph.nodes:
        text = "ROS: no other node; start the driver of the stage, and use its ROS_DOMAIN_ID and discovery range"
        return [Check(FAILED, text)]
    checks = [Check(OK, f"ROS: nodes {', '.join(sorted(graph.nodes))}")]
    checks += _of_publishers(graph)
    if graph.stamps.size:
        checks += [*_of_times(graph), *_of_values(graph)]
    checks += _of_commands(graph)
    known = model or graph.model
    if known is not None and graph.stamps.size:
        checks += _of_one_stage(graph.hardware_id, graph.axes, known)
        checks += _of_range(graph, known)
    elif known is None:
        checks.append(Check(NOTE, "model: none on stage_model; give one by --model to compare it with the stage"))
    return checks


def _of_publishers(graph: Graph) -> Iterator[Check]:
    topic, publishers = graph.state_topic, graph.state_publishers
    if not publishers:
        yield Check(FAILED, f"{topic}: no publisher; start the driver of the stage, or name its topic by --topic")
        return
    wrong = {kind for kind in publishers.values() if kind != STATE_TYPE}
    if wrong:
        yield Check(FAILED, f"{topic}: of type {', '.join(sorted(wrong))}; publish {STATE_TYPE}")
    elif len(publishers) > 1:
        yield Check(FAILED, f"{topic}: {len(publishers)} publishers: {', '.join(publishers)}; end all but one")
    elif not graph.stamps.size:
        yield Check(
            FAILED, f"{topic}: {', '.join(publishers)} sent nothing for {graph.seconds:.3g} s; make the driver publish"
        )
    else:
        yield Check(OK, f"{topic}: published by {', '.join(publishers)}")


def _of_times(graph: Graph) -> Iterator[Check]:
    topic, stamps, arrivals = graph.state_topic, graph.stamps, graph.arrivals
    if stamps.size < FEWEST:
        text = (
            f"{topic}: {stamps.size} states in {graph.seconds:.3g} s, too few to be judged; publish at 100 Hz or more"
        )
        yield Check(FAILED, text)
        return
    if not stamps.any():
        yield Check(FAILED, f"{topic}: without stamps; stamp each state with the time of its measurement")
        return
    steps = np.diff(stamps)
    if np.any(steps < 0.0):
        yield Check(FAILED, f"{topic}: {np.count_nonzero(steps < 0.0)} stamps run backwards; send the states in order")
    period = float(np.median(steps))
    if period <= 0.0:
        yield Check(FAILED, f"{topic}: most stamps are equal; stamp each state with the time of its measurement")
        return
    jitter = float(np.percentile(np.abs(steps - period), 95)) / period
    text = f"{topic}: {1.0 / period:.4g} states per second, jitter {jitter:.0%} of the period"
    yield _checked(jitter <= JITTER, text, "stamp each state with the time of its measurement")
    longest = float(np.max(steps))
    if longest > GAP * period:
        yield Check(FAILED, f"{topic}: a gap of {longest:.3g} s; relieve the processor or the network")
    offset = float(np.median(arrivals - stamps))
    text = f"{topic}: the stamps are {abs(offset):.3g} s {'old' if offset >= 0.0 else 'ahead'} when they come"
    remedy = "synchronise the clocks (chrony, PTP), or use use_sim_time in all nodes or in none"
    yield _checked(-NEWEST <= offset <= OLDEST, text, remedy)


def _of_values(graph: Graph) -> Iterator[Check]:
    topic = graph.state_topic
    if not graph.axes:
        yield Check(FAILED, f"{topic}: names no axis; fill name[], position[] (m) and effort[] (V)")
    for axis in graph.axes:
        y, v = graph.displacement.get(axis, np.nan), graph.voltage.get(axis, np.nan)
        if not (np.isfinite(y) and np.isfinite(v)):
            text = f"axis {axis}: position {y:g} m, effort {v:g} V; fill both with finite numbers"
            yield Check(FAILED, f"{topic}: {text}")
        elif abs(y) > FARTHEST:
            yield Check(FAILED, f"{topic}: axis {axis}: position {y:.4g} is no displacement in metres; publish metres")
        elif units := _units(graph, axis):
            yield Check(FAILED, f"{topic}: axis {axis}: {units}, {NO_STAGE}")
        else:
            yield Check(OK, f"{topic}: axis {axis} at {y * 1e6:.4g} µm, {v:.4g} V")
            yield from _held(graph, axis)
    if not stage_name(graph.hardware_id):
        yield Check(NOTE, f"{topic}: without a hardware id in header.frame_id: models cannot be told apart by stage")


def _held(graph: Graph, axis: str) -> Iterator[Check]:
    """Say that the sensor of an axis is slower than the states; it only shows while the stage moves."""
    v, y = graph.readings.get(axis, (np.empty(0), np.empty(0)))
    known = np.isfinite(v) & np.isfinite(y)
    held, span = held_readings(y[known], v[known]), float(np.ptp(graph.stamps))
    if held.found and span:
        rate = f"{(graph.stamps.size - 1) / span / held.rows:.3g} readings a second, each for {held.rows:.3g} states"
        yield Check(NOTE, f"{graph.state_topic}: the sensor of axis {axis} is slower than the states: {rate}")


def _units(graph: Graph, axis: str) -> str:
    """Return what is implausible of the readings of an axis, "" if nothing is."""
    low, high = graph.limits.get(axis, (nan, nan))
    return implausible(*graph.readings[axis], high - low) if axis in graph.readings else ""


def _of_commands(graph: Graph) -> Iterator[Check]:
    topic, publishers = graph.command_topic, graph.command_publishers
    told = f"{len(publishers)} publishers: " if len(publishers) > 1 else "published by "
    told += ", ".join(publishers) or "nobody"
    yield _checked(len(publishers) <= 1, f"{topic}: {told}", "stop all but one, as the voltage would jump")
    told = f"received by {', '.join(graph.command_subscribers)}" if graph.command_subscribers else "no subscriber"
    remedy = "start the driver of the amplifier, or remap its topic"
    yield _checked(bool(graph.command_subscribers), f"{topic}: {told}", remedy)


def _of_one_stage(hardware_id: str, axes: Sequence[str], model: StageModel) -> Iterator[Check]:
    agree = same_stage(hardware_id, model.hardware_id)
    if not agree:
        text = f"model: of stage '{model.hardware_id}', but the stage is '{hardware_id}'; take its own model"
        yield Check(FAILED, text)
    lacking = [axis for axis in model.axes if axis not in axes]
    if lacking:
        text = f"model: axes {', '.join(lacking)} are not among those of the stage, {', '.join(axes) or 'none'}"
        yield Check(FAILED, f"{text}; name the axes alike")
    elif agree:
        named = stage_name(hardware_id) and stage_name(model.hardware_id)
        known = "hardware id and axes agree" if named else "axes agree"
        yield Check(OK, f"model: {known} with those of the stage")


def _of_range(graph: Graph, model: StageModel) -> Iterator[Check]:
    for name, axis in model.axes.items():
        if np.isfinite(v := graph.voltage.get(name, np.nan)):
            told = "move it inside, or identify a model of the whole range"
            yield _within(name, "the stage is", (v, v), axis.voltage_range, "the model", told)
        if name in graph.limits:
            yield _overlap(
                f"model: axis {name}", axis.voltage_range, graph.limits[name], "correct voltage_min and voltage_max"
            )


def _checked(good: bool, text: str, remedy: str) -> Check:
    return Check(OK, text) if good else Check(FAILED, f"{text}; {remedy}")


def _within(axis: str, what: str, reached: Range, allowed: Range, whose: str, remedy: str) -> Check:
    slack = TOLERATED_SHARE * (allowed[1] - allowed[0])
    where = f"{reached[0]:.4g} V" if reached[0] == reached[1] else f"{reached[0]:.4g} to {reached[1]:.4g} V"
    text = f"axis {axis}: {what} {'at' if reached[0] == reached[1] else 'from'} {where}"
    bounds = f"{allowed[0]:.4g} to {allowed[1]:.4g} V of {whose}"
    inside = allowed[0] - slack <= reached[0] and reached[1] <= allowed[1] + slack
    return _checked(inside, f"{text}, {'within' if inside else 'outside'} {bounds}", remedy)


def _overlap(what: str, known: Range, limits: Range, remedy: str) -> Check:
    text = f"{what}: identified from {known[0]:.4g} to {known[1]:.4g} V, limits {limits[0]:.4g} to {limits[1]:.4g} V"
    if max(known[0], limits[0]) > min(known[1], limits[1]):
        return Check(FAILED, f"{text} do not meet; {remedy}")
    slack = TOLERATED_SHARE * (known[1] - known[0])
    narrower = limits[0] > known[0] + slack or limits[1] < known[1] - slack
    return Check(NOTE, f"{text}: a part of the stroke is not used") if narrower else Check(OK, text)


def worst_first(checks: Iterable[Check]) -> list[Check]:
    """Return the failed checks, the notes, and what is well."""
    return sorted(checks, key=lambda check: (FAILED, NOTE, OK).index(check.level))


def described(checks: Iterable[Check]) -> tuple[str, list[str], list[str]]:
    """Return the verdict, the lines of what is not well, and all lines; failed checks come first."""
    ordered = worst_first(checks)
    count = sum(check.level == FAILED for check in ordered)
    verdict = f"FAILED: {count} check{'s' * (count > 1)}" if count else f"GOOD: {len(ordered)} checks passed"
    unwell = [line for check in ordered if check.level != OK for line in check.lines()]
    return verdict, unwell, [line for check in ordered for line in check.lines()]


def doctor_document(checks: Sequence[Check]) -> dict[str, Any]:
    """Return the checks as a document for ``--json``."""
    return {
        "well": all(check.level != FAILED for check in checks),
        "checks": [{"level": check.level, "text": check.text} for check in checks],
    }
