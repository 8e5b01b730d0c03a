// Uncertainty, occupancy and index over two coordinates, the others as the point has them.

import { call, surrogate } from "/page/api.js";
import { debounced, h, newest } from "/page/dom.js";
import { number } from "/page/format.js";
import { heatMap } from "/page/heat.js";

const SIZE = 33;
const DECADES = 6; // of the index: what lies further below its highest value is nothing
const WORST = "the worst output";
const LOG_10 = Math.log(10);

const MOST_MARKS = 400;
const NOTHING = -9; // decades of the index below which nothing is worth a real step

/** At most so many samples, evenly chosen and the newest among them: more would hide the map. */
function thinned(samples) {
  const every = Math.ceil(samples.length / MOST_MARKS);
  return every > 1 ? samples.filter((_, at) => (samples.length - 1 - at) % every === 0) : samples;
}

const largest = (rows) => rows.map((row) => Math.max(...row));

export function maps(name, spec, controls) {
  const { ranges, point } = controls;
  const state = { said: null, samples: [], tolerances: [], outputs: [], paths: [], version: null };
  const names = ranges.map((range) => range.name);
  const pick = (label, options, value) => {
    const select = h("select", {}, options.map((option, at) => h("option", { value: at }, option)));
    select.value = value;
    select.addEventListener("change", () => ask());
    return { select, label: h("label", { class: "pick" }, label, select) };
  };
  const moving = ranges.flatMap((range, at) => (range.kind === "constant" || range.lag ? [] : [at]));
  const x = pick("across", names, moving[0] ?? 0);
  const y = pick("up", names, moving[1] ?? moving[0] ?? 0);
  const output = h("select", {}, h("option", { value: -1 }, WORST));
  output.addEventListener("change", () => draw());
  const onpoint = (px, py) => {
    const moved = [...point.coordinates];
    moved[x.select.value] = px;
    if (x.select.value !== y.select.value) moved[y.select.value] = py;
    controls.move(moved);
  };
  const marks = h("input", { type: "checkbox", checked: true });
  const many = h("span", { class: "note" });
  marks.addEventListener("change", () => draw());
  const kinds = {
    uncertainty: heatMap({ name: "uncertainty", title: "Uncertainty, in tolerances", onpoint }),
    occupancy: heatMap({ name: "occupancy", title: "Occupancy: where policies go", onpoint }),
    index: heatMap({ name: "index", title: "Index: where to look next", onpoint }),
  };

  const fetchMap = newest(async (signal) => {
    const [across, up] = [Number(x.select.value), Number(y.select.value)];
    const at = (range, step) => range.low + ((range.high - range.low) * step) / (SIZE - 1);
    const coordinates = Array.from({ length: SIZE * SIZE }, (_, cell) => {
      const q = [...point.coordinates];
      q[up] = at(ranges[up], Math.floor(cell / SIZE));
      q[across] = at(ranges[across], cell % SIZE);
      return q;
    });
    const action = coordinates.map(() => point.action);
    state.said = await call("POST", `${surrogate(name)}/query_uncertainty`, { coordinates, action }, signal);
    draw();
  });
  const ask = debounced(120, async () => {
    if (state.version === null) return;
    try {
      await fetchMap();
    } catch {
      state.version = null; // the next look asks again
    }
  });

  function draw() {
    const [across, up, which] = [x.select, y.select, output].map((select) => Number(select.value));
    const chosen = (rows) => (which < 0 ? largest(rows) : rows.map((row) => row[which]));
    const base = {
      x: ranges[across], y: ranges[up], size: SIZE, paths: state.paths.map(({ coordinates, mean }) => ({ mean, points: coordinates.map((q) => [q[across], q[up]]) })),
      samples: marks.checked ? thinned(state.samples).map(({ coordinates, purpose }) => ({ x: coordinates[across], y: coordinates[up], purpose })) : [],
      point: { x: point.coordinates[across], y: point.coordinates[up] },
    };
    const show = (kind, values, [low, high], [lowText, highText], remark) =>
      kinds[kind].show({ ...base, values, low, high, lowText, highText, remark });
    if (!state.said) {
      for (const kind of Object.keys(kinds)) show(kind, null, [0, 1], ["", ""], state.version === null ? "No model yet." : "Waiting for the model…");
      return;
    }
    const { deviation, input_probability: occupancy, log_uncertainty_index: index } = state.said;
    const ratio = chosen(deviation.map((row) => row.map((value, at) => value / state.tolerances[at])));
    show("uncertainty", ratio.map((value) => Math.log10(Math.max(value, 1e-9))), [-1, 1], ["≤ 0.1", "≥ 10"],
      `Up to ${number(Math.max(...ratio), 2)} of the tolerance on this cut.`);
    const visited = occupancy.map((row) => row[0]);
    const [least, most] = [Math.min(...visited), Math.max(...visited)];
    kinds.occupancy.figure.hidden = most - least < 1e-9; // the same everywhere: no training has submitted its states
    show("occupancy", visited, [0, most], ["never", "often"], "States visited by the training that submitted its states last.");
    const log = chosen(index).map((value) => value / LOG_10);
    const high = Math.max(...log);
    if (high < NOTHING) show("index", null, [0, 1], ["least", "most"], "No real step is needed on this cut: the whole cut is far within tolerance.");
    else show("index", log, [high - DECADES, high], ["a millionth", "the most"], "Relative to the highest index on this cut (eq. 12), on a logarithmic scale.");
  }

  return {
    parts: [
      h("div", { class: "picks cuts" }, x.label, y.label, h("label", { class: "pick" }, "of", output)),
      h("p", { class: "key" },
        ["initial", "adaptive", "manual"].map((purpose) => h("span", { class: `mark ${purpose}` }, purpose)),
        h("label", { class: "pick" }, marks, "show samples"), many,
        h("span", { class: "mark cross" }, "the point"), h("span", { class: "mark path" }, "episodes from there")),
      h("div", { class: "maps" }, Object.values(kinds).map((kind) => kind.figure)),
    ],
    moved: () => { draw(); ask(); },
    show({ samples, fidelity, version }) {
      state.samples = samples;
      many.textContent = samples.length > MOST_MARKS ? `${thinned(samples).length} of ${samples.length} are shown.` : "";
      if (fidelity && version !== state.version) {
        state.tolerances = fidelity.outputs.map((entry) => entry.tolerance);
        const kept = output.value;
        output.replaceChildren(h("option", { value: -1 }, WORST), ...fidelity.outputs.map((entry, at) => h("option", { value: at }, entry.name)));
        output.value = kept;
        state.version = version;
        ask();
      }
      draw();
    },
    paths(episodes) { state.paths = episodes; draw(); },
    repaint: draw,
    close: () => Object.values(kinds).forEach((kind) => kind.close()),
  };
}
