// Everything that the page shows of a surrogate, as files.

import { download, save, surrogate } from "/page/api.js";
import { h } from "/page/dom.js";
import { section } from "/page/parts.js";

export function downloads(name) {
  const url = surrogate(name);
  const trouble = h("p", { class: "bad", role: "alert", hidden: true });
  let now = null;

  const button = (words, work) => h("button", { type: "button", onclick: async () => {
    trouble.hidden = true;
    try {
      await work();
    } catch (error) {
      trouble.hidden = false;
      trouble.textContent = error.message;
    }
  } }, words);
  const file = (words, route, kind) => button(words, () => download(`${url}${route}`, `${name}-${kind}`));

  const model = button("Newest model (safetensors)", () => download(`${url}/models/${now.model_version}?format=safetensors`, `${name}-model-${now.model_version}.safetensors`));
  const element = section("downloads", "Downloads", "Everything that this page shows, as files. Policies and their episodes are with each policy.",
    h("div", { class: "buttons" },
      button("Specification (JSON)", () => save(new Blob([`${JSON.stringify(now.spec, null, 2)}\n`], { type: "application/json" }), `${name}-specification.json`)),
      file("Real steps (CSV)", "/samples?format=csv", "samples.csv"),
      file("Real steps (NPZ)", "/samples?format=npz", "samples.npz"),
      file("State and ledger (JSON)", "", "surrogate.json"),
      file("Queue (JSON)", "/queries", "queries.json"),
      file("Model versions (JSON)", "/models", "models.json"),
      model,
      file("Policies and evaluations (JSON)", "/policies", "policies.json")),
    trouble, h("p", { class: "note" }, "One file with specification, real steps and model: ", h("code", {}, `surrogym export ${name}`)));
  return {
    element,
    show(surrogate) {
      now = surrogate;
      model.hidden = surrogate.model_version === null;
    },
  };
}
