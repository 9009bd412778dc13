"""Registration through a model: a body is found on a scan, and a template of any triangles goes along.

1. The model's body is fitted to the template, and laid on it: every vertex of the template gets a place in a triangle
   of the body, and a distance from its skin. That is done once.
2. On a scan the body is found by the search of `complete`: typical poses turned every way, limbs tried elsewhere.
3. The template's vertices go where their places on the body are, and the template is registered from there on.
"""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

import numpy as np

from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Surface
from scanprep.registration.lead import Led
from scanprep.registration.nonrigid import register, share_stretched
from scanprep.registration.person import PersonParts
from scanprep.skeleton.roles import joint_in_words
from scanprep.skeleton.tree import Skeleton
from scanprep.synthetic.anatomy import PARENTS, PARTS
from scanprep.threads import one_thread

from ..body import BodyModel
from ..files import BUILT_IN, load_model
from ..fitting.bodies import as_body
from ..fitting.limbs import with_limbs
from ..fitting.rounds import solve_jointly
from ..fitting.scan import prepare_scan
from ..fitting.scan_fit import STRANGE, ScanFit, scan_fit
from ..fitting.settings import ScanFitConfig
from ..fitting.starts import best_starts, first_starts, from_nothing

Landmarks = tuple[np.ndarray, np.ndarray]
# of a template: share off the body that was laid on it, and of the body that is stretched, from which on it is another
# thing than the model; people have 0.004 and 0.001, a crab 0.005 and 0.088
OTHER = 0.02, 0.05
LEFT_OVER = 0.03                     # share of a scan with no body near, from which on a limb may be elsewhere


@dataclass(frozen=True, eq=False)
class ModelLead:
    """A model that leads a template to scans; made by `model_lead`.

    `corners` (N, 3) are vertices of the model, `weights` (N, 3) the place of each of the template's vertices among
    them, and `off` (N,), metres, how far outside of the skin it lies there.
    """

    name: str                        # of the model, or its file
    corners: np.ndarray
    weights: np.ndarray
    off: np.ndarray
    parts: PersonParts | None = None
    config: ScanFitConfig = field(default_factory=ScanFitConfig)

    def carry(self, body: Mesh) -> np.ndarray:
        """Where the template's vertices (N, 3), metres, are on a body."""
        ahead = np.einsum("nk,nkd->nd", self.weights, body.vertex_normals[self.corners])
        ahead /= np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-12)
        return np.einsum("nk,nkd->nd", self.weights, body.vertices[self.corners]) + self.off[:, None] * ahead

    @one_thread()
    def __call__(self, scan: Mesh | np.ndarray, landmarks: Landmarks | None = None) -> list[Led]:
        """The body on a scan, and another one that explains it nearly as well, where there is one."""
        vertices, points = (np.zeros(0, dtype=np.int64), np.zeros((0, 3))) if landmarks is None else (
            self.corners[landmarks[0], self.weights[landmarks[0]].argmax(axis=1)], landmarks[1])
        body = as_body(_loaded(self.name))
        fit = scan_fit(body, prepare_scan(scan), vertices, points, self.config)
        few = fit.few()
        starts = first_starts(fit, few)
        if len(vertices) >= 3:               # few landmarks leave much open: also bodies that begin without
            starts = np.concatenate([starts, from_nothing(few)])
        best, rival = with_limbs(fit, few, best_starts(few, starts))
        return [self._led(fit, solve_jointly(fit, few, x, lambda done: None).x) for x in (best, rival)
                if x is not None]

    def _led(self, fit: ScanFit, x: np.ndarray) -> Led:
        """What the body of unknowns (P,) says of the template."""
        explained = 1 - float(fit.unexplained(x, fit.thin).mean())
        strange = fit.body.joints_from_known(fit.body.split(x)[0])
        doubts = [f"the {joint_in_words(fit.body.skeleton.names[j])} is {np.degrees(strange[j]):.0f} degrees from any "
                  "way that it is known to be held" for j in np.flatnonzero(strange > STRANGE)]
        if 1 - explained > LEFT_OVER:
            doubts.append(f"{100 * (1 - explained):.0f}% of the scan has no body near")
        return Led(self.carry(fit.body.template.with_vertices(fit.body.vertices(x))), explained, tuple(doubts))


def model_lead(template: Mesh, through: str, progress: Callable[[int, int], None] | None = None) -> ModelLead | None:
    """A model that leads a template to scans, see `scanprep.registration.lead.lead_of`.

    Parameters
    ----------
    template : Mesh
        Of what the model is of, in a pose that the model's search finds.
    through : str
        The file of a model, "people", or "auto": the built-in people, or None where the template is no person.
    progress : callable, optional
        Called as progress(done, total).

    Raises
    ------
    ValueError
        A model that does not come to lie on the template. StorageError for a file that is no model.
    """
    name, tell = BUILT_IN if through == "auto" else through, progress or (lambda done, total: None)
    model = _loaded(name)
    body = as_body(model)
    fit = scan_fit(body, prepare_scan(template), np.zeros(0, dtype=np.int64), np.zeros((0, 3)), ScanFitConfig())
    few = fit.few()
    tell(1, 4)
    x = with_limbs(fit, few, best_starts(few, first_starts(fit, few)))[0]
    tell(2, 4)
    found = model.template.with_vertices(body.vertices(solve_jointly(fit, few, x, lambda done: None).x))
    tell(3, 4)
    laid = register(found, template, start=found.vertices)
    tell(4, 4)
    if laid.uncovered > OTHER[0] or share_stretched(found, laid.mesh) > OTHER[1]:
        if through == "auto":
            return None
        raise ValueError(f"--through {through}: the model does not come to lie on the template, "
                         f"{100 * laid.uncovered:.0f}% of which lies off it: a model of something else?")
    place = Surface(laid.mesh).closest(template.vertices)
    corners = laid.mesh.faces[place.faces]
    ahead = np.einsum("nk,nkd->nd", place.bary, laid.mesh.vertex_normals[corners])
    ahead /= np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-12)
    off = np.einsum("nd,nd->n", template.vertices - place.points, ahead)
    return ModelLead(name, corners, place.bary, off, _parts(model, laid.mesh, template))


def _parts(model: BodyModel, laid: Mesh, template: Mesh) -> PersonParts | None:
    """The parts of a template on which a model of people was laid; None for other models."""
    if model.skeleton.names != PARTS:
        return None
    part = model.skeleton.part_of_face[Surface(laid).closest(template.corners.mean(axis=1)).faces]
    joints = model.skeleton.joint_regressor(model.template) @ laid.vertices
    return PersonParts(Skeleton(part, PARENTS, joints, PARTS),
                       model.skeleton.fit_rotations(model.template, laid.vertices))


@lru_cache(maxsize=2)
def _loaded(name: str) -> BodyModel:
    return load_model(name if name == BUILT_IN else Path(name))
