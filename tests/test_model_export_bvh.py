"""Exported BVH is read back, and so is that of other programs; bad files say what is wrong."""
from dataclasses import replace

import numpy as np
import pytest
from bvh_reader import Bvh
from exported_worms import worm, worm_motion, worm_rig  # noqa: F401 -- fixtures

from model.export.bvh import part_ends, write_bvh
from model.motion.bvh import read_bvh
from model.rig import joint_places, turn_up
from scanprep.geometry.storage import StorageError


@pytest.mark.parametrize(("up", "unit", "metre"), [(0, "cm", 100), (1, "m", 1), (2, "in", 39.37007874015748)])
def test_bvh_holds_the_motion_of_the_joints_and_is_read_back(rig, motion, tmp_path, up, unit, metre):
    poses, trans = motion[0].copy(), motion[1]
    poses[0, 2], poses[1, 1] = [np.pi / 2, 0, 0], [0, 0, 3.5]      # of the first two Euler axes fall together
    write_bvh(tmp_path / "a.bvh", rig.skeleton, poses, trans, 120.0, unit, up, body=rig.mesh)
    theirs, ours, U = Bvh((tmp_path / "a.bvh").read_text()), read_bvh(tmp_path / "a.bvh", unit), turn_up(up)
    assert abs(float(theirs.time) - 1 / 120) < 1e-9 and len(theirs.frames) == 5
    assert [len(c) for c in theirs.channels] == [6, 3, 3, 3]
    assert ours.rate == pytest.approx(120, abs=1e-4) and not theirs.offsets[0].any() and not ours.offsets[0].any()
    order = [ours.names.index(name) for name in rig.skeleton.names]
    places = joint_places(rig.skeleton, poses, trans) @ U.T
    for t in range(5):
        found = theirs.positions(t)
        assert np.abs(np.stack([found[name] for name in rig.skeleton.names]) / metre - places[t]).max() < 1e-6
    assert np.abs(ours.places[:, order] - places).max() < 1e-6
    assert np.abs(ours.rotations[:, order] - U @ rig.skeleton.part_rotations(poses) @ U.T).max() < 1e-6
    rest = ours.rest[order] @ U
    assert np.abs(rest - rest[0] - rig.skeleton.joints + rig.skeleton.joints[0]).max() < 1e-6


MIXED = """HIERARCHY
ROOT Left Hip {
\tOFFSET 1 2 3
\tCHANNELS 6 Zposition Xposition Yposition Yrotation Xrotation Zrotation
\tJOINT a
\t{
\t\tOFFSET 0 10 0
\t\tCHANNELS 1 Xrotation
\t\tEnd Site { OFFSET 0 1 0 } }
\tJOINT b { OFFSET 4 0 0 CHANNELS 5 Xposition Yposition Zposition Zrotation Yrotation }
\tJOINT c { OFFSET 4 0 0
\t\tCHANNELS 3 xposition yposition zposition } }
MOTION
Frames : 3
Frame Time:\t0.05

30 10 20  40 50 60 70  4.5 0 0 80 90  0.5 0 0
30\t10 20  0 0 0  -70  4.5 0 0 0 0  0.5 0 0
30 10 20  0 0 0  0  4 0 0 0 0  0 0 0
"""


@pytest.mark.parametrize(("change", "words"), [
    (("0.5 0 0\n30\t", "0.5 0\n30 "), "a.bvh, line 17: expected the 15 numbers of a frame, found 14"),
    (("-70", "nan"), "a.bvh, line 18: expected finite numbers, found 'nan'"),
    (("-70", "x7"), "a.bvh, line 18: expected finite numbers, found 'x7'"),
    (("OFFSET 0 10 0", "OFFSET 0 10"), "a.bvh, line 8: expected a number of the OFFSET, found 'CHANNELS'"),
    (("CHANNELS 1 X", "CHANNELS 2 X"), "a.bvh, line 9: expected a channel as Xposition or Zrotation, found 'End'"),
    (("MOTION", ""), "expected MOTION, found 'Frames'"),
    ((MIXED, "HIERARCHY"), "expected ROOT, the file ends at line 1"),
    ((MIXED, "\x00\xff"), "expected a BVH file, .*not text"), ((MIXED, "solid"), "expected HIERARCHY")])
def test_damaged_bvh_is_refused(tmp_path, change, words):
    assert change[0] in MIXED
    with pytest.raises(StorageError, match=r"a\.bvh: no such file; expected a BVH file"):
        read_bvh(tmp_path / "a.bvh", "cm")
    (tmp_path / "a.bvh").write_text(MIXED.replace(*change))
    with pytest.raises(StorageError, match=words):
        read_bvh(tmp_path / "a.bvh", "cm")


def test_bvh_turns_do_not_jump(rig, tmp_path):
    poses = np.linspace(0, 4 * np.pi, 50)[:, None, None] * np.array([[0, 0, j == 2] for j in range(4)])
    write_bvh(tmp_path / "a.bvh", rig.skeleton, poses, up=1)
    frames = Bvh((tmp_path / "a.bvh").read_text()).frames
    assert np.abs(np.diff(frames, axis=0)).max() < 15
    assert frames[-1].max() == pytest.approx(720)


def test_bvh_without_motion_is_one_frame_at_rest(rig, tmp_path):
    for name, frames in (("a.bvh", None), ("b.bvh", np.zeros((0, 4, 3)))):
        write_bvh(tmp_path / name, rig.skeleton, frames, body=rig.mesh, up=1)
    bvh = Bvh((tmp_path / "a.bvh").read_text())
    assert (tmp_path / "a.bvh").read_text() == (tmp_path / "b.bvh").read_text()
    assert len(bvh.frames) == 1 and not bvh.frames[0, 3:].any()
    places = bvh.positions(0)
    assert np.abs(np.stack([places[name] for name in rig.skeleton.names]) / 100 - rig.skeleton.joints).max() < 1e-6
    assert set(bvh.ends) == {"part1", "part3"}, "the leaves"
    # the worm's parts end where the worm ends, along its axis
    for name, end in (("part1", rig.mesh.vertices[:, 0].min()), ("part3", rig.mesh.vertices[:, 0].max())):
        assert (places[name] + bvh.ends[name])[0] / 100 == pytest.approx(end, abs=0.02)
    joints = rig.skeleton.joints
    assert np.allclose(part_ends(rig.skeleton)[3], 2 * joints[3] - joints[2]), "without a body: as the bone before it"


@pytest.mark.parametrize(("names", "how", "words"), [
    (None, {"unit": "ft"}, "unit: expected one of m, mm, cm, in, or its length in metres, got 'ft'"),
    (("a", "b", "c", "left arm"), {}, "without white space"), (None, {"rate": -1.0}, "rate")])
def test_bad_bvh_is_refused(rig, tmp_path, names, how, words):
    with pytest.raises(ValueError, match=words):
        write_bvh(tmp_path / "a.bvh", replace(rig.skeleton, names=names or rig.skeleton.names), **how)
    with pytest.raises(ValueError, match="unit: expected one of m, mm, cm, in, or its length in metres, got 'ft'"):
        read_bvh(tmp_path / "no.bvh", "ft")
    assert not list(tmp_path.iterdir())
