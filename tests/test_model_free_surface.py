import numpy as np
from completion_bodies import worm_with_prior
from scipy.sparse import csr_array

from model.fitting.free_surface import FreeSurface
from model.gradients import edges


def test_the_free_surface_minimises_equation_10():
    """Against the dense least squares over all edges with R, S and Q spelled out."""
    rng, body = np.random.default_rng(1), worm_with_prior()
    pose, betas = rng.normal(0, 0.4, (4, 3)), np.array([0.5, -1, 0.2])
    predicted = body.vertices(pose, betas)
    faces, n = body.template.faces, len(predicted)
    R = body.skeleton.part_rotations(pose)[body.skeleton.part_of_face]
    wanted = edges(body.template.vertices, faces) @ np.swapaxes(
        R @ body.shape_space.gradients(betas) @ body.pose_space.gradients(pose), -1, -2)
    rows = rng.choice(len(faces), 40, replace=False)
    bary = rng.dirichlet(np.ones(3), 40)
    C = csr_array((bary.ravel(), (np.repeat(np.arange(40), 3), faces[rows].ravel())), shape=(40, n))
    z, w = C @ predicted + rng.normal(0, 0.02, (40, 3)), rng.random(40)
    got = FreeSurface(body.template).solve(predicted, C, z, w)
    G = np.zeros((2 * len(faces), n))
    k = np.arange(len(faces))
    for j in (0, 1):
        np.add.at(G, (2 * k + j, faces[:, j + 1]), 1)
        np.add.at(G, (2 * k + j, faces[:, 0]), -1)
    A = np.vstack([G, np.sqrt(w)[:, None] * C.toarray()])
    dense = np.linalg.lstsq(A, np.vstack([wanted.reshape(-1, 3), np.sqrt(w)[:, None] * z]), rcond=None)[0]
    np.testing.assert_allclose(got, dense, atol=1e-7)
