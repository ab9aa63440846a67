// Draws every figure of the page and connects its controls.

const NARROW = 640;

async function start() {
  startScheme();
  startTables();
  startPrinting();
  if (document.querySelector(".plot") === null) return;
  if (typeof DecompressionStream === "undefined") {
    document.getElementById("old-browser").hidden = false;
    return;
  }
  // In the place of a script of its own, which a page from a disk could not load.
  const plotly = document.createElement("script");
  plotly.textContent = await unpack("plotly");
  document.head.append(plotly);
  const content = JSON.parse(await unpack("data"));
  scheme.dark = content.dark;
  // On a touch screen a drag scrolls the page and does not zoom the figure.
  const isTouch = window.matchMedia("(pointer: coarse)").matches;
  for (const [key, { figure, about }] of Object.entries(content.figures)) {
    const { data, layout } = decoded(figure);
    if (isTouch) layout.dragmode = false;
    if (window.innerWidth < NARROW) data.forEach(shrinkMarkers);
    const state = { plot: document.getElementById(key), data, layout, about: decoded(about) };
    figures.set(key, state);
    await draw(state);
    rememberVisibility(state);
    startZoom(state);
    startDownloads(state);
    if (about.views > 0) startViews(state);
    if (about.frames) await startFrames(state);
  }
}

// On a phone large markers, such as the nodes of a network, would cover each other.
function shrinkMarkers({ marker, textfont }) {
  if (marker?.size > 10) marker.size *= 0.6;
  if (textfont?.size) textfont.size *= 0.8;
}

// Buttons that choose which of the first traces is visible.
function startViews(figure) {
  const buttons = Array.from(document.querySelectorAll(`.views[data-plot="${CSS.escape(figure.plot.id)}"] button`));
  buttons.forEach((button, chosen) => {
    button.addEventListener("click", () => {
      buttons.forEach((other) => other.setAttribute("aria-pressed", String(other === button)));
      buttons.forEach((_, k) => { figure.data[k].visible = k === chosen; });
      draw(figure);
    });
  });
}

// On paper: everything unfolded, light colours.
function startPrinting() {
  let folded = [];
  window.addEventListener("beforeprint", () => {
    folded = Array.from(document.querySelectorAll("details:not([open])"));
    folded.forEach((details) => { details.open = true; });
    scheme.isPrinting = true;
    setScheme(scheme.chosen);
  });
  window.addEventListener("afterprint", () => {
    folded.forEach((details) => { details.open = false; });
    scheme.isPrinting = false;
    setScheme(scheme.chosen);
  });
}

window.report = { ready: start(), figures };
