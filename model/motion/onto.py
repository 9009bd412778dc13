"""Read a motion of any file for a model: its own motions as they are, others by retargeting."""
from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from scanprep.cli import MM
from scanprep.console import Metric
from scanprep.geometry import rotations
from scanprep.geometry.storage import StorageError
from scanprep.skeleton.roles import find_numbered_roles

from ..body import BodyModel
from ..linear import Subject, check_subject
from .amass import BODY, UNCERTAIN, moving_body, with_joints
from .bvh import read_bvh
from .error import RetargetingError, TwistError, measure_error, measure_twist
from .files import betas_for, check_ours, read_motion_file
from .moving import MovingSkeleton, set_in_motion
from .retarget import Pairing, Retargeted, retarget_pair
from .same import copy_motion, same_skeleton


@dataclass(frozen=True, eq=False)
class BodyMotion:
    """A motion of a model's body."""

    poses: np.ndarray                # (T, J, 3) radians
    trans: np.ndarray                # (T, 3) metres
    betas: np.ndarray | None         # (K,) of the body, None for the template's own
    rate: float                      # frames a second
    gender: str = "neutral"
    how: str = "as it is"            # how the motion was transferred to the body
    rest: str = ""                   # what is uncertain about the rest pose of its own skeleton
    brought: Retargeted | None = None    # result of retargeting, for a motion of another skeleton
    fit: RetargetingError | None = None
    twist: TwistError | None = None      # of a motion that was retargeted or copied

    def at_rate(self, rate: float) -> BodyMotion:
        """Resample the motion to a frame rate: rotations by the shortest way between frames, places linearly."""
        if not rate > 0:
            raise ValueError(f"rate: expected more than 0 frames a second, got {rate}")
        last = len(self.poses) - 1
        at = np.arange(int(last * rate / self.rate + 1e-9) + 1) * self.rate / rate          # in frames
        before = np.minimum(at.astype(int), last)
        after, share = np.minimum(before + 1, last), (at - before)[:, None]
        R = rotations.exp(self.poses[before])
        turn = rotations.log(np.swapaxes(R, -1, -2) @ rotations.exp(self.poses[after]))
        return replace(self, poses=rotations.log(R @ rotations.exp(share[..., None] * turn)),
                       trans=(1 - share) * self.trans[before] + share * self.trans[after], rate=rate)

    @property
    def told(self) -> list[Metric]:
        """Rows for a table: how a motion of another skeleton was retargeted, and its error."""
        if self.brought is None:
            return []
        off = self.fit and f", joint centres {MM * self.fit.distance:.0f} mm, segments {self.fit.angle:.1f}° off"
        return [Metric("motion copied", f"{self.how}{off or ''}"),
                *([Metric("rest of its skeleton", self.rest)] if self.rest else [])]

    @property
    def doubts(self) -> list[str]:
        """Why the twists of a retargeted motion need a look."""
        return self.twist.reasons if self.twist else []


def read_motion(path: str | Path, model: BodyModel, subject: Subject | None = None, unit: str | None = None,
                rate: float | None = None) -> BodyMotion:
    """Read a motion file for a model: its own (`.npz`), AMASS (`.npz`) or BVH.

    A motion of the model's parts and rest pose is taken as it is. One of the same skeleton, or of a model of the same
    family, is copied. A motion of another skeleton is retargeted: segments keep their directions, see
    `model.motion.retarget`.

    Parameters
    ----------
    path : str or Path
        Motion file.
    model : BodyModel
        The model to move.
    subject : Subject, optional
        The body that moves; by default that of the file's betas, and for other skeletons the mean person.
    unit : str, optional
        Unit of the lengths in a BVH file, by default centimetres. Travel is scaled by the legs, so it matters little.
    rate : float, optional
        Frames a second, where the file does not say or says it wrongly.

    Returns
    -------
    BodyMotion
        `poses` (T, J, 3) in radians, `trans` (T, 3) in metres, `betas`, `rate` in frames a second.

    Raises
    ------
    StorageError
        The file is missing, damaged, or of a skeleton that cannot be retargeted.

    Examples
    --------
    >>> import tempfile
    >>> from model import load_built_in_model
    >>> arrays = {"poses": np.zeros((5, 48)), "trans": np.zeros((5, 3)), "mocap_frame_rate": 30.0}
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     np.savez(f"{folder}/stand.npz", **arrays)
    ...     read_motion(f"{folder}/stand.npz", load_built_in_model()).poses.shape
    (5, 16, 3)
    """
    path, subject = Path(path), None if subject is None else check_subject(subject)
    if path.suffix.lower() == ".bvh":
        return _onto(path, read_bvh(path, unit or "cm", rate), model, subject)
    J = len(model.skeleton.parents)
    stored = read_motion_file(path, parts=J, rate=rate)
    family = bool(model.info.get("family"))
    if stored.of_family and (stored.made_for or stored.poses.shape[1] != J or family):
        if family:                                    # our model was imported from that family: same joints
            betas = betas_for(path, stored.betas, model) if subject is None else subject.betas
            return BodyMotion(with_joints(stored.poses, J), stored.trans, betas, stored.rate, stored.gender,
                              "pose by pose, of the same family")
        if stored.poses.shape[1] < BODY:
            raise StorageError(f"{path}: expected at least the {BODY} joints of the body, "
                               f"found {stored.poses.shape[1]}")
        return _onto(path, moving_body(stored), model, subject, UNCERTAIN, stored.gender)
    check_ours(path, stored)
    if stored.skeleton is not None and not same_skeleton(stored.skeleton, model.skeleton):
        moving = set_in_motion(stored.skeleton, stored.poses, stored.trans, stored.rate)
        return _onto(path, moving, model, subject, gender=stored.gender)
    if stored.poses.shape[1] != J:
        raise StorageError(f"{path}: expected frames of the model's {J} parts, found {stored.poses.shape[1]} parts; "
                           "a motion of another skeleton comes as BVH")
    betas = betas_for(path, stored.betas, model) if subject is None else subject.betas
    return BodyMotion(stored.poses, stored.trans, betas, stored.rate, stored.gender)


def _onto(path: Path, moving: MovingSkeleton, model: BodyModel, subject: Subject | None, uncertain: str = "",
          gender: str = "neutral") -> BodyMotion:
    """Retarget a motion of another skeleton to a body, by default the mean person's."""
    subject = subject or model.mean_subject
    skeleton = subject.rest_skeleton
    same = copy_motion(skeleton, subject.template, subject.vertices, moving)
    if same is not None:
        return BodyMotion(same.poses, same.trans, subject.betas, same.rate, gender,
                          "part by part, of the same skeleton", brought=same,
                          twist=measure_twist(skeleton, same.poses, subject.joints(same.poses, same.trans)))
    moving, frame = standing_rest(moving)
    if frame is not None:
        uncertain = f"that of frame {frame}, in which it stands: the file has none of a person who does"
    try:
        pair = Pairing(skeleton, subject.vertices, moving)
        done = retarget_pair(pair)
    except ValueError as problem:
        raise StorageError(f"{path}: {problem}") from None
    centres = subject.joints(done.poses, done.trans)
    fit, twist = measure_error(pair, done.poses, centres), measure_twist(skeleton, done.poses, centres, done.rolls)
    return BodyMotion(done.poses, done.trans, subject.betas, done.rate, gender, "by the directions of the segments",
                      uncertain, done, fit, twist)


def standing_rest(moving: MovingSkeleton) -> tuple[MovingSkeleton, int | None]:
    """Replace a rest pose that does not stand by the frame in which trunk and legs are most upright; return its number.

    In some files all bones lie along one axis at rest. A skeleton that stands at rest, or never stands, is returned
    unchanged, with None. The vertical is y, as BVH says, or z where nobody stands along y.
    """
    roles = find_numbered_roles(moving.names, moving.rest)
    chains = [[roles.get(f"{side}_{name}") for name in ("shoulder", "hip", "knee", "ankle")] for side in "lr"]
    if any(j is None for chain in chains for j in chain):
        return moving, None
    # (2, 1 + T): the least cosine between y, or z, and the segments from shoulders to ankles, at rest and in each frame
    steps = np.diff(np.concatenate([moving.rest[None], moving.places])[:, np.array(chains)], axis=2)
    size = np.linalg.norm(steps, axis=3)
    cosine = np.stack([(-steps[..., axis] / np.maximum(size, 1e-12)).min(axis=(1, 2)) for axis in (1, 2)])
    if cosine[:, 0].max() > 0.4:                     # every segment within 66 degrees of the vertical: it stands
        return moving, None
    along = cosine[int(cosine[0, 1:].max() < 0.8), 1:]
    best = int(along.argmax())
    if along[best] < 0.8:                            # no frame has all segments within 37 degrees of the vertical
        return moving, None
    rest = moving.places[best]
    offsets = rest - np.where(moving.parents[:, None] < 0, 0, rest[moving.parents])
    R = moving.rotations @ np.swapaxes(moving.rotations[best], -1, -2)
    return replace(moving, offsets=offsets, rotations=R), best
