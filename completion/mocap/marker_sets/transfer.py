"""A marker layout on another triangulation, by registration."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from scanprep.correspondence.correlated import find_correspondences
from scanprep.geometry.mesh import Mesh
from scanprep.registration.nonrigid import register
from scanprep.registration.schedule import RegistrationConfig

from .layout import MarkerLayout
from .named import layout_on

UNCERTAIN = 0.05                      # a limb may be wrong
Landmarks = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True, eq=False)
class TransferredLayout:
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
    uncovered : float
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
    uncovered: float
    registered: Mesh


def transfer_layout(layout: MarkerLayout, source: Mesh, target: Mesh, landmarks: Landmarks | None = None,
                    config: RegistrationConfig | None = None, progress: Callable[[int, int], None] | None = None, *,
                    search: bool = True) -> TransferredLayout:
    """Bring a layout onto another body: the source is registered to the target, and takes its markers along.

    On a target of the same triangles, in whatever pose and shape, markers stay on their vertices. Labels, distances
    from the skin, aliases and loose markers are as they were.

    Parameters
    ----------
    layout : MarkerLayout
        Of the source.
    source, target : Mesh
        One connected manifold component each.
    landmarks : (K,) int and (K, 3) float, metres, optional
        Vertices of the source and where they are on the target. Without them, places that look alike are sought, which
        cannot tell how far a smooth limb is rotated about itself.
    config : RegistrationConfig, optional
    progress : callable, optional
        Called as progress(done, total).
    search : bool
        Look for such places; bodies that stand alike in the same place need none.

    Raises
    ------
    ValueError
        A layout of another body than the source, a target on which the source was not found, or what `register`
        raises.
    """
    layout.place(source)                                              # refuses a layout of another body
    if np.array_equal(source.faces, target.faces):
        L = len(layout.labels)
        return TransferredLayout(layout, np.zeros(L), np.ones(L), 0.0, np.nan, 0.0, target)
    config, tell = config or RegistrationConfig(), progress or (lambda done, total: None)
    if landmarks is not None or not search:
        fit = register(source, target, landmarks, config, tell)
    else:
        # by places that look alike; where they leave much of the target, as both stand
        fit = register(source, target, None, config, tell, find_correspondences(source, target))
        if fit.uncovered > UNCERTAIN:
            fit = min(fit, register(source, target, None, config, tell), key=lambda one: one.uncovered)
    if fit.uncovered > 0.3:  # of the target that the source does not cover: it is somewhere else
        raise ValueError(f"target: the source could not be brought onto it, {fit.uncovered:.0%} of it stays uncovered; "
                         "give landmarks, three at least, spread over the body")
    places = dict(zip(layout.labels, layout.skin_points(fit.mesh.vertices), strict=True))
    found, distances = layout_on(target, places)
    there = replace(layout, vertices=found.vertices, weights=found.weights)
    return TransferredLayout(there, distances, fit.confidence[layout.nearest], fit.rms, fit.landmark_rms,
                             fit.uncovered, fit.mesh)
