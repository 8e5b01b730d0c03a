// Lines over samples and over steps, by uPlot. Colours come from the style sheet.

import { css, h } from "/page/dom.js";
import { nines, number, percent } from "/page/format.js";

const uPlot = window.uPlot;
const HEIGHT = 190;
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

/** Confidence and leave-one-out error of each output against samples; the newest model of each number of samples. */
export function learningCurves() {
  const sure = chart("Confidence index of each output against samples");
  const error = chart("Leave-one-out error of each output against samples, in tolerances");
  const cursor = { sync: { key: "samples" }, drag: { x: false, y: false } };
  const samplesAxis = () => axis({ label: "real steps the model has seen", labelSize: 22, size: 34, labelFont: "12px system-ui", space: 40, incrs: [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000] });
  return {
    parts: [
      h("h3", {}, "Confidence index, by output"), sure.place,
      h("h3", {}, "Leave-one-out error, in tolerances"), error.place,
    ],
    show(models) {
      const latest = [...new Map(models.map((model) => [model.samples, model])).values()].sort((a, b) => a.samples - b.samples);
      const names = latest.at(-1).fidelity.outputs.map((output) => output.name);
      const x = latest.map((model) => model.samples);
      const of = (what) => names.map((name) => latest.map((model) => {
        const output = model.fidelity.outputs.find((candidate) => candidate.name === name);
        return output ? what(output) : null;
      }));
      const top = Math.min(9, Math.max(4, Math.ceil(nines(latest.at(-1).fidelity.target)) + 2));
      const xScale = { time: false, range: (_, low, high) => (low === high ? [low - 1, high + 1] : [low, high]) };
      sure.draw(() => ({
        cursor,
        scales: { x: xScale, y: { range: [0, top] } },
        axes: [samplesAxis(), axis({ size: 74, splits: () => SURE.keys().toArray?.().slice(0, top + 1) ?? [...SURE.keys()].slice(0, top + 1), values: (_, at) => at.map((k) => (k ? `${100 * SURE[k]} %`.replace(/(\.\d*?9)0+\d* %/, "$1 %") : "0")) })],
        series: [
          { label: "samples" },
          ...names.map((name, at) => line(name, at, { value: (plot, shown, series, index) => (index === null ? "–" : percent(of((output) => output.confidence_index)[at][index])) })),
          { ...dashed("target"), value: (plot, shown, series, index) => (index === null ? "–" : percent(latest[index].fidelity.target)) },
        ],
      }), [x, ...of((output) => Math.min(top, nines(output.confidence_index))), latest.map((model) => nines(model.fidelity.target))]);
      error.draw(() => ({
        cursor,
        scales: { x: xScale, y: { range: (_, low, high) => [Math.floor(Math.min(low, -1)), Math.ceil(Math.max(high, 1))] } },
        axes: [samplesAxis(), axis({ size: 74, incrs: [1, 2, 3], values: (_, at) => at.map((power) => (Math.abs(power) < 4 ? String(10 ** power) : `1e${power}`.replace("-", "−"))) })],
        series: [
          { label: "samples" },
          ...names.map((name, at) => line(name, at, { value: (_, value) => (value === null ? "–" : number(10 ** value)) })),
          { ...dashed("tolerance"), value: () => "1" },
        ],
      }), [x, ...of((output) => Math.log10(Math.max(LEAST_ERROR, output.leave_one_out_error / output.tolerance))), x.map(() => 0)]);
    },
    repaint: () => [sure, error].forEach((part) => part.repaint()),
    close: () => [sure, error].forEach((part) => part.close()),
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
