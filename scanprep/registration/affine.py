"""The regularisers of published registrations, behind one interface: links between neighbours that resist.

- "rigid": neighbouring nodes hold each other in their relative pose [Hahnel].
- "affine": every vertex has an affine map of its own, and neighbours want theirs alike in the Frobenius norm
  [Allen]; with a weight for the translations, solved exactly at every stiffness, stiff to soft [Amberg].

Matches and landmarks come from outside as a `Pull`, so all kinds share matching with the default registration. With
matches held fixed the affine energy is quadratic, so one sparse system gives its minimum.
"""
from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from scipy.sparse import bsr_array, coo_array, csc_array, diags_array, kron

from ..geometry.mesh import Mesh
from ..geometry.sparse import Factored, factor
from ..ranges import Count, Positive, Settings
from .deformation_graph import DeformationGraph, NodeMotion, build_graph, carry_over, deform, start
from .energies import UNKNOWNS, NodePattern, Pull, Term, bend_term, data_term, stretch_term
from .shell import conjugate_gradients

LinkKind = Literal["rigid", "affine"]


@dataclass(frozen=True)
class LinkStage(Settings):
    """One stage of a registration by links. Lengths are multiples of the template's size, √area.

    Attributes
    ----------
    kind : "rigid" or "affine"
    length : float
        Length over which the links resist: what is much smaller is not followed.
    landmarks : float
        The share of the surface that one landmark weighs as much as.
    reach : float
        Farthest match that counts; 0 leaves the scan out.
    rounds : int
        Times that matches are sought anew.
    translation : float
        Weight of differing translations against differing linear parts; affine links only.
    bend : float
        Length over which turns are held alike, as a share of `length`; rigid links only.
    nodes : int
        Nodes that are linked; rigid links only.
    slide : float
        Force of a match along the surface as a share of that across it: 1 draws point to point.
    """

    kind: LinkKind
    length: Positive
    landmarks: float
    reach: float
    rounds: Count = 2
    translation: float = 1.0
    bend: Positive = 0.1
    nodes: Count = 2000
    slide: float = 1.0


def hahnel_stages() -> tuple[LinkStage, ...]:
    """Rigid links, drawn to the landmarks first, then to the scan with ever softer links [Hahnel]."""
    first = tuple(LinkStage("rigid", 0.7, held, 0.0, 8, nodes=500) for held in (0.001, 0.1, 10.0))
    coarse = tuple(LinkStage("rigid", length, 0.01, 2 * length, 3, nodes=500) for length in (0.2, 0.1, 0.06, 0.04))
    return first + coarse + tuple(LinkStage("rigid", length, 0.005, 0.04, 3) for length in (0.04, 0.02))


def allen_stages() -> tuple[LinkStage, ...]:
    """Landmarks and smoothness first, then data with landmarks, then data alone [Allen]."""
    first = LinkStage("affine", 0.5, 1.0, 0.0, 1)
    middle = tuple(LinkStage("affine", length, 0.1, 0.3, 4) for length in (0.5, 0.3))
    return first, *middle, *(LinkStage("affine", length, 0.0, 0.06, 4) for length in (0.2, 0.1, 0.05))


def amberg_stages() -> tuple[LinkStage, ...]:
    """The stiffness falls by a constant factor, landmarks fade with it, each step to its optimum [Amberg]."""
    steps = tuple(LinkStage("affine", float(length), float(0.4 * length**2), float(max(0.6 * length, 0.03)), 4,
                            translation=0.1) for length in np.geomspace(0.5, 0.04, 8))
    return LinkStage("affine", 0.5, 1.0, 0.0, 1, translation=0.1), *steps


class Links(Protocol):
    """A template held together by links."""

    @property
    def vertices(self) -> np.ndarray:
        """(N, 3) metres."""
        ...

    def round(self, wanted: Pull, stage: LinkStage) -> np.ndarray:
        """Move to the minimum under what matches and landmarks want; the new vertices (N, 3)."""
        ...


def build_links(kind: LinkKind, template: Mesh, x: np.ndarray | None = None, T: np.ndarray | None = None) -> Links:
    """Links over a template that has been placed by a rigid transform.

    Parameters
    ----------
    kind : "rigid" or "affine"
    template : Mesh
    x : (N, 3) float, metres, optional
        Where the vertices lie; by default where T puts them.
    T : (4, 4) float, optional
        By default the identity.

    Raises
    ------
    ValueError
        A kind that does not exist.
    """
    T = np.eye(4) if T is None else T
    placed = template.vertices @ T[:3, :3].T + T[:3, 3] if x is None else x
    if kind == "affine":
        return AffineLinks(template, placed, T)
    if kind == "rigid":
        return RigidLinks(template, placed, T)
    raise ValueError(f'kind: expected "rigid" or "affine", got {kind!r}')


class AffineLinks:
    """An affine map at every vertex, neighbours alike.

    Lengths inside are multiples of the template's size and counted from its middle, so that neither the unit nor
    the place of the scan matters to the weight of the translations.
    """

    def __init__(self, template: Mesh, x: np.ndarray, T: np.ndarray) -> None:
        N = len(template.vertices)
        self.size = float(np.sqrt(template.face_areas.sum()))
        self._middle = x.mean(axis=0)
        rest = template.vertices - template.vertices.mean(axis=0)
        self._rest = np.concatenate([rest / self.size, np.ones((N, 1))], axis=1)
        a, b = template.edges.T
        e = np.arange(len(a))
        D = csc_array(coo_array((np.r_[np.ones(len(e)), -np.ones(len(e))], (np.r_[e, e], np.r_[a, b])),
                                shape=(len(e), N)))
        self._differences = csc_array(D.T @ D)
        self.X = np.empty((N, 4, 3))
        self.X[:, :3] = T[:3, :3].T
        linear = np.einsum("nk,kd->nd", self._rest[:, :3], T[:3, :3].T)
        self.X[:, 3] = (x - self._middle) / self.size - linear

    @property
    def vertices(self) -> np.ndarray:
        return self.size * np.einsum("nk,nkd->nd", self._rest, self.X) + self._middle

    def energy(self, X: np.ndarray, stage: LinkStage) -> float:
        """What the links resist with, for maps (N, 4, 3)."""
        G = np.array([1, 1, 1, stage.translation])[None, :, None]
        Y = (X * G).reshape(len(X), -1)
        return float(stage.length**4 * np.sum(Y * (self._differences @ Y)))

    def round(self, wanted: Pull, stage: LinkStage) -> np.ndarray:
        """Solve for all maps at once; with a force across the surface alone, as a step from where they are."""
        G = np.array([1, 1, 1, stage.translation])
        N, v = len(self.X), self._rest
        links = stage.length**4 * kron(self._differences, diags_array(G**2 + 1e-12), format="csc")
        A = wanted.A / self.size**2
        pulled = np.einsum("nii->n", A) / 3
        local = pulled[:, None, None] * v[:, :, None] * v[:, None, :]
        # A little inertia keeps the system regular where nothing draws a part of the body.
        tiny = 1e-9 * diags_array(np.ones(4 * N) / N)
        nearly = Factored(csc_array(links + tiny + bsr_array((local, np.arange(N), np.arange(N + 1))).tocsc()))
        x = np.einsum("nk,nkd->nd", v, self.X)
        pull_left = (wanted.b - np.einsum("nij,nj->ni", wanted.A, self._middle[None])) / self.size**3
        force = v[:, :, None] * (pull_left - np.einsum("nij,nj->ni", A, x))[:, None, :]
        flat = force.reshape(4 * N, 3) - links @ self.X.reshape(4 * N, 3)

        def system(d: np.ndarray) -> np.ndarray:
            moved = np.einsum("nk,nkd->nd", v, d.reshape(N, 4, 3))
            back = v[:, :, None] * np.einsum("nij,nj->ni", A, moved)[:, None, :]
            return links @ d + tiny @ d + back.reshape(4 * N, 3)

        self.X = self.X + conjugate_gradients(system, flat, nearly.solve).reshape(N, 4, 3)
        return self.vertices


class RigidLinks:
    """Nodes that turn and move but keep their size, each holding its neighbours in their relative pose."""

    def __init__(self, template: Mesh, x: np.ndarray, T: np.ndarray) -> None:
        self.template = template
        self.size = float(np.sqrt(template.face_areas.sum()))
        self._x, self._T = x, T
        self._nodes = 0
        self.motion: NodeMotion | None = None

    @property
    def vertices(self) -> np.ndarray:
        return self._x

    def round(self, wanted: Pull, stage: LinkStage) -> np.ndarray:
        """Damped Gauss-Newton steps over turns and places of all nodes."""
        graph, pattern, motion = self._graph(stage.nodes)
        lock = np.zeros(UNKNOWNS)
        lock[3] = 1.0
        stretch, bend = stage.length * self.size, stage.bend * stage.length * self.size

        def terms(m: NodeMotion) -> list[Term]:
            return [data_term(graph, m, wanted), stretch_term(graph, m, stretch), bend_term(graph, m, bend)]

        now, damping = terms(motion), 1e-5
        for _ in range(3):
            normal = [term.normal(pattern) for term in now]
            H = pattern.matrix(np.sum([blocks for blocks, _ in normal], axis=0))
            half = np.sum([g for _, g in normal], axis=0)
            half[:, 3] = 0
            most = H.diagonal().max()
            hold = damping * H.diagonal() + 1e-9 * most + 1e6 * most * np.tile(lock, len(half))
            step = -factor(csc_array(H + diags_array(hold)))(half.reshape(-1)).reshape(-1, UNKNOWNS)
            step[:, 3] = 0
            ahead = terms(motion.moved(step))
            if sum(t.value for t in ahead) > sum(t.value for t in now):
                damping *= 100
                continue
            motion, now, damping = motion.moved(step), ahead, max(damping / 10, 1e-7)
        self.motion, self._x = motion, deform(graph, motion)
        return self._x

    def _graph(self, nodes: int) -> tuple[DeformationGraph, NodePattern, NodeMotion]:
        """The graph with so many nodes, and the motion so far on it."""
        if self.motion is None:
            self._deformation = build_graph(self.template, nodes)
            self.motion = start(self._deformation, self._T)
        elif nodes != self._nodes:
            finer = build_graph(self.template, nodes)
            self.motion = carry_over(self._deformation, self.motion, finer)
            self._deformation = finer
        if nodes != self._nodes:
            self._pattern, self._nodes = NodePattern(self._deformation), nodes
        return self._deformation, self._pattern, self.motion
