"""Parts, tree and joints of a figure of boxes that moves exactly as told."""
from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from hand_bodies import KNUCKLES, bend_fingers, hand

from scanprep.geometry import rotations
from scanprep.geometry.mesh import Mesh, check_template
from scanprep.skeleton.find import find_skeleton
from scanprep.skeleton.names import skeleton_doubts
from scanprep.skeleton.parts import SkeletonConfig
from scanprep.skeleton.tree import Skeleton

CELL = 0.04
FEW = SkeletonConfig(restarts=1)
#         name       from            to            parent  joint
BOXES = [("torso", (-4, -2, 0), (4, 2, 10), -1, (0, 0, 5)),          # no two parts of one size
         ("head", (-2, -2, 10), (2, 2, 15), 0, (0, 0, 10)),
         ("upper arm l", (4, -1, 7), (11, 1, 9), 0, (4, 0, 8)),
         ("upper arm r", (-10, -1, 7), (-4, 1, 9), 0, (-4, 0, 8)),
         ("thigh l", (1, -2, -8), (4, 2, 0), 0, (2.5, 0, 0)),
         ("thigh r", (-4, -2, -7), (-1, 2, 0), 0, (-2.5, 0, 0)),
         ("forearm l", (11, -1, 7), (20, 1, 9), 2, (11, 0, 8)),
         ("forearm r", (-18, -1, 7), (-10, 1, 9), 3, (-10, 0, 8)),
         ("shin l", (1, -2, -15), (4, 2, -8), 4, (2.5, 0, -8)),
         ("shin r", (-4, -2, -13), (-1, 2, -7), 5, (-2.5, 0, -7))]
PARENTS = np.array([box[3] for box in BOXES])
JOINTS = CELL * np.array([box[4] for box in BOXES])


def surface_of_cells(cells: set[tuple[int, int, int]]) -> Mesh:
    """The outside of a set of unit cells, as triangles."""
    corner_number: dict[tuple[int, int, int], int] = {}
    faces = []
    for cell in sorted(cells):
        for axis in range(3):
            for side in (0, 1):
                beyond = list(cell)
                beyond[axis] += 2 * side - 1
                if tuple(beyond) in cells:
                    continue
                quad = []
                for u, v in ((0, 0), (1, 0), (1, 1), (0, 1)):
                    corner = list(cell)
                    corner[axis] += side
                    corner[(axis + 1) % 3] += u
                    corner[(axis + 2) % 3] += v
                    quad.append(corner_number.setdefault(tuple(corner), len(corner_number)))
                quad = quad if side else quad[::-1]
                faces += [[quad[0], quad[1], quad[2]], [quad[0], quad[2], quad[3]]]
    return Mesh(CELL * np.array(list(corner_number)), np.array(faces))


@dataclass(frozen=True)
class Figure:
    template: Mesh
    part_of_vertex: np.ndarray

    @property
    def pure(self) -> np.ndarray:
        """(F,) the part of triangles whose corners all follow the same part, -1 elsewhere."""
        corners = self.part_of_vertex[self.template.faces]
        return np.where((corners == corners[:, :1]).all(axis=1), corners[:, 0], -1)

    def posed(self, pose: np.ndarray, trans: np.ndarray) -> np.ndarray:
        R, place = np.empty((len(PARENTS), 3, 3)), np.empty((len(PARENTS), 3))
        for j, parent in enumerate(PARENTS):
            R[j] = rotations.exp(pose[j]) if parent < 0 else R[parent] @ rotations.exp(pose[j])
            place[j] = trans if parent < 0 else place[parent] + R[parent] @ (JOINTS[j] - JOINTS[parent])
        p = self.part_of_vertex
        return np.einsum("nij,nj->ni", R[p], self.template.vertices - JOINTS[p]) + place[p]

    def poses(self, count: int, rng: np.random.Generator, still: tuple[int, ...] = ()) -> np.ndarray:
        turns = rng.normal(0, 0.4, (count, len(PARENTS), 3))
        turns[:, still] = 0
        return np.stack([self.posed(pose, rng.normal(0, 0.3, 3)) for pose in turns])


@pytest.fixture(scope="module")
def figure() -> Figure:
    cells = {(x, y, z) for _, low, high, *_ in BOXES for x in range(low[0], high[0])
             for y in range(low[1], high[1]) for z in range(low[2], high[2])}
    template = surface_of_cells(cells)
    check_template(template)
    part = np.zeros(len(template.vertices), dtype=np.int64)
    for p, (_, low, high, *_) in enumerate(BOXES):
        inside = ((template.vertices > CELL * np.array(low) - 1e-9)
                  & (template.vertices < CELL * np.array(high) + 1e-9)).all(axis=1)
        part[inside] = p              # the ring between two parts follows the child
    return Figure(template, part)


@pytest.fixture(scope="module")
def poses(figure: Figure) -> np.ndarray:
    return figure.poses(12, np.random.default_rng(5))


@pytest.fixture(scope="module")
def found(figure: Figure, poses: np.ndarray) -> Skeleton:
    return find_skeleton(figure.template, poses, FEW)


def match(figure: Figure, skeleton: Skeleton) -> np.ndarray:
    """The found part of every true one, after checking that they share all triangles that are not between."""
    pure = figure.pure
    pairs = np.unique(np.stack([pure, skeleton.part_of_face], axis=1)[pure >= 0], axis=0)
    assert len(pairs) == len(np.unique(pairs[:, 1])), "a found part holds triangles of two true ones"
    assert len(pairs) == len(np.unique(pairs[:, 0])), "a true part is spread over two found ones"
    return pairs[:, 1]


def test_parts_tree_and_joints_of_the_figure_are_found(figure: Figure, found: Skeleton) -> None:
    part = match(figure, found)
    assert len(found.parents) == len(BOXES)
    assert part[0] == 0
    assert [found.parents[part[j]] for j in range(1, len(BOXES))] == [part[p] for p in PARENTS[1:]]
    assert np.linalg.norm(found.joints[part[1:]] - JOINTS[1:], axis=1).max() < 1e-4
    root = found.part_of_vertex(figure.template) == 0
    assert np.allclose(found.joints[0], figure.template.vertices[root].mean(axis=0), atol=1e-12)


def test_parts_that_never_move_against_each_other_are_one(figure: Figure) -> None:
    forearm, head = 6, 1
    poses = figure.poses(12, np.random.default_rng(6), still=(forearm, head))
    skeleton = find_skeleton(figure.template, poses, FEW)
    assert len(skeleton.parents) == len(BOXES) - 2
    pure = figure.pure
    for together in ({0, head}, {2, forearm}):
        assert len(set(skeleton.part_of_face[np.isin(pure, list(together))])) == 1
    assert len(set(skeleton.part_of_face[np.isin(pure, [0, 2])])) == 2


def test_a_body_that_does_not_move_is_one_part(figure: Figure) -> None:
    poses = np.stack([figure.template.vertices @ rotations.exp([0, 0.3 * k, 1.0]).T + k for k in range(4)])
    skeleton = find_skeleton(figure.template, poses, FEW)
    assert skeleton.parents.tolist() == [-1]
    assert np.allclose(skeleton.joints[0], figure.template.vertices.mean(axis=0), atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("count", [4, 9])
def test_an_exact_number_of_parts_is_kept(figure: Figure, poses: np.ndarray, count: int) -> None:
    skeleton = find_skeleton(figure.template, poses, replace(FEW, parts=count))
    assert len(skeleton.parents) == count


@pytest.mark.slow
def test_more_parts_than_can_be_told_apart_give_the_nearest_tree_and_a_reason(figure: Figure, poses: np.ndarray
                                                                              ) -> None:
    skeleton = find_skeleton(figure.template, poses, replace(FEW, parts=200))
    assert len(BOXES) <= len(skeleton.parents) < 200
    doubt, *_ = skeleton_doubts(skeleton, 200)
    assert f"of 200 parts was found, the nearest has {len(skeleton.parents)}" in doubt and "--parts" in doubt
    assert not any("parts was found" in doubt for doubt in skeleton_doubts(skeleton, len(skeleton.parents)))


@pytest.mark.slow
def test_moving_the_bodies_and_the_template_changes_nothing_but_the_place(
        figure: Figure, poses: np.ndarray, found: Skeleton) -> None:
    rng = np.random.default_rng(7)
    R, t = rotations.exp(rng.normal(0, 2, (len(poses), 3))), rng.normal(0, 3, (len(poses), 1, 3))
    R0, t0 = rotations.exp([0.4, -1.2, 0.7]), np.array([10.0, -4.0, 2.0])
    moved = figure.template.with_vertices(figure.template.vertices @ R0.T + t0)
    skeleton = find_skeleton(moved, np.einsum("mij,mnj->mni", R, poses) + t, FEW)
    assert np.array_equal(match(figure, skeleton), match(figure, found))
    assert np.array_equal(skeleton.parents, found.parents)
    assert np.allclose(skeleton.joints[1:], found.joints[1:] @ R0.T + t0, atol=1e-4)


def test_bad_poses_are_refused_by_name(figure: Figure, poses: np.ndarray) -> None:
    template = figure.template
    with pytest.raises(ValueError, match=r"poses: expected shape \(M, \d+, 3\)"):
        find_skeleton(template, poses[:, 1:])
    with pytest.raises(ValueError, match="poses: expected shape"):
        find_skeleton(template, poses[0])
    with pytest.raises(ValueError, match="poses: expected at least 3, got 2"):
        find_skeleton(template, poses[:2])
    broken = poses.copy()
    broken[4, 17, 1] = np.nan
    with pytest.raises(ValueError, match="poses: 1 have vertices that are not finite, the first is pose 4"):
        find_skeleton(template, broken)


def test_fingers_whose_roots_touch_hang_on_the_palm():
    """Links between neighbouring fingers are dropped, as their joints fit worse than the knuckles."""
    mesh, rng = hand(), np.random.default_rng(0)
    poses = np.stack([bend_fingers(mesh, rng.uniform(0, 1.2, 4)) for _ in range(12)])
    found = find_skeleton(mesh, poses, SkeletonConfig(restarts=1))
    middles = [mesh.vertices[mesh.faces[found.part_of_face == part]].mean(axis=(0, 1)) for part in range(5)]
    assert len(found.parents) == 5
    palm = int(np.argmin([middle[2] for middle in middles]))
    fingers = [part for part in range(5) if part != palm]
    assert all(found.parents[part] == palm for part in fingers), found.parents
    knuckle = np.argmin([[np.linalg.norm(middles[part][:1] - one[:1]) for one in KNUCKLES] for part in fingers], axis=1)
    assert np.linalg.norm((found.joints[fingers] - KNUCKLES[knuckle])[:, 1:], axis=1).max() < 0.005
