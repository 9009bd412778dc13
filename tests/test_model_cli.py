"""`scape model info` and `scape model mesh`, and who a subject on the command line is."""
import json

import numpy as np
import pytest
from model_bodies import worm_model

from model import fit_pose, fit_shape
from model.cli import info
from model.posing.cli import mesh, read_subject
from scanprep import read_mesh, write_mesh


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    folder = tmp_path_factory.mktemp("model")
    worm_model().save(folder / "worm.npz")
    return folder


def test_info_says_what_a_model_is(place):
    figures = {m.name: m.value for m in info(place / "worm.npz").metrics}
    assert figures["kind"] == "scape" and figures["vertices"] == 398 and figures["shape components"] == 3
    assert figures["parts"] == "part0, part1, part2, part3"


def test_mesh_of_a_pose_and_shape(place):
    model = worm_model()
    (place / "pose.json").write_text(json.dumps({"part2": [0, 0.5, 0]}))
    pose = np.zeros((4, 3))
    pose[2, 1] = 0.5
    mesh(place / "worm.npz", place / "a.ply", place / "pose.json", (1.0, -1.0))
    np.testing.assert_allclose(read_mesh(place / "a.ply").vertices, model.vertices(pose, [1.0, -1.0]), atol=1e-6)
    mesh(place / "worm.npz", place / "b.ply", own_body=True)
    np.testing.assert_allclose(read_mesh(place / "b.ply").vertices, model.template.vertices, atol=1e-6)
    (place / "betas.json").write_text(json.dumps({"betas": [1.0, -1.0]}))
    mesh(place / "worm.npz", place / "c.ply", place / "pose.json", subject=place / "betas.json")
    np.testing.assert_allclose(read_mesh(place / "c.ply").vertices, read_mesh(place / "a.ply").vertices, atol=1e-6)


def test_a_mesh_as_subject_keeps_what_betas_cannot(place):
    """A bump on the worm that no beta makes is there when the subject is posed."""
    model = worm_model()
    body = model.vertices(np.zeros((4, 3)), [0.5, 0.0, 0.0])
    bump = np.exp(-((model.template.vertices[:, 0] - 1.0) / 0.1) ** 2)[:, None] * [0, 0.03, 0]
    write_mesh(place / "bumpy.ply", model.template.with_vertices(body + bump))
    subject = read_subject(model, place / "bumpy.ply")
    by_betas = fit_shape(model, body + bump).mean
    assert fit_pose(subject, body + bump).mean < 0.15 * by_betas and by_betas > 5e-4


@pytest.mark.parametrize("given, words", [
    ({"betas": (1.0,), "own_body": True}, "one of them"), ({"pose": "bad.json"}, "no part 'tail'")])
def test_refuses_what_it_cannot_do(place, given, words):
    (place / "bad.json").write_text(json.dumps({"tail": [0, 0, 1]}))
    given = {k: place / v if k == "pose" else v for k, v in given.items()}
    with pytest.raises(ValueError, match=words):
        mesh(place / "worm.npz", place / "x.ply", **given)
