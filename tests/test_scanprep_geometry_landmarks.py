"""Landmark files of every kind, and what is said when they are wrong."""
import json

import numpy as np
import pytest

from scanprep.geometry.files import MeshFileError
from scanprep.geometry.landmarks import (
    LANDMARK_ENDINGS,
    landmarks_beside,
    match_landmarks,
    read_landmark_vertices,
    read_landmarks,
    read_template_landmarks,
    write_landmarks,
)
from scanprep.geometry.mesh import Mesh

MESH = Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.5]], [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
POINTS = {"nose": [0.1, -0.2, 1.6], "left knee": [0.3, 0.25, 0.5], "10th rib": [-0.2, 0.1, 1.2]}


def written(path, content):
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def picked(points):
    rows = "".join(f' <point x="{x}" y="{y}" z="{z}" active="1" name="{name}"/>\n'
                   for name, (x, y, z) in points.items())
    return (f'<!DOCTYPE PickedPoints>\n<PickedPoints>\n <DocumentData>\n  <User name="me"/>\n </DocumentData>\n'
            f'{rows} <point x="9" y="9" z="9" active="0" name="not picked"/>\n</PickedPoints>\n')


def caesar(points):
    rows = "".join(f" {i} 0 {i} {np.hypot(x, y):.2f} {x:.2f} {y:.2f} {z:.2f} {name}\n"
                   for i, (name, (x, y, z)) in enumerate((n, 1000 * np.array(p)) for n, p in points.items()))
    return f"SUBJECT_ID = 0001\nSCAN_TYPE = A\nSTD_LAND = {len(points)}\nAUX =\n{rows}END =\n"


def slicer(points, system, unit="mm", scale=1000):
    turn = np.array([-1, -1, 1]) if system == "RAS" else np.ones(3)
    return {"@schema": "markups", "markups": [{
        "type": "Fiducial", "coordinateSystem": system, "coordinateUnits": unit,
        "controlPoints": [{"label": name, "position": (scale * turn * p).tolist(), "positionStatus": "defined"}
                          for name, p in points.items()]
        + [{"label": "F-9", "position": [0, 0, 0], "positionStatus": "undefined"}]}]}


TEXT = "# landmarks\n" + "".join(f"{x} {y} {z} {name}\n" for name, (x, y, z) in POINTS.items())
FORMS = [("a.json", POINTS), ("a.pp", picked(POINTS)), ("a.lnd", caesar(POINTS)), ("a.txt", TEXT),
         ("a.mrk.json", slicer(POINTS, "LPS")), ("b.mrk.json", slicer(POINTS, "RAS")),
         ("c.mrk.json", slicer(POINTS, "LPS", "m", 1)), ("d.mrk.json", slicer(POINTS, "LPS", ["cm"] * 3, 100))]


@pytest.mark.parametrize(("name", "content"), FORMS, ids=[name for name, _ in FORMS])
def test_every_form_gives_the_same_points_in_metres_and_in_order(tmp_path, name, content):
    found = read_landmarks(written(tmp_path / name, content))
    assert list(found) == list(POINTS)
    for label, point in found.items():
        np.testing.assert_allclose(point, POINTS[label], atol=1e-9)


def test_a_unit_overrides_what_the_format_means(tmp_path):
    path = written(tmp_path / "a.json", {name: (100 * np.array(p)).tolist() for name, p in POINTS.items()})
    np.testing.assert_allclose(read_landmarks(path, unit="cm")["nose"], POINTS["nose"])
    with pytest.warns(UserWarning, match=r"a\.json.*unit='"):
        read_landmarks(path)
    path = written(tmp_path / "a.lnd", caesar(POINTS).replace("SCAN", "scan"))
    np.testing.assert_allclose(read_landmarks(path, unit="m")["nose"], 1000 * np.array(POINTS["nose"]))


def test_points_of_slicer_follow_the_mesh_when_there_is_one(tmp_path):
    points = {"a": MESH.vertices[1], "b": MESH.vertices[2] + 0.01, "c": MESH.vertices[3]}
    for system in ("LPS", "RAS"):
        for turned in (1, -1):       # a mesh saved in RAS by an old version looks turned by half a circle
            flip = np.array([turned, turned, 1])
            path = written(tmp_path / "a.mrk.json", slicer({n: flip * p for n, p in points.items()}, system))
            found = read_landmarks(path, MESH)
            for name, point in points.items():
                np.testing.assert_allclose(found[name], point, atol=1e-9)
            assert read_landmark_vertices(path, MESH) == {"a": 1, "b": 2, "c": 3}


def test_vertices_and_points_of_faces_need_the_mesh(tmp_path):
    path = written(tmp_path / "a.json", {"v": 2, "f": {"face": 1, "bary": [0.2, 0.1, 0.7]}, "p": [0, 0.1, 1.4]})
    found = read_landmarks(path, MESH)
    np.testing.assert_array_equal(found["v"], MESH.vertices[2])
    np.testing.assert_allclose(found["f"], [0.1, 0, 1.05])
    np.testing.assert_array_equal(found["p"], [0, 0.1, 1.4])
    assert read_landmark_vertices(path, MESH) == {"v": 2, "f": 3, "p": 3}
    with pytest.raises(ValueError, match=r"mesh: .*a\.json gives landmark 'v' by vertex"):
        read_landmarks(path)


def test_what_is_written_comes_back(tmp_path):
    write_landmarks(tmp_path / "a.json", {name: np.array(p) for name, p in POINTS.items()})
    for name, point in read_landmarks(tmp_path / "a.json").items():
        np.testing.assert_array_equal(point, POINTS[name])
    write_landmarks(tmp_path / "b.json", {"v": np.int64(3), "w": 1})
    assert read_landmark_vertices(tmp_path / "b.json", MESH) == {"v": 3, "w": 1}
    with pytest.raises(ValueError, match="'nose' expected three finite numbers"):
        write_landmarks(tmp_path / "c.json", {"nose": np.array([0, np.nan, 0])})
    assert not (tmp_path / "c.json").exists()


@pytest.mark.parametrize(("name", "content", "words"), [
    ("a.json", "{not json", ["expected landmarks in JSON"]),
    ("a.json", [1, 2, 3], ["list"]),
    ("a.json", {}, ["found none"]),
    ("a.json", {"nose": [0, 1]}, ["'nose'", "[0, 1]"]),
    ("a.json", {"nose": "there"}, ["'nose'", "there"]),
    ("a.json", {"nose": True}, ["'nose'"]),
    ("a.json", {"nose": {"face": 0, "bary": [1, 1, 1]}}, ["'nose'", "bary"]),
    ("a.json", '{"nose": [0, NaN, 1]}', ["'nose'", "not finite"]),
    ("a.json", {"nose": 4}, ["'nose'", "vertex 4", "0..3"]),
    ("a.json", {"nose": -1}, ["'nose'", "vertex -1"]),
    ("a.json", {"nose": {"face": 9, "bary": [1, 0, 0]}}, ["'nose'", "face 9", "0..3"]),
    ("a.mrk.json", {"markups": [{"controlPoints": [{"label": "a"}]}]}, ["3D Slicer", "position"]),
    ("a.mrk.json", {"markups": [{"coordinateSystem": "IJK", "controlPoints": []}]}, ["3D Slicer", "IJK"]),
    ("a.mrk.json", slicer(POINTS, "LPS", "furlong"), ["coordinateUnits", "furlong"]),
    ("a.pp", "<PickedPoints><point x='1'", ["MeshLab"]),
    ("a.pp", "<PickedPoints><point x='1' y='2' name='a'/></PickedPoints>", ["MeshLab", "z"]),
    ("a.lnd", "AUX =\n1 0 1 24.03 14.73 18.98 Sellion\nEND =\n", ["line 2", "Sellion"]),
    ("a.lnd", "AUX =\nEND =\n", ["found none"]),
    ("a.txt", "0 0 1 nose\n0 0 1\n", ["line 2", "x y z name"]),
    ("a.txt", "0 0 1 nose\n0 zero 1 chin\n", ["line 2", "zero"]),
    ("a.txt", "0 0 1 nose\n0 0 2 nose\n", ["'nose' comes twice"]),
])
@pytest.mark.parametrize("read", [read_landmarks, read_landmark_vertices])
def test_bad_files_say_what_is_wrong(tmp_path, read, name, content, words):
    path = written(tmp_path / name, content)
    with pytest.raises(MeshFileError) as caught:
        read(path, MESH)
    message = str(caught.value)
    assert str(path) in message and "\n" not in message
    assert all(word in message for word in words), message


def test_a_missing_file(tmp_path):
    with pytest.raises(MeshFileError, match=r"none\.json: no such file"):
        read_landmarks(tmp_path / "none.json")


def test_landmarks_are_matched_by_name_in_the_order_of_the_template():
    scan = {name: np.array(POINTS[name]) for name in reversed(POINTS)} | {"extra": np.zeros(3)}
    names, vertices, points = match_landmarks({"nose": 5, "chin": 7, "left knee": 6, "10th rib": 8}, scan)
    assert names == ("nose", "left knee", "10th rib") and vertices.tolist() == [5, 6, 8]
    np.testing.assert_array_equal(points, [POINTS[name] for name in names])


def test_too_few_matches_show_both_lists():
    with pytest.raises(ValueError, match=r"at least 3 .* found 1; template: nose, chin; scan: Nose, chin, knee"):
        match_landmarks({"nose": 1, "chin": 2}, {"Nose": 1, "chin": 2, "knee": 3})
    with pytest.raises(ValueError, match="template: none; scan: none"):
        match_landmarks({}, {})


@pytest.mark.parametrize("ending", LANDMARK_ENDINGS)
@pytest.mark.parametrize("scan", ["anna.ply", "anna.ply.gz", "anna.scan.xyz"])
def test_the_landmark_file_beside_a_scan_is_found(tmp_path, ending, scan):
    assert landmarks_beside(tmp_path / scan) is None
    for name in ("landmarks.json", f"annabel{ending}"):                      # those of others
        (tmp_path / name).touch()
    assert landmarks_beside(tmp_path / scan) is None
    (tmp_path / f"anna{ending}").touch()
    assert landmarks_beside(tmp_path / scan) == tmp_path / f"anna{ending}"
    assert landmarks_beside(tmp_path / "else" / scan, tmp_path) == tmp_path / f"anna{ending}"


def test_the_template_of_a_registered_set_has_the_landmarks_of_the_set(tmp_path):
    with pytest.raises(ValueError, match=r"template.landmarks.json beside it; name the file with --template-landmarks"):
        read_template_landmarks(tmp_path / "template.ply", MESH)
    write_landmarks(tmp_path / "landmarks.json", {"a": 3})
    assert read_template_landmarks(tmp_path / "template.ply", MESH) == {"a": 3}
    write_landmarks(tmp_path / "template.json", {"b": 2})
    assert read_template_landmarks(tmp_path / "template.ply", MESH) == {"b": 2}
    assert read_template_landmarks(tmp_path / "x.ply", MESH, tmp_path / "landmarks.json") == {"a": 3}
