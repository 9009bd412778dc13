"""A layout on another triangulation."""
from dataclasses import replace

import numpy as np
import pytest
from people_bodies import kept, small_people

from completion.mocap.marker_sets.layout import MarkerLayout
from completion.mocap.marker_sets.named import load_layout
from completion.mocap.marker_sets.transfer import transfer_layout
from scanprep.decimation.decimate import decimate
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.rotations import exp
from scanprep.registration.schedule import RegistrationConfig

NEAR = replace(RegistrationConfig(), graph=())          # bodies that lie on each other already


@pytest.fixture(scope="module")
def body():
    return small_people().template


@pytest.fixture(scope="module")
def layout(body):
    return load_layout("cmu41", body, kept())


def renumbered(body, rng):
    order = rng.permutation(len(body.vertices))
    return Mesh(body.vertices[order], np.argsort(order)[body.faces][rng.permutation(len(body.faces))]), order


def test_on_the_same_triangles_markers_stay_where_they_are(body, layout):
    model = small_people()
    posed = body.with_vertices(model.vertices(np.random.default_rng(0).normal(0, 0.5, (16, 3)), np.ones(model.n_betas)))
    found = transfer_layout(layout, body, posed)
    assert found.layout is layout and found.registered is posed and found.rms == 0 and (found.confidence == 1).all()


def test_renumbered_vertices_and_triangles_change_nothing(body, layout):
    target, _ = renumbered(body, np.random.default_rng(1))
    found = transfer_layout(layout, body, target, config=NEAR, search=False)
    off = np.linalg.norm(found.layout.skin_points(target.vertices) - layout.skin_points(body.vertices), axis=1)
    assert off.mean() < 0.002 and off.max() < 0.012 and found.uncovered < 0.001 and found.rms < 0.0005
    assert found.layout.labels == layout.labels and found.layout.loose == layout.loose
    assert found.layout.aliases == layout.aliases
    np.testing.assert_array_equal(found.layout.distances, layout.distances)
    assert (found.layout.weights >= 0).all() and (found.distances < 0.002).all()
    np.testing.assert_array_equal(np.sort(found.registered.faces, axis=None), np.sort(body.faces, axis=None))


def test_fewer_triangles_of_one_body_and_back(body, layout):
    small = decimate(body, 1400)
    there = transfer_layout(layout, body, small, config=NEAR, search=False).layout
    off = np.linalg.norm(there.skin_points(small.vertices) - layout.skin_points(body.vertices), axis=1)
    back = transfer_layout(there, small, body, config=NEAR, search=False).layout
    returned = np.linalg.norm(back.skin_points(body.vertices) - layout.skin_points(body.vertices), axis=1)
    assert off.mean() < 0.005 and returned.mean() < 0.005 and max(off.max(), returned.max()) < 0.03


def test_a_transfer_rotates_with_the_bodies(body, layout):
    target = decimate(body, 2800)                             # nearly the body: coarser ones come to 17 micrometres
    R, t = exp(np.array([0.3, -0.8, 1.9])), np.array([1.0, -2, 0.5])
    turn = lambda mesh: mesh.with_vertices(mesh.vertices @ R.T + t)          # noqa: E731
    here = transfer_layout(layout, body, target, config=NEAR, search=False).layout
    there = transfer_layout(layout, turn(body), turn(target), config=NEAR, search=False).layout
    wanted = here.skin_points(target.vertices) @ R.T + t
    off = np.linalg.norm(there.skin_points(turn(target).vertices) - wanted, axis=1)
    assert np.median(off) < 1e-5 and off.mean() < 0.001                      # where points tie, nearest ones may differ


def test_what_does_not_fit_is_refused(body, layout):
    target, _ = renumbered(body, np.random.default_rng(1))
    far = target.with_vertices(4 * target.vertices)
    with pytest.raises(ValueError, match=r"target: .* brought onto it, (99|100)% .* give landmarks"):
        transfer_layout(layout, body, far, config=replace(NEAR, final_fit=False), search=False)
    with pytest.raises(ValueError, match="marker 'A' sits on vertex 99999"):
        transfer_layout(MarkerLayout(("A",), np.array([99_999])), body, target)
    with pytest.raises(ValueError, match="landmarks: expected"):
        transfer_layout(layout, body, target, (np.array([1]), np.zeros((1, 3))), NEAR)
