"""People of known bodies in clothes, with long hair or bags, and scans of them.

    mesh = dress(body, skeleton, "skirt", rng)                        # outer surfaces of body and clothes side by side
    cloud = scan_dressed(mesh, rng, ahead=facing(body, skeleton))     # what 36 cameras see of it

Clothes are of three sorts. What follows the skin is the body's own surface, moved out along smoothed normals. What
hangs is a loft of rings around the trunk and both legs: each ring is the convex outline of a section, at least as wide
as the ring above it and the slope of the cloth allow. Bags, straps and scarves are boxes and tubes. All sizes are drawn
from `rng`. Half of the clothes that follow the skin thin out over 2 to 4 cm towards a hem, the others end in a step.

The meshes run into each other; what is visible is decided by scanning.
"""
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.sparse import csr_array, diags_array
from scipy.sparse import vstack as stack_rows

from scanprep.geometry.files import PointCloud
from scanprep.geometry.mesh import Mesh
from scanprep.skeleton.tree import Skeleton

ANGLES = np.linspace(0, 2 * np.pi, 96, endpoint=False)      # of rings: 0 is the left side, 3/2 pi is ahead
STEP = 0.012                         # metres between rings: the edges of the body's triangles are as long
TRUNK, LEGS = ("pelvis", "abdomen", "chest"), ("thigh", "shin")
UNDER = -0.005                       # metres: where a tube begins under what covers the shoulders, inside the skin
GRAZING = 0.2                        # cosine between ray and normal, below which scanners measure nothing


@dataclass(frozen=True, eq=False)
class Figure:
    """A naked body in its own frame: x to its left, -y ahead, z up, soles at 0, pelvis at x = y = 0."""

    mesh: Mesh                                     # each triangle of the body in four
    kind: np.ndarray                               # (N,) name of each vertex's part, without the side
    side: np.ndarray                               # (N,) 1 left, -1 right, 0 in the middle
    joints: dict[str, np.ndarray]                  # (3,) of each part, metres

    @cached_property
    def average(self) -> csr_array:
        """(N, N) sparse: half of a vertex, half the mean of its neighbours."""
        neighbours = csr_array(self.mesh.vertex_adjacency).astype(float)
        return csr_array(0.5 * (diags_array(np.ones(len(self.kind)))
                                + diags_array(1 / neighbours.sum(axis=1)) @ neighbours))

    def on(self, *kinds: str) -> np.ndarray:
        """Return which vertices (N,) lie on parts of these kinds."""
        return np.isin(self.kind, kinds)

    def smooth_normals(self, rounds: int) -> np.ndarray:
        """Compute unit normals (N, 3) averaged over neighbours."""
        n = self.mesh.vertex_normals
        for _ in range(rounds):
            n = self.average @ n
        return n / np.maximum(np.linalg.norm(n, axis=1, keepdims=True), 1e-9)

    def along_limb(self, first: str, second: str, end: str) -> tuple[np.ndarray, float]:
        """Compute how far along a limb each vertex lies, 0 at its root and 1 at `end`, (N,), and the limb's length.

        Vertices of other parts have NaN.
        """
        out, length = np.full(len(self.kind), np.nan), 0.0
        for side, word in ((1, "left"), (-1, "right")):
            a, b, c = (self.joints[f"{name}_{word}"] for name in (first, second, end))
            upper, lower = np.linalg.norm(b - a), np.linalg.norm(c - b)
            length = upper + lower
            for kinds, start, way, before in (((first,), a, (b - a) / upper, 0.0),
                                              ((second, end), b, (c - b) / lower, upper)):
                own = self.on(*kinds) & (self.side == side)
                out[own] = (before + (self.mesh.vertices[own] - start) @ way) / length
        return out, length

    @property
    def waist(self) -> float:
        """Height of the waist, metres."""
        return float(0.55 * self.joints["abdomen"][2] + 0.45 * self.joints["chest"][2])

    @property
    def armpit(self) -> float:
        """Height of the armpits, metres: as far below the shoulder joints as they are from the middle, or half that."""
        left, right = self.joints["upper_arm_left"], self.joints["upper_arm_right"]
        return float(0.5 * (left[2] + right[2]) - 0.3 * np.linalg.norm(left - right))


def dress(body: Mesh, skeleton: Skeleton, kind: str, rng: np.random.Generator) -> Mesh:
    """Put clothes, hair or a bag on a naked body.

    Parameters
    ----------
    body : Mesh, metres
        A person who stands, z up, in the triangles of the built-in model.
    skeleton : Skeleton
        With parts named as in `scanprep.synthetic.people.PARTS`.
    kind : str
        One of `KINDS`.
    rng : numpy Generator
        Draws lengths, looseness and folds.

    Returns
    -------
    Mesh
        The triangles of the body, then those of the clothes.
    """
    if kind not in KINDS:
        raise ValueError(f"kind: expected one of {', '.join(KINDS)}, got {kind!r}")
    figure, R, t = make_figure(body, skeleton)
    clothes = KINDS[kind](figure, rng)
    worn = join(clothes)
    return join([body, worn.with_vertices(worn.vertices @ R + t)])


def facing(body: Mesh, skeleton: Skeleton) -> np.ndarray:
    """Compute the horizontal unit vector (3,) that points ahead of a body."""
    return -own_frame(find_joints(body, skeleton))[1]


def find_joints(body: Mesh, skeleton: Skeleton) -> dict[str, np.ndarray]:
    """Find the joint (3,) of each part of a posed body, by name."""
    from model import load_built_in_model

    places = skeleton.joint_regressor(load_built_in_model().template) @ body.vertices
    return dict(zip(skeleton.names, places, strict=True))


def own_frame(joints: dict[str, np.ndarray]) -> np.ndarray:
    """Compute the axes (3, 3) of a standing body, as rows: left, behind, up."""
    left = joints["thigh_left"] - joints["thigh_right"] + joints["upper_arm_left"] - joints["upper_arm_right"]
    left = left * [1, 1, 0] / np.linalg.norm(left[:2])
    return np.stack([left, np.cross([0.0, 0.0, 1.0], left), [0.0, 0.0, 1.0]])


def make_figure(body: Mesh, skeleton: Skeleton) -> tuple[Figure, np.ndarray, np.ndarray]:
    """Bring a body into its own frame; with R (3, 3) and t (3,): places in the world are `own @ R + t`."""
    joints, part = find_joints(body, skeleton), skeleton.part_of_vertex(body)
    R, t = own_frame(joints), joints["pelvis"] * [1, 1, 0]
    t[2] = body.vertices[:, 2].min()
    # each triangle in four, so that hems and folds are finer than the triangles of the body
    a, b = body.edges.T
    e = len(body.vertices) + body.face_edges
    corners, sides = body.faces.T, e.T
    faces = np.vstack([np.stack([corners[k], sides[k], sides[k - 1]], axis=1) for k in range(3)] + [e])
    vertices = np.vstack([body.vertices, 0.5 * (body.vertices[a] + body.vertices[b])])
    part = np.r_[part, part[a]]
    names = np.array(skeleton.names)[part]
    kind = np.array([name.replace("_left", "").replace("_right", "") for name in skeleton.names])[part]
    side = np.char.endswith(names, "_left").astype(int) - np.char.endswith(names, "_right")
    own = {name: R @ (place - t) for name, place in joints.items()}
    return Figure(Mesh((vertices - t) @ R.T, faces), kind, side, own), R, t


# What the clothes are made of


def join(meshes: Sequence[Mesh]) -> Mesh:
    """Put meshes side by side."""
    starts = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes])
    return Mesh(np.vstack([mesh.vertices for mesh in meshes]),
                np.vstack([mesh.faces + start for mesh, start in zip(meshes, starts, strict=False)]))


def draw_field(points: np.ndarray, rng: np.random.Generator, wave: float = 0.15, upright: float = 0.3) -> np.ndarray:
    """Draw a smooth random field in [0, 1] at points (..., 3), of waves about `wave` metres long.

    `upright` below 1 makes the folds run up and down.
    """
    total = np.zeros(points.shape[:-1])
    for _ in range(10):
        way = rng.normal(size=3) * [1, 1, upright]
        way *= 2 * np.pi / (wave * rng.uniform(0.5, 2.0)) / np.linalg.norm(way)
        total += np.cos(points @ way + rng.uniform(0, 2 * np.pi))
    return np.clip(0.5 + 0.2 * total, 0, 1)


def cut_surface(faces: np.ndarray, g: np.ndarray) -> tuple[csr_array, np.ndarray]:
    """Cut triangles along g = 0 and keep the side where g (N,) is positive.

    Returns
    -------
    (n, N) sparse
        Vertices of the cut surface as weighted means of the given ones.
    (m, 3) int
        Its triangles.
    """
    inside, N = g > 0, len(g)
    count = inside[faces].sum(axis=1)
    crossed, single = faces[(count == 1) | (count == 2)], count[(count == 1) | (count == 2)] == 1
    # turn each crossed triangle so that the vertex alone on its side, a, is first
    first = np.argmax(inside[crossed] == single[:, None], axis=1)
    a, b, c = np.take_along_axis(crossed, (first[:, None] + [0, 1, 2]) % 3, axis=1).T
    pairs, number = np.unique(np.sort(np.r_[np.c_[a, b], np.c_[a, c]], axis=1), axis=0, return_inverse=True)
    ab, ac = N + number.reshape(2, -1)
    kept = np.vstack([faces[count == 3], np.c_[a, ab, ac][single], np.c_[b, c, ac][~single],
                      np.c_[b, ac, ab][~single]])
    # new vertices where g changes its sign
    p, q = pairs.T
    share = g[p] / (g[p] - g[q])
    rows = np.arange(len(pairs))
    crossing = csr_array((np.r_[1 - share, share], (np.r_[rows, rows], np.r_[p, q])), shape=(len(pairs), N))
    used, new = np.unique(kept, return_inverse=True)
    whole = csr_array((np.ones((used < N).sum()), (np.arange((used < N).sum()), used[used < N])),
                      shape=((used < N).sum(), N))
    return csr_array(stack_rows([whole, crossing[used[used >= N] - N]])), new.reshape(-1, 3)


def follow_skin(figure: Figure, g: np.ndarray, thickness: np.ndarray, soft: float, rounds: int = 6) -> Mesh:
    """Make cloth that follows the skin where g > 0.

    Parameters
    ----------
    figure : Figure
    g : (N,) float, metres
        Distance from the hem, negative outside of the cloth.
    thickness : (N,) float, metres
        How far out of the skin the outer side of the cloth is.
    soft : float, metres
        Over what distance the cloth thins out towards its hem; 0 for a step.
    rounds : int
        Of smoothing the normals.
    """
    W, faces = cut_surface(figure.mesh.faces, g)
    share = np.clip((W @ g) / max(soft, 1e-6), 0, 1) if soft else np.ones(len(W @ g))
    out = (W @ thickness) * share * share * (3 - 2 * share)
    skin = W @ figure.mesh.vertices
    outer = skin + np.maximum(out, 0.001)[:, None] * (W @ figure.smooth_normals(rounds))
    cloth = Mesh(outer, faces)
    # where the skin is hollow the moved surface folds: smooth it there, and nowhere push it into the skin
    neighbours = csr_array(cloth.vertex_adjacency).astype(float)
    mean = diags_array(1 / np.maximum(neighbours.sum(axis=1), 1)) @ neighbours
    n, free = W @ figure.mesh.vertex_normals, np.ones(len(outer), dtype=bool)
    free[cloth.boundary_vertices] = False
    for _ in range(4):
        moved = 0.5 * outer + 0.5 * (mean @ outer)
        low = np.einsum("nd,nd->n", moved - skin, n) < 0.6 * out
        outer = np.where((free & ~low)[:, None], moved, outer)
    # the rim between the outer side and the skin
    half = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    a, b = half[cloth.edge_use[cloth.face_edges.ravel()] == 1].T
    under = len(outer)
    rim = np.vstack([np.c_[b, a, a + under], np.c_[b, a + under, b + under]])
    return Mesh(np.vstack([outer, skin]), np.vstack([faces, rim]))


def find_cover(figure: Figure, neck: float | None = None, top: float | None = None, bottom: float | None = None,
               arms: float | None = None, legs: float | None = None) -> np.ndarray:
    """Compute the distance of every vertex from the hems of a garment, (N,), metres, negative outside.

    Parameters
    ----------
    figure : Figure
    neck : float, metres, optional
        Height of the hem above the base of the neck, lower in front; None: no upper part.
    top, bottom : float, metres, optional
        Heights of level hems.
    arms, legs : float, optional
        Where sleeves and trouser legs end, 0 shoulder or hip, 1 wrist or ankle; None: none.
    """
    v = figure.mesh.vertices
    g, arm = np.full(len(v), 0.5), figure.on("upper_arm", "forearm", "hand")
    if neck is not None:
        # level from the left to the right, 30 degrees down to the front
        base = figure.joints["head"]
        high = figure.on("chest", "head")
        g[high] = np.minimum(g, 0.86 * (base[2] + neck - v[:, 2]) + 0.5 * (v[:, 1] - base[1]))[high]
    if top is not None:
        g = np.minimum(g, top - v[:, 2])
    if bottom is not None:
        g[~arm] = np.minimum(g, v[:, 2] - bottom)[~arm]
    for end, whole, joints in ((arms, arm, ("upper_arm", "forearm", "hand")),
                               (legs, figure.on("thigh", "shin", "foot"), ("thigh", "shin", "foot"))):
        if end is not None:
            along, length = figure.along_limb(*joints)
            g[whole] = np.minimum(g, (end - along) * length)[whole]
    if arms is None:
        g[arm] = -0.5
    return g


def find_outlines(figure: Figure, kinds: Sequence[str], heights: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Compute convex outlines of level sections: how far they reach from `centre` (2,) in each of ANGLES, (Z, A)."""
    own = figure.mesh.vertices[figure.on(*kinds)]
    ways = np.stack([np.cos(ANGLES), np.sin(ANGLES)])
    reach, z = (own[:, :2] - centre) @ ways, own[:, 2]
    out = np.full((len(heights), len(ANGLES)), np.nan)
    for k, height in enumerate(heights):
        near = np.abs(z - height) < STEP
        if near.any():
            out[k] = reach[near].max(axis=0)
        elif k:
            out[k] = out[k - 1]
    return out


def hang(outlines: np.ndarray, gap: np.ndarray, slope: float) -> np.ndarray:
    """Let cloth hang from the first ring down: no ring is narrower than its body and `gap`, and the ring above.

    `slope` is by how much the cloth gets wider on its way down, metres per metre; below 0 it comes in again.
    """
    out = outlines + gap[:, None]
    for k in range(1, len(out)):
        out[k] = np.maximum(out[k], out[k - 1] + slope * STEP)
    return out


def find_radii(reach: np.ndarray) -> np.ndarray:
    """Turn how far convex outlines reach in each of ANGLES, (Z, A), into their radii there."""
    cosine = np.cos(ANGLES[:, None] - ANGLES)
    with np.errstate(divide="ignore"):
        away = np.where(cosine > 0.05, 1 / np.maximum(cosine, 0.05), np.inf)
    return np.stack([(row * away).min(axis=1) for row in np.maximum(reach, 0.01)])


def loft(rings: np.ndarray, closed: bool = True) -> Mesh:
    """Join rings (Z, A, 3) by triangles; each ring is closed, or a line."""
    Z, A = rings.shape[:2]
    number = np.arange(Z * A).reshape(Z, A)
    after = np.roll(number, -1, axis=1) if closed else number[:, 1:]
    here = number if closed else number[:, :-1]
    a, b, c, d = here[:-1].ravel(), after[:-1].ravel(), here[1:].ravel(), after[1:].ravel()
    return Mesh(rings.reshape(-1, 3), np.vstack([np.c_[a, c, b], np.c_[b, c, d]]))


def hang_tube(figure: Figure, rng: np.random.Generator, top: float, bottom: float, gap: float, slope: float,
              waves: float, rim: float = 0.005) -> Mesh:
    """Make a tube of cloth around trunk and both legs that hangs between two heights, metres.

    `gap` and `waves` are in metres: how far it is off where it lies on, and how deep its folds are at the bottom.
    At the top it is `rim` metres out of the skin, below 0 where it begins under a garment of the shoulders.
    """
    heights = np.arange(top, bottom, -STEP)
    reach = find_outlines(figure, (*TRUNK, *LEGS), heights, np.zeros(2))
    near_top = np.clip((top - heights) / 0.03, 0, 1)
    r = find_radii(hang(reach, gap * near_top + rim * (1 - near_top), slope))
    r = gaussian_filter1d(gaussian_filter1d(r, 2.0, axis=1, mode="wrap"), 1.5, axis=0, mode="nearest")
    # folds run down, deeper and deeper
    down = np.clip((top - heights) / 0.6, 0, 1)[:, None]
    count, start = rng.integers(5, 14, 3), rng.uniform(0, 2 * np.pi, 3)
    folds = np.mean([np.cos(n * ANGLES + s + 0.8 * down * np.cos(ANGLES + s)) for n, s in zip(count, start,
                                                                                            strict=True)], axis=0)
    r = r + waves * down * (0.7 + folds)
    at = np.stack([r * np.cos(ANGLES), r * np.sin(ANGLES), np.broadcast_to(heights[:, None], r.shape)], axis=-1)
    return loft(at)


def make_tube(way: np.ndarray, radius: np.ndarray | float, flat: float = 1.0) -> Mesh:
    """Make a tube around a line of points (n, 3); `flat` below 1 makes it a strap."""
    way = np.asarray(way, dtype=float)
    ahead = np.gradient(way, axis=0)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    aside = np.cross(ahead, [0.0, 1.0, 0.01])
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    third, a = np.cross(ahead, aside), np.linspace(0, 2 * np.pi, 20, endpoint=False)[:, None]
    ring = np.cos(a) * flat * aside[:, None] + np.sin(a) * third[:, None]
    return loft(way[:, None] + np.broadcast_to(radius, len(way))[:, None, None] * ring)


def make_line(corners: Sequence[np.ndarray], count: int = 40) -> np.ndarray:
    """Run through corners (n, 3) evenly and round them off: (count, 3)."""
    corner = np.asarray(corners, dtype=float)
    far = np.r_[0, np.cumsum(np.linalg.norm(np.diff(corner, axis=0), axis=1))]
    at = np.linspace(0, far[-1], count)
    line = np.stack([np.interp(at, far, corner[:, k]) for k in range(3)], axis=1)
    return gaussian_filter1d(line, 0.04 * count, axis=0, mode="nearest")


def make_box(middle: np.ndarray, size: np.ndarray, rng: np.random.Generator) -> Mesh:
    """Make a box with round edges and slight bulges, `size` (3,) metres."""
    u, w = np.linspace(0, 2 * np.pi, 64, endpoint=False), np.linspace(0.001, np.pi - 0.001, 40)[:, None]
    ball = np.stack([np.sin(w) * np.cos(u), np.sin(w) * np.sin(u), np.broadcast_to(np.cos(w), (40, 64))], axis=-1)
    # a ball of the norm of order q is a box with round edges
    q = rng.uniform(4, 8)
    box = ball / (np.abs(ball)**q).sum(axis=-1, keepdims=True)**(1 / q)
    bulge = 0.94 + 0.1 * draw_field(box, rng, 2.0, 1.0)[..., None]
    return loft(middle + 0.5 * size * box * bulge)


def find_depth(figure: Figure, x: np.ndarray, z: np.ndarray, sign: int) -> np.ndarray:
    """Find y of head and trunk at places (...,) of x and z, seen from behind (1) or the front (-1); NaN beside them."""
    from scanprep.geometry.surface import Rays

    trunk = figure.on("head", *TRUNK)
    mesh, _ = figure.mesh.submesh(trunk[figure.mesh.faces].all(axis=1))
    origins = np.stack([x, np.full(x.shape, 2.0 * sign), z], axis=-1).reshape(-1, 3)
    face, far = Rays(mesh).cast(origins, np.broadcast_to([0.0, -sign, 0.0], origins.shape))
    return np.where(face >= 0, sign * (2.0 - far), np.nan).reshape(x.shape)


def hang_strands(figure: Figure, x: np.ndarray, z: np.ndarray, out: np.ndarray, start: float, sign: int,
                 slope: float = 0.5) -> Mesh:
    """Make a sheet of hair that falls over the back (sign 1) or the chest (-1).

    Places x and z (Z, A), metres, are given from the top down; `out` (Z, A) is how thick it is. It begins at y =
    `start` where nothing is beneath.
    """
    surface = sign * find_depth(figure, x, z, sign)
    y = np.full(x.shape[1], sign * start)
    rows = []
    for k in range(len(x)):
        y = np.fmax(surface[k] + out[k], y - slope * STEP) if k else np.fmax(surface[k] + out[k], y)
        rows.append(y)
    depth = gaussian_filter1d(gaussian_filter1d(np.array(rows), 1.5, axis=0), 1.5, axis=1)
    depth = np.fmax(depth, surface + 0.6 * out)
    sheet = loft(np.stack([x, sign * depth, z], axis=-1), closed=False)
    return sheet if sign < 0 else Mesh(sheet.vertices, sheet.faces[:, ::-1])


# The ten kinds


def draw_hem(rng: np.random.Generator) -> float:
    """Draw over what distance a cloth thins out at its hem, metres: half of them end in a step, 0."""
    return float(rng.uniform(0.02, 0.04)) if rng.random() < 0.5 else 0.0


def sew(figure: Figure, rng: np.random.Generator, low: float, high: float, rounds: int = 6,
        **hems: float) -> Mesh:
    """Make cloth that follows the skin, between `low` and `high` metres out; `hems` are those of `find_cover`."""
    thickness = low + (high - low) * draw_field(figure.mesh.vertices, rng)
    # sleeves are narrower than the trunk of a thick garment
    along = np.nan_to_num(figure.along_limb("upper_arm", "forearm", "hand")[0])
    thickness = np.minimum(thickness, np.maximum(thickness * (1 - 0.7 * np.clip(along, 0, 1)), 0.015))
    return follow_skin(figure, find_cover(figure, **hems), thickness, draw_hem(rng), rounds)


def grow_long_hair(figure: Figure, rng: np.random.Generator) -> list[Mesh]:
    """Grow hair over crown and back of the head, neck and back, to somewhere between shoulders and waist."""
    v, thick = figure.mesh.vertices, rng.uniform(0.012, 0.045)
    head, neck = v[figure.on("head")], figure.joints["head"]
    top = head[:, 2].max()
    skull = head[head[:, 2] > top - 0.14]
    middle = 0.5 * (skull[:, :2].min(axis=0) + skull[:, :2].max(axis=0))
    # the crown: what lies behind the ears or above the forehead
    hairline = np.maximum(v[:, 1] - middle[1] + 0.02, v[:, 2] - top + 0.055)
    g = np.where(figure.on("head"), np.minimum(hairline, 0.7 * (v[:, 2] - top + 0.22)), -0.5)
    meshes = [follow_skin(figure, g, thick * (0.7 + 0.5 * draw_field(v, rng, 0.1)), draw_hem(rng), 12)]
    # a curtain from the widest place of the skull down to the shoulders, open in front
    heights = np.arange(top - 0.07, neck[2], -STEP)
    reach = find_outlines(figure, ("head",), heights, middle)
    r = find_radii(hang(reach, np.full(len(heights), thick), -0.2))
    r = gaussian_filter1d(r, 1.5, axis=0, mode="nearest")
    open_side = np.radians(rng.uniform(55, 80))
    chosen = np.abs((ANGLES - 1.5 * np.pi + np.pi) % (2 * np.pi) - np.pi) > open_side
    order = np.flatnonzero(chosen)[np.argsort((ANGLES[chosen] - 1.5 * np.pi) % (2 * np.pi))]
    # strands differ, and towards the face there are fewer
    skin, beyond = find_radii(reach), np.abs((ANGLES - 0.5 * np.pi + np.pi) % (2 * np.pi) - np.pi)
    full = np.clip((np.pi - open_side - beyond) / np.radians(25), 0.3, 1)
    way = np.stack([np.cos(ANGLES), np.sin(ANGLES), 0 * ANGLES], axis=-1)
    r = skin + (r - skin) * full * (0.75 + 0.4 * draw_field(way, rng, 0.5))
    ring = np.stack([middle[0] + r * np.cos(ANGLES), middle[1] + r * np.sin(ANGLES),
                     np.broadcast_to(heights[:, None], r.shape)], axis=-1)
    meshes.append(loft(ring[:, order], closed=False))
    # down the back, wider than the head at the shoulders
    end = rng.uniform(figure.waist, figure.armpit + 0.03)
    wide = rng.uniform(0.55, 0.85) * figure.joints["upper_arm_left"][0]
    meshes.append(fall(figure, rng, top - 0.1, end, (-0.075, 0.075), (-wide, wide), thick, middle[1], 1))
    # on the shoulders' front, of some people
    for side in (-1, 1):
        if rng.random() < 0.5:
            inner, outer = sorted((side * 0.045, side * rng.uniform(0.09, 0.12)))
            meshes.append(fall(figure, rng, neck[2] + 0.05, rng.uniform(figure.armpit - 0.08, figure.armpit + 0.05),
                               (inner, outer), (inner, outer), 0.8 * thick, middle[1], -1))
    return meshes


def fall(figure: Figure, rng: np.random.Generator, top: float, end: float, wide_top: Sequence[float],
         wide_end: Sequence[float], thick: float, start: float, sign: int) -> Mesh:
    """Let hair fall from a height to another; `wide_top` and `wide_end` are its x from and to, metres."""
    z = np.arange(top, end, -STEP)
    spread = np.clip((top - z) / 0.2, 0, 1)[:, None]
    u = np.linspace(0, 1, 25)
    edge = [(1 - spread) * wide_top[k] + spread * wide_end[k] for k in (0, 1)]
    x = edge[0] + u * (edge[1] - edge[0])
    zz = np.broadcast_to(z[:, None], x.shape)
    # thinner at the sides and at the tips
    out = thick * (1 - 0.8 * np.abs(2 * u - 1)**4) * np.clip((z - end) / 0.08, 0.4, 1)[:, None]
    out = out * (0.7 + 0.5 * draw_field(np.stack([x, 0 * x, zz], axis=-1), rng, 0.06))
    return hang_strands(figure, x, zz, out, start, sign)


def sew_skirt(figure: Figure, rng: np.random.Generator) -> list[Mesh]:
    """Hang a skirt from the waist, to between knees and ankles: narrow or wide."""
    bottom = rng.uniform(0.12, 1.05) * figure.joints["shin_left"][2]
    return [hang_tube(figure, rng, figure.waist, bottom, rng.uniform(0.004, 0.015), rng.uniform(-0.12, 0.35),
                      rng.uniform(0, 0.03))]


def sew_tight(figure: Figure, rng: np.random.Generator) -> list[Mesh]:
    """Sew a T-shirt and trousers that follow the skin."""
    low, high = rng.uniform(0.005, 0.008), rng.uniform(0.012, 0.025)
    shirt = sew(figure, rng, low, high, neck=rng.uniform(-0.01, 0.02), bottom=figure.waist - rng.uniform(0.08, 0.2),
                arms=rng.uniform(0.2, 0.45))
    return [shirt, sew(figure, rng, low, high, top=figure.waist - 0.03, legs=rng.uniform(0.85, 0.97))]


def sew_coat(figure: Figure, rng: np.random.Generator) -> list[Mesh]:
    """Sew a closed coat to between thighs and knees, over trousers."""
    thick = rng.uniform(0.03, 0.05)
    knee, hip = figure.joints["shin_left"][2], figure.joints["thigh_left"][2]
    coat = sew(figure, rng, thick, thick + 0.01, 14, neck=0.05, bottom=figure.armpit - 0.1,
               arms=rng.uniform(0.9, 1.0))
    skirt = hang_tube(figure, rng, figure.armpit, knee + rng.uniform(0.0, 0.6) * (hip - knee), thick + 0.01,
                      rng.uniform(-0.15, 0.12), rng.uniform(0, 0.012), UNDER)
    return [coat, skirt, sew(figure, rng, 0.008, 0.025, top=figure.waist, legs=0.97)]


def sew_gown(figure: Figure, rng: np.random.Generator) -> list[Mesh]:
    """Sew a gown from the shoulders to between knees and ankles, with sleeves."""
    thick = rng.uniform(0.006, 0.025)
    upper = sew(figure, rng, thick, thick + 0.015, 10, neck=rng.uniform(-0.02, 0.02),
                bottom=figure.armpit - 0.1, arms=rng.uniform(0.25, 0.9))
    bottom = rng.uniform(0.15, 1.0) * figure.joints["shin_left"][2]
    return [upper, hang_tube(figure, rng, figure.armpit, bottom, thick + 0.015, rng.uniform(-0.05, 0.2),
                             rng.uniform(0.005, 0.03), UNDER)]


def put_on_rucksack(figure: Figure, rng: np.random.Generator) -> list[Mesh]:
    """Put a rucksack on the back, with straps over the shoulders and below the arms."""
    v, neck = figure.mesh.vertices, figure.joints["head"]
    size = np.array([rng.uniform(0.26, 0.36), rng.uniform(0.12, 0.25), rng.uniform(0.36, 0.52)])
    middle = np.array([neck[0], 0.0, neck[2] - 0.02 - 0.5 * size[2]])
    x, z = np.meshgrid(middle[0] + np.linspace(-0.1, 0.1, 9), middle[2] + np.linspace(-0.4, 0.4, 9) * size[2])
    middle[1] = np.nanquantile(find_depth(figure, x, z, 1), 0.8) + 0.5 * size[1] - 0.01
    # straps lie on the skin: over the shoulders, and at the height of their lower end around the sides
    half, apart, low = rng.uniform(0.02, 0.035), rng.uniform(0.09, 0.11), figure.armpit - rng.uniform(0.02, 0.08)
    x = np.abs(v[:, 0] - neck[0])
    over = np.minimum(half - np.abs(x - apart), v[:, 2] - low + half)
    around = np.minimum(half - np.abs(v[:, 2] - low), x - apart)
    g = np.where(figure.on("chest", "abdomen"), np.maximum(over, around), -0.5)
    strap = follow_skin(figure, g, np.full(len(v), rng.uniform(0.008, 0.02)), 0.0)
    return [make_box(middle, size, rng), strap]


def hold_handbag(figure: Figure, rng: np.random.Generator) -> list[Mesh]:
    """Hang a bag from a hand, or from a shoulder beside the hip."""
    side = rng.choice([-1, 1])
    word = "left" if side > 0 else "right"
    size = np.array([rng.uniform(0.09, 0.16), rng.uniform(0.26, 0.40), rng.uniform(0.2, 0.32)])
    hand = figure.mesh.vertices[figure.on("hand") & (figure.side == side)]
    if rng.random() < 0.5:
        # from the hand: two handles
        grip = hand.mean(axis=0) * [1, 1, 0] + [0, 0, hand[:, 2].min() + 0.03]
        middle = grip - [0, 0, rng.uniform(0.08, 0.14) + 0.5 * size[2]]
        middle[2] = max(middle[2], 0.5 * size[2] + 0.02)
        ends = [middle + [w * 0.25 * size[0], s * 0.3 * size[1], 0.46 * size[2]] for w in (-1, 1) for s in (-1, 1)]
        return [make_box(middle, size, rng)] + [make_tube(make_line([ends[k], grip, ends[k + 1]]), 0.008)
                                                for k in (0, 2)]
    # from the shoulder: beside the hip, with a strap before and behind the trunk
    shoulder, z = figure.joints[f"upper_arm_{word}"], figure.joints["pelvis"][2] + rng.uniform(-0.05, 0.15)
    trunk = figure.mesh.vertices[figure.on("pelvis", "abdomen", "thigh")]
    beside = trunk[np.abs(trunk[:, 2] - z) < 0.5 * size[2]]
    middle = np.array([side * ((side * beside[:, 0]).max() + 0.5 * size[0] - 0.005), beside[:, 1].mean(), z])
    place = np.array([[0.75 * shoulder[0]], [shoulder[2]]])
    front, back = (find_depth(figure, *place, sign)[0] for sign in (-1, 1))
    chest = figure.mesh.vertices[figure.on("chest", "upper_arm")]
    high = chest[np.abs(chest[:, 0] - 0.75 * shoulder[0]) < 0.02, 2].max() + 0.01
    ends = [middle + [0, s * 0.42 * size[1], 0.42 * size[2]] for s in (-1, 1)]
    way = make_line([ends[0], np.array([shoulder[0], front - 0.04, shoulder[2] - 0.1]),
                     np.array([0.75 * shoulder[0], 0.5 * (front + back), high + 0.01]),
                     np.array([shoulder[0], back + 0.03, shoulder[2] - 0.1]), ends[1]], 80)
    return [make_box(middle, size, rng), make_tube(way, 0.014, 0.5)]


def wind_scarf(figure: Figure, rng: np.random.Generator, thick: float, behind: float) -> Mesh:
    """Wind a roll `thick` metres around the neck; `behind` 1 makes it a hood, thin in front and wide at the back."""
    neck = figure.joints["head"]
    z = neck[2] + 0.03
    ring = figure.mesh.vertices[figure.on("head")]
    ring = ring[np.abs(ring[:, 2] - z - 0.02) < 0.02]
    middle = ring[:, :2].mean(axis=0)
    reach = ((ring[:, :2] - middle) @ np.stack([np.cos(ANGLES), np.sin(ANGLES)])).max(axis=0)
    r = gaussian_filter1d(find_radii(reach[None])[0], 3, mode="wrap")
    # thicker at the back, lower in front
    minor = thick * (1 - behind * (0.4 - 0.6 * np.sin(ANGLES)))
    minor = np.maximum(minor, 0.008)[:, None]
    a = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    lift = z + 0.025 * np.sin(ANGLES) * (1 - 1.6 * behind)
    out = (r + (0.7 + 0.25 * behind) * minor[:, 0])[:, None] + minor * np.cos(a)
    rings = np.stack([middle[0] + out * np.cos(ANGLES)[:, None], middle[1] + out * np.sin(ANGLES)[:, None],
                      lift[:, None] + 1.1 * minor * np.sin(a)], axis=-1)
    n = rings - rings.mean(axis=1, keepdims=True)
    rings = rings + n * (0.4 * draw_field(rings, rng, 0.12, 1.0) - 0.2)[..., None]
    return loft(np.concatenate([rings, rings[:1]]))


def put_on_winter_things(figure: Figure, rng: np.random.Generator) -> list[Mesh]:
    """Put on a scarf, a cap and boots to the middle of the shins."""
    v = figure.mesh.vertices
    top = v[:, 2].max()
    # the cap's hem is lower at the forehead than at the back of the head
    head = figure.on("head")
    ahead = v[head, 1].mean() - v[:, 1]
    cap = np.where(head, v[:, 2] - top + rng.uniform(0.07, 0.1) + 0.25 * ahead, -0.5)
    along, length = figure.along_limb("thigh", "shin", "foot")
    boots = np.where(figure.on("shin", "foot"), (along - rng.uniform(0.7, 0.82)) * length, -0.5)
    boots[figure.on("foot")] = 0.3
    return [wind_scarf(figure, rng, rng.uniform(0.025, 0.045), 0.0),
            follow_skin(figure, cap, rng.uniform(0.006, 0.02) * (0.8 + 0.4 * draw_field(v, rng)), draw_hem(rng), 14),
            follow_skin(figure, boots, rng.uniform(0.008, 0.02) * (0.8 + 0.4 * draw_field(v, rng)), draw_hem(rng),
                        10)]


def wrap_towel(figure: Figure, rng: np.random.Generator) -> list[Mesh]:
    """Wrap a towel around the trunk, from chest or waist to the thighs; one side lies over the other."""
    top = figure.armpit - 0.01 if rng.random() < 0.5 else figure.waist - 0.02
    knee, hip = figure.joints["shin_left"][2], figure.joints["thigh_left"][2]
    bottom, gap, slope = knee + rng.uniform(0.05, 0.7) * (hip - knee), rng.uniform(0.005, 0.016), rng.uniform(-0.3, 0.0)
    inner = hang_tube(figure, rng, top, bottom, gap, slope, 0.0)
    # the outer side: half of the rings, a towel's thickness farther out
    rings = hang_tube(figure, rng, top - 0.005, bottom + 0.01, gap + rng.uniform(0.005, 0.01), slope,
                      0.0).vertices.reshape(-1, len(ANGLES), 3)
    first = rng.integers(len(ANGLES))
    return [inner, loft(np.roll(rings, first, axis=1)[:, :len(ANGLES) // 2], closed=False)]


def sew_hoodie(figure: Figure, rng: np.random.Generator) -> list[Mesh]:
    """Sew a loose sweater with a hood behind the neck, and shorts."""
    low = rng.uniform(0.015, 0.022)
    hip = figure.joints["thigh_left"][2]
    upper = sew(figure, rng, low, rng.uniform(low + 0.005, 0.04), 10, neck=0.01, bottom=figure.armpit - 0.1,
                arms=rng.uniform(0.85, 0.97))
    trunk = hang_tube(figure, rng, figure.armpit, hip + rng.uniform(-0.08, 0.04), low + 0.01,
                      rng.uniform(-0.3, -0.05), rng.uniform(0.005, 0.015), UNDER)
    shorts = sew(figure, rng, 0.010, 0.028, 10, top=figure.waist, legs=rng.uniform(0.3, 0.52))
    return [upper, trunk, wind_scarf(figure, rng, rng.uniform(0.04, 0.06), 1.0), shorts]


KINDS: dict[str, Callable[[Figure, np.random.Generator], list[Mesh]]] = {
    "long hair": grow_long_hair, "skirt": sew_skirt, "tight": sew_tight, "coat": sew_coat, "gown": sew_gown,
    "rucksack": put_on_rucksack, "handbag": hold_handbag, "scarf, cap, boots": put_on_winter_things,
    "towel": wrap_towel, "hoodie": sew_hoodie}


def scan_dressed(mesh: Mesh, rng: np.random.Generator, half: bool = False,
                 ahead: np.ndarray | Sequence[float] = (0.0, -1.0, 0.0)) -> PointCloud:
    """Scan a body and its clothes: what cameras around it see, with noise along the rays and a few holes.

    Parameters
    ----------
    mesh : Mesh, metres
        Triangles that may run into each other, z up.
    rng : numpy Generator
    half : bool
        Six cameras within 70 degrees, about ahead, instead of 36 all around at three heights.
    ahead : (3,) float
        Where the front is, for `half`.

    Returns
    -------
    PointCloud
        12,000 to 25,000 points with normals towards the cameras, fewer of half a body.
    """
    import open3d

    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32))
    # azimuths and heights of the cameras, 2.3 m away
    if half:
        azimuths = np.arctan2(ahead[1], ahead[0]) + np.radians(rng.uniform(-20, 20) + np.array([-35, 0, 35] * 2))
        heights = np.repeat([0.45, 0.8], 3)
    else:
        azimuths = np.tile(2 * np.pi * np.arange(12) / 12 + rng.uniform(0, 0.5), 3)
        heights = np.repeat([0.15, 0.55, 1.05], 12)
    middle, found = 0.5 * (low + high), []
    for azimuth, height in zip(azimuths, heights, strict=True):
        camera = middle + [2.3 * np.cos(azimuth), 2.3 * np.sin(azimuth), 0.0]
        camera[2] = low[2] + height * (high[2] - low[2])
        found.append(see(scene, mesh, camera, rng))
    points, normals = (np.vstack(one) for one in zip(*found, strict=True))
    # as many points as a scanner of 6 to 9 mm would keep, without those of a few holes
    count = int(rng.integers(12_000, 25_000) * (0.5 if half else 1))
    chosen = rng.permutation(len(points))[:count]
    points, normals = points[chosen], normals[chosen]
    kept = np.ones(len(points), dtype=bool)
    for _ in range(rng.integers(3, 7)):
        kept &= np.linalg.norm(points - points[rng.integers(len(points))], axis=1) > rng.uniform(0.01, 0.04)
    return PointCloud(points[kept], normals[kept])


def see(scene: object, mesh: Mesh, camera: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Compute points and normals (n, 3) of what a camera sees of a mesh in a ray casting scene of Open3D."""
    import open3d

    # rays through random places of the picture that the mesh fills
    middle = 0.5 * (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0))
    back = (camera - middle) / np.linalg.norm(camera - middle)
    right = np.cross([0.0, 0.0, 1.0], back)
    axes = np.stack([right / np.linalg.norm(right), np.cross(back, right / np.linalg.norm(right)), back])
    local = (mesh.vertices - camera) @ axes.T
    u, w = (local[:, :2] / -local[:, 2:]).T
    place = rng.uniform([u.min(), w.min()], [u.max(), w.max()], (12_000, 2))
    rays = np.c_[place, -np.ones(len(place))] @ axes
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    seen = scene.cast_rays(open3d.core.Tensor(np.c_[np.broadcast_to(camera, rays.shape), rays].astype(np.float32)))
    far, normals = seen["t_hit"].numpy().astype(float), seen["primitive_normals"].numpy().astype(float)
    cosine = np.einsum("nd,nd->n", rays, normals)
    hit = np.isfinite(far) & (np.abs(cosine) > GRAZING)
    # noise of 1 mm along the ray; normals towards the camera
    points = camera + (far + 0.001 * rng.normal(size=len(far)))[hit, None] * rays[hit]
    return points, -np.sign(cosine[hit])[:, None] * normals[hit]
