"""Registered bodies compared with each other: mirrored, copied, spiked, of another size, person or vertex order."""
from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .mesh import Mesh

# How many times as large as the others a body may be. 71 SCAPE poses of one man have 0.98 to 1.03, 227 SPRING men 0.90
# to 1.12. An adult is up to three times as large as a child; a metre is 3.28 feet.
ONE_BODY, ONE_KIND = 1.15, 3.0
# Sizes of SEVERAL bodies or more: a standard deviation beyond DIFFER is that of different people, and one below ALIKE
# that of one. In samples of 8 SCAPE has 0.002 to 0.015, SPRING 0.018 and more in 99 of 100.
SEVERAL, DIFFER, ALIKE = 5, 0.02, 0.012
# Copies lie on each other within this share of their radius, whatever their place and scale: 6 mm on a man. The nearest
# two people of SPRING are 17 mm apart, the nearest two poses of SCAPE 42 mm. So many vertices are compared.
COPIED, COMPARED = 0.01, 300
# Vertices in another order make more than this share of the edges twice or half as long: 12% or more even where each is
# exchanged for the next one. SCAPE, SPRING, animals and a hand of four fingers have at most 2%.
ANOTHER_ORDER, FACTOR = 0.08, 2.0
# Handedness: SCAPE, SPRING, animals and the hand have 0.5 to 1, people of three standard deviations in each component
# 0.36 or more, mirror images the negative of it, vertices in another order -0.2 to 0.2. Averages over 6 rings keep the
# sign where noise is as long as an edge.
MIRRORED, KEPT, RINGS = -0.2, 0.3, 6
# A torn edge is more than four times as long as in the others, by more than a tenth of the size (root of the area), 14
# cm on a man. SCAPE and SPRING have up to 6%, where an armpit was registered to the wrong side. A share of 3% of the
# edges is no spike any more: each of these has some six.
TORN_FACTOR, TORN, MANY = 4.0, 0.1, 0.03


def check_members(template: Mesh, bodies: np.ndarray, name: str, names: Sequence[str] = (), ratio: float = ONE_KIND
                  ) -> None:
    """Raise ValueError, with its name and what to do, for a body that cannot be one of its set.

    Poses of one body keep the lengths of its edges and the sides to which its surface bends, and people nearly do. So
    bodies are compared with the median of all; the limits are shares of the body's size.

    Parameters
    ----------
    template : Mesh
        N vertices.
    bodies : (n, N, 3) float, metres
        Poses of one body, or bodies of one kind.
    name : str
        What the bodies are called: an argument, or a folder.
    names : sequence of str, optional
        Names of the bodies; without them they are counted from 0.
    ratio : float
        How many times as large as the others a body may be: `ONE_BODY` for poses of one body, else `ONE_KIND`.
    """
    scale, stretch, torn = _compare_edges(template, bodies)
    hand = _handedness(template, bodies)
    strange = (np.abs(np.log(stretch)) > np.log(FACTOR)).mean(axis=1)
    # bends are lost in one body, or in all against a template that is the odd one
    lost = np.minimum(np.abs(hand), np.median(np.abs(hand))) < KEPT
    # size and side that most have; among two of each, those of the template
    most = float(np.sort(scale)[(len(scale) - 1) // 2])
    side = -1 if (hand < MIRRORED).sum() > len(hand) / 2 else 1
    for i, size in enumerate(scale / most):
        if (strange[i] > ANOTHER_ORDER and lost[i]) or torn[i].mean() > MANY:
            problem = (f"its vertices are in another order, or it is crumpled: {100 * strange[i]:.0f}% of its edges "
                       "are twice or half as long as in the other bodies; register the template to it")
        elif not 1 / ratio < size < ratio:
            problem = (f"it is {size:.4g} times as large as the other bodies: in another unit, or of another body? "
                       "Scale it as the others are")
        elif side * hand[i] < MIRRORED:
            problem = "it is a mirror image of the other bodies; change the sign of one coordinate"
        else:
            continue
        raise ValueError(f"{_label(name, names, i)}: {problem}, or leave it out")
    # all alike, but unlike the template
    if not 1 / ONE_KIND < most < ONE_KIND:
        raise ValueError(f"{name}: the bodies are {most:.4g} times as large as the template: the wrong unit?")
    if side < 0 and (hand < MIRRORED).all():
        raise ValueError(f"{name}: the bodies are mirror images of the template")


def find_doubtful_members(template: Mesh, bodies: np.ndarray, name: str, names: Sequence[str] = (),
                          ratio: float = ONE_KIND) -> list[str]:
    """Describe what needs a look in bodies that `check_members`, whose arguments these are, lets pass.

    A set of another size than the template, poses of different people, one body as many, copies, and spikes. An
    infinite `ratio` is for a mix, in which one body may have several poses.
    """
    scale, _, torn = _compare_edges(template, bodies)
    most, copies = float(np.median(scale)), _find_copies(bodies, COPIED if ratio == ONE_KIND else COPIED / 10)
    doubts = find_several_people(scale, name) if ratio == ONE_BODY else []
    # all bodies together: their size, and how much they differ in it
    if not 1 / ratio < most < ratio:
        doubts.append(f"{name}: the bodies are {most:.3g} times as large as the template: the wrong unit, or the "
                      "template of somebody else?")
    if ratio == ONE_KIND and len(scale) >= SEVERAL and not copies and (spread := np.log(scale).std(ddof=1)) < ALIKE:
        doubts.append(f"{name}: the bodies differ in size by {100 * spread:.2g}% only: one body in many poses, instead "
                      "of many people?")
    # single bodies: copies; and spikes, of which all edges are torn, and one of each neighbour
    for first, *others in copies:
        also = ", ".join(_label("", names, i) for i in others[:3]) + f" and {len(others) - 3} more" * (len(others) > 3)
        doubts.append(f"{_label(name, names, first)}: {also} is the same body in the same pose: leave out the copies")
    for i in np.flatnonzero(torn.any(axis=1)).tolist():
        spike = np.bincount(template.edges[torn[i]].ravel()).argmax()
        doubts.append(f"{_label(name, names, i)}: vertex {spike} is a spike, {torn[i].sum()} edges are torn: mend it, "
                      "or leave it out")
    return doubts


def find_several_people(scales: np.ndarray, name: str) -> list[str]:
    """Describe poses of one body whose sizes, `scales` (n,), differ as those of different people do."""
    spread = float(np.log(scales).std(ddof=1)) if len(scales) >= SEVERAL else 0.0
    return [f"{name}: the bodies differ in size by {100 * spread:.2g}%: different people, of whom each needs poses of "
            "their own?"] if spread > DIFFER else []


def measure_scales(template: Mesh, bodies: np.ndarray) -> np.ndarray:
    """Measure how many times as large as the template each body (n, N, 3) is, (n,): the median of its edges."""
    return _compare_edges(template, bodies)[0]


def _find_copies(bodies: np.ndarray, apart: float) -> list[list[int]]:
    """Group bodies (n, N, 3) that are equal up to place, turn and scale, by their numbers.

    `apart` is the largest distance, as a share of the radius.
    """
    points = np.asarray(bodies[:, ::max(1, bodies.shape[1] // COMPARED)], dtype=np.float64)
    points = points - points.mean(axis=1, keepdims=True)
    points /= np.linalg.norm(points, axis=(1, 2), keepdims=True)
    groups, left = list[list[int]](), np.arange(len(points))
    while len(left):
        # squared distance after the best turn: 2 - 2 (sum of the singular values, the last with the sign of the turn)
        across = np.einsum("ni,pnj->pij", points[left[0]], points[left])
        values = np.linalg.svd(across, compute_uv=False)
        values[:, 2] *= np.sign(np.linalg.det(across))
        same = 2 - 2 * values.sum(axis=1) < apart**2
        same[0] = True
        groups.append(left[same].tolist())
        left = left[~same]
    return [group for group in groups if len(group) > 1]


def _label(name: str, names: Sequence[str], i: int) -> str:
    """Name body `i` of a folder, or of an argument in Python; `name` may be empty."""
    return f"{name}[{i}]" if not len(names) else f"{name}: {names[i]}" if name else names[i]


def _compare_edges(template: Mesh, bodies: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compare the edges of bodies (n, N, 3).

    Returned are the scale (n,) of each body against the template, how many times as long as usual each edge of each
    body is apart from its scale, (n, E), and whether it is torn, (n, E).
    """
    a, b = template.edges.T
    smallest = np.finfo(np.float32).tiny

    def lengths(body: np.ndarray) -> np.ndarray:
        return np.maximum(np.linalg.norm(body[a] - body[b], axis=1), smallest)

    rest = lengths(template.vertices)
    scale = np.array([np.median(lengths(body) / rest) for body in bodies])
    length = np.stack([lengths(body / s) for body, s in zip(bodies, scale, strict=True)]).astype(np.float32)
    usual = np.median(length if len(length) > 2 else np.vstack([length, rest]), axis=0)
    torn = (length > TORN_FACTOR * usual) & (length - usual > TORN * np.sqrt(template.face_areas.sum()))
    return scale, length / usual, torn


def _handedness(template: Mesh, bodies: np.ndarray) -> np.ndarray:
    """Measure whether the surface of bodies (n, N, 3) bends as the template's, (n,): from 1 to -1 in a mirror.

    Every two triangles that share an edge span a tetrahedron, whose signed volume tells to which side the edge bends.
    Surfaces are smoothed first, as noise bends short edges at random.
    """
    # the tetrahedra: the two ends of every inner edge, and the corners opposite to it
    first, second = template.side_pairs.T
    across = np.roll(template.faces, 1, axis=1).ravel()                 # the corner opposite to the sides 01, 12, 20
    a, b = template.edges[template.face_edges.ravel()[first]].T
    c, d = across[first], across[second]
    neighbours = template.vertex_adjacency
    share = 1 / neighbours.sum(axis=1)[:, None]

    def bends(x: np.ndarray) -> np.ndarray:
        x = x - x.mean(axis=0)
        for _ in range(RINGS):
            x = (x + share * (neighbours @ x)) / 2
        volume = np.einsum("ei,ei->e", x[b] - x[a], np.cross(x[c] - x[a], x[d] - x[a]))
        return volume / max(np.abs(volume).sum(), np.finfo(np.float64).tiny)

    known = np.sign(bends(template.vertices))
    return np.array([known @ bends(body) for body in bodies])
