"""People from simulated markers: how near the recovered shape comes, for different numbers of markers.

    SCAPEKIT_DATA=... python tests/benchmarks/mosh_people.py -m MODEL.npz -o mosh_people.json
    SCAPEKIT_DATA=... python tests/benchmarks/mosh_people.py -m INNER.npz --men inner --markers 47 -o inner.json

The true subjects are SPRING men of whom the model has not learned, each with his own full shape. Their markers have a
radius of 9.5 mm and sit 5 mm beside their place, as a tangential Gaussian that is drawn once a subject. They move
through training poses. The error is that of the paper: the found shape is fixed, its pose is fitted to the registered
man, and the distances of corresponding vertices are averaged. Some men move a second time: how far the two bodies are
apart, and how far each is from the mean person against the true man, standing in the rest pose.
"""
from __future__ import annotations

import argparse
import dataclasses
import time

import numpy as np
from protocols import load_real, machine, spring_split, write_report

from completion.mocap.files.markers import MarkerSequence
from completion.mocap.marker_sets.layout import MarkerLayout
from completion.mocap.marker_sets.named import layout_names, load_layout
from completion.mocap.subject.person import PersonConfig, PersonFit, find_person
from model.body import BodyModel
from model.files import load_model
from model.fitting.vertices import fit_pose
from model.linear import Subject
from model.posing.transfer import subject_from_body
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Surface, SurfacePoints

RADIUS, PLACING = 0.0095, 0.005      # metres
KEYS, BETWEEN = 8, 6                 # training poses that a sequence passes, and frames from one to the next
WHOLE = 47                           # markers of the set that is compared with the paper


def marker_set(model: BodyModel, count: int) -> MarkerLayout:
    """The Vicon set, the spread-out part of it, or the larger set; every marker a ball on the skin."""
    name = "vicon47" if count <= WHOLE or "mosh67" not in layout_names() else "mosh67"
    layout = load_layout(name, model.template)
    plain = MarkerLayout(layout.labels, layout.vertices, RADIUS, layout.weights)
    places = model.template.vertices[plain.nearest]
    if count >= len(plain.labels):
        return plain if count == len(plain.labels) else enlarged(model, plain, count)
    chosen = [int(np.argmin(np.linalg.norm(places - places.mean(axis=0), axis=1)))]
    far = np.full(len(places), np.inf)
    while len(chosen) < count:
        far = np.minimum(far, np.linalg.norm(places - places[chosen[-1]], axis=1))
        chosen.append(int(far.argmax()))
    return plain.select([plain.labels[i] for i in sorted(chosen)])


def enlarged(model: BodyModel, layout: MarkerLayout, count: int) -> MarkerLayout:
    """With more markers where there is most room between them."""
    vertices, chosen = model.template.vertices, layout.nearest.tolist()
    far = np.linalg.norm(vertices[:, None] - vertices[chosen], axis=2).min(axis=1)
    while len(chosen) < count:
        chosen.append(int(far.argmax()))
        far = np.minimum(far, np.linalg.norm(vertices - vertices[chosen[-1]], axis=1))
    labels = (*layout.labels, *(f"X{i}" for i in range(count - len(layout.labels))))
    return MarkerLayout(labels, np.array(chosen), RADIUS)


def put_on(subject: Subject, layout: MarkerLayout, rng: np.random.Generator) -> SurfacePoints:
    """Where on the skin somebody put the markers."""
    vertices = subject.vertices(np.zeros((len(subject.skeleton.parents), 3)))
    mesh, ids = Mesh(vertices, subject.template.faces), layout.nearest
    off = rng.normal(0, PLACING, (len(ids), 3))
    normals = mesh.vertex_normals[ids]
    off -= np.einsum("ld,ld->l", off, normals)[:, None] * normals
    return Surface(mesh).closest(vertices[ids] + off)


def recorded(subject: Subject, places: SurfacePoints, labels: tuple[str, ...], model: BodyModel,
             rng: np.random.Generator) -> MarkerSequence:
    """A sequence of the markers, while the subject passes through training poses."""
    keys = model.pose_examples[rng.choice(len(model.pose_examples), KEYS, replace=False)].copy()
    keys[:, 0] = rng.normal(0, 0.3, (KEYS, 3))
    at = np.arange((KEYS - 1) * BETWEEN + 1) / BETWEEN
    before = np.minimum(at.astype(int), KEYS - 2)
    share = (at - before)[:, None, None]
    poses = (1 - share) * keys[before] + share * keys[before + 1]
    trans = np.cumsum(rng.normal(0, 0.02, (len(at), 3)), axis=0)
    out = np.empty((len(at), len(labels), 3))
    for t, vertices in enumerate(subject.vertices(poses, trans)):
        mesh = Mesh(vertices, subject.template.faces)
        ids = mesh.faces[places.faces]
        normals = np.einsum("lc,lcd->ld", places.bary, mesh.vertex_normals[ids])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        out[t] = np.einsum("lc,lcd->ld", places.bary, vertices[ids]) + RADIUS * normals
    return MarkerSequence(out, labels, 120.0)


def at_rest(subject: Subject) -> np.ndarray:
    """The subject (N, 3) in the rest pose, its centroid in the origin, metres."""
    vertices = subject.vertices(np.zeros((len(subject.skeleton.parents), 3)))
    return vertices - vertices.mean(axis=0)


def apart(first: np.ndarray, second: np.ndarray) -> float:
    """Mean distance of corresponding vertices, millimetres."""
    return 1e3 * float(np.linalg.norm(first - second, axis=1).mean())


def again(model: BodyModel, subject: Subject, found: PersonFit, second: PersonFit) -> dict[str, float]:
    """Two bodies of one subject against each other, and each against the mean person, in the rest pose.

    The two are also compared as bodies are with the true one, the pose of one fitted to the other: betas take up some
    of how people hold their limbs.
    """
    mean_person = model.subject(np.zeros(model.n_betas))
    mean, truth = at_rest(mean_person), at_rest(subject)
    one, two = (at_rest(model.subject(each.betas)) for each in (found, second))
    true = apart(truth, mean)
    fitted, first, other = (1e3 * fit_pose(mean_person, body).mean for body in (truth, one, two))
    return {"two_bodies_mm": apart(one, two), "true_from_mean_mm": true, "first_share": apart(one, mean) / true,
            "second_share": apart(two, mean) / true,
            "two_bodies_fitted_mm": 1e3 * fit_pose(model.subject(second.betas), one).mean,
            "true_from_mean_fitted_mm": fitted, "first_share_fitted": first / fitted,
            "second_share_fitted": other / fitted}


def main() -> None:
    """Run and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-m", "--model", required=True)
    parser.add_argument("-o", "--output", default="mosh_people.json")
    parser.add_argument("--men", choices=("held", "inner"), default="held",
                        help="the 45 held-out men, or every fifth of the others for a model without them")
    parser.add_argument("--markers", type=int, nargs="+", default=[WHOLE, 5, 10, 25, 67])
    parser.add_argument("--every", type=int, default=1, help="of the men, for numbers of markers other than 47")
    parser.add_argument("--twice", type=int, default=5, help="every so many men move a second time")
    parser.add_argument("--limit", type=int, help="of the men")
    args = parser.parse_args()
    data, model, config = load_real(), load_model(args.model), PersonConfig()
    train, held = spring_split(len(data.shapes))
    men = (held if args.men == "held" else train[::5])[:args.limit]
    rows, rest = [], model.subject(np.zeros(model.n_betas))
    for k, man in enumerate(men):
        subject = subject_from_body(model, data.shapes[man])
        for count in args.markers:
            if count != WHOLE and k % args.every:
                continue
            rng, layout = np.random.default_rng([int(man), count]), marker_set(model, count)
            places = put_on(subject, layout, rng)
            start = time.process_time()
            found = find_person(model, recorded(subject, places, layout.labels, model, rng), layout, config)
            seconds = time.process_time() - start
            error = fit_pose(model.subject(found.betas), data.shapes[man]).mean
            row = {"man": int(man), "markers": len(layout.labels), "error_mm": 1e3 * error, "cpu_s": seconds,
                   "residual_mm": 1e3 * found.residual, "moved_mm": 1e3 * float(found.moved.mean()),
                   "beta_rms": float(np.sqrt((found.betas**2).mean())), "converged": found.converged}
            if count == WHOLE and k % args.twice == 0:
                other = recorded(subject, places, layout.labels, model, rng)
                row["mean_person_mm"] = 1e3 * fit_pose(rest, data.shapes[man]).mean
                row |= again(model, subject, found, find_person(model, other, layout, config))
            rows.append(row)
            print("  ".join(f"{name} {value:.3g}" for name, value in row.items()), flush=True)
            write_report(args.output, {"protocol": f"{args.men} SPRING men, {PLACING} m beside their place",
                                       "machine": machine(), "config": dataclasses.asdict(config), "rows": rows,
                                       "mean": table(rows)})
    for line in table(rows):
        print("  ".join(f"{name} {value:.4g}" for name, value in line.items()))


def table(rows: list[dict]) -> list[dict[str, float]]:
    """The mean of everything for each number of markers."""
    out = []
    for count in sorted({row["markers"] for row in rows}):
        mine = [row for row in rows if row["markers"] == count]
        names = dict.fromkeys(name for row in mine for name in row if name not in ("man", "markers"))
        out.append({"markers": count, "men": len(mine), **{
            name: float(np.mean([row[name] for row in mine if name in row])) for name in names}})
    return out


if __name__ == "__main__":
    main()
