"""Layouts as marker sets of OpenSim: every marker on its body, as a start for the scale tool."""
from __future__ import annotations

from pathlib import Path

import numpy as np

from model.export.names import names_of
from scanprep.geometry import storage
from scanprep.geometry.format_common import MeshFileError
from scanprep.geometry.landmark_reading import read_marker_set
from scanprep.geometry.mesh import Mesh
from scanprep.pictures.camera import stance
from scanprep.skeleton.tree import Skeleton

from ..files.text import MarkerFileError
from .layout import MarkerLayout
from .symmetry import label_pairs

_LIMBS = {"humerus": "ulna", "ulna": "hand", "femur": "tibia", "tibia": "calcn"}      # body -> the next one below it
_WITH = {"head": "torso"}            # bodies that most models lack -> the body that has their markers
# other bodies of Rajagopal's and gait2392's models -> our body, and their origin in it, metres
_SAME = {"radius": ("ulna", (-0.0067, -0.0130, 0.0261)), "talus": ("tibia", (-0.010, -0.400, 0.0)),
         "toes": ("calcn", (0.1788, -0.002, 0.0011)), "head": ("torso", (-0.020, 0.3715, 0.0))}
# lengths in Rajagopal's model, metres: limbs, and from the lowest lumbar joint up to the shoulders
_LENGTHS = {"femur": 0.408, "tibia": 0.400, "humerus": 0.286, "ulna": 0.249}
_TORSO = 0.3715


def opensim_markers(layout: MarkerLayout, body: Mesh, skeleton: Skeleton) -> dict[str, tuple[str, np.ndarray]]:
    """Return label -> path of the OpenSim body, and the place (3,) in its frame, metres, for `marker_set`.

    The body stands at rest, arms anywhere; the skeleton has its joints. Frames have x forward, y up or along the limb
    towards the root, and z right. Hips, knees, ankles, shoulders and elbows are those of the skeleton; pelvis, torso
    and heel have their origins as in gait2392. This is a good start: the scale tool moves markers to those measured.

    Raises
    ------
    ValueError
        A skeleton without the parts of a person.
    """
    named = names_of(skeleton, "opensim")
    frames = _frames({name: skeleton.joints[skeleton.names.index(part)] for part, name in named.items()
                      if name not in _WITH}, *stance(body))
    # the OpenSim body of a part: its own, or that of the first ancestor with one
    carriers, found = list[str](), {}
    for part in skeleton.part_of_vertex(body)[layout.nearest].tolist():
        name = ""
        while part >= 0 and name not in frames:
            name = named.get(skeleton.names[part], "")
            name, part = _WITH.get(name, name), int(skeleton.parents[part])
        carriers.append(name if name in frames else "torso")
    order = ("pelvis", "torso", "femur", "humerus", "tibia", "ulna", "calcn", "hand")
    # left and right markers go on the same kind of body
    for i, (label, place, other) in enumerate(zip(layout.labels, layout.place(body), label_pairs(layout.labels),
                                                  strict=True)):
        kind, _, side = carriers[i].partition("_")
        partner = carriers[other].partition("_")[0] if other >= 0 else kind
        kind = min(kind, partner, key=order.index)           # of a pair at a joint, the one that is nearer the root
        name = kind if kind in frames else f"{kind}_{side}"
        origin, axes = frames[name]
        found[label] = f"/bodyset/{name}", axes.T @ (place - origin)
    return found


def opensim_places(path: Path, body: Mesh, skeleton: Skeleton) -> dict[str, np.ndarray]:
    """Read a marker set or model of OpenSim (.xml, .osim); return label -> place (3,), metres, on a body at rest.

    Limbs and trunk are scaled to those of the body. Errors of some centimetres remain, which `find_person` corrects.

    Parameters
    ----------
    path : Path
        With markers on bodies of gait2392 or Rajagopal's model, such as `/bodyset/femur_r`.
    body : Mesh
        At rest.
    skeleton : Skeleton
        With joints on that body.

    Raises
    ------
    MarkerFileError
        No marker set, no markers, a marker on a body that is not known.
    """
    try:
        markers = read_marker_set(path, storage.read_bytes(path, "a marker set of OpenSim", MarkerFileError))
    except MeshFileError as error:
        raise MarkerFileError(str(error)) from None
    if not markers:
        raise MarkerFileError(f"{path}: expected markers of OpenSim, found none")
    joints = {name: skeleton.joints[skeleton.names.index(part)] for part, name in names_of(skeleton, "opensim").items()
              if name not in _WITH}
    vertical, ahead = stance(body)
    frames = _frames(joints, vertical, ahead)
    scale = float(np.linalg.norm(joints["femur_l"] - joints["femur_r"])) / 0.167
    places = {}
    for name, (frame, place) in markers.items():
        kind, _, side = frame.partition("_")
        kind, begin = _SAME.get(kind, (kind, (0.0, 0.0, 0.0)))
        carrier = f"{kind}_{side}" if side else kind
        if carrier not in frames:
            raise MarkerFileError(f"{path}: marker '{name}': expected one on {', '.join(sorted(frames))}, found it on "
                                  f"'{frame}'")
        # origins of bodies with another name; z points right, so it changes sign on the left side
        place = scale * (place + begin * np.array([1.0, 1.0, -1.0 if side == "l" else 1.0]))
        below = f"{_LIMBS.get(kind)}_{side}"
        if kind in _LENGTHS and below in joints:
            place[1] *= float(np.linalg.norm(joints[carrier] - joints[below])) / (_LENGTHS[kind] * scale)
        elif kind == "torso" and {"humerus_l", "humerus_r"} <= joints.keys():
            shoulders = (joints["humerus_l"] + joints["humerus_r"]) / 2
            place[1] *= float(vertical @ (shoulders - frames["torso"][0])) / (_TORSO * scale)
        origin, axes = frames[carrier]
        places[name] = origin + axes @ place
    return places


def _frames(joints: dict[str, np.ndarray], vertical: np.ndarray, ahead: np.ndarray
            ) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Compute origin (3,), metres, and axes (3, 3) as columns, of every OpenSim body."""
    if not {"femur_l", "femur_r", "pelvis"} <= joints.keys():
        raise ValueError(f"skeleton: expected a pelvis and two thighs, as OpenSim's bodies, got {', '.join(joints)}")
    # OpenSim bodies have their origin at the joint, except pelvis, torso and heel. Their offsets are those of gait2392,
    # whose hips are 0.167 m apart, in axes x forward, y up, z right.
    scale = float(np.linalg.norm(joints["femur_l"] - joints["femur_r"])) / 0.167
    upright = np.column_stack([ahead, vertical, np.cross(ahead, vertical)])
    # pelvis: between the anterior superior iliac spines, from the middle of the hips; torso: lowest lumbar joint
    pelvis = (joints["femur_l"] + joints["femur_r"]) / 2 + scale * upright @ (0.0707, 0.0661, 0.0)
    found = {"pelvis": (pelvis, upright), "torso": (pelvis + scale * upright @ (-0.1007, 0.0815, 0.0), upright)}
    for name, joint in joints.items():
        kind, _, side = name.partition("_")
        if kind == "calcn":
            found[name] = joint + scale * upright @ (-0.0488, -0.0420, 0.0), upright
        elif f"{_LIMBS.get(kind)}_{side}" in joints:
            found[name] = joint, _along(joint - joints[f"{_LIMBS[kind]}_{side}"], vertical, ahead)
        elif kind == "hand":
            found[name] = joint, _along(joints.get(f"ulna_{side}", joint + vertical) - joint, vertical, ahead)
    return found


def _along(y: np.ndarray, vertical: np.ndarray, ahead: np.ndarray) -> np.ndarray:
    """Build axes (3, 3) with a given y, and x as far forward as y allows."""
    y = y / np.linalg.norm(y)
    x = ahead if abs(y @ ahead) < 0.9 else vertical
    x = x - (x @ y) * y
    x /= np.linalg.norm(x)
    return np.column_stack([x, y, np.cross(x, y)])
