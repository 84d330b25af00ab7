"use strict";
// Draws every figure, and draws them again where the page's width changes: on paper too.
(function () {
  const touch = window.matchMedia("(pointer: coarse)").matches;
  const plots = Array.from(document.querySelectorAll("[data-figure]"));
  for (const plot of plots) {
    const figure = JSON.parse(document.getElementById(plot.dataset.figure).textContent);
    const isMap = figure.layout.dragmode === "pan";
    // A finger scrolls the page; the map's buttons switch panning and zooming on.
    if (touch) figure.layout.dragmode = false;
    if (touch && isMap) figure.layout.margin.t = 40;
    if (plot.clientWidth < 500) {
      figure.layout.height = Math.min(figure.layout.height, plot.clientWidth * 1.1);
      figure.layout.font.size = 11;
    }
    Plotly.newPlot(plot, figure.data, figure.layout, {
      responsive: true,
      displaylogo: false,
      scrollZoom: isMap && !touch,
      displayModeBar: touch ? isMap : "hover",
      modeBarButtonsToRemove: ["select2d", "lasso2d"],
    });
  }
  let opened = [];
  function toPaper() {
    opened = Array.from(document.querySelectorAll("details:not([open])"));
    opened.forEach((item) => { item.open = true; });
    plots.forEach((plot) => Plotly.relayout(plot, { width: 660, autosize: false }));
  }
  function toScreen() {
    opened.forEach((item) => { item.open = false; });
    plots.forEach((plot) => Plotly.relayout(plot, { width: null, autosize: true }));
  }
  window.matchMedia("print").addEventListener("change", (e) => e.matches ? toPaper() : toScreen());
})();
