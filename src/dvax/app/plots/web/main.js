"use strict";
// Draws every figure of the page, and lets the buttons and sliders choose which trace is visible.
(function () {
  // No mode bar: it would lie over the legends. Drag to zoom, double-click to return (said in the page).
  const config = { responsive: true, displayModeBar: false };
  // On a touch screen a drag scrolls the page and does not zoom the figure.
  const touch = window.matchMedia("(pointer: coarse)").matches;
  document.querySelectorAll(".plot").forEach(function (plot) {
    const figure = JSON.parse(document.getElementById(plot.id + "-data").textContent);
    if (touch) figure.layout.dragmode = false;
    Plotly.newPlot(plot, figure.data, figure.layout, config);
  });
  document.querySelectorAll(".views").forEach(function (views) {
    const count = Number(views.dataset.count);
    const traces = Array.from({ length: count }, function (_, i) { return i; });
    const show = function (chosen) {
      const visible = traces.map(function (i) { return i === chosen; });
      Plotly.restyle(views.dataset.plot, { visible: visible }, traces);
    };
    views.querySelectorAll("button").forEach(function (button) {
      button.addEventListener("click", function () {
        views.querySelectorAll("button").forEach(function (other) {
          other.setAttribute("aria-pressed", String(other === button));
        });
        show(Number(button.dataset.view));
      });
    });
    const slider = views.querySelector("input");
    if (slider) {
      const labels = slider.dataset.labels.split("\n");
      slider.addEventListener("input", function () {
        views.querySelector("output").textContent = labels[Number(slider.value)];
        show(Number(slider.value));
      });
    }
  });
})();
