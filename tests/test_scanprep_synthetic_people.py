"""Synthetic people: the surface, correspondence, posing, poses and marks."""
from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import igl
import numpy as np
import pytest
from scanned_shapes import triangle_quality
from scipy.stats import norm

from model.measurement.find import find_tapes
from model.measurement.measure import measure
from model.measurement.survey import survey
from model.measurement.tapes import Height
from scanprep.geometry import rotations
from scanprep.geometry.mesh import Mesh, template_problem
from scanprep.registration.limbs import angle_excess, part_angles
from scanprep.synthetic import people, topology
from scanprep.synthetic.data_set import subject_pose
from scanprep.synthetic.landmarks import landmarks
from scanprep.synthetic.people import NAMED_POSES, PARENTS, PARTS, BodyShape, SyntheticPerson
from scanprep.synthetic.population import population

ROOT = Path(__file__).parents[1]
RECIPE = ROOT / "tests" / "people"
MAN, WOMAN = BodyShape(), BodyShape("female")
OTHERS = [BodyShape.like("female", stature=1.52, weight=2.0), BodyShape.like("male", stature=1.95, weight=-1.5),
          BodyShape.like("male", stature=1.70, weight=2.5), BodyShape.random(np.random.default_rng(1), "female")]


@pytest.fixture(scope="module")
def bodies() -> list[SyntheticPerson]:
    return [SyntheticPerson(shape) for shape in (MAN, WOMAN, *OTHERS)]


@pytest.fixture(scope="module")
def man(bodies: list[SyntheticPerson]) -> SyntheticPerson:
    return bodies[0]


def test_everybody_is_one_closed_outward_surface(bodies):
    for person in bodies:
        mesh = person.mesh
        assert template_problem(mesh) is None and mesh.is_closed
        assert len(mesh.vertices) == 12500
        assert len(mesh.vertices) - len(mesh.edges) + len(mesh.faces) == 2, "no handles"
        assert mesh.volume > 0
        # MakeHuman's quads, pressed thin in the groin and between toes, where skin meets skin
        assert triangle_quality(mesh).min() > 1e-3 and np.percentile(triangle_quality(mesh), 1) > 0.25


def test_the_file_is_what_the_recipe_makes():
    """It keeps the digest of the recipe that made it, with the table; `tests/people/make_people.py` makes it anew."""
    sys.path.insert(0, str(RECIPE))
    try:
        from make_people import recipe_digest
    finally:
        sys.path.remove(str(RECIPE))
    assert population().source["recipe"] == recipe_digest(ROOT / "model" / "measurement" / "ansur2.json")


def tapes_of_the_recipe():
    """Tapes as they were when the people were made from the survey.

    Heights were those on legs apart. Waist, bust and hips were the same rings of skin on everybody.
    """
    mesh, marks = topology.load_topology().mesh, landmarks()
    tapes, low = (find_tapes(mesh, {name: v for name, v in marks.items() if left_out not in name})
                  for left_out in ("navel", "neck"))            # the waist's own landmarks; nipples, not above them
    waist = replace(tapes.found["waist_girth"], level=None)
    rings = {"waist_girth": waist, "waist_height": Height(waist.centre),
             "chest_girth": replace(low.found["chest_girth"], level=None),
             "hip_girth": replace(tapes.found["hip_girth"], between=None)}
    return replace(tapes, found={**tapes.found, **rings}, legs=())


@pytest.mark.slow
@pytest.mark.parametrize("sex", ["female", "male"])
def test_people_of_a_sex_measure_as_those_of_the_survey(sex):
    """Means of measures, their spread and correlations, of 64 whose betas have exactly the moments of the sex."""
    people_, (mean, covariance), table = population(), population().moments[sex], survey(sex)
    tapes = tapes_of_the_recipe()
    z = np.random.default_rng(3).standard_normal((32, len(mean)))
    z = np.vstack([z, -z]) @ np.linalg.inv(np.linalg.cholesky(z.T @ z / len(z))).T
    drawn = [people_.rows(b)[:len(people_.weights)] for b in mean + z @ np.linalg.cholesky(covariance).T]
    at = [i for i, name in enumerate(table.names) if name not in ("weight", "knee_height", "age")]
    words = [name if name in tapes.found else f"{name}_left" for name in (table.names[i] for i in at)]
    found = [measure(body, tapes, tapes.axes, only=words).values for body in drawn]
    values = np.array([[each[word] for word in words] for each in found])
    off, spread = values.mean(axis=0) - table.mean[at], values.std(axis=0) / table.sd[at]
    assert (np.abs(off) <= np.maximum(0.008, 0.01 * table.mean[at])).all(), dict(zip(words, off, strict=True))
    assert np.abs(spread - 1).max() < 0.06, dict(zip(words, spread, strict=True))
    apart = np.abs(np.corrcoef(values.T) - table.correlation[np.ix_(at, at)])[np.triu_indices(len(at), 1)]
    assert apart.mean() < 0.04 and apart.max() < 0.15


def test_the_first_betas_are_stature_weight_and_sex():
    one = [population().rows(np.eye(30)[k] * 0.5)[:12500] for k in range(3)]
    none = population().rows(np.zeros(1))[:12500]
    faces = population().faces
    tall = [body[:, 2].max() - none[:, 2].max() for body in one]
    heavy = [Mesh(body, faces).volume - Mesh(none, faces).volume for body in one]
    assert tall[0] > 0.03 and heavy[1] > 0.004
    assert max(abs(tall[1]), abs(tall[2])) < 0.15 * tall[0] and abs(heavy[2]) < 0.25 * heavy[1]
    assert population().moments["male"][0][2] > 0.5 > -0.3 > population().moments["female"][0][2]


def test_stature_and_floor(bodies):
    for person, stature in zip(bodies, (1.756, 1.628, 1.52, 1.95, 1.70), strict=False):
        z = person.mesh.vertices[:, 2]
        assert z.max() == pytest.approx(stature, abs=0.004) and z.min() == pytest.approx(0, abs=1e-9)


def test_mass_is_that_of_the_survey(bodies):
    for person, sex in zip(bodies[:2], ("male", "female"), strict=True):
        table = survey(sex)
        assert 985 * person.mesh.volume == pytest.approx(table.mean[table.names.index("weight")], rel=0.03)
    heavier = SyntheticPerson(BodyShape.like(weight=1.0))
    assert 6 < 985 * (heavier.mesh.volume - bodies[0].mesh.volume) < 18


def test_mirrored_pose_gives_the_mirrored_body(man):
    twin = topology.load_topology().mirror
    pose = people.find_pose("throw_right")
    assert np.abs(man.in_pose(people.mirror_synthetic_pose(pose))[twin] * [-1, 1, 1] - man.in_pose(pose)).max() < 1e-9


def test_parts_are_connected_and_form_the_tree(man):
    assert len(PARTS) == 16 and set(man.part_of_face) == set(range(16))
    for part in range(16):
        piece, _ = man.mesh.submesh(man.part_of_face == part)
        assert piece.vertex_component.max() == 0, PARTS[part]
    pairs = man.part_of_face[man.mesh.face_pairs]
    touching = {tuple(sorted(pair)) for pair in pairs[pairs[:, 0] != pairs[:, 1]].tolist()}
    assert {(int(PARENTS[p]), p) for p in range(1, 16)} <= touching
    assert man.skeleton.joint_regressor(man.mesh) @ man.mesh.vertices == pytest.approx(man.joints, abs=1e-9)


def test_random_shapes_differ_repeat_and_are_spread_as_their_sex():
    one, two = (BodyShape.random(np.random.default_rng(seed)) for seed in (3, 3))
    assert one == two and one != BodyShape.random(np.random.default_rng(4))
    rng = np.random.default_rng(0)
    drawn = np.array([BodyShape.random(rng, "female").betas for _ in range(2000)])
    mean, covariance = population().moments["female"]
    sd = np.sqrt(np.diag(covariance))
    assert np.abs((drawn.mean(axis=0) - mean) / sd).max() < norm.ppf(1 - 1e-4) / np.sqrt(2000)
    assert np.abs(drawn.std(axis=0) / sd - 1).max() < 0.07
    assert {BodyShape.random(rng).sex for _ in range(20)} == {"female", "male"}


@pytest.mark.parametrize(("given", "why"), [
    (("woman",), "sex: expected 'female' or 'male', got 'woman'"),
    (("male", (0.0, np.nan)), "betas: expected at most 30"), (("male", (0.0,) * 31), "betas: expected at most 30")])
def test_shapes_that_nobody_has_are_refused(given, why):
    with pytest.raises(ValueError, match=why):
        BodyShape(*given)


def test_pose_zero_is_rest(bodies):
    for person in bodies[:2]:
        assert np.abs(person.in_pose(np.zeros((16, 3))) - person.mesh.vertices).max() < 1e-9


def test_turning_the_root_turns_the_body(man):
    pose = people.find_pose("boxer")
    turned = pose.copy()
    R = rotations.exp(np.array([0.4, -0.9, 1.3]))
    turned[0] = rotations.log(R @ rotations.exp(pose[0]))
    expected = (man.in_pose(pose) - man.joints[0]) @ R.T + man.joints[0] + [1, 2, 3]
    assert np.abs(man.in_pose(turned, np.array([1.0, 2, 3])) - expected).max() < 1e-9
    joints = (man.joints_in_pose(pose) - man.joints[0]) @ R.T + man.joints[0]
    assert np.abs(man.joints_in_pose(turned) - joints).max() < 1e-9


def test_parts_follow_their_rotations(man):
    """Away from the joints every part turns as the pose says."""
    for name in ("run", "point_right", "kick_left"):
        pose = people.find_pose(name)
        R = man.part_rotations(pose)
        fitted = man.skeleton.fit_rotations(man.mesh, man.in_pose(pose))
        angle = np.degrees(np.linalg.norm(rotations.log(np.swapaxes(R, 1, 2) @ fitted), axis=1))
        assert np.median(angle) < 3 and angle.max() < 15, dict(zip(PARTS, angle.round(1), strict=True))


@pytest.mark.parametrize("name", NAMED_POSES)
def test_named_poses_keep_the_volume_and_do_not_collapse(man, name):
    mesh = man.mesh.with_vertices(man.in_pose(people.find_pose(name)))
    assert abs(mesh.volume / man.mesh.volume - 1) < 0.09
    stretch = mesh.edge_lengths / man.mesh.edge_lengths
    assert np.percentile(stretch, 0.5) > 0.25 and np.percentile(stretch, 99.9) < 3.0
    assert inside(mesh).mean() - inside(man.mesh).mean() < 0.02, "gross self-intersection"


def inside(mesh: Mesh) -> np.ndarray:
    """(F,) bool, triangles with skin less than 1.5 mm before them: of lips and ears at rest, else within the body."""
    before = mesh.corners.mean(axis=1) + 0.0015 * mesh.face_normals
    return np.asarray(igl.fast_winding_number(mesh.vertices, mesh.faces, np.ascontiguousarray(before))) > 0.6


def test_unknown_poses_are_refused():
    with pytest.raises(ValueError, match="no pose 'cartwheel'"):
        people.find_pose("cartwheel")
    with pytest.raises(ValueError, match="pose: expected finite"):
        SyntheticPerson().in_pose(np.zeros((15, 3)))


def test_walk_goes_ahead_with_a_foot_on_the_floor(man):
    poses, trans = people.synthesise_walk(44, rate=20.0)
    assert poses.shape == (44, 16, 3) and trans.shape == (44, 3)
    assert 0.8 < -(trans[-1, 1] - trans[0, 1]) / (43 / 20) < 2.0            # metres a second, towards -y
    assert (-np.diff(trans[:, 1]) * 20).min() > 0.6, "nobody steps back between the feet"
    lowest = np.array([(man.in_pose(p, t))[:, 2].min() for p, t in zip(poses[::4], trans[::4], strict=True)])
    assert np.abs(lowest).max() < 0.03
    once, _ = people.synthesise_walk(1, rate=20.0)
    again, _ = people.synthesise_walk(23, rate=20.0)
    assert np.abs(again[22] - once[0]).max() < 1e-9                          # a cycle is 1.1 s


def test_landmarks_and_markers(bodies):
    twin = topology.load_topology().mirror
    assert 36 <= len(people.LANDMARKS) <= 48 and len(people.MARKERS) == 41
    for table in (people.LANDMARKS, people.MARKERS):
        assert len(set(table.values())) == len(table)
        assert all(0 <= v < len(twin) for v in table.values())
    for name, vertex in people.LANDMARKS.items():
        if name.startswith("left "):
            assert people.LANDMARKS["right " + name[5:]] == twin[vertex]
        assert (bodies[0].mesh.vertices[vertex, 0] > 0.01) == name.startswith("left ")
    nose = bodies[0].mesh.vertices[people.LANDMARKS["nose tip"]]
    head = bodies[0].mesh.vertices[bodies[0].part_of_vertex == 3]
    assert nose[1] == pytest.approx(head[:, 1].min(), abs=0.004), "people face -y"


@pytest.mark.slow
def test_the_poses_of_the_demonstration_are_ones_that_people_do(man):
    """No limb lies so that its registration would be doubted, whatever the seed."""
    poses = [subject_pose(k, np.random.default_rng([seed, 1, k]))[1] for seed in range(6) for k in range(1, 12)]
    bodies = np.stack([man.in_pose(pose) for pose in poses])
    assert not angle_excess(part_angles(man.skeleton.fit_rotations(man.mesh, bodies))).any()
