"""Bodies for `measures.py`: people whose true surface is known, as scans, half views and markers give them.

    SCAPEKIT_DATA=... python tests/benchmarks/measured_bodies.py -o FOLDER [--people 20] [--men 6]

Every body is a file of its own; called again, what is there is kept. Synthetic people are none of those of the model.
A person is scanned near rest (four views), the template registered with ten landmarks; this registered body is the
known person of the half view in a random pose (seven landmarks), and of the same view the person is unknown too; 47
markers, 5 mm beside their place, in frames between usual poses, give betas. SPRING men of the held-out part are
scanned twice, with cameras and noise of their own, and registered twice.
"""
from __future__ import annotations

import argparse
import itertools
from collections.abc import Callable
from pathlib import Path

import numpy as np
from mosh_people import BETWEEN, KEYS, PLACING, RADIUS
from protocols import half_view, load_real
from scans import HELD_MEN, TEN

from completion.mocap.files.markers import MarkerSequence
from completion.mocap.marker_sets.layout import MarkerLayout
from completion.mocap.marker_sets.named import load_layout
from completion.mocap.subject.person import find_person
from completion.partial.completion import Completion, complete
from model.body import BodyModel
from model.built_in import load_built_in_model
from model.posing.transfer import subject_from_body
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Surface
from scanprep.registration.nonrigid import register
from scanprep.synthetic.data_set import near_rest
from scanprep.synthetic.landmarks import landmarks
from scanprep.synthetic.people import BodyShape, SyntheticPerson, random_pose
from scanprep.synthetic.scanner import ScannerConfig, scan

CLICKED = ("left toe", "right toe", "left knee", "right knee", "left middle finger", "right middle finger",
           "left elbow outside", "right elbow outside", "top of head", "navel")
CLICK = 0.003                        # metres, in each coordinate


def kept(path: Path, make: Callable[[], dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """The arrays of a file, made first where it is not there."""
    if not path.exists():
        beside = path.with_suffix(".part.npz")
        np.savez_compressed(beside, **make())
        beside.rename(path)
        print(path.name, flush=True)
    with np.load(path) as found:
        return dict(found)


def somebody(k: int) -> tuple[SyntheticPerson, np.random.Generator]:
    """The k-th person, women and men in turn."""
    rng = np.random.default_rng([18, k])
    return SyntheticPerson(BodyShape.random(rng, "male" if k % 2 else "female")), rng


def registered(person: SyntheticPerson, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """The average person's mesh on a scan of somebody near rest."""
    true = person.mesh.with_vertices(person.in_pose(near_rest(rng)))
    scanned = scan(true, ScannerConfig(), rng).merged
    ids = np.array([landmarks()[name] for name in CLICKED])
    clicked = true.vertices[ids] + CLICK * rng.normal(size=(len(ids), 3))
    found = register(SyntheticPerson().mesh, scanned, (ids, clicked))
    return {"truth": true.vertices, "vertices": found.mesh.vertices, "confidence": found.confidence}


def halves(model: BodyModel, person: SyntheticPerson, mine: np.ndarray, k: int, rng: np.random.Generator, known: bool
           ) -> dict[str, np.ndarray]:
    """The half view of somebody in a random pose, completed; `mine` (N, 3) is the registered body."""
    ids = np.array(model.info["people_vertices"])
    true = person.mesh.with_vertices(person.in_pose(0.6 * random_pose(rng)))
    half = half_view(true, k, landmarks(), rng)
    place = {vertex: number for number, vertex in enumerate(ids.tolist())}
    clicked = np.array([place[int(vertex)] for vertex in half.landmarks[0]]), half.landmarks[1]
    done = complete(subject_from_body(model, mine[ids]) if known else model, half.points, clicked)
    return {"truth": true.vertices, **of_completion(done)}


def of_completion(done: Completion) -> dict[str, np.ndarray]:
    """What of a completion is kept."""
    assert done.expected_error is not None
    return {"vertices": done.completed.vertices, "predicted": done.predicted.vertices, "pose": done.pose,
            "trans": done.trans, "betas": np.zeros(0) if done.betas is None else done.betas, "seen": done.seen,
            "expected_error": done.expected_error, "judgement": np.array(str(done.judgement))}


def marked(model: BodyModel, person: SyntheticPerson, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """The body whose markers move between poses of the model."""
    ids = np.array(model.info["people_vertices"])
    usual = load_layout("vicon47", model.template, ids)
    layout = MarkerLayout(usual.labels, usual.vertices, RADIUS, usual.weights)
    rest = Mesh(person.mesh.vertices[ids], model.template.faces)
    places = Surface(rest).closest(layout.skin_points(rest.vertices) + rng.normal(0, PLACING, (len(layout.labels), 3)))
    keys = model.pose_examples[rng.choice(len(model.pose_examples), KEYS, replace=False)]
    frames = []
    for first, second in itertools.pairwise(keys):
        for share in np.arange(BETWEEN) / BETWEEN:
            mesh = Mesh(person.in_pose((1 - share) * first + share * second)[ids], rest.faces)
            corners = mesh.faces[places.faces]
            normals = np.einsum("lc,lcd->ld", places.bary, mesh.vertex_normals[corners])
            frames.append(np.einsum("lc,lcd->ld", places.bary, mesh.vertices[corners])
                          + RADIUS * normals / np.linalg.norm(normals, axis=1, keepdims=True))
    found = find_person(model, MarkerSequence(np.array(frames), layout.labels, 120.0), layout)
    return {"betas": found.betas}


def of_person(model: BodyModel, folder: Path, k: int) -> None:
    """All bodies of one synthetic person."""
    person, _ = somebody(k)
    chance = [np.random.default_rng([18, k, step]) for step in range(4)]
    mine = kept(folder / f"person{k:02d}_registered.npz", lambda: registered(person, chance[0]))["vertices"]
    kept(folder / f"person{k:02d}_known.npz", lambda: halves(model, person, mine, k, chance[1], True))
    kept(folder / f"person{k:02d}_markers.npz", lambda: marked(model, person, chance[2]))
    kept(folder / f"person{k:02d}_unknown.npz", lambda: halves(model, person, mine, k, chance[3], False))


def of_man(folder: Path, k: int) -> None:
    """Two registrations of two scans of a SPRING man."""
    data = load_real()
    truth = data.template.with_vertices(data.shapes[k])
    ids = np.array([data.landmarks[name] for name in TEN])

    def once(turn: int) -> dict[str, np.ndarray]:
        rng = np.random.default_rng([18, k, turn])
        scanned = scan(truth, ScannerConfig(azimuth=45.0 + 37.0 * turn), rng).merged
        clicked = truth.vertices[ids] + CLICK * rng.normal(size=(len(ids), 3))
        found = register(data.template, scanned, (ids, clicked))
        return {"truth": truth.vertices, "vertices": found.mesh.vertices, "confidence": found.confidence}

    for turn in range(2):
        kept(folder / f"man{k:03d}_{turn}.npz", lambda turn=turn: once(turn))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--people", type=int, default=20)
    parser.add_argument("--men", type=int, default=6)
    args = parser.parse_args()
    args.output.mkdir(parents=True, exist_ok=True)
    model = load_built_in_model()
    for k in range(max(args.people, args.men)):
        if k < args.people:
            of_person(model, args.output, k)
        if k < args.men:
            of_man(args.output, HELD_MEN[k])


if __name__ == "__main__":
    main()
