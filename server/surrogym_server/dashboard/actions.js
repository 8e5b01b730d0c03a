// What an admin may do: ask, pause, add budget, delete. Others see what they would need.

import { call, surrogate } from "/page/api.js";
import { h } from "/page/dom.js";
import { count } from "/page/format.js";
import { section } from "/page/parts.js";

/** Asks before what can't be taken back: the name has to be typed. */
function confirmed(name) {
  const dialog = document.getElementById("dialog");
  return new Promise((resolve) => {
    const input = h("input", { id: "confirm", autocomplete: "off", spellcheck: "false" });
    const go = h("button", { class: "danger", value: "yes", disabled: true }, "Delete");
    input.addEventListener("input", () => { go.disabled = input.value !== name; });
    dialog.replaceChildren(h("form", { method: "dialog" }, h("h2", { id: "dialog-title" }, `Delete ${name}?`),
      h("p", {}, "With its real steps, models and sessions. There is no way back; ", h("code", {}, `surrogym export ${name}`), " keeps a copy."),
      h("label", { for: "confirm" }, "Type its name"), input,
      h("p", { class: "buttons" }, h("button", { value: "no", formnovalidate: true }, "Keep it"), go)));
    dialog.returnValue = "no";
    dialog.addEventListener("close", () => resolve(dialog.returnValue === "yes"), { once: true });
    dialog.showModal();
    input.focus();
  });
}

export function actions(name, { role, refresh }) {
  const path = surrogate(name);
  const said = h("p", { class: "note", role: "status" });
  const more = h("input", { type: "number", min: 1, max: 10000, value: 10, "aria-label": "real steps to add" });
  const pause = h("button", { type: "button" });
  const buttons = h("div", { class: "buttons" });
  const body = h("div", {}, buttons, said);
  let now = null;

  async function run(work, done) {
    try {
      const reply = await work();
      said.className = "note good";
      said.textContent = typeof done === "function" ? done(reply) : done;
      refresh();
    } catch (error) {
      said.className = "bad";
      said.textContent = error.message;
    }
  }
  const steps = () => Math.max(1, Math.round(Number(more.value) || 1));
  pause.addEventListener("click", () => run(() => call("PATCH", path, { paused: !now.paused }), now.paused ? "The design continues." : "Paused: samplers get no queries."));
  const add = () => run(() => call("PATCH", path, { budget: now.budget + steps() }), `The budget is now ${count(now.budget + steps())}.`);
  const improve = () => run(() => call("POST", `${path}/improve`, { queries: steps() }), ({ budget, budget_raised_by: raised }) =>
    `${count(steps())} more real steps were requested, where they help the model most${raised ? `; this raised the budget to ${count(budget)}` : ""}.`);
  const remove = async () => {
    if (!(await confirmed(name))) return;
    await run(() => call("DELETE", path), "Deleted.");
    location.hash = "#/";
  };
  buttons.append(pause,
    h("span", { class: "group" }, more, h("button", { type: "button", onclick: add }, "Add to the budget"), h("button", { type: "button", onclick: improve }, "Request that many queries")),
    h("button", { type: "button", class: "danger", onclick: remove }, "Delete…"));

  return {
    element: section("actions", "Steer", null, body),
    /** A query by hand at a point; the probe's button. */
    ask: (point) => run(() => call("POST", `${path}/queries`, { coordinates: [[...point.coordinates]], action: [[...point.action]] }), "Requested: a sampler will take this real step.").then(() => said.scrollIntoView({ block: "center", behavior: "smooth" })),
    show(surrogate) {
      now = surrogate;
      pause.textContent = surrogate.paused ? "Resume" : "Pause";
      const may = role() === "admin";
      buttons.hidden = !may;
      if (!may) said.textContent = `This token's role is ${role() ?? "unknown"}. A token with role admin may pause, add budget, request queries and delete.`;
    },
  };
}
