"use strict";
// How far off, hour by hour, beside the level; where nothing was recorded, nothing is known.

const STRIP = 12, HOUR = 3600;

const Hours = {
  draw(known, events) {
    const host = byId("hours"), rows = known.rows || [], truth = known.truth || [];
    this.words(known);
    byId("k-truth").hidden = !truth.length;
    const every = [...rows, ...truth];
    if (!every.length) { host.replaceChildren(); return; }
    const width = Math.max(host.clientWidth, 260), height = width < 600 ? 190 : 220;
    const s = this.scales(every, known, width, height);
    const picture = svg("svg", { viewBox: `0 0 ${width} ${height}`, height, role: "img", "aria-label": "Error over time, mm" },
      ...this.gaps(s, rows), ...this.off(s, known.off || []), ...this.axes(s), ...this.marks(s, events), ...this.limit(s, known),
      svg("path", { class: "truth", d: line(truth.map((r) => [s.x(r.at), s.y(r.mm)])) }),
      svg("path", { class: "accepted dots", d: dots(rows.map((r) => [s.x(r.at + HOUR / 2), s.y(r.mm)])) }),
      ...this.levels(s, truth.length ? truth : rows));
    host.replaceChildren(picture);
  },

  words(known) {
    const off = known.off || [], hours = off.reduce((sum, o) => sum + Math.round((o.to - o.from) / HOUR), 0);
    const than = known.by === "truth" ? `more than ${digits(known.limit_mm)} mm of true tip error` : `more than twice the usual ${digits(known.usual_mm)} mm`;
    const list = off.slice(-3).map((o) => `${when(o.from).replace(/:\d\d UTC$/, "")} (${span(o.to - o.from)}, ${digits(o.mm, 2)} mm)`).join("; ");
    const more = off.length > 3 ? `; and ${off.length - 3} earlier` : "";
    if (!known.checked) say("off-nominal", "No hour has two readings yet.");
    else if (!hours) say("off-nominal", `Never off while the level was nominal, in ${count(known.checked)} hours (${than}).`);
    else say("off-nominal", `Off while the level was nominal in ${hours} of ${count(known.checked)} hours (${than}): ${list}${more}.`);
    byId("off-nominal").className = hours ? "warn" : "soft";
    say("k-limit", known.by === "truth" ? "limit" : "twice the usual");
  },

  scales(every, known, width, height) {
    const box = { left: 46, right: width - 8, top: 20, bottom: height - 34 - STRIP };
    const values = [...every.map((r) => r.mm), known.limit_mm].filter((v) => isNumber(v) && v > 0);
    const low = Math.floor(Math.log10(Math.min(...values)) * 2) / 2, high = Math.log10(Math.max(...values)) + 0.1;
    const first = Math.min(...every.map((r) => r.at)), last = Math.max(...every.map((r) => r.at)) + HOUR;
    const y = (mm) => box.bottom - Math.max((Math.log10(Math.max(mm, 1e-9)) - low) / (high - low), 0) * (box.bottom - box.top);
    return { box, low, high, first, last, y, x: (t) => box.left + ((t - first) / (last - first)) * (box.right - box.left) };
  },

  axes(s) {
    const parts = [svg("text", { x: 4, y: 12 }, "mm")];
    for (let power = Math.floor(s.low); power <= s.high; power++)
      for (const step of s.high - s.low < 2.2 ? [1, 2, 5] : [1]) {
        const mm = step * 10 ** power;
        if (Math.log10(mm) < s.low || Math.log10(mm) > s.high) continue;
        parts.push(svg("path", { class: "rule", d: `M${s.box.left} ${at(s.y(mm))}H${s.box.right}` }));
        parts.push(svg("text", { x: s.box.left - 6, y: at(s.y(mm) + 4), "text-anchor": "end" }, digits(mm)));
      }
    const days = s.last > 1e8, most = Math.max((s.box.right - s.box.left) / 110, 2);
    const steps = [1, 2, 3, 6, 12, 24, 48, 96, 168, 336, 720].map((h) => h * HOUR);
    const step = steps.find((step_s) => (s.last - s.first) / step_s <= most) || niceStep((s.last - s.first) / most);
    for (let t = Math.ceil(s.first / step) * step; t < s.last; t += step) {
      const word = !days ? `${digits(t / HOUR)} h` : step >= 24 * HOUR ? when(t).slice(5, 10) : when(t).slice(5, 16);
      parts.push(svg("text", { x: at(s.x(t)), y: s.box.bottom + STRIP + 18, "text-anchor": "middle" }, word));
    }
    parts.push(svg("path", { class: "axis", d: `M${s.box.left} ${s.box.top}V${s.box.bottom}H${s.box.right}` }));
    return parts;
  },

  // Two hours or more without a record.
  gaps(s, rows) {
    const parts = [], ends = [...rows.map((r) => r.at), s.last];
    for (let i = 0, before = s.first; i < ends.length; before = ends[i] + HOUR, i++)
      if (ends[i] - before >= 2 * HOUR) parts.push(this.band(s, "gap", before, ends[i]));
    return parts;
  },

  off(s, spans) { return spans.map((o) => this.band(s, "off", o.from, o.to)); },

  band(s, name, from, to) {
    const x = s.x(Math.max(from, s.first));
    return svg("rect", { class: name, x: at(x), y: s.box.top, width: at(Math.max(s.x(Math.min(to, s.last)) - x, 2)), height: at(s.box.bottom - s.box.top) });
  },

  limit(s, known) {
    return isNumber(known.limit_mm) ? [svg("path", { class: "gate", d: `M${s.box.left} ${at(s.y(known.limit_mm))}H${s.box.right}` })] : [];
  },

  marks(s, events) {
    const places = events.filter((e) => e.event === "decision" && e.at >= s.first && e.at <= s.last).map((e) => at(s.x(e.at)));
    return [svg("path", { class: "decision", d: places.map((x) => `M${x} ${s.box.top}V${s.box.bottom}`).join("") })];
  },

  levels(s, rows) {
    return rows.map((r) => svg("rect", { class: `strip ${r.level}`, x: at(s.x(r.at)), y: s.box.bottom + 2,
      width: at(Math.max(s.x(r.at + HOUR) - s.x(r.at), 1) + 0.3), height: STRIP - 4 }));
  },
};
