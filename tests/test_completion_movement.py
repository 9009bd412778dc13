"""Recordings that no person moves like: the wrong rate, upside down, squeezed, with another layout, mirrored."""
from functools import cache

import numpy as np
import pytest
from people_bodies import small_people

from completion.mocap.files.markers import MarkerSequence
from completion.mocap.labelling.label import label_markers
from completion.mocap.labelling.recording import columns_of_labels
from completion.mocap.marker_sets.named import load_layout
from completion.mocap.movement import measure_falls, pace_doubts, posture_doubts
from completion.mocap.pose.marked_body import supports
from completion.mocap.subject.person import PersonConfig, doubt_layout, find_person
from completion.motion import Motion
from model.built_in import load_built_in_model
from model.fitting.energy import rise_above_skin
from scanprep.geometry.rotations import exp, log
from scanprep.plausible import another_layout, falls_otherwise, impossible_walk, unequal_scale, upside_down
from scanprep.skeleton.roles import find_roles
from scanprep.synthetic.people import synthesise_walk

RATE = 60.0
POSES, TRANS = synthesise_walk(300, RATE)
QUICK = PersonConfig(frames=4, n_betas=10)


def subject():
    return small_people().subject(np.zeros(4))


def moving(poses=POSES, trans=TRANS, rate=RATE):
    return Motion(poses, trans, None, rate, np.zeros((len(poses), 0)))


def turned(axis, degrees, poses=POSES, trans=TRANS):
    """The motion in a room that is turned about an axis of the file."""
    R = exp(np.radians(degrees) * np.eye(3)["xyz".index(axis)])
    poses = poses.copy()
    poses[:, 0] = log(R @ exp(poses[:, 0]))
    return moving(poses, trans @ R.T)


@pytest.mark.parametrize(("times", "words"), [
    (1.0, ""), (0.5, ""), (2.0, ""), (0.1, "gait cycle of 11 s would fall backwards"), (0.05, "fall backwards"),
    (10.0, "gait cycle of 0.11 s: the wrong rate?")])
def test_a_walk_tells_its_rate_by_steps_and_balance(times, words):
    told = pace_doubts(moving(rate=times * RATE), subject())
    assert (words in told[0]) if words else told == ()


def test_slow_steps_in_balance_and_parts_that_no_marker_sees_tell_nothing():
    assert impossible_walk(9.0, -0.05) is None                                       # tai chi
    unseen = np.zeros((300, 16), dtype=bool)
    assert pace_doubts(moving(rate=6.0), subject(), unseen) == () == posture_doubts(turned("x", 180), subject(), unseen)
    # a slow motion without steps may be one: standing, arms that move
    still = np.repeat(POSES[:1], 300, axis=0)
    still[:, 6, 0] += np.linspace(0, 1, 300)
    assert pace_doubts(moving(still, np.zeros((300, 3)), 6.0), subject()) == ()


@pytest.mark.parametrize(("times", "words"), [(1.0, ""), (0.1, "falls with 0.098 m/s²"), (2.0, "falls with 39 m/s²")])
def test_a_jump_tells_its_rate_by_gravity(times, words):
    seconds = np.arange(120) / RATE
    jump = np.maximum(0, 2.5 * (seconds - 0.7) - 9.81 / 2 * (seconds - 0.7)**2) * (seconds > 0.7)
    told = pace_doubts(moving(np.repeat(POSES[:1], 120, axis=0), jump[:, None] * [0, 0, 1.0], times * RATE), subject())
    assert (words in told[0]) if words else told == ()


def test_somebody_who_steps_on_a_chair_does_not_fall():
    rise = np.interp(np.arange(240) / RATE, [0, 1, 2, 3, 4], [0, 0, 0.4, 0.4, 0])
    assert measure_falls(1 + rise, 0.1 + rise, RATE) == []
    assert falls_otherwise([]) is None and falls_otherwise([9.2, 9.7]) is None


@pytest.mark.parametrize(("axis", "degrees", "words"), [
    ("z", 50, ""), ("x", -90, ""), ("y", 90, ""), ("x", 180, "below the feet along z"), ("y", 180, "along z"),
    ("x", 90, "along y")])
def test_a_person_is_upside_down_along_the_axis_that_is_up(axis, degrees, words):
    """Up is x, y or z, whichever way round the person was turned; z of the walk is up."""
    told = posture_doubts(turned(axis, degrees), subject())
    assert (words in told[0]) if words else told == ()


def test_a_handstand_and_somebody_who_lies_are_not_upside_down():
    wrong = turned("x", 180)
    some = np.where(np.arange(300)[:, None, None] < 150, POSES, wrong.poses)
    assert posture_doubts(moving(some), subject()) == () and upside_down(np.array([]), "z") is None
    # lying with relaxed feet, the head along an axis of the file
    body, roles = subject(), find_roles(subject().skeleton.names)
    lying = np.zeros((9, 16, 3))
    for side in "lr":
        lying[:, roles[f"{side}_ankle"]] = [np.radians(40), 0, 0]
    assert posture_doubts(turned("x", 90, lying, np.zeros((9, 3))), body) == ()


@cache
def recorded(step=4):
    """Markers of a set on the walk of a person of the built-in model."""
    model = load_built_in_model()
    person, places = model.subject(np.random.default_rng(3).normal(size=8)), load_layout("cmu41", model)
    ids, weights = supports(model.template, places)
    points = person.points(ids, weights).evaluate(POSES[:60:step], TRANS[:60:step])
    return MarkerSequence(rise_above_skin(points, np.asarray(places.distances)), places.labels, RATE / step)


@pytest.mark.parametrize(("height", "words"), [(1.0, ""), (0.85, "too short along the body"), (1.2, "too long along")])
def test_a_recording_in_another_scale_along_the_body_is_told(height, words):
    """The body is along y of the file."""
    model, markers = load_built_in_model(), recorded()
    fit = find_person(model, MarkerSequence((markers.positions * [1, 1, height])[..., [1, 2, 0]], markers.labels, 15.0),
                      load_layout("cmu41", model), QUICK)
    told = fit.judgement(load_layout("cmu41", model))
    assert (words in told.reasons[0]) if words else unequal_scale(fit.stretch) is None


def test_a_layout_that_a_named_one_fits_better_is_told():
    model, markers = load_built_in_model(), [recorded()]
    told = {}
    for name in ("cmu41", "mosh67"):
        layout = load_layout(name, model).with_spellings(markers[0].labels)
        told[name] = doubt_layout(model, markers, layout, find_person(model, markers, layout, QUICK), QUICK)
    assert told["cmu41"] is None and told["mosh67"].startswith("cmu41 explains 41 labels")
    assert another_layout(41, 0.03, "helenhayes29", 14, 0.02, 0.5) is None            # one that knows fewer labels


@pytest.mark.slow
def test_labels_of_a_mirrored_recording_are_told():
    model = load_built_in_model()
    markers, layout = recorded(1), load_layout("cmu41", model)
    for side, words in ((1, ""), (-1, "mirrored recording")):
        points = MarkerSequence(markers.positions[:30] * [side, 1, 1], markers.labels, RATE)
        told = label_markers(model, points, layout, columns_of_labels(points, layout)).judgement
        assert words in told.why if words else told.verdict == "good", told
