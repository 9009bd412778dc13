"""What in a finished registration no person can do: limbs rolled about their own axis, and skin that slid.

A template rolled about its forearm lies on the scan as well as the right one, so distances say nothing. Its joints do,
when their angles are compared with those of people, and so does its skin: a part that is brought where it does not
belong must bend and stretch to lie there. What is usual is measured on the synthetic people in the same way, as the
rotation that best carries the whole skin of a part, so that skin that lags behind its bones counts on both sides.
"""
from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np

from ..geometry import rotations
from ..geometry.mesh import Mesh
from ..judgement import size
from ..skeleton.roles import in_words, part_kind
from ..skeleton.tree import Skeleton
from ..synthetic.anatomy import MIRROR_PART
from ..synthetic.people import NAMED_POSES, PARENTS, PARTS, find_pose, random_pose
from .limb_ends import bending
from .person import PersonParts, average_person

ROLL, BEND, SIDE = range(3)
# Degrees by which joints of real people go beyond those of the built-in ones (roll, bend, side), found on the true
# bodies of 56 scans of one man, none of them held out. Rolls hold for 99 in 100, so that rolled limbs are told; bends
# are five degrees beyond the largest, as registered hands bend a little more than they should.
SLACK = {"pelvis": (0, 0, 0), "abdomen": (20, 42, 20), "chest": (20, 24, 20), "head": (25, 40, 25),
         "upper_arm": (20, 20, 20), "forearm": (35, 21, 63), "hand": (55, 66, 64), "thigh": (20, 20, 20),
         "shin": (35, 22, 75), "foot": (20, 30, 66)}
# Of a body's size: what muscles and build add to the bending of a part. True bodies have up to 0.0025 more; registered
# ones are smoother, and with more a head rolled by 45 degrees is not told.
SHAPE = {"pelvis": 0.01, "abdomen": 0.01, "chest": 0.01, "head": 0.006, "upper_arm": 0.008, "forearm": 0.008,
         "hand": 0.008, "thigh": 0.012, "shin": 0.008, "foot": 0.008}
LIMBS = range(3, len(PARTS))           # head, arms and legs; a trunk tells of the build
SCALE = 0.18                           # logarithm: how much one limb may grow against the whole body
GRAVE = 30                             # degrees beyond what people do that double a doubt


@dataclass(frozen=True)
class PlausibilityIssue:
    """Something that no person can do: how grave, 1 where it begins, in words, and with which part."""

    excess: float
    words: str
    part: int = field(default=-1, compare=False)


@dataclass(frozen=True, eq=False)
class LimbMeasures:
    """How the parts of a person came to lie, and how that compares with what people do.

    `angles` (16, 3), degrees: by how much each part is rolled about its own axis, bent, and bent sideways against its
    parent, from the rest of the synthetic people; `beyond` (16, 3), degrees, is what of it no person does. `bending`
    (16,), metres: how far the skin of a part is from any enlarged copy of the template's, root mean square; `most`
    (16,), metres, is what people have. `growth` (16,): logarithm of the size of each part against that of all.
    """

    angles: np.ndarray
    beyond: np.ndarray
    bending: np.ndarray
    most: np.ndarray
    growth: np.ndarray

    def doubts(self, skeleton: Skeleton) -> tuple[PlausibilityIssue, ...]:
        """What is unlikely, the gravest first."""
        found: list[PlausibilityIssue] = []
        moved = ("rolled", "bent", "bent sideways")
        for part in range(1, len(PARTS)):
            name, parent = (in_words(skeleton.names[k]) for k in (part, skeleton.parents[part]))

            # a joint that is beyond what people do; 30 degrees beyond it double the severity
            kind = int(self.beyond[part].argmax())
            if self.beyond[part, kind] > 0:
                angle = abs(self.angles[part, kind])
                found.append(PlausibilityIssue(
                    1 + float(self.beyond[part, kind]) / GRAVE,
                    f"the {name} is {moved[kind]} by {angle:.0f} degrees against the {parent}", part))

            # skin that is no enlarged copy of the template's
            if part in LIMBS and self.bending[part] > self.most[part]:
                off = 1e3 * self.bending[part]
                found.append(PlausibilityIssue(
                    float(self.bending[part] / self.most[part]),
                    f"the skin of the {name} is {off:.0f} mm out of shape: it is rolled, or slid", part))

            # a limb that is much larger or smaller than the body
            if part in LIMBS and abs(self.growth[part]) > SCALE:
                share, way = 100 * abs(np.expm1(self.growth[part])), "smaller" if self.growth[part] < 0 else "larger"
                found.append(PlausibilityIssue(
                    abs(float(self.growth[part])) / SCALE,
                    f"the {name} is {share:.0f}% {way} than on the template", part))
        return tuple(sorted(found, key=lambda doubt: -doubt.excess))


def limb_doubts(template: Mesh, parts: PersonParts, vertices: np.ndarray) -> tuple[PlausibilityIssue, ...]:
    """What in a registration, vertices (N, 3), metres, no person can do, the gravest first."""
    return limb_measures(template, parts, vertices).doubts(parts.skeleton)


def find_exchanged_sides(template: Mesh, parts: PersonParts, vertices: np.ndarray) -> str | None:
    """Why left and right are exchanged in a registration, vertices (N, 3), metres; None where they are not."""
    measures, names = limb_measures(template, parts, vertices), parts.skeleton.names
    beyond = measures.beyond[:, ROLL]
    both = np.where(MIRROR_PART == np.arange(len(PARTS)), 0.0, np.minimum(beyond, beyond[MIRROR_PART]))
    limb = int(both.argmax())
    # Degrees of roll beyond what people do, of a limb and of the same on the other side: with left and right
    # exchanged the shins have 85 and 77, 71 poses and 46 men have none; a limb that came to lie rolled has none on
    # the other side.
    if both[limb] <= 45:
        return None
    told = " and ".join(f"the {in_words(names[p])} by {abs(measures.angles[p, ROLL]):.0f}"
                        for p in (limb, int(MIRROR_PART[limb])))
    return f"no person's limbs are rolled so, {told} degrees; left and right exchanged, of the landmarks or the scan?"


def limb_measures(template: Mesh, parts: PersonParts, vertices: np.ndarray) -> LimbMeasures:
    """How the parts of a template came to lie on its new vertices (N, 3), metres, against what people do."""
    angles = anatomical_angles(parts.skeleton.fit_rotations(template, vertices) @ parts.R_template_rest)
    bending, growth = part_bending(template, parts.skeleton, vertices)
    shape = np.array([SHAPE[part_kind(part)] for part in PARTS])
    most = (people_do()[2] + shape) * size(template.with_vertices(vertices))
    return LimbMeasures(angles, angle_excess(angles), bending, most, growth - np.median(growth))


def angle_excess(angles: np.ndarray) -> np.ndarray:
    """By how much joint angles (..., 16, 3), degrees, are beyond what any person does."""
    low, high = angle_limits()
    return np.maximum(np.maximum(low - angles, angles - high), 0)


def angle_limits() -> tuple[np.ndarray, np.ndarray]:
    """The lowest and the highest joint angles (16, 3), degrees, that are not doubted."""
    low, high, _ = people_do()
    slack = np.array([SLACK[part_kind(part)] for part in PARTS])
    return low - slack, high + slack


def anatomical_angles(R: np.ndarray) -> np.ndarray:
    """Roll, bend and sideways bend (..., 16, 3), degrees, of every part against its parent; 0 for the root.

    From world rotations R (..., 16, 3, 3) against the rest of the synthetic people. The relative rotation is a roll
    about the bone of the part, followed by the rotation that takes the bone to its new direction the shortest way.
    """
    angles = np.zeros((*R.shape[:-2], 3))
    for part in range(1, len(PARTS)):
        angles[..., part, :] = angles_of_joint(part, R[..., PARENTS[part], :, :], R[..., part, :, :])
    return angles


def angles_of_joint(part: int, R_parent: np.ndarray, R_part: np.ndarray) -> np.ndarray:
    """Those of one part (..., 3), degrees, from its own and its parent's world rotations (..., 3, 3)."""
    roll, bend, side = frames()[part]
    relative = np.swapaxes(R_parent, -1, -2) @ R_part
    about = rolls(relative, roll)
    swing = rotations.log(relative @ rotations.exp(-about[..., None] * roll))
    return np.degrees(np.stack([about, swing @ bend, swing @ side], axis=-1))


@lru_cache(maxsize=1)
def frames() -> np.ndarray:
    """The axes (16, 3, 3) of every part of the synthetic people at rest: along its bone, of bending, and across."""
    anatomy = average_person().anatomy
    out = np.zeros((len(PARTS), 3, 3))
    for part in range(len(PARTS)):
        bone = anatomy.ends[part] - anatomy.joints[part]
        bone /= np.linalg.norm(bone)
        bend = np.array([1.0, 0.0, 0.0])
        if 4 <= part < 10:                                     # arms hang obliquely, and so do the axes of elbows
            bend = np.cross(anatomy.upper_arm_frame[2], anatomy.upper_arm_frame[1])
            bend = bend if part < 7 else bend * [1, -1, -1]
        bend = bend - bone * (bend @ bone)
        bend /= np.linalg.norm(bend)
        out[part] = bone, bend, np.cross(bone, bend)
    return out


def rolls(R: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """The angles (...), radians, about an axis (3,) of rotations R (..., 3, 3): those that leave the least rotation."""
    trace = np.trace(R, axis1=-2, axis2=-1)
    vector = np.stack([R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], axis=-1)
    return np.arctan2(vector @ axis, trace - np.einsum("i,...ij,j->...", axis, R, axis))


def part_bending(template: Mesh, skeleton: Skeleton, vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How far every part is from the nearest enlarged copy of itself (J,), metres RMS, and the logarithm of its growth.

    Vertices (N, 3), metres.
    """
    part, areas = skeleton.part_of_vertex(template), template.vertex_areas
    out = np.zeros((2, len(skeleton.parents)))
    for p in range(len(skeleton.parents)):
        mine = part == p
        out[:, p] = bending(template.vertices[mine], vertices[mine], areas[mine])
    return out[0], out[1]


@lru_cache(maxsize=1)
def people_do() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The lowest and the highest joint angles (16, 3) of people, degrees, and how far parts (16,) bend, of their size.

    Measured on the skin of the average synthetic person in its named poses and some random ones, left and right alike.
    """
    person, rng = average_person(), np.random.default_rng(0)
    # random poses beside the named ones that show what people do
    poses = [*map(find_pose, NAMED_POSES), *(random_pose(rng) for _ in range(60))]
    bodies = np.stack([person.in_pose(pose) for pose in poses])
    angles = anatomical_angles(person.skeleton.fit_rotations(person.mesh, bodies))
    bent = np.stack([part_bending(person.mesh, person.skeleton, body)[0] for body in bodies])
    angles = np.concatenate([angles, angles[:, MIRROR_PART] * [-1, 1, -1]])
    bent = np.concatenate([bent, bent[:, MIRROR_PART]])
    return angles.min(axis=0), angles.max(axis=0), bent.max(axis=0) / size(person.mesh)
