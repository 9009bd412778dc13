// What programs share: a panel beside the figure, the connection to Python, notes and progress.
import { Figure, make } from "./figure.js";
import { unpackScene } from "./unpack.js";
import { hasWebGL } from "./pane.js";

const MOUSE = [["drag, arrow keys", "turn the body"], ["wheel", "zoom"], ["right button", "shift the body"]];

export class Program {
  constructor(connection) {
    this.connection = connection;
    document.body.className = "sk-program";
    this.panel = make("aside", { class: "sk-panel" });
    this.stage = make("div", { class: "sk-stage" });
    this.status = make("p", { class: "sk-status", role: "status" });
    this.progress = make("progress", { hidden: true });
    document.body.append(make("main", { class: "sk-main" }, this.panel,
      make("section", { class: "sk-view" }, this.stage, make("footer", {}, this.progress, this.status))));
    this.answers = {};
    for (const kind of ["dragover", "drop"]) addEventListener(kind, (event) => event.preventDefault());      // else the browser leaves the page
    this.theme();
    if (!hasWebGL()) this.say("This browser has no WebGL, so that bodies cannot be shown. Another browser, or its settings, may help.", "bad");
  }

  theme() {
    const button = make("button", { type: "button", class: "sk-theme", title: "dark or light", "aria-label": "dark or light",
      onclick: () => {
        const dark = matchMedia("(prefers-color-scheme: dark)").matches;
        const now = document.documentElement.dataset.theme ?? (dark ? "dark" : "light");
        document.documentElement.dataset.theme = now === "dark" ? "light" : "dark";
        this.figure?.panes.forEach((pane) => pane.redraw());
      } }, "◐");
    this.panel.append(make("header", {}, make("h1", {}, document.title), button));
  }

  help(keys) {
    return make("details", {}, make("summary", {}, "mouse and keys"),
      make("dl", {}, ...[...keys, ...MOUSE].flatMap(([key, what]) => [make("dt", {}, key), make("dd", {}, what)])));
  }

  on(kind, answer) { this.answers[kind] = answer; }

  send(kind, fields = {}, latest = "") {
    if (this.status.dataset.kind === "bad" && !this.lost) this.say("");         // what was wrong is over
    this.connection.send(kind, fields, latest);
  }

  // Messages one after the other: a scene takes a moment to unpack, and what comes after belongs to it.
  received(message) {
    this.turn = (this.turn ?? Promise.resolve()).then(() => this.answer(message)).catch((error) => { setTimeout(() => { throw error; }); });
    return this.turn;
  }

  async answer(message) {
    if (message.kind === "scene") await this.show(message.data, message.fields);
    else if (message.kind === "positions") this.move(message);
    else if (message.kind === "error") this.say(message.fields.text, "bad");
    this.answers[message.kind]?.(message.fields, message.data);
  }

  connected(state) {
    document.body.dataset.connection = state;
    if (state === "lost") this.say("The connection is lost; what you do is kept and sent when it is back.", "bad");
    if (state === "refused") this.say("This page was refused: start the program again and use the address that it prints.", "bad");
    if (state === "elsewhere") this.say("Another page of this program was opened. Load this one again to go on here.", "bad");
    if (state === "open" && this.lost) this.say("");
    this.lost = state !== "open";
  }

  // What a scene message holds; programs may put more behind the panes.
  unpack(data) { return unpackScene(data); }

  async show(data, fields) {
    const scene = await this.unpack(data, fields);
    const before = this.figure?.panes.map((pane) => pane.view()), choices = this.figure?.choices();
    this.figure = new Figure(this.stage, scene, this.linked ?? true, this.alike);
    const anew = fields.opened !== this.opened;         // another scan: it opens whole, the template stays as it is
    this.opened = fields.opened;
    if (before && (this.alike || before.length === scene.panes.length)) {
      this.figure.panes.slice(0, anew ? 1 : before.length).forEach((pane, i) => pane.restore(before[i]));
      this.figure.choose(choices);
    }
    const [first, ...others] = this.figure.panes.slice(this.alike ?? Infinity);
    for (const pane of others) {
      pane.follow(first);
      if (anew || before?.length !== scene.panes.length) pane.fit();            // else the view was chosen by hand
    }
    this.shown?.(this.figure);
  }

  // New places of a layer's vertices, as float32 relative to the pane's origin.
  move({ fields, data }) {
    const layer = this.figure?.panes[fields.pane]?.layers[fields.layer];
    if (!layer) return;
    const values = new Float32Array(data.slice().buffer);
    if (values.length !== layer.positions.length) return;
    layer.setPositions(values);
    this.figure.panes[fields.pane].redraw();
  }

  say(text, kind = "") {
    this.status.textContent = text ?? "";
    this.status.dataset.kind = kind;
  }

  work(working) {
    this.progress.hidden = !working;
    if (!working) return;
    const [what, done, total] = working;
    this.progress.max = total;
    this.progress.value = done;
    this.say(total > 1 ? `${what}: step ${done} of ${total}` : what);
  }
}
