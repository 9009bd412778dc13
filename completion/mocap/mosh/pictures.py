"""Pictures of a person with markers, and of what soft tissue does."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from model.body import BodyModel
from scanprep.geometry.mesh import Mesh
from scanprep.pictures.camera import Camera, look_around, upright
from scanprep.pictures.shading import Bones, Dots, Shape, Solid, color_bar, heat, render, side_by_side

from ...motion_pictures import MARKER, facing, moving_picture
from ..marker_sets.layout import MarkerLayout
from .takes import Take

USUAL, DOUBTED, UNUSED = (0.30, 0.50, 0.72), (0.93, 0.62, 0.16), (0.20, 0.62, 0.32)
SIDES = ("front", "left", "back", "right")
SHEET = 56                           # pictures on a contact sheet
LITTLE = 0.005                       # metres: the end of a colour scale that must not make much of nothing


def standing(model: BodyModel, betas: np.ndarray) -> Mesh:
    """The person in the mean pose of the training set."""
    return model.template.with_vertices(model.vertices(model.pose_mean, betas))


def picture_sides(body: Mesh, found: np.ndarray, usual: np.ndarray | None = None, labels: Sequence[str] = (),
                  height: int = 560) -> np.ndarray:
    """A body from four sides with its markers (L, 3), and where they usually sit (L, 3) with a rod from there.

    Those that moved most on each side are named by their labels.
    """
    cameras, images = look_around(body), []
    for camera in cameras:
        shapes: list[Shape] = [Solid(body), Dots(found, MARKER, 0.011)]
        if usual is not None:
            shapes += [Dots(usual, USUAL, 0.009), Bones(usual, found, USUAL, 0.004)]
        image = render(shapes, camera, _width(camera, height), height)
        if usual is not None and labels:
            image = _named(image, camera, body, found, np.linalg.norm(found - usual, axis=1), labels)
        images.append(image)
    return side_by_side(images, SIDES)


def _named(image: np.ndarray, camera: Camera, body: Mesh, found: np.ndarray, moved: np.ndarray,
           labels: Sequence[str]) -> np.ndarray:
    """The picture with the labels of at most 6 markers in sight that have moved most, none over another."""
    from PIL import Image, ImageDraw
    from scipy.spatial import cKDTree

    from scanprep.pictures.sheets import INK, font

    below = cKDTree(body.vertices).query(found)[1]
    in_sight = body.vertex_normals[below] @ camera.axes[2] > 0.3
    picture = Image.fromarray(image)
    draw, height, width = ImageDraw.Draw(picture), *image.shape[:2]
    places, taken = camera.project(found, width, height), np.zeros((0, 4))
    for i in np.argsort(-moved):
        x, y = places[i]
        for where, anchor in (((x + 9, y), "lm"), ((x - 9, y), "rm")):
            box = np.array(draw.textbbox(where, labels[i], font=font(13), anchor=anchor))
            free = not len(taken) or ((box[2:] < taken[:, :2]) | (box[:2] > taken[:, 2:])).any(axis=1).all()
            if in_sight[i] and moved[i] > 0.01 and free and box[0] > 0 and box[2] < width and len(taken) < 6:
                draw.text(where, labels[i], fill=INK, anchor=anchor, font=font(13), stroke_width=2, stroke_fill="white")
                taken = np.vstack([taken, box])
                break
    return np.asarray(picture)


def every(count: int, most: int = SHEET) -> int:
    """1, 2, 5, 10, 20, 50 ...: of so many frames, every so many make at most so many pictures."""
    power = 1
    while True:
        for step in (1, 2, 5):
            if -(-count // (step * power)) <= most:
                return step * power
        power *= 10


def contact_sheet(take: Take, frames: np.ndarray, columns: int = 8, width: int = 122) -> np.ndarray:
    """Frames of a sequence, 85% of them at one scale, the camera going along, the measured markers as dots."""
    motion, bodies = take.shown, take.bodies(frames)
    cameras = [facing(take.subject, motion.poses[t], body, 35.0) for t, body in zip(frames, bodies, strict=True)]
    tall, wide = (float(np.percentile([getattr(c, side) for c in cameras], 85)) for side in ("height", "width"))
    wide = min(max(wide, 0.5 * tall), 0.75 * tall)         # what is larger is shown smaller, not everything
    images = []
    for t, body, camera in zip(frames, bodies, cameras, strict=True):
        even = replace(camera, height=max(tall, camera.height), width=max(wide, camera.width))
        shapes: list[Shape] = [take.light.mesh(body), marker_dots(take, int(t), 0.019, coarse=True)]
        images.append(render(shapes, even, width, round(width * tall / wide)))
    return side_by_side(images, [f"{t} · {t / motion.rate:.2f} s" for t in frames], gap=4, columns=columns)


def marker_dots(take: Take, t: int, radius: float = 0.014, coarse: bool = False) -> Dots:
    """The measured markers of a frame: believed, not believed, and those that no stage has seen."""
    colors = np.where(take.motion.trusted[t][:, None], MARKER, DOUBTED)
    unused = ~np.isfinite(take.motion.residuals).any(axis=0)
    held = () if take.held is None else take.held.labels
    points = take.markers.positions[t].copy()
    for i, label in enumerate(take.markers.labels):
        if label in held:
            colors[i] = UNUSED
        elif unused[i]:
            points[i] = np.nan
    return Dots(points, colors, radius, coarse=coarse)


def picture_large(take: Take, frames: np.ndarray, height: int = 340) -> np.ndarray:
    """Some frames in a row, each as large as fits."""
    images = []
    for t, body in zip(frames, take.bodies(frames), strict=True):
        camera = facing(take.subject, take.shown.poses[t], body, 35.0)
        shapes: list[Shape] = [take.light.mesh(body), marker_dots(take, int(t))]
        images.append(render(shapes, camera, round(0.62 * height), height))
    return side_by_side(images, [f"{t} · {t / take.shown.rate:.2f} s" for t in frames])


def soft_change(take: Take, frames: np.ndarray) -> np.ndarray:
    """How far soft tissue moves the skin outwards (n, N), metres; inwards is negative."""
    rigid, soft = take.rigid(frames), take.bodies(frames)
    template = take.subject.template
    normals = np.stack([template.with_vertices(v).vertex_normals for v in rigid])
    return np.einsum("tnd,tnd->tn", soft - rigid, normals)


def picture_soft_map(take: Take, frames: np.ndarray, height: int = 460) -> np.ndarray:
    """Where the body is soft: the root mean square of the change over some frames, from four sides."""
    change = np.sqrt(((take.bodies(frames) - take.rigid(frames))**2).sum(axis=2).mean(axis=0))
    body = take.subject.template.with_vertices(
        take.subject.vertices(take.model.pose_mean).astype(float))
    end = max(float(np.percentile(change, 99.5)), LITTLE)
    images = [render(Solid(body, heat(change, 0, end)), camera, _width(camera, height), height)
              for camera in look_around(body)]
    bar = color_bar(0, end, "change of the skin, root mean square over time")
    return side_by_side([side_by_side(images, SIDES), bar], columns=1)


def picture_fixed_and_soft(take: Take, frames: np.ndarray, height: int = 400) -> np.ndarray:
    """Frames with the fixed shape above, and below with soft tissue, red where the skin moved out, blue inwards."""
    change, template = soft_change(take, frames), take.subject.template
    end = max(float(np.percentile(np.abs(change), 99.5)), LITTLE)
    rows: list[list[np.ndarray]] = [[], []]
    for t, rigid, soft, out in zip(frames, take.rigid(frames), take.bodies(frames), change, strict=True):
        camera = facing(take.subject, take.shown.poses[t], soft, 35.0)
        width = round(0.62 * height)
        rows[0].append(render([Solid(template.with_vertices(rigid)), marker_dots(take, int(t), 0.010)], camera, width,
                              height))
        rows[1].append(render([Solid(template.with_vertices(soft), heat(out, -end, end, "coolwarm")),
                               marker_dots(take, int(t), 0.010)], camera, width, height))
    seconds = [f"{t} · {t / take.shown.rate:.2f} s" for t in frames]
    return side_by_side([side_by_side(rows[0]), side_by_side(rows[1], seconds),
                         color_bar(-end, end, "skin moved inwards (-) and outwards", "coolwarm")], columns=1)


def most_changed(take: Take, frames: np.ndarray, count: int) -> np.ndarray:
    """Of some frames those, in order, in which soft tissue moves the body most, no two close in time."""
    size = np.sqrt((soft_change(take, frames)**2).mean(axis=1))
    apart = len(take.motion.poses) / (3 * count)
    chosen: list[int] = []
    for t in frames[np.argsort(-size)].tolist():
        if len(chosen) < count and all(abs(t - other) >= apart for other in chosen):
            chosen.append(t)
    return np.sort(chosen)


def moving(take: Take, seconds: float = 4.0, rate: float = 6.0) -> bytes:
    """The first seconds as an endless picture."""
    motion = take.shown
    span = max(1, min(len(motion.poses), round(seconds * motion.rate)))
    frames = np.arange(0, span, max(1, round(motion.rate / rate)))
    shown = take.bodies(frames)[:, take.light.vertex_ids]
    return moving_picture(shown, take.subject, motion.rate * len(frames) / span, 240, 320, take.light.faces,
                          motion.poses[frames[len(frames) // 2]])


def change_of_place(body: Mesh, layout: MarkerLayout, found: MarkerLayout) -> tuple[np.ndarray, np.ndarray]:
    """Where markers sit on a body (L, 3) metres, and from where they usually sit: up, forward, to its left (L, 3)."""
    up, front = upright(body)
    across = [(up + 1) % 3, (up + 2) % 3]
    axes = np.zeros((3, 3))
    axes[0, up] = 1
    axes[1, across] = np.cos(np.radians(front)), np.sin(np.radians(front))
    axes[2] = np.cross(axes[0], axes[1])
    places = found.place(body)
    return places, (places - layout.place(body)) @ axes.T


def _width(camera: Camera, height: int) -> int:
    return max(120, round(height * camera.width / camera.height) + 8)
