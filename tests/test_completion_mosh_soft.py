"""Soft tissue: skin or betas that moved are found, in size and phase, and nothing where nothing moved."""
from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from conformance_bodies import KINDS
from derivatives import differences

from completion import MarkerLayout, MarkerSequence, Motion, follow_soft_tissue
from completion.mocap.pose.foot_contact import Floor
from completion.mocap.pose.marked_body import supports
from completion.mocap.soft_tissue import follow
from completion.mocap.soft_tissue.follow import ShapeFollower, SkinFollower, SoftTissueConfig, variances, whiten
from completion.mocap.soft_tissue.soft_tissue import (
    SkinMovement,
    SoftTissue,
    changing_bodies,
    in_root,
    skin_movement,
    smooth_modes,
)
from completion.viewing.soft import soft_columns
from model.body import BodyModel
from scanprep.geometry import rotations
from scanprep.geometry.geodesics import SurfaceGraph
from scanprep.geometry.storage import StorageError

T, RATE, SIZE = 48, 120.0, 0.01
OWN = np.array([0.6, -0.4, 0.3])
FREQUENCY = 5.0                      # hertz


@cache
def body(kind: str = "scape-quadratic") -> BodyModel:
    """The worm, two metres long."""
    return KINDS[kind]()


def layout(model: BodyModel, distance: float = 0.0, count: int = 80) -> MarkerLayout:
    """Markers all over a body."""
    rows = np.random.default_rng(2).choice(len(model.template.faces), count, replace=False)
    weights = np.random.default_rng(3).dirichlet(np.ones(3), count)
    return MarkerLayout(tuple(f"M{i}" for i in range(count)), model.template.faces[rows], distance, weights)


def moving(model: BodyModel) -> tuple[np.ndarray, np.ndarray]:
    """Poses and places over time."""
    t = np.arange(T)[:, None, None] / RATE
    poses = model.pose_mean + 0.25 * np.sin(3 * t + np.arange(4)[None, :, None] + np.arange(3))
    return poses, np.array([0.2, 0.1, 1.0]) + t[:, 0] * np.array([1.0, 0, 0])


def bump(model: BodyModel, radius: float = 0.2) -> np.ndarray:
    """(N,) what swings: the skin around a vertex in the middle of the worm."""
    return np.exp(-(SurfaceGraph(model.template).distances(200) / radius)**2)


def swing(model: BodyModel, size: float = SIZE) -> tuple[np.ndarray, np.ndarray]:
    """The skin (T, N, 3) of the worm that moves, and what a bump adds to it."""
    poses, trans = moving(model)
    skin = model.subject(OWN).vertices(poses, trans)
    normals = np.array([model.template.with_vertices(v).vertex_normals for v in skin])
    phase = 2 * np.pi * FREQUENCY * np.arange(T) / RATE + 1.0
    return skin, size * np.sin(phase)[:, None, None] * bump(model)[:, None] * normals


def seen(model: BodyModel, where: MarkerLayout, size: float = SIZE, noise: float = 0.001
         ) -> tuple[MarkerSequence, Motion]:
    """The markers of the worm whose skin swings, and its motion."""
    positions = np.stack([where.place(model.template.with_vertices(v)) for v in sum(swing(model, size))])
    positions += np.random.default_rng(4).normal(0, noise, positions.shape) if noise else 0
    return MarkerSequence(positions, where.labels, RATE), fixed(*moving(model), where)


def fixed(poses: np.ndarray, trans: np.ndarray, where: MarkerLayout) -> Motion:
    """A motion of the worm's own shape."""
    return Motion(poses, trans, OWN, RATE, np.zeros((len(poses), len(where.labels))), where.labels)


def soft_of(model: BodyModel) -> SoftTissue:
    """The worm with skin that moves under four places."""
    poses, trans = moving(model)
    modes, _ = smooth_modes(model.template, np.array([20, 120, 220, 320]), 0.2)
    moved = SIZE * np.sin(np.arange(T * 12).reshape(T, 4, 3))
    return SoftTissue(fixed(poses, trans, layout(model)), np.zeros((T, 3)), SkinMovement(modes, moved))


def test_skin_that_swings_is_found_in_size_and_phase() -> None:
    model, where = body(), layout(body(), 0.01, 160)                           # a marker every 10 cm
    markers, motion = seen(model, where)
    found = follow_soft_tissue(model, motion, markers, where)
    skin, swung = swing(model)
    moved = found.vertices(model) - found.vertices(model, factor=0.0)
    turn = 2j * np.pi * FREQUENCY * np.arange(T) / RATE                        # two whole swings
    one, other = (np.tensordot(np.exp(turn), each, axes=1) for each in (moved, swung))
    share = (one * other.conj()).sum() / (np.abs(other)**2).sum()
    assert 0.8 < abs(share) < 1.1 and abs(np.angle(share)) < np.radians(5)
    before, after = (np.linalg.norm(each - skin - swung, axis=2)[:, bump(model) > 0.3].mean()
                     for each in (skin, found.vertices(model)))
    assert after < 0.6 * before and np.nanmean(found.motion.residuals) < 0.002
    np.testing.assert_array_equal(found.motion.betas, OWN)


def test_poses_do_not_follow_soft_tissue() -> None:
    model, where = body(), layout(body(), 0.01)
    markers, motion = seen(model, where, 3 * SIZE)
    found = follow_soft_tissue(model, motion, markers, where).motion
    skin, swung = swing(model, 3 * SIZE)
    off = np.linalg.norm(found.vertices(model.subject(OWN)) - skin, axis=2)
    assert off.mean() < 0.25 * np.linalg.norm(swung, axis=2).mean()


def test_noise_is_not_taken_for_soft_tissue() -> None:
    model, where = body(), layout(body())
    markers, motion = seen(model, where, 0.0)
    found = follow_soft_tissue(model, motion, markers, where)
    moved = found.vertices(model) - found.vertices(model, factor=0.0)
    assert np.sqrt((moved**2).sum(axis=2).mean()) < 0.001


def test_modes_are_one_at_their_place_and_die_away() -> None:
    model = body()
    places = layout(model, count=12).nearest
    modes, root = smooth_modes(model.template, places, 0.1)
    np.testing.assert_allclose(modes[places], np.eye(12), atol=1e-9)
    far = SurfaceGraph(model.template).distances(places).min(axis=0) > 0.4
    assert far.any() and not modes[far].any()
    np.testing.assert_allclose(np.diag(root @ root.T), 1)
    places, smooth = np.arange(0, 398, 2), bump(model, 0.3)
    close, root = smooth_modes(model.template, places, 0.15)
    assert root.shape[1] < 150                                               # many places: the finest patterns are out
    np.testing.assert_allclose(close @ smooth[places], smooth, atol=0.05)


def test_whitened_markers_are_independent() -> None:
    rng = np.random.default_rng(0)
    covariance = np.cov(rng.normal(size=(6, 20)))
    share = rng.uniform(0, 1, (3, 6))
    share[0, 2] = 0
    W = whiten(covariance, share)
    for mine, counts in zip(W, share, strict=True):
        some = counts > 0                                        # the noise of a marker that counts is 1 / share
        wanted = np.zeros((6, 6))
        wanted[np.ix_(some, some)] = np.linalg.inv(covariance[np.ix_(some, some)] + np.diag(1 / counts[some]))
        np.testing.assert_allclose(mine @ mine.T, wanted, atol=1e-12)


def test_derivatives_are_finite_differences() -> None:
    model, where = body(), layout(body(), 0.01, 20)
    markers, motion = seen(model, where, noise=0.005)
    follower = SkinFollower(model, motion, markers, where, SoftTissueConfig())
    x = follower.body.body.join(motion.poses[:2], motion.trans[:2])
    given = markers.positions[:2], 100 * whiten(follower.root @ follower.root.T, np.full((2, 20), 0.7))
    _, gradient, _ = follower.system(x, *given)
    slopes = differences(lambda d: follower.system(follower.body.retract(x, np.tile(d, (2, 1))), *given)[0],
                         np.zeros(x.shape[1]))
    np.testing.assert_allclose(gradient, slopes / 2, rtol=1e-5, atol=1e-4)


def test_the_movement_is_the_mean_of_a_gaussian_process() -> None:
    """Without smoothness over time: K (K + noise)⁻¹ of what markers are off, a missing one left out."""
    model, where = body(), layout(body(), count=20)
    markers, motion = seen(model, where)
    follower = SkinFollower(model, motion, markers, where, SoftTissueConfig(temporal_smoothness=0.0))
    off = in_root(follower.off(follower.body.body.join(motion.poses, motion.trans), markers.positions), motion.poses)
    share = np.ones((T, 20))
    share[3, 5] = 0
    size = follow.LOOSE * np.sqrt(np.maximum(variances(off, share) - 1e-6, 1e-8))
    root, some = size[:, None] * follower.root, np.arange(20) != 5
    K = root @ root.T
    found = follower.solve_displacements(off, share)
    for t, used in ((3, some), (7, np.full(20, True))):
        wanted = K[:, used] @ np.linalg.solve(K[np.ix_(used, used)] + 1e-6 * np.eye(used.sum()), off[t, used])
        np.testing.assert_allclose(found[t], wanted, atol=1e-6)


def test_the_world_may_be_turned() -> None:
    model, where = body(), layout(body(), 0.01)
    markers, motion = seen(model, where, noise=0.002)
    R, shift = rotations.exp(np.array([0.4, -1.0, 0.7])), np.array([0.3, 1.0, -2.0])
    origin = model.skeleton.joints[0]
    poses = motion.poses.copy()
    poses[:, 0] = rotations.log(R @ rotations.exp(poses[:, 0]))
    elsewhere = fixed(poses, (motion.trans + origin) @ R.T + shift - origin, where)
    turned = replace(markers, positions=markers.positions @ R.T + shift)
    one = follow_soft_tissue(model, motion, markers, where)
    other = follow_soft_tissue(model, elsewhere, turned, where)
    np.testing.assert_allclose(other.skin.moved, one.skin.moved, rtol=0, atol=1e-4)
    np.testing.assert_allclose(other.vertices(model), one.vertices(model) @ R.T + shift, rtol=0, atol=1e-4)


def changing(model: BodyModel, where: MarkerLayout, changes: np.ndarray) -> tuple[MarkerSequence, Motion]:
    """The markers of the worm whose betas change, and the motion of the one whose do not."""
    poses, trans = moving(model)
    meshes = changing_bodies(model, poses, OWN + changes, trans)
    positions = np.stack([where.place(model.template.with_vertices(v)) for v in meshes])
    return MarkerSequence(positions, where.labels, RATE), fixed(poses, trans, where)


@pytest.mark.parametrize("kind", KINDS)
def test_betas_that_changed_are_found(kind: str) -> None:
    model, where = body(kind), layout(body(kind), count=40)
    changes = 0.5 * np.sin(2 * np.pi * np.array([2.0, 3.0, 5.0]) * np.arange(T)[:, None] / RATE + np.arange(3))
    believing = SoftTissueConfig(pose=1e-4, velocity=1e-3, shape_change=1e-4)
    markers, motion = changing(model, where, changes)
    found = follow_soft_tissue(model, motion, markers, where, believing)
    np.testing.assert_allclose(found.changes, changes, rtol=0, atol=5e-3)
    assert found.skin is None and np.nanmax(found.motion.residuals) < 2e-4 and found.motion.converged.all()
    held = follow_soft_tissue(model, motion, markers, where, replace(believing, shape_change=1e8))
    assert np.abs(held.changes).max() < 1e-3


def test_betas_are_those_of_the_papers_energy() -> None:
    """At the poses found, no other betas have less of Eq. 24; markers that are missing count nothing."""
    model, where, config = body(), layout(body(), 0.01, 20), SoftTissueConfig.from_paper()
    markers, motion = seen(model, where)
    gone = markers.positions.copy()
    gone[5:9, 3] = np.nan
    found = follow_soft_tissue(model, motion, replace(markers, positions=gone), where, config)
    follower = ShapeFollower(model, motion, markers, where, config)
    x = follower.body.body.join(found.motion.poses, found.motion.trans)
    off = np.where(np.isnan(gone), 0, gone - follower.body.positions(x))
    D = follower.slopes(x).reshape(T, 3, 20, 3)

    def energy(z: np.ndarray) -> np.ndarray:
        away = np.where(np.isnan(gone), 0, off - np.einsum("tdlk,tk->tld", D, z))
        return 0.75e4 * (away**2).sum(axis=(1, 2)) + 0.25 * (z**2).sum(axis=1)
    least = energy(found.changes)
    for step in (0.01, -0.01):
        for k in range(3):
            assert (energy(found.changes + step * np.eye(3)[k]) > least).all()


@pytest.mark.parametrize("rate", [60.0, 120.0, 240.0])
def test_changes_of_velocity_weigh_as_in_the_paper(rate: float) -> None:
    """[MoSh] Eq. 24: lambda_u at 120 frames a second; in twice as many frames the same motion changes a fourth each."""
    markers, motion = seen(body(), layout(body()))
    config = SoftTissueConfig.from_paper()
    follower = ShapeFollower(body(), motion, replace(markers, rate=rate), layout(body()), config)
    np.testing.assert_allclose(follower.inertia[:-3], 6.25 * (rate / 120)**4)
    assert (config.data, config.pose, config.shape_change) == (0.75, 1.0, 0.25)
    assert follower.weight == pytest.approx(config.data * 100**2)                          # of square centimetres
    skin = SkinFollower(body(), motion, replace(markers, rate=rate), layout(body()), SoftTissueConfig())
    assert skin.smoothness == pytest.approx(2.0 * (rate / 120)**4)


def test_exaggeration_points_columns_and_movement() -> None:
    model = body()
    soft = soft_of(model)
    still, once, twice = (soft.vertices(model, slice(3, 6), factor) for factor in (0.0, 1.0, 2.0))
    np.testing.assert_allclose(twice - still, 2 * (once - still), rtol=0, atol=1e-12)
    np.testing.assert_allclose(soft.times(2.0).vertices(model, slice(3, 6)), twice, rtol=0, atol=1e-12)
    moved = soft.vertices(model) - soft.vertices(model, factor=0.0)
    np.testing.assert_allclose(soft.movement(model), np.sqrt((moved**2).sum(axis=2).mean(axis=0)), rtol=0, atol=1e-12)
    ids, weights = supports(model.template, layout(model))
    for each in (soft, replace(soft, changes=np.sin(np.arange(3 * T)).reshape(T, 3))):
        wanted = np.einsum("lk,tlkd->tld", weights, each.vertices(model)[:, ids])
        np.testing.assert_allclose(each.points(model, ids, weights), wanted, rtol=0, atol=1e-9)
    basis, coefficients = soft_columns(soft, model, soft.vertices(model, slice(0, T, 2)))
    assert np.abs(basis @ coefficients - soft.vertices(model)).max() < 1e-3


def test_files_of_now_and_of_before(tmp_path) -> None:
    model = body()
    soft = soft_of(model)
    soft.save(tmp_path / "soft.npz")
    read = SoftTissue.load(tmp_path / "soft.npz")
    np.testing.assert_allclose(read.vertices(model), soft.vertices(model), rtol=0, atol=1e-7)
    np.testing.assert_array_equal(Motion.load(tmp_path / "soft.npz").betas, OWN)      # as a motion of the fixed shape
    with np.load(tmp_path / "soft.npz") as stored:                    # what a version that knows changes of betas reads
        assert stored["shape_changes"].shape == (T, 3) and not stored["shape_changes"].any()
    changes = np.sin(np.arange(3 * T)).reshape(T, 3)
    before = SoftTissue(soft.motion, changes)
    before.save(tmp_path / "before.npz")
    read = SoftTissue.load(tmp_path / "before.npz")
    assert read.skin is None
    np.testing.assert_array_equal(read.betas(2.0), OWN + 2 * changes)
    np.testing.assert_allclose(skin_movement(model, 3 * changes), 3 * read.movement(model))
    soft.motion.save(tmp_path / "fixed.npz")
    with pytest.raises(StorageError, match="shape_changes"):
        SoftTissue.load(tmp_path / "fixed.npz")
    soft.motion.save(tmp_path / "broken.npz", shape_changes=changes, skin_modes=np.ones((398, 4)),
                     skin_moved=np.ones((T, 5, 3)))
    with pytest.raises(StorageError, match="skin_modes and skin_moved"):
        SoftTissue.load(tmp_path / "broken.npz")


def test_what_does_not_belong_together_is_refused() -> None:
    model, where = body(), layout(body())
    markers, motion = seen(model, where)
    for wrong, message in ((replace(motion, betas=None), "betas"), (replace(motion, betas=np.zeros(4)), "at most 3"),
                           (replace(motion, labels=tuple("x" * (i + 1) for i in range(80))), "labels")):
        with pytest.raises(ValueError, match=message):
            follow_soft_tissue(model, wrong, markers, where)
    with pytest.raises(ValueError, match="48 frames, 80 labels"):
        follow_soft_tissue(model, motion, markers.frames(slice(0, 5)), where)
    with pytest.raises(ValueError, match="k at most 3"):
        changing_bodies(model, motion.poses, np.zeros((T, 4)), motion.trans)


def test_what_stands_on_the_floor_does_not_slide_while_the_skin_moves():
    model, rng = body(), np.random.default_rng(6)
    poses = np.repeat(model.pose_mean[None], T, axis=0)
    poses[:, -1, 2] += 0.2 * np.sin(np.arange(T) / 8)                                          # the rest stands still
    where = layout(model, 0.0, 40)
    motion = fixed(poses, np.zeros((T, 3)), where)
    own = model.subject(OWN)
    truth = motion.vertices(own)
    placed = np.stack([where.place(model.template.with_vertices(v)) for v in truth])
    markers = MarkerSequence(placed + rng.normal(0, 0.005, placed.shape), where.labels, RATE)
    floor = Floor.below(truth)
    free, held = (follow_soft_tissue(model, motion, markers, where, ground=ground)
                  .motion.vertices(own) for ground in (False, True))
    soles = np.flatnonzero((floor.above(truth) < 0.01).all(axis=0))
    slide = [np.linalg.norm(np.diff(v[:, soles], axis=0), axis=2).mean() for v in (free, held)]
    assert slide[1] < 0.5 * slide[0]
    assert np.linalg.norm(held - truth, axis=2).mean() < 1.05 * np.linalg.norm(free - truth, axis=2).mean()
