"""The registered set: adding, going on after an interruption, loading, and what is said when it is damaged."""
import csv
import json
import shutil

import numpy as np
import pytest
import trimesh

from scanprep.dataset import RegisteredSet
from scanprep.geometry.files import MeshFileError, read_mesh, read_registered
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.storage import StorageError
from scanprep.skeleton.tree import Skeleton

SPHERE = trimesh.creation.icosphere(1, 0.9)
TEMPLATE = Mesh(SPHERE.vertices, SPHERE.faces)
SKELETON = Skeleton(np.arange(80) // 40, (-1, 0), np.zeros((2, 3)))


def body(seed):
    return TEMPLATE.vertices + 0.01 * np.random.default_rng(seed).normal(size=TEMPLATE.vertices.shape)


@pytest.fixture
def full(tmp_path):
    """Three poses of Ann, one of Bob, one of Cid."""
    registered = RegisteredSet.create(tmp_path / "set", TEMPLATE, {"made by": "hand"})
    for i, (name, subject, sex) in enumerate([("ann1", "Ann", "f"), ("bob1", "Bob", "m"), ("ann2", "Ann", "f"),
                                              ("cid1", "Cid", ""), ("ann3", "Ann", "f")]):
        registered = registered.add(name, body(i), subject, pose=f"pose {i}", sex=sex)
    return registered.with_skeleton(SKELETON)


def test_what_was_added_is_loaded(full):
    back = RegisteredSet.load(full.folder)
    assert back.entries == full.entries and back.names == ("ann1", "bob1", "ann2", "cid1", "ann3")
    assert back.subjects == ("Ann", "Bob", "Cid") and back.info == {"made by": "hand"}
    np.testing.assert_array_equal(back.template.vertices, TEMPLATE.vertices)
    np.testing.assert_array_equal(back.skeleton.part_of_face, SKELETON.part_of_face)
    np.testing.assert_array_equal(back.vertices(), [body(i) for i in range(5)])
    np.testing.assert_array_equal(back.vertices(["cid1", "ann1"]), [body(3), body(0)])
    np.testing.assert_array_equal(back.poses("Bob"), [body(1)])
    np.testing.assert_array_equal(back.poses(), [body(0), body(2), body(4)])         # of the one with the most
    np.testing.assert_array_equal(back.shapes(), [body(0), body(1), body(3)])


def test_the_folder_is_plain_files(full):
    assert sorted(p.name for p in full.folder.iterdir()) == ["meshes", "set.csv", "set.json", "skeleton.json",
                                                             "template.ply"]
    rows = list(csv.DictReader((full.folder / "set.csv").open()))
    assert rows[1] == {"name": "bob1", "subject": "Bob", "pose": "pose 1", "sex": "m", "file": "meshes/bob1.ply"}
    np.testing.assert_array_equal(read_mesh(full.folder / rows[1]["file"]).vertices, body(1))
    registered = read_registered(full.folder)
    assert registered.names == ("ann1", "ann2", "ann3", "bob1", "cid1")
    np.testing.assert_array_equal(registered.faces, TEMPLATE.faces)


def test_adding_a_name_again_replaces_its_row_and_its_mesh(full):
    again = full.add("bob1", Mesh(body(9), TEMPLATE.faces), "Bert")
    assert again.names == full.names and again.entries[1].subject == "Bert"
    back = RegisteredSet.load(full.folder)
    assert back.entries == again.entries
    np.testing.assert_array_equal(back.vertices(["bob1"]), [body(9)])
    assert len(list((full.folder / "meshes").iterdir())) == 5


@pytest.mark.parametrize("name", ["scan (1), late", "Zoë_07", "a.b.c", "x+y", "café 100%"])
def test_names_that_people_give_their_scans(full, name):
    added = full.add(name, body(6), 'Ann "Lee", senior')
    back = RegisteredSet.load(full.folder)
    assert back.entries == added.entries and back.names[-1] == name
    np.testing.assert_array_equal(back.vertices([name]), [body(6)])
    assert set(read_registered(full.folder).names) == set(back.names)


def test_two_who_add_by_turns_keep_each_others_rows(full):
    other = RegisteredSet.load(full.folder)
    full.add("x", body(1), "X")
    assert other.add("y", body(2), "Y").names[-2:] == ("x", "y")


def test_a_set_of_another_template_is_not_overwritten(full):
    with pytest.raises(ValueError, match="holds a set of another template"):
        RegisteredSet.create(full.folder, Mesh(2 * TEMPLATE.vertices, TEMPLATE.faces))
    assert RegisteredSet.load(full.folder).entries == full.entries


@pytest.mark.parametrize(("name", "mesh", "says"), [
    ("../x", TEMPLATE, "name"), ("", TEMPLATE, "name"), (".x", TEMPLATE, "name"), ("a/b", TEMPLATE, "name"),
    ("a\\b", TEMPLATE, "name"), ("a\nb", TEMPLATE, "name"),
    ("x", np.zeros((3, 3)), r"mesh: expected vertices \(42, 3\), got \(3, 3\)"),
    ("x", Mesh(TEMPLATE.vertices, TEMPLATE.faces[::-1]), "x: .*from face 0"),
    ("x", Mesh(TEMPLATE.vertices, TEMPLATE.faces[1:]), "x: .*42 vertices and 79 faces"),
    ("x", np.full((42, 3), np.nan), "not finite"),
])
def test_what_cannot_be_added(full, name, mesh, says):
    with pytest.raises(ValueError, match=says):
        full.add(name, mesh)
    assert RegisteredSet.load(full.folder).entries == full.entries
    assert len(list((full.folder / "meshes").iterdir())) == 5


def test_unknown_names_and_subjects(full):
    with pytest.raises(ValueError, match=r"names: eve not in .*ann1"):
        full.vertices(["eve"])
    with pytest.raises(ValueError, match="subject: expected one of Ann, Bob, Cid, got 'Eve'"):
        full.poses("Eve")


def test_an_empty_set(tmp_path):
    empty = RegisteredSet.create(tmp_path / "set", TEMPLATE)
    assert empty.names == () and empty.vertices().shape == (0, 42, 3) and empty.skeleton is None
    with pytest.raises(ValueError, match="holds no meshes"):
        empty.poses()


def edit_json(folder, **change):
    path = folder / "set.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | change))


@pytest.mark.parametrize(("damage", "says"), [
    (lambda f: shutil.rmtree(f), r"set\.json: no such file; expected the header of a registered set"),
    (lambda f: (f / "set.json").write_text("{"), r"set\.json: expected .* in JSON, cannot read it"),
    (lambda f: edit_json(f, kind="model"), r"set\.json: expected the header of a registered set"),
    (lambda f: edit_json(f, version=7), r"set\.json: version 7 .*known: 1"),
    (lambda f: edit_json(f, faces=3), r"template\.ply: found Mesh\(42 vertices, 80 faces\), set\.json says"),
    (lambda f: (f / "template.ply").unlink(), r"template\.ply: no such file"),
    (lambda f: (f / "set.csv").unlink(), r"set\.csv: no such file"),
    (lambda f: (f / "set.csv").write_text(""), r"set\.csv: line 1: expected the columns name,subject"),
    (lambda f: (f / "set.csv").write_text("name,file\nx,meshes/x.ply\n"), r"set\.csv: line 2: .* meshes/x\.ply"),
    (lambda f: (f / "set.csv").write_text("name,file\nx\n"), r"set\.csv: line 2: expected 2 values, found 1"),
    (lambda f: (f / "set.csv").write_text("name,file\n" + 2 * "x,template.ply\n"), "line 3: .* comes twice"),
    (lambda f: (f / "skeleton.json").write_text("[]"), r"skeleton\.json: expected a skeleton"),
    (lambda f: Skeleton([0, 1], (-1, 0), np.zeros((2, 3))).save(f / "skeleton.json"),
     r"skeleton\.json: expected 80 faces"),
])
def test_a_damaged_set_says_which_file_and_what(full, damage, says):
    damage(full.folder)
    with pytest.raises((StorageError, MeshFileError), match=says):
        RegisteredSet.load(full.folder)


def test_a_damaged_mesh_is_named_when_it_is_read(full):
    path = full.folder / "meshes" / "cid1.ply"
    path.write_bytes(path.read_bytes()[:500])
    registered = RegisteredSet.load(full.folder)
    with pytest.raises(MeshFileError, match=r"cid1\.ply: truncated"):
        registered.shapes()
    np.testing.assert_array_equal(registered.poses("Ann"), [body(0), body(2), body(4)])
