"""Landmarks clicked in the browser: exact places, names, undo, files of every format, and the page in Chromium."""
import json
import time

import numpy as np
import pytest
from browser import opened, wait_until
from hostile_messages import check_it_goes_on

from scanprep.geometry import rotations
from scanprep.geometry.files import write_mesh
from scanprep.geometry.landmarks import read_landmarks, write_landmarks
from scanprep.geometry.mesh import Mesh
from scanprep.pictures.shading import sphere
from scanprep.synthetic.landmarks import landmarks
from scanprep.synthetic.people import SyntheticPerson
from scanprep.viewer.clicked import Clicked, camera_like, camera_of, predict_landmarks
from scanprep.viewer.landmark_names import TEN, read_names
from scanprep.viewer.messages import Message
from scanprep.viewer.pick import PickApp
from scanprep.viewer.surface_clicks import Clickable

FOUR = ("left middle finger", "right middle finger", "left toe", "right toe")

ON_PAGE = """(place) => {
    const pane = program.figure.panes[1], box = pane.canvas.getBoundingClientRect();
    const at = pane.project(pane.origin.clone().fromArray(place).sub(pane.origin));
    return [box.left + at.x, box.top + at.y];
}"""


def on_page(page, place):
    """Where a place on the scan is on the page, pixels."""
    return page.evaluate(ON_PAGE, np.asarray(place).tolist())


@pytest.fixture(scope="module")
def person():
    return SyntheticPerson()


@pytest.fixture
def folder(person, tmp_path):
    """A template with landmarks, and a scan of it that is turned and moved."""
    write_mesh(tmp_path / "template.ply", person.mesh)
    some = {name: landmarks()[name] for name in (*FOUR, "navel", "chin")}
    write_landmarks(tmp_path / "template.landmarks.json", some)
    write_mesh(tmp_path / "anna.ply", person.mesh.with_vertices(moved(person.mesh.vertices)))
    return tmp_path


def moved(points):
    return points @ rotations.exp(np.array([0, 0, 0.4])).T + [5.0, -2.0, 0.3]


def app_of(folder, names=TEN, ending=".landmarks.json", scans=("anna.ply",)):
    return PickApp(Clicked.load(folder / "template.ply", ending),
                   [Clicked.load(folder / name, ending) for name in scans], names)


def sent(app, kind, **fields):
    """What a message makes the app tell the page."""
    told = []
    app.handle(Message(kind, fields), told.append)
    return told


def click(app, place, name, pane=1, normal=(0.0, 0.0, 1.0), **more):
    origin = np.asarray(place) + 2 * np.asarray(normal)
    return sent(app, "place", pane=pane, name=name, origin=origin.tolist(), direction=(-np.asarray(normal)).tolist(),
                **more)


def test_a_ray_meets_400_000_triangles_exactly():
    vertices, faces = sphere(7)
    assert len(faces) > 300_000
    body, rng = Clickable(Mesh(1000 + 0.9 * vertices, faces)), np.random.default_rng(0)
    for _ in range(20):
        toward = rng.normal(size=3)
        aim = 1000 + 0.5 * rng.uniform(-1, 1, 3)
        found = body.hit(aim + 5 * toward, -toward)
        direction = toward / np.linalg.norm(toward)
        along = (found - aim) @ direction
        np.testing.assert_allclose(found, aim + along * direction, atol=1e-9)         # on the ray
        corners = body.shape.corners
        near = np.flatnonzero(np.linalg.norm(corners.mean(axis=1) - found, axis=1) < 0.02)
        normals = np.cross(corners[near, 1] - corners[near, 0], corners[near, 2] - corners[near, 0])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        off = np.abs(np.einsum("nd,nd->n", found - corners[near, 0], normals)).min()
        assert off < 1e-6                                                              # and on a triangle


def test_clouds_are_clicked_point_by_point_and_the_nearest_one_wins():
    points = np.random.default_rng(0).normal(size=(5000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    found = Clickable(points).hit(np.array([0.0, 0, 5]), np.array([0.0, 0, -1]))
    assert found[2] > 0.9 and (found == points).all(axis=1).any()
    assert Clickable(points).hit(np.array([3.0, 0, 5]), np.array([0.0, 0, -1])) is None


def test_lists_of_names_come_from_a_file(tmp_path):
    (tmp_path / "names.txt").write_text("# mine\nnose\n\n  left   ear \nnose\n")
    assert read_names(str(tmp_path / "names.txt")) == ("nose", "left ear")
    (tmp_path / "none.txt").write_text("# nothing\n")
    for wrong, told in ((tmp_path / "none.txt", "none.txt"), (tmp_path / "missing", "--names")):
        with pytest.raises(ValueError, match=told):
            read_names(str(wrong))


@pytest.mark.parametrize("ending", [".landmarks.json", ".landmarks.csv", ".pp", ".mrk.json"])
def test_every_click_is_saved_in_the_format_wanted(folder, person, ending):
    app, file = app_of(folder, ending=ending), None
    for name in FOUR[:2]:
        place = moved(person.mesh.vertices[landmarks()[name]])
        click(app, place, name, seen=place.tolist())
        file = app.scans[0].file
        found = read_landmarks(file)
        np.testing.assert_allclose(found[name], app.scans[0].places[name], atol=1e-6)
    assert set(found) == set(FOUR[:2]) and file.name.endswith(ending)
    again = app_of(folder)                                             # opened again, it goes on where it was
    assert again.scans[0].file == file and set(again.scans[0].places) == set(FOUR[:2])


def test_a_file_of_the_user_is_kept_as_it_was(folder, person):
    mine = folder / "anna.pp"
    write_landmarks(mine, {"my own": np.array([5.0, -2.0, 1.0])})
    before = mine.read_bytes()
    app = app_of(folder)
    for name in FOUR[:2]:
        click(app, moved(person.mesh.vertices[landmarks()[name]]), name)
    assert (folder / ("anna.pp.before")).read_bytes() == before
    assert set(read_landmarks(mine)) >= {"my own"}


def test_what_was_taken_back_leaves_no_file_behind(folder, person):
    """A file without landmarks could not be read again, and one of our own needs no copy."""
    app = app_of(folder)
    place = moved(person.mesh.vertices[landmarks()["top of head"]])
    for name in "ab":
        click(app, place, name)
    for _ in "ab":
        sent(app, "undo")
    assert not list(folder.glob("anna.l*"))
    assert app_of(folder).scans[0].places == {}
    sent(app, "redo")
    assert set(read_landmarks(app.scans[0].file)) == {"a"} and not list(folder.glob("*.before"))


@pytest.mark.parametrize("ending", [".landmarks.json", ".pp", ".mrk.json"])
@pytest.mark.parametrize("unit", [None, "m", "cm"])
def test_a_unit_that_was_told_is_that_of_the_file(folder, person, ending, unit):
    factor = 100 if unit == "cm" else 1
    write_mesh(folder / "ben.ply", person.mesh.with_vertices(factor * person.mesh.vertices))
    place = person.mesh.vertices[landmarks()["top of head"]]
    ben = Clicked.load(folder / "ben.ply", ending, unit)
    app = PickApp(Clicked.load(folder / "template.ply", ending), [ben], TEN)
    click(app, place, "top of head")
    np.testing.assert_allclose(read_landmarks(ben.file, None, unit)["top of head"][2], place[2], atol=1e-3)


def test_work_that_fails_does_not_leave_the_page_waiting(folder, capsys):
    app, told = app_of(folder), []

    def work(tell):
        tell(1, 2)
        raise KeyError("nobody foresaw")

    app.beside("working", work, told.append, "it could not be done")
    end = time.monotonic() + 5
    while app.working is not None or len(told) < 2:
        assert time.monotonic() < end
    assert told[0].fields["working"] == ("working", 1, 2) and told[-1].fields["working"] is None
    assert "it could not be done: unexpected KeyError" in told[-1].fields["note"]
    assert "Traceback" in capsys.readouterr().err


def test_undo_and_redo_walk_through_all_changes_and_survive_a_reload(folder, person):
    app = app_of(folder)
    top = moved(person.mesh.vertices[landmarks()["top of head"]])
    click(app, top, "a")
    click(app, top + [0.01, 0, 0], "b")
    first = dict(app.scans[0].places)
    for x in (0.02, 0.03):
        click(app, top + [x, 0, 0], "b", drag=7)                 # a drag is one change, however long
    dragged = dict(app.scans[0].places)
    assert not np.allclose(first["b"], dragged["b"])
    sent(app, "undo")
    np.testing.assert_array_equal(app.scans[0].places["b"], first["b"])
    sent(app, "undo")
    assert sorted(read_landmarks(app.scans[0].file)) == ["a"] == sorted(app.scans[0].places)
    state = app.greet()[-1].fields
    assert state["redo"] and list(state["panes"][1]["places"]) == ["a"]
    sent(app, "redo")
    sent(app, "redo")
    np.testing.assert_array_equal(app.scans[0].places["b"], dragged["b"])
    sent(app, "remove", pane=1, name="a")
    sent(app, "undo")
    assert set(app.scans[0].places) == {"a", "b"}


def test_left_and_right_are_swapped_and_back(folder):
    app = app_of(folder)
    with pytest.raises(ValueError, match="names a side"):
        sent(app, "swap")
    app.scans[0].places = {"navel": np.zeros(3)}
    assert not app.greet()[-1].fields["can_swap"]
    app.scans[0].places = {"left toe": np.array([1.0, 0, 0]), "right toe": np.array([-1.0, 0, 0]),
                           "left knee": np.array([1.0, 0, 1]), "navel": np.zeros(3)}
    before = dict(app.scans[0].places)
    app.scans[0].predicted = {"left heel": np.array([1.0, 0, 0]), "nose tip": np.ones(3)}
    assert app.greet()[-1].fields["can_swap"]
    sent(app, "swap")
    after = app.scans[0].places
    assert set(app.scans[0].predicted) == {"right heel", "nose tip"}
    assert set(after) == {"left toe", "right toe", "right knee", "navel"} and after["left toe"][0] == -1
    assert after["right knee"] is before["left knee"] and set(read_landmarks(app.scans[0].file)) == set(after)
    sent(app, "undo")
    assert app.scans[0].places == before


def test_one_crossed_pair_is_exchanged_by_itself(folder):
    app = app_of(folder)
    places = {"left toe": np.array([1.0, 0, 0]), "left knee": np.array([-1.0, 0, 1]), "navel": np.zeros(3),
              "right toe": np.array([-1.0, 0, 0]), "right knee": np.array([1.0, 0, 1])}
    app.scans[0].places = dict(places)
    assert sent(app, "choose", name="navel")[-1].fields["pair"] is None
    assert sent(app, "choose", name="right knee")[-1].fields["pair"] == "left knee"
    sent(app, "swap", name="right knee")
    exchanged = {**places, "left knee": places["right knee"], "right knee": places["left knee"]}
    assert app.scans[0].places == exchanged
    sent(app, "undo")
    assert app.scans[0].places == places


def test_landmarks_are_predicted_only_where_some_are_missing(folder):
    app = app_of(folder)
    known = read_landmarks(folder / "template.landmarks.json", app.template.body.shape)
    places = {name: moved(point) for name, point in known.items()}
    for count, possible in ((3, False), (4, True), (len(places) - 1, True), (len(places), False)):
        app.scans[0].places = dict(list(places.items())[:count])
        assert app.greet()[-1].fields["can_predict"] is possible, count
    with pytest.raises(ValueError, match="then the others can be predicted"):
        sent(app, "predict")
    app.scans[0].places.pop("navel")
    app.template = Clicked(folder / "template.ply", app.template.file, places=known,
                           surface=Clickable(app.template.body.points))
    assert app.greet()[-1].fields["can_predict"] is False              # a cloud is no template that can be registered


def test_a_click_that_meets_nothing_is_told_and_wrong_messages_are_refused(folder):
    app = app_of(folder)
    assert "met nothing" in click(app, [50.0, 0, 0], "a")[-1].fields["note"] and not app.scans[0].places
    ray = {"origin": [0, 0, 0], "direction": [0, 0, 1]}
    for kind, fields in (("nonsense", {}), ("open", {"scan": 7}), ("place", {"pane": 3, "name": "a", **ray}),
                         ("place", {"pane": 1, "name": "a", **ray, "origin": [0, None, 0]}), ("choose", {"name": " "})):
        with pytest.raises((ValueError, TypeError)):
            sent(app, kind, **fields)


@pytest.mark.slow
def test_the_others_are_predicted_from_four(person):
    """Registration of a body to itself, moved and turned: within a centimetre, mostly."""
    template = {name: person.mesh.vertices[vertex] for name, vertex in landmarks().items()}
    scan = Clickable(person.mesh.with_vertices(moved(person.mesh.vertices)))
    found = predict_landmarks(person.mesh, template, scan, {name: moved(template[name]) for name in FOUR})
    off = [np.linalg.norm(found[name] - moved(template[name])) for name in template]
    assert np.median(off) < 0.003 and max(off) < 0.02


def test_landmarks_are_picked_by_mouse_and_saved(new_page, folder, person):
    """Four clicks at the true places, on a body 5 m off the origin; then undo by key, and a reload."""
    app = app_of(folder)
    app._predict_if_time = lambda send, pane: None                     # tested above
    with opened(new_page, app) as page:
        for name in FOUR:
            page.locator(".sk-names li").filter(has_text=name).first.click()
            wait_until(page, f"program.state.chosen === {json.dumps(name)}")
            place = moved(person.mesh.vertices[landmarks()[name]])
            page.mouse.click(*on_page(page, place))
            wait_until(page, f"{json.dumps(name)} in program.state.panes[1].places || program.state.note")
        found = read_landmarks(folder / "anna.landmarks.json")
        off = {name: np.linalg.norm(found[name] - moved(person.mesh.vertices[landmarks()[name]])) for name in found}
        assert len(off) == 4 and max(off.values()) < 0.02, off                        # a pixel is 2.5 mm
        page.keyboard.press("z")
        wait_until(page, "Object.keys(program.state.panes[1].places).length === 3")
        page.reload()
        wait_until(page, "Boolean(window.program?.state) && Object.keys(program.state.panes[1].places).length === 3")
        page.locator("button", has_text="redo").click()
        wait_until(page, "Object.keys(program.state.panes[1].places).length === 4")
    assert set(read_landmarks(folder / "anna.landmarks.json")) == set(FOUR)


@pytest.mark.slow
def test_a_landmark_is_dragged(new_page, folder, person):
    app, end = app_of(folder), time.monotonic() + 20
    app._predict_if_time = lambda send, pane: None
    place = moved(person.mesh.vertices[landmarks()["navel"]])
    ahead = moved(person.mesh.vertices[landmarks()["navel"]] + person.mesh.vertex_normals[landmarks()["navel"]]) - place
    click(app, place, "navel", normal=ahead)
    before = app.scans[0].places["navel"].copy()
    with opened(new_page, app) as page:
        x, y = on_page(page, before)
        page.mouse.move(x, y)
        page.mouse.down()
        page.mouse.move(x, y - 15, steps=4)
        page.mouse.move(x, y - 30, steps=4)
        page.mouse.up()
        while np.allclose(app.scans[0].places["navel"], before, atol=0.03) and time.monotonic() < end:
            page.wait_for_timeout(50)
    shift = app.scans[0].places["navel"] - before
    assert 0.03 < shift[2] < 0.2 and len(app.done) == 2                # up, and the drag is one change


def click_at(app, person, pane, at, name=None):
    """A click on a landmark of the template or the scan, from where it is seen; what the page is told."""
    v = landmarks()[at]
    ends = person.mesh.vertices[v] + [[0, 0, 0], 0.02 * person.mesh.vertex_normals[v]]
    place, beyond = moved(ends) if pane else ends
    return click(app, place, name or app.chosen, pane, (beyond - place) / 0.02)[-1].fields


def clicked(app, person, *clicks):
    """Clicks on (pane, name) as the page sends them, with the name that is chosen; what the app then offers."""
    offered = []
    for pane, at in clicks:
        click_at(app, person, pane, at)
        offered.append((app.chosen, app.alternating))
    return offered


def test_left_right_left_right_as_in_wrap_and_meshlab(folder, person):
    """A click on the other pane takes the same name; the next name comes when both have it."""
    (folder / "template.landmarks.json").unlink()
    app = app_of(folder)
    crown, navel, left = TEN[:3]
    assert app.chosen == crown
    assert clicked(app, person, (0, crown), (1, crown), (0, navel), (1, navel)) == [
        (crown, 0), (navel, None), (navel, 0), (left, None)]
    assert clicked(app, person, (1, left), (0, left))[-1][0] == TEN[3]         # also the scan first
    assert set(app.template.places) == set(app.scans[0].places) == {crown, navel, left}


def test_names_that_a_file_has_under_other_words_are_not_offered_twice(folder):
    write_landmarks(folder / "template.landmarks.json", {"crown": 1, "LeftHand": 2, "knee in right leg": 3})
    app = app_of(folder)
    assert app.names[:3] == ("crown", "LeftHand", "knee in right leg") and len(app.names) == 10


def test_a_click_far_from_the_prediction_is_questioned(folder, person):
    app = app_of(folder)
    true = {name: moved(person.mesh.vertices[landmarks()[name]]) for name in ("navel", "chin", *FOUR)}
    app.scans[0].predicted = dict(true)
    near = click_at(app, person, 1, "navel", "navel")
    assert near["question"] is None and near["chosen"] != "navel"
    far = click_at(app, person, 1, "chin", "left toe")
    away = np.linalg.norm(app.scans[0].places["left toe"] - true["left toe"])
    assert far["question"]["text"] == f"This is {100 * away:.0f} cm from where “left toe” was expected: keep it?"
    assert far["chosen"] == "left toe" and away > 1
    moved_there = sent(app, "confirm", names=["left toe"])[-1].fields
    assert moved_there["question"] is None
    np.testing.assert_allclose(app.scans[0].places["left toe"], true["left toe"])
    click_at(app, person, 1, "chin", "right toe")
    kept = sent(app, "keep", name="right toe")[-1].fields
    assert kept["question"] is None and kept["chosen"] != "right toe"
    assert np.linalg.norm(app.scans[0].places["right toe"] - true["right toe"]) > 1


@pytest.mark.parametrize("azimuth", [90, 215])
def test_the_scan_is_shown_from_the_side_of_the_template(person, azimuth):
    """A body that is turned by any angle: both panes show it from the front, also where its outline does not tell."""
    R = rotations.exp(np.radians([0.0, 0.0, azimuth]))
    first = camera_of(person.mesh)
    cut = person.mesh.submesh(person.mesh.corners.mean(axis=1)[:, 2] > 0.25)[0]           # without feet, which tell
    body = cut.with_vertices(cut.vertices @ R.T + 3)
    marks = person.mesh.vertices[[landmarks()[name] for name in FOUR]]
    assert camera_like(first, body, (marks, marks @ R.T + 3)).axes[2] @ R @ first.axes[2] > np.cos(np.radians(20))


@pytest.mark.parametrize("azimuth", [0, 215])
@pytest.mark.parametrize("kind", ["mesh", "cloud", "noisy cloud"])
def test_a_one_sided_scan_is_seen_from_outside(person, azimuth, kind):
    """Not in a mirror: from where its camera was, and with a template from at most 60 degrees beside it."""
    toward = np.array([np.sin(np.radians(azimuth)), -np.cos(np.radians(azimuth)), 0])
    half = person.mesh.submesh(person.mesh.face_normals @ toward > 0.15)[0]
    noise = np.random.default_rng(0).normal(0, 0.005 * (kind == "noisy cloud"), half.vertices.shape)
    body = half if kind == "mesh" else half.vertices + noise
    assert camera_of(body).axes[2] @ toward > np.cos(np.radians(30))
    first, marks = camera_of(person.mesh), person.mesh.vertices[[landmarks()[name] for name in FOUR]]
    for known in (None, (marks, marks)):
        assert camera_like(first, body, known).axes[2] @ toward > np.cos(np.radians(75))


def test_hostile_messages_are_refused_in_a_line(folder, capfd):
    check_it_goes_on(app_of(folder), capfd)
