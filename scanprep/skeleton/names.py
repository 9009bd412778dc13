"""Name the parts of people from the tree, its symmetry, and the positions of the parts."""
from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np

from ..geometry.mesh import Mesh
from .roles import missing_joints
from .symmetry import Symmetry
from .tree import Skeleton, number_parts


def name_parts(template: Mesh, skeleton: Skeleton, symmetry: Symmetry) -> tuple[str, ...]:
    """Name the parts of a person: pelvis, abdomen, chest, head, upper_arm_left, ..., foot_right.

    A body counts as a person if it and its tree are symmetric and its middle parts form one chain. One pair of limbs
    must start at the lower end and one further up. Every limb must be a chain, and the legs must continue the trunk as
    in standing. Beyond the arms the chain ends in a head. A head that never moves in the poses belongs to the chest.
    Left and right follow from the feet: soles reach forward from the ankles. Any other body keeps its names.
    """
    person = _person(template, skeleton, symmetry) if symmetry.holds else None
    if person is None:
        return skeleton.names
    left = _way_left(template, skeleton, person)
    if left is None:
        return skeleton.names
    names = dict(zip(person.spine, _spine_names(person), strict=True))
    # limbs by their number of parts, from the body outwards
    arm = {1: ("arm",), 2: ("upper_arm", "forearm"), 3: ("upper_arm", "forearm", "hand")}
    leg = {1: ("leg",), 2: ("thigh", "shin"), 3: ("thigh", "shin", "foot")}
    for limbs, kinds, first in ((person.arms, arm, "shoulder"), (person.legs, leg, "hip")):
        # the two of a pair against each other: on a body that leans both may be on one side of its centre
        pair = sorted(limbs, key=lambda limb: float(_middle(template, skeleton, limb) @ left))
        lengths = [np.linalg.norm(np.diff(_bones(template, skeleton, limb), axis=0), axis=1) for limb in pair]
        segments = _limb_names(np.mean(lengths, axis=0), kinds, first)
        for side, limb in zip(("right", "left"), pair, strict=True):
            names |= {part: f"{name}_{side}" for part, name in zip(limb, segments, strict=True)}
    return tuple(names[p] for p in range(len(skeleton.parents)))


def skeleton_doubts(skeleton: Skeleton, parts: int | None = None) -> list[str]:
    """List what a skeleton lacks, as reasons of a judgement: `parts` that were asked for, and joints of a person."""
    missing = missing_joints(skeleton.names, skeleton.joints)
    doubts = [f"the skeleton has no joint at the {', '.join(missing)}: add scans in which the body bends there"] \
        if missing else []
    if parts is not None and parts != len(skeleton.parents):
        doubts.insert(0, f"no skeleton of {parts} parts was found, the nearest has {len(skeleton.parents)}: ask "
                         "for no number of parts (scape prep skeleton --parts), or add scans in which the body bends "
                         "at the joints that are missing")
    return doubts


def note_numbered_parts(skeleton: Skeleton) -> None:
    """Warn where the parts of a skeleton have numbers for names, as on a body that is not recognised as a person."""
    if len(skeleton.parents) > 1 and skeleton.names == number_parts(len(skeleton.parents)):
        warnings.warn("the parts are numbered, as they are not those of a person with a clear left and right; name "
                      "them with scape prep edit-skeleton --rename", stacklevel=2)


@dataclass(frozen=True, eq=False)
class _Person:
    """Trunk (from the pelvis) and limbs as chains of parts, and the up direction."""

    spine: list[int]
    arms: list[list[int]]
    legs: list[list[int]]
    chest: int
    has_head: bool                       # a part of its own at the end of the chain
    up: np.ndarray


def part_partners(template: Mesh, skeleton: Skeleton, symmetry: Symmetry) -> np.ndarray | None:
    """Find the mirror partner (J,) of each part; None if the pairing is not mutual or does not preserve the tree."""
    J, part = len(skeleton.parents), skeleton.part_of_face
    table = np.zeros((J, J))
    np.add.at(table, (part, part[symmetry.partner]), template.face_areas)
    partner = (table + table.T).argmax(axis=1)
    tree = {frozenset(link) for link in zip(range(1, J), skeleton.parents[1:].tolist(), strict=True)}
    mirrored = {frozenset(partner[list(link)].tolist()) for link in tree}
    return partner if (partner[partner] == np.arange(J)).all() and tree == mirrored else None


def _person(template: Mesh, skeleton: Skeleton, symmetry: Symmetry) -> _Person | None:
    """Analyse a body as a person; None if it is none."""
    partner = part_partners(template, skeleton, symmetry)
    if partner is None:
        return None
    near = _neighbours(skeleton)
    middle = [p for p in range(len(partner)) if partner[p] == p]
    limbs = _limbs(near, partner, middle)
    found = limbs and _spine(template, skeleton, {p: [q for q in near[p] if q in middle] for p in middle}, limbs)
    if not found:
        return None
    spine, neck, order = found
    # both pairs of limbs must be mirror images, and the legs must start at the lower end
    legs, arms = [limbs[i][1] for i in order[:2]], [limbs[i][1] for i in order[2:]]
    if {partner[legs[0][0]], partner[arms[0][0]]} != {legs[1][0], arms[1][0]} or limbs[order[0]][0] != spine[0]:
        return None
    # the legs continue the trunk, as in standing: within about 45 degrees
    hips = np.mean([_joint(skeleton, leg[0], spine[0]) for leg in legs], axis=0)
    up = (neck - hips) / np.linalg.norm(neck - hips)
    down = np.mean([_bones(template, skeleton, leg)[-1] for leg in legs], axis=0) - hips
    if down @ up > -0.7 * np.linalg.norm(down):
        return None
    return _Person(spine, arms, legs, limbs[order[2]][0], spine[-1] != limbs[order[2]][0], up)


def _limbs(near: dict[int, list[int]], partner: np.ndarray, middle: list[int]) -> list[tuple[int, list[int]]]:
    """Find the four limbs: for each its middle part and its chain of parts; empty for any other body."""
    limbs = [(p, chain) for p in middle for q in near[p] if partner[q] != q and (chain := _chain(near, p, q))]
    whole = len(middle) + sum(len(chain) for _, chain in limbs) == len(partner)
    forks = any(sum(partner[q] == q for q in near[p]) > 2 for p in middle)
    return limbs if len(limbs) == 4 and whole and not forks else []


def _spine(template: Mesh, skeleton: Skeleton, along: dict[int, list[int]], limbs: list[tuple[int, list[int]]]
           ) -> tuple[list[int], np.ndarray, np.ndarray] | None:
    """Find the chain from the legs to the head, the neck (3,), and the order of the limbs, legs first."""
    heads = [p for p in along if len(along[p]) < 2 and p not in {q for q, _ in limbs}]
    if len(heads) > 1:
        return None
    roots = np.array([_joint(skeleton, chain[0], p) for p, chain in limbs])
    if heads:                                                             # legs are farther from the neck than arms
        spine = _chain(along, -1, heads[0])[::-1]
        neck = _joint(skeleton, spine[-1], spine[-2])
        return spine, neck, np.lexsort((-np.linalg.norm(roots - neck, axis=1), [spine.index(p) for p, _ in limbs]))
    # without a head: legs are larger than arms
    order = np.argsort([-_points(template, skeleton, chain)[1].sum() for _, chain in limbs])
    return _chain(along, -1, limbs[order[0]][0]), roots[order[2:]].mean(axis=0), order


def _neighbours(skeleton: Skeleton) -> dict[int, list[int]]:
    """List the linked parts of every part."""
    near: dict[int, list[int]] = {p: [] for p in range(len(skeleton.parents))}
    for child, parent in enumerate(skeleton.parents.tolist()):
        if parent >= 0:
            near[child].append(parent)
            near[parent].append(child)
    return near


def _chain(near: dict[int, list[int]], before: int, first: int) -> list[int]:
    """Follow the parts from `first` on, away from `before`; empty where they branch."""
    chain, last = [first], before
    while ahead := [q for q in near[chain[-1]] if q != last]:
        if len(ahead) > 1:
            return []
        last = chain[-1]
        chain.append(ahead[0])
    return chain


def _joint(skeleton: Skeleton, a: int, b: int) -> np.ndarray:
    """Return the joint (3,) between two linked parts."""
    return skeleton.joints[a if skeleton.parents[a] == b else b]


def _points(template: Mesh, skeleton: Skeleton, parts: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Return centroids (n, 3) and areas (n,) of the triangles of some parts."""
    inside = np.isin(skeleton.part_of_face, parts)
    return template.corners[inside].mean(axis=1), template.face_areas[inside]


def _middle(template: Mesh, skeleton: Skeleton, parts: list[int]) -> np.ndarray:
    """Return the centroid (3,) of some parts."""
    points, areas = _points(template, skeleton, parts)
    return areas @ points / areas.sum()


def _bones(template: Mesh, skeleton: Skeleton, limb: list[int]) -> np.ndarray:
    """Return the joints of a limb and its far end (n + 1, 3); the end is the point farthest from the first joint."""
    trunk = next(q for q in _neighbours(skeleton)[limb[0]] if q not in limb)
    places = [_joint(skeleton, a, b) for a, b in zip(limb, [trunk, *limb], strict=False)]
    points, _ = _points(template, skeleton, limb[-1:])
    return np.array([*places, points[np.linalg.norm(points - places[0], axis=1).argmax()]])


def _way_left(template: Mesh, skeleton: Skeleton, person: _Person) -> np.ndarray | None:
    """Find the direction (3,) to the person's left: up × front, front where the soles reach; None if unclear."""
    front, length = np.zeros(3), 0.0
    for leg in person.legs:
        points, areas = _points(template, skeleton, leg)
        # of each leg: the lowest 5% are the sole, 12 to 22% of the height the ankle
        height = points @ person.up
        bottom, size = height.min(), np.ptp(height)
        sole = height < bottom + 0.05 * size
        ankle = (height > bottom + 0.12 * size) & (height < bottom + 0.22 * size)
        if not sole.any() or not ankle.any():
            return None
        front += (np.average(points[sole], axis=0, weights=areas[sole])
                  - np.average(points[ankle], axis=0, weights=areas[ankle])) / 2
        length += size / 2
    front -= person.up * (front @ person.up)
    # a foot must reach forward by 4% of the leg to be clear
    return np.cross(person.up, front) if np.linalg.norm(front) > 0.04 * length else None


def _spine_names(person: _Person) -> list[str]:
    """Name the chain from pelvis to head; surplus parts of abdomen and neck are numbered."""
    chest = person.spine.index(person.chest)
    trunk = (["trunk"] if chest == 0 else
             ["pelvis", *([] if chest == 1 else ["abdomen"] if chest == 2 else
                          [f"abdomen{k}" for k in range(1, chest)]), "chest"])
    if not person.has_head:
        return trunk
    beyond = len(person.spine) - chest - 2                                    # between chest and head
    return [*trunk, *([] if beyond == 0 else ["neck"] if beyond == 1 else [f"neck{k + 1}" for k in range(beyond)]),
            "head"]


def _limb_names(lengths: np.ndarray, kinds: dict[int, tuple[str, ...]], first: str) -> tuple[str, ...]:
    """Name a limb from the body outwards, by the lengths (n,) of its segments; more than three are numbered."""
    lead: tuple[str, ...] = ()
    if len(lengths) in (3, 4) and lengths[0] < 0.45 * lengths[1]:          # too short for an upper arm or thigh
        lengths, lead = lengths[1:], (first,)
    n, whole = len(lengths), kinds[1][0]
    # elbows and knees are at 0.41 to 0.44 of the length of a limb, wrists and ankles at 0.75 to 0.81
    if n == 2 and lengths[0] > 0.6 * lengths.sum():                     # the knee never bends, the ankle does
        return *lead, whole, kinds[3][-1]
    return (*lead, *kinds[n]) if n in kinds else tuple(f"{whole}{k + 1}" for k in range(n))
