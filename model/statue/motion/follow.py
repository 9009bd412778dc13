"""A control mesh that follows a learned body model: motion as the model knows it, on the shape of the statue."""
from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.sparse import coo_array, csr_array, diags_array, eye_array

from scanprep.correspondence.correlated import find_correspondences
from scanprep.geometry import rotations
from scanprep.geometry.landmarks import match_landmarks
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import OrientedPoints, Surface
from scanprep.registration.nonrigid import Registration, register, registration_problem

from ...body import BodyModel
from ...fitting import fit_shape
from ...linear import Subject
from ..control.model import Statue
from ..detail.reconstruction import Reconstruction
from ..detail.subdivision import subdivide

_SAME_SIDE = 0.3                     # cosine of normals below which the nearest triangle is of another limb or side


class Follower:
    """A control mesh bound to the surface of a learned model's person, in the pose and place of the scan.

    Each control vertex keeps its offset from the point of the surface that it is bound to, in axes that turn with the
    edges around that point. `registered` (N, 3), the model's template on the scan, is nearer to it to find that point.
    """

    def __init__(self, mesh: Mesh, subject: Subject, pose: np.ndarray, trans: np.ndarray | None = None,
                 registered: np.ndarray | None = None) -> None:
        self.mesh, self.subject = mesh, subject
        body = subject.template.with_vertices(subject.vertices(pose, trans))
        if registered is not None and registered.shape != body.vertices.shape:
            raise ValueError(f"registered: expected shape {body.vertices.shape}, got {registered.shape}")
        near = body if registered is None else body.with_vertices(registered)
        self._bind = _bound(mesh, near)
        self._around = csr_array(self._bind @ _averaging(body))
        used = np.unique(self._around.indices)
        self._around, self._edges = self._around[:, used], body.edges[used]
        self._before = self._edge(body.vertices)
        self._offset = mesh.vertices - self._bind @ body.vertices

    def _edge(self, vertices: np.ndarray) -> np.ndarray:
        return vertices[self._edges[:, 1]] - vertices[self._edges[:, 0]]

    def vertices(self, poses: np.ndarray, trans: np.ndarray | None = None) -> np.ndarray:
        """The control mesh (..., n, 3), metres, in poses (..., J, 3) of the model."""
        if poses.ndim == 2:
            return self._moved(self.subject.vertices(poses, trans))
        trans = np.broadcast_to(np.zeros(3) if trans is None else trans, (len(poses), 3))
        return np.concatenate([[self._moved(body) for body in self.subject.vertices(poses[k:k + 32], trans[k:k + 32])]
                               for k in range(0, len(poses), 32)])

    def _moved(self, body: np.ndarray) -> np.ndarray:
        body = np.asarray(body, dtype=np.float64)
        outer = np.einsum("ea,eb->eab", self._edge(body), self._before).reshape(-1, 9)
        R = rotations.project((self._around @ outer).reshape(-1, 3, 3))
        return np.asarray(self._bind @ body + np.einsum("nab,nb->na", R, self._offset))


def _bound(mesh: Mesh, body: Mesh) -> csr_array:
    """(n, N) barycentric weights of the point of the body for each control vertex, with a compatible normal."""
    close = Surface(body).closest(mesh.vertices)
    corners, weights = body.faces[close.faces].copy(), close.bary.copy()
    facing = np.einsum("nd,nd->n", np.einsum("nc,ncd->nd", weights, body.vertex_normals[corners]), mesh.vertex_normals)
    wrong = np.flatnonzero(facing < _SAME_SIDE)
    if len(wrong):
        there = OrientedPoints(body.vertices, body.vertex_normals)
        found = there.match(mesh.vertices[wrong], mesh.vertex_normals[wrong], min_cosine=_SAME_SIDE)
        wrong, vertex = wrong[found.valid], found.index[found.valid]
        corners[wrong], weights[wrong] = vertex[:, None], [1, 0, 0]
    n = len(mesh.vertices)
    return csr_array(coo_array((weights.ravel(), (np.repeat(np.arange(n), 3), corners.ravel())),
                               shape=(n, len(body.vertices))))


def _averaging(body: Mesh) -> csr_array:
    """(N, E) how much the turn of each edge counts around each vertex."""
    N, edges = len(body.vertices), body.edges
    ends = csr_array(coo_array((np.ones(2 * len(edges)), (edges.T.ravel(), np.tile(np.arange(len(edges)), 2))),
                               shape=(N, len(edges))))
    ring = (body.vertex_adjacency != 0).astype(float) + eye_array(N)
    ring = csr_array(diags_array(1 / ring.sum(axis=1)) @ ring)
    for _ in range(4 - 1):
        ends = ring @ ends
    return csr_array(ends)


def follower_of(statue: Statue, model: BodyModel, registered: np.ndarray | None = None,
                progress: Callable[[int, int], None] | None = None) -> Follower:
    """The control mesh bound to a learned model, whose template, if not `registered`, is registered first."""
    if registered is None:
        surface = Reconstruction(statue.control, statue.map,
                                 subdivide(statue.control.mesh, statue.control.chart, 2)).mesh()
        registered = _registered(statue, model, surface, progress).mesh.vertices
    fit = fit_shape(model, registered)
    subject = model.subject(fit.betas if model.n_betas else None)
    return Follower(statue.control.mesh, subject, fit.pose, fit.trans, registered)


def _registered(statue: Statue, model: BodyModel, surface: Mesh, progress: Callable[[int, int], None] | None
                ) -> Registration:
    control, pairs, hints = statue.control, None, None
    places = {name: control.mesh.vertices[vertex] for name, vertex in control.landmarks.items()}
    try:
        pairs = match_landmarks(model.info.get("landmarks") or {}, places, minimum=8)[1:]
        pairs = pairs[0].astype(np.int64), pairs[1]
    except ValueError:                   # other names, or none
        hints = find_correspondences(model.template, surface)
    fit = register(model.template, surface, pairs, progress=progress, correspondences=hints)
    problem = registration_problem(model.template, surface, fit, pairs is not None)
    if problem:
        raise ValueError(f"model: its template could not be brought onto the statue, {problem}; register it to the "
                         "scan with landmarks (scape prep register) and name the result with --registered")
    return fit
