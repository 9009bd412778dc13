"""Small bodies in the layout of the files of MHR and SOMA-X, as the library `body-models` 0.26 reads them.

The real files cannot be had here, so nothing of these bodies is theirs but the layout, and what joints are called: a
mesh of the built-in people, joints with axes of their own, some that twist by shares of others, bones that change their
length, and random pose correctives of two layers. Lengths in the files are centimetres.
"""
from __future__ import annotations

import io
import pickle
import sys
import types
import zipfile
from functools import cache
from pathlib import Path
from unittest import mock

import numpy as np
from published_bodies import synthetic_smpl
from scipy.sparse import csc_matrix
from scipy.spatial.transform import Rotation

FACES = 1400
FINGERS = ("thumb", "index", "middle", "ring", "pinky")
# of the 24 joints of `published_bodies`, those here; hands and fingers are added
MHR = ("root", "l_upleg", "r_upleg", "c_spine0", "l_lowleg", "r_lowleg", "c_spine1", "l_foot", "r_foot", "c_spine2",
       "l_ball", "r_ball", "c_neck", "l_clavicle", "r_clavicle", "c_head", "l_uparm", "r_uparm", "l_lowarm", "r_lowarm",
       "l_wrist", "r_wrist")
SOMA = ("Hips", "LeftLeg", "RightLeg", "Spine1", "LeftShin", "RightShin", "Spine2", "LeftFoot", "RightFoot", "Chest",
        "LeftToeBase", "RightToeBase", "Neck1", "LeftShoulder", "RightShoulder", "Head", "LeftArm", "RightArm",
        "LeftForeArm", "RightForeArm", "LeftHand", "RightHand")


@cache
def person() -> dict[str, np.ndarray]:
    return synthetic_smpl(faces=FACES, people=12, poses=1).arrays      # ten betas of people


class Bones:
    """Named joints with parents, places (metres) and weights, to which others are added."""

    def __init__(self, names):
        a = person()
        self.x = a["v_template"]
        self.names, self.parents = list(names), a["kintree_table"][0, :22].astype(np.int64).tolist()
        self.parents[0] = -1
        self.places = list(a["J_regressor"][:22] @ self.x)
        weights = a["weights"].copy()
        weights[:, 20:22] += weights[:, 22:24]
        self.weights = list(weights[:, :22].T)

    def add(self, name, parent, place=None, share=0.0):
        """A joint takes a share of what its parent carries, more of what is near it."""
        p = self.names.index(parent)
        place = self.places[p] if place is None else place
        near = np.exp(-np.linalg.norm(self.x - place, axis=1)**2 / 0.05**2) * share * self.weights[p]
        self.weights[p] = self.weights[p] - near
        for row, value in ((self.names, name), (self.parents, p), (self.places, place), (self.weights, near)):
            row.append(value)

    def way(self, parent, to, share):
        a, b = (self.places[self.names.index(name)] for name in (parent, to))
        return a + share * (b - a)

    def tip(self, name):
        """The farthest vertex that a joint carries."""
        j = self.names.index(name)
        mine = self.x[self.weights[j] > 0.5]
        return mine[np.linalg.norm(mine - self.places[j], axis=1).argmax()]

    def fingers(self, hand, names):
        """Chains of finger joints, from a row of names for each finger, fanned out over the hand."""
        wrist, tip = self.places[self.names.index(hand)], self.tip(hand)
        across = np.cross(tip - wrist, [0, 0, 1.0])
        across /= np.linalg.norm(across)
        for k, row in enumerate(names):
            for i, name in enumerate(row):
                place = wrist + (0.3 + 0.6 * i / len(row)) * (tip - wrist) + 0.01 * (k - 2) * across
                self.add(name, row[i - 1] if i else hand, place, 0.0 if "End" in name else 0.5)


def axes(count, rng):
    return Rotation.from_rotvec(rng.normal(0, 1, (count, 3))).as_matrix()


def transforms(R, t):
    out = np.tile(np.eye(4), (len(R), 1, 1))
    out[:, :3, :3], out[:, :3, 3] = R, t
    return out


def local(world, parents):
    return np.stack([w if p in (-1, j) else np.linalg.inv(world[p]) @ w
                     for j, (p, w) in enumerate(zip(parents, world, strict=True))])


def composed(local, parents):
    out = []
    for j, (p, each) in enumerate(zip(parents, local, strict=True)):
        out.append(each if p in (-1, j) else out[p] @ each)
    return np.stack(out)


def bump(x, place, rng, count, size, wide=0.08):
    """(count, N, 3) random smooth displacements about a place."""
    near = np.exp(-np.linalg.norm(x - place, axis=1)**2 / wide**2)
    return near[:, None] * rng.normal(0, size, (count, 1, 3)) * (near > 0.05)[:, None]


def mhr_folder(folder: Path, seed: int = 0, plain: bool = False) -> Path:
    """127 joints, 45 shapes, 72 expressions, 204 controls of which the last 68 change bones.

    A plain one is linear blend skinning: nothing twists by shares, no bone changes its size, correctives are zero.
    """
    rng, bones, a = np.random.default_rng(seed), Bones(MHR), person()
    for side in "lr":
        bones.fingers(f"{side}_wrist", [[f"{side}_{finger}{i}" for i in (1, 2, 3)] for finger in FINGERS])
        bones.add(f"{side}_uparm_twist1_proc", f"{side}_uparm", bones.way(f"{side}_uparm", f"{side}_lowarm", 0.2), 0.6)
        place = bones.way(f"{side}_lowarm", f"{side}_wrist", 0.7)
        bones.add(f"{side}_lowarm_twist1_proc", f"{side}_lowarm", place, 0.6)
        bones.add(f"{side}_eye", "c_head")
    bones.add("c_jaw", "c_head", share=0.3)
    while len(bones.names) < 126:
        bones.add(f"null{len(bones.names)}", "c_spine2")
    names, parents = ["body_world", *bones.names], np.array([-1, *(p + 1 for p in bones.parents)])
    J, N, at = 127, len(bones.x), names.index
    world = transforms(np.concatenate([np.eye(3)[None], axes(126, rng)]), 100 * np.array([np.zeros(3), *bones.places]))
    rest = local(world, parents)
    back = np.linalg.inv(world)

    # every control is a column of places, angles and logarithms of sizes of all joints
    P, column = np.zeros((J, 7, 249)), iter(range(6, 136))
    for k in range(3):
        P[1, k, k] = 10.0
        P[1, 3 + k, 3 + k] = 1.0
    def turn(name, *angles):
        for k in angles:
            P[at(name), 3 + k, next(column)] = 1
    for name in names[1:]:
        if "proc" not in name and "null" not in name and name not in ("root", "c_spine2"):
            turn(name, *((1,) if name[2:] in ("lowleg", "lowarm", "ball") or name[-1] in "23" else (0, 1, 2)))
    turn("c_spine2", 0, 1, 2)
    for side in "lr":
        P[at(f"{side}_uparm_twist1_proc"), 3] -= (not plain) * 0.5 * P[at(f"{side}_uparm"), 3]
        P[at(f"{side}_lowarm_twist1_proc"), 3] += (not plain) * 0.5 * P[at(f"{side}_wrist"), 3]
    for k, name in enumerate(("l_lowleg", "r_lowleg", "l_foot", "r_foot", "l_lowarm", "r_lowarm", "c_neck")):
        P[at(name), :3, 136 + k] = 0.7 * rest[at(name), :3, 3]
    P[at("root"), 6, 150] = P[at("c_head"), 6, 151] = P[at("l_wrist"), 6, 152] = not plain

    shapes = np.zeros((117, N, 3))
    carried = np.column_stack(bones.weights)                # flesh about joints that stay
    shapes[:10] = (carried @ rng.normal(0, 0.04, (10, 126, 1))) * 100 * (bones.x - carried @ np.array(bones.places))
    shapes[10:45] = bump(100 * bones.x, 100 * bones.places[9], rng, 35, 0.3, 30)
    shapes[45:60] = bump(100 * bones.x, 100 * bones.tip("c_head"), rng, 15, 0.2, 5)
    # two layers of correctives: 24 hidden numbers a joint of 6 numbers of its rotation and of its parent's
    hidden, shown = [], np.zeros((3000, N, 3), np.float32)
    for j in range(2, 24):
        rows = 24 * (j - 2) + np.arange(4)
        inputs = [np.arange(6 * (i - 2), 6 * (i - 2) + 6) for i in (j, parents[j]) if i >= 2]
        hidden += [(r, c) for r in rows for c in np.concatenate(inputs)]
        shown[rows] = (not plain) * bump(100 * bones.x, 100 * bones.places[j - 1], rng, 4, 0.4, 8)
    weights = np.column_stack([np.zeros(N), *bones.weights])
    vertex, joint = np.nonzero(weights)
    folder.mkdir(parents=True)
    np.savez(folder / "corrective_activation.npz", **{
        "0.sparse_indices": np.array(hidden).T, "0.sparse_weight": rng.normal(0, 1, len(hidden)).astype("f4")})
    np.savez_compressed(folder / "corrective_blendshapes_lod1.npz", corrective_blendshapes=shown)
    quaternions = Rotation.from_matrix(back[:, :3, :3]).as_quat()
    write_torch(folder / "mhr_model.pt", {
        "character_torch": {
            "skeleton": {"joint_parents": parents, "joint_names": names,
                         "joint_translation_offsets": f4(rest[:, :3, 3]),
                         "joint_prerotations": f4(Rotation.from_matrix(rest[:, :3, :3]).as_quat())},
            "linear_blend_skinning": {
                "vert_indices_flattened": vertex, "skin_indices_flattened": joint,
                "skin_weights_flattened": f4(weights[vertex, joint]),
                "inverse_bind_pose": f4(np.column_stack([back[:, :3, 3], quaternions, np.ones(J)]))},
            "blend_shape": {"base_shape": f4(100 * bones.x), "shape_vectors": f4(shapes[:45])},
            "parameter_transform": {"parameter_transform": f4(P.reshape(7 * J, 249))},
            "mesh": {"faces": a["f"].astype(np.int64)}},
        "face_expressions_model": {"shape_vectors": f4(shapes[45:])}}, script=True)
    return folder


def soma_folder(folder: Path, seed: int = 1, plain: bool = False) -> Path:
    """77 joints below a root, two that twist by shares in each arm, bound with the arms lower than at rest, 128 shapes.

    A plain one is linear blend skinning: nothing twists by shares, it is bound at rest, correctives are zero.
    """
    rng, bones, a = np.random.default_rng(seed), Bones(SOMA), person()
    bones.add("Neck2", "Neck1", bones.way("Neck1", "Head", 0.6))
    bones.parents[bones.names.index("Head")] = bones.names.index("Neck2")
    for name in ("HeadEnd", "Jaw", "LeftEye", "RightEye"):
        bones.add(name, "Head", share=0.2 * (name == "Jaw"))
    for side in ("Left", "Right"):
        bones.add(f"{side}ToeEnd", f"{side}ToeBase")
        bones.fingers(f"{side}Hand", [[f"{side}Hand{finger.title()}{i}" for i in (1, 2, 3, *([4] * (k > 0)), "End")]
                                      for k, finger in enumerate(FINGERS)])
    sides = [[f"{side}{name}" for name in ("Shoulder", "Arm", "ForeArm", "Hand")]
             + [name for name in bones.names if name.startswith(f"{side}Hand") and name != f"{side}Hand"]
             for side in ("Left", "Right")]
    legs = [f"{side}{name}" for side in ("Left", "Right") for name in ("Leg", "Shin", "Foot", "ToeBase", "ToeEnd")]
    order = ["Hips", "Spine1", "Spine2", "Chest", "Neck1", "Neck2", "Head", "HeadEnd", "Jaw", "LeftEye", "RightEye",
             *sides[0], *sides[1], *legs]
    from_bones = [bones.names.index(name) for name in order]
    public_names, N = ["Root", *order], len(bones.x)
    public_parents = np.array([0, *(order.index(bones.names[bones.parents[j]]) + 1 if bones.parents[j] >= 0 else 0
                                    for j in from_bones)])
    places = 100 * np.array([np.zeros(3), *(bones.places[j] for j in from_bones)])
    public_weights = np.column_stack([np.zeros(N), *(bones.weights[j] for j in from_bones)])
    bind = transforms(np.concatenate([np.eye(3)[None], axes(77, rng)]), places)

    # a twisting joint in each upper arm and forearm has a share of what those carry
    at = public_names.index
    twists = [(f"{side}{name}", f"{side}{after}") for side in ("Left", "Right")
              for name, after in (("Arm", "ForeArm"), ("ForeArm", "Hand"))]
    names, parents = [*public_names], [*public_parents]
    weights, full_bind = [*public_weights.T], [*bind]
    share = np.eye(len(bind) + len(twists))
    for t, (name, after) in enumerate(twists):
        middle = (places[at(name)] + places[at(after)]) / 2
        near = 0.6 * weights[at(name)] * np.exp(-np.linalg.norm(100 * bones.x - middle, axis=1)**2 / 10**2)
        weights[at(name)] = weights[at(name)] - near
        weights.append(near)
        names.append(f"{name}Twist")
        parents.append(at(name))
        full_bind.append(transforms(bind[[at(name)], :3, :3], middle[None])[0])
        share[78 + t] = 0
        share[78 + t, [at(name), at(after)]] = 0.5
    full_bind, parents, weights = np.stack(full_bind), np.array(parents), np.column_stack(weights)

    def at_rest(world, parents, names):
        """Arms raised from how they are bound, every joint's axes as there."""
        turned = local(world, parents)
        for sign, side in ((1, "Left"), (-1, "Right")):
            j = names.index(f"{side}Arm")
            R = world[j, :3, :3]
            raised = Rotation.from_euler("y", -15 * sign * (not plain), degrees=True).as_matrix()
            turned[j, :3, :3] = turned[j, :3, :3] @ R.T @ raised @ R
        return composed(turned, parents)

    def rig(world, parents, weights, names, prefix):
        rest, sparse = at_rest(world, parents, names), csc_matrix(f4(weights))
        arrays = {"bind_shape": f4(100 * bones.x), "bind_pose_world": f4(world), "t_pose_world": f4(rest),
                  "bind_pose_local": f4(local(world, parents)), "t_pose_local": f4(local(rest, parents)),
                  "joint_parent_ids": parents, "joint_names": np.array(names), "skinning_weights_data": sparse.data,
                  "skinning_weights_indices": sparse.indices, "skinning_weights_indptr": sparse.indptr,
                  "skinning_weights_shape": np.array(sparse.shape)}
        return {prefix + name: value for name, value in arrays.items()}

    align = []
    for name, after in twists:
        x = places[at(after)] - places[at(name)]
        R, _ = Rotation.align_vectors(x[None] / np.linalg.norm(x), [[1.0, 0, 0]])
        align.append(bind[at(name), :3, :3] @ bind[at(name), :3, :3].T @ R.as_matrix())
    ends = [at(after) for _, after in twists]
    turned = np.zeros((len(twists), 78))
    turned[np.arange(len(twists)), ends] = 0.5 * (not plain)
    procedural = {
        "public_joint_indices_full": np.arange(78), "rotation_matrix": turned, "translation_matrix": share,
        "twist_joint_indices": 78 + np.arange(len(twists)), "twist_axis_ids": np.zeros(len(twists), int),
        "twist_axis_signs": np.ones(len(twists)), "segment_start_joint_indices": np.array([at(n) for n, _ in twists]),
        "segment_end_joint_indices": np.array(ends), "segment_reverse_indices": np.zeros(0, int),
        "segment_parent_joint_indices": public_parents[[at(n) for n, _ in twists]],
        "segment_alignment_rotations": np.stack(align)}
    shapes = np.zeros((128, N, 3))
    shapes[:10] = 100 * np.moveaxis(a["shapedirs"], -1, 0)
    shapes[:10] *= 3 / np.sqrt((shapes[:10]**2).sum(axis=2).mean(axis=1).max())          # the largest by 3 cm
    shapes[10:40] = bump(100 * bones.x, 100 * bones.places[9], rng, 30, 0.3, 30)
    sizes = np.linalg.norm(shapes.reshape(128, -1), axis=1)
    folder.mkdir(parents=True)
    np.savez(folder / "SOMA_neutral.npz", mean=f4(100 * bones.x), eigenvalues=f4(sizes**2),
             triangles=a["f"].astype(np.int64),
             shapedirs=f4(shapes / np.maximum(sizes, 1e-9)[:, None, None]), segment_eye_bags=np.arange(2),
             segment_mouth_bag=np.arange(2, 4), **rig(full_bind, parents, weights, names, ""),
             **rig(bind, public_parents, public_weights, public_names, "public_"),
             **{f"procedural_{name}": value for name, value in procedural.items()})
    first, second = np.zeros((78 * 6, 78 * 4)), np.zeros((78 * 4, 3 * N))
    for name in SOMA[1:]:
        j = at(name)
        for i in (j, public_parents[j]):
            first[6 * i:6 * i + 6, 4 * j:4 * j + 4] = rng.normal(0, 1, (6, 4))
        second[4 * j:4 * j + 4] = (not plain) * bump(100 * bones.x, places[j], rng, 4, 0.4, 8).reshape(4, -1)
    bound = local(bind, public_parents)[:, :3, :3]
    write_torch(folder / "correctives_model.pt", {"use_tanh": False, "C_max": 4, "bindpose": f4(bound),
                                                  "W1": csc_matrix(first), "W2": csc_matrix(second)})
    return folder


def f4(a) -> np.ndarray:
    return np.ascontiguousarray(a, dtype=np.float32)


def write_torch(path: Path, tree: dict, script: bool = False) -> None:
    """A file as PyTorch writes it, without PyTorch: arrays are tensors, sparse ones too; dicts of a script objects."""
    names = {"torch": ("FloatStorage", "LongStorage"), "torch._utils": ("_rebuild_tensor_v2", "_rebuild_sparse_tensor"),
             "torch.serialization": ("_get_layout",), "__torch__": ("Module",)}
    modules = {name: types.ModuleType(name) for name in names}
    for module, things in names.items():
        for thing in things:
            setattr(modules[module], thing, type(thing, (), {"__module__": module, "__qualname__": thing}))
    made, blobs = {name: modules[module] for module, things in names.items() for name in things}, []

    class Call:
        def __init__(self, name, args, state=None):
            self.told = (getattr(made[name], name), args) + ((state,) if state else ())

    class Writer(pickle.Pickler):
        def persistent_id(self, thing):
            if isinstance(thing, np.ndarray):
                blobs.append(np.ascontiguousarray(thing))
                kind = "FloatStorage" if thing.dtype == np.float32 else "LongStorage"
                return "storage", getattr(made[kind], kind), str(len(blobs) - 1), "cpu", thing.size

        def reducer_override(self, thing):
            return thing.told if isinstance(thing, Call) else NotImplemented

    def told(value):
        if isinstance(value, dict):
            inner = {name: told(each) for name, each in value.items()}
            return Call("Module", (), inner) if script else inner
        if isinstance(value, csc_matrix):
            coo = value.tocoo()
            parts = (told(np.stack([coo.row, coo.col]).astype(np.int64)), told(f4(coo.data)), coo.shape, True)
            return Call("_rebuild_sparse_tensor", (Call("_get_layout", ("torch.sparse_coo",)), parts))
        if isinstance(value, np.ndarray):
            steps = tuple(int(s) // value.itemsize for s in np.ascontiguousarray(value).strides)
            return Call("_rebuild_tensor_v2", (value, 0, value.shape, steps, False, {}))
        return value

    with mock.patch.dict(sys.modules, modules), zipfile.ZipFile(path, "w") as archive:
        Writer(out := io.BytesIO(), 2).dump(told(tree))
        archive.writestr("archive/data.pkl", out.getvalue())
        for k, blob in enumerate(blobs):
            archive.writestr(f"archive/data/{k}", blob.tobytes())
        if script:
            archive.writestr("archive/constants.pkl", pickle.dumps(()))
