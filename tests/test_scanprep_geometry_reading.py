"""What other programs write: seams, polygons with more than three corners, several objects in one file."""
import json

import numpy as np
import pytest
import trimesh
from scanned_shapes import ball

from scanprep.geometry.files import read_mesh, read_registered, write_mesh
from scanprep.geometry.landmarks import read_landmark_vertices, read_landmarks
from scanprep.geometry.mesh import Mesh, template_problem
from scanprep.geometry.seams import seams_closed

BALL = trimesh.creation.icosphere(2)
BODY = Mesh(BALL.vertices * (0.3, 0.4, 0.9), BALL.faces)
CUBE = ("".join(f"v {x} {y} {z}\n" for x in (0, 1) for y in (0, 1) for z in (0, 1))
        + "f 1 2 4 3\nf 5 7 8 6\nf 1 5 6 2\nf 3 4 8 7\nf 1 3 7 5\nf 2 6 8 4\n")


def cut_apart(mesh, corner_ids):
    """Every vertex once for each id that its corners (F, 3) have, in an order of no meaning, and the old vertex of
    each.
    """
    rows, faces = np.unique(np.stack([mesh.faces.ravel(), corner_ids.ravel()], axis=1), axis=0, return_inverse=True)
    order = np.random.default_rng(0).permutation(len(rows))
    return Mesh(mesh.vertices[rows[order, 0]], np.argsort(order)[faces.reshape(-1, 3)]), rows[order, 0]


SPLITS = {"flat": np.arange(BODY.faces.size).reshape(-1, 3),
          "textures": np.repeat(BODY.corners.mean(axis=1)[:, :1] > 0.02, 3, axis=1).astype(int),
          "one triangle": np.repeat(np.arange(len(BODY.faces))[:, None] == 7, 3, axis=1).astype(int)}


@pytest.mark.parametrize("suffix", [".glb", ".ply", ".obj", ".off"])
@pytest.mark.parametrize("kind", SPLITS)
def test_seams_are_closed_with_a_note(tmp_path, suffix, kind):
    split, old = cut_apart(BODY, SPLITS[kind])
    assert not split.is_closed
    write_mesh(tmp_path / f"a{suffix}", split)
    with pytest.warns(UserWarning, match=rf"a\{suffix}: {len(old) - 162} of {len(old)} vertices .* seams .* merged"):
        mesh = read_mesh(tmp_path / f"a{suffix}")
    assert mesh.is_closed and template_problem(mesh) is None and len(mesh.vertices) == 162
    np.testing.assert_allclose(mesh.corners, split.corners, atol=1e-6)                # the faces in their order
    first = np.unique(old, return_index=True)[1]
    np.testing.assert_allclose(mesh.vertices, split.vertices[np.sort(first)], atol=1e-6)      # and the vertices
    np.testing.assert_allclose(mesh.vertices[mesh.of_file], split.vertices, atol=1e-6)


def test_vertices_of_a_landmark_file_are_those_of_the_mesh_file(tmp_path):
    split, _ = cut_apart(BODY, SPLITS["flat"])
    write_mesh(tmp_path / "a.ply", split)
    with pytest.warns(UserWarning, match="merged"):
        mesh = read_mesh(tmp_path / "a.ply")
    named = {"head": 700, "foot": len(split.vertices) - 1, "face": {"face": 3, "bary": [0, 1, 0]}}
    (tmp_path / "a.json").write_text(json.dumps(named))
    wanted = [split.vertices[700], split.vertices[-1], split.corners[3, 1]]
    np.testing.assert_array_equal(list(read_landmarks(tmp_path / "a.json", mesh).values()), wanted)
    vertices = read_landmark_vertices(tmp_path / "a.json", mesh.with_vertices(mesh.vertices))
    np.testing.assert_array_equal(mesh.vertices[list(vertices.values())], wanted)
    (tmp_path / "a.json").write_text(json.dumps({"head": len(split.vertices)}))
    with pytest.raises(ValueError, match=f"vertex {len(split.vertices)}, the mesh has 0..{len(split.vertices) - 1}"):
        read_landmarks(tmp_path / "a.json", mesh)


def test_colours_of_merged_vertices_are_their_mean(tmp_path):
    split, old = cut_apart(BODY, SPLITS["textures"])
    colors = np.where(np.isin(np.arange(len(old)), split.faces[SPLITS["textures"][:, 0] == 1])[:, None], 1.0, 0.0)
    write_mesh(tmp_path / "a.ply", Mesh(split.vertices, split.faces, np.repeat(colors, 3, axis=1)))
    with pytest.warns(UserWarning, match="merged"):
        mesh = read_mesh(tmp_path / "a.ply")
    seam = np.bincount(mesh.of_file) == 2
    assert seam.any() and (mesh.colors[seam] == 0.5).all() and set(mesh.colors[~seam].ravel()) == {0.0, 1.0}


def test_what_touches_without_a_seam_stays_as_it_is(tmp_path):
    """Two closed bodies with common vertices; a border that runs along itself nowhere; a folder of one topology."""
    both = Mesh(np.r_[BODY.vertices, BODY.vertices], np.r_[BODY.faces, BODY.faces[:, ::-1] + 162])
    opened = BODY.submesh(np.arange(len(BODY.faces)) > 5)[0]
    for mesh in (BODY, both, opened):
        assert seams_closed(mesh.vertices, mesh.faces) is None
    split, _ = cut_apart(BODY, SPLITS["textures"])
    for name in "ab":
        write_mesh(tmp_path / f"{name}.obj", split.with_vertices(split.vertices * (1 + (name == "b"))))
    with pytest.warns(UserWarning, match="merged"):
        registered = read_registered(tmp_path)
    np.testing.assert_allclose(registered.vertices[1], 2 * registered.vertices[0])


def test_polygons_are_cut_where_no_edge_is_yet(tmp_path):
    """Two quads over one line, as of a limb that is closed at its end: their usual cuts would be the same edge."""
    text = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 0.5 0.5 1\nv 0.5 0.5 -1\n"
    (tmp_path / "a.obj").write_text(text + "f 1 2 3 5\nf 3 4 1 5\nf 1 6 3 2\nf 1 4 3 6\n")
    mesh = read_mesh(tmp_path / "a.obj")
    assert mesh.is_closed and mesh.is_edge_manifold and len(mesh.faces) == 8
    fans = [[0, 1, 2], [0, 2, 4], [2, 3, 0], [2, 0, 4], [0, 5, 2], [0, 2, 1], [0, 3, 2], [0, 2, 5]]
    assert not Mesh(mesh.vertices, fans).is_edge_manifold
    shape = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    assert shape.is_winding_consistent
    (tmp_path / "b.obj").write_text(text + "f 1 2 3 4 5\nf 1 3 6\n")       # a side of a triangle is in the way
    assert read_mesh(tmp_path / "b.obj").is_edge_manifold
    (tmp_path / "c.obj").write_text(CUBE)
    assert read_mesh(tmp_path / "c.obj").faces[:2].tolist() == [[0, 1, 3], [0, 3, 2]] and mesh.is_closed


def test_a_header_as_blender_2_4_wrote_it(tmp_path):
    """Its comment has no word that says so."""
    write_mesh(tmp_path / "a.ply", ball(1))
    data = (tmp_path / "a.ply").read_bytes().replace(b"element vertex", b"Created by Blender3D 247\nelement vertex", 1)
    (tmp_path / "b.ply").write_bytes(data)
    theirs, ours = (read_mesh(tmp_path / name, "m") for name in ("b.ply", "a.ply"))
    np.testing.assert_array_equal(theirs.vertices, ours.vertices)


def test_a_polygon_that_folds_over_is_told(tmp_path):
    corners = "v 0 0 0\nv 1 0 0\nv 0.1 0.1 0\nv 0 1 0\nv 2 2 0\n"
    (tmp_path / "a.obj").write_text(corners + "f 5 4 3 2\nf 2 3 4 1\nf 1 2 3 4\n")
    with pytest.warns(UserWarning, match=r"a\.obj: 1 polygon folds over .* the first is face 1"):
        read_mesh(tmp_path / "a.obj")


def test_several_objects_are_named(tmp_path):
    (tmp_path / "a.obj").write_text("o body\n" + CUBE + "o no faces\no left eye\nv 3 3 3\nf 1 2 9\n")
    with pytest.warns(UserWarning, match=r"2 objects .* one mesh: body \(12 triangles\), left eye \(1 triangle\)"):
        read_mesh(tmp_path / "a.obj")
    trimesh.Scene({"body": BALL, "hat": trimesh.creation.box()}).export(tmp_path / "a.glb")
    with pytest.warns(UserWarning, match=r"2 objects .* one mesh: body \(320 triangles\), hat \(12 triangles\)"):
        read_mesh(tmp_path / "a.glb")
