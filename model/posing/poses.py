"""Poses by hand: from joint angles, by rotating a joint, and mirrored."""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import Any, Literal

import numpy as np
from scipy.optimize import linear_sum_assignment

from scanprep.geometry import rotations
from scanprep.geometry.mesh import Mesh
from scanprep.skeleton.symmetry import MirrorPlane
from scanprep.skeleton.tree import Skeleton

Frame = Literal["parent", "world", "own"]


def pose_from_angles(skeleton: Skeleton, angles: Mapping[str | int, Any]) -> np.ndarray:
    """Build a pose in which some parts are rotated relative to their parents and all others are at rest.

    Parameters
    ----------
    skeleton : Skeleton
        The model's skeleton.
    angles : dict of str or int to rotation
        Parts by name or number. A rotation is an axis-angle vector (3,) in radians, or an axis and degrees:
        `("x", 30)`, `((0, 1, 1), -45)`. Axes are those of the template.

    Returns
    -------
    (J, 3) float, radians
        The pose.

    Raises
    ------
    ValueError
        A part that is unknown or given twice, or a rotation of another form.

    Examples
    --------
    >>> from model import load_built_in_model
    >>> skeleton = load_built_in_model().skeleton
    >>> pose = pose_from_angles(skeleton, {"forearm_left": ("x", 90)})
    >>> bool(np.isclose(np.linalg.norm(pose), np.pi / 2))
    True
    """
    pose = np.zeros((len(skeleton.parents), 3))
    seen: set[int] = set()
    for part, angle in angles.items():
        j = part_number(skeleton, part)
        if j in seen:
            raise ValueError(f"angles: part '{skeleton.names[j]}' is given twice")
        seen.add(j)
        pose[j] = rotation_vector(angle, f"angles['{part}']")
    return pose


def rotate_joint(skeleton: Skeleton, pose: np.ndarray, part: str | int, rotation: Any, frame: Frame = "parent"
                 ) -> np.ndarray:
    """Rotate one part, and what hangs below it, further from its present rotation.

    Parameters
    ----------
    skeleton : Skeleton
        The model's skeleton.
    pose : (..., J, 3) float, radians
        The present pose.
    part : str or int
        Name or number of the part.
    rotation
        As in `pose_from_angles`: axis-angle vector, or axis and degrees.
    frame : str
        Whose axes these are: of the part's "parent" (of the world for the root), of the "world", or of the part's
        "own" present frame.

    Returns
    -------
    (..., J, 3) float, radians

    Raises
    ------
    ValueError
        A part or frame that is not known, a rotation that is neither.
    """
    pose = np.array(pose, dtype=np.float64)
    j = part_number(skeleton, part)
    if pose.shape[-2:] != (len(skeleton.parents), 3):
        raise ValueError(f"pose: expected shape (..., {len(skeleton.parents)}, 3), got {pose.shape}")
    more, now = rotations.exp(rotation_vector(rotation, "rotation")), rotations.exp(pose[..., j, :])
    if frame == "own":
        turned = now @ more
    elif frame == "parent" or (frame == "world" and j == 0):
        turned = more @ now
    elif frame == "world":
        above = skeleton.part_rotations(pose)[..., skeleton.parents[j], :, :]
        turned = np.swapaxes(above, -1, -2) @ more @ above @ now
    else:
        raise ValueError(f"frame: expected 'parent', 'world' or 'own', got {frame!r}")
    pose[..., j, :] = rotations.log(turned)
    return pose


def part_number(skeleton: Skeleton, part: str | int) -> int:
    """Find the number of a part given by name or number; else ValueError."""
    if isinstance(part, str):
        if part not in skeleton.names:
            raise ValueError(f"part: no '{part}'; the skeleton has {', '.join(skeleton.names)}")
        return skeleton.names.index(part)
    if not 0 <= part < len(skeleton.parents):
        raise ValueError(f"part: expected 0..{len(skeleton.parents) - 1}, got {part}")
    return int(part)


def rotation_vector(given: Any, name: str) -> np.ndarray:
    """Convert a vector, or an axis with degrees, to an axis-angle vector (3,), radians."""
    axes = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
    if isinstance(given, tuple | list) and len(given) == 2:
        axis, degrees = given
        if isinstance(axis, str) and axis not in axes:
            raise ValueError(f"{name}: expected an axis x, y or z, got '{axis}'")
        along = _finite(axes[axis] if isinstance(axis, str) else axis, name)
        length = float(np.linalg.norm(along))
        if not length:
            raise ValueError(f"{name}: the axis has no direction")
        return np.radians(float(degrees)) * along / length
    return _finite(given, name)


def _finite(given: Any, name: str) -> np.ndarray:
    try:
        vector = np.array(given, dtype=np.float64)
    except (TypeError, ValueError):
        vector = np.zeros(0)
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise ValueError(f"{name}: expected an axis-angle vector of 3 numbers, or an axis and degrees, got {given!r}")
    return vector


@dataclass(frozen=True, eq=False)
class Mirror(MirrorPlane):
    """The symmetry plane of a body and the parts that it exchanges."""

    partners: np.ndarray             # (J,) the part on the other side; a part in the middle is its own
    distance: float                  # metres, RMS of mirrored joints and centroids from those of the partners

    def trans(self, skeleton: Skeleton, trans: np.ndarray) -> np.ndarray:
        """Compute the places (..., 3) of mirrored bodies, metres."""
        return self.reflect(skeleton.joints[0] + trans) - skeleton.joints[0]


def mirror_pose(mirror: Mirror, pose: np.ndarray) -> np.ndarray:
    """Mirror poses: every part moves as its partner on the other side did.

    A rotation R becomes `M R M`, and its axis-angle vector `-M pose`. Mirroring twice is the identity.

    Parameters
    ----------
    mirror : Mirror
        Symmetry of the body, see `find_mirror`.
    pose : (..., J, 3) float, radians
        Poses.

    Returns
    -------
    (..., J, 3) float, radians
        The mirrored poses.

    Raises
    ------
    ValueError
        A pose of another shape.

    Examples
    --------
    >>> from model import load_built_in_model
    >>> from model.posing.poses import find_mirror
    >>> model = load_built_in_model()
    >>> mirror = find_mirror(model.template, model.skeleton)
    >>> pose = pose_from_angles(model.skeleton, {"forearm_left": ("x", 60)})
    >>> part = int(np.abs(mirror_pose(mirror, pose)).sum(axis=1).argmax())
    >>> model.skeleton.names[part]
    'forearm_right'
    """
    pose = np.asarray(pose, dtype=np.float64)
    if pose.shape[-2:] != (len(mirror.partners), 3):
        raise ValueError(f"pose: expected shape (..., {len(mirror.partners)}, 3), got {pose.shape}")
    return -pose[..., mirror.partners, :] @ mirror.matrix


def find_mirror(template: Mesh, skeleton: Skeleton) -> Mirror:
    """Find the plane in which a template and its skeleton are most nearly symmetric.

    Planes halfway between two parts are tried, and those through the body's principal axes. For each plane, parts are
    paired with the nearest mirrored ones, and the plane is fitted to the pairs. Every part is its own partner only in a
    body without any pair.

    Raises
    ------
    ValueError
        The skeleton is not symmetric: no pairing, or none whose parts lie near each other.
    """
    marks = _marks(template, skeleton)
    size = float(np.linalg.norm(np.ptp(template.vertices, axis=0)))
    tried = (_fit_mirror(skeleton, marks, plane) for plane in _candidates(template, marks))
    mirrors = [mirror for mirror in tried if mirror is not None]
    if not mirrors:
        raise ValueError("skeleton: it is not symmetric, no mirror image of its tree is the tree itself")
    each = np.arange(len(skeleton.parents))
    exchanging = [m for m in mirrors if (m.partners != each).any()]
    best = min(exchanging or mirrors, key=lambda m: m.distance)
    # without exchanged parts the limit is stricter: a man is nearly flat, but front and back are not symmetric
    if best.distance > (0.08 if exchanging else 0.015) * size:
        image = np.linalg.norm(best.reflect(marks) - marks[:, best.partners], axis=-1).max(axis=0)
        worst = int(image.argmax())
        how = "in the best mirror" if exchanging else "no two parts can be exchanged, and in the best mirror"
        raise ValueError(f"skeleton: it is not symmetric; {how}, part '{skeleton.names[worst]}' comes to lie "
                         f"{image[worst]:.3g} m from part '{skeleton.names[best.partners[worst]]}'")
    return best


def _marks(template: Mesh, skeleton: Skeleton) -> np.ndarray:
    """Collect the points that are mirrored, (2, J, 3): joints and centroids of the parts, metres."""
    J, part = len(skeleton.parents), skeleton.part_of_face
    area = np.bincount(part, template.face_areas, J)
    middle = template.corners.mean(axis=1) * template.face_areas[:, None]
    centroids = np.stack([np.bincount(part, middle[:, i], J) for i in range(3)], axis=1) / area[:, None]
    return np.stack([skeleton.joints, centroids])


def _candidates(template: Mesh, marks: np.ndarray) -> list[MirrorPlane]:
    """List planes to start from: halfway between two parts, and through the body's principal axes."""
    middle = marks[1]
    planes = [MirrorPlane(apart / np.linalg.norm(apart), (one + other) / 2)
              for one, other in combinations(middle, 2) if np.linalg.norm(apart := one - other) > 0]
    centre, axes = template.vertices.mean(axis=0), np.linalg.eigh(np.cov(template.vertices.T))[1]
    return planes + [MirrorPlane(axis, centre) for axis in axes.T]


def _fit_mirror(skeleton: Skeleton, marks: np.ndarray, plane: MirrorPlane) -> Mirror | None:
    """Fit a mirror near a plane by pairing parts and fitting the plane in turn; None where parts cannot be paired."""
    partners = np.full(len(skeleton.parents), -1)
    for _ in range(10):
        before = partners
        paired = _pair_parts(skeleton, plane.reflect(marks), marks)
        if paired is None:
            return None
        partners = paired
        if (partners == before).all():
            break
        plane = MirrorPlane.between(marks.reshape(-1, 3), marks[:, partners].reshape(-1, 3))
    off = plane.reflect(marks) - marks[:, partners]
    return Mirror(plane.normal, plane.point, partners, float(np.sqrt((off**2).sum(axis=-1).mean())))


def _pair_parts(skeleton: Skeleton, image: np.ndarray, marks: np.ndarray) -> np.ndarray | None:
    """Pair every part with the nearest mirrored one; None where that does not respect the tree."""
    cost = ((image[:, :, None] - marks[:, None]) ** 2).sum(axis=(0, -1))
    partners, parents = linear_sum_assignment(cost)[1], skeleton.parents
    whole = (partners[partners] == np.arange(len(partners))).all() and partners[0] == 0
    return partners if whole and (parents[partners[1:]] == partners[parents[1:]]).all() else None
