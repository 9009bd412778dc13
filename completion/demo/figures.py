"""The figures of the demonstration against the ground truth."""
from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from model.learning.scape import judge_model
from scanprep.console import Metric
from scanprep.judgement import Judgement, judge_many
from scanprep.pipeline.page import judge_set

from ..mocap.pose.robust import motion_doubts
from .chain import Demo
from .truth import adjusted_rand, joint_errors, mean_over_area, surface_error

MM = 1000.0


def figures(demo: Demo) -> list[Metric]:
    """Run what has not been run, and measure it against the ground truth."""
    return [*_registration(demo), *_skeleton(demo), *_poses(demo), *_completion(demo), *_animation(demo)]


def judge_demo(demo: Demo) -> Judgement:
    """What the results of the chain are worth, by what each says of itself; the truth is in the figures."""
    set_of_scans = judge_many({one.name: one.judgement for one in judge_set(demo.folder / "set")})
    motion = Judgement.of(check=motion_doubts([demo.motion], [demo.walk[0]], demo.template))
    return judge_many({"registration": set_of_scans, "model": judge_model(demo.model),
                       "completion": demo.completion.judgement, "animation": motion})


def _registration(demo: Demo) -> list[Metric]:
    registered, template = demo.prepared.registered, demo.template
    surface, apart = [], []
    for name, vertices in zip(registered.names, registered.vertices(), strict=True):
        mesh, truth = template.with_vertices(vertices), demo.truths[name]
        surface.append(mean_over_area(surface_error(mesh, truth), template))
        apart.append(mean_over_area(distance(vertices, demo.truth_map.vertices(truth)), template))
    worst = int(np.argmax(surface))
    return [Metric("registration: scans", len(surface)),
            Metric("registration: distance to the true surface, mean", MM * float(np.mean(surface)), "mm"),
            Metric(f"registration: worst scan ({registered.names[worst]})", MM * surface[worst], "mm"),
            Metric("registration: distance of corresponding points, mean", MM * float(np.mean(apart)), "mm")]


def _skeleton(demo: Demo) -> list[Metric]:
    skeleton = demo.prepared.registered.skeleton
    assert skeleton is not None, "the subject has enough poses for a skeleton"
    agreement = adjusted_rand(skeleton.part_of_face, demo.truth_map.part_of_face, demo.template.face_areas)
    return [Metric("skeleton: parts (true: 16)", len(skeleton.parents)),
            Metric("skeleton: adjusted Rand index against the true parts", agreement),
            Metric("skeleton: joints to the nearest true one, mean",
                   MM * float(joint_errors(skeleton, demo.rest).mean()), "mm")]


def _poses(demo: Demo) -> list[Metric]:
    wanted = [demo.truth_map.vertices(truth) for truth in demo.held_out]
    error = [mean_over_area(distance(demo.fitted(w), w), demo.template) for w in wanted]
    return [Metric(f"model: {len(wanted)} held-out poses, mean vertex error", MM * float(np.mean(error)), "mm")]


def _completion(demo: Demo) -> list[Metric]:
    done, (half, _, truth) = demo.completion, demo.half_scan
    surface, wanted = surface_error(done.completed, truth), demo.truth_map.vertices(truth)
    apart = distance(done.completed.vertices, wanted)
    seen = cKDTree(half.vertices).query(wanted)[0] < 2 * demo.config.resolution
    return [Metric("completion: vertices seen", 100 * float(seen.mean()), "%"),
            Metric("completion: seen, distance to the true surface",
                   MM * mean_over_area(surface, demo.template, seen), "mm"),
            Metric("completion: unseen, distance of corresponding points",
                   MM * mean_over_area(apart, demo.template, ~seen), "mm")]


def _animation(demo: Demo) -> list[Metric]:
    motion, (_, _, bodies) = demo.motion, demo.walk
    followed = motion.vertices(demo.subject)
    faces = demo.person.mesh.faces
    apart = [distance(f, demo.truth_map.places.transferred(b, faces)) for f, b in zip(followed, bodies, strict=True)]
    return [Metric("animation: frames", len(followed)),
            Metric("animation: distance of markers, mean", MM * float(np.nanmean(motion.residuals)), "mm"),
            Metric("animation: distance of corresponding points, mean",
                   MM * mean_over_area(np.mean(apart, axis=0), demo.template), "mm")]


def distance(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(N,) distances of corresponding points (N, 3)."""
    return np.linalg.norm(a - b, axis=1)
