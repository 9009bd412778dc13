"""The shape of one synthetic person, and the skeleton at rest.

z is up, the person faces -y and stands on z = 0; the left side is +x. All people have the same rest pose: only the
lengths of their bones differ.
"""
from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from .population import MIRROR_PART, PARENTS, PARTS, population

__all__ = ["MIRROR_PART", "PARENTS", "PARTS", "BodyShape", "RestFrames"]

Sex = Literal["female", "male"]
# degrees in the rest pose: arms from the vertical, forearms bent forwards, legs sideways and backwards, feet outwards;
# an A-pose, in which scanners see armpits and the inner sides of the legs
ARM_ANGLE, ELBOW_ANGLE, LEG_ANGLE, LEG_LEAN, TOE_OUT = np.radians([36.0, 14.0, 6.0, 2.3, 9.0])


@dataclass(frozen=True)
class BodyShape:
    """A person of the built-in population: the sex, which decides how far muscles swell, and betas.

    Parameters
    ----------
    sex : 'female' or 'male'
        Sex.
    betas : (K,) float, standard deviations
        Shape coefficients; without them the average of the sex.

    Examples
    --------
    >>> from scanprep.synthetic.people import BodyShape, SyntheticPerson
    >>> tall = SyntheticPerson(BodyShape.like("male", stature=1.90))
    >>> round(float(tall.mesh.vertices[:, 2].max()), 2)
    1.9
    """

    sex: Sex = "male"
    betas: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if self.sex not in ("female", "male"):
            raise ValueError(f"sex: expected 'female' or 'male', got {self.sex!r}")
        count = len(population().directions)
        betas = np.asarray(self.betas if len(self.betas) else population().moments[self.sex][0], dtype=np.float64)
        if betas.ndim != 1 or len(betas) > count or not np.isfinite(betas).all():
            raise ValueError(f"betas: expected at most {count} finite numbers, got {self.betas!r}")
        object.__setattr__(self, "betas", tuple(map(float, betas)))

    @staticmethod
    def random(rng: np.random.Generator, sex: Sex | None = None) -> BodyShape:
        """Draw a person from the population, of either sex unless one is given."""
        if sex is None:
            sex = "male" if rng.random() < 0.5 else "female"
        mean, covariance = population().moments[sex]
        root = np.linalg.cholesky(covariance + 1e-12 * np.eye(len(mean)))
        z = rng.standard_normal(len(mean))
        # 3 standard deviations: bodies beyond are so unusual that `implausible_body` doubts them
        while (far := np.abs(z) > 3.0).any():
            z[far] = rng.standard_normal(far.sum())
        return BodyShape(sex, tuple(mean + root @ z))

    @staticmethod
    def like(sex: Sex = "male", stature: float | None = None, weight: float | None = None) -> BodyShape:
        """Return the most likely person of a sex with a stature, metres, and a weight.

        The weight is in standard deviations of the second beta, from the average of people of that stature.
        """
        mean, covariance = population().moments[sex]
        betas = mean.copy()
        if weight is not None:
            # covariance of the betas among people of equal stature
            conditional = covariance - np.outer(covariance[:, 0], covariance[0]) / covariance[0, 0]
            betas += weight * conditional[:, 1] / np.sqrt(conditional[1, 1])
        if stature is not None:
            direction, count = covariance[:, 0] / covariance[0, 0], len(population().weights)
            # Newton steps along the direction in which betas change with stature
            for _ in range(3):               # stature is almost linear in the first beta
                height, height_after = (population().rows(b)[:count, 2].max() for b in (betas, betas + direction))
                betas += direction * (stature - height) / (height_after - height)
        return BodyShape(sex, tuple(betas))


class RestFrames:
    """Joints and bone frames of one person at rest.

    `joints` (16, 3), metres, are the centres of rotation of the parts; that of part 0 is the middle between the hips.
    `ends` (16, 3) are the far ends of their bones. Frames (3, 3) of limbs have rows outwards, ahead and along the bone.
    """

    def __init__(self, shape: BodyShape) -> None:
        self.shape = shape
        rows = population().rows(np.array(shape.betas))
        n = len(population().weights)
        self.vertices, self.joints, self.ends, self.eye = rows[:n], rows[n:n + 16], rows[n + 16:n + 32], rows[n + 32]
        self.stature = float(self.vertices[:, 2].max())
        # tables of muscles and poses hold lengths for a person of 1.75 m
        self.scale = self.stature / 1.75

        def vector(side: float, front: float, up: float) -> np.ndarray:
            """Return a vector from its parts sideways, frontwards and upwards."""
            return np.array([side, -front, up])

        # frames of arm, forearm, leg and foot on the left side, from the angles of the rest pose
        a, b, c, lean, t = ARM_ANGLE, ELBOW_ANGLE, LEG_ANGLE, LEG_LEAN, TOE_OUT
        down = vector(np.sin(a), 0, -np.cos(a))
        out = vector(np.cos(a), 0, np.sin(a))
        ahead = vector(0, 1, 0)
        self.upper_arm_frame = np.array([out, ahead, down])
        self.forearm_frame = np.array([out, np.cos(b) * ahead - np.sin(b) * down, np.cos(b) * down + np.sin(b) * ahead])
        leg = vector(np.sin(c), 0, -np.cos(c))
        self.leg_frame = np.array([vector(np.cos(c), 0, np.sin(c)), np.cos(lean) * ahead + np.sin(lean) * leg,
                                   np.cos(lean) * leg - np.sin(lean) * ahead])
        self.foot_frame = np.array([vector(np.cos(t), -np.sin(t), 0), vector(0, 0, 1), vector(np.sin(t), np.cos(t), 0)])
        # stored joints are rounded: put the ends of bones exactly on the axes; feet roll about a level axis
        for first, frame in ((4, self.upper_arm_frame), (5, self.forearm_frame), (10, self.leg_frame),
                             (11, self.leg_frame), (12, self.foot_frame)):
            for part, flip in ((first, [1, 1, 1]), (first + 3, [-1, 1, 1])):
                way = (self.ends[part] - self.joints[part]) * ([1, 1, 0] if first == 12 else 1)
                self.ends[part] = self.joints[part] + np.linalg.norm(way) * frame[2] * flip
                if first != 12:
                    self.joints[part + 1] = self.ends[part]

    def at(self, level: float) -> float:
        """Return the height in metres of a level of the trunk: 0 is the hip joints, 1 the shoulder joints."""
        hip, shoulder = self.joints[10, 2], self.joints[4, 2]
        return float(hip + level * (shoulder - hip))
