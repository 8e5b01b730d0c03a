// One surrogate: what is known of it, and everything one can look at.

import { actions } from "/page/actions.js";
import { call, Problem, surrogate as path } from "/page/api.js";
import { learningCurves } from "/page/charts.js";
import { downloads } from "/page/downloads.js";
import { h, shown } from "/page/dom.js";
import { cost, leastSure, machine, prior, sure, where } from "/page/hero.js";
import { logUpload } from "/page/logs.js";
import { maps } from "/page/maps.js";
import { alive, phaseBadge, section } from "/page/parts.js";
import { pointControls } from "/page/point.js";
import { policyList } from "/page/policies.js";
import { probe } from "/page/probe.js";
import { ledgerTable, modelTable, queueTable, sessionTable } from "/page/tables.js";
import { work } from "/page/work.js";

const PAGE = 10_000;
const LINKS = [["policies", "Policies"], ["work", "Train"], ["learning", "Learning"], ["maps", "Maps"], ["probe", "Probe"], ["queue", "Queue"], ["sessions", "Sessions"], ["ledger", "Ledger"], ["models", "Models"], ["actions", "Steer"], ["log", "Log"], ["downloads", "Downloads"]];

export function surrogateView(main, name, context) {
  const url = path(name);
  let parts = null;
  let samples = [];
  let models = [];
  let dirt = [];
  let kept = []; // how real steps kept the limits, in sentences
  let known = null; // the prior
  let version = null;
  let evaluated = 0; // real steps of evaluations when `kept` was read
  let closed = false;
  main.replaceChildren(h("h1", {}, name), h("div", { class: "card loading", "aria-busy": "true" }, "Asking the server…"));

  async function allSamples() {
    for (;;) {
      const { samples: page } = await call("GET", `${url}/samples?after=${samples.at(-1)?.id ?? 0}&limit=${PAGE}`);
      samples = [...samples, ...page];
      if (page.length < PAGE) return;
    }
  }

  async function policiesNow(now, first) {
    const reply = await call("GET", `${url}/policies`);
    if (first && !closed) parts?.show({ now, samples, policies: reply.policies });
    return reply;
  }

  async function refresh() {
    const now = await call("GET", url);
    if (closed) return;
    const first = !parts;
    if (first) {
      parts = build(main, name, now.spec, context);
      parts.show({ now, samples }); // many samples and models take longer than a person wants to wait for the rest
    }
    const newSamples = samples.length !== now.samples && allSamples();
    const newDirt = newSamples && call("GET", `${url}/dirt`).then(({ findings }) => { dirt = findings; });
    const newKept = (newSamples || evaluated !== now.ledger.evaluation) && now.spec.limits && call("GET", `${url}/limits`).then(({ said }) => { kept = said; });
    const newPrior = (newSamples || !known || known.awaited || version !== now.model_version) && call("GET", `${url}/prior`).then((reply) => { known = reply; });
    const newModels = version !== now.model_version && call("GET", `${url}/models`).then((reply) => { models = reply.models; });
    const [queries, sessions, stored] = await Promise.all([call("GET", `${url}/queries`), call("GET", `${url}/sessions`), policiesNow(now, first), newSamples, newDirt, newKept, newPrior, newModels]);
    if (closed) return;
    parts.show({ now, samples, dirt, kept, known, models: newModels && models, queries: queries.queries, sessions: sessions.sessions, policies: stored.policies });
    version = now.model_version;
    evaluated = now.ledger.evaluation;
  }

  function fail(error) {
    const missing = error instanceof Problem && error.status === 404;
    parts?.close();
    parts = null;
    [samples, models, dirt, kept, known, version, evaluated] = [[], [], [], [], null, null, 0];
    main.replaceChildren(h("h1", {}, name), h("div", { class: "card bad", role: "alert" },
      missing ? "There is no surrogate of this name, or it was deleted." : error.message, " ", h("a", { href: "#/" }, "All surrogates")));
  }

  return {
    refresh,
    fail,
    repaint: () => parts?.repaint(),
    close: () => { closed = true; main.classList.remove("unmodelled"); parts?.close(); },
  };
}

function build(main, name, spec, context) {
  const title = h("div", { class: "title" });
  const facts = h("div", { class: "facts" });
  const curves = learningCurves();
  const stored = policyList(name, spec, context);
  const jobs = work(name, context);
  const controls = pointControls(spec, () => { map.moved(); probing.moved(); });
  const map = maps(name, spec, controls);
  const steer = actions(name, context);
  const log = logUpload(name, spec, context);
  const files = downloads(name);
  const settable = spec.max_rollout === undefined || spec.max_rollout === null;
  const probing = probe(name, spec, controls, { onepisodes: map.paths, ask: settable && ((point) => steer.ask(point)) });
  const [queue, ledger, versions, sessions] = [queueTable(), ledgerTable(), modelTable(), sessionTable(name)];
  const names = controls.ranges.map((range) => range.name);
  const showPoint = (coordinates, action) => {
    controls.move(coordinates, action);
    document.getElementById("maps").scrollIntoView({ behavior: "smooth" });
  };
  const render = {
    title: shown(title, (now) => [h("a", { class: "back", href: "#/" }, "All surrogates"), h("h1", {}, name), phaseBadge(now), h("span", { class: "note" }, `${now.environment} · ${alive(now)}`)]),
    facts: shown(facts, ({ now, found, dirt, known }) => [sure(now), where(found, names, showPoint, now.model_version), cost(now), known && prior(known, now.fidelity), machine(dirt)].filter(Boolean)),
  };
  const jump = (id) => (event) => {
    event.preventDefault();
    const part = document.getElementById(id);
    part.scrollIntoView({ behavior: "smooth" });
    part.focus({ preventScroll: true }); // Tab goes on from there
  };
  main.replaceChildren(title, facts,
    h("nav", { class: "jumps", "aria-label": "Parts of this page" }, LINKS.map(([id, text]) => h("a", { href: `#${id}`, onclick: jump(id) }, text))),
    stored.element,
    jobs.element,
    section("learning", "Learning", "Confidence index and leave-one-out error of each output, against the number of real steps in the model.", curves.parts),
    section("maps", "Maps", "Each map shows two coordinates; the sliders set the others. Click a map, or use the arrow keys, to move the point.",
      h("div", { class: "cut" }, controls.form, h("div", {}, map.parts))),
    section("probe", "Probe", "The model's prediction of one step from the point above, with standard deviations.", probing.parts),
    queue.element, sessions.element, h("div", { class: "two" }, ledger.element, steer.element), versions.element, log.element, files.element);

  let found = null;
  let about = { dirt: [], known: null }; // dirt of the machine, and its prior
  let looked = null;
  async function look(now) {
    if (!now.fidelity || looked === now.model_version) return;
    looked = now.model_version;
    try {
      found = await leastSure(name, now.fidelity, controls);
      render.facts({ now, found, ...about });
    } catch {
      looked = null; // the next look asks again
    }
  }

  return {
    show({ now, samples, dirt, kept, known, models, queries, sessions: open, policies }) {
      const { created_at, spec: _, ...rest } = now;
      render.title(rest);
      if (dirt) about = { dirt, known };
      render.facts({ now: rest, found, ...about });
      main.classList.toggle("unmodelled", !now.fidelity);
      if (models && models.length) curves.show(models);
      if (policies) stored.show(policies);
      jobs.show({ now, policies });
      if (models) versions.show(models);
      const point = { samples, fidelity: now.fidelity, version: now.model_version };
      map.show(point);
      probing.show(point);
      if (queries) queue.show(queries);
      ledger.show({ ledger: now.ledger, machine_seconds: now.machine_seconds, kept: kept ?? [] });
      if (open) sessions.show(open);
      steer.show(now);
      log.show();
      files.show(now);
      look(rest);
    },
    repaint: () => [curves, map, probing, stored, jobs].forEach((part) => part.repaint()),
    close: () => [curves, map, probing, stored, jobs].forEach((part) => part.close()),
  };
}
