// Queue, ledger, models and sessions.

import { h, keyed, shown } from "/page/dom.js";
import { count, moment, number, percent, plural, seconds, vector } from "/page/format.js";
import { section, sparkline, table } from "/page/parts.js";

const ROWS = 200;
const FILTERS = { all: () => true, open: (query) => ["pending", "leased"].includes(query.status), "with errors": (query) => query.error !== null };
const STATUS = { set_aside: "set aside" };

/** What is left of the lease a sampler holds, by the server's clock. */
function lease({ lease_seconds_left: left }) {
  if (left === null) return "–";
  return left > 0 ? `${Math.ceil(left)} s` : "ran out";
}

export function queueTable() {
  const filter = h("select", { "aria-label": "queries to show" }, Object.keys(FILTERS).map((name) => h("option", {}, name)));
  const place = h("div");
  let queries = [];
  const render = shown(place, (rows) => table("Queue of queries",
    [["id", "num"], ["purpose", ""], ["status", ""], ["state", ""], ["action", ""], ["leases", "num"], ["lease ends in", "num"], ["sampler", ""], ["error", "wide"]],
    rows.map((query) => [query.id, h("span", { class: `mark ${query.purpose}` }, query.purpose),
      h("span", { class: `badge ${query.status}` }, STATUS[query.status] ?? query.status),
      vector(query.coordinates), query.actions.length > 1 ? `${query.actions.length} actions` : vector(query.actions[0]),
      query.attempts, lease(query), query.sampler ?? "–", query.error ? h("span", { class: "bad" }, query.error) : ""]),
    filter.value === "all" ? "There are no queries yet." : "None."));
  const draw = () => render(queries.filter(FILTERS[filter.value]).slice(0, ROWS));
  filter.addEventListener("change", draw);
  return {
    element: section("queue", "Queue", "Queries, the newest first. A sampler holds a query under a lease, which it renews while it works. A query that keeps failing is set aside.", h("div", { class: "picks" }, h("label", { class: "pick" }, "show", filter)), place),
    show(given) { queries = given.toReversed(); draw(); },
  };
}

export function ledgerTable() {
  const place = h("div");
  const render = shown(place, ({ ledger, machine_seconds: taken, kept }) => [table("Ledger", [["real steps", ""], ["", "num"], ["", "wide"]], [
    ["initial", count(ledger.initial), "a Latin hypercube, before anything is known"],
    ["adaptive", count(ledger.adaptive), "chosen where the model was uncertain"],
    ["manual", count(ledger.manual), "requested or submitted by a person"],
    [h("strong", {}, "total"), h("strong", {}, count(ledger.total)), "initial, adaptive and manual: what the budget counts"],
    ["audit", count(ledger.audit), "tests of a policy's promise; they cost no budget"],
    ["logged", count(ledger.logged), "recorded before, from a log; they cost no budget"],
    ["unresolved", count(ledger.unresolved), `steps that may have been taken under leases that expired or failed (${count(ledger.failed)} failed)`],
    ["evaluation", count(ledger.evaluation), "real episodes of policies; the model does not learn from them"],
    ["resets", count(ledger.resets), "rollouts that began at a reset"],
    ...(taken === undefined ? [] : [["seconds", number(taken), "real steps of the design and of audits, times the sampling period; without resets"]]),
    ["wear", count(ledger.wear), "steps in which an entry of the action was at a bound"],
  ], ""), ...kept.map((words) => h("p", { class: "note" }, words))]);
  return { element: section("ledger", "Ledger", "Every real step, by purpose, and what else the machine gave.", place), show: render };
}

const HYPER = ["family", "inputs", "kernel", "features", "features_left_out", "shares_samples_with", "rates", "lengthscale", "signal_variance", "linear_variance", "quadratic_variance", "noise_variance", "jitter", "scale", "points", "left_out"];

function hyper(value) {
  if (typeof value === "number") return number(value);
  if (typeof value !== "object") return String(value);
  if (!Array.isArray(value)) return Object.entries(value).map(([name, one]) => `${name}: ${number(one)}`).join(", ") || "none";
  return (typeof value[0] === "number" ? vector(value) : value.join(", ")) || "none";
}

function model(record) {
  const { fidelity } = record;
  const head = h("summary", {}, h("strong", {}, `version ${record.version}`), h("span", { class: "note" },
    ` ${plural(record.samples, "sample")}, confidence ${percent(fidelity.confidence_index)}, fitted in ${seconds(record.fit_seconds)}, ${moment(record.created_at)}`));
  const rows = fidelity.outputs.map((output) => [output.name, output.structure, percent(output.confidence_index), percent(output.coverage), number(output.leave_one_out_error), number(output.tolerance)]);
  const parts = (record.description.outputs ?? []).map((output) => h("div", {}, h("h4", {}, output.name), h("dl", { class: "hyper" },
    HYPER.filter((name) => output[name] !== undefined).flatMap((name) => [h("dt", {}, name.replaceAll("_", " ")),
      h("dd", {}, hyper(output[name]))]))));
  return h("details", { class: "model" }, head,
    table(`Outputs of version ${record.version}`, [["output", ""], ["structure", ""], ["confidence", "num"], ["coverage", "num"], ["leave-one-out", "num"], ["tolerance", "num"]], rows, ""), h("div", { class: "outputs" }, parts));
}

export function modelTable() {
  const list = h("div", { class: "models" });
  const rows = keyed(list, model);
  const empty = h("p", { class: "empty" }, "No model yet: the first fit follows the initial queries.");
  return {
    element: section("models", "Model versions", "Open a version to see its structure and hyperparameters.", empty, list),
    show(models) { empty.hidden = models.length > 0; rows(models.toReversed(), (record) => record.version); },
  };
}

export function sessionTable(name) {
  const place = h("div");
  const mean = (values) => values.reduce((sum, value) => sum + value, 0) / values.length;
  const render = shown(place, (sessions) => table("Sessions",
    [["session", ""], ["lanes", "num"], ["variant", ""], ["model", ""], ["steps", "num"], ["steps / s", "num"], ["episodes", "num"], ["imagined return", "num"], ["", ""], ["penalty's share", "num"]],
    sessions.map((session) => {
      const taken = session.penalties.reduce((sum, value) => sum + value, 0);
      const before = session.returns.reduce((sum, value, at) => sum + Math.abs(value + session.penalties[at]), 0);
      return [h("code", {}, session.id.slice(0, 8)), count(session.num_envs), session.variant, `${session.model_version.join(", ")}${session.model === "latest" ? ", latest" : ""}`,
        count(session.steps), count(session.steps_per_second), count(session.episodes),
        session.returns.length ? number(mean(session.returns), 4) : "–", sparkline(session.returns), session.returns.length && before ? percent(taken / before) : "–"];
    }), `No session is open. A trainer opens one: surrogym train ${name}`));
  return {
    element: section("sessions", "Sessions", "Virtual environments in use. Returns are means of the last 100 virtual episodes; they do not show success in the original environment.", place),
    show: render,
  };
}
