"""The little of glTF that is needed to read back what was written, and to show it as a viewer would."""
import json
import struct

import numpy as np

from scanprep.geometry import rotations

WIDTH = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
NUMBERS = {5126: "<f4", 5125: "<u4", 5123: "<u2", 5121: "u1"}


class Glb:
    """A binary glTF file; `primitive` and what is skinned by it are those of its first mesh."""

    def __init__(self, data):
        magic, version, size = struct.unpack("<4sII", data[:12])
        assert (magic, version, size) == (b"glTF", 2, len(data))
        length, kind = struct.unpack("<I4s", data[12:20])
        assert kind == b"JSON" and length % 4 == 0
        self.json = json.loads(data[20:20 + length])
        rest = data[20 + length:]
        length, kind = struct.unpack("<I4s", rest[:8])
        assert kind == b"BIN\0" and length == len(rest) - 8 and length % 4 == 0
        self.buffer = rest[8:]

    def array(self, number):
        accessor = self.json["accessors"][number]
        view = self.json["bufferViews"][accessor["bufferView"]]
        dtype, width = np.dtype(NUMBERS[accessor["componentType"]]), WIDTH[accessor["type"]]
        start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        assert start % 4 == 0
        steps = view.get("byteStride", dtype.itemsize * width), dtype.itemsize
        values = np.ndarray((accessor["count"], width), dtype, self.buffer, start, steps)
        if "min" in accessor:
            assert np.array_equal(values.min(axis=0), np.float32(accessor["min"]))
            assert np.array_equal(values.max(axis=0), np.float32(accessor["max"]))
        return values

    @property
    def primitive(self):
        return self.json["meshes"][0]["primitives"][0]

    @property
    def bones(self):
        return [self.json["nodes"][number]["name"] for number in self.json["skins"][0]["joints"]]

    @property
    def faces(self):
        return self.array(self.primitive["indices"]).reshape(-1, 3)

    def morphed(self, weights, name="POSITION", primitive=None):
        """An attribute with the morph targets added, double precision."""
        primitive = primitive or self.primitive
        out = self.array(primitive["attributes"][name]).astype(float)
        for w, target in zip(weights, primitive.get("targets", []), strict=True):
            out += w * self.array(target[name])
        return out

    def moved(self, frame=None):
        """(node -> local translation and rotation matrix, morph weights) at rest or at a key frame."""
        local = {i: [np.array(node.get("translation", (0, 0, 0)), float), turn(node.get("rotation", (0, 0, 0, 1)))]
                 for i, node in enumerate(self.json["nodes"])}
        weights = np.array(self.json["meshes"][0].get("weights", []), float)
        if frame is not None:
            (animation,) = self.json["animations"]
            for channel in animation["channels"]:
                target, sampler = channel["target"], animation["samplers"][channel["sampler"]]
                values = self.array(sampler["output"])
                if target["path"] == "weights":                    # may have keys of its own
                    time = self.array(animation["samplers"][0]["input"])[frame, 0]
                    keys = self.array(sampler["input"])[:, 0]
                    weights = np.array([np.interp(time, keys, w) for w in values.reshape(len(keys), -1).T])
                elif target["path"] == "translation":
                    local[target["node"]][0] = values[frame].astype(float)
                else:
                    local[target["node"]][1] = turn(values[frame])
        return local, weights

    def matrices(self, frame=None):
        """(node -> world matrix) at rest or at a key frame."""
        local, _ = self.moved(frame)
        out = {}
        waiting = [(node, np.eye(4)) for node in self.json["scenes"][0]["nodes"]]
        while waiting:
            node, above = waiting.pop()
            mine = np.eye(4)
            mine[:3, :3], mine[:3, 3] = local[node][1], local[node][0]
            assert node not in out, "every node hangs on one other"
            out[node] = above @ mine
            waiting += [(child, out[node]) for child in self.json["nodes"][node].get("children", [])]
        return out

    def vertices(self, frame=None):
        """Vertices (N, 3) of every primitive, without morph targets."""
        return [self.skinned(frame, [0] * len(primitive.get("targets", [])), primitive)
                for node in self.json["nodes"] if "mesh" in node
                for primitive in self.json["meshes"][node["mesh"]]["primitives"]]

    def skinned(self, frame=None, weights=None, primitive=None):
        """Vertices (N, 3) of the skinned mesh at rest or at a key frame, as the specification says."""
        world, primitive = self.matrices(frame), primitive or self.primitive
        if weights is None:
            weights = self.moved(frame)[1]
        skin = self.json["skins"][0]
        inverse = self.array(skin["inverseBindMatrices"]).reshape(-1, 4, 4).transpose(0, 2, 1)
        carry = np.stack([world[node] for node in skin["joints"]]) @ inverse
        attributes = primitive["attributes"]
        joints, shares = self.array(attributes["JOINTS_0"]), self.array(attributes["WEIGHTS_0"])
        points = self.morphed(weights, primitive=primitive)
        out = np.zeros_like(points)
        for k in range(4):
            M = carry[joints[:, k]]
            out += shares[:, k, None] * (np.einsum("nij,nj->ni", M[:, :3, :3], points) + M[:, :3, 3])
        return out


def turn(quaternion):
    x, y, z, w = np.asarray(quaternion, float)
    axis = np.array([x, y, z])
    size = np.linalg.norm(axis)
    assert abs(size**2 + w**2 - 1) < 1e-5
    return rotations.exp(2 * np.arctan2(size, w) * axis / max(size, 1e-12))
