"""Few scans: a model of 8 poses of one man and 10 men, and what it completes.

    SCAPEKIT_DATA=... python tests/benchmarks/few_scans.py -o few_scans.json [--models DIR] [--pictures DIR]
    SCAPEKIT_DATA=... python tests/benchmarks/few_scans.py --inner --offsets 1 -o inner.json          (for tuning)
    SCAPEKIT_DATA=... python tests/benchmarks/few_scans.py --poses 3 --men 1 -o fewest.json

For each offset o the poses are mesh000 and those at `range(3 + o, 71, 9)[:7]`, the men `range(o, 227, 23)[:10]`; more
are spread over all that are not held out. The model leans on the built-in people, with `--prior none` on nothing. Held
out are the poses at indices 0 (mod 5) and the men at 2 (mod 5) that were not used; with `--inner` those at 1 and 3, so
that what is tuned never meets what is reported. Rows: *poses*, *men*, the model fitted to held-out bodies; *known*,
half views of held-out poses of the known man; *unknown*, half views of every third held-out man, of unknown shape;
*mosh*, the shape of every sixth held-out man from 47 simulated markers. `judgement` and `limb_mm`, the mean of the
worst part, are there for every half view: what a completion says about itself is compared with what it is worth.
`within_once` and `within_twice` are the shares of the unseen vertices that are off by at most the error
that was expected, or twice that.
`wrong` is a half view whose unseen surface is off by more than 30 mm on average, or a part by more than 150 mm;
`flagged` one that is not judged good.
"""
from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
from half_views import errors, picture
from protocols import RealData, half_view, load_real, machine, write_report
from scipy.stats import spearmanr

from completion.partial.completion import Completion, complete
from model import learn_scape
from model.body import BodyModel
from model.evaluation.errors import pose_errors, shape_errors
from model.files import load_model
from model.learning.parts import choose_skeleton
from model.learning.prior import bring_prior

STAGES = ("poses", "men", "known", "unknown", "mosh")


def training(offset: int, poses: int = 8, men: int = 10, inner: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Indices of the poses and of the men that a model is learned from."""
    few_poses, few_men = np.array([0, *range(3 + offset, 71, 9)][:8]), np.array(range(offset, 227, 23))[:10]
    rest_poses, rest_men = (np.flatnonzero(np.arange(count) % 5 != held)[offset:] for count, held in
                            ((71, 1 if inner else 0), (227, 3 if inner else 2)))
    # more than those of the protocol: evenly over all that are not held out
    return (few_poses[:poses] if poses <= 8 else np.union1d([0], _spread(rest_poses[rest_poses > 0], poses - 1)),
            few_men[:men] if men <= 10 else _spread(rest_men, men))


def _spread(indices: np.ndarray, count: int) -> np.ndarray:
    return indices[np.linspace(0, len(indices) - 1, min(count, len(indices))).astype(int)]


def held_out(offset: int, inner: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Indices of the poses and of the men that it is tried on."""
    used_poses, used_men = training(offset)
    poses, men = np.arange(1 if inner else 0, 71, 5), np.arange(3 if inner else 2, 227, 5)
    return np.setdiff1d(poses, used_poses), np.setdiff1d(men, used_men)


def learn(data: RealData, offset: int, args: argparse.Namespace) -> BodyModel:
    """The model, read from a folder where it lies already."""
    name = f"few_{offset}_{args.poses}_{args.men}_{args.prior}.npz"
    if args.models and (args.models / name).exists():
        return load_model(args.models / name)
    mine, people = training(offset, args.poses, args.men, args.inner)
    bodies, prior = data.poses[mine], None
    if args.prior != "none":
        prior = bring_prior(load_model(args.prior), data.template)
    chosen = choose_skeleton(data.template, bodies, known=None if prior is None else prior.poses[1:])
    model = learn_scape(data.template, bodies, data.shapes[people] if args.men > 1 else None, chosen.skeleton,
                        prior=prior)
    if args.models:
        args.models.mkdir(parents=True, exist_ok=True)
        model.save(args.models / name)
    return model


def judged(result: Completion, part: np.ndarray) -> dict[str, Any]:
    """What a completion says about itself; `part` (N,) of each vertex."""
    error = result.expected_error
    means = [] if error is None else [1e3 * float(np.sqrt((of**2).mean())) for of in
                                      (error[~result.seen], *(error[part == p] for p in range(part.max() + 1)))]
    return {"explained": result.explained, "converged": result.converged,
            "expected_mm": means[0] if means else None, "expected_limb_mm": max(means[1:], default=None),
            **({"judgement": result.judgement.verdict, "reasons": list(result.judgement.reasons)}
               if hasattr(result, "judgement") else {})}


def half_views(data: RealData, model: BodyModel, known: bool, which: np.ndarray, args: argparse.Namespace, offset: int
               ) -> list[dict[str, Any]]:
    """A row for every half view."""
    bodies = (data.poses if known else data.shapes)[which]
    body = model.subject(None) if known else model
    part, rows = model.skeleton.part_of_vertex(data.template), []
    for k, vertices in enumerate(bodies):
        if (not known and k % 3) or (args.only is not None and k not in args.only):
            continue
        truth = data.template.with_vertices(vertices)
        view = half_view(truth, k, data.landmarks, np.random.default_rng(k))
        start = time.process_time()
        result = complete(body, view.points, view.landmarks if args.marks else None)
        found, off = errors(truth, view, result, part), np.linalg.norm(result.completed.vertices - vertices, axis=1)
        row = {"offset": offset, "k": k, "index": int(which[k]),
               "seen_mm": found["completed_seen_mm"], "unseen_mm": found["completed_unseen_mm"],
               "limb_mm": found["worst_part_mm"], "limb": found["worst_part"], **judged(result, part),
               "within_once": float((off <= result.expected_error)[~result.seen].mean()),
               "within_twice": float((off <= 2 * result.expected_error)[~result.seen].mean()),
               "cpu_seconds": round(time.process_time() - start, 1)}
        rows.append(row)
        print(row, flush=True)
        if args.pictures:
            picture(truth, view, result, args.pictures / f"{'known' if known else 'unknown'}_{offset}_{k:02d}.png")
    return rows


def recovered_men(data: RealData, model: BodyModel, which: np.ndarray, offset: int) -> list[dict[str, Any]]:
    """The shape of some men from simulated markers."""
    from mosh_people import marker_set, put_on, recorded

    from completion.mocap.subject.person import PersonConfig, find_person
    from model.fitting.vertices import fit_pose
    from model.posing.transfer import subject_from_body

    layout, rows = marker_set(model, 47), []
    for k, i in enumerate(which[::6]):
        rng = np.random.default_rng(k)
        subject = subject_from_body(model, data.shapes[i])
        markers = recorded(subject, put_on(subject, layout, rng), layout.labels, model, rng)
        found = find_person(model, [markers], layout, PersonConfig())
        rows.append({"offset": offset, "index": int(i),
                     "error_mm": 1e3 * fit_pose(model.subject(found.betas), data.shapes[i]).mean})
        print(rows[-1], flush=True)
    return rows


def tried(data: RealData, offset: int, args: argparse.Namespace) -> dict[str, list[dict[str, Any]]]:
    """The rows of all stages of one draw."""
    model = learn(data, offset, args)
    poses, men = held_out(offset, args.inner)
    rows: dict[str, list[dict[str, Any]]] = {}
    if "poses" in args.stages:
        mean = pose_errors(model, data.poses[poses]).errors.mean
        rows["poses"] = [{"offset": offset, "index": int(i), "error_mm": 1e3 * m}
                         for i, m in zip(poses, mean, strict=True)]
    if "men" in args.stages and model.n_betas:
        mean = shape_errors(model, data.shapes[men], [model.n_betas]).errors[-1].mean
        rows["men"] = [{"offset": offset, "index": int(i), "error_mm": 1e3 * m}
                       for i, m in zip(men, mean, strict=True)]
    if "known" in args.stages:
        rows["known"] = half_views(data, model, True, poses, args, offset)
    if "unknown" in args.stages and model.n_betas:
        rows["unknown"] = half_views(data, model, False, men, args, offset)
    if "mosh" in args.stages and model.n_betas:
        rows["mosh"] = recovered_men(data, model, men, offset)
    return rows


def summary(rows: dict[str, list[dict[str, Any]]]) -> dict[str, float]:
    """Means and worst of each stage."""
    out = {}
    for stage, found in rows.items():
        for name in ("error_mm", "seen_mm", "unseen_mm", "limb_mm", "cpu_seconds", "within_once", "within_twice"):
            if values := [row[name] for row in found if name in row]:
                out |= {f"{stage}_{name}": float(np.mean(values)), f"{stage}_{name}_worst": float(np.max(values))}
    views = [row for found in rows.values() for row in found if "limb_mm" in row]
    if views:
        limb = np.array([row["limb_mm"] for row in views])
        wrong = (limb > 150) | (np.array([row["unseen_mm"] for row in views]) > 30)
        flagged = np.array([row.get("judgement", "good") != "good" for row in views])
        out |= {"views": len(views), "limbs_beyond_150_mm": int((limb > 150).sum()),
                "limbs_beyond_150_mm_said_good": int(((limb > 150) & ~flagged).sum()), "wrong": int(wrong.sum()),
                "flagged": int(flagged.sum()), "wrong_and_flagged": int((wrong & flagged).sum())}
        for name, true in (("expected_mm", "unseen_mm"), ("expected_limb_mm", "limb_mm")):
            if all(row.get(name) is not None for row in views):
                out[f"correlation_{name}"] = float(spearmanr([row[name] for row in views],
                                                             [row[true] for row in views]).statistic)
    return out


def main() -> None:
    """Learn, complete, print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", default="few_scans.json")
    parser.add_argument("--offsets", type=int, nargs="*", default=[0, 2, 4])
    parser.add_argument("--inner", action="store_true")
    parser.add_argument("--poses", type=int, default=8)
    parser.add_argument("--men", type=int, default=10)
    parser.add_argument("--prior", default="people", help="people, none or a model file")
    parser.add_argument("--marks", type=int, choices=(0, 7), default=7)
    parser.add_argument("--stages", nargs="*", choices=STAGES, default=list(STAGES))
    parser.add_argument("--only", type=int, nargs="*", help="half views of these places in the list")
    parser.add_argument("--models", type=Path, help="folder in which models are kept")
    parser.add_argument("--before", type=Path, help="report of earlier code, to stand beside")
    parser.add_argument("--pictures", type=Path, help="folder for a picture of each half view")
    args = parser.parse_args()
    data, rows = load_real(), {stage: [] for stage in args.stages}
    for offset in args.offsets:
        for stage, found in tried(data, offset, args).items():
            rows[stage] += found
    mean = summary(rows)
    for name, value in mean.items():
        print(f"{name:32s} {value:8.2f}")
    before = {} if args.before is None else {"before": json.loads(args.before.read_text(encoding="utf-8"))["mean"]}
    write_report(args.output, {"protocol": "few scans", "offsets": args.offsets, "inner": args.inner,
                               "poses": args.poses, "men": args.men, "machine": machine(), "mean": mean, **before,
                               "rows": rows})


if __name__ == "__main__":
    main()
