"""A motion whose surface is known everywhere: through held-out scans, with what the model misses of them.

At every stop the surface is a real scan that the model has never seen. On the way the pose turns from stop to
stop, and what is between the fitted body and the scan turns with the parts and fades into that of the next one.
"""
from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from protocols import RealData, scape_fold

from completion.mocap.files.markers import MarkerSequence
from completion.mocap.marker_sets.layout import MarkerLayout
from model.body import BodyModel
from model.fitting.vertices import fit_pose
from model.linear import Subject
from scanprep.geometry import rotations


@dataclass(frozen=True, eq=False)
class HeldOutMotion:
    """Held-out scans as stops of a motion.

    Parameters
    ----------
    subject : Subject
    poses, trans : (S, J, 3), (S, 3) float
        The body fitted to the scans.
    missed : (S, N, 3) float, metres
        From the fitted bodies to the scans, turned back into the template's frame part by part.
    per_stop : int
        Frames from one stop to the next.
    rate : float, frames per second
    """

    subject: Subject
    poses: np.ndarray
    trans: np.ndarray
    missed: np.ndarray
    per_stop: int
    rate: float

    @property
    def count(self) -> int:
        return (len(self.poses) - 1) * self.per_stop + 1

    @cached_property
    def part(self) -> np.ndarray:
        return self.subject.skeleton.part_of_vertex(self.subject.template)

    def vertices(self, frames: np.ndarray, some: np.ndarray | slice = slice(None)) -> np.ndarray:
        """True vertices (n, N, 3) of some frames, metres."""
        i = np.minimum(frames // self.per_stop, len(self.poses) - 2)
        share = frames / self.per_stop - i
        share = (share**2 * (3 - 2 * share))[:, None, None]
        turn = rotations.log(np.swapaxes(rotations.exp(self.poses[i]), -1, -2) @ rotations.exp(self.poses[i + 1]))
        pose = rotations.log(rotations.exp(self.poses[i]) @ rotations.exp(share * turn))
        trans = self.trans[i] + share[..., 0] * (self.trans[i + 1] - self.trans[i])
        missed = (1 - share) * self.missed[i][:, some] + share * self.missed[i + 1][:, some]
        R = self.subject.skeleton.part_rotations(pose)[:, self.part[some]]
        return self.subject.vertices(pose, trans)[:, some] + (R @ missed[..., None])[..., 0]

    def markers(self, layout: MarkerLayout) -> MarkerSequence:
        """What cameras would see of markers on the skin."""
        return MarkerSequence(self.vertices(np.arange(self.count), layout.vertices), layout.labels, self.rate)

    def error(self, poses: np.ndarray, trans: np.ndarray, every: int = 6) -> np.ndarray:
        """Mean distance (n,) of all vertices to the true ones in every sixth frame, millimetres."""
        out = []
        for start in range(0, self.count, 20 * every):
            frames = np.arange(start, min(start + 20 * every, self.count), every)
            apart = self.subject.vertices(poses[frames], trans[frames]) - self.vertices(frames)
            out.append(1e3 * np.linalg.norm(apart, axis=2).mean(axis=1))
        return np.concatenate(out)


def held_out_motion(data: RealData, model: BodyModel, fold: int, per_stop: int = 90, rate: float = 120.0
                    ) -> HeldOutMotion:
    """The motion through the held-out scans of a fold."""
    subject = model.subject(None)
    part = subject.skeleton.part_of_vertex(subject.template)
    poses, trans, missed = [], [], []
    for i in scape_fold(fold)[1]:
        fit = fit_pose(subject, data.poses[i])
        R = subject.skeleton.part_rotations(fit.pose)[part]
        poses.append(fit.pose)
        trans.append(fit.trans)
        missed.append(((data.poses[i] - fit.vertices)[:, None] @ R)[:, 0])
    return HeldOutMotion(subject, np.array(poses), np.array(trans), np.array(missed), per_stop, rate)


def dropped(sequence: MarkerSequence, share: float, seconds: float, rng: np.random.Generator) -> MarkerSequence:
    """At every time this share of the markers is out of sight, each for so long."""
    positions = sequence.positions.copy()
    T, L = positions.shape[:2]
    length = round(seconds * sequence.rate)
    for marker in range(L):
        t = -rng.integers(length)
        while t < T:
            if rng.random() < share:
                positions[max(t, 0):t + length, marker] = np.nan
            t += length
    return MarkerSequence(positions, sequence.labels, sequence.rate)


def swapped(sequence: MarkerSequence, pairs: int, seconds: float, rng: np.random.Generator) -> MarkerSequence:
    """So many random pairs exchange their labels, each once for so long."""
    positions = sequence.positions.copy()
    length = round(seconds * sequence.rate)
    for _ in range(pairs):
        two = rng.choice(positions.shape[1], 2, replace=False)
        t = rng.integers(len(positions) - length)
        positions[t:t + length, two] = positions[t:t + length, two[::-1]]
    return MarkerSequence(positions, sequence.labels, sequence.rate)


def strayed(sequence: MarkerSequence, share: float, sd: float, rng: np.random.Generator) -> MarkerSequence:
    """This share of all single observations lies somewhere else."""
    positions = sequence.positions.copy()
    off = rng.random(positions.shape[:2]) < share
    positions[off] += rng.normal(0, sd, (int(off.sum()), 3))
    return MarkerSequence(positions, sequence.labels, sequence.rate)
