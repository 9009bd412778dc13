"""Soles of scans that end flat at the floor."""
import numpy as np
import pytest

from scanprep.geometry import rotations
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.target import target_of
from scanprep.registration.ground import find_floor, foot_of_vertex, put_on_floor, soles_row, with_soles
from scanprep.registration.nonrigid import Registration
from scanprep.registration.person import PersonParts
from scanprep.synthetic.people import BodyShape, SyntheticPerson, find_pose

UP = np.array([0, 0, 1.0])
R, T = rotations.exp(np.array([0.9, -0.4, 1.3])), np.array([0.5, -2.0, 0.7])


def cut(mesh, height):
    """A mesh above a height, its triangles cut in the plane; open there."""
    z = mesh.vertices[:, 2] - height
    faces, vertices, new = mesh.faces[(z[mesh.faces] > 0).all(axis=1)].tolist(), list(mesh.vertices), {}

    def between(a, b):
        if (min(a, b), max(a, b)) not in new:
            new[min(a, b), max(a, b)] = len(vertices)
            vertices.append(mesh.vertices[a] + z[a] / (z[a] - z[b]) * (mesh.vertices[b] - mesh.vertices[a]))
        return new[min(a, b), max(a, b)]

    for face in mesh.faces[np.isin((z[mesh.faces] > 0).sum(axis=1), (1, 2))]:
        above = z[face] > 0
        alone = int(np.flatnonzero(above if above.sum() == 1 else ~above)[0])
        a, b, c = np.roll(face, -alone)
        p, q = between(a, b), between(a, c)
        faces += [[a, p, q]] if above.sum() == 1 else [[b, c, p], [c, q, p]]
    used, index = np.unique(faces, return_inverse=True)
    return Mesh(np.array(vertices)[used], index.reshape(-1, 3))


def walled(mesh, height):
    """A mesh cut at a height, and walls from there down to 0: as scanners that look from above see feet on a floor."""
    upper = cut(mesh, height)
    loops = [loop for loop in upper.boundary_loops if np.abs(upper.vertices[loop, 2] - height).max() < 1e-9]
    vertices, faces = [upper.vertices], [upper.faces]
    count = len(upper.vertices)
    for loop in loops:
        above = loop
        for level in (2, 1, 0):
            below = count + np.arange(len(loop))
            count += len(loop)
            vertices.append(np.c_[upper.vertices[loop, :2], np.full(len(loop), level * height / 3)])
            a, b, c, d = above, np.roll(above, -1), below, np.roll(below, -1)
            faces += [np.c_[b, a, c], np.c_[b, c, d]]
            above = below
    return Mesh(np.concatenate(vertices), np.concatenate(faces))


@pytest.fixture(scope="module")
def person():
    return SyntheticPerson(BodyShape.like("male", stature=1.82, weight=0.4))


@pytest.fixture(scope="module")
def foot(person):
    return foot_of_vertex(person.mesh, person.skeleton)


@pytest.fixture(scope="module")
def sunken(person):
    """The person with feet as of somebody else, which go on 22 mm below the floor where nothing was measured."""
    x = person.mesh.vertices.copy()
    x[:, 2] -= 0.022 * np.clip(1 - x[:, 2] / 0.015, 0, 1)
    return person.mesh.with_vertices(x)


@pytest.fixture(scope="module")
def other(person):
    """A template with feet that are as much unlike the person's as those of synthetic and real men: 6 to 8 mm."""
    x = person.mesh.vertices
    low, side = np.clip(1 - x[:, 2] / 0.12, 0, 1), np.sign(x[:, 0])
    middle = np.abs(x[low > 0, 0]).mean()
    narrow = np.c_[-0.6 * (x[:, 0] - middle * side), 0 * x[:, 0], 0.8 * x[:, 2]]
    return person.mesh.with_vertices(x + low[:, None] * narrow)


def on(scan, reference, body, foot):
    target = target_of(scan)
    return put_on_floor(reference, body, foot, target.points, target.normals)


@pytest.mark.parametrize("scanned", [lambda m: walled(m, 0.009), lambda m: cut(m, 0.004)], ids=["walls", "cut"])
def test_soles_below_the_floor_come_to_rest_on_it(person, other, sunken, foot, scanned):
    """Whatever way the scan is turned, to 5 mm; all that is above the floor stays."""
    scan = scanned(person.mesh)
    turned, body = (mesh.with_vertices(mesh.vertices @ R.T + T) for mesh in (scan, sunken))
    found = on(turned, other, body, foot)
    assert found is not None and found.beyond[0] > 0.02
    np.testing.assert_allclose(found.floor.normal, R @ UP, atol=1e-3)
    back = (found.vertices - T) @ R
    assert abs(back[:, 2].min()) < 0.005 and np.ptp(back[:, 2]) == pytest.approx(person.anatomy.stature, abs=0.005)
    above = sunken.vertices[:, 2] > 0.0045
    np.testing.assert_allclose(back[above], sunken.vertices[above], atol=1e-12)
    assert (sunken.with_vertices(back).face_areas > 0).all()


def test_noise_and_single_points_below_do_not_move_the_floor(person, other, sunken, foot):
    rng = np.random.default_rng(3)
    scan = walled(person.mesh, 0.009)
    x = scan.vertices + (scan.vertices[:, 2:] > 0) * 0.001 * rng.normal(size=scan.vertices.shape)    # cut afterwards
    x[rng.integers(len(x), size=3), 2] = -0.03
    found = on(scan.with_vertices(x), other, sunken, foot)
    assert found is not None and abs(found.floor.offset) < 0.002 and abs(found.vertices[:, 2].min()) < 0.005


@pytest.mark.parametrize("height", [0.0, 0.005, 0.010, 0.015])
def test_a_body_that_is_like_the_person_keeps_its_soles(person, foot, height):
    """A scanner may cut above the floor, and then feet that fit know better where it is."""
    found = on(cut(person.mesh, height + 1e-4), person.mesh, person.mesh, foot)
    off = 0.0 if found is None else found.vertices[:, 2].min()
    assert (height < 0.005 or found is not None) and abs(off) < 0.005


def views(person):
    """Scans that do not end flat around the feet, each with the body on it."""
    whole, x = person.mesh, person.mesh.vertices
    yield "whole", whole, whole
    yield "knees", whole, cut(whole, 0.5)
    yield "ankles", whole, cut(whole, 0.1)
    yield "front", whole, cut(whole.submesh(whole.face_normals[:, 1] < 0)[0], 0.004)
    yield "no feet", whole, whole.submesh((x[whole.faces, 2] > 0.9).all(axis=1))[0]
    jump = whole.with_vertices(person.in_pose(find_pose("kick_left")))
    yield "kick", jump, jump.submesh(jump.face_normals[:, 2] > -0.9)[0]
    head = x[:, 2].max() - 0.01
    yield "crown", whole, whole.submesh((x[whole.faces, 2] < head).all(axis=1))[0]


@pytest.mark.parametrize("name", ["whole", "knees", "ankles", "front", "no feet", "kick", "crown"])
def test_other_scans_have_no_floor(person, foot, name):
    body, scan = next((body, scan) for known, body, scan in views(person) if known == name)
    target = target_of(scan)
    deeper = body.vertices - 0.002 * (foot > 0)[:, None] * UP              # a fit is never exact
    assert find_floor(body.with_vertices(deeper), foot > 0, target.points, target.normals) is None


def test_a_registration_tells_what_was_done(person, other, sunken):
    none, parts = np.zeros(len(sunken.vertices)), PersonParts(person.skeleton, np.tile(np.eye(3), (16, 1, 1)))
    fit = Registration(sunken, none, none == 0, 0.0, 0.0, True, 1, {}, 0, none, 0.0)
    done = with_soles(other, walled(person.mesh, 0.009), fit, parts)
    assert abs(done.mesh.vertices[:, 2].min()) < 0.005 and done.inverted == 0
    assert done.soles[0] == pytest.approx(0.022, abs=0.001) and done.soles[1] < 0.005
    assert "soles rest on it" in str(soles_row(done.soles)[0])
    assert with_soles(other, person.mesh, fit, None) is fit and not soles_row(fit.soles)
    cloud = with_soles(other, walled(person.mesh, 0.009).vertices, fit, parts)
    assert abs(cloud.mesh.vertices[:, 2].min()) < 0.005
