// A specification in words: what a person checks before it is registered.

import { h } from "/page/dom.js";
import { count, number, percent, plural } from "/page/format.js";
import { table } from "/page/parts.js";

/** A distribution, such as "−1 to 1" or "0.5 ± 0.1". */
function spread({ kind, low, high, mean, std, value }) {
  if (kind === "fixed") return number(value);
  if (kind === "normal") return `${number(mean)} ± ${number(std)}`;
  return `${number(low)} to ${number(high)}`;
}

const end = (value) => (value === null || value === undefined ? "no limit" : number(value));
const limits = (bounds) => (bounds && [bounds.low, bounds.high].some((one) => end(one) !== "no limit") ? `${end(bounds.low)} to ${end(bounds.high)}` : "none");

/** A sum of functions of coordinates, such as "cos(theta) + 2 speed". */
export function termWords({ parts, low, high }) {
  const weighted = (weights) => Object.entries(weights).map(([name, weight]) => (weight === 1 ? name : `${number(weight)} ${name}`)).join(" + ");
  const part = ({ function: kind, coefficient, weights }) => {
    if (kind === "one") return number(coefficient);
    const inner = kind === "linear" ? weighted(weights) : `${kind}(${weighted(weights)})`;
    return coefficient === 1 ? inner : `${number(coefficient)} ${kind === "linear" ? `(${inner})` : inner}`;
  };
  const sum = parts.map(part).join(" + ");
  const clipped = [low, high].some((limit) => limit !== null && limit !== undefined);
  return clipped ? `${sum}, clipped to ${end(low)} to ${end(high)}` : sum;
}

const holds = (group) => group.map(({ term, relation, value }) => `${termWords(term)} ${relation} ${number(value)}`).join(" and ");

function endings({ termination, time_limit: limit }) {
  const rules = termination === "learned" ? ["learned from steps that ended an episode"] : termination.map(holds);
  return [...rules, limit && `after ${plural(limit, "step")}`].filter(Boolean).join("; or ") || "never";
}

function actionWords({ kind, low, high, n, nvec }) {
  if (kind === "box") return low.map((least, at) => `${number(least)} to ${number(high[at])}`).join(", ");
  return kind === "discrete" ? `one of ${n}` : `several, of ${nvec.join(", ")}`;
}

const rewardWords = ({ kind, terms }) => (kind === "learned" ? "learned from the real steps" : `declared, with ${plural(terms.length, "term")}`);

/** What an episode must meet to count as a success. */
function successWords({ hold, hold_steps: steps, min_steps: least, terminated, min_return: most }) {
  return [
    hold.length && `${holds(hold)}${steps > 1 ? ` in the last ${plural(steps, "step")}` : " at the end"}`,
    least !== null && `at least ${plural(least, "step")}`,
    terminated !== null && (terminated ? "the episode was ended by a rule" : "no rule ended the episode"),
    most !== null && `a return of at least ${number(most)}`,
  ].filter(Boolean).join("; and ");
}

const fallbackWords = ({ fallback }) => (Array.isArray(fallback) ? fallback.map(termWords).join(", ") : `the program ${fallback.name} at the machine`);

function facts(spec) {
  return [
    ["environment", spec.environment || "an own one"],
    ["action", actionWords(spec.action)],
    ["reward", rewardWords(spec.reward)],
    ["an episode ends", endings(spec)],
    ["a sampler", spec.query === "step" ? "sets the environment to any state" : "resets the environment and acts from there"],
    spec.starts.length && ["episodes start", `at one of ${plural(spec.starts.length, "state")}`],
    spec.success && ["success", successWords(spec.success)],
    spec.limits && ["fallback near a limit", fallbackWords(spec.limits)],
    spec.limits && ["episodes that may leave a limit", percent(spec.limits.probability)],
  ].filter(Boolean);
}

/** Tables of a specification with all its defaults; `design` is {budget, target, initial} where known. */
export function specificationParts(spec, design) {
  const planned = design ? [["budget", `${count(design.budget)} real steps`], ["first queries", `${count(design.initial)} real steps`], ["target", `confidence index ${percent(design.target)}`]] : [];
  return [
    table("Specification", [["", ""], ["", "wide"]], [...facts(spec), ...planned], ""),
    h("h3", {}, "Coordinates: the state that the environment is set to"),
    table("Coordinates", [["name", ""], ["kind", ""], ["unit", ""], ["sampled", ""], ["limits", ""], ["episodes start", ""]],
      spec.coordinates.map(({ name, kind, unit, sampling, bounds }) => [name, kind, unit || "–", spread(sampling), limits(bounds), spread(spec.start[name])]), ""),
    ...(spec.limits ? [h("h3", {}, "Limits: what must not be left, and the margin within which the fallback acts"),
      table("Limits", [["name", ""], ["value", "wide"], ["range", ""], ["margin", "num"], ["unit", ""]],
        spec.limits.keep.map(({ name, term, low, high, margin, unit }) => [name, termWords(term), limits({ low, high }), number(margin), unit || "–"]), "")] : []),
    h("h3", {}, "Observation: what a policy sees"),
    table("Observation", [["name", ""], ["value", "wide"], ["limits", ""]],
      spec.observation.map(({ name, term, low, high }) => [name, termWords(term), limits({ low, high })]), ""),
  ];
}
