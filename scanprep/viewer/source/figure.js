// A figure: panes side by side, with their buttons, legend and timeline. Reports are made of these, and programs too.
import { Layer, SURFACES, told } from "./layer.js";
import { Pane } from "./pane.js";

const SIDES = { "first view": [0, null], front: [0, 0], left: [90, 0], back: [180, 0], right: [-90, 0], above: [0, 85] };

const FEW_NAMES = [80, 15];                             // that are shown at first, where nothing moves, and in motions

export function make(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else if (value === true) element.setAttribute(name, "");
    else if (value !== false && value !== undefined && value !== null) element.setAttribute(name, value);
  }
  element.append(...children);
  return element;
}

export function choice(label, names, onChoose, chosen = 0) {
  const select = make("select", { "aria-label": label, title: label, onchange: () => onChoose(select.selectedIndex) },
    ...names.map((name, i) => make("option", { selected: i === chosen }, name)));
  return select;
}

export class Figure {
  constructor(element, scene, linked = true, alike = Infinity) {
    this.element = element;
    this.scene = scene;
    this.linked = linked;
    this.alike = alike;                                 // number of the pane from which on they always turn together
    this.frame = 0;
    this.row = make("div", { class: "sk-panes" });
    this.panes = scene.panes.map((described) => this.addPane(described));
    this.tools = make("div", { class: "sk-tools", role: "toolbar", "aria-label": "view" });
    this.below = make("div", { class: "sk-below" });
    element.replaceChildren(this.row, this.tools, this.below);
    element.classList.add("sk-figure");
    this.fill();
  }

  addPane(described) {
    const box = make("div", { class: "sk-pane" });
    this.row.append(box);
    const pane = new Pane(box, described);
    for (const layer of described.layers) pane.add(new Layer(layer, described.columns ?? this.scene.columns));
    if (described.label) box.append(make("div", { class: "sk-label" }, described.label));
    box.append(pane.tip = make("div", { class: "sk-tip", hidden: true }));
    const moves = pane.layers.some((layer) => layer.motion);
    pane.names = pane.layers.reduce((sum, layer) => sum + layer.labels.length, 0) <= FEW_NAMES[moves ? 1 : 0];
    pane.onTurn = () => this.turned(pane);
    pane.onHand = () => { this.side.selectedIndex = 0; };
    pane.canvas.addEventListener("pointermove", (event) => this.tell(pane, event));
    pane.canvas.addEventListener("pointerleave", () => { pane.tip.hidden = true; });
    return pane;
  }

  get layers() { return this.panes.flatMap((pane) => pane.layers); }

  // Buttons, legend and timeline for what is in the panes now.
  fill() {
    const { tools } = this;
    this.side = choice("side", Object.keys(SIDES), () => this.look(...SIDES[this.side.value]));
    this.side.prepend(make("option", { hidden: true }, "turned"));
    tools.replaceChildren(this.side,
      choice("surface", SURFACES, (i) => this.each((layer) => layer.setSurface(SURFACES[i]))));
    const many = this.layers.filter((layer) => layer.shades.length > 1);
    if (many.length) {
      const shades = [...new Set(many.flatMap((layer) => layer.shades.map((shade) => shade.name)))];
      tools.append(choice("colour", shades.map((name) => name || "as given"), (i) => this.color(shades[i]),
        shades.indexOf(many[0].shade.name)));
    }
    const named = [...new Set(this.layers.map((layer) => layer.name).filter(Boolean))];
    for (const name of named) {
      const shown = this.layers.some((layer) => layer.name === name && layer.object.visible);
      const box = make("input", { type: "checkbox", checked: shown, onchange: () => this.show(name, box.checked) });
      tools.append(make("label", {}, box, name));
    }
    if (this.layers.some((layer) => layer.labels.length)) {
      const box = make("input", { type: "checkbox", checked: this.labelled(), onchange: () => this.label(box.checked) });
      tools.append(make("label", {}, box, "names"));
    }
    if (this.panes.length > 1) {
      const box = make("input", { type: "checkbox", checked: this.linked, onchange: () => { this.linked = box.checked; } });
      tools.append(make("label", { title: "all panes turn together" }, box, "turn together"));
    }
    tools.append(make("button", { type: "button", title: "save what is seen as a picture", onclick: () => this.save() }, "picture"));
    this.legend();
    this.timeline();
  }

  each(change) {
    for (const pane of this.panes) {
      for (const layer of pane.layers) change(layer);
      pane.redraw();
    }
  }

  look(azimuth, elevation) {
    for (const pane of this.panes) pane.reset(azimuth, elevation);
  }

  // What is seen and in which colours, to be chosen again in a figure of the same things.
  choices() { return { visible: new Map(this.layers.map((layer) => [layer.name, layer.object.visible])), color: this.colored, side: this.side.value }; }

  choose({ visible, color, side }) {
    this.each((layer) => { if (layer.name) layer.object.visible = visible.get(layer.name) ?? layer.object.visible; });
    if (color !== undefined) this.color(color);
    this.fill();
    this.side.value = side;
  }

  color(name) {
    this.colored = name;
    this.each((layer) => {
      const index = layer.shades.findIndex((shade) => shade.name === name);
      if (index >= 0) layer.setShade(index);
    });
    this.legend();
  }

  show(name, visible) {
    this.each((layer) => { if (layer.name === name) layer.object.visible = visible; });
  }

  // Names of points are shown; many of them would hide the body, and are so at first.
  labelled() { return this.panes.some((pane) => pane.names); }

  label(on) {
    for (const pane of this.panes) {
      pane.names = on;
      pane.redraw();
    }
  }

  turned(pane) {
    const together = this.linked ? this.panes : this.panes.slice(this.alike);
    if (together.includes(pane)) for (const other of together) if (other !== pane) other.follow(pane);
  }

  tell(pane, event) {
    if (event.buttons || !pane.layers.some((layer) => layer.shade?.legend)) { pane.tip.hidden = true; return; }
    const hit = pane.hit(event);
    const text = hit?.layer.valueAt(hit.vertex) ?? "";
    pane.tip.hidden = !text;
    if (!text) return;
    pane.tip.textContent = text;
    const box = pane.element.getBoundingClientRect();
    pane.tip.style.transform = `translate(${event.clientX - box.left + 14}px, ${event.clientY - box.top + 10}px)`;
  }

  legend() {
    this.below.querySelectorAll(".sk-legend").forEach((old) => old.remove());
    const known = new Set();
    for (const { shade } of this.layers) {
      if (!shade?.legend || known.has(JSON.stringify(shade.legend))) continue;
      known.add(JSON.stringify(shade.legend));
      const { title, low, high } = shade.legend;
      const stops = Array.from({ length: 12 }, (_, i) => `#${shade.palette.slice(6 * Math.round(i * 254 / 11)).slice(0, 6)}`);
      this.below.prepend(make("div", { class: "sk-legend" }, make("span", {}, title),
        make("span", { class: "sk-low" }, told(low, shade.legend)),
        make("span", { class: "sk-ramp", style: `background: linear-gradient(to right, ${stops.join(", ")})` }),
        make("span", {}, `${told(high, shade.legend)}${shade.legend.more ? " or more" : ""}`)));
    }
  }

  timeline() {
    this.below.querySelectorAll(".sk-time").forEach((old) => old.remove());
    const moving = this.layers.filter((layer) => layer.motion);
    if (!moving.length) return;
    const { rate } = moving[0].motion;
    const frames = Math.max(...moving.map(({ motion }) => Math.round((motion.frames - 1) / motion.rate * rate))) + 1;
    const slider = make("input", { type: "range", min: 0, max: frames - 1, value: 0, step: 1, "aria-label": "time",
      oninput: () => { this.go(Number(slider.value)); } });
    const clock = make("output", {});
    const play = make("button", { type: "button", "aria-label": "play", onclick: () => this.play(!this.playing) }, "▶");
    const speeds = [0.1, 0.25, 0.5, 1, 2];
    this.speed = 1;
    this.time = { slider, clock, play, frames, rate, moving };
    this.below.append(make("div", { class: "sk-time" }, play, slider, clock,
      choice("speed", speeds.map((s) => `${s}×`), (i) => { this.speed = speeds[i]; }, 3)));
    this.go(0);
  }

  go(frame) {
    const { slider, clock, frames, rate, moving } = this.time;
    this.frame = Math.max(0, Math.min(frames - 1, frame));
    for (const layer of moving) layer.setFrame(this.frameOf(layer));
    slider.value = this.frame;
    clock.textContent = `${(this.frame / rate).toFixed(2)} s`;
    for (const pane of this.panes) pane.redraw();
  }

  // Where a layer is in its own motion, which may have another rate.
  frameOf({ motion }) {
    return Math.min(Math.round(this.frame / this.time.rate * motion.rate), motion.frames - 1);
  }

  play(on) {
    this.playing = on;
    this.time.play.textContent = on ? "❚❚" : "▶";
    this.time.play.setAttribute("aria-label", on ? "pause" : "play");
    let last = null;
    const step = (now) => {
      if (!this.playing) return;
      const { frames, rate } = this.time;
      if (last !== null) {
        const next = this.frame + (now - last) / 1000 * rate * this.speed;
        this.go(next > frames - 1 ? 0 : next);
      }
      last = now;
      requestAnimationFrame(step);
    };
    if (on) requestAnimationFrame(step);
  }

  // All panes side by side as one PNG file.
  save() {
    const sheet = document.createElement("canvas");
    const canvases = this.panes.map((pane) => { pane.draw(); return pane.canvas; });
    sheet.width = canvases.reduce((sum, canvas) => sum + canvas.width, 0);
    sheet.height = Math.max(...canvases.map((canvas) => canvas.height));
    let x = 0;
    for (const canvas of canvases) {
      sheet.getContext("2d").drawImage(canvas, x, 0);
      x += canvas.width;
    }
    sheet.toBlob((blob) => {
      const link = make("a", { href: URL.createObjectURL(blob), download: `${document.title || "scapekit"}.png` });
      link.click();
      setTimeout(() => URL.revokeObjectURL(link.href), 1000);
    });
  }
}
