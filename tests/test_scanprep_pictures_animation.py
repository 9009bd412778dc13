import io

import numpy as np
import pytest
from glb_reader import Glb

from scanprep.geometry.format_glb import turn_up
from scanprep.geometry.mesh import Mesh
from scanprep.pictures.gltf import encode_animated_glb, write_animated_glb
from scanprep.pictures.shading import sphere
from scanprep.pictures.sheets import gif_bytes, write_gif


@pytest.fixture(scope="module")
def motion():
    vertices, faces = sphere(1)
    t = np.linspace(0, 1, 9)[:, None, None]
    return faces, vertices * (1 + 0.2 * np.sin(6 * t)) + t * np.array([0.3, 0, 0.1])


def at(glb, time):
    """Positions and normals of the first mesh at a time, as a viewer blends them."""
    primitive = glb.json["meshes"][0]["primitives"][0]
    animation = glb.json["animations"][0]
    times = glb.array(animation["samplers"][0]["input"])[:, 0]
    weights = glb.array(animation["samplers"][0]["output"]).reshape(len(times), -1)
    now = np.array([np.interp(time, times, w) for w in weights.T])
    return [glb.array(primitive["attributes"][name]) + sum(
        w * glb.array(target[name]) for w, target in zip(now, primitive["targets"], strict=True))
        for name in ("POSITION", "NORMAL")]


def test_every_frame_is_shown_at_its_time(motion):
    faces, frames = motion
    glb = Glb(encode_animated_glb(faces, frames, rate=4.0, up=1))
    indices = glb.array(glb.json["meshes"][0]["primitives"][0]["indices"])
    assert np.array_equal(indices.reshape(-1, 3), faces)
    for t, frame in enumerate(frames):
        positions, normals = at(glb, t / 4.0)
        assert np.abs(positions - frame).max() < 1e-6
        assert np.abs(normals - Mesh(frame, faces).vertex_normals).max() < 1e-6
    between, _ = at(glb, 1.5 / 4.0)
    assert np.abs(between - (frames[1] + frames[2]) / 2).max() < 1e-6


@pytest.mark.parametrize("up", [0, 1, 2])
def test_the_body_stands_upright(motion, up):
    faces, frames = motion
    glb = Glb(encode_animated_glb(faces, frames, rate=4.0, up=up))
    U = turn_up(up)
    assert np.allclose(U @ np.eye(3)[up], [0, 1, 0]) and "rotation" not in glb.json["nodes"][0]
    assert np.abs(at(glb, 0.5)[0] - frames[2] @ U.T).max() < 1e-6


def test_one_frame_is_a_still(motion):
    faces, frames = motion
    still = Glb(encode_animated_glb(faces, frames[:1], 4.0))
    assert "animations" not in still.json and "targets" not in still.json["meshes"][0]["primitives"][0]


def test_another_reader_understands_it(motion, tmp_path):
    trimesh = pytest.importorskip("trimesh")
    faces, frames = motion
    write_animated_glb(tmp_path / "a.glb", faces, frames, 4.0, up=1)
    (mesh,) = trimesh.load(tmp_path / "a.glb", process=False).geometry.values()
    assert np.allclose(mesh.vertices, frames[0], atol=1e-6) and np.array_equal(mesh.faces, faces)
    assert [p.name for p in tmp_path.iterdir()] == ["a.glb"]


def test_bad_motion_is_refused(motion):
    faces, frames = motion
    holed = frames.copy()
    holed[3, 0] = np.nan
    for arguments, words in (((faces, frames[0], 4.0), "frames: expected shape"),
                             ((faces, holed, 4.0), "the first is frame 3"), ((faces, frames, 0.0), "rate"),
                             ((faces, frames[:0], 4.0), "at least one frame"),
                             ((faces, frames, 4.0, 3), "up: expected")):
        with pytest.raises(ValueError, match=words):
            encode_animated_glb(*arguments)


def test_gif_plays_all_pictures(tmp_path):
    from PIL import Image

    images = [np.full((20, 30, 3), 255, dtype=np.uint8) for _ in range(7)]
    for i, image in enumerate(images):
        image[5:15, 3 * i:3 * i + 8] = (200, 30, 20 * i)
    write_gif(tmp_path / "a.gif", images, rate=10.0)
    gif = Image.open(tmp_path / "a.gif")
    assert gif.n_frames == 7 and gif.info["duration"] == 100 and gif.info["loop"] == 0
    for i, image in enumerate(images):
        gif.seek(i)
        shown = np.asarray(gif.convert("RGB")).astype(int)
        assert np.abs(shown - image).mean() < 6
        assert (shown[0, 0] == 255).all()
    assert Image.open(io.BytesIO(gif_bytes(images[:1], 10.0))).size == (30, 20)
    with pytest.raises(ValueError, match="images"):
        gif_bytes([], 10.0)
