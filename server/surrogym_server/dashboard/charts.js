// Lines over samples and over steps, by uPlot. Colours come from the style sheet.

import { unbroken } from "/page/angles.js";
import { css, h } from "/page/dom.js";
import { nines, number, percent } from "/page/format.js";

const uPlot = window.uPlot;
const HEIGHT = 190;
const LEARNING_HEIGHT = 240;
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

const samplesAxis = (more) => axis({ label: "real steps the model has seen", font: FONT, labelFont: FONT, labelSize: 20, size: 34, space: 40, incrs: [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000], ...more });
const FONT = "12px system-ui";
const STROKES = [[], [8, 5], [2, 4]];
const DASHES = ["solid", "dashed", "dotted"]; // the same in a legend
const samplesScale = { time: false, range: (_, low, high) => (low === high ? [low - 1, high + 1] : [low, high]) };

/** Where no point is pointed at, the legend has the values of the last one. */
const lastShown = { hooks: { setCursor: [(plot) => plot.cursor.idx === null && plot.setLegend({ idx: plot.data[0].length - 1 }, false)], ready: [(plot) => plot.setLegend({ idx: plot.data[0].length - 1 }, false)] } };

/** Confidence and leave-one-out error of each output against samples, one picture each; the newest model of each number of samples. */
export function learningCurves() {
  const [sure, wrong] = [chart("Confidence index of each output against samples"), chart("Leave-one-out error of each output, in tolerances, against samples")];
  const which = h("select", {}, h("option", {}, ALL));
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
    const x = latest.map((model) => model.samples);
    const series = (drawn, value, limit, limitValue) => [
      { label: "samples" }, ...names.map((name, at) => line(name, colour(name), { value: (plot, shown, which, place) => (place === null ? "" : value(at, place)) })),
      { ...dashed(limit), value: (plot, shown, which, place) => (place === null ? "" : limitValue(place)) }];
    const top = Math.max(4, Math.ceil(nines(fidelity.target)) + 2);
    sure.draw(() => ({
      ...lastShown, height: LEARNING_HEIGHT, cursor: { drag: { x: false, y: false } }, scales: { x: samplesScale, y: { range: [0, top] } },
      axes: [samplesAxis(), axis({ font: FONT, labelFont: FONT, labelSize: 20, label: "confidence index", size: 60, splits: () => [...SURE.keys()].slice(0, top + 1), values: (_, at) => at.map((k) => (k ? `${100 * SURE[k]} %`.replace(/(\.\d*?9)0+\d* %/, "$1 %") : "0")) })],
      series: series(index, (at, place) => percent(index[at][place]), "target", (place) => percent(latest[place].fidelity.target)),
    }), [x, ...index.map((shares) => shares.map((share) => share && Math.min(top, nines(share)))), latest.map((model) => nines(model.fidelity.target))]);
    wrong.draw(() => ({
      ...lastShown, height: LEARNING_HEIGHT, cursor: { drag: { x: false, y: false } }, scales: { x: samplesScale },
      axes: [samplesAxis(), axis({ font: FONT, labelFont: FONT, labelSize: 20, label: "error / tolerance", size: 60, incrs: [1, 2, 3], values: (_, at) => at.map(power) })],
      series: series(errors, (at, place) => (errors[at][place] === null ? "" : number(10 ** errors[at][place])), "allowed", () => "1"),
    }), [x, ...errors, latest.map(() => 0)]);
  }
  which.addEventListener("change", draw);

  return {
    parts: [
      h("div", { class: "picks" }, h("label", { class: "pick" }, "of", which)),
      h("div", { class: "two" },
        h("div", {}, h("h3", {}, "How sure it was"), h("p", { class: "note" }, "A line above the dashed one has reached the target."), sure.place),
        h("div", {}, h("h3", {}, "How wrong it was"), h("p", { class: "note" }, "A line below the dashed one is within tolerance."), wrong.place)),
    ],
    show(models) {
      latest = [...new Map(models.map((model) => [model.samples, model])).values()].sort((a, b) => a.samples - b.samples);
      const names = [ALL, ...latest.at(-1).fidelity.outputs.map((output) => output.name)];
      const kept = which.value;
      which.replaceChildren(...names.map((name) => h("option", {}, name)));
      which.value = names.includes(kept) ? kept : ALL;
      draw();
    },
    repaint: () => [sure, wrong].forEach((part) => part.repaint()),
    close: () => [sure, wrong].forEach((part) => part.close()),
  };
}

/** A plain chart of lines that differ by their strokes; `show(data, names, x)` draws it. */
export function lines(label, height) {
  const part = chart(label);
  part.place.classList.add("stroked");
  return {
    place: part.place,
    show: (data, names, x) => part.draw(() => ({
      height: height + (names.length > 1 ? 0 : 20),
      cursor: { show: false },
      legend: { show: names.length > 1, live: false, markers: { width: 1, stroke: LEGEND.markers.fill, fill: () => "transparent", dash: (plot, at) => DASHES[(at - 1) % DASHES.length] } },
      scales: { x: { time: false } },
      axes: [axis({ size: x ? 40 : 26, space: x ? 90 : 45, label: x, labelFont: FONT, labelSize: 16 }), axis({ size: 56, space: 22, values: (_, at) => at.map((value) => number(value, 2)) })],
      series: [{}, ...names.map((name, at) => ({ label: name, stroke: css(`--series-${at}`), width: 2, dash: STROKES[at % STROKES.length], points: { show: false } }))],
    }), data),
    repaint: part.repaint,
    close: part.close,
  };
}

/** An imagined episode: one small chart for each coordinate and the reward; draws thin, the mean thick. */
export function episodeCharts(coordinates) {
  const names = [...coordinates.map((coordinate) => coordinate.name), "reward"];
  const charts = names.map((name) => chart(`Imagined ${name} against steps: the mean and drawn episodes`));
  const place = h("div", { class: "episodes" }, names.map((name, at) => h("div", {}, h("h4", {}, name), charts[at].place)));
  const filled = (values, length) => [...values, ...Array(length - values.length).fill(null)];
  return {
    place,
    show(imagined) {
      const all = [...imagined.draws, imagined.mean];
      const length = Math.max(...all.map((episode) => episode.coordinates.length));
      charts.forEach((part, which) => {
        const reward = which === coordinates.length;
        const values = all.map((episode) => (reward ? [null, ...episode.reward] : episode.coordinates.map((q) => q[which])));
        const rows = (coordinates[which]?.kind === "angle" ? unbroken(values, 0) : values).map((row) => filled(row, length));
        part.draw(() => ({
          height: 130,
          legend: { show: false },
          cursor: { show: false },
          scales: { x: { time: false } },
          axes: [axis({ size: 26, space: 45 }), axis({ size: 56, space: 22, values: (_, at) => at.map((value) => number(value, 2)) })],
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
