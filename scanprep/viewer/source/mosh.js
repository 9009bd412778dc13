// A result of `scape mosh`: markers on a person worst first, moved as in `scape pick`, exchanged or taken away; run again.
import { make } from "./figure.js";
import { button, Pick, WORDS } from "./pick.js";

export class Mosh extends Pick {
  build() {
    super.build();
    this.alike = undefined;                             // at rest and in a frame people stand differently
    for (const each of [this.added, this.insideBox.parentElement, this.buttons.swap, this.buttons.pair, this.buttons.predict, this.buttons.confirm]) each.remove();
    this.scans.setAttribute("aria-label", "person");
    this.list.setAttribute("aria-label", "markers");
    this.verdict = make("div", { class: "sk-verdict" });
    this.figures = make("table", { class: "sk-before" });
    this.frames = make("select", { "aria-label": "frame", onchange: () => this.send("frame", { frame: this.frames.selectedIndex }) });
    this.go = button("run again", "what scape mosh does, with the corrected layout", () => this.send("run"));
    this.go.classList.add("sk-main-button");
    this.other = make("select", { "aria-label": "marker to exchange with" });
    this.exchange = button("exchange with", "each is where the other was, for labels that were mixed up",
      () => this.send("exchange", { name: this.state.chosen, other: this.other.value }));
    this.away = button("take out of use", "run again without this marker (Delete)", () => this.send("remove", { pane: 1, name: this.state.chosen }));
    this.told = make("ul", { class: "sk-doubts", "aria-label": "doubts" });
    this.scans.after(this.verdict, this.figures, make("div", { class: "sk-buttons" }, this.go),
      make("label", {}, "frame ", this.frames));
    this.list.after(this.told, make("div", { class: "sk-buttons" }, this.away, this.exchange, this.other));
  }

  update(state) {
    super.update(state);
    const { verdicts, scan, rows, frames, frame, names, chosen, changed, doubts, working, panes } = state;
    const { verdict, reasons } = verdicts[scan];
    this.verdict.dataset.verdict = verdict;
    this.verdict.replaceChildren(make("strong", {}, WORDS[verdict]), make("ul", {}, ...reasons.map((reason) => make("li", {}, reason))));
    const again = rows.some(([, before]) => before);
    this.figures.replaceChildren(...again ? [make("tr", {}, ...["", "before", "now"].map((text) => make("th", {}, text)))] : [],
      ...rows.map(([name, before, now, unit]) => make("tr", {}, make("td", {}, name),
        ...(again ? [before, now] : [now]).map((value) => make("td", {}, value && `${value} ${unit}`)))));
    this.frames.replaceChildren(...frames.map((told, i) => make("option", { selected: i === frame }, told)));
    const wanted = this.other.value;
    this.other.replaceChildren(...names.filter((name) => name !== chosen && name in panes[1].places).map((name) => make("option", { selected: name === wanted }, name)));
    this.told.hidden = !doubts[chosen];
    this.told.replaceChildren(...(doubts[chosen] ?? []).map((line) => make("li", {}, line)));
    this.away.disabled = this.exchange.disabled = !(chosen in panes[1].places);
    this.go.disabled = Boolean(working) || !changed.length;
    this.go.textContent = changed.length ? `run again with ${changed.length} corrected` : "run again";
  }

  beside(name) {
    const { off, doubts, changed, panes } = this.state;
    const told = changed.includes(name) ? (name in panes[1].places ? "moved" : "out of use") : name in off ? `${off[name].toFixed(1)} mm` : "not used";
    return make("small", { title: (doubts[name] ?? ["mean distance of the measured marker from where the body has it"]).join("\n") },
      name in doubts ? `${told} ?` : told);
  }

  place(...given) {
    this.inside = false;                                // of the key for joints
    super.place(...given);
  }

  hint() { return `Click where “${this.state.chosen}” truly sits on the person at rest, or drag it there.`; }

  tellFile() { this.file.textContent = this.state.changed.length ? `saved at every click in ${this.state.corrected}; your own layout stays as it is` : ""; }
}
