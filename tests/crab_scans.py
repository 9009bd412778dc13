"""Scans of a crab whose arms bend, and how far a registration is off."""
from dataclasses import replace

import numpy as np
import pytest
from coregistered import QUICK
from jointed_bodies import crab

from scanprep.registration.schedule import GraphStage
from scanprep.skeleton.tree import Skeleton

COARSE = replace(QUICK, registration=replace(QUICK.registration, final_fit=False))     # bodies of 398 vertices
PLAIN = replace(QUICK.registration, graph=(GraphStage(80, 0.2, 0.7, 0.01, 0.21),
                                           GraphStage(80, 0.13, 0.7, 0.01, 0.15), *QUICK.registration.graph))
FAR = np.array([0, -1.3, 0.1]), np.array([0.1, 1.3, 0.2])          # both arms far from the template's


@pytest.fixture(name="body", scope="module")
def crab_body():
    return crab()


@pytest.fixture(name="skeleton", scope="module")
def crab_skeleton(body):
    part = np.select([body.corners.mean(axis=1)[:, 0] < -0.2, body.corners.mean(axis=1)[:, 0] > 0.2], [1, 2], 0)
    joints = np.array([[0, 0, 0], [-0.2, 0, 0], [0.2, 0, 0]])
    joints[0] = body.vertices[Skeleton(part, [-1, 0, 0], joints).part_of_vertex(body) == 0].mean(axis=0)
    return Skeleton(part, [-1, 0, 0], joints)


def scan_of(body, vertices, keep=None, seed=0):
    """Noisy points all over, or where `keep` says of points and normals."""
    rng = np.random.default_rng(seed)
    truth = body.with_vertices(vertices)
    points, face, _ = truth.sample(3900, rng)
    chosen = np.ones(len(points), dtype=bool) if keep is None else keep(points, truth.face_normals[face])
    return (points + rng.normal(0, 5e-4, points.shape))[chosen]


def mean_mm(found, truth):
    return 1e3 * np.linalg.norm(found - truth, axis=1).mean()
