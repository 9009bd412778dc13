"""From raw range scans to registered meshes and a skeleton.

The public names are loaded when they are first used, so that the command line answers at once.
"""
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .cleaning.components import CleanScanConfig, clean_scan
    from .cleaning.decimate import decimate
    from .cleaning.decimate_set import DecimateSetConfig, decimate_set
    from .cleaning.decimate_set_files import write_decimated_set
    from .cleaning.fill import fill_holes
    from .cleaning.merge import merge_views
    from .dataset import RegisteredSet
    from .geometry.files import MeshFileError, read_mesh, read_points, write_mesh
    from .geometry.landmarks import match_landmarks, read_landmark_vertices, read_landmarks, write_landmarks
    from .geometry.mesh import Mesh
    from .matching.correlated import CorrelatedConfig, find_correspondences
    from .matching.nonrigid import RegistrationConfig, register
    from .matching.rigid import align_rigid
    from .matching.seeds import SeedConfig, find_seeds
    from .skeleton.edit import apply_edits, merge_parts, move_joint, read_edits, rename_part, split_part
    from .skeleton.find import SkeletonConfig, find_skeleton
    from .skeleton.names import name_parts
    from .skeleton.search import SkeletonSearch, search_skeleton
    from .skeleton.tree import Skeleton

_ROOMS = {
    "cleaning.components": ("CleanScanConfig", "clean_scan"),
    "cleaning.decimate": ("decimate",),
    "cleaning.decimate_set": ("DecimateSetConfig", "decimate_set"),
    "cleaning.decimate_set_files": ("write_decimated_set",),
    "cleaning.fill": ("fill_holes",),
    "cleaning.merge": ("merge_views",),
    "dataset": ("RegisteredSet",),
    "geometry.files": ("MeshFileError", "read_mesh", "read_points", "write_mesh"),
    "geometry.landmarks": ("match_landmarks", "read_landmark_vertices", "read_landmarks", "write_landmarks"),
    "geometry.mesh": ("Mesh",),
    "matching.correlated": ("CorrelatedConfig", "find_correspondences"),
    "matching.nonrigid": ("RegistrationConfig", "register"),
    "matching.rigid": ("align_rigid",),
    "matching.seeds": ("SeedConfig", "find_seeds"),
    "skeleton.find": ("SkeletonConfig", "find_skeleton"),
    "skeleton.edit": ("apply_edits", "merge_parts", "move_joint", "read_edits", "rename_part", "split_part"),
    "skeleton.names": ("name_parts",),
    "skeleton.search": ("SkeletonSearch", "search_skeleton"),
    "skeleton.tree": ("Skeleton",),
}
_ROOM_OF = {name: room for room, names in _ROOMS.items() for name in names}

__all__ = ["CleanScanConfig", "CorrelatedConfig", "DecimateSetConfig", "Mesh", "MeshFileError", "RegisteredSet",
           "RegistrationConfig", "SeedConfig", "Skeleton", "SkeletonConfig", "SkeletonSearch",
           "align_rigid", "apply_edits", "clean_scan", "decimate", "decimate_set", "fill_holes",
           "find_correspondences", "find_seeds", "find_skeleton", "match_landmarks", "merge_parts",
           "merge_views", "move_joint", "name_parts", "read_edits", "read_landmark_vertices",
           "read_landmarks", "read_mesh", "read_points", "register", "rename_part", "search_skeleton",
           "split_part", "write_decimated_set", "write_landmarks", "write_mesh"]


def __getattr__(name: str) -> Any:
    if name not in _ROOM_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f".{_ROOM_OF[name]}", __name__), name)
