import numpy as np
import pytest
from model_bodies import worm, worm_skeleton

from model.blending import BlendedTemplate, rigid_weights
from model.gradients import GradientSystem, edges, pose_gradients, shape_gradients
from scanprep.geometry.mesh import Mesh


@pytest.fixture(scope="module")
def body():
    return worm()


def test_edges_start_at_the_first_vertex(body):
    e = edges(np.stack([body.vertices, 2 * body.vertices]), body.faces)
    k = 17
    a, b, c = body.vertices[body.faces[k]]
    np.testing.assert_allclose(e[0, k], [b - a, c - a], atol=0)
    np.testing.assert_allclose(e[1], 2 * e[0], rtol=1e-15)


def test_local_edges_undo_the_rotation_of_the_part(body):
    skeleton = worm_skeleton(body)
    parts, pose = skeleton.part_of_face == 2, np.random.default_rng(0).normal(0, 1, (2, 4, 3))
    R = skeleton.part_rotations(pose)[:, 2]
    blended = BlendedTemplate(body, skeleton, rigid_weights(skeleton))
    back = blended.local_edges(body.vertices @ np.swapaxes(R, -1, -2), pose)[:, parts]
    np.testing.assert_allclose(back, np.stack([edges(body.vertices, body.faces)[parts]] * 2), atol=1e-14)


def test_a_linear_map_per_part_is_recovered_exactly(body):
    """Nothing to smooth within a part, so the least squares has a zero."""
    parts = worm_skeleton(body).part_of_face
    rng = np.random.default_rng(1)
    Q = np.eye(3) + rng.normal(0, 0.2, (50, 4, 3, 3))            # more instances than one solve takes
    local = edges(body.vertices, body.faces) @ np.swapaxes(Q[:, parts], -1, -2)
    found = pose_gradients(GradientSystem(body, 0.001, parts), local)
    # the pull towards I is the only thing that moves them
    np.testing.assert_allclose(found, Q[:, parts], atol=1e-3)


def test_smoothness_is_a_thousandth_of_the_mean_edge(body):
    """[SCAPE] Eq. 5: w_s = 0.001 ρ, for every template that is learned on."""
    sides = np.unique(np.sort(body.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    rho = np.linalg.norm(body.vertices[sides[:, 0]] - body.vertices[sides[:, 1]], axis=1).mean()
    assert GradientSystem(body).w_s == pytest.approx(0.001 * rho)
    assert GradientSystem(body.with_vertices(2 * body.vertices)).w_s == pytest.approx(0.002 * rho)


def test_eq_5_is_the_minimum_of_its_energy(body):
    rng = np.random.default_rng(2)
    parts = worm_skeleton(body).part_of_face
    system = GradientSystem(body, 0.001, parts)
    v_hat = edges(body.vertices, body.faces)
    local = v_hat + rng.normal(0, 0.01, v_hat.shape)
    Q = pose_gradients(system, local[None])[0]
    a, b = body.face_pairs[parts[body.face_pairs[:, 0]] == parts[body.face_pairs[:, 1]]].T

    def energy(Q):
        data = ((v_hat @ np.swapaxes(Q, -1, -2) - local) ** 2).sum()
        return data + system.w_s * (((Q[a] - Q[b]) ** 2).sum() + 1e-4 * ((Q - np.eye(3)) ** 2).sum())

    lowest = energy(Q)
    for _ in range(5):
        step = 1e-4 * rng.normal(size=Q.shape)
        up, down = energy(Q + step) - lowest, energy(Q - step) - lowest
        assert up > 0 and abs(up - down) < 1e-6 * up                # a stationary point of a parabola


def test_one_person_solved_alone_agrees_with_all_at_once(body):
    """With Q = I and no parts Eq. 8 is Eq. 5: two ways to the same matrices."""
    rng = np.random.default_rng(3)
    system = GradientSystem(body, 0.001)
    v_hat = edges(body.vertices, body.faces)
    local = v_hat + rng.normal(0, 0.01, v_hat.shape)
    np.testing.assert_allclose(shape_gradients(system, v_hat, local), pose_gradients(system, local[None])[0],
                               atol=1e-9)


def test_smoothing_stops_at_part_borders(body):
    parts = worm_skeleton(body).part_of_face
    across = GradientSystem(body, 0.001).laplacian
    within = GradientSystem(body, 0.001, parts).laplacian
    pairs = body.face_pairs
    border = parts[pairs[:, 0]] != parts[pairs[:, 1]]
    assert border.sum() > 30
    a, b = pairs[border][0]
    assert across[a, b] < 0 and within[a, b] == 0
    assert across.nnz - within.nnz == 2 * border.sum()


def test_a_flat_surface_has_gradients_too():
    """All normals alike: nothing observes the third direction, and it stays as it is."""
    x, y = np.meshgrid(np.arange(4.0), np.arange(4.0))
    vertices = np.stack([x.ravel(), y.ravel(), np.zeros(16)], axis=1)
    i = np.array([i for i in range(12) if i % 4 < 3])
    flat = Mesh(vertices, np.vstack([np.stack([i, i + 1, i + 4], 1), np.stack([i + 1, i + 5, i + 4], 1)]))
    local = edges(vertices * [1.5, 0.5, 1], flat.faces)
    Q = pose_gradients(GradientSystem(flat, 0.001), local[None])[0]
    np.testing.assert_allclose(Q, np.broadcast_to(np.diag([1.5, 0.5, 1]), Q.shape), atol=1e-4)
