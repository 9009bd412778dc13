"""From raw views of one subject to the template of all registrations."""
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..decimation.decimate import DecimateConfig, decimate
from ..fusion.tsdf import MergeConfig, merge_views
from ..geometry.mesh import Mesh, check_template
from ..geometry.remeshing import improve_triangles, smooth
from ..geometry.surface import Surface
from ..ranges import Settings
from ..repair.hole_filling import FillConfig, close
from ..repair.manifold import drop_thin, repair


@dataclass(frozen=True)
class TemplateConfig(Settings):
    """Settings of `make_template`.

    Attributes
    ----------
    merge : MergeConfig
    fill : FillConfig
    decimate : DecimateConfig
    smoothing : int
        Rounds of smoothing, once before the holes are filled and once after.
    thinnest : float, metres
        What is thinner, as fingers are that were hardly seen, is taken off.
    """

    merge: MergeConfig = field(default_factory=lambda: MergeConfig(voxel=0.004, truncation=2.0, min_cosine=0.15))
    fill: FillConfig = field(default_factory=FillConfig)
    decimate: DecimateConfig = field(default_factory=lambda: DecimateConfig(method="quadric", improve=True))
    smoothing: int = 6
    thinnest: float = 0.007


def make_template(views: Sequence[Any], faces: int = 14000, config: TemplateConfig | None = None,
                  progress: Callable[[int, int], None] | None = None) -> Mesh:
    """Range views of one subject to a closed manifold mesh: merge, repair, smooth, fill, decimate.

    Views are RangeViews or pairs of a Mesh and a camera position (3,). ValueError where they give no surface that can
    serve as a template.
    """
    config = config or TemplateConfig()
    tell = progress or (lambda done, total: None)
    mesh = merge_views(views, config.merge)
    tell(1, 4)
    mesh = smooth(repair(mesh), config.smoothing)      # smooth rims make fair patches
    tell(2, 4)
    mesh = close(mesh, config.fill)
    mesh = smooth(close(drop_thin(mesh, config.thinnest), config.fill), config.smoothing)
    tell(3, 4)
    surface = Surface(mesh)
    mesh = improve_triangles(decimate(mesh, faces, config.decimate), surface)
    if mesh.volume < 0:
        mesh = Mesh(mesh.vertices, np.ascontiguousarray(mesh.faces[:, ::-1]), mesh.colors)
    check_template(mesh, "the merged views")
    tell(4, 4)
    return mesh
