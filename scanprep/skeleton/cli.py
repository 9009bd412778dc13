"""`scape prep skeleton`: parts, joints and a tree."""
from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from ..cli import Output, Unit, read_poses
from ..console import Metric, Outcome, bar
from .find import find_skeleton
from .parts import SkeletonConfig

PosesArg = Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="POSES")]


def skeleton(poses: PosesArg, output: Output, template: Path | None = None, subject: str | None = None,
             unit: Unit | None = None,
             config: Annotated[SkeletonConfig, tyro.conf.arg(name="")] = SkeletonConfig()) -> Outcome:  # noqa: B008
    """Rigid parts, joints and a tree from meshes of one person that share their triangles.

    Example: scape prep skeleton set -o skeleton.json

    Args:
        poses: Folder of meshes, or a registered set.
        output: JSON file to write.
        template: The mesh whose joints are wanted; else the first of the folder, or the set's own.
        subject: Of a registered set, whose meshes; else of the one with the most.
        unit: Unit of the meshes.
        config: Settings.
    """
    body, vertices = read_poses(poses, template, subject, unit)
    with bar("finding the skeleton") as progress:
        found = find_skeleton(body, vertices, config, progress=progress)
    found.save(output)
    shares = np.bincount(found.part_of_face, body.face_areas) / body.face_areas.sum()
    return Outcome(output, [Metric("poses", len(vertices)), Metric("parts", len(found.parents)),
                            *(Metric(f"{name}, share of the surface", 100 * float(share), "%")
                              for name, share in zip(found.names, shares, strict=True))], {"skeleton": config})
