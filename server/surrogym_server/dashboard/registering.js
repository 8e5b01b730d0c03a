// Register an environment from its specification: paste it, look at it, register it.

import { call, Problem } from "/page/api.js";
import { h } from "/page/dom.js";
import { plural } from "/page/format.js";
import { logDraft, storeLog } from "/page/logs.js";
import { table } from "/page/parts.js";
import { specificationParts } from "/page/specification.js";

const MOST_BYTES = 128 * 1024; // of the server's route

/** A cart that is pushed along a rail: what somebody begins with who has an environment without a name. */
const EXAMPLE = {
  environment: "cart",
  coordinates: [
    { name: "x", unit: "m", sampling: { kind: "uniform", low: -1, high: 1 } },
    { name: "speed", unit: "m/s", sampling: { kind: "uniform", low: -2, high: 2 } },
  ],
  observation: ["x", "speed"].map((name) => ({ name, term: { parts: [{ function: "linear", weights: { [name]: 1 } }] } })),
  action: { kind: "box", low: [-1], high: [1] },
  start: { x: { kind: "uniform", low: -1, high: 1 }, speed: { kind: "fixed", value: 0 } },
  time_limit: 100,
};

/** The name that `surrogym register` would choose: Pendulum-v1 becomes pendulum. */
function nameOf(environment) {
  const plain = environment.slice(environment.lastIndexOf(":") + 1).replace(/-v\d+$/, "").toLowerCase();
  return plain.replace(/[^a-z0-9._-]+/g, "-").replace(/^[-._]+|[-._]+$/g, "").slice(0, 64) || "surrogate";
}

/** {spec, found, asked} of what `surrogym describe` wrote, or of a specification alone. Throws an Error that says what is wrong. */
function read(text) {
  if (new Blob([text]).size > MOST_BYTES) throw new Error(`Expected at most ${MOST_BYTES / 1024} KiB.`);
  let read;
  try {
    read = JSON.parse(text);
  } catch (error) {
    throw new Error(`Expected JSON, as surrogym describe writes it: ${error.message}.`);
  }
  if (read === null || typeof read !== "object" || Array.isArray(read)) throw new Error("Expected a JSON object, as surrogym describe writes it.");
  const listed = (entries) => (Array.isArray(entries) ? entries : []);
  return read.specification ? { spec: read.specification, found: listed(read.found), asked: listed(read.asked) } : { spec: read, found: [], asked: [] };
}

const lines = (title, entries) => (entries.length ? [h("h3", {}, title), h("ul", {}, entries.map((entry) => h("li", {}, String(entry))))] : []);

/** What the server refused, a line for each field. */
function faults(error) {
  const rows = (error.errors ?? []).map(({ field, expected, got }) => [h("code", {}, field.replace(/^spec\./, "") || "–"), expected, got]);
  return h("div", { class: "card", role: "alert" },
    h("p", { class: "bad" }, rows.length ? `${plural(rows.length, "field")} can't be used. Correct the text, and check it again.` : error.message),
    rows.length ? table("Fields that can't be used", [["field", ""], ["expected", "wide"], ["got", "wide"]], rows, "") : "");
}

export function registerView(main, { role }) {
  const text = h("textarea", { id: "spec", rows: 12, spellcheck: "false", required: true });
  const file = h("input", { id: "spec-file", type: "file", accept: ".json,application/json" });
  const name = h("input", { id: "spec-name", maxlength: 64, autocomplete: "off", spellcheck: "false" });
  const answer = h("div", { "aria-live": "polite" });
  const forbidden = h("p", { class: "bad", hidden: true });
  const form = h("form", { class: "card stack" },
    h("p", {}, "A specification says what is known of an environment beforehand. ", h("code", {}, "surrogym describe ENV > env.json"), " drafts one from some random steps. Nothing is stored before you have seen it."),
    h("label", { for: "spec-file" }, "Choose the file"), file,
    h("label", { for: "spec" }, "or paste its text"), text,
    h("button", { type: "button", class: "link", onclick: () => insert(JSON.stringify(EXAMPLE, null, 1)) }, "Insert an example to change: a cart on a rail"),
    h("label", { for: "spec-name" }, "Name of the surrogate (empty: from the environment)"), name,
    forbidden, h("p", { class: "buttons" }, h("button", { class: "main" }, "Check")));
  const fromLog = h("details", { class: "card" }, h("summary", {}, "Start from a log instead"),
    h("p", { class: "note" }, "A log of an expensive environment is enough for a surrogate: no machine and no sampler are needed."), logDraft(drafted));
  let log = null; // whose steps are stored with the registration
  let checked = 0; // number of the newest check: an older answer is not shown

  file.addEventListener("change", async () => {
    if (!file.files.length) return;
    log = null;
    text.value = file.files[0].size > MOST_BYTES ? "" : await file.files[0].text();
    forget();
    if (!text.value) fail(new Error(`Expected a file of 1 byte to ${MOST_BYTES / 1024} KiB, got ${file.files[0].size} bytes.`));
  });
  text.addEventListener("input", forget);
  name.addEventListener("input", forget);
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    check();
  });
  main.replaceChildren(h("a", { class: "back", href: "#/" }, "All surrogates"), h("h1", {}, "Register an environment"), fromLog, form, answer);

  function insert(example) {
    log = null;
    text.value = example;
    forget();
    text.focus();
  }

  function drafted({ spec, notes }, given) {
    text.value = JSON.stringify({ found: notes, specification: spec }, null, 1);
    log = given;
    check();
  }

  function forget() {
    checked += 1;
    answer.replaceChildren();
  }

  const fail = (error) => answer.replaceChildren(faults(error));

  async function check() {
    const mine = (checked += 1);
    try {
      const { spec, found, asked } = read(text.value);
      const body = { name: name.value.trim() || nameOf(String(spec.environment ?? "")), spec };
      const reply = await call("POST", "/v1/surrogates:check", body);
      if (mine === checked) show(body, reply, found, asked);
    } catch (error) {
      if (mine === checked) fail(error);
    }
  }

  function show(body, reply, found, asked) {
    const go = h("button", { type: "button", class: "main" }, `Register ${reply.name}${log ? " and store its log" : ""}`);
    const trouble = h("div", {});
    go.addEventListener("click", async () => {
      go.disabled = true;
      try {
        await call("POST", "/v1/surrogates", body);
        if (log) await storeLog(reply.name, log);
        location.hash = `#/s/${encodeURIComponent(reply.name)}`;
      } catch (error) {
        go.disabled = false;
        trouble.replaceChildren(error instanceof Problem ? faults(error) : h("p", { class: "bad", role: "alert" }, `${error.message} Try again: a repeat is harmless.`));
      }
    });
    const next = reply.exists
      ? h("p", {}, "A surrogate of this name and specification is there already. ", h("a", { href: `#/s/${encodeURIComponent(reply.name)}` }, `Open ${reply.name}`))
      : h("p", { class: "buttons" }, go);
    answer.replaceChildren(h("section", { class: "card", "aria-labelledby": "checked-title" },
      h("h2", { id: "checked-title" }, `${reply.name}: the server would store this`),
      ...lines("The draft asks you to check", asked), ...lines("The draft was concluded from", found),
      ...specificationParts(reply.spec, reply), next, trouble));
  }

  return {
    async refresh() {
      const may = role() === null || role() === "admin";
      forbidden.hidden = may;
      forbidden.textContent = may ? "" : `This token's role is ${role()}. Only one with role admin may register.`;
    },
    fail,
    repaint() {},
    close() { checked += 1; },
  };
}
