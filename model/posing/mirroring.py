"""Left for right: the mirror symmetry of a body, and mirrored poses."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from scanprep.geometry.mesh import Mesh
from scanprep.skeleton.symmetry import MirrorPlane
from scanprep.skeleton.tree import Skeleton

NEAR = 0.08                          # of the body's size: how far mirrored parts may lie from their partners
NEAR_ALONE = 0.015                   # where none are exchanged: a man is nearly flat, but not his own front to back
ROUNDS = 10


@dataclass(frozen=True, eq=False)
class Mirror(MirrorPlane):
    """The plane of a body's symmetry and which parts it exchanges.

    Attributes
    ----------
    normal, point : (3,) float, metres
        Of the plane.
    partners : (J,) int
        The part on the other side; a part in the middle is its own.
    distance : float, metres
        Root mean square distance of mirrored joints and centroids of parts from those of their partners.
    """

    partners: np.ndarray
    distance: float

    def trans(self, skeleton: Skeleton, trans: np.ndarray) -> np.ndarray:
        """The places (..., 3) of mirrored bodies, metres."""
        return self.reflect(skeleton.joints[0] + trans) - skeleton.joints[0]


def mirror_pose(mirror: Mirror, pose: np.ndarray) -> np.ndarray:
    """Mirrored poses: every part does what its partner did, seen in the mirror.

    The rotation becomes `M R M`, its axis-angle vector `-M pose`; twice is the identity.

    Parameters
    ----------
    mirror : Mirror
        Of `find_mirror`.
    pose : (..., J, 3) float, radians

    Returns
    -------
    (..., J, 3) float, radians
    """
    pose = np.asarray(pose, dtype=np.float64)
    if pose.shape[-2:] != (len(mirror.partners), 3):
        raise ValueError(f"pose: expected shape (..., {len(mirror.partners)}, 3), got {pose.shape}")
    return -pose[..., mirror.partners, :] @ mirror.matrix


def find_mirror(template: Mesh, skeleton: Skeleton) -> Mirror:
    """The plane in which a template and its skeleton are most nearly their own mirror image.

    Planes halfway between two parts are tried; under each, parts are paired from the root down so that partners
    have partners for parents, and the plane is then fitted to the pairs. Only a body
    without any pair is mirrored with every part staying its own partner.

    Raises
    ------
    ValueError
        The skeleton is not symmetric: no pairing, or none whose parts lie near each other.
    """
    marks = _marks(template, skeleton)
    size = float(np.linalg.norm(np.ptp(template.vertices, axis=0)))
    tried = [_fitted(skeleton, marks, plane) for plane in _candidates(template, skeleton, marks)]
    found = [mirror for mirror in tried if mirror is not None]
    if not found:
        raise ValueError("skeleton: it is not symmetric, no mirror image of its tree is the tree itself")
    each = np.arange(len(skeleton.parents))
    exchanging = [m for m in found if (m.partners != each).any()]
    best = min(exchanging or found, key=lambda m: m.distance)
    if best.distance > (NEAR if exchanging else NEAR_ALONE) * size:
        image = np.linalg.norm(best.reflect(marks) - marks[:, best.partners], axis=-1).max(axis=0)
        worst = int(image.argmax())
        how = "in the best mirror" if exchanging else "no two parts can be exchanged, and in the best mirror"
        raise ValueError(f"skeleton: it is not symmetric; {how}, part '{skeleton.names[worst]}' comes to lie "
                         f"{image[worst]:.3g} m from part '{skeleton.names[best.partners[worst]]}'")
    return best


def _marks(template: Mesh, skeleton: Skeleton) -> np.ndarray:
    """(2, J, 3) what is mirrored: joints and centroids of the parts, metres."""
    J, part = len(skeleton.parents), skeleton.part_of_face
    area = np.bincount(part, template.face_areas, J)
    middle = template.corners.mean(axis=1) * template.face_areas[:, None]
    centroids = np.stack([np.bincount(part, middle[:, i], J) for i in range(3)], axis=1) / area[:, None]
    return np.stack([skeleton.joints, centroids])


def _candidates(template: Mesh, skeleton: Skeleton, marks: np.ndarray) -> list[MirrorPlane]:
    """Planes to start from: halfway between two parts alike, and through the body's main axes."""
    kind, middle = _kinds(skeleton), marks[1]
    planes = []
    for a in range(len(kind)):
        for b in range(a + 1, len(kind)):
            apart = middle[a] - middle[b]
            if kind[a] == kind[b] and np.linalg.norm(apart) > 0:
                planes.append(MirrorPlane(apart / np.linalg.norm(apart), (middle[a] + middle[b]) / 2))
    centre = template.vertices.mean(axis=0)
    axes = np.linalg.eigh(np.cov(template.vertices.T))[1]
    return planes + [MirrorPlane(axis, centre) for axis in axes.T]


def _kinds(skeleton: Skeleton) -> list[tuple[int, str]]:
    """The depth of every part and the shape of the tree below it: only parts of one kind can be partners."""
    J = len(skeleton.parents)
    below: list[list[str]] = [[] for _ in range(J)]
    depth = [0] * J
    for j in range(1, J):
        depth[j] = depth[skeleton.parents[j]] + 1
    shape = [""] * J
    for j in range(J - 1, -1, -1):
        shape[j] = "(" + "".join(sorted(below[j])) + ")"
        if j:
            below[skeleton.parents[j]].append(shape[j])
    return list(zip(depth, shape, strict=True))


def _fitted(skeleton: Skeleton, marks: np.ndarray, plane: MirrorPlane) -> Mirror | None:
    """The mirror near a plane, parts paired and plane fitted in turn; None where parts cannot be paired."""
    partners = np.full(len(skeleton.parents), -1)
    for _ in range(ROUNDS):
        before = partners
        paired = _paired(skeleton, plane.reflect(marks), marks)
        if paired is None:
            return None
        partners = paired
        if (partners == before).all():
            break
        plane = MirrorPlane.between(marks.reshape(-1, 3), marks[:, partners].reshape(-1, 3))
    off = plane.reflect(marks) - marks[:, partners]
    return Mirror(plane.normal, plane.point, partners, float(np.sqrt((off**2).sum(axis=-1).mean())))


def _paired(skeleton: Skeleton, image: np.ndarray, marks: np.ndarray) -> np.ndarray | None:
    """The partner of every part, children of partners paired where they come nearest; None if it is no exchange."""
    kind, J = _kinds(skeleton), len(skeleton.parents)
    children = [np.flatnonzero(skeleton.parents == p) for p in range(J)]
    partners = np.zeros(J, dtype=np.int64)
    for p in range(J):                                                        # parents come before their children
        mine, others = children[p], children[partners[p]]
        if len(mine) != len(others):
            return None
        cost = ((image[:, mine, None] - marks[:, None, others]) ** 2).sum(axis=(0, -1))
        alike = np.array([[kind[a][1] == kind[b][1] for b in others] for a in mine], dtype=bool).reshape(cost.shape)
        row, column = linear_sum_assignment(np.where(alike, cost, 1e6))
        if not alike[row, column].all():
            return None
        partners[mine[row]] = others[column]
    return partners if (partners[partners] == np.arange(J)).all() else None
