"""Motions of AMASS on models."""

import numpy as np
import pytest
from model_bodies import worm
from motion_files import FRAMES, apart, degrees, of_amass, random_poses
from people_bodies import small_people
from scipy.sparse import csr_array

from model.export.cli import export
from model.features import linear_features
from model.files import load_model
from model.motion import amass
from model.motion.files import read_motion_file
from model.motion.onto import read_motion
from model.posing.cli import read_subject
from model.skinning import SkinningModel
from model.statue.control.files import humanoid
from model.statue.control.model import Statue
from model.statue.motion.motions import read_statue_motion
from scanprep.command_line import run
from scanprep.geometry import rotations
from scanprep.geometry.storage import StorageError
from scanprep.skeleton.tree import Skeleton


@pytest.mark.parametrize("form", ["poses 52", "poses 24", "pieces 55", "y up"])
def test_amass_motions_point_the_same_way(tmp_path, form):
    model, poses = small_people(), random_poses()
    body = of_amass(poses, 1 if form == "y up" else 2)
    whole = np.zeros((FRAMES, 24 if form == "poses 24" else 52, 3))
    whole[:, :22] = body
    flat = whole.reshape(FRAMES, -1)
    told = {"poses": flat} if form != "pieces 55" else {
        "root_orient": flat[:, :3], "pose_body": flat[:, 3:66], "pose_jaw": np.zeros((FRAMES, 3)),
        "pose_eye": np.zeros((FRAMES, 6)), "pose_hand": flat[:, 66:], "surface_model_type": "smplx"}
    np.savez(tmp_path / "a.npz", **told, trans=np.zeros((FRAMES, 3)), betas=np.r_[0.5, np.zeros(15)],
             gender=np.array("female", dtype=object), mocap_framerate=120.0, labels=np.array(["A", None], dtype=object))
    found = read_motion(tmp_path / "a.npz", model)
    assert "T-pose" in found.rest and found.rate == 120 and not found.brought.lacking
    mean = model.subject(np.zeros(1))
    assert apart(mean.vertices(found.poses, found.trans), mean.vertices(poses)) < 4, "but for the bend of the trunk"
    limbs = [j for j, name in enumerate(model.skeleton.names) if name.endswith(("_left", "_right"))]
    R, truth = (model.skeleton.part_rotations(some)[:, limbs] for some in (found.poses, poses))
    assert degrees(rotations.log(R), rotations.log(truth)) < 0.2, "the front of learned people is that much aside"
    statue = Statue(humanoid(), np.zeros((17, 3)), None)
    moved, _ = read_statue_motion(statue, tmp_path / "a.npz")
    shin = humanoid().skeleton.names.index("l_knee")
    there = rotations.log(humanoid().skeleton.part_rotations(moved.poses)[:, shin])
    assert degrees(there, rotations.log(truth[:, limbs.index(model.skeleton.names.index("shin_left"))])) < 10


def family_model(tmp_path, kind="smplh"):
    """A body of 24 joints that stands for one imported from the family: a tube in slices, in the family's tree."""
    mesh, parents = worm(60, 6), np.r_[amass.PARENTS, 20, 21]
    middle = mesh.corners.mean(axis=1)[:, 0]
    part = np.searchsorted(np.quantile(middle, np.arange(1, 24) / 24), middle)
    names = (*amass.NAMES, "left_hand", "right_hand")
    skeleton = Skeleton(part, parents, np.stack([mesh.corners.mean(axis=1)[part == j].mean(axis=0) for j in range(24)]),
                        names).with_root_centred(mesh)
    # not all of these parts meet, so joints are the means of their vertices
    N, of_vertex = len(mesh.vertices), skeleton.part_of_vertex(mesh)
    centres = csr_array(np.stack([(of_vertex == j) / max((of_vertex == j).sum(), 1) for j in range(24)]))
    model = SkinningModel(mesh, skeleton, mesh.vertices, np.eye(24)[of_vertex],
                          linear_features(skeleton, (np.zeros((3, 0)),) * 24), np.zeros((0, N, 3)), mesh.vertices,
                          np.random.default_rng(0).normal(0, 0.01, (3, N, 3)), np.ones(3) / 3, 1.0, np.zeros((24, 3)),
                          np.eye(72), {"family": kind}, regressor=centres)
    model.save(tmp_path / "imported.npz")
    return load_model(tmp_path / "imported.npz")


def test_amass_on_a_model_of_its_family_is_copied_and_written_again(tmp_path, capsys):
    model, rng = family_model(tmp_path), np.random.default_rng(3)
    poses, trans = rng.normal(0, 0.4, (FRAMES, 52, 3)), rng.normal(size=(FRAMES, 3))
    np.savez(tmp_path / "amass.npz", poses=poses.reshape(FRAMES, -1), trans=trans, betas=np.r_[0.5, -1, np.zeros(14)],
             gender="male", mocap_framerate=60.0)
    found = read_motion(tmp_path / "amass.npz", model)
    assert np.array_equal(found.poses[:, :22], poses[:, :22]) and not found.poses[:, 22:].any()
    assert np.array_equal(found.trans, trans) and found.betas.tolist() == [0.5, -1, 0] and found.gender == "male"
    words = [str(tmp_path / "imported.npz"), "--motion", str(tmp_path / "amass.npz"), "-o"]
    assert run(export, "scape model export", [*words, str(tmp_path / "again.npz")]) == 0
    again = read_motion_file(tmp_path / "again.npz")
    with np.load(tmp_path / "again.npz", allow_pickle=False) as data:
        assert data["pose_body"].shape == (FRAMES, 63) and data["root_orient"].shape == (FRAMES, 3)
        assert str(data["surface_model_type"]) == "smplh" and float(data["mocap_frame_rate"]) == 60
    assert np.array_equal(again.poses, found.poses) and again.betas.tolist() == [0.5, -1, 0]
    small_people().save(tmp_path / "ours.npz")
    assert run(export, "scape model export", [str(tmp_path / "ours.npz"), *words[1:], str(tmp_path / "no.npz")]) == 1
    assert "ours.npz: a motion under the names of AMASS is one of an imported model" in capsys.readouterr().err
    assert not (tmp_path / "no.npz").exists()


def test_betas_that_a_model_lacks_count_only_where_they_are_not_zero(tmp_path):
    model = small_people()
    for betas, words in ((np.eye(16)[0], None), (np.eye(16)[15], "at most the 4 betas .* found 16")):
        np.savez(tmp_path / "m.npz", poses=np.zeros((2, 48)), trans=np.zeros((2, 3)), betas=betas, mocap_frame_rate=30)
        if words is None:
            assert read_motion(tmp_path / "m.npz", model).betas.tolist() == [1, 0, 0, 0]
            assert read_subject(model, tmp_path / "m.npz").betas.tolist() == [1, 0, 0, 0]
            continue
        for read in (read_motion, lambda path, model: read_subject(model, path)):
            with pytest.raises(StorageError, match=words):
                read(tmp_path / "m.npz", model)


GOOD = {"poses": np.zeros((2, 48)), "trans": np.zeros((2, 3)), "mocap_frame_rate": np.array(30.0)}


@pytest.mark.parametrize(("change", "words"), [
    ({"poses": np.array([None, 1], dtype=object)}, r"array poses: expected numbers or text, found Python objects"),
    ({"mocap_frame_rate": np.array([30.0, 60.0])}, "mocap_frame_rate: expected one number"),
    ({"mocap_frame_rate": np.array(0.0)}, "mocap_frame_rate"),
    ({"poses": np.full((2, 48), np.nan)}, "poses: 96 values are not finite"),
    ({"poses": np.zeros((0, 48)), "trans": np.zeros((0, 3))}, "frames of the model's 16 parts"),
    ({"poses": np.zeros((2, 60))}, "frames of the model's 16 parts, found 20 parts"),
    ({"poses": np.zeros((2, 50))}, "three numbers each"),
    ({"poses": None}, "it lacks poses"), ({"trans": np.zeros((3, 3))}, r"trans: expected shape \(2, 3\)"),
    ({"poses": np.zeros((2, 30)), "surface_model_type": "smpl"}, "at least the 22 joints"),
    ({"surface_model_type": "mano"}, "expected surface_model_type 'scape', found 'mano'")])
def test_wrong_motions_are_refused_in_our_words(tmp_path, change, words):
    arrays = {name: value for name, value in {**GOOD, **change}.items() if value is not None}
    np.savez(tmp_path / "m.npz", **arrays)
    with pytest.raises(StorageError, match=words) as caught:
        read_motion(tmp_path / "m.npz", small_people())
    assert "m.npz" in str(caught.value) and "allow_pickle" not in str(caught.value)
