// `scape complete --interactive`: landmarks as in `scape pick`, then a button, the whole body, and what it is worth.
import { make } from "./figure.js";
import { button, OFF, Pick, WORDS } from "./pick.js";

const WHOLE = "Blue was measured, yellow filled in. The list below has other colours, such as the expected error.";

export class Complete extends Pick {
  build() {
    super.build();
    this.known = make("input", { type: "checkbox", onchange: () => this.send("known", { known: this.known.checked }) });
    this.knownLabel = make("label", { title: "the person whose poses the model was learned from; else the shape is found too" }, this.known, "same person as in the model's poses");
    this.go = button("complete", "the whole body from the scan and the landmarks", () => this.send("complete"));
    this.go.classList.add("sk-main-button");
    this.anew = button("start over", "forget the body that there is and search again", () => this.send("complete", { anew: true }));
    this.keep = button("save", "write the body, its pose and a report", () => this.send("save"));
    this.verdict = make("div", { class: "sk-verdict", hidden: true });
    this.markers = make("p", { class: "sk-file" });
    this.added.placeholder = "a name, or a set: cmu41";
    this.list.before(make("div", { class: "sk-buttons" }, this.go, this.anew, this.keep), this.knownLabel, this.verdict, this.markers);
    this.buttons.predict.remove();
  }

  update(state) {
    super.update(state);
    const { completed, working, can_choose: free, verdicts } = state;      // verdicts: of a folder of completions
    this.known.checked = state.known;
    this.knownLabel.hidden = !free;
    const clicked = Object.keys(state.panes[1]?.places ?? {}).length - state.markers;
    this.markers.textContent = state.markers ? `${state.markers} marker${state.markers > 1 ? "s" : ""}: “save” writes where on the model to layout.json` : "";
    const few = clicked > 0 && clicked < state.fewest ? state.fewest - clicked : 0;
    this.go.disabled = Boolean(working) || state.panes.length < 2 || few > 0;
    this.few = few;
    this.go.textContent = few ? "complete" : completed ? "complete again" : clicked ? `complete with ${clicked} landmarks` : "complete without landmarks";
    this.anew.hidden = !completed;
    this.anew.disabled = Boolean(working) || few > 0;
    this.keep.disabled = !completed || Boolean(working) || completed.outdated || Boolean(verdicts && completed.saved);
    this.keep.textContent = completed?.verdict === "failed" ? "save all the same" : "save";
    const stored = verdicts && { rows: [], helpful: [], ...verdicts[state.scan] };
    this.verdict.hidden = !(completed ?? stored);
    if (completed ?? stored) this.judge(completed ?? stored);
  }

  judge({ verdict, reasons, rows, outdated, helpful, saved, landmarks }) {
    const off = outdated ? [] : Object.keys(this.state.panes[1].places).filter((name) => this.off(name) > OFF).sort((a, b) => this.off(b) - this.off(a));
    const link = (name, text) => make("a", { href: "#", onclick: (event) => { event.preventDefault(); this.send("choose", { name }); } }, text);
    const list = (names, text) => names.flatMap((name, i) => [i ? ", " : "", link(name, text(name))]);
    this.verdict.dataset.verdict = outdated ? "check" : verdict;
    this.verdict.replaceChildren(make("strong", {}, outdated ? "changed since: complete again" : WORDS[verdict] ?? verdict),
      make("ul", {}, ...reasons.map((reason) => make("li", {}, reason))),
      !outdated && landmarks ? make("p", {}, make("a", { href: "#", onclick: (event) => { event.preventDefault(); this.send("doubt"); },
        title: "find the body without the landmarks, and see which of them it has elsewhere" }, "Is a landmark at a wrong place?")) : "",
      off.length ? make("p", {}, "The body has these landmarks elsewhere: ", ...list(off, (name) => `${name}, ${(1000 * this.off(name)).toFixed(0)} mm`)) : "",
      helpful.length ? make("p", {}, "A landmark would help at: ", ...list(helpful, (name) => name)) : "",
      rows.length ? table(rows) : "",
      saved && !outdated ? make("p", {}, `saved: ${saved}`) : "");
  }

  hint() {
    if (this.few) return `${super.hint()} ${this.few === 1 ? "One" : "Two"} more, or none, then “complete”.`;
    return this.state.completed ? `${super.hint()} ${WHOLE}` : `${super.hint()} Three to ten landmarks help most; then press “complete”.`;
  }
}

function table(rows) {
  return make("details", {}, make("summary", {}, "figures"),
    make("table", {}, ...rows.map((row) => make("tr", {}, ...row.map((cell) => make("td", {}, cell))))));
}
