"""What lies inside a figure is left out, whatever else it has; nothing of the outer surface is."""
import numpy as np
import pytest
import trimesh

from model.statue.commands import read_scan
from model.statue.outer import keep_outer
from scanprep import Mesh, write_mesh
from scanprep.geometry.surface import Surface
from scanprep.pipeline.scans import ScanTask
from scanprep.synthetic import scanner
from scanprep.synthetic.people import LANDMARKS, SyntheticPerson


@pytest.fixture(scope="module")
def person():
    return SyntheticPerson()


def join(*meshes):
    first = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    return Mesh(np.concatenate([mesh.vertices for mesh in meshes]),
                np.concatenate([mesh.faces + n for mesh, n in zip(meshes, first, strict=False)]))


def box(centre, size):
    return trimesh.creation.box(size, trimesh.transformations.translation_matrix(centre))


def teeth(person):
    """Seven boxes in an arch behind the lips."""
    mouth = person.mesh.vertices[LANDMARKS["mouth"]]
    return [box(mouth + [x, 0.015 + 0.35 * abs(x), 0], (0.007, 0.006, 0.009)) for x in np.linspace(-0.024, 0.024, 7)]


def worn(person, parts, thickness):
    """A cloth around some parts of a body, as far off the skin as it is thick."""
    cloth, _ = person.mesh.submesh(np.isin(person.part_of_face, parts))
    return cloth.with_vertices(cloth.vertices + thickness * cloth.vertex_normals)


@pytest.mark.parametrize("turned", [False, True])
def test_teeth_and_balls_in_joints_are_left_out_whole(person, turned):
    balls = [trimesh.creation.icosphere(3, 0.02).apply_translation(joint) for joint in person.joints]
    body = Mesh(person.mesh.vertices, person.mesh.faces[:, ::-1]) if turned else person.mesh
    outer, left_out = keep_outer(join(body, *teeth(person), *balls))
    assert np.array_equal(outer.faces, body.faces) and left_out > 0.03


def test_a_body_under_clothes_keeps_what_shows(person):
    """The trunk, upper arms and thighs are covered; the rims under the hems may stay."""
    parts = (0, 1, 2, 4, 7, 10, 13)
    cloth, naked = worn(person, parts, 0.02), person.mesh.face_areas[~np.isin(person.part_of_face, parts)].sum()
    outer, _ = keep_outer(join(cloth, person.mesh))
    of_cloth = Surface(cloth).closest(outer.corners.mean(axis=1)).distances < 1e-9
    assert outer.face_areas[of_cloth].sum() > 0.97 * cloth.face_areas.sum()     # inflated thighs run into each other
    assert naked <= outer.face_areas[~of_cloth].sum() < naked + 0.2 * (person.mesh.face_areas.sum() - naked)


def test_a_body_of_one_shell_an_open_one_and_views_that_overlap_stay(person):
    """Both its armpits and the inner side that a hole shows belong to it; layers of views are of one skin."""
    open_shell, _ = person.mesh.submesh(person.mesh.corners.mean(axis=1)[:, 2] > 0.5)
    views = join(*(view.mesh for view in scanner.scan(person.mesh, rng=np.random.default_rng(0)).views))
    for mesh in (person.mesh, open_shell):
        assert keep_outer(mesh)[0] is mesh
    shoulder = worn(person, (2,), 0.001)
    assert keep_outer(join(person.mesh, shoulder))[1] == 0
    assert keep_outer(views)[1] < 0.01


def test_triangles_may_be_long_and_unwelded(person):
    """A block of twelve triangles around a figure: its walls count where they are seen, not at their corners."""
    block = box((0, 0, 1), (2, 2, 2.4))
    soup = Mesh(block.triangles.reshape(-1, 3), np.arange(36).reshape(-1, 3))
    outer, left_out = keep_outer(join(soup, person.mesh))
    assert len(outer.faces) == 12 and left_out == pytest.approx(person.mesh.face_areas.sum() / (
        person.mesh.face_areas.sum() + block.area))


@pytest.mark.parametrize(("cut", "width", "height"), [(None, 0.6, 0.15), (None, 0.45, 0.3), (0.08, 0.5, 0.08)])
def test_a_plinth_of_twelve_triangles_stays_behind_and_the_soles_stay(person, tmp_path, cut, width, height):
    """It became two feet: eight vertices are no floor."""
    body = person.mesh.with_vertices(person.mesh.vertices - [0, 0, person.mesh.vertices[:, 2].min()])
    write_mesh(tmp_path / "scan.ply", join(body, box((0, 0, -height / 2), (width, width, height))))
    found, _, rows, *_ = read_scan(ScanTask("scan", tmp_path / "scan.ply"), None, cut=cut)
    assert -0.001 < found.vertices[:, 2].min() < 0.005        # metres
    assert found.face_areas.sum() == pytest.approx(body.face_areas.sum(), rel=0.03)
    assert any(row.name == "plinth, left out" for row in rows)


@pytest.mark.slow
def test_flat_faces_of_a_figure_of_boxes_stay(tmp_path):
    """Sides of a box-shaped head were taken for walls."""
    parts = [box((0, 0, 1.35), (0.7, 0.7, 0.7)), box((0, 0, 0.75), (0.5, 0.3, 0.52)),
             *(box((x, 0, 0.25), (0.22, 0.3, 0.5)) for x in (-0.13, 0.13)),
             *(box((x, 0, 0.8), (0.16, 0.2, 0.45)) for x in (-0.33, 0.33))]
    figure = join(*parts)
    write_mesh(tmp_path / "scan.ply", figure)
    body, *_ = read_scan(ScanTask("scan", tmp_path / "scan.ply"), None)
    assert (np.ptp(body.vertices, axis=0) == pytest.approx(np.ptp(figure.vertices, axis=0)))
    assert body.face_areas.sum() > 0.9 * figure.face_areas.sum()


def test_box_shaped_shoes_are_no_plinth(person, tmp_path):
    """Their soles were taken for a floor: no vertex of the shoes lay near them."""
    shoes = [box((x, -0.05, 0.06), (0.16, 0.42, 0.12)) for x in (-0.19, 0.19)]
    write_mesh(tmp_path / "scan.ply", join(person.mesh, *shoes))
    body, _, rows, *_ = read_scan(ScanTask("scan", tmp_path / "scan.ply"), None)
    assert body.vertices[:, 2].min() == pytest.approx(0) and not any("plinth" in row.name for row in rows)


def test_a_cut_above_the_figure_is_refused(person, tmp_path):
    write_mesh(tmp_path / "scan.ply", person.mesh)
    with pytest.raises(ValueError, match="cut: expected a height below that of the scan"):
        read_scan(ScanTask("scan", tmp_path / "scan.ply"), None, cut=2.5)
