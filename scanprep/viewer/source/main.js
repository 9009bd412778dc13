// What a page calls: `scapekit.start()` in reports, `scapekit.start("view")` and the like in programs.
import { Complete } from "./complete.js";
import { connect } from "./connection.js";
import { Figure } from "./figure.js";
import { Mend } from "./mend.js";
import { Mosh } from "./mosh.js";
import { hasWebGL } from "./pane.js";
import { Pick } from "./pick.js";
import { fromBase64, unpackScene } from "./unpack.js";
import { View } from "./view.js";

// Every figure of a report becomes one that turns, when it comes into sight; without WebGL its picture stays.
function startReport() {
  const figures = document.querySelectorAll("figure[data-scene]");
  if (!hasWebGL()) {
    document.body.classList.add("sk-pictures-only");
    return;
  }
  const watch = new IntersectionObserver((entries) => {
    for (const { isIntersecting, target } of entries) {
      if (!isIntersecting) continue;
      watch.unobserve(target);
      turn(target).catch((error) => { target.dataset.failed = String(error); throw error; });
    }
  }, { rootMargin: "400px" });
  figures.forEach((figure) => watch.observe(figure));
}

async function turn(figure) {
  const packed = fromBase64(document.getElementById(figure.dataset.scene).textContent);
  const scene = await unpackScene(packed);
  const stage = document.createElement("div");
  const still = figure.querySelector("img");
  stage.style.setProperty("--sk-height", `${figure.dataset.height}px`);
  still.replaceWith(stage);
  figure.sk = new Figure(stage, scene);
  figure.dataset.turns = "";
}

const PROGRAMS = { complete: Complete, mend: Mend, mosh: Mosh, pick: Pick, view: View };

export function start(name) {
  if (!name) {
    startReport();
    return;
  }
  const connection = connect((message) => window.program.received(message), (state) => window.program.connected(state));
  window.program = new PROGRAMS[name](connection);
}
