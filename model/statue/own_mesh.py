"""The file's own mesh on the skeleton of its statue: vertices, shells and materials as they came, with weights."""
from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from scanprep.console import Metric
from scanprep.geometry import format_glb as glb
from scanprep.geometry.budget import reading, spend
from scanprep.geometry.files import read_scan
from scanprep.geometry.format_common import Contents, MeshFileError, load_bytes, polygons
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.storage import StorageError, check_regular, taking_apart, write_file
from scanprep.geometry.surface import Surface
from scanprep.pictures.textures import load_with_materials

from ..blend_weights import strongest
from ..export.conventions import aim_bones
from ..export.glb import add_animation, add_skin, build_nodes, four_carriers
from ..export.names import Names, rename_bones
from ..motion.retarget import Retargeted
from ..rig import Rig, turn_up
from .control.model import Statue
from .detail.reconstruction import Reconstruction
from .detail.subdivision import subdivide_uniform
from .motion.motions import bind_points

OWN_MESH = "own.glb"
# shares of the figure's height. Welded: vertices that stand closer are one place; seams of files differ by 1e-6.
# Stiff: the extent up to which a part of its own (eye, button, belt, shoe) keeps its shape; a sleeve has 0.25 and more.
# Apart: a larger part whose median distance from the body is more (a staff, a shield) keeps its shape too.
WELDED, STIFF, APART = 1e-5, 0.2, 0.03
SAMPLES = 50_000     # points over the whole surface that tell how far its parts are from the body: 1 cm on a person
DROPPED = ("KHR_draco_mesh_compression",)      # extensions whose arrays are written out plain


class PlacedPrimitive(NamedTuple):
    """A primitive of a glTF file where it stands in the scene."""

    primitive: dict[str, Any]
    tree: dict[str, Any]           # with the accessors of its attributes
    binary: bytes
    motion: np.ndarray             # (n, 4, 4) or (1, 4, 4), from its numbers to the scene, metres

    def bend(self, vectors: np.ndarray, matrices: np.ndarray | None = None) -> np.ndarray:
        """Carry directions (n, 3) along, without the translation, or by other matrices (n, 3, 3)."""
        matrices = self.motion[:, :3, :3] if matrices is None else matrices
        return np.einsum("nab,nb->na", np.broadcast_to(matrices, (len(vectors), 3, 3)), vectors)

    def read(self, name: str) -> np.ndarray:
        """Read an attribute (n, width); positions in metres, normals and tangents as they are in the scene."""
        values = glb.accessor(self.tree, self.binary, self.primitive["attributes"][name],
                              "SCALAR", "VEC2", "VEC3", "VEC4").astype(float)
        side = -1.0 if self.mirrored else 1.0
        if name == "POSITION":
            return self.bend(values) + self.motion[:, :3, 3]
        if name == "NORMAL":                      # by the cofactors, which have no division where a scale is zero
            x, y, z = np.moveaxis(self.motion[:, :3, :3], 1, 0)
            cofactors = np.stack([np.cross(y, z), np.cross(z, x), np.cross(x, y)], axis=1)
            return unit(self.bend(values, side * cofactors))
        return np.column_stack([unit(self.bend(values[:, :3])), side * values[:, 3]]) if name == "TANGENT" else values

    @property
    def mirrored(self) -> bool:
        """Whether its triangles are turned over in the scene."""
        return bool(np.linalg.det(self.motion[0, :3, :3]) < 0)

    @property
    def triangles(self) -> np.ndarray:
        """(F, 3), outward in the scene."""
        faces = glb.primitive_triangles(self.tree, self.binary, self.primitive, len(self.read("POSITION")))
        return faces[:, ::-1] if self.mirrored else faces


Shapes = list[tuple[dict[str, Any], list[PlacedPrimitive]]]      # nodes with a mesh, and its primitives


def unit(vectors: np.ndarray) -> np.ndarray:
    """Scale vectors (n, 3) to length 1; zeros point along z, since glTF allows no zero normal."""
    size = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.where(size > 0, vectors / np.maximum(size, 1e-300), [0.0, 0, 1])


def write_own_mesh(path: Path, source: Path, metres: float, statue: Statue, names: Names | None = None) -> list[Metric]:
    """Write the mesh of a scan's file on the skeleton of its statue, with the materials of the file, as GLB.

    Vertices keep their places, times `metres` for a unit of the file. An old skin and old animations are replaced.
    Every vertex takes the blend weights of the finished surface where that is nearest and faces the same way; see
    `carry_weights` for what hangs loose.

    Parameters
    ----------
    path : Path
        `.glb` to write.
    source : Path
        Any mesh file; of glTF and OBJ the materials are kept.
    metres : float
        For a unit of the file.
    statue : Statue
        Fitted to that file.
    names : str, optional
        Whose names the bones have, as in `rename_bones`.

    Returns
    -------
    list of Metric
        What was written.

    Raises
    ------
    ValueError
        A file without triangles.
    """
    # 1. the pieces of the file in the axes of glTF
    tree, binary, up, shapes = read_pieces(source, statue.upright_axis, metres)
    pieces = [piece for _, own in shapes for piece in own]
    # 2. weights of all vertices, of which those at one place have the same
    starts = np.cumsum([0, *(len(piece.read("POSITION")) for piece in pieces)])
    faces = np.concatenate([piece.triangles + start for piece, start in zip(pieces, starts, strict=False)])
    points = np.concatenate([piece.read("POSITION") for piece in pieces])
    weights, loose = carry_weights(statue, Mesh(points @ turn_up(up), faces))
    # 3. meshes with new attributes on our joints; the rest of the file stays
    arrays, rig = glb.Glb(tree, binary), own_rig(statue, names).with_up(up)
    joints, (meshes, shown) = build_nodes(rig)[1:], add_meshes(arrays, tree, binary, shapes, weights)
    J = len(joints)
    document: dict[str, Any] = {
        # the joints are nodes 1 to J, as `add_skin` numbers them, so the first mesh stands before them
        "scene": 0, "scenes": [{"nodes": [0, 1, *range(J + 1, J + len(shown))]}],
        "nodes": [shown[0], *joints, *shown[1:]], "meshes": meshes, "skins": [add_skin(arrays, rig)],
        "images": [embed_image(arrays, source, image) for image in tree.get("images", [])],
        **{key: [name for name in tree.get(key, []) if name not in DROPPED]
           for key in ("extensionsUsed", "extensionsRequired")},
        **{key: tree[key] for key in ("asset", "materials", "textures", "samplers", "extras") if key in tree},
        # others, as that of VRM, refer to nodes that are replaced
        "extensions": {key: value for key, value in tree.get("extensions", {}).items() if key.startswith("KHR_")}}
    write_file(path, arrays.pack({key: value for key, value in document.items() if value not in ([], {})}, up))
    targets = sum(len(piece.primitive.get("targets", [])) for piece in pieces)
    return [Metric("own mesh, vertices", len(points)), Metric("own mesh, loose parts that stay stiff", loose),
            *([Metric("own mesh, morph targets kept", targets)] if targets else [])]


def read_pieces(source: Path, upright: int, metres: float) -> tuple[dict[str, Any], bytes, int, Shapes]:
    """Read any mesh file as glTF: its tree and buffer, the axis that was turned to y, and its surface in metres.

    `upright` is the axis of the file that points up, unless the file is glTF. MeshFileError for one that is damaged or
    has no triangles.
    """
    check_regular(source, MeshFileError)
    with reading(source, MeshFileError), taking_apart(source, "a whole mesh file", MeshFileError):
        tree, binary = read_as_gltf(source)
        up = glb.up_of(tree) if source.suffix.lower() in (".glb", ".gltf") else upright
        frame = np.diag([metres] * 3 + [1.0])
        frame[:3, :3] = metres * turn_up(up) @ turn_up(glb.up_of(tree)).T
        shapes = place_pieces(tree, binary, frame)
        # all of it is read before the fit, which takes minutes
        for piece in (piece for _, pieces in shapes for piece in pieces):
            polygons(source, np.full(len(piece.triangles), 3), piece.triangles.ravel(), len(piece.read("POSITION")))
            rewrite(glb.Glb(), tree, binary, piece, np.ones((len(piece.read("POSITION")), 1)))
        for image in tree.get("images", []):
            embed_image(glb.Glb(), source, image)
    if not shapes:
        raise MeshFileError(f"{source}: expected triangles for --own-mesh, found none; leave it out")
    return tree, binary, up, shapes


def add_meshes(arrays: glb.Glb, tree: dict[str, Any], binary: bytes, shapes: Shapes,
               weights: np.ndarray) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Add the meshes of a file with the weights (n, J) of all their vertices; their entries, and nodes that show them.
    """
    meshes, nodes, start = list[dict[str, Any]](), list[dict[str, Any]](), 0
    for node, pieces in shapes:
        primitives = []
        for piece in pieces:
            end = start + len(piece.read("POSITION"))
            primitives.append(rewrite(arrays, tree, binary, piece, weights[start:end]))
            start = end
        nodes.append({**{key: node[key] for key in ("name", "weights", "extras") if key in node},
                      "mesh": len(meshes), "skin": 0})
        mesh = tree["meshes"][node["mesh"]]
        meshes.append({**{key: mesh[key] for key in ("name", "weights", "extras") if key in mesh},
                       "primitives": primitives})
    return meshes, nodes


def animate_own_mesh(path: Path, stored: Path, statue: Statue, motion: Retargeted, names: Names | None = None) -> None:
    """Write the own mesh of a statue with a motion; StorageError where the statue has none, or that of another fit."""
    again = "run scape statue fit with --own-mesh again"
    if not stored.is_file():
        raise StorageError(f"{stored}: the statue has no mesh of its file; {again}")
    with reading(stored, StorageError):
        tree, binary = glb.read_tree(stored, load_bytes(stored))
    up = glb.up_of(tree)
    rig, arrays = own_rig(statue, names).with_up(up), glb.Glb(tree, binary)
    joints = build_nodes(rig)[1:]
    before = [node.get("translation") for node in tree["nodes"][1:len(joints) + 1]]
    same = len(before) == len(joints) and None not in before
    if not same or not np.allclose(before, [node["translation"] for node in joints], atol=1e-6):
        raise StorageError(f"{stored}: it is of another fit than the rest of the folder; {again}")
    for node, joint in zip(tree["nodes"][1:], joints, strict=False):
        node["name"] = joint["name"] if names else node["name"]
    U = turn_up(up).T
    tree["animations"] = [add_animation(arrays, rig, motion.poses @ U, motion.trans @ U, motion.rate, 0)]
    write_file(path, arrays.pack(tree, up))


def own_rig(statue: Statue, names: Names | None) -> Rig:
    """Build the rig of a statue's control mesh with bones along the limbs, under the names of another program."""
    rig = aim_bones(statue.control.rig, statue.upright_axis)
    return rig if names is None else rename_bones(rig, names)


def read_as_gltf(path: Path) -> tuple[dict[str, Any], bytes]:
    """Read any mesh file as a glTF tree and its buffer; numbers are those of the file."""
    if path.suffix.lower() in (".glb", ".gltf"):
        return glb.read_tree(path, load_bytes(path))
    if path.suffix.lower() == ".obj":
        data = load_with_materials(path, "load_scene")[0].export(file_type="glb")
    else:
        mesh = read_scan(path, "m")
        if not isinstance(mesh, Mesh):
            raise MeshFileError(f"{path}: expected triangles for --own-mesh, found points; leave it out")
        data = glb.encode(Contents(mesh.vertices, mesh.faces, None, mesh.colors), False)
    return glb.chunks_of(path, data)


def place_pieces(tree: dict[str, Any], binary: bytes, frame: np.ndarray) -> Shapes:
    """List the nodes with a mesh, and their primitives of triangles as they stand in the scene, turned by a frame."""
    nodes = [(number, node, frame @ matrix) for number, node, matrix in glb.nodes_of(tree)]
    places, out = {number: matrix for number, _, matrix in nodes}, []
    for _, node, matrix in nodes:
        if "mesh" not in node:
            continue
        joints = (glb.joint_matrices(tree, binary, glb.item(tree["skins"], node["skin"]), places)
                  if "skin" in node else None)
        pieces = []
        for primitive in glb.item(tree["meshes"], node["mesh"])["primitives"]:
            if primitive.get("mode", 4) not in (4, 5, 6):             # triangles, strips, fans
                continue
            spend(visits=1)
            motion = matrix[None]
            if joints is not None and "JOINTS_0" in primitive["attributes"]:
                weights = glb.weights_of(tree, binary, primitive, len(joints))
                spend(memory=128 * len(weights))
                motion = np.einsum("nj,jab->nab", weights, joints)
            pieces.append(PlacedPrimitive(primitive, tree, binary, motion))
        out += [(node, pieces)] if pieces else []
    return out


def rewrite(arrays: glb.Glb, tree: dict[str, Any], binary: bytes, piece: PlacedPrimitive, weights: np.ndarray
            ) -> dict[str, Any]:
    """Add a piece's surface as it stands, with blend weights (n, J); all else of its primitive stays."""
    primitive, attributes = piece.primitive, dict[str, int]()
    for name, number in primitive["attributes"].items():
        if not name.startswith(("JOINTS_", "WEIGHTS_")):
            attributes[name] = arrays.add(piece.read(name), piece.tree["accessors"][number]["type"], glb.VERTICES,
                                          bounds=name == "POSITION")
    joints, shares = four_carriers(weights)
    attributes |= {"JOINTS_0": arrays.add_joints(joints), "WEIGHTS_0": arrays.add(shares, "VEC4", glb.VERTICES)}
    out = {key: value for key, value in primitive.items() if key not in ("mode", "targets", "indices")}
    extensions = {key: value for key, value in primitive.get("extensions", {}).items() if key not in DROPPED}
    out |= {"attributes": attributes, "indices": arrays.add_indices(piece.triangles), "extensions": extensions}
    targets = [{name: arrays.add(piece.bend(glb.accessor(tree, binary, number, "VEC3").astype(float)), "VEC3",
                                 glb.VERTICES, bounds=name == "POSITION")
                for name, number in target.items() if name in ("POSITION", "NORMAL", "TANGENT")}
               for target in primitive.get("targets", [])]
    return {key: value for key, value in {**out, "targets": targets}.items() if value not in ([], {})}


def embed_image(arrays: glb.Glb, source: Path, image: dict[str, Any]) -> dict[str, Any]:
    """Take a picture that lies beside the file into the file; others are returned as they are."""
    name = str(image.get("uri", "data:"))
    if name.startswith("data:"):
        return image
    kind = "image/png" if name.lower().endswith(".png") else "image/jpeg"
    added = arrays.add_png(load_bytes(glb.file_beside(source, name)), name)
    return {**{key: value for key, value in image.items() if key != "uri"}, **added, "mimeType": kind}


def carry_weights(statue: Statue, mesh: Mesh) -> tuple[np.ndarray, int]:
    """Carry the blend weights of a statue over to another mesh of the same figure, and count its stiff parts.

    Parts of their own that are small, or lie off the body, have one set of weights: the mean where they are nearest to
    the body. So eyes, teeth, buttons, belts and staffs keep their shape.

    Parameters
    ----------
    statue : Statue
        Fitted to the figure.
    mesh : Mesh, metres
        n vertices in the axes of the statue, which may be repeated along seams.

    Returns
    -------
    tuple
        Weights (n, J), at most four a vertex, and the number of stiff parts.
    """
    # the finished surface at 16 triangles for one of the control mesh, about 8 mm long
    control = statue.control
    fine = subdivide_uniform(control.mesh, control.chart, 2)
    body = Reconstruction(control, statue.map, fine).mesh()
    height = float(np.ptp(body.vertices[:, statue.upright_axis]))
    _, first, place = np.unique(np.round(mesh.vertices / (WELDED * height)), axis=0, return_index=True,
                                return_inverse=True)
    welded = Mesh(mesh.vertices[first], place.reshape(-1)[mesh.faces])
    shell = welded.vertex_component
    carried = np.einsum("nc,ncj->nj", fine.bary, control.weights[control.mesh.faces[fine.parent]])
    weights = bind_points(welded, body, APART * height) @ carried
    # extent of every connected part, and its median distance from the body, at vertices and evenly over the surface
    points, faces, _ = welded.sample(SAMPLES, np.random.default_rng(0))
    points, owner = np.vstack([welded.vertices, points]), np.r_[shell, shell[welded.faces[faces, 0]]]
    close = Surface(body).closest(points)
    order = np.lexsort((close.distances, owner))
    count = np.bincount(owner)
    start = np.r_[0, np.cumsum(count)[:-1]]
    extent = (np.maximum.reduceat(points[order], start) - np.minimum.reduceat(points[order], start)).max(axis=1)
    stiff = (extent < STIFF * height) | (close.distances[order][start + count // 2] > APART * height)
    stiff[np.argmax(extent)] = False
    # the mean over the tenth of its points that is nearest to the body, and there to the part that carries most
    near = order[np.arange(len(order)) - start[owner[order]] <= count[owner[order]] // 10]
    near = near[stiff[owner[near]]]
    shares = np.einsum("nc,ncj->nj", close.bary[near], carried[body.faces[close.faces[near]]])
    carrier, votes, mean = shares.argmax(axis=1), *np.zeros((2, len(count), weights.shape[1]))
    np.add.at(votes, (owner[near], carrier), 1)
    most = carrier == votes.argmax(axis=1)[owner[near]]
    np.add.at(mean, owner[near[most]], shares[most])
    mean /= np.maximum(mean.sum(axis=1, keepdims=True), 1e-12)
    weights = np.where(stiff[shell][:, None], mean[shell], weights)
    return strongest(weights)[place.reshape(-1)], int(stiff.sum())
