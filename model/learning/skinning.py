"""Learning a skinning model from registered meshes."""
from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from functools import partial
from operator import itemgetter

import numpy as np

from scanprep.batch.room import Step, run_uncached
from scanprep.geometry.mesh import Mesh, take_any_mesh
from scanprep.geometry.upright import find_up
from scanprep.ranges import Count, Settings
from scanprep.skeleton.tree import Skeleton
from scanprep.threads import one_thread

from ..blend_weights import CARRIERS, diffuse, diffuse_weights, fit_weights, strongest
from ..digests import body_digest
from ..features import LinearLift, PoseFeatures, part_features
from ..fitting.vertices import FitConfig, PoseFitter, ShapeFitter
from ..pose_space import principal_directions
from ..shape_space import body_volumes, learn_shape_space
from ..skinning import SkinningModel, invert_blended
from .regression import ridge_operator
from .scape import (
    POSES,
    Progress,
    ProgressShares,
    check_training,
    describe_bodies,
    estimate_pose_prior,
    fit_poses,
    pose_examples,
)

QUICK = FitConfig(sample=400, iterations=20, polish=0, tolerance=1e-4)     # poses are fitted again in the next round
WIDTH = 0.05                         # metres over which the initial blend weights change: about the width of a joint


@dataclass(frozen=True)
class SkinConfig(Settings):
    """Settings of `learn_skinning`.

    Attributes
    ----------
    correctives : bool
        Learn pose-corrective shapes, linear in the joint twists; else plain linear blend skinning.
    rounds : int
        Largest number of rounds in which poses, weights and joints are fitted in turn, first without and then with
        correctives.
    components : int
        Shape components to keep, fewer where there are fewer people.

    Examples
    --------
    >>> SkinConfig(correctives=False).components
    40

    Loper et al., SMPL, 2015.
    """

    correctives: bool = True
    rounds: Count = 8
    components: int = 40


@take_any_mesh
@one_thread()
def learn_skinning(template: Mesh, poses: np.ndarray, shapes: np.ndarray | None, skeleton: Skeleton,
                   config: SkinConfig | None = None, progress: Progress | None = None, step: Step = run_uncached
                   ) -> SkinningModel:
    """Learn a skinning model from one person in many poses and many people in about one pose.

    Parameters
    ----------
    template : Mesh
        The rest pose.
    poses : (M, N, 3) float, metres
        One person in many poses.
    shapes : (S, N, 3) float, metres, or None
        Many people in about one pose.
    skeleton : Skeleton
        Joints are fitted near those of the skeleton.
    config : SkinConfig, optional
        Settings.
    progress : callable, optional
        Called with (done, total).
    step : callable, optional
        Keeps intermediate results, as for `learn_scape`.

    Returns
    -------
    SkinningModel
        Blend weights, joints, pose correctives and shape components.

    Raises
    ------
    ValueError
        As `learn_scape`.

    Examples
    --------
    >>> from model import load_built_in_model
    >>> known = load_built_in_model()
    >>> poses = known.subject(None).vertices(known.pose_examples[:3])
    >>> learn_skinning(known.template, poses, None, known.skeleton, SkinConfig(rounds=1, correctives=False)).kind
    'skinning'

    Loper et al., SMPL, 2015.
    """
    config = config or SkinConfig()
    poses, shapes = check_training(template, skeleton, poses, shapes)
    template = find_up(template, poses)
    kinds, work = (False, True) if config.correctives else (False,), ProgressShares(progress, step)

    def learn(inner: ProgressShares) -> tuple[SkinningModel, np.ndarray]:
        at = skeleton.pose_of(skeleton.fit_rotations(template, poses))
        model = _start(template, skeleton)
        for correctives in kinds:
            model, at = _learn_pose(model, at, poses, replace(config, correctives=correctives), 1 / len(kinds), inner)
        return model, at

    model, at = work.step("pose space", (template, skeleton, poses, replace(config, components=0)), POSES, learn)
    if shapes is None:
        work.tick(1 - POSES)
    else:
        model = work.step("shape components", (model, shapes, config.components), 1 - POSES,
                          partial(_learn_people, model, shapes, config.components))
    examples = pose_examples(template, skeleton, at, shapes)
    mean, covariance = estimate_pose_prior(template, skeleton, examples, len(at))
    info = {"settings": asdict(config), **describe_bodies(template, poses, shapes), **model.info}
    return replace(model, pose_mean=mean, pose_covariance=covariance, pose_examples=examples, info=info)


def _start(template: Mesh, skeleton: Skeleton) -> SkinningModel:
    """Build the initial model: the template with smooth blend weights and without correctives."""
    J, N = len(skeleton.parents), len(template.vertices)
    constants = corrective_features(skeleton, np.zeros((1, J, 3)), False)
    weights = strongest(diffuse_weights(template, skeleton, WIDTH), CARRIERS, 1e-3)
    return SkinningModel(template, skeleton, template.vertices, weights, constants, np.zeros((0, N, 3), np.float32),
                         template.vertices, np.zeros((0, N, 3), np.float32), np.zeros(0), 0.0,
                         np.zeros((J, 3)), np.zeros((3 * J, 3 * J)))


def _learn_pose(model: SkinningModel, poses: np.ndarray, bodies: np.ndarray, config: SkinConfig, share: float,
                work: ProgressShares) -> tuple[SkinningModel, np.ndarray]:
    """Fit poses, weights, joints, rest vertices and correctives in turn, while the left-out error falls."""
    allowed = diffuse_weights(model.template, model.skeleton, 2 * WIDTH) > 0
    model = replace(model, info={"left_out_error": np.inf})
    for k in range(config.rounds):
        tried, fitted = work.step(f"correctives {config.correctives}, round {k}", (model, poses, bodies, config),
                                  share / config.rounds, partial(_next_round, model, poses, bodies, allowed, config))
        gain = 1 - tried.info["left_out_error"] / model.info["left_out_error"]
        if gain > 0:
            model, poses = tried, fitted
        # a round that gains less than 0.5% is the last
        if gain < 0.005:
            break
    return model, poses


def _next_round(model: SkinningModel, poses: np.ndarray, bodies: np.ndarray, allowed: np.ndarray, config: SkinConfig,
                work: ProgressShares) -> tuple[SkinningModel, np.ndarray]:
    """Fit poses, weights, joints, rest vertices and correctives, each to the others, once."""
    fitted = fit_poses(model.subject(), bodies, poses, work, QUICK)
    tried = _with_weights(model, fitted, bodies, allowed)
    tried = _with_joints(tried, fitted, bodies)
    return _with_correctives(tried, fitted, bodies, config), fitted


def _carry_by_each_part(model: SkinningModel, pose: np.ndarray, body: np.ndarray) -> np.ndarray:
    """Compute where each part alone would carry each vertex, (J, N, 3), with the whole placed at the body."""
    R, turns = model.skeleton.part_rotations(pose), model.joint_turns(pose)
    offset = np.einsum("pj,jde,je->pd", model.skeleton.descends.astype(float), turns,
                       model.joint_regressor @ model.rest)
    by_part = (model.rest + model.corrections(pose)) @ np.swapaxes(R, -1, -2) + offset[:, None]
    return np.asarray(by_part + (body - np.einsum("np,pnd->nd", model.weights, by_part)).mean(axis=0))


def _with_weights(model: SkinningModel, poses: np.ndarray, bodies: np.ndarray, allowed: np.ndarray) -> SkinningModel:
    """Fit the blend weights to the bodies at their poses."""
    carried = [_carry_by_each_part(model, p, y) for p, y in zip(poses, bodies, strict=True)]
    weights = fit_weights(carried, bodies, model.template, model.weights, allowed)
    return replace(model, weights=strongest(weights, CARRIERS, 1e-3))


def _with_joints(model: SkinningModel, poses: np.ndarray, bodies: np.ndarray) -> SkinningModel:
    """Fit the joints to the bodies: linear least squares, since the poses are known."""
    J = len(model.skeleton.parents)
    if J == 1:
        return model
    # a joint j moves vertex n by below_nj (R_parent - R_j); the place of each body is free
    below = model.below[:, 1:] - model.below[:, 1:].mean(axis=0)
    overlap, normal, slope = below.T @ below, np.zeros((J - 1, 3, J - 1, 3)), np.zeros((J - 1, 3))
    joints = model.joint_regressor @ model.rest
    for pose, body in zip(poses, bodies, strict=True):
        D = model.joint_turns(pose)[1:]
        left = below.T @ (body - model.vertices(pose))
        normal += np.einsum("ab,aki,bkj->aibj", overlap, D, D)
        slope += np.einsum("aki,ak->ai", D, left)
    flat = normal.reshape(3 * J - 3, -1)
    flat += 1e-3 * np.trace(flat) / len(flat) * np.eye(len(flat))             # directions without evidence stay
    moved = joints.copy()
    moved[1:] += np.linalg.solve(flat, slope.ravel()).reshape(J - 1, 3)
    return _with_joints_at(model, moved)


def _with_joints_at(model: SkinningModel, wanted: np.ndarray) -> SkinningModel:
    """Move the joints, which are combinations of the rest vertices, to wanted positions (J, 3)."""
    for _ in range(3):                          # repeated, as rest vertices differ from the template's by millimetres
        shift = wanted - model.joint_regressor @ model.rest
        shift[0] = 0
        old = model.skeleton
        skeleton = Skeleton(old.part_of_face, old.parents, old.joints + shift, old.names)
        model = replace(model, skeleton=skeleton, features=replace(model.features, skeleton=skeleton))
    return model


def _with_correctives(model: SkinningModel, poses: np.ndarray, bodies: np.ndarray, config: SkinConfig
                      ) -> SkinningModel:
    """Regress rest vertices and correctives on the unposed bodies, with the best penalty."""
    unposed = np.stack([_unpose(model, p, y) for p, y in zip(poses, bodies, strict=True)])
    features = corrective_features(model.skeleton, poses, config.correctives)
    joints = _acting_joints(model)
    penalties = (1e-4, 1e-3, 3e-3, 0.01, 0.03, 0.1, 0.3)  # penalties, of which the best on left-out poses is taken
    ridges = penalties if features.count > len(features.starts) else penalties[:1]
    tried = [(ridge, *_regress(features, poses, unposed, joints, ridge)) for ridge in ridges]
    ridge, rest, correctives, error = min(tried, key=itemgetter(-1))
    moved = _with_joints_at(replace(model, rest=rest), model.joint_regressor @ model.rest)
    return replace(moved, features=replace(features, skeleton=moved.skeleton), correctives=correctives,
                   info={"ridge": ridge, "left_out_error": error})


def _unpose(model: SkinningModel, pose: np.ndarray, body: np.ndarray) -> np.ndarray:
    """Find the rest vertices (N, 3), correctives included, that the model with its joints carries onto a body."""
    y = model.vertices(pose)
    left = body - y
    moved = np.einsum("nij,nj->ni", invert_blended(model.blend_rotations(pose)), left - left.mean(axis=0))
    return model.rest + model.corrections(pose) + moved


def corrective_features(skeleton: Skeleton, poses: np.ndarray, correctives: bool) -> PoseFeatures:
    """Build features: for every joint a constant, and its main twist directions where there are correctives."""
    J = len(skeleton.parents)
    # twist directions with a variance below 0.01 rad² are not observed well enough to learn from
    directions = principal_directions(poses, 0.01) if correctives else [np.zeros((3, 0))] * J
    return part_features(skeleton, LinearLift(), directions, [[j] for j in range(J)])


def _acting_joints(model: SkinningModel) -> np.ndarray:
    """Compute how freely each joint corrects each vertex, (N, J): two near joints, fading over the surface."""
    x, joints = model.template.vertices, model.skeleton.joints
    acting = np.zeros(model.weights.shape)
    for p, of_part in enumerate(model.skeleton.joints_of_part):
        vertices, near = np.flatnonzero(model.weights.argmax(axis=1) == p), np.array(of_part, dtype=np.int64)
        far = np.linalg.norm(x[vertices, None] - joints[near], axis=2)
        # two joints correct a vertex: those of its heaviest part that are nearest to it
        acting[vertices[:, None], near[np.argsort(far, axis=1, kind="stable")[:, :2]]] = 1
    # correctives fade over 5 cm of surface; rounding to eight levels lets vertices share one solve
    return np.round(8 * diffuse(model.template, acting, 0.05)) / 8


def _regress(features: PoseFeatures, poses: np.ndarray, unposed: np.ndarray, acting: np.ndarray, ridge: float
             ) -> tuple[np.ndarray, np.ndarray, float]:
    """Regress rest vertices (N, 3) and correctives (C, N, 3); also return the RMS error of left-out poses, metres."""
    free = np.flatnonzero(features.constant == 0)
    delta, M = features.evaluate(poses)[:, free], len(poses)
    rest, correctives = np.empty(unposed.shape[1:]), np.zeros((len(free), *unposed.shape[1:]), dtype=np.float32)
    kinds, which = np.unique(acting, axis=0, return_inverse=True)
    total = 0.0
    joint = features.part[free]
    for g, freedom in enumerate(kinds):
        used, vertices = np.flatnonzero(freedom[joint] > 0), which.ravel() == g
        target, scale = unposed[:, vertices].reshape(M, -1), freedom[joint[used]]
        centre, middle = delta[:, used].mean(axis=0) * scale, target.mean(axis=0)
        X = delta[:, used] * scale - centre
        # ridge regression, and its leave-one-out residuals in closed form
        solver = ridge_operator(X, M * ridge)
        slope, hat = solver @ target, X @ solver + 1 / M
        left = (target - middle - X @ slope) / np.maximum(1 - np.diag(hat), 1e-6)[:, None]
        total += float((left**2).sum())
        rest[vertices] = (middle - centre @ slope).reshape(-1, 3)
        correctives[np.ix_(used, vertices)] = (scale[:, None] * slope).reshape(len(used), vertices.sum(), 3)
    return rest, correctives, float(np.sqrt(total / (M * len(rest))))


def _learn_people(model: SkinningModel, shapes: np.ndarray, components: int, work: ProgressShares) -> SkinningModel:
    """Learn the shape components of people (P, N, 3), whose poses are fitted and undone in turn."""
    people_rounds = 3  # rounds of fitting the people's poses with the shapes learned so far, and undoing them
    share = 1 / (people_rounds * len(shapes))
    for k in range(people_rounds):
        quick = FitConfig(polish=0, n_betas=min(20, model.n_betas) or None)
        fitter = ShapeFitter(model, quick) if k else PoseFitter(model.subject(), quick)
        people = np.stack([work.step(f"round {k}, person {body_digest(body)}", (model, quick, k, body), share,
                                     partial(_unpose_person, model, fitter, body)) for body in shapes])
        space = learn_shape_space(people, components, body_volumes(model.template, people))
        model = replace(model, shape_mean=space.mean.astype(np.float64), shape_components=space.components,
                        shape_variances=space.variances, shape_total=space.total_variance)
    return model


def _unpose_person(model: SkinningModel, fitter: ShapeFitter | PoseFitter, body: np.ndarray,
                   _: ProgressShares) -> np.ndarray:
    """Fit the pose of a person and compute the rest vertices (N, 3)."""
    return model.unpose(body, fitter.fit(body).pose)
