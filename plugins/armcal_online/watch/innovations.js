"use strict";
// NIS of every record on a logarithmic axis, against the gate; decisions and changes of level as vertical lines.

const Innovations = {
  shown: [],
  chosen: null,

  window(records, events) {
    const size = Number(byId("window").value);
    const shown = size ? records.slice(-size) : records;
    const first = shown.length ? shown[0].sequence : 0;
    return { shown, events: events.filter((e) => isNumber(e.sequence) && e.sequence >= first) };
  },

  scales(shown, width, height) {
    const known = shown.filter((r) => isNumber(r.nis) && r.nis > 0).map((r) => r.nis);
    const limits = shown.map((r) => r.limit).filter((l) => isNumber(l) && l > 0);
    const top = Math.max(10, ...known, ...limits);
    const bottom = Math.max(Math.min(1, ...known), top / 1e9, 0.01);
    const low = Math.floor(Math.log10(bottom)), high = Math.log10(top) + 0.12;
    const box = { left: 46, right: width - 8, top: 20, bottom: height - 34 };
    const first = shown.length ? shown[0].sequence : 0, last = shown.length ? shown[shown.length - 1].sequence : 1;
    const span = Math.max(last - first, 1);
    const y = (nis) => {
      const part = (Math.log10(Math.max(nis, 1e-300)) - low) / (high - low);
      return box.bottom - Math.min(Math.max(part, 0), 1) * (box.bottom - box.top);
    };
    return { box, low, high, first, last, y, x: (n) => box.left + 6 + ((n - first) / span) * (box.right - box.left - 12) };
  },

  axes(s) {
    const parts = [];
    const every = Math.ceil((s.high - s.low) / 6);
    for (let power = s.low; power <= s.high; power += every) {
      const y = s.y(10 ** power);
      parts.push(svg("path", { class: "rule", d: `M${s.box.left} ${at(y)}H${s.box.right}` }));
      const label = power >= 5 || power < -2 ? `1e${power}` : digits(10 ** power);
      parts.push(svg("text", { x: s.box.left - 6, y: y + 4, "text-anchor": "end" }, label));
    }
    parts.push(svg("path", { class: "axis", d: `M${s.box.left} ${s.box.top}V${s.box.bottom}H${s.box.right}` }));
    const step = Math.max(1, niceStep((s.last - s.first) / Math.max((s.box.right - s.box.left) / 90, 2)));
    for (let n = Math.ceil(s.first / step) * step; n <= s.last; n += step) {
      parts.push(svg("text", { x: at(s.x(n)), y: s.box.bottom + 16, "text-anchor": "middle" }, count(n)));
    }
    parts.push(svg("text", { x: (s.box.left + s.box.right) / 2, y: s.box.bottom + 31, "text-anchor": "middle" }, "record"));
    parts.push(svg("text", { x: 4, y: 12 }, "NIS"));
    return parts;
  },

  lines(s, events) {
    const parts = [];
    let free = s.box.left;
    for (const event of events) {
      const level = event.event === "level";
      if (!level && event.event !== "decision" && event.event !== "alarm") continue;
      const x = s.x(Math.min(event.sequence, s.last));
      parts.push(svg("path", { class: level ? "change" : "decision", d: `M${at(x + (level ? 1.5 : 0))} ${s.box.top}V${s.box.bottom}` }));
      const word = level ? event.to || "" : "";
      if (word && x >= free && x < s.box.right - 7 * word.length) {
        parts.push(svg("text", { class: "change", x: at(x + 4), y: s.box.top - 4 }, word));
        free = x + 7 * word.length + 12;
      }
    }
    return parts;
  },

  gate(s, shown) {
    const points = [];
    let before = null;
    for (const record of shown) {
      if (!isNumber(record.limit)) continue;
      if (before !== null && before !== record.limit) points.push([s.x(record.sequence), s.y(before)]);
      points.push([s.x(record.sequence), s.y(record.limit)]);
      before = record.limit;
    }
    return points.length ? [svg("path", { class: "gate", d: line(points) })] : [];
  },

  draw(records, events) {
    const host = byId("innovations");
    const width = Math.max(host.clientWidth, 260), height = width < 600 ? 240 : 290;
    const seen = this.window(records, events);
    const s = this.scales(seen.shown, width, height);
    const places = { accepted: [], rejected: [], ignored: [] };
    for (const r of seen.shown) {
      if (isNumber(r.nis)) places[r.verdict].push([s.x(r.sequence), s.y(r.nis)]);
      else places[r.verdict].push([s.x(r.sequence), s.box.bottom - 5]);
    }
    const label = `NIS of ${seen.shown.length} records: ${places.accepted.length} accepted, ` +
      `${places.rejected.length} rejected, ${places.ignored.length} ignored`;
    const picture = svg("svg", { viewBox: `0 0 ${width} ${height}`, height, role: "img", "aria-label": label },
      ...this.axes(s), ...this.lines(s, seen.events), ...this.gate(s, seen.shown),
      svg("path", { class: "ignored rings", d: rings(places.ignored) }),
      svg("path", { class: "accepted dots", d: dots(places.accepted) }),
      svg("path", { class: "rejected crosses", d: crosses(places.rejected) }));
    this.ring = svg("path", { class: "chosen", d: "" });
    picture.append(this.ring);
    host.replaceChildren(picture);
    this.scale = s;
    this.shown = seen.shown;
    this.events = seen.events;
    if (this.chosen !== null) this.choose(this.chosen);
  },

  choose(sequence) {
    const record = this.shown.find((r) => r.sequence === sequence);
    if (!record) return;
    this.chosen = sequence;
    const y = isNumber(record.nis) ? this.scale.y(record.nis) : this.scale.box.bottom - 5;
    this.ring.setAttribute("d", rings([[this.scale.x(sequence), y]], 7));
    const parts = [`Record ${sequence}${record.id ? ` (${record.id})` : ""}, ${when(record.at)}: ${record.verdict}`];
    if (isNumber(record.nis)) parts.push(`NIS ${digits(record.nis)}${isNumber(record.limit) ? `, gate ${digits(record.limit)}` : ""}`);
    if (record.residual_mm) parts.push(`off by ${digits(length3(record.residual_mm))} mm`);
    const sentences = this.events.filter((e) => e.sequence === sequence).map((e) => e.sentence);
    byId("readout").textContent = `${parts.join("; ")}. ${[record.why, ...sentences].filter(Boolean).join(" ")}`;
  },

  pointed(event) {
    const box = byId("innovations").getBoundingClientRect();
    const across = event.clientX - box.left;
    let nearest = null, least = Infinity;
    for (const record of this.shown) {
      const away = Math.abs(this.scale.x(record.sequence) - across);
      if (away < least) [nearest, least] = [record, away];
    }
    if (nearest) this.choose(nearest.sequence);
  },
};
