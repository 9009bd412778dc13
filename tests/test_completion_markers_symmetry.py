"""Left and right: labels, places of the skin, markers."""
import numpy as np
import pytest

from completion.mocap.marker_sets.named import layout_names, load_layout
from completion.mocap.marker_sets.symmetry import find_skin_mirror, label_pairs
from scanprep.geometry.rotations import exp
from scanprep.geometry.sides import other_side, side_of
from scanprep.synthetic.people import SyntheticPerson
from scanprep.synthetic.topology import load_topology

PAIRS = [("LELB", "RELB"), ("L.Knee", "R.Knee"), ("left elbow", "right elbow"), ("Left Toe", "Right Toe"),
         ("LEFT_TOE", "RIGHT_TOE"), ("elbow_l", "elbow_r"), ("KneeL", "KneeR"), ("toe in left leg", "toe in right leg"),
         ("l_thigh", "r_thigh"), ("L.THIGH.1", "R.THIGH.1"), ("L1", "R1")]
MIDDLE = ["C7", "STRN", "CLAV", "T10", "V.Sacral", "Rear.Head", "ARIEL", "SJN", "tip of nose", "M.CHEST.1", "leftover",
          "Lumbar", "navel"]


@pytest.fixture(scope="module")
def person():
    return SyntheticPerson().mesh


@pytest.fixture(scope="module")
def mirror(person):
    return find_skin_mirror(person)


@pytest.mark.parametrize(("left", "right"), PAIRS)
def test_labels_name_their_partner(left, right):
    assert (other_side(left), other_side(right)) == (right, left)
    assert (side_of(left), side_of(right)) == (1, -1)


@pytest.mark.parametrize("label", MIDDLE)
def test_labels_of_the_middle_name_no_side(label):
    assert other_side(label) is None and side_of(label) == 0


def test_partners_by_label():
    assert label_pairs(["RELB", "C7", "LELB", "RBAC"]).tolist() == [2, 1, 0, -1]


def test_the_mirror_image_is_found_whatever_the_triangulation(person, mirror):
    true = person.vertices[load_topology().mirror]                           # known there, and not made use of
    off = np.linalg.norm(mirror.image(person) - true, axis=1)
    assert off.max() < 0.001 and (mirror.partner == load_topology().mirror).mean() > 0.999
    R, t = exp(np.array([1.0, 0.5, -2.0])), np.array([1.0, 2, 3])
    turned = person.with_vertices(person.vertices @ R.T + t)
    again = find_skin_mirror(turned)
    np.testing.assert_allclose(again.image(turned), mirror.image(person) @ R.T + t, atol=1e-4)
    np.testing.assert_allclose(np.abs(again.across), np.abs(mirror.across), atol=1e-4)


def test_the_mirror_image_moves_with_the_body(person, mirror):
    raised = np.zeros((16, 3))
    raised[4] = [0, -0.6, 0]                                         # one arm
    posed = person.with_vertices(SyntheticPerson().in_pose(raised))
    off = np.linalg.norm(mirror.image(posed) - posed.vertices[load_topology().mirror], axis=1)
    assert off.max() < 0.002 and np.linalg.norm(posed.vertices - person.vertices, axis=1).max() > 0.3


def test_who_does_not_stand_symmetrically_is_refused(person):
    body = person.with_vertices(SyntheticPerson().in_pose(np.random.default_rng(0).normal(0, 0.4, (16, 3))))
    with pytest.raises(ValueError, match=r"template: expected one that stands symmetrically, .* labels"):
        find_skin_mirror(body)


@pytest.mark.parametrize("name", layout_names())
def test_layouts_of_people_are_their_own_mirror_image(name, person, mirror):
    layout = load_layout(name, person)
    pairs = label_pairs(layout.labels)
    both = [i for i in range(len(pairs)) if pairs[i] >= 0 and layout.labels[i][1:] not in ("FRM", "THI", "TIB", "SHN",
                                                                                         "UPA", ".Shank", ".Thigh")]
    partner = layout.skin_points(person.vertices)[pairs[both]]
    assert np.linalg.norm(partner - layout.skin_points(mirror.image(person))[both], axis=1).max() < 0.001
