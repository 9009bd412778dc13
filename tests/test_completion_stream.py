import copy

import numpy as np
import pytest
from completion_bodies import MEAN, worm_with_prior
from derivatives import differences

from completion.mocap.files.markers import MarkerSequence
from completion.mocap.marker_sets.layout import MarkerLayout
from completion.mocap.pose.follow import AnimateConfig, animate, low_pass
from completion.mocap.pose.foot_contact import Floor, FootContact
from completion.mocap.pose.judgement import marker_speed
from completion.mocap.pose.marked_body import MarkedBody
from completion.mocap.pose.part_shapes import PartShapes
from completion.mocap.pose.stream import KalmanPrediction, MarkerStream
from completion.mocap.pose.swaps import LabelWatch
from model.features import linear_features
from model.pose_space import PoseSpace
from model.scape import ScapeModel
from model.shape_space import ShapeSpace
from scanprep.geometry import rotations
from scanprep.synthetic.people import SyntheticPerson, synthesise_walk

FRAMES = 50
CONFIG = AnimateConfig()


@pytest.fixture(scope="module")
def subject():
    return worm_with_prior().subject(None)


@pytest.fixture(scope="module")
def layout():
    vertices = np.random.default_rng(4).choice(396, 30, replace=False)
    return MarkerLayout(tuple(f"M{i}" for i in range(30)), vertices, 0.012)


@pytest.fixture(scope="module")
def sway(subject, layout):
    t = np.arange(FRAMES) / 100
    poses = MEAN + np.sin(2 * np.pi * t[:, None, None] + np.arange(4)[:, None]) * np.array([0.05, 0.3, 0.2])
    meshes = subject.vertices(poses, np.stack([1.2 * t, 0 * t, 0 * t], axis=1))
    return meshes, np.stack([layout.place(subject.template.with_vertices(v)) for v in meshes])


def pushed(stream, positions):
    return [stream.push(frame) for frame in positions]


def errors(subject, frames, meshes):
    found = subject.vertices(np.array([f.pose for f in frames]), np.array([f.trans for f in frames]))
    return np.linalg.norm(found - meshes, axis=2).mean(axis=1)


def test_part_shapes_are_the_point_operator(subject, layout):
    operator = subject.points(layout.vertices)
    rng = np.random.default_rng(1)
    pose, trans = rng.normal(0, 1, (6, 4, 3)), rng.normal(size=(6, 3))
    pose[0] *= 4                                                     # beyond a half turn
    positions, by_pose = operator.jacobian(pose, trans)
    y, columns = PartShapes(operator).columns(pose, trans)
    np.testing.assert_allclose(y.swapaxes(1, 2), positions, atol=1e-12)
    np.testing.assert_allclose(PartShapes(operator).evaluate(pose, trans).swapaxes(1, 2), positions, atol=1e-12)
    np.testing.assert_array_equal(columns[:, 12:], np.broadcast_to(np.eye(3)[:, :, None], (6, 3, 3, 30)))
    turns = columns[:, :12].reshape(6, 4, 3, 3, 30).transpose(0, 4, 3, 1, 2)               # (B, L, 3, J, 3)
    got = np.einsum("blijc,bjcd->blijd", turns, rotations.right_jacobian(pose))
    np.testing.assert_allclose(got.reshape(by_pose.shape), by_pose, atol=1e-9)


def test_the_derivative_of_the_frame_energy_is_a_finite_difference(subject, layout, sway):
    body = MarkedBody(subject, layout, 0.3, 0.3)
    rng = np.random.default_rng(3)
    x = rng.normal(0, 0.4, (2, 15))
    targets, weights = sway[1][[3, 8]].copy(), rng.random((2, 30)) * 100
    targets[0, 4] = np.nan
    _, gradient, hessian = body.system(x, targets, weights)
    slopes = differences(lambda d: body.system(body.retract(x, np.tile(d, (2, 1))), targets, weights)[0], np.zeros(15))
    np.testing.assert_allclose(slopes / 2, gradient, rtol=1e-5, atol=1e-4)
    assert (np.linalg.eigvalsh(hessian) > -1e-6).all()
    np.testing.assert_allclose(body.retract(x, body.step_to(x, x[::-1])), x[::-1], atol=1e-12)


def test_a_stream_follows_and_looks_at_no_later_frame(subject, layout, sway):
    meshes, positions = sway
    frames = pushed(MarkerStream(subject, layout, layout.labels, 100.0, CONFIG), positions)
    assert errors(subject, frames, meshes).max() < 0.006
    assert all(f.converged and f.trusted.all() for f in frames)
    other = positions.copy()
    other[20:] += 0.5
    again = pushed(MarkerStream(subject, layout, layout.labels, 100.0, CONFIG), other[:25])
    np.testing.assert_array_equal([f.pose for f in again[:20]], [f.pose for f in frames[:20]])


def test_a_stream_begins_when_it_sees_enough_and_lasts_through_gaps(subject, layout, sway):
    meshes, positions = sway
    gaps = positions.copy()
    gaps[:4, 3:] = np.nan                                            # three markers are too few to begin with
    gaps[20:30, ::3] = np.nan
    gaps[35:38] = np.nan
    frames = pushed(MarkerStream(subject, layout, ("none", *layout.labels), 100.0, CONFIG),
                    np.concatenate([np.zeros((FRAMES, 1, 3)), gaps], axis=1))
    assert all(np.isnan(f.pose).all() and not f.converged and not f.trusted.any() for f in frames[:4])
    assert all(np.isnan(f.residuals[0]) and not f.trusted[0] for f in frames)      # no layout knows it
    assert errors(subject, frames[4:], meshes[4:]).max() < 0.02
    assert [f.converged for f in frames[35:38]] == [False] * 3


def test_a_stream_finds_the_body_again_after_a_leap(subject, layout, sway):
    meshes, positions = sway
    R = rotations.exp(np.array([0, 0, 2.5]))
    leapt = np.concatenate([positions[:10], positions[10:] @ R.T + [3, 1, 0]])
    leapt[8:10] = np.nan
    frames = pushed(MarkerStream(subject, layout, layout.labels, 100.0, CONFIG), leapt)
    assert errors(subject, frames[12:], (meshes @ R.T + [3, 1, 0])[12:]).max() < 0.01


@pytest.mark.parametrize("way", ["stream", "sequence"])
def test_exchanged_labels_are_put_right_and_reported(subject, layout, sway, way):
    meshes, positions = sway
    swapped = positions.copy()
    far = int(np.linalg.norm(positions[0] - positions[0, 0], axis=1).argmax())
    swapped[20:40, [0, far]] = swapped[20:40, [far, 0]]
    if way == "stream":
        frames = pushed(MarkerStream(subject, layout, layout.labels, 100.0, CONFIG), swapped)
        trusted, clean = np.array([f.trusted for f in frames]), pushed(
            MarkerStream(subject, layout, layout.labels, 100.0, CONFIG), positions)
        np.testing.assert_allclose([f.pose for f in frames], [f.pose for f in clean], atol=1e-9)
    else:
        motion = animate(subject, MarkerSequence(swapped, layout.labels, 100.0), layout, CONFIG)
        assert np.linalg.norm(motion.vertices(subject) - meshes, axis=2).mean(axis=1).max() < 0.006
        trusted = motion.trusted
    wrong = np.zeros_like(trusted)
    wrong[20:40, [0, far]] = True
    np.testing.assert_array_equal(trusted, ~wrong)


@pytest.mark.parametrize("rate", [25.0, 120.0])
def test_the_speed_of_markers_is_in_metres_a_second(rate):
    x = np.arange(40)[:, None, None] / rate * np.array([1.2, -1.6, 0.0]) + np.zeros((40, 3, 3))
    x[5:9, 1] = np.nan
    assert marker_speed(MarkerSequence(x, tuple("ABC"), rate)) == pytest.approx(2.0)


def test_the_watch_swaps_late_and_puts_back_late():
    """Two markers on the way to each other's place: swapped past two thirds of it, put back before the half."""
    places = np.array([[0, 0, 0], [0, 0, 0.08], [0.5, 0, 0], [0.5, 0.4, 0], [0, 0.8, 0]])
    watch, seen = LabelWatch(5, 0.06), []
    for share in (0.4, 0.64, 0.7, 1.0, 0.64, 0.52, 0.48, 0.2):
        on_way = places.copy()
        on_way[:2] += share * (places[1::-1] - places[:2])
        seen.append(bool(watch.update(places, on_way)[0]))
    assert seen == [False, False, True, True, True, True, False, False]


def test_the_kalman_filter_is_the_smoother_of_its_past(subject, layout):
    """On numbers that add, a filter's last state is the least-squares solution over all frames so far."""
    body = MarkedBody(subject, layout, 0.3, 0.3)
    rng, P, T = np.random.default_rng(5), body.n_unknowns, 8
    filter = KalmanPrediction(body, CONFIG, 100.0)
    filter.momentum = 1.0
    filter.begin(np.zeros(P))
    noise, start = 1 / CONFIG.inertia(100.0, P)[-1], filter.place[-1, -1]
    seen, information = rng.normal(0, 1e-4, T), rng.random(T) / noise
    for z, weight in zip(seen, information, strict=True):
        expected, prior = filter.expect()
        measured = np.zeros((P, P))
        measured[-1, -1] = weight
        x = expected.copy()
        x[-1] = (prior[-1, -1] * expected[-1] + weight * z) / (prior[-1, -1] + weight)
        filter.update(x, measured)
    # the same by hand: place and velocity at the start, one acceleration a frame
    F = np.array([[1.0, 1.0], [0.0, 1.0]])
    state, rows, values = np.eye(2, 2 + T), [np.eye(2, 2 + T) / np.sqrt(start)], [np.zeros(2)]
    for t in range(T):
        state = F @ state
        state[:, 2 + t] += [0.5, 1.0]
        rows += [np.sqrt(information[t]) * state[:1], np.eye(2 + T)[2 + t][None] / np.sqrt(noise)]
        values += [[np.sqrt(information[t]) * seen[t]], [0.0]]
    solution = np.linalg.lstsq(np.vstack(rows), np.concatenate(values), rcond=None)[0]
    assert np.isclose(filter.x[-1], (state @ solution)[0], rtol=1e-8)
    assert np.isclose(filter.velocity[-1], (state @ solution)[1], rtol=1e-8)


def test_wrong_streams_are_refused(subject, layout):
    with pytest.raises(ValueError, match="low_pass=0 for a stream"):
        MarkerStream(subject, layout, layout.labels, 100.0, AnimateConfig(low_pass=5.0))
    with pytest.raises(ValueError, match="rate: expected a number above 0, got 0"):
        MarkerStream(subject, layout, layout.labels, 0.0)
    with pytest.raises(ValueError, match="found 1"):
        MarkerStream(subject, layout, ("M1", "X"), 100.0)
    with pytest.raises(ValueError, match=r"positions: expected shape \(30, 3\), got \(2, 3\)"):
        MarkerStream(subject, layout, layout.labels, 100.0).push(np.zeros((2, 3)))


def test_a_low_pass_keeps_slow_turns_and_takes_fast_ones():
    t = np.arange(200) / 100
    slow, fast = np.sin(2 * np.pi * t), 0.1 * np.sin(2 * np.pi * 30 * t)
    pose = np.zeros((200, 2, 3))
    pose[:, 0, 2], pose[:, 1, 0] = 2.8 + slow, slow + fast           # the first goes through a half turn
    found, trans = low_pass(rotations.log(rotations.exp(pose)), np.stack([slow + fast, slow, 0 * t], axis=1), 100.0, 6)
    turn = np.linalg.norm(rotations.log(np.swapaxes(rotations.exp(found), -1, -2) @ rotations.exp(
        pose - np.stack([0 * pose[:, 0], fast[:, None] * [1, 0, 0]], axis=1))), axis=2)
    assert turn[20:-20].max() < 0.03
    np.testing.assert_allclose(trans[20:-20, 0], slow[20:-20], atol=0.01)
    with pytest.raises(ValueError, match="between 0 and half the rate, 50, got 60"):
        low_pass(pose, trans, 100.0, 60)
    with pytest.raises(ValueError, match="expected more than"):
        low_pass(pose[:5], trans[:5], 100.0, 6)


@pytest.fixture(scope="module")
def walker():
    """A synthetic person whose parts are rigid."""
    person = SyntheticPerson()
    skeleton, J = person.skeleton, len(person.parents)
    features = linear_features(skeleton, tuple(np.zeros((3, 0)) for _ in range(J)))
    rigid = tuple(np.broadcast_to(np.eye(3, dtype=np.float32), (1, int((skeleton.part_of_face == p).sum()), 3, 3))
                  for p in range(J))
    prior = np.diag(np.r_[np.zeros(3), np.full(3 * J - 3, 0.4**2)])
    model = ScapeModel(person.mesh, skeleton, PoseSpace(features, rigid), ShapeSpace.empty(len(person.mesh.faces)),
                       np.zeros((J, 3)), prior)
    subject = model.subject(None)
    poses, trans = synthesise_walk(60, 60.0)
    still = np.repeat(poses[:1], 60, axis=0)
    still[:, 2, 2] += 0.2 * np.sin(np.arange(60) / 8)                # only the chest turns
    spread = np.random.default_rng(0).choice(len(person.mesh.vertices), 90, replace=False)
    layout = MarkerLayout(tuple(f"M{i}" for i in range(90)), spread, 0.0)
    return subject, layout, {"walk": (poses, trans), "stand": (still, np.repeat(trans[:1], 60, axis=0))}


def animated(walker, name, **settings):
    subject, layout, motions = walker
    truth = subject.vertices(*motions[name])
    noise = np.random.default_rng(1).normal(0, 0.005, (60, 90, 3))
    motion = animate(subject, MarkerSequence(truth[:, layout.vertices] + noise, layout.labels, 60.0), layout,
                     AnimateConfig(**settings))
    return truth, motion.vertices(subject)


def test_feet_that_stand_do_not_slide(walker):
    truth, free = animated(walker, "stand")
    _, held = animated(walker, "stand", ground=True)
    soles = np.flatnonzero(truth[0, :, 2] < truth[0, :, 2].min() + 0.01)

    def slide(vertices):
        return np.linalg.norm(np.diff(vertices[:, soles], axis=0), axis=2).mean()

    assert slide(held) < 0.3 * slide(free)
    assert np.linalg.norm(held - truth, axis=2).mean() < 1.05 * np.linalg.norm(free - truth, axis=2).mean()


def test_feet_do_not_sink_while_walking(walker):
    truth, free = animated(walker, "walk")
    height = Floor.below(free).height
    _, held = animated(walker, "walk", ground=True)
    sunk_free, sunk = (np.maximum(0, height - v[..., 2].min(axis=1)) for v in (free, held))
    assert sunk.mean() < 0.6 * sunk_free.mean()
    assert np.linalg.norm(held - truth, axis=2).mean() < 0.02


def test_the_floor_is_found_whatever_axis_is_up(walker):
    subject, _, motions = walker
    vertices = subject.vertices(*motions["walk"])
    floor = Floor.below(vertices)
    assert floor.normal.tolist() == [0, 0, 1] and abs(floor.height - np.median(vertices[..., 2].min(axis=1))) < 0.01
    turned = Floor.below(vertices @ rotations.exp(np.array([np.pi / 2, 0, 0])).T)  # z becomes -y
    assert turned.normal.tolist() == [0, -1, 0] and abs(turned.height - floor.height) < 1e-9


def test_what_stands_is_held_on_the_floor_and_the_rest_is_free(walker):
    subject, layout, motions = walker
    body = MarkedBody(subject, layout, 0.3, 0.3)
    x = body.body.join(*motions["stand"])
    feet = FootContact(body, x, 60.0)
    places = feet.target_positions(x)
    held = ~np.isnan(places[..., 0])
    assert held.all(axis=0).sum() >= 4 and (feet.floor.above(places[held]) > -1e-9).all()
    x[40:, -1] += 1                                                  # as if standing in the air
    assert np.isnan(FootContact(body, x, 60.0).target_positions(x)[45:]).all()


@pytest.fixture(scope="module")
def passing(walker):
    """A person who walks through 60 markers, 60 frames a second."""
    subject, layout, motions = walker
    truth = subject.vertices(*motions["walk"])
    return subject, layout, truth, truth[:, layout.vertices] + np.random.default_rng(1).normal(0, 0.003, (60, 90, 3))


WRONG = {"times 1000": lambda p: 1000 * p, "half of it": lambda p: p * np.where(np.arange(90) % 2, 1000, 1)[:, None],
         "all in one place": lambda p: 0 * p, "5 m away": lambda p: p + 5, "infinite": lambda p: p * np.inf,
         "1e300": lambda p: 1e300 * p, "turned round": lambda p: p * [-1, -1, 1],
         "mixed up": lambda p: p[np.random.default_rng(0).permutation(90)]}


@pytest.fixture(scope="module")
def unbroken(passing):
    """A stream of 20 frames, what the next 20 come to, and how far they are from the truth at most."""
    subject, layout, truth, positions = passing
    stream = MarkerStream(subject, layout, layout.labels, 60.0, CONFIG)
    first = pushed(stream, positions[:20])
    frames = pushed(copy.deepcopy(stream), positions[20:40])
    return stream, frames, errors(subject, [*first, *frames], truth[:40]).max()


@pytest.mark.slow
@pytest.mark.parametrize("wrong", WRONG.values(), ids=WRONG)
def test_one_frame_that_no_body_makes_is_passed_over(passing, unbroken, wrong):
    (subject, _, truth, positions), (stream, clean, apart) = passing, unbroken
    frames = pushed(copy.deepcopy(stream), [wrong(positions[20]), *positions[21:40]])
    assert not frames[0].trusted.any() and not frames[0].converged
    assert errors(subject, frames, truth[20:40]).max() < apart + 0.015
    for there, other in zip(frames[1:], clean[1:], strict=True):
        assert other.converged and there.converged
        np.testing.assert_array_equal(there.trusted, other.trusted)


def test_feet_that_slide_are_free_and_sunk_ones_are_lifted(walker):
    subject, layout, motions = walker
    body = MarkedBody(subject, layout, 0.3, 0.3)
    x = body.body.join(*motions["stand"])
    x[:, -3] += np.arange(60) / 60                                   # one metre a second, upright
    feet = FootContact(body, x, 60.0)
    assert np.isnan(feet.stands).all()
    x[:, -1] -= 0.1
    assert np.nanmin(feet.floor.above(feet.target_positions(x))) > -1e-9
