"""A motion of any file on a model: its own as it is, those of other skeletons brought onto it."""
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
from ..linear import Subject
from .amass import BODY, UNCERTAIN, moving_body, with_joints
from .bvh import read_bvh
from .error import RetargetingError, measure_error
from .files import betas_for, check_ours, read_motion_file
from .moving import MovingSkeleton
from .retarget import Pairing, Retargeted, retarget_pair
from .same import copy_motion


@dataclass(frozen=True, eq=False)
class BodyMotion:
    """A motion of a model's body."""

    poses: np.ndarray                # (T, J, 3) radians
    trans: np.ndarray                # (T, 3) metres
    betas: np.ndarray | None         # (K,) of the body, None for the template's own
    rate: float                      # frames a second
    gender: str = "neutral"
    how: str = "as it is"            # how it came onto the body
    rest: str = ""                   # what is not certain about the rest of its own skeleton
    brought: Retargeted | None = None    # what followed what, and how well, of a motion of another skeleton
    fit: RetargetingError | None = None

    def at_rate(self, rate: float) -> BodyMotion:
        """The motion with so many frames a second: joints turn the shortest way between frames, places go straight."""
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
        """For a table: how a motion of another skeleton came onto the body, and how far it is off."""
        if self.brought is None:
            return []
        off = self.fit and f", joint centres {MM * self.fit.distance:.0f} mm, segments {self.fit.angle:.1f}° off"
        return [Metric("motion copied", f"{self.how}{off or ''}"),
                *([Metric("rest of its skeleton", self.rest)] if self.rest else [])]


def read_motion(path: str | Path, model: BodyModel, subject: Subject | None = None, unit: str | None = None,
                rate: float | None = None) -> BodyMotion:
    """A motion file for a model: its own (`.npz`), AMASS (`.npz`) or BVH.

    A motion of the model's parts is taken as it is; one of its skeleton, or of a model of its family, is copied; of
    another skeleton the segments point where they pointed (see `retarget`).

    Parameters
    ----------
    path : str or Path
    model : BodyModel
    subject : Subject, optional
        The body that moves; else that of the file's betas, and for motions of other skeletons the mean person.
    unit : str, optional
        Of the lengths in a BVH file, else centimetres. Travel is as long as the legs are, so it matters little.
    rate : float, optional
        Frames a second, where the file does not say or says it wrongly.

    Raises
    ------
    StorageError
        Missing, damaged, or of a skeleton that cannot be brought onto this one.
    """
    path = Path(path)
    if path.suffix.lower() == ".bvh":
        return _onto(path, read_bvh(path, unit or "cm", rate), model, subject)
    J = len(model.skeleton.parents)
    stored = read_motion_file(path, parts=J, rate=rate)
    family = bool(model.info.get("family"))
    if stored.of_family and (stored.made_for or stored.poses.shape[1] != J or family):
        if family:                                    # a model that was imported from it
            betas = betas_for(path, stored.betas, model) if subject is None else subject.betas
            return BodyMotion(with_joints(stored.poses, J), stored.trans, betas, stored.rate, stored.gender,
                              "pose by pose, of the same family")
        if stored.poses.shape[1] < BODY:
            raise StorageError(f"{path}: expected at least the {BODY} joints of the body, "
                               f"found {stored.poses.shape[1]}")
        return _onto(path, moving_body(stored)[0], model, subject, UNCERTAIN, stored.gender)
    check_ours(path, stored)
    if stored.poses.shape[1] != J:
        raise StorageError(f"{path}: expected frames of the model's {J} parts, found {stored.poses.shape[1]} parts; "
                           "a motion of another skeleton comes as BVH")
    betas = betas_for(path, stored.betas, model) if subject is None else subject.betas
    return BodyMotion(stored.poses, stored.trans, betas, stored.rate, stored.gender)


def _onto(path: Path, moving: MovingSkeleton, model: BodyModel, subject: Subject | None, uncertain: str = "",
          gender: str = "neutral") -> BodyMotion:
    """A motion of another skeleton on a body, if none is given the mean person's."""
    subject = subject or model.subject(np.zeros(1) if model.n_betas else None)
    skeleton = replace(subject.skeleton, joints=subject.joints(np.zeros((len(subject.skeleton.parents), 3))))
    same = copy_motion(skeleton, subject.template, subject.vertices, moving)
    if same is not None:
        return BodyMotion(same.poses, same.trans, subject.betas, same.rate, gender,
                          "part by part, of the same skeleton", brought=same)
    moving, frame = standing_rest(moving)
    if frame is not None:
        uncertain = f"that of frame {frame}, in which it stands: the file has none of a person who does"
    try:
        pair = Pairing(skeleton, subject.vertices, moving)
        found = retarget_pair(pair)
    except ValueError as problem:
        raise StorageError(f"{path}: {problem}") from None
    fit = measure_error(pair, found.poses, subject.joints(found.poses, found.trans))
    return BodyMotion(found.poses, found.trans, subject.betas, found.rate, gender, "by the directions of the segments",
                      uncertain, found, fit)


def standing_rest(moving: MovingSkeleton) -> tuple[MovingSkeleton, int | None]:
    """The skeleton at rest as in the frame in which trunk and legs are nearest to the vertical, and its number.

    Some files have bones at rest that all lie along one axis. A skeleton that stands at rest, or never, is returned as
    it is, and None. The vertical is y, as BVH says, or z where nobody stands along y.
    """
    roles = find_numbered_roles(moving.names, moving.rest)
    chains = [[roles.get(f"{side}_{name}") for name in ("shoulder", "hip", "knee", "ankle")] for side in "lr"]
    if any(j is None for chain in chains for j in chain):
        return moving, None
    # (2, 1 + T): the least cosine between y, or z, and the segments from shoulders to ankles, at rest and in each frame
    steps = np.diff(np.concatenate([moving.rest[None], moving.places])[:, np.array(chains)], axis=2)
    size = np.linalg.norm(steps, axis=3)
    cosine = np.stack([(-steps[..., axis] / np.maximum(size, 1e-12)).min(axis=(1, 2)) for axis in (1, 2)])
    if cosine[:, 0].max() > 0.4:                     # it is nearly upright at rest
        return moving, None
    along = cosine[int(cosine[0, 1:].max() < 0.8), 1:]
    best = int(along.argmax())
    if along[best] < 0.8:                            # from where on somebody stands
        return moving, None
    rest = moving.places[best]
    offsets = rest - np.where(moving.parents[:, None] < 0, 0, rest[moving.parents])
    R = moving.rotations @ np.swapaxes(moving.rotations[best], -1, -2)
    return replace(moving, offsets=offsets, rotations=R), best
