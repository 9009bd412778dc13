"""Find what no person can do in a finished registration: twisted limbs, and skin that slid.

A forearm twisted about its bone lies on the scan as well as the right one, so distances say nothing. Joint angles do,
compared with those of people. The skin does too: a part in the wrong place must bend and stretch to fit there.

What is normal is measured on the synthetic people in the same way: by the rotation that best carries the whole skin of
a part. So the lag of skin behind its bones affects both sides alike.
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

ROLL, BEND, SIDE = range(3)            # columns of joint angles
# Degrees by which joints of real people exceed those of the synthetic ones (roll, bend, side). Measured on the true
# bodies of 56 scans of one man, none held out. Rolls cover 99 of 100, so that twisted limbs are still detected. Bends
# are five degrees beyond the largest, because registered hands bend a little too much.
SLACK = {"pelvis": (0, 0, 0), "abdomen": (20, 42, 20), "chest": (20, 24, 20), "head": (25, 40, 25),
         "upper_arm": (20, 20, 20), "forearm": (35, 21, 63), "hand": (55, 66, 64), "thigh": (20, 20, 20),
         "shin": (35, 22, 75), "foot": (20, 30, 66)}
# How much muscles and build may add to the skin bending of a part, as a share of the body's size. True bodies have up
# to 0.0025 more. Registered ones are smoother, and a larger allowance would miss a head twisted by 45 degrees.
SHAPE = {"pelvis": 0.01, "abdomen": 0.01, "chest": 0.01, "head": 0.006, "upper_arm": 0.008, "forearm": 0.008,
         "hand": 0.008, "thigh": 0.012, "shin": 0.008, "foot": 0.008}
# Parts that can be elsewhere though their neighbours are seen, and the share of one below which that is told.
ENDS, HIDDEN = ("head", "forearm", "hand", "shin", "foot"), 0.05
LIMBS = range(3, len(PARTS))           # head, arms and legs; the trunk depends on the build
SCALE = 0.18                           # log-scale that one limb may differ from the whole body, 20%
GRAVE = 30                             # degrees beyond the limit that double the severity


@dataclass(frozen=True)
class PlausibilityIssue:
    """Something that no person can do: its severity, 1 at the limit, in words, and of which part."""

    excess: float
    words: str
    part: int = field(default=-1, compare=False)


@dataclass(frozen=True, eq=False)
class LimbMeasures:
    """Joint angles and skin bending of a registered person, and their limits.

    Attributes
    ----------
    angles : (16, 3) float, degrees
        Roll, bend and sideways bend of each part against its parent, from the rest pose of the synthetic people.
    beyond : (16, 3) float, degrees
        How far the angles exceed what people do.
    bending : (16,) float, metres
        RMS distance of the skin of a part from a scaled rigid copy of the template's.
    most : (16,) float, metres
        The most bending that people have.
    growth : (16,) float
        Logarithm of the scale of each part against the median part.
    """

    angles: np.ndarray
    beyond: np.ndarray
    bending: np.ndarray
    most: np.ndarray
    growth: np.ndarray

    def doubts(self, skeleton: Skeleton) -> tuple[PlausibilityIssue, ...]:
        """List what is implausible, worst first."""
        issues: list[PlausibilityIssue] = []
        moved = ("rolled", "bent", "bent sideways")
        for part in range(1, len(PARTS)):
            name, parent = (in_words(skeleton.names[k]) for k in (part, skeleton.parents[part]))

            # a joint that is beyond what people do; 30 degrees beyond it double the severity
            kind = int(self.beyond[part].argmax())
            if self.beyond[part, kind] > 0:
                angle = abs(self.angles[part, kind])
                issues.append(PlausibilityIssue(
                    1 + float(self.beyond[part, kind]) / GRAVE,
                    f"the {name} is {moved[kind]} by {angle:.0f} degrees against the {parent}", part))

            # skin that is far from any scaled copy of the template's
            if part in LIMBS and self.bending[part] > self.most[part]:
                off = 1e3 * self.bending[part]
                issues.append(PlausibilityIssue(
                    float(self.bending[part] / self.most[part]),
                    f"the skin of the {name} is {off:.0f} mm out of shape: it is rolled, or slid", part))

            # a limb that is much larger or smaller than the body
            if part in LIMBS and abs(self.growth[part]) > SCALE:
                share, way = 100 * abs(np.expm1(self.growth[part])), "smaller" if self.growth[part] < 0 else "larger"
                issues.append(PlausibilityIssue(
                    abs(float(self.growth[part])) / SCALE,
                    f"the {name} is {share:.0f}% {way} than on the template", part))
        return tuple(sorted(issues, key=lambda doubt: -doubt.excess))


def limb_doubts(template: Mesh, parts: PersonParts, vertices: np.ndarray) -> tuple[PlausibilityIssue, ...]:
    """List what no person can do in a registration, vertices (N, 3), metres, worst first."""
    return limb_measures(template, parts, vertices).doubts(parts.skeleton)


def hidden_doubts(parts: PersonParts, mesh: Mesh, seen: np.ndarray) -> tuple[PlausibilityIssue, ...]:
    """List limbs of a registered mesh whose place is a guess: `seen` (N,) bool hardly marks any vertex with data."""
    skeleton, shown = parts.skeleton, seen[mesh.faces].mean(axis=1)
    share = np.bincount(skeleton.part_of_face, mesh.face_areas * shown) / np.bincount(
        skeleton.part_of_face, mesh.face_areas)
    return tuple(PlausibilityIssue(1.0, f"hardly anything of the {in_words(name)} was seen: its place is a guess")
                 for name, of_part in zip(skeleton.names, share, strict=True)
                 if part_kind(name) in ENDS and of_part < HIDDEN)


def find_exchanged_sides(template: Mesh, parts: PersonParts, vertices: np.ndarray) -> str | None:
    """Detect exchanged left and right in a registration, vertices (N, 3), metres; the reason in words, or None."""
    measures, names = limb_measures(template, parts, vertices), parts.skeleton.names
    beyond = measures.beyond[:, ROLL]
    # a limb and its mirror image must both be rolled: the smaller roll counts; the trunk has no mirror image
    both = np.where(MIRROR_PART == np.arange(len(PARTS)), 0.0, np.minimum(beyond, beyond[MIRROR_PART]))
    limb = int(both.argmax())
    # 45 degrees of roll beyond the limit on both sides. With left and right exchanged the shins have 85 and 77; correct
    # registrations of 71 poses and 46 men have none. A single twisted limb has none on the other side.
    if both[limb] <= 45:
        return None
    limbs = " and ".join(f"the {in_words(names[p])} by {abs(measures.angles[p, ROLL]):.0f}"
                         for p in (limb, int(MIRROR_PART[limb])))
    return f"no person's limbs are rolled so, {limbs} degrees; left and right exchanged, of the landmarks or the scan?"


def limb_measures(template: Mesh, parts: PersonParts, vertices: np.ndarray) -> LimbMeasures:
    """Measure joint angles and skin bending of a registration, vertices (N, 3), metres, with their limits."""
    angles = part_angles(parts.skeleton.fit_rotations(template, vertices) @ parts.R_template_rest)
    bending, growth = part_bending(template, parts.skeleton, vertices)
    shape = np.array([SHAPE[part_kind(part)] for part in PARTS])
    most = (people_do()[2] + shape) * size(template.with_vertices(vertices))
    return LimbMeasures(angles, angle_excess(angles), bending, most, growth - np.median(growth))


def angle_excess(angles: np.ndarray) -> np.ndarray:
    """Return how far joint angles (..., 16, 3), degrees, exceed what people do; 0 within the limits."""
    low, high = angle_limits()
    return np.maximum(np.maximum(low - angles, angles - high), 0)


def angle_limits() -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and the highest plausible joint angles (16, 3), degrees."""
    low, high, _ = people_do()
    slack = np.array([SLACK[part_kind(part)] for part in PARTS])
    return low - slack, high + slack


def part_angles(R: np.ndarray) -> np.ndarray:
    """Compute roll, bend and sideways bend (..., 16, 3), degrees, of every part against its parent; 0 for the root.

    World rotations R (..., 16, 3, 3) are from the rest pose of the synthetic people. The relative rotation is split
    into a roll about the bone and a swing, the shortest rotation of the bone to its new direction.
    """
    angles = np.zeros((*R.shape[:-2], 3))
    for part in range(1, len(PARTS)):
        angles[..., part, :] = angles_of_joint(part, R[..., PARENTS[part], :, :], R[..., part, :, :])
    return angles


def angles_of_joint(part: int, R_parent: np.ndarray, R_part: np.ndarray) -> np.ndarray:
    """Compute roll, bend and sideways bend (..., 3), degrees, of one part from its own and its parent's rotation."""
    roll, bend, side = frames()[part]
    relative = np.swapaxes(R_parent, -1, -2) @ R_part
    about = rolls(relative, roll)
    swing = rotations.log(relative @ rotations.exp(-about[..., None] * roll))
    return np.degrees(np.stack([about, swing @ bend, swing @ side], axis=-1))


@lru_cache(maxsize=1)
def frames() -> np.ndarray:
    """Return the axes (16, 3, 3) of every synthetic part at rest: its bone, the axis it bends about, the third."""
    anatomy = average_person().anatomy
    out = np.zeros((len(PARTS), 3, 3))
    for part in range(len(PARTS)):
        bone = anatomy.ends[part] - anatomy.joints[part]
        bone /= np.linalg.norm(bone)
        # trunk and legs bend about the left-right axis, x
        bend = np.array([1.0, 0.0, 0.0])
        if 4 <= part < 10:                                # arms at rest hang obliquely, so their elbow axes are oblique
            bend = np.cross(anatomy.upper_arm_frame[2], anatomy.upper_arm_frame[1])
            bend = bend if part < 7 else bend * [1, -1, -1]
        bend = bend - bone * (bend @ bone)
        bend /= np.linalg.norm(bend)
        out[part] = bone, bend, np.cross(bone, bend)
    return out


def rolls(R: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """Compute the twist angles (...), radians, of rotations R (..., 3, 3) about an axis (3,): those nearest to R."""
    trace = np.trace(R, axis1=-2, axis2=-1)
    vector = np.stack([R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], axis=-1)
    return np.arctan2(vector @ axis, trace - np.einsum("i,...ij,j->...", axis, R, axis))


def part_bending(template: Mesh, skeleton: Skeleton, vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Measure how far every part is from a scaled rigid copy of itself (J,), metres RMS, and the log of its scale (J,).

    `vertices` (N, 3), metres.
    """
    part, areas = skeleton.part_of_vertex(template), template.vertex_areas
    out = np.zeros((2, len(skeleton.parents)))
    for p in range(len(skeleton.parents)):
        own = part == p
        out[:, p] = bending(template.vertices[own], vertices[own], areas[own])
    return out[0], out[1]


@lru_cache(maxsize=1)
def people_do() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the lowest and the highest joint angles (16, 3) of people, degrees, and the most bending (16,) per size.

    Measured on the skin of the average synthetic person in its named poses and some random ones, left and right alike.
    """
    person, rng = average_person(), np.random.default_rng(0)
    # sixty random poses beside the named ones cover the range of motion
    poses = [*map(find_pose, NAMED_POSES), *(random_pose(rng) for _ in range(60))]
    bodies = np.stack([person.in_pose(pose) for pose in poses])
    angles = part_angles(person.skeleton.fit_rotations(person.mesh, bodies))
    bent = np.stack([part_bending(person.mesh, person.skeleton, body)[0] for body in bodies])
    # add the mirrored poses: roll and sideways bend change sign
    angles = np.concatenate([angles, angles[:, MIRROR_PART] * [-1, 1, -1]])
    bent = np.concatenate([bent, bent[:, MIRROR_PART]])
    return angles.min(axis=0), angles.max(axis=0), bent.max(axis=0) / size(person.mesh)
