"""Skeletons changed by hand: what is merged, split, renamed and moved, and how wrong edits are refused."""
import json

import numpy as np
import pytest

from scanprep.geometry.storage import StorageError
from scanprep.skeleton.edit import (
    apply_edits,
    find_part_number,
    merge_parts,
    move_joint,
    read_edits,
    rename_part,
    split_part,
)
from scanprep.skeleton.labels import label_patches
from scanprep.synthetic.people import SyntheticPerson
from scanprep.synthetic.poses import find_pose


@pytest.fixture(scope="module")
def person():
    return SyntheticPerson()


@pytest.fixture(scope="module")
def poses(person):
    return np.stack([person.in_pose(find_pose(name)) for name in ("sitting", "twist_left", "bow", "run", "boxer")])


def faces(skeleton, name):
    return skeleton.part_of_face == skeleton.names.index(name)


def parent(skeleton, name):
    return skeleton.names[skeleton.parents[skeleton.names.index(name)]]


def joint(skeleton, name):
    return skeleton.joints[skeleton.names.index(name)]


def root_centre(skeleton, mesh):
    return mesh.vertices[skeleton.part_of_vertex(mesh) == 0].mean(axis=0)


def test_linked_parts_merge_and_nothing_else_changes(person):
    before = person.skeleton
    after = merge_parts(before, person.mesh, "chest", "abdomen")
    assert set(after.names) == set(before.names) - {"abdomen"}
    assert np.array_equal(faces(after, "chest"), faces(before, "chest") | faces(before, "abdomen"))
    assert parent(after, "chest") == "pelvis" and parent(after, "head") == "chest"
    assert np.array_equal(joint(after, "chest"), joint(before, "abdomen"))
    for name in set(after.names) - {"chest", "pelvis"}:
        assert np.array_equal(joint(after, name), joint(before, name))
        assert np.array_equal(faces(after, name), faces(before, name))


def test_merging_into_the_root_moves_its_centre(person):
    after = merge_parts(person.skeleton, person.mesh, "abdomen", 0)
    assert after.names[0] == "abdomen" and len(after.parents) == 15
    np.testing.assert_allclose(after.joints[0], root_centre(after, person.mesh), atol=1e-12)
    assert {parent(after, name) for name in ("chest", "thigh_left", "thigh_right")} == {"abdomen"}


def test_parts_that_hang_on_the_same_one_merge_between_their_joints(person):
    halves = split_part(merge_parts(person.skeleton, person.mesh, "hand_left", "forearm_left"), person.mesh, "chest")
    assert parent(halves, "chest_2") == "chest"
    siblings = [name for name in halves.names if parent(halves, name) == "chest_2"]
    touching = merge_parts(halves, person.mesh, "chest", "chest_2")
    assert len(touching.parents) == 15 and siblings
    assert {parent(touching, name) for name in siblings} == {"chest"}


def test_a_part_is_split_across_its_length_into_connected_halves(person):
    mesh, before = person.mesh, person.skeleton
    after = split_part(before, mesh, "thigh_left", names=("thigh_top", "thigh_end"))
    top, end = faces(after, "thigh_top"), faces(after, "thigh_end")
    assert np.array_equal(top | end, faces(before, "thigh_left"))
    for half in (top, end):
        assert len(np.unique(label_patches(mesh.face_pairs, np.where(half, 0, 1))[half])) == 1
        assert mesh.face_areas[half].sum() > 0.3 * mesh.face_areas[faces(before, "thigh_left")].sum()
    assert parent(after, "thigh_top") == "pelvis" and parent(after, "thigh_end") == "thigh_top"
    assert parent(after, "shin_left") == "thigh_end"
    hip, knee = joint(before, "thigh_left"), joint(before, "shin_left")
    along = (joint(after, "thigh_end") - hip) @ (knee - hip) / ((knee - hip) @ (knee - hip))
    assert 0.3 < along < 0.7
    assert np.linalg.norm(joint(after, "thigh_end") - (hip + along * (knee - hip))) < 0.045  # flesh is ahead of bone
    assert np.abs(after.joint_regressor(mesh) @ mesh.vertices - after.joints).max() < 1e-9


def test_poses_show_where_a_merged_part_bends(person, poses):
    """An arm made one part comes apart at its elbow again."""
    joined = merge_parts(person.skeleton, person.mesh, "upper_arm_left", "forearm_left")
    again = split_part(joined, person.mesh, "upper_arm_left", poses, ("upper_arm_left", "forearm_left"))
    assert again.names == person.skeleton.names and np.array_equal(again.parents, person.parents)
    differ = person.mesh.face_areas[again.part_of_face != person.part_of_face].sum()
    assert differ < 0.15 * person.mesh.face_areas[faces(joined, "upper_arm_left")].sum()
    assert np.linalg.norm(joint(again, "forearm_left") - joint(person.skeleton, "forearm_left")) < 0.02
    with pytest.raises(ValueError, match="'foot_left' cannot be cut in two, it does not bend in these poses"):
        split_part(person.skeleton, person.mesh, "foot_left", np.stack([person.mesh.vertices + k for k in range(3)]))


def test_the_split_of_the_root_keeps_the_tree(person):
    after = split_part(person.skeleton, person.mesh, "pelvis")
    assert parent(after, "pelvis_2") == "pelvis"
    np.testing.assert_allclose(after.joints[0], root_centre(after, person.mesh), atol=1e-12)


def test_names_and_joints_change_alone(person):
    mesh, before = person.mesh, person.skeleton
    named = rename_part(before, "head", "skull")
    assert named.names[3] == "skull" and np.array_equal(named.joints, before.joints)
    moved = move_joint(named, mesh, "skull", position=(0.0, 0.1, 1.5))
    assert joint(moved, "skull").tolist() == [0.0, 0.1, 1.5]
    ring = before.ring(mesh, 3)
    centred = move_joint(named, mesh, 3, ring=ring.tolist())
    assert np.linalg.norm(joint(centred, "skull") - mesh.vertices[ring].mean(axis=0)) < 0.01
    for other in (moved, centred):
        assert np.array_equal(np.delete(other.joints, 3, axis=0), np.delete(before.joints, 3, axis=0))


def test_a_file_of_edits_is_carried_out_in_order(person, tmp_path):
    edits = [{"rename": {"hand_left": "palm", "head": "skull"}}, {"merge": ["forearm_left", "palm"]},
             {"split": "forearm_left", "names": ["forearm_left", "hand_left"]},
             {"move_joint": "hand_left", "position": [0.5, 0.0, 1.0]}, {"merge": ["0", 1]}]
    path = tmp_path / "edits.json"
    path.write_text(json.dumps(edits))
    after = apply_edits(person.skeleton, person.mesh, read_edits(path))
    by_hand = rename_part(rename_part(person.skeleton, "hand_left", "palm"), "head", "skull")
    by_hand = split_part(merge_parts(by_hand, person.mesh, "forearm_left", "palm"), person.mesh, "forearm_left",
                         names=("forearm_left", "hand_left"))
    by_hand = merge_parts(move_joint(by_hand, person.mesh, "hand_left", (0.5, 0.0, 1.0)), person.mesh, 0, 1)
    assert after.names == by_hand.names and after.joints.tobytes() == by_hand.joints.tobytes()
    assert np.array_equal(after.part_of_face, by_hand.part_of_face)


@pytest.mark.parametrize(("edit", "message"), [
    ({"merge": ["hand_left", "hand_right"]}, "neither linked nor on the same part"),
    ({"merge": ["head", "upper_arm_left"]}, "'head' and 'upper_arm_left' do not touch"),
    ({"merge": ["head", "head"]}, "expected two different parts, got 'head' twice"),
    ({"merge": "head"}, "expected a list of two parts"),
    ({"split": "wing"}, "expected one of pelvis, .* got 'wing'"),
    ({"split": "head", "names": ["a"]}, "expected two"),
    ({"split": "head", "names": ["chest", "a"]}, "different names"),
    ({"rename": {"head": "chest"}}, "'chest' is part 2 already"),
    ({"rename": {"head": "7"}}, "not a number"),
    ({"rename": "head"}, "expected {old: new}"),
    ({"move_joint": "pelvis", "position": [0, 0, 1]}, "'pelvis' is the root"),
    ({"move_joint": "head"}, "expected one of the two"),
    ({"move_joint": "head", "position": [0, 0]}, "three finite numbers"),
    ({"move_joint": "head", "ring": [1, 2, 10**6]}, "expected at least three vertices"),
    ({"move_joint": 99, "position": [0, 0, 1]}, "a number below 16, got 99"),
    ({"turn": "head"}, "expected one of merge, split, rename, move_joint, found"),
    ({"merge": ["head", "chest"], "split": "head"}, "expected one of merge, split, rename, move_joint, found"),
    ({"merge": ["head", "chest"], "force": True}, "merge does not know force")])
def test_a_wrong_edit_is_refused_by_number_and_words(person, edit, message):
    with pytest.raises(ValueError, match=message) as caught:
        apply_edits(person.skeleton, person.mesh, [{"rename": {"head": "head"}}, edit])
    assert str(caught.value).startswith("edits: entry 2, {")


def test_files_that_hold_no_edits_are_refused(tmp_path):
    path = tmp_path / "edits.json"
    for text, message in (("[{", "cannot read it"), ('{"merge": 1}', "found something else")):
        path.write_text(text)
        with pytest.raises(StorageError, match=message):
            read_edits(path)
    with pytest.raises(StorageError, match="no such file"):
        read_edits(tmp_path / "none.json")


def test_parts_are_known_by_name_and_number(person):
    assert [find_part_number(person.skeleton, part) for part in ("head", 3, "3", np.int64(3))] == [3, 3, 3, 3]
    for wrong in (-1, 16, True, "Head", None):
        with pytest.raises(ValueError, match="part: expected one of"):
            find_part_number(person.skeleton, wrong)


def test_a_skeleton_of_another_template_is_refused(person):
    small = person.mesh.submesh(np.arange(len(person.mesh.faces)) < 100)[0]
    with pytest.raises(ValueError, match=r"template: expected the \d+ triangles of the skeleton, got"):
        apply_edits(person.skeleton, small, [])
