"use strict";

const PERIOD_MS = 2000;
const status = document.getElementById("status");
const rows = document.getElementById("surrogates");
const login = document.getElementById("login");

function cells(surrogate) {
  const index = surrogate.confidence_index;
  return [
    surrogate.name,
    surrogate.environment,
    surrogate.paused ? `${surrogate.phase}, paused` : surrogate.phase,
    surrogate.samples,
    surrogate.model_version ?? "none yet",
    index === null ? "" : index.toFixed(4),
  ];
}

function show(surrogates) {
  rows.replaceChildren(...surrogates.map((surrogate) => {
    const row = document.createElement("tr");
    for (const text of cells(surrogate)) {
      row.insertCell().textContent = text;
    }
    return row;
  }));
  status.textContent = surrogates.length ? "" : "No surrogate is registered yet.";
}

async function refresh() {
  const token = sessionStorage.getItem("token");
  const headers = token ? { Authorization: `Bearer ${token}` } : {};
  try {
    const reply = await fetch("/v1/surrogates", { headers });
    const body = await reply.json();
    login.hidden = reply.status !== 401;
    if (reply.ok) {
      show(body.surrogates);
    } else {
      status.textContent = body.detail;
    }
  } catch {
    status.textContent = "The server does not answer.";
  }
  setTimeout(refresh, PERIOD_MS);
}

login.addEventListener("submit", (event) => {
  event.preventDefault();
  sessionStorage.setItem("token", document.getElementById("token").value);
});

refresh();
