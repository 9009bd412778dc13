"""The data of a statue: control model (a mesh on a skeleton, with one texture chart) and displacement map."""
from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from scanprep.geometry.mesh import Mesh, template_problem
from scanprep.skeleton.tree import Skeleton

from ...blend_weights import CARRIERS
from ...rig import Rig
from .chart import Chart, chart_problem


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
        Blend weights; rows sum to 1, at most four are not zero.
    chart : Chart
        Texture coordinates for all images.
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

    def refit(self, vertices: np.ndarray, joints: np.ndarray) -> ControlModel:
        """Replace vertices (N, 3) and joint centres (J, 3); their pose becomes the default pose."""
        return replace(self, mesh=self.mesh.with_vertices(vertices), skeleton=replace(self.skeleton, joints=joints))


def control_problem(control: ControlModel) -> str | None:
    """Explain why a control model is not usable; None where it is."""
    mesh, J, N = control.mesh, len(control.skeleton.parents), len(control.mesh.vertices)
    problem = surface_problem(mesh) or chart_problem(mesh, control.chart)
    if problem:
        return problem
    if control.weights.shape != (N, J):
        return f"expected weights of shape {(N, J)}, it has {control.weights.shape}"
    carriers = (control.weights > 0).sum(axis=1).max()
    if not (control.weights >= 0).all() or not np.allclose(control.weights.sum(axis=1), 1, atol=1e-6) \
            or carriers > CARRIERS:
        return f"expected weights of at least 0 that sum to 1, at most {CARRIERS} a vertex, found up to {carriers}"
    if [len(axes) for axes in control.axes] != [len(limits) for limits in control.limits] or len(control.axes) != J:
        return f"expected axes and limits of {J} joints"
    if max(map(len, control.axes)) > 3 or not np.allclose(np.linalg.norm(np.concatenate(control.axes), axis=1), 1):
        return "expected at most three axes of unit length at a joint"
    if not (np.diff(np.concatenate(control.limits), axis=1) >= 0).all():
        return "expected limits with the least angle first"
    if not set(control.segment_of_part.tolist()) == set(range(len(control.segments))):
        return f"expected every one of {len(control.segments)} segments to have parts"
    bad = [name for name, vertex in control.landmarks.items() if not 0 <= vertex < N]
    return f"landmark {bad[0]} is not on the mesh" if bad else None


def surface_problem(mesh: Mesh) -> str | None:
    """Explain why a mesh cannot be a control mesh; None where it can."""
    problem = template_problem(mesh)
    if problem is None and not mesh.is_closed:
        problem = f"it is open: {(mesh.edge_use == 1).sum()} edges have one triangle only, expected a closed surface"
    return problem or (None if mesh.volume > 0 else "it is inside out")


OUTSIDE, HOLE, FOLDED, MEASURED = 0, 85, 170, 255      # grey values of the coverage image


@dataclass(frozen=True, eq=False)
class DisplacementMap:
    """Images over the chart of a control model; rows from the top.

    Attributes
    ----------
    heights : (H, W) float32, metres
        Along the interpolated normal of the control mesh. Filled smoothly in holes and folds, continued outside.
    coverage : (H, W) uint8
        MEASURED; FOLDED where the surface is not one-to-one with the control mesh; HOLE where there are no data;
        OUTSIDE the chart.
    """

    heights: np.ndarray
    coverage: np.ndarray


@dataclass(frozen=True, eq=False)
class Statue:
    """One person as control model, displacement map and texture; made by `fit_statue`.

    Attributes
    ----------
    control : ControlModel
        The fitted control model; its default pose is that of the scan.
    pose : (J, 3) float, radians
        Rotations of the generic model's parts from its default pose to that of the scan.
    map : DisplacementMap
        The detail of the scan over the control mesh.
    texture : (H, W, 3) uint8, optional
        Colours over the same chart.

    Examples
    --------
    A statue of the generic humanoid itself, with a flat map:

    >>> from model.statue.control.files import humanoid
    >>> from model.statue.control.model import MEASURED, DisplacementMap
    >>> flat = DisplacementMap(np.zeros((16, 16), np.float32), np.full((16, 16), MEASURED, np.uint8))
    >>> Statue(humanoid(), np.zeros((len(humanoid().skeleton.parents), 3)), flat).upright_axis
    2

    [Statues]
    """

    control: ControlModel
    pose: np.ndarray
    map: DisplacementMap
    texture: np.ndarray | None = None

    @property
    def upright_axis(self) -> int:
        """0, 1 or 2: the axis of the scan nearest to the upward direction of the person's trunk."""
        return int(np.abs(self.control.skeleton.part_rotations(self.pose)[0][:, 2]).argmax())
