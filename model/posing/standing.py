"""Registered bodies of any triangles brought into the pose of a model's template.

1. Once, the model is laid on the template of the bodies (`fitting/search.py`). Its vertices then ride on the template.
2. On a registered body they are a body of the model, with all detail. It is fitted and posed (`transfer.py`).
3. The body's own vertices ride back on it.
"""
from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from scanprep.geometry.carrier import SurfaceCarrier, mount
from scanprep.geometry.mesh import Mesh

from ..body import BodyModel
from ..fitting.search import lay_model, nearest_by_name
from .transfer import own_body


@dataclass(frozen=True, eq=False)
class StandingBody:
    """A body in the pose of the model's template: vertices (N, 3), metres, and the pose (J, 3) it was registered in."""

    vertices: np.ndarray
    pose: np.ndarray


@dataclass(frozen=True, eq=False)
class StandingModel:
    """A model that brings registered bodies into the pose of its template; made by `lay_on`.

    `laid` is the model's mesh on the template of the bodies; None where their triangles are those of the model.
    """

    model: BodyModel
    template: Mesh
    laid: Mesh | None = None

    @classmethod
    def lay_on(cls, model: BodyModel, template: Mesh, progress: Callable[[int, int], None] | None = None
               ) -> StandingModel:
        """Lay a model on a template of any triangles.

        Parameters
        ----------
        model : BodyModel
            A model of the same kind of body.
        template : Mesh
            The template of the bodies, in a pose that the model's search finds.
        progress : callable, optional
            Called as progress(done, total).

        Raises
        ------
        ModelMismatchError
            The model does not come to lie on the template.
        """
        if np.array_equal(template.faces, model.template.faces):
            return cls(model, template)
        return cls(model, template, lay_model(model, template, progress))

    @cached_property
    def parts(self) -> np.ndarray:
        """(N,) the model's part of every vertex of the template."""
        own = self.model.skeleton.part_of_vertex(self.model.template)
        return own if self.laid is None else own[cKDTree(self.laid.vertices).query(self.template.vertices)[1]]

    def landmarks(self, names: Mapping[str, int]) -> dict[str, int]:
        """Find vertices of the model, by name, on the template: the nearest vertex of each."""
        return nearest_by_name(self.template, self.laid or self.template, names)

    def stand(self, vertices: np.ndarray) -> StandingBody:
        """Bring a registered body (N, 3), metres, into the pose of the model's template, with all its detail."""
        rest = np.zeros((len(self.model.skeleton.parents), 3))
        if self.laid is None:
            own = own_body(self.model, vertices)
            return StandingBody(own.subject.vertices(rest), own.pose)
        ridden, riding = self._carriers
        own = own_body(self.model, ridden.positions(vertices))
        return StandingBody(riding.carry(vertices, own.vertices, own.subject.vertices(rest)), own.pose)

    @cached_property
    def _carriers(self) -> tuple[SurfaceCarrier, SurfaceCarrier]:
        """The model's vertices on the template, and those of the template on the model."""
        assert self.laid is not None, "the triangles differ"
        return mount(self.template, self.laid), mount(self.laid, self.template)
