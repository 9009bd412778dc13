"""Measurements of people in any pose and any triangles: the outer skin, standing, errors of the pose, plausibility."""
import numpy as np
import pytest
import trimesh
from people_bodies import small_people
from scanned_shapes import ball

from model import find_tapes, measure
from model.measurement.measure import Measurements
from model.measurement.person import measure_person
from model.measurement.plausible import implausible_measures
from model.measurement.section import part_around, section
from model.posing.standing import StandingModel
from scanprep.geometry.mesh import Mesh
from scanprep.synthetic.landmarks import landmarks
from scanprep.synthetic.people import BodyShape, SyntheticPerson

UP = np.array([0.0, 0.0, 1.0])


def join(outer: Mesh, inner: Mesh) -> Mesh:
    """Join two meshes; the vertices of the first keep their numbers."""
    return Mesh(np.vstack([outer.vertices, inner.vertices]),
                np.vstack([outer.faces, inner.faces + len(outer.vertices)]))


def test_of_sections_inside_each_other_the_outermost_is_the_skin():
    """Also where the inner one is nearer to the point that the plane goes through."""
    off = np.array([0.04, 0, 0])
    throat, skin = ball(3, 0.02), ball(3, 0.1)
    for both in (join(skin, throat.with_vertices(throat.vertices + off)),
                 join(throat.with_vertices(throat.vertices + off), skin)):
        curve = part_around(section(both.vertices, both.faces, off + 0.001 * UP, UP), both.vertices, off, UP)
        assert np.linalg.norm(curve.at(both.vertices), axis=1) == pytest.approx(0.1, abs=0.002)
    beside = join(skin, throat.with_vertices(throat.vertices + 5 * off))
    curve = part_around(section(beside.vertices, beside.faces, 5 * off + 0.001 * UP, UP), beside.vertices, 5 * off, UP)
    assert np.ptp(curve.at(beside.vertices), axis=0).max() < 0.05, "a ball beside is not the skin around this point"


@pytest.fixture(scope="module")
def standing() -> tuple[StandingModel, np.ndarray]:
    """The small people laid on a template of four times as many triangles, and the vertices of one who bends knees."""
    model = small_people()
    fine, faces = trimesh.remesh.subdivide(model.template.vertices, model.template.faces)
    order = np.random.default_rng(0).permutation(len(fine))
    template = Mesh(fine[order], np.argsort(order)[faces])
    pose = np.zeros((len(model.skeleton.parents), 3))
    for part, axis, angle in (("upper_arm_left", 1, 0.8), ("thigh_left", 0, -0.7), ("shin_left", 0, 0.9)):
        pose[model.skeleton.names.index(part), axis] = angle
    bent = trimesh.remesh.subdivide(model.vertices(pose), model.template.faces)[0][order]
    return StandingModel(model, template, model.template), bent


def people_tapes(standing):
    return find_tapes(standing.template, standing.landmarks(small_people().info["landmarks"]))


def measure_in_pose(standing, vertices) -> Measurements:
    tapes = people_tapes(standing)
    return measure_person(vertices, tapes, standing, tapes.axes, np.full(len(vertices), 0.002))


@pytest.mark.slow
def test_bodies_of_other_triangles_are_measured_standing(standing):
    """Heights, trunk and knees as on the body at rest, with larger errors; a calf as it is."""
    laid, bent = standing
    rest, posed = (measure_in_pose(laid, vertices) for vertices in (laid.template.vertices, bent))
    for name in ("stature", "shoulder_height", "crotch_height", "chest_girth", "hip_girth", "knee_girth_left"):
        assert posed.values[name] == pytest.approx(rest.values[name], abs=0.008), name
        assert 0 < rest.errors[name] < posed.errors[name], name
    calf = measure(bent, people_tapes(laid), only=["calf_girth_left"]).values["calf_girth_left"]
    assert posed.values["calf_girth_left"] == pytest.approx(calf, abs=1e-4)
    raised, hanging = (each.errors["upper_arm_girth_left"] for each in (posed, rest))
    assert raised > 1.2 * hanging, "skin folds at the shoulder, also where the arm is measured as it is"
    assert np.abs(posed.body - laid.template.vertices).max() < 0.03


@pytest.mark.slow
def test_measures_of_people_are_plausible_and_misplaced_tapes_are_not():
    for sex, weight in (("male", 0.0), ("female", 2.5), ("male", 3.0), ("female", -1.5)):
        mesh = SyntheticPerson(BodyShape.like(sex, weight=weight)).mesh
        values = measure(mesh, find_tapes(mesh, landmarks())).values
        assert implausible_measures(values) == []
    for wrong, told in (({"waist_height": 0.75 * values["stature"]}, "waist height is 75% of stature, people have"),
                        ({"neck_girth": 0.104}, "neck girth is"),
                        ({"head_girth": 0.2 * values["stature"]}, "head girth is 20% of stature"),
                        ({"calf_girth_left": 1.2 * values["calf_girth_right"]}, "calf girth is .* left and .* right"),
                        ({"thigh_girth_right": 0.8 * values["hip_girth"]}, "thigh girth right is 80% of hip girth")):
        with pytest.raises(AssertionError, match=told):
            assert not implausible_measures({**values, **wrong}), implausible_measures({**values, **wrong})[0]
    arms = {"upper_arm_girth_left": 0.30, "upper_arm_girth_right": 0.35}
    assert implausible_measures(arms) and not implausible_measures(arms, dict.fromkeys(arms, 0.01))
