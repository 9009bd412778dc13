"""Names of people's parts: right on all builds and in all directions, left never right, and not given to animals."""
import numpy as np
import pytest
from animal_bodies import Animal, Build

from scanprep.geometry import rotations
from scanprep.geometry.mesh import Mesh
from scanprep.skeleton.edit import merge_parts, split_part
from scanprep.skeleton.names import in_words, joint_in_words, name_parts
from scanprep.skeleton.symmetry import find_symmetry
from scanprep.skeleton.tree import Skeleton
from scanprep.synthetic.people import BodyShape, Person


def expected(name):
    """`l_upper_arm` of the synthetic people as `upper_arm_left`."""
    return f"{name[2:]}_{'left' if name[0] == 'l' else 'right'}" if name[1] == "_" else name


def unnamed(skeleton):
    return Skeleton(skeleton.part_of_face, skeleton.parents, skeleton.joints)


def named(mesh, skeleton):
    return name_parts(mesh, skeleton, find_symmetry(mesh))


@pytest.fixture(scope="module")
def person():
    return Person()


@pytest.mark.parametrize("seed", range(4))
def test_people_of_any_build_and_direction_are_named(seed):
    rng = np.random.default_rng(seed)
    body = Person(BodyShape.random(rng, sex=1.0 - 2 * (seed % 2)))
    R, t = rotations.exp(rng.normal(0, 2, 3)), rng.normal(0, 3, 3)
    mesh = Mesh(body.mesh.vertices @ R.T + t, body.mesh.faces)
    skeleton = Skeleton(body.part_of_face, body.parents, body.joints @ R.T + t)
    assert named(mesh, skeleton) == tuple(map(expected, body.names))


def test_in_the_mirror_left_is_right(person):
    flip = np.array([1, -1, 1])
    mesh = Mesh(person.mesh.vertices * flip, person.mesh.faces[:, ::-1])
    found = named(mesh, Skeleton(person.part_of_face, person.parents, person.joints * flip))
    swapped = {"left": "right", "right": "left"}
    for name, true in zip(found, map(expected, person.names), strict=True):
        stem, _, side = true.rpartition("_")
        assert name == (f"{stem}_{swapped[side]}" if side in swapped else true)


def test_the_order_of_vertices_and_parts_does_not_matter(person):
    rng = np.random.default_rng(0)
    old, faces = rng.permutation(len(person.mesh.vertices)), rng.permutation(len(person.mesh.faces))
    mesh = Mesh(person.mesh.vertices[old], np.argsort(old)[person.mesh.faces[faces]])
    found = named(mesh, Skeleton(person.part_of_face[faces], person.parents, person.joints))
    assert found == tuple(map(expected, person.names))


def test_coarser_and_finer_trees_are_named(person):
    mesh = person.mesh

    def names(skeleton):
        return set(named(mesh, unnamed(skeleton)))

    whole = set(map(expected, person.names))
    two = merge_parts(person.skeleton, mesh, "pelvis", "abdomen")
    assert names(two) == whole - {"abdomen"}
    one = merge_parts(two, mesh, "pelvis", "chest")
    assert names(one) == whole - {"pelvis", "abdomen", "chest"} | {"trunk"}
    three = split_part(person.skeleton, mesh, "abdomen")
    assert names(three) == whole - {"abdomen"} | {"abdomen1", "abdomen2"}
    stumps = merge_parts(merge_parts(person.skeleton, mesh, "l_forearm", "l_hand"), mesh, "r_forearm", "r_hand")
    assert names(stumps) == whole - {"hand_left", "hand_right"}


def test_what_is_no_person_keeps_its_names(person):
    mesh = person.mesh
    lame = unnamed(merge_parts(person.skeleton, mesh, "l_hand", "l_forearm"))
    assert named(mesh, lame) == lame.names
    headless = unnamed(merge_parts(person.skeleton, mesh, "chest", "head"))
    assert named(mesh, headless) == headless.names
    for animal in (Animal(), Animal(Build(aside=0.0))):
        assert named(animal.mesh, animal.skeleton) == animal.skeleton.names
    tailless = Animal(Build(aside=0.0))
    skeleton = unnamed(merge_parts(tailless.skeleton, tailless.mesh, "barrel", "tail"))
    assert named(tailless.mesh, skeleton) == skeleton.names


@pytest.mark.parametrize(("name", "part", "joint"), [
    ("forearm_left", "left forearm", "left elbow"), ("upper_arm_right", "right upper arm", "right shoulder"),
    ("head", "head", "neck"), ("tail", "tail", "joint of the tail"),
    ("spine_2", "spine 2", "joint of the spine 2"), ("thigh2_left", "left thigh2", "joint of the left thigh2")])
def test_names_in_words(name, part, joint):
    assert in_words(name) == part and joint_in_words(name) == joint
