// Motion: animation of a structure in one of its modes, or of its responses over time.
"use strict";
workbench.COLOURS = ["#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9"];
workbench.move = function (root, spec) {
  var svg = workbench.svg, html = workbench.html, calm = matchMedia("(prefers-reduced-motion: reduce)").matches;
  var modes = spec.kind === "modes", playing = !calm, seen = false, clock = modes ? 0 : 0.05 * spec.seconds, last = null, mode = 0;
  var legend = html("div", { class: "legend" }, root);
  var tracks = spec.tracks.map(function (track, i) {
    var entry = html("button", { type: "button", title: "hide or show" }, legend), t = { spec: track, on: true };
    t.colour = track.colour || (spec.tracks.length > 1 && i === 0 && !modes ? "var(--soft)" : workbench.COLOURS[(i + (modes || spec.tracks.length === 1 ? 0 : -1)) % 6]);
    html("i", {}, entry).style.background = t.colour;
    entry.appendChild(document.createTextNode(track.label));
    entry.addEventListener("click", function () { t.on = !t.on; entry.classList.toggle("off", !t.on); show(); });
    return t;
  });
  if (tracks.length === 1 && !tracks[0].spec.label) legend.hidden = true;
  var picture = svg("svg", { class: "motion", role: "img", "aria-label": modes ? "mode shape" : "motion" }, root);
  picture.style.width = "100%";
  var player = html("div", { class: "player" }, root), choice = null, slider = null;
  var button = html("button", { type: "button" }, player);
  if (modes) {
    choice = html("select", { "aria-label": "mode" }, player);
    var most = Math.max.apply(null, spec.tracks.map(function (t) { return t.frequencies_hz.length; }));
    for (var r = 0; r < most; r++) html("option", { value: r }, choice, "mode " + (r + 1));
    choice.addEventListener("change", function () { mode = +choice.value; measure(); });
  } else {
    slider = html("input", { type: "range", min: 0, max: spec.time.length - 1, step: 1, value: 0, "aria-label": "time" }, player);
    slider.addEventListener("input", function () { playing = false; clock = slider.value / (spec.time.length - 1) * spec.seconds; name(); show(); });
  }
  var readout = html("output", {}, player);
  function name() { button.textContent = playing ? "pause" : "play"; }
  button.addEventListener("click", function () { playing = !playing; last = null; name(); });
  name();

  // the largest displacement of any track, for the scale of the picture
  var reach = 1;
  function displaced(track, frame) {
    var q = track.modal, shapes = track.shapes;
    return shapes.map(function (row) { var w = 0; for (var r = 0; r < row.length; r++) w += row[r] * q[r][frame]; return w; });
  }
  function swung(track, phase) {
    var c = Math.cos(phase), s = Math.sin(phase);
    return mode < track.frequencies_hz.length ? track.real.map(function (row, i) { return row[mode] * c - track.imaginary[i][mode] * s; }) : null;
  }
  function largest() {
    var most = 1e-300;
    tracks.forEach(function (t) { for (var k = 0; k < spec.time.length; k += 3) displaced(t.spec, k).forEach(function (w) { most = Math.max(most, Math.abs(w)); }); });
    return most;
  }
  if (!modes && !spec.net) reach = largest();

  var X, Y, height = 240;
  // a net: nodes of a plate or a frame, moved in the plane of the picture; responses side by side, modes superposed
  var net = spec.net;
  function spun(track, phase, frame) {
    var c = Math.cos(phase), s = Math.sin(phase), moves = track.moves, behind = track.imaginary;
    if (modes && !moves[mode]) return null;
    return net.rest.map(function (p, i) {
      if (modes && !behind) return [p[0] + c * moves[mode][i][0], p[1] + c * moves[mode][i][1]];
      if (modes) return [p[0] + c * moves[mode][i][0] - s * behind[mode][i][0], p[1] + c * moves[mode][i][1] - s * behind[mode][i][1]];
      for (var u = p[0], v = p[1], r = 0; r < moves.length; r++) { u += moves[r][i][0] * track.modal[r][frame]; v += moves[r][i][1] * track.modal[r][frame]; }
      return [u, v];
    });
  }
  function joined(spots, at) {
    return net.lines.map(function (l) { return "M" + (at[0] + X(spots[l[0]][0])).toFixed(1) + "," + (at[1] + Y(spots[l[0]][1])).toFixed(1) + "L" + (at[0] + X(spots[l[1]][0])).toFixed(1) + "," + (at[1] + Y(spots[l[1]][1])).toFixed(1); }).join("");
  }
  function drawnNet(width) {
    var u = net.rest.map(function (p) { return p[0]; }), v = net.rest.map(function (p) { return p[1]; });
    var low = [Math.min.apply(null, u), Math.min.apply(null, v)], high = [Math.max.apply(null, u), Math.max.apply(null, v)];
    var margin = 0.18 * Math.max(high[0] - low[0], high[1] - low[1]);
    var apart = modes ? 1 : tracks.length, beside = width > 280 * apart ? apart : 1, all = width;
    width = all / beside;
    height = Math.max(200, Math.min(380, width * (high[1] - low[1] + 2 * margin) / (high[0] - low[0] + 2 * margin)));
    var unit = Math.min(width / (high[0] - low[0] + 2 * margin), height / (high[1] - low[1] + 2 * margin));
    X = function (x) { return 0.5 * width + unit * (x - 0.5 * (low[0] + high[0])); };
    Y = function (y) { return 0.5 * height - unit * (y - 0.5 * (low[1] + high[1])); };
    picture.setAttribute("viewBox", "0 0 " + all + " " + height * apart / beside);
    picture.setAttribute("height", height * apart / beside);
    tracks.forEach(function (t, i) {
      t.at = modes ? [0, 0] : beside > 1 ? [i * width, 0] : [0, i * height];
      if (!modes || i === 0) svg("path", { d: joined(net.rest, t.at), fill: "none", stroke: "var(--line)", "stroke-width": 1 }, picture);
      t.line = svg("path", { class: "track moves", fill: "none", stroke: t.colour, "stroke-width": 1.6 }, picture);
      if (apart > 1) svg("text", { x: t.at[0] + 0.5 * width, y: t.at[1] + 14, "text-anchor": "middle" }, picture, t.spec.label);
      if (!modes || i === tracks.length - 1) marked(t.at);
    });
    show();
  }
  function marked(at) {
    (spec.sensors || []).forEach(function (s) {
      svg("title", {}, svg("circle", { cx: at[0] + X(s.at[0]), cy: at[1] + Y(s.at[1]), r: 3.5, fill: "var(--paper)", stroke: "var(--ink)" }, picture), "sensor " + s.name);
    });
    (spec.actuators || []).forEach(function (a) {
      var g = svg("g", { transform: "translate(" + (at[0] + X(a.at[0])) + "," + (at[1] + Y(a.at[1]) + 9) + ")" }, picture);
      svg("path", { d: "M0,-9L6,3H-6Z", fill: "var(--bad)" }, g);
      svg("title", {}, g, "actuator " + a.name);
    });
  }
  function measure() {
    var width = picture.clientWidth || 600;
    if (net) { while (picture.firstChild) picture.removeChild(picture.firstChild); drawnNet(width); return; }
    height = Math.max(170, Math.min(270, 0.36 * width)) + 16;
    picture.setAttribute("viewBox", "0 0 " + width + " " + height);
    picture.setAttribute("height", height);
    while (picture.firstChild) picture.removeChild(picture.firstChild);
    var ends = [Math.min.apply(null, spec.x), Math.max.apply(null, spec.x)];
    X = workbench.scale(ends, false, 14, width - 14);
    Y = workbench.scale([-reach * 1.12, reach * 1.12], false, height - 50, 8);
    svg("line", { x1: X(ends[0]), x2: X(ends[1]), y1: Y(0), y2: Y(0), stroke: "var(--line)", "stroke-width": 2 }, picture);
    workbench.ticks({}, ends, Math.round(width / 90)).forEach(function (t) {
      svg("text", { x: X(t[0]), y: height - 21, "text-anchor": "middle" }, picture, t[1]);
    });
    if (spec.label) svg("text", { class: "axis", x: 0.5 * width, y: height - 5, "text-anchor": "middle" }, picture, spec.label);
    (spec.sensors || []).forEach(function (s) {
      svg("title", {}, svg("circle", { cx: X(s.at), cy: Y(0), r: 3.5, fill: "var(--paper)", stroke: "var(--ink)" }, picture), "sensor " + s.name);
    });
    (spec.actuators || []).forEach(function (a) {
      var g = svg("g", { transform: "translate(" + X(a.at) + "," + (height - 49) + ")" }, picture);
      svg("path", { d: "M0,-9L6,3H-6Z", fill: "var(--bad)" }, g);
      svg("title", {}, g, "actuator " + a.name);
    });
    tracks.forEach(function (t) {
      t.ghost = svg("path", { class: "moves", fill: "none", stroke: t.colour, "stroke-width": 1, opacity: 0.35 }, picture);
      t.line = svg("path", { class: "track moves", fill: "none", stroke: t.colour, "stroke-width": t.colour === "var(--soft)" ? 1.6 : 2.4 }, picture);
      t.dots = (t.spec.sampled ? t.spec.x : []).map(function (x) { return svg("circle", { class: "moves", cx: X(x), r: 4, fill: t.colour }, picture); });
    });
    show();
  }
  function path(x, w) { return "M" + w.map(function (v, i) { return X(x[i]).toFixed(1) + "," + Y(v).toFixed(1); }).join("L"); }
  function show() {
    if (!X) return;
    var frame = modes ? 0 : Math.round((clock % spec.seconds) / spec.seconds * (spec.time.length - 1)), words = [];
    if (net) tracks.forEach(function (t) {
      var spots = spun(t.spec, Math.PI * clock, frame);
      t.line.setAttribute("visibility", t.on && spots ? "visible" : "hidden");
      if (!spots) return;
      t.line.setAttribute("d", joined(spots, t.at));
      if (modes) words.push((spec.tracks.length > 1 ? t.spec.label + ": " : "") + workbench.shown(t.spec.frequencies_hz[mode]) + " " + (spec.unit || "Hz") + ", ζ " + workbench.shown(100 * t.spec.damping[mode]) + " %");
    });
    else tracks.forEach(function (t) {
      var x = t.spec.x || spec.x, w = modes ? swung(t.spec, Math.PI * clock) : displaced(t.spec, frame);
      t.line.setAttribute("visibility", t.on && w ? "visible" : "hidden");
      t.ghost.setAttribute("visibility", modes && t.on && w ? "visible" : "hidden");
      t.dots.forEach(function (dot, i) { dot.setAttribute("cy", w ? Y(w[i]) : 0); dot.setAttribute("visibility", t.on && w ? "visible" : "hidden"); });
      if (!w) return;
      t.line.setAttribute("d", path(x, w));
      if (modes) {
        t.ghost.setAttribute("d", path(x, swung(t.spec, 0)) + path(x, swung(t.spec, Math.PI)));
        words.push((spec.tracks.length > 1 ? t.spec.label + ": " : "") + workbench.shown(t.spec.frequencies_hz[mode]) + " " + (spec.unit || "Hz") + ", ζ " + workbench.shown(100 * t.spec.damping[mode]) + " %");
      }
    });
    if (slider) slider.value = frame;
    readout.textContent = modes ? words.join(" · ") : "t = " + spec.time[frame].toFixed(spec.time[spec.time.length - 1] > 20 ? 1 : 3) + " " + (spec.unit || "s");
  }
  function step(now) {
    if (!seen || !root.isConnected) { last = null; return; }
    if (playing && last !== null) { clock += (now - last) / 1000; root.dataset.frames = +(root.dataset.frames || 0) + 1; show(); }
    last = now;
    requestAnimationFrame(step);
  }
  new IntersectionObserver(function (entries) {
    var was = seen;
    seen = entries[entries.length - 1].isIntersecting;
    if (seen && !was) requestAnimationFrame(step);
  }).observe(root);
  var wide = 0;
  new ResizeObserver(function () { if (picture.clientWidth !== wide) { wide = picture.clientWidth; measure(); } }).observe(picture.parentNode);
};
