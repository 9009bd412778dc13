"""Pose and soft tissue on characters: cartoon figures of the project, registered and moved by people.

    python tests/benchmarks/mosh_characters.py --folder OUT [-o FILE]
    SCAPEKIT_DATA=... python tests/benchmarks/mosh_characters.py -m PEOPLE.npz --c3d FILE.c3d --folder OUT [-o FILE]

The template is registered to each figure once and kept in OUT. Whose motion it is comes from `mosh`: an embedded man
who walks, or a file. Counted are triangles that have turned over against the rotations of the parts around them
(`Creases`) on the character and on the person, and how far the joints lie from those that the figure was made with.
Pictures and animated GLB are written beside the figures.
"""
from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np
from protocols import load_real, machine, write_report

from completion.mocap.files.markers import MarkerSequence, read_markers
from completion.mocap.marker_sets.layout import MarkerLayout
from completion.mocap.marker_sets.named import load_layout
from completion.mocap.mosh.mosh import mosh
from completion.mocap.retargeting.soft_tissue import (
    Creases,
    deformation,
    moving_character,
    picture_transfer,
    retarget_soft_tissue,
    write_character,
)
from completion.mocap.soft_tissue.soft_tissue import SoftTissue
from model.body import BodyModel
from model.built_in import load_built_in_model
from model.fitting.bodies import at_rest
from model.posing.character import Character, register_character
from scanprep.geometry.mesh import Mesh
from scanprep.pictures.shading import save_png
from scanprep.synthetic.data_set import SUBJECT
from scanprep.synthetic.people import SyntheticPerson, synthesise_walk

sys.path.append(str(Path(__file__).parents[1]))
from cartoons import CARTOONS, Cartoon, cartoon

MM = 1000.0
OF_SCAPE = {                         # names of the landmarks of the SCAPE template
    "{} toe": "toe in {} leg", "{} heel": "heel in {} leg", "{} knee": "knee in {} leg",
    "{} knee inside": "knee (inside) in {} leg", "{} waist": "waist {} side", "crotch": "between two legs",
    "{} middle finger": "middle finger {} hand", "{} elbow outside": "elbow (outside) {} arm",
    "{} elbow inside": "elbow (inside) {} arm", "{} shoulder": "shoulder (upper) {} side",
    "{} armpit": "shoulder (bottom) {} side", "{} nipple": "tit, {}", "navel": "cornea",
    "back": "cornea (on the back, similar position)", "neck front": "neck (front)", "neck back": "neck (back)",
    "{} eye": "eye, {}", "nose tip": "tip of nose", "mouth": "mouse (middle)", "{} ear": "ear, {}",
    "top of head": "top of head", "{} hip": "hip, {}"}
LIMB_PARTS = ("upper_arm", "forearm", "hand", "thigh", "shin", "foot")


def template_marks(model: BodyModel) -> dict[str, int]:
    """Landmarks of the template by the names of the figures'."""
    if "landmarks" in model.info:
        return dict(model.info["landmarks"])
    known = load_real().landmarks
    sides = [(name.format(side), other.format(side)) for name, other in OF_SCAPE.items() for side in ("left", "right")]
    return {name: known[other] for name, other in sides}


def on_figure(model: BodyModel, figure: Cartoon, kept: Path) -> tuple[Character, float]:
    """The figure as a model, and the seconds that its registration took; the registered mesh is kept."""
    start, marks = time.process_time(), template_marks(model)
    if kept.exists():
        return register_character(model, Mesh(np.load(kept), model.template.faces)), 0.0
    found = register_character(model, figure.mesh, figure.landmarks, marks)
    np.save(kept, found.mesh.vertices)
    return found, time.process_time() - start


def joints_off(model: BodyModel, figure: Cartoon, found: Character) -> list[float]:
    """How far the joints of the limbs lie from those that the figure was made with, metres."""
    parts = [f"{part}_{side}" for part in LIMB_PARTS for side in ("left", "right")]
    return [float(np.linalg.norm(found.joints[model.skeleton.names.index(part)] - figure.joints[part]))
            for part in parts]


def walking_man(model: BodyModel, frames: int, rate: float) -> tuple[MarkerSequence, MarkerLayout]:
    """Markers of an embedded man who walks, and their layout on the model's template."""
    person = SyntheticPerson(SUBJECT)
    layout = load_layout("cmu41", person.mesh)
    poses, trans = synthesise_walk(frames, rate)
    bodies = [person.mesh.with_vertices(person.in_pose(p, t)) for p, t in zip(poses, trans, strict=True)]
    markers = MarkerSequence(np.stack([layout.place(body) for body in bodies]), layout.labels, rate)
    return markers, load_layout("cmu41", model.template, np.array(model.info["people_vertices"]))


def measure(model: BodyModel, found: Character, soft: SoftTissue, factor: float, frames: np.ndarray) -> dict:
    """Triangles turned over, before and after creases are smoothed, and deformation, with soft tissue so many times."""
    moved = retarget_soft_tissue(soft, model, found.model, factor)
    fixed, changed = moving_character(found.model, moved, frames)
    _, person = moving_character(model, soft, frames)
    poses, row = soft.motion.poses[frames], {"factor": factor, "frames": len(frames)}
    creases = Creases(at_rest(found.model), model.skeleton)
    start = time.process_time()
    smooth = creases.smooth(changed, poses)
    row["smoothing_ms"] = MM * (time.process_time() - start) / len(frames)
    row["smoothing_moved_mm"] = MM * float(np.linalg.norm(smooth - changed, axis=2).max())
    shaped = model.template.with_vertices(model.vertices(np.zeros_like(poses[0]), soft.motion.betas))
    theirs = Creases(shaped, model.skeleton).find_inverted(person, poses)
    row["turned_on_person"] = int(theirs.sum())
    before, after = creases.find_inverted(changed, poses), creases.find_inverted(smooth, poses)
    row |= {"turned": int(before.sum()), "turned, smoothed": int(after.sum()),
            "worst_frame": int(before.sum(axis=1).max())}
    share = deformation(model.template.faces, fixed, changed)
    return row | {"deformed_mean": float(share.mean()), "deformed_most": float(np.percentile(share, 99.9)),
                  "moved_by_soft_tissue_mm": float(MM * np.linalg.norm(changed - fixed, axis=2).mean())}


def main() -> None:
    """Run and print a row for each figure and factor."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("-o", "--output", default="mosh_characters.json")
    parser.add_argument("-m", "--model", type=Path, help="of the file's person; else the embedded one")
    parser.add_argument("--c3d", type=Path, help="whose motion it is; else an embedded man walks")
    parser.add_argument("--frames", type=int, default=60, help="that are measured and shown")
    parser.add_argument("--factors", type=float, nargs="*", default=[0.0, 1.0, 2.0])
    args = parser.parse_args()
    from model.files import load_model

    args.folder.mkdir(parents=True, exist_ok=True)
    model = load_model(args.model) if args.model else load_built_in_model()
    markers, layout = walking_man(model, 120, 60.0) if args.c3d is None else \
        (read_markers(args.c3d), load_layout("cmu41", model.template))
    soft = mosh(markers, model, layout).soft_tissue[0]
    frames = np.unique(np.linspace(0, len(soft.motion.poses) - 1, args.frames).round().astype(int))
    rows = []
    for name in CARTOONS:
        figure = cartoon(name)
        found, seconds = on_figure(model, figure, args.folder / f"{name}.{len(model.template.faces)}.npy")
        off = joints_off(model, figure, found)
        about = {"figure": name, "joints_inside": f"{found.inside.sum()} of {len(found.inside)}",
                 "limb_joints_off_mm": MM * float(np.mean(off)), "worst_joint_mm": MM * max(off), "register_s": seconds}
        for factor in args.factors:
            rows.append({**about, **measure(model, found, soft, factor, frames)})
            print(rows[-1], flush=True)
        moved = retarget_soft_tissue(soft, model, found.model, max(args.factors))
        save_png(args.folder / f"{name}.png", picture_transfer(model, soft, found.model, moved))
        write_character(args.folder / f"{name}.glb", found.model, moved)
    write_report(args.output, {"motion": str(args.c3d or "embedded walk"), "machine": machine(),
                                               "rows": rows})


if __name__ == "__main__":
    main()
