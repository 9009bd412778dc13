// `scape view`: what was named, side by side or laid over each other; models with sliders, motions with their markers.
import { Vector3 } from "three";
import { choice, make } from "./figure.js";
import { millimetres } from "./layer.js";
import { button } from "./pick.js";
import { Program } from "./program.js";

const FIRST = 10;                    // sliders of the shape that are there before one asks for more
const NEAR = 12;                     // pixels from a marker that tell of it
const DEGREE = Math.PI / 180;
const KEYS = [["r", "reset"], ["space", "play, pause"], [", and .", "a frame back, forward"], ["arrows", "move the slider that has the focus"]];

export class View extends Program {
  constructor(connection) {
    super(connection);
    document.body.classList.add("sk-looking");
    this.markers = [];
    this.count = FIRST;
    this.on("state", (fields) => this.update(fields));
    this.on("residuals", (fields, data) => this.addMarkers({ ...fields, values: new Float32Array(data.slice().buffer) }));
    this.build();
    addEventListener("keydown", (event) => this.key(event));
  }

  answer(message) {
    if (message.kind === "scene") { this.number = message.fields.number; this.markers = []; }
    return super.answer(message);
  }

  build() {
    this.list = make("ul", { class: "sk-names sk-entries", "aria-label": "things to show" });
    this.shape = make("fieldset", { class: "sk-sliders" }, make("legend", {}, "shape"));
    this.more = button("more", "sliders for all components of the shape", () => { this.count += FIRST; this.shapeSliders(); });
    this.part = choice("part", [], (i) => this.send("choose", { part: this.parts[i] }));
    this.angles = ["x", "y", "z"].map((axis, i) => this.slider(`turn about ${axis}`, 180, 1, (value) => this.sendTurn(i, value), "°"));
    this.pose = make("fieldset", { class: "sk-sliders" }, make("legend", {}, "pose"), this.part, ...this.angles.map((one) => one.row));
    this.buttons = make("div", { class: "sk-buttons" },
      button("reset", "the mean body at rest (r)", () => this.send("reset")),
      button("save body", "write the mesh, beside what is there", () => this.send("save_body")),
      button("save pose", "write the pose as a motion file of one frame", () => this.send("save_pose")));
    this.notes = make("div", { class: "sk-notes" });
    this.saved = make("p", { class: "sk-file" });
    this.models = make("div", { class: "sk-models", hidden: true }, this.shape, this.pose, this.buttons);
    this.panel.append(this.list, this.notes, this.models, this.saved, this.help(KEYS));
  }

  // A labelled slider from minus to plus a limit, with its number.
  slider(name, limit, step, changed, unit = "") {
    const told = make("output", {}, "0");
    const input = make("input", { type: "range", min: -limit, max: limit, step, value: 0, "aria-label": name,
      oninput: () => { told.textContent = input.value + unit; changed(Number(input.value)); } });
    const set = (value) => {
      if (input === document.activeElement && performance.now() - (input.moved ?? 0) < 400) return;      // still in a hand
      input.value = value;
      told.textContent = `${Number(value.toFixed(unit ? 0 : 2))}${unit}`;
    };
    input.addEventListener("input", () => { input.moved = performance.now(); });
    return { input, set, row: make("label", { class: "sk-slider" }, make("span", {}, name), input, told) };
  }

  shapeSliders() {
    const count = Math.min(this.count, this.betas.length);
    if (this.sliders?.length !== count) {
      this.sliders = Array.from({ length: count }, (_, i) => this.slider(`shape ${i + 1}`, 4, 0.05,
        (value) => this.send("beta", { index: i, value }, `beta ${i}`)));
      this.shape.replaceChildren(make("legend", {}, "shape, standard deviations"), ...this.sliders.map((one) => one.row), this.more);
    }
    this.shape.hidden = !count;
    this.more.hidden = count === this.betas.length;
    this.sliders.forEach((one, i) => one.set(this.betas[i]));
  }

  sendTurn(axis, degrees) {
    const turn = [...this.turns[this.chosen]];
    turn[axis] = degrees * DEGREE;
    this.turns[this.chosen] = turn;
    this.send("turn", { part: this.chosen, turn }, `turn ${this.chosen}`);
  }

  update(state) {
    const { entries, notes, problems, saved, parts } = state;
    this.entries = entries;
    this.list.replaceChildren(...entries.map((entry, i) => this.entry(entry, i)));
    this.notes.replaceChildren(...problems.map((text) => make("p", { class: "sk-bad" }, text)),
      ...notes.map((text) => make("p", {}, text)));
    this.saved.textContent = saved.length ? `saved: ${saved.join(", ")}` : "";
    this.models.hidden = !parts.length;
    if (String(parts) !== String(this.parts)) {
      this.parts = parts;
      this.part.replaceChildren(...parts.map((name) => make("option", {}, name)));
    }
    this.stand(state);
  }

  entry({ name, shown, problem, about }, i) {
    const box = make("input", { type: "checkbox", checked: shown, onchange: () => this.send("show", { entries: this.wanted(i, box.checked) }) });
    const text = make("span", { class: problem ? "sk-bad" : "" }, name, make("small", {}, about));
    if (this.entries.length < 2) return make("li", {}, text);
    const only = button("only", `show ${name} alone`, () => this.send("show", { entries: [i] }));
    return make("li", { title: problem || name }, make("label", {}, box, text), only);
  }

  wanted(i, on) { return this.entries.flatMap((entry, k) => (k === i ? on : entry.shown) ? [k] : []); }

  // Where the sliders are.
  stand({ betas, turns, chosen }) {
    Object.assign(this, { betas, turns, chosen });
    if (!this.parts?.length) return;
    this.shapeSliders();
    this.part.selectedIndex = this.parts.indexOf(chosen);
    this.angles.forEach((one, i) => one.set((turns[chosen]?.[i] ?? 0) / DEGREE));
  }

  move(message) {
    const { fields } = message;
    if (fields.scene !== this.number) return;
    super.move(message);
    const pane = this.figure?.panes[fields.pane];
    if (pane) pane.joint = fields.joint?.[0] ?? null;
    this.stand(fields);
  }

  // Markers are coloured by how far they are from where the body puts them, frame by frame.
  addMarkers(told) {
    if (told.scene !== this.number) return;
    const dots = this.figure?.panes[told.pane]?.layers[told.layer];
    if (!dots?.motion) return;
    this.markers.push({ ...told, dots });
    dots.setValues(this.residuals(this.markers.at(-1)), 0, told.high, "distance of markers", told.palette);
    this.figure.legend();
  }

  residuals({ dots, labels, values }) {
    const frame = Math.min(this.figure.frameOf(dots), values.length / labels.length - 1);
    return values.subarray(frame * labels.length, (frame + 1) * labels.length);
  }

  wentOn(figure) {
    for (const told of this.markers) {
      const { dots, high } = told, { index } = dots.shades.at(-1), now = this.residuals(told);
      now.forEach((value, i) => { dots.columns[index][i] = Number.isNaN(value) ? 255 : Math.round(254 * Math.min(1, value / high)); });
      dots.setShade(dots.shades.length - 1);
    }
    for (const pane of figure.panes) {
      const body = pane.layers.find((layer) => layer.motion), at = body && middle(body);
      if (at && pane.followed && this.following.checked) {
        const step = at.clone().sub(pane.followed);
        pane.camera.position.add(step);
        pane.controls.target.add(step);
        pane.camera.updateMatrixWorld();
      }
      pane.followed = at ?? null;
    }
  }

  // The view goes along with bodies that walk.
  timeline(figure) {
    if (!figure.time) return;
    const go = figure.go.bind(figure);
    figure.go = (frame) => { go(frame); this.wentOn(figure); };
    this.following = make("input", { type: "checkbox", checked: true });
    figure.below.querySelector(".sk-time").append(make("label", { title: "the view goes along with the body" }, this.following, "follow"));
    this.wentOn(figure);
  }

  shown(figure) {
    this.timeline(figure);
    figure.panes.forEach((pane, i) => {
      pane.overlays.push((context) => this.drawJoint(context, pane));
      pane.canvas.addEventListener("pointermove", (event) => { if (!event.buttons) this.tellMarker(pane, i, event); });
    });
  }

  // The joint of the chosen part.
  drawJoint(context, pane) {
    const at = pane.joint && pane.project(new Vector3().fromArray(pane.joint));
    if (!at) return;
    const scale = pane.canvas.width / Math.max(pane.canvas.clientWidth, 1);
    context.beginPath();
    context.arc(at.x * scale, at.y * scale, 6 * scale, 0, 7);
    context.lineWidth = 2.5 * scale;
    context.strokeStyle = "#f0a400";
    context.stroke();
  }

  // How far the marker under the pointer is from where the body puts it, in this frame.
  tellMarker(pane, number, event) {
    const box = pane.canvas.getBoundingClientRect();
    let best = null, least = NEAR;
    for (const told of this.markers.filter((one) => one.pane === number && one.dots.object.visible)) {
      const { dots, labels } = told, now = this.residuals(told);
      labels.forEach((label, i) => {
        const at = dots.hidden.has(i) ? null : pane.project(new Vector3().fromArray(dots.positions, 3 * i));
        const away = at ? Math.hypot(at.x - (event.clientX - box.left), at.y - (event.clientY - box.top)) : Infinity;
        if (away < least) { least = away; best = { label, value: now[i] }; }
      });
    }
    if (!best) { if (pane.told) pane.tip.hidden = true; pane.told = false; return; }
    pane.told = true;
    pane.tip.hidden = false;
    pane.tip.textContent = `${best.label}: ${Number.isFinite(best.value) ? millimetres(best.value) : "no data"}`;
    pane.tip.style.transform = `translate(${event.clientX - box.left + 14}px, ${event.clientY - box.top + 10}px)`;
  }

  key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey || event.target.matches("select, textarea, button, summary")) return;
    const { time } = this.figure ?? {};
    const actions = { r: () => this.send("reset") };
    const moving = { " ": () => this.figure.play(!this.figure.playing), ",": () => this.figure.go(Math.round(this.figure.frame) - 1),
      ".": () => this.figure.go(Math.round(this.figure.frame) + 1) };
    const action = this.parts?.length && actions[event.key] || time && !event.target.matches("[type=checkbox]") && moving[event.key];
    if (action) { event.preventDefault(); action(); }
  }
}

function middle({ positions, count, hidden }) {
  const sum = new Vector3(), one = new Vector3();
  let known = 0;
  for (let i = 0; i < count; i += 5) {
    if (hidden.has(i)) continue;
    sum.add(one.fromArray(positions, 3 * i));
    known++;
  }
  return known ? sum.divideScalar(known) : null;
}
