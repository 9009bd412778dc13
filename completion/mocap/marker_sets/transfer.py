"""Transfer a marker layout to another triangulation, by registration."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from model.body import BodyModel
from scanprep.correspondence.correlated import find_correspondences
from scanprep.geometry.mesh import Mesh, take_any_mesh
from scanprep.registration.nonrigid import register
from scanprep.registration.schedule import RegistrationConfig

from .layout import MarkerLayout
from .named import layout_on

UNCERTAIN = 0.05                      # share of the target not covered by the source above which a limb may be wrong
Landmarks = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True, eq=False)
class TransferredLayout:
    """A layout on another body, and the quality of the registration.

    Attributes
    ----------
    layout : MarkerLayout
        On triangles of the target.
    distances : (L,) float, metres
        From the registered source to the target, at each marker: across the skin, not along it.
    confidence : (L,) float in [0, 1]
        Confidence of the registration at each marker.
    rms : float, metres
        RMS distance of the registered source from the target.
    landmark_rms : float, metres
        RMS distance of the landmarks, NaN without them.
    uncovered : float
        Share of the target that the source does not cover. More than a few per cent mean a wrong limb, or different
        bodies, such as a fist and an open hand.
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


@take_any_mesh
def transfer_layout(layout: MarkerLayout, source: Mesh | BodyModel, target: Mesh | BodyModel,
                    landmarks: Landmarks | None = None, config: RegistrationConfig | None = None,
                    progress: Callable[[int, int], None] | None = None, *, search: bool = True) -> TransferredLayout:
    """Transfer a layout to another body: the source is registered to the target and carries its markers.

    On a target with the same triangles, in any pose and shape, markers stay on their vertices. Labels, distances from
    the skin, aliases and loose markers do not change.

    Parameters
    ----------
    layout : MarkerLayout
        Of the source.
    source, target : Mesh or BodyModel
        One connected manifold component each; of a model its template.
    landmarks : (K,) int and (K, 3) float, metres, optional
        Vertices of the source and their places on the target. Without them, correspondences are found by shape, which
        cannot tell how far a smooth limb is rotated about its axis.
    config : RegistrationConfig, optional
        Settings of the registration.
    progress : callable, optional
        Called with (done, total).
    search : bool
        Find correspondences; bodies in the same pose and place do not need them.

    Returns
    -------
    TransferredLayout
        The layout on the target, with distances (L,) in metres and confidence (L,).

    Raises
    ------
    ValueError
        A layout of another body than the source, a target on which the source was not found, or an error of
        `register`.

    Examples
    --------
    >>> from scanprep.synthetic.topology import load_topology
    >>> body = load_topology().mesh
    >>> moved = body.with_vertices(body.vertices + 0.3)
    >>> transfer_layout(MarkerLayout(("LKNE", "RKNE"), np.array([120, 340])), body, moved).layout
    MarkerLayout(2 markers)

    [Allen]
    """
    source, target = (body.template if isinstance(body, BodyModel) else body for body in (source, target))
    layout.place(source)                                              # ValueError for a layout of another body
    if np.array_equal(source.faces, target.faces):
        L = len(layout.labels)
        return TransferredLayout(layout, np.zeros(L), np.ones(L), 0.0, np.nan, 0.0, target)
    config, report_progress = config or RegistrationConfig(), progress or (lambda done, total: None)
    if landmarks is not None or not search:
        fit = register(source, target, landmarks, config, report_progress)
    else:
        # by correspondences; where much of the target stays uncovered, also from the present poses
        fit = register(source, target, None, config, report_progress, find_correspondences(source, target))
        if fit.uncovered > UNCERTAIN:
            fit = min(fit, register(source, target, None, config, report_progress), key=lambda one: one.uncovered)
    if fit.uncovered > 0.3:  # so much of the target is uncovered only if the registration failed
        raise ValueError(f"target: the source could not be brought onto it, {fit.uncovered:.0%} of it stays uncovered; "
                         "give landmarks, three at least, spread over the body")
    # the carried points on the nearest triangles of the target
    places = dict(zip(layout.labels, layout.skin_points(fit.mesh.vertices), strict=True))
    nearest, distances = layout_on(target, places)
    transferred = replace(layout, vertices=nearest.vertices, weights=nearest.weights)
    return TransferredLayout(transferred, distances, fit.confidence[layout.nearest], fit.rms, fit.landmark_rms,
                             fit.uncovered, fit.mesh)
