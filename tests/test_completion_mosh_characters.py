"""Pose and soft tissue on characters, creases, and the cartoon figures."""
from dataclasses import replace

import numpy as np
import pytest
from completion_bodies import MEAN, worm_with_prior
from glb_reader import Glb
from mosh_folders import small_pictures

from completion import Motion
from completion.mocap.retargeting.retarget import world_up
from completion.mocap.retargeting.soft_tissue import (
    Creases,
    deformation,
    moving_character,
    picture_transfer,
    retarget_soft_tissue,
    write_character,
)
from completion.mocap.soft_tissue.soft_tissue import SoftTissue
from model.fitting.bodies import at_rest
from model.posing.character import character_model
from scanprep.geometry import rotations
from scanprep.geometry.format_glb import turn_up
from scanprep.pictures.camera import guess_upright

FRAMES = 12


@pytest.fixture(scope="module")
def model():
    return worm_with_prior()


@pytest.fixture(scope="module")
def soft():
    """A worm that bends, walks and sways."""
    t = np.arange(FRAMES) / 12
    poses = MEAN + np.sin(5 * t[:, None, None] + np.arange(4)[:, None]) * np.array([0.05, 0.3, 0.2])
    trans = np.stack([t, 0 * t, 0.05 * np.sin(9 * t)], axis=1)
    motion = Motion(poses, trans, np.array([0.5, -0.4, 0.2]), 12.0, np.zeros((FRAMES, 0)))
    return SoftTissue(motion, 0.3 * np.sin(7 * t[:, None] + np.arange(3)))


@pytest.fixture(scope="module")
def character(model):
    own = model.vertices(np.zeros((4, 3)), np.zeros(1))
    thick = own.mean(axis=0) + (own - own.mean(axis=0)) * [0.6, 1.5, 1.8]
    return character_model(model, thick, "rest")


def test_soft_tissue_is_added_to_the_character(model, soft, character):
    """The skin moves with the betas as the character model says, a factor times as far, and nothing else changes."""
    still, once, twice = (retarget_soft_tissue(soft, model, character, factor) for factor in (0.0, 1.0, 2.0))
    frames = np.arange(FRAMES)
    np.testing.assert_array_equal(once.motion.poses, soft.motion.poses)
    np.testing.assert_array_equal(once.motion.betas, np.zeros(3))
    np.testing.assert_array_equal(twice.changes, 2 * soft.changes)
    fixed, changed = moving_character(character, once, frames)
    np.testing.assert_allclose(moving_character(character, still, frames)[1] - still.motion.trans[:, None],
                               fixed - once.motion.trans[:, None], atol=1e-9)
    further = moving_character(character, twice, frames)[1] - twice.motion.trans[:, None]
    np.testing.assert_allclose(further - (fixed - once.motion.trans[:, None]), 2 * (changed - fixed), atol=1e-9)
    for t in range(FRAMES):
        wanted = character.vertices(soft.motion.poses[t], soft.changes[t], once.motion.trans[t])
        np.testing.assert_allclose(changed[t], wanted, atol=1e-9)


def test_it_reaches_the_ground_when_the_person_does(model, soft, character):
    """Whatever soft tissue does to the feet, lowest points keep their height over the floor, scaled with the legs."""
    own = model.subject(soft.motion.betas)
    up, sign = world_up(soft.motion, own)
    person, low = (sign * soft.motion.vertices(own)[..., up]).min(axis=1), []
    for factor in (0.0, 3.0):
        moved = retarget_soft_tissue(soft, model, character, factor)
        low.append((sign * moving_character(character, moved, np.arange(FRAMES))[1][..., up]).min(axis=1))
    np.testing.assert_allclose(low[1], low[0], atol=2e-3)
    floor = np.percentile(person, 2.0)
    ratio = (low[0] - floor) / (person - floor)
    high = person - floor > 0.02
    np.testing.assert_allclose(ratio[high], np.median(ratio[high]), rtol=1e-6)


def test_refuses_a_character_of_fewer_betas(model, soft):
    small = replace(model, shape_space=model.shape_space.first(2))
    with pytest.raises(ValueError, match="the 3 betas that change, got 2"):
        retarget_soft_tissue(soft, model, small)


def test_deformation_is_the_larger_stretch():
    rng = np.random.default_rng(0)
    grid = np.stack(np.meshgrid(np.arange(5.0), np.arange(4.0), indexing="ij"), axis=-1).reshape(-1, 2)
    flat = np.hstack([grid, np.zeros((20, 1))]) @ rotations.exp(rng.normal(size=3)).T
    corner = (np.arange(4)[:, None] * 4 + np.arange(3)).ravel()
    faces = np.stack([corner, corner + 4, corner + 1, corner + 4, corner + 5, corner + 1], axis=1).reshape(-1, 3)
    for stretch, wanted in (((1.1, 1.0), 0.1), ((1.05, 0.7), 0.3), ((1.0, 1.0), 0.0)):
        axes = rotations.exp([0, 0, 0.7])[:2, :2]
        moved = grid @ axes @ np.diag(stretch) @ axes.T
        moved = np.hstack([moved, np.zeros((20, 1))]) @ rotations.exp(rng.normal(size=3)).T + rng.normal(size=3)
        np.testing.assert_allclose(deformation(faces, flat, moved), wanted, atol=1e-7)
        np.testing.assert_allclose(deformation(faces, np.stack([flat, flat]), np.stack([moved, flat])),
                                   [[wanted] * 20, [0] * 20], atol=1e-7)


def test_creases_are_smoothed_and_nothing_else(model):
    rest = at_rest(model)
    pose = np.array([[0.2, 0.1, 0.3], [0, 0.3, 0], [0, 0, 0.4], [0, 0.2, 0.3]])
    body = model.vertices(pose, np.zeros(1))
    creases = Creases(rest, model.skeleton)
    assert not creases.find_inverted(body, pose).any()
    folded = body.copy()
    middle = int(np.argmin(np.abs(rest.vertices - rest.vertices.mean(axis=0)).sum(axis=1)))
    folded[middle] += 0.14 * np.array([1.0, 0.3, 0]) @ model.skeleton.part_rotations(pose)[0].T
    turned = creases.find_inverted(folded, pose)
    assert turned.any() and (rest.faces[turned] == middle).any(axis=1).all()
    smooth = creases.smooth(np.stack([body, folded]), np.stack([pose, pose]))
    assert not creases.find_inverted(smooth[1], pose).any()
    moved = np.flatnonzero(np.linalg.norm(smooth[1] - folded, axis=1))
    assert middle in moved and len(moved) < 30
    np.testing.assert_array_equal(smooth[0], body)


def test_files_and_pictures(model, soft, character, tmp_path):
    moved = retarget_soft_tissue(soft, model, character, 2.0)
    most, told = write_character(tmp_path / "worm.glb", character, moved)
    fixed, changed = moving_character(character, moved, np.arange(12))
    np.testing.assert_allclose(most, deformation(character.template.faces, fixed, changed).max(axis=0))
    glb = Glb((tmp_path / "worm.glb").read_bytes())
    smooth = Creases(at_rest(character), character.skeleton).smooth(changed, moved.motion.poses)
    shown = np.stack([glb.skinned(t) for t in range(12)]) @ turn_up(guess_upright(character.template)[0])
    off = 1000 * np.linalg.norm(shown - smooth, axis=2)
    assert off.mean() < 1 and off.mean() == pytest.approx(told[0].value, rel=1e-3)
    assert np.linalg.norm(changed - fixed, axis=2).max() > 10 * off.mean() / 1000
    assert "COLOR_0" in glb.primitive["attributes"] and most.max() > 0.01
    with small_pictures():
        sheet = picture_transfer(model, soft, character, moved)
    assert sheet.dtype == np.uint8 and sheet.shape[1] >= 8 * 20
