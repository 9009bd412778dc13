"""A body that can be posed and reshaped, learned from registered meshes.

The public names are loaded when they are first used, so that the command line answers at once.
"""
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .blendscape import BlendScapeModel
    from .body import BodyModel, Derivatives
    from .coregistration.config import CoregistrationConfig
    from .coregistration.first import FirstModel, learn_from_scans
    from .coregistration.rounds import Coregistration, coregister
    from .coregistration.single import ModelRegistration, register_with_model
    from .evaluation.errors import PoseErrors, ShapeErrors, compactness, pose_errors, shape_errors
    from .evaluation.sampling import Samples, Specificity, sample_bodies, specificity
    from .export.bvh import write_bvh
    from .export.bvh_read import read_bvh
    from .export.correctives import motion_correctives
    from .export.glb import write_skinned_glb
    from .export.npz import write_body_npz
    from .export.rig import Rig, make_rig, skin_weights
    from .files import load_model
    from .fitting import FitConfig, PoseFit, ShapeFit, fit_pose, fit_shape
    from .learning import BlendConfig, LearnConfig, learn_blendscape, learn_scape
    from .learning.mixing import MixConfig, learn_scape_mix
    from .learning.parts import ChosenSkeleton, PartsConfig, choose_skeleton
    from .learning.sex_plane import SexGuess, guess_sex
    from .learning.sexes import learn_by_sex
    from .learning.skin import SkinConfig, learn_skinning
    from .linear import PointOperator, Subject
    from .posing.angles import pose_from_angles, sample_poses, turn
    from .posing.character import CharacterConfig, character_model
    from .posing.limits import JointLimits
    from .posing.mirroring import Mirror, find_mirror, mirror_pose
    from .posing.transfer import TransferConfig, repose, subject_from_body
    from .resolution.change import ResolutionConfig, change_resolution
    from .scape import ScapeModel
    from .skinning import SkinningModel
    from .statue.control.humanoid import humanoid
    from .statue.control.model import ControlModel
    from .statue.files import load_statue, save_statue
    from .statue.fit import StatueConfig, fit_statue
    from .statue.statue import DisplacementMap, Statue

_ROOMS = {
    "body": ("BodyModel", "Derivatives"),
    "coregistration.config": ("CoregistrationConfig",),
    "coregistration.first": ("FirstModel", "learn_from_scans"),
    "coregistration.rounds": ("Coregistration", "coregister"),
    "coregistration.single": ("ModelRegistration", "register_with_model"),
    "evaluation.errors": ("PoseErrors", "ShapeErrors", "compactness", "pose_errors", "shape_errors"),
    "evaluation.sampling": ("Samples", "Specificity", "sample_bodies", "specificity"),
    "export.bvh": ("write_bvh",),
    "export.bvh_read": ("read_bvh",),
    "export.correctives": ("motion_correctives",),
    "export.glb": ("write_skinned_glb",),
    "export.npz": ("write_body_npz",),
    "export.rig": ("Rig", "make_rig", "skin_weights"),
    "files": ("load_model",),
    "fitting": ("FitConfig", "PoseFit", "ShapeFit", "fit_pose", "fit_shape"),
    "blendscape": ("BlendScapeModel",),
    "learning": ("BlendConfig", "LearnConfig", "learn_blendscape", "learn_scape"),
    "learning.mixing": ("MixConfig", "learn_scape_mix"),
    "learning.parts": ("ChosenSkeleton", "PartsConfig", "choose_skeleton"),
    "learning.sex_plane": ("SexGuess", "guess_sex"),
    "learning.sexes": ("learn_by_sex",),
    "learning.skin": ("SkinConfig", "learn_skinning"),
    "linear": ("PointOperator", "Subject"),
    "posing.angles": ("pose_from_angles", "sample_poses", "turn"),
    "posing.character": ("CharacterConfig", "character_model"),
    "posing.limits": ("JointLimits",),
    "posing.mirroring": ("Mirror", "find_mirror", "mirror_pose"),
    "posing.transfer": ("TransferConfig", "repose", "subject_from_body"),
    "resolution.change": ("ResolutionConfig", "change_resolution"),
    "scape": ("ScapeModel",),
    "skinning": ("SkinningModel",),
    "statue.control.model": ("ControlModel",),
    "statue.files": ("load_statue", "save_statue"),
    "statue.fit": ("StatueConfig", "fit_statue"),
    "statue.control.humanoid": ("humanoid",),
    "statue.statue": ("DisplacementMap", "Statue"),
}
_ROOM_OF = {name: room for room, names in _ROOMS.items() for name in names}

__all__ = ["BlendConfig", "BlendScapeModel", "BodyModel", "CharacterConfig", "ChosenSkeleton", "ControlModel",
           "Coregistration", "CoregistrationConfig", "Derivatives", "DisplacementMap", "FirstModel", "FitConfig",
           "JointLimits", "LearnConfig", "Mirror", "MixConfig", "ModelRegistration", "PartsConfig", "PointOperator",
           "PoseErrors", "PoseFit", "ResolutionConfig", "Rig", "Samples", "ScapeModel", "SexGuess", "ShapeErrors",
           "ShapeFit", "SkinConfig", "SkinningModel", "Specificity", "Statue", "StatueConfig", "Subject",
           "TransferConfig", "change_resolution", "character_model", "choose_skeleton", "compactness", "coregister",
           "find_mirror", "fit_pose", "fit_shape", "fit_statue", "guess_sex", "humanoid", "learn_blendscape",
           "learn_by_sex", "learn_from_scans", "learn_scape", "learn_scape_mix", "learn_skinning", "load_model",
           "load_statue", "make_rig", "mirror_pose", "motion_correctives", "pose_errors", "pose_from_angles",
           "read_bvh", "register_with_model", "repose", "sample_bodies", "sample_poses", "save_statue", "shape_errors",
           "skin_weights", "specificity", "subject_from_body", "turn", "write_body_npz", "write_bvh",
           "write_skinned_glb"]


def __getattr__(name: str) -> Any:
    if name not in _ROOM_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f".{_ROOM_OF[name]}", __name__), name)
