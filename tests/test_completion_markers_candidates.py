"""Candidates for marker sets: symmetric, spread out, where a marker can sit."""
from itertools import pairwise

import numpy as np
import pytest

from completion.mocap.marker_selection.candidates import candidate_layout, sitting_room
from completion.mocap.marker_sets.layout import DISTANCE, MarkerLayout
from completion.mocap.marker_sets.named import load_layout
from completion.mocap.marker_sets.symmetry import find_skin_mirror, label_pairs
from scanprep.geometry.geodesics import SurfaceGraph
from scanprep.geometry.rotations import exp
from scanprep.synthetic.landmarks import landmarks
from scanprep.synthetic.people import SyntheticPerson
from scanprep.synthetic.topology import load_topology


@pytest.fixture(scope="module")
def person():
    return SyntheticPerson().mesh


@pytest.fixture(scope="module")
def mirror(person):
    return find_skin_mirror(person)


@pytest.fixture(scope="module")
def base(person):
    return load_layout("vicon47", person)


@pytest.fixture(scope="module")
def candidates(person, mirror, base):
    return candidate_layout(person, base, 114, mirror=mirror, skeleton=SyntheticPerson().skeleton)


def test_there_are_as_many_as_wanted_and_the_base_is_first(candidates, base):
    assert len(candidates.labels) == 114 and candidates.labels[:47] == base.labels
    np.testing.assert_array_equal(candidates.vertices[:47], base.vertices)
    assert candidates.loose == base.loose and candidates.aliases == base.aliases
    assert (np.asarray(candidates.distances)[47:] == DISTANCE).all()


def test_every_candidate_has_its_mirror_image(candidates, person):
    pairs = label_pairs(candidates.labels)
    assert (pairs >= 0).all() and (pairs[pairs] == np.arange(114)).all()
    image = person.vertices[load_topology().mirror[candidates.vertices]]              # the true one
    assert np.linalg.norm(image - person.vertices[candidates.vertices[pairs]], axis=1)[47:].max() < 0.03
    own = pairs == np.arange(114)
    assert np.abs(person.vertices[candidates.vertices[own], 0]).max() < 0.02
    left = [label[0] == "L" for label in candidates.labels[47:]]
    assert (person.vertices[candidates.vertices[47:][left], 0] > 0.02).all()


def test_candidates_are_spread_over_the_skin(candidates, person):
    apart = SurfaceGraph(person).distances(candidates.vertices)[:, candidates.vertices]
    np.fill_diagonal(apart, np.inf)
    nearest = apart.min(axis=1)
    assert nearest[47:].min() > 0.05
    gaps = [nearest_before(apart, i) for i in range(47, 114)]                # each as far as the one before, or less
    pairs = label_pairs(candidates.labels)
    assert all(b < a + 0.02 for a, b in pairwise(gaps)) and (pairs[47:] != np.arange(47, 114)).any()


def nearest_before(apart, i):
    return apart[i, :i].min()


def test_labels_name_the_part(candidates, person):
    skeleton = SyntheticPerson().skeleton
    parts = skeleton.part_of_vertex(person)[candidates.vertices]
    for label, part in list(zip(candidates.labels, parts, strict=True))[47:]:
        side, stem, number = label.split(".")
        name = skeleton.names[part]
        sided = {"L": "left", "R": "right"}.get(side, "")
        assert int(number) > 0 and (name.endswith(sided) or name in ("chest", "abdomen", "pelvis", "head"))
        if side != "R":                                                      # the partner is named after the left one
            assert stem == name.removesuffix("_left").upper()


@pytest.mark.slow
def test_nobody_can_wear_markers_there(person, mirror):
    free = sitting_room(person, mirror)
    near = SurfaceGraph(person)
    for name in ("left armpit", "crotch", "left middle finger", "right thumb", "left toe", "right ear"):
        at = int(landmarks[name]) if isinstance(landmarks, dict) else int(landmarks()[name])
        assert not free[near.distances(at, limit=0.02) < 0.01].any(), name
    soles = (person.vertices[:, 2] < person.vertices[:, 2].min() + 0.01) & (person.vertex_normals[:, 2] < -0.8)
    assert soles.sum() > 30 and not free[soles].any()
    assert 0.5 < np.average(free, weights=person.vertex_areas) < 0.9


@pytest.mark.slow
def test_a_turned_body_has_the_same_candidates(candidates, person, base):
    turned = person.with_vertices(person.vertices @ exp(np.array([1.0, 0.5, -2.0])).T + 3)
    again = candidate_layout(turned, base, 114, skeleton=SyntheticPerson().skeleton)
    assert again.labels == candidates.labels and (again.vertices == candidates.vertices).mean() > 0.95


def test_a_lonely_marker_gets_its_partner(person, mirror, base):
    lopsided = base.without(["LBAC", "RELB"])
    whole = candidate_layout(person, lopsided, 47, mirror=mirror)
    assert set(whole.labels) == set(base.labels) and set(whole.loose) == set(base.loose)
    place = dict(zip(whole.labels, person.vertices[whole.vertices], strict=True))
    for label in ("LBAC", "RELB"):
        assert np.linalg.norm(place[label] - person.vertices[base.vertices[base.labels.index(label)]]) < 0.02


def test_what_cannot_be_done_is_refused(person, mirror, base):
    with pytest.raises(ValueError, match="count: expected at least the 47 markers of the base"):
        candidate_layout(person, base, 46, mirror=mirror)
    with pytest.raises(ValueError, match="base: expected labels that tell left from right"):
        candidate_layout(person, MarkerLayout(("C7", "CLAV"), base.vertices[:2]), 10, mirror=mirror)
