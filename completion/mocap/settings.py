"""What may be chosen when bodies are found from markers alone."""
from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from scanprep.ranges import Count, Positive, Seed, Settings, Share

from .pose.settings import AnimateConfig, FollowConfig

Attachment = Literal["triangle", "neighbourhood"]


@dataclass(frozen=True)
class PersonConfig(Settings):
    """Settings of `find_person`: the shape of a person and where the markers really sit, from some frames.

    Weights are those of the paper: on squared distances in centimetres, on squared standard deviations of betas and
    on the squared Mahalanobis distance of poses.

    Attributes
    ----------
    frames : int
        Frames that are used, over all sequences.
    choice : "spread" or "random"
        Frames that differ most, or drawn at random.
    n_betas : int
        Betas that are looked for, at most; the others stay zero.
    attachment : "triangle" or "neighbourhood"
        A latent marker in the coordinate frame of its nearest triangle, or as a sum of the neighbours of its
        nearest vertex and the normal there.
    data, surface, initial, shape, pose : float
        Weights of the terms: markers against their simulation, prescribed distance from the skin, usual place,
        shape and pose priors.
    loose : float
        Weight of the usual place of markers that the layout calls loose.
    annealing : floats
        Factors on the last three weights, one stage each.
    loose_reach : float, metres
        How far from its usual place a loose marker is looked for; 0 begins at the usual place.
    outlier : float, metres
        Residual at which a marker has lost three quarters of its weight.
    prior_shrinkage : float in [0, 1]
        See `gaussian_prior`.
    start_axes : int
        Directions of the training poses along which the pose of each frame is searched.
    iterations : int
        Most steps of each stage; the last may take three times as many.
    seed : int
        Of the frames drawn at random.
    """

    frames: Count = 12
    choice: Literal["spread", "random"] = "spread"
    n_betas: int = 80
    attachment: Attachment = "triangle"
    data: float = 0.75
    surface: float = 25.0
    initial: float = 1.0
    shape: float = 0.3
    pose: float = 0.25
    loose: float = 0.0025
    loose_reach: Positive = 0.2
    annealing: tuple[Positive, ...] = (40.0, 20.0, 10.0, 4.0, 2.0, 1.0)
    outlier: Positive = 0.06
    prior_shrinkage: Share = 0.3
    start_axes: int = 6
    iterations: Count = 8
    seed: Seed = 0


@dataclass(frozen=True)
class SoftTissueConfig(Settings):
    """Settings of `follow_soft_tissue`.

    Weights are in the paper's units. Its own are pose = 1, velocity = 6.25, skin = steadiness = 0: here the pose prior
    is a narrow one, which at 1 keeps poses from their markers, and the shape would bend to make up for it.

    Attributes
    ----------
    n_betas : int
        Components in which the shape may change: at least those of the person, all that the model has at most.
    data, pose, velocity, outlier, prior_shrinkage
        As in `FollowConfig`.
    change : float
        Weight on the squared change of betas from the person's own.
    skin : float
        Weight on the squared distance, in centimetres, that the change moves the skin: the mean over the surface.
    steadiness : float
        Weight on the squared second difference of the change from frame to frame, 120 frames a second, against that of
        the change itself.
    iterations : int
        Rounds over the whole sequence.
    """

    n_betas: int = 200
    data: float = 0.75
    pose: float = 0.1
    velocity: float = 40000.0
    change: float = 0.25
    skin: float = 10.0
    steadiness: float = 20.0
    outlier: Positive = 0.06
    prior_shrinkage: Share = 0.3
    iterations: Count = 3


@dataclass(frozen=True)
class FaultConfig(Settings):
    """Settings of `find_faults`.

    Attributes
    ----------
    follow : AnimateConfig
        How the body follows the markers.
    rounds : int
        Most times that markers are repaired and the body follows them anew.
    floor : float, metres
        Least standard deviation of a track around where it is expected a frame later.
    jump : float, metres
        Least distance from there that is a jump.
    deviation : float, metres
        How far a marker lies from its usual place on the body, in each direction.
    memory : float, seconds
        How long that distance stays much the same.
    doubt : float
        What each change of a label must be worth, as half a squared number of standard deviations.
    slip : float, metres
        Least lasting displacement in the frame of a body part.
    stray : float, metres
        Least distance from the simulated marker for a marker that is somewhere else for a while.
    noise : float, metres
        Least jitter from frame to frame, as the median length of the second difference.
    """

    follow: AnimateConfig = field(default_factory=AnimateConfig)
    rounds: int = 6
    floor: float = 0.002
    jump: float = 0.006
    deviation: float = 0.008
    memory: float = 0.1
    doubt: float = 4.0
    slip: float = 0.015
    stray: float = 0.06
    noise: float = 0.012


@dataclass(frozen=True)
class MoshConfig(Settings):
    """Settings of `mosh`.

    Attributes
    ----------
    person : PersonConfig
        Shape and marker places, from some frames.
    follow : FollowConfig
        Poses of all frames.
    soft : SoftTissueConfig
        The shape that changes with time.
    faults : FaultConfig
        What is wrong with the markers.
    soft_tissue : bool
        Let the shape change with time.
    """

    person: PersonConfig = field(default_factory=PersonConfig)
    follow: FollowConfig = field(default_factory=FollowConfig)
    soft: SoftTissueConfig = field(default_factory=SoftTissueConfig)
    faults: FaultConfig = field(default_factory=FaultConfig)
    soft_tissue: bool = True
