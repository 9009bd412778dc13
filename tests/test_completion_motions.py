"""`scape animate` of motions of other skeletons, and the same files in the viewer."""
import json
from dataclasses import replace

import numpy as np
import pytest
from motion_files import OTHERS, elsewhere, of_amass, random_poses
from people_bodies import small_people
from quiet_pictures import small_pictures  # noqa: F401 -- fixture

from completion.__main__ import main
from completion.motion import Motion
from model.export.bvh import write_bvh
from model.motion.onto import read_motion
from model.rig import joint_places, make_rig
from scanprep import write_mesh
from scanprep.geometry.storage import StorageError

WRITTEN = {"motion.npz", "animation.glb", "motion.bvh", "joint_angles.csv", "joint_centres.csv", "report.html",
           "report.json", "motion.trc", "motion.mot", "anatomical_angles.csv"}


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A model, and a folder with a BVH and an AMASS motion of other skeletons and one of the model's own."""
    place = tmp_path_factory.mktemp("motions")
    model, poses = small_people(), random_poses()
    model.save(place / "model.npz")
    many = place / "many"
    many.mkdir()
    elsewhere(many, poses, np.zeros((len(poses), 3)))
    np.savez(many / "amass.npz", poses=of_amass(poses).reshape(len(poses), -1), trans=np.zeros((len(poses), 3)),
             betas=np.zeros(16), gender="male", mocap_framerate=100.0, labels=np.array([None, "A"], dtype=object))
    Motion(poses, np.zeros((len(poses), 3)), np.zeros(4), 50.0, np.zeros((len(poses), 0))).save(many / "own.npz")
    np.savez(many / "shape.npz", betas=np.zeros(16))            # as AMASS has it beside its motions
    (many / "broken.npz").write_text("none")
    return place


def run(place, *words):
    return main(["animate", *map(str, words), "-m", str(place / "model.npz")])


def told(folder):
    return {row["metric"]: row["value"] for row in json.loads((folder / "report.json").read_text())["metrics"]}


def test_a_bvh_becomes_a_motion_of_the_body_with_its_error(place, tmp_path):
    (tmp_path / "onto.json").write_text("[1, 0]")
    words = ("-o", tmp_path / "out", "--retarget-to", tmp_path / "onto.json")
    assert run(place, place / "many" / "theirs.bvh", *words) == 0
    assert {p.name for p in (tmp_path / "out").glob("[!.]*")} == WRITTEN | {"residuals.csv", "onto.npz", "onto.glb"}
    motion, rows = Motion.load(tmp_path / "out" / "motion.npz"), told(tmp_path / "out")
    turns = motion.poses - random_poses()
    assert np.degrees(np.abs(turns).max()) < 0.05 and motion.rate == pytest.approx(24)
    assert rows["judgement"] == "good" and rows["parts that follow a joint"] == "16 of 16"
    assert 0 < rows["angle of segments, mean"] < 3 and 0 < rows["distance of joint centres, mean"] < 20
    page = (tmp_path / "out" / "report.html").read_text()
    assert "joint centres" in page and "left elbow" in page and "On another person" in page
    table = np.genfromtxt(tmp_path / "out" / "residuals.csv", delimiter=",", names=True)
    assert 1000 * np.mean([table[name].mean() for name in table.dtype.names[2:]]) == pytest.approx(
        rows["distance of joint centres, mean"], rel=1e-4)


def test_a_skeleton_that_bows_at_rest_is_to_be_looked_at(place, tmp_path):
    rig = make_rig(small_people(), np.zeros(1))
    bowed = np.zeros((16, 3))
    bowed[1, 0] = np.radians(50)
    R = rig.skeleton.part_rotations(bowed)
    names = tuple(OTHERS[name] for name in rig.skeleton.names)
    skeleton = replace(rig.skeleton, joints=joint_places(rig.skeleton, bowed), names=names)
    poses = skeleton.pose_of(rig.skeleton.part_rotations(random_poses()) @ np.swapaxes(R, -1, -2))
    write_bvh(tmp_path / "bowed.bvh", skeleton, poses, rate=20.0)
    assert run(place, tmp_path / "bowed.bvh", "-o", tmp_path / "out", "--rate", 12) == 0
    rows = told(tmp_path / "out")
    assert rows["trunk leans otherwise at rest, allowed for"] > 20 and rows["rate"] == 12
    assert rows["judgement"].startswith("check: the trunk of the motion's skeleton leans")


def test_a_folder_of_motions_of_every_kind(place, tmp_path):
    out = tmp_path / "out"
    assert run(place, place / "many", "-o", out, "--workers", "1") == 0
    assert {p.name for p in out.iterdir() if p.is_dir() and p.name[0] != "."} == {"theirs", "amass", "own"}
    assert told(out)["files"] == 3 and told(out)["distance of joint centres, mean of the files"] > 0
    own = Motion.load(out / "own" / "motion.npz")
    np.testing.assert_array_equal(own.poses, random_poses())
    assert {p.name for p in (out / "own").glob("[!.]*")} == WRITTEN - {"report.json"}
    assert Motion.load(out / "amass" / "motion.npz").rate == 100 and run(place, place / "many", "-o", out) == 0


@pytest.mark.parametrize(("name", "make", "words"), [
    ("half.bvh", lambda path, text: path.write_text(text[:len(text) // 2]), ["half.bvh", "expected"]),
    ("horse.bvh", lambda path, text: path.write_text(text.replace("UpLeg", "Stifle")),
     ["horse.bvh", "l_hip", "Stifle"]),
    ("none.npz", lambda path, text: np.savez(path, a=np.zeros(3)), ["none.npz", "expected"]),
    ("nan.npz", lambda path, text: np.savez(path, poses=np.full((2, 156), np.nan), trans=np.zeros((2, 3)),
                                            mocap_framerate=1.0), ["nan.npz", "finite"]),
    ("rate.npz", lambda path, text: np.savez(path, poses=np.zeros((2, 156)), trans=np.zeros((2, 3)),
                                             mocap_framerate=-1.0), ["rate.npz", "mocap_framerate"]),
    ("objects.npz", lambda path, text: np.savez(path, poses=np.array([None, 1], dtype=object), trans=np.zeros((2, 3))),
     ["objects.npz", "Python objects"]),
    ("other.npz", lambda path, text: np.savez(path, poses=np.zeros((2, 27)), trans=np.zeros((2, 3)),
                                              mocap_framerate=1.0), ["other.npz", "16 parts", "9 parts"])])
def test_bad_motions_are_one_clear_line(place, tmp_path, capsys, name, make, words):
    make(tmp_path / name, (place / "many" / "theirs.bvh").read_text())
    assert run(place, tmp_path / name, "-o", tmp_path / "out") == 1
    lines = capsys.readouterr().err.splitlines()
    said = [line for line in lines if line.startswith("scape ") and ": note: " not in line]
    assert len(said) == 1 and all(word in said[0] for word in words), said
    assert "pickle=" not in said[0] and not (tmp_path / "out" / "motion.npz").exists()


def test_a_motion_of_another_kind_of_model_says_what_to_do(tmp_path):
    np.savez(tmp_path / "a.npz", poses=np.zeros((2, 156)), trans=np.zeros((2, 3)), mocap_frame_rate=30.0,
             surface_model_type="smplh")
    with pytest.raises(StorageError, match=r"found 'smplh'; scape animate a\.npz -m MODEL -o OUT puts it on a model"):
        Motion.load(tmp_path / "a.npz")


def test_other_commands_read_the_same_motions(place, tmp_path):
    model = place / "model.npz"
    write_mesh(tmp_path / "body.ply", small_people().template)
    for name in ("theirs.bvh", "amass.npz"):
        file, out = str(place / "many" / name), tmp_path / name.partition(".")[0]
        assert main(["model", "export", str(model), "--motion", file, "-o", str(out / "out.bvh")]) == 0
        rows = json.loads((out / "out.bvh.report.json").read_text())["metrics"]
        assert any(row["metric"] == "motion copied" and "° off" in row["value"] for row in rows), rows
        found = read_motion(out / "out.bvh", small_people())
        assert np.abs(found.poses - read_motion(file, small_people()).poses).max() < 1e-6
        assert main(["model", "repose", str(model), str(tmp_path / "body.ply"), "--motion", file, "-o",
                     str(out / "reposed")]) == 0
        assert len(list((out / "reposed").glob("*.ply"))) == len(random_poses())
