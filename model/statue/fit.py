"""Fit a statue to one scan: registration by features, shape-constrained surface fit, displacement map."""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
from scipy.sparse import csr_array, diags_array

from scanprep.batch.room import Step, run_uncached
from scanprep.geometry.landmark_names import FACE
from scanprep.geometry.mesh import Mesh, take_any_mesh
from scanprep.geometry.sanitise import sanitise
from scanprep.ranges import FLAG, Range, Settings

from ..body import Progress, share_progress
from .control.files import humanoid
from .control.model import ControlModel, Statue
from .detail.displacement import SIZE, bake_displacement, unfold_control
from .registration.automatic import Features, find_features
from .registration.features import FeatureFit, fit_features, head_share, warp
from .registration.surface_fit import SurfaceFit, fit_surface


@dataclass(frozen=True)
class StatueConfig(Settings):
    """Settings of `fit_statue`.

    Attributes
    ----------
    size : int
        Pixels of the displacement map, each way.
    method : {"registered", "published"}
        "registered" starts the surface at the control mesh registered to the scan, if no features are given, and
        minimises its energy. "published" poses the control model by features, warps its head, and takes the paper's
        steps.

    Examples
    --------
    >>> StatueConfig.from_paper().method
    'published'

    [Statues]
    """

    size: Annotated[int, Range(16, 8192), FLAG] = SIZE
    method: Literal["registered", "published"] = "registered"

    @classmethod
    def from_paper(cls) -> StatueConfig:
        """Return the paper's settings: the control model posed by features, its head warped, its mesh fitted as there.

        Not as in the paper: without --features, a search finds joints and landmarks, which the paper has clicked. Eq. 4
        has a weak prior (1 mm for a radian or a double length), and Eq. 5 the φ(p - p_k) that interpolates. A click in
        the browser goes half way through the body, not to its medial surface. The shape carries vertices past the edge
        of a hole of the scan. Folds that remain after the fit are opened. Heights solve the cubic of Eq. 19, and are
        filled smoothly where there is no solution. Adaptive triangles are small where the displaced surface is curved,
        not where the displacement is large.
        """
        return cls(method="published")


class UnplacedError(ValueError):
    """No pose of the control model was found on a scan; `features` are what was found."""

    def __init__(self, problem: str, features: Features) -> None:
        super().__init__(problem)
        self.features = features


@dataclass(frozen=True, eq=False)
class Posed:
    """A control model in the pose of a scan, before its surface is fitted."""

    features: FeatureFit
    start: np.ndarray              # (N, 3) metres, its vertices after the warp of the head
    hidden: np.ndarray             # (N,), vertices of parts that the scan does not show
    face: int = 0                  # points of the face that shaped the head: none where fewer than four are known
    missing: tuple[str, ...] = ()  # joints and landmarks that the scan does not show
    searched: bool = False         # whether the features were found; else they were given
    problem: str | None = None     # why features that were found should not be trusted


@dataclass(frozen=True, eq=False)
class FittedStatue(Statue):
    """A statue as it was fitted, with how that went."""

    posed: Posed | None = None
    surface: SurfaceFit | None = None


@take_any_mesh
def fit_statue(scan: Mesh, joints: Mapping[str, np.ndarray] | None = None,
               points: Mapping[str, np.ndarray] | None = None, control: ControlModel | None = None,
               config: StatueConfig | None = None, progress: Progress | None = None, step: Step = run_uncached
               ) -> FittedStatue:
    """Fit a character that moves, with all its detail, to one scan of one person.

    Parameters
    ----------
    scan : Mesh, metres
        One body without floor and furniture (`clean_scan`). It may have holes, which the map then has too.
    joints : dict of str to (3,) float, metres, optional
        Joint centres by name. Without features, `find_features` finds a person who stands upright.
    points : dict of str to (3,) float, metres, optional
        Landmarks of the face and of the rest of the surface, by name.
    control : ControlModel, optional
        By default `humanoid()`.
    config : StatueConfig, optional
        Settings.
    progress : callable, optional
        Called as progress(done, total).
    step : Step, optional
        Keeps the results of the stages, so that an interrupted fit resumes.

    Returns
    -------
    FittedStatue
        A `Statue` with the results of the stages.

    Raises
    ------
    ValueError
        A scan without triangles, or too few features; `UnplacedError`, with what was found, for no person in it.

    Examples
    --------
    >>> from scanprep import Mesh
    >>> try:
    ...     fit_statue(Mesh(np.eye(3), [[0, 1, 2]]))
    ... except ValueError as error:
    ...     print(str(error)[:52])
    scan: expected a person of at least 100 points, got 

    [Statues]
    """
    control, config, scan = control or humanoid(), config or StatueConfig(), sanitise(scan)
    inputs, published = (scan, joints, points, control), config.method == "published"
    # 1. pose the control model by features, which are found if none are given
    if joints is None and points is None:
        features = step("features", inputs, lambda: find_features(control, scan, share_progress(progress, 0, 40)))
        posed = pose_automatically(control, features, not published)                               # [Statues] Eq. 4-5
    else:
        posed = pose_by_features(control, joints or {}, points or {})                           # [Statues] Eq. 1-5
    # 2. fit the control mesh to the scan, open its folds, and measure what is left as a displacement map
    surface = step("surface", (inputs, config), lambda: fit_surface(                             # [Statues] Eq. 6-18
        control.mesh, posed.start, scan, published, share_progress(progress, 40, 80), posed.hidden))
    fitted = step("control", (inputs, config), lambda: fit_control(
        control, posed.features, surface, scan, config.size))
    map = step("map", (inputs, config), lambda: bake_displacement(                              # [Statues] Eq. 19-21
        fitted, scan, config.size, share_progress(progress, 80, 100)))
    return FittedStatue(fitted, posed.features.pose, map, posed=posed, surface=surface)


def pose_by_features(control: ControlModel, joints: Mapping[str, np.ndarray], points: Mapping[str, np.ndarray]
                     ) -> Posed:
    """Pose the control model by features, and warp its head to those of the face."""
    return with_head(control, fit_features(control, joints, points), points)                     # [Statues] Eq. 4


def with_head(control: ControlModel, fit: FeatureFit, points: Mapping[str, np.ndarray]) -> Posed:
    """Warp the head of a control model that was posed by features to the points of the face. [Statues] Eq. 5"""
    start, face = fit.vertices, [name for name in FACE if name in points]
    if "skullbase" not in control.skeleton.names:
        face = []
    try:
        own, goal = start[[control.landmarks[name] for name in face]], np.array([points[name] for name in face])
        start = warp(start, own, goal, head_share(control)) if face else start
    except ValueError:                   # fewer than four points, or all in one plane, do not determine a head
        face = []
    return Posed(fit, start, np.zeros(len(start), dtype=bool), len(face))


def pose_automatically(control: ControlModel, found: Features, registered: bool = True) -> Posed:
    """Pose the control model where `find_features` found the person, and warp its head.

    If `registered`, its surface begins on the scan, except for parts whose joint the scan does not show. A start by the
    pose alone left 1.4% of a real scan folded, this one 0.3%.
    """
    if found.fit is None or found.registered is None:
        raise UnplacedError(f"scan: {found.problem}", found)
    posed, names = with_head(control, found.fit, found.points), control.skeleton.names
    lacking = control.weights[:, [j for j, name in enumerate(names) if name in found.missing]].sum(axis=1)
    posed = replace(posed, hidden=lacking > 0.5, missing=found.missing, problem=found.problem,
                    searched=True)
    if not registered:
        return posed
    surface = found.registered.vertices
    return replace(posed, start=surface + lacking[:, None] * (posed.start - surface),
                   face=posed.face if "skullbase" in found.missing else 0)


def fit_control(control: ControlModel, posed: FeatureFit, surface: SurfaceFit, scan: Mesh, size: int) -> ControlModel:
    """Build the control model on the scan, with folds opened and its joints where the features put them."""
    unfolded = spread_flat(unfold_control(control.refit(surface.vertices, posed.joints), scan, size).mesh).vertices
    root = unfolded[control.skeleton.part_of_vertex(control.mesh) == 0].mean(axis=0)
    return control.refit(unfolded, np.vstack([root, posed.joints[1:]]))


def spread_flat(mesh: Mesh) -> Mesh:
    """Move corners of triangles without area towards the mean of their neighbours, a tenth of the way at a time.

    On sharp corners of a scan vertices may meet, and a control mesh with such triangles cannot be read again.
    """
    near = csr_array(mesh.vertex_adjacency != 0, dtype=float)
    near = diags_array(1 / near.sum(axis=1)) @ near
    least, rounds = 1e-10, 30                                   # square metres: a hundred times what readers refuse
    for _ in range(rounds):
        flat = mesh.face_areas < least
        if not flat.any():
            break
        moved, corners = mesh.vertices.copy(), np.unique(mesh.faces[flat])
        moved[corners] += 0.1 * (near @ moved - moved)[corners]
        mesh = mesh.with_vertices(moved)
    return mesh
