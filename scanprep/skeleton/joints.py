"""Turn rigid parts into a tree with a joint on every link.

Parts that only blend between two neighbours are dissolved, loops are opened, and every link gets its joint.
"""
from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from ..geometry.mesh import Mesh
from .motions import Motions, PosedSurface
from .parts import FADING, PartSearch
from .sides import mirror_pairs, reductions
from .tree import Skeleton

# Joints whose parts carry them apart by more than this times the radius of their border are doubtful. Shoulders of
# people whose collar bones are in the chest have 0.9, the 20 parts of 71 SCAPE poses at most 0.64.
LOOSE = 1.0
LOOP_SEPARATION = 1.5            # in a loop, parts less than this times the separation apart are merged


def border_lengths(search: PartSearch, label: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find pairs of parts that touch (n, 2), and the length of their common border (n,), metres."""
    s = search.surface
    both = np.sort(label[s.pairs], axis=1)
    differ = both[:, 0] != both[:, 1]
    pairs, number = np.unique(both[differ], axis=0, return_inverse=True)
    return pairs, np.bincount(number.ravel(), s.pair_lengths[differ], len(pairs))


def is_connected(links: np.ndarray, count: int) -> bool:
    """Test whether links (n, 2) connect all `count` parts."""
    if len(links) < count - 1:
        return False
    # asked thousands of times of a few parts, for which a sparse matrix takes 40 times as long
    group = list(range(count))
    for a, b in links.tolist():
        old, new = group[a], group[b]
        if old != new:
            group = [new if each == old else each for each in group]
    return len(set(group)) <= 1


def without_weak(search: PartSearch, label: np.ndarray) -> np.ndarray:
    """Return the links (n, 2) between touching parts, without contacts that are short against their other borders.

    A contact that is the only connection stays.
    """
    pairs, lengths = border_lengths(search, label)
    count = int(label.max()) + 1
    image = mirror_pairs(pairs, search.sides.partners(label))
    # a border and its mirror image count alike
    lengths = (lengths + lengths[image]) / 2
    longest = np.zeros(count)
    for side in range(2):
        np.maximum.at(longest, pairs[:, side], lengths)
    weak = lengths < 0.2 * longest[pairs].min(axis=1)                # a fifth: thighs that touch are not linked
    keep = np.ones(len(pairs), dtype=bool)
    # drop weak contacts, shortest first, unless that disconnects the parts
    for i in np.argsort(lengths, kind="stable"):
        if weak[i] and keep[i]:
            keep[[i, image[i]]] = False
            if not is_connected(pairs[keep], count):
                keep[[i, image[i]]] = True
    return pairs[keep]


def dissolve_bands(search: PartSearch, label: np.ndarray) -> np.ndarray:
    """Dissolve parts that only blend between two neighbours; return the labels (F,).

    Skin at a shoulder or knee moves in between its neighbours, and such a band looks like a part. It is none if a blend
    of its neighbours' motions, vertex by vertex, explains nearly all that its own motion explains. A band stays if
    dissolving it does not reduce the number of labels.
    """
    while True:
        explained, between = passages(search, label)
        for band in np.argsort(-explained, kind="stable"):
            if explained[band] < FADING:
                return label
            without = search.alternate(_share_out(search, label, int(band), between[band]), rounds=4)
            if without.max() < label.max():
                label = without
                break
        else:
            return label


def passages(search: PartSearch, label: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Measure how far each part is a blend between two neighbours (P,), at most 1, and which two (P, 2).

    Without the part, its vertices follow their best neighbour, and the residual grows. The measure is the share of that
    growth that a blend of two neighbours recovers.
    """
    s, motions = search.surface, search.motions(label)
    partner = search.sides.partners(label)
    P, contacts = int(label.max()) + 1, search.contacts(label)
    lost, won, between = np.ones(P), np.full(P, -np.inf), np.zeros((P, 2), dtype=np.int64)
    for p in range(P):
        inside = label == p
        vertices, place = np.unique(s.mesh.faces[inside], return_inverse=True)
        weights = np.bincount(place.ravel(), np.repeat(s.face_weights[inside] / 3, 3))
        near = np.setdiff1d(contacts[(contacts == p).any(axis=1)], p)
        # residual of the part's own motion, of its best neighbour per vertex, and of the best blend of two neighbours
        own = weights @ _squares(_gaps(search, motions, p, vertices))
        gaps = [_gaps(search, motions, int(q), vertices) for q in near]
        if not len(near):
            continue
        between[p] = near[0]
        lost[p] = weights @ np.min([_squares(gap) for gap in gaps], axis=0) - own
        for i in range(len(near)):
            for k in range(i):
                left = lost[p] + own - weights @ _blend(gaps[i], gaps[k])
                if left > won[p]:
                    won[p], between[p] = left, near[[k, i]]
    lost, won = lost + lost[partner], won + won[partner]
    return np.where(lost > 0, won / np.where(lost > 0, lost, 1), 1.0), between


def _gaps(search: PartSearch, motions: Motions, part: int, vertices: np.ndarray) -> np.ndarray:
    """Return the residuals (n, M, 3), metres, of vertices in all poses under the motion of a part."""
    s = search.surface
    return np.einsum("mij,nj->nmi", motions.R[part], s.x[vertices]) + motions.t[part] - s.y[vertices]


def _squares(gap: np.ndarray) -> np.ndarray:
    """Return mean squared lengths (n,) over the poses."""
    return (gap**2).sum(axis=(1, 2)) / gap.shape[1]


def _blend(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the mean squared residual (n,) of the best blend of two motions, with a free share for every vertex."""
    apart = a - b
    share = np.clip(-(apart * b).sum(axis=(1, 2)) / np.maximum((apart**2).sum(axis=(1, 2)), 1e-300), 0, 1)
    return _squares(b + share[:, None, None] * apart)


def _share_out(search: PartSearch, label: np.ndarray, band: int, between: np.ndarray) -> np.ndarray:
    """Give every triangle of a band, and of its mirror image, to the neighbour that it follows better."""
    partner = search.sides.partners(label)
    costs = search.surface.face_costs(search.motions(label))
    for part, pair in ((band, between), (partner[band], partner[between])):
        label = np.where(label == part, pair[costs[:, pair].argmin(axis=1)], label)
    return search.sides.spread(label[search.sides.half], partner)


def to_tree(search: PartSearch, label: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Merge parts, and drop links, until parts and links form a tree.

    In a loop, the two parts whose union costs least are merged unless they are well separated. The paper did this by
    hand with the halves of crotch and chest. If all parts of a loop move freely, the link whose joint fits worst is
    dropped, such as that of thighs or fingers that touch. On a symmetric body both sides are treated alike. Returns
    labels (F,) and links (P - 1, 2).

    [SCAPE] §3
    """
    while True:
        count = int(label.max()) + 1
        links = without_weak(search, label)
        pairs, separation, extra = search.separations(label)
        of_pair = {tuple(pair): i for i, pair in enumerate(pairs.tolist())}
        while len(links) > count - 1:
            dropped, loop = worst_links(search, label, links)
            # merge the cheapest pair if it is not well separated, or if no link can be dropped with its mirror image
            number = np.array([of_pair[tuple(links[i].tolist())] for i in loop])
            cheapest = number[extra[number].argmin()]
            close = separation[cheapest] < LOOP_SEPARATION * search.config.separation
            if dropped is None or close:
                break
            links = np.delete(links, dropped, axis=0)
        else:
            return label, links
        joined = search.join(label, *pairs[cheapest])
        label = search.alternate(joined, rounds=4)
        if label.max() + 1 >= count:                             # the alternation split them again
            label = np.unique(joined, return_inverse=True)[1]


def tree_of(search: PartSearch, label: np.ndarray, links: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Reach a tree of `count` parts, or the nearest, by merging linked parts or cutting the parts that bend most."""
    while len(links) + 1 != count:
        tree = (fewer_parts if len(links) + 1 > count else more_parts)(search, label, count)
        if tree is None:
            break
        label, links = tree
    return label, links


def more_parts(search: PartSearch, label: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray] | None:
    """Cut the part that bends most; the tree may have one part too many if two of them can be merged.

    A cut that gives a tree is preferred; else the loops of one are opened where the joint fits worst.
    """
    cuts = sorted((search.split(label, p) for p in range(int(label.max()) + 1)), key=lambda cut: -cut[1])
    looped = []
    for cut, apart in cuts:
        many = int(cut.max()) + 1
        links = without_weak(search, cut)
        if apart > 0 and len(links) == many - 1 and (many <= count or fewer_parts(search, cut, count) is not None):
            return cut, links
        if apart > 0 and many <= count:
            looped.append((cut, links))
    for cut, links in looped:
        opened = spanning_links(search, cut, links)
        if opened is not None:
            return cut, opened
    return None


def spanning_links(search: PartSearch, label: np.ndarray, links: np.ndarray) -> np.ndarray | None:
    """Drop from the links (n, 2) those in loops whose joint fits worst, until a tree is left; None where none is.

    Of a symmetric body a link is dropped with its mirror image.
    """
    count = int(label.max()) + 1
    while len(links) > count - 1:
        dropped = worst_links(search, label, links)[0]
        if dropped is None:
            return None
        links = np.delete(links, dropped, axis=0)
    return links


def worst_links(search: PartSearch, label: np.ndarray, links: np.ndarray) -> tuple[np.ndarray | None, np.ndarray]:
    """Find the link in a loop whose joint fits worst, with its mirror image, and all links (n, 2) that lie in loops.

    None stands for the first where none can be dropped with its mirror image without dividing the body.
    """
    count, each = int(label.max()) + 1, np.arange(len(links))
    # links in loops: those whose removal keeps the parts connected
    loop = np.array([i for i in each if is_connected(links[each != i], count)])
    image = mirror_pairs(links, search.sides.partners(label))
    apart = place_joints(search.surface, label, search.motions(label), links[loop])[1]
    for k in np.argsort(-apart, kind="stable"):
        both = np.unique([loop[k], image[loop[k]]])
        if is_connected(np.delete(links, both, axis=0), count):
            return both, loop
    return None, loop


def fewer_parts(search: PartSearch, label: np.ndarray, count: int, limit: float = np.inf
                ) -> tuple[np.ndarray, np.ndarray] | None:
    """Merge the two linked parts whose union costs least, keeping at least `count` parts.

    Parts with a separation above `limit` stay.
    """
    many, partner = int(label.max()) + 1, search.sides.partners(label)
    pairs, separation, extra = search.separations(label)
    fewer = reductions(pairs, partner) if search.sides.tied else np.ones(len(pairs), dtype=np.int64)
    for i in np.argsort(extra * fewer, kind="stable"):
        if many - fewer[i] >= count and separation[i] < limit:
            joined = search.alternate(search.join(label, *pairs[i]), rounds=4)
            links = without_weak(search, joined)
            if joined.max() + 1 == many - fewer[i] and len(links) == joined.max():
                return joined, links
    return None


def place_joints(surface: PosedSurface, label: np.ndarray, motions: Motions, links: np.ndarray
                 ) -> tuple[np.ndarray, np.ndarray]:
    """Place joints (n, 3), metres on the template: points that both parts of a link (n, 2) carry to one place.

    Least squares over the poses [Articulated]. Along the axis of a hinge, and where the parts hardly rotate, any point
    fits. There the joint is pulled to the centroid of the border. Returned beside them is how far apart the two parts
    carry each joint (n,), metres, RMS over the poses.
    """
    s = surface
    edge = s.mesh.edges[s.mesh.edge_use == 2]
    middle = s.x[edge].mean(axis=1)
    both = np.sort(label[s.pairs], axis=1)
    joints, apart = np.empty((len(links), 3)), np.empty(len(links))
    for n, (a, b) in enumerate(links):
        border = (both == [min(a, b), max(a, b)]).all(axis=1)
        # centroid and radius of the border, weighted by edge lengths
        ring = np.average(middle[border], axis=0, weights=s.pair_lengths[border])
        radius = np.sqrt(np.average(((middle[border] - ring)**2).sum(axis=1), weights=s.pair_lengths[border]))
        dR = motions.R[a] - motions.R[b]
        gap = motions.t[a] - motions.t[b] + dR @ ring
        centre = _meeting_point(dR, gap, radius)
        joints[n], apart[n] = ring + centre, np.sqrt(((dR @ centre + gap)**2).sum(axis=1).mean())
    return joints + s.origin, apart


def joint_gaps(template: Mesh, poses: np.ndarray, skeleton: Skeleton) -> np.ndarray:
    """Measure how far apart the two parts of each joint carry it, as a share of the radius of their border.

    Parameters
    ----------
    template : Mesh
        N vertices.
    poses : (M, N, 3) float, metres
        Bodies in which the parts move.
    skeleton : Skeleton
        On the template, J parts.

    Returns
    -------
    (J,) float
        RMS over the poses; 0 for the root, which has no joint.
    """
    surface, label = PosedSurface(template, poses), skeleton.part_of_face
    motions, gaps = surface.core_motions(label), np.zeros(len(skeleton.parents))
    both = label[surface.pairs]
    corners = template.edges[template.edge_use == 2]
    for a, b in enumerate(skeleton.parents[1:], start=1):
        border = (np.sort(both, axis=1) == [min(a, b), max(a, b)]).all(axis=1)
        if not border.any():                                 # a tree made by hand may link parts that do not touch
            border = (both == a).any(axis=1) & (both[:, 0] != both[:, 1])
        ring = surface.x[corners[border]].mean(axis=1)
        radius = np.linalg.norm(ring - ring.mean(axis=0), axis=1).mean()
        place = skeleton.joints[a] - surface.origin
        apart = (motions.R[a] - motions.R[b]) @ place + motions.t[a] - motions.t[b]
        gaps[a] = np.sqrt((apart**2).sum(axis=1).mean()) / radius
    return gaps


def joint_doubts(skeleton: Skeleton, gaps: Sequence[float]) -> list[str]:
    """Name the joints whose two parts do not carry them to one place, by their `joint_gaps` (J,), as reasons."""
    loose = [f"{skeleton.names[j]} to {skeleton.names[skeleton.parents[j]]}" for j in range(1, len(gaps))
             if gaps[j] > LOOSE]
    return [f"no point holds these parts together, so they may belong elsewhere in the tree: {', '.join(loose)}; "
            "correct it with scape prep edit-skeleton, or add scans in which the body bends there"] if loose else []


def _meeting_point(dR: np.ndarray, gap: np.ndarray, radius: float) -> np.ndarray:
    """Find the c (3,) that minimises `dR c + gap` (M, 3), pulled to 0 where the poses do not determine it.

    The pull is a Gaussian prior of width 0.6 `radius`, weighed by the residual that remains.
    """
    A = np.einsum("mki,mkj->ij", dR, dR) / len(dR)
    b = np.einsum("mki,mk->i", dR, gap) / len(dR)
    pull = least = 1e-4                          # squared radians: rotations below 0.01 do not locate a joint
    expected = 0.6 * radius                      # usual distance of a joint from the border's centroid
    for _ in range(2):
        c = -np.linalg.solve(A + pull * np.eye(3), b)
        pull = max(least, float(((dR @ c + gap)**2).sum(axis=1).mean()) / max(expected, 1e-9)**2)
    return c


def middle_part(areas: np.ndarray, centres: np.ndarray, links: np.ndarray, joints: np.ndarray) -> int:
    """Find the part nearest to the rest of the body, by path lengths through the joints, weighted by areas (P,)."""
    P = len(areas)
    if P == 1:
        return 0
    step = sum(np.linalg.norm(centres[links[:, side]] - joints, axis=1) for side in range(2))
    graph = coo_array((np.maximum(step, 1e-9), links.T), shape=(P, P))
    return int((dijkstra(graph.tocsr(), directed=False) @ areas).argmin())
