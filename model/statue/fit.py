"""From one scan to a statue: registration by features, shape-constrained fit, displacement map."""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from scanprep.batch.room import Step, run_uncached
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.sanitise import sanitise
from scanprep.ranges import Settings

from ..body import Progress
from .control.files import humanoid
from .control.model import ControlModel, Statue
from .detail.displacement import DisplacementConfig, bake_displacement, unfold_control
from .registration.automatic import Features, find_features
from .registration.features import FeatureFit, fit_features, head_share, warp
from .registration.surface_fit import SurfaceFit, SurfaceFitConfig, fit_surface

FACE = ("left eye", "right eye", "nose tip", "mouth", "chin", "left ear", "right ear", "top of head")


@dataclass(frozen=True)
class StatueConfig(Settings):
    """Settings of `fit_statue`.

    Attributes
    ----------
    surface : SurfaceFitConfig
    displacement : DisplacementConfig
    start : "registered" or "posed"
        Without features, the fit of the surface begins at the control mesh as it was registered to the scan, or, as
        from clicks in the paper, at the control model posed by the features that were found, its head warped to them.
    """

    surface: SurfaceFitConfig = field(default_factory=SurfaceFitConfig)
    displacement: DisplacementConfig = field(default_factory=DisplacementConfig)
    start: Literal["registered", "posed"] = "registered"

    @classmethod
    def from_paper(cls) -> StatueConfig:
        """The control model posed by features, its head warped, its mesh fitted by the steps of the paper alone.

        Not as in the paper: without --features joints and landmarks are found by a search, which the paper has clicked.
        Eq. 4 has a weak prior (1 mm for a radian or a double length), Eq. 5 the φ(p - p_k) that interpolates. A click
        on a picture goes to the medial curves of the body, not to its medial surface. Vertices past the edge of a hole
        of the scan are carried by the shape. What is folded under the scan after the fit is drawn out of it. Heights
        are the cubic root that Eq. 19 asks for, and are filled smoothly where there is none. Adaptive triangles are
        small where the displaced surface bends away from their edges, not where the displacement is greater.
        """
        return cls(surface=SurfaceFitConfig.from_paper(), start="posed")


@dataclass(frozen=True, eq=False)
class Posed:
    """A control model in the pose of a scan, before its surface is fitted."""

    features: FeatureFit
    start: np.ndarray              # (N, 3) metres, its vertices after the warp of the head
    hidden: np.ndarray             # (N,), vertices of parts that the scan does not show
    face: int = 0                  # points of the face that shaped the head: none where fewer than four are known
    missing: tuple[str, ...] = ()  # joints and landmarks that the scan does not show
    problem: str | None = None     # why features that were found should not be trusted


@dataclass(frozen=True, eq=False)
class FittedStatue(Statue):
    """A statue as it was fitted, with how that went."""

    posed: Posed | None = None
    surface: SurfaceFit | None = None


def fit_statue(scan: Mesh, joints: Mapping[str, np.ndarray] | None = None,
               points: Mapping[str, np.ndarray] | None = None, control: ControlModel | None = None,
               config: StatueConfig | None = None, progress: Progress | None = None, step: Step = run_uncached
               ) -> FittedStatue:
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
    step : Step, optional
        Keeps the results of the stages, so that work which was interrupted goes on.

    Raises
    ------
    ValueError
        A scan without triangles, one in which no person is found, features that say too little.

    [Statues]
    """
    control, config, scan = control or humanoid(), config or StatueConfig(), sanitise(scan)
    given = (scan, joints, points, control)
    if joints is None and points is None:
        found = step("features", given, lambda: find_features(control, scan))
        posed = pose_automatically(control, found, config.start == "registered")                # [Statues] Eq. 4-5
    else:
        posed = pose_by_features(control, joints or {}, points or {})                           # [Statues] Eq. 1-5
    surface = step("surface", (given, config), lambda: fit_surface(
        control.mesh, posed.start, scan, config.surface, progress, posed.hidden))                # [Statues] Eq. 6-18
    fitted = step("control", (given, config), lambda: fit_control(
        control, posed.features, surface, scan, config.displacement))
    map = step("map", (given, config), lambda: bake_displacement(
        fitted, scan, config.displacement, progress))                                            # [Statues] Eq. 19-21
    return FittedStatue(fitted, posed.features.pose, map, posed=posed, surface=surface)


def pose_by_features(control: ControlModel, joints: Mapping[str, np.ndarray], points: Mapping[str, np.ndarray]
                     ) -> Posed:
    """The control model posed by features, and its head warped to those of the face."""
    return with_head(control, fit_features(control, joints, points), points)                     # [Statues] Eq. 4


def with_head(control: ControlModel, fit: FeatureFit, points: Mapping[str, np.ndarray]) -> Posed:
    """A control model that was posed by features, its head warped to the points of the face. [Statues] Eq. 5"""
    start, face = fit.vertices, [name for name in FACE if name in points]
    if "skullbase" not in control.skeleton.names:
        face = []
    try:
        own, goal = start[[control.landmarks[name] for name in face]], np.array([points[name] for name in face])
        start = warp(start, own, goal, head_share(control)) if face else start
    except ValueError:                   # fewer than four, or in one plane: they say nothing of the shape of a head
        face = []
    return Posed(fit, start, np.zeros(len(start), dtype=bool), len(face))


def pose_automatically(control: ControlModel, found: Features, registered: bool = True) -> Posed:
    """The control model where `find_features` found the person, posed and its head warped as by features given.

    If `registered`, its surface begins on the scan; only parts whose joint the scan does not show stand as the pose
    says. A start by the pose alone left 1.4% of a real scan folded, this one 0.3%.
    """
    if found.fit is None or found.registered is None:
        raise ValueError(f"scan: {found.problem}")
    posed, names = with_head(control, found.fit, found.points), control.skeleton.names
    lacking = control.weights[:, [j for j, name in enumerate(names) if name in found.missing]].sum(axis=1)
    posed = replace(posed, hidden=lacking > 0.5, missing=found.missing, problem=found.problem)
    if not registered:
        return posed
    surface = found.registered.vertices
    return replace(posed, start=surface + lacking[:, None] * (posed.start - surface),
                   face=posed.face if "skullbase" in found.missing else 0)


def fit_control(control: ControlModel, posed: FeatureFit, surface: SurfaceFit, scan: Mesh,
                config: DisplacementConfig | None = None) -> ControlModel:
    """The control model on the scan, drawn out of folds, its joints where the features put them."""
    unfolded = unfold_control(control.refit(surface.vertices, posed.joints), scan, config).mesh.vertices
    root = unfolded[control.skeleton.part_of_vertex(control.mesh) == 0].mean(axis=0)
    return control.refit(unfolded, np.vstack([root, posed.joints[1:]]))
