"""`scape sample`: files as a laboratory has them, of unlike people, without a landmark, always the same."""
import time

import numpy as np
import pytest

from completion import read_markers
from completion.demo.sample import HALF_VIEW, PEOPLE, SCANS, write_sample
from scanprep.command_line import run
from scanprep.geometry.files import name_of, read_mesh, read_points
from scanprep.pipeline.scans import find_scans
from scanprep.synthetic.people import SyntheticPerson


def files(folder):
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*")
            if path.is_file() and path.name != "report.json"}


def points_of(path, one):
    """Metres, z up, from the units and axes of the file."""
    points = read_points(path, "mm" if one.per_metre == 1000 else "m").points
    return points @ [[1, 0, 0], [0, 0, -1], [0, 1, 0]] if one.y_up else points


def test_the_files_are_those_that_the_documents_name_and_none_is_a_landmark(sample_folder):
    assert set(files(sample_folder)) == {"half_view.ply", "walk.c3d", "unnamed.c3d", "scans/scans.csv", "figure.glb",
                                         "walk.bvh",
                                         *(f"scans/{one.file}" for one in SCANS)}


def test_the_table_says_who_is_on_every_scan(sample_folder):
    tasks = find_scans(sample_folder / "scans")
    assert {task.name: (task.subject, task.pose, task.sex) for task in tasks} == {
        name_of(one.file): (one.person, one.pose, PEOPLE[one.person].sex) for one in SCANS}
    assert not any(task.landmarks for task in tasks)


@pytest.mark.parametrize("one", SCANS, ids=lambda one: one.file)
def test_a_scan_is_as_tall_as_its_person(sample_folder, one):
    """In the units and axes that the file is said to have; a bent person is smaller, one with raised arms taller."""
    height = float(np.ptp(points_of(sample_folder / "scans" / one.file, one)[:, 2]))
    stature = SyntheticPerson(PEOPLE[one.person]).anatomy.stature
    assert abs(height - stature) < (0.015 if one.pose == "standing" else 0.25)


def test_people_are_unlike():
    """A fat and a slim one, a small and a tall one, by kilograms at 985 a cubic metre over squared metres."""
    people = {name: SyntheticPerson(shape) for name, shape in PEOPLE.items()}
    statures = {name: person.anatomy.stature for name, person in people.items()}
    body_mass = {name: 985 * people[name].mesh.volume / statures[name]**2 for name in people}
    assert max(body_mass.values()) > 35 and min(body_mass.values()) < 18.5
    assert min(statures.values()) < 1.55 and max(statures.values()) > 1.95
    assert {shape.sex for shape in PEOPLE.values()} == {"female", "male"}


@pytest.mark.parametrize("one", [SCANS[0], HALF_VIEW], ids=lambda one: one.file)
def test_scans_have_holes_and_the_noise_of_their_scanner(sample_folder, one):
    """The truth is not written: noise shows between neighbours, where a smooth body has hardly any."""
    path = sample_folder / one.file if one is HALF_VIEW else sample_folder / "scans" / one.file
    mesh = read_mesh(path)
    assert mesh.boundary_loops
    smooth = mesh.vertex_adjacency @ mesh.vertices / mesh.vertex_adjacency.sum(axis=1)[:, None]
    rough = np.abs(np.einsum("nd,nd->n", mesh.vertices - smooth, mesh.vertex_normals))
    assert 0.3 * one.scanner.noise < np.median(rough) < 2 * one.scanner.noise


def test_the_walk_has_gaps_and_a_copy_without_names(sample_folder):
    walk, unnamed = (read_markers(sample_folder / f"{name}.c3d") for name in ("walk", "unnamed"))
    assert len(walk.labels) == 41 and "LKNE" in walk.labels and not set(walk.labels) & set(unnamed.labels)
    np.testing.assert_array_equal(walk.positions, unnamed.positions)
    assert 0.01 < np.isnan(walk.positions).mean() < 0.05


@pytest.mark.slow
def test_the_same_files_again_in_ten_seconds_beside_what_was_made_of_them(sample_folder, tmp_path):
    began = time.process_time()
    for _ in range(2):
        assert run(write_sample, "scape sample", ["-o", str(tmp_path / "sample")]) == 0
        (tmp_path / "sample" / "out").mkdir(exist_ok=True)
        (tmp_path / "sample" / "out" / "mine.txt").write_text("kept")
    assert (time.process_time() - began) / 2 < 10
    again = files(tmp_path / "sample")
    assert again.pop("out/mine.txt") == b"kept" and again == files(sample_folder)
