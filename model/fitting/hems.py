"""Hems of clothes: edges along limbs where a scan steps from cloth down to skin, at the same place left and right.

Clothes that follow the body look like a stouter body. Their ends do not: a body has no step of some millimetres around
both arms or both legs. Boots begin with a step outward.
"""
from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from scanprep.geometry.mesh import Mesh
from scanprep.skeleton.tree import Skeleton

RING, MEAN, SHIFT = 0.008, 2, 3      # metres along the limb; rings in a mean; rings by which left and right may differ
FIRST = 0.10                         # metres from hip and shoulder, where the trunk begins
# Metres of a step on both legs, on both arms, and of both together. Largest of 142 naked people: 0.0049, 0.0056 and
# 0.0082; of 57 real men: 0.0048, 0.0054 and 0.0100.
LEGS, ARMS, BOTH = 0.0054, 0.0060, 0.0102
SHIN, ANKLE = 0.55, 0.06             # boots begin below this share of a leg's length, and so far above its end, metres
SOME = 0.003                         # metres: a step that counts once another one is found
# Cuffs of close suits are askew, so edges across tilted planes are looked for, metres from the wrist, as seen through a
# narrow and a wider window; metres of both together on either arm. 12 of 23 suits of 5 to 6 mm have more, none of 199
# naked people, two of 30 very heavy ones. No edge at neck or ankles tells the others.
CUFF, TILTS, WINDOWS, CUFFS = np.arange(-0.05, 0.01, 0.003), (-0.4, -0.2, 0.0, 0.2, 0.4), (0.014, 0.02), 0.0202


@dataclass(frozen=True, eq=False)
class Limb:
    """Where the vertices of a limb are: metres from hip or shoulder along it, NaN elsewhere, and across its end."""

    along: np.ndarray               # (N,)
    across: np.ndarray              # (N, 2), from the line of the lower bone
    length: float


def find_limbs(template: Mesh, skeleton: Skeleton, kinds: np.ndarray, end: str) -> list[Limb]:
    """Measure along the limbs of three parts that end in a foot or a hand, in the pose of the template."""
    part, out = skeleton.part_of_vertex(template), []
    chain = {"foot": ("thigh", "shin"), "hand": ("upper_arm", "forearm")}[end]
    for last in np.flatnonzero(kinds == end):
        middle = skeleton.parents[last]
        first = skeleton.parents[middle]
        if (kinds[first], kinds[middle]) != chain:
            continue
        a, b, c = skeleton.joints[[first, middle, last]]
        along = np.full(len(template.vertices), np.nan)
        upper, lower = np.linalg.norm(b - a), np.linalg.norm(c - b)
        # along the straight line of the upper bone, then along that of the lower one
        on, beyond = part == first, np.isin(part, [middle, last])
        along[on] = (template.vertices[on] - a) @ (b - a) / upper
        along[beyond] = upper + (template.vertices[beyond] - b) @ (c - b) / lower
        across = (template.vertices - b) @ np.linalg.svd((c - b)[None])[2][1:].T
        out.append(Limb(along, across, float(upper + lower)))
    return out


def find_hems(template: Mesh, skeleton: Skeleton, kinds: np.ndarray, faces: np.ndarray, bary: np.ndarray,
              out_of: np.ndarray, crude: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Find the skin (N,) bool under clothes that end in hems on both legs or both arms, and that of shins in boots.

    Parameters
    ----------
    template : Mesh
        The body at rest.
    skeleton : Skeleton
        Its parts.
    kinds : (J,) str
        The kind of each part, such as "thigh".
    faces, bary : (n,), (n, 3)
        Places of the body that are nearest to points of the scan.
    out_of : (n,) float, metres
        How far each point lies out of the body; NaN where it faces elsewhere.
    crude : float, metres
        Steps of less are no hems, as the body is not exact.
    """
    part, limit = skeleton.part_of_vertex(template), max(LEGS, crude)
    ends = {end: find_limbs(template, skeleton, kinds, end) for end in ("foot", "hand")}
    if any(len(limbs) != 2 for limbs in ends.values()):
        return np.zeros(len(part), dtype=bool), np.zeros(len(part), dtype=bool)
    inward, outward = ({end: step_on_both([sign * step_along(limb, template.faces[faces], bary, out_of)
                                           for limb in limbs]) for end, limbs in ends.items()} for sign in (1, -1))
    # hems: what is nearer to the trunk than they are, and the part of the trunk beside
    (legs, _), (arms, _) = inward.values()
    certain = (legs > LEGS or arms > ARMS or legs + arms > BOTH) and max(legs, arms) > crude
    sewn = np.zeros(len(part), dtype=bool)
    for end, trunk in (("foot", ("pelvis",)), ("hand", ("chest", "abdomen"))):
        step, places = inward[end]
        if certain and step > SOME:
            sewn |= np.isin(kinds, trunk)[part]
            sewn |= np.any([limb.along < place for limb, place in zip(ends[end], places, strict=True)], axis=0)
    # boots begin at the shin
    step, places = outward["foot"]
    both = list(zip(ends["foot"], places, strict=True))
    on_shin = all(SHIN * limb.length < place < limb.length - ANKLE for limb, place in both)
    boots = (kinds == "shin")[part] & np.any([limb.along > place for limb, place in both], axis=0)
    return sewn, boots & (step > limit) & on_shin


def step_along(limb: Limb, corners: np.ndarray, bary: np.ndarray, out_of: np.ndarray) -> np.ndarray:
    """Compute by how much the scan steps inward at every ring of a limb, metres; NaN without points on both sides.

    `corners` (n, 3) are the vertices around each point's place, `bary` (n, 3) their weights.
    """
    place = np.einsum("nk,nk->n", bary, limb.along[corners])
    on = np.isfinite(place) & (np.abs(out_of) < 0.06) & (place >= 0)
    count = int((limb.length + 0.06) / RING)
    ring = np.minimum((place[on] / RING).astype(int), count - 1)
    total = np.concatenate([[0], np.cumsum(np.bincount(ring, out_of[on], count))])
    points = np.concatenate([[0], np.cumsum(np.bincount(ring, minlength=count))])
    # means of the rings before each ring, and of those after it
    i = np.arange(MEAN, count - MEAN - 1)
    before, after = points[i] - points[i - MEAN], points[i + 1 + MEAN] - points[i + 1]
    step = (total[i] - total[i - MEAN]) / np.maximum(before, 1) - (total[i + 1 + MEAN] - total[i + 1]) / np.maximum(
        after, 1)
    out = np.full(count, np.nan)
    allowed = (before > 5) & (after > 5) & (i * RING > FIRST) & (i * RING < limb.length + 0.03)
    out[i[allowed]] = step[allowed]
    return out


def step_on_both(steps: Sequence[np.ndarray]) -> tuple[float, tuple[float, float]]:
    """Find the largest step at about the same ring of both limbs, and its place along each, metres."""
    size = min(map(len, steps))
    pairs = np.minimum(steps[0][:size, None], steps[1][None, :size])
    rings = np.arange(size)
    pairs[np.abs(rings[:, None] - rings) > SHIFT] = np.nan
    if not np.isfinite(pairs).any():
        return 0.0, (0.0, 0.0)
    best = np.unravel_index(np.nanargmax(pairs), pairs.shape)
    return float(pairs[best]), (RING * (best[0] + 0.5), RING * (best[1] + 0.5))


def has_cuffs(template: Mesh, skeleton: Skeleton, kinds: np.ndarray, faces: np.ndarray, bary: np.ndarray,
              out_of: np.ndarray, crude: float = 0.0) -> bool:
    """Return whether both arms end in cuffs of clothes, however close; arguments as of `find_hems`."""
    arms = find_limbs(template, skeleton, kinds, "hand")
    edges = np.array([find_edge(limb, template.faces[faces], bary, out_of) for limb in arms])
    return len(arms) == 2 and bool(edges.min(axis=0).sum() > max(CUFFS, 3 * crude))


def find_edge(limb: Limb, corners: np.ndarray, bary: np.ndarray, out_of: np.ndarray) -> np.ndarray:
    """Compute the largest edge inward near the end of an arm, as seen through each window, (2,) metres; 0 without any.

    At an edge the surface goes on with the same slope, nearer to the bone. `corners` and `bary` as for `step_along`.
    """
    place = np.einsum("nk,nk->n", bary, limb.along[corners]) - limb.length
    on = (np.abs(place) < 0.09) & (np.abs(out_of) < 0.03)
    place, out_of = place[on], out_of[on]
    across = np.einsum("nk,nkd->nd", bary[on], limb.across[corners[on]])
    found = np.zeros(len(WINDOWS))
    for tilt in itertools.product(TILTS, TILTS):
        tilted = place + across @ np.array(tilt)
        for (k, window), middle in itertools.product(enumerate(WINDOWS), CUFF):
            from_edge = tilted - middle
            # one millimetre at the edge itself is neither side
            seen = (np.abs(from_edge) < window) & (np.abs(from_edge) > 0.001)
            x, before = from_edge[seen], from_edge[seen] < 0
            if min(before.sum(), (~before).sum()) >= 10:
                lines = np.column_stack([np.ones(len(x)), x, before])
                found[k] = max(found[k], np.linalg.solve(lines.T @ lines, lines.T @ out_of[seen])[2])
    return found
