"""The page's side of the connection, in a real browser: frames, reload, lost connections."""
import http.server
import json
import threading
from dataclasses import replace

import pytest
from browser import wait_until, watched
from click_app import until

from scanprep.viewer.messages import Message

# the event `lose` loses all answers that are underway, and what is asked while `offline`
LOSING = """
const real = fetch;
window.fetch = (address, options) => window.offline ? Promise.reject(new TypeError("offline")) : Promise.race([
  real(address, options),
  new Promise((_, fail) => { addEventListener("lose", () => fail(new TypeError("lost")), { once: true }); })]);
window.lose = () => { dispatchEvent(new Event("lose")); };
"""


@pytest.fixture
def opened(page, server):
    """The page of the server, connected."""
    server.style = "body { color: navy }"
    page.add_init_script(LOSING)
    page.goto(server.opening())
    connected(page)
    return page


def connected(page):
    wait_until(page, "states.at(-1) === 'open'")


def test_the_page_starts_with_nothing_of_another_machine_and_no_error(opened, server):
    assert opened.evaluate("name") == "pick" and opened.title() == "Clicks <of> a test"
    assert opened.evaluate("getComputedStyle(document.body).color") == "rgb(0, 0, 128)"
    assert opened.url == f"http://127.0.0.1:{server.port}/"
    assert {address.split("/")[2] for address in opened.requests} == {f"127.0.0.1:{server.port}"}
    assert opened.evaluate("got[0]") == ["state", {"clicks": 0}, [1, 2]]
    assert not opened.errors and not server.told


def test_a_foreign_script_does_not_run_in_the_page(opened):
    opened.evaluate("document.body.append(Object.assign(document.createElement('script'), {text: 'window.bad = 1'}))")
    assert opened.evaluate("window.bad") is None and any("Content Security Policy" in e for e in opened.errors)


def test_the_page_can_be_loaded_again_and_no_script_sees_the_token(opened, server):
    opened.reload()
    connected(opened)
    assert opened.evaluate("document.cookie") == ""
    assert server.gate.token not in opened.content()


def test_both_sides_read_and_write_the_same_frames(opened):
    message = Message("pick", {"name": "crown ⛑", "at": [1.5, None, True]}, b"", "pick/crown", 7)
    fields = json.dumps(dict(message.fields))
    packed = bytes(opened.evaluate(f"""() => Array.from(scapekit.pack({{
        kind: "pick", fields: {fields}, latest: "pick/crown", number: 7}}))"""))
    assert Message.unpack(packed) == message
    message = replace(message, data=bytes(range(256)))
    got = opened.evaluate(f"""() => {{
        const m = scapekit.unpack(new Uint8Array({list(message.pack())}).buffer);
        return [m.kind, m.fields, Array.from(m.data), m.latest, m.number, m.data.byteOffset % 8];
    }}""")
    assert got == ["pick", dict(message.fields), list(range(256)), "pick/crown", 7, 0]
    assert Message.unpack(bytes(opened.evaluate("Array.from(scapekit.pack({kind: 'a', fields: {x: NaN}}))"))
                          ).fields == {"x": None}


def test_a_second_tab_takes_over_and_the_first_says_so(opened, server, app):
    second = watched(opened.context)
    second.goto(f"http://127.0.0.1:{server.port}/")
    connected(second)
    wait_until(opened, "states.at(-1) === 'elsewhere'")
    opened.evaluate("line.send('click', {n: 3})")
    second.evaluate("line.send('click', {n: 4})")
    wait_until(second, "got.length === 2")
    assert second.evaluate("got[1]") == ["state", {"clicks": 1, "n": 4}, []] and app.seen == [4]


def test_what_is_clicked_while_the_connection_is_lost_arrives_once_and_in_order(opened, app):
    for n in range(30):
        if n in (5, 6, 18):
            opened.evaluate("lose()")                        # some arrived, none is answered
        opened.evaluate(f"line.send('click', {{n: {n}}})")
    until(lambda: len(app.seen) >= 30, 10)
    connected(opened)
    opened.evaluate("line.send('click', {n: 30})")
    until(lambda: len(app.seen) >= 31)
    assert app.seen == list(range(31))
    assert "lost" in opened.evaluate("states")
    wait_until(opened, "got.at(-1)[1].clicks === 31")


def test_a_page_whose_server_ended_says_that_the_connection_is_lost(opened, server):
    server.__exit__()
    wait_until(opened, "states.at(-1) === 'lost'")


class Foreign(http.server.SimpleHTTPRequestHandler):
    """A site that another program of this machine serves."""

    def do_GET(self):
        self.send_response(200)
        self.end_headers()

    def log_message(self, *given):
        pass


@pytest.mark.slow
@pytest.mark.parametrize("host", ["127.0.0.1", "localhost"])
def test_another_site_can_neither_click_nor_listen(opened, server, app, host):
    """Another port is the same site, which gets the user's cookie, but another origin."""
    foreign = watched(opened.context)
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Foreign) as site:
        threading.Thread(target=site.serve_forever, daemon=True).start()
        foreign.goto(f"http://{host}:{site.server_port}/")
        said = foreign.evaluate(f"""async () => {{
          const own = "127.0.0.1:{server.port}";
          const ask = (path) => fetch(`http://${{own}}${{path}}`, {{method: "POST", body: "x", mode: "no-cors",
            credentials: "include"}}).then((answer) => answer.type, () => "failed");
          return [await ask("/message?page=12345678"), await ask("/messages?page=12345678&greet=1")];
        }}""")
        site.shutdown()
    assert said == ["failed", "failed"] and opened.evaluate("states") == ["open"]     # what came was not shown to it
    origin = f"http://{host}:{site.server_port}"
    assert server.told == [f"refused: POST /message: foreign Origin {origin}",
                           f"refused: POST /messages: foreign Origin {origin}"]
