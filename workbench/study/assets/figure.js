// Figures: panels of marks on axes, drawn as SVG. Drag to zoom, press twice to see all, point to read a value; by
// keyboard + and − zoom, the arrows move, Escape shows all.
"use strict";
var workbench = (function () {
  var NS = "http://www.w3.org/2000/svg", count = 0, BAR = 58;  // px, for the bar of colours beside a field

  function svg(name, attributes, parent, text) {
    var node = document.createElementNS(NS, name);
    for (var key in attributes) if (attributes[key] !== undefined) node.setAttribute(key, attributes[key]);
    if (text !== undefined) node.textContent = text;
    if (parent) parent.appendChild(node);
    return node;
  }
  function html(name, attributes, parent, text) {
    var node = document.createElement(name);
    for (var key in attributes) node.setAttribute(key, attributes[key]);
    if (text !== undefined) node.textContent = text;
    if (parent) parent.appendChild(node);
    return node;
  }
  // black and grey follow the page from light to dark
  function ink(colour) { return colour === "#000000" ? "var(--ink)" : colour === "#8a8a8a" ? "var(--soft)" : colour; }

  function scale(limits, log, from, to) {
    var f = log ? Math.log10 : function (v) { return v; }, a = f(limits[0]), b = f(limits[1]);
    var at = function (v) { return from + (f(v) - a) / (b - a) * (to - from); };
    at.back = function (p) { var v = a + (p - from) / (to - from) * (b - a); return log ? Math.pow(10, v) : v; };
    return at;
  }
  // of a tick, by powers of ten where the largest of its axis is
  function shown(v, step, largest) {
    if (v === null || v === undefined || !isFinite(v)) return "–";
    if (v === 0 || (step && Math.abs(v) < 1e-9 * step)) return "0";
    var size = Math.abs(v), most = largest || size;
    if (most >= 1e5 || most < (step ? 1e-3 : 1e-4)) return power(v, step ? Math.max(0, Math.min(4, Math.floor(Math.log10(size) + 1e-9) - Math.floor(Math.log10(step) + 1e-9))) : 3);
    if (!step) return String(parseFloat(v.toPrecision(5))).replace("-", "−");
    var digits = Math.max(0, Math.min(8, -Math.floor(Math.log10(step) + 1e-9)));
    return v.toFixed(digits).replace("-", "−");
  }
  function ticks(axis, limits, wanted) {
    var low = Math.min(limits[0], limits[1]), high = Math.max(limits[0], limits[1]), found = [], v;
    if (axis.ticks) return axis.ticks.filter(function (t) { return t[0] >= low && t[0] <= high; });
    if (axis.log && high / low > 12) {
      var first = Math.ceil(Math.log10(low) - 1e-9), last = Math.floor(Math.log10(high) + 1e-9);
      var every = Math.max(1, Math.ceil((last - first + 1) / wanted));
      // with few decades, ticks at 2 and 5 too
      var parts = every > 1 || last - first >= 2 ? [1] : 3 * Math.log10(high / low) > 1.5 * wanted ? [1, 3] : [1, 2, 5];
      for (var e = parts.length > 1 ? first - 1 : first; e <= last; e += every) parts.forEach(function (part) {
        v = part * Math.pow(10, e);
        if (v >= low * (1 - 1e-9) && v <= high * (1 + 1e-9)) found.push([v]);
      });
      var plain = low > 9e-5 && high < 1.1e5;  // else powers of ten
      return found.map(function (t) { return [t[0], plain ? String(parseFloat(t[0].toPrecision(3))) : power(t[0])]; });
    }
    var raw = (high - low) / wanted, unit = Math.pow(10, Math.floor(Math.log10(raw)));
    var step = unit * (raw / unit > 5 ? 10 : raw / unit > 2 ? 5 : raw / unit > 1 ? 2 : 1);
    for (v = Math.ceil(low / step - 1e-9) * step; v <= high + 1e-9 * step; v += step) {
      if (!axis.log || v > 0) found.push([v, shown(v, step, Math.max(Math.abs(low), Math.abs(high)))]);
    }
    return found.length < 2 && wanted < 9 ? ticks(axis, limits, wanted + 1) : found;
  }
  // width of a text of an axis, px
  var pen = document.createElement("canvas").getContext("2d");
  function textWidth(text) {
    pen.font = "12px " + getComputedStyle(document.body).fontFamily;
    return pen.measureText(text).width;
  }
  // −2.5·10⁻⁷
  function power(v, digits) {
    var up = "⁰¹²³⁴⁵⁶⁷⁸⁹", parts = Math.abs(v).toExponential(digits || 0).split("e"), part = String(parseFloat(parts[0]));
    return (v < 0 ? "−" : "") + (part === "1" ? "" : part + "·") + "10" +
      parts[1].replace("+", "").split("").map(function (c) { return c === "-" ? "⁻" : up[+c]; }).join("");
  }

  function draw(root, spec) {
    var panels = spec.panels.map(function (p) {
      return { spec: p, x: p.x.limits.slice(), y: p.y.limits.slice(), off: {} };
    });
    var tools = html("div", { class: "tools" }, root);
    var reset = html("button", { type: "button", hidden: "" }, tools, "show all");
    reset.addEventListener("click", function () { view(null); });
    var tip = html("div", { class: "tip", hidden: "" }, root);
    if (spec.legend) legend(html("div", { class: "legend" }, root), panels);
    var grid = html("div", { class: "panels" }, root);
    grid.style.gridTemplateColumns = "repeat(" + spec.columns + ", minmax(0, 1fr))";
    panels.forEach(function (panel) {
      panel.root = html("div", { class: "panel" }, grid);
      if (panel.spec.title) html("h3", {}, panel.root, panel.spec.title);
      if (panel.spec.legend && !spec.legend) legend(html("div", { class: "legend" }, panel.root), [panel]);
      panel.svg = svg("svg", { role: "img", tabindex: 0, "aria-label": panel.spec.title || panel.spec.y.label }, panel.root);
      listen(panel);
    });
    var wide = 0;
    new ResizeObserver(function () {
      if (grid.clientWidth !== wide) { wide = grid.clientWidth; paintAll(); }
    }).observe(grid);

    function legend(box, of) {
      var named = {};
      of.forEach(function (panel) {
        panel.spec.marks.forEach(function (mark) { if (mark.label && mark.kind !== "field") named[mark.label] = named[mark.label] || mark; });
      });
      Object.keys(named).forEach(function (label) {
        var mark = named[label], entry = html("button", { type: "button", title: "hide or show" }, box);
        var swatch = html("i", {}, entry);
        if (mark.kind === "line" || mark.kind === "rule") sample(mark, swatch);
        else {
          swatch.style.background = ink(mark.colour || mark.colours[0]);
          if (mark.alpha) swatch.style.opacity = mark.alpha;
        }
        entry.appendChild(document.createTextNode(label));
        entry.addEventListener("click", function () {
          of.forEach(function (panel) { panel.off[label] = !panel.off[label]; paint(panel); });
          entry.classList.toggle("off", of[0].off[label]);
        });
      });
    }
    // a line as it is drawn: its dash, width and marker
    function sample(mark, box) {
      var node = svg("svg", { class: "sample", viewBox: "0 0 30 12", width: 30, height: 12, "aria-hidden": "true" });
      if (mark.width > 0) svg("line", { x1: 0, x2: 30, y1: 6, y2: 6, stroke: ink(mark.colour), "stroke-width": Math.min(mark.width, 8),
        "stroke-dasharray": mark.dash || undefined, opacity: mark.alpha }, node);
      if (mark.marker) marker(Object.assign({}, mark, { size: Math.min(mark.size, 11), colours: undefined }), [15, 6, 0], node);
      box.appendChild(node);
      box.style.width = "30px";
      box.style.height = "12px";
      node.style.cssText = "display: block; overflow: visible; cursor: inherit";
    }
    function view(panel, x, y) {
      panels.forEach(function (other) {
        if (!panel) { other.x = other.spec.x.limits.slice(); other.y = other.spec.y.limits.slice(); }
        else {
          if (other === panel || other.spec.x.group === panel.spec.x.group) other.x = x.slice();
          if (other === panel || other.spec.y.group === panel.spec.y.group) other.y = y.slice();
        }
      });
      paintAll();
      reset.hidden = !panel;
    }
    // the label of an axis, or of the first axis it is shared with
    function labelled(panel, axis) {
      var all = panels.filter(function (other) { return other.spec[axis].group === panel.spec[axis].group; });
      return all.map(function (other) { return other.spec[axis].label; }).filter(Boolean)[0] || "";
    }
    function sized(panel) {
      var p = panel.spec, width = (!p.square && panel.svg.clientWidth) || panel.root.clientWidth, narrow = grid.clientWidth < 600;
      // on a narrow screen panels are stacked, and one without a label gets that of its row or column
      var apart = narrow && spec.columns > 1, x = apart ? labelled(panel, "x") : p.x.label, y = apart ? labelled(panel, "y") : p.y.label;
      var height = Math.max(150, Math.min(narrow ? 300 : 620, p.height * (narrow ? 1 : Math.min(1, grid.clientWidth / spec.width)) + 34));
      if (narrow) height = Math.max(height, 0.5 * width);
      var bottom = height - (x ? 38 : 22), yTicks = ticks(p.y, panel.y, Math.max(3, Math.round(bottom / 38)));
      var longest = Math.max.apply(null, yTicks.map(function (t) { return textWidth(t[1]); }).concat([7]));
      var left = Math.min(0.42 * width, 12 + longest) + (y ? 17 : 0);
      if (p.square) width = Math.min(width, left + (bottom - 8) + BAR + 10);
      return { width: width, height: height, bottom: bottom, yTicks: yTicks, x: x, y: y, left: left };
    }
    function paintAll() {
      panels.forEach(function (panel) { panel.size = sized(panel); });
      panels.forEach(paint);
    }

    function paint(panel) {
      var p = panel.spec, node = panel.svg, size = panel.size;
      if (!size || !size.width) return;
      var width = size.width, height = size.height, bottom = size.bottom, yTicks = size.yTicks, right = width - 10, top = 8;
      while (node.firstChild) node.removeChild(node.firstChild);
      node.setAttribute("viewBox", "0 0 " + width + " " + height);
      node.setAttribute("height", height);
      if (p.square) node.style.width = width + "px";
      // stacked panels that share x are aligned
      var left = Math.max.apply(null, panels.filter(function (other) {
        return other === panel || (other.spec.x.group === p.x.group && other.size.width === width);
      }).map(function (other) { return other.size.left; }));
      var field = p.marks.filter(function (m) { return m.kind === "field"; })[0];
      if (field) right -= BAR;
      p.marks.forEach(function (m) {  // room for texts at the right edge
        var out = m.kind === "text" && m.frame === "data" && m.across === "left" && m.x >= p.x.limits[1] - 0.01 * (p.x.limits[1] - p.x.limits[0]);
        if (out) right = Math.min(right, width - 6 - 6.6 * m.text.length);
      });
      var X = scale(panel.x, p.x.log, left, right), Y = scale(panel.y, p.y.log, bottom, top), wanted = Math.max(2, Math.round((right - left) / 75));
      // room for half the width of the last number
      var over = ticks(p.x, panel.x, wanted).map(function (t) { return X(t[0]) + 0.5 * textWidth(t[1]) - width; });
      right -= Math.max(0, Math.max.apply(null, over.concat([0])));
      if (p.equal) {  // lengths along both axes to one scale: the frame shrinks
        var across = (right - left) / (panel.x[1] - panel.x[0]), up = (bottom - top) / (panel.y[1] - panel.y[0]);
        right = left + Math.min(across, up) * (panel.x[1] - panel.x[0]);
        top = bottom - Math.min(across, up) * (panel.y[1] - panel.y[0]);
        Y = scale(panel.y, p.y.log, bottom, top);
      }
      X = scale(panel.x, p.x.log, left, right);
      panel.frame = { left: left, right: right, top: top, bottom: bottom, X: X, Y: Y };
      panel.hits = [];
      var xTicks = ticks(p.x, panel.x, wanted);
      if (p.x.ticks) xTicks = spread(xTicks, X);
      xTicks.forEach(function (t) {
        svg("line", { class: "grid", x1: X(t[0]), x2: X(t[0]), y1: top, y2: bottom }, node);
        svg("text", { x: X(t[0]), y: bottom + 15, "text-anchor": "middle" }, node, t[1]);
      });
      yTicks.forEach(function (t) {
        svg("line", { class: "grid", x1: left, x2: right, y1: Y(t[0]), y2: Y(t[0]) }, node);
        var name = svg("text", { x: left - 5, y: Y(t[0]) + 4, "text-anchor": "end" }, node, t[1]);
        if (textWidth(t[1]) > left - 12) { name.setAttribute("textLength", left - 12); name.setAttribute("lengthAdjust", "spacingAndGlyphs"); }
      });
      if (size.x) fit(svg("text", { class: "axis", x: (left + right) / 2, y: height - 5, "text-anchor": "middle" }, node, size.x), right - left + 16);
      if (size.y) fit(svg("text", { class: "axis", x: 0, y: 0, "text-anchor": "middle",
        transform: "translate(12," + (top + bottom) / 2 + ") rotate(-90)" }, node, size.y), height - 8);
      var id = "clip" + (++count), clip = svg("clipPath", { id: id }, svg("defs", {}, node));
      svg("rect", { x: left, y: top, width: right - left, height: bottom - top }, clip);
      var layer = svg("g", { "clip-path": "url(#" + id + ")", class: "marks" }, node);
      p.marks.forEach(function (mark) { if (!panel.off[mark.label]) KINDS[mark.kind](mark, layer, panel); });
      svg("path", { class: "frame", d: "M" + left + "," + top + "V" + bottom + "H" + right }, node);
      if (field) bar(field, node, right + 12, top, bottom);
      panel.rubber = svg("rect", { fill: "var(--accent)", "fill-opacity": 0.15, stroke: "var(--accent)", visibility: "hidden" }, node);
      panel.dot = svg("circle", { r: 4, fill: "none", stroke: "var(--ink)", "stroke-width": 1.5, visibility: "hidden" }, node);
    }
    function fit(text, room) {
      var size = 6.2 * text.textContent.length;
      if (size > room) { text.setAttribute("textLength", room); text.setAttribute("lengthAdjust", "spacingAndGlyphs"); }
    }
    // category names that would overlap: only every nth
    function spread(all, X) {
      var room = Math.abs(all.length > 1 ? X(all[1][0]) - X(all[0][0]) : 1e9);
      var need = 8 + 6.6 * Math.max.apply(null, all.map(function (t) { return t[1].length; }).concat([1]));
      var every = Math.max(1, Math.ceil(need / room));
      return all.filter(function (_, i) { return i % every === 0; });
    }

    var KINDS = {
      line: function (mark, layer, panel) {
        var X = panel.frame.X, Y = panel.frame.Y, path = "", pen = false, logx = panel.spec.x.log, logy = panel.spec.y.log;
        var points = [];
        for (var i = 0; i < mark.x.length; i++) {
          var x = mark.x[i], y = mark.y[i];
          if (x === null || y === null || (logx && x <= 0) || (logy && y <= 0)) { pen = false; continue; }
          var px = X(x), py = Math.max(-1e5, Math.min(1e5, Y(y)));
          points.push([px, py, i]);
          path += (pen ? "L" : "M") + px.toFixed(1) + "," + py.toFixed(1);
          pen = true;
        }
        if (mark.width > 0 && path) svg("path", { d: path, fill: "none", stroke: ink(mark.colour), "stroke-width": mark.width,
          "stroke-dasharray": mark.dash || undefined, opacity: mark.alpha, "stroke-linejoin": "round" }, layer);
        if (mark.marker) points.forEach(function (q) { marker(mark, q, layer); });
        panel.hits.push({ mark: mark, points: points });
      },
      rule: function (mark, layer, panel) {
        var f = panel.frame, across = mark.axis === "y", at = across ? f.Y(mark.at) : f.X(mark.at);
        if (!isFinite(at)) return;
        svg("line", { x1: across ? f.left : at, x2: across ? f.right : at, y1: across ? at : f.top, y2: across ? at : f.bottom,
          stroke: ink(mark.colour), "stroke-width": mark.width, "stroke-dasharray": mark.dash || undefined, opacity: mark.alpha }, layer);
      },
      bars: function (mark, layer, panel) {
        var f = panel.frame, hits = [];
        mark.boxes.forEach(function (box, i) {
          var a = box[0] === null ? f.left : f.X(box[0]), b = box[1] === null ? f.right : f.X(box[1]);
          var c = box[2] === null ? f.bottom : edge(f.Y, box[2], panel.spec.y.log, f.bottom), d = box[3] === null ? f.top : f.Y(box[3]);
          if (panel.spec.x.log && box[0] !== null && box[0] <= 0) a = f.left;
          if (![a, b, c, d].every(isFinite)) return;
          var rect = { x: Math.min(a, b), y: Math.min(c, d), width: Math.abs(b - a), height: Math.abs(d - c) };
          svg("rect", Object.assign({ fill: ink(mark.colours[i % mark.colours.length]), stroke: mark.edge && ink(mark.edge),
            opacity: mark.alpha }, rect), layer);
          hits.push([rect, i]);
        });
        if (mark.boxes[0] && mark.boxes[0].indexOf(null) < 0) panel.hits.push({ mark: mark, boxes: hits });
      },
      area: function (mark, layer, panel) {
        var f = panel.frame;
        svg("path", { d: "M" + mark.x.map(function (x, i) { return f.X(x).toFixed(1) + "," + f.Y(mark.y[i]).toFixed(1); }).join("L") + "Z",
          fill: ink(mark.colour), "fill-opacity": mark.alpha }, layer);
      },
      field: function (mark, layer, panel) {
        var f = panel.frame, rows = mark.shape[0], columns = mark.shape[1];
        if (!mark.steps) mark.steps = Uint8Array.from(atob(mark.values), function (c) { return c.charCodeAt(0); });
        if (!mark.picture) {
          var canvas = document.createElement("canvas"), table = palette(mark.colours);
          canvas.width = columns; canvas.height = rows;
          var pen = canvas.getContext("2d"), image = pen.createImageData(columns, rows);
          for (var i = 0; i < rows; i++) for (var j = 0; j < columns; j++) {
            var step = mark.steps[(rows - 1 - i) * columns + j], k = 4 * (i * columns + j);
            if (step < 255) { image.data.set(table[step], k); image.data[k + 3] = 255; }
          }
          pen.putImageData(image, 0, 0);
          mark.picture = canvas.toDataURL();
        }
        var a = f.X(mark.x[0]), b = f.X(mark.x[1]), c = f.Y(mark.y[0]), d = f.Y(mark.y[1]);
        svg("image", { href: mark.picture, x: a, y: d, width: b - a, height: c - d, preserveAspectRatio: "none" }, layer);
        panel.hits.push({ mark: mark, field: true });
      },
      text: function (mark, layer, panel) {
        var f = panel.frame, data = mark.frame === "data";
        var x = data ? f.X(mark.x) : f.left + mark.x * (f.right - f.left), y = data ? f.Y(mark.y) : f.bottom - mark.y * (f.bottom - f.top);
        if (!isFinite(x) || !isFinite(y)) return;
        var node = svg("text", { x: x + mark.shift[0], y: y + mark.shift[1] + { top: 11, center: 4, center_baseline: 4 }[mark.up] || y + mark.shift[1],
          "text-anchor": { left: "start", center: "middle", right: "end" }[mark.across] }, layer.parentNode);
        node.style.fontSize = Math.min(13, mark.size) + "px";
        node.style.fill = ink(mark.colour);
        mark.text.split("\n").forEach(function (line, i) { svg("tspan", { x: x + mark.shift[0], dy: i ? "1.15em" : 0 }, node, line); });
      }
    };
    function edge(Y, v, log, bottom) { return log && v <= 0 ? bottom : Y(v); }
    function palette(colours) {
      var parsed = colours.map(function (c) { return [1, 3, 5].map(function (i) { return parseInt(c.slice(i, i + 2), 16); }); }), table = [];
      for (var s = 0; s < 255; s++) {
        var t = s / 254 * (parsed.length - 1), i = Math.min(parsed.length - 2, Math.floor(t));
        table.push(parsed[i].map(function (v, k) { return Math.round(v + (t - i) * (parsed[i + 1][k] - v)); }));
      }
      return table;
    }
    function bar(mark, node, x, top, bottom) {
      var id = "shade" + (++count), shade = svg("linearGradient", { id: id, x1: 0, x2: 0, y1: 1, y2: 0 }, svg("defs", {}, node));
      mark.colours.forEach(function (c, i) { svg("stop", { offset: i / (mark.colours.length - 1), "stop-color": c }, shade); });
      svg("rect", { x: x, y: top, width: 9, height: bottom - top, fill: "url(#" + id + ")" }, node);
      [[mark.limits[0], bottom], [mark.limits[1], top + 9]].forEach(function (t) {
        svg("text", { x: x + 12, y: t[1] }, node, String(parseFloat(t[0].toPrecision(2))).replace("-", "−"));
      });
    }
    function marker(mark, q, layer) {
      var r = mark.size / 2, colour = ink(mark.colours ? mark.colours[q[2]] : mark.colour), m = mark.marker;
      var look = { fill: mark.hollow ? "none" : colour, stroke: mark.hollow ? colour : undefined, opacity: mark.alpha };
      if (m === "s") svg("rect", Object.assign({ x: q[0] - r, y: q[1] - r, width: 2 * r, height: 2 * r }, look), layer);
      else if (m === "x" || m === "+") {
        var d = m === "x" ? "M-1,-1L1,1M-1,1L1,-1" : "M-1,0H1M0,-1V1";
        svg("path", { d: d, transform: "translate(" + q[0] + "," + q[1] + ") scale(" + r + ")", stroke: colour, "stroke-width": 2 / r, opacity: mark.alpha }, layer);
      } else if (m === "^" || m === "v") {
        svg("path", { d: m === "^" ? "M0,-1L1,1H-1Z" : "M0,1L1,-1H-1Z", transform: "translate(" + q[0] + "," + q[1] + ") scale(" + r + ")", fill: look.fill, stroke: look.stroke,
          "stroke-width": mark.hollow ? 1.3 / r : undefined, opacity: mark.alpha }, layer);
      } else if (m === "D" || m === "d") {
        svg("path", { d: "M0,-1L1,0L0,1L-1,0Z", transform: "translate(" + q[0] + "," + q[1] + ") scale(" + r + ")", fill: look.fill, stroke: look.stroke,
          "stroke-width": mark.hollow ? 1.3 / r : undefined, opacity: mark.alpha }, layer);
      } else svg("circle", Object.assign({ cx: q[0], cy: q[1], r: r }, look), layer);
    }

    function listen(panel) {
      var start = null;
      function place(event) {
        var box = panel.svg.getBoundingClientRect();
        return [event.clientX - box.left, event.clientY - box.top];
      }
      function inside(p) { var f = panel.frame; return f && p[0] >= f.left && p[0] <= f.right && p[1] >= f.top && p[1] <= f.bottom; }
      panel.svg.addEventListener("pointerdown", function (event) {
        var p = place(event);
        if (inside(p) && event.isPrimary && event.button === 0) { start = p; panel.svg.setPointerCapture(event.pointerId); }
      });
      panel.svg.addEventListener("pointermove", function (event) {
        var p = place(event), f = panel.frame;
        if (!start) return inside(p) ? read(panel, p) : leave(panel);
        leave(panel);
        var box = dragged(p);
        for (var key in box) panel.rubber.setAttribute(key, box[key]);
        panel.rubber.setAttribute("visibility", "visible");
      });
      function dragged(p) {
        var f = panel.frame, clamp = function (v, a, b) { return Math.max(a, Math.min(b, v)); };
        var x = [start[0], clamp(p[0], f.left, f.right)].sort(order), y = [start[1], clamp(p[1], f.top, f.bottom)].sort(order);
        // a drag along one axis zooms that axis alone
        if (y[1] - y[0] < 12) y = [f.top, f.bottom];
        if (x[1] - x[0] < 12) x = [f.left, f.right];
        return { x: x[0], width: x[1] - x[0], y: y[0], height: y[1] - y[0] };
      }
      function order(a, b) { return a - b; }
      panel.svg.addEventListener("pointerup", function (event) {
        if (!start) return;
        var p = place(event), f = panel.frame, box = dragged(p), far = Math.max(Math.abs(p[0] - start[0]), Math.abs(p[1] - start[1]));
        start = null;
        panel.rubber.setAttribute("visibility", "hidden");
        if (far < 12) return read(panel, p);
        view(panel, [f.X.back(box.x), f.X.back(box.x + box.width)], [f.Y.back(box.y + box.height), f.Y.back(box.y)]);
      });
      panel.svg.addEventListener("pointercancel", function () { start = null; panel.rubber.setAttribute("visibility", "hidden"); });
      panel.svg.addEventListener("dblclick", function () { view(null); });
      // part of the frame to see next, from left to right and from bottom to top
      var nearer = [0.2, 0.8, 0.2, 0.8], moves = { "+": nearer, "=": nearer, "-": [-1 / 3, 4 / 3, -1 / 3, 4 / 3],
        ArrowLeft: [-0.2, 0.8, 0, 1], ArrowRight: [0.2, 1.2, 0, 1], ArrowUp: [0, 1, 0.2, 1.2], ArrowDown: [0, 1, -0.2, 0.8] };
      panel.svg.addEventListener("keydown", function (event) {
        var f = panel.frame, to = moves[event.key], arrow = event.key.indexOf("Arrow") === 0;
        if (!f || event.ctrlKey || event.metaKey || event.altKey || (arrow && reset.hidden)) return;  // arrows scroll the page
        if (event.key === "Escape") return view(null);
        if (!to) return;
        event.preventDefault();
        var x = function (share) { return f.X.back(f.left + share * (f.right - f.left)); };
        var y = function (share) { return f.Y.back(f.bottom + share * (f.top - f.bottom)); };
        view(panel, [x(to[0]), x(to[1])], [y(to[2]), y(to[3])]);
      });
      panel.svg.addEventListener("pointerleave", function () { leave(panel); });
    }
    function leave(panel) { tip.hidden = true; if (panel.dot) panel.dot.setAttribute("visibility", "hidden"); }
    function read(panel, p) {
      var best = null, f = panel.frame, spec_ = panel.spec;
      panel.hits.forEach(function (hit) {
        if (hit.points) hit.points.forEach(function (q) {
          var d = Math.hypot(q[0] - p[0], q[1] - p[1]);
          if (d < 40 && (!best || d < best.d)) best = { d: d, at: q, mark: hit.mark, x: hit.mark.x[q[2]], y: hit.mark.y[q[2]] };
        });
        if (hit.boxes) hit.boxes.forEach(function (b) {
          var r = b[0], box = hit.mark.boxes[b[1]];
          if (p[0] >= r.x && p[0] <= r.x + r.width && p[1] >= r.y - 3 && p[1] <= r.y + r.height) {
            var flat = r.width > 0 && Math.abs(box[0]) < Math.abs(box[1]) && spec_.y.ticks && !spec_.x.ticks;
            best = { d: 0, at: flat ? [r.x + r.width, r.y + r.height / 2] : [r.x + r.width / 2, r.y], mark: hit.mark,
              x: flat ? box[1] : (box[0] + box[1]) / 2, y: flat ? (box[2] + box[3]) / 2 : box[3] };
          }
        });
        if (hit.field && !best) {
          var m = hit.mark, x = f.X.back(p[0]), y = f.Y.back(p[1]);
          var j = Math.floor((x - m.x[0]) / (m.x[1] - m.x[0]) * m.shape[1]), i = Math.floor((y - m.y[0]) / (m.y[1] - m.y[0]) * m.shape[0]);
          var step = m.steps[i * m.shape[1] + j];
          if (j >= 0 && i >= 0 && j < m.shape[1] && i < m.shape[0] && step < 255)
            best = { d: 50, at: p, mark: m, x: x, y: y, value: m.limits[0] + step / 254 * (m.limits[1] - m.limits[0]) };
        }
      });
      if (!best) return leave(panel);
      panel.dot.setAttribute("cx", best.at[0]); panel.dot.setAttribute("cy", best.at[1]);
      panel.dot.setAttribute("visibility", "visible");
      var lines = best.mark.label && best.value === undefined ? [best.mark.label] : [];
      lines.push((labelled(panel, "x") || "x") + ": " + named(spec_.x, best.x), (labelled(panel, "y") || "y") + ": " + named(spec_.y, best.y));
      if (best.value !== undefined) lines.push((best.mark.label || "value") + ": " + shown(best.value));
      tip.textContent = lines.join("\n");
      tip.hidden = false;
      var box = panel.svg.getBoundingClientRect(), home = root.getBoundingClientRect(), left = box.left - home.left + best.at[0] + 12;
      tip.style.left = Math.max(0, Math.min(left, home.width - tip.offsetWidth - 4)) + "px";
      tip.style.top = box.top - home.top + best.at[1] - tip.offsetHeight - 8 + "px";
    }
    function named(axis, v) {
      var at = axis.ticks && axis.ticks.filter(function (t) { return Math.abs(t[0] - v) < 0.45 && t[1]; })[0];
      return at && isNaN(parseFloat(at[1])) ? at[1] : shown(v);
    }
  }
  return { draw: draw, svg: svg, html: html, scale: scale, ticks: ticks, shown: shown, ink: ink };
})();
