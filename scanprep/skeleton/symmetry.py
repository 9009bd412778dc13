"""Find the left-right symmetry of a body from its surface alone: the mirror image of every triangle."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csc_array, diags_array
from scipy.spatial import cKDTree

from ..geometry.mesh import Mesh
from ..geometry.sparse import factor
from ..geometry.surface import OrientedPoints, Surface
from .labels import keep_connected

NORMAL_WEIGHT = 0.05                 # distance that equals a unit difference of normals, in sizes


@dataclass(frozen=True, eq=False)
class MirrorPlane:
    """A mirror plane."""

    normal: np.ndarray  # (3,) float, unit
    point: np.ndarray  # (3,) float, metres: on the plane

    @staticmethod
    def between(x: np.ndarray, y: np.ndarray) -> MirrorPlane:
        """Fit the plane that mirrors points x (n, 3) onto y (n, 3), by least squares."""
        # the normal is the eigenvector of the smallest eigenvalue of the symmetric cross-covariance
        cross = (x - x.mean(axis=0)).T @ (y - y.mean(axis=0))
        return MirrorPlane(np.linalg.eigh(cross + cross.T)[1][:, 0], (x.mean(axis=0) + y.mean(axis=0)) / 2)

    @property
    def matrix(self) -> np.ndarray:
        """The reflection M (3, 3) of directions."""
        return np.eye(3) - 2 * np.outer(self.normal, self.normal)

    def reflect(self, points: np.ndarray) -> np.ndarray:
        """Mirror points (..., 3), metres."""
        return points - 2 * ((points - self.point) @ self.normal)[..., None] * self.normal


@dataclass(frozen=True, eq=False)
class Symmetry(MirrorPlane):
    """The plane of symmetry, in the coordinates of the body it was found in, and the mirror image of every triangle."""

    # (F,) int: the triangle at the mirror image of each triangle; its partner is usually, but not always, the triangle
    # itself, as triangulations are not symmetric
    partner: np.ndarray
    left: np.ndarray  # (F,) bool: on the side the normal points to
    distance: float  # of the mirror image from the body, RMS, as a share of the body's size
    returns: float  # share of the surface whose partner's partner is near by
    image: np.ndarray  # (N, 3) float, metres: the mirror image of every vertex, bent onto the body in that pose
    pose: int = -1  # the pose it was found in, -1 for the template

    @property
    def holds(self) -> bool:
        """Whether the body is symmetric: within 3% of its size, and 80% of it returns when mirrored twice."""
        return self.distance <= 0.03 and self.returns >= 0.8

    @property
    def two_sided(self) -> bool:
        """Whether there are triangles on either side."""
        return bool(self.left.any()) and not bool(self.left.all())


def mirror_poses(template: Mesh, poses: np.ndarray, symmetry: Symmetry) -> np.ndarray:
    """Mirror poses (M, N, 3), metres: exchange left and right, as a body can do on both sides what it does on one."""
    body = template if symmetry.pose < 0 else template.with_vertices(poses[symmetry.pose])
    image = Surface(body).closest(symmetry.image)
    return symmetry.reflect(np.stack([image.transfer(pose, template.faces) for pose in poses]))


def find_symmetry(template: Mesh, poses: np.ndarray | None = None) -> Symmetry:
    """Find the best mirror symmetry of a body.

    It is searched at rest. If the body is not symmetric there, the most symmetric pose is used. Planes in all
    directions through the centre are tried, and the best ones are refined by nearest points. A smooth warp of the
    mirror image onto the body then tolerates a stance that is not quite symmetric. Vertex numbering is not used.
    `holds` says whether the body is symmetric at all.
    """
    sample = _spread(template, 800)
    at_rest = _match(template, _best_plane(template, sample)[1], -1)
    if at_rest.holds or poses is None:
        return at_rest
    # 24 poses at most, spread over all, are enough to find a symmetric one
    chosen = np.unique(np.linspace(0, len(poses) - 1, min(len(poses), 24)).astype(int))
    planes = [_best_plane(template.with_vertices(poses[m]), sample) for m in chosen]
    best = int(np.argmin([distance for distance, _ in planes]))
    posed = _match(template.with_vertices(poses[chosen[best]]), planes[best][1], int(chosen[best]))
    return posed if posed.holds or posed.distance < at_rest.distance else at_rest


def _spread(template: Mesh, count: int) -> np.ndarray:
    """Choose about `count` vertices spread evenly over the surface."""
    points = template.sample(count, np.random.default_rng(0))[0]
    return np.unique(cKDTree(template.vertices).query(points)[1])


def _best_plane(body: Mesh, sample: np.ndarray) -> tuple[float, MirrorPlane]:
    """Find the best mirror plane; return the distance of the mirror image, as a share of the size, and the plane."""
    size = _size(body)
    x, normals = body.vertices[sample], body.vertex_normals[sample]
    target = OrientedPoints(x, normals, NORMAL_WEIGHT * size)
    centre = np.average(body.corners.mean(axis=1), axis=0, weights=body.face_areas)
    axes = np.linalg.eigh(np.cov(x.T))[1].T
    axes[(((x - centre) @ axes.T)**3).sum(axis=0) < 0] *= -1            # signs that do not depend on orientation

    def fitted(plane: MirrorPlane, rounds: int) -> tuple[float, MirrorPlane]:
        before = np.zeros(0)
        for _ in range(rounds):
            nearest = target.match(plane.reflect(x), _mirror(normals, plane), min_cosine=-1.0).index
            if np.array_equal(nearest, before):
                break
            before, plane = nearest, MirrorPlane.between(x, x[nearest])
        image = _mirror(normals, plane)
        match = target.match(plane.reflect(x), image, min_cosine=-1.0)
        off = target.scale**2 * ((target.normals[match.index] - image)**2).sum(axis=1)
        return float(np.sqrt((match.distances**2 + off).mean())) / size, plane

    k = np.arange(60)                                            # directions spread evenly over half the sphere
    z, angle = (k + 0.5) / len(k), k * np.pi * (3 - np.sqrt(5))
    r = np.sqrt(1 - z**2)
    # score 60 directions and the principal axes, then refine the five best like ICP
    around = np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1)
    rough = [fitted(MirrorPlane(normal, centre), 0) for normal in np.vstack([axes, around @ axes])]
    rough.sort(key=lambda found: found[0])
    return min((fitted(plane, 60) for _, plane in rough[:5]), key=lambda found: found[0])


def _size(body: Mesh) -> float:
    """Return twice the distance of the farthest vertex from the centroid, metres."""
    return 2 * float(np.linalg.norm(body.vertices - body.vertices.mean(axis=0), axis=1).max())


def _mirror(normals: np.ndarray, plane: MirrorPlane) -> np.ndarray:
    """Mirror directions (n, 3)."""
    return MirrorPlane(plane.normal, np.zeros(3)).reflect(normals)


def _match(body: Mesh, plane: MirrorPlane, pose: int) -> Symmetry:
    """Warp the mirror image of a body onto it and pair the triangles."""
    size = _size(body)
    target = OrientedPoints(body.vertices, body.vertex_normals, NORMAL_WEIGHT * size)
    start = plane.reflect(body.vertices)
    graph = body.vertex_adjacency
    laplacian = diags_array(np.asarray(graph.sum(axis=1)).ravel()) - graph
    image, inside_out = start, body.faces[:, ::-1]
    # Laplacian-regularised warp from stiff to soft; matches beyond 3% of the size count less
    for stiffness in (300.0, 100.0, 30.0, 10.0, 3.0):
        normals = Mesh(image, inside_out).vertex_normals
        match = target.match(image, normals)
        weight = match.valid / (1 + (match.distances / (0.03 * size))**2)
        weight[~match.valid] = 0
        solve = factor(csc_array(diags_array(weight + 1e-6) + stiffness * laplacian))
        image = start + solve(weight[:, None] * (body.vertices[match.index] - start))
    return _pair(body, start, image, plane, pose)


def _pair(body: Mesh, start: np.ndarray, image: np.ndarray, plane: MirrorPlane, pose: int) -> Symmetry:
    """Pair triangles by the warped mirror image (N, 3) of the body; `start` (N, 3) is the image before the warp."""
    size, normal = _size(body), plane.normal
    centres, areas, normals = body.corners.mean(axis=1), body.face_areas, body.face_normals
    image_centres, image_normals = image[body.faces].mean(axis=1), Mesh(image, body.faces[:, ::-1]).face_normals

    def nearest(among: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        target = OrientedPoints(centres[among], normals[among], NORMAL_WEIGHT * size)
        match = target.match(image_centres[faces], image_normals[faces], min_cosine=-1.0)
        return among[match.index], match.distances

    everything = np.arange(len(areas))
    partner, apart = nearest(everything, everything)
    across = (centres - centres[partner]) @ normal
    if areas[across > 0].sum() < areas[across < 0].sum():        # so that the result does not depend on orientation
        normal, across = -normal, -across
    # two connected sides; each triangle of one side is paired with one of the other
    left = keep_connected(np.zeros((len(areas), 2)), body.face_pairs, areas, (across > 0).astype(np.int64)) == 1
    sides = np.flatnonzero(left), np.flatnonzero(~left)
    for here, there in (sides, sides[::-1]):                     # a partner lies on the other side
        if len(here) and len(there):
            partner[here] = nearest(there, here)[0]
    # quality: how much returns within 2% of the size, and how far the image was from the body
    back = np.linalg.norm(centres[partner[partner]] - centres, axis=1) < 0.02 * size
    moved = np.average(((start - image)**2).sum(axis=1), weights=body.vertex_areas)
    distance = np.sqrt(moved + np.average(apart**2, weights=areas)) / size
    return Symmetry(normal, plane.point, partner, left, float(distance), float(areas[back].sum() / areas.sum()), image,
                    pose)
