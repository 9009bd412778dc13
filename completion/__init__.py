"""The whole body from a partial scan, from markers, or from frames of points.

The public names are loaded when they are first used, so that the command line answers at once.
"""
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .animation.follow import AnimateConfig, animate
    from .animation.outputs import joint_angles, joint_centres
    from .animation.retarget import morphed_vertices, retarget
    from .animation.shape import MarkerShapeConfig, MarkerSubject, subject_from_markers
    from .animation.stream import Frame, MarkerStream
    from .designing.frames import FrameConfig, informative_frames
    from .designing.results import MarkerDesign
    from .designing.sets import design_markers
    from .designing.settings import DesignConfig
    from .embedded import embedded_model
    from .markers.candidates import CandidateConfig, candidate_layout
    from .markers.carry import CarriedLayout, CarryConfig, carry_layout, register_layout
    from .markers.files import MarkerSequence, read_markers, write_markers
    from .markers.layout import MarkerLayout
    from .markers.named import layout_names
    from .markers.symmetry import SkinMirror, find_skin_mirror
    from .moshing.capture import mosh
    from .moshing.characters.cartoons import Cartoon, CartoonShape, cartoon
    from .moshing.characters.transfer import deformation, retarget_soft_tissue
    from .moshing.faults.search import find_faults
    from .moshing.faults.virtual import write_virtual
    from .moshing.person import find_person
    from .moshing.results import MoshResult, PersonFit
    from .moshing.settings import MoshConfig, PersonConfig
    from .moshing.sex import SexedMosh, mosh_by_sex
    from .moshing.soft import follow_soft_tissue
    from .motion import Motion
    from .partial.colors import ColorConfig, carry_colors
    from .partial.completion import Completion, complete
    from .partial.masks import read_mask
    from .partial.settings import CompletionConfig
    from .tracking.sequence import track
    from .tracking.settings import TrackConfig

_ROOMS = {
    "animation.follow": ("AnimateConfig", "animate"),
    "animation.outputs": ("joint_angles", "joint_centres"),
    "animation.retarget": ("morphed_vertices", "retarget"),
    "animation.shape": ("MarkerShapeConfig", "MarkerSubject", "subject_from_markers"),
    "animation.stream": ("Frame", "MarkerStream"),
    "designing.frames": ("FrameConfig", "informative_frames"),
    "designing.results": ("MarkerDesign",),
    "designing.sets": ("design_markers",),
    "designing.settings": ("DesignConfig",),
    "embedded": ("embedded_model",),
    "markers.candidates": ("CandidateConfig", "candidate_layout"),
    "markers.carry": ("CarriedLayout", "CarryConfig", "carry_layout", "register_layout"),
    "markers.files": ("MarkerSequence", "read_markers", "write_markers"),
    "markers.layout": ("MarkerLayout",),
    "markers.named": ("layout_names",),
    "markers.symmetry": ("SkinMirror", "find_skin_mirror"),
    "moshing.capture": ("mosh",),
    "moshing.characters.cartoons": ("Cartoon", "CartoonShape", "cartoon"),
    "moshing.characters.transfer": ("deformation", "retarget_soft_tissue"),
    "moshing.faults.search": ("find_faults",),
    "moshing.person": ("find_person",),
    "moshing.results": ("MoshResult", "PersonFit"),
    "moshing.settings": ("MoshConfig", "PersonConfig"),
    "moshing.sex": ("SexedMosh", "mosh_by_sex"),
    "moshing.soft": ("follow_soft_tissue",),
    "moshing.faults.virtual": ("write_virtual",),
    "motion": ("Motion",),
    "partial.colors": ("ColorConfig", "carry_colors"),
    "partial.completion": ("Completion", "complete"),
    "partial.masks": ("read_mask",),
    "partial.settings": ("CompletionConfig",),
    "tracking.sequence": ("track",),
    "tracking.settings": ("TrackConfig",),
}
_ROOM_OF = {name: room for room, names in _ROOMS.items() for name in names}

__all__ = ["AnimateConfig", "CandidateConfig", "CarriedLayout", "CarryConfig", "Cartoon", "CartoonShape",
           "ColorConfig", "Completion", "CompletionConfig", "DesignConfig", "Frame", "FrameConfig", "MarkerDesign",
           "MarkerLayout", "MarkerSequence", "MarkerShapeConfig", "MarkerStream", "MarkerSubject", "MoshConfig",
           "MoshResult", "Motion", "PersonConfig", "PersonFit", "SexedMosh", "SkinMirror", "TrackConfig", "animate",
           "candidate_layout", "carry_colors", "carry_layout", "cartoon", "complete", "deformation", "design_markers",
           "embedded_model", "find_faults", "find_person", "find_skin_mirror", "follow_soft_tissue",
           "informative_frames", "joint_angles", "joint_centres", "layout_names", "morphed_vertices", "mosh",
           "mosh_by_sex", "read_markers", "read_mask", "register_layout", "retarget", "retarget_soft_tissue",
           "subject_from_markers", "track", "write_markers", "write_virtual"]


def __getattr__(name: str) -> Any:
    if name not in _ROOM_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f".{_ROOM_OF[name]}", __name__), name)
