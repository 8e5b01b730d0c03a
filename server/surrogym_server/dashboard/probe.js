// The probe: what the model says of one step from the point, and of episodes from there.

import { call, Problem, surrogate } from "/page/api.js";
import { episodeCharts } from "/page/charts.js";
import { debounced, h, newest, shown } from "/page/dom.js";
import { number } from "/page/format.js";
import { table } from "/page/parts.js";

const DRAWS = 12;

export function probe(name, spec, controls, { onepisodes, ask }) {
  const { ranges, entries, point } = controls;
  const answer = h("div", { class: "answer", "aria-live": "polite" }, h("p", { class: "empty" }, "The probe needs a model. There is none yet."));
  const charts = episodeCharts(ranges);
  const steps = h("input", { type: "number", min: 1, max: 500, value: Math.min(60, spec.time_limit ?? 60), "aria-label": "steps of the episode" });
  const how = h("select", { "aria-label": "actions of the episode" }, h("option", { value: "hold" }, "this action held"), h("option", { value: "random" }, "random actions"));
  const episode = h("p", { class: "note" });
  const trouble = h("p", { class: "bad", role: "alert" });
  let ready = false;

  const render = shown(answer, ({ now, said, doubt, tolerances }) => {
    const index = new Map(doubt.outputs.map((output, at) => [output, at]));
    const deviation = (of) => (index.has(of) ? `± ${number(doubt.deviation[0][index.get(of)], 2)}` : "exact");
    const judged = (of) => {
      if (!index.has(of)) return "";
      const times = doubt.deviation[0][index.get(of)] / tolerances[index.get(of)];
      return h("span", { class: times <= 1 ? "good" : "bad" }, times <= 1 ? "within tolerance" : `${number(times, 2)} tolerances`);
    };
    const rows = ranges.map((range, at) => [range.name, number(now[at]), number(said.next_coordinates[0][at], 4), deviation(range.name), judged(range.name)]);
    rows.push(["reward", "", number(said.reward[0], 4), `± ${number(said.reward_deviation[0], 2)}`, judged("reward")]);
    return [
      table("Predicted step", [["", ""], ["now", "num"], ["after one step", "num"], ["deviation", "num"], ["", ""]], rows, ""),
      said.terminated[0] && h("p", { class: "bad" }, "The episode would end here."),
    ].filter(Boolean);
  });

  const step = newest(async (signal, tolerances) => {
    const now = [...point.coordinates];
    const body = { coordinates: [now], action: [[...point.action]] };
    const [said, doubt] = await Promise.all(["predict", "query_uncertainty"].map((what) => call("POST", `${surrogate(name)}/${what}`, body, signal)));
    render({ now, said, doubt, tolerances });
  });

  const roll = newest(async (signal) => {
    const length = Math.min(500, Math.max(1, Math.round(Number(steps.value) || 60)));
    const drawn = ({ low, high, n }) => (n ? Math.floor(Math.random() * n) : low + Math.random() * (high - low));
    const actions = Array.from({ length }, () => (how.value === "hold" ? [...point.action] : entries.map(drawn)));
    const imagined = await call("POST", `${surrogate(name)}/imagine`, { coordinates: [...point.coordinates], actions, draws: DRAWS, seed: 0 }, signal);
    charts.show(imagined);
    onepisodes([...imagined.draws.map(({ coordinates }) => ({ coordinates })), { coordinates: imagined.mean.coordinates, mean: true }]);
    const total = imagined.mean.reward.reduce((sum, value) => sum + value, 0);
    episode.textContent = `Imagined return of the mean over ${imagined.mean.reward.length} steps: ${number(total, 4)}${imagined.mean.terminated ? ", then it ends" : ""}. Thin lines: ${DRAWS} functions drawn from the posterior.`;
  });

  const refused = (error) => {
    if (error instanceof Problem) trouble.textContent = error.message;
    else ready = false; // the server is away, which has a banner of its own; the next look asks again
  };
  const askStep = debounced(80, (tolerances) => step(tolerances).catch(refused));
  const askRoll = debounced(350, () => roll().catch(refused));
  let tolerances = [];
  const run = () => { trouble.textContent = ""; if (ready) { askStep(tolerances); askRoll(); } };
  steps.addEventListener("input", run);
  how.addEventListener("change", run);

  return {
    parts: [
      trouble,
      h("div", { class: "probe" }, answer,
        ask && h("button", { type: "button", class: "main", onclick: () => ask(point) }, "Request this real step")),
      h("div", { class: "rolled" }, h("h3", {}, "An episode from there"),
        h("div", { class: "picks" }, h("label", { class: "pick" }, "steps", steps), h("label", { class: "pick" }, "with", how)),
        episode, charts.place),
    ],
    moved: run,
    show({ fidelity, version }) {
      if (!fidelity || version === ready) return;
      tolerances = fidelity.outputs.map((output) => output.tolerance);
      ready = version;
      run();
    },
    repaint: charts.repaint,
    close: charts.close,
  };
}
