// A slider that goes through the instants of a figure, and the line that marks the instant in the map
// that the figure is a section of.

const SECONDS_TO_PLAY = 12, SECONDS_PER_FRAME = 0.08;

function valuesAt(change, k) {
  if (change.values) return change.values[k];
  const [key, trace] = change.section;
  const rows = figures.get(key).data[trace].z;
  return Float64Array.from(rows, (row) => row[k]);
}

function setAttribute(trace, path, value) {
  const keys = path.split(".");
  const last = keys.pop();
  const place = keys.reduce((node, key) => node[key], trace);
  place[last] = value;
}

function showFrame(figure, k) {
  const { times, changes } = figure.about.frames;
  for (const change of changes) setAttribute(figure.data[change.trace], change.attribute, valuesAt(change, k));
  const drawn = [draw(figure)];
  const map = mapOf(figure);
  if (map) {
    const line = (width, color) => ({
      type: "line", x0: times[k], x1: times[k], y0: 0, y1: 1, yref: "paper", line: { width, color },
    });
    map.layout.shapes = [line(4, "#FFFFFF"), line(1.5, "#1F2933")];
    drawn.push(draw(map));
  }
  return Promise.all(drawn);
}

function mapOf(figure) {
  const section = figure.about.frames.changes.find((change) => change.section);
  return section && figures.get(section.section[0]);
}

function startFrames(figure) {
  const box = document.querySelector(`.frames[data-plot="${CSS.escape(figure.plot.id)}"]`);
  const slider = box.querySelector("input"), play = box.querySelector("button");
  const { times, labels } = figure.about.frames, last = times.length - 1;
  let timer = null;
  const show = () => {
    box.querySelector("output").textContent = labels[Number(slider.value)];
    slider.setAttribute("aria-valuetext", labels[Number(slider.value)]);
    return showFrame(figure, Number(slider.value));
  };
  const stop = () => {
    clearInterval(timer);
    timer = null;
    play.textContent = "Play";
  };
  slider.addEventListener("input", () => { stop(); show(); });
  play.addEventListener("click", () => {
    if (timer !== null) return stop();
    play.textContent = "Pause";
    if (Number(slider.value) === last) slider.value = 0;
    const step = Math.max(1, Math.round((last * SECONDS_PER_FRAME) / SECONDS_TO_PLAY));
    timer = setInterval(() => {
      slider.value = Math.min(last, Number(slider.value) + step);
      show();
      if (Number(slider.value) === last) stop();
    }, 1000 * SECONDS_PER_FRAME);
  });
  const map = mapOf(figure);
  if (map) {
    map.plot.on("plotly_click", (event) => {
      const distance = Array.from(times, (t) => Math.abs(t - event.points[0].x));
      slider.value = distance.indexOf(Math.min(...distance));
      stop();
      show();
    });
  }
  return show();
}
