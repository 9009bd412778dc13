"""Two bodies explain a scan as well: both are kept, it is a doubt, and `scape pick SET` takes the other one."""
import shutil
import time
from dataclasses import replace

import numpy as np
import pytest
from click_app import allowed
from scan_folders import QUICK, ball, contents

from model.coregistration.lead import ModelLead
from scanprep import Mesh, RegisteredSet, read_mesh, write_mesh
from scanprep.batch.opening import workspace
from scanprep.geometry.carrier import mount
from scanprep.pipeline import bootstrap
from scanprep.pipeline import prepare as preparing
from scanprep.pipeline import scan as one_scan
from scanprep.pipeline.again import Call
from scanprep.pipeline.cli import carry_out
from scanprep.pipeline.mend import MendApp
from scanprep.pipeline.page import judge_set
from scanprep.pipeline.rivals import TWO_BODIES, doubt_rival, is_chosen
from scanprep.registration.figures import Verdict
from scanprep.registration.lead import Proposal
from scanprep.viewer.messages import Message

EGG = ball()
BACK = EGG.vertices * [-1, -1, 1]                      # the egg turned round, which lies on the scan as well


@pytest.fixture
def call(tmp_path, monkeypatch):
    """Two scans without landmarks, an egg alone and one with something beside it; and a set of them."""
    board = np.array([[1.5, 0, 0], [1.9, 0, 0], [1.9, 0.4, 0], [1.5, 0.4, 0]])
    faces = np.vstack([EGG.faces, len(EGG.vertices) + np.array([[0, 1, 2], [0, 2, 3]])])
    write_mesh(tmp_path / "scans" / "alone.ply", EGG)
    write_mesh(tmp_path / "scans" / "beside.ply", Mesh(np.vstack([EGG.vertices, board]), faces))
    write_mesh(tmp_path / "template.ply", EGG)
    lead = ModelLead("eggs", mount(EGG, EGG))
    monkeypatch.setattr(ModelLead, "__call__", lambda self, scan, *ignored: [Proposal(EGG.vertices), Proposal(BACK)])
    for module in (preparing, bootstrap):
        monkeypatch.setattr(module, "lead_of", lambda template, *args: lead)
    monkeypatch.setattr(one_scan, "take_clutter", lambda scan: (scan, 0.0))      # it stays, and leaves a doubt
    call = Call(tmp_path / "scans", tmp_path / "template.ply", config=QUICK)
    run(call, tmp_path / "set")
    return call


def run(call, folder):
    """How many scans `scape prep run` registers."""
    with workspace(folder) as space:
        done = carry_out(call, call.inputs(lambda line: None), space)
    return next(metric.value for metric in done.metrics if metric.name == "of them in this run")


def press(app, seconds=60):
    app.handle(Message("take_rival", {}), lambda message: None)
    end = time.monotonic() + seconds
    while app.working is not None:
        assert time.monotonic() < end
        time.sleep(0.02)


def off(path, truth):
    return np.linalg.norm(read_mesh(path).vertices - truth, axis=1).mean()


def test_both_bodies_are_in_the_set_and_on_its_page(call, tmp_path):
    folder = tmp_path / "set"
    kinds = ("ply", "webp", "scene", "npz")
    assert off(folder / "meshes" / "beside.ply", EGG.vertices) < 0.008 > off(folder / "rivals" / "beside.ply", BACK)
    assert {path.name for path in (folder / "rivals").iterdir()} == {f"beside.{kind}" for kind in kinds}
    with workspace(folder) as space:
        assert space.value("scans/beside").doubts == (TWO_BODIES,) and space.value("scans/alone").doubts == ()
    reasons = {verdict.name: verdict.reasons for verdict in judge_set(folder)}
    assert TWO_BODIES.words in reasons["beside"] and not reasons["alone"]
    good = Verdict("beside", 0.2, ())
    assert doubt_rival(good, folder).suspect and not doubt_rival(replace(good, name="alone"), folder).suspect
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert page.count('src="rivals/beside.webp"') == 1 and TWO_BODIES.words in page and "rivals/alone" not in page


def test_the_other_body_is_taken_and_taken_back(call, tmp_path):
    folder = tmp_path / "set"
    app = allowed(MendApp(folder))
    assert app.scan_names == ["beside", "alone"] and app.state().fields["rivals"] == [True, False]
    before = contents(folder)
    press(app)
    assert "the other body" in app.note and app.state().fields["rivals"] == [True, False]
    after = contents(folder)
    for ending, place in (("ply", "meshes"), ("webp", "pictures"), ("scene", "pictures")):
        one, other = f"{place}/beside.{ending}", f"rivals/beside.{ending}"
        assert (after[one], after[other]) == (before[other], before[one]) and before[one] != before[other]
    # it was somebody's choice: no doubt any more, and a run leaves it so
    assert is_chosen(folder, "beside") and not is_chosen(folder, "alone")
    assert app.verdicts["beside"].reasons and TWO_BODIES.words not in app.verdicts["beside"].reasons
    assert run(call, folder) == 0 and contents(folder) == after
    press(app)
    back = contents(folder)
    assert all(back[name] == before[name] for name in before if name.split("/")[0] in ("meshes", "pictures"))
    assert is_chosen(folder, "beside") and run(call, folder) == 0
    assert {entry.file for entry in RegisteredSet.load(folder).entries} == {"meshes/alone.ply", "meshes/beside.ply"}


def test_nothing_is_taken_where_there_is_no_rival_or_the_scan_has_changed(call, tmp_path):
    folder = tmp_path / "set"
    app, before = allowed(MendApp(folder)), contents(folder)
    app.handle(Message("open", {"scan": 1}), lambda message: None)
    press(app)
    assert "alone: there is no other body" in app.note and contents(folder) == before
    app.handle(Message("open", {"scan": 0}), lambda message: None)
    shutil.copyfile(tmp_path / "scans" / "alone.ply", tmp_path / "scans" / "beside.ply")
    press(app)
    assert "beside: its files, or scapekit, have changed" in app.note and contents(folder) == before
    # registered again, the scan has one body only, and nothing is left of the other
    assert run(call, folder) == 1 and not (folder / "rivals").exists()
    assert MendApp(folder).state().fields["rivals"] == [False, False]


@pytest.mark.parametrize("chosen", [False, True])
def test_a_choice_is_not_made_again_through_a_model_of_the_set(call, tmp_path, monkeypatch, chosen):
    """A scan with something beside it stays doubted; it is registered again unless somebody chose its body."""
    if chosen:
        press(allowed(MendApp(tmp_path / "set")))

    def teach(place, work, config, lessons, folder):
        (folder / place).parent.mkdir()
        (folder / place).write_text("a model")

    monkeypatch.setattr(bootstrap, "choose_lessons", lambda *args: bootstrap.Lessons("egg", (), (tmp_path,)))
    monkeypatch.setattr(bootstrap, "_teach", teach)
    monkeypatch.setattr(bootstrap, "CLEARLY", 10.0)                   # whatever comes of it is taken
    folder, rounds = tmp_path / "set", tmp_path / "set" / "again1"
    assert run(call, folder) == (0 if chosen else 1) and (rounds / "rivals" / "beside.ply").is_file() != chosen
    if not chosen:                                # of the later registration the other body can be taken too
        app, found = allowed(MendApp(folder)), contents(rounds)
        assert app.state().fields["rivals"] == [True, False]
        press(app)
        now = contents(folder)
        assert now["meshes/beside.ply"] == found["rivals/beside.ply"]
        assert now["rivals/beside.ply"] == found["meshes/beside.ply"] and not (rounds / "meshes").exists()
        assert run(call, folder) == 0 and contents(folder)["meshes/beside.ply"] == now["meshes/beside.ply"]
    assert {entry.file for entry in RegisteredSet.load(folder).entries} == {"meshes/alone.ply", "meshes/beside.ply"}
