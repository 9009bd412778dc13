"""Registration of the control model by features: known poses come back, derivatives are right, clicks find depths."""

import numpy as np
import pytest
from derivatives import differences
from trimesh.remesh import subdivide_to_size

from model.statue.control.files import humanoid
from model.statue.fit import pose_automatically, pose_by_features
from model.statue.registration.articulated import Articulated, BoundPoints
from model.statue.registration.automatic import Features, find_features, person_unit
from model.statue.registration.features import feature_misfit, fit_features, head_share, warp
from model.statue.registration.person_search import LENGTH, control_body
from scanprep.decimation.decimate import decimate
from scanprep.geometry import rotations
from scanprep.geometry.mesh import Mesh
from scanprep.synthetic.people import BodyShape, SyntheticPerson, compose_pose

FACE = ("nose tip", "chin", "left eye", "right eye", "left ear", "right ear", "top of head")


@pytest.fixture(scope="module")
def control():
    return humanoid()


@pytest.fixture(scope="module")
def model(control):
    return Articulated(control)


def drawn(model, rng, share=0.7):
    """Random parameters inside the limits, the body anyhow in space."""
    x = model.rest.copy()
    angles, factors, place = model.split(x)
    low, high = np.where(np.isfinite(model.limits), model.limits, [-3, 3]).T
    angles[:] = rng.uniform(share * low, share * high)
    factors[:] = rng.uniform(0.85, 1.15, len(factors))
    place[:] = rng.normal(size=3)
    return x


def features_of(control, model, x):
    """Joints and points of the posed model by name."""
    frames = model.frames(x)
    vertices = model.positions(frames, model.vertices)
    return (dict(zip(control.skeleton.names[1:], frames.joints[1:], strict=True)),
            {name: vertices[control.landmarks[name]] for name in FACE})


def test_with_default_lengths_it_is_linear_blend_skinning(control, model):
    x = drawn(model, np.random.default_rng(0))
    model.split(x)[1][:] = 1
    skinned = control.rig.vertices(model.pose(x), model.split(x)[2])
    assert np.abs(model.positions(model.frames(x), model.vertices) - skinned).max() < 1e-12


def test_a_length_moves_the_joints_beyond_it_and_stretches_its_own_vertices_only(control, model):
    x, names = model.rest.copy(), control.skeleton.names
    model.split(x)[1][control.segments.index("forearm")] = 1.2
    elbow, wrist = names.index("l_elbow"), names.index("l_wrist")
    o, moved = control.skeleton.joints, model.frames(x).joints
    np.testing.assert_allclose(moved[wrist] - moved[elbow], 1.2 * (o[wrist] - o[elbow]))
    others = [j for j, name in enumerate(names) if "wrist" not in name]
    np.testing.assert_allclose(moved[others], o[others])
    bone = (o[wrist] - o[elbow]) / np.linalg.norm(o[wrist] - o[elbow])
    rigid = np.flatnonzero(control.weights[:, elbow] > 1 - 1e-9)
    d, now = (control.mesh.vertices[rigid] - o[elbow],
              model.positions(model.frames(x), model.vertices)[rigid] - moved[elbow])
    np.testing.assert_allclose(now @ bone, 1.2 * d @ bone, atol=1e-12)
    across = np.eye(3) - np.outer(bone, bone)
    np.testing.assert_allclose(now @ across, model.size(x) * d @ across, atol=1e-12)


def test_derivatives_are_finite_differences(control, model):
    rng = np.random.default_rng(1)
    x, some = drawn(model, rng), rng.choice(len(control.mesh.vertices), 40)
    points = BoundPoints(control.weights[some], control.mesh.vertices[some])
    goal = rng.normal(size=(40, 3))
    found = model.derivatives(model.frames(x), points)
    by_point = differences(lambda x: model.positions(model.frames(x), points), x, 1e-5)
    assert np.abs(found - by_point).max() < 1e-8 * np.abs(found).max()
    gradient = feature_misfit(model, x, points, goal)[1]
    numeric = differences(lambda x: feature_misfit(model, x, points, goal)[0], x, 1e-5)
    assert np.abs(gradient - numeric).max() < 1e-8 * np.abs(gradient).max()


def test_as_a_body_of_unknown_shape_it_has_the_same_lengths(control, model):
    """A beta of a segment is its length factor of [Statues] Eq. 2, 3, in surface and joints, in any pose."""
    body, x = control_body(control), model.rest.copy()
    forearm = control.segments.index("forearm")
    betas = np.zeros(body.n_betas)
    betas[1 + forearm] = 2.0
    model.split(x)[1][forearm] = 1 + 2.0 * LENGTH
    np.testing.assert_allclose(body.rest_vertices(betas), model.positions(model.frames(x), model.vertices), atol=1e-6)
    posed = drawn(model, np.random.default_rng(8))
    model.split(posed)[1][:], posed[-3:] = model.split(x)[1], 0
    by_angles = model.positions(model.frames(posed), model.vertices)
    by_betas = body.vertices(model.pose(posed), betas)
    np.testing.assert_allclose(by_betas - by_betas.mean(axis=0), by_angles - by_angles.mean(axis=0), atol=5e-3)


@pytest.mark.parametrize("seed", range(3))
def test_features_of_random_poses_are_met_and_noise_stays_within_the_limits(control, model, seed):
    rng = np.random.default_rng(seed)
    x = drawn(model, rng)
    joints, points = features_of(control, model, x)
    fit = fit_features(control, joints, points)
    assert fit.converged
    assert max(np.linalg.norm(fit.joints[1:] - list(joints.values()), axis=1)) < 1e-4
    assert max(np.linalg.norm(fit.vertices[control.landmarks[name]] - p) for name, p in points.items()) < 1e-4
    noise = 0.02
    rough = fit_features(control, {name: p + noise * rng.normal(size=3) for name, p in joints.items()},
                         {name: p + noise * rng.normal(size=3) for name, p in points.items()})
    assert rough.joint_rms < 2 * noise
    assert np.linalg.norm(rough.vertices - fit.vertices, axis=1).mean() < 3 * noise
    for pose, axes, limits in zip(rough.pose[1:], control.axes[1:], control.limits[1:], strict=True):
        angles = pose @ np.linalg.pinv(np.reshape(axes, (-1, 3)))
        assert (angles >= limits[:, 0] - 1e-9).all() and (angles <= limits[:, 1] + 1e-9).all()


def test_the_fit_turns_moves_and_scales_with_its_features(control, model):
    joints, points = features_of(control, model, drawn(model, np.random.default_rng(2), 0.4))
    R, t, s = rotations.exp(np.array([2.0, -1, 1.5])), np.array([3.0, 1, -2]), 1000.0
    fit = fit_features(control, joints, points)
    joints, points = ({name: s * (R @ p + t) for name, p in given.items()} for given in (joints, points))
    turned = fit_features(control, joints, points)
    np.testing.assert_allclose(turned.vertices, s * (fit.vertices @ R.T + t), atol=1e-5 * s)
    np.testing.assert_allclose(turned.lengths, s * fit.lengths, rtol=1e-4)
    # the pose is that of the skeleton: root rotation, then every part in its parent
    np.testing.assert_allclose(rotations.exp(turned.pose[0]), R @ rotations.exp(fit.pose[0]), atol=1e-4)


def test_what_the_features_leave_open_stays_at_its_default(control, model):
    x = model.rest.copy()
    joints, _ = features_of(control, model, x)
    trunk = {name: joints[name] for name in ("l_shoulder", "r_shoulder", "l_hip", "r_hip")}
    fit = fit_features(control, trunk)
    assert np.abs(fit.vertices - control.mesh.vertices).max() < 1e-3
    assert np.isnan(fit.point_rms) and fit.joint_rms < 1e-4
    # a straight arm says nothing of its twist
    along = joints["l_elbow"] - joints["l_shoulder"]
    straight = {**joints, "l_wrist": joints["l_elbow"] + 0.9 * along}
    twist = fit_features(control, straight).pose[control.skeleton.names.index("l_shoulder")] @ along
    assert abs(twist) / np.linalg.norm(along) < np.radians(10)


def test_features_that_are_no_numbers_are_refused(control, model):
    joints, _ = features_of(control, model, model.rest)
    with pytest.raises(ValueError, match="l_hip: expected three finite"):
        fit_features(control, {**joints, "l_hip": np.array([np.nan, 0, 0])})


def test_the_warp_is_equation_5(control):
    rng = np.random.default_rng(3)
    p, goal = rng.normal(size=(9, 3)), rng.normal(size=(9, 3))
    q = rng.normal(size=(50, 3))

    def phi(a, b):
        return np.linalg.norm(a[:, None] - b[None], axis=2) ** 3

    affine = np.column_stack([p, np.ones(9)])
    K = np.block([[phi(p, p), affine], [affine.T, np.zeros((4, 4))]])
    c = np.linalg.solve(K, np.vstack([goal - p, np.zeros((4, 3))]))
    by_hand = q + phi(q, p) @ c[:9] + np.column_stack([q, np.ones(50)]) @ c[9:]
    np.testing.assert_allclose(warp(q, p, goal), by_hand, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(warp(p, p, goal), goal, atol=1e-9)
    with pytest.raises(ValueError, match="one plane"):
        warp(q, p * [1, 1, 0], goal)
    with pytest.raises(ValueError, match="one plane"):
        warp(q, p[:3], goal[:3])


def test_features_that_were_found_pose_and_warp_as_those_that_were_clicked(control, model):
    """[Statues] Eq. 4, 5 without a click: the published way; ours begins on the scan where it shows the body."""
    joints, points = features_of(control, model, drawn(model, np.random.default_rng(5)))
    points["nose tip"] = points["nose tip"] + [0.0, -0.02, 0.0]
    clicked = pose_by_features(control, joints, points)
    on_scan = control.mesh.with_vertices(clicked.features.vertices + [0.0, 0.0, 0.01])
    found = Features(joints, points, (), on_scan, clicked.features, None)
    published = pose_automatically(control, found, registered=False)
    np.testing.assert_array_equal(published.start, clicked.start)
    assert published.face == len(FACE) and np.abs(published.start - clicked.features.vertices).max() > 0.01
    usual = pose_automatically(control, found)
    np.testing.assert_array_equal(usual.start, on_scan.vertices)
    hidden = pose_automatically(control, Features(joints, points, ("skullbase",), on_scan, clicked.features, None))
    head = head_share(control) == 1
    np.testing.assert_allclose(hidden.start[head], clicked.start[head], atol=1e-12)
    assert (usual.face, hidden.face) == (0, len(FACE)) and hidden.hidden[head].all()


@pytest.mark.parametrize(("length", "metres"), [(1.8, 1.0), (1750, 0.001), (171, 0.01), (70, 0.0254)])
def test_the_unit_is_told_by_the_height(length, metres):
    points = length * (SyntheticPerson().mesh.vertices @ rotations.exp(np.array([0.4, 1.0, 0])).T) / 1.75
    assert person_unit(points)[0] == metres


@pytest.mark.parametrize("length", [0.02, 1.0, 2.6, 6.0, 17.0, 500.0])
def test_a_size_of_no_unit_is_brought_to_a_person(length):
    points = SyntheticPerson().mesh.vertices
    metres, words = person_unit(length / np.ptp(points[:, 2]) * points)
    assert metres * length == pytest.approx(1.7, rel=0.02) and "brought to 1.7 m" in words


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:scan")
def test_a_person_of_few_triangles_and_of_any_size_is_found(control):
    person, size = SyntheticPerson(), 30.0
    scan = decimate(person.mesh, 800)
    found = find_features(control, scan.with_vertices(size * scan.vertices))
    joints = find_features(control, person.mesh).joints
    assert found.problem is None and found.joints.keys() == joints.keys()
    assert max(np.linalg.norm(found.joints[name] / size - joints[name]) for name in joints) < 0.025


@pytest.mark.slow
def test_a_person_is_found_upside_down_in_millimetres_with_holes_and_without_an_arm(control):
    person = SyntheticPerson(BodyShape.like("female", stature=1.62, weight=1.0))
    pose = compose_pose(left_arm={"direction": (0.8, 0.5, -0.3), "elbow": 40}, back={"turn": 15},
                        right_leg={"knee": 20})
    vertices, joints = person.in_pose(pose), person.joints_in_pose(pose)
    rng = np.random.default_rng(4)
    centres = vertices[person.mesh.faces].mean(axis=1)
    keep = ~np.isin(person.part_of_face, [8, 9])                              # the right forearm and hand are hidden
    for hole in rng.choice(len(centres), 8, p=person.mesh.face_areas / person.mesh.face_areas.sum()):
        keep &= np.linalg.norm(centres - centres[hole], axis=1) > 0.05
    R = rotations.exp(np.array([0, 0, 0.7])) @ np.diag([1.0, -1, -1])

    def seen(points):
        return 1000 * (points @ R.T + [2, -1, 3])

    # scans are as dense on legs as on hands
    dense, faces, before = subdivide_to_size(vertices, person.mesh.faces, 0.015, return_index=True)
    scan, _ = Mesh(seen(dense), faces).submesh(keep[before])
    found = find_features(control, scan)
    assert person_unit(scan.vertices)[0] == 0.001 and found.problem is None
    assert {"r_wrist", "right middle finger", "right wrist"} <= set(found.missing)
    for name, part in {"l_elbow": 5, "l_wrist": 6, "l_hip": 10, "l_knee": 11, "r_knee": 14, "skullbase": 3}.items():
        assert np.linalg.norm(found.joints[name] - seen(joints[part])) < 40, name
    from scanprep.synthetic import people

    apart = [np.linalg.norm(found.points[name] - seen(vertices[people.LANDMARKS[name]])) for name in FACE]
    assert np.mean(apart) < 25
    assert found.fit.joint_rms < 25


@pytest.mark.slow
def test_a_ball_is_no_person(control):
    t, z = np.meshgrid(np.linspace(0, 2 * np.pi, 40, endpoint=False), np.linspace(-0.98, 0.98, 30))
    r = np.sqrt(1 - z**2)
    points = 0.8 * np.stack([r * np.cos(t), r * np.sin(t), z], axis=-1).reshape(-1, 3)
    found = find_features(control, Mesh(points, np.zeros((0, 3), dtype=int)))
    assert "no person" in found.problem and found.fit is None and found.registered is None and not found.points
