"""Bridges between fingers are cut: a person's surface has no handle."""
import numpy as np
import pytest
from scipy.spatial import cKDTree

from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Surface
from scanprep.repair.handles import count_handles, cut_handles, find_short_loop, measure_loop
from scanprep.surfaces.template import MadeTemplate, template_of_scan
from scanprep.synthetic.topology import load_topology


def ring(radius: float, thick: float, around: int = 120, across: int = 40) -> Mesh:
    """Make a ring, of radii in metres."""
    i, j = np.meshgrid(np.arange(around), np.arange(across), indexing="ij")
    u, v = 2 * np.pi * i / around, 2 * np.pi * j / across
    out = radius + thick * np.cos(v)
    vertices = np.stack([out * np.cos(u), out * np.sin(u), thick * np.sin(v)], axis=-1).reshape(-1, 3)
    a, b, c, d = ((i + k) % around * across + (j + n) % across for k, n in ((0, 0), (1, 0), (1, 1), (0, 1)))
    return Mesh(vertices, np.concatenate([np.stack(side, axis=-1).reshape(-1, 3) for side in ((a, b, c), (a, c, d))]))


@pytest.mark.parametrize("radius, thick, shortest", [
    (0.1, 0.012, 2 * np.pi * 0.012),                # around the bridge
    (0.03, 0.02, 2 * np.pi * 0.01),                 # around its opening
])
def test_the_shortest_loop_is_found_and_cut(radius, thick, shortest):
    joined = ring(radius, thick)
    assert count_handles(joined) == 1
    assert measure_loop(joined, find_short_loop(joined)) == pytest.approx(shortest, rel=0.01)
    apart = cut_handles(joined)
    assert count_handles(apart) == 0 and apart.is_closed and apart.is_edge_manifold
    assert apart.volume == pytest.approx(joined.volume, rel=0.02)


def test_long_handles_stay():
    wide = ring(0.2, 0.05)
    assert cut_handles(wide) is wide


@pytest.fixture(scope="module")
def joined():
    """A person of whom two fingers are joined by a tube."""
    person = load_topology().mesh
    # two triangles that face each other are taken out, and their borders joined by six
    middle, out = person.corners.mean(axis=1), person.face_normals
    hand = np.flatnonzero(middle[:, 0] > 0.88 * middle[:, 0].max())
    pairs = hand[cKDTree(middle[hand]).query_pairs(0.02, output_type="ndarray")]
    way = middle[pairs[:, 1]] - middle[pairs[:, 0]]
    length = np.linalg.norm(way, axis=1)
    # they face each other across at least 8 mm of air
    facing = ((out[pairs[:, 0]] * out[pairs[:, 1]]).sum(axis=1) < -0.8) & (length > 0.008)
    facing &= (out[pairs[:, 0]] * way).sum(axis=1) > 0.8 * length
    a, b = pairs[np.where(facing, length, 1.0).argmin()]
    one, other = person.faces[a], person.faces[b][::-1]
    other = min((np.roll(other, k) for k in range(3)),
                key=lambda turned: np.linalg.norm(person.vertices[one] - person.vertices[turned]))
    tube = [side for k in range(3) for side in (
        (one[k], one[(k + 1) % 3], other[k]), (one[(k + 1) % 3], other[(k + 1) % 3], other[k]))]
    return Mesh(person.vertices, np.concatenate([np.delete(person.faces, [a, b], axis=0), tube]))


def test_fingers_joined_by_a_bridge_come_apart(joined):
    assert count_handles(joined) == 1 and joined.is_closed and joined.is_edge_manifold
    apart = cut_handles(joined)
    assert count_handles(apart) == 0
    assert Surface(apart).closest(load_topology().mesh.vertices).distances.max() < 0.005


@pytest.mark.slow
def test_a_template_tells_that_a_bridge_was_cut(joined):
    made = template_of_scan(joined, person=load_topology().mesh)
    assert any(note.startswith("1 bridge was cut") for note in made.notes) and not made.handles


def test_a_template_with_a_handle_is_doubted():
    assert not MadeTemplate(ring(0.1, 0.01), (), 0.0, 0, None).doubts
    assert "joined to itself in 1 place" in MadeTemplate(ring(0.1, 0.01), (), 0.0, 1, None).doubts[0]
