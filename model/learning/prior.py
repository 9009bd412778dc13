"""A known model as the prior of a new one, for a template's person with few scans.

1. The model's mesh is laid on the template. It is then a body of the model with all detail of the template's person.
2. That body is posed in the model's example poses and carries the template's vertices. So there are bodies of the
   template's person in poses that nobody scanned.
3. In the template's own pose, the model's mean person, and one standard deviation along each of its betas, carry the
   template's vertices too. So there are other people in the template's triangles.

`learn_scape` uses both as a prior, where the scans determine too little.
"""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from scanprep.geometry.carrier import mount
from scanprep.geometry.mesh import Mesh, take_any_mesh
from scanprep.skeleton.tree import Skeleton

from ..body import BodyModel
from ..fitting.search import lay_model
from ..posing.transfer import own_body
from ..priors import sample_poses
from ..resolution.transfer import transfer_skeleton


@dataclass(frozen=True, eq=False)
class TemplatePrior:
    """A known model in the triangles of a template.

    Attributes
    ----------
    name : str
        Of the model.
    skeleton : Skeleton
        Of the model, on the template.
    poses : (M, N, 3) float, metres
        The template's person as the model moves it; the first is the template itself.
    people : (1 + K, N, 3) float, metres
        In the template's pose the model's mean person, then one standard deviation along each beta.
    """

    name: str
    skeleton: Skeleton
    poses: np.ndarray
    people: np.ndarray


@take_any_mesh
def bring_prior(model: BodyModel, template: Mesh, progress: Callable[[int, int], None] | None = None) -> TemplatePrior:
    """Bring a known model to a template of any triangles, as the prior of `learn_scape`.

    Parameters
    ----------
    model : BodyModel
        The known model.
    template : Mesh
        Of the same kind of body as the model, in a pose that the model's search finds.
    progress : callable, optional
        Called as progress(done, total).

    Returns
    -------
    TemplatePrior

    Raises
    ------
    ModelMismatchError
        The model does not fit the template.

    Examples
    --------
    >>> from model import load_model
    >>> people = load_model("people")
    >>> prior = bring_prior(people, people.template)
    >>> prior.poses.shape[1:] == people.template.vertices.shape
    True
    """
    laid = lay_model(model, template, progress)
    own = own_body(model, laid.vertices)
    ride = mount(laid.with_vertices(own.vertices), template)
    # the person in the model's example poses; models without examples draw from their prior
    # Number of the model's example poses that are used, evenly over all. With 50, the skeleton of 8 poses had parts
    # without a name, though held-out poses were 8.5 mm off, and 9.1 mm with 25.
    n_examples = 25
    known = model.pose_examples if len(model.pose_examples) else sample_poses(model, n_examples,
                                                                              np.random.default_rng(0))
    examples = known[np.unique(np.linspace(0, len(known) - 1, n_examples).astype(int))]
    moved = np.stack([ride.positions(own.subject.vertices(pose)) for pose in examples])
    # other people in the template's pose
    steps = np.vstack([np.zeros(model.n_betas), np.eye(model.n_betas)])
    people = np.stack([ride.positions(model.vertices(own.pose, betas, own.trans)) for betas in steps])
    return TemplatePrior(str(model.info.get("name", model.kind)), _skeleton_on(model, laid, template),
                         np.concatenate([template.vertices[None], moved]), people)


def _skeleton_on(model: BodyModel, laid: Mesh, template: Mesh) -> Skeleton:
    """Transfer the model's skeleton to a template on which its mesh was laid."""
    on_laid = replace(model.skeleton, joints=model.joint_regressor @ laid.vertices)
    skeleton = transfer_skeleton(on_laid, laid, template)
    joints = skeleton.joints.copy()
    joints[0] = template.vertices[skeleton.part_of_vertex(template) == 0].mean(axis=0)
    return replace(skeleton, joints=joints)
