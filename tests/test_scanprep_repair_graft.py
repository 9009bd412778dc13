"""What a scan lacks of a person is grafted from the body that lies on it."""
from types import SimpleNamespace

import igl
import numpy as np
import pytest
from scanned_shapes import ball, joined, pierced

from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Surface
from scanprep.judgement import size
from scanprep.registration.matches import Fit
from scanprep.registration.nonrigid import choose_fit_that_stays, covers, register, share_doubled
from scanprep.repair.graft import find_missing, graft, with_islands
from scanprep.repair.hole_filling import close
from scanprep.surfaces.template import template_of_scan
from scanprep.synthetic.landmarks import landmarks
from scanprep.synthetic.topology import load_topology


@pytest.fixture(scope="module")
def person():
    return load_topology().mesh


@pytest.fixture(scope="module")
def without_a_finger_tip(person):
    tip = person.vertices[landmarks()["left middle finger"]]
    return pierced(person, tip, 0.03), tip


def test_a_finger_tip_that_was_cut_off_grows_again(person, without_a_finger_tip):
    scan, tip = without_a_finger_tip
    capped = close(scan)
    assert Surface(capped).closest(tip[None]).distances[0] > 0.02            # a patch is a stump
    whole, pieces = graft(scan, capped, Mesh(*igl.upsample(np.array(person.vertices), np.array(person.faces), 1)))
    whole = close(whole)
    assert pieces >= 1 and whole.is_closed and whole.is_edge_manifold
    assert Surface(whole).closest(person.vertices).distances.max() < 0.004
    # facing outward everywhere: as much volume as the person has
    assert whole.volume == pytest.approx(person.volume, rel=2e-3)


def test_a_hole_in_a_smooth_surface_is_left_to_its_patch(person):
    scan = pierced(person, person.vertices[landmarks()["navel"]], 0.03)
    same, pieces = graft(scan, close(scan), person)
    assert pieces == 0 and same is scan


def test_a_fit_that_fuses_two_fingers_is_not_kept():
    """The scan lacks one finger, here a ball; without data it slides into its neighbour, and the scan is covered."""
    one = ball(3)
    both = joined(one, one.with_vertices(one.vertices + [0.3, 0, 0]))
    second = np.arange(len(both.vertices)) >= len(one.vertices)
    fused, touching = (both.with_vertices(both.vertices - second[:, None] * [by, 0, 0]) for by in (0.3, 0.1))
    assert (share_doubled(both, both), share_doubled(both, touching), share_doubled(both, fused)) == (0, 0, 1)
    inputs = SimpleNamespace(template=both, size=size(both))
    kept = choose_fit_that_stays(inputs, both.vertices, one, [lambda: Fit(fused.vertices), lambda: Fit(both.vertices)])
    assert kept.x is both.vertices


@pytest.mark.slow
def test_a_template_has_the_fingers_that_its_scan_lacks(person, without_a_finger_tip):
    scan, tip = without_a_finger_tip
    made = template_of_scan(scan, 8000, person=person)
    assert Surface(made.mesh).closest(tip[None]).distances[0] < 0.008
    assert any("piece" in note for note in made.notes)
    assert Surface(template_of_scan(scan, 8000).mesh).closest(tip[None]).distances[0] > 0.015


@pytest.mark.slow
def test_a_body_on_the_scan_keeps_its_fingers(person):
    scan = person.sample(20_000, np.random.default_rng(0))[0]
    fit = register(person, scan, start=person.vertices)
    assert covers(person, scan, size(person))
    tips = person.vertices[[landmarks()[f"{side} middle finger"] for side in ("left", "right")]]
    # the points are 10 mm apart
    assert Surface(fit.mesh).closest(tips).distances.max() < 0.010
    # a body beside the scan is brought there by the graph first
    assert not covers(person, scan + [0, 0.05, 0], size(person))


def test_a_piece_takes_what_it_encloses_and_the_largest_comes_first(person):
    """A missing toe that touches the patch of its hole in one place is still one piece with one rim."""
    tip, navel = (person.vertices[landmarks()[name]] for name in ("left middle finger", "navel"))
    middle = person.corners.mean(axis=1)
    ring = np.linalg.norm(middle - navel, axis=1)
    chosen = (ring < 0.06) & (ring > 0.03)
    assert len(person.submesh(chosen)[0].boundary_loops) > 1
    whole = with_islands(person, chosen)
    assert (whole >= chosen).all() and whole[ring < 0.02].all() and not whole[ring > 0.08].any()
    assert len(person.submesh(whole)[0].boundary_loops) == 1
    # of the person without a foot and a finger tip, the foot is found first
    heel = person.vertices[landmarks()["left heel"]]
    scan = pierced(pierced(person, heel, 0.12), tip, 0.03)
    missing = find_missing(close(scan), person)
    areas = [person.face_areas[one].sum() for one in missing]
    assert len(areas) >= 2 and areas == sorted(areas, reverse=True)
    assert np.linalg.norm(middle[missing[0]].mean(axis=0) - heel) < 0.15
