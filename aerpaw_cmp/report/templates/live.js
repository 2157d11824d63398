"use strict";
// The page of the tap: it stores the data that the tap sends and draws them. If the connection is lost, it reconnects and requests
// the data that it missed. Rows are numbered, so that none is stored twice.
(() => {
  const { at, css, number, cells, later, shade, polygon, polyline } = common;
  const scene = JSON.parse(at("scene").textContent), mapped = Boolean(scene.site);
  const MEASURED = ["t", "rank", "rsrp", "sinr"];
  const PREDICTED = ["t", "rank", "predicted", "low", "high", "rsrp", "level", "levelLow", "levelHigh", "east", "north", "up"];
  const MOST = 150000; // largest number of stored rows per table; above it, the older half is dropped
  const SILENT_MS = 10000; // the tap sends something every second; after this time without data, the page reconnects
  const state = { modems: [], alarms: new Map(), epoch: "", page: "", ended: null, chosen: 0, pose: null, drawn: 0, delay: NaN, now: NaN, clock: null, start: 0, beeps: 0, received: 0 };
  const view = { zoom: 1, east: 0, north: 0 };

  // --- received data ---------------------------------------------------------------------------------------------------

  const table = names => ({ names, count: 0, columns: Object.fromEntries(names.map(name => [name, []])) });
  const last = list => list.length ? list[list.length - 1] : NaN;

  function take(rows, [first, data]) {
    const raw = atob(data), bytes = new Uint8Array(raw.length);
    for (let i = 0; i < raw.length; i++) bytes[i] = raw.charCodeAt(i);
    const values = new Float32Array(bytes.buffer), wide = rows.names.length, n = values.length / wide;
    const known = Math.max(0, rows.count - first);
    for (let row = known; row < n; row++) rows.names.forEach((name, i) => {
      const value = values[row * wide + i];
      rows.columns[name].push(i ? value : state.start + value * 1000);
    });
    rows.count = Math.max(rows.count, first + n);
    if (rows.columns.t.length > MOST) for (const name of rows.names) rows.columns[name].splice(0, MOST / 2);
  }

  function receive(text, id) {
    const message = JSON.parse(text);
    if (state.page && message.page !== state.page) { location.reload(); return; } // the tap was restarted with another flight
    if (message.epoch !== state.epoch) {
      for (const modem of state.modems) for (const rows of [modem.rows, modem.predictions]) {
        rows.count = 0;
        if (rows.columns.t.length) for (const name of rows.names) rows.columns[name].push(name === "t" ? message.start_ms : NaN);
      }
      for (const alarm of state.alarms.values()) alarm.end ??= state.now;
      Object.assign(state, { epoch: message.epoch, ended: null });
    }
    Object.assign(state, { page: message.page, start: message.start_ms, now: message.start_ms + message.now_s * 1000, ended: message.ended, received: Date.now(), cursor: id });
    message.modems.forEach((sent, i) => {
      const modem = state.modems[i] ??= { rows: table(MEASURED), predictions: table(PREDICTED) };
      take(modem.rows, sent.rows); take(modem.predictions, sent.predictions);
      modem.now = sent;
    });
    for (const alarm of message.alarms) hear(message.epoch, alarm);
    later(draw);
  }

  function hear(epoch, sent) {
    const key = `${epoch}/${sent.number}`, fresh = !state.alarms.has(key);
    state.alarms.set(key, { ...sent, begin: state.start + sent.start_s * 1000, end: sent.end_s === null ? null : state.start + sent.end_s * 1000 });
    if (fresh && sent.end_s === null && sent.kind !== "message") beep();
  }

  // --- the connection -----------------------------------------------------------------------------------------------

  history.replaceState(null, "", location.pathname); // the token is used once: the cookie replaces it, so remove it from the address bar
  let source = null, opening = 0;
  function connect() {
    if (source) source.close();
    source = new EventSource(state.cursor ? `events?from=${encodeURIComponent(state.cursor)}` : "events");
    opening = Date.now();
    source.onmessage = event => receive(event.data, event.lastEventId);
    source.onerror = () => later(draw);
  }
  const connected = () => source && source.readyState === 1 && Date.now() - state.received < SILENT_MS;
  setInterval(() => {
    const silent = Date.now() - Math.max(opening, state.received) > SILENT_MS;
    if (!source || source.readyState === 2 ? Date.now() - opening > 2000 : silent && !state.ended) connect();
    later(draw);
  }, 1000);

  // --- sound and theme ----------------------------------------------------------------------------------------------

  let audio = null;
  function beep() {
    if (!audio) return;
    state.beeps++;
    for (const [k, pitch] of [880, 660, 880].entries()) {
      const tone = audio.createOscillator(), gain = audio.createGain(), from = audio.currentTime + k * 0.18;
      tone.frequency.value = pitch; gain.gain.value = 0.2; tone.connect(gain); gain.connect(audio.destination);
      tone.start(from); tone.stop(from + 0.14);
    }
  }
  at("sound").addEventListener("click", () => {
    if (audio) { audio.close(); audio = null; } else { audio = new AudioContext(); beep(); }
    at("sound").textContent = audio ? "Sound on" : "Sound off"; at("sound").setAttribute("aria-pressed", String(Boolean(audio)));
  });

  function setTheme(name) {
    document.documentElement.dataset.theme = name;
    at("theme").textContent = name === "dark" ? "Sunlight" : "Dark";
    at("theme").setAttribute("aria-label", name === "dark" ? "Use the theme for sunlight" : "Use the dark theme");
    try { localStorage.setItem("theme", name); } catch { /* private windows refuse */ }
    later(draw);
  }
  at("theme").addEventListener("click", () => setTheme(document.documentElement.dataset.theme === "dark" ? "sun" : "dark"));

  // --- texts --------------------------------------------------------------------------------------------------------

  const clock = (ms, digits = 8) => Number.isFinite(ms) ? new Date(ms).toISOString().slice(11, 11 + digits) : "–";
  const integer = v => Number.isFinite(v) ? String(Math.round(v)) : "–";
  const span = (low, high, unit = "") => Number.isFinite(low) ? `${number(low, 0)} to ${number(high, 0)}${unit && " " + unit}` : "none yet";
  function lasted(seconds) { return seconds < 60 ? `${Math.max(1, Math.round(seconds))} s` : `${Math.floor(seconds / 60)} min ${Math.round(seconds % 60)} s`; }
  function share([inside, given]) { return given ? `${number(100 * inside / given, 0)} % of ${given}` : "none yet"; }
  function mark(element, value, low, high) {
    const judged = Number.isFinite(value) && Number.isFinite(low);
    if (judged) element.append(make("small", value >= low && value <= high ? "inside" : "outside", value >= low && value <= high ? "inside" : "outside"));
  }

  function make(tag, className, text = "") { const e = document.createElement(tag); e.className = className; e.textContent = text; return e; }

  function drawCards() {
    const host = at("modems");
    while (host.children.length < state.modems.length) {
      const card = make("button", "card"), index = host.children.length, name = make("span", "name");
      card.type = "button"; name.append(make("span", ""), make("i", "")); card.append(name, make("span", "big"), make("div", "readings"));
      card.addEventListener("click", () => { state.chosen = index; state.pose = null; later(draw); });
      host.append(card);
    }
    state.modems.forEach((modem, i) => {
      const card = host.children[i], now = modem.now, c = modem.predictions.columns, k = c.t.length - 1, [name, big, facts] = card.children;
      card.setAttribute("aria-pressed", String(i === state.chosen && state.modems.length > 1));
      name.children[0].textContent = now.name; name.children[1].textContent = now.port === now.name ? "" : now.port;
      const age = now.rank_age_s + (Date.now() - state.received) / 1000, stale = now.rank && age > now.stale_s;
      card.classList.toggle("stale", Boolean(stale));
      big.textContent = stale ? `${now.rank}\n${lasted(age)} old` : now.rank ?? (now.connected ? "no CSI" : now.ended ? "ended" : "no modem"); big.className = now.rank && !stale ? "big" : "big none"; big.style.color = now.rank && !stale ? css(`--rank${now.rank}`) : "";
      big.setAttribute("aria-label", now.rank ? `measured rank ${now.rank}${stale ? `, ${lasted(age)} old` : ""}` : "no rank");
      const rows = [["RSRP", number(now.rsrp_dbm ?? NaN, 0, "dBm")], ["SINR", number(now.sinr_db ?? NaN, 0, "dB")], ["Answers", `${number(now.ri_rate_hz, 1)} Hz`], ["Gaps", String(now.gaps)], ["Records", String(now.records)]];
      if (now.disk_free_bytes !== null) rows.push(["Disk left", now.disk_free_bytes > 2 ** 30 ? number(now.disk_free_bytes / 2 ** 30, 1, "GiB") : number(now.disk_free_bytes / 2 ** 20, 0, "MiB")]);
      if (now.predicts) rows.unshift(["Predicted rank", k < 0 ? "–" : integer(c.predicted[k]) + (Number.isFinite(c.low[k]) ? ` (${c.low[k]}${c.low[k] < c.high[k] ? "–" + c.high[k] : ""})` : "")],
        ["Residual, RSRP", k < 0 ? "–" : number(c.rsrp[k] - c.level[k], 1, "dB")]);
      cells(facts, rows);
      if (now.predicts && k >= 0) { mark(facts.children[0].lastChild, c.rank[k], c.low[k], c.high[k]); mark(facts.children[1].lastChild, c.rsrp[k], c.levelLow[k], c.levelHigh[k]); }
    });
  }

  function drawState() {
    const open = state.modems.filter(m => m.now.connected).length, online = connected();
    const [text, kind] = state.ended ? ["ended", ""] : !online ? ["no connection to the tap", "bad"] : open < state.modems.length ? [state.modems.length > 1 ? `${open} of ${state.modems.length} modems` : "no modem", "bad"] : ["live", "live"];
    at("state").textContent = text; at("state").className = `pill ${kind}`;
    at("clock").textContent = `${clock(state.now)} UTC`;
    at("ended").hidden = !state.ended;
    if (state.ended) {
      at("ended-text").textContent = state.ended.text;
      at("commands").textContent = state.ended.commands.join("\n");
      at("show-report").hidden = !state.ended.commands.length;
    }
  }
  at("show-report").addEventListener("click", async () => {
    at("commands").hidden = false;
    try { await navigator.clipboard.writeText(at("commands").textContent); at("copied").textContent = "copied"; } catch { at("copied").textContent = ""; }
  });

  let historyShown = "";
  function drawAlarms() {
    const all = [...state.alarms.values()].sort((a, b) => b.begin - a.begin || b.number - a.number), open = all.filter(a => a.end === null);
    const several = state.modems.length > 1, name = a => state.modems[a.modem]?.now.name ?? "";
    const words = open.map(a => (several ? `${name(a)}: ` : "") + a.text);
    if (at("alarms").dataset.words !== words.join("\n")) {
      at("alarms").dataset.words = words.join("\n");
      at("alarms").replaceChildren(...words.map(text => make("span", "alarm", text)));
    }
    const lines = all.slice(0, 200).map(a => [clock(a.begin), a.kind === "message" ? "" : a.end === null ? "now" : lasted((a.end - a.begin) / 1000), several ? name(a) : "", a.text]);
    if (JSON.stringify(lines) === historyShown) return;
    historyShown = JSON.stringify(lines);
    at("modem-column").textContent = several ? "Modem" : "";
    at("no-history").hidden = lines.length > 0;
    at("history").replaceChildren(...lines.map(line => {
      const row = make("tr", line[1] === "now" ? "now" : "");
      row.append(...line.map(text => make("td", "", text)));
      return row;
    }));
  }

  function drawPose() {
    const modem = state.modems[state.chosen];
    if (!modem) return;
    const c = modem.predictions.columns, m = modem.rows.columns, t = state.pose ?? last(m.t);
    if (!Number.isFinite(t)) { cells(at("pose"), [["Moment", "no answer so far"]]); return; }
    const i = nearest(m.t, t), rows = [[state.pose === null ? "Latest answer" : "Marked moment", `${clock(m.t[i], 10)} UTC`], ["Rank", integer(m.rank[i])], ["RSRP", number(m.rsrp[i], 0, "dBm")], ["SINR", number(m.sinr[i], 0, "dB")]];
    if (c.t.length) {
      const k = nearest(c.t, t);
      rows.push(["Predicted rank", `${integer(c.predicted[k])}, 90 %: ${span(c.low[k], c.high[k])}`], ["Predicted RSRP", `${number(c.level[k], 0, "dBm")}, 90 %: ${span(c.levelLow[k], c.levelHigh[k])}`]);
      rows.push(["Residual", number(c.rsrp[k] - c.level[k], 1, "dB")], ["East, north, up", `${number(c.east[k], 0)}, ${number(c.north[k], 0)}, ${number(c.up[k], 0)} m`]);
    }
    cells(at("pose"), rows);
  }

  // --- charts over time ---------------------------------------------------------------------------------------------

  function nearest(time, t) {
    let low = 0, high = time.length - 1;
    while (high - low > 1) { const mid = (low + high) >> 1; if (time[mid] <= t) low = mid; else high = mid; }
    return high >= 0 && Math.abs(time[high] - t) < Math.abs(time[low] - t) ? high : Math.max(0, low);
  }

  function range() {
    const firsts = state.modems.map(m => m.rows.columns.t[0]).filter(Number.isFinite), first = firsts.length ? Math.min(...firsts) : state.now - 1000;
    const wide = +at("window").value * 1000;
    return wide ? [Math.max(first, state.now - wide), Math.max(state.now, first + 5000)] : [first, Math.max(state.now, first + 5000)];
  }

  const scales = new Map(); // the x axis of each chart, for the pointer

  function chart(id, parts, y) {
    const canvas = at(id);
    if (!canvas || !canvas.clientWidth) return;
    const [low, high] = range(), [pen, w, h] = common.frame(canvas);
    const end = high - 0.04 * (high - low), marks = common.clockTicks(low / 1000, end / 1000, Math.max(2, w / 110), 0).map(t => t * 1000); // keep labels inside the edge
    const g = common.axes(pen, w, h + 16, { low, high, label: "", marks, words: t => clock(t) }, y, 52);
    scales.set(id, { g, low, high, again: () => chart(id, parts, y) });
    pen.save(); pen.beginPath(); pen.rect(g.left, g.top - 4, g.right - g.left, g.bottom - g.top + 8); pen.clip();
    for (const part of parts) part(pen, g, low, high);
    if (state.pose !== null) polyline(pen, [[g.X(state.pose), g.top], [g.X(state.pose), g.bottom]], css("--accent"), 1.5);
    pen.restore();
  }

  const within = (time, low, high) => [Math.max(0, nearest(time, low) - 1), Math.min(time.length, nearest(time, high) + 2)];
  const dots = (time, values, colour, size = 4) => (pen, g, low, high) => {
    const [a, b] = within(time, low, high), fixed = typeof colour === "string";
    if (fixed) pen.fillStyle = colour;
    for (let i = a; i < b; i++) if (Number.isFinite(values[i])) { if (!fixed) pen.fillStyle = colour(i); pen.fillRect(g.X(time[i]) - size / 2, g.Y(values[i]) - size / 2, size, size); }
  };
  function runs(time, values, low, high, job) { // segments without a gap: nothing is drawn in a gap
    const [a, b] = within(time, low, high);
    let run = [];
    for (let i = a; i <= b; i++) {
      if (i < b && Number.isFinite(values[i]) && !(run.length && time[i] - time[run[run.length - 1]] > 5000)) { run.push(i); continue; }
      if (run.length > 1) job(run);
      run = i < b && Number.isFinite(values[i]) ? [i] : [];
    }
  }
  const line = (time, values, colour, width = 2, stepped = false) => (pen, g, low, high) => runs(time, values, low, high, run =>
    polyline(pen, run.flatMap((i, k) => { const p = [g.X(time[i]), g.Y(values[i])]; return stepped && k ? [[p[0], g.Y(values[run[k - 1]])], p] : [p]; }), colour, width));
  const band = (time, under, over, colour, stepped = false) => (pen, g, low, high) => runs(time, under, low, high, run => {
    const edge = values => run.flatMap((i, k) => { const p = [g.X(time[i]), g.Y(values[i])]; return stepped && k ? [[p[0], g.Y(values[run[k - 1]])], p] : [p]; });
    polygon(pen, [...edge(under), ...edge(over).reverse()], colour, null);
  });

  function extent(lists, least) {
    const [from, to] = range();
    let low = Infinity, high = -Infinity;
    for (const [time, values] of lists) { const [a, b] = within(time, from, to); for (let i = a; i < b; i++) if (Number.isFinite(values[i])) { low = Math.min(low, values[i]); high = Math.max(high, values[i]); } }
    if (!(high >= low)) return [0, least];
    const pad = Math.max(0.08 * (high - low), (least - (high - low)) / 2, 1);
    return [Math.floor((low - pad) / 5) * 5, Math.ceil((high + pad) / 5) * 5];
  }

  function drawCharts() {
    const modem = state.modems[state.chosen];
    if (!modem) return;
    const m = modem.rows.columns, c = modem.predictions.columns, ink = css("--predicted"), blue = css("--measured"), grey = css("--interval"), red = css("--accent");
    const half = values => values.map(v => v - 0.25), more = values => values.map(v => v + 0.25), given = modem.now.inside;
    const known = c.t.length > 0;
    at("rank-words").textContent = known ? `dots measured, line predicted; inside the 90 % interval: ${share(given?.slice(0, 2) ?? [0, 0])}` : "dots measured";
    at("rsrp-words").textContent = known ? `dots measured, line predicted plus offset; inside the 90 % interval: ${share(given?.slice(2) ?? [0, 0])}` : "dots measured";
    const [from, to] = range(), part = list => { const [a, b] = within(c.t, from, to); return list.slice(a, b); }, ct = part(c.t);
    chart("chart-rank", [band(ct, half(part(c.low)), more(part(c.high)), grey, true), line(ct, part(c.predicted), ink, 2, true), dots(m.t, m.rank, blue, 5)], { low: 0.5, high: 4.5, label: "", marks: [1, 2, 3, 4] });
    const [low, high] = extent([[m.t, m.rsrp], [c.t, c.level]], 20);
    chart("chart-rsrp", [band(c.t, c.levelLow, c.levelHigh, grey), line(c.t, c.level, ink), dots(m.t, m.rsrp, blue)], { low, high, label: "dBm" });
    if (mapped) {
      const rest = part(c.rsrp), level = part(c.level), below = part(c.levelLow), above = part(c.levelHigh), residual = rest.map((v, i) => v - level[i]);
      const reach = Math.max(6, ...residual.map(v => Number.isFinite(v) ? Math.min(30, Math.abs(v)) : 0), ...below.map((v, i) => Number.isFinite(v) ? Math.min(30, Math.abs(v - level[i])) : 0)) * 1.1;
      at("residual-words").textContent = "measured minus predicted; red: outside the interval";
      chart("chart-residual", [band(ct, below.map((v, i) => v - level[i]), above.map((v, i) => v - level[i]), grey), line(ct, ct.map(() => 0), ink, 1), dots(ct, residual, i => rest[i] < below[i] || rest[i] > above[i] ? red : blue, 5)], { low: -reach, high: reach, label: "dB" });
    }
    const [least, most] = extent([[m.t, m.sinr]], 10);
    chart("chart-sinr", [dots(m.t, m.sinr, blue)], { low: least, high: most, label: "dB" });
  }

  // names of columns and a row an answer, of what is measured ("rows") or predicted at poses ("predictions")
  function listed(kind) { const c = state.modems[state.chosen][kind].columns; return [Object.keys(c), ...c.t.map((_, i) => Object.values(c).map(list => list[i]))]; }
  for (const id of ["chart-rank", "chart-rsrp", "chart-residual", "chart-sinr"]) {
    const canvas = at(id);
    if (!canvas) continue;
    const saves = Object.assign(document.createElement("p"), { className: "saves" });
    saves.append(common.downloads(canvas, id.slice(6), () => listed("rows"), () => scales.get(id)?.again()));
    canvas.previousElementSibling.before(saves); // shown next to the heading, so that it takes no line on a small screen
    canvas.addEventListener("pointermove", e => {
      const s = scales.get(id);
      if (!s) return;
      const x = e.clientX - canvas.getBoundingClientRect().left;
      choose(s.low + (x - s.g.left) / (s.g.right - s.g.left) * (s.high - s.low));
    });
    canvas.addEventListener("pointerleave", () => choose(null));
  }
  function choose(t) { state.pose = t; later(draw); }

  // --- the map ------------------------------------------------------------------------------------------------------

  let layers = null, project = null, drawnPoses = [];
  const canvas = at("map"), KEY = 40;
  const RANK = k => css(`--rank${Math.max(0, Math.min(4, Math.round(k) || 0))}`);

  function height() { // the level of the prediction nearest to the UAV's height
    const up = last(state.modems[state.chosen]?.predictions.columns.up.filter(Number.isFinite).slice(-1) ?? []);
    return scene.heights.reduce((best, h, i) => Math.abs(h - up) < Math.abs(scene.heights[best] - up) ? i : best, 0);
  }

  function levelRange() {
    const known = Array.from(layers.level).filter(Number.isFinite).sort((a, b) => a - b);
    return [common.quantile(known, 0.05), common.quantile(known, 0.99)];
  }

  const rasters = new Map();
  function raster(kind, level) {
    const key = `${kind}/${level}/${document.documentElement.dataset.theme}`;
    if (rasters.has(key)) return rasters.get(key);
    const n = scene.columns * scene.rows, picture = document.createElement("canvas"), pen = (picture.width = scene.columns, picture.height = scene.rows, picture.getContext("2d"));
    const ranks = [0, 1, 2, 3, 4].map(RANK), [low, high] = levelRange();
    for (let i = 0; i < n; i++) {
      const v = layers[kind][level * n + i], none = kind === "rank" ? !v : !Number.isFinite(v);
      if (none) continue;
      pen.fillStyle = kind === "rank" ? ranks[v] : shade(v, low, high);
      pen.fillRect(i % scene.columns, scene.rows - 1 - Math.floor(i / scene.columns), 1, 1);
    }
    rasters.set(key, picture);
    return picture;
  }

  function box() {
    const e = [], n = [];
    for (const { predictions: { columns: c } } of state.modems) for (let i = 0; i < c.t.length; i += Math.ceil(c.t.length / 400)) if (Number.isFinite(c.east[i])) { e.push(c.east[i]); n.push(c.north[i]); }
    const tower = scene.site.towers.find(t => t.name === scene.tower);
    if (tower) { e.push(tower.at[0]); n.push(tower.at[1]); }
    if (e.length < 3) { e.push(scene.east, scene.east + scene.step * scene.columns); n.push(scene.north, scene.north + scene.step * scene.rows); }
    return [Math.min(...e), Math.max(...e), Math.min(...n), Math.max(...n)];
  }

  function colouring() {
    const kind = at("colour").value, c = state.modems[state.chosen].predictions.columns;
    if (kind === "rank") return { words: "measured rank", of: i => RANK(c.rank[i]), key: [1, 2, 3, 4].map(k => [RANK(k), String(k)]) };
    if (kind === "rsrp") {
      const seen = c.rsrp.filter(Number.isFinite).sort((a, b) => a - b), low = Math.floor(common.quantile(seen, 0.02) / 5) * 5, high = Math.ceil(common.quantile(seen, 0.98) / 5) * 5;
      return { words: "measured RSRP [dBm]", of: i => Number.isFinite(c.rsrp[i]) ? shade(c.rsrp[i], low, high) : css("--rank0"), key: [0, .25, .5, .75, 1].map(x => [shade(x, 0, 1), number(low + x * (high - low), 0)]) };
    }
    const [reach, words, value] = kind === "residual-rank" ? [2, "residual of the rank, measured minus predicted", i => c.rank[i] - c.predicted[i]] : [12, "residual of the RSRP [dB], measured minus predicted", i => c.rsrp[i] - c.level[i]];
    return { words, of: i => Number.isFinite(value(i)) ? shade(value(i), -reach, reach, true) : css("--rank0"), key: [-1, -.5, 0, .5, 1].map(x => [shade(x, -1, 1, true), number(x * reach, 0)]) };
  }

  function drawMap() {
    if (!mapped || !layers || !state.modems.length || !canvas.clientWidth) return;
    const [pen, w, full] = common.frame(canvas), h = full - KEY, b = box();
    const scale = view.zoom * Math.min((w - 50) / Math.max(b[1] - b[0], 120), (h - 50) / Math.max(b[3] - b[2], 120)), middle = [(b[0] + b[1]) / 2 + view.east, (b[2] + b[3]) / 2 + view.north];
    project = (e, n) => [w / 2 + (e - middle[0]) * scale, h / 2 - (n - middle[1]) * scale];
    project.scale = scale;
    pen.save(); pen.beginPath(); pen.rect(0, 0, w, h); pen.clip();
    for (const ring of scene.site.forests) polygon(pen, ring.map(p => project(p[0], p[1])), css("--forest"), null);
    const kind = at("layer").value, level = height();
    if (kind !== "none") {
      const s = scene.step, [left, top] = project(scene.east - s / 2, scene.north + s * (scene.rows - 0.5));
      pen.imageSmoothingEnabled = kind === "level"; pen.globalAlpha = document.documentElement.dataset.theme === "dark" ? 0.4 : 0.5;
      pen.drawImage(raster(kind, level), left, top, scene.columns * s * scale, scene.rows * s * scale);
      pen.globalAlpha = 1;
    }
    for (const faces of scene.site.buildings) for (const face of faces) polygon(pen, face.map(p => project(p[0], p[1])), css("--building"), css("--soft"));
    drawFlight(pen);
    for (const t of scene.site.towers) {
      const [x, y] = project(t.at[0], t.at[1]), own = t.name === scene.tower;
      polygon(pen, [[x, y - 9], [x - 7, y + 6], [x + 7, y + 6]], css(own ? "--accent" : "--soft"), css("--paper"));
    }
    common.names(pen, [0, 0, w, h], scene.site.towers.map(t => ({ text: t.name, at: project(t.at[0], t.at[1]), colour: css(t.name === scene.tower ? "--accent" : "--ink"), halo: css("--halo") })), scene.site.credit, "bold 13px system-ui, sans-serif");
    pen.restore();
    drawKey(pen, w, full, kind);
    const offset = state.modems[state.chosen].now.offset_db;
    at("map-words").textContent = kind === "none" ? `Tower ${scene.tower}.` : `Background: ${kind} predicted for tower ${scene.tower} at ${number(scene.heights[level], 0)} m, UAV level, heading north${kind === "rank" ? `, K = ${scene.k}` : `, ${number(levelRange()[0] + (offset ?? 0), 0)} to ${number(levelRange()[1] + (offset ?? 0), 0)} dBm${offset === null ? " before any offset" : ""}`}.`;
  }

  function drawFlight(pen) {
    drawnPoses = [];
    const rim = css("--dot");
    for (const modem of state.modems) {
      const c = modem.predictions.columns, own = modem === state.modems[state.chosen];
      if (!own) continue;
      const paint = colouring();
      runs(c.t, c.east, -Infinity, Infinity, run => polyline(pen, run.map(i => project(c.east[i], c.north[i])), rim, 1));
      const every = Math.ceil(c.t.length / 20000);
      for (let i = 0; i < c.t.length; i += every) {
        if (!Number.isFinite(c.east[i])) continue;
        const p = project(c.east[i], c.north[i]);
        drawnPoses.push([p[0], p[1], c.t[i]]);
        pen.fillStyle = rim; pen.fillRect(p[0] - 4, p[1] - 4, 8, 8);
        pen.fillStyle = paint.of(i); pen.fillRect(p[0] - 3, p[1] - 3, 6, 6);
      }
      const k = state.pose === null ? c.t.length - 1 : nearest(c.t, state.pose);
      if (k >= 0 && Number.isFinite(c.east[k])) {
        const p = project(c.east[k], c.north[k]);
        for (const [radius, colour, width] of [[11, css("--paper"), 6], [11, css("--accent"), 3]]) { pen.beginPath(); pen.arc(p[0], p[1], radius, 0, 7); pen.strokeStyle = colour; pen.lineWidth = width; pen.stroke(); }
      }
    }
  }

  function drawKey(pen, w, h, kind) {
    const paint = colouring(), metres = [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000].find(m => m * project.scale > 50) || 2000;
    pen.fillStyle = css("--ink"); pen.font = "12px system-ui, sans-serif"; pen.textAlign = "left";
    polyline(pen, [[10, h - 10], [10 + metres * project.scale, h - 10]], css("--ink"), 3); pen.fillText(`${metres} m`, 10, h - 16);
    paint.key.forEach(([fill, text], i) => { const x = w - 38 * (paint.key.length - i) - 4; pen.fillStyle = fill; pen.fillRect(x, h - 22, 36, 8); pen.fillStyle = css("--ink"); pen.textAlign = "center"; pen.fillText(text, x + 18, h - 3); });
    pen.textAlign = "right"; pen.fillText(paint.words, w - 4, h - 27); pen.textAlign = "left";
  }

  if (canvas) {
    common.saves(canvas, "map", () => listed("predictions"), drawMap);
    const fingers = new Map();
    const zoom = by => { view.zoom = Math.min(40, Math.max(0.2, view.zoom * by)); later(draw); };
    canvas.addEventListener("pointerdown", e => { canvas.setPointerCapture(e.pointerId); fingers.set(e.pointerId, [e.clientX, e.clientY]); });
    for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, e => fingers.delete(e.pointerId));
    canvas.addEventListener("pointerleave", () => choose(null));
    canvas.addEventListener("pointermove", e => {
      const held = fingers.get(e.pointerId);
      if (held && project) {
        const others = [...fingers].filter(([id]) => id !== e.pointerId).map(([, p]) => p), dx = e.clientX - held[0], dy = e.clientY - held[1];
        fingers.set(e.pointerId, [e.clientX, e.clientY]);
        if (others.length) zoom(Math.hypot(e.clientX - others[0][0], e.clientY - others[0][1]) / Math.max(1, Math.hypot(held[0] - others[0][0], held[1] - others[0][1])));
        else { view.east -= dx / project.scale; view.north += dy / project.scale; later(draw); }
        return;
      }
      const r = canvas.getBoundingClientRect(), x = e.clientX - r.left, y = e.clientY - r.top;
      let best = 600, t = null;
      for (const [px, py, time] of drawnPoses) { const d = (px - x) ** 2 + (py - y) ** 2; if (d < best) { best = d; t = time; } }
      choose(t);
    });
    canvas.addEventListener("wheel", e => { if (!e.ctrlKey && !e.metaKey && document.activeElement !== canvas) return; e.preventDefault(); zoom(Math.exp(-e.deltaY * 0.0015)); }, { passive: false });
    canvas.addEventListener("keydown", e => {
      const move = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[e.key];
      if (e.key === "+" || e.key === "=") zoom(1.25); else if (e.key === "-") zoom(0.8);
      else if (move && project) { e.preventDefault(); view.east += move[0] * 40 / project.scale; view.north += move[1] * 40 / project.scale; later(draw); }
    });
    at("closer").addEventListener("click", () => zoom(1.4)); at("farther").addEventListener("click", () => zoom(1 / 1.4));
    at("fit").addEventListener("click", () => { Object.assign(view, { zoom: 1, east: 0, north: 0 }); later(draw); });
    for (const id of ["layer", "colour"]) at(id).addEventListener("change", () => later(draw));
    common.unpack(scene).then(arrays => { layers = { rank: arrays[scene.rank], level: common.values(arrays[scene.level], 0.1) }; later(draw); });
  }

  // --- the complete page ----------------------------------------------------------------------------------------------------

  function draw() {
    drawState(); drawCards(); drawAlarms(); drawCharts(); drawPose(); drawMap();
    state.drawn++;
    const newest = last(state.modems[state.chosen]?.rows.columns.t ?? []);
    state.delay = Date.now() - newest; // time from the modem's answer to the screen, if both are on one computer
  }
  at("window").addEventListener("change", () => later(draw));
  common.whenResized(document.body, draw);
  let theme = null;
  try { theme = localStorage.getItem("theme"); } catch { /* private windows refuse */ }
  setTheme(theme || (matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "sun"));
  connect();
  window.live = { state, view, choose, poses: () => drawnPoses, drop: () => source.close() };
})();
