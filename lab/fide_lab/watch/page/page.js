"use strict";
const EVERY = 1000;
const SVG = "http://www.w3.org/2000/svg";
const byId = (id) => document.getElementById(id);
const shown = {};
const DIGIT = 10; // pixels of a character of a label, at most
let drawn = [[], 0];

function short(value) {
  if (value === 0) return "0";
  return Math.abs(value) >= 1e-3 && Math.abs(value) < 1e5 ? String(+value.toPrecision(4)) : value.toExponential(2);
}

function duration(seconds) {
  const s = Math.round(seconds);
  if (s < 60) return `${s} s`;
  return s < 3600 ? `${Math.floor(s / 60)} min ${s % 60} s` : `${Math.floor(s / 3600)} h ${Math.floor((s % 3600) / 60)} min`;
}

function numbers(state) {
  const rows = [];
  if ("best_loss" in state) rows.push(["best loss", short(state.best_loss)]);
  if ("evaluations" in state) rows.push(["renders", state.evaluations + (state.budget ? ` of ${state.budget}` : "")]);
  if ("seconds" in state) rows.push(["time", duration(state.seconds)]);
  if (state.failures) rows.push(["failed renders", state.failures]);
  byId("numbers").replaceChildren(...rows.map(([name, value]) => {
    const box = document.createElement("div");
    const dt = document.createElement("dt");
    const dd = document.createElement("dd");
    dt.textContent = name;
    dd.textContent = value;
    box.append(dt, dd);
    return box;
  }));
}

function pictures(versions) {
  for (const name of ["target", "best"]) {
    const version = versions[`${name}.png`];
    if (!version || shown[name] === version) continue;
    shown[name] = version;
    for (const image of document.getElementsByClassName(name)) {
      image.src = `/${name}.png?${version}`;
      image.hidden = false;
    }
  }
}

function tick(x1, y1, x2, y2, text, x, y, anchor) {
  const line = document.createElementNS(SVG, "line");
  for (const [key, value] of Object.entries({ x1, y1, x2, y2 })) line.setAttribute(key, value);
  const label = document.createElementNS(SVG, "text");
  label.setAttribute("x", x);
  label.setAttribute("y", y);
  label.setAttribute("text-anchor", anchor);
  label.textContent = text;
  return [line, label];
}

// Zero is drawn below all others.
function decades(losses) {
  const logs = losses.filter((loss) => loss > 0).map(Math.log10);
  const low = Math.floor(Math.min(...logs)), high = Math.max(Math.ceil(Math.max(...logs)), low + 1);
  const step = Math.ceil((high - low) / 5), marks = [];
  for (let log = low; log <= high; log += step) marks.push([log, `1e${log}`]);
  if (logs.length === losses.length) return { values: logs, low, high, marks };
  const zero = low - Math.max(1, (high - low) / 5);
  const values = losses.map((loss) => (loss > 0 ? Math.log10(loss) : zero));
  return { values, low: zero, high, marks: [[zero, "0"], ...marks] };
}

// Of losses below zero, which have no logarithm, or of zeros alone.
function linear(losses) {
  const low = Math.min(...losses), most = Math.max(...losses);
  const high = most > low ? most : low + Math.max(Math.abs(low), 1);
  const marks = [0, 1, 2, 3, 4].map((i) => low + (i * (high - low)) / 4);
  return { values: losses, low, high, marks: marks.map((value) => [value, short(value)]) };
}

function curve(points, last) {
  drawn = [points, last];
  if (!points.length) return;
  const width = byId("curve").clientWidth, bottom = byId("curve").clientHeight - 35;
  byId("curve").setAttribute("viewBox", `0 0 ${width} ${bottom + 35}`);
  const losses = points.map(([, loss]) => loss);
  const { values, low, high, marks } = losses.some((loss) => loss > 0) && losses.every((loss) => loss >= 0) ? decades(losses) : linear(losses);
  const end = Math.max(last || 0, points[points.length - 1][0], 1);
  const left = 20 + DIGIT * Math.max(...marks.map(([, text]) => text.length)), right = width - 10;
  const x = (n) => left + ((right - left) * n) / end;
  const y = (value) => 15 + ((bottom - 15) * (high - value)) / (high - low);
  let path = `M${x(points[0][0])} ${y(values[0])}`;
  for (let i = 1; i < points.length; i += 1) path += `H${x(points[i][0])}V${y(values[i])}`;
  byId("line").setAttribute("d", `${path}H${x(end)}`);
  const ticks = [];
  for (const [value, text] of marks) ticks.push(...tick(left, y(value), right, y(value), text, left - 8, y(value) + 5, "end"));
  ticks.push(...tick(right, bottom, right, bottom + 6, `${end} renders`, right, bottom + 24, "end"));
  byId("ticks").replaceChildren(...ticks);
}

function parameters(rows) {
  byId("parameters").replaceChildren(...rows.map((row) => {
    const tr = document.createElement("tr");
    tr.append(...row.map((text) => {
      const td = document.createElement("td");
      td.textContent = text;
      return td;
    }));
    return tr;
  }));
}

async function update() {
  try {
    const state = await (await fetch("/state.json", { cache: "no-store" })).json();
    document.title = "best_loss" in state ? `${short(state.best_loss)} · ${state.task}` : state.task;
    byId("task").textContent = state.task;
    byId("status").textContent = state.sentence ? `${state.state}: ${state.sentence}` : state.state;
    byId("curve-title").textContent = `${state.loss}, best so far`;
    numbers(state);
    pictures(state.pictures);
    curve(state.improvements, state.evaluations);
    parameters(state.parameters);
  } catch {
    byId("status").textContent = "the run does not answer; it may have ended";
  }
  setTimeout(update, EVERY);
}

window.addEventListener("resize", () => curve(...drawn));
update();
