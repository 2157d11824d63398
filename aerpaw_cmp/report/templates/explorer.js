"use strict";
// The linked views: a map and charts over time show one pose, one segment and one choice of series.
// Numbers of a segment follow aerpaw_cmp.compare: offset on the grid, RMSE with this offset, Pearson correlation.
(async () => {
  const data = JSON.parse(document.getElementById("explorer-data").textContent);
  const root = document.getElementById("explorer");
  const { at, css, number, count, cells, fill, axes, later, shade } = common;

  const arrays = await common.unpack(data.packed), get = i => i === undefined || i === null ? null : arrays[i];

  const state = { series: 0, model: 0, k: 0, span: null, pose: null, colour: "residual", against: 0, turn: 0, tilt: Math.PI / 2, zoom: 1, east: 0, north: 0 };
  const rss = () => data.rss[state.series] || null;
  const rank = () => {
    const tower = rss() ? rss().tower : null;
    return data.rank.find(r => r.tower === tower) || (rss() ? null : data.rank[state.series] || null);
  };

  // --- numbers ------------------------------------------------------------------------------------------------------

  function gridOffset(meanDifference) {
    const [low, high] = data.span_db, exact = meanDifference / data.step_db, whole = Math.trunc(exact);
    const rest = Math.abs(exact - whole);
    const steps = rest > 0.5 + 1e-9 ? whole + Math.sign(exact) : whole; // the offset nearer to zero wins a tie
    return Math.min(high, Math.max(low, steps * data.step_db));
  }

  function residuals() {
    const s = rss();
    if (!s) return null;
    const model = s.models[state.model], level = get(model.level), measured = get(s.measured), out = new Float64Array(level.length);
    for (let i = 0; i < out.length; i++) out[i] = measured[i] + (model.offset ?? NaN) - level[i];
    return out;
  }

  function statistics() {
    const s = rss();
    if (!s) return null;
    const time = get(s.time), measured = get(s.measured), model = s.models[state.model], level = get(model.level);
    let n = 0, sm = 0, sl = 0;
    const used = [];
    for (let i = 0; i < time.length; i++) {
      if (!Number.isFinite(measured[i]) || !Number.isFinite(level[i])) continue;
      if (state.span && (time[i] < state.span[0] || time[i] > state.span[1])) continue;
      used.push(i); n++; sm += measured[i]; sl += level[i];
    }
    if (!n) return { n: 0 };
    const mm = sm / n, ml = sl / n, own = gridOffset(ml - mm);
    let vm = 0, vl = 0, both = 0, ownSquare = 0, flightSquare = 0;
    for (const i of used) {
      const a = measured[i] - mm, b = level[i] - ml;
      vm += a * a; vl += b * b; both += a * b;
      ownSquare += (measured[i] + own - level[i]) ** 2;
      flightSquare += (measured[i] + (model.offset ?? NaN) - level[i]) ** 2;
    }
    return { n, offset: own, rmse: Math.sqrt(ownSquare / n), rmseFlight: Math.sqrt(flightSquare / n), bias: mm + (model.offset ?? NaN) - ml, correlation: both / Math.sqrt(vm * vl), used };
  }

  function rankStatistics() {
    const r = rank();
    if (!r) return null;
    const time = get(r.time), measured = get(r.measured), model = r.models[state.k], simulated = model ? get(model.rank) : null;
    const shares = { measured: [0, 0, 0, 0, 0], simulated: [0, 0, 0, 0, 0] };
    let n = 0, same = 0, pairs = 0;
    for (let i = 0; i < time.length; i++) {
      if (state.span && (time[i] < state.span[0] || time[i] > state.span[1])) continue;
      const m = measured[i], s = simulated ? simulated[i] : NaN;
      if (m >= 1) { shares.measured[Math.min(m, 4)]++; n++; }
      if (s >= 0) shares.simulated[Math.min(s, 4)]++;
      if (m >= 1 && s >= 1) { pairs++; if (m === s) same++; }
    }
    return { n, pairs, agreement: pairs ? same / pairs : NaN, shares };
  }

  // --- texts --------------------------------------------------------------------------------------------------------

  function clock(t) {
    if (!data.start) return number(t, 2, "s");
    return new Date(Date.parse(data.start + "Z") + t * 1000).toISOString().slice(11, 21) + " UTC";
  }
  function nearest(time, t) {
    let low = 0, high = time.length - 1;
    while (high - low > 1) { const mid = (low + high) >> 1; if (time[mid] <= t) low = mid; else high = mid; }
    return high >= 0 && Math.abs(time[high] - t) < Math.abs(time[low] - t) ? high : low;
  }

  function describe() {
    const s = rss(), r = rank(), rows = [], t = state.pose;
    document.body.classList.toggle("pointed", t !== null || state.span !== null); // the values remain visible only while a pose or a segment is selected
    if (t === null) { cells(at("pose"), [["Pose", "point at a chart or at the map"]]); return; }
    rows.push(["Time", clock(t)]);
    if (s) {
      const i = nearest(get(s.time), t), model = s.models[state.model], measured = get(s.measured)[i], level = get(model.level)[i];
      const east = get(s.east), north = get(s.north), up = get(s.up);
      if (east) rows.push(["East, north, up", `${number(east[i], 0)}, ${number(north[i], 0)}, ${number(up[i], 1)} m`]);
      rows.push(["Measured", number(measured, 1, s.unit)], [`${model.name[0].toUpperCase() + model.name.slice(1)}, less its offset`, number(level - model.offset, 1, s.unit)]);
      rows.push(["Residual", number(measured + model.offset - level, 1, "dB")]);
      for (const g of s.geometry.slice(0, 2)) rows.push([g.name.replace(/ \[.*\]/, ""), number(get(g.values)[i], 1, (g.name.match(/\[(\w+)/) || [])[1])]);
      if (s.line !== undefined) rows.push(["Log", `${s.files[get(s.file)[i]] ?? "?"}, line ${get(s.line)[i]}`]);
    }
    if (r && r.of) {
      const i = nearest(get(r.time), t), m = get(r.measured)[i];
      rows.push(["Rank measured", Number.isFinite(m) ? String(m) : "no CSI"]);
      if (r.models[state.k]) rows.push([`Rank, ${r.models[state.k].name}`, String(get(r.models[state.k].rank)[i] || "no path")]);
      for (const p of r.probability) rows.push([p.name.replaceAll("_", " "), number(100 * get(p.values)[i], 0, "%")]);
    }
    cells(at("pose"), rows);
  }

  function summarise() {
    const s = statistics(), r = rankStatistics(), rows = [];
    const span = state.span ? `${clock(state.span[0])} to ${clock(state.span[1])}` : "whole flight";
    rows.push(["Span", span]);
    if (s) {
      rows.push(["Samples", count(s.n)]);
      if (rss().models[state.model].learned_here) rows.push(["RMSE", "not scored: antennas learned from this flight"]);
      else if (s.n) rows.push(["RMSE, offset refitted on the selection", number(s.rmse, 1, "dB")], ["Offset of the selection", number(s.offset, 1, "dB")],
        ["RMSE with the flight's offset", number(s.rmseFlight, 1, "dB")], ["Mean residual", number(s.bias, 2, "dB")], ["Correlation", number(s.correlation, 2)]);
    }
    if (r) rows.push(["Rank reports", count(r.n)], ["Agreement", number(100 * r.agreement, 0, "%")]);
    cells(at("span"), rows);
    const shown = rss(), held = shown ? get(shown.time).length : 0;
    at("thinned").textContent = shown && held < shown.of ? `${count(held)} of ${count(shown.of)} samples are in this page (extremes are retained); rss.csv and rank.csv contain all.` : "";
  }

  // --- charts over time -----------------------------------------------------------------------------------------------

  let charts = [], range = null, linking = false;

  function axis(label, size = 52) {
    const splits = (u, which, low, high) => common.ticks(low, high, Math.max(3, Math.floor(u.bbox.height / devicePixelRatio / 34)));
    const values = (u, marks) => marks.map(v => number(v, common.digits(marks)));
    return { label, splits, values, labelSize: 18, size, stroke: css("--ink"), font: "12px system-ui, sans-serif", labelFont: "12px system-ui, sans-serif",
      grid: { stroke: css("--line"), width: 1 }, ticks: { stroke: css("--line"), width: 1 } };
  }
  function timeAxis() {
    const { splits, values, ...a } = axis("", 30), begun = Date.parse(data.start + "Z") / 1000;
    if (!data.start) return { ...a, space: 80, values: (u, splits) => splits.map((v, i) => number(v, v % 1 ? 1 : 0) + (i ? "" : " s")) };
    a.splits = (u, which, low, high) => common.clockTicks(low, high, u.width / 110, begun);
    a.values = (u, splits) => splits.map((v, i) => common.clockText(v + begun) + (i ? "" : " UTC"));
    return a;
  }

  function bands(u) {
    const { ctx, bbox } = u;
    ctx.save();
    const spans = [...(u.parted || []).map(ends => [ends, "--parted"]), ...(state.span ? [[state.span, "--chosen"]] : [])];
    for (const [ends, fill] of spans) {
      const [a, b] = ends.map(t => Math.min(bbox.left + bbox.width, Math.max(bbox.left, u.valToPos(t, "x", true))));
      ctx.fillStyle = css(fill); ctx.fillRect(a, bbox.top, b - a, bbox.height);
    }
    if (state.pose !== null) {
      const x = u.valToPos(state.pose, "x", true);
      if (x >= bbox.left && x <= bbox.left + bbox.width) {
        ctx.strokeStyle = css("--accent"); ctx.lineWidth = devicePixelRatio;
        ctx.beginPath(); ctx.moveTo(x, bbox.top); ctx.lineTo(x, bbox.top + bbox.height); ctx.stroke();
      }
    }
    ctx.restore();
  }

  function chart(target, label, columns, series, height, extra = {}) {
    const host = document.createElement("div");
    host.className = "chart";
    target.append(host);
    const options = {
      width: Math.max(host.clientWidth, 200), height, legend: { show: false }, padding: [6, 26, 0, 0],
      scales: { x: { time: false, range: () => range }, ...(extra.scales || {}) },
      axes: [timeAxis(), { ...axis(label), ...(extra.axis || {}) }],
      bands: extra.bands,
      cursor: { drag: { x: true, y: false, setScale: false }, y: false, points: { show: false } },
      series: [{}, ...series],
      hooks: {
        drawClear: [({ ctx }) => { ctx.save(); ctx.fillStyle = css("--paper"); ctx.fillRect(0, 0, ctx.canvas.width, ctx.canvas.height); ctx.restore(); }],
        draw: [bands],
        setCursor: [u => { if (!linking && u.cursor.left >= 0 && u.cursor.idx !== null) choose(u.posToVal(u.cursor.left, "x")); }],
        setSelect: [u => {
          if (u.select.width < 4) return;
          span([u.posToVal(u.select.left, "x"), u.posToVal(u.select.left + u.select.width, "x")]);
          u.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
        }],
      },
    };
    const made = new uPlot(options, columns, host);
    made.parted = extra.parted;
    common.saves(made.ctx.canvas, label, () => [["time", ...series.map(one => one.label || "band")], ...Array.from(columns[0], (t, i) => columns.map(list => list[i]))],
      () => made.batch(u => u.redraw()), made.root); // a batch computes the paths again and draws before it returns
    made.over.addEventListener("dblclick", () => { span(null); zoomTo(null); });
    charts.push({ chart: made, host, height });
  }

  const dots = (name, colour, size, hollow = false) => ({ label: name, stroke: colour, fill: colour, paths: () => null, points: { show: true, size, fill: hollow ? "transparent" : colour, stroke: colour } });
  const line = (name, colour, dash, width = 1.5) => ({ label: name, stroke: colour, width, dash, points: { show: false }, spanGaps: false });
  const column = a => Array.from(a, v => Number.isFinite(v) ? v : null);

  function fullRange() {
    const times = [];
    for (const s of [...data.rss, ...data.rank]) { const t = get(s.time); if (t.length) times.push(t[0], t[t.length - 1]); }
    if (!times.length && data.track) { const t = get(data.track.time); times.push(t[0], t[t.length - 1]); }
    return times.length ? [Math.min(...times), Math.max(...times, Math.min(...times) + 1)] : [0, 1];
  }

  function drawCharts() {
    for (const c of charts) c.chart.destroy();
    charts = [];
    const target = at("charts");
    target.replaceChildren();
    range = range || fullRange();
    const s = rss(), r = rank(), tall = innerWidth < 600 ? 150 : 175;
    if (s) {
      const time = get(s.time), model = s.models[state.model], measured = get(s.measured);
      // levels are as logged, and each model is shifted to them by its offset
      const moved = (index, by) => Array.from(get(index), v => Number.isFinite(v) ? v - (by ?? 0) : null), ray = s.models[0];
      const columns = [Array.from(time), column(measured), moved(model.level, model.offset)], series = [dots("measured", css("--measured"), 4), line(model.name, css("--ink"))];
      const words = [`dots: measured, as logged; line: ${model.name}${model.learned_here ? " with antennas learned from this flight" : ""}, minus its offset of ${number(model.offset, 1, "dB")}`], extra = {};
      if (state.model === 0 && s.models[1]) { columns.push(moved(s.models[1].level, s.models[1].offset)); series.push(line(s.models[1].name, css("--baseline"), [6, 4], 1)); words.push("dashed: " + s.models[1].name); }
      const second = data.rss.find(o => o.name === s.beside), first = second ? 1 : 0; // drawn below the dots and the line of the chosen channel
      if (state.model === 0 && s.band) {
        for (const end of s.band) { columns.push(moved(end, ray.offset)); series.push(line("", "transparent")); }
        extra.bands = [{ series: [columns.length - 1 + first, columns.length - 2 + first], fill: css("--band-90") }];
        words.push("band: 90 % of the samples are expected in it");
      }
      const tables = [columns];
      if (second) {
        tables.unshift([Array.from(get(second.time)), moved(second.measured, ray.offset - second.models[0].offset)]);
        series.unshift(dots(second.name, css("--second"), 5, true)); extra.parted = s.parted;
        words.push(`hollow violet dots: ${second.name}, moved by ${number(second.models[0].offset - ray.offset, 1, "dB")}`, ...(s.parted.length ? [`shaded: the two differ by more than ${s.parted_db} dB`] : []));
      }
      chart(target, `Level [${s.unit}]`, second ? uPlot.join(tables) : columns, series, tall + 30, extra);
      at("legend").textContent = words.join("; ");
      const rest = residuals();
      chart(target, "Residual [dB]", [Array.from(time), column(rest), rest.length ? Array(rest.length).fill(0) : []], [dots("residual", css("--measured"), 3), line("zero", css("--soft"), undefined, 1)], tall - 20);
    }
    if (r) {
      const steps = uPlot.paths.stepped({ align: 1 }), model = r.models[state.k];
      const columns = [Array.from(get(r.time)), column(get(r.measured))], series = [dots("measured", css("--measured"), 5)];
      if (model) { columns.push(column(get(model.rank))); series.push({ ...line(model.name, css("--ink")), paths: steps }); }
      chart(target, "Rank", columns, series, tall - 40, { scales: { y: { range: [-0.4, 4.4] } }, axis: { splits: () => [0, 1, 2, 3, 4], values: () => ["none", "1", "2", "3", "4"] } });
    }
    const place = data.track || s || r;
    if (place && get(place.up)) chart(target, "Height [m]", [Array.from(get(place.time)), column(get(place.up))], [line("height", css("--ink"))], tall - 35);
    if (!s) at("legend").textContent = "";
  }

  // --- the map, plan or in three dimensions ---------------------------------------------------------------------------

  const canvas = at("map"), pen = canvas.getContext("2d");
  const KEY = 46; // height of the strip below the map that contains its scale and colours
  let project = null, drawn = [], labels = [];

  function flown() {
    const s = rss() || rank() || data.track;
    return s && get(s.east) ? { time: get(s.time), east: get(s.east), north: get(s.north), up: get(s.up) } : null;
  }

  function way() { // positions of a moving tower, one per sample
    const s = rss() || rank();
    return s && s.tower_east !== undefined ? { tower: s.tower, time: get(s.time), east: get(s.tower_east), north: get(s.tower_north), up: get(s.tower_up) } : null;
  }

  function standing(t) { // foot and top of a tower, of a moving tower at the visible pose
    const m = way();
    if (m && m.tower === t.name && state.pose !== null) {
      const i = nearest(m.time, state.pose);
      if (Number.isFinite(m.east[i])) return [[m.east[i], m.north[i], t.at[2] + m.up[i] - t.top], [m.east[i], m.north[i], m.up[i]]];
    }
    return [t.at, [t.at[0], t.at[1], t.top]];
  }

  function drawWay() {
    const m = way();
    if (!m) return;
    let line = [], last = null;
    const end = () => { if (line.length > 1) polyline(line, css("--accent"), 1.5, [6, 4]); line = []; };
    for (let i = 0; i < m.east.length; i++) {
      if (!Number.isFinite(m.east[i])) { end(); continue; }
      const p = project([m.east[i], m.north[i], m.up[i]]);
      if (!line.length || Math.hypot(p[0] - last[0], p[1] - last[1]) > 1) { line.push(p); last = p; }
    }
    end();
  }

  function box() {
    const lists = [[], [], []], f = data.track ? { east: get(data.track.east), north: get(data.track.north), up: get(data.track.up) } : flown();
    if (f) for (let i = 0; i < f.east.length; i += Math.ceil(f.east.length / 500)) if (Number.isFinite(f.east[i])) { lists[0].push(f.east[i]); lists[1].push(f.north[i]); lists[2].push(f.up[i]); }
    const tower = rss() ? rss().tower : rank() ? rank().tower : null;
    for (const t of data.site.towers) if (t.name === tower || !lists[0].length) { lists[0].push(t.at[0]); lists[1].push(t.at[1]); lists[2].push(t.top); }
    const m = way();
    if (m) for (let i = 0; i < m.east.length; i += Math.ceil(m.east.length / 500)) if (Number.isFinite(m.east[i])) { lists[0].push(m.east[i]); lists[1].push(m.north[i]); lists[2].push(m.up[i]); }
    return lists.map(l => l.length ? [Math.min(...l), Math.max(...l)] : [0, 1]);
  }

  function prepare() {
    const w = canvas.clientWidth, h = canvas.clientHeight - KEY, b = box(), c = b.map(([x, y]) => (x + y) / 2);
    const ct = Math.cos(state.turn), st = Math.sin(state.turn), ce = Math.cos(state.tilt), se = Math.sin(state.tilt), stretch = state.tilt > 1.5 ? 1 : 2;
    const raw = p => {
      const e = p[0] - c[0] - state.east, n = p[1] - c[1] - state.north, u = (p[2] || 0) * stretch;
      const right = e * ct + n * st, deep = -e * st + n * ct;
      return [right, u * ce + deep * se, deep * ce - u * se];
    };
    const corners = [];
    for (const e of b[0]) for (const n of b[1]) for (const u of [0, b[2][1]]) corners.push(raw([e + state.east, n + state.north, u]));
    const xs = corners.map(p => p[0]), ys = corners.map(p => p[1]);
    const wide = Math.max(Math.max(...xs) - Math.min(...xs), 10), high = Math.max(Math.max(...ys) - Math.min(...ys), 10);
    const scale = state.zoom * Math.min((w - 60) / wide, (h - 44) / high), mx = (Math.max(...xs) + Math.min(...xs)) / 2, my = (Math.max(...ys) + Math.min(...ys)) / 2;
    project = p => { const q = raw(p); return [w / 2 + (q[0] - mx) * scale, h / 2 - (q[1] - my) * scale, q[2]]; };
    project.scale = scale;
  }

  const RANKS = ["#9a9a9a", "#440154", "#31688e", "#35b779", "#fde725"];

  function colours() {
    const s = rss(), r = rank();
    if ((state.colour === "rank" || !s) && r) {
      const model = r.models[state.k], v = get(r.measured);
      return { source: r, of: i => Number.isFinite(v[i]) ? RANKS[v[i]] : RANKS[0], words: "measured rank: " + [1, 2, 3, 4].join(", "), key: [1, 2, 3, 4].map(k => [RANKS[k], String(k)]), model };
    }
    if (!s) return null;
    if (state.colour === "level") {
      const v = get(s.measured), known = Array.from(v).filter(Number.isFinite).sort((a, b) => a - b), low = known[Math.floor(known.length * 0.02)] ?? 0, high = known[Math.floor(known.length * 0.98)] ?? 1;
      return { source: s, of: i => Number.isFinite(v[i]) ? shade(v[i], low, high) : "#9a9a9a", key: [0, .25, .5, .75, 1].map(x => [shade(x, 0, 1), number(low + x * (high - low), 0)]), words: `measured level [${s.unit}]` };
    }
    const v = residuals();
    return { source: s, of: i => Number.isFinite(v[i]) ? shade(v[i], -12, 12, true) : "#9a9a9a", key: [-12, -6, 0, 6, 12].map(x => [shade(x, -12, 12, true), number(x, 0)]), words: "residual [dB], measured minus " + s.models[state.model].name };
  }

  const polygon = (...given) => common.polygon(pen, ...given), polyline = (...given) => common.polyline(pen, ...given);

  common.saves(canvas, "Flight", () => {
    const f = flown(), s = rss(), r = rank(), columns = { time: f.time, east_m: f.east, north_m: f.north, up_m: f.up };
    Object.assign(columns, s ? { measured: get(s.measured), residual_db: residuals() } : r ? { rank: get(r.measured) } : {});
    return [Object.keys(columns), ...Array.from(f.time, (_, i) => Object.values(columns).map(list => list[i]))];
  }, drawMap);
  function drawMap() {
    const ratio = devicePixelRatio || 1, w = canvas.clientWidth, h = canvas.clientHeight;
    canvas.width = Math.round(w * ratio); canvas.height = Math.round(h * ratio);
    pen.setTransform(ratio, 0, 0, ratio, 0, 0); pen.lineJoin = "round";
    pen.fillStyle = css("--paper"); pen.fillRect(0, 0, w, h);
    prepare();
    pen.save(); pen.beginPath(); pen.rect(0, 0, w, h - KEY); pen.clip();
    for (const f of data.site.forests) polygon(f.map(p => project([p[0], p[1], 0])), css("--forest"), null);
    const parts = [];
    for (const faces of data.site.buildings) for (const face of faces) {
      const seen = face.map(project);
      parts.push([Math.max(...seen.map(p => p[2])), () => polygon(seen, css("--building"), css("--soft"))]);
    }
    if (state.tilt < 1.5) for (const [e, n, g, height, wide, base] of data.site.trees) {
      const foot = project([e, n, g]), crown = project([e, n, g + base]), top = project([e, n, g + height]), half = wide / 2 * project.scale;
      parts.push([foot[2], () => polygon([top, [crown[0] - half, crown[1]], [crown[0] + half, crown[1]]], css("--tree"), null)]);
    }
    parts.sort((a, b) => b[0] - a[0]).forEach(p => p[1]());
    if (data.track) {
      const e = get(data.track.east), n = get(data.track.north), u = get(data.track.up);
      polyline(Array.from(e, (v, i) => project([v, n[i], u[i]])), css("--line"), 1);
    }
    const c = colours();
    drawn = [];
    if (c) {
      const s = c.source, time = get(s.time), e = get(s.east), n = get(s.north), u = get(s.up);
      if (e) for (let i = 0; i < time.length; i++) {
        if (!Number.isFinite(e[i])) continue;
        const p = project([e[i], n[i], u[i]]), inside = !state.span || (time[i] >= state.span[0] && time[i] <= state.span[1]);
        drawn.push([p[0], p[1], time[i]]);
        pen.globalAlpha = inside ? 1 : 0.15;
        pen.fillStyle = c.of(i); pen.fillRect(p[0] - 2.5, p[1] - 2.5, 5, 5);
      }
      pen.globalAlpha = 1;
    }
    const tower = rss() ? rss().tower : rank() ? rank().tower : "";
    drawWay();
    for (const t of data.site.towers) {
      const [foot, top] = standing(t).map(project);
      if (Math.max(foot[1], top[1] + 4) > h - KEY) continue; // a mark that the strip would cut is not drawn
      polyline([foot, top], css("--accent"), 3);
      polygon([[top[0], top[1] - 6], [top[0] - 5, top[1] + 4], [top[0] + 5, top[1] + 4]], css("--accent"), null);
    }
    drawPaths(tower);
    const own = data.site.towers.filter(t => t.name === tower), others = data.site.towers.filter(t => t.name !== tower);
    labels = common.names(pen, [0, 0, w, h - KEY], [...own, ...others].map(t => ({ text: t.name, at: project(standing(t)[1]), colour: css(t.name === tower ? "--accent" : "--soft"), halo: css("--paper") })), data.site.credit);
    pen.restore();
    drawKey(c, w, h);
  }

  function drawPaths(tower) {
    if (state.pose === null) return;
    const f = flown();
    if (f) {
      const i = nearest(f.time, state.pose), p = project([f.east[i], f.north[i], f.up[i]]);
      const found = data.paths.find(x => x.tower === tower);
      if (found && found.time.length) {
        const j = nearest(found.time, state.pose);
        const look = kind => kind === -1 ? ["--measured", [2, 3]] : kind ? ["--baseline", [5, 3]] : ["--ink", []];
        for (const [points, kind] of found.lines[j]) polyline(points.map(project), css(look(kind)[0]), 1.4, look(kind)[1]);
      }
      pen.beginPath(); pen.arc(p[0], p[1], 6, 0, 7); pen.fillStyle = "#F0C000"; pen.fill(); pen.strokeStyle = "#000"; pen.lineWidth = 1.2; pen.stroke();
    }
  }

  function drawKey(c, w, h) {
    const metres = [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000].find(m => m * project.scale > 50) || 2000;
    if (state.tilt > 1.5) { polyline([[14, h - 14], [14 + metres * project.scale, h - 14]], css("--ink"), 2); pen.font = "11px system-ui, sans-serif"; pen.fillStyle = css("--ink"); pen.fillText(`${metres} m`, 14, h - 19); }
    if (!c) return;
    pen.font = "11px system-ui, sans-serif";
    c.key.forEach(([fill, text], i) => { pen.fillStyle = fill; pen.fillRect(w - 36 * (c.key.length - i) - 6, h - 24, 34, 10); pen.fillStyle = css("--ink"); pen.fillText(text, w - 36 * (c.key.length - i) - 2, h - 4); });
    pen.textAlign = "right"; pen.fillText(c.words, w - 8, h - 30); pen.textAlign = "left";
  }

  // --- residual against a quantity, and histograms ----------------------------------------------------------------------

  const saved = (id, name, rows, draw) => common.saves(at(id), name, () => rows, draw);
  function drawScatter() {
    const s = rss();
    at("scatter-figure").hidden = !s || !s.geometry.length;
    if (!s || !s.geometry.length) return;
    const [p, w, h] = common.frame(at("scatter")), kind = s.geometry[state.against] || s.geometry[0], x = get(kind.values), y = residuals(), time = get(s.time);
    const chosen = [];
    for (let i = 0; i < x.length; i++) if (Number.isFinite(x[i]) && Number.isFinite(y[i]) && (!state.span || (time[i] >= state.span[0] && time[i] <= state.span[1]))) chosen.push([x[i], y[i]]);
    if (!chosen.length) return;
    let low = Infinity, high = -Infinity, reach = 5;
    for (const [a, b] of chosen) { low = Math.min(low, a); high = Math.max(high, a); reach = Math.max(reach, Math.abs(b)); }
    reach = Math.min(reach, 30); if (high - low < 1e-6) high = low + 1;
    const g = axes(p, w, h, { low, high, label: kind.name }, { low: -reach, high: reach, label: "Residual [dB]" });
    const X = g.X, Y = v => g.Y(Math.max(-reach, Math.min(reach, v)));
    p.fillStyle = css("--measured"); p.globalAlpha = 0.5;
    for (const [a, b] of chosen) p.fillRect(X(a) - 1.2, Y(b) - 1.2, 2.4, 2.4);
    p.globalAlpha = 1;
    chosen.sort((a, b) => a[0] - b[0]);
    saved("scatter", "Residual", [[kind.name, "Residual [dB]"], ...chosen], drawScatter);
    const bins = Math.min(20, Math.floor(chosen.length / 8));
    if (bins > 1) {
      p.strokeStyle = css("--ink"); p.lineWidth = 2; p.beginPath();
      for (let k = 0; k < bins; k++) {
        const part = chosen.slice(Math.floor(k * chosen.length / bins), Math.floor((k + 1) * chosen.length / bins));
        const mx = part.reduce((t, v) => t + v[0], 0) / part.length, my = part.reduce((t, v) => t + v[1], 0) / part.length;
        if (k) p.lineTo(X(mx), Y(my)); else p.moveTo(X(mx), Y(my));
      }
      p.stroke();
    }
  }

  function drawHistogram() {
    const s = rss(), r = rank(), [p, w, h] = common.frame(at("histogram"));
    const bar = (g, low, high, v, colour) => { p.fillStyle = css(colour); p.fillRect(g.X(low), g.Y(v), g.X(high) - g.X(low) - 1, g.bottom - g.Y(v)); };
    if (s) {
      const found = statistics(), rest = residuals(), counts = new Array(30).fill(0);
      for (const i of found.used || []) counts[Math.min(29, Math.max(0, Math.floor(rest[i] + 15)))]++;
      const g = axes(p, w, h, { low: -15, high: 15, label: "Residual [dB] (outer bins include outliers)" }, { low: 0, high: Math.max(1, ...counts), label: "Samples" });
      saved("histogram", "Residuals", [["Residual from [dB]", "Samples"], ...counts.map((c, i) => [i - 15, c])], drawHistogram);
      counts.forEach((c, i) => bar(g, i - 15, i - 14, c, "--measured"));
    } else if (r) {
      const found = rankStatistics(), share = list => { const t = list.reduce((a, b) => a + b, 0) || 1; return list.map(v => 100 * v / t); };
      const m = share(found.shares.measured), q = share(found.shares.simulated);
      const g = axes(p, w, h, { low: -0.5, high: 4.5, label: "Rank: measured (light), simulated (dark)", marks: [0, 1, 2, 3, 4], words: v => v ? String(v) : "none" }, { low: 0, high: Math.max(1, ...m, ...q), label: "Share [%]" });
      saved("histogram", "Ranks", [["Rank", "Measured [%]", "Simulated [%]"], ...m.map((v, i) => [i, v, q[i]])], drawHistogram);
      m.forEach((v, i) => { bar(g, i - 0.4, i, v, "--measured"); bar(g, i, i + 0.4, q[i], "--ink"); });
    }
  }

  // --- linking ---------------------------------------------------------------------------------------------------------

  const lines = () => { linking = true; for (const c of charts) c.chart.redraw(false); linking = false; };

  function choose(t) { if (t === state.pose) return; state.pose = t; later(lines, drawMap, describe); }
  function span(s) { state.span = s && s[1] > s[0] ? s : null; later(lines, drawMap, drawScatter, drawHistogram, summarise); }
  function zoomTo(s) { range = s || fullRange(); linking = true; for (const c of charts) c.chart.setScale("x", { min: range[0], max: range[1] }); linking = false; }
  function everything() { drawCharts(); drawMap(); drawScatter(); drawHistogram(); summarise(); describe(); }

  function controls() {
    const s = rss(), r = rank();
    fill(at("choose-series"), (data.rss.length ? data.rss : data.rank).map(x => x.name || x.tower), state.series);
    fill(at("choose-model"), s ? s.models.map(m => m.name) : [], state.model);
    fill(at("choose-k"), r ? r.models.map(m => m.name) : [], state.k);
    const kinds = [...(s ? ["residual", "level"] : []), ...(r ? ["rank"] : [])];
    const names = { residual: "residual", level: "measured level", rank: "measured rank" };
    at("choose-colour").replaceChildren(...kinds.map(k => { const o = document.createElement("option"); o.value = k; o.textContent = names[k]; return o; }));
    if (!kinds.includes(state.colour)) state.colour = kinds[0];
    at("choose-colour").value = state.colour;
    at("choose-colour").closest("label").hidden = kinds.length < 2;
    fill(at("choose-against"), s ? s.geometry.map(g => g.name) : [], state.against);
  }

  const pick = (id, change) => at(id).addEventListener("change", e => { change(e.target.value); controls(); everything(); });
  pick("choose-series", v => { state.series = +v; state.model = Math.min(state.model, (rss() ? rss().models.length : 1) - 1); state.k = rank() ? rank().best : 0; });
  pick("choose-model", v => { state.model = +v; });
  pick("choose-k", v => { state.k = +v; });
  pick("choose-colour", v => { state.colour = v; });
  pick("choose-against", v => { state.against = +v; });
  at("zoom-span").addEventListener("click", () => zoomTo(state.span));
  at("clear-span").addEventListener("click", () => { span(null); zoomTo(null); });
  at("view-plan").addEventListener("click", () => { Object.assign(state, { turn: 0, tilt: Math.PI / 2, zoom: 1, east: 0, north: 0 }); later(drawMap); });
  at("view-solid").addEventListener("click", () => { Object.assign(state, { turn: -0.45, tilt: 0.5, zoom: 1, east: 0, north: 0 }); later(drawMap); });

  root.addEventListener("keydown", e => {
    if (e.target.tagName === "SELECT") return;
    const s = rss() || rank();
    if (!s) return;
    const time = get(s.time), step = { ArrowLeft: -1, ArrowRight: 1, PageUp: -50, PageDown: 50 }[e.key];
    if (step) {
      e.preventDefault();
      const i = state.pose === null ? 0 : nearest(time, state.pose) + step * (e.shiftKey ? 10 : 1);
      choose(time[Math.min(time.length - 1, Math.max(0, i))]);
    } else if (e.key === "[" && state.pose !== null) span([state.pose, state.span ? state.span[1] : range[1]]);
    else if (e.key === "]" && state.pose !== null) span([state.span ? state.span[0] : range[0], state.pose]);
    else if (e.key === "Escape") { span(null); zoomTo(null); }
    else if (e.key === "+" || e.key === "=") { state.zoom = Math.min(30, state.zoom * 1.25); later(drawMap); }
    else if (e.key === "-") { state.zoom = Math.max(0.3, state.zoom / 1.25); later(drawMap); }
  });

  let held = null;
  canvas.addEventListener("pointerdown", e => { canvas.setPointerCapture(e.pointerId); held = [e.clientX, e.clientY]; });
  canvas.addEventListener("pointerup", () => { held = null; });
  canvas.addEventListener("pointermove", e => {
    if (held) {
      const dx = e.clientX - held[0], dy = e.clientY - held[1];
      held = [e.clientX, e.clientY];
      if (state.tilt < 1.5 && !e.shiftKey) { state.turn -= dx * 0.006; state.tilt = Math.min(1.45, Math.max(0.05, state.tilt + dy * 0.006)); }
      else { state.east -= dx / project.scale; state.north += dy / project.scale; }
      later(drawMap);
      return;
    }
    const r = canvas.getBoundingClientRect(), x = e.clientX - r.left, y = e.clientY - r.top;
    let best = 400, t = null;
    for (const [px, py, time] of drawn) { const d = (px - x) ** 2 + (py - y) ** 2; if (d < best) { best = d; t = time; } }
    if (t !== null) choose(t);
  });
  canvas.addEventListener("wheel", e => { if (!e.ctrlKey && !e.metaKey && document.activeElement !== canvas) return; e.preventDefault(); state.zoom = Math.min(30, Math.max(0.3, state.zoom * Math.exp(-e.deltaY * 0.0015))); later(drawMap); }, { passive: false });

  common.plots(data.plots, get);

  let width = 0;
  new ResizeObserver(() => {
    if (root.clientWidth === width) return;
    width = root.clientWidth;
    linking = true;
    for (const c of charts) c.chart.setSize({ width: Math.max(c.host.clientWidth, 200), height: c.height });
    linking = false;
    later(drawMap, drawScatter, drawHistogram);
  }).observe(root);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => everything());

  state.k = Math.max(0, rank() ? rank().best : 0);
  document.documentElement.classList.add("live");
  controls();
  everything();
  window.explorer = { times: () => charts.map(c => c.chart.axes[0]._values), state, statistics, rankStatistics, choose, span, series: i => Array.from(get(i)), labels: () => labels, keyTop: () => canvas.clientHeight - KEY, data };
})().catch(error => { // a browser that is too old: the tables remain visible
  document.documentElement.classList.remove("live");
  console.error(error);
});
