"""Limbs that turned over: elbows and knees that bend the way they cannot, although their markers are there.

Both ends of a limb and its bend are right then; only upper arm or thigh, and what hangs on it, are half a turn about
their bones. They are turned back, solved again, and taken where the markers agree.
"""
from __future__ import annotations

from functools import cached_property

import numpy as np

from scanprep.geometry import rotations

from ..joint_angles import SegmentAxes, anatomy, angles_of, ground_axes, rest_joints
from .marked_body import AnimateConfig, MarkedBody, distances_apart, marker_misfit, marker_weights

HINGES = {"knee_angle": ("thigh", "shank"), "elbow_flex": ("humerus", "forearm")}
BACKWARDS = -20.0                    # degrees: no elbow and no knee of people bends so far the other way
LEAST = 2                            # markers on a limb and what hangs on it, without which it is anybody's guess


class Hinges:
    """The elbows and knees of a body with markers; none where it is no person's."""

    def __init__(self, body: MarkedBody) -> None:
        self.body, self.skeleton, self.turned = body, body.body.skeleton, 0      # frames that were turned back

    @cached_property
    def segments(self) -> SegmentAxes | None:
        """The segments of a person."""
        try:
            return anatomy(self.skeleton.names, self.skeleton.parents, rest_joints(self.body.body.subject))
        except ValueError:
            return None

    def turn_back(self, x: np.ndarray, targets: np.ndarray, config: AnimateConfig) -> np.ndarray:
        """Turn limbs back that bend the wrong way in frames of unknowns (T, P), with markers (T, L, 3)."""
        if self.segments is None:
            return x
        out = x.copy()
        names = [name for joint in self.segments.joints() for name in joint.angles]
        bends = self.measure(x, self.segments)
        for side, (hinge, limb) in ((side, item) for side in "lr" for item in HINGES.items()):
            if f"{hinge}_{side}" not in names:
                continue
            parts = [self.segments.parts[f"{name}_{side}"] for name in limb]
            own = np.isin(self.body.part_of_marker, [*parts, *np.flatnonzero(self.skeleton.parents == parts[1])])
            seen = np.isfinite(targets[:, own, 0]).sum(axis=1) >= LEAST
            frames = np.flatnonzero(seen & (bends[:, names.index(f"{hinge}_{side}")] < BACKWARDS))
            if not len(frames):
                continue
            # half a turn about the two bones, then the markers of each frame by themselves
            turned = self.roll(out[frames], [f"{name}_{side}" for name in limb], self.segments)
            weights, _ = marker_weights(self.body.positions(turned), targets[frames], config.marker_sd, config.outlier)
            turned = self.body.solve(turned, targets[frames], weights, 20, 1e-4).x
            bend = self.measure(turned, self.segments)[:, names.index(f"{hinge}_{side}")]
            better = (bend > BACKWARDS) & (self.misfit(turned, targets[frames], config)
                                           <= self.misfit(out[frames], targets[frames], config) + 1e-9)
            out[frames[better]] = turned[better]
            self.turned += int(better.sum())
        return out

    def measure(self, x: np.ndarray, segments: SegmentAxes) -> np.ndarray:
        """Compute the joint angles (T, K), degrees, of unknowns (T, P)."""
        poses, trans, _ = self.body.body.split(x)
        R = self.skeleton.part_rotations(poses)
        axes = segments.move(R, self.body.body.subject.joints(poses, trans))
        return angles_of(segments, ground_axes(segments.axes, R[:, 0]), axes)

    def roll(self, x: np.ndarray, limb: list[str], segments: SegmentAxes) -> np.ndarray:
        """Turn upper and lower segment of a limb half a turn about their bones; what hangs on them stays in place."""
        turned = self.skeleton.part_rotations(self.body.body.split(x)[0])
        for name in limb:
            part = segments.parts[name]
            bone = turned[:, part] @ segments.frames[name][:, 1]
            turned[:, part] = rotations.exp(np.pi * bone) @ turned[:, part]
        return self.body.body.join(self.skeleton.pose_of(turned), self.body.body.split(x)[1])

    def misfit(self, x: np.ndarray, targets: np.ndarray, config: AnimateConfig) -> np.ndarray:
        """Compute the misfit (T,) of markers (T, L, 3)."""
        return marker_misfit(np.sqrt(distances_apart(self.body.positions(x), targets, config.outlier)[0]),
                             config.outlier)
