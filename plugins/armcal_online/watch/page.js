"use strict";
// What the page knows, how it is kept up to date, and when it is drawn again.

const MOST_RECORDS = 8000, MOST_LISTED = 800; // more than the server keeps: then all is fetched anew
const PAUSE_MS = 250, AGAIN_MS = 3000, LONGEST_MS = 30000;
const LATE_MS = 8000; // the server answers within 5 s, be there news or not
const token = new URLSearchParams(location.search).get("token");
const address = (path, query = {}) => {
  const asked = new URLSearchParams(token === null ? query : { ...query, token });
  return asked.size ? `${path}?${asked}` : path;
};

const Known = { state: null, asked: Infinity, heard: 0, due: new Set(), timer: null };

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
  if (due.has("hours")) Hours.draw(state.over_time, state.events);
  if (due.has("innovations")) Innovations.draw(state.records, state.events);
  if (due.has("events")) drawEvents(state);
  if (due.has("arm")) Arm.draw(state.records, state.arm || {}, state.tips);
  if (due.has("parameters")) Parameters.draw(state.estimates, state.events);
}
const redrawAll = () => ask("health", "hours", "innovations", "events", "arm", "parameters");

// By a kill or a fault, and not because it was asked to end.
const isGone = (now) => now.life === "stopped" || now.life === "silent";

function drawHealth(state) {
  const status = state.status || {}, now = state.situation || {};
  const level = state.level === "unknown" && status.level ? status.level : state.level;
  byId("health").dataset.level = level;
  say("level", isGone(now) ? "not running" : level);
  say("do", now.do || "");
  say("sentence", now.what || isGone(now) ? now.what || "" : state.level_sentence || (status.level === level && status.why) || "");
  say("confirm", now.confirm ? `To confirm: ${now.confirm}` : now.earlier ? `The last decision: ${now.earlier}` : "");
  byId("waiting").hidden = !state.waiting;
  say("waiting", state.waiting || "");
  say("folder", state.folder);
  drawOff(now, state.last || {}, level);
  drawCounts(state, status);
  document.title = `${isGone(now) ? "not running" : level}, armcal watch`;
}

function drawOff(now, last, level) {
  say("off", isNumber(now.off_mm) ? `${digits(now.off_mm, 2)} mm` : "not known");
  say("off-of", now.off_of ? (now.off_of > 1 ? `median of the last ${now.off_of} readings from their predictions` : "the newest reading from its prediction") : isNumber(last.sequence) ? "no reading in mm yet" : "");
  say("off-before", isNumber(now.off_before_mm) ? `${digits(now.off_before_mm, 2)} mm before this was decided` : "");
  const since = now.since;
  say("since", since ? named(since) : level === "nominal" ? "the start" : "-");
  say("since-at", since ? placed(since, last) : "");
  say("good", now.last_good ? named(now.last_good) : "none yet");
  say("good-at", now.last_good ? placed(now.last_good, last) : "");
  byId("back").hidden = !now.rollback || level === "nominal";
  say("rollback", now.rollback || "");
  if (!isNumber(last.sequence)) return;
  say("last-id", named(last));
  say("last-verdict", last.verdict);
  byId("last-verdict").className = `verdict-${last.verdict}`;
  say("last-why", last.why || "");
  say("last-when", placed(last, {}));
  say("last-nis", digits(last.nis));
  say("last-limit", isNumber(last.limit) ? `(gate ${digits(last.limit)}${isNumber(last.dof) ? `, ${last.dof} degrees of freedom` : ""})` : "");
}

const named = (record) => record.id || `entry ${count(record.sequence)}`;
function placed(record, newest) {
  const parts = [when(record.at), record.id ? `entry ${count(record.sequence)}` : ""];
  const ago = newest.at - record.at;
  if (ago > 0) parts.push(`${span(ago)} before the newest record`);
  return parts.filter(Boolean).join(", ");
}

function drawCounts(state, status) {
  const counts = status.counts || state.counts;
  const total = counts.accepted + counts.rejected + counts.ignored;
  for (const verdict of ["accepted", "rejected", "ignored"]) say(verdict, count(counts[verdict]));
  for (const verdict of ["accepted", "rejected"]) say(`${verdict}-share`, total ? `(${digits(100 * counts[verdict] / total)} %)` : "");
  say("counted-from", !status.counts && isNumber(state.first_sequence) ? `counted from entry ${count(state.first_sequence)}` : "");
}

function drawEvents(state) {
  const names = new Map(state.records.map((record) => [record.sequence, record.id]));
  const decided = new Set(state.events.filter((event) => event.event === "decision").map((event) => event.sequence));
  byId("events").replaceChildren(...[...state.events].reverse().map((event) => eventItem(state, event, names, decided)));
  const faults = [];
  if (state.unreadable) faults.push(`${count(state.unreadable)} lines could not be read.`);
  if (state.unknown) faults.push(`${count(state.unknown)} events are of kinds that this page does not know.`);
  say("unread", state.events.length ? faults.join(" ") : ["No events yet.", ...faults].join(" "));
}

function eventItem(state, event, names, decided) {
  const id = names.get(event.sequence);
  const entry = isNumber(event.sequence) ? (id ? `record ${id} (entry ${count(event.sequence)})` : `entry ${count(event.sequence)}`) : "";
  const kind = event.event === "decision" && event.kind ? event.kind.replaceAll("_", " ")
    : event.event === "level" ? `level ${event.to || ""}` : event.event;
  const follows = event.event === "level" && decided.has(event.sequence);
  const lines = [html("span", { class: "said" }, follows ? `By the decision at this record; it was ${event.from || "unknown"}.` : event.sentence)];
  if (event.event === "decision") {
    if (event.do) lines.push(html("span", { class: "more" }, html("b", {}, "Do: "), event.do));
    if (event.confirm) lines.push(html("span", { class: "more" }, html("b", {}, "Confirm: "), event.confirm));
    if (event.why) lines.push(html("span", { class: "more" }, html("b", {}, "Because: "), event.why));
    if (event.last_good && event.kind !== "rollback")
      lines.push(html("span", { class: "more" }, html("b", {}, "Undo: "), html("code", {}, `${state.control} rollback ${event.last_good.sequence}`)));
  }
  return html("li", { class: event.event }, html("span", { class: "kind" }, kind), " ",
    html("span", { class: "where" }, [entry, when(event.at)].filter(Boolean).join(", ")), ...lines);
}

// A state, or what is new in it: of its lists that come after those that are known.
function take(state) {
  const known = Known.state, hours = state.over_time, { records, events } = state, { rows } = state.estimates;
  if (state.whole || records.length) ask("innovations", "arm");
  if (state.whole || events.length) ask("hours", "innovations", "events", "parameters");
  if (state.whole || rows.length) ask("parameters");
  if (state.whole || hours.rows.length) ask("hours");
  if (state.arm && state.arm.sequence !== (known && known.arm || {}).sequence) ask("arm");
  if (!state.whole) {
    state.records = [...known.records, ...records];
    state.events = [...known.events, ...events];
    state.estimates.rows = [...known.estimates.rows, ...rows];
    hours.rows = [...new Map([...known.over_time.rows, ...hours.rows].map((hour) => [hour.at, hour])).values()];
    hours.truth = known.over_time.truth;
  }
  Known.state = state;
  Known.heard = performance.now() - 1000 * state.heard_s;
}

async function follow() {
  const known = Known.state;
  const isMuch = known && (known.records.length > MOST_RECORDS || Math.max(known.events.length, known.estimates.rows.length) > MOST_LISTED);
  try {
    Known.asked = performance.now();
    const place = known && !isMuch ? { after: known.place } : {};
    const answer = await fetch(address("state", place), { cache: "no-store", signal: AbortSignal.timeout(LONGEST_MS) });
    if (!answer.ok) throw new Error(`the server answered ${answer.status}`);
    take(await answer.json());
    Known.asked = Infinity;
    connection("live", "live");
    setTimeout(follow, PAUSE_MS);
  } catch (fault) {
    connection("lost", "no connection; trying again");
    setTimeout(follow, AGAIN_MS);
  }
}

function connection(state, text) {
  byId("connection").dataset.state = state;
  Known.connection = text;
  age();
}

const ago = (since) => span((performance.now() - since) / 1000);

function age() {
  const state = Known.state, host = byId("connection");
  if (Known.connection === "live" && performance.now() - Known.asked > LATE_MS) connection("lost", "no answer; waiting for it");
  if (!state || Known.connection !== "live") {
    say("connection", Known.connection || "loading");
    return;
  }
  // Of the recalibration, not of the connection to this page's server.
  const now = (state.situation || {}).life, known = state.last || state.events.length;
  host.dataset.state = now;
  const ended = state.finished ? ` ${when(state.finished.at)}` : "";
  const words = now === "ended" ? `ended${ended}, level ${state.level}` : now;
  say("connection", known && now === "live" ? `${words}; newest event ${ago(Known.heard)} ago` : words);
  byId("health").dataset.life = now;
  say("level-when", now === "ended" ? `at its end${ended}` : isGone(state.situation) ? `the level was ${state.level}` : "");
  drawAlive(state);
  ask("health");
}

function drawAlive(state) {
  const status = state.status || {}, now = state.situation || {}, parts = [];
  say("alive", now.over || "");
  byId("alive").className = isGone(now) ? "stopped" : "";
  if (status.paused) parts.push("It is paused: records are passed over.");
  if (state.written) parts.push(`Calibration last written at entry ${count(state.written.sequence)}, ${when(state.written.at)}.`);
  if (isNumber(status.records)) parts.push(`${count(status.records)} records taken in all.`);
  say("kept", parts.join(" "));
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
addEventListener("resize", redrawAll);
setInterval(age, 1000);
turning();
follow();
