"""Large meshes are learned on fewer vertices, and the model has all of them."""
import numpy as np
import pytest
from model_bodies import random_poses, worm_model

from model import LearnConfig, load_model
from model.digests import was_trained_on
from model.learning import large
from model.learning.cli import learn
from model.learning.large import Resolutions
from model.resolution.change import subdivide_at_middles
from scanprep import write_mesh
from scanprep.batch.opening import beside

QUICK = LearnConfig(refinements=1, prunings=(0.01,), ridges=(1e-3,))


@pytest.fixture(scope="module")
def truth():
    return worm_model()


@pytest.fixture(scope="module")
def bodies(truth):
    """A worm in ten poses (10, N, 3), with four times its triangles."""
    poses = random_poses(truth, 10, np.random.default_rng(0), 0.4)
    poses[0] = 0
    return [subdivide_at_middles(truth.template.with_vertices(body)) for body in truth.subject().vertices(poses)]


@pytest.fixture
def small_limit(monkeypatch, truth):
    monkeypatch.setattr(large, "LARGE", len(truth.template.vertices))
    monkeypatch.setattr(large, "LEARNED", len(truth.template.vertices))


def test_a_large_set_is_learned_on_fewer_vertices_and_said(bodies, tmp_path, small_limit):
    for k, body in enumerate(bodies):
        write_mesh(tmp_path / "poses" / f"pose{k}.ply", body)
    with beside(tmp_path / "worm.npz") as space:
        outcome = learn(tmp_path / "poses", tmp_path / "worm.npz", scape=QUICK, unit="m", space=space)
    model, all_vertices = load_model(tmp_path / "worm.npz"), len(bodies[0].vertices)
    assert len(model.template.vertices) == all_vertices and np.array_equal(model.template.faces, bodies[0].faces)
    row, = [row for row in outcome.metrics if row.name == "learned on"]
    assert row.value.endswith(f"of {all_vertices} vertices")
    assert was_trained_on(model, np.stack([body.vertices for body in bodies]).astype(np.float32)).all()


def test_small_bodies_are_learned_as_they_are(bodies):
    sizes, posed = Resolutions(bodies[0]), np.stack([body.vertices for body in bodies])
    assert sizes.learned is bodies[0] and sizes.reduce(posed) is posed
