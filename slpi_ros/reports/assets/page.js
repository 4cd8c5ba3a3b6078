// Draws each chart from the data beside it, one after the other, so that the page can be read meanwhile.
"use strict";
(function () {
  const waiting = Array.from(document.querySelectorAll("figure.chart"));
  const buttons = [["toImage"], ["zoom2d", "pan2d"], ["zoomIn2d", "zoomOut2d", "resetScale2d"]];
  const options = { responsive: true, displaylogo: false, modeBarButtons: buttons };
  function next() {
    const figure = waiting.shift();
    if (!figure) {
      document.body.dataset.drawn = "all";
      return;
    }
    const { data, layout } = JSON.parse(figure.querySelector("script").textContent);
    Plotly.newPlot(figure.querySelector("div"), data, layout, options).then(() => setTimeout(next));
  }
  next();
})();
