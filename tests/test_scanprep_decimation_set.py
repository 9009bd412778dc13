import numpy as np
import pytest
from jointed_bodies import bent, crab
from scanned_shapes import bumpy

from scanprep.dataset import RegisteredSet
from scanprep.decimation.registered_set import decimate_set, write_decimated_set
from scanprep.geometry.landmarks import read_landmark_vertices, write_landmarks
from scanprep.geometry.mesh import template_problem
from scanprep.geometry.surface import Surface
from scanprep.skeleton.tree import Skeleton

KEEP = np.array([0, 17, 333, 820])


@pytest.fixture(scope="module")
def body():
    return crab()


@pytest.fixture(scope="module")
def poses(body):
    return np.stack([bent(body, [0, a, b], [0, -b, a]) for a, b in ((0, 1.2), (1, 0), (-1, 0.5), (0.3, -1))])


@pytest.fixture(scope="module")
def skeleton(body):
    x = body.corners[:, :, 0].mean(axis=1)
    part = np.where(x < -0.2, 1, np.where(x > 0.2, 2, 0))
    middle = body.vertices[np.unique(body.faces[part == 0])].mean(axis=0)
    return Skeleton(part, [-1, 0, 0], [middle, [-0.2, 0, 0], [0.2, 0, 0]], ("chest", "left", "right"))


def test_one_topology_for_all(body, poses, skeleton):
    small = decimate_set(body, poses, 500, KEEP, skeleton)
    assert template_problem(small.template) is None and small.template.is_closed
    assert len(small.template.faces) == 500
    assert set(KEEP) <= set(small.vertex_map)
    assert np.array_equal(small.owner[small.vertex_map], np.arange(len(small.vertex_map)))
    assert np.array_equal(small.template.faces, small.owner[body.faces[small.face_map]])
    assert np.array_equal(small.template.vertices, body.vertices[small.vertex_map])
    carried = small.transfer(poses)
    assert np.array_equal(carried, poses[:, small.vertex_map])
    assert carried.shape == (len(poses), len(small.vertex_map), 3)
    for before, after in zip(poses, carried, strict=True):
        assert np.array_equal(after[small.owner[KEEP]], before[KEEP])
        mesh, now = body.with_vertices(before), small.template.with_vertices(after)
        assert Surface(now).closest(mesh.vertices).distances.mean() < 0.1 * now.mean_edge
        assert now.volume == pytest.approx(mesh.volume, rel=0.03)


def borders(faces, part):
    """Border edges between parts as pairs of vertices."""
    seen = {}
    for face, p in zip(faces.tolist(), part.tolist(), strict=True):
        for i in range(3):
            seen.setdefault(tuple(sorted((face[i], face[i - 1]))), []).append(p)
    return {edge for edge, parts in seen.items() if len(set(parts)) > 1}


def test_borders_of_parts_stay_curves_on_them(body, poses, skeleton):
    small = decimate_set(body, poses, 300, KEEP, skeleton)
    assert small.skeleton.names == skeleton.names
    assert np.array_equal(small.skeleton.part_of_face, skeleton.part_of_face[small.face_map])
    assert np.array_equal(small.skeleton.joints[1:], skeleton.joints[1:])
    on_border = np.unique(list(borders(body.faces, skeleton.part_of_face)))
    edges = borders(small.template.faces, small.skeleton.part_of_face)
    assert edges
    for edge in edges:
        assert np.isin(small.vertex_map[list(edge)], on_border).all()
    counts = np.bincount(np.array(list(edges)).ravel())
    assert set(counts) <= {0, 2}                                   # closed rings
    joints = small.skeleton.joint_regressor(small.template) @ small.template.vertices
    np.testing.assert_allclose(joints, small.skeleton.joints, atol=1e-9)


def test_what_bends_in_a_pose_keeps_its_triangles(body):
    poses = np.stack([bent(body, [0, 0, 1.8], [0, 0, 0])])
    near = np.abs(body.vertices[:, 0] + 0.2) < 0.06
    alone, together = (np.count_nonzero(near[decimate_set(body, others, 400).vertex_map]) for others in (None, poses))
    assert together > alone


def test_meshes_in_other_places_change_nothing(body, poses):
    from scanprep.geometry import rotations

    R = rotations.exp(np.array([[0.3, 1.0, -2.0], [0, 0, 1.5], [1, 0, 0], [0, 2, 0]]))
    moved = np.einsum("mij,mnj->mni", R, poses) + np.arange(4)[:, None, None]
    a, b = decimate_set(body, poses, 600), decimate_set(body, moved, 600)
    assert np.array_equal(a.vertex_map, b.vertex_map) and np.array_equal(a.template.faces, b.template.faces)


def test_colours_and_landmarks_are_carried(body):
    from scanprep.geometry.mesh import Mesh

    colored = Mesh(body.vertices, body.faces, np.clip(body.vertices + 0.5, 0, 1))
    small = decimate_set(colored, None, 600, keep=[5, 400])
    assert np.array_equal(small.template.colors, colored.colors[small.vertex_map])
    new = small.landmarks({"a": 5, "b": 400})
    assert list(small.vertex_map[list(new.values())]) == [5, 400]


def test_arguments_are_checked(body, poses, skeleton):
    with pytest.raises(ValueError, match="poses: expected shape"):
        decimate_set(body, poses[:, :-1], 500)
    with pytest.raises(ValueError, match="keep: expected vertices"):
        decimate_set(body, poses, 500, keep=[10**6])
    with pytest.raises(ValueError, match="skeleton: expected"):
        decimate_set(bumpy(2), None, 100, skeleton=skeleton)
    with pytest.raises(ValueError, match="vertices: expected shape"):
        decimate_set(body, None, 500).transfer(poses[:, :-1])


@pytest.fixture
def source(tmp_path, body, poses, skeleton):
    out = RegisteredSet.create(tmp_path / "set", body, {"unit": "m"})
    for i, pose in enumerate(poses):
        out = out.add(f"pose{i}", pose, "Ada", f"p{i}", "f")
    write_landmarks(tmp_path / "set" / "landmarks.json", {f"mark{v}": int(v) for v in KEEP})
    return out.with_skeleton(skeleton)


def test_a_set_on_disk(source, tmp_path, poses):
    done = []
    small = write_decimated_set(source.folder, tmp_path / "small", 500, progress=lambda *state: done.append(state))
    again = RegisteredSet.load(tmp_path / "small")
    assert done == [(i, 4) for i in range(1, 5)]
    assert len(again.template.faces) == 500 and again.names == source.names == small.names
    assert [e.subject for e in again.entries] == ["Ada"] * 4 and [e.sex for e in again.entries] == ["f"] * 4
    assert again.info["unit"] == "m" and again.info["decimated_from"]["faces"] == len(source.template.faces)
    assert again.skeleton.names == source.skeleton.names
    marks = read_landmark_vertices(tmp_path / "small" / "landmarks.json", again.template)
    for name, v in marks.items():
        np.testing.assert_allclose(again.vertices()[:, v], poses[:, int(name[4:])], atol=1e-6)


def test_what_was_interrupted_goes_on(source, tmp_path):
    folder = tmp_path / "small"

    def stop(done, total):
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_decimated_set(source, folder, 500, progress=stop)
    first = RegisteredSet.load(folder)
    assert first.names == source.names[:2]
    times = [(folder / e.file).stat().st_mtime_ns for e in first.entries]
    more = source.add("late", source.vertices()[0], "Bea")
    whole = write_decimated_set(more, folder, 500)
    assert whole.names == more.names
    assert [(folder / e.file).stat().st_mtime_ns for e in first.entries] == times
    fresh = write_decimated_set(source, tmp_path / "fresh", 500)
    assert np.array_equal(fresh.vertices(), whole.vertices(fresh.names))


def test_other_folders_are_left_alone(source, tmp_path):
    with pytest.raises(ValueError, match="another one than that of the source"):
        write_decimated_set(source, source.folder, 500)
    write_decimated_set(source, tmp_path / "small", 500)
    with pytest.raises(ValueError, match="other settings"):
        write_decimated_set(source, tmp_path / "small", 400)
    RegisteredSet.create(tmp_path / "other", source.template)
    with pytest.raises(ValueError, match="no decimation"):
        write_decimated_set(source, tmp_path / "other", 500)
