"""Cartoon figures with their landmarks: characters for those who have none at hand.

z is up, a figure faces -y, stands on z = 0, has the left side at +x and its arms 36 degrees away from the body, as the
synthetic people at rest.
"""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from implicit_surface import Bump, Ellipsoid, Field, Group, Mirrored, RoundCone, polygonise, project

from scanprep.geometry.mesh import Mesh

ARM_ANGLE, ELBOW_ANGLE = np.radians([36.0, 14.0])
FINGERS = ((0.30, 1.00, 0.30), (0.0, 1.10, 0.31), (-0.30, 0.95, 0.29))    # across the palm, length, thickness


@dataclass(frozen=True)
class CartoonShape:
    """Proportions of a figure; all but the first are shares of its height."""

    height: float = 1.35
    legs: float = 0.34               # height of the hips
    head: float = 0.155              # radius
    neck: float = 0.025              # what is seen of it
    belly: float = 0.15              # radius, as of chest and limbs
    chest: float = 0.11
    shoulders: float = 0.13          # from the middle to a shoulder
    arms: float = 0.33               # from shoulder to wrist
    limbs: float = 0.036
    hands: float = 0.19
    feet: float = 0.19


CARTOONS = {
    "gnome": CartoonShape(),
    "beanpole": CartoonShape(2.25, 0.55, 0.062, 0.045, 0.058, 0.060, 0.075, 0.40, 0.019, 0.11, 0.135),
}


@dataclass(frozen=True, eq=False)
class Cartoon:
    """A cartoon figure: closed, with landmarks on its skin, joints, and the field that is nought on its skin."""

    mesh: Mesh
    landmarks: dict[str, np.ndarray]
    joints: dict[str, np.ndarray]
    field: Field


def cartoon(shape: CartoonShape | str = "gnome", step: float = 0.008) -> Cartoon:
    """Make a cartoon figure.

    `shape` may be a name of `CARTOONS`; `step` is the spacing of the grid on which its surface is sought, as a share of
    its height.
    """
    if isinstance(shape, str):
        if shape not in CARTOONS:
            raise ValueError(f"shape: expected a CartoonShape or one of {', '.join(CARTOONS)}, got '{shape}'")
        shape = CARTOONS[shape]
    figure = _Figure(shape)
    field = Mirrored(figure.field())
    reach = np.array([0.75, 0.35, 1.05]) * shape.height
    mesh = polygonise(field, np.r_[-reach[:2], -0.05 * shape.height], reach, step * shape.height)
    if mesh.volume < 0:                                              # coarse triangles lie too deep to tell outside
        mesh = Mesh(mesh.vertices, mesh.faces[:, ::-1])
    points = {name: project(field, point[None], 12)[0] for name, point in figure.points().items()}
    landmarks = {full: point * sign for name, point in points.items() for full, sign in _both(name)}
    joints = {full: point * sign for name, point in figure.joints.items() for full, sign in _both(name)}
    ground = mesh.vertices[:, 2].min() * np.array([0, 0, 1.0])
    return Cartoon(mesh.with_vertices(mesh.vertices - ground), {n: p - ground for n, p in landmarks.items()},
                   {n: p - ground for n, p in joints.items()}, lambda p: field(p + ground))


def _both(name: str) -> list[tuple[str, np.ndarray]]:
    """The names on both sides of a name with {}, and what mirrors a point of the left."""
    if "{}" not in name:
        return [(name, np.ones(3))]
    return [(name.format("left"), np.ones(3)), (name.format("right"), np.array([-1.0, 1, 1]))]


def _at(side: float, front: float, up: float) -> np.ndarray:
    return np.array([side, -front, up])


class _Figure:
    """Places on the left half of a figure, metres."""

    def __init__(self, shape: CartoonShape) -> None:
        self.shape, h = shape, shape.height
        self.head = shape.head * h
        top = h - 2.1 * self.head
        self.chin, self.shoulder = top, top - shape.neck * h - 0.45 * shape.chest * h
        self.hip, self.limb, self.belly, self.chest = (h * x for x in (shape.legs, shape.limbs, shape.belly,
                                                                      shape.chest))
        a, b = ARM_ANGLE, ELBOW_ANGLE
        down = _at(np.sin(a), 0, -np.cos(a))
        fore = np.cos(b) * down + np.sin(b) * _at(0, 1, 0)
        out = _at(np.cos(a), 0, np.sin(a))
        self.hand_frame = np.array([np.cross(fore, out), out, fore])          # thumb side, back, fingers
        if self.hand_frame[0, 1] > 0:
            self.hand_frame[0] *= -1
        ankle, wide = 0.33 * shape.feet * h, max(1.25 * self.limb, 0.62 * self.belly)
        shoulder = _at(shape.shoulders * h, 0, self.shoulder)
        elbow = shoulder + 0.52 * shape.arms * h * down
        rise = self.shoulder - self.hip
        self.joints = {
            "abdomen": _at(0, 0, self.hip + 0.22 * rise), "chest": _at(0, 0, self.hip + 0.55 * rise),
            "head": _at(0, 0, self.chin + 0.1 * self.head), "upper_arm_{}": shoulder, "forearm_{}": elbow,
            "hand_{}": elbow + 0.48 * shape.arms * h * fore, "thigh_{}": _at(wide, 0, self.hip),
            "shin_{}": _at(1.04 * wide, 0, 0.5 * (self.hip + ankle)), "foot_{}": _at(1.08 * wide, 0, ankle)}

    def field(self) -> Field:
        """The left half; the mirror makes the rest."""
        s, h, r, j = self.shape, self.shape.height, self.limb, self.joints
        rise, b, c = self.shoulder - self.hip, self.belly, self.chest
        trunk = Group([
            (Ellipsoid(_at(0, 0, self.hip + 0.10 * rise), np.array([0.95, 0.85, 0.75]) * b), 0),
            (Ellipsoid(_at(0, 0.16 * b, self.hip + 0.38 * rise), np.array([1.0, 1.0, 0.95]) * b), 0.4 * b),
            (Ellipsoid(_at(0, 0, self.shoulder - 0.25 * rise), np.array([1.15 * c, 0.85 * c, 0.36 * rise])), 0.5 * c),
            (RoundCone(_at(0, 0, self.shoulder + 0.2 * c), j["upper_arm_{}"], 0.5 * c, 1.15 * r), 0.5 * c),
            (RoundCone(_at(0, 0, self.shoulder), _at(0, 0, self.chin + 0.3 * self.head), 0.55 * c, 0.42 * c), 0.3 * c)])
        leg = Group([(RoundCone(j["thigh_{}"] - [0, 0, 0.02 * h], j["shin_{}"], 1.5 * r, 1.05 * r), 0),
                     (RoundCone(j["shin_{}"], j["foot_{}"], 1.05 * r, 0.8 * r), 0.5 * r), (self._foot(), 0.6 * r)])
        arm = Group([(RoundCone(j["upper_arm_{}"], j["forearm_{}"], 1.15 * r, 0.85 * r), 0),
                     (RoundCone(j["forearm_{}"], j["hand_{}"], 0.85 * r, 0.72 * r), 0.4 * r),
                     (self._hand(), 0.12 * s.hands * h)])
        return Group([(trunk, 0), (leg, 0.6 * r + 0.12 * b), (self._head(), 0.15 * self.head), (arm, 0.8 * r)])

    def _foot(self) -> Field:
        length, ankle = self.shape.feet * self.shape.height, self.joints["foot_{}"]
        half = 0.28 * length
        return Group([(Ellipsoid(_at(ankle[0], 0.22 * length, 0.62 * half), np.array([0.62, 1.75, 0.62]) * half), 0),
                      (Ellipsoid(_at(ankle[0], 0.5 * length, 0.7 * half), np.array([0.78, 0.8, 0.7]) * half),
                       0.5 * half)])

    def _hand(self) -> Field:
        palm = self._palm(0.26, 0, 0)
        size = 0.5 * self.shape.hands * self.shape.height
        parts: list[tuple[Field, float]] = [
            (Ellipsoid(palm, np.array([0.55, 0.30, 0.62]) * size, self.hand_frame), 0.0)]
        for across, length, thick in FINGERS:
            start, end = self._palm(0.40, 0.7 * across, 0), self._palm(0.45 + 0.42 * length, 1.15 * across, 0)
            parts.append((RoundCone(start, end, 0.62 * thick * size, 0.55 * thick * size), 0.06 * size))
        thumb = RoundCone(self._palm(0.18, 0.2, 0), self._palm(0.42, 0.85, 0), 0.2 * size, 0.17 * size)
        return Group([*parts, (thumb, 0.1 * size)])

    def _palm(self, along: float, thumb: float, back: float) -> np.ndarray:
        """A place of the hand: shares of its length along, half of it to the thumb and to its back."""
        size = self.shape.hands * self.shape.height
        return np.asarray(self.joints["hand_{}"] + size * (np.array([0.5 * thumb, 0.5 * back, along])
                                                           @ self.hand_frame))

    def _head(self) -> Field:
        r = self.head
        face = [Bump(self._face(0, 1.0, -0.12), 0.16 * r, np.full(3, 0.13 * r)),
                Bump(self._face(0.33, 0.9, 0.12), -0.03 * r, np.full(3, 0.11 * r)),
                Bump(self._face(0, 0.9, -0.45), -0.02 * r, np.array([0.25, 0.1, 0.05]) * r)]
        return Group([(Ellipsoid(self._face(0, 0, 0.0), np.array([0.98, 1.0, 1.05]) * r), 0),
                      (Ellipsoid(self._face(1.0, 0, 0.0), np.array([0.10, 0.16, 0.22]) * r), 0.06 * r)], face)

    def _face(self, side: float, front: float, up: float) -> np.ndarray:
        """A place of the head, in radii from its middle."""
        return _at(0, 0, self.chin + 1.05 * self.head) + self.head * _at(side, front, up)

    def points(self) -> dict[str, np.ndarray]:
        """Places near the skin by the names of landmarks."""
        j, r, b, c, rise = self.joints, self.limb, self.belly, self.chest, self.shoulder - self.hip
        foot, length = j["foot_{}"], self.shape.feet * self.shape.height
        out, fore = self.hand_frame[1], self.hand_frame[2]
        shoulder, elbow, knee = j["upper_arm_{}"], j["forearm_{}"], j["shin_{}"]
        hip = self.hip
        return {
            "{} toe": _at(foot[0], 0.75 * length, 0.15 * length), "{} heel": _at(foot[0], -0.3 * length, 0.1 * length),
            "{} ankle": foot + [r, 0, 0], "{} knee": knee + _at(0, 1.1 * r, 0),
            "{} knee inside": knee - [1.1 * r, 0, 0],
            "{} waist": _at(b, 0, hip + 0.5 * rise), "crotch": _at(0, 0, hip - 0.7 * b),
            "{} middle finger": self._palm(1.0, 0, 0), "{} thumb": self._palm(0.48, 1.1, 0),
            "{} wrist": j["hand_{}"] + 0.8 * r * out, "{} elbow outside": elbow - _at(0, 0.9 * r, 0),
            "{} elbow inside": elbow + _at(0, 0.9 * r, 0), "{} shoulder": shoulder + [0.3 * r, 0, 1.1 * r],
            "{} armpit": shoulder - 1.15 * r * out + 0.9 * r * fore,
            "{} nipple": _at(0.5 * c, c, self.shoulder - 0.22 * rise), "navel": _at(0, 1.2 * b, hip + 0.36 * rise),
            "back": _at(0, -b, hip + 0.36 * rise), "neck front": _at(0, 0.6 * c, self.shoulder + 0.45 * c),
            "neck back": _at(0, -0.6 * c, self.shoulder + 0.45 * c), "{} eye": self._face(0.33, 0.95, 0.12),
            "nose tip": self._face(0, 1.2, -0.12), "mouth": self._face(0, 0.9, -0.45),
            "chin": self._face(0, 0.75, -0.75), "{} ear": self._face(1.12, 0, 0), "top of head": self._face(0, 0, 1.05),
            "{} hip": _at(b, 0, hip)}
