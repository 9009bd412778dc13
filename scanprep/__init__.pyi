# The public names; loaded when they are first used, so that the command line answers at once.
from .alignment.icp import align_rigid as align_rigid
from .cleaning.clean_scan import CleanScanConfig as CleanScanConfig
from .cleaning.clean_scan import clean_scan as clean_scan
from .correspondence.correlated import find_correspondences as find_correspondences
from .correspondence.search import CorrelatedConfig as CorrelatedConfig
from .dataset import RegisteredSet as RegisteredSet
from .decimation.decimate import decimate as decimate
from .decimation.registered_set import DecimateSetConfig as DecimateSetConfig
from .decimation.registered_set import decimate_set as decimate_set
from .depth_camera.picture import DepthPicture as DepthPicture
from .depth_camera.picture import read_depth as read_depth
from .fusion.tsdf import merge_views as merge_views
from .geometry.files import (
    MeshFileError as MeshFileError,
)
from .geometry.files import (
    read_mesh as read_mesh,
)
from .geometry.files import (
    read_points as read_points,
)
from .geometry.files import (
    write_mesh as write_mesh,
)
from .geometry.landmarks import (
    match_landmarks as match_landmarks,
)
from .geometry.landmarks import (
    read_landmark_vertices as read_landmark_vertices,
)
from .geometry.landmarks import (
    read_landmarks as read_landmarks,
)
from .geometry.landmarks import (
    write_landmarks as write_landmarks,
)
from .geometry.mesh import Mesh as Mesh
from .registration.nonrigid import register as register
from .registration.schedule import RegistrationConfig as RegistrationConfig
from .repair.hole_filling import fill_holes as fill_holes
from .skeleton.edit import (
    apply_edits as apply_edits,
)
from .skeleton.edit import merge_parts as merge_parts
from .skeleton.edit import move_joint as move_joint
from .skeleton.edit import rename_part as rename_part
from .skeleton.edit import split_part as split_part
from .skeleton.find import SkeletonConfig as SkeletonConfig
from .skeleton.find import find_skeleton as find_skeleton
from .skeleton.tree import Skeleton as Skeleton
