"""The size of the person in a scan: what has the wrong unit is refused before the long part of a search."""
import re

import numpy as np
import pytest
import trimesh

from completion import complete
from model.files import load_model
from model.fitting.bodies import as_body
from model.fitting.scale import find_size
from model.fitting.scan import prepare_scan
from model.fitting.search import find_bodies
from model.fitting.settings import ScanFitConfig
from scanprep import Mesh, write_mesh
from scanprep.geometry import rotations
from scanprep.plausible import WrongScaleError, check_unit
from scanprep.registration.unit import resolve_unit
from scanprep.synthetic.people import BodyShape, SyntheticPerson


@pytest.fixture(scope="module")
def model():
    return load_model("people")


@pytest.fixture(scope="module")
def woman():
    """Somebody who is not the mean of the model, turned about the axis that is up."""
    body = SyntheticPerson(BodyShape.random(np.random.default_rng(4), sex="female"))
    return body.mesh.with_vertices(body.mesh.vertices @ rotations.exp([0, 0, 0.7]).T)


def scale(mesh, factor):
    return mesh.with_vertices(factor * mesh.vertices)


def tall(mesh):
    return float(np.ptp(mesh.vertices[:, 2]))


def test_what_no_person_can_be_is_refused_at_once(woman, model):
    for factor, passes in ((1.0, True), (0.1, True), (5.0, True), (850.0, False), (1e-3, False)):
        if passes:
            check_unit(scale(woman, factor), model.template.vertices, "it is")
            continue
        with pytest.raises(WrongScaleError, match="times as large as the body: the wrong unit"):
            check_unit(scale(woman, factor), model.template.vertices, "it is")
    with pytest.raises(WrongScaleError, match="the scan is"):
        complete(model, scale(woman, 850.0))


@pytest.mark.slow
def test_an_adult_of_a_metre_has_the_wrong_unit(woman, model):
    """As THuman2 and generated meshes come; it became a monster after the whole search."""
    small = scale(woman, 1 / tall(woman))
    words = re.escape("m tall, with the proportions of an adult") + ".*--unit unknown"
    with pytest.raises(WrongScaleError, match=words) as told:
        complete(model, small)
    assert float(re.search(r"(\d\.\d+) m tall", str(told.value))[1]) == pytest.approx(1.0, abs=0.04)
    with pytest.raises(WrongScaleError, match=words):
        next(find_bodies(model, small))
    with pytest.raises(WrongScaleError, match=r"the person is [23]\.\d\d m tall"):
        next(find_bodies(model, scale(woman, 1.7)))


@pytest.mark.slow
def test_a_child_of_a_metre_is_a_child(woman, model):
    """A head too large for the stature tells: no scan of a child is refused."""
    neck = woman.vertices[:, 2].min() + 0.86 * tall(woman)
    above = woman.vertices[:, 2] > neck
    middle = woman.vertices[above].mean(axis=0)
    head = np.where(above[:, None], middle + 1.45 * (woman.vertices - middle), woman.vertices)
    child = scale(woman.with_vertices(head), 1.05 / np.ptp(head[:, 2]))
    size = find_size(as_body(model), prepare_scan(child), ScanFitConfig())
    assert size.head > 1.13 and size.stature == pytest.approx(1.05, abs=0.06)
    next(find_bodies(model, child))


@pytest.mark.slow
def test_the_unit_that_nobody_knows_is_found(woman, model, tmp_path):
    write_mesh(tmp_path / "scan.ply", scale(woman, 0.6))
    with pytest.warns(UserWarning, match="scan.ply: one unit in it is taken for"):
        metres = float(resolve_unit(tmp_path / "scan.ply", "unknown"))
    assert metres == pytest.approx(1 / 0.6, rel=0.07)
    assert resolve_unit(tmp_path / "scan.ply", "cm") == "cm" and resolve_unit(tmp_path / "scan.ply", None) is None
    write_mesh(tmp_path / "box.ply", Mesh(*(lambda box: (box.vertices, box.faces))(
        trimesh.creation.box([1, 1, 1]).subdivide().subdivide().subdivide())))
    with pytest.raises(WrongScaleError, match="no person was found"):
        resolve_unit(tmp_path / "box.ply", "unknown")


@pytest.mark.slow
def test_somebody_on_a_turntable_is_found(woman, model):
    """All orientations were tried in coarse steps, and the best of them stood in the turntable."""
    floor = woman.vertices[:, 2].min()
    table = trimesh.creation.cylinder(0.32, 0.25, sections=96).subdivide().subdivide()
    table.apply_translation([0, 0, floor - 0.125])
    scan = Mesh(np.concatenate([woman.vertices, table.vertices]),
                np.concatenate([woman.faces, table.faces + len(woman.vertices)]))
    done = complete(model, scan)
    up = done.completed.vertices[:, 2]
    assert np.ptp(up) == pytest.approx(tall(woman), abs=0.02) and up.min() == pytest.approx(floor, abs=0.02)
    assert done.judgement.verdict == "check"
