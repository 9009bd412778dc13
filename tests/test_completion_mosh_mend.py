"""A result of `scape mosh` that is mended: markers moved, exchanged or taken away, saved as a layout, run again."""
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from browser import DRAWN, opened, wait_until
from click_app import allowed
from completion_bodies import worm_with_prior
from hostile_messages import check_it_goes_on
from mosh_folders import QuietWork, run, small_pictures, write_people

from completion import MarkerLayout, MarkerSequence, read_markers, write_markers
from completion.__main__ import main
from completion.mocap.mosh import cli
from completion.mocap.mosh.call import MoshCall
from completion.mocap.mosh.mend import MoshApp
from completion.mocap.mosh.mended_layout import changes
from scanprep.batch.calls import RUN
from scanprep.batch.ownership import HOME
from scanprep.geometry.storage import StorageError
from scanprep.viewer.messages import Message

MOVED, EXCHANGED = "M12", ["M2", "M20"]


@pytest.fixture(scope="module", autouse=True)
def nobody_looks():
    with small_pictures(), pytest.MonkeyPatch.context() as patch:
        patch.setattr(cli, "MoshTask", QuietWork)
        yield


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A walk with two labels exchanged, by a layout that has a third elsewhere: without any repair it fails."""
    place = write_people(tmp_path_factory.mktemp("mosh"))
    shutil.copy(place / "layout.json", place / "true.json")
    layout = MarkerLayout.load(place / "true.json")
    body = worm_with_prior().template.vertices
    far = np.linalg.norm(body - body[layout.vertices[layout.labels.index(MOVED)]], axis=1)
    layout.with_places({MOVED: int(np.abs(far - 0.3).argmin())}).save(place / "layout.json")
    walk = read_markers(place / "people" / "ann" / "walk.csv")
    names = dict(zip(EXCHANGED, EXCHANGED[::-1], strict=True))
    write_markers(place / "walk.csv", MarkerSequence(
        walk.positions, tuple(names.get(label, label) for label in walk.labels), walk.rate))
    assert run(place, place / "walk.csv", "-o", place / "out", repair=False, soft_tissue=False) == 1
    return place


def sent(app, kind, **fields):
    app.handle(Message(kind, fields), lambda message: None)


def told(app):
    return app.greet()[-1].fields


def true_spot(place, app):
    """Where the moved marker truly sits on the person, and the way outward there."""
    layout = MarkerLayout.load(place / "true.json")
    vertex, body = layout.vertices[layout.labels.index(MOVED)], app.person.body
    return body.vertices[vertex], body.vertex_normals[vertex]


def moved(place, app):
    spot, out = true_spot(place, app)
    sent(app, "place", pane=1, name=MOVED, origin=(spot + 0.3 * out).tolist(), direction=(-out).tolist())
    np.testing.assert_allclose(app.scan.places[MOVED], spot, atol=1e-6)


def test_corrections_are_saved_beside_and_undone(place):
    app, given = allowed(MoshApp(place / "out")), (place / "layout.json").read_bytes()
    state, file = told(app), place / "out" / "corrected_layout_1.json"
    assert state["scans"] == [{"name": "walk", "count": 34}] and not state["changed"]
    assert set(app.names[:3]) == {MOVED, *EXCHANGED} and state["verdicts"][0]["verdict"] == "failed"     # worst first
    assert state["doubts"] == {label: ["walk: hardly believed"] for label in (MOVED, *EXCHANGED)}
    assert state["frames"][0].startswith("walk, ") and len(app.scene().data) > 1000
    with pytest.raises(ValueError, match="nothing was corrected"):
        sent(app, "run")
    with pytest.raises(ValueError, match="click on the person"):
        sent(app, "place", pane=0, name=MOVED, origin=[0, 0, 9], direction=[0, 0, -1])
    sent(app, "exchange", name=EXCHANGED[0], other=EXCHANGED[1])
    moved(place, app)
    sent(app, "remove", pane=1, name="M5")
    saved, usual = MarkerLayout.load(file), MarkerLayout.load(place / "layout.json")
    assert set(usual.labels) - set(saved.labels) == {"M5"}
    assert saved.nearest[saved.labels.index("M2")] == usual.vertices[usual.labels.index("M20")]
    assert set(changes(usual, saved)) == {MOVED, *EXCHANGED, "M5"} == set(told(app)["changed"])
    again = allowed(MoshApp(place / "out"))                                                     # another session
    assert set(told(again)["changed"]) == set(told(app)["changed"]) and "M5" not in again.scan.places
    for label, spot in again.scan.places.items():
        np.testing.assert_allclose(spot, app.scan.places[label], atol=1e-9)
    for _ in range(3):
        sent(app, "undo")
    assert not told(app)["changed"] and not file.exists() and set(app.scan.places) == set(usual.labels)
    sent(app, "redo")
    assert set(told(app)["changed"]) == set(EXCHANGED) and file.exists()
    sent(app, "undo")
    assert (place / "layout.json").read_bytes() == given


def test_a_correction_is_of_the_layout_and_so_of_all_people(place, tmp_path):
    assert run(place, place / "people", "-o", tmp_path / "out", repair=False, soft_tissue=False) in (0, 1)
    app = allowed(MoshApp(tmp_path / "out"))
    assert {one["name"] for one in told(app)["scans"]} == {"ann", "bob"}
    assert len({frame.split(",")[0] for frame in told(app)["frames"]}) == (2 if app.person.name == "ann" else 1)
    first, found = app.person, [dict(scan.places) for scan in app.scans]
    moved(place, app)
    sent(app, "open", scan=1)
    assert app.person is not first and told(app)["changed"] == [MOVED] and app.chosen == app.names[0]
    np.testing.assert_allclose(app.scan.places[MOVED], true_spot(place, app)[0], atol=1e-6)       # on another body
    sent(app, "undo")
    assert app.person is first and [set(scan.places) for scan in app.scans] == [set(places) for places in found]
    assert all(np.array_equal(scan.places[MOVED], places[MOVED])
               for scan, places in zip(app.scans, found, strict=True))
    with pytest.raises(ValueError, match="expected 0 to 1, got 2"):
        sent(app, "open", scan=2)


def test_a_result_that_was_moved_or_made_earlier_is_told(place, tmp_path):
    shutil.copytree(place / "out", tmp_path / "out")
    call = MoshCall.read(tmp_path / "out")
    assert call.layout == str(place / "layout.json") and call.markers == (place / "walk.csv",)
    assert not call.config.repair
    for other, message in ((replace(call, markers=(tmp_path / "gone.c3d",)), r"gone\.c3d: no such file"),
                           (replace(call, model=(tmp_path / "gone.npz",)), r"gone\.npz: no such file"),
                           (replace(call, layout=str(tmp_path / "gone.json")), r"gone\.json")):
        other.write(tmp_path / "out")
        with pytest.raises(ValueError, match=message):
            MoshApp(tmp_path / "out")
    (tmp_path / "out" / RUN).unlink()
    (tmp_path / "out" / HOME / RUN).unlink()
    with pytest.raises(StorageError, match="run the same command once more"):
        MoshApp(tmp_path / "out")


@pytest.mark.slow
def test_a_result_is_mended_in_the_browser_and_run_again(place, new_page):
    """Two labels are exchanged by the mouse, a marker moved; the button runs again, and all markers are believed."""
    app = allowed(MoshApp(place / "out"))
    with opened(new_page, app, width=1300) as page:
        assert page.get_by_role("button", name="run again").is_disabled()
        assert "hardly believed" in page.locator(".sk-doubts").inner_text()               # the worst is chosen
        page.locator(".sk-names li").filter(has_text="M20").first.click()
        wait_until(page, "program.state.chosen === 'M20'")
        page.get_by_label("marker to exchange with").select_option("M2")
        page.get_by_role("button", name="exchange with").click()
        wait_until(page, "program.state.changed.length === 2")
        moved(place, app)
        page.reload()
        wait_until(page, DRAWN)
        page.get_by_role("button", name="run again with 3 corrected").click()
        wait_until(page, "program.state.working === null && program.state.rows[0][1] !== ''", 60)
        wait_until(page, "program.figure.panes.length === 3 && program.figure.panes.every((pane) => pane.drawn > 1)")
        assert page.locator(".sk-before th").all_inner_texts() == ["", "before", "now"]
        assert page.locator(".sk-verdict").get_attribute("data-verdict") == "good"
    rows = {name: (before, now) for name, before, now, _ in told(app)["rows"]}
    before, now = map(float, rows["distance of all markers, mean"])
    assert before > 30 and now < 5 and float(rows["distance of the worst marker"][1]) < 10
    assert [text.split(",")[0] for text in rows["markers in the mean distance"]] == ["31 of 34", "34 of 34"]
    off = {label: app.person.off[label] for label in (MOVED, *EXCHANGED)}
    assert max(off.values()) < 0.02 and not app.person.doubts
    true = true_spot(place, app)[0]
    assert np.linalg.norm(app.person.places[MOVED] - true) < 0.06
    call = MoshCall.read(place / "out")
    assert call.layout == str(place / "out" / "corrected_layout_1.json") and told(app)["corrected"].endswith("_2.json")
    written = json.loads((place / "out" / "report.json").read_text())
    assert written["settings"]["layout"] == call.layout and not written["failures"]
    assert "scape view" in (place / "out" / "report.html").read_text()


def test_a_built_in_model_is_kept_by_its_name(tmp_path, monkeypatch):
    """The call of `scape mosh walk.c3d -m people`, mended from any folder."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "walk.c3d").write_bytes(b"")
    MoshCall((Path("walk.c3d"),), (Path("people"),), layout="cmu41").write(tmp_path)
    call = MoshCall.read(tmp_path)
    assert call.markers == (tmp_path / "walk.c3d",) and call.model == (Path("people"),) and call.layout == "cmu41"


def test_hostile_messages_are_refused_in_a_line(place, tmp_path, capfd):
    shutil.copytree(place, tmp_path / "copy")
    check_it_goes_on(MoshApp(tmp_path / "copy" / "out"), capfd)


def test_the_page_is_opened_for_one_folder(place, monkeypatch, capsys):
    shown = []
    monkeypatch.setattr("scanprep.viewer.server.serve", lambda app, *_given: shown.append(app.name))
    assert main(["view", "--mend", str(place / "out")]) == 0 and shown == ["mosh"]
    assert main(["view", "--mend", str(place / "out"), str(place / "out")]) == 2
    assert "--mend: expected one folder of scape mosh, got 2" in capsys.readouterr().err
