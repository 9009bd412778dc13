"""Markers clicked on a scan of the person who wears them come back as places on the model."""
import json
import time

import numpy as np
import pytest
from completion_bodies import MARKS, POSE, QUICK, TRANS, worm_with_prior
from config_files import config_file

from completion.__main__ import main
from completion.mocap.marker_sets.named import read_layout
from completion.partial import report
from completion.partial.interactive import CompleteApp
from completion.partial.work import CompletionTask
from scanprep.batch.opening import workspace
from scanprep.geometry.files import write_mesh
from scanprep.geometry.landmarks import write_landmarks
from scanprep.viewer.messages import Message

LABELS = tuple(f"M{i:02d}" for i in range(12))
NAMES = [f"mark {i}" for i in range(len(MARKS))]


@pytest.fixture(autouse=True)
def small_pictures(monkeypatch):
    monkeypatch.setattr(report, "HEIGHT", 60)


@pytest.fixture(scope="module")
def worn():
    """A model, a person of another shape in a pose, and markers on the skin: places on the template and on the scan."""
    model = worm_with_prior()
    body = model.template.with_vertices(model.vertices(POSE, np.array([0.8, -0.5, 0.3]), TRANS))
    points, face, bary = body.sample(len(LABELS), np.random.default_rng(1))
    corners = model.template.vertices[model.template.faces[face]]
    return model, body, dict(zip(LABELS, points, strict=True)), np.einsum("nk,nkd->nd", bary, corners)


def app_of(worn, folder, labels=()):
    model, body, _, _ = worn
    write_mesh(folder / "person.ply", body)
    work = CompletionTask(model, "worm", dict(zip(NAMES, map(int, MARKS), strict=True)), QUICK)
    app = CompleteApp(model, work, [folder / "person.ply"], folder / "out", labels)
    app.scan.places.update({name: body.vertices[v] for name, v in zip(NAMES, MARKS, strict=True)})
    return app


def sent(app, kind, **fields):
    told = []
    app.handle(Message(kind, fields), told.append)
    while app.working is not None:
        time.sleep(0.02)
    return told


def assert_there(worn, file):
    """Where they belong on the template, to a hundredth of the worm."""
    model, _, markers, places = worn
    layout = read_layout(file, model.template)
    assert layout.labels == tuple(markers)
    off = np.linalg.norm(layout.skin_points(model.template.vertices) - places, axis=1)
    assert off.max() < 0.02 and off.mean() < 0.008


def test_markers_are_clicked_beside_the_landmarks_and_saved_as_a_layout(worn, tmp_path):
    app = app_of(worn, tmp_path)
    sent(app, "complete")
    with workspace(tmp_path / "out"):
        sent(app, "save")
    assert not (tmp_path / "out" / "layout.json").exists() and app.greet()[1].fields["markers"] == 0
    app = app_of(worn, tmp_path, LABELS)
    assert {*LABELS, *NAMES} == set(app.names) and len(app.scans) == 1
    sent(app, "choose", name=LABELS[0])
    sent(app, "complete")
    for name, place in worn[2].items():
        assert app.chosen == name                                     # one after the other
        sent(app, "place", pane=1, name=name, origin=place.tolist(), direction=[0, 0, 1], seen=place.tolist())
        app.scan.places[name] = place                                 # where a ray from beside it would have met
    state = app.greet()[1].fields
    assert state["markers"] == 12 and not state["completed"]["outdated"]
    with workspace(tmp_path / "out"):
        sent(app, "save")
    assert_there(worn, tmp_path / "out" / "layout.json")
    rows = {m["metric"]: m["value"] for m in json.loads((tmp_path / "out" / "report.json").read_text())["metrics"]}
    assert rows["markers clicked"] == 12 and rows["landmarks used"] == len(MARKS)


def test_the_command_does_the_same(worn, tmp_path):
    model, body, markers, _ = worn
    model.save(tmp_path / "model.npz")
    write_mesh(tmp_path / "person.ply", body)
    marks = {name: body.vertices[v] for name, v in zip(NAMES, MARKS, strict=True)}
    write_landmarks(tmp_path / "person.landmarks.json", {**marks, **markers})
    write_landmarks(tmp_path / "template.json", {name: int(v) for name, v in zip(NAMES, MARKS, strict=True)})
    settings = config_file(tmp_path, random_starts=6, rounds=5, scan_points=800, model_points=300)
    assert main(["complete", str(tmp_path / "person.ply"), "-m", str(tmp_path / "model.npz"), "-o",
                 str(tmp_path / "out"), "--template-landmarks", str(tmp_path / "template.json"), "--config",
                 str(settings)]) == 0
    assert_there(worn, tmp_path / "out" / "layout.json")
