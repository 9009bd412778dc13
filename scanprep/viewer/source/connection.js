// The page's side of its connection to Python: what is sent arrives once, in order, also when the connection was lost.
//
// A frame is, as in messages.py: uint32 little-endian length of the header; the header, JSON in UTF-8 with kind, latest,
// number, fields, blanks up to a multiple of 8; then the data.

const LARGEST_MESSAGE = 2 ** 24;     // bytes; the server closes the connection on more
const LARGEST_FILE = 2 ** 30;
const UNDERWAY = 2 ** 20;            // bytes in the socket beyond which messages wait, so that newer ones replace them
const FIRST_WAIT = 300;              // milliseconds before the connection is tried again
const LAST_WAIT = 5000;
const NOTHING = new Uint8Array(0);

/** One message as a frame; numbers that are not finite become null. */
export function pack({kind, latest = "", number = 0, fields = {}, data = NOTHING}) {
  const text = new TextEncoder().encode(JSON.stringify({kind, latest, number, fields}));
  const length = Math.ceil((text.length + 4) / 8) * 8 - 4;
  const frame = new Uint8Array(4 + length + data.byteLength);
  new DataView(frame.buffer).setUint32(0, length, true);
  frame.fill(32, 4 + text.length, 4 + length);
  frame.set(text, 4);
  frame.set(data instanceof ArrayBuffer ? new Uint8Array(data)
    : new Uint8Array(data.buffer, data.byteOffset, data.byteLength), 4 + length);
  return frame;
}

/** {kind, latest, number, fields, data} of a frame; data is a Uint8Array at a multiple of 8 bytes in its buffer. */
export function unpack(buffer) {
  if (buffer.byteLength < 4) throw new Error(`message: expected at least 4 bytes, got ${buffer.byteLength}`);
  const end = 4 + new DataView(buffer).getUint32(0, true);
  if (end > buffer.byteLength) throw new Error(`message: expected ${end} bytes, got ${buffer.byteLength}`);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, end - 4)));
  return {...header, data: new Uint8Array(buffer, end)};
}

/** What waits to be sent, in order; as in waiting.py, nothing overtakes a message without a key. */
function put(waiting, message) {
  for (let place = waiting.length - 1; message.latest && place >= 0 && waiting[place].latest; place--) {
    if (waiting[place].latest === message.latest) {
      waiting[place] = message;
      return;
    }
  }
  waiting.push(message);
}

function randomName() {
  return Array.from(crypto.getRandomValues(new Uint8Array(16)), (b) => b.toString(16).padStart(2, "0")).join("");
}

/**
 * Connect to the server of this page, and again whenever the connection was lost.
 *
 * onMessage({kind, fields, data, latest}) is called for every message of Python; after a lost connection the present
 * state comes again. onState("open" | "lost" | "refused"): refused is final, the page must be opened anew.
 *
 * send(kind, fields, data, latest) throws for messages that are too large; upload(file) is a promise that fails with
 * what to tell the user.
 */
export function connect(onMessage, onState = () => {}) {
  const server = document.documentElement.dataset.server ?? "";
  const query = new URLSearchParams({tab: randomName(), ...(server && {server})});
  const waiting = [];                // not sent yet
  const underway = [];               // sent, not acknowledged yet: {number, frame}
  let number = 0, wait = FIRST_WAIT, socket = null, ready = false, closed = false, timer = null, state = "";

  function tell(now) {
    if (now !== state && !closed) onState(state = now);
  }

  function flush() {
    while (ready && waiting.length && socket.bufferedAmount < UNDERWAY) {
      const message = waiting.shift();
      const sent = {number: ++number, frame: pack({...message, number})};
      underway.push(sent);
      socket.send(sent.frame);
    }
  }

  function acknowledged(last) {
    while (underway.length && underway[0].number <= last) underway.shift();
    if (!ready) {                    // a new connection: what the server did not see goes first
      ready = true;
      wait = FIRST_WAIT;
      for (const sent of underway) socket.send(sent.frame);
      tell("open");
    }
    flush();
  }

  function open() {
    const current = socket = new WebSocket(`ws://${location.host}/socket?${query}`);
    current.binaryType = "arraybuffer";
    current.onmessage = (event) => {
      if (current !== socket) return;
      const message = unpack(event.data);
      if (message.kind === "acknowledged") acknowledged(message.fields.number);
      else onMessage(message);
    };
    current.onclose = () => {
      if (current === socket) lost();
    };
  }

  function lost() {
    socket = null;
    ready = false;
    if (closed) return;
    tell("lost");
    timer = setTimeout(again, wait);
    wait = Math.min(1.7 * wait, LAST_WAIT);
  }

  async function again() {
    try {
      const answer = await fetch(`/alive${server && `?server=${encodeURIComponent(server)}`}`, {cache: "no-store"});
      if (closed) return;
      if (answer.status === 403) tell("refused");
      else open();
    } catch {
      lost();
    }
  }

  open();
  return {
    send(kind, fields = {}, data = NOTHING, latest = "") {
      if (closed || state === "refused") throw new Error("the connection was closed");
      const size = pack({kind, latest, number: Number.MAX_SAFE_INTEGER, fields, data}).length;
      if (size > LARGEST_MESSAGE) throw new Error(`a message of ${size} bytes, more than ${LARGEST_MESSAGE}`);
      put(waiting, {kind, fields: structuredClone(fields), data: data.slice(0), latest});
      flush();
    },
    async upload(file) {
      if (file.size > LARGEST_FILE) throw new Error(`${file.name}: more than ${LARGEST_FILE / 2 ** 30} GB`);
      const answer = await fetch(`/drop?name=${encodeURIComponent(file.name)}`, {method: "POST", body: file})
        .catch(() => { throw new Error(`${file.name}: the connection was lost; drop it again`); });
      if (!answer.ok) throw new Error(`${file.name}: ${(await answer.text()).trim()}`);
    },
    close() {
      closed = true;
      clearTimeout(timer);
      socket?.close();
    },
  };
}
