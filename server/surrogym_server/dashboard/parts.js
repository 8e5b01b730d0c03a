// Small pieces that several views show.

import { h } from "/page/dom.js";
import { count, MEANING, nines, percent, PHASES, plural } from "/page/format.js";

export function phaseBadge(surrogate) {
  return h("span", { class: `badge ${surrogate.phase}`, title: MEANING[surrogate.phase] },
    PHASES[surrogate.phase] + (surrogate.paused ? ", paused" : ""));
}

/** A bar on the scale of nines: as full as its mark when the index has reached its target. */
export function confidenceMeter(index, target) {
  const mark = 0.72;
  const share = index === null ? 0 : Math.min(1, (mark * nines(index)) / nines(target));
  const fill = h("span", { class: index !== null && index >= target ? "fill good" : "fill" });
  fill.style.width = `${100 * share}%`;
  const tick = h("span", { class: "tick", title: `target ${percent(target)}` });
  tick.style.left = `${100 * mark}%`;
  const label = index === null ? "no model yet" : `confidence index ${percent(index)}, target ${percent(target)}`;
  return h("span", { class: "meter", role: "img", "aria-label": label }, fill, tick);
}

/** Real steps by purpose against the budget. */
export function costBar(ledger, budget) {
  const whole = Math.max(budget, ledger.total, 1);
  const parts = ["initial", "adaptive", "manual"].map((purpose) => {
    const part = h("span", { class: `part ${purpose}` });
    part.style.width = `${(100 * ledger[purpose]) / whole}%`;
    return part;
  });
  const label = `${count(ledger.total)} real steps of a budget of ${count(budget)}`;
  return h("span", { class: "meter cost", role: "img", "aria-label": label }, parts);
}

export const alive = (surrogate) =>
  `${plural(surrogate.samplers.length, "sampler")}, ${plural(surrogate.sessions, "session")}`;

export const section = (id, title, note, ...children) =>
  h("section", { class: "card", id, tabindex: "-1", "aria-labelledby": `${id}-title` },
    h("header", { class: "head" }, h("h2", { id: `${id}-title` }, title), note && h("p", { class: "note" }, note)), children);

/** A table that scrolls within itself where the window is narrow. `columns` are [title, class]. */
export function table(label, columns, rows, empty) {
  if (!rows.length) return h("p", { class: "empty" }, empty);
  const head = h("tr", {}, columns.map(([title, kind]) => h("th", { class: kind, scope: "col" }, title)));
  const body = rows.map((cells) => h("tr", {}, cells.map((cell, at) => h("td", { class: columns[at][1] }, cell))));
  return h("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": label },
    h("table", {}, h("thead", {}, head), h("tbody", {}, body)));
}

/** Lines of returns, as small as a word. */
export function sparkline(values) {
  if (values.length < 2) return null;
  const [low, high] = [Math.min(...values), Math.max(...values)];
  const at = (value, index) => `${(100 * index) / (values.length - 1)},${22 - (20 * (value - low)) / (high - low || 1)}`;
  return h("svg", { class: "spark", viewBox: "0 0 100 24", preserveAspectRatio: "none", "aria-hidden": "true" },
    h("polyline", { points: values.map(at).join(" ") }));
}
