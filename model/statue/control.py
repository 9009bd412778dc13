"""The control model: a control mesh that hangs on a skeleton, with one chart for images."""
from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from scanprep.geometry.mesh import Mesh
from scanprep.skeleton.tree import Skeleton

from ..export.rig import Rig
from .chart import Chart


@dataclass(frozen=True, eq=False)
class ControlModel:
    """A control mesh, its skeleton with the freedom of every joint, and its chart.

    Parameters
    ----------
    mesh : Mesh
        In the default pose: closed, one component.
    skeleton : Skeleton
        Part 0 is the root; `joints` are the joint centres in the default pose.
    weights : (N, J) float
        How much each part carries each vertex; rows sum to 1, at most four are not zero.
    chart : Chart
    landmarks : {name: vertex}
        Feature points of the surface, named as in the synthetic people.
    axes : J arrays (k, 3), unit
        The axes about which a joint turns, in the default pose: `exp(angles @ axes)`, k = 0 to 3. The root's are free.
    limits : J arrays (k, 2) float, radians
        Least and greatest angle about each axis.
    segments : S strings
        Names of the segment lengths.
    segment_of_part : (J,) int
        The segment whose length stretches a part: its bone, and with it the offsets of the joints on it. Left and
        right share one.

    [Statues] Eq. 1, 2, 3
    """

    mesh: Mesh
    skeleton: Skeleton
    weights: np.ndarray
    chart: Chart
    landmarks: dict[str, int]
    axes: tuple[np.ndarray, ...]
    limits: tuple[np.ndarray, ...]
    segments: tuple[str, ...]
    segment_of_part: np.ndarray

    @cached_property
    def rig(self) -> Rig:
        """For linear blend skinning [Statues] Eq. 1."""
        return Rig(self.mesh, self.skeleton, self.weights, np.zeros((0, *self.mesh.vertices.shape)))

    def fitted(self, vertices: np.ndarray, joints: np.ndarray) -> ControlModel:
        """The same model on other vertices (N, 3) and joint centres (J, 3), whose pose becomes the default pose."""
        return replace(self, mesh=self.mesh.with_vertices(vertices), skeleton=replace(self.skeleton, joints=joints))
