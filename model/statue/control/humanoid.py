"""The generic humanoid: 17 parts on H-Anim joints, about a thousand vertices, made from the synthetic people."""
from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from scanprep.skeleton.tree import Skeleton
from scanprep.synthetic.anatomy import Anatomy

from .files import read_control
from .model import ControlModel

STORED = Path(__file__).with_name("humanoid.npz")
NAMES = ("humanoid_root", "vl5", "skullbase", "l_sternoclavicular", "l_shoulder", "l_elbow", "l_wrist",
         "r_sternoclavicular", "r_shoulder", "r_elbow", "r_wrist", "l_hip", "l_knee", "l_ankle", "r_hip", "r_knee",
         "r_ankle")
PARENTS = np.array([-1, 0, 1, 1, 3, 4, 5, 1, 7, 8, 9, 0, 11, 12, 0, 14, 15])
SEGMENTS = ("spine", "head", "clavicle", "upper_arm", "forearm", "hand", "thigh", "shank", "foot")
SEGMENT_OF_PART = np.array([0, 0, 1, 2, 3, 4, 5, 2, 3, 4, 5, 6, 7, 8, 6, 7, 8])
FREE = (-360, 360)
# degrees from the default pose about the axes of `freedom`, of the left side
LIMITS = {"humanoid_root": (FREE, FREE, FREE),
          "vl5": ((-40, 80), (-40, 40), (-50, 50)),                          # forwards, sideways, turn
          "skullbase": ((-65, 60), (-45, 45), (-80, 80)),
          "l_sternoclavicular": ((-12, 45), (-30, 35)),                      # up, forwards
          "l_shoulder": ((-75, 160), (-100, 180), (-100, 100)),              # aside, forwards, twist
          "l_elbow": ((-20, 138),), "l_wrist": ((-75, 85), (-40, 30)),       # bent; to the palm, to the thumb
          "l_hip": ((-35, 65), (-35, 130), (-50, 50)), "l_knee": ((-8, 155),), "l_ankle": ((-35, 55),)}


@lru_cache(maxsize=1)
def humanoid() -> ControlModel:
    """The generic humanoid, the average of a man and a woman of 1.69 m, arms and legs a little apart.

    z is up, it faces -y and stands on z = 0, its left side is at +x. Its joints turn and its segments stretch as in the
    paper: with the place of the root 38 parameters of pose, and 9 lengths.

    [Statues] Section 3.1
    """
    return read_control(STORED)


@lru_cache(maxsize=1)
def humanoid_markers() -> dict[str, int]:
    """Label -> vertex of 41 motion-capture markers, labelled as in the CMU recordings."""
    from scanprep.synthetic.landmarks import markers

    from .humanoid_build import nearest_marks

    return nearest_marks(humanoid().mesh, markers())


def build() -> ControlModel:
    """The humanoid from scratch, half a minute; `write_control(build(), STORED)` keeps it."""
    from scanprep.synthetic.landmarks import landmarks
    from scanprep.synthetic.topology import CANONICAL

    from . import humanoid_build as made
    from .chart import make_chart

    anatomy = Anatomy(CANONICAL)
    mesh = made.build_mesh(anatomy)
    weights = made.part_weights(mesh, anatomy)
    part_of_face = weights[mesh.faces].mean(axis=1).argmax(axis=1)
    skeleton = Skeleton(part_of_face, PARENTS, made.joint_places(anatomy), NAMES)
    joints = skeleton.joints.copy()
    joints[0] = mesh.vertices[skeleton.part_of_vertex(mesh) == 0].mean(axis=0)
    chart = make_chart(mesh, made.hidden_seams(mesh, anatomy))
    axes, limits = freedom(anatomy)
    return ControlModel(mesh, replace(skeleton, joints=joints), weights, chart,
                        made.nearest_marks(mesh, landmarks()), axes, limits, SEGMENTS, SEGMENT_OF_PART)


def freedom(anatomy: Anatomy) -> tuple[tuple[np.ndarray, ...], tuple[np.ndarray, ...]]:
    """Axes and limits of every joint, anatomical in the default pose; those of the right mirror those of the left.

    The axes of elbow and knee are square to the limb, and a positive angle bends it. Shoulder and hip have three axes
    at right angles, the third along the limb.
    """
    (arm_out, arm_front, arm), (hand_out, thumb, hand) = anatomy.upper_arm_frame, anatomy.forearm_frame
    (leg_out, leg_front, leg), (_, instep, toes) = anatomy.leg_frame, anatomy.foot_frame
    side, front, up = np.diag([1.0, -1.0, 1.0])

    def turning(*pairs: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
        """The axes (k, 3) about which the first of each pair turns towards the second."""
        return np.cross(*np.array(pairs).swapaxes(0, 1))

    trunk = np.vstack([turning((up, front), (up, side)), up])
    left = {"humanoid_root": np.eye(3), "vl5": trunk, "skullbase": trunk,
            "l_sternoclavicular": turning((side, up), (side, front)),
            "l_shoulder": np.vstack([turning((arm, arm_out), (arm, arm_front)), arm]),
            "l_elbow": turning((arm, arm_front)), "l_wrist": turning((hand, -hand_out), (hand, thumb)),
            "l_hip": np.vstack([turning((leg, leg_out), (leg, leg_front)), leg]),
            "l_knee": turning((leg, -leg_front)), "l_ankle": turning((toes, -instep))}
    axes, limits = [], []
    for name in NAMES:
        twin = name if name in left else "l_" + name[2:]
        axes.append(left[twin] * (1.0 if twin == name else np.array([1.0, -1.0, -1.0])))
        limits.append(np.radians(LIMITS[twin]))
    return tuple(axes), tuple(limits)
