// All surrogates: how sure each is, and what it cost.

import { call } from "/page/api.js";
import { h, keyed } from "/page/dom.js";
import { count, percent } from "/page/format.js";
import { alive, confidenceMeter, costBar, phaseBadge } from "/page/parts.js";

const HOME = ["http://127.0.0.1:8000", "http://localhost:8000"]; // where commands look by themselves
const ADDRESS = HOME.includes(location.origin) ? "" : `export SURROGYM_URL=${location.origin}\n`;

const EMPTY = () => h("div", { class: "card welcome" },
  h("h2", {}, "No surrogate yet"),
  h("p", {}, "Register an environment, and let a sampler answer its queries. This page updates itself."),
  h("p", {}, h("a", { href: "#/register" }, "Register from a specification"), ", or by commands:"),
  h("pre", {}, `${ADDRESS}surrogym register Pendulum-v1 --name pendulum\nsurrogym sample pendulum`));

function row(surrogate) {
  const { name, environment, confidence_index: index, target, ledger, budget } = surrogate;
  return h("li", {}, h("a", { class: "card row", href: `#/s/${encodeURIComponent(name)}` },
    h("span", { class: "who" }, h("strong", {}, name), h("span", { class: "note" }, environment)),
    phaseBadge(surrogate),
    h("span", { class: "cell" }, h("span", { class: "note" }, "how sure"), confidenceMeter(index, target),
      h("span", { class: "value" }, index === null ? "no model yet" : `${percent(index)}, target ${percent(target)}${index >= target ? " reached" : ""}`)),
    h("span", { class: "cell" }, h("span", { class: "note" }, "what it cost"), costBar(ledger, budget),
      h("span", { class: "value" }, `${count(ledger.total)} of ${count(budget)} real steps`)),
    h("span", { class: "alive note" }, alive(surrogate))));
}

const PAGE = 100;

async function firstOf(count) {
  const found = [];
  let after = 0;
  do {
    const { surrogates, next_after: next } = await call("GET", `/v1/surrogates?after=${after}&limit=${PAGE}`);
    found.push(...surrogates);
    after = next;
  } while (after && found.length < count);
  return { found, rest: Boolean(after) };
}

export function listView(main, { refresh }) {
  const list = h("ul", { class: "list" });
  let wished = PAGE;
  const more = h("button", { type: "button", hidden: true, onclick: () => { wished += PAGE; refresh(); } }, `Show ${PAGE} more`);
  const place = h("div", {}, h("div", { class: "card loading", "aria-busy": "true" }, "Asking the server…"));
  const rows = keyed(list, row);
  const compare = h("p", { hidden: true }, h("a", { href: "#/compare" }, "Compare policies of two surrogates"));
  const register = h("p", { hidden: true }, h("a", { href: "#/register" }, "Register another environment"));
  main.replaceChildren(h("h1", {}, "Surrogates"), place, more, register, compare);
  return {
    async refresh() {
      const { found, rest } = await firstOf(wished);
      rows(found.map(({ created_at, queries, round, ...rest }) => rest), (surrogate) => surrogate.name);
      const wanted = found.length ? list : place.querySelector(".welcome") ?? EMPTY();
      if (place.firstChild !== wanted) place.replaceChildren(wanted);
      more.hidden = !rest;
      register.hidden = !found.length;
      compare.hidden = found.length < 2;
    },
    fail: (error) => place.replaceChildren(h("div", { class: "card bad", role: "alert" }, error.message)),
    repaint() {},
    close() {},
  };
}
