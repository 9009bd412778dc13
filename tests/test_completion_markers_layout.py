"""Marker layouts: placing, matching, files."""
import json

import numpy as np
import pytest

from completion.mocap.files.markers import MarkerFileError
from completion.mocap.marker_sets.layout import MarkerLayout
from scanprep.geometry.mesh import Mesh

MESH = Mesh([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]])       # faces +z
LAYOUT = MarkerLayout(("A", "B", "C"), np.array([3, 0, 2]), np.array([0.01, 0.01, 0.02]))
BETWEEN = MarkerLayout(("A", "B"), np.array([[0, 1, 2], [0, 2, 3]]), 0.1, np.array([[0.5, 0.25, 0.25], [0, 1, 0]]))


def test_markers_stand_above_the_skin():
    np.testing.assert_allclose(LAYOUT.place(MESH), [[0, 1, 0.01], [0, 0, 0.01], [1, 1, 0.02]], atol=1e-15)
    np.testing.assert_allclose(BETWEEN.place(MESH), [[0.5, 0.25, 0.1], [1, 1, 0.1]], atol=1e-15)


def test_placing_turns_with_the_body():
    R = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    R *= np.linalg.det(R)
    for layout in (LAYOUT, BETWEEN):
        moved = layout.place(MESH.with_vertices(MESH.vertices @ R.T + 3))
        np.testing.assert_allclose(moved, layout.place(MESH) @ R.T + 3, atol=1e-12)


@pytest.mark.parametrize("layout", [LAYOUT, BETWEEN], ids=["vertices", "points"])
def test_what_is_saved_comes_back(tmp_path, layout):
    layout.save(tmp_path / "a.json")
    back = MarkerLayout.load(tmp_path / "a.json", n_vertices=4)
    assert back.labels == layout.labels
    np.testing.assert_array_equal(back.vertices, layout.vertices)
    np.testing.assert_array_equal(back.distances, layout.distances)
    assert (back.weights is None) == (layout.weights is None)
    if layout.weights is not None:
        np.testing.assert_array_equal(back.weights, layout.weights)
    sets = json.loads((tmp_path / "a.json").read_text())["markersets"]
    assert {"type", "distance_from_skin", "indices"} <= set(sets[0])


def test_a_layout_of_several_sets_mixed_with_points(tmp_path):
    (tmp_path / "a.json").write_text(json.dumps({"markersets": [
        {"type": "body", "indices": {"A": 3}},
        {"type": "finger", "distance_from_skin": 0.004, "indices": {
            "B": {"vertices": [0, 1, 2], "weights": [0.5, 0.25, 0.25]}}}]}))
    layout = MarkerLayout.load(tmp_path / "a.json")
    np.testing.assert_allclose(layout.place(MESH), [[0, 1, 0.0095], [0.5, 0.25, 0.004]], atol=1e-15)


def test_matching_and_selecting():
    assert LAYOUT.match_labels(["X", "C", "A", "B"]) == ("C", "A", "B")
    picked = LAYOUT.select(["C", "A"])
    np.testing.assert_array_equal(picked.place(MESH), LAYOUT.place(MESH)[[2, 0]])
    with pytest.raises(ValueError, match=r"at least 3 .* found 2; layout: A, B, C; sequence: A, B, D"):
        LAYOUT.match_labels(["A", "B", "D"])
    with pytest.raises(ValueError, match="labels: D not among A, B, C"):
        LAYOUT.select(["D"])


def test_labels_spelled_otherwise_are_known_where_only_one_is_meant():
    layout = MarkerLayout(("L.Knee", "RBAC", "a.b", "AB"), np.arange(4), aliases={"RBAK": "RBAC"})
    labels = ("l_knee", "rbak", "RBAC-1", "A B", "L.Knee")
    found = layout.with_spellings(labels)
    assert dict(found.aliases) == {"RBAK": "RBAC", "l_knee": "L.Knee", "rbak": "RBAC"}     # A B may be either
    assert found.match_labels(labels, 0) == ("rbak", "L.Knee") and layout.with_spellings(("RBAK", "AB")) is layout


def test_markers_are_left_out_with_their_aliases():
    layout = MarkerLayout(("A", "B", "C"), np.array([3, 0, 2]), np.array([0.01, 0.02, 0.03]),
                          aliases={"X": "A", "Y": "B"}, loose=("A", "B"))
    rest = layout.without(["X"])
    assert (rest.labels, rest.aliases, rest.loose) == (("B", "C"), {"Y": "B"}, ("B",))
    np.testing.assert_array_equal(rest.distances, [0.02, 0.03])
    np.testing.assert_array_equal(rest.place(MESH), layout.place(MESH)[1:])
    assert layout.without([]).labels == layout.labels and BETWEEN.without(["A"]).weights.tolist() == [[0, 1, 0]]
    with pytest.raises(ValueError, match="labels: D not among A, B, C"):
        layout.without(["D"])


@pytest.mark.parametrize(("content", "words"), [
    ("{oops", ["JSON"]),
    ([], ["markersets"]),
    ({"markersets": []}, ["found none"]),
    ({"markersets": [{"type": "body"}]}, ["indices"]),
    ({"markersets": [{"indices": {"A": 0}, "distance_from_skin": "far"}]}, ["distance_from_skin"]),
    ({"markersets": [{"indices": {"A": "wrist"}}]}, ["'A'", "wrist"]),
    ({"markersets": [{"indices": {"A": 0}}, {"indices": {"A": 1}}]}, ["A comes more often"]),
    ({"markersets": [{"indices": {"A": -1}}]}, ["from 0"]),
    ({"markersets": [{"indices": {"A": {"vertices": [0, 1, 2], "weights": [1, 1, 1]}}}]}, ["sum to 1"]),
    ({"markersets": [{"indices": {"A": {"vertices": [0, 1, 2]}}}]}, ["weights"]),
    ({"markersets": [{"indices": {"A": 0, "B": 4}}]}, ["'B'", "vertex 4", "0..3"]),
])
def test_bad_layouts_say_what_is_wrong(tmp_path, content, words):
    path = tmp_path / "bad.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    with pytest.raises(MarkerFileError) as caught:
        MarkerLayout.load(path, n_vertices=4)
    message = str(caught.value)
    assert str(path) in message and "\n" not in message and all(word in message for word in words), message


def test_a_layout_of_another_body_is_refused_when_placing():
    with pytest.raises(ValueError, match=r"marker 'B' sits on vertex 7, the body has 0..3"):
        MarkerLayout(("A", "B"), np.array([0, 7])).place(MESH)
