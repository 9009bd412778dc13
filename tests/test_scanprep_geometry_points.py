"""Files of points: what is written comes back, and other forms are understood."""


import numpy as np
import pytest
from mesh_files import TETRAHEDRON

from scanprep.geometry.files import PointCloud, read_mesh, read_points, write_mesh, write_points


def cloud(rng, normals=True, colors=True):
    n = rng.normal(size=(50, 3))
    return PointCloud(rng.normal(size=(50, 3)), n / np.linalg.norm(n, axis=1, keepdims=True) if normals else None,
                      rng.random((50, 3)) if colors else None)


@pytest.mark.parametrize("suffix", [".ply", ".ply.gz", ".pcd", ".xyz", ".txt"])
@pytest.mark.parametrize(("normals", "colors"), [(True, True), (True, False), (False, True), (False, False)])
def test_points_come_back(tmp_path, suffix, normals, colors):
    points = cloud(np.random.default_rng(8), normals, colors)
    write_points(tmp_path / f"a{suffix}", points)
    back = read_points(tmp_path / f"a{suffix}")
    np.testing.assert_allclose(back.points, points.points, atol=1e-9)
    for mine, theirs, tolerance in ((back.normals, points.normals, 1e-6), (back.colors, points.colors, 0.5 / 255)):
        assert (mine is None) == (theirs is None)
        if mine is not None:
            np.testing.assert_allclose(mine, theirs, atol=tolerance + 1e-9)


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".stl", ".off", ".glb"])
def test_the_vertices_of_a_mesh_are_points_with_its_normals(tmp_path, suffix):
    write_mesh(tmp_path / f"a{suffix}", TETRAHEDRON)
    points, mesh = read_points(tmp_path / f"a{suffix}"), read_mesh(tmp_path / f"a{suffix}")
    np.testing.assert_array_equal(points.points, mesh.vertices)
    np.testing.assert_allclose(points.normals, mesh.vertex_normals, atol=1e-6)


def test_pcd_ascii_leaves_out_points_without_return_and_unpacks_colours(tmp_path):
    (tmp_path / "a.pcd").write_text(
        "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F U\nCOUNT 1 1 1 1\nWIDTH 3\n"
        "HEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 3\nDATA ascii\n0 0 1 16711680\nnan nan nan 0\n0.5 0 1 255\n")
    points = read_points(tmp_path / "a.pcd")
    np.testing.assert_array_equal(points.points, [[0, 0, 1], [0.5, 0, 1]])
    np.testing.assert_array_equal(points.colors, [[1, 0, 0], [0, 0, 1]])


def test_what_a_depth_camera_writes_where_it_saw_nothing_is_no_size(tmp_path):
    # A bust in metres, and 3% of the pixels at 65.535 m, which alone would be 1.66 m in inches.
    rng = np.random.default_rng(0)
    bust = rng.uniform(-0.3, 0.3, (1000, 3)) + [0, 0, 0.9]
    nothing = np.column_stack([rng.uniform(-15, 15, (30, 2)), np.full(30, 65.535)])
    write_points(tmp_path / "bust.ply", PointCloud(np.concatenate([bust, nothing]), None, None))
    with pytest.warns(UserWarning, match="a few points lie far off the rest, which spans 0.5"):
        assert read_points(tmp_path / "bust.ply").points[:1000] == pytest.approx(bust, abs=1e-6)
    write_points(tmp_path / "mm.ply", PointCloud(3000 * bust, None, None))
    with pytest.warns(UserWarning, match="mm"):
        read_points(tmp_path / "mm.ply")
