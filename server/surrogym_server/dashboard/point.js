// One state and one action, typed, slid or clicked: what the maps are cut through, and what the probe asks about.

import { h } from "/page/dom.js";
import { number } from "/page/format.js";

const STEPS = 400;

/** The range of a coordinate: where it is sampled, or four deviations of a normal start. */
export function range({ name, kind, sampling, bounds }) {
  let [low, high] = [sampling.low, sampling.high];
  if (sampling.kind === "fixed") [low, high] = [sampling.value - 1, sampling.value + 1];
  if (sampling.kind === "normal") [low, high] = [sampling.mean - 4 * sampling.std, sampling.mean + 4 * sampling.std];
  return { name, kind, low: Math.max(low, bounds?.low ?? -Infinity), high: Math.min(high, bounds?.high ?? Infinity) };
}

/** What a policy may do, entry by entry: {name, low, high} of a box, {name, n} of a choice. */
export function actionEntries(action) {
  const label = (at, many) => (many > 1 ? `action ${at + 1}` : "action");
  if (action.kind === "box") return action.low.map((low, at) => ({ name: label(at, action.low.length), low, high: action.high[at] }));
  const choices = action.kind === "discrete" ? [action.n] : action.nvec;
  return choices.map((n, at) => ({ name: label(at, choices.length), n }));
}

/** Controls for a point; `onchange` is called after each change by hand. */
export function pointControls(spec, onchange) {
  const ranges = spec.coordinates.map(range);
  const entries = actionEntries(spec.action);
  const point = {
    coordinates: ranges.map(({ low, high }) => (low + high) / 2),
    action: entries.map(({ low, high, n }) => (n ? 0 : (low + high) / 2)),
  };
  const rows = [
    ...ranges.map((entry, at) => slider(entry, point.coordinates, at)),
    ...entries.map((entry, at) => (entry.n ? choice(entry, point.action, at) : slider(entry, point.action, at))),
  ];

  function slider({ name, low, high }, values, at) {
    const attributes = { min: low, max: high, step: "any" };
    const track = h("input", { type: "range", ...attributes, step: (high - low) / STEPS, "aria-label": name });
    const field = h("input", { type: "number", ...attributes, "aria-label": `${name}, as a number` });
    const row = h("div", { class: "slider" }, h("span", {}, name), track, field);
    const show = () => {
      track.value = values[at];
      if (document.activeElement !== field) field.value = Number(values[at].toPrecision(4));
    };
    for (const input of [track, field]) {
      input.addEventListener("input", () => {
        if (input.value === "" || !input.checkValidity()) return;
        values[at] = Number(input.value);
        show();
        onchange();
      });
    }
    field.addEventListener("change", show);
    show();
    return { row, show };
  }

  function choice({ name, n }, values, at) {
    const select = h("select", { "aria-label": name }, [...Array(n).keys()].map((value) => h("option", { value }, String(value))));
    select.addEventListener("change", () => { values[at] = Number(select.value); onchange(); });
    return { row: h("div", { class: "slider" }, h("span", {}, name), select), show: () => { select.value = values[at]; } };
  }

  return {
    ranges, entries, point,
    form: h("fieldset", { class: "point" }, h("legend", {}, "State and action"), rows.map(({ row }) => row)),
    move(coordinates, action = point.action) {
      coordinates.forEach((value, at) => { point.coordinates[at] = value; });
      action.forEach((value, at) => { point.action[at] = value; });
      rows.forEach(({ show }) => show());
      onchange();
    },
  };
}

export const told = (names, values) => names.map((name, at) => `${name} = ${number(values[at])}`).join(", ");
