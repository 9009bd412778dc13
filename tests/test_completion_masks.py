"""Clothing and hair that hide the body, the files that mark them, parts that are left out."""
import json
from dataclasses import replace

import numpy as np
import pytest
from completion_bodies import MARKS, POSE, QUICK, TRANS, half_view, worm_with_prior

from completion.partial.completion import complete
from completion.partial.masks import read_mask
from model.fitting.free_space import Clothing
from model.fitting.scan import prepare_scan
from scanprep.geometry.files import PointCloud, write_mesh, write_points
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Surface


@pytest.fixture(scope="module")
def model():
    return worm_with_prior()


@pytest.fixture(scope="module")
def body(model):
    return model.template.with_vertices(model.vertices(POSE, None, TRANS))


@pytest.fixture(scope="module")
def dressed(model, body):
    """Points of a half view with 4 cm of cloth over one part, which of them are cloth, and what was seen."""
    points, seen = half_view(body, np.array([0.3, -1, 0.5]), noise=0.001)
    found = Surface(body).closest(points)
    part = model.skeleton.part_of_vertex(body)[body.faces[found.faces, 0]]
    cloth = part == np.bincount(part).argmax()
    return points + np.where(cloth[:, None], 0.04 * body.face_normals[found.faces], 0), cloth, seen


def test_the_body_is_inside_its_clothes(model, body, dressed):
    points, cloth, _ = dressed
    marks = (MARKS, body.vertices[MARKS])
    aware, naive = (complete(model.subject(None), points, marks, QUICK, masked=mask) for mask in (cloth, None))
    off = [np.linalg.norm(r.completed.vertices - body.vertices, axis=1) for r in (aware, naive)]
    assert off[0].mean() < 0.006 and off[0].mean() < 0.6 * off[1].mean()
    assert aware.explained > 0.97                                    # of the points that are not cloth
    assert aware.seen.mean() < naive.seen.mean()


def test_what_sticks_out_of_clothing_is_pushed_in():
    x, y = (g.ravel() for g in np.meshgrid(np.linspace(0, 0.2, 21), np.linspace(0, 0.2, 21)))
    cloth = prepare_scan(np.column_stack([x, y, 0 * x, 0 * x, 0 * x, 1 + 0 * x]))
    clothing = Clothing(cloth)
    places = np.array([[0.1, 0.1, 0.023], [0.1, 0.1, -0.04], [0.1, 0.1, 0.4], [0.5, 0.1, 0.01], [0.05, 0.1, 0.03]])
    up = np.array([[0, 0, 1.0]] * 4 + [[0, 0, -1.0]])
    depth, normal, target = clothing.violation(places, up)
    np.testing.assert_allclose(depth, [0.02, 0, 0, 0, 0], atol=1e-12)
    np.testing.assert_allclose(target[0], [0.1, 0.1, 0.003], atol=1e-12)
    np.testing.assert_allclose(normal[0], [0, 0, 1])


@pytest.mark.parametrize("masked, message", [
    (np.zeros(3, dtype=bool), r"expected \d+ booleans, one for each point of the scan, got bool of shape \(3,\)"),
    (np.zeros(4000), r"expected 4000 booleans, one for each point of the scan, got float64"),
    (np.ones(4000, dtype=bool), "expected more than 16 points that are not masked, got 0"),
])
def test_masks_that_do_not_fit_are_refused(dressed, masked, message):
    with pytest.raises(ValueError, match=f"masked: {message}"):
        prepare_scan(np.resize(dressed[0], (4000, 3)), masked=masked)


def test_parts_that_are_left_out_are_not_matched(model, body):
    """What the scan shows at the last part is nonsense; without that part the rest comes out right."""
    points, _ = half_view(body, np.array([0.3, -1, 0.5]), noise=0.001)
    part = model.skeleton.part_of_vertex(body)
    mine = part[body.faces[Surface(body).closest(points).faces, 0]] == 3
    marks = MARKS[part[MARKS] != 3]
    centre = body.vertices[part == 3].mean(axis=0)
    odd = np.where(mine[:, None], centre + 1.35 * (points - centre), points)
    wrong, right = (complete(model.subject(None), odd, (marks, body.vertices[marks]), replace(QUICK, ignored_parts=out))
                    for out in ((), (model.skeleton.names[3],)))
    rest = part != 3
    off = [np.linalg.norm(r.completed.vertices - body.vertices, axis=1)[rest].mean() for r in (wrong, right)]
    assert off[1] < 0.006 and off[1] < off[0]
    assert right.seen[part == 3].mean() < 0.5 * wrong.seen[part == 3].mean()


# ---- files

POINTS = np.random.default_rng(0).normal(0, 0.4, (50, 3))
WANTED = np.arange(50) % 7 == 0


def test_masks_of_every_kind_say_the_same(tmp_path):
    white, red = np.ones((50, 3)), np.where(WANTED[:, None], [0.9, 0.1, 0.2], 1)
    (tmp_path / "index.json").write_text(json.dumps(np.flatnonzero(WANTED).tolist()))
    write_points(tmp_path / "painted.ply", PointCloud(POINTS, None, red))
    write_points(tmp_path / "part.ply", PointCloud(POINTS[::-1][::7], None, red[::-1][::7]))
    write_mesh(tmp_path / "mesh.ply", Mesh(POINTS, [[0, 1, 2]], red))
    write_points(tmp_path / "white.ply", PointCloud(POINTS, None, white))
    for path in sorted(tmp_path.iterdir()):
        wanted = 0 * WANTED > 1 if path.stem == "white" else WANTED & (path.stem != "part")
        if path.stem == "part":
            wanted = WANTED & np.isin(np.arange(50), np.arange(50)[::-1][::7])
        np.testing.assert_array_equal(read_mask(path, POINTS), wanted, err_msg=path.name)


@pytest.mark.parametrize("name, text, message", [
    ("a.json", "[1, 2, 50]", "element 2: expected a point of 0..49, found 50"),
    ("a.json", "[1, 2.5]", "element 1: expected a point of 0..49, found 2.5"),
    ("a.json", "[true, false]", "element 0: expected a point of 0..49, found True"),
    ("a.json", '{"x": 1}', "expected a list of numbers of points, found dict"),
    ("a.json", "[1,", "expected numbers of points in JSON"),
    ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "expected colours, those of clothing other than grey"),
    ("a.xyz", "0.1 0.2 0.3\n", "expected colours, those of clothing"),
])
def test_a_mask_that_cannot_be_read_says_why(tmp_path, name, text, message):
    (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match=f"{name}: .*{message}"):
        read_mask(tmp_path / name, POINTS)


def test_painted_points_must_be_those_of_the_scan(tmp_path):
    colors = np.zeros((3, 3)) + [1, 0, 0]
    moved = POINTS[:3] + [[0, 0, 0], [0, 0, 0], [0, 0.02, 0]]
    write_points(tmp_path / "moved.ply", PointCloud(moved, None, colors))
    with pytest.raises(ValueError, match=r"moved.ply: point 2: expected the points of the scan, this one is 20\.0 mm"):
        read_mask(tmp_path / "moved.ply", POINTS)
