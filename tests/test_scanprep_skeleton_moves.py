"""The moves of the search for parts: halves of many groups at once, and an end where every move is taken back."""
import numpy as np
import pytest
from animal_bodies import Animal, Build, random_pose

from scanprep.skeleton import joints
from scanprep.skeleton.joints import dissolve_bands, passages
from scanprep.skeleton.labels import field_energy, relabel
from scanprep.skeleton.motions import PosedSurface, agglomerate, halve, rigid_costs
from scanprep.skeleton.parts import PartSearch, SkeletonConfig


@pytest.fixture(scope="module")
def search():
    rng, animal = np.random.default_rng(3), Animal(Build(aside=0.0))
    poses = np.stack([animal.posed(random_pose(rng)) for _ in range(5)])
    poses += rng.normal(0, 0.01, poses.shape)
    return PartSearch(PosedSurface(animal.mesh, poses), SkeletonConfig(separation=1e6), patches=120)


@pytest.fixture
def label(search):
    """Twelve parts, each of several patches."""
    return agglomerate(search.surface.moments(search.patch), search.contacts(search.patch), 12)[search.patch]


def test_groups_are_halved_side_by_side_as_one_by_one(search, label):
    used, piece = np.unique(label * (search.patch.max() + 1) + search.patch, return_inverse=True)
    group = used // (search.patch.max() + 1)
    moments, contacts = search.surface.moments(piece), search.contacts(piece)
    within = contacts[group[contacts[:, 0]] == group[contacts[:, 1]]]
    half = halve(moments, within, group)
    assert len(np.unique(group)) == 12
    for part in range(12):
        mine = np.flatnonzero(group == part)
        number = np.searchsorted(mine, within[group[within[:, 0]] == part])
        alone = agglomerate(moments[mine], number, 2)
        here = np.unique(half[mine], return_inverse=True)[1]
        costs = [np.sort(rigid_costs(moments[mine].gather(sets))) for sets in (alone, here)]
        np.testing.assert_allclose(*costs, rtol=1e-9, atol=1e-15)


def test_a_border_as_long_as_the_body_costs_a_hundredth_of_its_residual(search, label):
    """Counted over the edges of the mesh; the residual counts as no less than the tolerance, 0.1% of the size."""
    mesh, size = search.surface.mesh, np.sqrt(search.surface.mesh.face_areas.sum())
    border = sum(np.linalg.norm(np.subtract(*mesh.vertices[edge])) for edge, (a, b) in
                 zip(mesh.edges[mesh.edge_use == 2], mesh.face_pairs, strict=True) if label[a] != label[b])
    residual = search.motions(label).cost.sum()
    assert residual > (1e-3 * size)**2
    assert search.energy(label) == pytest.approx(residual * (1 + 0.01 * border / size), rel=1e-9)
    assert search.price(search.motions(label), 0.5) == pytest.approx(0.02 * residual / size)     # of half the surface
    rigid = PartSearch(PosedSurface(mesh, mesh.vertices[None].repeat(3, axis=0)), SkeletonConfig())
    assert rigid.energy(label) == pytest.approx(0.01 * border / size * (1e-3 * size)**2, rel=1e-6)


@pytest.mark.parametrize("seed", range(6))
def test_labels_of_two_kinds_are_the_best_of_all_and_of_three_no_expansion_is_better(seed):
    """Ten triangles with random costs, neighbours and prices, against all 1,024 labellings or expansions."""
    rng = np.random.default_rng(seed)
    pairs, every = np.argwhere(np.triu(rng.random((10, 10)) < 0.4, 1)), np.indices((2,) * 10).reshape(10, -1).T
    prices = rng.uniform(0.1, 0.6, len(pairs))
    for kinds in (2, 3):
        costs = rng.uniform(0, 1, (10, kinds))
        label = relabel(costs, pairs, prices, np.zeros(10, dtype=np.int64), rounds=20)
        energy = field_energy(costs, pairs, prices, label)
        differ = sum(price for (a, b), price in zip(pairs, prices, strict=True) if label[a] != label[b])
        assert energy == pytest.approx(costs[np.arange(10), label].sum() + differ)
        others = every if kinds == 2 else [np.where(turn, k, label) for turn in every for k in range(3)]
        assert energy <= min(field_energy(costs, pairs, prices, other) for other in others) + 1e-3    # whole numbers


@pytest.mark.parametrize("move", [dissolve_bands, PartSearch.join_down])
@pytest.mark.timeout(60)
def test_moves_that_the_alternation_takes_back_come_to_an_end(search, label, monkeypatch, move):
    """A band was dissolved and found again without end."""
    monkeypatch.setattr(joints, "FADING", 1e-6)
    assert passages(search, label)[0].max() > joints.FADING
    monkeypatch.setattr(PartSearch, "alternate", lambda *_, **__: label)
    np.testing.assert_array_equal(move(search, label), label)
