// The two forms of what a worker is asked to do. What they send is numbers and words from fixed lists.

import { h } from "/page/dom.js";
import { count } from "/page/format.js";

const ALGORITHMS = ["fastppo", "ppo", "a2c", "sac", "td3", "ddpg", "dqn", "cmaes"];
const EPISODES = 20;


/** A label beside its input. */
function field(label, input) {
  input.id = `work-${label.toLowerCase().replaceAll(" ", "-")}`;
  return h("div", { class: "field" }, h("label", { for: input.id }, label), input);
}

const select = (options) => h("select", {}, options.map(([value, text]) => h("option", { value }, text)));
const whole = (properties) => h("input", { type: "number", step: 1, ...properties });
const numberOf = (input) => (input.value === "" ? null : Number(input.value));

function form(title, fields, button, submit) {
  const inside = h("fieldset", { class: "point" }, h("legend", {}, title), fields, h("div", { class: "buttons" }, button));
  const element = h("form", {}, inside);
  element.addEventListener("submit", (event) => {
    event.preventDefault();
    submit();
  });
  return { element, enable: (ready) => { inside.disabled = !ready; } };
}

export function trainingForm(start) {
  const algorithm = select([["", "default"], ...ALGORITHMS.map((name) => [name, name])]);
  const length = select([["default", "as the algorithm suggests"], ["quick", "quick: a quarter of that"], ["steps", "so many virtual steps"]]);
  const steps = whole({ min: 1, max: 10_000_000, value: 100_000 });
  const seed = whole({ min: 0, max: 2 ** 31 - 1, value: 0, required: true });
  const audit = h("input", { type: "checkbox", checked: true });
  const counted = field("Virtual steps", steps);
  const adapt = () => { counted.hidden = length.value !== "steps"; steps.required = !counted.hidden; };
  length.addEventListener("change", adapt);
  adapt();
  const parts = form("Train a policy", [
    field("Algorithm", algorithm), field("Length", length), counted, field("Seed", seed),
    h("label", { class: "check" }, audit, h("span", {}, "Audit by a few real steps, if a sampler is connected")),
  ], h("button", { class: "main" }, "Start training"), () => start({
    kind: "train",
    algorithm: algorithm.value || null,
    preset: length.value === "quick" ? "quick" : "default",
    steps: length.value === "steps" ? numberOf(steps) : null,
    seed: numberOf(seed),
    audit: audit.checked,
  }));
  return { element: parts.element, show: ({ ready }) => parts.enable(ready) };
}

export function evaluationForm(start) {
  const policy = h("select", {});
  const episodes = whole({ min: 1, value: EPISODES, required: true });
  const compare = select([["", "nothing"], ["zero", "an action of zero"], ["random", "random actions"]]);
  const reference = h("input", { type: "checkbox" });
  const controlled = h("label", { class: "check", hidden: true }, reference, h("span", {}, "Also run the same starts with the worker's reference controller"));
  const video = h("input", { type: "checkbox" });
  const starts = select([["", "as declared"], ["wide", "anywhere in the sampling range"]]);
  const cost = h("p", { class: "note" });
  let now = { most: 0, limit: null };
  const adapt = () => {
    const times = 1 + Boolean(compare.value) + reference.checked;
    episodes.max = Math.max(1, Math.floor(now.most / times));
    const all = times * (numberOf(episodes) ?? 0);
    cost.textContent = now.limit === null ? `${count(all)} episodes of the original environment.` : `${count(all)} episodes of the original environment: up to ${count(all * now.limit)} real steps.`;
  };
  for (const input of [episodes, compare, reference]) input.addEventListener("input", adapt);
  const parts = form("Evaluate a policy", [field("Policy", policy), field("Real episodes", episodes), field("Starts", starts), field("Compare with", compare), controlled,
    h("label", { class: "check" }, video, h("span", {}, "Draw a video of the best, the median and the worst episode, if the environment can be drawn")), cost],
    h("button", { class: "main" }, "Evaluate"), () => start({
      kind: "evaluate",
      policy: policy.value,
      episodes: numberOf(episodes),
      wide: starts.value === "wide",
      compare: compare.value || null,
      ...(reference.checked && { reference: true }),
      ...(video.checked && { video: true }),
    }));
  let listed = null;
  let newest = "";
  return {
    element: parts.element,
    show({ ready, most, policies, limit, reference: offered }) {
      const names = policies.map(({ version, aliases }) => [String(version), [`version ${version}`, ...aliases].join(", ")]);
      if (JSON.stringify(names) !== listed) {
        listed = JSON.stringify(names);
        const kept = policy.value === newest ? names[0]?.[0] ?? "" : policy.value; // whoever had the newest gets the newest
        newest = names[0]?.[0] ?? "";
        policy.replaceChildren(...names.map(([value, text]) => h("option", { value }, text)));
        if (names.some(([value]) => value === kept)) policy.value = kept;
      }
      if (most && !now.most) episodes.value = Math.min(EPISODES, most);
      now = { most, limit };
      controlled.hidden = !offered;
      if (!offered) reference.checked = false;
      adapt();
      parts.enable(ready);
    },
  };
}
