// Elements by hand: no markup in strings, so nothing that a server says can become markup.

const SVG = new Set(["svg", "polyline", "line", "circle", "path", "rect", "text", "title"]);

/** h("p", {class: "note", onclick: f}, "text", otherElement) makes an element. */
export function h(tag, properties = {}, ...children) {
  const element = SVG.has(tag) ? document.createElementNS("http://www.w3.org/2000/svg", tag) : document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (value === null || value === undefined || value === false) continue;
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else if (name === "value") element.value = value;
    else element.setAttribute(name, value === true ? "" : value);
  }
  element.append(...children.flat(Infinity).filter((child) => child !== null && child !== undefined && child !== false));
  return element;
}

/** Runs `build` only where `data` differs from what it built last, so that nothing loses focus for no reason. */
export function shown(parent, build) {
  let last = null;
  return (data) => {
    const now = JSON.stringify(data);
    if (now === last) return;
    last = now;
    parent.replaceChildren(...[build(data)].flat());
  };
}

/** Puts one child a key into `parent`, in order; a child whose data did not change stays the same element. */
export function keyed(parent, build) {
  const known = new Map();
  return (items, key) => {
    const keep = new Set(items.map(key));
    for (const old of known.keys()) if (!keep.has(old)) known.delete(old);
    const children = items.map((item) => {
      const text = JSON.stringify(item);
      const entry = known.get(key(item));
      if (entry?.text === text) return entry.element;
      const element = build(item);
      known.set(key(item), { text, element });
      return element;
    });
    if (children.length !== parent.children.length || children.some((child, at) => parent.children[at] !== child)) {
      parent.replaceChildren(...children);
    }
  };
}

export const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

/** A function that waits until it was not called for `milliseconds`; its last call wins. */
export function debounced(milliseconds, work) {
  let timer = 0;
  return (...given) => {
    clearTimeout(timer);
    timer = setTimeout(() => work(...given), milliseconds);
  };
}

/** Runs asynchronous work of which only the newest matters: an older one is aborted. */
export function newest(work) {
  let running = null;
  return async (...given) => {
    running?.abort();
    const mine = (running = new AbortController());
    try {
      await work(mine.signal, ...given);
    } catch (error) {
      if (!mine.signal.aborted) throw error;
    }
  };
}
