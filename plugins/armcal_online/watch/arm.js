"use strict";
// The arm in the base frame, seen from afar, with the residuals at the newest measured tips, enlarged.

const Arm = {
  turn: { around: -0.9, above: 0.42 },
  reach: 0,
  views: { free: { around: -0.9, above: 0.42 }, side: { around: -Math.PI / 2, above: 0 }, top: { around: -Math.PI / 2, above: Math.PI / 2 } },

  look(name) { this.turn = { ...this.views[name] }; },

  turned(across, up) {
    this.turn.around -= across;
    this.turn.above = Math.min(Math.max(this.turn.above + up, -Math.PI / 2), Math.PI / 2);
  },

  projection(width, height, points) {
    const low = [0, 1, 2].map((i) => Math.min(...points.map((p) => p[i])));
    const high = [0, 1, 2].map((i) => Math.max(...points.map((p) => p[i])));
    const middle = low.map((l, i) => (l + high[i]) / 2);
    const radius = Math.max(50, ...points.map((p) => Math.hypot(p[0] - middle[0], p[1] - middle[1], p[2] - middle[2])));
    const scale = (Math.min(width, height) / 2 - 14) / radius;
    const [c, s] = [Math.cos(this.turn.around), Math.sin(this.turn.around)];
    const [ce, se] = [Math.cos(this.turn.above), Math.sin(this.turn.above)];
    const project = (p) => {
      const [x, y, z] = p.map((v, i) => v - middle[i]);
      const right = -s * x + c * y, away = c * x + s * y;
      return [width / 2 + scale * right, height / 2 - scale * (ce * z - se * away)];
    };
    return { project, radius, low, high };
  },

  floor(view) {
    const step = niceStep(view.radius / 4);
    const lines = (i) => {
      const kept = [view.low[i], view.high[i]];
      for (let n = Math.ceil(view.low[i] / step); n * step <= view.high[i]; n++) kept.push(n * step);
      return kept;
    };
    const [x0, x1] = [view.low[0], view.high[0]], [y0, y1] = [view.low[1], view.high[1]];
    let path = "";
    for (const x of lines(0)) path += line([view.project([x, y0, 0]), view.project([x, y1, 0])]);
    for (const y of lines(1)) path += line([view.project([x0, y, 0]), view.project([x1, y, 0])]);
    return { step, parts: [svg("path", { class: "rule", d: path })] };
  },

  frame(view, size) {
    const parts = [];
    [[size, 0, 0], [0, size, 0], [0, 0, size]].forEach((end, i) => {
      const tip = view.project(end), label = view.project(end.map((v) => v * 1.2));
      parts.push(svg("path", { class: `frame frame-${"xyz"[i]}`, d: line([view.project([0, 0, 0]), tip]) }));
      parts.push(svg("text", { x: at(label[0]), y: at(label[1] + 4), "text-anchor": "middle" }, "xyz"[i]));
    });
    return parts;
  },

  arrow(from, to) {
    const [dx, dy] = [to[0] - from[0], to[1] - from[1]];
    const long = Math.hypot(dx, dy);
    let path = line([from, to]);
    if (long > 5) {
      const [ux, uy] = [dx / long, dy / long];
      for (const side of [1, -1]) path += line([to, [to[0] - 5 * ux + side * 3 * uy, to[1] - 5 * uy - side * 3 * ux]]);
    }
    return path;
  },

  enlarged(tips, radius) {
    const sizes = tips.map((r) => length3(r.residual_mm)).filter((x) => x > 0).sort((a, b) => a - b);
    if (!sizes.length) return 0;
    const typical = sizes[Math.floor((sizes.length - 1) * 0.5)];
    return niceStep(radius / 9 / typical / 2);
  },

  limbs(view, points) {
    const parts = [];
    for (const chain of Object.values(points)) {
      const placed = chain.map(view.project);
      parts.push(svg("path", { class: "limb", d: line(placed) }));
      for (const [x, y] of placed.slice(1, -1)) parts.push(svg("circle", { class: "joint", cx: at(x), cy: at(y), r: 4.5 }));
    }
    return parts;
  },

  tips(view, tips, factor) {
    const parts = [];
    const limit = view.radius * 0.6;
    for (const record of tips) {
      const start = record.predicted_mm || record.measured_mm.map((v, i) => v - record.residual_mm[i]);
      const shrink = Math.min(1, limit / Math.max(factor * length3(record.residual_mm), 1e-9));
      const end = start.map((v, i) => v + factor * shrink * record.residual_mm[i]);
      const [x, y] = view.project(start);
      parts.push(svg("circle", { class: `tip ${record.verdict}`, cx: at(x), cy: at(y), r: 2.2 }));
      parts.push(svg("path", { class: `arrow ${record.verdict}`, d: this.arrow([x, y], view.project(end)) }));
    }
    return parts;
  },

  caption(tips, factor, drawn, step) {
    const parts = [];
    if (tips.length) parts.push(`Arrows: residuals (measured less predicted) at the newest ${tips.length} measured tips, enlarged ${count(factor)} times; very long ones are cut short.`);
    if (drawn.fault) parts.push(`The arm is not drawn: ${drawn.fault}`);
    else if (!Object.keys(drawn.points_mm || {}).length) parts.push("The arm is drawn once there are a calibration and a record with all joint angles.");
    else parts.push(`The arm at record ${drawn.sequence}. The floor's squares are ${digits(step)} mm wide.`);
    return parts.join(" ");
  },

  draw(records, drawn, most) {
    const host = byId("arm");
    const width = Math.max(host.clientWidth, 260), height = Math.min(width * 0.8, 430);
    const tips = records.filter((r) => r.measured_mm && r.residual_mm).slice(-most);
    const points = drawn.points_mm || {};
    const seen = [[0, 0, 0], ...Object.values(points).flat(), ...tips.map((r) => r.measured_mm)];
    const view = this.projection(width, height, [...seen, ...seen.map((p) => [p[0], p[1], 0])]);
    const factor = this.enlarged(tips, view.radius);
    const floor = this.floor(view);
    const parts = [...floor.parts, ...this.frame(view, view.radius / 4), ...this.limbs(view, points)];
    const newest = tips[tips.length - 1];
    const chains = Object.values(points);
    if (newest && chains.length === 1 && newest.sequence === drawn.sequence) {
      const tool = chains[0][chains[0].length - 1];
      parts.push(svg("path", { class: "hand", d: line([view.project(tool), view.project(newest.predicted_mm || newest.measured_mm)]) }));
    }
    parts.push(...this.tips(view, tips, factor));
    if (newest) parts.push(svg("path", { class: "newest", d: rings([view.project(newest.measured_mm)], 6) }));
    host.replaceChildren(svg("svg", { viewBox: `0 0 ${width} ${height}`, height }, ...parts));
    say("arm-caption", this.caption(tips, factor, drawn, floor.step));
  },
};
