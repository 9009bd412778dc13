# The public names; loaded when they are first used, so that the command line answers at once.
from .blendscape import BlendScapeModel as BlendScapeModel
from .body import BodyModel as BodyModel
from .body import Derivatives as Derivatives
from .coregistration.config import CoregistrationConfig as CoregistrationConfig
from .coregistration.first import FirstModel as FirstModel
from .coregistration.first import learn_from_scans as learn_from_scans
from .coregistration.rounds import Coregistration as Coregistration
from .coregistration.rounds import coregister as coregister
from .coregistration.single import ModelRegistration as ModelRegistration
from .coregistration.single import register_with_model as register_with_model
from .evaluation.errors import (
    PoseErrors as PoseErrors,
)
from .evaluation.errors import (
    ShapeErrors as ShapeErrors,
)
from .evaluation.errors import (
    compactness as compactness,
)
from .evaluation.errors import (
    pose_errors as pose_errors,
)
from .evaluation.errors import (
    shape_errors as shape_errors,
)
from .evaluation.sampling import (
    Samples as Samples,
)
from .evaluation.sampling import (
    Specificity as Specificity,
)
from .evaluation.sampling import (
    sample_bodies as sample_bodies,
)
from .evaluation.sampling import (
    specificity as specificity,
)
from .export.bvh import write_bvh as write_bvh
from .export.bvh_read import read_bvh as read_bvh
from .export.correctives import motion_correctives as motion_correctives
from .export.glb import write_skinned_glb as write_skinned_glb
from .export.npz import write_body_npz as write_body_npz
from .export.rig import Rig as Rig
from .export.rig import make_rig as make_rig
from .export.rig import skin_weights as skin_weights
from .files import load_model as load_model
from .fitting import (
    FitConfig as FitConfig,
)
from .fitting import (
    PoseFit as PoseFit,
)
from .fitting import (
    ShapeFit as ShapeFit,
)
from .fitting import (
    fit_pose as fit_pose,
)
from .fitting import (
    fit_shape as fit_shape,
)
from .learning import (
    BlendConfig as BlendConfig,
)
from .learning import (
    LearnConfig as LearnConfig,
)
from .learning import (
    learn_blendscape as learn_blendscape,
)
from .learning import (
    learn_scape as learn_scape,
)
from .learning.mixing import MixConfig as MixConfig
from .learning.mixing import learn_scape_mix as learn_scape_mix
from .learning.parts import (
    ChosenSkeleton as ChosenSkeleton,
)
from .learning.parts import (
    PartsConfig as PartsConfig,
)
from .learning.parts import (
    choose_skeleton as choose_skeleton,
)
from .learning.sex_plane import SexGuess as SexGuess
from .learning.sex_plane import guess_sex as guess_sex
from .learning.sexes import learn_by_sex as learn_by_sex
from .learning.skin import SkinConfig as SkinConfig
from .learning.skin import learn_skinning as learn_skinning
from .linear import PointOperator as PointOperator
from .linear import Subject as Subject
from .posing.angles import pose_from_angles as pose_from_angles
from .posing.angles import rotate_joint as rotate_joint
from .posing.character import CharacterConfig as CharacterConfig
from .posing.character import character_model as character_model
from .posing.mirroring import Mirror as Mirror
from .posing.mirroring import find_mirror as find_mirror
from .posing.mirroring import mirror_pose as mirror_pose
from .posing.transfer import TransferConfig as TransferConfig
from .posing.transfer import repose as repose
from .posing.transfer import subject_from_body as subject_from_body
from .priors import JointLimits as JointLimits
from .priors import sample_poses as sample_poses
from .resolution.change import ResolutionConfig as ResolutionConfig
from .resolution.change import change_resolution as change_resolution
from .scape import ScapeModel as ScapeModel
from .skinning import SkinningModel as SkinningModel
from .statue.control.humanoid import humanoid as humanoid
from .statue.control.model import ControlModel as ControlModel
from .statue.control.model import DisplacementMap as DisplacementMap
from .statue.control.model import Statue as Statue
from .statue.files import load_statue as load_statue
from .statue.files import save_statue as save_statue
from .statue.fit import StatueConfig as StatueConfig
from .statue.fit import fit_statue as fit_statue
