"""The shapes of other people, seen through a skinning model of one person's poses."""
from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from scanprep.batch.steps import Step, once

from ..digests import body_digest
from ..fitting import FitConfig, PoseFitter, ShapeFitter
from ..shape_space import learn_shape_space
from ..skinning import SkinningModel
from .pose import Ticks

SOFTEST = 0.2                        # a mean of rotations that shrinks further is not undone


def learn_people(model: SkinningModel, shapes: np.ndarray, components: int, rounds: int, tick: Ticks,
                 step: Step = once) -> SkinningModel:
    """The model with the shape components of people whose poses are fitted and undone in turn."""
    for turn in range(rounds):
        quick = FitConfig(polish=0, n_betas=min(20, model.n_betas) or None)
        people = np.empty(shapes.shape)
        fitter = ShapeFitter(model, quick) if turn else PoseFitter(model.subject(), quick)
        for i, body in enumerate(shapes):
            people[i] = step(f"round {turn}, person {body_digest(body)}", (model, quick, turn, body),
                             partial(_fitted, model, fitter, body))
            tick(1)
        space = learn_shape_space(people, components)
        model = replace(model, shape_mean=space.mean.astype(np.float64), shape_components=space.components,
                        shape_variances=space.variances, shape_total=space.total_variance)
    return model


def _fitted(model: SkinningModel, fitter: ShapeFitter | PoseFitter, body: np.ndarray) -> np.ndarray:
    """(N, 3) rest vertices of a person whose pose is fitted."""
    return unposed_person(model, fitter.fit(body).pose, body)


def unposed_person(model: SkinningModel, pose: np.ndarray, body: np.ndarray) -> np.ndarray:
    """(N, 3) rest vertices that the model carries onto a body exactly, joints of their own included."""
    back, A, J = unblended(model.blended(pose)), model.joint_regressor, len(pose)
    # x = B⁻¹ (y - Σ_j below_j turn_j j_j) - c with the joints j = A x: first solved for the joints alone
    bare = np.einsum("nij,nj->ni", back, body) - model.corrections(pose)
    pull = np.einsum("nj,nik,jkl->nijl", model.below, back, model.joint_turns(pose)).reshape(len(body), -1)
    coupling = (A @ pull).reshape(3 * J, 3 * J)
    joints = np.linalg.solve(np.eye(3 * J) + coupling, (A @ bare).ravel())
    x = bare - (pull.reshape(-1, 3 * J) @ joints).reshape(-1, 3)
    return np.asarray(x + model.skeleton.joints[0] - (A @ x)[0])


def unblended(B: np.ndarray) -> np.ndarray:
    """Inverses (N, 3, 3) of means of rotations, gently where they have collapsed."""
    flat = np.linalg.det(B) < SOFTEST
    if flat.any():
        U, s, Vt = np.linalg.svd(B[flat])
        B = B.copy()
        B[flat] = (U * np.maximum(s, SOFTEST)[:, None]) @ Vt
    return np.linalg.inv(B)
