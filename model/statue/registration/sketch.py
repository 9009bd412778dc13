"""Sketch of the joints of an upright figure in T or A pose, by tips and notches of its silhouette.

Proportions do not matter: from the front a figure is a star with five tips (head, hands, feet) and five notches between
them (neck, armpits, crotch). Limbs run from notches to tips along the middle of the silhouette.
"""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage, sparse
from scipy.sparse import csgraph
from scipy.spatial import cKDTree

from scanprep.geometry.mesh import Mesh

# metres: side of a pixel, for figures of 1.7 m; and how many points fill a silhouette (they are 6 mm apart)
PIXEL, POINTS = 0.01, 60_000
# shares of the way from the base of a limb to its tip where its joints are on the control model
ARM, LEG = {"elbow": 0.38, "wrist": 0.75}, {"knee": 0.48, "ankle": 0.92}
CLEARLY = 0.8                        # principal axes count where the figure is so much more symmetric along them


@dataclass(frozen=True, eq=False)
class Silhouette:
    """The front view of a figure: which pixels (w, h) it fills, and how deep its middle is there.

    The first axis goes across from the figure's right to its left, if it faces the viewer; the second goes up.
    """

    axes: np.ndarray    # (3, 3), rows: across, up, and toward the viewer
    origin: np.ndarray  # (2,) metres, across and up, of the first pixel
    filled: np.ndarray  # (w, h) bool
    depth: np.ndarray   # (w, h) metres, NaN where no point is
    middle: int         # the column of the middle of the figure

    @staticmethod
    def draw(points: np.ndarray, axes: np.ndarray) -> Silhouette:
        """Draw points (n, 3) in a frame; only the largest connected region counts."""
        seen = points @ axes.T
        origin = seen[:, :2].min(axis=0) - 3 * PIXEL
        cells = np.floor((seen[:, :2] - origin) / PIXEL).astype(int)
        count, total = np.zeros((2, *(cells.max(axis=0) + 4)))
        np.add.at(count, tuple(cells.T), 1.0)
        np.add.at(total, tuple(cells.T), seen[:, 2])
        with np.errstate(invalid="ignore"):
            depth = np.where(count > 0, total / count, np.nan)
        filled = ndimage.binary_closing(count > 0, np.ones((3, 3)))
        region, _ = ndimage.label(filled, np.ones((3, 3)))
        filled = region == np.bincount(region[filled]).argmax()
        across = 0.5 * (seen[:, 0].min() + seen[:, 0].max())
        return Silhouette(axes, origin, filled, depth, int((across - origin[0]) / PIXEL))

    def place(self, pixel: np.ndarray) -> np.ndarray:
        """Compute the point (3,) in the middle of the figure behind a pixel (2,)."""
        i, j = np.clip(np.floor(pixel).astype(int), 0, np.array(self.filled.shape) - 1)
        around = self.depth[max(i - 2, 0):i + 3, max(j - 2, 0):j + 3]
        around = around if np.isfinite(around).any() else self.depth
        return np.asarray(np.array([*(self.origin + PIXEL * (pixel + 0.5)), np.nanmean(around)]) @ self.axes)

    def walk(self, starts: np.ndarray, free: np.ndarray | None = None) -> np.ndarray:
        """Compute the way (w, h), pixels, from the nearest of the starts (n, 2) inside `free`, or else `filled`.

        ValueError where no start is inside.
        """
        free = self.filled if free is None else free
        starts = starts[free[tuple(starts.T)]]
        if not len(starts):
            raise ValueError("scan: its silhouette is no star of five tips")
        first = np.ravel_multi_index(tuple(starts.T), free.shape)
        return csgraph.dijkstra(_pixel_graph(np.where(free, 1.0, np.inf)), directed=False, indices=first,
                                min_only=True).reshape(free.shape)

    def notch(self, tip: np.ndarray, other: np.ndarray) -> np.ndarray:
        """Find the deepest pixel (2,) between two tips, seen from the line that joins them, on the side of the first.
        """
        line = np.round(np.linspace(tip, other, 2 * max(self.filled.shape))).astype(int)
        across = np.array([other[1] - tip[1], tip[0] - other[0]])
        # what is free between the line and the trunk
        empty = np.argwhere(~self.filled)
        inward = ((empty - tip) @ across) * ((self.trunk - tip) @ across) >= 0
        free = np.zeros_like(self.filled)
        free[tuple(empty[inward].T)] = True
        free[tuple(line[~self.filled[tuple(line.T)]].T)] = True
        depth = self.walk(line, free)
        here = np.sign(tip[0] - self.middle) * (np.arange(len(depth)) - self.middle) > 0
        depth[~(here[:, None] & np.isfinite(depth))] = -1
        return np.array(np.unravel_index(depth.argmax(), depth.shape), dtype=float)

    @property
    def trunk(self) -> np.ndarray:
        """(2,) the pixel in the middle of the middle column."""
        rows = self.filled[self.middle].nonzero()[0]
        return np.array([self.middle, rows.mean() if len(rows) else self.filled.shape[1] / 2])

    def divide_limb(self, base: np.ndarray, tip: np.ndarray, shares: dict[str, float]) -> dict[str, np.ndarray]:
        """Find places (3,) at shares of the way from the base of a limb to its tip, in the middle of the limb."""
        # far from the border is cheap, so that the way is in the middle
        cost = np.where(self.filled, (1 + ndimage.distance_transform_edt(self.filled)) ** -2.0, 1e3)
        first, last = (int(np.ravel_multi_index(tuple(pixel.astype(int)), cost.shape)) for pixel in (base, tip))
        _, before = csgraph.dijkstra(_pixel_graph(cost), directed=False, indices=first, return_predecessors=True)
        pixels = [last]
        while pixels[-1] != first:
            pixels.append(int(before[pixels[-1]]))
        way = np.stack(np.unravel_index(pixels[::-1], cost.shape), axis=1).astype(float)
        gone = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(way, axis=0), axis=1))])
        return {name: self.place(way[np.searchsorted(gone, share * gone[-1])]) for name, share in shares.items()}


def _pixel_graph(cost: np.ndarray) -> sparse.csr_array:
    """Return the costs of steps between the eight neighbours of pixels (w, h): length times the mean of their costs.

    Pixels of infinite cost cannot be entered.
    """
    number = np.arange(cost.size).reshape(cost.shape)
    outside = np.pad(number, 1, constant_values=-1)
    links = []
    for across, up in ((1, 0), (0, 1), (1, 1), (1, -1)):
        other = np.roll(outside, (-across, -up), axis=(0, 1))[1:-1, 1:-1]
        free = (other >= 0) & np.isfinite(cost) & np.isfinite(cost.ravel()[other])
        costs = np.hypot(across, up) * 0.5 * (cost[free] + cost.ravel()[other[free]])
        links.append((costs, number[free], other[free]))
    costs, starts, ends = (np.concatenate(columns) for columns in zip(*links, strict=True))
    return sparse.csr_array((costs, (starts, ends)), shape=(cost.size, cost.size))


def sketch_joints(scan: Mesh | np.ndarray) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Sketch joints and tips of limbs, {name: (3,)} each, of a figure of 1.7 m, as if it faced the viewer.

    Parameters
    ----------
    scan : Mesh or (n, 3) float, metres
        A figure that spreads its limbs; axes, front and proportions need not be known.

    Returns
    -------
    joints, tips : dict of str to (3,) float, metres
        As the control model names them. Left and right are exchanged where the figure faces away.

    Raises
    ------
    ValueError
        The silhouette is no star.

    Examples
    --------
    >>> from scanprep.synthetic.people import SyntheticPerson
    >>> joints, tips = sketch_joints(SyntheticPerson().mesh)
    >>> sorted(tips)
    ['left middle finger', 'right middle finger', 'top of head']
    """
    points = scan if not isinstance(scan, Mesh) else scan.vertices if not len(scan.faces) else \
        scan.sample(POINTS, np.random.default_rng(0))[0]
    view = find_front(points)
    filled, middle = view.filled, view.middle
    columns, rows = np.arange(len(filled)), filled[middle].nonzero()[0]
    if not len(rows):
        raise ValueError("scan: its silhouette is no star of five tips")
    top, crotch = np.array([middle, rows.max()]), np.array([middle, rows.min() - 1])
    halves = {"l": (columns > middle)[:, None] & filled, "r": (columns < middle)[:, None] & filled}
    # 1. tips: soles, and on each side the pixel that is farthest from the middle column and from the soles
    feet = {}
    for side, half in halves.items():
        low = np.argwhere(half)
        low = low[low[:, 1] <= low[:, 1].min() + 3]
        feet[side] = low[np.linalg.norm(low - low.mean(axis=0), axis=1).argmin()]
    far = np.minimum(view.walk(np.stack([np.full(len(rows), middle), rows], axis=1)),
                     view.walk(np.array([*feet.values()])))
    hands = {side: np.array(np.unravel_index(np.where(half & np.isfinite(far), far, -1).argmax(), far.shape))
             for side, half in halves.items()}
    # 2. joints between notches and tips: the hip is as high above the crotch as the thigh is wide
    joints = dict[str, np.ndarray]()
    tips, necks = {"top of head": view.place(top)}, list[float]()
    for side, half in halves.items():
        armpit = view.notch(hands[side], feet[side])
        necks.append(view.notch(hands[side], top)[1])
        above = filled[int(armpit[0]), int(armpit[1]) + 1:]
        shoulder = armpit + [0, 0.5 * np.argmin(np.append(above, False))]
        thigh = half[:, max(crotch[1], 0)].nonzero()[0]
        hip = np.array([middle, crotch[1]]) if not len(thigh) else np.array([thigh.mean(), crotch[1] + np.ptp(thigh)])
        joints |= {f"{side}_{name}": place for name, place in (
            ("shoulder", view.place(shoulder)), ("hip", view.place(hip)),
            *view.divide_limb(shoulder, hands[side], ARM).items(), *view.divide_limb(hip, feet[side], LEG).items())}
        tips[{"l": "left", "r": "right"}[side] + " middle finger"] = view.place(hands[side])
    joints["skullbase"] = view.place(np.array([middle, np.mean(necks)]))
    return joints, tips


def find_front(points: np.ndarray) -> Silhouette:
    """Find the front view: the figure is symmetric across, and of the other axes the longer one is up."""
    few = points[::max(1, len(points) // 3000)] - points.mean(axis=0)
    tree, frames = cKDTree(few), list[tuple[float, np.ndarray]]()
    for axes in (np.eye(3), np.linalg.svd(few, full_matrices=False)[2]):
        order = np.argsort(np.ptp(few @ axes.T, axis=0))                    # thinnest from front to back
        for across, up in ((order[1], order[2]), (order[2], order[1])):
            side, high = axes[across], axes[up]
            unlike = tree.query(few - 2 * np.outer(few @ side, side))[0].mean()
            frames.append((float(unlike), np.array([side, high, np.cross(side, high)])))
    # own axes of the file win unless others are clearly better
    best = min(frames[:2], key=lambda frame: frame[0])
    principal = min(frames[2:], key=lambda frame: frame[0])
    axes = (principal if principal[0] < CLEARLY * best[0] else best)[1]
    # the middle column begins higher above the feet than above the head
    views = [Silhouette.draw(points, axes), Silhouette.draw(points, np.diag([-1, -1, 1]) @ axes)]
    return max(views, key=lambda view: int(view.filled[view.middle].argmax()))
