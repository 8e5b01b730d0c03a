// What the page says of a policy: promise beside real return. Higher is better.

import { number, percent, plural } from "/page/format.js";

const newest = (evaluations, wanted) => evaluations.filter(wanted).at(-1) ?? null;

/** The newest real episodes of a policy in the surrogate's own environment from the declared starts. */
export const realOf = ({ evaluations }) => newest(evaluations, ({ controller, declared, own }) => controller === "policy" && declared && own);

/** The newest real episodes of other controllers from the same starts. */
function besides(policy, controllers) {
  const real = realOf(policy);
  return real?.seeded && newest(policy.evaluations, ({ controller, first_seed: seed, note, own, seeded }) =>
    own && seeded && controllers.includes(controller) && seed === real.first_seed && note === real.note);
}

export const withoutOf = (policy) => besides(policy, ["zero", "random"]);
export const referenceOf = (policy) => besides(policy, ["reference"]);

const mark = (kind, { mean, mean_interval: interval }) => ({ kind, value: mean, low: interval?.low ?? null, high: interval?.high ?? null });

/** The mark of its real episodes for `ranges`. */
export const realMark = (policy) => mark("real", realOf(policy));

/** The marks of a policy for `ranges`. */
export function marksOf(policy) {
  const [real, without, reference] = [realOf(policy), withoutOf(policy), referenceOf(policy)];
  return [
    policy.promise && { kind: "promise", value: policy.promise.median, low: policy.promise.low, high: policy.promise.high },
    real && mark("real", real),
    without && mark("without", without),
    reference && mark("reference", reference),
  ].filter(Boolean);
}

export function meanWords({ mean, mean_interval: interval }) {
  return number(mean, 4) + (interval ? ` (${number(interval.low)} to ${number(interval.high)})` : "");
}

/** In words: what it promised, what came, and why that is not trusted. */
export function sentence(policy) {
  return `${outcome(policy)}${policy.trusted === false ? ` Not trusted: ${policy.reason}.` : ""}`;
}

/** An episode that leaves a limit has a fallback, too. */
function fallbacks({ fallback }) {
  if (!fallback) return "";
  return `; the fallback is expected in ${percent(fallback.mean ?? fallback.median)} of the episodes (${percent(fallback.low)} to ${percent(fallback.high)}), so no more leave a limit`;
}

function outcome(policy) {
  const [real, { promise }] = [realOf(policy), policy];
  const said = promise ? `Promised ${number(promise.low)} to ${number(promise.high)}${fallbacks(promise)}` : "No promise";
  if (!real) return `${said}; no real episodes from the declared starts yet.`;
  const unjudged = promise ? ": too few to judge the promise" : "";
  const kept = real.promise_kept === null ? unjudged : real.promise_kept ? ": the promise was kept" : ": the promise was broken";
  const success = real.success_rate === null ? "" : `; ${percent(real.success_rate)} succeeded`;
  const limits = real.limits ? ` Limits: ${real.limits.said}.` : "";
  return `${said}; real mean return ${meanWords(real)} in ${plural(real.episodes, "episode")}${success}${kept}.${limits}`;
}
