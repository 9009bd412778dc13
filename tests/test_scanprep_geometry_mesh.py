"""The mesh against brute force, known solids and libigl."""
import igl
import numpy as np
import pytest
import trimesh

from scanprep.geometry.mesh import Mesh, check_template, template_problem

RNG = np.random.default_rng


def ball(subdivisions=2, radius=0.5):
    sphere = trimesh.creation.icosphere(subdivisions, radius)
    return Mesh(sphere.vertices, sphere.faces)


def grid(n=5, m=4):
    """A flat bordered sheet of n by m vertices."""
    x, y = np.meshgrid(np.arange(n), np.arange(m), indexing="ij")
    corner = np.arange(n * m).reshape(n, m)
    a, b, c, d = corner[:-1, :-1], corner[1:, :-1], corner[1:, 1:], corner[:-1, 1:]
    faces = np.concatenate([np.stack(t, axis=-1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))])
    return Mesh(np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3).astype(float), faces)


def pierced(seed=0):
    """A ball with several holes, one of them touching another in a vertex."""
    mesh = ball(2)
    centre = RNG(seed).choice(len(mesh.vertices), 4, replace=False)
    gone = np.isin(mesh.faces, centre).any(axis=1)
    return mesh.submesh(~gone)[0]


MESHES = {"ball": ball(), "grid": grid(), "pierced": pierced()}
every = pytest.mark.parametrize("mesh", MESHES.values(), ids=MESHES)


@every
def test_edges_and_their_use_against_brute_force(mesh):
    count = {}
    for face in mesh.faces.tolist():
        for i in range(3):
            edge = tuple(sorted((face[i], face[(i + 1) % 3])))
            count[edge] = count.get(edge, 0) + 1
    assert [tuple(e) for e in mesh.edges.tolist()] == sorted(count)
    assert mesh.edge_use.tolist() == [count[e] for e in sorted(count)]
    for face, sides in zip(mesh.faces, mesh.face_edges, strict=True):
        for i in range(3):
            assert set(mesh.edges[sides[i]]) == {face[i], face[(i + 1) % 3]}
    np.testing.assert_allclose(mesh.edge_lengths, [np.linalg.norm(mesh.vertices[a] - mesh.vertices[b])
                                                   for a, b in mesh.edges])


@every
def test_normals_and_areas_agree_with_igl(mesh):
    v, f = np.array(mesh.vertices), np.array(mesh.faces)
    np.testing.assert_allclose(mesh.face_areas, igl.doublearea(v, f) / 2)
    np.testing.assert_allclose(mesh.face_normals, igl.per_face_normals(v, f, np.zeros(3)), atol=1e-12)
    theirs = np.asarray(igl.per_vertex_normals(v, f, igl.PER_VERTEX_NORMALS_WEIGHTING_TYPE_AREA))
    np.testing.assert_allclose(mesh.vertex_normals, theirs, atol=1e-9)
    assert mesh.vertex_areas.sum() == pytest.approx(mesh.face_areas.sum())


def test_volume_of_known_solids_and_its_sign():
    box = trimesh.creation.box((0.2, 0.3, 0.4))
    assert Mesh(box.vertices + 5, box.faces).volume == pytest.approx(0.024)
    assert Mesh(box.vertices, box.faces[:, ::-1]).volume == pytest.approx(-0.024)
    assert ball(4).volume == pytest.approx(np.pi / 6, rel=5e-3)


@pytest.mark.parametrize("seed", range(5))
def test_loops_use_every_border_edge_once_and_touch_no_vertex_twice(seed):
    mesh = pierced(seed)
    sides = [tuple(sorted(e)) for loop in mesh.boundary_loops for e in zip(loop, np.roll(loop, -1), strict=True)]
    assert sorted(sides) == [tuple(e) for e in mesh.edges[mesh.edge_use == 1].tolist()]
    assert all(len(set(loop)) == len(loop) for loop in mesh.boundary_loops)
    lengths = [len(loop) for loop in mesh.boundary_loops]
    assert lengths == sorted(lengths, reverse=True)


def test_holes_that_touch_in_a_vertex_are_two_loops_and_not_vertex_manifold():
    mesh = grid(5, 4)                # take away two squares that meet in one inner vertex
    centres = mesh.corners.mean(axis=1)[:, :2]
    gone = (np.floor(centres) == (1, 1)).all(axis=1) | (np.floor(centres) == (2, 2)).all(axis=1)
    open_mesh = Mesh(mesh.vertices, mesh.faces[~gone])
    assert open_mesh.is_edge_manifold and not open_mesh.is_vertex_manifold
    assert mesh.is_vertex_manifold
    squares = [set(loop) for loop in open_mesh.boundary_loops if len(loop) == 4]
    assert len(squares) == 1 and sum(len(x) for x in open_mesh.boundary_loops) == (open_mesh.edge_use == 1).sum()


@every
def test_manifold_predicates_agree_with_igl(mesh):
    assert mesh.is_edge_manifold == bool(igl.is_edge_manifold(np.array(mesh.faces))[0])
    assert mesh.is_vertex_manifold == bool(np.all(igl.is_vertex_manifold(np.array(mesh.faces))))
    assert mesh.is_closed == (len(mesh.boundary_loops) == 0)


@every
def test_submesh_keeps_its_triangles(mesh):
    keep = RNG(3).random(len(mesh.faces)) < 0.4
    part, used = mesh.submesh(keep)
    np.testing.assert_array_equal(part.corners, mesh.corners[keep])
    np.testing.assert_array_equal(part.vertices, mesh.vertices[used])
    assert len(np.unique(part.faces)) == len(part.vertices)


def test_samples_lie_on_their_triangles_and_spread_by_area():
    mesh = Mesh([[0, 0, 0], [3, 0, 0], [0, 1, 0], [3, 0, 1]], [[0, 1, 2], [1, 3, 2]])
    points, face, bary = mesh.sample(40_000, RNG(4))
    np.testing.assert_allclose(np.einsum("nc,ncd->nd", bary, mesh.corners[face]), points)
    assert bary.min() >= 0 and np.allclose(bary.sum(axis=1), 1)
    share = np.bincount(face) / len(face)
    np.testing.assert_allclose(share, mesh.face_areas / mesh.face_areas.sum(), atol=0.01)
    np.testing.assert_allclose(bary[face == 0].mean(axis=0), 1 / 3, atol=0.01)
    again, _, _ = mesh.sample(40_000, RNG(4))
    np.testing.assert_array_equal(points, again)


@pytest.mark.parametrize(("vertices", "faces", "says"), [
    (np.zeros((3, 2)), [[0, 1, 2]], r"vertices: expected shape \(N, 3\), got \(3, 2\)"),
    (np.zeros((3, 3)), [[0, 1]], r"faces: expected shape \(F, 3\)"),
    ([[0, 0, 0], [1, np.nan, 0], [0, 1, 0]], [[0, 1, 2]], "1 are not finite, the first is vertex 1"),
    ([[0, 0, 0], [1, np.inf, 0], [0, 1, 0]], [[0, 1, 2]], "not finite"),
    (np.zeros((3, 3)), [[0, 1, 2], [0, 1, 3]], r"face 1 = \[0, 1, 3\] refers to a vertex outside 0\.\.2"),
    (np.zeros((3, 3)), [[0, 1, -1]], "face 0"),
])
def test_what_a_mesh_refuses(vertices, faces, says):
    with pytest.raises(ValueError, match=says):
        Mesh(vertices, faces)


def test_a_mesh_cannot_be_written_to_and_does_not_share_memory():
    vertices = np.eye(3)
    mesh = Mesh(vertices, [[0, 1, 2]])
    vertices[0] = 9
    assert mesh.vertices[0, 0] == 1
    with pytest.raises(ValueError, match="read-only"):
        mesh.vertices[0] = 0


FLAT = Mesh([[0, 0, 0], [1, 0, 0], [2, 0, 0], [1, 1, 0]], [[0, 1, 2], [0, 2, 3]])


@pytest.mark.parametrize(("mesh", "says"), [
    (Mesh(np.eye(3), np.zeros((0, 3))), "no triangles"),
    (Mesh(np.r_[ball().vertices, [[1, 1, 1]]], ball().faces), "1 vertex belongs to no triangle"),
    (Mesh(np.r_[ball().vertices, ball().vertices + 3], np.r_[ball().faces, ball().faces + 162]), "2 components"),
    (Mesh(grid().vertices, np.r_[grid().faces, grid().faces[:1, [1, 2, 0]]]), "twice"),
    (FLAT, "no area, the first is face 0"),
    (Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, -1, 0]], [[0, 1, 2], [0, 1, 3]]), "facing opposite ways"),
])
def test_what_is_no_template_and_why(mesh, says):
    assert says in (template_problem(mesh) or "")
    with pytest.raises(ValueError, match=f"scan7: not usable as a template, .*{says}"):
        check_template(mesh, "scan7")
