"""The inverse of a stage as C source: tables and fields of each axis, put into the templates."""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cache
from math import isinf
from types import SimpleNamespace
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from numpy.typing import ArrayLike, NDArray

from slpi_ros.arrays import FloatArray
from slpi_ros.compensator.loop_filter import Section
from slpi_ros.effects.filters import DAMPING, WIDEST
from slpi_ros.export.feedback import ExportedLoop
from slpi_ros.export.stage import HISTORY, ExportedAxis, ExportedStage
from slpi_ros.hysteresis.shapes import END, FAR
from slpi_ros.model.limits import MAX_DT

# More than any number of a model: none. Turning points that are remembered, unless the compiler is told otherwise.
NONE, TURNS = 1e30, 64
LIBM = "fabs, floor, sqrt, exp, expm1, sin, cos, asinh, sinh (with an f for float)"


def _features(stage: ExportedStage) -> SimpleNamespace:
    """Return what any axis of the stage has, by which parts of the source are there."""
    laws = [axis.laws for axis in stage.axes]
    return SimpleNamespace(
        lag=any(one.lag > 0.0 for one in laws),
        slew=any(one.slew < np.inf for one in laws),
        rate=any(one.rate.size for one in laws),
        creep=any(one.relaxations.size for one in laws),
        modes=any(one.modes.size for one in laws),
        heating=any(one.heating.size and one.heating[0] for one in laws),
        surroundings=bool(stage.quantities),
        composed=any(axis.branches.operators.size for axis in stage.axes),
        coupling=bool(stage.gains.any()),
    )


def number(value: float) -> str:
    """Return a number as a constant of C of the type of the numbers."""
    return f"R({min(max(float(value), -NONE), NONE)!r})"


def _lines(items: Iterable[str], each: int = 4) -> Iterator[str]:
    given = list(items)
    for k in range(0, len(given), each):
        yield "    " + ", ".join(given[k : k + each]) + ","


def table(name: str, values: ArrayLike) -> str:
    """Return the definition of a table of numbers, shape (N,), N >= 1."""
    return "\n".join([f"static const slpi_real {name}[] = {{", *_lines(map(number, np.ravel(values).tolist())), "};"])


def _integers(name: str, values: Sequence[int]) -> str:
    return "\n".join([f"static const int {name}[] = {{", *_lines(map(str, values), 12), "};"])


def _rows(name: str, width: int, values: FloatArray) -> str:
    rows = ["    {" + ", ".join(map(number, row)) + "}," for row in values.tolist()]
    return "\n".join([f"static const slpi_real {name}[][{width}] = {{", *rows, "};"])


def _matrix(values: NDArray[np.floating[Any]]) -> str:
    return "{" + ", ".join("{" + ", ".join(map(number, row)) + "}" for row in values.tolist()) + "}"


class _Tables:
    """Tables of one axis, and the fields of its struct: declaration and value, by name."""

    def __init__(self, axis: ExportedAxis, place: int, has: SimpleNamespace, numbers: Mapping[str, int]) -> None:
        self._axis, self._prefix, self._has, self._quantities = axis, f"slpi_{place}", has, numbers
        self.tables: list[str] = []
        self.fields: dict[str, tuple[str, str]] = {}
        self._limits()
        self._curves()
        self._start()
        self._effects()

    def _numbers(self, **values: float) -> None:
        self.fields |= {name: (f"slpi_real {name}", number(value)) for name, value in values.items()}

    def _counts(self, **values: int) -> None:
        self.fields |= {name: (f"int {name}", str(int(value))) for name, value in values.items()}

    def _add(self, name: str, values: ArrayLike) -> None:
        """Add a table and the field that leads to it; no values: NULL."""
        text = table(f"{self._prefix}_{name}", values) if np.size(values) else ""
        self._refer(f"const slpi_real *{name}", name, text)

    def _refer(self, declared: str, name: str, text: str) -> None:
        """Add the definition of a table and the field that leads to it; "": NULL."""
        if text:
            self.tables.append(text)
        self.fields[name] = declared, f"{self._prefix}_{name}" if text else "NULL"

    def _limits(self) -> None:
        axis, allowed = self._axis, self._axis.allowed
        clipped, accepted = axis.model.chain.clipped, axis.accepted
        rest, symmetric, _, _ = axis.memory.shape_arrays()
        self._numbers(lower=allowed.lower, upper=allowed.upper, slew=allowed.slew)
        self._numbers(clip_lower=clipped[0], clip_upper=clipped[1])
        self._numbers(accepted_lower=accepted[0], accepted_upper=accepted[1])
        self._numbers(rest_v=rest[0], rest_y=rest[1], far_y=axis.memory.far)
        self._counts(primed=axis.primed, symmetric=symmetric)

    def _curves(self) -> None:
        """Add the curves of all branches, one after the other, the one without a turning point last."""
        axis, branches = self._axis, self._axis.branches
        base, near = axis.base, axis.near_base
        knots, change, first, last = list[FloatArray](), list[FloatArray](), list[int](), list[int]()
        place = 0
        if branches.last.size:
            for side in range(2):
                for row, end in enumerate(branches.last[side].tolist()):
                    first.append(place)
                    last.append(end)
                    knots.append(branches.knots[side, row, :, : end + 1])
                    change.append(branches.change[side, row, :, : end + 1])
                    place += end + 1
        packed, changed = np.hstack([np.empty((2, 0)), *knots]), np.hstack([np.empty((2, 0)), *change])
        zeros = np.zeros(near.knots.shape[1])
        for c, name in enumerate("uf"):
            # The branch without a turning point begins far outside; with `float` it is told from the upper limit.
            lines = [f"static const slpi_real {self._prefix}_{name}[] = {{", *_lines(map(number, packed[c].tolist()))]
            lines += ["#ifdef SLPI_FLOAT", *_lines(map(number, near.knots[c].tolist())), "#else"]
            lines += [*_lines(map(number, base.knots[c].tolist())), "#endif", "};"]
            self._refer(f"const slpi_real *{name}", name, "\n".join(lines))
            self._add(f"d{name}", np.append(changed[c], zeros))
        prefix = self._prefix.upper()
        self.tables.append(
            "\n".join([
                "#ifdef SLPI_FLOAT",
                f"#define {prefix}_BASE {number(near.voltage)}, {number(near.displacement)}",
                f"#define {prefix}_BASE_LAST {near.knots.shape[1] - 1}",
                "#else",
                f"#define {prefix}_BASE {number(base.voltage)}, {number(base.displacement)}",
                f"#define {prefix}_BASE_LAST {base.knots.shape[1] - 1}",
                "#endif",
            ])
        )  # fmt: skip
        self.fields["base"] = "slpi_real base[2]", f"{{{prefix}_BASE}}"
        self.fields["base_last"] = "int base_last", f"{prefix}_BASE_LAST"
        self._add("vertices", branches.vertices)
        for name, values in (("first", first), ("last", last)):
            self._refer(f"const int *{name}", name, _integers(f"{self._prefix}_{name}", values) if values else "")
        self._counts(count=branches.vertices.shape[1], base_first=place)
        if self._has.composed:
            empty = np.empty((2, 0))
            operators = branches.operators if branches.operators.ndim == 2 else empty
            self._add("thresholds", operators[0] if operators.size else [])
            self._add("weights", operators[1] if operators.size else [])
            self._counts(operators=operators.shape[1] if operators.size else 0)
            self._numbers(scale_origin=branches.scale[0], scale_amplitude=branches.scale[1])

    def _start(self) -> None:
        start = self._axis.start
        self._counts(start_direction=start.direction, start_turns=len(start.turn_voltages))
        self._numbers(start_v=start.voltage, start_y=start.displacement)
        self._add("start_turn_v", start.turn_voltages)
        self._add("start_turn_y", start.turn_displacements)

    def _effects(self) -> None:
        axis, laws, has = self._axis, self._axis.laws, self._has
        chain = axis.model.chain
        moving = [effect for effect in (*chain.before, *chain.own) if effect.streaming() is not None]
        self._counts(dynamic=bool(moving))
        if has.lag:
            self._numbers(lag=laws.lag)
        if has.slew:
            self._numbers(amplifier_slew=laws.slew)
        if has.rate:
            self._counts(has_rate=laws.rate.size > 0)
            threshold, onset, gain = laws.rate.tolist() if laws.rate.size else (0.0, 0.0, 0.0)
            self._numbers(threshold=threshold, onset_rate=onset, reversible_gain=gain)
        if has.creep:
            from_start = isinf(laws.rest_of_creep)
            self._counts(relaxations=laws.relaxations.shape[1], creep_from_start=from_start)
            self._numbers(creep_origin=0.0 if from_start else laws.rest_of_creep)
            self._add("creep_tau", laws.relaxations[0])
            self._add("creep_gain", laws.relaxations[1])
        self._numbers(contact_position=laws.contact[0], contact_gain=laws.contact[1])
        if has.modes:
            self._counts(modes=len(laws.modes))
            self._numbers(beside_modes=laws.rest)
            for name, width, rows in (("mode", 3, laws.modes[:, 1:]), ("factor", 8, laws.factors)):
                text = _rows(f"{self._prefix}_{name}", width, rows) if rows.size else ""
                self._refer(f"const slpi_real (*{name})[{width}]", name, text)
        if has.heating:
            gain, tau, origin, most = laws.heating.tolist() if laws.heating.size else (0.0, 1.0, 0.0, 0.0)
            self._numbers(heat_gain=gain, heat_tau=tau, heat_origin=origin, heat_most=most)
        if has.surroundings:
            self._surroundings()
        self._numbers(gain_origin=laws.gain[0], gain_factor=laws.gain[1])

    def _surroundings(self) -> None:
        """Add the quantities that the axis follows, with their numbers."""
        effect = self._axis.surroundings
        followed = effect.quantities if effect else ()
        rows = []
        for one in followed:
            values = (one.reference, one.offset_gain, one.sensitivity_gain, one.time_constant, one.averaging, one.ahead)
            rows.append(f"    {{{self._quantities[one.key]}, {', '.join(map(number, values))}}},")
        start = f"static const slpi_quantity_law_t {self._prefix}_quantity[] = {{"
        self._counts(quantities=len(rows))
        self._refer("const slpi_quantity_law_t *quantity", "quantity", "\n".join([start, *rows, "};"]) if rows else "")
        self._numbers(surroundings_origin=effect.origin if effect else 0.0)


@cache
def templates() -> Environment:
    """Return the templates of this folder."""
    return Environment(
        loader=PackageLoader("slpi_ros.export"),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        autoescape=False,
    )


def comment(text: str) -> str:
    """Return a text that cannot end a comment, of printable ASCII."""
    plain = "".join(one if " " <= one <= "~" else "?" for one in text)
    plain = plain.replace("\\", "/").replace('"', "'").replace("*/", "* /").replace("/*", "/ *")
    # No two question marks in a row begin a trigraph.
    return re.sub(r"\?(?=\?)", "? ", plain)


def context_of(stage: ExportedStage) -> Mapping[str, Any]:
    """Return what the templates are filled with."""
    has, laws = _features(stage), [axis.laws for axis in stage.axes]
    axes, numbers = [], {one.key: k for k, one in enumerate(stage.quantities)}
    for place, axis in enumerate(stage.axes):
        made = _Tables(axis, place, has, numbers)
        delay = axis.model.chain.delay
        axes.append({
            "name": comment(axis.name), "ahead": repr(delay) if delay else "", "tables": made.tables,
            "fields": made.fields,
        })  # fmt: skip
    operators = max(axis.branches.operators.shape[1] if axis.branches.operators.ndim == 2 else 0 for axis in stage.axes)
    conditions = ["a->lag > R(0.0)"] * has.lag + ["a->amplifier_slew < SLPI_NONE"] * has.slew
    lines = [f"model of {stage.model.created or 'unknown time'}, hardware '{stage.model.hardware_id}'"]
    lines += [line for axis in stage.axes for line in axis.describe]
    return {
        "has": has,
        "axes": axes,
        "about": [comment(line) for line in lines],
        "stack_bound": _stack_bound(stage),
        "history": HISTORY,
        "libm": LIBM,
        "longest": repr(MAX_DT),
        "far": repr(FAR),
        "end": repr(END),
        "damping": repr(DAMPING),
        "widest": repr(WIDEST),
        "before_condition": " || ".join(conditions) or "0",
        "most": {
            "relaxations": max(one.relaxations.shape[1] for one in laws),
            "modes": max(len(one.modes) for one in laws),
            "operators": operators,
            "knots": 4 * operators + 2,
            "quantities": max(len(axis.surroundings.quantities) if axis.surroundings else 0 for axis in stage.axes),
        },
        "quantities": [
            {"key": comment(one.key), "lowest": f"{one.lowest:.6g}", "highest": f"{one.highest:.6g}"}
            for one in stage.quantities
        ],
        "feedback": _feedback(stage.loops),
        "coupling": {
            "gains": _matrix(stage.gains),
            "inverse": _matrix(np.linalg.inv(np.eye(len(axes)) + stage.gains)),
            "origins": "{" + ", ".join(number(origin) for origin in stage.model.origins.values()) + "}",
        },
    }


def _feedback(loops: Sequence[ExportedLoop]) -> dict[str, Any] | None:
    """Return what the templates say of the feedback; None without one."""
    if not loops:
        return None
    rows, laws = list[Section](), []
    for loop in loops:
        own, gains = loop.sections, loop.gains
        values = (gains.proportional, gains.integral, gains.derivative, loop.moved, loop.most)
        laws.append(f"{{{len(rows)}, {len(own)}, {', '.join(map(number, values))}}}")
        rows += own
    return {
        "rows": ["{" + ", ".join(map(number, row)) + "}" for row in rows or [Section(0.0, 0.0, 0.0, 0.0, 0.0)]],
        "laws": laws,
        "period": repr(loops[0].period),
        "released": repr(loops[0].released),
        "most": max(1, *(len(loop.sections) for loop in loops)),
        "range": " and ".join(f"{loop.most:.4g}" for loop in loops),
    }


def _stack_bound(stage: ExportedStage) -> str:
    """Return the sentence on the error by a loop that is forgotten."""
    told = [f"axis {comment(axis.name)} {axis.forgotten(TURNS):.2g} m" for axis in stage.axes]
    return f"With {TURNS} that is at most, for each: {', '.join(told)}."


def c_files(stage: ExportedStage) -> dict[str, str]:
    """Return header and source by file name."""
    context = context_of(stage)
    return {
        name: templates().get_template(f"{name}.j2").render(context) for name in ("slpi_inverse.h", "slpi_inverse.c")
    }
