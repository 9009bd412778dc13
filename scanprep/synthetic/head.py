"""Head: skull, hair, face and ears."""
from __future__ import annotations

import numpy as np

from .anatomy import Anatomy
from .body_parts import UPRIGHT, cross_sections
from .implicit_surface import Bump, Ellipsoid, Field, Group, Loft, RoundCone


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
    h, man = a.head_scale, a.man

    def bump(place: tuple[float, float, float], height: float, widths: tuple[float, float, float]) -> Bump:
        return Bump(a.eye + np.array([place[0], -place[1], place[2]]) * h, height * h, np.array(widths) * h)

    return [bump((0.031, 0.085, 0.003), -0.0088, (0.0150, 0.03, 0.0105)),
            bump((0.014, 0.088, 0.001), -0.0035, (0.007, 0.02, 0.010)),
            bump((0.030, 0.088, 0.019), 0.0025 + 0.0025 * man, (0.018, 0.03, 0.0065)),
            bump((0, 0.09, 0.020), 0.001 + 0.0012 * man, (0.012, 0.03, 0.008)),
            bump((0.047, 0.066, -0.022), 0.0055, (0.015, 0.02, 0.011)),
            bump((0.046, 0.060, -0.056), -0.004 + 0.003 * a.fat, (0.014, 0.025, 0.016)),
            bump((0.050, 0.015, -0.066), 0.005 * man, (0.014, 0.018, 0.014)),
            bump((0.070, 0.045, 0.020), -0.003, (0.02, 0.018, 0.018)),
            bump((0, 0.088, -0.0955), 0.0065 + 0.001 * man, (0.015, 0.03, 0.0105)),
            bump((0, 0.088, -0.0790), -0.004, (0.016, 0.03, 0.0055))]


def _feature_bumps(a: Anatomy) -> list[Bump]:
    h = a.head_scale

    def bump(place: tuple[float, float, float], height: float, widths: tuple[float, float, float]) -> Bump:
        return Bump(a.eye + np.array([place[0], -place[1], place[2]]) * h, height * h, np.array(widths) * h)

    return [bump((0, 0.092, -0.0565), 0.0044, (0.017, 0.03, 0.0046)),
            bump((0, 0.092, -0.0685), 0.0058, (0.0145, 0.03, 0.0046)),
            bump((0, 0.092, -0.0622), -0.0030, (0.021, 0.03, 0.0020)),
            bump((0.090, -0.004, -0.010), -0.005, (0.010, 0.008, 0.014)),
            bump((0.0115, 0.100, -0.0475), -0.003, (0.004, 0.008, 0.003))]
