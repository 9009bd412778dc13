"""A reader of skinned and animated GLB files of its own, so that what is written is not read by what wrote it."""
import json
import struct

import numpy as np
from scipy.spatial.transform import Rotation

SIZES = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
KINDS = {5121: "u1", 5123: "<u2", 5125: "<u4", 5126: "<f4"}


class SkinnedFile:
    """The tree of a GLB file and its numbers."""

    def __init__(self, path):
        data = path.read_bytes()
        size = struct.unpack_from("<I", data, 12)[0]
        self.tree, self.buffer = json.loads(data[20:20 + size]), data[28 + size:]

    def array(self, number):
        entry = self.tree["accessors"][number]
        view, width = self.tree["bufferViews"][entry["bufferView"]], SIZES[entry["type"]]
        kind = np.dtype(KINDS[entry["componentType"]])
        start = view.get("byteOffset", 0) + entry.get("byteOffset", 0)
        return np.ndarray((entry["count"], width), kind, self.buffer, start,
                          (view.get("byteStride", kind.itemsize * width), kind.itemsize))

    @property
    def bones(self):
        return [self.tree["nodes"][number]["name"] for number in self.tree["skins"][0]["joints"]]

    def local(self, frame):
        """Local matrices of all nodes, at rest without a frame."""
        channels = {}
        for animation in self.tree.get("animations", []) if frame is not None else []:
            for channel in animation["channels"]:
                sampler = animation["samplers"][channel["sampler"]]
                values = self.array(sampler["output"])
                channels[channel["target"]["node"], channel["target"]["path"]] = values[frame % len(values)]
        out = []
        for number, node in enumerate(self.tree["nodes"]):
            matrix = np.eye(4)
            turn = channels.get((number, "rotation"), node.get("rotation", [0, 0, 0, 1]))
            matrix[:3, :3] = Rotation.from_quat(turn).as_matrix() * node.get("scale", [1, 1, 1])
            matrix[:3, 3] = channels.get((number, "translation"), node.get("translation", [0, 0, 0]))
            out.append(matrix)
        return out

    def vertices(self, frame=None):
        """Vertices of every primitive, skinned by their joints as the specification says."""
        matrices, skin = self.local(frame), self.tree["skins"][0]
        above = {child: k for k, node in enumerate(self.tree["nodes"]) for child in node.get("children", [])}

        def world(number):
            return world(above[number]) @ matrices[number] if number in above else matrices[number]

        bind = self.array(skin["inverseBindMatrices"]).reshape(-1, 4, 4).swapaxes(1, 2)
        motion = np.stack([world(number) for number in skin["joints"]]) @ bind
        out = []
        for node in self.tree["nodes"]:
            for primitive in self.tree["meshes"][node["mesh"]]["primitives"] if "mesh" in node else []:
                attributes = primitive["attributes"]
                points = np.column_stack([self.array(attributes["POSITION"]), np.ones(len(self.array(
                    attributes["POSITION"])))])
                moved = np.einsum("nk,nkab,nb->na", self.array(attributes["WEIGHTS_0"]),
                                  motion[self.array(attributes["JOINTS_0"])], points)
                out.append(moved[:, :3])
        return out

    def triangles(self):
        """Triangles of every primitive."""
        return [self.array(primitive["indices"]).reshape(-1, 3).astype(int) for node in self.tree["nodes"]
                if "mesh" in node for primitive in self.tree["meshes"][node["mesh"]]["primitives"]]
