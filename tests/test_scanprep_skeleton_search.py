"""Symmetry of bodies, symmetric skeletons, bands of skin that are no parts, loops, and fast costs of rigid motions."""
from dataclasses import replace

import numpy as np
import pytest
from animal_bodies import ODD, Animal, Build, random_pose

from scanprep.geometry import rotations
from scanprep.geometry.mesh import Mesh
from scanprep.skeleton.find import search_skeleton
from scanprep.skeleton.joints import dissolve_bands, passages, to_tree, without_weak
from scanprep.skeleton.labels import label_patches
from scanprep.skeleton.motions import PosedSurface, fit_motions, rigid_costs
from scanprep.skeleton.names import part_partners
from scanprep.skeleton.parts import PartSearch, SkeletonConfig
from scanprep.skeleton.sides import Sides
from scanprep.skeleton.symmetry import Symmetry, find_symmetry, mirror_poses
from scanprep.synthetic.anatomy import MIRROR_PART
from scanprep.synthetic.people import SyntheticPerson, mirror_synthetic_pose

CONFIG = SkeletonConfig(restarts=1)


@pytest.fixture(scope="module")
def animal():
    return Animal(Build(aside=0.0))


@pytest.fixture(scope="module")
def poses(animal):
    rng = np.random.default_rng(0)
    return np.stack([animal.mesh.vertices, *(animal.posed(random_pose(rng)) for _ in range(13))])


@pytest.fixture(scope="module")
def found(animal, poses):
    return search_skeleton(animal.mesh, poses, CONFIG)


def shares(mesh, skeleton):
    return np.bincount(skeleton.part_of_face, mesh.face_areas) / mesh.face_areas.sum()


def adjusted_rand(a, b):
    table = np.zeros((a.max() + 1, b.max() + 1))
    np.add.at(table, (a, b), 1)
    together, rows, columns = ((t * (t - 1) / 2).sum() for t in (table, table.sum(axis=1), table.sum(axis=0)))
    chance = rows * columns / (len(a) * (len(a) - 1) / 2)
    return (together - chance) / ((rows + columns) / 2 - chance)


@pytest.mark.parametrize("seed", range(2))
def test_the_plane_of_a_person_is_found_in_any_direction_and_order(seed):
    rng, body = np.random.default_rng(seed), SyntheticPerson()
    R, old = rotations.exp(rng.normal(0, 2, 3)), rng.permutation(len(body.mesh.faces))
    symmetry = find_symmetry(Mesh(body.mesh.vertices @ R.T + rng.normal(0, 3, 3), body.mesh.faces[old]))
    assert symmetry.holds and symmetry.distance < 0.005 and symmetry.returns > 0.99
    assert abs(symmetry.normal @ R[:, 0]) > np.cos(np.radians(1))
    part = body.part_of_face[old]
    assert (part[symmetry.partner] == MIRROR_PART[part]).mean() > 0.99


@pytest.mark.slow
def test_a_body_that_stands_crooked_is_judged_in_its_straightest_pose():
    body, bent = SyntheticPerson(), np.zeros((16, 3))
    bent[[4, 5, 10]] = [[0, -1.5, 0.4], [0, 0.8, 0.8], [-1.4, 0, 0]]
    crooked = body.mesh.with_vertices(body.in_pose(bent))
    alone = find_symmetry(crooked)
    helped = find_symmetry(crooked, np.stack([body.in_pose(bent / 2), body.mesh.vertices, body.in_pose(-bent / 2)]))
    assert not alone.holds and alone.pose == -1
    assert helped.holds and helped.pose == 1 and abs(helped.normal[0]) > 0.999


@pytest.mark.slow
@pytest.mark.parametrize("crooked", [False, True])
def test_a_mirrored_pose_is_that_of_the_other_side(crooked):
    body, bent = SyntheticPerson(), np.zeros((16, 3))
    bent[[4, 5, 10]] = [[0, -1.0, 0.4], [0, 0.8, 0.8], [-1.2, 0, 0]]
    poses = np.stack([body.mesh.vertices, body.in_pose(bent)])
    template = body.mesh.with_vertices(poses[1]) if crooked else body.mesh
    found = mirror_poses(template, poses, find_symmetry(template, poses))
    wanted = np.stack([body.mesh.vertices, body.in_pose(mirror_synthetic_pose(bent))])
    for one, other in zip(found, wanted, strict=True):
        R, t = rotations.procrustes(one, other)
        assert np.linalg.norm(one @ R.T + t - other, axis=1).max() < 0.01


@pytest.mark.slow
def test_parts_that_moved_on_one_side_alone_are_found_on_both():
    body, rng = SyntheticPerson(), np.random.default_rng(1)
    bent = np.zeros((5, 16, 3))
    for part in ("forearm_left", "thigh_right", "head", "upper_arm_left"):
        bent[1:, body.names.index(part)] = rng.normal(0, 0.5, (4, 3))
    poses = np.stack([body.in_pose(pose) for pose in bent])
    found = search_skeleton(body.mesh, poses, CONFIG)
    assert found.symmetric and part_partners(body.mesh, found.skeleton, found.symmetry) is not None
    # no knee bends in these poses, so a leg is one part
    assert {"forearm_left", "forearm_right", "leg_left", "leg_right", "head"} <= set(found.skeleton.names)


def test_a_lump_is_not_symmetric():
    animal = Animal(Build(aside=0.0))
    x = animal.mesh.vertices @ ODD
    lump = x * (1 + 0.5 * np.sin(x @ [[4.0, 1], [2, 5], [3, -2]]).sum(axis=1, keepdims=True)) + 0.4 * x[:, [1, 2, 0]]
    assert not find_symmetry(Mesh(lump, animal.mesh.faces)).holds


def mirrored_sheet(n):
    """A sheet of squares of one metre, n vertices a side, with its mirror image; and the faces of one side."""
    x, y = (g.ravel() for g in np.meshgrid(np.arange(n), np.arange(n), indexing="ij"))
    corner = np.flatnonzero((x < n - 1) & (y < n - 1))
    side = np.stack([corner, corner + n, corner + n + 1, corner, corner + n + 1, corner + 1], 1).reshape(-1, 3)
    number = np.where(x == 0, np.arange(n * n), np.arange(n * n) + n * n - n)         # of the mirrored vertices
    return Mesh(np.concatenate([np.stack([x, y, 0 * x], 1), np.stack([-x, y, 0 * x], 1)[x > 0]]).astype(float),
                np.concatenate([side, number[side][:, ::-1]])), side


def test_tied_labels_stay_connected_where_triangles_are_not_paired_one_to_one():
    """A triangle of the right side whose partner lies in another part takes the part that surrounds it."""
    sheet, side = mirrored_sheet(7)
    F, at = len(side), np.abs(sheet.corners.mean(axis=1))
    near = (at[:, 0] < 3).astype(np.int64)                                    # 1 at the plane of symmetry, else 0
    label = np.where(np.arange(2 * F) < F, 0, 2) + near
    pairing = (np.arange(2 * F) + F) % (2 * F)
    stray = F + int(np.linalg.norm(at[:F, :2] - [1.5, 3], axis=1).argmin())   # amid the near part of the right side
    pairing[stray] = int(np.linalg.norm(at[:F, :2] - [5, 3], axis=1).argmin())
    symmetry = Symmetry(np.array([1.0, 0, 0]), np.zeros(3), pairing, np.arange(2 * F) < F, 0.0, 1.0,
                        sheet.vertices * [-1, 1, 1])
    surface = PosedSurface(sheet, np.stack(2 * [sheet.vertices]))
    costs = (label[:, None] != np.arange(4)).astype(float)
    moved = Sides(surface, symmetry).relabel(costs, 1e-3, label, np.array([2, 3, 0, 1]))
    assert moved[stray] == 3 and label_patches(surface.pairs, moved).max() + 1 == 4


def test_borders_of_one_side_stand_for_those_of_both():
    """What a symmetric labelling costs on the side that is labelled is what it costs on the whole: a sheet in squares
    of one metre, with borders of 7 m on either side and of 3 m on the plane; in the middle one part reaches over it.
    """
    sheet, side = mirrored_sheet(5)
    F = len(side)
    left, image = np.arange(2 * F) < F, sheet.vertices * [-1, 1, 1]
    symmetry = Symmetry(np.array([1.0, 0, 0]), np.zeros(3), (np.arange(2 * F) + F) % (2 * F), left, 0.0, 1.0, image)
    surface = PosedSurface(sheet, np.stack(2 * [sheet.vertices]))
    sides = Sides(surface, symmetry)
    at = sheet.corners[:F].mean(axis=1)
    own = np.select([at[:, 1] < 1, at[:, 0] < 2], [2, 0], 1)                 # 2 reaches over the plane
    label = np.concatenate([own, np.array([3, 4, 2])[own]])
    partner, (a, b), (i, j) = sides.partners(label), surface.pairs.T, sides.pairs.T
    assert partner.tolist() == [3, 4, 2, 0, 1]
    whole = surface.pair_lengths[label[a] != label[b]].sum()
    half = sides.lengths[own[i] != own[j]].sum() + sides.middle[partner[own] != own].sum()
    assert half == pytest.approx(whole) and whole == pytest.approx(2 * (4 + 3) + 3)
    # one part over the plane, where what it costs more, on 64 triangles, is less than its 4 m of border there
    split = np.where(left, 0, 3)
    for more in (0.02, 0.09):
        costs = np.full((2 * F, 5), 9.0)
        costs[np.arange(2 * F), split], costs[:, 2] = 0, more
        wanted = 2 if 2 * F * more < 4 else split
        assert (sides.relabel(costs, 1.0, split, partner) == wanted).all()


def test_a_symmetric_animal_gets_its_twelve_symmetric_parts(animal, poses, found):
    skeleton, truth = found.skeleton, animal.skeleton
    assert found.symmetric and found.symmetry.holds and len(found.energies) == 1 and found.energies[0] > 0
    assert len(skeleton.parents) == 12
    partner = part_partners(animal.mesh, skeleton, found.symmetry)
    assert partner is not None and (partner == np.arange(12)).sum() == 4
    share = shares(animal.mesh, skeleton)
    assert (np.abs(share - share[partner]) < 0.15 * share).all()
    assert adjusted_rand(truth.part_of_face, skeleton.part_of_face) > 0.92
    for j in range(1, 12):
        assert np.linalg.norm(skeleton.joints - truth.joints[j], axis=1).min() < 0.03


def test_another_seed_finds_the_same_tree(animal, poses, found):
    again = search_skeleton(animal.mesh, poses, replace(CONFIG, seed=7))
    assert adjusted_rand(found.skeleton.part_of_face, again.skeleton.part_of_face) >= 0.98
    assert len(again.skeleton.parents) == 12


def test_a_band_between_two_parts_is_no_part(animal, poses):
    """A ring cut out where the knee bends dissolves, its neighbours do not."""
    surface, truth = PosedSurface(animal.mesh, poses), animal.skeleton
    search, free = PartSearch(surface, CONFIG, find_symmetry(animal.mesh)), PartSearch(surface, CONFIG)
    knee = np.linalg.norm(animal.mesh.corners.mean(axis=1) - truth.joints[5], axis=1) < 0.09
    label = np.where(knee & np.isin(truth.part_of_face, [4, 5]), 12, truth.part_of_face)
    assert (label == 12).sum() > 16
    explained = passages(free, label)[0]
    assert explained[12] > 0.8 > explained[:12].max()
    assert dissolve_bands(free, label).max() == 11
    assert passages(search, truth.part_of_face)[0].max() < 0.8


def test_a_loop_is_opened(animal, poses):
    """The barrel cut into four quarters around its length: they close a loop, and become one."""
    surface, truth = PosedSurface(animal.mesh, poses), animal.skeleton
    search = PartSearch(surface, CONFIG)
    across = (animal.mesh.corners.mean(axis=1) @ ODD)[:, [1, 2]] > 0
    quarter = across @ [1, 2]
    label = np.where(truth.part_of_face == 0, np.where(quarter == 0, 0, quarter + 11), truth.part_of_face)
    count = label.max()
    label, links = to_tree(search, label)
    assert len(links) == label.max() < count and len(without_weak(search, label)) >= len(links)


def test_costs_of_rigid_motions_without_the_motions():
    rng = np.random.default_rng(0)
    mesh = Animal().mesh
    turned = [mesh.vertices @ rotations.exp(rng.normal(size=3)).T for _ in range(9)]
    poses = np.stack([x * rng.uniform(-1.1, 1.1, 3) for x in turned])
    surface = PosedSurface(mesh, poses)
    moments = surface.moments(rng.integers(0, 40, len(mesh.faces)))
    exact = fit_motions(moments).cost
    np.testing.assert_allclose(rigid_costs(moments), exact, atol=1e-12 * moments.yy.max())
    rigid = PosedSurface(mesh, np.stack([mesh.vertices @ rotations.exp([0, 0, k]).T for k in range(3)]))
    assert rigid_costs(rigid.moments(np.zeros(len(mesh.faces), dtype=int)))[0] < 1e-14
