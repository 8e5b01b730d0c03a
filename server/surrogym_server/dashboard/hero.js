// The first ten seconds: how sure, where not, and what it cost.

import { call, surrogate } from "/page/api.js";
import { h } from "/page/dom.js";
import { count, MEANING, number, percent, plural } from "/page/format.js";
import { confidenceMeter, costBar } from "/page/parts.js";
import { told } from "/page/point.js";

const LOOKS = 768;
const NUMBERS = 2_500; // in a request, whose body may have 64 KiB

const card = (title, ...children) => h("div", { class: "card fact" }, h("h2", {}, title), children);

/** The same points for everybody: a Halton sequence over the box of states and actions. */
function points(entries) {
  const bases = [2, 3, 5, 7, 11, 13, 17, 19, 23, 29, 31, 37, 41, 43, 47, 53];
  const share = (index, base) => {
    let [value, weight] = [0, 1];
    for (let rest = index; rest > 0; rest = Math.floor(rest / base)) value += (weight /= base) * (rest % base);
    return value;
  };
  return Array.from({ length: LOOKS }, (_, index) =>
    entries.map(({ low, high, n }, at) => {
      const part = at < bases.length ? share(index + 1, bases[at]) : Math.random();
      return n ? Math.floor(part * n) : low + part * (high - low);
    }));
}

/** Where the model is least sure, in tolerances: {output, times, within, coordinates, action}. */
export async function leastSure(name, fidelity, { ranges, entries }) {
  const rows = points([...ranges, ...entries]);
  const [coordinates, action] = [rows.map((row) => row.slice(0, ranges.length)), rows.map((row) => row.slice(ranges.length))];
  const each = Math.max(Math.floor(NUMBERS / rows[0].length), 1);
  const said = { deviation: [] };
  for (let at = 0; at < rows.length; at += each) {
    const part = { coordinates: coordinates.slice(at, at + each), action: action.slice(at, at + each) };
    const { outputs, deviation } = await call("POST", `${surrogate(name)}/query_uncertainty`, part);
    said.outputs = outputs;
    said.deviation.push(...deviation);
  }
  const worst = said.deviation.map((row) => row.map((value, at) => value / fidelity.outputs[at].tolerance));
  let [at, output] = [0, 0];
  worst.forEach((row, index) => row.forEach((value, which) => { if (value > worst[at][output]) [at, output] = [index, which]; }));
  const within = worst.filter((row) => Math.max(...row) <= 1).length / worst.length;
  return { output: said.outputs[output], times: worst[at][output], within, coordinates: coordinates[at], action: action[at] };
}

export function sure({ confidence_index: index, target, fidelity, phase, error }) {
  if (index === null) return card("How sure", h("p", { class: "big" }, "no model yet"), h("p", { class: "note" }, error ?? MEANING[phase]));
  const least = fidelity.outputs.reduce((a, b) => (b.confidence_index < a.confidence_index ? b : a));
  return card("How sure",
    h("p", { class: index >= target ? "big good" : "big" }, percent(index)), confidenceMeter(index, target),
    h("p", { class: "note" }, `${index >= target ? "Above" : "Below"} the target of ${percent(target)}. Least certain output: ${least.name}.`),
    h("p", { class: error ? "bad" : "note" }, error ?? `${MEANING[phase][0].toUpperCase()}${MEANING[phase].slice(1)}.`));
}

export function where(found, names, onshow, model) {
  if (!found && model) return card("Where it is unsure", h("p", { class: "big" }, "looking…"), h("p", { class: "note" }, `The model is being evaluated at ${LOOKS} points.`));
  if (!found) return card("Where it is unsure", h("p", { class: "big" }, "everywhere"), h("p", { class: "note" }, "There is no model yet."));
  const { times, within, output, coordinates, action } = found;
  const place = `${told(names, coordinates)}, action ${action.map((value) => number(value, 2)).join(", ")}`;
  return card("Where it is unsure",
    h("p", { class: times <= 1 ? "big good" : "big" }, `${count(Math.round((1 - within) * LOOKS))} of ${LOOKS} points`),
    h("p", { class: "note" }, times <= 1
      ? `All of them are within tolerance. Largest uncertainty: ${output}, ${number(times, 2)} of its tolerance.`
      : `are beyond tolerance. Largest uncertainty: ${output}, ${number(times, 2)} times its tolerance.`),
    h("p", { class: "note" }, `Least certain near ${place}. `, h("button", { type: "button", class: "link", onclick: () => onshow(coordinates, action) }, "Show it")));
}

/** What the first real steps show of a machine that can only be reset, as `surrogym doctor --history` says it. */
export function machine(findings) {
  return findings.length > 0 && card("What the machine has", findings.map(({ name, said }) => h("p", { class: "note" }, `${name}: ${said}`)));
}

/** What a simulator or another surrogate told the model: its calibrated parameters, its error, and the outputs that use it. */
export function prior({ awaited, about }, fidelity) {
  if (awaited) return card("What was known", h("p", { class: "note" }, "The design waits for its prior."));
  if (!about) return null;
  const uses = (fidelity?.outputs ?? []).filter((output) => output.structure.startsWith("prior + ")).map((output) => output.name);
  return card("What was known", [
    `Prior: ${about.source}`,
    ...about.parameters.map((one) => `${one.name}: ${number(one.value)}, ${one.determined ? `${number(one.low)} to ${number(one.high)}` : "not determined by these steps"}`),
    ...(about.error === null ? [] : [`Error of the simulator: ${percent(about.error)} of the changes, on ${plural(about.real_steps, "real step")}${about.failed_steps ? `; it fails at ${count(about.failed_steps)} others` : ""}`]),
    ...(fidelity ? [`Outputs that use it: ${uses.join(", ") || "none"}`] : []),
  ].map((line) => h("p", { class: "note" }, line)));
}

export function cost({ ledger, budget, queries }) {
  const open = queries.pending + queries.leased;
  return card("What it cost",
    h("p", { class: "big" }, plural(ledger.total, "real step")), costBar(ledger, budget),
    h("p", { class: "note" }, `${count(ledger.initial)} initial, ${count(ledger.adaptive)} adaptive${ledger.manual ? `, ${count(ledger.manual)} by hand` : ""}; the budget is ${count(budget)}${ledger.logged ? `; ${count(ledger.logged)} more came from a log, at no cost` : ""}${open ? `; ${count(open)} ${open === 1 ? "query is" : "queries are"} open` : ""}.`),
    h("p", { class: "note" }, `${ledger.unresolved ? `At most ${count(ledger.unresolved)} more may have been taken under leases that failed or expired. ` : ""}Evaluation, counted separately: ${count(ledger.evaluation)}.`));
}
