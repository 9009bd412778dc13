from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from completion_bodies import worm_with_prior

from completion import MoshConfig, PersonConfig, animate, find_person, load_layout, mosh
from completion.mocap.files.markers import MarkerSequence
from completion.mocap.marker_sets.layout import MarkerLayout
from completion.mocap.pose.judgement import find_distrusted_markers, markers_told
from completion.mocap.subject.attachment import latent_markers
from completion.mocap.subject.misplaced_markers import (
    MisplacedMarkers,
    MovedMarker,
    _Frames,
    _with_whole_parts,
    find_misplaced_markers,
)
from completion.mocap.subject.person import choose_frames, common_markers, judge_moves, spread_frames
from model import load_built_in_model
from scanprep.geometry import rotations
from scanprep.geometry.surface import Surface
from scanprep.judgement import Judgement

MODEL = worm_with_prior()
BETAS = np.array([1.4, -1.1, 0.8])
LABELS = tuple(f"M{i:02d}" for i in range(26))
INSIDE = np.random.default_rng(9).dirichlet([6, 6, 6], 26)          # markers well inside of triangles
LAYOUT = MarkerLayout(LABELS, MODEL.template.faces[np.round(np.linspace(8, 788, 26)).astype(int)], 0.0095, INSIDE)
EXACT = PersonConfig(shape=1e-4, pose=1e-4, data=100.0, n_betas=3, frames=8, annealing=(100.0, 10.0, 1.0))
USUAL = PersonConfig(frames=8, annealing=(10.0, 4.0, 1.0))
SUBJECT = MODEL.subject(BETAS)
REST = np.zeros((4, 3))


def motion(frames=40, seed=0):
    """Poses that swing, and a place that drifts."""
    rng = np.random.default_rng(seed)
    t = np.arange(frames)[:, None, None] / 12
    poses = 0.45 * np.sin(t * rng.uniform(1, 2, (4, 3)) + rng.uniform(0, 6, (4, 3)))
    return poses, np.array([0.3, -0.2, 1.0]) + 0.2 * t[:, 0] * rng.normal(size=3)


def sequence(places=None, seed=0, kind="triangle"):
    """Markers at places (L, 3) on the resting person, as they move with it; where the layout has them if not given."""
    rest = MODEL.template.with_vertices(SUBJECT.vertices(REST))
    places = LAYOUT.place(rest) if places is None else places
    hung = latent_markers(rest, places, kind)
    vertices = SUBJECT.vertices(*motion(seed=seed))
    return MarkerSequence(hung.places(vertices, hung.coefficients(rest.vertices, places)), LABELS, 60.0)


@cache
def displaced(by=0.012):
    """Places on the resting person beside the usual ones, at the usual distance from the skin."""
    rest = MODEL.template.with_vertices(SUBJECT.vertices(REST))
    rng = np.random.default_rng(4)
    found = Surface(rest).closest(LAYOUT.place(rest) + rng.normal(0, by, (26, 3)))
    return found.points + 0.0095 * rest.face_normals[found.faces]


@cache
def known(attachment="triangle"):
    return find_person(MODEL, sequence(kind=attachment), LAYOUT, EXACT, attachment=attachment)


@cache
def beside():
    return find_person(MODEL, sequence(displaced()), LAYOUT, USUAL)


def rest_places(layout, betas):
    return layout.place(MODEL.template.with_vertices(MODEL.vertices(REST, betas)))


@pytest.mark.parametrize("attachment", ["triangle", "neighbourhood"])
def test_markers_without_error_give_back_the_person(attachment):
    found = known(attachment)
    np.testing.assert_allclose(found.betas, BETAS, atol=0.02)
    assert found.converged and found.residual < 3e-4
    np.testing.assert_allclose(rest_places(found.layout, found.betas), rest_places(LAYOUT, BETAS), atol=1e-3)
    poses, trans = motion()
    np.testing.assert_allclose(found.trans, trans[found.frames[:, 1]], atol=2e-3)
    turned = np.swapaxes(rotations.exp(found.poses), -1, -2) @ rotations.exp(poses[found.frames[:, 1]])
    assert np.linalg.norm(rotations.log(turned), axis=-1).max() < 0.02


def test_markers_beside_their_usual_place_are_found_there():
    found, at = beside(), displaced()
    usual = rest_places(LAYOUT, BETAS)
    off = np.linalg.norm(rest_places(found.layout, found.betas) - at, axis=1)
    assert off.mean() < 0.5 * np.linalg.norm(usual - at, axis=1).mean()
    assert found.residual < 5e-3
    wanted, own = np.linalg.norm(usual - at, axis=1), found.moved
    assert np.corrcoef(wanted, own)[0, 1] > 0.8
    np.testing.assert_allclose(found.layout.distances, 0.0095, atol=4e-3)


@pytest.mark.slow
def test_betas_are_as_long_as_the_markers_can_tell():
    """People who differ by a millimetre or two, in twelve ways, with markers 10 mm beside their place and 5 mm off the
    skin in every frame alike: the betas found are neither longer nor shorter than what is true of them: the truth is
    their own value on average. With a skin believed to a millimetre they were twice too long, and told nothing."""
    model = worm_with_prior(12)
    space = model.shape_space
    model = replace(model, shape_space=replace(space, components=space.components * np.float32(0.1),
                                               variances=0.01 * space.variances))
    found, true = np.array([found_and_true(model, np.random.default_rng(seed)) for seed in range(16)]).swapaxes(0, 1)
    assert 0.8 < (found * true).sum() / (found**2).sum() < 1.25
    assert ((found - true)**2).mean() < 0.85 * (true**2).mean()
    assert np.abs(found).max() < 3.5


def found_and_true(model, rng):
    """Betas of somebody as found and in truth; the markers keep their wrong places."""
    betas = rng.normal(size=model.n_betas)
    subject = model.subject(betas)
    rest = model.template.with_vertices(subject.vertices(REST))
    on_skin = Surface(rest).closest(LAYOUT.place(rest) + rng.normal(0, 0.010, (26, 3)))
    places = on_skin.points + rng.normal(0.0095, 0.005, (26, 1)) * rest.face_normals[on_skin.faces]
    hung, vertices = latent_markers(rest, places), subject.vertices(*motion(seed=int(rng.integers(1000))))
    markers = MarkerSequence(hung.places(vertices, hung.coefficients(rest.vertices, places)), LABELS, 60.0)
    return find_person(model, markers, LAYOUT, USUAL).betas, betas


def test_another_place_and_direction_is_the_same_person():
    R, t = rotations.exp(np.array([0.5, -1.9, 0.8])), np.array([3.0, -1.0, 0.4])
    first = sequence(displaced())
    second = find_person(MODEL, MarkerSequence(first.positions @ R.T + t, LABELS, 60.0), LAYOUT, USUAL)
    np.testing.assert_array_equal(second.frames, beside().frames)
    np.testing.assert_allclose(second.betas, beside().betas, atol=0.02)
    np.testing.assert_allclose(rest_places(second.layout, second.betas),
                               rest_places(beside().layout, beside().betas), atol=1e-3)


def test_several_sequences_of_one_subject_are_one_person():
    one, two = sequence(displaced()), sequence(displaced(), seed=3)
    renamed = MarkerSequence(two.positions[:, ::-1], (*LABELS[:0:-1], "X0"), 60.0)
    layout = replace(LAYOUT, aliases={"X0": "M00"})
    both = find_person(MODEL, [one, two], layout, USUAL)
    aliased = find_person(MODEL, [one, renamed], layout, USUAL)
    assert set(both.frames[:, 0]) == {0, 1} and both.frames[:, 1].max() < 40
    np.testing.assert_allclose(aliased.betas, both.betas, atol=1e-9)
    assert aliased.layout.labels == LABELS and dict(aliased.layout.aliases) == {"X0": "M00"}
    np.testing.assert_allclose(both.betas, BETAS, atol=0.35)


def test_missing_and_wild_markers_change_little():
    data = np.array(sequence(displaced()).positions)
    rng = np.random.default_rng(0)
    data[rng.random(data.shape[:2]) < 0.15] = np.nan
    data[:, 5] += [0.5, 0.3, -0.4]                                  # as if on something else
    found = find_person(MODEL, MarkerSequence(data, LABELS, 60.0), LAYOUT, USUAL)
    np.testing.assert_allclose(found.betas, beside().betas, atol=0.3)
    assert np.isnan(found.residuals).any() and np.nanmin(found.residuals[:, 5]) > 0.3
    assert np.nanmean(np.delete(found.residuals, 5, axis=1)) < 5e-3


def test_frames_of_the_paper_are_drawn_at_random():
    _, positions = common_markers([sequence()], LAYOUT)
    first = choose_frames(positions, PersonConfig(published=True, frames=7))
    np.testing.assert_array_equal(first, choose_frames(positions, PersonConfig(published=True, frames=7)))
    assert len(set(first)) == 7 and (np.diff(first) > 0).all()
    assert not np.array_equal(first, choose_frames(positions, PersonConfig(frames=7)))


def test_everything_together():
    """The motion of every frame comes back; residual columns are those of the file."""
    data = sequence(displaced())
    more = MarkerSequence(np.concatenate([data.positions, data.positions[:, :1] + 1], axis=1), (*LABELS, "prop"), 60.0)
    found = mosh(more, MODEL, LAYOUT, MoshConfig(person=USUAL, soft_tissue=False))
    assert len(found.motions) == len(found.artefacts) == 1 and found.soft_tissue == ()
    assert found.motions[0].labels == more.labels and np.isnan(found.motions[0].residuals[:, -1]).all()
    assert np.nanmean(found.motions[0].residuals) < 5e-3 and not found.artefacts[0].swaps
    poses, trans = motion()
    body = found.motions[0].vertices(MODEL.subject(found.betas))
    assert np.linalg.norm(body - SUBJECT.vertices(poses, trans), axis=2).mean() < 0.01
    np.testing.assert_array_equal(found.betas, found.person.betas)


def test_labels_that_were_exchanged_do_not_spoil_the_person():
    """Tracks tell it before there is a body: the person is the one of the clean sequence."""
    data = sequence(displaced())
    swapped, T = data.positions.copy(), len(data.positions)
    some = np.arange(T // 3, 2 * T // 3)
    swapped[np.ix_(some, [0, 7])] = swapped[np.ix_(some, [7, 0])]
    found = mosh(MarkerSequence(swapped, data.labels, data.rate), MODEL, LAYOUT,
                 MoshConfig(person=USUAL, soft_tissue=False))
    swap, = found.artefacts[0].swaps
    assert {swap.first, swap.second} == {LABELS[0], LABELS[7]} and (swap.begin, swap.end) == (some[0], some[-1])
    np.testing.assert_array_equal(found.betas, beside().betas)
    assert np.nanmean(found.motions[0].residuals) < 5e-3


def worn_otherwise(row, places, exchanged=()):
    """A marker at other places (T, 3), and pairs that bear each other's name."""
    data = np.array(sequence(displaced()).positions)
    data[:, row] = places
    for i, j in exchanged:
        data[:, [i, j]] = data[:, [j, i]]
    return mosh(MarkerSequence(data, LABELS, 60.0), MODEL, LAYOUT, MoshConfig(person=USUAL, soft_tissue=False))


def test_a_marker_worn_elsewhere_and_a_pair_of_exchanged_names_are_put_right():
    moved = np.array(displaced())
    moved[3] = moved[15]                                        # half a metre along the worm, beside another marker
    found = worn_otherwise(3, sequence(displaced()).positions[:, 15], [(6, 20)])
    assert [m.label for m in found.misplaced.moved] == ["M03"] and found.misplaced.exchanged == (("M06", "M20"),)
    rows = [LABELS.index(label) for label in found.layout.labels]
    off = np.linalg.norm(rest_places(found.layout, found.betas) - moved[rows], axis=1)
    assert off[found.layout.labels.index("M03")] < 0.01 and off.max() < 0.04
    swap, = found.artefacts[0].swaps
    assert (swap.first, swap.second, swap.begin, swap.end) == ("M06", "M20", 0, 39)
    assert found.artefacts[0].order[0, [6, 20]].tolist() == [20, 6]
    assert not found.motions[0].distrusted and np.nanmean(found.motions[0].residuals) < 5e-3
    np.testing.assert_allclose(found.betas, beside().betas, atol=0.35)


def test_a_marker_that_no_place_of_the_skin_explains_is_told_and_left_out():
    floating = np.array(displaced())
    floating[3] += [0.0, 0.0, 0.3]
    found = worn_otherwise(3, sequence(floating).positions[:, 3])
    assert found.misplaced.unplaced == ("M03",) and not found.misplaced.moved and not found.misplaced.exchanged
    assert "M03" not in found.layout.labels and "M03" in found.misplaced.judgement(found.layout.labels).doubts[0]
    assert np.nanmean(found.motions[0].residuals) < 5e-3
    np.testing.assert_allclose(found.betas, beside().betas, atol=0.35)


@pytest.mark.parametrize(("share", "verdict"), [(1.0, "all"), (0.7, "most")])
def test_a_part_keeps_its_markers(share, verdict):
    """When a part would lose its markers, not they are at fault: they stay, and it is said."""
    at = _Frames(MODEL, beside(), [sequence(displaced())], LAYOUT, 0.0)
    part = at.part[LAYOUT.nearest]
    mine = np.array(LABELS)[part == part[0]]
    gone = tuple(mine[:round(share * len(mine))].tolist())
    found = _with_whole_parts(at, MisplacedMarkers(unplaced=(*gone, LABELS[-1])), MODEL.skeleton.names)
    (told,) = found.lost
    assert found.unplaced == (LABELS[-1],) and told == (MODEL.skeleton.names[part[0]], gone, verdict == "all")
    judgement = found.judgement(LABELS)
    why = judgement.reasons
    assert why[0].startswith(f"{verdict} markers of the {told[0]} ({', '.join(gone)})")
    assert judgement.verdict == ("failed" if verdict == "all" else "check")


def test_knees_that_are_bent_in_every_frame_stay_bent():
    """The poses that a model has learned of stand, so a crouched person stood up, and markers slid along the skin."""
    model, rng = load_built_in_model(), np.random.default_rng(1)
    layout = load_layout("cmu41", model.template, np.array(model.info["people_vertices"]))
    person = model.subject(np.array([0.8, -1]))
    part = {name: j for j, name in enumerate(model.skeleton.names)}
    poses = np.zeros((6, 16, 3))
    for side in ("left", "right"):
        for name, degrees in (("thigh", -50), ("shin", 70), ("foot", -20)):
            poses[:, part[f"{name}_{side}"], 0] = np.radians(degrees)
    poses[:, part["forearm_left"], 0] = np.radians(np.linspace(-60, -20, 6))
    at = np.stack([layout.place(model.template.with_vertices(v)) for v in person.vertices(poses, np.zeros((6, 3)))])
    markers = MarkerSequence(at + rng.normal(0, 0.007, (41, 3)), layout.labels, 60.0)      # beside their places
    poses = find_person(model, markers, layout, PersonConfig(frames=6)).poses
    bent = np.degrees(np.linalg.norm(poses[:, [part["shin_left"], part["shin_right"]]], axis=2))
    assert np.abs(bent - 70).max() < 4


def test_a_marker_that_is_never_believed_is_left_out_of_the_mean():
    floating = np.array(displaced())
    floating[3] += [0.0, 0.0, 0.3]
    motion = animate(MODEL.subject(beside().betas), sequence(floating), beside().layout)
    assert motion.distrusted == ("M03",)
    assert np.nanmean(motion.residuals_of_trusted()) < 5e-3 and np.nanmean(motion.residuals) > 0.01
    assert markers_told([motion]).value == "25 of 26, without M03"
    assert "M03" in find_distrusted_markers([motion])[0]


@pytest.mark.slow
def test_left_and_right_exchanged_on_many_markers_are_put_right_together():
    sides = [(f"L{name}", f"R{name}") for name in "ABCDE"]
    names = tuple(dict.fromkeys([left for left, _ in sides] + list(LABELS[5:20]) + [right for _, right in sides]
                                + list(LABELS[25:])))
    layout, data = replace(LAYOUT, labels=names), sequence(displaced()).positions
    markers = MarkerSequence(data[:, [*range(20, 25), *range(5, 20), *range(5), 25]], names, 60.0)
    found = find_misplaced_markers(MODEL, [markers], layout, find_person(MODEL, markers, layout, USUAL), USUAL)
    assert found.exchanged == tuple(sides) and not found.moved and not found.unplaced
    np.testing.assert_array_equal(found.restore_names(markers, layout).positions, data)


@pytest.mark.slow
def test_where_the_body_is_at_fault_no_marker_is_moved():
    order = np.random.default_rng(0).permutation(26)
    markers = MarkerSequence(sequence(displaced()).positions[:, order], LABELS, 60.0)
    found = find_misplaced_markers(MODEL, [markers], LAYOUT, find_person(MODEL, markers, LAYOUT, USUAL), USUAL)
    assert not found.changes and len(found.too_many) > 7 and "the wrong layout" in found.judgement(LABELS).doubts[0]


def test_a_marker_moved_by_more_than_a_hand_is_to_be_looked_at():
    moved = [MovedMarker(label, np.arange(3), np.eye(3)[0], 0.01, before, 0.01) for label, before in
             (("M1", 0.07), ("M2", 0.31))]
    (told,) = MisplacedMarkers(moved=tuple(moved)).judgement(LABELS).doubts
    assert told == "moved by more than a hand's width: M2 by 31 cm"


def test_the_first_frame_is_the_most_usual_one():
    """A triangle whose third corner is 1 to 3 m away: 2.1 m is nearest to the mean, then come the farthest."""
    away = np.array([1.0, 3, 2.1, 1.2, 2.8])
    frames = np.zeros((5, 3, 3))
    frames[:, 1, 0], frames[:, 2, 1] = 0.1, away
    assert [spread_frames(frames, count).tolist() for count in (1, 2, 3)] == [[2], [0, 2], [0, 1, 2]]


def test_a_quarter_of_the_markers_moved_by_more_than_a_hand_means_nothing():
    moves = {label: 0.09 for label in LABELS[:7]}
    failed = judge_moves(moves, 27)
    assert failed.verdict == "failed" and failed.why.startswith("7 of 27 markers moved by more than a hand's width")
    assert judge_moves(moves, 28).verdict == "check" and judge_moves(dict.fromkeys(LABELS, 0.07), 26) == Judgement()


def test_the_published_preset_is_the_patent():
    """Stage one, poses and soft tissue of [MoSh]; every marker believed alike and nothing repaired."""
    found = MoshConfig.from_paper()
    person, poses, soft = found.person, found.poses, found.soft
    assert (person.data, person.surface, person.initial, person.shape, person.pose) == (0.75, 100, 0.25, 1, 0.25)
    assert (person.frames, person.published, person.annealing) == (12, True, (40, 20, 10, 4, 2, 1))
    assert (0.01 / poses.marker_sd)**2 == pytest.approx(0.75) and poses.prior_weight == 1
    assert (120**2 / poses.angle_acceleration)**2 == pytest.approx(6.25)
    assert (soft.data, soft.pose, soft.velocity, found.repair) == (0.75, 1, 6.25, False)
    data = sequence(displaced())
    result = mosh(data, MODEL, LAYOUT, replace(found, person=replace(person, frames=8, annealing=(10.0, 4.0, 1.0))))
    assert not result.artefacts[0].swaps and not result.artefacts[0].bad
    np.testing.assert_array_equal(result.artefacts[0].repaired.positions, data.positions)
    body = result.soft_tissue[0].vertices(MODEL)
    assert np.linalg.norm(body - SUBJECT.vertices(*motion()), axis=2).mean() < 0.02


def test_places_that_are_known_are_held():
    """With a strong weight on the usual places betas alone are left, and come back exactly as from a known layout."""
    found = find_person(MODEL, sequence(), LAYOUT, replace(USUAL, initial=1e4, shape=1e-3, pose=1e-3))
    assert found.moved.max() < 1e-3
    np.testing.assert_allclose(found.betas, BETAS, atol=0.05)
