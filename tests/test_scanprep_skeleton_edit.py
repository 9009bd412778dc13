"""Skeletons changed by hand: what is merged, renamed and moved, and how wrong edits are refused."""
import json

import numpy as np
import pytest

from scanprep.skeleton.edit import apply_edits, merge_parts, move_joint, read_edits, rename_part
from scanprep.skeleton.tree import Skeleton
from scanprep.synthetic.people import SyntheticPerson


@pytest.fixture(scope="module")
def person():
    return SyntheticPerson()


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
    parents = np.where(person.parents == 1, 0, person.parents)                # the chest hangs on the pelvis
    both = Skeleton(person.part_of_face, parents, person.joints, person.names)
    after = merge_parts(both, person.mesh, "chest", "abdomen")
    assert parent(after, "chest") == "pelvis" and parent(after, "head") == "chest"
    np.testing.assert_allclose(joint(after, "chest"), person.joints[1:3].mean(axis=0))


def test_names_and_joints_change_alone(person):
    before = person.skeleton
    named = rename_part(before, "head", "skull")
    assert named.names[3] == "skull" and np.array_equal(named.joints, before.joints)
    moved = move_joint(named, "skull", (0.0, 0.1, 1.5))
    assert joint(moved, "skull").tolist() == [0.0, 0.1, 1.5]
    assert np.array_equal(np.delete(moved.joints, 3, axis=0), np.delete(before.joints, 3, axis=0))


def test_a_file_of_edits_is_carried_out_in_order(person, tmp_path):
    edits = [{"rename": {"hand_left": "palm", "head": "skull"}}, {"merge": ["forearm_left", "palm"]},
             {"move_joint": "forearm_left", "position": [0.5, 0.0, 1.0]}, {"merge": ["0", 1]}]
    path = tmp_path / "edits.json"
    path.write_text(json.dumps(edits))
    after = apply_edits(person.skeleton, person.mesh, read_edits(path))
    by_hand = rename_part(rename_part(person.skeleton, "hand_left", "palm"), "head", "skull")
    by_hand = merge_parts(by_hand, person.mesh, "forearm_left", "palm")
    by_hand = merge_parts(move_joint(by_hand, "forearm_left", (0.5, 0.0, 1.0)), person.mesh, 0, 1)
    assert after.names == by_hand.names and after.joints.tobytes() == by_hand.joints.tobytes()
    assert np.array_equal(after.part_of_face, by_hand.part_of_face)


@pytest.mark.parametrize(("edit", "message"), [
    ({"merge": ["hand_left", "hand_right"]}, "neither linked nor on the same part"),
    ({"merge": ["head", "upper_arm_left"]}, "'head' and 'upper_arm_left' do not touch"),
    ({"merge": ["head", "head"]}, "expected two different parts, got 'head' twice"),
    ({"merge": "head"}, "expected a list of two parts"),
    ({"merge": ["wing", "head"]}, "expected one of pelvis, .* got 'wing'"),
    ({"rename": {"head": "chest"}}, "'chest' is part 2 already"),
    ({"rename": {"head": "7"}}, "not a number"),
    ({"rename": "head"}, "expected {old: new}"),
    ({"move_joint": "pelvis", "position": [0, 0, 1]}, "'pelvis' is the root"),
    ({"move_joint": "head"}, "expected a position"),
    ({"move_joint": "head", "position": [0, 0]}, "three finite numbers"),
    ({"move_joint": 99, "position": [0, 0, 1]}, "a number below 16, got 99"),
    ({"split": "head"}, "expected one of merge, rename, move_joint, found"),
    ({"merge": ["head", "chest"], "rename": {}}, "expected one of merge, rename, move_joint, found"),
    ({"merge": ["head", "chest"], "force": True}, "merge does not know force")])
def test_a_wrong_edit_is_refused_by_number_and_words(person, edit, message):
    with pytest.raises(ValueError, match=message) as caught:
        apply_edits(person.skeleton, person.mesh, [{"rename": {"head": "head"}}, edit])
    assert str(caught.value).startswith("edits: entry 2, {")


def test_a_skeleton_of_another_template_is_refused(person):
    small = person.mesh.submesh(np.arange(len(person.mesh.faces)) < 100)[0]
    with pytest.raises(ValueError, match=r"template: expected the \d+ triangles of the skeleton, got"):
        apply_edits(person.skeleton, small, [])
