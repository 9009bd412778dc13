"""The surfaces of the parts of the body, each a function of the anatomy."""
from __future__ import annotations

import numpy as np

from .anatomy import Anatomy, tables
from .implicit_surface import Bump, Ellipsoid, Field, Group, Loft, Mirrored, RoundCone

UPRIGHT = np.array([[1.0, 0, 0], [0, -1.0, 0], [0, 0, 1.0]])       # rows: sideways, frontwards, up


def body_surface(a: Anatomy) -> Field:
    """The implicit surface of the whole body at rest."""
    torso, shoulders = trunk(a)
    body: list[tuple[Field, float]] = [*torso, (leg(a), 0.035 * a.scale)]
    left = Group([(Group(body), 0), *shoulders, (arm(a), 0.048 * a.scale)], trunk_bumps(a))
    return Mirrored(Group([(left, 0), (head(a), 0.012), (hand(a), 0.012)]))


def cross_sections(at: np.ndarray, out: np.ndarray, inner: np.ndarray, front: np.ndarray, back: np.ndarray,
                   exponent: np.ndarray | float = 2.1, side: np.ndarray | float = 0.0,
                   fore: np.ndarray | float = 0.0) -> np.ndarray:
    """Keys of a Loft (k, 8) from columns that are broadcast against each other."""
    return np.stack(np.broadcast_arrays(at, side, fore, out, inner, front, back, exponent), axis=1)


def trunk(a: Anatomy) -> tuple[list[tuple[Field, float]], list[tuple[Field, float]]]:
    """Trunk with buttocks and breasts; neck and shoulder line."""
    s, g, man = a.shape, a.scale, a.man
    table = man * tables.trunk_man + (1 - man) * tables.trunk_woman
    fat = man * tables.trunk_fat + (1 - man) * tables.trunk_fat_woman
    body = table[:, 1:4] + a.fat * fat + s.muscle * tables.trunk_muscle
    up = table[:, 0]
    belly = np.exp(-((up - 0.28) / 0.20)**2)
    body[:, 1] += s.belly * 0.017 * belly
    body[:, 0] += s.belly * 0.005 * belly + s.hip_width * 0.006 * np.exp(-((up - 0.02) / 0.2)**2)
    ribs = np.exp(-((up - 0.74) / 0.2)**2)
    body[:, 1] += s.chest * 0.006 * ribs * (0.4 + 0.6 * man)
    body[:, 2] += s.chest * 0.004 * ribs
    body[:, 0] += (s.shoulder_width * 0.005 + s.chest * 0.004 * man) * ribs
    body = np.maximum(body, [0.05, 0.004, 0.03]) * g
    body[:, 1] = np.where(up > 1, np.maximum(body[:, 1], 0.004), body[:, 1])
    at = np.array([a.at(u) for u in up])
    main = Loft(np.zeros(3), UPRIGHT, cross_sections(at, body[:, 0], body[:, 0], body[:, 1], body[:, 2], table[:, 4]),
                (0.03 * g, 0.03 * g))
    members: list[tuple[Field, float]] = [(main, 0)]
    fatness = 0.7 * a.fat + 0.25 * s.hip_width
    r = g * np.array([0.076 + 0.004 * (1 - man), 0.068 + 0.005 * (1 - man), 0.083])
    r = r + g * np.array([0.006, 0.009, 0.007]) * fatness + g * np.array([0.002, 0.003, 0.002]) * s.muscle
    members.append((Ellipsoid(a.front(0.072 * g, -0.058 * g, a.at(-0.06)), r), 0.06 * g))
    if man < 1:
        members.append((breast(a), 0.030 * g))
    return members, [(neck(a), 0.03 * g), *((t, 0.06 * g) for t in shoulder_line(a))]


def breast(a: Anatomy) -> Field:
    """The breast of a woman, shrinking into the chest towards the man."""
    s, g = a.shape, a.scale
    size = (1 - a.man) * (1 + 0.10 * s.chest + 0.09 * a.fat)
    size = max(size, 0.05)
    r = g * np.array([0.060, 0.056, 0.058]) * size**0.7
    drop = 0.012 * (size - 1)
    depth = (0.052 + 0.011 * a.fat + 0.012 * (size - 1)) - 0.04 * a.man
    tilt = np.radians(16)
    frame = np.array([[np.cos(tilt), np.sin(tilt), 0], [np.sin(tilt), -np.cos(tilt), 0], [0, 0, 1.0]])
    return Ellipsoid(a.front((0.071 + 0.004 * a.fat) * g, depth * g, a.at(0.665) - drop * g), r, frame)


def neck(a: Anatomy) -> Field:
    """Neck, from between the shoulders to the skull."""
    s, g = a.shape, a.scale
    low, high = a.front(0, -0.036 * g, a.level["neck"] - 0.055 * g), a.front(0, 0.001 * g, a.level["head"] + 0.03)
    axis = high - low
    length = np.linalg.norm(axis)
    axis = axis / length
    front = np.cross([1.0, 0, 0], axis)
    front = -front if front[1] > 0 else front
    part = np.array([0.0, 0.3, 0.6, 0.85, 1.0])
    thick = (0.915 - 0.125 * (1 - a.man)) * g**0.5 * a.head_scale**0.5 * np.ones(5)
    grow = 0.0035 * a.fat + 0.003 * s.muscle
    side = np.array([0.070, 0.062, 0.059, 0.059, 0.061]) * thick + grow
    fore = np.array([0.052, 0.056, 0.057, 0.055, 0.052]) * thick + grow * 1.1
    back = np.array([0.054, 0.055, 0.056, 0.060, 0.066]) * thick + grow
    return Loft(low, np.array([[1.0, 0, 0], front, axis]), cross_sections(part * length, side, side, fore, back),
                (0.03, 0.03))


def shoulder_line(a: Anatomy) -> list[Field]:
    """Trapezius and the top of the shoulder."""
    s, g = a.shape, a.scale
    r = g * (0.020 + 0.004 * a.man + 0.003 * s.muscle + 0.0015 * a.fat)
    shoulder = a.joints[4]
    top = shoulder + a.front(-0.020 * g, 0.002 * g, 0.026 * g)
    mid = a.front(0.52 * shoulder[0], -0.040 * g, a.level["neck"] - 0.010 * g)
    return [RoundCone(a.front(0.028 * g, -0.048 * g, a.level["neck"] + 0.020 * g), mid, r * 0.8, r),
            RoundCone(mid, top, r, r * 0.9)]


def _limb(origin: np.ndarray, frame: np.ndarray, at: np.ndarray, extents: np.ndarray,
          caps: tuple[float, float], exponent: float = 2.1) -> Loft:
    extents = np.maximum(extents, 0.012)
    out, inner, front, back = extents.T
    return Loft(origin, frame, cross_sections(at, out, inner, front, back, exponent), caps)


Triple = tuple[float, float, float]


def _bumps(origin: np.ndarray, frame: np.ndarray, scale: float, rises: list[tuple[Triple, float, Triple]]
           ) -> list[Bump]:
    """Bumps from places in a frame, heights and widths on a body of average size."""
    return [Bump(origin + frame.T @ np.array(at) * scale, height * scale, np.array(widths) * scale, frame)
            for at, height, widths in rises]


def leg(a: Anatomy) -> Field:
    """Leg and foot."""
    s, g = a.shape, a.scale
    own = a.man + (1 - a.man) * tables.stature["woman"] / tables.stature["man"]    # the tables are for a man's size
    table = a.man * tables.leg_man + (1 - a.man) * tables.leg_woman
    fat = a.fat * (1.0 + 0.25 * (1 - a.man)) + 0.7 * s.limbs
    grown = fat * tables.leg_fat[:, None] * [1.2, 0.45, 1.0, 1.0] + s.muscle * tables.leg_muscle
    extents = table[:, 1:] * (1 - 0.035 * (1 - a.man)) + grown * own
    extents = extents * g
    thigh = np.linalg.norm(a.joints[11] - a.joints[10])
    shin = np.linalg.norm(a.joints[12] - a.joints[11])
    at = np.interp(table[:, 0], [-1, 0, 1, 2, 3], [-thigh, 0, thigh, thigh + shin, thigh + 2 * shin])
    shank = _limb(a.joints[10], a.leg_frame, at, extents, (0.02 * g, 0.012 * g))
    knee, ankle, f = a.joints[11], a.joints[12], a.leg_frame
    bumps = _bumps(knee, f, g, [((0.0, 0.052, -0.012), 0.007, (0.019, 0.03, 0.024)),
                                ((0.0, 0.045, 0.055), 0.004, (0.014, 0.03, 0.016)),
                                ((0.030, -0.05, 0.0), 0.003, (0.008, 0.02, 0.04)),
                                ((-0.030, -0.05, 0.0), 0.003, (0.008, 0.02, 0.04))])
    bumps += _bumps(ankle, f, g, [((0.036, -0.006, -0.002), 0.007, (0.012, 0.010, 0.012)),
                                  ((-0.034, 0.004, -0.010), 0.007, (0.012, 0.011, 0.012)),
                                  ((0.022, -0.035, -0.035), -0.005, (0.012, 0.014, 0.05)),
                                  ((-0.022, -0.035, -0.035), -0.005, (0.012, 0.014, 0.05))])
    return Group([(shank, 0), (foot(a), 0.022 * g)], bumps,
                 (a.joints[10] + [0, 0, 0.05], np.array([ankle[0], ankle[1] - 0.05, 0.02]), 0.29 * g))


def foot(a: Anatomy) -> Field:
    """Foot with five toes, sole on the floor."""
    length = a.width["foot"]
    frame = a.foot_frame
    ankle = a.joints[12]
    sole = 0.140 * length
    origin = np.array([ankle[0], ankle[1], sole])
    t, shift, half, top, bottom = (tables.foot * length).T
    centre, extent = (top - bottom) / 2, (top + bottom) / 2
    wide = 1 + 0.02 * a.fat
    main = Loft(origin, frame, cross_sections(t, half * wide, half * wide, extent, extent, 2.8, shift, centre),
                (0.018 * length, 0.03 * length))
    members: list[tuple[Field, float]] = [(main, 0)]
    toes = [(-0.113, 0.55, 0.745, 0.046), (-0.030, 0.55, 0.752, 0.034), (0.035, 0.53, 0.722, 0.032),
            (0.093, 0.50, 0.680, 0.031), (0.146, 0.46, 0.630, 0.030)]
    for side, start, end, r in toes:
        first = origin + length * (frame.T @ np.array([side * 0.95, r * 1.15 - 0.140, start]))
        last = origin + length * (frame.T @ np.array([side, r - 0.140, end]))
        members.append((RoundCone(first, last, r * 1.15 * length, r * length), 0.020 * length))
    return Group(members, bounds=(origin, origin + frame.T @ np.array([0, 0, 0.5]) * length, 0.55 * length))


def arm(a: Anatomy) -> Field:
    """Upper arm and forearm."""
    s, g = a.shape, a.scale
    thin = (a.man + (1 - a.man) * tables.arm_woman) * g
    fat = a.fat * (1.0 + 0.2 * (1 - a.man)) + 0.6 * s.limbs
    upper, fore = tables.upper_arm_man, tables.forearm_man
    extents = upper[:, 1:] + fat * tables.upper_arm_fat[:, None] + s.muscle * tables.upper_arm_muscle
    first = _limb(a.joints[4], a.upper_arm_frame, upper[:, 0] * a.width["upper_arm"], extents * thin,
                  (0.03 * g, 0.02 * g))
    extents = fore[:, 1:] + fat * tables.forearm_fat[:, None] + s.muscle * tables.forearm_muscle[:, None]
    second = _limb(a.joints[5], a.forearm_frame, fore[:, 0] * a.width["forearm"], extents * thin,
                   (0.02 * g, 0.006 * g))
    elbow, wrist, f = a.joints[5], a.joints[6], a.forearm_frame
    bumps = _bumps(elbow, f, g, [((0.0, -0.037, -0.004), 0.006, (0.012, 0.02, 0.016)),
                                 ((-0.034, -0.006, -0.010), 0.004, (0.015, 0.011, 0.014))])
    bumps += _bumps(wrist, f, g, [((0.018, -0.018, -0.015), 0.004, (0.01, 0.009, 0.010))])
    return Group([(first, 0), (second, 0.018 * g)], bumps, (a.joints[4], wrist, 0.20 * g))


def hand(a: Anatomy) -> Field:
    """Palm, four fingers slightly apart and curled, thumb."""
    L = a.width["hand"] / 0.19
    f, wrist = a.forearm_frame, a.joints[6]
    wide = L * (a.man + (1 - a.man) * 0.94) * (1 + 0.012 * a.fat)

    def at(palm: float, thumb: float, along: float) -> np.ndarray:
        return wrist + f.T @ np.array([-palm * wide, thumb * wide, along * L])

    t = np.array([-0.012, 0.015, 0.04, 0.07, 0.092]) * L
    thick = np.array([0.0195, 0.0185, 0.0165, 0.0145, 0.0115]) * wide
    front = np.array([0.0275, 0.031, 0.037, 0.041, 0.041]) * wide
    back = np.array([0.0275, 0.031, 0.037, 0.040, 0.038]) * wide
    palm = Loft(wrist, f, cross_sections(t, thick * 0.85, thick * 1.05, front, back, 2.5), (0.006 * L, 0.010 * L))
    members: list[tuple[Field, float]] = [(palm, 0)]
    fingers = [(0.0318, 0.0425, 0.072, 0.0088, 0.0), (0.0108, 0.0145, 0.080, 0.0091, 0.003),
               (-0.0107, -0.0140, 0.074, 0.0087, 0.001), (-0.0310, -0.0410, 0.058, 0.0080, -0.006)]
    for base, tip, length, r, start in fingers:
        s0, middle, end = 0.088 + start, 0.098 + start + 0.5 * length, 0.098 + start + length - r
        bent, far = at(0.006, 0.5 * (base + tip), middle), at(0.017, tip, end)
        members += [(RoundCone(at(0.0005, base, s0), bent, r * 1.06 * wide, r * 0.97 * wide), 0.005 * L),
                    (RoundCone(bent, far, r * 0.97 * wide, r * 0.80 * wide), 0.003 * L)]
    members.append((RoundCone(at(0.001, 0.030, 0.100), at(0.001, -0.028, 0.094), 0.0062 * wide, 0.0062 * wide),
                    0.006 * L))
    thumb = [at(0.006, 0.018, 0.018), at(0.013, 0.044, 0.052), at(0.016, 0.056, 0.078), at(0.016, 0.061, 0.104)]
    for first, last, r0, r1, k in ((thumb[0], thumb[1], 0.0165, 0.0125, 0.016),
                                   (thumb[1], thumb[2], 0.0125, 0.0105, 0.006),
                                   (thumb[2], thumb[3], 0.0108, 0.0082, 0.004)):
        members.append((RoundCone(first, last, r0 * wide, r1 * wide), k * L))
    return Group(members, bounds=(at(0, 0, 0.03), at(0, 0, 0.15), 0.15 * L))


def trunk_bumps(a: Anatomy) -> list[Bump]:
    """Muscles, bones and hollows of the trunk."""
    s, g, man = a.shape, a.scale, a.man
    lean = np.clip(1 - 0.35 * a.fat, 0.25, 1.6)
    firm = np.clip(1 + 0.35 * s.muscle, 0.4, 2.2)
    deep = 0.011 * a.fat

    def bump(side: float, front: float, level: float, height: float, widths: tuple[float, float, float]) -> Bump:
        return Bump(a.front(side * g, front * g, a.at(level)), height * g, np.array(widths) * g)

    shoulder = a.joints[4]
    collar = np.array([shoulder[0] / g * 0.5, 0.030, 0.97])
    turn = np.radians(12)
    along = np.array([[np.cos(turn), np.sin(turn) * 0.9, np.sin(turn) * 0.5], [0, 1.0, 0], [0, 0, 1.0]])
    along[0] /= np.linalg.norm(along[0])
    along[2] = np.cross(along[0], [0, 1.0, 0])
    along[2] /= -np.linalg.norm(along[2]) if along[2, 2] < 0 else np.linalg.norm(along[2])
    along[1] = np.cross(along[2], along[0])
    clavicle = Bump(a.front(collar[0] * g, collar[1] * g, a.at(collar[2])), 0.005 * lean * g,
                    np.array([0.045, 0.03, 0.0075]) * g, along)
    return [clavicle,
            bump(0.080, 0.105, 0.745, 0.014 * man * firm, (0.048, 0.05, 0.038)),
            bump(0.080, 0.105, 0.610, -0.006 * man * lean, (0.045, 0.05, 0.015)),
            bump(0.0, 0.115, 0.76, -0.006 * (0.5 + 0.5 * man), (0.012, 0.06, 0.075)),
            bump(0.088 if man > 0.5 else 0.080, 0.11, 0.690, 0.0025, (0.008, 0.06, 0.008)),
            bump(0.0, 0.10 + deep, 0.45, -0.004 * lean, (0.011, 0.06, 0.075)),
            bump(0.0, 0.105 + 2 * deep, 0.27, -0.010, (0.0095, 0.06, 0.0085)),
            bump(0.0, 0.035, 1.00, -0.007 * lean, (0.012, 0.03, 0.012)),
            bump(0.050, 0.02, 1.06, -0.006 * lean, (0.025, 0.03, 0.015)),
            bump(0.0, -0.10, 0.46, -0.009, (0.013, 0.05, 0.15)),
            bump(0.038, -0.09, 0.36, 0.005 * firm, (0.020, 0.04, 0.10)),
            bump(0.085, -0.12, 0.82, 0.007 * lean, (0.035, 0.03, 0.050)),
            bump(0.0, -0.12, 0.85, -0.004, (0.018, 0.04, 0.07)),
            bump(0.0, -0.090, 1.09, 0.004 * lean, (0.016, 0.03, 0.014)),
            bump(0.0, -0.135, -0.10, -0.026, (0.011, 0.05, 0.060)),
            bump(0.110, 0.09, 0.15, 0.004 * lean, (0.022, 0.03, 0.020)),
            bump(0.070, 0.09, -0.03, -0.004, (0.030, 0.04, 0.016)),
            bump(0.0, 0.075, -0.165, 0.017 * man, (0.026, 0.04, 0.030))]


def head(a: Anatomy) -> Field:
    """Skull, face and ears."""
    s, h, man = a.shape, a.head_scale, a.man

    def at(side: float, front: float, up: float) -> np.ndarray:
        return a.eye + np.array([side, -front, up]) * h

    cranium = Ellipsoid(at(0, -0.008, 0.0195), np.array([0.0755, 0.0965, 0.0895]) * h)
    hair = Ellipsoid(at(0, -0.020, 0.0255 - 0.004 * (1 - man)),
                     np.array([0.0785 + 0.004 * (1 - man), 0.0940 + 0.004 * (1 - man),
                               0.087 + 0.004 * (1 - man)]) * h)
    up = np.array([0.052, 0.022, 0.0, -0.030, -0.058, -0.082, -0.100])
    half = np.array([0.064, 0.0675, 0.068, 0.0665, 0.059 - 0.002 * (1 - man), 0.048 - 0.004 * (1 - man),
                     0.034 - 0.003 * (1 - man)]) + a.fat * np.array([0, 0, 0.0005, 0.002, 0.003, 0.0035, 0.003])
    fore = np.array([0.082, 0.089, 0.0875, 0.088, 0.0885, 0.0855, 0.0785])
    back = np.array([0.07, 0.07, 0.07, 0.06, 0.045, 0.03, 0.02])
    face = Loft(a.eye, UPRIGHT, cross_sections(up[::-1], half[::-1], half[::-1], fore[::-1], back[::-1], 2.25) *
                np.array([h] * 7 + [1.0]), (0.010 * h, 0.03 * h))
    big = 1 + 0.20 * s.nose + 0.06 * (man - 0.5)
    nose = RoundCone(at(0, 0.086, 0.010), at(0, 0.0945 + 0.012 * big, -0.036), 0.0065 * h, 0.0095 * h)
    wing = Ellipsoid(at(0.0115, 0.0965, -0.0395), np.array([0.0075, 0.0095, 0.0065]) * h)
    eyeball = Ellipsoid(at(0.0315, 0.0715, -0.001), np.array([0.0160, 0.0125, 0.0115]) * h)
    bun = Ellipsoid(at(0, -0.119 + 0.052 * man, 0.034), np.array([0.031, 0.029, 0.030]) * h)
    lean = np.radians(14)
    flare = np.radians(30)
    ear_frame = np.array([[np.cos(flare), -np.sin(flare), 0], [np.sin(flare), np.cos(flare), 0], [0, 0, 1.0]])
    tip = np.array([[1.0, 0, 0], [0, np.cos(lean), np.sin(lean)], [0, -np.sin(lean), np.cos(lean)]])
    ear = Ellipsoid(at(0.0800, -0.010, -0.010), np.array([0.0075, 0.0185, 0.0320]) * h, ear_frame @ tip)
    parts: list[tuple[Field, float]] = [(cranium, 0), (face, 0.03 * h), (hair, 0.004 * h)]
    return Group([(Group(parts, _face_bumps(a)), 0), (eyeball, 0.004 * h), (nose, 0.012 * h), (wing, 0.007 * h),
                  (ear, 0.006 * h), (bun, 0.007 * h)], _feature_bumps(a), bounds=(a.eye, a.eye + 1e-3, 0.19 * h))


def _face_bumps(a: Anatomy) -> list[Bump]:
    man = a.man
    return _bumps(a.eye, UPRIGHT, a.head_scale, [
        ((0.031, 0.085, 0.003), -0.0088, (0.0150, 0.03, 0.0105)),
        ((0.014, 0.088, 0.001), -0.0035, (0.007, 0.02, 0.010)),
        ((0.030, 0.088, 0.019), 0.0025 + 0.0025 * man, (0.018, 0.03, 0.0065)),
        ((0, 0.09, 0.020), 0.001 + 0.0012 * man, (0.012, 0.03, 0.008)),
        ((0.047, 0.066, -0.022), 0.0055, (0.015, 0.02, 0.011)),
        ((0.046, 0.060, -0.056), -0.004 + 0.003 * a.fat, (0.014, 0.025, 0.016)),
        ((0.050, 0.015, -0.066), 0.005 * man, (0.014, 0.018, 0.014)),
        ((0.070, 0.045, 0.020), -0.003, (0.02, 0.018, 0.018)),
        ((0, 0.088, -0.0955), 0.0065 + 0.001 * man, (0.015, 0.03, 0.0105)),
        ((0, 0.088, -0.0790), -0.004, (0.016, 0.03, 0.0055))])


def _feature_bumps(a: Anatomy) -> list[Bump]:
    return _bumps(a.eye, UPRIGHT, a.head_scale, [
        ((0, 0.092, -0.0565), 0.0044, (0.017, 0.03, 0.0046)),
        ((0, 0.092, -0.0685), 0.0058, (0.0145, 0.03, 0.0046)),
        ((0, 0.092, -0.0622), -0.0030, (0.021, 0.03, 0.0020)),
        ((0.090, -0.004, -0.010), -0.005, (0.010, 0.008, 0.014)),
        ((0.0115, 0.100, -0.0475), -0.003, (0.004, 0.008, 0.003))])
