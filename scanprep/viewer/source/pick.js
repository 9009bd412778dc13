// `scape pick`: a template, a scan, a list of names; a click is sent as a ray, and Python finds what it meets.
import { Vector3 } from "three";
import { make } from "./figure.js";
import { Program } from "./program.js";

const NEAR = 12;                     // pixels from a landmark that still take hold of it
const STILL = 4;                     // pixels that a hand moves while it clicks
const BESIDE = [3, 6, 9];            // pixels beside a surface that a click still means it: finger tips are at ragged borders
export const OFF = 0.03;             // metres from where a landmark is predicted, from which on it is to be looked at
const COLORS = { set: "#d5392f", chosen: "#f0a400", predicted: "#3b82c4" };
export const WORDS = { good: "good", check: "look at it", failed: "failed", new: "new" };       // verdicts
const KEYS = [["n, p", "next, previous name"], ["z, y", "undo, redo"], ["Delete", "take the landmark away"],
  ["c", "confirm the predicted ones"], ["[ and ]", "previous, next scan"], ["+ and -", "move it along the view, into the body"],
  ["i", "click inside the body: joints"], ["x", "exchange the pair: left for right"], ["arrows", "in the list: next, previous name"]];
// What a list says of a landmark, by shape too: a disc, a diamond, a ring.
const MARKS = { set: "sk-on", predicted: "sk-guess", "not set": "sk-off" };

export class Pick extends Program {
  constructor(connection) {
    super(connection);
    this.linked = false;                                // template and scan stand differently,
    this.alike = 1;                                     // what is made of the scan stands as the scan
    this.drags = Date.now() % 1e9;                      // other numbers than those of the page before
    this.inside = false;
    this.state = null;
    this.on("state", (fields) => this.update(fields));
    this.build();
    addEventListener("keydown", (event) => this.key(event));
  }

  build() {
    this.scans = make("select", { "aria-label": "scan", onchange: () => this.send("open", { scan: this.scans.selectedIndex }) });
    this.list = make("ol", { class: "sk-names", role: "listbox", "aria-label": "landmarks", onkeydown: (event) => this.walk(event) });
    this.added = make("input", { placeholder: "another name", "aria-label": "another name", onkeydown: (event) => {
      if (event.key === "Enter" && this.added.value.trim()) { this.send("choose", { name: this.added.value }); this.added.value = ""; }
    } });
    this.buttons = {
      undo: button("undo", "take the last change back (z)", () => this.send("undo")),
      redo: button("redo", "make it again (y)", () => this.send("redo")),
      swap: button("swap left and right", "exchange the two sides of the scan's landmarks", () => this.send("swap")),
      pair: button("exchange the pair", "each is where the other was: for a pair whose sides are mixed up (x)", () => this.send("swap", { name: this.state.chosen })),
      predict: button("predict the others", "register the template to the scan and see where the other landmarks should be", () => this.send("predict")),
      confirm: button("confirm all", "take all predicted landmarks as they are (c)", () => this.confirm()),
      next: button("skip", "go to the next name, as when the scan does not show this one (n)", () => this.step(1)),
      there: button("move it there", "to where the ring is: where it is predicted", () => this.send("confirm", { names: [this.state.chosen] })),
    };
    this.insideBox = make("input", { type: "checkbox", onchange: () => { this.inside = this.insideBox.checked; } });
    this.insideLabel = make("label", {}, this.insideBox, "inside the body (joints)");
    this.depth = make("input", { type: "range", min: 0, max: 100, step: 1, "aria-label": "depth", onchange: () => this.slideTo(this.depth.value / 100) });
    this.depthLabel = make("label", { class: "sk-depth", hidden: true }, make("span"), this.depth);
    this.measure = make("p", { class: "sk-measure" });
    this.question = make("div", { class: "sk-question", role: "alert", hidden: true });
    this.status.after(this.question);
    this.file = make("p", { class: "sk-file" });
    this.panel.append(this.scans, this.list, this.added, make("div", { class: "sk-buttons" }, ...Object.values(this.buttons)),
      this.insideLabel, this.depthLabel, this.measure, this.file,
      this.help(KEYS));
  }

  confirm() { this.send("confirm", { names: Object.keys(this.waiting()) }); }

  beyond(by) {
    const { names, chosen } = this.state;
    return names[(names.indexOf(chosen) + by + names.length) % names.length];
  }

  step(by) { this.send("choose", { name: this.beyond(by) }); }

  // The list is one stop of the Tab key: arrows choose in it, and the focus goes along with what is chosen.
  walk(event) {
    const { names } = this.state, focused = names[[...this.list.children].indexOf(event.target)];
    const name = { ArrowDown: this.beyond(1), ArrowUp: this.beyond(-1), Home: names[0], End: names.at(-1), Enter: focused, " ": focused }[event.key];
    if (!name) return;
    event.preventDefault();
    event.stopPropagation();
    this.choose(name, event);
  }

  // How far a landmark of the scan is from where it is predicted, in metres; null where one of the two is missing.
  off(name) {
    const { places = {}, predicted = {} } = this.state.panes[1] ?? {};
    return name in places && name in predicted ? distance(places[name], predicted[name]) : null;
  }

  // Predicted landmarks that nobody has clicked yet.
  waiting() {
    const { predicted = {}, places = {} } = this.state?.panes.at(-1) ?? {};
    return Object.fromEntries(Object.entries(predicted).filter(([name]) => !(name in places)));
  }

  update(state) {
    this.state = state;
    this.scans.hidden = state.scans.length < 2;
    this.scans.replaceChildren(...state.scans.map(({ name, count }, i) => make("option", { selected: i === state.scan },
      state.verdicts ? `${WORDS[state.verdicts[i].verdict]} · ${name} (${count})` : `${name}: ${count}`)));
    this.scans.title = this.scans.selectedOptions[0]?.text ?? "";
    this.buttons.undo.disabled = !state.undo;
    this.buttons.redo.disabled = !state.redo;
    const waiting = Object.keys(this.waiting()).length;
    this.buttons.confirm.disabled = !waiting;
    this.buttons.confirm.textContent = waiting ? `confirm ${waiting} predicted` : "confirm all";
    this.buttons.predict.disabled = !state.can_predict || Boolean(state.working);
    this.buttons.swap.disabled = !state.can_swap;
    this.buttons.pair.disabled = !state.pair;
    this.buttons.pair.textContent = state.pair ? `exchange with ${state.pair}` : "exchange the pair";
    this.buttons.next.disabled = state.names.length < 2;
    this.buttons.there.hidden = !(this.off(state.chosen) > OFF);
    this.buttons.swap.hidden = this.buttons.pair.hidden = this.buttons.predict.hidden = state.panes.length < 2;
    this.buttons.confirm.hidden = this.buttons.swap.hidden && !state.joints;
    this.insideLabel.hidden = Boolean(state.joints);
    this.tellDepth();
    this.names();
    this.tellFile();
    this.ask(state.question);
    if (state.working) this.work(state.working); else { this.work(null); this.say(state.note || this.hint()); }
    this.paint();
  }

  hint() {
    const { chosen, fixed, panes, hint } = this.state;
    if (!chosen || hint) return hint ?? "";
    if (panes.length < 2) return `Click “${chosen}” on the template.`;
    const [template, scan] = panes.map((pane) => chosen in pane.places);
    if (!fixed && !template && !scan) return `Click “${chosen}” on the template, then on the scan.`;
    return fixed || template ? `Click “${chosen}” on the scan.` : `Now the same, “${chosen}”, on the template.`;
  }

  // How deep the last joint lies on its ray, from where that enters the body to where it leaves: 0 to 1.
  share() {
    const { depth, panes } = this.state;
    const [from, to] = depth.ends, all = distance(from, to);
    return panes[0].places[depth.name].reduce((sum, x, k) => sum + (x - from[k]) * (to[k] - from[k]), 0) / (all * all);
  }

  tellDepth() {
    const { depth } = this.state;
    this.depthLabel.hidden = !depth;
    if (!depth) return;
    this.depthLabel.firstChild.textContent = `“${depth.name}” lies at ${(100 * this.share()).toFixed(0)}% of the way through the body: `;
    if (document.activeElement !== this.depth) this.depth.value = 100 * this.share();
  }

  slideTo(share) {
    const { name, ends: [from, to] } = this.state.depth;
    const direction = to.map((x, k) => x - from[k]);
    this.send("slide", { pane: 0, name, direction, by: (share - this.share()) * distance(from, to) }, "depth");
  }

  // A click that is far from where the landmark was expected: was it meant?
  ask(question) {
    this.question.hidden = !question;
    this.status.hidden = Boolean(question);
    if (!question) { this.question.replaceChildren(); return; }
    const { name, text } = question;
    this.question.replaceChildren(make("span", {}, text),
      button("keep", "it is right where I clicked", () => this.send("keep", { name })),
      button("move it there", "to where it was expected", () => this.send("confirm", { names: [name] })),
      button("undo", "click again", () => this.send("undo")));
  }

  tellFile() {
    this.file.textContent = this.state.fixed ? "" : `saved at every click in ${this.state.panes.map((pane) => pane.file).join(" and ")}`;
  }

  names() {
    const { names, chosen, panes } = this.state, focused = this.list.contains(document.activeElement);
    this.list.replaceChildren(...names.map((name) => {
      const marks = panes.map((pane) => {
        const said = name in pane.places ? "set" : name in pane.predicted ? "predicted" : "not set";
        return make("span", { class: MARKS[said], title: said, role: "img", "aria-label": said });
      });
      return make("li", { role: "option", "aria-selected": String(name === chosen), tabindex: name === chosen ? 0 : -1,
        onclick: (event) => this.choose(name, event) },
        make("span", { class: "sk-dots" }, ...marks), make("span", {}, name), this.beside(name));
    }));
    const current = this.list.querySelector("[aria-selected=true]");
    if (!current) return;
    if (focused) current.focus({ preventScroll: true });
    // only the list is scrolled: on a telephone the page would leave the bodies
    const top = current.offsetTop - this.list.offsetTop, below = top + current.offsetHeight - this.list.clientHeight;
    if (top < this.list.scrollTop) this.list.scrollTop = top;
    else if (below > this.list.scrollTop) this.list.scrollTop = below;
  }

  // What is told beside a name: how far it is from where it was predicted.
  beside(name) {
    const far = this.off(name);
    if (far === null) return "";
    return make("small", { title: "from where it is predicted", class: far > OFF ? "sk-bad" : null }, `${(1000 * far).toFixed(0)} mm off`);
  }

  choose(name, event) {
    if (event.shiftKey && this.state.chosen) this.tellDistance(this.state.chosen, name);
    this.send("choose", { name });
  }

  tellDistance(a, b) {
    const told = this.state.panes.map((pane, i) => a in pane.places && b in pane.places ?
      `${i ? "scan" : "template"} ${(1000 * distance(pane.places[a], pane.places[b])).toFixed(1)} mm` : null).filter(Boolean);
    this.measure.textContent = told.length ? `${a} to ${b}: ${told.join(", ")}` : `${a} and ${b} are not both set`;
  }

  // Landmarks as dots with names, in every pane.
  paint() {
    if (!this.figure || !this.state) return;
    if (this.state.joints) this.figure.panes[0].overlays = [(context, pane) => this.drawDepth(context, pane)];
    if (this.figure.panes[1]) this.figure.panes[1].overlays = [(context, pane) => this.drawOff(context, pane)];
    this.figure.panes.slice(0, 2).forEach((pane, i) => {
      const marks = this.state.panes[i];
      if (!marks) return;
      const groups = { predicted: i === this.state.panes.length - 1 ? this.waiting() : {}, set: {}, chosen: {} };
      for (const [name, place] of Object.entries(marks.places)) groups[name === this.state.chosen ? "chosen" : "set"][name] = place;
      for (const [group, places] of Object.entries(groups)) {
        const labels = Object.keys(places).map((name) => group === "predicted" ? `${name} ?` : name);
        pane.setDots(group, Object.values(places), labels, COLORS[group]);
      }
    });
  }

  // The ray of the last click, inside the body.
  drawDepth(context, pane) {
    const ends = this.state.depth?.ends.map((place) => pane.project(new Vector3().fromArray(place).sub(pane.origin)));
    if (!ends?.every(Boolean)) return;
    const scale = pane.canvas.width / Math.max(pane.canvas.clientWidth, 1);
    context.strokeStyle = context.fillStyle = COLORS.chosen;
    context.lineWidth = 2 * scale;
    context.beginPath();
    for (const end of ends) context.lineTo(end.x * scale, end.y * scale);
    context.stroke();
    for (const end of ends) context.fillRect((end.x - 3) * scale, (end.y - 3) * scale, 6 * scale, 6 * scale);
  }

  // A line from each landmark that is far off to a ring where it is predicted.
  drawOff(context, pane) {
    const { places, predicted } = this.state.panes[1] ?? { places: {} };
    const scale = pane.canvas.width / Math.max(pane.canvas.clientWidth, 1);
    context.strokeStyle = COLORS.predicted;
    context.lineWidth = 2 * scale;
    for (const name of Object.keys(places).filter((one) => this.off(one) > OFF)) {
      const [from, to] = [places[name], predicted[name]].map((place) => pane.project(new Vector3().fromArray(place).sub(pane.origin)));
      if (!from || !to) continue;
      context.beginPath();
      context.moveTo(from.x * scale, from.y * scale);
      context.lineTo(to.x * scale, to.y * scale);
      context.moveTo((to.x + 6) * scale, to.y * scale);
      context.arc(to.x * scale, to.y * scale, 6 * scale, 0, 2 * Math.PI);
      context.stroke();
    }
  }

  shown(figure) {
    figure.panes.slice(0, 2).forEach((pane, i) => this.listen(pane, i));
    this.paint();
  }

  listen(pane, number) {
    const { canvas } = pane;
    let down = null;
    canvas.addEventListener("pointerdown", (event) => {
      if (event.button !== 0) return;
      const name = this.near(pane, number, event);
      down = { x: event.clientX, y: event.clientY, name, moved: false, drag: ++this.drags };
      if (name && !(number === 0 && this.state.fixed)) { pane.controls.enabled = false; canvas.setPointerCapture(event.pointerId); }
    }, true);
    canvas.addEventListener("pointermove", (event) => {
      if (!down) return;
      down.moved ||= Math.hypot(event.clientX - down.x, event.clientY - down.y) > STILL;
      if (down.moved && !pane.controls.enabled) this.place(pane, number, down.name, event, down.drag);
    });
    canvas.addEventListener("pointerup", (event) => {
      if (!down) return;
      const { name, moved, drag } = down;
      const dragging = !pane.controls.enabled;
      down = null;
      pane.controls.enabled = true;
      if (!moved && this.state.joints && name in this.waiting()) this.send("confirm", { names: [name] });
      else if (dragging && moved) this.place(pane, number, name, event, drag);
      else if (!moved && name && name !== this.state.chosen && !(name in this.waiting())) this.send("choose", { name });
      else if (!moved) this.place(pane, number, name ?? this.state.chosen, event, 0);
    });
  }

  // The landmark under the pointer; one behind the body only where joints are clicked, which are inside.
  near(pane, number, event) {
    const box = pane.canvas.getBoundingClientRect();
    const marks = { ...(number === this.state.panes.length - 1 ? this.waiting() : {}), ...this.state.panes[number].places };
    let best = null, least = NEAR;
    for (const [name, place] of Object.entries(marks)) {
      const point = new Vector3().fromArray(place).sub(pane.origin), at = pane.project(point);
      const away = at ? Math.hypot(at.x - (event.clientX - box.left), at.y - (event.clientY - box.top)) : Infinity;
      const fixed = number === 0 && this.state.fixed;   // is only chosen
      if (away < least && (this.inside || fixed || !pane.covers(point))) { best = name; least = away; }
    }
    return best;
  }

  place(pane, number, name, event, drag) {
    if (!name) { this.say("Name the landmark first: choose one from the list, or type another name.", "bad"); return; }
    const aimed = aim(pane, event), { raycaster } = pane.ray(aimed), hit = pane.hit(aimed);
    const fields = { pane: number, name, inside: this.inside, drag, origin: raycaster.ray.origin.clone().add(pane.origin).toArray(),
      direction: raycaster.ray.direction.toArray(), seen: hit ? hit.point.clone().add(pane.origin).toArray() : null };
    this.send("place", fields, drag ? `drag ${drag}` : "");
  }

  key(event) {
    if (!this.state || event.target.matches("input:not([type=checkbox]), select, textarea")) return;
    const { chosen, scan, scans, panes } = this.state;
    const pane = panes.length > 1 && chosen in panes[1].places ? 1 : 0;
    const slide = (by) => {
      const name = this.state.depth?.name ?? chosen;
      if (!(name in panes[pane].places)) return;
      const direction = new Vector3().fromArray(panes[pane].places[name]).sub(this.figure.panes[pane].origin).sub(this.figure.panes[pane].camera.position);
      this.send("slide", { pane, name, direction: direction.toArray(), by });
    };
    const actions = {
      n: () => this.step(1), p: () => this.step(-1), z: () => this.send(event.shiftKey ? "redo" : "undo"), Z: () => this.send("redo"), y: () => this.send("redo"),
      Delete: () => this.send("remove", { pane, name: chosen }), Backspace: () => this.send("remove", { pane, name: chosen }),
      c: () => this.confirm(), "[": () => scan > 0 && this.send("open", { scan: scan - 1 }),
      "]": () => scan < scans.length - 1 && this.send("open", { scan: scan + 1 }),
      "+": () => slide(0.002), "-": () => slide(-0.002), i: () => this.insideBox.click(), x: () => this.buttons.pair.click(),
    };
    if (event.altKey || ((event.ctrlKey || event.metaKey) && !"zZy".includes(event.key))) return;
    if (actions[event.key]) { event.preventDefault(); actions[event.key](); }
  }
}

export function button(text, title, onclick) {
  return make("button", { type: "button", title, onclick }, text);
}

// The event itself, or the nearest place beside it where the pointer would be on a surface.
function aim(pane, event) {
  if (pane.hit(event)) return event;
  for (const away of BESIDE) {
    for (let k = 0; k < 8; k++) {
      const beside = { clientX: event.clientX + away * Math.cos(k * Math.PI / 4), clientY: event.clientY + away * Math.sin(k * Math.PI / 4) };
      if (pane.hit(beside)) return beside;
    }
  }
  return event;
}

function distance(a, b) { return Math.hypot(a[0] - b[0], a[1] - b[1], a[2] - b[2]); }
