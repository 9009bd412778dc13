// `scape complete --interactive`: landmarks as in `scape pick`, then a button, the whole body, and what it is worth.
import { dropZone } from "./drop.js";
import { make } from "./figure.js";
import { button, Pick } from "./pick.js";

const WHOLE = "Under the bodies: boxes show the completed body, the predicted one and the scan; the list has the expected error as colours.";

export class Complete extends Pick {
  build() {
    super.build();
    this.known = make("input", { type: "checkbox", onchange: () => this.send("known", { known: this.known.checked }) });
    this.knownLabel = make("label", { title: "the person whose poses the model was learned from; else the shape is found too" }, this.known, "the model's own person");
    this.go = button("complete", "the whole body from the scan and the landmarks", () => this.send("complete"));
    this.go.classList.add("sk-main-button");
    this.anew = button("search anew", "forget the body that there is and search again", () => this.send("complete", { anew: true }));
    this.keep = button("save", "write the body, its pose and a report", () => this.send("save"));
    this.verdict = make("div", { class: "sk-verdict", hidden: true });
    this.markers = make("p", { class: "sk-file" });
    this.added.placeholder = "a name, or a marker set: cmu41";
    this.scans.before(dropZone(this, "drop a scan here, or a recording whose markers to click, or choose a file"));
    this.list.before(make("div", { class: "sk-buttons" }, this.go, this.anew, this.keep), this.knownLabel, this.verdict, this.markers);
    this.buttons.predict.remove();
  }

  update(state) {
    super.update(state);
    const { completed, working, can_choose: free } = state;
    this.known.checked = state.known;
    this.knownLabel.hidden = !free;
    const clicked = Object.keys(state.panes[1]?.places ?? {}).length - state.markers;
    this.markers.textContent = state.markers ? `${state.markers} marker${state.markers > 1 ? "s" : ""}: “save” writes where on the model to layout.json` : "";
    this.go.disabled = Boolean(working) || state.panes.length < 2;
    this.go.textContent = completed ? "complete again" : clicked ? `complete with ${clicked} landmarks` : "complete without landmarks";
    this.anew.hidden = !completed;
    this.anew.disabled = Boolean(working);
    this.keep.disabled = !completed || Boolean(working);
    this.verdict.hidden = !completed;
    if (completed) this.judge(completed);
  }

  judge({ verdict, reasons, rows, outdated, helpful, saved }) {
    const words = { good: "good", check: "look at it", failed: "failed" };
    this.verdict.dataset.verdict = verdict;
    this.verdict.replaceChildren(make("strong", {}, outdated ? "landmarks changed since: complete again" : words[verdict] ?? verdict),
      make("ul", {}, ...reasons.map((reason) => make("li", {}, reason))),
      helpful.length ? make("p", {}, "A landmark would help at: ", ...helpful.flatMap((name, i) => [i ? ", " : "",
        make("a", { href: "#", onclick: (event) => { event.preventDefault(); this.send("choose", { name }); } }, name)])) : "",
      make("details", {}, make("summary", {}, "figures"), make("table", {}, ...rows.map((row) => make("tr", {}, ...row.map((cell) => make("td", {}, cell)))))),
      saved ? make("p", {}, `saved in ${saved}`) : "");
  }

  hint() {
    if (this.state.panes.length < 2) return "Drop a scan on the page.";
    return this.state.completed ? WHOLE : `${super.hint()} Three to ten landmarks help most; then press “complete”.`;
  }
}
