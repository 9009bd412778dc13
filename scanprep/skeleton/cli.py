"""`scape prep skeleton` and `edit-skeleton`: parts, joints and a tree, found and changed by hand."""
from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np

from ..arguments import Place
from ..cli import Output, Person, Unit, read_poses
from ..console import Metric, Outcome, bar
from ..dataset import RegisteredSet
from ..geometry.files import read_mesh
from ..geometry.members import ONE_BODY, find_doubtful_members
from ..geometry.mesh import Mesh
from ..judgement import Judgement
from .edit import apply_edits, read_edits
from .find import search_skeleton, skeleton_problem
from .joints import joint_doubts, joint_gaps
from .names import note_numbered_parts, skeleton_doubts
from .parts import SkeletonConfig
from .tree import Skeleton


def skeleton(poses: Annotated[Path, Place("POSES")], output: Output, template: Path | None = None,
             subject: Annotated[str | None, Person] = None, unit: Unit | None = None,
             config: SkeletonConfig = SkeletonConfig()) -> Outcome:
    """Find rigid parts, joints and a tree from meshes of one person that share their triangles.

    Example: scape prep skeleton set -o skeleton.json

    Args:
        poses: Folder of meshes, or a registered set.
        output: JSON file to write.
        template: The mesh whose joints are wanted; else the first of the folder, or the set's own.
        subject: Of a registered set, whose meshes; else of the one with the most.
        unit: Unit of the meshes.
        config: Settings.
    """
    body, vertices, names = read_poses(poses, template, subject, unit)
    with bar("finding the skeleton") as progress:
        search = search_skeleton(body, vertices, config, progress=progress)
    found = search.skeleton
    note_numbered_parts(found)
    found.save(output)
    return Outcome(output, [
        Metric("poses", len(vertices)), Metric("parts", len(found.parents)),
        Metric("left and right alike", "yes" if search.symmetric else "no"),
        Metric("restarts that ended with as many parts",
               f"{search.parts.count(len(found.parents))} of {len(search.parts)}"),
        *_shares(found, body)], {"skeleton": config},
                   judgement=Judgement.of(skeleton_problem(search, config.parts),
                                          [*find_doubtful_members(body, vertices, str(poses), names, ONE_BODY),
                                           *skeleton_doubts(found, config.parts),
                                           *joint_doubts(found, joint_gaps(body, vertices, found).tolist())]))


def edit(skeleton: Annotated[Path, Place("SKELETON")], output: Output, template: Path | None = None,
         edits: Path | None = None, merge: tuple[str, str] | None = None, rename: tuple[str, str] | None = None,
         unit: Unit | None = None) -> Outcome:
    """Change a skeleton by hand: merge and rename parts, move joints.

    Example: scape prep edit-skeleton set --merge chest shoulder_left --rename part3 neck -o set/skeleton.json

    Args:
        skeleton: Registered set with a skeleton, or a skeleton in JSON.
        output: JSON file to write.
        template: Its mesh; of a set it is known.
        edits: JSON list of edits, such as [{"merge": [a, b]}, {"rename": {a: b}},
            {"move_joint": a, "position": [x, y, z]}], which are made first, in their order.
        merge: Two parts to become one, called like the first.
        rename: A part and its new name.
        unit: Unit of the template.
    """
    wanted = [*(read_edits(edits) if edits else []), *([{"merge": list(merge)}] if merge else []),
              *([{"rename": {rename[0]: rename[1]}}] if rename else [])]
    if not wanted:
        raise ValueError("edits: expected --edits FILE or one of --merge, --rename")
    before, body = _read_skeleton(skeleton, template, unit)
    after = apply_edits(before, body, wanted)
    after.save(output)
    return Outcome(output, [Metric("edits", len(wanted)), Metric("parts before", len(before.parents)),
                            Metric("parts", len(after.parents)), *_shares(after, body)], {"edits": wanted},
                   judgement=Judgement())


def _read_skeleton(path: Path, template: Path | None, unit: Unit | None) -> tuple[Skeleton, Mesh]:
    """Read a skeleton and its template."""
    if path.is_dir():
        whole = RegisteredSet.load(path)
        if whole.skeleton is None:
            raise ValueError(f"{path}: expected a set with a skeleton, it has none; find one with scape prep skeleton")
        return whole.skeleton, whole.template
    if template is None:
        raise ValueError(f"template: expected the mesh that the skeleton {path} belongs to")
    return Skeleton.load(path), read_mesh(template, unit)


def _shares(skeleton: Skeleton, body: Mesh) -> list[Metric]:
    """Return one table row per part: its share of the surface."""
    shares = np.bincount(skeleton.part_of_face, body.face_areas, len(skeleton.parents)) / body.face_areas.sum()
    return [Metric(f"{name}, share of the surface", 100 * float(share), "%")
            for name, share in zip(skeleton.names, shares, strict=True)]
