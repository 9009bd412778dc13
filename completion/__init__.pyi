# The public names; loaded when they are first used, so that the command line answers at once.
from .mocap.artefacts.find import find_artefacts as find_artefacts
from .mocap.artefacts.results import write_virtual as write_virtual
from .mocap.files.markers import (
    MarkerSequence as MarkerSequence,
)
from .mocap.files.markers import (
    read_markers as read_markers,
)
from .mocap.files.markers import (
    write_markers as write_markers,
)
from .mocap.files.motion_files import joint_angles as joint_angles
from .mocap.files.motion_files import joint_centres as joint_centres
from .mocap.labelling.label import LabelledMarkers as LabelledMarkers
from .mocap.labelling.label import label_markers as label_markers
from .mocap.labelling.label import label_people as label_people
from .mocap.labelling.stream import LabelledFrame as LabelledFrame
from .mocap.labelling.stream import LabelStream as LabelStream
from .mocap.labelling.unknown_layout import FoundLayout as FoundLayout
from .mocap.labelling.unknown_layout import find_layout as find_layout
from .mocap.marker_selection.candidates import candidate_layout as candidate_layout
from .mocap.marker_selection.design import MarkerDesign as MarkerDesign
from .mocap.marker_selection.design import design_markers as design_markers
from .mocap.marker_selection.fits import DesignConfig as DesignConfig
from .mocap.marker_sets.layout import MarkerLayout as MarkerLayout
from .mocap.marker_sets.named import layout_names as layout_names
from .mocap.marker_sets.named import load_layout as load_layout
from .mocap.marker_sets.symmetry import SkinMirror as SkinMirror
from .mocap.marker_sets.symmetry import find_skin_mirror as find_skin_mirror
from .mocap.marker_sets.transfer import TransferredLayout as TransferredLayout
from .mocap.marker_sets.transfer import transfer_layout as transfer_layout
from .mocap.mosh.mosh import MoshConfig as MoshConfig
from .mocap.mosh.mosh import MoshResult as MoshResult
from .mocap.mosh.mosh import SexedMosh as SexedMosh
from .mocap.mosh.mosh import mosh as mosh
from .mocap.mosh.mosh import mosh_by_sex as mosh_by_sex
from .mocap.pose.follow import animate as animate
from .mocap.pose.marked_body import AnimateConfig as AnimateConfig
from .mocap.pose.stream import MarkerStream as MarkerStream
from .mocap.pose.stream import PoseFrame as PoseFrame
from .mocap.retargeting.retarget import morph_vertices as morph_vertices
from .mocap.retargeting.retarget import retarget as retarget
from .mocap.retargeting.soft_tissue import deformation as deformation
from .mocap.retargeting.soft_tissue import retarget_soft_tissue as retarget_soft_tissue
from .mocap.soft_tissue.follow import follow_soft_tissue as follow_soft_tissue
from .mocap.subject.person import PersonConfig as PersonConfig
from .mocap.subject.person import PersonFit as PersonFit
from .mocap.subject.person import find_person as find_person
from .motion import Motion as Motion
from .partial.colors import ColorConfig as ColorConfig
from .partial.colors import carry_colors as carry_colors
from .partial.completion import Completion as Completion
from .partial.completion import complete as complete
from .partial.masks import read_mask as read_mask
from .partial.settings import CompletionConfig as CompletionConfig
from .tracking.sequence import track as track
from .tracking.settings import TrackConfig as TrackConfig
from .viewing.notebook import Viewed as Viewed
from .viewing.notebook import view as view
