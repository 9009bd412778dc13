"""The marker layouts that come along: every file, on its body, and told apart."""
import json

import numpy as np
import pytest
from people_bodies import kept, small_people

from completion.mocap.files.text import MarkerFileError
from completion.mocap.marker_sets.layout import MarkerLayout
from completion.mocap.marker_sets.named import (
    FOLDER,
    faces_digest,
    fitting_layout,
    layout_names,
    load_layout,
    read_layout,
)
from scanprep.geometry.landmarks import write_landmarks
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.rotations import exp
from scanprep.geometry.surface import Surface
from scanprep.synthetic.people import SyntheticPerson

COUNTS = {"biomech57": 57, "cmu41": 41, "helenhayes29": 29, "mosh67": 67, "plugingait39": 39, "vicon47": 47}
MIDDLE = {"C7", "T10", "CLAV", "STRN", "CV7", "TV2", "TV7", "SJN", "SXS", "Top.Head", "Front.Head", "Rear.Head",
          "V.Sacral", "ARIEL", "NAVL", "VL3"}
FILES = sorted(FOLDER.glob("*.json"))


@pytest.fixture(scope="module")
def person():
    return SyntheticPerson().mesh


def test_every_set_is_there_for_both_bodies():
    assert layout_names() == tuple(COUNTS)
    bodies = {(tree["name"], tree["body"]["name"]) for tree in (json.loads(p.read_text()) for p in FILES)}
    assert bodies == {(name, body) for name in COUNTS for body in ("synthetic people", "SCAPE and SPRING")}


@pytest.mark.parametrize("path", FILES, ids=lambda p: p.stem)
def test_files_are_whole(path):
    tree = json.loads(path.read_text())
    layout = MarkerLayout.load(path, tree["body"]["vertices"])
    assert len(layout.labels) == COUNTS[tree["name"]]
    assert len(set(layout.vertices.tolist())) == len(layout.labels)
    assert all(label[0] in "LR" for label in layout.labels if label not in MIDDLE)
    partners = {"LR"["RL".index(label[0])] + label[1:] for label in layout.labels if label not in MIDDLE}
    assert {label for label in partners if label not in layout.labels} <= {"LBAC", "LBAK", "L.Offset"}


@pytest.mark.parametrize("name", COUNTS)
def test_left_is_the_persons_left_and_the_front_is_ahead(name, person):
    layout = load_layout(name, person)
    place = dict(zip(layout.labels, layout.place(person), strict=True))
    for label, at in place.items():                       # a person faces -y and has the left side at +x
        if label not in MIDDLE:
            assert np.sign(at[0]) == (1 if label[0] == "L" else -1), label
        else:
            assert abs(at[0]) < 0.005, label
    front = [x for x in ("CLAV", "STRN", "SJN", "SXS", "Front.Head", "LFHD", "LFWT", "LASI", "L.ASIS", "LIAS", "LTOE",
                         "LFM2", "L.Toe") if x in place]
    back = [x for x in ("C7", "T10", "CV7", "TV7", "Rear.Head", "LBHD", "LBWT", "LPSI", "V.Sacral", "LIPS", "LHEE",
                        "LFCC", "L.Heel") if x in place]
    assert max(place[x][1] for x in front) < -0.02 and min(place[x][1] for x in back) > 0.02
    knee, ankle = (next(place[x] for x in place if x.lower() in names) for names in (
        ("lkne", "l.knee", "lfle"), ("lank", "l.ankle", "lfal")))
    assert 0.4 < knee[2] < 0.6 and 0.03 < ankle[2] < 0.15


def test_a_body_is_known_by_its_triangles_alone(person):
    moved = person.with_vertices(1.1 * person.vertices @ exp(np.array([0.3, 0.2, 1.0])).T)
    np.testing.assert_array_equal(load_layout("cmu41", moved).vertices,
                                  load_layout("cmu41", person).vertices)
    assert faces_digest(person.faces) == faces_digest(person.faces.astype(np.int32))
    assert faces_digest(person.faces) != faces_digest(person.faces[:, [1, 2, 0]])


def test_other_bodies_and_names_are_refused_with_a_way_out(person):
    with pytest.raises(ValueError, match=r"expected a marker layout of biomech57, .* got 'cmu40'; .*markersets"):
        load_layout("cmu40", person)
    with pytest.raises(ValueError, match=r"synthetic people \(12500 vertices\), SCAPE and SPRING \(12500 vertices\); "
                                         r"got another triangulation with 12500 vertices; .*indices"):
        load_layout("cmu41", Mesh(person.vertices, person.faces[:, [1, 2, 0]]))


@pytest.mark.parametrize("name", COUNTS)
def test_a_template_that_kept_some_vertices_carries_the_markers_there(name, person):
    model = small_people()
    whole, small = load_layout(name, person), load_layout(name, model.template, kept())
    rest = Mesh(person.vertices[kept()], model.template.faces)
    off = np.linalg.norm(small.place(rest) - whole.place(person), axis=1)
    assert small.labels == whole.labels and small.loose == whole.loose and off.mean() < 0.008 and off.max() < 0.032
    with pytest.raises(ValueError, match="another triangulation"):
        load_layout(name, model.template)


def test_aliases_stand_in_where_the_marker_is_missing(person):
    layout = load_layout("cmu41", person)
    assert layout.match_labels(["RBAK", "C7", "T10"]) == ("RBAK", "C7", "T10")
    assert layout.match_labels(["RBAK", "C7", "T10", "RBAC"]) == ("C7", "T10", "RBAC")
    np.testing.assert_array_equal(layout.select(["RBAK"]).vertices, layout.select(["RBAC"]).vertices)
    assert layout.select(["RBAK", "C7"]).loose == ("RBAK",)
    with pytest.raises(ValueError, match="aliases: expected new labels for markers of the layout, got 'X' for 'Y'"):
        MarkerLayout(("A",), np.array([0]), aliases={"X": "Y"})
    with pytest.raises(ValueError, match="loose: B not among A"):
        MarkerLayout(("A",), np.array([0]), loose=("B",))


def test_loose_markers_and_aliases_are_kept_in_files(person, tmp_path):
    layout = load_layout("cmu41", person).with_places({"RBAK": 17})
    layout.save(tmp_path / "a.json")
    back = MarkerLayout.load(tmp_path / "a.json")
    assert set(back.loose) == set(layout.loose) and back.aliases == layout.aliases
    order = [back.labels.index(label) for label in layout.labels]
    np.testing.assert_array_equal(back.vertices[order], layout.vertices)
    np.testing.assert_array_equal(np.asarray(back.distances)[order], layout.distances)
    assert layout.vertices[layout.labels.index("RBAC")] == 17


def test_the_layout_that_knows_most_labels_is_found(person):
    for name in COUNTS:
        layout = load_layout(name, person)
        assert fitting_layout(layout.labels, person)[1] == name
    told = "of these 3 the sets know cmu41 1, .*biomech57 0.*scape layout list.*--layout"
    with pytest.raises(ValueError, match=told):
        fitting_layout(["LTHI", "x", "y"], person)


def test_markers_that_some_wear_on_wands_are_said_and_kept(person, tmp_path):
    layout = load_layout("plugingait39", person)
    assert set(layout.wands) == {"LTHI", "RTHI", "LTIB", "RTIB"} and set(layout.wands) < set(layout.loose)
    layout.save(tmp_path / "a.json")
    assert set(MarkerLayout.load(tmp_path / "a.json").wands) == set(layout.wands)
    assert layout.select(["RSHN", "C7"]).wands == ("RSHN",) and not layout.without(layout.wands).wands
    assert layout.without(layout.wands).merge(layout.select(layout.wands)).wands == layout.wands
    with pytest.raises(ValueError, match="wands: B not among A"):
        MarkerLayout(("A",), np.array([0]), wands=("B",))


@pytest.mark.parametrize("name", COUNTS)
def test_no_marker_is_inside(name, person):
    layout = load_layout(name, person)
    points = layout.place(person)
    found = Surface(person).closest(points)
    above = np.einsum("ld,ld->l", points - found.points, person.face_normals[found.faces])
    assert above.min() > 0.004 and (above < np.asarray(layout.distances) + 1e-9).all()


def test_places_clicked_on_the_template_are_a_layout(tmp_path):
    """Saved by `scape pick` in any format; others than on the template are refused, layouts are read as before."""
    person = small_people()
    body, rng = person.template, np.random.default_rng(0)
    points, face, bary = body.sample(12, rng)
    clicked = {f"M{i:02d}": point for i, point in enumerate(points)}
    for ending in (".landmarks.json", ".pp", ".mrk.json"):
        write_landmarks(tmp_path / f"markers{ending}", clicked)
        layout = read_layout(tmp_path / f"markers{ending}", body)
        assert layout.labels == tuple(clicked)
        np.testing.assert_allclose(layout.skin_points(body.vertices), points, atol=1e-6)
        posed = person.vertices(0.2 * rng.normal(size=(len(person.skeleton.parents), 3)), None)
        np.testing.assert_allclose(layout.skin_points(posed), np.einsum("nk,nkd->nd", bary, posed[body.faces[face]]),
                                   atol=1e-5)
    write_landmarks(tmp_path / "far.json", {**clicked, "M03": points[3] + [0, 0.6, 0]})
    with pytest.raises(MarkerFileError, match=r"far\.json: .*'M03' is \d+ mm off"):
        read_layout(tmp_path / "far.json", body)
    layout.save(tmp_path / "layout.json")
    np.testing.assert_array_equal(read_layout(tmp_path / "layout.json", body).vertices, layout.vertices)
