"""Read motion files (`.npz`), ours and those of AMASS."""
from __future__ import annotations

import warnings
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scanprep.geometry import storage
from scanprep.geometry.storage import StorageError
from scanprep.ranges import BETAS, TINY, TURNS, Range
from scanprep.skeleton.tree import Skeleton

from ..body import BodyModel
from ..files import KINDS
from .bvh import USUAL_RATE

OURS = tuple(KINDS)                                  # `surface_model_type` of motions of our models
FAMILY = ("smpl", "star", "supr")                    # prefixes of `surface_model_type` of motions in AMASS
JOINTS = (22, 24, 52, 55)                            # joints of these models: the body, with hands, fingers, face
RATES = ("mocap_frame_rate", "mocap_framerate", "fps", "frame_rate", "framerate")
# pieces of poses in their order, with the names of AMASS and of the smplx library, and their sizes
_PIECES = ({"root_orient": 3, "global_orient": 3}, {"pose_body": 63, "body_pose": 63},
           {"pose_jaw": 3, "jaw_pose": 3}, {"pose_eye": 6, "leye_pose": 3}, {"reye_pose": 3},
           {"pose_hand": 90, "left_hand_pose": 45}, {"right_hand_pose": 45})
# motion files of other programs by their ending: what they are, and what to export instead
SKELETON = ("part_names", "part_parents", "rest_joints")        # arrays of the skeleton that a motion belongs to
_ROTATIONS = "holds rotations of segments and no markers; export BVH in its place, for scape animate"
OTHER_MOTIONS = {
    ".fbx": "FBX: open it in Blender or MotionBuilder and export BVH, for scape animate",
    ".asf": "the skeleton of an ASF/AMC pair: amc2bvh or Blender makes BVH of both, for scape animate",
    ".amc": "the motion of an ASF/AMC pair: amc2bvh or Blender makes BVH of both, for scape animate",
    ".mvnx": f"a file of Xsens MVN, which {_ROTATIONS}", ".htr": f"HTR of Motion Analysis, which {_ROTATIONS}",
    ".gtr": f"GTR of Motion Analysis, which {_ROTATIONS}"}


@dataclass(frozen=True, eq=False)
class StoredMotion:
    """A motion as its file has it."""

    poses: np.ndarray                # (T, J, 3) radians
    trans: np.ndarray                # (T, 3) metres
    betas: np.ndarray | None         # (K,), None where there are none
    rate: float                      # frames a second
    gender: str
    made_for: str                    # the kind of model, "" where the file does not say
    more: dict[str, np.ndarray]      # further arrays that were asked for
    skeleton: Skeleton | None = None     # at rest, None where the file does not hold it

    @property
    def of_family(self) -> bool:
        """Whether this is a motion of the SMPL family, as in AMASS."""
        return self.made_for.lower().startswith(FAMILY) or (not self.made_for and self.poses.shape[1] in JOINTS)


def skeleton_arrays(skeleton: Skeleton) -> dict[str, np.ndarray]:
    """Return the arrays that say in a motion file whose motion it is: names, parents and joints at rest of the parts.

    Examples
    --------
    >>> skeleton_arrays(Skeleton([0, 1], [-1, 0], np.zeros((2, 3)), ("trunk", "head")))["part_names"].tolist()
    ['trunk', 'head']
    """
    values = np.array(skeleton.names), skeleton.parents, skeleton.joints
    return dict(zip(SKELETON, values, strict=True))


def is_motion(path: Path) -> bool:
    """Return whether an `.npz` file holds a motion."""
    names = storage.names_in(path, "a motion (.npz)")
    return "poses" in names or _whole_body(names)


def _whole_body(names: Collection[str]) -> bool:
    """Return whether the pieces of a pose that every body has are there."""
    return all(any(name in names for name in piece) for piece in _PIECES[:2])


def read_motion_file(path: str | Path, more: Collection[str] = (), parts: int | None = None,
                     rate: float | None = None) -> StoredMotion:
    """Read a motion file: `poses`, `trans`, `mocap_frame_rate`, and `betas` if it has some.

    Names may be those of AMASS or of the smplx library (`global_orient`, `body_pose`, `transl`, `fps`). Without a rate,
    30 frames a second are assumed, with a warning. `more` are further arrays to read; `parts` is the model's number of
    parts, for messages; `rate` replaces the frames a second of the file.

    Raises
    ------
    StorageError
        Missing, damaged, not finite, or no motion: which array, what was expected, what came.
    """
    path = Path(path)
    # files of other programs are recognised by their ending: say what to do instead
    if path.suffix.lower() == ".bvh":
        raise StorageError(f"{path}: expected a motion (.npz), found BVH; scape animate {path.name} -m MODEL -o OUT "
                           "puts it on a model")
    if path.suffix.lower() in OTHER_MOTIONS:
        raise StorageError(f"{path}: expected a motion (.npz), found {OTHER_MOTIONS[path.suffix.lower()]}")
    place_names = ("trans", "transl")
    what, wanted = "a motion (.npz)", (
        "poses", *place_names, "betas", *RATES, *(name for piece in _PIECES for name in piece), *SKELETON, *more)
    # only known arrays are read; poses in pieces are joined
    a = storage.load_arrays(path, what, wanted)
    for name in ("gender", "surface_model_type"):        # pickled objects in some files: these are skipped
        try:
            a |= storage.load_arrays(path, what, (name,))
        except StorageError:
            continue
    if "poses" not in a and _whole_body(a):
        with storage.taking_apart(path, "a whole motion"):
            a["poses"] = _join_poses(a)
    places = [a[name] for name in place_names if name in a]
    lacking = [name for name, found in (("poses", "poses" in a), ("trans", places)) if not found]
    if lacking:
        raise StorageError(f"{path}: expected a motion, it lacks {' and '.join(lacking)}")
    a["trans"] = places[0]
    with storage.taking_apart(path, "a whole motion"):
        return _restore_motion(path, a, more, parts, rate)


def _join_poses(a: dict[str, np.ndarray]) -> np.ndarray:
    """Join pieces to poses (T, 3J): the body, with face and hands where all are there as rotations.

    Hands as components of a hand model are left out, since only that model can expand them.
    """
    root = next(a[name] for name in _PIECES[0] if name in a)
    T = root.size // 3
    pieces = [(a[name].reshape(T, -1), size) for piece in _PIECES for name, size in piece.items() if name in a]
    body = pieces[1][0]
    if body.shape[1] == 69:                              # SMPL: the hands are two joints of the body
        return np.concatenate([pieces[0][0], body], axis=1)
    flat = np.concatenate([values for values, size in pieces if values.shape[1] == size], axis=1)
    return flat if flat.shape[1] // 3 in JOINTS else np.concatenate([pieces[0][0], body], axis=1)


def _restore_motion(path: Path, a: dict[str, np.ndarray], more: Collection[str], parts: int | None,
                    rate: float | None) -> StoredMotion:
    made_for = storage.text(a, "surface_model_type", "")
    if not made_for.lower().startswith((*OURS, *FAMILY)) and made_for:
        raise StorageError(f"{path}: expected surface_model_type '{OURS[0]}', found '{made_for}'")
    name = next((name for name in RATES if name in a), "")
    if rate is None and not name:
        warnings.warn(f"{path}: it does not say its frames a second ({RATES[0]}), {USUAL_RATE:g} are assumed; "
                      "say rate=", stacklevel=3)
        rate = USUAL_RATE
    elif rate is None:
        if np.size(a[name]) != 1:
            raise ValueError(f"{name}: expected one number, found shape {np.shape(a[name])}")
        rate = float(a[name].item())
        Range(TINY).check(rate, name)
    # poses, flat or by parts, and betas, one row or one for every frame
    T, shape = len(np.atleast_1d(a["poses"])), a["poses"].shape[1:]
    poses = storage.numbers(a, "poses", T, *shape)
    if not T or poses[0].size % 3 or not poses[0].size:
        whose = "parts" if parts is None else f"the model's {parts} parts"
        raise StorageError(f"{path}: expected frames of {whose}, three numbers each, found shape {poses.shape}")
    poses = poses.astype(np.float64).reshape(T, -1, 3)
    betas = storage.numbers(a, "betas", *a["betas"].shape).astype(np.float64) if "betas" in a else np.zeros(0)
    if betas.ndim == 2 and len(betas) in (1, T):                                   # some files have them as rows
        if np.ptp(betas, axis=0).max(initial=0) > 1e-3:
            warnings.warn(f"{path}: its betas change from frame to frame; their median is taken", stacklevel=3)
        betas = np.median(betas, axis=0)
    betas = storage.numbers({"betas": betas}, "betas", None)
    BETAS.check(betas, "betas")
    TURNS.check(poses, "poses")
    return StoredMotion(poses, storage.numbers(a, "trans", T, 3).astype(np.float64), betas if betas.size else None,
                        rate, storage.text(a, "gender", "neutral"),
                        made_for, {name: a[name] for name in more if name in a}, _skeleton(a, poses.shape[1]))


def _skeleton(a: dict[str, np.ndarray], parts: int) -> Skeleton | None:
    """Build the skeleton at rest from the arrays of a motion of some parts; None where they are not there."""
    if not a.keys() >= set(SKELETON):
        return None
    return Skeleton(np.arange(parts), storage.numbers(a, "part_parents", parts, kinds="iu"),
                    storage.numbers(a, "rest_joints", parts, 3), tuple(str(name) for name in a["part_names"]))


def check_ours(path: str | Path, stored: StoredMotion, where: str = "") -> None:
    """Raise StorageError for a motion of another kind of model."""
    if stored.made_for not in (*OURS, ""):
        raise StorageError(f"{path}: expected surface_model_type '{OURS[0]}', found '{stored.made_for}'{where}")


def betas_for(path: str | Path, betas: np.ndarray | None, model: BodyModel) -> np.ndarray | None:
    """Cut betas to those of the model; only zeros may be cut, else StorageError."""
    if betas is None or len(betas) <= model.n_betas:
        return betas
    used = int(np.flatnonzero(betas).max(initial=-1)) + 1
    if used > model.n_betas:
        raise StorageError(f"{path}: expected at most the {model.n_betas} betas of the model, found {used}")
    return betas[:model.n_betas] if model.n_betas else None
