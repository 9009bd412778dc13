"""Landmark files of every kind, and what is said when they are wrong."""
import json
import re

import numpy as np
import pytest
import trimesh

from scanprep.decimation.decimate import decimate
from scanprep.geometry import landmark_writing
from scanprep.geometry.files import MeshFileError, write_mesh
from scanprep.geometry.landmark_names import TEN, landmark_name, pair_names, translate_landmarks
from scanprep.geometry.landmarks import (
    LANDMARK_ENDINGS,
    find_template_landmarks,
    landmarks_beside,
    match_landmarks,
    names_no_landmark,
    read_landmark_vertices,
    read_landmarks,
    read_template_landmarks,
    try_match_landmarks,
    write_landmarks,
)
from scanprep.geometry.mesh import Mesh
from scanprep.synthetic.people import SyntheticPerson

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


def fiducials(points, system):
    """As 3D Slicer 4 and 5 write them; the last two numbers are of version 5, and say that the last is not placed."""
    turn = np.array([1, 1, 1]) if system in ("LPS", "1") else np.array([-1, -1, 1])
    rows = [f"vtkMRMLMarkupsFiducialNode_{i},{','.join(map(str, 1000 * turn * p))},0,0,0,1,1,1,0,\"{name}\",,,2,0\n"
            for i, (name, p) in enumerate(points.items())]
    return ("# Markups fiducial file version = 4.11\n" + f"# CoordinateSystem = {system}\n" * bool(system)
            + "# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID\n"
            + "".join(rows) + "9,0,0,0,0,0,0,1,1,1,0,F-9,,,0,0\n")


def scalismo(points):
    return [{"id": name, "coordinates": p, "description": "x"} for name, p in points.items()]


def marker_set(points, frame="<socket_parent_frame>/bodyset/torso</socket_parent_frame>"):
    rows = "".join(f'<Marker name="{name}">{frame}<location>{" ".join(map(str, p))}</location><fixed>true</fixed>'
                   "</Marker>" for name, p in points.items())
    return f'<?xml version="1.0"?><OpenSimDocument Version="40000"><MarkerSet name="m"><objects>{rows}</objects>' \
           "</MarkerSet></OpenSimDocument>"


def table(points, heading="name,x,y,z", mark=","):
    rows = "".join(f'"{name}"{mark}{mark.join(map(str, p))}\n' for name, p in points.items())
    return f"\ufeff{heading}\n{rows}"


TEXT = "# landmarks\n" + "".join(f"{x} {y} {z} {name}\n" for name, (x, y, z) in POINTS.items())
FORMS = [("a.json", POINTS), ("a.pp", picked(POINTS)), ("a.lnd", caesar(POINTS)), ("a.txt", TEXT),
         ("a.mrk.json", slicer(POINTS, "LPS")), ("b.mrk.json", slicer(POINTS, "RAS")),
         ("c.mrk.json", slicer(POINTS, "LPS", "m", 1)), ("d.mrk.json", slicer(POINTS, "LPS", ["cm"] * 3, 100)),
         *((f"{system or 'none'}.fcsv", fiducials(POINTS, system)) for system in ("LPS", "RAS", "0", "1", "")),
         ("a.scalismo.json", scalismo(POINTS)), ("scalismo.json", scalismo(POINTS)), ("a.csv", table(POINTS)),
         ("b.csv", table(POINTS, "Label;X;Y;Z", ";")), ("a.xml", marker_set(POINTS)),
         ("b.xml", marker_set(POINTS, "<body>torso</body>"))]
WRITTEN = (".json", ".csv", ".pp", ".mrk.json")


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


@pytest.mark.parametrize("ending", WRITTEN)
def test_every_format_comes_back(tmp_path, ending):
    rng = np.random.default_rng(0)
    points = {name: rng.normal(size=3) for name in ("nose", "left knee", "Gr\u00f6\u00dfe", "10th, \"rib\" & <so> on",
                                                    "=1+1", "-knee", "'=x", "'x")}
    write_landmarks(tmp_path / f"a{ending}", points)
    assert ending != ".csv" or not re.search(r"^[=+@-]", (tmp_path / "a.csv").read_text(), re.MULTILINE)
    found = read_landmarks(tmp_path / f"a{ending}")
    assert list(found) == list(points)
    np.testing.assert_allclose(np.array([*found.values()]), np.array([*points.values()]), rtol=0, atol=1e-9)
    write_landmarks(tmp_path / f"mm{ending}", points, "mm")
    np.testing.assert_allclose(read_landmarks(tmp_path / f"mm{ending}", unit="mm")["nose"], points["nose"], atol=1e-9)
    write_landmarks(tmp_path / f"again{ending}", found)
    assert (tmp_path / f"again{ending}").read_bytes() == (tmp_path / f"a{ending}").read_bytes()


@pytest.mark.parametrize("ending", [".fcsv", ".scalismo.json", ".xml", ".lnd", ".txt", ".ply", ""])
def test_other_formats_are_not_written(tmp_path, ending):
    with pytest.raises(ValueError, match=rf"a{ending}: expected a name ending in \.json, \.csv, \.pp, \.mrk\.json"):
        write_landmarks(tmp_path / f"a{ending}", {"nose": np.ones(3)})
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("ending", WRITTEN)
@pytest.mark.parametrize("name", ["bell\x07", "two\nlines", "\x1b[2J", "tab\tin", "\ufffe"])
def test_a_name_with_control_characters_comes_back_or_is_refused(tmp_path, ending, name):
    try:
        write_landmarks(tmp_path / f"a{ending}", {name: np.array([1.0, 2, 3])})
    except ValueError as error:
        assert "write JSON" in str(error)
        return
    assert [*read_landmarks(tmp_path / f"a{ending}")] == [name]


@pytest.mark.parametrize(("name", "content"), [form for form in FORMS if form[0][:2] == "a." or form[0] == "LPS.fcsv"],
                         ids=lambda value: value if isinstance(value, str) and len(value) < 15 else "")
def test_a_file_cut_off_is_refused_or_has_the_points_before(tmp_path, name, content):
    """Of files of lines the rows before the cut may be there, the last of them shorter; no other is wrong."""
    data = written(tmp_path / name, content).read_bytes()
    for length in range(1, len(data) - 1, 7):
        (tmp_path / name).write_bytes(data[:length])
        try:
            found = read_landmarks(tmp_path / name)
        except MeshFileError as error:
            assert name in str(error) and "\n" not in str(error)
            continue
        assert name.endswith((".fcsv", ".csv", ".lnd", ".txt")) or data[length:].strip() in (b"", b"}", b"]")
        for label in [*found][:-1]:
            np.testing.assert_allclose(found[label], POINTS[label], atol=1e-9)


def test_opensim_reads_our_markers(tmp_path):
    opensim = pytest.importorskip("opensim", reason="OpenSim's own library is not installed")
    (tmp_path / "a.xml").write_text(landmark_writing.marker_set({n: ("/ground", p) for n, p in POINTS.items()}))
    markers = opensim.MarkerSet(str(tmp_path / "a.xml"))
    assert [markers.get(i).getName() for i in range(markers.getSize())] == list(POINTS)
    for i, point in enumerate(POINTS.values()):
        np.testing.assert_allclose([markers.get(i).get_location()[k] for k in range(3)], point, atol=1e-9)
        assert markers.get(i).getParentFrameName() == "/ground"


def test_vertices_come_back_and_what_is_no_point_is_not_written(tmp_path):
    write_landmarks(tmp_path / "b.json", {"v": np.int64(3), "w": 1})
    assert read_landmark_vertices(tmp_path / "b.json", MESH) == {"v": 3, "w": 1}
    with pytest.raises(ValueError, match="'nose' expected three finite numbers"):
        write_landmarks(tmp_path / "c.json", {"nose": np.array([0, np.nan, 0])})
    assert not (tmp_path / "c.json").exists()


@pytest.mark.parametrize(("name", "content", "words"), [
    ("a.json", "{not json", ["expected landmarks in JSON"]),
    ("a.json", [1, 2, 3], ["list"]),
    ("a.json", {"nose": [0, 1]}, ["'nose'", "[0, 1]"]),
    ("a.json", {"nose": {"face": 0, "bary": [1, 1, 1]}}, ["'nose'", "bary"]),
    ("a.json", '{"nose": [0, NaN, 1]}', ["'nose'", "not finite"]),
    ("a.json", {"nose": 4}, ["'nose'", "vertex 4", "0..3"]),
    ("a.json", {"nose": {"face": 9, "bary": [1, 0, 0]}}, ["'nose'", "face 9", "0..3"]),
    ("a.mrk.json", {"markups": [{"controlPoints": [{"label": "a"}]}]}, ["3D Slicer", "position"]),
    ("a.mrk.json", {"markups": [{"coordinateSystem": "IJK", "controlPoints": []}]}, ["3D Slicer", "IJK"]),
    ("a.mrk.json", slicer(POINTS, "LPS", "furlong"), ["coordinateUnits", "furlong"]),
    ("a.pp", "<PickedPoints><point x='1'", ["MeshLab"]),
    ("a.pp", "<PickedPoints><point x='1' y='2' name='a'/></PickedPoints>", ["MeshLab", "z"]),
    ("a.lnd", "AUX =\n1 0 1 24.03 14.73 18.98 Sellion\nEND =\n", ["line 2", "Sellion"]),
    ("a.txt", "0 0 1 nose\n0 0 1\n", ["line 2", "x y z name"]),
    ("a.txt", "0 0 1 nose\n0 0 2 nose\n", ["'nose' comes twice"]),
    ("a.fcsv", fiducials(POINTS, "IJK"), ["CoordinateSystem", "IJK"]),
    ("a.fcsv", fiducials(POINTS, "LPS").replace("1600.0", "nan"), ["line 4", "expected id,x,y,z"]),
    ("a.fcsv", "# CoordinateSystem = LPS\nnose,1,2,3\n", ["# columns = id,x,y,z"]),
    ("a.csv", "nose,0,0,1\n", ["line 1", "heading with name, x, y, z"]),
    ("a.csv", "name,x,y,z\nnose,0,0,nan\n", ["line 2", "nan"]),
    ("a.scalismo.json", [{"id": "nose", "coordinates": [1, 2]}], ["'nose'", "[1, 2]"]),
    ("a.mrk.json", {"markups": [{"controlPoints": [{"label": "a", "position": [1, "b", 2]}]}]}, ["point 0", "x, y, z"]),
    ("a.xml", marker_set(POINTS).replace("torso", "pelvis", 1), ["'nose' on pelvis", "'left knee' on torso", "TRC"]),
    ("a.xml", marker_set(POINTS, ""), ["OpenSim", "marker 1 'nose'", "socket_parent_frame"]),
    ("a.xml", marker_set(POINTS).replace("-0.2", "far"), ["OpenSim", "marker 1 'nose'", "location"]),
])
@pytest.mark.parametrize("read", [read_landmarks, read_landmark_vertices])
def test_bad_files_say_what_is_wrong(tmp_path, read, name, content, words):
    path = written(tmp_path / name, content)
    with pytest.raises(MeshFileError) as caught:
        read(path, MESH)
    message = str(caught.value)
    assert str(path) in message and "\n" not in message
    assert all(word in message for word in words), message


@pytest.mark.parametrize(("name", "content"), [
    ("a.json", {}), ("a.json", []), ("a.mrk.json", {"markups": []}), ("a.pp", "<PickedPoints/>"),
    ("a.lnd", "AUX =\nEND =\n"), ("a.fcsv", fiducials({}, "LPS")), ("a.csv", "name,x,y,z\n"), ("a.txt", "# none\n"),
    ("a.xml", "<OpenSimDocument/>")])
def test_a_file_may_say_that_no_landmark_is_known(tmp_path, name, content):
    """As in the set of scans without landmarks: its readers go on as if there were no file."""
    path = written(tmp_path / name, content)
    assert names_no_landmark(path) and read_landmarks(path) == {} == read_landmark_vertices(path, MESH)
    assert try_match_landmarks(path, {"navel": 1}, read_landmarks(path)) is None            # without a warning
    write_mesh(tmp_path / "a.ply", MESH)
    assert find_template_landmarks(tmp_path / "a.ply", MESH, path) == {}
    with pytest.raises(ValueError, match=r"a\.ply: expected its landmarks in a\.landmarks\.json"):
        read_template_landmarks(tmp_path / "a.ply", MESH, path)


def test_landmarks_are_matched_by_name_in_the_order_of_the_template():
    scan = {name: np.array(POINTS[name]) for name in reversed(POINTS)} | {"extra": np.zeros(3)}
    names, vertices, points = match_landmarks({"nose": 5, "chin": 7, "left knee": 6, "10th rib": 8}, scan)
    assert names == ("nose", "left knee", "10th rib") and vertices.tolist() == [5, 6, 8]
    np.testing.assert_array_equal(points, [POINTS[name] for name in names])


def test_too_few_matches_show_both_lists():
    with pytest.raises(ValueError, match=r"at least 3 .* found 2; template: nose, chin; scan: Nose, chin, knee"):
        match_landmarks({"nose": 1, "chin": 2}, {"Nose": 1, "chin": 2, "knee": 3})
    with pytest.raises(ValueError, match="template: none; scan: none"):
        match_landmarks({}, {})


@pytest.mark.parametrize("ending", LANDMARK_ENDINGS)
@pytest.mark.parametrize("scan", ["anna.ply", "anna.ply.gz", "anna.xyz"])
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


@pytest.mark.parametrize(("ours", "theirs"), [
    ("left middle finger", ("l_hand", "LeftHand", "hand left", "Hand_L", "HAND, LEFT", "middle finger left hand",
                            "Lt. Dactylion", "leftFingertip")),
    ("right toe", ("R.Foot", "right_foot", "Right foot", "toe in right leg", "Rt. Digit II", "RightBigToe")),
    ("left elbow outside", ("elbow_l", "LeftElbow", "elbow (outside) left arm", "Lt. Olecranon")),
    ("right knee", ("kneeR", "knee in right leg", "Rt. Femoral Lateral Epicn.", "RIGHT KNEE")),
    ("right knee inside", ("knee (inside) in right leg", "right knee inside")),
    ("top of head", ("Crown", "head top", "TopOfHead", "Vertex", "top_of_head")), ("navel", ("Belly button", "cornea")),
    ("left nipple", ("tit, left", "Lt. Thelion/Bustpoint")), ("neck back", ("neck (back)", "Cervicale")),
    ("mole 3", ("Mole_3",)), ("left scar", ("scar (left)",))])
def test_a_place_has_one_name_however_it_is_spelt(ours, theirs):
    assert {landmark_name(name) for name in (ours, *theirs)} == {ours}


def test_the_ten_of_the_readme_are_what_everything_wants():
    readme = ["crown", "navel", *(f"{side} {name}" for name in ("hand", "foot", "elbow", "knee")
                                  for side in ("left", "right"))]
    assert [landmark_name(name) for name in readme] == list(TEN)
    assert len(pair_names(TEN, readme)) == 10


def test_a_name_spelt_alike_comes_before_a_synonym():
    assert translate_landmarks({"crown": 1, "top of head": 2, "l_knee": 3, "left knee cap": 4}) == {
        "top of head": 2, "left knee": 3, "left knee cap": 4}
    assert pair_names(["left hand", "left wrist"], ["left wrist", "left hand", "left middle finger"]) == [
        ("left hand", "left hand"), ("left wrist", "left wrist")]
    assert pair_names(["left hand", "left middle finger"], ["LeftHand"]) == [("left hand", "LeftHand")]


@pytest.mark.parametrize("cloud", [False, True])
@pytest.mark.parametrize(("name", "content", "factor"), [
    ("a.mrk.json", lambda p: slicer(p, "LPS", scale=1), "1000"),          # a scan in metres, which Slicer calls mm
    ("a.mrk.json", lambda p: slicer(p, "RAS", scale=1), "1000"),
    ("a.pp", lambda p: picked({n: 1000 * x for n, x in p.items()}), "0.001"),         # the other way round
    ("a.landmarks.txt", lambda p: "".join(f"{x} {y} {z} {n}\n" for n, (x, y, z) in
                                          ((n, 100 * v) for n, v in p.items())), "0.01"),
    ("a.pp", picked, None), ("a.mrk.json", lambda p: slicer(p, "RAS"), None)])
def test_landmarks_in_another_unit_than_the_scan_are_brought_onto_it(tmp_path, recwarn, name, content, factor, cloud):
    rng = np.random.default_rng(0)
    scan = rng.normal(size=(2000, 3)) * [0.1, 0.3, 0.6]
    points = dict(zip(("crown", "navel", "left hand", "right hand"), scan[:4] + 0.002, strict=True))
    path = written(tmp_path / name, content(points))
    found = read_landmarks(path, scan if cloud else Mesh(scan, np.zeros((0, 3), dtype=np.int64)))
    for label, place in points.items():
        np.testing.assert_allclose(found[label], place, atol=1e-6, err_msg=label)
    said = [str(one.message) for one in recwarn]
    assert len(said) == bool(factor) and all(f"multiplied by {factor} they do" in line for line in said), said


def test_axes_that_a_slicer_file_tells_are_doubted_only_where_the_others_fit_far_better(tmp_path):
    """A body looks alike from in front and behind: few triangles, and clicks between their corners, tell nothing."""
    body = decimate(SyntheticPerson().mesh, 300)
    for seed in range(8):
        points = dict(zip("abcdefghijkl", body.sample(12, np.random.default_rng(seed))[0], strict=True))
        write_landmarks(tmp_path / "a.mrk.json", points)
        found = read_landmarks(tmp_path / "a.mrk.json", body)
        assert all(np.allclose(found[name], point, atol=1e-6) for name, point in points.items()), seed
        turned = body.with_vertices(body.vertices * [-1, -1, 1])            # a scan that was saved in RAS
        found = read_landmarks(tmp_path / "a.mrk.json", turned)
        assert all(np.allclose(found[name], point * [-1, -1, 1], atol=1e-6) for name, point in points.items()), seed


def test_joints_inside_a_thick_body_keep_their_unit(tmp_path):
    """4% of the body's size below its surface; as inches for centimetres they would be nearer to it, in one corner."""
    body = trimesh.creation.box(bounds=[[0, 0, 0], [1, 1, 1]])
    joints = {str(k): np.array([0.07, y, 0.5 + 0.4 * (-1) ** k]) for k, y in enumerate(np.linspace(0.1, 0.95, 9))}
    write_landmarks(tmp_path / "a.json", joints)
    found = read_landmarks(tmp_path / "a.json", Mesh(body.vertices, body.faces))
    for name, place in joints.items():
        np.testing.assert_allclose(found[name], place)
