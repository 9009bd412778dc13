"""Bodies with the six holes that scanners leave, and how well a filler closes them."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from protocols import RealData
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from scanprep.geometry.geodesics import SurfaceGraph
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Surface

RADII = {"crown": 0.06, "left armpit": 0.07, "right armpit": 0.07, "crotch": 0.07}
REAL_MARKS = {"crown": "top of head", "left armpit": "shoulder (bottom) left side",
              "right armpit": "shoulder (bottom) right side", "crotch": "between two legs"}
SYNTHETIC_MARKS = {"crown": "top of head", "left armpit": "left armpit", "right armpit": "right armpit",
                  "crotch": "crotch"}


@dataclass(frozen=True, eq=False)
class HoledBody:
    """A body with six holes, and what was there.

    Attributes
    ----------
    name : str
    truth, holed : Mesh
    removed : dict of (n,) int
        Hole -> true vertices inside it.
    """

    name: str
    truth: Mesh
    holed: Mesh
    removed: dict[str, np.ndarray]


def soles(upright: Mesh, toes: dict[str, int], height: float = 0.012) -> dict[str, np.ndarray]:
    """Triangles (F,) bool of each sole: those near the floor that look down, on a body that stands along z."""
    low = upright.vertices[:, 2].min()
    down = (upright.face_normals[:, 2] < -0.5) & (upright.corners[:, :, 2].max(axis=1) < low + height)
    middle = upright.corners.mean(axis=1)
    ends = np.array([upright.vertices[v] for v in toes.values()])
    nearest = np.linalg.norm(middle[:, None] - ends, axis=2).argmin(axis=1)
    return {name: down & (nearest == k) for k, name in enumerate(toes)}


def six_holes(name: str, truth: Mesh, marks: dict[str, int], sole: dict[str, np.ndarray], scale: float = 1.0
              ) -> HoledBody:
    """Discs along the surface about the landmarks, of `RADII` times a scale, and both soles, cut out."""
    graph = SurfaceGraph(truth)
    gone = {hole: (graph.distances(marks[hole], 2 * radius) < scale * radius)[truth.faces].all(axis=1)
            for hole, radius in RADII.items()} | sole
    mesh, used = truth.submesh(_one_piece(truth, ~np.any(list(gone.values()), axis=0)))
    left = np.zeros(len(truth.vertices), dtype=bool)
    left[used] = True
    removed = {hole: np.setdiff1d(truth.faces[faces], np.flatnonzero(left)) for hole, faces in gone.items()}
    return HoledBody(name, truth, mesh, removed)


def _one_piece(mesh: Mesh, keep: np.ndarray) -> np.ndarray:
    """(F,) bool: of the triangles to keep, those of the largest piece that hangs together by edges."""
    pairs = mesh.face_pairs[keep[mesh.face_pairs].all(axis=1)]
    count = len(mesh.faces)
    label = connected_components(coo_array((np.ones(len(pairs)), pairs.T), shape=(count, count)), directed=False)[1]
    return np.asarray(label == np.bincount(label[keep]).argmax())


def real_body(data: RealData, kind: str, index: int, scale: float = 1.0) -> HoledBody:
    """A pose ("pose") or a man ("man") of the real scans."""
    truth = data.template.with_vertices((data.poses if kind == "pose" else data.shapes)[index])
    toes = {"left sole": data.landmarks["toe in left leg"], "right sole": data.landmarks["toe in right leg"]}
    marks = {hole: data.landmarks[mark] for hole, mark in REAL_MARKS.items()}
    return six_holes(f"{kind}{index:03d}", truth, marks, soles(data.template, toes), scale)


def embedded_body(seed: int, scale: float = 1.0) -> HoledBody:
    """A procedural person near the rest pose."""
    from scanprep.synthetic import people
    from scanprep.synthetic.anatomy import BodyShape
    from scanprep.synthetic.data_set import near_rest, stand

    rng = np.random.default_rng(seed)
    person = people.SyntheticPerson(BodyShape.random(rng))
    rest, body = stand(person, np.zeros((16, 3))).mesh, stand(person, near_rest(rng)).mesh
    toes = {"left sole": people.LANDMARKS["left toe"], "right sole": people.LANDMARKS["right toe"]}
    marks = {hole: people.LANDMARKS[mark] for hole, mark in SYNTHETIC_MARKS.items()}
    return six_holes(f"embedded{seed}", body, marks, soles(rest, toes), scale)


def distances(item: HoledBody, filled: Mesh, kept: int | None) -> dict[str, float]:
    """Millimetres between the new surface and the true one, over all holes.

    Parameters
    ----------
    item : HoledBody
    filled : Mesh
    kept : int, optional
        Triangles of `filled` that were there before; without it (the filler remeshes) only true points that were
        cut out are measured.
    """
    out = {}
    missing = 1e3 * Surface(filled).closest(item.truth.vertices[np.concatenate(list(item.removed.values()))]).distances
    if kept is not None and kept < len(filled.faces):
        points = Mesh(filled.vertices, filled.faces[kept:]).sample(20_000, np.random.default_rng(0))[0]
        patch = 1e3 * Surface(item.truth).closest(points).distances
        out = {"patch_mean_mm": float(patch.mean()), "patch_max_mm": float(patch.max())}
    out |= {"truth_mean_mm": float(missing.mean()), "truth_max_mm": float(missing.max())}
    for hole, vertices in item.removed.items():
        apart = 1e3 * Surface(filled).closest(item.truth.vertices[vertices]).distances
        out |= {f"{hole} mean": float(apart.mean()), f"{hole} max": float(apart.max())}
    return out
