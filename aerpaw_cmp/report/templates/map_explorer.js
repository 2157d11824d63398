"use strict";
// The linked map: one layer or the difference of two, values at the pointer, a profile, and numbers of the layer.
(async () => {
  const { at, css, number, count, cells, fill, frame, axes, ramp, quantile, later, whenResized } = common;
  const data = JSON.parse(at("explorer-data").textContent), arrays = await common.unpack(data.packed);
  const east = arrays[data.east], north = arrays[data.north], columns = east.length, rows = north.length;
  const ramps = { level: ramp("viridis"), difference: ramp("RdBu_r") };
  const root = at("explorer"), canvas = at("map"), legend = at("legend");
  const edges = [east[0] - data.half[0], east[columns - 1] + data.half[0], north[0] - data.half[1], north[rows - 1] + data.half[1]];
  const state = { quantity: 0, a: [], b: [], difference: false, scale: "shared", cell: null, line: null, zoom: 1, east: 0, north: 0 };

  // --- layers ---------------------------------------------------------------------------------------------------------

  const quantity = () => data.quantities[state.quantity];
  const kept = new Map();
  function layer(choice) { // values of a choice, row 0 in the south; null if there is no such layer
    const q = quantity(), i = q.layers[choice.join(",") || ""];
    if (i === undefined) return null;
    const key = state.quantity + ":" + i;
    if (!kept.has(key)) { if (kept.size > 40) kept.clear(); kept.set(key, common.values(arrays[i], q.kind === "classes" ? 1 : q.step)); }
    return kept.get(key);
  }
  const named = choice => quantity().axes.map((axis, i) => (axis.name === "K" ? "K = " : "") + (axis.values[choice[i]] === data.joint ? "nearest tower" : axis.values[choice[i]])).join(", ");
  const unit = () => state.difference ? (quantity().unit === "dBm" ? "dB" : quantity().kind === "classes" ? "ranks" : quantity().unit) : quantity().unit;

  let shown = null, a = null, b = null;
  function compute() {
    a = layer(state.a); b = state.difference ? layer(state.b) : null;
    if (!state.difference) shown = a;
    else shown = a && b ? a.map((v, i) => v - b[i]) : null;
    image = null;
  }
  const asClasses = () => quantity().kind === "classes" && !state.difference;

  function statistics(values = shown) {
    if (!values) return { n: 0, cells: rows * columns };
    const q = quantity(), finite = values.filter(Number.isFinite).sort(), total = values.length;
    const found = { n: finite.length, cells: total, covered: finite.length / total };
    if (asClasses()) {
      const counts = q.classes.map(() => 0);
      for (const v of finite) counts[v]++;
      if (q.classes[0] === "Z") counts[0] = total - finite.length;
      found.share = counts.map(c => c / total); // a list in the order of the classes, because an object would sort "1" before "Z"
      return found;
    }
    let sum = 0, square = 0;
    for (const v of finite) { sum += v; square += v * v; }
    Object.assign(found, { mean: sum / finite.length, rms: Math.sqrt(square / finite.length), min: quantile(finite, 0), p10: quantile(finite, 0.1), median: quantile(finite, 0.5), p90: quantile(finite, 0.9), max: quantile(finite, 1) });
    if (state.difference) {
      found.onlyA = a.reduce((t, v, i) => t + (Number.isFinite(v) && !Number.isFinite(b[i]) ? 1 : 0), 0) / total;
      found.onlyB = a.reduce((t, v, i) => t + (!Number.isFinite(v) && Number.isFinite(b[i]) ? 1 : 0), 0) / total;
      found.up = finite.reduce((t, v) => t + (v > 0 ? 1 : 0), 0) / total;
      found.down = finite.reduce((t, v) => t + (v < 0 ? 1 : 0), 0) / total;
    }
    return found;
  }

  function limits() {
    const q = quantity();
    if (state.difference) {
      const sizes = shown ? shown.filter(Number.isFinite).map(Math.abs).sort() : [];
      const reach = quantile(sizes, 0.99) || quantile(sizes, 1) || 1;
      return [-reach, reach];
    }
    if (state.scale === "shared" || !shown) return q.range;
    let low = Infinity, high = -Infinity;
    for (const v of shown) if (Number.isFinite(v)) { low = Math.min(low, v); high = Math.max(high, v); }
    return high > low ? [low, high] : Number.isFinite(low) ? [low - 0.5, low + 0.5] : [0, 1];
  }
  const ramped = () => state.difference ? ramps.difference : ramps.level;
  const rgb = hex => [1, 3, 5].map(k => parseInt(hex.slice(k, k + 2), 16));
  function colour(v, ends) {
    if (!Number.isFinite(v)) return null;
    if (asClasses()) return rgb(quantity().colours[v] || "#888888");
    return ramped()((v - ends[0]) / (ends[1] - ends[0]));
  }
  function words(v, more = 0) {
    const q = quantity();
    if (!Number.isFinite(v)) return asClasses() && q.classes[0] === "Z" || q.unit === "dBm" ? "no path" : "–";
    if (q.kind === "classes" && !state.difference) return q.classes[v];
    if (q.kind === "classes") return number(v, 0);
    return number(v, Math.min(4, (q.step < 1 ? 1 : 0) + more), unit());
  }

  // --- the map ----------------------------------------------------------------------------------------------------------

  let image = null, project = null, labels = [];
  function draw() { // draws the cells once per layer; the browser scales the image
    image = document.createElement("canvas"); image.width = columns; image.height = rows;
    const pen = image.getContext("2d"), pixels = pen.createImageData(columns, rows), ends = limits();
    for (let r = 0; r < rows; r++) for (let c = 0; c < columns; c++) {
      const found = shown && colour(shown[r * columns + c], ends), p = 4 * ((rows - 1 - r) * columns + c); // north is up
      if (found) { pixels.data[p] = found[0]; pixels.data[p + 1] = found[1]; pixels.data[p + 2] = found[2]; pixels.data[p + 3] = 255; }
    }
    pen.putImageData(pixels, 0, 0);
  }

  function hatch(pen) {
    const tile = document.createElement("canvas"), p = tile.getContext("2d");
    tile.width = tile.height = 8; p.strokeStyle = css("--soft"); p.globalAlpha = 0.6; p.lineWidth = 1;
    p.beginPath(); p.moveTo(0, 8); p.lineTo(8, 0); p.moveTo(-2, 2); p.lineTo(2, -2); p.moveTo(6, 10); p.lineTo(10, 6); p.stroke();
    return pen.createPattern(tile, "repeat");
  }

  const cellValues = () => [["east_m", "north_m", at("title").textContent], ...Array.from(shown || [], (v, i) => [east[i % columns], north[Math.floor(i / columns)], asClasses() ? quantity().classes[v] : v])];
  function drawMap() {
    if (!image) draw();
    const [pen, w, h] = frame(canvas);
    project = common.plan([46, 8, w - 16, h - 32], edges, state.zoom, [state.east, state.north]);
    const x0 = project.x(edges[0]), x1 = project.x(edges[1]), y0 = project.y(edges[3]), y1 = project.y(edges[2]);
    pen.save(); pen.beginPath(); pen.rect(46, 8, w - 62, h - 40); pen.clip();
    pen.fillStyle = css("--band"); pen.fillRect(x0, y0, x1 - x0, y1 - y0);
    pen.fillStyle = hatch(pen); pen.fillRect(x0, y0, x1 - x0, y1 - y0);
    pen.imageSmoothingEnabled = false; pen.drawImage(image, x0, y0, x1 - x0, y1 - y0);
    const path = (points, close) => common.path(pen, points, project, close);
    for (const f of data.site.forests) { path(f, true); pen.strokeStyle = "#fff"; pen.lineWidth = 2.2; pen.stroke(); pen.strokeStyle = "#2F5D28"; pen.lineWidth = 1.1; pen.setLineDash([4, 2]); pen.stroke(); pen.setLineDash([]); }
    for (const faces of data.site.buildings) for (const face of faces) { path(face, true); pen.fillStyle = "#fff"; pen.strokeStyle = "#000"; pen.lineWidth = 0.8; pen.fill("evenodd"); pen.stroke(); }
    const tower = chosen("Tower", state.a);
    if (!tower || tower === data.joint) for (const line of data.borders) { path(line); pen.strokeStyle = "#fff"; pen.lineWidth = 2.4; pen.stroke(); pen.strokeStyle = "#000"; pen.lineWidth = 1.1; pen.setLineDash([6, 3]); pen.stroke(); pen.setLineDash([]); }
    if (data.flown.length && at("flown").checked) for (const line of data.flown) { path(line); pen.strokeStyle = "#fff"; pen.lineWidth = 2.6; pen.stroke(); pen.strokeStyle = "#7a1fa2"; pen.lineWidth = 1.2; pen.stroke(); }
    if (state.line) { path(state.line); pen.strokeStyle = "#fff"; pen.lineWidth = 4.5; pen.stroke(); pen.strokeStyle = "#c1121f"; pen.lineWidth = 2.2; pen.stroke(); }
    for (const t of data.site.towers) {
      const own = !tower || tower === data.joint || tower === t.name;
      common.tower(pen, project.x(t.at[0]), project.y(t.at[1]), own ? 1 : 0.35);
    }
    labels = common.names(pen, [46, 8, w - 16, h - 32], data.site.towers.map(t => ({ text: t.name, at: [project.x(t.at[0]), project.y(t.at[1])], colour: "#8f0f18", halo: "#fff", alpha: !tower || tower === data.joint || tower === t.name ? 1 : 0.35 })), data.site.credit);
    if (state.cell) {
      const [r, c] = state.cell, x = project.x(east[c] - data.half[0]), y = project.y(north[r] + data.half[1]), wide = 2 * data.half[0] * project.scale, high = 2 * data.half[1] * project.scale;
      pen.strokeStyle = "#000"; pen.lineWidth = 3; pen.strokeRect(x, y, wide, high); pen.strokeStyle = "#F0C000"; pen.lineWidth = 1.6; pen.strokeRect(x, y, wide, high);
    }
    pen.restore();
    common.planAxes(pen, project, w, h);
  }

  function drawLegend() {
    const [pen, w] = frame(legend), q = quantity(), ends = limits();
    pen.textAlign = "left"; pen.fillStyle = css("--ink");
    const name = state.difference ? `A − B: ${q.name}` : q.name, said = unit();
    let x = 46;
    pen.fillStyle = css("--band"); pen.fillRect(x, 6, 26, 14); pen.fillStyle = hatch(pen); pen.fillRect(x, 6, 26, 14); pen.strokeStyle = css("--soft"); pen.strokeRect(x, 6, 26, 14);
    pen.fillStyle = css("--ink"); pen.fillText(state.difference ? "missing in A or B" : "no value: no path", x + 32, 17);
    x += 32 + pen.measureText("no value: missing in A").width;
    if (asClasses()) {
      let line = 6; x = 46; line = 28;
      q.classes.forEach((c, i) => {
        if (!q.colours[i]) return;
        const text = q.classes[0] === "Z" ? `rank ${c}` : c, wide = 30 + pen.measureText(text).width;
        if (x + wide > w) { x = 46; line += 20; }
        pen.fillStyle = q.colours[i]; pen.fillRect(x, line, 18, 14); pen.strokeStyle = css("--soft"); pen.strokeRect(x, line, 18, 14);
        pen.fillStyle = css("--ink"); pen.fillText(text, x + 23, line + 12); x += wide + 8;
      });
      return;
    }
    common.colourBar(pen, ramped(), ends, [46, w - 40], 26);
    pen.textAlign = "right"; pen.fillText(`${name}${said ? ` [${said}]` : ""}`, w - 40, 17); pen.textAlign = "left";
  }

  // --- texts and numbers --------------------------------------------------------------------------------------------

  function chosen(axis, choice) { const i = quantity().axes.findIndex(x => x.name === axis); return i < 0 ? null : quantity().axes[i].values[choice[i]]; }

  function degrees(e, n) {
    const g = data.degrees, u = (e - g.middle[0]) / g.reach[0], v = (n - g.middle[1]) / g.reach[1];
    let lat = 0, lon = 0;
    g.powers.forEach(([p, q], i) => { const term = u ** p * v ** q; lat += g.lat[i] * term; lon += g.lon[i] * term; });
    return [lat, lon];
  }

  function column(cell) { // values of a cell at all heights of the chosen layer
    const i = quantity().axes.findIndex(axis => axis.name === "Height");
    if (i < 0 || !cell) return [];
    const at = cell[0] * columns + cell[1];
    const of = choice => k => { const other = [...choice]; other[i] = k; const l = layer(other); return l ? l[at] : NaN; };
    return quantity().axes[i].values.map((name, k) => {
      const v = of(state.a)(k);
      return [parseFloat(name), state.difference ? v - of(state.b)(k) : v];
    }).sort((x, y) => x[0] - y[0]);
  }

  function describe() {
    if (!state.cell) { cells(at("here"), [["Cell", "point at the map"]]); return; }
    const [r, c] = state.cell, i = r * columns + c, [lat, lon] = degrees(east[c], north[r]), out = [];
    if (state.difference) out.push(["A", cellWords(a, i)], ["B", cellWords(b, i)], ["A − B", words(shown ? shown[i] : NaN, 1)]);
    else out.push([quantity().name, words(shown ? shown[i] : NaN, 1)]);
    out.push(["East, north", `${number(east[c], 1)}, ${number(north[r], 1)} m`], ["Latitude, longitude", `${number(lat, 6)}°, ${number(lon, 6)}°`]);
    let near = null;
    for (const t of data.site.towers) { const d = Math.hypot(t.at[0] - east[c], t.at[1] - north[r]); if (!near || d < near[1]) near = [t.name, d]; }
    if (near) out.push(["Nearest tower", `${near[0]}, ${number(near[1], 0)} m on the ground`]);
    const up = column(state.cell);
    if (up.length > 1) out.push(["Over height", up.map(([z, v]) => `${z} m: ${words(v)}`).join("; ")]);
    cells(at("here"), out);
  }
  function cellWords(values, i) {
    const q = quantity(), v = values ? values[i] : NaN;
    if (q.kind === "classes") return Number.isFinite(v) ? q.classes[v] : "no path";
    return Number.isFinite(v) ? number(v, q.step < 1 ? 2 : 0, q.unit) : "no value";
  }

  function summarise() {
    const s = statistics(), out = [], percent = v => number(100 * v, 1, "%"), q = quantity();
    const none = !a ? "A" : state.difference && !b ? "B" : "";
    if (none) out.push(["Layer", `there is no layer ${none} for these choices`]);
    else if (s.share) s.share.forEach((share, i) => out.push([q.classes[0] === "Z" ? (i ? `Rank ${q.classes[i]}` : "No path") : q.classes[i], percent(share)]));
    else {
      out.push([state.difference ? "Cells with both" : "Cells with a value", `${percent(s.covered)} of ${count(s.cells)} cells`]);
      if (s.n) out.push(["Median", words(s.median, 1)], ["Mean", q.kind === "classes" ? number(s.mean, 2) : words(s.mean, 1)], ["10th / 90th percentile", `${words(s.p10, 1)}; ${words(s.p90, 1)}`], ["Minimum / maximum", `${words(s.min, 1)}; ${words(s.max, 1)}`]);
      if (state.difference) out.push(["RMS", q.kind === "classes" ? number(s.rms, 2) : words(s.rms, 1)], ["A above B, below B", `${percent(s.up)}, ${percent(s.down)}`], ["Only in A, only in B", `${percent(s.onlyA)}, ${percent(s.onlyB)}`]);
    }
    cells(at("numbers"), out);
    const title = `${q.name}${named(state.a) ? ": " + named(state.a) : ""}`;
    at("title").textContent = state.difference ? `A: ${title}. B: ${named(state.b) || q.name}. Shown: A minus B.` : title;
  }

  // --- profile and distribution -------------------------------------------------------------------------------------

  function cellAt(e, n) {
    const c = Math.floor((e - edges[0]) / (edges[1] - edges[0]) * columns), r = Math.floor((n - edges[2]) / (edges[3] - edges[2]) * rows);
    return c >= 0 && c < columns && r >= 0 && r < rows ? [r, c] : null;
  }
  function profile() { // [distance along the line, value of the cell that contains the point]
    if (!state.line || !shown) return [];
    const [[e0, n0], [e1, n1]] = state.line, length = Math.hypot(e1 - e0, n1 - n0), steps = Math.max(2, Math.min(2000, Math.ceil(length / Math.min(...data.half))));
    return Array.from({ length: steps + 1 }, (_, i) => {
      const t = i / steps, cell = cellAt(e0 + t * (e1 - e0), n0 + t * (n1 - n0));
      return [t * length, cell ? shown[cell[0] * columns + cell[1]] : NaN];
    });
  }
  function classAxis(values) {
    const q = quantity();
    if (asClasses()) return { low: -0.4, high: q.classes.length - 0.6, label: q.name, marks: q.classes.map((_, i) => i), words: i => q.classes[i] };
    let low = Infinity, high = -Infinity;
    for (const v of values) if (Number.isFinite(v)) { low = Math.min(low, v); high = Math.max(high, v); }
    if (!(high > low)) { low = (Number.isFinite(low) ? low : 0) - 1; high = low + 2; }
    return { low, high, label: (state.difference ? "A − B" : q.name.length > 22 ? "" : q.name) + (unit() ? ` [${unit()}]` : "") };
  }
  function drawProfile() {
    const [pen, w, h] = frame(at("profile")), along = profile(), up = along.length ? [] : column(state.cell), points = along.length ? along : up;
    common.saves(at("profile"), "Profile", () => [[along.length ? "distance_m" : "height_m", quantity().name], ...points], drawProfile);
    if (!along.length && up.length < 2) {
      pen.fillStyle = css("--soft"); pen.textAlign = "left"; pen.fillText("Drag over the map: profile along the line.", 10, 24); pen.fillText("Point at a cell: its values over height.", 10, 44);
      return;
    }
    const g = axes(pen, w, h, { low: points[0][0], high: points[points.length - 1][0], label: along.length ? "Distance along the line [m]" : "Height at the selected cell [m]" }, classAxis(points.map(p => p[1])));
    pen.strokeStyle = css("--accent"); pen.fillStyle = css("--accent"); pen.lineWidth = 1.6; pen.beginPath();
    let on = false;
    for (const [x, v] of points) { if (!Number.isFinite(v)) { on = false; continue; } if (on) pen.lineTo(g.X(x), g.Y(v)); else pen.moveTo(g.X(x), g.Y(v)); on = true; }
    pen.stroke();
    if (!along.length) for (const [x, v] of points) if (Number.isFinite(v)) { pen.beginPath(); pen.arc(g.X(x), g.Y(v), 3.2, 0, 7); pen.fill(); }
  }
  function drawHistogram() {
    const [pen, w, h] = frame(at("histogram")), q = quantity();
    if (!shown) return;
    const finite = shown.filter(Number.isFinite);
    let bars;
    if (asClasses()) { const s = statistics(); bars = q.classes.map((name, i) => [i - 0.4, i + 0.4, s.share[i]]); }
    else {
      const y = classAxis(finite), whole = q.kind === "classes" || finite.every(Number.isInteger) && y.high - y.low < 40, n = whole ? Math.round(y.high - y.low) + 1 : 40;
      const low = whole ? y.low - 0.5 : y.low, wide = whole ? 1 : (y.high - y.low) / n, counts = new Array(n).fill(0);
      for (const v of finite) counts[Math.max(0, Math.min(n - 1, Math.floor((v - low) / wide)))]++;
      bars = counts.map((c, i) => [low + i * wide, low + (i + 1) * wide, c / shown.length]);
    }
    common.saves(at("histogram"), "Distribution", () => [["from", "to", "share"], ...bars], drawHistogram);
    const most = Math.max(1e-6, ...bars.map(x => x[2])), x = classAxis(finite);
    const g = axes(pen, w, h, { ...x, low: Math.min(x.low, bars[0][0]), high: Math.max(x.high, bars[bars.length - 1][1]) }, { low: 0, high: 100 * most, label: "Share of cells [%]" });
    bars.forEach(([low, high, share], i) => {
      const c = asClasses() ? (q.colours[i] || "#999999") : css("--measured");
      pen.fillStyle = c; pen.fillRect(g.X(low), g.Y(100 * share), Math.max(1, g.X(high) - g.X(low) - 1), g.bottom - g.Y(100 * share));
    });
  }

  // --- choices --------------------------------------------------------------------------------------------------------

  function selects(target, letter) {
    const q = quantity();
    target.replaceChildren(...q.axes.map((axis, i) => {
      const label = document.createElement("label"), select = document.createElement("select");
      label.append(axis.name + " ", select); select.id = `${letter}-${axis.name.toLowerCase()}`;
      fill(select, axis.values.map(v => v === data.joint ? "nearest tower" : v), state[letter][i]);
      select.addEventListener("change", () => { state[letter][i] = +select.value; everything(); });
      return label;
    }));
  }
  function nearestLayer(wanted) { // the layer that agrees in the most axes; the first axes count most
    const keys = Object.keys(quantity().layers).map(k => k === "" ? [] : k.split(",").map(Number));
    let best = keys[0], most = -1;
    for (const k of keys) { const same = k.reduce((t, v, i) => t + (v === wanted[i] ? 1 : 0), 0); if (same > most) { most = same; best = k; } }
    return [...best];
  }
  function carry(before, choice) { // the choice with the same tower, height, ... in another quantity
    return quantity().axes.map(axis => {
      const i = before ? before.axes.findIndex(x => x.name === axis.name) : -1, value = i < 0 ? null : before.axes[i].values[choice[i]];
      return Math.max(0, axis.values.indexOf(value));
    });
  }
  function setQuantity(i) {
    const before = data.quantities[state.quantity], [wasA, wasB] = [state.a, state.b];
    state.quantity = i;
    state.a = nearestLayer(carry(before, wasA));
    state.b = nearestLayer(carry(before, wasB));
    controls();
  }
  function controls() {
    fill(at("quantity"), data.quantities.map(q => q.name), state.quantity, true);
    at("scale").value = state.scale; at("difference").checked = state.difference;
    at("difference").closest("label").hidden = Object.keys(quantity().layers).length < 2;
    at("scale").closest("label").hidden = quantity().kind === "classes" || state.difference;
    at("choices-b").hidden = !state.difference;
    selects(at("axes-a"), "a"); selects(at("axes-b"), "b");
    at("steps").textContent = `This page stores values in steps of ${quantity().kind === "classes" ? "one class" : quantity().step + (quantity().unit ? " " + quantity().unit : "")}; files in the same folder contain the exact values.`
      + (data.left_out ? ` To limit its size, the page does not contain ${data.left_out}.` : "")
      + (data.stride > 1 ? " The numbers of the layer are computed from the cells in this page." : "");
  }
  function setDifference(on) {
    state.difference = on && Object.keys(quantity().layers).length > 1;
    if (state.difference && state.a.join() === state.b.join()) { // B becomes another layer, because the difference would be zero
      const keys = Object.keys(quantity().layers), axis = ["Foliage", "Height", "Tower", "K", "Antennas"].map(n => quantity().axes.findIndex(x => x.name === n)).find(i => i >= 0 && quantity().axes[i].values.length > 1);
      const other = [...state.a];
      if (axis !== undefined) other[axis] = (other[axis] + 1) % quantity().axes[axis].values.length;
      state.b = quantity().layers[other.join(",")] !== undefined ? other : keys.find(k => k !== state.a.join(",")).split(",").map(Number);
    }
    controls();
  }
  function everything() { compute(); common.saves(canvas, "Map", cellValues, drawMap, legend); later(drawMap, drawLegend, drawProfile, drawHistogram, describe, summarise); }

  at("quantity").addEventListener("change", e => { setQuantity(+e.target.value); if (state.difference) setDifference(true); everything(); });
  at("scale").addEventListener("change", e => { state.scale = e.target.value; everything(); });
  at("difference").addEventListener("change", e => { setDifference(e.target.checked); everything(); });
  at("flown-choice").hidden = !data.flown.length; at("flown").addEventListener("change", everything);
  at("swap").addEventListener("click", () => { [state.a, state.b] = [state.b, state.a]; controls(); everything(); });
  at("view-all").addEventListener("click", () => { Object.assign(state, { zoom: 1, east: 0, north: 0 }); later(drawMap); });
  at("clear-line").addEventListener("click", () => line(null));

  // --- pointer and keys -----------------------------------------------------------------------------------------------

  function point(cell) { state.cell = cell; later(drawMap, describe, drawProfile); }
  function line(ends) { state.line = ends; later(drawMap, drawProfile); }
  const place = e => { const r = canvas.getBoundingClientRect(); return [project.east(e.clientX - r.left), project.north(e.clientY - r.top)]; };
  let held = null;
  canvas.addEventListener("pointerdown", e => { canvas.setPointerCapture(e.pointerId); held = { from: place(e), x: e.clientX, y: e.clientY, move: e.shiftKey }; });
  canvas.addEventListener("pointerup", () => { held = null; });
  canvas.addEventListener("pointercancel", () => { held = null; });
  canvas.addEventListener("pointermove", e => {
    if (held && held.move) {
      state.east -= (e.clientX - held.x) / project.scale; state.north += (e.clientY - held.y) / project.scale;
      held.x = e.clientX; held.y = e.clientY; later(drawMap);
      return;
    }
    const here = place(e), cell = cellAt(...here);
    if (held && Math.hypot(e.clientX - held.x, e.clientY - held.y) > 6) line([held.from, here]);
    if (cell && (!state.cell || cell[0] !== state.cell[0] || cell[1] !== state.cell[1])) point(cell);
  });
  canvas.addEventListener("pointerdown", e => { const cell = cellAt(...place(e)); if (cell) point(cell); });
  const zoom = by => { state.zoom = Math.min(40, Math.max(0.5, state.zoom * by)); later(drawMap); };
  canvas.addEventListener("wheel", e => { if (!e.ctrlKey && !e.metaKey && document.activeElement !== canvas) return; e.preventDefault(); zoom(Math.exp(-e.deltaY * 0.0015)); }, { passive: false });
  root.addEventListener("keydown", e => {
    if (["SELECT", "INPUT", "BUTTON"].includes(e.target.tagName)) return;
    const step = { ArrowLeft: [0, -1], ArrowRight: [0, 1], ArrowUp: [1, 0], ArrowDown: [-1, 0] }[e.key], cell = state.cell || [Math.floor(rows / 2), Math.floor(columns / 2)];
    const here = state.cell && [east[cell[1]], north[cell[0]]];
    if (step) { e.preventDefault(); const k = e.shiftKey ? 10 : 1; point([Math.max(0, Math.min(rows - 1, cell[0] + k * step[0])), Math.max(0, Math.min(columns - 1, cell[1] + k * step[1]))]); }
    else if (e.key === "[" && here) line([here, state.line ? state.line[1] : here]);
    else if (e.key === "]" && here) line([state.line ? state.line[0] : here, here]);
    else if (e.key === "Escape") line(null);
    else if (e.key === "+" || e.key === "=") zoom(1.25);
    else if (e.key === "-") zoom(0.8);
  });
  whenResized(root, () => { image = null; drawMap(); drawLegend(); drawProfile(); drawHistogram(); });

  common.plots(data.plots, i => i === undefined ? null : arrays[i]);
  document.documentElement.classList.add("live");
  setQuantity(0);
  state.b = [...state.a];
  everything();
  window.mapExplorer = { state, data, statistics, layer, degrees, profile, column, cellAt, limits, point, line, setQuantity, setDifference, everything, shown: () => shown, labels: () => labels, project: () => project, ready: true };
})().catch(error => { // a browser that is too old: the tables remain visible
  document.documentElement.classList.remove("live");
  console.error(error);
});
