"use strict";
// What the page knows, how it is kept up to date, and when it is drawn again.

const MOST_RECORDS = 6000, MOST_ROWS = 700, MOST_EVENTS = 400;
const token = new URLSearchParams(location.search).get("token");
const address = (path, query = {}) => {
  const asked = new URLSearchParams(token === null ? query : { ...query, token });
  return asked.size ? `${path}?${asked}` : path;
};

const SILENT_S = 15;
const Known = { state: null, heard: 0, status: 0, stream: null, due: new Set(), timer: null };

function ask(...parts) {
  for (const part of parts) Known.due.add(part);
  if (Known.timer === null) Known.timer = setTimeout(redraw, 120);
}

function redraw() {
  Known.timer = null;
  if (!Known.state) return;
  const due = new Set(Known.due), state = Known.state;
  Known.due.clear();
  if (due.has("health")) drawHealth(state);
  if (due.has("innovations")) Innovations.draw(state.records, state.told);
  if (due.has("events")) drawEvents(state);
  if (due.has("arm")) Arm.draw(state.records, state.arm || {}, state.tips);
  if (due.has("parameters")) Parameters.draw(state.estimates, state.told);
}
const redrawAll = () => ask("health", "innovations", "events", "arm", "parameters");

function drawHealth(state) {
  const status = state.status || {};
  const level = state.level === "unknown" && status.level ? status.level : state.level;
  byId("health").dataset.level = level;
  say("level", level);
  say("sentence", state.level_sentence || (status.level === level && status.why) || "");
  byId("waiting").hidden = !state.waiting;
  say("waiting", state.waiting || "");
  say("folder", state.folder);
  const counts = status.counts || state.counts;
  const total = counts.accepted + counts.rejected + counts.ignored;
  for (const verdict of ["accepted", "rejected", "ignored"]) say(verdict, count(counts[verdict]));
  for (const verdict of ["accepted", "rejected"]) say(`${verdict}-share`, total ? `${digits(100 * counts[verdict] / total)} %` : "");
  say("counted-from", !status.counts && isNumber(state.first_sequence) ? `counted from record ${count(state.first_sequence)}` : "");
  drawAlive(state);
  document.title = `${level}, armcal watch`;
  const last = state.last;
  if (!last) return;
  say("last-id", last.id || `record ${last.sequence}`);
  say("last-verdict", last.verdict);
  byId("last-verdict").className = `verdict-${last.verdict}`;
  say("last-why", last.why || "");
  say("last-when", `record ${count(last.sequence)}${isNumber(last.at) ? `, ${when(last.at)}` : ""}`);
  say("last-nis", digits(last.nis));
  say("last-limit", isNumber(last.limit) ? `gate ${digits(last.limit)}${isNumber(last.dof) ? `, ${last.dof} degrees of freedom` : ""}` : "");
}

function drawEvents(state) {
  const newest = [...state.told].reverse();
  byId("events").replaceChildren(...newest.map((event) => {
    const where = [isNumber(event.sequence) ? `record ${count(event.sequence)}` : "", when(event.at)].filter(Boolean).join(", ");
    const kind = event.event === "decision" && event.kind ? event.kind.replaceAll("_", " ")
      : event.event === "level" ? `level ${event.to || ""}` : event.event;
    return html("li", { class: event.event }, html("span", { class: "kind" }, kind), " ",
      html("span", { class: "where" }, where), html("span", { class: "said" }, event.sentence));
  }));
  const faults = [];
  if (state.unreadable) faults.push(`${count(state.unreadable)} lines could not be read.`);
  if (state.unknown) faults.push(`${count(state.unknown)} events are of kinds that this page does not know.`);
  say("unread", newest.length ? faults.join(" ") : ["No events yet.", ...faults].join(" "));
}

function took(message) {
  const state = Known.state;
  if (message.event !== "status" && message.event !== "arm") Known.heard = performance.now();
  state.waiting = null;
  if (message.event === "record") takeRecord(state, message);
  else if (message.event === "estimate") takeEstimate(state, message);
  else if (message.event === "arm") { state.arm = message; ask("arm"); }
  else if (message.event === "status") {
    state.status = message.status;
    Known.status = performance.now();
    ask("health");
  } else if (message.event === "calibration") { state.written = message; ask("health"); }
  else if (message.event === "reset") begin();
  else takeTold(state, message);
}

function takeRecord(state, record) {
  state.counts = record.counts;
  if (state.level !== record.standing) {
    state.level = record.standing;
    state.level_sentence = record.standing_sentence;
  }
  state.last = record;
  if (!isNumber(state.first_sequence)) state.first_sequence = record.sequence;
  state.records.push(record);
  if (state.records.length > MOST_RECORDS) state.records.splice(0, MOST_RECORDS / 6);
  ask("health", "innovations", "arm");
}

function takeEstimate(state, row) {
  const rows = state.estimates.rows;
  if (row.change.length > state.estimates.parameters.length) { begin(); return; }
  rows.push(row);
  if (rows.length > MOST_ROWS) state.estimates.rows = rows.filter((_, i) => i % 2 === 0 || i > MOST_ROWS / 2);
  ask("parameters");
}

function takeTold(state, event) {
  if (event.event === "level") { state.level = event.to; state.level_sentence = event.sentence; }
  state.told.push(event);
  if (state.told.length > MOST_EVENTS) state.told.shift();
  ask("health", "innovations", "events", "parameters");
}

let beginning = false;
async function begin() {
  if (beginning) return;
  beginning = true;
  if (Known.stream) Known.stream.close();
  Known.stream = null;
  try {
    const answer = await fetch(address("state"), { cache: "no-store" });
    if (!answer.ok) throw new Error(`the server answered ${answer.status}`);
    Known.state = await answer.json();
    Known.heard = performance.now() - 1000 * Known.state.heard_s;
    Known.status = performance.now() - 1000 * (Known.state.status_s || 0);
    listen(Known.state.after);
    redrawAll();
  } catch (fault) {
    connection("lost", "no connection; trying again");
    setTimeout(begin, 3000);
  }
  beginning = false;
}

function listen(after) {
  const stream = new EventSource(address("events", { after }));
  Known.stream = stream;
  stream.onopen = () => connection("live", "live");
  stream.onmessage = (event) => { if (Known.stream === stream) took(JSON.parse(event.data)); };
  stream.addEventListener("reset", () => begin());
  stream.onerror = () => {
    connection("lost", "no connection; trying again");
    if (stream.readyState === EventSource.CLOSED && Known.stream === stream) setTimeout(begin, 3000);
  };
}

function connection(state, text) {
  byId("connection").dataset.state = state;
  Known.connection = text;
  age();
}

function spoken(since) {
  const seconds = Math.round((performance.now() - since) / 1000);
  if (seconds < 120) return `${seconds} s`;
  return seconds < 7200 ? `${Math.round(seconds / 60)} min` : `${Math.round(seconds / 3600)} h`;
}

function age() {
  const state = Known.state;
  const known = state && (state.last || state.told.length);
  const ended = Known.connection === "live" && state && (state.status || {}).finished;
  const connection = ended ? "ended" : Known.connection || "loading";
  if (Known.connection === "live") byId("connection").dataset.state = connection;
  say("connection", known ? `${connection}; newest event ${spoken(Known.heard)} ago` : connection);
  if (state) drawAlive(state);
}

function drawAlive(state) {
  const status = state.status || {}, parts = [];
  const known = Object.keys(status).length > 0;
  const silent = known && !status.finished && performance.now() - Known.status > 1000 * SILENT_S;
  if (silent) parts.push(`No status for ${spoken(Known.status)}: the recalibration may have stopped.`);
  if (status.finished) parts.push("The recalibration has finished.");
  if (status.paused) parts.push("It is paused: records are passed over.");
  if (status.journal === "full") parts.push("Its journal is full: records wait.");
  if (state.written) parts.push(`Calibration last written at record ${count(state.written.sequence)}, ${when(state.written.at)}.`);
  if (isNumber(status.records)) parts.push(`${count(status.records)} records taken in all.`);
  say("alive", parts.join(" "));
  byId("alive").className = silent ? "stopped" : "soft";
}

function turning() {
  const host = byId("arm");
  let from = null;
  host.addEventListener("pointerdown", (e) => { from = [e.clientX, e.clientY]; host.setPointerCapture(e.pointerId); });
  host.addEventListener("pointermove", (e) => {
    if (!from) return;
    Arm.turned((e.clientX - from[0]) / 120, (e.clientY - from[1]) / 120);
    from = [e.clientX, e.clientY];
    ask("arm");
  });
  for (const name of ["pointerup", "pointercancel"]) host.addEventListener(name, () => { from = null; });
  host.addEventListener("keydown", (e) => {
    const step = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] }[e.key];
    if (step) { Arm.turned(...step); ask("arm"); e.preventDefault(); }
  });
  for (const button of document.querySelectorAll("[data-view]"))
    button.addEventListener("click", () => { Arm.look(button.dataset.view); ask("arm"); });
}

for (const name of ["pointermove", "pointerdown"]) byId("innovations").addEventListener(name, (e) => Innovations.pointed(e));
byId("window").addEventListener("change", () => ask("innovations"));
byId("filter").addEventListener("input", () => ask("parameters"));
byId("order").addEventListener("change", () => ask("parameters"));
addEventListener("resize", redrawAll);
setInterval(age, 1000);
turning();
begin();
