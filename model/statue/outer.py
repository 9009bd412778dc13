"""The outer surface of a figure: without teeth, joint balls, bodies under clothes and what else lies inside."""
from __future__ import annotations

import numpy as np
from scipy.spatial import ConvexHull, cKDTree

from scanprep.geometry.mesh import Mesh
from scanprep.geometry.sparse import label_components
from scanprep.geometry.surface import Rays
from scanprep.pictures.lighting import sphere_directions

SAMPLES, LEAST = 40_000, 24    # points spread over the surface, 6 mm apart on a person; and on the smallest shell
DIRECTIONS = 128               # half of them on each side of the surface
# Share of the rays on one side of a point. A covered point lets fewer than the first get out; teeth behind parted lips
# have 0.02, legs under a gown that is open below 0.05. More than the second end on another shell; two thirds do under
# clothes, none in the armpits and between the legs of a body that is one shell.
OUT, ON_OTHERS = 0.06, 0.5
# Share of the figure's height: a cover that is nearer is another view of the same skin, or the floor under the soles.
CLEAR = 0.003
WHOLE = 0.9                    # a shell of which more is covered is dropped whole
AROUND = 8                     # a point is covered where its nearest samples of its shell all are


def keep_outer(scan: Mesh) -> tuple[Mesh, float]:
    """Drop what other shells of a figure cover on every side.

    A shell is a connected component. What its own shell covers stays (armpits, nostrils, between the legs), so a body
    of one shell comes back as it is. The way in which triangles face does not matter.

    Parameters
    ----------
    scan : Mesh
        In any unit.

    Returns
    -------
    outer : Mesh
        The same object if nothing is inside.
    left_out : float
        Share of the surface that was left out.

    Examples
    --------
    >>> import trimesh
    >>> ball = trimesh.creation.icosphere(3)
    >>> outer, left_out = keep_outer(Mesh(np.vstack([ball.vertices, 0.5 * ball.vertices]),
    ...                                   np.vstack([ball.faces, ball.faces + len(ball.vertices)])))
    >>> len(outer.faces) == len(ball.faces), round(left_out, 2)
    (True, 0.2)
    """
    shell = _label_shells(scan)
    if shell.max(initial=0) == 0 or not scan.face_areas.sum() > 0:
        return scan, 0.0
    points, face = _sample_shells(scan, shell)
    covered, clearly = _find_covered(scan, shell, points, face)
    share = np.bincount(shell[face], covered, shell.max() + 1) / np.maximum(np.bincount(shell[face]), 1)
    inside = share[shell] > WHOLE
    # of a shell that shows in part, as a body under clothes, what lies among covered points only
    for number in np.flatnonzero((np.bincount(shell[face], clearly, len(share)) > 0) & (share <= WHOLE)):
        own, faces = shell[face] == number, np.flatnonzero(shell == number)
        vertices, corners = np.unique(scan.faces[faces], return_inverse=True)
        near = cKDTree(points[own]).query(scan.vertices[vertices], min(AROUND, int(own.sum())))[1]
        deep = clearly[own][near.reshape(len(vertices), -1)].all(axis=1)
        inside[faces] = deep[corners.reshape(-1, 3)].all(axis=1)
        inside[face[own & ~clearly]] = False
    left_out = float(scan.face_areas[inside].sum() / scan.face_areas.sum())
    return (scan.submesh(~inside)[0], left_out) if left_out else (scan, 0.0)


def find_plinth(scan: Mesh) -> float | None:
    """Find the height of a plinth: a wide block with a flat top under the feet; None where there clearly is none.

    Triangles face outward (`sanitise`), and their sides are short. Up is the longest axis.
    """
    size = np.ptp(scan.vertices, axis=0)
    axis, height = int(size.argmax()), float(size.max())
    centres, low = scan.corners.mean(axis=1), scan.vertices[:, axis].min()
    rise = centres[:, axis] - low
    # a plinth is 1% to 25% of the whole (legs of boxes end at 29%), and its top a layer of 0.5%
    top = np.flatnonzero((scan.face_normals[:, axis] > 0.98) & (rise > 0.01 * height) & (rise < 0.25 * height))
    layer, of = np.unique(np.round(rise[top] / (0.005 * height)), return_inverse=True)
    area = np.bincount(of, scan.face_areas[top], len(layer))
    if not len(layer) or area.max() < 0.015 * height**2:           # soles are 0.013, plinths of 0.4 m 0.04
        return None
    level = float(np.median(rise[top][of == area.argmax()]))
    below = np.delete(scan.vertices[scan.vertices[:, axis] <= low + level + 1e-3 * height], axis, axis=1)
    # what is seen of its top, in shares of its outline: plinths have 0.8, two shoes that are boxes 0.5
    return level if area.max() > 0.6 * ConvexHull(below).volume else None


def cut_plinth(scan: Mesh, height: float) -> tuple[Mesh, float]:
    """Leave out what lies lower than `height` above the lowest point, along the longest axis; also return its share.

    What is level with the cut is the top of the plinth. ValueError where nothing would be left.
    """
    level = scan.vertices[:, np.ptp(scan.vertices, axis=0).argmax()]
    rise = (level - level.min())[scan.faces]
    step = 0.002 * float(np.ptp(level))                            # 3 mm on a person: the top need not be quite level
    above = (rise >= height - step).all(axis=1) & (rise > height + step).any(axis=1)
    if not above.any():
        raise ValueError(f"cut: expected a height below that of the scan, {np.ptp(level):.3g}, got {height:.3g}")
    return scan.submesh(above)[0], float(scan.face_areas[~above].sum() / scan.face_areas.sum())


def _label_shells(scan: Mesh) -> np.ndarray:
    """Number the shell of every triangle (F,); vertices at one place are one."""
    key = scan.vertices.astype(np.float32) @ np.random.default_rng(0).random(3)        # one number sorts fast
    place = np.unique(key, return_inverse=True)[1].reshape(-1)
    corners = place[scan.faces]
    label = label_components(corners[:, [0, 1]].ravel(), corners[:, [1, 2]].ravel(), int(place.max(initial=-1)) + 1)
    return np.unique(label[corners[:, 0]], return_inverse=True)[1].reshape(-1)


def _sample_shells(scan: Mesh, shell: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Draw points (n, 3) evenly over every shell, on small ones more densely; with their triangles (n,)."""
    rng, area = np.random.default_rng(0), np.bincount(shell, scan.face_areas)
    count = np.maximum(SAMPLES * area / area.sum(), min(LEAST, SAMPLES / len(area)))
    chance = scan.face_areas * (count / np.maximum(area, 1e-300))[shell]
    face = rng.choice(len(shell), int(count.sum()), p=chance / chance.sum())
    r, s = np.sqrt(rng.random(len(face))), rng.random(len(face))
    return np.einsum("nc,ncd->nd", np.stack([1 - r, r * (1 - s), r * s], axis=1), scan.corners[face]), face


def _find_covered(scan: Mesh, shell: np.ndarray, points: np.ndarray, face: np.ndarray
                  ) -> tuple[np.ndarray, np.ndarray]:
    """Find the points (n,) bool on triangles (n,) that hardly see out on either side, and other shells on one.

    Also those of them whose cover is `CLEAR` of them.
    """
    rays, height = Rays(scan), float(np.ptp(scan.vertices, axis=0).max())
    out, cover, far_cover = np.zeros((3, 2, len(points)))      # rays on the back and on the front of every point
    start = 1e-4 * height * scan.face_normals[face]            # off the surface, or rays would meet their own triangle
    rest = np.arange(len(points))                              # that are not known to see out
    for direction in np.random.default_rng(0).permutation(sphere_directions(DIRECTIONS)):
        ahead = scan.face_normals[face[rest]] @ direction > 0
        met, far = rays.cast(points[rest] + np.where(ahead[:, None], start[rest], -start[rest]), direction)
        on_other = (met >= 0) & (shell[met] != shell[face[rest]])
        out[ahead.astype(int), rest] += met < 0
        cover[ahead.astype(int), rest] += on_other
        far_cover[ahead.astype(int), rest] += on_other & (far > CLEAR * height)
        rest = rest[out[:, rest].max(axis=0) < OUT * DIRECTIONS / 2]
    covered, clearly = np.zeros((2, len(points)), dtype=bool)
    covered[rest] = cover[:, rest].max(axis=0) > ON_OTHERS * DIRECTIONS / 2
    clearly[rest] = far_cover[:, rest].max(axis=0) > ON_OTHERS * DIRECTIONS / 2
    return covered, clearly
