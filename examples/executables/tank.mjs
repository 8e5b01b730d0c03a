// A tank with an outflow at the bottom: a step of 1 s changes the level by the inflow, which is the action.
//
//   surrogym conformance --exec "node examples/executables/tank.mjs"

import { createInterface } from "node:readline";

const AREA = 2, OUTFLOW = 0.4, HIGHEST = 2, WANTED = 1; // m2, m2.5/s, m, m
const level = { parts: [{ function: "linear", coefficient: 1, weights: { level: 1 } }], low: null, high: null };
const SPEC = {
  environment: "tank-node",
  coordinates: [
    {
      name: "level",
      unit: "m",
      sampling: { kind: "uniform", low: 0, high: HIGHEST },
      bounds: { low: 0, high: HIGHEST },
    },
  ],
  observation: [{ name: "level", term: level, low: 0, high: HIGHEST }],
  action: { kind: "box", low: [0], high: [1] },
  start: { level: { kind: "uniform", low: 0.2, high: 0.8 } },
  time_limit: 50,
  sampling_period: 1,
  limits: {
    keep: [{ name: "brim", term: level, high: 1.8, margin: 0.6, unit: "m" }],
    fallback: [{ parts: [{ function: "one", coefficient: 0, weights: {} }] }], // close the inflow
  },
};

let h = 0.5, closed = false;

class Invalid extends Error {}

function go(to) {
  h = to;
  return { state: [h] };
}

function only(list, name) {
  if (!Array.isArray(list) || list.length !== 1 || !Number.isFinite(list[0])) {
    throw new Invalid(`expected one number for ${name}, got ${JSON.stringify(list)}`);
  }
  return list[0];
}

// A number in [0, 1) that depends on the seed alone, by mulberry32.
function uniform(seed) {
  let t = (seed + 0x6d2b79f5) | 0;
  t = Math.imul(t ^ (t >>> 15), t | 1);
  t ^= t + Math.imul(t ^ (t >>> 7), t | 61);
  return ((t ^ (t >>> 14)) >>> 0) / 2 ** 32;
}

const METHODS = {
  spec: () => ({ protocol: 1, spec: SPEC }),
  reset: ({ seed }) => go(0.2 + 0.6 * (seed === null ? Math.random() : uniform(seed))),
  set: ({ state }) => go(only(state, "state")),
  get: () => ({ state: [h] }),
  save: () => ({ snapshot: JSON.stringify(h) }),
  restore: ({ snapshot }) => go(JSON.parse(snapshot)),
  step: ({ action }) => {
    const inflow = only(action, "action");
    go(Math.min(HIGHEST, Math.max(0, h + (inflow - OUTFLOW * Math.sqrt(h)) / AREA)));
    return { state: [h], reward: -((h - WANTED) ** 2), terminated: false, truncated: false };
  },
  close: () => {
    closed = true;
    return {};
  },
};

for await (const line of createInterface({ input: process.stdin })) {
  const answer = { id: null };
  let method;
  try {
    const request = JSON.parse(line);
    answer.id = request.id;
    method = request.method;
    if (Object.hasOwn(METHODS, method)) answer.result = METHODS[method](request);
    else Object.assign(answer, { error: `expected ${Object.keys(METHODS)}, got ${method}`, code: "unsupported" });
  } catch (error) {
    const invalid = error instanceof Invalid || error instanceof SyntaxError;
    Object.assign(answer, { error: error.message, code: invalid ? "invalid" : "failed" });
  }
  process.stdout.write(`${JSON.stringify(answer)}\n`);
  if (closed) break;
}
process.stdin.destroy(); // or Node waits for further lines
if (!closed) { // the sampler was killed, so nobody else closes the inflow
  let steps = 0, before;
  do {
    before = h;
    METHODS.step({ action: [0] });
    steps += 1;
  } while (before - h > 1e-3 && steps < 200);
  process.stdout.write(`${JSON.stringify({ fallback: steps })}\n`);
}
