// Lines over samples and over steps, by uPlot. Colours come from the style sheet.

import { css, h } from "/page/dom.js";
import { nines, number, percent } from "/page/format.js";

const uPlot = window.uPlot;
const HEIGHT = 190;
const LEARNING_HEIGHT = 280;
const ALL = "every output";
const LEGEND = { markers: { fill: (plot, at) => plot.series[at].stroke(plot, at) } };
const LEAST_ERROR = 1e-6;
const SURE = [0, 0.9, 0.99, 0.999, 0.9999, 0.99999, 0.999999, 0.9999999, 0.99999999, 0.999999999];

const axis = (more) => ({ stroke: css("--muted"), grid: { stroke: css("--line"), width: 1 }, ticks: { show: false }, font: "12px system-ui", ...more });
const line = (label, at, more) => ({ label, stroke: css(`--series-${at % 6}`), width: 2, points: { show: true, size: 5 }, ...more });
const dashed = (label) => ({ label, stroke: css("--ink"), width: 1.5, dash: [6, 4], points: { show: false } });

/** A place for a chart that is as wide as its place; `options(width)` and the data are given with each drawing. */
function chart(label) {
  const place = h("div", { class: "plot", role: "img", "aria-label": label });
  let plot = null;
  let last = null;
  function draw(options, data) {
    last = [options, data];
    plot?.destroy();
    plot = new uPlot({ width: Math.max(240, place.clientWidth), height: HEIGHT, legend: LEGEND, ...options() }, data, place);
  }
  const watcher = new ResizeObserver(() => plot && plot.setSize({ width: Math.max(240, place.clientWidth), height: plot.height }));
  watcher.observe(place);
  return { place, draw, repaint: () => last && draw(...last), close: () => watcher.disconnect() };
}

/** Heights of the two scales, so that the target of the one and the tolerance of the other are the same line. */
function heights(target, errors) {
  const top = Math.max(4, Math.ceil(nines(target)) + 2);
  const line = nines(target) / top;
  const span = Math.max(2, -Math.min(0, ...errors) / line, Math.max(0, ...errors) / (1 - line));
  return { top, error: [-line * span, (1 - line) * span] };
}

/** Confidence and leave-one-out error of each output against samples; the newest model of each number of samples. */
export function learningCurves() {
  const both = chart("Confidence index and leave-one-out error of each output against samples");
  const which = h("select", {}, h("option", {}, ALL));
  const text = { font: "12px system-ui", labelFont: "12px system-ui", labelSize: 20 };
  const power = (value) => (Math.abs(value) < 4 ? String(10 ** value) : `1e${value}`.replace("-", "−"));
  let latest = [];

  function draw() {
    const { fidelity } = latest.at(-1);
    const names = fidelity.outputs.map((output) => output.name).filter((name) => [ALL, name].includes(which.value));
    const colour = (name) => fidelity.outputs.findIndex((output) => output.name === name);
    const of = (what) => names.map((name) => latest.map((model) => {
      const output = model.fidelity.outputs.find((candidate) => candidate.name === name);
      return output ? what(output) : null;
    }));
    const index = of((output) => output.confidence_index);
    const errors = of((output) => (output.leave_one_out_error === null ? null : Math.log10(Math.max(LEAST_ERROR, output.leave_one_out_error / output.tolerance))));
    const { top, error } = heights(fidelity.target, errors.flat());
    const x = latest.map((model) => model.samples);
    both.draw(() => ({
      height: LEARNING_HEIGHT,
      cursor: { drag: { x: false, y: false } },
      scales: { x: { time: false, range: (_, low, high) => (low === high ? [low - 1, high + 1] : [low, high]) }, y: { range: [0, top] }, error: { range: error } },
      axes: [
        axis({ ...text, label: "real steps the model has seen", size: 34, space: 40, incrs: [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000] }),
        axis({ ...text, label: "confidence index", size: 60, splits: () => [...SURE.keys()].slice(0, top + 1), values: (_, at) => at.map((k) => (k ? `${100 * SURE[k]} %`.replace(/(\.\d*?9)0+\d* %/, "$1 %") : "0")) }),
        axis({ ...text, scale: "error", side: 1, label: "error / tolerance", size: 48, grid: { show: false }, incrs: [1, 2, 3], values: (_, at) => at.map(power) }),
      ],
      series: [
        { label: "samples" },
        ...names.map((name, at) => line(name, colour(name), { value: (plot, shown, series, place) => (place === null ? "–" : percent(index[at][place])) })),
        { ...dashed("target"), value: (plot, shown, series, place) => (place === null ? "–" : percent(latest[place].fidelity.target)) },
        ...names.map((name) => line(`${name}, error`, colour(name), { scale: "error", dash: [2, 4], points: { show: true, size: 3 }, value: (_, value) => (value === null ? "–" : number(10 ** value)) })),
      ],
    }), [x, ...index.map((shares) => shares.map((share) => share && Math.min(top, nines(share)))), latest.map((model) => nines(model.fidelity.target)), ...errors]);
  }
  which.addEventListener("change", draw);

  return {
    parts: [
      h("div", { class: "picks" }, h("label", { class: "pick" }, "of", which)),
      h("p", { class: "note" }, "Solid, left: confidence index. Dotted, right: leave-one-out error in tolerances. Dashed: the target of the one and a whole tolerance of the other."),
      both.place,
    ],
    show(models) {
      latest = [...new Map(models.map((model) => [model.samples, model])).values()].sort((a, b) => a.samples - b.samples);
      const names = [ALL, ...latest.at(-1).fidelity.outputs.map((output) => output.name)];
      const kept = which.value;
      which.replaceChildren(...names.map((name) => h("option", {}, name)));
      which.value = names.includes(kept) ? kept : ALL;
      draw();
    },
    repaint: both.repaint,
    close: both.close,
  };
}

/** An imagined episode: one small chart for each coordinate and the reward; draws thin, the mean thick. */
export function episodeCharts(coordinates) {
  const names = [...coordinates.map((coordinate) => coordinate.name), "reward"];
  const charts = names.map((name) => chart(`Imagined ${name} against steps: the mean and drawn episodes`));
  const place = h("div", { class: "episodes" }, names.map((name, at) => h("div", {}, h("h4", {}, name), charts[at].place)));
  const jumps = (values, kind) => (kind !== "angle" ? values : values.map((value, at) => (at && Math.abs(value - values[at - 1]) > Math.PI ? null : value)));
  const filled = (values, length) => [...values, ...Array(length - values.length).fill(null)];
  return {
    place,
    show(imagined) {
      const all = [...imagined.draws, imagined.mean];
      const length = Math.max(...all.map((episode) => episode.coordinates.length));
      charts.forEach((part, which) => {
        const reward = which === coordinates.length;
        const rows = all.map((episode) => filled(reward ? [null, ...episode.reward] : jumps(episode.coordinates.map((q) => q[which]), coordinates[which].kind), length));
        part.draw(() => ({
          height: 130,
          legend: { show: false },
          cursor: { show: false },
          scales: { x: { time: false } },
          axes: [axis({ size: 26, space: 45 }), axis({ size: 52, space: 22 })],
          series: [{}, ...rows.map((_, at) => at === rows.length - 1
            ? { stroke: css("--accent"), width: 2.5, points: { show: false } }
            : { stroke: css("--draw"), width: 1, points: { show: false } })],
        }), [[...Array(length).keys()], ...rows]);
      });
    },
    repaint: () => charts.forEach((part) => part.repaint()),
    close: () => charts.forEach((part) => part.close()),
  };
}
