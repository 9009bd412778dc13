"""Learning from a random mix of people and poses, without one person scanned in many poses.

A body is explained by `R S Q v̂`: with the people's S known, their scans tell Q; with Q known, they tell S. The two are
found in turns [SCAPE-patent], and so are the part rotations R, which Procrustes cannot tell from the shape.
"""
from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from scanprep.batch.steps import Step, inside, once
from scanprep.geometry.mesh import Mesh, check_template
from scanprep.skeleton.tree import Skeleton
from scanprep.threads import one_thread

from ..carriers import rigid_weights
from ..digests import body_digests, digest
from ..fitting import FitConfig, ShapeFitter
from ..scape import ScapeModel
from ..shape_space import ShapeSpace, learn_shape_space
from .carriage import Carriage
from .mix_rounds import Mix, MixConfig, State, kept_round, start
from .pose import Progress, Ticks
from .scape import check_skeleton, checked_bodies, pose_examples, pose_prior, timed
from .within import held_out_bodies, number_people


@one_thread()
def learn_scape_mix(template: Mesh, bodies: np.ndarray, subjects: Sequence[Hashable], skeleton: Skeleton,
                    config: MixConfig | None = None, progress: Progress | None = None, step: Step = once
                    ) -> ScapeModel:
    """Learn a body model from any people in any poses.

    In every round the part rotations are fitted to the model, the pose model is regressed with the people's shapes
    held, and the shapes are solved for with the pose model held. Shapes are held down to a few components at first,
    and what the bodies of one person have in common is never left to the pose model. The number of rounds is the one
    with which bodies that were held out are met best; then everything trains.

    Q and S are determined up to a factor per triangle only, `S Q = (S A)(A⁻¹ Q)`. It is fixed by Q = I at zero
    twist, so that S carries all that the pose does not change, and the template's own body, which need not be among
    the bodies, has S = I. That Q is found from `S⁻¹ Rᵀ v` weighs its residuals by the inverse shape, which keeps one
    factorisation for all bodies.

    Parameters
    ----------
    template : Mesh
    bodies : (M, N, 3) float, metres
    subjects : M labels
        Whose body each is.
    skeleton : Skeleton
        On the template.
    config : MixConfig, optional
    progress : callable, optional
        Called with the work done and the whole.
    step : callable, optional
        Keeps every round, as `scanprep.batch.steps.Step`.

    Raises
    ------
    ValueError
        Bodies of another shape or not finite, labels of another count, fewer than two people or four bodies, a
        skeleton of another template.

    [SCAPE] Eq. 4, Eq. 5, Eq. 7, Eq. 8
    """
    config = config or MixConfig()
    check_template(template)
    check_skeleton(template, skeleton)
    bodies = checked_bodies(template, bodies, "bodies")
    who = number_people(subjects, len(bodies))
    mix = Mix(Carriage(template, skeleton, rigid_weights(skeleton)), bodies, who, config)
    tick = Ticks(progress, 2 * config.rounds * len(bodies))
    inputs = mix.carriage, bodies, who, config

    def count() -> list[float]:
        with timed("how many rounds"):
            return held_out_errors(mix, tick, inside(step, "how many rounds"))

    errors = tick.over(config.rounds * len(bodies), lambda: step("how many rounds", inputs, count))
    rounds = 1 + int(np.argmin(errors))

    def learn() -> tuple[State, ShapeSpace]:
        with timed("poses and shapes in turns"):
            state = start(mix)
            for number in range(rounds):
                state = kept_round(mix, state, number, tick, inside(step, "poses and shapes in turns"))
            return replace(state, S=np.zeros((0, 3, 3))), learn_shape_space(state.S, config.components)

    state, shapes = tick.over(config.rounds * len(bodies), lambda: step("poses and shapes in turns", inputs, learn))
    assert state.design is not None
    info: dict[str, Any] = {
        "settings": asdict(config), "bodies": len(bodies), "people": mix.people, "rounds": rounds,
        "held_out_errors": errors, "pruning": state.design.pruning, "ridge": state.design.ridge,
        "features": state.space.features.count, "digest": digest(template, bodies, None),
        "digests": body_digests(bodies)}
    return make_model(mix, state, shapes, info)


def make_model(mix: Mix, state: State, shapes: ShapeSpace, info: dict[str, Any]) -> ScapeModel:
    """The model that a round has reached."""
    template, skeleton = mix.carriage.template, mix.carriage.skeleton
    examples = pose_examples(template, skeleton, state.poses)
    return ScapeModel(template, skeleton, state.space, shapes, *pose_prior(examples, len(examples)), info,
                      pose_examples=examples)


def held_out_errors(mix: Mix, tick: Ticks, step: Step = once) -> list[float]:
    """Mean error, metres, of bodies that are held out, after each round until it stops falling."""
    held = held_out_bodies(mix.who, mix.config.held_out)
    train = mix.some(np.setdiff1d(np.arange(len(mix.bodies)), held))
    state, errors = start(train), list[float]()

    def error() -> float:
        model = make_model(train, state, learn_shape_space(state.S, mix.config.components), {})
        fitter = ShapeFitter(model, FitConfig(sample=400, polish=0))
        return float(np.mean([fitter.fit(y).mean for y in mix.bodies[held]]))

    for number in range(mix.config.rounds):
        state = kept_round(train, state, number, tick, step)
        errors.append(step(f"error of round {number}", (mix.carriage, mix.bodies, mix.who, mix.config, number), error))
        tick(len(held))
        if number and errors[-1] > (1 - mix.config.tolerance) * min(errors[:-1]):
            break
    return errors
