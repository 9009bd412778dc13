import csv
import json

import numpy as np
import pytest
from model_bodies import random_poses, worm_model

from model import LearnConfig, learn_scape
from model.digests import body_digest, digest, was_trained_on
from model.evaluation.cli import evaluate, sample
from model.evaluation.errors import (
    pose_errors,
    shape_errors,
)
from model.evaluation.sampling import sample_bodies
from model.posing.cli import mesh as mesh_command
from model.scape import ScapeModel
from model.shape_space import ShapeSpace
from scanprep.dataset import RegisteredSet
from scanprep.geometry.files import read_mesh, write_mesh


@pytest.fixture(scope="module")
def model():
    return worm_model()


@pytest.fixture(scope="module")
def people(model):
    """Twelve people of the model in gentle poses, somewhere."""
    rng = np.random.default_rng(5)
    return model.vertices(random_poses(model, 12, rng, 0.1), rng.normal(size=(12, 3)), rng.normal(size=(12, 3)))


def test_the_subject_is_whom_the_bodies_are_of(model):
    betas, done = np.array([1.0, -1.0, 0.5]), []
    bodies = model.vertices(random_poses(model, 2, np.random.default_rng(1)), betas)
    own = pose_errors(model, bodies, progress=lambda i, n: done.append((i, n)))
    theirs = pose_errors(model, bodies, model.subject(betas))
    assert theirs.errors.overall < 1e-5 < 1e-2 < own.errors.overall
    assert done == [(1, 2), (2, 2)]
    np.testing.assert_array_equal(theirs.betas, betas)


def test_summaries_agree_with_the_fitted_bodies(model):
    rng = np.random.default_rng(2)
    bodies = model.vertices(random_poses(model, 3, rng)) + rng.normal(0, 0.01, (3, 398, 3))
    found = pose_errors(model, bodies)
    far = np.stack([np.linalg.norm(found.vertices(model, i) - bodies[i], axis=1) for i in range(3)])
    part = model.skeleton.part_of_vertex(model.template)
    np.testing.assert_allclose(found.errors.mean, far.mean(axis=1), atol=1e-9)
    np.testing.assert_allclose(found.errors.p95, np.percentile(far, 95, axis=1), atol=1e-9)
    np.testing.assert_allclose(found.errors.worst, far.max(axis=1), atol=1e-9)
    np.testing.assert_allclose(found.errors.by_vertex, far.mean(axis=0), atol=1e-9)
    np.testing.assert_allclose(found.errors.by_part, [[row[part == p].mean() for p in range(4)] for row in far],
                               atol=1e-9)
    assert found.errors.overall == pytest.approx(far.mean(), abs=1e-9)
    assert 0.012 < found.errors.overall < 0.017                # noise of 10 mm an axis: its mean length is 16 mm


def test_more_components_leave_less_and_all_leave_nothing(model, people):
    found = shape_errors(model, people, counts=(3, 1, 2, 99))
    np.testing.assert_array_equal(found.counts, [1, 2, 3])
    left = [e.overall for e in found.errors]
    assert left[0] > left[1] > left[2] and left[2] < 1e-5
    assert found.converged.all() and found.vertex_pca is None
    assert (found.betas[0, :, 1:] == 0).all() and (found.betas[1, :, 2:] == 0).all()
    np.testing.assert_allclose(found.vertices(model, 2, 4), people[4], atol=1e-4)


def test_vertex_pca_is_that_of_the_singular_value_decomposition(model, people):
    train, held = people[:8], people[8:]
    found = shape_errors(model, held, (1, 3), train)
    flat = (train - train.mean(axis=1, keepdims=True)).reshape(8, -1)
    mean = flat.mean(axis=0)
    rows = np.linalg.svd(flat - mean, full_matrices=False)[2]
    centred = (held - held.mean(axis=1, keepdims=True)).reshape(4, -1) - mean
    for count, errors in zip((1, 3), found.vertex_pca, strict=True):
        left = centred - centred @ rows[:count].T @ rows[:count]
        far = np.linalg.norm(left.reshape(4, -1, 3), axis=2)
        np.testing.assert_allclose(errors.mean, far.mean(axis=1), atol=1e-9)
        np.testing.assert_allclose(errors.by_vertex, far.mean(axis=0), atol=1e-9)


def test_random_bodies_are_the_models_and_follow_the_seed(model):
    a, b = (sample_bodies(model, 4, np.random.default_rng(1), pose_too=True) for _ in range(2))
    np.testing.assert_array_equal(a.vertices, b.vertices)
    np.testing.assert_array_equal(a.vertices[2], model.vertices(a.poses[2], a.betas[2]))
    assert not sample_bodies(model, 4, np.random.default_rng(1)).poses.any()


def test_a_model_knows_the_bodies_that_trained_it(model, people):
    poses = model.vertices(random_poses(model, 6, np.random.default_rng(4)))
    learned = learn_scape(model.template, poses, people, model.skeleton, LearnConfig(refinements=0, components=3))
    assert learned.info["digest"] == digest(model.template, poses, people)
    assert was_trained_on(learned, poses).all() and was_trained_on(learned, people).all()
    assert not was_trained_on(learned, poses + 1e-3).any()
    told = ScapeModel(model.template, model.skeleton, model.pose_space, model.shape_space, model.pose_mean,
                      model.pose_covariance, {"digests": [body_digest(p) for p in people[:3]]})
    np.testing.assert_array_equal(was_trained_on(told, people[2:5].astype(np.float32)), [True, False, False])
    assert was_trained_on(model, people) is None


@pytest.mark.parametrize("what, word", [
    (lambda m, p: pose_errors(m, p[:, :5]), "bodies: expected shape"),
    (lambda m, p: pose_errors(m, np.full_like(p, np.nan)), "finite"),
    (lambda m, p: shape_errors(m, p, (0, 2)), "counts"),
    (lambda m, p: shape_errors(m, p, (1,), p[:, :5]), "train"),
    (lambda m, p: sample_bodies(m, 0, np.random.default_rng(0)), "count")])
def test_refuses(model, people, what, word):
    with pytest.raises(ValueError, match=word):
        what(model, people)


@pytest.fixture(scope="module")
def files(model, people, tmp_path_factory):
    """A model file, a folder of poses, a set of people."""
    folder = tmp_path_factory.mktemp("evaluation")
    ScapeModel(model.template, model.skeleton, model.pose_space, model.shape_space, model.pose_mean,
               0.02 * np.diag(np.arange(12) > 2)).save(folder / "worm.npz")
    for i, vertices in enumerate(model.vertices(random_poses(model, 3, np.random.default_rng(6), 0.3))):
        write_mesh(folder / "poses" / f"bent{i}.ply", model.template.with_vertices(vertices))
    held = RegisteredSet.create(folder / "held", model.template)
    for i, person in enumerate(people[:3]):
        held = held.add(f"p{i}", person, subject=f"s{i}")
    held.add("again", people[3], subject="s1")
    for i, person in enumerate(people[4:7]):
        write_mesh(folder / "train" / f"t{i}.ply", model.template.with_vertices(person))
    return folder


def test_evaluate_command(files):
    out = files / "out"
    done = evaluate(files / "worm.npz", out, files / "poses", files / "held", (1, 3), files / "train")
    figures = {m.name: m.value for m in done.metrics}
    assert figures["poses"] == figures["people"] == 3 and figures["poses: mean"] < 0.01
    assert figures["people: mean"] == figures["people, components 3"] < 0.01 < figures["people, components 1"]
    assert figures["people, components 1, vertex PCA"] > 0
    assert figures["variance, components 3"] == pytest.approx(100)
    assert "nobody checked" in figures["note"] and done.output == out
    page = (out / "report.html").read_text()
    assert page.count("<img") >= 4 and "src=\"http" not in page and "not held-out" not in page
    people = list(csv.DictReader((out / "people.csv").open()))
    assert [(r["components"], r["name"]) for r in people] == [(c, f"p{i}") for c in "13" for i in range(3)]
    poses = list(csv.DictReader((out / "poses.csv").open()))
    assert [r["name"] for r in poses] == ["bent0", "bent1", "bent2"] and {r["converged"] for r in poses} == {"yes"}
    assert np.mean([float(r["mean_mm"]) for r in poses]) == pytest.approx(figures["poses: mean"], abs=1e-3)


def test_evaluate_says_when_the_bodies_trained_the_model(model, files):
    posed = np.stack([read_mesh(p).vertices for p in sorted((files / "poses").glob("*.ply"))])
    for info in ({"digests": [body_digest(posed[1])]}, {"digest": digest(model.template, posed, None)}):
        ScapeModel(model.template, model.skeleton, model.pose_space, ShapeSpace.empty(len(model.template.faces)),
                   model.pose_mean, model.pose_covariance, info).save(files / "told.npz")
        done = evaluate(files / "told.npz", files / "told", files / "poses")
        assert any("not held-out" in str(m.value) for m in done.metrics if m.name == "note")
        assert "not held-out" in (files / "told" / "report.html").read_text()


@pytest.mark.parametrize("given, word", [({}, "--poses"), ({"poses": "poses", "train_shapes": "train"}, "--shapes"),
                                         ({"shapes": "other"}, "other.*expected the triangles"),
                                         ({"poses": "poses", "counts": (3,), "shapes": "nowhere"}, "nowhere")])
def test_evaluate_refuses(model, files, given, word):
    write_mesh(files / "other" / "a.ply", model.template.submesh(np.arange(600))[0])
    given = {k: files / v if isinstance(v, str) else v for k, v in given.items()}
    with pytest.raises(ValueError, match=word):
        evaluate(files / "worm.npz", files / "no", **given)


def test_sample_command_writes_what_the_mesh_command_reads(files):
    out = files / "random"
    done = sample(files / "worm.npz", out, 3, seed=4, pose_too=True)
    assert {m.name: m.value for m in done.metrics}["bodies"] == 3
    betas = json.loads((out / "body_2.betas.json").read_text())["betas"]
    mesh_command(files / "worm.npz", files / "again.ply", out / "body_2.pose.json", tuple(betas))
    again, written = read_mesh(files / "again.ply"), read_mesh(out / "body_2.ply")
    np.testing.assert_allclose(again.vertices, written.vertices, atol=1e-9)
    assert (out / "sheet.png").stat().st_size > 5000
