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


def pierced(mesh: Mesh, centres, radius: float) -> Mesh:
    """A mesh without the triangles within a radius of some places (n, 3) or one."""
    apart = np.linalg.norm(mesh.corners.mean(axis=1)[:, None] - np.atleast_2d(centres), axis=2)
    return mesh.submesh((apart > radius).all(axis=1))[0]


def joined(*meshes: Mesh) -> Mesh:
    """Several meshes as one, side by side."""
    starts = np.cumsum([0] + [len(m.vertices) for m in meshes[:-1]])
    return Mesh(np.concatenate([m.vertices for m in meshes]),
                np.concatenate([m.faces + s for m, s in zip(meshes, starts, strict=True)]))


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


def globe(rings, sectors, radius):
    """A sphere of rings and sectors, and its meridian from pole to pole."""
    t, a = np.meshgrid(np.pi * np.arange(1, rings) / rings, 2 * np.pi * np.arange(sectors) / sectors, indexing="ij")
    around = np.stack([np.sin(t) * np.cos(a), np.sin(t) * np.sin(a), np.cos(t)], axis=-1).reshape(-1, 3)
    number = np.pad(1 + np.arange(len(around)).reshape(t.shape), ((1, 1), (0, 0)))
    number[-1] = len(around) + 1
    a, b = (v[:-1].ravel() for v in (number, np.roll(number, -1, axis=1)))
    c, d = (v[1:].ravel() for v in (number, np.roll(number, -1, axis=1)))
    faces = np.stack([[a, c, d], [a, d, b]]).transpose(0, 2, 1).reshape(-1, 3)
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]            # at the poles every second has no area
    return Mesh(radius * np.vstack([[0, 0, 1], around, [0, 0, -1]]), faces), number[:, 0]


def mushroom(R):
    """A sphere of radius R, metres, with a round mushroom on it: stem 24 mm, cap 36 mm wide, 20 mm high."""
    mesh, _ = globe(400, 80, 1.0)
    t = np.arccos(np.clip(mesh.vertices[:, 2], -1, 1))
    a = np.arctan2(mesh.vertices[:, 1], mesh.vertices[:, 0])
    s = t / np.pi                                            # along the profile from the top
    profile = np.array([(0, .22), (.012, .2195), (.017, .216), (.018, .213), (.017, .210), (.013, .2085), (.012, .206),
                        (.012, .202), (.014, np.sqrt(R**2 - .014**2))])
    way = np.r_[0, np.cumsum(np.linalg.norm(np.diff(profile, axis=0), axis=1))]
    way *= 0.25 / way[-1]
    r, z = (np.interp(s, way, profile[:, k]) for k in range(2))
    polar = np.arcsin(.014 / R) + (s - 0.25) / 0.75 * (np.pi - np.arcsin(.014 / R))
    below = s > 0.25
    r, z = np.where(below, R * np.sin(polar), r), np.where(below, R * np.cos(polar), z)
    return Mesh(np.stack([r * np.cos(a), r * np.sin(a), z], axis=1), mesh.faces)


BUMPY = 0.2                            # metres, mean radius


def bumpy_radius(directions):
    """Radius of a bumpy sphere in a direction (..., 3), unit."""
    x, y, z = np.moveaxis(directions, -1, 0)
    return BUMPY + 0.006 * np.sin(9 * x) * np.cos(7 * y) + 0.004 * np.sin(8 * z + 1)
