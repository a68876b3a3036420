"use strict";
// Small multiples: each parameter's change since the start with its 95 % band, in the unit people read.

const BAND = 1.96, MOVED = 3, LEAST = 6;

const Parameters = {
  latest(rows, index) {
    for (let i = rows.length - 1; i >= 0; i--) if (isNumber(rows[i].change[index])) return rows[i];
    return null;
  },

  moved(parameter, change) {
    return parameter.start_sd > 0 && isNumber(change) ? Math.abs(change) / parameter.start_sd : 0;
  },

  // Two digits of the band, and as many decimals of everything beside it.
  fixed(sd) {
    const decimals = sd > 0 ? Math.min(Math.max(1 - Math.floor(Math.log10(BAND * sd)), 0), 12) : 6;
    return (x) => (sd > 0 || x === 0 ? x.toFixed(decimals) : digits(x, 6));
  },

  draw(estimates, events) {
    const wanted = byId("filter").value.trim().toLowerCase();
    const all = estimates.parameters.map((parameter, index) => {
      const row = this.latest(estimates.rows, index);
      const change = row ? row.change[index] : null;
      return { parameter, index, change, sd: row ? row.sd[index] : null, ratio: this.moved(parameter, change) };
    });
    const chosen = all.filter((shown) => shown.parameter.name.toLowerCase().includes(wanted));
    chosen.sort((a, b) => b.ratio - a.ratio);
    const first = wanted ? chosen.length : Math.max(LEAST, chosen.filter((shown) => shown.ratio > MOVED).length);
    const cards = (some) => some.map((shown) => this.card(shown, estimates.rows, events));
    const others = chosen.slice(first);
    say("parameter-count", all.length ? `${chosen.length} of ${all.length}` : "none known yet");
    byId("parameters").replaceChildren(...cards(chosen.slice(0, first)));
    byId("others").hidden = !others.length;
    say("others-count", `The other ${others.length}, which moved by less than ${MOVED} sd`);
    byId("parameters-others").replaceChildren(...cards(others));
  },

  card(shown, rows, events) {
    const { parameter, index, change, sd, ratio } = shown;
    const unit = parameter.unit ? ` ${parameter.unit}` : "";
    const fixed = this.fixed(isNumber(sd) ? sd : parameter.start_sd);
    const band = isNumber(sd) ? ` \u00b1 ${fixed(BAND * sd)}` : "";
    const sized = ratio >= 0.05 ? `; moved ${digits(ratio, 2)} sd` : "";
    const now = isNumber(change) ? `${change >= 0 ? "+" : ""}${fixed(change)}${band}${unit}` : "not estimated yet";
    const value = `${isNumber(change) ? "now" : "start"} ${fixed(parameter.start + (change || 0))}${unit}${sized}`;
    const trace = this.trace(rows, index, events);
    return html("div", { class: ratio > MOVED ? "parameter moved" : "parameter" },
      html("span", { class: "name" }, parameter.name),
      html("span", { class: "now" }, now), html("small", { class: "value" }, value),
      html("div", { class: "trace" }, trace.picture,
        html("div", { class: "ends" }, html("span", {}, signed(trace.high, 2)), html("span", {}, signed(trace.low, 2)))));
  },

  trace(rows, index, events) {
    const points = rows.filter((r) => isNumber(r.change[index]));
    const spread = (r) => BAND * (isNumber(r.sd[index]) ? r.sd[index] : 0);
    let low = 0, high = 0;
    for (const r of points) {
      low = Math.min(low, r.change[index] - spread(r));
      high = Math.max(high, r.change[index] + spread(r));
    }
    if (!(high > low)) [low, high] = [-1e-6, 1e-6];
    const first = rows.length ? rows[0].sequence : 0, last = rows.length ? rows[rows.length - 1].sequence : 1;
    const x = (n) => 2 + ((n - first) / Math.max(last - first, 1)) * 236;
    const y = (v) => 70 - ((v - low) / (high - low)) * 66;
    const upper = points.map((r) => [x(r.sequence), y(r.change[index] + spread(r))]);
    const lower = points.map((r) => [x(r.sequence), y(r.change[index] - spread(r))]).reverse();
    const marks = events.filter((e) => e.event === "decision" && e.sequence >= first && e.sequence <= last);
    const picture = svg("svg", { viewBox: "0 0 240 74", preserveAspectRatio: "none", "aria-hidden": "true" },
      svg("path", { class: "zero", d: `M0 ${at(y(0))}H240` }),
      svg("path", { class: "decision", d: marks.map((e) => `M${at(x(e.sequence))} 0V74`).join("") }),
      svg("path", { class: "band", d: upper.length ? `${line([...upper, ...lower])}Z` : "" }),
      svg("path", { class: "line", d: line(points.map((r) => [x(r.sequence), y(r.change[index])])) }));
    return { picture, low, high };
  },
};
