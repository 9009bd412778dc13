"""Poses that people take, for the skeleton of any person: what is known of joints before a pose of this one is seen.

They are drawn as those of the synthetic people (named everyday poses, limb by limb, loosened), and carried to another
skeleton by the directions of its bones. No scan was used.
"""
from __future__ import annotations

import numpy as np

from scanprep.geometry import rotations
from scanprep.geometry.mesh import Mesh
from scanprep.skeleton.roles import limb_parts, part_kind
from scanprep.skeleton.tree import Skeleton
from scanprep.synthetic.anatomy import PARENTS, PARTS
from scanprep.synthetic.poses import average, random_pose

Moments = tuple[np.ndarray, np.ndarray]         # mean (J, 3) and covariance (3J, 3J) of poses, radians

TRUNK = ("pelvis", "abdomen", "chest", "head")
LIMBS = {"arm": ("upper_arm", "forearm", "hand"), "leg": ("thigh", "shin", "foot")}
WORTH = 8                            # training poses that what people do with their joints counts as


def human_poses(template: Mesh, skeleton: Skeleton, count: int, rng: np.random.Generator) -> np.ndarray | None:
    """Poses (count, J, 3), radians, the root at rest, of a template that stands; None for a body that is no person.

    A body counts as a person by the names of its parts, see `name_parts`.
    """
    names, chains = skeleton.names, _limbs(skeleton)
    if not all(chains.values()):
        return None
    # axes (3, 3) take directions of the synthetic people, whose left is +x and who face -y, to the template's
    joint = {key: skeleton.joints[chain[0]] for key, chain in chains.items()}
    hips, shoulders = (np.mean([joint[kind, side] for side in ("left", "right")], axis=0) for kind in ("leg", "arm"))
    up = _unit(shoulders - hips)
    left = joint["leg", "left"] - joint["leg", "right"] + joint["arm", "left"] - joint["arm", "right"]
    left = _unit(left - up * (left @ up))
    axes = np.stack([left, np.cross(up, left), up], axis=1)
    scale = float(np.ptp(template.vertices @ up)) / average().stature
    # of every part: rotations of two of their parts, and how far from one to the other; what takes its bone to theirs
    plain = [name.rstrip("0123456789") for name in names]
    trunk = [{"neck": "head", "trunk": "abdomen"}.get(name, name if name in TRUNK else "pelvis") for name in plain]
    source = [(PARTS.index(part), PARTS.index(part), 0.0) for part in trunk]
    at_rest = np.tile(np.eye(3), (len(names), 1, 1))
    for (kind, side), chain in chains.items():
        _follow_limb(template, skeleton, chain, kind, side, scale, axes, source, at_rest)
    drawn = np.stack([random_pose(rng) for _ in range(count)])
    drawn[:, 0] = 0
    R = rotations.exp(drawn)
    for part in range(1, len(PARENTS)):
        R[:, part] = R[:, PARENTS[part]] @ R[:, part]
    R = axes @ R @ axes.T
    world = np.stack([R[:, a] if share == 0 else
                      R[:, a] @ rotations.exp(share * rotations.log(np.swapaxes(R[:, a], -1, -2) @ R[:, b]))
                      for a, b, share in source], axis=1)
    poses = skeleton.pose_of(world @ at_rest)
    poses[:, [0, *(p for p, name in enumerate(names) if is_held(name))]] = 0
    return poses


def is_person(skeleton: Skeleton) -> bool:
    """Whether the parts of a skeleton have the names of a person's, so that `human_poses` hold for it."""
    return all(_limbs(skeleton).values())


def _limbs(skeleton: Skeleton) -> dict[tuple[str, str], list[int]]:
    """The parts of every limb from the trunk outwards, by kind and side; none where names do not tell."""
    return {(kind, side): limb_parts(skeleton.names, skeleton.parents, skeleton.joints, kind, side)
            for kind in LIMBS for side in ("left", "right")}


def is_held(name: str) -> bool:
    """Whether a part, by its name, is one that poses of people here leave at rest: toes, fingers, face."""
    # parts that stay at rest
    return part_kind(name) in ("toes", "fingers", "jaw", "eye", "index", "middle", "pinky", "ring", "thumb")


def with_human_poses(template: Mesh, skeleton: Skeleton, count: int, mean: np.ndarray, covariance: np.ndarray
                     ) -> Moments:
    """Mean (J, 3) and covariance (3J, 3J) of `count` training poses mixed with those of all people.

    The fewer poses were seen, the more is taken from all people, of whom no joint is quite like this body's: of eight
    poses one half, of eighty a tenth. Nothing changes for a body that is no person.
    """
    drawn = 400  # poses for its mean and covariance
    people = human_poses(template, skeleton, drawn, np.random.default_rng(0))
    if people is None:
        return mean, covariance
    # radians by which joints of this body may differ from those of all people
    loose = np.full(mean.size, 0.25)
    loose[:3] = 0                                                                 # the root is at rest
    theirs = people.mean(axis=0), np.cov(people.reshape(drawn, -1).T) + np.diag(loose**2)
    return mix_moments((mean, covariance), theirs, count / (count + WORTH))


def mix_moments(one: Moments, other: Moments, share: float) -> Moments:
    """Moments of poses of which a share has those of the one, and the rest those of the other."""
    apart = (one[0] - other[0]).ravel()
    return (share * one[0] + (1 - share) * other[0],
            share * one[1] + (1 - share) * other[1] + share * (1 - share) * np.outer(apart, apart))


def _follow_limb(template: Mesh, skeleton: Skeleton, chain: list[int], kind: str, side: str, scale: float,
                 axes: np.ndarray, source: list[tuple[int, int, float]], at_rest: np.ndarray) -> None:
    """Pair the parts of a limb with those of the synthetic people by their distance from its end."""
    a, parts = average(), [PARTS.index(f"{part}_{side}") for part in LIMBS[kind]]
    far = scale * _from_the_end(np.vstack([a.joints[parts], a.ends[parts[-1]]]))  # (4,), 0 at the fingers or toes
    skin = template.vertices[np.unique(template.faces[skeleton.part_of_face == chain[-1]])]
    tip = skin[np.linalg.norm(skin - skeleton.joints[chain[-1]], axis=1).argmax()]
    mine = np.vstack([skeleton.joints[chain], tip])
    away = _from_the_end(mine)
    middles = (away[1:] + away[:-1]) / 2
    segment = np.array([int((far[1:-1] > middle).sum()) for middle in middles])   # 0 upper arm, 1 forearm, 2 hand
    for i, part in enumerate(chain):
        k, same = segment[i], np.flatnonzero(segment == segment[i])
        if k == 0 and len(same) > 1 and i == 0:                                   # a shoulder goes some of the way
            # of an upper arm's rotation against the chest three tenths happen in the shoulder itself
            source[part] = int(PARENTS[parts[0]]), parts[0], 0.3
            continue
        source[part] = parts[k], parts[k], 0.0
        if kind == "arm" or k < 2:
            first = same[1] if k == 0 and len(same) > 1 else same[0]
            theirs = axes @ _unit(a.ends[parts[k]] - a.joints[parts[k]])
            own = _unit(mine[same[-1] + 1] - mine[first])
            cross = np.cross(own, theirs)             # the least rotation from ours to theirs
            sine = float(np.linalg.norm(cross))
            at_rest[part] = rotations.exp(cross / max(sine, 1e-12) * np.arctan2(sine, float(own @ theirs)))


def _from_the_end(places: np.ndarray) -> np.ndarray:
    """(n,) the way from each of a chain of points (n, 3) to the last."""
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    return np.r_[np.cumsum(steps[::-1])[::-1], 0.0]


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v)
