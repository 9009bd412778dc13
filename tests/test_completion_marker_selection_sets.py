"""Marker sets: the fast updates are the direct solves, greedy is near the best of all subsets, pairs stay together."""
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from completion_bodies import worm_with_prior
from derivatives import differences

from completion.mocap.marker_selection.design import design_markers
from completion.mocap.marker_selection.fits import BodyPoints, DesignConfig, rough_poses, vertex_errors
from completion.mocap.marker_selection.greedy import ADD, REMOVE, MarkerSets, exchange, improve_set, symmetric_groups
from completion.mocap.marker_selection.linear import LinearBodies, fit_bodies
from completion.mocap.marker_sets.layout import MarkerLayout
from model.fitting.vertices import spread_vertices
from scanprep.geometry import rotations

MODEL = worm_with_prior()
RNG = np.random.default_rng(4)
LABELS = ("LA", "RA", "LB", "RB", "LC", "RC", "LD", "RD", "C1", "C2", "C3", "C4", "C5")
CANDIDATES = MarkerLayout(LABELS, spread_vertices(MODEL.template.vertices, len(LABELS)), 0.0)
POSES = MODEL.pose_mean + RNG.normal(0, 0.3, (5, 4, 3))
BODIES = MODEL.vertices(POSES, RNG.normal(0, 1, (5, 3)), RNG.normal(0, 1, (5, 3))) \
    + RNG.normal(0, 0.002, (5, *MODEL.template.vertices.shape))
CONFIG = DesignConfig(count=7)
FITS = fit_bodies(MODEL, BODIES, CANDIDATES, CONFIG)
GROUPS = symmetric_groups(LABELS)
SINGLES = tuple((i,) for i in range(len(LABELS)))


def small(Z=3, C=7, P=5, seed=0) -> LinearBodies:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(Z, P, P))
    return LinearBodies(rng.normal(size=(Z, C, 3, P)), rng.normal(size=(Z, C, 3)), root @ np.swapaxes(root, 1, 2),
                        rng.normal(size=(Z, P)), np.full(Z, 99.0), np.eye(P), rng.normal(size=(Z, P)))


def test_points_are_those_of_the_model_and_their_jacobian_is_the_finite_difference():
    points = BodyPoints(MODEL.points(CANDIDATES.vertices))
    x = np.concatenate([POSES.reshape(5, -1), RNG.normal(0, 1, (5, 6))], axis=1)
    at = points.follow(x)
    exact = MODEL.vertices(POSES, x[:, 15:], x[:, 12:15])[:, CANDIDATES.vertices]
    assert np.allclose(at.positions, exact, atol=1e-9) and np.allclose(points.positions(x), exact, atol=1e-9)
    some = points.some(np.array([2, 5]))
    assert np.allclose(some.follow(x).jacobian, at.jacobian[:, [2, 5]], atol=1e-12)
    slopes = differences(lambda step: points.positions(x + step), np.zeros(x.shape[1]), 1e-5)
    np.testing.assert_allclose(at.jacobian, slopes, atol=1e-7, rtol=1e-5)


@pytest.mark.parametrize("groups", [SINGLES, GROUPS], ids=["singles", "pairs"])
@pytest.mark.parametrize("sign", [ADD, REMOVE])
def test_every_step_is_the_direct_solve(groups, sign):
    linear, everything = FITS.linear, np.arange(len(groups))
    sets = MarkerSets(linear, groups, everything if sign == REMOVE else [])
    path = improve_set(sets, sign, np.ones(len(groups), bool), 3 if sign == REMOVE else len(LABELS))
    assert len(path.steps) > 5
    for i in range(len(path.counts)):
        members = [c for g in path.set(i) for c in groups[g]]
        assert len(members) == path.counts[i]
        assert path.rmse[i] == pytest.approx(linear.rmse(members), rel=1e-7 if sign == ADD else 1e-8)
    inside = np.flatnonzero(sets.inside)
    for g in np.flatnonzero(~sets.inside)[:4]:
        with_it = [c for h in (*inside, g) for c in groups[h]]
        assert sets.score_groups(np.array([g]), ADD)[0] == pytest.approx(linear.rmse(with_it)**2, rel=1e-8)


@pytest.mark.parametrize("seed", range(4))
def test_greedy_is_never_better_than_the_best_subset_and_finds_it_one_step_away(seed):
    linear, free = small(seed=seed), np.ones(7, bool)
    groups = tuple((i,) for i in range(7))
    best = {n: min(linear.rmse(list(each)) for each in combinations(range(7), n)) for n in range(1, 8)}
    down = improve_set(MarkerSets(linear, groups, range(7)), REMOVE, free, 1)
    up = improve_set(MarkerSets(linear, groups, []), ADD, free, 7)
    for path in (down, up):
        for count, rmse in zip(path.counts, path.rmse, strict=True):
            assert count == 0 or rmse >= best[count] * (1 - 1e-9)
    assert down.rmse[1] == pytest.approx(best[6]) and up.rmse[1] == pytest.approx(best[1])
    for count in (3, 4):
        sets = MarkerSets(linear, groups, down.set(down.at(count)))
        before = sets.rmse
        while exchange(sets, free):
            pass
        assert best[count] * (1 - 1e-6) <= sets.rmse <= before * (1 + 1e-6)
        chosen = np.flatnonzero(sets.inside)
        for out, new in ((o, n) for o in chosen for n in np.flatnonzero(~sets.inside)):       # no exchange is left
            assert linear.rmse(np.union1d(np.setdiff1d(chosen, [out]), [new])) >= sets.rmse * (1 - 1e-6)


def test_two_single_markers_are_exchanged_for_a_pair_and_back():
    linear, free = small(C=4), np.ones(3, bool)
    groups = ((0, 1), (2,), (3,))
    good, bad = (linear.rmse(list(each)) for each in ((0, 1), (2, 3)))
    for start in ([0], [1, 2]):
        sets = MarkerSets(linear, groups, start)
        while exchange(sets, free):
            pass
        assert sets.rmse == pytest.approx(min(good, bad)) and sets.count == 2


def test_pairs_come_and_go_together_and_kept_markers_stay():
    config = replace(CONFIG, through=(5, 9))
    design = design_markers(MODEL, BODIES, CANDIDATES, config, keep=("C2", "LB"))
    assert len(design.layout.labels) == 7 and {"C2", "LB", "RB"} <= set(design.layout.labels)
    for curve in design.curves:
        assert np.abs(np.diff(curve.counts)).tolist() == [len(labels) for labels in curve.steps]
        assert all({label[1:] for label in labels} == {labels[0][1:]} for labels in curve.steps)
        if curve.name != "kept, removed":
            assert {5, 7, 9} <= set(curve.counts.tolist())
            assert not {"C2", "LB", "RB"} & {label for labels in curve.steps for label in labels}
    assert design.full == pytest.approx(design.rmse, rel=0.05)
    assert design.floor <= design.rmse <= 1.05 * design.other_half


def test_full_refits_end_where_their_energy_is_least():
    chosen = list(range(11))
    x = FITS.refit(chosen, CONFIG)
    points, goal = FITS.markers.some(np.array(chosen)), FITS.places[:, chosen]

    def energy(x):
        return ((points.positions(x) - goal)**2).sum(axis=(1, 2)) / CONFIG.marker_sd**2 + FITS.prior.system(x)[0]

    assert (energy(x) <= energy(FITS.x)).all()
    for _ in range(20):
        step = RNG.normal(0, 1e-3, x.shape)
        assert (energy(x + step) > energy(x) * (1 - 1e-4)).all()
    assert np.sqrt(vertex_errors(MODEL, x, BODIES).mean()) == pytest.approx(FITS.linear.rmse(chosen), rel=0.05)


def test_moved_turned_and_reordered_bodies_have_the_same_markers():
    config = CONFIG
    design = design_markers(MODEL, BODIES, CANDIDATES, config)
    R = rotations.exp(np.array([0.2, -0.4, 0.3]))
    moved = design_markers(MODEL, (BODIES @ R.T + [3.0, -1.0, 2.0])[::-1], CANDIDATES, config)
    order = RNG.permutation(len(LABELS))
    other = design_markers(MODEL, BODIES, CANDIDATES.select([LABELS[i] for i in order]), config)
    assert set(other.layout.labels) == set(design.layout.labels)
    assert other.rmse == pytest.approx(design.rmse, rel=1e-6)
    assert moved.layout.labels == design.layout.labels
    assert moved.rmse == pytest.approx(design.rmse, rel=0.01)


def test_rough_poses_are_near():
    assert np.abs(rough_poses(MODEL, BODIES, 3)[:, :12].reshape(5, 4, 3) - POSES).max() < 0.25


def test_wrong_input_is_told():
    for count in (2, 14):
        with pytest.raises(ValueError, match=r"count: expected 3\.\.13 markers"):
            design_markers(MODEL, BODIES, CANDIDATES, DesignConfig(count=count))
    with pytest.raises(ValueError, match=r"bodies: expected finite numbers of shape \(Z, 398, 3\), got shape"):
        design_markers(MODEL, BODIES[0], CANDIDATES, CONFIG)
    with pytest.raises(ValueError, match="keep: NOSE not among the candidates"):
        design_markers(MODEL, BODIES, CANDIDATES, CONFIG, keep=("NOSE",))
    with pytest.raises(ValueError, match=r"candidates: expected markers on vertices 0\.\.397"):
        design_markers(MODEL, BODIES, MarkerLayout(("A", "B", "C"), [0, 1, 398]), replace(CONFIG, count=3))
