// The figures of the page, and how each is drawn in light and dark colours.

// key: { plot, data, layout, about }. `data` and `layout` are the state of a figure: whatever changes it
// writes there and draws again.
const figures = new Map();
const systemScheme = window.matchMedia("(prefers-color-scheme: dark)");
const scheme = { chosen: null, isPrinting: false, dark: {} };

function isDark() {
  if (scheme.isPrinting) return false;
  return scheme.chosen === null ? systemScheme.matches : scheme.chosen === "dark";
}

// A copy with the colours of a dark page. Arrays of numbers stay the same objects, so that Plotly finds
// them unchanged.
function inScheme(node, isColour) {
  if (typeof node === "string") return (isColour && isDark() && scheme.dark[node.toUpperCase()]) || node;
  if (node === null || typeof node !== "object" || ArrayBuffer.isView(node)) return node;
  if (Array.isArray(node)) {
    const isList = isColour || (node.length > 0 && Object.getPrototypeOf(node[0] ?? 0) === Object.prototype);
    return isList ? node.map((item) => inScheme(item, isColour)) : node;
  }
  const copy = {};
  for (const [key, value] of Object.entries(node)) {
    copy[key] = inScheme(value, isColour || key.toLowerCase().includes("color"));
  }
  return copy;
}

// No mode bar: it would lie over the legends. The page has buttons below each figure.
const CONFIG = { responsive: true, displayModeBar: false, doubleClick: "reset+autosize" };

function draw(figure) {
  return Plotly.react(figure.plot, inScheme(figure.data), inScheme(figure.layout), CONFIG);
}

function drawAll() {
  return Promise.all(Array.from(figures.values(), draw));
}

// Legend entries that a reader has switched off stay off when the figure is drawn again.
function rememberVisibility(figure) {
  figure.plot.on("plotly_restyle", ([update, indices]) => {
    if (!("visible" in update)) return;
    indices.forEach((trace, k) => {
      const value = update.visible;
      figure.data[trace].visible = Array.isArray(value) ? value[k % value.length] : value;
    });
  });
}

function setScheme(chosen) {
  scheme.chosen = chosen;
  document.documentElement.style.colorScheme = scheme.isPrinting ? "light" : (chosen ?? "");
  return drawAll();
}

function startScheme() {
  const button = document.getElementById("scheme");
  const name = () => { button.textContent = isDark() ? "Light colours" : "Dark colours"; };
  name();
  button.hidden = false;
  button.addEventListener("click", () => {
    const wanted = isDark() ? "light" : "dark";
    // The choice that the system has, too, follows the system again.
    setScheme(systemScheme.matches === (wanted === "dark") ? null : wanted);
    name();
  });
  systemScheme.addEventListener("change", () => { if (scheme.chosen === null) drawAll(); name(); });
}
