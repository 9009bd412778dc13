// The page's side of its connection to Python: what is sent arrives once, in order, also when the connection was lost.
//
// The page asks for one message after the other, and its own go one after the other too. A frame is, as in messages.py:
// uint32 little-endian length of the header; the header, JSON in UTF-8 with kind, latest, number, fields, blanks up to a
// multiple of 8; then the data.

const FIRST_WAIT = 300;              // milliseconds before the connection is tried again
const LAST_WAIT = 5000;
const FINAL = { 403: "refused", 409: "elsewhere" };      // by the status of an answer

/** One message as a frame; numbers that are not finite become null. */
export function pack({ kind, latest = "", number = 0, fields = {} }) {
  const text = new TextEncoder().encode(JSON.stringify({ kind, latest, number, fields }));
  const length = Math.ceil((text.length + 4) / 8) * 8 - 4;
  const frame = new Uint8Array(4 + length);
  new DataView(frame.buffer).setUint32(0, length, true);
  frame.fill(32, 4 + text.length);
  frame.set(text, 4);
  return frame;
}

/** {kind, latest, number, fields, data} of a frame; data is a Uint8Array at a multiple of 8 bytes in its buffer. */
export function unpack(buffer) {
  if (buffer.byteLength < 4) throw new Error(`message: expected at least 4 bytes, got ${buffer.byteLength}`);
  const end = 4 + new DataView(buffer).getUint32(0, true);
  if (end > buffer.byteLength) throw new Error(`message: expected ${end} bytes, got ${buffer.byteLength}`);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, end - 4)));
  return { ...header, data: new Uint8Array(buffer, end) };
}

/**
 * Connect to the server of this page, and again whenever the connection was lost.
 *
 * onMessage({kind, fields, data, latest}) is called for every message of Python; after a lost connection the present
 * state comes again. onState("open" | "lost" | "refused" | "elsewhere"): after the last two the page must be loaded
 * again; elsewhere, because another page took its place.
 *
 * Of what waits to be sent, send(kind, fields, latest) replaces the last message if it has the same key.
 */
export function connect(onMessage, onState = () => {}) {
  const page = Array.from(crypto.getRandomValues(new Uint8Array(16)), (b) => b.toString(16).padStart(2, "0")).join("");
  const waiting = [];                // not sent yet
  let underway = null;               // frame that was sent, and not answered yet
  let number = 0, turn = 0, state = "", sending = false;

  const ended = () => Object.values(FINAL).includes(state);
  const pause = (milliseconds) => new Promise((done) => { setTimeout(done, milliseconds); });

  function tell(now) {
    if (now !== state && !ended()) onState(state = now);
  }

  async function ask(path, options = {}, body = undefined) {
    const { server } = document.documentElement.dataset;
    const query = new URLSearchParams({ page, turn, ...options, ...(server && { server }) });
    const answer = await fetch(`/${path}?${query}`, { method: "POST", body });
    if (answer.status in FINAL) tell(FINAL[answer.status]);
    return answer.arrayBuffer();
  }

  // Ask for one message after the other; a new connection asks for the present state first.
  async function listen() {
    for (let wait = FIRST_WAIT; ;) {
      const greet = state === "open" ? {} : { greet: 1, turn: ++turn };
      const buffer = await ask("messages", greet).catch(() => null);
      if (ended()) return;
      if (buffer) {
        tell("open");
        wait = FIRST_WAIT;
        if (buffer.byteLength) onMessage(unpack(buffer));
        flush();
      } else {
        tell("lost");
        await pause(wait);
        wait = Math.min(1.7 * wait, LAST_WAIT);
      }
    }
  }

  async function flush() {
    if (sending) return;
    sending = true;
    while (state === "open" && (underway || waiting.length)) {
      underway ??= pack({ ...waiting.shift(), number: ++number });
      const arrived = await ask("message", {}, underway).catch(() => null);
      if (arrived) underway = null;
      else await pause(FIRST_WAIT);
    }
    sending = false;
  }

  listen();
  return {
    send(kind, fields = {}, latest = "") {
      if (latest && waiting.at(-1)?.latest === latest) waiting.pop();
      waiting.push({ kind, fields: structuredClone(fields), latest });
      flush();
    },
  };
}
