"""Initialisation of a registration by a body model, for a template of any triangles.

1. Once: the model is fitted to the template and laid on it (`fitting/search.py`). Every template vertex is mounted on a
   triangle of the body.
2. The same search finds the model's body on a scan.
3. The body carries the template's vertices to the scan, and the registration starts from there.
"""
from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from scanprep.geometry.carrier import SurfaceCarrier, mount
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Surface
from scanprep.judgement import extent
from scanprep.plausible import WrongScaleError, unit_problem
from scanprep.ranges import Axis, direction_of
from scanprep.registration.lead import Proposal
from scanprep.registration.nonrigid import covers
from scanprep.registration.person import PersonParts, average_person
from scanprep.skeleton.tree import Skeleton
from scanprep.synthetic.anatomy import PARENTS, PARTS
from scanprep.threads import one_thread

from ..body import BodyModel
from ..files import BUILT_IN, load_model
from ..fitting.bodies import as_body
from ..fitting.scale import BADLY, find_size
from ..fitting.scan import prepare_scan
from ..fitting.search import Landmarks, ModelMismatchError, find_bodies, lay_model, nearest_by_name
from ..fitting.settings import ScanFitConfig
from ..learning.config import LearnConfig
from ..learning.scape import learn_scape

# the first model of a set only has to find bodies: these settings take a tenth of the time of `scape learn`
LEARNING = LearnConfig(prunings=(0.01,), ridges=(0.003, 0.03), refinements=1)


@dataclass(frozen=True, eq=False)
class ModelLead:
    """A model that initialises a template on scans; made by `model_lead`.

    Its body carries the vertices of the template. `landmarks` are those nearest to the ones that the model names.
    """

    name: str                        # of the model, or its file
    carrier: SurfaceCarrier
    parts: PersonParts | None = None
    landmarks: Mapping[str, int] = field(default_factory=dict)

    def __call__(self, scan: Mesh | np.ndarray, landmarks: Landmarks | None = None, model: Path | None = None,
                 up: Axis | None = None) -> Iterator[Proposal]:
        """Yield the template's vertices (N, 3) on the bodies of `find_bodies`, each computed on demand."""
        marked = None
        if landmarks is not None:              # landmarks of the template become the nearest vertices of the model
            nearest = self.carrier.bary[landmarks[0]].argmax(axis=1)
            marked = self.carrier.corners[landmarks[0], nearest], landmarks[1]
        body_model = model_at(self.name if model is None else model)
        for body, worn in find_bodies(body_model, scan, marked, None if up is None else direction_of(up)):
            yield Proposal(self.carrier.positions(body.vertices), None if worn is None else worn.points,
                           () if worn is None else worn.places)

    def person_size(self, scan: Mesh | np.ndarray) -> tuple[float, float]:
        """Find the length of a scan's unit and the stature of the person in it, both in metres."""
        with one_thread():
            size = find_size(as_body(model_at(self.name)), prepare_scan(scan), ScanFitConfig())
        if size.lost > BADLY:
            raise WrongScaleError(f"scan: no person was found in it at any scale, {100 * size.lost:.0f}% of it has no "
                                  "body near: expected the scan of a person, or its unit")
        return size.metres, size.metres * size.stature


def model_lead(template: Mesh, through: str, progress: Callable[[int, int], None] | None = None) -> ModelLead | None:
    """Prepare a model that initialises a template on scans, see `scanprep.registration.lead.lead_of`.

    Parameters
    ----------
    template : Mesh
        Of the same kind of body as the model, in a pose that the model's search finds.
    through : str
        The file of a model, "people", or "auto": the built-in people, or None where the template is no person.
    progress : callable, optional
        Called as progress(done, total).

    Raises
    ------
    ValueError
        The model does not fit the template. StorageError for a file that is no model.
    """
    name = BUILT_IN if through == "auto" else through
    model = model_at(name)
    laid = _in_same_triangles(model, template)
    try:
        # the body is found on the template as on any scan, and laid on it
        laid = lay_model(model, template, progress) if laid is None else laid
        parts = _parts(model, laid, template)
    except WrongScaleError as error:
        raise ValueError(f"template: {error}; make it with scape prep template, in its right unit") from error
    except ModelMismatchError as error:
        if through == "auto":
            return None
        raise ValueError(f"--through {through}: {error}") from error
    return ModelLead(name, mount(laid, template), parts,
                     nearest_by_name(template, laid, model.info.get("landmarks") or {}))


def person_on(scan: Mesh | np.ndarray) -> tuple[Mesh, dict[str, int]] | None:
    """Find the built-in people's body on a scan, see `scanprep.registration.lead.find_scanned_person`."""
    model = model_at(BUILT_IN)
    points = scan.vertices if isinstance(scan, Mesh) else scan
    # the search takes seconds: ask it only where the scan is as large as people are
    if unit_problem(extent(points), extent(model.template.vertices), "the scan is"):
        return None
    for body, _ in find_bodies(model, scan, only_if_near=True):        # an animal took half a minute
        size = float(np.sqrt(body.face_areas.sum()))
        # the scan lies on the body, but for clothes and hair, and shows most of it
        shown = cKDTree(points).query(body.vertices)[0] < 0.03 * size
        if covers(body, scan, size) and body.share_of_area(shown) > 0.7:
            return body, dict(model.info["landmarks"])
    return None


def _in_same_triangles(model: BodyModel, template: Mesh) -> Mesh | None:
    """Find the model's body on a template with the model's triangles or the synthetic people's; None for others."""
    if np.array_equal(template.faces, model.template.faces):
        return template
    people_vertices = model.info.get("people_vertices")
    if people_vertices is None or not np.array_equal(template.faces, average_person().mesh.faces):
        return None
    return model.template.with_vertices(template.vertices[np.array(people_vertices)])


def learn_set_model(template: Mesh, skeleton: Skeleton, poses: np.ndarray, shapes: np.ndarray | None, path: Path
                    ) -> None:
    """Learn a model of registered meshes and write its file, see `scanprep.registration.lead.learn_model`."""
    learn_scape(template, poses, shapes, skeleton, LEARNING).save(path)


def _parts(model: BodyModel, laid: Mesh, template: Mesh) -> PersonParts | None:
    """Find the parts of a template on which a model of people was laid; None for other models."""
    if model.skeleton.names != PARTS:
        return None
    part = model.skeleton.part_of_face[Surface(laid).closest(template.corners.mean(axis=1)).faces]
    if len(np.unique(part)) < len(PARTS):
        raise ModelMismatchError("the model does not come to lie on the template: not every part lies on it")
    joints = model.skeleton.joint_regressor(model.template) @ laid.vertices
    return PersonParts(Skeleton(part, PARENTS, joints, PARTS),
                       model.skeleton.fit_rotations(model.template, laid.vertices))


def model_at(name: str | Path) -> BodyModel:
    """Load a model by name or file; it is kept for the next scan as long as the file does not change."""
    path = Path(name)
    return _read(str(name), path.stat().st_mtime_ns if path.is_file() else 0)


@lru_cache(maxsize=2)
def _read(name: str, _changed: int) -> BodyModel:
    return load_model(name)
