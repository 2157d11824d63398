"use strict";
// Functions of the scripts of all pages: arrays of the page's data, colours, texts, small charts.
const common = (() => {
  const at = id => document.getElementById(id);
  const css = name => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  // a number that rounds to zero has no sign
  const number = (v, digits = 1, unit = "") => Number.isFinite(v) ? (+v.toFixed(digits) === 0 ? 0 : v).toFixed(digits).replace("-", "−") + (unit ? " " + unit : "") : "–";
  const count = n => String(n).replace(/\B(?=(\d{3})+$)/g, "\u202f");
  const FONT = "12px system-ui, sans-serif";

  // one deflated block in base64 that contains all arrays, each at a multiple of eight bytes
  async function unpack(packed) {
    const raw = atob(packed.data), bytes = new Uint8Array(raw.length);
    for (let i = 0; i < raw.length; i++) bytes[i] = raw.charCodeAt(i);
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
    const buffer = await new Response(stream).arrayBuffer();
    const kinds = { i1: Int8Array, u1: Uint8Array, i2: Int16Array, u2: Uint16Array, i4: Int32Array, f4: Float32Array, f8: Float64Array };
    return packed.arrays.map(([kind, offset, length]) => new kinds[kind](buffer, offset, length));
  }

  // numbers stored as integers: value = stored * step; the smallest integer means "none"
  const none = { i1: -128, i2: -32768, u1: 255, u2: 65535 };
  function values(array, step) {
    const missing = array instanceof Int16Array ? none.i2 : array instanceof Uint8Array ? none.u1 : array instanceof Uint16Array ? none.u2 : none.i1;
    return Float64Array.from(array, v => v === missing ? NaN : v * step);
  }

  function cells(target, rows) {
    target.replaceChildren(...rows.map(([name, value]) => {
      const row = document.createElement("dl"), dt = document.createElement("dt"), dd = document.createElement("dd");
      dt.textContent = name; dd.textContent = value; row.append(dt, dd);
      return row;
    }));
  }

  function fill(select, names, chosen, always = false) {
    select.replaceChildren(...names.map((name, i) => { const o = document.createElement("option"); o.value = i; o.textContent = name; return o; }));
    select.value = chosen;
    select.closest("label").hidden = names.length < 2 && !always;
  }

  function frame(canvas) {
    const pen = canvas.getContext("2d"), ratio = devicePixelRatio || 1, w = canvas.clientWidth, h = canvas.clientHeight;
    canvas.width = Math.round(w * ratio); canvas.height = Math.round(h * ratio);
    pen.setTransform(ratio, 0, 0, ratio, 0, 0); pen.fillStyle = css("--paper"); pen.fillRect(0, 0, w, h); pen.font = FONT; pen.lineJoin = "round";
    return [pen, w, h];
  }

  // names next to their points inside an area [left, top, right, bottom], which overlap neither its edges, nor each
  // other, nor the source of the map (credit) in the lower right corner
  function names(pen, area, points, credit = "", font = "bold 12px system-ui, sans-serif") {
    const [left, top, right, bottom] = area, placed = [], high = 13;
    pen.save(); pen.lineWidth = 3; pen.textAlign = "left"; pen.lineJoin = "round";
    if (credit) {
      pen.font = "10px system-ui, sans-serif";
      const x = right - 4 - pen.measureText(credit).width, y = bottom - 4;
      pen.strokeStyle = css("--paper"); pen.strokeText(credit, x, y); pen.fillStyle = css("--soft"); pen.fillText(credit, x, y);
      placed.push([x, y - 10, right, bottom, ""]);
    }
    pen.font = font;
    for (const { text, at, colour, halo, alpha } of points) {
      if (!(at[0] >= left && at[0] <= right && at[1] >= top && at[1] <= bottom)) continue;
      const wide = pen.measureText(text).width;
      const held = ([x, y]) => [Math.max(left + 2, Math.min(right - wide - 2, x)), Math.max(top + high, Math.min(bottom - 4, y))];
      const over = ([x, y]) => placed.reduce((sum, [a, b, c, d]) => sum + Math.max(0, Math.min(x + wide, c) - Math.max(x, a)) * Math.max(0, Math.min(y + 3, d) - Math.max(y - high + 3, b)), 0);
      const tried = [[8, -5], [8, 14], [-wide - 8, -5], [-wide - 8, 14], [-wide / 2, -12], [-wide / 2, 22]].map(d => held([at[0] + d[0], at[1] + d[1]]));
      const [x, y] = tried.reduce((best, one) => over(one) < over(best) - 0.5 ? one : best);
      placed.push([x, y - high + 3, x + wide, y + 3, text]);
      pen.globalAlpha = alpha ?? 1; pen.strokeStyle = halo; pen.strokeText(text, x, y); pen.fillStyle = colour; pen.fillText(text, x, y);
    }
    pen.restore();
    return placed.filter(place => place[4]);
  }

  function ticks(low, high, most = 5) { // at least three
    if (!(high > low)) return [low];
    const raw = (high - low) / most, mag = 10 ** Math.floor(Math.log10(raw)), step = [1, 2, 5, 10].map(k => k * mag).find(k => k >= raw * (1 - 1e-9)), out = [];
    for (let v = Math.ceil(low / step - 1e-9) * step; v <= high + 1e-9 * step; v += step) out.push(Math.abs(v) < 1e-9 * step ? 0 : v);
    return out.length < 3 && most < 20 ? ticks(low, high, most + 1) : out;
  }
  // round times of day between two times, all in seconds; "begun" is the time of day of second 0
  function clockTicks(low, high, most, begun) {
    const day = 86400, steps = [1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 10800, 21600, day, 2 * day, 7 * day, 30 * day, 90 * day, 365 * day];
    const step = steps.find(s => (high - low) / s <= most) ?? 3650 * day, out = [];
    for (let v = Math.ceil((low + begun) / step - 1e-9) * step; v <= high + begun; v += step) out.push(v - begun);
    if (high - low < 4) return ticks(low, high, most);
    return out.length < 3 && most < 20 ? clockTicks(low, high, most + 1, begun) : out;
  }
  const clockText = seconds => new Date(Math.round(seconds * 1000)).toISOString().slice(11, seconds % 1 ? 21 : 19);
  const digits = marks => { const step = marks.length > 1 ? Math.abs(marks[1] - marks[0]) : 1; return Math.max(0, Math.min(6, -Math.floor(Math.log10(step) + 1e-9))); };

  // axes of a small chart; returns both scales. x and y: {low, high, label, marks?, words?}
  function axes(pen, w, h, x, y, left = 50) {
    const right = w - 12, top = 10, bottom = h - 38;
    const X = v => left + (v - x.low) / (x.high - x.low || 1) * (right - left), Y = v => bottom - (v - y.low) / (y.high - y.low || 1) * (bottom - top);
    const xs = x.marks || ticks(x.low, x.high, Math.max(2, Math.floor(w / 110))), ys = y.marks || ticks(y.low, y.high, 4);
    pen.strokeStyle = css("--line"); pen.fillStyle = css("--ink"); pen.lineWidth = 1; pen.font = FONT;
    const dx = digits(xs), dy = digits(ys);
    pen.textAlign = "center";
    for (const v of xs) { pen.beginPath(); pen.moveTo(X(v), top); pen.lineTo(X(v), bottom); pen.stroke(); const words = x.words ? x.words(v) : number(v, dx), half = pen.measureText(words).width / 2; pen.fillText(words, Math.max(half, Math.min(w - half, X(v))), bottom + 14); }
    pen.textAlign = "right";
    for (const v of ys) { pen.beginPath(); pen.moveTo(left, Y(v)); pen.lineTo(right, Y(v)); pen.stroke(); pen.fillText(y.words ? y.words(v) : number(v, dy), left - 5, Y(v) + 4); }
    pen.textAlign = "center"; pen.fillText(x.label, (left + right) / 2, h - 6);
    pen.save(); pen.translate(12, (top + bottom) / 2); pen.rotate(-Math.PI / 2); pen.fillText(y.label, 0, 0); pen.restore();
    pen.textAlign = "left";
    return { X, Y, left, right, top, bottom };
  }

  // scales of a plan, zoomed and moved, that show [west, east, south, north] in an area [left, top, right, bottom]
  function plan(area, [west, east, south, north], zoom = 1, moved = [0, 0]) {
    const [left, top, right, bottom] = area, scale = zoom * Math.min((right - left) / (east - west), (bottom - top) / (north - south));
    const mx = (west + east) / 2 + moved[0], my = (south + north) / 2 + moved[1], ox = (left + right) / 2, oy = (top + bottom) / 2;
    return { area, scale, x: e => ox + (e - mx) * scale, y: n => oy - (n - my) * scale, east: x => mx + (x - ox) / scale, north: y => my - (y - oy) / scale };
  }
  function planAxes(pen, { area: [left, top, right, bottom], x, y, east, north }, w, h) {
    pen.fillStyle = css("--ink"); pen.font = FONT; pen.textAlign = "center";
    for (const e of ticks(east(left), east(right), Math.floor(w / 110))) pen.fillText(number(e, 0), x(e), h - 18);
    pen.fillText("East [m]", w / 2, h - 3); pen.textAlign = "right";
    for (const n of ticks(north(bottom), north(top), 6)) pen.fillText(number(n, 0), 42, y(n) + 4);
    pen.textAlign = "center"; pen.save(); pen.translate(10, h / 2); pen.rotate(-Math.PI / 2); pen.fillText("North [m]", 0, 0); pen.restore(); pen.textAlign = "left";
  }
  function path(pen, points, project, close) {
    pen.beginPath(); points.forEach((p, i) => i ? pen.lineTo(project.x(p[0]), project.y(p[1])) : pen.moveTo(project.x(p[0]), project.y(p[1]))); if (close) pen.closePath();
  }
  function tower(pen, x, y, alpha = 1) {
    pen.beginPath(); pen.moveTo(x, y - 8); pen.lineTo(x - 7, y + 5); pen.lineTo(x + 7, y + 5); pen.closePath();
    pen.globalAlpha = alpha; pen.fillStyle = "#C1121F"; pen.strokeStyle = "#fff"; pen.lineWidth = 1.2; pen.fill(); pen.stroke(); pen.globalAlpha = 1;
  }
  // a colour scale with numbers below it
  function colourBar(pen, of, [low, high], [left, right], top) {
    for (let i = 0; i <= right - left; i++) { pen.fillStyle = `rgb(${of(i / (right - left))})`; pen.fillRect(left + i, top, 1.5, 14); }
    pen.strokeStyle = css("--soft"); pen.strokeRect(left, top, right - left, 14);
    const marks = ticks(low, high, Math.max(2, Math.floor((right - left) / 70))), d = digits(marks);
    pen.fillStyle = css("--ink"); pen.textAlign = "center";
    for (const v of marks) { const x = left + (v - low) / (high - low) * (right - left); pen.fillText(number(v, d), x, top + 28); pen.fillRect(x, top + 14, 1, 3); }
  }

  // colour maps of matplotlib as consecutive colours of six digits
  const RAMPS = {
    viridis: "44015445045746075a460a5d470d6047106347136548166848186a481b6d481d6f482071482374482576482878472a7a472d7b472f7d46327e463480453781443983443b84433e854240864142874045883f47883e49893e4c8a3d4e8a3c508b3b528b3a548c39568c38598c375b8d365d8d355f8d34618d33638d32658e31678e30698e2f6b8e2e6d8e2e6f8e2d718e2c728e2b748e2a768e2a788e297a8e287c8e277e8e27808e26828e25838e25858e24878e23898e228b8d228d8d218f8d20928c20938c1f958b1f978b1f998a1e9b8a1e9d891f9f881fa1881fa28720a48621a68522a88424aa8325ac8227ad8129af7f2cb17e2eb37c31b57b34b67937b8783aba763dbc7440bd7244bf7048c16e4cc26c50c46a54c56858c7655cc86360ca6065cb5e69cd5b6ece5873d05677d1537cd25081d34d86d5498bd64690d74395d8409bd93ca0da39a5db36aadc32b0dd2fb5de2bbade28c0df25c5e021cae11fd0e11cd5e21adae319dfe318e5e419eae51aefe51cf4e61ef8e621fde725",
    plasma: "0d088713078919068c1d068e2206902605912a05932e059531059735049838049a3c049b3f049c43039e46039f4903a04c02a15002a25302a35601a45901a55c01a66001a66300a76600a76900a86c00a86f00a87201a87501a87801a87b02a87e03a88104a78405a78707a68a09a58d0ba58f0da4920fa39511a19814a09a169f9d189da01a9ca21d9aa51f99a72197aa2395ac2694ae2892b12a90b32c8eb52f8cb7318aba3388bc3587be3885c03a83c23c81c43e7fc6417dc8437bca457acc4977ce4b75d04d73d24f71d45270d5546ed7566cd9586ada5b69dc5d67de5f65df6263e16462e26660e4695ee56b5de76e5be87059e97257eb7556ec7754ed7a52ef7c51f07f4ff1814df2844bf3874af48948f58c46f68f44f79143f89441f9973ff99a3efa9c3cfb9f3afba238fca537fca835fdab33fdae32fdb130fdb42ffeb72dfeba2cfebd2afec029fdc328fdc627fdca26fccd25fcd025fbd324fbd724fada24f9dd25f8e125f7e425f6e826f5eb27f3ee27f2f227f1f525f0f921",
    RdBu_r: "05306107346709386d0c3d730e417910457e124984144e8a1752901956961b5a9c1d5fa21f63a82267ac246aae276eb02a71b22c75b42f79b5327cb73480b93783bb3a87bd3c8abe3f8ec04291c24695c44c99c6529dc859a1ca5fa5cd65a9cf6bacd171b0d378b4d57eb8d784bcd98ac0db90c4dd96c7df9bc9e0a0cce2a5cee3a9d1e5aed3e6b3d6e8b8d8e9bddbeac2ddecc7e0edcce2efd1e5f0d4e6f1d7e8f1dae9f2ddebf2e0ecf3e3edf3e6eff4e9f0f4ecf2f5eff3f5f2f5f6f5f6f7f7f5f4f8f3f0f8f1edf9efe9f9ede5faeae1fae8defbe6dafbe4d6fce2d2fcdfcffdddcbfddbc7fcd7c2fcd3bcfbceb7facab1f9c6acf9c2a7f8bda1f7b99cf7b596f6b191f5ac8bf5a886f3a481f19e7def9979ec9374ea8e70e8896ce58368e37e64e17860de735cdc6e57da6853d7634fd55d4cd25849cf5246cc4c44c94741c6413ec43b3cc13639be3036bb2a34b82531b61f2eb3192cae172aa81529a213289c1127960f27900d268a0b258409247f08237906227304216d022067001f",
  };
  // on a dark page the first quarter of a colour map is not used, because it looks like the background
  const night = matchMedia("(prefers-color-scheme: dark)"), theme = document.documentElement.dataset;
  const lifted = t => (theme.theme ? theme.theme === "dark" : night.matches) ? 0.25 + 0.75 * t : t;
  function ramp(name) {
    const hex = RAMPS[name], n = hex.length / 6, parts = [];
    for (let i = 0; i < n; i++) parts.push([0, 2, 4].map(k => parseInt(hex.slice(i * 6 + k, i * 6 + k + 2), 16)));
    const begun = name === "RdBu_r" ? t => t : lifted;
    return t => parts[Math.max(0, Math.min(n - 1, Math.floor(begun(t) * n)))];
  }

  function quantile(sorted, share) {
    if (!sorted.length) return NaN;
    const place = (sorted.length - 1) * share, low = Math.floor(place), high = Math.ceil(place);
    return sorted[low] + (sorted[high] - sorted[low]) * (place - low);
  }

  // a colour of viridis, or of a scale from blue to red around the middle
  function shade(v, low, high, diverging) {
    const x = Math.min(1, Math.max(0, (v - low) / (high - low)));
    if (diverging) {
      const d = 2 * x - 1, k = Math.abs(d), to = d < 0 ? [33, 102, 172] : [178, 24, 43], mid = [208, 208, 198];
      return `rgb(${to.map((t, i) => Math.round(mid[i] + (t - mid[i]) * Math.sqrt(k))).join(",")})`;
    }
    const stops = [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]], y = lifted(x), i = Math.min(3, Math.floor(y * 4)), f = y * 4 - i;
    return `rgb(${stops[i].map((a, j) => Math.round(a + (stops[i + 1][j] - a) * f)).join(",")})`;
  }

  function polygon(pen, points, fill, stroke) {
    pen.beginPath(); points.forEach((p, i) => i ? pen.lineTo(p[0], p[1]) : pen.moveTo(p[0], p[1])); pen.closePath();
    if (fill) { pen.fillStyle = fill; pen.fill(); }
    if (stroke) { pen.strokeStyle = stroke; pen.lineWidth = 0.6; pen.stroke(); }
  }
  function polyline(pen, points, colour, width, dash) {
    pen.beginPath(); points.forEach((p, i) => i ? pen.lineTo(p[0], p[1]) : pen.moveTo(p[0], p[1]));
    pen.strokeStyle = colour; pen.lineWidth = width; pen.setLineDash(dash || []); pen.stroke(); pen.setLineDash([]);
  }

  let waiting = new Set();
  function later(...jobs) {
    if (!waiting.size) requestAnimationFrame(() => { const now = [...waiting]; waiting = new Set(); for (const job of now) job(); });
    jobs.forEach(job => waiting.add(job));
  }

  // commands of a path as SVG; an arc is written as two, because SVG has no arc that ends at its start
  const SPELLED = {
    closePath: () => ["Z"], moveTo: (x, y) => ["M", x, y], lineTo: (x, y) => ["L", x, y], rect: (x, y, w, h) => ["M", x, y, "h", w, "v", h, "h", -w, "Z"],
    arc: (x, y, r, from, to) => SPELLED.ellipse(x, y, r, r, 0, from, to),
    ellipse: (x, y, wide, high, _, from, to) => [0, 0.5, 1].flatMap(part => { // no ellipse of these pages is rotated
      const angle = from + part * Math.min(to - from, 2 * Math.PI);
      return [...(part ? ["A", wide, high, 0, 0, 1] : ["L"]), x + wide * Math.cos(angle), y + high * Math.sin(angle)];
    }),
  };
  const spell = (name, values) => SPELLED[name](...values).map(v => Number.isFinite(v) ? +v.toFixed(2) : v).join(" ") + " ";
  // a path that uPlot makes without a canvas
  class SpelledPath extends Path2D { constructor(...other) { super(...other); this.spelled = other.length ? other[0].spelled : ""; } }
  const drawn = Path2D.prototype;
  for (const name in SPELLED) SpelledPath.prototype[name] = function (...values) { this.spelled += spell(name, values); drawn[name].apply(this, values); };

  // records the drawing of a canvas as SVG, while ``draw`` repeats it
  function drawnAsSvg(canvas, draw) {
    const pen = canvas.getContext("2d"), out = [], clips = [0], text = v => String(v).replace(/[&<"]/g, c => `&#${c.charCodeAt(0)};`);
    let path = "", clip = 0;
    const d = other => `d="${(other?.spelled ?? path).replace(/^L/, "M")}"`; // in a canvas the first line of a path needs no starting point
    const paint = (use, style) => { // many programs cannot read rgba() in an SVG
      if (typeof style !== "string") return `${use}="none"`; // a pattern, which is drawn over a colour
      const [, rgb, alpha] = style.match(/^rgba\((.*), ([\d.]+)\)$/) || [];
      return rgb ? `${use}="rgb(${rgb})" ${use}-opacity="${alpha}"` : `${use}="${style}"`;
    };
    const matrix = () => { const m = pen.getTransform(); return `transform="matrix(${[m.a, m.b, m.c, m.d, m.e, m.f]})"`; };
    const mark = (tag, rest, filled) => {
      const line = () => `fill="none" ${paint("stroke", pen.strokeStyle)} stroke-width="${pen.lineWidth}" stroke-linejoin="${pen.lineJoin}" stroke-dasharray="${pen.getLineDash()}"`;
      out.push(`<${tag} ${matrix()} opacity="${pen.globalAlpha}" ${filled ? paint("fill", pen.fillStyle) : line()} ${rest}`);
    };
    const box = filled => (x, y, w, h) => mark("rect", `x="${x}" y="${y}" width="${w}" height="${h}"/>`, filled);
    const words = filled => (t, x, y) => {
      const above = () => pen.measureText(t).actualBoundingBoxAscent, own = pen.textBaseline, to = above();
      pen.textBaseline = "alphabetic"; // the only baseline that all programs draw equally
      const base = y + above() - to;
      pen.textBaseline = own;
      mark("text", `x="${x}" y="${base}" style="font: ${text(pen.font)}" text-anchor="${{ center: "middle", right: "end" }[pen.textAlign] || "start"}">${text(t)}</text>`, filled);
    };
    const taken = {
      beginPath: () => { path = ""; }, stroke: other => mark("path", `${d(other)}/>`), fill: other => mark("path", `${d(other)}/>`, true),
      fillRect: box(true), strokeRect: box(false), fillText: words(true), strokeText: words(false),
      drawImage: (image, x, y, w, h) => out.push(`<image ${matrix()} opacity="${pen.globalAlpha}" href="${image.toDataURL()}" x="${x}" y="${y}" width="${w}" height="${h}" preserveAspectRatio="none" style="image-rendering: pixelated"/>`),
      save: () => clips.push(0), restore: () => out.push("</g>".repeat(clips.pop())),
      clip: other => { clips.push(clips.pop() + 1); out.push(`<clipPath id="clip${++clip}"><path ${matrix()} ${d(other)}/></clipPath><g clip-path="url(#clip${clip})">`); },
    };
    for (const name in SPELLED) taken[name] = (...values) => { path += spell(name, values); };
    for (const name in taken) pen[name] = (...values) => { taken[name](...values); CanvasRenderingContext2D.prototype[name].apply(pen, values); };
    window.Path2D = SpelledPath;
    try { draw(); } finally { window.Path2D = drawn.constructor; for (const name in taken) delete pen[name]; }
    const left = "</g>".repeat(clips.reduce((sum, count) => sum + count));
    return `<svg xmlns="http://www.w3.org/2000/svg" width="${canvas.clientWidth}" viewBox="0 0 ${canvas.width} ${canvas.height}">${out.join("")}${left}</svg>`;
  }

  // a menu that saves a chart: as SVG, for which ``draw`` draws it again, as a picture, or as rows of numbers
  function downloads(canvas, name, rows, draw) {
    const save = (kind, blob) => { const a = document.createElement("a"); a.href = URL.createObjectURL(blob); a.download = `${name}.${kind}`; a.click(); URL.revokeObjectURL(a.href); };
    // same rule as in aerpaw_cmp.common.text, so that a spreadsheet does not execute a name as a formula
    const guarded = v => typeof v === "string" ? v.replace(/(^|;)(?=[=+\-@\t\r'])/g, "$1'") : v;
    const quoted = v => /[",\n]/.test(v) ? `"${String(v).replaceAll('"', '""')}"` : v;
    const cell = v => v === null || Number.isNaN(v) ? "" : quoted(guarded(v));
    const kinds = { svg: () => save("svg", new Blob([drawnAsSvg(canvas, draw)])), png: () => canvas.toBlob(blob => save("png", blob)), csv: () => save("csv", new Blob([rows().map(row => row.map(cell).join(",")).join("\n") + "\n"])) };
    const menu = Object.assign(document.createElement("select"), { title: `Save: ${name}` });
    menu.setAttribute("aria-label", menu.title);
    menu.append(new Option("Save as", ""), ...Object.keys(kinds).map(kind => new Option(kind.toUpperCase(), kind)));
    menu.addEventListener("change", () => { kinds[menu.value]?.(); menu.value = ""; });
    return menu;
  }

  // the same menu in a line below the chart, or below its colour scale
  function saves(canvas, name, rows, draw, above = canvas) {
    let place = above.nextElementSibling;
    if (!place?.classList.contains("saves")) above.after(place = Object.assign(document.createElement("p"), { className: "key saves" }));
    place.replaceChildren(downloads(canvas, name, rows, draw));
  }

  function whenResized(element, job) {
    let width = 0;
    new ResizeObserver(() => { if (element.clientWidth !== width) { width = element.clientWidth; later(job); } }).observe(element);
    night.addEventListener("change", () => later(job));
  }

  // Charts of the sections, from marks over two axes; ``get`` returns the array with a number. Marks differ in shape or
  // dashes, too, so that they can be distinguished without colours.
  const SHAPES = "■●▲◆✚▼", DASHES = [[], [7, 4], [2, 3], [9, 3, 2, 3]];
  function plots(specs, get) {
    const HUES = ["--measured", "--second", "--baseline", "--accent", "--ink", "--soft"];
    function dot(p, x, y, size, shape) {
      const at = (angles, r = size) => { p.beginPath(); for (const angle of angles) p.lineTo(x + r * Math.sin(angle * Math.PI), y - r * Math.cos(angle * Math.PI)); p.closePath(); p.fill(); };
      if (size < 2 || shape === "■") p.fillRect(x - size, y - size, 2 * size, 2 * size);
      else if (shape === "●") { p.beginPath(); p.arc(x, y, 1.1 * size, 0, 2 * Math.PI); p.fill(); }
      else if (shape === "✚") { p.fillRect(x - 1.3 * size, y - size / 2, 2.6 * size, size); p.fillRect(x - size / 2, y - 1.3 * size, size, 2.6 * size); }
      else at({ "▲": [0, 2 / 3, 4 / 3], "▼": [1, 1 / 3, 5 / 3], "◆": [0, 0.5, 1, 1.5] }[shape], 1.4 * size);
    }
    function drawPlot(place) {
      const spec = specs[place.dataset.plot], n = spec.rows ? spec.rows.length : 0;
      if (!place.clientWidth) return;
      if (n) place.style.height = `${30 * n + 50}px`;
      const marks = spec.marks.map((m, i) => ({ ...m, hue: m.colour || css(HUES[i % HUES.length]), shape: SHAPES[i % SHAPES.length], dash: DASHES[i % DASHES.length], x: get(m.x), y: get(m.y), low: get(m.low), high: get(m.high) }));
      const reach = lists => { let low = Infinity, high = -Infinity; for (const list of lists) for (const v of list || []) if (Number.isFinite(v)) { low = Math.min(low, v); high = Math.max(high, v); } return low < high ? [low, high] : [low - 1, low + 1]; };
      const [west, east] = spec.x.ends || reach(marks.flatMap(m => n ? [m.x, m.low, m.high] : [m.x])), [south, north] = n ? [n - 0.4, -0.9] : spec.y.ends || reach(marks.flatMap(m => [m.y, m.low, m.high]));
      const [p, w, h] = frame(place), x = { low: west - (n ? 0.02 * (east - west) : 0), high: east, label: spec.x.label }, y = { low: south, high: north, label: n ? "" : spec.y.label };
      if (spec.x.start) { const begun = Date.parse(spec.x.start + "Z") / 1000; x.marks = clockTicks(west, east, w / 110, begun); x.words = v => clockText(v + begun); }
      if (spec.x.names) { const step = Math.max(1, Math.ceil(spec.x.names.length * 150 / w)); x.marks = spec.x.names.flatMap((_, i) => i % step ? [] : [i]); x.words = v => spec.x.names[v]; }
      if (n) y.marks = [];
      const g = axes(p, w, h, x, y, n ? 14 : 50);
      if (n) spec.rows.forEach((name, i) => { p.fillStyle = css(i === spec.chosen ? "--accent" : "--soft"); p.fillText(name + (i === spec.chosen ? " (recommended)" : ""), g.left + 4, g.Y(i - 0.35)); });
      for (const m of marks) {
        p.fillStyle = p.strokeStyle = m.hue; p.lineWidth = 1.4; p.globalAlpha = m.kind === "band" ? (m.colour ? 0.9 : 0.25) : 1; p.beginPath();
        if (m.kind === "band") { for (let i = 0; i < m.x.length; i++) p.lineTo(g.X(m.x[i]), g.Y(m.high[i])); for (let i = m.x.length - 1; i >= 0; i--) p.lineTo(g.X(m.x[i]), g.Y(m.low[i])); p.fill(); }
        else if (m.kind === "line") { p.setLineDash(m.dash); for (let i = 0; i < m.x.length; i++) p.lineTo(g.X(m.x[i]), g.Y(m.y[i])); p.stroke(); p.setLineDash([]); }
        else for (let i = 0; i < m.x.length; i++) {
          const [a, b] = [g.X(m.x[i]), g.Y(m.y[i])];
          dot(p, a, b, m.x.length > 200 ? 1.2 : 3.2, m.shape);
          if (m.low && Number.isFinite(m.low[i])) { p.beginPath(); p.moveTo(g.X(m.low[i]), b); p.lineTo(g.X(m.high[i]), b); p.stroke(); }
        }
        p.globalAlpha = 1;
      }
      const symbol = m => m.kind === "band" ? "▒ " : m.kind === "line" ? (m.dash.length ? "╌ " : "— ") : m.shape + " ";
      place.parentElement.querySelector(".key").replaceChildren(...marks.map(m => { const s = document.createElement("span"), i = document.createElement("i"); i.textContent = symbol(m); i.style.color = m.hue; s.append(i, m.name); return s; }), downloads(place, place.getAttribute("aria-label"), () => [["series", spec.x.label, n ? "row" : spec.y.label, "low", "high"],
        ...marks.flatMap(m => Array.from(m.x, (x, i) => [m.name, x, n ? spec.rows[Math.round(m.y[i])] : m.y ? m.y[i] : null, ...[m.low, m.high].map(list => list ? list[i] : null)]))], () => drawPlot(place)));
    }
    for (const place of document.querySelectorAll("canvas[data-plot]")) whenResized(place, () => drawPlot(place));
  }

  return { at, css, number, count, unpack, values, cells, fill, frame, names, ticks, axes, ramp, quantile, shade, polygon, polyline, later, downloads, saves, whenResized, digits, clockTicks, clockText, plan, planAxes, path, tower, colourBar, plots };
})();
