// The policies of a surrogate: promise beside real return, aliases, episodes, files.

import { unbroken } from "/page/angles.js";
import { call, download, surrogate } from "/page/api.js";
import { lines } from "/page/charts.js";
import { h, keyed, shown } from "/page/dom.js";
import { moment, number, percent } from "/page/format.js";
import { meanWords, marksOf, sentence } from "/page/judged.js";
import { section, table } from "/page/parts.js";
import { ranges, rangesKey } from "/page/ranges.js";
import { videoPart } from "/page/video.js";

const SHOWN = 20; // in the picture
const BYTES = ["bytes", "kB", "MB", "GB"];
const ACTING = { policy: "the policy", zero: "an action of zero", random: "random actions", reference: "the reference controller" };

function size(bytes) {
  const power = Math.min(BYTES.length - 1, Math.floor(Math.log10(Math.max(1, bytes)) / 3));
  return `${number(bytes / 1e3 ** power)} ${BYTES[power]}`;
}

export function policyList(name, spec, { role, refresh }) {
  const url = `${surrogate(name)}/policies`;
  const place = h("div");
  const list = h("div", { class: "policies" });
  const trouble = h("p", { class: "bad", role: "alert", hidden: true });
  const charts = new Set();
  const element = section("policies", "Policies", "The promise of each policy, and its return in the original environment. Higher is better.", place, trouble, list);
  const judged = (policies) => policies.slice(0, SHOWN).map((policy) => ({ label: who(policy), marks: marksOf(policy) }));
  const draw = shown(place, (policies) => (policies.length
    ? [rangesKey(judged(policies)), ranges(judged(policies), "Returns of the newest policies"), h("a", { href: `#/compare/${encodeURIComponent(name)}` }, "Compare with the policies of another surrogate")].filter(Boolean)
    : [h("p", { class: "empty" }, "No policy is stored. ", h("code", {}, `surrogym train ${name}`), " stores the policy that it trains; ", h("code", {}, "surrogym policy push"), " stores a policy from a file.")]));
  const rows = keyed(list, one);

  const who = ({ version, aliases }) => [`${name}@${version}`, ...aliases].join(", ");

  async function attempt(work) {
    trouble.hidden = true;
    try {
      await work();
    } catch (error) {
      trouble.hidden = false;
      trouble.textContent = error.message;
    }
  }

  function one(policy) {
    const inside = h("div", {});
    const details = h("details", { class: "model" },
      h("summary", {}, h("strong", {}, `version ${policy.version}`), policy.aliases.map((alias) => h("span", { class: "badge ready" }, alias)),
        h("span", { class: "note" }, ` ${[policy.algorithm, moment(policy.created_at)].filter(Boolean).join(", ")}. ${sentence(policy)}`)), inside);
    details.addEventListener("toggle", () => details.open && !inside.firstChild && attempt(() => fill(policy, inside)));
    return details;
  }

  async function fill(policy, inside) {
    const detail = await call("GET", `${url}/${policy.version}`);
    const trusted = policy.trusted === null ? "Nobody checked whether the promise can be trusted." : `The promise was ${policy.trusted ? "" : "not "}trusted: ${policy.reason}.`;
    const parts = [h("p", {}, trusted, policy.pushed_by ? ` The card is as its trainer sent it: ${policy.pushed_by}.` : "")];
    if (policy.differs) parts.push(h("p", { class: "bad" }, `The policy was made for another specification, which differs in ${policy.differs}.`));
    parts.push(table(`Real episodes of version ${policy.version}`, [["actions of", ""], ["environment", ""], ["starts", ""], ["episodes", "num"], ["mean return (95 %)", "num"], ["success", "num"], ["real steps", "num"], ["", ""]],
      policy.evaluations.map((each) => [ACTING[each.controller], each.own ? "its own" : each.environment, each.note || "–", each.episodes, meanWords(each), percent(each.success_rate), each.steps, episodesOf(policy, each)]), "No real episodes yet; run some with surrogym evaluate."));
    inside.replaceChildren(...parts, files(policy), naming(policy));
    if (detail.curve.length > 1) inside.append(...curve(detail.curve));
    const video = videoPart(`${url}/${policy.version}`, policy);
    charts.add(video);
    inside.append(video.element);
    await episodes(policy, inside);
  }

  const episodesOf = (policy, { id }) => h("button", { type: "button", class: "link", "aria-label": `Download the episodes of evaluation ${id}`, onclick: () => attempt(() => download(`${url}/${policy.version}/evaluations/${id}`, `${name}-${policy.version}-evaluation-${id}.json`)) }, "Download");

  function files(policy) {
    const links = policy.files.map((file) => (file.stored
      ? h("button", { type: "button", onclick: () => attempt(() => download(`${url}/${policy.version}/files/${file.form}`, `${name}-${policy.version}.${file.form}`)) }, `Download ${file.form}, ${size(file.bytes)}`)
      : h("span", { class: "bad" }, `The ${file.form} file is missing: it was never sent, or it was removed to make room for newer files.`)));
    return h("div", { class: "buttons" }, links);
  }

  function naming(policy) {
    if (role() !== "admin" || policy.aliases.includes("production")) return "";
    return h("div", { class: "buttons" }, h("button", { type: "button", onclick: () => attempt(async () => {
      await call("PUT", `${url}/aliases/production`, { version: policy.version });
      refresh();
    }) }, "Make it production"));
  }

  function curve(points) {
    const known = points.filter((point) => point.imagined_return !== null);
    const chart = lines("Imagined return over virtual steps", 150);
    charts.add(chart);
    requestAnimationFrame(() => chart.show([known.map((point) => point.steps), known.map((point) => point.imagined_return)], ["imagined return"], "virtual steps"));
    return [h("h4", {}, "Training: the imagined return rises while the policy learns"), chart.place];
  }

  async function episodes(policy, inside) {
    const own = policy.evaluations.filter((each) => each.controller === "policy" && each.own);
    const chosen = own.findLast((each) => each.declared) ?? own.at(-1);
    if (!chosen) return;
    const { traces, missing } = await call("GET", `${url}/${policy.version}/evaluations/${chosen.id}`);
    if (missing) inside.append(h("p", { class: "bad" }, `The single episodes can't be shown: ${missing}.`));
    const ranked = ["best", "median", "worst"].map((rank) => traces.find((trace) => trace.rank === rank)).filter(Boolean);
    if (!ranked.length) return;
    const length = Math.max(...ranked.map((trace) => trace.coordinates.length));
    const filled = (values) => [...values, ...Array(length - values.length).fill(null)];
    inside.append(h("h4", {}, "Best, median and worst real episode: half of all went at least as well as the median"));
    const grid = h("div", { class: "episodes" });
    inside.append(grid);
    if (spec.coordinates.some(({ kind }) => kind === "angle")) inside.append(h("p", { class: "note" }, "Angles are drawn without a jump after a full turn: values that are 6.28 rad apart are the same position."));
    spec.coordinates.forEach(({ name: label, unit, kind }, at) => {
      const chart = lines(`${label} over the steps of the best, the median and the worst real episode`, 130);
      charts.add(chart);
      grid.append(h("div", {}, h("h4", {}, unit ? `${label} (${unit})` : label), chart.place));
      const values = ranked.map((trace) => trace.coordinates.map((q) => q[at]));
      const rows = (kind === "angle" ? unbroken(values, -1) : values).map(filled);
      chart.show([[...Array(length).keys()], ...rows], ranked.map((trace) => trace.rank));
    });
  }

  return {
    element,
    show(policies) {
      draw(policies);
      rows(policies, (policy) => policy.version);
    },
    repaint: () => charts.forEach((chart) => chart.repaint?.()),
    close: () => charts.forEach((chart) => chart.close()),
  };
}
