"""A body that can be posed and reshaped, learned from registered meshes.

The public names are loaded when they are first used, so that the command line answers at once.
"""
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .body import BodyModel, Derivatives
    from .evaluation.errors import PoseErrors, ShapeErrors, compactness, pose_errors, shape_errors
    from .evaluation.sampling import Samples, Specificity, sample_bodies, specificity
    from .export.bvh import write_bvh
    from .export.correctives import motion_correctives
    from .export.glb import write_skinned_glb
    from .export.npz import write_body_npz
    from .export.rig import Rig, make_rig, skin_weights
    from .files import load_model
    from .fitting import FitConfig, PoseFit, ShapeFit, fit_pose, fit_shape
    from .learning import LearnConfig, learn_scape
    from .learning.skin import SkinConfig, learn_skinning
    from .linear import PointOperator, Subject
    from .scape import ScapeModel
    from .skinning import SkinningModel

_ROOMS = {
    "body": ("BodyModel", "Derivatives"),
    "evaluation.errors": ("PoseErrors", "ShapeErrors", "compactness", "pose_errors", "shape_errors"),
    "evaluation.sampling": ("Samples", "Specificity", "sample_bodies", "specificity"),
    "export.bvh": ("write_bvh",),
    "export.correctives": ("motion_correctives",),
    "export.glb": ("write_skinned_glb",),
    "export.npz": ("write_body_npz",),
    "export.rig": ("Rig", "make_rig", "skin_weights"),
    "files": ("load_model",),
    "fitting": ("FitConfig", "PoseFit", "ShapeFit", "fit_pose", "fit_shape"),
    "learning": ("LearnConfig", "learn_scape"),
    "learning.skin": ("SkinConfig", "learn_skinning"),
    "linear": ("PointOperator", "Subject"),
    "scape": ("ScapeModel",),
    "skinning": ("SkinningModel",),
}
_ROOM_OF = {name: room for room, names in _ROOMS.items() for name in names}

__all__ = ["BodyModel", "Derivatives", "FitConfig", "LearnConfig", "PointOperator", "PoseErrors", "PoseFit", "Rig",
           "Samples", "ScapeModel", "ShapeErrors", "ShapeFit", "SkinConfig", "SkinningModel", "Specificity",
           "Subject", "compactness", "fit_pose", "fit_shape", "learn_scape", "learn_skinning", "load_model",
           "make_rig", "motion_correctives", "pose_errors", "sample_bodies", "shape_errors", "skin_weights",
           "specificity", "write_body_npz", "write_bvh", "write_skinned_glb"]


def __getattr__(name: str) -> Any:
    if name not in _ROOM_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f".{_ROOM_OF[name]}", __name__), name)
