// The policies of two surrogates beside each other: which is better in reality, and by how much.

import { call, surrogate } from "/page/api.js";
import { h, shown } from "/page/dom.js";
import { number } from "/page/format.js";
import { compared, marksOf, realOf } from "/page/judged.js";
import { ranges, rangesKey } from "/page/ranges.js";

const MOST = 5; // policies of each

/** How `compared` reads. */
function words(found) {
  if (!found) return "Two policies with real episodes from the declared starts are needed to say which is better.";
  const { better, worse, by, low, high } = found;
  const interval = `${number(by)} (95 %: ${number(low)} to ${number(high)})`;
  return low > 0
    ? `${better.label} is better than ${worse.label} by ${interval}.`
    : `${better.label} and ${worse.label} can't be told apart: the difference is ${interval}, which includes none.`;
}

const best = (entries) => entries.filter(({ policy }) => realOf(policy)).toSorted((a, b) => realOf(b.policy).mean - realOf(a.policy).mean)[0] ?? null;

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

  const draw = shown(place, ({ pair, environments }) => {
    const entries = pair.map(({ name, policies }) => policies.slice(0, MOST).map((policy) => ({ label: [`${name}@${policy.version}`, ...policy.aliases].join(", "), policy })));
    const all = entries.flat();
    if (!all.length) return h("p", { class: "card empty" }, "Neither has a policy yet.");
    const other = new Set(environments).size > 1;
    const ends = entries.map(best);
    const found = pair[0].name === pair[1].name ? null : ends.every(Boolean) ? compared(...ends) : null;
    return h("div", { class: "card" },
      other && h("p", { class: "bad" }, `These are different environments (${environments.join(" and ")}), so their returns don't compare.`),
      !other && h("p", { class: "big" }, words(found)),
      !other && found && h("p", { class: "note" }, "The best of each, by its mean return in real episodes from the declared starts. The interval is that of the difference of two means over new starts. Of several policies, the best one looks a little better than it is."),
      rangesKey(), ranges(all.map(({ label, policy }) => ({ label, marks: marksOf(policy) })), "Returns of the newest policies of both"));
  });

  return {
    async refresh() {
      const { surrogates } = await call("GET", "/v1/surrogates?limit=1000");
      const names = surrogates.map(({ name }) => name);
      chosen[0] = names.includes(chosen[0]) ? chosen[0] : names[0];
      chosen[1] = names.includes(chosen[1]) ? chosen[1] : names.find((name) => name !== chosen[0]) ?? names[0];
      if (!names.length) return draw({ pair: [{ name: "", policies: [] }, { name: "", policies: [] }], environments: [] });
      const lists = await Promise.all(chosen.map((name) => call("GET", `${surrogate(name)}/policies`)));
      pick({ names, now: [...chosen] });
      draw({ pair: chosen.map((name, at) => ({ name, policies: lists[at].policies })), environments: chosen.map((name) => surrogates.find((one) => one.name === name).environment) });
    },
    fail: (error) => place.replaceChildren(h("div", { class: "card bad", role: "alert" }, error.message)),
    repaint() {},
    close() {},
  };
}
