// Files that are dropped on a page, or chosen: sent one after the other, those that belong to others after them.
import { make } from "./figure.js";

const LATER = /\.(json|pp|lnd|txt)$/i;                  // landmarks, layouts, cameras
const FOLDER = "A folder cannot be dropped: drop the files in it, or name it on the command line.";

/** Where files can be dropped, for as long as the program is shown; told by what it says. */
export function dropZone(program, text) {
  const input = make("input", { type: "file", multiple: true, hidden: true, onchange: () => take([...input.files]) });
  const zone = make("label", { class: "sk-drop", tabindex: 0, onkeydown: (event) => {
    if (event.key === "Enter" || event.key === " ") { event.preventDefault(); event.stopPropagation(); input.click(); }
  } }, input, text);

  async function take(files) {
    program.say("");
    for (const file of files.sort((a, b) => LATER.test(a.name) - LATER.test(b.name))) {
      if (program.status.dataset.kind !== "bad") program.say(`reading ${file.name}`);
      await program.connection.upload(file).catch((error) => program.say(String(error.message ?? error), "bad"));
    }
    input.value = "";
  }

  program.onWindow("dragover", (event) => { event.preventDefault(); zone.classList.add("sk-over"); });
  program.onWindow("dragleave", (event) => { if (!event.relatedTarget) zone.classList.remove("sk-over"); });
  program.onWindow("drop", (event) => {
    event.preventDefault();
    zone.classList.remove("sk-over");
    const folders = [...event.dataTransfer.items].some((item) => item.webkitGetAsEntry?.()?.isDirectory);
    if (folders) program.say(FOLDER, "bad");
    else take([...event.dataTransfer.files]);
  });
  return zone;
}
