"""Interactive charts of SI values, drawn by the plotly.js bundle that every page contains."""

import base64
import html
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from slpi_ros.arrays import FloatArray, IntArray, Mask
from slpi_ros.errors import shown

# Colours of one chart differ in lightness, too: printed in grey they are still different.
MEASURED, DESIRED, NOISE = "#a3aebb", "#1b2733", "#c9d2da"
COLOURS = ("#d6654a", "#d99a26", "#1b6049", "#2b5c93")
# Colours of unused samples: their time span, the measurement, and the model.
UNUSED_SHADE, UNUSED_MEASURED, UNUSED_MODEL = "#fbeccb", "#e6cc94", "#b98a2f"
BEFORE, AFTER = COLOURS[0], COLOURS[2]
# Colours of causes, in the order of their weight; distinct from BEFORE and AFTER.
CAUSES = ("#3b6ea5", "#e0a83a", "#6b3f8f", "#35a9b5", "#b5467d", "#b9a78f")
# Sequential colour scales for counts and errors: dark on white, suitable for colour blindness.
SCALE = ((0.0, "#c3d8ea"), (0.5, "#5b8db8"), (1.0, "#173a5c"))
ERROR_SCALE = ((0.0, "#c9e4d8"), (0.5, "#e0b04a"), (1.0, "#a8321c"))

# Largest number of points of a line, and of dots of a scatter plot, each of which is an element of the page.
LINE_POINTS, CLOUD_POINTS = 5000, 1500
# Up to so many dots are drawn large.
_FEW = 50
# Spacing between panels, and margins for the axis titles, pixels.
_GAP = {"row": 80, "column": 62}
_MARGIN = {"l": 75, "r": 15, "t": 46, "b": 56}
_WIDTH = 1085
_GRID = {
    "gridcolor": "#e4e9ee",
    "zerolinecolor": "#b9c4ce",
    "linecolor": "#b9c4ce",
    "showline": True,
    "ticks": "outside",
}
_SMALL = {"size": 13}


def thin_line(*signals: FloatArray, most: int = LINE_POINTS) -> IntArray:
    """Return sample indices (ascending, about `most`): ends, and extremes of each signal (N,) in each interval."""
    # Of NaN sequences at least as long as an interval, one NaN is kept, so that the line is interrupted.
    size = signals[0].size
    if size <= most:
        return np.arange(size)
    stretches = max(1, (most - 2) // (2 * len(signals)))
    length = -(-size // stretches)
    kept = [np.array([0, size - 1])]
    for signal in signals:
        padded = np.full(stretches * length, np.nan)
        padded[:size] = signal
        rows = padded.reshape(stretches, length)
        offset = np.arange(stretches) * length
        first, after = sequences(np.isnan(signal))
        kept.append(first[after - first >= length])
        kept += [offset + np.argmin(np.where(np.isnan(rows), np.inf, rows), axis=1)]
        kept += [offset + np.argmax(np.where(np.isnan(rows), -np.inf, rows), axis=1)]
    found = np.unique(np.concatenate(kept))
    return found[found < size]


def sequences(chosen: Mask) -> tuple[IntArray, IntArray]:
    """Return the first sample of each sequence of `chosen` samples, shape (N,), and the sample after it."""
    steps = np.diff(np.pad(chosen, 1).astype(np.int8))
    return np.flatnonzero(steps > 0), np.flatnonzero(steps < 0)


def thin_cloud(x: FloatArray, y: FloatArray, most: int = CLOUD_POINTS) -> IntArray:
    """Return the sample indices of a thinned scatter plot of `x`, `y`, shape (N,): envelope and some inner points."""
    finite = np.flatnonzero(np.isfinite(x) & np.isfinite(y))
    if finite.size <= most:
        return finite
    along = finite[np.argsort(x[finite], kind="stable")]
    outline = along[thin_line(y[along], most=most // 2)]
    inside = finite[np.linspace(0, finite.size - 1, most - outline.size).astype(np.int64)]
    return np.union1d(outline, inside)


@dataclass(frozen=True)
class Quantity:
    """Quantity, unit and number format of a panel axis, as displayed."""

    name: str
    unit: str
    scale: float = 1.0  # from SI to the displayed unit
    digits: str = ".4~g"  # as in d3-format
    logarithmic: bool = False

    @property
    def title(self) -> str:
        """Name and unit."""
        return f"{self.name} ({self.unit})" if self.unit else self.name

    def shown(self, values: FloatArray) -> dict[str, str]:
        """Return SI values in the displayed unit, in the encoding of plotly.js."""
        packed = np.ascontiguousarray(np.asarray(values) * self.scale, dtype="<f4")
        return {"dtype": "f4", "bdata": base64.b64encode(packed.tobytes()).decode()}


TIME = Quantity("time", "s", digits=".4f")
VOLTAGE = Quantity("voltage", "V", digits=".3f")
DISPLACEMENT = Quantity("displacement", "µm", 1e6, ".4f")
ERROR = Quantity("measured - model", "nm", 1e9, ".1f")
SAMPLES = Quantity("samples", "", digits=",d")


@dataclass(frozen=True)
class Panel:
    """One pair of axes."""

    x: Quantity
    y: Quantity
    share: float = 1.0  # of width (row) or height (column), relative to the other panels


@dataclass
class Chart:
    """Panels in a row or a column with a common legend; a legend entry shows or hides its curves in all panels."""

    # Panels in a row share the vertical axis, panels in a column the horizontal one, if they show the same quantity, so
    # that they zoom together.
    panels: Sequence[Panel]
    arrangement: Literal["row", "column"] = "row"
    height: int = 420  # pixels
    _traces: list[dict[str, Any]] = field(default_factory=list, init=False)
    _shapes: list[dict[str, Any]] = field(default_factory=list, init=False)
    _ranges: dict[int, list[float]] = field(default_factory=dict, init=False)
    _legend: set[str] = field(default_factory=set, init=False)

    def line(self, panel: int, name: str, x: FloatArray, y: FloatArray, colour: str, *, width: float = 1.4) -> None:
        """Add a line through points, shape (N,) each, SI; NaN interrupts it, an isolated point is drawn as a dot."""
        style: dict[str, Any] = {"mode": "lines", "line": {"color": colour, "width": width}}
        if _alone(y).any():
            style |= {"mode": "lines+markers", "marker": {"color": colour, "size": width}}
        self._add(panel, name, x, y, {"type": "scatter", **style})

    def thinned(self, panel: int, name: str, x: FloatArray, y: FloatArray, colour: str, *, width: float = 1.4) -> None:
        """Add a line as `line` does, through about `LINE_POINTS` of the points."""
        kept = thin_line(y)
        self.line(panel, name, x[kept], y[kept], colour, width=width)

    def dots(self, panel: int, name: str, x: FloatArray, y: FloatArray, colour: str, *, faint: bool = False) -> None:
        """Add points, shape (N,) each, SI; `faint` points belong to a line of the same name, which is added later."""
        look = {"size": 3, "opacity": 0.3 if faint else 0.55} if x.size > _FEW else {"size": 8, "opacity": 1.0}
        style = {"mode": "markers", "marker": {"color": colour, **look}}
        self._add(panel, name, x, y, {"type": "scatter", **style}, keyed=not faint)

    def steps(self, panel: int, name: str, edges: FloatArray, counts: FloatArray, colour: str) -> None:
        """Add a horizontal histogram: `counts`, shape (n,), of the bins between `edges`, shape (n + 1,), SI."""
        style = {"mode": "lines", "line": {"color": colour, "width": 1.2, "shape": "vh"}, "fill": "tozerox"}
        self._add(panel, name, np.append(counts, 0.0), edges, {"type": "scatter", **style})

    def cells(self, panel: int, edges: FloatArray, values: FloatArray, shade: Quantity, scale: Sequence[Any]) -> None:
        """Add a map of SI values (n, n), upwards first, in cells between `edges` (n + 1,); NaN cells are empty."""
        x, y = self.panels[panel].x, self.panels[panel].y
        start, stop = self._domain(panel)
        # Limit the colour scale, so that a few large values do not dominate it.
        most = float(np.nanpercentile(values, 98)) if np.isfinite(values).any() else 1.0
        texts = {"x": x.name, "y": y.name, "z": shade.name}
        lines = [f"{texts[k]} %{{{k}:{q.digits}}} {q.unit}" for k, q in (("x", x), ("y", y), ("z", shade))]
        self._traces.append(
            {
                "type": "heatmap", "x": x.shown(edges), "y": y.shown(edges),
                "z": {**shade.shown(values), "shape": ",".join(map(str, values.shape))},
                "colorscale": [list(stop) for stop in scale], "hoverongaps": False,
                "zmin": 0, "zmax": most * shade.scale,
                "hovertemplate": "<br>".join(lines) + "<extra></extra>", **self._anchors(panel),
                "colorbar": {
                    "title": {"text": shade.title, "side": "top", "font": _SMALL}, "orientation": "h",
                    "x": start, "xanchor": "left", "xpad": 0, "len": stop - start, "thickness": 10,
                    "y": 1.01, "yanchor": "bottom", "ypad": 0, "outlinewidth": 0,
                },
            }
        )  # fmt: skip

    def band(self, panel: int, half_width: float) -> None:
        """Shade the range between plus and minus `half_width`, SI; 0 adds nothing."""
        if not half_width > 0.0:
            return
        y = self.panels[panel].y
        numbers = self._anchors(panel)
        self._shapes.append(
            {
                "type": "rect", "layer": "below", "fillcolor": NOISE, "opacity": 0.45, "line": {"width": 0},
                "xref": f"{numbers['xaxis']} domain", "x0": 0, "x1": 1,
                "yref": numbers["yaxis"], "y0": -half_width * y.scale, "y1": half_width * y.scale,
            }
        )  # fmt: skip

    def span(self, panel: int, name: str, start: float, stop: float, colour: str) -> None:
        """Shade the interval from `start` to `stop` on the horizontal axis, SI; equal names share one legend entry."""
        x = self.panels[panel].x
        numbers = self._anchors(panel)
        self._shapes.append(
            {
                "type": "rect", "layer": "below", "fillcolor": colour, "line": {"width": 0},
                "xref": numbers["xaxis"], "x0": start * x.scale, "x1": stop * x.scale,
                "yref": f"{numbers['yaxis']} domain", "y0": 0, "y1": 1,
                "name": _plain(name), "legendgroup": _plain(name), "showlegend": name not in self._legend,
            }
        )  # fmt: skip
        self._legend.add(name)

    def show(self, panel: int, low: float, high: float) -> None:
        """Set the initial vertical range, SI."""
        y = self.panels[panel].y
        ends = np.array([low, high]) * y.scale
        self._ranges[panel] = (np.log10(ends) if y.logarithmic else ends).tolist()

    def _add(
        self, panel: int, name: str, x: FloatArray, y: FloatArray, style: dict[str, Any], *, keyed: bool = True
    ) -> None:
        across, up = self.panels[panel].x, self.panels[panel].y
        values = f"%{{y:{up.digits}}} {up.unit}"
        if self.arrangement == "row":
            values = f"%{{x:{across.digits}}} {across.unit}<br>{values}"
        self._traces.append(
            {
                "name": _plain(name), "x": across.shown(x), "y": up.shown(y), **style, **self._anchors(panel),
                "legendgroup": _plain(name), "showlegend": keyed and name not in self._legend,
                "hovertemplate": f"{values}<extra>{_plain(name)}</extra>",
            }
        )  # fmt: skip
        if keyed:
            self._legend.add(name)

    def _anchors(self, panel: int) -> dict[str, str]:
        number = str(panel + 1) if panel else ""
        return {"xaxis": f"x{number}", "yaxis": f"y{number}"}

    def _domain(self, panel: int) -> tuple[float, float]:
        """Return start and end (0..1) of a panel within the width of a row, or the height of a column from below."""
        length = _WIDTH - 90 if self.arrangement == "row" else self.height - _MARGIN["t"] - _MARGIN["b"]
        gap = _GAP[self.arrangement] / length
        shares = np.array([part.share for part in self.panels])
        sizes = shares / shares.sum() * (1.0 - gap * (len(shares) - 1))
        start = float(sizes[:panel].sum() + gap * panel)
        stop = start + float(sizes[panel])
        return (start, stop) if self.arrangement == "row" else (1.0 - stop, 1.0 - start)

    def to_json(self) -> str:
        """Return the plotly.js figure as JSON, with characters that are special in HTML escaped."""
        layout: dict[str, Any] = {
            "height": self.height, "margin": _MARGIN, "shapes": self._shapes, "dragmode": "zoom",
            "hovermode": "closest" if self.arrangement == "row" else "x unified",
            "hoverlabel": {"namelength": -1},
            "paper_bgcolor": "#fff", "plot_bgcolor": "#fff",
            "font": {"family": "system-ui, sans-serif", "size": 13, "color": "#1b2733"},
            "legend": {
                "orientation": "h", "x": 0, "y": 1, "yref": "container", "yanchor": "top", "itemsizing": "constant"
            },
        }  # fmt: skip
        for panel in range(len(self.panels)):
            layout.update(self._axes(panel))
        text = json.dumps({"data": self._traces, "layout": layout}, separators=(",", ":"), allow_nan=False)
        return text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")

    def _axes(self, panel: int) -> dict[str, Any]:
        """Return the layout of the axes of a panel."""
        here, first = self.panels[panel], self.panels[0]
        number = str(panel + 1) if panel else ""
        across: dict[str, Any] = {**_GRID, "title": {"text": here.x.title, "font": _SMALL}, "anchor": f"y{number}"}
        up: dict[str, Any] = {
            **_GRID,
            "title": {"text": here.y.title, "font": _SMALL, "standoff": 6},
            "anchor": f"x{number}",
        }
        for axis, quantity in ((across, here.x), (up, here.y)):
            if quantity.logarithmic:
                axis.update(type="log", exponentformat="none", dtick=1)
        if panel in self._ranges:
            up["range"] = self._ranges[panel]
        if self.arrangement == "row":
            across["domain"] = self._domain(panel)
            if panel and here.y == first.y:
                up.update(matches="y", title={"text": ""})
        else:
            up["domain"] = self._domain(panel)
            across["unifiedhovertitle"] = {"text": f"%{{x:{here.x.digits}}} {here.x.unit}"}
            if panel and here.x == first.x:
                across["matches"] = "x"
            if panel < len(self.panels) - 1 and here.x == self.panels[panel + 1].x:
                across.update(title={"text": ""})
        return {f"xaxis{number}": across, f"yaxis{number}": up}


def over_time(error: Quantity) -> Chart:
    """Return an empty chart of the displacement over time, and of an error below."""
    return Chart([Panel(TIME, DISPLACEMENT), Panel(TIME, error, 1.2)], "column", 540)


def _alone(y: FloatArray) -> Mask:
    """Return a mask of the finite points, shape (N,), without a finite neighbour."""
    finite = np.pad(np.isfinite(y), 1)
    return np.asarray(finite[1:-1] & ~finite[:-2] & ~finite[2:])


def _plain(name: str) -> str:
    """Return a name that plotly.js displays unchanged, without interpreting tags."""
    return html.escape(shown(name), quote=False)
