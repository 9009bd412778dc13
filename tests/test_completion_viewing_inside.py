"""From `scape view` to everything else: files dropped on the page, a scan completed, a set mended, and back."""
import base64
import json
from dataclasses import replace

import numpy as np
import pytest
from browser import wait_until, watched
from click_app import allowed
from completion_bodies import MARKS, POSE, QUICK, TRANS, half_view, worm_with_prior
from hostile_messages import check_it_goes_on
from PIL import Image
from test_completion_depth_picture import AWAY, taken
from test_completion_interactive import NAMES, clicked_on_the_scan, finished
from test_completion_partial import errors
from test_scanprep_pipeline_mend import ENDING, made, mend, place  # noqa: F401 -- fixtures
from test_scanprep_pipeline_mend import wait as wait_for
from viewing_apps import app_of, ask

from completion.partial import report
from completion.partial.completion import load_completion
from completion.viewing import pages as viewing_pages
from completion.viewing.app import ViewApp
from scanprep import write_landmarks, write_mesh
from scanprep.geometry.files import PointCloud, write_points
from scanprep.geometry.landmarks import read_landmarks
from scanprep.viewer.messages import Message
from scanprep.viewer.pages import Pages
from scanprep.viewer.server import Server

TOWARD = np.array([0.3, -1, 0.5])
DROP = """(files) => { const data = new DataTransfer();
    const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
    for (const [name, text] of files) data.items.add(new File([bytes(text)], name));
    return data; }"""


@pytest.fixture(scope="module")
def model():
    plain = worm_with_prior()
    return replace(plain, info={**plain.info, "landmarks": dict(zip(NAMES, map(int, MARKS), strict=True))})


@pytest.fixture(scope="module")
def body(model):
    return model.template.with_vertices(model.vertices(POSE, None, TRANS))


@pytest.fixture
def files(model, body, tmp_path):
    """A model, a scan with a landmark file, a depth picture with its camera, a file that is no mesh."""
    folder = tmp_path / "files"
    folder.mkdir()
    model.save(folder / "worm.npz")
    points, seen = half_view(body, TOWARD, noise=0.001)
    write_points(folder / "half.ply", PointCloud(points))
    write_landmarks(folder / "half.landmarks.json", {
        name: body.vertices[v] for name, v in zip(NAMES, MARKS, strict=True) if seen[v]})
    (folder / "broken.ply").write_text("no mesh")
    there = model.vertices(POSE, None, np.zeros(3))
    depth = taken(model.template.with_vertices(there - there.mean(axis=0) + [0, 0, AWAY])).depth
    Image.fromarray(np.round(1000 * depth).astype(np.uint16)).save(folder / "one.png")
    (folder / "one.camera.json").write_text('{"fx": 300, "fy": 300, "cx": 159.5, "cy": 119.5}')
    return folder


@pytest.fixture
def app(tmp_path, monkeypatch):
    """An empty view whose completions are quick."""
    monkeypatch.setattr(viewing_pages, "CompletionConfig", lambda: QUICK)
    monkeypatch.setattr(report, "HEIGHT", 60)
    app = ViewApp(output=tmp_path / "out")
    yield app
    app.close()


def drop(app, *paths):
    told = []
    for path in paths:
        app.receive(path.name, path, told.append)
    return next(message.fields for message in reversed(told) if message.kind == "state")


def entered(app, **wanted):
    return app.enter(lambda message: None, wanted)


def drop_in(page, *paths):
    data = page.evaluate_handle(DROP, [[path.name, base64.b64encode(path.read_bytes()).decode()] for path in paths])
    page.dispatch_event(".sk-main", "drop", {"dataTransfer": data})


# in Python


def test_hostile_messages_are_refused_in_a_line(files, tmp_path, capfd):
    check_it_goes_on(Pages(app_of(files, "half.ply", "worm.npz", output=tmp_path / "out")), capfd)


def test_dropped_files_join_the_things_and_take_each_others_place(app, files, tmp_path):
    assert not app.greet()[-1].fields["entries"] and not app.state().fields["pages"]["scans"]
    state = drop(app, files / "half.ply", files / "worm.npz")
    assert [(entry["name"], entry["shown"]) for entry in state["entries"]] == [("half.ply", True), ("worm.npz", True)]
    assert state["pages"]["scans"] == [0] and [one["name"] for one in state["pages"]["models"]][1:] == ["worm.npz"]
    ask(app, "beta", index=0, value=1.5)
    drop(app, files / "half.landmarks.json")                                  # of the same name: they lie on it
    assert [shape.name for shape in app.contents[0].shapes] == ["", "landmarks"]
    write_points(tmp_path / "half.ply", PointCloud(np.eye(3)))
    drop(app, tmp_path / "half.ply")
    assert len(app.entries) == 2 and len(app.contents[0].shapes[0].points) == 3 and app.controls.betas[0] == 1.5
    drop(app, files / "half.landmarks.json")
    (tmp_path / "half.ply").write_text("no mesh")
    scene = app.number
    with pytest.raises(ValueError, match=r"half\.ply"):
        drop(app, tmp_path / "half.ply")
    assert app.number == scene and len(app.contents[0].shapes[0].points) == 3 and app.shown == [0, 1]
    (tmp_path / "worm.npz").write_bytes((files / "worm.npz").read_bytes()[:3000])
    with pytest.raises(ValueError, match=r"^worm\.npz: expected"):
        drop(app, tmp_path / "worm.npz")
    assert [path.name for path in app.files.models] == ["worm.npz"] and app.controls.betas[0] == 1.5
    with pytest.raises(ValueError, match=r"notes\.docx: expected a mesh"):
        (tmp_path / "notes.docx").write_text("hello")
        drop(app, tmp_path / "notes.docx")
    assert app.shown == [0, 1] and not app.problems


def test_landmarks_need_something_to_lie_on(app, files, model, tmp_path):
    with pytest.raises(ValueError, match="name that before them"):
        drop(app, files / "half.landmarks.json")
    write_mesh(tmp_path / "body.ply", model.template)
    drop(app, tmp_path / "body.ply")
    state = drop(app, files / "half.landmarks.json")
    assert len(state["entries"]) == 1 and app.contents[0].shapes[1].name == "half.landmarks.json"


@pytest.mark.slow
def test_a_depth_picture_is_shown_from_its_camera_and_completed(app, files, model, body):
    state = drop(app, files / "one.png")
    assert "drop its camera, one.camera.json" in state["note"] and not state["entries"]
    state = drop(app, files / "one.camera.json", files / "worm.npz")
    assert [entry["name"] for entry in state["entries"]] == ["one.png", "worm.npz"] and not state["note"]
    camera = app.cameras[0]
    assert np.allclose(camera.axes, np.diag([1.0, -1, -1])) and np.allclose(camera.position, 0)      # its own place
    assert camera.distance == pytest.approx(AWAY, abs=0.3)                    # one turns about the body
    page = entered(app, what="complete", scan=0, model=str(app.files.models[0]))
    there = body.vertices - TRANS
    there = there - there.mean(axis=0) + [0, 0, AWAY]
    wanted = dict(zip(NAMES, there[MARKS], strict=True))
    for name, spot in wanted.items():                                         # clicks from where the camera was
        page.handle(Message("place", {"pane": 1, "name": name, "origin": [0, 0, 0], "direction": spot.tolist()}),
                    lambda message: None)
    behind = [np.linalg.norm(wanted[name]) - np.linalg.norm(at) for name, at in page.scan.places.items()]
    assert len(behind) >= 5 and min(behind) > -0.02 and min(np.abs(behind)) < 0.005       # most are on the far side
    page.scan.places = wanted
    page.handle(Message("complete", {}), lambda message: None)
    finished(page)
    done = page.made[page.scan.path]
    moved = done.completion.predicted.vertices - there
    assert np.linalg.norm(moved, axis=1).mean() < 0.03 and len(page._result_pane().shapes) >= 2
    page.handle(Message("save", {}), lambda message: None)
    assert load_completion(page.saved[page.scan.path]).seen.any()


def test_each_completion_is_saved_beside_what_is_there(app, files, tmp_path):
    drop(app, files / "half.ply", files / "half.landmarks.json", files / "worm.npz")
    page = entered(app, what="complete", scan=0, model=str(app.files.models[0]))
    assert set(page.scan.places) <= set(NAMES) and page.scan.file == tmp_path / "out" / "half.landmarks.json"
    (tmp_path / "out" / "half_completed").mkdir(parents=True)
    assert page.folder_of(page.scan) == page.folder_of(page.scan) == tmp_path / "out" / "half_completed_2"
    places = page.scan.places
    assert entered(app, what="complete", scan=0, model=str(app.files.models[0])) is page
    assert page.scan.places is places                                         # as it was left
    drop(app, files / "half.ply")
    entered(app, what="complete", scan=0, model=str(app.files.models[0]))
    assert page.scan.places is not places and len(page.scans) == 1
    for wanted in ({"scan": 1, "model": ""}, {"scan": 0, "model": "none.npz"}):
        with pytest.raises(ValueError, match="expected"):
            entered(app, what="complete", **wanted)


@pytest.mark.slow
def test_a_set_is_mended_from_the_view(place):  # noqa: F811
    app = app_of(place, "set", "scans/body0.ply")
    one, other = app.state().fields["pages"]["folders"], app.entries[-1]
    assert [(page["page"], page["label"]) for page in one] == [("mend", "mend landmarks of set")]
    assert "set/body1" not in [entry.name for entry in app.entries]           # it failed
    before = app.contents[app.shown[0]]
    page = entered(app, what="mend", folder=one[0]["folder"])
    assert page.name == "mend" and page.scans[0].file.name == "body1" + ENDING
    mend(allowed(page), place)
    page.handle(Message("register", {}), lambda message: None)
    wait_for(page)
    app.on_return(page)
    assert app.entries[-1] is other and app.contents[app.shown[0]] is not before
    assert "set/body1" in [entry.name for entry in app.entries]
    assert len(app.entries) == 5 and len(app.shown) == 2 and not app.problems
    with pytest.raises(ValueError, match="that the list of things offers"):
        entered(app, what="mend", folder="/elsewhere")
    app.close()


# in the browser


@pytest.mark.slow
def test_from_an_empty_page_to_a_saved_body_and_back_by_mouse(app, files, body, new_page, tmp_path):
    *_, seen = half_view(body, TOWARD, noise=0.001)
    with Server(Pages(app), say=lambda line: None) as server:
        page = new_page(viewport={"width": 1000, "height": 560})
        page.goto(server.opening())
        wait_until(page, "Boolean(window.program?.entries)")
        assert "drop files anywhere" in page.locator(".sk-empty").inner_text()
        drop_in(page, files / "broken.ply")
        wait_until(page, "program.status.dataset.kind === 'bad'")
        assert page.locator(".sk-status").inner_text().startswith("broken.ply: ")
        drop_in(page, files / "half.ply")
        page.locator("input[type=file]").set_input_files(files / "worm.npz")
        wait_until(page, "program.entries.length === 2 && program.figure?.panes.length === 2")
        assert page.get_by_label("model", exact=True).input_value().endswith("worm.npz")
        page.get_by_role("button", name="complete this scan").click()
        wait_until(page, "program.page.name === 'complete' && program.state?.panes.length === 2 && program.figure")
        inner = server.app.app
        inner.known = True
        clicked_on_the_scan(page, inner, body, seen, TOWARD)
        page.get_by_role("button", name="complete with 4 landmarks").click()
        other = watched(page.context)                                         # tabs and reloads end on the same page
        other.goto(server.address)
        page.reload()
        for tab in (other, page):
            wait_until(tab, "program.page?.back === 'View' && Boolean(program.state?.completed)", 60)
        wait_until(page, "!program.state.working && program.figure?.panes.length === 3")
        page.get_by_label("colour", exact=True).select_option("expected error")
        page.get_by_label("predicted body").check()
        page.evaluate("window.before = program.figure")
        server.send(inner.scene())                                            # as after another completion
        wait_until(page, "program.figure !== before")
        assert page.get_by_label("predicted body").is_checked()               # what was chosen stays
        assert page.get_by_label("colour", exact=True).input_value() == "expected error"
        assert page.locator(".sk-legend").inner_text().split("\n")[0] == "expected error"
        assert "mm" in page.locator(".sk-legend").inner_text()
        page.get_by_role("button", name="save").click()
        wait_until(page, "Boolean(program.state.completed.saved)", 30)
        page.get_by_role("button", name="← View").click()
        for tab in (page, other):
            wait_until(tab, "program.page.name === 'view' && program.entries?.length === 3")
        assert page.evaluate("program.entries.map((one) => [one.name, one.shown])") == [
            ["half.ply", True], ["worm.npz", True], ["half_completed", True]]
        wait_until(page, "program.figure?.panes.length === 3")
        assert not [error for error in page.errors + other.errors if "ERR_CONNECTION" not in error]
    assert max(errors(body, load_completion(tmp_path / "out" / "half_completed"), seen)) < 0.02
    assert len(read_landmarks(tmp_path / "out" / "half.landmarks.json")) == 4
    assert not app.dropped.folder.exists()


@pytest.mark.slow
def test_an_empty_page_fits_a_telephone_and_is_used_by_keyboard(app, files, new_page):
    with Server(Pages(app), say=lambda line: None) as server:
        page = new_page(viewport={"width": 420, "height": 800})
        page.goto(server.opening())
        wait_until(page, "Boolean(window.program?.entries)")
        assert page.evaluate("document.documentElement.scrollWidth") <= 420
        page.evaluate("document.querySelector('[type=file]').onclick = () => { window.asked = true; return false; }")
        page.locator(".sk-drop").focus()
        page.keyboard.press("Enter")
        wait_until(page, "window.asked")
        page.locator("input[type=file]").set_input_files([files / "one.camera.json", files / "one.png"])
        wait_until(page, "program.entries.length === 1 && program.figure?.panes[0].drawn > 0")
        page.locator("canvas").focus()
        before = page.evaluate("program.figure.panes[0].camera.position.toArray()")
        page.keyboard.press("ArrowRight")
        wait_until(page, f"String(program.figure.panes[0].camera.position.toArray()) !== {json.dumps(before)}.join()")
        assert page.evaluate("document.documentElement.scrollWidth") <= 420
