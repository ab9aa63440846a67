"use strict";
// The page of dvax explore. It asks the server for the subject, sends the values of the sliders, and draws
// the answers. Only the newest question counts: the answer to an older one is dropped.
(function () {
  const at = function (id) { return document.getElementById(id); };
  const DIVISIONS = 400, PATIENCE = 250, RECOMPUTE = 300;
  const dark = window.matchMedia("(prefers-color-scheme: dark)");
  const touch = window.matchMedia("(pointer: coarse)").matches;
  // On a dark ground: colours of the theme that have too little contrast there, and what takes their place.
  const INSTEAD = {
    "#1f2933": "#e6ebf0", "#5f6b76": "#a3afba", "#dde3e8": "#36414c", "#0072B2": "#4aa8e8"
  };
  let subject, values = {}, base = {}, slider = null, answer = null, frame = null, last = null;
  let sequence = 0, started = null, waiting = null, dragging = false;
  const views = {}, moved = { frame: false };

  function element(tag, properties, children) {
    const made = Object.assign(document.createElement(tag), properties || {});
    (children || []).forEach(function (child) { made.append(child); });
    return made;
  }

  async function text(path, body) {
    const options = body === undefined ? {} : {
      method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(body)
    };
    const response = await fetch(path, options), content = await response.text();
    if (!response.ok) throw new Error(content);
    return content;
  }

  function parsed(content) {
    if (!dark.matches) return JSON.parse(content);
    Object.entries(INSTEAD).forEach(function (pair) {
      content = content.replaceAll('"' + pair[0] + '"', '"' + pair[1] + '"');
    });
    return JSON.parse(content);
  }

  function shown(value) { return Number(value.toPrecision(4)).toString(); }

  // Figures

  function time() { return last && last.frames ? last.frames.times[frame] : null; }

  function mark() {
    if (time() === null) return [];
    return [{
      type: "line", x0: time(), x1: time(), y0: 0, y1: 1, yref: "paper",
      line: { color: dark.matches ? "#ffffff" : "#1f2933", width: 1.5, dash: "dot" }
    }];
  }

  function card(drawing, place) {
    const id = "drawing-" + drawing.key;
    let box = at(id);
    if (box) return box;
    const plot = element("div", { className: "plot" });
    plot.setAttribute("role", "img");
    const save = ["png", "svg"].map(function (format) {
      const button = element("button", {
        type: "button", className: "small", textContent: format.toUpperCase(),
        title: "Save the figure as " + format.toUpperCase()
      });
      button.addEventListener("click", function () {
        Plotly.downloadImage(plot, {
          format: format, filename: "dvax-" + drawing.key, width: 1000,
          height: plot.layout.height, scale: format === "png" ? 2 : 1
        });
      });
      return button;
    });
    box = element("section", { id: id, className: "card" }, [
      element("div", { className: "head" }, [
        element("h2"), element("span", { className: "buttons", style: "margin:0" }, save)
      ]),
      element("div", { className: "views" }), plot, element("p", { className: "caption" })
    ]);
    place.append(box);
    watcher.observe(box);
    return box;
  }

  // A figure outside of the screen is drawn when it comes into sight.
  const watcher = new IntersectionObserver(function (entries) {
    entries.forEach(function (entry) {
      const box = entry.target;
      box.isAway = !entry.isIntersecting;
      if (!box.isAway && box.undrawn) draw(box.undrawn, box.parentNode);
    });
  }, { rootMargin: "150px" });

  function draw(drawing, place) {
    const box = card(drawing, place), plot = box.querySelector(".plot");
    box.querySelector("h2").textContent = drawing.title;
    box.querySelector(".caption").textContent = drawing.caption;
    plot.setAttribute("aria-label", drawing.title + ". " + drawing.caption);
    choose(drawing, box, plot);
    box.undrawn = box.isAway && plot.data ? drawing : null;
    if (box.undrawn) return plot;
    const style = getComputedStyle(document.documentElement), ground = style.getPropertyValue("--card");
    const layout = Object.assign({}, drawing.layout, {
      paper_bgcolor: ground, plot_bgcolor: ground, uirevision: "kept", autosize: true
    });
    if (drawing.hasTime) layout.shapes = (drawing.layout.shapes || []).concat(mark());
    if (touch) layout.dragmode = false;
    const isNew = !plot.data;
    Plotly.react(plot, drawing.data, layout, { responsive: true, displayModeBar: false });
    if (isNew && drawing.hasTime) {
      plot.on("plotly_click", function (event) { seek(event.points[0].x); });
    }
    plot.dataset.time = drawing.hasTime ? "yes" : "";
    return plot;
  }

  function choose(drawing, box, plot) {
    const row = box.querySelector(".views");
    if (!drawing.views) return;
    const names = drawing.views.labels;
    if (views[drawing.key] === undefined) views[drawing.key] = 0;
    const show = function (index) {
      names.forEach(function (_, k) { drawing.data[k].visible = k === index; });
    };
    show(views[drawing.key]);
    box.drawing = drawing;
    if (row.childElementCount) return;
    const redraw = function (index) {
      views[drawing.key] = index;
      const newest = box.drawing;
      names.forEach(function (_, k) { newest.data[k].visible = k === index; });
      Plotly.restyle(plot, { visible: names.map(function (_, k) { return k === index; }) },
        names.map(function (_, k) { return k; }));
    };
    row.append(drawing.views.name);
    names.forEach(function (name, index) {
      const button = element("button", { type: "button", textContent: name });
      button.setAttribute("aria-pressed", String(index === views[drawing.key]));
      button.addEventListener("click", function () {
        row.querySelectorAll("button").forEach(function (other) {
          other.setAttribute("aria-pressed", String(other === button));
        });
        redraw(index);
      });
      row.append(button);
    });
  }

  function drawAll(content) {
    last = parsed(content);
    last.text = content;
    at("error").hidden = true;
    if (last.frames) {
      const scrub = at("frame");
      scrub.max = last.frames.times.length - 1;
      // The time may have been moved since the question was sent.
      if (frame === null) frame = last.frames.frame;
      frame = Math.min(frame, last.frames.times.length - 1);
      scrub.value = frame;
      at("time").hidden = false;
      moment();
    }
    last.drawings.forEach(function (drawing, k) { draw(drawing, at(k ? "after" : "before")); });
    if (last.frames && last.frames.frame === frame) {
      last.frames.drawings.forEach(function (d) { draw(d, at("frames")); });
    } else if (last.frames) {
      show(frame);
    }
    numbers();
    at("prediction").textContent = last.prediction;
    at("notes").hidden = !last.notes.length;
    at("notes").textContent = last.notes.join("\n");
  }

  function numbers() {
    at("numbers").replaceChildren.apply(at("numbers"), last.numbers.map(function (n) {
      const box = element("div", { className: "number", title: n.meaning }, [
        element("div", { className: "name", textContent: n.name }),
        element("div", { className: "text", textContent: (n.text + " " + n.unit).trim() })
      ]);
      box.dataset.name = n.name;
      return box;
    }));
    at("numbers-card").hidden = !last.numbers.length;
    const status = at("certificate-status");
    status.textContent = last.certificate.status;
    status.className = "status " + last.certificate.status;
    at("certificate-text").replaceChildren.apply(at("certificate-text"),
      last.certificate.sentences.map(function (s) { return element("p", { textContent: s }); }));
  }

  // Questions

  function say(words) {
    if (at("status").textContent !== words) at("status").textContent = words;
  }

  window.setInterval(function () {
    const seconds = started === null ? 0 : (performance.now() - started) / 1000;
    at("clock").textContent = seconds > 0.15 ? seconds.toFixed(1) + " s" : "";
    if (seconds > 0.15) say("solving…");
  }, 100);

  function failed(words) {
    at("error").textContent = words;
    at("error").hidden = false;
  }

  async function solve(derivative) {
    // A question that has been running for long is given up; a fast one is waited for.
    if (started !== null && performance.now() - started < PATIENCE) {
      waiting = { derivative: derivative || (waiting !== null && waiting.derivative) };
      return;
    }
    const number = ++sequence, began = performance.now();
    waiting = null;
    started = began;
    let more = false;
    try {
      const content = await text("solve", {
        values: values, base: base, slider: slider, derivative: derivative, frame: frame
      });
      if (number !== sequence) return;
      const found = JSON.parse(content);
      if (found.error) {
        failed(found.error);
        say("not solved");
      } else if (!found.outdated) {
        answer = found.answer;
        drawAll(content);
        say("answered in " + Math.round(performance.now() - began) + " ms");
        more = found.hasMore && !dragging;
      }
    } catch (error) {
      if (number !== sequence) return;
      failed("The server does not answer: " + error.message);
      say("no answer");
    }
    started = null;
    document.body.dataset.answers = String(Number(document.body.dataset.answers || 0) + 1);
    if (waiting !== null) solve(waiting.derivative);
    else if (more) solve(true);
    else if (!dragging) plan();
  }

  // Sliders

  function position(p, value) {
    if (p.whole) return value;
    if (p.log) return DIVISIONS * Math.log(value / p.low) / Math.log(p.high / p.low);
    return DIVISIONS * (value - p.low) / (p.high - p.low);
  }

  function value(p, place) {
    if (p.whole) return place;
    const part = place / DIVISIONS;
    const exact = p.log ? p.low * Math.pow(p.high / p.low, part) : p.low + (p.high - p.low) * part;
    // Four digits can be read; near zero of a range that has both signs, so many of the range.
    const grain = p.log ? 0 : (p.high - p.low) / DIVISIONS / 10;
    return Math.abs(exact) < grain ? 0 : Number(exact.toPrecision(4));
  }

  function set(key, number, rest) {
    values = Object.assign({}, values);
    values[key] = number;
    if (slider !== key) {
      slider = key;
      document.querySelectorAll(".slider").forEach(function (row) {
        row.classList.toggle("chosen", row.dataset.key === key);
      });
    }
    dragging = !rest;
    if (rest) base = Object.assign({}, values);
    present(key);
    solve(false);
  }

  function present(key) {
    const p = subject.parameters.find(function (q) { return q.key === key; });
    const row = document.querySelector('.slider[data-key="' + key + '"]');
    const range = row.querySelector('[type="range"]'), field = row.querySelector('[type="number"]');
    const place = position(p, values[key]);
    if (Number(range.value) !== Math.round(place)) range.value = place;
    range.setAttribute("aria-valuetext", (shown(values[key]) + " " + p.unit).trim());
    if (document.activeElement !== field) field.value = shown(values[key]);
  }

  function addSlider(p) {
    const id = "slider-" + p.key.replaceAll(".", "-");
    const range = element("input", {
      type: "range", id: id, min: p.whole ? p.low : 0, max: p.whole ? p.high : DIVISIONS, step: 1
    });
    const field = element("input", { type: "number", step: "any", value: shown(p.value) });
    field.setAttribute("aria-label", p.label + ", as a number");
    const row = element("div", { className: "slider" }, [
      element("div", { className: "head" }, [
        element("label", { htmlFor: id, textContent: p.label, title: p.key }),
        element("span", { className: "value" }, [field, element("span", { textContent: p.unit })])
      ]),
      range
    ]);
    row.dataset.key = p.key;
    at("sliders").append(row);
    range.addEventListener("pointerdown", function () { base = Object.assign({}, values); });
    range.addEventListener("input", function () { set(p.key, value(p, Number(range.value)), false); });
    range.addEventListener("change", function () { set(p.key, value(p, Number(range.value)), true); });
    field.addEventListener("change", function () {
      const number = field.valueAsNumber;
      if (Number.isFinite(number)) set(p.key, p.whole ? Math.round(number) : number, true);
    });
    present(p.key);
  }

  function reset() {
    subject.parameters.forEach(function (p) { values[p.key] = p.value; });
    base = Object.assign({}, values);
    dragging = false;
    subject.parameters.forEach(function (p) { present(p.key); });
    solve(false);
  }

  // Time

  function moment() {
    const words = (shown(time()) + " " + last.frames.unit).trim();
    at("moment").textContent = "t = " + words;
    at("frame").setAttribute("aria-valuetext", words);
  }

  async function show(index) {
    frame = index;
    at("frame").value = index;
    moment();
    document.querySelectorAll(".plot").forEach(function (plot) {
      if (plot.dataset.time) Plotly.relayout(plot, { shapes: mark() });
    });
    if (moved.frame) return; // the request in flight is followed by one for the newest time
    moved.frame = true;
    try {
      let drawn = -1, of = null;
      while (drawn !== frame || of !== answer) {
        drawn = frame;
        of = answer;
        const found = parsed(await text("frame", { answer: of, frame: drawn }));
        if (found.outdated || of !== answer) continue;
        found.drawings.forEach(function (d) { draw(d, at("frames")); });
      }
    } catch (error) {
      failed("The server does not answer: " + error.message);
    } finally {
      moved.frame = false;
    }
  }

  function seek(t) {
    const times = last.frames.times;
    let nearest = 0;
    times.forEach(function (other, k) {
      if (Math.abs(other - t) < Math.abs(times[nearest] - t)) nearest = k;
    });
    show(nearest);
  }

  let player = null;
  function play() {
    const button = at("play");
    if (player !== null) {
      window.clearInterval(player);
      player = null;
    } else {
      player = window.setInterval(function () {
        if (!moved.frame) show((frame + 1) % last.frames.times.length);
      }, 80);
    }
    button.setAttribute("aria-pressed", String(player !== null));
    button.textContent = player === null ? "Play" : "Pause";
  }

  // The map of stability: it is computed while it is on the screen, and when the sliders rest.

  let mapOnScreen = false, mapAsked = "", mapTimer = null;
  function plan() {
    if (!subject.planes.length || !mapOnScreen) return;
    window.clearTimeout(mapTimer);
    mapTimer = window.setTimeout(map, RECOMPUTE);
  }

  async function map() {
    const across = at("across").value, upward = at("upward").value;
    if (across === upward) {
      at("map-state").textContent = "Choose two different parameters.";
      return;
    }
    const body = { values: values, across: across, upward: upward };
    const question = JSON.stringify(body) + String(dark.matches);
    if (question === mapAsked) return;
    mapAsked = question;
    at("map-state").textContent = "computing…";
    try {
      const found = parsed(await text("map", body));
      if (question !== mapAsked) return;
      at("map-state").textContent = found.error || "";
      if (found.error) return;
      const isNew = !at("drawing-stability"), plot = draw(found.drawing, at("map"));
      plot.axes = [across, upward];
      if (isNew) {
        plot.on("plotly_click", function (event) {
          const point = event.points[0];
          values = Object.assign({}, values);
          values[plot.axes[0]] = Number(point.x.toPrecision(4));
          set(plot.axes[1], Number(point.y.toPrecision(4)), true);
          present(plot.axes[0]);
        });
      }
    } catch (error) {
      at("map-state").textContent = "The server does not answer: " + error.message;
    }
  }

  function addMap() {
    if (!subject.planes.length) return;
    [["across", "model.b_x"], ["upward", "model.d_u"]].forEach(function (pair) {
      subject.planes.forEach(function (key) {
        const p = subject.parameters.find(function (q) { return q.key === key; });
        at(pair[0]).append(element("option", { value: key, textContent: p.label }));
      });
      at(pair[0]).value = pair[1];
      at(pair[0]).addEventListener("change", plan);
    });
    at("stability").hidden = false;
    new IntersectionObserver(function (entries) {
      mapOnScreen = entries[entries.length - 1].isIntersecting;
      if (mapOnScreen) plan();
    }).observe(at("stability"));
  }

  // Export

  async function save(kind) {
    try {
      const found = JSON.parse(await text("export", { kind: kind, values: values }));
      if (found.error) return failed(found.error);
      const link = element("a", {
        href: URL.createObjectURL(new Blob([found.text], { type: "text/plain" })), download: found.name
      });
      link.click();
      window.setTimeout(function () { URL.revokeObjectURL(link.href); }, 1000);
    } catch (error) {
      failed("The server does not answer: " + error.message);
    }
  }

  async function begin() {
    subject = JSON.parse(await text("subject"));
    document.title = subject.title + " · dvax explore";
    at("title").textContent = subject.title;
    at("subtitle").textContent = subject.subtitle;
    subject.parameters.forEach(function (p) { values[p.key] = p.value; });
    base = Object.assign({}, values);
    at("parameters").hidden = !subject.parameters.length;
    subject.parameters.forEach(addSlider);
    const names = { configuration: "Configuration (TOML)", code: "Code (Python)" };
    subject.exports.forEach(function (kind) {
      const button = element("button", { type: "button", textContent: names[kind] });
      button.addEventListener("click", function () { save(kind); });
      document.querySelector("#exports .buttons").append(button);
    });
    at("reset").addEventListener("click", reset);
    at("play").addEventListener("click", play);
    at("frame").addEventListener("input", function () { show(Number(at("frame").value)); });
    dark.addEventListener("change", function () {
      if (last) drawAll(last.text);
      plan();
    });
    addMap();
    solve(false);
  }

  begin().catch(function (error) { failed("The page cannot start: " + error.message); });
})();
