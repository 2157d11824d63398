// A 3-D view by the painter's algorithm: polygons, lines and labels, sorted by depth, are drawn from far to near.
const scene = JSON.parse(document.getElementById("scene").textContent);
const canvas = document.getElementById("view"), pen = canvas.getContext("2d");
const L = scene.limits, centre = L.map(([a, b]) => (a + b) / 2);
centre[2] = L[2][0];
const size = Math.max(L[0][1] - L[0][0], L[1][1] - L[1][0]);
const eye = { turn: -0.45, tilt: 0.55, zoom: 1, east: 0, north: 0, stretch: 2, right: 0, up: 0, fit: 1 };
const box = id => document.getElementById(id);
const on = id => !box(id) || box(id).checked;
let shape = null;

// A view is fitted when it is chosen. Turning and zooming do not move its centre.
function prepare() {
  const ct = Math.cos(eye.turn), st = Math.sin(eye.turn), ce = Math.cos(eye.tilt), se = Math.sin(eye.tilt);
  const w = canvas.clientWidth, h = canvas.clientHeight, far = 2.6 * size, scale = eye.zoom * eye.fit;
  shape = p => {
    const e = p[0] - centre[0] - eye.east, n = p[1] - centre[1] - eye.north, u = (p[2] - centre[2]) * eye.stretch;
    const right = e * ct + n * st, deep = -e * st + n * ct;
    const up = u * ce + deep * se, away = deep * ce - u * se;
    const near = Math.max(1 + away / far, 0.05);
    return [w / 2 + (right / near - eye.right) * scale, h / 2 - (up / near - eye.up) * scale, away, near];
  };
  shape.scale = scale;
}

function view(turn, tilt) {
  Object.assign(eye, { turn, tilt, zoom: 1, east: 0, north: 0, right: 0, up: 0, fit: 1 });
  prepare();
  const w = canvas.clientWidth, h = canvas.clientHeight, seen = [];
  for (const e of L[0]) for (const n of L[1]) for (const u of L[2]) seen.push(shape([e, n, u]));
  const [left, right] = [Math.min(...seen.map(p => p[0])), Math.max(...seen.map(p => p[0]))];
  const [top, bottom] = [Math.min(...seen.map(p => p[1])), Math.max(...seen.map(p => p[1]))];
  eye.right = (left + right) / 2 - w / 2;
  eye.up = h / 2 - (top + bottom) / 2;
  eye.fit = Math.min((w - 80) / (right - left), (h - 50) / (bottom - top));
  redraw();
}

const polygon = (...given) => common.polygon(pen, ...given), polyline = (...given) => common.polyline(pen, ...given);

function label(text, p, colour) {
  pen.font = "bold 13px system-ui, sans-serif"; pen.lineWidth = 3; pen.strokeStyle = common.css("--paper");
  pen.strokeText(text, p[0] + 6, p[1] - 4); pen.fillStyle = colour; pen.fillText(text, p[0] + 6, p[1] - 4);
}

function ground() {
  const step = Math.pow(10, Math.floor(Math.log10(size / 2)));
  const pace = size / step > 12 ? 2 * step : size / step < 5 ? step / 2 : step;
  for (const axis of [0, 1]) {
    for (let v = Math.ceil(L[axis][0] / pace) * pace; v <= L[axis][1]; v += pace) {
      const a = axis ? [L[0][0], v, 0] : [v, L[1][0], 0], b = axis ? [L[0][1], v, 0] : [v, L[1][1], 0];
      polyline([shape(a), shape(b)], common.css("--line"), 1);
      const p = shape(a);
      pen.font = "11px system-ui, sans-serif"; pen.fillStyle = common.css("--soft");
      pen.fillText(v + " m " + (axis ? "N" : "E"), p[0] - 14, p[1] + 13);
    }
  }
  scene.forests.forEach(ring => polygon(ring.map(p => shape([p[0], p[1], 0])), common.css("--forest"), "#7FA873"));
  scene.fences.forEach(ring => polyline(ring.map(p => shape([p[0], p[1], 0])), common.css("--ink"), 1.2, [6, 4]));
}

function solids() {
  const parts = [];
  if (on("buildings")) for (const b of scene.buildings) for (const face of b.faces) {
    const seen = face.map(shape), flat = face.every(p => p[2] === face[0][2]);
    const dx = face[1][0] - face[0][0], dy = face[1][1] - face[0][1];
    const light = flat ? 222 : 130 + 60 * Math.abs(dx) / (Math.hypot(dx, dy) || 1);
    parts.push([Math.max(...seen.map(p => p[2])) - (flat ? 0.5 : 0), () => polygon(seen, `rgb(${light},${light},${light - 6})`, "#333")]);
  }
  if (on("trees")) for (const [e, n, g, height, wide, base] of scene.trees) {
    const foot = shape([e, n, g]), crown = shape([e, n, g + base]), top = shape([e, n, g + height]);
    const half = wide / 2 * shape.scale / crown[3], flat = half * Math.sin(eye.tilt) * 0.9;
    parts.push([foot[2], () => {
      polyline([foot, crown], "#6B4A2B", 1);
      pen.beginPath(); pen.moveTo(top[0], top[1]); pen.lineTo(crown[0] - half, crown[1]);
      pen.lineTo(crown[0] + half, crown[1]); pen.closePath();
      pen.moveTo(crown[0] + half, crown[1]); pen.ellipse(crown[0], crown[1], Math.max(half, .1), Math.max(flat, .1), 0, 0, 7);
      pen.fillStyle = "rgba(84,130,70,.85)"; pen.fill(); pen.strokeStyle = "#3F6136"; pen.lineWidth = 0.4; pen.stroke();
    }]);
  }
  for (const t of scene.towers) {
    const foot = shape(t.at), top = shape([t.at[0], t.at[1], t.top]);
    parts.push([foot[2], () => { polyline([foot, top], "#C1121F", 4); pen.beginPath(); pen.arc(top[0], top[1], 5, 0, 7); pen.fillStyle = "#C1121F"; pen.fill(); }]);
  }
  parts.sort((a, b) => b[0] - a[0]).forEach(part => part[1]());
}

function draw() {
  const ratio = window.devicePixelRatio || 1, w = canvas.clientWidth, h = canvas.clientHeight;
  if (canvas.width !== Math.round(w * ratio) || canvas.height !== Math.round(h * ratio)) {
    canvas.width = Math.round(w * ratio); canvas.height = Math.round(h * ratio);
  }
  pen.setTransform(ratio, 0, 0, ratio, 0, 0); pen.lineJoin = "round";
  pen.fillStyle = common.css("--paper"); pen.fillRect(0, 0, w, h);
  prepare(); ground(); solids();
  scene.towers.forEach(t => label(t.name, shape([t.at[0], t.at[1], t.top]), common.css("--accent")));
  const n = [0, 1].map(i => centre[i] + (i ? eye.north : eye.east)), a = shape([n[0], n[1], 0]), b = shape([n[0], n[1] + size * 0.05, 0]);
  const k = 26 / (Math.hypot(b[0] - a[0], b[1] - a[1]) || 1), x = 40, y = h - 40;
  polyline([[x, y], [x + (b[0] - a[0]) * k, y + (b[1] - a[1]) * k]], common.css("--ink"), 2);
  label("N", [x + (b[0] - a[0]) * k - 6, y + (b[1] - a[1]) * k], common.css("--ink"));
}

const redraw = () => common.later(draw);
function turn(dx, dy) { eye.turn += dx; eye.tilt = Math.min(1.57, Math.max(0.03, eye.tilt + dy)); redraw(); }
function zoom(by) { eye.zoom = Math.min(30, Math.max(0.4, eye.zoom * by)); redraw(); }
function move(dx, dy) {
  const s = 1 / shape.scale, ct = Math.cos(eye.turn), st = Math.sin(eye.turn), deep = dy * s / Math.max(Math.sin(eye.tilt), 0.2);
  eye.east += -dx * s * ct - deep * st; eye.north += -dx * s * st + deep * ct; redraw();
}
const fingers = new Map();
canvas.addEventListener("pointerdown", e => { canvas.setPointerCapture(e.pointerId); fingers.set(e.pointerId, [e.clientX, e.clientY]); });
for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, e => fingers.delete(e.pointerId));
canvas.addEventListener("pointermove", e => {
  const was = fingers.get(e.pointerId);
  if (!was) return;
  const dx = e.clientX - was[0], dy = e.clientY - was[1];
  if (fingers.size === 2) {
    const other = [...fingers].find(([id]) => id !== e.pointerId)[1];
    zoom(Math.hypot(e.clientX - other[0], e.clientY - other[1]) / (Math.hypot(was[0] - other[0], was[1] - other[1]) || 1));
  } else if (e.shiftKey || e.buttons === 2) move(dx, dy);
  else turn(-dx * 0.006, dy * 0.006);
  fingers.set(e.pointerId, [e.clientX, e.clientY]);
});
canvas.addEventListener("contextmenu", e => e.preventDefault());
canvas.addEventListener("wheel", e => { e.preventDefault(); zoom(Math.exp(-e.deltaY * 0.0015)); }, { passive: false });
canvas.addEventListener("keydown", e => {
  const step = { ArrowLeft: [0.08, 0], ArrowRight: [-0.08, 0], ArrowUp: [0, 0.06], ArrowDown: [0, -0.06] }[e.key];
  if (step) { e.preventDefault(); turn(...step); }
  if (e.key === "+" || e.key === "=") zoom(1.15);
  if (e.key === "-") zoom(1 / 1.15);
});
document.querySelectorAll("input[type=checkbox]").forEach(b => b.addEventListener("change", redraw));
box("stretch").addEventListener("input", e => { eye.stretch = +e.target.value; box("stretched").value = e.target.value; redraw(); });
box("above").addEventListener("click", () => view(0, 1.57));
box("side").addEventListener("click", () => view(0, 0.12));
new ResizeObserver(redraw).observe(canvas);
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
// corners of all objects, those that are not drawn too
function corners() {
  const of = (kind, name, points) => points.map(p => [kind, name, p[0], p[1], p[2] ?? 0]), all = (kind, rings) => rings.flatMap((ring, i) => of(kind, i + 1, ring));
  return [["kind", "name", "east_m", "north_m", "up_m"], ...scene.towers.flatMap(t => of("tower", t.name, [t.at, [t.at[0], t.at[1], t.top]])),
    ...scene.buildings.flatMap(b => of("building", b.name, b.faces.flat())), ...scene.trees.flatMap(([e, n, g, high], i) => of("tree", i + 1, [[e, n, g], [e, n, g + high]])),
    ...all("forest", scene.forests), ...all("geofence", scene.fences)];
}
box("saves").append(common.downloads(canvas, document.title, corners, draw));
view(-0.45, 0.55);
