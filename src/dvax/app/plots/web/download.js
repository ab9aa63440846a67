// The data that a figure shows, as CSV, and the figure itself as PNG or SVG.

function plainText(html) {
  return (html ?? "").replace(/<br>/g, " ").replace(/<[^>]*>/g, "").trim();
}

function axisTitle(figure, letter, name) {
  const own = figure.layout[`${letter}axis${(name ?? letter).slice(1)}`]?.title?.text;
  // Panels that share the horizontal axis have its title under the last one.
  const any = axesOf(figure, letter).map((axis) => figure.layout[axis].title?.text).find(Boolean);
  return plainText(own ?? any) || letter;
}

// A flat bar has its title in the margin of the figure.
const barTitle = (figure, bar) => plainText(bar?.title?.text ?? figure.layout.title?.text);

function cell(value, values) {
  if (typeof value !== "number") return `"${String(value ?? "").replace(/"/g, '""')}"`;
  if (!Number.isFinite(value)) return "";
  return String(values instanceof Float32Array ? Number(value.toPrecision(7)) : value);
}

const isEqual = (a, b) => a.length === b.length && a.every((value, k) => value === b[k]);

// Columns [head, values] of the curves; curves over the same places share their column.
function curveColumns(figure, traces) {
  const columns = [];
  let before = null;
  for (const trace of traces) {
    const across = axisTitle(figure, "x", trace.xaxis), upward = axisTitle(figure, "y", trace.yaxis);
    if (!before || !isEqual(Array.from(before), Array.from(trace.x))) columns.push([across, trace.x]);
    before = trace.x;
    columns.push([trace.name ? `${trace.name}: ${upward}` : upward, trace.y]);
    if (trace.marker?.colorbar && trace.text) columns.push(["name", trace.text]);
    if (trace.marker?.colorbar) columns.push([barTitle(figure, trace.marker.colorbar), trace.marker.color]);
  }
  return columns;
}

// A map has one row for each cell; its axes may hold the edges of the cells.
function mapColumns(figure, traces) {
  const columns = [];
  for (const { x, y, z, xaxis, yaxis, colorbar, name } of traces) {
    const middle = (edges, count) =>
      edges.length > count ? Array.from({ length: count }, (_, k) => (edges[k] + edges[k + 1]) / 2) : edges;
    const across = middle(x, z[0].length), upward = middle(y, z.length);
    const cells = Array.from(z, (row) => Array.from(row, (value) => Number(cell(value, row) || NaN))).flat();
    columns.push(
      [axisTitle(figure, "x", xaxis), Array.from(upward, () => Array.from(across)).flat()],
      [axisTitle(figure, "y", yaxis), Array.from(upward, (v) => Array.from(across, () => v)).flat()],
      [barTitle(figure, colorbar) || name || "value", cells],
    );
  }
  return columns;
}

function csv(figure) {
  const shown = figure.data.filter((trace) => trace.visible !== false && trace.visible !== "legendonly");
  const maps = shown.filter((trace) => trace.type === "heatmap");
  // Without what has no read-out, such as the lines between nodes, and entries of the legend alone.
  const curves = shown.filter((trace) =>
    trace.type === "scatter" && trace.hoverinfo !== "skip" && trace.y?.length > 0 && trace.y[0] !== null);
  const lines = shown.filter((trace) => trace.type === "parcoords");
  const columns = [
    ...mapColumns(figure, maps), ...curveColumns(figure, curves),
    ...lines.flatMap(({ dimensions }) => dimensions.map(({ label, values }) => [plainText(label), values])),
  ];
  const length = Math.max(0, ...columns.map(([, values]) => values.length));
  const rows = Array.from({ length }, (_, k) =>
    columns.map(([, values]) => (k < values.length ? cell(values[k], values) : "")).join(","));
  return [columns.map(([head]) => cell(head)).join(","), ...rows].join("\r\n") + "\r\n";
}

function save(name, content) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([content], { type: "text/csv" }));
  link.download = name;
  link.click();
  URL.revokeObjectURL(link.href);
}

// Plotly makes one picture at a time.
let lastPicture = Promise.resolve();

function savePicture(figure, options) {
  // A picture that failed is reported in the console, and does not keep the next one from being made.
  lastPicture = lastPicture.catch(() => null)
    .then(() => Plotly.downloadImage(figure.plot, { filename: figure.plot.id, ...options }));
}

function startDownloads(figure) {
  const box = document.querySelector(`.tools[data-plot="${CSS.escape(figure.plot.id)}"]`);
  const actions = {
    reset: () => resetZoom(figure),
    csv: () => save(`${figure.plot.id}.csv`, csv(figure)),
    png: () => savePicture(figure, { format: "png", scale: 2 }),
    svg: () => savePicture(figure, { format: "svg" }),
  };
  for (const button of box.querySelectorAll("button")) {
    button.addEventListener("click", actions[button.dataset.action]);
  }
  box.hidden = false;
}
