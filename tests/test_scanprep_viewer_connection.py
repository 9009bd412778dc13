"""The page's side of the connection, in a real browser: frames, reload, lost connections, dropped files."""
import http.server
import json
import threading

import pytest
from browser import wait_until, watched
from click_app import Clicks, clicking, until

from scanprep.viewer import handlers
from scanprep.viewer.messages import Message

CUT = """
const Real = WebSocket;
let made = 0, sent = 0;
window.WebSocket = class extends Real {                  // the first connection breaks with the third message: some
  cut = made++ === 0;                                    // arrived, none is acknowledged
  send(data) {
    if (!this.cut) return super.send(data);
    if (++sent <= %d) super.send(data);
    if (sent === 3) setTimeout(() => this.close(), 50);
  }
  set onmessage(hear) { super.onmessage = (event) => { if (!this.cut || !sent) hear(event); }; }
};
"""


@pytest.fixture
def app(tmp_path):
    (tmp_path / "body.ply").write_bytes(b"ply of a body")
    return Clicks(tmp_path)


@pytest.fixture
def server(app):
    with clicking(app) as server:
        yield server


@pytest.fixture
def opened(page, server):
    """The page of the server, connected."""
    page.goto(server.opening())
    connected(page)
    return page


def connected(page):
    wait_until(page, "states.at(-1) === 'open'")


def disconnect(server):
    """Cut all connections, from the side of the server."""
    server._in_loop(server.tabs.close)


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


def test_wasm_and_workers_of_its_own_run_in_the_page(opened):
    assert opened.evaluate("""async () => {
      await WebAssembly.instantiate(new Uint8Array([0, 97, 115, 109, 1, 0, 0, 0]));
      const worker = new Worker(URL.createObjectURL(new Blob(["postMessage(7)"])));
      return new Promise((done) => { worker.onmessage = (event) => done(event.data); });
    }""") == 7
    assert not opened.errors


def test_the_page_can_be_loaded_again_and_no_script_sees_the_token(opened, server):
    opened.reload()
    connected(opened)
    assert opened.evaluate("document.cookie") == ""
    assert server.gate.token not in opened.content()


def test_a_page_without_the_token_is_refused(page, server):
    assert page.goto(f"http://127.0.0.1:{server.port}/").status == 403


def test_both_sides_read_and_write_the_same_frames(opened):
    message = Message("pick", {"name": "crown ⛑", "at": [1.5, None, True]}, bytes(range(256)), "pick/crown", 7)
    fields = json.dumps(dict(message.fields))
    packed = bytes(opened.evaluate(f"""() => Array.from(scapekit.pack({{
        kind: "pick", fields: {fields}, data: Uint8Array.from({{length: 256}}, (_, i) => i), latest: "pick/crown",
        number: 7}}))"""))
    assert Message.unpack(packed) == message
    got = opened.evaluate(f"""() => {{
        const m = scapekit.unpack(new Uint8Array({list(message.pack())}).buffer);
        return [m.kind, m.fields, Array.from(m.data), m.latest, m.number, m.data.byteOffset % 8];
    }}""")
    assert got == ["pick", dict(message.fields), list(range(256)), "pick/crown", 7, 0]
    assert Message.unpack(bytes(opened.evaluate("Array.from(scapekit.pack({kind: 'a', fields: {x: NaN}}))"))
                          ).fields == {"x": None}


def test_two_tabs_show_the_same(opened, server, app):
    second = watched(opened.context)
    second.goto(f"http://127.0.0.1:{server.port}/")
    connected(second)
    opened.evaluate("line.send('click', {n: 4}, new Float32Array([1]))")
    for tab in (opened, second):
        wait_until(tab, "got.length === 2")
        assert tab.evaluate("got[1]") == ["state", {"clicks": 1, "n": 4}, [0, 0, 128, 63]]


def test_what_is_clicked_while_the_connection_is_lost_arrives_once_and_in_order(opened, server, app):
    for n in range(30):
        if n in (5, 6, 18):
            disconnect(server)
        opened.evaluate(f"line.send('click', {{n: {n}}})")
    until(lambda: len(app.seen) >= 30, 10)
    connected(opened)
    opened.evaluate("line.send('click', {n: 30})")
    until(lambda: len(app.seen) >= 31)
    assert app.seen == list(range(31))
    assert "lost" in opened.evaluate("states")
    wait_until(opened, "got.at(-1)[1].clicks === 31")


@pytest.mark.slow
@pytest.mark.parametrize("arriving", [0, 2, 6])
def test_what_was_not_acknowledged_is_done_once_whether_it_arrived_or_not(new_page, server, app, arriving):
    page = new_page()
    page.add_init_script(CUT % arriving)
    page.goto(server.opening())
    connected(page)
    page.evaluate("for (let n = 0; n < 6; n++) line.send('click', {n})")
    wait_until(page, "states.join() === 'open,lost,open'")
    until(lambda: len(app.seen) >= 6)
    page.evaluate("line.send('click', {n: 6})")
    until(lambda: len(app.seen) >= 7)
    assert app.seen == list(range(7))


def test_what_is_sent_again_is_not_done_twice(opened, server, app, monkeypatch):
    """The old connection may still deliver what the new one was told to be missing."""
    monkeypatch.setattr(server.tabs, "acknowledgement", lambda name: (nothing_came, "acknowledged"))
    nothing_came = Message("acknowledged", {"number": 0}).pack()
    opened.evaluate("for (let n = 0; n < 6; n++) line.send('click', {n})")
    until(lambda: len(app.seen) >= 6)
    disconnect(server)
    wait_until(opened, "states.join() === 'open,lost,open'")
    opened.evaluate("line.send('click', {n: 6})")
    until(lambda: 6 in app.seen)
    assert app.seen == list(range(7))


def test_moves_of_a_lost_connection_are_replaced_but_overtake_no_click(opened, server, app):
    disconnect(server)
    wait_until(opened, "states.at(-1) === 'lost'")
    opened.evaluate("""for (const n of [1, 2, 3, "click", 4, 5]) {
        line.send("move", {n}, undefined, n === "click" ? "" : "pose"); }""")
    until(lambda: len(app.seen) == 3, 10)
    assert app.seen == [3, "click", 5] and app.numbers == [1, 2, 3]


def test_the_page_of_a_server_that_ended_waits_and_that_of_an_earlier_one_is_refused(opened, server):
    server.gate.server = "another server at the same port"
    disconnect(server)
    wait_until(opened, "states.at(-1) === 'refused'")
    assert opened.evaluate("states") == ["open", "lost", "refused"]
    line, = server.told
    assert line == "refused: GET /alive: a page of an earlier server"
    assert opened.evaluate("try { line.send('click') } catch (e) { e.message }") == "the connection was closed"


def test_a_closed_connection_stays_closed(opened, server):
    opened.evaluate("line.close()")
    until(lambda: len(server.tabs) == 0)
    opened.wait_for_timeout(600)
    assert len(server.tabs) == 0 and opened.evaluate("states") == ["open"]


def test_messages_that_are_too_large_are_not_sent(opened, server, app):
    said = opened.evaluate(f"try {{ line.send('click', {{}}, new Uint8Array({handlers.LARGEST_MESSAGE})) }}"
                           " catch (e) { e.message }")
    assert "more than 16777216" in said
    opened.evaluate("line.send('click', {n: 1})")
    until(lambda: app.seen == [1])


def test_files_are_dropped_and_downloaded(opened, server, app):
    opened.evaluate("line.upload(new File([new Uint8Array(100000).fill(7)], 'änna 1.ply'))")
    wait_until(opened, "got.some(([kind, fields]) => kind === 'received' && fields.name === 'änna 1.ply')")
    assert app.files[0][2] == b"\x07" * 100000
    opened.evaluate("line.upload(new File(['x'], 'notes.txt'))")
    wait_until(opened, "got.some(([kind, fields]) => kind === 'error' && fields.text.startsWith('notes.txt: '))")
    with opened.expect_download() as started:
        opened.evaluate("Object.assign(document.createElement('a'), {href: '/file/body.ply'}).click()")
    assert started.value.suggested_filename == "body.ply"
    assert started.value.path().read_bytes() == b"ply of a body"
    assert not opened.errors and not server.told


def test_a_file_without_a_name_is_told_to_the_user(opened):
    said = opened.evaluate("line.upload(new File(['x'], '..')).catch((e) => e.message)")
    assert said == "..: Bad Request"


class Foreign(http.server.SimpleHTTPRequestHandler):
    """A site that another program of this machine serves."""

    def do_GET(self):
        self.send_response(200)
        self.end_headers()

    def log_message(self, *given):
        pass


@pytest.mark.slow
@pytest.mark.parametrize("host", ["127.0.0.1", "localhost"])
def test_another_site_can_neither_connect_nor_store(opened, server, app, host):
    """Another port is the same site, which gets the user's cookie, but another origin."""
    foreign = watched(opened.context)
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Foreign) as site:
        threading.Thread(target=site.serve_forever, daemon=True).start()
        foreign.goto(f"http://{host}:{site.server_port}/")
        said = foreign.evaluate(f"""async () => {{
          const own = "127.0.0.1:{server.port}";
          await fetch(`http://${{own}}/drop?name=a.ply`, {{method: "POST", body: "x", mode: "no-cors",
            credentials: "include"}}).catch(() => null);
          const line = new WebSocket(`ws://${{own}}/socket?tab=12345678`);
          return new Promise((done) => {{ line.onopen = () => done("open"); line.onclose = () => done("closed"); }});
        }}""")
        site.shutdown()
    assert said == "closed" and not app.files and len(server.tabs) == 1
    origin = f"http://{host}:{site.server_port}"
    assert server.told == [f"refused: POST /drop: foreign Origin {origin}",
                           f"refused: GET /socket: foreign Origin {origin}"]
