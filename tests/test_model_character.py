"""A character in place of the mean person."""
from dataclasses import replace

import numpy as np
import pytest
from model_bodies import random_poses, worm_model
from posing_bodies import skinned, symmetric_worm

from model import load_model
from model.cli import group
from model.posing.character import (
    character_model,
    character_pose,
    register_character,
)
from model.scape import BlendScapeModel
from model.shape_statistics import PLANE
from scanprep import Mesh, write_landmarks, write_mesh
from scanprep.geometry import rotations
from scanprep.registration.schedule import RegistrationConfig

REST, MEAN = np.zeros((4, 3)), np.zeros(1)


def blended(model):
    """The same with rotations that pass into each other near the borders of parts."""
    near = np.abs(model.template.corners.mean(axis=1)[:, [0]] - 0.3 - np.array([0, -0.7, 0.5, 0.9]))
    blend = np.exp(-near**2 / 0.03) + 1e-3 * np.eye(4)[model.skeleton.part_of_face]
    blend /= blend.sum(axis=1, keepdims=True)
    fields = ("template", "skeleton", "pose_space", "shape_space", "pose_mean", "pose_covariance", "info")
    return BlendScapeModel(**{name: getattr(model, name) for name in fields}, blend=blend)


def with_betas():
    template, skeleton, _ = symmetric_worm()
    model, wave = skinned(template, skeleton), np.cos(3 * template.vertices[:, :1])
    U = 0.02 * wave * template.vertex_normals
    return replace(model, shape_components=U[None], shape_variances=np.array([(U**2).sum()]),
                   shape_total=float((U**2).sum()))


MODELS = {"scape": worm_model, "blendscape": lambda: blended(worm_model()), "skinning": with_betas}


def figure(mesh):
    """Nearly twice as thick in the middle, shorter at one end."""
    x = mesh.vertices - [0.3, -0.2, 0.9]
    thick = 1 + 0.8 * np.exp(-x[:, :1]**2 / 0.1)
    return np.hstack([np.where(x[:, :1] > 0, 0.75, 1.0) * x[:, :1], thick * x[:, 1:]])


def centred(vertices):
    return vertices - vertices.mean(axis=-2, keepdims=True)


@pytest.mark.parametrize("kind", MODELS)
def test_the_mean_is_the_character_and_betas_move_it_as_they_moved_people(kind):
    model = MODELS[kind]()
    J, K = len(model.skeleton.parents), model.n_betas
    wanted = figure(model.template)
    found = character_model(model, wanted, "rest")
    assert type(found) is type(model)
    np.testing.assert_allclose(centred(found.vertices(np.zeros((J, 3)), np.zeros(K))), centred(wanted), atol=2e-5)
    pose, betas = random_poses(model, 1, np.random.default_rng(0), 0.4)[0], np.linspace(-1, 1, K) + 0.3
    moved = [one.vertices(pose, betas) - one.vertices(pose, np.zeros(K)) for one in (model, found)]
    np.testing.assert_allclose(moved[1], moved[0], atol=1e-9)
    np.testing.assert_array_equal(found.vertices(pose), model.vertices(pose))          # None is the template's own body


@pytest.mark.parametrize("kind", MODELS)
def test_it_may_stand_anywhere_and_any_way(kind):
    """Turned, moved, and in a pose of rigid parts, the character is the same model."""
    model = MODELS[kind]()
    pose = random_poses(model, 1, np.random.default_rng(2), 0.4)[0]
    wanted = character_model(model, figure(model.template), "rest")
    R = rotations.exp([0.4, -1.2, 0.7])
    turned = np.zeros((len(model.skeleton.parents), 3))
    turned[0] = [0.4, -1.2, 0.7]
    own = wanted.vertices(np.zeros_like(turned), np.zeros(1))
    for given in ("rest", turned):
        found = character_model(model, own @ R.T + [3.0, 1.0, -2.0], given)
        np.testing.assert_allclose(found.vertices(pose, np.zeros(1)), wanted.vertices(pose, np.zeros(1)), atol=2e-3)


def test_the_pose_is_found_where_parts_are_rigid():
    model = worm_model(bulge=0.0)
    own = character_model(model, figure(model.template), "rest")
    pose = random_poses(model, 1, np.random.default_rng(3), 0.4)[0]
    pose[1:, 0] = 0                                                      # stitching spreads a twist over the tube
    stands = own.vertices(pose, MEAN)
    apart = np.linalg.norm(character_pose(model, stands, "found") - pose, axis=1)
    assert np.degrees(apart.max()) < 6
    far = [np.linalg.norm(character_model(model, stands, known).vertices(REST, MEAN) - own.vertices(REST, MEAN),
                          axis=1).mean() for known in (pose, "found", REST)]
    assert far[0] < 2e-3 and far[1] < 8e-3 and far[2] > 0.05          # known, found, and taken for its build


def test_triangles_do_not_turn_inside_out():
    """With normals no S mirrors, however the character is squeezed."""
    model = worm_model()
    rng = np.random.default_rng(4)
    rough = figure(model.template) + rng.normal(0, 0.01, model.template.vertices.shape)
    assert (np.linalg.det(character_model(model, rough).shape_space.mean) > 0).all()


def test_what_it_keeps_and_what_it_refuses(tmp_path):
    model = replace(worm_model(), info={"digest": "d", PLANE: {"weights": [1.0]}})
    found = character_model(model, figure(model.template))
    assert found.info == {"digest": "d", "character": True} and PLANE in model.info
    found.save(tmp_path / "c.npz")
    np.testing.assert_array_equal(load_model(tmp_path / "c.npz").vertices(REST, MEAN), found.vertices(REST, MEAN))
    for vertices in (np.zeros((3, 3)), np.full(model.template.vertices.shape, np.nan)):
        with pytest.raises(ValueError, match="vertices"):
            character_model(model, vertices)
    with pytest.raises(ValueError, match="no betas"):
        character_model(replace(model, shape_space=model.shape_space.first(0)), model.template.vertices)
    with pytest.raises(ValueError, match="pose"):
        character_model(model, model.template.vertices, pose=np.zeros((2, 3)))


@pytest.fixture(scope="module")
def drawn():
    """A thick worm of other triangles, twice as large and turned, with landmarks; and those of the template."""
    from model_bodies import worm

    other = worm(47, 18)
    R, size = rotations.exp([0, 0, 2.0]), 2.0
    mesh = Mesh(size * figure(other) @ R.T + [1.0, 0, 0], other.faces[:, ::-1])
    base = worm()
    at = {f"ring {i} {k}": (33 * i // 6, 3 * k) for i in range(6) for k in range(4)}
    ours = {name: 12 * ring + k for name, (ring, k) in at.items()} | {"left end": 396, "right end": 397}
    theirs = {name: size * figure(base)[v] @ R.T + [1.0, 0, 0] for name, v in ours.items()}
    return mesh, theirs, ours


def test_a_mesh_of_other_triangles_is_registered(drawn, tmp_path):
    mesh, theirs, ours = drawn
    model = worm_model()
    model = replace(model, template=Mesh(model.template.vertices, model.template.faces[:, ::-1]))
    stages = RegistrationConfig().graph
    quick = RegistrationConfig(graph=(stages[3], replace(stages[7], ends=0)), final_fit=False)
    found = register_character(model, mesh, theirs, ours, quick)
    assert found.registration.uncovered < 0.05 and found.registration.inverted == 0 and found.inside.all()
    wanted = np.array([[0, 0, 0], [-0.35, 0, 0], [0.2625, 0, 0], [0.525, 0, 0]]) @ rotations.exp([0, 0, 2.0]).T * 2
    assert np.linalg.norm(found.joints - wanted - [1.0, 0, 0], axis=1)[1:].max() < 0.08
    with pytest.raises(ValueError, match="at least 4"):
        register_character(model, mesh, {"left end": theirs["left end"]}, ours)


def test_from_the_command_line(drawn, tmp_path, capsys):
    model = worm_model()
    model.save(tmp_path / "worm.npz")
    write_mesh(tmp_path / "figure.ply", model.template.with_vertices(figure(model.template)))
    call = ["character", str(tmp_path / "figure.ply"), "-m", str(tmp_path / "worm.npz"), "-o", str(tmp_path / "c.npz")]
    assert group(call) == 0 and (tmp_path / "c.png").exists()
    found = load_model(tmp_path / "c.npz")
    np.testing.assert_allclose(found.shape_space.mean, character_model(model, figure(model.template)).shape_space.mean,
                               atol=1e-3)
    write_mesh(tmp_path / "figure.ply", drawn[0])
    assert group(call) == 1
    assert "--landmarks" in capsys.readouterr().err
    write_landmarks(tmp_path / "few.json", {"left end": drawn[1]["left end"]})
    assert group([*call, "--landmarks", str(tmp_path / "few.json")]) == 1
