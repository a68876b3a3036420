"use strict";
// Small helpers for drawing. Text is only ever set as text, so nothing that was written by others becomes markup.

const SVG = "http://www.w3.org/2000/svg";
const byId = (id) => document.getElementById(id);

function made(namespace, name, attributes, children) {
  const node = namespace ? document.createElementNS(namespace, name) : document.createElement(name);
  for (const [key, value] of Object.entries(attributes || {})) node.setAttribute(key, value);
  for (const child of children) node.append(child);
  return node;
}
const html = (name, attributes, ...children) => made(null, name, attributes, children);
const svg = (name, attributes, ...children) => made(SVG, name, attributes, children);

const say = (id, text) => { const node = byId(id); if (node.textContent !== text) node.textContent = text; };
const isNumber = (x) => typeof x === "number" && Number.isFinite(x);
const at = (x) => x.toFixed(1);

function digits(x, significant = 3) {
  if (!isNumber(x)) return "-";
  if (x === 0) return "0";
  const size = Math.abs(x);
  if (size >= 1e6 || size < 1e-5) return x.toExponential(1);
  const text = size >= 10 ** significant ? x.toFixed(0) : Number(x.toPrecision(significant)).toString();
  return size >= 10000 ? Number(text).toLocaleString("en") : text;
}
const signed = (x, significant = 3) => (x > 0 ? "+" : "") + digits(x, significant);
const count = (x) => (isNumber(x) ? x.toLocaleString("en") : "-");
// Unix seconds as a date; seconds of a clock that began elsewhere as they are.
const when = (seconds) => {
  if (!isNumber(seconds)) return "";
  if (seconds < 1e8 || seconds > 1e11) return `at ${digits(seconds, 6)} s`;
  return new Date(seconds * 1000).toISOString().slice(0, 19).replace("T", " ") + " UTC";
};
function span(seconds) {
  if (seconds < 120) return `${Math.round(seconds)} s`;
  if (seconds < 7200) return `${Math.round(seconds / 60)} min`;
  return seconds < 172800 ? `${Math.round(seconds / 3600)} h` : `${Math.round(seconds / 86400)} d`;
}

function niceStep(rough) {
  if (!(rough > 0) || !Number.isFinite(rough)) return 1;
  const power = 10 ** Math.floor(Math.log10(rough));
  return [1, 2, 5, 10].find((step) => step * power >= rough * 0.999) * power;
}

const dots = (points) => points.map(([x, y]) => `M${at(x)} ${at(y)}h0`).join("");
const crosses = (points, r = 4) =>
  points.map(([x, y]) => `M${at(x - r)} ${at(y - r)}l${2 * r} ${2 * r}m${-2 * r} 0l${2 * r} ${-2 * r}`).join("");
const rings = (points, r = 3) =>
  points.map(([x, y]) => `M${at(x - r)} ${at(y)}a${r} ${r} 0 1 0 ${2 * r} 0a${r} ${r} 0 1 0 ${-2 * r} 0`).join("");
const line = (points) => points.map(([x, y], i) => `${i ? "L" : "M"}${at(x)} ${at(y)}`).join("");
const length3 = (v) => Math.hypot(v[0], v[1], v[2]);
