// Numbers and times as people read them.

/** Three significant digits, without a needless exponent. */
export function number(value, digits = 3) {
  if (value === null || value === undefined) return "–";
  if (!Number.isFinite(value)) return String(value);
  if (value === 0) return "0";
  if (Math.abs(value) < 1e-12) return "≈ 0";
  const size = Math.abs(value);
  if (size >= 1e6 || size < 1e-3) return value.toExponential(digits - 1).replace("e+", "e").replace("-", "−");
  const decimals = Math.max(0, digits - 1 - Math.floor(Math.log10(size)));
  return value.toFixed(Math.min(decimals, 6)).replace("-", "−");
}

export const count = (value) => Math.round(value).toLocaleString("en").replaceAll(",", " ");

/** A share as percent, never rounded up to a hundred that it is not. */
export function percent(share) {
  if (share === null || share === undefined) return "–";
  if (share === 1) return "100 %";
  if (share > 0.9999) return "> 99.99 %";
  const shown = share >= 0.99 ? Math.floor(share * 1e4) / 100 : Math.floor(share * 1e3) / 10;
  return `${shown} %`;
}

/** How many nines a share has: 0.99 has two. The scale on which confidence can be told apart. */
export const nines = (share) => Math.min(9, -Math.log10(Math.max(1e-9, 1 - share)));

export const plural = (many, one, more = `${one}s`) => `${count(many)} ${many === 1 ? one : more}`;

export function seconds(value) {
  if (value < 1) return `${Math.round(value * 1e3)} ms`;
  if (value < 90) return `${number(value, 2)} s`;
  if (value < 5400) return `${Math.round(value / 60)} min`;
  return value < 129600 ? `${Math.round(value / 3600)} h` : `${Math.round(value / 86400)} days`;
}

export const moment = (at) => new Date(at * 1e3).toLocaleString([], { dateStyle: "medium", timeStyle: "short" });

export const vector = (values) => (values ? `(${values.map((value) => number(value)).join(", ")})` : "–");

export const PHASES = {
  collecting: "collecting",
  fitting: "fitting",
  sampling: "sampling",
  ready: "ready",
  over_budget: "not ready",
  unsure: "not ready",
  from_log: "from a log",
  failed: "failed",
};

export const MEANING = {
  collecting: "the first real steps are being taken",
  fitting: "the model is learning from new real steps",
  sampling: "the design queries real steps where the model is uncertain",
  ready: "the model has reached its target",
  over_budget: "the budget is spent, and the model is below its target; it can be used all the same",
  unsure: "the design has ended before its budget was spent, and the model is below its target; it can be used all the same",
  from_log: "the model is fitted to the log, and the design requests no real steps",
  failed: "the design stopped with an error",
};
