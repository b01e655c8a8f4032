// The panel's page: asks the server ten times a second, draws what came. See rig/panel/README.md.
"use strict";

const ASK_MS = 100;
const DRAW_MS = 150;
const OLD_S = 1.0;
const HOLE_S = 1.0;
const TRACES = [
  ["force_mN", "force", "mN", "--a"],
  ["displacement_mm", "displacement", "mm", "--b"],
  ["voltage_V", "voltage", "V", "--e"],
  ["current_uA", "current", "µA", "--c"],
];
const COLOURS = ["--a", "--b", "--d", "--c", "--e", "--f"];
const LIMITS = {
  force_mN: ["Force", "mN"], displacement_mm: ["Displacement", "mm"], voltage_V: ["Voltage", "V"],
  current_uA: ["Current", "µA"], field_V_per_um: ["Field (model)", "V/µm"], hoop_stress_kPa: ["Least hoop stress (model)", "kPa"],
};
const byId = (id) => document.getElementById(id);

let log = null;
let curves = {};
let loop = { generation: -1, points: [] };
let outlook = null;
let heard = 0; // when the server last answered
let last = null;
let changed = true; // since the pictures were drawn
let drawn = ""; // the window's size then

function forget() {
  curves = {};
  loop = { generation: -1, points: [] };
  outlook = null;
  last = null;
}

async function post(path, body) {
  const answer = await fetch(path, { method: "POST", body: JSON.stringify(body) });
  const content = (answer.headers.get("Content-Type") || "").includes("json") ? await answer.json() : { error: await answer.text() };
  if (!answer.ok && !content.error) content.error = "The panel's server refused.";
  return content;
}

// What the operator does ------------------------------------------------------------------------------------

async function say(text) {
  byId("said").textContent = `${text} ...`;
  try {
    const answer = await post("/say", { log, text });
    byId("said").textContent = answer.error || answer.said;
  } catch {
    byId("said").textContent = "The panel's server does not answer. Use the emergency stop.";
  }
}

byId("stop").addEventListener("click", () => say("stop"));
byId("pause").addEventListener("click", () => say("pause"));
byId("continue").addEventListener("click", () => say("continue"));
byId("answer").addEventListener("submit", (event) => {
  event.preventDefault();
  say(byId("answer-text").value || "yes");
  byId("answer-text").value = "";
});
document.addEventListener("keydown", (event) => {
  if (event.key === "Escape") { event.preventDefault(); say("stop"); }
});
byId("runs").addEventListener("change", () => { log = byId("runs").value; forget(); });

// Asking ----------------------------------------------------------------------------------------------------

async function findRuns() {
  try {
    const runs = await (await fetch("/runs")).json();
    const list = byId("runs");
    const names = runs.map((run) => run.log).join("\n");
    if (list.dataset.names !== names) {
      list.dataset.names = names;
      list.replaceChildren(...runs.map((run) => new Option(run.name, run.log, false, run.log === log)));
    }
    list.hidden = runs.length < 2;
    if (log === null && runs.length) log = runs[0].log;
  } catch { /* told by the age of the data */ }
  setTimeout(findRuns, 2000);
}

async function ask() {
  if (log !== null) {
    const seen = { loop: [loop.generation, loop.points.length] };
    for (const [name] of TRACES) if (curves[name]) seen[name] = [curves[name].generation, Math.max(curves[name].least.length - 1, 0)];
    if (outlook) seen.outlook = true;
    const asked = log;
    try {
      const news = await post("/data", { log, seen });
      if (asked === log && !news.error) { take(news); heard = performance.now(); }
      if (news.error && news.state) heard = performance.now();
    } catch { /* told by the age of the data */ }
  }
  setTimeout(ask, document.hidden ? 1000 : ASK_MS);
}

function take(news) {
  for (const [name, part] of Object.entries(news.traces)) {
    const known = curves[name];
    if (!known || known.generation !== part.generation || part.first === 0) {
      curves[name] = { generation: part.generation, width: part.width, least: part.least, largest: part.largest };
    } else {
      known.least.splice(part.first, Infinity, ...part.least);
      known.largest.splice(part.first, Infinity, ...part.largest);
    }
  }
  if (news.loop.generation !== loop.generation || news.loop.first === 0) loop = { generation: news.loop.generation, points: news.loop.points };
  else loop.points.splice(news.loop.first, Infinity, ...news.loop.points);
  if (news.outlook && !news.outlook.error) outlook = news.outlook;
  const moved = !last || last.t_s !== news.t_s || Boolean(news.outlook);
  changed = changed || moved;
  last = news;
  show(news);
}

// Words and numbers -----------------------------------------------------------------------------------------

const CLASSES = { "SAFE": "safe", "ARMED": "armed", "LIVE": "live", "NOT SAFE": "not_safe", "UNKNOWN": "unknown", "NO HIGH VOLTAGE": "no_hv" };
const NOTES = {
  "SAFE": "output measured off", "ARMED": "the supply is on, output below 60 V", "LIVE": "HIGH VOLTAGE on the film",
  "NOT SAFE": "the output could not be proved off: use the emergency stop, keep away",
  "UNKNOWN": "the voltage is not known: treat it as live", "NO HIGH VOLTAGE": "this scene has no supply",
};

function digits(value, n = 4) {
  if (value === null || value === undefined) return "-";
  const size = Math.abs(value);
  return size !== 0 && size < 1e-2 ? value.toFixed(3) : Number(value.toPrecision(n)).toString();
}

function time(seconds) {
  if (seconds === null || seconds === undefined) return "-";
  const s = Math.round(seconds), h = Math.floor(s / 3600), m = Math.floor(s / 60) % 60;
  return h ? `${h} h ${m} min` : m ? `${m} min ${s % 60} s` : `${s} s`;
}

function showState(word, note) {
  const band = byId("state");
  if (band.className !== CLASSES[word]) band.className = CLASSES[word];
  if (byId("state-word").textContent !== word) byId("state-word").textContent = word;
  byId("state-note").textContent = note;
  document.title = `${word} - dea-rig`;
}

function show(news) {
  const outcome = news.outcome;
  let note = NOTES[news.state];
  if (outcome) note = `${outcome.status}: ${outcome.reason}; ${note}`;
  else if (news.control.state && news.control.state !== "running") note = `run ${news.control.state}; ${note}`;
  else if (!news.lives && !news.ended) note = `the run does not answer; ${note}`;
  showState(news.state, note);
  byId("bench").textContent = news.simulated ? "SIMULATED" : "REAL PORTS";
  byId("bench").className = news.simulated ? "" : "real";
  byId("title").textContent = [news.run.specimen, news.run.protocol].filter(Boolean).join(": ");
  const old = byId("old");
  old.hidden = news.age_s <= OLD_S;
  old.textContent = `These data are ${time(news.age_s)} old.`;
  const question = news.control.question || "";
  byId("question").hidden = !question;
  const typed = news.control.expected && news.control.expected !== "clear" ? "" : news.control.expected;
  byId("question-text").textContent = question + (news.control.expected ? "\nThis is confirmed by typing in the terminal that started the run." : "");
  byId("answer").hidden = Boolean(news.control.expected) || typed === undefined;
  const latest = news.latest, phase = news.phase, near = nearest(news.near);
  const field = news.near.find((entry) => entry.name === "field_V_per_um");
  fill("numbers", [
    ["Force", digits(latest.force_mN), "mN"], ["Displacement", digits(latest.displacement_mm), "mm"],
    ["Voltage", latest.voltage_V === undefined ? null : digits(latest.voltage_V), "V"],
    ["Current", latest.current_uA === undefined || latest.current_uA === null ? null : digits(latest.current_uA, 3), "µA"],
    ["Second reading", latest.second_V === undefined ? null : digits(latest.second_V), "V"],
    ["Air", latest.measured_temperature_C === undefined ? null : digits(latest.measured_temperature_C, 3), "°C"],
    ["Humidity", latest.measured_humidity_percent === undefined ? null : digits(latest.measured_humidity_percent, 2), "%"],
    ["Field (model)", field ? digits(field.value, 3) : null, "V/µm"],
    ["Nearest limit", near ? `${Math.round(near.share * 100)} %` : null, near ? LIMITS[near.name][0] : ""],
    ["Step", phase ? `${phase.step} of ${steps()}` : null, phase ? phase.kind : ""],
    ["Cycle", latest.cycle === undefined ? null : String(latest.cycle), ""],
    ["Specimen", news.queue.of ? `${news.queue.done} of ${news.queue.of}` : null, "done"],
    ["Time left", news.ended ? "ended" : time(news.time_left_s), "by the plan"],
  ].filter((entry) => entry[1] !== null));
  showLimits(news.near);
  showSteps(news);
  showEvents(news.events);
  showQueue(news.queue);
}

function steps() { return outlook ? Math.max(...outlook.steps.map((step) => step.step)) : "?"; }

function nearest(entries) {
  return entries.filter((entry) => entry.share !== null).reduce((best, entry) => (!best || entry.share > best.share ? entry : best), null);
}

function fill(id, entries) {
  const box = byId(id);
  while (box.children.length > entries.length) box.lastChild.remove();
  entries.forEach(([name, value, unit], k) => {
    let cell = box.children[k];
    if (!cell) {
      cell = document.createElement("div");
      cell.append(document.createElement("span"), document.createElement("b"), document.createElement("span"));
      box.append(cell);
    }
    [name, value, unit].forEach((text, n) => { if (cell.children[n].textContent !== text) cell.children[n].textContent = text; });
  });
}

function showLimits(entries) {
  const box = byId("limits");
  box.replaceChildren(...entries.map((entry) => {
    const [name, unit] = LIMITS[entry.name];
    const row = document.createElement("div"), words = document.createElement("span");
    const bound = entry.share === null ? "not below" : "limit";
    words.textContent = `${name}: ${digits(entry.value, 3)} ${unit} (${bound} ${digits(entry.limit, 3)} ${unit})`;
    row.append(words);
    if (entry.share !== null) {
      const bar = document.createElement("div"), part = document.createElement("span");
      bar.className = "bar";
      part.style.width = `${Math.min(entry.share, 1) * 100}%`;
      part.className = entry.share > 1 ? "over" : entry.share > 0.8 ? "near" : "";
      bar.append(part);
      row.append(bar);
    }
    return row;
  }));
}

function showSteps(news) {
  if (!outlook) return;
  const box = byId("steps"), now = news.phases - 1;
  const key = `${now} ${news.ended}`;
  if (box.dataset.key === key) return;
  box.dataset.key = key;
  box.replaceChildren(...outlook.steps.map((step, k) => {
    const row = document.createElement("li");
    row.textContent = `${step.step} ${step.kind}: ${step.label} (${time(step.duration_s)})`;
    row.className = k < now || news.ended ? "done" : k === now ? "now" : "";
    return row;
  }));
  box.querySelector(".now")?.scrollIntoView({ block: "nearest" });
}

function showQueue(queue) {
  const box = byId("queue"), key = JSON.stringify(queue);
  byId("campaign").hidden = !queue.of;
  if (!queue.of || box.dataset.key === key) return;
  box.dataset.key = key;
  byId("campaign-words").textContent = `${queue.title}: ${queue.words}`;
  box.replaceChildren(...queue.rows.map((one) => {
    const row = document.createElement("li");
    row.textContent = [one.specimen, one.batch && `(${one.batch})`, one.is, one.note].filter(Boolean).join(" ");
    row.className = { done: "done", running: "now", failed: "error", interrupted: "warning" }[one.is] || "";
    return row;
  }));
  box.querySelector(".now")?.scrollIntoView({ block: "nearest" });
}

function showEvents(events) {
  const box = byId("events"), newest = events[events.length - 1];
  const key = newest ? `${events.length} ${newest.t_s} ${newest.message}` : "";
  if (box.dataset.key === key) return;
  box.dataset.key = key;
  box.replaceChildren(...events.slice().reverse().map((event) => {
    const row = document.createElement("li");
    row.className = event.severity;
    row.textContent = `${event.t_s.toFixed(1)} s ${event.source}: ${event.message}`;
    return row;
  }));
}

// Pictures --------------------------------------------------------------------------------------------------

function colour(name) { return getComputedStyle(document.documentElement).getPropertyValue(name).trim(); }

function begin(canvas) {
  const ratio = window.devicePixelRatio || 1, width = canvas.clientWidth, height = canvas.clientHeight;
  if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
  }
  const pen = canvas.getContext("2d");
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  pen.clearRect(0, 0, width, height);
  pen.font = "12px system-ui, sans-serif";
  pen.lineWidth = 1.5;
  return [pen, width, height];
}

function ticks(low, high, most) {
  const raw = (high - low) / most, power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map((m) => m * power).find((s) => s >= raw);
  const found = [];
  for (let k = Math.ceil(low / step); k * step <= high + step * 1e-9; k += 1) found.push(Number((k * step).toPrecision(12)));
  return found;
}

// Axes with units in a box; gives back the two functions from values to pixels.
function axes(pen, box, x, y, names) {
  const [left, top, width, height] = box;
  const span = (range) => (range[1] > range[0] ? range : [range[0] - 0.5, range[0] + 0.5]);
  const [x0, x1] = span(x), [y0, y1] = span(y);
  const px = (value) => left + ((value - x0) / (x1 - x0)) * width;
  const py = (value) => top + height - ((value - y0) / (y1 - y0)) * height;
  pen.strokeStyle = colour("--line");
  pen.fillStyle = colour("--soft");
  pen.textAlign = "center";
  for (const value of ticks(x0, x1, Math.max(2, width / 80))) {
    pen.beginPath(); pen.moveTo(px(value), top); pen.lineTo(px(value), top + height); pen.stroke();
    if (names[0]) pen.fillText(String(value), px(value), top + height + 14);
  }
  pen.textAlign = "right";
  for (const value of ticks(y0, y1, Math.max(2, height / 40))) {
    pen.beginPath(); pen.moveTo(left, py(value)); pen.lineTo(left + width, py(value)); pen.stroke();
    pen.fillText(String(value), left - 4, py(value) + 4);
  }
  pen.fillStyle = colour("--ink");
  if (names[0]) { pen.textAlign = "right"; pen.fillText(names[0], left + width, top + height + 28); }
  pen.textAlign = "left";
  pen.fillText(names[1], left + 4, top + 12);
  return [px, py];
}

function bounds(values) {
  let low = Infinity, high = -Infinity;
  for (const value of values) if (value !== null) { low = Math.min(low, value); high = Math.max(high, value); }
  if (low > high) return [0, 1];
  const rim = (high - low) * 0.06 || Math.abs(high) * 0.1 || 0.5;
  return [low - rim, high + rim];
}

function line(pen, xs, ys, px, py) {
  pen.beginPath();
  let down = false;
  for (let k = 0; k < xs.length; k += 1) {
    if (ys[k] === null || xs[k] === null) { down = false; continue; }
    if (down) pen.lineTo(px(xs[k]), py(ys[k])); else pen.moveTo(px(xs[k]), py(ys[k]));
    down = true;
  }
  pen.stroke();
}

function drawTime() {
  const [pen, width, height] = begin(byId("time"));
  const shown = TRACES.filter(([name]) => curves[name] && curves[name].least.some((value) => value !== null));
  if (!shown.length) return;
  const end = Math.max(...shown.map(([name]) => curves[name].least.length * curves[name].width));
  const each = (height - 34) / shown.length;
  shown.forEach(([name, word, unit, tone], k) => {
    const curve = curves[name], last_one = k === shown.length - 1;
    const range = bounds([...curve.least, ...curve.largest]);
    const [px, py] = axes(pen, [58, k * each + 4, width - 66, each - 12], [0, end], range, [last_one ? "time (s)" : "", `${word} (${unit})`]);
    pen.strokeStyle = colour(tone);
    const xs = [], ys = [];
    const hole = Math.ceil(HOLE_S / curve.width); // so many empty bins are a hole in the data
    let empty = 0;
    curve.least.forEach((value, n) => {
      empty = value === null ? empty + 1 : 0;
      if (value === null && empty < hole) return;
      xs.push(n * curve.width, (n + 0.5) * curve.width);
      ys.push(value, curve.largest[n]);
    });
    line(pen, xs, ys, px, py);
  });
}

function drawLoop() {
  const [pen, width, height] = begin(byId("loop"));
  const film = outlook && outlook.film;
  const model = film ? film.force_mN.flat() : [];
  if (!loop.points.length && !film) return;
  const x = bounds([...loop.points.map((p) => p[0]), ...(film ? film.h_mm : [])]);
  const y = bounds([...loop.points.map((p) => p[1]), ...model]);
  const [px, py] = axes(pen, [58, 4, width - 66, height - 40], x, y, ["displacement (mm)", "force (mN)"]);
  const levels = film ? film.voltages_V : [...new Set(loop.points.map((p) => p[2]))].sort((a, b) => a - b);
  const tone = (level) => colour(COLOURS[Math.max(levels.indexOf(level), 0) % COLOURS.length]);
  pen.setLineDash([5, 4]);
  if (film) film.voltages_V.forEach((level, k) => { pen.strokeStyle = tone(level); line(pen, film.h_mm, film.force_mN[k], px, py); });
  pen.setLineDash([]);
  for (const [h, force, level] of loop.points) { pen.fillStyle = tone(level); pen.fillRect(px(h) - 1.5, py(force) - 1.5, 3, 3); }
  const here = last && last.latest;
  if (here && here.displacement_mm !== null && here.displacement_mm !== undefined && here.force_mN !== null && !last.ended) {
    pen.strokeStyle = colour("--ink");
    pen.beginPath(); pen.arc(px(here.displacement_mm), py(here.force_mN), 6, 0, 7); pen.stroke();
  }
  byId("loop-key").textContent = levels.length ? `points: measured, dashed: model, at ${levels.map((v) => `${v} V`).join(", ")}` : "";
}

function drawShape() {
  const [pen, width, height] = begin(byId("shape"));
  const film = outlook && outlook.film;
  if (!film || !last) return;
  const deepest = film.h_mm[film.h_mm.length - 1], h = Math.min(Math.max(last.latest.displacement_mm || 0, 0), deepest);
  const place = (h / deepest) * (film.h_mm.length - 1), k = Math.min(Math.floor(place), film.h_mm.length - 2), part = place - k;
  const mix = (rows, n) => (rows[k][n] === null || rows[k + 1][n] === null ? null : rows[k][n] * (1 - part) + rows[k + 1][n] * part);
  const scale = Math.min((width - 20) / (2 * film.ring_radius_mm), (height - 20) / (deepest * 1.1));
  const px = (r) => width / 2 + r * scale, py = (z) => 10 + Math.abs(z) * scale;
  pen.strokeStyle = colour("--a");
  pen.lineWidth = 3;
  const n = film.shape_r_mm[0].length, rs = [], zs = [];
  for (let m = 0; m < n; m += 1) { rs.push(mix(film.shape_r_mm, m)); zs.push(mix(film.shape_z_mm, m)); }
  line(pen, rs, zs, px, py);
  line(pen, rs.map((r) => (r === null ? null : -r)), zs, px, py);
  pen.strokeStyle = colour("--ink");
  pen.lineWidth = 6;
  pen.beginPath(); pen.moveTo(px(-film.disk_radius_mm), py(h)); pen.lineTo(px(film.disk_radius_mm), py(h)); pen.stroke();
  pen.fillStyle = colour("--soft");
  pen.textAlign = "left";
  pen.fillText(`displacement ${digits(h, 3)} mm`, 8, height - 8);
}

function draw() {
  const silent = (performance.now() - heard) / 1000;
  if (heard && silent > OLD_S) {
    byId("old").hidden = false;
    byId("old").textContent = `The panel's server has not answered for ${time(silent)}. Nothing here is current.`;
    if (!(last && last.ended)) showState("UNKNOWN", NOTES.UNKNOWN);
  }
  const size = `${window.innerWidth} ${window.innerHeight}`;
  if (!changed && size === drawn) return; // a finished log costs nothing
  changed = false;
  drawn = size;
  drawTime();
  drawLoop();
  drawShape();
}

setInterval(draw, DRAW_MS);
window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { changed = true; });
findRuns();
ask();
