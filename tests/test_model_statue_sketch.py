"""Joints of figures of odd proportions: sketched by their silhouette, found by a body of free lengths and girths."""
from __future__ import annotations

import numpy as np
import pytest
import trimesh

from model.statue.control.files import humanoid
from model.statue.registration.automatic import find_features
from model.statue.registration.sketch import sketch_joints
from scanprep.geometry import rotations
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.sides import other_side
from scanprep.synthetic.people import SyntheticPerson

PARTS = {"shoulder": "upper_arm", "elbow": "forearm", "wrist": "hand", "hip": "thigh", "knee": "shin", "ankle": "foot"}
NAMES = {f"{side[0]}_{joint}": f"{part}_{side}" for joint, part in PARTS.items() for side in ("left", "right")}


def stretch(person: SyntheticPerson, head: float, legs: float) -> tuple[Mesh, dict[str, np.ndarray]]:
    """A toon: the head scaled about its joint, the legs squeezed along z about the hips; with its joints."""
    x, joints = person.mesh.vertices.copy(), person.joints.copy()
    neck, hip = joints[person.names.index("head")], joints[person.names.index("thigh_left"), 2]
    share = np.clip((x[:, 2:] - neck[2]) / 0.03, 0, 1)                       # smooth across the neck
    x = x + share * (head - 1) * (x - neck)
    squeezed = [np.where(z < hip, hip + legs * (z - hip), z) for z in (x[:, 2], joints[:, 2])]
    x[:, 2], joints[:, 2] = squeezed
    return person.mesh.with_vertices(x), {name: joints[person.names.index(part)] for name, part in NAMES.items()}


@pytest.fixture(scope="module")
def person():
    return SyntheticPerson()


def test_joints_of_a_person_are_sketched_in_any_axes(person):
    true = stretch(person, 1, 1)[1]
    for turn in ([0, 0, 0], [0, 0, np.pi / 2], [np.pi / 2, 0, 0], [0.3, -0.5, 0.9]):
        R = rotations.exp(np.array(turn))
        joints, tips = sketch_joints(person.mesh.with_vertices(person.mesh.vertices @ R.T))
        off = {name: np.linalg.norm(joints[name] @ R - place) for name, place in true.items()}
        swapped = {name: np.linalg.norm(joints[other_side(name)] @ R - place) for name, place in true.items()}
        best = min((off, swapped), key=lambda one: sum(one.values()))        # front and back look alike from the front
        assert max(best.values()) < 0.12 and np.mean(list(best.values())) < 0.06, (turn, best)
        top = person.mesh.vertices[person.mesh.vertices[:, 2].argmax()]
        assert np.linalg.norm(tips["top of head"] @ R - top) < 0.08


@pytest.mark.parametrize("shape", [trimesh.creation.icosphere(3, 0.8), trimesh.creation.box((0.5, 0.4, 1.7))])
def test_what_has_no_limbs_is_not_sketched(shape):
    with pytest.raises(ValueError, match="no star of five tips"):
        sketch_joints(Mesh(shape.vertices, shape.faces))


@pytest.mark.slow
def test_a_toon_with_a_big_head_and_short_legs_is_found(person):
    toon, true = stretch(person, 2.2, 0.6)
    toon = toon.with_vertices(1.7 / np.ptp(toon.vertices[:, 2]) * toon.vertices)
    scale = np.ptp(toon.vertices[:, 2]) / np.ptp(stretch(person, 2.2, 0.6)[0].vertices[:, 2])
    found = find_features(humanoid(), toon)
    assert found.problem is None
    off = {name: np.linalg.norm(found.joints[name] - scale * place) for name, place in true.items()}
    assert max(off.values()) < 0.06, off
