// What is shown where, and whether the server is there.

import { call, events, Gone, Problem, token } from "/page/api.js";
import { compareView } from "/page/compare.js";
import { h } from "/page/dom.js";
import { listView } from "/page/list.js";
import { registerView } from "/page/registering.js";
import { surrogateView } from "/page/surrogate.js";

const LOOK_MS = 3_000; // what no event tells of: steps of sessions, samplers that fall silent
const SOON_MS = 500;
const LATE_MS = 5_000;
const THEMES = ["system", "light", "dark"];

const main = document.getElementById("main");
const pill = document.getElementById("connection");
const banner = document.getElementById("gone");
const page = { view: null, role: null, state: "connecting", busy: false, again: false };

function say(state, text = state) {
  const back = page.state === "gone" && state === "live";
  page.state = state;
  pill.dataset.state = state;
  pill.textContent = back ? "back" : text;
  document.body.classList.toggle("stale", state === "gone");
  banner.hidden = state !== "gone";
}

/** A part of the address; as it is if it is no encoded text. */
function decoded(part) {
  try {
    return decodeURIComponent(part);
  } catch {
    return part;
  }
}

function route() {
  const [kind, ...names] = location.hash.slice(2).split("/").map(decoded);
  page.view?.close();
  if (kind === "compare") page.view = compareView(main, names);
  else if (kind === "register") page.view = registerView(main, { role: () => page.role });
  else if (kind === "s") page.view = surrogateView(main, names.join("/"), { role: () => page.role, refresh });
  else page.view = listView(main, { refresh });
  document.title = { compare: "Compare policies · Surrogym", register: "Register an environment · Surrogym", s: `${names.join("/")} · Surrogym` }[kind] ?? "Surrogym";
  refresh();
}

/** Looks again; while a look is under way, once more after it. */
async function refresh() {
  if (page.busy) {
    page.again = true;
    return;
  }
  if (page.state === "locked") return;
  page.busy = true;
  try {
    await page.view.refresh();
    if (page.state === "gone") say("live");
  } catch (error) {
    if (error.name !== "AbortError") failed(error);
  } finally {
    page.busy = false;
    if (page.again) {
      page.again = false;
      setTimeout(refresh, 0);
    }
  }
}

function failed(error) {
  if (error instanceof Problem && error.status === 401) locked(error);
  else if (error instanceof Gone) lost();
  else {
    page.view.fail(error);
    if (!(error instanceof Problem)) throw error;
  }
}

function lost(seconds) {
  say("gone", "server gone");
  banner.textContent = "The server does not answer. The page shows the last state that it received, and tries again "
    + (seconds ? `in ${seconds} s.` : "by itself.");
}

/** Follows the server for as long as the page is open, through its restarts. */
async function follow() {
  let wait = SOON_MS;
  for (;;) {
    try {
      for await (const { event } of events("/v1/events", new AbortController().signal)) {
        if (event === "open") {
          const access = await call("GET", "/v1/access");
          page.role = access.role;
          keys(access);
          say("live");
          wait = SOON_MS;
        }
        if (event !== "silence") refresh();
      }
    } catch (error) {
      if (error instanceof Problem && error.status === 401) {
        await locked(error);
        continue;
      }
    }
    lost(Math.max(1, Math.round(wait / 1e3)));
    await new Promise((resolve) => setTimeout(resolve, wait));
    wait = Math.min(LATE_MS, wait * 2);
  }
}

let unlocking = null;

/** Asks for a token; the promise is kept once one was given. */
function locked(error) {
  unlocking ??= new Promise((resolve) => {
    say("locked", "token needed");
    page.view?.close();
    const known = token.get();
    const input = h("input", { id: "token", type: "password", autocomplete: "off", spellcheck: "false", required: true });
    const form = h("form", { class: "lock card" },
      h("h1", {}, "This server needs a token"),
      h("p", {}, "Role ", h("code", {}, "read"), " is enough to view this page; ", h("code", {}, "admin"), " may pause, change and delete. The token is kept only in this tab, until the tab is closed."),
      known && h("p", { class: "bad", role: "alert" }, `The server refused this token: ${error.message}`),
      h("label", { for: "token" }, "Token"), input, h("button", { class: "main" }, "Open"));
    form.addEventListener("submit", (event) => {
      event.preventDefault();
      token.set(input.value.trim());
      unlocking = null;
      say("connecting");
      route();
      resolve();
    });
    main.replaceChildren(form);
    input.focus();
  });
  return unlocking;
}

function keys(access) {
  const button = document.getElementById("role");
  button.hidden = !access.tokens;
  document.getElementById("docs").hidden = access.tokens; // a link carries no token
  button.textContent = `Role: ${access.role}, sign out`;
}

function theme(next) {
  const chosen = next ?? localStorage.getItem("surrogym-theme") ?? "system";
  localStorage.setItem("surrogym-theme", chosen);
  document.documentElement.dataset.theme = chosen;
  const button = document.getElementById("theme");
  button.setAttribute("aria-label", `Theme: ${chosen}`);
  button.lastChild.textContent = chosen;
  page.view?.repaint();
}

document.getElementById("theme").addEventListener("click", () => {
  theme(THEMES[(THEMES.indexOf(document.documentElement.dataset.theme) + 1) % THEMES.length]);
});
document.getElementById("role").addEventListener("click", () => {
  token.set(null);
  location.reload();
});
document.querySelector(".skip").addEventListener("click", (event) => {
  event.preventDefault();
  main.focus();
});
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => page.view?.repaint());
addEventListener("hashchange", route);
theme();
route();
setInterval(() => document.visibilityState === "visible" && ["live", "gone"].includes(page.state) && refresh(), LOOK_MS);
follow();
