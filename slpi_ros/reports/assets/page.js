// Draws each chart from the data beside it, one after the other, so that the page can be read meanwhile.
"use strict";
(function () {
  const figures = Array.from(document.querySelectorAll("figure.chart"));
  const buttons = [["toImage"], ["zoom2d", "pan2d"], ["zoomIn2d", "zoomOut2d", "resetScale2d"]];
  const options = { responsive: true, displaylogo: false, modeBarButtons: buttons };
  const dark = window.matchMedia("(prefers-color-scheme: dark)");
  // Colours that would not be seen on dark paper, and theirs: text, paper, grid, axes, shades.
  const DARK = {
    "#1b2733": "#dfe6ec", "#fff": "#14191f", "#e4e9ee": "#2b343d", "#b9c4ce": "#56636f", "#c9d2da": "#46525e",
    "#fbeccb": "#43381c", "#e6cc94": "#a08447", "#2b5c93": "#6ea3d8", "#1b6049": "#43b58d", "#6b3f8f": "#b48ad6",
    "#3b6ea5": "#6ea3d8",
  };
  // Below this width (pixels) the panels of a row are placed one below the other; the width of a printed page,
  // and the height of a chart on it as a share of that on the screen, so that it holds two.
  const NARROW = 640, PRINTED = 688, LOWER = 0.8;
  let printing = false;

  function draw(figure) {
    const div = figure.querySelector("div");
    let text = figure.querySelector("script").textContent;
    if (dark.matches && !printing)
      text = text.replace(/"(#[0-9a-f]+)"/g, (all, colour) => `"${DARK[colour] || colour}"`);
    const { data, layout } = JSON.parse(text);
    if (dark.matches && !printing) for (const one of data) if (one.type === "heatmap") one.reversescale = true;
    // What the reader has zoomed and hidden stays.
    layout.uirevision = "kept";
    if (printing) Object.assign(layout, { width: PRINTED, height: LOWER * layout.height });
    figure.dataset.narrow = !printing && figure.clientWidth < NARROW;
    if (figure.dataset.narrow === "true") stack(data, layout);
    div.style.minHeight = `${layout.height}px`;
    const shown = { ...options, displayModeBar: figure.dataset.narrow === "true" ? false : "hover" };
    return Plotly.react(div, data, layout, shown).then(() => fit(div, layout));
  }

  function stack(data, layout) {
    layout.margin = { ...layout.margin, l: 66, r: 16 };
    // A finger that moves over a chart scrolls the page.
    layout.dragmode = false;
    const rows = Object.keys(layout).filter((name) => /^xaxis\d*$/.test(name) && layout[name].domain);
    rows.forEach((name, k) => {
      const y = layout[name.replace("x", "y")];
      const legend = data.filter((one) => one.colorbar && "x" + name.slice(5) === one.xaxis);
      const top = 1 - k / rows.length - (k || legend.length ? 0.06 : 0), bottom = 1 - (k + 1) / rows.length + 0.12;
      y.domain = [k + 1 < rows.length ? bottom : 0, top];
      if (!y.title.text) y.title = { ...layout.yaxis.title };
      layout[name].domain = [0, 1];
      for (const one of legend) Object.assign(one.colorbar, { x: 0, len: 1, y: top + 0.03 });
    });
    layout.height *= rows.length > 1 ? 0.8 * rows.length : 1;
  }

  // Makes room for all lines of the legend, below the buttons where it is as wide as to reach them.
  function fit(div, layout) {
    const legend = div.querySelector(".legend .bg"), bar = printing ? null : div.querySelector(".modebar");
    const place = bar && bar.getBoundingClientRect();
    const low = legend && bar && legend.getBoundingClientRect().right > place.left
      ? place.bottom - div.getBoundingClientRect().top : 0;
    const more = legend ? Math.max(0, legend.getBBox().height + low + 14 - layout.margin.t) : 0;
    const height = layout.height + more;
    div.style.minHeight = `${height}px`;
    if (more !== div._fullLayout.margin.t - layout.margin.t)
      return Plotly.relayout(div, { height, "margin.t": layout.margin.t + more, "legend.y": 1 - low / height });
  }

  function again() {
    for (const figure of figures) if ("narrow" in figure.dataset) draw(figure);
  }
  dark.addEventListener("change", again);
  let width = 0;
  new ResizeObserver(() => {
    if (document.body.clientWidth !== width && !printing) {
      width = document.body.clientWidth;
      again();
    }
  }).observe(document.body);
  window.addEventListener("beforeprint", () => { printing = true; again(); });
  window.addEventListener("afterprint", () => { printing = false; again(); });

  (function next(k) {
    if (k < figures.length) draw(figures[k]).then(() => setTimeout(next, 0, k + 1));
    else document.body.dataset.drawn = "all";
  })(0);
})();
