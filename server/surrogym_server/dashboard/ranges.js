// Numbers with their intervals on one axis: told apart by shape, so that no colour is needed.

import { h } from "/page/dom.js";
import { number } from "/page/format.js";

const WIDEST = 600;
const STEP = 11; // from a mark to the next in a row
const MOST = 1e30; // beyond it, differences overflow
const MARKS = 3; // that a row has room for, at least
const LETTER = 7; // width of one
const HALF_LABEL = 30; // pixels
const PAD = { right: 8, top: 4, bottom: 22 };
const KEY = {
  promise: "promised: 90 % interval", real: "real: mean with 95 % interval", without: "real, without the policy", reference: "real, reference controller",
};

const text = (x, y, said, anchor = "middle") => h("text", { x, y, "text-anchor": anchor }, said);

function shape({ kind, value, low, high }, x, y) {
  const parts = [];
  if (low !== null && low !== undefined) {
    parts.push(kind === "promise"
      ? h("line", { class: "wide", x1: x(low), x2: x(high), y1: y, y2: y })
      : [h("line", { x1: x(low), x2: x(high), y1: y, y2: y }), ...[low, high].map((end) => h("line", { x1: x(end), x2: x(end), y1: y - 5, y2: y + 5 }))]);
  }
  if (kind === "without") parts.push([[-4, -4, 4, 4], [-4, 4, 4, -4]].map(([a, b, c, d]) => h("line", { x1: x(value) + a, y1: y + b, x2: x(value) + c, y2: y + d })));
  else if (kind === "reference") parts.push(h("rect", { x: x(value) - 4, y: y - 4, width: 8, height: 8 }));
  else parts.push(h("circle", { class: kind === "promise" ? "hollow" : "", cx: x(value), cy: y, r: 4.5 }));
  return parts;
}

const within = (value) => value && Math.max(-MOST, Math.min(MOST, value));
const bounded = ({ kind, value, low, high }) => ({ kind, value: within(value), low: within(low), high: within(high) });

/** `rows` are {label, marks: [{kind: "promise" | "real" | "without" | "reference", value, low, high}]}; null where nothing is known. */
export function ranges(rows, label, least = MARKS) {
  const row = 7 + STEP * Math.max(least, ...rows.map(({ marks }) => marks.length));
  rows = rows.map((one) => ({ ...one, marks: one.marks.map(bounded) }));
  const all = rows.flatMap(({ marks }) => marks.flatMap(({ value, low, high }) => [value, low ?? value, high ?? value]));
  if (!all.length) return null;
  const [lowest, most] = [Math.min(...all), Math.max(...all)];
  const span = most - lowest || Math.abs(most) || 1;
  const [from, to] = [lowest - 0.04 * span, most + 0.04 * span];
  const width = Math.min(WIDEST, Math.max(260, window.innerWidth - 60)); // text keeps its size on a phone
  const left = Math.min(170, 0.32 * width);
  const letters = Math.floor(left / LETTER);
  const x = (value) => left + ((width - left - PAD.right) * (value - from)) / (to - from);
  const height = PAD.top + row * rows.length + PAD.bottom;
  const said = rows.map(({ label: who, marks }) => `${who}: ${marks.map(({ kind, value, low, high }) => `${kind} ${number(value)}${low === null || low === undefined ? "" : ` between ${number(low)} and ${number(high)}`}`).join(", ") || "nothing known"}`);
  return h("svg", { class: "ranges", viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": `${label}. ${said.join("; ")}` },
    rows.map(({ label: who, marks }, at) => {
      const top = PAD.top + row * at;
      const label = text(0, top + (row + 6) / 2, who.length > letters ? `${who.slice(0, letters - 1)}…` : who, "start");
      label.append(h("title", {}, who));
      return [label, ...marks.map((mark, which) => shape(mark, x, top + 8 + STEP * which))];
    }),
    h("line", { class: "axis", x1: left, x2: width - PAD.right, y1: height - PAD.bottom, y2: height - PAD.bottom }),
    roundNumbers(from, to).map((value) => text(x(value), height - 6, number(value), x(value) > width - HALF_LABEL ? "end" : "middle")));
}

/** Two to six multiples of 1, 2 or 5 times a power of ten. */
function roundNumbers(from, to) {
  const least = (to - from) / 6;
  const power = 10 ** Math.floor(Math.log10(least));
  const step = power * [1, 2, 5, 10].find((times) => times * power >= least);
  const first = Math.ceil(from / step);
  return Array.from({ length: Math.floor(to / step) - first + 1 }, (_, at) => (first + at) * step);
}

/** What the shapes in these rows mean. */
export function rangesKey(rows) {
  const kinds = new Set(rows.flatMap(({ marks }) => marks.map(({ kind }) => kind)));
  return h("p", { class: "key" }, Object.entries(KEY).filter(([kind]) => kinds.has(kind)).map(([kind, words]) => h("span", { class: `shape ${kind}` }, words)));
}
