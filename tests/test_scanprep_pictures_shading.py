import numpy as np
import pytest

from scanprep.geometry import rotations
from scanprep.geometry.format_common import as_light
from scanprep.geometry.mesh import Mesh
from scanprep.pictures.colors import part_palette
from scanprep.pictures.shading import (
    Bones,
    Camera,
    Dots,
    Solid,
    contact_sheet,
    heat,
    part_colors,
    png_bytes,
    render,
    save_png,
    sphere,
)

RED, GREEN = (0.9, 0.1, 0.1), (0.1, 0.8, 0.1)


def ball(radius=0.5, centre=(0, 0, 0)):
    vertices, faces = sphere(4)
    return Mesh(radius * vertices + np.asarray(centre), faces)


def box(x=0.0, half=0.5):
    """A square across the x axis, its outer side towards +x."""
    corners = [[x, -half, -half], [x, half, -half], [x, half, half], [x, -half, half]]
    return Mesh(np.array(corners), [[0, 1, 2], [0, 2, 3]])


def ink(image):
    return (image != 255).any(axis=2)


@pytest.mark.parametrize("up", [0, 1, 2])
def test_projection_and_rays_agree(up):
    rng = np.random.default_rng(0)
    points = rng.normal(size=(50, 3)) + [3, -1, 2]
    camera = Camera.around(points, 33, 21, up=up)
    origins, directions = camera.rays(80, 60)
    pixel = camera.project(points, 80, 60)
    assert (pixel > 0).all() and (pixel < [80, 60]).all()
    column, row = np.floor(pixel).astype(int).T
    start, along = (origins + camera.target)[row * 80 + column], directions[row * 80 + column]
    off = np.linalg.norm(np.cross(points - start, along), axis=1)
    size = max(camera.width / 80, camera.height / 60)
    assert off.max() < size                       # within the pixel, up to its corner
    assert np.allclose(np.linalg.norm(along, axis=1), 1, atol=1e-6)


@pytest.mark.parametrize(("up", "front"), [(0, 1), (1, 2), (2, 0)])
def test_azimuth_0_looks_along_the_axis_after_up(up, front):
    camera = Camera.around(ball(), 0, 0, up=up)
    assert np.allclose(camera.axes[2], np.eye(3)[front])
    assert np.allclose(camera.axes[1], np.eye(3)[up])
    assert np.linalg.det(camera.axes) == pytest.approx(1)
    assert np.allclose(Camera.around(ball(), 0, 90, up=up).axes[2], np.eye(3)[up])


def test_a_ball_covers_its_share_of_the_picture():
    image = render(ball(), Camera.around(ball(), margin=1.25), width=200, height=200)
    assert ink(image).mean() == pytest.approx(np.pi / 4 / 1.25**2, rel=0.01)
    again = render(ball(), Camera.around(ball(), margin=2.5), width=200, height=200)
    assert ink(again).mean() == pytest.approx(ink(image).mean() / 4, rel=0.03)


def test_what_is_nearer_hides_what_is_behind():
    shapes = [Solid(box(0.0), RED), Solid(box(0.3, half=0.2), GREEN)]
    camera = Camera.around(box(), 0, 0)
    for order in (shapes, shapes[::-1]):
        image = render(order, camera, 61, 61).astype(int)
        assert image[30, 30, 1] > 2 * image[30, 30, 0]
        assert image[5, 30, 0] > 2 * image[5, 30, 1]
    behind = render(shapes, Camera.around(box(), 180, 0), 61, 61).astype(int)
    assert behind[30, 30, 0] > 1.5 * behind[30, 30, 1]


def test_the_inner_side_is_darker():
    front, back = (render(box(), Camera.around(box(), a, 0), 41, 41)[20, 20].mean() for a in (0, 180))
    assert back < 0.7 * front


def test_dots_on_top_are_seen_through_a_mesh():
    camera = Camera.around(ball(), 0, 0)
    hidden, seen = (render([ball(), Dots(np.zeros((1, 3)), RED, 0.1, on_top=t)], camera, 61, 61)[30, 30].astype(int)
                    for t in (False, True))
    assert abs(hidden[0] - hidden[1]) < 15
    assert seen[0] > seen[1] + 60


def test_translucent_meshes_let_through_what_is_behind():
    camera = Camera.around(ball(), 0, 0)
    inside = Dots(np.zeros((1, 3)), RED, 0.2)
    clear, ghost, solid = (render([Solid(ball(), opacity=o), inside], camera, 61, 61)[30, 30].astype(int)
                           for o in (0.0, 0.5, 1.0))
    red = [c[0] - c[1] for c in (clear, ghost, solid)]
    assert red[0] > red[1] + 30 > red[2] + 60


def test_missing_points_are_left_out():
    points = np.array([[0, 0, 0], [np.nan, 0, 0]])
    camera = Camera.around(ball(), 0, 0)
    assert np.array_equal(render(Dots(points), camera, 40, 40), render(Dots(points[:1]), camera, 40, 40))
    nothing = render(Bones(points[1:], points[:1]), camera, 40, 40)
    assert (nothing == 255).all()


def test_colours_per_face_vertex_and_mesh_agree():
    mesh = ball()
    camera = Camera.around(mesh)
    one = render(Solid(mesh, RED), camera, 60, 60)
    for color in (np.tile(RED, (len(mesh.faces), 1)), np.tile(RED, (len(mesh.vertices), 1))):
        assert np.array_equal(render(Solid(mesh, color), camera, 60, 60), one)
    carried = Mesh(mesh.vertices, mesh.faces, np.tile(RED, (len(mesh.vertices), 1)))
    assert np.array_equal(render(carried, camera, 60, 60), one)
    with pytest.raises(ValueError, match=r"color: expected \(3,\)"):
        render(Solid(mesh, np.zeros((5, 3))), camera, 20, 20)


def test_the_picture_does_not_depend_on_where_the_scene_is():
    mesh = ball()
    far = np.array([4e5, -5e6, 120.0])
    here = render(mesh, Camera.around(mesh, 40, 10), 60, 60).astype(int)
    there = render(mesh.with_vertices(mesh.vertices + far), Camera.around(mesh.vertices + far, 40, 10), 60, 60)
    assert np.abs(here - there).max() <= 2
    turn = rotations.exp(np.array([0, 0, np.pi / 2]))
    turned = render(mesh.with_vertices(mesh.vertices @ turn.T), Camera.around(mesh.vertices @ turn.T, 130, 10), 60, 60)
    assert np.abs(here - turned).mean() < 0.5


def test_heat_darkens_evenly():
    colors = heat(np.linspace(0, 0.02, 50), 0, 0.02)
    light = as_light(colors) @ [0.2126, 0.7152, 0.0722]
    assert (np.diff(np.cbrt(light)) < 0).all()
    assert np.array_equal(heat(np.array([-1.0, 5.0]), 0, 1), heat(np.array([0.0, 1.0]), 0, 1))
    grey = heat(np.array([np.nan, 0.5]), 0, 1)[0]
    assert np.ptp(grey) < 0.06


def test_sixteen_parts_can_be_told_apart():
    palette = part_palette(16)
    apart = np.linalg.norm(palette[:, None] - palette[None], axis=2)[np.triu_indices(16, 1)]
    assert apart.min() > 0.1
    assert (palette >= 0).all() and (palette <= 1).all()
    label = np.array([3, 0, -1, 3])
    colors = part_colors(label)
    assert np.array_equal(colors[0], colors[3]) and np.array_equal(colors[0], palette[3])
    assert np.ptp(colors[2]) < 0.06


def test_sheets_hold_all_pictures(tmp_path):
    from PIL import Image

    images = [np.full((40, 30, 3), 10 * i, dtype=np.uint8) for i in range(5)]
    sheet = contact_sheet(images, columns=3)
    assert sheet.shape == (2 * 40 + 8, 3 * 30 + 2 * 8, 3)
    for i in range(5):
        assert (sheet[(i // 3) * 48 + 20, (i % 3) * 38 + 15] == 10 * i).all()
    labelled = contact_sheet(images[:2], ["one", "two"])
    assert labelled.shape[0] > 40 and (labelled[42:] < 128).any()
    with pytest.raises(ValueError, match="labels: expected 5"):
        contact_sheet(images, ["one"])
    with pytest.raises(ValueError, match="images"):
        contact_sheet([])
    save_png(tmp_path / "a" / "sheet.png", sheet)
    assert np.array_equal(np.asarray(Image.open(tmp_path / "a" / "sheet.png")), sheet)
    assert [p.name for p in (tmp_path / "a").iterdir()] == ["sheet.png"]
    assert png_bytes(sheet).startswith(b"\x89PNG")
