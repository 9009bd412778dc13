import numpy as np
from scanned_shapes import ball, pierced, view

from scanprep.geometry.mesh import Mesh, template_problem
from scanprep.geometry.surface import SeenSpace, Surface
from scanprep.repair.hole_filling import fill_holes, fill_report
from scanprep.repair.volumetric_diffusion import diffuse_surface, measure_signed_distance


def dented():
    """A ball of radius 10 cm whose top is pressed in, with a hole there that hides the dent."""
    whole = ball(5)
    x, y, z = whole.vertices.T
    dent = whole.with_vertices(np.stack([x, y, z - 0.035 * np.exp(-(x**2 + y**2) / (2 * 0.03**2)) * (z > 0)], axis=1))
    return dent, pierced(dent, [0, 0, 0.08], 0.062)


def test_signed_distances_of_a_ball_and_where_they_end():
    holed = pierced(ball(5), [0, 0, 0.1], 0.05)
    points = np.random.default_rng(0).uniform(-0.13, 0.13, size=(500, 3))
    distance, sure = measure_signed_distance(holed, points)
    assert np.abs(distance - (np.linalg.norm(points, axis=1) - 0.1))[sure].max() < 0.001
    above = points[:, 2] > 0.98 * np.linalg.norm(points, axis=1)
    assert not sure[above & (np.linalg.norm(points, axis=1) > 0.05)].any()
    assert sure[points[:, 2] < 0].all()


def test_the_zero_level_continues_a_ball():
    holed = pierced(ball(5), [0, 0, 0.1], 0.04)
    zero = diffuse_surface(holed, holed.boundary_vertices)
    cap = zero.vertices[(zero.vertices[:, 2] > 0.09)]
    assert len(cap) > 30
    assert np.abs(np.linalg.norm(cap, axis=1) - 0.1).max() < 0.002


def test_what_was_seen_to_be_empty_is_outside():
    """Within a ball whose hole was looked into, which without that would be continued over it."""
    class Pit:
        def ahead(self, points):
            return np.where(np.linalg.norm(points - [0, 0, 0.1], axis=1) < 0.035, 0.05, -np.inf)

    holed = pierced(ball(4), [0, 0, 0.1], 0.05)
    inside = np.array([[0, 0, 0.08], [0.01, 0, 0.085], [0, -0.01, 0.09]])
    for seen, sign in ((None, -1), (Pit(), 1)):
        found = diffuse_surface(holed, holed.boundary_vertices, seen)
        assert (np.sign(measure_signed_distance(found, inside)[0]) == sign).all()


def test_seen_space_stays_empty():
    dent, holed = dented()
    # A wall behind, seen by a camera that looks into the dent from the side and above: a line of sight is evidence.
    views = [view(dent, d) for d in ([0.8, 0, 1], [-0.8, 0, 1], [0, 0.8, 1], [0, -0.8, 1])]
    truth = Surface(dent)
    blind, told = (fill_report(holed, views=v) for v in ((), views))
    new = slice(len(holed.vertices), None)
    before, after = (truth.closest(r.mesh.vertices[new]).distances.mean() for r in (blind, told))
    assert told.mesh.is_closed and template_problem(told.mesh) is None
    assert (SeenSpace(views).ahead(blind.mesh.vertices[new]) > 0.01).mean() > 0.3
    assert told.holes[0].in_empty < 0.1
    assert told.holes[0].method == "diffusion"
    assert after < 0.6 * before


def test_colours_are_continued():
    whole = ball(4)
    red = Mesh(whole.vertices, whole.faces, np.tile([0.8, 0.1, 0.2], (len(whole.vertices), 1)))
    assert np.allclose(fill_holes(pierced(red, [0.1, 0, 0], 0.05)).colors, [0.8, 0.1, 0.2])
