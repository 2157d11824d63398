"use strict";
// The linked views of a campaign: one setting, one tower or channel, one flight, shown by tables, charts and a map.
(async () => {
  const { at, css, number, cells, fill, frame, axes, ramp, quantile, later, whenResized, ticks } = common;
  const data = JSON.parse(at("explorer-data").textContent), arrays = await common.unpack(data.packed);
  const root = at("explorer"), ALL = "all";
  const column = (name, step) => step ? common.values(arrays[data.rows[name]], step) : arrays[data.rows[name]];
  const rows = { flight: column("flight"), setting: column("setting"), link: column("link"), held: column("held", data.step), own: column("own", data.step), offset: column("offset", data.step) };
  const flights = data.flights, links = data.links, hues = ["#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#999933", "#8C6BB1"];
  const diverging = ramp(data.ramp);
  const state = { setting: data.first, tower: ALL, channel: ALL, measure: data.held_out ? "held" : "own", flight: null, kept: false };

  const bySetting = data.settings.map(() => []);
  for (let i = 0; i < rows.flight.length; i++) bySetting[rows.setting[i]].push(i);
  const failed = flights.map(() => 0);
  for (const f of data.failures) if (f[0] >= 0) failed[f[0]]++;

  // --- numbers --------------------------------------------------------------------------------------------------------

  const wanted = link => (state.tower === ALL || links[link].tower === state.tower) && (state.channel === ALL || links[link].channel === state.channel);
  const chosenLinks = () => links.map((_, i) => i).filter(wanted);
  const errorOf = i => state.measure === "held" && Number.isFinite(rows.held[i]) ? rows.held[i] : rows.own[i];
  // per flight: mean error over the chosen links, mean own offset, worst link; kept until the choice changes
  let kept = new Map(), keptFor = "";
  function perFlight(setting) {
    const choice = [state.tower, state.channel, state.measure].join("|");
    if (choice !== keptFor) { kept = new Map(); keptFor = choice; }
    if (!kept.has(setting)) {
      const found = flights.map(() => ({ n: 0, error: 0, offset: 0, worst: -1, most: -Infinity })), use = links.map((_, l) => wanted(l));
      for (const i of bySetting[setting]) {
        const l = rows.link[i], e = errorOf(i);
        if (!use[l] || !Number.isFinite(e)) continue;
        const f = found[rows.flight[i]];
        f.n++; f.error += e; f.offset += rows.offset[i];
        if (e > f.most) { f.most = e; f.worst = l; }
      }
      for (const f of found) { f.error = f.n ? f.error / f.n : NaN; f.offset = f.n ? f.offset / f.n : NaN; }
      kept.set(setting, found);
    }
    return kept.get(setting);
  }
  function byLink(setting) { // per flight: error of each chosen link
    const found = flights.map(() => new Map());
    for (const i of bySetting[setting]) { const e = errorOf(i); if (wanted(rows.link[i]) && Number.isFinite(e)) found[rows.flight[i]].set(rows.link[i], e); }
    return found;
  }
  // the ranking of the record where it has this choice (held out; all links or one), else means alone
  function ranking() {
    const chosen = chosenLinks(), one = chosen.length === 1 && links.length > 1 ? chosen[0] : -1;
    const ready = state.measure === data.ranked_by && (chosen.length === links.length || one >= 0) ? data.ranking.filter(r => r.link === (chosen.length === links.length ? -1 : one)) : [];
    if (ready.length) return ready.map(r => ({ ...r, recorded: true }));
    const found = data.settings.map((_, s) => {
      const e = perFlight(s).map(f => f.error).filter(Number.isFinite).sort((x, y) => x - y);
      return { setting: s, n: e.length, mean: e.reduce((t, v) => t + v, 0) / e.length, quantiles: [0, 0.1, 0.25, 0.5, 0.75, 0.9, 1].map(q => quantile(e, q)), difference: NaN, ci: null, verdict: "" };
    }).filter(r => r.n).sort((x, y) => x.mean - y.mean);
    const first = found.length ? byLink(found[0].setting) : [];
    for (const r of found) {
      const d = byLink(r.setting).map((by, i) => { const both = [...by.keys()].filter(k => first[i].has(k)); return both.length ? both.reduce((t, k) => t + by.get(k) - first[i].get(k), 0) / both.length : NaN; }).filter(Number.isFinite);
      r.difference = d.reduce((t, v) => t + v, 0) / d.length;
    }
    return found;
  }

  // --- tables -----------------------------------------------------------------------------------------------------------

  const cell = (text, className, value) => { const td = document.createElement("td"); td.textContent = text; if (className) td.className = className; if (value !== undefined) td.dataset.v = value; return td; };
  function ofNumber(v, digits = 2) { return cell(number(v, digits), "n", Number.isFinite(v) ? v : ""); }

  let ranked = [];
  function drawRanking() {
    ranked = ranking();
    at("ranking-caption").textContent = `Settings by their mean ${state.measure === "held" ? "held-out error: each flight scored with the offset of the other flights" : "error with an offset of each flight's own samples"}, ${words()}. Difference from the best setting: mean difference on the same flights and links${ranked.length && ranked[0].recorded ? ", with a 95 % interval over flights; the first was chosen on these flights" : " (intervals: with all links or a single one)"}.`;
    at("ranking").tBodies[0].replaceChildren(...ranked.map((r, i) => {
      const tr = document.createElement("tr"), head = document.createElement("th"), choose = document.createElement("button");
      head.scope = "row"; choose.type = "button"; choose.className = "plain"; choose.textContent = data.settings[r.setting]; choose.title = data.changes[r.setting];
      choose.addEventListener("click", () => { state.setting = r.setting; controls(); everything(); });
      head.append(choose); tr.classList.toggle("chosen", r.setting === state.setting);
      tr.append(cell(String(i + 1), "n", i + 1), head, cell(String(r.n), "n", r.n), ofNumber(r.mean), ofNumber(r.quantiles[3]), cell(`${number(r.quantiles[1], 2)} to ${number(r.quantiles[5], 2)}`, "n", r.quantiles[5]), ofNumber(r.difference), cell(r.ci ? `[${number(r.ci[0], 2)}, ${number(r.ci[1], 2)}]` : "", "n", r.ci ? r.ci[0] : ""), cell(r.verdict));
      return tr;
    }));
    resort(at("ranking"));
  }
  const words = () => [state.tower === ALL ? "all towers" : state.tower, state.channel === ALL ? "all channels" : state.channel].join(", ");
  const dated = f => f.t === null ? "" : new Date(f.t).toISOString().slice(0, 10);

  let shown = [];
  const MOST = 500;
  function drawFlights() {
    const mine = perFlight(state.setting), first = ranked.length ? perFlight(ranked[0].setting) : mine;
    shown = mine.map((f, i) => ({ ...f, i, to: f.error - first[i].error })).filter(f => f.n || failed[f.i]).sort((a, b) => (b.n ? b.error : -1) - (a.n ? a.error : -1));
    at("flights-caption").textContent = `Flights under “${data.settings[state.setting]}”, ${words()}, worst first${shown.length > MOST ? `; ${MOST} of ${shown.length}` : ""}.`;
    at("flights").tBodies[0].replaceChildren(...shown.slice(0, MOST).map(f => {
      const tr = document.createElement("tr"), head = document.createElement("th"), flight = flights[f.i];
      head.scope = "row"; tr.dataset.flight = f.i;
      if (flight.href) { const a = document.createElement("a"); a.href = flight.href; a.textContent = flight.name; head.append(a); } else head.textContent = flight.name;
      tr.append(head, cell(dated(flight), "when", flight.t ?? ""), ofNumber(f.error), ofNumber(f.to), ofNumber(f.offset), cell(f.worst < 0 ? "" : links[f.worst].name), ofNumber(f.worst < 0 ? NaN : f.most), cell(String(failed[f.i]), "n", failed[f.i]));
      return tr;
    }));
    resort(at("flights"));
    markRow();
  }
  function markRow(scroll = false) {
    for (const tr of at("flights").tBodies[0].rows) {
      const on = +tr.dataset.flight === state.flight;
      tr.classList.toggle("chosen", on);
      const box = at("flights").closest(".tall");
      if (on && scroll) box.scrollTop = tr.offsetTop - box.clientHeight / 2;
    }
  }
  at("flights").tBodies[0].addEventListener("pointerover", e => { const tr = e.target.closest("tr"); if (tr) mark(+tr.dataset.flight); });
  at("flights").tBodies[0].addEventListener("click", e => { const tr = e.target.closest("tr"); if (tr && e.target.tagName !== "A") keep(+tr.dataset.flight); });

  // every table of class sortable: a click on a head sorts, a second one the other way round
  const plain = td => { if (td.dataset.v !== undefined) return td.dataset.v === "" ? NaN : +td.dataset.v; const text = td.textContent.trim(), v = parseFloat(text.replace(/[\u202f\s]/g, "").replace("−", "-")); return Number.isFinite(v) && /^[−\-\d]/.test(text) ? v : text === "–" || text === "" ? NaN : text; };
  function sort(table, i, up) {
    const body = table.tBodies[0], sign = up ? 1 : -1, keyed = [...body.rows].map(row => [plain(row.cells[i]), row]);
    keyed.sort(([a], [b]) => {
      const none = Number.isNaN(b) - Number.isNaN(a);
      if (none) return -none; // what is missing stands last, whichever way
      return sign * (typeof a === "number" && typeof b === "number" ? a - b : String(a).localeCompare(String(b), undefined, { numeric: true }));
    });
    body.append(...keyed.map(k => k[1]));
    [...table.tHead.rows[0].cells].forEach((th, k) => { if (k === i) th.setAttribute("aria-sort", up ? "ascending" : "descending"); else th.removeAttribute("aria-sort"); });
  }
  function resort(table) {
    const i = [...table.tHead.rows[0].cells].findIndex(th => th.hasAttribute("aria-sort"));
    if (i >= 0) sort(table, i, table.tHead.rows[0].cells[i].getAttribute("aria-sort") === "ascending");
  }
  for (const table of document.querySelectorAll("table.sortable")) [...table.tHead.rows[0].cells].forEach((th, i) => {
    const button = document.createElement("button");
    button.type = "button"; button.className = "plain"; button.append(...th.childNodes); th.append(button);
    button.addEventListener("click", () => sort(table, i, th.getAttribute("aria-sort") !== "ascending"));
  });

  // --- distribution -----------------------------------------------------------------------------------------------------

  let spots = { distribution: [], drift: [] };
  const jitter = i => ((i * 0.618033988749895) % 1 - 0.5) * 0.56;
  function drawDistribution() {
    const canvas = at("distribution");
    canvas.style.height = `${Math.max(220, 60 + ranked.length * 26)}px`;
    const [pen, w, h] = frame(canvas), table = ranked.map(r => perFlight(r.setting));
    spots.distribution = [];
    const every = table.flatMap(t => t.map(f => f.error)).filter(Number.isFinite).sort((a, b) => a - b);
    if (!every.length) return;
    const top = Math.max(quantile(every, 0.995) * 1.05, every[0] + 0.1), low = Math.max(0, every[0] - 0.1 * (top - every[0]));
    const left = Math.min(190, w * 0.32), Y = k => 14 + (k + 0.5) * 26, right = w - 14, X = v => left + (Math.min(v, top) - low) / (top - low) * (right - left), bottom = 14 + ranked.length * 26;
    pen.strokeStyle = css("--line"); pen.fillStyle = css("--ink"); pen.textAlign = "center";
    for (const v of ticks(low, top, Math.max(2, Math.floor((right - left) / 70)))) { pen.beginPath(); pen.moveTo(X(v), 8); pen.lineTo(X(v), bottom); pen.stroke(); pen.fillText(String(Math.round(v * 100) / 100), X(v), bottom + 16); }
    pen.fillText("Error [dB]", (left + right) / 2, bottom + 34);
    ranked.forEach((r, k) => {
      if (r.setting === state.setting) { pen.fillStyle = css("--chosen"); pen.fillRect(0, Y(k) - 13, w, 26); }
      pen.fillStyle = css("--ink"); pen.textAlign = "right";
      let name = data.settings[r.setting];
      while (name.length > 3 && pen.measureText(name).width > left - 10) name = name.slice(0, -2) + "…";
      pen.fillText(name, left - 6, Y(k) + 4);
      pen.globalAlpha = 0.45; pen.fillStyle = css("--measured");
      table[k].forEach((f, i) => { if (!f.n) return; const x = X(f.error), y = Y(k) + 26 * jitter(i); spots.distribution.push([x, y, i, r.setting]); pen.fillRect(x - 1.5, y - 1.5, 3, 3); });
      pen.globalAlpha = 1; pen.strokeStyle = css("--ink"); pen.lineWidth = 1.3;
      pen.strokeRect(X(r.quantiles[2]), Y(k) - 8, Math.max(1, X(r.quantiles[4]) - X(r.quantiles[2])), 16);
      pen.lineWidth = 2.4; pen.beginPath(); pen.moveTo(X(r.quantiles[3]), Y(k) - 8); pen.lineTo(X(r.quantiles[3]), Y(k) + 8); pen.stroke(); pen.lineWidth = 1;
    });
    ring(pen, spots.distribution);
  }
  function ring(pen, list) {
    for (const [x, y, i] of list) if (i === state.flight) { pen.beginPath(); pen.arc(x, y, 5, 0, 7); pen.fillStyle = "#F0C000"; pen.fill(); pen.strokeStyle = "#000"; pen.lineWidth = 1.2; pen.stroke(); }
  }

  // --- drift --------------------------------------------------------------------------------------------------------------

  const known = flights.filter(f => f.t !== null).length, withDates = known >= 2 && known >= flights.length / 2;
  function drawDrift() {
    const canvas = at("drift"), chosen = chosenLinks();
    canvas.style.height = `${Math.max(220, Math.min(420, 60 + ranked.length * 26))}px`;
    const [pen, w, h] = frame(canvas);
    spots.drift = [];
    const points = bySetting[state.setting].filter(i => wanted(rows.link[i]) && Number.isFinite(rows.offset[i]) && (!withDates || flights[rows.flight[i]].t !== null)).map(i => [withDates ? flights[rows.flight[i]].t : rows.flight[i] + 1, rows.offset[i], rows.flight[i], rows.link[i]]);
    at("drift-caption").textContent = `Own offset of each flight over ${withDates ? "its date" : "its number in the campaign"}, “${data.settings[state.setting]}”.`;
    if (!points.length) { at("drift-legend").textContent = ""; return; }
    let [x0, x1, y0, y1] = [Infinity, -Infinity, Infinity, -Infinity];
    for (const [x, y] of points) { x0 = Math.min(x0, x); x1 = Math.max(x1, x); y0 = Math.min(y0, y); y1 = Math.max(y1, y); }
    if (!(x1 > x0)) { x0 -= withDates ? 864e5 : 1; x1 += withDates ? 864e5 : 1; }
    const pad = Math.max(0.5, (y1 - y0) * 0.06);
    const date = v => new Date(v).toISOString().slice(0, x1 - x0 < 3 * 864e5 ? 16 : 10).replace("T", " ");
    const marks = withDates ? common.clockTicks(x0 / 1000, x1 / 1000, Math.max(2, Math.floor(w / 150)), 0).map(t => t * 1000) : undefined;
    const g = axes(pen, w, h, { low: x0 - (x1 - x0) * 0.02, high: x1 + (x1 - x0) * 0.02, label: withDates ? "Date (UTC)" : "Flight number", marks, words: withDates ? date : undefined }, { low: y0 - pad, high: y1 + pad, label: "Offset [dB]" });
    for (const [x, y, f, l] of points) { const X = g.X(x), Y = g.Y(y); spots.drift.push([X, Y, f]); pen.globalAlpha = 0.7; pen.fillStyle = hues[l % hues.length]; pen.beginPath(); pen.arc(X, Y, 2.4, 0, 7); pen.fill(); }
    pen.globalAlpha = 1;
    const said = [];
    for (const l of chosen) {
      const d = data.drift.find(d => d.setting === state.setting && d.link === l), mine = points.filter(p => p[3] === l);
      if (!mine.length) continue;
      let text = `${links[l].name}: SD ${number(d ? d.spread : NaN, 2, "dB")}`;
      if (d && d.slope !== null) {
        const mx = mine.reduce((t, p) => t + p[0], 0) / mine.length, my = mine.reduce((t, p) => t + p[1], 0) / mine.length, at = x => my + d.slope * (x - mx) / (30 * 864e5);
        pen.strokeStyle = hues[l % hues.length]; pen.lineWidth = 1.8; pen.beginPath(); pen.moveTo(g.X(x0), g.Y(at(x0))); pen.lineTo(g.X(x1), g.Y(at(x1))); pen.stroke();
        text += `, ${number(d.slope, 2)} [${number(d.ci[0], 2)}, ${number(d.ci[1], 2)}] dB per 30 days`;
      }
      said.push([text, hues[l % hues.length]]);
    }
    at("drift-legend").replaceChildren(...said.flatMap(([text, hue], i) => { const dot = document.createElement("span"); dot.textContent = "● "; dot.style.color = hue; return [...(i ? [document.createTextNode("; ")] : []), dot, document.createTextNode(text)]; }));
    ring(pen, spots.drift);
  }

  // --- residuals by place -----------------------------------------------------------------------------------------------

  let project = null, place = null, labels = [];
  const places = () => {
    const chosen = chosenLinks(), one = data.places.find(p => p.link === (chosen.length === 1 ? chosen[0] : -1)) || (data.places.length === 1 ? data.places[0] : null);
    return one;
  };
  const unpacked = new Map();
  function cellsOf(p) {
    if (!unpacked.has(p)) unpacked.set(p, { e: arrays[p.east], n: arrays[p.north], mean: common.values(arrays[p.mean], data.step), spread: common.values(arrays[p.spread], data.step), count: arrays[p.n] });
    return unpacked.get(p);
  }
  const trackOf = f => { const t = data.tracks[f]; return t ? [common.values(arrays[t[0]], data.track_step), common.values(arrays[t[1]], data.track_step)] : null; };
  function drawPlaces() {
    const [pen, w, h] = frame(at("map")), found = places(), c = found && cellsOf(found);
    project = null;
    const chosen = chosenLinks();
    at("place-caption").textContent = found ? `Mean residual (measured minus simulated) by place over flights, “${data.settings[data.reference]}”, ${found.link < 0 ? "all towers and channels" : links[found.link].name}, cells of ${data.cell_m} m.${chosen.length > 1 && chosen.length < links.length ? " (One tower and channel, or all, can be mapped.)" : ""}` : "No residuals by place.";
    if (!c || !c.e.length) return;
    const m = data.cell_m, ext = list => list.reduce(([a, b], v) => [Math.min(a, v), Math.max(b, v)], [Infinity, -Infinity]);
    let [[a, b], [s, n]] = [ext(c.e).map(v => (v + 0.5) * m), ext(c.n).map(v => (v + 0.5) * m)];
    const wide = Math.max(b - a, n - s) / 2, near = (data.site ? data.site.towers : []).map(t => t.at).filter(t => t[0] > a - wide && t[0] < b + wide && t[1] > s - wide && t[1] < n + wide);
    for (const t of near) { a = Math.min(a, t[0]); b = Math.max(b, t[0]); s = Math.min(s, t[1]); n = Math.max(n, t[1]); }
    project = common.plan([46, 6, w - 6, h - 30], [a - 1.5 * m, b + 1.5 * m, s - 1.5 * m, n + 1.5 * m]);
    const scale = project.scale;
    pen.save(); pen.beginPath(); pen.rect(46, 6, w - 52, h - 36); pen.clip();
    if (data.site) {
      const path = f => common.path(pen, f, project, true);
      for (const f of data.site.forests) { path(f); pen.fillStyle = css("--forest"); pen.fill(); }
      for (const faces of data.site.buildings) for (const f of faces) { path(f); pen.fillStyle = css("--building"); pen.fill("evenodd"); }
    }
    for (let i = 0; i < c.e.length; i++) {
      pen.fillStyle = `rgb(${diverging((c.mean[i] + data.reach) / (2 * data.reach))})`;
      pen.fillRect(project.x(c.e[i] * m), project.y((c.n[i] + 1) * m), m * scale + 0.4, m * scale + 0.4);
    }
    const track = state.flight === null ? null : trackOf(state.flight);
    if (track) for (const [colour, wide] of [["#000", 4], ["#F0C000", 2]]) { pen.beginPath(); track[0].forEach((e, i) => i ? pen.lineTo(project.x(e), project.y(track[1][i])) : pen.moveTo(project.x(e), project.y(track[1][i]))); pen.strokeStyle = colour; pen.lineWidth = wide; pen.stroke(); }
    for (const t of data.site ? data.site.towers : []) common.tower(pen, project.x(t.at[0]), project.y(t.at[1]));
    labels = common.names(pen, [46, 6, w - 6, h - 30], (data.site ? data.site.towers : []).map(t => ({ text: t.name, at: [project.x(t.at[0]), project.y(t.at[1])], colour: css("--accent"), halo: css("--paper") })));
    if (place !== null && c.e[place] !== undefined) { pen.strokeStyle = "#000"; pen.lineWidth = 2; pen.strokeRect(project.x(c.e[place] * m), project.y((c.n[place] + 1) * m), m * scale, m * scale); }
    pen.restore();
    common.planAxes(pen, project, w, h);
  }
  function drawLegend() {
    const [pen, w] = frame(at("legend")), ends = [46, w - 40];
    common.colourBar(pen, diverging, [-data.reach, data.reach], ends, 4);
    pen.fillText("Mean residual [dB]", (ends[0] + ends[1]) / 2, 48); pen.textAlign = "left";
  }
  function describePlace() {
    const found = places(), c = found && cellsOf(found);
    at("place").textContent = place === null || !c || c.e[place] === undefined ? "Point at a cell." : `East ${number((c.e[place] + 0.5) * data.cell_m, 0)} m, north ${number((c.n[place] + 0.5) * data.cell_m, 0)} m: mean ${number(c.mean[place], 2, "dB")}, standard deviation over flights ${number(c.spread[place], 2, "dB")}, ${c.count[place]} ${found.link < 0 ? "flights times links" : "flights"}.`;
  }

  // --- one flight -------------------------------------------------------------------------------------------------------

  function describe() {
    const link = at("report-link");
    link.replaceChildren();
    if (state.flight === null) { cells(at("marked"), [["Flight", "point at a flight"]]); return; }
    const flight = flights[state.flight], f = perFlight(state.setting)[state.flight], out = [["Flight", flight.name]];
    if (flight.t !== null) out.push(["Start", new Date(flight.t).toISOString().slice(0, 16).replace("T", " ") + " UTC"]);
    out.push([`Error, “${data.settings[state.setting]}”`, number(f.error, 2, "dB")], ["Mean offset", number(f.offset, 1, "dB")]);
    for (const [l, e] of [...byLink(state.setting)[state.flight]].sort((a, b) => b[1] - a[1]).slice(0, 6)) out.push([links[l].name, number(e, 2, "dB")]);
    for (const [who, setting, message] of data.failures.filter(x => x[0] === state.flight).slice(0, 2)) out.push([`Failed: ${setting}`, data.messages[message]]);
    cells(at("marked"), out);
    if (flight.href) { const a = document.createElement("a"); a.href = flight.href; a.textContent = `Report of ${flight.name}`; link.append(a); }
  }
  function mark(i, scroll = false) {
    if (state.kept || i === state.flight) return;
    state.flight = i; markRow(scroll);
    later(drawDistribution, drawDrift, drawPlaces, describe);
  }
  function keep(i) { state.kept = false; mark(i, true); state.kept = i !== null; }
  for (const name of ["distribution", "drift"]) {
    const nearest = e => {
      const r = at(name).getBoundingClientRect(), x = e.clientX - r.left, y = e.clientY - r.top;
      let best = 225, found = null;
      for (const spot of spots[name]) { const d = (spot[0] - x) ** 2 + (spot[1] - y) ** 2; if (d < best) { best = d; found = spot; } }
      return found;
    };
    at(name).addEventListener("pointermove", e => { const spot = nearest(e); if (spot) mark(spot[2], true); });
    at(name).addEventListener("click", e => { const spot = nearest(e); if (!spot) return; if (spot[3] !== undefined) { state.setting = spot[3]; controls(); everything(); } keep(spot[2]); });
  }
  at("map").addEventListener("pointermove", e => {
    const found = places();
    if (!project || !found) return;
    const r = at("map").getBoundingClientRect(), c = cellsOf(found), i = Math.floor(project.east(e.clientX - r.left) / data.cell_m), j = Math.floor(project.north(e.clientY - r.top) / data.cell_m);
    let k = null;
    for (let q = 0; q < c.e.length; q++) if (c.e[q] === i && c.n[q] === j) { k = q; break; }
    if (k !== place) { place = k; later(drawPlaces, describePlace); }
  });
  root.addEventListener("keydown", e => {
    if (["SELECT", "BUTTON", "A"].includes(e.target.tagName)) return;
    const step = { ArrowDown: 1, ArrowRight: 1, ArrowUp: -1, ArrowLeft: -1 }[e.key];
    if (e.key === "Escape") { state.kept = false; mark(null); }
    if (!step || !shown.length) return;
    e.preventDefault();
    const order = [...at("flights").tBodies[0].rows].map(tr => +tr.dataset.flight), i = order.indexOf(state.flight);
    state.kept = false; mark(order[Math.max(0, Math.min(order.length - 1, i + step))], true);
  });

  // --- choices ----------------------------------------------------------------------------------------------------------

  const unique = list => [...new Set(list)];
  function controls() {
    fill(at("setting"), data.settings, state.setting);
    for (const name of ["tower", "channel"]) {
      const values = [ALL, ...unique(links.filter(l => name === "tower" || state.tower === ALL || l.tower === state.tower).map(l => l[name]))];
      if (!values.includes(state[name])) state[name] = ALL;
      fill(at(name), values, values.indexOf(state[name]));
      at(name).closest("label").hidden = values.length < 3;
    }
    fill(at("measure"), data.held_out ? ["held out: offset of the other flights", "offset of the flight's own samples"] : ["offset of the flight's own samples"], state.measure === "held" ? 0 : data.held_out ? 1 : 0);
    at("said").textContent = (data.held_out ? "" : "No second flight has these towers and channels: each error uses the offset of the flight's own samples. ") + `This page holds errors and offsets in steps of ${data.step} dB; campaign.csv holds all digits.` + (data.left_out ? ` Left out of this page for its size: ${data.left_out}.` : "");
  }
  const filters = () => { for (const tr of document.querySelectorAll("#failures-table tbody tr")) tr.hidden = !["every setting", data.settings[state.setting]].includes(tr.dataset.setting) && tr.dataset.setting !== undefined && at("failures-filter").checked; };
  for (const [id, change] of [["setting", v => { state.setting = +v; }], ["measure", v => { state.measure = data.held_out && +v === 0 ? "held" : "own"; }]]) at(id).addEventListener("change", e => { change(e.target.value); controls(); everything(); });
  for (const name of ["tower", "channel"]) at(name).addEventListener("change", e => { state[name] = e.target.selectedOptions[0].textContent; controls(); everything(); });
  if (at("failures-filter")) at("failures-filter").addEventListener("change", filters);

  function everything() {
    drawRanking(); drawFlights();
    if (at("failures-filter")) filters();
    place = null;
    later(drawDistribution, drawDrift, drawPlaces, drawLegend, describe, describePlace);
  }
  whenResized(root, () => { drawDistribution(); drawDrift(); drawPlaces(); drawLegend(); });

  document.documentElement.classList.add("live");
  controls(); everything();
  window.campaignExplorer = { state, data, perFlight, ranking: () => ranked, mark, keep, spots, everything, controls, places: () => { const p = places(); return p && { link: p.link, ...cellsOf(p) }; }, labels: () => labels, project: () => project, trackOf, ready: true };
})().catch(error => { // an old browser without the means: the static tables and figures stay
  document.documentElement.classList.remove("live");
  console.error(error);
});
