"""Shapes as a browser gets them: read again they are what they were, in few bytes, and always the same ones."""
import numpy as np
import pytest
from scanned_shapes import ball
from scene_reader import SceneReader, scenes_of

from scanprep.geometry import rotations
from scanprep.geometry.mesh import Mesh
from scanprep.pictures import scene as scenes
from scanprep.pictures.camera import Camera, look_around, stance
from scanprep.pictures.low_rank import TOLERANCE, low_rank
from scanprep.pictures.page import Page
from scanprep.pictures.scene import Pane, match_camera_scales, pack_scene, picture_panes, small_scene
from scanprep.pictures.shading import Bones, Dots, Heat, Moving, Solid, sphere
from scanprep.pictures.thinning import MOST, thin_solid


@pytest.fixture
def body():
    vertices, faces = sphere(3)
    return Mesh(vertices * [0.3, 0.2, 0.9] + [5.0, -3.0, 1.0], faces)


def pane(*shapes, camera=None):
    return Pane(shapes, camera or Camera.around(np.array([[4.0, -4, 0], [6, -2, 2]])))


def turning(body, count=90):
    """A body of two halves that turn against each other, and walk: 12 columns at most."""
    t = np.linspace(0, 3, count)
    upper = (body.vertices[:, 2] > 1.0)[None, :, None]
    R = rotations.exp(np.stack([0 * t, 0.8 * np.sin(3 * t), 0.3 * t], axis=1))
    centred = body.vertices - body.vertices.mean(axis=0)
    moved = np.where(upper, np.einsum("tij,nj->tni", R, centred), centred[None])
    return moved + np.stack([t, 0 * t, 0 * t], axis=1)[:, None] + body.vertices.mean(axis=0)


def test_meshes_come_back_within_a_step(body):
    read = SceneReader(pack_scene([pane(Solid(body, name="body"))]))
    layer = read.layer("body")
    step = np.ptp(body.vertices, axis=0).max() / 65535
    assert layer["positions"]["step"] == pytest.approx(step)
    np.testing.assert_allclose(read.positions(layer), body.vertices, atol=0.51 * step)
    np.testing.assert_array_equal(read.faces(layer), body.faces)


def test_heat_goes_over_in_254_steps_and_without_a_value_is_grey(body):
    values = np.linspace(-0.001, 0.012, len(body.vertices))
    values[7] = np.nan
    shade = Heat(values, 0.0, 0.01, "distance")
    sure = Heat(values, 0, 1, "sure", "%")
    read = SceneReader(pack_scene([pane(Solid(body, shade, shades={"sure": sure}))]))
    first, sure = read.layers[0]["shades"]
    index = read.columns[first["index"]].ravel()
    known = np.isfinite(values)
    np.testing.assert_allclose(index[known] / 254 * 0.01, values[known].clip(0, 0.01), atol=0.51 * 0.01 / 254)
    assert index[7] == 255
    assert first["legend"] == {"title": "distance", "low": 0.0, "high": 0.01, "unit": "mm", "more": True}
    np.testing.assert_allclose(read.colors(first, 0) / 255, shade.colors(), atol=0.02)
    assert sure["name"] == "sure" and sure["legend"]["unit"] == "%"


def test_colours_of_vertices_and_triangles(body):
    rng = np.random.default_rng(0)
    many, few = rng.random(body.vertices.shape), np.where(body.vertices[:, :1] > 5, (1.0, 0, 0), (0, 0, 1.0))
    parts = np.where(body.corners.mean(axis=1)[:, :1] > 5, (1.0, 0, 0), (0, 0, 1.0))
    read = SceneReader(pack_scene([pane(Solid(body, many), Solid(body, few), Solid(body, parts), Solid(body))]))
    told = [read.colors(layer["shades"][0], len(body.vertices)) for layer in read.layers]
    np.testing.assert_allclose(told[0] / 255, many, atol=0.5 / 255 + 1e-9)
    np.testing.assert_array_equal(told[1], 255 * few)
    assert (told[2] == told[1]).all(axis=1).mean() > 0.9 and len(np.unique(told[3], axis=0)) == 1


def test_dots_and_bones_with_names_and_without_places(body):
    points = body.vertices[:4].copy()
    points[2] = np.nan
    dots = Dots(points, name="marks", labels=["a", "b", "c", "d"], on_top=True, visible=False)
    bones = Bones(points[[0, 1]], points[[1, 3]], np.array([[1.0, 0, 0], [0, 1.0, 0]]), name="bones")
    read = SceneReader(pack_scene([pane(dots, bones)]))
    marks, rods = read.layer("marks"), read.layer("bones")
    assert marks["labels"] == list("abcd") and marks["hidden"] == [2] and not marks["visible"] and marks["on_top"]
    np.testing.assert_allclose(read.positions(marks), points, atol=1e-4)
    np.testing.assert_allclose(read.positions(rods), points[[0, 1, 1, 3]], atol=1e-4)
    np.testing.assert_array_equal(read.colors(rods["shades"][0], 4), 255 * np.eye(3)[[0, 0, 1, 1]])


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_a_motion_comes_back_within_its_tolerance(body, dtype):
    frames = turning(body).astype(dtype)
    read = SceneReader(pack_scene([pane(Moving(Solid(body, name="body"), frames, 25.0))]))
    layer = read.layer("body")
    assert layer["motion"]["frames"] == 90 and layer["motion"]["rate"] == 25 and layer["motion"]["rank"] <= 12
    np.testing.assert_allclose(read.frames(layer), frames, atol=1.3 * TOLERANCE)


def test_bodies_whose_vertices_will_be_moved_stay_whole():
    many = Mesh(*sphere(6))
    assert len(many.faces) > MOST
    moving = Moving(Solid(many), np.stack([many.vertices, many.vertices + 1.0]), 25.0)
    for packed, all_there in ((pack_scene([pane(Solid(many))], whole=True), True), (pack_scene([pane(moving)]), True),
                              (pack_scene([pane(Solid(many))]), False)):
        read = SceneReader(packed)
        assert (len(read.faces(read.layers[0])) == len(many.faces)) is all_there


def test_a_frame_unlike_the_others_is_found():
    rng = np.random.default_rng(1)
    frames = np.repeat(rng.random((1, 50, 3)), 400, axis=0)
    frames[203] = rng.random((50, 3))
    basis, coefficients = low_rank(frames)
    np.testing.assert_allclose(np.einsum("nr,trc->tnc", basis, coefficients), frames, atol=TOLERANCE)


def test_large_meshes_are_thinned_and_keep_their_colours():
    mesh = Mesh(*sphere(5))
    parts = np.where(mesh.corners.mean(axis=1)[:, :1] > 0, (1.0, 0, 0), (0, 0, 1.0))
    solid = Solid(mesh, parts, shades={"height": Heat(mesh.vertices[:, 2], -1, 1), "plain": np.array([0.5, 0.5, 0.5])})
    small = thin_solid(solid, 3000)
    assert 2500 < len(small.mesh.faces) <= 3000 and thin_solid(small, 3000) is small
    assert np.abs(np.linalg.norm(small.mesh.vertices, axis=1) - 1).max() < 0.02
    np.testing.assert_allclose(small.shades["height"].values, small.mesh.vertices[:, 2], atol=0.05)
    far = np.abs(small.mesh.vertices[:, 0]) > 0.1
    np.testing.assert_array_equal(small.color[far, 0] == 1, small.mesh.vertices[far, 0] > 0)
    assert small.shades["plain"].shape == (3,)
    read = SceneReader(small_scene([pane(solid)]))
    assert len(read.faces(read.layers[0])) <= scenes.SMALL < len(mesh.faces)


def test_panes_beside_each_other_are_of_one_scale(body):
    small = body.with_vertices(body.vertices.mean(axis=0) + 0.5 * (body.vertices - body.vertices.mean(axis=0)))
    cameras = [p.camera for p in match_camera_scales([Pane([m], Camera.around(m)) for m in (body, small)])]
    assert cameras[0].height == cameras[1].height and cameras[0].distance == cameras[1].distance
    picture = picture_panes([Pane([m], c) for m, c in zip((body, small), cameras, strict=True)], 100)
    inked = [(half.min(axis=2) < 240).sum() for half in np.array_split(picture, 2, axis=1)]
    assert inked[1] == pytest.approx(inked[0] / 4, rel=0.1)


def test_a_page_carries_the_viewer_once_and_its_scenes(body):
    page = Page("x").bodies([pane(Solid(body, name="one"))]).bodies([pane(Solid(body, name="two"))], "two").html()
    assert [scene.layers[0]["name"] for scene in scenes_of(page)] == ["one", "two"]
    assert page.count('id="viewer"') == 1 and page.count("data:image/webp") == 2
    assert "viewer" not in Page("x").text("no bodies").html()


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(("points", "faces"), [
    (np.ones((1, 3)), []), (np.ones((3, 3)), [[0, 1, 2]]), (np.eye(3)[:1] * np.arange(3.0)[:, None], [[0, 1, 2]])])
def test_a_point_and_a_line_have_a_stance_too(points, faces):
    """One marker, or a scan of which nothing is left but a sliver, can be looked at."""
    up, ahead = stance(Mesh(points, np.array(faces, dtype=int).reshape(-1, 3)))
    assert abs(np.linalg.norm(up) - 1) < 1e-12 and abs(np.linalg.norm(ahead) - 1) < 1e-12 and abs(up @ ahead) < 1e-12


@pytest.mark.parametrize("turn", [np.zeros(3), [0, 0, 2.0], [0.5, 0, 0.4], [-np.pi / 2, 0, 0], [np.pi / 2, 0, 0],
                                  [0, np.pi / 2, 0], [np.pi, 0, 0]])
def test_a_body_stands_upright_whatever_axis_is_up(turn):
    template = ball(2)
    template = template.with_vertices(template.vertices * [0.3, 0.2, 1.0])
    R = rotations.exp(np.asarray(turn, dtype=float))
    still, = look_around(template, turns=(35,))
    camera, = look_around(template, template.vertices @ R.T, (35,), R)
    assert (camera.axes[1] @ (R @ still.vertical)) > 0.75            # the head is above, up to a lean
    assert (camera.vertical == 0).sum() == 2 and np.abs(camera.vertical).sum() == 1
    if np.allclose(np.abs(R).max(axis=0), 1):                        # a quarter turn: the very same picture
        np.testing.assert_allclose(camera.axes, still.axes @ R.T, atol=1e-9)


def test_of_a_motion_the_mean_counts():
    template = ball(2)
    template = template.with_vertices(template.vertices * [0.3, 0.2, 1.0])
    lean = rotations.exp(np.array([[1.3, 0, 0], [0.1, 0, 0], [0.0, 0, 0.1]]))
    assert look_around(template, turns=(0,), turned=lean)[0].vertical[2] == 1
    over = rotations.exp(np.array([np.pi, 0, 0]))                    # upside down in one frame of a motion
    assert look_around(template, turns=(0,), turned=over, vertical=np.array([0, 0, 1.0]))[0].vertical[2] == 1
    flat = rotations.exp(np.array([-np.pi / 2, 0, 0]))               # on its back: seen from the feet or the head
    assert np.isfinite(look_around(template, turns=(0,), turned=flat, vertical=np.array([0, 0, 1.0]))[0].axes).all()
    spin = rotations.exp(np.stack([[0, 0, a] for a in np.linspace(0, 2 * np.pi, 9)[:-1]]))
    np.testing.assert_allclose(look_around(template, turns=(0,), turned=spin)[0].axes,
                               look_around(template, turns=(0,))[0].axes, atol=1e-9)
