// The policies of two surrogates beside each other: which is better in reality, and by how much.

import { call, surrogate } from "/page/api.js";
import { difference } from "/page/differences.js";
import { h, shown } from "/page/dom.js";
import { number, percent, plural } from "/page/format.js";
import { meanWords, realMark, realOf, referenceOf, withoutOf } from "/page/judged.js";
import { table } from "/page/parts.js";
import { ranges } from "/page/ranges.js";

const MOST = 5; // policies of each: those with an alias, and the newest

const interval = ({ low, high }) => `${number(low)} to ${number(high)}`;
const byMean = (one, other) => realOf(other.policy).mean - realOf(one.policy).mean;
const chosenOf = (policies) => [...policies.filter(({ aliases }) => aliases.length), ...policies.filter(({ aliases }) => !aliases.length)].slice(0, MOST);

/** One sentence about the best of each surrogate, or the best two of one. */
function words(better, worse, found) {
  const by = `${number(Math.abs(found.by))} (95 %: ${interval(found)})`;
  return found.low > 0
    ? `${better.label} is better than ${worse.label} by ${by}.`
    : `${better.label} and ${worse.label} can't be told apart: the difference is ${by}, and the interval includes 0.`;
}

function grounds(better, found, pairs, same) {
  const real = realOf(better.policy);
  const starts = found.paired ? `Both ran the same ${plural(real.episodes, "start")}, and each start is compared with itself.` : "They ran different starts.";
  return `The best ${same ? "two" : "of each"}, by mean return in real episodes from the declared starts. ${starts} `
    + (pairs > 1 ? `The intervals of all ${pairs} pairs of policies hold together with 95 % chance, so choosing the best does not flatter it.` : "");
}

/** Each policy beside the best one. */
function everyPolicy(entries, pairs) {
  const [best] = entries;
  const gap = (entry) => (entry === best ? "the best" : (({ by, ...ends }) => `${number(by)} (${interval(ends)})`)(difference(entry, best, pairs)));
  const shown = (found) => (found ? meanWords(found) : "–");
  const columns = [
    ["policy", "", ({ label }) => label],
    ["mean real return (95 %)", "num", ({ policy }) => meanWords(realOf(policy))],
    ["difference from the best (95 %)", "num", gap],
    ["success", "num", ({ policy }) => percent(realOf(policy).success_rate)],
    ["without the policy", "num", ({ policy }) => shown(withoutOf(policy))],
    ["reference controller", "num", ({ policy }) => shown(referenceOf(policy))],
  ].filter(([, , said]) => entries.some((entry) => said(entry) !== "–"));
  return table("Each policy beside the best", columns.map(([title, kind]) => [title, kind]), entries.map((entry) => columns.map(([, , said]) => said(entry))), "");
}

export function compareView(main, given) {
  const chosen = [...given];
  const place = h("div", {}, h("div", { class: "card loading", "aria-busy": "true" }, "Asking the server…"));
  const picks = h("div", { class: "picks" });
  main.replaceChildren(h("a", { class: "back", href: "#/" }, "All surrogates"), h("h1", {}, "Compare policies"), picks, place);

  const pick = shown(picks, ({ names, now }) => now.map((value, at) => {
    const select = h("select", {}, names.map((name) => h("option", {}, name)));
    select.value = value;
    select.addEventListener("change", () => {
      chosen[at] = select.value;
      location.hash = `#/compare/${chosen.map(encodeURIComponent).join("/")}`;
    });
    return h("label", { class: "pick" }, at ? "with" : "policies of", select);
  }));

  const draw = shown(place, ({ sides, environments, same }) => {
    const all = sides.flat();
    if (!all.length) return h("p", { class: "card empty" }, "Neither has a policy yet.");
    const judged = all.filter(({ policy }) => realOf(policy)?.mean_interval).toSorted(byMean);
    const unjudged = all.filter((entry) => !judged.includes(entry)).map(({ label }) => label);
    const missing = unjudged.length > 0 && h("p", { class: "note" }, `Without two real episodes from the declared starts: ${unjudged.join(", ")}.`);
    if (new Set(environments).size > 1) return h("div", { class: "card" }, h("p", { class: "bad" }, `These are different environments (${environments.join(" and ")}), so their returns can't be compared.`));
    const pairs = (judged.length * (judged.length - 1)) / 2;
    const bests = same ? [judged[0], judged[1]] : sides.map((side) => judged.find((entry) => side.includes(entry)));
    const [better, worse] = bests.every(Boolean) ? bests.toSorted(byMean) : [];
    const found = worse ? difference(better, worse, pairs) : null;
    return h("div", { class: "card" },
      h("p", { class: "big" }, found ? words(better, worse, found) : "Two policies with real episodes from the declared starts are needed to say which is better."),
      found && h("p", { class: "note" }, grounds(better, found, pairs, same)),
      judged.length > 0 && [h("h2", {}, "Mean real return, the best first; a bar is its 95 % interval"),
        ranges(judged.map(({ label, policy }) => ({ label, marks: [realMark(policy)] })), "Mean real returns of the policies of both", 2),
        everyPolicy(judged, pairs)],
      missing);
  });

  const known = new Map(); // returns of the episodes of an evaluation, which never change
  async function returnsOf(name, policy) {
    const real = realOf(policy);
    if (!real) return [];
    const path = `${surrogate(name)}/policies/${policy.version}/evaluations/${real.id}?traces=false`;
    if (!known.has(path)) known.set(path, (await call("GET", path)).returns);
    return known.get(path);
  }

  async function side(name) {
    const { policies } = await call("GET", `${surrogate(name)}/policies`);
    return Promise.all(chosenOf(policies).map(async (policy) => ({
      label: [`${name}@${policy.version}`, ...policy.aliases].join(", "), policy, returns: await returnsOf(name, policy),
    })));
  }

  return {
    async refresh() {
      const { surrogates } = await call("GET", "/v1/surrogates?limit=1000");
      const names = surrogates.map(({ name }) => name);
      chosen[0] = names.includes(chosen[0]) ? chosen[0] : names[0];
      chosen[1] = names.includes(chosen[1]) ? chosen[1] : names.find((name) => name !== chosen[0]) ?? names[0];
      if (!names.length) return draw({ sides: [[], []], environments: [] });
      const sides = chosen[0] === chosen[1] ? [await side(chosen[0]), []] : await Promise.all(chosen.map(side));
      pick({ names, now: [...chosen] });
      draw({ sides, same: chosen[0] === chosen[1], environments: chosen.map((name) => surrogates.find((one) => one.name === name).environment) });
    },
    fail: (error) => place.replaceChildren(h("div", { class: "card bad", role: "alert" }, error.message)),
    repaint() {},
    close() {},
  };
}
