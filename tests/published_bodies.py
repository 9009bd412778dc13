"""Synthetic people in the layout of published body models, and the published formula written down a second time."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from people_bodies import make_model
from scipy.spatial.transform import Rotation

from model.blend_weights import skin_weights, strongest
from model.export.correctives import pose_directions
from model.rig import Rig
from scanprep.dataset import Skeleton
from scanprep.synthetic.data_set import SUBJECT, near_rest
from scanprep.synthetic.people import PARTS, BodyShape, SyntheticPerson, random_pose

PARENTS = [-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21]
# of each synthetic part the joint that turns it here
JOINT = dict(zip(PARTS, (0, 3, 9, 15, 16, 18, 20, 17, 19, 21, 1, 4, 7, 2, 5, 8), strict=True))


@dataclass(frozen=True, eq=False)
class Synthetic:
    """The arrays of a model, which vertices of `Person` it has, and landmarks on it."""

    arrays: dict[str, np.ndarray]
    vertices: np.ndarray


def synthetic_smpl(faces: int = 2400, people: int = 3, poses: int = 8, seed: int = 5) -> Synthetic:
    """24 joints, 10 betas and 207 pose columns, learned from synthetic people; no spine is cut but ours."""
    rng, man = np.random.default_rng(seed), SyntheticPerson(SUBJECT)
    at = [random_pose(rng) for _ in range(poses)]
    for pose in at:
        pose[0] = 0
    small = make_model.decimate_person(man, None, faces)
    own, template = small.vertex_map, small.template
    drawn = [BodyShape.random(rng, ("female", "male")[k % 2]) for k in range(people)]
    shapes = np.stack([SyntheticPerson(shape).mesh.vertices[own] for shape in drawn])
    mean = shapes.mean(axis=0)
    _, s, Vt = np.linalg.svd((shapes - mean).reshape(people, -1), full_matrices=False)
    shapedirs = (s[:10, None] * Vt[:10] / np.sqrt(people - 1)).reshape(-1, len(own), 3)[:people - 1]
    rest = (mean - mean.mean(axis=0)) @ rng.normal(0, 0.02, (10 - len(shapedirs), 3, 3))     # few people: stretches
    shapedirs = np.concatenate([shapedirs, rest])
    skeleton = split(template.vertices, template.faces, small.skeleton)
    regressor = joint_rows(skeleton, template)
    weights = strongest(skin_weights(template, skeleton, 0.04))
    # the man's own skin by pose, on his own rest mesh
    body = man.mesh.vertices[own]
    rig = Rig(template.with_vertices(body), Skeleton(skeleton.part_of_face, PARENTS, regressor @ body), weights,
              np.zeros((0, *body.shape)))
    ours, exact = np.zeros((poses, 24, 3)), np.stack([man.in_pose(pose)[own] for pose in at])
    ours[:, [JOINT[name] for name in PARTS]] = at
    root = weights[:, 0]**4 / (weights[:, 0]**4).sum()
    exact += np.einsum("n,mnd->md", root, rig.vertices(ours) - exact)[:, None]
    posedirs = pose_directions(rig, ours, exact)
    table = np.stack([np.where(np.array(PARENTS) < 0, 2**32 - 1, PARENTS), np.arange(24)]).astype(np.uint32)
    return Synthetic({"v_template": mean, "shapedirs": np.moveaxis(shapedirs, 0, -1), "posedirs": posedirs,
                      "J_regressor": regressor, "weights": weights, "kintree_table": table,
                      "f": template.faces.astype(np.uint32)}, own)


def split(x: np.ndarray, faces: np.ndarray, skeleton: Skeleton) -> Skeleton:
    """The 24 parts of the 16 of the synthetic people: spine and neck in two, collars, toes and fingers."""
    c, j = x[faces].mean(axis=1), dict(zip(PARTS, skeleton.joints, strict=True))
    part = np.array([JOINT[name] for name in PARTS])[skeleton.part_of_face]
    part[(part == 3) & (c[:, 2] > (j["abdomen"][2] + j["chest"][2]) / 2)] = 6
    part[(part == 15) & (c[:, 2] < j["head"][2] + 0.05)] = 12
    for side, sign, (collar, arm, toes, fingers) in (("left", 1, (13, 20, 10, 22)), ("right", -1, (14, 21, 11, 23))):
        beside = sign * c[:, 0] > 0.6 * abs(j["upper_arm_left"][0])
        part[(part == 9) & beside & (c[:, 2] > j["chest"][2] + 0.1)] = collar
        far = np.linalg.norm(c - j[f"hand_{side}"], axis=1)
        part[(part == arm) & (far > 0.6 * far[part == arm].max())] = fingers
        part[(part == JOINT[f"foot_{side}"]) & (c[:, 1] < j[f"foot_{side}"][1] - 0.08)] = toes
    return Skeleton(part, PARENTS, np.array([c[part == p].mean(axis=0) for p in range(24)]))


def joint_rows(skeleton: Skeleton, template) -> np.ndarray:
    """(J, N): a joint is the mean of the vertices where its part meets its parent's; the root's, of its part."""
    rows = np.zeros((24, len(template.vertices)))
    part = skeleton.part_of_vertex(template)
    for p in range(24):
        ring = skeleton.ring(template, p) if p else np.flatnonzero(part == 0)
        if not len(ring):
            mine, other = (template.vertices[part == q] for q in (p, PARENTS[p]))
            middle = (mine.mean(axis=0) + other.mean(axis=0)) / 2
            ring = np.argsort(np.linalg.norm(template.vertices - middle, axis=1))[:8]
        rows[p, ring] = 1 / len(ring)
    return rows


def as_star(smpl: dict[str, np.ndarray], seed: int = 0) -> dict[str, np.ndarray]:
    """The same body with 93 pose columns of quaternions and the second beta."""
    size = 0.3 * np.abs(smpl["posedirs"]).max()
    noise = np.random.default_rng(seed).normal(0, size, (*smpl["v_template"].shape, 93))
    return {**smpl, "posedirs": noise}


def as_smplx(smpl: dict[str, np.ndarray], seed: int = 0) -> dict[str, np.ndarray]:
    """The same body with a jaw, eyes and fifteen finger joints a hand: 55 joints, 486 pose columns, 20 betas."""
    rng, x, weights = np.random.default_rng(seed), smpl["v_template"], smpl["weights"]
    parents = PARENTS[:22] + [15, 15, 15]
    for wrist, first in ((20, 25), (21, 40)):
        for finger in range(5):
            parents += [wrist, first + 3 * finger, first + 3 * finger + 1]
    new = np.zeros((len(x), 55))
    new[:, :20] = weights[:, :20]
    regressor = np.zeros((55, len(x)))
    regressor[:22] = smpl["J_regressor"][:22]
    for joint, old in [(15, (15,)), (20, (20, 22)), (21, (21, 23))]:
        children = range(22, 25) if joint == 15 else range(25, 40) if joint == 20 else range(40, 55)
        mine = np.flatnonzero(weights[:, old].sum(axis=1) > 0.5)
        new[:, joint] = weights[:, old].sum(axis=1)
        for k, child in enumerate(children):
            share = mine[k::len(children)]
            new[share, child] = 0.6 * new[share, joint]
            new[share, joint] *= 0.4
            regressor[child, share] = 1 / len(share)
    posedirs = rng.normal(0, 0.1 * np.abs(smpl["posedirs"]).max(), (len(x), 3, 486))
    expression = rng.normal(0, 0.002, (len(x), 3, 10)) * (weights[:, 15] > 0.5)[:, None, None]
    return {**smpl, "weights": new, "J_regressor": regressor, "posedirs": posedirs,
            "shapedirs": np.concatenate([smpl["shapedirs"], expression], axis=2),
            "kintree_table": np.array([parents, range(55)]), "hands_meanl": rng.normal(0, 0.3, 45),
            "hands_meanr": rng.normal(0, 0.3, 45)}


def published_vertices(a: dict[str, np.ndarray], pose: np.ndarray, betas: np.ndarray, trans: np.ndarray) -> np.ndarray:
    """(N, 3) by the papers, joint by joint with 4×4 matrices, and SciPy's rotations (Loper et al. 2015, Eq. 2-9)."""
    J, star = len(pose), a["posedirs"].shape[2] == 4 * (len(pose) - 1) + 1
    shaped = a["v_template"] + a["shapedirs"][..., :len(betas)] @ betas
    if star:
        q = Rotation.from_rotvec(pose[1:]).as_quat()
        q *= np.where(q[:, 3:] < 0, -1, 1)
        feature = np.append((q - [0, 0, 0, 1]).ravel(), betas[1])
    else:
        feature = (Rotation.from_rotvec(pose[1:]).as_matrix() - np.eye(3)).ravel()
    bent, joints = shaped + a["posedirs"] @ feature, a["J_regressor"] @ shaped
    parents = a["kintree_table"][0].astype(np.int64)
    G = []
    for j in range(J):
        local = np.eye(4)
        local[:3, :3] = Rotation.from_rotvec(pose[j]).as_matrix()
        local[:3, 3] = joints[j] - (joints[parents[j]] if j else 0)
        G.append(G[parents[j]] @ local if j else local)
    out = np.zeros_like(bent)
    for n, x in enumerate(bent):
        T = np.zeros((4, 4))
        for j in np.flatnonzero(a["weights"][n]):
            back = np.eye(4)
            back[:3, 3] = -joints[j]
            T += a["weights"][n, j] * G[j] @ back
        out[n] = (T @ np.append(x, 1))[:3]
    return out + trans


def people_near_rest(count: int, seed: int) -> list[tuple[SyntheticPerson, np.ndarray]]:
    """People who were not learned from, and how they stand."""
    rng = np.random.default_rng(seed)
    return [(SyntheticPerson(BodyShape.random(rng, ("female", "male")[k % 2])), near_rest(rng)) for k in range(count)]
