// Logs of real steps: chosen, checked row by row, and then stored or drafted into a specification.

import { call, save, surrogate } from "/page/api.js";
import { columnPicks, headingOf } from "/page/columns.js";
import { h } from "/page/dom.js";
import { count, plural } from "/page/format.js";
import { section, table } from "/page/parts.js";

const MOST_BYTES = 4 * 1024 * 1024; // of the server's route
const MOST_ACTIONS = 4; // entries that the selects of a draft offer; the text takes more
const SHOWN = 100; // rejected rows
const PATIENCE_MS = 120_000; // 45,000 steps are stored in 7 s
const ROLES = ["sample", "admin"];

/** The filled roles of a mapping alone, as text to edit. */
const mappingText = (mapping) => JSON.stringify(Object.fromEntries(Object.entries(mapping)
  .filter(([, value]) => value !== null && (typeof value !== "object" || Object.keys(value).length))), null, 1);

function rejectedParts({ rejected, rejected_rows: rows }) {
  if (!rejected) return [];
  const cell = (text) => `"${String(text).replace(/^(?=\s*[=+\-@＝＋－＠])/, "'").replaceAll('"', '""')}"`; // no formula of a spreadsheet
  const csv = () => ["line,reason", ...rows.map(({ line, reason }) => `${line},${cell(reason)}`), ""].join("\n");
  return [
    h("p", { class: "bad" }, `${plural(rejected, "row")} can't be used${rejected > SHOWN ? `; the first ${SHOWN} are shown` : ""}.`),
    table("Rows that can't be used", [["line", "num"], ["reason", "wide"]], rows.slice(0, SHOWN).map(({ line, reason }) => [count(line), reason]), ""),
    h("button", { type: "button", onclick: () => save(new Blob([csv()], { type: "text/csv" }), "rejected.csv") }, "Download these rows (CSV)"),
  ];
}

/** What the server found in a log. */
function reportParts(report) {
  const ends = report.without_next_state ? `, ${count(report.without_next_state)} without a next state` : "";
  const columns = [...Object.entries(report.columns), ...Object.entries(report.ignored).map(([name, reason]) => [name, `ignored: ${reason}`])];
  return [
    h("p", { class: "big" }, `${plural(report.steps, "usable step")} of ${plural(report.rows, "row")}${ends}`),
    table("Columns of the log", [["column", ""], ["role", "wide"]], columns, ""),
    ...rejectedParts(report),
  ];
}

/**
 * Fields for a log and the roles of its columns, and a button that has it looked at. `known` is what `columnPicks` needs;
 * `look(log)` gives the report; `found(report, log)` what follows it.
 */
function logForm(id, known, { look, found }) {
  const file = h("input", { id: `${id}-file`, type: "file", accept: ".csv,.tsv,.txt,text/csv", required: true });
  const mapping = h("textarea", { id: `${id}-mapping`, rows: 5, spellcheck: "false" });
  const picks = columnPicks(id, mapping, known);
  const details = h("details", { class: "model" }, h("summary", {}, "The columns have other names"),
    h("p", { class: "note" }, "Choose a log, and then what each of its columns is. If nothing is chosen, the names of the columns decide."), picks.element,
    h("label", { for: mapping.id }, "The same as text: mapping as JSON"), mapping,
    h("p", { class: "note" }, "Such as ", h("code", {}, '{"state": {"level": "LT-101"}, "action": ["FV-101"], "reward": "profit", "episode": "batch"}')));
  const answer = h("div", { "aria-live": "polite" });
  const go = h("button", {}, "Check the log");
  const form = h("form", { class: "stack" }, h("label", { for: file.id }, "Log as CSV, with a heading"), file, details, h("p", { class: "buttons" }, go));
  const fail = (error) => answer.replaceChildren(h("p", { class: "bad", role: "alert" }, error.message));

  async function chosen() {
    const [one] = file.files;
    if (!one) throw new Error("Choose a log first.");
    if (one.size > MOST_BYTES) throw new Error(`Expected at most ${MOST_BYTES / 1024 / 1024} MiB, got ${count(one.size)} bytes. surrogym import reads longer logs.`);
    const log = { text: await one.text() };
    if (!mapping.value.trim()) return log;
    try {
      return { ...log, mapping: JSON.parse(mapping.value) };
    } catch (error) {
      throw new Error(`The mapping is no JSON: ${error.message}`);
    }
  }
  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    go.disabled = true;
    try {
      const log = await chosen();
      const report = await look(log, file.files[0]);
      if (!mapping.value.trim()) mapping.value = mappingText(report.mapping);
      picks.follow();
      answer.replaceChildren(...reportParts(report), ...[found(report, log, fail)].flat());
    } catch (error) {
      details.open = details.open || Boolean(file.files.length);
      fail(error);
    } finally {
      go.disabled = false;
    }
  });
  file.addEventListener("change", async () => {
    mapping.value = "";
    picks.show(file.files.length ? await headingOf(file.files[0]) : []);
  });
  for (const input of [file, mapping]) input.addEventListener("input", () => answer.replaceChildren());
  return [form, answer];
}

/** Stores a log at a surrogate; the reply has `stored` and `duplicates`. A repeat is harmless. */
export const storeLog = (name, log) => call("POST", `${surrogate(name)}/logs`, log, undefined, PATIENCE_MS);

/** The part of a surrogate's page that takes logs. */
export function logUpload(name, spec, { role, refresh }) {
  const forbidden = h("p", { class: "note" });
  const form = h("div", {}, logForm("log", { coordinates: spec.coordinates.map((one) => one.name), actions: (spec.action.low ?? spec.action.nvec ?? [0]).length }, {
    look: (log) => call("POST", `${surrogate(name)}/logs`, { ...log, check_only: true }, undefined, PATIENCE_MS),
    found: ({ steps }, log, fail) => {
      const said = h("p", { class: "good", role: "status" });
      const go = h("button", { type: "button", class: "main", onclick: async () => {
        go.disabled = true;
        try {
          const { stored, duplicates } = await storeLog(name, log);
          said.textContent = `${plural(stored, "new logged step")}${duplicates ? `, ${count(duplicates)} were there before` : ""}. The model is fitted to them next.`;
          refresh();
        } catch (error) {
          go.disabled = false;
          fail(error);
        }
      } }, `Store ${plural(steps, "step")}`);
      return h("p", { class: "buttons" }, go, said);
    },
  }));
  return {
    element: section("log", "Log", "Real steps that were recorded before. They cost no budget, and the model learns from them. Nothing is stored before you have seen which rows can be used.", forbidden, form),
    show() {
      const may = ROLES.includes(role());
      form.hidden = !may;
      forbidden.textContent = may ? "" : `This token's role is ${role() ?? "unknown"}. One with role sample or admin may store a log.`;
      forbidden.hidden = may;
    },
  };
}

/** A form that drafts a specification from a log; `ondraft(drafted, log)` takes it. */
export const logDraft = (ondraft) => logForm("draft", { coordinates: null, actions: MOST_ACTIONS }, {
  look: (log, file) => call("POST", "/v1/logs:draft", { ...log, environment: file.name.replace(/\.[^.]*$/, "").slice(0, 256) }, undefined, PATIENCE_MS),
  found: (report, log) => {
    ondraft(report, log);
    return h("p", { class: "note" }, "The drafted specification is below. Change it if you know better, and check it. Registering it stores the usable steps too.");
  },
});
