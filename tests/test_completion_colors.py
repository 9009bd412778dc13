"""Colours and textures carried over from scans."""
import warnings

import numpy as np
import pytest
from glb_reader import Glb

from completion.partial.colors import blend, carry_colors, views_with_colors
from scanprep.geometry.files import PointCloud
from scanprep.geometry.format_glb import Glb as GlbFile
from scanprep.geometry.format_glb import one_mesh, tallest, turn_up
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Surface
from scanprep.pictures.textures import Texture, bake_body_texture, read_texture, write_textured
from scanprep.synthetic.people import SyntheticPerson
from scanprep.synthetic.scanner import ScannerConfig, scan


def paint(points):
    """Colours that go over smoothly from place to place."""
    x, y, z = points.T
    return np.column_stack([0.5 + 0.4 * np.sin(9 * z), 0.5 + 0.4 * np.cos(7 * x), 0.5 + y])


@pytest.fixture(scope="module")
def person():
    return SyntheticPerson().mesh


@pytest.fixture(scope="module")
def views(person):
    """Two painted range views, the cameras, and which vertices they saw."""
    found = scan(person, ScannerConfig(views=2, resolution=0.012, noise=0.0, azimuth=0.0)).views
    meshes = [Mesh(v.mesh.vertices, v.mesh.faces, np.clip(paint(v.mesh.vertices), 0, 1)) for v in found]
    seen = np.min([Surface(m).closest(person.vertices).distances for m in meshes], axis=0) < 0.004
    return meshes, np.array([v.camera for v in found]), seen


def test_colours_arrive_where_the_body_was_seen(person, views):
    meshes, cameras, seen = views
    colors = carry_colors(person, seen, meshes, viewpoint=cameras)
    off = np.abs(colors - np.clip(paint(person.vertices), 0, 1))[seen].max(axis=1)
    grey = (colors == 0.6).all(axis=1)
    # of the skin: most vertices are of fingers, lips and ears, which hide each other
    hidden = np.average(grey[seen], weights=person.vertex_areas[seen])
    assert np.quantile(off[~grey[seen]], 0.99) < 0.05 and hidden < 0.02
    assert 0.02 < grey.mean() < 0.5 and grey[~seen].mean() > 0.5     # single gaps amid what was seen are closed


def test_a_cloud_gives_the_colours_that_its_mesh_gives(person, views):
    mesh, seen = views[0][0], views[2]
    cloud = PointCloud(mesh.vertices, mesh.vertex_normals, mesh.colors)
    one, other = (carry_colors(person, seen, view, viewpoint=views[1][0]) for view in (mesh, cloud))
    both = (one != 0.6).any(axis=1) & (other != 0.6).any(axis=1)
    assert both.mean() > 0.2 and np.quantile(np.abs(one - other)[both], 0.98) < 0.06


def test_colours_move_with_the_scan_and_its_unit(person, views):
    """By a power of two, which rounds nothing: a ray that grazes an edge is as near to it as before."""
    meshes, cameras, seen = views
    large = [Mesh(1024 * m.vertices, m.faces, m.colors) for m in meshes]
    np.testing.assert_allclose(carry_colors(person, seen, large, viewpoint=1024 * cameras, metres=1 / 1024),
                               carry_colors(person, seen, meshes, viewpoint=cameras), atol=1e-9)


def test_the_view_that_looked_squarely_counts_most():
    x, y = (g.ravel() for g in np.meshgrid(np.linspace(-0.3, 0.3, 31), np.linspace(-0.3, 0.3, 31)))
    points, up = np.column_stack([x, y, 0 * x]), np.tile([0, 0, 1.0], (len(x), 1))
    square, slanted = (PointCloud(points, up, np.tile(c, (len(x), 1))) for c in ([1.0, 0, 0], [0, 0, 1.0]))
    cameras = np.array([[0, 0, 2.0], [2 * np.sin(1.2), 0, 2 * np.cos(1.2)]])
    found = views_with_colors([square, slanted], cameras)
    colors, weight = blend(found, np.zeros((1, 3)), up[:1])
    share = np.cos(1.2)**2 / (1 + np.cos(1.2)**2)
    np.testing.assert_allclose(colors[0], [1 - share, 0, share], atol=1e-9)
    assert weight[0] == pytest.approx(1 + np.cos(1.2)**2)
    away = blend(found, np.array([[0, 0, 0.05], [0, 0, 0]]), np.array([[0, 0, 1.0], [0, 0, -1]]))
    np.testing.assert_array_equal(away[1], 0)                        # too far, and the other side


def test_what_was_not_seen_is_grey_or_filled(person, views):
    meshes, cameras, seen = views
    grey = carry_colors(person, seen, meshes[:1], viewpoint=cameras[0])
    filled = carry_colors(person, seen, meshes[:1], fill=True, viewpoint=cameras[0])
    unseen = (grey == 0.6).all(axis=1)
    assert unseen.mean() > 0.3 and (np.ptp(filled[unseen], axis=0) > 0.1).all()
    np.testing.assert_array_equal(filled[~unseen], grey[~unseen])


def test_a_scan_without_colours_is_refused(person, views):
    with pytest.raises(ValueError, match="expected colours at its points, found none"):
        carry_colors(person, views[2], [Mesh(views[0][0].vertices, views[0][0].faces), np.zeros((40, 3))])


# ---- textures

SQUARE = Mesh([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]])
UV = np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]])
IMAGE = np.random.default_rng(0).random((8, 6, 3))


def test_pixels_lie_where_they_should():
    texture = Texture(SQUARE, UV, IMAGE)
    column, row = np.meshgrid(np.arange(6), np.arange(8))
    at = np.column_stack([(column.ravel() + 0.5) / 6, 1 - (row.ravel() + 0.5) / 8, np.zeros(48)])
    found = Surface(SQUARE).closest(at)
    np.testing.assert_allclose(texture.sample(found.faces, found.bary), IMAGE.reshape(-1, 3), atol=1e-9)
    between = texture.sample(*_at([[2 / 6, 1 - 3 / 8, 0]]))          # where four pixels meet
    np.testing.assert_allclose(between[0], IMAGE[2:4, 1:3].mean(axis=(0, 1)), atol=1e-9)


def _at(points):
    found = Surface(SQUARE).closest(np.array(points, dtype=float))
    return found.faces, found.bary


def test_a_textured_file_comes_back(tmp_path):
    write_textured(tmp_path / "square.glb", Texture(SQUARE, UV, IMAGE))
    again = read_texture(tmp_path / "square.glb")
    np.testing.assert_array_equal(again.mesh.vertices, np.float32(SQUARE.vertices))      # turned to y, and back
    glb = Glb((tmp_path / "square.glb").read_bytes())
    normals = glb.array(glb.primitive["attributes"]["NORMAL"])
    np.testing.assert_allclose(normals, SQUARE.vertex_normals @ turn_up(tallest(SQUARE.vertices)).T, atol=1e-6)
    found = Surface(again.mesh).closest(np.array([[0.3, 0.6, 0], [0.9, 0.1, 0]]))
    faces, bary = _at([[0.3, 0.6, 0], [0.9, 0.1, 0]])
    np.testing.assert_allclose(again.sample(found.faces, found.bary), Texture(SQUARE, UV, IMAGE).sample(faces, bary),
                               atol=1 / 255)


def write_obj(folder, picture="skin.png"):
    from PIL import Image

    Image.fromarray((255 * IMAGE).astype(np.uint8)).save(folder / "skin.png")
    (folder / "a.mtl").write_text(f"newmtl skin\nKd 1 1 1\nmap_Kd {picture}\n")
    corners = "\n".join(f"v {100 * x} {100 * y} 0\nvt {x} {y}" for x, y in UV)
    (folder / "a.obj").write_text(f"mtllib a.mtl\n{corners}\nusemtl skin\nf 1/1 2/2 3/3\nf 1/1 3/3 4/4\n")
    return folder / "a.obj"


def test_an_obj_with_its_material_and_picture_is_read(tmp_path):
    texture = read_texture(write_obj(tmp_path), "cm")
    assert np.ptp(texture.mesh.vertices[:, 0]) == pytest.approx(1)
    found = Surface(texture.mesh).closest(np.array([[0.25, 0.7, 0]]))
    wanted = Texture(SQUARE, UV, IMAGE).sample(*_at([[0.25, 0.7, 0]]))
    np.testing.assert_allclose(texture.sample(found.faces, found.bary), wanted, atol=1 / 255)


def test_a_file_without_a_texture_has_none(tmp_path):
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    assert read_texture(tmp_path / "a.obj") is None
    with pytest.warns(UserWarning, match="its colours are left out"), warnings.catch_warnings():
        warnings.filterwarnings("ignore", module="trimesh")
        assert read_texture(write_obj(tmp_path, "missing.png")) is None


@pytest.mark.parametrize("corner", ["nan", "inf", "1e40"])
def test_a_mesh_that_cannot_carry_its_texture_is_refused_by_name(tmp_path, corner):
    path = write_obj(tmp_path)
    path.write_text(path.read_text().replace("v 0.0 0.0 0", f"v {corner} 0 0"))
    with pytest.raises(ValueError, match=r"a\.obj"):
        read_texture(path)


def test_a_picture_in_a_glb_that_is_damaged_or_huge_is_refused_by_name(tmp_path):
    from PIL import Image

    path = tmp_path / "square.glb"
    write_textured(path, Texture(SQUARE, UV, np.random.default_rng(0).random((64, 64, 3))))
    whole = path.read_bytes()
    place = whole.index(b"IDAT")
    path.write_bytes(whole[:place + 2000] + bytes(100) + whole[place + 2100:])
    with pytest.raises(ValueError, match=r"square\.glb"):
        read_texture(path)
    Image.new("1", (8200, 8200)).save(tmp_path / "huge.png")
    glb = GlbFile()
    surface = glb.add_surface(SQUARE, SQUARE.vertex_normals, UV)
    image = glb.add_png((tmp_path / "huge.png").read_bytes(), "texture")
    document = one_mesh({"primitives": [surface]}, {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}, {})
    path.write_bytes(glb.pack({**document, "images": [image], "textures": [{"source": 0}]}, 2))
    with pytest.raises(ValueError, match=r"square\.glb.*8200 x 8200 pixels"):
        read_texture(path)


def test_a_baked_texture_shows_the_colours_of_the_scan(person, views):
    pytest.importorskip("xatlas")
    rest = np.flatnonzero(person.vertices[:, 2] > 1.5)
    head = person.submesh(np.isin(person.faces, rest).all(axis=1))[0]
    plain = np.full((len(head.vertices), 3), 0.25)

    def look(places, normals):
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1)
        return np.clip(paint(places), 0, 1), (places[:, 0] > 0).astype(float)

    texture = bake_body_texture(head, look, plain, 256)
    corners = np.tile(0.8 * np.eye(3) + 0.2 / 3, (len(head.faces), 1))
    faces = np.repeat(np.arange(len(head.faces)), 3)
    at = np.einsum("nc,ncd->nd", corners, head.corners[faces])
    np.testing.assert_allclose(np.einsum("nc,ncd->nd", corners, texture.mesh.corners[faces]), at, atol=1e-6)
    colors, left = texture.sample(faces, corners), at[:, 0] > 0.01
    assert np.quantile(np.abs(colors - np.clip(paint(at), 0, 1))[left], 0.98) < 0.06
    assert np.quantile(np.abs(colors - 0.25)[at[:, 0] < -0.01], 0.98) < 0.01
