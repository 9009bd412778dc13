// The pages of one server: its front ends take each other's place on one connection, as Python says.
import { connect } from "./connection.js";

/** Start the program of this name; a message `page` {number, name, title, back} puts another in its place. */
export function run(programs, name) {
  let state = "";
  const connection = connect((message) => {
    if (message.kind !== "page") window.program.received(message);
    else if (message.fields.number !== window.program.page.number) turn(message.fields);
  }, (now) => { state = now; window.program.connected(now); });

  function turn(page) {
    window.program?.end();
    document.title = page.title;
    window.program = new programs[page.name](connection, page);
    if (state) window.program.connected(state);
  }

  turn({ name, title: document.title });
}
