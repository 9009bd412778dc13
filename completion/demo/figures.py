"""Figures of the demonstration against the ground truth."""
from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from model.learning.scape import judge_model
from scanprep.cli import MM
from scanprep.console import Metric
from scanprep.dataset import RegisteredSet
from scanprep.judgement import Judgement, judge_many
from scanprep.pipeline.page import judge_set, judge_whole

from ..mocap.pose.judgement import motion_doubts
from .chain import Demo
from .truth import distance, mean_over_area, surface_error

NAMED = ("head", "hand_left", "hand_right", "foot_left", "foot_right")     # parts that exports of motions need


def measure_demo(demo: Demo) -> list[Metric]:
    """Run the stages that have not been run, and measure them; errors on unseen data come first."""
    template = demo.template
    # held-out poses, which the model never saw
    wanted = [demo.true_places(truth) for truth in demo.held_out]
    error = [mean_over_area(distance(demo.fit_pose(w), w), template) for w in wanted]
    rows = [Metric(f"model: {len(wanted)} poses it never saw, mean error", MM * float(np.mean(error)), "mm")]
    # the completed half view, separately for surface that was seen and that was hidden
    done, (half, _, truth) = demo.completion, demo.half_scan
    surface, true = surface_error(done.completed, truth), demo.true_places(truth)
    apart = distance(done.completed.vertices, true)
    seen = cKDTree(half.vertices).query(true)[0] < 2 * demo.amounts.resolution
    rows += [Metric("completion, hidden: mean error", MM * mean_over_area(apart, template, ~seen), "mm"),
             Metric("completion, seen: mean distance to the true surface",
                    MM * mean_over_area(surface, template, seen), "mm")]
    # the walk, followed by its markers
    motion, faces = demo.motion, demo.person.mesh.faces
    walked = [distance(body, demo.places.transfer(true_body, faces))
              for body, true_body in zip(motion.vertices(demo.subject), demo.walking, strict=True)]
    rows += [Metric("animation: mean error", MM * mean_over_area(np.mean(walked, axis=0), template), "mm"),
             Metric("animation: markers to their place on the body, mean", MM * float(np.nanmean(motion.residuals)),
                    "mm")]
    # registered scans, and the skeleton found from them
    means = {name: mean_over_area(off, template) for name, (off, _) in demo.off.items()}
    slid = [mean_over_area(off, template) for _, off in demo.off.values()]
    worst = max(means, key=means.__getitem__)
    return [*rows, Metric(f"registration: {len(means)} scans, mean distance to the true surface",
                          MM * float(np.mean(list(means.values()))), "mm"),
            Metric(f"registration: the same, worst scan ({worst})", MM * means[worst], "mm"),
            Metric("points registered beside their true place, mean", MM * float(np.mean(slid)), "mm"),
            Metric("skeleton: parts found (the people have 16)", len(demo.model.skeleton.parents))]


def judge_demo(demo: Demo) -> Judgement:
    """Judge the demonstration: each result's own judgement, and names of parts."""
    folder = demo.folder / "set"
    set_of_scans = judge_whole(judge_set(folder), RegisteredSet.load(folder))
    motion = Judgement.of(check=motion_doubts([demo.motion], [demo.walk], demo.template))
    of_results = judge_many({"registration": set_of_scans, "model": judge_model(demo.model),
                             "completion": demo.completion.judgement, "animation": motion})
    lacking = [name for name in NAMED if name not in demo.model.skeleton.names]
    return of_results.merge(Judgement.of(check=[f"no part is called {', '.join(lacking)}"] if lacking else []))
