// `scape pick SET`: scans worst first, their landmarks mended as in `scape pick`, and a button that registers them again;
// of two bodies that explain a scan as well another button takes the other.
import { make } from "./figure.js";
import { button, Pick, WORDS } from "./pick.js";
import { unpackScene } from "./unpack.js";

export class Mend extends Pick {
  build() {
    super.build();
    this.verdict = make("div", { class: "sk-verdict" });
    this.go = button("register again", "what scape prep run does, for scans that have changed", () => this.send("register"));
    this.go.classList.add("sk-main-button");
    this.other = button("take the other body", "it explains the scan as well; once more takes it back", () => this.send("take_rival"));
    this.scans.after(this.verdict, make("div", { class: "sk-buttons" }, this.go, this.other));
  }

  // The template on the scan, from the page of the set, has columns of its own.
  async unpack(data, { first }) {
    const scene = await unpackScene(data.slice(0, first));
    if (first < data.length) {
      const { panes, columns } = await unpackScene(data.slice(first));
      scene.panes.push({ ...panes[1], columns });
    }
    return scene;
  }

  update(state) {
    super.update(state);
    const { scan, verdicts, changed, template_changed: all, outdated, working, rivals } = state;
    const { verdict, reasons } = verdicts[scan];
    this.verdict.dataset.verdict = verdict;
    this.verdict.replaceChildren(make("strong", {}, outdated && verdict !== "new" ? `${WORDS[verdict]}; changed since` : WORDS[verdict]),
      make("ul", {}, ...reasons.map((reason) => make("li", {}, reason))));
    this.other.disabled = Boolean(working);
    this.go.disabled = Boolean(working) || !(all || changed.length);
    this.other.hidden = !rivals[scan];
    this.go.textContent = all ? "register all scans again" : changed.length > 1 ? `register ${changed.length} scans again` : "register again";
  }
}
