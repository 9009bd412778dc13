"""Left-right symmetry: mirror partners of markers and of places on the skin."""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from scanprep.geometry.mesh import Mesh
from scanprep.geometry.sides import other_side, side_of
from scanprep.geometry.surface import Surface
from scanprep.skeleton.symmetry import MirrorPlane, find_symmetry

from .layout import MarkerLayout


@dataclass(frozen=True, eq=False)
class SkinMirror:
    """The mirror image of every vertex, as a point of the skin.

    Attributes
    ----------
    faces : (N,) int
        Triangle of the image.
    bary : (N, 3) float
        Barycentric coordinates of the image.
    partner : (N,) int
        Vertex nearest to the image. In an irregular triangulation the partner's partner is the vertex itself for most
        vertices, but not all.
    across : (N,) float, metres
        Distance of each vertex from its image, 0 in the middle, negative on one side. With landmarks it is positive on
        the left; without them the side is unknown.
    returns : float, metres
        Mean distance of a vertex from its place after two reflections.
    """

    faces: np.ndarray
    bary: np.ndarray
    partner: np.ndarray
    across: np.ndarray
    returns: float

    def image(self, mesh: Mesh) -> np.ndarray:
        """Compute the mirror images (N, 3) of all vertices, metres, on a body with these triangles in any pose."""
        return np.einsum("nc,ncd->nd", self.bary, mesh.vertices[mesh.faces[self.faces]])


def label_pairs(labels: Sequence[str]) -> np.ndarray:
    """Return the index (L,) of each label's partner: its own for a label without side, -1 for a missing partner."""
    rows = {label: i for i, label in enumerate(labels)}
    others = [other_side(label) for label in labels]
    return np.array([i if other is None else rows.get(other, -1) for i, other in enumerate(others)], dtype=np.int64)


def marker_pairs(layout: MarkerLayout, template: Mesh, mirror: SkinMirror | None = None) -> np.ndarray:
    """Return the marker (L,) on the other side of every marker, by label, or by place where labels have no side.

    It is the marker itself in the middle, and -1 without a partner; the partner's partner is the marker.
    """
    pairs, untold = label_pairs(layout.labels), np.flatnonzero([other_side(label) is None for label in layout.labels])
    pairs[untold] = -1
    if len(untold) == 0:
        return pairs
    mirror = mirror or find_skin_mirror(template)
    skin = layout.skin_points(template.vertices)[untold]
    image = mirror_points(layout, template, mirror)[untold]
    apart = np.linalg.norm(image[:, None] - skin[None], axis=-1)
    apart = apart + apart.T                                                    # there and back
    for i, row in enumerate(untold):
        j = int(apart[i].argmin())
        if int(apart[j].argmin()) == i and apart[i, j] < 0.12:         # metres, there and back
            pairs[row] = untold[j]
    return pairs


def mirror_points(layout: MarkerLayout, mesh: Mesh, mirror: SkinMirror) -> np.ndarray:
    """Compute the mirror images (L, 3), metres, of the markers on the skin."""
    return layout.skin_points(mirror.image(mesh))


def find_skin_mirror(template: Mesh, poses: np.ndarray | None = None, landmarks: Mapping[str, int] | None = None
                     ) -> SkinMirror:
    """Find the mirror image of every vertex, for any triangulation.

    The reflected template is registered to the template, without using vertex numbers.

    Parameters
    ----------
    template : Mesh
        In a nearly symmetric pose, or with landmarks.
    poses : (M, N, 3) float, metres, optional
        The most symmetric one is used if the template is not in a symmetric pose.
    landmarks : {name: vertex}, optional
        With names that have sides, such as "left elbow" or "LELB". They align the mirror image, in any pose.

    Raises
    ------
    ValueError
        Not symmetric; landmarks without three pairs of sides.
    """
    if landmarks is not None:
        body, (image, normal) = template, _by_landmarks(template, landmarks)
    else:
        symmetry = find_symmetry(template, poses)
        if not symmetry.holds:
            raise ValueError("template: expected one that stands symmetrically, its mirror image is "
                             f"{symmetry.distance:.1%} of its size away; give landmarks whose names tell the sides")
        body, image, normal = template, symmetry.image, symmetry.normal
        if symmetry.pose >= 0 and poses is not None:
            body = template.with_vertices(poses[symmetry.pose])
    # the nearest points to the image, and where a second reflection leads
    found = Surface(body).closest(image)
    again = np.einsum("nc,ncd->nd", found.bary, found.points[body.faces[found.faces]])
    partner = cKDTree(body.vertices).query(found.points)[1]
    return SkinMirror(found.faces, found.bary, partner, (body.vertices - found.points) @ normal,
                      float(np.average(np.linalg.norm(again - body.vertices, axis=1), weights=body.vertex_areas)))


def _by_landmarks(template: Mesh, landmarks: Mapping[str, int]) -> tuple[np.ndarray, np.ndarray]:
    """Register the mirror image by landmarks; return images (N, 3) and the plane's normal, to the left."""
    from scanprep.registration.nonrigid import register

    pairs = [(v, landmarks[other]) for name, v in landmarks.items()
             if side_of(name) == 1 and (other := other_side(name)) is not None and other in landmarks]
    if len(pairs) < 3:
        raise ValueError(f"landmarks: expected at least 3 pairs of left and right, found {len(pairs)} among "
                         f"{', '.join(landmarks) or 'none'}")
    # the plane between landmarks and their partners, then non-rigid registration
    middle = [v for name, v in landmarks.items() if side_of(name) == 0]
    left, right = np.array(pairs).T
    x, y = template.vertices[np.r_[left, right, middle]], template.vertices[np.r_[right, left, middle]]
    plane = MirrorPlane.between(x, y)
    normal = plane.normal * np.sign(((template.vertices[left] - template.vertices[right]) @ plane.normal).sum())
    start = plane.reflect(template.vertices)
    marks = np.r_[left, right, middle].astype(np.int64), y
    return register(Mesh(start, template.faces[:, ::-1]), template, marks).mesh.vertices, normal
