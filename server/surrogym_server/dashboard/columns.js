// Roles of a log's columns: a select for each column of its heading. The mapping as text stays the one that is sent.

import { h } from "/page/dom.js";

const HEADING_BYTES = 256 * 1024;
const MOST_COLUMNS = 64; // a log with more needs the text
const DELIMITERS = [",", ";", "\t"];
const SINGLE = {
  reward: "reward",
  episode: "number of the episode",
  time: "time",
  terminated: "whether a rule ended the episode",
  truncated: "whether the episode was cut off",
};

/** The columns of a CSV file, by its first line. */
export async function headingOf(file) {
  const [line] = (await file.slice(0, HEADING_BYTES).text()).replace(/^\ufeff/, "").split(/\r?\n/, 1);
  const delimiter = DELIMITERS.reduce((best, one) => (line.split(one).length > line.split(best).length ? one : best));
  const cells = line.matchAll(new RegExp(`(?:"((?:[^"]|"")*)"|([^${delimiter}]*))(?:${delimiter}|$)`, "g"));
  const names = [...cells].filter(({ index }) => index < line.length).map(([, quoted, plain]) => (quoted?.replaceAll('""', '"') ?? plain).trim());
  return names.filter(Boolean);
}

const pairs = (columns, nameOf) => (Array.isArray(columns) ? columns.map((column, at) => [nameOf(column, at), column]) : Object.entries(columns ?? {}));

/** The role of each column, as the value of its select. `own`: the coordinates have no names but those of their columns. */
function rolesOf(mapping, own) {
  const roles = new Map();
  const states = pairs(mapping.state, (column) => column);
  const columnOf = new Map(states);
  for (const [name, column] of states) roles.set(column, own ? "state" : `state:${name}`);
  pairs(mapping.action, (_, at) => String(at)).forEach(([, column], at) => roles.set(column, `action:${at}`));
  for (const [name, column] of Object.entries(mapping.next ?? {})) roles.set(column, `next:${own ? columnOf.get(name) : name}`);
  for (const role of Object.keys(SINGLE)) if (mapping[role]) roles.set(mapping[role], role);
  return roles;
}

/** The mapping of these roles. What selects can't say, such as limits, is kept from the earlier one. */
function mappingOf(roles, earlier, own) {
  const names = new Map(pairs(earlier.state, (column) => column).map(([name, column]) => [column, name]));
  const entries = pairs(earlier.action, (_, at) => String(at)).map(([name]) => name);
  const nameOf = (column) => names.get(column) ?? column;
  const mapping = { ...earlier, state: {}, action: {}, next: {} };
  for (const role of Object.keys(SINGLE)) delete mapping[role];
  for (const [column, value] of roles) {
    const [role, name] = [value.split(":", 1)[0], value.slice(value.indexOf(":") + 1)];
    if (role === "state") mapping.state[own ? nameOf(column) : name] = column;
    else if (role === "next") mapping.next[own ? nameOf(name) : name] = column;
    else if (role === "action") mapping.action[entries[name] ?? name] = column;
    else mapping[role] = column;
  }
  if (!Object.keys(mapping.next).length) delete mapping.next;
  return mapping;
}

/**
 * Selects beside the text of a mapping, which both change. `coordinates`: names of a known specification, or null
 * where the columns name them; `actions`: how many entries an action has.
 */
export function columnPicks(id, text, { coordinates, actions }) {
  const own = coordinates === null;
  const element = h("div", { class: "columns" });
  const selects = new Map();
  const unlisted = new Map(); // roles by the text that no option has
  const said = () => {
    try {
      const read = JSON.parse(text.value || "{}");
      return read !== null && typeof read === "object" && !Array.isArray(read) ? read : null;
    } catch {
      return null; // half typed
    }
  };

  function options(columns, column) {
    const states = own ? [["state", "state"]] : coordinates.map((name) => [`state:${name}`, `state ${name}`]);
    const entries = Array.from({ length: actions }, (_, at) => [`action:${at}`, actions > 1 ? `action ${at + 1}` : "action"]);
    const following = (own ? columns.filter((one) => one !== column) : coordinates).map((name) => [`next:${name}`, `next state of ${name}`]);
    return [["", "not used"], ...states, ...entries, ...Object.entries(SINGLE), ...following].map(([value, words]) => h("option", { value }, words));
  }

  function changed(select) {
    const roles = new Map();
    for (const [column, one] of selects) {
      if (one !== select && one.value !== "state" && one.value === select.value) one.value = "";
      const role = one.value || (one !== select && unlisted.get(column));
      if (role) roles.set(column, role);
    }
    text.value = roles.size ? JSON.stringify(mappingOf(roles, said() ?? {}, own), null, 1) : "";
    text.dispatchEvent(new Event("input"));
  }

  function follow() {
    const mapping = said();
    if (!mapping) return;
    const roles = rolesOf(mapping, own);
    unlisted.clear();
    for (const [column, select] of selects) {
      select.value = roles.get(column) ?? "";
      if (select.selectedIndex >= 0) continue;
      select.value = "";
      unlisted.set(column, roles.get(column));
    }
  }
  text.addEventListener("input", follow);

  return {
    element,
    follow,
    /** Shows the columns of another log. */
    show(columns) {
      selects.clear();
      const few = columns.length > 0 && columns.length <= MOST_COLUMNS;
      element.replaceChildren(...(few ? columns : []).map((column, at) => {
        const select = h("select", { id: `${id}-column-${at}`, onchange: () => changed(select) }, options(columns, column));
        selects.set(column, select);
        return h("div", { class: "field" }, h("label", { for: select.id }, column), select);
      }));
      follow();
    },
  };
}
