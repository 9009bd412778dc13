"""Parts that are none: stretches of skin where the motion of one part passes into that of the next."""
from __future__ import annotations

import numpy as np

from .motions import Motions
from .parts import PartSearch


def dissolve_bands(search: PartSearch, label: np.ndarray) -> np.ndarray:
    """Labels (F,) without the parts that are only the passage between two neighbours.

    The skin of a shoulder or a knee moves in between; cut out, such a band looks like a part. It is none if a blend of
    its neighbours' motions, vertex by vertex, explains nearly all that its own motion explains. A band stays if the
    labels that follow are no fewer.
    """
    while True:
        explained, between = passages(search, label)
        for band in np.argsort(-explained, kind="stable"):
            if explained[band] < search.config.fading:
                return label
            without = search.alternate(_shared_out(search, label, int(band), between[band]), rounds=4)
            if without.max() < label.max():
                label = without
                break
        else:
            return label


def passages(search: PartSearch, label: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How far each part is a passage between neighbours (P,), 1 when entirely, and between which two (P, 2).

    The share of what is lost when the part's vertices follow the neighbour they fit best that a blend of two
    neighbours wins back.
    """
    s, motions = search.surface, search.motions(label)
    partner = search.sides.partners(label)
    P, contacts = int(label.max()) + 1, search.contacts(label)
    lost, won, between = np.ones(P), np.full(P, -np.inf), np.zeros((P, 2), dtype=np.int64)
    for p in range(P):
        mine = label == p
        vertices, place = np.unique(s.mesh.faces[mine], return_inverse=True)
        weights = np.bincount(place.ravel(), np.repeat(s.face_weights[mine] / 3, 3))
        near = np.setdiff1d(contacts[(contacts == p).any(axis=1)], p)
        own = weights @ _squares(_gaps(search, motions, p, vertices))
        gaps = [_gaps(search, motions, int(q), vertices) for q in near]
        if not len(near):
            continue
        between[p] = near[0]
        lost[p] = weights @ np.min([_squares(gap) for gap in gaps], axis=0) - own
        for i in range(len(near)):
            for k in range(i):
                left = lost[p] + own - weights @ _blended(gaps[i], gaps[k])
                if left > won[p]:
                    won[p], between[p] = left, near[[k, i]]
    lost, won = lost + lost[partner], won + won[partner]
    return np.where(lost > 0, won / np.where(lost > 0, lost, 1), 1.0), between


def _gaps(search: PartSearch, motions: Motions, part: int, vertices: np.ndarray) -> np.ndarray:
    """(n, M, 3) from the vertices in the poses to where the motion of a part would carry them, metres."""
    s = search.surface
    return np.einsum("mij,nj->nmi", motions.R[part], s.x[vertices]) + motions.t[part] - s.y[vertices]


def _squares(gap: np.ndarray) -> np.ndarray:
    """(n,) squared lengths, mean over the poses."""
    return (gap**2).sum(axis=(1, 2)) / gap.shape[1]


def _blended(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(n,) the least squares that a blend of two motions leaves of their gaps, its share free for every vertex."""
    apart = a - b
    share = np.clip(-(apart * b).sum(axis=(1, 2)) / np.maximum((apart**2).sum(axis=(1, 2)), 1e-300), 0, 1)
    return _squares(b + share[:, None, None] * apart)


def _shared_out(search: PartSearch, label: np.ndarray, band: int, between: np.ndarray) -> np.ndarray:
    """Labels where every triangle of a band, and of its mirror image, goes to the neighbour that it follows better."""
    partner = search.sides.partners(label)
    costs = search.surface.face_costs(search.motions(label))
    for part, pair in ((band, between), (partner[band], partner[between])):
        label = np.where(label == part, pair[costs[:, pair].argmin(axis=1)], label)
    return search.sides.spread(label[search.sides.half], partner)
