"""The triangle mesh that all stages use."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, wraps
from importlib import import_module
from typing import Any, TypeVar, cast

import numpy as np
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components

from ..words import number_of
from .sparse import label_components, unique_integers


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh.

    Derived quantities are computed on first use and cached. So all arrays are copied and read-only.

    Parameters
    ----------
    vertices : (N, 3) float, metres
        Positions.
    faces : (F, 3) int
        Vertices of the triangles, counter-clockwise seen from outside.
    colors : (N, 3) float in [0, 1], optional
        Red, green and blue of every vertex.
    of_file : (M,) int, optional
        The vertex here of each vertex of the file, if its reader merged some; -1 if it was left out. Files with vertex
        numbers refer to those of the mesh file.
    up : 0, 1 or 2, optional
        The axis that points up, where it is known. Other vertices may lie, so `with_vertices` asks for it again.
    attached : scanprep.geometry.attached.Attached, optional
        Eyes, teeth and loose vertices that follow this body in every file that is written.

    Raises
    ------
    ValueError
        An array of the wrong shape, a vertex that is not finite, an index out of range.

    Examples
    --------
    >>> triangle = Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    >>> triangle.face_areas.tolist(), triangle.edges.shape, triangle.is_closed
    ([0.5], (3, 2), False)
    """

    vertices: np.ndarray
    faces: np.ndarray
    colors: np.ndarray | None = None
    of_file: np.ndarray | None = None
    up: int | None = None
    attached: Any = None

    def __post_init__(self) -> None:
        if self.up not in (None, 0, 1, 2):
            raise ValueError(f"up: expected 0, 1 or 2, got {self.up}")
        vertices = np.array(self.vertices, dtype=np.float64)
        faces = np.array(self.faces, dtype=np.int64)
        if vertices.ndim != 2 or vertices.shape[1] != 3:
            raise ValueError(f"vertices: expected shape (N, 3), got {vertices.shape}")
        if faces.ndim != 2 or faces.shape[1] != 3:
            raise ValueError(f"faces: expected shape (F, 3), got {faces.shape}")
        # refuse values and indices that would fail later, with the first bad one
        bad = np.flatnonzero(~np.isfinite(vertices).all(axis=1))
        if len(bad):
            raise ValueError(f"vertices: {len(bad)} are not finite, the first is vertex {bad[0]}")
        outside = np.flatnonzero(((faces < 0) | (faces >= len(vertices))).any(axis=1))
        if len(outside):
            raise ValueError(f"faces: face {outside[0]} = {faces[outside[0]].tolist()} refers to a vertex "
                             f"outside 0..{len(vertices) - 1}")
        if self.colors is not None:
            colors = np.array(self.colors, dtype=np.float64)
            if colors.shape != vertices.shape:
                raise ValueError(f"colors: expected shape {vertices.shape}, got {colors.shape}")
            colors.flags.writeable = False
            object.__setattr__(self, "colors", colors)
        vertices.flags.writeable = faces.flags.writeable = False
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "faces", faces)

    def __repr__(self) -> str:
        return f"Mesh({len(self.vertices)} vertices, {len(self.faces)} faces)"

    @staticmethod
    def of(mesh: Any) -> Mesh:
        """Take a mesh of trimesh, pyvista or Open3D as it is; ours comes back itself.

        Parameters
        ----------
        mesh : Mesh, trimesh.Trimesh, pyvista.PolyData or open3d.geometry.TriangleMesh
            In metres. Polygons of pyvista are cut into triangles.

        Raises
        ------
        TypeError
            Something else.
        """
        taken = take_mesh(mesh)
        if not isinstance(taken, Mesh):
            raise TypeError(f"mesh: expected a mesh of scanprep, trimesh, pyvista or Open3D, got {type(mesh).__name__}")
        return taken

    def to_trimesh(self) -> Any:
        """Make a `trimesh.Trimesh` with the same vertices and triangles."""
        colors = None if self.colors is None else np.round(255 * self.colors).astype(np.uint8)
        return import_module("trimesh").Trimesh(self.vertices, self.faces, vertex_colors=colors, process=False)

    def to_pyvista(self) -> Any:
        """Make a `pyvista.PolyData`; colours are its point data "colors"."""
        mesh = import_module("pyvista").PolyData.from_regular_faces(self.vertices, self.faces)
        if self.colors is not None:
            mesh.point_data["colors"] = self.colors
        return mesh

    def to_open3d(self) -> Any:
        """Make an `open3d.geometry.TriangleMesh`."""
        o3d = import_module("open3d")
        # copies, as Open3D needs arrays of its own
        mesh = o3d.geometry.TriangleMesh(o3d.utility.Vector3dVector(np.array(self.vertices)),
                                         o3d.utility.Vector3iVector(self.faces.astype(np.int32)))
        if self.colors is not None:
            mesh.vertex_colors = o3d.utility.Vector3dVector(np.array(self.colors))
        return mesh

    @cached_property
    def bounds(self) -> np.ndarray:
        """(2, 3) lower and upper corner of the box around the vertices, metres."""
        return np.stack([self.vertices.min(axis=0), self.vertices.max(axis=0)])

    def with_vertices(self, vertices: np.ndarray, up: int | None = None) -> Mesh:
        """Return a mesh with the same triangles and other vertices (N, 3), metres; `up` is their axis, where known."""
        return Mesh(vertices, self.faces, self.colors, self.of_file, up, self.attached)

    @cached_property
    def corners(self) -> np.ndarray:
        """(F, 3, 3) the three points of every triangle, metres."""
        return self.vertices[self.faces]

    @cached_property
    def _cross(self) -> np.ndarray:
        """(F, 3) cross products of two sides: twice the area vectors."""
        c = self.corners
        return np.cross(c[:, 1] - c[:, 0], c[:, 2] - c[:, 0])

    @cached_property
    def face_areas(self) -> np.ndarray:
        """(F,) areas of the triangles, square metres."""
        return 0.5 * np.linalg.norm(self._cross, axis=1)

    @cached_property
    def face_normals(self) -> np.ndarray:
        """(F, 3) unit normals; zero for a degenerate triangle."""
        return _unit(self._cross)

    @cached_property
    def vertex_normals(self) -> np.ndarray:
        """(N, 3) unit normals, area-weighted; zero at a vertex without triangles."""
        corner, count = self.faces.T.ravel(), len(self.vertices)
        return _unit(np.stack([np.bincount(corner, np.tile(along, 3), count) for along in self._cross.T], axis=1))

    def share_of_area(self, chosen: np.ndarray) -> float:
        """Compute the share of the surface at chosen vertices (N,) bool; vertices may be denser in some places."""
        return float(self.vertex_areas @ chosen / self.vertex_areas.sum())

    @cached_property
    def vertex_areas(self) -> np.ndarray:
        """(N,) a third of the area of the triangles around each vertex, square metres."""
        return np.bincount(self.faces.ravel(), np.repeat(self.face_areas / 3, 3), len(self.vertices))

    @cached_property
    def _edges_and_sides(self) -> tuple[np.ndarray, np.ndarray]:
        """`edges` and `face_edges`, computed together."""
        a, b = self.faces, np.roll(self.faces, -1, axis=1)
        count = len(self.vertices)           # one number per edge sorts several times faster than rows
        key, of_half = np.unique(np.minimum(a, b) * count + np.maximum(a, b), return_inverse=True)
        return np.stack(np.divmod(key, max(count, 1)), axis=1), of_half.reshape(-1, 3)

    @property
    def edges(self) -> np.ndarray:
        """(E, 2) every edge once, lower vertex first."""
        return self._edges_and_sides[0]

    @property
    def face_edges(self) -> np.ndarray:
        """(F, 3) the row in `edges` of the sides 01, 12, 20 of every triangle."""
        return self._edges_and_sides[1]

    @cached_property
    def edge_lengths(self) -> np.ndarray:
        """(E,) lengths of the edges, metres."""
        a, b = self.edges.T
        return np.linalg.norm(self.vertices[a] - self.vertices[b], axis=1)

    @cached_property
    def edge_use(self) -> np.ndarray:
        """(E,) how many triangles use each edge: 1 at a border, 2 inside, more where it is not manifold."""
        return np.bincount(self.face_edges.ravel(), minlength=len(self.edges))

    @cached_property
    def side_pairs(self) -> np.ndarray:
        """(P, 2) places in `face_edges`, flattened, of the two sides that meet at each edge with two triangles."""
        order = np.argsort(self.face_edges.ravel(), kind="stable")
        inner = np.concatenate([[0], np.cumsum(self.edge_use)[:-1]])[self.edge_use == 2]
        return np.stack([order[inner], order[inner + 1]], axis=1)

    @property
    def face_pairs(self) -> np.ndarray:
        """(P, 2) triangles that share an edge, for edges with exactly two triangles."""
        return self.side_pairs // 3

    @cached_property
    def vertex_adjacency(self) -> csr_array:
        """(N, N) sparse adjacency, 1 where an edge joins two vertices."""
        a, b = self.edges.T
        n = len(self.vertices)
        one = np.ones(2 * len(a))
        return csr_array(coo_array((one, (np.r_[a, b], np.r_[b, a])), shape=(n, n)))

    @cached_property
    def is_edge_manifold(self) -> bool:
        """Whether no edge has more than two triangles, and neighbours have the same orientation."""
        half = self.faces * len(self.vertices) + np.roll(self.faces, -1, axis=1)
        in_order = np.sort(half, axis=None)
        return bool((self.edge_use <= 2).all()) and bool((in_order[1:] != in_order[:-1]).all())

    @cached_property
    def corner_fans(self) -> np.ndarray:
        """(F, 3) fan of each corner; corners at a vertex are in the same fan if their triangles are joined by edges."""
        corner = np.arange(self.faces.size).reshape(-1, 3)
        rows = []
        for side in range(3):        # corners of the two triangles at an inner edge that share a vertex
            following = (side + 1) % 3
            swap = self.faces[:, side] > self.faces[:, following]
            low = np.where(swap, corner[:, following], corner[:, side])
            high = np.where(swap, corner[:, side], corner[:, following])
            rows.append(np.stack([self.face_edges[:, side], low, high], axis=1))
        row = np.concatenate(rows)
        row = row[np.argsort(row[:, 0], kind="stable")]
        same = row[1:, 0] == row[:-1, 0]
        a, b = np.r_[row[:-1, 1][same], row[:-1, 2][same]], np.r_[row[1:, 1][same], row[1:, 2][same]]
        return label_components(a, b, self.faces.size).reshape(-1, 3)

    @cached_property
    def is_vertex_manifold(self) -> bool:
        """Whether the triangles around every vertex form one fan."""
        return int(self.corner_fans.max(initial=-1)) + 1 == len(unique_integers(self.faces))

    @cached_property
    def non_manifold_vertices(self) -> np.ndarray:
        """(n,) vertices on an edge that has more than two triangles, or at which separate fans touch, ascending."""
        fan = np.unique(np.stack([self.faces.ravel(), self.corner_fans.ravel()]), axis=1)[0]
        touching = np.flatnonzero(np.bincount(fan, minlength=len(self.vertices)) > 1)
        return unique_integers(np.r_[self.edges[self.edge_use > 2].ravel(), touching])

    @cached_property
    def boundary_vertices(self) -> np.ndarray:
        """(B,) vertices on an edge that has one triangle, ascending."""
        return unique_integers(self.edges[self.edge_use == 1])

    @cached_property
    def boundary_loops(self) -> list[np.ndarray]:
        """Closed simple borders as vertex lists, longest first, in the direction of the triangles' own sides."""
        half = self.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
        border = half[self.edge_use[self.face_edges.ravel()] == 1]
        return sorted(_loops(border), key=len, reverse=True)

    @cached_property
    def is_closed(self) -> bool:
        """Whether every edge has exactly two triangles."""
        return bool(len(self.faces)) and bool((self.edge_use == 2).all())

    @cached_property
    def vertex_component(self) -> np.ndarray:
        """(N,) connected component of each vertex, largest 0; a vertex without triangles is its own component."""
        _, label = connected_components(self.vertex_adjacency, directed=False)
        rank = np.argsort(-np.bincount(label), kind="stable")
        return np.argsort(rank)[label]

    @cached_property
    def volume(self) -> float:
        """Enclosed volume, cubic metres; meaningful for a closed mesh, negative if it is inside out."""
        c = self.corners
        return float(np.einsum("fi,fi->", c[:, 0], np.cross(c[:, 1], c[:, 2])) / 6)

    @cached_property
    def mean_edge(self) -> float:
        """Mean edge length, metres: the resolution of the mesh."""
        return float(self.edge_lengths.mean())

    def submesh(self, keep: np.ndarray) -> tuple[Mesh, np.ndarray]:
        """Return triangles `keep`, (F,) bool or (n,) int, with the vertices they use, and their old indices (n,)."""
        faces = self.faces[keep]
        used, new = np.unique(faces, return_inverse=True)
        colors = None if self.colors is None else self.colors[used]
        return Mesh(self.vertices[used], new.reshape(-1, 3), colors), used

    def sample(self, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Draw points (count, 3) evenly over the surface; with their triangles (count,) and barycentric coordinates."""
        face = rng.choice(len(self.faces), count, p=self.face_areas / self.face_areas.sum())
        r = np.sqrt(rng.random(count))
        s = rng.random(count)
        bary = np.stack([1 - r, r * (1 - s), r * s], axis=1)
        return np.einsum("nc,ncd->nd", bary, self.corners[face]), face, bary


def take_mesh(what: Any) -> Any:
    """Return a mesh of trimesh, pyvista or Open3D as `Mesh`, in lists and tuples too; anything else as it is.

    They are known by what they have: vertices and faces, points and faces, or vertices and triangles.
    """
    if type(what) in (list, tuple):
        taken = [take_mesh(part) for part in what]
        return type(what)(taken) if any(a is not b for a, b in zip(taken, what, strict=True)) else what
    if isinstance(what, Mesh | np.ndarray | str | type):
        return what
    points = next((getattr(what, name) for name in ("vertices", "points") if hasattr(what, name)), None)
    faces = next((getattr(what, name) for name in ("faces", "triangles") if hasattr(what, name)), None)
    if points is None or faces is None or callable(points) or callable(faces):
        return what
    if hasattr(what, "triangulate") and np.ndim(faces) == 1:         # pyvista: 3, a, b, c, 3, a, b, c, ...
        faces = np.asarray(what.triangulate().faces).reshape(-1, 4)[:, 1:]
    # colours of the vertices, of Open3D from 0 to 1, of trimesh from 0 to 255
    colors = np.asarray(getattr(what, "vertex_colors", ()), dtype=float)
    if getattr(getattr(what, "visual", None), "kind", None) == "vertex":
        colors = np.asarray(what.visual.vertex_colors)[:, :3] / 255
    return Mesh(np.asarray(points), np.asarray(faces), colors if len(colors) and len(colors) == len(points) else None)


F = TypeVar("F", bound=Callable[..., Any])


def take_any_mesh(function: F) -> F:
    """Decorate a public function, so that it takes meshes of trimesh, pyvista and Open3D where it takes ours."""
    @wraps(function)
    def wrapper(*args: Any, **named: Any) -> Any:
        return function(*take_mesh(args), **{name: take_mesh(value) for name, value in named.items()})

    return cast(F, wrapper)


def template_problem(mesh: Mesh) -> str | None:
    """Explain why a mesh cannot serve as a template; None if it can.

    It must be one connected manifold component, without unused vertices, duplicate or degenerate triangles.
    """
    if not len(mesh.faces):
        return "it has no triangles"
    unused = len(mesh.vertices) - len(unique_integers(mesh.faces))
    if unused:
        return f"{number_of(unused, 'vertex belongs', 'vertices belong')} to no triangle"
    components = mesh.vertex_component.max() + 1
    if components > 1:
        sizes = np.bincount(mesh.vertex_component)
        return f"it has {components} components (of {', '.join(map(str, sizes[:4]))} vertices), expected one"
    if len(np.unique(np.sort(mesh.faces, axis=1), axis=0)) < len(mesh.faces):
        return "some triangles appear twice"
    flat = np.flatnonzero(mesh.face_areas < 1e-12)
    if len(flat):
        return f"{number_of(len(flat), 'triangle has', 'triangles have')} no area, the first is face {flat[0]}"
    if not mesh.is_edge_manifold:
        half = np.sort(mesh.faces * len(mesh.vertices) + np.roll(mesh.faces, -1, axis=1), axis=None)
        first = int(half[1:][half[1:] == half[:-1]][0] // len(mesh.vertices))     # such edges have one direction twice
        return ("it is not manifold: some edges have more than two triangles or triangles facing opposite ways, the "
                f"first at {_place(mesh.vertices[first])}")
    if not mesh.is_vertex_manifold:
        return f"it is not manifold: at some vertices separate sheets touch, the first at " \
               f"{_place(mesh.vertices[mesh.non_manifold_vertices[0]])}"
    return None


def check_template(mesh: Mesh, name: str = "template") -> None:
    """Raise ValueError with the reason if a mesh cannot serve as a template."""
    problem = template_problem(mesh)
    if problem:
        raise ValueError(f"{name}: not usable as a template, {problem}")


def _place(point: np.ndarray) -> str:
    """Return a point in words, which no numbering of vertices changes."""
    return "({:.4g}, {:.4g}, {:.4g}) m".format(*point)


def _unit(v: np.ndarray) -> np.ndarray:
    """Normalise vectors (..., 3); zero stays zero."""
    length = np.linalg.norm(v, axis=-1, keepdims=True)
    return np.divide(v, length, out=np.zeros(v.shape), where=length > 0)


def _loops(border: np.ndarray) -> list[np.ndarray]:
    """Cut directed border edges (n, 2) into simple closed loops."""
    following: dict[int, list[int]] = {}
    for a, b in border.tolist():
        following.setdefault(a, []).append(b)
    loops = []
    while following:
        path = [next(iter(following))]
        place = {path[0]: 0}
        while path:
            ahead = following.get(path[-1])
            if not ahead:
                break                # an open end: the mesh is not manifold there
            step = ahead.pop()
            if not ahead:
                del following[path[-1]]
            # a vertex was reached again: the path since then is a simple loop; go on with the rest
            if step in place:
                first = place[step]
                loops.append(np.array(path[first:]))
                for v in path[first + 1:]:
                    del place[v]
                path = path[:first + 1]
                if step not in following:
                    break
            else:
                place[step] = len(path)
                path.append(step)
        for v in path[:-1]:
            if not following.get(v):
                following.pop(v, None)
    return loops


def select_points(scan: Mesh | np.ndarray, kept: np.ndarray) -> Mesh | np.ndarray:
    """Return the kept points (n,) bool of a scan, as a mesh if it was one.

    >>> select_points(np.eye(3), np.array([True, False, True])).shape
    (2, 3)
    """
    if not isinstance(scan, Mesh):
        return np.asarray(scan)[kept]
    if not len(scan.faces):
        return Mesh(scan.vertices[kept], scan.faces, None if scan.colors is None else scan.colors[kept])
    return scan.submesh(kept[scan.faces].all(axis=1))[0]
