// `scape complete --interactive`: landmarks as in `scape pick`, then a button, the whole body, and what it is worth.
import { make } from "./figure.js";
import { button, Pick, WORDS } from "./pick.js";

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
    this.dropping = this.drop();
    this.scans.before(this.dropping);
    this.list.before(make("div", { class: "sk-buttons" }, this.go, this.anew, this.keep), this.knownLabel, this.verdict);
    this.buttons.predict.remove();
  }

  drop() {
    const input = make("input", { type: "file", hidden: true, onchange: () => { if (input.files[0]) this.upload(input.files[0]); } });
    addEventListener("dragover", (event) => event.preventDefault());
    addEventListener("drop", (event) => { event.preventDefault(); if (event.dataTransfer.files[0]) this.upload(event.dataTransfer.files[0]); });
    return make("label", { class: "sk-drop", tabindex: 0, onkeydown: (event) => { if (event.key === "Enter") input.click(); } }, input, "drop a scan here, or choose a file");
  }

  upload(file) {
    this.say(`reading ${file.name}`);
    this.connection.upload(file).catch((error) => this.say(String(error.message ?? error), "bad"));
  }

  update(state) {
    super.update(state);
    const { completed, working, can_choose: free, verdicts } = state;      // verdicts: of a folder of completions
    this.dropping.hidden = Boolean(verdicts);
    this.known.checked = state.known;
    this.knownLabel.hidden = !free;
    const clicked = Object.keys(state.panes[1]?.places ?? {}).length;
    this.go.disabled = Boolean(working) || state.panes.length < 2;
    this.go.textContent = completed ? "complete again" : clicked ? `complete with ${clicked} landmarks` : "complete without landmarks";
    this.anew.hidden = !completed;
    this.anew.disabled = Boolean(working);
    this.keep.disabled = !completed || Boolean(working) || (verdicts && Boolean(completed.outdated || completed.saved));
    const stored = verdicts && { rows: [], helpful: [], ...verdicts[state.scan] };
    this.verdict.hidden = !(completed ?? stored);
    if (completed ?? stored) this.judge(completed ?? stored);
  }

  judge({ verdict, reasons, rows, outdated, helpful, saved }) {
    this.verdict.dataset.verdict = verdict;
    this.verdict.replaceChildren(make("strong", {}, outdated ? "it changed since: complete again" : WORDS[verdict] ?? verdict),
      make("ul", {}, ...reasons.map((reason) => make("li", {}, reason))),
      helpful.length ? make("p", {}, "A landmark would help at: ", ...helpful.flatMap((name, i) => [i ? ", " : "",
        make("a", { href: "#", onclick: (event) => { event.preventDefault(); this.send("choose", { name }); } }, name)])) : "",
      rows.length ? table(rows) : "",
      saved ? make("p", {}, `saved in ${saved}`) : "");
  }

  hint() {
    if (this.state.panes.length < 2) return "Drop a scan on the page.";
    return this.state.completed ? "" : `${super.hint()} Three to ten landmarks help most; then press “complete”.`;
  }
}

function table(rows) {
  return make("details", {}, make("summary", {}, "figures"),
    make("table", {}, ...rows.map((row) => make("tr", {}, ...row.map((cell) => make("td", {}, cell))))));
}
