"""Registration through a model: a body is found on a scan, and a template of any triangles goes along.

1. The model's body is fitted to the template, and laid on it: every vertex of the template gets a place in a triangle
   of the body, and a distance from its skin. That is done once.
2. On a scan the body is found by the search of `complete`: typical poses turned every way, limbs tried elsewhere.
3. The template's vertices go where their places on the body are, and the template is registered from there on.
"""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Surface
from scanprep.registration.nonrigid import register, share_stretched
from scanprep.registration.person import PersonParts
from scanprep.skeleton.tree import Skeleton
from scanprep.synthetic.anatomy import PARENTS, PARTS
from scanprep.threads import one_thread

from ..body import BodyModel
from ..files import BUILT_IN, load_model
from ..fitting.bodies import as_body
from ..fitting.limbs import with_limbs
from ..fitting.rounds import solve_jointly
from ..fitting.scan import prepare_scan
from ..fitting.scan_fit import scan_fit
from ..fitting.settings import ScanFitConfig
from ..fitting.starts import best_starts, first_starts, from_nothing

Landmarks = tuple[np.ndarray, np.ndarray]
# of a template: share off the body that was laid on it, and of the body that is stretched, from which on it is another
# thing than the model; a woman has 0.004 and 0.0002, a crab 0.005 and 0.088
OTHER = 0.02, 0.05
NO_LANDMARKS = np.zeros(0, dtype=np.int64), np.zeros((0, 3))


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

    def carry(self, body: Mesh) -> np.ndarray:
        """Where the template's vertices (N, 3), metres, are on a body."""
        ahead = normals_at(body, self.corners, self.weights)
        return np.einsum("nk,nkd->nd", self.weights, body.vertices[self.corners]) + self.off[:, None] * ahead

    def __call__(self, scan: Mesh | np.ndarray, landmarks: Landmarks | None = None, model: Path | None = None
                 ) -> list[np.ndarray]:
        """The template's vertices (N, 3) on the body found, and on another that explains the scan nearly as well."""
        mine = None
        if landmarks is not None:              # of the model, the vertex that is nearest to each
            mine = self.corners[landmarks[0], self.weights[landmarks[0]].argmax(axis=1)], landmarks[1]
        return [self.carry(body) for body in find_bodies(model_at(self.name if model is None else model), scan, mine)]


@one_thread()
def find_bodies(model: BodyModel, scan: Mesh | np.ndarray, landmarks: Landmarks | None = None) -> list[Mesh]:
    """The body of a model on a scan, and another one that explains it nearly as well, where there is one.

    Landmarks, few or none, are vertices (L,) of the model and points (L, 3), metres.
    """
    body, (vertices, points) = as_body(model), landmarks or NO_LANDMARKS
    fit = scan_fit(body, prepare_scan(scan), vertices, points, ScanFitConfig())
    few = fit.few()
    starts = first_starts(fit, few)
    if len(vertices) >= 3:                     # few landmarks leave much open: also bodies that begin without
        starts = np.concatenate([starts, from_nothing(few)])
    found = [x for x in with_limbs(fit, few, best_starts(few, starts)) if x is not None]
    solved = [solve_jointly(fit, few, x, lambda done: None).x for x in found]
    return [model.template.with_vertices(body.vertices(x)) for x in solved]


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
    model = model_at(name)
    # the body is found on the template as on any scan, and laid on it
    found = find_bodies(model, template)[0]
    tell(1, 2)
    laid = register(found, template, start=found.vertices)
    tell(2, 2)
    if laid.uncovered > OTHER[0] or share_stretched(found, laid.mesh) > OTHER[1]:
        if through == "auto":
            return None
        raise ValueError(f"--through {through}: the model does not come to lie on the template, "
                         f"{100 * laid.uncovered:.0f}% of which lies off it: a model of something else?")
    # every vertex of the template gets a place on the body, and a distance from its skin
    place = Surface(laid.mesh).closest(template.vertices)
    corners = laid.mesh.faces[place.faces]
    off = np.einsum("nd,nd->n", template.vertices - place.points, normals_at(laid.mesh, corners, place.bary))
    return ModelLead(name, corners, place.bary, off, _parts(model, laid.mesh, template))


def normals_at(body: Mesh, corners: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Unit normals (n, 3) of a body at places among its vertices, `corners` (n, 3) with `weights` (n, 3)."""
    ahead = np.einsum("nk,nkd->nd", weights, body.vertex_normals[corners])
    return ahead / np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-12)


def _parts(model: BodyModel, laid: Mesh, template: Mesh) -> PersonParts | None:
    """The parts of a template on which a model of people was laid; None for other models."""
    if model.skeleton.names != PARTS:
        return None
    part = model.skeleton.part_of_face[Surface(laid).closest(template.corners.mean(axis=1)).faces]
    joints = model.skeleton.joint_regressor(model.template) @ laid.vertices
    return PersonParts(Skeleton(part, PARENTS, joints, PARTS),
                       model.skeleton.fit_rotations(model.template, laid.vertices))


def model_at(name: str | Path) -> BodyModel:
    """The model of a name or a file, kept for the next scan as long as the file is the same."""
    path = Path(name)
    return _read(str(name), path.stat().st_mtime_ns if path.is_file() else 0)


@lru_cache(maxsize=2)
def _read(name: str, _changed: int) -> BodyModel:
    return load_model(name)
