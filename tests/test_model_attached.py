"""Meshes with eyes and loose vertices: the body is learned, all else follows it in every file."""
import json

import numpy as np
import pytest
from glb_reader import Glb

from completion.__main__ import main
from completion.partial.completion import Completion, load_completion
from model import load_built_in_model, load_model
from model.resolution.change import change_resolution, resample
from scanprep import Mesh, read_mesh, write_mesh
from scanprep.cli import read_poses
from scanprep.geometry import rotations
from scanprep.geometry.attached import in_body, take_body
from scanprep.geometry.mesh import template_problem
from scanprep.geometry.surface import Surface
from scanprep.pictures.shading import sphere

MODEL = load_built_in_model()
BALL, TRIANGLES = sphere(1)
EYE = len(BALL)
PARTS = MODEL.skeleton.part_of_vertex(MODEL.template)
HEAD = PARTS == MODEL.skeleton.names.index("head")


def eyes_and_body(vertices):
    """A loose vertex before the body at rest, an eye, the body, and the other eye, in this order."""
    centre = MODEL.template.vertices[HEAD].mean(axis=0)
    left, right = (0.012 * BALL + centre + [side, -0.05, 0.02] for side in (0.03, -0.03))
    loose = MODEL.template.vertices.mean(axis=0) + [0, -0.4, 0]
    first = 1 + EYE + len(vertices)
    return Mesh(np.concatenate([[loose], left, vertices, right]),
                np.concatenate([TRIANGLES + 1, MODEL.template.faces + 1 + EYE, TRIANGLES + first]))


WHOLE = eyes_and_body(MODEL.template.vertices)
BODY = slice(1 + EYE, 1 + EYE + len(PARTS))
EYES = [slice(1, 1 + EYE), slice(1 + EYE + len(PARTS), None)]


@pytest.fixture(scope="module")
def learned(tmp_path_factory):
    """A model of the command, learned from poses with eyes that stay at rest; and what the command told."""
    place = tmp_path_factory.mktemp("attached")
    bodies = MODEL.subject(None).vertices(MODEL.pose_examples[:5])
    for i, body in enumerate((MODEL.template.vertices, *bodies)):
        write_mesh(place / "poses" / f"{i}.ply", eyes_and_body(body))
    MODEL.skeleton.save(place / "skeleton.json")
    (place / "landmarks.json").write_text(json.dumps({"nose": BODY.start + 7}))
    (place / "quick.toml").write_text("[skinning]\nrounds = 1\ncorrectives = false\n")
    assert main(["learn", "--poses", str(place / "poses"), "--skeleton", str(place / "skeleton.json"), "--unit", "m",
                 "--landmarks", str(place / "landmarks.json"), "--kind", "skinning",
                 "--config", str(place / "quick.toml"), "-o", str(place / "model.npz")]) == 0
    return place


def test_the_largest_component_is_the_body(learned):
    body, posed, _ = read_poses(learned / "poses", None, None, "m")
    assert np.array_equal(body.faces, MODEL.template.faces) and posed.shape == (6, *MODEL.template.vertices.shape)
    assert np.array_equal(posed[0], MODEL.template.vertices) and template_problem(body) is None
    report = (learned / "model.npz.report.json").read_text()
    assert "3, the largest is the body, the others follow it, and 1 loose vertex" in report
    model = load_model(learned / "model.npz")
    assert model.info["landmarks"] == {"nose": 7}                        # numbers are those of the user's files
    assert np.array_equal(model.template.attached.whole.faces, WHOLE.faces)
    # a mesh of one component is as it was
    assert take_body(MODEL.template) is MODEL.template


def check_eyes(shown, round_within=1e-5):
    """Every eye is the ball that it was, and as far from the surface of the head as it was."""
    rest, now = Surface(Mesh(WHOLE.vertices[BODY], MODEL.template.faces)), Surface(Mesh(shown[BODY],
                                                                                         MODEL.template.faces))
    for eye in EYES:
        before, after = WHOLE.vertices[eye], shown[eye]
        assert np.ptp(np.linalg.norm(after - after.mean(axis=0), axis=1)) < round_within
        off = now.closest(after).distances - rest.closest(before).distances
        assert np.abs(off).max() < 0.002
        assert np.linalg.norm(after.mean(axis=0) - before.mean(axis=0)) > 0.02             # the head did turn


@pytest.mark.parametrize("ending", [".ply", ".obj", ".off", ".glb"])
def test_eyes_follow_the_head_in_the_mesh_of_a_pose(learned, tmp_path, ending):
    (tmp_path / "pose.json").write_text(json.dumps({"head": [0.2, 0.1, 1.0]}))
    assert main(["model", "mesh", str(learned / "model.npz"), "--own-body", "--pose", str(tmp_path / "pose.json"),
                 "-o", str(tmp_path / f"a{ending}")]) == 0
    shown = read_mesh(tmp_path / f"a{ending}", "m")
    assert np.array_equal(shown.faces, WHOLE.faces)
    check_eyes(shown.vertices)


def test_rest_is_rest_and_motion_is_motion():
    """The whole at rest is the file's; a rigid motion of the body is one of the whole."""
    body = take_body(WHOLE)
    R, t = rotations.exp(np.array([0.3, -1.0, 0.5])), np.array([1.0, 2, 3])
    assert np.abs(body.attached.follow(body.vertices) - WHOLE.vertices).max() < 1e-12
    assert np.abs(body.attached.follow(body.vertices @ R.T + t) - (WHOLE.vertices @ R.T + t)).max() < 1e-12


def test_the_skinned_body_and_the_frames_have_all_vertices(learned, tmp_path):
    (tmp_path / "keys.csv").write_text("time,head_rz\n0,0\n1,57.3\n")
    model = str(learned / "model.npz")
    assert main(["animate", str(tmp_path / "keys.csv"), "-m", model, "-o", str(tmp_path / "out"), "--rate", "5"]) == 0
    glb = Glb((tmp_path / "out" / "animation.glb").read_bytes())
    shown = glb.skinned(5)                        # y is up: back to the axes of the model
    assert shown.shape == WHOLE.vertices.shape
    check_eyes(np.stack([shown[:, 0], -shown[:, 2], shown[:, 1]], axis=1), 2e-4)        # weights of the neck too
    assert main(["model", "export", model, "--motion", str(tmp_path / "out" / "motion.npz"),
                 "-o", str(tmp_path / "frames")]) == 0
    last = read_mesh(sorted((tmp_path / "frames").glob("*.ply"))[-1], "m")
    assert np.array_equal(last.faces, WHOLE.faces)
    check_eyes(last.vertices)


def test_meshes_of_the_user_are_bodies_of_the_model(learned, tmp_path):
    """What a command wrote is read by the others, with its eyes."""
    write_mesh(tmp_path / "own.ply", WHOLE)
    model = learned / "model.npz"
    assert main(["model", "mesh", str(model), "--subject", str(tmp_path / "own.ply"), "-o", str(tmp_path / "b.ply")]
                ) == 0
    assert np.abs(read_mesh(tmp_path / "b.ply", "m").vertices - WHOLE.vertices).max() < 5e-3
    template = take_body(WHOLE)
    assert np.array_equal(in_body(template, WHOLE.faces, WHOLE.vertices), template.vertices)
    assert in_body(template, WHOLE.faces[:-1], WHOLE.vertices) is None


def test_a_completion_is_read_again(tmp_path):
    """Its meshes are the whole, its numbers are those of the body."""
    body = take_body(WHOLE)
    moved = body.with_vertices(body.vertices + 0.1)
    seen = np.ones(len(body.vertices), dtype=bool)
    done = Completion(moved, moved, np.zeros((16, 3)), None, np.zeros(3), seen, 0.001,
                      0.98, 0.004, True, 12)
    folder = done.save(tmp_path / "done")
    assert np.abs(read_mesh(folder / "completed.ply", "m").vertices - WHOLE.vertices - 0.1).max() < 1e-6
    assert np.array_equal(load_completion(folder).completed.vertices, moved.vertices)


def test_fewer_triangles_keep_the_eyes(learned):
    model = load_model(learned / "model.npz")
    coarse = change_resolution(model, resample(model.template, 1500), rounds=0)
    whole = coarse.template.attached.mesh(coarse.template)
    assert len(whole.vertices) == 1500 + 2 * EYE + 1 and whole.vertex_component.max() == 3
    assert np.abs(whole.vertices[1500:] - WHOLE.vertices[model.template.attached.others]).max() < 1e-12


def test_files_that_do_not_belong_together_are_refused(learned, tmp_path):
    with np.load(learned / "model.npz") as stored:
        arrays = dict(stored)
    arrays["whole_body"] = arrays["whole_body"] + 10**6
    np.savez(tmp_path / "bad.npz", **arrays)
    with pytest.raises(ValueError, match="whole_body: expected different vertices"):
        load_model(tmp_path / "bad.npz")
