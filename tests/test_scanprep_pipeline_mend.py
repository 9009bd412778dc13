"""`scape pick SET`: scans worst first, landmarks mended, registered again; the others' files stay as they are."""
import shutil
import time

import pytest
from browser import opened, take_away, wait_until
from click_app import allowed
from scan_folders import MARKS, QUICK, ball, contents, write_scans

from scanprep import RegisteredSet, read_mesh, write_landmarks, write_mesh
from scanprep.batch.calls import RUN
from scanprep.batch.opening import workspace
from scanprep.geometry.landmark_names import TEN
from scanprep.geometry.landmarks import read_landmarks
from scanprep.geometry.storage import StorageError
from scanprep.pipeline.again import Call
from scanprep.pipeline.cli import carry_out
from scanprep.pipeline.mend import MendApp
from scanprep.viewer import pick
from scanprep.viewer.clicked import Clicked
from scanprep.viewer.messages import Message

ENDING, WRONG = ".landmarks.json", {"top": "front", "front": "top"}        # whose places are exchanged


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A set of three scans; two landmarks of body1 are exchanged. The folder, and a copy that stays as it is."""
    place = tmp_path_factory.mktemp("mend") / "place"
    template = ball()
    write_mesh(place / "template.ply", template)
    write_landmarks(place / "template.landmarks.json", MARKS)
    scans = write_scans(place / "scans", template)
    file = scans / "body1.landmarks.json"
    marks = read_landmarks(file)
    write_landmarks(file, {name: marks[WRONG.get(name, name)] for name in marks})
    call = Call(scans, place / "template.ply", config=QUICK)
    with workspace(place / "set") as space:
        carry_out(call, call.inputs(lambda line: None), space)
    return place, shutil.copytree(place, place.with_name("kept"))


@pytest.fixture
def place(made):
    """That folder as it was, under the name that the set keeps."""
    place, kept = made
    shutil.rmtree(place)
    return shutil.copytree(kept, place)


def sent(app, kind, **fields):
    told = []
    app.handle(Message(kind, fields), told.append)
    return told


def wait(app, seconds=60):
    end = time.monotonic() + seconds
    while app.working is not None:
        assert time.monotonic() < end
        time.sleep(0.02)


def true_place(place, name):
    """Where a landmark of body1 is, and the way outward there."""
    body = read_mesh(place / "scans" / "body1.ply")
    return body.vertices[MARKS[name]], body.vertex_normals[MARKS[name]]


def mend(app, place):
    for name in WRONG:
        spot, out = true_place(place, name)
        sent(app, "place", pane=1, name=name, origin=(spot + 0.5 * out).tolist(), direction=(-out).tolist())


def test_what_a_set_was_made_with_is_read_back(place):
    call = Call.read(place / "set")
    assert call == Call(place / "scans", place / "template.ply", config=QUICK)
    RegisteredSet.load(place / "set")                      # the set itself is as it was
    (place / "set" / RUN).write_text('{"kind": "call of scape prep run", "version": 2}')
    with pytest.raises(StorageError, match=r"run\.json"):
        Call.read(place / "set")
    (place / "set" / RUN).unlink()
    with pytest.raises(StorageError, match="run the same command once more"):
        MendApp(place / "set", ENDING)


def test_exchanged_landmarks_are_mended_and_only_that_scan_is_registered(place):
    app = allowed(MendApp(place / "set", ENDING))
    state = app.greet()[-1].fields
    assert state["scans"][0]["name"] == "body1.ply"                                      # worst first
    assert [v["verdict"] for v in state["verdicts"]][1:] == ["good", "good"]
    assert state["verdicts"][0]["verdict"] in ("check", "failed") and state["verdicts"][0]["reasons"]
    before, page = contents(place), (place / "set" / "report.html").read_bytes()
    mend(app, place)
    assert app.greet()[-1].fields["changed"] == ["body1"]
    sent(app, "register")
    wait(app)
    state = app.greet()[-1].fields
    assert "1 of 3 scans registered again" in state["note"] and not state["changed"]
    assert state["verdicts"][0] == {"verdict": "good", "reasons": []} and state["scans"][0]["name"] == "body1.ply"
    after = contents(place)
    changed = {name for name in after if after[name] != before.get(name)}
    assert {name for name in changed if not name.startswith("set/")} == {
        "scans/body1.landmarks.json", "scans/body1.landmarks.json.before"}
    assert {name for name in changed if "body" in name and name.startswith("set/")} <= {
        "set/meshes/body1.ply", "set/pictures/body1.webp", "set/pictures/body1.scene"}
    assert after["scans/body1.landmarks.json.before"] == before["scans/body1.landmarks.json"]
    assert (place / "set" / "report.html").read_bytes() != page
    scene = app.scene()
    assert len(scene.data) - scene.fields["first"] == len(after["set/pictures/body1.scene"])
    call = Call.read(place / "set")                             # and the command itself has nothing left to do
    with workspace(place / "set") as space:
        done = carry_out(call, call.inputs(lambda line: None), space)
    assert {m.name: m.value for m in done.metrics}["of them in this run"] == 0


def test_only_what_has_changed_is_registered_again(place):
    """Also what was changed before the page was opened; a click that was taken back is no change."""
    app = allowed(MendApp(place / "set", ENDING))
    state = app.greet()[-1].fields
    assert state["changed"] == [] and not state["template_changed"] and not state["outdated"]
    with pytest.raises(ValueError, match="nothing has changed"):
        sent(app, "register")
    sent(app, "remove", pane=1, name="top")
    assert app.greet()[-1].fields["changed"] == ["body1"] and app.greet()[-1].fields["outdated"]
    sent(app, "undo")
    assert app.greet()[-1].fields["changed"] == []
    sent(app, "open", scan=1)
    sent(app, "remove", pane=1, name="top")
    write_mesh(place / "scans" / "body9.ply", ball())
    again = allowed(MendApp(place / "set", ENDING)).greet()[-1].fields
    assert again["changed"] == [app.scan_names[1], "body9"] and not again["outdated"]
    sent(app, "remove", pane=0, name="top")
    assert app.greet()[-1].fields["template_changed"]


def test_where_nobody_named_a_landmark_those_of_people_are_offered(place):
    """A set that was made without any: the landmarks of template and scans are clicked one after the other."""
    for path in place.rglob("*landmarks.json"):
        path.write_text("{}")
    app = allowed(MendApp(place / "set", ENDING))
    assert app.names == TEN and app.building and app.chosen == TEN[0]
    assert pick.PickApp(Clicked.load(place / "set" / "template.ply", ENDING), [], TEN).names == TEN


def test_new_landmark_files_lie_where_the_run_reads_them(place):
    (place / "scans" / "body2.landmarks.json").unlink()
    app = allowed(MendApp(place / "set", ".pp"))
    scan = app.scans[app.scan_names.index("body2")]
    assert scan.file == place / "scans" / "body2.pp" and not scan.places
    app.call = Call(app.call.scans, app.call.template, place / "marks", config=app.call.config)
    task = next(task for task in Call.read(place / "set").tasks() if task.name == "body2")
    assert app._load_clicked(task, ".pp").file == place / "marks" / "body2.pp"


@pytest.mark.slow
def test_a_set_is_mended_in_the_browser(new_page, place):
    """The wrong landmarks are taken away by key, the scan is registered again by a button: all is new."""
    app = allowed(MendApp(place / "set", ENDING))
    with opened(new_page, app) as page:
        assert page.locator(".sk-verdict").get_attribute("data-verdict") in ("check", "failed")
        again = page.locator("button", has_text="register again")
        assert again.is_disabled()
        take_away(page, WRONG)
        assert "changed since" in page.locator(".sk-verdict strong").inner_text()
        again.click()
        wait_until(page, "program.state.verdicts[0].verdict === 'good' && !program.state.working", 60)
        wait_until(page, "program.figure.panes.length === 3 && program.figure.panes.every((pane) => pane.drawn > 1)")
        assert page.locator(".sk-verdict strong").inner_text() == "good" and again.is_disabled()
        shades = page.evaluate("program.figure.panes[2].layers[0].described.shades.length")
        assert shades == 3                             # distance, confidence, plain
    assert set(read_landmarks(place / "scans" / "body1.landmarks.json")) == set(MARKS) - set(WRONG)
