"""Joints clicked inside a body: the depth of a ray, the mirrored side, the file, and the page in Chromium."""
import json

import numpy as np
import pytest
import trimesh
from browser import opened, wait_until
from hostile_messages import check_it_goes_on

from scanprep.geometry.files import write_mesh
from scanprep.geometry.landmark_names import FACE
from scanprep.geometry.landmarks import read_landmarks, write_landmarks
from scanprep.geometry.mesh import Mesh
from scanprep.pipeline import pick
from scanprep.synthetic.landmarks import landmarks
from scanprep.synthetic.people import SyntheticPerson
from scanprep.viewer.clicked import Clicked
from scanprep.viewer.joints import JointApp
from scanprep.viewer.landmark_names import HUMANOID
from scanprep.viewer.messages import Message
from scanprep.viewer.surface_clicks import Clickable

FRONT = np.array([0.0, -1.0, 0.0])                   # the synthetic person faces -y
ON_PAGE = """(place) => {
    const pane = program.figure.panes[0], box = pane.canvas.getBoundingClientRect();
    const at = pane.project(pane.origin.clone().fromArray(place).sub(pane.origin));
    return [box.left + at.x, box.top + at.y];
}"""
# joints of the synthetic person, by the names of the humanoid
PLACES = {"shoulder": "upper_arm", "elbow": "forearm", "wrist": "hand", "hip": "thigh", "knee": "shin", "ankle": "foot"}


@pytest.fixture(scope="module")
def person():
    return SyntheticPerson()


@pytest.fixture
def true_joints(person):
    at = dict(zip(person.skeleton.names, person.skeleton.joints, strict=True))
    left = {f"l_{name}": at[f"{part}_left"] for name, part in PLACES.items()}
    return left | {f"r_{name}": at[f"{part}_right"] for name, part in PLACES.items()}


@pytest.fixture
def app(person, tmp_path):
    write_mesh(tmp_path / "anna.ply", person.mesh)
    return JointApp(Clicked(tmp_path / "anna.ply", tmp_path / "anna.features.json", opacity=0.45), HUMANOID, FACE)


def click(app, name, place, way=FRONT):
    """Click at a place from a side, 3 m away."""
    fields = {"pane": 0, "name": name, "origin": (place + 3 * way).tolist(), "direction": (-way).tolist()}
    app.handle(Message("place", fields), lambda message: None)


def boxes(*layers):
    """Boxes of heights (low, high) as one mesh."""
    parts = [trimesh.creation.box(bounds=[[-1, -1, low], [1, 1, high]]) for low, high in layers]
    both = trimesh.util.concatenate(parts)
    return Mesh(both.vertices, both.faces)


@pytest.mark.parametrize(("layers", "ends"), [
    ([(0, 0.5)], (0.5, 0)),
    ([(0, 0.5), (0.9, 0.905)], (0.5, 0)),                          # cloth before the body
    ([(0, 0.5), (0.3, 0.4)], (0.5, 0)),                            # a shell inside it
    ([(0, 0.5), (0.7, 0.9)], (0.9, 0.7)),                          # an arm before the trunk
    ([(0, 0.001), (0.3, 0.303)], (0.303, 0.3)),                    # thin everywhere
])
def test_the_interval_is_the_first_that_a_joint_has_room_in(layers, ends):
    mesh = boxes(*layers)
    for body in (mesh, Mesh(mesh.vertices, mesh.faces[:, ::-1])):                     # inside out too
        found = Clickable(body).interval(np.array([0.1, 0.2, 5.0]), np.array([0, 0, -2.0]))
        np.testing.assert_allclose(found, [[0.1, 0.2, end] for end in ends], atol=1e-5)


def test_joints_clicked_from_the_front_are_within_15_mm_and_so_are_their_mirrors(app, true_joints):
    for name, place in true_joints.items():
        if name.startswith("l_"):
            click(app, name, place)
    app.handle(Message("confirm", {"names": list(app.template.predicted)}), lambda message: None)
    found = read_landmarks(app.template.file)
    off = {name: 1000 * np.linalg.norm(found[name] - place) for name, place in true_joints.items()}
    hips = [off.pop("l_hip"), off.pop("r_hip")]
    assert max(off.values()) < 15, off
    assert max(hips) < 25              # in front of the middle: the page says so, and the depth can be moved


def test_the_mirror_holds_for_a_body_that_is_turned_and_of_any_size(app, person, true_joints):
    """Centimetres, turned by 50 degrees: one click has the plane of the body, the third that of two pairs."""
    turn = trimesh.transformations.rotation_matrix(np.radians(50), [0.2, 0.1, 1])[:3, :3]
    app.template.surface = Clickable(person.mesh.with_vertices(100 * person.mesh.vertices @ turn.T + 40))
    app.template._shown = None
    for name in ("l_elbow", "l_knee", "l_ankle"):
        click(app, name, 100 * turn @ true_joints[name] + 40, way=100 * turn @ FRONT)
        other = f"r{name[1:]}"
        truth = 100 * turn @ true_joints[other] + 40
        assert np.linalg.norm(app.template.predicted[other] - truth) < 2.0
        click(app, other, truth, way=100 * turn @ FRONT)


def test_points_of_the_face_are_on_the_surface_and_the_other_side_is_offered_next(app, person):
    place = person.mesh.vertices[landmarks()["left eye"]]
    click(app, "left eye", place)
    assert np.linalg.norm(app.template.places["left eye"] - place) < 0.003 and app.depth is None
    assert app.chosen == "right eye" and "“right eye”: on the surface" in app.more()["hint"]
    assert np.linalg.norm(app.template.predicted["right eye"] - person.mesh.vertices[landmarks()["right eye"]]) < 0.01


def test_the_command_starts_with_what_was_found_and_goes_on_where_it_ended(person, tmp_path, monkeypatch):
    opened = []
    monkeypatch.setattr(pick, "_serve_until_closed", lambda app, serve: opened.append(app))
    write_mesh(tmp_path / "anna.ply", person.mesh)
    write_landmarks(tmp_path / "found.json", {"l_hip": np.ones(3), "own joint": np.zeros(3)})
    pick.pick_landmarks(tmp_path / "anna.ply", joints=True, start=tmp_path / "found.json")
    assert set(read_landmarks(tmp_path / "anna.features.json")) == {"l_hip", "own joint"}     # saved without a click
    write_landmarks(tmp_path / "anna.features.json", {"l_hip": np.zeros(3), "r_hip": np.ones(3)})
    pick.pick_landmarks(tmp_path / "anna.ply", joints=True, start=tmp_path / "found.json")
    assert opened[1].template.places["l_hip"].max() == 0 and len(opened[1].template.places) == 3
    assert set(HUMANOID) < set(opened[1].names)
    with pytest.raises(ValueError, match="--joints: expected one scan"):
        pick.pick_landmarks(tmp_path / "anna.ply", (tmp_path / "anna.ply",), joints=True)
    with pytest.raises(ValueError, match="--start: expected --joints"):
        pick.pick_landmarks(tmp_path / "anna.ply", start=tmp_path / "found.json")


def test_joints_are_clicked_in_the_browser(new_page, app, true_joints):
    """A click sets a joint inside, one on the blue ball takes the mirror's; the depth is shown and can be moved."""
    with opened(new_page, app) as page:
        for name in ("l_shoulder", "l_elbow", "l_wrist", "l_hip", "l_knee", "l_ankle"):
            wait_until(page, f"program.state.chosen === '{name}'")
            page.mouse.click(*page.evaluate(ON_PAGE, true_joints[name].tolist()))
            other = f"r{name[1:]}"
            wait_until(page, f"'{other}' in program.state.panes[0].predicted && program.state.depth")
            page.mouse.click(*page.evaluate(ON_PAGE, app.template.predicted[other].tolist()))
            wait_until(page, f"'{other}' in program.state.panes[0].places")
        off = {name: 1000 * np.linalg.norm(app.template.places[name] - true_joints[name]) for name in true_joints}
        assert max(off.values()) < 25, off                                            # a pixel is 2.5 mm
        page.mouse.click(*page.evaluate(ON_PAGE, true_joints["l_hip"].tolist()))       # chooses it
        wait_until(page, "program.state.chosen === 'l_hip'")
        page.mouse.click(*page.evaluate(ON_PAGE, true_joints["l_hip"].tolist()))
        wait_until(page, "program.state.depth?.name === 'l_hip'")
        page.locator("input[aria-label=depth]").evaluate(
            "(range) => { range.value = 80; range.dispatchEvent(new Event('change')); }")
        wait_until(page, "Math.abs(program.share() - 0.8) < 1e-6")
        assert "80% of the way" in page.locator(".sk-depth").inner_text()
    assert json.loads(app.template.file.read_text()).keys() == true_joints.keys()


def test_hostile_messages_are_refused_in_a_line(app, capfd):
    check_it_goes_on(app, capfd)
