"""Settings of `complete`."""
from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from scanprep.ranges import Cosine, Count, Positive, Seed, Settings, Share, Signed

from ..priors import PosePrior

Method = Literal["joint", "alternation"]


@dataclass(frozen=True)
class CompletionConfig(Settings):
    """Settings of `complete`.

    Attributes
    ----------
    surface_weight : float
        w_Z of Eq. 10: how strongly each measured point draws the completed surface.
    twist_weight : float
        w_T of Eq. 11: how strongly one round holds the joint angles of the round before.
    landmark_sd : float, metres
        How far a landmark may lie from its vertex.
    scan_sd : float, metres
        How far the scan lies from the predicted mesh, as the model is not exact.
    evidence : float
        How many independent measurements the whole scan is worth; what the model cannot follow is alike
        at neighbouring points, so this is far fewer than there are points.
    prior_weight : float
        Factor on the pose prior once the scan is used.
    prior_shrinkage : float in [0, 1]
        See `gaussian_prior`.
    pose_prior : "gaussian", "mixture" or "nearest"
        What is known of poses: one Gaussian, a mixture around the training poses of each limb, or the nearest of them.
        From a start in the right place the mixture and the nearest hold hidden limbs better; from any start the
        Gaussian lost fewer.
    joint_limits : bool
        Joints that turn further than in the training poses are held back.
    start_axes : int
        Directions of the training poses along which the search starts.
    correspondences : bool
        Landmarks are multiplied first, by correlated correspondence, for closer starts; on the poses this was
        tuned on it changed the starts and not where they ended.
    candidates : int
        Starts that are carried on from the landmarks to the scan.
    reach : float, metres
        First limit on the distance of matches; it shrinks to `final_reach`.
    final_reach : float, metres
    rounds : int
        Matchings from `reach` to `final_reach`.
    min_cosine : float
        Least cosine between the normals of a match.
    scan_points : int
        Points of the scan that are matched to the model.
    model_points : int
        Vertices of the model that are matched to the scan.
    surface_reach : float, metres
        Limit on the distance of scan points to the free surface.
    surface_rounds : int
        Matchings of the free surface.
    draws : int
        Poses drawn at random around each start, and for each limb that may be wrong.
    seed : int
        Of the random draws.
    silhouette_weight : float
        How much a vertex counts that stands where a single camera saw nothing, against one that lies on the
        scan; 0 when the scan has parts cut away by hand.
    silhouette_tolerance : float, metres
    contact_weight : float
        The same for a vertex that stands inside another part of the body.
    viewpoint : (3,) floats, metres, or one for each view, optional
        Where the scan was seen from; found by itself when not given.
    cover_weight : float
        The same for a vertex that sticks out of clothing or hair, of which `complete` is told.
    cover_sd : float, metres
        How far clothing and hair usually stand off the skin.
    ignored_parts : names of parts
        Parts of the body that the scan says nothing about, though it may show something there.
    method : {"joint", "alternation"}
        All unknowns at once by Levenberg-Marquardt, or rotations, surface and shape in turns as the paper does; the
        latter takes SCAPE models only, and neither priors, contact nor what a camera must have seen.
    twist_damping : float, square metres
        w_T of Eq. 11 in the alternation, against the squared edges of a part.
    tolerance : float, metres
        Distance from the truth within which a vertex counts as right in `Completion.confidence`.
    free_scale : bool
        The unit of the scan is not known: one factor is found together with pose, place and shape.
    """

    surface_weight: float = 1.0
    twist_weight: float = 1.0
    landmark_sd: Positive = 0.01
    scan_sd: Positive = 0.008
    evidence: float = 400.0
    prior_weight: float = 1.0
    prior_shrinkage: Share = 0.3
    pose_prior: PosePrior = "gaussian"
    joint_limits: bool = False
    start_axes: int = 4
    correspondences: bool = False
    candidates: Count = 3
    reach: Positive = 0.2
    final_reach: Positive = 0.03
    rounds: Count = 8
    min_cosine: Cosine = 0.6
    scan_points: Count = 2500
    model_points: Count = 1200
    surface_reach: Positive = 0.03
    surface_rounds: int = 4
    draws: int = 60
    seed: Seed = 0
    silhouette_weight: float = 0.5
    silhouette_tolerance: Positive = 0.03
    contact_weight: float = 0.5
    viewpoint: tuple[Signed, Signed, Signed] | tuple[tuple[Signed, Signed, Signed], ...] | None = None
    cover_weight: float = 1.0
    cover_sd: Positive = 0.06
    ignored_parts: tuple[str, ...] = ()
    method: Method = "joint"
    twist_damping: float = 1.0
    tolerance: float = 0.01
    free_scale: bool = False
