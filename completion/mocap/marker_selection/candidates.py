"""Candidate markers: symmetric places, spread over the skin, from which a marker set is chosen."""
from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

import numpy as np
from scipy.sparse import coo_array, diags_array
from scipy.spatial import cKDTree

from model.fitting.bodies import at_rest
from scanprep.geometry.geodesics import SurfaceGraph
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.sides import other_side, side_of, split_side
from scanprep.geometry.surface import Rays
from scanprep.skeleton.tree import Skeleton

from ..marker_sets.layout import MarkerLayout
from ..marker_sets.symmetry import SkinMirror, find_skin_mirror

if TYPE_CHECKING:
    from model.body import BodyModel


def candidate_layout(body: BodyModel | Mesh, base: MarkerLayout, count: int = 114,
                     mirror: SkinMirror | None = None, skeleton: Skeleton | None = None) -> MarkerLayout:
    """Extend a marker set by markers as far along the skin from all others as possible, symmetric left and right.

    First, markers that the base has on one side only get their partner. New markers are named after their part, with L,
    R or M in front.

    Parameters
    ----------
    body : BodyModel or Mesh
        Of a model the mean person in the pose of the template, and its skeleton.
    base : MarkerLayout
        Its labels tell left from right.
    count : int
        Markers altogether, those of the base included.
    mirror : SkinMirror, optional
        Of `find_skin_mirror`; found when not given.
    skeleton : Skeleton, optional
        For the names, where `body` is a mesh.

    Returns
    -------
    MarkerLayout
        The markers of the base first.

    Raises
    ------
    ValueError
        Fewer than the base has, no room for so many, a body that is not symmetric, a base without sides.

    [MoSh] Eq. 25
    """
    if not isinstance(body, Mesh):
        skeleton, body = skeleton or body.skeleton, at_rest(body)
    mirror = mirror or find_skin_mirror(body)
    sides = np.array([side_of(label) for label in base.labels])
    turn = float(np.sign((sides * mirror.across[base.nearest]).sum()))
    if turn == 0:
        raise ValueError("base: expected labels that tell left from right, such as LELB and RELB, found "
                         f"{', '.join(base.labels[:6])}")
    # the partners that are missing in the base
    lonely = {label: o for label in base.labels if (o := other_side(label)) and o not in base.labels}
    rows = [base.labels.index(label) for label in lonely]
    loose = tuple(o for label, o in lonely.items() if label in base.loose)
    whole = base.merge(MarkerLayout(tuple(lonely.values()), mirror.partner[base.nearest[rows]], loose=loose))
    if count < len(whole.labels):
        raise ValueError(f"count: expected at least the {len(whole.labels)} markers of the base with their partners, "
                         f"got {count}")
    # new places, far from all others
    places = _spread(body, mirror, turn * mirror.across, count - len(whole.labels), whole.nearest)
    vertices = np.array([v for place in places for v in place], dtype=np.int64)
    return whole.merge(MarkerLayout(tuple(_names(body, skeleton, places)), vertices))


def sitting_room(body: Mesh, mirror: SkinMirror) -> np.ndarray:
    """Return a mask (N,) of vertices where a marker can sit: visible to cameras, flat, on thick limbs, not on soles.

    Lengths are shares of the body's length.
    """
    # shares of the length: 2.5% of either end with a normal along the axis is sole or crown; skin within 6% may hide a
    # marker from cameras
    axis, length = _long_axis(body, mirror)
    thick = 0.022  # the body is at least so thick below a marker; fingers and ears are not
    along = body.vertices @ axis
    near_end = np.minimum(along - along.min(), along.max() - along) < 0.025 * length
    at_end = near_end & (np.abs(body.vertex_normals @ axis) > 0.5)
    reach, normals = 0.06 * length, body.vertex_normals

    # flatness: cosine between a normal and the mean normal of its surroundings, weighted by area
    i, j = cKDTree(body.vertices).query_pairs(thick * length, output_type="ndarray").T
    each = np.arange(len(body.vertices))
    i, j = np.r_[i, j, each], np.r_[j, i, each]
    near = coo_array((body.vertex_areas[j], (i, j)), shape=(len(each), len(each))).tocsr()
    around = diags_array(1 / np.maximum(near.sum(axis=1), 1e-30)) @ near
    flatness = np.einsum("nd,nd->n", normals, around @ normals)

    # openness: share of 48 cosine-weighted outward rays that hit nothing; it is below 3/4 in armpits, in the crotch and
    # between fingers
    rays, n = Rays(body), 48
    origins, directions = _fans(body, np.sqrt((np.arange(n) + 0.5) / n))
    lifted = origins + 1e-4 * reach * np.repeat(normals, n, axis=0)
    openness = 1 - rays.test_occlusion(lifted, directions, reach).reshape(-1, n).mean(axis=1)
    closed = np.flatnonzero(around @ openness < 0.75)
    away = SurfaceGraph(body).nearest(closed)[0] if len(closed) else np.inf

    # thickness: median length of 16 inward rays to the skin on the other side, at most the reach
    n = 16
    origins, directions = _fans(body, 1 - (1 - 0.5) * (np.arange(n) + 0.5) / n)
    hit = rays.cast(origins - 1e-4 * reach * np.repeat(normals, n, axis=0), -directions, reach)[1]
    thickness = np.median(np.minimum(np.where(np.isfinite(hit), hit, reach), reach).reshape(-1, n), axis=1)
    return (away > 0.035 * length) & (thickness >= thick * length) & (flatness >= 0.75) & ~at_end


def _spread(body: Mesh, mirror: SkinMirror, across: np.ndarray, count: int, taken: np.ndarray
            ) -> list[tuple[int, ...]]:
    """Choose places one by one, (left, right) or (middle,), up to `count` vertices, far from those `taken`.

    `across` (N,), metres, is the distance of every vertex from its mirror image, positive on the left.
    """
    graph, partner, length = SurfaceGraph(body), mirror.partner, _long_axis(body, mirror)[1]
    free = sitting_room(body, mirror)
    free &= free[partner]
    on_line = np.abs(across) < float(np.linalg.norm(np.diff(body.vertices[body.edges], axis=1), axis=-1).mean())
    from_line = graph.nearest(np.flatnonzero(on_line))[0]
    on_left = free & (across > 0) & (from_line > 0.012 * length)        # closer to the line a marker has no partner
    near, found = graph.nearest(taken)[0], list[tuple[int, ...]]()
    while (left := count - sum(map(len, found))) > 0:
        # distance to all markers, for a pair also to its partner, which is twice as far as the middle line
        both = np.where(on_left, np.minimum(np.minimum(near, near[partner]), 2 * from_line), 0.0)
        alone = np.where(free & on_line, near, 0.0)
        paired = left > 1 and both.max() >= alone.max()
        v = int(both.argmax() if paired else alone.argmax())
        if max(both[v], alone[v]) <= 0:
            raise ValueError(f"count: no room on the body for {left} more markers")
        found.append((v, int(partner[v])) if paired else (v,))
        near = np.minimum(near, graph.nearest(np.array(found[-1]))[0])
    return found


def _names(body: Mesh, skeleton: Skeleton | None, places: list[tuple[int, ...]]) -> list[str]:
    """Return the labels of new markers: side, part, number."""
    parts = None if skeleton is None else skeleton.part_of_vertex(body)
    counts, labels = Counter[str](), list[str]()
    for place in places:
        stem, sides = "", "M" if len(place) == 1 else "LR"
        if skeleton is not None and parts is not None:
            stem = split_side(skeleton.names[parts[place[0]]])[0].replace(".", "_").upper() + "."
        counts[sides + stem] += 1
        labels += [f"{side}.{stem}{counts[sides + stem]}" for side in sides]
    return labels


def _long_axis(body: Mesh, mirror: SkinMirror) -> tuple[np.ndarray, float]:
    """Return the direction in the plane of symmetry along which the body is longest, and its length, metres."""
    across = (body.vertices - mirror.image(body)).T @ mirror.across
    across /= np.linalg.norm(across)
    x = body.vertices - body.vertices.mean(axis=0)
    x = x - np.outer(x @ across, across)
    axis = np.linalg.eigh((x * body.vertex_areas[:, None]).T @ x)[1][:, -1]
    return axis, float(np.ptp(body.vertices @ axis))


def _fans(body: Mesh, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return origins and unit directions (N·n, 3) about the normal of every vertex, with cosines `z` (n,) to it."""
    # a Fibonacci spiral about the z axis, in frames whose z is the normal; the first edge makes them turn with the body
    turn = np.arange(len(z)) * np.pi * (3 - np.sqrt(5))
    local = np.stack([np.sqrt(1 - z**2) * np.cos(turn), np.sqrt(1 - z**2) * np.sin(turn), z], axis=1)
    n, neighbour = body.vertex_normals, np.zeros(len(body.vertices), dtype=np.int64)
    neighbour[body.edges[:, 0]], neighbour[body.edges[:, 1]] = body.edges[:, 1], body.edges[:, 0]
    first = body.vertices[neighbour] - body.vertices
    first = first - np.einsum("nd,nd->n", first, n)[:, None] * n
    first /= np.maximum(np.linalg.norm(first, axis=1, keepdims=True), 1e-12)
    frames = np.stack([first, np.cross(n, first), n], axis=1)
    return np.repeat(body.vertices, len(z), axis=0), np.einsum("kc,ncd->nkd", local, frames).reshape(-1, 3)
