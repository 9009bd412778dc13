"""From one scan to a statue: registration by features, shape-constrained fit, displacement map."""
from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from scanprep.geometry.mesh import Mesh
from scanprep.ranges import Settings

from .control.humanoid import humanoid
from .control.model import ControlModel, Statue
from .detail.displacement import DisplacementConfig, bake, unfold_control
from .registration.automatic import Features, find_features
from .registration.features import FeatureConfig, FeatureFit, fit_features, head_share, warp
from .registration.surface_fit import SurfaceFit, SurfaceFitConfig, fit_surface

Progress = Callable[[int, int], None]
FACE = ("left eye", "right eye", "nose tip", "mouth", "chin", "left ear", "right ear", "top of head")


@dataclass(frozen=True)
class StatueConfig(Settings):
    """Settings of `fit_statue`.

    Attributes
    ----------
    features : FeatureConfig
    surface : SurfaceFitConfig
    displacement : DisplacementConfig
    """

    features: FeatureConfig = field(default_factory=FeatureConfig)
    surface: SurfaceFitConfig = field(default_factory=SurfaceFitConfig)
    displacement: DisplacementConfig = field(default_factory=DisplacementConfig)


@dataclass(frozen=True, eq=False)
class Posed:
    """A control model in the pose of a scan, before its surface is fitted."""

    features: FeatureFit
    start: np.ndarray   # (N, 3) metres, its vertices after the warp of the head
    hidden: np.ndarray  # (N,), vertices of parts that the scan does not show
    face: int = 0       # points of the face that shaped the head: none where fewer than four are known or all lie in
                        # one plane


def fit_statue(scan: Mesh, joints: Mapping[str, np.ndarray] | None = None,
               points: Mapping[str, np.ndarray] | None = None, control: ControlModel | None = None,
               config: StatueConfig | None = None, progress: Progress | None = None) -> Statue:
    """One scan of one person as a character that moves, with all its detail.

    Parameters
    ----------
    scan : Mesh, metres
        One body, floor and furniture taken off (`clean_scan`); it may have holes, which the map then has too.
    joints : {name of a joint: (3,) float, metres}, optional
        Joint centres. Without any, a person who stands upright is found by `find_features`.
    points : {name of a landmark: (3,) float, metres}, optional
        Points of the face and of the rest of the surface.
    control : ControlModel, optional
        `humanoid()` when not given.
    config : StatueConfig, optional
    progress : callable, optional
        Called as progress(done, total).

    Raises
    ------
    ValueError
        A scan without triangles, one in which no person is found, features that say too little.

    [Statues]
    """
    control, config = control or humanoid(), config or StatueConfig()
    if joints is None and points is None:
        found = find_features(control, scan)
        posed = posed_automatically(control, found)
    else:
        posed = posed_by_features(control, joints or {}, points or {}, config.features)
    surface = fit_surface(control.mesh, posed.start, scan, config.surface, progress, posed.hidden)
    fitted = fitted_control(control, posed.features, surface, scan, config.displacement)
    return Statue(fitted, posed.features.pose, bake(fitted, scan, config.displacement, progress))


def posed_by_features(control: ControlModel, joints: Mapping[str, np.ndarray], points: Mapping[str, np.ndarray],
                      config: FeatureConfig | None = None) -> Posed:
    """The control model posed by features, and its head warped to those of the face. [Statues] Eq. 4, 5"""
    fit = fit_features(control, joints, points, config)
    shown = np.zeros(len(fit.vertices), dtype=bool)
    face = [name for name in FACE if name in points]
    if len(face) < 4 or "skullbase" not in control.skeleton.names:
        return Posed(fit, fit.vertices, shown)
    own = fit.vertices[[control.landmarks[name] for name in face]]
    try:
        goal = np.array([points[name] for name in face])
        return Posed(fit, warp(fit.vertices, own, goal, head_share(control)), shown, len(face))
    except ValueError:                   # points in one plane say nothing of the shape of a head
        return Posed(fit, fit.vertices, shown)


def posed_automatically(control: ControlModel, found: Features) -> Posed:
    """The control model where `find_features` found the person.

    Its surface is then near the scan already; parts whose joint the scan does not show stand as the pose says.
    """
    if found.fit is None or found.registered is None:
        raise ValueError(f"scan: {found.problem}")
    names = control.skeleton.names
    lacking = control.weights[:, [j for j, name in enumerate(names) if name in found.missing]].sum(axis=1)[:, None]
    start = found.registered.vertices + lacking * (found.fit.vertices - found.registered.vertices)
    return Posed(found.fit, start, lacking[:, 0] > 0.5)


def fitted_control(control: ControlModel, posed: FeatureFit, surface: SurfaceFit, scan: Mesh,
                   config: DisplacementConfig | None = None) -> ControlModel:
    """The control model on the scan, drawn out of folds, its joints where the features put them."""
    root = control.skeleton.part_of_vertex(control.mesh) == 0

    def on(vertices: np.ndarray) -> ControlModel:
        return control.fitted(vertices, np.concatenate([vertices[root].mean(axis=0)[None], posed.joints[1:]]))

    return on(unfold_control(on(surface.vertices), scan, config).mesh.vertices)
