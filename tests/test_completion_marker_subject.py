"""Whose body it is, from the markers of a few frames."""
from dataclasses import replace

import numpy as np
import pytest
from people_bodies import kept, small_people

from completion.mocap.files.markers import MarkerSequence
from completion.mocap.marker_sets.named import load_layout
from completion.mocap.pose.follow import AnimateConfig, animate
from completion.mocap.subject.person import PersonConfig, choose_frames, find_person, spread_frames
from scanprep.synthetic.people import BodyShape, SyntheticPerson, synthesise_walk

BETAS = np.array([1.2, -0.8, 0.6, -0.5])
CONFIG = PersonConfig(frames=6)
FRAMES = 24


@pytest.fixture(scope="module")
def model():
    return small_people()


@pytest.fixture(scope="module")
def layout(model):
    return load_layout("cmu41", model.template, kept())


def carried(model, layout, betas, frames=FRAMES, seed=0):
    """Markers of a body in poses of the model's prior that follow each other, turning about."""
    rng = np.random.default_rng(seed)
    variances, axes = np.linalg.eigh(model.pose_covariance)
    keys = model.pose_mean.ravel() + (rng.normal(size=(4, len(axes))) * np.sqrt(np.maximum(variances, 0))) @ axes.T
    t = np.linspace(0, 3, frames)
    poses = np.stack([np.interp(t, np.arange(4), column) for column in keys.T], axis=1).reshape(frames, -1, 3)
    poses[:, 0] = [0, 0, 1] * np.linspace(0, 4, frames)[:, None]
    trans = np.stack([t, 0.3 * t, 0 * t], axis=1)
    meshes = model.subject(betas).vertices(poses, trans)
    places = np.stack([layout.place(model.template.with_vertices(v)) for v in meshes])
    return meshes, MarkerSequence(places, layout.labels, 60.0)


def rest(model, betas):
    return model.subject(betas).vertices(model.pose_mean * 0)


def test_loose_markers_are_found_where_they_are(model, layout):
    rows = [layout.labels.index(label) for label in ("LTHI", "RSHN", "RUPA")]
    part, rest_at = model.skeleton.part_of_vertex(model.template), model.template.vertices
    true = {}
    for row in rows:
        usual = int(layout.vertices[row][np.argmax(layout.weights[row])])
        far = np.linalg.norm(rest_at - rest_at[usual], axis=1)
        true[layout.labels[row]] = int(np.argmin(np.where(part == part[usual], np.abs(far - 0.1), np.inf)))
    _, sequence = carried(model, layout.with_places(true), BETAS)
    found = find_person(model, sequence, layout, CONFIG)
    stays = find_person(model, sequence, replace(layout, loose=()), CONFIG)
    places = found.layout.place(model.template)
    for label, vertex in true.items():
        assert np.linalg.norm(places[layout.labels.index(label)] - rest_at[vertex]) < 0.03, label
    assert found.residual < 0.6 * stays.residual
    firm = [i for i, label in enumerate(layout.labels) if label not in layout.loose]
    assert found.moved[firm].max() < 0.03 < found.moved[rows].min()


@pytest.mark.parametrize(("wanded", "distance"), [
    (("THI", "SHN"), 0.035), (("THI", "SHN"), 0.06), (("WRA", "WRB"), 0.0095)])
def test_markers_on_wands_and_without_their_bars_are_the_same_person(model, layout, wanded, distance):
    """Thighs and shanks 25 and 50 mm off the skin, wrists on the skin where the set has bars of 45 mm."""
    these = np.isin([label[1:] for label in layout.labels], wanded)
    worn = replace(layout, distances=np.where(these, distance, np.asarray(layout.distances)))
    _, sequence = carried(model, worn, BETAS)
    found = find_person(model, sequence, layout, CONFIG)
    apart = np.linalg.norm(rest(model, found.betas) - rest(model, BETAS), axis=1)
    assert apart.mean() < 0.005
    np.testing.assert_allclose(np.asarray(found.layout.distances)[these], distance, atol=0.010)
    assert set(found.standing_off(layout)) == {label for label, is_one in zip(layout.labels, these, strict=True)
                                               if is_one}
    off = found.metrics(layout)[0]
    assert off.value == pytest.approx(1000 * distance, abs=6) and "skin" in off.name
    assert not found.judgement(layout).reasons


@pytest.mark.slow
def test_a_walk_of_somebody_the_model_was_not_learned_from(model, layout):
    person = SyntheticPerson(BodyShape.like("male", stature=1.88, weight=1.0))
    on_skin = load_layout("cmu41", person.mesh)
    poses, trans = synthesise_walk(40, 40.0)
    bodies = np.stack([person.in_pose(p, t) for p, t in zip(poses, trans, strict=True)])
    places = np.stack([on_skin.place(person.mesh.with_vertices(v)) for v in bodies])
    sequence = MarkerSequence(places, on_skin.labels, 40.0)
    found = find_person(model, sequence, layout, CONFIG)
    body = model.subject(found.betas)
    stature = np.ptp(rest(model, found.betas)[:, 2])
    assert abs(stature - 1.88) < 0.06 < abs(np.ptp(rest(model, np.zeros(4))[:, 2]) - 1.88)
    motion = animate(body, sequence, found.layout, AnimateConfig())
    off = np.linalg.norm(motion.vertices(body) - bodies[:, kept()], axis=2)
    wrong = animate(model.subject(np.zeros(4)), sequence, layout, AnimateConfig())
    assert off.mean() < 0.03 and np.nanmean(motion.residuals) < 0.6 * np.nanmean(wrong.residuals)


def test_frames_are_spread_over_what_happens():
    t = np.arange(200)
    angle = np.where(t < 150, 0.0, (t - 150) / 50 * np.pi)          # three quarters of the time nothing happens
    positions = np.zeros((200, 4, 3))
    positions[:, 1] = [1, 0, 0]
    positions[:, 2] = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    positions[:, 3] = [0, 0, 1]
    positions += t[:, None, None] * [0.1, 0, 0]                     # going somewhere is no other pose
    positions[180:185, :2] = np.nan
    frames = choose_frames([positions], PersonConfig(frames=5))
    assert (frames < 155).sum() == 1 and len(frames) == 5 and not ((frames >= 180) & (frames < 185)).any()
    assert frames.max() >= 197 and np.diff(np.clip(frames, 150, None)).min() >= 5
    assert len(spread_frames(np.broadcast_to(positions[:1], (30, 4, 3)), 5)) == 1


def test_what_cannot_be_done_is_said(model, layout):
    _, sequence = carried(model, layout, BETAS, 4)
    with pytest.raises(ValueError, match="expected at least 3 markers of the layout, found 0"):
        find_person(model, MarkerSequence(sequence.positions[:, :3], ("x", "y", "z"), 60.0), layout)
    blind = MarkerSequence(np.where(np.arange(41)[:, None] < 2, sequence.positions, np.nan), layout.labels, 60.0)
    with pytest.raises(ValueError, match="expected a frame with at least 3 known markers, the best has 2"):
        find_person(model, blind, layout)
    bare = replace(model, shape_space=model.shape_space.first(0))
    with pytest.raises(ValueError, match="model: expected one with betas"):
        find_person(bare, sequence, layout)
    with pytest.raises(ValueError, match="sequences: expected at least one, got none"):
        find_person(model, [], layout)
    with pytest.raises(ValueError, match="annealing: expected at least one factor"):
        find_person(model, sequence, layout, PersonConfig(annealing=()))
