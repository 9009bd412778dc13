"""Smooth shapes with known surfaces and a bare scanner for the tests of cleaning."""
import numpy as np

from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Rays
from scanprep.pictures.shading import sphere


def ball(divisions: int = 4, radius: float = 0.1) -> Mesh:
    """A closed sphere with vertices on the exact surface."""
    from scanprep.repair.manifold import weld

    vertices, faces = sphere(divisions)
    return weld(Mesh(radius * vertices, faces), 1e-9)


def bumpy(divisions: int = 5) -> Mesh:
    """A closed surface without symmetry, about 20 cm across."""
    mesh = ball(divisions, 1.0)
    x, y, z = mesh.vertices.T
    radius = 0.1 * (1 + 0.15 * np.sin(3 * x + 1) * np.cos(2 * y) + 0.12 * np.sin(4 * z + x) + 0.1 * y * z)
    return mesh.with_vertices(mesh.vertices * radius[:, None] * np.array([1, 0.8, 1.3]))


def view(mesh: Mesh, towards: np.ndarray, rng=None, noise: float = 0.0, spacing: float = 0.003):
    """What a camera a metre away in a direction sees: a mesh of its own and the camera's position."""
    back = np.asarray(towards, dtype=float) / np.linalg.norm(towards)
    right = np.cross(back, np.eye(3)[np.abs(back).argmin()])
    right /= np.linalg.norm(right)
    count = int(0.5 / spacing)
    step = (np.arange(count) - count / 2) * spacing
    y, x = np.meshgrid(step, step, indexing="ij")
    rays = x[..., None] * right + y[..., None] * np.cross(back, right) - back
    rays = (rays / np.linalg.norm(rays, axis=2, keepdims=True)).reshape(-1, 3)
    face, depth = Rays(mesh).cast(np.repeat(back[None], len(rays), axis=0), rays)
    slant = -np.einsum("nd,nd->n", mesh.face_normals[face], rays)
    depth = np.where((face >= 0) & (slant > 0.15), depth, np.nan)
    if noise:
        depth = depth + noise * rng.normal(size=len(depth))
    points = back + depth[:, None] * rays
    number = np.arange(count * count).reshape(count, count)
    a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]
    faces = np.concatenate([np.stack(t, axis=-1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))])
    faces = faces[np.isfinite(depth[faces]).all(axis=1)]
    faces = faces[np.ptp(depth[faces], axis=1) < 0.02]
    seen, corners = np.unique(faces, return_inverse=True)
    return Mesh(points[seen], corners.reshape(-1, 3)), back


def triangle_quality(mesh: Mesh) -> np.ndarray:
    """(F,) 1 for an equilateral triangle, 0 for one without area: 4√3 area over the sum of squared sides."""
    squares = ((mesh.corners - np.roll(mesh.corners, -1, axis=1)) ** 2).sum(axis=(1, 2))
    return np.divide(4 * 3 ** 0.5 * mesh.face_areas, squares, out=np.zeros(len(squares)), where=squares > 0)


SIX = np.concatenate([np.eye(3), -np.eye(3)])


def distortion(rest: Mesh, x: np.ndarray) -> float:
    """Root mean square over the area at rest of the logarithm of the stretches of the triangles."""
    def flat(c: np.ndarray) -> np.ndarray:
        e, f = c[:, 1] - c[:, 0], c[:, 2] - c[:, 0]
        length = np.maximum(np.linalg.norm(e, axis=1), 1e-12)
        along = np.einsum("fd,fd->f", e, f) / length
        height = np.linalg.norm(np.cross(e, f), axis=1) / length
        return np.stack([np.stack([length, along], axis=1), np.stack([np.zeros_like(length), height], axis=1)], axis=1)

    s = np.linalg.svd(flat(x[rest.faces]) @ np.linalg.inv(flat(rest.corners)), compute_uv=False)
    stretch = (np.log(np.maximum(s, 1e-6)) ** 2).mean(axis=1)
    return float(np.sqrt(np.average(stretch, weights=rest.face_areas)))
