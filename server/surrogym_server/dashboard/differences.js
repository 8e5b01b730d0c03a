// Differences of mean returns in real episodes, with intervals. Higher is better.

import { realOf } from "/page/judged.js";

const Z = 1.959964; // a 95 % interval reaches so many standard errors to both sides
// Acklam's approximation of the normal quantile, tail part
const OVER = [-7.784894002430293e-3, -3.223964580411365e-1, -2.400758277161838, -2.549732539343734, 4.374664141464968, 2.938163982698783];
const UNDER = [7.784695709041462e-3, 3.224671290700398e-1, 2.445134137142996, 3.754408661907416, 1];

const horner = (coefficients, x) => coefficients.reduce((sum, value) => sum * x + value, 0);
const mean = (values) => values.reduce((sum, value) => sum + value, 0) / values.length;

/** The z beyond which a standard normal has this share, for shares up to 0.025. */
export function tail(share) {
  const q = Math.sqrt(-2 * Math.log(share));
  return -horner(OVER, q) / horner(UNDER, q);
}

/** Whether two policies ran the same starts of the same machine, and the return of each episode is known. */
function paired(one, other) {
  const [a, b] = [realOf(one.policy), realOf(other.policy)];
  return a.seeded && b.seeded && a.first_seed === b.first_seed && a.note === b.note && one.returns.length > 1 && one.returns.length === other.returns.length;
}

function errorOf(one, other) {
  if (paired(one, other)) {
    const gaps = one.returns.map((value, at) => value - other.returns[at]);
    const middle = mean(gaps);
    return Math.sqrt(gaps.reduce((sum, gap) => sum + (gap - middle) ** 2, 0) / (gaps.length - 1) / gaps.length);
  }
  const error = ({ low, high }) => (high - low) / (2 * Z);
  return Math.hypot(error(realOf(one.policy).mean_interval), error(realOf(other.policy).mean_interval));
}

/**
 * How much higher the mean real return of `one` is: {by, low, high, paired}; null where that is not known.
 * Entries are {policy, returns}, with the return of each real episode where known. The intervals of all `pairs` that
 * are looked at hold together with 95 % chance (Bonferroni), so that the best of several is not flattered.
 */
export function difference(one, other, pairs = 1) {
  const [a, b] = [realOf(one.policy), realOf(other.policy)];
  if (!a?.mean_interval || !b?.mean_interval) return null;
  const reach = tail(0.025 / pairs) * errorOf(one, other);
  const by = a.mean - b.mean;
  return { by, low: by - reach, high: by + reach, paired: paired(one, other) };
}
