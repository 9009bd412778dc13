import numpy as np
import pytest

from scanprep.geometry import rotations
from scanprep.geometry.target import target_of
from scanprep.judgement import size
from scanprep.pipeline.scan import size_doubts
from scanprep.registration.limb_ends import RigidFit, find_ends, rotate_ends
from scanprep.registration.limbs import frames, hidden_doubts, limb_doubts, part_angles, part_bending, rolls
from scanprep.registration.person import PersonParts, average_person
from scanprep.skeleton.tree import Skeleton
from scanprep.synthetic.people import NAMED_POSES, PARTS, find_pose

rng = np.random.default_rng(4)


@pytest.fixture(scope="module")
def person():
    return average_person()


@pytest.fixture(scope="module")
def parts(person):
    """The parts of a template that is the average person itself, but stands differently in its own frame."""
    skeleton = Skeleton(person.part_of_face, person.parents, person.joints, PARTS)
    return PersonParts(skeleton, np.broadcast_to(np.eye(3), (len(PARTS), 3, 3)))


def words(person, parts, vertices):
    return [doubt.words for doubt in limb_doubts(person.mesh, parts, vertices)]


def test_a_roll_about_an_axis_is_what_was_put_in():
    axis, angle = rotations.exp(rng.normal(size=3)) @ np.array([0, 0, 1.0]), 2.3
    tilt = np.cross(axis, rng.normal(size=3))                        # no roll: about an axis across
    assert np.isclose(rolls(rotations.exp(tilt) @ rotations.exp(angle * axis), axis), angle)


def test_angles_are_those_that_a_joint_was_given(person):
    pose = np.zeros((len(PARTS), 3))
    forearm, shin = PARTS.index("forearm_left"), PARTS.index("shin_right")
    pose[forearm], pose[shin] = np.radians(40) * frames()[forearm, 1], np.radians(-25) * frames()[shin, 0]
    angles = part_angles(person.part_rotations(pose))
    wanted = np.zeros((len(PARTS), 3))
    wanted[forearm, 1], wanted[shin, 0] = 40, -25
    assert np.allclose(angles, wanted, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMED_POSES[::7])
def test_what_people_do_is_not_doubted(person, parts, name):
    turned = person.in_pose(find_pose(name)) @ rotations.exp(np.array([0.3, -2.0, 0.5])).T
    assert not words(person, parts, turned)


@pytest.mark.parametrize("part, name, parent", [("forearm_left", "left forearm", "left upper arm"),
                                                ("shin_right", "right shin", "right thigh"), ("head", "head", "chest")])
def test_a_limb_rolled_about_its_own_axis_is_told(person, parts, part, name, parent):
    pose, p = np.zeros((len(PARTS), 3)), PARTS.index(part)
    pose[p] = np.radians(150) * frames()[p, 0]
    first = words(person, parts, person.in_pose(pose))[0]
    assert first.startswith(f"the {name} is rolled by ") and first.endswith(f" degrees against the {parent}")
    assert 130 < int(first.split(" by ")[1].split()[0]) < 165        # skin lags behind bones


def test_skin_that_slid_is_told(person, parts):
    """The skin of a head, taken round the head by a quarter while the head stays where it is."""
    from scanprep.geometry.surface import Surface

    mine, p = person.part_of_vertex == PARTS.index("head"), PARTS.index("head")
    middle = person.mesh.vertices[mine].mean(axis=0)
    around = rotations.exp(np.pi / 2 * frames()[p, 0])
    slid = person.mesh.vertices.copy()
    slid[mine] = Surface(person.mesh).closest((slid[mine] - middle) @ around.T + middle).points
    assert any(text.startswith("the skin of the head is ") for text in words(person, parts, slid))


def test_a_limb_drawn_into_the_body_is_told(person, parts):
    p = PARTS.index("forearm_left")
    mine = person.part_of_vertex == p
    small = person.mesh.vertices.copy()
    small[mine] = person.joints[p] + 0.7 * (small[mine] - person.joints[p])
    assert "the left forearm is 30% smaller than on the template" in words(person, parts, small)


def test_growth_of_the_whole_body_is_no_bending(person, parts):
    bending, growth = part_bending(person.mesh, parts.skeleton, 1.2 * person.mesh.vertices + 3)
    assert np.abs(bending).max() < 1e-9 and np.allclose(growth, np.log(1.2))
    assert not words(person, parts, 1.2 * person.mesh.vertices)


def test_a_hand_bent_at_the_wrist_is_found(person):
    """The template's hand points along the arm, the scan's is bent to some side."""
    template, pose, hand = person.mesh, np.zeros((len(PARTS), 3)), PARTS.index("hand_left")
    end = next(end for end in find_ends(template, 5, 0.14 * size(template))
               if (person.part_of_vertex[end.vertices] == hand).any())
    mine = np.flatnonzero(person.part_of_vertex[end.vertices] == hand)
    for axis, degrees in ((1, 50), (1, 80), (2, -40), (2, 80)):    # farther back: as one turned over
        pose[hand] = np.radians(degrees) * frames()[hand, axis]
        scan = template.with_vertices(person.in_pose(pose))
        tried = rotate_ends(template, end, template.vertices, RigidFit(target_of(scan), size(template)))
        off = min(np.linalg.norm(places[mine] - scan.vertices[end.vertices[mine]], axis=1).mean() for places in tried)
        assert off < 0.025, (axis, degrees)


@pytest.mark.parametrize(("scale", "excess", "word"), [(1.0, None, ""), (0.7, 1.0, "a child"), (0.3, 2.0, "scale")])
def test_a_set_says_of_a_scan_that_it_has_the_size_of_no_adult(person, parts, scale, excess, word):
    found = size_doubts(person.mesh, parts, scale * person.mesh.vertices)
    assert [doubt.excess for doubt in found] == ([] if excess is None else [excess])
    assert all(word in doubt.words for doubt in found)


def test_limbs_that_no_view_shows_are_named(person, parts):
    """From the front every limb shows its half; a hand behind the back, and legs behind a table, show nothing."""
    front = person.mesh.vertex_normals[:, 1] < 0
    assert not hidden_doubts(parts, person.mesh, front)
    behind = person.part_of_vertex == PARTS.index("hand_left")
    words = [doubt.words for doubt in hidden_doubts(parts, person.mesh, front & ~behind)]
    assert words == ["hardly anything of the left hand was seen: its place is a guess"]
    legs = [f"{part}_{side}" for side in ("left", "right") for part in ("shin", "foot")]
    below = np.isin(person.part_of_vertex, [PARTS.index(name) for name in legs])
    assert len(hidden_doubts(parts, person.mesh, ~below)) == len(legs)
