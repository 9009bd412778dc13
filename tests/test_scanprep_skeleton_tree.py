"""The skeleton: pose and rotations, joints that follow the surface, files."""
import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scanprep.geometry import rotations
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.storage import StorageError
from scanprep.skeleton.tree import Skeleton, reorder

PARENTS = (-1, 0, 1, 0)


def tube(rings=24, around=8, length=2.4):
    """An open tube along z, and the part of every triangle: 1 and 2 upwards, 0 in the middle, 3 below."""
    z, turn = np.meshgrid(np.linspace(0, length, rings), np.arange(around) * 2 * np.pi / around, indexing="ij")
    k = np.arange(rings * around).reshape(rings, around)
    a, b = k[:-1], np.roll(k[:-1], -1, axis=1)
    c, d = np.roll(k[1:], -1, axis=1), k[1:]
    faces = np.concatenate([np.stack(t, axis=-1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))])
    mesh = Mesh(np.stack([0.1 * np.cos(turn), 0.1 * np.sin(turn), z], axis=-1).reshape(-1, 3), faces)
    height = mesh.corners[..., 2].mean(axis=1) / length
    part = np.select([height < 0.25, height < 0.5, height < 0.75], [3, 0, 1], 2)
    return mesh, part


MESH, PART = tube()


def skeleton():
    joints = np.array([[0, 0, 0.0], [0.01, 0, 1.2], [0, 0.02, 1.8], [0, 0, 0.6]])
    flat = Skeleton(PART, PARENTS, joints)
    root = MESH.vertices[flat.part_of_vertex(MESH) == 0].mean(axis=0)
    return Skeleton(PART, PARENTS, np.r_[[root], joints[1:]], ("belly", "chest", "head", "legs"))


SKELETON = skeleton()
poses = st.integers(0, 2**32 - 1).map(lambda seed: np.random.default_rng(seed).uniform(-1.7, 1.7, (3, 4, 3)))


@settings(max_examples=40, deadline=None)
@given(poses)
def test_pose_and_part_rotations_undo_each_other(pose):
    R = SKELETON.part_rotations(pose)
    np.testing.assert_allclose(rotations.exp(SKELETON.pose_of(R)), rotations.exp(pose), atol=1e-9)
    np.testing.assert_allclose(SKELETON.part_rotations(SKELETON.pose_of(R)), R, atol=1e-9)


def test_rotations_are_chained_from_parent_to_child():
    pose = np.random.default_rng(0).uniform(-1, 1, (5, 4, 3))
    R, own = SKELETON.part_rotations(pose), rotations.exp(pose)
    for t in range(5):
        np.testing.assert_allclose(R[t, 0], own[t, 0])
        np.testing.assert_allclose(R[t, 2], own[t, 0] @ own[t, 1] @ own[t, 2], atol=1e-14)
        np.testing.assert_allclose(R[t, 3], own[t, 0] @ own[t, 3], atol=1e-14)
        np.testing.assert_array_equal(R[t], SKELETON.part_rotations(pose[t]))        # batch = loop
        np.testing.assert_allclose(rotations.log(R[t, 1].T @ R[t, 2]), pose[t, 2], atol=1e-12)
    np.testing.assert_array_equal(SKELETON.part_rotations(np.zeros((4, 3))), np.tile(np.eye(3), (4, 1, 1)))


def test_the_ring_lies_between_a_part_and_its_parent():
    for j in (1, 2, 3):
        ring = SKELETON.ring(MESH, j)
        for part in (j, PARENTS[j]):
            assert np.isin(ring, MESH.faces[PART == part]).all()
        assert np.ptp(MESH.vertices[ring, 2]) < 0.25 and len(ring) >= 8
        wide = SKELETON.ring(MESH, j, widen=1)
        assert set(ring) < set(wide)
        assert all(MESH.vertex_adjacency[[v]][:, ring].sum() or v in ring for v in wide)


def test_the_regressor_gives_the_joints_and_is_affine():
    regressor = SKELETON.joint_regressor(MESH)
    np.testing.assert_allclose(regressor @ MESH.vertices, SKELETON.joints, atol=1e-9)
    np.testing.assert_allclose(regressor.sum(axis=1), 1)
    A, t = np.random.default_rng(2).normal(size=(3, 3)), np.array([1, 2, 3])
    np.testing.assert_allclose(regressor @ (MESH.vertices @ A.T + t), SKELETON.joints @ A.T + t, atol=1e-9)
    assert all(regressor[[j]].nnz == len(SKELETON.ring(MESH, j, widen=2)) for j in (1, 2, 3))


def test_a_part_that_does_not_touch_its_parent_has_no_joint():
    torn = Skeleton(PART, (-1, 0, 0, 0), SKELETON.joints)
    with pytest.raises(ValueError, match="part 2 does not touch its parent 0"):
        torn.joint_regressor(MESH)


def test_what_is_saved_comes_back(tmp_path):
    SKELETON.save(tmp_path / "s.json")
    back = Skeleton.load(tmp_path / "s.json")
    np.testing.assert_array_equal(back.part_of_face, PART)
    np.testing.assert_array_equal(back.parents, PARENTS)
    np.testing.assert_array_equal(back.joints, SKELETON.joints)
    assert back.names == SKELETON.names


@pytest.mark.parametrize(("change", "says"), [
    ({"version": 99}, "version 99 is not known here"),
    ({"kind": "model"}, "found something else"),
    ({"parents": [-1, 0, 5, 0]}, "part 2 has parent 5"),
    ({"joints": None}, "expected shape"),
    ({"names": None}, "expected a whole skeleton"),
])
def test_bad_files_say_what_is_wrong(tmp_path, change, says):
    SKELETON.save(tmp_path / "s.json")
    stored = json.loads((tmp_path / "s.json").read_text()) | change
    (tmp_path / "s.json").write_text(json.dumps(stored))
    with pytest.raises(StorageError, match=rf"s\.json: .*({says})"):
        Skeleton.load(tmp_path / "s.json")


@pytest.mark.parametrize(("part", "parents", "joints", "says"), [
    (PART, (0, 0, 1, 0), SKELETON.joints, "part 0 to be the root"),
    (PART, (-1, 2, 0, 0), SKELETON.joints, "part 1 has parent 2"),
    (PART, (-1, 1, 0, 0), SKELETON.joints, "part 1 has parent 1"),
    (np.minimum(PART, 2), PARENTS, SKELETON.joints, "every part"),
    (PART, PARENTS, SKELETON.joints[:2], r"joints: expected shape \(4, 3\)"),
])
def test_what_is_no_skeleton(part, parents, joints, says):
    with pytest.raises(ValueError, match=says):
        Skeleton(part, parents, joints)


@pytest.mark.parametrize("root", range(5))
def test_reordering_puts_the_root_first_and_parents_before_children(root):
    parents = [-1, 0, 1, 1, 3]
    part = np.repeat(np.arange(5), [5, 1, 4, 2, 3])
    order = reorder(part, np.array([(c, p) for c, p in enumerate(parents) if p >= 0]), root)
    assert order[0] == root and sorted(order) == list(range(5))
    links = {frozenset((c, p)) for c, p in enumerate(parents) if p >= 0}
    for i in range(1, 5):            # each new part hangs on exactly one that came before
        assert sum(frozenset((order[i], q)) in links for q in order[:i]) == 1
