"""From raw range scans to registered meshes and a skeleton."""
from .cleaning.decimate import decimate
from .cleaning.fill import fill_holes
from .cleaning.merge import merge_views
from .dataset import RegisteredSet
from .geometry.files import MeshFileError, read_mesh, read_points, write_mesh
from .geometry.landmarks import read_landmark_vertices, read_landmarks, write_landmarks
from .geometry.mesh import Mesh
from .matching.nonrigid import RegistrationConfig, register
from .matching.rigid import align_rigid
from .skeleton.find import find_skeleton
from .skeleton.tree import Skeleton

__all__ = ["Mesh", "MeshFileError", "RegisteredSet", "RegistrationConfig", "Skeleton", "align_rigid", "decimate",
           "fill_holes", "find_skeleton", "merge_views", "read_landmark_vertices", "read_landmarks", "read_mesh",
           "read_points", "register", "write_landmarks", "write_mesh"]
