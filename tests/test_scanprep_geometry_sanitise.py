import warnings

import numpy as np
import pytest
from scanned_shapes import ball

from scanprep.cleaning.clean_scan import clean_scan
from scanprep.geometry.mesh import Mesh, template_problem
from scanprep.geometry.places import spacing
from scanprep.geometry.sanitise import _agree_with_camera, invert_triangles, sanitise
from scanprep.geometry.surface import Rays
from scanprep.geometry.target import target_of
from scanprep.geometry.thinning import thin_scan
from scanprep.synthetic.people import SyntheticPerson


@pytest.fixture(scope="module")
def person():
    return SyntheticPerson().mesh


@pytest.fixture(scope="module", params=[0, 1, 2])
def half(request, person):
    """What is seen of a person from one side."""
    angle = 137.5 * np.pi / 180 * request.param
    towards = np.array([np.cos(angle), np.sin(angle), 0.1])
    middle = person.corners.mean(axis=1)
    hidden = Rays(person).test_occlusion(middle + 1e-4 * towards, np.broadcast_to(towards / np.linalg.norm(towards),
                                                                                  middle.shape))
    return person.submesh((person.face_normals @ towards > 0.15) & ~hidden)[0]


def quietly(mesh):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return sanitise(mesh)


def told(mesh, words):
    with pytest.warns(UserWarning, match=words) as caught:
        sound = sanitise(mesh)
    assert len(caught) == 1 and np.array_equal(sound.vertices, mesh.vertices)
    assert quietly(sound) is sound
    return sound


def wrong_share(found, right):
    assert len(found.faces) == len(right.faces)
    return right.face_areas[(found.faces != right.faces).any(axis=1)].sum() / right.face_areas.sum()


def test_what_is_right_stays_the_very_same(person, half):
    assert quietly(person) is person and quietly(half) is half


def test_all_inside_out_is_turned(person, half):
    for right in (person, half):
        turned = Mesh(right.vertices, invert_triangles(right.faces, np.ones(len(right.faces), dtype=bool)))
        assert wrong_share(told(turned, "faced inward and were turned"), right) < 0.005


def test_patches_that_face_different_ways_are_turned(person, half):
    rng = np.random.default_rng(0)
    for right in (person, half):
        middle = right.corners.mean(axis=1)
        seeds = middle[rng.integers(len(middle), size=12)]
        patches = (np.linalg.norm(middle[:, None] - seeds, axis=2) < 0.1).any(axis=1)
        mixed = Mesh(right.vertices, invert_triangles(right.faces, patches))
        assert wrong_share(told(mixed, rf"of {len(patches)} triangles faced inward"), right) < 0.01


def test_what_one_camera_saw_faces_it_whatever_its_noise_hides(person, half):
    """On a Kinect's view of a person the rays turned two thirds of the surface, and other parts when read again."""
    middle = half.corners.mean(axis=1) - half.vertices.mean(axis=0)
    patch = np.where(middle[:, 2] < 0, 0, np.where(middle[:, 0] > 0, 1, 2))
    mixed = Mesh(half.vertices, invert_triangles(half.faces, patch == 1))
    np.testing.assert_array_equal(_agree_with_camera(mixed, Rays(mixed), patch, np.array([True, False, False])),
                                  [False, True, False])
    whole = np.zeros(len(person.faces), dtype=int)                      # seen from all sides: the rays decide
    assert _agree_with_camera(person, Rays(person), whole, np.array([True])).all()


def test_a_room_seen_from_inside_is_left_as_it_is(person):
    box = np.array([[x, y, z] for x in (-2.5, 2.5) for y in (-2.5, 2.5) for z in (0, 3.0)])
    floor = np.array([[0, 4, 6], [0, 6, 2]])                                # and one wall, facing the person
    wall = np.array([[0, 1, 5], [0, 5, 4]])
    standing = person.vertices - [0, 0, person.vertices[:, 2].min()]
    room = Mesh(np.concatenate([standing, box]), np.concatenate([person.faces, len(standing) + floor,
                                                                 len(standing) + wall]))
    assert quietly(room) is room


def test_triangles_that_are_no_surface_go(person):
    N, F = len(person.vertices), len(person.faces)
    flat = Mesh(np.vstack([person.vertices, person.vertices[7]]), np.vstack([person.faces, [7, N, N], [7, 9, 7]]))
    assert np.array_equal(told(flat, "scan: 2 triangles without area dropped").faces, person.faces)
    a, b, _ = person.faces[5]
    flap = Mesh(np.vstack([person.vertices, person.vertices[a] + 0.01]),
                np.vstack([person.faces, [a, b, N], [b, a, N]]))
    assert np.array_equal(told(flap, "1 flap dropped").faces, person.faces)
    hanging = Mesh(np.vstack([person.vertices, person.vertices[[a, b]] + 0.01]),
                   np.vstack([person.faces, [a, N, N + 1], [N, a, N + 1]]))
    assert np.array_equal(told(hanging, "1 flap dropped").faces, person.faces)
    again = Mesh(person.vertices, np.vstack([person.faces, np.roll(person.faces[:30], 1, axis=1)]))
    assert np.array_equal(told(again, "30 repeated triangles dropped").faces, person.faces)
    both = Mesh(person.vertices, np.vstack([person.faces, person.faces[:, ::-1]]))
    assert np.array_equal(told(both, f"{F:,} triangles of two-sided surfaces dropped").faces, person.faces)
    own = Mesh(np.tile(person.vertices, (2, 1)), np.vstack([person.faces, N + person.faces[:, ::-1]]))
    assert np.array_equal(told(own, f"{F:,} triangles of two-sided surfaces dropped").faces, person.faces)


def test_every_point_of_a_target_has_a_normal_where_triangles_cancel(person):
    N = len(person.vertices)
    # Two triangles back to back that are not quite the same: their corner that is theirs alone has no normal.
    a, b, _ = person.faces[5]
    tip = person.vertices[a] + [0, 0.03, 0]
    fold = Mesh(np.vstack([person.vertices, tip, person.vertices[b]]),
                np.vstack([person.faces, [a, b, N], [N + 1, a, N]]))
    for mesh in (fold, Mesh(np.vstack([person.vertices, tip]), np.vstack([person.faces, [a, N, N]]))):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            target = target_of(mesh)
        np.testing.assert_allclose(np.linalg.norm(target.normals, axis=1), 1, atol=1e-9)


def test_points_that_are_there_twice_are_there_once(person):
    points = person.vertices[::2]
    twice, once = target_of(np.tile(points, (2, 1))), target_of(points)
    for name in ("points", "normals", "border", "index"):
        np.testing.assert_array_equal(getattr(twice, name), getattr(once, name))
    assert spacing(np.repeat(points, 2, axis=0)) == pytest.approx(spacing(points), rel=1e-12)
    rng = np.random.default_rng(0)
    overlapping = np.concatenate([points, points + 1e-6 * rng.normal(size=points.shape)])
    assert spacing(overlapping) == pytest.approx(spacing(points), rel=0.02)


@pytest.mark.parametrize("front", [1, 2, 8])
def test_overlapping_views_do_not_throw_away_a_side(person, front):
    """The back is seen once and sparsely, the front often and densely."""
    points, _, _ = person.sample(4000, np.random.default_rng(0))
    back = points[points[:, 1] > 0]
    dense, _, _ = person.sample(4000 * front, np.random.default_rng(1))
    dense = dense[dense[:, 1] < 0]
    rng = np.random.default_rng(2)
    scan = np.concatenate([back, dense, dense + 1e-4 * rng.normal(size=dense.shape)])
    kept = clean_scan(scan).kept
    assert kept[:len(back)].mean() > 0.99 and kept.mean() > 0.99


def test_a_scan_finer_than_any_work_needs_is_thinned_and_told():
    fine = ball(6)
    with pytest.warns(UserWarning, match=rf"thinned from {len(fine.faces)} to \d+ triangles"):
        thin = thin_scan(fine, most=4000)
    assert 3400 < len(thin.faces) < 4400
    np.testing.assert_allclose(np.linalg.norm(thin.vertices, axis=1), 0.1, atol=5e-4)
    assert np.linalg.norm(thin.vertices[thin.of_file] - fine.vertices, axis=1).max() < 0.01
    assert thin_scan(thin, most=2500) is thin
    assert thin.is_closed and thin.is_edge_manifold and thin.is_vertex_manifold and template_problem(thin) is None
    rng = np.random.default_rng(0)                     # noise as large as the triangles: pleats, but no holes
    rough = fine.with_vertices(fine.vertices + 0.001 * rng.normal(size=fine.vertices.shape))
    with pytest.warns(UserWarning, match="thinned"):
        thin = thin_scan(rough, most=4000)
    assert thin.volume == pytest.approx(rough.volume, rel=0.03) and (thin.edge_use % 2 == 0).all()


def test_a_thinned_surface_stays_closed_and_manifold():
    """A sphere that all but touches one around it, and a noisy one."""
    fine = ball(6)
    inner = fine.with_vertices(0.8 * fine.vertices + [0.0199, 0, 0])
    both = Mesh(np.r_[fine.vertices, inner.vertices], np.r_[fine.faces, inner.faces[:, ::-1] + len(fine.vertices)])
    rng = np.random.default_rng(0)
    rough = fine.with_vertices(fine.vertices + 1e-4 * rng.normal(size=fine.vertices.shape))
    for scan in (both, rough):
        with pytest.warns(UserWarning, match="thinned"):
            thin = thin_scan(scan, most=16_000)
        assert thin.is_closed and thin.is_edge_manifold and thin.is_vertex_manifold
        assert template_problem(thin) is None and len(thin.faces) < 20_000
