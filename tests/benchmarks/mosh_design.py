"""Marker sets: greedy choice of 114 candidates against random sets, over men in eight poses.

    SCAPEKIT_DATA=... python tests/benchmarks/mosh_design.py -m MODEL.npz --men inner -o design.json
    SCAPEKIT_DATA=... python tests/benchmarks/mosh_design.py -m MODEL.npz --men held-out --bodies CACHE.npz -o out.json

`inner` men are every fifth of the 182 of SPRING, for a model that was learned without them; `held-out` are the 45.
Every man is posed by the model from his own full shape. Candidates: the 47 markers of vicon47 with 67 more, left and
right the same. Random sets are symmetric too. Nothing is chosen on the men but the sets themselves, and those also on
one half of the men for the other half.
"""
from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
from protocols import load_real, machine, spring_split, write_report

from completion.mocap.marker_selection.candidates import candidate_layout
from completion.mocap.marker_selection.design import Choice, best_path, choose
from completion.mocap.marker_selection.fits import DesignConfig, vertex_errors
from completion.mocap.marker_selection.greedy import Groups, MarkerSets, exchange, symmetric_groups
from completion.mocap.marker_selection.linear import LinearBodies, WholeFits, fit_bodies, in_poses
from completion.mocap.marker_sets.layout import MarkerLayout
from completion.mocap.marker_sets.named import load_layout
from model.body import BodyModel
from model.files import load_model

COUNTS = (10, 25, 47, 67)
CHECKS = (10, 25, 47, 67, 90)
POSES, RANDOM = 8, 50
SOME = 17                            # every so manyth body is refitted in full for random sets; all poses come up
OTHERS = ("vicon47", "mosh67", "cmu41")


def random_set(groups: Groups, count: int, rng: np.random.Generator) -> list[int]:
    """Markers of groups drawn at random, exactly so many."""
    while True:
        chosen: list[int] = []
        for g in rng.permutation(len(groups)):
            if len(chosen) + len(groups[g]) <= count:
                chosen += groups[g]
        if len(chosen) == count:
            return chosen


def full_rmse(model: BodyModel, bodies: np.ndarray, fits: WholeFits, chosen: list[int], config: DesignConfig,
              some: np.ndarray) -> float:
    """Metres, by full refits of some of the bodies."""
    fewer = WholeFits(fits.x[some], fits.markers, fits.places[some], fits.prior.of(some), fits.linear)
    return float(np.sqrt(vertex_errors(model, fewer.refit(chosen, config), bodies[some]).mean()))


def members(groups: Groups, choice: Choice, count: int) -> list[int]:
    """Candidates of the best set of that size on the curves."""
    path = best_path(choice.paths, count)
    assert path.counts[path.at(count)] == count, f"a set of {count}"
    return sorted(i for g in path.set(path.at(count)) for i in groups[g])


def exchanged(linear: LinearBodies, groups: Groups, chosen: list[int], free: np.ndarray
              ) -> tuple[list[int], float]:
    """The set after a round of exchanges, and its error."""
    sets = MarkerSets(linear, groups, [g for g, group in enumerate(groups) if set(group) <= set(chosen)])
    exchange(sets, free)
    return sorted(i for g in np.flatnonzero(sets.inside) for i in groups[g]), sets.rmse


def other_halves(linear: LinearBodies, groups: Groups, config: DesignConfig) -> dict[int, float]:
    """Error of the sets of one half of the men on the other half, by count."""
    first = np.arange(len(linear.rest)) < POSES * ((len(linear.rest) // POSES + 1) // 2)
    squared: dict[int, list[np.ndarray]] = {count: [] for count in COUNTS}
    for mine in (first, ~first):
        choice, other = choose(linear.of(mine), groups, np.zeros(len(groups), bool), config), linear.of(~mine)
        for count in COUNTS:
            squared[count].append(other.surface_error(other.steps(members(groups, choice, count))))
    return {count: float(np.sqrt(np.concatenate(parts).mean())) for count, parts in squared.items()}


def main() -> None:
    """Measure, print as it comes, write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-m", "--model", type=Path, required=True)
    parser.add_argument("--men", choices=("inner", "held-out"), default="inner")
    parser.add_argument("--bodies", type=Path, help="file in which the posed men are kept")
    parser.add_argument("--save", type=Path, help="file for the set of 67 markers that keeps vicon47")
    parser.add_argument("-o", "--output", type=Path, required=True)
    given = parser.parse_args()
    model, data = load_model(given.model), load_real()
    train, held = spring_split(len(data.shapes))
    men = [int(i) for i in (held if given.men == "held-out" else train[::5])]
    if given.bodies and given.bodies.exists():
        bodies = np.load(given.bodies)["bodies"].reshape(-1, *model.template.vertices.shape)
    else:
        poses = model.pose_examples[np.linspace(0, 70, POSES).round().astype(int)]          # of the 71 scans of SCAPE
        bodies = in_poses(model, data.shapes[men], poses).reshape(-1, *model.template.vertices.shape)
        if given.bodies:
            np.savez(given.bodies, bodies=bodies)
    base = load_layout("vicon47", model.template)
    candidates = candidate_layout(model, base, 114)
    groups = symmetric_groups(candidates.labels)
    report: dict[str, object] = {"machine": machine(), "model": str(given.model), "men": given.men,
                                 "bodies": len(bodies), "candidates": candidates.labels}

    def tell(**row: object) -> None:
        print(row, flush=True)
        report.setdefault("rows", []).append(row)                    # type: ignore[attr-defined]

    start, wall = time.process_time(), time.perf_counter()
    config = DesignConfig(through=COUNTS)
    places, extra = _with_others(candidates, model)
    fits = fit_bodies(model, bodies, places, config)
    tell(what="fit and linearise", cpu_s=time.process_time() - start, wall_s=time.perf_counter() - wall,
         floor_mm=1e3 * float(np.sqrt(fits.linear.rest.mean())))
    linear, free, every = fits.linear, np.ones(len(groups), bool), slice(None)
    choice = choose(linear, groups, ~free, config)
    tell(what="greedy choice, down from 114 and up from 0", cpu_s=time.process_time() - start,
         wall_s=time.perf_counter() - wall,
         curve={name: [p.counts.tolist(), (1e3 * p.rmse).round(3).tolist()] for name, p in choice.paths.items()})
    for count in CHECKS:
        path = best_path(choice.paths, count)
        chosen = sorted(i for g in path.set(path.at(count)) for i in groups[g])
        tell(what="linearised against full refits", count=len(chosen), linearised_mm=1e3 * linear.rmse(chosen),
             full_mm=1e3 * full_rmse(model, bodies, fits, chosen, config, every))
    sets = _against_random(linear, groups, choice, tell)
    for count, error in other_halves(linear, groups, config).items():
        tell(what="chosen on the other half of the men", count=count, linearised_mm=1e3 * error,
             on_all_mm=1e3 * linear.rmse(members(groups, choice, count)))
    for name, rows in extra.items():
        tell(what=name, count=len(rows), linearised_mm=1e3 * linear.rmse(rows),
             full_mm=1e3 * full_rmse(model, bodies, fits, rows, config, every))
    kept = np.array([candidates.labels[group[0]] in base.labels for group in groups])
    more = choose(linear, groups, kept, DesignConfig(count=67))
    chosen = sorted(i for g in more.groups for i in groups[g])
    tell(what="vicon47 and 20 more", count=len(chosen), linearised_mm=1e3 * more.rmse,
         full_mm=1e3 * full_rmse(model, bodies, fits, chosen, config, every),
         added=[candidates.labels[i] for i in chosen if candidates.labels[i] not in base.labels],
         kept_curve=[[int(n), 1e3 * float(e)] for n, e in zip(more.paths["kept, removed"].counts,
                                                             more.paths["kept, removed"].rmse, strict=True)])
    if given.save:
        candidates.select([candidates.labels[i] for i in chosen]).save(given.save)
    write_report(given.output, report)
    _against_random_in_full(model, bodies, fits, sets, config, tell)
    write_report(given.output, report)


def _with_others(candidates: MarkerLayout, model: BodyModel) -> tuple[MarkerLayout, dict[str, list[int]]]:
    """The candidates with the markers of other sets behind them, and where those sets are among them."""
    labels, vertices = list(candidates.labels), candidates.vertices.tolist()
    rows = {}
    for name in OTHERS:
        layout = load_layout(name, model.template)
        rows[name] = list(range(len(labels), len(labels) + len(layout.labels)))
        labels += [f"{name} {label}" for label in layout.labels]
        vertices += layout.vertices.tolist()
    return MarkerLayout(tuple(labels), np.array(vertices), 0.0), rows


def _against_random(linear: LinearBodies, groups: Groups, choice: Choice, tell) -> dict[int, list[list[int]]]:
    """Every size: greedy, greedy with exchanges, and random sets, linearised; all these sets."""
    rng, sets = np.random.default_rng(0), {}
    for count in COUNTS:
        chosen = members(groups, choice, count)
        better, error = exchanged(linear, groups, chosen, np.ones(len(groups), bool))
        drawn = [random_set(groups, count, rng) for _ in range(RANDOM)]
        errors = 1e3 * np.array([linear.rmse(each) for each in drawn])
        tell(what="against random sets", count=count, greedy_mm=1e3 * linear.rmse(chosen), exchanged_mm=1e3 * error,
             random_median_mm=float(np.median(errors)), random_best_mm=float(errors.min()))
        sets[count] = [chosen, better, *drawn]
    return sets


def _against_random_in_full(model: BodyModel, bodies: np.ndarray, fits: WholeFits, sets: dict[int, list[list[int]]],
                            config: DesignConfig, tell) -> None:
    """The same sets by full refits of some of the bodies."""
    some = slice(None, None, SOME)
    for count, each in sets.items():
        errors = 1e3 * np.array([full_rmse(model, bodies, fits, chosen, config, some) for chosen in each])
        tell(what="against random sets, full refits", count=count, bodies=len(bodies[some]), greedy_mm=float(errors[0]),
             exchanged_mm=float(errors[1]), random_median_mm=float(np.median(errors[2:])),
             random_best_mm=float(errors[2:].min()))


if __name__ == "__main__":
    main()
