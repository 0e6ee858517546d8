// The bench: each change of the design is sent to the server, one request at a time; the last change is always sent.
"use strict";
(function () {
  var setting = JSON.parse(document.getElementById("setting").textContent), design = setting.design, labels = setting.labels;
  var svg = workbench.svg, html = workbench.html, shown = workbench.shown, by = function (id) { return document.getElementById(id); };
  var stand = document.querySelector(".stand"), say = document.querySelector(".say"), hint = say.textContent;
  var answer = null, busy = false, waiting = false, calm = matchMedia("(prefers-reduced-motion: reduce)").matches;
  var frame = setting.points, plate = Array.isArray(setting.length) && !frame, flat = plate || frame, sides = [].concat(setting.length), usual = Math.floor(Math.log10(design.weight[0]));
  var COLOURS = ["#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9"];

  document.querySelector(".theme").addEventListener("click", function () {
    var root = document.documentElement, dark = matchMedia("(prefers-color-scheme: dark)").matches;
    root.dataset.theme = (root.dataset.theme || (dark ? "dark" : "light")) === "dark" ? "light" : "dark";
  });

  function post(path, content) {
    return fetch(path, { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(content) })
      .then(function (r) { return r.json(); });
  }
  function ask() {
    if (busy) { waiting = true; return; }
    busy = true;
    waiting = false;
    var start = performance.now();
    post("/try", design).then(function (found) {
      if (found.error) { say.textContent = found.error; say.className = "say bad"; }
      else { answer = found; say.textContent = hint; say.className = "say"; present(); }
      document.body.dataset.ms = (performance.now() - start).toFixed(1);
      document.body.dataset.answers = +(document.body.dataset.answers || 0) + 1;
      document.querySelectorAll(".cards, .figures").forEach(function (e) { e.classList.toggle("stale", !!found.error); });
    }).catch(function () { say.textContent = "The bench no longer answers: start it again with `workbench bench`."; say.className = "say bad"; })
      .then(function () { busy = false; if (waiting) ask(); });
  }

  // legend of the marks
  var TRIANGLE = "M0,-10L8,6H-8Z", RING = "M0,-6A6,6 0 1 1 -0.01,-6Z", HAMMER = "M-9,-6H9V3H2V12H-2V3H-9Z";
  (function () {
    var box = document.querySelector(".key"), LINE = "M-11,0H11", BLOCK = "M-9,-6H9V6H-9Z", thin = { fill: "none", stroke: "var(--soft)", "stroke-width": 1.4 };
    var marks = [[TRIANGLE, { fill: "var(--bad)" }, "actuator"], [RING, { fill: "var(--paper)", stroke: "var(--ink)", "stroke-width": 1.5 }, "sensor"], [HAMMER, { fill: "var(--ink)" }, "impulse"]];
    if (frame) marks.push(["M0,-3A3,3 0 1 1 -0.01,-3Z", { fill: "var(--soft)" }, "point, beside its node in its direction"]);
    if (plate) marks.push([BLOCK, { fill: "rgb(202,0,32)" }, "up"], [BLOCK, { fill: "rgb(5,113,176)" }, "down"]);
    else marks.push([LINE, { fill: "none", stroke: "#0072B2", "stroke-width": 2.6 }, "controlled" + (frame ? ", neighbouring nodes joined" : "")], [LINE, thin, "without control"]);
    marks.forEach(function (mark) {
      var entry = html("span", {}, box);
      svg("path", Object.assign({ d: mark[0] }, mark[1]), svg("svg", { viewBox: "-12 -12 24 24", "aria-hidden": "true" }, entry));
      entry.appendChild(document.createTextNode(mark[2]));
    });
  })();

  // numbers
  var cards = {};
  [["residual", labels.residual], ["effort", labels.effort], ["peak_force", labels.peak_force], ["stable", "closed loop"]].forEach(function (card) {
    var box = html("div", {}, document.querySelector(".cards"));
    cards[card[0]] = html("b", { id: card[0] }, box, "–");
    html("span", {}, box, card[1]);
  });

  // controls
  var controls = document.querySelector(".controls"), count, law, sliders = [], master;
  function row(text) { var label = html("label", {}, controls); html("span", {}, label, text); return label; }
  function build() {
    controls.textContent = "";
    var a = row("control law");
    law = html("select", { id: "law" }, a);
    setting.laws.forEach(function (name) { html("option", {}, law, name); });
    law.value = design.law;
    law.addEventListener("change", function () { design.law = law.value; build(); ask(); });
    var c = row("modes controlled"), reading;
    count = html("input", { id: "controlled", type: "range", min: 1, max: setting.omega.length, value: design.controlled }, c);
    reading = html("output", {}, c, design.controlled);
    count.addEventListener("input", function () {
      design.controlled = +count.value;
      while (design.weight.length < design.controlled) design.weight.push(design.weight[design.weight.length - 1]);
      design.weight.length = design.controlled;
      reading.textContent = count.value;
      weights();
      ask();
    });
    transducers("actuators", "actuators");
    transducers("sensors", "sensors (none: exact modal coordinates)");
    var t = row(labels.final_time), time = html("input", { id: "time", type: "number", min: 0, step: "any", value: +design.final_time.toPrecision(4) }, t);
    time.addEventListener("change", function () { if (+time.value > 0) { design.final_time = +time.value; ask(); } });
    weights();
  }
  function transducers(kind, text) {
    var label = row(text), reading = html("output", {}, label, design[kind].length);
    [["−", -1], ["+", 1]].forEach(function (way) {
      html("button", { type: "button", "aria-label": (way[1] > 0 ? "add to " : "take from ") + kind }, label, way[0]).addEventListener("click", function () {
        if (way[1] < 0 && design[kind].length > (kind === "actuators" ? 1 : 0)) design[kind].pop();
        if (way[1] > 0 && design[kind].length < setting.most) design[kind].push(gap(flat ? design.actuators.concat(design.sensors, [design.impulse_at]) : design[kind]));
        reading.textContent = design[kind].length;
        handles();
        ask();
      });
    });
  }
  // the middle of the widest gap between the present places; on a plate the point farthest from these and the edges
  function gap(places) {
    if (frame) {
      var taken = places.map(spotOf), away = function (name) { var p = spotOf(name); return Math.min.apply(null, taken.map(function (q) { return Math.hypot(p[0] - q[0], p[1] - q[1]); })); };
      return frame.names.reduce(function (one, other) { return away(other) > away(one) ? other : one; });
    }
    if (plate) {
      var spots = setting.x.filter(function (_, i) { return i % 7 === 0; }).map(function (p) { return held("actuators", p); });
      var far = function (p) { return Math.min.apply(null, places.map(function (q) { return Math.hypot(p[0] - q[0], p[1] - q[1]); }).concat([p[0], sides[0] - p[0], p[1], sides[1] - p[1]])); };
      return spots.reduce(function (one, other) { return far(other) > far(one) ? other : one; });
    }
    var all = [0].concat(places.slice().sort(function (a, b) { return a - b; }), [setting.length]), best = 0;
    for (var i = 1; i < all.length - 1; i++) if (all[i + 1] - all[i] > all[best + 1] - all[best]) best = i;
    return 0.5 * (all[best] + all[best + 1]);
  }
  // the handle of a named point, beside its node in its direction, and the point nearest to a position, px
  function spotOf(name) {
    var i = frame.names.indexOf(name), p = frame.spots[i], way = frame.ways[i];
    return [X(p[0]) + frame.apart * way[0], Y(p[1]) - frame.apart * way[1]];
  }
  function nearest(p) {
    var far = frame.names.map(spotOf).map(function (q) { return Math.hypot(p[0] - q[0], p[1] - q[1]); });
    return frame.names[far.indexOf(Math.min.apply(null, far))];
  }
  function weights() {
    sliders.forEach(function (s) { s.remove(); });
    sliders = [];
    var imsc = design.law === "IMSC", n = imsc ? design.controlled : 1;
    for (var r = 0; r < n; r++) (function (r) {
      var label = row(imsc ? "R of mode " + (r + 1) : "R"), reading;
      var slider = html("input", { type: "range", min: usual - 3, max: usual + 3, step: 0.02, value: Math.log10(design.weight[r]), "aria-label": "weight " + (r + 1) }, label);
      reading = html("output", {}, label, shown(design.weight[r]));
      slider.addEventListener("input", function () {
        design.weight[r] = +Math.pow(10, +slider.value).toPrecision(4);
        reading.textContent = shown(design.weight[r]);
        ask();
      });
      sliders.push(label);
    })(r);
  }

  // the structure with its actuators and sensors: a line seen from the side, or a plate seen from above
  var X, Y, line, still, free, beamY, reach = 1, INSET = 0.3, BESIDE_NODE = 18;
  function layout() {
    var width = stand.clientWidth;
    if (!width) return;
    stand.textContent = "";
    var height = frame ? front(width) : plate ? above(width) : aside(width);
    stand.setAttribute("viewBox", "0 0 " + width + " " + height);
    stand.setAttribute("height", height);
    free = svg("g", {}, stand);
    handles();
    animate();
  }
  function aside(width) {
    var height = Math.max(240, Math.min(330, 0.4 * width));
    beamY = 0.42 * height;
    X = workbench.scale([0, setting.length], false, 18, width - 18);
    svg("line", { x1: X(0), x2: X(setting.length), y1: beamY, y2: beamY, stroke: "var(--line)", "stroke-width": 2 }, stand);
    along(height - 20, width);
    still = svg("path", { fill: "none", stroke: "var(--soft)", "stroke-width": 1.2, opacity: 0.6 }, stand);
    line = svg("path", { class: "track", fill: "none", stroke: "#0072B2", "stroke-width": 2.6 }, stand);
    return height;
  }
  // the scale along x, its label below
  function along(y, width) {
    svg("text", { x: 0.5 * (X(0) + X(sides[0])), y: y + 16, "text-anchor": "middle", class: "axis" }, stand, labels.x);
    workbench.ticks({}, [0, sides[0]], Math.round(width / 90)).forEach(function (t) {
      svg("text", { x: X(t[0]), y: y, "text-anchor": "middle" }, stand, t[1]);
    });
  }
  // the frame from the front, its elements moving
  function front(width) {
    var pad = 46, scale = Math.min((width - 2 * pad) / sides[0], 440 / sides[1]), w = scale * sides[0], h = scale * sides[1], left = 0.5 * (width - w);
    X = workbench.scale([0, sides[0]], false, left, left + w);
    Y = workbench.scale([0, sides[1]], false, pad + h, pad);
    frame.sway = 0.07 * Math.max(w, h);
    var near = Infinity;  // the least distance of two nodes, px
    frame.lines.forEach(function (ends) {
      var a = frame.rest[ends[0]], b = frame.rest[ends[1]];
      near = Math.min(near, scale * Math.hypot(a[0] - b[0], a[1] - b[1]));
    });
    frame.apart = Math.max(6, Math.min(BESIDE_NODE, 0.45 * near));
    still = svg("path", { fill: "none", stroke: "var(--soft)", "stroke-width": 1.2, opacity: 0.6 }, stand);
    line = svg("path", { class: "track", fill: "none", stroke: "#0072B2", "stroke-width": 2.6 }, stand);
    frame.names.forEach(function (name) {
      var p = spotOf(name);
      svg("title", {}, svg("circle", { cx: p[0], cy: p[1], r: 2.4, fill: "var(--soft)" }, stand), name);
    });
    return h + 2 * pad;
  }
  function joined(values) {
    var size = frame.sway / reach, spot = function (i) { return (X(frame.rest[i][0]) + size * values[2 * i]).toFixed(1) + "," + (Y(frame.rest[i][1]) - size * values[2 * i + 1]).toFixed(1); };
    return frame.lines.map(function (ends) { return "M" + spot(ends[0]) + "L" + spot(ends[1]); }).join("");
  }
  // the plate under control, and a smaller one without control
  function above(width) {
    var left = 50, small = width > 640, most = (small ? 1 - INSET : 1) * width - left - 16;
    var scale = Math.min(most / sides[0], 420 / sides[1]), w = scale * sides[0], h = scale * sides[1];
    X = workbench.scale([0, sides[0]], false, left, left + w);
    Y = workbench.scale([0, sides[1]], false, 12 + h, 12);
    line = field("track", left, 12, w, h);
    along(28 + h, w);
    svg("text", { x: 12, y: 12 + 0.5 * h, transform: "rotate(-90 12 " + (12 + 0.5 * h) + ")", "text-anchor": "middle", class: "axis" }, stand, labels.y);
    workbench.ticks({}, [0, sides[1]], Math.max(2, Math.round(h / 90))).forEach(function (t) {
      svg("text", { x: left - 6, y: Y(t[0]) + 4, "text-anchor": "end" }, stand, t[1]);
    });
    var share = Math.min(INSET * width - 20, 0.55 * w) / w, x = small ? left + w + 24 : left, y = small ? 12 : 60 + h;
    still = field("still", x, y, share * w, share * h);
    svg("text", { x: x, y: y + share * h + 16 }, stand, "without control");
    return Math.max(h + 50, y + share * h + 24);
  }
  function field(name, x, y, w, h) {
    var image = svg("image", { class: name, x: x, y: y, width: w, height: h, preserveAspectRatio: "none" }, stand);
    svg("rect", { x: x, y: y, width: w, height: h, fill: "none", stroke: "var(--soft)" }, stand);
    return image;
  }
  var canvas = document.createElement("canvas"), paint = canvas.getContext("2d");
  // red up and blue down, more intense for larger displacements; one pixel per cell of the plate
  function painted(values) {
    var nx = setting.cells[0], ny = setting.cells[1];
    canvas.width = nx;
    canvas.height = ny;
    var spots = paint.createImageData(nx, ny);
    values.forEach(function (w, i) {
      var k = 4 * ((ny - 1 - i % ny) * nx + Math.floor(i / ny)), v = Math.max(-1, Math.min(1, w / reach));
      spots.data.set(v > 0 ? [202, 0, 32, 255 * v] : [5, 113, 176, -255 * v], k);
    });
    paint.putImageData(spots, 0, 0);
    return canvas.toDataURL();
  }
  // a label with the place of each handle, where it covers no other handle, no label and no member at rest
  var tags = [], BESIDE = [[13, 4, "start"], [-13, 4, "end"], [0, 24, "middle"], [0, -15, "middle"], [12, 19, "start"], [-12, 19, "end"], [12, -10, "start"], [-12, -10, "end"]];
  function boxOf(spot, way, width) {
    var x = spot[0] + way[0] - (way[2] === "middle" ? width / 2 : way[2] === "end" ? width : 0), y = spot[1] + way[1];
    return [x - 1, y - 11, x + width + 1, y + 3];
  }
  function shared(a, b) { return Math.max(0, Math.min(a[2], b[2]) - Math.max(a[0], b[0])) * Math.max(0, Math.min(a[3], b[3]) - Math.max(a[1], b[1])); }
  // length of the part of a segment inside a box (Liang and Barsky 1984)
  function inside(box, s) {
    var t = [0, 1], d = [s[2] - s[0], s[3] - s[1]];
    for (var k = 0; k < 2; k++) {
      if (!d[k] && (s[k] < box[k] || s[k] > box[k + 2])) return 0;
      if (!d[k]) continue;
      var a = (box[k] - s[k]) / d[k], b = (box[k + 2] - s[k]) / d[k];
      t = [Math.max(t[0], Math.min(a, b)), Math.min(t[1], Math.max(a, b))];
    }
    return Math.max(0, t[1] - t[0]) * Math.hypot(d[0], d[1]);
  }
  function settle() {
    var width = stand.viewBox.baseVal.width, height = stand.viewBox.baseVal.height, members = [];
    if (frame) members = frame.lines.map(function (ends) { return [].concat.apply([], ends.map(function (i) { return [X(frame.rest[i][0]), Y(frame.rest[i][1])]; })); });
    if (plate) members = [[0, 0, 1, 0], [1, 0, 1, 1], [1, 1, 0, 1], [0, 1, 0, 0]].map(function (s) { return [X(s[0] * sides[0]), Y(s[1] * sides[1]), X(s[2] * sides[0]), Y(s[3] * sides[1])]; });
    var taken = tags.map(function (tag) { var s = tag.spot; return [s[0] - 9, s[1] - 10, s[0] + 9, s[1] + 12]; });
    if (!flat) taken.push([0, beamY - 2, width, beamY + 2]);
    stand.querySelectorAll(":scope > text").forEach(function (text) { var b = text.getBBox(); taken.push([b.x, b.y, b.x + b.width, b.y + b.height]); });
    tags.forEach(function (tag, own) {
      var best = null, long = tag.label.getComputedTextLength();
      tag.ways.forEach(function (way, i) {
        var box = boxOf(tag.spot, way, long), cost = 0.1 * i;
        taken.forEach(function (other, k) { if (k !== own) cost += shared(box, other); });
        members.forEach(function (s) { cost += 4 * inside(box, s); });
        cost += 50 * (Math.max(0, -box[0]) + Math.max(0, box[2] - width) + Math.max(0, -box[1]) + Math.max(0, box[3] - height));
        if (!best || cost < best.cost) best = { cost: cost, way: way, box: box };
      });
      taken.push(best.box);
      tag.label.setAttribute("x", best.way[0]);
      tag.label.setAttribute("y", best.way[1]);
      tag.label.setAttribute("text-anchor", best.way[2]);
    });
  }
  function handles() {
    if (!free) return;
    free.textContent = "";
    tags = [];
    design.actuators.forEach(function (_, i) { handle("actuators", i, stand.viewBox.baseVal.height - 56, TRIANGLE, "var(--bad)", "actuator " + (i + 1)); });
    design.sensors.forEach(function (_, i) { handle("sensors", i, beamY, RING, "var(--paper)", "sensor " + (i + 1)); });
    handle("impulse_at", null, 20, HAMMER, flat ? "var(--ink)" : "var(--soft)", "hammer");
    settle();
  }
  // the nearest place at which the whole patch is on the structure
  function held(kind, place) {
    if (frame) return nearest(place);
    var inside = [].concat(place).map(function (v, d) {
      var half = kind === "actuators" && setting.patch.length ? setting.patch[d] / 2 : 0;
      return +Math.max(half, Math.min(sides[d] - half, v)).toPrecision(5);
    });
    return plate ? inside : inside[0];
  }
  function handle(kind, i, lane, path, fill, name) {
    var g = svg("g", { class: "handle " + kind, tabindex: 0, role: "slider", "aria-label": name, "aria-valuemin": 0, "aria-valuemax": frame ? frame.names.length - 1 : sides[0] }, free);
    if (kind === "actuators" && setting.patch.length) {
      var w = X(setting.patch[0]) - X(0), h = plate ? Y(0) - Y(setting.patch[1]) : 6;
      svg("rect", { x: -w / 2, y: plate ? -h / 2 : 7, width: w, height: h, fill: "var(--bad)", "fill-opacity": 0.18, stroke: "var(--bad)" }, g);
    }
    svg("circle", { class: "halo", r: 20 }, g);
    svg("path", { d: path, fill: fill, stroke: flat && kind !== "sensors" ? "var(--paper)" : "var(--ink)", "stroke-width": kind === "sensors" ? 1.5 : flat ? 1 : 0 }, g);
    // along a member actuators and sensors have their own rows, with labels below
    var rows = [20, 33].map(function (y) { return [0, y, "middle"]; }), ways = flat ? BESIDE : kind === "impulse_at" ? [[14, 5, "start"], [-14, 5, "end"]] : rows;
    var tag = { label: svg("text", { class: "tag" }, g), spot: [0, 0], ways: ways };
    tags.push(tag);
    function at() { return i === null ? design[kind] : design[kind][i]; }
    function put() {
      var p = at(), spot = frame ? spotOf(p) : plate ? [X(p[0]), Y(p[1])] : [X(p), lane];
      var text = frame ? at() : [].concat(p).map(function (v) { return v.toPrecision(3); }).join(", ");
      g.setAttribute("transform", "translate(" + spot + ")");
      g.setAttribute("aria-valuenow", frame ? frame.names.indexOf(p) : [].concat(p)[0]);
      if (flat) g.setAttribute("aria-valuetext", text);
      tag.label.textContent = text;
      tag.spot = spot;
    }
    function move(place) {
      place = held(kind, place);
      if (i === null) design[kind] = place; else design[kind][i] = place;
      put();
      settle();
      ask();
    }
    g.addEventListener("pointerdown", function (e) { g.setPointerCapture(e.pointerId); g.focus(); e.preventDefault(); g.dragged = true; });
    g.addEventListener("pointermove", function (e) {
      if (!g.dragged) return;
      var box = stand.getBoundingClientRect(), p = [e.clientX - box.left, e.clientY - box.top];
      move(frame ? p : plate ? [X.back(p[0]), Y.back(p[1])] : X.back(p[0]));
    });
    ["pointerup", "pointercancel"].forEach(function (end) { g.addEventListener(end, function () { g.dragged = false; }); });
    g.addEventListener("keydown", function (e) {
      var way = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowDown: [0, -1], ArrowUp: [0, 1] }[e.key], step = e.shiftKey ? 1000 : 100;
      if (!way || (way[1] && !flat)) return;
      e.preventDefault();
      if (frame) {
        var n = frame.names.length, next = frame.names[(frame.names.indexOf(at()) + way[0] + way[1] + n) % n];
        return move(spotOf(next));
      }
      move([].concat(at()).map(function (v, d) { return v + way[d] * sides[d] / step; }));
    });
    put();
  }

  // results
  function present() {
    ["residual", "effort", "peak_force"].forEach(function (name) { cards[name].textContent = figures(answer[name]); });
    var undamped = answer.stable && answer.undamped > 0;
    cards.stable.textContent = undamped ? "undamped" : answer.stable ? "stable" : "unstable";
    cards.stable.nextSibling.textContent = "closed loop; " + (undamped ?
      answer.undamped + (answer.undamped > 1 ? " pairs of poles" : " pair of poles") + " on the imaginary axis" :
      "real part of the rightmost pole " + shown(answer.rightmost) + " " + labels.rate);
    cards.stable.className = undamped ? "" : answer.stable ? "good" : "bad";
    reach = 1e-12;
    for (var k = 0; k < answer.time.length; k += 5) displaced(k).concat(idle(k)).forEach(function (w) { reach = Math.max(reach, Math.abs(w)); });
    animate();
    var n = answer.by_mode.length, numbers = answer.by_mode.map(function (_, i) { return i + 1; }).slice(design.controlled);
    var work = answer.by_mode.slice(design.controlled).map(function (w) { return w || 0; }), top = Math.max.apply(null, work.concat([1e-300]));
    figure("work", { x: axis("residual mode", [design.controlled + 0.4, Math.max(n, design.controlled + 1) + 0.6], false, numbers.map(function (v) { return [v, String(v)]; })),
      y: axis(labels.by_mode, [Math.min(0, 1.1 * Math.min.apply(null, work.concat([0]))), 1.1 * top]), title: work.length ? "spillover work by residual mode" : "no residual mode",
      marks: [{ kind: "bars", boxes: work.map(function (w, i) { return [numbers[i] - 0.35, numbers[i] + 0.35, 0, w]; }), colours: [COLOURS[0]], label: "W_r" }] });
    var re = answer.poles.map(function (p) { return p[0]; }), im = answer.poles.map(function (p) { return p[1]; });
    var left = Math.min.apply(null, re), right = Math.max.apply(null, re), pad = 0.08 * (right - left || 1);
    figure("poles", { x: axis(labels.real, [left - pad, Math.max(right, 0) + pad]), y: axis(labels.imaginary, [-0.03 * Math.max.apply(null, im), 1.08 * Math.max.apply(null, im)]),
      title: "closed-loop poles", marks: [{ kind: "rule", axis: "x", at: 0, colour: "#8a8a8a", width: 1, dash: "", alpha: 1 },
        { kind: "line", x: re, y: im, width: 0, marker: "x", size: 9, colour: COLOURS[1], alpha: 1, label: "poles" }] });
    var energy = answer.energy.map(function (v) { return v > 0 ? v : null; }), seen = energy.filter(function (v) { return v; });
    figure("energy", { x: axis(labels.time, [0, answer.time[answer.time.length - 1]]), y: axis(labels.energy, [0.7 * Math.min.apply(null, seen), 1.4 * Math.max.apply(null, seen)], true),
      title: "energy after the impulse", marks: [curve(answer.time, energy, 2)] });
    var forces = [].concat.apply([], answer.forces), most = 1.1 * Math.max.apply(null, forces.map(Math.abs).concat([1e-300]));
    figure("forces", { x: axis(labels.time, [0, answer.time[answer.time.length - 1]]), y: axis(labels.forces, [-most, most]), title: "actuator forces", legend: answer.forces.length > 1,
      marks: answer.forces.map(function (f, i) { var c = curve(answer.time, f, i); c.label = "F" + (i + 1); return c; }) });
  }
  // four digits, with a power of ten where there would be many zeros
  function figures(v) {
    if (v === null) return "∞";
    return workbench.shown(+v.toPrecision(4));
  }
  function axis(label, limits, log, ticks) { var a = { label: label, limits: limits, log: !!log, group: 0 }; if (ticks) a.ticks = ticks; return a; }
  function curve(x, y, i) { return { kind: "line", x: x, y: y, width: 1.8, dash: "", colour: COLOURS[i % COLOURS.length], alpha: 1, label: "" }; }
  function figure(id, panel) {
    panel.height = 200;
    panel.x.group = panel.y.group = 0;
    var root = by(id), stage = html("div", {});
    root.replaceChildren(stage);
    workbench.draw(stage, { columns: 1, width: 500, legend: false, panels: [panel] });
  }

  // motion
  var clock = 0, last = null, playing = !calm;
  function displaced(k) { return setting.shapes.map(function (row) { var w = 0; for (var r = 0; r < row.length; r++) w += row[r] * answer.modal[r][k]; return w; }); }
  // the same impulse without control: each mode decays by itself
  function idle(k) {
    var t = answer.time[k], q = setting.omega.map(function (w, r) {
      var z = setting.zeta[r], ring = w * Math.sqrt(Math.max(0, 1 - z * z));
      return answer.impulse_shape[r] * Math.exp(-z * w * t) * (ring > 0 ? Math.sin(ring * t) / ring : t);
    });
    return setting.shapes.map(function (row) { var w = 0; for (var r = 0; r < row.length; r++) w += row[r] * q[r]; return w; });
  }
  function animate() {
    if (!answer || !X) return;
    var k = Math.round(clock % 1 * (answer.time.length - 1)), size = (beamY - 40) / reach;
    [[line, displaced(k)], [still, idle(k)]].forEach(function (shape) {
      if (frame) shape[0].setAttribute("d", joined(shape[1]));
      else if (plate) shape[0].setAttribute("href", painted(shape[1]));
      else shape[0].setAttribute("d", "M" + shape[1].map(function (w, i) { return X(setting.x[i]).toFixed(1) + "," + (beamY - size * w).toFixed(1); }).join("L"));
    });
    by("clock").textContent = "t = " + shown(answer.time[k]) + " " + labels.clock;
  }
  function step(now) {
    if (playing && last !== null) { clock += (now - last) / 10000; animate(); }
    last = now;
    requestAnimationFrame(step);
  }
  by("play").textContent = playing ? "pause" : "play";
  by("play").addEventListener("click", function () { playing = !playing; by("play").textContent = playing ? "pause" : "play"; });
  by("save").addEventListener("submit", function (e) {
    e.preventDefault();
    post("/save", { name: by("name").value, design: design }).then(function (found) {
      by("saved").className = found.error ? "bad" : "good";
      by("saved").textContent = found.error || "saved as " + found.saved + "; run it: workbench study " + by("name").value;
    }).catch(function () { by("saved").textContent = "The bench no longer answers."; });
  });
  build();
  var wide = 0;  // the layout is made again only for a new width, so that a dragged handle persists
  new ResizeObserver(function () { if (stand.clientWidth !== wide) { wide = stand.clientWidth; layout(); } }).observe(stand.parentNode);
  requestAnimationFrame(step);
  ask();
})();
