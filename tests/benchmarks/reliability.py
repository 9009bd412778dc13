"""How well verdicts and probabilities tell which registrations are right, without any landmark.

    SCAPEKIT_DATA=... python tests/benchmarks/reliability.py FOLDER [--part train|held] [--count 80] [--fit] [-o FILE]

Virtual scans of SCAPE poses and SPRING men: as they are, turned any way, upside down, with a chair on a floor, and cut
at the waist. FOLDER keeps a row a scan, so that a run that was stopped goes on. `held` are scans whose number is 2 mod
5; `--fit` finds the weights of the evidence. Probabilities are told by weights of one half of the scans on the other. A
registration is *right* within 20 mm on average, and no part beyond 50 mm: the vertices of the men are true to about a
centimetre.

What we lose at: a hand that is rolled lies on its scan, and stretches little.
"""
from __future__ import annotations

import argparse
import json
import random
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from protocols import RealData, load_real, machine, write_report
from registration import worst_limb
from scans import test_scan
from scipy.optimize import minimize
from scipy.spatial import cKDTree
from wrong_inputs import box, chair, cut, together

from scanprep.cleaning.clean_scan import take_clutter
from scanprep.geometry import rotations
from scanprep.geometry.mesh import Mesh
from scanprep.judgement import size
from scanprep.registration.figures import EVIDENCE, UNSEEN, Limits, evidence_of, figures_of, review
from scanprep.registration.lead import Lead, lead_of
from scanprep.registration.limbs import find_exchanged_sides, limb_doubts
from scanprep.registration.nonrigid import registration_problem
from scanprep.registration.person import PersonParts, person_parts
from scanprep.registration.unmarked import register_by_any

MEAN, PART = 20.0, 50.0               # millimetres within which a registration is right
LEGS = "thigh", "shin", "foot"
# Evidence that is hardly seen keeps this weight: as much as tells in favour; and the penalty of squared distances to it
PRIOR, PENALTY = 0.5, 0.5


def change(what: str, scan: Mesh, truth: np.ndarray, parts: PersonParts, body: Mesh, rng: np.random.Generator
           ) -> tuple[Mesh, np.ndarray]:
    """A scan and its true vertices (N, 3), metres, changed in some way."""
    if what == "turned":
        R = rotations.exp(2 * rng.normal(size=3))
        return scan.with_vertices(scan.vertices @ R.T), truth @ R.T
    if what == "down":
        R = rotations.exp(np.array([np.pi, 0, 0]))
        return scan.with_vertices(scan.vertices @ R.T), truth @ R.T
    if what == "clutter":
        low, high = truth.min(axis=0), truth.max(axis=0)
        floor = box((low[0] - 0.4, low[1] - 0.4, low[2] - 0.06), (high[0] + 0.4, high[1] + 0.4, low[2] - 0.01))
        beside = chair()
        at = np.array([high[0] + 0.15, truth[:, 1].mean(), low[2]])
        return together(scan, floor, beside.with_vertices(beside.vertices + at)), truth
    if what == "waist":
        legs = [k for k, name in enumerate(parts.skeleton.names) if any(leg in name for leg in LEGS)]
        lower = np.isin(parts.skeleton.part_of_vertex(body), legs)
        return cut(scan, ~lower[cKDTree(truth).query(scan.vertices)[1]]), truth
    return scan, truth


def chosen(part: str, count: int) -> list[tuple[str, int, str]]:
    """Kind, number and change of so many scans: half of them poses, most as they are; fewer, where poses run out."""
    rng, held = random.Random(2), part == "held"
    poses = [k for k in range(1, 71) if (k % 5 == 2) == held]
    men = [k for k in range(227) if (k % 5 == 2) == held]
    rng.shuffle(poses)
    rng.shuffle(men)
    changes = ("plain", "turned", "plain", "waist", "plain", "down", "plain", "clutter")
    out = []
    for k in range(count // 2):
        out.append(("pose", poses[k % len(poses)], changes[(k + k // len(poses)) % 8]))
        out.append(("man", men[k % len(men)], changes[(k + 4) % 8]))
    return list(dict.fromkeys(out))


def measure(data: RealData, parts: PersonParts, lead: Lead, kind: str, index: int, what: str) -> dict[str, object]:
    """Register one scan: what is true of it, and the evidence."""
    item = test_scan(data, kind, index)
    scan, truth = change(what, item.scan, item.truth.vertices, parts, item.truth, np.random.default_rng(index))
    row: dict[str, object] = {"scan": item.name, "kind": kind, "change": what}
    cpu = time.process_time()
    scan = take_clutter(scan)[0]               # as `scape prep run` does
    try:
        led = register_by_any(data.template, scan, None, lead, parts)
    except ValueError as error:
        return {**row, "verdict": "failed", "why": str(error), "right": False}
    fit, way = led.fit, led.way
    x = fit.mesh.vertices
    limb = worst_limb(x, replace(item, truth=item.truth.with_vertices(truth)), parts)
    mean = 1e3 * float(np.linalg.norm(x - truth, axis=1).mean())
    figures, doubts = figures_of(item.name, way, data.template, fit), limb_doubts(data.template, parts, x)
    problem = registration_problem(data.template, scan, fit, marked=False) or find_exchanged_sides(data.template, parts,
                                                                                                   x)
    scale, faces = size(data.template), len(data.template.faces)
    verdict = review([figures], {item.name: problem} if problem else {}, scale, faces, None, {item.name: doubts},
                     UNSEEN)[0]
    return {**row, "cpu_s": time.process_time() - cpu, "way": way, "mean_mm": mean, **limb,
            "right": mean <= MEAN and float(str(limb["worst_limb_mm"])) <= PART,
            "evidence": evidence_of(figures, scale, faces, UNSEEN, Limits(), doubts),
            "verdict": verdict.judgement.verdict, "why": verdict.judgement.why, "probability": verdict.right}


def fit_weights(rows: list[dict]) -> dict[str, float]:
    """Weights of the evidence, none negative, of the likeliest logistic model; the first is the log-odds without any.

    Registrations that failed are left out: they have their reason.
    """
    rows = [row for row in rows if row["verdict"] != "failed"]
    X = np.log1p([[row["evidence"][name] for name in EVIDENCE] for row in rows])
    y = np.array([row["right"] for row in rows], dtype=float)

    def cost(w: np.ndarray) -> float:
        z = w[0] - X @ w[1:]
        return float(np.logaddexp(0, z).sum() - y @ z + PENALTY * ((w[1:] - PRIOR)**2).sum())

    found = minimize(cost, np.r_[2.0, np.ones(X.shape[1])], bounds=[(None, None), *[(0, None)] * X.shape[1]]).x
    return dict(zip(("certain", *EVIDENCE), found.round(2).tolist(), strict=True))


def halves_probability(rows: list[dict]) -> np.ndarray:
    """Probability (n,) of every row by weights that were fitted on the other half; pose and man alternate in both."""
    half, p = (np.arange(len(rows)) // 2) % 2, np.zeros(len(rows))
    for k in (0, 1):
        weights = fit_weights([row for row, of in zip(rows, half, strict=True) if of != k])
        for i in np.flatnonzero(half == k):
            if rows[i]["verdict"] != "failed":
                against = sum(weights.get(name, 0.0) * np.log1p(value) for name, value in rows[i]["evidence"].items())
                p[i] = 1 / (1 + np.exp(against - weights["certain"]))
    return p


def summarise(rows: list[dict]) -> dict[str, object]:
    """Verdicts against the truth, Brier score, and a reliability diagram, by weights of the other half."""
    right = np.array([row["right"] for row in rows])
    word = np.array([row["verdict"] for row in rows])
    p = halves_probability(rows)
    bins = np.minimum((5 * p).astype(int), 4)
    return {"registrations": len(rows), "right": int(right.sum()),
            "wrong_called_good": int((~right & (word == "good")).sum()),
            "right_called_check": int((right & (word == "check")).sum()),
            "right_called_failed": int((right & (word == "failed")).sum()),
            "brier": float(((p - right)**2).mean()), "brier_of_the_mean": float(((right.mean() - right)**2).mean()),
            "diagram": [{"from": k / 5, "count": int((bins == k).sum()), "said": float(p[bins == k].mean()),
                         "were": float(right[bins == k].mean())} for k in range(5) if (bins == k).any()]}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--part", choices=("train", "held"), default="held")
    parser.add_argument("--count", type=int, default=150)
    parser.add_argument("--fit", action="store_true", help="find the weights on these scans, and print them")
    parser.add_argument("-o", "--output", help="write all figures here")
    args = parser.parse_args()
    args.folder.mkdir(parents=True, exist_ok=True)
    data, rows, lead, parts = load_real(), list[dict](), None, None
    for kind, index, what in chosen(args.part, args.count):
        kept = args.folder / f"{kind}{index:03d}_{what}.json"
        if not kept.exists():
            if lead is None:
                parts, lead = person_parts(data.template), lead_of(data.template, "auto")
            assert parts is not None and lead is not None, "the template is a person"
            kept.write_text(json.dumps(measure(data, parts, lead, kind, index, what)))
        rows.append(json.loads(kept.read_text()))
        row = rows[-1]
        print(row["scan"], row["change"], row["verdict"], row["right"], row.get("mean_mm"), row["why"][:90], flush=True)
    if args.fit:
        print("weights:", fit_weights(rows))
    summary = summarise(rows)
    print(summary)
    if args.output:
        write_report(args.output, {"part": args.part, "machine": machine(), "summary": summary, "rows": rows})


if __name__ == "__main__":
    main()
