"""One picture of a depth camera: a dressed person, cut off by the border of the picture, in front of a wall.

    SCAPEKIT_DATA=... python tests/benchmarks/depth_camera.py -o depth_camera.json [--model FILE] [--pictures DIR]
    SCAPEKIT_DATA=... python tests/benchmarks/depth_camera.py --tuning --only 0 1 2 --marks up 4 -o tuning.json

The virtual camera has 640 x 480 pixels and the field of view of a Kinect, 57 by 43 degrees, and stands 0.8 to 2.5 m
away. Noise along the optical axis grows with the square of the distance; at edges a third of the pixels are lost and
a third fly between the two surfaces; what grazes is lost. The body wears clothes, smooth offsets of 5 to 40 mm with
folds, on all but head, hands and feet; it is cut off at hips, knees or neck; a floor is under it and a wall behind.
Every other camera is rolled: upside down, on its side, or by a few degrees. Bodies are in turns SCAPE poses and SPRING
men, of unknown shape to the completion. The model is learned from poses at indices 2, 3 and 4 (mod 5) and men at 0, 1
and 4; tuned is on poses and men at 1 and 3, and what is reported is at 0 and 2, with other cameras and clothes.

Each case is tried blind (no landmark), *up* (no landmark, the direction that is up told), and with 4 and 7 landmarks
that are off by 5 mm. Errors are those of corresponding vertices of the undressed body, *within* the picture, whether
seen or not, and *beyond* it. A result is *right* when the head is off by less than 100 mm and every other part by less
than 150 mm in the mean, over the parts of which a fifth was seen, as in half views: where nothing was seen the place is
a guess. *Within right* is over all parts of which half is within the picture, hidden or not, *all right* over all.

Pictures of nobody, of two people and of one leg have to be refused, those of one person not.

A run goes on where the one before stopped: what stands in the output already is not done again.
"""
from __future__ import annotations

import argparse
import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from protocols import RealData, load_real, machine, write_report

from completion.partial.completion import Completion, complete
from completion.partial.settings import CompletionConfig
from model import LearnConfig, learn_scape
from model.body import BodyModel
from model.files import load_model
from scanprep.depth_camera.person import segment_person
from scanprep.depth_camera.picture import DepthPicture
from scanprep.geometry.farthest_points import farthest_points
from scanprep.geometry.geodesics import SurfaceGraph
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Rays
from scanprep.judgement import size
from scanprep.skeleton.find import find_skeleton

SIZE, FOCAL = (480, 640), 589.0
NOISE = 0.0015                       # metres at one metre
GRAZING = 0.15
SHIFTED, LOST = 0.33, 0.33           # shares of the pixels at edges
CASES = 20
CUTS = ("hips", "knees", "hips", "neck")
MARKS = ("blind", "up", "4", "7")
BARE = {"top of head": 0.26, "middle finger right hand": 0.2, "middle finger left hand": 0.2,
        "heel in right leg": 0.2, "heel in left leg": 0.2}            # metres of skin around these landmarks
RIGHT, HEAD = 150.0, 100.0           # mm
SHOWN = 0.2                          # share of a part's vertices, as in half views


@dataclass(frozen=True, eq=False)
class Case:
    """A body before a camera; all in the camera's frame."""

    name: str
    body: Mesh
    dressed: Mesh
    picture: DepthPicture
    seen: np.ndarray                 # (N,) bool
    within: np.ndarray               # (N,) bool: in the picture, whether seen or hidden
    up: np.ndarray                   # (3,)
    facts: dict[str, Any]

    def landmarks(self, names: dict[str, int], count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Some that are seen, and where a user clicks them: on the clothes, 5 mm off; others where too few are seen."""
        seen = np.array([v for v in names.values() if self.seen[v]])
        chosen = seen[np.unique(np.round(np.linspace(0, len(seen) - 1, count)).astype(int))]
        more = np.flatnonzero(self.seen)[farthest_points(self.body.vertices[self.seen], count, 0)]
        chosen = np.r_[chosen, more[:count - len(chosen)]]
        return chosen, self.dressed.vertices[chosen] + rng.normal(0, 0.005 / np.sqrt(3), (len(chosen), 3))


def clothes(template: Mesh, landmarks: dict[str, int]) -> np.ndarray:
    """(N,) how much of the clothes is worn at each vertex: 0 on bare skin, 1 elsewhere."""
    worn = np.ones(len(template.vertices))
    for name, bare in BARE.items():
        away, _ = SurfaceGraph(template).nearest(np.array([landmarks[name]]))
        worn *= np.clip((away - bare) / 0.03, 0, 1)
    return worn


def dressed(body: Mesh, template: Mesh, worn: np.ndarray, rng: np.random.Generator) -> Mesh:
    """The body in clothes: offsets of 5 to 40 mm that change over half a metre, and folds of a few millimetres."""
    x = template.vertices
    smooth, folds = np.zeros(len(x)), np.zeros(len(x))
    for _ in range(6):
        smooth += np.sin(x @ _wave(rng, 0.4, 0.9) + rng.uniform(0, 2 * np.pi)) / 6
        folds += np.sin(x @ _wave(rng, 0.06, 0.12) + rng.uniform(0, 2 * np.pi)) / 6
    offset = 0.005 + 0.03 * np.clip(0.5 + smooth, 0, 1) + 0.012 * np.clip(folds, -0.4, 0.4)
    return body.with_vertices(body.vertices + (worn * np.clip(offset, 0.003, 0.04))[:, None] * body.vertex_normals)


def _wave(rng: np.random.Generator, shortest: float, longest: float) -> np.ndarray:
    direction = rng.normal(size=3)
    return 2 * np.pi / rng.uniform(shortest, longest) * direction / np.linalg.norm(direction)


def make_case(data: RealData, worn: np.ndarray, k: int, tuning: bool) -> Case:
    """The k-th case."""
    rng = np.random.default_rng([k, tuning])
    poses, men = np.arange(1 if tuning else 0, 71, 5), np.arange(3 if tuning else 2, 227, 5)
    person, index = k % 2 == 1, (men if k % 2 else poses[poses != 0])[(4 * (k // 2) + k // 10) % (44 if k % 2 else 14)]
    vertices = (data.shapes if person else data.poses)[index]
    cut = CUTS[k // 2 % len(CUTS)]
    roll = np.deg2rad([0, 180, rng.uniform(-12, 12), (90, -90, 180, 0)[k // 4 % 4]][k % 4])
    body = data.template.with_vertices(vertices)
    camera, away, R = _camera(body, cut, k, roll, data.landmarks, rng)
    clad = dressed(body, data.template, worn, rng)
    back = float(((vertices - camera) @ R[2]).max() + rng.uniform(0.3, 1.5))
    body, clad = (m.with_vertices((m.vertices - camera) @ R.T) for m in (body, clad))
    floor = float(vertices[:, 2].min() - camera[2])
    up = R[:, 2]
    picture, clean = _taken(clad, up, floor, back, rng)
    row, column, within = picture.project(clad.vertices)
    near = np.abs(clad.vertices[:, 2] - clean[row, column]) < 0.02
    facing = np.einsum("nd,nd->n", clad.vertex_normals, -clad.vertices) > 0.1 * np.linalg.norm(clad.vertices, axis=1)
    facts = {"k": k, "body": "man" if person else "pose", "index": int(index), "cut": cut,
             "roll": round(float(np.degrees(roll))), "distance_m": round(float(away), 2)}
    return Case(f"{k:02d}", body, clad, picture, within & near & facing, within, up, facts)


def _camera(body: Mesh, cut: str, k: int, roll: float, landmarks: dict[str, int], rng: np.random.Generator
            ) -> tuple[np.ndarray, float, np.ndarray]:
    """Place (3,), distance, and axes (3, 3) right, down, ahead of a camera whose picture ends where the body is cut."""
    v = body.vertices
    marks = {"hips": ("hip, right", "hip, left"), "knees": ("knee in right leg", "knee in left leg"),
             "neck": ("neck (front)", "neck (back)")}[cut]
    level = np.mean([v[landmarks[name], 2] for name in marks])
    pixels = SIZE[1] if abs(np.sin(roll)) > 0.7 else SIZE[0]
    whole = 0.9 if cut == "neck" else v[:, 2].max() + 0.05 - level
    away = float(np.clip(whole * FOCAL / pixels + rng.uniform(0, 0.5), 0.8, 2.5))
    half, pitch = 0.5 * away * pixels / FOCAL, rng.uniform(-0.12, 0.12)
    centre = np.r_[v[:, :2].mean(axis=0) + rng.normal(0, 0.04, 2), level + (-half if cut == "neck" else half)]
    azimuth = np.deg2rad(137.5 * k + rng.uniform(0, 60))
    ahead = -np.array([np.cos(pitch) * np.cos(azimuth), np.cos(pitch) * np.sin(azimuth), np.sin(pitch)])
    right = np.cross(ahead, [0, 0, 1])
    right /= np.linalg.norm(right)
    down = np.cross(ahead, right)
    c, s = np.cos(roll), np.sin(roll)
    return centre - away * ahead, away, np.stack([c * right + s * down, c * down - s * right, ahead])


def _taken(clad: Mesh, up: np.ndarray, floor: float, back: float, rng: np.random.Generator
           ) -> tuple[DepthPicture, np.ndarray]:
    """The picture with all that sensors do to it, and the clean distances (h, w), metres."""
    h, w = SIZE
    K = np.array([[FOCAL, 0, (w - 1) / 2], [0, FOCAL, (h - 1) / 2], [0, 0, 1.0]])
    empty = DepthPicture(np.full(SIZE, np.nan), K)
    row, column = np.indices(SIZE)
    rays = empty.directions(column, row)
    unit = (rays / np.linalg.norm(rays, axis=2, keepdims=True)).reshape(-1, 3)
    face, far = Rays(clad).cast(np.zeros((h * w, 3)), unit)
    slope = np.where(face >= 0, -np.einsum("nd,nd->n", clad.face_normals[face], unit), 1.0).reshape(h, w)
    person = np.nan_to_num((far * unit[:, 2]).reshape(h, w), nan=np.inf)
    wall_normal = np.array([0, 0, 1.0]) - up[2] * up
    wall_normal /= np.linalg.norm(wall_normal)
    with np.errstate(divide="ignore"):
        ground = floor / (rays @ up)
        wall = back / (rays @ wall_normal)
    clean = np.minimum.reduce([person, np.where(ground > 0, ground, np.inf), np.where(wall > 0, wall, np.inf)])
    slope[~(person <= clean)] = 1.0
    depth = clean + NOISE * clean**2 * rng.normal(size=SIZE)
    depth[slope < GRAZING] = np.nan
    low, high = _extremes(clean)
    edge, draw = high - low > 0.06, rng.uniform(size=SIZE)
    depth = np.where(edge & (draw < SHIFTED), low + rng.uniform(size=SIZE) * (high - low), depth)
    depth[edge & (draw > 1 - LOST)] = np.nan
    depth[(depth > 6) | ~np.isfinite(depth) | (depth < 0.4)] = np.nan
    return DepthPicture.of(np.round(depth, 3), K), clean


def _extremes(depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    from scipy import ndimage

    return ndimage.minimum_filter(depth, 3), ndimage.maximum_filter(depth, 3)


def errors(case: Case, result: Completion, part: np.ndarray, names: tuple[str, ...]) -> dict[str, Any]:
    """Figures of one completion, millimetres."""
    apart = 1e3 * np.linalg.norm(result.completed.vertices - case.body.vertices, axis=1)
    of_part = np.array([apart[part == p].mean() for p in range(len(names))])
    shown = np.array([case.seen[part == p].mean() >= SHOWN for p in range(len(names))])
    bound = np.array([HEAD if name == "head" else RIGHT for name in names])
    inside = np.array([case.within[part == p].mean() >= 0.5 for p in range(len(names))])
    worst = int(np.argmax(np.where(shown, of_part, 0)))
    return {"seen_mm": apart[case.seen].mean(), "within_mm": apart[case.within].mean(),
            "beyond_mm": apart[~case.within].mean() if not case.within.all() else None,
            "worst_part": names[worst], "worst_part_mm": of_part[worst], "worst_of_all_mm": of_part.max(),
            "right": bool((of_part < bound)[shown].all()), "within_right": bool((of_part < bound)[inside].all()),
            "all_right": bool((of_part < bound).all())}


def attempt(case: Case, body: BodyModel, data: RealData, marks: str, part: np.ndarray
            ) -> tuple[dict[str, Any], Completion | None]:
    """A row, and the completion unless it was refused."""
    rng, start, cpu = np.random.default_rng(7), time.perf_counter(), time.process_time()
    config = CompletionConfig(up=tuple(case.up)) if marks == "up" else CompletionConfig()
    pairs = case.landmarks(data.landmarks, int(marks), rng) if marks.isdigit() else None
    row = {**case.facts, "marks": marks}
    try:
        result = complete(body, case.picture, pairs, config)
    except ValueError as error:
        return {**row, "judgement": "failed", "reasons": [str(error)], "right": False, "within_right": False,
                "all_right": False}, None
    row |= errors(case, result, part, body.skeleton.names)
    judged = result.judgement
    assert judged is not None, "complete judges"
    return {**row, "judgement": judged.verdict, "reasons": list(judged.reasons), "explained": result.explained,
            "converged": result.converged, "seconds": round(time.perf_counter() - start, 1),
            "cpu_seconds": round(time.process_time() - cpu, 1)}, result


def scenes(data: RealData, worn: np.ndarray, part: np.ndarray, names: tuple[str, ...], tuning: bool, every: int = 3
           ) -> list[tuple[str, DepthPicture]]:
    """Pictures with one person, nobody, two people side by side, and a leg alone, of every third of the men."""
    leg = np.isin(part, [p for p, name in enumerate(names) if name in ("thigh_left", "shin_left", "foot_left")])
    out = []
    for k, man in enumerate(np.arange(3 if tuning else 2, 227, 5)[::every]):
        rng, v = np.random.default_rng([k, tuning]), data.shapes[man]
        camera, _, R = _camera(data.template.with_vertices(v), "knees", k, 0.0, data.landmarks, rng)
        clad = dressed(data.template.with_vertices(v), data.template, worn, rng)
        aside = 0.45 * R[0] + rng.uniform(0, 0.4) * R[2]
        two = Mesh(np.vstack([clad.vertices - aside, clad.vertices + aside]),
                   np.vstack([clad.faces, clad.faces + len(v)]))
        low = np.r_[camera[:2], v[:, 2].min() + 0.45]
        for name, mesh, place in (("one", clad, camera), ("nobody", clad, camera + 4 * R[0]),
                                  ("two", two, camera - 0.6 * R[2]),
                                  ("leg", clad.submesh(leg[clad.faces].all(axis=1))[0], low)):
            seen = mesh.with_vertices((mesh.vertices - place) @ R.T)
            out.append((name, _taken(seen, R[:, 2], float(v[:, 2].min() - place[2]), 3.0, rng)[0]))
    return out


def refusals(found: list[tuple[str, DepthPicture]], body: BodyModel) -> dict[str, dict[str, int]]:
    """How many pictures of each kind were taken for one person, and how many refused."""
    counts: dict[str, dict[str, int]] = {}
    for name, picture in found:
        mine = counts.setdefault(name, {"accepted": 0, "refused": 0})
        try:
            segment_person(picture, size(body.template))
            mine["accepted"] += 1
        except ValueError:
            mine["refused"] += 1
    return counts


def picture_of(case: Case, result: Completion | None, path: Path) -> None:
    """The depth picture, then truth (dressed, points of the picture) and result from the camera and from its side."""
    from scanprep.pictures.camera import Camera
    from scanprep.pictures.shading import Dots, Solid, render
    from scanprep.pictures.sheets import contact_sheet, save_png

    depth = np.nan_to_num(case.picture.depth[::2, ::2], nan=0.0)
    grey = np.repeat((255 * np.clip(1 - (depth - 0.5) / 3.5, 0, 1) * (depth > 0))[..., None], 3, axis=2)
    canvas = np.full((400, 320, 3), 255, np.uint8)
    canvas[:240] = grey.astype(np.uint8)
    upright = np.stack([np.cross(case.up, [0, 0, 1]), np.cross(np.cross(case.up, [0, 0, 1]), case.up), case.up])
    upright /= np.linalg.norm(upright, axis=1, keepdims=True)
    turned = [m.with_vertices(m.vertices @ upright.T) for m in
              (case.body, *([result.completed, result.predicted] if result else []))]
    dots = Dots(case.dressed.vertices[case.seen][::25] @ upright.T, (0.2, 0.4, 0.9), 0.008, coarse=True)
    images = [canvas]
    for turn in (-90, 0):
        images += [render([Solid(mesh), dots], Camera.around([turned[0].vertices], turn, margin=1.5), 320, 400)
                   for mesh in turned]
    save_png(path, contact_sheet(images, columns=len(images)))


def learned(data: RealData, path: Path | None) -> BodyModel:
    """The model, read from a file where it lies already."""
    if path is not None and path.exists():
        return load_model(path)
    i, j = np.arange(len(data.poses)), np.arange(len(data.shapes))
    poses, men = data.poses[(i % 5 >= 2) | (i == 0)], data.shapes[np.isin(j % 5, (0, 1, 4))][::3]
    model = learn_scape(data.template, poses, men, find_skeleton(data.template, poses), LearnConfig(components=20))
    if path is not None:
        model.save(path)
    return model


def summary(rows: list[dict[str, Any]]) -> dict[str, float]:
    """Shares and means for each number of landmarks."""
    out: dict[str, float] = {}
    for marks in MARKS:
        mine = [row for row in rows if row["marks"] == marks]
        if not mine:
            continue
        for name in ("within_mm", "beyond_mm", "seconds", "cpu_seconds"):
            values = [row[name] for row in mine if row.get(name) is not None]
            if values:
                out[f"{marks}_{name}"] = float(np.mean(values))
                if name.endswith("_mm"):
                    out[f"{marks}_{name[:-3]}_median_mm"] = float(np.median(values))
        out[f"{marks}_cases"] = len(mine)
        for right in ("right", "within_right", "all_right"):
            flagged = [(row[right], row["judgement"] != "good") for row in mine]
            out[f"{marks}_{right}"] = float(np.mean([is_right for is_right, _ in flagged]))
            out[f"{marks}_{right}_not"] = sum(not is_right for is_right, _ in flagged)
            out[f"{marks}_{right}_not_and_flagged"] = sum(flag for is_right, flag in flagged if not is_right)
            out[f"{marks}_{right}_but_flagged"] = sum(flag for is_right, flag in flagged if is_right)
    return out


def main() -> None:
    """Complete every picture and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", default="depth_camera.json")
    parser.add_argument("--tuning", action="store_true", help="other bodies, cameras and clothes")
    parser.add_argument("--only", type=int, nargs="*", default=list(range(CASES)))
    parser.add_argument("--marks", nargs="*", choices=MARKS, default=list(MARKS))
    parser.add_argument("-m", "--model", type=Path, help="where the model is kept")
    parser.add_argument("--pictures", type=Path, help="folder for a picture of each")
    args = parser.parse_args()
    data = load_real()
    model = learned(data, args.model)
    worn, part = clothes(data.template, data.landmarks), model.skeleton.part_of_vertex(data.template)
    output = Path(args.output)
    who = refusals(scenes(data, worn, part, model.skeleton.names, args.tuning), model)
    print(who)
    rows = json.loads(output.read_text())["rows"] if output.exists() else []
    done = {(row["k"], row["marks"]) for row in rows}
    for k in args.only:
        case = make_case(data, worn, k, args.tuning)
        for marks in (marks for marks in args.marks if (k, marks) not in done):
            row, result = attempt(case, model, data, marks, part)
            rows.append(row)
            print({name: round(v, 3) if isinstance(v, float) else v for name, v in row.items()}, flush=True)
            if args.pictures:
                picture_of(case, result, args.pictures / f"{case.name}_{marks}.png")
        mean = summary(rows)
        write_report(output, {"protocol": "depth camera", "tuning": args.tuning, "machine": machine(), "mean": mean,
                              "taken_for_one_person": who, "rows": rows})
    for name, value in mean.items():
        print(f"{name:32s} {value:8.2f}")


if __name__ == "__main__":
    main()
