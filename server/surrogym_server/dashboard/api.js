// The HTTP API as the page uses it. The token stays in this tab's sessionStorage and goes into the header alone.

const KEY = "surrogym-token";
const PATIENCE_MS = 20_000;

export const token = {
  get: () => sessionStorage.getItem(KEY),
  set: (value) => (value ? sessionStorage.setItem(KEY, value) : sessionStorage.removeItem(KEY)),
};

/** The server answered, and said no. */
export class Problem extends Error {
  constructor(status, body) {
    super(body.detail ?? body.title ?? `status ${status}`);
    this.status = status;
    this.code = body.code;
    this.errors = body.errors ?? null; // of fields: {field, expected, got} each
  }
}

/** Nothing answered, or nothing that this page understands. */
export class Gone extends Error {}

function headers(body) {
  const sent = token.get() ? { authorization: `Bearer ${token.get()}` } : {};
  return body === undefined ? sent : { ...sent, "content-type": "application/json" };
}

async function send(path, options) {
  let reply;
  try {
    reply = await fetch(path, options);
  } catch (error) {
    if (error.name === "AbortError") throw error;
    throw new Gone("The server does not answer.");
  }
  if (!reply.ok) throw new Problem(reply.status, await reply.json().catch(() => ({})));
  return reply;
}

/** One request; its reply as an object, null where it has no body. Raises `Problem` or `Gone`. */
export async function call(method, path, body, signal, patience = PATIENCE_MS) {
  const limit = AbortSignal.timeout(patience);
  const signals = signal ? AbortSignal.any([signal, limit]) : limit;
  try {
    const reply = await send(path, { method, headers: headers(body), body: body && JSON.stringify(body), signal: signals });
    return reply.status === 204 ? null : await reply.json();
  } catch (error) {
    if (signal?.aborted || error instanceof Problem || error instanceof Gone) throw error;
    throw new Gone("The server takes too long to answer.");
  }
}

/** The bytes that a route gives: an address in the page would carry no token. */
export async function bytes(path) {
  const reply = await send(path, { headers: headers() });
  return reply.blob();
}

/** Saves what a route gives as a file. */
export async function download(path, name) {
  save(await bytes(path), name);
}

/** Saves bytes that the page has as a file. */
export function save(blob, name) {
  const address = URL.createObjectURL(blob);
  const link = document.createElement("a");
  link.href = address;
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(address), 10_000);
}

/** Server-sent events, one after the other as {event, data}; also {event: "open"} first. Ends when the server ends. */
export async function* events(path, signal) {
  const reply = await send(path, { headers: headers(), signal });
  yield { event: "open" };
  const reader = reply.body.pipeThrough(new TextDecoderStream()).getReader();
  let text = "";
  for (;;) {
    const { value, done } = await reader.read();
    if (done) return;
    text += value;
    const blocks = text.split("\n\n");
    text = blocks.pop();
    for (const block of blocks) {
      const fields = Object.fromEntries(block.split("\n").map((line) => [line.split(":", 1)[0], line.slice(line.indexOf(":") + 1).trim()]));
      yield fields.event ? { event: fields.event, data: JSON.parse(fields.data ?? "{}") } : { event: "silence" };
    }
  }
}

export const surrogate = (name) => `/v1/surrogates/${encodeURIComponent(name)}`;
