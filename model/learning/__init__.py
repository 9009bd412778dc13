"""Learning body models from registered meshes."""
from ..digests import digest
from .carriage import Carriage
from .pose import Ticks, fit_poses
from .scape import (
    BlendConfig,
    LearnConfig,
    Progress,
    check_skeleton,
    checked_bodies,
    learn_blendscape,
    learn_scape,
    pose_examples,
    pose_prior,
)

__all__ = ["BlendConfig", "Carriage", "LearnConfig", "Progress", "Ticks", "check_skeleton", "checked_bodies", "digest",
           "fit_poses", "learn_blendscape", "learn_scape", "pose_examples", "pose_prior"]
