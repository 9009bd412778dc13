"""Settings of `complete`."""
from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from scanprep.ranges import Count, Positive, Seed, Settings, Signed

Method = Literal["joint", "alternation"]


@dataclass(frozen=True)
class CompletionConfig(Settings):
    """Settings of `complete`.

    Attributes
    ----------
    method : {"joint", "alternation"}
        All unknowns at once by Levenberg-Marquardt, or rotations, surface and shape in turns as the paper does; the
        latter takes SCAPE models only, and neither priors, contact nor free space.
    surface_weight : float
        w_Z of Eq. 10: how strongly each measured point draws the completed surface.
    twist_weight : float
        w_T of Eq. 11: how strongly one round holds the joint angles of the round before; for the alternation in
        square metres, against the squared edges of a part.
    landmark_sd : float, metres
        How far a landmark may lie from its vertex.
    scan_sd : float, metres
        How far the scan lies from the predicted mesh, as the model is not exact.
    prior_weight : float
        Factor on the pose prior once the scan is used.
    joint_limits : bool
        Joints that rotate farther than in the training poses are held back.
    correspondences : bool
        Landmarks are multiplied first, by correlated correspondence, for closer starts; on the poses this was
        tuned on it changed the starts and not where they ended.
    rounds : int
        Matchings while the reach of matches shrinks.
    scan_points : int
        Points of the scan that are matched to the model.
    model_points : int
        Vertices of the model that are matched to the scan.
    random_starts : int
        Poses drawn at random around each start, and for each limb that may be wrong.
    seed : int
        Of the random numbers.
    free_space_weight : float
        How much a vertex counts that stands where a single camera saw nothing, against one that lies on the
        scan; 0 when the scan has parts cut away by hand.
    contact_weight : float
        The same for a vertex that stands inside another part of the body.
    clothing_sd : float, metres
        How far clothing and hair, of which `complete` is told, usually stand off the skin.
    viewpoint : (3,) floats, metres, or one for each view, optional
        Where the scan was seen from; found by itself when not given.
    up : (3,) floats, optional
        The direction that is up in the scan, where people in it mostly stand; without it all directions are tried,
        and for a depth picture its four sides.
    ignored_parts : names of parts
        Parts of the body that the scan says nothing about, though it may show something there.
    free_scale : bool
        The unit of the scan is not known: one factor is found together with pose, place and shape.
    fill_colors : bool
        The colours of a scan are spread over what was not seen, which else is grey.
    tolerance : float, metres
        Distance from the truth within which a vertex counts as right in `Completion.confidence`.
    """

    method: Method = "joint"
    surface_weight: float = 1.0
    twist_weight: float = 1.0
    landmark_sd: Positive = 0.01
    scan_sd: Positive = 0.008
    prior_weight: float = 1.0
    joint_limits: bool = False
    correspondences: bool = False
    rounds: Count = 8
    scan_points: Count = 2500
    model_points: Count = 1200
    random_starts: int = 60
    seed: Seed = 0
    free_space_weight: float = 0.5
    contact_weight: float = 0.5
    clothing_sd: Positive = 0.06
    viewpoint: tuple[Signed, Signed, Signed] | tuple[tuple[Signed, Signed, Signed], ...] | None = None
    up: tuple[Signed, Signed, Signed] | None = None
    ignored_parts: tuple[str, ...] = ()
    free_scale: bool = False
    fill_colors: bool = False
    tolerance: float = 0.01

    @classmethod
    def published(cls) -> CompletionConfig:
        """The paper's way: a few markers become correspondences, then rotations, surface and shape in turns.

        Not as in the paper: the start is the best of several, from landmarks, typical poses and limbs held otherwise.
        w_Z and w_T, which it does not print, are ours, and points that lie far from the body count less. Soles are
        pressed to a scan that ends flat around the feet.

        [SCAPE] §7
        """
        return cls(method="alternation", correspondences=True)
