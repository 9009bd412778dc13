"""What a known model says of a template's person, of whom there are few scans.

1. The model's mesh is laid on the template. Laid, it is a body of the model, with all detail of the template's person.
2. That body is moved to the model's example poses; the template's vertices ride on its triangles. These are bodies of
   the template's person in poses that nobody scanned.
3. In the template's own pose the mean person of the model, and one standard deviation along each of its betas, carry
   the template's vertices in the same way. These are other people in the template's triangles.

`learn_scape` learns from both as if they had been scanned, and leans on them as far as the scans leave it open.
"""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from scanprep.geometry.mesh import Mesh
from scanprep.skeleton.tree import Skeleton

from ..body import BodyModel
from ..fitting.search import lay_model
from ..posing.transfer import own_body
from ..priors import sample_poses
from ..resolution.transfer import SurfaceCarrier, transfer_skeleton

# Example poses of the model that are used, evenly over all. With 50 the skeleton of 8 poses had parts that nobody can
# name; held-out poses were 8.5 mm off with 50, and 9.1 mm with 25.
EXAMPLES = 25


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


def bring_prior(model: BodyModel, template: Mesh, progress: Callable[[int, int], None] | None = None) -> TemplatePrior:
    """Bring a known model to a template of any triangles, as the prior of `learn_scape`.

    Parameters
    ----------
    model : BodyModel
    template : Mesh
        Of what the model is of, in a pose that the model's search finds.
    progress : callable, optional
        Called as progress(done, total).

    Returns
    -------
    TemplatePrior

    Raises
    ------
    ModelMismatchError
        A model that does not come to lie on the template.

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
    ride = SurfaceCarrier(laid.with_vertices(own.vertices), template)
    # the person as the model moves it, in poses that it was learned from, of which some models keep none
    known = model.pose_examples if len(model.pose_examples) else sample_poses(model, EXAMPLES, np.random.default_rng(0))
    examples = known[np.unique(np.linspace(0, len(known) - 1, EXAMPLES).astype(int))]
    moved = np.stack([ride.positions(own.subject.vertices(pose)) for pose in examples])
    # other people in the template's pose
    steps = np.vstack([np.zeros(model.n_betas), np.eye(model.n_betas)])
    people = np.stack([ride.positions(model.vertices(own.pose, betas, own.trans)) for betas in steps])
    return TemplatePrior(str(model.info.get("name", model.kind)), _skeleton_on(model, laid, template),
                         np.concatenate([template.vertices[None], moved]), people)


def _skeleton_on(model: BodyModel, laid: Mesh, template: Mesh) -> Skeleton:
    """The model's skeleton on a template on which its mesh was laid."""
    on_laid = replace(model.skeleton, joints=model.joint_regressor @ laid.vertices)
    skeleton = transfer_skeleton(on_laid, laid, template)
    joints = skeleton.joints.copy()
    joints[0] = template.vertices[skeleton.part_of_vertex(template) == 0].mean(axis=0)
    return replace(skeleton, joints=joints)
