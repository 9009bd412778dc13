"""Measurements: known sections and ways, two derivations of a girth, derivatives, what is carried, what is missing."""
import math

import numpy as np
import pytest
import trimesh
from derivatives import slope
from people_bodies import small_people
from scipy.spatial import ConvexHull
from scipy.stats import norm

from model import body_with_measurements, find_tapes, load_built_in_model, measure
from model.measurement import reading
from model.measurement.catalogue import CATALOGUE
from model.measurement.measure import measurement_error
from model.measurement.path import shortest_path
from model.measurement.reading import Reading, Standing
from model.measurement.section import SectionCurve, bulge, direction, section, tape, tape_length
from model.measurement.tapes import Girth, Span, Way, Weight
from model.shape_statistics import draw_betas, shape_statistics
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.rotations import exp
from scanprep.synthetic.landmarks import landmarks
from scanprep.synthetic.people import BodyShape, SyntheticPerson

UP = np.array([0.0, 0.0, 1.0])


@pytest.fixture(scope="module")
def person():
    return SyntheticPerson(BodyShape.like("female", weight=0.8))


@pytest.fixture(scope="module")
def tapes():
    return find_tapes(SyntheticPerson().mesh, landmarks())


@pytest.fixture(scope="module")
def small_tapes():
    return find_tapes(small_people().template, small_people().info["landmarks"])


def tube(radius=0.05, height=0.4, around=40, rings=31, profile=None):
    """A tube without ends about z; `profile` (angle) -> radius."""
    angle = 2 * np.pi * np.arange(around) / around
    far = np.full(around, radius) if profile is None else profile(angle)
    ring = np.stack([far * np.cos(angle), far * np.sin(angle)], axis=1)
    vertices = np.array([[*xy, z] for z in np.linspace(0, height, rings) for xy in ring])
    a = np.arange(around * (rings - 1)).reshape(rings - 1, around)
    b = np.roll(a, -1, axis=1)
    return Mesh(vertices, np.stack([a, b, a + around, b, b + around, a + around], axis=-1).reshape(-1, 3))


def taped(mesh, height, normal=UP):
    """Length of the tape around a mesh at a height, and of the plain polygon."""
    curve, = section(mesh.vertices, mesh.faces, height * UP, normal)
    assert curve.closed
    points = curve.at(mesh.vertices) + bulge(mesh.vertices, mesh.vertex_normals, curve)[0]
    hull = tape(points, normal)
    apart = np.abs(hull - np.roll(hull, 1))
    return tape_length(points[hull],
                       (apart == 1) | (apart == len(points) - 1))[0], tape_length(curve.at(mesh.vertices))[0]


def test_a_tape_around_a_coarse_tube_is_as_long_as_its_circle():
    """With 14 corners a polygon loses three percent."""
    smooth, plain = taped(tube(around=14), 0.2037)
    assert smooth == pytest.approx(2 * np.pi * 0.05, rel=2e-3)
    assert 0.006 < 1 - plain / (2 * np.pi * 0.05) < 0.03


def test_a_tape_across_a_tube_at_a_slant_is_an_ellipse():
    from scipy.special import ellipe

    tilt = np.radians(30)
    found, _ = taped(tube(around=160, rings=121), 0.2037, np.array([0, -np.sin(tilt), np.cos(tilt)]))
    assert found == pytest.approx(4 * 0.05 / np.cos(tilt) * ellipe(np.sin(tilt)**2), rel=1e-3)


def test_a_tape_spans_hollows():
    def profile(angle):
        return 0.05 * (1 + 0.7 * np.cos(2 * angle))

    mesh = tube(around=400, profile=profile)
    found, plain = taped(mesh, 0.2037)
    assert found == pytest.approx(ConvexHull(mesh.vertices[:400, :2]).area, rel=1e-3) and found < 0.95 * plain


def test_ways_are_exact():
    """On a tube as on the plane it unrolls to, up to what the polygon cuts off."""
    mesh = tube(around=60, rings=81)
    start, end = 10 * 60 + 3, 70 * 60 + 23
    length, curve = shortest_path(mesh.vertices, mesh.faces, start, end)
    edge = 2 * 0.05 * np.sin(np.pi / 60)
    assert length == pytest.approx(np.hypot(20 * edge, 0.3), rel=1e-9)
    drawn = np.diff(curve.at(mesh.vertices), axis=0)
    assert np.linalg.norm(drawn, axis=1).sum() == pytest.approx(length, rel=1e-6)
    with pytest.raises(ValueError, match="no way along the surface"):
        two = Mesh(np.concatenate([mesh.vertices, mesh.vertices + 1]), np.concatenate([mesh.faces, mesh.faces + 4860]))
        shortest_path(two.vertices, two.faces, start, end + 4860)


def test_all_is_measured_of_a_person(person, tapes):
    found = measure(person.mesh, tapes)
    assert not found.missing and not found.turned and set(found.values) == set(CATALOGUE)
    for name, value in found.values.items():
        assert CATALOGUE[name].low < value < CATALOGUE[name].high, name
    # legs stand apart at rest: straight down they are as long as from joint to joint
    hips, ankles = person.joints[[10, 13]], person.joints[[12, 15]]
    longer = np.mean(np.linalg.norm(hips - ankles, axis=1) - (hips - ankles)[:, 2])
    stature = measure(person.mesh, tapes, tapes.axes, only=["stature"]).values["stature"]
    assert stature == pytest.approx(np.ptp(person.mesh.vertices[:, 2]) + longer, abs=0.003)
    for name in found.values:
        if name.endswith("_left"):
            assert found.values[name] == pytest.approx(found.values[name.replace("left", "right")], rel=0.01), name


@pytest.mark.parametrize(("name", "girth"), [("back_length", "waist_girth"), ("arm_length_left", "wrist_girth_left")])
def test_a_way_ends_at_the_girth_wherever_the_vertices_lie(tapes, name, girth):
    """On all bodies: a vertex of the template's section was up to 2 cm from the section of another."""
    for shape in (BodyShape(), BodyShape("female"), BodyShape.like("male", stature=1.95, weight=-2)):
        body = SyntheticPerson(shape).mesh
        way, ring = measure(body, tapes, tapes.axes, only=[name]).readings[name], tapes.found[girth]
        end, origin = way.curve[-1], ring.height.at(body.vertices)
        normal = UP if ring.axis is None else direction(ring.axis, body.vertices)
        assert (end - origin) @ normal == pytest.approx(0, abs=1e-9)
        assert way.value == pytest.approx(np.linalg.norm(np.diff(way.curve, axis=0), axis=1).sum(), abs=2e-3)


def test_place_turn_and_size_change_nothing_else(person, tapes):
    still = measure(person.mesh, tapes).values
    turned = measure(person.mesh.vertices @ exp(np.array([0.3, -0.5, 2.0])).T + [3, -2, 5], tapes).values
    larger = measure(1.1 * person.mesh.vertices, tapes).values
    for name, value in still.items():
        assert turned[name] == pytest.approx(value, abs=2e-5), name
        assert larger[name] == pytest.approx(1.1**(3 if name == "weight" else 1) * value, rel=2e-3), name


@pytest.mark.slow
@pytest.mark.parametrize("smooth", [False, True])
def test_derivatives_are_finite_differences(person, tapes, smooth, monkeypatch):
    """Exact on plain triangles, but for ways that change theirs; of the smooth tape turning normals are left out."""
    if not smooth:
        monkeypatch.setattr(reading, "bulge", lambda body, normals, curve: 2 * (np.zeros((len(curve.share), 3)),))
        monkeypatch.setattr(reading, "tape_length", lambda points, near: tape_length(points))
    rng, axes = np.random.default_rng(0), tapes.axes
    body = person.mesh.vertices + 1e-4 * rng.normal(size=person.mesh.vertices.shape)       # no two soles alike
    moves = np.sin(body @ rng.normal(size=(3, 3)) * 3 + rng.normal(size=3))
    for name, found in tapes.found.items():
        def read(step, found=found):
            return reading.read_measurement(found, Standing(person.mesh.with_vertices(body + step * moves), axes),
                                            tapes)

        limit = 0.15 if smooth and isinstance(found, Girth | Span) else 0.05 if isinstance(found, Way) else 1e-5
        step = 1e-3 if isinstance(found, Way) else 1e-6        # metres; a way is cut where it happens to be traced
        assert read(0).along(moves) == pytest.approx(slope(lambda s, read=read: read(s).value, step), abs=limit), name


def test_moved_limbs_are_told(person, tapes):
    pose = np.zeros((16, 3))
    pose[4, 1] = 1.2
    assert [line.split(" is ")[0] for line in measure(person.in_pose(pose), tapes).turned] == [
        "the left upper arm", "the left forearm"]


def test_what_a_template_lacks_is_told(person):
    few = {name: v for name, v in landmarks().items() if "nipple" not in name}
    found = find_tapes(person.mesh, few)
    assert found.missing["chest_girth"] == "the template has no landmark 'left nipple'"
    assert "waist_girth" in found.found and "chest_width" in found.missing
    with pytest.raises(ValueError, match=r"expected at least left toe, .*; there is no left toe"):
        find_tapes(person.mesh, {name: v for name, v in landmarks().items() if name != "left toe"})


def test_holes_leave_out_what_crosses_them(person, tapes):
    waist = tapes.found["waist_girth"]
    cut = np.abs(person.mesh.corners[..., 2].mean(axis=1) - waist.centre.at(person.mesh.vertices) @ UP) < 0.02
    front = person.mesh.corners[..., 1].mean(axis=1) < waist.centre.at(person.mesh.vertices)[1]
    opened = Mesh(person.mesh.vertices, person.mesh.faces[~(cut & front)])
    found = find_tapes(opened, landmarks())
    assert found.missing["waist_girth"] == "a hole of the template crosses it" and "hip_girth" in found.found


def test_bodies_of_other_triangles_are_refused(tapes):
    for wrong in (np.zeros((5, 3)), np.full(tapes.template.vertices.shape, np.nan)):
        with pytest.raises(ValueError, match="body: expected finite numbers of shape"):
            measure(wrong, tapes)


@pytest.mark.slow
def test_stated_errors(person, tapes):
    """None of the vertices leaves the sliding; small ones add up as squares; what moves as a whole cancels."""
    error = np.full(len(person.mesh.vertices), 0.001)
    plain, one, two = (measure(person.mesh, tapes, expected_error=k * error) for k in (0, 1, 2))
    for name, taken in plain.readings.items():
        slide = plain.errors[name]
        alone = 0.02 * taken.value if name == "weight" else 0.007 * abs(taken.slope)
        assert slide == pytest.approx(alone, abs=1e-9), name
        assert two.errors[name]**2 - slide**2 == pytest.approx(4 * (one.errors[name]**2 - slide**2), rel=1e-6), name
    waist = plain.readings["waist_girth"]
    assert np.abs(waist.along(np.ones_like(person.mesh.vertices)[:, None, :].transpose(0, 2, 1))).max() < 1e-9


def test_the_centroid_of_a_curve_counts_its_length_and_not_its_points():
    """Of a square with five points on one side, and as a carried point on another body: there with the same weights."""
    corners = np.array([[0.0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]])
    edges = np.array([[0, 1], [0, 1], [0, 1], [0, 1], [1, 2], [2, 3], [3, 0]])
    square = SectionCurve(edges, np.array([0.0, 0.1, 0.3, 0.6, 0.0, 0.0, 0.0]), True)
    np.testing.assert_allclose(square.centroid(corners).at(corners), [0.5, 0.5, 1])
    np.testing.assert_allclose(square.centroid(corners).at(2 * corners), [1, 1, 2])


@pytest.mark.parametrize("apart", [0.02, 0.1, 0.5])
def test_errors_of_near_points_cancel_and_of_far_ones_add_up(apart):
    """A distance whose ends are off by e in all directions: e²/3 at each, correlated as a bell of 15 cm says."""
    ends = np.array([[0.0, 0, 0], [apart, 0, 0], [0, 1, 0]])
    reading = Reading(apart, ends, np.array([0, 1]), np.array([[-1.0, 0, 0], [1, 0, 0]]), slope=0.5)
    e = 1e-4
    square = 2 * e**2 / 3 * (1 - np.exp(-0.5 * (apart / 0.15)**2)) + (0.5 * 0.007)**2
    assert measurement_error(reading, Mesh(ends, [[0, 1, 2]]), np.full(3, e))**2 == pytest.approx(square, rel=1e-9)


def test_the_body_with_some_measurements(small_tapes):
    model, tapes = small_people(), small_tapes
    betas = np.array([1.0, -0.8, 0.5, 0.3])
    pose = np.zeros((len(model.skeleton.parents), 3))
    there = measure(model.vertices(pose, betas), tapes, tapes.axes).values
    made = body_with_measurements(model, tapes, {"stature": there["stature"], "waist": there["waist_girth"]})
    assert not made.missed and made.deviations <= np.linalg.norm(betas) + 1e-6
    again = measure(model.vertices(pose, made.betas), tapes, tapes.axes).values
    assert again["stature"] == pytest.approx(there["stature"], abs=2e-4)
    assert again["waist_girth"] == pytest.approx(there["waist_girth"], abs=2e-4)
    mean = measure(model.vertices(pose, np.zeros(4)), tapes, tapes.axes).values
    usual = body_with_measurements(model, tapes, {"stature": mean["stature"]})
    assert usual.deviations < 1e-3 and usual.rarer > 0.999
    tall = body_with_measurements(model, tapes, {"stature": mean["stature"] + 0.05})
    assert tall.rarer == pytest.approx(math.erfc(tall.deviations / np.sqrt(2)))         # of one number: both tails
    apart = body_with_measurements(model, tapes, {"waist": 1.6, "hip": 0.7})
    assert set(apart.missed) == {"waist_girth", "hip_girth"} and np.isfinite(apart.betas).all()


@pytest.mark.parametrize(("given", "told"), [
    ({"stature": 4}, r"stature=4: expected 1.2 to 2.4 m"), ({"waist": 0.01}, r"waist=0.01: expected 0.4 to 2.2 m"),
    ({"shoe": 1}, "no measurement 'shoe'; there are: stature, "), ({}, "expected at least one measurement")])
def test_measures_that_no_person_has(given, told, small_tapes):
    with pytest.raises(ValueError, match=told):
        body_with_measurements(small_people(), small_tapes, given)


def test_a_cube_weighs_what_its_volume_does():
    """985 kg in a cubic metre, also inside out; growing in all directions it does so by the third power."""
    box = trimesh.creation.box((0.4, 0.5, 0.6))
    for faces in (box.faces, box.faces[:, ::-1]):
        taken = reading.read_measurement(Weight(), Standing(Mesh(box.vertices, faces), np.eye(3)), None)
        assert taken.value == pytest.approx(985 * 0.12) and taken.unknown == pytest.approx(0.02 * taken.value)
        assert taken.along(box.vertices) == pytest.approx(3 * taken.value)


@pytest.fixture(scope="module")
def built_in():
    model = load_built_in_model()
    return model, find_tapes(model.template, model.info["landmarks"])


@pytest.mark.parametrize("sex", ["female", "male"])
def test_the_most_probable_body_is_the_conditional_mean(built_in, sex):
    """Near the mean, where measures are linear: betas are m + C Sᵀ (S C Sᵀ)⁻¹ (goal - s), their ranges the regression's
    of drawn people on what was asked for.
    """
    model, tapes = built_in
    people, pose = shape_statistics(model, sex), np.zeros((16, 3))
    moves, m, C = model.shape_jacobian(pose), people.mean, people.covariance
    names = ("stature", "hip_girth", "waist_girth", "calf_girth_left")
    taken = measure(model.vertices(pose, m), tapes, tapes.axes, only=names).readings
    S = np.stack([taken[name].along(moves) for name in names])
    goal = np.array([taken[name].value for name in names[:2]]) + [0.01, -0.004]
    made = body_with_measurements(model, tapes, dict(zip(names, goal, strict=False)), sex)
    K = C @ S[:2].T @ np.linalg.inv(S[:2] @ C @ S[:2].T)
    assert np.abs(made.betas - m - K @ [0.01, -0.004]).max() < 0.02
    z = np.random.default_rng(0).normal(size=(20000, len(m))) @ people.root.T @ S.T
    left = z[:, 2:] - z[:, :2] @ np.linalg.lstsq(z[:, :2], z[:, 2:], rcond=None)[0]
    for name, spread in zip(names[2:], left.std(axis=0), strict=True):
        low, value, high = made.likely[name]
        assert (high - low) / (2 * 1.6449) == pytest.approx(spread, rel=0.05) and low < value < high
    assert made.sex == sex and made.sex_probability == 1


def test_both_thighs_alike_force_nobody_out(built_in):
    """Triangles of left and right differ by a fraction of a millimetre, which once cost 2 standard deviations."""
    made = body_with_measurements(*built_in, {"thigh": 0.6, "hip": 1.0}, "female")
    assert not made.missed and made.deviations < 1
    one = body_with_measurements(*built_in, {"thigh_left": 0.6, "hip": 1.0}, "female")
    assert np.abs(made.betas - one.betas).max() < 0.05


def test_the_sex_is_told_by_measures(built_in):
    """As Bayes has it for one measure: the densities of the two normal distributions."""
    model, tapes = built_in
    made, pose = body_with_measurements(model, tapes, {"stature": 1.72}), np.zeros((16, 3))
    density = {}
    for sex in ("female", "male"):
        people = shape_statistics(model, sex)
        taken = measure(model.vertices(pose, people.mean), tapes, tapes.axes, only=["stature"]).readings["stature"]
        s = taken.along(model.shape_jacobian(pose))
        density[sex] = norm.pdf(1.72, taken.value, np.sqrt(s @ people.covariance @ s))
    assert made.sex == max(density, key=density.get)
    assert made.sex_probability == pytest.approx(density[made.sex] / sum(density.values()), abs=0.02)


def test_chests_as_high_as_the_armpits(built_in):
    """The fold behind the arm is no chest: it once added up to 25 cm to a quarter of the women."""
    model, tapes = built_in
    pose, people = np.zeros((16, 3)), shape_statistics(model, "female")
    base, moves = model.vertices(pose, people.mean), model.shape_jacobian(pose)
    usual = measure(base, tapes, tapes.axes, only=["chest_girth"]).readings["chest_girth"]
    for betas in draw_betas(model, 40, np.random.default_rng(1), "female")[0] - people.mean:
        found = measure(base + moves @ betas, tapes, tapes.axes, only=["chest_girth"]).values["chest_girth"]
        assert found == pytest.approx(usual.value + usual.along(moves) @ betas, abs=0.08)
