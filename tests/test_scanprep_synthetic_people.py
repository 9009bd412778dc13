"""Synthetic people: the surface, correspondence, posing, poses and marks."""
from __future__ import annotations

import igl
import numpy as np
import pytest

from scanprep.geometry import rotations, storage
from scanprep.geometry.mesh import Mesh, template_problem
from scanprep.registration.limbs import beyond_people, joint_angles
from scanprep.synthetic import people, topology
from scanprep.synthetic.body_parts import body_surface
from scanprep.synthetic.data_set import subject_pose
from scanprep.synthetic.muscles import COLUMNS, masks
from scanprep.synthetic.people import NAMED_POSES, PARENTS, PARTS, BodyShape, Person

MAN = BodyShape()
WOMAN = BodyShape(sex=-1.0, stature=1.63)
OTHERS = [BodyShape(sex=-1.0, stature=1.52, weight=2.0, chest=1.0),
          BodyShape(stature=1.95, weight=-1.5, leg_length=1.5),
          BodyShape(stature=1.70, muscle=2.5, belly=2.0, weight=1.5),
          BodyShape(sex=0.2, stature=1.60, arm_length=-2.0)]


@pytest.fixture(scope="module")
def bodies() -> list[Person]:
    return [Person(shape) for shape in (MAN, WOMAN, *OTHERS)]


@pytest.fixture(scope="module")
def man(bodies: list[Person]) -> Person:
    return bodies[0]


def quality(mesh: Mesh) -> np.ndarray:
    """1 for an equilateral triangle, 0 for one without area."""
    c = mesh.corners
    return 4 * np.sqrt(3) * mesh.face_areas / ((c - np.roll(c, 1, axis=1))**2).sum(axis=(1, 2))


def test_everybody_is_one_closed_outward_surface(bodies):
    for person in bodies:
        mesh = person.mesh
        assert template_problem(mesh) is None and mesh.is_closed
        assert 6000 <= len(mesh.vertices) <= 12000
        assert len(mesh.vertices) - len(mesh.edges) + len(mesh.faces) == 2, "no handles"
        assert mesh.volume > 0
        assert quality(mesh).min() > 0.02 and np.percentile(quality(mesh), 1) > 0.6


def test_canonical_mesh_has_no_slivers():
    assert quality(topology.load().mesh).min() > 0.4


def test_topology_is_shared_and_vertices_lie_on_the_surface_that_the_code_describes(bodies):
    for person in bodies:
        assert np.array_equal(person.mesh.faces, topology.load().mesh.faces)
        distance = np.abs(body_surface(person.anatomy)(person.mesh.vertices))
        assert np.median(distance) < 1e-5 and np.percentile(distance, 99) < 5e-4 and distance.max() < 5e-3


def test_stored_template_is_what_the_code_would_build():
    _, arrays = storage.load(topology.STORED, "people template", (topology.VERSION,))
    stored = arrays["vertices"] / 1e5
    assert np.abs(body_surface(topology.Anatomy(topology.CANONICAL))(stored)).max() < 5e-4
    assert topology.STORED.stat().st_size < 300_000


def test_stature_and_floor(bodies):
    for person in bodies:
        z = person.mesh.vertices[:, 2]
        assert z.max() == pytest.approx(person.shape.stature, abs=0.003)
        assert z.min() == pytest.approx(0, abs=0.003)


def test_mass_is_plausible(bodies):
    """A litre of body weighs about a kilogram; body mass index of the averages."""
    for person in bodies[:2]:
        assert 20 < 1000 * person.mesh.volume / person.shape.stature**2 < 25
    heavier = Person(BodyShape.like(weight=1.0))
    assert 8 < 1000 * (heavier.mesh.volume - bodies[0].mesh.volume) < 16


def test_left_and_right_are_mirror_images(bodies):
    twin = topology.load().mirror
    assert np.array_equal(twin[twin], np.arange(len(twin)))
    for person in bodies:
        v = person.mesh.vertices
        assert np.abs(v[twin] * [-1, 1, 1] - v).max() < 1e-12
        assert np.abs(person.joints[topology.PARENTS == 0][:, 0].sum()) < 1e-12


def test_mirrored_pose_gives_the_mirrored_body(man):
    twin = topology.load().mirror
    pose = people.named_pose("throw_right")
    assert np.abs(man.posed(people.mirrored_pose(pose))[twin] * [-1, 1, 1] - man.posed(pose)).max() < 1e-9


def test_joints_lie_inside_the_body(bodies):
    for person in bodies:
        pose = people.named_pose("run")
        for mesh, joints in ((person.mesh, person.joints),
                             (person.mesh.with_vertices(person.posed(pose)), person.posed_joints(pose))):
            inside = igl.fast_winding_number(mesh.vertices, mesh.faces, np.ascontiguousarray(joints))
            assert (np.asarray(inside) > 0.5).all(), np.array(PARTS)[np.asarray(inside) < 0.5]


def test_parts_are_connected_and_form_the_tree(man):
    assert len(PARTS) == 16 and set(man.part_of_face) == set(range(16))
    for part in range(16):
        piece, _ = man.mesh.submesh(man.part_of_face == part)
        assert piece.vertex_component.max() == 0, PARTS[part]
    pairs = man.part_of_face[man.mesh.face_pairs]
    touching = {tuple(sorted(pair)) for pair in pairs[pairs[:, 0] != pairs[:, 1]].tolist()}
    assert {(int(PARENTS[p]), p) for p in range(1, 16)} <= touching
    assert man.skeleton.joint_regressor(man.mesh) @ man.mesh.vertices == pytest.approx(man.joints, abs=1e-9)


def test_same_vertex_is_the_same_place_on_everybody(bodies):
    for person in bodies:
        v, j = person.mesh.vertices, person.anatomy.joints
        assert np.linalg.norm(v[people.LANDMARKS["nose tip"]] - v[people.LANDMARKS["chin"]]) < 0.09
        assert v[people.LANDMARKS["top of head"], 2] == pytest.approx(person.shape.stature, abs=0.004)
        for side, elbow in (("left", 5), ("right", 8)):
            middle = 0.5 * (v[people.LANDMARKS[f"{side} elbow outside"]] + v[people.LANDMARKS[f"{side} elbow inside"]])
            assert np.linalg.norm(middle - j[elbow]) < 0.03


def test_random_shapes_differ_and_repeat():
    one, two = (BodyShape.random(np.random.default_rng(seed)) for seed in (3, 3))
    assert one == two and one != BodyShape.random(np.random.default_rng(4))
    assert BodyShape.random(np.random.default_rng(0), sex=-1.0).sex == -1.0
    assert np.array_equal(BodyShape.from_array(one.array()).array(), one.array())


def test_shape_out_of_range_is_refused():
    with pytest.raises(ValueError, match=r"stature: expected 1\.45 to 2\.05, got 175"):
        BodyShape(stature=175)


def test_every_shape_parameter_moves_the_surface(man):
    for name in ("weight", "muscle", "leg_length", "arm_length", "shoulder_width", "hip_width", "belly", "chest",
                 "neck",
                 "head_size", "limbs", "extremities", "nose"):
        other = topology.Anatomy(BodyShape(**{name: 1.5}))
        assert np.abs(body_surface(other)(man.mesh.vertices)).max() > 0.0025, name


def test_pose_zero_is_rest(bodies):
    for person in bodies[:2]:
        assert np.abs(person.posed(np.zeros((16, 3))) - person.mesh.vertices).max() < 1e-9


def test_turning_the_root_turns_the_body(man):
    pose = people.named_pose("boxer")
    turned = pose.copy()
    R = rotations.exp(np.array([0.4, -0.9, 1.3]))
    turned[0] = rotations.log(R @ rotations.exp(pose[0]))
    expected = (man.posed(pose) - man.joints[0]) @ R.T + man.joints[0] + [1, 2, 3]
    assert np.abs(man.posed(turned, np.array([1.0, 2, 3])) - expected).max() < 1e-9
    joints = (man.posed_joints(pose) - man.joints[0]) @ R.T + man.joints[0]
    assert np.abs(man.posed_joints(turned) - joints).max() < 1e-9


def test_root_part_stays_centred(man):
    for name in ("squat", "run"):
        v = man.posed(people.named_pose(name))
        assert np.abs(v[man.part_of_vertex == 0].mean(axis=0) - man.joints[0]).max() < 1e-9


def test_parts_follow_their_rotations(man):
    """Away from the joints every part turns as the pose says."""
    for name in ("run", "point_right", "kick_left"):
        pose = people.named_pose(name)
        R = man.part_rotations(pose)
        fitted = man.skeleton.fit_rotations(man.mesh, man.posed(pose))
        angle = np.degrees(np.linalg.norm(rotations.log(np.swapaxes(R, 1, 2) @ fitted), axis=1))
        assert np.median(angle) < 3 and angle.max() < 15, dict(zip(PARTS, angle.round(1), strict=True))


def test_posing_is_not_linear_blend_skinning(man):
    """What the best linear blend of the parts' rigid motions leaves over, vertex by vertex."""
    poses = [people.named_pose(name) for name in NAMED_POSES]
    posed = np.stack([man.posed(pose) for pose in poses])
    affine = np.empty((len(poses), 16, 3, 4))
    for k, pose in enumerate(poses):
        R, place = man._poser.part_motion(pose)
        affine[k] = np.concatenate([R, (place - np.einsum("pij,pj->pi", R, man.anatomy.joints)
                                        + man._poser.settling(pose))[..., None]], axis=2)
    rest = np.hstack([man.mesh.vertices, np.ones((len(man.mesh.vertices), 1))])
    residual = np.empty(len(rest))
    for v in range(0, len(rest), 60):
        basis = np.einsum("kpij,j->kip", affine, rest[v]).reshape(-1, 16)
        weights = np.linalg.lstsq(basis, posed[:, v].reshape(-1), rcond=1e-6)[0]
        residual[v] = np.sqrt(np.mean((basis @ weights - posed[:, v].reshape(-1))**2) * 3)
    sampled = residual[::60]
    assert np.mean(sampled) > 0.0015 and np.percentile(sampled, 90) > 0.003


def test_muscles_bulge_with_strength():
    """A bent elbow raises the biceps in the frame of the upper arm, more on a strong person."""
    bent = people.compose(left_arm={"elbow": 95})
    rises = []
    for muscle in (-1.0, 2.0):
        person = Person(BodyShape(muscle=muscle))
        biceps = masks()[:, COLUMNS["biceps", "l"]].argmax()
        rest = person.mesh.vertices[biceps] - person.joints[4]
        R = person.part_rotations(bent)[4]
        moved = R.T @ (person.posed(bent)[biceps] - person.posed_joints(bent)[4])
        rises.append((moved - rest) @ person.mesh.vertex_normals[biceps])
    assert 0.004 < rises[0] < 0.02 and rises[1] > rises[0] + 0.004


def test_raised_arms_raise_the_shoulders(man):
    rest, up = man.posed_joints(np.zeros((16, 3))), man.posed_joints(people.named_pose("arms_up"))
    assert 0.03 < up[4, 2] - rest[4, 2] < 0.10
    assert up[4, 2] == pytest.approx(up[7, 2], abs=1e-9)


@pytest.mark.parametrize("name", NAMED_POSES)
def test_named_poses_keep_the_volume_and_do_not_collapse(man, name):
    mesh = man.mesh.with_vertices(man.posed(people.named_pose(name)))
    assert abs(mesh.volume / man.mesh.volume - 1) < 0.09
    stretch = mesh.edge_lengths / man.mesh.edge_lengths
    assert np.percentile(stretch, 0.5) > 0.25 and np.percentile(stretch, 99.9) < 3.0
    middle = mesh.corners.mean(axis=1) + 0.0015 * mesh.face_normals
    inside = np.asarray(igl.fast_winding_number(mesh.vertices, mesh.faces, np.ascontiguousarray(middle))) > 0.6
    assert inside.mean() < 0.02, "gross self-intersection"


def test_poses_are_many_and_unknown_ones_refused():
    assert len(NAMED_POSES) >= 24
    with pytest.raises(ValueError, match="no pose 'cartwheel'"):
        people.named_pose("cartwheel")
    with pytest.raises(ValueError, match="pose: expected finite"):
        Person().posed(np.zeros((15, 3)))


def test_random_poses_are_repeatable_varied_and_scale_with_spread():
    drawn = np.stack([people.random_pose(np.random.default_rng(seed)) for seed in range(40)])
    assert np.array_equal(drawn[7], people.random_pose(np.random.default_rng(7)))
    assert np.allclose(people.random_pose(np.random.default_rng(7), spread=0.0), 0)
    assert drawn[:, 1:].std(axis=0).max() > 0.4
    assert np.degrees(np.linalg.norm(drawn, axis=2)).max() < 178


def test_walk_goes_ahead_with_a_foot_on_the_floor(man):
    poses, trans = people.walk(44, rate=20.0)
    assert poses.shape == (44, 16, 3) and trans.shape == (44, 3)
    assert 0.8 < -(trans[-1, 1] - trans[0, 1]) / (43 / 20) < 2.0            # metres a second, towards -y
    lowest = np.array([(man.posed(p, t))[:, 2].min() for p, t in zip(poses[::4], trans[::4], strict=True)])
    assert np.abs(lowest).max() < 0.03
    once, _ = people.walk(1, rate=20.0)
    again, _ = people.walk(23, rate=20.0)
    assert np.abs(again[22] - once[0]).max() < 1e-9                          # a cycle is 1.1 s


def test_landmarks_and_markers(bodies):
    twin = topology.load().mirror
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


def test_the_poses_of_the_demonstration_are_ones_that_people_do(man):
    """No limb lies so that its registration would be doubted, whatever the seed."""
    poses = [subject_pose(k, np.random.default_rng([seed, 1, k]))[1] for seed in range(6) for k in range(1, 12)]
    bodies = np.stack([man.posed(pose) for pose in poses])
    assert not beyond_people(joint_angles(man.skeleton.fit_rotations(man.mesh, bodies))).any()
