"""Exported files, read back by readers of their own."""
import json
from dataclasses import replace

import numpy as np
import pytest
from bvh_reader import Bvh
from conformance_bodies import blendscape_worm, scape_worm, skinned_worm
from exported_worms import BETAS, worm, worm_motion, worm_rig  # noqa: F401 -- fixtures
from glb_reader import Glb
from published_bodies import published_vertices

from model.export.cli import export
from model.export.correctives import motion_correctives, write_body_npz
from model.export.glb import continuous_quaternions, encode_skinned_glb, write_skinned_glb
from model.motion.onto import BodyMotion
from model.rig import turn_up
from model.shape_space import ShapeSpace
from scanprep.command_line import run
from scanprep.geometry import rotations
from scanprep.geometry.files import read_mesh
from scanprep.geometry.mesh import Mesh


@pytest.mark.parametrize("up", [0, 1, 2])
def test_a_viewer_sees_the_skinned_motion(rig, motion, up):
    glb = Glb(encode_skinned_glb(rig, *motion, 4.0, up=up))
    assert np.array_equal(glb.faces, rig.mesh.faces)
    for t, expected in enumerate(rig.vertices(*motion)):
        assert np.abs(glb.skinned(t) - expected @ turn_up(up).T).max() < 1e-5
    times = [glb.array(s["input"]) for s in glb.json["animations"][0]["samplers"]]
    assert all(np.allclose(t[:, 0], [0, 0.25, 0.5, 0.75, 1.0]) for t in times)


def test_at_rest_nothing_is_moved_and_weights_are_as_gltf_wants_them(rig):
    glb = Glb(encode_skinned_glb(rig, up=1))
    assert np.abs(glb.skinned() - rig.mesh.vertices).max() < 1e-6
    assert np.abs(glb.morphed([0] * 6) - rig.mesh.vertices).max() < 1e-6
    world = glb.matrices()
    skin = glb.json["skins"][0]
    inverse = glb.array(skin["inverseBindMatrices"]).reshape(-1, 4, 4).transpose(0, 2, 1)
    for j, node in enumerate(skin["joints"]):
        assert np.abs(world[node] @ inverse[j] - np.eye(4)).max() < 1e-6
        assert np.abs(world[node][:3, 3] - rig.skeleton.joints[j]).max() < 1e-6
        assert glb.json["nodes"][node]["name"] == rig.skeleton.names[j]
    assert "animations" not in glb.json
    joints = glb.array(glb.primitive["attributes"]["JOINTS_0"])
    weights = glb.array(glb.primitive["attributes"]["WEIGHTS_0"])
    assert joints.max() < 4 and np.abs(weights.sum(axis=1, dtype=float) - 1).max() < 1e-6
    assert (joints[weights == 0] == 0).all() and (weights >= 0).all()
    spread = np.zeros(rig.weights.shape)
    for k in range(4):
        np.add.at(spread, (np.arange(len(joints)), joints[:, k]), weights[:, k])
    assert np.abs(spread - rig.weights).max() < 1e-6


@pytest.mark.parametrize(("k", "sign"), [(0, 1), (1, -1), (2, 1)])
def test_morph_targets_are_betas(model, rig, k, sign):
    glb = Glb(encode_skinned_glb(rig, up=1))
    assert glb.json["meshes"][0]["extras"]["targetNames"] == [
        "beta 1 +3", "beta 1 -3", "beta 2 +3", "beta 2 -3", "beta 3 +3", "beta 3 -3"]
    weights, betas = np.zeros(6), np.r_[BETAS, 0]
    weights[2 * k + (sign < 0)], betas[k] = 2 / 3, betas[k] + 2 * sign
    body = model.vertices(np.zeros((4, 3)), betas)
    assert np.abs(glb.skinned(weights=weights) - body).max() < 1e-6
    one = Mesh(rig.mesh.vertices + 3 * sign * rig.shapes[k], rig.mesh.faces)
    assert np.abs(glb.morphed(1.5 * weights, "NORMAL") - one.vertex_normals).max() < 1e-6


def test_correctives_play_with_the_motion(model, rig, motion):
    poses, trans = 0.3 * motion[0], motion[1]
    subject = model.subject(BETAS)
    extra = replace(rig, correctives=motion_correctives(rig, subject, poses, 5))
    glb = Glb(encode_skinned_glb(extra, poses, trans, 4.0, up=1))
    names = glb.json["meshes"][0]["extras"]["targetNames"]
    assert names[6:] == [f"corrective {k}" for k in range(1, 6)]
    weights = np.stack([glb.moved(t)[1] for t in range(5)])
    assert weights.min() >= 0 and weights.max() <= 1, "programs clamp others"
    plain, exact = rig.vertices(poses, trans), subject.vertices(poses, trans)
    for t in range(5):
        assert np.abs(plain[t] - exact[t]).max() > 10 * np.abs(glb.skinned(t) - exact[t]).max()
    with pytest.raises(ValueError, match="correctives: expected the poses"):
        encode_skinned_glb(extra)
    with pytest.raises(ValueError, match="correctives: expected weights of 4 frames, got frame 4"):
        encode_skinned_glb(extra, poses[:4], trans[:4], 4.0)


def test_quaternions_do_not_jump():
    angle = np.linspace(0, 4 * np.pi, 41)
    poses = angle[:, None, None] * np.array([[0.6, 0, 0.8], [0, 1, 0]])
    q = continuous_quaternions(rotations.exp(poses))
    assert ((q[1:] * q[:-1]).sum(axis=-1) > 0.98).all() and np.allclose(np.linalg.norm(q, axis=-1), 1)
    expected = np.concatenate([np.sin(angle / 2)[:, None, None] * np.array([[0.6, 0, 0.8], [0, 1, 0]]),
                               np.broadcast_to(np.cos(angle / 2)[:, None, None], (41, 2, 1))], axis=-1)
    assert np.abs(q - expected).max() < 1e-9


def test_other_readers_find_the_rest_mesh(rig, motion, tmp_path):
    trimesh = pytest.importorskip("trimesh")
    write_skinned_glb(tmp_path / "a.glb", rig, *motion, rate=4.0, up=1)
    (mesh,) = trimesh.load(tmp_path / "a.glb", process=False).geometry.values()
    ours = read_mesh(tmp_path / "a.glb")
    for vertices, faces in ((mesh.vertices, mesh.faces), (ours.vertices, ours.faces)):
        assert np.abs(vertices - rig.mesh.vertices).max() < 1e-6 and np.array_equal(faces, rig.mesh.faces)
    assert [p.name for p in tmp_path.iterdir()] == ["a.glb"]


@pytest.mark.parametrize(("change", "words"), [
    (lambda p, t: (p[:, :3], t, 4.0), r"poses: expected shape \(T, 4, 3\)"),
    (lambda p, t: (p[:0], t[:0], 4.0), "at least one frame"), (lambda p, t: (p, t[:2], 4.0), "trans: expected"),
    (lambda p, t: (p, t, 0.0), "rate: expected a positive"),
    (lambda p, t: (np.where(np.arange(5)[:, None, None] == 3, np.nan, p), t, 4.0), "the first is frame 3")])
def test_bad_motion_is_refused(rig, motion, change, words):
    with pytest.raises(ValueError, match=words):
        encode_skinned_glb(rig, *change(*motion))


def test_npz_has_the_arrays_that_users_expect(model, tmp_path):
    write_body_npz(tmp_path / "a.npz", model)
    with np.load(tmp_path / "a.npz", allow_pickle=False) as stored:
        arrays = {name: stored[name] for name in stored.files}
    N, F, J, K = len(model.template.vertices), len(model.template.faces), 4, 3
    shapes = {"v_template": (N, 3), "f": (F, 3), "weights": (N, J), "kintree_table": (2, J), "J_regressor": (J, N),
              "J": (J, 3), "shapedirs": (N, 3, K), "posedirs": (N, 3, 9 * (J - 1)), "part_names": (J,)}
    assert {name: arrays[name].shape for name in shapes} == shapes
    assert str(arrays["betas_unit"]) == "standard deviation" and str(arrays["length_unit"]) == "metre"
    assert np.array_equal(arrays["kintree_table"], [[-1, 0, 0, 2], [0, 1, 2, 3]])
    assert np.allclose(arrays["J_regressor"] @ arrays["v_template"], arrays["J"], atol=1e-12)
    betas, trans = np.array([1.0, -2.0, 0.5]), np.array([1.0, -2.0, 0.5])
    for root in (np.zeros(3), [1.0, 0.5, 2.0]):
        pose = np.vstack([root, np.zeros((3, 3))])
        assert np.abs(published_vertices(arrays, pose, betas, trans) - model.vertices(pose, betas, trans)).max() < 1e-6


@pytest.fixture(scope="module")
def files(model, motion, tmp_path_factory):
    folder = tmp_path_factory.mktemp("export")
    model.save(folder / "model.npz")
    np.savez(folder / "motion.npz", poses=motion[0].reshape(5, -1), trans=motion[1], betas=BETAS,
             mocap_frame_rate=np.array(4.0), surface_model_type=np.array("scape"))
    return folder


def exported(files, output, *arguments):
    """Metrics of the report of a run that succeeded."""
    assert run(export, "scape model export", [str(files / "model.npz"), "-o", str(files / output), *arguments]) == 0
    place = files / output
    report = place / "report.json" if place.is_dir() else place.with_name(f"{output}.report.json")
    return {m["metric"]: m["value"] for m in json.loads(report.read_text())["metrics"]}


def test_the_command_writes_what_the_name_says(files, model, rig, motion):
    figures = exported(files, "a.glb", "--motion", str(files / "motion.npz"), "--up", "y", "--correctives", "2")
    glb = Glb((files / "a.glb").read_bytes())
    assert len(glb.json["meshes"][0]["extras"]["targetNames"]) == 8 == figures["shape targets"] + 2
    off = np.stack([glb.skinned(t) for t in range(5)]) - model.subject(BETAS).vertices(*motion)
    assert figures["distance from exact body, mean"] == pytest.approx(
        1000 * np.linalg.norm(off, axis=2).mean(), rel=1e-3)
    assert figures["frames"] == 5 and figures["joints"] == 4
    exported(files, "a.bvh", "--betas", "0.5", "-1", "--unit", "m", "--up", "y")
    places = Bvh((files / "a.bvh").read_text()).positions(0)
    assert np.allclose([places[name] for name in rig.skeleton.names], rig.skeleton.joints, atol=1e-5)
    figures = exported(files, "a.npz")
    assert figures["distance from exact body, with pose directions, mean"] < figures[
        "distance from exact body, skinning alone, mean"]
    exported(files, "a.ply", "--own-body")
    assert np.abs(read_mesh(files / "a.ply", "m").vertices - model.vertices(np.zeros((4, 3)))).max() < 1e-12
    figures = exported(files, "slow.glb", "--motion", str(files / "motion.npz"), "--up", "y", "--fps", "2")
    assert figures["frames"] == 3
    figures = exported(files, "fast.bvh", "--motion", str(files / "motion.npz"), "--up", "y", "--rate", "50")
    assert figures["frames"] == 5 and "Frame Time: 0.02" in (files / "fast.bvh").read_text()
    assert exported(files, "frames", "--motion", str(files / "motion.npz"))["meshes"] == 5
    assert len(list((files / "frames").glob("*.ply"))) == 5


@pytest.mark.parametrize(("arguments", "code", "words"), [
    (["-o", "a.fbx"], 1, "expected a name ending in .glb, .bvh, .npz"),
    (["-o", "b.ply", "--motion", "motion.npz"], 2, "name a folder for the meshes of a motion"),
    (["-o", "b.glb", "--correctives", "3"], 2, "name it with --motion"),
    (["-o", "b.ply", "--fps", "24"], 2, "--fps: it says nothing about a mesh"),
    (["-o", "b.glb", "--root", "nose"], 1, "expected a part of the body (part0, part1, part2, part3), got 'nose'"),
    (["-o", "b.glb", "--names", "vrm"], 1, "names: expected a person's parts (pelvis, thigh_left, ...)"),
    (["-o", "nothing"], 1, "name it with --motion"),
    (["-o", "b.glb", "--own-body", "--betas", "1"], 2, "the template's own body has no betas"),
    (["-o", "b.glb", "--own-body", "--morphs", "2"], 1, "shapes: the template's own body has none"),
    (["-o", "b.bvh", "--motion", "model.npz"], 1, "expected a motion, it lacks poses and trans")])
def test_the_command_refuses_in_one_line(files, arguments, code, words, capsys, monkeypatch):
    monkeypatch.chdir(files)
    assert run(export, "scape model export", ["model.npz", *arguments]) == code
    assert words in capsys.readouterr().err
    assert not list(files.glob("b.*")) and not (files / "nothing").exists()


@pytest.mark.parametrize("rate", [24.0, 30.0, 48.0, 120.0])
def test_a_motion_at_another_rate_is_the_same_motion(rate):
    """Joints that turn at constant speed about a slanted axis, beyond half a turn, and a straight way."""
    axis, speed = np.array([0.6, 0.0, 0.8]), np.array([[1.0], [-4.0]])

    def at(times):
        turned = rotations.log(rotations.exp(times[:, None, None] * speed * axis))
        return BodyMotion(turned, np.outer(times, [1.0, 2.0, 0.0]), None, 120.0)

    found, wanted = at(np.arange(121) / 120).at_rate(rate), at(np.arange(int(rate) + 1) / rate)
    assert found.rate == rate and len(found.poses) == int(rate) + 1
    np.testing.assert_allclose(rotations.exp(found.poses), rotations.exp(wanted.poses), atol=1e-9)
    np.testing.assert_allclose(found.trans, wanted.trans, atol=1e-12)


@pytest.mark.parametrize("betas", [0, 3])
@pytest.mark.parametrize("name", ["scape", "blendscape", "skinning"])
def test_every_kind_of_model_exports_to_every_format(name, betas, tmp_path):
    body = {"scape": scape_worm, "blendscape": blendscape_worm, "skinning": lambda: skinned_worm(True)}[name]()
    if betas == 0 and name == "skinning":
        body = replace(body, shape_components=body.shape_components[:0],
                       shape_variances=body.shape_variances[:0])
    elif betas == 0:
        body = replace(body, shape_space=ShapeSpace.empty(len(body.template.faces)))
    body.save(tmp_path / "model.npz")
    for ending in ("glb", "bvh", "npz", "ply", "obj", "stl", "off"):
        exported(tmp_path, f"body.{ending}")
    # at rest every file holds the mean person, who is the template where a model has no betas
    rest, mean = np.zeros((4, 3)), body.mean_subject
    assert mean.betas.shape == (betas,)
    assert np.abs(read_mesh(tmp_path / "body.ply", "m").vertices - mean.vertices(rest)).max() < 1e-6
    arrays = dict(np.load(tmp_path / "body.npz"))
    assert arrays["shapedirs"].shape[-1] == betas
    assert np.abs(arrays["v_template"] - mean.vertices(rest)).max() < 1e-6
    assert body.shape_jacobian(rest).shape == (*body.template.vertices.shape, betas)
    assert np.allclose(body.points(np.arange(4)).operator(np.zeros(betas)).evaluate(rest), mean.vertices(rest)[:4])
