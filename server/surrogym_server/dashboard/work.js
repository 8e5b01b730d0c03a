// Trainings and evaluations that a worker runs: started here, followed while they run, stopped, and their results.

import { call, surrogate } from "/page/api.js";
import { lines } from "/page/charts.js";
import { h, shown } from "/page/dom.js";
import { count, moment, number, percent, seconds } from "/page/format.js";
import { sentence } from "/page/judged.js";
import { section } from "/page/parts.js";
import { evaluationForm, trainingForm } from "/page/workforms.js";

const LOOK_MS = 1_000; // while a job runs: no event tells of its progress
const HOME = ["http://127.0.0.1:8000", "http://localhost:8000"]; // where commands look by themselves
const SERVER = HOME.includes(location.origin) ? "" : ` --server ${location.origin}`;
const FEW = 5; // jobs that have ended
const OPEN = ["queued", "running"];
const STAGES = { preparing: "preparing", training: "training", auditing: "waiting for the real steps of the audit", evaluating: "running real episodes", storing: "storing the result" };

/** What a job asks for, in a few words. */
export function asked({ task }) {
  if (task.kind === "train") {
    const steps = task.preset === "quick" ? ", a quick look" : task.steps === null ? "" : `, ${count(task.steps)} virtual steps`;
    return `train${task.algorithm ? ` by ${task.algorithm}` : ""}, seed ${task.seed}${steps}`;
  }
  const others = [{ zero: "an action of zero", random: "random actions" }[task.compare], task.reference && "the reference controller"].filter(Boolean);
  const beside = (others.length ? `, compared with ${others.join(" and ")}` : "") + (task.video ? ", with a video" : "");
  const starts = task.wide ? " from anywhere in the sampling range" : "";
  return `evaluate version ${task.policy} in ${count(task.episodes)} real episodes${starts}${beside}`;
}

/** How far a job is, as one sentence. */
export function standing(job) {
  if (job.status === "queued") return job.attempts ? `Its worker fell silent (${job.worker}). It waits for another one.` : "It waits for a worker.";
  const stage = STAGES[job.stage] ?? "starting";
  const who = `${job.worker}: ${stage}`;
  const end = job.cancelling ? " It was asked to stop." : "";
  if (job.stage === "evaluating") return `${who}, ${percent(job.share)} done.${end}`;
  if (job.stage === "training" && job.total_steps && job.steps >= job.total_steps) return `${job.worker}: trained, the promise is being computed.${end}`;
  if (job.steps === null || !job.total_steps) return `${who}.${end}`;
  const imagined = job.imagined_return === null ? "the first check of the imagined return is to come" : `imagined return ${number(job.imagined_return)} at the last check`;
  return `${who}, ${count(job.steps)} of ${count(job.total_steps)} virtual steps, ${imagined}.${end}`;
}

/** A running job: its bar, its curve and a button; the same element from its first look to its last. */
function running(job, may, cancel) {
  const said = h("p", { class: "note" });
  const bar = h("progress", { max: 1, "aria-label": `how far job ${job.id} is` });
  const stop = h("button", { type: "button", onclick: () => cancel(job.id) }, `Cancel job ${job.id}`);
  const chart = job.task.kind === "train" ? lines(`Imagined return over the virtual steps of job ${job.id}`, 170) : null;
  const picture = chart && h("div", { hidden: true }, chart.place, h("p", { class: "note" }, "The policy learns while the line rises. The line shows what it earns in the virtual environment, not in the original one."));
  const element = h("div", { class: "job" }, h("h3", {}, `Job ${job.id}: ${asked(job)}`), said, bar, picture ?? "", h("div", { class: "buttons" }, stop));
  let drawn = 0;
  return {
    element,
    show(now) {
      said.textContent = standing(now);
      if (now.status === "running" && now.stage && now.stage !== "preparing") bar.value = now.share;
      else bar.removeAttribute("value");
      bar.hidden = now.status === "queued";
      stop.hidden = !may();
      stop.disabled = now.cancelling;
      const points = (now.curve ?? []).filter(({ imagined_return: value }) => value !== null);
      if (!chart || points.length < 2) return;
      picture.hidden = false;
      if (points.at(-1).steps === drawn) return;
      drawn = points.at(-1).steps;
      chart.show([points.map(({ steps }) => steps), points.map(({ imagined_return: value }) => value)], ["imagined return"], "virtual steps");
    },
    repaint: () => chart?.repaint(),
    close: () => chart?.close(),
  };
}

export function work(name, { role, refresh }) {
  const url = `${surrogate(name)}/jobs`;
  const connected = h("div", {});
  const said = h("p", { class: "note", role: "status" });
  const forms = h("div", { class: "two" });
  const open = h("div", {});
  const ended = h("div", {});
  const cards = new Map();
  const may = () => ["train", "admin"].includes(role());
  let policies = [];
  let all = false;
  let known = null;
  let timer = 0;
  let closed = false;
  let looking = false;

  let sending = false;

  async function attempt(work, done) {
    if (sending) return; // a second click
    sending = true;
    try {
      const job = await work();
      said.className = "note good";
      said.textContent = done(job);
    } catch (error) {
      said.className = "bad";
      said.textContent = error.message;
    } finally {
      sending = false;
    }
    look();
  }
  const start = (task) => attempt(() => call("POST", url, { task }), ({ id, task: { kind } }) => `Job ${id} is queued: a worker ${kind === "train" ? "trains" : "evaluates"} soon.`);
  const cancel = (id) => attempt(() => call("POST", `${url}/${id}:cancel`), ({ status }) => (status === "cancelled" ? `Job ${id} is cancelled.` : `Job ${id} was asked to stop. The best policy so far is stored.`));
  const training = trainingForm(start);
  const evaluation = evaluationForm(start);
  forms.append(training.element, evaluation.element);

  const workers = shown(connected, ({ workers: all, allowed, model }) => {
    const lack = (command, why) => h("p", {}, why, h("code", {}, command));
    const evaluates = all.some(({ most_episodes: most }) => most > 0);
    return [
      all.length
        ? h("p", {}, `Connected: ${all.map((one) => `${one.name} (${one.most_episodes ? `evaluates in up to ${count(one.most_episodes)} real episodes${one.reference ? ", has a reference controller" : ""}` : "only trains"})`).join(", ")}.`)
        : lack(`surrogym work ${name}${SERVER}`, "No worker is connected, so nothing can be started here. To start one: "),
      all.length && !evaluates && lack(`surrogym work ${name} --env package.module:factory${SERVER}`, "No worker evaluates. One that is started with the environment does: "),
      !model && h("p", {}, "There is no model yet. A training needs one."),
      !allowed && h("p", {}, `This token's role is ${role() ?? "unknown"}. One with role train or admin may start and cancel.`),
    ].filter(Boolean);
  });

  const result = (job) => {
    const policy = policies.find(({ version }) => version === job.version);
    if (!policy) return `Version ${job.version}, which is no longer stored.`;
    return [h("button", { class: "link", type: "button", onclick: () => reveal(job.version) }, `version ${job.version}`), `: ${sentence(policy)}`];
  };
  const past = shown(ended, ({ jobs, more }) => (jobs.length
    ? [h("h3", {}, "Ended, newest first"), h("ul", { class: "jobs", tabindex: "0", "aria-label": "Jobs that have ended" }, jobs.map(over)), more && h("button", { type: "button", onclick: () => { all = true; draw(); } }, `Show ${more} more`)].filter(Boolean)
    : []));
  const over = (job) => h("li", {}, h("p", {}, h("strong", {}, `Job ${job.id}: ${asked(job)} `), h("span", { class: `badge ${job.status}` }, job.status)),
    job.error && h("p", { class: job.status === "failed" ? "bad" : "" }, job.error),
    job.version !== null && h("p", {}, result(job)),
    h("p", { class: "note" }, [job.worker, moment(job.finished_at), job.begun_at !== null && `took ${seconds(job.finished_at - job.begun_at)}`].filter(Boolean).join(", ")));

  /** Opens the row of a policy, and goes there. */
  function reveal(version) {
    const row = [...document.querySelectorAll("#policies details")].find((one) => one.querySelector("strong")?.textContent === `version ${version}`);
    if (!row) return;
    row.open = true;
    row.scrollIntoView({ behavior: "smooth" });
    row.querySelector("summary").focus({ preventScroll: true });
  }

  function draw() {
    const { jobs, workers: there } = known;
    workers({ workers: there, allowed: may(), model: known.model });
    const most = Math.max(0, ...there.map(({ most_episodes: episodes }) => episodes));
    forms.hidden = !may();
    training.show({ ready: there.length > 0 && known.model });
    evaluation.show({ ready: most > 0 && policies.length > 0, most, policies, limit: known.limit, reference: there.some((one) => one.reference) });
    const over = jobs.filter(({ status }) => !OPEN.includes(status));
    const few = all ? over : over.slice(0, FEW);
    past({ jobs: few, more: over.length - few.length, policies: policies.map(({ version, promise, evaluations }) => [version, promise, evaluations.length]) });
  }

  async function follow(jobs) {
    const now = jobs.filter(({ status }) => OPEN.includes(status)).reverse();
    for (const [id, card] of cards) {
      if (now.some((job) => job.id === id)) continue;
      card.close();
      card.element.remove();
      cards.delete(id);
      const job = jobs.find((one) => one.id === id);
      if (job) announce(job);
    }
    const details = await Promise.all(now.map((job) => (job.status === "running" && job.task.kind === "train" ? call("GET", `${url}/${job.id}`) : job)));
    if (closed) return;
    for (const job of details) {
      if (!cards.has(job.id)) {
        cards.set(job.id, running(job, may, cancel));
        open.append(cards.get(job.id).element);
      }
      cards.get(job.id).show(job);
    }
  }

  function announce(job) {
    const where = job.version === null ? "" : ` Its policy is version ${job.version}.`;
    said.className = job.status === "failed" ? "bad" : "note good";
    said.textContent = `Job ${job.id} (${asked(job)}): ${job.status}${job.error ? `, ${job.error}` : ""}.${where}`;
    refresh();
  }

  /** Looks at the jobs; again after a moment while one is open. One look at a time. */
  async function look() {
    clearTimeout(timer);
    if (closed || looking) return;
    looking = true;
    try {
      known = { ...known, ...(await call("GET", url)) };
      if (closed) return;
      draw();
      await follow(known.jobs);
    } catch {
      // the page itself says that the server is away, or that the surrogate is gone
    } finally {
      looking = false;
    }
    if (!closed && document.visibilityState === "visible" && known?.jobs.some(({ status }) => OPEN.includes(status))) timer = setTimeout(look, LOOK_MS);
  }

  return {
    element: section("work", "Train and evaluate", "A worker on any machine runs what you start here. A training takes a few real steps for its audit, and more of the budget if the audit fails or if policies try episodes. An evaluation takes real steps.",
      connected, forms, said, open, ended),
    show({ now, policies: stored }) {
      policies = stored ?? policies;
      known = { ...(known ?? { jobs: [], workers: [] }), model: now.model_version !== null, limit: now.spec?.time_limit ?? null };
      look();
    },
    repaint: () => cards.forEach((card) => card.repaint()),
    close: () => {
      closed = true;
      clearTimeout(timer);
      cards.forEach((card) => card.close());
    },
  };
}
