"""A marker layout on another triangulation, by registration."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from scanprep.correspondence.correlated import CorrelatedConfig, find_correspondences
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Surface
from scanprep.ranges import Settings
from scanprep.registration.nonrigid import Registration, register
from scanprep.registration.schedule import RegistrationConfig

from .layout import MarkerLayout, most_used
from .symmetry import skin_points

LOST = 0.3                           # of the target that the source does not cover: it is somewhere else
DOUBTFUL = 0.05                      # a limb may be wrong
Landmarks = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class CarryConfig(Settings):
    """Settings of `carry_layout`.

    Attributes
    ----------
    correspond : CorrelatedConfig or None
        Of the search for pairs of places, without landmarks; None for bodies that stand alike in the same place, which
        need no search.
    register : RegistrationConfig
    """

    correspond: CorrelatedConfig | None = field(default_factory=CorrelatedConfig)
    register: RegistrationConfig = field(default_factory=RegistrationConfig)


@dataclass(frozen=True, eq=False)
class CarriedLayout:
    """A layout on another body, and how well the registration that brought it there went.

    Attributes
    ----------
    layout : MarkerLayout
        On triangles of the target.
    distances : (L,) float, metres
        From the registered source to the target, at each marker: across the skin, not along it.
    confidence : (L,) float in [0, 1]
        Of the registration at each marker.
    rms : float, metres
        Of the distances of the registered source from the target.
    landmark_rms : float, metres
        NaN without landmarks.
    missed : float
        Share of the target that the source does not cover: more than a few per cent says that a limb is wrong, or that
        the bodies differ, a fist and an open hand.
    registered : Mesh
        The source's triangles on the target.
    """

    layout: MarkerLayout
    distances: np.ndarray
    confidence: np.ndarray
    rms: float
    landmark_rms: float
    missed: float
    registered: Mesh


def carry_layout(layout: MarkerLayout, source: Mesh, target: Mesh, landmarks: Landmarks | None = None,
                 config: CarryConfig | None = None, progress: Callable[[int, int], None] | None = None) -> MarkerLayout:
    """The layout of one body on another of any triangulation and pose; `register_layout` also tells how it went.

    Returns
    -------
    MarkerLayout
        Three vertices of a triangle of the target for every marker; labels, distances from the skin, aliases and
        loose markers as they were.
    """
    return register_layout(layout, source, target, landmarks, config, progress).layout


def register_layout(layout: MarkerLayout, source: Mesh, target: Mesh, landmarks: Landmarks | None = None,
                    config: CarryConfig | None = None, progress: Callable[[int, int], None] | None = None
                    ) -> CarriedLayout:
    """Bring a layout onto another body: the source is registered to the target, and takes its markers along.

    On a target of the same triangles, in whatever pose and shape, markers stay on their vertices.

    Parameters
    ----------
    layout : MarkerLayout
        Of the source.
    source, target : Mesh
        One connected manifold component each.
    landmarks : (K,) int and (K, 3) float, metres, optional
        Vertices of the source and where they are on the target. Without them, places that look alike are sought, which
        cannot tell how far a smooth limb is turned about itself.
    config : CarryConfig, optional
    progress : callable, optional
        Called as progress(done, total).

    Raises
    ------
    ValueError
        A layout of another body than the source, a target on which the source was not found, or what `register`
        raises.
    """
    config = config or CarryConfig()
    layout.place(source)                                              # refuses a layout of another body
    if np.array_equal(source.faces, target.faces):
        L = len(layout.labels)
        return CarriedLayout(layout, np.zeros(L), np.ones(L), 0.0, np.nan, 0.0, target)
    fit = _registered(source, target, landmarks, config, progress or (lambda done, total: None))
    if fit.uncovered > LOST:
        raise ValueError(f"target: the source could not be brought onto it, {fit.uncovered:.0%} of it stays uncovered; "
                         "give landmarks, three at least, spread over the body")
    found = Surface(target).closest(skin_points(layout, fit.mesh))
    carried = MarkerLayout(layout.labels, target.faces[found.faces], layout.distances, _on_triangle(found.bary),
                           layout.aliases, layout.loose)
    return CarriedLayout(carried, found.distances, fit.confidence[most_used(layout)], fit.rms, fit.landmark_rms,
                         fit.uncovered, fit.mesh)


def _registered(source: Mesh, target: Mesh, landmarks: Landmarks | None, config: CarryConfig,
                tell: Callable[[int, int], None]) -> Registration:
    """By landmarks; else by places that look alike, and where that leaves much of the target, as both stand."""
    if landmarks is not None or config.correspond is None:
        return register(source, target, landmarks, config.register, tell)
    alike = register(source, target, None, config.register, tell,
                     find_correspondences(source, target, config=config.correspond))
    if alike.uncovered <= DOUBTFUL:
        return alike
    return min(alike, register(source, target, None, config.register, tell), key=lambda fit: fit.uncovered)


def _on_triangle(bary: np.ndarray) -> np.ndarray:
    """Barycentric coordinates (n, 3) without the last digits outside of the triangle."""
    inside = np.clip(bary, 0.0, 1.0)
    return inside / inside.sum(axis=1, keepdims=True)
