"""How the triangulation that all synthetic people share is made: done once, its result is stored in the package.

One half of the canonical body is polygonised, remeshed evenly, and mirrored. `python tests/people_maker.py` makes the
file anew, in two minutes.
"""
from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from polygonise import polygonise

from scanprep.geometry import storage
from scanprep.geometry.mesh import Mesh
from scanprep.synthetic.anatomy import Anatomy
from scanprep.synthetic.body_parts import arm, body_surface, hand, trunk
from scanprep.synthetic.implicit_surface import Field, project
from scanprep.synthetic.topology import CANONICAL, STORED, VERSION, Template

Sizing = Callable[[np.ndarray], np.ndarray]


def sizing(anatomy: Anatomy) -> Sizing:
    """Wanted edge length in metres at points (n, 3): fine on face, ears, hands and toes."""
    hand = anatomy.joints[6] + 0.6 * (anatomy.ends[6] - anatomy.joints[6])
    foot = anatomy.joints[12] + 0.75 * anatomy.width["foot"] * anatomy.foot_frame[2] * [1, 1, 0]
    foot[2] = 0.01
    face = anatomy.eye + np.array([0, -0.095, -0.035])
    ear = anatomy.eye + np.array([0.08, 0.008, -0.01])
    spots = [(hand, 0.0068, 0.09), (foot, 0.0085, 0.05), (face, 0.0062, 0.05), (anatomy.eye, 0.0110, 0.12),
             (ear, 0.0055, 0.036)]

    def size(points: np.ndarray) -> np.ndarray:
        wanted = np.full(len(points), 0.0235)
        for centre, fine, radius in spots:
            folded = np.abs(points[:, :1]) if centre[0] > 0 else points[:, :1]
            d = np.linalg.norm(np.hstack([folded, points[:, 1:]]) - centre, axis=1)
            wanted = np.minimum(wanted, fine + 0.16 * np.maximum(d - radius, 0))
        return wanted

    return size


def build(step: float = 0.0035) -> Template:
    """Polygonise and remesh the canonical body from scratch (about two minutes)."""
    anatomy = Anatomy(CANONICAL)
    field = body_surface(anatomy)
    high = np.array([anatomy.ends[6, 0] + 0.08, 0.22, CANONICAL.stature + 0.03])
    half = polygonise(field, np.array([0.0, -0.30, -0.02]), high, step)
    keep = half.vertex_component[half.faces[:, 0]] == 0
    half = remesh(half.submesh(keep)[0], field, sizing(anatomy))
    mesh, twin = mirror(half)
    order = np.lexsort((np.round(mesh.vertices[:, 0], 4), np.round(mesh.vertices[:, 2], 3)))
    place = np.argsort(order)
    mesh = Mesh(mesh.vertices[order], place[mesh.faces])
    return Template(mesh, place[twin[order]], label_faces(mesh, anatomy), anatomy)


def store(template: Template, path: Path = STORED) -> None:
    """Keep a built template beside the code."""
    storage.save(path, "people template", VERSION, {
        "vertices": np.round(template.mesh.vertices * 1e5).astype(np.int32),
        "mirror": template.mirror.astype(np.uint16), "part_of_face": template.part_of_face.astype(np.uint8),
        "faces": template.mesh.faces.astype(np.uint16)})


def label_faces(mesh: Mesh, anatomy: Anatomy) -> np.ndarray:
    """Part of every triangle (F,): cut by a plane through each joint, across the surface only."""
    c = mesh.corners.mean(axis=1)
    j = anatomy.joints
    part = np.zeros(len(c), dtype=np.int64)

    def beyond(joint: int, normal: np.ndarray) -> np.ndarray:
        return (c - j[joint]) @ normal > 0

    folded = np.abs(c * [1, 0, 0]) + c * [0, 1, 1]
    of_arm = np.minimum(arm(anatomy)(folded), hand(anatomy)(folded)) < 0.02
    of_arm &= trunk(anatomy)[0][0][0](c) > 0.012 * anatomy.scale
    part[c[:, 2] > j[1, 2]] = 1
    part[c[:, 2] > j[2, 2]] = 2
    neck = np.array([0, -0.35, 1.0])
    part[beyond(3, neck / np.linalg.norm(neck)) & (np.abs(c[:, 0]) < 0.12)] = 3
    for side, upper, leg in ((1, 4, 10), (-1, 7, 13)):
        flip = np.array([side, 1, 1])
        up = flip * anatomy.upper_arm_frame[2]
        out = up * 0.75 + 0.66 * np.array([side, 0, 0.25])
        armpit = j[upper] + 0.012 * anatomy.scale * flip * [-1, 0, 0]
        mine = ((c - armpit) @ out > 0) & (c[:, 0] * side > 0.10 * anatomy.scale) & of_arm
        fore = up + flip * anatomy.forearm_frame[2]
        part[mine] = upper
        part[mine & beyond(upper + 1, fore)] = upper + 1
        part[mine & beyond(upper + 2, flip * anatomy.forearm_frame[2])] = upper + 2
        cut = np.array([0.72 * side, -0.0, -1.0])
        top = j[leg] + np.array([0.0, 0, -0.012 * anatomy.scale])
        mine = ((c - top) @ cut > 0) & (c[:, 0] * side > 0) & (c[:, 2] < j[0, 2] + 0.02) & (part < 3)
        part[mine] = leg
        part[mine & (c[:, 2] < j[leg + 1, 2])] = leg + 1
        heel = np.array([0, -0.5, -1.0])
        part[mine & beyond(leg + 2, heel)] = leg + 2
    return part


def remesh(mesh: Mesh, field: Field, sizing: Sizing, rounds: int = 12) -> Mesh:
    """Even triangles with edges of length `sizing` on the zero surface of a field.

    Borders must lie in the plane x = 0 and stay there. Split, collapse, flip and tangential smoothing in
    turns, in the manner of Botsch and Kobbelt.
    """
    vertices, faces = mesh.vertices.copy(), mesh.faces.copy()
    vertices[mesh.boundary_vertices, 0] = 0
    vertices, faces = _collapse(vertices, faces, sizing, 10)
    for _ in range(rounds):
        vertices, faces = _split(vertices, faces, sizing)
        vertices, faces = _collapse(vertices, faces, sizing)
        faces = _flip(vertices, faces)
        for _ in range(2):
            vertices = _relax(vertices, faces, field, sizing)
    return Mesh(vertices, faces)


def mirror(half: Mesh) -> tuple[Mesh, np.ndarray]:
    """A half body (x >= 0, its border at x = 0) and its mirror image as one mesh."""
    n = len(half.vertices)
    middle = np.zeros(n, dtype=bool)
    middle[half.boundary_vertices] = True
    twin = np.arange(n)
    twin[~middle] = n + np.arange((~middle).sum())
    other = half.vertices[~middle] * [-1, 1, 1]
    mesh = Mesh(np.vstack([half.vertices, other]), np.vstack([half.faces, twin[half.faces][:, ::-1]]))
    return mesh, np.r_[twin, np.flatnonzero(~middle)]


def _lengths(vertices: np.ndarray, edges: np.ndarray, sizing: Sizing) -> np.ndarray:
    a, b = vertices[edges[:, 0]], vertices[edges[:, 1]]
    return np.linalg.norm(a - b, axis=1) / sizing(0.5 * (a + b))


def _split(vertices: np.ndarray, faces: np.ndarray, sizing: Sizing) -> tuple[np.ndarray, np.ndarray]:
    for _ in range(3):
        mesh = Mesh(vertices, faces)
        length = _lengths(vertices, mesh.edges, sizing)
        best = length[mesh.face_edges].max(axis=1)
        longest = mesh.face_edges[np.arange(len(faces)), length[mesh.face_edges].argmax(axis=1)]
        count = np.bincount(longest[best > 4 / 3], minlength=len(length))
        chosen = (length > 4 / 3) & (count == mesh.edge_use)         # the longest side of all its triangles
        if not chosen.any():
            break
        number = np.full(len(length), -1)
        number[chosen] = len(vertices) + np.arange(chosen.sum())
        a, b = mesh.edges[chosen].T
        vertices = np.vstack([vertices, 0.5 * (vertices[a] + vertices[b])])
        new = number[longest]
        cut = new >= 0
        side = (mesh.face_edges == longest[:, None]).argmax(axis=1)
        p, q, r = (faces[np.arange(len(faces)), (side + k) % 3] for k in range(3))
        faces = np.vstack([faces[~cut], np.stack([p, new, r], 1)[cut], np.stack([new, q, r], 1)[cut]])
    return vertices, faces


def _collapse(vertices: np.ndarray, faces: np.ndarray, sizing: Sizing, passes: int = 3) -> tuple[np.ndarray,
                                                                                                 np.ndarray]:
    for _ in range(passes):
        mesh = Mesh(vertices, faces)
        length = _lengths(vertices, mesh.edges, sizing)
        border = np.zeros(len(vertices), dtype=bool)
        border[mesh.boundary_vertices] = True
        adjacency = mesh.vertex_adjacency
        valence = np.diff(adjacency.indptr)
        neighbours = np.split(adjacency.indices, adjacency.indptr[1:-1])
        locked = np.zeros(len(vertices), dtype=bool)
        onto = np.arange(len(vertices))
        moved = vertices.copy()
        order = np.flatnonzero(length < 4 / 5)
        for e in order[np.argsort(length[order], kind="stable")]:
            a, b = mesh.edges[e]
            if border[b] and not border[a]:
                a, b = b, a
            rings = np.concatenate([neighbours[a], neighbours[b]])
            if locked[rings].any() or (border[b] and mesh.edge_use[e] == 2):
                continue
            common = np.intersect1d(neighbours[a], neighbours[b])
            if len(common) != mesh.edge_use[e] or valence[common].min() <= 3 + (~border[common]).any():
                continue
            middle = vertices[a] if border[a] and not border[b] else 0.5 * (vertices[a] + vertices[b])
            far = np.linalg.norm(vertices[rings] - middle, axis=1) / sizing(middle[None])
            if far.max() > 4 / 3:
                continue
            moved[a], onto[b] = middle, a
            locked[rings] = True
        faces = onto[faces]
        faces = faces[(faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])]
        if len(faces) == len(mesh.faces):
            break
        used, new = np.unique(faces, return_inverse=True)
        vertices, faces = moved[used], new.reshape(-1, 3)
    return vertices, faces


def _flip(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    for _ in range(2):
        mesh = Mesh(vertices, faces)
        border = np.zeros(len(vertices), dtype=bool)
        border[mesh.boundary_vertices] = True
        valence = np.diff(mesh.vertex_adjacency.indptr)
        excess = valence - np.where(border, 4, 6)
        joined = {(int(a), int(b)) for a, b in mesh.edges}
        faces = faces.copy()
        locked = np.zeros(len(faces), dtype=bool)
        normals = mesh.face_normals
        for f, g in mesh.face_pairs:
            if locked[f] or locked[g] or normals[f] @ normals[g] < 0.6:
                continue
            P, Q = faces[f].tolist(), faces[g].tolist()
            c = next(v for v in P if v not in Q)
            d = next(v for v in Q if v not in P)
            k = P.index(c)
            a, b = P[(k + 1) % 3], P[(k + 2) % 3]
            ends = excess[[a, b, c, d]]
            after = ends + [-1, -1, 1, 1]
            if (after**2).sum() >= (ends**2).sum() or (min(c, d), max(c, d)) in joined:
                continue
            new = np.array([[c, a, d], [c, d, b]])
            corner = vertices[new]
            n = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
            if (n @ (normals[f] + normals[g]) <= 0).any() or np.einsum("i,i->", n[0], n[1]) <= 0:
                continue
            faces[f], faces[g] = new
            joined.add((min(c, d), max(c, d)))
            joined.discard((min(a, b), max(a, b)))
            excess[[a, b, c, d]] = after
            locked[[f, g]] = True
    return faces


def _relax(vertices: np.ndarray, faces: np.ndarray, field: Field, sizing: Sizing) -> np.ndarray:
    mesh = Mesh(vertices, faces)
    border = mesh.boundary_vertices
    weight = mesh.face_areas / sizing(mesh.corners.mean(axis=1))**2      # sizes even out as wished
    total, amount = np.zeros_like(vertices), np.zeros(len(vertices))
    for corner in range(3):
        np.add.at(total, faces[:, corner], weight[:, None] * mesh.corners.mean(axis=1))
        np.add.at(amount, faces[:, corner], weight)
    step = total / amount[:, None] - vertices
    loops = mesh.boundary_loops
    for loop in loops:
        step[loop] = 0.5 * (vertices[np.roll(loop, 1)] + vertices[np.roll(loop, -1)]) - vertices[loop]
    n = mesh.vertex_normals
    step -= np.einsum("nd,nd->n", step, n)[:, None] * n
    moved = vertices + 0.6 * step
    moved[border, 0] = 0
    moved = project(field, moved, 2, 0.004)
    moved[border, 0] = 0
    return moved


if __name__ == "__main__":
    store(build())
