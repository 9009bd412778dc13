"""Pictures of a person with markers and of its soft tissue."""
from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from model.body import BodyModel
from scanprep.geometry.mesh import Mesh
from scanprep.pictures.camera import look_around
from scanprep.pictures.scene import Pane, picture_panes
from scanprep.pictures.shading import Bones, Dots, Heat, Shape, Solid

from ...motion_pictures import MARKER, frames_to_play, moving_pane
from ..soft_tissue.soft_tissue import SoftTissue
from .mosh import MoshResult
from .takes import Take

USUAL, UNCERTAIN = (0.30, 0.50, 0.72), (0.93, 0.62, 0.16)


def person_in_mean_pose(model: BodyModel, betas: np.ndarray) -> Mesh:
    """Return the person in the mean pose of the training set."""
    return model.template.with_vertices(model.vertices(model.pose_mean, betas))


def person_picture(model: BodyModel, result: MoshResult) -> np.ndarray:
    """Render a person with the markers from four sides, for the page of all people."""
    body = person_in_mean_pose(model, result.betas)
    shapes: list[Shape] = [Solid(body), Dots(result.layout.place(body), MARKER, 0.011)]
    return picture_panes([Pane(shapes, camera) for camera in look_around(body)], 360)


def person_pane(body: Mesh, found: np.ndarray, usual: np.ndarray, labels: Sequence[str]) -> Pane:
    """Return a body with its markers (L, 3), and their usual places (L, 3) with a rod between the two."""
    return Pane([Solid(body, name="body"), Dots(found, MARKER, 0.011, name="markers as found", labels=labels),
                 Dots(usual, USUAL, 0.009, name="in the layout"),
                 Bones(usual, found, USUAL, 0.004, name="from one to the other")], look_around(body, turns=(20,))[0])


def kinds_of_markers(take: Take) -> dict[str, tuple[Sequence[float], np.ndarray]]:
    """Return kind -> colour and positions (T, L, 3) of the measured markers of that kind, NaN elsewhere."""
    used = np.isfinite(take.motion.residuals).any(axis=0)
    kinds = {"believed markers": (MARKER, take.motion.trusted & used),
             "not believed": (UNCERTAIN, ~take.motion.trusted & used)}
    found = {name: (color, np.where(np.broadcast_to(which, take.motion.trusted.shape)[..., None],
                                    take.markers.positions, np.nan)) for name, (color, which) in kinds.items()}
    return {name: (color, at) for name, (color, at) in found.items() if np.isfinite(at).any()}


def take_pane(take: Take) -> Pane:
    """Return the whole sequence with its markers."""
    frames, _ = frames_to_play(take.shown)
    dots = [(Dots(at[0], color, 0.013, name=name, labels=take.markers.labels), at[frames])
            for name, (color, at) in kinds_of_markers(take).items()]
    return moving_pane(take.shown, take.subject, dots, take.make)


def soft_pane(take: Take, soft: SoftTissue) -> Pane:
    """Return a body coloured by how far soft tissue moves the skin, root mean square over time."""
    body = take.subject.template.with_vertices(take.subject.vertices(take.model.pose_mean).astype(float))
    change = soft.movement(take.model)
    # 0.005 metres at least, so that tiny changes stay pale
    end = max(float(np.percentile(change, 99.5)), 0.005)
    shown = Heat(change, 0, end, "change of the skin, root mean square over time")
    return Pane([Solid(body, shown)], look_around(body, turns=(20,))[0])
