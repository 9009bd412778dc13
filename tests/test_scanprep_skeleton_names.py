"""Names of people's parts: right on all builds and in all directions, left never right, and not given to animals."""
import numpy as np
import pytest
from animal_bodies import Animal, Build

from scanprep.geometry import rotations
from scanprep.geometry.mesh import Mesh
from scanprep.skeleton.edit import merge_parts
from scanprep.skeleton.names import name_parts, note_numbered_parts
from scanprep.skeleton.roles import find_roles, in_words, joint_in_words, limb_parts, missing_joints, part_name
from scanprep.skeleton.symmetry import find_symmetry
from scanprep.skeleton.tree import Skeleton
from scanprep.synthetic.people import BodyShape, SyntheticPerson

SIDES = "left", "right"


def unnamed(skeleton):
    return Skeleton(skeleton.part_of_face, skeleton.parents, skeleton.joints)


def named(mesh, skeleton):
    return name_parts(mesh, skeleton, find_symmetry(mesh))


@pytest.fixture(scope="module")
def person():
    return SyntheticPerson()


@pytest.mark.parametrize("seed", range(4))
def test_people_of_any_build_and_direction_are_named(seed):
    rng = np.random.default_rng(seed)
    body = SyntheticPerson(BodyShape.random(rng, sex=("male", "female")[seed % 2]))
    R, t = rotations.exp(rng.normal(0, 2, 3)), rng.normal(0, 3, 3)
    mesh = Mesh(body.mesh.vertices @ R.T + t, body.mesh.faces)
    skeleton = Skeleton(body.part_of_face, body.parents, body.joints @ R.T + t)
    assert named(mesh, skeleton) == body.names


def test_in_the_mirror_left_is_right(person):
    flip = np.array([1, -1, 1])
    mesh = Mesh(person.mesh.vertices * flip, person.mesh.faces[:, ::-1])
    found = named(mesh, Skeleton(person.part_of_face, person.parents, person.joints * flip))
    swapped = {"left": "right", "right": "left"}
    for name, true in zip(found, person.names, strict=True):
        stem, _, side = true.rpartition("_")
        assert name == (f"{stem}_{swapped[side]}" if side in swapped else true)


def test_the_limbs_of_a_pair_are_on_two_sides_of_a_body_that_leans(person):
    """Both legs were to the left of the middle of the hips, both became left, and learning ended there."""
    leaning, joints = (points + np.outer(np.maximum(0, 1 - points[:, 2]), [0.6, 0, 0])
                       for points in (person.mesh.vertices, person.joints))
    mesh, skeleton = Mesh(leaning, person.mesh.faces), Skeleton(person.part_of_face, person.parents, joints)
    assert name_parts(mesh, skeleton, find_symmetry(person.mesh)) == person.names


@pytest.mark.slow
def test_the_limbs_of_a_pair_have_the_same_segments(person):
    """An upper arm just short enough for a shoulder on one side alone gave the arms different names."""
    joints = person.joints.copy()
    elbow, shoulder = (person.names.index(f"{part}_left") for part in ("forearm", "upper_arm"))
    wrist = person.joints[person.names.index("hand_left")]
    for share in np.linspace(0.2, 0.5, 7):
        joints[elbow] = joints[shoulder] + share * (wrist - joints[shoulder])
        names = set(name_parts(person.mesh, Skeleton(person.part_of_face, person.parents, joints),
                               find_symmetry(person.mesh)))
        assert {name.removesuffix("_left") for name in names if name.endswith("_left")} == {
            name.removesuffix("_right") for name in names if name.endswith("_right")}


def test_parts_without_names_are_numbered_and_told(person):
    with pytest.warns(UserWarning, match="the parts are numbered.*edit-skeleton --rename"):
        note_numbered_parts(unnamed(person.skeleton))
    note_numbered_parts(person.skeleton)


@pytest.mark.slow
def test_coarser_and_finer_trees_are_named(person):
    mesh = person.mesh

    def names(skeleton):
        return set(named(mesh, unnamed(skeleton)))

    whole = set(person.names)
    two = merge_parts(person.skeleton, mesh, "pelvis", "abdomen")
    assert names(two) == whole - {"abdomen"}
    one = merge_parts(two, mesh, "pelvis", "chest")
    assert names(one) == whole - {"pelvis", "abdomen", "chest"} | {"trunk"}
    # the upper half of the abdomen as a part of its own, number 2
    height, part = mesh.corners[..., 2].mean(axis=1), person.part_of_face
    upper = (part == 1) & (height > np.median(height[part == 1]))
    parents = np.insert(person.parents + (person.parents >= 2), 2, 1)
    parents[3] = 2
    cut = Skeleton(np.where(upper, 2, part + (part >= 2)), parents,
                   np.insert(person.joints, 2, mesh.corners[upper].mean(axis=(0, 1)), axis=0))
    assert names(cut) == whole - {"abdomen"} | {"abdomen1", "abdomen2"}
    stumps = merge_parts(merge_parts(person.skeleton, mesh, "forearm_left", "hand_left"), mesh,
                         "forearm_right", "hand_right")
    assert names(stumps) == whole - {"hand_left", "hand_right"}


def test_a_head_that_never_moved_is_in_the_chest(person):
    mesh, whole = person.mesh, set(person.names)
    still = merge_parts(person.skeleton, mesh, "chest", "head")
    assert set(named(mesh, unnamed(still))) == whole - {"head"}
    stiff = merge_parts(merge_parts(still, mesh, "abdomen", "chest"), mesh, "pelvis", "abdomen")
    assert set(named(mesh, unnamed(stiff))) == whole - {"head", "pelvis", "abdomen", "chest"} | {"trunk"}


def test_joints_that_never_bent_are_told(person):
    """A leg whose knee was never seen to bend ends in a foot, not in a shin."""
    mesh, tree = person.mesh, person.skeleton
    assert missing_joints(tree.names, tree.joints) == []
    for side in SIDES:
        tree = merge_parts(tree, mesh, f"thigh_{side}", f"shin_{side}")
        tree = merge_parts(tree, mesh, f"upper_arm_{side}", f"forearm_{side}")
    found = named(mesh, unnamed(tree))
    assert {"leg_left", "foot_left", "arm_right", "hand_right"} < set(found)
    assert missing_joints(found, tree.joints) == ["elbows", "knees"]
    tree = merge_parts(tree, mesh, "chest", "head")
    assert missing_joints(named(mesh, unnamed(tree)), tree.joints) == ["neck", "elbows", "knees"]
    one_hand = merge_parts(person.skeleton, mesh, "forearm_left", "hand_left")
    assert missing_joints(one_hand.names, one_hand.joints) == ["left wrist"]
    assert missing_joints(("barrel", "neck", "tail"), np.zeros((3, 3))) == []


def test_what_is_no_person_keeps_its_names(person):
    mesh = person.mesh
    lame = unnamed(merge_parts(person.skeleton, mesh, "hand_left", "forearm_left"))
    assert named(mesh, lame) == lame.names
    for animal in (Animal(), Animal(Build(aside=0.0))):
        assert named(animal.mesh, animal.skeleton) == animal.skeleton.names
    tailless = Animal(Build(aside=0.0))
    skeleton = unnamed(merge_parts(tailless.skeleton, tailless.mesh, "barrel", "tail"))
    assert named(tailless.mesh, skeleton) == skeleton.names
    headless = merge_parts(merge_parts(skeleton, tailless.mesh, 0, 1), tailless.mesh, 0, 1)
    assert len(headless.parents) == 9 and named(tailless.mesh, headless) == headless.names


@pytest.mark.parametrize(("name", "part", "joint"), [
    ("forearm_left", "left forearm", "left elbow"), ("l_forearm", "left forearm", "left elbow"),
    ("upper_arm_right", "right upper arm", "right shoulder"),
    ("head", "head", "neck"), ("tail", "tail", "joint of the tail"),
    ("spine_2", "spine 2", "joint of the spine 2"), ("thigh2_left", "left thigh2", "joint of the left thigh2")])
def test_names_in_words(name, part, joint):
    assert in_words(name) == part and joint_in_words(name) == joint


@pytest.mark.parametrize("spelt", ["hand_left", "l_hand", "hand_l", "hand_L", "hand.L", "L_hand", "left_hand",
                                   "hand-left"])
def test_every_spelling_of_a_side_is_one_part(spelt):
    assert part_name(spelt) == "hand_left" and find_roles([spelt]) == {"l_wrist": 0}


OTHERS = {"upper_arm": "Arm", "forearm": "ForeArm", "hand": "Hand", "thigh": "UpLeg", "shin": "Leg", "foot": "Foot",
          "pelvis": "Hips", "abdomen": "Spine", "chest": "Spine2", "head": "Head"}


@pytest.mark.parametrize("spell", [
    lambda plain, side: f"{side[0]}_{plain}" if side else plain,  # ours of old
    lambda plain, side: f"mixamorig:{side.title()}{OTHERS[plain]}"], ids=["old", "mixamo"])
def test_limbs_are_found_whatever_program_named_them(person, spell):
    names = []
    for name in person.names:
        plain, _, side = name.rpartition("_") if name.endswith(("_left", "_right")) else (name, "", "")
        names.append(spell(plain, side))
    for limb, side in (("arm", "left"), ("arm", "right"), ("leg", "left"), ("leg", "right")):
        found = limb_parts(names, person.parents, person.joints, limb, side)
        assert found == limb_parts(person.names, person.parents, person.joints, limb, side)
        assert [person.names[p].removesuffix(f"_{side}") for p in found] == (
            ["upper_arm", "forearm", "hand"] if limb == "arm" else ["thigh", "shin", "foot"])
