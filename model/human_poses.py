"""Poses that people take, for the skeleton of any person: prior knowledge for bodies with few training poses.

They are drawn as for the synthetic people (everyday poses, mixed limb by limb, with noise). The directions of the bones
carry them to another skeleton. No scan was used.
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

LIMBS = {"arm": ("upper_arm", "forearm", "hand"), "leg": ("thigh", "shin", "foot")}
WORTH = 8                            # the poses of all people count as much as so many training poses


def human_poses(template: Mesh, skeleton: Skeleton, count: int, rng: np.random.Generator) -> np.ndarray | None:
    """Draw poses (count, J, 3), radians, for a template that stands; None for a body that is no person.

    The root is at rest. A body counts as a person by the names of its parts, see `name_parts`.
    """
    names, chains = skeleton.names, _limbs(skeleton)
    if not all(chains.values()):
        return None
    # axes (3, 3) take directions of the synthetic people, whose left is +x and who face -y, to the template's
    joint = {key: skeleton.joints[chain[0]] for key, chain in chains.items()}
    # up from hips to shoulders, left from the right limbs to the left ones
    hips, shoulders = (np.mean([joint[kind, side] for side in ("left", "right")], axis=0) for kind in ("leg", "arm"))
    up = _unit(shoulders - hips)
    left = joint["leg", "left"] - joint["leg", "right"] + joint["arm", "left"] - joint["arm", "right"]
    left = _unit(left - up * (left @ up))
    axes = np.stack([left, np.cross(up, left), up], axis=1)
    scale = float(np.ptp(template.vertices @ up)) / average().stature
    # for every part: two parts a, b of the synthetic people and a share, how far to interpolate from a to b;
    # and the rotation that takes the bone at rest to that of the synthetic people
    plain = [name.rstrip("0123456789") for name in names]
    trunk_parts = ("pelvis", "abdomen", "chest", "head")
    known = {"neck": "head", "trunk": "abdomen", **{name: name for name in trunk_parts}}
    trunk = [known.get(name, "pelvis") for name in plain]
    source = [(PARTS.index(part), PARTS.index(part), 0.0) for part in trunk]
    at_rest = np.tile(np.eye(3), (len(names), 1, 1))
    for (kind, side), chain in chains.items():
        _follow_limb(template, skeleton, chain, kind, side, scale, axes, source, at_rest)
    # poses of the synthetic people: world rotations of their parts, in the template's axes
    drawn = np.stack([random_pose(rng) for _ in range(count)])
    drawn[:, 0] = 0
    R = rotations.exp(drawn)
    for part in range(1, len(PARENTS)):
        R[:, part] = R[:, PARENTS[part]] @ R[:, part]
    R = axes @ R @ axes.T
    # rotations carried to this skeleton; toes, fingers and face stay at rest
    world = np.stack([R[:, a] if share == 0 else
                      R[:, a] @ rotations.exp(share * rotations.log(np.swapaxes(R[:, a], -1, -2) @ R[:, b]))
                      for a, b, share in source], axis=1)
    poses = skeleton.pose_of(world @ at_rest)
    poses[:, [0, *(p for p, name in enumerate(names) if is_held(name))]] = 0
    return poses


def is_person(skeleton: Skeleton) -> bool:
    """Return whether a skeleton's parts are named as a person's, so that `human_poses` applies."""
    return all(_limbs(skeleton).values())


def _limbs(skeleton: Skeleton) -> dict[tuple[str, str], list[int]]:
    """Find the parts of every limb from the trunk outwards, by kind and side; none where no names match."""
    return {(kind, side): limb_parts(skeleton.names, skeleton.parents, skeleton.joints, kind, side)
            for kind in LIMBS for side in ("left", "right")}


def is_held(name: str) -> bool:
    """Return whether `human_poses` leaves a part, by its name, at rest: toes, fingers and face."""
    return part_kind(name) in ("toes", "fingers", "jaw", "eye", "index", "middle", "pinky", "ring", "thumb")


def with_human_poses(template: Mesh, skeleton: Skeleton, count: int, mean: np.ndarray, covariance: np.ndarray
                     ) -> Moments:
    """Mix mean (J, 3) and covariance (3J, 3J) of `count` training poses with those of the poses of all people.

    The share of all people is a half for eight training poses and about a tenth for eighty. Nothing changes for a body
    that is no person.
    """
    drawn = 400  # poses from which mean and covariance of all people are computed
    people = human_poses(template, skeleton, drawn, np.random.default_rng(0))
    if people is None:
        return mean, covariance
    # 0.25 rad: joints of this body may differ so much from those of all people, standard deviation
    loose = np.full(mean.size, 0.25)
    loose[:3] = 0                                                                 # the root is at rest
    of_people = people.mean(axis=0), np.cov(people.reshape(drawn, -1).T) + np.diag(loose**2)
    return mix_moments((mean, covariance), of_people, count / (count + WORTH))


def mix_moments(one: Moments, other: Moments, share: float) -> Moments:
    """Compute the moments of a mixture: a share of the poses has moments `one`, the rest has moments `other`."""
    apart = (one[0] - other[0]).ravel()
    return (share * one[0] + (1 - share) * other[0],
            share * one[1] + (1 - share) * other[1] + share * (1 - share) * np.outer(apart, apart))


def _follow_limb(template: Mesh, skeleton: Skeleton, chain: list[int], kind: str, side: str, scale: float,
                 axes: np.ndarray, source: list[tuple[int, int, float]], at_rest: np.ndarray) -> None:
    """Pair the parts of a limb with those of the synthetic people by their distance from the limb's end.

    Fills `source` and `at_rest` of `human_poses` for the parts in `chain`.
    """
    a, parts = average(), [PARTS.index(f"{part}_{side}") for part in LIMBS[kind]]
    far = scale * _from_the_end(np.vstack([a.joints[parts], a.ends[parts[-1]]]))  # (4,), 0 at the fingers or toes
    # the tip of this limb: the point of the last part's skin farthest from its joint
    skin = template.vertices[np.unique(template.faces[skeleton.part_of_face == chain[-1]])]
    tip = skin[np.linalg.norm(skin - skeleton.joints[chain[-1]], axis=1).argmax()]
    points = np.vstack([skeleton.joints[chain], tip])
    away = _from_the_end(points)
    middles = (away[1:] + away[:-1]) / 2
    segment = np.array([int((far[1:-1] > middle).sum()) for middle in middles])   # 0 upper arm, 1 forearm, 2 hand
    # each part gets the rotations of its segment; a shoulder before the upper arm gets some of the upper arm's
    for i, part in enumerate(chain):
        k, same = segment[i], np.flatnonzero(segment == segment[i])
        if k == 0 and len(same) > 1 and i == 0:
            # three tenths of the upper arm's rotation against the chest happen in the shoulder girdle
            source[part] = int(PARENTS[parts[0]]), parts[0], 0.3
            continue
        source[part] = parts[k], parts[k], 0.0
        if kind == "arm" or k < 2:
            # the smallest rotation that takes our bone's direction at rest to theirs
            first = same[1] if k == 0 and len(same) > 1 else same[0]
            target = axes @ _unit(a.ends[parts[k]] - a.joints[parts[k]])
            own = _unit(points[same[-1] + 1] - points[first])
            cross = np.cross(own, target)
            sine = float(np.linalg.norm(cross))
            at_rest[part] = rotations.exp(cross / max(sine, 1e-12) * np.arctan2(sine, float(own @ target)))


def _from_the_end(places: np.ndarray) -> np.ndarray:
    """Compute the distance (n,) along a chain of points (n, 3) from each to the last."""
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    return np.r_[np.cumsum(steps[::-1])[::-1], 0.0]


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v)
