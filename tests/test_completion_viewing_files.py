"""`scape view`: what files are, what cannot be shown, the same in a notebook."""
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from browser import wait_until
from completion_bodies import worm_with_prior
from people_bodies import small_people
from readme_user import of_a_user
from viewing_apps import a_motion, app_of, ask, write_files

from completion import MarkerSequence, write_markers
from completion.__main__ import main
from completion.partial.completion import Completion
from completion.viewing import files as reading
from completion.viewing.arrangement import arrange_side_by_side
from completion.viewing.contents import of_mesh
from completion.viewing.notebook import view
from model import files as files_of_models
from scanprep import RegisteredSet, write_mesh
from scanprep.geometry import rotations
from scanprep.synthetic.people import MARKERS, SyntheticPerson, synthesise_walk


@pytest.fixture(scope="module")
def model():
    return worm_with_prior()


@pytest.fixture(scope="module")
def files(tmp_path_factory, model):
    return write_files(tmp_path_factory.mktemp("view"), model)


def test_kinds_are_told_by_content(files, tmp_path, model):
    (tmp_path / "walk.model").write_bytes((files / "worm.npz").read_bytes())
    (tmp_path / "old").write_bytes((files / "wave.npz").read_bytes())
    app = app_of(tmp_path, "walk.model", "old")
    assert [one.name for one in app.controls.shown] == ["walk.model"]
    assert len(app.shown) == 2 and not app.problems


def test_landmarks_beside_a_mesh_are_shown_with_it(files):
    app = app_of(files, "body.ply", "cloud.xyz")
    mesh, cloud = app.contents[0], app.contents[1]
    assert [shape.name for shape in mesh.shapes] == ["", "landmarks"]
    assert mesh.shapes[1].labels == ("head", "tail")
    assert len(cloud.shapes[0].points) == len(mesh.shapes[0].mesh.vertices)


def test_a_file_beside_that_has_no_landmarks_hides_nothing(files, tmp_path):
    (tmp_path / "body.ply").write_bytes((files / "body.ply").read_bytes())
    (tmp_path / "body.json").write_text('{"kind": "statue"}')
    content = app_of(tmp_path, "body.ply").contents[0]
    assert len(content.shapes) == 1 and "body.json" in content.notes[0]


def test_landmarks_and_layouts_are_laid_on_what_was_named_before(files, tmp_path, model):
    layout = {"markersets": [{"type": "body", "distance_from_skin": 0.01, "indices": {"A": 3, "B": 40}}]}
    (tmp_path / "layout.json").write_text(json.dumps(layout))
    (tmp_path / "body.ply").write_bytes((files / "body.ply").read_bytes())
    app = app_of(tmp_path, "body.ply", "layout.json")
    dots = app.contents[0].shapes[1]
    assert dots.labels == ("A", "B")
    assert np.allclose(np.linalg.norm(dots.points - model.template.vertices[[3, 40]], axis=1), 0.01, atol=1e-9)
    with pytest.raises(ValueError, match=r"layout.json: landmarks and layouts"):
        app_of(tmp_path, "layout.json")


def test_a_registered_set_is_a_list_with_the_first_shown(model, tmp_path):
    made = RegisteredSet.create(tmp_path / "set", model.template)
    for i in range(3):
        made = made.add(f"scan{i}", model.template.vertices + i)
    app = app_of(tmp_path, "set")
    assert [entry.name for entry in app.entries] == ["scan0", "scan1", "scan2", "template"]
    assert app.shown == [0]
    told = ask(app, "show", entries=[1, 2])
    assert [message.kind for message in told] == ["scene", "state"] and app.shown == [1, 2]


def test_a_completion_has_its_errors_as_heat(model, tmp_path):
    mesh, N = model.template, len(model.template.vertices)
    done = Completion(mesh, mesh, np.zeros((4, 3)), np.zeros(3), np.zeros(3), np.arange(N) < 50, rms=0.0, explained=1.0,
                      landmark_rms=0.0, converged=True, iterations=3, energies={}, scale=1.0,
                      expected_error=np.linspace(0, 0.05, N), confidence=np.ones(N))
    (tmp_path / "done").mkdir()
    done.save(tmp_path / "done")
    content = app_of(tmp_path, "done").contents[0]
    assert set(content.shapes[0].shades) == {"seen", "expected error"}
    assert [shape.visible for shape in content.shapes] == [True, False]


REFUSED = {
    "nothing.ply": (None, "nothing.ply: no such file"),
    "empty.ply": (b"ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nproperty float y\nproperty float z\n"
                  b"end_header\n", "empty.ply"),
    "notes.docx": (b"hello", "notes.docx: expected a mesh"),
    "text.ply": (b"hello", "text.ply"),
    "cut.npz": (b"PK\x03\x04broken", "cut.npz: expected"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_shown_is_refused_in_one_line(name, tmp_path, capsys):
    data, line = REFUSED[name]
    if data is not None:
        (tmp_path / name).write_bytes(data)
    assert main(["view", str(tmp_path / name), "--serve", "0"]) == 1
    told = capsys.readouterr().err
    assert line in told and len(told.strip().splitlines()) == 1 and "unforeseen" not in told


def test_a_bad_file_among_good_ones_is_told_of(files, tmp_path):
    (tmp_path / "bad.ply").write_text("no mesh")
    (tmp_path / "good.ply").write_bytes((files / "body.ply").read_bytes())
    app = app_of(tmp_path, "bad.ply", "good.ply")
    assert app.shown == [1] and "bad.ply" in app.problems[0]
    assert "bad.ply" in app.state().fields["problems"][0]


@pytest.mark.slow
def test_a_notebook_shows_what_turns_without_a_network(model, new_page, tmp_path):
    subject, motion = model.subject(np.array([0.5, -1.0])), a_motion(20)
    shown = view(model.template, model.template.vertices, model, subject, (motion, subject))
    assert len(shown._repr_html_()) < 2_000_000
    (tmp_path / "notebook.html").write_text(f"<body>{shown._repr_html_()}</body>", encoding="utf-8")
    page = new_page(offline=True)
    page.goto((tmp_path / "notebook.html").as_uri())
    frame = page.frames[-1]
    wait_until(page, "Boolean(document.querySelector('iframe').contentDocument.querySelector('figure')?.sk)", 20)
    assert frame.evaluate("document.querySelector('figure').sk.panes.length") == 5
    assert not page.errors and all(url.startswith(("file:", "about:", "data:", "blob:")) for url in page.requests)


def test_a_notebook_shows_files_and_refuses_the_rest(files):
    assert [content.name for content in view(files / "body.ply", str(files / "worm.npz")).contents] == [
        "body.ply", "worm.npz"]
    with pytest.raises(ValueError, match="got dict"):
        view({})
    with pytest.raises(ValueError, match="got nothing"):
        view()
    with pytest.raises(ValueError, match="up: expected one of"):
        view(files / "body.ply", up="w")


def test_things_at_one_place_are_seen_from_one_side(model):
    """As a scan and what was made of it; not what stands elsewhere, or faces the other way."""
    body = of_mesh("body", model.template)

    def standing(angle, away=0.0):
        stance = body.stance
        front = rotations.exp(np.radians(angle) * stance.up) @ stance.front
        return replace(body, stance=replace(stance, front=front, extent=stance.extent + away))

    cameras, _ = arrange_side_by_side([body, standing(40), standing(170), standing(40, 5.0)])
    apart = [np.degrees(np.arccos(np.clip(one.axes[2] @ cameras[0].axes[2], -1, 1))) for one in cameras]
    assert apart[1] < 1e-3 and apart[2] > 100 and 30 < apart[3] < 50


@pytest.mark.slow
def test_results_of_commands_without_a_model_open_in_another_folder(tmp_path, monkeypatch):
    person, (poses, trans) = SyntheticPerson(), synthesise_walk(12, 30.0)
    bodies = [person.mesh.with_vertices(person.in_pose(*each)) for each in zip(poses, trans, strict=True)]
    at = list(MARKERS.values())
    markers = np.stack([body.vertices[at] + 0.0095 * body.vertex_normals[at] for body in bodies])
    with of_a_user(tmp_path):
        write_markers(Path("walk.c3d"), MarkerSequence(markers, tuple(MARKERS), 30.0))
        for number in range(2):
            write_mesh(Path("frames") / f"{number}.ply", small_people().template)
        for words in ("mosh walk.c3d", "animate walk.c3d", "track frames", "complete frames/0.ply"):
            assert main([*words.split(), "-o", f"out/{words.split()[0]}"]) == 0
        (tmp_path / "out").rename(tmp_path / "moved")
        (tmp_path / "elsewhere").mkdir()
        monkeypatch.chdir(tmp_path / "elsewhere")
        monkeypatch.setattr(reading, "load_model", files_of_models.load_model)
        for command in ("mosh", "animate", "track", "complete"):
            app = app_of(tmp_path / "moved", command)
            assert app.shown == [0] and not app.problems, command
        app = app_of(tmp_path, "moved")
        ask(app, "show", entries=[0, 1, 2, 3])
        assert app.shown == [0, 1, 2, 3] and not app.problems
