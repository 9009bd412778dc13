"""Soft tissue: the change of shape that was there is found, one that was not there is not."""
from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from conformance_bodies import KINDS

from completion import MarkerLayout, MarkerSequence, Motion, follow_soft_tissue
from completion.energy import lifted
from completion.mocap.mosh.quick_bodies import QuickBodies
from completion.mocap.pose.marked_body import supports
from completion.mocap.soft_tissue.changing_body import ChangingBody, changing_bodies, skin_metric, skin_movement
from completion.mocap.soft_tissue.soft_tissue import (
    SoftFollower,
    SoftTissue,
    SoftTissueConfig,
    cheap_directions,
    smooth_changes,
)
from model.body import BodyModel
from scanprep.geometry import rotations
from scanprep.geometry.storage import StorageError

T, RATE = 24, 60.0
OWN = np.array([0.6, -0.4, 0.3])
BELIEVING = SoftTissueConfig(change=1e-4, skin=0, pose=1e-4, velocity=1e-3, temporal_smoothness=0)


@cache
def body(kind: str = "scape-quadratic") -> BodyModel:
    """The worm."""
    return KINDS[kind]()


def layout(model: BodyModel, distance: float = 0.0, count: int = 40) -> MarkerLayout:
    """Markers all over a body."""
    rows = np.random.default_rng(2).choice(len(model.template.faces), count, replace=False)
    weights = np.random.default_rng(3).dirichlet(np.ones(3), count)
    return MarkerLayout(tuple(f"M{i}" for i in range(count)), model.template.faces[rows], distance, weights)


def moving(model: BodyModel) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Poses, places and changes of shape over time."""
    t = np.arange(T)[:, None, None] / RATE
    poses = model.pose_mean + 0.25 * np.sin(3 * t + np.arange(4)[None, :, None] + np.arange(3))
    changes = 0.5 * np.sin(2 * np.pi * np.array([2.0, 3.0, 5.0]) * t[:, 0] + np.arange(3))
    return poses, np.array([0.2, 0.1, 1.0]) + t[:, 0] * np.array([1.0, 0, 0]), changes


def seen(model: BodyModel, where: MarkerLayout, changes: np.ndarray, noise: float = 0.0
         ) -> tuple[MarkerSequence, Motion]:
    """The markers of a body that changes, and the motion of the one that does not."""
    poses, trans, _ = moving(model)
    meshes = changing_bodies(model, poses, OWN + changes, trans)
    positions = np.stack([where.place(model.template.with_vertices(v)) for v in meshes])
    positions += np.random.default_rng(4).normal(0, noise, positions.shape) if noise else 0
    return MarkerSequence(positions, where.labels, RATE), fixed(poses, trans, where)


def fixed(poses: np.ndarray, trans: np.ndarray, where: MarkerLayout) -> Motion:
    """A motion of the worm's own shape."""
    return Motion(poses, trans, OWN, RATE, np.zeros((len(poses), len(where.labels))), where.labels)


def swaying(model: BodyModel, where: MarkerLayout) -> ChangingBody:
    """The worm that sways along its betas."""
    return ChangingBody(model, OWN, where, np.eye(3), model.shape_jacobian(model.pose_mean), 0.3, 0.3)


@pytest.mark.parametrize("kind", KINDS)
def test_bodies_together_are_those_one_by_one(kind: str) -> None:
    model = body(kind)
    poses, trans, changes = moving(model)
    one_by_one = np.array([model.vertices(*each) for each in zip(poses, OWN + changes, trans, strict=True)])
    np.testing.assert_allclose(changing_bodies(model, poses, OWN + changes, trans), one_by_one, rtol=0, atol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_markers_are_where_the_body_has_them(kind: str) -> None:
    model = body(kind)
    poses, trans, changes = moving(model)
    for distance, within in ((0.0, 1e-10), (0.01, 5e-4)):                # normals are followed by regression
        where = layout(model, distance)
        markers, _ = seen(model, where, changes)
        sway = swaying(model, where)
        found = sway.positions(sway.marked.body.join(poses, trans), changes)
        assert np.linalg.norm(found - markers.positions, axis=2).mean() < within


def test_normals_that_turn_with_betas_are_followed() -> None:
    model, changes = body(), 2 * moving(body())[2]
    poses = np.repeat(model.pose_mean[None], T, axis=0)
    where = layout(model, 0.05)
    sway = swaying(model, where)
    x, trans = sway.marked.body.join(poses, np.zeros((T, 3))), np.zeros((T, 3))
    ids, weights = supports(model.template, where)
    exact, own = (lifted(np.einsum("lk,tlkd->tld", weights, changing_bodies(model, poses, betas, trans)[:, ids]),
                         np.asarray(where.distances)) for betas in (OWN + changes, OWN + 0 * changes))
    error = np.linalg.norm(sway.positions(x, changes) - sway.positions(x, 0 * changes) - (exact - own), axis=2)
    plain = swaying(model, replace(where, distances=0.0))
    without = np.linalg.norm(plain.positions(x, changes) - plain.positions(x, 0 * changes) - (exact - own), axis=2)
    assert error.mean() < 0.2 * without.mean()


def test_derivatives_are_finite_differences() -> None:
    model, step = body(), 1e-6
    where = layout(model, 0.01)
    sway, (poses, trans, changes) = swaying(model, where), moving(model)
    markers, _ = seen(model, where, changes, 0.01)
    x, z = sway.marked.body.join(poses[:2], trans[:2]), np.zeros((2, 3))
    given = markers.positions[:2], np.random.default_rng(5).uniform(1, 2, (2, 40))
    _, gradient, _ = sway.system(x, z, *given)
    P = x.shape[1]
    for k in range(P + 3):
        d = np.zeros((2, P + 3))
        d[:, k] = step
        ahead, behind = (sway.system(sway.marked.retract(x, way * d[:, :P]), z + way * d[:, P:], *given)[0]
                         for way in (1, -1))
        np.testing.assert_allclose(gradient[:, k], (ahead - behind) / (4 * step), rtol=1e-5, atol=1e-5)


def test_the_change_that_was_there_is_found() -> None:
    model = body()
    _, _, changes = moving(model)
    where = layout(model)
    markers, motion = seen(model, where, changes)
    found = follow_soft_tissue(model, motion, markers, where, BELIEVING)
    np.testing.assert_allclose(found.changes, changes, rtol=0, atol=5e-3)
    assert np.nanmax(found.motion.residuals) < 2e-4 and found.motion.converged.all()
    np.testing.assert_array_equal(found.motion.betas, OWN)


def test_noise_is_not_taken_for_soft_tissue() -> None:
    model, where = body(), layout(body())
    markers, motion = seen(model, where, np.zeros((T, 3)), 0.001)
    found = follow_soft_tissue(model, motion, markers, where)
    moved = found.vertices(model) - found.vertices(model, factor=0.0)
    assert np.sqrt((moved**2).sum(axis=2).mean()) < 0.0005


def test_skin_and_steadiness_hold_the_change() -> None:
    model, where = body(), layout(body())
    markers, motion = seen(model, where, moving(model)[2], 0.005)
    free = SoftTissueConfig(skin=0, temporal_smoothness=0)
    size, bend = {}, {}
    for name, config in (("free", free), ("skin", replace(free, skin=1000.0)),
                         ("steady", replace(free, temporal_smoothness=2e4)), ("still", replace(free, change=1e8))):
        changes = follow_soft_tissue(model, motion, markers, where, config).changes
        size[name], bend[name] = np.abs(changes).mean(), np.abs(np.diff(changes, n=2, axis=0)).mean()
    assert size["skin"] < 0.5 * size["free"] and size["still"] < 1e-4
    assert bend["steady"] < 0.3 * bend["free"] and size["steady"] > 0.5 * size["free"]


def test_steady_changes_without_steadiness_are_frame_by_frame() -> None:
    model, where = body(), layout(body())
    markers, motion = seen(model, where, moving(model)[2], 0.002)
    sway = swaying(model, where)
    x, weights = sway.marked.body.join(motion.poses, motion.trans), np.full((T, 40), 1e4)
    _, gradient, hessian = sway.change_system(x, markers.positions, weights)
    alone = -np.linalg.solve(hessian + np.eye(3), gradient[..., None])[..., 0]
    np.testing.assert_allclose(smooth_changes(sway, x, markers.positions, weights, 0.0), alone, rtol=1e-6, atol=1e-8)


def test_the_world_may_be_turned() -> None:
    model, where = body(), layout(body(), 0.01)
    _, _, changes = moving(model)
    markers, motion = seen(model, where, changes, 0.002)
    R, shift = rotations.exp(np.array([0.4, -1.0, 0.7])), np.array([0.3, 1.0, -2.0])
    origin = model.skeleton.joints[0]
    poses = motion.poses.copy()
    poses[:, 0] = rotations.log(R @ rotations.exp(poses[:, 0]))
    elsewhere = fixed(poses, (motion.trans + origin) @ R.T + shift - origin, where)
    turned = replace(markers, positions=markers.positions @ R.T + shift)
    alike = SoftTissueConfig(outlier=100.0)        # weights of outliers are of coordinates, which turn with the world
    one = follow_soft_tissue(model, motion, markers, where, alike)
    other = follow_soft_tissue(model, elsewhere, turned, where, alike)
    np.testing.assert_allclose(other.changes, one.changes, rtol=0, atol=1e-4)
    np.testing.assert_allclose(other.vertices(model), one.vertices(model) @ R.T + shift, rtol=0, atol=1e-5)


def test_markers_that_are_missing_or_not_trusted_count_nothing() -> None:
    model, where = body(), layout(body())
    markers, motion = seen(model, where, moving(model)[2])
    gone, wrong = markers.positions.copy(), markers.positions.copy()
    gone[5:9, 3], wrong[5:9, 3] = np.nan, wrong[5:9, 3] + 0.05
    trusted = motion.trusted.copy()
    trusted[5:9, 3] = False
    one = follow_soft_tissue(model, motion, replace(markers, positions=gone), where)
    other = follow_soft_tissue(model, replace(motion, trusted=trusted), replace(markers, positions=wrong), where)
    np.testing.assert_allclose(other.changes, one.changes, rtol=0, atol=2e-3)
    assert np.isnan(one.motion.residuals[5:9, 3]).all()
    np.testing.assert_allclose(other.motion.residuals[5:9, 3], np.sqrt(3) * 0.05, rtol=0, atol=0.02)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_few_frames_and_frames_without_markers(count: int) -> None:
    model, where = body(), layout(body())
    markers, motion = seen(model, where, moving(model)[2])
    few = Motion(motion.poses[:count], motion.trans[:count], OWN, RATE, motion.residuals[:count], motion.labels)
    found = follow_soft_tissue(model, few, markers.frames(slice(0, count)), where)
    assert found.changes.shape == (count, 3) and np.abs(found.changes).max() > 0.01
    blind = replace(markers.frames(slice(0, count)), positions=np.full((count, 40, 3), np.nan))
    found = follow_soft_tissue(model, few, blind, where)
    assert not found.changes.any() and np.array_equal(found.motion.poses, few.poses)


def test_the_skin_metric_is_how_far_the_skin_moves() -> None:
    model = body()
    slopes, change = model.shape_jacobian(model.pose_mean), np.array([0.3, -0.7, 0.2])
    moved = model.vertices(model.pose_mean, OWN + change) - model.vertices(model.pose_mean, OWN)
    areas = model.template.vertex_areas
    squared = ((moved**2).sum(axis=1) * areas).sum() / areas.sum()
    np.testing.assert_allclose(change @ skin_metric(model, slopes) @ change, squared, rtol=1e-9)
    config = SoftTissueConfig(change=0.5, skin=7.0)
    z = np.array([0.2, 0.1, -0.4])
    change = z @ cheap_directions(model, slopes, config)
    np.testing.assert_allclose(0.5 * change @ change + 7e4 * change @ skin_metric(model, slopes) @ change, z @ z)


def test_exaggeration_movement_and_file(tmp_path) -> None:
    model = body()
    poses, trans, changes = moving(model)
    soft = SoftTissue(fixed(poses, trans, layout(model)), changes)
    still, once, twice = (soft.vertices(model, slice(3, 6), factor) for factor in (0.0, 1.0, 2.0))
    np.testing.assert_allclose(twice - still, 2 * (once - still), rtol=0, atol=1e-12)
    np.testing.assert_allclose(still, model.subject(OWN).vertices(poses[3:6], trans[3:6]), rtol=0, atol=1e-9)
    at_rest = replace(soft, motion=replace(soft.motion, poses=np.repeat(model.pose_mean[None], T, axis=0)))
    moved = at_rest.vertices(model) - at_rest.vertices(model, factor=0.0)
    np.testing.assert_allclose(soft.movement(model), np.sqrt((moved**2).sum(axis=2).mean(axis=0)), rtol=0, atol=1e-12)
    np.testing.assert_allclose(skin_movement(model, 3 * changes), 3 * soft.movement(model))
    soft.save(tmp_path / "soft.npz")
    read = SoftTissue.load(tmp_path / "soft.npz")
    np.testing.assert_array_equal(read.changes, changes)
    np.testing.assert_array_equal(read.betas(2.0), OWN + 2 * changes)
    np.testing.assert_array_equal(Motion.load(tmp_path / "soft.npz").betas, OWN)      # as a motion of the fixed shape
    soft.motion.save(tmp_path / "fixed.npz")
    with pytest.raises(StorageError, match="shape_changes"):
        SoftTissue.load(tmp_path / "fixed.npz")


def test_what_does_not_belong_together_is_refused() -> None:
    model, where = body(), layout(body())
    markers, motion = seen(model, where, np.zeros((T, 3)))
    for wrong, message in ((replace(motion, betas=None), "betas"), (replace(motion, betas=np.zeros(4)), "at most 3"),
                           (replace(motion, labels=("x",) * 40), "labels")):
        with pytest.raises(ValueError, match=message):
            follow_soft_tissue(model, wrong, markers, where)
    with pytest.raises(ValueError, match="24 frames, 40 labels"):
        follow_soft_tissue(model, motion, markers.frames(slice(0, 5)), where)
    for name, value in (("change", 0.0), ("skin", -1.0), ("temporal_smoothness", -1.0)):
        with pytest.raises(ValueError, match=f"{name}: expected|config"):
            SoftFollower(model, motion, markers, where, SoftTissueConfig(**{name: value}))
    with pytest.raises(ValueError, match="k at most 3"):
        changing_bodies(model, motion.poses, np.zeros((T, 4)), motion.trans)


@pytest.mark.parametrize("kind", KINDS)
def test_quick_bodies_are_exact_in_key_frames_and_near_between(kind):
    model = body(kind)
    poses, trans, changes = moving(model)
    soft = SoftTissue(fixed(poses, trans, layout(model)), changes)
    keys, ids = np.array([0, 8, 16, T - 1]), np.arange(0, len(model.template.vertices), 3)
    exact, subject = soft.vertices(model)[:, ids], model.subject(OWN)
    quick = QuickBodies.of(model, subject, soft, ids, keys, exact[keys]).vertices(np.arange(T))
    off, moved = (np.linalg.norm(other - exact, axis=2) for other in (quick, subject.vertices(poses, trans)[:, ids]))
    assert off[keys].max() < 2e-6                                      # metres, in single precision
    assert off.mean() < 0.2 * moved.mean()
