import igl
import numpy as np
import pytest
from scanned_shapes import ball, joined

from scanprep.cleaning.clean_scan import (
    FAR,
    FLOOR,
    LANDMARKS,
    LARGEST,
    NEAR,
    SPECKS,
    CleanScanConfig,
    clean_scan,
    cleaning_doubts,
    label_pieces,
    take_clutter,
)
from scanprep.cleaning.floor import inside_outline
from scanprep.geometry import rotations
from scanprep.geometry.mesh import Mesh
from scanprep.synthetic.people import SyntheticPerson

NOISE = 0.002


def grid(width, depth, spacing=0.01):
    """A flat sheet through the origin, facing up."""
    x, y = (np.arange(-s / 2, s / 2, spacing) for s in (width, depth))
    X, Y = np.meshgrid(x, y, indexing="ij")
    number = np.arange(X.size).reshape(X.shape)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    faces = np.concatenate([np.stack(t, axis=-1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))])
    return Mesh(np.stack([X.ravel(), Y.ravel(), np.zeros(X.size)], axis=1), faces)


def moved(mesh, by, R=None):
    return mesh.with_vertices(mesh.vertices @ (np.eye(3) if R is None else R).T + np.asarray(by))


UPRIGHT = rotations.exp(np.array([0, np.pi / 2, 0]))


@pytest.fixture(scope="module")
def person():
    """With four triangles for one: scans have points every centimetre."""
    mesh = SyntheticPerson().mesh
    mesh = Mesh(*igl.upsample(mesh.vertices, mesh.faces, 1))
    return moved(mesh, [0, 0, -mesh.vertices[:, 2].min()])


@pytest.fixture(scope="module")
def scene(person):
    """A noisy person on a floor, a chair leg and a table top beside; which vertices are whose."""
    rng = np.random.default_rng(0)
    floor = grid(1.6, 1.6)
    low = person.vertices[person.vertices[:, 2] < 0.02][:, :2]
    hidden = inside_outline(floor.vertices[:, :2], low, 0.015)       # nobody sees the floor under the feet
    floor = floor.submesh(~hidden[floor.faces].any(axis=1))[0]
    leg = moved(grid(0.45, 0.04), [0.5, -0.4, 0.225], UPRIGHT)
    table = moved(grid(0.6, 0.3), [-0.5, 0.75, 0.7])
    parts = [person, floor, leg, table]
    whole = joined(*parts)
    whole = whole.with_vertices(whole.vertices + NOISE * rng.normal(size=whole.vertices.shape))
    return whole, np.repeat(np.arange(4), [len(p.vertices) for p in parts])


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["mesh", "points"])
def test_the_person_is_left_with_the_soles(scene, person, kind):
    mesh, whose = scene
    clean = clean_scan(mesh if kind == "mesh" else mesh.vertices)
    assert clean.kept[whose == 0].mean() > 0.999
    soles = (whose == 0) & (np.r_[person.vertices[:, 2], np.full((whose > 0).sum(), 9)] < 3 * NOISE)
    assert soles.sum() > 50 and clean.kept[soles].mean() > 0.98
    assert not clean.kept[whose > 1].any()
    wrong = mesh.vertices[clean.kept & (whose == 1)]
    assert len(wrong) < 0.01 * (whose == 1).sum()
    feet = person.vertices[person.vertices[:, 2] < 0.05]
    assert all(np.linalg.norm(feet[:, :2] - p[:2], axis=1).min() < 0.03 for p in wrong)
    assert clean.floor.normal[2] > 0.9999 and abs(clean.floor.offset) < 5e-4
    assert clean.floor.noise == pytest.approx(NOISE, rel=0.1)
    assert isinstance(clean.scan, Mesh) == (kind == "mesh")
    assert len(clean.mesh.vertices) == pytest.approx(clean.kept.sum(), rel=5e-3)      # loose points have no triangle


@pytest.mark.slow
def test_every_piece_is_accounted_for(scene):
    mesh, whose = scene
    clean = clean_scan(mesh)
    rows = clean.components
    assert [row.reason for row in rows[:4]] == [FLOOR, LARGEST, FAR, FAR]
    assert [row.reason for row in rows[4:]] in ([], [SPECKS])
    assert sum(row.points for row in rows) == len(whose)
    assert np.array_equal(np.bincount(clean.label), [row.points for row in rows])
    table, leg = rows[2], rows[3]
    assert table.points == (whose == 3).sum()
    assert table.size[2] < 0.03 and leg.size[2] == pytest.approx(0.45, abs=0.03)
    assert [row.kept for row in rows[:4]] == [False, True, False, False]


@pytest.mark.slow
def test_floor_and_wall_go_and_the_floor_is_the_one_stood_on(scene):
    mesh, whose = scene
    rng = np.random.default_rng(2)
    wall = moved(grid(2.2, 1.6), [0.9, 0, 1.1], UPRIGHT)
    wall = wall.with_vertices(wall.vertices + NOISE * rng.normal(size=wall.vertices.shape))
    clean = clean_scan(joined(mesh, wall))
    assert [row.reason for row in clean.components[:3]] == [FLOOR, FLOOR, LARGEST]
    assert clean.floor.normal[2] > 0.999
    assert not clean.kept[len(whose):].any() and clean.kept[:len(whose)][whose == 0].mean() > 0.999


@pytest.mark.slow
def test_landmarks_say_which_piece_is_the_body(person):
    large = moved(ball(5, 1.5), [4, 0, 0])
    both = joined(person, large)
    assert not clean_scan(both).kept[:len(person.vertices)].any()
    clean = clean_scan(both, landmarks=person.vertices[[10, 500, 3000]])
    assert clean.kept[:len(person.vertices)].all() and not clean.kept[len(person.vertices):].any()
    assert sorted(row.reason for row in clean.components) == sorted([LANDMARKS, FAR])


def test_near_pieces_stay_and_specks_go(person):
    top = person.vertices[person.vertices[:, 2].argmax()]
    hat, balloon, dust = (moved(ball(d, r), top + [0, 0, up]) for d, r, up in
                          ((3, 0.05, 0.077), (3, 0.05, 0.3), (0, 0.002, 0.16)))
    clean = clean_scan(joined(person, hat, balloon, dust))
    reasons = [row.reason for row in clean.components]
    assert sorted(reasons) == sorted([LARGEST, NEAR, FAR, SPECKS])
    assert clean.kept.sum() == len(person.vertices) + len(hat.vertices) and clean.floor is None


def test_an_arm_seen_in_steps_stays_and_a_thing_beyond_its_hand_goes():
    # A depth camera sees a body 10 mm apart, and of an arm that points away from it slices 45 mm behind each other.
    body = grid(0.5, 1.7)
    arm = [moved(grid(0.08, 0.08), [0.3 + 0.045 * i, 0.5, 0.045 * i]) for i in range(6)]
    thing = moved(grid(0.3, 0.3), [0.9, 0.5, 0.25])
    clean = clean_scan(joined(body, *arm, thing).vertices, CleanScanConfig(planes=0))
    assert clean.kept[:-len(thing.vertices)].all() and not clean.kept[-len(thing.vertices):].any()
    assert [row.reason for row in clean.components] == [LARGEST, FAR, *[NEAR] * 5]
    dense = clean_scan(joined(grid(0.5, 1.7, 0.005), *arm[1:], thing).vertices, CleanScanConfig(planes=0))
    assert [row.reason for row in dense.components] == [LARGEST, FAR, *[FAR] * 5]      # no camera takes such steps


def test_what_a_depth_camera_did_not_see_is_not_taken_for_the_body(person):
    rng = np.random.default_rng(3)
    unseen = np.column_stack([rng.uniform(-15, 15, (200, 2)), np.full(200, 65.535)])
    clean = clean_scan(np.concatenate([person.vertices, unseen]))
    assert clean.kept[:-200].all() and not clean.kept[-200:].any()


@pytest.mark.slow
def test_clutter_goes_unasked_and_nothing_that_may_be_wanted(person):
    """A small box beside the person is taken off. A second person, a room, and a person alone stay as they are."""
    box = moved(ball(3, 0.1), [0.9, 0, 0.1])
    clean, removed = take_clutter(joined(person, box))
    np.testing.assert_array_equal(clean.vertices, person.vertices)
    assert removed == pytest.approx(len(box.vertices) / (len(box.vertices) + len(person.vertices)))
    # one camera saw a hand whose forearm and upper arm it did not see: the person is 0.35 m away
    hand = moved(ball(3, 0.05), [person.vertices[:, 0].max() + 0.4, 0, 1.0])
    assert take_clutter(joined(person, hand))[1] == 0
    for scan in (person, joined(person, moved(person, [1.5, 0, 0])),
                 joined(person, moved(grid(5, 5, 0.02), [0, 0, -0.05])), np.zeros((0, 3))):
        assert take_clutter(scan) == (scan, 0.0)


def test_nothing_is_an_error():
    with pytest.raises(ValueError, match="scan: expected points"):
        clean_scan(np.zeros((0, 3)))


def test_views_side_by_side_are_one_piece():
    one = ball(4)
    left, right = (one.submesh(s * one.corners[:, :, 0].mean(axis=1) > -0.01)[0] for s in (1, -1))
    both = joined(left, right)
    assert label_pieces(both, np.arange(len(both.vertices)), 0.012).max() == 0
    with pytest.warns(UserWarning, match="scan: 512 repeated triangles dropped"):
        clean = clean_scan(both)
    assert clean.kept.all() and clean.mesh.face_areas.sum() == pytest.approx(one.face_areas.sum(), rel=1e-12)


def test_pieces_are_those_of_the_scan_wherever_it_stands():
    """The cells began at the origin of the file: three metres away other points stood for them."""
    points = np.random.default_rng(0).random((300, 3)) * [1, 1, 0.02]
    there = [label_pieces(Mesh(points + offset, np.zeros((0, 3), dtype=int)), np.arange(300), 0.05)
             for offset in ([0, 0, 0], [3, -3.015625, 3.0078125])]
    np.testing.assert_array_equal(*there)


def plinth(width, height, closed, spacing=0.008):
    """The top and the sides of a block under the origin, and its bottom where it is closed."""
    side = grid(width, height, spacing)
    upright = [rotations.exp([0, 0, turn]) @ rotations.exp([np.pi / 2, 0, 0]) for turn in np.pi / 2 * np.arange(4)]
    top = grid(width, width, spacing)
    return [top, *([moved(top, [0, 0, -height])] if closed else []),
            *(moved(side, R @ [0, 0, width / 2] - [0, 0, height / 2], R) for R in upright)]


@pytest.mark.slow
@pytest.mark.parametrize(("width", "height", "goes"), [(0.6, 0.3, True), (0.7, 1.0, False)])
def test_a_pedestal_goes_with_its_top_or_is_doubted(width, height, goes):
    """It was kept and called good; as high as a seat it might be part of somebody who sits."""
    body = SyntheticPerson().mesh
    body = moved(body, [*-body.vertices.mean(axis=0)[:2], -body.vertices[:, 2].min()])
    pieces = [body, *plinth(width, height, closed=not goes)]
    cleaned = clean_scan(joined(*pieces))
    assert (cleaned.mesh.vertices[:, 2] < -0.02).any() != goes and bool(cleaning_doubts(cleaned)) != goes
    assert cleaned.kept[:len(body.vertices)].mean() > 0.97
