"use strict";
// Values at points on the plan of the site or on a turning sphere of directions, at the pointer, and along a route.
(async () => {
  const { at, css, number, count, cells, fill, frame, axes, later, polyline } = common;
  const data = JSON.parse(at("explorer-data").textContent), arrays = await common.unpack(data.packed);
  const ramps = { level: common.ramp("viridis"), spread: common.ramp("plasma"), residual: common.ramp("RdBu_r") };
  document.documentElement.classList.add("live");
  common.plots(data.plots, i => i === undefined ? null : arrays[i]);
  if (!data.groups.length) return; // a page with charts only
  const canvas = at("map"), legend = at("legend"), chart = at("profile");
  const state = { group: 0, layer: 0, point: null, zoom: 1, east: 0, north: 0, turn: -Math.PI / 2, tilt: 0.6 };
  const group = () => data.groups[state.group], layer = () => group().layers[state.layer], sphere = () => group().around.length > 0;
  const taken = new Map();
  const values = l => { if (!taken.has(l)) taken.set(l, common.values(arrays[l.values], l.step)); return taken.get(l); };
  const unit = l => (l.name.match(/\[(.*)\]/) || [])[1] || "", ranked = l => l.name.includes("rank") && !l.name.includes("probability");
  const words = (l, v) => !Number.isFinite(v) ? "–" : ranked(l) ? String(v) : number(v, unit(l) || Math.abs(v) > 2 ? 1 : 2, unit(l));
  const ramped = l => ramps[l.name.includes("deviation") ? "spread" : l.name.startsWith("residual") ? "residual" : "level"];
  function colour(l, v) {
    if (!Number.isFinite(v)) return css("--line");
    if (ranked(l)) return data.ranks[v] || css("--line");
    const [low, high] = l.range;
    return `rgb(${ramped(l)((v - low) / (high - low))})`;
  }

  // --- the plan and the sphere ----------------------------------------------------------------------------------------

  let project = null, drawn = [], labels = [];
  function limits() { // extent of the points of this group, of the lines, and of towers that are no farther than it is wide
    const [e, n] = group().at.map(i => arrays[i]), all = [[...e].filter(Number.isFinite), [...n].filter(Number.isFinite)];
    for (const line of [...data.lines, ...data.rings]) for (const [x, y] of line) { all[0].push(x); all[1].push(y); }
    const ends = all.flatMap(list => [list.reduce((a, b) => Math.min(a, b), Infinity), list.reduce((a, b) => Math.max(a, b), -Infinity)]);
    const size = Math.max(ends[1] - ends[0], ends[3] - ends[2], 50), room = 0.04 * size, [west, east, south, north] = ends;
    for (const { at: [x, y] } of data.site.towers) {
      if (x < west - size || x > east + size || y < south - size || y > north + size) continue;
      [x, x, y, y].forEach((v, i) => { ends[i] = i % 2 ? Math.max(ends[i], v) : Math.min(ends[i], v); });
    }
    return ends.map((v, i) => v + (i % 2 ? room : -room));
  }
  function drawPlan(pen, w, h) {
    const area = [46, 8, w - 16, h - 32], g = group(), v = values(layer()), [e, n] = g.at.map(i => arrays[i]);
    project = common.plan(area, limits(), state.zoom, [state.east, state.north]);
    pen.save(); pen.beginPath(); pen.rect(area[0], area[1], area[2] - area[0], area[3] - area[1]); pen.clip();
    const path = (points, close) => common.path(pen, points, project, close);
    for (const f of data.site.forests) { path(f, true); pen.fillStyle = css("--forest"); pen.fill(); }
    const side = g.cell ? Math.max(g.cell * project.scale + 0.5, 1.5) : 7;
    drawn = Array.from(v, (value, i) => {
      const p = [project.x(e[i]), project.y(n[i])];
      pen.fillStyle = colour(layer(), value);
      if (g.cell) { const [a, b] = [Math.floor(p[0] - side / 2), Math.floor(p[1] - side / 2)]; pen.fillRect(a, b, Math.ceil(p[0] + side / 2) - a, Math.ceil(p[1] + side / 2) - b); }
      else { pen.beginPath(); pen.arc(p[0], p[1], side / 2, 0, 7); pen.fill(); }
      return p;
    });
    for (const faces of data.site.buildings) for (const face of faces) { path(face, true); pen.fillStyle = css("--building"); pen.fill(); pen.strokeStyle = css("--ink"); pen.lineWidth = 0.6; pen.stroke(); }
    for (const ring of data.rings) { path(ring, true); pen.strokeStyle = css("--soft"); pen.lineWidth = 1.2; pen.setLineDash([6, 4]); pen.stroke(); pen.setLineDash([]); }
    for (const line of data.lines) { path(line); pen.strokeStyle = css("--paper"); pen.lineWidth = 2.6; pen.stroke(); pen.strokeStyle = css("--ink"); pen.lineWidth = 1.1; pen.stroke(); }
    for (const t of data.site.towers) common.tower(pen, project.x(t.at[0]), project.y(t.at[1]));
    labels = common.names(pen, area, data.site.towers.map(t => ({ text: t.name, at: [project.x(t.at[0]), project.y(t.at[1])], colour: css("--accent"), halo: css("--paper") })), data.site.credit);
    mark(pen); pen.restore();
    common.planAxes(pen, project, w, h);
  }
  const spacing = new Map();
  function apart(g) { // the largest distance of a direction to its nearest neighbour, from about 60 directions
    if (!spacing.has(g)) {
      const [x, y, z] = g.at.map(i => arrays[i]), n = x.length;
      let most = 0;
      for (let i = 0; i < n; i += Math.ceil(n / 60)) { let near = 4; for (let k = 0; k < n; k++) { const d = (x[i] - x[k]) ** 2 + (y[i] - y[k]) ** 2 + (z[i] - z[k]) ** 2; if (d > 1e-9 && d < near) near = d; } most = Math.max(most, near); }
      spacing.set(g, Math.sqrt(most));
    }
    return spacing.get(g);
  }
  function drawSphere(pen, w, h) {
    const g = group(), v = values(layer()), [x, y, z] = g.at.map(i => arrays[i]), r = state.zoom * (Math.min(w, h) / 2 - 26);
    const [ct, st, ce, se] = [Math.cos(state.turn), Math.sin(state.turn), Math.cos(state.tilt), Math.sin(state.tilt)];
    const shape = (a, b, c) => { const ahead = ct * a + st * b; return [w / 2 + r * (ct * b - st * a), h / 2 - r * (ce * c - se * ahead), ce * ahead + se * c]; };
    const circle = (f, colour) => { let run = []; for (let a = 0; a <= 120; a++) { const p = shape(...f(a * Math.PI / 60)); if (p[2] > 0) run.push(p); if (run.length && (p[2] <= 0 || a === 120)) { polyline(pen, run, colour, 0.8); run = []; } } };
    pen.fillStyle = css("--band"); pen.beginPath(); pen.arc(w / 2, h / 2, r, 0, 7); pen.fill();
    drawn = Array.from(v, (_, i) => shape(x[i], y[i], z[i]));
    const side = 1.35 * r * apart(g), order = [...drawn.keys()].filter(i => drawn[i][2] > 0).sort((a, b) => drawn[a][2] - drawn[b][2]);
    for (const i of order) { pen.fillStyle = colour(layer(), v[i]); pen.beginPath(); pen.arc(drawn[i][0], drawn[i][1], side / 2, 0, 7); pen.fill(); }
    const [a, b, c] = g.dots.map(i => arrays[i]);
    for (let i = 0; i < a.length; i++) { const p = shape(a[i], b[i], c[i]); if (p[2] > 0) { pen.fillStyle = "#000"; pen.fillRect(p[0] - 1, p[1] - 1, 2, 2); pen.fillStyle = "#fff"; pen.fillRect(p[0], p[1], 1, 1); } }
    for (const up of [-60, -30, 0, 30, 60]) { const k = up * Math.PI / 180; circle(t => [Math.cos(k) * Math.cos(t), Math.cos(k) * Math.sin(t), Math.sin(k)], up ? css("--soft") : css("--ink")); }
    for (let k = 0; k < 8; k++) { const f = k * Math.PI / 4; circle(t => [Math.sin(t / 2) * Math.cos(f), Math.sin(t / 2) * Math.sin(f), Math.cos(t / 2)], css("--soft")); }
    const marks = [...g.around.map((name, k) => [name, shape(1.06 * Math.cos(k * Math.PI / 2), 1.06 * Math.sin(k * Math.PI / 2), 0)]), ["up", shape(0, 0, 1.06)], ["down", shape(0, 0, -1.06)]];
    labels = common.names(pen, [0, 0, w, h], marks.filter(([, p]) => p[2] > -0.2).map(([text, p]) => ({ text, at: [p[0], p[1]], colour: css("--ink"), halo: css("--paper") })));
    drawn.forEach((p, i) => { if (p[2] <= 0) drawn[i] = [NaN, NaN]; });
    mark(pen);
  }
  function mark(pen) {
    const p = state.point === null ? null : drawn[state.point];
    if (!p || !Number.isFinite(p[0])) return;
    for (const [colour, wide] of [["#000", 3], ["#F0C000", 1.6]]) { pen.beginPath(); pen.arc(p[0], p[1], 6, 0, 7); pen.strokeStyle = colour; pen.lineWidth = wide; pen.stroke(); }
  }
  function drawMap() { const [pen, w, h] = frame(canvas); (sphere() ? drawSphere : drawPlan)(pen, w, h); }

  function drawLegend() {
    const [pen, w] = frame(legend), l = layer(), left = 46, right = Math.min(w - 16, 700);
    pen.fillStyle = css("--ink"); pen.textAlign = "left"; pen.fillText(l.name, left, 14);
    if (!ranked(l)) { common.colourBar(pen, ramped(l), l.range, [left, right], 22); return; }
    Object.entries(data.ranks).forEach(([rank, shade], i) => { pen.fillStyle = shade; pen.fillRect(left + 76 * i, 24, 18, 14); pen.fillStyle = css("--ink"); pen.fillText(`rank ${rank}`, left + 76 * i + 23, 36); });
  }

  function drawAlong() {
    const g = group(), l = layer(), v = values(l), time = g.time === null ? null : arrays[g.time];
    at("along").hidden = time === null;
    if (time === null) return;
    const [pen, w, h] = frame(chart), banded = state.layer === 0 && g.band.length === 2, [low, high] = g.band.map(values), ends = [1e9, -1e9];
    for (const list of banded ? [v, low, high] : [v]) for (const x of list) if (Number.isFinite(x)) { ends[0] = Math.min(ends[0], x); ends[1] = Math.max(ends[1], x); }
    const table = { time_s: time, [l.name]: v, ...(banded ? { [g.band[0].name]: low, [g.band[1].name]: high } : {}) };
    common.saves(chart, `${g.name} over time`, () => [Object.keys(table), ...Array.from(time, (_, i) => Object.values(table).map(list => list[i]))], drawAlong);
    const room = 0.05 * (ends[1] - ends[0]) || 0.5, known = [...v.keys()].filter(i => Number.isFinite(v[i]));
    const a = axes(pen, w, h, { low: time[0], high: time[time.length - 1], label: "Time along the route [s]" }, { low: ends[0] - room, high: ends[1] + room, label: l.name[0].toUpperCase() + l.name.slice(1) });
    if (banded) common.polygon(pen, [...known.map(i => [a.X(time[i]), a.Y(low[i])]), ...known.reverse().map(i => [a.X(time[i]), a.Y(high[i])])], css("--band-90"));
    polyline(pen, [...v.keys()].filter(i => Number.isFinite(v[i])).map(i => [a.X(time[i]), a.Y(v[i])]), css("--ink"), 1.4);
    if (state.point !== null) polyline(pen, [[a.X(time[state.point]), a.top], [a.X(time[state.point]), a.bottom]], css("--accent"), 1);
    at("along-words").textContent = banded ? "Line: median. Band: the interval that contains 90 % of the samples." : "";
  }

  // --- texts, choices and the pointer -----------------------------------------------------------------------------------

  const degrees = x => x * 180 / Math.PI;
  function place(i) {
    const [a, b, c] = group().at.map(k => arrays[k][i]);
    return sphere() ? [["Azimuth, elevation", `${number((degrees(Math.atan2(b, a)) + 360) % 360, 0)}°, ${number(degrees(Math.asin(c)), 0)}°`]] : [["East, north, up", `${number(a, 0)}, ${number(b, 0)}, ${number(c, 1)} m`]];
  }
  function describe() {
    const i = state.point;
    cells(at("here"), i === null ? [["At the pointer", `point at the ${sphere() ? "sphere" : "map"}`]] : [...place(i), ...group().layers.map(l => [l.name.replace(/ \[.*\]/, ""), words(l, values(l)[i])])]);
  }
  function everything() { later(drawMap, drawLegend, drawAlong, describe); }
  function choose(i, name = "") {
    const same = group().around.join() === data.groups[i].around.join();
    state.group = i; state.point = null;
    state.layer = Math.max(0, group().layers.findIndex(l => l.name === name));
    if (!same) Object.assign(state, { zoom: 1, east: 0, north: 0 });
    fill(at("layer"), group().layers.map(l => l.name), state.layer, true);
    at("plan-buttons").hidden = sphere(); at("sphere-buttons").hidden = !sphere();
    const n = arrays[group().at[0]].length, some = n < group().of ? ` ${count(n)} of ${count(group().of)} points are in this page; the files in the same folder contain all.` : "";
    at("hint").textContent = `${sphere() || !data.note ? "" : data.note + " "}Drag to ${sphere() ? "rotate" : "move"}; Ctrl + wheel or + and − to zoom; arrow keys move the pointer.${group().dots.length && arrays[group().dots[0]].length ? " Dots: directions flown." : ""}${some}`;
    const rows = () => [[...(sphere() ? ["x", "y", "z"] : ["east_m", "north_m", "up_m"]), ...group().layers.map(l => l.name)], ...Array.from({ length: n }, (_, k) => [...group().at.map(j => arrays[j][k]), ...group().layers.map(l => values(l)[k])])];
    at("saves").replaceChildren(common.downloads(canvas, group().name, rows, drawMap));
    everything();
  }
  fill(at("group"), data.groups.map(g => g.name), 0);
  at("group").addEventListener("change", e => choose(+e.target.value, layer().name));
  at("layer").addEventListener("change", e => { state.layer = +e.target.value; everything(); });
  at("view-all").addEventListener("click", () => { Object.assign(state, { zoom: 1, east: 0, north: 0 }); later(drawMap); });
  at("view-above").addEventListener("click", () => { Object.assign(state, { zoom: 1, turn: -Math.PI / 2, tilt: Math.PI / 2 }); later(drawMap); });
  at("view-side").addEventListener("click", () => { Object.assign(state, { zoom: 1, tilt: 0 }); later(drawMap); });

  function point(i) { state.point = i; later(drawMap, drawAlong, describe); }
  let held = null;
  canvas.addEventListener("pointerdown", e => { canvas.setPointerCapture(e.pointerId); held = [e.clientX, e.clientY]; });
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, () => { held = null; });
  canvas.addEventListener("pointermove", e => {
    if (held) {
      const [dx, dy] = [e.clientX - held[0], e.clientY - held[1]];
      if (sphere()) { state.turn -= dx * 0.008; state.tilt = Math.min(Math.PI / 2, Math.max(-Math.PI / 2, state.tilt + dy * 0.008)); }
      else { state.east -= dx / project.scale; state.north += dy / project.scale; }
      held = [e.clientX, e.clientY]; later(drawMap);
      return;
    }
    const r = canvas.getBoundingClientRect(), [x, y] = [e.clientX - r.left, e.clientY - r.top];
    let best = null, near = 20;
    drawn.forEach((p, i) => { const d = Math.hypot(p[0] - x, p[1] - y); if (d < near) { near = d; best = i; } });
    if (best !== null && best !== state.point) point(best);
  });
  const zoom = by => { state.zoom = Math.min(40, Math.max(0.5, state.zoom * by)); later(drawMap); };
  canvas.addEventListener("wheel", e => { if (!e.ctrlKey && !e.metaKey && document.activeElement !== canvas) return; e.preventDefault(); zoom(Math.exp(-e.deltaY * 0.0015)); }, { passive: false });
  canvas.addEventListener("keydown", e => {
    const step = { ArrowLeft: -1, ArrowRight: 1, ArrowUp: 10, ArrowDown: -10 }[e.key], n = drawn.length;
    if (step) { e.preventDefault(); point(state.point === null ? 0 : (state.point + step + n) % n); }
    else if (e.key === "+" || e.key === "=") zoom(1.25);
    else if (e.key === "-") zoom(0.8);
  });
  common.whenResized(at("explorer"), () => { drawMap(); drawLegend(); drawAlong(); });

  choose(0);
  window.places = { state, data, values, choose, point, drawn: () => drawn, labels: () => labels, ready: true };
})().catch(error => { // a browser that is too old
  document.documentElement.classList.remove("live");
  console.error(error);
});
