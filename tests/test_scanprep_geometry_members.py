"""Bodies of a set compared with each other: each kind of bad member is named, whatever the size, and good sets pass."""
import numpy as np
import pytest
from model_bodies import random_poses, worm_model

from completion.__main__ import main
from model import LearnConfig, learn_blendscape, learn_scape, learn_skinning
from model.learning.mixing import learn_scape_mix
from scanprep import RegisteredSet, find_skeleton, write_mesh
from scanprep.geometry import rotations
from scanprep.geometry.files import read_registered
from scanprep.geometry.members import ONE_BODY, ONE_KIND, check_members, find_doubtful_members
from scanprep.geometry.mesh import Mesh

QUICK = LearnConfig(refinements=0, components=2, prunings=(0.01,), ridges=(0.01,))


@pytest.fixture(scope="module")
def truth():
    return worm_model(bulge=0.05)


@pytest.fixture(scope="module")
def poses(truth):
    """Eight poses of the worm, the first at rest."""
    angles = random_poses(truth, 8, np.random.default_rng(0), 0.3)
    angles[0] = 0
    return truth.subject().vertices(angles)


def shuffled(body):
    return body[np.random.default_rng(1).permutation(len(body))]


def spiked(body):
    """One vertex is off by a third of the worm's length."""
    body = body.copy()
    body[100] += 0.3 * np.ptp(body, axis=0).max() * np.array([0, 0, 1])
    return body


BAD = {"it is a mirror image": lambda body: body * [1, -1, 1], "its vertices are in another order": shuffled,
       r"it is 1\.[23]\d* times as large": lambda body: 1.3 * body,
       r"it is (99\d|10\d\d)\.?\d* times as large": lambda body: 1000 * body}


@pytest.mark.parametrize("size", [0.01, 1.0, 1000.0])
@pytest.mark.parametrize("member", [0, 3])
@pytest.mark.parametrize("what", BAD)
def test_a_bad_pose_is_named_whatever_the_size(truth, poses, what, member, size):
    bodies = size * poses
    bodies[member] = BAD[what](bodies[member])
    template = Mesh(bodies[0] if member == 0 else size * truth.template.vertices, truth.template.faces)
    with pytest.raises(ValueError, match=rf"poses\[{member}\]: {what}"):
        check_members(template, bodies, "poses", ratio=ONE_BODY)


def test_people_may_differ_in_size_and_poses_of_one_may_not(truth, poses):
    bodies = poses * np.array([1, 1, 1, 1.8, 1, 1, 0.7, 1])[:, None, None]
    check_members(truth.template, bodies, "shapes", ratio=ONE_KIND)
    with pytest.raises(ValueError, match=r"poses\[3\]: it is 1\.[78]\d* times"):
        check_members(truth.template, bodies, "poses", ratio=ONE_BODY)


def test_a_mirror_image_is_found_under_noise_as_long_as_an_edge(truth, poses):
    noisy = poses + np.random.default_rng(2).normal(0, 0.5 * truth.template.mean_edge, poses.shape)
    check_members(truth.template, noisy[:3], "poses", ratio=np.inf)
    noisy[3] *= [1, -1, 1]
    with pytest.raises(ValueError, match=r"poses\[3\]"):
        check_members(truth.template, noisy, "poses", ratio=np.inf)


@pytest.mark.parametrize("size", [0.01, 1.0, 1000.0])
def test_a_spike_is_named_whatever_the_size(truth, poses, size):
    bodies, template = size * poses, Mesh(size * truth.template.vertices, truth.template.faces)
    assert find_doubtful_members(template, bodies, "poses", ratio=ONE_BODY) == []
    bodies[5] = spiked(bodies[5])
    check_members(template, bodies, "poses", ratio=ONE_BODY)
    (doubt,) = find_doubtful_members(template, bodies, "poses", ratio=ONE_BODY)
    assert doubt.startswith("poses[5]: vertex 100 is a spike")


def test_poses_of_different_people_need_a_look(truth, poses):
    sizes = np.exp(np.linspace(-0.06, 0.06, 8))[:, None, None]
    (doubt,) = find_doubtful_members(truth.template, sizes * poses, "poses", ratio=ONE_BODY)
    assert "different people" in doubt
    assert find_doubtful_members(truth.template, sizes * poses, "shapes") == []


def test_one_body_as_many_people_needs_a_look(truth, poses):
    (doubt,) = find_doubtful_members(truth.template, poses, "shapes")
    assert "one body in many poses" in doubt
    # the same in one pose, turned, scaled and with noise: copies are named
    many = poses * np.exp(np.linspace(-0.06, 0.06, 8))[:, None, None]
    turn, noise = rotations.exp(np.array([0.3, 2.0, 1.0])), np.random.default_rng(3).normal(0, 1, many[0].shape)
    many[5] = 1.1 * many[2] @ turn.T + 2 + 0.0005 * np.ptp(many[2]) * noise
    assert find_doubtful_members(truth.template, many, "shapes", list("abcdefgh")) == [
        "shapes: c: f is the same body in the same pose: leave out the copies"]
    assert find_doubtful_members(truth.template, many, "poses", ratio=np.inf) == []
    many[5] = 1.1 * many[2] @ turn.T + 2
    (doubt,) = find_doubtful_members(truth.template, many, "poses", ratio=np.inf)
    assert doubt.startswith("poses[2]: [5] is the same body")


@pytest.mark.real
def test_scans_of_people_are_poses_of_one_and_bodies_of_one_kind(real_data):
    for folder, ratio in (("scape_poses", ONE_BODY), ("spring_shapes", ONE_KIND)):
        read = read_registered(real_data / folder)
        template, bodies, names = Mesh(read.vertices[0], read.faces), read.vertices, read.names
        check_members(template, bodies, folder, names, ratio)
        assert find_doubtful_members(template, bodies, folder, names, ratio) == []


def test_every_way_to_learn_refuses_a_mirrored_pose(truth, poses):
    bodies, (body, tree) = poses.copy(), (truth.template, truth.skeleton)
    bodies[3] *= [1, -1, 1]
    ways = {
        "poses": [lambda: learn_scape(body, bodies, None, tree, QUICK),
                  lambda: learn_blendscape(body, bodies, None, tree, QUICK),
                  lambda: learn_skinning(body, bodies, None, tree), lambda: find_skeleton(body, bodies)],
        "shapes": [lambda: learn_scape(body, poses, bodies, tree, QUICK)],
        "bodies": [lambda: learn_scape_mix(body, bodies, list("aabbccdd"), tree)]}
    for name, calls in ways.items():
        for call in calls:
            with pytest.raises(ValueError, match=rf"^{name}\[3\]: it is a mirror image"):
                call()


@pytest.mark.parametrize("command", ["learn", "prep skeleton"])
def test_commands_name_the_file(truth, poses, tmp_path, capsys, command):
    whole = RegisteredSet.create(tmp_path / "set", truth.template)
    for i, body in enumerate(poses):
        body = body * [1, -1, 1] if i == 3 else body
        write_mesh(tmp_path / "plain" / f"bend{i}.ply", truth.template.with_vertices(body))
        whole = whole.add(f"bend{i}", body, subject="worm")
    for name in ("plain", "set"):
        option = ["--poses"] if command == "learn" else []
        assert main([*command.split(), *option, str(tmp_path / name), "-o", str(tmp_path / "out.npz")]) == 1
        assert f"{name}: bend3: it is a mirror image of the other bodies" in capsys.readouterr().err
    assert main(["learn", "--poses", str(tmp_path / "set"), "--shapes", str(tmp_path / "plain"), "--kind", "skinning",
                 "-o", str(tmp_path / "out.npz")]) == 1
