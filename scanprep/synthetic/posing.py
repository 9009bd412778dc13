"""Posing of synthetic people.

Dual-quaternion blending, with twists spread along the limbs, moving shoulders, muscles that bulge with joint angles,
and a last pass that restores the detail which blending smeared.
"""
from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy.spatial.transform import Rotation

from ..geometry import rotations
from ..geometry.mesh import Mesh
from .anatomy import PARENTS, RestFrames
from .muscles import drivers, masks, twist_about
from .topology import blending, load_topology, neighbour_mean


class Poser:
    """What posing needs of one person at rest on the shared topology; part 0 turns about `root` (3,)."""

    def __init__(self, anatomy: RestFrames, vertices: np.ndarray, root: np.ndarray) -> None:
        template = load_topology()
        self.anatomy, self.rest, self.root = anatomy, vertices, root
        self.weights = blending()[1]
        self.normals = Mesh(vertices, template.mesh.faces).vertex_normals
        self.main = self.weights.argmax(axis=1)
        self.joints = anatomy.joints
        self.axes = anatomy.ends - anatomy.joints
        self.axes = self.axes / np.linalg.norm(self.axes, axis=1, keepdims=True)
        # detail at rest, relative to the smoothed surface, restored after posing
        smooth = _smooth(vertices)
        self._coordinates = np.einsum("nij,ni->nj", _detail_frames(smooth, template.mesh.faces), vertices - smooth)
        self._root_vertices = np.flatnonzero(template.part_of_vertex == 0)

    def part_motion(self, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Compute world rotations (16, 3, 3) of the parts and places (16, 3) of their joints."""
        relative = rotations.exp(pose)
        shift = self.girdle(relative)
        R, place = np.empty((16, 3, 3)), np.empty((16, 3))
        R[0], place[0] = relative[0], self.root + relative[0] @ (self.joints[0] - self.root)
        for j in range(1, 16):
            p = PARENTS[j]
            R[j] = R[p] @ relative[j]
            place[j] = place[p] + R[p] @ (self.joints[j] - self.joints[p] + shift[j])
        return R, place

    def girdle(self, relative: np.ndarray) -> np.ndarray:
        """Compute how far the shoulder joints (16, 3) move in the chest as the arms are raised, metres."""
        shift = np.zeros((16, 3))
        for arm, side in ((4, 1), (7, -1)):
            change = relative[arm] @ self.axes[arm] - self.axes[arm]
            up, across, fore = change[2], -side * change[0], -change[1]
            # metres at full elevation: up to 18 mm upwards, less inwards and forwards
            shift[arm] = self.anatomy.scale * np.array([-side * (0.006 * up + 0.006 * across), -0.011 * fore,
                                                        0.018 * up - 0.002 * abs(across)])
        return shift

    def __call__(self, pose: np.ndarray) -> np.ndarray:
        """Compute the vertices (N, 3) in a pose (16, 3), with the centroid of part 0 where it was at rest."""
        x = self._move(pose)
        return x + (self.root - x[self._root_vertices].mean(axis=0))

    def settling(self, pose: np.ndarray) -> np.ndarray:
        """Compute the shift (3,), metres, that brings the centroid of part 0 back to where it was at rest."""
        return self.root - self._move(pose)[self._root_vertices].mean(axis=0)

    def _move(self, pose: np.ndarray) -> np.ndarray:
        """Compute the vertices (N, 3) in a pose, before the root is centred."""
        relative = rotations.exp(pose)
        # muscles rise along the normals at rest
        amounts = drivers(self.anatomy, self.axes, relative)
        x = self.rest + (masks() @ amounts)[:, None] * self.normals
        # turn skin about the bones, so that a twist spreads along the limb
        for part, share in twist_shares():
            axis = self.axes[part if part not in (6, 9) else part - 1]
            twist = twist_about(pose[part], axis)
            base = self.joints[part]
            angle = -share * twist
            near = np.abs(angle) > 1e-9
            if near.any():
                turn = Rotation.from_rotvec(angle[near, None] * axis)
                x = x.copy()
                x[near] = base + turn.apply(x[near] - base)
        shift = self.girdle(relative)
        # skin of the chest follows the shoulders; then blend the rigid motions of the parts
        for arm, field in zip((4, 7), girdle_masks(), strict=True):
            x = x + (field * self.weights[:, 2])[:, None] * shift[arm]
        R, place = self.part_motion(pose)
        x = _dual_quaternion_blend(x, self.weights, self.main, R, place - np.einsum("pij,pj->pi", R, self.joints))
        smooth = _smooth(x)
        # near joints, put the detail of the rest shape back onto the smoothed surface (delta mush)
        mushed = smooth + np.einsum("nij,nj->ni", _detail_frames(smooth, load_topology().mesh.faces), self._coordinates)
        blend = mush_mask()[:, None]
        return x + blend * (mushed - x)


@lru_cache(maxsize=1)
def twist_shares() -> list[tuple[int, np.ndarray]]:
    """For each part whose twist is spread, compute how much of it the skin takes back, (N,).

    Near the shoulder and the hip the skin lags behind the bone; a turn of the hand is already begun by the
    forearm.
    """
    template = load_topology()
    vertices, anatomy = template.mesh.vertices, template.anatomy
    weights = blending()[1]
    shares = []
    # upper arms and thighs: skin near the body does not turn with the bone
    for part, reach in ((4, 0.5), (7, 0.5), (10, 0.45), (13, 0.45)):
        axis = anatomy.ends[part] - anatomy.joints[part]
        position = (vertices - anatomy.joints[part]) @ axis / (axis @ axis)
        chain = weights[:, part]
        shares.append((part, chain * (1 - _smoothstep(position / reach))))
    # hands: the forearm takes part of their turn, increasingly towards the wrist
    for part in (6, 9):
        axis = anatomy.joints[part] - anatomy.joints[part - 1]
        position = (vertices - anatomy.joints[part - 1]) @ axis / (axis @ axis)
        chain = weights[:, part - 1]
        shares.append((part, -chain * _smoothstep((position - 0.15) / 0.85)))
    return shares


@lru_cache(maxsize=1)
def girdle_masks() -> tuple[np.ndarray, np.ndarray]:
    """For the left and the right shoulder, compute how far the skin of the chest moves with it, (N,)."""
    template = load_topology()
    vertices, anatomy = template.mesh.vertices, template.anatomy
    out = []
    for arm, side in ((4, 1), (7, -1)):
        offset = vertices - (anatomy.joints[arm] + np.array([-side * 0.02, 0.0, -0.02]))
        across = _smoothstep((side * vertices[:, 0]) / 0.10)
        out.append(across * np.exp(-0.5 * ((offset[:, 0] / 0.085)**2 + (offset[:, 2] / 0.10)**2)))
    return out[0], out[1]


@lru_cache(maxsize=1)
def mush_mask() -> np.ndarray:
    """Compute where detail is restored after blending, (N,): near the joints, not on fingers, toes and face."""
    weights = blending()[1]
    mixed = 1 - weights.max(axis=1)
    mask = np.minimum(1, mixed / 0.08)
    mean = neighbour_mean()
    for _ in range(4):
        mask = 0.5 * mask + 0.5 * (mean @ mask)
    return mask


def _smoothstep(x: np.ndarray) -> np.ndarray:
    """Blend smoothly from 0 to 1."""
    x = np.clip(x, 0, 1)
    return x * x * (3 - 2 * x)


def _smooth(x: np.ndarray) -> np.ndarray:
    """Smooth vertices by averaging with their neighbours, eight times."""
    mean = neighbour_mean()
    for _ in range(8):
        x = 0.4 * x + 0.6 * (mean @ x)
    return x


def _detail_frames(x: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Compute frames (N, 3, 3) with columns normal and two tangents that turn with the surface."""
    normal = Mesh(x, faces).vertex_normals
    first = _first_neighbour()
    along = x[first] - x
    along -= np.einsum("nd,nd->n", along, normal)[:, None] * normal
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12)
    return np.stack([normal, along, np.cross(normal, along)], axis=2)


@lru_cache(maxsize=1)
def _first_neighbour() -> np.ndarray:
    """Choose one neighbour (N,) of every vertex, symmetric between left and right."""
    template = load_topology()
    twin, adjacency = template.mirror, template.mesh.vertex_adjacency
    owner = np.repeat(np.arange(len(twin)), np.diff(adjacency.indptr))
    # vertices on the middle line take a neighbour on the middle line
    middle = twin == np.arange(len(twin))
    first = adjacency.indices[adjacency.indptr[:-1]].astype(np.int64)
    along = middle[owner] & middle[adjacency.indices]
    first[owner[along]] = adjacency.indices[along]
    right = template.mesh.vertices[:, 0] < -1e-9
    first[right] = twin[first[twin[right]]]
    return first


def _dual_quaternion_blend(x: np.ndarray, weights: np.ndarray, main: np.ndarray, R: np.ndarray, t: np.ndarray
                           ) -> np.ndarray:
    """Move points by blends of rigid motions `x -> R x + t` that stay rigid (dual-quaternion skinning)."""
    real = Rotation.from_matrix(R).as_quat()                           # x, y, z, w
    real *= np.where(real @ real[0] < 0, -1, 1)[:, None]
    for p in range(1, len(real)):
        if real[p] @ real[PARENTS[p]] < 0:
            real[p] *= -1                 # q and -q are one rotation: take the one near the parent's
    # dual part: half the product of the translation with the rotation
    dual = 0.5 * np.stack([
        t[:, 0] * real[:, 3] + t[:, 1] * real[:, 2] - t[:, 2] * real[:, 1],
        -t[:, 0] * real[:, 2] + t[:, 1] * real[:, 3] + t[:, 2] * real[:, 0],
        t[:, 0] * real[:, 1] - t[:, 1] * real[:, 0] + t[:, 2] * real[:, 3],
        -(t * real[:, :3]).sum(axis=1)], axis=1)
    # blend on the side of the main part, normalise, and apply rotation and translation
    sign = np.where(real[main] @ real.T < 0, -1.0, 1.0)
    w = weights * sign
    b, d = w @ real, w @ dual
    length = np.linalg.norm(b, axis=1, keepdims=True)
    b, d = b / length, d / length
    v, s = b[:, :3], b[:, 3:]
    dv, ds = d[:, :3], d[:, 3:]
    turned = x + 2 * np.cross(v, np.cross(v, x) + s * x)
    return turned + 2 * (s * dv - ds * v + np.cross(v, dv))
