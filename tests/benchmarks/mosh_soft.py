"""Soft tissue of known size: how much of a simulated jiggle is found, with how many markers.

    python tests/benchmarks/mosh_soft.py FOLDER -m MODEL.npz -o mosh_soft.json [--file 02_05] [--frames 240]
        [--picture worst.png]

A person moves as in a recording, with 1 mm of noise on every coordinate of the markers. On waist, chest, thighs,
buttocks and calves, left and right, a bump of the skin swings along the normals by 10 mm: exp(-(d / R)²) at distance d
along the skin, R drawn between 6 and 12 cm, its centre within 6 cm of a point of the anatomy, its phase drawn, its
frequency 2, 5, 10 or 15 Hz. In four runs every place has every frequency once. Betas make up little of such a bump:
`betas_share` is what of its energy the best change of all betas has. `still` is the same without bumps.

For every bump: `amplitude` and `phase` (degrees) of what soft tissue moves its skin at that frequency against the
truth, by complex regression; `with_pose` is the amplitude of the whole skin, which the pose moves too. `spacing` is how
far apart markers are there: 2.6 times the mean distance of the region (weight above a half) from its nearest marker, as
on a square grid. Also the distance of the whole skin from the true one, with fixed shape and with soft tissue, and the
root mean square of what soft tissue moves it (mm). 90 markers are the 67, and farthest points where the bumps are.

`--picture` shows, a row for every number of markers, the bump below 12 cm of which least was found, when it swings
farthest: how far the true skin is out, and what was found of it.
"""
from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from protocols import machine, write_report

from completion.mocap.files.markers import MarkerSequence, read_markers
from completion.mocap.marker_sets.layout import MarkerLayout
from completion.mocap.marker_sets.named import load_layout
from completion.mocap.mosh.mosh import MoshConfig
from completion.mocap.pose.follow import animate
from completion.mocap.pose.marked_body import supports
from completion.mocap.soft_tissue.follow import follow_soft_tissue
from completion.mocap.soft_tissue.soft_tissue import SoftTissue
from completion.mocap.subject.person import find_person
from completion.motion import Motion
from model.body import BodyModel
from model.files import load_model
from model.fitting.energy import rise_above_skin
from scanprep.geometry.geodesics import SurfaceGraph
from scanprep.pictures.camera import Camera, guess_upright
from scanprep.pictures.colors import Heat
from scanprep.pictures.shading import Dots, Solid, render, save_png

PLACES = {"waist": ("LBEL", "RBEL"), "chest": ("LPEC", "RPEC"), "thigh": ("LQUA", "RQUA"), "buttock": ("LGLU", "RGLU"),
          "calf": ("LCAL", "RCAL")}
FREQUENCIES = (2.0, 5.0, 10.0, 15.0)
SIZE, NOISE, NEAR = 0.010, 0.001, 0.06                  # metres
RADIUS = (0.06, 0.12)                                   # metres
CLASSES = {"spacing below 12 cm": (0, 12), "12 to 16 cm": (12, 16), "above 16 cm": (16, np.inf)}
SAMPLED = 8                                             # every so many vertices are the whole skin


@dataclass(frozen=True, eq=False)
class Bump:
    """A region of the skin that swings."""

    region: str
    weight: np.ndarray          # (N,)
    radius: float               # metres
    frequency: float            # hertz
    phase: float                # radians

    def swing(self, t: np.ndarray) -> np.ndarray:
        return SIZE * np.sin(2 * np.pi * self.frequency * t + self.phase)

    def regression(self, moved: np.ndarray, normals: np.ndarray, t: np.ndarray) -> complex:
        """What skin that moves (T, n, 3) has of the swing: 1 is all of it, in phase."""
        w = self.weight[::SAMPLED]
        along = np.einsum("n,tnd,tnd->t", w, moved, normals) / (w**2).sum()
        turn = 2 * np.pi * self.frequency * t
        sine, cosine, *_ = np.linalg.lstsq(np.stack([np.sin(turn), np.cos(turn), np.ones(len(t)), t], 1), along,
                                           rcond=None)[0]
        return complex(sine, cosine) / (SIZE * np.exp(1j * self.phase))


class Scene:
    """A person in motion, and bumps for each run."""

    def __init__(self, model: BodyModel, motion: Motion) -> None:
        self.model, self.motion, self.graph = model, motion, SurfaceGraph(model.template)
        self.subject = model.subject(motion.betas)
        self.skin = motion.vertices(self.subject)
        self.normals = np.array([model.template.with_vertices(v).vertex_normals for v in self.skin])
        self.marks = load_layout("mosh67", model.template)
        D = model.shape_jacobian(model.pose_mean)
        self.area = np.sqrt(model.template.vertex_areas)
        self.betas = np.linalg.qr((self.area[:, None, None] * D).reshape(-1, D.shape[-1]))[0]
        self.at_rest = model.template.with_vertices(model.vertices(model.pose_mean, motion.betas)).vertex_normals

    def vertex(self, label: str) -> int:
        return int(self.marks.nearest[self.marks.labels.index(label)])

    def bumps(self, run: int) -> list[Bump]:
        """The same for every layout."""
        rng, out = np.random.default_rng(run), []
        for i, (region, labels) in enumerate(PLACES.items()):
            for side, label in enumerate(labels):
                near = np.flatnonzero(self.graph.distances(self.vertex(label), limit=NEAR) < NEAR)
                radius = rng.uniform(*RADIUS)
                far = self.graph.distances(int(rng.choice(near)), limit=4 * radius)
                out.append(Bump(region, np.exp(-(far / radius)**2), radius,
                                FREQUENCIES[(i + run + 2 * side) % len(FREQUENCIES)], rng.uniform(0, 2 * np.pi)))
        return out

    def moved(self, bumps: list[Bump]) -> np.ndarray:
        """The true skin (T, N, 3)."""
        out = self.skin.copy()
        for bump in bumps:
            some = np.flatnonzero(bump.weight)
            out[:, some] += bump.swing(self.motion.times)[:, None, None] * (
                bump.weight[some, None] * self.normals[:, some])
        return out

    def betas_share(self, bump: Bump) -> float:
        """What share of the energy of a bump the best change of betas has."""
        wanted = (self.area[:, None] * bump.weight[:, None] * self.at_rest).ravel()
        return float(((self.betas.T @ wanted)**2).sum() / (wanted**2).sum())

    def spacing(self, bump: Bump, layout: MarkerLayout) -> float:
        """How far apart the markers are at a bump, centimetres."""
        nearest, _ = self.graph.nearest(layout.nearest)
        return 100 * float(nearest[bump.weight > 0.5].mean()) / 0.383

    def layouts(self) -> dict[int, MarkerLayout]:
        """By their number of markers."""
        soft = np.flatnonzero(self.graph.nearest(np.array([self.vertex(label) for labels in PLACES.values()
                                                           for label in labels]))[0] < 2 * NEAR)
        chosen = list(self.marks.nearest)
        while len(chosen) < 90:
            chosen.append(int(soft[np.argmax(self.graph.nearest(np.array(chosen))[0][soft])]))
        more = np.array(chosen[len(self.marks.labels):])
        dense = self.marks.merge(MarkerLayout(tuple(f"M{i}" for i in range(len(more))), more))
        return {41: load_layout("cmu41", self.model.template), 67: self.marks, 90: dense}

    def found(self, truth: np.ndarray, layout: MarkerLayout, seed: int) -> tuple[Motion, SoftTissue]:
        """The motion of fixed shape and that with soft tissue, from the markers of a true skin."""
        ids, weights = supports(self.model.template, layout)
        places = rise_above_skin(np.einsum("lk,tlkd->tld", weights, truth[:, ids]), np.asarray(layout.distances))
        noise = np.random.default_rng(seed).normal(0, NOISE, places.shape)
        markers = MarkerSequence(places + noise, layout.labels, self.motion.rate)
        fixed = animate(self.subject, markers, layout, MoshConfig().poses)
        return fixed, follow_soft_tissue(self.model, fixed, markers, layout)


def run(scene: Scene, layout: MarkerLayout, bumps: list[Bump], seed: int) -> tuple[list[dict], dict[str, float]]:
    """A row for each bump, and what the whole skin is off."""
    truth = scene.moved(bumps)
    motion, soft = scene.found(truth, layout, seed)
    some = slice(None, None, SAMPLED)
    poses, trans = soft.motion.poses, soft.motion.trans
    fixed, own = (scene.subject.vertices(*at)[:, some] for at in ((motion.poses, motion.trans), (poses, trans)))
    alone = soft.skin.at(soft.skin.modes[some], poses)
    rows = []
    for bump in bumps:
        share, whole = (bump.regression(moved, scene.normals[:, some], motion.times)
                        for moved in (alone, own + alone - scene.skin[:, some]))
        rows.append({"region": bump.region, "radius_cm": 100 * bump.radius, "frequency": bump.frequency,
                     "spacing_cm": scene.spacing(bump, layout), "amplitude": abs(share),
                     "phase_deg": float(np.degrees(np.angle(share))), "with_pose": abs(whole),
                     "betas_share": scene.betas_share(bump)})
    off = {"fixed_mm": fixed, "soft_mm": own + alone}
    return rows, {**{name: 1e3 * float(np.linalg.norm(skin - truth[:, some], axis=2).mean())
                     for name, skin in off.items()}, "moved_rms_mm": 1e3 * float(np.sqrt((alone**2).sum(2).mean()))}


def picture(scene: Scene, layout: MarkerLayout, number: int, bump: Bump) -> np.ndarray:
    """The true and the found displacement of the skin along its normals, in the frame when a bump of a run is farthest.
    """
    truth = scene.moved(scene.bumps(number))
    _, soft = scene.found(truth, layout, number)
    t = int(np.argmax(np.abs(bump.swing(scene.motion.times))))
    found = soft.skin.at(soft.skin.modes, soft.motion.poses[[t]])[0]
    mesh, centre = scene.model.template.with_vertices(scene.skin[t]), int(np.argmax(bump.weight))
    vertical = np.eye(3)[guess_upright(mesh)[0]]
    near = mesh.vertices[bump.weight > 0.05]
    camera = Camera.from_side(near, scene.normals[t, centre], vertical, margin=1.6)
    dots = Dots(mesh.vertices[layout.nearest], (0.1, 0.1, 0.1), 0.006)
    out = [np.einsum("nd,nd->n", moved, scene.normals[t]) for moved in (truth[t] - scene.skin[t], found)]
    shown = [[Solid(mesh, Heat(far, -SIZE, SIZE)), dots] for far in out]
    return np.concatenate([render(shapes, camera, 420, 420) for shapes in shown], axis=1)


def summary(markers: int, where: str, rows: list[dict]) -> dict[str, object]:
    """The means of some bumps."""
    amplitude = np.array([row["amplitude"] for row in rows])
    at = {f"{f:g} Hz": float(np.mean(mine)) for f in FREQUENCIES
          if len(mine := [r["amplitude"] for r in rows if r["frequency"] == f])}
    return {"markers": markers, "where": where, "bumps": len(rows), "amplitude": float(amplitude.mean()), **at,
            "least": float(amplitude.min()), "with_pose": float(np.mean([r["with_pose"] for r in rows])),
            "phase_deg": float(np.mean([abs(r["phase_deg"]) for r in rows])),
            "betas_share": float(np.mean([r["betas_share"] for r in rows]))}


def main() -> None:
    """Run and print the rows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("-m", "--model", required=True)
    parser.add_argument("-o", "--output", default="mosh_soft.json")
    parser.add_argument("--file", default="02_05", help="stem of the recording")
    parser.add_argument("--frames", type=int, default=240, help="from its middle")
    parser.add_argument("--runs", type=int, default=len(FREQUENCIES))
    parser.add_argument("--picture", help="write the bumps of which least was found here")
    args = parser.parse_args()
    model, whole = load_model(args.model), read_markers(args.folder / f"{args.file}.c3d")
    layout = load_layout("cmu41", model.template)
    first = max(0, (len(whole.positions) - args.frames) // 2)
    person = find_person(model, whole, layout)
    scene = Scene(model, animate(model.subject(person.betas), whole.frames(slice(first, first + args.frames)),
                                 person.layout, MoshConfig().poses))
    rows: list[dict] = []
    details: list[dict] = []
    pictures: list[np.ndarray] = []
    for count, layout in scene.layouts().items():
        bumps: list[dict] = []
        skins = []
        for i in range(args.runs):
            found, skin = run(scene, layout, scene.bumps(i), i)
            bumps += found
            skins.append(skin)
        for where, (low, high) in CLASSES.items():
            mine = [row for row in bumps if low <= row["spacing_cm"] < high]
            rows += [summary(count, where, mine)] if mine else []
        for region in PLACES:
            mine = [row for row in bumps if row["region"] == region and row["spacing_cm"] < 12]
            rows += [summary(count, f"{region}, below 12 cm", mine)] if mine else []
        rows.append({"markers": count, "where": "whole skin",
                     **{name: float(np.mean([skin[name] for skin in skins])) for name in skins[0]}})
        rows.append({"markers": count, "where": "whole skin, still", **run(scene, layout, [], 0)[1]})
        details += [{"markers": count, **row} for row in bumps]
        if args.picture:
            dense = [i for i, row in enumerate(bumps) if row["spacing_cm"] < 12]
            number, place = divmod(min(dense, key=lambda i: bumps[i]["amplitude"]), len(bumps) // args.runs)
            pictures.append(picture(scene, layout, number, scene.bumps(number)[place]))
        for row in rows:
            if row["markers"] == count:
                print("  ".join(f"{name} {value:.3g}" if isinstance(value, float) else f"{value}"
                                for name, value in row.items()), flush=True)
    if pictures:
        save_png(args.picture, np.concatenate(pictures))
    write_report(args.output, {"protocol": f"swinging skin on the motion of {args.file}, {args.frames} frames",
                               "machine": machine(), "rows": rows, "bumps": details})


if __name__ == "__main__":
    main()
