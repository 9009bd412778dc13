"""Bodies for the tests of `completion`: the worm of `model_bodies` with poses that are not all alike."""
from __future__ import annotations

from dataclasses import replace

import numpy as np
from model_bodies import worm_model

from completion.partial.settings import CompletionConfig
from model.scape import ScapeModel
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Rays

POSE = np.array([[0.3, -0.5, 0.8], [0.2, 0.5, -0.4], [-0.1, -0.6, 0.3], [0.3, 0.1, 0.5]])
TRANS = np.array([0.4, -0.3, 1.1])
MARKS = np.array([6, 75, 130, 200, 255, 330, 396])
QUICK = CompletionConfig(random_starts=6, rounds=5, scan_points=800, model_points=300)

MEAN = np.array([[0, 0, 0], [0, 0.2, -0.1], [0, -0.2, 0.1], [0.1, 0, 0.2]])
SD = 0.35


def worm_with_prior(components: int = 3) -> ScapeModel:
    """The worm whose training poses had these moments; the root's rows are zero."""
    covariance = np.diag(np.r_[np.zeros(3), np.full(9, SD**2)])
    model = worm_model(components=components, bulge=0.05)
    outside = model.template if model.template.volume > 0 else Mesh(model.template.vertices,
                                                                    model.template.faces[:, [0, 2, 1]])
    return replace(model, template=outside, pose_mean=MEAN, pose_covariance=covariance)


def half_view(body: Mesh, toward: np.ndarray, count: int = 4000, noise: float = 0.0, seed: int = 0
              ) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) that a camera 3 m away sees, and which vertices (N,) it sees."""
    rng = np.random.default_rng(seed)
    camera = body.vertices.mean(axis=0) + 3 * toward / np.linalg.norm(toward)
    rays = Rays(body)

    def visible(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        to = camera - points
        to = to / np.linalg.norm(to, axis=1, keepdims=True)
        return (np.einsum("nd,nd->n", to, normals) > 0.15) & ~rays.test_occlusion(points + 1e-3 * normals, to)

    points, face, _ = body.sample(3 * count, rng)
    points = points[visible(points, body.face_normals[face])][:count]
    along = (points - camera) / np.linalg.norm(points - camera, axis=1, keepdims=True)
    return points + along * rng.normal(0, noise, (len(points), 1)), visible(body.vertices, body.vertex_normals)
