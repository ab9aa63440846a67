// Zoom: pictures over the same axis, such as time, are zoomed together.

const axesOf = (figure, letter) =>
  Object.keys(figure.layout).filter((key) => key.startsWith(`${letter}axis`));

// What an event of Plotly says of the horizontal axes: a range, null for all of it, or nothing.
function horizontal(event) {
  for (const [key, value] of Object.entries(event)) {
    if (/^xaxis\d*\.autorange$/.test(key) && value) return null;
    if (/^xaxis\d*\.range$/.test(key)) return value;
    const axis = /^(xaxis\d*)\.range\[0\]$/.exec(key);
    if (axis) return [value, event[`${axis[1]}.range[1]`]];
  }
  return undefined;
}

// Keep the ranges of an event in the state of its figure.
function rememberRanges(figure, event) {
  for (const [key, value] of Object.entries(event)) {
    const [, axis, what, end] = /^([xy]axis\d*)\.(range|autorange)(?:\[([01])\])?$/.exec(key) ?? [];
    if (!axis) continue;
    const state = figure.layout[axis];
    if (what === "autorange") {
      delete state.range;
      state.autorange = value;
    } else if (end === undefined) {
      Object.assign(state, { range: [...value], autorange: false });
    } else {
      state.range = state.range ? [...state.range] : [0, 1];
      state.range[Number(end)] = value;
      state.autorange = false;
    }
  }
}

function setHorizontal(figure, range) {
  for (const axis of axesOf(figure, "x")) {
    const initial = figure.initial[axis];
    figure.layout[axis].range = range === null ? initial.range && [...initial.range] : [...range];
    figure.layout[axis].autorange = range === null ? initial.autorange : false;
  }
  return draw(figure);
}

function groupOf(figure) {
  const zoom = figure.about.zoom;
  return Array.from(figures.values()).filter((other) => other !== figure && zoom && other.about.zoom === zoom);
}

function startZoom(figure) {
  figure.initial = {};
  for (const axis of [...axesOf(figure, "x"), ...axesOf(figure, "y")]) {
    const { range, autorange } = figure.layout[axis];
    figure.initial[axis] = { range: range && [...range], autorange };
  }
  figure.plot.on("plotly_relayout", (event) => {
    rememberRanges(figure, event);
    const range = horizontal(event);
    if (range !== undefined) groupOf(figure).forEach((other) => setHorizontal(other, range));
  });
}

// Show all of a figure again, and all of the horizontal axes that were zoomed with it.
function resetZoom(figure) {
  for (const [axis, { range, autorange }] of Object.entries(figure.initial)) {
    Object.assign(figure.layout[axis], { range: range && [...range], autorange });
  }
  return Promise.all([draw(figure), ...groupOf(figure).map((other) => setHorizontal(other, null))]);
}
