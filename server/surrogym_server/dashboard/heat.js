// A heat map on a canvas, with points over it: small enough to be our own.

import { css, h } from "/page/dom.js";
import { number } from "/page/format.js";

const FEW = 100; // samples; more are drawn as dots
const PAD = { left: 46, right: 10, top: 8, bottom: 34 };

/** Colours of a scale from nothing to much, as the style sheet has them: [[r, g, b], ...]. */
function colours(name) {
  return css(`--heat-${name}`).split(" ").map((hex) => [1, 3, 5].map((at) => parseInt(hex.slice(at, at + 2), 16)));
}

function colour(stops, share) {
  const at = Math.min(0.99999, Math.max(0, share)) * (stops.length - 1);
  const [from, to] = [stops[Math.floor(at)], stops[Math.floor(at) + 1]];
  return from.map((value, channel) => value + (to[channel] - value) * (at % 1));
}

/** `onpoint(x, y)` is called with what was clicked, dragged to, or moved to with the arrow keys. */
export function heatMap({ name, title, onpoint }) {
  const canvas = h("canvas", { tabindex: "0", role: "img" });
  const legend = h("div", { class: "legend" });
  const remark = h("p", { class: "note" });
  const figure = h("figure", { class: "heat" }, h("figcaption", {}, title), canvas, legend, remark);
  let shown = null;

  function frame() {
    const { width, height } = canvas.getBoundingClientRect();
    const [w, t] = [width - PAD.left - PAD.right, height - PAD.top - PAD.bottom];
    const { x, y } = shown;
    return {
      width, height, w, t,
      px: (value) => PAD.left + (w * (value - x.low)) / (x.high - x.low),
      py: (value) => PAD.top + t - (t * (value - y.low)) / (y.high - y.low),
      ux: (pixel) => Math.min(x.high, Math.max(x.low, x.low + ((pixel - PAD.left) / w) * (x.high - x.low))),
      uy: (pixel) => Math.min(y.high, Math.max(y.low, y.low + ((PAD.top + t - pixel) / t) * (y.high - y.low))),
    };
  }

  function draw() {
    if (!shown || !canvas.clientWidth) return;
    const f = frame();
    const scale = devicePixelRatio || 1;
    canvas.width = Math.round(f.width * scale);
    canvas.height = Math.round(f.height * scale);
    const pen = canvas.getContext("2d");
    pen.scale(scale, scale);
    if (shown.values) cells(pen, f);
    axes(pen, f);
    path(pen, f);
    const draws = shown.samples.length > FEW ? dot : marker;
    for (const sample of shown.samples) draws(pen, f.px(sample.x), f.py(sample.y), sample.purpose);
    cross(pen, f.px(shown.point.x), f.py(shown.point.y));
  }

  function cells(pen, f) {
    const { values, size, low, high } = shown;
    const stops = colours(name);
    const image = new ImageData(size, size);
    values.forEach((value, at) => {
      const row = size - 1 - Math.floor(at / size);
      image.data.set([...colour(stops, (value - low) / (high - low || 1)), 255], 4 * (row * size + (at % size)));
    });
    const small = new OffscreenCanvas(size, size);
    small.getContext("2d").putImageData(image, 0, 0);
    pen.imageSmoothingEnabled = true;
    pen.imageSmoothingQuality = "high";
    pen.drawImage(small, PAD.left, PAD.top, f.w, f.t);
  }

  function axes(pen, f) {
    const { x, y } = shown;
    pen.strokeStyle = css("--line");
    pen.strokeRect(PAD.left, PAD.top, f.w, f.t);
    pen.fillStyle = css("--muted");
    pen.font = "11px system-ui";
    pen.textAlign = "center";
    for (const share of [0, 0.5, 1]) {
      const value = x.low + share * (x.high - x.low);
      pen.textAlign = ["left", "center", "right"][2 * share];
      pen.fillText(number(value, 2), PAD.left + share * f.w, f.height - 20);
      pen.textAlign = "right";
      pen.fillText(number(y.low + share * (y.high - y.low), 2), PAD.left - 5, PAD.top + 9 + (1 - share) * (f.t - 9));
    }
    pen.fillStyle = css("--ink");
    pen.textAlign = "center";
    pen.fillText(x.name, PAD.left + f.w / 2, f.height - 5);
    pen.save();
    pen.translate(11, PAD.top + f.t / 2);
    pen.rotate(-Math.PI / 2);
    pen.fillText(y.name, 0, 0);
    pen.restore();
  }

  function marker(pen, x, y, purpose) {
    pen.beginPath();
    if (purpose === "adaptive") {
      pen.moveTo(x, y - 6); pen.lineTo(x + 6, y); pen.lineTo(x, y + 6); pen.lineTo(x - 6, y); pen.closePath();
    } else if (purpose === "manual") pen.rect(x - 4, y - 4, 8, 8);
    else pen.arc(x, y, 4.5, 0, 7);
    pen.fillStyle = css(`--${purpose}`);
    pen.fill();
    pen.lineWidth = 1.5;
    pen.strokeStyle = "#fff";
    pen.stroke();
  }

  function dot(pen, x, y, purpose) {
    pen.fillStyle = css(`--${purpose}`) || css("--manual");
    pen.globalAlpha = 0.7;
    pen.fillRect(x - 1.25, y - 1.25, 2.5, 2.5);
    pen.globalAlpha = 1;
  }

  function path(pen, f) {
    pen.save();
    pen.beginPath();
    pen.rect(PAD.left, PAD.top, f.w, f.t);
    pen.clip();
    for (const { points, mean } of shown.paths) {
      pen.beginPath();
      points.forEach(([x, y], at) => {
        const far = at && (Math.abs(x - points[at - 1][0]) > (shown.x.high - shown.x.low) / 2 || Math.abs(y - points[at - 1][1]) > (shown.y.high - shown.y.low) / 2);
        pen[at && !far ? "lineTo" : "moveTo"](f.px(x), f.py(y));
      });
      pen.lineWidth = mean ? 2.5 : 1;
      pen.strokeStyle = css(mean ? "--accent" : "--draw");
      pen.stroke();
    }
    pen.restore();
  }

  function cross(pen, x, y) {
    for (const [width, ink] of [[4, css("--card")], [2, css("--ink")]]) {
      pen.lineWidth = width;
      pen.strokeStyle = ink;
      pen.beginPath();
      pen.moveTo(x - 10, y); pen.lineTo(x + 10, y); pen.moveTo(x, y - 10); pen.lineTo(x, y + 10);
      pen.stroke();
    }
  }

  function pointed(event) {
    if (!shown || !(event.buttons & 1)) return;
    const box = canvas.getBoundingClientRect();
    const f = frame();
    onpoint(f.ux(event.clientX - box.left), f.uy(event.clientY - box.top));
  }

  canvas.addEventListener("pointerdown", (event) => { if (event.pointerType === "mouse") canvas.setPointerCapture(event.pointerId); pointed(event); });
  canvas.addEventListener("pointermove", (event) => event.pointerType === "mouse" && pointed(event));
  canvas.addEventListener("keydown", (event) => {
    const way = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
    if (!way || !shown) return;
    event.preventDefault();
    const [fine, { x, y, point }] = [event.shiftKey ? 10 : 50, shown];
    const held = (value, { low, high }) => Math.min(high, Math.max(low, value));
    onpoint(held(point.x + (way[0] * (x.high - x.low)) / fine, x), held(point.y + (way[1] * (y.high - y.low)) / fine, y));
  });
  const watcher = new ResizeObserver(draw);
  watcher.observe(canvas);

  return {
    figure,
    /** {x, y: {name, low, high}, size, values, low, high, lowText, highText, remark, samples, paths, point} */
    show(data) {
      shown = data;
      const bar = h("span", { class: "bar", role: "presentation" });
      bar.style.background = `linear-gradient(to right, ${css(`--heat-${name}`).split(" ").join(", ")})`;
      legend.replaceChildren(h("span", {}, data.lowText), bar, h("span", {}, data.highText));
      canvas.setAttribute("aria-label", `${title} over ${data.x.name} and ${data.y.name}: from ${data.lowText} to ${data.highText}. Arrow keys move the point, now at ${number(data.point.x)}, ${number(data.point.y)}.`);
      remark.textContent = data.remark;
      draw();
    },
    draw,
    close: () => watcher.disconnect(),
  };
}
